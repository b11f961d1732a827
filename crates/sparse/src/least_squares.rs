//! Least squares: Cholesky on a normalised Gram matrix where that is safe, Householder QR of the rows elsewhere.

use std::ops::Range;

use faer::Mat;

use crate::SparseError;
use crate::design::{Design, count};
use crate::gram::Normalised;

/// Smallest pivot of the Cholesky factor of a unit-diagonal Gram matrix that is trusted. The pivot is the squared
/// sine of the angle between a column and the span of those before it; the solution's relative error is about
/// ε/pivot, so 1e-9 leaves six digits for the decisions of a selector (final refits use the rows).
const SAFE_PIVOT: f64 = 1e-9;

/// Sine of the angle to the span of the other columns below which a column counts as dependent.
const DEPENDENT: f64 = 1e-12;

/// Lower Cholesky factor of the active part of ρ (k × k), row by row packed (row i has i + 1 entries), or `None`
/// when a pivot is below [`SAFE_PIVOT`].
pub(crate) fn cholesky(correlation: &[f64], k: usize, active: &[usize]) -> Option<Vec<f64>> {
    let m = active.len();
    let mut l = vec![0.0; m * (m + 1) / 2];
    for i in 0..m {
        let row = i * (i + 1) / 2;
        for j in 0..=i {
            let other = j * (j + 1) / 2;
            let dot: f64 = (0..j).map(|q| l[row + q] * l[other + q]).sum();
            let value = correlation[active[j] * k + active[i]] - dot;
            if i == j {
                if value < SAFE_PIVOT {
                    return None;
                }
                l[row + j] = value.sqrt();
            } else {
                l[row + j] = value / l[other + j];
            }
        }
    }
    Some(l)
}

/// Solve L Lᵀ x = b in place for a packed lower factor.
pub(crate) fn cholesky_back(l: &[f64], x: &mut [f64]) {
    let m = x.len();
    for i in 0..m {
        let row = i * (i + 1) / 2;
        let dot: f64 = (0..i).map(|j| l[row + j] * x[j]).sum();
        x[i] = (x[i] - dot) / l[row + i];
    }
    for i in (0..m).rev() {
        let row = i * (i + 1) / 2;
        x[i] /= l[row + i];
        let value = x[i];
        for j in 0..i {
            x[j] -= l[row + j] * value;
        }
    }
}

/// β of the active columns, or `None` where the Gram matrix is too ill conditioned.
pub(crate) fn cholesky_solve(normalised: &Normalised, active: &[usize]) -> Option<Vec<f64>> {
    let l = cholesky(&normalised.correlation, normalised.columns, active)?;
    let mut beta: Vec<f64> = active.iter().map(|&j| normalised.cross[j]).collect();
    cholesky_back(&l, &mut beta);
    Some(beta)
}

/// Upper triangular factor T of Z = [a₀ … a_{k−1} p]: ‖Z v‖ = ‖T v‖ for every v, so T stands for the rows.
#[derive(Debug, Clone)]
pub(crate) struct Reduced {
    /// k + 1.
    size: usize,
    /// Columns of T, `size` values each; the target is last.
    columns: Vec<Vec<f64>>,
    /// Powers of two of the columns (target first).
    scale: Vec<f64>,
}

impl Reduced {
    pub(crate) fn new(design: &Design<'_>, pieces: &[(Range<usize>, f64)]) -> Self {
        let size = design.columns() + 1;
        let ranges: Vec<_> = pieces.iter().map(|(r, _)| r.clone()).collect();
        let rows = count(&ranges);
        let mut z = Mat::<f64>::zeros(rows.max(size), size);
        for j in 0..size {
            let source = if j + 1 == size { 0 } else { j + 1 };
            let (values, factor) = (design.augmented(source), 1.0 / design.scale()[source]);
            let mut at = 0;
            for (range, weight) in pieces {
                let factor = factor * weight.sqrt();
                for a in &values[range.clone()] {
                    z[(at, j)] = a * factor;
                    at += 1;
                }
            }
        }
        let qr = z.qr();
        let r = qr.thin_R();
        let columns =
            (0..size).map(|j| (0..size).map(|i| if i <= j { r[(i, j)] } else { 0.0 }).collect()).collect();
        Self { size, columns, scale: design.scale().to_vec() }
    }

    /// Coefficients (own units) of the active columns by Householder QR of their columns of T.
    pub(crate) fn solve(&self, active: &[usize], rows: f64) -> Result<Vec<f64>, SparseError> {
        let m = active.len();
        if rows < m as f64 {
            return Err(SparseError::TooFewRows { rows: rows as usize, unknowns: m });
        }
        let (triangle, mut q, norms) = self.triangle(active)?;
        for i in (0..m).rev() {
            q[i] /= triangle[i][i];
            let value = q[i];
            for j in 0..i {
                q[j] -= triangle[i][j] * value;
            }
        }
        let unit = |i: usize| self.scale[0] / (norms[i] * self.scale[active[i] + 1]);
        Ok((0..m).map(|i| q[i] * unit(i)).collect())
    }

    /// Column-normalised triangular factor of the active columns: its columns (m values each), the rotated
    /// target (m values, then one more: the norm of the residual) and the columns' norms.
    #[allow(clippy::type_complexity)] // one factorisation with its three parts, taken apart at once
    pub(crate) fn triangle(
        &self,
        active: &[usize],
    ) -> Result<(Vec<Vec<f64>>, Vec<f64>, Vec<f64>), SparseError> {
        let m = active.len();
        let mut work: Vec<Vec<f64>> = active.iter().map(|&j| self.columns[j].clone()).collect();
        let mut target = self.columns[self.size - 1].clone();
        let norms: Vec<f64> = work.iter().map(|c| norm(c)).collect();
        for (column, n) in work.iter_mut().zip(&norms) {
            column.iter_mut().for_each(|v| *v /= n.max(f64::MIN_POSITIVE));
        }
        for i in 0..m {
            let dependent = || SparseError::RankDeficient {
                column: active[i],
                others: active.iter().copied().filter(|&j| j != active[i]).collect(),
            };
            let length = norm(&work[i][i..]);
            if length.is_nan() || length <= DEPENDENT {
                return Err(dependent());
            }
            let (head, tail) = work.split_at_mut(i + 1);
            let pivot = &mut head[i];
            let alpha = if pivot[i] > 0.0 { -length } else { length };
            let mut v = pivot[i..].to_vec();
            v[0] -= alpha;
            let square: f64 = v.iter().map(|x| x * x).sum();
            for column in tail.iter_mut().chain(std::iter::once(&mut target)) {
                let dot: f64 = v.iter().zip(&column[i..]).map(|(a, b)| a * b).sum();
                let factor = 2.0 * dot / square;
                column[i..].iter_mut().zip(&v).for_each(|(c, v)| *c -= factor * v);
            }
            pivot[i] = alpha;
            pivot[i + 1..].fill(0.0);
        }
        for column in &mut work {
            column.truncate(m);
        }
        let rest = norm(&target[m..]);
        target.truncate(m);
        target.push(rest);
        Ok((work, target, norms))
    }

    /// ‖p − Σ cⱼ aⱼ‖² without the cancellation of a Gram matrix.
    pub(crate) fn rss(&self, coefficients: &[f64]) -> f64 {
        let mut r = self.columns[self.size - 1].clone();
        for (j, c) in coefficients.iter().enumerate() {
            let c = c * (self.scale[j + 1] / self.scale[0]);
            if c != 0.0 {
                r.iter_mut().zip(&self.columns[j]).for_each(|(r, a)| *r -= c * a);
            }
        }
        r.iter().map(|v| v * v).sum::<f64>() * self.scale[0] * self.scale[0]
    }
}

fn norm(v: &[f64]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Ordinary least squares p ≈ Σ cⱼ aⱼ over the columns `active` on the given rows: column-normalised
/// Householder QR of those rows, never normal equations. The result has one coefficient per column of the
/// design, zero outside `active`.
///
/// # Errors
/// [`SparseError::RankDeficient`], [`SparseError::TooFewRows`], [`SparseError::NoSuchColumn`],
/// [`SparseError::NoSuchRows`].
///
/// ```
/// let (a, b) = ([1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 2.0, 3.0]);
/// let p = [1.0, 3.0, 5.0, 7.0];
/// let design = greybox_sparse::Design::new(&[&a, &b], &p)?;
/// let c = greybox_sparse::least_squares(&design, &[0, 1], &[0..4])?;
/// assert!((c[0] - 1.0).abs() < 1e-14 && (c[1] - 2.0).abs() < 1e-14);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn least_squares(
    design: &Design<'_>,
    active: &[usize],
    rows: &[Range<usize>],
) -> Result<Vec<f64>, SparseError> {
    design.check_rows(rows)?;
    Design::check_columns("the active set", active, design.columns())?;
    let mut full = vec![0.0; design.columns()];
    if active.is_empty() {
        return Ok(full);
    }
    let columns: Vec<&[f64]> = active.iter().map(|&j| design.column(j)).collect();
    let part = Design::new(&columns, design.target())?;
    let pieces: Vec<_> = rows.iter().map(|r| (r.clone(), 1.0)).collect();
    let all: Vec<usize> = (0..active.len()).collect();
    let solved = Reduced::new(&part, &pieces).solve(&all, count(rows) as f64).map_err(|e| match e {
        SparseError::RankDeficient { column, others } => SparseError::RankDeficient {
            column: active[column],
            others: others.iter().map(|&j| active[j]).collect(),
        },
        other => other,
    })?;
    for (&j, c) in active.iter().zip(solved) {
        full[j] = c;
    }
    Ok(full)
}
