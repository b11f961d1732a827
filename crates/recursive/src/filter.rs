//! The recursive prediction-error method: a Kalman filter of the state with the sensitivities of what it predicts.

use alloc::vec;
use alloc::vec::Vec;

use crate::error::RecursiveError;
use crate::triangle::absorb;

/// A state filter and how its state depends on parameters.
///
/// ```text
/// predict:   x̂ ← F(x̂, θ)      W ← F_x W + F_θ         S Sᵀ ← (F_x S Sᵀ F_xᵀ)/λ + Q
/// correct:   e = y − h(x̂, θ)   ψ = h_x W + h_θ          s = h_x S Sᵀ h_xᵀ + r²
///            x̂ ← x̂ + k e       W ← W − k ψ              k = S Sᵀ h_xᵀ / s
/// ```
///
/// e is the innovation and −ψ its derivative by the parameters: rows of a regression of e/√s on ψ/√s. Where F and h are
/// linear in x and θ, recursive least squares of these rows, with x̂ moved by W Δθ, is the Kalman filter of states and
/// parameters together (B. Friedland, *Treatment of bias in recursive filtering*, IEEE Trans. Autom. Control 14, 1969);
/// elsewhere it is the recursive prediction-error method, but for the gain's own dependence on θ (L. Ljung, T. Söderström,
/// *Theory and Practice of Recursive Identification*, 1983, §3.8). λ < 1 gives the filter a fading memory (B. D. O. Anderson,
/// *Exponential data weighting in the Kalman–Bucy filter*, Inf. Sci. 5, 1973).
///
/// S is kept as a square root: rotations predict it, Potter's update corrects it (Bierman 1977, §II).
///
/// Shapes: n states, p parameters; matrices row by row; units are the caller's.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Filter {
    n: usize,
    p: usize,
    state: Vec<f64>,
    /// W, n × p.
    sensitivity: Vec<f64>,
    /// U = Sᵀ, n × n.
    root: Vec<f64>,
    next: Vec<f64>,
    wide: Vec<f64>,
    row: Vec<f64>,
    gain: Vec<f64>,
    psi: Vec<f64>,
}

/// What a model predicts from one sample to the next.
#[derive(Debug, Clone, Copy)]
pub struct Predicted<'a> {
    /// The state there, n.
    pub state: &'a [f64],
    /// Its derivative by the state before, n × n.
    pub by_state: &'a [f64],
    /// Its derivative by the parameters, n × p.
    pub by_parameters: &'a [f64],
    /// Standard deviation of what disturbed each entry on the way, n.
    pub noise: &'a [f64],
    /// λ: weight of what is known so far, in (0, 1].
    pub memory: f64,
}

/// One measured value and what a model says of it at the predicted state.
#[derive(Debug, Clone, Copy)]
pub struct Measured<'a> {
    /// Measured less predicted.
    pub error: f64,
    /// Derivative of the predicted value by the state, n.
    pub by_state: &'a [f64],
    /// Its derivative by the parameters, p.
    pub by_parameters: &'a [f64],
    /// Standard deviation of the sensor's noise.
    pub noise: f64,
}

/// An innovation over its standard deviation, and its regressor.
#[derive(Debug, Clone, Copy)]
pub struct Innovation<'a> {
    /// e/√s.
    pub value: f64,
    /// ψ/√s, p.
    pub row: &'a [f64],
    /// √s, in the unit of the measured value.
    pub deviation: f64,
}

impl Filter {
    /// A filter whose state has the mean `state` and the standard deviations `deviation`, for `parameters` parameters.
    ///
    /// # Errors
    /// [`RecursiveError`] where the two differ in length, or a value is not finite or, of a deviation, negative.
    pub fn new(state: &[f64], deviation: &[f64], parameters: usize) -> Result<Filter, RecursiveError> {
        let n = state.len();
        if deviation.len() != n {
            return Err(RecursiveError::Length {
                what: "the deviations of the state",
                found: deviation.len(),
                expected: n,
            });
        }
        let mut root = vec![0.0; n * n];
        for (index, (value, deviation)) in state.iter().zip(deviation).enumerate() {
            if !value.is_finite() {
                return Err(RecursiveError::NotFinite { what: "the state", index });
            }
            if !(deviation.is_finite() && *deviation >= 0.0) {
                return Err(RecursiveError::Deviation { index, value: *deviation });
            }
            root[index * n + index] = *deviation;
        }
        Ok(Filter {
            n,
            p: parameters,
            state: state.to_vec(),
            sensitivity: vec![0.0; n * parameters],
            root,
            next: vec![0.0; n * n],
            wide: vec![0.0; n * parameters],
            row: vec![0.0; n],
            gain: vec![0.0; n],
            psi: vec![0.0; parameters],
        })
    }

    /// States and parameters, where the sizes of all parts agree: a filter that was restored from data may be anything.
    pub fn shape(&self) -> Option<(usize, usize)> {
        let (n, p) = (self.n, self.p);
        let square = n.checked_mul(n)?;
        let wide = n.checked_mul(p)?;
        let agree = [&self.state, &self.row, &self.gain].iter().all(|v| v.len() == n)
            && [&self.root, &self.next].iter().all(|v| v.len() == square)
            && [&self.sensitivity, &self.wide].iter().all(|v| v.len() == wide)
            && self.psi.len() == p;
        agree.then_some((n, p))
    }

    /// The state x̂.
    pub fn state(&self) -> &[f64] {
        &self.state
    }

    /// W: how the state depends on the parameters, n × p.
    pub fn sensitivity(&self) -> &[f64] {
        &self.sensitivity
    }

    /// √s: the standard deviation of the error of a value that is measured with these derivatives by the state and this noise. Not
    /// a number where the derivatives are not those of n entries.
    pub fn deviation_of(&self, by_state: &[f64], noise: f64) -> f64 {
        if by_state.len() != self.n {
            return f64::NAN;
        }
        let of = |row: &[f64]| row.iter().zip(by_state).map(|(u, h)| u * h).sum::<f64>();
        let known: f64 = self.root.chunks_exact(self.n.max(1)).map(|row| of(row) * of(row)).sum();
        libm::sqrt(known + noise * noise)
    }

    /// Standard deviation of each entry of the state.
    pub fn deviations(&self) -> Vec<f64> {
        let n = self.n;
        (0..n)
            .map(|i| libm::sqrt((0..n).map(|k| self.root[k * n + i] * self.root[k * n + i]).sum()))
            .collect()
    }

    /// Goes to the next sample. Slices of other lengths than the filter's, or values that are not finite, change nothing:
    /// `false`.
    pub fn predict(&mut self, to: &Predicted<'_>) -> bool {
        let (n, p) = (self.n, self.p);
        let fits = to.state.len() == n
            && to.by_state.len() == n * n
            && to.by_parameters.len() == n * p
            && to.noise.len() == n;
        let all = [to.state, to.by_state, to.by_parameters, to.noise];
        if !fits
            || to.memory.is_nan()
            || to.memory <= 0.0
            || !all.iter().all(|s| s.iter().all(|v| v.is_finite()))
        {
            return false;
        }
        self.state.copy_from_slice(to.state);
        for i in 0..n {
            let wide = &mut self.wide[i * p..(i + 1) * p];
            wide.copy_from_slice(&to.by_parameters[i * p..(i + 1) * p]);
            for k in 0..n {
                let f = to.by_state[i * n + k];
                let old = &self.sensitivity[k * p..(k + 1) * p];
                wide.iter_mut().zip(old).for_each(|(w, s)| *w += f * s);
            }
        }
        core::mem::swap(&mut self.sensitivity, &mut self.wide);
        let fading = 1.0 / libm::sqrt(to.memory);
        self.next.fill(0.0);
        for k in 0..n {
            for i in 0..n {
                let f = &to.by_state[i * n..(i + 1) * n];
                let u = &self.root[k * n..(k + 1) * n];
                self.row[i] = fading * f.iter().zip(u).map(|(f, u)| f * u).sum::<f64>();
            }
            absorb(&mut self.next, n, &mut self.row);
        }
        for k in 0..n {
            self.row.fill(0.0);
            self.row[k] = to.noise[k];
            absorb(&mut self.next, n, &mut self.row);
        }
        core::mem::swap(&mut self.root, &mut self.next);
        true
    }

    /// Corrects the state by what was measured at one sample, value after value; `learn` receives every innovation. What
    /// is not finite is passed over.
    pub fn correct<'m>(
        &mut self,
        measured: impl IntoIterator<Item = Measured<'m>>,
        mut learn: impl FnMut(usize, Innovation<'_>),
    ) {
        let (n, p) = (self.n, self.p);
        // How far the state has moved since it was predicted.
        let mut moved = core::mem::take(&mut self.next);
        moved[..n].fill(0.0);
        for (channel, m) in measured.into_iter().enumerate() {
            let rows = [m.by_state, m.by_parameters];
            let finite = m.error.is_finite() && rows.iter().all(|r| r.iter().all(|v| v.is_finite()));
            if !finite
                || m.by_state.len() != n
                || m.by_parameters.len() != p
                || m.noise.is_nan()
                || m.noise <= 0.0
            {
                continue;
            }
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let error = m.error - dot(m.by_state, &moved[..n]);
            for k in 0..n {
                self.row[k] = dot(&self.root[k * n..(k + 1) * n], m.by_state);
            }
            let s = dot(&self.row, &self.row) + m.noise * m.noise;
            let deviation = libm::sqrt(s);
            if !(deviation.is_finite() && deviation > 0.0) {
                continue;
            }
            for i in 0..n {
                self.gain[i] = (0..n).map(|k| self.root[k * n + i] * self.row[k]).sum::<f64>() / s;
            }
            for l in 0..p {
                let by_state: f64 = (0..n).map(|i| m.by_state[i] * self.sensitivity[i * p + l]).sum();
                self.psi[l] = m.by_parameters[l] + by_state;
            }
            for i in 0..n {
                moved[i] += self.gain[i] * error;
                self.state[i] += self.gain[i] * error;
                let w = &mut self.sensitivity[i * p..(i + 1) * p];
                w.iter_mut().zip(&self.psi).for_each(|(w, psi)| *w -= self.gain[i] * psi);
            }
            let gamma = 1.0 / (1.0 + m.noise / deviation);
            for k in 0..n {
                for i in 0..n {
                    self.root[k * n + i] -= gamma * self.row[k] * self.gain[i];
                }
            }
            self.psi.iter_mut().for_each(|v| *v /= deviation);
            learn(channel, Innovation { value: error / deviation, row: &self.psi, deviation });
        }
        self.next = moved;
    }

    /// Moves the state as far as parameters that move by `change` take it: x̂ ← x̂ + W Δθ.
    pub fn follow(&mut self, change: &[f64]) {
        for (x, w) in self.state.iter_mut().zip(self.sensitivity.chunks_exact(self.p.max(1))) {
            *x += w.iter().zip(change).map(|(w, d)| w * d).sum::<f64>();
        }
    }

    /// The state begins anew with this mean and these standard deviations, and depends on no parameter yet. Slices of other
    /// lengths change nothing.
    pub fn restart(&mut self, state: &[f64], deviation: &[f64]) {
        if state.len() == self.n && deviation.len() == self.n {
            self.state.copy_from_slice(state);
            self.sensitivity.fill(0.0);
            self.root.fill(0.0);
            deviation.iter().enumerate().for_each(|(i, d)| self.root[i * self.n + i] = *d);
        }
    }

    /// The state of another filter with its uncertainty, and its sensitivities by the first parameters, as many as both have;
    /// those by others begin anew.
    pub fn take_state(&mut self, from: &Filter) {
        if from.n != self.n {
            return;
        }
        self.state.copy_from_slice(&from.state);
        self.root.copy_from_slice(&from.root);
        self.sensitivity.fill(0.0);
        let (p, both) = (self.p, self.p.min(from.p));
        for i in 0..self.n {
            self.sensitivity[i * p..i * p + both]
                .copy_from_slice(&from.sensitivity[i * from.p..i * from.p + both]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LeastSquares;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// x₁' = x₂, x₂' = −4 x₁ + θ₁ + noise in discrete time; y = x₁ + θ₂: as an augmented Kalman filter of (x, θ), written out.
    #[test]
    fn with_least_squares_it_is_the_kalman_filter_of_states_and_parameters() {
        let (h, q, r) = (0.05, 0.02, 0.1f64);
        let f = [[1.0, h, 0.0, 0.0], [-4.0 * h, 1.0, h, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
        let c = [1.0, 0.0, 0.0, 1.0];
        let (start, std) = ([0.3, -0.1, 0.0, 0.0], [0.5, 0.5, 2.0, 1.0]);
        let mut x = start;
        let mut p = [[0.0; 4]; 4];
        for i in 0..4 {
            p[i][i] = std[i] * std[i];
        }
        let mut filter = Filter::new(&start[..2], &std[..2], 2).unwrap();
        let mut fit = LeastSquares::new(&start[2..], &std[2..]).unwrap();
        let mut theta = [0.0; 2];
        let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
        for k in 0..300 {
            // The dense filter.
            let old = p;
            for i in 0..4 {
                for j in 0..4 {
                    p[i][j] =
                        (0..4).map(|a| (0..4).map(|b| f[i][a] * old[a][b] * f[j][b]).sum::<f64>()).sum();
                }
            }
            p[1][1] += q * q;
            let from = x;
            (0..4).for_each(|i| x[i] = (0..4).map(|a| f[i][a] * from[a]).sum());
            let noise: f64 = StandardNormal.sample(&mut rng);
            let y = (0.1 * f64::from(k)).sin() + 0.2 * noise;
            let pc: [f64; 4] = core::array::from_fn(|i| (0..4).map(|a| p[i][a] * c[a]).sum());
            let s = (0..4).map(|i| c[i] * pc[i]).sum::<f64>() + r * r;
            let e = y - (0..4).map(|i| c[i] * x[i]).sum::<f64>();
            for i in 0..4 {
                x[i] += pc[i] / s * e;
                for j in 0..4 {
                    p[i][j] -= pc[i] * pc[j] / s;
                }
            }
            // The same in two stages.
            let state = filter.state().to_vec();
            let next = [state[0] + h * state[1], -4.0 * h * state[0] + state[1] + h * theta[0]];
            let predicted = Predicted {
                state: &next,
                by_state: &[1.0, h, -4.0 * h, 1.0],
                by_parameters: &[0.0, 0.0, h, 0.0],
                noise: &[0.0, q],
                memory: 1.0,
            };
            assert!(filter.predict(&predicted));
            let measured = Measured {
                error: y - next[0] - theta[1],
                by_state: &[1.0, 0.0],
                by_parameters: &[0.0, 1.0],
                noise: r,
            };
            filter.correct([measured], |_, i| {
                let at: f64 = i.row.iter().zip(&theta).map(|(r, t)| r * t).sum();
                assert!(fit.update(i.row, i.value + at));
            });
            let new = fit.estimate();
            filter.follow(&[new[0] - theta[0], new[1] - theta[1]]);
            theta.copy_from_slice(&new);
            let found = [filter.state()[0], filter.state()[1], theta[0], theta[1]];
            for i in 0..4 {
                assert!((found[i] - x[i]).abs() < 1e-9, "sample {k}: {found:?} {x:?}");
            }
            let std = fit.deviations();
            assert!((std[0] - p[2][2].sqrt()).abs() < 1e-9 && (std[1] - p[3][3].sqrt()).abs() < 1e-9);
        }
    }

    /// Two sensors of one sample: one after the other is both at once.
    #[test]
    fn values_of_one_sample_are_corrected_together() {
        let mut both = Filter::new(&[1.0, 2.0], &[1.0, 2.0], 0).unwrap();
        let rows = [[1.0, 0.5], [0.2, 1.0]];
        let measured = rows.iter().zip([0.3, -0.4]).zip([0.1, 0.5]).map(|((row, error), noise)| Measured {
            error,
            by_state: row,
            by_parameters: &[],
            noise,
        });
        both.correct(measured, |_, _| {});
        // (P⁻¹ + Σ hᵀh/r²) Δx = Σ hᵀ e/r²
        let (mut a, mut b) = ([[1.0, 0.0], [0.0, 0.25]], [0.0; 2]);
        for ((row, e), r) in rows.iter().zip([0.3, -0.4]).zip([0.1f64, 0.5]) {
            for i in 0..2 {
                for j in 0..2 {
                    a[i][j] += row[i] * row[j] / (r * r);
                }
                b[i] += row[i] * e / (r * r);
            }
        }
        let det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
        let step = [(a[1][1] * b[0] - a[0][1] * b[1]) / det, (a[0][0] * b[1] - a[1][0] * b[0]) / det];
        assert!((both.state()[0] - 1.0 - step[0]).abs() < 1e-12);
        assert!((both.state()[1] - 2.0 - step[1]).abs() < 1e-12);
        assert!((both.deviations()[0] - (a[1][1] / det).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_number_changes_nothing() {
        assert!(matches!(Filter::new(&[0.0], &[], 1), Err(RecursiveError::Length { .. })));
        assert!(matches!(Filter::new(&[0.0], &[-1.0], 1), Err(RecursiveError::Deviation { .. })));
        assert!(matches!(Filter::new(&[f64::NAN], &[1.0], 1), Err(RecursiveError::NotFinite { .. })));
        let mut filter = Filter::new(&[1.0], &[1.0], 1).unwrap();
        let before = filter.clone();
        let to = |state: &'static [f64]| Predicted {
            state,
            by_state: &[1.0],
            by_parameters: &[0.0],
            noise: &[0.1],
            memory: 1.0,
        };
        assert!(!filter.predict(&to(&[f64::NAN])) && !filter.predict(&to(&[1.0, 2.0])));
        let nan = Measured { error: f64::NAN, by_state: &[1.0], by_parameters: &[0.0], noise: 0.1 };
        filter.correct([nan], |_, _| panic!("learned from NaN"));
        assert_eq!(filter.state(), before.state());
        assert_eq!(filter.deviations(), before.deviations());
    }
}
