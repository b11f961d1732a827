//! The score test of all candidates, and a whole diagnosis, on an oscillator that lacks its Coulomb friction.
#![allow(missing_docs, clippy::unwrap_used)]

use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_calibrate::{Data, FitPoint, Limits, Point, Setup, free_parameters};
use greybox_diagnose::candidate::candidates;
use greybox_diagnose::place::places;
use greybox_diagnose::screen::screen;
use greybox_diagnose::{Options, Quiet, built_in, diagnose};
use greybox_model::{Hold, Model, System};
use greybox_recording::{Channel, Recording};
use greybox_simulate::{Environment, Method, Seeds, Signal, integrate};

/// The oscillator, with or without friction.
fn model(friction: &str) -> Model {
    let text = format!(
        r#"
[inputs]
f = {{ unit = "N" }}
[states]
x = {{ unit = "m" }}
[parameters]
m  = {{ value = 2.0, unit = "kg" }}
c  = {{ value = 1.0, unit = "N s/m" }}
k  = {{ value = 6.0, unit = "N/m" }}
[equations]
motion = "m*x'' + c*x' + k*x{friction} = f"
"#
    );
    Model::from_toml(&text, "bench.toml").unwrap()
}

fn recording() -> Recording {
    let rubbing = model(" + 3*sign(x')");
    let system = System::compile(&rubbing).unwrap();
    let parameters: Vec<f64> = rubbing.parameters.iter().map(|p| p.value).collect();
    let time: Vec<f64> = (0..1000).map(|k| 0.02 * f64::from(k)).collect();
    let force: Vec<f64> = time.iter().map(|t| 10.0 * t.sin() + 15.0 * (3.1 * t).sin()).collect();
    let input = Signal::new(Hold::Linear, 0.02, &force, |_| Vec::new());
    let environment = Environment { start: 0.0, dt: 0.02, len: 1000, inputs: vec![input], forces: vec![] };
    let method = Method::Dp5 { substeps: 2 };
    let run = integrate(&system, &environment, &parameters, &[0.0; 2], 0..1000, method, &Seeds::default());
    let x: Vec<f64> = run.y.iter().map(|x| (1000.0 * x).round() / 1000.0).collect();
    let channel = |name: &str, values: Vec<f64>| Channel { name: name.into(), unit: None, values };
    Recording::from_columns("bench.csv", time, vec![channel("f", force), channel("x", x)]).unwrap()
}

fn all(c: &mut Criterion) {
    let (model, recording, library) = (model(""), recording(), built_in().unwrap());
    let data = Arc::new(Data::new(&model, std::slice::from_ref(&recording)).unwrap());
    let setup = Setup::new(&model, data, free_parameters(&model)).unwrap();
    let level = setup.windows(200, 20_000);
    let scale = setup.data.spread.clone();
    let point = Point { parameters: setup.values(), starts: setup.starts(&level, &setup.values()) };
    let fit = setup.fit(&level, &scale, &[point], Limits::default());
    let all = candidates(&model, &library, &places(&model));
    let mut group = c.benchmark_group("oscillator, 1000 samples");
    group.sample_size(10);
    group.bench_function("score test of all candidates", |b| {
        b.iter(|| {
            screen(
                FitPoint { setup: &setup, level: &level, scale: &scale, point: &fit.point },
                &library,
                &all,
            )
        });
    });
    group.bench_function("whole diagnosis", |b| {
        let train = std::slice::from_ref(&recording);
        b.iter(|| diagnose(&model, train, &[], &Options::default(), &Quiet).unwrap());
    });
    group.finish();
}

criterion_group!(group, all);
criterion_main!(group);
