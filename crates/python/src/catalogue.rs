//! `Catalogue` and `Part`.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray2, PyArray3};
use pyo3::prelude::*;
use samsod::recognize::{self as stage, CatalogueError, MeshError};

use crate::config::unreadable;
use crate::value_error;

/// Parts that can be recognised, from a folder that has a folder for each of them.
///
/// Args:
///     path: the folder; the folders in it hold part.toml, template.png, mask.png and, for those that have one,
///         model.stl. Folders without part.toml are passed over.
///
/// Raises:
///     OSError: the folder or a file cannot be read.
///     ValueError: it has no part, two parts have one name, or a file is not what it should be: the message names file and
///         value and says what is allowed.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Catalogue {
    parts: Arc<stage::Catalogue>,
}

impl Catalogue {
    pub(crate) fn parts(&self) -> &stage::Catalogue {
        &self.parts
    }
}

#[pymethods]
impl Catalogue {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let parts = py.detach(|| stage::Catalogue::read(&path)).map_err(exception)?;
        Ok(Self { parts: Arc::new(parts) })
    }

    /// The parts, in the order of their folders.
    #[getter(parts)]
    fn list(&self) -> Vec<Part> {
        (0..self.parts.parts().len()).map(|index| Part { parts: Arc::clone(&self.parts), index }).collect()
    }

    /// The same catalogue without some parts; names that are not in it change nothing.
    ///
    /// Args:
    ///     names: names of parts.
    fn without(&self, names: Vec<String>) -> Self {
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        Self { parts: Arc::new(self.parts.without(&names)) }
    }

    fn __len__(&self) -> usize {
        self.parts.parts().len()
    }

    fn __repr__(&self) -> String {
        let names: Vec<&str> = self.parts.parts().iter().map(|part| part.name.as_str()).collect();
        format!("<samsod.Catalogue: {}>", names.join(", "))
    }
}

/// The exception that suits an error: `FileNotFoundError` and the like for what cannot be read.
fn exception(error: CatalogueError) -> PyErr {
    match error {
        CatalogueError::Read { path, source } | CatalogueError::Mesh(MeshError::Read { path, source }) => {
            unreadable(&path, source)
        }
        error => value_error(error),
    }
}

/// A part of a catalogue.
#[pyclass(frozen, module = "samsod")]
pub(crate) struct Part {
    parts: Arc<stage::Catalogue>,
    index: usize,
}

impl Part {
    fn part(&self) -> &stage::Part {
        &self.parts.parts()[self.index]
    }
}

#[pymethods]
impl Part {
    /// Its name.
    #[getter]
    fn name(&self) -> &str {
        &self.part().name
    }

    /// The folder that it was read from.
    #[getter]
    fn folder(&self) -> PathBuf {
        self.part().folder.clone()
    }

    /// Height over the table, as it lies, in mm.
    #[getter]
    fn height_mm(&self) -> f64 {
        self.part().height_mm
    }

    /// Opening of the gripper at the part in mm.
    #[getter]
    fn grasp_width_mm(&self) -> f64 {
        self.part().grasp.width_mm
    }

    /// Where the gripper closes: x and y in mm from the origin of the part and in its axes.
    #[getter]
    fn grasp_offset_mm(&self) -> (f64, f64) {
        self.part().grasp.offset_mm.into()
    }

    /// Direction of the gripper's x axis, along its fingers, in the axes of the part, in degrees.
    #[getter]
    fn grasp_angle_deg(&self) -> f64 {
        self.part().grasp.angle_rad.to_degrees()
    }

    /// n of a part of which a turn by 360 / n degrees gives the same outline; 0: any turn does.
    #[getter]
    fn shape_symmetry(&self) -> u32 {
        self.part().symmetry.shape_order
    }

    /// n of a part of which a turn by 360 / n degrees gives the same picture; 0: any turn does.
    #[getter]
    fn appearance_symmetry(&self) -> u32 {
        self.part().symmetry.appearance_order
    }

    /// Its picture: uint8 (H, W, 3), made anew at every access.
    #[getter]
    fn template<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let image = &self.part().template.image;
        let shape = (image.height() as usize, image.width() as usize, 3);
        Ok(Array3::from_shape_vec(shape, image.as_raw().clone()).map_err(value_error)?.into_pyarray(py))
    }

    /// Its pixels in that picture: bool (H, W), made anew at every access.
    #[getter]
    fn template_mask<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        let mask = &self.part().template.mask;
        let shape = (mask.height() as usize, mask.width() as usize);
        let inside = mask.as_raw().iter().map(|&value| value > 127).collect();
        Ok(Array2::from_shape_vec(shape, inside).map_err(value_error)?.into_pyarray(py))
    }

    /// Whether it has a shape, model.stl.
    #[getter]
    fn has_model(&self) -> bool {
        self.part().mesh.is_some()
    }

    fn __repr__(&self) -> String {
        format!("<samsod.Part: {}, {} mm high>", self.part().name, self.part().height_mm)
    }
}
