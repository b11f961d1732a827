//! The demo as a user meets it, and as the README shows it.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use common::{Bench, names};
use serde_json::Value;

#[allow(dead_code)]
mod common;

#[test]
fn demo_tells_the_story_and_writes_what_it_shows() {
    let bench = Bench::empty();
    let outcome = bench.greybox(&["demo", "--out", "demo"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    assert!(outcome.stdout.contains("Coulomb friction is missing in the hub equation"), "{}", outcome.stdout);
    assert!(outcome.stdout.contains("held out, θ"), "{}", outcome.stdout);
    assert!(!outcome.stdout.contains("limit of work"), "{}", outcome.stdout);
    // The README shows this answer; its last digits may be another machine's.
    let readme = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../README.md")).unwrap();
    let readme = readme.replace("\r\n", "\n");
    let shown = readme.split("```text\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let without_digits = |text: &str| text.replace(|c: char| c.is_ascii_digit(), "");
    assert!(shown.lines().count() > 5, "{shown}");
    assert!(without_digits(&outcome.stdout).contains(&without_digits(shown)), "{}", outcome.stdout);

    let json: Value = serde_json::from_str(&bench.read("demo/report.json")).unwrap();
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
    assert_eq!(names(&bench.path("demo")), files);
    // The files that it leaves simulate as well as the report says.
    for (model, said) in [("improved.toml", "improved"), ("rotary_link.toml", "nominal")] {
        let said = json["fit"]["holdout"][said]["theta"]["nrmse"].as_f64().unwrap();
        let model = format!("demo/{model}");
        let run = bench.json(&["simulate", &model, "demo/rotary_link_test.csv", "--out", "s.csv"]);
        let nrmse = run["fit"]["theta"]["nrmse"].as_f64().unwrap();
        assert!((nrmse / said - 1.0).abs() < 0.05, "{model}: {nrmse} {said}");
    }
    // The friction level is the rig's within 15 % (other physics stays unmodelled).
    let fc = json["mechanisms"][0]["parameters"]["fc"]["value"].as_f64().unwrap();
    assert!((fc / 0.0148 - 1.0).abs() < 0.15, "{fc}");
}
