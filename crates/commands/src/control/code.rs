//! The law and its observer as code, with numbers that the code must reproduce.

use std::fmt::Write as _;

use greybox_control::{Controller, OutputFeedback, Plant, Run, observer};
use greybox_export::{
    ChainForm, Constant, Function, Group, Member, ObserverCode, ObserverForm, RestForm, StartForm,
};
use greybox_model::Model;
use greybox_recording::write_csv;

use super::answer::observer_in_words;
use super::designed::Designed;
use crate::failure::Failure;

/// Samples of the simulated loop that the observer's code must reproduce.
const OBSERVED: usize = 2000;
/// What the reference and its derivatives are called in tables.
const GIVEN: [&str; 3] = ["set_point", "set_point'", "set_point''"];
/// States at which the exported code must agree, for each set point.
const VECTORS: usize = 32;

/// A state with its unit.
fn state_member(model: &Model, name: &str, primes: u8) -> Member {
    let unit = model.state(name).map_or("", |i| model.states[i].unit.text.as_str());
    // Rates have no unit text of their own.
    let unit = match (unit, primes) {
        ("", _) => String::new(),
        (unit, 0) => format!("SI of {unit}"),
        (unit, 1) => format!("SI of {unit} per s"),
        (unit, n) => format!("SI of {unit} per s^{n}"),
    };
    Member::new(name, primes, &unit)
}

/// The parameters as constants.
fn constants(model: &Model, plant: &Plant) -> Vec<Constant> {
    let parameter = |(name, value): &(String, f64)| {
        let unit = model.parameter(name).and_then(|i| model.parameters[i].unit.as_ref());
        Constant::new(name, *value, unit.map_or("", |u| u.text.as_str()))
    };
    plant.parameters().iter().map(parameter).collect()
}

/// The observer and the equations that it predicts with.
pub(super) fn observer_code(
    designed: &Designed<'_>,
    output: &OutputFeedback,
    law: &Function,
) -> ObserverCode {
    let Designed { model, file, controller, .. } = *designed;
    let plant = controller.plant();
    let (f, g) = plant.frictionless();
    let input = greybox_model::Expr::var(plant.input_name());
    let rates = f.iter().zip(g).zip(plant.state_names());
    let state = plant.symbols().iter().map(|(name, primes)| state_member(model, name, *primes));
    let rate = Function {
        name: "plant_rate".into(),
        summary: vec![
            format!("Equations of motion of {}, friction dropped, for the observer.", model.name),
            format!("Made by greybox {} from {file}.", env!("CARGO_PKG_VERSION")),
        ],
        arguments: vec![
            Group { name: "state".into(), members: state.collect() },
            Group { name: "command".into(), members: vec![Member::new(plant.input_name(), 0, "SI")] },
        ],
        constants: constants(model, plant),
        outputs: rates
            .map(|((f, g), name)| {
                (format!("rate of {name}"), (f.clone() + g.clone() * input.clone()).simplify())
            })
            .collect(),
    };
    let form = match output.observer().form() {
        observer::Form::Kalman { gain, start } => ObserverForm::Kalman {
            gain,
            start: StartForm {
                point: start.point,
                sizes: start.sizes,
                matrix: start.matrix,
                most_steps: start.most_steps,
                last_step: start.last_step,
                close: start.close,
            },
        },
        observer::Form::Eso(chains) => ObserverForm::Chains(
            chains
                .into_iter()
                .map(|c| ChainForm {
                    first: c.first,
                    a: c.a,
                    before: c.before,
                    now: c.now,
                    input: c.input,
                    gain: c.gain,
                    weight: c.weight,
                })
                .collect(),
        ),
    };
    let delay = output.observer().input_delay();
    ObserverCode {
        summary: vec![format!(
            "{}. Call observer_step once a sample; it calls {} of the law's file.",
            observer_in_words(output),
            law.name
        )],
        rate,
        law: law.clone(),
        dt: controller.dt(),
        measured: output.observer().measured().to_vec(),
        dead_zone: plant.dead_zone(),
        substeps: output.observer().substeps(),
        input_delay: (delay.samples, delay.remainder),
        form,
        rest: output.rest().map(|rest| RestForm {
            step: rest.step,
            samples: rest.samples(),
            slow: rest.rate().map(|rate| (rate, rest.velocity())),
            tracked: controller.tracked(),
            measurement: rest.measurement(),
            integral_time: rest.integral_time,
        }),
    }
}

/// What the sensors said in the simulated loop, and the command that the observer's code must give.
pub(super) fn observed(designed: &Designed<'_>, output: &OutputFeedback) -> Result<Vec<u8>, Failure> {
    let Designed { controller, run, .. } = *designed;
    let names = controller.plant().state_names();
    let count = run.t.len().min(OBSERVED);
    let mut columns: Vec<(&str, &[f64])> = Vec::new();
    for (&i, y) in output.observer().measured().iter().zip(&run.y) {
        columns.push((names[i].as_str(), &y[..count]));
    }
    let given = GIVEN.into_iter().zip(&run.given).take(references(controller));
    columns.extend(given.map(|(name, r)| (name, &r[..count])));
    columns.push(("command", &run.u[..count]));
    let mut csv = Vec::new();
    write_csv(&mut csv, &run.t[..count], &columns)?;
    Ok(csv)
}

/// The law as a function of the state, the disturbance where an observer estimates it, and the set point.
pub(super) fn function(designed: &Designed<'_>) -> Function {
    let Designed { model, file, controller, output, .. } = *designed;
    let plant = controller.plant();
    let member = |(name, primes): &(String, u8)| state_member(model, name, *primes);
    let law = match output {
        Some(output) => output.law().clone(),
        None => controller.law().first().cloned().unwrap_or(greybox_model::Expr::Num(0.0)),
    };
    let (low, high) = controller.limits();
    let disturbance = output.map(|o| Group {
        name: "disturbance".into(),
        members: vec![Member::new(o.disturbance(), 0, "units of the command")],
    });
    let derivatives = (0..references(controller)).map(|p| (controller.reference().to_owned(), p as u8));
    let set_point = Group {
        name: "set_point".into(),
        members: derivatives.map(|symbol| reference_member(designed, &symbol)).collect(),
    };
    let state = Group { name: "state".into(), members: plant.symbols().iter().map(member).collect() };
    Function {
        name: "control_law".into(),
        summary: vec![
            format!("{} law of {} for {}", controller.method().name(), plant.input_name(), model.name),
            format!("Made by greybox {} from {file}.", env!("CARGO_PKG_VERSION")),
            format!("Call it every {} s and hold the command; range {low} to {high}.", controller.dt()),
        ],
        arguments: [Some(state), disturbance, Some(set_point)].into_iter().flatten().collect(),
        constants: constants(model, plant),
        outputs: vec![(format!("{}, SI", plant.input_name()), law)],
    }
}

/// How much of the reference the law reads: itself, or its first two derivatives too.
fn references(controller: &Controller) -> usize {
    if controller.trajectories() { 3 } else { 1 }
}

/// The reference, or a derivative of it, with the unit of the tracked state's.
fn reference_member(designed: &Designed<'_>, (name, primes): &(String, u8)) -> Member {
    let Designed { model, controller, .. } = *designed;
    let unit = controller
        .plant()
        .symbols()
        .get(controller.tracked())
        .map(|(tracked, own)| state_member(model, tracked, own + primes).unit);
    Member::new(name, *primes, &unit.unwrap_or_default())
}

/// States around the set points, with the command that the code must give.
pub(super) fn vectors(
    designed: &Designed<'_>,
    function: &Function,
) -> Result<String, greybox_export::ExportError> {
    let Designed { controller, output, run, .. } = *designed;
    let largest = |values: &[f64]| values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let (low, high) = controller.feed_forward().range;
    let plant = controller.plant();
    let mut points = Vec::new();
    for check in controller.checks() {
        for k in 0..VECTORS {
            // Evenly spread whatever the number of states: a Kronecker sequence of square roots of primes.
            let roots = [2f64, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0, 29.0, 31.0, 37.0];
            let spread = |i: usize| 2.0 * (k as f64 * roots[i % roots.len()].sqrt()).fract() - 1.0;
            let state = check.equilibrium.state.iter().zip(plant.sizes()).enumerate();
            let mut point: Vec<f64> = state.map(|(i, (x, size))| x + size * spread(i)).collect();
            if output.is_some() {
                point.push(plant.input_size() * spread(plant.order()));
            }
            point.push(if k % 2 == 0 { check.set_point } else { low + 0.75 * (high - low) });
            let derivatives = run.given.iter().enumerate().take(references(controller)).skip(1);
            point.extend(derivatives.map(|(p, r)| largest(r) * spread(plant.order() + p)));
            points.push(point);
        }
    }
    let mut names = plant.state_names();
    names.extend(output.map(|o| o.disturbance().to_owned()));
    let given = (0..references(controller))
        .map(|p| greybox_model::Expr::prime(controller.reference(), p as u8).to_string());
    names.extend(given.chain([plant.input_name().to_owned()]));
    let mut text = names.join(",") + "\n";
    for vector in function.vectors(&points)? {
        let numbers: Vec<String> =
            vector.arguments.iter().chain(&vector.outputs).map(|v| format!("{v:?}")).collect();
        let _ = writeln!(text, "{}", numbers.join(","));
    }
    Ok(text)
}

/// The closed loop as a table.
pub(super) fn series(run: &Run) -> Result<Vec<u8>, Failure> {
    let mut columns: Vec<(&str, &[f64])> = vec![("set_point", &run.r), ("command", &run.u)];
    columns.extend(run.states.iter().zip(&run.x).map(|(name, x)| (name.as_str(), x.as_slice())));
    let mut csv = Vec::new();
    write_csv(&mut csv, &run.t, &columns)?;
    Ok(csv)
}
