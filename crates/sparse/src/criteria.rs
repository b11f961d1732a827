//! Information criteria with an effective sample size.
//!
//! With n test rows, residual sum of squares RSS, k coefficients and effective sample size nₑ ≤ n:
//!
//! ```text
//! AIC  = nₑ ln(RSS/n) + 2k                     (thesis Eq 2.17 with nₑ = n)
//! AICc = AIC + 2k(k + 1)/(nₑ − k − 1)          (Hurvich & Tsai 1989)
//! BIC  = nₑ ln(RSS/n) + k ln nₑ                (Schwarz 1978)
//! ```
//!
//! Rows of one recording are correlated. Counting them all makes the smallest systematic change of RSS dwarf
//! the penalty, so that all criteria agree and choose too much; nₑ puts the two terms back in proportion.

use crate::error::SparseError;

/// Which criterion chooses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Criterion {
    /// Akaike's.
    #[default]
    Aic,
    /// Akaike's with the small-sample correction.
    Aicc,
    /// Schwarz's.
    Bic,
}

/// Two criteria closer than this times nₑ are a tie: RSS is not known to more digits.
pub const TIE: f64 = 1e-9;

impl Criterion {
    /// The criterion's value. A perfect fit gives −∞, an AICc with k ≥ nₑ − 1 gives +∞.
    ///
    /// # Errors
    /// [`SparseError::Empty`] without rows, [`SparseError::Option`] unless RSS ≥ 0 and 0 < nₑ ≤ n.
    pub fn value(
        self,
        rss: f64,
        rows: usize,
        effective: f64,
        coefficients: usize,
    ) -> Result<f64, SparseError> {
        if rows == 0 {
            return Err(SparseError::Empty { what: "test rows" });
        }
        crate::error::check_range("residual sum of squares", rss, 0.0, f64::MAX, "finite and not negative")?;
        let n = rows as f64;
        crate::error::check_range(
            "effective sample size",
            effective,
            f64::MIN_POSITIVE,
            n,
            "positive and at most the rows",
        )?;
        let k = coefficients as f64;
        let fit = effective * (rss / n).ln();
        Ok(match self {
            Self::Aic => fit + 2.0 * k,
            Self::Aicc if effective - k - 1.0 <= 0.0 => f64::INFINITY,
            Self::Aicc => fit + 2.0 * k + 2.0 * k * (k + 1.0) / (effective - k - 1.0),
            Self::Bic => fit + k * effective.ln(),
        })
    }
}

/// Index of the smallest value; among ties (within [`TIE`] times `effective`) the one with the fewest
/// coefficients, then the first. `None` without values.
#[must_use]
pub fn choose(values: &[f64], coefficients: &[usize], effective: f64) -> Option<usize> {
    let least = values.iter().copied().filter(|v| !v.is_nan()).reduce(f64::min)?;
    (0..values.len().min(coefficients.len()))
        .filter(|&i| values[i] == least || values[i] - least <= TIE * effective)
        .min_by_key(|&i| (coefficients[i], i))
}

/// Which moment of the series the effective sample size is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// The mean: nₑ = n / (1 + 2 Σ ρₗ). For AR(1): n (1 − φ)/(1 + φ).
    Mean,
    /// The mean square, as in RSS/n, of a Gaussian series: nₑ = n / (1 + 2 Σ ρₗ²). For AR(1):
    /// n (1 − φ²)/(1 + φ²). The one for the criteria.
    Square,
}

/// Effective sample size of correlated residuals, at least 1 and at most n.
///
/// ρₗ is the biased sample autocorrelation (divided by n, mean removed). The sum stops by Geyer's initial
/// positive sequence (Statist. Sci. 7 (1992), 473): at the first pair ρ₂ₘ + ρ₂ₘ₊₁ ≤ 0, beyond which the sample
/// autocorrelation is noise; for [`Moment::Square`] the same lags are used.
///
/// # Errors
/// [`SparseError::Empty`], [`SparseError::NotFinite`].
///
/// ```
/// use greybox_sparse::criteria::{Moment, effective_sample_size};
/// let alternating: Vec<f64> = (0..100).map(|i| if i % 2 == 0 { 1.0 } else { -1.0 }).collect();
/// assert_eq!(effective_sample_size(&alternating, Moment::Mean)?, 100.0);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn effective_sample_size(residuals: &[f64], moment: Moment) -> Result<f64, SparseError> {
    if residuals.is_empty() {
        return Err(SparseError::Empty { what: "residuals" });
    }
    if let Some(row) = crate::rows::first_not_finite(residuals) {
        return Err(SparseError::NotFinite { what: "the residual".into(), row });
    }
    let n = residuals.len();
    let mean = residuals.iter().sum::<f64>() / n as f64;
    let centred: Vec<f64> = residuals.iter().map(|r| r - mean).collect();
    let at = |lag: usize| centred[..n - lag].iter().zip(&centred[lag..]).map(|(a, b)| a * b).sum::<f64>();
    let variance = at(0);
    if variance <= 0.0 {
        return Ok(n as f64);
    }
    // 1 + 2 Σ ρ = −1 + 2 Σ over pairs from lag 0.
    let (mut sum, mut lag) = (-1.0, 0);
    while lag + 1 < n {
        let (even, odd) = (at(lag) / variance, at(lag + 1) / variance);
        if even + odd <= 0.0 {
            break;
        }
        sum += 2.0
            * match moment {
                Moment::Mean => even + odd,
                Moment::Square => even * even + odd * odd,
            };
        lag += 2;
    }
    Ok((n as f64 / sum.max(1.0)).max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::ar1;

    #[test]
    fn the_formulas() {
        let aic = Criterion::Aic.value(50.0, 100, 100.0, 3).unwrap();
        assert!((aic - (100.0 * 0.5f64.ln() + 6.0)).abs() < 1e-12);
        let aicc = Criterion::Aicc.value(50.0, 100, 100.0, 3).unwrap();
        assert!((aicc - aic - 24.0 / 96.0).abs() < 1e-12);
        let bic = Criterion::Bic.value(50.0, 100, 25.0, 3).unwrap();
        assert!((bic - (25.0 * 0.5f64.ln() + 3.0 * 25f64.ln())).abs() < 1e-12);
        assert_eq!(Criterion::Aic.value(0.0, 10, 10.0, 1).unwrap(), f64::NEG_INFINITY);
        assert_eq!(Criterion::Aicc.value(1.0, 5, 5.0, 4).unwrap(), f64::INFINITY);
        assert!(Criterion::Aic.value(f64::NAN, 10, 10.0, 1).is_err());
        assert!(Criterion::Aic.value(1.0, 10, 11.0, 1).is_err());
    }

    #[test]
    fn ties_go_to_the_smaller_model() {
        assert_eq!(choose(&[5.0, 1.0, 1.0 + 1e-8, 1.0], &[1, 4, 3, 4], 100.0), Some(2));
        assert_eq!(choose(&[f64::NEG_INFINITY, f64::NEG_INFINITY], &[3, 2], 10.0), Some(1));
        assert_eq!(choose(&[], &[], 1.0), None);
    }

    #[test]
    fn autoregressions_have_the_known_size() {
        for phi in [0.0, 0.5, 0.9] {
            for (moment, truth) in [
                (Moment::Mean, (1.0 - phi) / (1.0 + phi)),
                (Moment::Square, (1.0 - phi * phi) / (1.0 + phi * phi)),
            ] {
                let mut found: Vec<f64> = (0..21)
                    .map(|seed| effective_sample_size(&ar1(20_000, phi, seed), moment).unwrap() / 20_000.0)
                    .collect();
                found.sort_by(f64::total_cmp);
                assert!(
                    (found[10] / truth - 1.0).abs() < 0.1,
                    "phi {phi} {moment:?}: {} vs {truth}",
                    found[10]
                );
            }
        }
    }

    #[test]
    fn constants_and_single_values() {
        assert_eq!(effective_sample_size(&[2.0; 9], Moment::Mean).unwrap(), 9.0);
        assert_eq!(effective_sample_size(&[2.0], Moment::Square).unwrap(), 1.0);
        assert!(effective_sample_size(&[], Moment::Mean).is_err());
        assert!(effective_sample_size(&[f64::NAN], Moment::Mean).is_err());
    }
}
