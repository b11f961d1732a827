#![doc = include_str!("../README.md")]

mod blocks;
mod changes;
mod error;
mod event;
mod first_pass;
mod identity;
mod judge;
mod learn;
mod machine;
mod naming;
mod options;
mod released;
mod sample;
mod saved;
mod tracker;
mod watch;

pub use error::WatchError;
pub use event::{Change, Clock, Estimates, Event, Irregular, Learned, Outside, Parameter, Subject};
pub use options::Options;
pub use saved::Saved;
pub use watch::Watch;
