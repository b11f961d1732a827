//! How far a sampled loop is from instability, cut at the command.

use nalgebra::{Complex, DMatrix};

/// Frequencies of a scan.
const POINTS: usize = 2000;
/// The lowest of them, over the Nyquist frequency.
const LOWEST: f64 = 1e-6;
/// Halvings of an interval in which a border is crossed.
const HALVINGS: usize = 50;

/// Margins of the loop L(z) cut at the command, z = e^{jω dt}: from the crossings of its frequency response (K. J.
/// Åström and R. M. Murray, *Feedback Systems*, 2008, section 9.3). They belong to a loop that is stable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Margins {
    /// The factor by which the loop's gain may rise; infinite where no factor makes it unstable.
    pub gain: f64,
    /// The factor to which it may fall; zero where no factor makes it unstable.
    pub lower_gain: f64,
    /// The phase that the loop may lose or gain at a frequency where |L| = 1, rad; π where there is none.
    pub phase: f64,
    /// The further delay that the loop bears, s; infinite where |L| is never 1.
    pub delay: f64,
    /// The largest 1/|1 + L|: one over the distance of L from −1.
    pub sensitivity: f64,
}

impl Margins {
    /// The worse of both, margin by margin.
    #[must_use]
    pub fn worse(self, other: Margins) -> Margins {
        Margins {
            gain: self.gain.min(other.gain),
            lower_gain: self.lower_gain.max(other.lower_gain),
            phase: self.phase.min(other.phase),
            delay: self.delay.min(other.delay),
            sensitivity: self.sensitivity.max(other.sensitivity),
        }
    }
}

/// The loop as a linear system: x⁺ = A x + b v, u = c x; with v = u it is closed.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct OpenLoop {
    pub(crate) a: DMatrix<f64>,
    pub(crate) b: DMatrix<f64>,
    pub(crate) c: DMatrix<f64>,
}

impl OpenLoop {
    /// L = −c (z I − A)⁻¹ b.
    fn response(&self, z: Complex<f64>) -> Option<Complex<f64>> {
        let n = self.a.nrows();
        let m = DMatrix::from_fn(n, n, |i, j| {
            let diagonal = if i == j { z } else { Complex::new(0.0, 0.0) };
            diagonal - Complex::new(self.a[(i, j)], 0.0)
        });
        let b = self.b.map(|v| Complex::new(v, 0.0));
        let x = m.lu().solve(&b)?;
        let sum: Complex<f64> = (0..n).map(|i| x[(i, 0)] * self.c[(0, i)]).sum();
        (sum.re.is_finite() && sum.im.is_finite()).then_some(-sum)
    }

    pub(crate) fn margins(&self, dt: f64) -> Margins {
        let nyquist = std::f64::consts::PI / dt;
        let at = |omega: f64| self.response(Complex::from_polar(1.0, omega * dt));
        let omega = |k: usize| nyquist * LOWEST.powf(1.0 - k as f64 / (POINTS - 1) as f64);
        let mut margins = Margins {
            gain: f64::INFINITY,
            lower_gain: 0.0,
            phase: std::f64::consts::PI,
            delay: f64::INFINITY,
            sensitivity: 0.0,
        };
        let mut before: Option<(f64, Complex<f64>)> = None;
        for k in 0..POINTS {
            let omega = omega(k);
            let Some(l) = at(omega) else { continue };
            margins.sensitivity = margins.sensitivity.max(1.0 / (l + 1.0).norm());
            if let Some((low, l_low)) = before {
                let crossed = |value: &dyn Fn(Complex<f64>) -> f64| {
                    (value(l_low) * value(l) < 0.0).then(|| crossing((low, omega), &at, value)).flatten()
                };
                if let Some((_, l)) = crossed(&|l| l.im).filter(|(_, l)| l.re < 0.0) {
                    let factor = 1.0 / l.norm();
                    if factor >= 1.0 {
                        margins.gain = margins.gain.min(factor);
                    } else {
                        margins.lower_gain = margins.lower_gain.max(factor);
                    }
                }
                if let Some((omega, l)) = crossed(&|l| l.norm() - 1.0) {
                    let lag = (l.arg() + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU);
                    margins.phase = margins.phase.min(lag.min(std::f64::consts::TAU - lag));
                    margins.delay = margins.delay.min(lag / omega);
                }
            }
            // At the Nyquist frequency L is real: a crossing of the axis lies at the end of the scan.
            if k + 1 == POINTS && l.re < 0.0 {
                let factor = 1.0 / l.norm();
                if factor >= 1.0 {
                    margins.gain = margins.gain.min(factor);
                } else {
                    margins.lower_gain = margins.lower_gain.max(factor);
                }
            }
            before = Some((omega, l));
        }
        margins
    }
}

/// Where `value` changes sign between two frequencies.
fn crossing(
    (mut low, mut high): (f64, f64),
    at: &dyn Fn(f64) -> Option<Complex<f64>>,
    value: &dyn Fn(Complex<f64>) -> f64,
) -> Option<(f64, Complex<f64>)> {
    let rises = value(at(high)?) > 0.0;
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if (value(at(middle)?) > 0.0) == rises {
            high = middle;
        } else {
            low = middle;
        }
    }
    Some((high, at(high)?))
}

#[cfg(test)]
mod tests {
    use nalgebra::dmatrix;

    use super::*;

    /// x⁺ = x + dt v, u = −k x: L = k dt/(z − 1), in closed form. On the circle z − 1 = 2j sin(θ/2) e^{jθ/2}.
    #[test]
    fn an_integrator_has_the_margins_of_the_book() {
        let (dt, k): (f64, f64) = (0.01, 20.0);
        let open = OpenLoop { a: dmatrix![1.0], b: dmatrix![dt], c: dmatrix![-k] };
        let m = open.margins(dt);
        // |L| = 1 at 2 sin(θ/2) = k dt; the phase there is −π/2 − θ/2.
        let theta = 2.0 * (0.5 * k * dt).asin();
        let phase = 0.5 * std::f64::consts::PI - 0.5 * theta;
        assert!((m.phase - phase).abs() < 1e-9, "{m:?}");
        assert!((m.delay - phase / (theta / dt)).abs() < 1e-9);
        // At the Nyquist frequency L = −k dt/2.
        assert!((m.gain - 2.0 / (k * dt)).abs() < 1e-6 && m.lower_gain == 0.0);
        assert!((m.sensitivity - 1.0 / (1.0 - 0.5 * k * dt)).abs() < 1e-6);
    }
}
