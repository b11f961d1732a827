//! From recordings and a nominal model to the finished diagnosis.

use std::sync::Arc;

use greybox_calibrate::{
    Criterion, Data, DataError, FreeRun, HELD_OUT_SHARE, HoldoutSource, Score, Setup, SetupError, Work,
    free_parameters,
};
use greybox_model::{Hold, Model};
use greybox_recording::Recording;

use crate::answer::Answer;
use crate::baseline::{Baseline, Judge, WholeRecordFit, alone, residual_scale};
use crate::candidate::Instance;
use crate::discrepancy::Discrepancy;
use crate::evidence::Evidence;
use crate::findings::{DOUBTED, findings, rank};
use crate::importance::subsets_of;
use crate::library::{Excitation, Mechanism, MechanismError, built_in};
use crate::locate::Location;
use crate::place::Place;
use crate::proposal::{Proposal, Rejected};
use crate::remainder::{only_variable, remainder};
use crate::search::{FittedModel, Found, MOST_WORK, MechanismTerm, Search, UNDECIDED};
use crate::trajectory::TrajectoryEval;
use crate::uncertainty::Uncertainty;
use crate::verdict::{Judged, discrepancy_of, is_crowded, is_shared, outdone};
use crate::{ProgressListener, Stage};

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
    /// How an experiment that tells it from its rivals drives the machine, if its law states it.
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
    conclude(&nominal, holdout, source, &search, found, options)
}

/// Training and held-out data.
pub(crate) struct Layout {
    /// Training.
    pub train: Arc<Data>,
    /// Held out.
    pub holdout: Arc<Data>,
    /// Where the held-out data come from.
    pub source: HoldoutSource,
}

/// Lays the recordings out, holding out the last fifth of each when none is held out.
///
/// # Errors
/// As [`diagnose`].
pub(crate) fn layout(
    model: &Model,
    train: &[Recording],
    holdout: &[Recording],
) -> Result<Layout, DiagnoseError> {
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
                source: HoldoutSource::LastFifth,
            });
        }
    }
    let held = Data::new(model, if holdout.is_empty() { train } else { holdout })?;
    let source = if holdout.is_empty() { HoldoutSource::None } else { HoldoutSource::Given };
    Ok(Layout { train: Arc::new(whole), holdout: Arc::new(held), source })
}

/// Sees that one of the runs goes beyond the first samples.
pub(crate) fn follows<const N: usize>(runs: [&FreeRun; N], data: &Data) -> Result<(), DiagnoseError> {
    match runs.iter().all(|run| run.is_lost()) {
        true => Err(DiagnoseError::Diverges { file: data.recordings.join(", ") }),
        false => Ok(()),
    }
}

fn conclude(
    nominal: &Setup,
    holdout: Arc<Data>,
    holdout_source: HoldoutSource,
    search: &Search<'_>,
    found: Found,
    options: &Options,
) -> Result<Diagnosis, DiagnoseError> {
    let (train, library) = (nominal.data.clone(), search.library);
    search.listener.stage(Stage::Simulating);
    // The model that fits best knows best how errors grow.
    let judge = Judge::of(&found.improved, &residual_scale(&found.improved, &found.scale));
    let window = judge.window;
    let Answer { found, polished, baseline, judged, believed, rejected, limited } =
        Answer::of(nominal, search, found, options, &judge);
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
                excitation: mechanism.excitation.clone(),
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
    let lacks = if unexplained { discrepancy_of(calibrated, calibrated_scale) } else { None };
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

/// Residual over the estimated noise below which the estimate was not of noise alone.
const BELOW_NOISE: f64 = 0.8;
