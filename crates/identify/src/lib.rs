//! Governing equations from recordings alone.
pub mod choose;
pub mod output_error;
pub mod structure;
