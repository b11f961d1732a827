//! The cost of an input with limits, and the law that it gives.

use crate::error::HjbError;

/// The size of x up to which ln(1 + x) − x is summed as a series.
const SERIES_LOG: f64 = 0.05;
/// The size of s up to which s − tanh s is summed as a series.
const SERIES_TANH: f64 = 0.1;

/// The range low ≤ u ≤ high of an input around zero, the input of the equilibrium, as a cost that makes the law stay
/// within it.
///
/// The quadratic cost r u² is replaced by
///
/// ```text
/// U(u) = 2 r (1 − T²) h ∫₀ᵘ (atanh((v − m)/h) − atanh T) dv        m = (low + high)/2,  h = (high − low)/2,  T = −m/h
/// ```
///
/// whose slope is infinite at the limits. It has U(0) = U′(0) = 0 and U″(0) = 2r. With p = gᵀ∇V, the Hamiltonian
/// U(u) + p u is least at
///
/// ```text
/// u* = −h (1 − T²) tanh s / (1 − T tanh s)        s = p / (2 r h (1 − T²))
/// U(u*) + p u* = −2 r h² (1 − T²) (ln cosh s + ln(1 − T tanh s) + T s)
/// ```
///
/// For limits of one size, T = 0 and h = ū, this is the cost of M. Abu-Khalaf and F. L. Lewis (*Nearly optimal control
/// laws for nonlinear systems with saturating actuators using a neural network HJB approach*, Automatica 41(5), 2005,
/// 779–791), after S. E. Lyshevski (1998):
///
/// ```text
/// U(u) = 2 ū r ∫₀ᵘ atanh(v/ū) dv        u* = −ū tanh(p/(2 ū r))        U(u*) + p u* = −2 ū² r ln cosh(p/(2 ū r))
/// ```
///
/// Limits of two sizes are our extension: atanh is shifted so that zero input costs least, and scaled so that the law
/// has the slope of the quadratic one there. As the limits go to infinity, U(u) → r u², u* → −p/(2r) and
/// U(u*) + p u* → −p²/(4r).
///
/// ```
/// use greybox_hjb::InputRange;
/// let range = InputRange::new(-2.0, 2.0)?;
/// // −ū tanh(p/(2 ū r)) for p = 4, r = 0.5.
/// assert!((range.command(4.0, 0.5) + 2.0 * 2f64.tanh()).abs() < 1e-15);
/// // No input is cheaper than this one.
/// let total = |u: f64| range.cost(u, 0.5) + 4.0 * u;
/// let best = range.command(4.0, 0.5);
/// assert!(total(best) < total(best + 1e-3) && total(best) < total(best - 1e-3));
/// // U(ū) = 2 ū² r ln 2, and nothing beyond is paid for.
/// assert!((range.cost(2.0, 0.5) - 4.0 * 2f64.ln()).abs() < 1e-14);
/// assert_eq!(range.cost(2.1, 0.5), f64::INFINITY);
/// # Ok::<(), greybox_hjb::HjbError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InputRange {
    low: f64,
    high: f64,
}

impl InputRange {
    /// No limits: the quadratic cost.
    pub const UNLIMITED: InputRange = InputRange { low: f64::NEG_INFINITY, high: f64::INFINITY };

    /// From `low` < 0 to `high` > 0, both finite, or neither.
    ///
    /// # Errors
    /// [`HjbError::Range`] for any other range.
    pub fn new(low: f64, high: f64) -> Result<InputRange, HjbError> {
        let finite = low.is_finite() && high.is_finite() && (high - low).is_finite();
        let around_zero = low < 0.0 && high > 0.0;
        if around_zero && (finite || (low.is_infinite() && high.is_infinite())) {
            Ok(InputRange { low, high })
        } else {
            Err(HjbError::Range { low, high })
        }
    }

    /// The lower limit.
    #[must_use]
    pub fn low(&self) -> f64 {
        self.low
    }

    /// The upper limit.
    #[must_use]
    pub fn high(&self) -> f64 {
        self.high
    }

    /// Whether there are limits.
    #[must_use]
    pub fn is_limited(&self) -> bool {
        self.low.is_finite()
    }

    /// u*, the input that minimises U(u) + p u, for `slope` p = gᵀ∇V and weight `r`.
    #[must_use]
    pub fn command(&self, slope: f64, r: f64) -> f64 {
        if !self.is_limited() {
            return -0.5 * slope / r;
        }
        let (s, size) = (self.scaled(slope, r), self.half() * self.share());
        // Rounding must not step over a limit; clamp keeps what is not a number.
        (-size * s.tanh() / self.nearness(s)).clamp(self.low, self.high)
    }

    /// min U(u) + p u for `slope` p = gᵀ∇V and weight `r`: what the input adds to the Hamiltonian.
    #[must_use]
    pub fn least(&self, slope: f64, r: f64) -> f64 {
        if !self.is_limited() {
            return -0.25 * slope * slope / r;
        }
        let (s, h, skew) = (self.scaled(slope, r), self.half(), self.skew());
        let x = skew * s.tanh();
        // ln(1 − T tanh s) + T s, where the terms of first order cancel.
        let log = if x.abs() < SERIES_LOG { log_remainder(-x) } else { self.nearness(s).ln() + x };
        -2.0 * r * h * h * self.share() * (ln_cosh(s) + log + skew * tanh_remainder(s))
    }

    /// U(u) for weight `r`; infinite beyond the limits.
    #[must_use]
    pub fn cost(&self, u: f64, r: f64) -> f64 {
        if !self.is_limited() {
            return r * u * u;
        }
        if u < self.low || u > self.high {
            return f64::INFINITY;
        }
        // ∫ atanh z dz = ½ ((1 + z) ln(1 + z) + (1 − z) ln(1 − z)) with 1 + z = (v − low)/h and 1 − z = (high − v)/h.
        // With v over the limit as x, U is r (1 − T²) h Σ |limit| ((1 − x) ln(1 − x) + x) over both limits.
        let term = |limit: f64| {
            let x = u / limit;
            let gap = 1.0 - x;
            let entropy = if x.abs() < SERIES_LOG {
                gap * log_remainder(-x) + x * x
            } else {
                (if gap > 0.0 { gap * gap.ln() } else { 0.0 }) + x
            };
            limit.abs() * entropy
        };
        r * self.share() * self.half() * (term(self.low) + term(self.high))
    }

    /// The range for an input counted in units of which one is `factor` of this one's.
    pub(crate) fn times(&self, factor: f64) -> InputRange {
        InputRange { low: self.low * factor, high: self.high * factor }
    }

    /// h.
    fn half(&self) -> f64 {
        0.5 * (self.high - self.low)
    }

    /// T.
    fn skew(&self) -> f64 {
        -(self.low + self.high) / (self.high - self.low)
    }

    /// 1 − T².
    fn share(&self) -> f64 {
        let h = self.half();
        (-self.low / h) * (self.high / h)
    }

    /// s; zero for a slope of zero.
    fn scaled(&self, slope: f64, r: f64) -> f64 {
        if slope == 0.0 { 0.0 } else { slope / (2.0 * r * self.half() * self.share()) }
    }

    /// 1 − T tanh s, without cancellation: 1 ∓ T is what is left to a limit.
    fn nearness(&self, s: f64) -> f64 {
        let skew = self.skew();
        if skew * s > 0.0 {
            let nearer = if skew > 0.0 { self.high } else { -self.low };
            nearer / self.half() + skew.abs() * 2.0 / ((2.0 * s.abs()).exp() + 1.0)
        } else {
            1.0 + (skew * s.tanh()).abs()
        }
    }
}

/// ln cosh s, without overflow and without cancellation.
fn ln_cosh(s: f64) -> f64 {
    let size = s.abs();
    if size < 1.0 {
        0.5 * size.sinh().powi(2).ln_1p()
    } else {
        size + (-2.0 * size).exp().ln_1p() - std::f64::consts::LN_2
    }
}

/// ln(1 + x) − x for |x| < [`SERIES_LOG`].
fn log_remainder(x: f64) -> f64 {
    let sum = (2..14).rev().fold(0.0, |sum, k| sum * -x + 1.0 / f64::from(k));
    -x * x * sum
}

/// s − tanh s.
fn tanh_remainder(s: f64) -> f64 {
    if s.abs() < SERIES_TANH {
        let q = s * s;
        let sum = 1.0 / 3.0
            + q * (-2.0 / 15.0 + q * (17.0 / 315.0 + q * (-62.0 / 2835.0 + q * (1382.0 / 155_925.0))));
        s * q * sum
    } else {
        s - s.tanh()
    }
}
