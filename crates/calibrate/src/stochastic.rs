//! Maximum likelihood where the model itself errs: the stochastic grey-box model and its extended Kalman filter.
//!
//! ```text
//! dx = f(x, u, p) dt + G dw,     w: one Wiener process per equation of the machine, of intensity q_j
//! y_c(k) = h_c(x(k), u(k), p) + n_c(k),     n_c ~ N(0, r_c)
//! ```
//!
//! (Kristensen, Madsen, Jørgensen, *Parameter estimation in stochastic grey-box models*, Automatica 40, 2004.) The noise
//! enters the rate of each equation's highest derivative, so that it is a force (a heat flow, a current) that the equation
//! lacks. Where the equation moves something (its highest derivative is the second or above), its intensity falls to a four
//! hundredth at rest: a force that is there when nothing moves would reward a friction that is not.
//!
//! With the innovations e and their variances s,
//!
//! ```text
//! ln L = −½ Σ (e²/s + ln 2πs),     ∂ ln L = Σ (−e ∂e/s + ½ ∂s/s (e²/s − 1)),     I = Σ (∂e ∂eᵀ/s + ½ ∂s ∂sᵀ/s²)
//! ```
//!
//! The derivatives by the logarithms of q and r are exact; those by the parameters leave out what a parameter does to the
//! variances and to the gain.
//!
//! **Horizons.** White noise on the rate is itself only a model of what a model lacks, right for no more than one lag. The
//! likelihood of the innovations at full rate fixes q by the shortest lag, where a slow force is small, and hides slow
//! physics in it. So the likelihood is a composite one: the sum of those of the record thinned by 1, 4, 16 and so on,
//! all with the same parameters (Varin, Reid, Firth, *An overview of composite likelihood methods*, Statistica Sinica 21,
//! 2011). It counts the same samples several times; by how much its curvature overstates what they tell is the ratio of
//! the variance of its score to that curvature ([`Pass::inflation`]).
//!
//! What a pass is given by, `n` = free parameters, then equations of the machine, then channels:
//!
//! | | shape | unit |
//! |---|---|---|
//! | [`Errors::force`], [`Errors::sensor`] | equations, channels | ln of (unit of the highest derivative)²·s, of (SI unit)² |
//! | [`Pass::gradient`] | n | 1/SI, 1 |
//! | [`Pass::information`] | n × n | the same, squared |
//!
//! ```
//! use std::sync::Arc;
//!
//! use greybox_calibrate::stochastic::{Filter, Stochastic};
//! use greybox_calibrate::{Data, Setup, free_parameters};
//! use greybox_model::Model;
//! use greybox_recording::{Channel, Recording};
//!
//! // A tank that runs empty. Beside a pulsing inflow that the model does not know, its level falls with 0.5 1/s.
//! let model = Model::from_toml(
//!     r#"
//! [states]
//! h = { unit = "m", initial = 2.0 }
//! [parameters]
//! a = { value = 0.3, unit = "1/s" }
//! [equations]
//! tank = "h' + a*h = 0"
//! "#,
//!     "tank.toml",
//! )?;
//! let (dt, mut h) = (0.02, 2.0);
//! let (mut time, mut values) = (Vec::new(), Vec::new());
//! for k in 0..400 {
//!     let t = dt * f64::from(k);
//!     time.push(t);
//!     values.push(h);
//!     h += dt * (-0.5 * h + 0.2 * (7.0 * t).sin());
//! }
//! let channel = Channel { name: "h".into(), unit: Some("m".into()), values };
//! let recording = Recording::from_columns("tank.csv", time, vec![channel])?;
//! let data = Arc::new(Data::new(&model, &[recording])?);
//! let setup = Setup::new(&model, data, free_parameters(&model))?;
//!
//! let filter = Filter::new(&setup);
//! let (parameters, errors) = (setup.values(), filter.first_errors());
//! let start = Stochastic { setup, parameters, errors, starts: Vec::new() };
//! let weight = 1.0 / filter.strides().len() as f64;
//! let fitted = filter.fit(start, weight, 40).expect("the simulation stays bounded");
//! assert!((fitted.at.parameters[0] - 0.5).abs() < 0.05, "{}", fitted.at.parameters[0]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::sync::Arc;

use greybox_simulate::{Environment, Method, Seeds, SignalLanes, Simulation, integrate};
use rayon::prelude::*;

use crate::qr;
use crate::setup::Setup;

/// Most samples of all recordings by which the shortest horizon corrects: of more, every n-th.
const MOST_SAMPLES: usize = 5000;
/// Fewest samples of a horizon: where thinning leaves fewer, the record is thinned from several first samples; and fewest
/// that each of these may have.
const FEWEST: usize = 100;
const LEAST_SAMPLES: usize = 6;
/// Ratio of one horizon to the next.
const RATIO: usize = 4;
/// Horizons that there are in any case, as far as samples go; more of them until the longest is half a period.
const HORIZONS: usize = 4;
/// Speed at which model error is at half of its intensity, over the RMS of the speed; and what is left of it at rest.
const SLOW: f64 = 0.03;
const AT_REST: f64 = 0.0025;
/// Least standard deviation of a sensor's noise, over what the fast differences of its samples show.
const LEAST_NOISE: f64 = 0.25;
/// First model error: a force of this share of the equation's own, correlated over so many samples.
const FIRST_ERROR: f64 = 0.1;
const FIRST_MEMORY: f64 = 10.0;
/// How far the logarithm of an intensity may go from the first one, downwards and upwards.
pub const RANGE: (f64, f64) = (25.0, 12.0);
/// Longest step of the logarithm of a variance.
const LONGEST: f64 = 2.0;
/// Blocks of samples whose scores tell their variance.
pub const BLOCKS: usize = 40;

/// Logarithms of the variances of a stochastic model.
#[derive(Debug, Clone, PartialEq)]
pub struct Errors {
    /// ln q per equation of the machine, q in (unit of the highest derivative)²·s.
    pub force: Vec<f64>,
    /// ln r per channel, r in SI².
    pub sensor: Vec<f64>,
}

impl Errors {
    /// Standard deviation of each channel's noise, SI.
    pub fn noise(&self) -> Vec<f64> {
        self.sensor.iter().map(|r| (0.5 * r).exp()).collect()
    }
}

/// A model at these parameters, which errs so much.
#[derive(Debug, Clone)]
pub struct Stochastic {
    /// Model, data and free parameters.
    pub setup: Setup,
    /// All parameters of the model, SI.
    pub parameters: Vec<f64>,
    /// How much it errs.
    pub errors: Errors,
    /// Start of the states that no sensor tells, `[piece][state]`; NaN where one does, or nothing is known.
    pub starts: Vec<Vec<f64>>,
}

/// An equation of the machine that may err.
#[derive(Debug, Clone)]
struct Row {
    /// Name of its coordinate.
    state: String,
    /// Whether its rate is a speed, and the square of the speed at which the error is at half.
    slow: Option<f64>,
    /// First ln q.
    first: f64,
}

/// What disturbs the rate of an equation's highest derivative but one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateNoise {
    /// Entry of the state vector.
    pub entry: usize,
    /// Intensity q, (unit of the highest derivative)²·s.
    pub intensity: f64,
    /// Where the rate is a speed, the square of the speed at which the intensity is at half.
    pub slow: Option<f64>,
}

impl RateNoise {
    /// Variance that gathers in `dt` seconds at the state `x`.
    pub fn variance(&self, x: &[f64], dt: f64) -> f64 {
        let full = self.intensity * dt;
        match self.slow {
            Some(slow) => {
                let v = x[self.entry] * x[self.entry];
                full * (AT_REST + v / (v + slow))
            }
            None => full,
        }
    }
}

/// The filter of a set of recordings, for all models of the same machine.
#[derive(Debug, Clone)]
pub struct Filter {
    rows: Vec<Row>,
    /// Samples from one correction to the next, horizon by horizon.
    strides: Vec<usize>,
    /// How many first samples each is thinned from.
    phases: Vec<usize>,
    /// Samples that a simulation goes at once: of a machine without inputs it needs none between two corrections.
    coarse: usize,
    /// First sample of each piece in all of them.
    offsets: Vec<usize>,
    total: usize,
    spread: Vec<f64>,
    /// Least and first ln r per channel.
    sensor: Vec<(f64, f64)>,
    /// Size of each state's entries by name: what is known of a start that no sensor tells.
    sizes: Vec<(String, Vec<f64>)>,
}

/// One run of the filter: over a piece, thinned by a horizon from a first sample on.
struct Chain {
    horizon: usize,
    piece: usize,
    first: usize,
}

/// One innovation.
#[derive(Debug)]
pub struct Innovation<'a> {
    /// Index of the horizon.
    pub horizon: usize,
    /// Piece and sample.
    pub at: (usize, usize),
    /// Channel.
    pub channel: usize,
    /// Measured less predicted, SI.
    pub e: f64,
    /// Its variance.
    pub s: f64,
    /// Derivatives of the innovation by the free parameters.
    pub by_parameters: &'a [f64],
    /// Derivatives of the innovation, and of its variance, by ln q and ln r.
    pub by_errors: (&'a [f64], &'a [f64]),
    /// Derivatives of the innovation by the signals.
    pub by_signals: &'a [f64],
}

/// What the filter says of a model.
#[derive(Debug, Clone)]
pub struct Pass {
    /// ln L, summed over the horizons.
    pub log: f64,
    /// Its gradient: free parameters, ln q, ln r.
    pub gradient: Vec<f64>,
    /// Its information, row by row.
    pub information: Vec<f64>,
    /// Gradients of [`BLOCKS`] blocks of samples.
    pub blocks: Vec<Vec<f64>>,
}

impl Pass {
    fn new(n: usize) -> Pass {
        Pass {
            log: 0.0,
            gradient: vec![0.0; n],
            information: vec![0.0; n * n],
            blocks: vec![vec![0.0; n]; BLOCKS],
        }
    }

    fn add(&mut self, filter: &Filter, i: &Innovation<'_>) {
        let (np, nn) = (i.by_parameters.len(), i.by_errors.0.len());
        let n = np + nn;
        let ratio = i.e * i.e / i.s;
        self.log -= 0.5 * (ratio + (2.0 * std::f64::consts::PI * i.s).ln());
        if n == 0 {
            return;
        }
        let (piece, sample) = i.at;
        let block = &mut self.blocks[BLOCKS * (filter.offsets[piece] + sample) / filter.total.max(1)];
        let de = |a: usize| if a < np { i.by_parameters[a] } else { i.by_errors.0[a - np] };
        let ds = |a: usize| if a < np { 0.0 } else { i.by_errors.1[a - np] };
        let (inverse, half) = (1.0 / i.s, 0.5 / (i.s * i.s));
        for a in 0..n {
            let (dea, dsa) = (de(a), ds(a));
            let g = -i.e * dea * inverse + 0.5 * dsa * inverse * (ratio - 1.0);
            self.gradient[a] += g;
            block[a] += g;
            for b in 0..=a {
                self.information[a * n + b] += dea * de(b) * inverse + half * dsa * ds(b);
            }
        }
    }

    /// Of all parts together, the other half of the information filled in.
    fn sum(parts: Vec<Pass>, n: usize) -> Pass {
        let mut total = Pass::new(n);
        let add = |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        for part in parts {
            total.log += part.log;
            add(&mut total.gradient, &part.gradient);
            add(&mut total.information, &part.information);
            total.blocks.iter_mut().zip(&part.blocks).for_each(|(a, b)| add(a, b));
        }
        for a in 0..n {
            for b in 0..a {
                total.information[b * n + a] = total.information[a * n + b];
            }
        }
        total
    }

    /// How much the information overstates what the samples tell of the first `n` of what is free: the mean eigenvalue of
    /// I⁻¹J, with the variance J of the score from the blocks of samples; at least 1. (The ratio of the two in Godambe's
    /// information, *An optimum property of regular maximum likelihood estimation*, Ann. Math. Stat. 31, 1960.) Of a
    /// composite likelihood and of innovations that come in bursts, it is far from 1.
    pub fn inflation(&self, n: usize) -> f64 {
        let all = self.gradient.len();
        let n = if n == 0 { all } else { n.min(all) };
        if n == 0 {
            return 1.0;
        }
        let diagonal: Vec<f64> =
            (0..n).map(|a| self.information[a * all + a].max(f64::MIN_POSITIVE).sqrt()).collect();
        let mut information = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                information[a * n + b] = self.information[a * all + b] / (diagonal[a] * diagonal[b]);
            }
            information[a * n + a] += 1e-9;
        }
        let mean: Vec<f64> = (0..n).map(|a| self.gradient[a] / BLOCKS as f64).collect();
        let mut trace = 0.0;
        for block in &self.blocks {
            let g: Vec<f64> = (0..n).map(|a| (block[a] - mean[a]) / diagonal[a]).collect();
            trace += qr::dot(&g, &qr::solve_spd(&information, n, &g));
        }
        let c = trace / n as f64 * BLOCKS as f64 / (BLOCKS - 1) as f64;
        if c.is_finite() { c.max(1.0) } else { 1.0 }
    }
}

/// A model fitted by the filter.
#[derive(Debug, Clone)]
pub struct Fitted {
    /// Where the fit ended.
    pub at: Stochastic,
    /// The filter there.
    pub pass: Pass,
    /// weight · ln L + ln of the priors.
    pub objective: f64,
    /// It ended because nothing more was to be gained.
    pub converged: bool,
}

/// Root mean square of what is finite.
fn rms<'a>(values: impl Iterator<Item = &'a f64>) -> f64 {
    let (mut sum, mut n) = (0.0, 0usize);
    for v in values.filter(|v| v.is_finite()) {
        sum += v * v;
        n += 1;
    }
    (sum / n.max(1) as f64).sqrt()
}

impl Filter {
    /// Prepares the filter for the recordings of a machine; `nominal` has no equations but the machine's own.
    pub fn new(nominal: &Setup) -> Filter {
        let data = &nominal.data;
        let lengths = data.lengths();
        let total: usize = lengths.iter().sum();
        let offsets = lengths
            .iter()
            .scan(0, |at, n| {
                let first = *at;
                *at += n;
                Some(first)
            })
            .collect();
        let dt = data.pieces.iter().map(|p| p.dt).fold(f64::INFINITY, f64::min);
        let slowest = data.periods().into_iter().fold(0.0, f64::max);
        let strides = strides(total, (0.5 * slowest) as usize);
        let runs: Vec<Option<Vec<f64>>> = (0..data.pieces.len())
            .map(|p| {
                let (x0, seeds) = (nominal.start(p, 0), Seeds::default());
                let environment = &nominal.environments[p];
                let run = integrate(
                    &nominal.system,
                    environment,
                    &nominal.values(),
                    &x0,
                    0..environment.len,
                    nominal.method,
                    &seeds,
                );
                run.diverged.is_none().then_some(run.x)
            })
            .collect();
        // Of an entry of the state: by its sensor, else by the simulation.
        let size = |entry: usize| -> f64 {
            let seen: Vec<&Vec<f64>> =
                nominal.smoothed_states.states.iter().filter_map(|states| states[entry].as_ref()).collect();
            if !seen.is_empty() {
                return rms(seen.into_iter().flatten());
            }
            let simulated = runs.iter().zip(&lengths).filter_map(|(run, n)| {
                run.as_ref().map(|x| rms(x[entry * n..(entry + 1) * n].iter()).powi(2))
            });
            let squares: Vec<f64> = simulated.collect();
            (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
        };
        let (offset, order) = (&nominal.system.offsets, &nominal.system.orders);
        let rows = nominal
            .model
            .states
            .iter()
            .enumerate()
            .map(|(j, state)| {
                let seen: Vec<&Vec<f64>> =
                    nominal.smoothed_states.highest.iter().filter_map(|h| h[j].as_ref()).collect();
                let rate = size(offset[j] + order[j] - 1);
                let highest =
                    if seen.is_empty() { rate / dt / FIRST_MEMORY } else { rms(seen.into_iter().flatten()) };
                let first = (FIRST_ERROR * highest).powi(2) * FIRST_MEMORY * dt;
                Row {
                    state: state.name.clone(),
                    slow: (order[j] > 1 && rate > 0.0).then_some((SLOW * rate).powi(2)),
                    first: first.max(f64::MIN_POSITIVE).ln(),
                }
            })
            .collect();
        let sensor = data
            .sigma
            .iter()
            .zip(&data.spread)
            .map(|(sigma, spread)| {
                let sigma = sigma.max(1e-9 * spread).max(f64::MIN_POSITIVE);
                (2.0 * (LEAST_NOISE * sigma).ln(), 2.0 * sigma.ln())
            })
            .collect();
        let sizes = nominal
            .model
            .states
            .iter()
            .enumerate()
            .map(|(j, state)| (state.name.clone(), (0..order[j]).map(|i| size(offset[j] + i)).collect()))
            .collect();
        Filter {
            rows,
            phases: strides.iter().map(|stride| phases(total, *stride)).collect(),
            coarse: coarse(nominal, strides[0]),
            strides,
            offsets,
            total,
            spread: data.spread.iter().map(|s| s.max(1e-300)).collect(),
            sensor,
            sizes,
        }
    }

    /// Samples from one correction to the next, horizon by horizon.
    pub fn strides(&self) -> &[usize] {
        &self.strides
    }

    /// How much a model errs before anything is known of it.
    pub fn first_errors(&self) -> Errors {
        Errors {
            force: self.rows.iter().map(|r| r.first).collect(),
            sensor: self.sensor.iter().map(|s| s.1).collect(),
        }
    }

    /// What disturbs the rates of a model that errs so much.
    pub fn rate_noise(&self, at: &Stochastic) -> Vec<RateNoise> {
        let system = &at.setup.system;
        self.rows
            .iter()
            .zip(&at.errors.force)
            .filter_map(|(row, ln)| {
                let j = at.setup.model.state(&row.state)?;
                let entry = system.offsets[j] + system.orders[j] - 1;
                Some(RateNoise { entry, intensity: ln.exp(), slow: row.slow })
            })
            .collect()
    }

    /// Number of variances.
    fn variances(&self) -> usize {
        self.rows.len() + self.sensor.len()
    }

    /// Runs the filter over every horizon of every piece. `add` receives the innovations of one of them, in their order,
    /// and what it makes of them comes back in the order of horizons and pieces; `None` where the model diverges.
    pub fn run<T: Send>(
        &self,
        at: &Stochastic,
        derivatives: bool,
        signals: Option<&[Arc<SignalLanes>]>,
        new: impl Fn() -> T + Sync,
        add: impl Fn(&mut T, &Innovation<'_>) + Sync,
    ) -> Option<Vec<T>> {
        self.run_from(0, at, derivatives, signals, new, add)
    }

    /// The same over the horizons from one on.
    fn run_from<T: Send>(
        &self,
        shortest: usize,
        at: &Stochastic,
        derivatives: bool,
        signals: Option<&[Arc<SignalLanes>]>,
        new: impl Fn() -> T + Sync,
        add: impl Fn(&mut T, &Innovation<'_>) + Sync,
    ) -> Option<Vec<T>> {
        let mut chains = Vec::new();
        for horizon in shortest..self.strides.len() {
            let (stride, phases) = (self.strides[horizon], self.phases[horizon]);
            for phase in 0..phases {
                let first = phase * stride / phases / self.coarse * self.coarse;
                chains.extend((0..at.setup.data.pieces.len()).map(|piece| Chain { horizon, piece, first }));
            }
        }
        chains
            .into_par_iter()
            .map(|chain| {
                let mut out = new();
                let signals = signals.map(|s| &s[chain.piece]);
                self.chain(at, &chain, derivatives, signals, &mut |i| add(&mut out, i)).then_some(out)
            })
            .collect()
    }

    /// The likelihood of a model with its derivatives, or alone.
    pub fn pass(&self, at: &Stochastic, derivatives: bool) -> Option<Pass> {
        self.pass_from(0, at, derivatives)
    }

    fn pass_from(&self, shortest: usize, at: &Stochastic, derivatives: bool) -> Option<Pass> {
        let n = if derivatives { at.setup.free.len() + self.variances() } else { 0 };
        let add = |pass: &mut Pass, i: &Innovation<'_>| pass.add(self, i);
        let parts = self.run_from(shortest, at, derivatives, None, || Pass::new(n), add)?;
        let pass = Pass::sum(parts, n);
        pass.log.is_finite().then_some(pass)
    }

    /// ln L of the longer half of the horizons alone: enough to tell which of several points is the best to begin with.
    pub fn glance(&self, at: &Stochastic) -> Option<f64> {
        self.pass_from(self.strides.len() / 2, at, false).map(|pass| pass.log)
    }

    /// First state of a piece, and its covariance (row by row).
    pub fn start(&self, at: &Stochastic, piece: usize) -> (Vec<f64>, Vec<f64>) {
        let setup = &at.setup;
        let nx = setup.system.nx;
        let mut x = setup.start(piece, 0);
        let mut p = vec![0.0; nx * nx];
        let prior = setup.start_prior(piece, 0);
        for (j, state) in setup.model.states.iter().enumerate() {
            for i in 0..state.order {
                let entry = setup.system.offsets[j] + i;
                let (mean, std) = prior[entry];
                let given = at.starts.get(piece).and_then(|s| s.get(entry)).copied().unwrap_or(f64::NAN);
                let std = if std.is_finite() {
                    x[entry] = mean;
                    std
                } else {
                    if given.is_finite() {
                        x[entry] = given;
                    }
                    // What a mechanism remembers is as uncertain as its start is large.
                    let known = self.sizes.iter().find(|s| s.0 == state.name);
                    known.map_or_else(|| x[entry].abs(), |s| s.1[i])
                };
                p[entry * nx + entry] = std * std;
            }
        }
        (x, p)
    }

    /// The filter over one piece at one horizon. `false` where the model diverges.
    fn chain(
        &self,
        at: &Stochastic,
        chain: &Chain,
        derivatives: bool,
        signals: Option<&Arc<SignalLanes>>,
        add: &mut dyn FnMut(&Innovation<'_>),
    ) -> bool {
        let setup = &at.setup;
        let coarse = self.coarse;
        let Chain { horizon, piece, first } = *chain;
        let fine = &setup.environments[piece];
        // (A machine of which samples are skipped has no inputs.)
        let thin = (coarse > 1).then(|| Environment {
            dt: fine.dt * coarse as f64,
            len: fine.len.div_ceil(coarse),
            start: fine.start,
            inputs: Vec::new(),
            forces: Vec::new(),
        });
        let environment = thin.as_ref().unwrap_or(fine);
        let system = &*setup.system;
        let (nx, ny) = (system.nx, system.ny);
        let (stride, first) = (self.strides[horizon] / coarse, first / coarse);
        let seeds = Seeds {
            parameters: if derivatives { setup.free.iter().map(|f| f.index).collect() } else { Vec::new() },
            initial: (0..nx).collect(),
            signals: signals.map(|s| thinned(s, coarse)).unwrap_or_default(),
        };
        let (np, lanes) = (seeds.parameters.len(), seeds.lanes());
        let nn = if derivatives { self.variances() } else { 0 };
        let noise = self.rate_noise(at);
        let (x0, mut p) = self.start(at, piece);
        let simulation = Simulation {
            system,
            environment,
            parameters: &at.parameters,
            method: finer(setup.method, coarse),
            seeds: &seeds,
        };
        let mut stepper = simulation.stepper(&x0);
        let mut x = x0;
        let mut before = vec![0.0; nx];
        let mut dp = vec![0.0; nn * nx * nx];
        let mut dx = vec![0.0; nn * nx];
        let mut f = vec![0.0; nx * nx];
        let mut scratch = vec![0.0; nx * nx];
        let mut change = vec![0.0; nx * lanes];
        let mut by_lanes = vec![0.0; lanes];
        let (mut by_e, mut by_s, mut dk) = (vec![0.0; nn], vec![0.0; nn], vec![0.0; nn * nx]);
        let (mut pc, mut gain, mut row) = (vec![0.0; nx], vec![0.0; nx], vec![0.0; nx]);
        let measured = &setup.data.pieces[piece].measured;
        let n = environment.len;
        if n <= first {
            return true;
        }
        let last = first + (n - 1 - first) / stride * stride;
        // Half of a step's noise before it, half after it.
        let disturb = |p: &mut [f64], dp: &mut [f64], x: &[f64]| {
            for (l, noise) in noise.iter().enumerate() {
                let q = noise.variance(x, environment.dt);
                let i = noise.entry * nx + noise.entry;
                p[i] += 0.5 * q;
                if !dp.is_empty() {
                    dp[l * nx * nx + i] += 0.5 * q;
                }
            }
        };
        for k in 0..=last {
            if k >= first && (k - first).is_multiple_of(stride) {
                stepper.observe();
                x.copy_from_slice(stepper.state());
                change.fill(0.0);
                before.copy_from_slice(&x);
                for c in 0..ny {
                    let y = measured[c][k * coarse];
                    if y.is_nan() {
                        continue;
                    }
                    let tangents = stepper.output_tangents(c);
                    row.copy_from_slice(&tangents[np..np + nx]);
                    let moved: f64 =
                        row.iter().zip(x.iter().zip(&before)).map(|(r, (a, b))| r * (a - b)).sum();
                    let e = y - stepper.output(c) - moved;
                    for i in 0..nx {
                        pc[i] = qr::dot(&p[i * nx..(i + 1) * nx], &row);
                    }
                    let r = at.errors.sensor[c].exp();
                    let s = qr::dot(&pc, &row) + r;
                    if !(e.is_finite() && s.is_finite() && s > 0.0) {
                        return false;
                    }
                    for (l, by) in by_lanes.iter_mut().enumerate() {
                        let moved: f64 = (0..nx).map(|i| row[i] * change[i * lanes + l]).sum();
                        *by = -(tangents[l] + moved);
                    }
                    for (i, g) in gain.iter_mut().enumerate() {
                        *g = pc[i] / s;
                    }
                    for l in 0..nn {
                        let dp = &dp[l * nx * nx..(l + 1) * nx * nx];
                        by_e[l] = -qr::dot(&row, &dx[l * nx..(l + 1) * nx]);
                        let dk = &mut dk[l * nx..(l + 1) * nx];
                        for i in 0..nx {
                            dk[i] = qr::dot(&dp[i * nx..(i + 1) * nx], &row);
                        }
                        by_s[l] = qr::dot(dk, &row) + if l == self.rows.len() + c { r } else { 0.0 };
                        for i in 0..nx {
                            dk[i] = (dk[i] - gain[i] * by_s[l]) / s;
                        }
                    }
                    add(&Innovation {
                        horizon,
                        at: (piece, k * coarse),
                        channel: c,
                        e,
                        s,
                        by_parameters: &by_lanes[..np],
                        by_errors: (&by_e, &by_s),
                        by_signals: &by_lanes[np + nx..],
                    });
                    for i in 0..nx {
                        x[i] += gain[i] * e;
                        for l in (0..np).chain(np + nx..lanes) {
                            change[i * lanes + l] += gain[i] * by_lanes[l];
                        }
                        for j in 0..nx {
                            p[i * nx + j] -= gain[i] * pc[j];
                        }
                    }
                    for l in 0..nn {
                        for i in 0..nx {
                            let dki = dk[l * nx + i];
                            dx[l * nx + i] += dki * e + gain[i] * by_e[l];
                            for j in 0..nx {
                                dp[(l * nx + i) * nx + j] -=
                                    dki * pc[j] + gain[i] * by_s[l] * gain[j] + pc[i] * dk[l * nx + j];
                            }
                        }
                    }
                }
                stepper.set_state(&x);
                for i in 0..nx {
                    let change = &change[i * lanes..(i + 1) * lanes];
                    stepper.tangents_mut(i).iter_mut().zip(change).for_each(|(t, c)| *t += c);
                }
            }
            if k == last {
                break;
            }
            disturb(&mut p, &mut dp, stepper.state());
            if !stepper.step() {
                return false;
            }
            for i in 0..nx {
                f[i * nx..(i + 1) * nx].copy_from_slice(&stepper.tangents(i)[np..np + nx]);
            }
            stepper.restart_lanes();
            qr::sandwich(&f, &mut p, &mut scratch, nx);
            for l in 0..nn {
                qr::sandwich(&f, &mut dp[l * nx * nx..(l + 1) * nx * nx], &mut scratch, nx);
                let dx = &mut dx[l * nx..(l + 1) * nx];
                for i in 0..nx {
                    scratch[i] = qr::dot(&f[i * nx..(i + 1) * nx], dx);
                }
                dx.copy_from_slice(&scratch[..nx]);
            }
            disturb(&mut p, &mut dp, stepper.state());
        }
        setup.work.add_evaluations(stepper.evaluations(), lanes, system);
        true
    }

    /// Maximises weight · ln L less half the priors' squares, from a point, by Fisher's scoring with Levenberg's damping;
    /// no parameter goes more than half-way to its bound in a step. `None` where the model diverges at the point.
    pub fn fit(&self, at: Stochastic, weight: f64, iterations: usize) -> Option<Fitted> {
        let prior = |s: &Stochastic| -> f64 {
            -0.5 * s.setup.free.iter().map(|f| f.prior.at(s.parameters[f.index]).0.powi(2)).sum::<f64>()
        };
        let mut at = at;
        for f in &at.setup.free {
            at.parameters[f.index] = at.parameters[f.index].max(f.lower).min(f.upper);
        }
        let mut pass = self.pass(&at, true)?;
        let mut objective = weight * pass.log + prior(&at);
        let (mut damping, mut small, mut converged) = (1e-2, 0, false);
        for _ in 0..iterations {
            if at.setup.work.is_given_up() {
                break;
            }
            let mut accepted = false;
            for attempt in 0..8 {
                let (trial, promised) = self.step(&at, &pass, weight, damping);
                // (The first is tried in any case: the gradient is not exact.)
                if attempt > 0 && (promised.is_nan() || promised < GAIN) {
                    break;
                }
                let found = self.pass(&trial, true);
                let value = found.as_ref().map_or(f64::NEG_INFINITY, |p| weight * p.log + prior(&trial));
                if value > objective {
                    small = if value - objective < GAIN { small + 1 } else { 0 };
                    (at, objective) = (trial, value);
                    if let Some(found) = found {
                        pass = found;
                    }
                    damping = (0.2 * damping).max(1e-6);
                    accepted = true;
                    break;
                }
                damping *= 8.0;
                if damping > 1e6 {
                    break;
                }
            }
            if !accepted || small >= 2 {
                converged = true;
                break;
            }
        }
        Some(Fitted { at, pass, objective, converged })
    }

    /// A step of the scoring, and the gain that the curvature promises.
    fn step(&self, at: &Stochastic, pass: &Pass, weight: f64, damping: f64) -> (Stochastic, f64) {
        let free = &at.setup.free;
        let (np, n) = (free.len(), pass.gradient.len());
        let value = |a: usize| match a.checked_sub(np) {
            None => at.parameters[free[a].index],
            Some(l) if l < self.rows.len() => at.errors.force[l],
            Some(l) => at.errors.sensor[l - self.rows.len()],
        };
        let bounds = |a: usize| match a.checked_sub(np) {
            None => (free[a].lower, free[a].upper),
            Some(l) if l < self.rows.len() => (self.rows[l].first - RANGE.0, self.rows[l].first + RANGE.1),
            Some(l) => {
                let c = l - self.rows.len();
                (self.sensor[c].0, 2.0 * self.spread[c].ln())
            }
        };
        let mut g: Vec<f64> = pass.gradient.iter().map(|g| weight * g).collect();
        let mut h: Vec<f64> = pass.information.iter().map(|i| weight * i).collect();
        for (a, f) in free.iter().enumerate() {
            let (z, slope) = f.prior.at(at.parameters[f.index]);
            g[a] -= z * slope;
            h[a * n + a] += slope * slope;
        }
        // What pushes against a bound stays.
        let held: Vec<bool> = (0..n)
            .map(|a| {
                let ((low, high), v) = (bounds(a), value(a));
                let near = 1e-6 * (high - low).min(v.abs().max(1e-300));
                (v - low <= near && g[a] < 0.0) || (high - v <= near && g[a] > 0.0)
            })
            .collect();
        let d: Vec<f64> = (0..n).map(|a| h[a * n + a].max(f64::MIN_POSITIVE).sqrt()).collect();
        let mut scaled = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                let out = a != b && (held[a] || held[b]);
                scaled[a * n + b] = if out { 0.0 } else { h[a * n + b] / (d[a] * d[b]) };
            }
            scaled[a * n + a] += damping;
        }
        let rhs: Vec<f64> = (0..n).map(|a| if held[a] { 0.0 } else { g[a] / d[a] }).collect();
        let step = qr::solve_spd(&scaled, n, &rhs);
        let mut next = at.clone();
        let mut moved = vec![0.0; n];
        for a in 0..n {
            let ((low, high), v) = (bounds(a), value(a));
            let mut step = step[a] / d[a];
            if a >= np {
                step = step.clamp(-LONGEST, LONGEST);
            }
            let to = v + step;
            let to = if to <= low {
                0.5 * (v + low)
            } else if to >= high {
                0.5 * (v + high)
            } else {
                to
            };
            moved[a] = to - v;
            match a.checked_sub(np) {
                None => next.parameters[free[a].index] = to,
                Some(l) if l < self.rows.len() => next.errors.force[l] = to,
                Some(l) => next.errors.sensor[l - self.rows.len()] = to,
            }
        }
        let curved: f64 = (0..n).map(|a| moved[a] * qr::dot(&h[a * n..(a + 1) * n], &moved)).sum();
        (next, qr::dot(&g, &moved) - 0.5 * curved)
    }
}

/// Gain of a step below which a fit is about to end, in nats.
const GAIN: f64 = 0.05;

/// Steps in a period of the fastest channel that a simulation of a machine without inputs takes at least.
const STEPS: f64 = 50.0;

/// Samples that a simulation may go at once.
fn coarse(setup: &Setup, first: usize) -> usize {
    if setup.system.nu > 0 || !setup.environments.iter().all(|e| e.forces.is_empty()) {
        return 1;
    }
    let period = setup.data.periods().into_iter().fold(f64::INFINITY, f64::min);
    // (A divisor of the first stride, so that every correction falls on a step.)
    (1..=first).rev().find(|n| first.is_multiple_of(*n) && *n as f64 * STEPS <= period).unwrap_or(1)
}

/// A method for so many samples at once: as many steps where one sample takes several.
fn finer(method: Method, coarse: usize) -> Method {
    let steps = |substeps: usize| if substeps > 1 { substeps * coarse } else { 1 };
    match method {
        Method::Rk4 { substeps } => Method::Rk4 { substeps: steps(substeps) },
        Method::Dp5 { substeps } => Method::Dp5 { substeps: steps(substeps) },
        Method::Dop853 { substeps } => Method::Dop853 { substeps: steps(substeps) },
        Method::Rk4Stride { samples } => Method::Rk4 { substeps: coarse.div_ceil(samples.max(1)) },
        adaptive @ Method::Adaptive { .. } => adaptive,
    }
}

/// The same signals at every n-th sample.
fn thinned(signals: &Arc<SignalLanes>, n: usize) -> Arc<SignalLanes> {
    if n == 1 {
        return signals.clone();
    }
    let lanes = signals.lanes;
    let thin = |table: &Vec<f64>| -> Vec<f64> {
        let samples = if signals.rows.is_empty() { table.len() / lanes.max(1) } else { signals.rows.len() };
        let rows = (0..samples).step_by(n).map(|k| &table[signals.row(k) * lanes..][..lanes]);
        if table.is_empty() { Vec::new() } else { rows.flatten().copied().collect() }
    };
    let all = |tables: &Vec<(usize, Vec<f64>)>| tables.iter().map(|(i, t)| (*i, thin(t))).collect();
    Arc::new(SignalLanes {
        lanes,
        weights: signals.weights.clone(),
        force: thin(&signals.force),
        inputs: all(&signals.inputs),
        outputs: all(&signals.outputs),
        rows: Vec::new(),
    })
}

/// The horizons of so many samples in all.
fn strides(total: usize, half_period: usize) -> Vec<usize> {
    let first = total.div_ceil(MOST_SAMPLES).max(1);
    let mut out = vec![first];
    let mut next = first * RATIO;
    while total / next >= LEAST_SAMPLES && (out.len() < HORIZONS || out[out.len() - 1] < half_period) {
        out.push(next);
        next *= RATIO;
    }
    out
}

/// How many first samples a record is thinned from, so that a horizon has enough samples.
fn phases(total: usize, stride: usize) -> usize {
    (FEWEST * stride).div_ceil(total.max(1)).clamp(1, stride)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Data, free_parameters};
    use greybox_model::Model;
    use greybox_recording::{Channel, Recording};
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    const DECAY: &str = r#"
[states]
x = { unit = "m" }
[parameters]
a = { value = 0.8, unit = "1/s" }
[equations]
decay = "x' + a*x = 0"
"#;

    /// dx = −a x dt + √q dw, measured with noise of variance r.
    fn walk(n: usize, a: f64, q: f64, r: f64, seed: u64) -> Setup {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let dt = 0.1;
        let decay = (-a * dt).exp();
        let jump = (q * (1.0 - decay * decay) / (2.0 * a)).sqrt();
        let mut x = (q / (2.0 * a)).sqrt() * normal() + 2.0;
        let values = (0..n)
            .map(|_| {
                let y = x + r.sqrt() * normal();
                x = decay * x + jump * normal();
                y
            })
            .collect();
        let time: Vec<f64> = (0..n).map(|k| dt * k as f64).collect();
        let channel = Channel { name: "x".into(), unit: None, values };
        let model = Model::from_toml(DECAY, "decay.toml").unwrap();
        let recording = Recording::from_columns("walk.csv", time, vec![channel]).unwrap();
        let data = Arc::new(Data::new(&model, &[recording]).unwrap());
        Setup::new(&model, data, free_parameters(&model)).unwrap()
    }

    fn at(setup: &Setup, a: f64, q: f64, r: f64) -> Stochastic {
        let errors = Errors { force: vec![q.ln()], sensor: vec![r.ln()] };
        Stochastic { setup: setup.clone(), parameters: vec![a], errors, starts: Vec::new() }
    }

    /// The samples of a linear model are jointly normal: their density from the inverse of the whole covariance.
    #[test]
    fn the_likelihood_of_a_linear_model_is_its_normal_density() {
        let (a, q, r, stride) = (0.6, 0.3, 0.02, 2);
        let setup = walk(40, 0.8, 0.4, 0.01, 3);
        let mut filter = Filter::new(&setup);
        (filter.strides, filter.phases) = (vec![stride], vec![1]);
        let found = filter.pass(&at(&setup, a, q, r), false).unwrap().log;
        let decay = (-a * 0.1f64).exp();
        let prior = setup.start_prior(0, 0)[0];
        // Mean and covariance of the states at every sample.
        let n = 40;
        let mut mean = vec![prior.0; n];
        let mut cov = vec![0.0; n * n];
        cov[0] = prior.1 * prior.1;
        for k in 1..n {
            mean[k] = decay * mean[k - 1];
            for j in 0..k {
                cov[k * n + j] = decay * cov[(k - 1) * n + j];
                cov[j * n + k] = cov[k * n + j];
            }
            cov[k * n + k] = decay * decay * cov[(k - 1) * n + k - 1] + 0.5 * q * 0.1 * (1.0 + decay * decay);
        }
        let seen: Vec<usize> = (0..n).step_by(stride).collect();
        let m = seen.len();
        let mut s = vec![0.0; m * m];
        for (i, a) in seen.iter().enumerate() {
            for (j, b) in seen.iter().enumerate() {
                s[i * m + j] = cov[a * n + b] + if i == j { r } else { 0.0 };
            }
        }
        let e: Vec<f64> = seen.iter().map(|k| setup.data.pieces[0].measured[0][*k] - mean[*k]).collect();
        let square = qr::dot(&e, &qr::solve_spd(&s, m, &e));
        let mut det = 0.0;
        for k in 0..m {
            // Gauss elimination, row by row.
            let pivot = s[k * m + k];
            det += pivot.ln();
            for i in k + 1..m {
                let factor = s[i * m + k] / pivot;
                for j in k..m {
                    s[i * m + j] -= factor * s[k * m + j];
                }
            }
        }
        let dense = -0.5 * (square + det + m as f64 * (2.0 * std::f64::consts::PI).ln());
        assert!((found - dense).abs() < 1e-6 * dense.abs(), "{found} {dense}");
    }

    #[test]
    fn the_gradient_by_the_variances_is_exact() {
        let setup = walk(400, 0.8, 0.4, 0.01, 5);
        let filter = Filter::new(&setup);
        assert!(filter.strides.len() > 1);
        let (q, r) = (0.3f64, 0.015f64);
        let gradient = filter.pass(&at(&setup, 0.7, q, r), true).unwrap().gradient;
        let log =
            |dq: f64, dr: f64| filter.pass(&at(&setup, 0.7, q * dq.exp(), r * dr.exp()), false).unwrap().log;
        let h = 1e-4;
        let by_q = (log(h, 0.0) - log(-h, 0.0)) / (2.0 * h);
        let by_r = (log(0.0, h) - log(0.0, -h)) / (2.0 * h);
        assert!((gradient[1] - by_q).abs() < 1e-4 * by_q.abs().max(1.0), "{} {by_q}", gradient[1]);
        assert!((gradient[2] - by_r).abs() < 1e-4 * by_r.abs().max(1.0), "{} {by_r}", gradient[2]);
    }

    /// The rate, the intensity and the sensor's noise of a random walk that decays, over seeds: means within 2.5 standard
    /// errors of the truth and the hundredth that a finite record is biased by.
    #[test]
    fn a_walk_tells_its_rate_its_intensity_and_its_noise() {
        let (a, q, r) = (0.8f64, 0.4f64, 0.01f64);
        let seeds = 20;
        let mut found = vec![Vec::new(); 3];
        for seed in 0..seeds {
            let setup = walk(3000, a, q, r, 100 + seed);
            let mut filter = Filter::new(&setup);
            filter.strides.truncate(1);
            let start =
                Stochastic { errors: filter.first_errors(), ..at(&setup, setup.values()[0], 1.0, 1.0) };
            let fitted = filter.fit(start, 1.0, 40).unwrap();
            assert!(fitted.converged);
            found[0].push(fitted.at.parameters[0] / a);
            found[1].push(fitted.at.errors.force[0].exp() / q);
            found[2].push(fitted.at.errors.sensor[0].exp() / r);
        }
        for values in found {
            let n = values.len() as f64;
            let mean = values.iter().sum::<f64>() / n;
            let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
            assert!(
                (mean - 1.0).abs() < 2.5 * std / n.sqrt() + 0.01 && std < 0.2,
                "{mean} ± {std}: {values:?}"
            );
        }
    }

    /// What does not err needs no error: q goes to nothing where the model is right.
    #[test]
    fn a_right_model_has_no_error() {
        let setup = walk(1000, 0.8, 1e-12, 0.01, 7);
        let filter = Filter::new(&setup);
        let start = Stochastic { errors: filter.first_errors(), ..at(&setup, 0.8, 1.0, 1.0) };
        let fitted = filter.fit(start, 1.0, 60).unwrap();
        let share = (fitted.at.errors.force[0].exp() * 0.1).sqrt() / 0.1;
        assert!(share < 0.02, "{share} of the sensor's noise per sample");
    }

    /// Independent innovations are worth what their information says; those of a thinned record beside the whole are not.
    #[test]
    fn counting_samples_twice_inflates() {
        let setup = walk(4000, 0.8, 0.4, 0.01, 11);
        let mut filter = Filter::new(&setup);
        let of = |filter: &Filter| {
            let pass = filter.pass(&at(&setup, 0.8, 0.4, 0.01), true).unwrap();
            pass.inflation(0)
        };
        let composite = of(&filter);
        filter.strides.truncate(1);
        let single = of(&filter);
        assert!(single < 1.6 && composite > 1.3 * single, "{single} {composite}");
    }

    #[test]
    fn horizons_reach_half_a_period_and_hold_enough_samples() {
        assert_eq!(strides(2000, 10), [1, 4, 16, 64]);
        assert_eq!(strides(2000, 10_000), [1, 4, 16, 64, 256]);
        assert_eq!(strides(120, 10), [1, 4, 16]);
        assert_eq!(strides(60_000, 4000), [12, 48, 192, 768, 3072, 12_288][..5]);
        assert_eq!(strides(0, 0), [1]);
        assert_eq!([1, 4, 16].map(|s| phases(120, s)), [1, 4, 14]);
        assert_eq!([1, 4, 16, 64].map(|s| phases(5000, s)), [1, 1, 1, 2]);
    }
}
