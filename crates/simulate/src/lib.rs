//! Simulation of greybox models: events, true stick–slip, delays, forward sensitivities.
mod aligned;
mod integrate;
pub mod rigs;
mod signal;
pub mod small;

pub use integrate::{
    Carry, Environment, Force, MOST_TRIALS, Method, Seeds, SignalLanes, Simulation, Trajectory,
    delayed_states, has_history, integrate,
};
pub use signal::{FINE, Signal};
