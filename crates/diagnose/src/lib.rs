//! Finds the physics a simulation leaves out.
pub mod along;
pub mod candidate;
pub mod diagnosis;
pub mod evidence;
pub mod library;
pub mod locate;
pub mod place;
pub mod screen;
pub mod spectra;
pub mod search;
pub mod surface;

pub use diagnosis::{Calibration, DiagnoseError, Diagnosis, Estimate, Options, Verdict, calibrate, diagnose};
pub use library::{Mechanism, MechanismError, built_in};

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
    /// Simulating whole recordings.
    Simulating,
}

/// Watches a diagnosis; never steers it.
pub trait Observer: Sync {
    /// A stage begins.
    fn stage(&self, _stage: Stage) {}
    /// The best candidate of a round was weighed.
    fn weighed(&self, _kind: &str, _evidence: &evidence::Evidence, _share: f64) {}
    /// A mechanism no longer pays and was dropped.
    fn dropped(&self, _kind: &str) {}
}

/// An observer that does nothing.
pub struct Quiet;
impl Observer for Quiet {}
