//! The Python side: one process per row that works when told to.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, bail};
use serde::Deserialize;

use super::case::{Answer, Case};

/// A row's function of `dev/bench/peers.py`, warmed up and waiting.
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
        command.arg(root.join("dev").join("bench").join("peers.py")).arg(function).arg(folder);
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
            bail!("the peer `{}` of dev/bench/peers.py ended without an answer", self.function);
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
