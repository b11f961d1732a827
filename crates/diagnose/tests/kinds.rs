//! Effects with memory, in time, in the sensor, and pairs that only pay together: each is named and sized.
//! The recordings come from an integrator of this file's own (explicit steps, a hundred a sample).

use greybox_diagnose::{Diagnosis, Options, Quiet, Verdict, diagnose};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal, Uniform};

use crate::common::OSCILLATOR;

/// State of the machine: position, velocity, and one of the effect's own.
type State = [f64; 3];

/// What the effect does: force on the left side, slope of its own state, from (t, state, input).
type Effect<'a> = &'a dyn Fn(f64, &State, f64) -> (f64, f64);

fn inputs(seed: u64, n: usize, dt: f64, lines: &[f64], amplitude: f64) -> Vec<f64> {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let phase = Uniform::new(0.0, std::f64::consts::TAU).unwrap();
    let lines: Vec<(f64, f64)> = lines.iter().map(|w| (*w, phase.sample(&mut rng))).collect();
    (0..n).map(|k| lines.iter().map(|(w, p)| amplitude * (w * k as f64 * dt + p).sin()).sum()).collect()
}

/// x'' + 0.6 x' + 42 x + effect = f, seen `late` seconds later.
fn record(seed: u64, u: &[f64], dt: f64, effect: Effect<'_>, late: f64, noise: f64) -> Recording {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed + 77);
    let gauss = Normal::new(0.0, noise).unwrap();
    let fine = 100;
    let h = dt / fine as f64;
    let mut s: State = [0.02, 0.0, 0.0];
    let mut past = Vec::new();
    let mut y = Vec::new();
    let shift = (late / h).round() as usize;
    for k in 0..u.len() {
        let seen = if shift == 0 { s[0] } else { past.len().checked_sub(shift).map_or(0.02, |i| past[i]) };
        y.push(seen + gauss.sample(&mut rng));
        for i in 0..fine {
            past.push(s[0]);
            let slope = |t: f64, s: &State| -> State {
                let w = (t / dt - k as f64).clamp(0.0, 1.0);
                let f = u[k] + w * (u[(k + 1).min(u.len() - 1)] - u[k]);
                let (force, own) = effect(t, s, f);
                [s[1], f - 0.6 * s[1] - 42.0 * s[0] - force, own]
            };
            let t = k as f64 * dt + i as f64 * h;
            let a = slope(t, &s);
            let half: State = std::array::from_fn(|j| s[j] + 0.5 * h * a[j]);
            let b = slope(t + 0.5 * h, &half);
            s = std::array::from_fn(|j| s[j] + h * b[j]);
        }
    }
    let channel = |name: &str, unit: &str, values| Channel {
        name: name.to_string(),
        unit: Some(unit.to_string()),
        values,
    };
    let time = (0..u.len()).map(|k| k as f64 * dt).collect();
    let channels = vec![channel("f", "N", u.to_vec()), channel("x", "m", y)];
    Recording::from_columns(&format!("run{seed}.csv"), time, channels).unwrap()
}

const LINES: [f64; 6] = [1.3, 2.9, 4.7, 6.1, 7.9, 11.3];

fn answer(model: &str, seed: u64, lines: &[f64], effect: Effect<'_>, late: f64) -> Diagnosis {
    let model = Model::from_toml(model, "oscillator.toml").unwrap();
    let (n, dt) = (1600, 0.01);
    let run = |s: u64| record(s, &inputs(s, n, dt, lines, 2.0), dt, effect, late, 1e-3);
    diagnose(&model, &[run(seed)], &[run(seed + 1000)], &Options::default(), &Quiet).unwrap()
}

fn kinds(d: &Diagnosis) -> Vec<&str> {
    d.mechanisms.iter().map(|m| m.kind.as_str()).collect()
}

fn value(d: &Diagnosis, name: &str) -> f64 {
    d.mechanisms[0].parameters.iter().find(|p| p.0 == name).unwrap().2.value
}

#[test]
fn hysteresis_is_named_and_sized() {
    // z' = v − β|v|z − γ v|z|, force 30 z.
    let effect =
        |_: f64, s: &State, _: f64| (30.0 * s[2], s[1] - 12.0 * s[1].abs() * s[2] - 9.0 * s[1] * s[2].abs());
    let d = answer(OSCILLATOR, 1, &LINES, &effect, 0.0);
    assert_eq!(kinds(&d), ["bouc_wen_hysteresis"]);
    for (name, truth) in [("kh", 30.0), ("be", 12.0), ("ga", 9.0)] {
        let v = value(&d, name);
        assert!((v / truth - 1.0).abs() < 0.15, "{name} = {v}, not {truth}");
    }
    // The state is carried: an improved model simulates the held-out recording to the noise.
    let nrmse = d.holdout.improved.scores[0].nrmse / d.noise_floor[0];
    assert!(nrmse < 1.2, "{nrmse} of the noise");
}

#[test]
fn hysteresis_that_is_friction_by_its_equation_is_called_both() {
    // γ = 0: the equation of a contact that lets go over 1/β.
    let effect = |_: f64, s: &State, _: f64| (30.0 * s[2], s[1] - 12.0 * s[1].abs() * s[2]);
    let d = answer(OSCILLATOR, 1, &LINES, &effect, 0.0);
    assert_eq!(kinds(&d), ["presliding_friction"]);
    let found = &d.mechanisms[0];
    let other: Vec<_> = found.alternatives.iter().filter(|a| a.kind == "bouc_wen_hysteresis").collect();
    assert_eq!(other.len(), 1);
    assert!(other[0].equivalent && other[0].confidence == found.confidence && found.confidence > 0.9);
    assert!(other[0].separate.contains("loops"));
}

#[test]
fn a_lag_of_the_actuator_is_named_and_sized() {
    // The actuator's force a follows with 60 ms: 0.06 a' + a = f. (f − a is what the model lacks.)
    let effect = |_: f64, s: &State, f: f64| (f - s[2], (f - s[2]) / 0.06);
    let d = answer(OSCILLATOR, 2, &LINES, &effect, 0.0);
    assert_eq!(kinds(&d), ["actuator_lag"]);
    assert!((value(&d, "ta") / 0.06 - 1.0).abs() < 0.05, "{}", value(&d, "ta"));
}

#[test]
fn a_drift_names_its_parameter() {
    let effect = |t: f64, s: &State, _: f64| (42.0 * 0.02 * t * s[0], 0.0);
    let d = answer(OSCILLATOR, 3, &LINES, &effect, 0.0);
    assert_eq!(kinds(&d), ["parameter_drift"]);
    assert_eq!(d.mechanisms[0].drifting.as_deref(), Some("k"));
    assert!((value(&d, "rate") / 0.02 - 1.0).abs() < 0.05, "{}", value(&d, "rate"));
}

#[test]
fn a_disturbance_in_time_has_its_frequency() {
    let effect = |t: f64, _: &State, _: f64| (0.7 * (2.0 * std::f64::consts::PI * 1.37 * t + 0.4).sin(), 0.0);
    let d = answer(OSCILLATOR, 4, &LINES, &effect, 0.0);
    assert_eq!(kinds(&d), ["periodic_disturbance"]);
    assert!((value(&d, "fd") / 1.37 - 1.0).abs() < 0.002, "{}", value(&d, "fd"));
    assert!((value(&d, "ad") / 0.7 - 1.0).abs() < 0.05, "{}", value(&d, "ad"));
}

#[test]
fn a_delay_of_the_only_sensor_is_declared_the_same_as_one_of_the_only_input() {
    let d = answer(OSCILLATOR, 5, &LINES, &|_, _, _| (0.0, 0.0), 0.034);
    let first = &d.mechanisms[0];
    assert!(first.kind == "sensor_delay" || first.kind == "input_delay", "{:?}", kinds(&d));
    let other = if first.kind == "sensor_delay" { "input_delay" } else { "sensor_delay" };
    assert!(first.alternatives.iter().any(|a| a.kind == other && a.equivalent));
    let late = first.parameters[0].2.value;
    assert!((late / 0.034 - 1.0).abs() < 0.05, "{late}");
}

/// A hardening spring and a softer linear one, so that at the one amplitude in the recording they cancel at
/// the excitation's frequency: either alone makes things worse, both together explain the harmonics.
#[test]
fn a_pair_that_only_pays_together_is_found() {
    let model = OSCILLATOR
        .replace(", std = 0.2 }", ", fixed = true }")
        .replace(", std = 8.0 }", ", fixed = true }")
        .replace("1.1", "1.0")
        .replace("38.0", "42.0");
    let amplitude = 2.0 / (42.0 - 9.0); // of the response to 2 N at 3 rad/s
    let k3 = 900.0;
    let soft = -0.75 * k3 * amplitude * amplitude;
    let effect = move |_: f64, s: &State, _: f64| (soft * s[0] + k3 * s[0].powi(3), 0.0);
    let d = answer(&model, 6, &[3.0], &effect, 0.0);
    let mut found = kinds(&d);
    found.sort_unstable();
    assert_eq!(found, ["cubic_stiffness", "linear_stiffness"]);
}

/// A law that no mechanism of the library has: damping that grows with the cube of the position.
#[test]
fn what_the_library_does_not_know_is_not_named_with_confidence() {
    let effect = |_: f64, s: &State, _: f64| (260.0 * s[0] * s[0] * s[1], 0.0);
    let d = answer(OSCILLATOR, 7, &LINES, &effect, 0.0);
    assert_ne!(d.verdict, Verdict::Consistent);
    let sure = d.mechanisms.iter().any(|m| m.confidence >= 0.9);
    assert!(d.verdict == Verdict::Unexplained || !sure, "{:?}", kinds(&d));
}
