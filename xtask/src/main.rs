//! Developer commands: `cargo xtask prove | reproduce | bench | docs | ci`.

// This is a command that measures: its answers go to standard output, its complaints to standard error.
#![allow(clippy::disallowed_methods, clippy::print_stdout, clippy::print_stderr)]

#[cfg(test)]
mod circles;
#[cfg(test)]
mod corpus;
mod crates;
mod demo;
mod docs;
mod package;
#[cfg(test)]
mod supply;
#[cfg(test)]
mod tidy;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::{Parser, Subcommand};
use greybox_dev::{Ending, process, readme, root};
use {greybox_bench as bench, greybox_prove as prove, greybox_reproduce as reproduce};

#[derive(Debug, Parser)]
#[command(name = "cargo xtask", about = "Developer commands of greybox", disable_help_subcommand = true)]
struct Arguments {
    #[command(subcommand)]
    command: Task,
}

#[derive(Debug, Subcommand)]
enum Task {
    /// Measure greybox against its goals on real recordings
    Prove(prove::Arguments),
    /// Make the tables and figures of the thesis again, beside its numbers
    Reproduce(reproduce::Arguments),
    /// Measure the hot paths, beside the tools that people use today
    Bench(bench::Arguments),
    /// Write the generated pages of the book
    Docs {
        /// Change nothing; exit 1 when a page is stale
        #[arg(long)]
        check: bool,
    },
    /// Make a Python with NumPy, SciPy and a reader of Modelica, as dev/bench/requirements.txt pins them, and print its path for $GREYBOX_PYTHON
    Python,
    /// Build the wheel of the Python package, install it in an environment of its own, and run its tests and notebooks
    PythonPackage,
    /// Package every crate as it would be published, in the order of their dependencies, and build it from its package
    Crates(crates::Arguments),
    /// Check what `greybox demo MACHINE --out OUT` answered and left: the README shows it
    Demo {
        /// The machine
        machine: demo::Machine,
        /// What the command printed
        answer: PathBuf,
        /// The folder that it wrote
        out: PathBuf,
        /// Draw the figure of its simulations (docs/src/demo-*.svg)
        #[arg(long)]
        write_docs: bool,
    },
    /// Run what the continuous integration runs (.ci/run)
    Ci,
    /// Print the commands of the README's block behind `<!-- MARKER -->`
    ReadmeCommand {
        /// For example "test command"
        marker: String,
    },
}

fn main() -> ExitCode {
    let ending = match Arguments::parse().command {
        Task::Prove(arguments) => prove::run(&root(), &arguments),
        Task::Reproduce(arguments) => reproduce::run(&root(), &arguments),
        Task::Bench(arguments) => bench::run(&root(), &arguments),
        Task::Docs { check } => docs::run(&root(), check),
        Task::Python => python(&root()),
        Task::Crates(arguments) => crates::run(&root(), &arguments),
        Task::PythonPackage => package::run(&root()),
        Task::Demo { machine, answer, out, write_docs } => {
            demo::check(&root(), machine, &answer, &out, write_docs)
        }
        Task::Ci => ci(&root()),
        Task::ReadmeCommand { marker } => print_command(&root(), &marker),
    };
    match ending {
        Ok(Ending::Done) => ExitCode::SUCCESS,
        Ok(Ending::Missed) => ExitCode::from(1),
        Ok(Ending::Refused) => ExitCode::from(2),
        Err(e) => {
            eprintln!("error: {e:#}");
            ExitCode::from(2)
        }
    }
}

fn python(root: &Path) -> Result<Ending> {
    let folder = process::target(root).join("python");
    let list = root.join("dev").join("bench").join("requirements.txt");
    println!(
        "{}",
        greybox_dev::python::environment(
            &list,
            &folder,
            &["numpy", "scipy", "antlr4-python3-runtime", "casadi", "pymoca"]
        )?
        .display()
    );
    Ok(Ending::Done)
}

fn ci(root: &Path) -> Result<Ending> {
    let script = root.join(".ci").join("run");
    let status = std::process::Command::new(&script)
        .current_dir(root)
        .status()
        .with_context(|| format!("{} could not be started", script.display()))?;
    Ok(if status.success() { Ending::Done } else { Ending::Missed })
}

fn print_command(root: &Path, marker: &str) -> Result<Ending> {
    let path = root.join("README.md");
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
    print!("{}", readme::block_after(&text, marker)?);
    Ok(Ending::Done)
}
