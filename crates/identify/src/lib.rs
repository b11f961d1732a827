#![doc = include_str!("../README.md")]

mod choose;
mod correlation;
mod error;
mod identify;
mod library;
mod output_error;
mod precision;
mod stream;
mod structure;
mod weak;

pub use error::IdentifyError;
pub use greybox_calibrate::HoldoutSource;
pub use identify::{
    Blocks, DelayedState, DoubtfulTerm, FoundDelay, FoundEquation, FoundTerm, Identification, MOST_WORK,
    Options, OrderChoice, ProgressListener, Quiet, Role, identify,
};
pub use library::{Library, Monomials};
pub use stream::{Linearisation, Statistics, Streamed, identify_blocks};
