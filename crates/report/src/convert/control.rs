//! From a controller and its simulated loops to the page.

use greybox_control::{
    Controller, Family, Integral, Margins, Method, Metrics, ObserverMethod, OutputFeedback, Run, Spread,
    Tracking, TrackingSpread,
};
use greybox_model::{Expr, Model};

use super::coherent;
use crate::contract::{ModelId, Producer};
use crate::control::{
    ControlPage, Figure, IntegralAction, LawKind, LawState, LoopRun, ObserverPage, Perturbed,
    PerturbedMargins, Quantity, SensorPage, SetPoint,
};
use crate::format;

/// What a page is made from.
#[derive(Debug, Clone, Copy)]
pub struct ControlSources<'a> {
    /// File name of the model, without its directory.
    pub model_file: &'a str,
    /// The model, as simulated.
    pub model: &'a Model,
    /// The law.
    pub controller: &'a Controller,
    /// The observer between the sensors and the law.
    pub output: Option<&'a OutputFeedback>,
    /// How old what the law is given is in the simulated loop, s.
    pub delay: f64,
    /// Its loop on the model.
    pub run: &'a Run,
    /// Whether that followed a trajectory instead of set points.
    pub is_trajectory: bool,
    /// The perturbed plants, with the standard deviations (SI) of their parameters.
    pub family: Option<(&'a Family, &'a [(String, f64)])>,
    /// Version and seed.
    pub producer: &'a Producer,
    /// The files beside the page and what they hold.
    pub files: &'a [(&'static str, &'static str)],
}

/// The page of a controller.
pub fn page(sources: &ControlSources<'_>) -> ControlPage {
    let ControlSources { model, controller, run, .. } = *sources;
    let plant = controller.plant();
    let names = plant.state_names();
    let quantity = |name: &str, primes: u8, shown: &str| Quantity {
        name: shown.to_owned(),
        unit: model
            .state(name)
            .map_or_else(String::new, |i| per_second(&coherent(&model.states[i].unit), primes)),
    };
    let states: Vec<LawState> = plant
        .symbols()
        .iter()
        .zip(&names)
        .zip(plant.sizes().iter().zip(controller.gains()))
        .map(|(((name, primes), shown), (size, gain))| LawState {
            quantity: quantity(name, *primes, shown),
            size: *size,
            gain: *gain,
        })
        .collect();
    let input = Quantity {
        name: plant.input_name().to_owned(),
        unit: model.input(plant.input_name()).map_or_else(String::new, |i| coherent(&model.inputs[i].unit)),
    };
    let pole = |p: &greybox_control::Pole| [p.re, p.im];
    let margins: Vec<Option<Margins>> = match sources.output {
        Some(output) => output.margins_late(controller, plant, sources.delay),
        None => controller.margins_late(plant, sources.delay),
    };
    let set_points = controller.checks().iter().zip(margins).map(|(c, margins)| SetPoint {
        margins,
        value: c.set_point,
        // What is rounding is not shown.
        state: c.equilibrium.state.iter().zip(plant.sizes()).map(|(x, size)| rounded(*x, *size)).collect(),
        command: rounded(c.equilibrium.input, plant.input_size()),
        poles: c.poles.iter().map(pole).collect(),
        held_poles: c.held_poles.iter().map(pole).collect(),
        stuck_poles: c.stuck_poles.iter().map(pole).collect(),
    });
    let set_points: Vec<SetPoint> = set_points.collect();
    let symbols = model
        .states
        .iter()
        .flat_map(|s| (0..s.order).map(|p| (s.name.as_str(), u8::try_from(p).unwrap_or(u8::MAX))));
    let series = symbols
        .zip(&run.x)
        .map(|((name, primes), x)| {
            (quantity(name, primes, &Expr::prime(name, primes).to_string()), x.clone())
        })
        .collect();
    let (low, high) = controller.limits();
    ControlPage {
        title: format!(
            "Controller of {}",
            if model.name.is_empty() { sources.model_file } else { &model.name }
        ),
        producer: sources.producer.clone(),
        model: ModelId { name: model.name.clone(), file: sources.model_file.to_owned() },
        verdict: run.verdict(sources.family.map(|(f, _)| f)),
        method: match controller.method() {
            Method::Lqr => LawKind::Lqr,
            Method::Hjb { .. } => LawKind::Hjb,
            Method::Smc { .. } => LawKind::Smc,
        },
        settings: settings(controller, sources.output, &input),
        limits: [low, high],
        dt: controller.dt(),
        tracked: controller.tracked(),
        reference: controller.reference().to_owned(),
        law: match sources.output {
            Some(output) => output.law().to_string(),
            None => controller.law().first().map(ToString::to_string).unwrap_or_default(),
        },
        observer: sources.output.map(|output| ObserverPage {
            disturbance: output.disturbance().to_owned(),
            integral: match (output.integral(), output.rest()) {
                (_, Some(rest)) => IntegralAction::AtRest {
                    time: rest.time,
                    step: rest.step,
                    integral_time: rest.integral_time,
                },
                (Integral::Off, None) => IntegralAction::Off,
                _ => IntegralAction::Disturbance,
            },
            kind: match output.method() {
                ObserverMethod::Kalman { .. } => "steady-state Kalman filter",
                ObserverMethod::Eso { .. } => "extended-state observer",
            },
            sensors: output
                .observer()
                .measured()
                .iter()
                .zip(output.sensors())
                .filter_map(|(&i, s)| {
                    let quantity = states.get(i)?.quantity.clone();
                    Some(SensorPage { quantity, noise: s.noise, resolution: s.resolution })
                })
                .collect(),
        }),
        delay: sources.delay,
        left_out: plant.dropped().iter().map(|d| (d.equation.clone(), d.term.to_string())).collect(),
        steps: run.metrics.clone(),
        is_trajectory: sources.is_trajectory,
        reads_derivatives: controller.trajectories(),
        tracking: run.tracking,
        family: sources.family.map(|(family, deviations)| {
            let unit = states.get(controller.tracked()).map_or("", |s| s.quantity.unit.as_str());
            let margins = set_points.iter().filter_map(|s| s.margins).reduce(Margins::worse);
            perturbed(family, deviations, model, (run, margins), [unit, &input.unit])
        }),
        run: LoopRun {
            t: run.t.clone(),
            reference: run.r.clone(),
            command: run.u.clone(),
            states: series,
            tracked: run.tracked,
            diverged: run.diverged.and_then(|k| run.t.get(k).copied()),
        },
        files: sources.files.to_vec(),
        set_points,
        states,
        input,
    }
}

/// Zero where a value is nothing against its size.
fn rounded(value: f64, size: f64) -> f64 {
    if value.abs() < 1e-12 * size { 0.0 } else { value }
}

/// `V` → `(V)^2 s`
pub(crate) fn squared(unit: &str) -> String {
    if unit.is_empty() { String::new() } else { format!("({unit})^2 s") }
}

/// `rad` → `rad/s^2`
pub(super) fn per_second(unit: &str, primes: u8) -> String {
    match (unit, primes) {
        ("", _) | (_, 0) => unit.to_owned(),
        (unit, 1) => format!("{unit}/s"),
        (unit, n) => format!("{unit}/s^{n}"),
    }
}

fn settings(
    controller: &Controller,
    output: Option<&OutputFeedback>,
    input: &Quantity,
) -> Vec<(&'static str, String)> {
    let plant = controller.plant();
    let of_input = |value: f64| format::with_unit(&format::plain(value), &input.unit);
    let mut out = Vec::new();
    match controller.method() {
        Method::Lqr => {}
        Method::Hjb { degree, bounded, .. } => {
            out.push(("Degree of the value function", degree.to_string()));
            if *bounded {
                out.push(("Limits of the command", "in the cost: the law stays within them".to_owned()));
            }
        }
        Method::Smc { lambda, eta, phi } => {
            out.push(("Poles on the surface", format!("{} 1/s", format::plain(-lambda))));
            out.push(("Pole towards the surface", format!("{} 1/s", format::plain(-eta / phi))));
            out.push(("Reaching rate η", of_input(*eta)));
        }
    }
    out.push(("Typical size of the command", of_input(plant.input_size())));
    match output.map(OutputFeedback::method) {
        Some(ObserverMethod::Kalman { disturbance }) => {
            out.push(("Disturbance, change in one second", of_input(*disturbance)));
        }
        Some(ObserverMethod::Eso { bandwidth }) => {
            out.push(("Bandwidth of the observer", format!("{} 1/s", format::number(*bandwidth))));
        }
        None => {}
    }
    if plant.input_delay() > 0.0 {
        out.push((
            "Delay of the command predicted over",
            format!("{} s", format::number(plant.input_delay())),
        ));
    }
    if plant.dead_zone() > 0.0 {
        out.push(("Dead zone made up for", of_input(plant.dead_zone())));
    }
    out
}

fn perturbed(
    family: &Family,
    deviations: &[(String, f64)],
    model: &Model,
    (own, own_margins): (&Run, Option<Margins>),
    units: [&str; 2],
) -> Perturbed {
    let parameters = deviations.iter().filter_map(|(name, deviation)| {
        let parameter = &model.parameters[model.parameter(name)?];
        let unit = parameter.unit.as_ref().map(coherent).unwrap_or_default();
        Some((Quantity { name: name.clone(), unit }, parameter.value, *deviation))
    });
    Perturbed {
        members: family.members,
        diverged: family.diverged,
        settled: family.settled,
        deviations: parameters.collect(),
        figures: match &family.tracking {
            Some(tracking) => followed(family, tracking, own, units),
            None => reached(family, &own.metrics, units),
        },
        margins: family.margins.zip(own_margins).map(|(margins, own)| PerturbedMargins {
            own,
            median: margins.median(),
            worst: margins.worst(),
            unstable: family.unstable,
        }),
        tracked: [family.tracked.lowest.clone(), family.tracked.highest.clone()],
        command: [family.command.lowest.clone(), family.command.highest.clone()],
    }
}

fn figure(name: &'static str, unit: &str, own: f64, spread: Spread) -> Figure {
    Figure { name, unit: unit.to_owned(), own, median: spread.median, worst: spread.worst }
}

/// What the plants reached at set points.
fn reached(family: &Family, own: &[Metrics], [tracked, input]: [&str; 2]) -> Vec<Figure> {
    let most = |of: fn(&Metrics) -> f64| own.iter().map(of).fold(0.0, f64::max);
    vec![
        figure("Settling", "s", most(|m| m.settling.unwrap_or(f64::INFINITY)), family.settling),
        figure("Overshoot", "%", most(|m| m.overshoot), family.overshoot),
        figure("Final error", tracked, most(|m| m.final_error.abs()), family.final_error),
        figure("Peak to peak at rest", tracked, most(|m| m.peak_to_peak), family.peak_to_peak),
        figure("Largest command", input, most(|m| m.largest_command), family.largest_command),
        figure("∫ u² dt", &squared(input), own.iter().map(|m| m.effort).sum(), family.effort),
    ]
}

/// How the plants followed a trajectory.
fn followed(family: &Family, of: &TrackingSpread, own: &Run, [tracked, input]: [&str; 2]) -> Vec<Figure> {
    let own = |value: fn(&Tracking) -> f64| own.tracking.as_ref().map_or(f64::INFINITY, value);
    vec![
        figure("RMS error", tracked, own(|t| t.later_error.rms), of.rms_error),
        figure("Largest error", tracked, own(|t| t.later_error.largest), of.largest_error),
        figure("Largest command", input, own(|t| t.largest_command), family.largest_command),
        figure("∫ u² dt", &squared(input), own(|t| t.effort), family.effort),
    ]
}
