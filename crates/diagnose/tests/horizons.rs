//! The optimum is found from far away, and what judges a machine is what it can be judged by. The recordings come from small
//! explicit steps of this file's own.

use greybox_calibrate::Criterion;
use greybox_diagnose::{Calibration, Quiet, calibrate};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};

const NOISE: f64 = 1e-3;

/// θ sampled every 20 ms, where `acceleration` says how (θ, θ′) goes on; dry friction stops the pendulum within a step.
fn record(
    seconds: f64,
    start: (f64, f64),
    dry: f64,
    acceleration: impl Fn(f64, f64) -> f64,
) -> Vec<Recording> {
    let (dt, fine) = (0.02, 400);
    let h = dt / f64::from(fine);
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
    let gauss = Normal::new(0.0, NOISE).unwrap();
    let n = (seconds / dt) as usize;
    let (mut x, mut v) = start;
    let mut values = Vec::new();
    for _ in 0..n {
        values.push(x + gauss.sample(&mut rng));
        for _ in 0..fine {
            let free = v + h * acceleration(x, v);
            v = if free.abs() <= h * dry { 0.0 } else { free - h * dry * free.signum() };
            x += h * v;
        }
    }
    let time = (0..n).map(|k| k as f64 * dt).collect();
    let channel = Channel { name: "q".into(), unit: Some("rad".into()), values };
    vec![Recording::from_columns("run.csv", time, vec![channel]).unwrap()]
}

fn calibrated(model: &str, train: &[Recording]) -> Calibration {
    calibrate(&Model::from_toml(model, "model.toml").unwrap(), train, &[], &Quiet).unwrap()
}

/// Forty swings that hardly decay, with starts a hundred times off: a fit of short segments cannot tell the frictions apart,
/// one of the whole record from there ends in another minimum of the phase.
#[test]
fn a_long_lightly_damped_record_is_fitted_from_far_off() {
    let train = record(60.0, (1.2, 0.0), 0.05, |x, v| -40.0 * x.sin() - 0.01 * v - 0.004 * v * v.abs());
    for factor in [0.01, 100.0] {
        let found = calibrated(
            &format!(
                "[states]\nq = {{ unit = \"rad\" }}\n[parameters]\ng = {{ value = 38, unit = \"1/s^2\", std = 2 }}\n\
                 b = {{ value = {}, unit = \"1/s\" }}\nfc = {{ value = {}, unit = \"1/s^2\" }}\ncd = {{ value = {}, unit = \"1\" }}\n\
                 [equations]\narm = \"q'' + b*q' + fc*sign(q') + cd*q'*abs(q') + g*sin(q) = 0\"\n",
                0.01 * factor,
                0.05 * factor,
                0.004 * factor
            ),
            &train,
        );
        let error = found.train.1[0].rmse;
        assert!(error < 1.2 * NOISE, "{factor}: {error}");
        assert!(found.converged && found.criterion == Criterion::FreeRun, "{factor}");
        let value = |i: usize| found.parameters[i].calibrated.value;
        assert!((value(0) / 40.0 - 1.0).abs() < 1e-3 && (value(2) / 0.05 - 1.0).abs() < 0.1, "{factor}");
    }
}

/// An inverted pendulum that falls: an error of its start, however small, outgrows the motion, and windows judge. The same
/// pendulum that hangs is judged by its free run.
#[test]
fn windows_judge_a_machine_that_falls() {
    let model = |sign: &str| {
        format!(
            "[states]\nq = {{ unit = \"rad\" }}\n[parameters]\ng = {{ value = 8, unit = \"1/s^2\" }}\n\
             [equations]\narm = \"q'' {sign} g*q = 0\"\n"
        )
    };
    let falls = calibrated(&model("-"), &record(5.5, (1e-6, 0.0), 0.0, |x, _| 9.0 * x));
    assert_eq!(falls.criterion, Criterion::Windowed);
    let hangs = calibrated(&model("+"), &record(6.0, (0.5, 0.0), 0.0, |x, _| -9.0 * x));
    assert_eq!(hangs.criterion, Criterion::FreeRun);
    assert!((hangs.parameters[0].calibrated.value / 9.0 - 1.0).abs() < 1e-3);
}
