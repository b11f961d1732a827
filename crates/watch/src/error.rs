//! Why a machine cannot be watched.

use greybox_calibrate::{DataError, SetupError};
use greybox_recursive::RecursiveError;

/// Why a machine cannot be watched.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum WatchError {
    /// An option that makes no sense.
    #[error("{option} is {value}: {help}")]
    Option {
        /// Which.
        option: &'static str,
        /// As given.
        value: f64,
        /// What it should be.
        help: &'static str,
    },
    /// The recording does not have what the model needs.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The model does not compile or is too stiff.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// The model delays a measurement.
    #[error(
        "a measurement of the model has `delay(...)`: what is measured is a state of the past, and a filter corrects the \
         present one. Shift the channel by the delay, or leave it out"
    )]
    DelayedMeasurement,
    /// Nothing may move.
    #[error(
        "every parameter is fixed: there is nothing to watch. Take `fixed = true` from the parameters that may change"
    )]
    NothingFree,
    /// The first seconds are too few samples.
    #[error(
        "the first {seconds} s hold {samples} samples on an even grid, and {needed} are needed to learn what is usual: \
         learn for longer"
    )]
    TooShort {
        /// Seconds.
        seconds: f64,
        /// Samples of the longest piece.
        samples: usize,
        /// Samples needed.
        needed: usize,
    },
    /// The model cannot follow the first seconds.
    #[error(
        "the model cannot follow the first seconds: its simulation diverges. Calibrate it on a recording first"
    )]
    Diverged,
    /// A saved state of another model.
    #[error("the saved state belongs to another model: {what}")]
    OtherModel {
        /// What differs.
        what: String,
    },
    /// A filter could not be made of what was learned.
    #[error("the first seconds tell too little: {0}. Learn for longer")]
    Recursive(#[from] RecursiveError),
}
