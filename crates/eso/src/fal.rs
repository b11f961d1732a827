//! The nonlinear correction `fal` and its two linear branches.

use crate::EsoError;

/// The correction `fal(e, α, δ)` of an observer: a root far out, a straight line near zero.
///
/// ```text
///                 ⎧ |e|^α sign(e)     |e| > δ
/// fal(e, α, δ) =  ⎨
///                 ⎩ e / δ^(1−α)       |e| ≤ δ
/// ```
///
/// With α < 1 small errors get a larger gain than large ones; the line near zero keeps that gain finite, so
/// that noise within δ is not amplified without bound. α = 1 is the identity, α = 0 a saturated sign.
///
/// This is Han's form (J. Han, *From PID to active disturbance rejection control*, IEEE Trans. Ind. Electron.
/// 56(3), 2009, doi:10.1109/TIE.2008.2011621). It is continuous. Equations 2.23 and 3.28 of the thesis print
/// the line as e/δ^α, which jumps at |e| = δ unless α = ½: [`Fal::as_printed`] is there to reproduce it.
///
/// ```
/// use greybox_eso::Fal;
/// let han = Fal::new(0.25, 0.05)?;
/// let printed = Fal::new(0.25, 0.05)?.as_printed();
/// assert!((han.apply(0.05) - 0.4729).abs() < 1e-4); // meets 0.05^0.25 …
/// assert!((printed.apply(0.05) - 0.1057).abs() < 1e-4); // … where this does not
/// # Ok::<(), greybox_eso::EsoError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fal {
    power: Power,
    delta: f64,
    /// Slope of the line near zero.
    slope: f64,
    printed: bool,
}

/// The exponent; the frequent ones cost no general power.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Power {
    One,
    Half,
    Any(f64),
}

impl Power {
    fn of(alpha: f64) -> Self {
        match alpha {
            1.0 => Self::One,
            0.5 => Self::Half,
            _ => Self::Any(alpha),
        }
    }

    fn exponent(self) -> f64 {
        match self {
            Self::One => 1.0,
            Self::Half => 0.5,
            Self::Any(alpha) => alpha,
        }
    }

    /// x^α for x ≥ 0.
    #[inline]
    fn raise(self, x: f64) -> f64 {
        match self {
            Self::One => x,
            Self::Half => libm::sqrt(x),
            Self::Any(alpha) => libm::pow(x, alpha),
        }
    }
}

impl Fal {
    /// fal(e) = e, the correction of a linear (Luenberger) observer.
    pub const LINEAR: Fal = Fal { power: Power::One, delta: 1.0, slope: 1.0, printed: false };

    /// Han's `fal` with the exponent `alpha` in [0, 1] and the half width `delta` > 0 of its linear zone, in
    /// units of the error.
    ///
    /// # Errors
    /// [`EsoError::Exponent`] or [`EsoError::Width`] when one is outside its range, or when the slope at zero
    /// overflows (a subnormal `delta`).
    pub fn new(alpha: f64, delta: f64) -> Result<Self, EsoError> {
        if !(0.0..=1.0).contains(&alpha) {
            return Err(EsoError::Exponent { alpha });
        }
        let power = Power::of(alpha);
        let slope = power.raise(delta) / delta;
        if !(delta > 0.0 && delta.is_finite() && slope.is_finite() && slope > 0.0) {
            return Err(EsoError::Width { delta });
        }
        Ok(Self { power, delta, slope, printed: false })
    }

    /// The same with the linear branch e/δ^α that equations 2.23 and 3.28 of the thesis print (erratum E5).
    ///
    /// At α = ½ both are one; at other exponents this one jumps at |e| = δ.
    #[must_use]
    pub fn as_printed(self) -> Self {
        match self.power {
            Power::One if self.delta == 1.0 => self,
            power => Self { slope: 1.0 / power.raise(self.delta), printed: true, ..self },
        }
    }

    /// fal(e).
    #[must_use]
    #[inline]
    pub fn apply(&self, e: f64) -> f64 {
        let size = e.abs();
        if size <= self.delta {
            self.slope * e
        } else if size > self.delta {
            libm::copysign(self.power.raise(size), e)
        } else {
            e // not a number
        }
    }

    /// The slope at zero: δ^(α−1), or δ^(−α) as printed.
    #[must_use]
    pub fn slope(&self) -> f64 {
        self.slope
    }

    /// The exponent α.
    #[must_use]
    pub fn alpha(&self) -> f64 {
        self.power.exponent()
    }

    /// The half width δ of the linear zone; of [`Fal::LINEAR`], where it plays no part, 1.
    #[must_use]
    pub fn delta(&self) -> f64 {
        self.delta
    }

    /// Whether the two branches fail to meet at |e| = δ.
    pub(crate) fn jumps(&self) -> bool {
        self.printed && (self.slope * self.delta - self.power.raise(self.delta)).abs() > 1e-12 * self.slope
    }

    /// dfal/de (at |e| = δ that of the line).
    pub(crate) fn tangent(&self, e: f64) -> f64 {
        if e.abs() <= self.delta {
            self.slope
        } else {
            self.power.exponent() * self.power.raise(e.abs()) / e.abs()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hans_branches_meet() {
        for alpha in [0.0, 0.1, 0.25, 0.5, 0.8, 1.0] {
            for delta in [1e-3, 0.05, 1.0, 20.0] {
                let fal = Fal::new(alpha, delta).unwrap();
                let (inside, outside) = (fal.apply(delta), fal.apply(delta * (1.0 + 1e-12)));
                assert!((inside - outside).abs() < 1e-11 * outside, "{alpha} {delta}");
                assert!(!fal.jumps());
            }
        }
    }

    #[test]
    fn erratum_e5_the_printed_branch_jumps_unless_alpha_is_one_half() {
        let half = Fal::new(0.5, 0.05).unwrap();
        assert!((half.slope() - half.as_printed().slope()).abs() < 1e-14);
        assert!(!half.as_printed().jumps());
        let quarter = Fal::new(0.25, 0.05).unwrap();
        assert!((quarter.as_printed().apply(0.05) - 0.1057).abs() < 5e-5);
        assert!((quarter.apply(0.05) - 0.4729).abs() < 5e-5);
        assert!(quarter.as_printed().jumps());
        assert_eq!(Fal::LINEAR.as_printed(), Fal::LINEAR);
    }

    #[test]
    fn odd_increasing_and_concave() {
        let fal = Fal::new(0.3, 0.02).unwrap();
        let mut last = (0.0, f64::INFINITY);
        for k in 1..400 {
            let e = 1e-3 * f64::from(k);
            let value = fal.apply(e);
            assert_eq!(fal.apply(-e), -value);
            let rise = value - last.0;
            assert!(rise > 0.0 && rise <= last.1 * (1.0 + 1e-9), "at {e}");
            last = (value, rise);
        }
        assert_eq!(fal.apply(0.0), 0.0);
        assert!(fal.apply(f64::NAN).is_nan());
        assert_eq!(Fal::new(0.0, 0.1).unwrap().apply(-7.0), -1.0);
    }

    #[test]
    fn the_fast_root_is_the_power() {
        let fal = Fal::new(0.5, 0.05).unwrap();
        for e in [0.06, 0.9, 3.0, 1e6] {
            assert!((fal.apply(-e) + libm::pow(e, 0.5)).abs() <= 1e-15 * fal.apply(e));
        }
    }

    #[test]
    fn what_makes_no_sense_is_refused() {
        for alpha in [-0.1, 1.1, f64::NAN] {
            assert!(matches!(Fal::new(alpha, 0.1), Err(EsoError::Exponent { .. })));
        }
        for delta in [0.0, -1.0, f64::NAN, f64::INFINITY, 5e-324] {
            assert!(matches!(Fal::new(0.0, delta), Err(EsoError::Width { .. })), "{delta}");
        }
    }
}
