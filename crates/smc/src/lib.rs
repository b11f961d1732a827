#![doc = include_str!("../README.md")]
#![no_std]

#[cfg(test)]
extern crate std;

pub mod check;
mod design;
mod eigen;
mod equilibrium;
mod error;
mod flat;
mod friction;
mod law;
mod matrix;
mod pole;
mod surface;
mod tangent;
pub mod thesis;

pub use design::Design;
pub use equilibrium::{Equilibrium, EquilibriumSolver};
pub use error::{Fault, SmcError};
pub use flat::FlatOutput;
pub use friction::smooth_sign;
pub use law::{BoundaryLayer, Command, Law, Rate, Target, sat};
pub use surface::Surface;
pub use tangent::Tangent;
