//! Time delays.
pub mod bound;
pub mod exact;
mod qr;
pub mod spectrum;
mod spline;
