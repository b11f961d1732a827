//! Algorithm 2 on made-up columns.
use greybox_delay::taylor::{Data, Options, Order, Search, TaylorError, search};
use greybox_sparse::Resample;
use greybox_sparse::select::logspace;
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
    let options = Options { thresholds: logspace(0.05, 0.2, 5), ..Options::thesis(0, 0) };
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
fn dependent_columns_end_the_search() {
    let (mut train, f) = made(300, 0.01, 0.0, 1);
    let (mut test, g) = made(300, 0.01, 0.0, 2);
    train[6] = train[5].iter().map(|c| 3.0 * c).collect();
    test[6] = test[5].iter().map(|c| 3.0 * c).collect();
    let (train, test) = (Data { columns: &train, target: &f }, Data { columns: &test, target: &g });
    let found = search(train, test, &ORDERS, &Options::thesis(1, 0)).unwrap();
    assert_eq!(found.models.len(), 2);
    assert_eq!(found.model().unwrap().active(), [0, 2, 5]);
    let error = search(train, test, &ORDERS[2..], &Options::thesis(1, 0)).unwrap_err();
    assert_eq!(error, TaylorError::Dependent { order: 3, column: 6 });
}

#[test]
fn single_rows_understate_the_scatter_that_blocks_show() {
    let order = [Order { order: 1, columns: 6 }];
    let spread = |seed: u64, options: &Options| {
        let (train, f) = made(600, 0.3, 0.8, 100 + seed);
        let data = Data { columns: &train, target: &f };
        let found = search(data, data, &order, options).unwrap();
        (found.models[0].coefficients[2], found.models[0].std[2])
    };
    // Truth: the scatter of the coefficient over fresh recordings.
    let options = |resample, seed| Options { thresholds: vec![0.0], resample, ..Options::thesis(1, seed) };
    let rows = Resample::Rows { ratio: 1.0 };
    let squares: f64 = (0..60).map(|seed| (spread(seed, &options(rows, seed)).0 - 2.0).powi(2)).sum();
    let scatter = (squares / 60.0).sqrt();
    let claimed = |resample| (0..20).map(|seed| spread(seed, &options(resample, seed)).1).sum::<f64>() / 20.0;
    let (single, blocks) = (claimed(rows), claimed(Resample::Blocks { length: 40, circular: true }));
    assert!(single < 0.6 * scatter, "{single} {scatter}");
    assert!((blocks / scatter - 1.0).abs() < 0.35, "{blocks} {scatter}");
}

#[test]
fn bad_input_is_refused() {
    let (train, f) = made(60, 0.01, 0.0, 1);
    let data = Data { columns: &train, target: &f };
    let base = Options::thesis(1, 0);
    let with = |options: &Options| search(data, data, &ORDERS, options).unwrap_err();
    let regression = |error: &TaylorError| matches!(error, TaylorError::Regression(_));
    assert_eq!(search(data, data, &[], &base).unwrap_err(), TaylorError::NoOrder);
    assert!(regression(&with(&Options { replicates: 0, ..base.clone() })));
    let nothing = Resample::Rows { ratio: f64::NAN };
    assert!(regression(&with(&Options { resample: nothing, ..base.clone() })));
    assert!(regression(&with(&Options { thresholds: vec![], ..base.clone() })));
    assert!(regression(&with(&Options { thresholds: vec![-1.0], ..base.clone() })));
    assert!(matches!(with(&Options { tolerance: -1.0, ..base.clone() }), TaylorError::Tolerance { .. }));
    assert!(matches!(with(&Options { protected: 7, ..base.clone() }), TaylorError::Orders { order: 1, .. }));
    let short = Data { columns: &train[..5], target: &f };
    assert!(matches!(
        search(short, data, &ORDERS, &base),
        Err(TaylorError::Columns { data: "training", .. })
    ));
    let cut = Data { columns: &train, target: &f[1..] };
    assert!(matches!(search(data, cut, &ORDERS, &base), Err(TaylorError::Rows { data: "test", .. })));
    let mut spoiled = train.clone();
    spoiled[9][17] = f64::NAN;
    let error = search(data, Data { columns: &spoiled, target: &f }, &ORDERS, &base).unwrap_err();
    assert!(error.to_string().contains("77"), "{error}");
}
