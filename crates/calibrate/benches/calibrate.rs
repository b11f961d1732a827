//! An output-error fit of four parameters and the start, and one linearisation, on an oscillator with a cubic spring.
#![allow(missing_docs, clippy::unwrap_used)]

use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_calibrate::{Data, Limits, Point, Setup, free_parameters};
use greybox_model::{Hold, Model, System};
use greybox_recording::{Channel, Recording};
use greybox_simulate::{Environment, Method, Seeds, Signal, integrate};

const MODEL: &str = r#"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m  = { value = 2.0, unit = "kg" }
c  = { value = 1.0, unit = "N s/m" }
k  = { value = 6.0, unit = "N/m" }
k3 = { value = 1.0, unit = "N/m^3" }
[equations]
motion = "m*x'' + c*x' + k*x + k3*x^3 = f"
"#;

fn all(c: &mut Criterion) {
    let mut model = Model::from_toml(MODEL, "bench.toml").unwrap();
    let system = System::compile(&model).unwrap();
    let truth: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    let time: Vec<f64> = (0..2000).map(|k| 0.01 * f64::from(k)).collect();
    let force: Vec<f64> = time.iter().map(|t| 10.0 * t.sin() + 15.0 * (3.1 * t).sin()).collect();
    let input = Signal::new(Hold::Linear, 0.01, &force, |_| Vec::new());
    let environment = Environment { start: 0.0, dt: 0.01, len: 2000, inputs: vec![input], forces: vec![] };
    let method = Method::Dp5 { substeps: 2 };
    let run = integrate(&system, &environment, &truth, &[0.0; 2], 0..2000, method, &Seeds::default());
    // A sensor of 0.01 m.
    let x: Vec<f64> = run.y.iter().map(|x| (100.0 * x).round() / 100.0).collect();
    let channel = |name: &str, values: Vec<f64>| Channel { name: name.into(), unit: None, values };
    let recording =
        Recording::from_columns("bench.csv", time, vec![channel("f", force), channel("x", x)]).unwrap();
    for (parameter, factor) in model.parameters.iter_mut().zip([1.2, 0.7, 0.9, 1.3]) {
        parameter.value *= factor;
    }
    let data = Arc::new(Data::new(&model, &[recording]).unwrap());
    let setup = Setup::new(&model, data, free_parameters(&model)).unwrap();
    let level = setup.level(4);
    let scale = setup.data.spread.clone();
    let point = Point { parameters: setup.values(), starts: setup.starts(&level, &setup.values()) };
    c.bench_function("rows with sensitivities, 2000 samples", |b| {
        b.iter(|| setup.with_problem(&level, &scale, |p| p.rows(&point, true, None)));
    });
    c.bench_function("fit of four parameters, 2000 samples", |b| {
        b.iter(|| setup.fit(&level, &scale, std::slice::from_ref(&point), Limits::default()));
    });
}

criterion_group!(group, all);
criterion_main!(group);
