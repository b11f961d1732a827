//! Lines of samples while a machine runs, and what a watch says of them.

use greybox_recording::{Channel, Recording, Rename};
use greybox_report::format;
use greybox_watch::{Clock, Event, Options, Saved, Watch, WatchError};

use crate::failure::Failure;
use crate::loading::LoadedModel;

mod influx;
mod lines;
mod words;

use lines::{LABEL, Lines};

/// Lines in which nothing could be read from which on the input is taken to be something else.
const UNREADABLE: usize = 100;

/// A watch on lines of samples: CSV with a header, or JSON objects, one a line.
#[derive(Debug)]
pub struct Session {
    model: LoadedModel,
    map: Vec<Rename>,
    options: Options,
    line: u64,
    lines: Option<Lines>,
    stage: Stage,
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
    Restarted(Clock),
}

/// Share of the first seconds that is a gap: no samples are missing for so long.
const GAP: f64 = 0.04;

impl First {
    /// Adds a sample. A late or repeated one is passed over; where the clock jumps back before the first one, all begins anew.
    fn add(&mut self, row: Vec<f64>, learn: f64) -> Added {
        let t = row[0];
        if let (Some(first), Some(last)) = (self.rows.first(), self.rows.last()) {
            if t < first[0] {
                let clock = Clock { from: last[0], t };
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

/// One thing that a session says.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
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
            None => Stage::Learning(First::default()),
        };
        Ok(Session { model, map: map.to_vec(), options, line: 0, lines: None, stage, unreadable: 0 })
    }

    /// Takes the next line.
    ///
    /// # Errors
    /// Bad input: a header without the model's channels, first seconds from which nothing can be learned, or
    /// nothing but lines that cannot be read.
    pub fn line(&mut self, text: &str) -> Result<Vec<Output>, Failure> {
        self.line += 1;
        if text.trim().is_empty() {
            return Ok(Vec::new());
        }
        let model = &self.model.model;
        match &self.lines {
            None => {
                let lines = Lines::new(model, &self.map, text, self.line)?;
                let sample = lines.begins_with_a_sample();
                self.lines = Some(lines);
                if !sample {
                    return Ok(Vec::new());
                }
            }
            Some(lines) if lines.may_be_a_header(text) => {
                if let Ok(again) = Lines::new(model, &self.map, text, self.line) {
                    self.lines = Some(again);
                    return Ok(Vec::new());
                }
            }
            Some(_) => {}
        }
        self.sample(text)
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
        let Stage::Learning(First { seconds, .. }) = &self.stage else { return Ok(()) };
        Err(Failure::input(format!(
            "{LABEL}: the samples ended after {} s, before the {} s from which is learned what is usual",
            format::number(*seconds),
            format::number(self.options.learn)
        ))
        .help("send more samples, or learn from fewer seconds: `--learn SECONDS`"))
    }

    fn sample(&mut self, text: &str) -> Result<Vec<Output>, Failure> {
        let row = match self.lines.as_ref().map_or(Ok(None), |lines| lines.row(text, self.line)) {
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
                return Ok(vec![Output::Unreadable { line: self.line, message }]);
            }
        };
        self.unreadable = 0;
        match &mut self.stage {
            Stage::Watching(watch) => {
                let inputs = self.model.model.inputs.len();
                let events = watch.push(row[0], &row[1..=inputs], &row[1 + inputs..]);
                Ok(events.into_iter().map(Output::Event).collect())
            }
            Stage::Learning(first) => match first.add(row, self.options.learn) {
                Added::More => Ok(Vec::new()),
                Added::Restarted(clock) => Ok(vec![Output::Event(Event::Restarted(clock))]),
                Added::Enough => self.learn(),
            },
        }
    }

    fn learn(&mut self) -> Result<Vec<Output>, Failure> {
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
            let values = rows.iter().map(|r| column.unit.from_si(r[k + 1])).collect();
            let unit = Some(column.unit.text.clone()).filter(|u| !u.is_empty());
            channels.push(Channel { name: column.channel.clone(), unit, values });
        }
        let recording = Recording::from_columns(LABEL, time, channels)?;
        let (watch, event) = Watch::learn(&self.model.model, &recording, &self.options)
            .map_err(|e| failure(&self.model, e))?;
        self.stage = Stage::Watching(Box::new(watch));
        Ok(vec![Output::Event(event)])
    }
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
