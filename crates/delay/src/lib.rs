//! Time delays.
pub mod spectrum;
