//! Algorithm 2 on made-up columns.
use greybox_delay::taylor::{Data, Options, Order, Search, TaylorError, logarithmic, search};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

/// Ten columns, of which 0 (small, protected), 2 and 5 count; noise with neighbours correlated by `memory`.
fn made(rows: usize, noise: f64, memory: f64, seed: u64) -> (Vec<Vec<f64>>, Vec<f64>) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let columns: Vec<Vec<f64>> = (0..10)
        .map(|_| {
            let mut state = 0.0;
            (0..rows)
                .map(|_| {
                    state = memory * state + (1.0 - memory * memory).sqrt() * normal();
                    state
                })
                .collect()
        })
        .collect();
    let mut state = 0.0;
    let target = (0..rows)
        .map(|i| {
            state = memory * state + (1.0 - memory * memory).sqrt() * normal();
            0.003 * columns[0][i] + 2.0 * columns[2][i] - 0.5 * columns[5][i] + noise * state
        })
        .collect();
    (columns, target)
}

const ORDERS: [Order; 3] =
    [Order { order: 1, columns: 4 }, Order { order: 2, columns: 6 }, Order { order: 3, columns: 10 }];

fn run(options: &Options) -> Search {
    let (train, f) = made(600, 0.01, 0.0, 1);
    let (test, g) = made(600, 0.01, 0.0, 2);
    search(Data { columns: &train, target: &f }, Data { columns: &test, target: &g }, &ORDERS, options)
        .expect("valid input")
}

#[test]
fn the_smallest_sufficient_order_and_its_terms_are_found() {
    let search = run(&Options::thesis(1, 0));
    let model = search.model().unwrap();
    assert_eq!(model.order, 2);
    assert_eq!(model.active(), [0, 2, 5]);
    assert!((model.coefficients[0] - 0.003).abs() < 0.002, "{:?}", model.coefficients);
    assert!((model.coefficients[2] - 2.0).abs() < 0.002 && (model.coefficients[5] + 0.5).abs() < 0.002);
    assert!(search.models[0].test_error > 100.0 * model.test_error);
}

#[test]
fn what_is_not_protected_falls() {
    let options = Options { thresholds: logarithmic(0.05, 0.2, 5), ..Options::thesis(0, 0) };
    assert_eq!(run(&options).model().unwrap().active(), [2, 5]);
    let options = Options { protected: 1, ..options };
    assert_eq!(run(&options).model().unwrap().active(), [0, 2, 5]);
}

#[test]
fn a_seed_decides_everything() {
    assert_eq!(run(&Options::thesis(1, 3)), run(&Options::thesis(1, 3)));
    assert_ne!(run(&Options::thesis(1, 3)), run(&Options::thesis(1, 4)));
}

#[test]
fn dependent_columns_are_dropped_not_fatal() {
    let (mut train, f) = made(300, 0.01, 0.0, 1);
    let (mut test, g) = made(300, 0.01, 0.0, 2);
    train[6] = train[5].iter().map(|c| 3.0 * c).collect();
    test[6] = test[5].iter().map(|c| 3.0 * c).collect();
    let run = |protected| {
        let (train, test) = (Data { columns: &train, target: &f }, Data { columns: &test, target: &g });
        search(train, test, &ORDERS, &Options::thesis(protected, 0))
    };
    assert_eq!(run(1).unwrap().models[2].active(), [0, 2, 5]);
    assert_eq!(run(7).unwrap_err(), TaylorError::Orders { order: 1, columns: 4 });
    let last = [ORDERS[2]];
    let (train, test) = (Data { columns: &train, target: &f }, Data { columns: &test, target: &g });
    let error = search(train, test, &last, &Options::thesis(7, 0)).unwrap_err();
    assert_eq!(error, TaylorError::Dependent { column: 6 });
}

#[test]
fn single_rows_understate_the_scatter_that_blocks_show() {
    // Truth: the scatter of the coefficient over fresh recordings.
    let estimates: Vec<f64> = (0..60)
        .map(|seed| {
            let (train, f) = made(600, 0.3, 0.8, 100 + seed);
            let data = Data { columns: &train, target: &f };
            let options =
                Options { replicates: 1, ratio: 10.0, thresholds: vec![0.0], ..Options::thesis(1, seed) };
            search(data, data, &[Order { order: 1, columns: 6 }], &options).unwrap().models[0].coefficients[2]
        })
        .collect();
    let scatter = (estimates.iter().map(|c| (c - 2.0).powi(2)).sum::<f64>() / 60.0).sqrt();
    let claimed = |block| {
        let mean: f64 = (0..20)
            .map(|seed| {
                let (train, f) = made(600, 0.3, 0.8, 100 + seed);
                let data = Data { columns: &train, target: &f };
                let base = Options::thesis(1, seed);
                let options = Options { replicates: 60, ratio: 1.0, block, thresholds: vec![0.0], ..base };
                search(data, data, &[Order { order: 1, columns: 6 }], &options).unwrap().models[0].std[2]
            })
            .sum();
        mean / 20.0
    };
    assert!(claimed(1) < 0.5 * scatter, "{} {scatter}", claimed(1));
    assert!((claimed(40) / scatter - 1.0).abs() < 0.35, "{} {scatter}", claimed(40));
}

#[test]
fn bad_input_is_refused() {
    let (train, f) = made(60, 0.01, 0.0, 1);
    let data = Data { columns: &train, target: &f };
    let base = Options::thesis(1, 0);
    let with = |options: &Options| search(data, data, &ORDERS, options).unwrap_err();
    assert_eq!(search(data, data, &[], &base).unwrap_err(), TaylorError::NoOrder);
    assert!(matches!(with(&Options { replicates: 0, ..base.clone() }), TaylorError::Option { .. }));
    assert!(matches!(with(&Options { ratio: f64::NAN, ..base.clone() }), TaylorError::Option { .. }));
    assert!(matches!(with(&Options { thresholds: vec![], ..base.clone() }), TaylorError::Option { .. }));
    assert!(matches!(with(&Options { thresholds: vec![-1.0], ..base.clone() }), TaylorError::Option { .. }));
    assert!(matches!(with(&Options { block: 0, ..base.clone() }), TaylorError::Option { .. }));
    assert!(matches!(with(&Options { ratio: 0.1, ..base.clone() }), TaylorError::TooFewRows { rows: 6, .. }));
    let short = Data { columns: &train[..5], target: &f };
    assert!(matches!(search(short, data, &ORDERS, &base), Err(TaylorError::Shape { data: "training", .. })));
    let cut = Data { columns: &train, target: &f[1..] };
    assert!(matches!(search(data, cut, &ORDERS, &base), Err(TaylorError::Shape { data: "test", .. })));
    let mut spoiled = train.clone();
    spoiled[9][17] = f64::NAN;
    let error = search(data, Data { columns: &spoiled, target: &f }, &ORDERS, &base).unwrap_err();
    assert_eq!(error, TaylorError::NotFinite { data: "test", row: 17 });
}
