//! Exact delay regression on the virtual rigs of thesis chapter 3.
mod common;

use common::{DT, Duffing, Joint};
use greybox_algebraic::{Column, Hold, Kernel};
use greybox_delay::exact::{Fit, Gain, Options};
use greybox_delay::windows::{Before, Windowed, fit};
use greybox_recording::smooth::savitzky_golay;
use greybox_simulate::rigs::{DelayedDuffing, RotaryFlexibleJoint};

fn smooth(signal: &[f64], order: usize) -> Column<'_> {
    Column { signal, order, hold: Hold::Smooth }
}

/// m x″ + c₁ x′ + c₂ x²x′ + c₃ x′³ + k₁ x + k₃ x³ + g x(t−τ) = f over windows of 1 s; x²x′ = (x³/3)′.
fn duffing(recordings: &[Duffing], gain: Gain) -> Fit {
    let kernel = Kernel::new(2, 3, 1000, DT).unwrap();
    let windowed: Vec<Windowed> = recordings
        .iter()
        .map(|r| {
            let cube: Vec<f64> = r.x.iter().map(|x| x.powi(3)).collect();
            let third: Vec<f64> = cube.iter().map(|x| x / 3.0).collect();
            let drag: Vec<f64> = r.v.iter().map(|v| v.powi(3)).collect();
            let columns = [
                smooth(&r.x, 2),
                smooth(&r.x, 1),
                smooth(&third, 1),
                smooth(&drag, 0),
                smooth(&r.x, 0),
                smooth(&cube, 0),
            ];
            let target = [(1.0, smooth(&r.f, 0))];
            Windowed::new(&kernel, 20, &target, &columns, &r.x, Hold::Smooth, Before::Held(0.5)).unwrap()
        })
        .collect();
    fit(&windowed, &Options::new(gain, 0.0, 0.5)).unwrap()
}

#[test]
fn duffing_without_noise_is_exact() {
    let truth = DelayedDuffing::THESIS;
    let expected = [truth.m, truth.c1, truth.c2, truth.c3, truth.k1, truth.k3];
    for gain in [Gain::Known(-2.0), Gain::Free] {
        let fit = duffing(&[Duffing::training(20.0, 0.0, 0)], gain);
        println!("{gain:?}: tau {} gain {} {:?}", fit.delay, fit.gain, fit.coefficients);
        assert!((fit.delay / 0.2 - 1.0).abs() < 1e-3, "{}", fit.delay);
        for (found, truth) in fit.coefficients.iter().zip(expected) {
            assert!((found / truth - 1.0).abs() < 0.01, "{:?}", fit.coefficients);
        }
    }
}

#[test]
fn duffing_with_noise_needs_a_known_gain() {
    let known: Vec<f64> = (0..6)
        .map(|seed| {
            let both = [Duffing::training(20.0, 0.01, seed), Duffing::test(20.0, 0.01, seed)];
            let fit = duffing(&both, Gain::Known(-2.0));
            println!("known {seed}: {} ± {} {:?}", fit.delay, fit.delay_std, fit.separability);
            (fit.delay / 0.2 - 1.0).abs()
        })
        .collect();
    assert!(common::median(known.clone()) < 0.1, "{known:?}");
    let free: Vec<f64> = (0..6)
        .map(|seed| {
            let fit = duffing(&[Duffing::training(20.0, 0.01, seed)], Gain::Free);
            println!("free {seed}: {} ± {} {:?}", fit.delay, fit.delay_std, fit.separability);
            (fit.delay / 0.2 - 1.0).abs()
        })
        .collect();
    assert!(common::median(free.clone()) > common::median(known), "{free:?}");
}

/// J_eq θ″ + B_eq θ′ − k_s α + f_c sign θ′ + a kₚ θ(t−τ) = a kₚ θ_d + b θ′ over windows of 0.5 s.
fn joint(recording: &Joint, velocity: &[f64]) -> Fit {
    let plant = RotaryFlexibleJoint::WITH_FRICTION;
    let kernel = Kernel::new(2, 3, 500, DT).unwrap();
    let sign: Vec<f64> = velocity.iter().map(|v| (v / 0.05).tanh()).collect();
    let held = |signal| Column { signal, order: 0, hold: Hold::Zero };
    let gain = plant.torque_per_volt * plant.gain;
    let target = [(gain, held(&recording.reference)), (plant.back_emf, smooth(&recording.theta, 1))];
    let columns = [
        smooth(&recording.theta, 2),
        smooth(&recording.theta, 1),
        smooth(&recording.alpha, 0),
        smooth(&sign, 0),
    ];
    let windowed =
        Windowed::new(&kernel, 10, &target, &columns, &recording.theta, Hold::Zero, Before::Held(0.5))
            .unwrap();
    fit(&[windowed], &Options::new(Gain::Known(gain), 0.0, 0.5)).unwrap()
}

#[test]
fn joint_delay_without_noise() {
    for square in [false, true] {
        let recording = Joint::new(square, 60.0, 0.0, 0);
        let fit = joint(&recording, &recording.theta_dot);
        println!("{square}: {} ± {} {:?}", fit.delay, fit.delay_std, fit.coefficients);
        assert!((fit.delay / 0.2 - 1.0).abs() < 1e-3, "{}", fit.delay);
    }
}

#[test]
fn joint_delay_with_noise() {
    for (square, seed) in [(false, 0), (false, 1), (false, 2), (true, 0)] {
        let recording = Joint::new(square, 60.0, 1e-3, seed);
        let velocity = savitzky_golay(&recording.theta, DT, 61, 5).d1;
        let fit = joint(&recording, &velocity);
        println!(
            "{square} {seed}: {} ± {} {:?} {:?}",
            fit.delay, fit.delay_std, fit.coefficients, fit.separability
        );
        assert!((fit.delay / 0.2 - 1.0).abs() < 0.015, "{}", fit.delay);
    }
}
