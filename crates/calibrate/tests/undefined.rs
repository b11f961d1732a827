//! What a simulation has no number for is a misfit, not a missing sample.
#![allow(missing_docs, clippy::unwrap_used)]

mod common;
use common::*;
use greybox_calibrate::{Limits, Point};
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
