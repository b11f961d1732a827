//! Recordings that are no CSV, channels under other names, folders and clocks.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(missing_docs, clippy::unwrap_used)]

use std::fmt::Write as _;
use std::fs;

use common::Bench;
use serde_json::Value;
use spring::{MODEL, recording};

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/spring.rs"]
mod spring;

/// A folder with the model, and a recording under the names of the model and under others.
fn bench() -> Bench {
    let bench = Bench::empty();
    bench.write("model.toml", MODEL);
    let run = recording(600, 0.0);
    bench.write("run.csv", &run);
    bench.write("raw.csv", &run.replace("f [N],x [mm]", "force,sensor_3"));
    bench
}

/// An element of a MAT-file, in the byte order of most machines.
fn element(kind: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = [kind.to_le_bytes(), u32::try_from(data.len()).unwrap().to_le_bytes()].concat();
    bytes.extend(data);
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    bytes
}

/// A MAT-file (as of `-v6`) with the columns of a CSV file as vectors.
fn mat(csv: &str) -> Vec<u8> {
    let mut bytes = b"MATLAB 5.0 MAT-file".to_vec();
    bytes.resize(124, b' ');
    bytes.extend(*b"\x00\x01IM");
    let mut rows = csv.lines();
    for (c, header) in rows.next().unwrap().split(',').enumerate() {
        let cells = csv.lines().skip(1).map(|row| row.split(',').nth(c).unwrap().parse::<f64>().unwrap());
        let values: Vec<u8> = cells.flat_map(f64::to_le_bytes).collect();
        let rows = u32::try_from(values.len() / 8).unwrap();
        let dimensions = [rows.to_le_bytes(), 1u32.to_le_bytes()].concat();
        let name = header.split(' ').next().unwrap();
        let class = [6u32.to_le_bytes(), 0u32.to_le_bytes()].concat();
        let parts =
            [element(6, &class), element(5, &dimensions), element(1, name.as_bytes()), element(9, &values)];
        bytes.extend(element(14, &parts.concat()));
    }
    bytes
}

#[test]
fn renamed_channels_give_the_same_bytes() {
    let bench = bench();
    let renamed = ["--map", "f=force [N]", "--map", "x=sensor_3 [mm]"];
    for (command, file) in [
        (&["calibrate", "model.toml"] as &[&str], "report.json"),
        (&["diagnose", "model.toml", "--work", "1"], "report.json"),
    ] {
        let run = |recording: &str, map: &[&str], out: &str| {
            bench.write("train.csv", &bench.read(recording));
            let outcome = bench.greybox(&[command, &["train.csv", "--out", out], map].concat());
            assert_eq!(outcome.code, 0, "{}", outcome.stderr);
            bench.read(&format!("{out}/{file}"))
        };
        assert!(run("run.csv", &[], "a") == run("raw.csv", &renamed, "b"), "{command:?}");
    }
    let simulate = |recording: &str, map: &[&str]| {
        let arguments = ["simulate", "model.toml", recording, "--out", "out.csv"];
        let outcome = bench.greybox(&[&arguments as &[&str], map].concat());
        assert_eq!(outcome.code, 0, "{}", outcome.stderr);
        bench.read("out.csv")
    };
    let plain = simulate("run.csv", &[]);
    assert!(plain.starts_with("t,x [mm]\n"), "{}", &plain[..20]);
    assert!(plain == simulate("raw.csv", &renamed));
}

#[test]
fn a_map_is_part_of_what_a_folder_was_made_from() {
    let bench = bench();
    fs::create_dir(bench.path("runs")).unwrap();
    fs::rename(bench.path("raw.csv"), bench.path("runs/raw.csv")).unwrap();
    let run = |unit: &str| {
        let x = format!("x=sensor_3 [{unit}]");
        bench.json(&[
            "diagnose",
            "model.toml",
            "runs",
            "--work",
            "1",
            "--out",
            "out",
            "--map",
            "f=force",
            "--map",
            &x,
        ])
    };
    assert_eq!(run("mm")["done_before"], 0);
    assert_eq!(run("mm")["done_before"], 1);
    assert_eq!(run("cm")["done_before"], 0, "another unit is another diagnosis");
}

/// `--channels` reads these alone, and what `--map` and the model name.
#[test]
fn channels_are_read_alone() {
    let bench = bench();
    let names = |arguments: &[&str]| -> Vec<String> {
        let json = bench.json(&[&["check", "raw.csv"], arguments].concat());
        let channels = json["recordings"][0]["channels"].as_array().unwrap();
        channels.iter().map(|c| c["name"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(names(&[]), ["force", "sensor_3"]);
    assert_eq!(names(&["--channels", "sensor_3"]), ["sensor_3"]);
    assert_eq!(names(&["--channels", "force", "--map", "x=sensor_3 [mm]"]), ["force", "x"]);
    bench.refuses(
        &["check", "raw.csv", "--channels", "sensor3"],
        &[
            "raw.csv: there is no channel `sensor3`; the file has `force`, `sensor_3`",
            "did you mean `sensor_3`?",
        ],
    );
    let calibrated = |arguments: &[&str]| {
        let all = [&["calibrate", "model.toml", "run.csv", "--out", "out"], arguments].concat();
        bench.json(&all)["parameters"].clone()
    };
    assert_eq!(calibrated(&["--channels", "x"]), calibrated(&[]), "the model's input is read as well");
    bench.refuses(&["watch", "model.toml", "--channels", "x"], &["--channels"]);
}

#[test]
fn channels_are_part_of_what_a_folder_was_made_from() {
    let bench = bench();
    fs::create_dir(bench.path("runs")).unwrap();
    fs::rename(bench.path("run.csv"), bench.path("runs/run.csv")).unwrap();
    let run = |more: &[&str]| {
        let arguments = ["diagnose", "model.toml", "runs", "--work", "1", "--out", "out"];
        bench.json(&[&arguments as &[&str], more].concat())["done_before"].clone()
    };
    assert_eq!(run(&[]), 0);
    assert_eq!(run(&["--channels", "x"]), 0, "other channels are another diagnosis");
    assert_eq!(run(&["--channels", "x"]), 1);
}

#[test]
fn a_map_that_does_not_fit_is_refused() {
    let bench = bench();
    let check = |map: &'static str| ["check", "raw.csv", "--map", map];
    bench.refuses(
        &check("x=sensor3"),
        &[
            "raw.csv: there is no channel `sensor3`; the file has `force`, `sensor_3`",
            "did you mean `sensor_3`?",
        ],
    );
    bench.refuses(&check("x=sensor_3 [N//m]"), &["found `/`", "--map"]);
    // A model might declare it; this one does not.
    bench.refuses(
        &["check", "raw.csv", "--model", "model.toml", "--map", "f=force", "--map", "x=sensor_3 [furlong]"],
        &["channel `x`: unknown unit `furlong`", "[units]"],
    );
    bench.refuses(&check("sensor_3"), &["is not `NAME=CHANNEL`"]);
    bench.refuses(&check("force=sensor_3"), &["a channel `force` already"]);
    bench.refuses(&["check", "run.csv", "--map", "x=x [m]"], &["channel `x` in [mm], not [m]"]);
    bench.refuses(&["check", "raw.csv", "--model", "model.toml"], &["there is no channel `f`"]);
    bench.refuses(
        &["check", "raw.csv", "--model", "model.toml", "--map", "f=force", "--map", "x=sensor_3 [deg]"],
        &["channel `x` is in [deg]", "do not measure the same thing"],
    );
}

/// Units that machines come in become the model's at the edge: every calibration sees the same numbers.
#[test]
fn units_are_converted_at_the_edge() {
    let bench = bench();
    let of = |unit: &str, factor: f64| {
        let mut text = String::from("t,f,x\n");
        for row in recording(600, 0.0).lines().skip(1) {
            let cells: Vec<f64> = row.split(',').map(|c| c.parse().unwrap()).collect();
            writeln!(text, "{},{},{}", cells[0], cells[1], cells[2] * 1e-3 / factor).unwrap();
        }
        bench.write("train.csv", &text);
        let map = format!("x=x [{unit}]");
        let json = bench.json(&["calibrate", "model.toml", "train.csv", "--out", "out", "--map", &map]);
        json["parameters"]["k"]["value"].as_f64().unwrap()
    };
    let k = of("m", 1.0);
    for (unit, factor) in [("mm", 1e-3), ("cm", 1e-2), ("um", 1e-6), ("in", 0.0254)] {
        assert!((of(unit, factor) / k - 1.0).abs() < 1e-6, "{unit}");
    }
}

#[cfg(feature = "mat")]
#[test]
fn a_mat_file_is_a_recording_like_any_other() {
    let bench = bench();
    fs::write(bench.path("run.mat"), mat(&bench.read("run.csv"))).unwrap();
    let units = ["--map", "f=f [N]", "--map", "x=x [mm]"];
    let check =
        |recording| bench.json(&[&["check", recording, "--model", "model.toml"], &units as &[_]].concat());
    let said = |json: &Value| json["recordings"][0]["findings"].to_string();
    assert_eq!(said(&check("run.mat")), said(&check("run.csv")));
    let calibrated = |recording: &str| {
        let json = bench.json(&["calibrate", "model.toml", recording, "--out", "out", "--map", "x=x [mm]"]);
        json["parameters"].to_string()
    };
    assert_eq!(calibrated("run.mat"), calibrated("run.csv"));

    let whole = fs::read(bench.path("run.mat")).unwrap();
    fs::write(bench.path("cut.mat"), &whole[..whole.len() - 100]).unwrap();
    bench.refuses(&["check", "cut.mat"], &["cut.mat: the file is damaged", "copy it again"]);
    bench.refuses(
        &["identify", "run.mat", "--states", "x", "--inputs", "f", "--block", "1000", "--out", "found"],
        &["run.mat: only CSV files are read in blocks", "leave `--block` out"],
    );
}

#[cfg(not(feature = "parquet"))]
#[test]
fn a_format_that_is_left_out_is_named() {
    let bench = bench();
    bench.write("run.parquet", "PAR1");
    bench.refuses(&["check", "run.parquet"], &["does not read Parquet files", "feature `parquet`"]);
}

#[test]
fn check_takes_folders_and_finds_clocks_that_disagree() {
    let bench = bench();
    fs::create_dir(bench.path("runs")).unwrap();
    let mut noise = spring::noise::Noise(7);
    let (mut rows, mut x, mut y) = (Vec::new(), 0.0, 0.0);
    for _ in 0..4000 {
        let u = noise.normal();
        rows.push((u, x, y));
        x += 0.2 * (u - x);
        y += 0.4 * (u - y);
    }
    let file = |behind: usize| {
        let mut text = String::from("t,u,x,y\n");
        for k in 20..rows.len() {
            let (u, x, y) = (rows[k].0, rows[k].1, rows[k - behind].2);
            writeln!(text, "{:.2},{u:.6},{x:.6},{y:.6}", 0.01 * (k - 20) as f64).unwrap();
        }
        text
    };
    bench.write("runs/one_clock.csv", &file(0));
    bench.write("runs/two_clocks.csv", &file(12));
    let offsets = |json: &Value, k: usize| -> Vec<Value> {
        let findings = json["recordings"][k]["findings"].as_array().unwrap();
        findings.iter().filter(|f| f["code"] == "clock_offset").cloned().collect()
    };
    let json = bench.json(&["check", "runs", "run.csv"]);
    let names: Vec<&str> =
        json["recordings"].as_array().unwrap().iter().map(|r| r["file"].as_str().unwrap()).collect();
    assert_eq!(names, ["one_clock.csv", "two_clocks.csv", "run.csv"]);
    let json = bench.json(&["check", "runs", "--inputs", "u"]);
    assert!(offsets(&json, 0).is_empty());
    let [found] = &offsets(&json, 1)[..] else { panic!("{json:#}") };
    assert_eq!(found["channel"], "y");
    assert!((found["value"].as_f64().unwrap() - 0.12).abs() < 1e-9, "{found}");
    let words = bench.greybox(&["check", "runs", "--inputs", "u"]).stdout;
    for part in [
        "warning  two_clocks.csv, y: Recorded about 12 samples (0.12 s) later than `x`",
        "The lag is sure: 8 of 8 parts",
        "help: If the machine does not explain it, move the column `y` up by 12 rows",
    ] {
        assert!(words.contains(part), "`{part}` is not in: {words}");
    }
    fs::create_dir(bench.path("empty")).unwrap();
    bench.refuses(
        &["check", "empty"],
        &["empty: this folder holds no recording (`*.csv`, `*.mat`, `*.h5`, `*.hdf5`, `*.npz`, `*.npy`, `*.mcap`, `*.parquet`)"],
    );
    bench
        .refuses(&["check", "runs", "runs/one_clock.csv"], &["one_clock.csv: this recording is named twice"]);
}

#[test]
fn check_lists_what_is_in_a_folder_of_logs_and_passes_over_a_damaged_one() {
    let bench = bench();
    fs::create_dir_all(bench.path("logs/bag")).unwrap();
    let run = recording(600, 0.0);
    let in_steps = rewritten("t,f [N],x [mm]", |k, t, _, x| format!("{t},{},{x}", k / 40 % 3));
    let holed: Vec<&str> =
        in_steps.lines().enumerate().filter(|(k, _)| !(200..230).contains(k)).map(|l| l.1).collect();
    bench.write("logs/b.csv", &holed.join("\n"));
    bench.write("logs/bag/a.csv", &in_steps);
    bench.write("logs/cut.csv", "t,f [N],x [mm]\n0,1,nothing\n");
    let outcome = bench.greybox(&["check", "logs"]);
    assert_eq!(outcome.code, 2, "{}", outcome.stdout);
    for part in [
        "b.csv: ",
        "a.csv: ",
        "1 recording could not be checked\n",
        "Channels of each:",
        "f  [N]         95.0 to 100 Hz, 570 to 600 samples, 0 to 1 gaps; in steps: an input?\n",
        "x  [mm]        95.0 to 100 Hz, 570 to 600 samples, 0 to 1 gaps; smooth: a state?\n",
    ] {
        assert!(outcome.stdout.contains(part), "`{part}` is not in: {}", outcome.stdout);
    }
    assert!(outcome.stderr.contains("cut.csv") && outcome.stderr.contains("nothing"), "{}", outcome.stderr);
    let json: Value = serde_json::from_str(&bench.greybox(&["check", "logs", "--json"]).stdout).unwrap();
    assert_eq!(json["recordings"].as_array().unwrap().len(), 2);
    assert_eq!(json["failures"][0]["kind"], "bad_input");
    assert!(json["failures"][0]["file"].as_str().unwrap().ends_with("cut.csv"), "{json:#}");
    let holed = &json["recordings"][0]["channels"][1];
    assert_eq!((holed["gaps"].as_u64(), holed["samples"].as_u64()), (Some(1), Some(570)), "{holed}");

    // With the model, what feeds it is told, and a recording that does not is a failure of its own.
    bench.write("logs/cut.csv", &run.replacen("x [mm]", "y [mm]", 1));
    let outcome = bench.greybox(&["check", "logs", "--model", "model.toml"]);
    assert_eq!(outcome.code, 2, "{}", outcome.stdout);
    assert!(outcome.stdout.contains("measurement of x (mm → m)"), "{}", outcome.stdout);
    assert!(outcome.stderr.contains("cut.csv") && outcome.stderr.contains("`x`"), "{}", outcome.stderr);
}

/// The cells of a recording of the spring written anew: row, time, f and x of a line.
fn rewritten(header: &str, row: impl Fn(usize, &str, &str, &str) -> String) -> String {
    let mut text = format!("{header}\n");
    for (k, line) in recording(600, 0.0).lines().skip(1).enumerate() {
        let cells: Vec<&str> = line.split(',').collect();
        writeln!(text, "{}", row(k, cells[0], cells[1], cells[2])).unwrap();
    }
    text
}

/// Codes, channels and severities of the findings.
fn codes(findings: &Value) -> Vec<(String, String, String)> {
    let text = |f: &Value, key: &str| f[key].as_str().unwrap_or_default().to_owned();
    let findings = findings.as_array().unwrap().iter();
    findings.map(|f| (text(f, "code"), text(f, "channel"), text(f, "severity"))).collect()
}

#[test]
fn a_noisy_input_is_told_and_a_command_is_not() {
    let bench = bench();
    let mut noise = spring::noise::Noise(7);
    let errors: Vec<f64> = (0..600).map(|_| 0.1 * noise.normal()).collect();
    let noisy = rewritten("t,f [N],x [mm]", |k, t, f, x| {
        format!("{t},{:.6},{x}", f.parse::<f64>().unwrap() + errors[k])
    });
    bench.write("noisy.csv", &noisy);
    let check = |file: &str| {
        let outcome = bench.greybox(&["check", file, "--model", "model.toml", "--json"]);
        assert_eq!(outcome.code, 0, "{}", outcome.stderr);
        let document: Value = serde_json::from_str(&outcome.stdout).unwrap();
        codes(&document["recordings"][0]["findings"])
    };
    let reported = |severity: &str| ("input_noise".to_owned(), "f".to_owned(), severity.to_owned());
    assert!(check("noisy.csv").contains(&reported("info")));
    assert!(!check("run.csv").iter().any(|(code, ..)| code == "input_noise"));
    for command in [&["calibrate"] as &[&str], &["diagnose", "--work", "1"]] {
        let findings = |file: &str| {
            let outcome = bench.greybox(&[command, &["model.toml", file, "--out", "out"]].concat());
            assert_eq!(outcome.code, 0, "{}", outcome.stderr);
            codes(&serde_json::from_str::<Value>(&bench.read("out/report.json")).unwrap()["findings"])
        };
        assert!(findings("noisy.csv").contains(&reported("warning")), "{command:?}");
        assert!(!findings("run.csv").iter().any(|(code, ..)| code == "input_noise"), "{command:?}");
    }
}

#[test]
fn a_derivative_and_a_constant_are_inputs_as_any_other() {
    let bench = bench();
    let model = MODEL
        .replace(
            "f = { unit = \"N\" }",
            "f = { unit = \"N\" }\ndf = { unit = \"N/s\", channel = \"f'\" }\nmp = { unit = \"kg\" }",
        )
        .replace("[equations]", "td = { value = 0.01, unit = \"s\" }\n[equations]")
        .replace("m*x''", "(m + mp)*x''")
        .replace("= f\"", "= f + td*df\"");
    bench.write("lead.toml", &model);
    bench.write("loaded.csv", &rewritten("t,f [N],mp [g],x [mm]", |_, t, f, x| format!("{t},{f},50,{x}")));
    let outcome = bench.greybox(&["check", "loaded.csv", "--model", "lead.toml"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    for reported in [
        "input f (N, linear hold) and input df (its derivative, in N/s)",
        "mp: The input is a known constant here (50 g)",
    ] {
        assert!(outcome.stdout.contains(reported), "{}", outcome.stdout);
    }
    assert!(!outcome.stdout.contains("no channel of this name"), "{}", outcome.stdout);
    // What is written is read again, the line of the derivative as it was.
    let outcome = bench.greybox(&["calibrate", "lead.toml", "loaded.csv", "--out", "out"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    assert!(bench.read("out/model.toml").contains("df = { unit = \"N/s\", channel = \"f'\" }\n"));
    let outcome = bench.greybox(&["simulate", "out/model.toml", "loaded.csv", "--out", "out.csv"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    let outcome = bench.greybox(&["diagnose", "lead.toml", "loaded.csv", "--work", "1", "--out", "found"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
}
