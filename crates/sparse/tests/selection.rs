//! Known answers and recovery.

#![allow(clippy::single_range_in_vec_init)]

use greybox_sparse::*;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

fn normal(random: &mut Pcg64Mcg, n: usize) -> Vec<f64> {
    (0..n).map(|_| StandardNormal.sample(random)).collect()
}

fn ar1(random: &mut Pcg64Mcg, n: usize, phi: f64) -> Vec<f64> {
    let mut x = 0.0;
    let e = normal(random, n);
    e.iter()
        .map(|e| {
            x = phi * x + (1.0 - phi * phi).sqrt() * e;
            x
        })
        .collect()
}

/// NIST StRD, Longley (lower-difficulty data, higher-difficulty conditioning): certified coefficients.
#[test]
fn longley_to_certified_digits() {
    let y = [
        60323., 61122., 60171., 61187., 63221., 63639., 64989., 63761., 66019., 67857., 68169., 66513.,
        68655., 69564., 69331., 70551.,
    ];
    let x = [
        [
            83.0, 88.5, 88.2, 89.5, 96.2, 98.1, 99.0, 100.0, 101.2, 104.6, 108.4, 110.8, 112.6, 114.2, 115.7,
            116.9,
        ],
        [
            234289., 259426., 258054., 284599., 328975., 346999., 365385., 363112., 397469., 419180.,
            442769., 444546., 482704., 502601., 518173., 554894.,
        ],
        [
            2356., 2325., 3682., 3351., 2099., 1932., 1870., 3578., 2904., 2822., 2936., 4681., 3813., 3931.,
            4806., 4007.,
        ],
        [
            1590., 1456., 1616., 1650., 3099., 3594., 3547., 3350., 3048., 2857., 2798., 2637., 2552., 2514.,
            2572., 2827.,
        ],
        [
            107608., 108632., 109773., 110929., 112075., 113270., 115094., 116219., 117388., 118734.,
            120445., 121950., 123366., 125368., 127852., 130081.,
        ],
        [
            1947., 1948., 1949., 1950., 1951., 1952., 1953., 1954., 1955., 1956., 1957., 1958., 1959., 1960.,
            1961., 1962.,
        ],
    ];
    let one = [1.0; 16];
    let columns: Vec<&[f64]> = std::iter::once(&one[..]).chain(x.iter().map(|c| &c[..])).collect();
    let certified = [
        -3482258.63459582,
        15.0618722713733,
        -0.0358191792925910,
        -2.02022980381683,
        -1.03322686717359,
        -0.0511041056535807,
        1829.15146461355,
    ];
    let design = Design::new(&columns, &y).unwrap();
    let active: Vec<usize> = (0..7).collect();
    let c = least_squares(&design, &active, &[0..16]).unwrap();
    for (c, exact) in c.iter().zip(certified) {
        assert!(((c - exact) / exact).abs() < 1e-10, "{c} {exact}");
    }
    let sample = Sample::new(&design, &[0..16]).unwrap();
    let full = sample.solve(&active, &sample.normalised(7)).unwrap();
    for (c, exact) in full.iter().zip(certified) {
        assert!(((c - exact) / exact).abs() < 1e-6, "{c} {exact}");
    }
    assert!((sample.rss(&c) - 836424.055505915).abs() < 1.0);
}

#[test]
fn lasso_on_an_orthogonal_design_is_soft_thresholding() {
    let columns = [vec![1.0, 1.0, 1.0, 1.0], vec![1.0, -1.0, 1.0, -1.0], vec![1.0, 1.0, -1.0, -1.0]];
    let p = [4.0, 1.0, 2.5, 0.5];
    let design = Design::new(&slices(&columns), &p).unwrap();
    let sample = Sample::new(&design, &[0..4]).unwrap();
    let norm = p.iter().map(|v| v * v).sum::<f64>().sqrt();
    for lambda in [0.0, 0.1, 0.3, 0.7, 1.0] {
        let c = &lasso(&sample, 3, &[lambda], &[]).unwrap()[0];
        for (j, a) in columns.iter().enumerate() {
            let r = a.iter().zip(&p).map(|(a, p)| a * p).sum::<f64>() / (2.0 * norm);
            assert!((c[j] - soft_threshold(r, lambda) * norm / 2.0).abs() < 1e-13);
        }
    }
}

#[test]
fn lasso_meets_its_optimality_conditions_on_correlated_columns() {
    let mut random = Pcg64Mcg::seed_from_u64(1);
    let x: Vec<f64> = normal(&mut random, 300);
    let v: Vec<f64> = normal(&mut random, 300);
    let library = Library::tensor(&["x", "v"], &[4, 4]);
    let columns = library.evaluate(&[&x, &v], &[]).unwrap();
    let noise = normal(&mut random, 300);
    let p: Vec<f64> = (0..300).map(|i| x[i] - 0.3 * x[i].powi(3) + v[i] + 0.5 * noise[i]).collect();
    let design = Design::new(&slices(&columns), &p).unwrap();
    let sample = Sample::new(&design, &[0..300]).unwrap();
    let mut weights = vec![1.0; 24];
    weights[1] = 0.0;
    weights[5] = 2.0;
    let grid = log_grid(1e-4, 0.5, 12);
    let n = sample.normalised(24);
    for (lambda, c) in grid.iter().zip(lasso(&sample, 24, &grid, &weights).unwrap()) {
        let beta: Vec<f64> = c.iter().zip(&n.unit).map(|(c, u)| c / u).collect();
        assert!(beta[1] != 0.0);
        for j in 0..24 {
            let g: f64 = n.cross[j] - (0..24).map(|i| n.correlation[j * 24 + i] * beta[i]).sum::<f64>();
            let bound = lambda * weights[j];
            if beta[j] == 0.0 {
                assert!(g.abs() <= bound + 1e-6, "{j} {g} {bound}");
            } else {
                assert!((g - bound * beta[j].signum()).abs() < 1e-6, "{j} {g} {bound}");
            }
        }
    }
}

#[test]
fn twelve_decades_of_scale_change_nothing() {
    let mut random = Pcg64Mcg::seed_from_u64(2);
    let base: Vec<Vec<f64>> = (0..6).map(|_| normal(&mut random, 400)).collect();
    let noise = normal(&mut random, 400);
    let p: Vec<f64> = (0..400).map(|i| 2.0 * base[0][i] - base[3][i] + 0.1 * noise[i]).collect();
    let scaled: Vec<Vec<f64>> = base
        .iter()
        .enumerate()
        .map(|(j, c)| c.iter().map(|v| v * 10f64.powi(3 * j as i32 - 9)).collect())
        .collect();
    for selector in [
        Selector::StlsqNormalised,
        Selector::LassoRefit,
        Selector::Lasso,
        Selector::Backward,
        Selector::BestSubset,
    ] {
        let run = |columns: &[Vec<f64>]| {
            let design = Design::new(&slices(columns), &p).unwrap();
            let sample = Sample::new(&design, &[0..400]).unwrap();
            selector.path(&sample, 6, &[0.05], &[]).unwrap()
        };
        for (a, b) in run(&base).iter().zip(run(&scaled)) {
            for j in 0..6 {
                let b = b[j] * 10f64.powi(3 * j as i32 - 9);
                assert!((a[j] - b).abs() < 1e-9, "{selector:?} {j} {} {b}", a[j]);
            }
        }
    }
}

#[test]
fn best_subsets_agree_with_enumeration_and_beat_backward() {
    let mut random = Pcg64Mcg::seed_from_u64(3);
    let common = normal(&mut random, 60);
    let columns: Vec<Vec<f64>> = (0..8)
        .map(|_| normal(&mut random, 60).iter().zip(&common).map(|(a, c)| a + 1.5 * c).collect())
        .collect();
    let p: Vec<f64> = normal(&mut random, 60).iter().zip(&common).map(|(a, c)| a + c).collect();
    let design = Design::new(&slices(&columns), &p).unwrap();
    let sample = Sample::new(&design, &[0..60]).unwrap();
    let best = best_subsets(&sample, 8, &[2]).unwrap();
    let steps = backward(&sample, 8, &[2]).unwrap();
    assert_eq!(best.len(), 8);
    for (best, step) in best.iter().zip(&steps) {
        let size = support(best).len();
        let mut least = f64::INFINITY;
        for mask in 0u32..256 {
            if mask & 4 != 0 && mask.count_ones() as usize == size {
                let active: Vec<usize> = (0..8).filter(|j| mask >> j & 1 == 1).collect();
                least = least.min(sample.rss(&least_squares(&design, &active, &[0..60]).unwrap()));
            }
        }
        assert!((sample.rss(best) - least).abs() < 1e-9 * least, "{size}");
        assert!(sample.rss(step) >= least * (1.0 - 1e-12) && best[2] != 0.0 && step[2] != 0.0);
    }
}

#[test]
fn effective_rows_of_ar1() {
    let mut random = Pcg64Mcg::seed_from_u64(4);
    for phi in [0.0, 0.5, 0.9] {
        let e = ar1(&mut random, 100_000, phi);
        let expected = 1e5 * (1.0 - phi) / (1.0 + phi);
        let found = effective_rows(&[&e[..50_000], &e[50_000..]]);
        assert!((found / expected - 1.0).abs() < 0.12, "{phi} {found} {expected}");
    }
}

#[test]
fn search_finds_the_order_and_the_terms() {
    let mut right = 0;
    for seed in 0..20 {
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let x = ar1(&mut random, 4000, 0.95);
        let v = ar1(&mut random, 4000, 0.95);
        let noise = ar1(&mut random, 4000, 0.8);
        let p: Vec<f64> = (0..4000)
            .map(|i| 6.0 * x[i] + 0.4 * x[i].powi(3) + v[i] + 0.5 * x[i] * x[i] * v[i] + 0.1 * noise[i])
            .collect();
        let library = Library::tensor(&["x", "v"], &[5, 5]);
        let columns = library.evaluate(&[&x, &v], &[]).unwrap();
        let views = slices(&columns);
        let problem = Problem { columns: &views, target: &p, orders: library.sizes(), pieces: &[] };
        let found = search(&problem, &Options { gap: 20, ..Options::raw() }).unwrap();
        let names = library.names();
        let active: Vec<&str> = found.best().active.iter().map(|&j| names[j].as_str()).collect();
        right += usize::from(
            found.chosen == 2 && active == ["x", "v", "x^2*v", "x^3"] || active == ["x", "v", "x^3", "x^2*v"],
        );
    }
    assert!(right >= 18, "{right}/20");
}

#[test]
fn bad_input_is_named() {
    let a = [1.0, f64::NAN];
    assert!(matches!(Design::new(&[&a], &[1.0, 2.0]), Err(SparseError::NotFinite { row: 1, .. })));
    assert!(matches!(Design::new(&[&[1.0]], &[1.0, 2.0]), Err(SparseError::Length { found: 1, .. })));
    let (a, b) = ([1.0, 2.0, 3.0], [2.0, 4.0, 6.0]);
    let design = Design::new(&[&a, &b], &[1.0, 0.0, 1.0]).unwrap();
    let error = least_squares(&design, &[0, 1], &[0..3]).unwrap_err();
    assert_eq!(error, SparseError::RankDeficient { column: 1, others: vec![0] });
    let sample = Sample::new(&design, &[0..3]).unwrap();
    assert!(stlsq(&sample, 2, &[0.1], Threshold::Raw, &[]).is_err());
    assert!(Selector::StlsqRaw.path(&sample, 7, &[0.1], &[]).is_err());
    assert!(Selector::StlsqRaw.path(&sample, 2, &[f64::NAN], &[]).is_err());
    assert!(Sample::new(&design, &[0..9]).is_err());
    assert!(folds::contiguous(std::slice::from_ref(&(0..4)), 3, 2).is_err());
}
