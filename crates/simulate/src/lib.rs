//! Simulation of greybox models: events, true stick–slip, delays, forward sensitivities.
mod integrate;
pub mod rigs;
mod signal;
pub mod small;

pub use integrate::{Environment, Force, Method, Seeds, SignalLanes, Trajectory, integrate};
pub use signal::{FINE, Signal};
