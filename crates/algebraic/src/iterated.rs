//! The thesis's signals as printed: iterated integrals that grow from the start of a window (Eq 2.10, 3.10).
//!
//! For every derivative order n, r derivatives by s and q integrations, the inverse Laplace transform of
//! (−1)^r s^(−q) dʳ/dsʳ \[sⁿ Y(s)\] is
//!
//! ```text
//! P(t) = Σ_{i=0}^{min(r,n)} (−1)^i C(r, i) n!/(n−i)! I^(q−n+i)[t^(r−i) y] ,   q ≥ n ,
//! ```
//!
//! where I^m is the m-fold integral from the start of the window and I⁰ the signal itself. P equals
//! I^q\[t^r y⁽ⁿ⁾\] but for initial conditions, which stay when n > r:
//!
//! ```text
//! I^q[t^r y⁽ⁿ⁾] = P(t) − Σ_{k=0}^{n−r−1} (−1)^r m!/(m−r)! t^(q+r−1−m)/(q+r−1−m)! y⁽ᵏ⁾(0) ,   m = n − 1 − k .
//! ```
//!
//! Thesis Eq 2.10 is r = q = 2 with n = 2, 1, 0; Eq 3.10 is r = 2, q = 3 with n = 3 … 0, and its P₁ keeps x₀ t²
//! (erratum E13).
//!
//! The integrals are exact for the joined signal ([`Hold`]): over one step the m-fold integrals are carried
//! forward by Taylor's formula with its integral remainder. At the end of a window P is therefore
//! [`Kernel::scale`](crate::Kernel::scale) times the row of the [`Kernel`](crate::Kernel) of that window. For
//! identification the windowed rows are better: P grows like t^(q+r) and gives neighbouring rows the same past.

use crate::error::AlgebraicError;
use crate::kernel::{Initial, binomial, check, check_order, factorial, falling, sign};
use crate::quadrature::{Hold, StepRule};
use crate::windows::{Column, Rows, check_pieces};

/// The iterated-integral form of the algebraic method: r derivatives by s, q integrations.
#[derive(Debug, Clone, PartialEq)]
pub struct Iterated {
    s_derivatives: usize,
    integrations: usize,
    dt: f64,
    initial: Initial,
}

/// Where the integrals start anew, and which of their values become rows. All in samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Restart {
    /// Steps of one window.
    pub intervals: usize,
    /// From the start of one window to the next.
    pub hop: usize,
    /// From one row to the next within a window; the first row is this far from the window's start, where every
    /// signal is zero.
    pub every: usize,
}

impl Iterated {
    /// The form of `s_derivatives` (r) and `integrations` (q) for samples every `dt` s.
    ///
    /// # Errors
    /// [`AlgebraicError::Step`], [`AlgebraicError::NoIntegration`], [`AlgebraicError::Degree`].
    pub fn new(s_derivatives: usize, integrations: usize, dt: f64) -> Result<Self, AlgebraicError> {
        check(s_derivatives, integrations, dt)?;
        Ok(Self { s_derivatives, integrations, dt, initial: Initial::Eliminated })
    }

    /// The same form with another treatment of remaining initial conditions. [`Initial::Separate`] leaves them
    /// in: the signals exactly as the thesis prints them.
    #[must_use]
    pub fn with_initial(self, initial: Initial) -> Self {
        Self { initial, ..self }
    }

    /// P(tₖ), tₖ = k Δt, for every sample of one window that starts at the signal's first sample.
    ///
    /// Unit: that of the signal times s^(q+r−n). A missing sample (NaN) makes P NaN from there on. With
    /// [`Hold::Smooth`] P looks at most two samples ahead.
    ///
    /// # Errors
    /// [`AlgebraicError::InitialConditions`], [`AlgebraicError::EndDerivatives`], [`AlgebraicError::Window`].
    pub fn signal(&self, y: &[f64], order: usize, hold: Hold) -> Result<Vec<f64>, AlgebraicError> {
        check_order(self.s_derivatives, self.integrations, self.initial, order)?;
        let (r, q) = (self.s_derivatives, self.integrations);
        let needed = hold.min_intervals();
        if y.len() < needed + 1 {
            return Err(AlgebraicError::Window { intervals: y.len().saturating_sub(1), order, needed });
        }
        // Time runs in steps; the unit comes back at the end: every term has the same power of Δt.
        let mut signal = vec![0.0; y.len()];
        for i in 0..=r.min(order) {
            let factor = sign(i) * binomial(r, i) * falling(order, i);
            add_integral(&mut signal, factor, y, r - i, q - order + i, hold);
        }
        let unit = self.dt.powi((q + r - order) as i32);
        signal.iter_mut().for_each(|p| *p *= unit);
        if self.initial == Initial::FirstSample && order > r {
            for (k, p) in signal.iter_mut().enumerate() {
                *p -= y[0] * self.initial_factor(order, 0, k as f64 * self.dt);
            }
        }
        Ok(signal)
    }

    /// Factor of y⁽ᵏ⁾(0), k = `derivative`, that P(t) holds beyond I^q\[t^r y⁽ⁿ⁾\]; to be subtracted times y⁽ᵏ⁾(0)
    /// when it is known. 0 when n ≤ r + k: dʳ/dsʳ has removed it.
    ///
    /// For Eq 3.10's jerk (n = q = 3, r = 2, k = 0) it is t²: the fix of E13.
    pub fn initial_factor(&self, order: usize, derivative: usize, t: f64) -> f64 {
        let (r, q) = (self.s_derivatives, self.integrations);
        if order <= r + derivative || order > q {
            return 0.0;
        }
        let m = order - 1 - derivative;
        let power = q + r - 1 - m;
        sign(r) * falling(m, r) * t.powi(power as i32) / factorial(power)
    }

    /// Rows of restarted windows of one piece: row j of a window is every column's P at j · `every` samples from
    /// the window's start. Windows that do not fit into the piece are left out, and rows that are not finite
    /// (a missing sample before them in their window) are dropped and counted.
    ///
    /// One window over the whole record, as the thesis has it, is `intervals` = samples − 1.
    ///
    /// # Errors
    /// Those of [`Self::signal`] and of [`rows`](crate::rows()).
    pub fn rows(&self, columns: &[Column<'_>], restart: Restart) -> Result<Rows, AlgebraicError> {
        self.rows_of_pieces(&[columns], restart)
    }

    /// Rows of restarted windows of several pieces with the same columns; see [`Self::rows`].
    ///
    /// # Errors
    /// Those of [`Self::rows`] and [`AlgebraicError::ColumnsDiffer`].
    pub fn rows_of_pieces<'a, P: AsRef<[Column<'a>]>>(
        &self,
        pieces: &[P],
        restart: Restart,
    ) -> Result<Rows, AlgebraicError> {
        let Restart { intervals, hop, every } = restart;
        if hop == 0 {
            return Err(AlgebraicError::Hop { what: "the hop between windows" });
        }
        if every == 0 {
            return Err(AlgebraicError::Hop { what: "the step between rows" });
        }
        if every > intervals {
            return Err(AlgebraicError::Window { intervals, order: 0, needed: every });
        }
        check_pieces(pieces, intervals.saturating_add(1))?;
        let mut rows = Rows::empty(pieces[0].as_ref().len());
        for (piece, columns) in pieces.iter().enumerate() {
            let columns = columns.as_ref();
            let samples = columns[0].signal.len();
            for start in (0..samples.saturating_sub(intervals)).step_by(hop) {
                let signals = columns
                    .iter()
                    .map(|c| self.signal(&c.signal[start..=start + intervals], c.order, c.hold))
                    .collect::<Result<Vec<_>, _>>()?;
                for k in (every..=intervals).step_by(every) {
                    if !signals.iter().all(|p| p[k].is_finite()) {
                        rows.dropped += 1;
                        continue;
                    }
                    rows.pieces.push(piece);
                    rows.starts.push(start);
                    rows.ends.push(start + k);
                    for (out, p) in rows.columns.iter_mut().zip(&signals) {
                        out.push(p[k]);
                    }
                }
            }
        }
        if rows.is_empty() {
            return Err(AlgebraicError::NoRows { dropped: rows.dropped });
        }
        Ok(rows)
    }
}

/// Adds `factor` · I^m\[t^power y\] at every sample to `signal`; time in steps.
///
/// With zⱼ = I^j\[t^power y\], one step is Taylor's formula,
/// zⱼ(k+1) = Σ_{i<j} zⱼ₋ᵢ(k)/i! + ∫₀¹ (1−σ)^(j−1)/(j−1)! (k+σ)^power y(k+σ) dσ .
fn add_integral(signal: &mut [f64], factor: f64, y: &[f64], power: usize, m: usize, hold: Hold) {
    let exponent = power as i32;
    if m == 0 {
        for (k, (p, y)) in signal.iter_mut().zip(y).enumerate() {
            *p += factor * (k as f64).powi(exponent) * y;
        }
        return;
    }
    let intervals = y.len() - 1;
    let rule = StepRule::new(hold, power + m - 1);
    // remainder[g][j−1]: Gauss weight times (1−σ)^(j−1)/(j−1)! at point g.
    let remainder: Vec<Vec<f64>> = rule
        .points
        .iter()
        .map(|&(s, w)| (0..m).map(|j| w * (1.0 - s).powi(j as i32) / factorial(j)).collect())
        .collect();
    let taylor: Vec<f64> = (0..m).map(|i| 1.0 / factorial(i)).collect();
    let mut z = vec![0.0; m];
    for k in 0..intervals {
        for j in (0..m).rev() {
            z[j] = (0..=j).map(|i| taylor[i] * z[j - i]).sum();
        }
        let (first, basis) = rule.at(k, intervals);
        for ((&(s, _), basis), remainder) in rule.points.iter().zip(basis).zip(&remainder) {
            let joined: f64 = (0..rule.width()).map(|i| basis[i] * y[first + i]).sum();
            let integrand = (k as f64 + s).powi(exponent) * joined;
            for (z, c) in z.iter_mut().zip(remainder) {
                *z += c * integrand;
            }
        }
        signal[k + 1] += factor * z[m - 1];
    }
}
