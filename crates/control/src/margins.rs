//! How far a sampled loop is from instability, cut at the command.

use nalgebra::linalg::balancing::balance_parlett_reinsch;
use nalgebra::{Complex, DMatrix};

use crate::check::largest;
use crate::stability;

/// Frequencies of a scan.
const POINTS: usize = 2000;
/// The lowest of them, over the Nyquist frequency.
const LOWEST: f64 = 1e-6;
/// Halvings of an interval in which a border is crossed.
const HALVINGS: usize = 50;
/// Relative difference of L(1) and L at the lowest frequency up to which L(1) is a crossing: with an integrator in the loop
/// there is none.
const SETTLED: f64 = 1e-3;

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
    /// What a loop has that is unstable already: nothing to spare.
    pub const NONE: Margins =
        Margins { gain: 1.0, lower_gain: 1.0, phase: 0.0, delay: 0.0, sensitivity: f64::INFINITY };

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
    /// The largest magnitude of the poles of the closed loop, A + b c; none where a number is not finite. `sizes` are
    /// those of the states.
    pub(crate) fn radius(&self, sizes: &[f64]) -> Option<f64> {
        Some(largest(&stability::poles(&(&self.a + &self.b * &self.c), sizes)?))
    }

    /// The same loop in states in which A is an upper Hessenberg matrix, balanced first, so that units play no part.
    /// A response then takes n² operations instead of n³ (A. J. Laub, IEEE Trans. Autom. Control 26(2), 1981).
    fn reduced(&self) -> OpenLoop {
        let mut a = self.a.clone();
        if a.is_empty() || !a.iter().all(|v| v.is_finite()) {
            return self.clone();
        }
        let scale = balance_parlett_reinsch(&mut a);
        let b = DMatrix::from_fn(a.nrows(), 1, |i, _| self.b[(i, 0)] / scale[i]);
        let c = DMatrix::from_fn(1, a.nrows(), |_, j| self.c[(0, j)] * scale[j]);
        let (q, h) = a.hessenberg().unpack();
        OpenLoop { a: h, b: q.transpose() * b, c: c * q }
    }

    /// L = −c (z I − A)⁻¹ b of a [reduced](Self::reduced) loop, by elimination between neighbouring rows.
    fn response(&self, z: Complex<f64>) -> Option<Complex<f64>> {
        let n = self.a.nrows();
        let mut rows: Vec<Complex<f64>> = Vec::with_capacity(n * n);
        for i in 0..n {
            rows.extend((0..n).map(|j| {
                let diagonal = if i == j { z } else { Complex::new(0.0, 0.0) };
                diagonal - self.a[(i, j)]
            }));
        }
        let mut x: Vec<Complex<f64>> = self.b.iter().map(|b| Complex::new(*b, 0.0)).collect();
        for i in 1..n {
            let (above, below) = rows.split_at_mut(i * n);
            let (upper, lower) = (&mut above[(i - 1) * n..], &mut below[..n]);
            if lower[i - 1].norm_sqr() > upper[i - 1].norm_sqr() {
                upper.swap_with_slice(lower);
                x.swap(i - 1, i);
            }
            let factor = lower[i - 1] / upper[i - 1];
            for (l, u) in lower[i..].iter_mut().zip(&upper[i..]) {
                *l -= factor * u;
            }
            x[i] = x[i] - factor * x[i - 1];
        }
        let mut sum = Complex::new(0.0, 0.0);
        for i in (0..n).rev() {
            let known: Complex<f64> = (i + 1..n).map(|j| rows[i * n + j] * x[j]).sum();
            x[i] = (x[i] - known) / rows[i * n + i];
            sum += x[i] * self.c[(0, i)];
        }
        (sum.re.is_finite() && sum.im.is_finite()).then_some(-sum)
    }

    /// [`Margins::NONE`] where the closed loop, with a further delay of `late` seconds, is unstable; none where a number is
    /// not finite.
    pub(crate) fn margins_if_stable(&self, sizes: &[f64], dt: f64, late: f64) -> Option<Margins> {
        if self.radius(sizes)? >= 1.0 {
            return Some(Margins::NONE);
        }
        let without = self.margins(dt, 0.0);
        Some(match late {
            0.0 => without,
            late if late < without.delay => self.margins(dt, late),
            _ => Margins::NONE,
        })
    }

    /// Of L(e^{jω dt}) e^{−jω `late`}.
    pub(crate) fn margins(&self, dt: f64, late: f64) -> Margins {
        let nyquist = std::f64::consts::PI / dt;
        let reduced = self.reduced();
        let at = |omega: f64| {
            let own = reduced.response(Complex::from_polar(1.0, omega * dt))?;
            Some(own * Complex::from_polar(1.0, -omega * late))
        };
        let omega = |k: usize| nyquist * LOWEST.powf(1.0 - k as f64 / (POINTS - 1) as f64);
        let mut margins = Margins {
            gain: f64::INFINITY,
            lower_gain: 0.0,
            phase: std::f64::consts::PI,
            delay: f64::INFINITY,
            sensitivity: 0.0,
        };
        let cross = |margins: &mut Margins, l: Complex<f64>| {
            let factor = 1.0 / l.norm();
            if factor >= 1.0 {
                margins.gain = margins.gain.min(factor);
            } else {
                margins.lower_gain = margins.lower_gain.max(factor);
            }
        };
        // At z = 1 L is real: where the plant alone is unstable, less gain may cross there.
        if let (Some(still), Some(low)) = (at(0.0), at(omega(0)))
            && still.re < 0.0
            && (still - low).norm() <= SETTLED * low.norm()
        {
            cross(&mut margins, still);
            margins.sensitivity = 1.0 / (still + 1.0).norm();
        }
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
                    cross(&mut margins, l);
                }
                if let Some((omega, l)) = crossed(&|l| l.norm() - 1.0) {
                    let lag = (l.arg() + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU);
                    margins.phase = margins.phase.min(lag.min(std::f64::consts::TAU - lag));
                    margins.delay = margins.delay.min(lag / omega);
                }
            }
            // At the Nyquist frequency L is real, but for a delay: a crossing of the axis lies at the end of the scan.
            if k + 1 == POINTS && l.re < 0.0 && late == 0.0 {
                cross(&mut margins, l);
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
        let m = open.margins(dt, 0.0);
        // |L| = 1 at 2 sin(θ/2) = k dt; the phase there is −π/2 − θ/2.
        let theta = 2.0 * (0.5 * k * dt).asin();
        let phase = 0.5 * std::f64::consts::PI - 0.5 * theta;
        assert!((m.phase - phase).abs() < 1e-9, "{m:?}");
        assert!((m.delay - phase / (theta / dt)).abs() < 1e-9);
        // At the Nyquist frequency L = −k dt/2.
        assert!((m.gain - 2.0 / (k * dt)).abs() < 1e-6 && m.lower_gain == 0.0);
        assert!((m.sensitivity - 1.0 / (1.0 - 0.5 * k * dt)).abs() < 1e-6);
    }

    /// A further delay takes its phase, and its time off the delay margin; beyond that the loop is unstable.
    #[test]
    fn a_further_delay_takes_its_part_of_the_margins() {
        let (dt, k): (f64, f64) = (0.01, 20.0);
        let open = OpenLoop { a: dmatrix![1.0], b: dmatrix![dt], c: dmatrix![-k] };
        let (own, late) = (open.margins(dt, 0.0), open.margins_if_stable(&[1.0], dt, 0.02).unwrap());
        assert!((own.delay - late.delay - 0.02).abs() < 1e-9, "{own:?} {late:?}");
        // |L| = 1 at the frequency where it was.
        let omega = own.phase / own.delay;
        assert!((own.phase - late.phase - 0.02 * omega).abs() < 1e-9);
        assert!(late.gain < own.gain);
        let beyond = open.margins_if_stable(&[1.0], dt, 1.001 * own.delay).unwrap();
        assert_eq!(beyond, Margins::NONE);
        // The same delay in whole samples, as states.
        let two = dmatrix![1.0, 0.0, dt; 0.0, 0.0, 0.0; 0.0, 1.0, 0.0];
        let states = OpenLoop { a: two, b: dmatrix![0.0; 1.0; 0.0], c: dmatrix![-k, 0.0, 0.0] };
        let states = states.margins(dt, 0.0);
        assert!((states.phase - late.phase).abs() < 1e-6 && (states.gain / late.gain - 1.0).abs() < 1e-6);
    }

    /// x′ − x = u, u = −k x: without feedback enough it runs away. L(1) = −k, whatever the sample time.
    #[test]
    fn an_unstable_plant_needs_a_least_gain() {
        let (dt, k): (f64, f64) = (0.01, 2.5);
        let open = OpenLoop { a: dmatrix![dt.exp()], b: dmatrix![dt.exp() - 1.0], c: dmatrix![-k] };
        let m = open.margins(dt, 0.0);
        assert!((m.lower_gain - 0.4).abs() < 1e-9, "{m:?}");
        assert!((0.9..1.1).contains(&m.sensitivity) && m.gain > 50.0);
        let least = |factor: f64| OpenLoop { c: &open.c * factor, ..open.clone() }.radius(&[1.0]).unwrap();
        assert!(least(0.41) < 1.0 && least(0.39) > 1.0);
    }

    /// A loop in badly chosen units, with a late command (a subdiagonal of ones): its response is that of the plain solve.
    #[test]
    fn the_reduced_loop_has_the_response_of_the_loop() {
        let a = dmatrix![
            0.9, 2e-6, 0.0, 3e-4, 0.0;
            -4e3, 0.8, 1e2, 0.0, 7.0;
            0.3, 1e-5, 0.5, 0.2, 1e-3;
            0.0, 0.0, 0.0, 0.0, 0.0;
            0.0, 0.0, 0.0, 1.0, 0.0
        ];
        let open =
            OpenLoop { a, b: dmatrix![1e-4; 2.0; 0.0; 1.0; 0.0], c: dmatrix![-3.0, -1e-3, 0.4, 0.1, 0.0] };
        let reduced = open.reduced();
        for k in 0..200 {
            let z = Complex::from_polar(1.0, 1e-5 * 10f64.powf(5.4 * f64::from(k) / 199.0));
            let m = DMatrix::from_fn(5, 5, |i, j| {
                let diagonal = if i == j { z } else { Complex::new(0.0, 0.0) };
                diagonal - open.a[(i, j)]
            });
            let x = m.lu().solve(&open.b.map(|v| Complex::new(v, 0.0))).unwrap();
            let plain: Complex<f64> = (0..5).map(|i| -x[(i, 0)] * open.c[(0, i)]).sum();
            let found = reduced.response(z).unwrap();
            assert!((found - plain).norm() <= 1e-10 * plain.norm(), "{z}: {found} {plain}");
        }
    }
}
