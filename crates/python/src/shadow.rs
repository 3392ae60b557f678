//! `separate_shadows` and `ObjectRegion`.

use std::sync::Arc;

use numpy::ndarray::Array2;
use numpy::{IntoPyArray, Ix1, PyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use samsod::saliency::{SaliencyMap, SalientRegion as Region};
use samsod::shadow::{self as stage, Mask, ObjectSide, ShadowParams, ShadowSeparator};

use crate::arrays::{Frame, borrow};
use crate::partition::Partition;
use crate::saliency::{SalientRegion, map_from_array};
use crate::{run, value_error};

/// Separates the objects of salient regions from their shadows.
///
/// Args:
///     rgb: uint8 (H, W, 3), C-contiguous; read in place.
///     partition: the partition of the image.
///     saliency: float32 (H, W) in [0, 1], C-contiguous.
///     regions: salient regions of that partition.
///     object_side: "evidence" (asks of every piece what tells a shadow from a dark part) or "paper" (the more salient
///         side of a normalised cut of hue histograms).
///     min_object_area_px: connected object pixels fewer than these are no object. None: from the size of the image.
///     parts: float32 (n,) in [0, 1], probabilities that the pieces of `describe_pieces` are part, instead of the
///         judgement of "evidence", which they need.
///     fringe: float32 (m,) in [0, 1], probabilities that the pixels of `describe_fringe` of these `parts` show a part,
///         instead of how outlines are settled always; one whose piece is part shows it from 0.38 on, others from 0.5.
///
/// Returns:
///     the objects, by region in the order of `regions`, and largest first within a region; a region that is all
///     shadow has none, and one whose parts only a shadow joined has several.
///
/// Raises:
///     ValueError: sizes differ, a region is of another partition or given twice, a value of `saliency` is not in
///         [0, 1], or a parameter is out of range.
///     TypeError: an argument is of another type.
#[pyfunction]
#[pyo3(signature = (rgb, partition, saliency, regions, object_side="evidence", *, min_object_area_px=None, parts=None, fringe=None))]
#[allow(clippy::too_many_arguments, reason = "they are those of the function in Python")]
pub(crate) fn separate_shadows(
    py: Python<'_>,
    rgb: &Bound<'_, PyAny>,
    partition: &Bound<'_, Partition>,
    saliency: &Bound<'_, PyAny>,
    regions: Vec<Py<SalientRegion>>,
    object_side: &str,
    min_object_area_px: Option<i64>,
    parts: Option<&Bound<'_, PyAny>>,
    fringe: Option<&Bound<'_, PyAny>>,
) -> PyResult<Vec<ObjectRegion>> {
    let Seen { partition, frame, map, salient } = Seen::read(rgb, partition, saliency, &regions)?;
    let view = frame.view()?;
    let object_side = match object_side {
        "evidence" => ObjectSide::Evidence,
        "paper" if parts.is_some() => {
            return Err(value_error("object_side = \"paper\" with parts; allowed is \"evidence\""));
        }
        "paper" => ObjectSide::Paper,
        other => return Err(value_error(format!("object_side = {other:?}; allowed are \"evidence\" and \"paper\""))),
    };
    let min_object_area_px = min_area(min_object_area_px)?;
    let mut separator = ShadowSeparator::new(ShadowParams { object_side, min_object_area_px }).map_err(value_error)?;
    let objects = match parts {
        None if fringe.is_some() => return Err(value_error("fringe without parts; it belongs to them")),
        None => run(py, || separator.separate(&view, &partition, &map, &salient))?,
        Some(parts) => {
            let parts = borrow::<f32, Ix1>("parts", PROBABILITIES, parts)?;
            let fringe = fringe.map(|fringe| borrow::<f32, Ix1>("fringe", PROBABILITIES, fringe)).transpose()?;
            let fringe = fringe.as_ref().map(|fringe| fringe.as_slice()).transpose()?;
            let parts = parts.as_slice()?;
            run(py, || separator.separate_judged(&view, &partition, &map, &salient, parts, fringe))?
        }
    };
    let size = (partition.width(), partition.height());
    Ok(objects.into_iter().map(|object| ObjectRegion::new(object, size)).collect())
}

/// What the stage sees.
struct Seen<'py> {
    partition: Arc<samsod::segment::Partition>,
    frame: Frame<'py>,
    map: SaliencyMap,
    salient: Vec<Region>,
}

impl<'py> Seen<'py> {
    fn read(
        rgb: &Bound<'py, PyAny>,
        partition: &Bound<'py, Partition>,
        saliency: &Bound<'py, PyAny>,
        regions: &[Py<SalientRegion>],
    ) -> PyResult<Self> {
        let partition = Arc::clone(&partition.get().inner);
        let frame = Frame::new(rgb)?;
        frame.must_have_size("partition", partition.width(), partition.height())?;
        let map = map_from_array(saliency, &partition)?;
        let salient = regions_of(&partition, regions)?;
        Ok(Self { partition, frame, map, salient })
    }
}

const PROBABILITIES: &str = "a C-contiguous float32 array of shape (n,)";

/// Pieces of pixels, and signs of pieces.
type Described<'py> = (Bound<'py, PyArray2<i32>>, Bound<'py, PyArray2<f32>>);

/// The pieces that `separate_shadows` judges by "evidence", and what it knows of them: to fit another judgement.
///
/// Args:
///     rgb, partition, saliency, regions: as those of `separate_shadows`.
///
/// Returns:
///     int32 (H, W), the index of the piece of every pixel, -1 where there is none; and float32 (n, `len(PIECE_SIGNS)`), the
///     signs of every piece.
///
/// Raises:
///     ValueError, TypeError: as `separate_shadows`.
#[pyfunction]
pub(crate) fn describe_pieces<'py>(
    py: Python<'py>,
    rgb: &Bound<'py, PyAny>,
    partition: &Bound<'py, Partition>,
    saliency: &Bound<'py, PyAny>,
    regions: Vec<Py<SalientRegion>>,
) -> PyResult<Described<'py>> {
    let Seen { partition, frame, map, salient } = Seen::read(rgb, partition, saliency, &regions)?;
    let view = frame.view()?;
    let mut separator = ShadowSeparator::new(ShadowParams::default()).map_err(value_error)?;
    let pieces = run(py, || separator.pieces(&view, &partition, &map, &salient))?;
    let size = (partition.height() as usize, partition.width() as usize);
    let labels = Array2::from_shape_vec(size, pieces.labels).map_err(value_error)?;
    let size = (pieces.signs.len(), stage::PIECE_SIGNS.len());
    let signs = Array2::from_shape_vec(size, pieces.signs.into_iter().flatten().collect()).map_err(value_error)?;
    Ok((labels.into_pyarray(py), signs.into_pyarray(py)))
}

/// Places of pixels, and their signs.
type DescribedFringe<'py> = (Bound<'py, PyArray2<u32>>, Bound<'py, PyArray2<f32>>);

/// The pixels at the outlines of what is judged part, and what `separate_shadows` knows of them by "evidence": to fit how
/// outlines are settled.
///
/// Args:
///     rgb, partition, saliency, regions, parts: as those of `separate_shadows`.
///
/// Returns:
///     uint32 (n, 2), the places (x, y) of the pixels, px; and float32 (n, `len(FRINGE_SIGNS)`), their signs.
///
/// Raises:
///     ValueError, TypeError: as `separate_shadows`.
#[pyfunction]
pub(crate) fn describe_fringe<'py>(
    py: Python<'py>,
    rgb: &Bound<'py, PyAny>,
    partition: &Bound<'py, Partition>,
    saliency: &Bound<'py, PyAny>,
    regions: Vec<Py<SalientRegion>>,
    parts: &Bound<'py, PyAny>,
) -> PyResult<DescribedFringe<'py>> {
    let Seen { partition, frame, map, salient } = Seen::read(rgb, partition, saliency, &regions)?;
    let view = frame.view()?;
    let parts = borrow::<f32, Ix1>("parts", PROBABILITIES, parts)?;
    let parts = parts.as_slice()?;
    let mut separator = ShadowSeparator::new(ShadowParams::default()).map_err(value_error)?;
    let fringe = run(py, || separator.fringe(&view, &partition, &map, &salient, parts))?;
    let count = fringe.signs.len();
    let places = Array2::from_shape_vec((count, 2), fringe.places.into_iter().flatten().collect());
    let size = (count, stage::FRINGE_SIGNS.len());
    let signs = Array2::from_shape_vec(size, fringe.signs.into_iter().flatten().collect());
    Ok((places.map_err(value_error)?.into_pyarray(py), signs.map_err(value_error)?.into_pyarray(py)))
}

/// Regions as the stage takes them, all of one partition.
pub(crate) fn regions_of(
    partition: &Arc<samsod::segment::Partition>,
    regions: &[Py<SalientRegion>],
) -> PyResult<Vec<Region>> {
    let region = |(i, region): (usize, &Py<SalientRegion>)| {
        let region = region.get();
        if Arc::ptr_eq(region.partition(), partition) {
            Ok(region.region().clone())
        } else {
            Err(PyValueError::new_err(format!("regions[{i}] is a region of another partition")))
        }
    };
    regions.iter().enumerate().map(region).collect()
}

/// The least area of an object as the stages take it.
pub(crate) fn min_area(px: Option<i64>) -> PyResult<Option<u32>> {
    let refused = |px: i64| format!("min_object_area_px = {px}; allowed are 1 to {}", u32::MAX);
    px.map(|px| u32::try_from(px).map_err(|_| value_error(refused(px)))).transpose()
}

/// One object: connected pixels of a salient region that are neither shadow nor table.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct ObjectRegion {
    object: stage::ObjectRegion,
    /// Width and height of the image, px.
    size: (u32, u32),
}

impl ObjectRegion {
    pub(crate) fn new(object: stage::ObjectRegion, size: (u32, u32)) -> Self {
        Self { object, size }
    }

    pub(crate) fn object(&self) -> &stage::ObjectRegion {
        &self.object
    }

    /// Width and height of the image that it lies in, px.
    pub(crate) fn size(&self) -> (u32, u32) {
        self.size
    }
}

/// A mask as an array in the size of the image (width, height); none of its pixels is set where there is no mask.
pub(crate) fn paint<'py>(py: Python<'py>, size: (u32, u32), mask: Option<&Mask>) -> Bound<'py, PyArray2<bool>> {
    let mut pixels = Array2::from_elem((size.1 as usize, size.0 as usize), false);
    for run in mask.into_iter().flat_map(Mask::runs) {
        for x in run.start..run.end {
            if let Some(pixel) = pixels.get_mut((run.y as usize, x as usize)) {
                *pixel = true;
            }
        }
    }
    pixels.into_pyarray(py)
}

/// Points (x, y) as an array (N, 2).
fn points<'py>(py: Python<'py>, points: &[[i32; 2]]) -> PyResult<Bound<'py, PyArray2<i32>>> {
    let values = points.as_flattened().to_vec();
    Ok(Array2::from_shape_vec((points.len(), 2), values).map_err(value_error)?.into_pyarray(py))
}

#[pymethods]
impl ObjectRegion {
    /// Index of its region among the salient regions.
    #[getter]
    fn region(&self) -> usize {
        self.object.region
    }

    /// Pixels of the object: bool (H, W), made anew at every access. They may lie up to 4 px outside of the region.
    #[getter]
    fn mask<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<bool>> {
        paint(py, self.size, Some(&self.object.mask))
    }

    /// Shadow pixels of the region that are nearest to this object of it: bool (H, W), made anew at every access; none
    /// set where there is no shadow.
    #[getter]
    fn shadow<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<bool>> {
        paint(py, self.size, self.object.shadow.as_ref())
    }

    /// Outer boundary: int32 (N, 2), x and y of the boundary pixels in steps to one of the eight neighbours, clockwise
    /// on the screen from the leftmost pixel of the topmost row; the last is a neighbour of the first.
    #[getter]
    fn outline<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i32>>> {
        points(py, &self.object.outline)
    }

    /// The object's pixels round each hole: arrays as `outline`, but counter-clockwise.
    #[getter]
    fn holes<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyArray2<i32>>>> {
        self.object.holes.iter().map(|hole| points(py, hole)).collect()
    }

    /// Centre of area (x, y) in pixels, pixel centres at integers.
    #[getter]
    fn centroid(&self) -> (f32, f32) {
        self.object.centroid.into()
    }

    /// The smallest rectangle round the object: centre x, centre y, length, width in pixels, and the direction of the
    /// longer side in degrees in (-90, 90], counter-clockwise on the screen from image right. Pixels count as squares.
    #[getter(r#box)]
    fn oriented_box(&self) -> (f32, f32, f32, f32, f32) {
        let b = &self.object.oriented_box;
        (b.center_px[0], b.center_px[1], b.length_px, b.width_px, b.angle_rad.to_degrees())
    }

    /// Bounding box (x, y, width, height) in pixels.
    #[getter]
    fn bbox(&self) -> (u32, u32, u32, u32) {
        let b = self.object.mask.bbox();
        (b.x, b.y, b.width, b.height)
    }

    /// Number of pixels.
    #[getter]
    fn area(&self) -> u32 {
        self.object.area
    }

    /// Direction of the longest axis in degrees, in (-90, 90], counter-clockwise on the screen from image right; 0
    /// where no axis is longest.
    #[getter]
    fn axis_deg(&self) -> f32 {
        self.object.axis_rad.to_degrees()
    }

    fn __repr__(&self) -> String {
        let [x, y] = self.object.centroid;
        format!("<samsod.ObjectRegion: {} px at ({x:.1}, {y:.1})>", self.object.area)
    }
}
