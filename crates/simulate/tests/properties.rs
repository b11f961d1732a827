//! Properties of the integrators over random oscillators: order, energy, time reversal.
#![allow(missing_docs, clippy::unwrap_used)]

mod common;
use common::*;
use greybox_model::{Hold, Model};
use greybox_simulate::Method;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

const FINE: Method = Method::Adaptive { rtol: 1e-12, atol: 1e-14 };

/// x'' + c x' + k x + h x³ = u
fn duffing(c: f64, k: f64, h: f64) -> Model {
    let parameters = [("c", c), ("k", k), ("h", h)];
    model(&["u"], &[("x", 2)], &parameters, &["x'' + c*x' + k*x + h*x^3 = u"], &["x", "x'"])
}

/// Largest distance of two runs' samples.
fn distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

proptest! {
    #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(1), ..ProptestConfig::with_cases(24) })]

    /// Half the step divides the error by two to the power of the order.
    #[test]
    fn every_method_has_its_order(c in 0.1..0.6f64, k in 4.0..16.0f64, h in -1.0..3.0f64, v in -1.0..1.0f64) {
        let m = duffing(c, k, h);
        let error = |dt: f64, method| {
            let env = driven(Hold::Linear, dt, &[0.0; 17]);
            let at = |method| run(&m, &env, &[1.0, v], method).y;
            distance(&at(method), &at(FINE))
        };
        // The eighth order needs long steps, or rounding is all there is.
        let radian = 1.0 / (k + 3.0 * h.max(0.0)).sqrt();
        let orders = [
            (4.0, [8, 16].map(|substeps| error(0.25, Method::Rk4 { substeps }))),
            (5.0, [8, 16].map(|substeps| error(0.25, Method::Dp5 { substeps }))),
            (8.0, [1, 2].map(|substeps| error(radian, Method::Dop853 { substeps }))),
        ];
        for (order, [coarse, fine]) in orders {
            prop_assert!(fine < 1e-4, "order {order}: {fine}");
            let found = (coarse / fine).log2();
            prop_assert!((order - 0.7..order + 1.6).contains(&found), "order {order}: {coarse} {fine}");
        }
    }

    /// Without damping and force the energy stays: of a nonlinear spring, and of two masses whose springs pass it on.
    #[test]
    fn what_is_conservative_keeps_its_energy(
        k in 1.0..20.0f64, h in 0.0..5.0f64, kc in 0.5..5.0f64, start in prop::array::uniform4(-1.0..1.0f64),
    ) {
        let parameters = [("k", k), ("h", h), ("kc", kc), ("m", 2.0)];
        let equations = ["x'' + k*x + h*x^3 + kc*(x - y) = 0", "m*y'' + 3*sin(y) - kc*(x - y) = 0"];
        let m = model(&[], &[("x", 2), ("y", 2)], &parameters, &equations, &["x", "y", "x'", "y'"]);
        let n = 400;
        let y = run(&m, &free(n, 0.05), &start, FINE).y;
        let energy = |i: usize| {
            let [x, y, v, w] = std::array::from_fn(|c| y[c * n + i]);
            0.5 * v * v + w * w + 0.5 * k * x * x + 0.25 * h * x.powi(4) + 0.5 * kc * (x - y).powi(2)
                + 3.0 * (1.0 - y.cos())
        };
        let first = energy(0);
        prop_assume!(first > 1e-2);
        for i in 0..n {
            prop_assert!((energy(i) / first - 1.0).abs() < 1e-9, "{} of {first} at {i}", energy(i));
        }
    }

    /// Run backwards (the inputs from their end, damping and speed with the other sign), a motion comes to where it
    /// began.
    #[test]
    fn a_motion_run_backwards_comes_to_its_start(
        c in 0.0..0.4f64, k in 1.0..10.0f64, h in 0.0..2.0f64, start in prop::array::uniform2(-1.0..1.0f64),
        u in prop::collection::vec(-2.0..2.0f64, 40),
    ) {
        let n = u.len();
        let reversed: Vec<f64> = u.iter().rev().copied().collect();
        for (method, tolerance) in [(FINE, 1e-8), (Method::Dop853 { substeps: 4 }, 1e-8), (Method::Dp5 { substeps: 40 }, 1e-7)] {
            let there = run(&duffing(c, k, h), &driven(Hold::Linear, 0.1, &u), &start, method).y;
            let turned = [there[n - 1], -there[2 * n - 1]];
            let back = run(&duffing(-c, k, h), &driven(Hold::Linear, 0.1, &reversed), &turned, method).y;
            let positions: Vec<f64> = back[..n].iter().rev().copied().collect();
            prop_assert!(distance(&positions, &there[..n]) < tolerance, "{method:?}");
            prop_assert!((back[2 * n - 1] + start[1]).abs() < tolerance, "{method:?}");
        }
    }
}
