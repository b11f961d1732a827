//! Finds the physics a simulation leaves out.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

mod answer;
mod baseline;
mod calibration;
pub mod candidate;
mod closure;
mod conclude;
mod diagnose;
pub mod diagnosis;
pub mod discrepancy;
pub mod evidence;
mod explore;
mod findings;
pub mod fitted;
mod gates;
mod importance;
mod layout;
pub mod library;
pub mod locate;
mod marginal;
pub mod place;
mod plausibility;
pub mod proposal;
mod remainder;
pub mod screen;
pub mod search;
pub mod shapes;
pub mod smoother;
pub mod spectra;
mod takeover;
mod temperature;
pub mod trajectory;
mod turns;
mod twins;
mod uncertainty;
mod validate;
mod verdict;

pub use calibration::{Calibration, calibrate};
pub use diagnose::diagnose;
pub use diagnosis::{DiagnoseError, Diagnosis, Estimate, Options, Subset, Verdict};
pub use library::{Mechanism, MechanismError, built_in};

use std::sync::Arc;

use greybox_calibrate::Work;

/// Where the diagnosis is, for progress bars and logs.
#[derive(Debug, Clone, PartialEq)]
pub enum Stage {
    /// Fitting the nominal equations.
    Calibrating,
    /// Score test of every candidate.
    Screening {
        /// How many.
        candidates: usize,
        /// Mechanisms found so far.
        found: usize,
    },
    /// Joint fits of the short-list.
    Fitting {
        /// How many.
        candidates: usize,
    },
    /// Going on with longer segments.
    Lengthening {
        /// How many.
        segments: usize,
    },
    /// Searching again with a model of the coloured noise.
    Whitening,
    /// Fitting the model that was found, and the equations alone, to whole recordings.
    Simulating,
    /// Choosing the terms of a formula for what no name explains.
    Closing {
        /// Samples of the segments.
        length: usize,
        /// Terms so far.
        terms: usize,
    },
    /// Fitting to parts of the recordings, and simulating the others.
    Validating,
    /// Weighing laws beside an error of the model itself.
    Exploring,
    /// Estimates and intervals, and what each mechanism explains.
    Concluding,
}

/// What was weighed, and how.
pub struct Weighed<'a> {
    /// The laws that were not there before.
    pub kinds: &'a [&'a str],
    /// What decides.
    pub evidence: &'a evidence::Evidence,
    /// What [`evidence::robust`] makes of it, computed when asked for.
    pub robust: &'a dyn Fn() -> f64,
    /// What either must exceed.
    pub threshold: f64,
    /// Whether it is believed.
    pub believed: bool,
}

/// Watches a diagnosis. It never steers it, but may end it: by giving the work up, and by unwinding.
pub trait ProgressListener: Sync {
    /// The work begins; it may be [given up](Work::give_up), after which it ends soon.
    fn begins(&self, _work: &Arc<Work>) {}
    /// A stage begins.
    fn stage(&self, _stage: Stage) {}
    /// A candidate of a round was fitted.
    fn tried(&self, _kind: &str, _expression: &str, _evidence: &evidence::Evidence) {}
    /// The best of a round, one candidate or two, was weighed.
    fn weighed(&self, _weighed: &Weighed<'_>) {}
    /// The score test's ranking: kind and share of the residual that it may explain.
    fn screened(&self, _ranking: &[(&str, f64)]) {}
    /// A mechanism no longer pays and was dropped.
    fn dropped(&self, _kind: &str) {}
}

/// A listener that does nothing.
pub struct Quiet;
impl ProgressListener for Quiet {}
