//! Parameters of a cell from TOML files and Python mappings, and back.

use std::path::{Path, PathBuf};

use pyo3::exceptions::{PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyMapping, PyString, PyTuple};
use samsod::CellParams;
use samsod::recognize::RecognizeParams;
use serde::Serialize;
use toml::{Table, Value};

use crate::value_error;

/// Sections of a samsodd configuration that are not the vision chain's; any other unknown name is a slip of the pen.
const DAEMON_SECTIONS: [&str; 13] = [
    "cell",
    "frames",
    "camera",
    "view",
    "catalogue",
    "robot",
    "jig",
    "recording",
    "supervision",
    "interest",
    "http",
    "foxglove",
    "log",
];

/// Deepest nesting of a mapping; one that contains itself would otherwise exhaust the stack.
const MAX_DEPTH: usize = 8;

/// Reads the parameters of a cell: None, a mapping or the path of a TOML file.
pub(crate) fn params(config: Option<&Bound<'_, PyAny>>) -> PyResult<CellParams> {
    let Some(config) = config else { return Ok(CellParams::default()) };
    if let Ok(mapping) = config.cast::<PyMapping>() {
        return vision(table(mapping, 0)?).map_err(value_error);
    }
    let path: PathBuf = config.extract().map_err(|_| {
        PyTypeError::new_err(format!(
            "config: expected the path of a TOML file, a mapping or None, got {}",
            config.get_type()
        ))
    })?;
    let text = std::fs::read_to_string(&path).map_err(|error| unreadable(&path, error))?;
    let in_file = |error: toml::de::Error| PyValueError::new_err(format!("{}: {error}", path.display()));
    vision(text.parse().map_err(in_file)?).map_err(in_file)
}

/// Parameters of the recognition from keyword arguments; the method has an argument of its own.
pub(crate) fn recognition(method: &str, keywords: Option<&Bound<'_, PyDict>>) -> PyResult<RecognizeParams> {
    let mut params = match keywords {
        Some(keywords) => table(keywords.cast::<PyMapping>()?, 0)?,
        None => Table::new(),
    };
    params.insert("method".to_owned(), Value::String(method.to_owned()));
    Value::Table(params).try_into().map_err(value_error)
}

/// The part of a configuration that describes the vision chain.
fn vision(mut whole: Table) -> Result<CellParams, toml::de::Error> {
    whole.retain(|key, _| !DAEMON_SECTIONS.contains(&key));
    Value::Table(whole).try_into()
}

/// The exception that suits an I/O error (`FileNotFoundError`, ..), with the path in its message.
pub(crate) fn unreadable(path: &Path, error: std::io::Error) -> PyErr {
    if error.kind() == std::io::ErrorKind::InvalidData {
        return value_error(format!("{}: {error}", path.display()));
    }
    std::io::Error::new(error.kind(), format!("{}: {error}", path.display())).into()
}

/// Parameters as a dict that [`params`] or [`recognition`] takes.
pub(crate) fn to_dict<'py>(py: Python<'py>, params: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    to_python(py, &Value::try_from(params).map_err(value_error)?)
}

fn to_python<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    Ok(match value {
        Value::String(text) => text.into_pyobject(py)?.into_any(),
        Value::Integer(number) => number.into_pyobject(py)?.into_any(),
        Value::Float(number) => as_written(*number).into_pyobject(py)?.into_any(),
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

/// The number with the fewest digits that stands for the same f32, which most parameters are: 5.3, not
/// 5.300000190734863. What no f32 is was a f64 and is left as it is.
fn as_written(number: f64) -> f64 {
    let single = number as f32;
    if f64::from(single) != number {
        return number;
    }
    single.to_string().parse().unwrap_or(number)
}

/// A mapping as TOML; entries that are None are left out, so they keep their default.
fn table(mapping: &Bound<'_, PyMapping>, depth: usize) -> PyResult<Table> {
    let mut table = Table::new();
    for item in mapping.items()? {
        let (key, value): (Bound<'_, PyAny>, Bound<'_, PyAny>) = item.extract()?;
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
        return Err(value_error(format!("config: {key}: more than {MAX_DEPTH} levels of mappings and lists")));
    }
    // bool before int: Python's bool is an int. Neither NumPy's bool nor its integers are subclasses of Python's.
    if let Ok(truth) = value.extract::<bool>() {
        return Ok(Value::Boolean(truth));
    }
    match value.extract::<i64>() {
        Ok(number) => return Ok(Value::Integer(number)),
        Err(error) if error.is_instance_of::<PyOverflowError>(value.py()) => {
            return Err(value_error(format!("{key} = {value}: too large")));
        }
        Err(_) => {}
    }
    if let Ok(text) = value.cast::<PyString>() {
        return Ok(Value::String(text.extract()?));
    }
    if let Ok(mapping) = value.cast::<PyMapping>() {
        return Ok(Value::Table(table(mapping, depth + 1)?));
    }
    if value.is_instance_of::<PyList>() || value.is_instance_of::<PyTuple>() {
        let items = value.try_iter()?.map(|item| from_python(key, &item?, depth + 1));
        return Ok(Value::Array(items.collect::<PyResult<_>>()?));
    }
    if let Ok(number) = value.extract::<f64>() {
        return Ok(Value::Float(number));
    }
    Err(PyTypeError::new_err(format!(
        "config: {key}: expected a number, string, bool, list or mapping, got {}",
        value.get_type()
    )))
}
