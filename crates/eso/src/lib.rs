#![doc = include_str!("../README.md")]
#![no_std]

#[cfg(test)]
extern crate std;

mod design;
mod error;
mod fal;
mod observer;
pub mod record;

pub use design::{Design, bandwidth_gains};
pub use error::EsoError;
pub use fal::Fal;
pub use observer::{Observer, Scheme};
