//! Many recordings of one model: the work of one of them, and what all say together.
//!
//! [`Fleet`] is what all diagnoses share. [`Fleet::finished`] and [`Fleet::diagnose`] do the work of one recording,
//! [`conclude`] draws the summary from what they leave. None of them reads or writes a file: the command does that for a
//! folder, the Python package for the workers of a cluster, and so both leave the same bytes.

mod done;

use std::path::{Path, PathBuf};

use greybox_calibrate::Data;
use greybox_diagnose::{Options, ProgressListener};
use greybox_fleet::Runs;
use greybox_recording::{Location, Recording, Rename};
use greybox_report::contract::{ModelId, Producer};
use greybox_report::summary::{Run, Statistics, Summary};
use greybox_report::{Report, ReportError, merge};

use crate::diagnose::{FILES, Results};
use crate::failure::Failure;
use crate::loading::{self, LoadedModel, Wanted};
use crate::story;
use done::{Done, Fingerprint, Inputs};

pub use done::DONE;

/// The files that tell of all recordings.
pub const SUMMARY: [&str; 2] = ["summary.json", "summary.html"];

/// A file: where it stands, as errors name it, and what it holds.
#[derive(Debug, Clone)]
pub struct File {
    /// A path, or a URL.
    pub path: PathBuf,
    /// Its content.
    pub bytes: Vec<u8>,
}

/// What the diagnoses of all recordings share.
#[derive(Debug)]
pub struct Fleet {
    loaded: LoadedModel,
    /// What judges all of them; each has its path for a name until a recording is called the same.
    holdout: Vec<(PathBuf, Recording)>,
    channels: Channels,
    wanted: Wanted,
    options: Options,
    /// What the results depend on beside the recording.
    shared: Shared,
}

/// Which channels of the recordings are read, and what the model calls them.
#[derive(Debug, Clone, Default)]
pub struct Channels {
    /// Names of the model for channels.
    pub map: Vec<Rename>,
    /// These alone are read beside those of `map`; all, if there are none.
    pub only: Vec<String>,
}

/// The fingerprints of what is the same for all recordings.
#[derive(Debug)]
struct Shared {
    model: Fingerprint,
    holdout: Vec<Fingerprint>,
    mechanisms: Vec<Fingerprint>,
}

/// One recording of a fleet.
#[derive(Debug, Clone, Copy)]
pub struct Member<'a> {
    /// Its file.
    pub file: &'a File,
    /// What the summary calls it: the name of its file, or more of its path where names stand twice.
    pub name: &'a str,
    /// The folder of its results, from the summary.
    pub folder: &'a str,
}

/// What the diagnosis of one recording leaves.
#[derive(Debug)]
pub struct Outcome {
    /// The files, by name; the last one is the mark of a finished diagnosis, [`DONE`].
    pub files: Vec<(&'static str, Vec<u8>)>,
    /// For [`conclude`].
    pub statistics: Statistics,
}

/// The summary as the files and words that users see.
#[derive(Debug)]
pub struct Conclusion {
    /// `summary.json`.
    pub json: String,
    /// `summary.html`.
    pub html: String,
    /// In plain language.
    pub story: String,
}

impl Fleet {
    /// The diagnoses of a model with these options. `mechanisms` are name and text of those beside the built-in ones,
    /// which `options` has.
    ///
    /// # Errors
    /// Bad input: a fault in what judges all recordings.
    pub fn new(
        loaded: LoadedModel,
        holdout: Vec<File>,
        channels: Channels,
        options: Options,
        mechanisms: &[(String, String)],
    ) -> Result<Fleet, Failure> {
        let shared = Shared {
            model: Fingerprint::of(&loaded.file, loaded.text.as_bytes()),
            holdout: holdout.iter().map(|file| Fingerprint::of("", &file.bytes)).collect(),
            mechanisms: mechanisms
                .iter()
                .map(|(name, text)| Fingerprint::of(name, text.as_bytes()))
                .collect(),
        };
        let wanted = Wanted::new(&channels.map, &channels.only).of_model(&loaded.model);
        let read = |file: File| {
            let recording = loading::recording_of(file.bytes, &file.path, &wanted)?;
            Ok((file.path, recording))
        };
        let holdout = holdout.into_iter().map(read).collect::<Result<Vec<_>, Failure>>()?;
        let recordings: Vec<Recording> = holdout.iter().map(|(_, recording)| recording.clone()).collect();
        Data::new(&loaded.model, &recordings)?;
        Ok(Fleet { loaded, holdout, channels, wanted, options, shared })
    }

    /// The model.
    pub fn model(&self) -> &LoadedModel {
        &self.loaded
    }

    /// What a finished diagnosis of a recording left, where `read` gives its files whole and they are of the same
    /// inputs; nothing else counts.
    pub fn finished(&self, member: Member<'_>, read: impl Fn(&str) -> Option<Vec<u8>>) -> Option<Statistics> {
        let [json, ..] = FILES;
        let report = Done::read(read, &self.inputs(member.file), json)?;
        statistics(member, &report).ok()
    }

    /// Diagnoses a recording.
    ///
    /// # Errors
    /// As a diagnosis of this recording alone.
    pub fn diagnose(&self, member: Member<'_>, listener: &dyn ProgressListener) -> Result<Outcome, Failure> {
        let recording = loading::recording_of(member.file.bytes.clone(), &member.file.path, &self.wanted)?;
        self.diagnose_prepared(member, recording, listener)
    }

    /// As [`diagnose`](Self::diagnose), of a file that was read elsewhere.
    ///
    /// # Errors
    /// As a diagnosis of this recording alone.
    pub fn diagnose_read(
        &self,
        member: Member<'_>,
        mut recording: Recording,
        listener: &dyn ProgressListener,
    ) -> Result<Outcome, Failure> {
        self.wanted.apply(&mut recording)?;
        self.diagnose_prepared(member, recording, listener)
    }

    fn diagnose_prepared(
        &self,
        member: Member<'_>,
        mut recording: Recording,
        listener: &dyn ProgressListener,
    ) -> Result<Outcome, Failure> {
        let paths = self.paths(&member.file.path);
        recording.name = loading::called(&member.file.path, &paths);
        let train = [recording];
        let holdout: Vec<Recording> = self
            .holdout
            .iter()
            .map(|(path, held)| Recording { name: loading::called(path, &paths), ..held.clone() })
            .collect();
        let diagnosis =
            greybox_diagnose::diagnose(&self.loaded.model, &train, &holdout, &self.options, listener)
                .map_err(|e| Failure::diagnosis(&self.loaded.path, e))?;
        let results = Results::of(&diagnosis, &self.loaded, &train, &holdout)?;
        let mark = serde_json::to_vec_pretty(&Done::new(self.inputs(member.file), &results.files()))
            .map_err(|e| unwritten(e.into()))?;
        let statistics = statistics(member, &results.report_json).map_err(unwritten)?;
        let mut files: Vec<_> =
            results.files().iter().map(|&(name, content)| (name, content.to_vec())).collect();
        files.push((DONE, mark));
        Ok(Outcome { files, statistics })
    }

    /// The recording's path and those of what judges it.
    fn paths(&self, recording: &Path) -> Vec<PathBuf> {
        std::iter::once(recording.to_owned())
            .chain(self.holdout.iter().map(|(path, _)| path.clone()))
            .collect()
    }

    /// What the results of a recording depend on.
    fn inputs(&self, recording: &File) -> Inputs {
        let paths = self.paths(&recording.path);
        Inputs {
            greybox: env!("CARGO_PKG_VERSION").to_owned(),
            seed: self.options.seed,
            work: self.options.work,
            model: self.shared.model.clone(),
            recording: Fingerprint::of(loading::called(&recording.path, &paths), &recording.bytes),
            holdout: self
                .holdout
                .iter()
                .zip(&self.shared.holdout)
                .map(|((path, _), content)| content.called(loading::called(path, &paths)))
                .collect(),
            map: self.channels.map.iter().map(Rename::to_string).collect(),
            channels: self.channels.only.clone(),
            mechanisms: self.shared.mechanisms.clone(),
        }
    }
}

/// What the text of a report.json leaves for the summary.
fn statistics(member: Member<'_>, report: &str) -> Result<Statistics, ReportError> {
    let [_, html, _] = FILES;
    let page = format!("{}/{html}", member.folder);
    Report::from_json(report).map(|report| merge::map(member.name, Some(&page), &report))
}

/// The folder of the results of the recording at `path`: called as its file without the ending, and `data.parquet.3` for the
/// episode `data.parquet#3`, since `#` begins the fragment of a link.
///
/// ```
/// use greybox_commands::fleet::folder_of;
/// assert_eq!(folder_of("runs/monday.csv".as_ref()), "monday");
/// assert_eq!(folder_of("runs/data.parquet#3".as_ref()), "data.parquet.3");
/// ```
pub fn folder_of(path: &Path) -> String {
    let Location { file, episode } = Location::of(path);
    match episode {
        Some(episode) => format!("{}.{episode}", loading::file_name(&file)),
        None => file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default(),
    }
}

/// What a recording that could not be diagnosed leaves for the summary.
pub fn failed(name: &str, failure: &Failure) -> Statistics {
    merge::failed(name, failure.message(), failure.advice())
}

/// A table of the recordings: machines, dates, covariates.
#[derive(Debug)]
pub struct Table {
    runs: Runs,
    /// What errors call it.
    file: String,
}

impl Table {
    /// Reads the table in `text`, which errors call `file`, and sees that it has a row for each of these recordings.
    ///
    /// # Errors
    /// Bad input: a fault in the table, or a recording that it does not have.
    pub fn new<'a>(
        text: &str,
        file: &str,
        recordings: impl IntoIterator<Item = &'a str>,
    ) -> Result<Table, Failure> {
        let runs = Runs::parse(text, file)?;
        for recording in recordings {
            runs.of(recording, file)?;
        }
        Ok(Table { runs, file: file.to_owned() })
    }

    /// Tells each recording of its row.
    fn attach(&self, statistics: &mut Statistics) -> Result<(), Failure> {
        for recording in &mut statistics.recordings {
            let run = self.runs.of(&recording.recording, &self.file)?;
            let known =
                self.runs.covariates.iter().zip(&run.covariates).filter(|(_, value)| value.is_finite());
            recording.run = Some(Run {
                machine: run.machine.clone(),
                date: (!run.date.is_empty()).then(|| run.date.clone()),
                covariates: known.map(|(covariate, value)| (covariate.header(), *value)).collect(),
            });
        }
        Ok(())
    }
}

/// What the recordings say together of a model called `name`, read from `file`, diagnosed with this seed; over the machines
/// too, where a table says which each is of.
///
/// # Errors
/// Bad input: a recording that the table does not have. An internal failure where the summary cannot be written.
pub fn conclude(
    parts: Vec<Statistics>,
    table: Option<&Table>,
    name: &str,
    file: &str,
    seed: u64,
) -> Result<Conclusion, Failure> {
    let mut statistics = merge::reduce(parts).map_err(unwritten)?;
    if let Some(table) = table {
        table.attach(&mut statistics)?;
    }
    let summary: Summary = merge::conclude(
        statistics,
        Producer::this(seed),
        ModelId { name: name.to_owned(), file: file.to_owned() },
    );
    Ok(Conclusion {
        json: summary.to_json().map_err(unwritten)?,
        html: summary.to_html().map_err(unwritten)?,
        story: story::summary(&summary),
    })
}

/// A failure to write what greybox itself made.
pub fn unwritten(error: ReportError) -> Failure {
    Failure::internal(error.to_string())
}
