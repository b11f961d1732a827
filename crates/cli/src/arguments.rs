//! The command line.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::error::ErrorKind;
use clap::{Args, Parser, Subcommand};

use crate::answer::Answer;
use crate::case::{CaseOptions, Subject};
use crate::commands::{
    calibrate, check, compare, control, demo, diagnose, export, identify, mechanisms, new, shell, simulate,
};
use crate::failure::{self, Failure};
use crate::loading::{self, LoadedModel};
use crate::output::OutputFolder;
use greybox_calibrate::Data;
use greybox_model::Unit;
use greybox_recording::{Recording, Rename, RenameError};

/// Give greybox a recording and the simulation you believe in: it tells you what physics is missing,
/// where it acts, how sure it is, and hands back a simulation that fits.
#[derive(Debug, Parser)]
#[command(
    name = "greybox",
    version,
    disable_help_subcommand = true,
    after_help = "Examples:
  greybox demo
  greybox check run1.csv --model link.toml
  greybox diagnose link.toml run1.csv run2.csv --holdout run3.csv --out result
  greybox diagnose link.toml run1.mat --map \"theta=sensor_3 [deg]\" --out result
  greybox simulate result/improved.toml run3.csv --out simulated.csv
  greybox identify run1.csv --states x --inputs f --holdout run2.csv --out found
  greybox control result/improved.toml --track theta --to 0.5 --out controller
  greybox export result/improved.toml --to python --out machine.py
  greybox new servo --out servo.toml

Exit status: 0 finished, whatever the verdict; 2 bad usage or bad input; 1 internal failure; 3 what
`compare --fail-if` names holds."
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,

    /// Print one JSON document for machines in place of plain language
    #[arg(long, global = true)]
    json: bool,

    /// Tell every stage on standard error, and at the end what the stages cost
    #[arg(long, global = true)]
    pub(crate) log: bool,
}

/// The unit of `--work`, in operations.
pub(crate) const BILLION: u64 = 1_000_000_000;

/// A seed, or an amount of work.
pub(crate) fn whole(text: &str) -> Result<u64, String> {
    text.parse().map_err(|_| format!("write a whole number from 0 to {}, such as 7", u64::MAX))
}

/// What the model calls the channels of the recordings.
#[derive(Debug, Args)]
pub(crate) struct Channels {
    // (Not a doc comment: rustdoc takes a unit in brackets for a link.)
    #[arg(
        long,
        value_name = "NAME=CHANNEL",
        value_parser = rename,
        help = "Name of the model for a channel of the recordings, with its unit where they state none, such as \
                \"theta=sensor_3 [deg]\"; may be repeated"
    )]
    pub(crate) map: Vec<Rename>,
}

/// A [`Rename`] whose unit, if it has one, is written as one; a symbol that is not built in may be declared by the model.
fn rename(text: &str) -> Result<Rename, String> {
    let rename: Rename = text.parse().map_err(|e: RenameError| e.to_string())?;
    match rename.unit.as_deref().map(Unit::parse) {
        Some(Err(error)) if error.unknown.is_none() => Err(error.to_string()),
        _ => Ok(rename),
    }
}

/// The recordings of a command that learns from some and is judged on others, and where its results go.
#[derive(Debug, Args)]
pub(crate) struct Study {
    /// Recordings to choose and fit with (CSV, MAT-file or Parquet)
    #[arg(value_name = "TRAIN.csv", required = true)]
    pub(crate) train: Vec<PathBuf>,

    /// Recordings that only judge the result
    #[arg(long, value_name = "TEST.csv", num_args = 1..)]
    pub(crate) holdout: Vec<PathBuf>,

    #[command(flatten)]
    pub(crate) channels: Channels,

    /// Folder for the results; made where it is missing
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,

    #[command(flatten)]
    pub(crate) case: CaseOptions,
}

/// What a [`Study`] reads.
#[derive(Debug)]
pub(crate) struct Recordings {
    pub(crate) train: Vec<Recording>,
    pub(crate) holdout: Vec<Recording>,
}

impl Study {
    /// Reads the recordings.
    ///
    /// # Errors
    /// As [`loading::train_and_holdout`].
    pub(crate) fn recordings(&self) -> Result<Recordings, Failure> {
        let (train, holdout) = loading::train_and_holdout(&self.train, &self.holdout, &self.channels.map)?;
        Ok(Recordings { train, holdout })
    }

    /// Reads a model and the recordings, and sees that they fit each other.
    ///
    /// # Errors
    /// Bad input: a file that cannot be read, or a recording that lacks what the model needs.
    pub(crate) fn read(&self, model: &Path) -> Result<(LoadedModel, Recordings), Failure> {
        let loaded = loading::model(model)?;
        let recordings = self.recordings()?;
        Data::new(&loaded.model, &recordings.train)?;
        Data::new(&loaded.model, &recordings.holdout)?;
        Ok((loaded, recordings))
    }

    /// What a case of it holds: its files, and the names of its results.
    pub(crate) fn subject<'a>(&'a self, files: &'a [&'a str]) -> Subject<'a> {
        Subject {
            model: None,
            train: &self.train,
            holdout: &self.holdout,
            map: &self.channels.map,
            mechanisms: None,
            channels: (&[], &[]),
            out: &self.out,
            files,
        }
    }

    /// The folder for `results`, none of which may replace an input.
    ///
    /// # Errors
    /// As [`OutputFolder::prepare`] and [`OutputFolder::spares`].
    pub(crate) fn folder<'a>(
        &'a self,
        results: &[&str],
        others: impl IntoIterator<Item = &'a PathBuf>,
    ) -> Result<OutputFolder, Failure> {
        let out = OutputFolder::prepare(&self.out)?;
        out.spares(results, self.train.iter().chain(&self.holdout).chain(others))?;
        Ok(out)
    }
}

/// A [`Study`] of a model.
#[derive(Debug, Args)]
pub(crate) struct ModelStudy {
    /// Nominal model (TOML)
    #[arg(value_name = "MODEL.toml")]
    pub(crate) model: PathBuf,

    #[command(flatten)]
    pub(crate) study: Study,
}

impl ModelStudy {
    /// As [`Study::read`].
    ///
    /// # Errors
    /// As [`Study::read`].
    pub(crate) fn read(&self) -> Result<(LoadedModel, Recordings), Failure> {
        self.study.read(&self.model)
    }

    /// As [`Study::folder`]; the model is an input too.
    ///
    /// # Errors
    /// As [`Study::folder`].
    pub(crate) fn folder(&self, results: &[&str]) -> Result<OutputFolder, Failure> {
        self.study.folder(results, [&self.model])
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    Diagnose(diagnose::Arguments),
    Identify(identify::Arguments),
    Calibrate(calibrate::Arguments),
    Simulate(simulate::Arguments),
    Check(check::Arguments),
    Compare(compare::Arguments),
    Control(control::Arguments),
    Export(export::Arguments),
    New(new::Arguments),
    Mechanisms(mechanisms::Arguments),
    Demo(demo::Arguments),
    Completions(shell::Completions),
    Man(shell::Man),
}

impl Command {
    pub(crate) fn run(&self) -> Result<Answer, Failure> {
        match self {
            Command::Diagnose(arguments) => diagnose::run(arguments),
            Command::Identify(arguments) => identify::run(arguments),
            Command::Calibrate(arguments) => calibrate::run(arguments),
            Command::Simulate(arguments) => simulate::run(arguments),
            Command::Check(arguments) => check::run(arguments),
            Command::Compare(arguments) => compare::run(arguments),
            Command::Control(arguments) => control::run(arguments),
            Command::Export(arguments) => export::run(arguments),
            Command::New(arguments) => new::run(arguments),
            Command::Mechanisms(arguments) => mechanisms::run(arguments),
            Command::Demo(arguments) => demo::run(arguments),
            Command::Completions(arguments) => shell::completions(arguments),
            Command::Man(arguments) => shell::man(arguments),
        }
    }
}

impl Cli {
    /// Parses the command line; `Ok(Err(…))` is help or version, asked for and given.
    pub(crate) fn read(arguments: Vec<OsString>) -> Result<Result<Cli, Answer>, Failure> {
        match Cli::try_parse_from(arguments) {
            Ok(cli) => Ok(Ok(cli)),
            Err(e) if matches!(e.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) => {
                Ok(Err(Answer::words(e.render().to_string())))
            }
            Err(e)
                if matches!(
                    e.kind(),
                    ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand | ErrorKind::MissingSubcommand
                ) =>
            {
                Err(Failure::input("no command is given").help(
                    "name one: `greybox diagnose`, `identify`, `calibrate`, `simulate`, `check`, `compare`, `control`, \
                     `export`, `new`, `mechanisms` or `demo`; \
                     `greybox --help` explains them",
                ))
            }
            Err(e) => Err(failure::usage(&e.render().to_string())),
        }
    }
}
