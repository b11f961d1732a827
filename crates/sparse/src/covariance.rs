//! Covariance of the coefficients of a refitted linear model.
//!
//! With residuals r and rows xₜ, gₜ = xₜ rₜ:
//!
//! ```text
//! cov ĉ = (PᵀP)⁻¹ S (PᵀP)⁻¹,   S = Γ₀ + Σ_{l=1..L} (1 − l/(L + 1)) (Γₗ + Γₗᵀ),   Γₗ = Σₜ gₜ gₜ₋ₗᵀ
//! ```
//!
//! (Newey & West, Econometrica 55 (1987), Bartlett weights: S is never indefinite.) L = 0 is White's
//! heteroscedasticity-consistent covariance. Products across the pieces of a recording are left out.

use std::ops::Range;

use crate::error::SparseError;
use crate::rows::{Rows, check_ranges, count};
use crate::triangle::Triangle;

/// How the correlation of the rows is taken into account.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Covariance {
    /// σ² (PᵀP)⁻¹ with σ² = RSS/(n − k): independent rows of equal variance.
    Independent,
    /// Newey–West with this many lags, times n/(n − k).
    NeweyWest {
        /// The largest lag L.
        lags: usize,
    },
}

/// Newey & West's (1994) rule of thumb for the lags, ⌊4 (n/100)^(2/9)⌋. It suits econometric series; rows of a
/// fast-sampled recording are correlated over more lags than this.
#[must_use]
pub fn rule_of_thumb_lags(rows: usize) -> usize {
    (4.0 * (rows as f64 / 100.0).powf(2.0 / 9.0)).floor() as usize
}

/// Coefficients of the least-squares model on `active` and their covariance, k × k column-major in the order of
/// `active`. Standard errors are the roots of the diagonal.
///
/// # Errors
/// [`SparseError::RowRange`], [`SparseError::NoSuchColumn`], [`SparseError::RankDeficient`],
/// [`SparseError::TooFewRows`] unless there are more rows than columns, [`SparseError::Option`] for lags beyond
/// the rows.
///
/// ```
/// use greybox_sparse::Rows;
/// use greybox_sparse::covariance::{Covariance, covariance};
/// // The mean of four values: the variance of the mean is s²/n.
/// let (one, y) = ([1.0; 4], [1.0, 2.0, 3.0, 4.0]);
/// let (mean, v) = covariance(&Rows::new(&[&one], &y)?, &[0..4], &[0], Covariance::Independent)?;
/// assert!((mean[0] - 2.5).abs() < 1e-12 && (v[0] - 5.0 / 3.0 / 4.0).abs() < 1e-12);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn covariance(
    rows: &Rows<'_>,
    ranges: &[Range<usize>],
    active: &[usize],
    kind: Covariance,
) -> Result<(Vec<f64>, Vec<f64>), SparseError> {
    check_ranges(ranges, rows.rows())?;
    let (n, k) = (count(ranges), active.len());
    if n <= k {
        return Err(SparseError::TooFewRows { what: "the set of rows".into(), found: n, needed: k + 1 });
    }
    let all = Triangle::of_rows(rows, ranges)?;
    let fit = all.fit(active)?;
    let inverse = all.select(active)?.inverse_gram()?;
    let coefficients: Vec<f64> = active.iter().map(|&j| fit.coefficients[j]).collect();
    let freedom = (n - k) as f64;
    let matrix = match kind {
        Covariance::Independent => inverse.iter().map(|v| v * fit.rss / freedom).collect(),
        Covariance::NeweyWest { lags } => {
            if lags >= n {
                return Err(SparseError::Option {
                    name: "Newey-West lags",
                    found: lags as f64,
                    expected: "fewer than the rows",
                });
            }
            // hₜ = (PᵀP)⁻¹ xₜ rₜ: the sandwich of S is the long-run sum of h, and h has balanced sizes.
            let mut sum = vec![0.0; k * k];
            for range in ranges {
                let h = influences(rows, range, active, &fit.coefficients, &inverse);
                add_long_run(&mut sum, &h, k, lags);
            }
            sum.iter().map(|v| v * n as f64 / freedom).collect()
        }
    };
    Ok((coefficients, matrix))
}

/// Rows hₜ = (PᵀP)⁻¹ xₜ rₜ of one piece, row-major.
fn influences(
    rows: &Rows<'_>,
    range: &Range<usize>,
    active: &[usize],
    coefficients: &[f64],
    inverse: &[f64],
) -> Vec<f64> {
    let k = active.len();
    let residuals = rows.residuals(coefficients, std::slice::from_ref(range));
    let mut h = vec![0.0; k * residuals.len()];
    for (t, r) in residuals.iter().enumerate() {
        for (b, &j) in active.iter().enumerate() {
            let g = rows.column(j)[range.start + t] * r;
            for a in 0..k {
                h[t * k + a] += inverse[b * k + a] * g;
            }
        }
    }
    h
}

/// Adds Γ₀ + Σ w (Γₗ + Γₗᵀ) of the rows of `h`.
fn add_long_run(sum: &mut [f64], h: &[f64], k: usize, lags: usize) {
    if k == 0 {
        return;
    }
    let n = h.len() / k;
    // Σₗ of the later rows with the weighted sum of the earlier ones.
    for lag in 0..=lags.min(n.saturating_sub(1)) {
        let weight = 1.0 - lag as f64 / (lags as f64 + 1.0);
        for (now, before) in h[lag * k..].chunks_exact(k).zip(h.chunks_exact(k)) {
            for a in 0..k {
                for b in 0..k {
                    let product = weight * now[a] * before[b];
                    sum[b * k + a] += product;
                    if lag > 0 {
                        sum[a * k + b] += product;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::testing::{ar1, design};

    #[test]
    fn equals_the_formula_written_out() {
        let (columns, y) = design(12, 2, 4);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let pieces = [0..7, 7..12];
        let (c, v) = covariance(&rows, &pieces, &[1, 0], Covariance::NeweyWest { lags: 2 }).unwrap();
        let x = |t: usize| [columns[1][t], columns[0][t]];
        let r: Vec<f64> = (0..12).map(|t| y[t] - c[0] * x(t)[0] - c[1] * x(t)[1]).collect();
        let (mut s, mut g) = ([[0.0; 2]; 2], [[0.0; 2]; 2]);
        for t in 0..12_usize {
            for u in 0..12_usize {
                let lag = t.abs_diff(u);
                if lag <= 2 && (t < 7) == (u < 7) {
                    for a in 0..2 {
                        for b in 0..2 {
                            s[a][b] += (1.0 - lag as f64 / 3.0) * x(t)[a] * r[t] * x(u)[b] * r[u];
                        }
                    }
                }
            }
            for a in 0..2 {
                for b in 0..2 {
                    g[a][b] += x(t)[a] * x(t)[b];
                }
            }
        }
        let d = g[0][0] * g[1][1] - g[0][1] * g[1][0];
        let i = [[g[1][1] / d, -g[0][1] / d], [-g[1][0] / d, g[0][0] / d]];
        for a in 0..2 {
            for b in 0..2 {
                let mut truth = 0.0;
                for e in 0..2 {
                    for f in 0..2 {
                        truth += i[a][e] * s[e][f] * i[f][b];
                    }
                }
                truth *= 12.0 / 10.0;
                assert!((v[b * 2 + a] - truth).abs() < 1e-12 * truth.abs().max(1.0));
            }
        }
    }

    #[test]
    fn correlated_rows_need_the_lags() {
        let (phi, n) = (0.9, 4000);
        let truth = ((1.0 + phi * phi) / (1.0 - phi * phi) / n as f64).sqrt();
        let (mut plain, mut hac) = (0.0, 0.0);
        for seed in 0..20 {
            let (x, e) = (ar1(n, phi, 500 + 2 * seed), ar1(n, phi, 501 + 2 * seed));
            let y: Vec<f64> = x.iter().zip(&e).map(|(x, e)| x + e).collect();
            let rows = Rows::new(&[&x], &y).unwrap();
            let error = |kind| covariance(&rows, &[0..n], &[0], kind).unwrap().1[0].sqrt() / 20.0;
            plain += error(Covariance::Independent);
            hac += error(Covariance::NeweyWest { lags: 60 });
        }
        assert!((hac / truth - 1.0).abs() < 0.15, "{}", hac / truth);
        assert!(plain / truth < 0.5, "{}", plain / truth);
    }

    #[test]
    fn bad_input_is_an_error() {
        let (columns, y) = design(5, 2, 4);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let run = |ranges: &[Range<usize>], active: &[usize], kind| covariance(&rows, ranges, active, kind);
        assert!(matches!(
            run(&[0..2], &[0, 1], Covariance::Independent),
            Err(SparseError::TooFewRows { found: 2, needed: 3, .. })
        ));
        assert!(run(&[0..5], &[7], Covariance::Independent).is_err());
        assert!(run(&[0..5], &[0], Covariance::NeweyWest { lags: 5 }).is_err());
        assert_eq!(rule_of_thumb_lags(100), 4);
    }
}
