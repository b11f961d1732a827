//! The discrete observer: its lag, its schemes against each other, extended states, missing samples.

use greybox_eso::{Design, EsoError, Fal, Observer, Scheme, record};
use proptest::prelude::*;

const SCHEMES: [Scheme; 3] = [Scheme::Euler, Scheme::Implicit, Scheme::Trapezoidal];

fn root(alpha: f64, delta: f64) -> Fal {
    Fal::new(alpha, delta).expect("a test's own numbers")
}

#[test]
fn the_lag_of_every_scheme_is_the_one_that_is_stated() {
    // A slow ramp in velocity: y = t², y' = 2 t; a state that lags by L shows 2 (t − L).
    let h = 4e-3;
    for scheme in SCHEMES {
        let observer = Observer::new(Design::thesis(), h, scheme).unwrap();
        let mut running = observer;
        let mut last = [0.0; 2];
        for k in 0..500 {
            let t = h * f64::from(k);
            last = running.update(0.01 * t * t, 0.0);
        }
        let lag = h * 499.0 - last[1] / 0.02;
        // Discretised, the derivative of t² is one half step off; that is the lead or lag of the scheme.
        assert!((lag - observer.lag(1).unwrap()).abs() < 1e-6, "{scheme:?}: {lag}");
    }
}

#[test]
fn schemes_agree_for_short_steps_and_the_trapezoidal_is_of_second_order() {
    // Far outside the linear zone, so that the nonlinear solve is at work.
    let design = Design::new([20.0, 60.0, 90.0], [Fal::LINEAR, root(0.5, 1e-4), root(0.25, 1e-4)]).unwrap();
    let end = |scheme: Scheme, h: f64| {
        let mut observer = Observer::new(design, h, scheme).unwrap();
        let mut z = [0.0; 3];
        for k in 0..=(1.0 / h).round() as usize {
            z = observer.update((3.0 * k as f64 * h).sin(), 0.0);
        }
        z
    };
    let exact = end(Scheme::Trapezoidal, 1e-5);
    let off = |z: [f64; 3]| z.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let errors = SCHEMES.map(|scheme| off(end(scheme, 1e-4)));
    assert!(errors[0] < 2e-2 && errors[1] < 2e-2, "{errors:?}");
    assert!(errors[2] < 1e-4, "{errors:?}");
}

#[test]
fn an_implicit_step_solves_its_equation() {
    let laws = [root(0.8, 0.01), root(0.5, 0.02), root(0.0, 0.03)];
    let design = Design::new([30.0, 300.0, 1000.0], laws).unwrap();
    let h = 0.05;
    let mut observer = Observer::new(design, h, Scheme::Implicit).unwrap().with_extended_state(2.0).unwrap();
    let mut before = observer.update(0.3, 0.0);
    for (y, u) in [(0.31, 1.0), (-4.0, -2.0), (100.0, 0.5), (100.0001, 0.0), (99.9, 3.0)] {
        let after = observer.update(y, u);
        let e = after[0] - y;
        let drives = [0.0, 2.0 * u, 0.0];
        for i in 0..3 {
            let next = after.get(i + 1).copied().unwrap_or(0.0);
            let expected = before[i] + h * (next + drives[i] - design.gains()[i] * laws[i].apply(e));
            assert!((after[i] - expected).abs() < 1e-9 * (1.0 + expected.abs()), "state {i} at y = {y}");
        }
        before = after;
    }
}

#[test]
fn the_extended_state_is_the_disturbance() {
    // y'' = 2 u + d with d = −1.5 and a known u.
    let h = 1e-3;
    for scheme in SCHEMES {
        let design = Design::<3>::from_bandwidth(50.0, [Fal::LINEAR; 3]).unwrap();
        let mut observer = Observer::new(design, h, scheme).unwrap().with_extended_state(2.0).unwrap();
        let (mut y, mut v, mut u, mut z) = (0.2, -1.0, 0.0, [0.0; 3]);
        for k in 0..2000 {
            z = observer.update(y, u);
            u = if (k / 100) % 2 == 0 { 1.0 } else { -0.5 };
            let a = 2.0 * u - 1.5;
            y += h * v + 0.5 * h * h * a;
            v += h * a;
        }
        assert!((z[2] + 1.5).abs() < 0.03 && (z[1] - v - h * 1.5).abs() < 0.01, "{scheme:?}: {z:?}, {v}");
    }
}

#[test]
fn zero_phase_with_an_input_knows_the_direction_of_time() {
    // An oscillating disturbance, so that a wrong sign of the input in the backward pass cannot hide.
    let h = 1e-3;
    let design = Design::<3>::from_bandwidth(80.0, [Fal::LINEAR; 3]).unwrap();
    let observer = Observer::new(design, h, Scheme::Trapezoidal).unwrap().with_extended_state(2.0).unwrap();
    let (mut y, mut v, mut ys, mut us, mut ds) = (0.0, 0.5, vec![], vec![], vec![]);
    for k in 0..4000 {
        let t = h * f64::from(k);
        let (u, d) = ((7.0 * t).cos().signum(), (3.0 * t).sin());
        ys.push(y);
        us.push(u);
        ds.push(d);
        let a = 2.0 * u + d;
        y += h * v + 0.5 * h * h * a;
        v += h * a;
    }
    let mut z = vec![[0.0; 3]; ys.len()];
    record::zero_phase(&observer, &ys, Some(&us), &mut z).unwrap();
    for k in 500..3500 {
        assert!((z[k][2] - ds[k]).abs() < 0.02, "at {k}: {} for {}", z[k][2], ds[k]);
    }
}

#[test]
fn zero_phase_turns_the_input_of_a_first_order_plant() {
    // y' = 2 u + d: seen backward, both change their sign.
    let h = 1e-3;
    let design = Design::<2>::from_bandwidth(80.0, [Fal::LINEAR; 2]).unwrap();
    let observer = Observer::new(design, h, Scheme::Trapezoidal).unwrap().with_extended_state(2.0).unwrap();
    let us: Vec<f64> = (0..3000).map(|k| (7e-3 * f64::from(k)).cos().signum()).collect();
    let mut ys = vec![0.0];
    for u in &us[1..] {
        ys.push(ys[ys.len() - 1] + h * (2.0 * u - 1.5));
    }
    // us[k] acts from sample k − 1 here, so the observer gets it one sample earlier.
    let acting: Vec<f64> = us[1..].iter().copied().chain([0.0]).collect();
    let mut z = vec![[0.0; 2]; ys.len()];
    record::zero_phase(&observer, &ys, Some(&acting), &mut z).unwrap();
    for k in 500..2500 {
        assert!((z[k][1] + 1.5).abs() < 1e-6, "at {k}: {:?}", z[k]);
    }
}

#[test]
fn missing_samples_are_bridged() {
    let mut observer = Observer::new(Design::thesis(), 1e-3, Scheme::Trapezoidal).unwrap();
    assert_eq!(observer.update(f64::NAN, 0.0), [0.0, 0.0]);
    let mut z = [0.0; 2];
    for k in 0..1500 {
        let lost = (700..730).contains(&k);
        z = observer.update(if lost { f64::NAN } else { 2e-3 * f64::from(k) }, f64::NAN);
        if k > 600 {
            assert!((z[1] - 2.0).abs() < 1e-6, "at {k}: {z:?}");
        }
    }
    observer.reset();
    assert_eq!(observer.update(5.0, 0.0), [5.0, 0.0]);
    assert!(z[0].is_finite());
}

#[test]
fn what_cannot_work_is_refused() {
    let design = Design::thesis();
    for step in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(Observer::new(design, step, Scheme::Implicit), Err(EsoError::Step { .. })));
    }
    assert!(Observer::new(design, 0.020, Scheme::Euler).is_ok());
    let refused = Observer::new(design, 0.025, Scheme::Euler).unwrap_err();
    assert!(matches!(refused, EsoError::StepTooLong { .. }));
    assert!(refused.to_string().contains("Scheme::Trapezoidal"), "{refused}");
    assert!(Observer::new(design, 10.0, Scheme::Trapezoidal).is_ok());
    let printed = Design::new([100.0, 900.0], [Fal::LINEAR, root(0.25, 0.05).as_printed()]).unwrap();
    assert_eq!(Observer::new(printed, 1e-3, Scheme::Implicit), Err(EsoError::PrintedBranch));
    assert!(Observer::new(printed, 1e-3, Scheme::Euler).is_ok());

    let one = Design::new([10.0], [Fal::LINEAR]).unwrap();
    let one = Observer::new(one, 1e-3, Scheme::Euler).unwrap();
    assert_eq!(one.with_extended_state(1.0), Err(EsoError::NothingToExtend));
    assert!(matches!(one.with_input(f64::NAN), Err(EsoError::InputGain { .. })));
    let y = [0.0; 4];
    assert!(record::forward(&one, &y, Some(&[0.0; 3]), &mut [[0.0]; 4]).is_err());
    assert!(record::zero_phase(&one, &y, None, &mut [[0.0]; 5]).is_err());
    assert!(record::lag_compensated(&one, &y, None, &mut [[0.0]; 3], &mut [[0.0]; 4]).is_err());
    assert!(record::advance(&y, -1.0, &mut [0.0; 4]).is_err());
    assert_eq!(record::advance(&y, 9.0, &mut [0.0; 4]), Ok(0));
    assert_eq!(record::zero_phase(&one, &[], None, &mut []), Ok(()));
}

#[test]
fn the_limit_of_euler_is_where_it_is_said_to_be() {
    // The error recursion of the linear regime, without the guard of Observer::new.
    let design = Design::<3>::from_bandwidth(30.0, [Fal::LINEAR; 3]).unwrap();
    let [l1, l2, l3] = design.linear_gains();
    let size_after = |h: f64| {
        let mut z = [1e-3, 0.0, 0.0];
        for _ in 0..20_000 {
            let e = z[0];
            z = [z[0] + h * (z[1] - l1 * e), z[1] + h * (z[2] - l2 * e), z[2] - h * l3 * e];
        }
        z[0].abs()
    };
    let limit = design.euler_limit();
    assert!(size_after(0.998 * limit) < 1e-6 && size_after(1.002 * limit) > 1.0);
}

proptest! {
    /// Whatever the samples and the step, an implicit observer stays finite and near what it is shown.
    #[test]
    fn implicit_schemes_never_diverge(
        samples in prop::collection::vec(-1e3..1e3_f64, 1..80),
        h in 1e-6..10.0_f64,
        alpha in 0.0..1.0_f64,
        delta in 1e-3..1.0_f64,
        omega in 1.0..300.0_f64,
    ) {
        let design = Design::from_bandwidth(omega, [Fal::LINEAR, root(alpha, delta)]).unwrap();
        let mut observer = Observer::new(design, h, Scheme::Implicit).unwrap();
        for &y in &samples {
            let z = observer.update(y, 0.0);
            prop_assert!(z.iter().all(|z| z.is_finite()), "{:?}", z);
            prop_assert!(z[0].abs() < 1e7);
        }
    }
}

#[test]
fn the_noise_gain_is_the_sum_of_squares_of_the_impulse_response() {
    let laws = [Fal::LINEAR, root(0.5, 0.05), root(0.25, 0.01)];
    let design = Design::<3>::from_bandwidth(60.0, laws).unwrap();
    for scheme in SCHEMES {
        let observer = Observer::new(design, 2e-3, scheme).unwrap().with_extended_state(3.0).unwrap();
        let mut running = observer;
        running.start_at([0.0; 3], 0.0);
        // Small, so that it stays within the linear zones.
        let size = 1e-9;
        let mut sums = [0.0; 3];
        for k in 0..5000 {
            let z = running.update(if k == 0 { size } else { 0.0 }, 0.0);
            for (sum, z) in sums.iter_mut().zip(z) {
                *sum += (z / size) * (z / size);
            }
        }
        for (state, sum) in sums.iter().enumerate() {
            let gain = observer.noise_gain(state).unwrap();
            assert!(
                (gain / sum.sqrt() - 1.0).abs() < 1e-9,
                "{scheme:?}, state {state}: {gain} {}",
                sum.sqrt()
            );
        }
    }
}

#[test]
fn the_noise_gain_of_one_state_is_as_by_hand() {
    // Implicit Euler: z ← (z + hβ y)/(1 + hβ), whose variance is hβ/(2 + hβ). Explicit: hβ/(2 − hβ).
    for (h, beta) in [(1e-3, 50.0), (1e-6, 1e-3), (10.0, 1e3)] {
        let design = Design::new([beta], [Fal::LINEAR]).unwrap();
        let implicit = Observer::new(design, h, Scheme::Implicit).unwrap().noise_gain(0).unwrap();
        let exact = (h * beta / (2.0 + h * beta)).sqrt();
        assert!((implicit / exact - 1.0).abs() < 1e-6, "{implicit} {exact}");
        if h * beta < 1.0 {
            let euler = Observer::new(design, h, Scheme::Euler).unwrap().noise_gain(0).unwrap();
            let exact = (h * beta / (2.0 - h * beta)).sqrt();
            assert!((euler / exact - 1.0).abs() < 1e-6, "{euler} {exact}");
        }
    }
    let observer = Observer::new(Design::thesis(), 1e-3, Scheme::Euler).unwrap();
    assert_eq!(observer.noise_gain(2), Err(EsoError::State { state: 2, order: 2 }));
}
