//! `Camera`.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use numpy::ndarray::{Array1, Array2, Array3};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use samsod_camera::nalgebra::Isometry3;
use samsod_camera::{
    Camera as Placed, CameraFile, CameraFileError, IntrinsicParams, Intrinsics, ProjectionError, UndistortionMap,
    pose_from_rows, rows_from_pose,
};

use crate::arrays::{Frame, borrow};
use crate::{run, value_error};

/// A calibrated camera: its lens and, where they are known, its pose over the table and that of the table at the robot.
///
/// Frames: image, pixels, u right and v down, centres at integers; camera, mm, x right, y down, z forward; world, mm,
/// right-handed, the table is z = 0 and z points up; base, mm, of the robot. `a_from_b` is the 4 x 4 matrix that takes
/// coordinates of b to those of a.
///
/// Args:
///     matrix: float64 (3, 3), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
///     distortion: float64 (5,), OpenCV's k1, k2, p1, p2, k3.
///     size: width and height of the image in pixels.
///     world_from_camera: float64 (4, 4), translation in mm. None: only the lens is known.
///     base_from_world: float64 (4, 4), translation in mm. None: the robot's place is not known.
///
/// Raises:
///     ValueError: numbers that make no camera, such as a distortion that is not invertible all over the image.
///     TypeError: an argument is not such an array.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Camera {
    intrinsics: Intrinsics,
    placed: Option<Placed>,
    base_from_world: Option<Isometry3<f64>>,
    /// Made when it is first needed: it takes 8 bytes a pixel.
    map: OnceLock<UndistortionMap>,
}

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (matrix, distortion, size, world_from_camera=None, base_from_world=None))]
    fn new(
        matrix: &Bound<'_, PyAny>,
        distortion: &Bound<'_, PyAny>,
        size: (i64, i64),
        world_from_camera: Option<&Bound<'_, PyAny>>,
        base_from_world: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let [[fx_px, skew, cx_px], [zero, fy_px, cy_px], last] =
            rows::<3, 3>("matrix", "a C-contiguous float64 array of shape (3, 3)", matrix)?;
        if (skew, zero, last) != (0.0, 0.0, [0.0, 0.0, 1.0]) {
            return Err(PyValueError::new_err("matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"));
        }
        const LENS: &str = "a C-contiguous float64 array of shape (5,): k1, k2, p1, p2, k3";
        let lens = borrow::<f64, numpy::Ix1>("distortion", LENS, distortion)?;
        let &[k1, k2, p1, p2, k3] = lens.as_slice().map_err(value_error)? else {
            let given = lens.as_slice().map_or(0, <[f64]>::len);
            return Err(PyValueError::new_err(format!("distortion: expected {LENS}, got {given} numbers")));
        };
        let side = |pixels: i64| u32::try_from(pixels).map_err(|_| value_error(format!("size: {pixels} pixels")));
        let (width_px, height_px) = (side(size.0)?, side(size.1)?);
        let params = IntrinsicParams { width_px, height_px, fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3 };
        Self::from_parts(
            Intrinsics::new(params).map_err(value_error)?,
            world_from_camera.map(|rows| pose("world_from_camera", rows)).transpose()?,
            base_from_world.map(|rows| pose("base_from_world", rows)).transpose()?,
        )
    }

    /// Reads a camera file, as `samsod calibrate` writes it.
    ///
    /// Raises:
    ///     OSError: the file cannot be read.
    ///     ValueError: it is no camera file, or a number in it is impossible.
    #[staticmethod]
    fn from_file(path: PathBuf) -> PyResult<Self> {
        let file = CameraFile::read(&path).map_err(|error| unreadable(&path, error))?;
        Self::from_parts(file.intrinsics, file.world_from_camera, file.base.map(|base| base.base_from_world))
    }

    /// Focal lengths and principal point: float64 (3, 3), pixels.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let p = self.intrinsics.params();
        table(py, &[[p.fx_px, 0.0, p.cx_px], [0.0, p.fy_px, p.cy_px], [0.0, 0.0, 1.0]])
    }

    /// The lens: float64 (5,), k1, k2, p1, p2, k3.
    #[getter]
    fn distortion<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let p = self.intrinsics.params();
        Array1::from_vec(vec![p.k1, p.k2, p.p1, p.p2, p.k3]).into_pyarray(py)
    }

    /// Width and height of the image in pixels.
    #[getter]
    fn size(&self) -> (u32, u32) {
        self.intrinsics.size_px().into()
    }

    /// Pose of the camera over the table: float64 (4, 4), translation in mm; None if it is not known.
    #[getter]
    fn world_from_camera<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        let pose = self.placed.as_ref().map(Placed::world_from_camera);
        pose.map(|pose| table(py, &rows_from_pose(pose))).transpose()
    }

    /// Pose of the table at the robot: float64 (4, 4), translation in mm; None if it is not known.
    #[getter]
    fn base_from_world<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        self.base_from_world.as_ref().map(|pose| table(py, &rows_from_pose(pose))).transpose()
    }

    /// The image that an ideal lens of the same focal lengths and principal point would give.
    ///
    /// Args:
    ///     rgb: uint8 (H, W, 3), C-contiguous, of the camera's size; read in place.
    ///
    /// Returns:
    ///     uint8 (H, W, 3), bilinear; black where the camera saw nothing.
    ///
    /// Raises:
    ///     ValueError: the image has another size than the camera.
    ///     TypeError: `rgb` is not such an array.
    fn undistort<'py>(&self, py: Python<'py>, rgb: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let frame = Frame::new(rgb)?;
        let view = frame.view()?;
        let image = run(py, || {
            let mut image = samsod_camera::RgbImage::default();
            let map = self.map.get_or_init(|| UndistortionMap::new(&self.intrinsics));
            map.apply(&view, &mut image).map(|()| image)
        })?;
        let shape = (image.height() as usize, image.width() as usize, 3);
        Ok(Array3::from_shape_vec(shape, image.into_raw()).map_err(value_error)?.into_pyarray(py))
    }

    /// Where pixels of the camera image lie in the undistorted image.
    ///
    /// Args:
    ///     points: float64 (N, 2), u and v in pixels, C-contiguous.
    ///
    /// Returns:
    ///     float64 (N, 2), pixels.
    ///
    /// Raises:
    ///     ValueError: a point is not finite, or farther out than the lens model reaches; the message says which.
    ///     TypeError: `points` is not such an array.
    fn undistort_points<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        map_points(py, PIXELS, points, |pixel| self.intrinsics.undistort_point(pixel))
    }

    /// The points of the plane z = `height_mm` over the table that are seen at pixels of the image.
    ///
    /// Args:
    ///     points: float64 (N, 2), u and v in pixels, C-contiguous.
    ///     height_mm: height of what was seen over the table.
    ///
    /// Returns:
    ///     float64 (N, 3), mm.
    ///
    /// Raises:
    ///     ValueError: the pose of the camera is not known; a point is not finite, not in the image or does not meet the
    ///         plane: the message says which.
    ///     TypeError: `points` is not such an array.
    #[pyo3(signature = (points, height_mm=0.0))]
    fn world_from_image<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
        height_mm: f64,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let camera = self.placed()?;
        map_points(py, PIXELS, points, |pixel| camera.world_from_image(pixel, height_mm))
    }

    /// `world_from_image` in the base frame of the robot.
    ///
    /// Args:
    ///     points: float64 (N, 2), u and v in pixels, C-contiguous.
    ///     height_mm: height of what was seen over the table.
    ///
    /// Returns:
    ///     float64 (N, 3), mm.
    ///
    /// Raises:
    ///     ValueError: as `world_from_image`, and if the robot's place is not known.
    ///     TypeError: `points` is not such an array.
    #[pyo3(signature = (points, height_mm=0.0))]
    fn base_from_image<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
        height_mm: f64,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let camera = self.placed()?;
        map_points(py, PIXELS, points, |pixel| camera.base_from_image(pixel, height_mm))
    }

    /// The pixels at which points of the world are seen; they may lie outside the image.
    ///
    /// Args:
    ///     points: float64 (N, 3), mm, C-contiguous.
    ///
    /// Returns:
    ///     float64 (N, 2), pixels.
    ///
    /// Raises:
    ///     ValueError: the pose of the camera is not known; a point is not finite, not in front of the camera or outside of
    ///         the lens model: the message says which.
    ///     TypeError: `points` is not such an array.
    fn image_from_world<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let camera = self.placed()?;
        map_points(py, "a C-contiguous float64 array of shape (N, 3)", points, |point| camera.image_from_world(point))
    }

    fn __repr__(&self) -> String {
        let p = self.intrinsics.params();
        let placed = if self.placed.is_some() { "placed" } else { "without a pose" };
        format!("<samsod.Camera: {} x {} px, fx {:.1} px, {placed}>", p.width_px, p.height_px, p.fx_px)
    }
}

const PIXELS: &str = "a C-contiguous float64 array of shape (N, 2)";

impl Camera {
    fn from_parts(
        intrinsics: Intrinsics,
        world_from_camera: Option<Isometry3<f64>>,
        base_from_world: Option<Isometry3<f64>>,
    ) -> PyResult<Self> {
        let placed = world_from_camera.map(|pose| Placed::new(intrinsics, pose, base_from_world)).transpose();
        Ok(Self { intrinsics, placed: placed.map_err(value_error)?, base_from_world, map: OnceLock::new() })
    }

    pub(crate) fn placed(&self) -> PyResult<&Placed> {
        self.placed.as_ref().ok_or_else(|| PyValueError::new_err("the camera has no world_from_camera"))
    }
}

/// The exception that suits an I/O error (`FileNotFoundError`, ..); `ValueError` for what is in the file.
fn unreadable(path: &Path, error: CameraFileError) -> PyErr {
    match error {
        CameraFileError::Read { source, .. } if source.kind() != std::io::ErrorKind::InvalidData => {
            std::io::Error::new(source.kind(), format!("{}: {source}", path.display())).into()
        }
        error => value_error(error),
    }
}

/// An argument as rows of a fixed size.
fn rows<const R: usize, const C: usize>(
    name: &str,
    allowed: &str,
    argument: &Bound<'_, PyAny>,
) -> PyResult<[[f64; C]; R]> {
    let array: PyReadonlyArray2<'_, f64> = borrow(name, allowed, argument)?;
    let given = array.as_array().dim();
    if given != (R, C) {
        return Err(PyValueError::new_err(format!("{name}: expected {allowed}, got shape {given:?}")));
    }
    let view = array.as_array();
    Ok(std::array::from_fn(|row| std::array::from_fn(|column| view[(row, column)])))
}

fn pose(name: &str, argument: &Bound<'_, PyAny>) -> PyResult<Isometry3<f64>> {
    let rows = rows::<4, 4>(name, "a C-contiguous float64 array of shape (4, 4)", argument)?;
    pose_from_rows(&rows).map_err(|error| value_error(format!("{name}: {error}")))
}

/// Every row of an argument through a mapping, without the interpreter lock.
fn map_points<'py, const A: usize, const B: usize>(
    py: Python<'py>,
    allowed: &str,
    argument: &Bound<'py, PyAny>,
    mapping: impl Fn([f64; A]) -> Result<[f64; B], ProjectionError> + Sync + Send,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let array: PyReadonlyArray2<'_, f64> = borrow("points", allowed, argument)?;
    let (count, columns) = array.as_array().dim();
    if columns != A {
        return Err(PyValueError::new_err(format!("points: expected {allowed}, got shape {:?}", (count, columns))));
    }
    let (points, _) = array.as_slice().map_err(value_error)?.as_chunks::<A>();
    let mapped = run(py, || {
        let of_one = |(i, &point)| mapping(point).map_err(|error| format!("points[{i}]: {error}"));
        points.iter().enumerate().map(of_one).collect::<Result<Vec<_>, String>>()
    })?;
    table(py, &mapped)
}

fn table<'py, const C: usize>(py: Python<'py>, rows: &[[f64; C]]) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let values = rows.as_flattened().to_vec();
    Ok(Array2::from_shape_vec((rows.len(), C), values).map_err(value_error)?.into_pyarray(py))
}
