//! Are these recordings good enough, and do they fit the model?

use std::fmt::Write as _;
use std::path::Path;

use greybox_calibrate::Data;
use greybox_model::{Model, Unit};
use greybox_recording::{Channel, Character, Finding, Recording, Severity, character, health, listed};
use greybox_report::convert::health_finding;
use greybox_report::notes::{Note, grouped};
use greybox_report::{contract, format};
use serde::Serialize;
use serde_json::json;

use crate::failure::Failure;
use crate::plausible;

/// What is said of recordings.
#[derive(Debug)]
pub struct Checked {
    /// Those that could be checked.
    pub recordings: Vec<Health>,
    /// Why the others could not.
    pub failures: Vec<Failure>,
}

/// What is said of one recording.
#[derive(Debug, Serialize)]
pub struct Health {
    file: String,
    rows: usize,
    pieces: usize,
    dt_s: f64,
    duration_s: f64,
    channels: Vec<ChannelUse>,
    findings: Vec<Finding>,
}

/// A channel and what it feeds.
#[derive(Debug, Serialize)]
struct ChannelUse {
    name: String,
    unit: Option<String>,
    /// In plain language; `null` where the model does not use the channel, or none was given.
    feeds: Option<String>,
    /// Samples that are not missing.
    samples: usize,
    /// Samples per second, from the first to the last of them.
    rate_hz: Option<f64>,
    /// Places where the next sample comes after more than 1.5 of its usual steps.
    gaps: usize,
    /// How it moves; what is smooth may be a state, anything else that moves an input.
    character: Option<Character>,
}

/// Checks recordings, with the roles that a model gives their channels, or with `inputs` as what drives them. One that cannot
/// be read or does not fit the model stops no other, and none is kept once it is checked.
///
/// # Errors
/// Bad input: none of the recordings could be checked; the first of their errors.
pub fn check(
    recordings: impl IntoIterator<Item = Result<Recording, Failure>>,
    model: Option<&Model>,
    inputs: &[String],
) -> Result<Checked, Failure> {
    let mut checked = Checked { recordings: Vec::new(), failures: Vec::new() };
    for recording in recordings {
        match recording.and_then(|recording| health_of(&recording, model, inputs)) {
            Ok(health) => checked.recordings.push(health),
            Err(failure) => checked.failures.push(failure),
        }
    }
    match checked.failures.len() {
        0 => Ok(checked),
        _ if checked.recordings.is_empty() => Err(checked.failures.swap_remove(0)),
        _ => Ok(checked),
    }
}

fn health_of(recording: &Recording, model: Option<&Model>, inputs: &[String]) -> Result<Health, Failure> {
    known(recording, inputs)?;
    let Some(model) = model else {
        let findings = check_with_inputs(recording, inputs);
        let feeds =
            |name: &str, _: Option<&str>| inputs.iter().any(|i| i == name).then(|| "input".to_owned());
        return Ok(describe(recording, findings, feeds));
    };
    Data::new(model, std::slice::from_ref(recording))?;
    let has = |name: &str| recording.channel(name).is_some();
    let (inputs, outputs) = roles(model, recording);
    let mut findings = findings(recording, &inputs, &outputs);
    findings.extend(plausible::findings(model, recording));
    Ok(describe(recording, findings, |name, unit| feeds(model, name, unit, &has)))
}

/// What was found, in plain language: a verdict for each recording, its channels, then the findings, those that matter most
/// first. What the recordings have in common is said once.
pub fn story(checked: &Checked) -> String {
    let Checked { recordings, failures } = checked;
    let mut text = String::new();
    let alike = recordings.len() > 1 && recordings.iter().all(|health| health.is_laid_out_as(&recordings[0]));
    for health in recordings {
        let _ = writeln!(text, "{}: {}", health.file, verdict(&health.findings));
        if !alike {
            text.push_str(&table(std::slice::from_ref(health)));
        }
    }
    if !failures.is_empty() {
        let _ = writeln!(text, "{} could not be checked", plural(failures.len(), "recording"));
    }
    if alike {
        let _ = write!(text, "\nChannels of each:\n{}", table(recordings));
    }
    let found: Vec<contract::Finding> = recordings.iter().flat_map(Health::findings).collect();
    let mut notes = grouped(&found);
    notes.sort_by_key(|note| std::cmp::Reverse(note.severity));
    if recordings.len() > 1 {
        text.push_str("\nFindings:\n");
    }
    for mut note in notes {
        if let [alone] = &recordings[..] {
            // It stands above.
            let place = note.place.strip_prefix(&alone.file).unwrap_or(&note.place);
            note.place = place.trim_start_matches(", ").to_owned();
        }
        text.push_str(&in_words(&note));
    }
    text
}

/// What was found, for machines.
pub fn to_json(model: Option<&Model>, checked: &Checked) -> serde_json::Value {
    let failures: Vec<serde_json::Value> =
        checked.failures.iter().map(|failure| failure.to_json()["error"].take()).collect();
    json!({ "model": model.map(|m| &m.name), "recordings": checked.recordings, "failures": failures })
}

/// Sees that the recording has every channel named after `--inputs`.
fn known(recording: &Recording, inputs: &[String]) -> Result<(), Failure> {
    let Some(unknown) = inputs.iter().find(|name| recording.channel(name).is_none()) else {
        return Ok(());
    };
    let names: Vec<String> = recording.channels.iter().map(|c| format!("`{}`", c.name)).collect();
    let message = format!("there is no channel `{unknown}`, which `--inputs` names");
    Err(Failure::file(Path::new(&recording.name), message).help(format!("name one of {}", listed(names))))
}

/// The health of a recording, its channels in the roles that the model gives them.
pub fn check_for_model(recording: &Recording, model: &Model) -> Vec<Finding> {
    let (inputs, outputs) = roles(model, recording);
    health::check(recording, &inputs, &outputs)
}

/// The channels of a recording that a model takes as inputs, and as measurements.
fn roles<'a>(model: &'a Model, recording: &Recording) -> (Vec<&'a str>, Vec<&'a str>) {
    let inputs = model.input_columns(|name| recording.channel(name).is_some());
    let outputs = model.measurements.iter().map(|m| m.channel.as_str()).collect();
    (inputs, outputs)
}

/// The health of a recording, and whether its channels were recorded with one clock.
fn findings(recording: &Recording, inputs: &[&str], outputs: &[&str]) -> Vec<Finding> {
    let mut findings = health::check(recording, inputs, outputs);
    findings.extend(health::clock_offsets(recording, inputs, outputs));
    findings
}

fn check_with_inputs(recording: &Recording, inputs: &[String]) -> Vec<Finding> {
    let named: Vec<&str> = inputs.iter().map(String::as_str).collect();
    let others: Vec<&str> = if inputs.is_empty() {
        Vec::new()
    } else {
        recording.channels.iter().map(|c| c.name.as_str()).filter(|name| !named.contains(name)).collect()
    };
    findings(recording, &named, &others)
}

/// What the channel feeds in the model, in words.
fn feeds(model: &Model, channel: &str, header: Option<&str>, has: &dyn Fn(&str) -> bool) -> Option<String> {
    let input = model.inputs.iter().filter(|i| i.column(has) == channel);
    let measured = model.measurements.iter().filter(|m| m.channel == channel);
    let uses: Vec<String> = input
        .map(|i| match i.derivative_of() {
            Some(base) if base == channel => format!("input {} (its derivative, in {})", i.name, i.unit.text),
            _ => format!("input {} ({}, {} hold)", i.name, conversion(header, &i.unit), i.hold.name()),
        })
        .chain(measured.map(|m| format!("measurement of {} ({})", m.expr, conversion(header, &m.unit))))
        .collect();
    (!uses.is_empty()).then(|| uses.join(" and "))
}

/// How header units become the model's: `deg → rad`, or the one unit where they agree.
fn conversion(header: Option<&str>, unit: &Unit) -> String {
    match header {
        Some(header) if header != unit.text => format!("{header} → {}", unit.text),
        Some(_) => unit.text.clone(),
        None => format!("taken as {}", unit.text),
    }
}

fn describe(
    recording: &Recording,
    findings: Vec<Finding>,
    feeds: impl Fn(&str, Option<&str>) -> Option<String>,
) -> Health {
    Health {
        file: recording.name.clone(),
        rows: recording.time.len(),
        pieces: recording.pieces.len(),
        dt_s: recording.dt(),
        duration_s: recording.duration(),
        channels: recording
            .channels
            .iter()
            .map(|c| ChannelUse::of(c, &recording.time, feeds(&c.name, c.unit.as_deref())))
            .collect(),
        findings,
    }
}

impl ChannelUse {
    fn of(channel: &Channel, time: &[f64], feeds: Option<String>) -> ChannelUse {
        let there = time.iter().zip(&channel.values).filter(|(_, value)| !value.is_nan());
        let times: Vec<f64> = there.map(|(t, _)| *t).collect();
        let steps: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
        let usual = greybox_recording::noise::median(&steps);
        let span: f64 = steps.iter().sum();
        ChannelUse {
            name: channel.name.clone(),
            unit: channel.unit.clone(),
            feeds,
            samples: times.len(),
            rate_hz: (span > 0.0).then(|| steps.len() as f64 / span),
            gaps: steps.iter().filter(|step| **step > 1.5 * usual).count(),
            character: character(&channel.values),
        }
    }

    /// What it may be, in words.
    fn moves(&self) -> Option<&'static str> {
        Some(match self.character? {
            Character::Constant => "constant",
            Character::Steps => "in steps: an input?",
            Character::Broadband => "broadband: an input?",
            Character::Smooth => "smooth: a state?",
        })
    }
}

/// Rates, samples, gaps of a channel in every recording, and what it may be, in words.
fn in_a_log(channels: &[&ChannelUse]) -> String {
    let rates: Vec<f64> = channels.iter().filter_map(|c| c.rate_hz).collect();
    let rate = range(&rates, format::number).map_or(String::new(), |rate| format!("{rate} Hz, "));
    let counted = |count: fn(&ChannelUse) -> usize, word: &str| {
        let counts: Vec<f64> = channels.iter().map(|c| count(c) as f64).collect();
        let plural = if counts.iter().all(|n| *n == 1.0) { "" } else { "s" };
        range(&counts, |n| n.to_string()).map_or(String::new(), |range| format!("{range} {word}{plural}"))
    };
    let samples = counted(|c| c.samples, "sample");
    let gaps = match channels.iter().any(|c| c.gaps > 0) {
        true => format!(", {}", counted(|c| c.gaps, "gap")),
        false => String::new(),
    };
    let mut moves: Vec<&str> = channels.iter().filter_map(|c| c.moves()).collect();
    moves.sort_unstable();
    moves.dedup();
    let moves = if moves.is_empty() { String::new() } else { format!("; {}", moves.join(", or ")) };
    format!("{rate}{samples}{gaps}{moves}")
}

/// The least and the largest of values, in words: one value where both read the same.
fn range(values: &[f64], written: impl Fn(f64) -> String) -> Option<String> {
    let least = values.iter().copied().reduce(f64::min)?;
    let (least, largest) = (written(least), written(values.iter().copied().fold(least, f64::max)));
    Some(if least == largest { least } else { format!("{least} to {largest}") })
}

impl Health {
    /// Whether another recording has the same channels, which feed the same.
    fn is_laid_out_as(&self, other: &Health) -> bool {
        let layout = |health: &Health| -> Vec<(String, Option<String>, Option<String>)> {
            health.channels.iter().map(|c| (c.name.clone(), c.unit.clone(), c.feeds.clone())).collect()
        };
        layout(self) == layout(other)
    }

    /// The findings as those of a study of several recordings.
    fn findings(&self) -> impl Iterator<Item = contract::Finding> {
        self.findings.iter().map(|f| health_finding(f.clone(), Some(self.file.clone())))
    }
}

/// What the findings amount to.
fn verdict(findings: &[Finding]) -> String {
    let count = |severity| findings.iter().filter(|f| f.severity == severity).count();
    match (count(Severity::Problem), count(Severity::Warning)) {
        (0, 0) => "healthy".to_owned(),
        (0, w) => format!("usable, {}", plural(w, "warning")),
        (p, 0) => plural(p, "problem"),
        (p, w) => format!("{}, {}", plural(p, "problem"), plural(w, "warning")),
    }
}

/// The channels of recordings that have the same ones.
fn table(recordings: &[Health]) -> String {
    let mut text = String::new();
    let Some(first) = recordings.first() else { return text };
    let width = first.channels.iter().map(|c| c.name.chars().count()).max().unwrap_or(0);
    for (k, channel) in first.channels.iter().enumerate() {
        let unit = channel.unit.as_deref().map_or(String::new(), |u| format!("[{}]", format::unit(u)));
        let feeds = match &channel.feeds {
            Some(feeds) => feeds.clone(),
            None => in_a_log(&recordings.iter().map(|health| &health.channels[k]).collect::<Vec<_>>()),
        };
        let line = format!("  {:width$}  {unit:10}  {feeds}", channel.name);
        let _ = writeln!(text, "{}", line.trim_end());
    }
    text
}

/// One note: severity, place, sentence; the fix on a line of its own.
fn in_words(note: &Note) -> String {
    let severity = match note.severity {
        contract::Severity::Info => Severity::Info,
        contract::Severity::Warning => Severity::Warning,
        contract::Severity::Error => Severity::Problem,
    };
    let severity = severity.to_string();
    let place = if note.place.is_empty() { String::new() } else { format!("{}: ", note.place) };
    let mut text = format!("  {severity:8} {place}{}\n", note.message);
    if let Some(help) = &note.help {
        let _ = writeln!(text, "           help: {help}");
    }
    text
}

fn plural(count: usize, word: &str) -> String {
    if count == 1 { format!("1 {word}") } else { format!("{count} {word}s") }
}
