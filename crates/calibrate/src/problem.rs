//! Multiple shooting: output-error least squares over segments with free initial states.
//!
//! ```text
//! minimise  Σ_segments Σ_k Σ_c ((y_c(k) − ŷ_c(k; p, x₀ˢ)) / s_c)²
//!         + Σ_i g_i(p_i)²  +  Σ_segments |(x₀ˢ − x̄₀ˢ)/σˢ|²
//! ```
//!
//! over the parameters p, with their priors g ([`Prior`]), and every segment's initial state x₀ˢ (Bock 1981, without the matching
//! conditions: short segments keep the problem convex, long ones give it power). The initial states
//! are eliminated segment by segment: Householder QR of \[J_x | J_p | r\] leaves a small triangle per
//! segment, and the triangles are stacked and factored again.
//!
//! **What goes on from segment to segment.** A free initial state is harmless where a sensor sees the
//! state and ruinous where none does: the memory of a friction or of an actuator, free again every
//! second, can be whatever the residual likes. Such states are *carried*
//! ([`Problem::carried`]): free, or given, only where a piece begins, and after that where the segment
//! before has left them. Delayed expressions remember what was before the segment in any case. Then
//! the segments of a piece are simulated one after the other. The sensitivities to the parameters go
//! through the seams; that of a segment's carried states and delayed expressions to the *free* initial
//! states of the segments before it is left out of the Jacobian: the step is Gauss–Newton's with this
//! approximation, the cost that decides on a step is the true one. Where a delay is long against the
//! segments the last digits come slowly; longer segments bring them.
//!
//! **Coloured noise.** With [`Problem::noise`] residuals and Jacobians are whitened channel by channel
//! and segment by segment before anything else sees them ([`crate::noise_model`]). With the scale
//! √v_p, the standard deviation of the innovations, the cost is −2 ln of the likelihood of
//! autoregressive noise but for a constant, if the noise of different segments is independent. The
//! rows of the priors are not touched.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use greybox_model::System;
use greybox_simulate::{
    Carry, Environment, Method, Seeds, SignalLanes, Simulation, Trajectory, delayed_states, has_history,
};
use rayon::prelude::*;

use crate::noise_model::Autoregression;
use crate::qr;

/// One stretch of one piece with an initial state of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Index of the piece (environment and measurements).
    pub piece: usize,
    /// Samples, the first being where the initial state applies.
    pub range: Range<usize>,
}

/// What is believed of an initial state before the segment is fitted: one (mean, σ) per state; an
/// infinite σ says nothing, σ = 0 pins the state.
pub type StartPrior = Vec<(f64, f64)>;

/// What is known of a parameter before the fit. With z the departure from the prior's centre over its scale, it adds
/// g(z)² to the cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Prior {
    /// Nothing: g = 0.
    Flat,
    /// A normal distribution, for what is stated: g = z.
    Normal {
        /// Mean.
        mean: f64,
        /// Standard deviation, positive.
        std: f64,
    },
    /// A Cauchy distribution, for a guess that may be wrong by orders of magnitude: g² = ln(1 + z²), which is z² near
    /// the centre and grows without a bound to how far the data may draw the parameter (Gelman, Jakulin, Pittau, Su, *A
    /// weakly informative default prior distribution*, Annals of Applied Statistics 2, 2008; half their exponent).
    Cauchy {
        /// Centre.
        centre: f64,
        /// Scale, positive.
        scale: f64,
    },
}

impl Prior {
    /// g and dg/dp at the value p.
    ///
    /// ```
    /// use greybox_calibrate::Prior;
    /// assert_eq!(Prior::Normal { mean: 1.0, std: 0.5 }.at(2.0), (2.0, 2.0));
    /// let (near, slope) = Prior::Cauchy { centre: 1.0, scale: 0.5 }.at(1.0);
    /// assert_eq!((near, slope), (0.0, 2.0));
    /// // Seventy times the guess costs as much as three standard deviations.
    /// let (far, _) = Prior::Cauchy { centre: 1.0, scale: 0.5 }.at(70.0);
    /// assert!((far - 3.14).abs() < 0.01);
    /// ```
    pub fn at(&self, value: f64) -> (f64, f64) {
        match *self {
            Prior::Flat => (0.0, 0.0),
            Prior::Normal { mean, std } => ((value - mean) / std, 1.0 / std),
            Prior::Cauchy { centre, scale } => {
                let z = (value - centre) / scale;
                let g = (z * z).ln_1p().sqrt().copysign(z);
                let slope = if z.abs() < 1e-6 { 1.0 } else { z / ((1.0 + z * z) * g) };
                (g, slope / scale)
            }
        }
    }

    /// Its part of the matrix of Gauss and Newton at a value: (dg/dp)².
    pub fn precision(&self, value: f64) -> f64 {
        self.at(value).1.powi(2)
    }
}

/// A parameter the fit may move.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeParameter {
    /// Index in the system's parameter vector.
    pub index: usize,
    /// What is known of it before the fit.
    pub prior: Prior,
    /// Smallest admissible value.
    pub lower: f64,
    /// Largest admissible value.
    pub upper: f64,
}

/// The problem; borrowed parts are shared between the many fits of a diagnosis.
#[derive(Debug, Clone)]
pub struct Problem<'a> {
    /// The compiled model.
    pub system: &'a System,
    /// One environment per piece.
    pub environments: &'a [Environment],
    /// Measurements per piece and channel; NaN = missing.
    pub measured: &'a [&'a [Vec<f64>]],
    /// Integration.
    pub method: Method,
    /// The segments.
    pub segments: &'a [Segment],
    /// One prior per segment.
    pub start_priors: &'a [StartPrior],
    /// Parameters to fit.
    pub free: &'a [FreeParameter],
    /// Residual scale per channel.
    pub scale: &'a [f64],
    /// Entries of the state vector that a segment takes over from the one that ends where it starts.
    pub carried: &'a [usize],
    /// What the measurements say of the states, SI, `past[piece][entry][sample]` (`None`: no sensor). A delayed state
    /// was there before a segment that goes on from no other.
    pub past: &'a [Vec<Option<Vec<f64>>>],
    /// Noise per channel by which the rows of the measurements are whitened; `None`: as they are.
    pub noise: Option<&'a [Autoregression]>,
    /// Where the work done is added up.
    pub work: &'a Work,
}

/// Work done: evaluations of the right-hand side, each counted once for the state and once for every tangent, times
/// the operations of one. Unlike time it is the same in every run, whatever the machine and the number of threads.
#[derive(Debug, Default)]
pub struct Work {
    done: AtomicU64,
    given_up: AtomicBool,
    /// Most of it; 0: no limit.
    most: u64,
    /// Most of one fit; 0: no limit.
    most_of_fit: u64,
    /// What it is a part of: all that is done here is done there too, and ends when that does.
    whole: Option<Arc<Work>>,
}

impl Work {
    /// Work that ends at a limit: every fit that adds up here ends with the step that it is at. For fits one after the
    /// other; of several at once it would depend on chance which one ends.
    pub fn within(most: u64) -> Work {
        Work { most: most.max(1), ..Work::default() }
    }

    /// Work of which each fit does at most so much: it then ends with the step that it is at, which is the same
    /// whatever other fits do.
    pub fn of_fits_within(most: u64) -> Work {
        Work { most_of_fit: most.max(1), ..Work::default() }
    }

    /// A part of `whole` with a limit of its own.
    pub fn part_of(whole: &Arc<Work>, most: u64) -> Work {
        Work { whole: Some(whole.clone()), ..Work::within(most) }
    }

    /// Whether it met its limit, or that of the whole.
    pub fn is_spent(&self) -> bool {
        (self.most > 0 && self.done() > self.most) || self.whole.as_ref().is_some_and(|w| w.is_spent())
    }

    /// So far.
    pub fn done(&self) -> u64 {
        self.done.load(Ordering::Relaxed)
    }

    /// Nobody waits for the answer any more: every fit that adds up here ends with the step that it is at, and what
    /// comes of it is no answer.
    pub fn give_up(&self) {
        self.given_up.store(true, Ordering::Relaxed);
    }

    /// Whether it was given up.
    pub fn is_given_up(&self) -> bool {
        self.given_up.load(Ordering::Relaxed) || self.whole.as_ref().is_some_and(|w| w.is_given_up())
    }

    /// Whether a fit that did so much has to end.
    fn ends(&self, fit: u64) -> bool {
        self.is_given_up() || self.is_spent() || (self.most_of_fit > 0 && fit > self.most_of_fit)
    }

    /// Adds a simulation, and says how much it was.
    fn add(&self, trajectory: &Trajectory, lanes: usize, system: &System) -> u64 {
        self.add_evaluations(trajectory.evaluations, lanes, system)
    }

    /// Adds evaluations of the right-hand side with so many tangents, and says how much work they were.
    pub(crate) fn add_evaluations(&self, evaluations: usize, lanes: usize, system: &System) -> u64 {
        let work = (evaluations * (1 + lanes) * system.rhs.registers()) as u64;
        let mut at = Some(self);
        while let Some(work_of) = at {
            work_of.done.fetch_add(work, Ordering::Relaxed);
            at = work_of.whole.as_deref();
        }
        work
    }
}

/// Most steps that are tried from one point, each more damped than the one before.
const TRIALS: usize = 30;

/// The first step is at most so many times as long as the parameters are (Moré: 0.1 to 100).
const FIRST_RADIUS: f64 = 1.0;

/// Bounds of the damping.
const LEAST_DAMPING: f64 = 1e-12;
const MOST_DAMPING: f64 = 1e18;

/// Least residual where the simulation says no number (a logarithm of what is negative, an overflow) or has diverged, in
/// units of the scale: much more than any that it may have, and not so much that a fit cannot leave such a place.
const UNDEFINED: f64 = 1e3;

/// A point of the search.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// All parameters of the system.
    pub parameters: Vec<f64>,
    /// Initial state of every segment.
    pub starts: Vec<Vec<f64>>,
}

/// The linearised problem of one segment. Rows: channel by channel the samples of the segment,
/// then one row per state for the prior on the start. Missing samples have zero rows, and so have
/// those that whitening cannot form ([`Autoregression::whiten`]).
#[derive(Debug, Clone)]
pub struct SegmentRows {
    /// Number of rows.
    pub rows: usize,
    /// Residual (measured − simulated)/scale.
    pub r: Vec<f64>,
    /// −∂r/∂x₀, one column per state (zero for pinned ones and for those carried from the segment
    /// before).
    pub jx: Vec<f64>,
    /// −∂r/∂p, one column per free parameter.
    pub jp: Vec<f64>,
    /// Response to each signal lane.
    pub signals: Vec<f64>,
    /// The trajectory behind it (its sensitivities moved out).
    pub trajectory: Trajectory,
    /// What it cost, in units of [`Work`].
    pub work: u64,
}

/// How a fit ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// The relative decrease fell below the tolerance, or no step promises one above it.
    Converged,
    /// No step decreases the cost any more.
    Stalled,
    /// The iteration limit was reached, or the work was given up.
    Limit,
}

/// Result of [`Problem::fit`].
#[derive(Debug, Clone)]
pub struct Fit {
    /// Where it ended.
    pub point: Point,
    /// Cost there, priors included.
    pub cost: f64,
    /// Weighted residual sum of squares per channel.
    pub rss: Vec<f64>,
    /// Number of measured samples per channel.
    pub count: Vec<usize>,
    /// Jacobians evaluated.
    pub iterations: usize,
    /// Why it ended.
    pub ending: Ending,
}

/// Limits of [`Problem::fit`].
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Most Jacobians.
    pub iterations: usize,
    /// Relative decrease of the cost below which a fit has converged.
    pub tolerance: f64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits { iterations: 30, tolerance: 1e-6 }
    }
}

struct Reduced {
    /// Triangle of [J_x | J_p | r], stride nx + np + 1.
    triangle: Vec<f64>,
}

impl Problem<'_> {
    /// Simulates every segment and returns its rows; with `jacobian` false only the residuals.
    pub fn rows(
        &self,
        point: &Point,
        jacobian: bool,
        signals: Option<&[Arc<SignalLanes>]>,
    ) -> Vec<SegmentRows> {
        if self.carried.is_empty() && !has_history(self.system) {
            return (0..self.segments.len())
                .into_par_iter()
                .map(|i| self.segment_rows(i, point, jacobian, signals, None).0)
                .collect();
        }
        let chains: Vec<Vec<(usize, SegmentRows)>> = self
            .chains()
            .into_par_iter()
            .map(|chain| {
                let mut before = None;
                chain
                    .into_iter()
                    .map(|i| {
                        let (rows, carry) = self.segment_rows(i, point, jacobian, signals, before.as_ref());
                        before = carry;
                        (i, rows)
                    })
                    .collect()
            })
            .collect();
        let mut rows: Vec<(usize, SegmentRows)> = chains.into_iter().flatten().collect();
        rows.sort_by_key(|(i, _)| *i);
        rows.into_iter().map(|(_, rows)| rows).collect()
    }

    /// The segments (by index) in runs of one piece in which each starts where the one before ended.
    pub fn chains(&self) -> Vec<Vec<usize>> {
        let mut order: Vec<usize> = (0..self.segments.len()).collect();
        order.sort_by_key(|&i| (self.segments[i].piece, self.segments[i].range.start));
        let mut chains: Vec<Vec<usize>> = Vec::new();
        for i in order {
            let goes_on = |chain: &&mut Vec<usize>| {
                chain.last().is_some_and(|&last| {
                    let (a, b) = (&self.segments[last], &self.segments[i]);
                    a.piece == b.piece && a.range.end == b.range.start
                })
            };
            match chains.last_mut().filter(goes_on) {
                Some(chain) => chain.push(i),
                None => chains.push(vec![i]),
            }
        }
        chains
    }

    /// Per segment, whether it goes on from another one, which gives it its carried states.
    fn continued(&self) -> Vec<bool> {
        let mut continued = vec![false; self.segments.len()];
        for &i in self.chains().iter().flat_map(|chain| &chain[1..]) {
            continued[i] = true;
        }
        continued
    }

    /// Writes where the carried states really started into `point`.
    fn take_over(&self, rows: &[SegmentRows], continued: &[bool], point: &mut Point) {
        for ((start, rows), _) in point.starts.iter_mut().zip(rows).zip(continued).filter(|(_, c)| **c) {
            let t = &rows.trajectory;
            if t.n > 0 {
                self.carried.iter().for_each(|&j| start[j] = t.x[j * t.n]);
            }
        }
    }

    /// The measured past of a segment that begins within its piece, where an equation delays a state.
    fn remembered(&self, segment: &Segment) -> Option<Carry> {
        let start = segment.range.start;
        let past = self.past.get(segment.piece)?;
        let delayed = delayed_states(self.system);
        if start == 0 || !delayed.iter().any(|&e| past[e].is_some()) {
            return None;
        }
        // As long as the segment itself: a longer delay is seen in none of its samples.
        let from = start.saturating_sub(segment.range.len());
        let mut states: Vec<Option<&[f64]>> = vec![None; past.len()];
        for e in delayed {
            let known = past[e].as_ref().and_then(|s| s.get(from..=start));
            states[e] = known.filter(|s| s.iter().all(|v| v.is_finite()));
        }
        let dt = self.environments[segment.piece].dt;
        Some(Carry::remembered(self.system, start, dt, &states))
    }

    /// Rows of segment `i`, and where it ended if the next one may have to know.
    fn segment_rows(
        &self,
        i: usize,
        point: &Point,
        jacobian: bool,
        signals: Option<&[Arc<SignalLanes>]>,
        before: Option<&Carry>,
    ) -> (SegmentRows, Option<Carry>) {
        let segment = &self.segments[i];
        let (nx, ny, np) = (self.system.nx, self.system.ny, self.free.len());
        let start = &point.starts[i];
        let prior = &self.start_priors[i];
        let seeds = if jacobian {
            Seeds {
                parameters: self.free.iter().map(|f| f.index).collect(),
                initial: (0..nx).collect(),
                signals: signals.map(|s| s[segment.piece].clone()).unwrap_or_default(),
            }
        } else {
            Seeds::default()
        };
        let simulation = Simulation {
            system: self.system,
            environment: &self.environments[segment.piece],
            parameters: &point.parameters,
            method: self.method,
            seeds: &seeds,
        };
        let n = segment.range.len();
        let range = segment.range.clone();
        let (mut trajectory, carry) = if self.carried.is_empty() && !has_history(self.system) {
            (simulation.run(start, range), None)
        } else {
            let past = if before.is_none() { self.remembered(segment) } else { None };
            let (before, carried) = match &past {
                Some(past) => (Some(past), &[][..]),
                None => (before, self.carried),
            };
            let (trajectory, carry) = simulation.run_on(start, range, before, carried);
            (trajectory, Some(carry))
        };
        let work = self.work.add(&trajectory, seeds.lanes(), self.system);
        let missing: Vec<Vec<bool>> = match self.noise {
            Some(_) => (0..ny).map(|c| self.missing(segment, c)).collect(),
            None => Vec::new(),
        };
        // The rows of the measurements in one column, whitened.
        let whiten = |column: &mut [f64]| {
            for (c, model) in self.noise.unwrap_or_default().iter().enumerate().take(ny) {
                model.whiten(&mut column[c * n..(c + 1) * n], &missing[c]);
            }
        };
        let taken_over = |j: usize| before.is_some() && self.carried.contains(&j);
        let rows = ny * n + nx;
        let mut r = vec![0.0; rows];
        let measured = self.measured[segment.piece];
        // From there on the trajectory is frozen at its last good sample, which may happen to fit.
        let followed = trajectory.diverged.unwrap_or(n);
        for c in 0..ny {
            let inverse = 1.0 / self.scale[c];
            let y = &measured[c][segment.range.clone()];
            for k in 0..n {
                let e = (y[k] - trajectory.y[c * n + k]) * inverse;
                r[c * n + k] = if y[k].is_nan() {
                    0.0
                } else if !e.is_finite() {
                    UNDEFINED
                } else if k >= followed {
                    e.abs().max(UNDEFINED)
                } else {
                    e
                };
            }
        }
        whiten(&mut r);
        for j in 0..nx {
            let (mean, std) = prior[j];
            if std > 0.0 && std.is_finite() && !taken_over(j) {
                r[ny * n + j] = (mean - start[j]) / std;
            }
        }
        let take = |dy: &[f64], from: usize, lanes: usize| -> Vec<f64> {
            let mut columns = vec![0.0; lanes * rows];
            for l in 0..lanes {
                let column = &mut columns[l * rows..(l + 1) * rows];
                let d = &dy[(from + l) * ny * n..(from + l + 1) * ny * n];
                for c in 0..ny {
                    let inverse = 1.0 / self.scale[c];
                    let y = &measured[c][segment.range.clone()];
                    for k in 0..n {
                        let v = d[c * n + k] * inverse;
                        let defined = !y[k].is_nan() && trajectory.y[c * n + k].is_finite() && v.is_finite();
                        column[c * n + k] = if defined { v } else { 0.0 };
                    }
                }
                whiten(column);
            }
            columns
        };
        let (mut jx, mut jp, mut columns) = (Vec::new(), Vec::new(), Vec::new());
        if jacobian {
            jp = take(&trajectory.dy, 0, np);
            jx = take(&trajectory.dy, np, nx);
            columns = take(&trajectory.dy, np + nx, seeds.signals.lanes);
            for j in 0..nx {
                let (_, std) = prior[j];
                if std == 0.0 || taken_over(j) {
                    jx[j * rows..(j + 1) * rows].fill(0.0);
                } else if std.is_finite() {
                    jx[j * rows + ny * n + j] = 1.0 / std;
                } else {
                    // A faint ridge, relative to the column, for a state the segment does not see.
                    let column = &jx[j * rows..(j + 1) * rows];
                    let size = qr::dot(column, column).sqrt();
                    jx[j * rows + ny * n + j] = 1e-5 * size;
                }
            }
            trajectory.dy = Vec::new();
        }
        (SegmentRows { rows, r, jx, jp, signals: columns, trajectory, work }, carry)
    }

    fn prior_cost(&self, parameters: &[f64]) -> f64 {
        self.free.iter().map(|f| f.prior.at(parameters[f.index]).0.powi(2)).sum()
    }

    /// Cost of a point.
    pub fn cost(&self, point: &Point) -> f64 {
        let rows = self.rows(point, false, None);
        self.cost_of(&rows, point)
    }

    /// [`cost`](Self::cost) of a point whose rows are known.
    pub(crate) fn cost_of(&self, rows: &[SegmentRows], point: &Point) -> f64 {
        rows.iter().map(|s| qr::dot(&s.r, &s.r)).sum::<f64>() + self.prior_cost(&point.parameters)
    }

    /// Which samples of channel `c` a segment misses.
    fn missing(&self, segment: &Segment, c: usize) -> Vec<bool> {
        self.measured[segment.piece][c][segment.range.clone()].iter().map(|v| v.is_nan()).collect()
    }

    /// Residual sum of squares (in units of the scale, whitened if the rows are) and number of rows
    /// that count per channel.
    pub fn rss(&self, rows: &[SegmentRows]) -> (Vec<f64>, Vec<usize>) {
        let ny = self.system.ny;
        let (mut rss, mut count) = (vec![0.0; ny], vec![0; ny]);
        for (segment, rows) in self.segments.iter().zip(rows) {
            let n = segment.range.len();
            for c in 0..ny {
                rss[c] += qr::dot(&rows.r[c * n..(c + 1) * n], &rows.r[c * n..(c + 1) * n]);
                let missing = self.missing(segment, c);
                let lost = match self.noise.and_then(|noise| noise.get(c)) {
                    Some(model) => model.lost(&missing),
                    None => missing.iter().filter(|m| **m).count(),
                };
                count[c] += n - lost;
            }
        }
        (rss, count)
    }

    /// Levenberg–Marquardt from `point` in a region of trust (Moré, *The Levenberg–Marquardt algorithm:
    /// implementation and theory*, 1978), bounds by projection. A parameter is scaled by the largest norm that its
    /// column has had: where the model does not feel it for a while, its step stays bounded. The region grows and
    /// shrinks by how much of the decrease that the linear model promised came true.
    ///
    /// It has converged when a step decreases the cost F by less than the tolerance τ, ΔF < τ F, as was promised (MINPACK's test,
    /// Moré, Garbow and Hillstrom, ANL-80-74, 1980: promised < τ F and ΔF / promised < 2), when two in a row do unforeseen, and
    /// when a step fails and promised less than τ F: a shorter one promises less still.
    pub fn fit(&self, point: Point, limits: Limits) -> Fit {
        self.fit_from(point, None, limits)
    }

    /// [`fit`](Self::fit) from a point whose rows, with their derivatives, are known.
    pub(crate) fn fit_from(&self, point: Point, rows: Option<Vec<SegmentRows>>, limits: Limits) -> Fit {
        let (nx, np) = (self.system.nx, self.free.len());
        let width = nx + np + 1;
        let known = point.parameters.clone();
        let mut point = point;
        for f in self.free {
            point.parameters[f.index] = point.parameters[f.index].clamp(f.lower, f.upper);
        }
        let rows = rows.filter(|_| point.parameters == known);
        let continued = self.continued();
        let pinned = |i: usize, j: usize| {
            self.start_priors[i][j].1 == 0.0 || (continued[i] && self.carried.contains(&j))
        };
        let mut radius = 0.0_f64;
        let mut damping = 1.0_f64;
        let mut ending = Ending::Limit;
        let mut iterations = 0;
        // Those of `point` throughout; with derivatives, where another iteration follows.
        let mut rows = rows.unwrap_or_else(|| self.rows(&point, limits.iterations > 0, None));
        let mut cost = self.cost_of(&rows, &point);
        let work_of = |rows: &[SegmentRows]| rows.iter().map(|s| s.work).sum::<u64>();
        let mut work = work_of(&rows);
        let mut small = 0;
        // The first trial of an iteration was taken over.
        let mut goes_well = true;
        let mut sizes = vec![0.0; np];
        while iterations < limits.iterations && !self.work.ends(work) {
            iterations += 1;
            let reduced: Vec<Reduced> = rows
                .par_iter()
                .enumerate()
                .map(|(i, s)| {
                    let mut a = Vec::with_capacity(width * s.rows);
                    a.extend_from_slice(&s.jx);
                    for j in (0..nx).filter(|&j| pinned(i, j)) {
                        // The state's own row says that it does not move; without it the elimination
                        // would take a row of the measurements for this column.
                        a[j * s.rows + s.rows - nx + j] = 1.0;
                    }
                    a.extend_from_slice(&s.jp);
                    a.extend_from_slice(&s.r);
                    Reduced { triangle: qr::triangle(&mut a, s.rows, width) }
                })
                .collect();
            // No more is needed of the derivatives: those of a trial may take their place.
            rows.iter_mut().for_each(|s| (s.jx, s.jp) = (Vec::new(), Vec::new()));
            let global = self.stack(&reduced, &point.parameters, nx, np);
            for (j, size) in sizes.iter_mut().enumerate() {
                let square: f64 = (0..=j).map(|i| global[i * (np + 1) + j].powi(2)).sum();
                *size = square.max(*size);
            }
            let scaled = |values: &mut dyn Iterator<Item = f64>| -> f64 {
                values.zip(&sizes).map(|(v, size)| v * v * size).sum::<f64>().sqrt()
            };
            if iterations == 1 {
                let size = scaled(&mut self.free.iter().map(|f| point.parameters[f.index]));
                radius = FIRST_RADIUS * if size > 0.0 { size } else { cost.sqrt() };
            }
            let mut accepted = false;
            let mut has_derivatives = false;
            let mut otherwise = Ending::Stalled;
            for trials in 0..TRIALS {
                let Some((step, lambda)) = self.step_within(&global, &sizes, radius, &point.parameters)
                else {
                    break;
                };
                let length = scaled(&mut step.iter().copied());
                if iterations == 1 {
                    radius = radius.min(length);
                }
                let mut trial = point.clone();
                for (f, d) in self.free.iter().zip(&step) {
                    trial.parameters[f.index] = (trial.parameters[f.index] + d).clamp(f.lower, f.upper);
                }
                let moved: Vec<f64> =
                    self.free.iter().map(|f| trial.parameters[f.index] - point.parameters[f.index]).collect();
                let shrink = damping / (1.0 + 0.1 * lambda.min(1e6));
                let promised = self.promised(&global, &reduced, &moved, shrink);
                if promised < f64::EPSILON * cost {
                    let whole = |(f, d): (&FreeParameter, &f64)| {
                        (f.lower..=f.upper).contains(&(point.parameters[f.index] + d))
                    };
                    if self.free.iter().zip(&step).all(whole) {
                        otherwise = Ending::Converged;
                        break;
                    }
                    // A bound cut the step to one that is not worth a simulation.
                    radius = 0.25 * radius.min(length);
                    continue;
                }
                for (i, red) in reduced.iter().enumerate() {
                    let rhs: Vec<f64> = (0..nx)
                        .map(|a| {
                            let row = &red.triangle[a * width..(a + 1) * width];
                            row[nx + np] - (0..np).map(|b| row[nx + b] * moved[b]).sum::<f64>()
                        })
                        .collect();
                    let dx = qr::back_substitute(&red.triangle, width, nx, &rhs);
                    for (j, d) in dx.iter().enumerate() {
                        if !pinned(i, j) {
                            trial.starts[i][j] += d * shrink;
                        }
                    }
                }
                // What is likely to be taken over is simulated once, with the derivatives that the next iteration needs.
                has_derivatives = trials == 0 && goes_well && iterations < limits.iterations;
                let simulated = self.rows(&trial, has_derivatives, None);
                let value = self.cost_of(&simulated, &trial);
                work += work_of(&simulated);
                // How much of the decrease that the linear model promised came true says how far it reaches.
                let gained = if value.is_finite() { (cost - value) / promised } else { f64::NEG_INFINITY };
                if gained <= 0.25 {
                    // Where the parabola through the cost, its slope and the new cost has its minimum.
                    let slope = 2.0 * promised;
                    let least = slope / (2.0 * (slope - (cost - value)));
                    let shorter = if gained.is_finite() { least.clamp(0.1, 0.5) } else { 0.1 };
                    radius = shorter * radius.min(10.0 * length);
                } else if gained >= 0.75 || lambda == 0.0 {
                    radius = 2.0 * length;
                }
                if gained > 1e-4 {
                    let decrease = (cost - value) / cost.max(1e-300);
                    point = trial;
                    // A small decrease that was foreseen is the end (MINPACK's test); one that was not may be a bad step.
                    let foreseen = promised < limits.tolerance * cost && gained < 2.0;
                    small = if decrease < limits.tolerance { small + 1 + usize::from(foreseen) } else { 0 };
                    cost = value;
                    damping = (2.0 * damping).min(1.0);
                    rows = simulated;
                    goes_well = trials == 0;
                    accepted = true;
                    break;
                }
                if np == 0 {
                    damping *= 0.25;
                } else if promised < limits.tolerance * cost {
                    // A shorter step promises less still.
                    otherwise = Ending::Converged;
                    break;
                }
            }
            if !accepted {
                ending = otherwise;
                break;
            }
            if small >= 2 || cost < 1e-20 {
                ending = Ending::Converged;
                break;
            }
            if iterations < limits.iterations && !has_derivatives {
                rows = self.rows(&point, true, None);
                work += work_of(&rows);
            }
        }
        self.take_over(&rows, &continued, &mut point);
        let (rss, count) = self.rss(&rows);
        Fit { cost: self.cost_of(&rows, &point), point, rss, count, iterations, ending }
    }

    /// Decrease of the cost that the linear model expects where the parameters move so and the initial states by the
    /// share `shrink` of what would suit them best.
    fn promised(&self, global: &[f64], reduced: &[Reduced], moved: &[f64], shrink: f64) -> f64 {
        let (nx, np) = (self.system.nx, moved.len());
        let (width, stride) = (nx + np + 1, np + 1);
        let of_starts = |r: &Reduced| (0..nx).map(|a| r.triangle[a * width + nx + np].powi(2)).sum::<f64>();
        let of_parameters = (0..np).map(|i| {
            let row = &global[i * stride..(i + 1) * stride];
            let left = row[np] - row[i..np].iter().zip(&moved[i..]).map(|(r, d)| r * d).sum::<f64>();
            row[np].powi(2) - left.powi(2)
        });
        let starts = (1.0 - (1.0 - shrink).powi(2)) * reduced.iter().map(of_starts).sum::<f64>();
        starts + of_parameters.sum::<f64>()
    }

    /// Triangle of [J_p | r] over all segments with the prior's rows, stride np + 1.
    fn stack(&self, reduced: &[Reduced], parameters: &[f64], nx: usize, np: usize) -> Vec<f64> {
        let width = nx + np + 1;
        let m = reduced.len() * (np + 1) + np;
        let mut a = vec![0.0; m * (np + 1)];
        for (s, red) in reduced.iter().enumerate() {
            for i in 0..=np {
                for j in i..=np {
                    a[j * m + s * (np + 1) + i] = red.triangle[(nx + i) * width + nx + j];
                }
            }
        }
        for (i, f) in self.free.iter().enumerate() {
            let (g, slope) = f.prior.at(parameters[f.index]);
            let row = reduced.len() * (np + 1) + i;
            a[i * m + row] = slope;
            a[np * m + row] = -g;
        }
        qr::triangle(&mut a, m, np + 1)
    }

    /// The step of at most `radius` in the scaled parameters, and its damping (Moré 1978).
    fn step_within(
        &self,
        global: &[f64],
        sizes: &[f64],
        radius: f64,
        parameters: &[f64],
    ) -> Option<(Vec<f64>, f64)> {
        let length = |step: &[f64]| step.iter().zip(sizes).map(|(d, size)| d * d * size).sum::<f64>().sqrt();
        let within = |lambda: f64, least: f64| {
            let step = self.step(global, sizes, lambda, parameters)?;
            let found = length(&step);
            (found <= 1.1 * radius).then_some((found >= least, step))
        };
        if let Some((_, step)) = within(LEAST_DAMPING, 0.0) {
            return Some((step, 0.0));
        }
        let (mut low, mut high) = (LEAST_DAMPING.ln(), MOST_DAMPING.ln());
        let mut best = None;
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            let Some((near, step)) = within(middle.exp(), 0.9 * radius) else {
                low = middle;
                continue;
            };
            best = Some((step, middle.exp()));
            if near {
                break;
            }
            high = middle;
        }
        best
    }

    /// Damped step from the global triangle; parameters at a bound that push outward stay.
    fn step(&self, global: &[f64], sizes: &[f64], lambda: f64, parameters: &[f64]) -> Option<Vec<f64>> {
        let np = sizes.len();
        if np == 0 {
            return Some(Vec::new());
        }
        let stride = np + 1;
        let mut held = vec![false; np];
        for _ in 0..=np {
            let m = 2 * np;
            let mut a = vec![0.0; m * stride];
            for j in 0..np {
                if held[j] {
                    // A column of its own row only: the step is zero.
                    a[j * m + np + j] = 1.0;
                    continue;
                }
                for i in 0..=j {
                    a[j * m + i] = global[i * stride + j];
                }
                a[j * m + np + j] = (lambda * sizes[j]).sqrt().max(1e-150);
            }
            for i in 0..np {
                a[np * m + i] = global[i * stride + np];
            }
            let r = qr::triangle(&mut a, m, stride);
            let rhs: Vec<f64> = (0..np).map(|i| r[i * stride + np]).collect();
            let step = qr::back_substitute(&r, stride, np, &rhs);
            if !step.iter().all(|v| v.is_finite()) {
                return None;
            }
            let mut changed = false;
            for (j, f) in self.free.iter().enumerate() {
                let at = parameters[f.index];
                let outward = (at <= f.lower && step[j] < 0.0) || (at >= f.upper && step[j] > 0.0);
                if outward && !held[j] {
                    held[j] = true;
                    changed = true;
                }
            }
            if !changed {
                return Some(step);
            }
        }
        None
    }
}

/// Cuts `lengths[i]` samples of each piece into about `count` segments in all, none shorter than
/// `least` samples where the piece allows it, never across a piece's end.
pub fn segments(lengths: &[usize], count: usize, least: usize) -> Vec<Segment> {
    let total: usize = lengths.iter().sum();
    let mut out = Vec::new();
    for (piece, &n) in lengths.iter().enumerate() {
        if n < 2 {
            continue;
        }
        let share = (count as f64 * n as f64 / total as f64).round() as usize;
        let parts = share.clamp(1, (n / least.max(1)).max(1));
        for i in 0..parts {
            let (a, b) = (i * n / parts, (i + 1) * n / parts);
            out.push(Segment { piece, range: a..b });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_tile_every_piece_and_respect_the_least_length() {
        let s = segments(&[1000, 500, 30], 15, 40);
        let mut next = [0; 3];
        for seg in &s {
            assert_eq!(seg.range.start, next[seg.piece]);
            next[seg.piece] = seg.range.end;
            assert!(seg.range.len() >= 30);
        }
        assert_eq!(next, [1000, 500, 30]);
        assert_eq!(s.len(), 10 + 5 + 1);
        assert!(segments(&[100], 60, 40).len() == 2);
    }
}
