//! Small models for the tests, written in the model language.
#![allow(dead_code, missing_docs, unreachable_pub, clippy::unwrap_used)]

use greybox_model::{
    Equation, Hold, Input, Measurement, Model, Parameter, State, System, Unit, Units, parse, parse_equation,
};
use greybox_simulate::{Environment, Method, Seeds, Signal, Trajectory, integrate};

pub fn unit() -> Unit {
    Unit { text: String::new(), ..Unit::dimensionless() }
}

/// `states`: (name, order); all are measured unless `measured` lists expressions.
pub fn model(
    inputs: &[&str],
    states: &[(&str, usize)],
    parameters: &[(&str, f64)],
    equations: &[&str],
    measured: &[&str],
) -> Model {
    Model {
        name: "test".into(),
        units: Units::default(),
        inputs: inputs
            .iter()
            .map(|n| Input {
                name: n.to_string(),
                channel: n.to_string(),
                unit: unit(),
                hold: Hold::Linear,
                range: None,
            })
            .collect(),
        states: states
            .iter()
            .map(|(n, order)| State {
                name: n.to_string(),
                unit: unit(),
                order: *order,
                channel: None,
                initial: vec![],
            })
            .collect(),
        parameters: parameters
            .iter()
            .map(|(n, v)| Parameter {
                name: n.to_string(),
                value: *v,
                unit: Some(unit()),
                std: None,
                fixed: false,
                positive: None,
            })
            .collect(),
        equations: equations
            .iter()
            .enumerate()
            .map(|(i, text)| {
                let e = parse_equation(text).unwrap();
                Equation { name: format!("e{i}"), lhs: e.lhs.expr, rhs: e.rhs.expr }
            })
            .collect(),
        measurements: measured
            .iter()
            .map(|text| Measurement {
                channel: text.to_string(),
                expr: parse(text).unwrap().expr,
                unit: unit(),
            })
            .collect(),
    }
}

pub fn free(n: usize, dt: f64) -> Environment {
    Environment { start: 0.0, dt, len: n, inputs: vec![], forces: vec![] }
}

pub fn driven(hold: Hold, dt: f64, u: &[f64]) -> Environment {
    Environment {
        start: 0.0,
        dt,
        len: u.len(),
        inputs: vec![Signal::new(hold, dt, u, no_upsampling)],
        forces: vec![],
    }
}

fn no_upsampling(_: &[f64]) -> Vec<f64> {
    unreachable!("tests here use zero or linear hold")
}

pub fn run(model: &Model, env: &Environment, x0: &[f64], method: Method) -> Trajectory {
    let system = System::compile(model).unwrap();
    let p: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    integrate(&system, env, &p, x0, 0..env.len, method, &Seeds::default())
}

/// Largest difference between the sensitivities and central differences, relative to the largest
/// sensitivity of each lane.
pub fn sensitivity_error(model: &Model, env: &Environment, x0: &[f64], method: Method, h: f64) -> f64 {
    let system = System::compile(model).unwrap();
    let p: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    let seeds =
        Seeds { parameters: (0..p.len()).collect(), initial: (0..x0.len()).collect(), ..Seeds::default() };
    let base = integrate(&system, env, &p, x0, 0..env.len, method, &seeds);
    let n = base.y.len();
    let mut worst: f64 = 0.0;
    for lane in 0..seeds.lanes() {
        let shifted = |sign: f64| {
            let (mut p, mut x0) = (p.clone(), x0.to_vec());
            let step = if lane < p.len() {
                let step = h * p[lane].abs().max(1e-3);
                p[lane] += sign * step;
                step
            } else {
                x0[lane - p.len()] += sign * h;
                h
            };
            (integrate(&system, env, &p, &x0, 0..env.len, method, &Seeds::default()).y, step)
        };
        let ((plus, step), (minus, _)) = (shifted(1.0), shifted(-1.0));
        let numeric: Vec<f64> = plus.iter().zip(&minus).map(|(a, b)| (a - b) / (2.0 * step)).collect();
        let size = numeric.iter().fold(1e-12f64, |m, v| m.max(v.abs()));
        for (a, b) in base.dy[lane * n..(lane + 1) * n].iter().zip(&numeric) {
            worst = worst.max((a - b).abs() / size);
        }
    }
    worst
}
