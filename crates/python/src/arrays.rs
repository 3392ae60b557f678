//! Arrays in and out: what is accepted is checked here, with messages that say what was given.

use numpy::ndarray::{ArrayView2, Dimension};
use numpy::{Element, PyArray2, PyArrayMethods, PyReadonlyArray, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use samsod::segment::RgbView;

use crate::value_error;

/// Borrows an argument as an array of one element type and number of dimensions.
///
/// # Errors
/// `TypeError` for another type, `ValueError` for an array that is not C-contiguous.
pub(crate) fn borrow<'py, T: Element, D: Dimension>(
    name: &str,
    allowed: &str,
    argument: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArray<'py, T, D>> {
    let Ok(array) = argument.extract::<PyReadonlyArray<'py, T, D>>() else {
        let given = match argument.cast::<PyUntypedArray>() {
            Ok(array) => format!("{} of shape {:?}", array.dtype(), array.shape()),
            Err(_) => argument.get_type().name()?.to_string(),
        };
        return Err(PyTypeError::new_err(format!("{name}: expected {allowed}, got {given}")));
    };
    if !array.is_c_contiguous() {
        return Err(PyValueError::new_err(format!(
            "{name}: expected {allowed}, got one with strides {:?} bytes; numpy.ascontiguousarray makes a copy that fits",
            array.strides()
        )));
    }
    Ok(array)
}

/// A borrowed frame; the array stays alive, and locked against mutable borrows of PyO3, as long as this does.
pub(crate) struct Frame<'py> {
    array: PyReadonlyArray<'py, u8, numpy::Ix3>,
    width: u32,
    height: u32,
}

impl<'py> Frame<'py> {
    /// Takes an argument that must be a C-contiguous uint8 array (H, W, 3).
    pub(crate) fn new(argument: &Bound<'py, PyAny>) -> PyResult<Self> {
        const ALLOWED: &str = "a C-contiguous uint8 array of shape (H, W, 3)";
        let array = borrow::<u8, numpy::Ix3>("rgb", ALLOWED, argument)?;
        let &[rows, columns, channels] = array.shape() else {
            return Err(PyTypeError::new_err(format!("rgb: expected {ALLOWED}")));
        };
        if channels != 3 {
            return Err(PyValueError::new_err(format!("rgb: expected {ALLOWED}, got shape {:?}", array.shape())));
        }
        let (width, height) = side(columns).zip(side(rows)).ok_or_else(|| {
            PyValueError::new_err(format!("rgb: {columns} x {rows} pixels; a side has at most {} pixels", u32::MAX))
        })?;
        Ok(Self { array, width, height })
    }

    /// The frame without a copy.
    pub(crate) fn view(&self) -> PyResult<RgbView<'_>> {
        let pixels = self.array.as_slice().map_err(value_error)?;
        RgbView::from_raw(self.width, self.height, pixels)
            .ok_or_else(|| PyValueError::new_err("rgb: fewer bytes than its shape says"))
    }

    /// # Errors
    /// `ValueError` when the frame and something made of it differ in size.
    pub(crate) fn must_have_size(&self, what: &str, width: u32, height: u32) -> PyResult<()> {
        same_size("rgb", (self.width, self.height), what, (width, height))
    }
}

/// # Errors
/// `ValueError` when two (width, height) differ.
pub(crate) fn same_size(first: &str, a: (u32, u32), second: &str, b: (u32, u32)) -> PyResult<()> {
    if a == b {
        return Ok(());
    }
    Err(PyValueError::new_err(format!(
        "{first} has {} x {} pixels and {second} {} x {}; both must have the same size",
        a.0, a.1, b.0, b.1
    )))
}

/// The side of an image as Rust counts it.
pub(crate) fn side(pixels: usize) -> Option<u32> {
    u32::try_from(pixels).ok()
}

/// A read-only array over memory that belongs to a Python object, without a copy.
pub(crate) fn lend<'py, T: Element>(
    owner: Bound<'py, PyAny>,
    width: u32,
    height: u32,
    values: &[T],
) -> PyResult<Bound<'py, PyArray2<T>>> {
    let view = ArrayView2::from_shape((height as usize, width as usize), values).map_err(value_error)?;
    // SAFETY: `values` lie in an allocation that `owner` keeps alive and never moves or changes (the callers pass
    // frozen classes that hold it in an `Arc`), and the array holds a reference to `owner`.
    let array = unsafe { PyArray2::borrow_from_array(&view, owner) };
    // Nobody else can have borrowed the array that was made a line above.
    array.try_readwrite().map_err(value_error)?.make_nonwriteable();
    Ok(array)
}
