//! Spread of coefficients when rows are correlated.

#![allow(clippy::single_range_in_vec_init)]

use greybox_sparse::*;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

fn ar1(random: &mut Pcg64Mcg, n: usize, phi: f64) -> Vec<f64> {
    let mut x = 0.0;
    (0..n)
        .map(|_| {
            let e: f64 = StandardNormal.sample(random);
            x = phi * x + (1.0 - phi * phi).sqrt() * e;
            x
        })
        .collect()
}

/// Share of 95 % intervals that hold the true coefficient: blocks and HAC near 95 %, rows far below.
#[test]
fn blocks_and_hac_cover_where_rows_do_not() {
    let (seeds, n) = (60, 3000);
    let (mut blocks, mut rows, mut hac) = (0, 0, 0);
    for seed in 0..seeds {
        let mut random = Pcg64Mcg::seed_from_u64(1000 + seed);
        let a = ar1(&mut random, n, 0.9);
        let e = ar1(&mut random, n, 0.9);
        let p: Vec<f64> = a.iter().zip(&e).map(|(a, e)| 2.0 * a + e).collect();
        let design = Design::new(&[&a], &p).unwrap();
        let run = |resampling| {
            let b = bootstrap(
                &design,
                std::slice::from_ref(&(0..n)),
                1,
                Selector::StlsqRaw,
                &Penalty::Fixed(0.0),
                &[],
                resampling,
                100,
                seed,
            );
            let (low, high) = b.unwrap().interval(0, 0.95).unwrap();
            u32::from(low <= 2.0 && 2.0 <= high)
        };
        blocks += run(Resampling::Blocks { length: 150 });
        rows += run(Resampling::Rows { ratio: 1.0 });
        let whole = [0..n];
        let c = least_squares(&design, &[0], &whole).unwrap();
        let v = newey_west(&design, &[0], &c, &whole, Bandwidth::Andrews).unwrap();
        hac += u32::from((c[0] - 2.0).abs() <= 1.96 * v[0][0].sqrt());
    }
    assert!(blocks >= 50 && hac >= 50, "blocks {blocks} hac {hac} of {seeds}");
    assert!(rows <= 42, "rows {rows} of {seeds}");
}

#[test]
fn replicates_do_not_depend_on_threads() {
    let mut random = Pcg64Mcg::seed_from_u64(5);
    let (a, b) = (ar1(&mut random, 400, 0.5), ar1(&mut random, 400, 0.5));
    let p: Vec<f64> = a.iter().zip(&b).map(|(a, b)| a + 0.05 * b).collect();
    let design = Design::new(&[&a, &b], &p).unwrap();
    let run = || {
        let resampling = Resampling::HalfOfBlocks { length: 20 };
        let rows = [0..400];
        bootstrap(&design, &rows, 2, Selector::Lasso, &Penalty::Fixed(0.1), &[], resampling, 40, 9).unwrap()
    };
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(run);
    let found = run();
    assert_eq!(one, found);
    assert_eq!(found.inclusion[0], 1.0);
    assert!(found.inclusion[1] < 0.5);
}

/// White's covariance of one column by hand: V = n/(n−1) Σ a²e² / (Σ a²)².
#[test]
fn white_covariance_by_hand() {
    let (a, p) = ([1.0, 2.0, 3.0, 4.0], [1.1, 1.9, 3.3, 3.9]);
    let design = Design::new(&[&a], &p).unwrap();
    let rows = [0..4];
    let c = least_squares(&design, &[0], &rows).unwrap();
    let v = newey_west(&design, &[0], &c, &rows, Bandwidth::Lags(0)).unwrap();
    let meat: f64 = a.iter().zip(&p).map(|(a, p)| (a * (p - c[0] * a)).powi(2)).sum();
    assert!((v[0][0] / (4.0 / 3.0 * meat / 900.0) - 1.0).abs() < 1e-12);
}
