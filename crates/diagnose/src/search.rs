//! The search: short-list by the score test, fit, decide, and again; on short segments first, on longer
//! ones later.

mod compare;
mod fit;
mod refine;
mod rounds;

pub use compare::{coloured_channels, log_likelihood_gain, raw_rms, raw_rss};
pub(crate) use fit::carried;
use fit::is_drift;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use greybox_calibrate::{Limits, Point, Segmentation, Setup};
use rayon::prelude::*;

use crate::candidate::{Candidate, candidates};
use crate::evidence::least_effective_sample_ratio;
use crate::fitted::{FittedModel, Found, STUCK, SelectedTerm, next_scale};
use crate::library::Mechanism;
use crate::place::{Place, places};
use crate::plausibility::Deviation;
use crate::temperature::AnyScale;
use crate::validate::{Gain, errors};
use crate::{ProgressListener, Stage};

/// Number of segments of the first and last level, where nothing else decides.
const SEGMENTS: (usize, usize) = (60, 4);
/// Longest segments of the first level, in periods of the fastest channel: beyond, a wrong stiffness turns
/// the phase of the response round, and the score test's first order means nothing.
const PERIODS: f64 = 3.0;
/// Shortest segment, samples.
const SHORTEST: usize = 40;
/// Innovations over high-frequency noise from which a correlated residual passes for coloured noise.
const CLEAR: f64 = 1.35;
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
/// Candidates of other kinds that are fitted beside it, where they promise nearly as much.
const MORE: usize = 5;
/// Pairs that are fitted when no single candidate pays.
const PAIRS: usize = 4;
/// Fewest samples by which a pair is believed: there are many pairs.
const PAIR_SAMPLES: usize = 500;
/// Fall of the cost from which another hold of an input is considered once more is known of the machine.
pub(crate) const SAME_HOLD: f64 = 0.002;
/// Residual over noise from which a model is far from the noise.
const FAR_FROM_NOISE: f64 = 2.0;
/// Ratio of sums of squares at which a whitened estimate simulates no longer what it is fitted to.
const FORGETS: f64 = 1.5;
/// Fewest samples from which a mechanism with states of its own is looked for.
const MEMORY_SAMPLES: usize = 200;
/// Residual over noise from which a residual is a misfit, whatever its colour.
pub(crate) const MISFIT: f64 = 1.5;
/// Two explanations whose scores differ by less stay undecided.
pub const UNDECIDED: f64 = 3.0;
/// Steps of a fit that decide which candidates of a short-list go on, and how many do.
const FIRST_STEPS: usize = 6;
const FINALISTS: usize = 5;
/// Further steps of these, how many of them go to the end, and the steps that is.
const MORE_STEPS: usize = 12;
const BEST: usize = 2;
const LAST_STEPS: usize = 40;
/// Steps of a fit without a part, for each that is left out.
const STEPS_WITHOUT: usize = 10;
/// Steps that bring the starts of new segments to given parameters.
const STARTS: usize = 6;
/// Residual on all data over that of the windows from which a model holds for the windows alone.
const BEYOND_WINDOWS: f64 = 2.0;
/// A simpler model wins when its score is no further behind than this.
const PARSIMONY: f64 = 4.0;
/// Least share of the calibrated model's misfit that a second or later mechanism must explain.
const LEAST_SHARE: f64 = 7e-4;

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

/// The same segments with the priors of another model's states.
pub(crate) fn same_level(setup: &Setup, level: &Segmentation) -> Segmentation {
    let priors = level.segments.iter().map(|s| setup.start_prior(s.piece, s.range.start)).collect();
    Segmentation { segments: level.segments.clone(), priors }
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
        least_effective_sample_ratio(f.at(&state.scale)) < below
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
        if self.current.setup.noise.is_some() || self.misfit() < FAR_FROM_NOISE { MORE } else { 0 }
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

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_calibrate::{Data, FreeParameter, free_parameters};
    use greybox_model::Model;
    use greybox_recording::{Channel, Recording};

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
            let negative = search.has_negative_inertia(fitted.at(&scale));
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
