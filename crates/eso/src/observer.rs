//! The observer in discrete time, one sample at a time.

use crate::{Design, EsoError};

/// How the observer is carried from one sample to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Scheme {
    /// Explicit Euler, as in the thesis: the correction of the last sample acts over the step. Cheapest; stable
    /// only for steps below [`Design::euler_limit`]; leads by half a step per derivative.
    Euler,
    /// Implicit Euler: the correction of the present sample acts over the step. Stable with any step; lags by
    /// half a step per derivative.
    Implicit,
    /// The mean of both: second order, stable with any step, with the lag of the continuous observer.
    #[default]
    Trapezoidal,
}

/// Where a known input enters.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Input {
    gain: f64,
    row: usize,
}

/// An observer of N states: ẑ₁ ≈ y, ẑ₂ ≈ y', … from samples of a noisy y.
///
/// ```
/// use greybox_eso::{Design, Observer, Scheme};
/// let mut observer = Observer::new(Design::thesis(), 1e-3, Scheme::Euler)?;
/// let mut velocity = 0.0;
/// for k in 0..1000 {
///     let position = 3.0 * 1e-3 * f64::from(k);
///     [_, velocity] = observer.update(position, 0.0);
/// }
/// assert!((velocity - 3.0).abs() < 1e-9);
/// # Ok::<(), greybox_eso::EsoError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observer<const N: usize> {
    design: Design<N>,
    step: f64,
    scheme: Scheme,
    input: Option<Input>,
    /// hⁱ βᵢ of the implicit part, with h the step (half of it for the trapezoidal rule).
    weights: [f64; N],
    z: [f64; N],
    /// The error that corrects the explicit part of the next step; none after a missing sample.
    error: Option<f64>,
    started: bool,
}

impl<const N: usize> Observer<N> {
    /// The observer for samples `step` seconds apart. It starts at the first sample, at rest: a rate that y has then is
    /// taken for a disturbance, until the start is forgotten. [`Observer::start_at`] says what is known instead.
    ///
    /// # Errors
    /// [`EsoError::Step`]; with [`Scheme::Euler`], [`EsoError::StepTooLong`]; with the others,
    /// [`EsoError::PrintedBranch`].
    pub fn new(design: Design<N>, step: f64, scheme: Scheme) -> Result<Self, EsoError> {
        if !(step > 0.0 && step.is_finite()) {
            return Err(EsoError::Step { step });
        }
        if scheme == Scheme::Euler {
            let limit = design.euler_limit();
            if step >= limit {
                return Err(EsoError::StepTooLong { step, limit });
            }
        } else if design.laws().iter().any(|law| law.jumps()) {
            return Err(EsoError::PrintedBranch);
        }
        let weights = weights(&design, scheme.implicit_part() * step);
        Ok(Self { design, step, scheme, input: None, weights, z: [0.0; N], error: None, started: false })
    }

    /// The plant is y⁽ᴺ⁾ = b u + …: the known input enters the last state, z_N' = b u − β_N fal(e).
    ///
    /// # Errors
    /// [`EsoError::InputGain`] where b is not finite.
    pub fn with_input(self, gain: f64) -> Result<Self, EsoError> {
        self.entering(gain, N.saturating_sub(1))
    }

    /// The plant is y⁽ᴺ⁻¹⁾ = b u + d and the last state is *extended*: it estimates the lumped disturbance d,
    /// everything that b u does not explain (Han's extended-state observer).
    ///
    /// # Errors
    /// [`EsoError::InputGain`] where b is not finite, [`EsoError::NothingToExtend`] where N < 2.
    pub fn with_extended_state(self, gain: f64) -> Result<Self, EsoError> {
        if N < 2 {
            return Err(EsoError::NothingToExtend);
        }
        self.entering(gain, N - 2)
    }

    fn entering(self, gain: f64, row: usize) -> Result<Self, EsoError> {
        if !gain.is_finite() {
            return Err(EsoError::InputGain { gain });
        }
        Ok(Self { input: Some(Input { gain, row }), ..self })
    }

    /// Takes the sample `y` of this instant and the input `u` that acted since the sample before; returns the
    /// estimate z at this instant.
    ///
    /// The first sample sets z₁ = y and everything else to zero. A sample that is not finite counts as missing:
    /// the observer runs on without correction. `u` plays no part without [`Observer::with_input`] or
    /// [`Observer::with_extended_state`]; one that is not finite counts as zero.
    ///
    /// Nothing is allocated; the cost is fixed but for the implicit schemes outside the linear zone, where a
    /// few Newton steps are added.
    pub fn update(&mut self, y: f64, u: f64) -> [f64; N] {
        let sample = y.is_finite().then_some(y);
        if !self.started {
            if let (Some(y), Some(first)) = (sample, self.z.first_mut()) {
                *first = y;
                self.error = Some(0.0);
                self.started = true;
            }
            return self.z;
        }
        let u = if u.is_finite() { u } else { 0.0 };
        let part = self.scheme.implicit_part();
        // The explicit part of the step, with the error of the last sample …
        self.advance((1.0 - part) * self.step, self.error.unwrap_or(0.0), u);
        // … and the implicit part, with the error that will be there at its end.
        if part > 0.0 {
            let h = part * self.step;
            let error = sample.map_or(0.0, |y| self.end_error(h, y, u));
            self.advance_implicitly(h, error, u);
            self.error = sample.map(|_| error);
        } else {
            self.error = sample.and_then(|y| self.z.first().map(|z| z - y));
        }
        self.z
    }

    /// The estimate after the last sample.
    #[must_use]
    pub fn state(&self) -> [f64; N] {
        self.z
    }

    /// Sets the estimate at the instant of the sample `y`, from where the next [`Observer::update`] goes on.
    pub fn start_at(&mut self, z: [f64; N], y: f64) {
        self.z = z;
        self.error = z.first().map(|z| z - y).filter(|e| e.is_finite());
        self.started = true;
    }

    /// Forgets everything: the next sample is the first.
    pub fn reset(&mut self) {
        self.z = [0.0; N];
        self.error = None;
        self.started = false;
    }

    /// The design.
    #[must_use]
    pub fn design(&self) -> &Design<N> {
        &self.design
    }

    /// The sample time, in s.
    #[must_use]
    pub fn step(&self) -> f64 {
        self.step
    }

    /// The scheme.
    #[must_use]
    pub fn scheme(&self) -> Scheme {
        self.scheme
    }

    /// [`Design::lag`] with what the scheme adds: minus (Euler) or plus (implicit) half a step per derivative.
    ///
    /// # Errors
    /// [`EsoError::State`] where there is no such state.
    pub fn lag(&self, state: usize) -> Result<f64, EsoError> {
        let skew = (self.scheme.implicit_part() - 0.5) * self.step;
        Ok(self.design.lag(state)? + skew * state as f64)
    }

    /// The noise of an estimate: its standard deviation over that of white noise on the samples of y, once the start is
    /// forgotten, in the linear regime. In 1/sⁱ for the state i (counted from 0).
    ///
    /// With one step z′ = A z + b y + c y′, w = z − c y has the covariance P = A P Aᵀ + d dᵀ, d = A c + b (discrete
    /// Lyapunov equation; K. J. Åström, *Introduction to Stochastic Control Theory*, 1970, ch. 3), and the estimates
    /// have P + c cᵀ.
    ///
    /// It is what [`Design::from_bandwidth`] pays for a short [`lag`](Observer::lag).
    ///
    /// ```
    /// use greybox_eso::{Design, Fal, Observer, Scheme};
    /// // An encoder with noise of 0.1 mrad, read every millisecond: the speed is then noisy by
    /// let design = Design::<3>::from_bandwidth(100.0, [Fal::LINEAR; 3])?;
    /// let observer = Observer::new(design, 1e-3, Scheme::Trapezoidal)?;
    /// let speed = 1e-4 * observer.noise_gain(1)?;
    /// assert!((speed - 3.93e-3).abs() < 0.01e-3); // 3.93 mrad/s.
    /// # Ok::<(), greybox_eso::EsoError>(())
    /// ```
    ///
    /// # Errors
    /// [`EsoError::State`] where there is no such state.
    pub fn noise_gain(&self, state: usize) -> Result<f64, EsoError> {
        if state >= N {
            return Err(EsoError::State { state, order: N });
        }
        // z_{k+1} = A z_k + b y_k + c y_{k+1}. Then w = z − c y follows w_{k+1} = A w_k + (A c + b) y_k, and w_k knows
        // nothing of y_k: cov z = cov w + c cᵀ.
        let probe = self.linearised();
        let responded = |z: [f64; N], now: f64, next: f64| {
            let mut probe = probe;
            probe.start_at(z, now);
            probe.update(next, 0.0)
        };
        let b = responded([0.0; N], 1.0, 0.0);
        let c = responded([0.0; N], 0.0, 1.0);
        // By columns.
        let a: [[f64; N]; N] = core::array::from_fn(|j| {
            responded(core::array::from_fn(|i| if i == j { 1.0 } else { 0.0 }), 0.0, 0.0)
        });
        let carried = times(&a, &c);
        let drive: [f64; N] = core::array::from_fn(|i| carried[i] + b[i]);
        let variance = stationary(a, drive, state) + c[state] * c[state];
        Ok(if variance.is_finite() { libm::sqrt(variance) } else { f64::INFINITY })
    }

    /// The observer of the linear regime, without its input.
    fn linearised(&self) -> Self {
        let linear = Self { design: self.design.linearised(), input: None, ..*self };
        Self { weights: weights(&linear.design, self.scheme.implicit_part() * self.step), ..linear }
    }

    /// The same observer for a record that is run backward in time: yʳ(τ) = y(−τ), where odd derivatives and
    /// the input to an odd one change their sign.
    pub(crate) fn backward(&self) -> Self {
        let input = self.input.map(|Input { gain, row }| {
            let gain = if row.is_multiple_of(2) { -gain } else { gain };
            Input { gain, row }
        });
        Self { input, ..*self }
    }

    /// z ← z + h ż with the error as it is.
    fn advance(&mut self, h: f64, error: f64, u: f64) {
        if h == 0.0 {
            return;
        }
        let (gains, laws) = (self.design.gains(), self.design.laws());
        for i in 0..N {
            let next = if i + 1 < N { self.z[i + 1] } else { 0.0 };
            self.z[i] += h * (next + self.drive(i, u) - gains[i] * laws[i].apply(error));
        }
    }

    /// z ← z + h ż with ż at the end, where the error is known: from the last state up.
    fn advance_implicitly(&mut self, h: f64, error: f64, u: f64) {
        let (gains, laws) = (self.design.gains(), self.design.laws());
        for i in (0..N).rev() {
            let next = if i + 1 < N { self.z[i + 1] } else { 0.0 };
            self.z[i] += h * (next + self.drive(i, u) - gains[i] * laws[i].apply(error));
        }
    }

    fn drive(&self, row: usize, u: f64) -> f64 {
        self.input.filter(|input| input.row == row).map_or(0.0, |input| input.gain * u)
    }

    /// The error at the end of an implicit step: the root of e + Σ hⁱ βᵢ falᵢ(e) = c, where c is the error
    /// that would be there without correction.
    ///
    /// The left side rises, is odd, and is concave for e > 0, so that Newton's steps from zero approach the
    /// root from below and never pass it; the first is exact in the linear regime.
    fn end_error(&self, h: f64, y: f64, u: f64) -> f64 {
        let mut free = 0.0;
        for i in (0..N).rev() {
            free = self.z[i] + h * (free + self.drive(i, u));
        }
        let target = (free - y).abs();
        let laws = self.design.laws();
        let mut e = 0.0;
        for _ in 0..MAX_NEWTON_STEPS {
            let (mut value, mut slope) = (e - target, 1.0);
            for (weight, law) in self.weights.iter().zip(&laws) {
                value += weight * law.apply(e);
                slope += weight * law.tangent(e);
            }
            let better = e - value / slope;
            // Rounding ends the rise; so does a target that is not a number.
            if better.is_nan() || better <= e * (1.0 + f64::EPSILON) {
                break;
            }
            e = better;
        }
        libm::copysign(e, free - y)
    }
}

/// hⁱ βᵢ.
fn weights<const N: usize>(design: &Design<N>, h: f64) -> [f64; N] {
    let mut weights = design.gains();
    let mut power = 1.0;
    for weight in &mut weights {
        power *= h;
        *weight *= power;
    }
    weights
}

/// A v, the matrix by columns.
fn times<const N: usize>(a: &[[f64; N]; N], v: &[f64; N]) -> [f64; N] {
    core::array::from_fn(|i| (0..N).map(|j| a[j][i] * v[j]).sum())
}

/// Doublings of the time that a covariance has had to settle; 2⁶⁴ steps are enough for a pole of 1 − 10⁻¹⁵.
const DOUBLINGS: usize = 64;

/// Entry (state, state) of the covariance P = Σ Aᵏ d dᵀ Aᵏᵀ of w_{k+1} = A w_k + d y_k with white y of variance 1, by
/// doubling: P ← P + A P Aᵀ, A ← A².
fn stationary<const N: usize>(mut a: [[f64; N]; N], d: [f64; N], state: usize) -> f64 {
    let mut p: [[f64; N]; N] = core::array::from_fn(|j| core::array::from_fn(|i| d[i] * d[j]));
    for _ in 0..DOUBLINGS {
        // Columns of A P, and then of (A (A P)ᵀ)ᵀ = A P Aᵀ by symmetry.
        let ap: [[f64; N]; N] = core::array::from_fn(|j| times(&a, &p[j]));
        let transposed: [[f64; N]; N] = core::array::from_fn(|j| core::array::from_fn(|i| ap[i][j]));
        let before = p;
        for (column, added) in p.iter_mut().zip(&transposed) {
            for (entry, more) in column.iter_mut().zip(times(&a, added)) {
                *entry += more;
            }
        }
        if p == before {
            break;
        }
        a = core::array::from_fn(|j| times(&a, &a[j]));
    }
    p[state][state]
}

/// Convergence is quadratic; a handful suffices, this many only guard the loop.
const MAX_NEWTON_STEPS: usize = 60;

impl Scheme {
    /// The share of the step that takes the derivative at its end.
    fn implicit_part(self) -> f64 {
        match self {
            Self::Euler => 0.0,
            Self::Implicit => 1.0,
            Self::Trapezoidal => 0.5,
        }
    }
}
