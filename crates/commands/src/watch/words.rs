//! What a watch says: one line for machines, or words.

use std::fmt::Write as _;

use greybox_recording::listed;
use greybox_report::contract::Interval;
use greybox_report::format;
use greybox_watch::{Change, Event, Irregular, Parameter, Subject};
use serde_json::{Value, json};

use super::{Clock, Output};

/// The keys of events that are times.
const TIMES: [&str; 3] = ["t", "since", "from"];

impl Output {
    /// One line for machines.
    pub fn to_json(&self) -> Value {
        match self {
            Output::Event { event, clock } => {
                let mut value = serde_json::to_value(event).unwrap_or_default();
                for key in TIMES {
                    if let Some(time) = value.get_mut(key)
                        && let Some(t) = time.as_f64()
                    {
                        *time = clock.value(t);
                    }
                }
                value
            }
            Output::Unreadable { line, topic: None, message } => {
                json!({ "event": "unreadable", "line": line, "message": message })
            }
            Output::Unreadable { line, topic, message } => {
                json!({ "event": "unreadable", "topic": topic, "number": line, "message": message })
            }
        }
    }

    /// In plain language, with its line ends; estimates that come with every block are for machines alone.
    pub fn in_words(&self) -> Option<String> {
        match self {
            Output::Unreadable { message, .. } => Some(format!("passed over: {message}\n")),
            Output::Event { event, clock } => in_words(event, *clock),
        }
    }
}

/// A value with its 95 % interval and its unit.
fn value(value: f64, std: f64, unit: Option<&str>) -> String {
    let half = 1.96 * std;
    let text = format::with_interval(value, Some(Interval::new(value - half, value + half)));
    unit.map_or_else(|| text.clone(), |unit| format::with_unit(&text, unit))
}

fn parameter(p: &Parameter) -> String {
    format!("{} = {}", p.name, value(p.value, p.std, p.unit.as_deref()))
}

fn in_words(event: &Event, clock: Clock) -> Option<String> {
    let at = |t| clock.words(t);
    let mut text = String::new();
    match event {
        Event::Learned(l) => {
            let _ = writeln!(
                text,
                "{}: learned what is usual, at {} samples a second",
                at(l.t),
                format::number(l.rate)
            );
            l.parameters.iter().for_each(|p| {
                let not_told =
                    if l.undetermined.contains(&p.name) { ", not told by these seconds" } else { "" };
                let _ = writeln!(text, "    {}{not_told}", parameter(p));
            });
            let _ = writeln!(
                text,
                "    {} charts, a value each {} s; false alarms: {} a day",
                l.charts,
                format::number(l.block),
                format::number(l.alarms_per_day)
            );
        }
        Event::Changed(change) => {
            let _ = writeln!(text, "{}: {}", at(change.t), changed(change, &at(change.since)));
        }
        Event::Settled(change) => {
            let (name, since) = (subject(&change.subject), at(change.since));
            let said = if change.or.is_empty() { "it was" } else { "most likely it was" };
            let _ = writeln!(
                text,
                "{}: {said} {name}, since {since}: {}{}; usual from now on",
                at(change.t),
                extent(change),
                others(change)
            );
        }
        Event::Outside(outside) => {
            let _ = writeln!(
                text,
                "{}: outside what was learned: these samples say more of {} than all that was learned; learning anew",
                at(outside.t),
                listed(outside.parameters.clone())
            );
        }
        Event::Irregular(irregular) => {
            let _ = writeln!(text, "samples: {}", irregularities(irregular));
        }
        Event::Restarted(clock) => {
            let _ = writeln!(
                text,
                "{}: the clock jumped here from {}; the state begins anew",
                at(clock.t),
                at(clock.from)
            );
        }
        _ => return None,
    }
    Some(text)
}

fn subject(subject: &Subject) -> String {
    match subject {
        Subject::Parameter(name) => name.clone(),
        Subject::Force(name) => format!("a constant force on {name}"),
        Subject::Offset(name) => format!("an offset of sensor {name}"),
        Subject::Noise(name) => format!("the scatter of sensor {name}"),
    }
}

/// How far something has changed.
fn extent(change: &Change) -> String {
    let relative = change.relative().map_or_else(String::new, |r| format!(" ({:+.1} %)", 100.0 * r));
    match change.subject {
        Subject::Noise(_) => format!("{} times what it was", format::number(change.now)),
        _ => format!(
            "{} to {}{relative}",
            format::significant(change.before, 4),
            value(change.now, change.std, change.unit.as_deref())
        ),
    }
}

/// The sentence of an alarm.
fn changed(change: &Change, since: &str) -> String {
    let (name, extent) = (subject(&change.subject), extent(change));
    if change.or.is_empty() {
        return format!("{name} has changed since {since}: {extent}");
    }
    format!("something has changed since {since}, most likely {name}: {extent}{}", others(change))
}

/// What the samples do not tell from the subject.
fn others(change: &Change) -> String {
    let others: Vec<String> = change.or.iter().map(subject).collect();
    if others.is_empty() { String::new() } else { format!("; or {}", others.join(", ")) }
}

fn irregularities(i: &Irregular) -> String {
    let counts = [
        (i.late, "late"),
        (i.repeated, "repeated"),
        (i.missing, "missing"),
        (i.not_measured, "values not measured"),
        (i.outliers, "outliers not used"),
        (i.input_held, "inputs held"),
        (i.diverged, "times the simulation diverged"),
    ];
    let said: Vec<String> =
        counts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}")).collect();
    said.join(", ")
}
