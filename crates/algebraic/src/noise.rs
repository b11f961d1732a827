//! What measurement noise becomes in the rows, and how much the overlap of windows makes them alike.

use crate::error::AlgebraicError;
use crate::kernel::{Weights, dot};

/// Noise of rows Σ vᵢ y(start + i) when every sample of y carries white noise of standard deviation σ.
impl Weights {
    /// √Σ vᵢ²: the standard deviation of a row per unit of σ. Unit 1/sⁿ.
    pub fn gain(&self) -> f64 {
        self.overlap(0).sqrt()
    }

    /// Σ vᵢ vᵢ₊ₗ: the covariance, per σ², of two rows whose windows start `lag` samples apart.
    pub fn overlap(&self, lag: usize) -> f64 {
        let v = self.values();
        let lag = lag.min(v.len());
        dot(&v[lag..], &v[..v.len() - lag])
    }

    /// Correlation of two rows whose windows start `lag` samples apart; 0 once they do not overlap.
    pub fn correlation(&self, lag: usize) -> f64 {
        self.overlap(lag) / self.overlap(0)
    }

    /// Effective number of independent rows among `rows` rows, `hop` samples apart,
    ///
    /// ```text
    /// n_eff = n / (1 + 2 Σ_{k=1}^{n−1} (1 − k/n) ρₖ²) ,   ρₖ = correlation(k hop) ,
    /// ```
    ///
    /// which is (tr R)²/tr R² of the rows' correlation matrix R: the residual sum of squares of the n correlated
    /// rows scatters like that of n_eff independent ones (Satterthwaite 1946, doi:10.2307/3002019). It takes the
    /// place of n in an information criterion, n_eff ln(RSS/n) + penalty. 1 ≤ n_eff ≤ n; 0 for no rows. A
    /// `hop` of 0 repeats one row: 1.
    pub fn effective_rows(&self, rows: usize, hop: usize) -> f64 {
        if rows == 0 {
            return 0.0;
        }
        if hop == 0 {
            return 1.0;
        }
        let n = rows as f64;
        let overlapping = (self.values().len() - 1) / hop;
        let alike: f64 = (1..=overlapping.min(rows - 1))
            .map(|k| (1.0 - k as f64 / n) * self.correlation(k * hop).powi(2))
            .sum();
        n / (1.0 + 2.0 * alike)
    }

    /// Weights of Σ cⱼ columnⱼ of one and the same signal: with `terms` (c, k), (b, k'), … of the linear part of
    /// an equation, the noise of the equation's residual. The order and the hold are those of the first.
    ///
    /// # Errors
    /// [`AlgebraicError::NoColumns`]; [`AlgebraicError::SliceLength`] for weights of windows that differ.
    pub fn combined(terms: &[(f64, &Self)]) -> Result<Self, AlgebraicError> {
        let (_, first) = terms.first().ok_or(AlgebraicError::NoColumns { piece: 0 })?;
        let mut values = vec![0.0; first.values().len()];
        for (factor, weights) in terms {
            if weights.values().len() != values.len() {
                return Err(AlgebraicError::SliceLength {
                    what: "a term's list of weights",
                    found: weights.values().len(),
                    expected: values.len(),
                });
            }
            for (sum, v) in values.iter_mut().zip(weights.values()) {
                *sum += factor * v;
            }
        }
        Ok(Self::from_values(first.order(), first.hold(), values))
    }
}
