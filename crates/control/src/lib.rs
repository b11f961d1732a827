#![doc = include_str!("../README.md")]

mod builder;
mod check;
pub mod closed_loop;
mod compiled;
mod controller;
mod design;
mod equilibrium;
mod error;
mod explicit;
pub mod family;
mod feedforward;
mod methods;
pub mod metrics;
pub mod plant;
mod run;
mod specification;
mod stability;
mod terms;

pub use check::Check;
pub use closed_loop::{ClosedLoop, Feedback, LoopOptions};
pub use controller::Controller;
pub use design::design;
pub use equilibrium::{Equilibrium, equilibrium};
pub use error::ControlError;
pub use family::{Envelope, Family, FamilyOptions, Spread};
pub use feedforward::FeedForward;
pub use greybox_smc::check::Pole;
pub use metrics::{Metrics, Verdict};
pub use plant::{Dropped, Plant, PlantOptions};
pub use run::{Reference, Run};
pub use specification::{DesignOptions, Method, Weights};
