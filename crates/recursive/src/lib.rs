#![doc = include_str!("../README.md")]
#![no_std]

extern crate alloc;
#[cfg(test)]
extern crate std;

mod chart;
mod error;
mod filter;
mod least_squares;
mod triangle;

pub use chart::{Alarm, Chart, Direction};
pub use error::RecursiveError;
pub use filter::{Filter, Innovation, Measured, Predicted};
pub use least_squares::LeastSquares;
pub use triangle::Triangle;
