//! What a watch says: one line for machines, or words.

use std::fmt::Write as _;

use greybox_report::contract::Interval;
use greybox_report::format;
use greybox_watch::{Change, Event, Irregular, Parameter, Subject};
use serde_json::{Value, json};

use super::Output;

impl Output {
    /// One line for machines.
    pub fn to_json(&self) -> Value {
        match self {
            Output::Event(event) => serde_json::to_value(event).unwrap_or_default(),
            Output::Unreadable { line, message } => {
                json!({ "event": "unreadable", "line": line, "message": message })
            }
        }
    }

    /// In plain language, with its line ends; estimates that come with every block are for machines alone.
    pub fn in_words(&self) -> Option<String> {
        match self {
            Output::Unreadable { message, .. } => Some(format!("passed over: {message}\n")),
            Output::Event(event) => in_words(event),
        }
    }
}

fn at(t: f64) -> String {
    format!("{t:.3} s")
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

fn in_words(event: &Event) -> Option<String> {
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
                let _ = writeln!(text, "    {}", parameter(p));
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
            let _ = writeln!(text, "{}: {}", at(change.t), changed(change));
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
fn changed(change: &Change) -> String {
    let (since, name, extent) = (at(change.since), subject(&change.subject), extent(change));
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
        (i.input_held, "inputs held"),
        (i.diverged, "times the simulation diverged"),
    ];
    let said: Vec<String> =
        counts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}")).collect();
    said.join(", ")
}
