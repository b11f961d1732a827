//! From recordings and a nominal model to the finished diagnosis.

use std::cell::{LazyCell, OnceCell};
use std::ops::Deref;
use std::sync::Arc;

use greybox_calibrate::{
    Criterion, Data, DataError, Ending, Fit, FreeRun, Horizon, Limits, Point, Score, Segmentation, Setup,
    SetupError, Work, free_parameters, window_length, window_of,
};
use greybox_model::{Expr, Func, Hold, Model};
use greybox_recording::Recording;
use rayon::prelude::*;

use crate::candidate::{Candidate, Instance};
use crate::closure::Visited;
use crate::discrepancy::{Discrepancy, held_out};
use crate::evidence::{Evidence, cross_validation_improvement, effective_sample_ratio};
use crate::library::{Mechanism, MechanismError, built_in};
use crate::locate::{Location, force, locate};
use crate::place::{Motion, Place};
use crate::plausibility::Deviation;
use crate::proposal::{Gate, Proposal, Rejected};
use crate::search::{
    FittedModel, Found, MISFIT, MOST_WORK, MechanismTerm, Rival, Search, UNDECIDED, log_likelihood_gain,
    raw_rms, raw_rss, rms,
};
use crate::shapes::Variable;
use crate::trajectory::TrajectoryEval;
use crate::twins::{Twin, twins};
use crate::uncertainty::Uncertainty;
use crate::validate::Gain;
use crate::{ProgressListener, Stage};

/// Share of each recording held out when no recording is.
pub const HELD_OUT_SHARE: f64 = 0.2;

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
    fn of(places: &[Place], model: &Model) -> Site {
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
    fn is(&self, other: &Site) -> bool {
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

/// Equivalents first, then the likelier.
fn rank(alternatives: &mut [Alternative]) {
    alternatives.sort_by(|a, b| b.equivalent.cmp(&a.equivalent).then(b.confidence.total_cmp(&a.confidence)));
}

/// One entry per kind and place, the likeliest, and none that is the finding itself under its own name: those that the
/// data cannot separate first.
fn distinct(mut alternatives: Vec<Alternative>, kind: &str, site: &Site) -> Vec<Alternative> {
    rank(&mut alternatives);
    let mut out: Vec<Alternative> = Vec::new();
    for a in alternatives {
        let known = (a.kind == kind && a.site.is(site))
            || out.iter().any(|other| other.kind == a.kind && other.site.is(&a.site));
        if !known {
            out.push(a);
        }
    }
    out
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
    fn stands_as(&mut self, instance: &Instance, model: &Model, is_shape: bool) {
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
    pub holdout_source: String,
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

/// Diagnoses a model.
///
/// # Errors
/// [`DiagnoseError`] when the recordings do not fit the model or hold too little data.
pub fn diagnose(
    model: &Model,
    train: &[Recording],
    holdout: &[Recording],
    options: &Options,
    listener: &dyn ProgressListener,
) -> Result<Diagnosis, DiagnoseError> {
    let library = match &options.library {
        Some(library) => library.clone(),
        None => built_in()?,
    };
    let Layout { train, holdout, source } = layout(model, train, holdout)?;
    let laid_out = Setup::new(model, train.clone(), free_parameters(model))?;
    let nominal = Setup { work: Arc::new(Work::of_fits_within(options.work)), ..laid_out };
    listener.begins(&nominal.work);
    let mut search = Search::new(nominal.clone(), &library, listener);
    search.most_work = options.work;
    let found = match options.terms_only {
        true => alone(&nominal, false, options.work, listener),
        false => search.run(),
    };
    conclude(&nominal, holdout, source, &library, &search, found, options, listener)
}

/// Training and held-out data.
pub struct Layout {
    /// Training.
    pub train: Arc<Data>,
    /// Held out.
    pub holdout: Arc<Data>,
    /// Where the held-out data come from.
    pub source: String,
}

/// Lays the recordings out, holding out the last fifth of each when none is held out.
///
/// # Errors
/// As [`diagnose`].
pub fn layout(model: &Model, train: &[Recording], holdout: &[Recording]) -> Result<Layout, DiagnoseError> {
    if train.is_empty() {
        return Err(DiagnoseError::NoTraining);
    }
    // The whole recordings first: errors name them as they are.
    let whole = Data::new(model, train)?;
    let needed =
        4 * model.states.iter().map(|s| s.order).sum::<usize>() + 4 * model.parameters.len().min(8) + 8;
    let found = whole.samples();
    if found < needed {
        return Err(DiagnoseError::TooShort { file: whole.recordings.join(", "), found, needed });
    }
    if whole.spread.iter().all(|s| s.is_nan() || *s <= 0.0) {
        let channels: Vec<String> = whole.channels.iter().map(|c| format!("`{}`", c.name)).collect();
        return Err(DiagnoseError::Still {
            file: whole.recordings.join(", "),
            channels: channels.join(", "),
        });
    }
    if holdout.is_empty() {
        let (head, tail) = Data::split_tail(train, HELD_OUT_SHARE);
        if !head.is_empty() {
            return Ok(Layout {
                train: Arc::new(Data::new(model, &head)?),
                holdout: Arc::new(Data::new(model, &tail)?),
                source: "the last fifth of each recording".to_string(),
            });
        }
    }
    let held = Data::new(model, if holdout.is_empty() { train } else { holdout })?;
    let source = if holdout.is_empty() {
        "none: the recordings are too short to hold anything out; these are the training figures".to_string()
    } else {
        format!("recordings held out: {}", held.recordings.join(", "))
    };
    Ok(Layout { train: Arc::new(whole), holdout: Arc::new(held), source })
}

/// Sees that one of the runs goes beyond the first samples.
fn follows<const N: usize>(runs: [&FreeRun; N], data: &Data) -> Result<(), DiagnoseError> {
    match runs.iter().all(|run| run.is_lost()) {
        true => Err(DiagnoseError::Diverges { file: data.recordings.join(", ") }),
        false => Ok(()),
    }
}

fn conclude(
    nominal: &Setup,
    holdout: Arc<Data>,
    holdout_source: String,
    library: &[Mechanism],
    search: &Search<'_>,
    found: Found,
    options: &Options,
    listener: &dyn ProgressListener,
) -> Result<Diagnosis, DiagnoseError> {
    let train = nominal.data.clone();
    listener.stage(Stage::Simulating);
    // The model that fits best knows best how errors grow.
    let judge = Judge::of(&found.improved, &residual_scale(&found.improved, &found.scale));
    let window = judge.window;
    let values = nominal.values();
    // The search fits the baseline with a scale that its mechanisms made small, and only where it goes on with it. What is
    // compared with is the best that the equations can do alone.
    let has_parts = !found.improved.parts.is_empty();
    let alone = has_parts.then(|| alone(nominal, false, options.work, &WorkOnlyListener(listener)));
    let baseline_of = |found: &Found| Baseline::of(found, &values, &judge);
    let (mut baseline, (alone, polished)) = rayon::join(
        || baseline_of(&found),
        || {
            rayon::join(
                || alone.as_ref().map(|alone| (alone.limited, baseline_of(alone))),
                || has_parts.then(|| polish(&found.improved, &found.scale, &judge)),
            )
        },
    );
    let mut limited = found.limited;
    let mut found = found;
    // What no round believed may still be what the equations lack: where the noise does not explain the rest, it is
    // held against data that it was not fitted to.
    let mut named = true;
    let mut proposed = None;
    if found.improved.parts.is_empty() && baseline.polished.fitted.misfit(&found.scale) > MISFIT {
        for rejected in std::mem::take(&mut found.rejected).into_iter().rev() {
            found.improved = rejected;
            let polished = polish(&found.improved, &found.scale, &judge);
            let polished = defend(search, &mut found, polished, &baseline, &judge, false);
            if !polished.fitted.parts.is_empty() {
                (named, proposed) = (false, Some(polished));
                break;
            }
        }
    }
    let mut polished = if let Some(proposed) = proposed {
        proposed
    } else if let (Some((is_limited, alone)), Some(polished)) = (alone, polished) {
        limited |= is_limited;
        if alone.misfit.total_cmp(&baseline.misfit).is_lt() {
            baseline = alone;
        }
        defend(search, &mut found, polished, &baseline, &judge, true)
    } else {
        baseline.polished.clone()
    };
    let judged_of = |found: &Found, polished: &WholeRecordFit, named: &dyn Fn(&MechanismTerm) -> bool| {
        let scale = residual_scale(&polished.fitted, &found.scale);
        Judged::of(search, found, &polished.fitted, &scale, (&baseline.polished.fitted, named), library)
    };
    let scale = residual_scale(&polished.fitted, &found.scale);
    let scores = judge.scores(&polished.fitted.setup, &polished.fitted.fit.point.parameters, &scale);
    let mut judged = judged_of(&found, &polished, &|_| named);
    // Where more than noise is left, every model of the machine errs, and output errors do not compare them.
    let errs = !leaves_noise(&scores, &polished.origin, &scale);
    let names = judged.verdict == Verdict::MissingPhysics;
    let agreed: Vec<_> = match errs && names {
        true => polished.fitted.parts.iter().map(|p| named_as(p, library, &nominal.model)).collect(),
        false => Vec::new(),
    };
    // Of laws that are not believed together those stand that another comparison has named.
    let believed = |judged: &Judged, found: &Found, fitted: &FittedModel| -> Vec<bool> {
        let all = judged.verdict == Verdict::MissingPhysics;
        let stands =
            |part: &MechanismTerm| found.errs && agreed.contains(&named_as(part, library, &nominal.model));
        let parts = fitted.parts.iter().zip(&judged.named);
        parts.map(|(part, named)| (all && *named) || stands(part)).collect()
    };
    let mut rejected = None;
    // (What passes for coloured noise may hold what no name explains.)
    let unnamed = polished.fitted.parts.is_empty();
    if errs || judged.verdict == Verdict::Unexplained || unnamed && judged.left.significant(0) {
        let closed = Closed::of(search, &found, &polished, &baseline, &judge);
        // What reaches the noise leaves no error of the model to be believed beside.
        if errs && !options.terms_only && !closed.as_ref().is_ok_and(|closed| closed.leaves_noise) {
            let in_both = |part: &MechanismTerm| agreed.contains(&named_as(part, library, &nominal.model));
            let standing = (&found, &polished);
            let explored = explored(search, standing, in_both, names, &baseline, &judge);
            if let Some(Explored { found: other, polished: simulates, named }) = explored {
                judged = judged_of(&other, &simulates, &|part| named.contains(&part.candidate));
                (found, polished) = (other, simulates);
            }
        }
        rejected = match closed {
            Err(failed) => failed,
            Ok(closed) => {
                let standing = believed(&judged, &found, &polished.fitted);
                let standing = polished.fitted.parts.iter().zip(standing).filter(|part| part.1);
                let standing: Vec<&Candidate> = standing.map(|(part, _)| &part.candidate).collect();
                if !closed.outdoes((&found, &polished), !standing.is_empty(), &judge) {
                    Some(Rejected::at(Gate::Comparison, search, &closed.polished.fitted))
                } else if let Some(named) = closed.names(search, &standing) {
                    let Closed { found: other, polished: simulates, .. } = closed;
                    judged = judged_of(&other, &simulates, &|part| named.contains(&part.candidate));
                    (found, polished) = (other, simulates);
                    None
                } else {
                    Some(Rejected::at(Gate::Names, search, &closed.polished.fitted))
                }
            }
        };
        limited |= found.limited;
    }
    let WholeRecordFit { fitted: improved, origin } = &polished;
    let scale = residual_scale(improved, &found.scale);
    let Baseline {
        polished: WholeRecordFit { fitted: calibrated, origin: own },
        scale: calibrated_scale,
        ..
    } = &baseline;
    let calibrated_widths = Uncertainty::of(own, calibrated_scale).widths();
    let uncertainty = Uncertainty::of(origin, &scale);
    let improved_widths = uncertainty.widths();
    let value_of = |f: &FittedModel, widths: &[f64], index: usize| {
        let value = f.fit.point.parameters[index];
        let width = f.setup.free.iter().position(|x| x.index == index).map(|i| widths[i]);
        Estimate { value, ci95: width.map(|w| (value - w, value + w)) }
    };
    let final_model = |f: &FittedModel| {
        let mut model = f.setup.model.clone();
        for (p, v) in model.parameters.iter_mut().zip(&f.fit.point.parameters) {
            p.value = *v;
        }
        // The mechanisms' units follow from the equations they enter.
        let _ = model.resolve_units();
        model
    };
    let calibrated_model = final_model(calibrated);
    let (improved_model, instances) = match search.tabulated(improved) {
        Some((model, instances)) => (model, Some(instances)),
        None => (final_model(improved), None),
    };
    let parameters: Vec<ParameterChange> = (0..nominal.model.parameters.len())
        .map(|i| ParameterChange {
            index: i,
            nominal: nominal.model.parameters[i].value,
            calibrated: value_of(calibrated, &calibrated_widths, i),
            improved: value_of(improved, &improved_widths, i),
        })
        .collect();

    // Free runs.
    let role = |data: &Arc<Data>, held: bool| -> Role {
        let run = |f: &Setup, parameters: &[f64], scale: &[f64]| -> Run {
            let fine: Vec<f64> = scale.iter().map(|s| 0.02 * s).collect();
            let setup = match held {
                true => f.for_simulations_of(data.clone(), parameters, &fine),
                false => f.clone(),
            };
            let run = match held {
                true => setup.free_run(parameters, scale),
                false => setup.training_run(parameters, scale),
            };
            let scores = setup.scores(&run, parameters, window, None);
            let by_recording =
                (0..data.recordings.len()).map(|r| setup.scores(&run, parameters, window, Some(r))).collect();
            Run { run, scores, by_recording }
        };
        let nominal_scale: Vec<f64> = data.spread.iter().map(|s| s.max(1e-300)).collect();
        Role {
            data: data.clone(),
            nominal: run(nominal, &nominal.values(), &nominal_scale),
            calibrated: run(&calibrated.setup, &calibrated.fit.point.parameters, calibrated_scale),
            improved: run(&improved.setup, &improved.fit.point.parameters, &scale),
        }
    };
    let train_role = role(&train, false);
    follows([&train_role.calibrated.run, &train_role.improved.run], &train)?;
    let holdout_role = role(&holdout, true);

    // The machine may be predictable where it was recorded to learn from, and not where it is held out.
    let held = improved.setup.for_simulations_of(holdout.clone(), &improved.fit.point.parameters, &scale);
    let (elsewhere, _) = held.criterion(&improved.fit.point.parameters, &scale);
    let criterion = if elsewhere == Criterion::Windowed { elsewhere } else { judge.criterion };

    // Mechanisms, remainder, verdict.
    let believed = believed(&judged, &found, improved);
    let verdict = if believed.contains(&true) { Verdict::MissingPhysics } else { judged.verdict };
    let Judged { shares, left, discrepancy, alone, without, full, base, doubts, .. } = judged;
    let share = |rss: f64| (rss / base.max(1e-300)).clamp(0.0, 1.0);
    let significant = found.errs || left.significant(improved.parts.len()) || verdict == Verdict::Unexplained;
    let mut mechanisms =
        findings(improved, &found, &nominal.model, library, &scale, &shares, &train_role, &uncertainty);
    if let Some(instances) = &instances {
        improved.parts.iter().zip(instances).zip(&mut mechanisms).for_each(|((part, instance), finding)| {
            let mechanism = &library[part.candidate.mechanism];
            finding.stands_as(instance, &improved_model, mechanism.shape.is_some());
        });
    }
    let outdone = outdone(search, &found, verdict);
    let mut subsets = Vec::new();
    if verdict == Verdict::MissingPhysics && believed.iter().all(|b| *b) && !found.closed {
        subsets = subsets_of(
            &shares,
            [&alone, &without].map(|rss| rss.iter().copied().map(share).collect()),
            share(full),
        );
    }
    for (i, m) in mechanisms.iter_mut().enumerate() {
        // What is still missing may be what was taken for this.
        if significant
            || doubts[i].is_some_and(|d| d > -UNDECIDED)
            || outdone[i].is_some()
            || is_shared(improved, &shares, i)
            || is_crowded(improved, &shares, i, &nominal.model)
        {
            m.confidence = m.confidence.min(DOUBTED);
            m.alternatives.iter_mut().for_each(|a| a.confidence = a.confidence.min(DOUBTED));
        }
        if let Some(law) = &outdone[i] {
            let place = &law.candidate.place;
            let mechanism = &library[law.candidate.mechanism];
            m.alternatives.push(Alternative {
                kind: mechanism.kind.clone(),
                confidence: 1.0 - DOUBTED,
                equivalent: false,
                expression: law.instance.expression.to_string(),
                separate: mechanism.separate(place.moves(&nominal.model)).to_string(),
                site: Site::of(std::slice::from_ref(place), &nominal.model),
            });
            rank(&mut m.alternatives);
        }
    }
    let proposal = believed.contains(&false).then(|| {
        let parameters = &improved.fit.point.parameters;
        let along = TrajectoryEval::simulated(&improved.setup, &train_role.improved.run.x, parameters);
        let held_out = TrajectoryEval::simulated(&held, &holdout_role.improved.run.x, parameters);
        let proposed = improved.parts.iter().zip(&believed).filter(|part| !part.1);
        let proposed: Vec<&MechanismTerm> = proposed.map(|(part, _)| part).collect();
        let errors = (baseline.errors(&judge), &judge.errors(&polished, &scale)[..]);
        Proposal::of(improved, &proposed, library, (&along, &held_out), errors, &uncertainty)
    });
    let mut mechanisms: Vec<(IdentifiedMechanism, bool)> = mechanisms.into_iter().zip(believed).collect();
    mechanisms.sort_by(|a, b| b.0.share_explained.total_cmp(&a.0.share_explained));
    let unexplained = verdict != Verdict::MissingPhysics && !improved.parts.is_empty();
    // What is not believed explains nothing: all that the equations lack is what is missing. (Where too little is
    // known of the noise for that, what those mechanisms leave over shows the place.)
    let lacks = if unexplained { self::discrepancy(calibrated, calibrated_scale) } else { None };
    let remainder = match lacks {
        Some(lacks) => remainder(calibrated, Some(lacks), significant, 1.0),
        None => {
            let all = if unexplained { share(base - full) } else { 0.0 };
            // What a closure leaves shows nothing of what it models: that has the closure's own variable.
            let own = if unexplained && found.closed { only_variable(improved, library) } else { None };
            let discrepancy = discrepancy.map(|left| match own {
                Some(variable) => Discrepancy { variable: Some((variable, left.gain)), ..left },
                None => left,
            });
            let left = remainder(improved, discrepancy, significant, share(full));
            Remainder { share_of_residual: (all + left.share_of_residual).min(1.0), ..left }
        }
    };
    // No model beats the noise: where one is below what fast differences say, they saw more than noise.
    let models = [&train_role.nominal, &train_role.calibrated, &train_role.improved];
    let reached = |c: usize| models.iter().map(|run| run.scores[c].nrmse).fold(f64::INFINITY, f64::min);
    let estimated: Vec<f64> = train.sigma.iter().zip(&train.spread).map(|(s, d)| s / d.max(1e-300)).collect();
    let noise_floor = estimated.iter().enumerate().map(|(c, &floor)| floor.min(reached(c))).collect();
    let unknown_noise = (0..estimated.len()).filter(|&c| reached(c) < BELOW_NOISE * estimated[c]).collect();
    let holds = nominal.holds.iter().copied().zip(improved.setup.holds.iter().copied()).collect();
    // What no name reaches is proposed without one: it predicts data that it was not fitted to.
    let (named, proposed): (Vec<_>, Vec<_>) = mechanisms.into_iter().partition(|m| m.1);
    let [mechanisms, candidates] =
        [named, proposed].map(|of| of.into_iter().map(|m| m.0).collect::<Vec<_>>());
    let (basis, mechanisms, candidates) = match verdict {
        Verdict::MissingPhysics if candidates.is_empty() => (Basis::Named, mechanisms, candidates),
        Verdict::MissingPhysics => (Basis::NamedAndProposed, mechanisms, candidates),
        _ if candidates.is_empty() => (Basis::Calibrated, Vec::new(), candidates),
        _ => (Basis::Proposed, Vec::new(), candidates),
    };
    Ok(Diagnosis {
        verdict,
        terms_only: options.terms_only,
        basis,
        criterion,
        nominal: nominal.model.clone(),
        improved: improved_model,
        calibrated: calibrated_model,
        mechanisms,
        candidates,
        proposal,
        rejected,
        subsets,
        remainder,
        parameters,
        train: train_role,
        holdout: holdout_role,
        holdout_source,
        window,
        noise_floor,
        unknown_noise,
        holds,
        better_holds: found.better_holds.iter().map(|b| b.0).collect(),
        seed: options.seed,
        limited,
    })
}

/// For each part that is named, the law without a name that does its work, or that of all parts together, better. (Beside an
/// error of the model and in a closure, such laws were among the candidates.)
fn outdone(search: &Search<'_>, found: &Found, verdict: Verdict) -> Vec<Option<MechanismTerm>> {
    let parts: Vec<usize> = (0..found.improved.parts.len()).collect();
    if verdict != Verdict::MissingPhysics || found.errs || found.closed {
        return vec![None; parts.len()];
    }
    let outdoes = |parts: &[usize]| {
        let (above, law) = search.unnamed_above(&found.improved, parts, &found.scale)?;
        (above > UNDECIDED).then_some(law)
    };
    let all = if parts.len() > 1 { outdoes(&parts) } else { None };
    parts.par_iter().map(|part| outdoes(&[*part]).or_else(|| all.clone())).collect()
}

/// The name of a part and the equations that it enters.
fn named_as(part: &MechanismTerm, library: &[Mechanism], nominal: &Model) -> (String, Vec<String>) {
    let kind = library[part.candidate.mechanism].kind.clone();
    (kind, part.candidate.place.equations(nominal))
}

/// What an improved model explains, and what it leaves.
struct Judged {
    verdict: Verdict,
    /// Whether each part is named, if the verdict allows.
    named: Vec<bool>,
    /// Share of the calibrated model's misfit that each part explains.
    shares: Vec<f64>,
    left: ResidualDiagnostics,
    discrepancy: Option<Discrepancy>,
    /// Residual sum of squares with each part alone, without each, with all, with none.
    alone: Vec<f64>,
    without: Vec<f64>,
    full: f64,
    base: f64,
    /// How far above each part the law is that casts doubt on it.
    doubts: Vec<Option<f64>>,
}

impl Judged {
    /// Of a model with a residual like `scale` beside a calibrated one; whether its parts are named.
    fn of(
        search: &Search<'_>,
        found: &Found,
        improved: &FittedModel,
        scale: &[f64],
        (calibrated, named): (&FittedModel, &dyn Fn(&MechanismTerm) -> bool),
        library: &[Mechanism],
    ) -> Judged {
        // Where nothing was found, what the search's own noise model leaves white.
        let discrepancy = if found.improved.parts.is_empty() && found.improved.setup.noise.is_some() {
            discrepancy(&found.improved, &found.scale)
        } else {
            discrepancy(improved, scale)
        };
        // Two refits, for those tests that need them.
        let comparable = LazyCell::new(|| search.comparable(found));
        let full: f64 = raw_rss(improved, &found.scale).iter().sum();
        let base = search.rss_at(calibrated, improved, &found.scale);
        let left = ResidualDiagnostics::of(improved, found, &comparable, discrepancy.as_ref(), base);
        let without: Vec<f64> = (0..improved.parts.len())
            .into_par_iter()
            .map(|i| search.rss_without(improved, &[i], calibrated, &found.scale).unwrap_or(base))
            .collect();
        let share = |rss: f64| (rss / base.max(1e-300)).clamp(0.0, 1.0);
        let alone = rss_alone(search, (calibrated, improved), &found.scale, &without, base);
        let lost: Vec<f64> = without.iter().map(|rss| share(rss - full)).collect();
        let gained: Vec<f64> = alone.iter().map(|rss| share(base - rss)).collect();
        let shares = divided(&lost, &gained, share(base - full));
        // Two laws that share one work lose little each when the other takes over, and all together.
        let redundant = |a: usize, b: usize| {
            let both = search.rss_without(improved, &[a.max(b), a.min(b)], calibrated, &found.scale);
            let both = both.unwrap_or(base);
            (both - full) / base.max(1e-300) > REDUNDANT * (lost[a] + lost[b])
        };
        // A law that another one, which the library has no name for, stands in for.
        let doubts: Vec<Option<f64>> = (0..improved.parts.len())
            .into_par_iter()
            .map(|i| match found.errs || found.closed {
                true => None,
                false => search.doubt(&found.improved, i, &found.scale),
            })
            .collect();
        let beaten = |i: usize| doubts[i].is_some_and(|d| d > UNDECIDED);
        let is_imitation = (0..doubts.len()).any(|i| {
            beaten(i) && (lost[i] > CORRECTION || (0..doubts.len()).any(|j| i != j && redundant(i, j)))
        });
        let named: Vec<bool> = improved.parts.iter().map(named).collect();
        let by_name: f64 = shares.iter().zip(&named).filter(|s| *s.1).map(|s| s.0).sum();
        let is_series_expansion = || is_series_expansion(improved, &shares, library, left.steady, redundant);
        let verdict = match left.verdict(improved.parts.len()) {
            _ if !named.contains(&true) && !improved.parts.is_empty() => Verdict::Unexplained,
            // (The exploration has held free shapes against its laws.)
            _ if found.errs && (by_name < EXPLAINED || is_series_expansion()) => Verdict::Unexplained,
            // (Of a closure the names have been held against all other terms.)
            _ if found.errs || found.closed => Verdict::MissingPhysics,
            Verdict::MissingPhysics
                if is_imitation
                    || is_series_expansion()
                    || beaten_by_discrepancy(&comparable, &found.scale, library) =>
            {
                Verdict::Unexplained
            }
            verdict => verdict,
        };
        Judged { verdict, named, shares, left, discrepancy, alone, without, full, base, doubts }
    }
}

/// A closure that can be handed back, in the place of what stands.
struct Closed {
    found: Found,
    polished: WholeRecordFit,
    /// How its simulations of the training recordings are judged.
    misfit: f64,
    /// Whether they leave no more than noise.
    leaves_noise: bool,
}

impl Closed {
    /// The closure that begins with the calibrated model or, where that leaves more than noise and it simulates better, the one
    /// that begins with what stands. Where none passes the gates, the last that failed, if there was one at all.
    fn of(
        search: &Search<'_>,
        found: &Found,
        polished: &WholeRecordFit,
        baseline: &Baseline,
        judge: &Judge,
    ) -> Result<Closed, Option<Rejected>> {
        let mut from = vec![&found.calibrated];
        if !polished.fitted.parts.is_empty() {
            from.push(&found.improved);
        }
        let gates = Gates::of_a_closure(search, &polished.fitted, baseline, judge);
        let mut visited = Visited::default();
        let (mut best, mut rejected): (Option<Closed>, _) = (None, None);
        for from in from {
            let Some(closed) = search.closure(found, from, &mut visited) else { continue };
            let closed = match Closed::defended(search, closed, &gates, judge) {
                Ok(closed) => closed,
                Err(failed) => {
                    rejected = Some(failed);
                    continue;
                }
            };
            if best.as_ref().is_none_or(|best| closed.misfit.total_cmp(&best.misfit).is_lt()) {
                best = Some(closed);
            }
            // (There is no less than noise.)
            if best.as_ref().is_some_and(|best| best.leaves_noise) {
                break;
            }
        }
        let mut best = best.ok_or(rejected)?;
        best.found.accepted = search.accepted(found, &best.found);
        Ok(best)
    }

    /// A closure that passes all gates, without what whole recordings do not determine; else what fails, and where.
    fn defended(
        search: &Search<'_>,
        found: Found,
        gates: &Gates<'_>,
        judge: &Judge,
    ) -> Result<Closed, Rejected> {
        let mut found = found;
        loop {
            let polished = polish(&found.improved, &found.scale, judge);
            let Some(failure) = gates.failure(&polished, &found.scale) else {
                return Ok(Closed::new(found, polished, judge));
            };
            // Whole recordings may not tell what segments with free starts told.
            let smaller = match (failure.gate, &failure.parts[..]) {
                (Gate::Determined, [part]) => search.smaller(&found.improved, *part, &found.scale),
                _ => None,
            };
            match smaller {
                Some(smaller) if !smaller.parts.is_empty() => found.improved = smaller,
                _ => return Err(Rejected::at(failure.gate, search, &polished.fitted)),
            }
        }
    }

    fn new(found: Found, polished: WholeRecordFit, judge: &Judge) -> Closed {
        let fitted = &polished.fitted;
        let scale = residual_scale(fitted, &found.scale);
        let scores = judge.scores(&fitted.setup, &fitted.fit.point.parameters, &scale);
        let (misfit, leaves_noise) =
            (judge.criterion.misfit(&scores), leaves_noise(&scores, &polished.origin, &scale));
        Closed { found, polished, misfit, leaves_noise }
    }

    /// Whether it simulates the training recordings better than what stands, and predicts what was left out of its fit
    /// better: beyond chance where that has names, on the whole where it is a proposal as well.
    fn outdoes(&self, (found, polished): (&Found, &WholeRecordFit), has_names: bool, judge: &Judge) -> bool {
        let errors = |found: &Found, polished: &WholeRecordFit| {
            judge.errors(polished, &residual_scale(&polished.fitted, &found.scale))
        };
        let scale = residual_scale(&polished.fitted, &found.scale);
        let (setup, parameters) = (&polished.fitted.setup, &polished.fitted.fit.point.parameters);
        self.misfit.total_cmp(&judge.misfit(setup, parameters, &scale)).is_lt() && {
            let gain = Gain::of(&errors(found, polished), &errors(&self.found, &self.polished));
            if has_names { gain.is_beyond_chance() } else { gain.mean > 0.0 }
        }
    }

    /// Of the names that stand those that it holds and that no other terms can have the place of. `None` where it leaves
    /// more than noise and does not hold them all.
    fn names(&self, search: &Search<'_>, standing: &[&Candidate]) -> Option<Vec<Candidate>> {
        let parts = &self.polished.fitted.parts;
        let held: Vec<usize> =
            (0..parts.len()).filter(|&i| standing.contains(&&parts[i].candidate)).collect();
        (self.leaves_noise || held.len() == standing.len()).then(|| {
            let named = held.into_iter().filter(|&i| !search.is_replaceable(&self.found, i));
            named.map(|i| parts[i].candidate.clone()).collect()
        })
    }
}

/// What the exploration finds beside an error of the model, if it can be defended and says more than what stands. Where
/// nothing is named yet, it names laws or simulates better. Where laws are named, it has one of them (`agreed`) and simulates
/// better.
fn explored(
    search: &Search<'_>,
    (found, polished): (&Found, &WholeRecordFit),
    agreed: impl Fn(&MechanismTerm) -> bool,
    names: bool,
    baseline: &Baseline,
    judge: &Judge,
) -> Option<Explored> {
    let posterior = search.explore(found)?;
    let beliefs = posterior.chosen.parts.iter().zip(&posterior.beliefs);
    let mut named: Vec<Candidate> =
        beliefs.filter(|(_, b)| b.named).map(|(part, _)| part.candidate.clone()).collect();
    let likeliest = posterior.tried.as_ref().unwrap_or(&posterior.chosen);
    if likeliest.parts.is_empty() {
        return None;
    }
    let mut adopted = search.adopt(found, likeliest, &posterior.beliefs)?;
    let own = polish(&adopted.improved, &adopted.scale, judge);
    let own = defend(search, &mut adopted, own, baseline, judge, false);
    let (parts, standing) = (&own.fitted.parts, &polished.fitted.parts);
    let known = |part: &MechanismTerm| standing.iter().any(|p| p.candidate == part.candidate);
    let is_same = parts.len() == standing.len() && parts.iter().all(known);
    if parts.is_empty() || names && is_same {
        return None;
    }
    let misfit = |p: &WholeRecordFit, scale: &[f64]| {
        let scale = residual_scale(&p.fitted, scale);
        judge.misfit(&p.fitted.setup, &p.fitted.fit.point.parameters, &scale)
    };
    let is_better = || misfit(&own, &adopted.scale).total_cmp(&misfit(polished, &found.scale)).is_lt();
    named.retain(|candidate| parts.iter().any(|part| part.candidate == *candidate));
    let takes_over =
        if names { parts.iter().any(agreed) && is_better() } else { !named.is_empty() || is_better() };
    adopted.limited |= posterior.limited;
    takes_over.then_some(Explored { found: adopted, polished: own, named })
}

/// What an exploration hands back.
struct Explored {
    found: Found,
    polished: WholeRecordFit,
    /// The candidates whose names the data hold.
    named: Vec<Candidate>,
}

fn residual_scale(fitted: &FittedModel, scale: &[f64]) -> Vec<f64> {
    if fitted.setup.noise.is_some() {
        return scale.to_vec(); // that of the innovations
    }
    rms(&fitted.fit, scale).iter().zip(&fitted.setup.data.sigma).map(|(r, s)| r.max(0.7 * s)).collect()
}

/// Hears of the work, which it may give up, and of nothing else.
struct WorkOnlyListener<'a>(&'a dyn ProgressListener);

impl ProgressListener for WorkOnlyListener<'_> {
    fn begins(&self, work: &Arc<Work>) {
        self.0.begins(work);
    }
}

/// A search that changes parameters, and the holds of inputs if it may, and nothing else.
fn alone(nominal: &Setup, keep_holds: bool, most_work: u64, listener: &dyn ProgressListener) -> Found {
    // With a limit of work of its own.
    let alone = Setup { work: Arc::new(Work::of_fits_within(most_work)), ..nominal.clone() };
    listener.begins(&alone.work);
    let mut search = Search::new(alone, &[], listener);
    search.keep_holds = keep_holds;
    search.most_work = most_work;
    let found = search.run();
    listener.begins(&nominal.work);
    found
}

/// A fit in segments, at parameters that a fit of whole pieces may have found.
#[derive(Debug, Clone)]
struct WholeRecordFit {
    fitted: FittedModel,
    /// The fit that found the parameters. Their intervals are taken here: the free starts of segments know less of
    /// the parameters than whole pieces do.
    origin: FittedModel,
}

impl WholeRecordFit {
    fn kept(fitted: FittedModel) -> WholeRecordFit {
        WholeRecordFit { origin: fitted.clone(), fitted }
    }

    /// `fitted` at the parameters of `whole`, its segments' starts refitted.
    fn at(fitted: &FittedModel, level: Segmentation, whole: Fit, scale: &[f64]) -> WholeRecordFit {
        let free = Setup { free: Vec::new(), ..fitted.setup.clone() };
        let point =
            Point { parameters: whole.point.parameters.clone(), starts: fitted.fit.point.starts.clone() };
        let fit = free.fit(&fitted.level, scale, &[point], Limits { iterations: 8, tolerance: 1e-6 });
        let origin = FittedModel { level, fit: whole, ..fitted.clone() };
        WholeRecordFit { fitted: FittedModel { fit, ..fitted.clone() }, origin }
    }
}

/// The equations as they are, with the parameters that simulate the training recordings best in free run.
struct Baseline {
    polished: WholeRecordFit,
    /// Its residual.
    scale: Vec<f64>,
    /// How its simulations are judged ([`Criterion::misfit`]).
    misfit: f64,
    /// Its errors on folds, once somebody asks.
    errors: OnceCell<Vec<f64>>,
}

impl Baseline {
    /// Its errors on what is left out of its fit.
    fn errors(&self, judge: &Judge) -> &[f64] {
        self.errors.get_or_init(|| judge.errors(&self.polished, &self.scale))
    }

    /// What a search found without mechanisms, refitted at growing horizons, from its parameters and from the nominal
    /// ones: of all these fits the one that the criterion judges best.
    fn of(found: &Found, nominal: &[f64], judge: &Judge) -> Baseline {
        let (fitted, setup) = (&found.calibrated, &found.calibrated.setup);
        let own = residual_scale(fitted, &found.scale);
        let measured = Point { parameters: nominal.to_vec(), starts: setup.starts(&fitted.level, nominal) };
        let points = [fitted.fit.point.clone(), measured];
        let mut polished = best_horizon(fitted, &points, &own, &found.scale, judge);
        // A fit to segments may simulate the whole worse than what it began with.
        if judge.misfit(setup, nominal, &own)
            < judge.misfit(setup, &polished.fitted.fit.point.parameters, &own)
        {
            let level = setup.level(1);
            let as_given = Point { parameters: nominal.to_vec(), starts: setup.starts(&level, nominal) };
            let held = Limits { iterations: 0, ..HORIZON };
            let fit = setup.fit(&level, &own, &[as_given], held);
            polished = WholeRecordFit::at(fitted, level, fit, &found.scale);
        }
        let scale = residual_scale(&polished.fitted, &found.scale);
        let misfit = judge.misfit(setup, &polished.fitted.fit.point.parameters, &scale);
        Baseline { polished, scale, misfit, errors: OnceCell::new() }
    }
}

/// How simulations of the training recordings are judged.
#[derive(Debug, Clone, Copy)]
struct Judge {
    criterion: Criterion,
    /// Window of restarted simulations, s.
    window: f64,
}

impl Judge {
    /// By what a fitted model says of the machine.
    fn of(fitted: &FittedModel, scale: &[f64]) -> Judge {
        let setup = &fitted.setup;
        let durations: Vec<f64> =
            setup.data.pieces.iter().map(|p| p.len.saturating_sub(1) as f64 * p.dt).collect();
        let dt = setup.data.pieces.iter().map(|p| p.dt).fold(0.0, f64::max);
        let window = window_length(&durations, dt);
        let (criterion, predictable) = setup.criterion(&fitted.fit.point.parameters, scale);
        Judge { criterion, window: if predictable < window { window_of(predictable, dt) } else { window } }
    }

    /// Errors on what is left out of the fit, fold by fold.
    fn errors(&self, polished: &WholeRecordFit, scale: &[f64]) -> Vec<f64> {
        crate::validate::errors(&polished.origin, scale, self.criterion, self.window)
    }

    fn misfit(&self, setup: &Setup, parameters: &[f64], scale: &[f64]) -> f64 {
        self.criterion.misfit(&self.scores(setup, parameters, scale))
    }

    fn scores(&self, setup: &Setup, parameters: &[f64], scale: &[f64]) -> Vec<Score> {
        let run = setup.training_run(parameters, scale);
        let window = match self.criterion {
            Criterion::FreeRun => f64::INFINITY,
            Criterion::Windowed => self.window,
        };
        setup.scores(&run, parameters, window, None)
    }
}

/// Whether free runs leave no more than noise: in each channel at most [`MISFIT`] of its white noise, or a residual that passes
/// for coloured noise.
fn leaves_noise(scores: &[Score], fitted: &FittedModel, scale: &[f64]) -> bool {
    let coloured = crate::search::coloured_channels(fitted, scale);
    let over = scores.iter().zip(&fitted.setup.data.sigma).map(|(s, sigma)| s.rmse / sigma);
    over.zip(coloured).all(|(over, coloured)| coloured || over <= MISFIT)
}

/// A model refitted at growing horizons from each of these points of its level: of all fits, and the model as it is, the
/// one that is judged best.
fn best_horizon(
    fitted: &FittedModel,
    points: &[Point],
    own: &[f64],
    scale: &[f64],
    judge: &Judge,
) -> WholeRecordFit {
    let setup = &fitted.setup;
    let misfit = |point: &Point| judge.misfit(setup, &point.parameters, own);
    let grown = |point: &Point| -> Vec<(f64, Horizon)> {
        let horizons = setup.grow(&fitted.level, point, own, HORIZON);
        horizons.into_par_iter().map(|horizon| (misfit(&horizon.fit.point), horizon)).collect()
    };
    let (as_it_is, grown): (f64, Vec<Vec<(f64, Horizon)>>) =
        rayon::join(|| misfit(&fitted.fit.point), || points.par_iter().map(grown).collect());
    let mut best = (as_it_is, None);
    for (quality, horizon) in grown.into_iter().flatten() {
        if quality < best.0 {
            best = (quality, Some(horizon));
        }
    }
    match best.1 {
        Some(Horizon { level, mut fit }) => {
            if fit.ending == Ending::Limit {
                let further = setup.fit(&level, own, std::slice::from_ref(&fit.point), FURTHER);
                if misfit(&further.point) <= best.0 {
                    fit = further;
                }
            }
            WholeRecordFit::at(fitted, level, fit, scale)
        }
        None => WholeRecordFit::kept(fitted.clone()),
    }
}

/// Limits of the fit at each horizon.
const HORIZON: Limits = Limits { iterations: 30, tolerance: 1e-6 };
/// Limits of the best of these fits, where it has not ended.
const FURTHER: Limits = Limits { iterations: 100, tolerance: 1e-6 };

/// Takes mechanisms away until what is left can be handed back: every one is determined, no inertia is negative, and the
/// model is no worse than the calibrated one in training. It also predicts data left out of its fit better than chance,
/// unless a round believed it (`named`) and it leaves no more than noise, white or coloured. What acts at certain times of a
/// single recording is never taken for such a prediction. Nothing is left but the calibrated model where that takes all
/// mechanisms.
fn defend(
    search: &Search<'_>,
    found: &mut Found,
    polished: WholeRecordFit,
    baseline: &Baseline,
    judge: &Judge,
    named: bool,
) -> WholeRecordFit {
    let gates = Gates::new(search, baseline, judge, named);
    let mut polished = polished;
    loop {
        let fitted = &polished.fitted;
        if fitted.parts.is_empty() {
            found.improved = found.calibrated.clone();
            found.accepted.clear();
            return baseline.polished.clone();
        }
        let Some(failure) = gates.failure(&polished, &found.scale) else { return polished };
        // Without the part that is missed least. (That would be one that is not determined, unless it is so only beside
        // another that does the same.)
        let open = match failure.gate {
            Gate::Clock => failure.parts,
            _ => (0..fitted.parts.len()).collect(),
        };
        let smaller = open
            .into_par_iter()
            .filter_map(|i| {
                let smaller = search.smaller(&found.improved, i, &found.scale)?;
                let polished = polish(&smaller, &found.scale, judge);
                let scale = residual_scale(&polished.fitted, &found.scale);
                let of = &polished.fitted;
                let misfit = judge.misfit(&of.setup, &of.fit.point.parameters, &scale);
                Some((misfit, smaller, polished))
            })
            .collect::<Vec<_>>()
            .into_iter()
            .min_by(|a, b| a.0.total_cmp(&b.0));
        match smaller {
            Some((_, smaller, rest)) => {
                found.accepted.retain(|a| smaller.parts.iter().any(|p| p.candidate == a.candidate));
                found.improved = smaller;
                polished = rest;
            }
            None => {
                found.improved = found.calibrated.clone();
                found.accepted.clear();
                return baseline.polished.clone();
            }
        }
    }
}

/// What a model must pass to be handed back.
struct Gates<'a> {
    search: &'a Search<'a>,
    baseline: &'a Baseline,
    judge: &'a Judge,
    /// A round believed its mechanisms.
    named: bool,
    /// How far the machine's parameters may be from what the model states of them, if that counts.
    stated: Option<Deviation>,
}

/// The gate that a model fails at.
struct Failure {
    gate: Gate,
    /// The parts that it fails by, where it is not the model as a whole.
    parts: Vec<usize>,
}

impl Failure {
    fn at(gate: Gate, parts: Vec<usize>) -> Option<Failure> {
        Some(Failure { gate, parts })
    }
}

impl<'a> Gates<'a> {
    fn new(search: &'a Search<'a>, baseline: &'a Baseline, judge: &'a Judge, named: bool) -> Gates<'a> {
        Gates { search, baseline, judge, named, stated: None }
    }

    /// Those of a closure in the place of what `stands`: it takes the machine's parameters no farther from what the model states
    /// of them than the calibrated model or that does. (Named laws are not held to it. One may stand in for a given term, whose
    /// parameter then goes to zero: gravity for the spring of a linearised pendulum.)
    fn of_a_closure(
        search: &'a Search<'a>,
        stands: &FittedModel,
        baseline: &'a Baseline,
        judge: &'a Judge,
    ) -> Gates<'a> {
        let calibrated = search.deviation(&baseline.polished.fitted);
        let stated = Some(calibrated.larger(search.deviation(stands)));
        Gates { stated, ..Gates::new(search, baseline, judge, false) }
    }

    /// The first gate that the model fails at, if it does.
    fn failure(&self, polished: &WholeRecordFit, scale: &[f64]) -> Option<Failure> {
        let (search, fitted) = (self.search, &polished.fitted);
        let own = residual_scale(fitted, scale);
        let scores = self.judge.scores(&fitted.setup, &fitted.fit.point.parameters, &own);
        // (By the free run: starts that are free absorb what a model leaves, of segments as of windows.)
        let likely = self.named && leaves_noise(&scores, &polished.origin, &own);
        let bound = if likely { Vec::new() } else { search.bound_to_a_clock(fitted) };
        if !bound.is_empty() {
            return Failure::at(Gate::Clock, bound);
        }
        let widths = Uncertainty::of(&polished.origin, &own).widths();
        if let Some(part) = search.undetermined(&polished.origin, &widths) {
            return Failure::at(Gate::Determined, vec![part]);
        }
        if self.judge.criterion.misfit(&scores).total_cmp(&self.baseline.misfit).is_gt() {
            return Failure::at(Gate::Training, Vec::new());
        }
        if search.has_negative_inertia(&fitted.setup, &fitted.level, &fitted.fit.point, scale) {
            return Failure::at(Gate::Inertia, Vec::new());
        }
        if self.stated.is_some_and(|stated| search.deviation(fitted).is_implausible_beside(stated)) {
            return Failure::at(Gate::Parameters, Vec::new());
        }
        let predicts = || {
            Gain::of(self.baseline.errors(self.judge), &self.judge.errors(polished, &own)).is_beyond_chance()
        };
        if likely || predicts() { None } else { Failure::at(Gate::CrossValidation, Vec::new()) }
    }
}

/// The improved model refitted at growing horizons.
fn polish(fitted: &FittedModel, scale: &[f64], judge: &Judge) -> WholeRecordFit {
    let own = residual_scale(fitted, scale);
    best_horizon(fitted, std::slice::from_ref(&fitted.fit.point), &own, scale, judge)
}

/// Residual sum of squares with each part alone, refitted; `without` is that without each part, `base` that without all.
fn rss_alone(
    search: &Search<'_>,
    (calibrated, improved): (&FittedModel, &FittedModel),
    scale: &[f64],
    without: &[f64],
    base: f64,
) -> Vec<f64> {
    match without {
        // All there is, and without the other.
        [] | [_] => vec![0.0; without.len()],
        [first, second] => vec![*second, *first],
        _ => (0..without.len())
            .into_par_iter()
            .map(|i| {
                let others: Vec<usize> = (0..without.len()).rev().filter(|&j| j != i).collect();
                search.rss_without(improved, &others, calibrated, scale).unwrap_or(base)
            })
            .collect(),
    }
}

/// What is left of the residual with each part `alone` and `without` each, for parts that are told in the order of their
/// shares; nothing where there are no two.
fn subsets_of(shares: &[f64], [alone, without]: [Vec<f64>; 2], all: f64) -> Vec<Subset> {
    let n = shares.len();
    if n < 2 {
        return Vec::new();
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| shares[*b].total_cmp(&shares[*a]));
    let mut subsets = vec![Subset { mechanisms: Vec::new(), left: 1.0 }];
    subsets.extend(order.iter().enumerate().map(|(at, i)| Subset { mechanisms: vec![at], left: alone[*i] }));
    if n > 2 {
        subsets.extend(order.iter().enumerate().rev().map(|(at, i)| Subset {
            mechanisms: (0..n).filter(|other| *other != at).collect(),
            left: without[*i],
        }));
    }
    subsets.push(Subset { mechanisms: (0..n).collect(), left: all });
    subsets
}

/// What each part explains of a residual of which they explain `all`: the mean of what it takes away alone (`gained`)
/// and of what is missed without it (`lost`), which are two figures where parts take over from each other, scaled so
/// that they add up. Of two parts it is Shapley's value (L. S. Shapley, *A value for n-person games*, 1953).
fn divided(lost: &[f64], gained: &[f64], all: f64) -> Vec<f64> {
    if lost.len() < 2 {
        return lost.to_vec();
    }
    let means: Vec<f64> = lost.iter().zip(gained).map(|(l, g)| 0.5 * (l + g)).collect();
    let sum: f64 = means.iter().sum();
    means.into_iter().map(|m| if sum > 0.0 { m * all / sum } else { 0.0 }).collect()
}

/// A figure that follows from a mechanism's parameters, with its interval by the delta method.
fn figure(
    improved: &FittedModel,
    uncertainty: &Uncertainty,
    mechanism: &Mechanism,
    part: &crate::search::MechanismTerm,
    e: &greybox_model::Expr,
) -> Option<Estimate> {
    let model = &improved.setup.model;
    let own: Vec<(&str, usize)> = mechanism
        .parameters()
        .zip(&part.instance.names)
        .filter_map(|(plain, name)| Some((plain, model.parameter(name)?)))
        .collect();
    let parameters = &improved.fit.point.parameters;
    let value = |e: &greybox_model::Expr| {
        e.eval(&|n, _| match n {
            "pi" => Some(std::f64::consts::PI),
            _ => own.iter().find(|o| o.0 == n).map(|o| parameters[o.1]),
        })
        .filter(|v| v.is_finite())
    };
    let mut gradient = vec![0.0; improved.setup.free.len()];
    for (plain, index) in &own {
        if let Some(at) = improved.setup.free.iter().position(|f| f.index == *index) {
            gradient[at] = value(&e.derivative(plain, 0))?;
        }
    }
    let (v, w) = (value(e)?, uncertainty.width(&gradient));
    Some(Estimate { value: v, ci95: Some((v - w, v + w)) })
}

/// A list that describes some other law piece by piece: three or more forces on one and the same motion, or two
/// of one family beside which a constant stands (a law and the first terms of its series) or forces of free shape
/// still explain something (`remains`), each a considerable part of what is missing, or the two `redundant`: nearly
/// superfluous beside each other. (Beside a law that explains nearly everything, small corrections are what a real
/// machine has.)
fn is_series_expansion(
    improved: &FittedModel,
    shares: &[f64],
    library: &[Mechanism],
    remains: bool,
    redundant: impl Fn(usize, usize) -> bool,
) -> bool {
    // Laws of one motion: added, or in the stead of a spring's or a load's term.
    let laws: Vec<(usize, &Motion, &str, bool)> = improved
        .parts
        .iter()
        .enumerate()
        .filter_map(|(i, p)| {
            let family = &*library[p.candidate.mechanism].family;
            match &p.candidate.place {
                Place::Motion(m) => Some((i, m, family, true)),
                Place::Spring { motion, .. } | Place::Load { motion, .. } => Some((i, motion, family, false)),
                _ => None,
            }
        })
        .collect();
    let considerable = |i: usize| shares[i] > CORRECTION;
    let relatives = |a: usize, b: usize| {
        let ((i, m, family, _), (j, other, its, _)) = (&laws[a], &laws[b]);
        m.coefficients == other.coefficients
            && family == its
            && ((considerable(*i) && considerable(*j)) || redundant(*i, *j))
    };
    let patches = |motion: &Motion| {
        let here = |l: &&(usize, &Motion, &str, bool)| l.3 && l.1.coefficients == motion.coefficients;
        laws.iter().filter(here).filter(|l| considerable(l.0)).count()
    };
    // What it adds depends on nothing: a constant force, or the offset of an input.
    let model = &improved.setup.model;
    let is_constant = |part: &MechanismTerm| {
        let law = &part.instance.expression;
        let input = match &part.candidate.place {
            Place::Input(i) => Some(&*model.inputs[*i].name),
            _ => None,
        };
        let mut depends = input.is_some_and(|input| law.derivative(input, 0) != Expr::Num(1.0));
        law.walk(&mut |e| {
            depends |= matches!(e, Expr::Var { name, .. }
                if model.parameter(name).is_none() && input != Some(&**name));
        });
        !depends
    };
    let beside_constant = |motion: &Motion| {
        improved.parts.iter().enumerate().any(|(i, part)| {
            let acts = match &part.candidate.place {
                Place::Equation(e) => motion.weights[*e] != 0.0,
                Place::Input(i) => {
                    let moved = model.equations.iter().zip(&motion.weights).filter(|(_, w)| **w != 0.0);
                    moved.into_iter().any(|(e, _)| e.residual().mentions(&model.inputs[*i].name))
                }
                _ => false,
            };
            acts && considerable(i) && is_constant(part)
        })
    };
    laws.iter().any(|l| considerable(l.0) && patches(l.1) >= PATCHES)
        || (0..laws.len()).any(|b| (0..b).any(|a| relatives(a, b) && (remains || beside_constant(laws[a].1))))
}

/// Whether a law stands beside another one of the same variables on the same motion: two shapes of a
/// restoring force may well be one shape that the library lacks. Beside a small correction, the law that
/// explains nearly everything stands.
fn is_shared(improved: &FittedModel, shares: &[f64], index: usize) -> bool {
    let of = |part: &MechanismTerm| match &part.candidate.place {
        Place::Motion(m) => {
            let mut variables: Vec<(String, u8)> = Vec::new();
            part.instance.expression.walk(&mut |e| {
                if let Expr::Var { name, primes } = e
                    && improved.setup.model.state(name).is_some()
                {
                    variables.push((name.to_string(), *primes));
                }
            });
            variables.sort();
            variables.dedup();
            Some((m.coefficients.clone(), variables))
        }
        _ => None,
    };
    let own = of(&improved.parts[index]);
    own.is_some()
        && improved.parts.iter().enumerate().any(|(i, part)| {
            i != index && of(part) == own && (shares[i] > shares[index] || shares[i] > CORRECTION)
        })
}

/// Whether a mechanism is one of three or more in one equation, each a considerable part of what is missing: so
/// many together follow nearly anything.
fn is_crowded(improved: &FittedModel, shares: &[f64], index: usize, nominal: &Model) -> bool {
    let equations = |part: &MechanismTerm| part.candidate.place.equations(nominal);
    let considerable = || improved.parts.iter().zip(shares).filter(|(_, share)| **share > CORRECTION);
    shares[index] > CORRECTION
        && equations(&improved.parts[index])
            .iter()
            .any(|e| considerable().filter(|(part, _)| equations(part).contains(e)).count() >= PATCHES)
}

/// Whether forces of free shape beat the mechanisms: held out by folds, they explain clearly more of the
/// calibrated model's residual, and steadily so, or as much where the mechanisms need a memory and the shapes need
/// none. A law
/// of the library is at least as good as a free shape of its variables; an imitating law need not be.
fn beaten_by_discrepancy(
    (base, improved): &(FittedModel, FittedModel),
    scale: &[f64],
    library: &[Mechanism],
) -> bool {
    let Some(free) = discrepancy(base, scale).filter(|s| s.t > STEADY_SHAPE) else { return false };
    // On the same folds as the free shapes: how much blocks tell of each other depends on where they are cut.
    let point = &improved.fit.point;
    let Some(errors) = held_out(&improved.setup, &improved.level, scale, point, free.block) else {
        return false;
    };
    let named = 1.0 - errors.iter().sum::<f64>() / free.without.max(1e-300);
    let (_, t) = cross_validation_improvement(&errors, &free.errors);
    let remembers = improved.parts.iter().all(|part| {
        let mut delayed = false;
        part.instance.expression.walk(&mut |e| delayed |= matches!(e, Expr::Call(Func::Delay, _)));
        delayed || !library[part.candidate.mechanism].states.is_empty()
    });
    // Where nothing but white noise is left, what a memory explains is explained.
    let doubtful = remembers && !improved.leaves_white_noise(scale);
    if doubtful {
        free.gain > RIVALS_MEMORY * named
    } else {
        free.gain > RIVALS_LAW * named && t > STEADY_SHAPE
    }
}

/// Mean over standard error of the folds' gains from which free shapes are taken seriously.
const STEADY_SHAPE: f64 = 2.0;
/// Gain of free shapes over that of the mechanisms from which these are imitations: laws of the state, and
/// mechanisms with a memory or a delay (which no shape of the state should come near).
const RIVALS_LAW: f64 = 1.1;
const RIVALS_MEMORY: f64 = 0.97;

/// Share of the calibrated model's misfit up to which a mechanism counts as a small correction.
const CORRECTION: f64 = 0.02;

/// Forces on one motion that make a patchwork (and mechanisms in one equation that cast doubt on each other).
const PATCHES: usize = 3;

/// What two laws explain together over the sum of what each adds to the other, from which they do one work.
const REDUNDANT: f64 = 4.0;

/// What the improved model leaves over.
struct ResidualDiagnostics {
    /// Largest residual RMS over the noise.
    misfit: f64,
    /// A channel's residual is well above the noise, correlated, and no coloured noise.
    slow: bool,
    /// Gain of free shapes on folds they were not fitted to (zero where it is not steady).
    shape: f64,
    /// Whether free shapes are likelier than none, however little they explain.
    hidden: bool,
    /// They are, and explain about as much in every fold.
    steady: bool,
    /// They are, and the innovations are all there is to judge by.
    innovations: bool,
    /// Share of the calibrated model's misfit beyond the noise that the mechanisms explain.
    explained: f64,
}

impl ResidualDiagnostics {
    fn of(
        improved: &FittedModel,
        found: &Found,
        comparable: &impl Deref<Target = (FittedModel, FittedModel)>,
        discrepancy: Option<&Discrepancy>,
        base: f64,
    ) -> ResidualDiagnostics {
        let scale = &found.scale;
        let sigma = &improved.setup.data.sigma;
        let rms = raw_rms(improved, scale);
        let coloured = crate::search::coloured_channels(improved, scale);
        let misfit = rms.iter().zip(sigma).map(|(r, s)| r / s).fold(0.0, f64::max);
        let ratios = effective_sample_ratio(&improved.setup, &improved.level, scale, &improved.fit.point);
        let slow = (0..rms.len()).any(|c| {
            let over = rms[c] / sigma[c];
            !coloured[c] && (over > MISFIT || (over > SLOW_MISFIT && ratios[c] < SLOW))
        });
        let shape = discrepancy.filter(|s| s.t > 2.5).map_or(0.0, |s| s.gain);
        // The floor is the noise where it is white, the residual itself where it passes for noise.
        let counts = &improved.fit.count;
        let floor: f64 = (0..rms.len())
            .map(|c| {
                let noise = if coloured[c] { rms[c] } else { sigma[c].min(rms[c]) };
                counts[c] as f64 * (noise / scale[c]).powi(2)
            })
            .sum();
        let full: f64 = raw_rss(improved, scale).iter().sum();
        let mut explained = 1.0 - (full - floor).max(0.0) / (base - floor).max(1e-300);
        let whitened = found.improved.setup.noise.is_some();
        // Free shapes' gain in log-likelihood, by what independent samples there are.
        let likelier = discrepancy.filter(|s| {
            s.t > STEADY_DOUBT && s.samples as f64 * s.effective_sample_ratio * s.gain > LIKELIER
        });
        let hidden = likelier.is_some();
        let steady = likelier.is_some_and(|s| s.t > STEADY_SHAPE);
        let predictable = likelier.filter(|s| whitened && s.t > STEADY_INNOVATIONS);
        let innovations = predictable.is_some();
        if let Some(free) = predictable {
            // What the mechanisms gain in log-likelihood per sample beside what free shapes would gain beyond
            // them.
            let (before, after) = &**comparable;
            let seen = after.fit.count.iter().sum::<usize>().max(1) as f64;
            let named = log_likelihood_gain(before, after, scale) / seen;
            explained = named / (named - (1.0 - free.gain).max(1e-9).ln()).max(1e-300);
        }
        ResidualDiagnostics { misfit, slow, shape, hidden, steady, innovations, explained }
    }

    /// Whether something is missing beyond the mechanisms found.
    fn significant(&self, mechanisms: usize) -> bool {
        let (gain, ratio) = if mechanisms == 0 { (0.2, 1.3) } else { (0.05, 1.1) };
        self.slow || self.hidden || (self.shape > gain && self.misfit > ratio)
    }

    fn verdict(&self, mechanisms: usize) -> Verdict {
        let lacks = self.slow || self.innovations || (self.shape > 0.2 && self.misfit > 1.3);
        match mechanisms {
            0 if lacks => Verdict::Unexplained,
            0 => Verdict::Consistent,
            _ if lacks && self.explained < 0.9 => Verdict::Unexplained,
            _ => Verdict::MissingPhysics,
        }
    }
}

/// Mean over standard error of the folds' gains from which free shapes cast doubt on what was found, and from
/// which what they predict of innovations is called missing; and their held-out gain in log-likelihood (twice):
/// by chance fourteen columns lose fourteen, give or take five.
const STEADY_DOUBT: f64 = 1.5;
const STEADY_INNOVATIONS: f64 = 2.5;
const LIKELIER: f64 = 20.0;

/// Share of the calibrated model's misfit that laws must explain to be the answer where every model errs.
const EXPLAINED: f64 = 0.5;

/// Most confidence in a mechanism beside which something unexplained remains, or that may be part of another law.
const DOUBTED: f64 = 0.8;

/// Residual over the estimated noise below which the estimate was not of noise alone.
const BELOW_NOISE: f64 = 0.8;
/// Residual over noise from which a residual is a misfit where samples hold so little information each that it must be
/// slow.
const SLOW_MISFIT: f64 = 1.2;
const SLOW: f64 = 0.05;

fn discrepancy(fitted: &FittedModel, scale: &[f64]) -> Option<Discrepancy> {
    crate::discrepancy::test(&fitted.setup, &fitted.level, scale, &fitted.fit.point)
}

fn findings(
    improved: &FittedModel,
    found: &Found,
    nominal: &Model,
    library: &[Mechanism],
    scale: &[f64],
    shares: &[f64],
    train: &Role,
    uncertainty: &Uncertainty,
) -> Vec<IdentifiedMechanism> {
    let widths = uncertainty.widths();
    let mut setup = improved.setup.clone();
    for (p, v) in setup.model.parameters.iter_mut().zip(&improved.fit.point.parameters) {
        p.value = *v;
    }
    let along = TrajectoryEval::simulated(&setup, &train.improved.run.x, &improved.fit.point.parameters);
    let smoothed_states = TrajectoryEval::smoothed(&setup, &improved.level, scale, &improved.fit.point);
    improved
        .parts
        .iter()
        .enumerate()
        .map(|(i, part)| {
            let mechanism = &library[part.candidate.mechanism];
            let accepted = found.accepted.iter().find(|a| a.candidate == part.candidate);
            let evidence = accepted.map_or(Evidence::NONE, |a| a.evidence);
            // Posterior weights of the explanations tried; equivalent ones share their weight.
            let rivals = accepted.map_or(&[][..], |a| &a.rivals[..]);
            let weight = |score: f64| (0.5 * (score - evidence.score)).clamp(-60.0, 0.0).exp();
            // A wider law at the same place does not speak against a special case of it.
            let wider = |r: &&Rival| {
                let kind = &library[r.candidate.mechanism].kind;
                r.candidate.place == part.candidate.place && mechanism.wider().any(|k| k == kind)
            };
            let against = rivals.iter().filter(|r| !r.equivalent && !wider(r));
            let others: f64 = against.map(|r| weight(r.evidence.score)).sum();
            let nothing = weight(0.0);
            let confidence = (1.0 / (1.0 + others + nothing)).clamp(0.01, 0.99);
            let mut alternatives: Vec<Alternative> = rivals
                .iter()
                .map(|r| {
                    let m = &library[r.candidate.mechanism];
                    let probability = if r.equivalent {
                        confidence
                    } else {
                        (weight(r.evidence.score) / (1.0 + others + nothing)).clamp(0.0, 0.99)
                    };
                    let place = &r.candidate.place;
                    Alternative {
                        kind: m.kind.clone(),
                        confidence: probability,
                        equivalent: r.equivalent,
                        expression: r.instance.expression.to_string(),
                        separate: m.separate(place.moves(nominal)).to_string(),
                        site: Site::of(std::slice::from_ref(place), nominal),
                    }
                })
                .filter(|a| a.equivalent || a.confidence > 0.001)
                .collect();
            let site = Site::of(std::slice::from_ref(&part.candidate.place), nominal);
            let moves = part.candidate.place.moves(nominal);
            declare_twins(
                &mut alternatives,
                twins(&setup.model, nominal, library, &part.candidate),
                |twin| {
                    let m = &library[twin.mechanism];
                    let moves = twin.places.iter().any(|place| place.moves(nominal));
                    Alternative {
                        kind: m.kind.clone(),
                        confidence,
                        equivalent: true,
                        expression: String::new(),
                        separate: m.separate(moves).to_string(),
                        site: Site::of(&twin.places, nominal),
                    }
                },
            );
            for kind in mechanism.wider() {
                alternatives.retain(|a| a.kind != kind);
                let separate = library.iter().find(|m| m.kind == kind).map(|m| m.separate(moves).to_string());
                alternatives.push(Alternative {
                    kind: kind.to_string(),
                    confidence,
                    equivalent: true,
                    expression: part.instance.expression.to_string(),
                    separate: separate.unwrap_or_default(),
                    site: site.clone(),
                });
            }
            let alternatives = distinct(alternatives, &mechanism.kind, &site);
            let parameters = part
                .instance
                .names
                .iter()
                .filter_map(|name| {
                    let index = setup.model.parameter(name)?;
                    let value = improved.fit.point.parameters[index];
                    let width = setup.free.iter().position(|f| f.index == index).map(|i| widths[i]);
                    let estimate = Estimate { value, ci95: width.map(|w| (value - w, value + w)) };
                    Some((name.clone(), index, estimate))
                })
                .collect();
            let figures = mechanism
                .report
                .iter()
                .filter_map(|(name, e)| {
                    Some((name.clone(), figure(improved, uncertainty, mechanism, part, e)?))
                })
                .collect();
            let state = |name: &String| {
                let equation = setup.model.equations.iter().find(|e| e.name == *name)?;
                Some((name.clone(), format!("{} = {}", equation.lhs, equation.rhs)))
            };
            // Where the data cannot tell at which of several places it acts, all are named.
            let mut places = site.equations.clone();
            for rival in rivals.iter().filter(|r| r.equivalent) {
                if library[rival.candidate.mechanism].kind == mechanism.kind {
                    for name in rival.candidate.place.equations(nominal) {
                        if !places.contains(&name) {
                            places.push(name);
                        }
                    }
                }
            }
            IdentifiedMechanism {
                kind: mechanism.kind.clone(),
                family: mechanism.family.clone(),
                signature: mechanism.about.signature.clone(),
                equations: places,
                channel: site.channels.first().cloned(),
                input: site.input.clone(),
                drifting: site.drifting.clone(),
                figures,
                expression: part.instance.expression.to_string(),
                states: part.instance.states.iter().filter_map(state).collect(),
                parameters,
                share_explained: shares[i],
                confidence,
                alternatives,
                location: crate::locate::Location {
                    equations: site.equations,
                    ..locate(&setup, &along, mechanism, &part.instance)
                },
                evidence,
                curve: curve(&setup, &smoothed_states, mechanism, &part.instance, &part.candidate.place),
            }
        })
        .collect()
}

/// Algebraic twins that no recording of this kind can tell apart are declared even where they were not tried.
fn declare_twins(
    alternatives: &mut Vec<Alternative>,
    twins: Vec<Twin>,
    declared: impl Fn(&Twin) -> Alternative,
) {
    for twin in twins.iter().map(declared) {
        match alternatives.iter_mut().find(|a| a.kind == twin.kind && a.site.is(&twin.site)) {
            Some(known) => {
                known.equivalent = true;
                known.confidence = twin.confidence;
            }
            None => alternatives.push(twin),
        }
    }
}

/// The law over its variable beside the force that the rest of the equation leaves over (computed from
/// the smoothed measurements; for plots only).
fn curve(
    setup: &Setup,
    smoothed_states: &TrajectoryEval<'_>,
    mechanism: &Mechanism,
    instance: &crate::candidate::Instance,
    place: &Place,
) -> Option<Curve> {
    let (variable, equation, weight) = match place {
        Place::Motion(m) => {
            let rate = mechanism.law.contains("d", 1);
            let variable = if rate { m.rate.clone()? } else { m.position.clone()? };
            let e = m.weights.iter().position(|w| *w != 0.0)?;
            (variable, e, m.weights[e])
        }
        _ => return None,
    };
    let x = smoothed_states.eval(std::slice::from_ref(&variable), &[])?.pop()?;
    let f = force(setup, smoothed_states, mechanism, instance)?;
    let left = left_over(setup, smoothed_states, equation)?;
    let mut points = Vec::new();
    let mut law = Vec::new();
    for ((x, f), left) in x.iter().zip(&f).zip(&left) {
        for ((x, f), left) in x.iter().zip(f).zip(left) {
            if x.is_finite() && f.is_finite() && left.is_finite() {
                points.push((*x, f - left / weight));
                law.push((*x, *f));
            }
        }
    }
    // A few thousand points tell as much as sixty thousand.
    let keep = points.len().div_ceil(2500).max(1);
    let points = points.into_iter().step_by(keep).collect();
    law.sort_by(|a, b| a.0.total_cmp(&b.0));
    let keep = law.len().div_ceil(400).max(1);
    let law = law.into_iter().step_by(keep).collect();
    Some(Curve { variable: variable.to_string(), points, law })
}

/// Residual of an equation along the smoothed measurements, SI: what the improved model still lacks.
pub fn left_over(
    setup: &Setup,
    smoothed_states: &TrajectoryEval<'_>,
    equation: usize,
) -> Option<Vec<Vec<f64>>> {
    let residual = setup.model.equations[equation].residual();
    // The highest derivatives come from the smoothed measurements, too.
    let highest: Vec<(&str, u8)> =
        setup.model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
    let (mass, rest) = residual.affine_in(&highest)?;
    let mut exprs = mass;
    exprs.push(rest);
    let mut values = smoothed_states.eval(&exprs, &[])?;
    let mut total = values.pop()?;
    for (j, column) in values.iter().enumerate() {
        for (p, (t, c)) in total.iter_mut().zip(column).enumerate() {
            match &setup.smoothed_states.highest[p][j] {
                Some(z) => {
                    for ((t, c), z) in t.iter_mut().zip(c).zip(z) {
                        *t += c * z;
                    }
                }
                None if c.iter().any(|v| *v != 0.0) => return None,
                None => {}
            }
        }
    }
    Some(total)
}

/// What the forces of a model's parts depend on, where that is one motion.
fn only_variable(improved: &FittedModel, library: &[Mechanism]) -> Option<Variable> {
    let acts = |part: &&MechanismTerm| !library[part.candidate.mechanism].is_constant();
    let parts: Vec<&Candidate> = improved.parts.iter().filter(acts).map(|part| &part.candidate).collect();
    let motion = parts.first()?.motion()?;
    let is_only = parts.iter().all(|c| matches!(&c.place, Place::Motion(own) if own == motion));
    let depends = |primes| parts.iter().any(|c| library[c.mechanism].depends_on("d", primes));
    match (depends(0), depends(1)) {
        _ if !is_only || depends(2) => None,
        (true, false) => Some(Variable::Position(motion.clone())),
        (false, true) => Some(Variable::Rate(motion.clone())),
        _ => Some(Variable::Both(motion.clone())),
    }
}

fn remainder(
    improved: &FittedModel,
    discrepancy: Option<Discrepancy>,
    significant: bool,
    left: f64,
) -> Remainder {
    let model = &improved.setup.model;
    let mut location = Location::default();
    let mut shape = None;
    let share = discrepancy.as_ref().map_or(0.0, |s| s.gain.clamp(0.0, 1.0) * left.min(1.0));
    let force = |m: &Motion| match Place::Motion(m.clone()).moves(model) {
        true => "a force",
        false => "a term",
    };
    if significant && let Some(Discrepancy { variable: Some((variable, _)), .. }) = &discrepancy {
        let (motion, text) = match variable {
            Variable::Position(m) => {
                (m, m.position.as_ref().map(|e| format!("{} that depends on {e}", force(m))))
            }
            Variable::Rate(m) => (m, m.rate.as_ref().map(|e| format!("{} that depends on {e}", force(m)))),
            Variable::Both(m) => (
                m,
                match (&m.position, &m.rate) {
                    (Some(d), Some(v)) => Some(format!("{} that depends on {d} and {v} together", force(m))),
                    _ => None,
                },
            ),
            Variable::Product(m, o) => (
                m,
                match (&m.position, &o.position) {
                    (Some(d), Some(o)) => Some(format!("{} that depends on {d} and {o} together", force(m))),
                    _ => None,
                },
            ),
            Variable::Input(u, m) => {
                (m, Some(format!("{} that depends on the input {}", force(m), model.inputs[*u].name)))
            }
            Variable::Time(m) => (m, Some(format!("{} that changes slowly with time", force(m)))),
        };
        location.equations = Place::Motion(motion.clone()).equations(model);
        shape = text;
    }
    Remainder { significant, location, share_of_residual: share, shape }
}

/// Calibrates only: the same equations, parameters refitted.
#[derive(Debug)]
pub struct Calibration {
    /// The model with the fitted parameters.
    pub model: Model,
    /// Nominal and calibrated value with interval per parameter.
    pub parameters: Vec<ParameterChange>,
    /// Scores on the training recordings: nominal, calibrated.
    pub train: (Vec<Score>, Vec<Score>),
    /// Scores on the held-out recordings.
    pub holdout: (Vec<Score>, Vec<Score>),
    /// Where the held-out data come from.
    pub holdout_source: String,
    /// Window of the restarted simulations, s.
    pub window: f64,
    /// The data.
    pub data: Arc<Data>,
    /// Held-out data.
    pub held: Arc<Data>,
    /// By which figure simulations were judged.
    pub criterion: Criterion,
    /// The last fit ended because nothing more was to be gained.
    pub converged: bool,
    /// The fits ended at their limit of work, not because nothing more was to be gained.
    pub limited: bool,
    /// Free runs on the training recordings: nominal, calibrated.
    pub train_runs: (FreeRun, FreeRun),
    /// Free runs on the held-out recordings.
    pub holdout_runs: (FreeRun, FreeRun),
}

/// Scores and free runs of two models.
type Both = ((Vec<Score>, Vec<Score>), (FreeRun, FreeRun));

/// Refits the parameters of a model, with uncertainties.
///
/// # Errors
/// As [`diagnose`].
pub fn calibrate(
    model: &Model,
    train: &[Recording],
    holdout: &[Recording],
    listener: &dyn ProgressListener,
) -> Result<Calibration, DiagnoseError> {
    let Layout { train, holdout, source } = layout(model, train, holdout)?;
    let nominal = Setup::new(model, train.clone(), free_parameters(model))?;
    let found = alone(&nominal, true, MOST_WORK, listener);
    let judge = Judge::of(&found.calibrated, &residual_scale(&found.calibrated, &found.scale));
    let window = judge.window;
    let Baseline { polished: WholeRecordFit { fitted, origin }, scale, .. } =
        Baseline::of(&found, &nominal.values(), &judge);
    let widths = Uncertainty::of(&origin, &scale).widths();
    let values = &fitted.fit.point.parameters;
    let mut calibrated = model.clone();
    for (p, v) in calibrated.parameters.iter_mut().zip(values) {
        p.value = *v;
    }
    let parameters = (0..model.parameters.len())
        .map(|i| {
            let width = fitted.setup.free.iter().position(|f| f.index == i).map(|k| widths[k]);
            let e = Estimate { value: values[i], ci95: width.map(|w| (values[i] - w, values[i] + w)) };
            ParameterChange { index: i, nominal: model.parameters[i].value, calibrated: e, improved: e }
        })
        .collect();
    let spread: Vec<f64> = train.spread.iter().map(|s| s.max(1e-300)).collect();
    let runs = |data: &Arc<Data>, held: bool| -> Both {
        let fine: Vec<f64> = scale.iter().map(|s| 0.02 * s).collect();
        let setup = fitted.setup.for_simulations_of(data.clone(), values, &fine);
        let run = |parameters: &[f64], scale: &[f64]| match held {
            true => setup.free_run(parameters, scale),
            false => setup.training_run(parameters, scale),
        };
        let before = run(&nominal.values(), &spread);
        let after = run(values, &scale);
        let scores = (
            setup.scores(&before, &nominal.values(), window, None),
            setup.scores(&after, values, window, None),
        );
        (scores, (before, after))
    };
    let (train_scores, train_runs) = runs(&train, false);
    follows([&train_runs.1], &train)?;
    let (holdout_scores, holdout_runs) = runs(&holdout, true);
    Ok(Calibration {
        model: calibrated,
        parameters,
        train: train_scores,
        holdout: holdout_scores,
        holdout_source: source,
        window,
        data: train,
        held: holdout,
        criterion: judge.criterion,
        converged: origin.fit.ending != Ending::Limit,
        limited: found.limited,
        train_runs,
        holdout_runs,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each gate stops what it is there for, and a right law passes all of them.
    #[test]
    fn every_gate_stops_what_it_is_there_for() {
        use crate::closure::tests::{bodies, nothing};
        let library = built_in().unwrap();
        let search = Search::new(bodies(&|[x, ..]| [9.0 * x * x, 0.0, 0.0], 60), &library, &crate::Quiet);
        let found = nothing(&search);
        let (scale, calibrated) = (&found.scale, &found.calibrated);
        let own = residual_scale(calibrated, scale);
        let judge = Judge::of(calibrated, &own);
        let baseline = || Baseline::of(&found, &search.nominal().values(), &judge);
        let with = |kind: &str, values: &[f64], steps: usize| {
            let is_there = |c: &&Candidate| {
                library[c.mechanism].kind == kind && c.place.equations(&search.nominal().model) == ["first"]
            };
            let candidate = search.candidates().iter().chain(search.terms()).find(is_there).unwrap().clone();
            let parameters = calibrated.fit.point.parameters.iter().chain(values).copied().collect();
            let laws = [(candidate, values.to_vec(), vec![1.0; values.len()])];
            search.reassembled_from(calibrated, &laws, vec![parameters], scale, steps).unwrap()
        };
        let gate = |model: FittedModel, baseline: &Baseline| {
            let gates = Gates::of_a_closure(&search, calibrated, baseline, &judge);
            gates.failure(&polish(&model, scale, &judge), scale).map(|failure| failure.gate)
        };
        let as_it_is = |model: FittedModel, baseline: &Baseline| {
            let gates = Gates::of_a_closure(&search, calibrated, baseline, &judge);
            gates.failure(&WholeRecordFit::kept(model), scale).map(|failure| failure.gate)
        };
        let law = with("quadratic_stiffness", &[9.0], 20);
        assert_eq!(gate(law.clone(), &baseline()), None);
        assert_eq!(gate(with("step_disturbance", &[0.5, 10.0], 20), &baseline()), Some(Gate::Clock));
        assert_eq!(gate(with("cubic_damping", &[0.01], 20), &baseline()), Some(Gate::Determined));
        let closer = Baseline { misfit: f64::NEG_INFINITY, ..baseline() };
        assert_eq!(gate(law.clone(), &closer), Some(Gate::Training));
        let lenient = Baseline { misfit: f64::INFINITY, ..baseline() };
        // (An inertia of −0.02 kg m²: any force moves it far, so that it is well known.)
        let negative = with("position_dependent_inertia", &[-1.02, 0.5], 0);
        assert_eq!(as_it_is(negative, &lenient), Some(Gate::Inertia));
        // Five standard deviations from where the model states it, the calibrated one as stated.
        let mut drawn_away = law.clone();
        let index = drawn_away.setup.model.parameter("b").unwrap();
        let damping = drawn_away.setup.free.iter().position(|f| f.index == index).unwrap();
        let value = drawn_away.fit.point.parameters[index];
        drawn_away.setup.free[damping].prior =
            greybox_calibrate::Prior::Normal { mean: value - 0.5, std: 0.1 };
        assert_eq!(as_it_is(drawn_away, &lenient), Some(Gate::Parameters));
        // A calibrated model that predicts better.
        let folds = baseline().errors(&judge).len();
        let better = Baseline { errors: OnceCell::from(vec![-50.0; folds]), ..baseline() };
        assert_eq!(gate(law, &better), Some(Gate::CrossValidation));
    }

    /// A closure takes the place of what it simulates better than, and keeps the names that it holds; where it leaves more than
    /// noise it must hold them all.
    #[test]
    fn a_closure_is_better_than_what_stands_and_holds_its_names() {
        use crate::closure::tests::{bodies, nothing};
        let library = built_in().unwrap();
        let friction = |[_, _, v, ..]: [f64; 5]| [0.8 * f64::tanh(1e3 * v), 0.0, 0.0];
        let search = Search::new(bodies(&friction, 62), &library, &crate::Quiet);
        let found = nothing(&search);
        let judge = Judge::of(&found.calibrated, &residual_scale(&found.calibrated, &found.scale));
        let baseline = Baseline::of(&found, &search.nominal().values(), &judge);
        let closure = search.closure(&found, &found.calibrated, &mut Visited::default()).unwrap();
        let polished = polish(&closure.improved, &closure.scale, &judge);
        let closed = Closed::new(closure, polished, &judge);
        assert!(closed.leaves_noise);
        for has_names in [false, true] {
            assert!(closed.outdoes((&found, &baseline.polished), has_names, &judge));
            assert!(
                !closed.outdoes((&closed.found, &closed.polished), has_names, &judge),
                "it is no better than itself"
            );
        }
        let own = closed.polished.fitted.parts[0].candidate.clone();
        assert_eq!(library[own.mechanism].kind, "coulomb_friction");
        let is_other = |c: &&Candidate| library[c.mechanism].kind == "cubic_stiffness";
        let other = search.terms().find(is_other).unwrap();
        assert_eq!(closed.names(&search, &[&own]), Some(vec![own.clone()]));
        assert_eq!(
            closed.names(&search, &[&own, other]),
            Some(vec![own.clone()]),
            "there is no less than noise"
        );
        let leaves_more = Closed { leaves_noise: false, ..closed };
        assert_eq!(leaves_more.names(&search, &[&own]), Some(vec![own.clone()]));
        assert_eq!(leaves_more.names(&search, &[&own, other]), None);
    }

    fn alternative(kind: &str, equations: &[&str], confidence: f64, equivalent: bool) -> Alternative {
        let equations = equations.iter().map(|e| (*e).to_string()).collect();
        Alternative {
            kind: kind.into(),
            confidence,
            equivalent,
            expression: String::new(),
            separate: String::new(),
            site: Site { equations, ..Site::default() },
        }
    }

    #[test]
    fn alternatives_are_listed_once_by_kind_and_place() {
        let input = |name: &str| Alternative {
            site: Site { input: Some(name.into()), ..Site::default() },
            ..alternative("input_offset", &[], 0.3, true)
        };
        let all = vec![
            alternative("viscous_friction", &["hub"], 0.1, false),
            alternative("presliding_friction", &["hub"], 0.4, true),
            alternative("presliding_friction", &["link"], 0.2, true),
            alternative("viscous_friction", &["hub"], 0.2, false),
            alternative("coupling", &["link", "hub"], 0.1, true),
            alternative("coupling", &["hub", "link"], 0.3, false),
            input("u"),
            input("v"),
        ];
        let own = Site { equations: vec!["hub".into()], ..Site::default() };
        let left = distinct(all, "presliding_friction", &own);
        let told: Vec<(&str, f64)> = left.iter().map(|a| (a.kind.as_str(), a.confidence)).collect();
        assert_eq!(
            told,
            [
                ("input_offset", 0.3),
                ("input_offset", 0.3),
                ("presliding_friction", 0.2),
                ("coupling", 0.1),
                ("viscous_friction", 0.2),
            ]
        );
        assert_eq!(left[2].site.equations, ["link"], "the finding's own name and place are not listed again");
    }

    #[test]
    fn twins_that_were_tried_become_equivalent_and_the_others_are_added() {
        let mut all = vec![alternative("sensor_offset", &["hub"], 0.1, false)];
        let twin = |e| Twin { mechanism: 0, places: vec![Place::Equation(e)] };
        declare_twins(&mut all, vec![twin(0), twin(1)], |twin| {
            let name = if twin.places == [Place::Equation(0)] { "hub" } else { "link" };
            alternative("sensor_offset", &[name], 0.6, true)
        });
        let told: Vec<(&str, f64, bool)> =
            all.iter().map(|a| (a.site.equations[0].as_str(), a.confidence, a.equivalent)).collect();
        assert_eq!(told, [("hub", 0.6, true), ("link", 0.6, true)]);
    }
}
