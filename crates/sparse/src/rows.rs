//! The rows of a linear model, checked once.

use std::ops::Range;

use crate::error::SparseError;

/// Columns P and target p of `P c ≈ p`, column-major, borrowed: all of one length and finite.
///
/// Only a checked `Rows` can reach the numerics, so they need no checks of their own.
///
/// ```
/// use greybox_sparse::Rows;
/// let (x, y) = ([1.0, 2.0, 3.0], [2.0, 4.0, f64::NAN]);
/// let error = Rows::new(&[&x], &y).unwrap_err();
/// assert!(error.to_string().starts_with("the target is not finite in row 2"));
/// ```
#[derive(Debug, Clone)]
pub struct Rows<'a> {
    columns: Vec<&'a [f64]>,
    target: &'a [f64],
}

impl<'a> Rows<'a> {
    /// Checks and takes the columns and the target.
    ///
    /// # Errors
    /// [`SparseError::Empty`] without rows or columns, [`SparseError::Length`] for unequal lengths,
    /// [`SparseError::NotFinite`] naming column and row.
    pub fn new<C: AsRef<[f64]> + ?Sized>(columns: &[&'a C], target: &'a [f64]) -> Result<Self, SparseError> {
        let columns: Vec<&'a [f64]> = columns.iter().map(|c| (*c).as_ref()).collect();
        if columns.is_empty() {
            return Err(SparseError::Empty { what: "columns" });
        }
        if target.is_empty() {
            return Err(SparseError::Empty { what: "rows" });
        }
        check_finite(target, || "the target".into())?;
        for (j, column) in columns.iter().enumerate() {
            let what = || format!("column {j}");
            if column.len() != target.len() {
                return Err(SparseError::Length {
                    what: what(),
                    found: column.len(),
                    expected: target.len(),
                });
            }
            check_finite(column, what)?;
        }
        Ok(Self { columns, target })
    }

    /// As [`Rows::new`] from owned columns.
    ///
    /// # Errors
    /// As [`Rows::new`].
    pub fn from_vecs(columns: &'a [Vec<f64>], target: &'a [f64]) -> Result<Self, SparseError> {
        let columns: Vec<&'a [f64]> = columns.iter().map(Vec::as_slice).collect();
        Self::new(&columns, target)
    }

    /// Number of rows n.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.target.len()
    }

    /// Number of columns p.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns.len()
    }

    /// Column `j`; an empty slice if there is none.
    #[must_use]
    pub fn column(&self, j: usize) -> &'a [f64] {
        self.columns.get(j).copied().unwrap_or(&[])
    }

    /// The target.
    #[must_use]
    pub fn target(&self) -> &'a [f64] {
        self.target
    }

    /// The first `count` columns with the same target (all of them if there are fewer).
    #[must_use]
    pub fn first_columns(&self, count: usize) -> Self {
        Self { columns: self.columns[..count.clamp(1, self.columns.len())].to_vec(), target: self.target }
    }

    /// Σ of the squares of [`Rows::residuals`] for each of several c, the rows read once.
    pub(crate) fn squares(&self, models: &[&[f64]], ranges: &[Range<usize>]) -> Vec<f64> {
        let mut sums = vec![0.0; models.len()];
        for panel in panels(ranges, CACHED) {
            for (sum, coefficients) in sums.iter_mut().zip(models) {
                let left = self.residuals(coefficients, std::slice::from_ref(&panel));
                *sum += left.iter().map(|r| r * r).sum::<f64>();
            }
        }
        sums
    }

    /// Residuals p − P c over the given ranges, in their order; columns with zero coefficient are skipped.
    /// Ranges and coefficients beyond the data are ignored.
    #[must_use]
    pub fn residuals(&self, coefficients: &[f64], ranges: &[Range<usize>]) -> Vec<f64> {
        let mut out = Vec::with_capacity(count(ranges));
        for range in ranges {
            let (start, end) = (range.start.min(self.rows()), range.end.min(self.rows()));
            let from = out.len();
            out.extend_from_slice(&self.target[start.min(end)..end]);
            for (column, &c) in self.columns.iter().zip(coefficients) {
                if c != 0.0 {
                    for (r, &v) in out[from..].iter_mut().zip(&column[start.min(end)..end]) {
                        *r -= c * v;
                    }
                }
            }
        }
        out
    }
}

/// Rows whose columns stay in the second-level cache.
pub(crate) const CACHED: usize = 1024;

/// Row ranges cut into panels of at most `most` rows.
pub(crate) fn panels(ranges: &[Range<usize>], most: usize) -> impl Iterator<Item = Range<usize>> + '_ {
    ranges
        .iter()
        .flat_map(move |r| r.clone().step_by(most).map(move |start| start..(start + most).min(r.end)))
}

/// Number of rows in a set of ranges.
#[must_use]
pub fn count(ranges: &[Range<usize>]) -> usize {
    ranges.iter().map(|r| r.end.saturating_sub(r.start)).sum()
}

/// Checks that the ranges are non-empty, ascending, separate and within `rows`.
///
/// # Errors
/// [`SparseError::RowRange`] naming the first bad range, [`SparseError::Empty`] without ranges.
pub fn check_ranges(ranges: &[Range<usize>], rows: usize) -> Result<(), SparseError> {
    if ranges.is_empty() {
        return Err(SparseError::Empty { what: "row ranges" });
    }
    let mut last = 0;
    for r in ranges {
        if r.start < last || r.end <= r.start || r.end > rows {
            return Err(SparseError::RowRange { start: r.start, end: r.end, rows });
        }
        last = r.end;
    }
    Ok(())
}

/// An error that names the first value that is not finite.
pub(crate) fn check_finite(values: &[f64], what: impl FnOnce() -> String) -> Result<(), SparseError> {
    match first_not_finite(values) {
        None => Ok(()),
        Some(row) => Err(SparseError::NotFinite { what: what(), row }),
    }
}

pub(crate) fn first_not_finite(values: &[f64]) -> Option<usize> {
    // Blocks without an early end are checked as fast as they are read; only a bad one is looked at closely.
    let bad = |block: &[f64]| block.iter().fold(false, |bad, v| bad | !v.is_finite());
    let block = values.chunks(CACHED).position(bad)?;
    let place = values[block * CACHED..].iter().position(|v| !v.is_finite())?;
    Some(block * CACHED + place)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_what_is_wrong() {
        let a = [1.0, 2.0];
        assert!(matches!(Rows::new::<[f64]>(&[], &a), Err(SparseError::Empty { what: "columns" })));
        assert!(matches!(Rows::new(&[&a[..1]], &a), Err(SparseError::Length { found: 1, expected: 2, .. })));
        let b = [1.0, f64::INFINITY];
        assert_eq!(
            Rows::new(&[&a, &b], &a).unwrap_err(),
            SparseError::NotFinite { what: "column 1".into(), row: 1 }
        );
    }

    #[test]
    fn the_first_bad_value_is_found_wherever_it_is() {
        let mut values = vec![1.0; 5000];
        assert_eq!(first_not_finite(&values), None);
        for at in [4999, 3000, 1024, 1023, 0] {
            values[at] = f64::NAN;
            assert_eq!(first_not_finite(&values), Some(at));
        }
    }

    #[test]
    #[allow(clippy::single_range_in_vec_init)]
    fn ranges_must_ascend() {
        assert!(check_ranges(&[0..2, 2..4], 4).is_ok());
        assert!(check_ranges(&[0..3, 2..4], 4).is_err());
        assert!(check_ranges(&[0..5], 4).is_err());
        assert!(check_ranges(&[1..1], 4).is_err());
    }

    #[test]
    fn residuals_over_pieces() {
        let (x, y) = ([1.0, 2.0, 3.0, 4.0], [2.0, 4.0, 6.0, 9.0]);
        let rows = Rows::new(&[&x], &y).unwrap();
        assert_eq!(rows.residuals(&[2.0], &[0..1, 2..4]), vec![0.0, 0.0, 1.0]);
        assert_eq!(rows.squares(&[&[2.0], &[]], &[0..1, 2..4]), [1.0, 121.0]);
    }
}
