//! The Taylor expansion of a delayed term, and delays read off its coefficients.
//!
//! ```text
//! g x(t − τ) = Σₖ₌₀ʳ g (−τ)ᵏ/k! · x⁽ᵏ⁾(t) + remainder
//! ```
//!
//! turns the delay into coefficients of derivatives (thesis Eq 3.7). With the thesis's g = −kₚ and r = 3 the
//! parameter vector is \[kₚτ³/6, m − kₚτ²/2, c₁ + kₚτ, …, k₁ − kₚ\] for x‴, ẍ, ẋ, x (Table 3.1; Eq 3.12 prints three of
//! these signs wrong). One coefficient gives the delay when the plant's own share of it is known: none of x‴ is the
//! plant's, so with g known the cube root of its coefficient needs nothing else.
//!
//! ```
//! use greybox_delay::expansion::Expansion;
//!
//! let expansion = Expansion::new(-2.0, 3)?;
//! // Thesis Tables 3.1 and 3.2: τ = (6·0.001515/2)^(1/3) = 0.1656, m = 0.9611 + 2·0.1656²/2.
//! let reading = expansion.read(3, 0.001515, 0.0)?;
//! assert!((reading.delay - 0.1656).abs() < 1e-4 && reading.admissible);
//! assert!((0.9611 - expansion.coefficient(2, reading.delay) - 0.9885).abs() < 1e-4);
//! # Ok::<(), greybox_delay::expansion::ExpansionError>(())
//! ```

/// Why an expansion gives nothing.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ExpansionError {
    /// The gain is zero or not finite.
    #[error("a delayed term with the gain {gain} carries no delay: the gain must be finite and not zero")]
    Gain {
        /// The gain.
        gain: f64,
    },
    /// The order is outside 1 to [`MAX_ORDER`].
    #[error("an expansion of order {order} is impossible: give 1 to {MAX_ORDER}")]
    Order {
        /// The order.
        order: usize,
    },
    /// The coefficient of x⁽ᵏ⁾ holds no delay.
    #[error("the coefficient of derivative {derivative} holds no delay: ask for 1 to {order}")]
    Derivative {
        /// The derivative asked for.
        derivative: usize,
        /// Order of the expansion.
        order: usize,
    },
}

/// Highest order of an expansion: beyond it factorials and powers say nothing that data could hold.
pub const MAX_ORDER: usize = 12;

/// The expansion of g x(t − τ), on the left side of the equation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expansion {
    gain: f64,
    order: usize,
}

/// A delay read off one coefficient.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// Which derivative's coefficient was read.
    pub derivative: usize,
    /// The delay, s: the signed root, negative when the coefficient has a sign that no delay gives it.
    pub delay: f64,
    /// Whether the sign is one that a delay τ ≥ 0 gives.
    pub admissible: bool,
}

impl Expansion {
    /// The expansion of a term with the gain g to the order r.
    ///
    /// # Errors
    /// A gain that is zero or not finite, an order outside 1 to [`MAX_ORDER`].
    pub fn new(gain: f64, order: usize) -> Result<Self, ExpansionError> {
        if !gain.is_finite() || gain == 0.0 {
            return Err(ExpansionError::Gain { gain });
        }
        if order == 0 || order > MAX_ORDER {
            return Err(ExpansionError::Order { order });
        }
        Ok(Self { gain, order })
    }

    /// The order r.
    #[must_use]
    pub fn order(&self) -> usize {
        self.order
    }

    /// The gain g.
    #[must_use]
    pub fn gain(&self) -> f64 {
        self.gain
    }

    /// g (−τ)ᵏ/k!: what the delay adds to the coefficient of x⁽ᵏ⁾ (0 above the order).
    #[must_use]
    pub fn coefficient(&self, derivative: usize, delay: f64) -> f64 {
        if derivative > self.order {
            return 0.0;
        }
        (1..=derivative).fold(self.gain, |c, k| c * -delay / k as f64)
    }

    /// The delay from the coefficient of x⁽ᵏ⁾, of which `own` is the plant's (0 for a derivative above the plant's
    /// order): g (−τ)ᵏ/k! = coefficient − own.
    ///
    /// # Errors
    /// A derivative without delay: 0 or above the order.
    pub fn read(&self, derivative: usize, coefficient: f64, own: f64) -> Result<Reading, ExpansionError> {
        if derivative == 0 || derivative > self.order {
            return Err(ExpansionError::Derivative { derivative, order: self.order });
        }
        let factorial: f64 = (1..=derivative).map(|k| k as f64).product();
        let sign = if derivative.is_multiple_of(2) { 1.0 } else { -1.0 };
        let power = sign * factorial * (coefficient - own) / self.gain;
        let delay = power.signum() * power.abs().powf(1.0 / derivative as f64);
        Ok(Reading { derivative, delay, admissible: power >= 0.0 })
    }

    /// Standard deviation of a reading from that of its coefficient, to first order:
    /// σ_τ = σ_c / |∂c/∂τ|, infinite at τ = 0 for derivatives above the first.
    #[must_use]
    pub fn reading_std(&self, reading: &Reading, coefficient_std: f64) -> f64 {
        let k = reading.derivative;
        let slope = (1..k).fold(self.gain.abs(), |c, i| c * reading.delay.abs() / i as f64);
        coefficient_std / slope
    }

    /// Relative error of the expansion for a sine of the angular frequency ω, rad/s:
    /// |Σₖ (−iωτ)ᵏ/k! − e^(−iωτ)|. Where it is not small, the estimated delay is that of another system.
    #[must_use]
    pub fn truncation(&self, delay: f64, omega: f64) -> f64 {
        let angle = omega * delay;
        let (mut re, mut im) = (1.0 - angle.cos(), angle.sin());
        let mut term = 1.0;
        for k in 1..=self.order {
            term *= angle / k as f64;
            match k % 4 {
                0 => re += term,
                1 => im -= term,
                2 => re -= term,
                _ => im += term,
            }
        }
        re.hypot(im)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_of_table_3_1() {
        let e = Expansion::new(-2.0, 3).unwrap();
        let added: Vec<f64> = (0..5).map(|k| e.coefficient(k, 0.2)).collect();
        for (found, expected) in added.iter().zip([-2.0, 0.4, -0.04, 0.002_666_666_666_666_667, 0.0]) {
            assert!((found - expected).abs() < 1e-15, "{added:?}");
        }
    }

    #[test]
    fn every_coefficient_gives_the_delay_back() {
        for gain in [-2.0, 0.7] {
            let e = Expansion::new(gain, 6).unwrap();
            for k in 1..=6 {
                let reading = e.read(k, 1.3 + e.coefficient(k, 0.35), 1.3).unwrap();
                assert!((reading.delay - 0.35).abs() < 1e-9 && reading.admissible, "{k} {reading:?}");
                let wrong = e.read(k, 1.3 - e.coefficient(k, 0.35), 1.3).unwrap();
                assert!((wrong.delay + 0.35).abs() < 1e-9 && !wrong.admissible, "{k} {wrong:?}");
                // The slope, against a difference.
                let h = 1e-6;
                let slope = (e.coefficient(k, 0.35 + h) - e.coefficient(k, 0.35 - h)) / (2.0 * h);
                assert!((e.reading_std(&reading, 1.0) * slope.abs() - 1.0).abs() < 1e-6, "{k}");
            }
        }
    }

    #[test]
    fn table_3_5_has_two_delays() {
        // θ-equation: a kp = 0.40605; a kp τ²/2 = 0.0061 gives 0.1734, a kp τ − B_eq = 0.0920 gives 0.2635.
        let e = Expansion::new(0.406_05, 2).unwrap();
        assert!((e.read(2, 0.0061, 0.0).unwrap().delay - 0.1734).abs() < 1e-4);
        assert!((e.read(1, -0.0920, 0.015).unwrap().delay - 0.2635).abs() < 1e-4);
    }

    #[test]
    fn truncation_at_the_frequencies_of_the_notes() {
        let e = Expansion::new(-2.0, 3).unwrap();
        for (omega, expected) in [(4.0, 0.017), (8.0, 0.26), (12.0, 1.28)] {
            let error = e.truncation(0.2, omega);
            assert!((error / expected - 1.0).abs() < 0.03, "{omega} {error}");
        }
    }

    #[test]
    fn what_holds_no_delay_is_refused() {
        assert!(matches!(Expansion::new(0.0, 3), Err(ExpansionError::Gain { .. })));
        assert!(matches!(Expansion::new(1.0, 0), Err(ExpansionError::Order { .. })));
        assert!(matches!(Expansion::new(1.0, 13), Err(ExpansionError::Order { .. })));
        let e = Expansion::new(1.0, 2).unwrap();
        assert!(matches!(e.read(0, 1.0, 0.0), Err(ExpansionError::Derivative { .. })));
        assert!(matches!(e.read(3, 1.0, 0.0), Err(ExpansionError::Derivative { .. })));
    }
}
