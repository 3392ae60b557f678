//! The Python extension module `samsod._native`: thin bindings of the crates `samsod` and `samsod-camera`.
//!
//! Frames come in without a copy (C-contiguous uint8 arrays of shape (H, W, 3)); the stages run without the
//! interpreter lock. Every error of the Rust side becomes a `ValueError` with its message, a wrong type of argument a
//! `TypeError`. A panic, which would be a fault of samsod, becomes a `RuntimeError`: PyO3's own `PanicException`
//! derives from `BaseException` and would pass by every `except Exception` of the caller.

mod arrays;
mod camera;
mod catalogue;
mod cell;
mod config;
mod partition;
mod recognizer;
mod saliency;
mod shadow;

use std::panic::{AssertUnwindSafe, catch_unwind};

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;

/// The compiled part of samsod. Import from `samsod`, not from here.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::camera::Camera;
    #[pymodule_export]
    use crate::catalogue::{Catalogue, Part};
    #[pymodule_export]
    use crate::cell::{Cell, Scene};
    #[pymodule_export]
    use crate::partition::{Partition, segment};
    #[pymodule_export]
    use crate::recognizer::{Detection, Recognizer, settle_objects};
    #[pymodule_export]
    use crate::saliency::{SalientRegion, saliency, salient_regions};
    #[pymodule_export]
    use crate::shadow::{ObjectRegion, describe_fringe, describe_pieces, separate_shadows};
    use pyo3::prelude::*;
    use pyo3::types::PyTuple;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("FRINGE_SIGNS", PyTuple::new(module.py(), samsod::shadow::FRINGE_SIGNS)?)?;
        module.add("PIECE_SIGNS", PyTuple::new(module.py(), samsod::shadow::PIECE_SIGNS)?)?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}

/// A `ValueError` with the message of a Rust error.
pub(crate) fn value_error(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Runs a stage without the interpreter lock and turns its error, or its panic, into an exception.
pub(crate) fn run<T, E>(py: Python<'_>, stage: impl FnOnce() -> Result<T, E> + Send) -> PyResult<T>
where
    T: Send,
    E: std::fmt::Display + Send,
{
    match py.detach(|| catch_unwind(AssertUnwindSafe(stage))) {
        Ok(result) => result.map_err(value_error),
        Err(panic) => {
            let text = panic
                .downcast_ref::<String>()
                .map(String::as_str)
                .or_else(|| panic.downcast_ref::<&str>().copied())
                .unwrap_or("no message");
            Err(PyRuntimeError::new_err(format!("internal error in samsod: {text}")))
        }
    }
}
