//! The columns and the target of a linear regression, checked once.

use std::ops::Range;

use crate::SparseError;

/// Columns a₀ … a_{k−1} and target p of the regression p ≈ Σ cⱼ aⱼ, of equal length and all finite.
///
/// The data stay where they are; only an exact power of two near the largest magnitude of every column is
/// kept, so that sums of squares neither overflow nor vanish whatever the units (no rounding is introduced).
#[derive(Debug, Clone)]
pub struct Design<'a> {
    columns: Vec<&'a [f64]>,
    target: &'a [f64],
    /// Powers of two: the target first, then the columns.
    scale: Vec<f64>,
}

impl<'a> Design<'a> {
    /// Check lengths and values of `columns` (each of n rows) and `target` (n rows).
    ///
    /// # Errors
    /// [`SparseError::Empty`], [`SparseError::Length`], [`SparseError::NotFinite`] (the first bad row).
    pub fn new(columns: &[&'a [f64]], target: &'a [f64]) -> Result<Self, SparseError> {
        if target.is_empty() {
            return Err(SparseError::Empty { what: "the target".into(), mend: "give at least one row" });
        }
        if columns.is_empty() {
            return Err(SparseError::Empty {
                what: "the list of columns".into(),
                mend: "give at least one column",
            });
        }
        let mut scale = vec![power_of_two("the target", target)?];
        for (j, column) in columns.iter().enumerate() {
            let what = format!("column {j}");
            if column.len() != target.len() {
                return Err(SparseError::Length { what, found: column.len(), expected: target.len() });
            }
            scale.push(power_of_two(&what, column)?);
        }
        Ok(Self { columns: columns.to_vec(), target, scale })
    }

    /// Number of rows n.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.target.len()
    }

    /// Number of columns k.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns.len()
    }

    /// Column j.
    #[must_use]
    pub fn column(&self, j: usize) -> &'a [f64] {
        self.columns[j]
    }

    /// The target p.
    #[must_use]
    pub fn target(&self) -> &'a [f64] {
        self.target
    }

    /// Exact powers of two by which target and columns are divided inside (target first).
    pub(crate) fn scale(&self) -> &[f64] {
        &self.scale
    }

    /// Slice 0 is the target, slice 1 + j is column j.
    pub(crate) fn augmented(&self, j: usize) -> &'a [f64] {
        if j == 0 { self.target } else { self.columns[j - 1] }
    }

    /// Residual p − Σ cⱼ aⱼ on the given rows, in their order.
    #[must_use]
    pub fn residual(&self, coefficients: &[f64], rows: &[Range<usize>]) -> Vec<f64> {
        let mut out = Vec::with_capacity(count(rows));
        for range in rows {
            let start = out.len();
            out.extend_from_slice(&self.target[range.clone()]);
            for (column, &c) in self.columns.iter().zip(coefficients) {
                if c != 0.0 {
                    for (r, a) in out[start..].iter_mut().zip(&column[range.clone()]) {
                        *r -= c * a;
                    }
                }
            }
        }
        out
    }

    /// Check that ranges lie inside the rows and are not all empty.
    pub(crate) fn check_rows(&self, rows: &[Range<usize>]) -> Result<(), SparseError> {
        for r in rows {
            if r.start > r.end || r.end > self.rows() {
                return Err(SparseError::NoSuchRows { start: r.start, end: r.end, rows: self.rows() });
            }
        }
        if count(rows) == 0 {
            return Err(SparseError::Empty { what: "the set of rows".into(), mend: "name at least one row" });
        }
        Ok(())
    }

    /// Check that the column numbers exist among the first `columns`.
    pub(crate) fn check_columns(
        what: &'static str,
        list: &[usize],
        columns: usize,
    ) -> Result<(), SparseError> {
        match list.iter().find(|&&j| j >= columns) {
            Some(&column) => Err(SparseError::NoSuchColumn { what, column, columns }),
            None => Ok(()),
        }
    }
}

/// How many rows a list of ranges holds.
#[must_use]
pub fn count(rows: &[Range<usize>]) -> usize {
    rows.iter().map(ExactSizeIterator::len).sum()
}

/// Columns as a list of slices.
///
/// ```
/// let columns = vec![vec![1.0, 2.0], vec![3.0, 4.0]];
/// assert_eq!(greybox_sparse::slices(&columns)[1], [3.0, 4.0]);
/// ```
#[must_use]
pub fn slices(columns: &[Vec<f64>]) -> Vec<&[f64]> {
    columns.iter().map(Vec::as_slice).collect()
}

/// The power of two at or below the largest magnitude (1 for a column of zeros), within 2^±1000.
fn power_of_two(what: &str, values: &[f64]) -> Result<f64, SparseError> {
    let mut largest = 0.0_f64;
    for (row, &value) in values.iter().enumerate() {
        if !value.is_finite() {
            return Err(SparseError::NotFinite { what: what.into(), row, value });
        }
        largest = largest.max(value.abs());
    }
    Ok(if largest > 0.0 { largest.log2().floor().clamp(-1000.0, 1000.0).exp2() } else { 1.0 })
}
