//! Sequentially thresholded least squares (Brunton, Proctor & Kutz 2016, the SINDy algorithm).

use std::collections::BTreeMap;

use crate::error::{SparseError, check_range};
use crate::protect::checked;
use crate::triangle::{Fit, Triangle};

/// What is compared with the threshold λ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Threshold {
    /// |cⱼ| < λ is dropped: λ has the unit of the coefficients. Right where they are of one size.
    Raw,
    /// |cⱼ| ‖Pⱼ‖ / ‖p‖ < λ is dropped: the term's share of the target's norm, free of units and scales.
    Normalised,
}

/// Fits the full model, drops the terms below the threshold, refits by QR, and repeats until none is dropped.
/// Protected columns stay. Columns that depend on others before them do not take part.
///
/// # Errors
/// [`SparseError::Option`] for a negative or non-finite threshold, [`SparseError::NoSuchColumn`] and
/// [`SparseError::RankDeficient`] for bad protected columns, [`SparseError::ZeroTarget`] if normalised.
///
/// ```
/// use greybox_sparse::stlsq::{Threshold, stlsq};
/// use greybox_sparse::{Rows, Triangle};
/// let (a, b) = ([1.0, 2.0, 3.0, 5.0], [1.0, -1.0, 0.5, 0.0]);
/// let y = [2.01, 3.99, 6.0, 10.0];
/// let triangle = Triangle::of_rows(&Rows::new(&[&a, &b], &y)?, &[0..4])?;
/// assert_eq!(stlsq(&triangle, &[], 0.1, Threshold::Raw)?.support(), [0]);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn stlsq(
    triangle: &Triangle,
    protected: &[usize],
    threshold: f64,
    kind: Threshold,
) -> Result<Fit, SparseError> {
    let mut path = stlsq_path(triangle, protected, &[threshold], kind)?;
    path.pop().ok_or(SparseError::Empty { what: "thresholds" })
}

/// [`stlsq`] for many thresholds from one factor; a support met before is not fitted again.
///
/// # Errors
/// As [`stlsq`]; [`SparseError::Empty`] without thresholds.
pub fn stlsq_path(
    triangle: &Triangle,
    protected: &[usize],
    thresholds: &[f64],
    kind: Threshold,
) -> Result<Vec<Fit>, SparseError> {
    if thresholds.is_empty() {
        return Err(SparseError::Empty { what: "thresholds" });
    }
    let protected = checked(protected, triangle.columns())?;
    let scale: Vec<f64> = match kind {
        Threshold::Raw => vec![1.0; triangle.columns()],
        Threshold::Normalised => {
            let target = triangle.target_norm();
            if target == 0.0 {
                return Err(SparseError::ZeroTarget);
            }
            (0..triangle.columns()).map(|j| triangle.norm(j) / target).collect()
        }
    };
    let start = triangle.independent(&protected)?;
    let mut fits: BTreeMap<Vec<usize>, Fit> = BTreeMap::new();
    thresholds
        .iter()
        .map(|&threshold| {
            check_range("threshold", threshold, 0.0, f64::MAX, "a finite number, not negative")?;
            let mut active = start.clone();
            loop {
                let fit = match fits.get(&active) {
                    Some(fit) => fit.clone(),
                    None => {
                        let fit = triangle.fit(&active)?;
                        fits.insert(active.clone(), fit.clone());
                        fit
                    }
                };
                let before = active.len();
                active.retain(|&j| {
                    fit.coefficients[j].abs() * scale[j] >= threshold || protected.binary_search(&j).is_ok()
                });
                if active.len() == before {
                    return Ok(fit);
                }
            }
        })
        .collect()
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::rows::Rows;
    use crate::testing::{design, normal};

    fn sparse_problem() -> (Vec<Vec<f64>>, Vec<f64>) {
        let (columns, _) = design(400, 8, 21);
        let noise = normal(400, 77);
        let y =
            (0..400).map(|i| 2.0 * columns[1][i] - columns[4][i] + 0.01 * columns[6][i] + 0.05 * noise[i]);
        let y = y.collect();
        (columns, y)
    }

    fn triangle(columns: &[Vec<f64>], y: &[f64]) -> Triangle {
        Triangle::of_rows(&Rows::from_vecs(columns, y).unwrap(), &[0..y.len()]).unwrap()
    }

    #[test]
    fn keeps_the_large_terms_and_the_protected_ones() {
        let (columns, y) = sparse_problem();
        let t = triangle(&columns, &y);
        assert_eq!(stlsq(&t, &[], 0.2, Threshold::Raw).unwrap().support(), [1, 4]);
        let fit = stlsq(&t, &[6], 0.2, Threshold::Raw).unwrap();
        assert_eq!(fit.support(), [1, 4, 6]);
        assert!((fit.coefficients[6] - 0.01).abs() < 0.01);
        assert_eq!(stlsq(&t, &[], 0.0, Threshold::Raw).unwrap().support().len(), 8);
        assert!(stlsq(&t, &[], 1e9, Threshold::Raw).unwrap().support().is_empty());
    }

    #[test]
    fn the_normalised_threshold_does_not_see_units() {
        let (columns, y) = sparse_problem();
        let scales = [1e6, 1e-6, 3.0, 1e-3, 1e4, 1.0, 1e2, 1e-5];
        let scaled: Vec<Vec<f64>> =
            columns.iter().zip(scales).map(|(c, s)| c.iter().map(|v| v * s).collect()).collect();
        let grid = [1e-4, 1e-3, 3e-3, 1e-2, 0.1, 0.3, 0.7];
        let a = stlsq_path(&triangle(&columns, &y), &[], &grid, Threshold::Normalised).unwrap();
        let b = stlsq_path(&triangle(&scaled, &y), &[], &grid, Threshold::Normalised).unwrap();
        for (a, b) in a.iter().zip(&b) {
            assert_eq!(a.support(), b.support());
            assert!((a.rss - b.rss).abs() < 1e-10 * a.rss);
        }
        let raw = stlsq(&triangle(&scaled, &y), &[], 0.2, Threshold::Raw).unwrap();
        assert_ne!(raw.support(), [1, 4]);
    }

    #[test]
    fn the_path_equals_single_runs() {
        let (columns, y) = sparse_problem();
        let t = triangle(&columns, &y);
        let grid = [0.5, 1e-3, 0.02];
        let path = stlsq_path(&t, &[2], &grid, Threshold::Raw).unwrap();
        for (fit, &l) in path.iter().zip(&grid) {
            assert_eq!(*fit, stlsq(&t, &[2], l, Threshold::Raw).unwrap());
        }
    }

    #[test]
    fn bad_input_is_an_error() {
        let (columns, y) = sparse_problem();
        let t = triangle(&columns, &y);
        assert!(matches!(stlsq(&t, &[], -1.0, Threshold::Raw), Err(SparseError::Option { .. })));
        assert!(matches!(stlsq(&t, &[8], 0.1, Threshold::Raw), Err(SparseError::NoSuchColumn { .. })));
        let zero = triangle(&columns, &[0.0; 400]);
        assert_eq!(stlsq(&zero, &[], 0.1, Threshold::Normalised), Err(SparseError::ZeroTarget));
    }
}
