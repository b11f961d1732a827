//! What a command that finished has to say.

use std::io::{ErrorKind, Write};
use std::process::ExitCode;

use greybox_commands::Failure;

/// For whom a command speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum OutputFormat {
    /// Plain language.
    Text,
    /// One JSON document.
    Json,
}

/// Exit status of a command that did its work and found what was to make it fail.
const FAILED: u8 = 3;

/// The result of a command, in words and for machines.
#[derive(Debug)]
pub(crate) struct Answer {
    text: String,
    json: Option<serde_json::Value>,
    /// Conditions that were to make it fail, and hold.
    met: Vec<String>,
    /// What it could not do of what was asked.
    failures: Vec<Failure>,
}

impl Answer {
    pub(crate) fn new(text: String, json: serde_json::Value) -> Answer {
        Answer { text, json: Some(json), met: Vec::new(), failures: Vec::new() }
    }

    /// The same, of a command that fails for these reasons; none is success.
    pub(crate) fn failing(self, met: Vec<String>) -> Answer {
        Answer { met, ..self }
    }

    /// The same without what failed on its own, while the rest was done.
    pub(crate) fn without(self, failures: Vec<Failure>) -> Answer {
        Answer { failures, ..self }
    }

    /// Help or version: the same words in either format.
    pub(crate) fn words(text: String) -> Answer {
        Answer { text, json: None, met: Vec::new(), failures: Vec::new() }
    }

    /// Adds words, which JSON does not have.
    pub(crate) fn add(&mut self, words: &str) {
        self.text.push_str(words);
    }

    /// Prints on standard output, and on standard error what makes the command fail.
    ///
    /// # Errors
    /// Bad input: standard output cannot be written.
    pub(crate) fn print(&self, format: OutputFormat) -> Result<ExitCode, Failure> {
        let printed = match (&self.json, format) {
            (Some(json), OutputFormat::Json) => print(&format!("{json:#}\n")),
            _ => print(&self.text),
        };
        printed.map_err(|e| {
            Failure::input(format!("standard output cannot be written: {e}"))
                .help("see that the disk has room; what `--out` names is written")
        })?;
        let met = self.met.iter().map(|what| format!("failed: {what}\n"));
        let said: String = self.failures.iter().map(Failure::to_string).chain(met).collect();
        // With standard error closed there is nobody left to tell.
        let _ = std::io::stderr().lock().write_all(said.as_bytes());
        // (A fault of greybox, 1, outweighs bad input, 2.)
        let failed = self.failures.iter().map(Failure::code).min();
        let met = (!self.met.is_empty()).then_some(FAILED);
        Ok(failed.or(met).map_or(ExitCode::SUCCESS, ExitCode::from))
    }
}

/// Writes to standard output. A reader that has heard enough (`greybox … | head`) is no failure.
pub(crate) fn print(text: &str) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == ErrorKind::BrokenPipe => Ok(()),
        printed => printed,
    }
}
