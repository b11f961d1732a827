//! An arm held against gravity from its encoder alone: `cargo run --release --package example-controller`. With a folder
//! as argument it writes the controller there as C.
#![allow(clippy::print_stdout)]

use std::error::Error;
use std::path::PathBuf;

use example_controller::{ARM, COUNT, SET_POINTS, code, designed};
use greybox_control::{
    ClosedLoop, Controller, Family, FamilyOptions, Feedback, LoopOptions, Margins, OutputFeedback, Reference,
    Run,
};
use greybox_export::Language;
use greybox_model::Model;

/// Time at each set point, s.
const HOLD: f64 = 2.0;

/// The closed loop with true friction, from one set point to the next, and fifty arms that differ from the model.
fn tried(
    model: &Model,
    law: &Controller,
    observer: Option<&OutputFeedback>,
) -> Result<(Run, Family), Box<dyn Error>> {
    let feedback = observer.map_or(Feedback::FullState, |o| Feedback::Output(Box::new(o.clone())));
    let looped = ClosedLoop::new(model, law, &LoopOptions { feedback, ..LoopOptions::default() })?;
    let at = SET_POINTS.iter().enumerate().map(|(k, set_point)| (HOLD * k as f64, *set_point));
    let duration = HOLD * SET_POINTS.len() as f64;
    let reference = Reference::SetPoints { set_points: at.collect(), duration };
    let deviations = [("J", 0.003), ("mgl", 0.08), ("fc", 0.01), ("kt", 0.03)];
    let deviations = deviations.map(|(name, deviation)| (name.to_string(), deviation)).to_vec();
    let family = looped.family(&reference, &FamilyOptions { deviations, members: 50, seed: 1 })?;
    Ok((looped.run(&reference)?, family))
}

fn main() -> Result<(), Box<dyn Error>> {
    let model = Model::from_toml(ARM, "arm.toml")?;
    let (law, output) = designed(&model)?;
    println!("set point     loop        gain margin  phase   delay    largest sensitivity");
    for ((check, full), set_point) in output.checks().iter().zip(law.margins()).zip(SET_POINTS) {
        for (name, margins) in [("full state", full), ("observer", Some(check.margins))] {
            let Margins { gain, phase, delay, sensitivity, .. } = margins.unwrap_or(Margins::NONE);
            let (phase, delay) = (phase.to_degrees(), 1e3 * delay);
            println!(
                "{set_point:5.2} rad     {name:10}  {gain:11.1}  {phase:4.1}°  {delay:4.1} ms  {sensitivity:.2}"
            );
        }
    }
    println!("\n              set point  settles  overshoot  error at rest, counts");
    for (name, observer) in [("full state", None), ("observer", Some(&output))] {
        let (run, family) = tried(&model, &law, observer)?;
        for m in &run.metrics {
            let settling = m.settling.map_or("never".into(), |s| format!("{s:.3} s"));
            let (overshoot, error) = (100.0 * m.overshoot, m.final_error / COUNT);
            println!("{name:10}  {:5.1} rad    {settling}  {overshoot:7.1} %  {error:7.2}", m.set_point);
        }
        let phase = family.margins.map_or(f64::NAN, |m| m.phase.worst.to_degrees());
        println!(
            "{name:10}  {} of {} other arms settle; worst error {:.2} counts, phase margin {phase:.1}°",
            family.settled,
            family.members,
            family.final_error.worst / COUNT
        );
    }
    let code = code(&law, &output)?;
    let files = [("law.c", code.law.code(Language::C99)?), ("observer.c", code.code(Language::C99)?)];
    println!();
    for (name, text) in &files {
        println!("{name}: {} lines, {} bytes", text.lines().count(), text.len());
        if let Some(folder) = std::env::args_os().nth(1) {
            std::fs::write(PathBuf::from(folder).join(name), text)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use example_controller::SIZES;

    /// Of θ″ = −a θ − b θ′ + k v with weights 1/size².
    #[test]
    fn the_gains_are_those_of_the_riccati_equation() {
        let (law, _) = designed(&Model::from_toml(ARM, "arm.toml").unwrap()).unwrap();
        let (a, b, k) = (0.8 * 0.5f64.cos() / 0.03, 0.12 / 0.03, 0.3 / 0.03);
        let ([q1, q2], r) = ([SIZES[0], SIZES[1]].map(|s| s.powi(-2)), SIZES[2].powi(-2));
        let first = ((a * a + k * k * q1 / r).sqrt() - a) / k;
        let second = ((b * b + k * k * q2 / r + 2.0 * k * first).sqrt() - b) / k;
        assert!((law.gains()[0] / first - 1.0).abs() < 1e-9, "{:?} {first}", law.gains());
        assert!((law.gains()[1] / second - 1.0).abs() < 1e-9, "{:?} {second}", law.gains());
    }

    #[test]
    fn the_observer_takes_friction_and_wrong_parameters_out_at_the_cost_of_margin() {
        let model = Model::from_toml(ARM, "arm.toml").unwrap();
        let (law, output) = designed(&model).unwrap();
        let (_, plain) = tried(&model, &law, None).unwrap();
        let (run, family) = tried(&model, &law, Some(&output)).unwrap();
        assert!(run.metrics.len() == 3 && run.metrics.iter().all(|m| m.final_error.abs() < 0.8 * COUNT));
        assert!(run.metrics.iter().all(|m| m.settling.is_some_and(|s| s < 0.5)), "{:?}", run.metrics);
        assert_eq!((family.settled, family.unstable), (50, 0));
        assert!(family.final_error.worst < COUNT, "{:?}", family.final_error);
        assert!(plain.settled < 45, "{}", plain.settled);
        assert!((16.0..63.0).contains(&(plain.final_error.worst / COUNT)), "{:?}", plain.final_error);
        for (check, full) in output.checks().iter().zip(law.margins()) {
            let (full, observer) = (full.unwrap().phase.to_degrees(), check.margins.phase.to_degrees());
            assert!((70.0..85.0).contains(&full), "{full}");
            assert!((36.0..50.0).contains(&observer), "{observer}");
        }
    }

    #[test]
    fn the_code_is_the_law() {
        let model = Model::from_toml(ARM, "arm.toml").unwrap();
        let (law, output) = designed(&model).unwrap();
        let code = code(&law, &output).unwrap();
        // Within the limits, where the disturbance is taken off.
        let point = |k: f64| vec![0.45 * k - 0.6, 0.5 - 0.3 * k, 0.2 * k, 0.4 * k - 0.5];
        let points: Vec<Vec<f64>> = (0..6).map(|k| point(f64::from(k))).collect();
        for vector in code.law.vectors(&points).unwrap() {
            let [theta, rate, disturbance, r] = vector.arguments[..] else { panic!("{vector:?}") };
            let wanted = law.command(&[theta, rate], r) - disturbance;
            assert!(wanted.abs() < 11.0 && (vector.outputs[0] - wanted).abs() < 1e-12, "{vector:?}");
        }
        let text = code.code(Language::C99).unwrap();
        assert!(text.contains("double observer_step(observer_memory *memory, const double measured[1]"));
    }
}
