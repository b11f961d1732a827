//! Runs of `greybox diagnose` on real recordings: the same question is put once, whoever asks.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result};
use greybox_report::Report;

use greybox_dev::process::{self, Measured};

/// A model with its recordings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Question {
    pub(crate) model: PathBuf,
    pub(crate) train: Vec<PathBuf>,
    pub(crate) holdout: Vec<PathBuf>,
}

impl Question {
    /// Of the files of a folder.
    pub(crate) fn of(folder: &Path, model: &str, train: &[String], holdout: &[String]) -> Question {
        let at = |files: &[String]| files.iter().map(|file| folder.join(file)).collect();
        Question { model: folder.join(model), train: at(train), holdout: at(holdout) }
    }
}

/// How the run went, and its report, or why there is none.
#[derive(Debug)]
pub(crate) struct Answered {
    pub(crate) run: Measured,
    pub(crate) report: Result<Report, String>,
}

/// The runs so far.
#[derive(Debug)]
pub(crate) struct Runs<'a> {
    binary: &'a Path,
    limit: Duration,
    done: Vec<(Question, Answered)>,
}

impl<'a> Runs<'a> {
    /// None yet: of this binary, each no longer than `limit`.
    pub(crate) fn new(binary: &'a Path, limit: Duration) -> Runs<'a> {
        Runs { binary, limit, done: Vec::new() }
    }

    /// The answer to a question, its files in `out` when it was not answered before.
    ///
    /// # Errors
    /// When the binary cannot be started or `out` cannot be written.
    pub(crate) fn ask(&mut self, question: &Question, out: &Path) -> Result<&Answered> {
        let known = self.done.iter().position(|(asked, _)| asked == question);
        let at = match known {
            Some(at) => at,
            None => {
                let answered = self.diagnose(question, out)?;
                self.done.push((question.clone(), answered));
                self.done.len() - 1
            }
        };
        Ok(&self.done[at].1)
    }

    fn diagnose(&self, question: &Question, out: &Path) -> Result<Answered> {
        // A report of an earlier run must not be taken for this one's.
        if out.exists() {
            std::fs::remove_dir_all(out).with_context(|| format!("{} cannot be emptied", out.display()))?;
        }
        std::fs::create_dir_all(out).with_context(|| format!("{} cannot be made", out.display()))?;
        let mut command = Command::new(self.binary);
        command.arg("diagnose").arg(&question.model).args(&question.train);
        for file in &question.holdout {
            command.arg("--holdout").arg(file);
        }
        command.arg("--out").arg(out);
        let run = process::run(&mut command, out, self.limit)?;
        let report = report_of(&run, out);
        Ok(Answered { run, report })
    }
}

/// The report that a run left in `out`, or why there is none.
pub(crate) fn report_of(run: &Measured, out: &Path) -> Result<Report, String> {
    match run.status {
        None => Err(format!("stopped after {:.0} s", run.seconds)),
        Some(status) if !status.success() => {
            let said = std::fs::read_to_string(out.join("stderr.txt")).unwrap_or_default();
            let first = said.lines().find(|l| !l.trim().is_empty()).unwrap_or("no message").trim();
            Err(format!("{status}: {first}"))
        }
        Some(_) => std::fs::read_to_string(out.join("report.json"))
            .map_err(|e| format!("report.json: {e}"))
            .and_then(|text| Report::from_json(&text).map_err(|e| e.to_string())),
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    /// A stand-in for greybox that counts its runs.
    #[test]
    fn the_same_question_is_put_once() {
        use std::os::unix::fs::PermissionsExt;
        let place = tempfile::tempdir().unwrap();
        let (binary, count) = (place.path().join("stand-in"), place.path().join("count"));
        std::fs::write(&binary, format!("#!/bin/sh\necho run >> {}\nexit 2\n", count.display())).unwrap();
        std::fs::set_permissions(&binary, std::fs::Permissions::from_mode(0o755)).unwrap();
        let mut runs = Runs::new(&binary, Duration::from_secs(20));
        let question = |model: &str| Question::of(Path::new("here"), model, &["a.csv".to_owned()], &[]);
        for (model, out) in [("one.toml", "1"), ("one.toml", "2"), ("two.toml", "3")] {
            let answered = runs.ask(&question(model), &place.path().join(out)).unwrap();
            assert!(answered.report.is_err());
        }
        assert_eq!(std::fs::read_to_string(&count).unwrap(), "run\nrun\n");
        assert!(place.path().join("1").is_dir() && !place.path().join("2").exists());
    }
}
