#![doc = include_str!("../README.md")]

pub mod bound;
pub mod exact;
pub mod expansion;
mod qr;
pub mod spectrum;
mod spline;
pub mod taylor;
pub mod windows;
