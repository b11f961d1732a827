//! `--save-case`: without data it holds no value of a recording, with data it runs again to the same bytes.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(missing_docs, clippy::unwrap_used)]

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use common::{Bench, names};
use serde_json::Value;
use spring::{MODEL, recording};

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/spring.rs"]
mod spring;

/// A folder with the model and recordings whose channels have other names and units than the model.
fn bench() -> Bench {
    let bench = Bench::empty();
    fs::create_dir_all(bench.path("home/me")).unwrap();
    bench.write("home/me/model.toml", MODEL);
    let raw = |rows, phase| recording(rows, phase).replace("f [N],x [mm]", "f [N],sensor_3");
    bench.write("home/me/train.csv", &raw(400, 0.0));
    bench.write("home/me/test.csv", &raw(300, 1.0));
    bench
}

/// What follows `greybox` of a diagnosis, a calibration and an identification of the bench.
fn commands() -> [Vec<&'static str>; 3] {
    let files = ["home/me/train.csv", "--holdout", "home/me/test.csv", "--map", "x=sensor_3 [mm]"];
    let study = |command: &[&'static str]| [command, &files, &["--out", "out"]].concat();
    [
        [study(&["diagnose", "home/me/model.toml"]), vec!["--work", "2", "--seed", "7"]].concat(),
        study(&["calibrate", "home/me/model.toml"]),
        [study(&["identify"]), vec!["--states", "x", "--inputs", "f", "--work", "1", "--term", "x'*abs(x')"]]
            .concat(),
    ]
}

/// Every file below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { found.extend(files(&path)) } else { found.push(path) }
    }
    found.sort();
    found
}

/// The significant digits of every number of a text that has more than three.
fn numbers(text: &str) -> HashSet<String> {
    let digits = |token: &str| -> String {
        let mantissa = token.split(['e', 'E']).next().unwrap_or_default();
        let digits: String = mantissa.chars().filter(char::is_ascii_digit).collect();
        digits.trim_matches('0').to_owned()
    };
    let tokens = text.split(|c: char| !c.is_ascii_digit() && c != '.');
    tokens.map(digits).filter(|digits| digits.len() > 3).collect()
}

#[test]
fn a_case_without_data_holds_no_value_of_a_recording() {
    for command in commands() {
        let bench = bench();
        let run = bench.greybox(&[&command[..], &["--save-case", "case"]].concat());
        assert_eq!(run.code, 0, "{}", run.stderr);
        assert!(run.stdout.ends_with("Packed: case (without the recordings)\n"), "{}", run.stdout);

        let mut values = HashSet::new();
        for name in ["train.csv", "test.csv"] {
            for row in bench.read(&format!("home/me/{name}")).lines().skip(1) {
                values.extend(numbers(row.split_once(',').unwrap().1));
            }
        }
        assert!(values.len() > 1000, "the recordings have values to be found");
        for path in files(&bench.path("case")) {
            let text = fs::read_to_string(&path).unwrap();
            let kept: Vec<_> = numbers(&text).intersection(&values).cloned().collect();
            assert!(kept.is_empty(), "{}: {kept:?}", path.display());
            assert!(!text.contains("home/me") && !text.contains("home\\me"), "{}: {text}", path.display());
            assert!(!path.to_str().unwrap().ends_with(".html"), "curves: {}", path.display());
        }

        let case: Value = serde_json::from_str(&bench.read("case/case.json")).unwrap();
        assert_eq!(case["greybox"]["version"], env!("CARGO_PKG_VERSION"));
        assert_eq!(case["platform"]["os"], std::env::consts::OS);
        assert_eq!(case["with_data"], false);
        assert_eq!(case["outcome"]["report"], "results/report.json");
        let [train, test] = &case["recordings"].as_array().unwrap()[..] else { panic!("{case:#}") };
        assert_eq!((&train["rows"], &test["rows"]), (&400.into(), &300.into()));
        assert_eq!((&train["held_out"], &test["held_out"]), (&false.into(), &true.into()));
        assert_eq!(train["step_s"], 0.01);
        assert_eq!(train["channels"][1]["name"], "x");
        assert_eq!(train["channels"][1]["unit"], "mm");
        assert_eq!(train["channels"][1]["missing"], 0);
        assert!(train["channels"][1]["range"][0].as_f64().unwrap() < -10.0, "{train:#}");
        assert!(train["findings"].as_array().unwrap().iter().any(|f| f["code"] == "sampling"), "{train:#}");
        assert!(bench.path("case/results/report.json").is_file());
        assert_eq!(bench.path("case/model").is_dir(), command[0] != "identify");
    }
}

#[test]
fn a_case_with_data_runs_again_to_the_same_bytes() {
    for command in commands() {
        let bench = bench();
        let run = bench.greybox(&[&command[..], &["--save-case", "case", "--with-data"]].concat());
        assert_eq!(run.code, 0, "{}", run.stderr);
        // Nothing but the case is needed.
        fs::remove_dir_all(bench.path("home")).unwrap();
        let case: Value = serde_json::from_str(&bench.read("case/case.json")).unwrap();
        let again: Vec<&str> =
            case["command"].as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
        let readme = bench.read("case/README.md");
        assert!(readme.contains(&format!("greybox {} ", again[0])), "{readme}");
        Command::cargo_bin("greybox")
            .unwrap()
            .current_dir(bench.path("case"))
            .args(&again)
            .assert()
            .success();
        let made = names(&bench.path("case/rerun"));
        assert_eq!(made, names(&bench.path("case/results")));
        assert!(made.contains(&"report.json".to_owned()));
        for name in made {
            let [one, other] = ["out", "case/rerun"].map(|folder| bench.read(&format!("{folder}/{name}")));
            assert!(one == other, "{command:?}: {name} differs");
            assert!(
                one == bench.read(&format!("case/results/{name}")),
                "{command:?}: {name} was packed otherwise"
            );
        }
    }
}

/// The command of the README, as a shell reads it.
#[cfg(unix)]
#[test]
fn the_command_of_the_readme_is_the_command_of_the_case() {
    let bench = bench();
    let [.., identify] = commands();
    assert_eq!(bench.greybox(&[&identify[..], &["--save-case", "case", "--with-data"]].concat()).code, 0);
    let readme = bench.read("case/README.md");
    let line = readme.lines().find(|line| line.starts_with("greybox ")).unwrap();
    let said = std::process::Command::new("sh")
        .args(["-c", &line.replacen("greybox", "printf '%s\\n'", 1)])
        .output()
        .unwrap();
    let case: Value = serde_json::from_str(&bench.read("case/case.json")).unwrap();
    let words: Vec<&str> = case["command"].as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
    assert_eq!(String::from_utf8(said.stdout).unwrap().lines().collect::<Vec<_>>(), words);
}

/// A run that fails is what a case is for.
#[test]
fn a_run_that_fails_leaves_its_case() {
    let bench = bench();
    let train = bench.read("home/me/train.csv").replacen("\n0.03,", "\n0.03,\u{3a9}31.4159", 1);
    bench.write("home/me/train.csv", &train);
    let [diagnose, ..] = commands();
    let run = bench.greybox(&[&diagnose[..], &["--save-case", "case"]].concat());
    assert_eq!(run.code, 2, "{}", run.stdout);
    assert!(run.stderr.contains("31.4159"), "{}", run.stderr);
    assert!(!bench.path("out").exists());
    assert_eq!(names(&bench.path("case")), ["README.md", "case.json", "model"]);
    let text = bench.read("case/case.json");
    assert!(!text.contains("31.4159"), "{text}");
    let case: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(case["outcome"]["error"]["line"], 5, "{case:#}");
    assert_eq!(case["outcome"]["error"]["exit_code"], 2);
    assert_eq!(case["recordings"][0]["error"]["channel"], "f", "{case:#}");
    assert_eq!(case["recordings"][1]["rows"], 300);

    let run = bench.greybox(&[&diagnose[..], &["--save-case", "whole", "--with-data"]].concat());
    assert_eq!(run.code, 2);
    assert_eq!(bench.read("whole/recordings/train.csv"), train);
    assert!(bench.read("whole/case.json").contains("31.4159"));
}

#[test]
fn a_case_needs_a_place_of_its_own() {
    let bench = bench();
    fs::create_dir(bench.path("there")).unwrap();
    let [diagnose, _, identify] = commands();
    let refuses = |command: &[&str], more: &[&str], expected: &[&str]| {
        bench.refuses(&[command, more].concat(), expected);
    };
    refuses(&diagnose, &["--save-case", "there"], &["there: this is there already", "help: ", "--save-case"]);
    refuses(&diagnose, &["--save-case", "out"], &["out: the results would go into the case", "--save-case"]);
    refuses(
        &diagnose,
        &["--save-case", "home/me/model.toml/case"],
        &["is a file, not a folder", "--save-case"],
    );
    refuses(&diagnose, &["--with-data"], &["--save-case <CASE>"]);
    refuses(&identify, &["--block", "1000", "--save-case", "case"], &["cannot be used with"]);
    let folder = ["diagnose", "home/me/model.toml", "home/me", "--out", "out", "--save-case", "case"];
    bench.refuses(&folder, &["home/me: a case holds one diagnosis", "name the recording"]);
}
