//! The command line.

use std::ffi::OsString;

use clap::error::ErrorKind;
use clap::{CommandFactory, Parser, Subcommand};

use crate::answer::{Answer, OutputFormat};
use crate::commands::{
    calibrate, check, compare, control, demo, diagnose, export, identify, mechanisms, new, shell, simulate,
    watch,
};
use crate::failure::{self, Failure};

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
  mosquitto_sub -t drive/samples | greybox watch result/improved.toml
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

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    Diagnose(diagnose::Arguments),
    Identify(identify::Arguments),
    Calibrate(calibrate::Arguments),
    Simulate(simulate::Arguments),
    Check(check::Arguments),
    Compare(compare::Arguments),
    Control(control::Arguments),
    Watch(watch::Arguments),
    Export(export::Arguments),
    New(new::Arguments),
    Mechanisms(mechanisms::Arguments),
    Demo(demo::Arguments),
    Completions(shell::Completions),
    Man(shell::Man),
}

impl Command {
    /// Runs it; `format` is for a command that answers while it works.
    pub(crate) fn run(&self, format: OutputFormat) -> Result<Answer, Failure> {
        match self {
            Command::Diagnose(arguments) => diagnose::run(arguments),
            Command::Identify(arguments) => identify::run(arguments),
            Command::Calibrate(arguments) => calibrate::run(arguments),
            Command::Simulate(arguments) => simulate::run(arguments),
            Command::Check(arguments) => check::run(arguments),
            Command::Compare(arguments) => compare::run(arguments),
            Command::Control(arguments) => control::run(arguments),
            Command::Watch(arguments) => watch::run(arguments, format),
            Command::Export(arguments) => export::run(arguments),
            Command::New(arguments) => new::run(arguments),
            Command::Mechanisms(arguments) => mechanisms::run(arguments),
            Command::Demo(arguments) => demo::run(arguments),
            Command::Completions(arguments) => shell::completions(arguments, Cli::command()),
            Command::Man(_) => shell::man(Cli::command()),
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
                     `watch`, `export`, `new`, `mechanisms` or `demo`; \
                     `greybox --help` explains them",
                ))
            }
            Err(e) => Err(failure::usage(&e.render().to_string())),
        }
    }
}
