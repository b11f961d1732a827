//! The thesis's signals: the reference values of Eq 2.10, erratum E13, agreement with the kernel.

use greybox_algebraic::{AlgebraicError, Column, Hold, Initial, Iterated, Kernel, Restart};

fn force(t: f64) -> f64 {
    10.0 * t.sin() + 40.0 * (4.0 * t).sin()
}

/// The Duffing oscillator of Eq 2.18/2.19 (m 2, k1 6, k3 0.1, c1 1, c2 0.2, c3 1; x(0) = 1, v(0) = 0) by RK4.
fn duffing(dt: f64, samples: usize) -> (Vec<f64>, Vec<f64>) {
    let slope = |t: f64, [x, v]: [f64; 2]| {
        [v, (force(t) - 6.0 * x - 0.1 * x.powi(3) - v - 0.2 * x * x * v - v.powi(3)) / 2.0]
    };
    let along = |[x, v]: [f64; 2], [a, b]: [f64; 2], h: f64| [x + h * a, v + h * b];
    let (mut y, mut xs, mut vs) = ([1.0, 0.0], vec![1.0], vec![0.0]);
    for i in 1..samples {
        let t = (i - 1) as f64 * dt;
        let k1 = slope(t, y);
        let k2 = slope(t + dt / 2.0, along(y, k1, dt / 2.0));
        let k3 = slope(t + dt / 2.0, along(y, k2, dt / 2.0));
        let k4 = slope(t + dt, along(y, k3, dt));
        y = std::array::from_fn(|j| y[j] + dt / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j]));
        xs.push(y[0]);
        vs.push(y[1]);
    }
    (xs, vs)
}

fn close(found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() < tolerance * expected.abs().max(1.0), "{found} for {expected}");
}

#[test]
fn duffing_signals_have_their_reference_values() {
    let (x, v) = duffing(1e-3, 5001);
    for (k, x_ref, v_ref) in [
        (1000, 2.550935075077822, -1.228130128439885),
        (2000, 1.2312936569971542, 3.160320384476708),
        (5000, -0.8088628449402667, 0.47309723567996625),
    ] {
        close(x[k], x_ref, 1e-9);
        close(v[k], v_ref, 1e-9);
    }
    let f: Vec<f64> = (0..=5000).map(|k| force(1e-3 * f64::from(k))).collect();
    let product = |g: fn(f64, f64) -> f64| x.iter().zip(&v).map(|(x, v)| g(*x, *v)).collect::<Vec<_>>();
    let (x2v, v3, x3) = (product(|x, v| x * x * v), product(|_, v| v.powi(3)), product(|x, _| x.powi(3)));
    let form = Iterated::new(2, 2, 1e-3).unwrap();
    let signal = |y: &[f64], order| form.signal(y, order, Hold::Smooth).unwrap();
    let signals = [
        signal(&x, 2),
        signal(&x, 1),
        signal(&x, 0),
        signal(&x2v, 0),
        signal(&v3, 0),
        signal(&x3, 0),
        signal(&f, 0),
    ];
    let reference = [
        [-0.2506008330066818, -0.4006027812029558, -28.9292489418912],
        [0.1765974750682866, -1.2445096378257334, -27.648266743363358],
        [0.16577470432214833, 2.294739599160457, 63.13760601121314],
        [0.6754387928969117, -3.367109957762211, -37.07158660582869],
        [1.1464768165199644, -11.269883579323409, -346.7978371017807],
        [0.7646405695376804, 9.597431904318794, 188.02221519549371],
        [2.0280663138501427, 0.7391689641647543, -42.09093047491933],
    ];
    for (p, values) in signals.iter().zip(reference) {
        for (k, value) in [1000, 2000, 5000].into_iter().zip(values) {
            // The reference is the trapezoidal rule's, whose error is O(Δt²): 2.0280663 for the exact 2.0280700.
            close(p[k], value, 1e-4);
        }
    }
    // P_f = ∫ (T−t) t² f dt by a midpoint rule of 200 000 steps.
    for (k, exact) in [(1000, 2.0280699567), (2000, 0.7391365201), (5000, -42.0910426597)] {
        close(signals[6][k], exact, 1e-8);
    }
    // Eq 2.9 holds at every sample, by the better rule far more closely than E3's 9.5e-7.
    let largest = signals[6].iter().fold(0.0, |a: f64, p| a.max(p.abs()));
    for k in 0..=5000 {
        let [p1, p2, p3, p4, p5, p6, pf] = std::array::from_fn(|j| signals[j][k]);
        let residual = 2.0 * p1 + p2 + 6.0 * p3 + 0.2 * p4 + p5 + 0.1 * p6 - pf;
        assert!(residual.abs() < 1e-9 * largest, "sample {k}: {residual} of {largest}");
    }
}

#[test]
fn e13_the_jerk_keeps_x0_t_squared_until_it_is_subtracted() {
    // x = 3 e^{−t/2} + sin 2t: x(0) = 3, and every derivative is known.
    let dt = 1e-3;
    let at = |g: fn(f64) -> f64| (0..=5000).map(|k| g(dt * f64::from(k))).collect::<Vec<_>>();
    let x = at(|t| 3.0 * (-0.5 * t).exp() + (2.0 * t).sin());
    let jerk = at(|t| -0.375 * (-0.5 * t).exp() - 8.0 * (2.0 * t).cos());
    let second = at(|t| 0.75 * (-0.5 * t).exp() - 4.0 * (2.0 * t).sin());
    let printed = Iterated::new(2, 3, dt).unwrap().with_initial(Initial::Separate);
    let corrected = Iterated::new(2, 3, dt).unwrap().with_initial(Initial::FirstSample);
    let of = |form: &Iterated, y: &[f64], n| form.signal(y, n, Hold::Smooth).unwrap();
    let (p1, p1_corrected, truth) = (of(&printed, &x, 3), of(&corrected, &x, 3), of(&corrected, &jerk, 0));
    let (p2, p2_truth) = (of(&printed, &x, 2), of(&printed, &second, 0));
    for k in (0..=5000).step_by(50) {
        let t = dt * k as f64;
        assert!((p1[k] - truth[k] - 3.0 * t * t).abs() < 1e-7);
        assert!((p1_corrected[k] - truth[k]).abs() < 1e-7);
        assert!((p2[k] - p2_truth[k]).abs() < 1e-7);
        assert!((printed.initial_factor(3, 0, t) - t * t).abs() < 1e-12);
    }
    assert!(p1[5000] - truth[5000] > 70.0);
    // r = 3 needs no initial condition at all (weight t³).
    let third = Iterated::new(3, 3, dt).unwrap();
    assert!((of(&third, &x, 3)[5000] - of(&third, &jerk, 0)[5000]).abs() < 1e-6);
    // And without any of these the form refuses.
    assert!(matches!(
        Iterated::new(2, 3, dt).unwrap().signal(&x, 3, Hold::Smooth),
        Err(AlgebraicError::InitialConditions { order: 3, s_derivatives: 2 })
    ));
}

#[test]
fn at_the_end_of_a_window_it_is_the_kernels_row() {
    let y: Vec<f64> = (0..=60).map(|k| 2.0 + (0.1 * f64::from(k * k % 37)).sin()).collect();
    for initial in [Initial::Eliminated, Initial::FirstSample, Initial::Separate] {
        for (r, q) in [(0, 1), (2, 2), (2, 3), (3, 3), (1, 4), (4, 5)] {
            let kernel = Kernel::new(r, q, 60, 0.05).unwrap().with_initial(initial);
            let form = Iterated::new(r, q, 0.05).unwrap().with_initial(initial);
            for hold in [Hold::Zero, Hold::Linear, Hold::Smooth] {
                for order in 0..=q {
                    let (Ok(weights), Ok(signal)) =
                        (kernel.weights(order, hold), form.signal(&y, order, hold))
                    else {
                        assert!(
                            kernel.weights(order, hold).is_err() && form.signal(&y, order, hold).is_err()
                        );
                        continue;
                    };
                    let size = kernel.scale() * weights.values().iter().map(|v| v.abs()).sum::<f64>();
                    let row = kernel.scale() * weights.apply(&y).unwrap();
                    assert!(
                        (signal[60] - row).abs() < 1e-11 * size,
                        "r {r} q {q} n {order} {hold:?}: {} {row}",
                        signal[60]
                    );
                }
            }
        }
    }
}

#[test]
fn restarted_windows_give_the_rows_of_each_window() {
    let mut y: Vec<f64> = (0..100).map(|k| (0.1 * f64::from(k)).cos()).collect();
    let form = Iterated::new(1, 2, 0.1).unwrap();
    let restart = Restart { intervals: 20, hop: 15, every: 8 };
    fn column(signal: &[f64]) -> [Column<'_>; 1] {
        [Column { signal, order: 1, hold: Hold::Linear }]
    }
    let rows = form.rows(&column(&y), restart).unwrap();
    assert_eq!(rows.starts, [0, 0, 15, 15, 30, 30, 45, 45, 60, 60, 75, 75]);
    assert_eq!(rows.ends[..4], [8, 16, 23, 31]);
    let third = form.signal(&y[15..=35], 1, Hold::Linear).unwrap();
    assert_eq!(rows.columns[0][2..4], [third[8], third[16]]);
    y[33] = f64::NAN;
    let holed = form.rows(&column(&y), restart).unwrap();
    assert_eq!((holed.len(), holed.dropped), (10, 2));
    let bad = |intervals, hop, every| form.rows(&column(&y), Restart { intervals, hop, every }).map(|_| ());
    assert!(matches!(bad(20, 0, 1), Err(AlgebraicError::Hop { .. })));
    assert!(matches!(bad(20, 1, 0), Err(AlgebraicError::Hop { .. })));
    assert!(matches!(bad(20, 1, 21), Err(AlgebraicError::Window { .. })));
    assert!(matches!(bad(usize::MAX, 1, 21), Err(AlgebraicError::TooShort { .. })));
    assert!(matches!(bad(100, 1, 1), Err(AlgebraicError::TooShort { longest: 100, needed: 101 })));
}
