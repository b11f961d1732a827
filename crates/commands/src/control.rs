//! From a model to a controller, its closed loop, and its law as code.

use std::fmt::Write as _;
use std::path::Path;

use greybox_control::{
    ClosedLoop, Controller, DesignOptions, Family, FamilyOptions, Feedback, LoopOptions, Margins, Method,
    Metrics, ObserverMethod, OutputFeedback, OutputOptions, Plant, PlantOptions, Pole, Reference, Run,
    Sensor, UNSTATED_NOISE, design, observer,
};
use greybox_export::{ChainForm, Constant, Function, Group, Language, Member, ObserverCode, ObserverForm};
use greybox_model::Model;
use greybox_recording::write_csv;
use greybox_report::contract::Producer;
use greybox_report::convert::control::{self as convert, ControlSources};
use greybox_report::{ControlPage, format, sentence};
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::loading::LoadedModel;

/// Files of a result and what they hold; the page names those beside it.
pub const FILES: [(&str, &str); 6] = [
    ("report.html", "this page"),
    ("report.json", "its numbers"),
    ("closed_loop.csv", "the simulated loop"),
    ("law.c", "the law as C99"),
    ("law.rs", "the law as Rust without the standard library"),
    ("vectors.csv", "states and set points with the command that the code must give"),
];
/// Further files with an observer.
pub const OBSERVER_FILES: [(&str, &str); 3] = [
    ("observer.c", "the observer as C99: its step calls the law"),
    ("observer.rs", "the observer as Rust without the standard library"),
    (
        "observer_vectors.csv",
        "measurements and set points of the simulated loop with the command that the step must give",
    ),
];
/// Samples of the simulated loop that the observer's code must reproduce.
const OBSERVED: usize = 2000;
/// Change of the disturbance in one second that an observer expects where nothing is stated, over the command's size.
const DISTURBANCE: f64 = 0.2;
/// Bandwidth of an extended-state observer where none is stated, over the fastest pole of the loop.
const FASTER: f64 = 4.0;
/// States at which the exported code must agree, for each set point.
const VECTORS: usize = 32;

/// What is asked for; all numbers in SI.
#[derive(Debug, Clone)]
pub struct Request {
    /// How the law is found.
    pub method: Way,
    /// Input that commands; the model's only one where it has one.
    pub input: Option<String>,
    /// State to bring to the set points, with its primes; the model's first where none is named.
    pub track: Option<String>,
    /// Set point; the closed loop steps between it and its negative.
    pub to: f64,
    /// Typical sizes of states; 1 where none is stated.
    pub sizes: Vec<(String, f64)>,
    /// Typical size of the command.
    pub input_size: f64,
    /// The actuator gives ± this at most.
    pub limit: Option<f64>,
    /// Sample time of the law, s.
    pub dt: f64,
    /// Time for each set point of the simulated square wave, s.
    pub hold: f64,
    /// Degree of the value function (hjb).
    pub degree: u8,
    /// Poles on the sliding surface are at −λ, 1/s (smc).
    pub lambda: f64,
    /// Pole towards the sliding surface, 1/s (smc).
    pub rate: f64,
    /// Reaching rate η in units of the command; ten input sizes where none is given (smc).
    pub eta: Option<f64>,
    /// Drop disturbances that depend on the time from the design.
    pub ignore_time_terms: bool,
    /// Take friction, smoothed, out of the motion (smc).
    pub compensate_friction: bool,
    /// What the law is given: the full state, or what an observer makes of the measured ones.
    pub observer: Option<ObserverRequest>,
    /// The law is given what was measured so long ago, s, in the simulated loop.
    pub delay: f64,
    /// Perturbed plants on which the law is tried.
    pub members: usize,
    /// Seed of the perturbed plants.
    pub seed: u64,
}

/// An observer, and the sensors that it has; all numbers in SI.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ObserverRequest {
    /// Which one.
    pub kind: ObserverKind,
    /// Standard deviations of the sensors' noise, by measured state.
    pub noise: Vec<(String, f64)>,
    /// Steps of the sensors' values, by measured state.
    pub resolution: Vec<(String, f64)>,
    /// Change of the disturbance in one second, in units of the command; a fifth of its size where none is given
    /// (Kalman).
    pub disturbance: Option<f64>,
    /// Bandwidth, 1/s; four times the fastest pole of the loop where none is given (ESO).
    pub bandwidth: Option<f64>,
    /// The law does not take the estimated disturbance off the command: no integral action.
    pub no_integral: bool,
}

/// The observers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ObserverKind {
    /// Steady-state Kalman filter with the disturbance of the command as a state.
    #[default]
    Kalman,
    /// Extended-state observer.
    Eso,
}

/// The methods.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// Linear-quadratic regulator.
    Lqr,
    /// Value function of a higher degree by the Hamilton–Jacobi–Bellman equation.
    Hjb,
    /// Flat-output sliding mode.
    Smc,
}

impl Default for Request {
    fn default() -> Request {
        Request {
            method: Way::Lqr,
            input: None,
            track: None,
            to: 1.0,
            sizes: Vec::new(),
            input_size: 1.0,
            limit: None,
            dt: 1e-3,
            hold: 2.0,
            degree: 4,
            lambda: 10.0,
            rate: 50.0,
            eta: None,
            ignore_time_terms: false,
            compensate_friction: false,
            observer: None,
            delay: 0.0,
            members: 50,
            seed: 0,
        }
    }
}

/// A controller as the files and words that users see.
#[derive(Debug)]
pub struct Results {
    /// Names and contents of [`FILES`], and of [`OBSERVER_FILES`] where there is an observer.
    contents: Vec<(&'static str, Vec<u8>)>,
    /// The controller in plain language.
    pub story: String,
    /// The content of `report.json`.
    pub json: Value,
    /// The simulated loop.
    pub run: Run,
}

impl Results {
    /// The files, by name.
    pub fn files(&self) -> Vec<(&'static str, &[u8])> {
        self.contents.iter().map(|(name, content)| (*name, content.as_slice())).collect()
    }
}

/// Designs a controller, simulates its loop, and writes its law as code; `report` is the text of the report that the
/// model is from and where it stands, `stage` hears what is being done.
///
/// # Errors
/// Bad input: a request that the model does not allow, or a report that is none.
pub fn control(
    loaded: &LoadedModel,
    request: &Request,
    report_of: Option<(&Path, &str)>,
    stage: &dyn Fn(&str),
) -> Result<Results, Failure> {
    let model = &loaded.model;
    let refused = |e: greybox_control::ControlError| Failure::file(&loaded.path, e);

    let plant = Plant::of(model, &input(request, loaded)?, &options(request)).map_err(refused)?;
    let tracked = match &request.track {
        Some(name) => name.clone(),
        None => plant.state_names().first().cloned().unwrap_or_default(),
    };
    stage("designing");
    let wanted = DesignOptions {
        limit: request.limit,
        compensate_friction: request.compensate_friction,
        ..DesignOptions::new(&tracked, &[-request.to, request.to], request.dt)
    };
    let controller = design(&plant, &method(request), &wanted).map_err(refused)?;
    stage("simulating");
    let output = request.observer.as_ref().map(|o| output_feedback(o, request, &controller)).transpose();
    let output = output.map_err(refused)?;
    let feedback = output.clone().map_or(Feedback::FullState, |o| Feedback::Output(Box::new(o)));
    let options =
        LoopOptions { feedback, delay: request.delay, seed: request.seed, ..LoopOptions::default() };
    let closed = ClosedLoop::new(model, &controller, &options).map_err(refused)?;
    let reference = Reference::square(request.to, request.hold, 4);
    let run = closed.run(&reference).map_err(refused)?;
    stage("perturbing");
    let deviations = match report_of {
        Some((path, text)) => reported(path, text, model)?,
        None => stated(model),
    };
    let family = if deviations.is_empty() || request.members == 0 {
        None
    } else {
        let options =
            FamilyOptions { deviations: deviations.clone(), members: request.members, seed: request.seed };
        Some(closed.family(&reference, &options).map_err(refused)?)
    };
    stage("writing the report");
    let files = files(request);
    let producer = Producer { version: env!("CARGO_PKG_VERSION").into(), seed: request.seed };
    let page = convert::page(&ControlSources {
        model_file: &loaded.file,
        model,
        controller: &controller,
        output: output.as_ref(),
        delay: request.delay,
        run: &run,
        family: family.as_ref().map(|f| (f, deviations.as_slice())),
        producer: &producer,
        files: &files[1..],
    });

    let function = function(model, &controller, output.as_ref(), &loaded.file);
    let written = |e: greybox_export::ExportError| Failure::file(&loaded.path, e);
    let (c, rust) =
        (function.code(Language::C99).map_err(written)?, function.code(Language::Rust).map_err(written)?);
    let vectors = vectors(&function, &controller, output.as_ref(), request.to).map_err(written)?;
    let json = report(&page, request, &controller, output.as_ref(), &run, family.as_ref());
    let html = page.to_html().map_err(|e| Failure::internal(e.to_string()))?;
    let mut texts = vec![
        html.into_bytes(),
        format!("{json:#}\n").into_bytes(),
        series(&run)?,
        c.into_bytes(),
        rust.into_bytes(),
        vectors.into_bytes(),
    ];
    if let Some(output) = &output {
        let code = observer_code(model, &controller, output, &function, &loaded.file);
        for language in [Language::C99, Language::Rust] {
            texts.push(code.code(language).map_err(written)?.into_bytes());
        }
        texts.push(observed(&controller, output, &run)?);
    }
    let contents = files.iter().map(|(name, _)| *name).zip(texts).collect();
    let story = in_words(request, &loaded.file, &controller, output.as_ref(), &run, family.as_ref());
    Ok(Results { contents, story, json, run })
}

/// Standard deviations that the model states.
fn stated(model: &Model) -> Vec<(String, f64)> {
    let free = model.parameters.iter().filter(|p| !p.fixed);
    free.filter_map(|p| Some((p.name.clone(), p.std.filter(|s| *s > 0.0)?))).collect()
}

/// Standard deviations from the 95 % intervals of a report, SI.
fn reported(path: &Path, text: &str, model: &Model) -> Result<Vec<(String, f64)>, Failure> {
    let report: Value = serde_json::from_str(text).map_err(|e| {
        Failure::file(path, format!("this is no report: {e}"))
            .help("give the report.json of `greybox diagnose`")
    })?;
    let mechanisms = report["mechanisms"].as_array().into_iter().flatten().map(|m| &m["parameters"]);
    let tables: Vec<&Value> = [&report["parameters"]].into_iter().chain(mechanisms).collect();
    let deviation = |name: &str| {
        let interval = tables.iter().find_map(|t| t.get(name)?.get("ci95")?.as_array())?;
        let (low, high) = (interval.first()?.as_f64()?, interval.get(1)?.as_f64()?);
        Some((high - low) / (2.0 * 1.96))
    };
    let found: Vec<(String, f64)> = model
        .parameters
        .iter()
        .filter_map(|p| {
            let factor = p.unit.as_ref().map_or(1.0, |u| u.factor);
            Some((p.name.clone(), deviation(&p.name).map(|d| d * factor).filter(|d| *d > 0.0)?))
        })
        .collect();
    if found.is_empty() {
        return Err(Failure::file(path, "no interval of this report belongs to a parameter of the model")
            .help("give the report.json that was written with the model"));
    }
    Ok(found)
}

/// The input that commands.
fn input(request: &Request, loaded: &LoadedModel) -> Result<String, Failure> {
    match (&request.input, loaded.model.inputs.as_slice()) {
        (Some(name), _) => Ok(name.clone()),
        (None, [only]) => Ok(only.name.clone()),
        (None, []) => Err(Failure::file(&loaded.path, "the model has no input to command with")
            .help("state one under [inputs] and let it act in an equation")),
        (None, several) => {
            let names: Vec<&str> = several.iter().map(|i| i.name.as_str()).collect();
            Err(Failure::file(&loaded.path, format!("the model has the inputs {}", names.join(", ")))
                .help("name the one that commands with `--input`; the others are held at zero"))
        }
    }
}

fn options(request: &Request) -> PlantOptions {
    PlantOptions {
        sizes: request.sizes.clone(),
        input_size: request.input_size,
        ignore_time_terms: request.ignore_time_terms,
        predict_input_delay: request.observer.is_some(),
        ..PlantOptions::default()
    }
}

fn method(request: &Request) -> Method {
    match request.method {
        Way::Lqr => Method::Lqr,
        Way::Hjb => Method::Hjb { degree: request.degree, domain: Vec::new() },
        Way::Smc => {
            let eta = request.eta.unwrap_or(10.0 * request.input_size);
            Method::Smc { lambda: request.lambda, eta, phi: eta / request.rate }
        }
    }
}

/// The files of a request.
#[must_use]
pub fn files(request: &Request) -> Vec<(&'static str, &'static str)> {
    let further: &[(&str, &str)] = if request.observer.is_some() { &OBSERVER_FILES } else { &[] };
    FILES.iter().chain(further).copied().collect()
}

/// The observer that is asked for.
fn output_feedback(
    wanted: &ObserverRequest,
    request: &Request,
    controller: &Controller,
) -> Result<OutputFeedback, greybox_control::ControlError> {
    let fastest = controller.design_point().poles.iter().fold(0.0f64, |f, p| f.max(p.magnitude()));
    let method = match wanted.kind {
        ObserverKind::Kalman => ObserverMethod::Kalman {
            disturbance: wanted.disturbance.unwrap_or(DISTURBANCE * request.input_size),
        },
        ObserverKind::Eso => ObserverMethod::Eso { bandwidth: wanted.bandwidth.unwrap_or(FASTER * fastest) },
    };
    let mut sensors: Vec<(String, Sensor)> = Vec::new();
    let names = || wanted.noise.iter().chain(&wanted.resolution).map(|(name, _)| name);
    for name in names() {
        if sensors.iter().any(|(n, _)| n == name) {
            continue;
        }
        let of = |list: &[(String, f64)]| list.iter().rev().find(|(n, _)| n == name).map(|(_, v)| *v);
        let resolution = of(&wanted.resolution).unwrap_or(0.0);
        // An encoder has no noise but its counts; another sensor of which nothing is stated has.
        let size = controller.plant().state(name).map_or(1.0, |i| controller.plant().sizes()[i]);
        let unstated = if resolution > 0.0 { 0.0 } else { UNSTATED_NOISE * size };
        sensors.push((name.clone(), Sensor { noise: of(&wanted.noise).unwrap_or(unstated), resolution }));
    }
    OutputFeedback::new(controller, &OutputOptions { method, sensors, integral: !wanted.no_integral })
}

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
fn observer_code(
    model: &Model,
    controller: &Controller,
    output: &OutputFeedback,
    law: &Function,
    file: &str,
) -> ObserverCode {
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
        observer::Form::Kalman { gain } => ObserverForm::Kalman { gain },
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
        late: (output.observer().late().samples, output.observer().late().part),
        form,
    }
}

/// What the sensors said in the simulated loop, and the command that the observer's code must give.
fn observed(controller: &Controller, output: &OutputFeedback, run: &Run) -> Result<Vec<u8>, Failure> {
    let names = controller.plant().state_names();
    let count = run.t.len().min(OBSERVED);
    let mut columns: Vec<(&str, &[f64])> = Vec::new();
    for (&i, y) in output.observer().measured().iter().zip(&run.y) {
        columns.push((names[i].as_str(), &y[..count]));
    }
    columns.extend([("set_point", &run.r[..count]), ("command", &run.u[..count])]);
    let mut csv = Vec::new();
    write_csv(&mut csv, &run.t[..count], &columns)?;
    Ok(csv)
}

fn observer_in_words(output: &OutputFeedback) -> String {
    match output.method() {
        ObserverMethod::Kalman { disturbance } => format!(
            "Kalman filter, disturbance of {} of the command in a second",
            format::number(*disturbance)
        ),
        ObserverMethod::Eso { bandwidth } => {
            format!("Extended-state observer, bandwidth {} 1/s", format::number(*bandwidth))
        }
    }
}

/// The law as a function of the state, the disturbance where an observer estimates it, and the set point.
fn function(model: &Model, controller: &Controller, output: Option<&OutputFeedback>, file: &str) -> Function {
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
    let set_point =
        Group { name: "set_point".into(), members: vec![member(&(controller.reference().to_owned(), 0))] };
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

/// States around the set points, with the command that the code must give.
fn vectors(
    function: &Function,
    controller: &Controller,
    output: Option<&OutputFeedback>,
    to: f64,
) -> Result<String, greybox_export::ExportError> {
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
            point.push(if k % 2 == 0 { check.set_point } else { 0.5 * to });
            points.push(point);
        }
    }
    let mut names = plant.state_names();
    names.extend(output.map(|o| o.disturbance().to_owned()));
    names.extend([controller.reference().to_owned(), plant.input_name().to_owned()]);
    let mut text = names.join(",") + "\n";
    for vector in function.vectors(&points)? {
        let numbers: Vec<String> =
            vector.arguments.iter().chain(&vector.outputs).map(|v| format!("{v:?}")).collect();
        let _ = writeln!(text, "{}", numbers.join(","));
    }
    Ok(text)
}

/// The closed loop as a table.
fn series(run: &Run) -> Result<Vec<u8>, Failure> {
    let mut columns: Vec<(&str, &[f64])> = vec![("set_point", &run.r), ("command", &run.u)];
    columns.extend(run.states.iter().zip(&run.x).map(|(name, x)| (name.as_str(), x.as_slice())));
    let mut csv = Vec::new();
    write_csv(&mut csv, &run.t, &columns)?;
    Ok(csv)
}

fn report(
    page: &ControlPage,
    request: &Request,
    controller: &Controller,
    output: Option<&OutputFeedback>,
    run: &Run,
    family: Option<&Family>,
) -> Value {
    let plant = controller.plant();
    let (low, high) = controller.limits();
    let limit = |v: f64| if v.is_finite() { json!(v) } else { Value::Null };
    let margins = |m: &Margins| {
        json!({
            "gain": limit(m.gain), "lower_gain": m.lower_gain, "phase": m.phase, "delay": limit(m.delay),
            "sensitivity": m.sensitivity,
        })
    };
    let full = controller.margins();
    let checks: Vec<Value> = controller
        .checks()
        .iter()
        .enumerate()
        .map(|(k, c)| {
            let poles = |poles: &[Pole]| poles.iter().map(|p| [p.re, p.im]).collect::<Vec<_>>();
            json!({
                "set_point": c.set_point, "state": c.equilibrium.state, "command": c.equilibrium.input,
                "poles": poles(&c.poles), "held_poles": poles(&c.held_poles), "spectral_radius": c.spectral_radius,
                "margins": full.get(k).and_then(Option::as_ref).map(margins),
                "with_observer": output.and_then(|o| o.checks().get(k)).map(|c| json!({
                    "spectral_radius": c.spectral_radius, "margins": margins(&c.margins),
                })),
            })
        })
        .collect();
    let spread = |s: &greybox_control::Spread| json!({ "median": limit(s.median), "worst": limit(s.worst) });
    json!({
        "greybox": page.producer,
        "model": page.model.file,
        "verdict": page.verdict.name(),
        "summary": sentence::control::summary(page),
        "method": controller.method().name(),
        "input": plant.input_name(),
        "states": plant.state_names(),
        "tracked": plant.state_names().get(controller.tracked()),
        "dt": controller.dt(),
        "limits": [limit(low), limit(high)],
        "gains": controller.gains(),
        "law": match output {
            Some(output) => vec![output.law().to_string()],
            None => controller.law().iter().map(ToString::to_string).collect(),
        },
        "delay": request.delay,
        "input_delay": plant.input_delay(),
        "observer": output.map(|o| observer_report(plant, o)),
        "checks": checks,
        "left_out": plant.dropped().iter().map(|d| json!({
            "equation": d.equation, "term": d.term.to_string(),
        })).collect::<Vec<_>>(),
        "closed_loop": {
            "diverged": run.diverged.is_some(),
            "set_points": run.metrics.iter().map(metrics).collect::<Vec<_>>(),
        },
        "family": family.map(|f| json!({
            "members": f.members, "diverged": f.diverged, "settled": f.settled,
            "settling": spread(&f.settling), "overshoot": spread(&f.overshoot),
            "final_error": spread(&f.final_error), "largest_command": spread(&f.largest_command),
        })),
    })
}

fn observer_report(plant: &Plant, output: &OutputFeedback) -> Value {
    let names = plant.state_names();
    let sensors = output.observer().measured().iter().zip(output.sensors());
    let (kind, setting) = match output.method() {
        ObserverMethod::Kalman { disturbance } => ("kalman", json!({ "disturbance": disturbance })),
        ObserverMethod::Eso { bandwidth } => ("eso", json!({ "bandwidth": bandwidth })),
    };
    let gain = match output.observer().form() {
        observer::Form::Kalman { gain, .. } => json!(gain),
        observer::Form::Eso(_) => Value::Null,
    };
    json!({
        "kind": kind, "setting": setting, "integral": output.integral(), "gain": gain,
        "sensors": sensors.map(|(&i, s)| json!({
            "state": names[i], "noise": s.noise, "resolution": s.resolution,
        })).collect::<Vec<_>>(),
    })
}

fn metrics(m: &Metrics) -> Value {
    json!({
        "set_point": m.set_point, "settling": m.settling, "overshoot": m.overshoot,
        "final_error": m.final_error, "peak_to_peak": m.peak_to_peak, "rms_error": m.rms_error, "largest_command": m.largest_command,
        "saturated": m.saturated, "effort": m.effort,
    })
}

/// The worst margins over the set points, of the loop as it is fed back.
fn worst_margins(controller: &Controller, output: Option<&OutputFeedback>) -> Option<Margins> {
    let all: Vec<Margins> = match output {
        Some(output) => output.checks().iter().map(|c| c.margins).collect(),
        None => controller.margins().into_iter().flatten().collect(),
    };
    all.into_iter().reduce(Margins::worse)
}

fn in_words(
    request: &Request,
    file: &str,
    controller: &Controller,
    output: Option<&OutputFeedback>,
    run: &Run,
    family: Option<&Family>,
) -> String {
    let plant = controller.plant();
    let tracked = plant.state_names().get(controller.tracked()).cloned().unwrap_or_default();
    let mut text = format!(
        "{} of {} for {tracked}, commanded by {} every {} s\n",
        match request.method {
            Way::Lqr => "Linear-quadratic regulator",
            Way::Hjb => "Optimal law",
            Way::Smc => "Sliding-mode law",
        },
        file,
        plant.input_name(),
        format::number(controller.dt()),
    );
    for (name, gain) in plant.state_names().iter().zip(controller.gains()) {
        let _ = writeln!(text, "  gain of {name}: {}", format::number(*gain));
    }
    if let Some(output) = output {
        let sensors = output.observer().measured().iter().zip(output.sensors()).map(|(&i, s)| {
            let name = plant.state_names().get(i).cloned().unwrap_or_default();
            match (s.noise, s.resolution) {
                (noise, 0.0) => format!("{name} (noise {})", format::number(noise)),
                (0.0, resolution) => format!("{name} (in steps of {})", format::number(resolution)),
                (noise, resolution) => {
                    format!(
                        "{name} (noise {}, in steps of {})",
                        format::number(noise),
                        format::number(resolution)
                    )
                }
            }
        });
        let sensors: Vec<String> = sensors.collect();
        if plant.input_delay() > 0.0 {
            let _ = writeln!(
                text,
                "  predicts over the delay of the command, {} s",
                format::number(plant.input_delay())
            );
        }
        let integral = if output.integral() { "" } else { "; no integral action" };
        let _ = writeln!(text, "  {}; measured: {}{integral}", observer_in_words(output), sensors.join(", "));
    }
    let worst = worst_margins(controller, output);
    if let Some(m) = worst {
        let _ = writeln!(
            text,
            "  margins: gain × {} to {}, phase {}°, delay {} s",
            format::number(m.lower_gain),
            format::number(m.gain),
            format::number(m.phase.to_degrees()),
            format::number(m.delay),
        );
    }
    for dropped in plant.dropped() {
        let _ = writeln!(text, "  left out of {}: {}", dropped.equation, dropped.term);
    }
    for m in run.metrics.iter().skip(1) {
        let settling =
            m.settling.map_or("does not settle".into(), |s| format!("settles in {} s", format::number(s)));
        let _ = writeln!(
            text,
            "  to {}: {settling}, overshoot {}, ends {} off (peak to peak {}), command up to {}",
            format::number(m.set_point),
            format::percent(m.overshoot),
            format::number(m.final_error.abs()),
            format::number(m.peak_to_peak),
            format::number(m.largest_command),
        );
    }
    if let Some(at) = run.diverged {
        let t = run.t.get(at).copied().unwrap_or_default();
        let _ =
            writeln!(text, "  warning: the simulated loop leaves every bound after {} s", format::number(t));
    }
    if let Some(f) = family {
        let _ = writeln!(
            text,
            "  on {} perturbed plants: {} settle, {} diverge",
            f.members, f.settled, f.diverged
        );
    }
    text
}
