#![doc = include_str!("../README.md")]

mod compiled;
mod error;
mod explicit;
pub mod plant;
mod terms;

pub use error::ControlError;
pub use plant::{Dropped, Plant, PlantOptions};
