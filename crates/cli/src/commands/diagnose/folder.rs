//! `greybox diagnose` on a folder: every recording by itself, and what they say together.

use std::fs;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use greybox_commands::diagnose::FILES;
use greybox_commands::fleet::{self, Channels, DONE, File, Fleet, Member, SUMMARY, Table};
use greybox_diagnose::Quiet;
use greybox_report::summary::Statistics;
use serde_json::json;

use super::{Arguments, tried};
use crate::answer::Answer;
use crate::failure::Failure;
use crate::loading::{self, Mechanisms, same_file};
use crate::output::OutputFolder;
use crate::progress::Progress;

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
    loading::no_twins(holdout)?;
    let held = holdout.iter().map(|path| file(path)).collect::<Result<_, _>>()?;
    let texts = own.map_or(&[][..], |own| &own.texts);
    // A fault in what judges all recordings is reported once.
    let channels = Channels { map: read.names.map.clone(), only: read.only.clone() };
    let fleet = Fleet::new(loaded, held, channels, arguments.options(own), texts)?;
    let recordings = recordings(folder, holdout, arguments.runs.as_deref())?;
    let inputs = || {
        [model].into_iter().chain(holdout).chain(&arguments.runs).chain(own.iter().flat_map(|own| &own.files))
    };
    let out = OutputFolder::prepare(place)?;
    out.spares(&SUMMARY, inputs())?;
    let tasks = tasks(&recordings, place)?;
    let table = arguments.runs.as_deref().map(|path| table(path, &recordings)).transpose()?;
    for task in &tasks {
        task.out.spares(&[&FILES as &[&str], &[DONE]].concat(), inputs())?;
    }
    let kept = out.keep()?;
    let progress = Progress::steps(tasks.len() as u64);
    let outcomes = in_turn(&tasks, |task| {
        progress.stage(format!("diagnosing {}", task.name));
        let outcome = panic::catch_unwind(AssertUnwindSafe(|| diagnosed(&fleet, task)));
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
                parts.push(fleet::failed(&name, &failure));
                failures.push(failure);
            }
        }
    }
    if failures.len() == tasks.len() {
        kept.give_up();
        return Err(Failure::all(folder, "no recording of this folder could be diagnosed", &failures));
    }
    let model = fleet.model();
    let summary = fleet::conclude(parts, table.as_ref(), &model.model.name, &model.file, arguments.seed)?;
    let [json_name, html_name] = SUMMARY;
    out.write(&[(json_name, summary.json.as_bytes()), (html_name, summary.html.as_bytes())])?;

    let mut json: serde_json::Value =
        serde_json::from_str(&summary.json).map_err(|e| fleet::unwritten(e.into()))?;
    json["done_before"] = json!(before);
    let resumed = match before {
        0 => String::new(),
        n => format!("{n} of {} done before.\n", tasks.len()),
    };
    let words = format!(
        "{}\n{resumed}Written: {1}/{html_name}, {1}/{json_name}, and a folder for each recording in {1}\n",
        summary.story + &own.map(tried).unwrap_or_default(),
        place.display()
    );
    Ok(Answer::new(words, json))
}

/// The recordings of the folder that are not held out, episodes one by one; a table of them is none.
fn recordings(folder: &Path, holdout: &[PathBuf], table: Option<&Path>) -> Result<Vec<PathBuf>, Failure> {
    let mut recordings = loading::recordings_of(folder)?;
    recordings.retain(|path| !table.is_some_and(|table| same_file(table, path)));
    recordings.retain(|path| !holdout.iter().any(|held| same_file(held, path)));
    if recordings.is_empty() {
        return Err(Failure::file(folder, "every recording of this folder is held out")
            .help("leave at least one of them to learn from"));
    }
    Ok(recordings)
}

/// The table of the recordings.
fn table(path: &Path, recordings: &[PathBuf]) -> Result<Table, Failure> {
    let names: Vec<String> = recordings.iter().map(|path| loading::file_name(path)).collect();
    Table::new(&loading::text(path)?, &path.display().to_string(), names.iter().map(String::as_str))
}

/// A folder of results for each recording.
fn tasks(recordings: &[PathBuf], place: &Path) -> Result<Vec<Task>, Failure> {
    let mut tasks: Vec<Task> = Vec::with_capacity(recordings.len());
    for recording in recordings {
        let name = fleet::folder_of(recording);
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

/// Diagnoses a recording and writes its results, unless that was done before.
///
/// # Errors
/// As a diagnosis of this recording alone.
fn diagnosed(fleet: &Fleet, task: &Task) -> Result<Diagnosed, Failure> {
    let file = file(&task.recording)?;
    let name = loading::file_name(&task.recording);
    let member = Member { file: &file, name: &name, folder: &task.name };
    let read = |name: &str| fs::read(task.out.path().join(name)).ok();
    if let Some(statistics) = fleet.finished(member, read) {
        return Ok(Diagnosed { statistics, before: true });
    }
    let outcome = fleet.diagnose(member, &Quiet)?;
    let files: Vec<(&str, &[u8])> = outcome.files.iter().map(|(name, c)| (*name, c.as_slice())).collect();
    task.out.write(&files)?;
    Ok(Diagnosed { statistics: outcome.statistics, before: false })
}

fn file(path: &Path) -> Result<File, Failure> {
    Ok(File { path: path.to_owned(), bytes: loading::content(path)? })
}
