//! What must not change when columns are rescaled, reordered or turned round.
#![allow(clippy::single_range_in_vec_init)]

use greybox_sparse::folds::contiguous;
use greybox_sparse::select::{Selector, path};
use greybox_sparse::{Fit, Rows, Triangle};
use proptest::prelude::*;

const ROWS: usize = 40;
const SELECTORS: [Selector; 5] = [
    Selector::StlsqNormalised,
    Selector::Lasso,
    Selector::LassoRefit,
    Selector::Backward,
    Selector::BestSubset,
];

fn fit(selector: Selector, columns: &[Vec<f64>], y: &[f64], parameter: f64) -> Fit {
    let rows = Rows::from_vecs(columns, y).unwrap();
    let triangle = Triangle::of_rows(&rows, &[0..y.len()]).unwrap();
    let value = if matches!(selector, Selector::Backward | Selector::BestSubset) { 2.0 } else { parameter };
    path(selector, &triangle, &[0], &[value]).unwrap().pop().unwrap()
}

/// Whether a few thousandths around the parameter leave the support: then rounding may decide.
fn borderline(selector: Selector, columns: &[Vec<f64>], y: &[f64], parameter: f64) -> bool {
    let at = |p: f64| fit(selector, columns, y, p).support();
    at(parameter * 0.999) != at(parameter * 1.001)
}

fn column() -> impl Strategy<Value = Vec<f64>> {
    prop::collection::vec(-1.0..1.0, ROWS)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn scales_signs_and_order_do_not_matter(
        columns in prop::collection::vec(column(), 5),
        noise in column(),
        exponents in prop::collection::vec(-6..6_i32, 5),
        signs in prop::collection::vec(any::<bool>(), 5),
        shift in 0..4_usize,
        parameter in 0.02..0.4_f64,
    ) {
        let y: Vec<f64> = (0..ROWS)
            .map(|i| 1.5 * columns[0][i] - columns[2][i] + 0.2 * columns[3][i] + 0.3 * noise[i])
            .collect();
        let factors: Vec<f64> = exponents
            .iter()
            .zip(&signs)
            .map(|(&e, &s)| 10f64.powi(e) * if s { -1.0 } else { 1.0 })
            .collect();
        // The protected column stays first; the others rotate.
        let order: Vec<usize> = std::iter::once(0).chain((0..4).map(|i| 1 + (i + shift) % 4)).collect();
        let changed: Vec<Vec<f64>> =
            order.iter().map(|&j| columns[j].iter().map(|v| v * factors[j]).collect()).collect();
        for selector in SELECTORS {
            if borderline(selector, &columns, &y, parameter) {
                continue;
            }
            let (a, b) = (fit(selector, &columns, &y, parameter), fit(selector, &changed, &y, parameter));
            for (at, &j) in order.iter().enumerate() {
                let back = b.coefficients[at] * factors[j];
                prop_assert_eq!(a.coefficients[j] == 0.0, back == 0.0, "{:?}", selector);
                prop_assert!((a.coefficients[j] - back).abs() < 1e-4 * a.coefficients[j].abs().max(1e-2));
            }
            prop_assert!((a.rss - b.rss).abs() <= 1e-4 * a.rss);
        }
    }

    #[test]
    fn the_target_scales_the_coefficients(
        columns in prop::collection::vec(column(), 3),
        y in column(),
        exponent in -6..6_i32,
    ) {
        let factor = 10f64.powi(exponent);
        let scaled: Vec<f64> = y.iter().map(|v| v * factor).collect();
        for selector in SELECTORS {
            if borderline(selector, &columns, &y, 0.1) {
                continue;
            }
            let (a, b) = (fit(selector, &columns, &y, 0.1), fit(selector, &columns, &scaled, 0.1));
            for (a, b) in a.coefficients.iter().zip(&b.coefficients) {
                prop_assert!((a * factor - b).abs() <= 1e-4 * factor * a.abs().max(1e-2));
            }
        }
    }

    #[test]
    fn best_subsets_are_never_worse_than_elimination(
        columns in prop::collection::vec(column(), 6),
        y in column(),
    ) {
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let triangle = Triangle::of_rows(&rows, &[0..ROWS]).unwrap();
        let sizes = [6.0, 5.0, 4.0, 3.0, 2.0, 1.0, 0.0];
        let best = path(Selector::BestSubset, &triangle, &[], &sizes).unwrap();
        let greedy = path(Selector::Backward, &triangle, &[], &sizes).unwrap();
        for ((best, greedy), size) in best.iter().zip(&greedy).zip(sizes) {
            prop_assert_eq!(best.support().len(), size as usize);
            prop_assert!(best.rss <= greedy.rss * (1.0 + 1e-12));
        }
    }

    #[test]
    fn folds_never_train_on_what_they_judge(
        lengths in prop::collection::vec(1..30_usize, 1..5),
        between in 0..5_usize,
        k in 2..6_usize,
        gap in 0..4_usize,
    ) {
        let mut start = 0;
        let pieces: Vec<_> = lengths
            .iter()
            .map(|&n| {
                let piece = start..start + n;
                start += n + between;
                piece
            })
            .collect();
        if let Ok(folds) = contiguous(&pieces, k, gap) {
            let mut judged = 0;
            for fold in 0..k {
                let rows = |which: &[usize]| -> Vec<usize> {
                    which.iter().flat_map(|&p| folds.parts[p].iter().cloned().flatten()).collect()
                };
                let (held, trained) = (rows(&folds.held_out[fold]), rows(&folds.training[fold]));
                prop_assert!(!held.is_empty() && !trained.is_empty());
                prop_assert!(held.iter().all(|row| !trained.contains(row)));
                judged += held.len();
            }
            prop_assert_eq!(judged, lengths.iter().sum::<usize>());
        }
    }
}
