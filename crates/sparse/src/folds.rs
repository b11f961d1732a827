//! Which rows train, which validate and which test.

use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::SparseError;
use crate::design::count;

/// Rows of the K folds; a row dropped between two folds belongs to none.
pub type Folds = Vec<Vec<Range<usize>>>;

/// K folds of consecutive rows (thesis Figure 2.1), equally long over the given pieces (row ranges of
/// separate recordings, in order). `gap` rows are dropped at the end of a fold where the next one goes on
/// in the same piece: rows made from overlapping windows would otherwise stand in both.
///
/// # Errors
/// [`SparseError::Folds`] for fewer than 2 folds or when a fold would be empty.
///
/// ```
/// let folds = greybox_sparse::folds::contiguous(&[0..10], 2, 1)?;
/// assert_eq!(folds, vec![vec![0..4], vec![5..10]]);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn contiguous(pieces: &[Range<usize>], folds: usize, gap: usize) -> Result<Folds, SparseError> {
    let rows = count(pieces);
    let fail = SparseError::Folds { rows, folds, gap };
    if folds < 2 || rows < folds {
        return Err(fail);
    }
    let out: Folds =
        (0..folds).map(|f| stretch(pieces, f * rows / folds, (f + 1) * rows / folds, gap)).collect();
    if out.iter().any(|f| count(f) == 0) { Err(fail) } else { Ok(out) }
}

/// K folds of rows drawn at random. **Wrong for time series**: neighbouring rows are nearly equal, so every
/// validation row has a twin in training, and the penalty comes out too small (with the settings of thesis
/// chapter 2 the true structure is then never found). Here to show just that.
///
/// # Errors
/// [`SparseError::Folds`] for fewer than 2 folds or fewer rows than folds.
pub fn random(pieces: &[Range<usize>], folds: usize, seed: u64) -> Result<Folds, SparseError> {
    let mut rows: Vec<usize> = pieces.iter().cloned().flatten().collect();
    if folds < 2 || rows.len() < folds {
        return Err(SparseError::Folds { rows: rows.len(), folds, gap: 0 });
    }
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    for i in (1..rows.len()).rev() {
        rows.swap(i, random.random_range(0..=i));
    }
    let n = rows.len();
    Ok((0..folds)
        .map(|f| rows[f * n / folds..(f + 1) * n / folds].iter().map(|&r| r..r + 1).collect())
        .collect())
}

/// Training rows first, test rows after, never overlapping: the first `fraction` of the rows of all pieces
/// trains; `gap` rows are dropped where the cut falls inside a piece.
///
/// # Errors
/// [`SparseError::Option`] for a fraction outside (0, 1); [`SparseError::Folds`] when a side is empty.
pub fn train_test(pieces: &[Range<usize>], fraction: f64, gap: usize) -> Result<Split, SparseError> {
    if !(fraction > 0.0 && fraction < 1.0) {
        return Err(SparseError::Option {
            name: "train_fraction",
            value: fraction,
            expected: "a number between 0 and 1",
        });
    }
    let rows = count(pieces);
    let cut = (fraction * rows as f64).round() as usize;
    let (train, test) = (stretch(pieces, 0, cut, gap), stretch(pieces, cut, rows, 0));
    if count(&train) == 0 || count(&test) == 0 {
        return Err(SparseError::Folds { rows, folds: 2, gap });
    }
    Ok(Split { train, test })
}

/// Rows for training (cross-validation happens inside them) and rows for the information criterion.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Split {
    /// Training rows.
    pub train: Vec<Range<usize>>,
    /// Test rows.
    pub test: Vec<Range<usize>>,
}

/// Positions from..to of the concatenated pieces as ranges, less `gap` rows at an end inside a piece.
fn stretch(pieces: &[Range<usize>], from: usize, to: usize, gap: usize) -> Vec<Range<usize>> {
    let mut out = Vec::new();
    let mut before = 0;
    for piece in pieces {
        let low = from.clamp(before, before + piece.len()) - before;
        let high = to.clamp(before, before + piece.len()) - before;
        let end = if high < piece.len() { high.saturating_sub(gap).max(low) } else { high };
        if low < end {
            out.push(piece.start + low..piece.start + end);
        }
        before += piece.len();
    }
    out
}

/// How the penalty is chosen from the cross-validation curve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rule {
    /// The smallest MSE_cv (thesis Algorithm 1, line 11); of equal ones the sparser.
    Minimum,
    /// The sparsest model whose MSE_cv is within one standard error of the smallest.
    OneStandardError,
}

/// Index of the chosen point of a curve: `mse` and its standard error, `terms` = mean number of terms of the
/// models behind it. `None` for an empty curve.
///
/// ```
/// use greybox_sparse::folds::{Rule, choose};
/// let (mse, se, terms) = ([1.0, 0.9, 0.95, 3.0], [0.1; 4], [9.0, 6.0, 3.0, 1.0]);
/// assert_eq!(choose(Rule::Minimum, &mse, &se, &terms), Some(1));
/// assert_eq!(choose(Rule::OneStandardError, &mse, &se, &terms), Some(2));
/// ```
#[must_use]
pub fn choose(rule: Rule, mse: &[f64], standard_error: &[f64], terms: &[f64]) -> Option<usize> {
    let best = (0..mse.len()).min_by(|&a, &b| mse[a].total_cmp(&mse[b]))?;
    let limit = match rule {
        Rule::Minimum => mse[best] * (1.0 + 1e-12),
        Rule::OneStandardError => mse[best] + standard_error[best],
    };
    (0..mse.len())
        .filter(|&i| mse[i] <= limit)
        .min_by(|&a, &b| terms[a].total_cmp(&terms[b]).then(mse[a].total_cmp(&mse[b])))
}
