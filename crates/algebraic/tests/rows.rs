//! Rows of windows: known equations, initial conditions, gaps, streams, properties.

use greybox_algebraic::{AlgebraicError, Column, Hold, Kernel, Stream, Term, rows, rows_of_pieces};
use proptest::prelude::*;

fn column(signal: &[f64], order: usize, hold: Hold) -> Column<'_> {
    Column { signal, order, hold }
}

/// m x'' + c x' + k x = 0 with x(0) = x0, x'(0) = v0, underdamped, in closed form.
fn free_oscillation(m: f64, c: f64, k: f64, x0: f64, v0: f64, dt: f64, samples: usize) -> Vec<f64> {
    let decay = c / (2.0 * m);
    let own = (k / m - decay * decay).sqrt();
    (0..samples)
        .map(|i| {
            let t = i as f64 * dt;
            (-decay * t).exp() * (x0 * (own * t).cos() + (v0 + decay * x0) / own * (own * t).sin())
        })
        .collect()
}

#[test]
fn a_linear_equation_holds_whatever_the_initial_conditions() {
    let kernel = Kernel::new(2, 3, 200, 5e-3).unwrap();
    for (x0, v0) in [(1.0, 0.7), (-40.0, 3.0), (0.0, -9.0), (5.0, 0.0)] {
        let x = free_oscillation(2.0, 1.0, 6.0, x0, v0, 5e-3, 1200);
        let r = rows(&kernel, &[2, 1, 0].map(|n| column(&x, n, Hold::Smooth)), 7).unwrap();
        assert_eq!(r.len(), (1200 - 201) / 7 + 1);
        let size = r.columns[2].iter().fold(0.0, |a: f64, p| a.max(6.0 * p.abs()));
        for i in 0..r.len() {
            let residual = 2.0 * r.columns[0][i] + r.columns[1][i] + 6.0 * r.columns[2][i];
            assert!(residual.abs() < 1e-7 * size, "x0 {x0} v0 {v0} row {i}: {residual} of {size}");
        }
    }
}

#[test]
fn a_held_input_is_exact_with_the_zero_order_hold_only() {
    // x' + 3x = u with u held: x steps exactly. x is read by its own exact integral relation: take the column of
    // (x' + 3x) through the smooth signal between two jumps of u only, and all of u by its hold.
    let (dt, a) = (0.01, 3.0f64);
    let u: Vec<f64> = (0..400).map(|k: usize| f64::from(u32::try_from(k / 50 % 3).unwrap())).collect();
    let mut x = vec![1.3];
    for k in 0..399 {
        x.push(u[k] / a + (x[k] - u[k] / a) * (-a * dt).exp());
    }
    let kernel = Kernel::new(1, 2, 100, dt).unwrap();
    let residual = |hold| {
        let r = rows(
            &kernel,
            &[column(&x, 1, Hold::Smooth), column(&x, 0, Hold::Smooth), column(&u, 0, hold)],
            10,
        )
        .unwrap();
        (0..r.len())
            .map(|i| (r.columns[0][i] + a * r.columns[1][i] - r.columns[2][i]).abs())
            .fold(0.0, f64::max)
    };
    // The kinks of x at the jumps leave an error of second order; a wrong hold is late by half a sample.
    assert!(residual(Hold::Zero) < 2e-4, "{}", residual(Hold::Zero));
    assert!(residual(Hold::Linear) > 3e-3, "{}", residual(Hold::Linear));
}

#[test]
fn a_product_may_be_asked_for_as_a_derivative() {
    let dt = 0.01;
    let x: Vec<f64> = (0..300).map(|k| (dt * f64::from(k)).sin()).collect();
    let x2v: Vec<f64> =
        (0..300).map(|k| (dt * f64::from(k)).sin().powi(2) * (dt * f64::from(k)).cos()).collect();
    let third: Vec<f64> = x.iter().map(|x| x.powi(3) / 3.0).collect();
    let kernel = Kernel::new(2, 3, 100, dt).unwrap();
    let r = rows(&kernel, &[column(&x2v, 0, Hold::Smooth), column(&third, 1, Hold::Smooth)], 9).unwrap();
    assert!(r.columns[0].iter().zip(&r.columns[1]).all(|(a, b)| (a - b).abs() < 1e-8));
}

#[test]
fn windows_never_cross_gaps_and_missing_samples_cost_their_windows_only() {
    let kernel = Kernel::new(1, 2, 10, 0.1).unwrap();
    let ramp = |n: i32| (0..n).map(|k| f64::from(k) * 0.1).collect::<Vec<_>>();
    let (mut a, b, short) = (ramp(40), ramp(25), ramp(5));
    a[17] = f64::NAN;
    let piece = |y| [column(y, 1, Hold::Smooth), column(y, 0, Hold::Linear)];
    let r = rows_of_pieces(&kernel, &[piece(&a), piece(&short), piece(&b)], 3).unwrap();
    assert_eq!(r.pieces, [0, 0, 0, 0, 0, 0, 0, 2, 2, 2, 2, 2]);
    assert_eq!(r.starts, [0, 3, 6, 18, 21, 24, 27, 0, 3, 6, 9, 12]);
    assert_eq!(r.dropped, 3);
    assert!(r.ends.iter().zip(&r.starts).all(|(e, s)| e - s == 10));
    assert!(r.columns[0].iter().all(|slope| (slope - 1.0).abs() < 1e-12));
}

#[test]
fn bad_columns_are_refused_with_their_place() {
    let kernel = Kernel::new(2, 3, 10, 0.1).unwrap();
    let (a, b) = (vec![1.0; 30], vec![1.0; 29]);
    let c = |y| column(y, 0, Hold::Smooth);
    assert!(matches!(rows(&kernel, &[c(&a)], 0), Err(AlgebraicError::Hop { .. })));
    assert_eq!(rows(&kernel, &[], 1), Err(AlgebraicError::NoColumns { piece: 0 }));
    assert_eq!(
        rows(&kernel, &[c(&a), c(&b)], 1),
        Err(AlgebraicError::Lengths { piece: 0, column: 1, found: 29, expected: 30 })
    );
    assert_eq!(rows(&kernel, &[c(&a[..10])], 1), Err(AlgebraicError::TooShort { longest: 10, needed: 11 }));
    assert_eq!(rows(&kernel, &[c(&[])], 1), Err(AlgebraicError::TooShort { longest: 0, needed: 11 }));
    let none: [[Column<'_>; 1]; 0] = [];
    assert!(matches!(rows_of_pieces(&kernel, &none, 1), Err(AlgebraicError::TooShort { longest: 0, .. })));
    assert_eq!(rows(&kernel, &[c(&[f64::NAN; 12])], 1), Err(AlgebraicError::NoRows { dropped: 2 }));
    assert!(matches!(
        rows_of_pieces(&kernel, &[vec![c(&a)], vec![c(&a), c(&a)]], 1),
        Err(AlgebraicError::ColumnsDiffer { piece: 1, column: 1 })
    ));
    assert!(matches!(
        rows(&kernel, &[column(&a, 3, Hold::Smooth)], 1),
        Err(AlgebraicError::InitialConditions { .. })
    ));
}

#[test]
fn a_stream_gives_the_batch_to_the_last_bit() {
    let kernel = Kernel::new(2, 3, 37, 0.02).unwrap();
    let mut x: Vec<f64> = (0..500).map(|k| (0.07 * f64::from(k)).sin()).collect();
    let u: Vec<f64> = (0..500).map(|k| f64::from(k % 11)).collect();
    x[203] = f64::NAN;
    let batch = rows(
        &kernel,
        &[column(&x, 2, Hold::Smooth), column(&x, 0, Hold::Linear), column(&u, 0, Hold::Zero)],
        5,
    )
    .unwrap();
    let term = |signal, order, hold| Term { signal, order, hold };
    let terms = [term(0, 2, Hold::Smooth), term(0, 0, Hold::Linear), term(1, 0, Hold::Zero)];
    let mut stream = Stream::new(&kernel, 2, &terms, 5).unwrap();
    for _ in 0..2 {
        let (mut row, mut count) = ([0.0; 3], 0);
        for (x, u) in x.iter().zip(&u) {
            if let Some(start) = stream.push(&[*x, *u], &mut row).unwrap() {
                assert_eq!(start, batch.starts[count]);
                assert!((0..3).all(|c| row[c].to_bits() == batch.columns[c][count].to_bits()));
                count += 1;
            }
        }
        assert_eq!(count, batch.len());
        stream.reset();
    }
    assert!(stream.push(&[1.0], &mut [0.0; 3]).is_err() && stream.push(&[1.0; 2], &mut [0.0; 2]).is_err());
    assert!(matches!(Stream::new(&kernel, 1, &terms, 5), Err(AlgebraicError::Signal { term: 2, .. })));
    assert!(Stream::new(&kernel, 2, &terms, 0).is_err() && Stream::new(&kernel, 2, &[], 1).is_err());
}

#[test]
fn white_noise_scatters_and_correlates_as_the_weights_say() {
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(1);
    let noise: Vec<f64> = (0..400_000).map(|_| StandardNormal.sample(&mut rng)).collect();
    let kernel = Kernel::new(2, 3, 50, 0.02).unwrap();
    for order in [0, 2] {
        let w = kernel.weights(order, Hold::Smooth).unwrap();
        let r = rows(&kernel, &[column(&noise, order, Hold::Smooth)], 10).unwrap();
        let p = &r.columns[0];
        let mean_of =
            |lag: usize| p.iter().zip(&p[lag..]).map(|(a, b)| a * b).sum::<f64>() / (p.len() - lag) as f64;
        assert!((mean_of(0).sqrt() / w.gain() - 1.0).abs() < 0.02);
        for lag in 1..=6 {
            assert!((mean_of(lag) / mean_of(0) - w.correlation(10 * lag)).abs() < 0.03, "lag {lag}");
        }
        let n = w.effective_rows(r.len(), 10);
        assert!(n > 1.0 && n < r.len() as f64);
        assert_eq!(w.effective_rows(100, 51), 100.0);
        assert!((w.effective_rows(1, 1) - 1.0).abs() < 1e-15 && w.effective_rows(0, 1) == 0.0);
        // The scatter of the residual sum of squares over blocks of 50 rows gives n_eff by itself.
        let blocks: Vec<f64> = p.chunks_exact(50).map(|b| b.iter().map(|p| p * p).sum::<f64>()).collect();
        let mean = blocks.iter().sum::<f64>() / blocks.len() as f64;
        let variance = blocks.iter().map(|b| (b - mean).powi(2)).sum::<f64>() / blocks.len() as f64;
        let seen = 2.0 * mean * mean / variance;
        assert!((seen / w.effective_rows(50, 10) - 1.0).abs() < 0.2, "{seen} {}", w.effective_rows(50, 10));
    }
    let (second, value) =
        (kernel.weights(2, Hold::Smooth).unwrap(), kernel.weights(0, Hold::Smooth).unwrap());
    let both = greybox_algebraic::Weights::combined(&[(2.0, &second), (6.0, &value)]).unwrap();
    assert!((both.values()[20] - 2.0 * second.values()[20] - 6.0 * value.values()[20]).abs() < 1e-12);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn rows_are_linear_and_shift_with_time(
        y in proptest::collection::vec(-1e3f64..1e3, 60),
        z in proptest::collection::vec(-1e3f64..1e3, 60),
        a in -5.0f64..5.0, r in 0usize..5, q in 1usize..6, intervals in 6usize..30, shift in 1usize..20,
    ) {
        let kernel = Kernel::new(r, q, intervals, 0.1).unwrap();
        let order = r.min(q);
        let sum: Vec<f64> = y.iter().zip(&z).map(|(y, z)| a * y + z).collect();
        for hold in [Hold::Zero, Hold::Linear, Hold::Smooth] {
            let of = |y: &[f64]| rows(&kernel, &[column(y, order, hold)], 1).unwrap().columns.remove(0);
            let (py, pz, ps, later) = (of(&y), of(&z), of(&sum), of(&y[shift..]));
            let size = 1e4 * kernel.weights(order, hold).unwrap().values().iter().map(|v| v.abs()).sum::<f64>();
            for i in 0..py.len() {
                prop_assert!((a * py[i] + pz[i] - ps[i]).abs() <= 1e-14 * size);
            }
            prop_assert_eq!(&py[shift..], &later[..]);
        }
    }
}
