//! The `greybox` command as a user meets it: help, results, and one clear error for every bad input.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(clippy::unwrap_used)]

use std::fs;

use common::{Bench, names};
use serde_json::Value;
use spring::{MODEL, TRUTH, recording};

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/spring.rs"]
mod spring;

/// A folder with `model.toml`, `run1.csv` and `run2.csv`.
fn bench() -> Bench {
    let bench = Bench::empty();
    bench.write("model.toml", MODEL);
    bench.write("run1.csv", &recording(1200, 0.0));
    bench.write("run2.csv", &recording(900, 1.0));
    bench
}

/// Cells of a column, by position.
fn column(csv: &str, index: usize) -> Vec<Option<f64>> {
    csv.lines().skip(1).map(|row| row.split(',').nth(index).unwrap().parse().ok()).collect()
}

// --- Help --------------------------------------------------------------------------------------------------

#[test]
fn every_help_has_an_example() {
    let bench = bench();
    for command in [&["--help"] as &[&str], &["diagnose", "--help"], &["calibrate", "--help"]]
        .into_iter()
        .chain([&["simulate", "--help"] as &[&str], &["check", "--help"], &["demo", "--help"]])
        .chain([&["identify", "--help"] as &[&str], &["mechanisms", "--help"]])
    {
        let outcome = bench.greybox(command);
        assert_eq!(outcome.code, 0);
        assert!(outcome.stdout.contains("Example"), "{command:?}");
        assert!(outcome.stdout.contains("\n  greybox "), "{command:?}");
        assert!(outcome.stderr.is_empty());
    }
    assert!(bench.greybox(&["--version"]).stdout.starts_with("greybox "));
}

// --- Results -----------------------------------------------------------------------------------------------

#[test]
fn check_says_what_each_channel_feeds() {
    let bench = bench();
    let outcome = bench.greybox(&["check", "run1.csv", "--model", "model.toml"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    assert!(outcome.stdout.starts_with("run1.csv: healthy\n"), "{}", outcome.stdout);
    assert!(outcome.stdout.contains("input f (N, linear hold)"), "{}", outcome.stdout);
    assert!(outcome.stdout.contains("measurement of x (mm → m)"), "{}", outcome.stdout);
    let json = bench.json(&["check", "run1.csv", "--inputs", "f"]);
    assert_eq!(json["recordings"][0]["dt_s"], 0.01);
    assert_eq!(json["recordings"][0]["channels"][1]["unit"], "mm");
    assert!(json["recordings"][0]["findings"].as_array().unwrap().iter().any(|f| f["code"] == "excitation"));
}

#[test]
fn what_recordings_have_in_common_is_one_line() {
    let bench = bench();
    // Both rounded to fewer than fifty steps.
    for name in ["run1.csv", "run2.csv", "run3.csv"] {
        let run = recording(if name == "run2.csv" { 900 } else { 1200 }, 0.0);
        let mut rows = run.lines();
        let mut text = format!("{}\n", rows.next().unwrap());
        let cells: Vec<Vec<f64>> =
            rows.map(|row| row.split(',').map(|cell| cell.parse().unwrap()).collect()).collect();
        let largest = cells.iter().map(|row| row[2].abs()).fold(0.0, f64::max);
        for row in cells {
            let step = largest / 15.0;
            text.push_str(&format!("{},{},{:.6}\n", row[0], row[1], (row[2] / step).round() * step));
        }
        bench.write(name, &text);
    }
    let files = ["run1.csv", "run2.csv", "run3.csv"];
    let reported = bench.greybox(&[&["check"], &files[..], &["--model", "model.toml"]].concat()).stdout;
    assert!(reported.starts_with("run1.csv: usable, 1 warning\nrun2.csv: usable, "), "{reported}");
    assert_eq!(reported.matches("Use a finer sensor").count(), 1, "{reported}");
    let place = "x in 3 recordings (run1.csv, run2.csv, run3.csv): The values come in steps of";
    assert!(reported.contains(&format!("  warning  {place}")), "{reported}");
    let json = bench.json(&[&["check"], &files[..], &["--model", "model.toml"]].concat());
    for k in 0..3 {
        let findings = json["recordings"][k]["findings"].as_array().unwrap();
        assert!(findings.iter().any(|f| f["code"] == "quantisation"), "{findings:#?}");
    }
    let fit = ["calibrate", "model.toml", "run1.csv", "run2.csv", "--holdout", "run3.csv", "--out", "out"];
    let reported = bench.greybox(&fit).stdout;
    assert_eq!(reported.matches("Use a finer sensor").count(), 1, "{reported}");
    assert!(reported.contains(&format!("Note: {place}")), "{reported}");
}

#[test]
fn check_names_the_gap_and_still_exits_0() {
    let bench = bench();
    let whole = recording(600, 0.0);
    let holed: Vec<&str> =
        whole.lines().enumerate().filter(|(i, _)| !(200..260).contains(i)).map(|l| l.1).collect();
    bench.write("holed.csv", &holed.join("\n"));
    let outcome = bench.greybox(&["check", "holed.csv"]);
    assert_eq!(outcome.code, 0);
    assert!(
        outcome.stdout.contains("60 rows are missing") && outcome.stdout.contains("help:"),
        "{}",
        outcome.stdout
    );
}

#[test]
fn calibrate_finds_the_parameters_and_keeps_comments() {
    let bench = bench();
    let json = bench.json(&["calibrate", "model.toml", "run1.csv", "--holdout", "run2.csv", "--out", "a/b"]);
    assert!((json["parameters"]["k"]["value"].as_f64().unwrap() - TRUTH.1).abs() < 0.1, "{json}");
    assert!((json["parameters"]["b"]["value"].as_f64().unwrap() - TRUTH.0).abs() < 0.02, "{json}");
    assert_eq!(json["parameters"]["m"]["value"], 1.0);
    let holdout = &json["fit"]["holdout"];
    assert!(holdout["calibrated"]["x"]["nrmse"].as_f64().unwrap() < 0.01, "{holdout}");
    assert!(holdout["nominal"]["x"]["nrmse"].as_f64().unwrap() > 0.2, "{holdout}");
    assert_eq!(names(&bench.path("a/b")), ["model.toml", "report.json"]);
    let written: Value = serde_json::from_str(&bench.read("a/b/report.json")).unwrap();
    assert_eq!(written, json);
    let model = bench.read("a/b/model.toml");
    assert!(model.contains("# a guess") && model.contains("# measured in mm"), "{model}");
    assert!(!model.contains("value = 0.5,"), "{model}");
}

#[test]
fn what_calibrate_writes_simulates_as_well_as_it_says() {
    let bench = bench();
    let json = bench.json(&["calibrate", "model.toml", "run1.csv", "--holdout", "run2.csv", "--out", "out"]);
    let said = json["fit"]["holdout"]["calibrated"]["x"]["nrmse"].as_f64().unwrap();
    let run = bench.json(&["simulate", "out/model.toml", "run2.csv", "--out", "simulated.csv"]);
    assert_eq!(run["rows"], 900);
    let nrmse = run["fit"]["x"]["nrmse"].as_f64().unwrap();
    assert!((nrmse / said - 1.0).abs() < 0.05, "{nrmse} {said}");
}

#[test]
fn without_a_holdout_the_last_fifth_is_held_out() {
    let bench = bench();
    let json = bench.json(&["calibrate", "model.toml", "run1.csv", "--out", "out"]);
    let source = json["fit"]["holdout_source"].as_str().unwrap();
    assert!(source.starts_with("the last fifth of each"), "{source}");
    assert!(json["fit"]["holdout"]["calibrated"]["x"]["nrmse"].as_f64().unwrap() < 0.02);
}

#[test]
fn simulate_keeps_names_units_and_rows() {
    let bench = bench();
    let input = bench.read("run1.csv");
    let truth = MODEL.replace("0.5", "0.8").replace("30.0", "25.0");
    bench.write("truth.toml", &truth);
    let outcome = bench.greybox(&["simulate", "truth.toml", "run1.csv", "--out", "new/simulated.csv"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    assert!(outcome.stdout.contains("nrmse"), "{}", outcome.stdout);
    let simulated = bench.read("new/simulated.csv");
    assert_eq!(simulated.lines().next(), Some("t,x [mm]"));
    assert_eq!(column(&simulated, 0), column(&input, 0));
    let pairs = column(&simulated, 1).into_iter().zip(column(&input, 2));
    let worst = pairs.map(|(s, m)| (s.unwrap() - m.unwrap()).abs()).fold(0.0, f64::max);
    assert!(worst < 1.5, "mm: {worst}");
    assert_eq!(names(&bench.path("new")), ["simulated.csv"]);
}

#[test]
fn rows_outside_the_pieces_stay_empty() {
    let bench = bench();
    let whole = recording(600, 0.0);
    // Rows 300 … 303 stand alone between two gaps.
    let keep = |i: usize| i < 201 || (301..305).contains(&i) || i > 400;
    let holed: Vec<&str> = whole.lines().enumerate().filter(|(i, _)| keep(*i)).map(|l| l.1).collect();
    bench.write("holed.csv", &holed.join("\n"));
    let json = bench.json(&["simulate", "model.toml", "holed.csv", "--out", "out.csv"]);
    assert_eq!(json["empty_rows"], 4);
    let x = column(&bench.read("out.csv"), 1);
    assert_eq!(x.len(), 404);
    let empty: Vec<usize> = (0..x.len()).filter(|&i| x[i].is_none()).collect();
    assert_eq!(empty, [200, 201, 202, 203]);
}

// --- Refusals ----------------------------------------------------------------------------------------------

/// Every command that reads a model and a recording.
fn with_both<'a>(model: &'a str, recording: &'a str) -> [Vec<&'a str>; 4] {
    [
        vec!["diagnose", model, recording, "--out", "out"],
        vec!["calibrate", model, recording, "--out", "out"],
        vec!["simulate", model, recording, "--out", "out.csv"],
        vec!["check", recording, "--model", model],
    ]
}

#[test]
fn a_bad_model_is_shown_with_its_line_and_help() {
    let bench = bench();
    let cases: [(&str, &str, &[&str]); 5] = [
        (
            "k*x = f",
            "kk*x = f",
            &["equation \"body\"", "`kk` is not defined", "bad.toml:15:", "^^\n", "help:", "`k`"],
        ),
        ("b*x' + k*x = f", "b*x' + k*x = m", &["equation \"body\"", "bad.toml:15:", "`m`", "kg"]),
        ("k*x = f\"\n", "k*x = f\"\nagain = \"x'' = 0\"\n", &["bad.toml:", "2 equations", "1 state"]),
        ("value = 30.0", "valu = 30.0", &["bad.toml:12:", "`valu`", "help:", "`value`"]),
        ("[parameters]", "[parameters", &["bad.toml:9:", "TOML"]),
    ];
    for (good, bad, expected) in cases {
        bench.write("bad.toml", &MODEL.replacen(good, bad, 1));
        for arguments in with_both("bad.toml", "run1.csv") {
            bench.refuses(&arguments, expected);
        }
    }
}

#[test]
fn a_bad_recording_is_named_with_line_and_column() {
    let bench = bench();
    let good = recording(100, 0.0);
    let line4: Vec<&str> = good.lines().nth(3).unwrap().split(',').collect();
    let with_cell =
        |cell: &str| good.replacen(&line4.join(","), &format!("{},{},{cell}", line4[0], line4[1]), 1);
    let cases: [(String, &[&str]); 6] = [
        (with_cell("NaN"), &["bad.csv:4:x (column 3)", "`NaN`", "leave the cell empty"]),
        (with_cell("broken"), &["bad.csv:4:x (column 3)", "`broken` is not a number"]),
        (String::new(), &["bad.csv", "the file is empty", "header row"]),
        (good.replacen("x [mm]", "y [mm]", 1), &["bad.csv", "no channel `x`", "`f`, `y`", "--map x="]),
        (good.replacen("x [mm]", "x [kg]", 1), &["bad.csv", "`x` is in [kg]", "`m`"]),
        (good.lines().take(4).collect::<Vec<_>>().join("\n"), &["bad.csv", "3 rows", "8 are needed"]),
    ];
    for (content, expected) in cases {
        bench.write("bad.csv", &content);
        for arguments in with_both("model.toml", "bad.csv") {
            bench.refuses(&arguments, expected);
        }
    }
}

#[test]
fn paths_that_lead_to_the_wrong_thing() {
    let bench = bench();
    fs::create_dir(bench.path("folder")).unwrap();
    for arguments in with_both("model.toml", "nowhere.csv") {
        bench.refuses(&arguments, &["nowhere.csv", "no such file"]);
    }
    for arguments in with_both("nowhere.toml", "run1.csv") {
        bench.refuses(&arguments, &["nowhere.toml", "no such file", "help:"]);
    }
    // `diagnose` and `check` take a folder of recordings.
    for arguments in with_both("model.toml", "folder") {
        let found = match arguments[0] {
            "diagnose" | "check" => "this folder holds no recording",
            _ => "this is a folder",
        };
        bench.refuses(&arguments, &["folder", found]);
    }
    for arguments in with_both("folder", "run1.csv") {
        bench.refuses(&arguments, &["folder", "this is a folder", "help:"]);
    }
    for arguments in with_both("run1.csv", "model.toml") {
        bench.refuses(&arguments, &["run1.csv", "this is a recording", "help:"]);
    }
    for arguments in with_both("model.toml", "model.toml") {
        bench.refuses(&arguments, &["model.toml", "this is a model", "help:"]);
    }
    bench.refuses(
        &["calibrate", "model.toml", "run1.csv", "--holdout", "./run1.csv", "--out", "out"],
        &["run1.csv", "named twice", "help:"],
    );
    bench.refuses(&["check", "run1.csv", "--inputs", "g"], &["run1.csv", "no channel `g`", "`f`, `x`"]);
}

#[test]
fn outputs_that_cannot_be_written() {
    let bench = bench();
    bench.write("file", "mine");
    for command in ["diagnose", "calibrate"] {
        bench.refuses(
            &[command, "model.toml", "run1.csv", "--out", "file"],
            &["file", "need a folder", "help:"],
        );
        bench.refuses(
            &[command, "model.toml", "run1.csv", "--out", "file/under"],
            &["file/under", "`file` is a file", "help:"],
        );
    }
    let simulate = |out| ["simulate", "model.toml", "run1.csv", "--out", out];
    bench.refuses(&simulate("file/under.csv"), &["file", "help:"]);
    bench.refuses(&simulate("."), &["this is a folder", "help:"]);
    bench.refuses(&simulate("run1.csv"), &["run1.csv", "overwrite", "help:"]);
    // Results never replace what the command reads, nor does the demo replace the user's files.
    bench.refuses(
        &["calibrate", "model.toml", "run1.csv", "--out", "."],
        &["model.toml", "overwrite", "help:"],
    );
    bench.write("improved.toml", MODEL);
    bench.refuses(&["diagnose", "improved.toml", "run1.csv", "--out", "."], &["improved.toml", "overwrite"]);
    bench.write("cart.toml", MODEL);
    bench.refuses(&["demo", "--out", "."], &["cart.toml", "not of this demo", "help:"]);
    bench.write("rotary_link.toml", MODEL);
    bench.refuses(&["demo", "link", "--out", "."], &["rotary_link.toml", "not of this demo", "help:"]);
    assert_eq!(bench.read("model.toml"), MODEL);
    assert_eq!(bench.read("file"), "mine");
    assert_eq!(bench.read("run1.csv"), recording(1200, 0.0));
}

#[cfg(target_os = "linux")]
#[test]
fn a_place_that_nobody_may_write_to() {
    let bench = bench();
    bench.refuses(
        &["calibrate", "model.toml", "run1.csv", "--out", "/proc/greybox"],
        &["/proc/greybox", "cannot be written", "help:"],
    );
}

#[test]
fn bad_usage() {
    let bench = bench();
    bench.refuses(
        &["diagnose", "model.toml", "run1.csv", "--out", "out", "--sead", "1"],
        &["--sead", "--seed"],
    );
    bench.refuses(&["diagnose", "model.toml", "run1.csv", "--out", "out", "--seed", "x"], &["--seed", "'x'"]);
    bench.refuses(&["diagnose", "model.toml", "--out", "out"], &["TRAIN.csv"]);
    bench.refuses(&["calibrate", "model.toml", "run1.csv"], &["--out"]);
    bench.refuses(&["check"], &["RECORDING.csv"]);
    bench.refuses(&["chek", "run1.csv"], &["chek", "check"]);
    bench.refuses(&[], &["no command", "greybox diagnose"]);
}

#[test]
fn nothing_free_to_calibrate_is_an_error_with_its_help() {
    let bench = bench();
    let fixed = MODEL
        .replace("\"N s/m\" }", "\"N s/m\", fixed = true }")
        .replace("\"N/m\" }", "\"N/m\", fixed = true }");
    bench.write("fixed.toml", &fixed);
    bench.refuses(
        &["calibrate", "fixed.toml", "run1.csv", "--out", "out"],
        &["every parameter is fixed", "help:"],
    );
}

#[test]
fn a_json_error_has_its_place_in_fields() {
    let bench = bench();
    bench.write("bad.toml", &MODEL.replace("k*x = f", "kk*x = f"));
    let outcome = bench.greybox(&["check", "run1.csv", "--model", "bad.toml", "--json"]);
    let json: Value = serde_json::from_str(&outcome.stdout).unwrap();
    let error = &json["error"];
    assert_eq!((error["file"].as_str(), error["line"].as_u64()), (Some("bad.toml"), Some(15)), "{error}");
    assert!(error["column"].is_u64() && error["help"].is_string(), "{error}");
    assert!(outcome.stderr.starts_with("error: "), "{}", outcome.stderr);
}

// --- Diagnosis ---------------------------------------------------------------------------------------------

#[test]
fn diagnose_of_a_complete_model_says_that_nothing_is_missing() {
    let bench = bench();
    let outcome =
        bench.greybox(&["diagnose", "model.toml", "run1.csv", "--holdout", "run2.csv", "--out", "out"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    assert!(outcome.stdout.contains("agrees with the recordings"), "{}", outcome.stdout);
    assert!(outcome.stdout.contains("Written: out/report.html"), "{}", outcome.stdout);
    let report: Value = serde_json::from_str(&bench.read("out/report.json")).unwrap();
    assert_eq!(report["verdict"], "consistent");
    assert_eq!(report["mechanisms"], serde_json::json!([]));
}

/// A heated room, recorded on the Celsius scale: what comes in as degrees Celsius goes out as degrees Celsius.
#[test]
fn temperatures_stay_on_their_scale_and_declared_units_in_the_model() {
    let bench = Bench::empty();
    let model = r#"[units]
duty = "0.01 1"

[inputs]
u = { unit = "duty" }

[states]
T = { unit = "degC" }

[parameters]
tau = { value = 3, unit = "s" }
rise = { value = 20, unit = "K" }
To = { value = 10, unit = "degC" }

[equations]
heat = "tau*T' = To - T + rise*u"
"#;
    bench.write("room.toml", model);
    // 4 T' = 15 - T + 30 u, degC.
    let (mut rows, mut temperature) = ("t,u [duty],T [degF]\n".to_owned(), 15.0);
    for k in 0..400 {
        let u = if k * 13 % 97 < 40 { 100.0 } else { 0.0 };
        rows += &format!("{:.2},{u},{:.6}\n", 0.1 * f64::from(k), temperature * 1.8 + 32.0);
        for _ in 0..20 {
            temperature += 0.005 * (15.0 - temperature + 0.3 * u) / 4.0;
        }
    }
    bench.write("room.csv", &rows);
    let report = bench.json(&["calibrate", "room.toml", "room.csv", "--out", "out"]);
    let ground = &report["parameters"]["To"];
    let (nominal, value) = (ground["nominal"].as_f64().unwrap(), ground["value"].as_f64().unwrap());
    assert!((nominal - 10.0).abs() < 1e-9 && (value - 15.0).abs() < 1.0, "{ground}");
    let (low, high) = (ground["ci95"][0].as_f64().unwrap(), ground["ci95"][1].as_f64().unwrap());
    assert!(low < value && value < high && high - low < 8.0, "{ground}");
    let written = bench.read("out/model.toml");
    assert!(
        written.starts_with("[units]\nduty = \"0.01 1\"\n") && written.contains("unit = \"degC\""),
        "{written}"
    );
    bench.json(&["simulate", "out/model.toml", "room.csv", "--out", "simulated.csv"]);
    let simulated = bench.read("simulated.csv");
    assert_eq!(simulated.lines().next(), Some("t,T [degF]"));
    for (simulated, measured) in column(&simulated, 1).into_iter().zip(column(&rows, 2)) {
        let (simulated, measured) = (simulated.unwrap(), measured.unwrap());
        assert!((simulated - measured).abs() < 2.0, "{simulated} {measured}");
    }
    // A symbol of the model is known to `--map` too.
    bench.write("bare.csv", &rows.replace("u [duty]", "valve"));
    let report =
        bench.json(&["calibrate", "room.toml", "bare.csv", "--map", "u=valve [duty]", "--out", "mapped"]);
    assert!((report["parameters"]["To"]["value"].as_f64().unwrap() - value).abs() < 1e-9);
}
