//! An environment of Python from a pinned list.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};

/// The interpreter of the environment in `folder` with the packages of a `requirements.txt`, those in `only` where it
/// names some. It is made (again) when they are not what it was made from.
pub fn environment(list: &Path, folder: &Path, only: &[&str]) -> Result<PathBuf> {
    let pinned = fs::read_to_string(list).with_context(|| format!("{} cannot be read", list.display()))?;
    let named =
        |line: &&str| only.is_empty() || line.split("==").next().is_some_and(|name| only.contains(&name));
    let packages: Vec<&str> = pinned.lines().filter(named).collect();
    let wanted = packages.join("\n");
    let made_from = folder.join("made-from.txt");
    let python = match cfg!(windows) {
        true => folder.join("Scripts").join("python.exe"),
        false => folder.join("bin").join("python"),
    };
    if python.exists() && fs::read_to_string(&made_from).is_ok_and(|found| found == wanted) {
        return Ok(python);
    }
    eprintln!("making a Python environment in {}", folder.display());
    let system = if cfg!(windows) { "python" } else { "python3" };
    succeed(Command::new(system).args(["-m", "venv", "--clear"]).arg(folder))?;
    succeed(Command::new(&python).args(["-m", "pip", "install", "--quiet", "--no-deps"]).args(&packages))?;
    fs::write(&made_from, wanted).with_context(|| format!("{} cannot be written", made_from.display()))?;
    Ok(python)
}

fn succeed(command: &mut Command) -> Result<()> {
    let text = format!("{command:?}");
    // Standard output is for the answer of the task.
    let command = command.stdin(Stdio::null()).stdout(Stdio::null());
    let status = command.status().with_context(|| format!("{text} could not be started"))?;
    if !status.success() {
        bail!("{text} failed ({status})");
    }
    Ok(())
}
