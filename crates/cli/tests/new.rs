//! First contact: `greybox new`, completions and the man page.
#![allow(clippy::unwrap_used)]

use common::Bench;
use noise::Noise;
use recordings::driven;

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/noise.rs"]
mod noise;
#[path = "common/recordings.rs"]
mod recordings;

/// Name, inputs, channels.
const TEMPLATES: [(&str, &[&str], &[&str]); 7] = [
    ("servo", &["v"], &["theta"]),
    ("two_mass_drive", &["i"], &["motor", "load"]),
    ("pendulum", &["tau"], &["theta"]),
    ("flexible_link", &["v"], &["theta", "alpha"]),
    ("quarter_car", &["road"], &["body", "wheel"]),
    ("oscillator", &["f"], &["x"]),
    ("linear_axis", &["i"], &["x"]),
];

#[test]
fn every_template_loads_and_moves() {
    let bench = Bench::empty();
    let listed = bench.json(&["new", "--list"]);
    let listed: Vec<&str> =
        listed["templates"].as_array().unwrap().iter().map(|t| t["name"].as_str().unwrap()).collect();
    assert_eq!(listed, TEMPLATES.map(|(name, ..)| name));
    for (name, inputs, channels) in TEMPLATES {
        let model = format!("{name}.toml");
        let text = bench.greybox(&["new", name]).stdout;
        let said = bench.greybox(&["new", name, "--out", &model]);
        assert_eq!(said.code, 0, "{}", said.stderr);
        assert!(said.stdout.contains("greybox diagnose"), "{}", said.stdout);
        assert_eq!(bench.read(&model), text);
        // What it is, who has its equations, and where to look up every parameter that is not known to all.
        let comments: Vec<&str> = text.lines().take_while(|line| line.starts_with("# ")).collect();
        let initial = |word: &str| word.len() == 2 && word.ends_with('.') && word < "[";
        let author = |line: &&str| line.split_whitespace().any(initial) || line.contains("Student Workbook");
        assert!(comments.iter().skip(1).any(author), "{name}: {comments:?}");
        let parameters = text.split("[parameters]").nth(1).unwrap().split("[equations]").next().unwrap();
        for line in parameters.lines().filter(|l| l.contains("value =")) {
            assert!(line.contains("# ") || line.starts_with("g "), "{name}: no comment: {line}");
            assert!(line.contains("unit ="), "{name}: no unit: {line}");
        }
        bench.write("run.csv", &driven(inputs, channels, 500, 0.004, 1.0));
        let answer = bench.json(&["simulate", &model, "run.csv", "--out", "simulated.csv"]);
        assert_eq!(answer["diverged"], false, "{name}");
        let simulated = bench.read("simulated.csv");
        let moved = simulated
            .lines()
            .skip(1)
            .any(|row| row.split(',').skip(1).any(|cell| cell.parse::<f64>().unwrap().abs() > 1e-6));
        assert!(moved, "{name} rests");
        let states = answer["initial_si"][0].as_object().unwrap();
        assert!(
            states.len() == channels.len() && states[channels[0]].as_array().unwrap().len() == 2,
            "{answer}"
        );
    }
}

#[test]
fn a_template_is_consistent_with_data_of_its_own() {
    let bench = Bench::empty();
    bench.json(&["new", "oscillator", "--out", "m.toml"]);
    bench.write("drive.csv", &driven(&["f"], &["x"], 1000, 0.02, 2.0));
    bench.json(&["simulate", "m.toml", "drive.csv", "--out", "simulated.csv"]);
    let mut noise = Noise(11);
    let mut recording = String::from("t,f,x\n");
    for (drive, simulated) in bench.read("drive.csv").lines().zip(bench.read("simulated.csv").lines()).skip(1)
    {
        let (head, _) = drive.rsplit_once(',').unwrap();
        let x: f64 = simulated.rsplit_once(',').unwrap().1.parse().unwrap();
        recording.push_str(&format!("{head},{:.6}\n", x + 5e-4 * noise.normal()));
    }
    bench.write("run.csv", &recording);
    bench.json(&["diagnose", "m.toml", "run.csv", "--out", "result"]);
    let report: serde_json::Value = serde_json::from_str(&bench.read("result/report.json")).unwrap();
    assert_eq!(report["verdict"], "consistent", "{}", report["mechanisms"]);
}

#[test]
fn a_file_that_is_there_is_not_replaced() {
    let bench = Bench::empty();
    bench.write("m.toml", "mine");
    bench.refuses(&["new", "servo", "--out", "m.toml"], &["m.toml: this file is there already", "help: "]);
    assert_eq!(bench.read("m.toml"), "mine");
    bench.refuses(&["new", "serwo"], &["no template called `serwo`", "servo, two_mass_drive"]);
    bench.refuses(&["new"], &["TEMPLATE"]);
}

#[test]
fn completions_and_man_page_know_every_command() {
    let bench = Bench::empty();
    let commands = [
        "diagnose",
        "identify",
        "calibrate",
        "simulate",
        "check",
        "control",
        "export",
        "new",
        "mechanisms",
        "demo",
    ];
    for shell in ["bash", "zsh", "fish"] {
        let script = bench.greybox(&["completions", shell]);
        assert_eq!(script.code, 0, "{}", script.stderr);
        assert!(commands.iter().all(|c| script.stdout.contains(c)), "{shell}: {}", script.stdout);
        assert_eq!(bench.json(&["completions", shell])["text"], script.stdout);
    }
    let page = bench.greybox(&["man"]).stdout;
    assert!(page.contains(".TH greybox 1"), "{page}");
    for command in commands {
        assert!(page.contains(&format!(".SH GREYBOX {}", command.to_uppercase())), "{command}");
    }
    assert!(page.contains("\\-\\-holdout"), "options are explained");
    assert_eq!(bench.json(&["man"])["text"], page);
    bench.refuses(&["completions", "tcsh"], &["bash"]);
}
