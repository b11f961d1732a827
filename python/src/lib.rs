//! The native half of the Python package `greybox`: what `python/greybox/*.py` calls.
//!
//! Arrays become recordings here, work runs on a thread of its own without the interpreter's lock ([`watch`]), and
//! results go back as text and arrays. What a report says and how is decided in `greybox-commands`, as for the command.

mod control;
mod error;
mod fleet;
mod input;
mod study;
mod watch;

use pyo3::prelude::*;

/// The native half of greybox.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<input::Recording>()?;
    module.add_class::<input::Model>()?;
    module.add_function(wrap_pyfunction!(study::diagnose, module)?)?;
    module.add_function(wrap_pyfunction!(study::identify, module)?)?;
    module.add_function(wrap_pyfunction!(study::calibrate, module)?)?;
    module.add_function(wrap_pyfunction!(study::simulate, module)?)?;
    module.add_function(wrap_pyfunction!(study::check, module)?)?;
    module.add_function(wrap_pyfunction!(control::control, module)?)?;
    module.add("EXTENSIONS", greybox_recording::EXTENSIONS.to_vec())?;
    module.add("READS_PARQUET", cfg!(feature = "parquet"))?;
    module.add_class::<fleet::Fleet>()?;
    module.add_function(wrap_pyfunction!(fleet::content, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::episode, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::episodes, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::episodes_of, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::mechanisms, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::statistics, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::failed, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::reduce, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::check_table, module)?)?;
    module.add_function(wrap_pyfunction!(fleet::conclude, module)?)?;
    Ok(())
}
