//! What the developer commands share: where the repository is, how a task ends, processes and environments that they start,
//! plots, the demo, and the pages of the book that they write.

// Tasks print what they do.
#![allow(clippy::disallowed_methods, clippy::print_stdout, clippy::print_stderr)]

pub mod book;
pub mod demo;
pub mod figure;
pub mod process;
pub mod python;
pub mod readme;

use std::path::{Path, PathBuf};

/// How a task ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// All is well.
    Done,
    /// The task ran, and its answer is no.
    Missed,
    /// It could not run as asked.
    Refused,
}

/// The repository.
#[must_use]
pub fn root() -> PathBuf {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    here.ancestors().nth(2).unwrap_or(here).to_path_buf()
}

/// The middle value; of an even number the mean of the two. NaN without values.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => values[middle],
        _ => 0.5 * (values[middle - 1] + values[middle]),
    }
}
