//! The weights against closed forms: exactness, order of convergence, what enters at the ends.

use greybox_algebraic::{AlgebraicError, Hold, Initial, Kernel, MAX_DEGREE};

const HOLDS: [Hold; 3] = [Hold::Zero, Hold::Linear, Hold::Smooth];

/// ∫ w y⁽ⁿ⁾ for y = t^p on [0, T], from ∫ u^a (1−u)^b du = a! b!/(a+b+1)!.
fn monomial(kernel: &Kernel, order: usize, p: usize) -> f64 {
    if p < order {
        return 0.0;
    }
    let falling = |n: usize, k: usize| (0..k).map(|i| (n - i) as f64).product::<f64>();
    let beta = |a: usize, b: usize| 1.0 / (falling(a + b + 1, b + 1) / falling(b, b));
    let (r, b) = (kernel.s_derivatives(), kernel.integrations() - 1);
    falling(p, order) * kernel.duration().powi((p - order) as i32) * beta(r + p - order, b) / beta(r, b)
}

fn sampled(kernel: &Kernel, y: impl Fn(f64) -> f64) -> Vec<f64> {
    (0..kernel.samples()).map(|k| y(k as f64 * kernel.dt())).collect()
}

#[test]
fn cubics_are_exact_for_every_order_and_kernel() {
    for r in 0..=6 {
        for q in 1..=7 {
            let kernel = Kernel::new(r, q, 30, 0.05).unwrap().with_initial(Initial::FirstSample);
            for order in 0..=q.min(r + 1) {
                let weights = kernel.weights(order, Hold::Smooth).unwrap();
                for p in 0..=3 {
                    let row = weights.apply(&sampled(&kernel, |t| t.powi(p as i32))).unwrap();
                    let scale = weights.values().iter().map(|v| v.abs()).sum::<f64>() * 1.5f64.powi(p as i32);
                    let exact = monomial(&kernel, order, p);
                    assert!(
                        (row - exact).abs() < 1e-13 * scale.max(1.0),
                        "r {r} q {q} n {order} t^{p}: {row} {exact}"
                    );
                }
            }
        }
    }
}

#[test]
fn separate_initial_conditions_complete_the_integral() {
    // Orders far above r: y = 1 + 2t + 3t² + 4t³ has y(0) = 1, y'(0) = 2, y''(0) = 6.
    let y = |t: f64| 1.0 + 2.0 * t + 3.0 * t * t + 4.0 * t.powi(3);
    let at_start = [1.0, 2.0, 6.0, 24.0];
    for r in 0..=2 {
        let kernel = Kernel::new(r, 5, 50, 0.02).unwrap().with_initial(Initial::Separate);
        for order in 0..=4 {
            let factors = kernel.initial_factors(order);
            assert_eq!(factors.len(), order.saturating_sub(r));
            let row = kernel.weights(order, Hold::Smooth).unwrap().apply(&sampled(&kernel, y)).unwrap();
            let whole = row + factors.iter().zip(at_start).map(|(c, y)| c * y).sum::<f64>();
            let exact: f64 =
                [1.0, 2.0, 3.0, 4.0].iter().enumerate().map(|(p, a)| a * monomial(&kernel, order, p)).sum();
            assert!((whole - exact).abs() < 1e-9, "r {r} n {order}: {whole} {exact}");
        }
    }
    // E13: with Eq 3.10's r = 2, q = n = 3 the unscaled factor is −T².
    let kernel = Kernel::new(2, 3, 40, 0.1).unwrap();
    assert!((kernel.initial_factors(3)[0] * kernel.scale() + 16.0).abs() < 1e-12);
}

#[test]
fn holds_are_exact_for_their_own_signals() {
    // Any samples, joined: the integral cell by cell by a fine midpoint rule of the kernel itself.
    let kernel = Kernel::new(3, 4, 12, 0.1).unwrap();
    let y: Vec<f64> = (0..13).map(|k| f64::from((k * 7919) % 13) - 6.0).collect();
    for hold in [Hold::Zero, Hold::Linear] {
        for order in 0..=3 {
            const FINE: usize = 4000;
            let mut integral = 0.0;
            for k in 0..12 {
                for j in 0..FINE {
                    let s = (j as f64 + 0.5) / FINE as f64;
                    let joined = if hold == Hold::Zero { y[k] } else { y[k] + s * (y[k + 1] - y[k]) };
                    integral += kernel.value(order, (k as f64 + s) / 12.0) * joined * 0.1 / FINE as f64;
                }
            }
            let exact = if order % 2 == 0 { integral } else { -integral };
            let row = kernel.weights(order, hold).unwrap().apply(&y).unwrap();
            assert!((row - exact).abs() < 1e-6 * exact.abs().max(1.0), "{hold:?} n {order}: {row} {exact}");
        }
    }
}

#[test]
fn convergence_has_the_order_of_the_hold() {
    // ∫ w (e^{−2t})⁽ⁿ⁾ over T = 1 with w = 30 t²(1−t)².
    let error = |hold, order: usize, intervals: usize| {
        let row = |hold, intervals: usize| {
            let kernel = Kernel::new(2, 3, intervals, 1.0 / intervals as f64).unwrap();
            kernel.weights(order, hold).unwrap().apply(&sampled(&kernel, |t| (-2.0 * t).exp())).unwrap()
        };
        let mean = 15.0 / 2.0 * (1.0 - 7.0 * (-2.0f64).exp());
        (row(hold, intervals) - mean * (-2.0f64).powi(order as i32)).abs()
    };
    for order in 0..=2 {
        for (hold, expected) in [(Hold::Linear, 2.0), (Hold::Smooth, 4.0)] {
            let rate = (error(hold, order, 20) / error(hold, order, 40)).log2();
            assert!(rate > expected - 0.25, "{hold:?}, derivative {order}: order of convergence {rate}");
        }
        let rate = (error(Hold::Zero, order, 50) / error(Hold::Zero, order, 100)).log2();
        assert!(rate > 0.9, "derivative {order}: {rate}");
    }
}

#[test]
fn a_kernel_has_unit_area_and_its_constant_has_no_derivative() {
    for hold in HOLDS {
        for (r, q) in [(0, 1), (2, 2), (3, 5), (12, 13)] {
            let kernel = Kernel::new(r, q, 64, 1e-3).unwrap();
            let sum = |order| kernel.weights(order, hold).unwrap().values().iter().sum::<f64>();
            assert!((sum(0) - 1.0).abs() < 1e-12);
            for order in 1..=kernel.clean_order() {
                let size = kernel.weights(order, hold).unwrap().gain();
                assert!(sum(order).abs() < 1e-11 * size, "r {r} q {q} n {order}");
            }
        }
    }
}

#[test]
fn the_last_sample_enters_raw_only_when_q_equals_the_order() {
    // Eq 2.10 (q = n = 2) against one more integration: the printed form is far noisier.
    let printed = Kernel::new(2, 2, 1000, 1e-3).unwrap().weights(2, Hold::Smooth).unwrap();
    let clean = Kernel::new(2, 3, 1000, 1e-3).unwrap().weights(2, Hold::Smooth).unwrap();
    assert!(printed.values()[1000].abs() > 10.0 && printed.gain() > 4.0 * clean.gain());
    assert!(clean.values()[1000].abs() < 0.1);
}

#[test]
fn what_cannot_be_is_refused_with_its_reason() {
    let kernel = |r, q, m| Kernel::new(r, q, m, 0.1);
    assert!(matches!(Kernel::new(2, 2, 9, 0.0), Err(AlgebraicError::Step { .. })));
    assert!(matches!(Kernel::new(2, 2, 9, f64::NAN), Err(AlgebraicError::Step { .. })));
    assert!(matches!(kernel(2, 0, 9), Err(AlgebraicError::NoIntegration)));
    assert!(matches!(kernel(usize::MAX, 2, 9), Err(AlgebraicError::Degree { .. })));
    assert!(matches!(kernel(MAX_DEGREE, 2, 9), Err(AlgebraicError::Degree { .. })));
    assert!(matches!(kernel(2, 2, 0), Err(AlgebraicError::Window { .. })));
    let weights = |r, q, m, n| kernel(r, q, m).unwrap().weights(n, Hold::Smooth).map(|_| ());
    assert_eq!(weights(2, 3, 9, 3), Err(AlgebraicError::InitialConditions { order: 3, s_derivatives: 2 }));
    assert_eq!(weights(3, 2, 9, 3), Err(AlgebraicError::EndDerivatives { order: 3, integrations: 2 }));
    assert_eq!(weights(2, 3, 2, 2), Err(AlgebraicError::Window { intervals: 2, order: 2, needed: 3 }));
    let first = kernel(1, 4, 9).unwrap().with_initial(Initial::FirstSample);
    assert!(first.weights(2, Hold::Linear).is_ok());
    assert!(matches!(first.weights(3, Hold::Linear), Err(AlgebraicError::InitialConditions { .. })));
    assert!(matches!(
        first.weights(0, Hold::Zero).unwrap().apply(&[1.0; 9]),
        Err(AlgebraicError::SliceLength { found: 9, expected: 10, .. })
    ));
    assert!(
        AlgebraicError::InitialConditions { order: 3, s_derivatives: 2 }.to_string().contains("first sample")
    );
}

#[test]
fn a_symmetric_kernel_has_symmetric_weights() {
    // τ²(T−τ)² read backwards is itself; so the stencil of the cubics must be centred.
    let kernel = Kernel::new(2, 3, 20, 0.1).unwrap();
    for hold in [Hold::Linear, Hold::Smooth] {
        for order in 0..=2 {
            let weights = kernel.weights(order, hold).unwrap();
            let v = weights.values();
            let mirror = if order == 1 { -1.0 } else { 1.0 };
            for i in 0..=20 {
                assert!(
                    (v[i] - mirror * v[20 - i]).abs() < 1e-13 * weights.gain(),
                    "{hold:?} n {order} i {i}"
                );
            }
        }
    }
}
