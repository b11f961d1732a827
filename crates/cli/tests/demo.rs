//! The demo as a user meets it, and as the README shows it.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::{env, fs};

use common::{Bench, names};
use serde_json::Value;

#[allow(dead_code)]
mod common;

/// What `greybox demo --out out` answered and left: as run by someone else in the folder `$GREYBOX_DEMO`, with the answer in
/// `answer.txt`, or here.
fn demo(bench: &Bench) -> (String, PathBuf) {
    if let Some(folder) = env::var_os("GREYBOX_DEMO").map(PathBuf::from) {
        return (fs::read_to_string(folder.join("answer.txt")).unwrap(), folder.join("out"));
    }
    let outcome = bench.greybox(&["demo", "--out", "out"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    (outcome.stdout, bench.path("out"))
}

#[test]
#[ignore = "diagnoses for minutes: `cargo test --package greybox-cli --test demo -- --ignored`; CI runs it on what the README's command leaves"]
fn demo_tells_the_story_and_writes_what_it_shows() {
    let bench = Bench::empty();
    let (answer, out) = demo(&bench);
    assert!(answer.contains("Coulomb friction is missing in the hub equation"), "{answer}");
    assert!(answer.contains("held out, θ"), "{answer}");
    assert!(!answer.contains("limit of work"), "{answer}");
    // The README shows this answer; its last digits may be another machine's.
    let readme = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../README.md")).unwrap();
    let readme = readme.replace("\r\n", "\n");
    let shown = readme.split("```text\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let without_digits = |text: &str| text.replace(|c: char| c.is_ascii_digit(), "");
    assert!(shown.lines().count() > 5, "{shown}");
    assert!(without_digits(&answer).contains(&without_digits(shown)), "{answer}");

    let json: Value = serde_json::from_str(&fs::read_to_string(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(json["verdict"], "missing_physics");
    assert_eq!(json["mechanisms"][0]["kind"], "coulomb_friction");
    let files = [
        "improved.toml",
        "report.html",
        "report.json",
        "rotary_link.toml",
        "rotary_link_test.csv",
        "rotary_link_train.csv",
    ];
    assert_eq!(names(&out), files);
    // The files that it leaves simulate as well as the report says.
    for (model, said) in [("improved.toml", "improved"), ("rotary_link.toml", "nominal")] {
        let said = json["fit"]["holdout"][said]["theta"]["nrmse"].as_f64().unwrap();
        let [model, recording] = [model, "rotary_link_test.csv"].map(|name| out.join(name));
        let [model, recording] = [&model, &recording].map(|path| path.to_str().unwrap());
        let run = bench.json(&["simulate", model, recording, "--out", "s.csv"]);
        let nrmse = run["fit"]["theta"]["nrmse"].as_f64().unwrap();
        assert!((nrmse / said - 1.0).abs() < 0.05, "{model}: {nrmse} {said}");
    }
    // The friction level is the rig's within 15 % (other physics stays unmodelled).
    let fc = json["mechanisms"][0]["parameters"]["fc"]["value"].as_f64().unwrap();
    assert!((fc / 0.0148 - 1.0).abs() < 0.15, "{fc}");
}
