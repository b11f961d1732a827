//! Reading MCAP logs of robots (feature `mcap`).
//!
//! Every topic has a clock of its own; every scalar number and truth value of its messages is a series:
//!
//! | in the log | channels |
//! |---|---|
//! | field `data` of the topic `/cmd` | `/cmd.data` |
//! | field in a structure | `/odom.twist.twist.linear.x` |
//! | array beside a list of as many names (`name`, `names`, `…_names`) | `/joint_states.position[elbow]` |
//! | another array | `/cmd.data[0]`, `/cmd.data[1]`, … |
//! | duration | in s |
//!
//! Read are messages of ROS 2 (CDR, defined in `ros2msg`), of ROS 1 (`ros1msg`), and JSON, in chunks that are packed with
//! Zstandard, LZ4 or not at all. Left out, and told in the warnings of the recording, are bytes and arrays of more than 64
//! values (images, scans), instants, and topics in other encodings.
//!
//! The times of a topic are the stamps of its headers where all are set, else those at which its messages were logged. A
//! signal with stamps was sampled at them; one without keeps its value until the next message, as do truth values.
//! Nanoseconds are whole numbers until the first time of the log is taken off: a double since 1970 has no room for them.
//! Units are those that the type of a message fixes (REP 103). How the clocks become one grid: [`parse_mcap`].

mod cdr;
mod container;
mod fields;
mod json;
mod schema;
mod topic;
mod units;

use crate::clocks::{self, Clock, Series};
use crate::error::{Place, RecordingError};
use crate::file::{ROOM, guarded};
use crate::finding::{Finding, Severity, listed};
use crate::recording::Recording;
use crate::selection::Selection;
use ::mcap::McapError;
use container::{Content, Fault};
use topic::Topic;

/// Reads the selected channels of a recording called `name` from the bytes of an MCAP log.
///
/// The clock of the topic with the most messages is the grid's. What has the same stamps is copied; the samples of others
/// are carried to the nearest instants of the grid, and what lies between them is missing. Only what all clocks cover
/// counts. The warnings of the recording tell all of that.
///
/// # Errors
/// [`RecordingError::Damaged`], [`RecordingError::Format`] or [`RecordingError::TooLarge`] where the bytes cannot be read;
/// [`RecordingError::NoSeries`] or [`RecordingError::NoOverlap`] where they make no recording; else as
/// [`Recording::from_columns`].
///
/// ```
/// use greybox_recording::{Selection, parse_mcap};
/// let error = parse_mcap(b"t,u\n0,1\n", "run1.mcap", &Selection::default()).unwrap_err();
/// assert!(error.to_string().starts_with("run1.mcap: the file is damaged"));
/// ```
pub fn parse_mcap(bytes: &[u8], name: &str, selection: &Selection) -> Result<Recording, RecordingError> {
    parse(bytes, name, name, selection)
}

pub(crate) fn parse(
    bytes: &[u8],
    label: &str,
    name: &str,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    guarded(label, || read(bytes, label, name, selection))
}

fn read(bytes: &[u8], label: &str, name: &str, selection: &Selection) -> Result<Recording, RecordingError> {
    let content = |wanted: &dyn Fn(&str) -> bool| {
        container::content(bytes, wanted).map_err(|fault| refused(fault, Place::file(label)))
    };
    // The topics that are named may be all that is needed.
    if selection.names().next().is_some() {
        let of = |topic: &str, name: &str| {
            let behind = name.strip_prefix(topic);
            behind.is_some_and(|behind| behind.is_empty() || behind.starts_with(['.', '[']))
        };
        let found = content(&|topic| selection.names().any(|name| of(topic, name)))?;
        let available: Vec<&str> =
            found.topics.iter().flat_map(|t| &t.columns).map(|(column, _)| column.name.as_str()).collect();
        if let Some(names) = selection.among(&available) {
            return recording(found, &|name| names.contains(&name), label, name);
        }
    }
    recording(content(&|_| true)?, &|_| true, label, name)
}

/// The recording of those channels of the topics that are `wanted`.
fn recording(
    content: Content,
    wanted: &dyn Fn(&str) -> bool,
    label: &str,
    name: &str,
) -> Result<Recording, RecordingError> {
    let Content { topics, others } = content;
    let mut left_out: Vec<String> = others.iter().map(|(topic, why)| format!("`{topic}` ({why})")).collect();
    let mut notes = Vec::new();
    let mut kept = Vec::new();
    for mut topic in topics {
        if let Some(why) = &topic.fault {
            left_out.push(format!("`{}` ({why})", topic.name));
            continue;
        }
        left_out.extend(topic.left_out.iter().map(|(field, why)| format!("`{field}` ({why})")));
        topic.columns.retain(|(column, _)| wanted(&column.name));
        if !topic.columns.is_empty() {
            kept.push(topic);
        }
    }
    if kept.is_empty() {
        let found = if left_out.is_empty() { "nothing".to_owned() } else { listed(left_out) };
        return Err(RecordingError::NoSeries { place: Place::file(label), found });
    }
    if !left_out.is_empty() {
        let message = format!("Left out of the file, being no series of numbers: {}.", listed(left_out));
        notes.push(Finding::new(Severity::Info, "left_out", message));
    }
    let logged = kept.iter().flat_map(|topic| &topic.logged);
    let span = (logged.clone().min().copied().unwrap_or(0), logged.max().copied().unwrap_or(0));
    let times: Vec<(Vec<i64>, bool)> = kept.iter().map(|topic| times(topic, span)).collect();
    notes.extend(stamps(&kept, &times));
    let first = times.iter().flat_map(|(times, _)| times).min().copied().unwrap_or(0);
    let clocks =
        kept.into_iter().zip(times).map(|(topic, (times, stamped))| clock(topic, &times, stamped, first));
    clocks::recording(label, name, clocks.collect(), notes)
}

/// The times of a topic, ns, and whether they are stamps: those of another time than the log's, which was written in
/// `span`, are not comparable with the times of other topics.
fn times(topic: &Topic, span: (i64, i64)) -> (Vec<i64>, bool) {
    let stamps = topic.stamps().filter(|stamps| {
        let first = stamps.iter().min().is_some_and(|&first| first <= span.1);
        first && stamps.iter().max().is_some_and(|&last| last >= span.0)
    });
    match stamps {
        Some(stamps) => (stamps.to_vec(), true),
        None => (topic.logged.clone(), false),
    }
}

/// Which times count, in words.
fn stamps(topics: &[Topic], times: &[(Vec<i64>, bool)]) -> Option<Finding> {
    let named = |stamped: bool| {
        let these = topics.iter().zip(times).filter(|(_, (_, s))| *s == stamped);
        listed(these.map(|(topic, _)| format!("`{}`", topic.name)).collect())
    };
    let message = match (named(true), named(false)) {
        (stamped, logged) if logged.is_empty() => {
            format!("The times are the stamps in the headers of {stamped}.")
        }
        (stamped, logged) if stamped.is_empty() => {
            format!(
                "The times are those at which {logged} were logged: their messages have no stamps that are set."
            )
        }
        (stamped, logged) => format!(
            "The times are the stamps in the headers of {stamped}, and those at which {logged} were logged, whose messages \
             have no stamps that are set."
        ),
    };
    Some(Finding::new(Severity::Info, "clocks", message))
}

fn clock(topic: Topic, times: &[i64], stamped: bool, first: i64) -> Clock {
    let series = topic.columns.into_iter().map(|(column, mut values)| {
        values.resize(times.len(), f64::NAN);
        let unit = column.unit.map(str::to_owned);
        Series { name: column.name, unit, held: column.held || !stamped, values }
    });
    Clock {
        series: series.collect(),
        name: topic.name,
        resolution: 0.0,
        time: times.iter().map(|time| time.saturating_sub(first) as f64 / 1e9).collect(),
    }
}

fn refused(fault: Fault, place: Place) -> RecordingError {
    match fault {
        Fault::TooLarge { topic } => {
            RecordingError::TooLarge { place, variable: Some(topic), limit_gib: ROOM >> 30 }
        }
        Fault::Library(McapError::UnsupportedCompression(found)) => RecordingError::Format {
            place,
            found: format!("its chunks are packed with `{found}`"),
            help: "pack it with Zstandard or LZ4: `mcap compress run.mcap -o packed.mcap`",
        },
        Fault::Library(McapError::UnexpectedEof) => RecordingError::Damaged {
            place,
            variable: None,
            found: "it ends too early (`mcap recover` keeps what is whole)".to_owned(),
        },
        Fault::Library(error) => RecordingError::Damaged { place, variable: None, found: error.to_string() },
    }
}
