//! The Python side: an environment from a pinned list, and one process per row that works when told to.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, bail};
use serde::Deserialize;

use super::case::{Answer, Case};

/// The interpreter of the environment in `folder` with the packages of a `requirements.txt`, those in `only` where it
/// names some. It is made (again) when they are not what it was made from.
pub(crate) fn environment(list: &Path, folder: &Path, only: &[&str]) -> Result<PathBuf> {
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

/// A row's function of `bench/peers.py`, warmed up and waiting.
pub(crate) struct Worker {
    function: String,
    child: Child,
    orders: Option<ChildStdin>,
    reports: BufReader<ChildStdout>,
    /// What its first call came to.
    pub(crate) answer: Answer,
    /// CPU seconds of the first call, compilation included.
    pub(crate) first: f64,
}

#[derive(Deserialize)]
struct First {
    answer: Answer,
    seconds: f64,
}

#[derive(Deserialize)]
struct Measured {
    calls: f64,
    seconds: f64,
}

impl Worker {
    /// Starts the function on the data of a case, written to `folder`.
    pub(crate) fn start(
        root: &Path,
        python: &Path,
        folder: &Path,
        function: &str,
        case: &Case,
    ) -> Result<Self> {
        fs::create_dir_all(folder).with_context(|| format!("{} cannot be made", folder.display()))?;
        let write = |name: String, bytes: Vec<u8>| {
            let path = folder.join(name);
            fs::write(&path, bytes).with_context(|| format!("{} cannot be written", path.display()))
        };
        for (name, values) in &case.data {
            write(format!("{name}.f64"), values.iter().flat_map(|v| v.to_le_bytes()).collect())?;
        }
        write("settings.json".to_owned(), serde_json::to_vec(&case.settings)?)?;
        let mut command = Command::new(python);
        command.arg(root.join("bench").join("peers.py")).arg(function).arg(folder);
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("{command:?} could not be started"))?;
        let orders = child.stdin.take();
        let reports = BufReader::new(child.stdout.take().context("the peer has no output")?);
        let mut worker =
            Self { function: function.to_owned(), child, orders, reports, answer: Answer::new(), first: 0.0 };
        let first: First = worker.read()?;
        (worker.answer, worker.first) = (first.answer, first.seconds);
        Ok(worker)
    }

    /// CPU seconds of one call, over calls for `seconds` and at least one.
    pub(crate) fn measure(&mut self, seconds: f64) -> Result<f64> {
        let orders = self.orders.as_mut().context("the peer takes no orders")?;
        writeln!(orders, "{seconds}").and_then(|()| orders.flush()).context("the peer takes no orders")?;
        let measured: Measured = self.read()?;
        Ok(measured.seconds / measured.calls)
    }

    fn read<T: for<'de> Deserialize<'de>>(&mut self) -> Result<T> {
        let mut line = String::new();
        if self.reports.read_line(&mut line)? == 0 {
            bail!("the peer `{}` of bench/peers.py ended without an answer", self.function);
        }
        serde_json::from_str(&line).with_context(|| format!("the peer `{}` answers {line:?}", self.function))
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        // The end of its input ends it.
        drop(self.orders.take());
        if self.child.wait().is_err() {
            eprintln!("the peer `{}` could not be waited for", self.function);
        }
    }
}
