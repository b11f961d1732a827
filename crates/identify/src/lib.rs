#![doc = include_str!("../README.md")]

mod choose;
mod correlation;
mod energy;
mod error;
mod identify;
mod library;
mod options;
mod output_error;
mod precision;
mod setting;
mod stream;
mod structure;
mod weak;

pub use error::IdentifyError;
pub use greybox_calibrate::HoldoutSource;
pub use identify::{
    Blocks, DoubtfulTerm, FoundDelay, FoundEquation, FoundTerm, Identification, OrderChoice,
    ProgressListener, Quiet, Role, identify,
};
pub use library::{Library, Monomials};
pub use options::{DelayedState, MOST_WORK, Options};
pub use stream::{Linearisation, Statistics, Streamed, identify_blocks};
