//! `greybox control`: from a model to a controller, its closed loop, and its law as code.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use greybox_commands::control::{self as commands, Integral, ObserverKind, ObserverRequest, Request};

use crate::answer::Answer;
use crate::failure::Failure;
use crate::loading::{self, Wanted};
use crate::output::OutputFolder;
use crate::progress::Progress;
use crate::study::whole;

/// Design a controller for a model, simulate its closed loop, and write its law as code
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox control improved.toml --report report.json --track theta --to 0.5 --size theta=0.5 --size \"theta'=5\" --out controller
  greybox control improved.toml --track theta --to 0.5 --feedback output --resolution theta=0.0015 --out controller
  greybox control improved.toml --track theta --reference move.csv --out controller
  greybox control improved.toml --method smc --lambda 16 --rate 100 --track theta --to 0.5 --limit 10 --out controller

All numbers are in SI. Sizes are the typical deviations of states and input: weights (Bryson's rule), the width of
smoothed friction and the perturbation of the state follow from them.
DIR receives report.html (self-contained, with plots), report.json, closed_loop.csv (a square wave between the set
points, or the trajectory of --reference), law.c (C99), law.rs (no_std Rust) and vectors.csv (states and set points with the command that the code must give);
with --feedback output also observer.c, observer.rs and observer_vectors.csv.")]
pub(crate) struct Arguments {
    /// Model (TOML), for example the improved.toml of a diagnosis
    #[arg(value_name = "MODEL.toml")]
    model: PathBuf,

    /// How the law is found
    #[arg(long, value_enum, default_value_t = Way::Lqr)]
    method: Way,

    /// Input that commands; the model's only one where it has one
    #[arg(long, value_name = "NAME")]
    input: Option<String>,

    /// State to bring to the set points, with its primes; the model's first where none is named
    #[arg(long, value_name = "STATE")]
    track: Option<String>,

    /// Set point; the closed loop steps between it and its negative
    #[arg(
        long,
        value_name = "VALUE",
        default_value_t = 1.0,
        allow_negative_numbers = true,
        conflicts_with = "reference"
    )]
    to: f64,

    /// Trajectory to follow in the place of set points: a recording with a channel of the tracked state
    #[arg(long, value_name = "FILE.csv")]
    reference: Option<PathBuf>,

    /// What the law reads of the trajectory: its value alone (static), or its first two derivatives too (dynamic)
    #[arg(long, value_enum, default_value_t = FeedForward::Dynamic, requires = "reference")]
    feed_forward: FeedForward,

    /// Typical size of a state, NAME=VALUE (may be given more than once); 1 where none is stated
    #[arg(long, value_name = "NAME=VALUE")]
    size: Vec<String>,

    /// Typical size of the command
    #[arg(long, value_name = "VALUE", default_value_t = 1.0, allow_negative_numbers = true)]
    input_size: f64,

    /// The actuator gives ± this at most
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true)]
    limit: Option<f64>,

    /// Sample time of the law, s
    #[arg(long, value_name = "SECONDS", default_value_t = 1e-3, allow_negative_numbers = true)]
    dt: f64,

    /// Time for each set point of the simulated square wave, s
    #[arg(
        long,
        value_name = "SECONDS",
        default_value_t = 2.0,
        allow_negative_numbers = true,
        conflicts_with = "reference"
    )]
    hold: f64,

    /// Degree of the value function; 4 where none is given (hjb)
    #[arg(long, value_name = "EVEN", value_parser = even, allow_negative_numbers = true)]
    degree: Option<u8>,

    /// Hold the limits of the command by the cost, so that the law slows down in time; without this they clip it (hjb)
    #[arg(long)]
    bounded: bool,

    /// Poles on the sliding surface are at −λ, 1/s; 10 where none is given (smc)
    #[arg(long, value_name = "RATE", allow_negative_numbers = true)]
    lambda: Option<f64>,

    /// Pole towards the sliding surface, 1/s; 50 where none is given (smc)
    #[arg(long, value_name = "RATE", allow_negative_numbers = true)]
    rate: Option<f64>,

    /// Reaching rate η in units of the command; ten input sizes where none is given (smc)
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true)]
    eta: Option<f64>,

    /// Drop disturbances that depend on the time from the design
    #[arg(long)]
    ignore_time_terms: bool,

    /// Take friction, smoothed, out of the motion (smc)
    #[arg(long)]
    compensate_friction: bool,

    /// What the law is given: the full state, or what an observer makes of the measured states (output)
    #[arg(long, value_enum, default_value_t = Feedback::State)]
    feedback: Feedback,

    /// How the state is estimated (output)
    #[arg(long, value_enum, default_value_t = Observer::Kalman)]
    observer: Observer,

    /// Noise of a measured state, NAME=STD (may be given more than once); a thousandth of its size where nothing is stated (output)
    #[arg(long, value_name = "NAME=STD")]
    noise: Vec<String>,

    /// Step of a measured state, NAME=STEP, such as one count of an encoder (may be given more than once) (output)
    #[arg(long, value_name = "NAME=STEP")]
    resolution: Vec<String>,

    /// Change of the disturbance in one second, in units of the command; a fifth of its size where none is given (kalman)
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true)]
    disturbance: Option<f64>,

    /// Bandwidth of the observer, 1/s; four times the fastest pole of the loop where none is given (eso)
    #[arg(long, value_name = "RATE", allow_negative_numbers = true)]
    bandwidth: Option<f64>,

    /// Leave the estimated disturbance in: no integral action (output)
    #[arg(long)]
    no_integral: bool,

    /// Integral action of the error at rest in place of the estimated disturbance, for a machine that sticks and hunts (output)
    #[arg(long, conflicts_with = "no_integral")]
    integral_at_rest: bool,

    /// Delay of the simulated loop, s: sensors, network and computing together
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, allow_negative_numbers = true)]
    delay: f64,

    /// Report of the diagnosis or calibration the model is from: how sure its parameters are
    #[arg(long, value_name = "report.json")]
    report: Option<PathBuf>,

    /// Perturbed plants on which the law is tried: parameters vary as the report says, else by the model's `std`
    #[arg(long, value_name = "N", default_value_t = 200, allow_negative_numbers = true)]
    members: usize,

    /// Seed of the perturbed plants
    #[arg(long, value_name = "N", value_parser = whole, default_value_t = 0, allow_negative_numbers = true)]
    seed: u64,

    /// Folder for the results; made where it is missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// A degree of polynomials that may be positive everywhere.
fn even(text: &str) -> Result<u8, String> {
    match text.parse::<u8>() {
        Ok(degree) if degree >= 2 && degree % 2 == 0 => Ok(degree),
        _ => Err("a value function has an even degree of 2 or more".to_owned()),
    }
}

/// The methods, as on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Way {
    /// Linear-quadratic regulator
    Lqr,
    /// Value function of a higher degree by the Hamilton–Jacobi–Bellman equation
    Hjb,
    /// Flat-output sliding mode
    Smc,
}

/// What the law reads of a trajectory, as on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum FeedForward {
    /// Its value: every one is a set point
    Static,
    /// Its value, rate and acceleration
    Dynamic,
}

/// What the law is given, as on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Feedback {
    /// Every state
    State,
    /// The estimate of an observer
    Output,
}

/// The observers, as on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Observer {
    /// Steady-state Kalman filter with the disturbance of the command as a state
    Kalman,
    /// Extended-state observer
    Eso,
}

impl From<Way> for commands::Way {
    fn from(way: Way) -> commands::Way {
        match way {
            Way::Lqr => commands::Way::Lqr,
            Way::Hjb => commands::Way::Hjb,
            Way::Smc => commands::Way::Smc,
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let loaded = loading::model(&arguments.model)?;
    let out = OutputFolder::prepare(&arguments.out)?;
    let mut request = request(arguments)?;
    if let Some(path) = &arguments.reference {
        let track = arguments.track.as_deref();
        let wanted = Wanted::default().of_names(commands::channel(&loaded.model, track).map(|c| vec![c]));
        let recordings = loading::recordings(std::slice::from_ref(path), &wanted)?;
        let [recording] = recordings.as_slice() else {
            return Err(Failure::internal("one recording was named, but not read"));
        };
        request.trajectory = Some(commands::trajectory(&loaded, track, recording, path)?);
    }
    let names: Vec<&str> = commands::files(&request).iter().map(|(name, _)| *name).collect();
    out.spares(&names, [&arguments.model].into_iter().chain(&arguments.reference))?;
    let report = arguments.report.as_deref().map(loading::text).transpose()?;
    let report = arguments.report.as_deref().zip(report.as_deref());
    let progress = Progress::open();
    let results = commands::control(&loaded, &request, report, &|what| progress.stage(what))?;
    drop(progress);
    out.write(&results.files())?;
    let place = arguments.out.display();
    let files: Vec<String> = names.iter().map(|f| format!("{place}/{f}")).collect();
    let text = format!("{}Written: {}\n", results.story, files.join(", "));
    Ok(Answer::new(text, results.json))
}

/// An option that belongs to another method, or another observer, than the one that was chosen.
fn of_another(option: &str, choice: &str, (other, own): (impl ValueEnum, impl ValueEnum)) -> Failure {
    let name = |value: Option<clap::builder::PossibleValue>| {
        value.map_or_else(String::new, |v| v.get_name().to_owned())
    };
    let (other, own) = (name(other.to_possible_value()), name(own.to_possible_value()));
    Failure::input(format!("`{option}` belongs to `--{choice} {other}`, and `{own}` is chosen"))
        .help(format!("leave it out, or add `--{choice} {other}`"))
}

fn request(arguments: &Arguments) -> Result<Request, Failure> {
    let named = |option: &str, what: &str, list: &[String]| -> Result<Vec<(String, f64)>, Failure> {
        let one = |text: &String| {
            let parsed = text
                .rsplit_once('=')
                .and_then(|(name, v)| Some((name.trim(), v.trim().parse::<f64>().ok()?)));
            match parsed {
                Some((name, value)) if value > 0.0 && value.is_finite() => Ok((name.to_owned(), value)),
                _ => Err(Failure::input(format!("`--{option} {text}` is no {what} of a state")).help(
                    format!("write it as NAME=VALUE with a positive number, such as `--{option} theta=0.5`"),
                )),
            }
        };
        list.iter().map(one).collect()
    };
    let observer = match arguments.feedback {
        Feedback::State => None,
        Feedback::Output => Some(ObserverRequest {
            kind: match arguments.observer {
                Observer::Kalman => ObserverKind::Kalman,
                Observer::Eso => ObserverKind::Eso,
            },
            noise: named("noise", "noise", &arguments.noise)?,
            resolution: named("resolution", "step", &arguments.resolution)?,
            disturbance: arguments.disturbance,
            bandwidth: arguments.bandwidth,
            integral: match (arguments.no_integral, arguments.integral_at_rest) {
                (true, _) => Integral::Off,
                (false, true) => Integral::AtRest { time: None },
                (false, false) => Integral::Disturbance,
            },
        }),
    };
    let unused = [
        ("--noise", !arguments.noise.is_empty()),
        ("--resolution", !arguments.resolution.is_empty()),
        ("--disturbance", arguments.disturbance.is_some()),
        ("--bandwidth", arguments.bandwidth.is_some()),
        ("--no-integral", arguments.no_integral),
        ("--integral-at-rest", arguments.integral_at_rest),
    ];
    if observer.is_none()
        && let Some((option, _)) = unused.iter().find(|(_, given)| *given)
    {
        return Err(Failure::input(format!(
            "`{option}` belongs to an observer, and the law is given the full state"
        ))
        .help("add `--feedback output`"));
    }
    let of_a_method = [
        ("--degree", Way::Hjb, arguments.degree.is_some()),
        ("--bounded", Way::Hjb, arguments.bounded),
        ("--lambda", Way::Smc, arguments.lambda.is_some()),
        ("--rate", Way::Smc, arguments.rate.is_some()),
        ("--eta", Way::Smc, arguments.eta.is_some()),
        ("--compensate-friction", Way::Smc, arguments.compensate_friction),
    ];
    if let Some((option, method, _)) = of_a_method.iter().find(|o| o.2 && o.1 != arguments.method) {
        return Err(of_another(option, "method", (*method, arguments.method)));
    }
    let of_an_observer = [
        ("--disturbance", Observer::Kalman, arguments.disturbance.is_some()),
        ("--bandwidth", Observer::Eso, arguments.bandwidth.is_some()),
    ];
    if let Some((option, observer, _)) = of_an_observer.iter().find(|o| o.2 && o.1 != arguments.observer) {
        return Err(of_another(option, "observer", (*observer, arguments.observer)));
    }
    Ok(Request {
        method: arguments.method.into(),
        input: arguments.input.clone(),
        track: arguments.track.clone(),
        to: arguments.to,
        trajectory: None,
        static_feed_forward: arguments.feed_forward == FeedForward::Static,
        sizes: named("size", "size", &arguments.size)?,
        input_size: arguments.input_size,
        limit: arguments.limit,
        dt: arguments.dt,
        hold: arguments.hold,
        degree: arguments.degree.unwrap_or(4),
        bounded: arguments.bounded,
        lambda: arguments.lambda.unwrap_or(10.0),
        rate: arguments.rate.unwrap_or(50.0),
        eta: arguments.eta,
        ignore_time_terms: arguments.ignore_time_terms,
        compensate_friction: arguments.compensate_friction,
        observer,
        delay: arguments.delay,
        members: arguments.members,
        seed: arguments.seed,
    })
}
