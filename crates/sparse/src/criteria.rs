//! Information criteria and the effective number of correlated rows.

/// Information criterion for a Gaussian error of unknown variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Criterion {
    /// n ln(RSS/n) + 2k (thesis Eq 2.17, on the test rows: erratum E4).
    Aic,
    /// AIC + 2k(k+1)/(n−k−1) (Hurvich, Tsai 1989); infinite when n ≤ k+1.
    Aicc,
    /// n ln(RSS/n) + k ln n (Schwarz 1978).
    Bic,
}

impl Criterion {
    /// The value for a residual sum of squares over `rows` rows, `terms` coefficients and an effective number
    /// of rows (`rows` itself for independent rows, see [`effective_rows`]): n_eff ln(RSS/rows) + penalty(n_eff).
    ///
    /// ```
    /// use greybox_sparse::Criterion;
    /// let aic = Criterion::Aic.value(50.0, 100.0, 3, 100.0);
    /// assert!((aic - (100.0 * 0.5_f64.ln() + 6.0)).abs() < 1e-12);
    /// ```
    #[must_use]
    pub fn value(self, rss: f64, rows: f64, terms: usize, effective: f64) -> f64 {
        let k = terms as f64;
        let fit = effective * (rss / rows).max(f64::MIN_POSITIVE).ln();
        match self {
            Self::Aic => fit + 2.0 * k,
            Self::Aicc if effective > k + 1.0 => fit + 2.0 * k + 2.0 * k * (k + 1.0) / (effective - k - 1.0),
            Self::Aicc => f64::INFINITY,
            Self::Bic => fit + k * effective.max(1.0).ln(),
        }
    }
}

/// Effective number of rows of a correlated residual, pieces apart:
///
/// ```text
/// n_eff = n / (1 + 2 Σ ρ_l) ,
/// ```
///
/// ρ_l the pooled autocorrelation (mean zero assumed, products never across a piece's end), summed by Geyer's
/// initial positive sequence: pairs ρ_{2i} + ρ_{2i+1} until the first that is not positive
/// (doi:10.1214/ss/1177011137). For an AR(1) residual with coefficient φ it tends to n(1−φ)/(1+φ). At least 1,
/// at most n; it is n itself for a residual of zeros.
#[must_use]
pub fn effective_rows(pieces: &[&[f64]]) -> f64 {
    let n = pieces.iter().map(|p| p.len()).sum::<usize>();
    let energy: f64 = pieces.iter().flat_map(|p| p.iter()).map(|e| e * e).sum();
    if n == 0 || energy <= 0.0 {
        return n as f64;
    }
    let rho = |lag: usize| -> f64 {
        pieces
            .iter()
            .filter(|p| p.len() > lag)
            .map(|p| p.iter().zip(&p[lag..]).map(|(a, b)| a * b).sum::<f64>())
            .sum::<f64>()
            / energy
    };
    let longest = pieces.iter().map(|p| p.len()).max().unwrap_or(0);
    let mut sum = 0.0;
    let mut lag = 0;
    while lag + 1 < longest {
        let pair = rho(lag) + rho(lag + 1);
        if pair <= 0.0 {
            break;
        }
        sum += pair;
        lag += 2;
    }
    (n as f64 / (2.0 * sum - 1.0).max(1.0)).max(1.0)
}

/// Index of the smallest value; of values that agree to 1e-9 (relative, and absolute) the first, so that models
/// listed from small to large resolve ties towards the small one. `None` when none is finite or −∞.
///
/// ```
/// assert_eq!(greybox_sparse::criteria::smallest(&[5.0, -2.0, -2.0 - 1e-12]), Some(1));
/// ```
#[must_use]
pub fn smallest(values: &[f64]) -> Option<usize> {
    let least = values.iter().copied().filter(|v| !v.is_nan()).fold(f64::INFINITY, f64::min);
    let limit = if least.is_finite() { least + 1e-9 * (1.0 + least.abs()) } else { least };
    values.iter().position(|v| *v <= limit && *v < f64::INFINITY)
}
