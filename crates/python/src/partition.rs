//! `segment` and `Partition`.

use std::sync::Arc;

use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray1, PyArray2};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use samsod::segment::{Partition as Objects, ProtoObject, SegmentParams, Segmenter};

use crate::arrays::{Frame, borrow, lend};
use crate::{run, value_error};

/// A decomposition of an image into N disjoint proto-objects that cover it.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Partition {
    pub(crate) inner: Arc<Objects>,
}

impl Partition {
    pub(crate) fn new(partition: Objects) -> Self {
        Self { inner: Arc::new(partition) }
    }

    /// One row an object.
    fn table<'py, T: numpy::Element, const C: usize>(
        &self,
        py: Python<'py>,
        row: impl Fn(&ProtoObject) -> [T; C],
    ) -> PyResult<Bound<'py, PyArray2<T>>> {
        let values: Vec<T> = self.inner.objects().iter().flat_map(row).collect();
        Ok(Array2::from_shape_vec((self.inner.len(), C), values).map_err(value_error)?.into_pyarray(py))
    }
}

#[pymethods]
impl Partition {
    /// Builds a partition from a label image.
    ///
    /// Args:
    ///     rgb: uint8 (H, W, 3), C-contiguous.
    ///     labels: uint32 (H, W), C-contiguous; dense: every value in 0..N occurs. Copied.
    ///
    /// Raises:
    ///     ValueError: sizes differ or a label is missing.
    ///     TypeError: an argument is not such an array.
    #[staticmethod]
    fn from_labels(py: Python<'_>, rgb: &Bound<'_, PyAny>, labels: &Bound<'_, PyAny>) -> PyResult<Self> {
        let frame = Frame::new(rgb)?;
        let view = frame.view()?;
        let labels = borrow::<u32, numpy::Ix2>("labels", "a C-contiguous uint32 array of shape (H, W)", labels)?;
        let array = labels.as_array();
        let (rows, columns) = array.dim();
        if (columns, rows) != (view.width() as usize, view.height() as usize) {
            return Err(PyValueError::new_err(format!(
                "labels have {columns} x {rows} pixels and rgb {} x {}; both must have the same size",
                view.width(),
                view.height()
            )));
        }
        let labels = labels.as_slice().map_err(value_error)?.to_vec();
        run(py, || Objects::from_labels(&view, labels)).map(Self::new)
    }

    /// Width of the image in pixels.
    #[getter]
    fn width(&self) -> u32 {
        self.inner.width()
    }

    /// Height of the image in pixels.
    #[getter]
    fn height(&self) -> u32 {
        self.inner.height()
    }

    /// Number of partitions N.
    fn __len__(&self) -> usize {
        self.inner.len()
    }

    fn __repr__(&self) -> String {
        format!("<samsod.Partition: {} partitions of {} x {} px>", self.inner.len(), self.width(), self.height())
    }

    /// Partition of every pixel: uint32 (H, W), dense from 0. Read-only, shares memory with the partition.
    #[getter]
    fn labels<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray2<u32>>> {
        let inner = &slf.get().inner;
        lend(slf.clone().into_any(), inner.width(), inner.height(), inner.labels())
    }

    /// Number of pixels of each partition: int64 (N,).
    #[getter]
    fn areas<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        self.inner.objects().iter().map(|o| i64::from(o.area)).collect::<Vec<_>>().into_pyarray(py)
    }

    /// Mean colour of each partition: float32 (N, 3), RGB in 0..255.
    #[getter]
    fn means<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        self.table(py, |o| o.mean)
    }

    /// Bounding box of each partition: int64 (N, 4), x, y, width, height in pixels.
    #[getter]
    fn boxes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i64>>> {
        self.table(py, |o| [o.bbox.x, o.bbox.y, o.bbox.width, o.bbox.height].map(i64::from))
    }

    /// Centre of area of each partition: float32 (N, 2), x and y in pixels, pixel centres at integers.
    #[getter]
    fn centroids<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        self.table(py, |o| o.centroid)
    }

    /// Labels of the partitions that share a pixel edge with partition `label`, ascending: uint32 (K,).
    ///
    /// Raises:
    ///     IndexError: there is no partition `label`.
    fn neighbours<'py>(&self, py: Python<'py>, label: i64) -> PyResult<Bound<'py, PyArray1<u32>>> {
        let known = u32::try_from(label).ok().filter(|&l| (l as usize) < self.inner.len());
        let Some(known) = known else {
            let n = self.inner.len();
            return Err(PyIndexError::new_err(format!("no partition {label}; there are {n}, from 0")));
        };
        Ok(self.inner.neighbours(known).to_vec().into_pyarray(py))
    }
}

/// Segments an image into proto-objects by mean shift in the joint spatial-range domain.
///
/// Args:
///     rgb: uint8 (H, W, 3), C-contiguous; read in place.
///     preset: "cell" (the default) or "photo": what the parameters below are where they are None. A photo has no table
///         whose texture could be measured: range bandwidth 16, texture gain 0, penumbra light 1, and 40 pixels of an
///         image of 256 as the minimum area.
///     spatial_bandwidth_px: radius of the flat kernel in the image plane, pixels. None: from the size of the image.
///     range_bandwidth: radius of the flat kernel in colour, levels of 255.
///     min_area_px: partitions with fewer pixels are joined to a neighbour. None: from the spatial bandwidth.
///     texture_gain: how much noise and texture of the table widen the range bandwidth, in standard deviations of
///         the colour within small blocks; 0 keeps it the same everywhere.
///     penumbra_light: where a shadow fades out, the share of its light, 0.5 to 1, from which on the table is table;
///         1 leaves every penumbra where the mean shift puts it.
///
/// Returns:
///     the partition; its labels are dense and each is 4-connected.
///
/// Raises:
///     ValueError: an image without pixels, one that is not contiguous, or a parameter out of range.
///     TypeError: `rgb` is not such an array.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "keyword arguments of a Python function")]
#[pyo3(signature = (
    rgb, *, preset="cell", spatial_bandwidth_px=None, range_bandwidth=None, min_area_px=None, texture_gain=None,
    penumbra_light=None
))]
pub(crate) fn segment(
    py: Python<'_>,
    rgb: &Bound<'_, PyAny>,
    preset: &str,
    spatial_bandwidth_px: Option<f32>,
    range_bandwidth: Option<f32>,
    min_area_px: Option<i64>,
    texture_gain: Option<f32>,
    penumbra_light: Option<f32>,
) -> PyResult<Partition> {
    let frame = Frame::new(rgb)?;
    let view = frame.view()?;
    let mut params = match preset {
        "cell" => SegmentParams::default(),
        "photo" => SegmentParams::photo(view.width(), view.height()),
        other => return Err(value_error(format!("preset = {other:?}; allowed are \"cell\" and \"photo\""))),
    };
    if let Some(px) = spatial_bandwidth_px {
        params.spatial_bandwidth_px = Some(px);
    }
    if let Some(levels) = range_bandwidth {
        params.range_bandwidth = levels;
    }
    if let Some(px) = min_area_px {
        let allowed = || PyValueError::new_err(format!("min_area_px = {px}; allowed are 0 to {}", u32::MAX));
        params.min_area_px = Some(u32::try_from(px).map_err(|_| allowed())?);
    }
    if let Some(gain) = texture_gain {
        params.texture_gain = gain;
    }
    if let Some(light) = penumbra_light {
        params.penumbra_light = light;
    }
    let mut segmenter = Segmenter::new(params).map_err(value_error)?;
    run(py, || segmenter.segment(&view)).map(Partition::new)
}
