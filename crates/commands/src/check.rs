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

/// Checks recordings, with the roles that a model gives their channels, or with `inputs` as what drives them.
///
/// # Errors
/// Bad input: a recording that lacks what the model needs, or an input that is no channel.
pub fn check(
    recordings: &[Recording],
    model: Option<&Model>,
    inputs: &[String],
) -> Result<Vec<Health>, Failure> {
    if let Some(model) = model {
        Data::new(model, recordings)?;
    }
    for recording in recordings {
        known(recording, inputs)?;
    }
    let checked = recordings
        .iter()
        .map(|recording| match model {
            Some(model) => {
                let has = |name: &str| recording.channel(name).is_some();
                let feeds = |name: &str, unit: Option<&str>| feeds(model, name, unit, &has);
                let (inputs, outputs) = roles(model, recording);
                let mut findings = findings(recording, &inputs, &outputs);
                findings.extend(plausible::findings(model, recording));
                describe(recording, findings, feeds)
            }
            None => {
                let findings = check_with_inputs(recording, inputs);
                describe(recording, findings, |name, _| {
                    inputs.iter().any(|i| i == name).then(|| "input".to_owned())
                })
            }
        })
        .collect();
    Ok(checked)
}

/// What was found, in plain language: a verdict for each recording, its channels, then the findings, those that matter most
/// first. What the recordings have in common is said once.
pub fn story(checked: &[Health]) -> String {
    let tables: Vec<String> = checked.iter().map(table).collect();
    let alike = checked.len() > 1 && tables.windows(2).all(|pair| pair[0] == pair[1]);
    let mut text = String::new();
    for (health, table) in checked.iter().zip(&tables) {
        let _ = writeln!(text, "{}: {}", health.file, verdict(&health.findings));
        if !alike {
            text.push_str(table);
        }
    }
    if let Some(table) = tables.first().filter(|_| alike) {
        let _ = write!(text, "\nChannels of each:\n{table}");
    }
    let found: Vec<contract::Finding> = checked.iter().flat_map(Health::findings).collect();
    let mut notes = grouped(&found);
    notes.sort_by_key(|note| std::cmp::Reverse(note.severity));
    if checked.len() > 1 {
        text.push_str("\nFindings:\n");
    }
    for mut note in notes {
        if let [alone] = checked {
            // It stands above.
            let place = note.place.strip_prefix(&alone.file).unwrap_or(&note.place);
            note.place = place.trim_start_matches(", ").to_owned();
        }
        text.push_str(&in_words(&note));
    }
    text
}

/// What was found, for machines.
pub fn to_json(model: Option<&Model>, checked: &[Health]) -> serde_json::Value {
    json!({ "model": model.map(|m| &m.name), "recordings": checked })
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

    /// Rate, samples, gaps and what it may be, in words.
    fn in_a_log(&self) -> String {
        let rate = self.rate_hz.map_or(String::new(), |rate| format!("{} Hz, ", format::number(rate)));
        let gaps = if self.gaps > 0 { format!(", {}", plural(self.gaps, "gap")) } else { String::new() };
        let moves = match self.character {
            Some(Character::Constant) => "; constant",
            Some(Character::Steps) => "; in steps: an input?",
            Some(Character::Broadband) => "; broadband: an input?",
            Some(Character::Smooth) => "; smooth: a state?",
            None => "",
        };
        format!("{rate}{}{gaps}{moves}", plural(self.samples, "sample"))
    }
}

impl Health {
    /// Whether its channels come from clocks of their own.
    fn is_a_log(&self) -> bool {
        self.findings.iter().any(|finding| finding.code == "clocks")
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

/// The channels of a recording.
fn table(health: &Health) -> String {
    let mut text = String::new();
    let width = health.channels.iter().map(|c| c.name.chars().count()).max().unwrap_or(0);
    for channel in &health.channels {
        let unit = channel.unit.as_deref().map_or(String::new(), |u| format!("[{}]", format::unit(u)));
        let feeds = match &channel.feeds {
            Some(feeds) => feeds.clone(),
            None if health.is_a_log() => channel.in_a_log(),
            None => String::new(),
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
