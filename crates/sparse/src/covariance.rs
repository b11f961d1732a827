//! Covariance of least-squares coefficients whose rows are correlated.

use std::ops::Range;

use crate::SparseError;
use crate::design::{Design, count};
use crate::gram::Sample;
use crate::least_squares::{cholesky, cholesky_back};

/// How many lags of the scores enter the Newey–West sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bandwidth {
    /// This many; 0 gives the heteroskedasticity-consistent (White) covariance.
    Lags(usize),
    /// Andrews' AR(1) plug-in for the Bartlett kernel, 1.1447 (α n)^⅓ (doi:10.2307/2938229).
    Andrews,
}

/// Newey–West (HAC, sandwich) covariance of the coefficients fitted on the columns `active`:
///
/// ```text
/// V = n/(n−k) · G⁻¹ S G⁻¹ ,   G = Σ aₜaₜᵀ ,   S = Γ₀ + Σ_{l=1}^{L} (1 − l/(L+1)) (Γ_l + Γ_lᵀ) ,
/// Γ_l = Σ_t (aₜeₜ)(aₜ₋ₗeₜ₋ₗ)ᵀ ,
/// ```
///
/// products never across the end of a range of `rows` (doi:10.2307/1913610). `coefficients` has one value per
/// column of the design; they need not be the ones refitted. The result is k × k, row by row in the order of
/// `active`, in the coefficients' units.
///
/// # Errors
/// [`SparseError::RankDeficient`], [`SparseError::TooFewRows`] when n ≤ k, [`SparseError::Length`].
pub fn newey_west(
    design: &Design<'_>,
    active: &[usize],
    coefficients: &[f64],
    rows: &[Range<usize>],
    bandwidth: Bandwidth,
) -> Result<Vec<Vec<f64>>, SparseError> {
    Design::check_columns("the active set", active, design.columns())?;
    if coefficients.len() > design.columns() {
        return Err(SparseError::Length {
            what: "the list of coefficients".into(),
            found: coefficients.len(),
            expected: design.columns(),
        });
    }
    let (n, k) = (count(rows), active.len());
    if n <= k {
        return Err(SparseError::TooFewRows { rows: n, unknowns: k });
    }
    let sample = Sample::new(design, rows)?;
    let normalised = sample.normalised(design.columns());
    let l = cholesky(&normalised.correlation, normalised.columns, active).ok_or_else(|| {
        SparseError::RankDeficient {
            column: active.last().copied().unwrap_or(0),
            others: active.iter().copied().take(k.saturating_sub(1)).collect(),
        }
    })?;
    // Scores of normalised columns, range by range.
    let residual = design.residual(coefficients, rows);
    let norm: Vec<f64> = active.iter().map(|&j| sample.gram().product(j, j).sqrt()).collect();
    let mut scores: Vec<Vec<Vec<f64>>> = Vec::new();
    let mut at = 0;
    for range in rows {
        let e = &residual[at..at + range.len()];
        let columns = active
            .iter()
            .zip(&norm)
            .map(|(&j, n)| design.column(j)[range.clone()].iter().zip(e).map(|(a, e)| a / n * e).collect());
        scores.push(columns.collect());
        at += range.len();
    }
    let lagged = |i: usize, j: usize, lag: usize| -> f64 {
        scores
            .iter()
            .filter(|s| s[i].len() > lag)
            .map(|s| s[i][lag..].iter().zip(&s[j]).map(|(a, b)| a * b).sum::<f64>())
            .sum()
    };
    let lags = match bandwidth {
        Bandwidth::Lags(lags) => lags,
        Bandwidth::Andrews => andrews((0..k).map(|i| (lagged(i, i, 0), lagged(i, i, 1))), n),
    };
    let mut meat = vec![vec![0.0; k]; k];
    for i in 0..k {
        for j in 0..k {
            meat[i][j] = lagged(i, j, 0);
            for lag in 1..=lags.min(n - 1) {
                let weight = 1.0 - lag as f64 / (lags as f64 + 1.0);
                meat[i][j] += weight * (lagged(i, j, lag) + lagged(j, i, lag));
            }
        }
    }
    // G⁻¹ S G⁻¹: solve for the columns, then for the rows (S is symmetric).
    for _ in 0..2 {
        for row in &mut meat {
            cholesky_back(&l, row);
        }
        meat = (0..k).map(|j| meat.iter().map(|row| row[j]).collect()).collect();
    }
    let correction = n as f64 / (n - k) as f64;
    for (row, a) in meat.iter_mut().zip(&norm) {
        row.iter_mut().zip(&norm).for_each(|(v, b)| *v *= correction / (a * b));
    }
    Ok(meat)
}

/// α = Σ 4ρᵢ²σᵢ⁴/((1−ρᵢ)⁶(1+ρᵢ)²) / Σ σᵢ⁴/(1−ρᵢ)⁴ with equal weights, from (Γ₀, Γ₁) of every score.
fn andrews(moments: impl Iterator<Item = (f64, f64)>, n: usize) -> usize {
    let (mut above, mut below) = (0.0, 0.0);
    for (zero, one) in moments.filter(|m| m.0 > 0.0) {
        let rho = (one / zero).clamp(-0.97, 0.97);
        let innovation = (zero * (1.0 - rho * rho)).powi(2);
        above += 4.0 * rho * rho * innovation / ((1.0 - rho).powi(6) * (1.0 + rho).powi(2));
        below += innovation / (1.0 - rho).powi(4);
    }
    if below > 0.0 { (1.1447 * (above / below * n as f64).cbrt()).ceil() as usize } else { 0 }
}
