//! The states of the machine as model and measurements together tell them: an extended Kalman filter and a
//! Rauch–Tung–Striebel smoother over the model with one unknown force per equation,
//!
//! ```text
//! x(k+1) = F(x(k), u) + Γ d(k),    d(k+1) = d(k) + w(k),    y(k) = h(x(k)) + e(k)
//! ```
//!
//! w white with variance q f² per sample (f the size of the equation's own forces), e white with the
//! channel's noise. It is the extended-state observer of the thesis (its chapter 2) run forwards and
//! backwards with gains that follow from the noise. F, Γ and h are linearised by the sensitivities of one
//! simulated sample each, so sticking, stops and mass matrices are those of the simulator. q is chosen by
//! the likelihood of the innovations.
//!
//! Where the smoothing of a single channel knows nothing of the machine, this knows its inertia: velocities
//! survive coarse sampling and noise, states without a sensor exist, and d(t) is the force that the
//! equations lack (Rauch, Tung & Striebel, AIAA J. 3(8), 1965).

use greybox_calibrate::{Setup, qr, spread};
use greybox_simulate::{Seeds, SignalLanes, Simulation};
use rayon::prelude::*;

/// Samples smoothed in one go, and how many more on either side settle it.
const CHUNK: usize = 1500;
const MARGIN: usize = 80;
/// Intensities of the unknown force that are tried, as powers of ten of its variance per sample over the
/// square of the equation's forces.
const INTENSITIES: [f64; 6] = [-7.0, -5.5, -4.0, -3.0, -2.0, -1.0];
/// Samples of a chunk, and chunks, that choose the intensity.
const TRIED: usize = 400;
const CHOOSING: usize = 12;

/// Smoothed states and forces.
#[derive(Debug, Clone)]
pub struct Smoothed {
    /// `states[piece][entry][sample]`.
    pub states: Vec<Vec<Vec<f64>>>,
    /// `forces[piece][equation][sample]`: what is missing on the left side of each equation, with the
    /// sign of a force that the model leaves out.
    pub forces: Vec<Vec<Vec<f64>>>,
}

/// What the smoother takes for granted.
#[derive(Debug, Clone)]
pub struct Assumptions<'a> {
    /// Parameters of the model.
    pub parameters: &'a [f64],
    /// Noise per channel, SI.
    pub noise: &'a [f64],
    /// Size of each equation's forces; zero forbids an unknown force there.
    pub force: &'a [f64],
    /// Per piece and entry, a first idea of the states and how far it may be off (infinite: unknown).
    pub first: &'a [Vec<Vec<f64>>],
    /// Standard deviation of the first idea, per entry.
    pub tolerance: &'a [f64],
}

/// Smooths every piece.
pub fn smooth(setup: &Setup, given: &Assumptions<'_>) -> Smoothed {
    let pieces = &setup.data.pieces;
    let chunks: Vec<(usize, std::ops::Range<usize>)> = pieces
        .iter()
        .enumerate()
        .flat_map(|(p, piece)| {
            let parts = piece.len.div_ceil(CHUNK).max(1);
            (0..parts).map(move |i| (p, i * piece.len / parts..(i + 1) * piece.len / parts))
        })
        .collect();
    // The intensity that makes the innovations likeliest, on the head of every chunk or of some spread evenly.
    let step = chunks.len().div_ceil(CHOOSING).max(1);
    let choosing: Vec<_> = chunks.iter().step_by(step).collect();
    let likelihood = |power: f64| -> f64 {
        let parts: Vec<f64> = choosing
            .par_iter()
            .map(|(p, range)| {
                let head = range.start..range.end.min(range.start + TRIED);
                Filter::new(setup, given, *p, power).forward(head).1
            })
            .collect();
        parts.iter().sum()
    };
    let scored: Vec<f64> = INTENSITIES.iter().map(|q| likelihood(*q)).collect();
    let best =
        (0..scored.len()).filter(|&i| scored[i].is_finite()).max_by(|&a, &b| scored[a].total_cmp(&scored[b]));
    let power = INTENSITIES[best.unwrap_or(2)];
    let done: Vec<Vec<Vec<f64>>> = chunks
        .par_iter()
        .map(|(p, range)| {
            let n = pieces[*p].len;
            let wide = range.start.saturating_sub(MARGIN)..(range.end + MARGIN).min(n);
            let filter = Filter::new(setup, given, *p, power);
            let (steps, _) = filter.forward(wide.clone());
            let smoothed = filter.backward(steps);
            smoothed[range.start - wide.start..range.end - wide.start].to_vec()
        })
        .collect();
    let (nx, nz) = (setup.system.nx, setup.system.nz);
    let mut out = Smoothed {
        states: pieces.iter().map(|p| vec![vec![0.0; p.len]; nx]).collect(),
        forces: pieces.iter().map(|p| vec![vec![0.0; p.len]; nz]).collect(),
    };
    for ((p, range), rows) in chunks.iter().zip(done) {
        for (k, row) in range.clone().zip(rows) {
            for i in 0..nx {
                let v = row[i];
                out.states[*p][i][k] = if v.is_finite() { v } else { given.first[*p][i][k] };
            }
            for e in 0..nz {
                let v = row[nx + e];
                out.forces[*p][e][k] = if v.is_finite() { v } else { 0.0 };
            }
        }
    }
    out
}

/// One sample of the filter, for the way back.
struct Step {
    /// Filtered state and covariance.
    x: Vec<f64>,
    p: Vec<f64>,
    /// Predicted state and covariance of the next sample, and the transition to it.
    next: Vec<f64>,
    p_next: Vec<f64>,
    phi: Vec<f64>,
}

struct Filter<'a> {
    setup: &'a Setup,
    given: &'a Assumptions<'a>,
    piece: usize,
    /// Variance of the unknown forces' steps.
    q: Vec<f64>,
    seeds: Seeds,
}

impl<'a> Filter<'a> {
    fn new(setup: &'a Setup, given: &'a Assumptions<'a>, piece: usize, power: f64) -> Filter<'a> {
        let (nx, nz) = (setup.system.nx, setup.system.nz);
        let len = setup.data.pieces[piece].len;
        let mut weights = vec![0.0; nz * nz];
        for e in 0..nz {
            weights[e * nz + e] = 1.0;
        }
        let signals =
            SignalLanes { lanes: nz, weights, force: vec![1.0; len * nz], ..SignalLanes::default() };
        Filter {
            setup,
            given,
            piece,
            q: given.force.iter().map(|f| 10f64.powf(power) * f * f).collect(),
            seeds: Seeds { parameters: Vec::new(), initial: (0..nx).collect(), signals: signals.into() },
        }
    }

    /// The filter over `range`: its steps, and the log-likelihood of the innovations.
    fn forward(&self, range: std::ops::Range<usize>) -> (Vec<Step>, f64) {
        let system = &self.setup.system;
        let (nx, nz, ny) = (system.nx, system.nz, system.ny);
        let n = nx + nz;
        let lanes = nx + nz;
        let simulation = Simulation {
            system,
            environment: &self.setup.environments[self.piece],
            parameters: self.given.parameters,
            method: self.setup.method,
            seeds: &self.seeds,
        };
        let first = &self.given.first[self.piece];
        let mut x: Vec<f64> =
            (0..nx).map(|i| first[i][range.start]).chain(std::iter::repeat_n(0.0, nz)).collect();
        let mut p = vec![0.0; n * n];
        let mut scratch = vec![0.0; n * n];
        for i in 0..n {
            let std = if i < nx {
                let t = self.given.tolerance[i];
                if t.is_finite() { t } else { 3.0 * spread(&first[i]).max(1e-9) }
            } else {
                0.3 * self.given.force[i - nx]
            };
            p[i * n + i] = std * std;
        }
        let measured = &self.setup.data.pieces[self.piece].measured;
        let mut likelihood = 0.0;
        let mut steps = Vec::with_capacity(range.len());
        let mut carry = None;
        for k in range {
            let (here, next) = simulation.run_on(&x[..nx], k..k + 1, carry.as_ref(), &[]);
            // Updates, channel by channel (their errors are independent).
            for c in 0..ny {
                let y = measured[c][k];
                let predicted = here.y[c];
                if y.is_nan() || !predicted.is_finite() {
                    continue;
                }
                // Output sensitivities at the predicted state; earlier channels have moved it a little.
                let h: Vec<f64> = (0..nx).map(|i| here.dy[i * ny + c]).collect();
                let moved: f64 = (0..nx).map(|i| h[i] * (x[i] - here.x[i])).sum();
                let ph: Vec<f64> =
                    (0..n).map(|i| (0..nx).map(|j| p[i * n + j] * h[j]).sum::<f64>()).collect();
                let s = self.given.noise[c].powi(2) + (0..nx).map(|i| h[i] * ph[i]).sum::<f64>();
                let e = y - predicted - moved;
                if !(s > 0.0 && s.is_finite() && e.is_finite()) {
                    continue;
                }
                likelihood -= 0.5 * (e * e / s + s.ln());
                for i in 0..n {
                    x[i] += ph[i] * e / s;
                    for j in 0..n {
                        p[i * n + j] -= ph[i] * ph[j] / s;
                    }
                }
            }
            // Prediction: linear about the state before the update.
            let dx = next.tangents();
            let mut phi = vec![0.0; n * n];
            for i in 0..nx {
                for j in 0..nx {
                    phi[i * n + j] = dx[i * lanes + j];
                }
                for e in 0..nz {
                    phi[i * n + nx + e] = dx[i * lanes + nx + e];
                }
            }
            for e in 0..nz {
                phi[(nx + e) * n + nx + e] = 1.0;
            }
            let mut ahead = vec![0.0; n];
            for i in 0..nx {
                let from_states: f64 = (0..nx).map(|j| phi[i * n + j] * (x[j] - here.x[j])).sum();
                let from_forces: f64 = (0..nz).map(|e| phi[i * n + nx + e] * x[nx + e]).sum();
                ahead[i] = next.state()[i] + from_states + from_forces;
            }
            ahead[nx..].copy_from_slice(&x[nx..]);
            let mut p_next = p.clone();
            qr::sandwich(&phi, &mut p_next, &mut scratch, n);
            for e in 0..nz {
                p_next[(nx + e) * n + nx + e] += self.q[e];
            }
            // A trace of noise on the states keeps the covariance regular (and admits what the
            // linearisation neglects).
            for i in 0..nx {
                p_next[i * n + i] *= 1.0 + 1e-9;
            }
            let filtered = std::mem::replace(&mut x, ahead.clone());
            let covariance = std::mem::replace(&mut p, p_next.clone());
            steps.push(Step { x: filtered, p: covariance, next: ahead, p_next, phi });
            carry = Some(next);
            if !x.iter().all(|v| v.is_finite()) {
                // Lost: start again from what the channels say.
                for i in 0..nx {
                    x[i] = first[i][(k + 1).min(first[i].len() - 1)];
                }
                x[nx..].fill(0.0);
                carry = None;
            }
        }
        (steps, likelihood)
    }

    /// x̂(k|N) = x̂(k) + C (x̂(k+1|N) − x̂(k+1|k)),  C = P Φᵀ P⁻(k+1)⁻¹.
    fn backward(&self, steps: Vec<Step>) -> Vec<Vec<f64>> {
        let n = self.setup.system.nx + self.setup.system.nz;
        let mut out = vec![Vec::new(); steps.len()];
        let mut later: Option<Vec<f64>> = None;
        for (k, step) in steps.into_iter().enumerate().rev() {
            let smoothed = match &later {
                None => step.x.clone(),
                Some(later) => {
                    let difference: Vec<f64> = later.iter().zip(&step.next).map(|(a, b)| a - b).collect();
                    match solve_scaled(&step.p_next, &difference, n) {
                        None => step.x.clone(),
                        Some(v) => {
                            let back: Vec<f64> =
                                (0..n).map(|j| (0..n).map(|i| step.phi[i * n + j] * v[i]).sum()).collect();
                            (0..n)
                                .map(|i| step.x[i] + (0..n).map(|j| step.p[i * n + j] * back[j]).sum::<f64>())
                                .collect()
                        }
                    }
                }
            };
            if smoothed.iter().all(|v| v.is_finite()) {
                later = Some(smoothed.clone());
                out[k] = smoothed;
            } else {
                out[k] = step.x;
                later = None;
            }
        }
        out
    }
}

/// Solves P v = b with P scaled to unit diagonal; `None` when it is not positive definite.
fn solve_scaled(p: &[f64], b: &[f64], n: usize) -> Option<Vec<f64>> {
    let d: Vec<f64> = (0..n).map(|i| if p[i * n + i] > 0.0 { p[i * n + i].sqrt() } else { 1.0 }).collect();
    let mut l = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..=i {
            let mut sum = p[i * n + j] / (d[i] * d[j]);
            if i == j {
                sum += if p[i * n + i] > 0.0 { 1e-12 } else { 1.0 };
            }
            for k in 0..j {
                sum -= l[i * n + k] * l[j * n + k];
            }
            if i == j {
                if sum <= 0.0 || sum.is_nan() {
                    return None;
                }
                l[i * n + i] = sum.sqrt();
            } else {
                l[i * n + j] = sum / l[j * n + j];
            }
        }
    }
    let mut x: Vec<f64> = b.iter().zip(&d).map(|(b, d)| b / d).collect();
    for i in 0..n {
        let s: f64 = (0..i).map(|j| l[i * n + j] * x[j]).sum();
        x[i] = (x[i] - s) / l[i * n + i];
    }
    for i in (0..n).rev() {
        let s: f64 = (i + 1..n).map(|j| l[j * n + i] * x[j]).sum();
        x[i] = (x[i] - s) / l[i * n + i];
    }
    Some(x.iter().zip(&d).map(|(x, d)| x / d).collect())
}
