//! What a simulation has no number for is a misfit, not a missing sample.

use crate::common::*;
use greybox_calibrate::{Criterion, Limits, Point};
use greybox_model::Model;

const LOGARITHM: &str = r#"
name = "Logarithm"
[inputs]
f = {}
[states]
rest = { measured = false, initial = 0 }
[parameters]
b = { value = 2.0 }
[equations]
rest = "rest' = 0"
[measurements]
y = "ln(b - f)"
"#;

#[test]
fn an_output_without_a_value_is_not_a_perfect_one() {
    let truth = Model::from_toml(LOGARITHM, "model.toml").unwrap();
    let u: Vec<f64> = (0..200).map(|k| f64::from(k) / 200.0).collect();
    let setup = setup(&truth, &u, 0.01, &measure(&truth, &u, 0.01, &[0.0]));
    let level = setup.level(1);
    let scale = [0.01];
    let point = |b: f64| Point { parameters: vec![b], starts: setup.starts(&level, &[b]) };
    // At b = 0 there is no number at all, at 0.5 for half of the samples; both are worse than a poor fit.
    let cost = |b: f64| setup.with_problem(&level, &scale, |p| p.cost(&point(b)));
    assert!(cost(0.0) > cost(0.5) && cost(0.5) > cost(1.2), "{} {} {}", cost(0.0), cost(0.5), cost(1.2));
    let fit = setup.fit(&level, &scale, &[point(0.5)], Limits { iterations: 50, tolerance: 1e-9 });
    assert!((fit.point.parameters[0] - 2.0).abs() < 0.01, "{:?}", fit.point.parameters);
}

const BURST: &str = r#"
name = "Finite escape time"
[inputs]
f = {}
[states]
x = { unit = "1" }
[parameters]
a = { value = 1.0, unit = "1/s" }
[equations]
growth = "x' = a*x^2 + a*f"
"#;

/// What has diverged stands still at its last sample, which may lie near the mean of the measurements: an error of about
/// 100 %, less than that of many a poor model.
#[test]
fn a_simulation_that_diverges_has_infinite_error() {
    let model = Model::from_toml(BURST, "burst.toml").unwrap();
    let u = vec![0.0; 400];
    // Measured: a slow decay. Simulated from it: x = 1/(1/x0 - a t), which ends at 1 s.
    let measured = vec![(0..400).map(|k| 1.0 - 1e-3 * f64::from(k)).collect()];
    let setup = setup(&model, &u, 0.01, &measured);
    let scores = |a: f64| {
        let run = setup.training_run(&[a], &[0.01]);
        (run.diverged, setup.scores(&run, &[a], f64::INFINITY, None))
    };
    let (diverged, burst) = scores(5.0);
    assert!(diverged && burst[0].rmse.is_infinite() && burst[0].nrmse.is_infinite(), "{burst:?}");
    assert_eq!(Criterion::FreeRun.misfit(&burst), f64::INFINITY);
    let (diverged, slow) = scores(-0.1);
    assert!(!diverged && slow[0].nrmse.is_finite(), "{slow:?}");
}
