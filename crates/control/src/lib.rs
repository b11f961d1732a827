#![doc = include_str!("../README.md")]

mod compiled;
pub mod design;
mod equilibrium;
mod error;
mod explicit;
mod feedforward;
mod methods;
pub mod plant;
mod stability;
mod terms;

pub use design::{Check, Controller, DesignOptions, Method, Weights, design};
pub use equilibrium::{Equilibrium, equilibrium};
pub use error::ControlError;
pub use feedforward::FeedForward;
pub use plant::{Dropped, Plant, PlantOptions};
