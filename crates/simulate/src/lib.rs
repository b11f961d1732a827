//! Simulation of greybox models: events, true stick–slip, delays, forward sensitivities.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

mod aligned;
mod integrate;
pub mod rigs;
mod signal;
pub mod small;

pub use integrate::{
    Carry, Environment, Force, MOST_TRIALS, Method, Past, Seeds, SignalLanes, Simulation, Stepper,
    Trajectory, can_stride, delayed_states, delays, has_history, integrate,
};
pub use signal::{FINE, Signal};
