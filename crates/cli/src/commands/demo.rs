//! `greybox demo`: the whole story on an embedded recording.

use std::path::PathBuf;

use clap::Args;

use crate::answer::Answer;
use crate::failure::Failure;

/// Diagnose an embedded recording: the whole story in under a minute
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox demo
  greybox demo --out demo")]
pub(crate) struct Arguments {
    /// Folder for the report and the improved model; nothing is written without it
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let _ = &arguments.out;
    Err(Failure::internal("the diagnosis engine is not part of this build"))
}
