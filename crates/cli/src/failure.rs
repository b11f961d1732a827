//! The one error of the command line, on its way out.

use std::io::Write as _;
use std::process::ExitCode;

pub(crate) use greybox_commands::Failure;

use crate::answer::{self, OutputFormat};

/// A command line that clap refuses, in clap's words.
pub(crate) fn usage(rendered: &str) -> Failure {
    let text = rendered.trim_end();
    Failure::input(text.strip_prefix("error: ").unwrap_or(text))
}

/// Prints on standard error, and in JSON on standard output too where that is spoken.
pub(crate) fn print(failure: &Failure, format: OutputFormat) -> ExitCode {
    if format == OutputFormat::Json {
        // Where standard output cannot be written, standard error says what is wrong.
        let _ = answer::print(&format!("{:#}\n", failure.to_json()));
    }
    // With standard error closed there is nobody left to tell.
    let _ = std::io::stderr().lock().write_all(failure.to_string().as_bytes());
    ExitCode::from(failure.code())
}
