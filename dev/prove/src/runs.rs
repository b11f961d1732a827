//! Runs of `greybox diagnose` on real recordings: the same question is put once, whoever asks.

use std::cmp::Reverse;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
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

    /// Bytes of its recordings: what has many of them takes long.
    fn size(&self) -> u64 {
        self.train.iter().map(|file| std::fs::metadata(file).map_or(0, |m| m.len())).sum()
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
    /// Threads of each; as many as it likes where nothing is stated.
    threads: Option<usize>,
    done: Vec<(Question, Answered)>,
}

impl<'a> Runs<'a> {
    /// None yet: of this binary, each no longer than `limit`.
    pub(crate) fn new(binary: &'a Path, limit: Duration) -> Runs<'a> {
        Runs { binary, limit, threads: None, done: Vec::new() }
    }

    /// Answers questions beforehand, `jobs` at a time, which share the machine: each has its part of the cores, and that much
    /// more time. Those with the largest recordings come first, so that no long one is left at the end.
    ///
    /// # Errors
    /// As [`ask`](Self::ask).
    pub(crate) fn ask_ahead(&mut self, questions: Vec<(Question, PathBuf)>, jobs: usize) -> Result<()> {
        let jobs = jobs.max(1);
        let mut open: Vec<(Question, PathBuf)> = Vec::new();
        for (question, out) in questions {
            if !open.iter().any(|(asked, _)| *asked == question) {
                open.push((question, out));
            }
        }
        open.sort_by_key(|(question, _)| Reverse(question.size()));
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let each = Runs {
            limit: self.limit.saturating_mul(jobs.try_into().unwrap_or(u32::MAX)),
            threads: Some((cores / jobs).max(1)),
            ..Runs::new(self.binary, self.limit)
        };
        let answered = in_order(&open, jobs, |(question, out)| {
            eprintln!("{} …", question.model.display());
            each.diagnose(question, out)
        })?;
        self.done.extend(open.into_iter().map(|(question, _)| question).zip(answered));
        Ok(())
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
        if let Some(threads) = self.threads {
            command.env("RAYON_NUM_THREADS", threads.to_string());
        }
        let run = process::run(&mut command, out, self.limit)?;
        let report = report_of(&run, out);
        Ok(Answered { run, report })
    }
}

/// Works through items in their order, several at a time; the results in the same order. After an error nothing new is begun.
///
/// # Errors
/// The first error of an item.
pub(crate) fn in_order<I: Sync, T: Send>(
    items: &[I],
    jobs: usize,
    work: impl Fn(&I) -> Result<T> + Sync,
) -> Result<Vec<T>> {
    let next = AtomicUsize::new(0);
    let results: Mutex<Vec<(usize, Result<T>)>> = Mutex::default();
    std::thread::scope(|scope| {
        for _ in 0..jobs.max(1) {
            scope.spawn(|| {
                loop {
                    let i = next.fetch_add(1, Ordering::Relaxed);
                    let Some(item) = items.get(i) else { break };
                    let result = work(item);
                    if result.is_err() {
                        next.store(items.len(), Ordering::Relaxed);
                    }
                    results.lock().unwrap_or_else(PoisonError::into_inner).push((i, result));
                }
            });
        }
    });
    let mut results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    results.sort_by_key(|r| r.0);
    results.into_iter().map(|(_, result)| result).collect()
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

    /// A program in the place of greybox.
    #[allow(clippy::unwrap_used, reason = "a test")]
    fn stand_in(binary: &Path, line: &str) {
        use std::os::unix::fs::PermissionsExt;
        std::fs::write(binary, format!("#!/bin/sh\n{line}\nexit 2\n")).unwrap();
        std::fs::set_permissions(binary, std::fs::Permissions::from_mode(0o755)).unwrap();
    }

    /// A stand-in that counts its runs.
    #[test]
    fn the_same_question_is_put_once() {
        let place = tempfile::tempdir().unwrap();
        let (binary, count) = (place.path().join("stand-in"), place.path().join("count"));
        stand_in(&binary, &format!("echo run >> {}", count.display()));
        let mut runs = Runs::new(&binary, Duration::from_secs(20));
        let question = |model: &str| Question::of(Path::new("here"), model, &["a.csv".to_owned()], &[]);
        for (model, out) in [("one.toml", "1"), ("one.toml", "2"), ("two.toml", "3")] {
            let answered = runs.ask(&question(model), &place.path().join(out)).unwrap();
            assert!(answered.report.is_err());
        }
        assert_eq!(std::fs::read_to_string(&count).unwrap(), "run\nrun\n");
        assert!(place.path().join("1").is_dir() && !place.path().join("2").exists());
    }

    /// A stand-in that writes down the model and how many threads it may have.
    #[test]
    fn questions_are_answered_ahead_the_largest_first() {
        let place = tempfile::tempdir().unwrap();
        let (binary, log) = (place.path().join("stand-in"), place.path().join("log"));
        stand_in(&binary, &format!("echo $2 $RAYON_NUM_THREADS >> {}", log.display()));
        for (file, bytes) in [("short.csv", 10), ("long.csv", 1000)] {
            std::fs::write(place.path().join(file), vec![b'0'; bytes]).unwrap();
        }
        let question = |model: &str, file: &str| {
            let question = Question::of(place.path(), model, &[file.to_owned()], &[]);
            (Question { model: model.into(), ..question }, place.path().join(model))
        };
        let (short, long) = (question("short", "short.csv"), question("long", "long.csv"));
        let mut runs = Runs::new(&binary, Duration::from_secs(20));
        runs.ask_ahead(vec![short.clone(), long.clone(), short.clone()], 1).unwrap();
        let cores = std::thread::available_parallelism().unwrap();
        let once = format!("long {cores}\nshort {cores}\n");
        assert_eq!(std::fs::read_to_string(&log).unwrap(), once);
        for (question, out) in [&short, &long] {
            runs.ask(question, out).unwrap();
        }
        assert_eq!(
            std::fs::read_to_string(&log).unwrap(),
            once,
            "what was answered ahead is not asked again"
        );
        // (As many at a time as there are cores: a thread each.)
        let mut runs = Runs::new(&binary, Duration::from_secs(20));
        runs.ask_ahead(vec![long.clone()], cores.get()).unwrap();
        assert!(std::fs::read_to_string(&log).unwrap().ends_with("long 1\n"));
    }
}
