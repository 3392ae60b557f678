//! Parameters of a cell from TOML files and Python dicts, and back.

use std::path::{Path, PathBuf};

use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};
use samsod::CellParams;
use toml::{Table, Value};

use crate::value_error;

/// Sections of a samsodd configuration that describe the vision chain; the others are the daemon's.
const SECTIONS: [&str; 3] = ["segment", "saliency", "regions"];

/// Deepest nesting of a dict; one that contains itself would otherwise exhaust the stack.
const MAX_DEPTH: usize = 8;

/// Reads the parameters of a cell: None, a dict or the path of a TOML file.
pub(crate) fn params(config: Option<&Bound<'_, PyAny>>) -> PyResult<CellParams> {
    let Some(config) = config else { return Ok(CellParams::default()) };
    if let Ok(dict) = config.cast::<PyDict>() {
        return Value::Table(table(dict, 0)?).try_into().map_err(value_error);
    }
    let path: PathBuf = config.extract().map_err(|_| {
        PyTypeError::new_err(format!(
            "config: expected the path of a TOML file, a dict or None, got {}",
            config.get_type()
        ))
    })?;
    let text = std::fs::read_to_string(&path).map_err(|error| unreadable(&path, error))?;
    let in_file = |error: toml::de::Error| PyValueError::new_err(format!("{}: {error}", path.display()));
    let mut whole: Table = text.parse().map_err(in_file)?;
    whole.retain(|key, _| SECTIONS.contains(&key));
    Value::Table(whole).try_into().map_err(in_file)
}

/// The exception that suits an I/O error (`FileNotFoundError`, ..), with the path in its message.
fn unreadable(path: &Path, error: std::io::Error) -> PyErr {
    if error.kind() == std::io::ErrorKind::InvalidData {
        return value_error(format!("{}: {error}", path.display()));
    }
    std::io::Error::new(error.kind(), format!("{}: {error}", path.display())).into()
}

/// The parameters as a dict that [`params`] takes.
pub(crate) fn to_dict<'py>(py: Python<'py>, params: &CellParams) -> PyResult<Bound<'py, PyAny>> {
    to_python(py, &Value::try_from(params).map_err(value_error)?)
}

fn to_python<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    Ok(match value {
        Value::String(text) => text.into_pyobject(py)?.into_any(),
        Value::Integer(number) => number.into_pyobject(py)?.into_any(),
        Value::Float(number) => number.into_pyobject(py)?.into_any(),
        Value::Boolean(truth) => truth.into_pyobject(py)?.to_owned().into_any(),
        Value::Datetime(time) => time.to_string().into_pyobject(py)?.into_any(),
        Value::Array(items) => {
            let list = PyList::empty(py);
            for item in items {
                list.append(to_python(py, item)?)?;
            }
            list.into_any()
        }
        Value::Table(entries) => {
            let dict = PyDict::new(py);
            for (key, item) in entries {
                dict.set_item(key, to_python(py, item)?)?;
            }
            dict.into_any()
        }
    })
}

/// A dict as TOML; entries that are None are left out, so they keep their default.
fn table(dict: &Bound<'_, PyDict>, depth: usize) -> PyResult<Table> {
    let mut table = Table::new();
    for (key, value) in dict {
        let key: String =
            key.extract().map_err(|_| PyTypeError::new_err(format!("config: key {key} is not a string")))?;
        if !value.is_none() {
            let value = from_python(&key, &value, depth)?;
            table.insert(key, value);
        }
    }
    Ok(table)
}

fn from_python(key: &str, value: &Bound<'_, PyAny>, depth: usize) -> PyResult<Value> {
    if depth > MAX_DEPTH {
        return Err(value_error(format!("config: {key}: more than {MAX_DEPTH} levels of dicts and lists")));
    }
    // bool before int: Python's bool is an int.
    if let Ok(truth) = value.cast::<PyBool>() {
        return Ok(Value::Boolean(truth.is_true()));
    }
    if value.is_instance_of::<PyInt>() {
        return Ok(Value::Integer(value.extract().map_err(|_| value_error(format!("{key} = {value}: too large")))?));
    }
    if value.is_instance_of::<PyFloat>() {
        return Ok(Value::Float(value.extract()?));
    }
    if let Ok(text) = value.cast::<PyString>() {
        return Ok(Value::String(text.extract()?));
    }
    if let Ok(dict) = value.cast::<PyDict>() {
        return Ok(Value::Table(table(dict, depth + 1)?));
    }
    if value.is_instance_of::<PyList>() || value.is_instance_of::<PyTuple>() {
        let items = value.try_iter()?.map(|item| from_python(key, &item?, depth + 1));
        return Ok(Value::Array(items.collect::<PyResult<_>>()?));
    }
    // NumPy's scalars are numbers to Python but no subclass of int.
    if let Ok(number) = value.extract::<f64>() {
        return Ok(Value::Float(number));
    }
    Err(PyTypeError::new_err(format!(
        "config: {key}: expected a number, string, bool, list or dict, got {}",
        value.get_type()
    )))
}
