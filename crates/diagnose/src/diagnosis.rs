//! A finished diagnosis, and what one asks for.

use std::sync::Arc;

use greybox_calibrate::{Criterion, Data, DataError, FreeRun, HoldoutSource, Score, SetupError};
use greybox_model::{Hold, Model};

use crate::candidate::Instance;
use crate::evidence::Evidence;
use crate::library::{Excitation, Mechanism, MechanismError};
use crate::locate::Location;
use crate::place::Place;
use crate::proposal::{Proposal, Rejected};
use crate::search::MOST_WORK;

/// What may be chosen.
#[derive(Debug, Clone)]
pub struct Options {
    /// Seed, echoed into the report. (Nothing in the present algorithm is random.)
    pub seed: u64,
    /// Mechanisms instead of the built-in library.
    pub library: Option<Vec<Mechanism>>,
    /// Work of the search ([`greybox_calibrate::Work`]) after which it looks for nothing more.
    pub work: u64,
    /// Identify what is missing as a sum of terms and name nothing: a law with a name is a term like the others.
    pub terms_only: bool,
}

impl Default for Options {
    fn default() -> Options {
        Options { seed: 0, library: None, work: MOST_WORK, terms_only: false }
    }
}

/// Why a diagnosis could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DiagnoseError {
    /// The recordings do not fit the model.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The model does not compile, or cannot be simulated.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// A mechanism file is wrong.
    #[error(transparent)]
    Mechanism(#[from] MechanismError),
    /// No recording to learn from.
    #[error("no training recording: name at least one CSV file")]
    NoTraining,
    /// Too little data.
    #[error("{file}: only {found} samples to learn from; a diagnosis needs at least {needed}. Record longer")]
    TooShort {
        /// File.
        file: String,
        /// Samples there are.
        found: usize,
        /// Samples needed.
        needed: usize,
    },
    /// No measured channel moves.
    #[error(
        "{file}: no measured channel ever moves ({channels}): there is nothing to learn from. Excite the machine, and check that the sensors were connected"
    )]
    Still {
        /// File.
        file: String,
        /// The channels.
        channels: String,
    },
    /// The simulation leaves every bound at once and cannot be calibrated.
    #[error(
        "{file}: the simulation of the model diverges within the first samples, whatever its parameters. Check that no inertia is zero, nothing is divided by zero and no equation follows from the others, and the signs and units of the equations"
    )]
    Diverges {
        /// File.
        file: String,
    },
}

/// The answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing beyond noise is missing once the parameters are calibrated.
    Consistent,
    /// Physics is missing and named.
    MissingPhysics,
    /// Something is missing that no mechanism explains.
    Unexplained,
}

/// What the improved model rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Basis {
    /// Mechanisms that are believed.
    Named,
    /// Mechanisms that are believed, and beside them some that stand in for something without a name.
    NamedAndProposed,
    /// Mechanisms that predict data they were not fitted to, and that stand in for something without a name.
    Proposed,
    /// The given equations, refitted.
    Calibrated,
}

/// A value with its 95 % interval, SI.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Value.
    pub value: f64,
    /// Lower and upper end; `None` for a parameter known exactly.
    pub ci95: Option<(f64, f64)>,
}

/// A parameter of the nominal model before and after.
#[derive(Debug, Clone)]
pub struct ParameterChange {
    /// Index in the model.
    pub index: usize,
    /// As given.
    pub nominal: f64,
    /// In the calibrated model.
    pub calibrated: Estimate,
    /// In the improved model.
    pub improved: Estimate,
}

/// Another explanation.
#[derive(Debug, Clone)]
pub struct Alternative {
    /// Kind.
    pub kind: String,
    /// Its probability beside the named mechanism.
    pub confidence: f64,
    /// The data cannot separate them.
    pub equivalent: bool,
    /// Its law.
    pub expression: String,
    /// The recording that would.
    pub separate: String,
    /// How that drives the machine, if its law states it.
    pub excitation: Option<Excitation>,
    /// Where it would act.
    pub site: Site,
}

/// Where a mechanism acts, in the names of the model. Several channels, or several equations of one that acts on whole
/// equations, are meant together.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Site {
    /// Equations, the one that the report names first.
    pub equations: Vec<String>,
    /// Channels, for faults of sensors.
    pub channels: Vec<String>,
    /// Input, for a fault of the actuation.
    pub input: Option<String>,
    /// Parameter, for one that drifts.
    pub drifting: Option<String>,
}

impl Site {
    /// Of places that are meant together.
    pub(crate) fn of(places: &[Place], model: &Model) -> Site {
        let mut site = Site::default();
        for place in places {
            for name in place.equations(model) {
                if !site.equations.contains(&name) {
                    site.equations.push(name);
                }
            }
            match place {
                Place::Measurement(c) => site.channels.push(model.measurements[*c].channel.clone()),
                Place::Input(u) => site.input = Some(model.inputs[*u].name.clone()),
                Place::Parameter(p) => site.drifting = Some(model.parameters[*p].name.clone()),
                _ => {}
            }
        }
        site
    }

    /// Whether a reader takes the two for one place.
    pub(crate) fn is(&self, other: &Site) -> bool {
        let sorted = |names: &[String]| {
            let mut names = names.to_vec();
            names.sort();
            names
        };
        sorted(&self.equations) == sorted(&other.equations)
            && sorted(&self.channels) == sorted(&other.channels)
            && self.input == other.input
            && self.drifting == other.drifting
    }
}

/// A mechanism that was found.
#[derive(Debug, Clone)]
pub struct IdentifiedMechanism {
    /// Kind.
    pub kind: String,
    /// Family of the kind.
    pub family: String,
    /// What it looks like.
    pub signature: String,
    /// How an experiment that tells it from its alternatives drives the machine, if its law states it.
    pub excitation: Option<Excitation>,
    /// Names of the equations it enters.
    pub equations: Vec<String>,
    /// Channel, for a fault of a sensor.
    pub channel: Option<String>,
    /// Input, for a fault of the actuation.
    pub input: Option<String>,
    /// Parameter, for one that drifts.
    pub drifting: Option<String>,
    /// The law in the model's names.
    pub expression: String,
    /// Its own states: name, equation.
    pub states: Vec<(String, String)>,
    /// Parameters: name in the report, index in the improved model, estimate.
    pub parameters: Vec<(String, usize, Estimate)>,
    /// Further figures that follow from the parameters (a resonance frequency, Hz): name, estimate.
    pub figures: Vec<(String, Estimate)>,
    /// Its part of the calibrated model's misfit; all parts add up to what all explain.
    pub share_explained: f64,
    /// Probability among the explanations tried.
    pub confidence: f64,
    /// Others.
    pub alternatives: Vec<Alternative>,
    /// Where it acts.
    pub location: Location,
    /// Evidence when it was accepted.
    pub evidence: Evidence,
    /// Its law against the residual: variable, and per training sample (variable, residual force,
    /// law's force).
    pub curve: Option<Curve>,
}

impl IdentifiedMechanism {
    /// As it stands in the model that is handed back, where that is not the one that was fitted.
    pub(crate) fn stands_as(&mut self, instance: &Instance, model: &Model, is_shape: bool) {
        let at = |name: &String| model.parameter(name);
        if is_shape {
            self.expression = instance.expression.to_string();
            let known = |i: usize| Estimate { value: model.parameters[i].value, ci95: None };
            let own = instance.names.iter().filter_map(|name| Some((name.clone(), at(name)?)));
            self.parameters = own.map(|(name, i)| (name, i, known(i))).collect();
        } else {
            for (name, index, _) in &mut self.parameters {
                *index = at(name).unwrap_or(*index);
            }
        }
    }
}

/// A law beside the force that the rest of the model leaves over.
#[derive(Debug, Clone)]
pub struct Curve {
    /// Expression of the variable.
    pub variable: String,
    /// (variable, force left over by the improved model without this mechanism), SI.
    pub points: Vec<(f64, f64)>,
    /// (variable, force of the law), sorted, SI.
    pub law: Vec<(f64, f64)>,
}

/// What is still unexplained.
#[derive(Debug, Clone)]
pub struct Remainder {
    /// Whether free shapes still predict the residual.
    pub significant: bool,
    /// Where.
    pub location: Location,
    /// What free shapes still explain on data they have not seen, as a share of the calibrated model's
    /// residual.
    pub share_of_residual: f64,
    /// A sentence on its shape.
    pub shape: Option<String>,
}

/// Free runs and scores of one model on one role's recordings.
#[derive(Debug, Clone)]
pub struct Run {
    /// Simulated outputs.
    pub run: FreeRun,
    /// Scores over all recordings, per channel.
    pub scores: Vec<Score>,
    /// Scores per recording, per channel.
    pub by_recording: Vec<Vec<Score>>,
}

/// The three models on one role's recordings.
#[derive(Debug)]
pub struct Role {
    /// The data.
    pub data: Arc<Data>,
    /// The model as given.
    pub nominal: Run,
    /// The same equations, refitted.
    pub calibrated: Run,
    /// With the mechanisms.
    pub improved: Run,
}

/// Some of the mechanisms, and what the model with these alone leaves.
#[derive(Debug, Clone, PartialEq)]
pub struct Subset {
    /// Indices into [`Diagnosis::mechanisms`], rising.
    pub mechanisms: Vec<usize>,
    /// Residual sum of squares, noise included, over that of the calibrated model; its parameters refitted.
    pub left: f64,
}

/// Everything a report needs.
#[derive(Debug)]
pub struct Diagnosis {
    /// Verdict.
    pub verdict: Verdict,
    /// What is missing was identified as terms ([`Options::terms_only`]).
    pub terms_only: bool,
    /// As given.
    pub nominal: Model,
    /// Refitted.
    pub calibrated: Model,
    /// The best simulation that can be defended, whatever the verdict.
    pub improved: Model,
    /// What `improved` rests on.
    pub basis: Basis,
    /// By which figure simulations are judged: windowed where free runs of the training or the held-out recordings
    /// cannot tell.
    pub criterion: Criterion,
    /// Mechanisms, largest share first.
    pub mechanisms: Vec<IdentifiedMechanism>,
    /// What `improved` holds that is not believed to be what is missing, largest share first.
    pub candidates: Vec<IdentifiedMechanism>,
    /// How far the candidates can be trusted; `None` where there are none.
    pub proposal: Option<Proposal>,
    /// The closure that was tried and is not handed back; `None` where none was found, or it is.
    pub rejected: Option<Rejected>,
    /// What fewer of several mechanisms would leave: none, each alone, all but one, all. Empty where there is one, or none.
    pub subsets: Vec<Subset>,
    /// Remainder.
    pub remainder: Remainder,
    /// Parameters of the nominal model.
    pub parameters: Vec<ParameterChange>,
    /// Training recordings.
    pub train: Role,
    /// Held-out recordings.
    pub holdout: Role,
    /// Where the held-out data come from, in words.
    pub holdout_source: HoldoutSource,
    /// Window of the restarted simulations, s.
    pub window: f64,
    /// Noise over the spread of each channel, at most what the best of the models leaves.
    pub noise_floor: Vec<f64>,
    /// Channels whose noise the recordings do not tell: a model leaves less than their fast differences say.
    pub unknown_noise: Vec<usize>,
    /// Hold of each input: as given, and the better one.
    pub holds: Vec<(Hold, Hold)>,
    /// Whether the better hold mattered.
    pub better_holds: Vec<usize>,
    /// Seed.
    pub seed: u64,
    /// The search ended at its limit of work ([`Options::work`]), not because nothing more was to be found.
    pub limited: bool,
}
