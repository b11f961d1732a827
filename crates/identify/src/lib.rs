//! Governing equations from recordings alone.
mod choose;
mod error;
mod identify;
mod library;
mod output_error;
mod precision;
mod structure;
mod weak;

pub use error::IdentifyError;
pub use identify::{
    DelayedState, DoubtfulTerm, FoundDelay, FoundEquation, FoundTerm, HoldoutSource, Identification,
    Observer, Options, OrderChoice, Quiet, Role, identify,
};
pub use library::{Library, Monomials};
