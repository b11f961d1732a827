#![doc = include_str!("../README.md")]

mod choose;
mod correlation;
mod dead_time;
mod energy;
mod error;
mod first;
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
    Blocks, DoubtfulTerm, FoundDeadTime, FoundDelay, FoundEquation, FoundTerm, Identification, OrderChoice,
    ProgressListener, Quiet, Role, identify,
};
pub use library::{Library, Monomials};
pub use options::{DeadTime, DelayedState, MOST_WORK, Options};
pub use stream::{Linearisation, Statistics, Streamed, identify_blocks};
