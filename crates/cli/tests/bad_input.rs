//! Bad inputs, and what the command answers to each, to the byte.
//!
//! `bad_input/rows.rs` has the inputs; `UPDATE=1 cargo test -p greybox-cli --test bad_input` writes what the command says now to
//! `bad_input/answers.md`, and the first of each section to the book's page. Without it both must agree with the command.

// The words of the operating system stand in the page.
#![cfg(target_os = "linux")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(clippy::disallowed_methods, missing_docs, clippy::unwrap_used)]

use std::fmt::Write as _;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::os::unix::process::ExitStatusExt as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use common::Bench;
use rows::{Row, rows};
use serde_json::Value;
use spring::{MODEL, recording};

#[allow(dead_code, reason = "rows are run by a shell")]
mod common;
#[path = "bad_input/rows.rs"]
mod rows;
#[path = "common/spring.rs"]
mod spring;

/// Longest that a row may take.
const PATIENCE: Duration = Duration::from_secs(60);
/// Fewest rows.
const LEAST: usize = 60;
/// What stands around the generated part of the book's page.
const MARKS: (&str, &str) =
    ("<!-- begin of the generated examples -->\n\n", "<!-- end of the generated examples -->\n");

/// What a shell line left.
#[derive(Debug, PartialEq, Eq)]
struct Said {
    code: i32,
    stdout: String,
    stderr: String,
}

/// The folder in which every row begins.
fn bench() -> Bench {
    let bench = Bench::empty();
    bench.write("model.toml", MODEL);
    bench.write("run.csv", &recording(200, 0.0));
    bench
}

/// Runs a line as a shell would, with the built `greybox` first in the path.
fn shell(bench: &Bench, line: &str) -> Said {
    let folder = Path::new(env!("CARGO_BIN_EXE_greybox")).parent().unwrap();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap_or_default());
    let (out, err) = (tempfile::tempfile().unwrap(), tempfile::tempfile().unwrap());
    let mut child = Command::new("sh")
        .args(["-c", line])
        .current_dir(bench.path(""))
        .envs([("PATH", path.as_str()), ("LC_ALL", "C")])
        .stdin(Stdio::null())
        .stdout(out.try_clone().unwrap())
        .stderr(err.try_clone().unwrap())
        .spawn()
        .unwrap();
    let begun = Instant::now();
    let code = loop {
        match child.try_wait().unwrap() {
            Some(status) => break status.code().unwrap_or(-1),
            None if begun.elapsed() > PATIENCE => {
                child.kill().unwrap();
                panic!("`{line}` has not ended after {PATIENCE:?}");
            }
            None => thread::sleep(Duration::from_millis(2)),
        }
    };
    Said { code, stdout: text(out), stderr: text(err) }
}

fn text(mut file: fs::File) -> String {
    use std::io::{Read, Seek};
    file.rewind().unwrap();
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).unwrap();
    String::from_utf8(bytes).unwrap()
}

/// Every file below a folder with its content (of a folder: nothing), in the order of the paths.
fn tree(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned();
            if path.is_dir() {
                found.push((name, Vec::new()));
                open.push(path);
            } else {
                found.push((name, if path.is_file() { fs::read(path).unwrap() } else { Vec::new() }));
            }
        }
    }
    found.sort();
    found
}

/// Runs a row: what it says, and which of the rules that hold of every refusal it breaks.
fn said(row: &Row) -> (Said, Option<String>) {
    let bench = bench();
    (row.make)(&bench);
    let before = tree(&bench.path(""));
    let _held = row.held.map(|name| {
        let file = fs::File::open(bench.path(name)).unwrap();
        file.lock().unwrap();
        file
    });
    let said = shell(&bench, row.run);
    let errors = said.stderr.lines().filter(|line| line.starts_with("error: ")).count();
    let broken = [
        (said.code != row.code, "another exit status than the row says"),
        (said.stderr.contains("panicked"), "a panic"),
        (said.stdout.is_empty() && said.stderr.is_empty(), "nothing is said"),
        (
            row.code != 0 && tree(&bench.path("")) != before,
            "something is left behind, or an input was changed",
        ),
        (row.code != 0 && !said.stdout.is_empty(), "an error on standard output"),
        (row.code != 0 && errors != 1, "not one error"),
        (row.code != 0 && !json_agrees(&bench, row, &said), "another error as JSON"),
    ];
    let broken: Vec<&str> = broken.into_iter().filter_map(|(is, what)| is.then_some(what)).collect();
    let wrong =
        (!broken.is_empty()).then(|| format!("{} ({}): {}: {said:#?}", row.run, row.what, broken.join(", ")));
    (said, wrong)
}

/// Whether the same error comes as JSON, where the line is one command that can speak it.
fn json_agrees(bench: &Bench, row: &Row, words: &Said) -> bool {
    if row.run.contains(['|', '>', ';']) {
        return true;
    }
    let json = shell(bench, &format!("{} --json", row.run));
    let Ok(document) = serde_json::from_str::<Value>(&json.stdout) else { return false };
    let error = &document["error"];
    // How a command is to be called is told of the command as it was called: with `--json`.
    let reported = |key: &str| {
        let mut lines = error[key].as_str().into_iter().flat_map(str::lines);
        lines.all(|line| line.contains("Usage: ") || words.stderr.contains(line.trim()))
    };
    json.code == row.code
        && error["exit_code"] == row.code
        && error["message"].is_string()
        && reported("message")
        && reported("help")
}

/// An answer: its heading and what the terminal shows.
fn block(row: &Row, said: &Said) -> String {
    let mut text = format!("**{}**\n\n```text\n$ {}\n", row.what, row.run);
    text.push_str(&said.stdout);
    text.push_str(&said.stderr);
    assert!(text.ends_with('\n'), "{text}");
    writeln!(text, "```\n\nExit status {}.\n", said.code).unwrap();
    text
}

/// All answers, and those of the book's page: the first of each section.
fn answers(rows: &[Row], outcomes: &[Said]) -> (String, String) {
    let mut all = String::from(
        "# What the command answers to bad input\n\nWritten by `UPDATE=1 cargo test -p greybox-cli --test bad_input`.\n\n",
    );
    let mut page = String::new();
    let mut section = "";
    for (row, said) in rows.iter().zip(outcomes) {
        let block = block(row, said);
        if row.section != section {
            section = row.section;
            write!(all, "## {section}\n\n").unwrap();
            write!(page, "### {section}\n\n{block}").unwrap();
        }
        all.push_str(&block);
    }
    (all, page)
}

/// Writes the text with `UPDATE`; else it must be what is there, and the first block that is not is shown.
fn agree(now: &str, then: &str, write: impl FnOnce()) {
    if std::env::var_os("UPDATE").is_some() {
        return write();
    }
    for (now, then) in now.split("\n**").zip(then.split("\n**")) {
        assert_eq!(now, then, "the command has changed: look at the answer, and run this test with UPDATE=1");
    }
    assert_eq!(now, then, "answers are missing or too many: run this test with UPDATE=1");
}

/// All rows, on as many threads as there are processors.
fn run(rows: &[Row]) -> Vec<Said> {
    let threads = thread::available_parallelism().map_or(1, usize::from);
    thread::scope(|scope| {
        let part = |first: usize| rows.iter().skip(first).step_by(threads).map(said).collect::<Vec<_>>();
        let workers: Vec<_> = (0..threads).map(|first| scope.spawn(move || part(first))).collect();
        let mut parts: Vec<_> = workers.into_iter().map(|w| w.join().unwrap().into_iter()).collect();
        let (said, wrong): (Vec<_>, Vec<_>) =
            (0..rows.len()).map(|k| parts[k % threads].next().unwrap()).unzip();
        let wrong: Vec<String> = wrong.into_iter().flatten().collect();
        assert!(wrong.is_empty(), "{} rows break a rule:\n{}", wrong.len(), wrong.join("\n"));
        said
    })
}

#[test]
fn every_bad_input_is_answered_as_before() {
    let rows = rows();
    assert!(rows.len() >= LEAST, "only {} rows", rows.len());
    for (k, row) in rows.iter().enumerate() {
        assert!(rows[..k].iter().all(|other| other.what != row.what), "`{}` stands twice", row.what);
    }
    let (all, examples) = answers(&rows, &run(&rows));
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let file = package.join("tests/bad_input/answers.md");
    agree(&all, &fs::read_to_string(&file).unwrap_or_default(), || fs::write(&file, &all).unwrap());
    // The book is not in the package.
    let path = package.join("../../docs/src/bad-input.md");
    let Ok(page) = fs::read_to_string(&path) else { return };
    let (head, rest) = page.split_once(MARKS.0).unwrap();
    let (body, tail) = rest.split_once(MARKS.1).unwrap();
    agree(&examples, body, || {
        fs::write(&path, format!("{head}{}{examples}{}{tail}", MARKS.0, MARKS.1)).unwrap();
    });
}

/// Killed while it works, at the first step that it logs: nothing is there, and the same command runs.
#[test]
fn a_run_that_is_killed_leaves_nothing_and_runs_again() {
    let bench = bench();
    bench.write("run.csv", &recording(40_000, 0.0));
    let before = tree(&bench.path(""));
    let arguments = ["diagnose", "model.toml", "run.csv", "--out", "out"];
    let mut child = Command::new(env!("CARGO_BIN_EXE_greybox"))
        .current_dir(bench.path(""))
        .args(arguments)
        .arg("--log")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut step = String::new();
    // (Read until it is killed: a log that nobody reads would end it as well.)
    let mut log = BufReader::new(child.stderr.take().unwrap());
    log.read_line(&mut step).unwrap();
    assert!(!step.is_empty(), "it ended without a step");
    child.kill().unwrap();
    assert_eq!(child.wait().unwrap().signal(), Some(9), "it ended before it could be killed");
    drop(log);
    assert_eq!(tree(&bench.path("")), before);
    let again = bench.greybox(&[&arguments[..], &["--work", "1"]].concat());
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert_eq!(common::names(&bench.path("out")), ["improved.toml", "report.html", "report.json"]);
}

/// Of two runs into one folder, the folder holds all that one of them wrote.
#[test]
fn two_runs_at_once_leave_the_results_of_one() {
    let bench = bench();
    let line = |seed: u8, out: &str| {
        format!("greybox diagnose model.toml run.csv --work 1 --seed {seed} --out {out} > {seed}.txt")
    };
    let said = shell(&bench, &format!("{} & {} & wait", line(1, "out"), line(2, "out")));
    assert_eq!(said, Said { code: 0, stdout: String::new(), stderr: String::new() });
    let alone = [1, 2].map(|seed| {
        let out = format!("alone{seed}");
        assert_eq!(shell(&bench, &line(seed, &out)).code, 0);
        tree(&bench.path(&out))
    });
    assert_ne!(alone[0], alone[1], "the seed is told");
    let both = tree(&bench.path("out"));
    assert!(alone.contains(&both), "a mixture: {:?}", both.iter().map(|(name, _)| name).collect::<Vec<_>>());
}

/// A byte order mark and line ends of other systems are no fault.
#[test]
fn a_mark_at_the_beginning_is_no_fault() {
    let bench = bench();
    let plain = shell(&bench, "greybox check run.csv");
    assert_eq!(plain.code, 0, "{plain:?}");
    let run = bench.read("run.csv");
    for text in [format!("\u{feff}{run}"), run.replace('\n', "\r\n"), run.trim_end().to_owned()] {
        bench.write("run.csv", &text);
        assert_eq!(shell(&bench, "greybox check run.csv"), plain);
    }
}
