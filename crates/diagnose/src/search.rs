//! The search: short-list by the score test, fit, decide, and again; on short segments first, on longer
//! ones later.

use std::cell::LazyCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use greybox_calibrate::{
    Ending, Fit, FreeParameter, Limits, Point, Segmentation, Setup, Work, free_parameters, qr,
};
use greybox_model::system::CompileError;
use greybox_model::{Hold, Model};
use rayon::prelude::*;

use crate::candidate::{Candidate, Instance, candidates};
use crate::evidence::{
    ComparedModel, Evidence, Smoothness, effective_sample_ratio, folds, least_effective_sample_ratio, robust,
    weigh,
};
use crate::explore::{Belief, Explorer, Hypothesis, Posterior};
use crate::library::Mechanism;
use crate::place::{Place, places};
use crate::plausibility::Deviation;
use crate::screen::{Scored, Together, first_states, first_values, inner_scales, screen, screen_pairs};
use crate::temperature::AnyScale;
use crate::trajectory::TrajectoryEval;
use crate::uncertainty::Uncertainty;
use crate::validate::{Gain, errors};
use crate::{ProgressListener, Stage, Weighed};

/// Number of segments of the first and last level, where nothing else decides.
const SEGMENTS: (usize, usize) = (60, 4);
/// Longest segments of the first level, in periods of the fastest channel: beyond, a wrong stiffness turns
/// the phase of the response round, and the score test's first order means nothing.
const PERIODS: f64 = 3.0;
/// Shortest segment, samples.
const SHORTEST: usize = 40;
/// Innovations over high-frequency noise from which a correlated residual passes for coloured noise.
const CLEAR: f64 = 1.35;
/// Residual over innovations up to which a correlated residual passes for noise: slower ones (a pole beyond
/// 0.995) are what a model leaves over.
const SLOWEST: f64 = 10.0;
/// Correlation times that recordings must hold for a correlated residual to pass for noise: of fewer, any slow misfit
/// looks the same.
const INDEPENDENT: f64 = 20.0;
/// Most samples that a level of the search looks at; longer recordings are seen through windows.
pub(crate) const MOST_SAMPLES: usize = 5000;
/// Work after which nothing more is looked for: laws that the library lacks are pieced together from mechanisms with
/// memories and delays, each slower to simulate than the one before.
pub const MOST_WORK: u64 = 120_000_000_000;
/// Most mechanisms that are looked for.
const MOST_MECHANISMS: usize = 4;
/// Most candidates that are fitted per round.
const SHORT_LIST: usize = 9;
/// Share of the best gain from which one more of every other kind is fitted, and how many.
const NEARLY: f64 = 0.5;
const MORE: usize = 5;
/// Most candidates that a mechanism is held against once more, beside its relatives.
const RIVALS: usize = 6;
/// Pairs that are fitted when no single candidate pays, and the residual over noise that calls for them.
const PAIRS: usize = 4;
const PAIR_MISFIT: f64 = 1.1;
/// Fewest samples by which a pair is believed: there are many pairs.
const PAIR_SAMPLES: usize = 500;
/// Residual over noise from which a fit may be stuck.
const STUCK: f64 = 1.2;
/// Fall of the cost from which another hold of an input is considered once more is known of the machine.
pub(crate) const SAME_HOLD: f64 = 0.002;
/// Information per sample from which a residual counts as white.
pub(crate) const WHITE: f64 = 0.8;
/// Residual over noise from which a model is far from the noise.
const FAR: f64 = 2.0;
/// Factor by which calibration may move a parameter before a model far from the noise is in doubt for it.
const MOVED: f64 = 2.0;
/// Ratio of sums of squares at which a whitened estimate simulates no longer what it is fitted to.
const FORGETS: f64 = 1.5;
/// Share of the misfit that each parameter more must buy far from the noise.
const SHARE_PER_PARAMETER: f64 = 0.05;
/// Least mean over standard error of the folds' gains, for a force that never rests.
const STEADY: f64 = 2.5;
/// Fewest samples from which a mechanism with states of its own is looked for.
const MEMORY_SAMPLES: usize = 200;
/// Residual over noise from which a residual is a misfit, whatever its colour.
pub(crate) const MISFIT: f64 = 1.5;
/// Two explanations whose scores differ by less stay undecided.
pub const UNDECIDED: f64 = 3.0;
/// Whitened scores that differ by less are the same.
const SAME_SCORE: f64 = 1.0;
/// Steps of a fit that decide which candidates of a short-list go on, and how many do.
const FIRST_STEPS: usize = 6;
const FINALISTS: usize = 5;
/// Further steps of these, how many of them go to the end, and the steps that is.
const MORE_STEPS: usize = 12;
const BEST: usize = 2;
const LAST_STEPS: usize = 40;
/// Steps of a fit without a part, for each that is left out, and how much of the others it may begin with.
const STEPS_WITHOUT: usize = 10;
const FAINT: f64 = 0.1;
/// Steps that bring the starts of new segments to given parameters.
const STARTS: usize = 6;
/// Residual on all data over that of the windows from which a model holds for the windows alone.
const BEYOND_WINDOWS: f64 = 2.0;
/// Starting points of a mechanism with a memory that are followed, and for how many steps.
const STARTING_POINTS: usize = 3;
const STEPS_TO_TELL: usize = 3;
/// Share of a law's strength by which a refinement's differs, to matter.
const SUBSTANTIAL: f64 = 0.5;
/// Log-likelihood gain that another hold must bring.
const HOLD_GAIN: f64 = 10.0;

/// Score that a mechanism keeps, or goes.
const LEAST_SCORE: f64 = 10.0;
/// A simpler model wins when its score is no further behind than this.
const PARSIMONY: f64 = 4.0;
/// Least share of the calibrated model's misfit that a second or later mechanism must explain.
const LEAST_SHARE: f64 = 7e-4;

/// A mechanism in a model, with the sizes its inner parameters are searched at.
#[derive(Debug, Clone, PartialEq)]
pub struct MechanismTerm {
    /// What and where.
    pub candidate: Candidate,
    /// As it stands in the model.
    pub instance: Instance,
    /// Sizes of the inner parameters.
    pub scales: Vec<f64>,
}

/// A law at a place, the values of its parameters, and the sizes of the inner ones.
pub(crate) type Law = (Candidate, Vec<f64>, Vec<f64>);

/// Whether two models have the same parts, in whatever order.
pub(crate) fn is_same(a: &[Candidate], b: &[Candidate]) -> bool {
    a.len() == b.len() && a.iter().all(|c| b.contains(c))
}

/// The laws of a model with the values that its parameters give them.
pub(crate) fn laws(parts: &[MechanismTerm], model: &Model, parameters: &[f64]) -> Vec<Law> {
    let value = |name: &String| model.parameter(name).map(|i| parameters[i]);
    let law = |part: &MechanismTerm| {
        let values = part.instance.names.iter().filter_map(value).collect();
        (part.candidate.clone(), values, part.scales.clone())
    };
    parts.iter().map(law).collect()
}

/// A model fitted at a level.
#[derive(Debug, Clone)]
pub struct FittedModel {
    /// Model, data, free parameters.
    pub setup: Setup,
    /// Mechanisms beyond the nominal equations.
    pub parts: Vec<MechanismTerm>,
    /// The segments.
    pub level: Segmentation,
    /// The fit; its `rss` is in units of the scale it was fitted with.
    pub fit: Fit,
}

impl FittedModel {
    /// Residual sum of squares over all channels, in units of the fit's scale.
    pub(crate) fn rss(&self) -> f64 {
        self.fit.rss.iter().sum()
    }

    /// Largest residual RMS over the noise.
    pub fn misfit(&self, scale: &[f64]) -> f64 {
        rms(&self.fit, scale).iter().zip(&self.setup.data.sigma).map(|(r, s)| r / s).fold(0.0, f64::max)
    }

    /// Whether a residual with this ratio of independent samples is white, and no larger than the noise.
    fn is_white(&self, effective_sample_ratio: f64, scale: &[f64]) -> bool {
        effective_sample_ratio > WHITE && self.misfit(scale) < STUCK
    }

    /// Whether nothing is left over but white noise, for which no noise model had to stand in.
    pub fn leaves_white_noise(&self, scale: &[f64]) -> bool {
        self.setup.noise.is_none()
            && self.is_white(
                least_effective_sample_ratio(&self.setup, &self.level, scale, &self.fit.point),
                scale,
            )
    }
}

/// What was tried beside an accepted mechanism.
#[derive(Debug, Clone)]
pub struct Rival {
    /// What and where.
    pub candidate: Candidate,
    /// As it would stand in the model.
    pub instance: Instance,
    /// Its evidence.
    pub evidence: Evidence,
    /// The data cannot separate it from the accepted one.
    pub equivalent: bool,
}

/// An accepted mechanism with the evidence for it.
#[derive(Debug, Clone)]
pub struct SelectedTerm {
    /// What and where.
    pub candidate: Candidate,
    /// Evidence when it was accepted.
    pub evidence: Evidence,
    /// The others of that round.
    pub rivals: Vec<Rival>,
}

/// Result of the search.
pub struct Found {
    /// The nominal equations with fitted parameters, at the last level.
    pub calibrated: FittedModel,
    /// With the mechanisms.
    pub improved: FittedModel,
    /// Evidence for each part of `improved`, in the same order.
    pub accepted: Vec<SelectedTerm>,
    /// Holds that explain the recording better than the stated ones: (input, stated, better).
    pub better_holds: Vec<(usize, Hold, Hold)>,
    /// Residual scale of the improved model per channel, SI.
    pub scale: Vec<f64>,
    /// The work ran out before the search had come to its end.
    pub limited: bool,
    /// With the best single candidate, and the best pair, of the last round that found nothing to be believed.
    pub rejected: Vec<FittedModel>,
    /// The mechanisms are believed beside an error of the model, by their posterior probability.
    pub errs: bool,
    /// The improved model is a closure: a sum of terms that is proposed as a whole.
    pub closed: bool,
}

/// The search with everything it needs.
pub struct Search<'a> {
    /// The mechanisms.
    pub library: &'a [Mechanism],
    /// Watches.
    pub listener: &'a dyn ProgressListener,
    /// Never try another hold than the stated ones.
    pub keep_holds: bool,
    /// Work ([`greybox_calibrate::Work`]) after which nothing more is looked for.
    pub most_work: u64,
    /// Whether something was left out for that.
    limited: AtomicBool,
    nominal: Setup,
    all: Vec<Candidate>,
    /// Laws that only cast doubt on others.
    doubts: Vec<Candidate>,
    /// Terms without a name.
    unnamed: Vec<Candidate>,
    /// Lengths of the segments, samples, level by level.
    lengths: Vec<usize>,
}

/// Twice the logarithm of the odds against one law among so many, each as likely as the others.
pub(crate) fn odds(candidates: usize) -> f64 {
    2.0 * (candidates.max(1) as f64).ln()
}

/// Samples of the longest segments that are looked at: whole pieces, as far as the search goes.
pub(crate) fn whole(setup: &Setup) -> usize {
    setup.data.lengths().into_iter().max().unwrap_or(0).clamp(SHORTEST, MOST_SAMPLES)
}

/// Lengths of the segments: from a few periods of the fastest channel, by factors of four, to a quarter of the data.
fn lengths(setup: &Setup) -> Vec<usize> {
    let total: usize = setup.data.lengths().iter().sum();
    let period = setup.data.periods().into_iter().fold(f64::INFINITY, f64::min);
    let longest = (total.min(MOST_SAMPLES) / SEGMENTS.1).max(SHORTEST);
    let first = ((PERIODS * period) as usize).min(total / SEGMENTS.0).max(SHORTEST).min(longest);
    let mut out = vec![first];
    while let Some(&last) = out.last()
        && last < longest
    {
        // A last step of less than a factor of two is not worth a level.
        let next = if last * 4 > longest / 2 { longest } else { last * 4 };
        out.push(next);
    }
    out
}

/// Samples of the longest segment.
fn longest(level: &Segmentation) -> usize {
    level.segments.iter().map(|s| s.range.len()).max().unwrap_or(0)
}

pub(crate) fn limits(iterations: usize) -> Limits {
    Limits { iterations, tolerance: 1e-5 }
}

/// A state of another model: entries of the same name keep what they are (`unknown` where that is not given), new ones are
/// `fresh` (their chains in order; zero where there is none).
pub(crate) fn carried(from: &Setup, old: &[f64], to: &Setup, fresh: &[f64], unknown: f64) -> Vec<f64> {
    let mut x = vec![0.0; to.system.nx];
    let mut new = fresh.iter();
    for (j, state) in to.model.states.iter().enumerate() {
        let known = from.model.state(&state.name).map(|i| from.system.offsets[i]);
        for k in 0..state.order {
            x[to.system.offsets[j] + k] = match known {
                Some(at) => old.get(at + k).copied().unwrap_or(unknown),
                None => new.next().copied().unwrap_or(0.0),
            };
        }
    }
    x
}

/// Start values for another model of the same data; new states get those of `fresh`, per piece.
fn transfer(
    from: &Setup,
    level: &Segmentation,
    starts: &[Vec<f64>],
    to: &Setup,
    fresh: &[Vec<f64>],
) -> Vec<Vec<f64>> {
    let fresh = |piece: usize| fresh.get(piece).map_or(&[][..], Vec::as_slice);
    let segments = level.segments.iter().zip(starts);
    segments.map(|(segment, old)| carried(from, old, to, fresh(segment.piece), 0.0)).collect()
}

/// The same segments with the priors of another model's states.
pub(crate) fn same_level(setup: &Setup, level: &Segmentation) -> Segmentation {
    let priors = level.segments.iter().map(|s| setup.start_prior(s.piece, s.range.start)).collect();
    Segmentation { segments: level.segments.clone(), priors }
}

/// Residual RMS per channel in SI.
pub fn rms(fit: &Fit, scale: &[f64]) -> Vec<f64> {
    rms_of(&fit.rss, &fit.count, scale)
}

fn rms_of(rss: &[f64], count: &[usize], scale: &[f64]) -> Vec<f64> {
    rss.iter().zip(count).zip(scale).map(|((r, n), s)| s * (r / (*n).max(1) as f64).sqrt()).collect()
}

/// The scale for the next comparison: the model's own residual, never below 0.7 of the noise.
pub fn next_scale(fit: &Fit, scale: &[f64], sigma: &[f64]) -> Vec<f64> {
    rms(fit, scale).iter().zip(sigma).map(|(r, s)| r.max(0.7 * s)).collect()
}

impl<'a> Search<'a> {
    /// Prepares the search for a laid-out nominal model.
    pub fn new(nominal: Setup, library: &'a [Mechanism], listener: &'a dyn ProgressListener) -> Search<'a> {
        let places = places(&nominal.model);
        let mut all = candidates(&nominal.model, library, &places);
        let samples: usize = nominal.data.lengths().iter().sum();
        all.retain(|c| samples >= MEMORY_SAMPLES || library[c.mechanism].states.is_empty());
        // Time begins anew with every recording, and no drift does.
        all.retain(|c| nominal.data.recordings.len() < 2 || !is_drift(&library[c.mechanism]));
        // Of an input that is constant, nothing tells what becomes of its changes; a derivative goes with its channel.
        let drives =
            |i: usize| nominal.data.input_moves(i) && nominal.model.inputs[i].derivative_of().is_none();
        all.retain(|c| !matches!(c.place, Place::Input(i) if !drives(i)));
        let any_scale = AnyScale::of(&nominal.model);
        all.retain(|c| any_scale.admits(c, &library[c.mechanism]));
        let (all, doubts): (Vec<_>, _) =
            all.into_iter().partition(|c| library[c.mechanism].doubts.is_empty());
        let (all, unnamed) = all.into_iter().partition(|c| library[c.mechanism].named);
        let lengths = lengths(&nominal);
        Search {
            library,
            listener,
            keep_holds: false,
            most_work: MOST_WORK,
            limited: AtomicBool::new(false),
            nominal,
            all,
            doubts,
            unnamed,
            lengths,
        }
    }

    /// What a formula is a sum of: what vanishes with its strengths, with a name or without.
    pub(crate) fn terms(&self) -> impl Iterator<Item = &Candidate> {
        self.all.iter().chain(&self.unnamed).filter(|c| self.library[c.mechanism].is_term())
    }

    /// The model as given, with its data.
    pub(crate) fn nominal(&self) -> &Setup {
        &self.nominal
    }

    /// Lengths of the segments, samples, level by level.
    pub(crate) fn lengths(&self) -> &[usize] {
        &self.lengths
    }

    /// The candidates it considers.
    pub fn candidates(&self) -> &[Candidate] {
        &self.all
    }

    /// How far the machine's own parameters are from what the model states of them.
    pub(crate) fn deviation(&self, fitted: &FittedModel) -> Deviation {
        let machine = self.nominal.model.parameters.len();
        Deviation::of(&fitted.setup.free, machine, &fitted.fit.point.parameters)
    }

    /// The nominal equations plus `parts` (candidate, values, sizes), parameters at `parameters`.
    pub(crate) fn assemble(
        &self,
        holds: &[Hold],
        parameters: &[f64],
        parts: &[Law],
        from: &Setup,
    ) -> Result<(Setup, Vec<MechanismTerm>), CompileError> {
        let mut model: Model = self.nominal.model.clone();
        for (input, hold) in model.inputs.iter_mut().zip(holds) {
            input.hold = *hold;
        }
        let mut free: Vec<FreeParameter> = free_parameters(&self.nominal.model);
        for (p, v) in model.parameters.iter_mut().zip(parameters) {
            p.value = *v;
        }
        let mut out = Vec::new();
        for (candidate, values, scales) in parts {
            let mechanism = &self.library[candidate.mechanism];
            let first = model.parameters.len();
            let instance = candidate.insert(&mut model, mechanism, values);
            free.extend(candidate.free(mechanism, first, scales));
            out.push(MechanismTerm { candidate: candidate.clone(), instance, scales: scales.clone() });
        }
        let memory: Vec<String> =
            out.iter().flat_map(|p: &MechanismTerm| p.instance.states.clone()).collect();
        let setup = from.with_model(model, free)?;
        // The names come from the model itself.
        let setup = setup.with_carried(&memory).unwrap_or(setup);
        Ok((setup, out))
    }

    /// A model whose free shapes are tables, with the numbers of their functions, and the instances of its parts in it. `None`
    /// where it has none.
    pub(crate) fn tabulated(&self, fitted: &FittedModel) -> Option<(Model, Vec<Instance>)> {
        let law = |part: &MechanismTerm| &self.library[part.candidate.mechanism];
        if !fitted.parts.iter().any(|part| law(part).shape.is_some()) {
            return None;
        }
        let mut model = self.nominal().model.clone();
        model.inputs.iter_mut().zip(&fitted.setup.holds).for_each(|(input, hold)| input.hold = *hold);
        let values = &fitted.fit.point.parameters;
        model.parameters.iter_mut().zip(values).for_each(|(p, v)| p.value = *v);
        let mut instances = Vec::new();
        for part in &fitted.parts {
            let value = |name: &String| fitted.setup.model.parameter(name).map(|i| values[i]);
            let own: Vec<f64> = part.instance.names.iter().map(value).collect::<Option<_>>()?;
            let first = model.parameters.len();
            instances.push(match law(part).tabulated(&own) {
                Some((table, left)) => {
                    let instance = part.candidate.insert(&mut model, &table, &left);
                    model.parameters[first].fixed = true; // what the knots are multiples of
                    instance
                }
                None => part.candidate.insert(&mut model, law(part), &own),
            });
        }
        let _ = model.resolve_units();
        Some((model, instances))
    }

    /// The laws of a fitted model with their present values.
    pub(crate) fn laws(&self, fitted: &FittedModel) -> Vec<Law> {
        laws(&fitted.parts, &fitted.setup.model, &fitted.fit.point.parameters)
    }

    /// An integration method whose error is a fiftieth of the residual.
    pub(crate) fn method(&self, fitted: &mut FittedModel, scale: &[f64]) {
        for (p, v) in fitted.setup.model.parameters.iter_mut().zip(&fitted.fit.point.parameters) {
            p.value = *v;
        }
        let tolerance: Vec<f64> = scale.iter().map(|s| 0.02 * s).collect();
        fitted.setup.choose_method(&tolerance, longest(&fitted.level));
    }

    /// The model fitted at another level, from the stitched trajectory or the measurements.
    fn relevel(
        &self,
        fitted: &FittedModel,
        level: Segmentation,
        scale: &[f64],
        iterations: usize,
    ) -> FittedModel {
        let level = same_level(&fitted.setup, &level);
        let fit = fitted.setup.lengthen(&fitted.level, &fitted.fit.point, &level, scale, limits(iterations));
        FittedModel { level, fit, ..fitted.clone() }
    }

    pub(crate) fn refit(&self, fitted: &FittedModel, scale: &[f64], iterations: usize) -> FittedModel {
        let point = fitted.fit.point.clone();
        let fit = fitted.setup.fit(&fitted.level, scale, &[point], limits(iterations));
        FittedModel { fit, ..fitted.clone() }
    }

    /// Fits `base` plus several candidates, the parameters as they are: from the values of all together, by each of these
    /// `factors` (how much of the strengths, how much of the shift of the parameters that goes with them).
    pub(crate) fn extend_by(
        &self,
        base: &FittedModel,
        open: &[Candidate],
        together: &Together,
        factors: &[(f64, f64)],
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let n0 = self.nominal.model.parameters.len();
        let old = &base.fit.point;
        let mut parts = self.laws(base);
        let mut fresh: Vec<Vec<f64>> = vec![Vec::new(); base.setup.data.pieces.len()];
        let along = LazyCell::new(|| TrajectoryEval::smoothed(&base.setup, &base.level, scale, old));
        for member in &together.members {
            let candidate = &open[member.candidate];
            let mechanism = &self.library[candidate.mechanism];
            parts.push((candidate.clone(), member.values.clone(), member.scales.clone()));
            if !mechanism.states.is_empty() {
                let own = first_states(&base.setup, mechanism, candidate, &along)?;
                fresh.iter_mut().zip(own).for_each(|(f, o)| f.extend(o));
            }
        }
        let (setup, parts) =
            self.assemble(&base.setup.holds, &old.parameters[..n0], &parts, &base.setup).ok()?;
        let level = same_level(&setup, &base.level);
        let starts = transfer(&base.setup, &base.level, &old.starts, &setup, &fresh);
        let point = |&(values, shift): &(f64, f64)| {
            let mut parameters = old.parameters.clone();
            for (f, d) in base.setup.free.iter().zip(&together.shift) {
                parameters[f.index] = (parameters[f.index] + shift * d).clamp(f.lower, f.upper);
            }
            for member in &together.members {
                let vanish = self.library[open[member.candidate].mechanism].vanish_with_force();
                let value = |(v, vanishes): (&f64, bool)| if vanishes { values * v } else { *v };
                parameters.extend(member.values.iter().zip(vanish).map(value));
            }
            Point { parameters, starts: starts.clone() }
        };
        let points: Vec<Point> = factors.iter().map(point).collect();
        let fit = setup.fit(&level, scale, &points, limits(iterations));
        let fitted = FittedModel { setup, parts, level, fit };
        (fitted.fit.cost.is_finite() && self.admissible(&fitted, scale)).then_some(fitted)
    }

    /// Fits `base` plus two candidates, from the values that they have together.
    fn extend_by_pair(
        &self,
        base: &FittedModel,
        open: &[Candidate],
        pair: &Together,
        scale: &[f64],
    ) -> Option<FittedModel> {
        self.extend_by(base, open, pair, &[(1.0, 0.0)], scale, 20)
    }

    /// Complexity of all mechanisms of a model.
    fn complexity(&self, fitted: &FittedModel) -> f64 {
        fitted.parts.iter().map(|p| self.library[p.candidate.mechanism].complexity()).sum()
    }

    /// Whether every mechanism's requirements on its parameters hold, and no inertia is negative.
    pub(crate) fn admissible(&self, fitted: &FittedModel, scale: &[f64]) -> bool {
        self.is_admissible(&fitted.parts, &fitted.setup, &fitted.level, &fitted.fit.point, scale)
    }

    /// The same of parts in a model at a point of a level.
    pub(crate) fn is_admissible(
        &self,
        parts: &[MechanismTerm],
        setup: &Setup,
        level: &Segmentation,
        point: &Point,
        scale: &[f64],
    ) -> bool {
        parts.iter().all(|part| self.allows(part, setup, &point.parameters))
            && !self.has_negative_inertia(setup, level, point, scale)
    }

    /// Whether a mechanism's requirements on its parameters hold at these values of the model's.
    fn allows(&self, part: &MechanismTerm, setup: &Setup, parameters: &[f64]) -> bool {
        let mechanism = &self.library[part.candidate.mechanism];
        let value = |n: &str| {
            let i = mechanism.parameters().position(|p| p == n)?;
            Some(parameters[setup.model.parameter(&part.instance.names[i])?])
        };
        let required = mechanism.require.iter().all(|e| e.eval(&|n, _| value(n)).is_none_or(|v| v >= 0.0));
        required && (!is_drift(mechanism) || self.keeps_its_sign(mechanism, &value))
    }

    /// Whether a parameter that drifts, with these values of the drift's own, has one sign until the end of the recordings.
    fn keeps_its_sign(&self, mechanism: &Mechanism, value: &dyn Fn(&str) -> Option<f64>) -> bool {
        let end = self.nominal.data.pieces.iter().map(|p| p.start + p.len as f64 * p.dt).fold(0.0, f64::max);
        let at = |t: f64| {
            mechanism.law.eval(&|n, _| match n {
                "p" => Some(1.0),
                "t" => Some(t),
                _ => value(n),
            })
        };
        match (at(0.0), at(end)) {
            (Some(first), Some(last)) => first * last > 0.0,
            _ => true,
        }
    }

    /// When no single candidate is believable and yet something is missing: the best pairs of those that
    /// only pay together.
    fn pair_round(&self, calibrated: &mut FittedModel, state: &mut SearchState) -> bool {
        if state.current.parts.len() + 2 > MOST_MECHANISMS || state.misfit() < PAIR_MISFIT {
            return false;
        }
        let current = state.current.clone();
        let scale = state.scale.clone();
        let open: Vec<Candidate> =
            self.all.iter().filter(|c| !current.parts.iter().any(|p| p.candidate == **c)).cloned().collect();
        let pairs = screen_pairs(
            &current.setup,
            self.library,
            &open,
            &current.level,
            &scale,
            &current.fit.point,
            PAIRS,
        );
        self.listener.stage(Stage::Fitting { candidates: pairs.len() });
        let trials: Vec<FittedModel> =
            pairs.par_iter().filter_map(|p| self.extend_by_pair(&current, &open, p, &scale)).collect();
        let Some(best) = trials.into_iter().min_by(|a, b| a.rss().total_cmp(&b.rss())) else {
            return false;
        };
        // (Beside a single candidate that was not believed either.)
        state.rejected.push(best.clone());
        let control = self.refit_baseline(&current, &best, &scale);
        let evidence = self.weigh(&control, &best, &scale);
        let share = (control.rss() - best.rss()) / calibrated_rss(calibrated, &scale).max(1e-300);
        let first = current.parts.is_empty();
        let members = &best.parts[best.parts.len() - 2..];
        let kinds: Vec<&str> =
            members.iter().map(|part| &*self.library[part.candidate.mechanism].kind).collect();
        // There are n²/2 pairs to choose from; of few samples, one of them always fits.
        let samples: usize = state.current.fit.count.iter().sum();
        let believable = samples >= PAIR_SAMPLES
            && evidence.score > self.threshold(2)
            && members.iter().all(|part| {
                self.accepts(&evidence, &self.library[part.candidate.mechanism], share, first, false)
            });
        self.tell((&control, &best), &kinds, &evidence, &scale, believable);
        if !believable {
            return false;
        }
        for part in members {
            state.accepted.push(SelectedTerm {
                candidate: part.candidate.clone(),
                evidence,
                rivals: Vec::new(),
            });
        }
        state.current = best;
        self.settle(state);
        state.current.parts.len() >= current.parts.len() + 2
    }

    /// Fits `base` plus one candidate.
    fn extend(
        &self,
        base: &FittedModel,
        candidate: &Candidate,
        scored: &Scored,
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let n0 = self.nominal.model.parameters.len();
        let mut parts = self.laws(base);
        parts.push((candidate.clone(), scored.values.clone(), scored.scales.clone()));
        let old = &base.fit.point;
        let (mut setup, parts) =
            self.assemble(&base.setup.holds, &old.parameters[..n0], &parts, &base.setup).ok()?;
        let plain: Vec<f64> = old.parameters.iter().chain(&scored.values).copied().collect();
        let mut shifted = plain.clone();
        for (f, d) in base.setup.free.iter().zip(&scored.shift) {
            shifted[f.index] = (shifted[f.index] + d).clamp(f.lower, f.upper);
        }
        for (p, v) in setup.model.parameters.iter_mut().zip(&shifted) {
            p.value = *v;
        }
        let mechanism = &self.library[candidate.mechanism];
        let fresh = if mechanism.states.is_empty() {
            Vec::new()
        } else {
            let along = TrajectoryEval::smoothed(&base.setup, &base.level, scale, &base.fit.point);
            first_states(&base.setup, mechanism, candidate, &along)?
        };
        let level = same_level(&setup, &base.level);
        let kept = transfer(&base.setup, &base.level, &old.starts, &setup, &fresh);
        if !mechanism.states.is_empty() {
            // What it brings along may be faster than the machine.
            let tolerance: Vec<f64> = scale.iter().map(|s| 0.05 * s).collect();
            setup.choose_method(&tolerance, longest(&level));
        }
        let mut starts = setup.starts(&level, &shifted);
        // What the mechanism remembers has its own likely start.
        for (h, k) in starts.iter_mut().zip(&kept) {
            for (j, state) in setup.model.states.iter().enumerate() {
                if base.setup.model.state(&state.name).is_none() {
                    let at = setup.system.offsets[j]..setup.system.offsets[j] + state.order;
                    h[at.clone()].copy_from_slice(&k[at]);
                }
            }
        }
        let mut points = vec![
            Point { parameters: shifted.clone(), starts: kept.clone() },
            Point { parameters: plain, starts: kept.clone() },
            Point { parameters: shifted, starts },
        ];
        // Less of it, and other choices of the inner parameters: the score test is only of first order.
        if let Some(reduced_start) = &scored.reduced_start {
            let parameters = old.parameters.iter().chain(reduced_start).copied().collect();
            points.push(Point { parameters, starts: kept.clone() });
        }
        for (_, values, shift) in &scored.others {
            let mut parameters: Vec<f64> = old.parameters.iter().chain(values).copied().collect();
            for (f, d) in base.setup.free.iter().zip(shift) {
                parameters[f.index] = (parameters[f.index] + d).clamp(f.lower, f.upper);
            }
            points.push(Point { parameters, starts: kept.clone() });
        }
        // With a memory of its own, where a fit starts decides where it ends: a few steps from the best few.
        if !mechanism.states.is_empty() {
            points = setup.best_points(&level, scale, points, STARTING_POINTS);
            if points.len() > 1 {
                points = points
                    .into_iter()
                    .map(|p| setup.fit(&level, scale, &[p], limits(STEPS_TO_TELL)).point)
                    .collect();
            }
        }
        let fit = setup.fit(&level, scale, &points, limits(iterations));
        fit.cost.is_finite().then(|| FittedModel { setup, parts, level, fit })
    }

    /// `fitted` without part `index`, refitted.
    fn without(
        &self,
        fitted: &FittedModel,
        index: usize,
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let mut parts = self.laws(fitted);
        parts.remove(index);
        self.reassembled(fitted, &parts, scale, iterations)
    }

    /// The model with other parts at these values, from a fit's parameters.
    fn reassembled(
        &self,
        fitted: &FittedModel,
        parts: &[Law],
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        self.reassembled_from(fitted, parts, Vec::new(), scale, iterations)
    }

    /// [`reassembled`](Self::reassembled) from there or from one of the `others`, values of all parameters.
    pub(crate) fn reassembled_from(
        &self,
        fitted: &FittedModel,
        parts: &[Law],
        others: Vec<Vec<f64>>,
        scale: &[f64],
        iterations: usize,
    ) -> Option<FittedModel> {
        let n0 = self.nominal.model.parameters.len();
        let head = &fitted.fit.point.parameters[..n0];
        let (setup, kept) = self.assemble(&fitted.setup.holds, head, parts, &fitted.setup).ok()?;
        let mut own = head.to_vec();
        own.extend(parts.iter().flat_map(|p| p.1.iter().copied()));
        let level = same_level(&setup, &fitted.level);
        let starts = transfer(&fitted.setup, &level, &fitted.fit.point.starts, &setup, &[]);
        let points: Vec<Point> = std::iter::once(own)
            .chain(others)
            .map(|parameters| Point { parameters, starts: starts.clone() })
            .collect();
        let fit = setup.fit(&level, scale, &points, limits(iterations));
        Some(FittedModel { setup, parts: kept, level, fit })
    }

    /// Tries the other holds of every input; switches where the cost falls by more than `margin`.
    pub(crate) fn redecide_holds(&self, fitted: &FittedModel, scale: &[f64], margin: f64) -> FittedModel {
        let mut best = fitted.clone();
        if self.keep_holds {
            return best;
        }
        let gain = |from: &FittedModel, to: &FittedModel| -> f64 {
            let ratios = effective_sample_ratio(&to.setup, &to.level, scale, &to.fit.point);
            (0..ratios.len())
                .filter(|&c| to.fit.rss[c] > 0.0 && from.fit.rss[c] > 0.0)
                .map(|c| to.fit.count[c] as f64 * ratios[c] * (from.fit.rss[c] / to.fit.rss[c]).ln())
                .sum()
        };
        // What the model states counts unless the data speak clearly: another hold may have stood in for a
        // delay that has its own name now.
        for i in 0..fitted.setup.holds.len() {
            let stated = self.nominal.holds[i];
            if best.setup.holds[i] != stated {
                let mut holds = best.setup.holds.clone();
                holds[i] = stated;
                let trial = FittedModel { setup: best.setup.with_holds(holds), ..best.clone() };
                let trial = self.refit(&trial, scale, 10);
                if gain(&trial, &best) < HOLD_GAIN {
                    best = trial;
                }
            }
        }
        for i in 0..fitted.setup.holds.len() {
            if self.nominal.model.inputs[i].derivative_of().is_some() || !fitted.setup.data.input_moves(i) {
                continue;
            }
            for hold in [Hold::Zero, Hold::Linear, Hold::BandLimited] {
                if hold == best.setup.holds[i] {
                    continue;
                }
                let mut holds = best.setup.holds.clone();
                holds[i] = hold;
                let trial = FittedModel { setup: best.setup.with_holds(holds), ..best.clone() };
                let trial = self.refit(&trial, scale, 4);
                if trial.fit.cost < best.fit.cost * (1.0 - margin) {
                    // Significant for the information that a correlated residual holds, or else the
                    // hold would follow the misfit of a model that lacks something.
                    if gain(&best, &trial) > HOLD_GAIN {
                        best = trial;
                    }
                }
            }
        }
        best
    }

    fn weigh(&self, old: &FittedModel, new: &FittedModel, scale: &[f64]) -> Evidence {
        let ratios = effective_sample_ratio(&new.setup, &new.level, scale, &new.fit.point);
        self.weigh_with(old, new, scale, &ratios)
    }

    /// The evidence for `new` over `old`; where residuals are whitened, by the profile likelihood: each
    /// model with the noise model that suits its own residual.
    fn weigh_with(
        &self,
        old: &FittedModel,
        new: &FittedModel,
        scale: &[f64],
        effective_sample_ratio: &[f64],
    ) -> Evidence {
        let (before, after) = (self.side(old, new, scale), self.side(new, new, scale));
        let folds = |f: &FittedModel| folds(&f.setup, &f.level, scale, &f.fit.point);
        let whitened = new.setup.noise.is_some();
        weigh((&before, &folds(old)), (&after, &folds(new)), &new.fit.count, effective_sample_ratio, whitened)
    }

    /// What a comparison that ends at `new` knows of a model.
    fn side(&self, of: &FittedModel, new: &FittedModel, scale: &[f64]) -> ComparedModel {
        let rss = if new.setup.noise.is_some() { innovations(of, scale) } else { of.fit.rss.clone() };
        let mechanisms = || of.parts.iter().map(|part| &self.library[part.candidate.mechanism]);
        // (Of a free shape its size alone: the rest has a prior.)
        let parameters =
            mechanisms().map(|m| if m.shape.is_some() { 1.0 } else { m.parameters().count() as f64 });
        ComparedModel {
            rss,
            parameters: parameters.sum(),
            surcharge: mechanisms().map(|m| m.surcharge).sum(),
            shapes: self.smoothness(of, scale),
        }
    }

    /// What the free shapes of a model cost.
    fn smoothness(&self, of: &FittedModel, scale: &[f64]) -> Smoothness {
        let is_shape = |part: &&MechanismTerm| self.library[part.candidate.mechanism].shape.is_some();
        let free = |name: &String| {
            let index = of.setup.model.parameter(name)?;
            of.setup.free.iter().position(|f| f.index == index)
        };
        let names = of.parts.iter().filter(is_shape).flat_map(|part| &part.instance.names);
        let positions: Vec<usize> = names.filter_map(free).collect();
        if positions.is_empty() {
            return Smoothness::default();
        }
        let value = |&i: &usize| of.fit.point.parameters[of.setup.free[i].index];
        let known = Uncertainty::known(of, scale, &positions);
        Smoothness {
            squares: positions.iter().map(|i| value(i).powi(2)).sum(),
            certainty: -qr::log_determinant(&known, positions.len()),
        }
    }

    /// What is known of the strengths that `new` has and `old` has not ([`robust`]).
    pub(crate) fn robust(&self, old: &FittedModel, new: &FittedModel, scale: &[f64]) -> f64 {
        // Whoever listens changes nothing: what it costs is not counted.
        let work = Arc::new(Work::of_fits_within(u64::MAX));
        let uncounted = |f: &FittedModel| FittedModel {
            setup: Setup { work: work.clone(), ..f.setup.clone() },
            ..f.clone()
        };
        let (old, new) = (uncounted(old), uncounted(new));
        let inflation = Uncertainty::inflation(&new, scale, &self.tested(&old, &new));
        robust(&self.side(&old, &new, scale), &self.side(&new, &new, scale), &new.fit.count, inflation)
    }

    /// Positions, among what is free in `new`, of what stands for the laws that `old` lacks: their strengths, or all
    /// parameters of a law that has none.
    fn tested(&self, old: &FittedModel, new: &FittedModel) -> Vec<usize> {
        let is_new = |part: &&MechanismTerm| !old.parts.iter().any(|o| o.candidate == part.candidate);
        let names = new.parts.iter().filter(is_new).flat_map(|part| {
            let strengths = self.library[part.candidate.mechanism].linear.len();
            let names = &part.instance.names;
            if strengths > 0 { &names[..strengths.min(names.len())] } else { &names[..] }
        });
        let position = |name: &String| {
            let index = new.setup.model.parameter(name)?;
            new.setup.free.iter().position(|f| f.index == index)
        };
        names.filter_map(position).collect()
    }

    /// What evidence must exceed for so many laws, each one of all candidates.
    fn threshold(&self, laws: usize) -> f64 {
        laws as f64 * odds(self.all.len()) + 6.0
    }

    /// Tells what was weighed against what.
    fn tell(
        &self,
        (old, new): (&FittedModel, &FittedModel),
        kinds: &[&str],
        evidence: &Evidence,
        scale: &[f64],
        believed: bool,
    ) {
        let robust = || self.robust(old, new, scale);
        let threshold = self.threshold(kinds.len());
        self.listener.weighed(&Weighed { kinds, evidence, robust: &robust, threshold, believed });
    }

    /// Whether the improvement is to be believed.
    fn accepts(
        &self,
        e: &Evidence,
        mechanism: &Mechanism,
        share: f64,
        first: bool,
        allow_rare: bool,
    ) -> bool {
        let threshold = self.threshold(1);
        // An effect that acts rarely is seen in few folds: it must pay much where it acts and cost nothing
        // elsewhere, and the baseline must have shown a misfit while its segments were short.
        // (Where the residual is white, the likelihood can be taken at its word.)
        let (times, focus) =
            if e.effective_sample_ratio > WHITE && !e.whitened { (2.0, 0.7) } else { (4.0, 0.85) };
        let rare = mechanism.rare
            && allow_rare
            && e.score > times * threshold.max(15.0)
            && e.drop > if e.whitened { 0.01 } else { 0.05 }
            && e.improvement_concentration > focus;
        if rare {
            return true;
        }
        if e.whitened {
            return e.score > threshold
                && e.drop > 0.003
                && e.cross_validation_gain > 0.0015
                && e.t > 1.5
                && e.improved_fold_fraction >= 0.6;
        }
        let enough = (e.drop > 0.02 && e.cross_validation_gain > 0.01)
            || (e.effective_sample_ratio > WHITE
                && e.drop > 0.005
                && e.cross_validation_gain > 0.004
                && e.t > 2.5);
        // Of a force that never rests, each fold brings its share of the score, with a spread near its
        // square root: where the score is beyond doubt, so is t.
        if mechanism.steady && (e.t < STEADY || e.improved_fold_fraction < 0.8) {
            return false;
        }
        // Steady over the folds; or, where a few strong moments hold most of the gain, for the better in
        // nearly every fold and to no one's loss (the sign test).
        let steady = (e.t > 2.0 && e.improved_fold_fraction >= 0.6)
            || (e.t > 1.5 && e.improved_fold_fraction >= 0.8)
            || (e.improved_fold_fraction >= 0.9 && e.improvement_concentration > 0.95);
        // A second effect may be small beside the first; it must then be seen everywhere.
        let visible =
            first || share > LEAST_SHARE || (e.drop > 0.1 && e.t > 5.0 && e.improved_fold_fraction >= 0.9);
        e.score > threshold && visible && enough && steady
    }

    /// Residual sum of squares of `calibrated` at the level of `like`, in units of `scale`, its starts refitted.
    pub fn rss_at(&self, calibrated: &FittedModel, like: &FittedModel, scale: &[f64]) -> f64 {
        let mut f = calibrated.clone();
        let fixed = Setup { free: Vec::new(), ..f.setup.clone() };
        let point = fixed.stitch(&f.level, &f.fit.point, &like.level, scale);
        f.fit = fixed.fit(&like.level, scale, &[point], limits(8));
        f.level = like.level.clone();
        calibrated_rss(&f, scale)
    }

    /// The calibrated and the improved model on the search's longest windows, with one noise model, refitted.
    pub fn comparable(&self, found: &Found) -> (FittedModel, FittedModel) {
        let length = self.lengths.last().copied().unwrap_or(SHORTEST);
        let windows = self.nominal.windows(length, MOST_SAMPLES);
        let on_windows = |f: &FittedModel| {
            let mut f = f.clone();
            f.setup.noise.clone_from(&found.improved.setup.noise);
            if f.level.segments == windows.segments {
                self.refit(&f, &found.scale, 10)
            } else {
                self.relevel(&f, windows.clone(), &found.scale, 15)
            }
        };
        (on_windows(&found.calibrated), on_windows(&found.improved))
    }

    /// Residual sum of squares of a model without some of its parts (indices falling), refitted: from where it is, or
    /// from the calibrated model with a little of each part that stays. What is left of laws that hold each other up may
    /// not even be stable.
    pub fn rss_without(
        &self,
        fitted: &FittedModel,
        parts: &[usize],
        calibrated: &FittedModel,
        scale: &[f64],
    ) -> Option<f64> {
        let mut rest = self.laws(fitted);
        parts.iter().for_each(|index| drop(rest.remove(*index)));
        let n0 = self.nominal.model.parameters.len();
        let mut reduced_start = calibrated.fit.point.parameters[..n0].to_vec();
        for (candidate, values, _) in &rest {
            let linear = self.library[candidate.mechanism].linear.len();
            reduced_start
                .extend(values.iter().enumerate().map(|(i, v)| if i < linear { FAINT * v } else { *v }));
        }
        let left = self.reassembled_from(
            fitted,
            &rest,
            vec![reduced_start],
            scale,
            STEPS_WITHOUT * parts.len().min(MOST_MECHANISMS),
        )?;
        Some(raw_rss(&left, scale).iter().sum())
    }

    /// How far the score of the law that casts doubt on part `index` is above its own; `None` where none does.
    pub fn doubt(&self, fitted: &FittedModel, index: usize, scale: &[f64]) -> Option<f64> {
        let part = &fitted.parts[index].candidate;
        let kind = &self.library[part.mechanism].kind;
        let meets = |place: &Place| match (place, &part.place) {
            // A force of the motion beside one that is a force of time alone.
            (Place::Motion(motion), Place::Equation(e)) => motion.weights[*e] != 0.0,
            (place, other) => place == other,
        };
        let doubts = |c: &&Candidate| {
            meets(&c.place) && !c.mirrored && self.library[c.mechanism].doubts.contains(kind)
        };
        let doubt = self.doubts.iter().find(doubts)?;
        let base = self.without(fitted, index, scale, 12)?;
        let scored = screen(
            &base.setup,
            self.library,
            std::slice::from_ref(doubt),
            &base.level,
            scale,
            &base.fit.point,
        );
        let rival = self.extend(&base, doubt, scored.first()?, scale, LAST_STEPS)?;
        // One information per sample for both: that of the residual which fits better.
        let best = if rival.rss() < fitted.rss() { &rival } else { fitted };
        let ratios = effective_sample_ratio(&best.setup, &best.level, scale, &best.fit.point);
        let score = |f: &FittedModel| self.weigh_with(&base, f, scale, &ratios).score;
        Some(score(&rival) - score(fitted))
    }

    /// Runs all levels; again on whitened residuals where what is left over is coloured.
    pub fn run(&self) -> Found {
        let sigma = self.nominal.data.sigma.clone();
        let scale: Vec<f64> = self.nominal.data.spread.iter().map(|s| s.max(1e-300)).collect();
        self.listener.stage(Stage::Calibrating);
        let level = self.nominal.windows(self.lengths[0], MOST_SAMPLES);
        let start = Point {
            parameters: self.nominal.values(),
            starts: self.nominal.starts(&level, &self.nominal.values()),
        };
        let fit = self.nominal.fit(&level, &scale, &[start], limits(30));
        let mut calibrated = FittedModel { setup: self.nominal.clone(), parts: Vec::new(), level, fit };
        let mut state = SearchState {
            scale: next_scale(&calibrated.fit, &scale, &sigma),
            current: calibrated.clone(),
            accepted: Vec::new(),
            allow_rare: true,
            sigma,
            rejected: Vec::new(),
        };
        self.method(&mut calibrated, &state.scale);
        calibrated = self.refit(&calibrated, &state.scale, 15);
        calibrated = self.redecide_holds(&calibrated, &state.scale, 0.02);
        state.current = calibrated.clone();
        // Only a baseline that misses something already on short segments may lack a rare effect: on long
        // ones a fit may also be stuck.
        state.allow_rare = state.misfit() > 1.05;
        for (step, &length) in self.lengths.iter().enumerate() {
            // The last, on which conclusions rest, in any case.
            if self.is_spent() && step + 1 < self.lengths.len() {
                continue;
            }
            if step > 0 {
                self.lengthen(&mut calibrated, &mut state, length);
            }
            self.level(&mut calibrated, &mut state);
        }
        self.restart_short_segments(&mut calibrated, &mut state);
        let mut settled = false;
        if self.is_coloured(&state, 0.6) && state.noise_is_coloured() {
            self.listener.stage(Stage::Whitening);
            let plain = (calibrated.clone(), state.clone());
            self.whitened(&mut calibrated, &mut state);
            // An estimate that takes noise for noise simulates as well as one that does not. One that takes
            // a misfit for noise predicts the next sample and forgets the simulation.
            let before = raw_rss(&plain.1.current, &plain.1.scale);
            let remembers = |f: &FittedModel| {
                let after = raw_rss(f, &plain.1.scale);
                !after.iter().zip(&before).any(|(a, b)| *a > FORGETS * b)
            };
            settled = remembers(&state.current);
            if settled {
                self.refine_structure(&mut calibrated, &mut state);
                settled = remembers(&state.current);
            }
            if !settled {
                (calibrated, state) = plain;
            }
        }
        if !settled {
            self.refine_structure(&mut calibrated, &mut state);
        }
        // An answer that stands is not less complete for what was tried beyond it.
        let (mut limited, standing) = (self.limited.load(Ordering::Relaxed), state.candidates());
        self.go_on_to_the_end(&mut calibrated, &mut state);
        self.search_long(&calibrated, &mut state);
        if state.candidates() != standing {
            limited = self.limited.load(Ordering::Relaxed);
        }
        // What was searched through windows is fitted to all data in the end.
        let length = self.lengths.last().copied().unwrap_or(SHORTEST);
        let whole = self.nominal.windows(length, usize::MAX);
        if whole.segments != state.current.level.segments {
            calibrated = self.relevel(&calibrated, whole.clone(), &state.scale, 15);
            if state.current.parts.is_empty() {
                state.current = FittedModel { setup: state.current.setup.clone(), ..calibrated.clone() };
            } else {
                self.refit_all_data(&mut state, &whole);
            }
            if state.current.setup.noise.is_none() {
                state.rescale();
                state.current = self.refit(&state.current, &state.scale, 5);
            }
        }
        self.simplify(&mut state);
        self.mark_unidentifiable(&mut state);
        let current = state.current;
        let better_holds = (0..current.setup.holds.len())
            .filter(|&i| current.setup.holds[i] != self.nominal.holds[i])
            .map(|i| (i, self.nominal.holds[i], current.setup.holds[i]))
            .collect();
        let (accepted, scale, rejected) = (state.accepted, state.scale, state.rejected);
        Found {
            calibrated,
            improved: current,
            accepted,
            better_holds,
            scale,
            limited,
            rejected,
            errs: false,
            closed: false,
        }
    }

    /// Explores what the machine lacks where every model of it errs, from what this search found.
    pub(crate) fn explore(&self, found: &Found) -> Option<Posterior> {
        let calibrated = &found.calibrated;
        Explorer::new(self, &calibrated.setup).explore(&calibrated.fit.point.parameters, &[&found.improved])
    }

    /// A hypothesis fitted to the segments of what this search found, in its place.
    pub(crate) fn adopt(&self, found: &Found, h: &Hypothesis, beliefs: &[Belief]) -> Option<Found> {
        let at = &h.fitted.at;
        let n0 = self.nominal.model.parameters.len();
        let laws = laws(&h.parts, &at.setup.model, &at.parameters);
        let (setup, parts) = self.assemble(&at.setup.holds, &at.parameters[..n0], &laws, &at.setup).ok()?;
        let setup = Setup { noise: None, work: self.nominal.work.clone(), ..setup };
        let level = same_level(&setup, &found.calibrated.level);
        let starts = setup.starts(&level, &at.parameters);
        let point = Point { parameters: at.parameters.clone(), starts };
        let fit = setup.fit(&level, &found.scale, &[point], limits(15));
        if !fit.cost.is_finite() {
            return None;
        }
        let mut improved = FittedModel { setup, parts, level, fit };
        let scale = next_scale(&improved.fit, &found.scale, &self.nominal.data.sigma);
        self.method(&mut improved, &scale);
        improved = self.refit(&improved, &scale, 10);
        let score = |gain: f64| Evidence { score: 2.0 * gain, ..Evidence::NONE };
        let accepted = improved.parts.iter().zip(beliefs).map(|(part, belief)| SelectedTerm {
            candidate: part.candidate.clone(),
            evidence: score(belief.gain),
            rivals: belief
                .others
                .iter()
                .map(|other| Rival {
                    candidate: other.part.candidate.clone(),
                    instance: other.part.instance.clone(),
                    evidence: score(belief.gain + (other.probability / belief.probability).ln()),
                    equivalent: other.equivalent,
                })
                .collect(),
        });
        let accepted = accepted.collect();
        Some(Found {
            calibrated: found.calibrated.clone(),
            improved,
            accepted,
            better_holds: found.better_holds.clone(),
            scale,
            limited: found.limited,
            rejected: Vec::new(),
            errs: true,
            closed: false,
        })
    }

    /// The model without part `index`, on the same segments, refitted.
    pub fn smaller(&self, fitted: &FittedModel, index: usize, scale: &[f64]) -> Option<FittedModel> {
        self.without(fitted, index, scale, STEPS_WITHOUT)
    }

    /// How well the recordings determine each part: the largest of its strengths over the half `widths` of their 95 %
    /// intervals (of the free parameters). −∞ for a part without strengths of its own, which shows nothing of the kind.
    pub(crate) fn known(&self, fitted: &FittedModel, widths: &[f64]) -> Vec<f64> {
        let known = |part: &MechanismTerm| -> f64 {
            let mechanism = &self.library[part.candidate.mechanism];
            let ratio = |name: &String| {
                let index = fitted.setup.model.parameter(name)?;
                let at = fitted.setup.free.iter().position(|f| f.index == index)?;
                let value = fitted.fit.point.parameters[index].abs();
                let ratio = value / widths[at];
                Some(if ratio.is_nan() || value == 0.0 { 0.0 } else { ratio })
            };
            let names = part.instance.names.iter().zip(mechanism.vanish_with_force());
            let known = names.filter(|(_, vanishes)| *vanishes).filter_map(|(name, _)| ratio(name));
            known.fold(f64::NEG_INFINITY, f64::max)
        };
        fitted.parts.iter().map(known).collect()
    }

    /// The part whose strengths the recordings determine least, where the 95 % intervals (half `widths`, of the free
    /// parameters) of all of them hold zero: such a mechanism may as well not be there.
    pub fn undetermined(&self, fitted: &FittedModel, widths: &[f64]) -> Option<usize> {
        let ratios =
            self.known(fitted, widths).into_iter().enumerate().filter(|(_, r)| *r != f64::NEG_INFINITY);
        let least = ratios.filter(|(_, ratio)| *ratio < 1.0).min_by(|a, b| a.1.total_cmp(&b.1));
        least.map(|(index, _)| index)
    }

    /// The parts that act at certain times of a single recording. Nothing tells when they would act in another.
    pub fn bound_to_a_clock(&self, fitted: &FittedModel) -> Vec<usize> {
        (0..fitted.parts.len()).filter(|i| self.is_bound_to_a_clock(&fitted.parts[*i].candidate)).collect()
    }

    /// Whether a candidate acts at certain times of a single recording.
    pub(crate) fn is_bound_to_a_clock(&self, candidate: &Candidate) -> bool {
        self.nominal.data.recordings.len() == 1 && is_timed(&self.library[candidate.mechanism])
    }

    /// Whether the mechanisms turn the sign of the mass matrix's determinant somewhere along the recordings: a negative
    /// inertia, or a coupling of accelerations stronger than the inertias that it couples.
    pub fn has_negative_inertia(
        &self,
        setup: &Setup,
        level: &Segmentation,
        point: &Point,
        scale: &[f64],
    ) -> bool {
        let along = TrajectoryEval::smoothed(setup, level, scale, point);
        let n0 = self.nominal.system.nz;
        let model = &setup.model;
        let highest: Vec<(&str, u8)> =
            self.nominal.model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let mass = |model: &Model| -> Option<Vec<greybox_model::Expr>> {
            let rows = model.equations.iter().take(n0).map(|e| Some(e.residual().affine_in(&highest)?.0));
            Some(rows.collect::<Option<Vec<_>>>()?.concat())
        };
        let (Some(before), Some(after)) = (mass(&self.nominal.model), mass(model)) else { return false };
        if before == after {
            return false;
        }
        let values = |exprs: &[greybox_model::Expr]| along.eval(exprs, &[]);
        let (Some(before), Some(after)) = (values(&before), values(&after)) else { return false };
        let sign = |values: &[Vec<Vec<f64>>], piece: usize, k: usize| {
            let mut a: Vec<f64> = values.iter().map(|e| e[piece][k]).collect();
            determinant_sign(&mut a, n0)
        };
        let pieces = self.nominal.data.lengths();
        pieces
            .iter()
            .enumerate()
            .any(|(p, &n)| (0..n).any(|k| sign(&before, p, k) * sign(&after, p, k) < 0.0))
    }

    /// Goes on with whole pieces where something is left over that is not noise: what acts slowly is hardly seen on a
    /// quarter of the data. Long free runs of a model that is wrong in small ways also bend it: what was found there counts
    /// where it predicts data left out of its fit better.
    fn go_on_to_the_end(&self, calibrated: &mut FittedModel, state: &mut SearchState) {
        let length = whole(&self.nominal);
        if self.lengths.last().is_some_and(|&last| 2 * last >= length)
            || !self.leaves_more(state)
            || self.is_spent()
        {
            return;
        }
        let before = (calibrated.clone(), state.clone());
        self.lengthen(calibrated, state, length);
        self.level(calibrated, state);
        self.restart_short_segments(calibrated, state);
        self.refine_structure(calibrated, state);
        if !self.predicts_better(&before.1, state) {
            (*calibrated, *state) = before;
        }
    }

    /// Whether more is left over than a single mechanism leaves of noise.
    fn leaves_more(&self, state: &SearchState) -> bool {
        let current = &state.current;
        current.parts.len() > 1 || !current.leaves_white_noise(&state.scale) && state.misfit() >= STUCK
    }

    /// Whether what another search found predicts data left out of its fit better, beyond chance.
    fn predicts_better(&self, standing: &SearchState, found: &SearchState) -> bool {
        let (criterion, reach) =
            standing.current.setup.criterion(&standing.current.fit.point.parameters, &standing.scale);
        let error = |s: &SearchState| errors(&s.current, &s.scale, criterion, reach);
        Gain::of(&error(standing), &error(found)).is_beyond_chance()
    }

    /// Searches once more from the calibrated model on the longest segments alone. What acts slowly (a light damping) is
    /// hardly seen on short ones, where the free starts of the segments absorb it, and what was taken for it there leaves
    /// more to be explained: the result of fewer mechanisms, or of more evidence, counts. Not where a single mechanism
    /// leaves nothing but white noise.
    fn search_long(&self, calibrated: &FittedModel, state: &mut SearchState) {
        let length = whole(&self.nominal);
        if !self.leaves_more(state)
            || self.lengths.last().is_some_and(|&last| last >= length)
            || self.is_spent()
        {
            return;
        }
        let plain = Setup { noise: None, ..calibrated.setup.clone() };
        let level = self.nominal.windows(length, MOST_SAMPLES);
        let mut baseline =
            self.relevel(&FittedModel { setup: plain, ..calibrated.clone() }, level, &state.scale, 20);
        let mut other = SearchState {
            scale: next_scale(&baseline.fit, &state.scale, &state.sigma),
            current: baseline.clone(),
            accepted: Vec::new(),
            sigma: state.sigma.clone(),
            allow_rare: false,
            rejected: Vec::new(),
        };
        baseline = self.refit(&baseline, &other.scale, 10);
        other.current = baseline.clone();
        self.level(&mut baseline, &mut other);
        self.refine_structure(&mut baseline, &mut other);
        if other.current.parts.is_empty() {
            if state.current.parts.is_empty() && !other.rejected.is_empty() {
                state.rejected = other.rejected;
            }
            return;
        }
        // Both over the calibrated model, on the same segments and in the same units.
        let scale = other.scale.clone();
        let mut standing = state.current.clone();
        standing.setup.noise = None;
        let standing = if standing.level.segments == other.current.level.segments {
            self.refit(&standing, &scale, 10)
        } else {
            self.relevel(&standing, other.current.level.clone(), &scale, 20)
        };
        let found = self.refit(&other.current, &scale, 10);
        let evidence = self.weigh(&standing, &found, &scale);
        let simpler = self.complexity(&found) < self.complexity(&standing);
        if evidence.score > if simpler { -PARSIMONY } else { PARSIMONY } {
            *state = other;
        }
    }

    /// Whether the work is used up. Asked only between one step of the search and the next: the sum does not
    /// depend on the order in which threads add to it.
    fn is_spent(&self) -> bool {
        self.would_overspend(0)
    }

    /// Whether so much more is too much. Of work that was given up, any is.
    fn would_overspend(&self, more: u64) -> bool {
        let work = &self.nominal.work;
        let over = work.done().saturating_add(more) > self.most_work || work.is_given_up();
        if over {
            self.limited.store(true, Ordering::Relaxed);
        }
        over
    }

    /// From the windows to all data. A mechanism that fits what the windows show and nothing beyond them is
    /// let go.
    fn refit_all_data(&self, state: &mut SearchState, whole: &Segmentation) {
        // A simulation that has left every bound is worse than any number.
        let worst = |a: f64, b: f64| if b.is_nan() { f64::INFINITY } else { a.max(b) };
        let ratio = |wide: &FittedModel, narrow: &FittedModel| -> f64 {
            let (a, b) = (raw_rms(wide, &state.scale), raw_rms(narrow, &state.scale));
            a.iter().zip(&b).map(|(a, b)| a / b.max(1e-300)).fold(0.0, worst)
        };
        let mut narrow = state.current.clone();
        let mut wide = self.relevel(&narrow, whole.clone(), &state.scale, 15);
        while narrow.parts.len() > 1 && ratio(&wide, &narrow) > BEYOND_WINDOWS {
            let smaller: Vec<(FittedModel, FittedModel)> = (0..narrow.parts.len())
                .into_par_iter()
                .filter_map(|i| {
                    let without = self.without(&narrow, i, &state.scale, 12)?;
                    let wide = self.relevel(&without, whole.clone(), &state.scale, 15);
                    Some((without, wide))
                })
                .collect();
            let best = smaller.into_iter().min_by(|a, b| a.1.fit.cost.total_cmp(&b.1.fit.cost));
            match best {
                Some(best) if best.1.fit.cost.total_cmp(&wide.fit.cost).is_lt() => (narrow, wide) = best,
                _ => break,
            }
        }
        state.accepted.retain(|a| wide.parts.iter().any(|p| p.candidate == a.candidate));
        state.current = wide;
    }

    /// A fit that is left well above the noise may be stuck where long segments led it: from the shortest
    /// segments up again, with all its mechanisms; if that is better, the search goes on from there.
    fn restart_short_segments(&self, calibrated: &mut FittedModel, state: &mut SearchState) {
        if state.misfit() < STUCK || self.lengths.len() < 2 || self.is_spent() {
            return;
        }
        let mut fitted = state.current.clone();
        for &length in &self.lengths {
            let level = same_level(&fitted.setup, &self.nominal.windows(length, MOST_SAMPLES));
            let smoothed_states = Point {
                parameters: fitted.fit.point.parameters.clone(),
                starts: fitted.setup.starts(&level, &fitted.fit.point.parameters),
            };
            let stitched = fitted.setup.stitch(&fitted.level, &fitted.fit.point, &level, &state.scale);
            // At the shortest, from the measurements alone: what the long segments believe is in doubt.
            let points = if length == self.lengths[0] {
                vec![smoothed_states]
            } else {
                vec![stitched, smoothed_states]
            };
            let fit = fitted.setup.fit(&level, &state.scale, &points, limits(25));
            fitted = FittedModel { level, fit, ..fitted };
        }
        if fitted.fit.cost < 0.98 * state.current.fit.cost {
            if fitted.parts.is_empty() {
                *calibrated = fitted.clone();
            }
            state.current = fitted;
            self.settle(state);
            self.level(calibrated, state);
        }
    }

    /// Goes on with longer segments.
    fn lengthen(&self, calibrated: &mut FittedModel, state: &mut SearchState, length: usize) {
        let level = self.nominal.windows(length, MOST_SAMPLES);
        self.listener.stage(Stage::Lengthening { segments: level.segments.len() });
        *calibrated = self.relevel(calibrated, level.clone(), &state.scale, 20);
        state.current = if state.current.parts.is_empty() {
            calibrated.clone()
        } else {
            self.relevel(&state.current, level, &state.scale, 20)
        };
        state.rescale();
        state.current = self.refit(&state.current, &state.scale, 10);
        state.current = self.redecide_holds(&state.current, &state.scale, SAME_HOLD);
        if !state.current.parts.is_empty() {
            self.prune(state);
        }
    }

    fn is_coloured(&self, state: &SearchState, below: f64) -> bool {
        let f = &state.current;
        least_effective_sample_ratio(&f.setup, &f.level, &state.scale, &f.fit.point) < below
    }

    /// The second pass: the noise has a model of its own (an autoregression per channel), residuals,
    /// sensitivities and candidates are whitened by it, and models are compared by the likelihood of
    /// their innovations.
    fn whitened(&self, calibrated: &mut FittedModel, state: &mut SearchState) {
        // Not the shortest: they hide the low frequencies of the noise.
        for &length in &self.lengths[self.lengths.len().saturating_sub(2)..] {
            let plain = Setup { noise: None, ..state.current.setup.clone() };
            state.current = FittedModel { setup: plain, ..state.current.clone() };
            let level = self.nominal.windows(length, MOST_SAMPLES);
            if level.segments != state.current.level.segments {
                state.current = self.relevel(&state.current, level.clone(), &state.scale, 20);
                *calibrated = if state.current.parts.is_empty() {
                    state.current.clone()
                } else {
                    self.relevel(calibrated, level, &state.scale, 20)
                };
            }
            state.whiten();
            state.current = self.refit(&state.current, &state.scale, 10);
            let samples = state.current.fit.count.iter().sum::<usize>().max(1) as f64;
            state.current = self.redecide_holds(&state.current, &state.scale, 4.0 / samples);
            state.whiten();
            self.prune(state);
            self.level(calibrated, state);
        }
    }

    /// One level: rounds until nothing more is believable.
    fn level(&self, calibrated: &mut FittedModel, state: &mut SearchState) {
        let mut seen: Vec<Vec<Candidate>> = Vec::new();
        // A round is dearer than the one before, which had a mechanism less to simulate.
        let mut last = 0;
        while state.current.parts.len() < MOST_MECHANISMS && !self.would_overspend(last) {
            let begun = self.nominal.work.done();
            if state.misfit() < 1.03 && !self.is_coloured(state, WHITE) && state.current.setup.noise.is_none()
            {
                break;
            }
            let before = state.candidates();
            if !self.round(calibrated, state) && !self.pair_round(calibrated, state) {
                break;
            }
            last = self.nominal.work.done() - begun;
            seen.push(before);
            if seen.contains(&state.candidates()) {
                break; // what was accepted has been dropped again
            }
        }
    }

    /// One round: the best candidate, if it is believable.
    fn round(&self, calibrated: &mut FittedModel, state: &mut SearchState) -> bool {
        let current = &state.current;
        let scale = state.scale.clone();
        let taken = |c: &Candidate| {
            current.parts.iter().any(|p| {
                p.candidate == *c
                    || (p.candidate.place == c.place
                        && self.library[p.candidate.mechanism]
                            .refines
                            .contains(&self.library[c.mechanism].kind))
            })
        };
        let open: Vec<Candidate> = self.all.iter().filter(|c| !taken(c)).cloned().collect();
        self.listener.stage(Stage::Screening { candidates: open.len(), found: current.parts.len() });
        let scored = screen(&current.setup, self.library, &open, &current.level, &scale, &current.fit.point);
        let ranking: Vec<(&str, f64)> =
            scored.iter().map(|s| (&*self.library[open[s.candidate].mechanism].kind, s.gain)).collect();
        self.listener.screened(&ranking);
        let least = if current.setup.noise.is_some() { 0.001 } else { 0.003 };
        let short = self.short_list(&open, &scored, least, SHORT_LIST, state.near_equals());
        let trials = self.all_trials(current, state, &open, &short, least);
        if trials.is_empty() {
            return false;
        }
        let Some((winner, chosen, rivals, evidence)) =
            self.decide(calibrated, current, &open, trials, &scale)
        else {
            return false;
        };
        // Control: the smaller model from the winner's parameters. If that is better than it was, the
        // baseline had been stuck.
        let control = self.refit_baseline(current, &chosen, &scale);
        let evidence = if control.fit.cost < current.fit.cost * 0.999 {
            if current.parts.is_empty() && current.setup.noise.is_none() {
                *calibrated = control.clone();
            }
            state.current = control;
            self.weigh(&state.current, &chosen, &scale)
        } else {
            evidence
        };
        let total: f64 = calibrated_rss(calibrated, &scale);
        let share =
            if evidence.whitened { 1.0 } else { (state.current.rss() - chosen.rss()) / total.max(1e-300) };
        let mechanism = &self.library[winner.mechanism];
        let believable =
            self.accepts(&evidence, mechanism, share, state.current.parts.is_empty(), state.allow_rare);
        self.tell((&state.current, &chosen), &[&mechanism.kind], &evidence, &scale, believable);
        if !believable {
            state.rejected = vec![chosen];
            return false;
        }
        self.accept(state, winner, chosen, rivals, evidence);
        true
    }

    /// Other points from which candidates are tried, where what calibration has made of the model may be the
    /// work of what is missing:
    ///
    /// - with the stated holds, where others fit better: half a sample of delay may be a delay;
    /// - at the nominal parameters, where the calibrated ones are far from them and the simulation still far
    ///   from the recording: a strong friction is taken for an inertia and a damping many times too large, and
    ///   no friction helps there.
    fn anchors(&self, current: &FittedModel, state: &SearchState) -> Vec<FittedModel> {
        let mut out = Vec::new();
        if !current.parts.is_empty() {
            return out; // what was found has changed the model already
        }
        let stated = current.setup.with_holds(self.nominal.holds.clone());
        if current.setup.holds != self.nominal.holds {
            let fitted = FittedModel { setup: stated.clone(), ..current.clone() };
            out.push(self.refit(&fitted, &state.scale, 10));
        }
        if current.setup.noise.is_none() && current.misfit(&state.scale) > FAR {
            let nominal = self.nominal.values();
            let moved = current.setup.free.iter().any(|f| {
                let (was, is) = (nominal[f.index], current.fit.point.parameters[f.index]);
                !(1.0 / MOVED..=MOVED).contains(&(is / was))
            });
            if moved {
                let starts = current.setup.starts(&current.level, &nominal);
                let held = Setup { free: Vec::new(), ..stated.clone() };
                let start = Point { parameters: nominal, starts };
                let fit = held.fit(&current.level, &state.scale, &[start], limits(STARTS));
                out.push(FittedModel { setup: stated, fit, ..current.clone() });
            }
        }
        out.retain(|f| f.fit.cost.is_finite());
        out
    }

    /// Fits a short-list from `base`, and what ranks high at its anchors from these: of each candidate the better.
    fn all_trials(
        &self,
        base: &FittedModel,
        state: &SearchState,
        open: &[Candidate],
        short: &[&Scored],
        least: f64,
    ) -> Vec<(usize, FittedModel)> {
        let scale = &state.scale;
        let anchors: Vec<(FittedModel, Vec<Scored>)> = self
            .anchors(base, state)
            .into_iter()
            .map(|a| {
                let scored = screen(&a.setup, self.library, open, &a.level, scale, &a.fit.point);
                (a, scored)
            })
            .collect();
        let anchored: Vec<(&FittedModel, Vec<&Scored>)> =
            anchors.iter().map(|(a, s)| (a, self.short_list(open, s, least, SHORT_LIST, 0))).collect();
        let candidates = short.len() + anchored.iter().map(|a| a.1.len()).sum::<usize>();
        if candidates > 0 {
            self.listener.stage(Stage::Fitting { candidates });
        }
        let mut trials = self.trials(base, open, short, scale);
        for (anchor, short) in anchored {
            for (c, fitted) in self.trials(anchor, open, &short, scale) {
                match trials.iter_mut().find(|t| t.0 == c) {
                    Some(known) if fitted.fit.cost < known.1.fit.cost => known.1 = fitted,
                    Some(_) => {}
                    None => trials.push((c, fitted)),
                }
            }
        }
        trials
    }

    /// Fits a short-list: all of it a little, the more promising half further, the best to the end.
    fn trials(
        &self,
        base: &FittedModel,
        open: &[Candidate],
        short: &[&Scored],
        scale: &[f64],
    ) -> Vec<(usize, FittedModel)> {
        let mut trials: Vec<(usize, FittedModel)> = short
            .par_iter()
            .filter_map(|s| self.trial(base, &open[s.candidate], s, scale).map(|f| (s.candidate, f)))
            .collect();
        trials.sort_by(|a, b| a.1.rss().total_cmp(&b.1.rss()).then(a.0.cmp(&b.0)));
        let rest = trials.split_off(trials.len().min(FINALISTS));
        let go_on = |trials: Vec<(usize, FittedModel)>, steps: usize| -> Vec<(usize, FittedModel)> {
            trials
                .into_par_iter()
                .map(|(c, f)| {
                    (c, if f.fit.ending == Ending::Limit { self.refit(&f, scale, steps) } else { f })
                })
                .filter(|(_, f)| self.admissible(f, scale))
                .collect()
        };
        let mut finished = go_on(trials, MORE_STEPS);
        // The best of these to the very end, or the one that started better would win.
        finished.sort_by(|a, b| a.1.rss().total_cmp(&b.1.rss()).then(a.0.cmp(&b.0)));
        let others = finished.split_off(finished.len().min(BEST));
        finished = go_on(finished, LAST_STEPS);
        finished.extend(others);
        finished.extend(rest);
        finished
    }

    /// The `most` strongest candidates, no more than two of a kind, and up to `more` of other kinds near the best.
    pub(crate) fn short_list<'s>(
        &self,
        open: &[Candidate],
        scored: &'s [Scored],
        least: f64,
        most: usize,
        more: usize,
    ) -> Vec<&'s Scored> {
        let mut short: Vec<&Scored> = Vec::new();
        for s in scored {
            let kind = &self.library[open[s.candidate].mechanism].kind;
            let of_kind =
                short.iter().filter(|o| self.library[open[o.candidate].mechanism].kind == *kind).count();
            // A test of first order ranks no finer than this: of every kind at least one.
            let near = of_kind == 0 && s.gain > NEARLY * scored[0].gain && short.len() < most + more;
            if s.gain > least && of_kind < 2 && (near || short.len() < most) {
                short.push(s);
            }
        }
        short
    }

    /// Takes a winner over, and settles what follows from it: its simpler parts, the scale, the hold, the
    /// mechanisms that no longer pay.
    fn accept(
        &self,
        state: &mut SearchState,
        winner: Candidate,
        chosen: FittedModel,
        rivals: Vec<Rival>,
        evidence: Evidence,
    ) {
        let scale = state.scale.clone();
        // A refinement has replaced its simpler relative.
        let before = state.accepted.clone();
        state.accepted.retain(|a| chosen.parts.iter().any(|p| p.candidate == a.candidate));
        match self.split(&chosen, &scale) {
            Some(split) => {
                let whole = Rival {
                    candidate: winner.clone(),
                    instance: chosen.parts[chosen.parts.len() - 1].instance.clone(),
                    evidence,
                    equivalent: true,
                };
                for part in &split.parts[chosen.parts.len() - 1..] {
                    // A part that was there before keeps its own evidence.
                    if let Some(known) = before.iter().find(|a| a.candidate == part.candidate) {
                        let mut known = known.clone();
                        known.rivals.retain(|r| r.candidate != winner);
                        known.rivals.insert(0, whole.clone());
                        state.accepted.push(known);
                        continue;
                    }
                    // What was tried beside the whole is no equal of its parts alone.
                    let mut others = vec![whole.clone()];
                    others.extend(
                        rivals
                            .iter()
                            .filter(|r| !split.parts.iter().any(|p| p.candidate == r.candidate))
                            .map(|r| Rival { equivalent: false, ..r.clone() }),
                    );
                    state.accepted.push(SelectedTerm {
                        candidate: part.candidate.clone(),
                        evidence,
                        rivals: others,
                    });
                }
                state.current = split;
            }
            None => {
                state.current = chosen;
                state.accepted.push(SelectedTerm { candidate: winner, evidence, rivals });
            }
        }
        self.settle(state);
    }

    /// After an acceptance: the noise or the scale anew, the hold, the mechanisms that no longer pay.
    fn settle(&self, state: &mut SearchState) {
        if state.current.setup.noise.is_some() {
            state.whiten();
            self.method(&mut state.current, &state.scale);
            state.current = self.refit(&state.current, &state.scale, 10);
            state.whiten();
            state.current = self.refit(&state.current, &state.scale, 5);
        } else {
            state.rescale();
            self.method(&mut state.current, &state.scale);
            state.current = self.refit(&state.current, &state.scale, 10);
            let holds = state.current.setup.holds.clone();
            state.current = self.redecide_holds(&state.current, &state.scale, SAME_HOLD);
            if state.current.setup.holds != holds {
                state.rescale();
                self.method(&mut state.current, &state.scale);
                state.current = self.refit(&state.current, &state.scale, 10);
            }
            state.rescale();
            state.current = self.refit(&state.current, &state.scale, 5);
        }
        self.prune(state);
    }

    /// Second thoughts; where they change the model, whether it lacks something still. Mechanisms that were thought of before
    /// would lead to the same again.
    fn refine_structure(&self, calibrated: &mut FittedModel, state: &mut SearchState) {
        let mut seen: Vec<Vec<Candidate>> = Vec::new();
        while seen.len() < MOST_MECHANISMS && !self.is_spent() {
            let before = state.candidates();
            if seen.iter().any(|s| is_same(s, &before)) {
                break;
            }
            self.reconsider(calibrated, state);
            if state.candidates() == before {
                break;
            }
            seen.push(before);
            let after = state.candidates();
            self.level(calibrated, state);
            if state.candidates() == after {
                break;
            }
        }
    }

    /// Every mechanism again, with all others in place and the segments at their longest: what else could
    /// stand in its stead? The better (or the simpler of equals) takes its place; the others are the
    /// alternatives of the report.
    fn reconsider(&self, calibrated: &FittedModel, state: &mut SearchState) {
        self.reconsider_pair(state);
        let mut index = 0;
        let mut relieved = 0;
        while index < state.current.parts.len() && !self.is_spent() {
            let at = index;
            index += 1;
            let Some(base) = self.without(&state.current, at, &state.scale, 12) else { continue };
            let part = state.current.parts[at].clone();
            let taken = |c: &Candidate| base.parts.iter().any(|p| p.candidate == *c);
            let open: Vec<Candidate> = self.all.iter().filter(|c| !taken(c)).cloned().collect();
            self.listener.stage(Stage::Screening { candidates: open.len(), found: base.parts.len() });
            let scored = screen(&base.setup, self.library, &open, &base.level, &state.scale, &base.fit.point);
            let relatives = &self.library[part.candidate.mechanism].about.confused_with;
            let mut short = self.short_list(&open, &scored, 0.003, RIVALS, state.near_equals());
            // Those it is confused with at the same place, even where the score test ranks them low.
            for s in &scored {
                let c = &open[s.candidate];
                let kind = &self.library[c.mechanism].kind;
                if relatives.contains(kind)
                    && !short.iter().any(|o| self.library[open[o.candidate].mechanism].kind == *kind)
                {
                    short.push(s);
                }
            }
            short.retain(|s| open[s.candidate] != part.candidate);
            let mut trials = self.all_trials(&base, state, &open, &short, 0.003);
            trials.retain(|(c, _)| open[*c] != part.candidate);
            if let Some(own) = open.iter().position(|c| *c == part.candidate) {
                // The fit that stands, its part at the end like that of the others.
                let mut standing = state.current.clone();
                standing.parts.remove(at);
                standing.parts.push(part.clone());
                trials.push((own, standing));
            }
            // Of those that fit as well: one that makes another mechanism superfluous.
            if relieved < MOST_MECHANISMS && self.swap_and_drop(&base, state, &open, &trials, &part) {
                // From the first again: fewer mechanisms, other alternatives.
                relieved += 1;
                index = 0;
                continue;
            }
            let Some((winner, chosen, rivals, evidence)) =
                self.decide(calibrated, &base, &open, trials, &state.scale)
            else {
                continue;
            };
            let known = state.accepted.iter_mut().find(|a| a.candidate == part.candidate);
            if winner == part.candidate {
                if let Some(known) = known {
                    // What equals it exactly stays declared so.
                    let before = std::mem::replace(&mut known.rivals, rivals);
                    for old in before.into_iter().filter(|r| r.equivalent) {
                        match known.rivals.iter_mut().find(|r| r.candidate == old.candidate) {
                            Some(new) => new.equivalent = true,
                            None => known.rivals.push(old),
                        }
                    }
                    known.evidence = evidence;
                }
                continue;
            }
            let mechanism = &self.library[winner.mechanism];
            // On few data, what was found on short segments is not traded for a whim of the long ones.
            let believable = state.current.fit.count.iter().sum::<usize>() >= PAIR_SAMPLES
                && self.accepts(&evidence, mechanism, 1.0, base.parts.is_empty(), state.allow_rare);
            self.tell((&base, &chosen), &[&mechanism.kind], &evidence, &state.scale, believable);
            if !believable {
                continue;
            }
            state.accepted.retain(|a| a.candidate != part.candidate);
            self.accept(state, winner, chosen, rivals, evidence);
        }
    }

    /// Two mechanisms of one family may be the round-about way to another two that only pay together (which
    /// the search, one at a time, does not see): the best simpler pair that fits as well takes their place.
    fn reconsider_pair(&self, state: &mut SearchState) {
        let current = state.current.clone();
        let family = |p: &MechanismTerm| &self.library[p.candidate.mechanism].family;
        let samples: usize = current.fit.count.iter().sum();
        let [first, second] = &current.parts[..] else { return };
        if family(first) != family(second) || self.complexity(&current) <= 2.0 || samples < PAIR_SAMPLES {
            return;
        }
        let scale = state.scale.clone();
        let Some(base) =
            self.without(&current, 1, &scale, 12).and_then(|one| self.without(&one, 0, &scale, 12))
        else {
            return;
        };
        let pairs =
            screen_pairs(&base.setup, self.library, &self.all, &base.level, &scale, &base.fit.point, PAIRS);
        self.listener.stage(Stage::Fitting { candidates: pairs.len() });
        let best = pairs
            .par_iter()
            .filter_map(|p| self.extend_by_pair(&base, &self.all, p, &scale))
            .filter(|f| self.complexity(f) < self.complexity(&current))
            .collect::<Vec<_>>()
            .into_iter()
            .min_by(|a, b| a.rss().total_cmp(&b.rss()));
        let Some(best) = best else { return };
        let evidence = self.weigh(&base, &best, &scale);
        if evidence.score + PARSIMONY > self.weigh(&base, &current, &scale).score {
            state.accepted = best
                .parts
                .iter()
                .map(|p| SelectedTerm { candidate: p.candidate.clone(), evidence, rivals: Vec::new() })
                .collect();
            state.current = best;
            self.settle(state);
        }
    }

    /// Takes over a trial that fits nearly as well as the standing one and lets another mechanism go.
    fn swap_and_drop(
        &self,
        base: &FittedModel,
        state: &mut SearchState,
        open: &[Candidate],
        trials: &[(usize, FittedModel)],
        standing: &MechanismTerm,
    ) -> bool {
        if state.current.parts.len() < 2 {
            return false;
        }
        let best = state.current.rss();
        for (c, trial) in trials {
            let near = trial.rss() < 1.02 * best;
            let whole = !self.library[open[*c].mechanism].equals.is_empty();
            if !near
                || whole
                || open[*c] == standing.candidate
                || trial.parts.len() != state.current.parts.len()
            {
                continue;
            }
            for index in 0..trial.parts.len() - 1 {
                let Some(smaller) = self.without(trial, index, &state.scale, 12) else { continue };
                let e = self.weigh(&smaller, &state.current, &state.scale);
                if e.score > PARSIMONY || e.drop > 0.02 {
                    continue;
                }
                let evidence = self.weigh(base, trial, &state.scale);
                state.accepted.retain(|a| smaller.parts.iter().any(|p| p.candidate == a.candidate));
                state.accepted.push(SelectedTerm {
                    candidate: open[*c].clone(),
                    evidence,
                    rivals: Vec::new(),
                });
                state.current = smaller;
                self.settle(state);
                return true;
            }
        }
        false
    }

    /// Fits a candidate: added, or in place of the relative that it refines.
    fn trial(
        &self,
        current: &FittedModel,
        candidate: &Candidate,
        scored: &Scored,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let fitted = self.fitted_trial(current, candidate, scored, scale)?;
        self.admissible(&fitted, scale).then_some(fitted)
    }

    fn fitted_trial(
        &self,
        current: &FittedModel,
        candidate: &Candidate,
        scored: &Scored,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let refined = current.parts.iter().position(|p| {
            p.candidate.place == candidate.place
                && self.library[candidate.mechanism]
                    .refines
                    .contains(&self.library[p.candidate.mechanism].kind)
        });
        match refined {
            None => self.extend(current, candidate, scored, scale, FIRST_STEPS),
            Some(index) => {
                let base = self.without(current, index, scale, 6)?;
                let again = screen(
                    &base.setup,
                    self.library,
                    std::slice::from_ref(candidate),
                    &base.level,
                    scale,
                    &base.fit.point,
                );
                self.extend(&base, candidate, again.first()?, scale, FIRST_STEPS)
            }
        }
    }

    /// The last part written as the sum of simpler mechanisms that it equals exactly.
    fn split(&self, fitted: &FittedModel, scale: &[f64]) -> Option<FittedModel> {
        let mut parts = self.laws(fitted);
        let (whole, values, _) = parts.pop()?;
        let mechanism = &self.library[whole.mechanism];
        if mechanism.equals.is_empty() {
            return None;
        }
        let Place::Motion(motion) = &whole.place else { return None };
        let touched: Vec<usize> = (0..motion.weights.len()).filter(|&e| motion.weights[e] != 0.0).collect();
        let value = |n: &str| Some(values[mechanism.parameters().position(|p| p == n)?]);
        for (kind, _, expression) in &mechanism.equals {
            let part = self.all.iter().find(|c| {
                self.library[c.mechanism].kind == *kind
                    && !parts.iter().any(|p| p.0 == **c)
                    && match &c.place {
                        Place::Equation(e) => touched == [*e] && motion.weights[*e] == 1.0,
                        place => *place == whole.place && !c.mirrored,
                    }
            })?;
            parts.push((part.clone(), vec![expression.eval(&|n, _| value(n))?], Vec::new()));
        }
        self.reassembled(fitted, &parts, scale, 3)
    }

    /// The model without the winner, from the winner's parameters.
    fn refit_baseline(&self, current: &FittedModel, chosen: &FittedModel, scale: &[f64]) -> FittedModel {
        let mut parameters = current.fit.point.parameters.clone();
        for (p, name) in parameters.iter_mut().zip(current.setup.model.parameters.iter().map(|p| &p.name)) {
            if let Some(i) = chosen.setup.model.parameter(name) {
                *p = chosen.fit.point.parameters[i];
            }
        }
        let starts = transfer(&chosen.setup, &current.level, &chosen.fit.point.starts, &current.setup, &[]);
        let points = [Point { parameters, starts }];
        let fit = current.setup.fit(&current.level, scale, &points, limits(15));
        if fit.cost < current.fit.cost { FittedModel { fit, ..current.clone() } } else { current.clone() }
    }

    /// The best trial by score, unless a simpler one is as good; with the evidence of all.
    fn decide(
        &self,
        calibrated: &FittedModel,
        current: &FittedModel,
        open: &[Candidate],
        trials: Vec<(usize, FittedModel)>,
        scale: &[f64],
    ) -> Option<(Candidate, FittedModel, Vec<Rival>, Evidence)> {
        // One information per sample for all: that of the residual which fits best.
        let best = trials.iter().min_by(|a, b| a.1.rss().total_cmp(&b.1.rss()))?;
        let ratios = effective_sample_ratio(&best.1.setup, &best.1.level, scale, &best.1.fit.point);
        let mut weighed: Vec<(usize, FittedModel, Evidence)> = trials
            .into_par_iter()
            .map(|(c, f)| {
                let e = self.weigh_with(current, &f, scale, &ratios);
                (c, f, e)
            })
            .collect();
        weighed.sort_by(|a, b| b.2.score.total_cmp(&a.2.score).then(a.0.cmp(&b.0)));
        for (c, f, e) in &weighed {
            if let Some(part) = f.parts.last() {
                let kind = &self.library[open[*c].mechanism].kind;
                self.listener.tried(kind, &part.instance.expression.to_string(), e);
            }
        }
        let total = calibrated_rss(calibrated, scale);
        let mut undetermined = Vec::new();
        let best = loop {
            if weighed.is_empty() {
                return None;
            }
            let best = self.best_of(&weighed, open, total, scale);
            if self.gives_way(&weighed, best, current, open, scale) {
                undetermined.push(weighed.remove(best));
            } else if self.shows_nothing(&weighed[best].1, scale) {
                weighed.remove(best);
            } else {
                break best;
            }
        };
        let (chosen, fitted, evidence) = weighed.remove(best);
        let likelihood = by_likelihood(&fitted, &evidence, scale);
        let tell = |(c, f, e): (usize, FittedModel, Evidence), undetermined: bool| {
            // The data cannot separate what fits as well with no more parameters, nor what the evidence
            // leaves at odds that no one would bet on: close scores, or criteria that contradict each other
            // (BIC asks for certainty, Akaike's for a better prediction).
            let as_good = self.complexity(&f) <= self.complexity(&fitted)
                && !likelihood
                && f.fit.rss.iter().zip(&fitted.fit.rss).all(|(x, y)| *x < 1.005 * y);
            let disputed = likelihood && (e.score < evidence.score) != (e.akaike < evidence.akaike);
            let close = (e.score - evidence.score).abs() < UNDECIDED;
            // A refinement that the data do not show cannot be told from the law that it refines; from others it may.
            let refined = &self.library[open[c].mechanism].refines;
            let undetermined = undetermined && refined.contains(&self.library[open[chosen].mechanism].kind);
            let equivalent = as_good || disputed || close || undetermined;
            let instance = f.parts.last()?.instance.clone();
            Some(Rival { candidate: open[c].clone(), instance, evidence: e, equivalent })
        };
        let rivals =
            undetermined.into_iter().map(|u| (u, true)).chain(weighed.into_iter().map(|w| (w, false)));
        let rivals = rivals.filter_map(|(trial, undetermined)| tell(trial, undetermined)).collect();
        Some((open[chosen].clone(), fitted, rivals, evidence))
    }

    /// Whether the recordings determine none of the strengths of a model's last part.
    fn shows_nothing(&self, fitted: &FittedModel, scale: &[f64]) -> bool {
        let last = fitted.parts.len().wrapping_sub(1);
        self.undetermined(fitted, &Uncertainty::of(fitted, scale).widths()) == Some(last)
    }

    /// Whether a refinement is no choice: the law that it refines is at hand, and the data do not show its parts.
    fn gives_way(
        &self,
        weighed: &[(usize, FittedModel, Evidence)],
        best: usize,
        current: &FittedModel,
        open: &[Candidate],
        scale: &[f64],
    ) -> bool {
        let (candidate, fitted) = (&open[weighed[best].0], &weighed[best].1);
        let standing = current.parts.iter().map(|p| &p.candidate);
        let mut at_hand = standing.chain(weighed.iter().map(|(c, ..)| &open[*c]));
        at_hand.any(|c| self.is_refined_by(c, candidate))
            && self.is_undetermined(fitted, fitted.parts.len().wrapping_sub(1), scale)
    }

    fn is_refined_by(&self, law: &Candidate, refinement: &Candidate) -> bool {
        law.place == refinement.place
            && self.library[refinement.mechanism].refines.contains(&self.library[law.mechanism].kind)
    }

    /// Whether the 95 % interval of one of a part's strengths is wider than the largest of them.
    fn is_undetermined(&self, fitted: &FittedModel, part: usize, scale: &[f64]) -> bool {
        let strengths = self.strengths(fitted, part, scale);
        let largest = strengths.iter().map(|s| s.value.abs()).fold(0.0, f64::max);
        strengths.iter().any(|s| s.width > largest)
    }

    /// The linear parameters of a part that are fitted; none of a part that is not there.
    fn strengths(&self, fitted: &FittedModel, part: usize, scale: &[f64]) -> Vec<Strength> {
        let Some(part) = fitted.parts.get(part) else { return Vec::new() };
        let mechanism = &self.library[part.candidate.mechanism];
        let widths = Uncertainty::of(fitted, scale).widths();
        mechanism
            .parameters()
            .zip(&part.instance.names)
            .filter(|(plain, _)| mechanism.linear.iter().any(|l| l == plain))
            .filter_map(|(plain, name)| {
                let index = fitted.setup.model.parameter(name)?;
                let at = fitted.setup.free.iter().position(|f| f.index == index)?;
                let least =
                    if mechanism.positive.iter().any(|p| p == plain) { 0.0 } else { f64::NEG_INFINITY };
                Some(Strength { index, value: fitted.fit.point.parameters[index], width: widths[at], least })
            })
            .collect()
    }

    /// The model with a law in place of its refinement, from the refinement's parameters.
    fn simpler(&self, fitted: &FittedModel, index: usize, scale: &[f64]) -> Option<FittedModel> {
        let mut parts = self.laws(fitted);
        let (refinement, values, _) = &parts[index];
        let law = self.all.iter().find(|c| self.is_refined_by(c, refinement))?;
        if parts.iter().any(|p| p.0 == *law) {
            return None;
        }
        let mechanism = &self.library[refinement.mechanism];
        let known: Vec<(&str, f64)> = mechanism.parameters().zip(values.iter().copied()).collect();
        let strength = known
            .iter()
            .filter(|(n, _)| mechanism.linear.iter().any(|l| l == n))
            .map(|k| k.1)
            .max_by(|a, b| a.abs().total_cmp(&b.abs()))?;
        let inner = &self.library[law.mechanism];
        let values = inner.parameters().map(|n| {
            let linear = inner.linear.iter().any(|l| l == n);
            if linear { Some(strength) } else { known.iter().find(|k| k.0 == n).map(|k| k.1) }
        });
        parts[index] = (law.clone(), values.collect::<Option<_>>()?, Vec::new());
        self.reassembled(fitted, &parts, scale, LAST_STEPS)
    }

    /// The best by score, unless a simpler one is as good.
    fn best_of(
        &self,
        weighed: &[(usize, FittedModel, Evidence)],
        open: &[Candidate],
        total: f64,
        scale: &[f64],
    ) -> usize {
        let priority = |c: usize| self.library[open[c].mechanism].rank;
        let mut best = 0;
        for i in 1..weighed.len() {
            let (a, b) = (&weighed[best], &weighed[i]);
            // (Of innovations a per cent is much: they hold what cannot be predicted. There, and where the
            // residual is white and as small as the noise, the likelihood alone speaks.)
            let likelihood = by_likelihood(&a.1, &a.2, scale);
            let near = |slack: f64| {
                !likelihood
                    && a.1.fit.rss.iter().zip(&b.1.fit.rss).all(|(x, y)| {
                        *y < (1.0 + slack) * x || (slack > 0.01 && (y - x) < LEAST_SHARE * total)
                    })
            };
            // As good in every channel, or within what a likelihood can tell. Far above the noise each
            // parameter more must buy its share: there, any flexible law follows what another law lacks.
            let surplus = self.complexity(&a.1) - self.complexity(&b.1);
            let slack = if a.1.misfit(scale) > FAR { SHARE_PER_PARAMETER * surplus } else { 0.0 }.max(0.02);
            let simpler = surplus > 0.0 && (near(slack) || a.2.score - b.2.score < PARSIMONY);
            let tie = self.complexity(&b.1) == self.complexity(&a.1)
                && (near(0.005) || (likelihood && a.2.score - b.2.score < SAME_SCORE))
                && priority(b.0) < priority(a.0);
            if simpler || tie {
                best = i;
            }
        }
        best
    }

    /// Drops what no longer pays.
    fn prune(&self, state: &mut SearchState) {
        let mut index = 0;
        // What was found on coloured residuals stands the test of white ones, or goes.
        let least_parts = if state.current.setup.noise.is_some() { 0 } else { 1 };
        while state.current.parts.len() > least_parts && index < state.current.parts.len() {
            let Some(smaller) = self.without(&state.current, index, &state.scale, 12) else {
                index += 1;
                continue;
            };
            let e = self.weigh(&smaller, &state.current, &state.scale);
            // A little less than what it takes to be accepted, or rounds would go in circles.
            let least = match (e.whitened, e.effective_sample_ratio > WHITE) {
                (true, _) => 0.0025,
                (false, true) => 0.004,
                (false, false) => 0.01,
            };
            if e.score < LEAST_SCORE || e.drop < least {
                let gone = state.current.parts[index].candidate.clone();
                self.listener.dropped(&self.library[gone.mechanism].kind);
                state.accepted.retain(|a| a.candidate != gone);
                state.current = smaller;
                index = 0;
            } else {
                index += 1;
            }
        }
    }

    /// Puts a law in the place of its refinement where the data do not show the refinement's parts, and the law fits
    /// as well.
    fn simplify(&self, state: &mut SearchState) {
        for index in 0..state.current.parts.len() {
            let MechanismTerm { candidate: refinement, instance, .. } = state.current.parts[index].clone();
            let mechanism = &self.library[refinement.mechanism];
            if mechanism.refines.is_empty() || !self.is_undetermined(&state.current, index, &state.scale) {
                continue;
            }
            let Some(simpler) = self.simpler(&state.current, index, &state.scale) else { continue };
            let over = self.weigh(&simpler, &state.current, &state.scale);
            if over.score >= LEAST_SCORE {
                continue;
            }
            let Some(base) = self.without(&simpler, index, &state.scale, 12) else { continue };
            let evidence = self.weigh(&base, &simpler, &state.scale);
            self.listener.dropped(&mechanism.kind);
            let law = simpler.parts[index].candidate.clone();
            if let Some(known) = state.accepted.iter_mut().find(|a| a.candidate == refinement) {
                known.rivals.retain(|r| r.candidate != law);
                let before = std::mem::replace(&mut known.evidence, evidence);
                known.candidate = law;
                let rival = Rival { candidate: refinement, instance, evidence: before, equivalent: true };
                known.rivals.insert(0, rival);
            }
            state.current = simpler;
        }
    }

    /// Declares refinements that these recordings would not show equals of the law that they refine: that BIC prefers
    /// the law says then no more than that it is the simpler.
    fn mark_unidentifiable(&self, state: &mut SearchState) {
        for index in 0..state.current.parts.len() {
            let law = state.current.parts[index].candidate.clone();
            let Some(known) = state.accepted.iter_mut().find(|a| a.candidate == law) else { continue };
            for refinement in self.all.iter().filter(|c| self.is_refined_by(&law, c)) {
                if known.rivals.iter().any(|r| r.equivalent && r.candidate == *refinement) {
                    continue;
                }
                if self.is_spent() {
                    return;
                }
                let Some(instance) = self.unseen(&state.current, index, refinement, &state.scale) else {
                    continue;
                };
                match known.rivals.iter_mut().find(|r| r.candidate == *refinement) {
                    Some(rival) => rival.equivalent = true,
                    None => known.rivals.push(Rival {
                        candidate: refinement.clone(),
                        instance,
                        evidence: known.evidence,
                        equivalent: true,
                    }),
                }
            }
        }
    }

    /// A refinement that may be there unseen, in place of the law that it refines: at half or more of the first values
    /// of its inner parameters the 95 % interval of one of its strengths reaches further than [`SUBSTANTIAL`] from the
    /// law's. Only of a refinement that is the law itself where its strengths are the law's.
    fn unseen(
        &self,
        fitted: &FittedModel,
        index: usize,
        refinement: &Candidate,
        scale: &[f64],
    ) -> Option<Instance> {
        let parts = self.laws(fitted);
        let (law, mechanism) = (&self.library[parts[index].0.mechanism], &self.library[refinement.mechanism]);
        let ([_], [strength]) = (&law.linear[..], &parts[index].1[..]) else { return None };
        if !mechanism.is_at_equal_strengths(law) {
            return None;
        }
        let along = TrajectoryEval::smoothed(&fitted.setup, &fitted.level, scale, &fitted.fit.point);
        let scales = inner_scales(mechanism, refinement, &along, &fitted.setup)?;
        let choices = first_values(mechanism, &scales);
        let at = |inner: &Vec<f64>| -> Option<(bool, Instance)> {
            let mut parts = parts.clone();
            let values = mechanism.values(&vec![*strength; mechanism.linear.len()], inner)?;
            parts[index] = (refinement.clone(), values, scales.clone());
            let held = self.held(fitted, &parts, index, scale)?;
            let instance = held.parts[index].instance.clone();
            Some((self.may_differ(&held, index, *strength, scale), instance))
        };
        let found: Vec<(bool, Instance)> = choices.par_iter().filter_map(at).collect();
        let unseen = found.iter().filter(|f| f.0).count();
        (2 * unseen >= choices.len()).then(|| found.into_iter().next().map(|f| f.1)).flatten()
    }

    /// The model with these parts, of which one has its inner parameters held where they are.
    fn held(&self, fitted: &FittedModel, parts: &[Law], index: usize, scale: &[f64]) -> Option<FittedModel> {
        let mut held = self.reassembled(fitted, parts, scale, 0)?;
        let mechanism = &self.library[held.parts[index].candidate.mechanism];
        let names = mechanism.parameters().zip(&held.parts[index].instance.names);
        let inner: Vec<usize> = names
            .filter(|(plain, _)| !mechanism.linear.iter().any(|l| l == plain))
            .filter_map(|(_, name)| held.setup.model.parameter(name))
            .collect();
        held.setup.free.retain(|f| !inner.contains(&f.index));
        Some(self.refit(&held, scale, STEPS_TO_TELL))
    }

    /// Whether an admissible end of the 95 % interval of one of a part's strengths lies further than [`SUBSTANTIAL`]
    /// from this one.
    fn may_differ(&self, fitted: &FittedModel, index: usize, strength: f64, scale: &[f64]) -> bool {
        let admissible = |at: usize, value: f64| {
            let mut parameters = fitted.fit.point.parameters.clone();
            parameters[at] = value;
            self.allows(&fitted.parts[index], &fitted.setup, &parameters)
        };
        self.strengths(fitted, index, scale).iter().any(|s| {
            [(s.value - s.width).max(s.least), s.value + s.width]
                .iter()
                .any(|end| (end - strength).abs() > SUBSTANTIAL * strength.abs() && admissible(s.index, *end))
        })
    }
}

/// Whether a law depends on the time since a recording began.
fn is_timed(mechanism: &Mechanism) -> bool {
    mechanism.law.mentions("t")
}

/// Whether a mechanism lets a parameter change with time.
fn is_drift(mechanism: &Mechanism) -> bool {
    mechanism.on == crate::library::On::Parameter && is_timed(mechanism)
}

/// A fitted linear parameter of a mechanism.
struct Strength {
    /// Index in the model.
    index: usize,
    value: f64,
    /// Half of the 95 % interval.
    width: f64,
    /// Least admissible value.
    least: f64,
}

/// Where the search stands.
#[derive(Clone)]
struct SearchState {
    current: FittedModel,
    accepted: Vec<SelectedTerm>,
    /// Residual scale per channel, SI.
    scale: Vec<f64>,
    /// Noise per channel, SI.
    sigma: Vec<f64>,
    /// Rare effects may be believed.
    allow_rare: bool,
    /// With the best single candidate, and the best pair, of the last round that found nothing to be believed.
    rejected: Vec<FittedModel>,
}

impl SearchState {
    fn candidates(&self) -> Vec<Candidate> {
        self.current.parts.iter().map(|p| p.candidate.clone()).collect()
    }

    /// Largest residual RMS over the noise.
    fn misfit(&self) -> f64 {
        self.current.misfit(&self.scale)
    }

    /// How many near-equals of other kinds are fitted as well: none where the model is far off, and the order of
    /// what it lacks matters more than which of two comes first.
    fn near_equals(&self) -> usize {
        if self.current.setup.noise.is_some() || self.misfit() < FAR { MORE } else { 0 }
    }

    fn rescale(&mut self) {
        self.scale = next_scale(&self.current.fit, &self.scale, &self.sigma);
    }

    /// Whether what is left over can be coloured noise (not white noise with a slow misfit).
    fn noise_is_coloured(&self) -> bool {
        let f = &self.current;
        coloured_channels(f, &self.scale).into_iter().any(|c| c)
    }

    /// The noise model that suits the current residual, and its innovations as the scale.
    fn whiten(&mut self) {
        let f = &self.current;
        let noise = f.setup.innovations(&f.level, &self.scale, &f.fit.point);
        for ((s, a), sigma) in self.scale.iter_mut().zip(&noise).zip(&self.sigma) {
            *s = a.variance().sqrt().max(0.2 * sigma);
        }
        self.current.setup.noise = Some(Arc::new(noise));
    }
}

/// Per channel: the residual is correlated, and its innovations stand clear of the noise that fast
/// differences show and are no tiny part of it. Coloured noise has little power at high frequencies (for an
/// autoregression with a coefficient near one, innovations are twice what the differences say); a slow misfit
/// over white noise leaves innovations of just that noise.
pub fn coloured_channels(f: &FittedModel, scale: &[f64]) -> Vec<bool> {
    let noise = f.setup.innovations(&f.level, scale, &f.fit.point);
    noise
        .iter()
        .zip(&f.setup.data.sigma)
        .zip(raw_rms(f, scale).into_iter().zip(&f.fit.count))
        .map(|((a, sigma), (rms, count))| {
            let innovation = a.variance().sqrt();
            a.order() > 0
                && innovation > CLEAR * sigma
                && rms < SLOWEST * innovation
                && (*count < MEMORY_SAMPLES || is_long(*count, rms / innovation))
        })
        .collect()
}

/// Whether so many samples tell coloured noise from what a model leaves over (of fewer than [`MEMORY_SAMPLES`] nothing tells
/// a misfit either, and they are not asked): they hold [`INDEPENDENT`] correlation times.
/// Noise with a pole ρ, whose RMS is 1/√(1 − ρ²) of its innovations, remembers (1 + ρ)/(1 − ρ) samples (Bartlett): for a
/// long memory 4 times the square of that ratio.
fn is_long(samples: usize, ratio: f64) -> bool {
    samples as f64 > INDEPENDENT * 4.0 * ratio * ratio
}

/// Whether the likelihood can be taken at its word: of innovations, and of a residual that is white and no
/// larger than the noise. Anything else holds misfits that no likelihood knows of.
fn by_likelihood(f: &FittedModel, e: &Evidence, scale: &[f64]) -> bool {
    e.whitened || f.is_white(e.effective_sample_ratio, scale)
}

/// Sum of squared innovations per channel, each model with the noise model of its own residual.
fn innovations(f: &FittedModel, scale: &[f64]) -> Vec<f64> {
    let noise = f.setup.innovations(&f.level, scale, &f.fit.point);
    let relative = noise.iter().zip(scale).map(|(a, s)| a.variance() / (s * s));
    relative.zip(&f.fit.count).map(|(v, n)| v * *n as f64).collect()
}

/// Twice the gain in log-likelihood from one model to another, each with the noise model of its own residual.
pub fn log_likelihood_gain(old: &FittedModel, new: &FittedModel, scale: &[f64]) -> f64 {
    let (before, after) = (innovations(old, scale), innovations(new, scale));
    let ratios = before.iter().zip(&after).filter(|(b, a)| **b > 0.0 && **a > 0.0);
    ratios.zip(&new.fit.count).map(|((b, a), n)| *n as f64 * (b / a).ln()).sum()
}

/// Residual sum of squares per channel of a fitted model, not whitened, in units of `scale`.
pub fn raw_rss(fitted: &FittedModel, scale: &[f64]) -> Vec<f64> {
    let plain = Setup { noise: None, ..fitted.setup.clone() };
    plain.with_problem(&fitted.level, scale, |p| p.rss(&p.rows(&fitted.fit.point, false, None)).0)
}

/// Residual RMS per channel in SI, not whitened.
pub fn raw_rms(fitted: &FittedModel, scale: &[f64]) -> Vec<f64> {
    rms_of(&raw_rss(fitted, scale), &fitted.fit.count, scale)
}

/// The sign of the determinant of an n × n matrix, by rows, which it overwrites.
fn determinant_sign(a: &mut [f64], n: usize) -> f64 {
    let mut pivots = vec![0; n];
    if !greybox_simulate::small::factor(a, &mut pivots, n) {
        return 0.0;
    }
    let swaps = pivots.iter().enumerate().filter(|(i, p)| i != *p).count();
    let product: f64 = (0..n).map(|i| a[i * n + i].signum()).product();
    if swaps % 2 == 0 { product } else { -product }
}

fn calibrated_rss(calibrated: &FittedModel, scale: &[f64]) -> f64 {
    raw_rss(calibrated, scale).iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_calibrate::Data;
    use greybox_recording::{Channel, Recording};

    #[test]
    fn a_slow_residual_is_noise_only_where_the_recordings_outlast_its_memory() {
        // ρ = 0.97 remembers 66 samples.
        let ratio = 1.0 / (1.0f64 - 0.97 * 0.97).sqrt();
        assert!(is_long(2000, ratio) && !is_long(700, ratio));
        // A few runs of 15 s with a residual that hardly changes within one.
        assert!(!is_long(733, 7.0));
    }

    /// Two carts of 1 and 2 kg, each on its spring, that swing freely: x = cos 2t and cos 3t.
    const CARTS: &str = r#"
[states]
x1 = { unit = "m" }
x2 = { unit = "m" }
[parameters]
m1 = { value = 1.0, unit = "kg", fixed = true }
m2 = { value = 2.0, unit = "kg", fixed = true }
k1 = { value = 4.0, unit = "N/m" }
k2 = { value = 18.0, unit = "N/m" }
[equations]
first  = "m1*x1'' + k1*x1 = 0"
second = "m2*x2'' + k2*x2 = 0"
"#;

    fn carts(recordings: usize) -> Setup {
        let time: Vec<f64> = (0..400).map(|k| 0.02 * f64::from(k)).collect();
        let channel = |name: &str, omega: f64| Channel {
            name: name.into(),
            unit: None,
            values: time.iter().map(|t| (omega * t).cos()).collect(),
        };
        let record = |i: usize| {
            let channels = vec![channel("x1", 2.0), channel("x2", 3.0)];
            Recording::from_columns(&format!("{i}.csv"), time.clone(), channels).unwrap()
        };
        let model = Model::from_toml(CARTS, "carts.toml").unwrap();
        let recordings: Vec<Recording> = (0..recordings).map(record).collect();
        let data = std::sync::Arc::new(Data::new(&model, &recordings).unwrap());
        Setup::new(&model, data, free_parameters(&model)).unwrap()
    }

    /// The nominal equations with the first candidate of such a mechanism, at this value of its only parameter.
    fn with(search: &Search<'_>, is: impl Fn(&Mechanism) -> bool, value: f64) -> FittedModel {
        let candidate = search.all.iter().find(|c| is(&search.library[c.mechanism])).unwrap().clone();
        let nominal = &search.nominal;
        let scale = nominal.data.spread.clone();
        let level = nominal.level(1);
        let values = nominal.values();
        let starts = nominal.starts(&level, &values);
        let held = Setup { free: Vec::new(), ..nominal.clone() };
        let fit = held.fit(&level, &scale, &[Point { parameters: values, starts }], limits(3));
        let base = FittedModel { setup: nominal.clone(), parts: Vec::new(), level, fit };
        search.reassembled(&base, &[(candidate, vec![value], vec![])], &scale, 0).unwrap()
    }

    #[test]
    fn the_sign_of_a_determinant_follows_its_rows() {
        let sign = |rows: [f64; 9]| determinant_sign(&mut rows.to_vec(), 3);
        assert_eq!(sign([2.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 4.0]), 1.0);
        assert_eq!(sign([0.0, 3.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 4.0]), -1.0, "two rows changed");
        assert_eq!(sign([0.0, 0.0, 4.0, 2.0, 0.0, 0.0, 0.0, 3.0, 0.0]), 1.0, "all three changed round");
        assert_eq!(sign([1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]), -1.0, "1 − 4");
        assert_eq!(sign([1.0, 2.0, 0.0, 2.0, 4.0, 0.0, 0.0, 0.0, 1.0]), 0.0, "singular");
    }

    /// An inertia mc between the carts gives the mass matrix [1, mc; mc, 2] kg, one that acts one way [1, mc; 0, 2] kg.
    #[test]
    fn an_inertia_that_is_negative_along_the_data_is_not_admissible() {
        let library = crate::built_in().unwrap();
        let search = Search::new(carts(1), &library, &crate::Quiet);
        let scale = search.nominal.data.spread.clone();
        let negative = |both: bool, mc: f64| {
            let inertia =
                |m: &Mechanism| m.kind == "coupling" && m.linear == ["mc"] && m.reaction.is_some() == both;
            let fitted = with(&search, inertia, mc);
            let negative =
                search.has_negative_inertia(&fitted.setup, &fitted.level, &fitted.fit.point, &scale);
            assert_eq!(search.admissible(&fitted, &scale), !negative);
            negative
        };
        assert!(!negative(true, 1.3) && !negative(true, -1.3));
        assert!(negative(true, 1.5) && negative(true, -1.5));
        assert!(!negative(false, 9.0));
    }

    #[test]
    fn a_drift_needs_one_clock() {
        let library = crate::built_in().unwrap();
        let drifts = |recordings: usize| {
            let search = Search::new(carts(recordings), &library, &crate::Quiet);
            search.all.iter().filter(|c| is_drift(&library[c.mechanism])).count()
        };
        assert_eq!((drifts(1), drifts(2)), (2, 0), "k1 and k2; time begins anew with every recording");
    }

    /// The recording lasts 8 s: a stiffness that would vanish after 10 s may fall so, one that would after 5 s has
    /// changed its sign.
    #[test]
    fn no_stiffness_drifts_through_zero() {
        let library = crate::built_in().unwrap();
        let search = Search::new(carts(1), &library, &crate::Quiet);
        let scale = search.nominal.data.spread.clone();
        let allowed = |rate: f64| search.admissible(&with(&search, is_drift, rate), &scale);
        assert!(allowed(0.1) && allowed(-0.1) && !allowed(-0.2));
    }

    /// A constant force known to ±0.5 N: as many newtons say whether it is there.
    #[test]
    fn a_part_whose_interval_holds_zero_is_undetermined() {
        let library = crate::built_in().unwrap();
        let search = Search::new(carts(1), &library, &crate::Quiet);
        let undetermined = |force: f64, width: f64| {
            let fitted = with(&search, |m| m.kind == "constant_offset", force);
            let index = fitted.setup.model.parameter(&fitted.parts[0].instance.names[0]).unwrap();
            let width = |f: &FreeParameter| if f.index == index { width } else { 0.1 };
            search.undetermined(&fitted, &fitted.setup.free.iter().map(width).collect::<Vec<_>>())
        };
        assert_eq!((undetermined(0.6, 0.5), undetermined(-0.6, 0.5)), (None, None));
        assert_eq!((undetermined(0.4, 0.5), undetermined(-0.4, 0.5)), (Some(0), Some(0)));
        assert_eq!(undetermined(0.0, 0.5), Some(0));
        assert_eq!(undetermined(0.0, 0.0), Some(0), "0 ± 0 is nothing");
        assert_eq!(undetermined(0.6, f64::INFINITY), Some(0));
    }
}
