//! `greybox identify`: the governing equations, from recordings alone.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use greybox_commands::identify::{FILES, Results};
use greybox_identify::{DeadTime, DelayedState, Library, Monomials, Options, Streamed};
use greybox_model::Hold;
use greybox_report::convert::identification::{MODEL_FILE, Sources};

use crate::answer::Answer;
use crate::case::Subject;
use crate::commands::diagnose::{self, written};
use crate::failure::Failure;
use crate::loading;
use crate::progress::Progress;
use crate::study::{BILLION, Recordings, Study, whole};

/// Find the governing equations from recordings alone: which terms, their values, and how sure each is
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox identify run1.csv --states x --inputs f --holdout run2.csv --out found
  greybox identify run1.csv run2.csv --states theta,alpha --inputs v --library separate,friction --out found
  greybox identify run1.mat --states x --inputs f --map x=encoder --out found
  greybox identify run1.csv --states x --inputs f --delay x --longest 0.5 --out found
  greybox identify run1.csv --states x --inputs f --dead-time f=0.2 --hold zero --out found
  greybox identify a_week.csv --states x --inputs f --block 20000 --out found
  greybox identify run1.csv --model link.toml --holdout run2.csv --out found

With --model, the equations are kept: the terms that they lack are identified (`greybox mechanisms` lists what is tried)
and fitted together with the parameters. No mechanism is named.

DIR receives model.toml (runs in `greybox simulate` and `greybox diagnose`), report.json and report.html
(self-contained, with plots). With no --holdout, the last fifth of each recording is held out. The same seed and
inputs give the same results.")]
pub(crate) struct Arguments {
    #[command(flatten)]
    study: Study,

    /// Nominal model (TOML): identify the terms that its equations lack
    #[arg(long, value_name = "MODEL.toml", conflicts_with_all = [
        "states", "inputs", "order", "library", "terms", "derivatives", "hold", "dead_times", "delay", "gain", "longest",
        "block", "replicates",
    ])]
    model: Option<PathBuf>,

    /// With --model: folder of terms of your own (*.toml), tried beside the built-in ones
    #[arg(long, value_name = "DIR", requires = "model")]
    mechanisms: Option<PathBuf>,

    /// Channels that are the coordinates of the machine, one equation each
    #[arg(long, value_name = "X,…", value_delimiter = ',', num_args = 1, required_unless_present = "model")]
    states: Vec<String>,

    /// Channels that drive it; which of them enters which equation is found
    #[arg(long, value_name = "F,…", value_delimiter = ',', num_args = 1)]
    inputs: Vec<String>,

    /// Highest order of the library to try [default: 6 for one state, 4 for several]
    #[arg(long, value_name = "N")]
    order: Option<usize>,

    /// What the equations may contain: one kind of monomials and any of the other parts
    /// [default: tensor for one state, separate for several]
    #[arg(long, value_name = "PART,…", value_delimiter = ',', num_args = 1)]
    library: Vec<Part>,

    /// A candidate term of your own in the model language, such as "x'*abs(x')"; may be repeated
    #[arg(long = "term", value_name = "EXPR")]
    terms: Vec<String>,

    /// Order of the leading derivative, one for all states or one for each: 2 for mechanics, 1 for first-order systems
    #[arg(long, value_name = "1|2,…", value_delimiter = ',', num_args = 1, default_value = "2")]
    derivatives: Vec<usize>,

    /// What the inputs do between samples [default: found from the recordings]
    #[arg(long, value_name = "HOLD")]
    hold: Option<Between>,

    /// Input with a dead time to be found, and the longest in seconds; may be repeated [default: a typical oscillation of
    /// the states, at most a tenth of the longest recording]
    #[arg(long = "dead-time", value_name = "INPUT[=SECONDS]", value_parser = dead_time)]
    dead_times: Vec<DeadTime>,

    /// State that is also fed back with an unknown delay
    #[arg(long, value_name = "STATE")]
    delay: Option<String>,

    /// Gain of the delayed feedback, where it is known
    #[arg(long, value_name = "KP", requires = "delay", allow_negative_numbers = true)]
    gain: Option<f64>,

    /// Longest delay to look for, s
    #[arg(
        long,
        value_name = "SECONDS",
        requires = "delay",
        default_value_t = 1.0,
        allow_negative_numbers = true
    )]
    longest: f64,

    /// Read the recordings in blocks of so many rows, in constant memory, whatever their length; without --holdout
    /// the last block is held out
    #[arg(long, value_name = "ROWS", value_parser = clap::value_parser!(u32).range(1000..), conflicts_with = "save_case")]
    block: Option<u32>,

    /// Resampled data sets behind the inclusion probabilities
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u16).range(1..))]
    replicates: u16,

    /// Seed of every random choice
    #[arg(long, value_name = "N", value_parser = whole, default_value_t = 0, allow_negative_numbers = true)]
    seed: u64,

    /// Most work of the fits, in billions of operations; the report says when it was not enough [default: 80, with
    /// --model 120]
    #[arg(long, value_name = "N", value_parser = whole, allow_negative_numbers = true)]
    work: Option<u64>,
}

/// What the help says of `--work`.
const _: () = {
    assert!(greybox_identify::MOST_WORK == 80 * BILLION);
    assert!(greybox_diagnose::search::MOST_WORK == 120 * BILLION);
};

/// A part of the library.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Part {
    /// All products of powers, each exponent up to the order
    Tensor,
    /// All products of powers of total degree up to the order
    Total,
    /// Powers of single variables, no products
    Separate,
    /// A constant force
    Constant,
    /// Coulomb friction: the sign of every velocity
    Friction,
    /// Sine and cosine of every state
    Trigonometric,
    /// Terms of kinetic energy and gravity, shared by the equations of rigid bodies on joints
    Lagrangian,
}

impl Part {
    fn monomials(self) -> Option<Monomials> {
        match self {
            Part::Tensor => Some(Monomials::Tensor),
            Part::Total => Some(Monomials::TotalDegree),
            Part::Separate => Some(Monomials::Separate),
            Part::Constant | Part::Friction | Part::Trigonometric | Part::Lagrangian => None,
        }
    }
}

/// What an input does between its samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum Between {
    /// The sample's value until the next one
    Zero,
    /// A straight line
    Linear,
    /// The band-limited signal through the samples
    BandLimited,
}

impl From<Between> for Hold {
    fn from(between: Between) -> Hold {
        match between {
            Between::Zero => Hold::Zero,
            Between::Linear => Hold::Linear,
            Between::BandLimited => Hold::BandLimited,
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let study = &arguments.study;
    let subject = Subject {
        model: arguments.model.as_deref(),
        mechanisms: arguments.mechanisms.as_deref(),
        channels: (&arguments.inputs, &arguments.states),
        ..study.subject(&FILES)
    };
    study.case.around(&subject, || match &arguments.model {
        Some(model) => terms(arguments, model),
        None => work(arguments),
    })
}

/// The terms that a nominal model lacks.
fn terms(arguments: &Arguments, model: &PathBuf) -> Result<Answer, Failure> {
    let own = arguments.mechanisms.as_deref().map(loading::mechanisms).transpose()?;
    let usual = greybox_diagnose::Options::default();
    let options = greybox_diagnose::Options {
        seed: arguments.seed,
        library: own.as_ref().map(|own| own.library.mechanisms.clone()),
        work: arguments.work.map_or(usual.work, |work| work.saturating_mul(BILLION)),
        terms_only: true,
    };
    diagnose::answer(&arguments.study, model, own.as_ref(), &options, MODEL_FILE)
}

fn work(arguments: &Arguments) -> Result<Answer, Failure> {
    let options = options(arguments)?;
    let names = arguments.states.iter().chain(&arguments.inputs).map(|name| vec![name.trim().to_owned()]);
    let wanted = arguments.study.channels.wanted().of_names(names);
    let (found, recordings, out, progress) = match arguments.block {
        None => {
            let recordings = arguments.study.recordings(&wanted)?;
            let out = arguments.study.folder(&FILES, [])?;
            let progress = Progress::open();
            let Recordings { train, holdout } = &recordings;
            let found = greybox_identify::identify(train, holdout, &options, &progress)?;
            (found, recordings, out, progress)
        }
        Some(rows) => {
            let paths = &arguments.study.train;
            loading::no_twins(paths.iter().chain(&arguments.study.holdout))?;
            let holdout = loading::recordings(&arguments.study.holdout, &wanted)?;
            let open = || loading::blocks(paths, rows as usize, &wanted);
            // A file that is missing or empty is reported before anything is written.
            drop(open()?);
            let out = arguments.study.folder(&FILES, [])?;
            let progress = Progress::open();
            let Streamed { found, first, holdout } =
                greybox_identify::identify_blocks(open, &holdout, &options, &progress)?;
            (found, Recordings { train: vec![first], holdout }, out, progress)
        }
    };
    progress.stage("writing the report");
    let sources = Sources { train: &recordings.train, holdout: &recordings.holdout, hold: options.hold };
    let results = Results::of(&found, &sources)?;
    drop(progress);
    out.write(&results.files())?;
    Ok(Answer::new(format!("{}\n{}", results.story, written(&arguments.study.out, MODEL_FILE)), results.json))
}

/// The request in the words of the library.
fn options(arguments: &Arguments) -> Result<Options, Failure> {
    fn borrowed(names: &[String]) -> Vec<&str> {
        names.iter().map(|name| name.trim()).filter(|name| !name.is_empty()).collect()
    }
    let usual = Options::new(&borrowed(&arguments.states), &borrowed(&arguments.inputs));
    let delay = arguments.delay.as_ref().map(|state| DelayedState {
        state: state.clone(),
        gain: arguments.gain,
        longest: arguments.longest,
    });
    Ok(Options {
        derivatives: of_every_state(&arguments.derivatives, arguments.states.len()),
        library: library(arguments, usual.library.monomials)?,
        order: arguments.order.unwrap_or(usual.order),
        hold: arguments.hold.map(Hold::from),
        delay,
        dead_times: arguments.dead_times.clone(),
        replicates: usize::from(arguments.replicates),
        seed: arguments.seed,
        work: arguments.work.map_or(usual.work, |work| work.saturating_mul(BILLION)),
        ..usual
    })
}

/// `INPUT` or `INPUT=SECONDS`.
fn dead_time(text: &str) -> Result<DeadTime, String> {
    let (input, longest) = match text.split_once('=') {
        None => (text, None),
        Some((input, seconds)) => {
            let number = seconds.trim().parse::<f64>();
            (input, Some(number.map_err(|_| format!("`{seconds}` is not a number of seconds"))?))
        }
    };
    Ok(DeadTime { input: input.trim().to_owned(), longest })
}

/// One value for every state, where one stands for all.
fn of_every_state(given: &[usize], states: usize) -> Vec<usize> {
    match given {
        [one] => vec![*one; states],
        several => several.to_vec(),
    }
}

fn library(arguments: &Arguments, usual: Monomials) -> Result<Library, Failure> {
    let parts = &arguments.library;
    let mut kinds = parts.iter().filter_map(|part| part.monomials());
    let monomials = kinds.next().unwrap_or(usual);
    if kinds.any(|other| other != monomials) {
        return Err(Failure::input("--library names two kinds of monomials")
            .help("choose one of `tensor`, `total` and `separate`"));
    }
    Ok(Library {
        monomials,
        constant: parts.contains(&Part::Constant),
        friction: parts.contains(&Part::Friction),
        trigonometric: parts.contains(&Part::Trigonometric),
        lagrangian: parts.contains(&Part::Lagrangian),
        terms: arguments.terms.clone(),
    })
}
