//! `Cell` and `Scene`: the whole chain on one frame.

use std::sync::{Arc, Mutex};

use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::Frame;
use crate::camera::Camera;
use crate::catalogue::Catalogue;
use crate::partition::Partition;
use crate::recognizer::Detection;
use crate::saliency::SalientRegion;
use crate::shadow::ObjectRegion;
use crate::{config, run, value_error};

/// The vision chain of one robot cell; keeps the scratch memory of its stages from frame to frame.
///
/// Args:
///     config: the path of a TOML file as samsodd takes it, a mapping with the same content, or None for the
///         defaults. Used are the sections segment, saliency, regions, shadow and recognize; those of the daemon (cell,
///         frames, camera, view, catalogue, robot, recording, log) are passed over, and any other is an error.
///     catalogue: the parts that its objects may be. None: it finds objects and does not name them.
///     camera: the camera of all frames for which `inspect` is given none, with its pose over the table. None: it is not
///         known, and detections have no place in the world.
///
/// Raises:
///     ValueError: a parameter is out of range or not known, the file is no TOML, the catalogue has no part, or the
///         camera no pose.
///     OSError: the file cannot be read.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Cell {
    params: samsod::CellParams,
    catalogue: Option<Py<Catalogue>>,
    camera: Option<Py<Camera>>,
    inner: Mutex<samsod::Cell>,
}

/// A cell, of which only a catalogue makes one that names its objects.
fn make(params: &samsod::CellParams, catalogue: Option<&Catalogue>) -> Result<samsod::Cell, samsod::CellError> {
    match catalogue {
        Some(catalogue) => samsod::Cell::with_catalogue(params.clone(), catalogue.parts().clone()),
        None => samsod::Cell::new(params.clone()),
    }
}

#[pymethods]
impl Cell {
    #[new]
    #[pyo3(signature = (config=None, catalogue=None, camera=None))]
    fn new(
        py: Python<'_>,
        config: Option<&Bound<'_, PyAny>>,
        catalogue: Option<Py<Catalogue>>,
        camera: Option<Py<Camera>>,
    ) -> PyResult<Self> {
        let params = config::params(config)?;
        if let Some(camera) = &camera {
            camera.get().placed()?;
        }
        // A catalogue that is used for the first time takes a while.
        let inner = run(py, || make(&params, catalogue.as_ref().map(Py::get)))?;
        Ok(Self { params, catalogue, camera, inner: Mutex::new(inner) })
    }

    /// The parameters in force, as a dict that `Cell` takes. Parameters that follow from the size of the frame are
    /// absent.
    #[getter]
    fn params<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        config::to_dict(py, &self.params)
    }

    /// The catalogue; None of a cell without one.
    #[getter]
    fn catalogue(&self, py: Python<'_>) -> Option<Py<Catalogue>> {
        self.catalogue.as_ref().map(|catalogue| catalogue.clone_ref(py))
    }

    /// The camera of frames for which `inspect` is given none, or None.
    #[getter]
    fn camera(&self, py: Python<'_>) -> Option<Py<Camera>> {
        self.camera.as_ref().map(|camera| camera.clone_ref(py))
    }

    /// Runs the chain on one frame. Calls from several threads wait for each other.
    ///
    /// Args:
    ///     rgb: uint8 (H, W, 3), C-contiguous; read in place.
    ///     camera: the camera of this frame, with its pose over the table. None: that of the cell. A cell without a
    ///         catalogue has no use for it.
    ///
    /// Raises:
    ///     ValueError: a frame without pixels, too large, or not contiguous; a camera without a pose, or, in a cell with a
    ///         catalogue, of another size than the frame.
    ///     TypeError: `rgb` is not such an array.
    #[pyo3(signature = (rgb, camera=None))]
    fn inspect(&self, py: Python<'_>, rgb: &Bound<'_, PyAny>, camera: Option<&Bound<'_, Camera>>) -> PyResult<Scene> {
        let frame = Frame::new(rgb)?;
        let view = frame.view()?;
        let camera = camera.map(Bound::get).or(self.camera.as_ref().map(Py::get)).map(Camera::placed).transpose()?;
        let scene = run(py, || {
            let mut cell = match self.inner.lock() {
                Ok(cell) => cell,
                Err(poisoned) => {
                    // A panic left the scratch memory half written: start with fresh memory.
                    let mut cell = poisoned.into_inner();
                    *cell = make(&self.params, self.catalogue.as_ref().map(Py::get))?;
                    self.inner.clear_poison();
                    cell
                }
            };
            cell.set_camera(camera.cloned());
            cell.inspect(&view)
        })?;
        Scene::new(py, scene)
    }
}

/// What one frame showed.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Scene {
    /// The partition of the frame.
    #[pyo3(get)]
    partition: Py<Partition>,
    /// Saliency of every pixel: float32 (H, W) in [0, 1].
    #[pyo3(get)]
    saliency: Py<PyArray2<f32>>,
    regions: Vec<Py<SalientRegion>>,
    objects: Vec<Py<ObjectRegion>>,
    detections: Vec<Py<Detection>>,
    timings_ms: Vec<(&'static str, f64)>,
}

impl Scene {
    fn new(py: Python<'_>, scene: samsod::Scene) -> PyResult<Self> {
        let partition = Arc::new(scene.partition);
        let timings_ms = scene.times.stages().map(|(stage, time)| (stage, time.as_secs_f64() * 1e3)).to_vec();
        let regions =
            scene.regions.into_iter().map(|region| Py::new(py, SalientRegion::new(region, Arc::clone(&partition))));
        let regions = regions.collect::<PyResult<Vec<_>>>()?;
        let size = (partition.width(), partition.height());
        let objects = scene.objects.into_iter().map(|object| Py::new(py, ObjectRegion::new(object, size)));
        let objects = objects.collect::<PyResult<Vec<_>>>()?;
        let detections = scene.detections.into_iter().map(|detection| Py::new(py, Detection::new(detection, size)));
        let detections = detections.collect::<PyResult<Vec<_>>>()?;
        let saliency = map_to_array(py, &scene.saliency)?;
        let partition = Py::new(py, Partition { inner: partition })?;
        Ok(Self { partition, saliency, regions, objects, detections, timings_ms })
    }
}

#[pymethods]
impl Scene {
    /// The salient regions, largest first.
    #[getter]
    fn regions(&self, py: Python<'_>) -> Vec<Py<SalientRegion>> {
        self.regions.iter().map(|region| region.clone_ref(py)).collect()
    }

    /// The objects without their shadows: by region, in the order of `regions`, and largest first within a region.
    #[getter]
    fn objects(&self, py: Python<'_>) -> Vec<Py<ObjectRegion>> {
        self.objects.iter().map(|object| object.clone_ref(py)).collect()
    }

    /// What the objects are; empty in a cell without a catalogue.
    #[getter]
    fn detections(&self, py: Python<'_>) -> Vec<Py<Detection>> {
        self.detections.iter().map(|detection| detection.clone_ref(py)).collect()
    }

    /// Wall-clock milliseconds of each stage, in their order.
    #[getter]
    fn timings_ms<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        for (stage, ms) in &self.timings_ms {
            dict.set_item(stage, ms)?;
        }
        Ok(dict)
    }

    fn __repr__(&self) -> String {
        let (partitions, regions) = (self.partition.get().inner.len(), self.regions.len());
        let (objects, detections) = (self.objects.len(), self.detections.len());
        format!(
            "<samsod.Scene: {partitions} partitions, {regions} regions, {objects} objects, {detections} detections>"
        )
    }
}

/// A saliency map as an array (H, W).
pub(crate) fn map_to_array(py: Python<'_>, map: &samsod::saliency::SaliencyMap) -> PyResult<Py<PyArray2<f32>>> {
    let shape = (map.height() as usize, map.width() as usize);
    let array = Array2::from_shape_vec(shape, map.values().to_vec()).map_err(value_error)?;
    Ok(array.into_pyarray(py).unbind())
}
