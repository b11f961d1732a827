//! `greybox watch`: a machine while it runs.

use std::fs;
use std::io::{self, BufRead, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use greybox_commands::watch::{Output, Session};
use greybox_watch::{Options, Saved};

use crate::answer::{Answer, OutputFormat};
use crate::channels::Names;
use crate::failure::Failure;
use crate::loading;

/// How often the state is saved.
const SAVED_EVERY: Duration = Duration::from_secs(1);

/// Watch a machine while it runs: estimates as samples come, and what has changed
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  mosquitto_sub -t drive/samples | greybox watch drive.toml
  greybox watch drive.toml --learn 120 --alarms-per-day 0.1 --state drive.state < samples.csv
  tail -f log.csv | greybox watch drive.toml --map \"theta=sensor_3 [deg]\" --json

Samples come on standard input, one a line: CSV with a header (first column `t` in seconds), JSON objects such as
{\"t\": 0.01, \"angle\": 1.25}, or the Influx line protocol. The first seconds tell what is usual; while they last, nothing is watched. With --json,
every event and, after every block of samples, the estimates with their covariance are JSON objects, one a line.")]
pub(crate) struct Arguments {
    /// Model of the machine (TOML): calibrated, or improved by `diagnose`
    #[arg(value_name = "MODEL.toml")]
    model: PathBuf,

    /// Seconds at the beginning in which it is learned what is usual
    #[arg(long, value_name = "SECONDS", default_value_t = Options::default().learn)]
    learn: f64,

    /// Seconds that the estimates remember
    #[arg(long, value_name = "SECONDS", default_value_t = Options::default().memory)]
    memory: f64,

    /// False alarms a day, of all that is watched together
    #[arg(long, value_name = "RATE", default_value_t = Options::default().alarms_per_day)]
    alarms_per_day: f64,

    /// File that keeps what was learned, saved every second; where it exists, the watch goes on from it
    #[arg(long, value_name = "FILE")]
    state: Option<PathBuf>,

    #[command(flatten)]
    names: Names,
}

pub(crate) fn run(arguments: &Arguments, format: OutputFormat) -> Result<Answer, Failure> {
    let model = loading::model(&arguments.model)?;
    let options = Options {
        learn: arguments.learn,
        memory: arguments.memory,
        alarms_per_day: arguments.alarms_per_day,
    };
    let state = arguments.state.as_deref();
    let saved = state.map(read).transpose()?.flatten();
    let mut session = Session::new(model, &arguments.names.map, options, saved)?;
    let mut input = io::stdin().lock();
    let mut line = Vec::new();
    let mut saved_at = now();
    loop {
        line.clear();
        let read = input
            .read_until(b'\n', &mut line)
            .map_err(|e| Failure::input(format!("standard input cannot be read: {e}")))?;
        if read == 0 {
            break;
        }
        for output in session.line(&String::from_utf8_lossy(&line))? {
            if !print(&output, format)? {
                return Ok(Answer::words(String::new()));
            }
        }
        if let Some(path) = state
            && saved_at.elapsed() >= SAVED_EVERY
        {
            save(path, &session)?;
            saved_at = now();
        }
    }
    if let Some(path) = state {
        save(path, &session)?;
    }
    session.end()?;
    Ok(Answer::words(String::new()))
}

/// The clock of the saves, which is in no result.
#[allow(clippy::disallowed_methods, reason = "when the state is saved")]
fn now() -> Instant {
    Instant::now()
}

/// Prints one line of the answer; `false` where nobody reads any more.
fn print(output: &Output, format: OutputFormat) -> Result<bool, Failure> {
    let text = match format {
        OutputFormat::Json => Some(format!("{}\n", output.to_json())),
        OutputFormat::Text => output.in_words(),
    };
    let Some(text) = text else { return Ok(true) };
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Ok(()) => Ok(true),
        Err(e) if e.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(e) => Err(Failure::input(format!("standard output cannot be written: {e}"))),
    }
}

/// The state in a file, where there is one.
fn read(path: &Path) -> Result<Option<Saved>, Failure> {
    if !path.exists() {
        return Ok(None);
    }
    let text = loading::text(path)?;
    serde_json::from_str(&text).map(Some).map_err(|e| {
        Failure::file(path, format!("this is no state of a watch: {e}"))
            .help("delete the file to learn anew, or name another one")
    })
}

/// Saves the state whole or not at all.
fn save(path: &Path, session: &Session) -> Result<(), Failure> {
    let Some(saved) = session.saved() else { return Ok(()) };
    let refused = |e: io::Error| {
        Failure::file(path, format!("the state cannot be saved: {e}"))
            .help("name another file after `--state`")
    };
    let text = serde_json::to_string(saved).map_err(|e| Failure::internal(format!("the state: {e}")))?;
    let mut beside = path.as_os_str().to_owned();
    beside.push(format!(".{}.tmp", std::process::id()));
    fs::write(&beside, text).and_then(|()| fs::rename(&beside, path)).map_err(|e| {
        // (The temporary file may not exist; the first error is the one to report.)
        let _ = fs::remove_file(&beside);
        refused(e)
    })
}
