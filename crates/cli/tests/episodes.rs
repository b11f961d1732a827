//! The commands on a Parquet file of several episodes (feature `parquet`).
#![cfg(feature = "parquet")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(missing_docs, clippy::unwrap_used)]

use std::fs;

use common::{Bench, names};
use serde_json::{Value, json};
use spring::{MODEL, recording};

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/spring.rs"]
mod spring;

/// The model without its damping, and a folder `runs` of a file with the episodes 0 to 3, of which the last is too short
/// (`tests/parquet/make.py`), and one of another format.
fn bench() -> Bench {
    let bench = Bench::empty();
    let damping = ("b*x' + ", "b = { value = 0.5, unit = \"N s/m\" } # a guess\n");
    bench.write("model.toml", &MODEL.replace(damping.0, "").replace(damping.1, ""));
    fs::create_dir(bench.path("runs")).unwrap();
    fs::write(bench.path("runs/data.parquet"), include_bytes!("parquet/episodes.parquet")).unwrap();
    bench.write("runs/monday.csv", &recording(400, 3.0));
    bench
}

const DIAGNOSE: [&str; 5] = ["diagnose", "model.toml", "runs", "--out", "out"];

#[test]
fn each_episode_of_a_folder_is_a_recording() {
    let bench = bench();
    let run = bench.greybox(&DIAGNOSE);
    assert_eq!(run.code, 0, "{}", run.stderr);
    for part in [
        "4 recordings diagnosed: physics is missing in 4; 1 recording could not be diagnosed.\n",
        "\n  data.parquet#1  missing physics  viscous friction\n",
        "\nNote: data.parquet#3 could not be diagnosed: runs/data.parquet#3",
    ] {
        assert!(run.stdout.contains(part), "`{part}` is not in:\n{}", run.stdout);
    }
    let folders = ["data.parquet.0", "data.parquet.1", "data.parquet.2", "monday"];
    assert_eq!(names(&bench.path("out")), [&folders as &[&str], &["summary.html", "summary.json"]].concat());
    let summary: Value = serde_json::from_str(&bench.read("out/summary.json")).unwrap();
    assert_eq!(summary["recordings"][1]["recording"], "data.parquet#1");
    assert_eq!(summary["recordings"][1]["page"], "data.parquet.1/report.html");
    assert_eq!(summary["recordings"][1]["samples"], json!({"train": 360, "holdout": 90}));
    assert_eq!(summary["failed"][0]["recording"], "data.parquet#3");
    assert!(bench.read("out/summary.html").contains("href=\"data.parquet.1/report.html\""));

    // What stands in the folder of an episode is what its diagnosis alone writes.
    let alone = bench.greybox(&["diagnose", "model.toml", "runs/data.parquet#1", "--out", "alone"]);
    assert_eq!(alone.code, 0, "{}", alone.stderr);
    for file in names(&bench.path("alone")) {
        let kept = bench.read(&format!("out/data.parquet.1/{file}"));
        assert_eq!(bench.read(&format!("alone/{file}")), kept, "{file}");
    }

    // What is done is not done again; a lost mark is.
    fs::remove_file(bench.path("out/data.parquet.2/done.json")).unwrap();
    let mut again = bench.json(&DIAGNOSE);
    assert_eq!(again.as_object_mut().unwrap().remove("done_before"), Some(json!(3)));
    assert_eq!(again, summary);
}

#[test]
fn an_episode_is_held_out_by_its_name_and_has_a_row_of_its_own() {
    let bench = bench();
    let held = ["--holdout", "runs/../runs/data.parquet#2", "runs/data.parquet#0"];
    bench.write("table.csv", "recording,machine\ndata.parquet#1,A\ndata.parquet#3,B\nmonday.csv,A\n");
    let json = bench.json(&[&DIAGNOSE as &[&str], &held, &["--runs", "table.csv"]].concat());
    let of = |key: &str| -> Vec<(&Value, &Value)> {
        json[key].as_array().unwrap().iter().map(|r| (&r["recording"], &r["run"]["machine"])).collect()
    };
    let machine = json!("A");
    assert_eq!(of("recordings"), [(&json!("data.parquet#1"), &machine), (&json!("monday.csv"), &machine)]);
    assert_eq!(json["recordings"][1]["samples"], json!({"train": 400, "holdout": 820}));
    let report: Value = serde_json::from_str(&bench.read("out/monday/report.json")).unwrap();
    let held = "recordings held out: data.parquet#2, data.parquet#0";
    assert_eq!(report["fit"]["holdout_source"], held);

    bench.write("table.csv", "recording,machine\ndata.parquet,A\nmonday.csv,A\n");
    let refused = [&DIAGNOSE as &[&str], &["--runs", "table.csv"]].concat();
    bench.refuses(&refused, &["table.csv", "data.parquet#0"]);
    bench.write("runs/data.parquet.1.csv", &recording(400, 0.0));
    bench.refuses(&DIAGNOSE, &["would go where those of", "data.parquet.1"]);
}

#[test]
fn check_takes_the_episodes_of_a_folder_apart() {
    let bench = bench();
    let run = bench.greybox(&["check", "runs"]);
    assert_eq!(run.code, 2, "{}", run.stdout);
    for name in ["data.parquet#0: ", "data.parquet#1: ", "data.parquet#2: ", "monday.csv: "] {
        assert_eq!(
            run.stdout.matches(&format!("\n{name}")).count() + usize::from(run.stdout.starts_with(name)),
            1
        );
    }
    assert!(run.stderr.contains("runs/data.parquet#3: the recording has 3 rows"), "{}", run.stderr);
    let one = bench.greybox(&["check", "runs/data.parquet#0", "runs/data.parquet#1"]);
    assert_eq!(one.code, 0, "{}", one.stderr);
}

#[test]
fn what_names_no_episode_is_refused() {
    let bench = bench();
    for (name, parts) in [
        ("runs/data.parquet", &["holds 4 episodes (0 … 3", "`data.parquet#0`", "`data.parquet#{0..3}`"][..]),
        ("runs/data.parquet#9", &["runs/data.parquet#9: the file has no episode 9", "0 … 3"]),
        ("runs/monday.csv#0", &["runs/monday.csv#0: `#0` names an episode", "name the file without it"]),
        ("none.parquet#0", &["none.parquet: no such file"]),
    ] {
        bench.refuses(&["check", name], parts);
    }
    for twins in
        [["runs/data.parquet#0", "./runs/data.parquet#0"], ["runs/data.parquet#0", "runs/data.parquet"]]
    {
        bench.refuses(&[&["check"] as &[&str], &twins].concat(), &["named twice", twins[0]]);
    }
    let model = ["diagnose", "runs/data.parquet#0", "runs/data.parquet#1", "--out", "out"];
    bench.refuses(&model, &["this is a recording, but a model (TOML) is needed here"]);
    let blocks = [
        "identify",
        "runs/data.parquet#0",
        "--block",
        "1000",
        "--inputs",
        "f",
        "--states",
        "x",
        "--out",
        "out",
    ];
    bench.refuses(&blocks, &["only CSV files are read in blocks"]);
}

/// Both episodes lie in one copy of their file.
#[test]
fn a_case_of_episodes_runs_again() {
    let bench = bench();
    let command = ["diagnose", "model.toml", "runs/data.parquet#0", "--holdout", "runs/data.parquet#1"];
    let saved = ["--out", "out", "--save-case", "case", "--with-data"];
    let run = bench.greybox(&[&command as &[&str], &saved].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(names(&bench.path("case/recordings")), ["data.parquet"]);
    let case: Value = serde_json::from_str(&bench.read("case/case.json")).unwrap();
    assert_eq!(case["recordings"][1]["file"], "recordings/data.parquet#1");
    assert_eq!(case["recordings"][1]["bytes"], fs::metadata(bench.path("runs/data.parquet")).unwrap().len());
    let again: Vec<&str> = case["command"].as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
    let rerun = assert_cmd::Command::cargo_bin("greybox")
        .unwrap()
        .current_dir(bench.path("case"))
        .args(&again)
        .output()
        .unwrap();
    assert!(rerun.status.success(), "{rerun:?}");
    assert_eq!(bench.read("case/rerun/report.json"), bench.read("out/report.json"));
}
