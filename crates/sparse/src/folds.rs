//! Which rows train and which test.
//!
//! Rows of one recording are correlated with their neighbours. A row held out at random is all but known from
//! its neighbours left in, so random folds reward over-fitting: on the thesis' Duffing example they never find
//! the structure (0 of 20 runs) where contiguous folds do. Contiguous folds are the only kind [`contiguous`]
//! makes; [`random_for_demonstration`] exists to show the difference.

use std::ops::Range;

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64Mcg;

use crate::error::{SparseError, check_range};
use crate::rows::{check_ranges, count};

/// Two sets of rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Split {
    /// Rows to fit.
    pub train: Vec<Range<usize>>,
    /// Rows to judge.
    pub test: Vec<Range<usize>>,
}

impl Split {
    /// Rows of one recording: the first `ratio` of them for training and the rest for the test, with `gap` rows dropped
    /// between. [`train_test`] is the same for several pieces.
    ///
    /// # Errors
    /// As [`train_test`]; [`SparseError::Empty`] without rows.
    ///
    /// ```
    /// use greybox_sparse::Split;
    /// let split = Split::of_rows(100, 0.5, 5)?;
    /// assert_eq!((&split.train[..], &split.test[..]), (&[0..50][..], &[55..100][..]));
    /// # Ok::<(), greybox_sparse::SparseError>(())
    /// ```
    pub fn of_rows(rows: usize, ratio: f64, gap: usize) -> Result<Self, SparseError> {
        if rows == 0 {
            return Err(SparseError::Empty { what: "rows" });
        }
        train_test(std::slice::from_ref(&(0..rows)), ratio, gap)
    }
}

/// Cross-validation folds over disjoint parts of the rows.
///
/// The parts are what is factorised once; a fold is trained on some and judged on others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Folds {
    /// Disjoint sets of rows.
    pub parts: Vec<Vec<Range<usize>>>,
    /// For every fold, the parts it is judged on.
    pub held_out: Vec<Vec<usize>>,
    /// For every fold, the parts it is trained on; parts in neither lie in the gap.
    pub training: Vec<Vec<usize>>,
}

impl Folds {
    /// Number of folds K.
    #[must_use]
    pub fn len(&self) -> usize {
        self.held_out.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.held_out.is_empty()
    }
}

/// Splits consecutive pieces of rows into the first `ratio` for training and the rest for the test, with `gap`
/// rows dropped after the cut, so that no window of rows straddles it. A cut between two pieces needs no gap.
///
/// # Errors
/// [`SparseError::RowRange`] for bad pieces, [`SparseError::Option`] unless 0 < `ratio` < 1,
/// [`SparseError::TooFewRows`] if a side is empty.
///
/// ```
/// use greybox_sparse::folds::train_test;
/// let split = train_test(&[0..60, 60..100], 0.5, 5)?;
/// assert_eq!((split.train, split.test), (vec![0..50], vec![55..60, 60..100]));
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn train_test(pieces: &[Range<usize>], ratio: f64, gap: usize) -> Result<Split, SparseError> {
    check_ranges(pieces, usize::MAX)?;
    check_range("train/test ratio", ratio, f64::MIN_POSITIVE, 1.0 - f64::EPSILON, "between 0 and 1")?;
    let total = count(pieces);
    let cut = (ratio * total as f64).round() as usize;
    let train = slice(pieces, 0, cut);
    let inside_a_piece = train.last().is_some_and(|last| pieces.iter().all(|p| p.end != last.end));
    let test = if inside_a_piece {
        // The gap ends with the piece: the next one is unrelated.
        let left_in_piece = train
            .last()
            .and_then(|last| pieces.iter().find(|p| p.contains(&last.start)).map(|p| p.end - last.end))
            .unwrap_or(0);
        slice(pieces, cut + gap.min(left_in_piece), total)
    } else {
        slice(pieces, cut, total)
    };
    for (what, set) in [("the training set", &train), ("the test set", &test)] {
        if set.is_empty() {
            return Err(SparseError::TooFewRows { what: what.into(), found: 0, needed: 1 });
        }
    }
    Ok(Split { train, test })
}

/// `folds` contiguous folds of equal size (±1 row) over consecutive pieces of rows. Rows closer than `gap` to a
/// held-out row of the same piece are not trained on.
///
/// # Errors
/// [`SparseError::RowRange`] for bad pieces, [`SparseError::Option`] for fewer than two folds,
/// [`SparseError::TooFewRows`] for a fold without rows or without training rows.
// A part often is one range of rows.
#[allow(clippy::single_range_in_vec_init)]
pub fn contiguous(pieces: &[Range<usize>], folds: usize, gap: usize) -> Result<Folds, SparseError> {
    check_folds(pieces, folds)?;
    let total = count(pieces);
    let bounds: Vec<usize> = (0..=folds).map(|k| k * total / folds).collect();
    let held: Vec<Vec<Range<usize>>> = bounds.windows(2).map(|b| slice(pieces, b[0], b[1])).collect();
    // Rows in the gap of each fold, cut off at the ends of the piece.
    let guarded: Vec<Vec<Range<usize>>> = held
        .iter()
        .map(|ranges| {
            ranges
                .iter()
                .filter_map(|r| pieces.iter().find(|p| p.contains(&r.start)).map(|p| (r, p)))
                .map(|(r, p)| r.start.saturating_sub(gap).max(p.start)..r.end.saturating_add(gap).min(p.end))
                .collect()
        })
        .collect();
    let mut cuts: Vec<usize> =
        held.iter().chain(&guarded).flatten().chain(pieces).flat_map(|r| [r.start, r.end]).collect();
    cuts.sort_unstable();
    cuts.dedup();
    // Elementary ranges, joined where they play the same role in every fold.
    let holds = |sets: &[Range<usize>], row: usize| sets.iter().any(|r| r.contains(&row));
    let mut parts: Vec<(Vec<u8>, Vec<Range<usize>>)> = Vec::new();
    for pair in cuts.windows(2).filter(|pair| holds(pieces, pair[0])) {
        let role: Vec<u8> = (0..folds)
            .map(|k| if holds(&held[k], pair[0]) { 2 } else { u8::from(holds(&guarded[k], pair[0])) })
            .collect();
        match parts.iter_mut().find(|(r, _)| *r == role) {
            Some((_, ranges)) => match ranges.last_mut() {
                Some(last) if last.end == pair[0] => last.end = pair[1],
                _ => ranges.push(pair[0]..pair[1]),
            },
            None => parts.push((role, vec![pair[0]..pair[1]])),
        }
    }
    let with_role =
        |k: usize, wanted: u8| (0..parts.len()).filter(|&i| parts[i].0[k] == wanted).collect::<Vec<usize>>();
    let held_out: Vec<_> = (0..folds).map(|k| with_role(k, 2)).collect();
    let training: Vec<_> = (0..folds).map(|k| with_role(k, 0)).collect();
    if let Some(k) = (0..folds).find(|&k| training[k].is_empty()) {
        return Err(SparseError::TooFewRows {
            what: format!("the training part of fold {k}"),
            found: 0,
            needed: 1,
        });
    }
    Ok(Folds { parts: parts.into_iter().map(|(_, ranges)| ranges).collect(), held_out, training })
}

/// Folds of rows drawn at random. **Wrong for time series** (see the module's text): here only to show that.
///
/// # Errors
/// As [`contiguous`].
pub fn random_for_demonstration(
    pieces: &[Range<usize>],
    folds: usize,
    seed: u64,
) -> Result<Folds, SparseError> {
    check_folds(pieces, folds)?;
    let mut rows: Vec<usize> = pieces.iter().cloned().flatten().collect();
    rows.shuffle(&mut Pcg64Mcg::seed_from_u64(seed));
    let parts = (0..folds)
        .map(|k| {
            let mut own = rows[k * rows.len() / folds..(k + 1) * rows.len() / folds].to_vec();
            own.sort_unstable();
            own.into_iter().map(|i| i..i + 1).collect()
        })
        .collect();
    let held_out = (0..folds).map(|k| vec![k]).collect();
    let training = (0..folds).map(|k| (0..folds).filter(|&j| j != k).collect()).collect();
    Ok(Folds { parts, held_out, training })
}

fn check_folds(pieces: &[Range<usize>], folds: usize) -> Result<(), SparseError> {
    check_ranges(pieces, usize::MAX)?;
    check_range("number of folds", folds as f64, 2.0, f64::MAX, "2 or more")?;
    let found = count(pieces);
    if found < folds {
        return Err(SparseError::TooFewRows {
            what: format!("the set of {folds} folds"),
            found,
            needed: folds,
        });
    }
    Ok(())
}

/// Rows number `from` to `to` of the concatenated pieces.
fn slice(pieces: &[Range<usize>], from: usize, to: usize) -> Vec<Range<usize>> {
    let mut before = 0;
    let mut out = Vec::new();
    for p in pieces {
        let len = p.end - p.start;
        let (a, b) = (from.clamp(before, before + len), to.clamp(before, before + len));
        if a < b {
            out.push(p.start + a - before..p.start + b - before);
        }
        before += len;
    }
    out
}

/// Index of the smallest value; among equal ones the last, which is the sparsest if the values are ordered from
/// the densest model to the sparsest. NaN never wins; `None` if there is nothing else.
#[must_use]
pub fn minimum(means: &[f64]) -> Option<usize> {
    (0..means.len()).filter(|&i| !means[i].is_nan()).reduce(|a, b| if means[b] <= means[a] { b } else { a })
}

/// The one-standard-error rule (Breiman et al. 1984): the sparsest model whose mean error is at most the
/// minimum plus the minimum's standard error. The values are ordered from the densest to the sparsest.
///
/// ```
/// use greybox_sparse::folds::{minimum, one_standard_error};
/// let (mean, error) = ([2.0, 1.0, 1.05, 1.2, 4.0], [0.1; 5]);
/// assert_eq!(minimum(&mean), Some(1));
/// assert_eq!(one_standard_error(&mean, &error), Some(2));
/// ```
#[must_use]
pub fn one_standard_error(means: &[f64], standard_errors: &[f64]) -> Option<usize> {
    let least = minimum(means)?;
    let bound = means[least] + standard_errors.get(least).copied().filter(|s| s.is_finite()).unwrap_or(0.0);
    (0..means.len()).rev().find(|&i| means[i] <= bound)
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;

    #[test]
    fn folds_partition_the_rows() {
        let pieces = [0..37, 50..81];
        let folds = contiguous(&pieces, 4, 0).unwrap();
        assert_eq!(folds.len(), 4);
        let mut seen: Vec<usize> =
            folds.held_out.iter().flatten().flat_map(|&p| folds.parts[p].iter().cloned().flatten()).collect();
        seen.sort_unstable();
        assert_eq!(seen, pieces.iter().cloned().flatten().collect::<Vec<_>>());
        for k in 0..4 {
            let n: usize = folds.held_out[k].iter().map(|&p| count(&folds.parts[p])).sum();
            let m: usize = folds.training[k].iter().map(|&p| count(&folds.parts[p])).sum();
            assert_eq!((n, m), (17, 51));
        }
    }

    #[test]
    fn the_gap_keeps_neighbours_out_of_training() {
        let pieces = [0..40, 40..100];
        let folds = contiguous(&pieces, 5, 3).unwrap();
        for k in 0..5 {
            let rows = |which: &[usize]| -> Vec<usize> {
                which.iter().flat_map(|&p| folds.parts[p].iter().cloned().flatten()).collect()
            };
            let (held, trained) = (rows(&folds.held_out[k]), rows(&folds.training[k]));
            assert_eq!(held, (20 * k..20 * k + 20).collect::<Vec<_>>());
            for i in 0..100_usize {
                let same_piece = |j: usize| (i < 40) == (j < 40);
                let close = held.iter().any(|&j| same_piece(j) && i.abs_diff(j) <= 3);
                assert_eq!(trained.contains(&i), !close, "fold {k}, row {i}");
            }
        }
    }

    #[test]
    fn splits_do_not_straddle() {
        let s = train_test(&[0..100], 0.5, 7).unwrap();
        assert_eq!((s.train, s.test), (vec![0..50], vec![57..100]));
        let s = train_test(&[0..50, 50..100], 0.5, 7).unwrap();
        assert_eq!((s.train, s.test), (vec![0..50], vec![50..100]));
        let s = train_test(&[0..52, 60..108], 0.5, 7).unwrap();
        assert_eq!((s.train, s.test), (vec![0..50], vec![60..108]));
        assert!(matches!(train_test(&[0..100], 0.5, 60), Err(SparseError::TooFewRows { .. })));
        assert!(matches!(train_test(&[0..100], 1.0, 0), Err(SparseError::Option { .. })));
    }

    #[test]
    fn random_folds_partition_and_repeat() {
        let a = random_for_demonstration(&[0..30], 3, 5).unwrap();
        assert_eq!(a, random_for_demonstration(&[0..30], 3, 5).unwrap());
        let mut rows: Vec<usize> = a.parts.iter().flatten().cloned().flatten().collect();
        rows.sort_unstable();
        assert_eq!(rows, (0..30).collect::<Vec<_>>());
    }

    #[test]
    fn bad_numbers_are_errors() {
        assert!(matches!(contiguous(&[0..10], 1, 0), Err(SparseError::Option { .. })));
        assert!(matches!(contiguous(&[0..3], 4, 0), Err(SparseError::TooFewRows { .. })));
        assert!(matches!(contiguous(&[0..10], 2, 50), Err(SparseError::TooFewRows { .. })));
        assert!(matches!(contiguous(&[], 2, 0), Err(SparseError::Empty { .. })));
        assert_eq!(minimum(&[f64::NAN, f64::NAN]), None);
        assert_eq!(minimum(&[f64::NAN, 2.0, 2.0, 3.0]), Some(2));
    }
}
