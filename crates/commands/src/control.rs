//! From a model to a controller, its closed loop, and its law as code.

mod answer;
mod code;
mod designed;
mod trajectory;

use std::path::Path;

pub use greybox_control::Integral;
use greybox_control::{
    ClosedLoop, Controller, DesignOptions, Equilibrium, FamilyOptions, Feedback, LoopOptions, Method,
    ObserverMethod, OutputFeedback, OutputOptions, Plant, PlantOptions, Reference, Run, Sensor, Trajectory,
    UNSTATED_NOISE, design, equilibrium,
};
use greybox_export::Language;
use greybox_model::Model;
use greybox_report::contract::Producer;
use greybox_report::convert::control::{self as convert, ControlSources};
use serde_json::Value;

use self::designed::Designed;
pub use self::trajectory::{channel, trajectory};
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
/// Change of the disturbance in one second that an observer expects where nothing is stated, over the command's size.
const DISTURBANCE: f64 = 0.2;
/// Bandwidth of an extended-state observer where none is stated, over the fastest pole of the loop.
const FASTER: f64 = 4.0;

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
    /// What the tracked state is to follow, in the place of set points.
    pub trajectory: Option<Trajectory>,
    /// Whether the law takes every value of the trajectory for a set point, and does not read its derivatives.
    pub static_feed_forward: bool,
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
    /// Hold the limits of the command by the cost (hjb); without this the limits clip the law.
    pub bounded: bool,
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
    /// The integral action of the law.
    pub integral: Integral,
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
            trajectory: None,
            static_feed_forward: false,
            sizes: Vec::new(),
            input_size: 1.0,
            limit: None,
            dt: 1e-3,
            hold: 2.0,
            degree: 4,
            bounded: false,
            lambda: 10.0,
            rate: 50.0,
            eta: None,
            ignore_time_terms: false,
            compensate_friction: false,
            observer: None,
            delay: 0.0,
            members: 200,
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
    if request.bounded && request.method != Way::Hjb {
        return Err(Failure::input("only a law of the method `hjb` can be bounded by its cost")
            .help("choose the method `hjb`, or leave `bounded` out: the limits then clip the law"));
    }
    let plant = Plant::of(model, &input(request, loaded)?, &options(request)).map_err(refused)?;
    let tracked = match &request.track {
        Some(name) => name.clone(),
        None => plant.state_names().first().cloned().unwrap_or_default(),
    };
    stage("designing");
    let wanted = DesignOptions {
        limit: request.limit,
        compensate_friction: request.compensate_friction,
        trajectories: request.trajectory.is_some() && !request.static_feed_forward,
        ..DesignOptions::new(&tracked, &set_points(request), request.dt)
    };
    let controller = design(&plant, &method(request), &wanted).map_err(refused)?;
    stage("simulating");
    let output = request.observer.as_ref().map(|o| output_feedback(o, request, &controller)).transpose();
    let output = output.map_err(refused)?;
    let feedback = output.clone().map_or(Feedback::FullState, |o| Feedback::Output(Box::new(o)));
    let rest = start(request, &controller).map_err(refused)?;
    // What the actuator is given; the equilibrium is behind its dead zone.
    let held = rest.as_ref().map(|at| plant.before_dead_zone(at.input));
    let options = LoopOptions {
        start: rest.map(|at| at.state),
        feedback,
        held,
        delay: request.delay,
        seed: request.seed,
        ..LoopOptions::default()
    };
    let closed = ClosedLoop::new(model, &controller, &options).map_err(refused)?;
    let reference = reference(request);
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
    let producer = Producer::this(request.seed);
    let page = convert::page(&ControlSources {
        model_file: &loaded.file,
        model,
        controller: &controller,
        output: output.as_ref(),
        delay: request.delay,
        run: &run,
        is_trajectory: request.trajectory.is_some(),
        family: family.as_ref().map(|f| (f, deviations.as_slice())),
        producer: &producer,
        files: &files[1..],
    });

    let designed = Designed {
        model,
        file: &loaded.file,
        controller: &controller,
        output: output.as_ref(),
        delay: request.delay,
        held: output.as_ref().and(held),
        run: &run,
        family: family.as_ref(),
    };
    let json = answer::report(&page, &designed);
    let html = page.to_html().map_err(|e| Failure::internal(e.to_string()))?;
    let mut texts = vec![html.into_bytes(), format!("{json:#}\n").into_bytes(), code::series(&run)?];
    let law = code::function(&designed);
    let written = |e: greybox_export::ExportError| Failure::file(&loaded.path, e);
    for language in [Language::C99, Language::Rust] {
        texts.push(law.code(language).map_err(written)?.into_bytes());
    }
    texts.push(code::vectors(&designed, &law).map_err(written)?.into_bytes());
    if let Some(output) = &output {
        let observer = code::observer_code(&designed, output, &law);
        for language in [Language::C99, Language::Rust] {
            texts.push(observer.code(language).map_err(written)?.into_bytes());
        }
        texts.push(code::observed(&designed, output)?);
    }
    let contents = files.iter().map(|(name, _)| *name).zip(texts).collect();
    let story = answer::in_words(&page, &designed);
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
        Way::Hjb => Method::Hjb { degree: request.degree, domain: Vec::new(), bounded: request.bounded },
        Way::Smc => {
            let eta = request.eta.unwrap_or(10.0 * request.input_size);
            Method::Smc { lambda: request.lambda, eta, phi: eta / request.rate }
        }
    }
}

/// What the simulated loop follows.
fn reference(request: &Request) -> Reference {
    match &request.trajectory {
        Some(trajectory) => Reference::Trajectory(trajectory.clone()),
        None => Reference::square(request.to, request.hold, 4),
    }
}

/// Where the law is designed and checked: the ends of what it is to reach.
fn set_points(request: &Request) -> [f64; 2] {
    match &request.trajectory {
        Some(trajectory) => trajectory.range().into(),
        None => [-request.to, request.to],
    }
}

/// The loop begins at rest where the trajectory begins; for set points at zero.
fn start(
    request: &Request,
    controller: &Controller,
) -> Result<Option<Equilibrium>, greybox_control::ControlError> {
    let Some(trajectory) = &request.trajectory else { return Ok(None) };
    let near = &controller.design_point().equilibrium;
    let at = equilibrium(controller.plant(), controller.tracked(), trajectory.at(0.0)[0], near)?;
    Ok(Some(at))
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
    OutputFeedback::new(controller, &OutputOptions { method, sensors, integral: wanted.integral })
}
