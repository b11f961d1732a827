//! Lines of samples while a machine runs, and what a watch says of them in words and for machines.

use std::fmt::Write as _;

use greybox_calibrate::data::recorded_unit;
use greybox_model::{Expr, Model, Unit};
use greybox_recording::{Channel, CsvLines, Recording, Rename, listed};
use greybox_report::contract::Interval;
use greybox_report::format;
use greybox_watch::{Change, Event, Irregular, Options, Parameter, Saved, Subject, Watch, WatchError};
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::loading::LoadedModel;

/// What the samples are called in messages.
const LABEL: &str = "standard input";
/// Lines in which nothing could be read from which on the input is taken to be something else.
const UNREADABLE: usize = 100;

/// A watch on lines of samples: CSV with a header, or JSON objects, one a line.
#[derive(Debug)]
pub struct Session {
    model: LoadedModel,
    map: Vec<Rename>,
    options: Options,
    line: u64,
    format: Option<Format>,
    /// Where each input, then each measurement, stands in a row, and its unit there.
    columns: Vec<Column>,
    stage: Stage,
    /// Lines one after the other that could not be read.
    unreadable: usize,
}

#[derive(Debug)]
enum Format {
    Csv(CsvLines),
    /// Keys of the channels, in the order of the columns.
    Json(Vec<String>),
}

#[derive(Debug)]
struct Column {
    /// As the model calls it.
    channel: String,
    /// Place in a row after the time.
    index: usize,
    unit: Unit,
}

#[derive(Debug)]
enum Stage {
    /// Rows of the first seconds: time and columns.
    Learning(Vec<Vec<f64>>),
    Watching(Box<Watch>),
}

/// One thing that a session says.
#[derive(Debug, Clone, PartialEq)]
pub enum Said {
    /// Of the machine.
    Event(Event),
    /// A line could not be read; it is passed over.
    Unreadable {
        /// Its number.
        line: u64,
        /// Why.
        message: String,
    },
}

impl Session {
    /// A session on a model; `saved` is a state to go on from.
    ///
    /// # Errors
    /// Bad input: options that make no sense, or the state of another model.
    pub fn new(
        model: LoadedModel,
        map: &[Rename],
        options: Options,
        saved: Option<Saved>,
    ) -> Result<Session, Failure> {
        options.check().map_err(|e| failure(&model, e))?;
        let stage = match saved {
            Some(saved) => Stage::Watching(Box::new(
                Watch::restore(&model.model, saved).map_err(|e| failure(&model, e))?,
            )),
            None => Stage::Learning(Vec::new()),
        };
        Ok(Session {
            model,
            map: map.to_vec(),
            options,
            line: 0,
            format: None,
            columns: Vec::new(),
            stage,
            unreadable: 0,
        })
    }

    /// Takes the next line.
    ///
    /// # Errors
    /// Bad input: a header without the model's channels, first seconds from which nothing can be learned, or
    /// nothing but lines that cannot be read.
    pub fn line(&mut self, text: &str) -> Result<Vec<Said>, Failure> {
        self.line += 1;
        if text.trim().is_empty() {
            return Ok(Vec::new());
        }
        let Some(format) = &self.format else {
            let (format, columns) = self.header(text)?;
            let json = matches!(format, Format::Json(_));
            (self.format, self.columns) = (Some(format), columns);
            // The first JSON object is a sample already.
            return if json { self.sample(text) } else { Ok(Vec::new()) };
        };
        // A log that is written on starts again with its header.
        let again = matches!(format, Format::Csv(_))
            && text.trim_start_matches(['"', ' ']).starts_with('t')
            && self.header(text).is_ok_and(|(format, columns)| {
                (self.format, self.columns) = (Some(format), columns);
                true
            });
        if again { Ok(Vec::new()) } else { self.sample(text) }
    }

    /// The state of the watch, where it has learned.
    pub fn saved(&self) -> Option<&Saved> {
        match &self.stage {
            Stage::Learning(_) => None,
            Stage::Watching(watch) => Some(watch.saved()),
        }
    }

    /// Sees that the samples have sufficed, at their end.
    ///
    /// # Errors
    /// Bad input: they ended before anything was learned.
    pub fn end(&self) -> Result<(), Failure> {
        let Stage::Learning(rows) = &self.stage else { return Ok(()) };
        let seconds = rows.last().map_or(0.0, |last| last[0] - rows[0][0]);
        Err(Failure::input(format!(
            "{LABEL}: the samples ended after {} s, before the {} s from which is learned what is usual",
            format::number(seconds),
            format::number(self.options.learn)
        ))
        .help("send more samples, or learn from fewer seconds: `--learn SECONDS`"))
    }

    fn header(&self, text: &str) -> Result<(Format, Vec<Column>), Failure> {
        let wanted = wanted(&self.model.model);
        if text.trim_start().starts_with('{') {
            let mut keys = Vec::new();
            let mut columns = Vec::new();
            for (index, (channel, unit, measured)) in wanted.into_iter().enumerate() {
                let rename = self.map.iter().find(|r| r.name == channel);
                keys.push(rename.map_or_else(|| channel.clone(), |r| r.channel.clone()));
                let stated = rename.and_then(|r| r.unit.as_deref());
                let unit = self.unit(&channel, stated, &unit, measured.as_ref())?;
                columns.push(Column { channel, index, unit });
            }
            return Ok((Format::Json(keys), columns));
        }
        let lines = CsvLines::new(text, LABEL, self.line)?;
        let mut columns = Vec::new();
        for (channel, unit, measured) in wanted {
            let rename = self.map.iter().find(|r| r.name == channel);
            let name = rename.map_or(channel.as_str(), |r| r.channel.as_str());
            let Some(index) = lines.columns().iter().position(|(n, _)| n == name) else {
                let available = listed(lines.columns().iter().map(|(n, _)| format!("`{n}`")).collect());
                return Err(Failure::input(format!(
                    "{LABEL}:{}: there is no channel `{name}`, which the model needs; the header has {available}",
                    self.line
                ))
                .help(format!("name the channel that is `{channel}`: `--map \"{channel}=CHANNEL\"`")));
            };
            let stated = lines.columns()[index].1.as_deref().or(rename.and_then(|r| r.unit.as_deref()));
            let unit = self.unit(&channel, stated, &unit, measured.as_ref())?;
            columns.push(Column { channel, index, unit });
        }
        Ok((Format::Csv(lines), columns))
    }

    fn unit(
        &self,
        channel: &str,
        stated: Option<&str>,
        unit: &Unit,
        measured: Option<&Expr>,
    ) -> Result<Unit, Failure> {
        let found = recorded_unit(&self.model.model, stated, unit, measured)
            .map_err(|e| Failure::input(format!("{LABEL}:{}: channel `{channel}`: {e}", self.line)))?;
        if found.dimension.same(&unit.dimension) {
            return Ok(found);
        }
        Err(Failure::input(format!(
            "{LABEL}:{}: channel `{channel}` is in [{}], but the model has it in [{}]",
            self.line, found.text, unit.text
        ))
        .help("correct the unit in the header or in the model"))
    }

    fn sample(&mut self, text: &str) -> Result<Vec<Said>, Failure> {
        let row = match self.row(text) {
            Ok(Some(row)) => row,
            Ok(None) => return Ok(Vec::new()),
            Err(message) => {
                self.unreadable += 1;
                if self.unreadable >= UNREADABLE {
                    return Err(Failure::input(format!(
                        "{UNREADABLE} lines one after the other cannot be read; the last: {message}"
                    ))
                    .help("send CSV with a header, or one JSON object a line with the time as `t`"));
                }
                return Ok(vec![Said::Unreadable { line: self.line, message }]);
            }
        };
        self.unreadable = 0;
        match &mut self.stage {
            Stage::Watching(watch) => {
                let inputs = self.model.model.inputs.len();
                let events = watch.push(row[0], &row[1..=inputs], &row[1 + inputs..]);
                Ok(events.into_iter().map(Said::Event).collect())
            }
            Stage::Learning(rows) => {
                // (A clock that jumps back begins anew; a late or repeated sample is passed over.)
                if let Some(last) = rows.last() {
                    if row[0] < rows[0][0] {
                        rows.clear();
                    } else if row[0] <= last[0] {
                        return Ok(Vec::new());
                    }
                }
                rows.push(row);
                if rows[rows.len() - 1][0] - rows[0][0] < self.options.learn {
                    return Ok(Vec::new());
                }
                self.learn()
            }
        }
    }

    /// Time and columns of a line, SI; `None` for a blank one.
    fn row(&self, text: &str) -> Result<Option<Vec<f64>>, String> {
        let values = match &self.format {
            Some(Format::Csv(lines)) => match lines.row(text, self.line).map_err(|e| e.to_string())? {
                Some(values) => values,
                None => return Ok(None),
            },
            Some(Format::Json(keys)) => {
                from_json(text, keys).map_err(|e| format!("{LABEL}:{}: {e}", self.line))?
            }
            None => return Ok(None),
        };
        let columns = self.columns.iter().map(|c| c.unit.to_si(values[c.index + 1]));
        Ok(Some(std::iter::once(values[0]).chain(columns).collect()))
    }

    fn learn(&mut self) -> Result<Vec<Said>, Failure> {
        let Stage::Learning(rows) = &self.stage else { return Ok(Vec::new()) };
        let time: Vec<f64> = rows.iter().map(|r| r[0]).collect();
        let mut channels: Vec<Channel> = Vec::new();
        for (k, column) in self.columns.iter().enumerate() {
            // (An input that is also measured is one channel.)
            if channels.iter().any(|c| c.name == column.channel) {
                continue;
            }
            let values = rows.iter().map(|r| column.unit.from_si(r[k + 1])).collect();
            let unit = Some(column.unit.text.clone()).filter(|u| !u.is_empty());
            channels.push(Channel { name: column.channel.clone(), unit, values });
        }
        let recording = Recording::from_columns(LABEL, time, channels)?;
        let (watch, event) = Watch::learn(&self.model.model, &recording, &self.options)
            .map_err(|e| failure(&self.model, e))?;
        self.stage = Stage::Watching(Box::new(watch));
        Ok(vec![Said::Event(event)])
    }
}

/// Channels of a model: name, unit and, of measurements, the expression.
fn wanted(model: &Model) -> Vec<(String, Unit, Option<Expr>)> {
    let inputs = model.inputs.iter().map(|i| (i.channel.clone(), i.unit.clone(), None));
    let measured = model.measurements.iter();
    inputs.chain(measured.map(|m| (m.channel.clone(), m.unit.clone(), Some(m.expr.clone())))).collect()
}

fn failure(model: &LoadedModel, error: WatchError) -> Failure {
    match error {
        WatchError::Data(error) => error.into(),
        WatchError::Setup(_) | WatchError::Delayed | WatchError::NothingFree => {
            Failure::file(&model.path, error)
        }
        other => Failure::input(other.to_string()),
    }
}

/// Time and values of a JSON object; a key that is not there, or is `null`, is a missing sample. A key with points may lead
/// into objects: `motor.angle`.
fn from_json(text: &str, keys: &[String]) -> Result<Vec<f64>, String> {
    let object: Value = serde_json::from_str(text).map_err(|e| format!("this is no JSON object: {e}"))?;
    let find = |key: &str| {
        object.get(key).or_else(|| key.split('.').try_fold(&object, |inner, part| inner.get(part)))
    };
    let number = |key: &str, value: &Value| match value {
        Value::Null => Ok(f64::NAN),
        value => value.as_f64().ok_or_else(|| format!("`{key}` is {value}, not a number")),
    };
    let time = find("t").ok_or("there is no time `t`, in seconds")?;
    let mut row = vec![number("t", time)?];
    if row[0].is_nan() {
        return Err("the time `t` is null".to_owned());
    }
    for key in keys {
        row.push(find(key).map_or(Ok(f64::NAN), |value| number(key, value))?);
    }
    Ok(row)
}

impl Said {
    /// One line for machines.
    pub fn to_json(&self) -> Value {
        match self {
            Said::Event(event) => serde_json::to_value(event).unwrap_or_default(),
            Said::Unreadable { line, message } => {
                json!({ "event": "unreadable", "line": line, "message": message })
            }
        }
    }

    /// In plain language, with its line ends; estimates that come with every block are for machines alone.
    pub fn in_words(&self) -> Option<String> {
        match self {
            Said::Unreadable { message, .. } => Some(format!("passed over: {message}\n")),
            Said::Event(event) => in_words(event),
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
                "{}: the clock went there from {}; the state begins anew",
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
