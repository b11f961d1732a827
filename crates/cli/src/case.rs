//! `--save-case`: what another needs to see why a command did what it did.

use std::any::Any;
use std::collections::HashSet;
use std::fs;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};

use clap::Args;
use greybox_commands::case::{Values, masked, statistics};
use greybox_commands::check::check_for_model;
use greybox_model::Model;
use greybox_recording::{Finding, Location, Recording, health};
use serde_json::{Value, json};

use crate::answer::Answer;
use crate::channels::Channels;
use crate::failure::Failure;
use crate::loading;
use crate::output::{Content, OutputFolder};

/// What is packed to report a fault.
#[derive(Debug, Args)]
pub(crate) struct CaseOptions {
    /// Pack what a report of a fault needs into this new folder: command, version, platform, model, options, statistics of
    /// the channels and the report, without the data; also where the command fails
    #[arg(long, value_name = "CASE")]
    save_case: Option<PathBuf>,

    /// Add the recordings to the case, so that it runs again by one command
    #[arg(long, requires = "save_case")]
    with_data: bool,
}

/// What a command reads and writes.
pub(crate) struct Subject<'a> {
    pub(crate) model: Option<&'a Path>,
    pub(crate) train: &'a [PathBuf],
    pub(crate) holdout: &'a [PathBuf],
    pub(crate) read: &'a Channels,
    /// Folder of mechanisms beside the built-in ones.
    pub(crate) mechanisms: Option<&'a Path>,
    /// The channels that drive the machine and those that follow, where no model says so.
    pub(crate) channels: (&'a [String], &'a [String]),
    pub(crate) out: &'a Path,
    /// The results.
    pub(crate) files: &'a [&'a str],
}

const HELP: &str =
    "name a folder after `--save-case` that is not there yet, in a place that you may write to";

/// The one result that holds no curves.
const REPORT: &str = "report.json";

impl CaseOptions {
    /// Does the work, and packs the case where one is asked for, whatever became of the work.
    ///
    /// # Errors
    /// Those of the work; bad input where the case cannot be written.
    pub(crate) fn around(
        &self,
        subject: &Subject<'_>,
        work: impl FnOnce() -> Result<Answer, Failure>,
    ) -> Result<Answer, Failure> {
        let Some(path) = &self.save_case else { return work() };
        let folder = prepare(path, subject)?;
        let mut panic = None;
        let outcome = panic::catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|payload| {
            panic = Some(words(payload.as_ref()));
            Err(Failure::fault().help(format!("send the folder {} with it", path.display())))
        });
        let data = if self.with_data { "with the recordings" } else { "without the recordings" };
        let written = folder.write_new(&self.files(subject, &outcome, panic.as_deref()));
        let written = written.map_err(|failure| failure.help(HELP));
        let mut answer = outcome?;
        written?;
        answer.add(&format!("Packed: {} ({data})\n", path.display()));
        Ok(answer)
    }

    /// The files of the case, by name.
    fn files(
        &self,
        subject: &Subject<'_>,
        outcome: &Result<Answer, Failure>,
        panic: Option<&str>,
    ) -> Vec<(String, Content)> {
        let model = subject.model.and_then(|path| loading::model(path).ok()).map(|loaded| loaded.model);
        let files = Inputs::of(subject);
        let read: Vec<Result<Recording, Failure>> =
            files.recordings.iter().map(|(path, _)| recording(path, subject, model.as_ref())).collect();
        let values = match self.with_data {
            true => Values::default(),
            false => Values::of(read.iter().flatten()),
        };
        let document = self.document(subject, &files, model.as_ref(), &read, outcome, panic);
        let mut packed = vec![
            ("case.json".to_owned(), Content::Text(values.taken_out_of(&format!("{document:#}\n")))),
            ("README.md".to_owned(), Content::Text(self.readme(&files))),
        ];
        let copied = |(path, name): &(PathBuf, String)| (name.clone(), Content::Copy(path.clone()));
        packed.extend(
            files.model.iter().chain(&files.mechanisms).filter(|(path, _)| path.is_file()).map(copied),
        );
        if self.with_data {
            packed.extend(files.data().filter(|(path, _)| path.is_file()).map(|file| copied(&file)));
        }
        if outcome.is_ok() {
            let reported = subject.files.iter().filter(|name| self.with_data || !name.ends_with(".html"));
            packed.extend(reported.filter_map(|name| {
                let text = fs::read_to_string(subject.out.join(name)).ok()?;
                Some((format!("results/{name}"), Content::Text(values.taken_out_of(&text))))
            }));
        }
        packed
    }

    fn document(
        &self,
        subject: &Subject<'_>,
        files: &Inputs,
        model: Option<&Model>,
        read: &[Result<Recording, Failure>],
        outcome: &Result<Answer, Failure>,
        panic: Option<&str>,
    ) -> Value {
        let recordings: Vec<Value> = files
            .recordings
            .iter()
            .zip(read)
            .enumerate()
            .map(|(k, ((path, name), read))| {
                let mut reported = match read {
                    Ok(recording) => statistics(recording, &findings(recording, model, subject)),
                    Err(failure) => self.reported(failure, true),
                };
                reported["file"] = json!(name);
                reported["held_out"] = json!(k >= subject.train.len());
                reported["bytes"] = json!(fs::metadata(Location::of(path).file).map(|m| m.len()).ok());
                reported
            })
            .collect();
        let unread = read.iter().any(Result::is_err);
        json!({
            "greybox": { "version": env!("CARGO_PKG_VERSION"), "formats": formats() },
            "platform": {
                "os": std::env::consts::OS,
                "arch": std::env::consts::ARCH,
                "threads": rayon::current_num_threads(),
            },
            "command": files.command(),
            "with_data": self.with_data,
            "model": files.model.as_ref().map(|(_, name)| name),
            "recordings": recordings,
            "outcome": match (outcome, panic) {
                (_, Some(words)) => json!({ "panic": words }),
                (Err(failure), _) => self.reported(failure, unread),
                (Ok(_), _) => json!({ "report": format!("results/{REPORT}") }),
            },
        })
    }

    /// An error, without what it quotes of a recording that could not be read.
    fn reported(&self, failure: &Failure, quotes: bool) -> Value {
        let mut reported = failure.to_json();
        if quotes && !self.with_data {
            for key in ["message", "help"] {
                if let Some(text) = reported["error"][key].as_str().map(masked) {
                    reported["error"][key] = json!(text);
                }
            }
        }
        reported
    }

    fn readme(&self, files: &Inputs) -> String {
        let names: String = files.recordings.iter().map(|(_, name)| format!("- `{name}`\n")).collect();
        let data = match self.with_data {
            true => "The recordings are here:".to_owned(),
            false => "No value of a recording is in it; `case.json` has their sizes, sampling, ranges and health. To run \
                      it again, these are needed:"
                .to_owned(),
        };
        format!(
            "# A case of greybox {}\n\nWhat is needed to see again what a run did. {data}\n\n{names}\nIn this folder, run\n\n\
             ```sh\ngreybox {}\n```\n\nand compare `rerun` with `results` (which is not there where the run failed: \
             `outcome` of `case.json` says how).\n",
            env!("CARGO_PKG_VERSION"),
            files.command().iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" "),
        )
    }
}

/// The folder of a case, which is new and holds no results.
fn prepare(path: &Path, subject: &Subject<'_>) -> Result<OutputFolder, Failure> {
    if let Some(folder) = subject.train.iter().chain(subject.holdout).find(|path| path.is_dir()) {
        return Err(Failure::file(
            folder,
            "a case holds one diagnosis, not one for each recording of a folder",
        )
        .help("name the recording that the case is about"));
    }
    if path.exists() {
        return Err(Failure::file(path, "this is there already, but a case needs a new folder").help(HELP));
    }
    if subject.out.starts_with(path) {
        return Err(Failure::file(path, "the results would go into the case").help(HELP));
    }
    OutputFolder::prepare(path).map_err(|failure| failure.help(HELP))
}

/// The recording as the command sees it.
fn recording(path: &Path, subject: &Subject<'_>, model: Option<&Model>) -> Result<Recording, Failure> {
    let wanted = subject.read.wanted();
    let (inputs, states) = subject.channels;
    let wanted = match model {
        Some(model) => wanted.of_model(model),
        None => wanted.of_names(inputs.iter().chain(states).map(|name| vec![name.clone()])),
    };
    // Whatever the reader does to this file, the case is written.
    let read = panic::catch_unwind(AssertUnwindSafe(|| loading::recordings(&[path.to_owned()], &wanted)));
    read.unwrap_or_else(|_| Err(Failure::fault()))?.pop().ok_or_else(Failure::fault)
}

fn findings(recording: &Recording, model: Option<&Model>, subject: &Subject<'_>) -> Vec<Finding> {
    fn borrowed(names: &[String]) -> Vec<&str> {
        names.iter().map(String::as_str).collect()
    }
    match model {
        Some(model) => check_for_model(recording, model),
        None => health::check(recording, &borrowed(subject.channels.0), &borrowed(subject.channels.1)),
    }
}

/// Formats of recordings that this build reads.
fn formats() -> Vec<&'static str> {
    [
        ("csv", true),
        ("mat", cfg!(feature = "mat")),
        ("hdf5", cfg!(feature = "hdf5")),
        ("npz", cfg!(feature = "npz")),
        ("mcap", cfg!(feature = "mcap")),
        ("parquet", cfg!(feature = "parquet")),
    ]
    .into_iter()
    .filter_map(|(name, built)| built.then_some(name))
    .collect()
}

/// What a panic says.
fn words(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| payload.downcast_ref::<&str>().copied()).unwrap_or("no words").to_owned()
}

/// The files that a command reads, with their names in the case.
struct Inputs {
    model: Option<(PathBuf, String)>,
    recordings: Vec<(PathBuf, String)>,
    mechanisms: Vec<(PathBuf, String)>,
    folder: Option<PathBuf>,
}

impl Inputs {
    fn of(subject: &Subject<'_>) -> Inputs {
        let paths: Vec<&PathBuf> = subject.train.iter().chain(subject.holdout).collect();
        let files: Vec<PathBuf> = paths.iter().map(|path| Location::of(path).file).collect();
        let named = |k: usize| {
            let name = loading::file_name(&files[k]);
            let is_twin = |file: &PathBuf| *file != files[k] && loading::file_name(file) == name;
            // Episodes of a file lie in one copy of it.
            let first = files.iter().position(|file| *file == files[k]).unwrap_or(k);
            let folder = if files.iter().any(is_twin) { format!("{}/", first + 1) } else { String::new() };
            (paths[k].clone(), format!("recordings/{folder}{}", loading::file_name(paths[k])))
        };
        let mine = |folder: &Path| loading::files_of(folder, &["toml"]).unwrap_or_default();
        let inside = |path: PathBuf, place: &str| {
            let name = format!("{place}/{}", loading::file_name(&path));
            (path, name)
        };
        Inputs {
            model: subject.model.map(|path| inside(path.to_owned(), "model")),
            recordings: (0..paths.len()).map(named).collect(),
            mechanisms: subject
                .mechanisms
                .map(mine)
                .unwrap_or_default()
                .into_iter()
                .map(|path| inside(path, "mechanisms"))
                .collect(),
            folder: subject.mechanisms.map(Path::to_owned),
        }
    }

    /// The files of the recordings, each once, with their names in the case.
    fn data(&self) -> impl Iterator<Item = (PathBuf, String)> {
        let mut seen = HashSet::new();
        let file = |(path, name): &(PathBuf, String)| {
            let Location { file, episode } = Location::of(path);
            let name = match episode {
                Some(episode) => name.strip_suffix(&format!("#{episode}")).unwrap_or(name),
                None => name,
            };
            (file, name.to_owned())
        };
        self.recordings.iter().map(file).filter(move |(file, _)| seen.insert(file.clone()))
    }

    /// The arguments of this process, with the files of the case in the place of their own and the results in `rerun`.
    fn command(&self) -> Vec<String> {
        let arguments = std::env::args_os().skip(1).map(|a| a.to_string_lossy().into_owned());
        self.renamed(arguments)
    }

    fn renamed(&self, arguments: impl Iterator<Item = String>) -> Vec<String> {
        let mut out: Vec<String> = Vec::new();
        let mut skip = false;
        for argument in arguments {
            if std::mem::take(&mut skip) {
                continue;
            }
            match argument.split_once('=') {
                _ if matches!(argument.as_str(), "--with-data" | "--json" | "--log") => {}
                _ if matches!(argument.as_str(), "--save-case" | "--out") => skip = true,
                Some(("--save-case" | "--out", _)) => {}
                Some((option @ ("--holdout" | "--mechanisms"), path)) => {
                    out.push(format!("{option}={}", self.in_case(path)));
                }
                _ => out.push(self.in_case(&argument)),
            }
        }
        out.extend(["--out".to_owned(), "rerun".to_owned()]);
        out
    }

    /// A path's name in the case; anything else as it is.
    fn in_case(&self, argument: &str) -> String {
        if self.folder.as_deref() == Some(Path::new(argument)) {
            return "mechanisms".to_owned();
        }
        let files = self.model.iter().chain(&self.recordings);
        let mut named = files.filter(|(path, _)| path == Path::new(argument)).map(|(_, name)| name.clone());
        named.next().unwrap_or_else(|| argument.to_owned())
    }
}

/// A word of a command as a shell reads it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:+".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn renamed(arguments: &[&str]) -> Vec<String> {
        let inputs = Inputs {
            model: Some(("/elsewhere/me/m.toml".into(), "model/m.toml".into())),
            recordings: vec![
                ("a/run.csv".into(), "recordings/1/run.csv".into()),
                ("b/run.csv".into(), "recordings/2/run.csv".into()),
            ],
            mechanisms: vec![],
            folder: Some("../mine".into()),
        };
        inputs.renamed(arguments.iter().map(|a| (*a).to_owned()))
    }

    #[test]
    fn a_case_names_no_place_of_its_maker() {
        let reported = renamed(&[
            "diagnose",
            "/elsewhere/me/m.toml",
            "a/run.csv",
            "--holdout=b/run.csv",
            "--mechanisms",
            "../mine",
            "--seed",
            "3",
            "--out",
            "/elsewhere/me/out",
            "--save-case=c",
            "--with-data",
            "--json",
            "--map",
            "x=s [mm]",
        ]);
        assert_eq!(
            reported.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" "),
            "diagnose model/m.toml recordings/1/run.csv --holdout=recordings/2/run.csv --mechanisms mechanisms --seed 3 \
             --map 'x=s [mm]' --out rerun"
        );
    }

    #[test]
    fn words_are_quoted_for_a_shell() {
        assert_eq!(quoted("it's"), r"'it'\''s'");
        assert_eq!(quoted(""), "''");
        assert_eq!(quoted("x'*abs(x')"), r"'x'\''*abs(x'\'')'");
    }

    #[test]
    fn a_panic_is_told_in_its_words() {
        let reported = |work: fn()| words(panic::catch_unwind(work).unwrap_err().as_ref());
        assert_eq!(reported(|| panic!("an index {}", 3)), "an index 3");
        assert_eq!(reported(|| panic!("plain")), "plain");
    }
}
