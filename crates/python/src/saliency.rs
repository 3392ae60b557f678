//! `saliency`, `salient_regions` and `SalientRegion`.

use std::sync::Arc;

use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray2};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyString};
use samsod::saliency::{self as stage, Method, Saliency, SaliencyMap, SaliencyParams, Scales, Threshold, Variant};
use samsod::segment::{Partition as Objects, SegmentParams, Segmenter};

use crate::arrays::{Frame, borrow, same_size, side};
use crate::cell::map_to_array;
use crate::partition::Partition;
use crate::{run, value_error};

/// Saliency of an image.
///
/// Args:
///     rgb: uint8 (H, W, 3), C-contiguous. With a partition only its size is used: the colours that count are the
///         partitions' means.
///     partition: its partition; None makes that of a still photo, `segment(rgb, preset="photo")`.
///     method: of "paper" and "averaged": "fast" (interpolated from coarse nodes) or "exact" (every pixel by itself; the
///         reference). None: "fast".
///     center: of the same: standard deviations of the centre Gaussians in pixels of the image.
///     surround: those of the surround Gaussians; each must be larger than every centre. Without both, the generic
///         scales {3, 5, 7} and {19, 23, 29} for a longer side of 256 px, scaled with the image.
///     variant: "background" (what is cut off from the border of the image and unlike it; S = 0.5 is the bound between
///         background and objects), "centred" (the same with a preference for the centre), "paper" (centre-surround
///         contrast, as in a cell) or "averaged" (the mean of that over every partition). None: "background", which is
///         better on still photos, or "paper" where method, center or surround is given.
///
/// Returns:
///     float32 (H, W) in [0, 1]; 0 everywhere on an image of one colour.
///
/// Raises:
///     ValueError: a parameter is out of range or not one of the variant, only one of center and surround is given, or
///         sizes differ.
///     TypeError: `rgb` is not such an array.
#[pyfunction]
#[pyo3(signature = (rgb, partition=None, method=None, center=None, surround=None, *, variant=None))]
pub(crate) fn saliency(
    py: Python<'_>,
    rgb: &Bound<'_, PyAny>,
    partition: Option<&Bound<'_, Partition>>,
    method: Option<&str>,
    center: Option<Vec<f32>>,
    surround: Option<Vec<f32>>,
    variant: Option<&str>,
) -> PyResult<Py<PyArray2<f32>>> {
    let frame = Frame::new(rgb)?;
    let variant = match variant {
        Some(name) => parse_variant(name)?,
        None if method.is_some() || center.is_some() || surround.is_some() => Variant::Paper,
        None => Variant::Background,
    };
    if let (Some(method), false) = (method, variant.has_scales()) {
        let name = variant.name();
        return Err(value_error(format!("method = {method:?}: variant {name:?} has one way, so none is to be given")));
    }
    let method = match method {
        None | Some("fast") => Method::Fast,
        Some("exact") => Method::Exact,
        Some(other) => return Err(value_error(format!("method = {other:?}; allowed are \"fast\" and \"exact\""))),
    };
    let scales = match (center, surround) {
        (None, None) => Scales::Generic,
        (Some(center), Some(surround)) => Scales::Pixels { center_px: center, surround_px: surround },
        _ => return Err(PyValueError::new_err("center and surround must be given together, or neither")),
    };
    let mut method = Saliency::new(SaliencyParams { variant, method, scales }).map_err(value_error)?;
    let partition = match partition {
        Some(partition) => {
            let partition = Arc::clone(&partition.get().inner);
            frame.must_have_size("partition", partition.width(), partition.height())?;
            partition
        }
        None => {
            let view = frame.view()?;
            let params = SegmentParams::photo(view.width(), view.height());
            let mut segmenter = Segmenter::new(params).map_err(value_error)?;
            Arc::new(run(py, || segmenter.segment(&view))?)
        }
    };
    let map = run(py, || method.compute(&partition))?;
    map_to_array(py, &map)
}

fn parse_variant(name: &str) -> PyResult<Variant> {
    Variant::ALL.into_iter().find(|variant| variant.name() == name).ok_or_else(|| {
        let names = Variant::ALL.map(|variant| format!("{:?}", variant.name())).join(", ");
        value_error(format!("variant = {name:?}; allowed are {names}"))
    })
}

/// The connected salient regions of an image, largest first.
///
/// Args:
///     saliency: float32 (H, W) in [0, 1], C-contiguous.
///     partition: the partition of the same image; regions are made of whole partitions.
///     threshold: "positive" (S > 0 made robust: just above the noise of the background), "adaptive" (twice the
///         mean of S) or a number in [0, 1]; a partition is salient when its mean saliency exceeds it. None, the
///         default, means "positive".
///
/// Raises:
///     ValueError: sizes differ, a value of `saliency` is not in [0, 1], or the threshold is not one of the above.
///     TypeError: `saliency` is not such an array.
#[pyfunction]
#[pyo3(signature = (saliency, partition, threshold=None))]
pub(crate) fn salient_regions(
    py: Python<'_>,
    saliency: &Bound<'_, PyAny>,
    partition: &Bound<'_, Partition>,
    threshold: Option<&Bound<'_, PyAny>>,
) -> PyResult<Vec<SalientRegion>> {
    let partition = Arc::clone(&partition.get().inner);
    let threshold = threshold.map(parse_threshold).transpose()?.unwrap_or_default();
    let map = map_from_array(saliency, &partition)?;
    let regions = run(py, || stage::salient_regions(&map, &partition, threshold))?;
    Ok(regions.into_iter().map(|region| SalientRegion::new(region, Arc::clone(&partition))).collect())
}

/// A saliency map of the size of a partition.
pub(crate) fn map_from_array(argument: &Bound<'_, PyAny>, partition: &Objects) -> PyResult<SaliencyMap> {
    let array =
        borrow::<f32, numpy::Ix2>("saliency", "a C-contiguous float32 array of shape (H, W) in [0, 1]", argument)?;
    let (rows, columns) = array.as_array().dim();
    let size = side(columns).zip(side(rows)).ok_or_else(|| value_error("saliency: too large"))?;
    same_size("saliency", size, "partition", (partition.width(), partition.height()))?;
    let values = array.as_slice().map_err(value_error)?.to_vec();
    SaliencyMap::from_values(size.0, size.1, values).map_err(value_error)
}

fn parse_threshold(argument: &Bound<'_, PyAny>) -> PyResult<Threshold> {
    const ALLOWED: &str = "allowed are \"positive\", \"adaptive\" and a number in [0, 1]";
    if let Ok(name) = argument.cast::<PyString>() {
        return match name.to_cow()?.as_ref() {
            "positive" => Ok(Threshold::Positive),
            "adaptive" => Ok(Threshold::Adaptive),
            other => Err(value_error(format!("threshold = {other:?}; {ALLOWED}"))),
        };
    }
    match argument.extract::<f32>() {
        Ok(value) if !argument.is_instance_of::<PyBool>() => Ok(Threshold::Value(value)),
        _ => Err(PyTypeError::new_err(format!("threshold: {ALLOWED}, got {}", argument.get_type()))),
    }
}

/// One connected salient region: partitions that touch and are all salient.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct SalientRegion {
    region: stage::SalientRegion,
    partition: Arc<Objects>,
}

impl SalientRegion {
    pub(crate) fn new(region: stage::SalientRegion, partition: Arc<Objects>) -> Self {
        Self { region, partition }
    }

    pub(crate) fn region(&self) -> &stage::SalientRegion {
        &self.region
    }

    /// The partition that it is a region of.
    pub(crate) fn partition(&self) -> &Arc<Objects> {
        &self.partition
    }
}

#[pymethods]
impl SalientRegion {
    /// Pixels of the region: bool (H, W), made anew at every access.
    #[getter]
    fn mask<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        let mask = self.region.mask(&self.partition);
        let shape = (mask.height() as usize, mask.width() as usize);
        let inside: Vec<bool> = mask.as_raw().iter().map(|&value| value > 0).collect();
        Ok(Array2::from_shape_vec(shape, inside).map_err(value_error)?.into_pyarray(py))
    }

    /// Centre of area (x, y) in pixels, pixel centres at integers.
    #[getter]
    fn centroid(&self) -> (f32, f32) {
        self.region.centroid.into()
    }

    /// Bounding box (x, y, width, height) in pixels.
    #[getter]
    fn bbox(&self) -> (u32, u32, u32, u32) {
        let b = self.region.bbox;
        (b.x, b.y, b.width, b.height)
    }

    /// Number of pixels.
    #[getter]
    fn area(&self) -> u32 {
        self.region.area
    }

    /// Labels of its partitions, ascending.
    #[getter]
    fn partitions(&self) -> Vec<u32> {
        self.region.partitions.clone()
    }

    /// Mean saliency over the region, in [0, 1].
    #[getter]
    fn mean_saliency(&self) -> f32 {
        self.region.mean_saliency
    }

    /// Direction of the longest axis in degrees, in (-90, 90], counter-clockwise on the screen from image right; 0
    /// where no axis is longest.
    #[getter]
    fn axis_deg(&self) -> f32 {
        self.region.axis_rad.to_degrees()
    }

    fn __repr__(&self) -> String {
        let [x, y] = self.region.centroid;
        format!("<samsod.SalientRegion: {} px at ({x:.1}, {y:.1})>", self.region.area)
    }
}
