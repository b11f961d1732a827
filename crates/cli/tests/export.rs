//! `greybox export`: the files it writes, and that the Python module computes what `greybox simulate` computes.
#![allow(clippy::unwrap_used, clippy::print_stderr)]

use std::fs;
use std::path::Path;
use std::process::Command;

use common::Bench;
use recordings::driven;
use serde_json::Value;

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/recordings.rs"]
mod recordings;

/// Every function of the language, the three holds, delays of an input, a state and a sensor, a hidden state, and
/// names that are words of Python.
const EVERYTHING: &str = include_str!("common/everything.toml");

/// Two slides that stick at times of their own, one by a load that is zero at the start; an accelerometer, and a delayed
/// measurement of a speed.
const CONTACT: &str = include_str!("common/contact.toml");

/// A Python that has these modules: the one of `$GREYBOX_PYTHON` (`cargo xtask python` makes one), or the system's.
fn python(modules: &str) -> Option<String> {
    let stated = std::env::var("GREYBOX_PYTHON").ok();
    let candidate = stated.clone().unwrap_or_else(|| "python3".to_owned());
    let probe = Command::new(&candidate).args(["-c", &format!("import {modules}")]).output();
    let has = probe.is_ok_and(|output| output.status.success());
    assert!(has || stated.is_none(), "$GREYBOX_PYTHON is {candidate:?}, which cannot import {modules}");
    if !has {
        eprintln!("skipped: no Python with {modules}; `cargo xtask python` makes one for $GREYBOX_PYTHON");
    }
    has.then_some(candidate)
}

/// What a script of `tests/common` prints.
fn script(python: &str, name: &str, arguments: &[&str], bench: &Bench) -> Vec<u8> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/common").join(name);
    let mut command = Command::new(python);
    let output = command.arg(script).args(arguments).current_dir(bench.path(".")).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && error.is_empty(), "{arguments:?}: {error}");
    output.stdout
}

/// Name of the model, inputs, channels, step in s, amplitude of the inputs, largest difference over the spread.
type Case = (&'static str, &'static [&'static str], &'static [&'static str], f64, f64, f64);

/// The largest difference of each channel over its spread, and the number of events.
fn compare(python: &str, bench: &Bench, model: &str, recording: &str) -> Value {
    let answer = bench.json(&["simulate", model, recording, "--out", "simulated.csv"]);
    bench.write("answer.json", &answer.to_string());
    bench.json(&["export", model, "--to", "python", "--out", "exported.py"]);
    let arguments = ["exported.py", recording, "simulated.csv", "answer.json"];
    serde_json::from_slice(&script(python, "compare.py", &arguments, bench)).unwrap()
}

#[test]
fn the_python_module_computes_what_simulate_computes() {
    let Some(python) = python("numpy, scipy") else { return };
    let bench = Bench::empty();
    // What `simulate` itself is right to bounds the
    // agreement: 1e-6 of the spread, and for a delayed sensor the cubic between its samples.
    let cases: [Case; 9] = [
        ("servo", &["v"], &["theta"], 0.005, 3.0, 1e-9),
        ("two_mass_drive", &["i"], &["motor", "load"], 0.001, 1.0, 1e-9),
        ("pendulum", &["tau"], &["theta"], 0.01, 1.0, 1e-7),
        ("flexible_link", &["v"], &["theta", "alpha"], 0.002, 3.0, 1e-9),
        ("quarter_car", &["road"], &["body", "wheel"], 0.002, 0.02, 1e-9),
        ("oscillator", &["f"], &["x"], 0.01, 3.0, 1e-9),
        ("linear_axis", &["i"], &["x"], 0.002, 1.0, 1e-7),
        ("everything", &["v", "w", "q"], &["x", "lambda", "sensor"], 0.005, 1.0, 1e-4),
        ("contact", &["u"], &["x", "y", "acc", "lag"], 0.005, 1.0, 1e-8),
    ];
    for (name, inputs, channels, dt, amplitude, bound) in cases {
        let model = format!("{name}.toml");
        match name {
            "everything" => bench.write(&model, EVERYTHING),
            "contact" => bench.write(&model, CONTACT),
            _ => assert_eq!(bench.json(&["new", name, "--out", &model])["template"], name),
        }
        bench.write("run.csv", &driven(inputs, channels, 600, dt, amplitude));
        let answer = compare(&python, &bench, &model, "run.csv");
        let differences = answer["difference"].as_object().unwrap();
        assert_eq!(differences.len(), channels.len(), "{name}: {answer}");
        for (channel, difference) in differences {
            let difference = difference.as_f64().unwrap();
            assert!(difference < bound, "{name}, {channel}: {difference:e}");
        }
        if name == "everything" {
            assert!(differences["x"].as_f64().unwrap() < 2e-6, "{answer}");
            assert!(answer["events"].as_u64().unwrap() > 20, "{answer}");
        }
        if name == "linear_axis" {
            assert!(answer["events"].as_u64().unwrap() >= 2, "the axis never sticks: {answer}");
        }
    }
}

/// A reader of Modelica that knows nothing of greybox integrates the equations to the same answer. Friction is a steep
/// line there: an axis creeps where it should stick.
#[test]
fn the_modelica_model_computes_what_simulate_computes() {
    let Some(python) = python("numpy, scipy, casadi, pymoca") else { return };
    let bench = Bench::empty();
    // Name of the model, its input with the hold, channels with the size of their unit, step in s, amplitude, bound.
    type Modelled = (&'static str, [&'static str; 2], &'static [(&'static str, f64)], f64, f64, f64);
    let cases: [Modelled; 7] = [
        ("servo", ["v", "zero"], &[("theta", 1.0)], 0.005, 3.0, 1e-6),
        ("two_mass_drive", ["i", "linear"], &[("motor", 1.0), ("load", 1.0)], 0.001, 1.0, 1e-6),
        ("pendulum", ["tau", "linear"], &[("theta", 1.0)], 0.01, 1.0, 2e-6),
        ("flexible_link", ["v", "linear"], &[("theta", 1.0), ("alpha", 1.0)], 0.002, 3.0, 1e-6),
        ("quarter_car", ["road", "linear"], &[("body", 1.0), ("wheel", 1.0)], 0.002, 0.02, 1e-6),
        ("oscillator", ["f", "linear"], &[("x", 1.0)], 0.01, 3.0, 1e-6),
        ("linear_axis", ["i", "linear"], &[("x", 1e-3)], 0.002, 1.0, 1e-3),
    ];
    for (name, [input, hold], channels, dt, amplitude, bound) in cases {
        let model = format!("{name}.toml");
        bench.json(&["new", name, "--out", &model]);
        let names: Vec<&str> = channels.iter().map(|c| c.0).collect();
        bench.write("run.csv", &driven(&[input], &names, 600, dt, amplitude));
        let answer = bench.json(&["simulate", &model, "run.csv", "--out", "simulated.csv"]);
        bench.write("answer.json", &answer.to_string());
        let class = modelica(&bench, &model);
        let units: Value = channels.iter().map(|(c, unit)| ((*c).to_owned(), Value::from(*unit))).collect();
        let (holds, units) = (serde_json::json!({ input: hold }).to_string(), units.to_string());
        let files = ["run.csv", "simulated.csv", "answer.json"];
        let reported =
            script(&python, "modelica.py", &[&[".", &class, &holds, &units], &files[..]].concat(), &bench);
        let differences: Value = serde_json::from_slice(&reported).unwrap();
        for channel in names {
            let difference = differences[channel].as_f64().unwrap();
            assert!(difference < bound, "{name}, {channel}: {difference:e}");
        }
    }
    // Delays and every function of the language: that they are Modelica.
    for (name, text) in [("everything.toml", EVERYTHING), ("contact.toml", CONTACT)] {
        bench.write(name, text);
        let class = modelica(&bench, name);
        script(&python, "modelica.py", &[".", &class], &bench);
    }
}

/// Writes a model as Modelica into the file of its class, whose name it says.
fn modelica(bench: &Bench, model: &str) -> String {
    bench.json(&["export", model, "--to", "modelica", "--out", "exported.mo"]);
    let text = bench.read("exported.mo");
    let class = text.split_whitespace().nth(1).unwrap().to_owned();
    bench.write(&format!("{class}.mo"), &text);
    class
}

/// The book's page says what its own code prints.
#[test]
fn the_page_of_the_book_says_what_its_code_prints() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/export.md");
    let page = fs::read_to_string(page).unwrap().replace("\r\n", "\n");
    let block = |language: &str| {
        let behind = page.split(&format!("```{language}\n")).nth(1).unwrap();
        behind.split("```").next().unwrap().to_owned()
    };
    let bench = Bench::empty();
    bench.write("axis.toml", &block("toml"));
    bench.write("use.py", &block("python"));
    bench.json(&["export", "axis.toml", "--to", "python", "--out", "axis.py"]);
    let Some(python) = python("numpy, scipy") else { return };
    let output = Command::new(python).arg("use.py").current_dir(bench.path(".")).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8_lossy(&output.stdout).replace("\r\n", "\n"), block("text"));
}

#[test]
fn every_language_is_written_to_a_file_or_to_standard_output() {
    let bench = Bench::empty();
    bench.write("m.toml", EVERYTHING);
    for (language, marker) in
        [("python", "def simulate("), ("latex", "\\documentclass"), ("modelica", "der(")]
    {
        let shown = bench.greybox(&["export", "m.toml", "--to", language]);
        assert_eq!(shown.code, 0, "{}", shown.stderr);
        assert!(shown.stdout.contains(marker), "{}", shown.stdout);
        let json = bench.json(&["export", "m.toml", "--to", language]);
        assert_eq!(json["text"], shown.stdout);
        let answer = bench.json(&["export", "m.toml", "--to", language, "--out", "out/model"]);
        assert_eq!((&answer["language"], &answer["out"]), (&language.into(), &"out/model".into()));
        assert_eq!(bench.read("out/model"), shown.stdout);
    }
    let bare = bench.greybox(&["export", "m.toml", "--to", "latex", "--bare"]).stdout;
    assert!(bare.starts_with("\\begin{align}"), "{bare}");
    assert!(bench.greybox(&["export", "m.toml", "--to", "latex"]).stdout.contains(&bare));
}

#[test]
fn what_cannot_be_exported_is_refused_with_its_help() {
    let bench = Bench::empty();
    bench.write("m.toml", &EVERYTHING.replace("sign(x')", "sign(delay(x', taf))"));
    bench.refuses(
        &["export", "m.toml", "--to", "python", "--out", "m.py"],
        &["m.toml: equation \"one\": `sign` cannot be written in Python", "help: "],
    );
    bench.refuses(&["export", "m.toml", "--to", "python", "--bare"], &["`--bare` is for LaTeX"]);
    bench.refuses(&["export", "m.toml", "--to", "latex", "--out", "m.toml"], &["would overwrite this input"]);
    bench.refuses(&["export", "m.toml", "--to", "fortran"], &["python, latex, modelica"]);
    bench.refuses(&["export", "none.toml", "--to", "latex"], &["none.toml: no such file"]);
    assert!(fs::read_dir(bench.path(".")).unwrap().count() == 1);
}
