//! Which physics does the model of this motor axis lack? `cargo run --release --package example-diagnosis`.
#![allow(clippy::print_stdout)]

use std::error::Error;

use greybox_diagnose::diagnosis::Role;
use greybox_diagnose::{Diagnosis, Options, Quiet, diagnose};
use greybox_model::{Hold, Model, Parameter, System, WriteOptions, parse};
use greybox_recording::{Channel, Recording};
use greybox_simulate::{Environment, Method, Seeds, Signal, Simulation};

/// What is believed of the axis: inertia and damping from data sheets, motor constants that were measured.
const MODEL: &str = r#"name = "Motor axis"

[inputs]
v = { unit = "V", hold = "zero" }

[states]
theta = { unit = "rad" }

[parameters]
J = { value = 4.0e-4, unit = "kg m^2" } # motor and coupling
b = { value = 2.0e-4, unit = "N m s/rad" }
R = { value = 2.6, unit = "Ohm", fixed = true }
kt = { value = 0.05, unit = "N m/A", fixed = true }

[equations]
shaft = "J*theta'' + b*theta' = kt/R*(v - kt*theta')"
"#;
/// The axis itself: J, b, R and kt, and the Coulomb friction fc (N m).
const TRUTH: [f64; 5] = [5.2e-4, 1.2e-4, 2.6, 0.05, 0.003];
/// Sample time, s.
const STEP: f64 = 0.005;
/// Noise of the encoder, rad.
const NOISE: f64 = 2e-3;

/// What a logger would have recorded of the axis with friction `fc` under a voltage of three sines (V, Hz).
fn record(name: &str, fc: f64, tones: [(f64, f64); 3], seed: u32) -> Result<Recording, Box<dyn Error>> {
    let mut axis = Model::from_toml(MODEL, "axis.toml")?;
    axis.parameters.push(Parameter { name: "fc".into(), unit: None, ..axis.parameters[0].clone() });
    axis.add_term(0, parse("fc*sign(theta')")?.expr);
    let time: Vec<f64> = (0..4000).map(|k| STEP * f64::from(k)).collect();
    let sine = |t: f64, (volts, hertz): (f64, f64)| volts * (std::f64::consts::TAU * hertz * t + hertz).sin();
    let v: Vec<f64> = time.iter().map(|t| tones.iter().map(|tone| sine(*t, *tone)).sum()).collect();
    let inputs = vec![Signal::new(Hold::Zero, STEP, &v, <[f64]>::to_vec)];
    let run = Simulation {
        system: &System::compile(&axis)?,
        environment: &Environment { start: 0.0, dt: STEP, len: v.len(), inputs, forces: vec![] },
        parameters: &[TRUTH[0], TRUTH[1], TRUTH[2], TRUTH[3], fc],
        method: Method::Rk4 { substeps: 4 },
        seeds: &Seeds::default(),
    }
    .run(&[0.0, 0.0], 0..v.len());
    // Normal noise, nearly: the sum of twelve uniform numbers (Numerical Recipes' generator).
    let mut state = seed;
    let mut uniform = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state) / f64::from(u32::MAX) - 0.5
    };
    let mut noise = || NOISE * (0..12).map(|_| uniform()).sum::<f64>();
    let theta = run.y.iter().map(|angle| angle + noise()).collect();
    let channel = |name: &str, values| Channel { name: name.into(), unit: None, values };
    Ok(Recording::from_columns(name, time, vec![channel("v", v), channel("theta", theta)])?)
}

/// A recording to learn from and one of another motion that is held out.
fn diagnosed(model: &Model, fc: f64) -> Result<Diagnosis, Box<dyn Error>> {
    let train = record("run1.csv", fc, [(0.8, 0.23), (0.45, 0.7), (0.4, 1.9)], 1)?;
    let test = record("run2.csv", fc, [(0.7, 0.3), (0.4, 1.1), (0.4, 2.7)], 2)?;
    Ok(diagnose(model, &[train], &[test], &Options::default(), &Quiet)?)
}

/// Errors of the free run over the spread of the angle: nominal, calibrated, improved.
fn errors(role: &Role) -> [f64; 3] {
    [&role.nominal, &role.calibrated, &role.improved]
        .map(|run| run.scores.first().map_or(f64::NAN, |s| s.nrmse))
}

fn main() -> Result<(), Box<dyn Error>> {
    let model = Model::from_toml(MODEL, "axis.toml")?;
    let found = diagnosed(&model, TRUTH[4])?;
    println!("{:?}", found.verdict);
    for mechanism in &found.mechanisms {
        let (place, law) = (mechanism.equations.join(", "), &mechanism.expression);
        println!("{} in {place}: {law}, confidence {:.2}", mechanism.kind, mechanism.confidence);
        for (name, _, estimate) in &mechanism.parameters {
            let half = estimate.ci95.map_or(f64::NAN, |(low, high)| 0.5 * (high - low));
            println!("{name} = {:.7} ± {half:.7} N m (truth {})", estimate.value, TRUTH[4]);
        }
    }
    println!("\nerror of the free run  nominal  calibrated  improved");
    for (name, role) in [("training", &found.train), ("held out", &found.holdout)] {
        let [nominal, calibrated, improved] = errors(role).map(|e| 100.0 * e);
        println!("{name:21}  {nominal:5.1} %  {calibrated:8.2} %  {improved:6.3} %");
    }
    println!(
        "\n{}",
        found.improved.to_toml(&WriteOptions { original: Some(MODEL), ..WriteOptions::default() })
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_diagnose::Verdict;

    #[test]
    fn the_friction_is_named_and_what_was_held_out_is_simulated() {
        let model = Model::from_toml(MODEL, "axis.toml").unwrap();
        let found = diagnosed(&model, TRUTH[4]).unwrap();
        assert_eq!(found.verdict, Verdict::MissingPhysics);
        let [mechanism] = &found.mechanisms[..] else { panic!("{:?}", found.mechanisms) };
        assert_eq!(
            (mechanism.kind.as_str(), mechanism.equations.join(" ")),
            ("coulomb_friction", "shaft".into())
        );
        let estimate = mechanism.parameters[0].2;
        let (low, high) = estimate.ci95.unwrap();
        assert!(low < TRUTH[4] && TRUTH[4] < high && (5e-7..2e-6).contains(&(high - low)), "{estimate:?}");
        let [nominal, calibrated, improved] = errors(&found.holdout);
        assert!(nominal > 0.2 && (0.09..0.36).contains(&calibrated), "{nominal} {calibrated}");
        // The noise alone is 4.5e-4.
        assert!((3.7e-4..1.5e-3).contains(&improved), "{improved}");
    }

    #[test]
    fn nothing_is_missing_where_there_is_no_friction() {
        let model = Model::from_toml(MODEL, "axis.toml").unwrap();
        let found = diagnosed(&model, 0.0).unwrap();
        assert_eq!(found.verdict, Verdict::Consistent);
        assert!(found.mechanisms.is_empty());
    }
}
