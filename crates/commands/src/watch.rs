//! Lines of samples while a machine runs, and what a watch says of them.

use std::path::Path;

use greybox_recording::{Channel, Recording, Rename, SIZES};
use greybox_report::format;
use greybox_watch::{Clock as Jump, Event, Options, Saved, Watch, WatchError};
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};

use crate::failure::Failure;
use crate::loading::LoadedModel;

mod clock;
mod influx;
mod lines;
mod words;

pub use clock::Clock;
use lines::{Lines, Place};

/// What the first seconds are called in messages.
const LABEL: &str = "first seconds";

/// Lines in which nothing could be read from which on the input is taken to be something else.
const UNREADABLE: usize = 100;

/// A watch on lines of samples: CSV with a header or with [named columns](Session::with_columns), JSON objects, or the Influx
/// line protocol.
#[derive(Debug)]
pub struct Session {
    model: LoadedModel,
    map: Vec<Rename>,
    options: Options,
    /// Lines, or messages, so far.
    line: u64,
    lines: Option<Lines>,
    /// Names of the columns of lines without a header.
    columns: Option<String>,
    /// That of the samples, from the first of them on.
    clock: Option<Clock>,
    stage: Stage,
    /// Whether it has learned before.
    learned: bool,
    /// Lines one after the other that could not be read.
    unreadable: usize,
}

#[derive(Debug)]
enum Stage {
    Learning(First),
    Watching(Box<Watch>),
}

/// The first seconds.
#[derive(Debug, Default)]
struct First {
    /// Time and columns of every sample.
    rows: Vec<Vec<f64>>,
    /// Seconds, without gaps.
    seconds: f64,
}

/// What a sample of the first seconds was.
enum Added {
    More,
    Enough,
    /// The clock jumped: they begin anew.
    Restarted(Jump),
}

/// Share of the first seconds that is a gap: no samples are missing for so long.
const GAP: f64 = 0.04;

impl First {
    /// Adds a sample. A late or repeated one is passed over; where the clock jumps back before the first one, all begins anew.
    fn add(&mut self, row: Vec<f64>, learn: f64) -> Added {
        let t = row[0];
        if let (Some(first), Some(last)) = (self.rows.first(), self.rows.last()) {
            if t < first[0] {
                let clock = Jump { from: last[0], t };
                (self.rows, self.seconds) = (vec![row], 0.0);
                return Added::Restarted(clock);
            }
            let passed = t - last[0];
            if passed <= 0.0 {
                return Added::More;
            }
            self.seconds += if passed < GAP * learn { passed } else { 0.0 };
        }
        self.rows.push(row);
        // (Sums of intervals are rounded.)
        if self.seconds < (1.0 - 1e-9) * learn { Added::More } else { Added::Enough }
    }
}

/// The state of a session as data: what [`Session::new`] goes on from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State<W = Saved> {
    /// The clock of its samples.
    #[serde(default)]
    clock: Clock,
    /// The state of the watch.
    #[serde(flatten)]
    watch: W,
}

/// One thing that a session says.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// Of the machine.
    Event {
        /// What has happened; its times are seconds of the clock.
        event: Event,
        /// The clock of the samples.
        clock: Clock,
    },
    /// A line could not be read; it is passed over.
    Unreadable {
        /// Its number, or that of its message.
        line: u64,
        /// The topic of its message.
        topic: Option<String>,
        /// Why.
        message: String,
    },
}

impl Session {
    /// A session on a model; `saved` is a state to go on from, and the file that errors say it is in.
    ///
    /// # Errors
    /// Bad input: options that make no sense, or the state of another model.
    pub fn new(
        model: LoadedModel,
        map: &[Rename],
        options: Options,
        saved: Option<(State, &Path)>,
    ) -> Result<Session, Failure> {
        options.check().map_err(|e| failure(&model, e))?;
        let learned = saved.is_some();
        let (clock, stage) = match saved {
            Some((State { clock, watch }, path)) => {
                let watch = Watch::restore(&model.model, watch).map_err(|e| match e {
                    WatchError::OtherModel { .. } => Failure::file(path, e)
                        .help("delete the file to learn anew, or name another one after `--state`"),
                    e => failure(&model, e),
                })?;
                (Some(clock), Stage::Watching(Box::new(watch)))
            }
            None => (None, Stage::Learning(First::default())),
        };
        let map = map.to_vec();
        let (line, lines, columns, unreadable) = (0, None, None, 0);
        Ok(Session { model, map, options, line, lines, columns, clock, stage, learned, unreadable })
    }

    /// The same on rows of CSV that have no header, whose columns have these names: `t [s],t [ns],_,angle [deg]`, as
    /// [`CsvLines::named`](greybox_recording::CsvLines::named) takes them.
    ///
    /// # Errors
    /// Bad input: names that do not fit, or without the model's channels.
    pub fn with_columns(mut self, names: &str) -> Result<Session, Failure> {
        Lines::named(&self.model.model, &self.map, names)?;
        self.columns = Some(names.to_owned());
        Ok(self)
    }

    /// Takes the next line.
    ///
    /// # Errors
    /// Bad input: a header without the model's channels, lines of another kind than their columns were named for, first
    /// seconds from which nothing can be learned, or nothing but lines that cannot be read.
    pub fn line(&mut self, text: &str) -> Result<Vec<Output>, Failure> {
        self.line += 1;
        if text.trim().is_empty() {
            return Ok(Vec::new());
        }
        let (model, place) = (&self.model.model, Place { topic: None, line: self.line });
        match (&self.lines, &self.columns) {
            (None, Some(columns)) => {
                let lines = Lines::named(model, &self.map, columns)?;
                lines.check_first(text, place)?;
                self.lines = Some(lines);
            }
            (None, None) => {
                let lines = Lines::new(model, &self.map, text, place)?;
                let sample = lines.begins_with_a_sample();
                self.lines = Some(lines);
                if !sample {
                    return Ok(Vec::new());
                }
            }
            (Some(lines), None) if lines.may_be_a_header(text) => {
                if let Ok(again) = Lines::new(model, &self.map, text, place) {
                    self.lines = Some(again);
                    return Ok(Vec::new());
                }
            }
            (Some(_), _) => {}
        }
        self.sample(text, None)
    }

    /// Takes the next message of a broker: JSON objects, or lines of the Influx protocol.
    ///
    /// # Errors
    /// Bad input, as of lines.
    pub fn message(&mut self, topic: &str, payload: &str) -> Result<Vec<Output>, Failure> {
        self.line += 1;
        if self.lines.is_none() {
            let place = Place { topic: Some(topic), line: self.line };
            self.lines = Some(Lines::new(&self.model.model, &self.map, payload, place)?);
        }
        // (An object may stand on several lines; lines of the protocol come many in a message.)
        let object =
            payload.trim_start().starts_with('{') && serde_json::from_str::<IgnoredAny>(payload).is_ok();
        if object {
            return self.sample(payload, Some(topic));
        }
        let mut outputs = Vec::new();
        for text in payload.lines().filter(|text| !text.trim().is_empty()) {
            outputs.append(&mut self.sample(text, Some(topic))?);
        }
        Ok(outputs)
    }

    /// The state, where it has learned.
    pub fn state(&self) -> Option<State<&Saved>> {
        match &self.stage {
            Stage::Learning(_) => None,
            Stage::Watching(watch) => {
                Some(State { clock: self.clock.unwrap_or_default(), watch: watch.saved() })
            }
        }
    }

    /// Sees that the samples have sufficed, at their end.
    ///
    /// # Errors
    /// Bad input: they ended before anything was learned.
    pub fn end(&self) -> Result<(), Failure> {
        let Stage::Learning(First { seconds, .. }) = &self.stage else { return Ok(()) };
        if self.learned {
            return Ok(());
        }
        Err(Failure::input(format!(
            "the samples ended after {} s, before the {} s from which is learned what is usual",
            format::number(*seconds),
            format::number(self.options.learn)
        ))
        .help("send more samples, or learn from fewer seconds: `--learn SECONDS`"))
    }

    /// The seconds on the clock of the samples, and the columns of a line.
    fn row(&mut self, text: &str, place: Place<'_>) -> Result<Option<Vec<f64>>, String> {
        let Some(lines) = &self.lines else { return Ok(None) };
        let Some((stamp, values)) = lines.row(text, place)? else { return Ok(None) };
        let clock = self.clock.get_or_insert_with(|| Clock::of(&stamp));
        let t = clock.read(&stamp).map_err(|e| format!("{place}: {e}"))?;
        Ok(Some(std::iter::once(t).chain(values).collect()))
    }

    fn sample(&mut self, text: &str, topic: Option<&str>) -> Result<Vec<Output>, Failure> {
        let line = self.line;
        let row = match self.row(text, Place { topic, line }) {
            Ok(Some(row)) => row,
            Ok(None) => return Ok(Vec::new()),
            Err(message) => {
                self.unreadable += 1;
                if self.unreadable >= UNREADABLE {
                    return Err(Failure::input(format!(
                        "{UNREADABLE} lines one after the other cannot be read; the last: {message}"
                    ))
                    .help(match (topic, &self.columns) {
                        (None, None) => {
                            "send CSV with a header, or one JSON object a line with the time as `t`"
                        }
                        (None, Some(_)) => "name every column of a row after `--columns`, those not to read `_`",
                        (Some(_), _) => {
                            "subscribe to the topic of the samples alone: JSON objects with the time as `t`, or lines of \
                             the Influx protocol"
                        }
                    }));
                }
                return Ok(vec![Output::Unreadable { line, topic: topic.map(str::to_owned), message }]);
            }
        };
        self.unreadable = 0;
        let events = match &mut self.stage {
            Stage::Watching(watch) => {
                let inputs = self.model.model.inputs.len();
                watch.push(row[0], &row[1..=inputs], &row[1 + inputs..])
            }
            Stage::Learning(first) => match first.add(row, self.options.learn) {
                Added::More => Vec::new(),
                Added::Restarted(clock) => vec![Event::Restarted(clock)],
                Added::Enough => self.learn()?,
            },
        };
        // (What was learned says nothing of what the machine does now.)
        if events.iter().any(|event| matches!(event, Event::Outside(_))) {
            self.stage = Stage::Learning(First::default());
        }
        let clock = self.clock.unwrap_or_default();
        Ok(events.into_iter().map(|event| Output::Event { event, clock }).collect())
    }

    fn learn(&mut self) -> Result<Vec<Event>, Failure> {
        let (Stage::Learning(First { rows, .. }), Some(lines)) = (&self.stage, &self.lines) else {
            return Ok(Vec::new());
        };
        let time: Vec<f64> = rows.iter().map(|r| r[0]).collect();
        let mut channels: Vec<Channel> = Vec::new();
        for (k, column) in lines.columns.iter().enumerate() {
            // (An input that is also measured is one channel.)
            if channels.iter().any(|c| c.name == column.channel) {
                continue;
            }
            // (What cannot be computed with is not measured, as afterwards.)
            let value =
                |r: &Vec<f64>| Some(column.unit.from_si(r[k + 1])).filter(|v| v.abs() <= *SIZES.end());
            let values = rows.iter().map(|r| value(r).unwrap_or(f64::NAN)).collect();
            let unit = Some(column.unit.text.clone()).filter(|u| !u.is_empty());
            channels.push(Channel { name: column.channel.clone(), unit, values });
        }
        let recording = Recording::from_columns(LABEL, time, channels)?;
        let (watch, event) = Watch::learn(&self.model.model, &recording, &self.options)
            .map_err(|e| failure(&self.model, e))?;
        (self.stage, self.learned) = (Stage::Watching(Box::new(watch)), true);
        Ok(vec![event])
    }
}

fn failure(model: &LoadedModel, error: WatchError) -> Failure {
    match error {
        WatchError::Data(error) => error.into(),
        WatchError::Setup(_) | WatchError::DelayedMeasurement | WatchError::NothingFree => {
            Failure::file(&model.path, error)
        }
        other => Failure::input(other.to_string()),
    }
}
