//! The kernel of a window and the quadrature weights of ∫ w y⁽ⁿ⁾.

use crate::error::AlgebraicError;
use crate::quadrature::{Hold, StepRule};

/// Highest degree r + q − 1 of a kernel.
pub const MAX_DEGREE: usize = 24;

/// What becomes of initial conditions that differentiation by s leaves in the equation (order n > r).
///
/// For n ≤ r there are none and the choice does not matter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Initial {
    /// None may be left: n > r is an error.
    #[default]
    Eliminated,
    /// n = r + 1 leaves y(0) only: it is the window's first sample, whose noise then enters the row.
    FirstSample,
    /// They are left out of the weights; the caller adds Σₖ cₖ y⁽ᵏ⁾(0) with [`Kernel::initial_factors`]. Leaving
    /// them out altogether is the thesis's Eq 3.10 as printed (erratum E13).
    Separate,
}

/// The kernel of one window of M steps Δt, T = M Δt:
///
/// ```text
/// w(τ) = τ^r (T − τ)^(q−1) / (q−1)! · 1/S ,   S = T^(r+q) r!/(r+q)! ,   so that ∫₀ᵀ w dτ = 1 .
/// ```
///
/// It is what remains in time of dʳ/dsʳ (to remove initial conditions) and division by s^q (to remove
/// derivatives) of the Laplace-transformed equation, thesis §2.1.2: without the scale S,
/// ∫ w y⁽ⁿ⁾ = I^q\[t^r y⁽ⁿ⁾\](T), whose common sign (−1)^r is dropped. The scale is shared by all columns, so the
/// coefficients of the equation do not feel it; with it, a row is the weighted mean of y⁽ⁿ⁾ over the window, in
/// the unit of y⁽ⁿ⁾, and rows of all windows and kernels are of comparable size.
///
/// ```
/// use greybox_algebraic::{Hold, Kernel};
/// // The mean of a second derivative, from the signal alone: y = t³ has y'' = 6 t, and the kernel
/// // τ²(T−τ)² is centred on T/2 = 0.5.
/// let kernel = Kernel::new(2, 3, 100, 0.01)?;
/// let weights = kernel.weights(2, Hold::Smooth)?;
/// let y: Vec<f64> = (0..=100).map(|k| (0.01 * f64::from(k)).powi(3)).collect();
/// assert!((weights.apply(&y)? - 3.0).abs() < 1e-9);
/// # Ok::<(), greybox_algebraic::AlgebraicError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Kernel {
    s_derivatives: usize,
    integrations: usize,
    intervals: usize,
    dt: f64,
    initial: Initial,
}

impl Kernel {
    /// The kernel of `s_derivatives` (r), `integrations` (q) and a window of `intervals` steps of `dt` s, that is
    /// `intervals + 1` samples.
    ///
    /// The kernel written τ^a (T−τ)^b has r = a, q = b + 1. For an equation of order n, r = n and q = n + 1 keep
    /// all values at the ends of the window out of the rows: the noise-proof choice.
    ///
    /// # Errors
    /// [`AlgebraicError::Step`], [`AlgebraicError::NoIntegration`], [`AlgebraicError::Degree`],
    /// [`AlgebraicError::Window`] for a window of no steps.
    pub fn new(
        s_derivatives: usize,
        integrations: usize,
        intervals: usize,
        dt: f64,
    ) -> Result<Self, AlgebraicError> {
        check(s_derivatives, integrations, dt)?;
        if intervals == 0 {
            return Err(AlgebraicError::Window { intervals, order: 0, needed: 1 });
        }
        Ok(Self { s_derivatives, integrations, intervals, dt, initial: Initial::Eliminated })
    }

    /// The same kernel with another treatment of remaining initial conditions.
    #[must_use]
    pub fn with_initial(self, initial: Initial) -> Self {
        Self { initial, ..self }
    }

    /// Number r of derivatives by s: the kernel vanishes like τ^r at the start.
    pub fn s_derivatives(&self) -> usize {
        self.s_derivatives
    }

    /// Number q of integrations: the kernel vanishes like (T−τ)^(q−1) at the end.
    pub fn integrations(&self) -> usize {
        self.integrations
    }

    /// Steps M of the window.
    pub fn intervals(&self) -> usize {
        self.intervals
    }

    /// Samples of the window, M + 1.
    pub fn samples(&self) -> usize {
        self.intervals + 1
    }

    /// Sampling step Δt, s.
    pub fn dt(&self) -> f64 {
        self.dt
    }

    /// Length T = M Δt of the window, s.
    pub fn duration(&self) -> f64 {
        self.intervals as f64 * self.dt
    }

    /// What becomes of remaining initial conditions.
    pub fn initial(&self) -> Initial {
        self.initial
    }

    /// S = T^(r+q) r!/(r+q)!, s^(r+q): a row times S is the thesis's iterated integral I^q\[t^r y⁽ⁿ⁾\] at T.
    pub fn scale(&self) -> f64 {
        scale(self.s_derivatives, self.integrations, self.duration())
    }

    /// Highest derivative whose rows hold no value at the ends of the window, min(r, q − 1).
    pub fn clean_order(&self) -> usize {
        self.s_derivatives.min(self.integrations - 1)
    }

    /// w⁽ʲ⁾(τ) at τ = `fraction` T, 1/s^(j+1), for a fraction within [0, 1] (the kernel is zero outside).
    pub fn value(&self, order: usize, fraction: f64) -> f64 {
        if (0.0..=1.0).contains(&fraction) { self.derivative(order, fraction, 1.0 - fraction) } else { 0.0 }
    }

    /// w⁽ʲ⁾ at τ = u T with 1 − u given beside u, so that no digits are lost at the end of the window.
    fn derivative(&self, order: usize, u: f64, rest: f64) -> f64 {
        let (r, p) = (self.s_derivatives, self.integrations - 1);
        // w = u^r (1−u)^p / (T B(r+1, q)) with the beta function B(r+1, q) = (q−1)! r!/(r+q)!
        let beta = factorial(p) / falling(r + p + 1, p + 1);
        product_derivative(r, p, order, u, rest) / beta / self.duration().powi(order as i32 + 1)
    }

    /// Factors cₖ of the initial conditions y⁽ᵏ⁾(0), k = 0 … n − r − 1, in ∫ w y⁽ⁿ⁾ = Σ vᵢ yᵢ + Σ cₖ y⁽ᵏ⁾(0);
    /// empty when n ≤ r. Unit of cₖ: 1/s^(n−k).
    ///
    /// With j = n − 1 − k, cₖ = (−1)^(j+1) w⁽ʲ⁾(0). Times [`Kernel::scale`] and for r = 2, q = n = 3 this is −T²:
    /// the x₀ t² that Eq 3.10 forgets (E13).
    pub fn initial_factors(&self, order: usize) -> Vec<f64> {
        (0..order.saturating_sub(self.s_derivatives))
            .map(|k| {
                let j = order - 1 - k;
                -sign(j) * self.derivative(j, 0.0, 1.0)
            })
            .collect()
    }

    /// Weights vᵢ, i = 0 … M, of the quadrature Σ vᵢ yᵢ = ∫₀ᵀ w y⁽ⁿ⁾ dτ of the derivative of `order` n of a signal
    /// joined by `hold`, exact for the joined signal.
    ///
    /// Integrating by parts n times moves the derivatives onto the kernel,
    ///
    /// ```text
    /// ∫ w y⁽ⁿ⁾ = Σ_{j<n} (−1)^j [w⁽ʲ⁾ y⁽ⁿ⁻¹⁻ʲ⁾]₀ᵀ + (−1)ⁿ ∫ w⁽ⁿ⁾ y .
    /// ```
    ///
    /// Terms at 0 vanish for n ≤ r; beyond, [`Initial`] decides. Terms at T vanish for n ≤ q − 1; for n = q the raw
    /// last sample enters (Eq 2.10: its noise is not averaged at all); beyond, derivatives at T would.
    ///
    /// # Errors
    /// [`AlgebraicError::InitialConditions`], [`AlgebraicError::EndDerivatives`], [`AlgebraicError::Window`].
    pub fn weights(&self, order: usize, hold: Hold) -> Result<Weights, AlgebraicError> {
        check_order(self.s_derivatives, self.integrations, self.initial, order)?;
        let needed = hold.min_intervals().max(order + 1);
        if self.intervals < needed {
            return Err(AlgebraicError::Window { intervals: self.intervals, order, needed });
        }
        let m = self.intervals as f64;
        let degree = self.s_derivatives + self.integrations - 1;
        let mut values = vec![0.0; self.samples()];
        // Every wⁿ beyond the degree is zero: n ≤ r + 1 ≤ degree + 1 unless initial conditions are separate.
        if order <= degree {
            let rule = StepRule::new(hold, degree - order);
            for step in 0..self.intervals {
                let (first, basis) = rule.at(step, self.intervals);
                for (&(s, gauss), basis) in rule.points.iter().zip(basis) {
                    let u = (step as f64 + s) / m;
                    let rest = ((self.intervals - step) as f64 - s) / m;
                    let kernel = sign(order) * self.dt * gauss * self.derivative(order, u, rest);
                    for i in 0..rule.width() {
                        values[first + i] += kernel * basis[i];
                    }
                }
            }
        }
        if order == self.integrations {
            values[self.intervals] += sign(order - 1) * self.derivative(order - 1, 1.0, 0.0);
        }
        if self.initial == Initial::FirstSample
            && let [factor] = self.initial_factors(order)[..]
        {
            values[0] += factor;
        }
        Ok(Weights { order, hold, values })
    }
}

/// Quadrature weights vᵢ of one kind of column, i = 0 … M: a row is Σ vᵢ y(start + i).
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    order: usize,
    hold: Hold,
    values: Vec<f64>,
}

impl Weights {
    /// Weights that have been made elsewhere.
    pub(crate) fn from_values(order: usize, hold: Hold, values: Vec<f64>) -> Self {
        Self { order, hold, values }
    }

    /// Order n of the derivative. Unit of the weights: 1/sⁿ.
    pub fn order(&self) -> usize {
        self.order
    }

    /// How the samples are joined.
    pub fn hold(&self) -> Hold {
        self.hold
    }

    /// The weights, one per sample of the window.
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// Σ vᵢ yᵢ over one window.
    ///
    /// # Errors
    /// [`AlgebraicError::SliceLength`] unless `window` has as many samples as there are weights.
    pub fn apply(&self, window: &[f64]) -> Result<f64, AlgebraicError> {
        if window.len() != self.values.len() {
            return Err(AlgebraicError::SliceLength {
                what: "the window",
                found: window.len(),
                expected: self.values.len(),
            });
        }
        Ok(dot(&self.values, window))
    }
}

/// Σ aᵢ bᵢ by eight running sums, which the compiler turns into vector instructions.
///
/// Batch and stream both come here, so that their rows agree to the last bit.
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    const LANES: usize = 8;
    let (a_blocks, a_rest) = a.as_chunks::<LANES>();
    let (b_blocks, b_rest) = b.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for (a, b) in a_blocks.iter().zip(b_blocks) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7])) + rest
}

/// Whether r, q and Δt make a kernel.
pub(crate) fn check(s_derivatives: usize, integrations: usize, dt: f64) -> Result<(), AlgebraicError> {
    if !(dt.is_finite() && dt > 0.0) {
        return Err(AlgebraicError::Step { dt });
    }
    if integrations == 0 {
        return Err(AlgebraicError::NoIntegration);
    }
    let degree = s_derivatives.saturating_add(integrations - 1);
    if degree > MAX_DEGREE {
        return Err(AlgebraicError::Degree { s_derivatives, integrations, degree, highest: MAX_DEGREE });
    }
    Ok(())
}

/// Whether a derivative of `order` can be removed by r derivatives by s and q integrations.
pub(crate) fn check_order(
    s_derivatives: usize,
    integrations: usize,
    initial: Initial,
    order: usize,
) -> Result<(), AlgebraicError> {
    let highest = match initial {
        Initial::Eliminated => s_derivatives,
        Initial::FirstSample => s_derivatives + 1,
        Initial::Separate => usize::MAX,
    };
    if order > integrations {
        return Err(AlgebraicError::EndDerivatives { order, integrations });
    }
    if order > highest {
        return Err(AlgebraicError::InitialConditions { order, s_derivatives });
    }
    Ok(())
}

/// T^(r+q) r!/(r+q)!, the integral of τ^r (T−τ)^(q−1)/(q−1)!.
pub(crate) fn scale(s_derivatives: usize, integrations: usize, duration: f64) -> f64 {
    duration.powi((s_derivatives + integrations) as i32) / falling(s_derivatives + integrations, integrations)
}

/// dʲ/duʲ of u^r v^p with v = 1 − u, by Leibniz's rule: no powers that cancel each other.
fn product_derivative(r: usize, p: usize, order: usize, u: f64, v: f64) -> f64 {
    (order.saturating_sub(p)..=order.min(r))
        .map(|k| {
            let i = order - k;
            sign(i)
                * binomial(order, k)
                * (falling(r, k) * u.powi((r - k) as i32))
                * (falling(p, i) * v.powi((p - i) as i32))
        })
        .sum()
}

/// (−1)ⁿ.
pub(crate) fn sign(n: usize) -> f64 {
    if n.is_multiple_of(2) { 1.0 } else { -1.0 }
}

/// n (n−1) … (n−k+1).
pub(crate) fn falling(n: usize, k: usize) -> f64 {
    (0..k).map(|i| n as f64 - i as f64).product()
}

/// n!.
pub(crate) fn factorial(n: usize) -> f64 {
    falling(n, n)
}

/// n over k.
pub(crate) fn binomial(n: usize, k: usize) -> f64 {
    falling(n, k) / factorial(k)
}
