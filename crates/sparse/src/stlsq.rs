//! Sequentially thresholded least squares (Brunton, Proctor, Kutz 2016, doi:10.1073/pnas.1517384113).

use std::collections::BTreeMap;

use crate::SparseError;
use crate::design::Design;
use crate::gram::{Normalised, Sample};

/// What is compared with the threshold λ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Threshold {
    /// |cⱼ| in the units of the columns.
    Raw,
    /// |cⱼ| ‖aⱼ‖/‖p‖: the share of the column in the target, free of units.
    Normalised,
}

/// For every threshold λ of the grid: solve, drop the columns below λ, solve again, until none is dropped.
///
/// Works on the first `columns` columns; those in `protected` are never dropped. Every λ starts from the full
/// set. One coefficient per column, zero where dropped.
///
/// # Errors
/// [`SparseError::RankDeficient`] when the full set is dependent, [`SparseError::NoSuchColumn`],
/// [`SparseError::Option`] for a λ that is negative or not finite.
pub fn stlsq(
    sample: &Sample<'_>,
    columns: usize,
    grid: &[f64],
    threshold: Threshold,
    protected: &[usize],
) -> Result<Vec<Vec<f64>>, SparseError> {
    check_grid(grid)?;
    sample.check_size(columns)?;
    Design::check_columns("the protected list", protected, columns)?;
    let normalised = sample.normalised(columns);
    let mut solved: BTreeMap<Vec<usize>, Vec<f64>> = BTreeMap::new();
    let start = live_columns(&normalised, protected)?;
    let mut path = Vec::with_capacity(grid.len());
    for &lambda in grid {
        let mut active = start.clone();
        loop {
            if !solved.contains_key(&active) {
                solved.insert(active.clone(), sample.solve(&active, &normalised)?);
            }
            let c = &solved[&active];
            let kept: Vec<usize> = active
                .iter()
                .zip(c)
                .filter(|&(&j, &c)| {
                    let size = match threshold {
                        Threshold::Raw => c.abs(),
                        Threshold::Normalised => c.abs() / normalised.unit[j],
                    };
                    size >= lambda || protected.contains(&j)
                })
                .map(|(&j, _)| j)
                .collect();
            if kept.len() == active.len() {
                let mut full = vec![0.0; columns];
                active.iter().zip(c).for_each(|(&j, &c)| full[j] = c);
                path.push(full);
                break;
            }
            active = kept;
        }
    }
    Ok(path)
}

/// Columns that are not all zero; a protected column of zeros is an error.
pub(crate) fn live_columns(normalised: &Normalised, protected: &[usize]) -> Result<Vec<usize>, SparseError> {
    let live: Vec<usize> = (0..normalised.columns).filter(|&j| normalised.unit[j] != 0.0).collect();
    match protected.iter().find(|&&j| normalised.unit[j] == 0.0) {
        Some(&column) if normalised.cross.iter().any(|r| *r != 0.0) => {
            Err(SparseError::RankDeficient { column, others: live })
        }
        _ => Ok(live),
    }
}

/// A grid of thresholds or penalties: not empty, finite, not negative.
pub(crate) fn check_grid(grid: &[f64]) -> Result<(), SparseError> {
    if grid.is_empty() {
        return Err(SparseError::Empty {
            what: "the grid of lambda".into(),
            mend: "give at least one value",
        });
    }
    match grid.iter().find(|l| !(l.is_finite() && **l >= 0.0)) {
        Some(&value) => Err(SparseError::Option { name: "lambda", value, expected: "a finite number >= 0" }),
        None => Ok(()),
    }
}

/// `count` values from `low` to `high` with equal ratios.
///
/// ```
/// let grid = greybox_sparse::log_grid(1e-2, 1.0, 3);
/// assert!((grid[1] - 0.1).abs() < 1e-15 && grid[2] == 1.0);
/// ```
#[must_use]
pub fn log_grid(low: f64, high: f64, count: usize) -> Vec<f64> {
    let last = count.saturating_sub(1);
    (0..count)
        .map(|i| if i == last { high } else { low * (high / low).powf(i as f64 / last as f64) })
        .collect()
}
