//! Subset selection on the triangular factor: backward elimination and the best subset of every size.

use crate::SparseError;
use crate::design::Design;
use crate::gram::Sample;
use crate::least_squares::cholesky;
use crate::stlsq::live_columns;

/// Most optional columns for which [`best_subsets`] enumerates.
pub const EXHAUSTIVE_LIMIT: usize = 16;

/// Subset of every size, from all columns down to the protected ones: at every step the column goes whose
/// loss raises the residual sum of squares least. The coefficients are refitted.
///
/// # Errors
/// [`SparseError::RankDeficient`], [`SparseError::NoSuchColumn`].
pub fn backward(
    sample: &Sample<'_>,
    columns: usize,
    protected: &[usize],
) -> Result<Vec<Vec<f64>>, SparseError> {
    let mut triangle = Triangle::new(sample, columns, protected)?;
    let mut supports = vec![triangle.names.clone()];
    while let Some(at) = triangle.cheapest(protected) {
        triangle.delete(at);
        supports.push(triangle.names.clone());
    }
    fit(sample, columns, &supports)
}

/// Best subset of every size (smallest residual sum of squares), from all columns down to the protected ones,
/// by the dropping-column tree with bounds (Gatu, Kontoghiorghes 2006, doi:10.1198/106186006X100290).
///
/// # Errors
/// [`SparseError::TooManyColumns`] beyond [`EXHAUSTIVE_LIMIT`] optional columns; as [`backward`].
pub fn best_subsets(
    sample: &Sample<'_>,
    columns: usize,
    protected: &[usize],
) -> Result<Vec<Vec<f64>>, SparseError> {
    let triangle = Triangle::new(sample, columns, protected)?;
    let (all, fixed) = (triangle.names.len(), triangle.fixed);
    if all - fixed > EXHAUSTIVE_LIMIT {
        return Err(SparseError::TooManyColumns { found: all - fixed, limit: EXHAUSTIVE_LIMIT });
    }
    let mut best: Vec<(f64, Vec<usize>)> = vec![(f64::INFINITY, Vec::new()); all + 1];
    descend(&triangle, fixed, &mut best);
    let supports: Vec<_> = (fixed..=all)
        .rev()
        .map(|size| {
            let mut names = std::mem::take(&mut best[size].1);
            names.sort_unstable();
            names
        })
        .collect();
    fit(sample, columns, &supports)
}

fn fit(sample: &Sample<'_>, columns: usize, supports: &[Vec<usize>]) -> Result<Vec<Vec<f64>>, SparseError> {
    let normalised = sample.normalised(columns);
    supports
        .iter()
        .map(|active| {
            let mut full = vec![0.0; columns];
            for (&j, c) in active.iter().zip(sample.solve(active, &normalised)?) {
                full[j] = c;
            }
            Ok(full)
        })
        .collect()
}

/// Visit the node and every node got by deleting a column at position `from` or later. The leading parts of a
/// triangle are models of their own: their RSS is the tail of the rotated target.
fn descend(node: &Triangle, from: usize, best: &mut [(f64, Vec<usize>)]) {
    let m = node.names.len();
    let mut rss = node.rest;
    for size in (node.fixed..=m).rev() {
        if rss < best[size].0 {
            best[size] = (rss, node.names[..size].to_vec());
        }
        if size > 0 {
            rss += node.target[size - 1].powi(2);
        }
    }
    // Below this node sizes from+1 .. m−1 occur (sizes ≤ from were leading parts); none fits better than the node.
    for at in from..m.saturating_sub(1) {
        if (at.max(node.fixed)..m).all(|size| best[size].0 <= node.rest) {
            return;
        }
        let mut child = node.clone();
        child.delete(at);
        descend(&child, at, best);
    }
}

/// Upper triangular R and rotated target q of the columns `names`: RSS = rest + 0, and ‖q − R β‖² the loss.
#[derive(Debug, Clone)]
struct Triangle {
    names: Vec<usize>,
    /// Leading columns never deleted.
    fixed: usize,
    /// Column c has its entries 0 ..= c (a few more while a rotation is under way).
    columns: Vec<Vec<f64>>,
    target: Vec<f64>,
    rest: f64,
}

impl Triangle {
    fn new(sample: &Sample<'_>, columns: usize, protected: &[usize]) -> Result<Self, SparseError> {
        sample.check_size(columns)?;
        Design::check_columns("the protected list", protected, columns)?;
        let normalised = sample.normalised(columns);
        let live = live_columns(&normalised, protected)?;
        let mut names: Vec<usize> = live.iter().copied().filter(|j| protected.contains(j)).collect();
        let fixed = names.len();
        names.extend(live.iter().copied().filter(|j| !protected.contains(j)));
        let m = names.len();
        if let Some(l) = cholesky(&normalised.correlation, normalised.columns, &names) {
            let columns = (0..m).map(|i| l[i * (i + 1) / 2..(i + 1) * (i + 2) / 2].to_vec()).collect();
            let mut target: Vec<f64> = names.iter().map(|&j| normalised.cross[j]).collect();
            for i in 0..m {
                let row = i * (i + 1) / 2;
                let dot: f64 = (0..i).map(|j| l[row + j] * target[j]).sum();
                target[i] = (target[i] - dot) / l[row + i];
            }
            let rest = (1.0 - target.iter().map(|q| q * q).sum::<f64>()).max(0.0);
            if rest > 1e-9 {
                return Ok(Self { names, fixed, columns, target, rest });
            }
        }
        let (mut columns, mut target, _) = sample.reduced().triangle(&names)?;
        for (i, column) in columns.iter_mut().enumerate() {
            column.truncate(i + 1);
        }
        let rest = target.pop().map_or(0.0, |r| r * r);
        Ok(Self { names, fixed, columns, target, rest })
    }

    /// Position of the optional column whose deletion costs least: βᵢ²/[(RᵀR)⁻¹]ᵢᵢ.
    fn cheapest(&self, protected: &[usize]) -> Option<usize> {
        let m = self.names.len();
        let mut best: Option<(f64, usize)> = None;
        // Rows of R⁻¹ from unit vectors: Rᵀ y = eᵢ gives column i of R⁻ᵀ, whose entries start at i.
        for i in 0..m {
            let mut y = vec![0.0; m];
            y[i] = 1.0 / self.columns[i][i];
            for c in i + 1..m {
                let dot: f64 = (i..c).map(|r| self.columns[c][r] * y[r]).sum();
                y[c] = -dot / self.columns[c][c];
            }
            let beta: f64 = y.iter().zip(&self.target).map(|(y, q)| y * q).sum();
            let cost = beta * beta / y.iter().map(|v| v * v).sum::<f64>();
            if !protected.contains(&self.names[i]) && best.is_none_or(|(least, _)| cost < least) {
                best = Some((cost, i));
            }
        }
        best.map(|(_, i)| i)
    }

    /// Delete the column at a position and restore the triangle by Givens rotations.
    fn delete(&mut self, at: usize) {
        self.names.remove(at);
        self.columns.remove(at);
        for row in at..self.names.len() {
            let (a, b) = (self.columns[row][row], self.columns[row][row + 1]);
            let h = a.hypot(b);
            let (c, s) = (a / h, b / h);
            for column in &mut self.columns[row..] {
                let (u, v) = (column[row], column[row + 1]);
                column[row] = c * u + s * v;
                column[row + 1] = c * v - s * u;
            }
            self.columns[row].truncate(row + 1);
            let (u, v) = (self.target[row], self.target[row + 1]);
            self.target[row] = c * u + s * v;
            self.target[row + 1] = c * v - s * u;
        }
        if let Some(lost) = self.target.pop() {
            self.rest += lost * lost;
        }
    }
}
