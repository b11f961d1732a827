//! Sums of products by blocks of rows, from which every fold, order and penalty is served.

use std::ops::Range;
use std::sync::{Arc, OnceLock};

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatMut, MatRef, Par};

use crate::SparseError;
use crate::design::Design;
use crate::least_squares::{self, Reduced};

/// Rows copied at a time: the panel of target and columns stays in the cache.
const PANEL: usize = 512;

/// Gram matrix M = ZᵀWZ of Z = [p a₀ … a_{k−1}] over a set of rows with weights W.
///
/// Additive: the Gram matrix of a union of blocks is the sum, of a fold's complement the total less the fold.
/// The target stands first, so that the first k columns of a nested library are the leading part.
#[derive(Debug, Clone)]
pub struct Gram {
    /// k + 1, also the leading dimension.
    size: usize,
    /// Column-major, symmetric, of the columns divided by `scale`.
    matrix: Vec<f64>,
    scale: Arc<[f64]>,
    rows: f64,
}

impl Gram {
    /// Gram matrix over ranges of rows (n × k rows of work done once, panel by panel).
    #[must_use]
    pub fn new(design: &Design<'_>, rows: &[Range<usize>]) -> Self {
        let pieces: Vec<_> = rows.iter().map(|r| (r.clone(), 1.0)).collect();
        Self::weighted(design, &pieces)
    }

    /// As [`Gram::new`] with a weight ≥ 0 for every range (how often a bootstrap sample holds it).
    #[must_use]
    pub fn weighted(design: &Design<'_>, pieces: &[(Range<usize>, f64)]) -> Self {
        let size = design.columns() + 1;
        let mut sum = Mat::<f64>::zeros(size, size);
        let mut panel = vec![0.0; PANEL * size];
        let mut filled = 0;
        let mut rows = 0.0;
        for (range, weight) in pieces {
            let root = weight.sqrt();
            rows += weight * range.len() as f64;
            let mut at = range.start;
            while at < range.end {
                let take = (PANEL - filled).min(range.end - at);
                for j in 0..size {
                    let factor = root / design.scale()[j];
                    let source = &design.augmented(j)[at..at + take];
                    let to = j * PANEL + filled;
                    for (z, a) in panel[to..to + take].iter_mut().zip(source) {
                        *z = a * factor;
                    }
                }
                at += take;
                filled += take;
                if filled == PANEL {
                    accumulate(sum.as_mut(), &panel, size, filled);
                    filled = 0;
                }
            }
        }
        accumulate(sum.as_mut(), &panel, size, filled);
        let matrix =
            (0..size).flat_map(|j| (0..size).map(move |i| (i, j))).map(|(i, j)| sum[(i, j)]).collect();
        Self { size, matrix, scale: design.scale().into(), rows }
    }

    /// Number of columns k.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.size - 1
    }

    /// Number of rows, a repeated row counted as often as it is held.
    #[must_use]
    pub fn rows(&self) -> f64 {
        self.rows
    }

    /// aᵢᵀ W aⱼ in the columns' own units.
    #[must_use]
    pub fn product(&self, i: usize, j: usize) -> f64 {
        self.at(i + 1, j + 1) * self.scale[i + 1] * self.scale[j + 1]
    }

    /// aⱼᵀ W p in own units.
    #[must_use]
    pub fn cross(&self, j: usize) -> f64 {
        self.at(j + 1, 0) * self.scale[j + 1] * self.scale[0]
    }

    /// pᵀ W p.
    #[must_use]
    pub fn energy(&self) -> f64 {
        self.at(0, 0) * self.scale[0] * self.scale[0]
    }

    /// Sum with the Gram matrix of other rows of the same design.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        self.combine(other, 1.0)
    }

    /// What is left when the rows of `other`, all held by `self`, are taken away.
    #[must_use]
    pub fn minus(&self, other: &Self) -> Self {
        self.combine(other, -1.0)
    }

    fn combine(&self, other: &Self, sign: f64) -> Self {
        let matrix = self.matrix.iter().zip(&other.matrix).map(|(a, b)| a + sign * b).collect();
        Self { matrix, scale: self.scale.clone(), size: self.size, rows: self.rows + sign * other.rows }
    }

    /// Add `weight` times another Gram matrix of the same design.
    pub(crate) fn add(&mut self, other: &Self, weight: f64) {
        self.matrix.iter_mut().zip(&other.matrix).for_each(|(a, b)| *a += weight * b);
        self.rows += weight * other.rows;
    }

    /// All rows `weight` times.
    pub(crate) fn scaled(&self, weight: f64) -> Self {
        let mut out = self.clone();
        out.matrix.iter_mut().for_each(|v| *v *= weight);
        out.rows *= weight;
        out
    }

    fn at(&self, i: usize, j: usize) -> f64 {
        self.matrix[j * self.size + i]
    }

    /// ‖p − Σ cⱼ aⱼ‖² for the first columns, with the part of it that rounding can make: (RSS, uncertainty).
    fn rss(&self, coefficients: &[f64]) -> (f64, f64) {
        let c: Vec<f64> = std::iter::once(-1.0)
            .chain(coefficients.iter().enumerate().map(|(j, c)| c * (self.scale[j + 1] / self.scale[0])))
            .collect();
        let (mut sum, mut magnitude) = (0.0, 0.0);
        for (j, cj) in c.iter().enumerate().filter(|(_, c)| **c != 0.0) {
            for (i, ci) in c.iter().enumerate().filter(|(_, c)| **c != 0.0) {
                let term = ci * self.at(i, j) * cj;
                sum += term;
                magnitude += term.abs();
            }
        }
        let unit = self.scale[0] * self.scale[0];
        (sum * unit, magnitude * unit * f64::EPSILON * 16.0)
    }
}

/// sum += ZᵀZ for the first `rows` rows of the panel.
fn accumulate(sum: MatMut<'_, f64>, panel: &[f64], size: usize, rows: usize) {
    if rows > 0 {
        let z = MatRef::from_column_major_slice(panel, PANEL, size).subrows(0, rows);
        matmul(sum, Accum::Add, z.transpose(), z, 1.0, Par::Seq);
    }
}

/// The first k columns of a sample with all columns and the target of unit length.
///
/// ρᵢⱼ = aᵢᵀaⱼ/(‖aᵢ‖‖aⱼ‖), rⱼ = aⱼᵀp/(‖aⱼ‖‖p‖); coefficients βⱼ = cⱼ‖aⱼ‖/‖p‖; RSS in units of ‖p‖².
#[derive(Debug, Clone)]
pub struct Normalised {
    /// Number of columns k.
    pub columns: usize,
    /// ρ, column-major k × k (zero rows and columns for columns of zeros).
    pub correlation: Vec<f64>,
    /// r, k values.
    pub cross: Vec<f64>,
    /// ‖p‖/‖aⱼ‖: multiply β by it to have c; 0 for a column of zeros.
    pub unit: Vec<f64>,
}

/// A set of rows of a design: their Gram matrix and, when rounding asks for it, their triangular factor.
///
/// Every selector of this crate takes a `Sample`. Solutions come from a Cholesky factor of the normalised Gram
/// matrix as long as its smallest pivot shows that this is accurate, else from a QR factor of the rows.
#[derive(Debug)]
pub struct Sample<'a> {
    design: &'a Design<'a>,
    pieces: Vec<(Range<usize>, f64)>,
    gram: Gram,
    reduced: OnceLock<Reduced>,
}

impl<'a> Sample<'a> {
    /// The rows of the given ranges.
    ///
    /// # Errors
    /// [`SparseError::NoSuchRows`], [`SparseError::Empty`].
    pub fn new(design: &'a Design<'a>, rows: &[Range<usize>]) -> Result<Self, SparseError> {
        design.check_rows(rows)?;
        Ok(Self::from_gram(design, rows, Gram::new(design, rows)))
    }

    /// The rows of the given ranges whose Gram matrix is known already.
    pub(crate) fn from_gram(design: &'a Design<'a>, rows: &[Range<usize>], gram: Gram) -> Self {
        Self::from_weighted(design, rows.iter().map(|r| (r.clone(), 1.0)).collect(), gram)
    }

    /// Weighted ranges whose Gram matrix is known already.
    pub(crate) fn from_weighted(
        design: &'a Design<'a>,
        pieces: Vec<(Range<usize>, f64)>,
        gram: Gram,
    ) -> Self {
        Self { design, pieces, gram, reduced: OnceLock::new() }
    }

    /// The Gram matrix.
    #[must_use]
    pub fn gram(&self) -> &Gram {
        &self.gram
    }

    /// Check that there are as many columns as asked for, and at least one.
    pub(crate) fn check_size(&self, columns: usize) -> Result<(), SparseError> {
        let found = self.gram.columns();
        if columns == 0 || columns > found {
            let column = columns.saturating_sub(1);
            return Err(SparseError::NoSuchColumn { what: "the number of columns", column, columns: found });
        }
        Ok(())
    }

    /// The first `columns` columns (all, if there are fewer), normalised.
    #[must_use]
    pub fn normalised(&self, columns: usize) -> Normalised {
        let g = &self.gram;
        let k = columns.min(g.columns());
        let norm: Vec<f64> = (0..=k).map(|j| g.at(j, j).max(0.0).sqrt()).collect();
        let inverse: Vec<f64> = norm.iter().map(|n| if *n > 0.0 { 1.0 / n } else { 0.0 }).collect();
        let mut correlation = vec![0.0; k * k];
        for j in 0..k {
            for i in 0..k {
                correlation[j * k + i] = g.at(i + 1, j + 1) * inverse[i + 1] * inverse[j + 1];
            }
        }
        let cross = (0..k).map(|j| g.at(j + 1, 0) * inverse[j + 1] * inverse[0]).collect();
        let unit = (0..k).map(|j| (norm[0] * inverse[j + 1]) * (g.scale[0] / g.scale[j + 1])).collect();
        Normalised { columns: k, correlation, cross, unit }
    }

    /// Least squares on the columns `active`: coefficients in the columns' own units, in the order of `active`.
    ///
    /// # Errors
    /// [`SparseError::RankDeficient`] naming the dependent column; [`SparseError::TooFewRows`].
    pub fn solve(&self, active: &[usize], normalised: &Normalised) -> Result<Vec<f64>, SparseError> {
        match least_squares::cholesky_solve(normalised, active) {
            Some(beta) => Ok(active.iter().zip(beta).map(|(&j, b)| b * normalised.unit[j]).collect()),
            None => self.solve_rows(active),
        }
    }

    /// As [`Sample::solve`], always from the rows (column-normalised Householder QR).
    ///
    /// # Errors
    /// As [`Sample::solve`].
    pub fn solve_rows(&self, active: &[usize]) -> Result<Vec<f64>, SparseError> {
        self.reduced().solve(active, self.gram.rows())
    }

    /// The triangular factor of [p a₀ …], computed when first asked for.
    pub(crate) fn reduced(&self) -> &Reduced {
        self.reduced.get_or_init(|| Reduced::new(self.design, &self.pieces))
    }

    /// Residual sum of squares ‖p − Σ cⱼ aⱼ‖² on these rows; where the Gram matrix cannot resolve it
    /// (a nearly perfect fit) it is taken from the triangular factor of the rows.
    #[must_use]
    pub fn rss(&self, coefficients: &[f64]) -> f64 {
        let (rss, uncertainty) = self.gram.rss(coefficients);
        if rss > 1e4 * uncertainty { rss } else { self.reduced().rss(coefficients) }
    }
}
