//! A folder to run the command in, and what must hold of every run.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use serde_json::Value;
use tempfile::TempDir;

/// A folder of its own.
pub(crate) struct Bench {
    folder: TempDir,
}

/// What a run of the command left.
pub(crate) struct Outcome {
    pub(crate) code: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Bench {
    /// An empty folder.
    pub(crate) fn empty() -> Bench {
        Bench { folder: tempfile::tempdir().unwrap() }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn write(&self, name: &str, content: &str) {
        fs::write(self.path(name), content).unwrap();
    }

    pub(crate) fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    pub(crate) fn names(&self) -> Vec<String> {
        names(self.folder.path())
    }

    /// Runs `greybox` in the folder.
    pub(crate) fn greybox(&self, arguments: &[&str]) -> Outcome {
        self.greybox_with(arguments, &[])
    }

    pub(crate) fn greybox_with(&self, arguments: &[&str], environment: &[(&str, &str)]) -> Outcome {
        let mut command = Command::cargo_bin("greybox").unwrap();
        command.current_dir(self.folder.path()).args(arguments).envs(environment.iter().copied());
        let output = command.output().unwrap();
        Outcome {
            code: output.status.code().unwrap(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }

    /// Runs `greybox` in the folder with this on standard input.
    pub(crate) fn greybox_fed(&self, arguments: &[&str], input: &str) -> Outcome {
        let mut command = Command::cargo_bin("greybox").unwrap();
        let output =
            command.current_dir(self.folder.path()).args(arguments).write_stdin(input).output().unwrap();
        Outcome {
            code: output.status.code().unwrap(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }

    pub(crate) fn json(&self, arguments: &[&str]) -> Value {
        let outcome = self.greybox(&[arguments, &["--json"]].concat());
        assert_eq!(outcome.code, 0, "{}", outcome.stderr);
        serde_json::from_str(&outcome.stdout).unwrap()
    }

    /// Runs `greybox`, which must refuse with exit 2, one error that holds all of `expected`, and nothing
    /// written; the same error must come as JSON.
    #[track_caller]
    pub(crate) fn refuses(&self, arguments: &[&str], expected: &[&str]) {
        let before = self.names();
        let outcome = self.greybox(arguments);
        let error = outcome.stderr;
        assert_eq!(outcome.code, 2, "{arguments:?}: {error}");
        assert_eq!(error.matches("error: ").count(), 1, "{error}");
        for part in expected {
            assert!(error.contains(part), "{arguments:?}: `{part}` is not in: {error}");
        }
        assert!(outcome.stdout.is_empty(), "{}", outcome.stdout);
        let outcome = self.greybox(&[arguments, &["--json"]].concat());
        assert_eq!(outcome.code, 2);
        let json: Value = serde_json::from_str(&outcome.stdout).unwrap();
        assert_eq!(json["error"]["exit_code"], 2, "{json}");
        assert!(json["error"]["message"].is_string(), "{json}");
        assert_eq!(self.names(), before, "{arguments:?} left something behind");
    }
}

/// The files of a folder, sorted.
pub(crate) fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}
