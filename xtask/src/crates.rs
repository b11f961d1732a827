//! `cargo xtask crates`: every crate packaged as it would be published, and built from its package.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result};

use greybox_dev::{Ending, process};

/// What to leave out.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Package only; do not build the packages
    #[arg(long)]
    no_verify: bool,
    /// Package what is not committed too
    #[arg(long)]
    allow_dirty: bool,
}

/// Publishes every crate in the order of its dependencies, without the upload: what a crate of ours needs comes from the
/// package made before it. Needs the registry's index.
pub(crate) fn run(root: &Path, arguments: &Arguments) -> Result<Ending> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command.args(["publish", "--dry-run", "--workspace", "--locked", "--target-dir"]);
    command.arg(process::target(root)).current_dir(root);
    if arguments.no_verify {
        command.arg("--no-verify");
    }
    if arguments.allow_dirty {
        command.arg("--allow-dirty");
    }
    let status = command.status().context("cargo could not be started")?;
    Ok(if status.success() { Ending::Done } else { Ending::Missed })
}
