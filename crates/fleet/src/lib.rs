//! Statistics of many machines that were recorded once or several times.
//!
//! Each recording gives estimates of parameters with standard errors. This crate says what they say together.
//!
//! | module | what it answers |
//! |---|---|
//! | [`mod@pool`] | one number from several estimates of it, and whether they agree |
//! | [`machines`] | mean over machines, scatter between them and within, what each has of its own, what it depends on, which machines differ |
//! | [`share()`] | in which share of the machines something is found |
//! | [`runs`] | the table that says which machine a recording is of, when it was made and under what conditions |
//!
//! All functions are pure; nothing here reads a file or prints.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub mod machines;
mod mixed;
pub mod pool;
pub mod runs;
mod share;

pub use crate::machines::{Machines, analyse};
pub use crate::pool::{Effect, pool};
pub use crate::runs::{Runs, RunsError};
pub use crate::share::{Share, share};
