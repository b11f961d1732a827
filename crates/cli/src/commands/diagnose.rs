//! `greybox diagnose`: what physics does the model leave out?

use std::path::PathBuf;

use clap::Args;
use greybox_calibrate::Data;

use crate::answer::Answer;
use crate::failure::Failure;
use crate::loading;
use crate::output::OutputFolder;

/// Find what physics a model leaves out: what, where, how sure, and a model that fits
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox diagnose link.toml run1.csv run2.csv --holdout run3.csv --out result

DIR receives report.json, report.html (self-contained, with plots) and improved.toml. With no --holdout, the
last fifth of each recording is held out. The same seed and inputs give the same results.")]
pub(crate) struct Arguments {
    /// Nominal model (TOML)
    #[arg(value_name = "MODEL.toml")]
    model: PathBuf,

    /// Recordings to choose and fit with (CSV)
    #[arg(value_name = "TRAIN.csv", required = true)]
    train: Vec<PathBuf>,

    /// Recordings that only judge the result
    #[arg(long, value_name = "TEST.csv", num_args = 1..)]
    holdout: Vec<PathBuf>,

    /// Folder for the results; made where it is missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Seed of every random choice
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let loaded = loading::model(&arguments.model)?;
    let (train, holdout) = loading::train_and_holdout(&arguments.train, &arguments.holdout)?;
    Data::new(&loaded.model, &train)?;
    Data::new(&loaded.model, &holdout)?;
    let _out = OutputFolder::prepare(&arguments.out)?;
    let _ = arguments.seed;
    Err(Failure::internal("the diagnosis engine is not part of this build"))
}
