//! What to identify: the states, the inputs, the candidate terms and the limits of the search.

use greybox_model::Hold;

use crate::library::{Library, Monomials};

/// What to identify.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Channels that are the coordinates; one equation each.
    pub states: Vec<String>,
    /// Channels that drive the machine. Which of them enters which equation is part of the choice where there are
    /// several states or inputs. The first that an equation has stands on its right with factor one, the others enter
    /// as terms. An equation without any is divided by its leading coefficient. With a delayed feedback every equation
    /// has the first input on its right.
    pub inputs: Vec<String>,
    /// Order of the leading derivative of every state: 2 for mechanics (q̈), 1 for a current or a temperature.
    pub derivatives: Vec<usize>,
    /// The candidate terms.
    pub library: Library,
    /// Orders of the library to search, from 1 to this.
    pub order: usize,
    /// What the inputs do between samples; none: found from the recordings.
    pub hold: Option<Hold>,
    /// A delayed feedback of a state.
    pub delay: Option<DelayedState>,
    /// Inputs that act late, each by a dead time of its own.
    pub dead_times: Vec<DeadTime>,
    /// Replicates of the block bootstrap behind the inclusion probabilities.
    pub replicates: usize,
    /// Seed of the bootstrap.
    pub seed: u64,
    /// Work of the fits ([`greybox_calibrate::Work`]) after which nothing more is tried.
    pub work: u64,
}

/// The usual limit of the work.
pub const MOST_WORK: u64 = 80_000_000_000;

impl Options {
    /// The usual request: second order, polynomials up to order 6 for one state, up to 4 for several.
    pub fn new(states: &[&str], inputs: &[&str]) -> Options {
        let several = states.len() > 1;
        let monomials = if several { Monomials::Separate } else { Monomials::Tensor };
        Options {
            states: states.iter().map(|s| (*s).to_string()).collect(),
            inputs: inputs.iter().map(|s| (*s).to_string()).collect(),
            derivatives: vec![2; states.len()],
            library: Library { monomials, ..Library::default() },
            order: if several { 4 } else { 6 },
            hold: None,
            delay: None,
            dead_times: Vec::new(),
            replicates: 100,
            seed: 0,
            work: MOST_WORK,
        }
    }
}

impl Options {
    /// Whether equations share the coefficients of energies, and so have one scale.
    pub(crate) fn has_one_scale(&self) -> bool {
        self.library.lagrangian && self.states.len() > 1
    }
}

/// A feedback k_p q(t − τ) that is added to the first input, on the right side of every equation (thesis Eq 3.3).
#[derive(Debug, Clone, PartialEq)]
pub struct DelayedState {
    /// The state.
    pub state: String,
    /// The gain k_p where it is known.
    pub gain: Option<f64>,
    /// Longest delay looked for, s.
    pub longest: f64,
}

/// The dead time τ ≥ 0 of an input: every equation that the input u enters has u(t − τ).
#[derive(Debug, Clone, PartialEq)]
pub struct DeadTime {
    /// The input.
    pub input: String,
    /// Longest τ looked for, s; none: a typical oscillation of the states, at most a tenth of the longest stretch without
    /// a gap.
    pub longest: Option<f64>,
}
