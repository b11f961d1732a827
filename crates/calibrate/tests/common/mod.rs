//! Simulated recordings, and the intervals that Gauss–Newton promises.
#![allow(missing_docs, unreachable_pub, clippy::unwrap_used)]

use std::sync::Arc;

use greybox_calibrate::{Data, Point, Problem, Segmentation, Setup, free_parameters, qr};
use greybox_model::{Hold, Model, System};
use greybox_recording::{Channel, Recording};
use greybox_simulate::{Environment, Method, Seeds, Signal, integrate};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

pub const OSCILLATOR: &str = r#"
name = "Damped oscillator"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.0, unit = "kg" }
c = { value = 1.5, unit = "N s/m" }
k = { value = 20.0, unit = "N/m" }
[equations]
mass = "m*x'' + c*x' + k*x = f"
"#;

pub fn normal(seed: u64, n: usize) -> Vec<f64> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    (0..n).map(|_| StandardNormal.sample(&mut rng)).collect()
}

/// A force with a flat spectrum up to about `corner` Hz: white noise through two first-order lags.
pub fn force(seed: u64, n: usize, dt: f64, corner: f64, size: f64) -> Vec<f64> {
    let a = (-2.0 * std::f64::consts::PI * corner * dt).exp();
    let (mut p, mut q) = (0.0, 0.0);
    let raw: Vec<f64> = normal(seed, n)
        .iter()
        .map(|e| {
            p = a * p + (1.0 - a) * e;
            q = a * q + (1.0 - a) * p;
            q
        })
        .collect();
    let rms = (raw.iter().map(|v| v * v).sum::<f64>() / n as f64).sqrt();
    raw.iter().map(|v| size * v / rms).collect()
}

/// What a finely integrated simulation measures without noise, `[channel][sample]`.
pub fn measure(model: &Model, f: &[f64], dt: f64, x0: &[f64]) -> Vec<Vec<f64>> {
    measure_in(model, f, dt, x0, 8)
}

/// The same in so many steps from sample to sample.
pub fn measure_in(model: &Model, f: &[f64], dt: f64, x0: &[f64], substeps: usize) -> Vec<Vec<f64>> {
    let system = System::compile(model).unwrap();
    let environment = Environment {
        start: 0.0,
        dt,
        len: f.len(),
        inputs: vec![Signal::new(Hold::Linear, dt, f, |_| unreachable!("linear hold"))],
        forces: vec![],
    };
    let p: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    let method = Method::Dp5 { substeps };
    let t = integrate(&system, &environment, &p, x0, 0..f.len(), method, &Seeds::default());
    assert_eq!(t.diverged, None);
    t.y.chunks(t.n).map(<[f64]>::to_vec).collect()
}

/// A set-up from a force and measurements.
pub fn setup(model: &Model, f: &[f64], dt: f64, y: &[Vec<f64>]) -> Setup {
    let mut channels = vec![Channel { name: "f".into(), unit: None, values: f.to_vec() }];
    for (m, y) in model.measurements.iter().zip(y) {
        channels.push(Channel { name: m.channel.clone(), unit: None, values: y.clone() });
    }
    let time = (0..f.len()).map(|k| k as f64 * dt).collect();
    let recording = Recording::from_columns("simulated", time, channels).unwrap();
    let data = Arc::new(Data::new(model, &[recording]).unwrap());
    Setup::new(model, data, free_parameters(model)).unwrap()
}

/// Standard errors of the free parameters by Gauss–Newton, in units of the residual's own: the
/// initial states eliminated, priors of the parameters left out.
pub fn standard_errors(problem: &Problem<'_>, point: &Point) -> Vec<f64> {
    let (nx, np) = (problem.system.nx, problem.free.len());
    let width = nx + np;
    let rows = problem.rows(point, true, None);
    let m = rows.len() * np;
    let mut stacked = vec![0.0; m * np];
    for (s, segment) in rows.iter().enumerate() {
        let mut a: Vec<f64> = segment.jx.iter().chain(&segment.jp).copied().collect();
        let r = qr::triangle(&mut a, segment.rows, width);
        for i in 0..np {
            for j in i..np {
                stacked[j * m + s * np + i] = r[(nx + i) * width + nx + j];
            }
        }
    }
    let inverse = qr::invert_triangle(&qr::triangle(&mut stacked, m, np), np);
    (0..np).map(|i| qr::dot(&inverse[i * np..(i + 1) * np], &inverse[i * np..(i + 1) * np]).sqrt()).collect()
}

/// Fits from the model's own values.
pub fn fit(setup: &Setup, level: &Segmentation, scale: &[f64]) -> greybox_calibrate::Fit {
    let parameters = setup.values();
    let starts = setup.starts(level, &parameters);
    setup.fit(level, scale, &[Point { parameters, starts }], greybox_calibrate::Limits::default())
}
