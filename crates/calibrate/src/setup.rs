//! A model together with the data it is fitted to: everything the fits of a diagnosis share.

use std::ops::Range;
use std::sync::Arc;

use greybox_model::system::CompileError;
use greybox_model::{Expr, Func, Hold, Model, System};
use greybox_simulate::{Environment, MOST_TRIALS, Method, Seeds, Trajectory, can_stride, integrate};
use rayon::prelude::*;

use crate::data::{Data, SmoothedStates};
use crate::noise_model::{Autoregression, MOST};
use crate::problem::{
    Fit, FreeParameter, Limits, Point, Problem, Segment, SegmentRows, StartPrior, Work, segments,
};

/// Shortest segment, samples.
const LEAST: usize = 40;

/// Samples of a recording, and stretches of it, by which a method is judged.
const JUDGED: usize = 1500;
const STRETCHES: usize = 8;
/// Samples that a step may go across.
const STRIDES: [usize; 4] = [16, 8, 4, 2];
/// How far the error of such steps may move a parameter, in its standard deviations.
const SHIFT: f64 = 0.1;
/// Error over the least of any method up to which one is as good.
const AS_GOOD: f64 = 2.0;

/// Most samples to which the state at a piece's first sample is fitted.
const ONE_SIDED: usize = 60;

/// Mean square of these samples over that of all from which a start is in doubt.
const BADLY_STARTED: f64 = 2.0;

/// Steps between two samples beyond which a model is not simulated.
const MOST_SUBSTEPS: usize = 512;

/// A compiled model, its data, and how to integrate it.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The model.
    pub model: Model,
    /// The model compiled.
    pub system: Arc<System>,
    /// The data.
    pub data: Arc<Data>,
    /// Smoothed measurements as states.
    pub smoothed_states: Arc<SmoothedStates>,
    /// Hold of each input.
    pub holds: Vec<Hold>,
    /// One environment per piece.
    pub environments: Arc<Vec<Environment>>,
    /// Integration method.
    pub method: Method,
    /// Whether steps across several samples may be chosen (see [`with_strides`](Self::with_strides)).
    pub strides: bool,
    /// Parameters to fit with priors and bounds.
    pub free: Vec<FreeParameter>,
    /// Entries of the state vector carried from segment to segment (see [`Problem::carried`]).
    pub carried: Vec<usize>,
    /// Noise per channel by which fits are whitened (see [`Problem::noise`]); simulations and scores
    /// do not use it.
    pub noise: Option<Arc<Vec<Autoregression>>>,
    /// Work done by the fits of this setup and of all that were made from it.
    pub work: Arc<Work>,
}

/// A model that cannot be laid out.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SetupError {
    /// It does not compile.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// Its fastest mode needs more steps than can be taken.
    #[error(
        "the model is stiff: it has a mode of about {rate:.1e} 1/s, which takes more than {MOST_SUBSTEPS} steps between \
         two samples, {dt} s apart. Check the values and units of masses, capacities and stiffnesses; a part that fast \
         is better left out, its state replaced by the value at which it settles"
    )]
    Stiff {
        /// The largest |λ| that was seen, 1/s.
        rate: f64,
        /// Sample interval, s.
        dt: f64,
    },
}

/// A stretch of the data, simulated exactly.
struct Reference {
    piece: usize,
    range: Range<usize>,
    x0: Vec<f64>,
    run: Trajectory,
}

impl Reference {
    /// Steps per sample.
    fn steps(&self) -> f64 {
        self.run.steps as f64 / self.run.diverged.unwrap_or(self.run.n).max(1) as f64
    }

    /// Whether it takes more steps than there may be, for a mode that is that fast.
    fn is_beyond_reach(&self, dt: f64) -> bool {
        let stable = |steps: usize| self.run.fastest * dt > 3.25 * steps as f64;
        let given_up = self.run.exhausted.is_some() && stable(MOST_TRIALS);
        given_up || (self.run.is_stiff() && self.steps() > MOST_SUBSTEPS as f64 && stable(MOST_SUBSTEPS))
    }
}

/// A name that is no state of the model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the model has no state `{name}` to carry from segment to segment; its states are {available}")]
pub struct UnknownState {
    /// What was asked for.
    pub name: String,
    /// What there is.
    pub available: String,
}

/// A choice of segments with the priors of their starts.
#[derive(Debug, Clone)]
pub struct Segmentation {
    /// The segments.
    pub segments: Vec<Segment>,
    /// Prior of each segment's initial state.
    pub priors: Vec<StartPrior>,
}

impl Setup {
    /// Lays out a model. `nominal_free` are the parameters to fit (see [`crate::free_parameters`]).
    ///
    /// # Errors
    /// When the model does not compile, or has a mode so much faster than the samples that it cannot be simulated.
    pub fn new(model: &Model, data: Arc<Data>, free: Vec<FreeParameter>) -> Result<Setup, SetupError> {
        let system = Arc::new(System::compile(model)?);
        let smoothed_states = Arc::new(SmoothedStates::new(model, &data));
        let holds: Vec<Hold> = model.inputs.iter().map(|i| i.hold).collect();
        let environments = Arc::new(data.environments(&holds));
        let mut setup = Setup {
            model: model.clone(),
            system,
            data,
            smoothed_states,
            holds,
            environments,
            method: Method::Rk4 { substeps: 1 },
            strides: false,
            free,
            carried: Vec::new(),
            noise: None,
            work: Arc::default(),
        };
        let tolerance = setup.first_tolerance();
        let references = setup.references(JUDGED);
        for r in &references {
            let dt = setup.data.pieces[r.piece].dt;
            if r.is_beyond_reach(dt) {
                return Err(SetupError::Stiff { rate: r.run.fastest, dt });
            }
        }
        setup.method = setup.cheapest(&tolerance, &references);
        Ok(setup)
    }

    /// The same data with another model of the same measurements (a mechanism added). No state is
    /// carried any more, since the entries of the state vector are others: ask again with
    /// [`with_carried`](Self::with_carried). Steps across several samples were chosen for this model; the other one, which may
    /// be faster, goes from sample to sample.
    ///
    /// # Errors
    /// When the model does not compile.
    pub fn with_model(&self, model: Model, free: Vec<FreeParameter>) -> Result<Setup, CompileError> {
        let system = Arc::new(System::compile(&model)?);
        let smoothed_states = if system.nx == self.system.nx {
            self.smoothed_states.clone()
        } else {
            Arc::new(SmoothedStates::new(&model, &self.data))
        };
        let method = self.method.at_every_sample();
        Ok(Setup { model, system, smoothed_states, method, free, carried: Vec::new(), ..self.clone() })
    }

    /// The same model, integrated in the same way, with other recordings of its channels; where steps went across several
    /// samples of these, they go from sample to sample of those.
    pub fn with_data(&self, data: Arc<Data>) -> Setup {
        let smoothed_states = SmoothedStates::new(&self.model, &data);
        self.with_smoothed(data, smoothed_states)
    }

    fn with_smoothed(&self, data: Arc<Data>, smoothed_states: SmoothedStates) -> Setup {
        let environments = Arc::new(data.environments(&self.holds));
        let (smoothed_states, method) = (Arc::new(smoothed_states), self.method.at_every_sample());
        Setup { data, smoothed_states, environments, method, noise: None, ..self.clone() }
    }

    /// The same, where a step of the integration may go across up to 16 samples ([`Method::Rk4Stride`]): for records taken far
    /// faster than the machine moves. The longest step is taken whose error e, against tight tolerances, keeps
    ///
    /// ```text
    /// N · mean (e/σ)² ≤ 0.1²
    /// ```
    ///
    /// over N samples of noise σ (each channel's own). In a least-squares fit a parameter moves by at most ‖e/σ‖ of its standard
    /// deviations, so that none moves by more than a tenth of one. Where no such step is good enough, or the model has delays
    /// or measures its highest derivatives, the method stays one that ends a step at every sample.
    pub fn with_strides(mut self) -> Setup {
        self.strides = true;
        self.choose_method(&self.first_tolerance(), JUDGED);
        self
    }

    /// What a simulation may be off before anything is fitted, SI per channel.
    fn first_tolerance(&self) -> Vec<f64> {
        self.data.spread.iter().map(|s| 1e-3 * s).collect()
    }

    /// The same model for simulations of other recordings with these parameters: in the same steps, or in finer ones
    /// where those recordings ask for them at this tolerance (SI, per channel). A law can be far faster in a motion that
    /// the fits never saw. Where a sensor reads a coordinate along a line or a curve, that tells the start.
    pub fn for_simulations_of(&self, data: Arc<Data>, parameters: &[f64], tolerance: &[f64]) -> Setup {
        let mut model = self.model.clone();
        for (p, v) in model.parameters.iter_mut().zip(parameters) {
            p.value = *v;
        }
        let smoothed_states = SmoothedStates::of_known(&model, &data);
        let mut setup = Setup { model, ..self.with_smoothed(data, smoothed_states) };
        setup.choose_method(tolerance, JUDGED);
        if setup.method.evaluations() < self.method.evaluations() {
            setup.method = self.method;
        }
        setup
    }

    /// The same with the states of these names (all entries of their chains) carried from segment to
    /// segment instead of free in each: the memory of a mechanism, which no sensor sees.
    ///
    /// # Errors
    /// [`UnknownState`] when a name is no state of the model.
    pub fn with_carried(&self, names: &[String]) -> Result<Setup, UnknownState> {
        let mut carried = Vec::new();
        for name in names {
            let j = self.model.state(name).ok_or_else(|| UnknownState {
                name: name.clone(),
                available: self
                    .model
                    .states
                    .iter()
                    .map(|s| format!("`{}`", s.name))
                    .collect::<Vec<_>>()
                    .join(", "),
            })?;
            carried.extend(self.system.offsets[j]..self.system.offsets[j] + self.system.orders[j]);
        }
        carried.sort_unstable();
        carried.dedup();
        Ok(Setup { carried, ..self.clone() })
    }

    /// The same with other holds.
    pub fn with_holds(&self, holds: Vec<Hold>) -> Setup {
        let environments = Arc::new(self.data.environments(&holds));
        let mut model = self.model.clone();
        for (input, hold) in model.inputs.iter_mut().zip(&holds) {
            input.hold = *hold;
        }
        Setup { holds, environments, model, ..self.clone() }
    }

    /// The cheapest fixed-step method whose error stays below `tolerance` (SI, per channel; at least a
    /// twentieth of the noise and 10⁻⁶ of the signal) over stretches of `length` samples of the data (those that
    /// a fit simulates in one go), judged against Dormand–Prince with tight tolerances. Where none is that accurate, the
    /// cheapest that is as accurate as any, however long the simulation.
    pub fn choose_method(&mut self, tolerance: &[f64], length: usize) {
        let references = self.references(length);
        self.method = self.cheapest(tolerance, &references);
    }

    /// What methods are judged against.
    fn references(&self, length: usize) -> Vec<Reference> {
        let Some((piece, data)) = self.data.pieces.iter().enumerate().max_by_key(|(_, p)| p.len.min(JUDGED))
        else {
            return Vec::new();
        };
        let n = length.clamp(2, JUDGED).min(data.len);
        let count = (JUDGED / n).clamp(1, STRETCHES);
        (0..count)
            .map(|i| {
                let from = i * (data.len - n) / count;
                let x0 = self.start(piece, from);
                let exact = Method::Adaptive { rtol: 1e-9, atol: 1e-10 };
                let run = self.stretch(piece, from..from + n, &x0, exact);
                Reference { piece, range: from..from + n, x0, run }
            })
            .collect()
    }

    fn stretch(&self, piece: usize, range: Range<usize>, x0: &[f64], method: Method) -> Trajectory {
        let environment = &self.environments[piece];
        integrate(&self.system, environment, &self.values(), x0, range, method, &Seeds::default())
    }

    fn cheapest(&self, tolerance: &[f64], references: &[Reference]) -> Method {
        let limit: Vec<f64> = (0..self.system.ny)
            .map(|c| tolerance[c].max(0.05 * self.data.sigma[c]).max(1e-6 * self.data.spread[c]))
            .collect();
        if let Some(long) = self.strides.then(|| self.longest_stride(references)).flatten() {
            return long;
        }
        let ladder = [
            Method::Rk4 { substeps: 1 },
            Method::Dp5 { substeps: 1 },
            // As dear as two steps of the fifth order; where the past is interpolated, two steps may be better.
            Method::Dop853 { substeps: 1 },
            Method::Dp5 { substeps: 2 },
            Method::Dop853 { substeps: 2 },
            Method::Dp5 { substeps: 4 },
            Method::Dop853 { substeps: 4 },
            Method::Dp5 { substeps: 8 },
            Method::Dp5 { substeps: 16 },
        ];
        // A fast mode needs small steps whatever the accuracy.
        let fast = references.iter().any(|r| r.steps() > 16.0);
        let fine = [32, 64, 128, 256, MOST_SUBSTEPS].map(|substeps| Method::Dp5 { substeps });
        let fine = &fine[..if fast { fine.len() } else { 1 }];
        // Largest error so far over what is allowed, sample by sample of all stretches.
        let errors = |method: Method| -> Vec<f64> {
            let of = |reference: &Reference| -> Vec<f64> {
                let n = reference.range.len();
                let trial = self.stretch(reference.piece, reference.range.clone(), &reference.x0, method);
                let good = reference.run.diverged.unwrap_or(n).saturating_sub(1).max(2).min(n);
                let error = |c: usize, k: usize| {
                    let off = (trial.y[c * n + k] - reference.run.y[c * n + k]).abs() / limit[c];
                    if off.is_nan() { f64::INFINITY } else { off }
                };
                let grown = |largest: &mut f64, k: usize| {
                    *largest = (0..limit.len()).map(|c| error(c, k)).fold(*largest, f64::max);
                    Some(*largest)
                };
                (0..good).scan(0.0, grown).collect()
            };
            references.iter().flat_map(of).collect()
        };
        let mut tried = Vec::new();
        for method in ladder.iter().chain(fine).copied() {
            let errors = errors(method);
            if errors.iter().all(|e| *e <= 1.0) {
                return method;
            }
            tried.push((method, errors));
        }
        // Where small errors grow whatever the step, finer steps bring nothing from some sample on.
        let least = |k: usize| tried.iter().map(|t| t.1[k]).fold(f64::INFINITY, f64::min);
        let allowed: Vec<f64> = (0..tried[0].1.len()).map(|k| (AS_GOOD * least(k)).max(1.0)).collect();
        let is_as_good = |errors: &[f64]| {
            errors.iter().zip(&allowed).all(|(error, allowed)| error.is_finite() && error <= allowed)
        };
        let as_good = tried.iter().find(|t| is_as_good(&t.1));
        as_good.map_or(fine[fine.len() - 1], |t| t.0)
    }

    /// The longest steps across several samples whose error e moves no fitted parameter by more than a tenth of its standard
    /// deviation. A parameter's shift is at most ‖e/σ‖ of its standard deviations, with the norm over all samples of the
    /// data; the samples that are judged stand for all. `None`: steps have to end at every sample.
    fn longest_stride(&self, references: &[Reference]) -> Option<Method> {
        let judged: usize = references.iter().map(|r| r.range.len()).sum();
        let channels = self.system.ny;
        if !can_stride(&self.system) || judged == 0 || references.iter().any(|r| r.run.diverged.is_some()) {
            return None;
        }
        let share = self.data.samples() as f64 / judged as f64;
        let is_good = |method: Method| {
            let squares: f64 = references
                .iter()
                .map(|r| {
                    let n = r.range.len();
                    let trial = self.stretch(r.piece, r.range.clone(), &r.x0, method);
                    let of = |c: usize| {
                        let pairs = trial.y[c * n..(c + 1) * n].iter().zip(&r.run.y[c * n..(c + 1) * n]);
                        pairs.map(|(a, b)| ((a - b) / self.data.sigma[c]).powi(2)).sum::<f64>()
                    };
                    (0..channels).map(of).sum::<f64>()
                })
                .sum();
            share * squares <= SHIFT * SHIFT
        };
        STRIDES.map(|samples| Method::Rk4Stride { samples }).into_iter().find(|method| is_good(*method))
    }

    /// Parameter values of the model.
    pub fn values(&self) -> Vec<f64> {
        self.model.parameters.iter().map(|p| p.value).collect()
    }

    /// State at a sample as the measurements tell it; unmeasured entries are the given initial value or
    /// zero.
    pub fn start(&self, piece: usize, sample: usize) -> Vec<f64> {
        let mut x = self.given_start();
        for (v, hat) in x.iter_mut().zip(&self.smoothed_states.states[piece]) {
            if let Some(hat) = hat
                && hat[sample].is_finite()
            {
                *v = hat[sample];
            }
        }
        x.iter_mut().zip(self.gone_on(piece, sample)).for_each(|(v, moved)| *v += moved);
        x
    }

    /// How far each entry of the state has gone on since a late sensor saw it: τ times its rate.
    fn gone_on(&self, piece: usize, sample: usize) -> Vec<f64> {
        let mut moved = vec![0.0; self.system.nx];
        let known = |n: &str| self.model.parameter(n).map(|i| self.model.parameters[i].value);
        for measurement in &self.model.measurements {
            let Expr::Call(Func::Delay, arguments) = &measurement.expr else { continue };
            let [Expr::Var { name, .. }, tau] = &arguments[..] else { continue };
            let (Some(j), Some(tau)) = (self.model.state(name), tau.eval(&|n, _| known(n))) else { continue };
            let (first, order) = (self.system.offsets[j], self.model.states[j].order);
            // (What another sensor sees at once has not gone on.)
            let seen_at_once = |i: usize| (0..=i).any(|p| self.model.measurement_of(name, p as u8).is_some());
            for i in (0..order).filter(|i| !seen_at_once(*i)) {
                let rate = if i + 1 < order {
                    self.smoothed_states.states[piece][first + i + 1].as_ref()
                } else {
                    self.smoothed_states.highest[piece][j].as_ref()
                };
                moved[first + i] = rate.map_or(0.0, |r| tau * r[sample]);
            }
        }
        moved.iter_mut().filter(|m| !m.is_finite()).for_each(|m| *m = 0.0);
        moved
    }

    fn given_start(&self) -> Vec<f64> {
        let mut x = vec![0.0; self.system.nx];
        for (j, state) in self.model.states.iter().enumerate() {
            for (i, v) in state.initial.iter().enumerate().take(state.order) {
                x[self.system.offsets[j] + i] = *v;
            }
        }
        x
    }

    /// Prior of the state at a sample: where it is measured, the smoothed value; at a recording's
    /// start, the given initial values pin it.
    pub fn start_prior(&self, piece: usize, sample: usize) -> StartPrior {
        // At the end of a record the smoothing window is one-sided: the standard error of a cubic's
        // slope there is four times that in the middle.
        let n = self.data.pieces[piece].len;
        let end = if sample < 3 || sample + 3 >= n { 4.0 } else { 1.0 };
        let mut prior: StartPrior = self.smoothed_states.states[piece]
            .iter()
            .zip(&self.smoothed_states.tolerance)
            .zip(self.gone_on(piece, sample))
            .map(|((hat, tolerance), moved)| match hat {
                Some(h) if h[sample].is_finite() => (h[sample] + moved, (end * tolerance).hypot(moved)),
                _ => (0.0, f64::INFINITY),
            })
            .collect();
        if sample == 0 && self.data.pieces[piece].start == 0.0 {
            for (j, state) in self.model.states.iter().enumerate() {
                for (i, v) in state.initial.iter().enumerate().take(state.order) {
                    prior[self.system.offsets[j] + i] = (*v, 0.0);
                }
            }
        }
        prior
    }

    /// Windows of about `length` samples, of at most `most` samples in all: where the data hold more, the
    /// windows are spread evenly over them.
    pub fn windows(&self, length: usize, most: usize) -> Segmentation {
        let total: usize = self.data.lengths().iter().sum();
        let count = (total as f64 / length.max(1) as f64).round().max(1.0) as usize;
        let all = segments(&self.data.lengths(), count, length.min(LEAST));
        let wanted = (most / length.max(1)).max(4);
        let chosen: Vec<Segment> = if all.len() <= wanted || total <= most {
            all
        } else {
            (0..wanted).map(|i| all[(2 * i + 1) * all.len() / (2 * wanted)].clone()).collect()
        };
        let priors = chosen.iter().map(|s| self.start_prior(s.piece, s.range.start)).collect();
        Segmentation { segments: chosen, priors }
    }

    /// About `count` segments over all pieces.
    pub fn level(&self, count: usize) -> Segmentation {
        self.level_after(count, 0.0)
    }

    /// The same without the first `skip` seconds of every piece: where an input acts late and its past is not recorded, the
    /// equations there are not known.
    pub fn level_after(&self, count: usize, skip: f64) -> Segmentation {
        let skipped: Vec<usize> =
            self.data.pieces.iter().map(|p| ((skip / p.dt).ceil() as usize).min(p.len)).collect();
        let lengths: Vec<usize> = self.data.lengths().iter().zip(&skipped).map(|(n, s)| n - s).collect();
        let mut segments = segments(&lengths, count, LEAST);
        for segment in &mut segments {
            segment.range.start += skipped[segment.piece];
            segment.range.end += skipped[segment.piece];
        }
        let priors = segments.iter().map(|s| self.start_prior(s.piece, s.range.start)).collect();
        Segmentation { segments, priors }
    }

    /// Initial states from the measurements; unmeasured entries from a simulation with `parameters`. That at a piece's
    /// first sample, where smoothing is one-sided, is fitted to its first samples.
    pub fn starts(&self, level: &Segmentation, parameters: &[f64]) -> Vec<Vec<f64>> {
        let unmeasured: Vec<usize> =
            (0..self.system.nx).filter(|&i| self.smoothed_states.tolerance[i].is_infinite()).collect();
        let runs: Vec<Option<Vec<f64>>> = if unmeasured.is_empty() {
            Vec::new()
        } else {
            self.data
                .pieces
                .par_iter()
                .enumerate()
                .map(|(i, piece)| {
                    let x0 = self.start(i, 0);
                    let run = integrate(
                        &self.system,
                        &self.environments[i],
                        parameters,
                        &x0,
                        0..piece.len,
                        self.method,
                        &Seeds::default(),
                    );
                    run.diverged.is_none().then_some(run.x)
                })
                .collect()
        };
        level
            .segments
            .iter()
            .map(|s| {
                if s.range.start == 0 {
                    let most = s.range.len().min(ONE_SIDED);
                    return self.grow_start(s.piece, parameters, &self.data.sigma, most);
                }
                let mut x = self.start(s.piece, s.range.start);
                for &i in &unmeasured {
                    if let Some(Some(run)) = runs.get(s.piece) {
                        x[i] = run[i * self.data.pieces[s.piece].len + s.range.start];
                    }
                }
                x
            })
            .collect()
    }

    /// Runs `f` on the shooting problem of a level.
    pub fn with_problem<R>(
        &self,
        level: &Segmentation,
        scale: &[f64],
        f: impl FnOnce(&Problem<'_>) -> R,
    ) -> R {
        self.with_problem_in(&self.environments, level, scale, f)
    }

    /// [`with_problem`](Self::with_problem) in other environments (with exogenous forces added).
    pub fn with_problem_in<R>(
        &self,
        environments: &[Environment],
        level: &Segmentation,
        scale: &[f64],
        f: impl FnOnce(&Problem<'_>) -> R,
    ) -> R {
        let measured: Vec<&[Vec<f64>]> = self.data.pieces.iter().map(|p| p.measured.as_slice()).collect();
        f(&Problem {
            system: &self.system,
            environments,
            measured: &measured,
            method: self.method,
            segments: &level.segments,
            start_priors: &level.priors,
            free: &self.free,
            scale,
            carried: &self.carried,
            past: &self.smoothed_states.states,
            noise: self.noise.as_ref().map(|noise| noise.as_slice()),
            work: &self.work,
        })
    }

    /// What the residuals at a point say of the noise: one autoregression per channel, of the raw
    /// residuals (measured − simulated, SI), whatever [`noise`](Self::noise) is now.
    pub fn innovations(&self, level: &Segmentation, scale: &[f64], point: &Point) -> Vec<Autoregression> {
        let raw = Setup { noise: None, ..self.clone() };
        let rows = raw.with_problem(level, scale, |p| p.rows(point, false, None));
        (0..self.system.ny)
            .map(|c| {
                let residuals: Vec<Vec<f64>> = level
                    .segments
                    .iter()
                    .zip(&rows)
                    .map(|(s, rows)| {
                        let n = s.range.len();
                        let y = &self.data.pieces[s.piece].measured[c][s.range.clone()];
                        let t = &rows.trajectory;
                        y.iter().zip(&t.y[c * n..(c + 1) * n]).map(|(y, simulated)| y - simulated).collect()
                    })
                    .collect();
                let stretches: Vec<&[f64]> = residuals.iter().map(Vec::as_slice).collect();
                Autoregression::fit(&stretches, MOST)
            })
            .collect()
    }

    /// Fits from the cheapest of several starting points.
    pub fn fit(&self, level: &Segmentation, scale: &[f64], points: &[Point], limits: Limits) -> Fit {
        self.with_problem(level, scale, |problem| {
            let is_only = points.len() == 1 && limits.iterations > 0;
            let simulated = points.iter().map(|p| (problem.rows(p, is_only, None), p));
            let evaluated = simulated.map(|(rows, p)| (problem.cost_of(&rows, p), rows, p));
            let Some((_, rows, point)) = evaluated.min_by(|a, b| a.0.total_cmp(&b.0)) else {
                return problem.fit(Point { parameters: self.values(), starts: Vec::new() }, limits);
            };
            let best = self.with_fresh_starts(problem, &rows, point.clone());
            let known = is_only && best == *point;
            problem.fit_from(best, known.then_some(rows), limits)
        })
    }

    /// A point whose pieces' first samples fit worse than the rest of its level (the wrong physics of an earlier fit
    /// may have led the start of a free decay into another minimum) gets those starts anew where they are better.
    /// `rows` are those of the point.
    fn with_fresh_starts(&self, problem: &Problem<'_>, rows: &[SegmentRows], mut point: Point) -> Point {
        let ny = self.system.ny;
        let squares = |r: &[f64]| r.iter().map(|v| v * v).sum::<f64>();
        let samples: usize = problem.segments.iter().map(|s| s.range.len()).sum();
        let mean =
            rows.iter().map(|s| squares(&s.r[..s.rows - self.system.nx])).sum::<f64>() / samples as f64;
        let firsts: Vec<usize> =
            (0..problem.segments.len()).filter(|&i| problem.segments[i].range.start == 0).collect();
        let grown: Vec<(usize, Vec<f64>)> = firsts
            .into_par_iter()
            .filter(|&i| {
                let n = problem.segments[i].range.len();
                let few = n.min(ONE_SIDED);
                let first: f64 = (0..ny).map(|c| squares(&rows[i].r[c * n..c * n + few])).sum();
                first > BADLY_STARTED * mean * few as f64
            })
            .map(|i| {
                let segment = &problem.segments[i];
                let most = segment.range.len().min(ONE_SIDED);
                (i, self.grow_start(segment.piece, &point.parameters, &self.data.sigma, most))
            })
            .collect();
        if grown.is_empty() {
            return point;
        }
        let before = point.clone();
        for (i, start) in &grown {
            point.starts[*i].clone_from(start);
        }
        let anew = problem.rows(&point, false, None);
        for (i, _) in grown {
            if squares(&anew[i].r).total_cmp(&squares(&rows[i].r)).is_ge() {
                point.starts[i].clone_from(&before.starts[i]);
            }
        }
        point
    }

    /// The `most` points of least cost, best first; points that cannot be simulated are left out, and so is
    /// what costs the same as a better one.
    pub fn best_points(
        &self,
        level: &Segmentation,
        scale: &[f64],
        points: Vec<Point>,
        most: usize,
    ) -> Vec<Point> {
        self.with_problem(level, scale, |problem| {
            let mut evaluated: Vec<(f64, Point)> =
                points.into_iter().map(|p| (problem.cost(&p), p)).collect();
            evaluated.retain(|p| p.0.is_finite());
            evaluated.sort_by(|a, b| a.0.total_cmp(&b.0));
            evaluated.dedup_by(|a, b| a.0 == b.0);
            evaluated.truncate(most);
            evaluated.into_iter().map(|p| p.1).collect()
        })
    }

    /// Start values for a finer or coarser level read off a fitted trajectory (stitched segments).
    pub fn stitch(&self, from: &Segmentation, fit: &Point, to: &Segmentation, scale: &[f64]) -> Point {
        let rows = self.with_problem(from, scale, |p| p.rows(fit, false, None));
        let starts = to
            .segments
            .iter()
            .enumerate()
            .map(|(i, s)| {
                for (j, f) in from.segments.iter().enumerate() {
                    if f.piece == s.piece && f.range.contains(&s.range.start) {
                        let t = &rows[j].trajectory;
                        let k = s.range.start - f.range.start;
                        let mut x: Vec<f64> = (0..self.system.nx).map(|r| t.x[r * t.n + k]).collect();
                        for (x, (mean, std)) in x.iter_mut().zip(&to.priors[i]) {
                            if *std == 0.0 {
                                *x = *mean;
                            }
                        }
                        return x;
                    }
                }
                self.start(s.piece, s.range.start)
            })
            .collect();
        Point { parameters: fit.parameters.clone(), starts }
    }
}
