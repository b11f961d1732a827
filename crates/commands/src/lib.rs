//! What the commands do with what was read, for the command line and for Python.
//!
//! A module a command: from a finished piece of work of the libraries to files, words and JSON. [`loading`] reads models
//! and recordings, [`Failure`] is the one error, [`story`] tells reports in plain language. Nothing here prints, knows a
//! command line or writes a file, so that the command and the Python package give the same answer.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub mod calibrate;
pub mod case;
pub mod check;
pub mod control;
pub mod diagnose;
mod failure;
pub mod fleet;
mod foreign;
pub mod identify;
pub mod loading;
mod plausible;
pub mod simulate;
pub mod story;
pub mod watch;

pub use failure::Failure;
