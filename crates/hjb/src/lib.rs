#![doc = include_str!("../README.md")]

pub mod adamax;
pub mod basis;
mod check;
mod compensated;
mod dense;
pub mod design;
mod error;
pub mod feedback;
mod lqr;
mod lyapunov;
pub mod plant;
pub mod points;
pub mod policy;
pub mod problem;
pub mod range;
mod riccati;

pub use adamax::{AdamaxOptions, Training, TrainingEnd, adamax};
pub use basis::Monomials;
pub use dense::eigenvalues;
pub use design::{Optimal, design, design_within};
pub use error::{HjbError, RiccatiError};
pub use feedback::{Feedback, Verification, verify};
pub use lqr::{dlqr, lqr};
pub use lyapunov::{lyapunov, stein};
pub use plant::{Affine, Linear, Plant, tangent};
pub use points::Domain;
pub use policy::{Policy, PolicyOptions, policy_iteration};
pub use problem::Problem;
pub use range::InputRange;
pub use riccati::{Riccati, care, dare};
