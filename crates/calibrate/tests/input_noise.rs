//! The noise of an input that was measured: told where it shows, and of no command.

use std::sync::Arc;

use crate::common::{OSCILLATOR, force, measure, normal};
use greybox_calibrate::input_noise::{InputNoise, findings, input_noise};
use greybox_calibrate::{Data, Setup};
use greybox_model::Model;
use greybox_recording::{Channel, Finding, Recording, Severity};

const DT: f64 = 0.01;
const N: usize = 3000;

/// What is told of an oscillator that `truth` drives, where `logged` stands in the column of the force.
fn reported(truth: &[f64], logged: &[f64], noise: f64) -> (Vec<InputNoise>, Vec<Finding>) {
    told_by(OSCILLATOR, truth, logged, noise)
}

/// The same by another model than the truth.
fn told_by(by: &str, truth: &[f64], logged: &[f64], noise: f64) -> (Vec<InputNoise>, Vec<Finding>) {
    let model = Model::from_toml(OSCILLATOR, "m.toml").unwrap();
    let mut y = measure(&model, truth, DT, &[0.0, 0.0]).remove(0);
    for (y, e) in y.iter_mut().zip(normal(77, N)) {
        *y += noise * e;
    }
    let channel =
        |name: &str, values: &[f64]| Channel { name: name.into(), unit: None, values: values.to_vec() };
    let time = (0..N).map(|k| k as f64 * DT).collect();
    let run = Recording::from_columns("run.csv", time, vec![channel("f", logged), channel("x", &y)]).unwrap();
    let model = Model::from_toml(by, "m.toml").unwrap();
    let setup = Setup::new(&model, Arc::new(Data::new(&model, &[run]).unwrap()), vec![]).unwrap();
    let run = setup.training_run(&setup.values(), &setup.data.sigma);
    (input_noise(&setup, &setup.values(), &run), findings(&setup, &setup.values(), &run, true))
}

fn multisine(lines: &[f64]) -> Vec<f64> {
    (0..N)
        .map(|k| lines.iter().map(|f| (2.0 * std::f64::consts::PI * f * k as f64 * DT + f * f).sin()).sum())
        .collect()
}

#[test]
fn noise_of_a_measured_input_is_told_with_its_size() {
    let truth = multisine(&[0.3, 0.7, 1.1, 2.3]);
    let noisy: Vec<f64> = truth.iter().zip(normal(5, N)).map(|(u, e)| u + 0.2 * e).collect();
    let (found, words) = reported(&truth, &noisy, 2e-4);
    assert_eq!(found.len(), 1);
    let found = found[0];
    assert!((found.sigma / 0.2 - 1.0).abs() < 0.1 && !found.rounded, "{found:?}");
    // What the simulation leaves is what the noise makes of it, and the noise of the output.
    assert!((found.effect.hypot(found.noise) / found.residual - 1.0).abs() < 0.3, "{found:?}");
    assert_eq!((words[0].severity, words[0].code), (Severity::Warning, "input_noise"));
    assert_eq!(words[0].channel.as_deref(), Some("f"));
    assert!(words[0].message.starts_with("If this input is a measurement, its noise of 0."), "{}", words[0]);
    // Where the output is noisier than that, nothing is to be said.
    assert!(reported(&truth, &noisy, 2e-2).0.is_empty());
}

#[test]
fn a_coarse_sensor_of_an_input_is_told() {
    let truth = multisine(&[0.3, 0.7, 1.1, 2.3]);
    let rounded: Vec<f64> = truth.iter().map(|u| (u / 0.5).round() * 0.5).collect();
    let (found, _) = reported(&truth, &rounded, 2e-5);
    assert!(found.len() == 1 && found[0].rounded, "{found:?}");
    assert!((found[0].sigma / (0.5 / 12f64.sqrt()) - 1.0).abs() < 0.05, "{found:?}");
}

#[test]
fn commands_are_no_noisy_measurements() {
    let held = |every: usize, seed: u64| -> Vec<f64> {
        let levels = normal(seed, N);
        (0..N).map(|k| levels[k / every]).collect()
    };
    let sign = |u: Vec<f64>| u.into_iter().map(f64::signum).collect::<Vec<f64>>();
    let commands = [
        ("multisine", multisine(&[0.3, 1.7, 4.9, 9.1, 14.3])),
        ("fast multisine", multisine(&[1.0, 5.0, 11.0, 23.0, 37.0, 44.0])),
        ("white", normal(1, N)),
        ("filtered white", force(2, N, DT, 5.0, 1.0)),
        ("steps", held(50, 3)),
        ("random levels", held(4, 4)),
        ("binary", sign(held(7, 5))),
        ("fast binary", sign(normal(6, N))),
        ("rounded", multisine(&[0.3, 1.7, 4.9]).iter().map(|u| (u * 1e3).round() / 1e3).collect()),
        ("sweep", (0..N).map(|k| (0.02 * (k as f64 * DT).powi(3)).sin()).collect()),
        ("constant", vec![2.0; N]),
    ];
    // A spring that is far off leaves too much to prove anything.
    let off = OSCILLATOR.replace("20.0", "28.0");
    for (what, u) in commands {
        let (found, _) = reported(&u, &u, 1e-5);
        assert!(found.is_empty(), "{what}: {found:?}");
        let (found, _) = told_by(&off, &u, &u, 2e-4);
        assert!(found.is_empty(), "{what}, wrong model: {found:?}");
    }
}

#[test]
fn an_input_that_is_kept_between_its_samples_is_a_command() {
    let truth = multisine(&[0.3, 0.7, 1.1, 2.3]);
    let noisy: Vec<f64> = truth.iter().zip(normal(5, N)).map(|(u, e)| u + 0.2 * e).collect();
    let held = OSCILLATOR.replace("unit = \"N\" }", "unit = \"N\", hold = \"zero\" }");
    assert!(held != OSCILLATOR && told_by(&held, &truth, &noisy, 2e-4).0.is_empty());
    assert_eq!(reported(&truth, &noisy, 2e-4).0.len(), 1);
}
