//! Gram matrices by blocks of rows.

use std::ops::Range;

use crate::error::SparseError;
use crate::library::Library;
use crate::product::{RowPanel, add_products};
use crate::rows::{Rows, check_finite, check_ranges, count, panels};

/// Rows of a panel: its columns stay in the caches while they are multiplied.
pub(crate) const PANEL: usize = 256;

/// The Gram matrix of `[P p]` for n rows and k columns: PᵀP, Pᵀp and pᵀp, additive over rows.
///
/// ```
/// use greybox_sparse::{Gram, Rows};
/// let (x, y) = ([1.0, 2.0, 3.0], [2.0, 4.0, 6.0]);
/// let rows = Rows::new(&[&x], &y)?;
/// let mut gram = Gram::of_rows(&rows, &[0..2])?;
/// gram.add(&Gram::of_rows(&rows, &[2..3])?)?;
/// assert_eq!((gram.rows(), gram.product(0, 0), gram.moment(0), gram.target_square()), (3, 14.0, 28.0, 56.0));
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Gram {
    columns: usize,
    rows: usize,
    /// (k + 1)² column-major, symmetric, the target last.
    values: Vec<f64>,
}

impl Gram {
    /// The Gram matrix of no rows.
    #[must_use]
    pub fn zero(columns: usize) -> Self {
        Self { columns, rows: 0, values: vec![0.0; (columns + 1) * (columns + 1)] }
    }

    pub(crate) fn from_augmented(values: Vec<f64>, columns: usize, rows: usize) -> Self {
        Self { columns, rows, values }
    }

    /// The Gram matrix of the rows in `ranges`: one pass, panel by panel.
    ///
    /// # Errors
    /// [`SparseError::RowRange`], [`SparseError::Empty`].
    pub fn of_rows(rows: &Rows<'_>, ranges: &[Range<usize>]) -> Result<Self, SparseError> {
        check_ranges(ranges, rows.rows())?;
        let m = rows.columns() + 1;
        let mut sums = vec![0.0; m * m];
        let mut columns: Vec<&[f64]> = Vec::with_capacity(m);
        for panel in panels(ranges, PANEL) {
            columns.clear();
            columns.extend((0..rows.columns()).map(|j| &rows.column(j)[panel.clone()]));
            columns.push(&rows.target()[panel]);
            add_products(&columns, &mut sums);
        }
        Ok(Self::from_lower(sums, rows.columns(), count(ranges)))
    }

    /// The Gram matrix of a library's terms and a target on the rows in `ranges`: as [`Library::evaluate`] and
    /// [`Gram::of_rows`], but a panel of the terms is multiplied while it is in the cache, and never stored.
    ///
    /// ```
    /// use greybox_sparse::{Gram, Library, Rows};
    /// let (x, y) = ([1.0, 2.0, 3.0], [2.0, 4.0, 6.0]);
    /// let library = Library::separate_powers(&["x"], 2);
    /// let whole = std::iter::once(0..3).collect::<Vec<_>>();
    /// let gram = Gram::of_library(&library, &[&x], &[], &y, &whole)?;
    /// assert_eq!(gram, Gram::of_rows(&Rows::from_vecs(&library.evaluate(&[&x], &[])?, &y)?, &whole)?);
    /// # Ok::<(), greybox_sparse::SparseError>(())
    /// ```
    ///
    /// # Errors
    /// Those of [`Library::evaluate`] and [`Rows::new`]; [`SparseError::RowRange`], [`SparseError::Empty`].
    pub fn of_library(
        library: &Library,
        variables: &[&[f64]],
        expressions: &[(&str, &[f64])],
        target: &[f64],
        ranges: &[Range<usize>],
    ) -> Result<Self, SparseError> {
        let plan = library.plan(variables, expressions)?;
        let k = library.len();
        if k == 0 {
            return Err(SparseError::Empty { what: "columns" });
        }
        if target.len() != plan.rows() {
            let what = "the target".to_owned();
            return Err(SparseError::Length { what, found: target.len(), expected: plan.rows() });
        }
        check_finite(target, || "the target".into())?;
        check_ranges(ranges, target.len())?;
        let mut sums = vec![0.0; (k + 1) * (k + 1)];
        let mut terms = vec![0.0; k * PANEL];
        for panel in panels(ranges, PANEL) {
            let n = panel.len();
            plan.evaluate(panel.clone(), &mut terms[..k * n])?;
            let mut columns: Vec<&[f64]> = terms[..k * n].chunks_exact(n).collect();
            columns.push(&target[panel]);
            add_products(&columns, &mut sums);
        }
        Ok(Self::from_lower(sums, k, count(ranges)))
    }

    /// Mirrors the lower triangle.
    pub(crate) fn from_lower(mut values: Vec<f64>, columns: usize, rows: usize) -> Self {
        let m = columns + 1;
        for j in 0..m {
            for i in j + 1..m {
                values[i * m + j] = values[j * m + i];
            }
        }
        Self { columns, rows, values }
    }

    /// The Gram matrix of rows taken `weights[i]` times each (a bootstrap sample): Σ wᵢ rowᵢ rowᵢᵀ.
    ///
    /// # Errors
    /// [`SparseError::Length`] if there is not one weight per row.
    pub fn of_weighted_rows(rows: &Rows<'_>, weights: &[u32]) -> Result<Self, SparseError> {
        let gram = Self::of_samples(rows, &[weights])?.pop();
        gram.ok_or(SparseError::Empty { what: "samples" })
    }

    /// [`Gram::of_weighted_rows`] of several samples, each with its weights; the rows are read once for all of them.
    ///
    /// # Errors
    /// As [`Gram::of_weighted_rows`].
    pub fn of_samples(rows: &Rows<'_>, samples: &[&[u32]]) -> Result<Vec<Self>, SparseError> {
        if let Some(bad) = samples.iter().find(|w| w.len() != rows.rows()) {
            return Err(SparseError::Length {
                what: "the list of row weights".into(),
                found: bad.len(),
                expected: rows.rows(),
            });
        }
        let k = rows.columns();
        let mut sums = vec![vec![0.0; (k + 1) * (k + 1)]; samples.len()];
        let mut panel = RowPanel::new(PANEL.min(rows.rows()), k);
        let mut picked = vec![(0, 0.0); PANEL];
        for start in (0..rows.rows()).step_by(PANEL) {
            let range = start..(start + PANEL).min(rows.rows());
            panel.fill(&rows.target()[range.clone()], (0..k).map(|j| &rows.column(j)[range.clone()]));
            for (weights, sums) in samples.iter().zip(&mut sums) {
                // Every row is written; those left out are written over.
                let mut count = 0;
                for (row, &weight) in (0..).zip(&weights[range.clone()]) {
                    picked[count] = (row, f64::from(weight));
                    count += usize::from(weight > 0);
                }
                panel.add_products(&picked[..count], sums);
            }
        }
        let counts = samples.iter().map(|weights| weights.iter().map(|&w| w as usize).sum());
        Ok(sums.into_iter().zip(counts).map(|(s, n)| Self::from_lower(s, rows.columns(), n)).collect())
    }

    /// Adds the rows of another Gram matrix over the same columns.
    ///
    /// # Errors
    /// [`SparseError::Length`] for another number of columns.
    pub fn add(&mut self, other: &Self) -> Result<(), SparseError> {
        self.combine(other, 1.0)?;
        self.rows += other.rows;
        Ok(())
    }

    /// Takes rows away again: a fold's complement is total − fold. Where the fold holds most of the energy the
    /// difference cancels; [`BlockGram::sum`] of the other blocks does not.
    ///
    /// # Errors
    /// [`SparseError::Length`] for another number of columns.
    pub fn subtract(&mut self, other: &Self) -> Result<(), SparseError> {
        self.combine(other, -1.0)?;
        self.rows = self.rows.saturating_sub(other.rows);
        Ok(())
    }

    fn combine(&mut self, other: &Self, factor: f64) -> Result<(), SparseError> {
        if other.columns != self.columns {
            return Err(SparseError::Length {
                what: "the columns of a Gram matrix".into(),
                found: other.columns,
                expected: self.columns,
            });
        }
        for (a, b) in self.values.iter_mut().zip(&other.values) {
            *a += factor * b;
        }
        Ok(())
    }

    /// Number of columns k.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Number of rows n.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// (PᵀP)ᵢⱼ; zero outside.
    #[must_use]
    pub fn product(&self, i: usize, j: usize) -> f64 {
        if i < self.columns && j < self.columns { self.augmented(i, j) } else { 0.0 }
    }

    /// (Pᵀp)ᵢ; zero outside.
    #[must_use]
    pub fn moment(&self, i: usize) -> f64 {
        if i < self.columns { self.augmented(i, self.columns) } else { 0.0 }
    }

    /// pᵀp.
    #[must_use]
    pub fn target_square(&self) -> f64 {
        self.augmented(self.columns, self.columns)
    }

    /// ‖column j‖₂ of every column.
    #[must_use]
    pub fn norms(&self) -> Vec<f64> {
        (0..self.columns).map(|j| self.augmented(j, j).max(0.0).sqrt()).collect()
    }

    /// Entry of the (k + 1)² matrix with the target last.
    #[inline]
    pub(crate) fn augmented(&self, i: usize, j: usize) -> f64 {
        self.values[j * (self.columns + 1) + i]
    }
}

/// Gram matrices of disjoint blocks of rows, kept apart for folds and the block bootstrap.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockGram {
    blocks: Vec<Gram>,
    columns: usize,
}

impl BlockGram {
    /// One Gram matrix per range.
    ///
    /// # Errors
    /// As [`Gram::of_rows`].
    pub fn of_rows(rows: &Rows<'_>, ranges: &[Range<usize>]) -> Result<Self, SparseError> {
        check_ranges(ranges, rows.rows())?;
        let blocks = ranges
            .iter()
            .map(|r| Gram::of_rows(rows, std::slice::from_ref(r)))
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Self { blocks, columns: rows.columns() })
    }

    /// The blocks.
    #[must_use]
    pub fn blocks(&self) -> &[Gram] {
        &self.blocks
    }

    /// Sum over the given blocks, repeated ones as often as named; unknown indices count as nothing.
    #[must_use]
    pub fn sum(&self, which: impl IntoIterator<Item = usize>) -> Gram {
        let mut total = Gram::zero(self.columns);
        for block in which.into_iter().filter_map(|i| self.blocks.get(i)) {
            for (a, b) in total.values.iter_mut().zip(&block.values) {
                *a += b;
            }
            total.rows += block.rows;
        }
        total
    }
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::testing::design;

    fn direct(columns: &[Vec<f64>], y: &[f64], i: usize, j: usize) -> f64 {
        let of = |l: usize| if l < columns.len() { &columns[l][..] } else { y };
        of(i).iter().zip(of(j)).map(|(a, b)| a * b).sum()
    }

    #[test]
    fn equals_the_sums_and_is_additive() {
        let (columns, y) = design(2500, 4, 1);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let whole = Gram::of_rows(&rows, &[0..2500]).unwrap();
        for i in 0..5 {
            for j in 0..5 {
                let truth = direct(&columns, &y, i, j);
                assert!((whole.augmented(i, j) - truth).abs() < 1e-10 * 2500.0);
            }
        }
        let blocks = BlockGram::of_rows(&rows, &[0..700, 700..1900, 1900..2500]).unwrap();
        let sum = blocks.sum(0..3);
        let mut back = whole.clone();
        back.subtract(&blocks.blocks()[1]).unwrap();
        let complement = blocks.sum([0, 2]);
        assert_eq!((sum.rows(), back.rows(), complement.rows()), (2500, 1300, 1300));
        for (a, b) in sum.values.iter().zip(&whole.values).chain(back.values.iter().zip(&complement.values)) {
            assert!((a - b).abs() < 1e-9);
        }
    }

    #[test]
    fn weights_repeat_rows() {
        let (columns, y) = design(5, 2, 2);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let weighted = Gram::of_weighted_rows(&rows, &[2, 0, 1, 0, 3]).unwrap();
        let truth = 2.0 * columns[0][0] * y[0] + columns[0][2] * y[2] + 3.0 * columns[0][4] * y[4];
        assert!((weighted.moment(0) - truth).abs() < 1e-13);
        assert_eq!(weighted.rows(), 6);
        assert!(Gram::of_weighted_rows(&rows, &[1]).is_err());
        let both = Gram::of_samples(&rows, &[&[1; 5], &[2, 0, 1, 0, 3]]).unwrap();
        assert_eq!(both[1], weighted);
        assert_eq!(both[0].rows(), 5);
    }
}
