//! `Recognizer` and `Detection`.

use std::sync::Arc;

use numpy::PyArray2;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use samsod::recognize::{self as stage, Method, RecognizeError, RecognizeParams};
use samsod::segment::RgbView;
use samsod::shadow::{ShadowParams, bare_regions};

use crate::arrays::Frame;
use crate::camera::Camera;
use crate::catalogue::Catalogue;
use crate::partition::Partition;
use crate::saliency::SalientRegion;
use crate::shadow::{ObjectRegion, min_area, paint, regions_of};
use crate::{config, run, value_error};

/// Recognises the parts of a catalogue among objects. Threads may share one: they do not wait for each other.
///
/// Args:
///     catalogue: the parts.
///     method: "sift" (local features: parts with lettering or other texture), "shape" (outlines) or "best" (shape for
///         every part, and SIFT where the texture tells more).
///     camera: the camera of all frames for which no other is given, with its pose over the table. None: frames are
///         taken for those of the camera that the parts were taught with, and detections have no place in the world.
///     **params: those of the section [recognize] of a configuration: min_score and min_margin in [0, 1], and mappings
///         such as sift={"ratio": 1.5}.
///
/// Raises:
///     ValueError: a parameter is out of range or not known, the catalogue has no part, or the camera no pose.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Recognizer {
    params: RecognizeParams,
    catalogue: Py<Catalogue>,
    camera: Option<Py<Camera>>,
    inner: stage::Recognizer,
}

type Detections = Vec<stage::Detection>;

#[pymethods]
impl Recognizer {
    #[new]
    #[pyo3(signature = (catalogue, method="best", camera=None, **params))]
    fn new(
        py: Python<'_>,
        catalogue: Py<Catalogue>,
        method: &str,
        camera: Option<Py<Camera>>,
        params: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let params = config::recognition(method, params)?;
        if let Some(camera) = &camera {
            camera.get().placed()?;
        }
        // A catalogue that is used for the first time takes a while.
        let inner = run(py, || stage::Recognizer::new(catalogue.get().parts().clone(), params.clone()))?;
        Ok(Self { params, catalogue, camera, inner })
    }

    /// The catalogue.
    #[getter]
    fn catalogue(&self, py: Python<'_>) -> Py<Catalogue> {
        self.catalogue.clone_ref(py)
    }

    /// The parameters in force, as a dict: the arguments but for the catalogue and the camera.
    #[getter]
    fn params<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        config::to_dict(py, &self.params)
    }

    /// Says of every object which part it is, at which pose.
    ///
    /// Args:
    ///     rgb: the frame that the objects were found in: uint8 (H, W, 3), C-contiguous; read in place.
    ///     objects: its objects.
    ///     camera: the camera of the frame. None: that of the recogniser.
    ///     partition, regions: the partition of the frame and its salient regions. Where both are given, regions without an
    ///         object are searched, too: a part may be taken for shadow as a whole.
    ///
    /// Returns:
    ///     one detection for each part and for each unknown object.
    ///
    /// Raises:
    ///     ValueError: objects or regions are of a frame of another size or partition, the camera has another size or no pose.
    ///     TypeError: `rgb` is not such an array.
    #[pyo3(signature = (rgb, objects, camera=None, *, partition=None, regions=None))]
    fn recognize(
        &self,
        py: Python<'_>,
        rgb: &Bound<'_, PyAny>,
        objects: Vec<Py<ObjectRegion>>,
        camera: Option<&Bound<'_, Camera>>,
        partition: Option<&Bound<'_, Partition>>,
        regions: Option<Vec<Py<SalientRegion>>>,
    ) -> PyResult<Vec<Detection>> {
        let frame = Frame::new(rgb)?;
        let mut found = Vec::with_capacity(objects.len());
        for (i, object) in objects.iter().enumerate() {
            let (width, height) = object.get().size();
            frame.must_have_size(&format!("the frame of objects[{i}]"), width, height)?;
            found.push(object.get().object().clone());
        }
        let bare = match partition.zip(regions) {
            None => Vec::new(),
            Some((partition, regions)) => {
                let partition = Arc::clone(&partition.get().inner);
                frame.must_have_size("partition", partition.width(), partition.height())?;
                bare_regions(&partition, &regions_of(&partition, &regions)?, &found)
            }
        };
        self.search(py, &frame, camera, |stage, view, camera| stage.recognize_all(view, &found, &bare, camera))
    }

    /// The conventional method that the paper compares with: features of the whole frame against every template,
    /// without salient regions.
    ///
    /// Args:
    ///     rgb: uint8 (H, W, 3), C-contiguous; read in place.
    ///     camera: the camera of the frame. None: that of the recogniser.
    ///
    /// Raises:
    ///     ValueError: the camera has another size or no pose.
    ///     TypeError: `rgb` is not such an array.
    #[pyo3(signature = (rgb, camera=None))]
    fn conventional_sift(
        &self,
        py: Python<'_>,
        rgb: &Bound<'_, PyAny>,
        camera: Option<&Bound<'_, Camera>>,
    ) -> PyResult<Vec<Detection>> {
        self.search(py, &Frame::new(rgb)?, camera, stage::Recognizer::conventional_sift)
    }

    /// The conventional method that the paper compares with: edges of the whole frame against every template, without
    /// salient regions. Slow.
    ///
    /// Args:
    ///     rgb: uint8 (H, W, 3), C-contiguous; read in place.
    ///     camera: the camera of the frame. None: that of the recogniser.
    ///
    /// Raises:
    ///     ValueError: the camera has another size or no pose.
    ///     TypeError: `rgb` is not such an array.
    #[pyo3(signature = (rgb, camera=None))]
    fn conventional_shape(
        &self,
        py: Python<'_>,
        rgb: &Bound<'_, PyAny>,
        camera: Option<&Bound<'_, Camera>>,
    ) -> PyResult<Vec<Detection>> {
        self.search(py, &Frame::new(rgb)?, camera, stage::Recognizer::conventional_shape)
    }

    fn __repr__(&self) -> String {
        format!(
            "<samsod.Recognizer: {}, {} parts>",
            name(self.params.method),
            self.catalogue.get().parts().parts().len()
        )
    }
}

impl Recognizer {
    /// Runs one of the searches on a frame, without the interpreter lock.
    fn search(
        &self,
        py: Python<'_>,
        frame: &Frame<'_>,
        camera: Option<&Bound<'_, Camera>>,
        search: impl FnOnce(
            &stage::Recognizer,
            &RgbView<'_>,
            Option<&samsod_camera::Camera>,
        ) -> Result<Detections, RecognizeError>
        + Send,
    ) -> PyResult<Vec<Detection>> {
        let view = frame.view()?;
        let camera = camera.map(Bound::get).or(self.camera.as_ref().map(Py::get)).map(Camera::placed).transpose()?;
        let detections = run(py, || search(&self.inner, &view, camera))?;
        let size = (view.width(), view.height());
        Ok(detections.into_iter().map(|detection| Detection::new(detection, size)).collect())
    }
}

/// The method as it is written in a configuration.
fn name(method: Method) -> &'static str {
    match method {
        Method::Sift => "sift",
        Method::Shape => "shape",
        Method::Best => "best",
    }
}

/// Settles the objects of a frame by what was recognised among them: a recognised part is one object with the pixels that
/// its pose gives it, whatever the separation of shadows made of them, and what it leaves of other objects stays one.
///
/// Args:
///     objects: the objects of one frame.
///     detections: what `Recognizer.recognize` says of them.
///     min_object_area_px: connected pixels fewer than these are no object, unless they are a recognised part. None: from
///         the size of the image.
///
/// Returns:
///     the objects after that, by region and largest first within one, and the detections, whose indices are theirs.
///
/// Raises:
///     ValueError: objects and detections are of images of different sizes, a detection covers an object that is not
///         there, or the least area is out of range.
#[pyfunction]
#[pyo3(signature = (objects, detections, *, min_object_area_px=None))]
pub(crate) fn settle_objects(
    py: Python<'_>,
    objects: Vec<Py<ObjectRegion>>,
    detections: Vec<Py<Detection>>,
    min_object_area_px: Option<i64>,
) -> PyResult<(Vec<ObjectRegion>, Vec<Detection>)> {
    let params = ShadowParams { min_object_area_px: min_area(min_object_area_px)?, ..ShadowParams::default() };
    params.check().map_err(value_error)?;
    let sizes = objects.iter().map(|object| object.get().size()).chain(detections.iter().map(|d| d.get().size));
    let mut sizes = sizes.collect::<Vec<_>>();
    sizes.dedup();
    let (width, height) = match sizes[..] {
        [] => return Ok((Vec::new(), Vec::new())),
        [size] => size,
        [first, other, ..] => {
            let message = format!("objects and detections of images of {first:?} and {other:?} px");
            return Err(PyValueError::new_err(message));
        }
    };
    let before: Vec<_> = objects.iter().map(|object| object.get().object().clone()).collect();
    let mut found: Vec<_> = detections.iter().map(|detection| detection.get().detection.clone()).collect();
    for (i, detection) in found.iter().enumerate() {
        if let Some(index) = detection.objects.iter().find(|index| **index >= before.len()) {
            let message = format!("detections[{i}] covers object {index}; there are {}, from 0", before.len());
            return Err(PyValueError::new_err(message));
        }
    }
    let min_area_px = params.min_object_area_for(width, height);
    let settled = run(py, || Ok::<_, RecognizeError>(stage::settle(&before, &mut found, min_area_px)))?;
    let objects = settled.into_iter().map(|object| ObjectRegion::new(object, (width, height))).collect();
    Ok((objects, found.into_iter().map(|detection| Detection::new(detection, (width, height))).collect()))
}

/// One object, recognised or not.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Detection {
    detection: stage::Detection,
    /// Width and height of the image, px.
    size: (u32, u32),
}

impl Detection {
    pub(crate) fn new(detection: stage::Detection, size: (u32, u32)) -> Self {
        Self { detection, size }
    }
}

#[pymethods]
impl Detection {
    /// Name of the part in the catalogue; None is an unknown object.
    #[getter]
    fn name(&self) -> Option<&str> {
        self.detection.name.as_deref()
    }

    /// How well it fits, in [0, 1]; of an unknown object that of the part that came closest.
    #[getter]
    fn score(&self) -> f32 {
        self.detection.score
    }

    /// Score less that of the next best part of another name, 0 without any, in [0, 1].
    #[getter]
    fn margin(&self) -> f32 {
        self.detection.margin
    }

    /// What told its pose: "sift" where features did, or features or lettering its turn; else "shape".
    #[getter]
    fn method(&self) -> &'static str {
        name(self.detection.method)
    }

    /// World x of the part's origin in mm; None of an unknown object, and without a camera.
    #[getter]
    fn x_mm(&self) -> Option<f64> {
        self.detection.world.map(|world| world.x_mm)
    }

    /// World y of the part's origin in mm; None of an unknown object, and without a camera.
    #[getter]
    fn y_mm(&self) -> Option<f64> {
        self.detection.world.map(|world| world.y_mm)
    }

    /// Rotation about world z in degrees, in (-180, 180], counter-clockwise seen from above; of a part of n-fold
    /// symmetry one of n values that are the same. None of an unknown object, and without a camera.
    #[getter]
    fn yaw_deg(&self) -> Option<f64> {
        self.detection.world.map(|world| world.yaw_rad.to_degrees())
    }

    /// Height of the part over the table in mm; None of an unknown object, and without a camera.
    #[getter]
    fn height_mm(&self) -> Option<f64> {
        self.detection.world.map(|world| world.height_mm)
    }

    /// Pixel (x, y) at which the part's origin is seen at the height of the part; of an unknown object the centroid of
    /// its mask. Pixel centres are at integers.
    #[getter]
    fn origin_px(&self) -> (f64, f64) {
        self.detection.image.origin_px.into()
    }

    /// Direction of the part's x axis in the image in degrees, in (-180, 180], counter-clockwise on the screen from image
    /// right; of an unknown object that of the longest axis of its mask.
    #[getter]
    fn angle_deg(&self) -> f64 {
        self.detection.image.angle_rad.to_degrees()
    }

    /// Pixels of the part as its pose explains them, of an unknown object those of its object region: bool (H, W), made
    /// anew at every access.
    #[getter]
    fn mask<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<bool>> {
        paint(py, self.size, Some(&self.detection.mask))
    }

    /// Index of its region among the salient regions; 0 of a conventional search.
    #[getter]
    fn region(&self) -> usize {
        self.detection.region
    }

    /// Indices of the objects that it covers, ascending; none of a conventional search.
    #[getter]
    fn objects(&self) -> Vec<usize> {
        self.detection.objects.clone()
    }

    fn __repr__(&self) -> String {
        let [x, y] = self.detection.image.origin_px;
        let name = self.detection.name.as_deref().unwrap_or("unknown");
        format!("<samsod.Detection: {name}, score {:.2}, at ({x:.1}, {y:.1})>", self.detection.score)
    }
}
