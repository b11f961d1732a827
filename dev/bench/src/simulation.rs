//! Rows of simulation and calibration.

use std::sync::Arc;

use anyhow::{Context, Result};
use greybox_calibrate::{Data, FreeParameter, Limits, Point, Prior, Setup};
use greybox_model::{Hold, Model, System};
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::{Duffing, Sampling};
use greybox_simulate::{Environment, Method, Seeds, Signal, Simulation, integrate};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use serde_json::json;

use super::case::{Against, Answer, Case, Peer, Row, array, close, difference};

/// Thesis equations 2.18 and 2.19.
const FORCED: &str = r#"
name = "Duffing oscillator under its own force"

[states]
x = { unit = "m", initial = [1.0, 0.0] }

[parameters]
m  = { value = 2.0, unit = "kg", fixed = true }
k1 = { value = 6.0, unit = "N/m", fixed = true }
k3 = { value = 0.1, unit = "N/m^3", fixed = true }
c1 = { value = 1.0, unit = "N s/m", fixed = true }
c2 = { value = 0.2, unit = "N s/m^3", fixed = true }
c3 = { value = 1.0, unit = "N s^3/m^3", fixed = true }
f1 = { value = 10.0, unit = "N", fixed = true }
f4 = { value = 40.0, unit = "N", fixed = true }
w1 = { value = 1.0, unit = "rad/s", fixed = true }
w4 = { value = 4.0, unit = "rad/s", fixed = true }

[equations]
motion = "m*x'' + k1*x + k3*x^3 + c1*x' + c2*x^2*x' + c3*x'^3 = f1*sin(w1*t) + f4*sin(w4*t)"
"#;

/// The same with a recorded force, divided by the mass.
const DRIVEN: &str = r#"
name = "Duffing oscillator"

[inputs]
f = { unit = "N" }

[states]
x = { unit = "m" }

[parameters]
k1 = { value = 3.0, unit = "1/s^2" }
k3 = { value = 0.05, unit = "1/(m^2 s^2)" }
c1 = { value = 0.5, unit = "1/s" }
c2 = { value = 0.1, unit = "1/(m^2 s)" }
c3 = { value = 0.5, unit = "s/m^2" }
b  = { value = 0.5, unit = "1/kg" }

[equations]
motion = "x'' + k1*x + k3*x^3 + c1*x' + c2*x^2*x' + c3*x'^3 = b*f"
"#;

/// Parameters of [`DRIVEN`] that made the recording.
const TRUTH: [f64; 6] = [3.0, 0.05, 0.5, 0.1, 0.5, 0.5];
/// Where a fit starts, relative to them.
const GUESS: [f64; 6] = [1.2, 0.7, 1.3, 0.8, 0.9, 1.1];

/// The rows.
pub(crate) fn rows() -> Vec<Row> {
    vec![
        Row::new(
            "tape",
            "right-hand side of the oscillator, compiled from the model",
            "evaluation",
            Against::NOTHING,
            tape,
        ),
        Row::new(
            "simulation",
            "the oscillator for 1 000 s to 1e-8, from the model's equations",
            "run",
            Against::Peers(&[
                Peer { function: "duffing_lsoda", name: "SciPy LSODA, Python right-hand side", goal: 100.0 },
                Peer { function: "duffing_numba", name: "Numba RK4, hand-written", goal: 1.2 },
            ]),
            simulation,
        ),
        Row::new(
            "sensitivities",
            "4 000 samples with 8 sensitivities, one RK4 step each",
            "sample",
            Against::NOTHING,
            || sensitivities(false),
        ),
        Row::new(
            "sensitivities_interpreted",
            "4 000 samples with 8 sensitivities, one RK4 step each, interpreted",
            "sample",
            Against::NOTHING,
            || sensitivities(true),
        ),
        Row::new(
            "calibration",
            "output-error fit of six parameters and the start, 4 000 samples",
            "fit",
            Against::Peers(&[
                Peer {
                    function: "calibration_numba",
                    name: "SciPy least_squares, Numba simulator",
                    goal: 3.0,
                },
                Peer { function: "calibration_scipy", name: "SciPy least_squares on solve_ivp", goal: 300.0 },
            ]),
            calibration,
        ),
    ]
}

fn compiled(text: &str) -> Result<(Model, System)> {
    let model = Model::from_toml(text, "bench.toml")?;
    let system = System::compile(&model)?;
    Ok((model, system))
}

fn values(model: &Model) -> Vec<f64> {
    model.parameters.iter().map(|p| p.value).collect()
}

fn tape() -> Result<Case> {
    const CALLS: usize = 10_000;
    let (model, system) = compiled(FORCED)?;
    let tape = system.rhs.clone();
    let (mut registers, mut modes) = (vec![0.0; tape.registers()], Vec::new());
    registers[system.parameters()..][..system.np].copy_from_slice(&values(&model));
    tape.prepare(&mut registers, &mut modes);
    Ok(Case::alone(CALLS as f64, move || {
        for k in 0..CALLS {
            registers[System::TIME] = 1e-3 * k as f64;
            registers[System::STATES] = 1.0 + 1e-4 * k as f64;
            tape.eval(&mut registers, &mut modes, &[]);
        }
        Ok(Answer::from([("last".to_owned(), vec![registers[registers.len() - 1]])]))
    }))
}

fn simulation() -> Result<Case> {
    const STEP: f64 = 0.05;
    const SAMPLES: usize = 20_001;
    /// Largest error of x, m, of either side.
    const ACCURACY: f64 = 1e-8;
    let (model, system) = compiled(FORCED)?;
    let parameters = values(&model);
    // Steps twenty times shorter than those that give the accuracy: all but exact.
    let sampling = Sampling { dt: STEP, substeps: 200 };
    let reference = Duffing::THESIS.run(sampling, [1.0, 0.0], SAMPLES, Duffing::thesis_force)?;
    let reference: Vec<f64> = reference.iter().map(|s| s[0]).collect();
    let settings = json!({
        "dt": STEP, "samples": SAMPLES, "start": [1.0, 0.0], "substeps": 10, "rtol": 1e-9, "atol": 1e-9,
    });
    let environment = Environment { start: 0.0, dt: STEP, len: SAMPLES, inputs: vec![], forces: vec![] };
    let work = move || {
        let run = Simulation {
            system: &system,
            environment: &environment,
            parameters: &parameters,
            method: Method::Dop853 { substeps: 1 },
            seeds: &Seeds::default(),
        };
        Ok(Answer::from([("x".to_owned(), run.run(&[1.0, 0.0], 0..SAMPLES).y)]))
    };
    let agree = move |peer: &str, ours: &Answer, theirs: &Answer| {
        let error = |a: &Answer| difference(array(a, "x")?, &reference);
        let (ours, theirs) = (error(ours)?, error(theirs)?);
        let size = reference.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
        // The peer may be as accurate as its coarsest setting makes it, never less than a third of what is asked.
        if ours * size <= ACCURACY && theirs * size <= 3.0 * ACCURACY {
            Ok(format!("largest error {:.1e} m, of {peer} {:.1e} m", ours * size, theirs * size))
        } else {
            anyhow::bail!("largest error {:.1e} m, of {peer} {:.1e} m", ours * size, theirs * size)
        }
    };
    Ok(Case { data: vec![], settings, work: Box::new(work), units: 1.0, agree: Box::new(agree) })
}

/// A recorded force and its oscillator: 4 000 samples, 40 s, noise of 0.01 m.
fn record() -> Result<(Vec<f64>, Vec<f64>)> {
    const SAMPLES: usize = 4000;
    let (_, system) = compiled(DRIVEN)?;
    let mut random = Pcg64Mcg::seed_from_u64(3);
    let noise = Normal::new(0.0, 0.01)?;
    let force: Vec<f64> =
        (0..SAMPLES).map(|k| Duffing::thesis_force(0.01 * k as f64) + noise.sample(&mut random)).collect();
    let x = integrate(
        &system,
        &environment(&force),
        &TRUTH,
        &[1.0, 0.0],
        0..SAMPLES,
        Method::Dp5 { substeps: 4 },
        &Seeds::default(),
    );
    Ok((force, x.y.iter().map(|x| x + noise.sample(&mut random)).collect()))
}

fn environment(force: &[f64]) -> Environment {
    let input = Signal::new(Hold::Linear, 0.01, force, |_| Vec::new());
    Environment { start: 0.0, dt: 0.01, len: force.len(), inputs: vec![input], forces: vec![] }
}

/// By machine code where there is a compiler, or by the interpreter.
fn sensitivities(is_interpreted: bool) -> Result<Case> {
    let (_, system) = compiled(DRIVEN)?;
    let system = if is_interpreted { system.interpreted() } else { system };
    let (force, _) = record()?;
    let environment = environment(&force);
    let seeds = Seeds { parameters: (0..6).collect(), initial: vec![0, 1], ..Seeds::default() };
    Ok(Case::alone(force.len() as f64, move || {
        let run = Simulation {
            system: &system,
            environment: &environment,
            parameters: &TRUTH,
            method: Method::Rk4 { substeps: 1 },
            seeds: &seeds,
        };
        Ok(Answer::from([("dy".to_owned(), run.run(&[1.0, 0.0], 0..force.len()).dy)]))
    }))
}

fn calibration() -> Result<Case> {
    let (force, x) = record()?;
    let guess: Vec<f64> = TRUTH.iter().zip(GUESS).map(|(t, g)| t * g).collect();
    let settings = json!({"dt": 0.01, "guess": guess, "start": [x[0], 0.0]});
    let data = vec![("force", force.clone()), ("x", x.clone())];
    let mut model = Model::from_toml(DRIVEN, "bench.toml")?;
    for (parameter, value) in model.parameters.iter_mut().zip(&guess) {
        parameter.value = *value;
    }
    let channel = |name: &str, values: Vec<f64>| Channel { name: name.into(), unit: None, values };
    let time = (0..x.len()).map(|k| 0.01 * k as f64).collect();
    let first = x[0];
    let recording = Recording::from_columns("bench.csv", time, vec![channel("f", force), channel("x", x)])
        .context("the recording of the bench")?;
    let free: Vec<FreeParameter> = (0..6)
        .map(|index| FreeParameter {
            index,
            prior: Prior::Flat,
            lower: f64::NEG_INFINITY,
            upper: f64::INFINITY,
        })
        .collect();
    let setup = Setup::new(&model, Arc::new(Data::new(&model, &[recording])?), free)?;
    let mut level = setup.level(1);
    for prior in level.priors.iter_mut().flatten() {
        // The peer knows nothing of the start but a first guess.
        *prior = (0.0, f64::INFINITY);
    }
    let work = move || {
        let point = Point { parameters: guess.clone(), starts: vec![vec![first, 0.0]] };
        let fit = setup.fit(&level, &[0.01], &[point], Limits::default());
        Ok(Answer::from([("parameters".to_owned(), fit.point.parameters)]))
    };
    // Differences of an adaptive integrator's results are no better than this, and so is where their fit ends.
    let agree = |peer: &str, ours: &Answer, theirs: &Answer| {
        close(ours, theirs, "parameters", if peer.contains("solve_ivp") { 2e-2 } else { 1e-3 })
    };
    Ok(Case { data, settings, work: Box::new(work), units: 1.0, agree: Box::new(agree) })
}
