//! `cargo xtask python-package`: the wheel of the Python package, built, installed and tested as users have it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

use greybox_dev::{Ending, process, python};

/// Builds the wheel and tests it beside the command, in an environment that has nothing else of greybox.
pub(crate) fn run(root: &Path) -> Result<Ending> {
    let package = root.join("python");
    let target = process::target(root);
    let command = process::build(root)?;
    let list = package.join("requirements.txt");
    let interpreter = python::environment(&list, &target.join("python-package"), &[])?;

    let wheels = target.join("wheels");
    // An older wheel must not be taken for this one.
    if wheels.exists() {
        fs::remove_dir_all(&wheels).with_context(|| format!("{} cannot be cleared", wheels.display()))?;
    }
    let mut build = Command::new(&interpreter);
    build.args(["-m", "maturin", "build", "--release", "--locked", "--interpreter"]).arg(&interpreter);
    build.arg("--out").arg(&wheels).current_dir(&package).env("CARGO_TARGET_DIR", &target);
    if !passes(&mut build)? {
        bail!("the wheel does not build");
    }
    let wheel = only_file(&wheels)?;
    let bytes = fs::metadata(&wheel).with_context(|| format!("{} cannot be read", wheel.display()))?.len();
    println!("{}: {:.1} MB", wheel.display(), bytes as f64 / 1e6);

    let mut install = Command::new(&interpreter);
    install.args(["-m", "pip", "install", "--quiet", "--no-deps", "--force-reinstall"]).arg(&wheel);
    if !passes(&mut install)? {
        bail!("the wheel cannot be installed");
    }
    let mut tests = Command::new(&interpreter);
    // In a folder from which `import greybox` finds the installed package, not the sources.
    tests.args(["-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir"]).arg(&package);
    tests.arg(package.join("tests")).current_dir(&wheels).env("GREYBOX", command);
    Ok(if passes(&mut tests)? { Ending::Done } else { Ending::Missed })
}

fn passes(command: &mut Command) -> Result<bool> {
    let status = command.status().with_context(|| format!("{command:?} could not be started"))?;
    Ok(status.success())
}

fn only_file(folder: &Path) -> Result<PathBuf> {
    let entries = fs::read_dir(folder).with_context(|| format!("{} cannot be read", folder.display()))?;
    let mut files = entries.filter_map(|entry| entry.ok().map(|e| e.path()));
    match (files.next(), files.next()) {
        (Some(file), None) => Ok(file),
        _ => bail!("{} does not hold one wheel", folder.display()),
    }
}
