//! The command line.

use std::ffi::OsString;

use clap::error::ErrorKind;
use clap::{Parser, Subcommand};

use crate::answer::Answer;
use crate::commands::{calibrate, check, demo, diagnose, simulate};
use crate::failure::Failure;

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
  greybox simulate result/improved.toml run3.csv --out simulated.csv

Exit status: 0 finished, whatever the verdict; 2 bad usage or bad input; 1 internal failure."
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,

    /// Print one JSON document for machines in place of plain language
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    Diagnose(diagnose::Arguments),
    Calibrate(calibrate::Arguments),
    Simulate(simulate::Arguments),
    Check(check::Arguments),
    Demo(demo::Arguments),
}

impl Command {
    pub(crate) fn run(&self) -> Result<Answer, Failure> {
        match self {
            Command::Diagnose(arguments) => diagnose::run(arguments),
            Command::Calibrate(arguments) => calibrate::run(arguments),
            Command::Simulate(arguments) => simulate::run(arguments),
            Command::Check(arguments) => check::run(arguments),
            Command::Demo(arguments) => demo::run(arguments),
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
            Err(e) if e.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
                Err(Failure::input("no command is given").mend(
                    "name one: `greybox diagnose`, `calibrate`, `simulate`, `check` or `demo`; \
                     `greybox --help` explains them",
                ))
            }
            Err(e) => Err(Failure::usage(&e.render().to_string())),
        }
    }
}
