//! Steps across several samples.
//!
//! Logs are often taken far faster than the machine moves. A step of the classical method then goes across N sample
//! intervals, up to the next sample whose number is a multiple of N, and the samples within are read off the method's own
//! interpolant, with θ the part of the step that has passed:
//!
//! ```text
//! x(t + θh) = x + h Σ bᵢ(θ) kᵢ        b₁ = θ − 3θ²/2 + 2θ³/3,   b₂ = b₃ = θ² − 2θ³/3,   b₄ = −θ²/2 + 2θ³/3
//! ```
//!
//! (of the third order; Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.6). Sensitivities are
//! read off likewise, so they are the derivatives of what is recorded.
//!
//! **Inputs.** The stages would see three of the N + 1 samples of an input. Over such a step an input is therefore the
//! parabola that has its mean and its first and second moments there (its projection onto Legendre's polynomials up to the
//! second), so that whatever it drives ends the step where all samples would have taken it. Forces and the directions
//! of the sensitivities that are signals are treated alike.

use greybox_model::Hold;

use super::Core;
use super::tangent::tangents_along;

/// What sampled signals weigh in the coefficients of the parabola over so many intervals: 3 × (intervals + 1).
#[derive(Debug, Clone)]
struct Weights {
    rows: [Vec<f64>; 3],
}

impl Weights {
    /// `held`: each sample stays until the next; else the signal goes straight from one to the next.
    fn new(intervals: usize, held: bool) -> Weights {
        let n = intervals as f64;
        let xi = |i: f64| 2.0 * i / n - 1.0;
        let legendre: [fn(f64) -> f64; 3] = [|_| 1.0, |x| x, |x| 0.5 * (3.0 * x * x - 1.0)];
        // ⟨u, Pₙ⟩ (2n + 1)/2 over ξ from −1 to 1, by Simpson's rule in every interval (exact: the degree is 3 at most).
        let projection: Vec<Vec<f64>> = legendre
            .iter()
            .enumerate()
            .map(|(degree, p)| {
                let mut row = vec![0.0; intervals + 1];
                let factor = (2 * degree + 1) as f64 / n;
                for i in 0..intervals {
                    let at = i as f64;
                    let (left, middle, right) = (p(xi(at)), p(xi(at + 0.5)), p(xi(at + 1.0)));
                    if held {
                        row[i] += factor * (left + 4.0 * middle + right) / 6.0;
                    } else {
                        row[i] += factor * (left / 6.0 + middle / 3.0);
                        row[i + 1] += factor * (right / 6.0 + middle / 3.0);
                    }
                }
                row
            })
            .collect();
        let combined = |c: [f64; 3]| -> Vec<f64> {
            (0..=intervals).map(|j| (0..3).map(|d| c[d] * projection[d][j]).sum()).collect()
        };
        // In powers of the intervals that have passed.
        Weights {
            rows: [
                combined([1.0, -1.0, 1.0]),
                combined([0.0, 2.0 / n, -6.0 / n]),
                combined([0.0, 0.0, 6.0 / (n * n)]),
            ],
        }
    }

    fn of(&self, samples: &[f64]) -> [f64; 3] {
        self.rows.each_ref().map(|row| row.iter().zip(samples).map(|(w, u)| w * u).sum())
    }

    /// Coefficients of `count` signals side by side: 3 × count.
    fn of_rows(&self, table: &[f64], count: usize, out: &mut [f64]) {
        out.fill(0.0);
        for (row, out) in self.rows.iter().zip(out.chunks_exact_mut(count)) {
            for (w, samples) in row.iter().zip(table.chunks_exact(count)) {
                for (o, u) in out.iter_mut().zip(samples) {
                    *o += w * u;
                }
            }
        }
    }
}

/// Weights by the number of intervals, made when they are first needed.
#[derive(Debug, Default)]
struct Table {
    held: bool,
    known: Vec<Option<Weights>>,
}

impl Table {
    fn of(&mut self, intervals: usize) -> &Weights {
        if self.known.len() <= intervals {
            self.known.resize(intervals + 1, None);
        }
        self.known[intervals].get_or_insert_with(|| Weights::new(intervals, self.held))
    }
}

/// A state with its tangents.
#[derive(Debug, Default)]
struct State {
    x: Vec<f64>,
    dx: Vec<f64>,
}

/// The step across several samples that is being taken, if any.
#[derive(Debug, Default)]
pub(super) struct Long {
    /// Samples of a step; 1: none goes across several.
    pub(super) samples: usize,
    /// Whether one is being taken.
    pub(super) active: bool,
    /// The sample at which it began, that at which it ends, and the next one to record.
    first: usize,
    last: usize,
    pub(super) next: usize,
    /// The first sample of what is recorded.
    pub(super) from: usize,
    held: Table,
    linear: Table,
    /// Forces of the environment, and directions that are signals, each as coefficients of parabolas.
    forces: Vec<[f64; 3]>,
    lane_force: Vec<f64>,
    lane_inputs: Vec<Vec<f64>>,
    /// Tangents of the state where the step began, and the state at a sample within it.
    start: Vec<f64>,
    at: State,
}

impl Long {
    pub(super) fn new(samples: usize) -> Long {
        let held = Table { held: true, ..Table::default() };
        Long { samples: samples.max(1), held, ..Long::default() }
    }

    /// Intervals since the step began.
    fn passed(&self, s: f64, dt: f64) -> f64 {
        s / dt - self.first as f64
    }

    /// The i-th force of the environment at `s`.
    pub(super) fn force(&self, i: usize, s: f64, dt: f64) -> f64 {
        let [a, b, c] = self.forces[i];
        let t = self.passed(s, dt);
        a + t * (b + t * c)
    }

    /// Takes the lanes' forces at `s`, each by its weight, off `row`.
    pub(super) fn take_lane_forces(&self, weights: &[f64], s: f64, dt: f64, row: &mut [f64]) {
        let t = self.passed(s, dt);
        for (l, (r, weight)) in row.iter_mut().zip(weights).enumerate() {
            *r -= weight * parabola(&self.lane_force, weights.len(), l, t);
        }
    }

    /// The lanes' changes of the i-th input that changes, at `s`.
    pub(super) fn lane_input(&self, i: usize, s: f64, dt: f64, row: &mut [f64]) {
        let (t, count) = (self.passed(s, dt), row.len());
        for (l, r) in row.iter_mut().enumerate() {
            *r = parabola(&self.lane_inputs[i], count, l, t);
        }
    }
}

/// Parabola `l` of `count` side by side.
fn parabola(c: &[f64], count: usize, l: usize, t: f64) -> f64 {
    c[l] + t * (c[count + l] + t * c[2 * count + l])
}

/// The interpolant's weights where the part θ of the step has passed.
fn weights(theta: f64) -> [f64; 4] {
    let (two, three) = (theta * theta, theta * theta * theta);
    let middle = two - 2.0 / 3.0 * three;
    [theta - 1.5 * two + 2.0 / 3.0 * three, middle, middle, 2.0 / 3.0 * three - 0.5 * two]
}

impl Core<'_> {
    /// From sample `from` to sample `to` in one step, where no branch is left in between.
    pub(super) fn cross_samples(&mut self, from: usize, to: usize) {
        self.events_here = 0;
        self.trials_here = 0;
        self.fresh = false;
        self.lay_out_signals(from, to);
        (self.long.first, self.long.last, self.long.next) = (from, to, from + 1);
        self.long.active = true;
        self.advance(to as f64 * self.env.dt, true);
        self.long.active = false;
        // The signals are again what they are between two samples.
        self.mid = f64::NAN;
    }

    /// The parabolas of all signals between two samples.
    fn lay_out_signals(&mut self, from: usize, to: usize) {
        let (env, seeds, long) = (self.env, self.seeds, &mut self.long);
        let intervals = to - from;
        for (piece, input) in self.pieces.iter_mut().zip(&env.inputs) {
            let table = if input.hold() == Hold::Zero { &mut long.held } else { &mut long.linear };
            *piece = input.parabola(from, intervals, |samples| table.of(samples.len() - 1).of(samples));
        }
        let weights = long.linear.of(intervals);
        long.forces.clear();
        long.forces.extend(env.forces.iter().map(|force| weights.of(&force.samples[from..=to])));
        let signals = &seeds.signals;
        let count = signals.lanes;
        let first = signals.row(from);
        let rows = first * count..(first + intervals + 1) * count;
        if !signals.force.is_empty() {
            long.lane_force.resize(3 * count, 0.0);
            weights.of_rows(&signals.force[rows.clone()], count, &mut long.lane_force);
        }
        long.lane_inputs.resize(signals.inputs.len(), Vec::new());
        for ((_, change), out) in signals.inputs.iter().zip(&mut long.lane_inputs) {
            out.resize(3 * count, 0.0);
            weights.of_rows(&change[rows.clone()], count, out);
        }
    }

    /// Keeps what [`record_within`](Self::record_within) needs of the start of a step.
    pub(super) fn keep_start(&mut self) {
        if self.long.active && self.lanes > 0 {
            self.long.start.clear();
            self.long.start.extend_from_slice(&self.d[self.at_dx..self.at_dk]);
        }
    }

    /// Records the samples within the step of length `h` that was just accepted: the state is at its end, `x1` at its
    /// start.
    pub(super) fn record_within(&mut self, h: f64) {
        if !self.long.active {
            return;
        }
        let (end, dt) = (self.s, self.env.dt);
        let mut at = std::mem::take(&mut self.long.at);
        at.x.resize(self.x.len(), 0.0);
        at.dx.resize(self.at_dk - self.at_dx, 0.0);
        // (The sample at the end is recorded by what follows the step.)
        while self.long.next < self.long.last && self.long.next as f64 * dt <= end {
            let s = self.long.next as f64 * dt;
            let b = weights(((s - (end - h)) / h).clamp(0.0, 1.0));
            self.rates.along(&mut at.x, &self.x1, &b, h);
            if self.lanes > 0 {
                tangents_along(&mut at.dx, &self.long.start, &self.d[self.at_dk..], &b, h);
            }
            self.exchange(&mut at);
            self.s = s;
            self.record(self.long.next - self.long.from);
            self.exchange(&mut at);
            self.long.next += 1;
        }
        self.s = end;
        self.long.at = at;
    }

    fn exchange(&mut self, at: &mut State) {
        std::mem::swap(&mut self.x, &mut at.x);
        self.d[self.at_dx..self.at_dk].swap_with_slice(&mut at.dx);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A parabola through an input's samples would be one of three; this one has the moments of all.
    #[test]
    fn a_parabola_has_the_moments_of_the_signal() {
        let u: Vec<f64> = (0..=8).map(|i| (1.7 * f64::from(i)).sin() + 0.2 * f64::from(i)).collect();
        for held in [false, true] {
            for intervals in [1usize, 2, 3, 8] {
                let [a, b, c] = Weights::new(intervals, held).of(&u[..=intervals]);
                for power in 0..3 {
                    // Midpoints of 4000 parts of an interval.
                    let parts = 4000;
                    let n = intervals * parts;
                    let integral = |f: &dyn Fn(f64) -> f64| -> f64 {
                        (0..n)
                            .map(|i| (i as f64 + 0.5) / f64::from(4000))
                            .map(|t| f(t) * t.powi(power))
                            .sum::<f64>()
                            / f64::from(4000)
                    };
                    let signal = |t: f64| {
                        let k = t as usize;
                        if held { u[k] } else { u[k] + (t - k as f64) * (u[k + 1] - u[k]) }
                    };
                    let (of_signal, of_parabola) = (integral(&signal), integral(&|t| a + t * (b + t * c)));
                    let size = 10.0 * (intervals as f64).powi(power + 1);
                    assert!((of_signal - of_parabola).abs() < 1e-7 * size, "{held} {intervals} {power}");
                }
            }
        }
    }

    #[test]
    fn the_interpolant_ends_in_the_step_and_is_right_for_cubics() {
        let ends = weights(1.0);
        for (w, b) in ends.iter().zip([1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0]) {
            assert!((w - b).abs() < 1e-15);
        }
        // ẋ = 3t²: the stages see 0, 3/4, 3/4, 3.
        let at =
            |theta: f64| weights(theta).iter().zip([0.0, 0.75, 0.75, 3.0]).map(|(w, k)| w * k).sum::<f64>();
        for theta in [0.1, 0.5, 0.9] {
            assert!((at(theta) - theta * theta * theta).abs() < 1e-15);
        }
    }
}
