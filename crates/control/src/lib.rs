#![doc = include_str!("../README.md")]

mod builder;
pub mod closed_loop;
mod compiled;
pub mod design;
mod equilibrium;
mod error;
mod explicit;
pub mod family;
mod feedforward;
mod methods;
pub mod metrics;
pub mod plant;
mod stability;
mod terms;

pub use closed_loop::{ClosedLoop, Feedback, LoopOptions, Reference, Run};
pub use design::{Check, Controller, DesignOptions, Method, Weights, design};
pub use equilibrium::{Equilibrium, equilibrium};
pub use error::ControlError;
pub use family::{Family, FamilyOptions, Spread};
pub use feedforward::FeedForward;
pub use metrics::Metrics;
pub use plant::{Dropped, Plant, PlantOptions};
