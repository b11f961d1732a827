//! `greybox diagnose` on a folder: every recording by itself, and what they say together.

use std::fs;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use greybox_calibrate::Data;
use greybox_commands::diagnose::{FILES, Results};
use greybox_diagnose::{Options, Quiet};
use greybox_recording::Rename;
use greybox_report::contract::{ModelId, Producer};
use greybox_report::summary::Statistics;
use greybox_report::{Report, ReportError, merge};
use serde_json::json;

use super::{Arguments, tried};
use crate::answer::Answer;
use crate::channels::Channels;
use crate::done::{self, Done, Fingerprint, Inputs};
use crate::failure::Failure;
use crate::loading::{self, LoadedModel, Mechanisms, Wanted, same_file};
use crate::output::OutputFolder;
use crate::progress::Progress;
use crate::story;

/// The files that tell of all recordings.
const SUMMARY: [&str; 2] = ["summary.json", "summary.html"];

/// What all diagnoses of a folder share.
struct Batch<'a> {
    loaded: LoadedModel,
    holdout: &'a [PathBuf],
    read: &'a Channels,
    wanted: Wanted,
    options: Options,
    /// Those beside the built-in ones.
    mechanisms: Vec<Fingerprint>,
}

/// One recording and where its results go.
struct Task {
    recording: PathBuf,
    /// Name of its folder of results.
    name: String,
    out: OutputFolder,
}

/// What became of a recording.
struct Diagnosed {
    statistics: Statistics,
    /// It was there from a run before.
    before: bool,
}

pub(super) fn run(arguments: &Arguments, folder: &Path, own: Option<&Mechanisms>) -> Result<Answer, Failure> {
    let (model, place) = (&arguments.inputs.model, &arguments.inputs.study.out);
    let holdout = &arguments.inputs.study.holdout;
    let read = &arguments.inputs.study.channels;
    let loaded = loading::model(model)?;
    let wanted = read.wanted().of_model(&loaded.model);
    // A fault in what judges all recordings is told once.
    Data::new(&loaded.model, &loading::recordings(holdout, &wanted)?)?;
    let recordings = recordings(folder, holdout)?;
    let inputs = || [model].into_iter().chain(holdout).chain(own.iter().flat_map(|own| &own.files));
    let out = OutputFolder::prepare(place)?;
    out.spares(&SUMMARY, inputs())?;
    let tasks = tasks(&recordings, place)?;
    for task in &tasks {
        task.out.spares(&[&FILES as &[&str], &[done::FILE]].concat(), inputs())?;
    }
    let batch = Batch {
        loaded,
        holdout,
        read,
        wanted,
        options: arguments.options(own),
        mechanisms: own
            .iter()
            .flat_map(|own| &own.texts)
            .map(|(name, text)| Fingerprint::of(name, text.as_bytes()))
            .collect(),
    };

    let kept = out.keep()?;
    let progress = Progress::steps(tasks.len() as u64);
    let outcomes = in_turn(&tasks, |task| {
        progress.stage(format!("diagnosing {}", task.name));
        let outcome = panic::catch_unwind(AssertUnwindSafe(|| batch.diagnosed(task)));
        progress.advance();
        outcome.unwrap_or_else(|_| Err(Failure::fault()))
    });
    drop(progress);

    let (mut parts, mut failures, mut before) = (Vec::new(), Vec::new(), 0);
    for (task, outcome) in tasks.iter().zip(outcomes) {
        match outcome {
            Ok(diagnosed) => {
                before += usize::from(diagnosed.before);
                parts.push(diagnosed.statistics);
            }
            Err(failure) => {
                let name = loading::file_name(&task.recording);
                parts.push(merge::failed(&name, failure.message(), failure.advice()));
                failures.push(failure);
            }
        }
    }
    if failures.len() == tasks.len() {
        kept.give_up();
        return Err(Failure::all(folder, "no recording of this folder could be diagnosed", &failures));
    }
    let summary = merge::conclude(
        merge::reduce(parts).map_err(unwritten)?,
        Producer { version: env!("CARGO_PKG_VERSION").to_owned(), seed: arguments.seed },
        ModelId { name: batch.loaded.model.name.clone(), file: batch.loaded.file.clone() },
    );
    let text = summary.to_json().map_err(unwritten)?;
    let html = summary.to_html().map_err(unwritten)?;
    let [json_name, html_name] = SUMMARY;
    out.write(&[(json_name, text.as_bytes()), (html_name, html.as_bytes())])?;

    let mut json: serde_json::Value = serde_json::from_str(&text).map_err(|e| unwritten(e.into()))?;
    json["done_before"] = json!(before);
    let resumed = match before {
        0 => String::new(),
        n => format!("{n} of {} done before.\n", tasks.len()),
    };
    let words = format!(
        "{}\n{resumed}Written: {1}/{html_name}, {1}/{json_name}, and a folder for each recording in {1}\n",
        story::summary(&summary) + &own.map(tried).unwrap_or_default(),
        place.display()
    );
    Ok(Answer::new(words, json))
}

/// The recordings of the folder that are not held out.
fn recordings(folder: &Path, holdout: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut recordings = loading::recordings_of(folder)?;
    recordings.retain(|path| !holdout.iter().any(|held| same_file(held, path)));
    if recordings.is_empty() {
        return Err(Failure::file(folder, "every recording of this folder is held out")
            .help("leave at least one of them to learn from"));
    }
    Ok(recordings)
}

/// A folder of results for each recording, called as the file without its ending.
fn tasks(recordings: &[PathBuf], place: &Path) -> Result<Vec<Task>, Failure> {
    let mut tasks: Vec<Task> = Vec::with_capacity(recordings.len());
    for recording in recordings {
        let name = recording.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let taken = match tasks.iter().find(|task| task.name == name) {
            Some(twin) => Some(twin.recording.display().to_string()),
            None => SUMMARY.iter().find(|file| **file == name).map(|file| (*file).to_owned()),
        };
        if let Some(other) = taken {
            return Err(Failure::file(
                recording,
                format!("its results would go where those of `{other}` go, to `{name}`"),
            )
            .help("rename the recording"));
        }
        let out = OutputFolder::prepare(&place.join(&name))?;
        tasks.push(Task { recording: recording.clone(), name, out });
    }
    Ok(tasks)
}

/// `work` on each item, on as many threads as rayon has; the results in the order of the items.
///
/// The threads are not rayon's own: one of those, waiting for a part of its recording, would begin another recording
/// meanwhile, and with every such wait one more would be in memory.
fn in_turn<T: Sync, R: Send>(items: &[T], work: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let next = AtomicUsize::new(0);
    let threads = rayon::current_num_threads().min(items.len());
    let mut done: Vec<(usize, R)> = thread::scope(|scope| {
        let turns = || {
            let mut mine = Vec::new();
            loop {
                let turn = next.fetch_add(1, Ordering::Relaxed);
                let Some(item) = items.get(turn) else { return mine };
                mine.push((turn, work(item)));
            }
        };
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(turns)).collect();
        workers.into_iter().flat_map(|w| w.join().unwrap_or_else(|e| panic::resume_unwind(e))).collect()
    });
    done.sort_by_key(|(turn, _)| *turn);
    done.into_iter().map(|(_, result)| result).collect()
}

impl Batch<'_> {
    /// Diagnoses a recording and writes its results, unless that was done before.
    ///
    /// # Errors
    /// As a diagnosis of this recording alone.
    fn diagnosed(&self, task: &Task) -> Result<Diagnosed, Failure> {
        let inputs = self.inputs(&task.recording)?;
        let [json_name, html_name, _] = FILES;
        let reported = |json: &str| {
            let page = format!("{}/{html_name}", task.name);
            let name = loading::file_name(&task.recording);
            Report::from_json(json).map(|report| merge::map(&name, Some(&page), &report))
        };
        if let Some(statistics) =
            Done::read(task.out.path(), &inputs, json_name).and_then(|json| reported(&json).ok())
        {
            return Ok(Diagnosed { statistics, before: true });
        }
        let (train, holdout) =
            loading::train_and_holdout(std::slice::from_ref(&task.recording), self.holdout, &self.wanted)?;
        let diagnosis =
            greybox_diagnose::diagnose(&self.loaded.model, &train, &holdout, &self.options, &Quiet)
                .map_err(|e| Failure::diagnosis(&self.loaded.path, e))?;
        let results = Results::of(&diagnosis, &self.loaded, &train, &holdout)?;
        let done = serde_json::to_string_pretty(&Done::new(inputs, &results.files()))
            .map_err(|e| unwritten(e.into()))?;
        task.out.write(&[&results.files()[..], &[(done::FILE, done.as_bytes())]].concat())?;
        Ok(Diagnosed { statistics: reported(&results.report_json).map_err(unwritten)?, before: false })
    }

    /// What the results of a recording depend on.
    ///
    /// # Errors
    /// Bad input: a file that cannot be read.
    fn inputs(&self, recording: &Path) -> Result<Inputs, Failure> {
        let paths: Vec<PathBuf> =
            [recording].into_iter().map(Path::to_owned).chain(self.holdout.iter().cloned()).collect();
        let fingerprint = |path: &Path| {
            let content = fs::read(path).map_err(|e| {
                Failure::file(path, format!("the file cannot be read: {e}")).help("check its permissions")
            })?;
            Ok(Fingerprint::of(loading::called(path, &paths), &content))
        };
        Ok(Inputs {
            greybox: env!("CARGO_PKG_VERSION").to_owned(),
            seed: self.options.seed,
            work: self.options.work,
            model: Fingerprint::of(&self.loaded.file, self.loaded.text.as_bytes()),
            recording: fingerprint(recording)?,
            holdout: self.holdout.iter().map(|path| fingerprint(path)).collect::<Result<_, Failure>>()?,
            map: self.read.names.map.iter().map(Rename::to_string).collect(),
            channels: self.read.only.clone(),
            mechanisms: self.mechanisms.clone(),
        })
    }
}

fn unwritten(error: ReportError) -> Failure {
    Failure::internal(error.to_string())
}
