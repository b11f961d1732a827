//! `greybox watch`: a machine while it runs.

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use clap::Args;
use greybox_commands::watch::{Session, State};
use greybox_recording::write_whole;
use greybox_watch::Options;
use serde_json::Value;
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::answer::{Answer, OutputFormat};
use crate::channels::Names;
use crate::failure::Failure;
use crate::loading;

mod address;
#[cfg(feature = "mqtt")]
mod certificate;
#[cfg(feature = "mqtt")]
mod connection;
#[cfg(feature = "mqtt")]
mod mqtt;
mod source;

use address::Source;
use source::{Certificate, Message};

/// How often the state is saved.
const SAVED_EVERY: Duration = Duration::from_secs(1);
/// How often it is looked whether that, or an end, is due while nothing comes.
const TICK: Duration = Duration::from_millis(100);
/// Lines and messages that may wait.
const WAITING: usize = 4096;

/// Watch a machine while it runs: estimates as samples come, and what has changed
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  mosquitto_sub -t drive/samples | greybox watch drive.toml
  greybox watch drive.toml --learn 120 --alarms-per-day 0.1 --state drive.state < samples.csv
  greybox watch drive.toml --from mqtt://localhost:1883/drive/samples --state drive.state
  tail -f log.csv | greybox watch drive.toml --map \"theta=sensor_3 [deg]\" --json
  ros2 topic echo --csv /joint_states | greybox watch arm.toml --columns \"t [s],t [ns],_,_,angle,_,torque\"

Samples come on standard input, one a line: CSV with a header (first column `t`, in seconds or a date), or without one and --columns, JSON objects such as
{\"t\": 0.01, \"angle\": 1.25}, or the Influx line protocol; or, with --from, as messages of an MQTT broker. The first seconds tell what is usual; while they last, nothing is watched. With --json,
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

    /// Broker and topic to take samples from, instead of standard input: mqtt://host:1883/topic, by TLS mqtts://user:password@host:8883/topic; may be repeated, for topics of one broker
    #[arg(long, value_name = "URL")]
    from: Vec<String>,

    /// Certificate of this client (PEM), for a broker that demands one: mqtts://
    #[arg(long, value_name = "FILE", requires = "from")]
    cert: Option<PathBuf>,

    /// Private key of that certificate (PEM, not encrypted), where it stands in a file of its own
    #[arg(long, value_name = "FILE", requires = "cert")]
    key: Option<PathBuf>,

    // (Not a doc comment: rustdoc takes a unit in brackets for a link.)
    #[arg(
        long,
        value_name = "NAMES",
        conflicts_with = "from",
        help = "Names of the columns of CSV without a header, with their units, such as \"t [s],t [ns],_,angle [deg]\": `_` is \
                not read, several columns `t` add up"
    )]
    columns: Option<String>,

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
    let mut session = Session::new(model, &arguments.names.map, options, saved.zip(state))?;
    if let Some(columns) = &arguments.columns {
        session = session.with_columns(columns)?;
    }
    let certificate = arguments.cert.as_deref();
    let certificate =
        certificate.map(|certificate| Certificate { certificate, key: arguments.key.as_deref() });
    let mut kept = Kept { path: state, changed: false, saved: now() };
    let stopped = stop_signals()?;
    let (to, messages) = mpsc::sync_channel(WAITING);
    match Source::of(&arguments.from)? {
        Some(source) => source::broker(source, certificate, to)?,
        None => source::standard_input(to),
    }
    let ended = watch(&mut session, &messages, &mut kept, (&stopped, format));
    // (Whatever ended it: the first error is the one to report.)
    let saved = kept.save(&session);
    let ended = ended.and_then(|ended| saved.map(|()| ended))?;
    match ended {
        Ended::Input => session.end()?,
        Ended::Output => {}
        Ended::Signal(signal) => {
            // Whoever sent it sees that it was obeyed.
            let _ = signal_hook::low_level::emulate_default_handler(signal);
        }
    }
    Ok(Answer::words(String::new()))
}

/// Why a watch ended.
enum Ended {
    /// Nothing comes any more.
    Input,
    /// Nobody reads any more.
    Output,
    /// It was told to.
    Signal(i32),
}

/// Takes what comes, and saves the state every second also while nothing does.
fn watch(
    session: &mut Session,
    messages: &Receiver<Message>,
    kept: &mut Kept<'_>,
    (stopped, format): (&AtomicUsize, OutputFormat),
) -> Result<Ended, Failure> {
    loop {
        let signal = stopped.load(Ordering::Relaxed);
        if signal != 0 {
            return Ok(Ended::Signal(signal as i32));
        }
        let outputs = match messages.recv_timeout(TICK) {
            Ok(Message::Line(line)) => session.line(&String::from_utf8_lossy(&line))?,
            Ok(Message::Payload { topic, payload }) => {
                session.message(&topic, &String::from_utf8_lossy(&payload))?
            }
            Ok(Message::Connection(connection)) => {
                if !print(|| connection.to_json(), || Some(connection.in_words()), format)? {
                    return Ok(Ended::Output);
                }
                continue;
            }
            Ok(Message::Failed(failure)) => return Err(failure),
            Err(RecvTimeoutError::Disconnected) => return Ok(Ended::Input),
            Err(RecvTimeoutError::Timeout) => {
                kept.tick(session)?;
                continue;
            }
        };
        for output in outputs {
            if !print(|| output.to_json(), || output.in_words(), format)? {
                return Ok(Ended::Output);
            }
        }
        kept.changed = true;
        kept.tick(session)?;
    }
}

/// The signal that asked for an end; nought before.
fn stop_signals() -> Result<Arc<AtomicUsize>, Failure> {
    let stopped = Arc::new(AtomicUsize::new(0));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register_usize(signal, Arc::clone(&stopped), signal as usize)
            .map_err(|e| Failure::internal(format!("signals cannot be waited for: {e}")))?;
    }
    Ok(stopped)
}

/// The clock of saves and pauses, which is in no result.
#[allow(clippy::disallowed_methods, reason = "when the state is saved, when a broker is asked")]
fn now() -> Instant {
    Instant::now()
}

/// Prints one line of the answer; `false` where nobody reads any more.
fn print(
    json: impl FnOnce() -> Value,
    words: impl FnOnce() -> Option<String>,
    format: OutputFormat,
) -> Result<bool, Failure> {
    let text = match format {
        OutputFormat::Json => Some(format!("{}\n", json())),
        OutputFormat::Text => words(),
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
fn read(path: &Path) -> Result<Option<State>, Failure> {
    if !path.exists() {
        return Ok(None);
    }
    let text = loading::text(path)?;
    serde_json::from_str(&text).map(Some).map_err(|e| {
        Failure::file(path, format!("this is no state of a watch: {e}"))
            .help("delete the file to learn anew, or name another one")
    })
}

/// The file that keeps the state.
struct Kept<'a> {
    path: Option<&'a Path>,
    /// Whether anything came since it was saved.
    changed: bool,
    saved: Instant,
}

impl Kept<'_> {
    /// Saves the state where it is time to.
    fn tick(&mut self, session: &Session) -> Result<(), Failure> {
        match self.changed && self.saved.elapsed() >= SAVED_EVERY {
            true => self.save(session),
            false => Ok(()),
        }
    }

    /// Saves the state whole or not at all, where it has changed.
    fn save(&mut self, session: &Session) -> Result<(), Failure> {
        let (Some(path), Some(state), true) = (self.path, session.state(), self.changed) else {
            return Ok(());
        };
        let text = serde_json::to_string(&state).map_err(|e| Failure::internal(format!("the state: {e}")))?;
        write_whole(path, text).map_err(|e| {
            Failure::file(path, format!("the state cannot be saved: {e}"))
                .help("name another file after `--state`")
        })?;
        (self.changed, self.saved) = (false, now());
        Ok(())
    }
}
