//! What forces of free shape explain beside a model: everything that is missing, and nothing of the noise.

use std::sync::Arc;

use greybox_calibrate::{Data, Fit, FitPoint, Limits, Point, Segmentation, Setup, free_parameters};
use greybox_diagnose::discrepancy::{held_out, test};
use greybox_diagnose::evidence::cross_validation_improvement;
use greybox_model::{Hold, Model, System};
use greybox_recording::{Channel, Recording};
use greybox_simulate::{Environment, Method, Seeds, Signal, integrate};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const DT: f64 = 0.02;
const N: usize = 3000;
const SIGMA: f64 = 0.1;

fn model(force: &str) -> Model {
    let text = format!(
        r#"
name = "oscillator"
[inputs]
f = {{ unit = "N" }}
[states]
x = {{ unit = "m" }}
[parameters]
m = {{ value = 1.0, unit = "kg" }}
c = {{ value = 0.8, unit = "N s/m" }}
k = {{ value = 20.0, unit = "N/m" }}
k3 = {{ value = 60.0, unit = "N/m^3" }}
[equations]
mass = "m*x'' + c*x' + {force} = f"
"#
    );
    Model::from_toml(&text, "oscillator.toml").unwrap()
}

/// The oscillator with a cubic spring, its position measured under coloured noise (`correlation` from one sample
/// to the next).
fn record(seed: u64, correlation: f64) -> Recording {
    let truth = model("k*x + k3*x^3");
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let (mut low, mut force) = (0.0, Vec::new());
    for _ in 0..N {
        low += 0.2 * (6.0 * normal() - low);
        force.push(3.0 * low);
    }
    let environment = Environment {
        start: 0.0,
        dt: DT,
        len: N,
        inputs: vec![Signal::new(Hold::Linear, DT, &force, |_| unreachable!("linear hold"))],
        forces: vec![],
    };
    let p: Vec<f64> = truth.parameters.iter().map(|p| p.value).collect();
    let system = System::compile(&truth).unwrap();
    let method = Method::Dp5 { substeps: 4 };
    let run = integrate(&system, &environment, &p, &[0.0, 0.0], 0..N, method, &Seeds::default());
    let mut noise = SIGMA * normal();
    let x = run.y[..N]
        .iter()
        .map(|x| {
            noise = correlation * noise + SIGMA * (1.0 - correlation * correlation).sqrt() * normal();
            x + noise
        })
        .collect();
    let channel = |name: &str, values| Channel { name: name.into(), unit: None, values };
    let time = (0..N).map(|k| k as f64 * DT).collect();
    Recording::from_columns("simulated", time, vec![channel("f", force), channel("x", x)]).unwrap()
}

/// A model fitted to a recording, with a noise model of its own residual if asked for.
fn fitted(force: &str, recording: &Recording, whitened: bool) -> (Setup, Segmentation, Vec<f64>, Fit) {
    let model = model(force);
    let data = Arc::new(Data::new(&model, std::slice::from_ref(recording)).unwrap());
    let mut setup = Setup::new(&model, data, free_parameters(&model)).unwrap();
    let level = setup.windows(N / 4, N);
    let mut scale = vec![SIGMA];
    let parameters = setup.values();
    let starts = setup.starts(&level, &parameters);
    let mut fit = setup.fit(&level, &scale, &[Point { parameters, starts }], Limits::default());
    if whitened {
        let noise = setup.innovations(&level, &scale, &fit.point);
        scale = noise.iter().map(|a| a.variance().sqrt()).collect();
        setup.noise = Some(Arc::new(noise));
        fit = setup.fit(&level, &scale, &[fit.point], Limits::default());
    }
    (setup, level, scale, fit)
}

/// Beside coloured noise the measured motion holds the noise itself, and a function of it would predict the
/// innovations of a model that lacks nothing.
#[test]
fn coloured_noise_is_no_force() {
    let (seeds, mut alarms, mut found, mut sum) = (8, 0, 0, 0.0);
    for seed in 0..seeds {
        let recording = record(seed, 0.95);
        for (force, count) in [("k*x + k3*x^3", &mut alarms), ("k*x", &mut found)] {
            let (setup, level, scale, fit) = fitted(force, &recording, true);
            let s =
                test(FitPoint { setup: &setup, level: &level, scale: &scale, point: &fit.point }).unwrap();
            let gain = s.samples as f64 * s.gain;
            *count += u64::from(s.t > 2.5 && gain > 20.0);
            if force.contains("k3") {
                sum += gain;
            }
        }
    }
    assert_eq!((alarms, found), (0, seeds));
    // Columns that explain nothing cost their own error.
    assert!(sum < 0.0, "{}", sum / seeds as f64);
}

/// A model's own errors on the folds are what the gain of free shapes is measured by; a richer model is compared
/// on the same folds.
#[test]
fn models_and_free_shapes_share_their_folds() {
    let recording = record(1, 0.0);
    let (setup, level, scale, fit) = fitted("k*x", &recording, false);
    let free = test(FitPoint { setup: &setup, level: &level, scale: &scale, point: &fit.point }).unwrap();
    let own =
        held_out(FitPoint { setup: &setup, level: &level, scale: &scale, point: &fit.point }, free.block)
            .unwrap();
    let (ahead, t) = cross_validation_improvement(&own, &free.errors);
    assert!((ahead / own.iter().sum::<f64>() - free.gain).abs() < 1e-12, "{ahead} {}", free.gain);
    assert!((t - free.t).abs() < 1e-9, "{t} {}", free.t);
    assert!(free.gain > 0.5, "{}", free.gain);

    // The law itself is ahead of every free shape.
    let (setup, level, _, fit) = fitted("k*x + k3*x^3", &recording, false);
    let law =
        held_out(FitPoint { setup: &setup, level: &level, scale: &scale, point: &fit.point }, free.block)
            .unwrap();
    let (ahead, t) = cross_validation_improvement(&free.errors, &law);
    assert!(ahead > 0.0 && t > 2.0, "{ahead} {t}");
}
