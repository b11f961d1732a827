//! Parameter estimation by multiple shooting and output error.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub mod data;
mod fit_point;
pub mod free;
pub mod free_run;
mod holdout;
pub mod horizon;
pub mod input_noise;
pub mod noise_model;
pub mod problem;
pub mod qr;
pub mod setup;
pub mod stochastic;
mod student;

pub use data::{Data, DataError, PieceData, SmoothedStates, spread};
pub use fit_point::FitPoint;
pub use free::free_parameters;
pub use free_run::{Criterion, FreeRun, Score, window_length, window_of};
pub use holdout::{HELD_OUT_SHARE, HoldoutSource};
pub use horizon::Horizon;
pub use noise_model::Autoregression;
pub use problem::{
    Ending, Fit, FreeParameter, Limits, Point, Prior, Problem, Segment, SegmentRows, StartPrior, Work,
};
pub use setup::{Segmentation, Setup, SetupError, UnknownState};
pub use student::student_quantile;
