//! What can be wrong with an estimator's arguments.

use core::fmt;

/// Why an estimator could not be made.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum RecursiveError {
    /// Two slices that go together differ in length.
    Length {
        /// What is too long or too short.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that it should have.
        expected: usize,
    },
    /// A value that is no number.
    NotFinite {
        /// What it is.
        what: &'static str,
        /// Where it stands, counted from 0.
        index: usize,
    },
    /// A standard deviation that is not positive.
    Deviation {
        /// Where it stands, counted from 0.
        index: usize,
        /// As given.
        value: f64,
    },
    /// A run length between false alarms, or a change to look for, that is not positive.
    Design {
        /// What it is.
        what: &'static str,
        /// As given.
        value: f64,
    },
}

impl fmt::Display for RecursiveError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Length { what, found, expected } => {
                write!(f, "{what} has {found} entries where {expected} are needed")
            }
            Self::NotFinite { what, index } => write!(f, "entry {index} of {what} is not a finite number"),
            Self::Deviation { index, value } => {
                write!(f, "standard deviation {index} is {value}; it must be positive and finite")
            }
            Self::Design { what, value } => write!(f, "{what} is {value}; it must be positive and finite"),
        }
    }
}

impl core::error::Error for RecursiveError {}
