//! Gains: their choice by bandwidth, the linear regime, its lag, and how fast it must be sampled.

use crate::{EsoError, Fal};

/// Gains and corrections of an observer with N states, in continuous time.
///
/// ```text
/// e   = z₁ − y
/// z₁' = z₂ − β₁ fal₁(e)
///   ⋮
/// z_N' =   − β_N fal_N(e)
/// ```
///
/// zᵢ estimates the derivative y⁽ⁱ⁻¹⁾. While |e| stays within every δ the observer is *linear* with the gains
/// lᵢ = βᵢ · falᵢ'(0), and everything below that speaks of gains, lag or stability means this regime.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Design<const N: usize> {
    gains: [f64; N],
    laws: [Fal; N],
    linear: [f64; N],
}

impl<const N: usize> Design<N> {
    /// Gains β₁ … β_N (βᵢ in 1/sⁱ times the unit that falᵢ leaves) and corrections fal₁ … fal_N.
    ///
    /// # Errors
    /// [`EsoError::Gain`] for one that is not positive and finite (also where its linear gain overflows), and
    /// [`EsoError::NotHurwitz`] where the linear regime is unstable.
    pub fn new(gains: [f64; N], laws: [Fal; N]) -> Result<Self, EsoError> {
        let mut linear = [0.0; N];
        for i in 0..N {
            linear[i] = gains[i] * laws[i].slope();
            if !(gains[i] > 0.0 && gains[i].is_finite() && linear[i] > 0.0 && linear[i].is_finite()) {
                return Err(EsoError::Gain { index: i + 1, value: gains[i] });
            }
        }
        let design = Self { gains, laws, linear };
        if design.euler_limit() > 0.0 { Ok(design) } else { Err(EsoError::NotHurwitz) }
    }

    /// All poles of the linear regime at −ω (`omega` in rad/s): lᵢ = (N over i) ωⁱ, divided by falᵢ'(0) to give
    /// βᵢ.
    ///
    /// Z. Gao, *Scaling and bandwidth-parameterization based controller tuning*, American Control Conference
    /// 2003, doi:10.1109/ACC.2003.1242516. A larger ω follows faster and passes more noise.
    ///
    /// # Errors
    /// [`EsoError::Bandwidth`] where ω is not positive or ωᴺ overflows.
    pub fn from_bandwidth(omega: f64, laws: [Fal; N]) -> Result<Self, EsoError> {
        let linear = bandwidth_gains(omega)?;
        let mut gains = [0.0; N];
        for i in 0..N {
            gains[i] = linear[i] / laws[i].slope();
            if !(gains[i] > 0.0 && gains[i].is_finite()) {
                return Err(EsoError::Bandwidth { omega });
            }
        }
        Ok(Self { gains, laws, linear })
    }

    /// The gains β₁ … β_N.
    #[must_use]
    pub fn gains(&self) -> [f64; N] {
        self.gains
    }

    /// The corrections fal₁ … fal_N.
    #[must_use]
    pub fn laws(&self) -> [Fal; N] {
        self.laws
    }

    /// The gains l₁ … l_N of the linear regime, lᵢ in 1/sⁱ: its poles are the roots of
    /// sᴺ + l₁ sᴺ⁻¹ + … + l_N.
    #[must_use]
    pub fn linear_gains(&self) -> [f64; N] {
        self.linear
    }

    /// The linear observer with the gains of the linear regime.
    pub(crate) fn linearised(&self) -> Self {
        Self { gains: self.linear, laws: [Fal::LINEAR; N], linear: self.linear }
    }

    /// The step, in s, from which explicit Euler is unstable in the linear regime; zero where it is unstable
    /// with any.
    ///
    /// Euler is stable when |1 + h s| < 1 for every pole s, that is when Re(1/s) < −h/2: the limit is twice
    /// the distance of the roots r = 1/s of 1 + l₁ r + … + l_N rᴺ from the imaginary axis. For two complex
    /// poles it is l₁/l₂. The distance is found by halving an interval with Routh's test, with no need of the
    /// roots.
    ///
    /// ```
    /// use greybox_eso::Design;
    /// assert!((Design::thesis().euler_limit() - 0.02485).abs() < 1e-5);
    /// ```
    #[must_use]
    pub fn euler_limit(&self) -> f64 {
        if N == 0 {
            return 0.0;
        }
        // Scaled by the root whose size is the geometric mean of all: r = scale · q.
        let scale = 1.0 / libm::pow(self.linear[N - 1], 1.0 / N as f64);
        let mut reversed = [0.0; N];
        let mut power = scale;
        for (coefficient, gain) in reversed.iter_mut().zip(self.linear) {
            *coefficient = gain * power;
            power *= scale;
        }
        // The mean real part of the roots bounds the largest one.
        let before_last = if N == 1 { 1.0 } else { reversed[N - 2] };
        let (mut stable, mut unstable) = (0.0, before_last / (N as f64 * reversed[N - 1]) * (1.0 + 1e-12));
        if !is_hurwitz(&reversed, 0.0) {
            return 0.0;
        }
        for _ in 0..80 {
            let middle = 0.5 * (stable + unstable);
            if is_hurwitz(&reversed, middle) {
                stable = middle;
            } else {
                unstable = middle;
            }
        }
        2.0 * scale * stable
    }

    /// The lag, in s, of a state (counted from 0) behind the derivative that it estimates, for slow signals in
    /// the linear regime.
    ///
    /// It is l_{N−1}/l_N for the last state (1/l₁ where there is one only) and zero, to this order, for all
    /// others: z₂ of an observer with three states does not lag as z₂ of one with two does. See [`Design::response`] for
    /// signals that are not slow.
    ///
    /// ```
    /// use greybox_eso::Design;
    /// // "z2 is an accurate estimate" of the velocity, but of that 25 ms ago (erratum E6).
    /// assert!((Design::thesis().lag(1)? - 0.02485).abs() < 1e-5);
    /// # Ok::<(), greybox_eso::EsoError>(())
    /// ```
    ///
    /// # Errors
    /// [`EsoError::State`] where there is no such state.
    pub fn lag(&self, state: usize) -> Result<f64, EsoError> {
        if state >= N {
            return Err(EsoError::State { state, order: N });
        }
        let before_last = if N == 1 { 1.0 } else { self.linear[N - 2] };
        Ok(if state + 1 == N { before_last / self.linear[N - 1] } else { 0.0 })
    }

    /// What a state (counted from 0) shows of its derivative at `omega` rad/s in the linear regime: the
    /// amplitude ratio (1 is exact) and the phase lag in rad (0 is exact).
    ///
    /// ```text
    /// Zᵢ / (sⁱ⁻¹ Y) = (lᵢ sᴺ⁻ⁱ + … + l_N) / (sᴺ + l₁ sᴺ⁻¹ + … + l_N)
    /// ```
    ///
    /// # Errors
    /// [`EsoError::State`] where there is no such state.
    pub fn response(&self, state: usize, omega: f64) -> Result<(f64, f64), EsoError> {
        if state >= N {
            return Err(EsoError::State { state, order: N });
        }
        // Horner's rule with s = jω; the numerator joins at its first coefficient.
        let (mut above, mut below) = ((0.0, 0.0), (1.0, 0.0));
        for (i, gain) in self.linear.iter().enumerate() {
            let times_s = |(re, im): (f64, f64)| (-omega * im + gain, omega * re);
            below = times_s(below);
            if i >= state {
                above = times_s(above);
            }
        }
        let amplitude = libm::hypot(above.0, above.1) / libm::hypot(below.0, below.1);
        let (re, im) = (above.0 * below.0 + above.1 * below.1, above.1 * below.0 - above.0 * below.1);
        Ok((amplitude, -libm::atan2(im, re)))
    }
}

impl Design<2> {
    /// The observer of equations 2.22 and 3.27 of the thesis: β₁ = 100 1/s, β₂ = 900, α = ½, δ = 0.05.
    ///
    /// In its linear regime it has the poles −50 ± 39j 1/s.
    #[must_use]
    pub fn thesis() -> Self {
        let root = Fal::new(0.5, 0.05).unwrap_or(Fal::LINEAR);
        let gains = [100.0, 900.0];
        Self { gains, laws: [Fal::LINEAR, root], linear: [gains[0], gains[1] * root.slope()] }
    }
}

/// lᵢ = (N over i) ωⁱ, i = 1 … N, in 1/sⁱ: the linear gains with all N poles at −ω (`omega` in rad/s).
///
/// # Errors
/// [`EsoError::Bandwidth`] where ω is not positive or ωᴺ overflows.
pub fn bandwidth_gains<const N: usize>(omega: f64) -> Result<[f64; N], EsoError> {
    let mut gains = [0.0; N];
    let mut gain = 1.0;
    for i in 0..N {
        gain *= omega * (N - i) as f64 / (i + 1) as f64;
        gains[i] = gain;
        if !(omega > 0.0 && gain > 0.0 && gain.is_finite()) {
            return Err(EsoError::Bandwidth { omega });
        }
    }
    Ok(gains)
}

/// Whether all roots of 1 + c₁ q + … + c_N qᴺ have a real part below −shift (`coefficients` are c₁ … c_N).
fn is_hurwitz<const N: usize>(coefficients: &[f64; N], shift: f64) -> bool {
    let mut p = Polynomial { constant: 1.0, rest: *coefficients };
    // In powers of q + shift, by repeated synthetic division.
    for first in 0..N {
        for k in (first..N).rev() {
            *p.at(k) -= shift * *p.at(k + 1);
        }
    }
    // Routh: strip the leading power, N times, and watch the signs. Entry j below is that of q^(N−j).
    for k in 0..N {
        let (leading, next) = (*p.at(N - k), *p.at(N - k - 1));
        if !(leading > 0.0 && next > 0.0) {
            return false;
        }
        for j in (k + 2..N).step_by(2) {
            *p.at(N - j) -= leading / next * *p.at(N - j - 1);
        }
    }
    true
}

/// N + 1 coefficients by rising power (an array of N + 1 cannot be written on stable Rust).
struct Polynomial<const N: usize> {
    constant: f64,
    rest: [f64; N],
}

impl<const N: usize> Polynomial<N> {
    fn at(&mut self, power: usize) -> &mut f64 {
        if power == 0 { &mut self.constant } else { &mut self.rest[power - 1] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn linear<const N: usize>(gains: [f64; N]) -> Result<Design<N>, EsoError> {
        Design::new(gains, [Fal::LINEAR; N])
    }

    #[test]
    fn erratum_e6_the_thesis_observer_is_linear_and_lags() {
        let design = Design::thesis();
        let [l1, l2] = design.linear_gains();
        assert_eq!(l1, 100.0);
        assert!((l2 - 4024.92).abs() < 0.01);
        assert_eq!(Design::new(design.gains(), design.laws()), Ok(design));
        // Poles −l₁/2 ± j √(l₂ − l₁²/4).
        assert!((libm::sqrt(l2 - 0.25 * l1 * l1) - 39.05).abs() < 0.01);
        assert!((design.lag(1).unwrap() - 0.024845).abs() < 1e-6);
        assert_eq!(design.lag(0), Ok(0.0));
        assert_eq!(design.lag(2), Err(EsoError::State { state: 2, order: 2 }));
    }

    #[test]
    fn the_euler_limit_is_that_of_the_fastest_pole() {
        // Complex pair: l₁/l₂. Real poles: 2/|s| of the fastest. One state: 2/l₁.
        assert!((linear([100.0, 4025.0]).unwrap().euler_limit() - 100.0 / 4025.0).abs() < 1e-12);
        assert!((linear([12.0, 20.0]).unwrap().euler_limit() - 0.2).abs() < 1e-12);
        assert!((linear([50.0]).unwrap().euler_limit() - 0.04).abs() < 1e-14);
        // (s + 1)(s² + 2 s + 10): the pair −1 ± 3j allows 0.2, the real pole 2.
        assert!((linear([3.0, 12.0, 10.0]).unwrap().euler_limit() - 0.2).abs() < 1e-12);
        // (s + 30)(s² + 2 s + 10): now the real pole.
        assert!((linear([32.0, 70.0, 300.0]).unwrap().euler_limit() - 2.0 / 30.0).abs() < 1e-12);
        // Four equal poles, far from 1.
        let gao = Design::<4>::from_bandwidth(2e4, [Fal::LINEAR; 4]).unwrap();
        assert!((gao.euler_limit() * 1e4 - 1.0).abs() < 1e-3);
    }

    #[test]
    fn bandwidth_gives_binomial_gains_also_through_fal() {
        assert_eq!(bandwidth_gains::<3>(10.0), Ok([30.0, 300.0, 1000.0]));
        assert_eq!(bandwidth_gains::<4>(1.0), Ok([4.0, 6.0, 4.0, 1.0]));
        let laws = [Fal::LINEAR, Fal::new(0.5, 0.05).unwrap(), Fal::new(0.25, 0.01).unwrap()];
        let design = Design::from_bandwidth(40.0, laws).unwrap();
        assert_eq!(design.linear_gains(), [120.0, 4800.0, 64000.0]);
        let again = Design::new(design.gains(), laws).unwrap().linear_gains();
        for (a, b) in again.iter().zip(design.linear_gains()) {
            assert!((a / b - 1.0).abs() < 1e-14);
        }
    }

    #[test]
    fn unusable_gains_are_refused() {
        assert_eq!(linear([1.0, -2.0]), Err(EsoError::Gain { index: 2, value: -2.0 }));
        assert!(matches!(linear([f64::NAN]), Err(EsoError::Gain { index: 1, .. })));
        // s³ + s² + s + 2 has roots to the right.
        assert_eq!(linear([1.0, 1.0, 2.0]), Err(EsoError::NotHurwitz));
        for omega in [0.0, -3.0, f64::NAN, f64::INFINITY, 1e200] {
            assert!(matches!(bandwidth_gains::<3>(omega), Err(EsoError::Bandwidth { .. })), "{omega}");
        }
    }

    #[test]
    fn the_response_starts_with_the_lag() {
        let laws = [Fal::LINEAR; 3];
        let design = Design::from_bandwidth(50.0, laws).unwrap();
        let omega = 1e-3;
        for state in 0..3 {
            let (amplitude, phase) = design.response(state, omega).unwrap();
            assert!((amplitude - 1.0).abs() < 1e-6);
            assert!((phase / omega - design.lag(state).unwrap()).abs() < 1e-8, "state {state}");
        }
        // (3 · 50² (jω) + 50³)/(jω + 50)³ at ω = 50: (1 + 3j)/(1 + j)³ = (1 + 3j)/(−2 + 2j).
        let (amplitude, phase) = design.response(1, 50.0).unwrap();
        assert!((amplitude - libm::sqrt(10.0 / 8.0)).abs() < 1e-12);
        assert!((phase - (0.75 * core::f64::consts::PI - libm::atan(3.0))).abs() < 1e-12);
        assert!(design.response(3, 1.0).is_err());
    }
}
