//! Failures as exceptions.

use greybox_commands::Failure;
use pyo3::prelude::*;

/// The exception of `greybox._errors` that tells of a failure.
pub(crate) fn exception(py: Python<'_>, failure: &Failure) -> PyErr {
    let text = failure.to_string();
    let text = text.strip_prefix("error: ").unwrap_or(&text).trim_end().to_owned();
    let told = (text, failure.to_json().to_string());
    let made =
        py.import("greybox._errors").and_then(|module| module.getattr("of")).and_then(|of| of.call1(told));
    match made {
        Ok(exception) => PyErr::from_value(exception),
        Err(error) => error,
    }
}

/// As [`exception`], where the value is there or not.
pub(crate) fn raised<T>(py: Python<'_>, outcome: Result<T, Failure>) -> PyResult<T> {
    outcome.map_err(|failure| exception(py, &failure))
}
