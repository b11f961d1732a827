//! Steps across several samples.

mod common;
use std::sync::Arc;

use common::*;
use greybox_model::{Hold, Model, System};
use greybox_simulate::{Force, Method, Seeds, SignalLanes, Simulation, integrate};

const FINE: Method = Method::Adaptive { rtol: 1e-11, atol: 1e-13 };

fn stride(samples: usize) -> Method {
    Method::Rk4Stride { samples }
}

fn pendulum(measured: &[&str]) -> Model {
    let parameters = [("c", 0.3), ("g", 9.0), ("b", 2.0)];
    model(&["u"], &[("x", 2)], &parameters, &["x'' + c*x' + g*sin(x) = b*u"], measured)
}

/// Largest difference over all samples.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn every_sample_is_there_with_an_order_of_four() {
    let m = pendulum(&["x", "x'"]);
    // The length is no multiple of the steps: the last one is shorter.
    let (n, dt) = (1206, 0.005);
    let u: Vec<f64> = (0..n).map(|k| (1.3 * k as f64 * dt).sin()).collect();
    let env = driven(Hold::Linear, dt, &u);
    let exact = run(&m, &env, &[0.4, 0.0], FINE).y;
    let error = |samples| apart(&run(&m, &env, &[0.4, 0.0], stride(samples)).y, &exact);
    let (coarse, fine) = (error(16), error(8));
    assert!(coarse < 4e-4 && fine < 2.5e-5, "{coarse:.1e} {fine:.1e}");
    assert!(coarse / fine > 13.0, "order {}", (coarse / fine).log2());
    let one = run(&m, &env, &[0.4, 0.0], stride(1));
    assert_eq!(one.y, run(&m, &env, &[0.4, 0.0], Method::Rk4 { substeps: 1 }).y);
    let (long, short) = (run(&m, &env, &[0.4, 0.0], stride(16)), one);
    assert!(15 * long.evaluations < short.evaluations, "{} {}", long.evaluations, short.evaluations);
}

#[test]
fn an_input_acts_by_all_of_its_samples() {
    // White noise: a step that looks at three samples of seventeen is far off.
    let m = model(&["u"], &[("x", 2)], &[], &["x'' = u"], &["x'"]);
    let mut state = 7u64;
    let mut noise = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    };
    let u: Vec<f64> = (0..801).map(|_| noise()).collect();
    for hold in [Hold::Zero, Hold::Linear] {
        let env = driven(hold, 0.01, &u);
        let exact = run(&m, &env, &[0.0, 0.0], Method::Rk4 { substeps: 1 });
        let long = run(&m, &env, &[0.0, 0.0], stride(16));
        for k in (0..801).step_by(16) {
            // Position and speed at the end of every step.
            for entry in [0, 801] {
                let off = (long.x[entry + k] - exact.x[entry + k]).abs();
                assert!(off < 1e-12, "{hold:?} {k} {entry}: {off:e}");
            }
        }
        assert!(apart(&long.y, &exact.y) < 0.02);
    }
}

#[test]
fn sensitivities_are_those_of_the_recorded_samples() {
    let n = 301;
    let u: Vec<f64> = (0..n).map(|k| (0.07 * k as f64).sin()).collect();
    for hold in [Hold::Zero, Hold::Linear] {
        let env = driven(hold, 0.01, &u);
        let error = sensitivity_error(&pendulum(&["x", "x'*x"]), &env, &[0.4, 0.1], stride(8), 1e-5);
        assert!(error < 1e-8, "{error:e}");
    }
}

#[test]
fn forces_and_signals_have_their_sensitivities() {
    let m = pendulum(&["x"]);
    let system = System::compile(&m).unwrap();
    let p: Vec<f64> = m.parameters.iter().map(|p| p.value).collect();
    let n = 203;
    let wave = |a: f64, b: f64| -> Vec<f64> { (0..n).map(|k| (a * k as f64 + b).sin()).collect() };
    let (u, force, change) = (wave(0.1, 0.0), wave(0.23, 1.0), wave(0.19, 2.0));
    let side_by_side =
        |a: &[f64], b: &[f64]| -> Vec<f64> { a.iter().zip(b).flat_map(|(a, b)| [*a, *b]).collect() };
    let none = vec![0.0; n];
    let seeds = Seeds {
        signals: Arc::new(SignalLanes {
            lanes: 2,
            weights: vec![0.7, 0.0],
            force: side_by_side(&force, &none),
            inputs: vec![(0, side_by_side(&none, &change))],
            ..SignalLanes::default()
        }),
        ..Seeds::default()
    };
    let at = |f: f64, c: f64, seeds: &Seeds| {
        let u: Vec<f64> = u.iter().zip(&change).map(|(u, v)| u + c * v).collect();
        let mut env = driven(Hold::Linear, 0.01, &u);
        env.forces.push(Force { weights: vec![0.7], samples: force.iter().map(|v| f * v).collect() });
        integrate(&system, &env, &p, &[0.3, 0.0], 0..n, stride(8), seeds)
    };
    let h = 1e-4;
    let dy = at(0.0, 0.0, &seeds).dy;
    for (lane, (high, low)) in [((h, 0.0), (-h, 0.0)), ((0.0, h), (0.0, -h))].into_iter().enumerate() {
        let (high, low) = (at(high.0, high.1, &Seeds::default()).y, at(low.0, low.1, &Seeds::default()).y);
        let difference: Vec<f64> = high.iter().zip(&low).map(|(a, b)| (a - b) / (2.0 * h)).collect();
        let row = &dy[lane * n..(lane + 1) * n];
        let size = difference.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        assert!(
            size > 5e-4 && apart(row, &difference) < 1e-6 * size,
            "{lane}: {:e}",
            apart(row, &difference)
        );
    }
}

#[test]
fn friction_sticks_and_slips_within_a_step() {
    let m =
        model(&["u"], &[("x", 2)], &[("f", 1.1), ("k", 4.0)], &["x'' + f*sign(x') + k*x = u"], &["x", "x'"]);
    let (n, dt) = (1500, 0.004);
    let u: Vec<f64> = (0..n).map(|k| 1.5 * (1.1 * k as f64 * dt).sin()).collect();
    let env = driven(Hold::Linear, dt, &u);
    let exact = run(&m, &env, &[0.8, 0.3], FINE);
    let long = run(&m, &env, &[0.8, 0.3], stride(8));
    assert!(exact.events > 2 && long.events == exact.events, "{} {}", long.events, exact.events);
    let off = apart(&long.y, &exact.y);
    assert!(off < 1e-6, "{off:e}");
    // At rest it is at rest, at the samples within a step too.
    let resting = |t: &greybox_simulate::Trajectory| t.y[n..].iter().filter(|v| **v == 0.0).count();
    let (a, b) = (resting(&long), resting(&exact));
    assert!(a > 50 && a.abs_diff(b) <= 2, "{a} {b}");
    let error = |method| sensitivity_error(&m, &env, &[0.8, 0.3], method, 1e-6);
    let (long, short) = (error(stride(8)), error(Method::Rk4 { substeps: 1 }));
    assert!(long < 1e-4, "{long:e} {short:e}");
}

#[test]
fn a_stretch_that_is_cut_at_the_end_of_a_step_goes_on_as_if_it_were_whole() {
    let m = pendulum(&["x"]);
    let system = System::compile(&m).unwrap();
    let p: Vec<f64> = m.parameters.iter().map(|p| p.value).collect();
    let u: Vec<f64> = (0..200).map(|k| (0.1 * k as f64).sin()).collect();
    let env = driven(Hold::Linear, 0.01, &u);
    let seeds = Seeds { parameters: vec![0, 1, 2], ..Seeds::default() };
    let simulation =
        Simulation { system: &system, environment: &env, parameters: &p, method: stride(8), seeds: &seeds };
    let whole = simulation.run(&[0.4, 0.0], 3..200);
    let (first, carry) = simulation.run_on(&[0.4, 0.0], 3..80, None, &[]);
    let (second, _) = simulation.run_on(&[f64::NAN; 2], 80..200, Some(&carry), &[0, 1]);
    // What is recorded ends at sample 79, so that the step to 80 is a short one: they differ by the error of one step.
    assert_eq!(first.y[..70], whole.y[..70]);
    let (y, dy) = (apart(&second.y, &whole.y[77..]), apart(&second.dy[..120], &whole.dy[77..197]));
    assert!(y < 5e-6 && dy < 4e-6, "{y:e} {dy:e}");
}

#[test]
fn a_motion_that_leaves_every_bound_is_held_from_the_first_sample_that_is_not_known() {
    let m = model(&[], &[("x", 1)], &[], &["x' = x^3"], &["x"]);
    let t = run(&m, &free(100, 0.01), &[1.0], stride(8));
    // At 0.5 s it is infinite.
    let at = t.diverged.unwrap();
    assert!((41..=57).contains(&at), "{at}");
    assert!(t.y.iter().all(|v| v.is_finite()) && t.y[at..].iter().all(|v| *v == t.y[at - 1]));
    let exact = |k: usize| (1.0 - 2.0 * 0.01 * k as f64).powf(-0.5);
    assert!((0..32).all(|k| (t.y[k] / exact(k) - 1.0).abs() < 1e-3));
}

#[test]
fn what_needs_every_sample_gets_every_sample() {
    let u: Vec<f64> = (0..100).map(|k| (0.1 * k as f64).sin()).collect();
    let env = driven(Hold::Linear, 0.01, &u);
    let acceleration = pendulum(&["x", "x''"]);
    let late = model(&["u"], &[("x", 2)], &[("tau", 0.033)], &["x'' + x = delay(u, tau)"], &["x"]);
    let sensor = model(&["u"], &[("x", 2)], &[("tau", 0.033)], &["x'' + x = u"], &["delay(x, tau)"]);
    for m in [acceleration, late, sensor] {
        let short = run(&m, &env, &[0.4, 0.0], Method::Rk4 { substeps: 1 });
        assert_eq!(run(&m, &env, &[0.4, 0.0], stride(8)).y, short.y);
    }
}
