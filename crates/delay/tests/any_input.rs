//! Whatever comes in, an answer or an error comes out.
use greybox_delay::bound::{Output, cramer_rao};
use greybox_delay::exact::{self, Gain, Rows};
use greybox_delay::expansion::Expansion;
use greybox_delay::spectrum::DelaySystem;
use greybox_delay::taylor::{self, Data, Order};
use greybox_sparse::{Resample, Selector};
use proptest::prelude::*;

/// Numbers of every kind, ordinary ones most often.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => -10.0..10.0,
        1 => any::<f64>(),
        1 => prop_oneof![Just(0.0), Just(f64::NAN), Just(1e300), Just(-1e-300), Just(f64::INFINITY)],
    ]
}

fn numbers(longest: usize) -> impl Strategy<Value = Vec<f64>> {
    prop::collection::vec(number(), 0..longest)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn exact_fit(
        target in numbers(12),
        columns in prop::collection::vec(numbers(12), 0..3),
        delayed in numbers(16),
        places in prop::collection::vec(0usize..18, 0..12),
        (dt, from, to, gain) in (number(), number(), number(), number()),
        (grid, lags, free) in (0usize..9, 0usize..5, any::<bool>()),
    ) {
        let rows = Rows { target: &target, columns: &columns, delayed: &delayed, places: &places, dt };
        let gain = if free { Gain::Free } else { Gain::Known(gain) };
        let options = exact::Options { gain, from, to, grid, correlated_rows: lags };
        let _ = exact::fit(&[rows, rows], &options);
    }

    #[test]
    fn exact_fit_of_fitting_shapes(
        values in prop::collection::vec((number(), number(), number()), 6..40),
        (to, gain, free, scale) in (0.5..4.0, number(), any::<bool>(), number()),
    ) {
        let target: Vec<f64> = values.iter().map(|v| v.0 * scale).collect();
        let columns = vec![values.iter().map(|v| v.1).collect::<Vec<f64>>()];
        let delayed: Vec<f64> = values.iter().map(|v| v.2 * scale).collect();
        let places: Vec<usize> = (0..values.len()).collect();
        let rows = Rows { target: &target, columns: &columns, delayed: &delayed, places: &places, dt: 1.0 };
        let gain = if free { Gain::Free } else { Gain::Known(gain) };
        if let Ok(fit) = exact::fit(&[rows], &exact::Options { grid: 20, ..exact::Options::new(gain, 0.0, to) }) {
            prop_assert!((0.0..=to).contains(&fit.delay));
        }
    }

    #[test]
    fn algorithm_2(
        values in prop::collection::vec(prop::collection::vec(number(), 4), 1..20),
        (ratio, block, circular) in (number(), 0usize..30, any::<bool>()),
        (protected, seed) in (0usize..5, any::<u64>()),
        (threshold, tolerance, counts) in (number(), number(), prop::collection::vec(0usize..6, 0..4)),
    ) {
        let columns: Vec<Vec<f64>> = (0..3).map(|j| values.iter().map(|v| v[j]).collect()).collect();
        let target: Vec<f64> = values.iter().map(|v| v[3]).collect();
        let data = Data { columns: &columns, target: &target };
        let orders: Vec<Order> = counts.iter().map(|&columns| Order { order: columns, columns }).collect();
        let options = taylor::Options {
            protected,
            replicates: 2,
            resample: match block {
                0 => Resample::Rows { ratio },
                length => Resample::Blocks { length, circular },
            },
            selector: Selector::StlsqRaw,
            thresholds: vec![threshold, 0.1],
            tolerance,
            seed,
        };
        let _ = taylor::search(data, data, &orders, &options);
    }

    #[test]
    fn bounds(columns in prop::collection::vec(numbers(8), 0..4), noise in number()) {
        let slices: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
        let _ = cramer_rao(&[Output { sensitivities: &slices, noise }]);
    }

    #[test]
    fn expansions(gain in number(), order in 0usize..20, derivative in 0usize..20, c in number()) {
        if let Ok(expansion) = Expansion::new(gain, order) {
            let _ = expansion.read(derivative, c, 0.0).map(|r| expansion.reading_std(&r, c));
            let _ = (expansion.truncation(c, gain), expansion.coefficient(derivative, c));
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn spectra(
        a in prop::collection::vec(number(), 4),
        b in prop::collection::vec(number(), 4),
        (delay, count) in (number(), 0usize..4),
    ) {
        let rows = |m: &[f64]| [vec![m[0], m[1]], vec![m[2], m[3]]];
        if let Ok(system) = DelaySystem::new(&rows(&a), &rows(&b), delay)
            && let Ok(roots) = system.roots(count)
        {
            prop_assert!(roots.iter().all(|r| r.re.is_finite() && r.im.is_finite()), "{roots:?}");
        }
    }
}
