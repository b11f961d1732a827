//! The book's pages beside what the command says: of its options, and of the example that is not in a demo.
#![allow(missing_docs, clippy::unwrap_used)]

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

use common::Bench;
use noise::Noise;
use serde_json::Value;

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/noise.rs"]
mod noise;
#[allow(dead_code, reason = "not every test file uses all of it")]
#[path = "common/throttle.rs"]
mod throttle;

fn read(page: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src").join(page)).unwrap()
}

fn page() -> String {
    read("commands.md")
}

fn help(command: &[&str]) -> String {
    let run = Command::new(env!("CARGO_BIN_EXE_greybox")).args(command).arg("--help").output().unwrap();
    assert!(run.status.success(), "{command:?}");
    String::from_utf8(run.stdout).unwrap()
}

/// The long options that a help lists, without `--help` itself.
fn options(help: &str) -> BTreeSet<String> {
    let listed = help.lines().map(str::trim_start).filter(|line| line.starts_with('-'));
    let long = listed.filter_map(|line| line.split_once("--").map(|(_, rest)| name(rest)));
    long.filter(|name| !name.is_empty() && name != "help").collect()
}

fn name(text: &str) -> String {
    let name: String = text.chars().take_while(|c| c.is_ascii_lowercase() || *c == '-').collect();
    name.trim_end_matches('-').to_owned()
}

fn commands() -> Vec<String> {
    let help = help(&[]);
    let listed = help.split_once("Commands:\n").unwrap().1.lines().take_while(|line| !line.is_empty());
    let names = listed.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names.map(|line| line.split_whitespace().next().unwrap().to_owned()).filter(|n| n != "help").collect()
}

#[test]
fn the_page_lists_every_command_and_option() {
    let (page, commands) = (page(), commands());
    assert!(commands.len() > 10 && commands.contains(&"diagnose".to_owned()), "{commands:?}");
    let common = options(&help(&[]));
    for command in commands {
        assert!(page.contains(&format!("| `{command}` |")), "{command} is not in the table of commands");
        let mut sections = page.split("\n## ").filter(|s| s.starts_with('`'));
        let section =
            sections.find(|s| s.lines().next().is_some_and(|l| l.contains(&format!("`{command}`"))));
        for option in options(&help(&[&command])).difference(&common) {
            let listed = section.is_some_and(|s| s.contains(&format!("--{option}")));
            assert!(listed, "`{command} --{option}` is not in docs/src/commands.md");
        }
    }
}

#[test]
fn the_page_lists_no_option_that_is_not_there() {
    let mut known = options(&help(&[]));
    known.insert("help".to_owned());
    for command in commands() {
        known.extend(options(&help(&[&command])));
    }
    for named in page().split("--").skip(1).map(name).filter(|n| !n.is_empty()) {
        assert!(known.contains(&named), "--{named} is no option");
    }
}

/// A pendulum that hangs from a cart on a spring, 40 s of it: 1.3 x″ + 0.12 (cos θ θ″ − sin θ θ′²) + 1.5 x′ + 20 x = f,
/// 0.06 θ″ + 0.12 cos θ x″ + 1.177 sin θ + 0.01 θ′ = 0; x in mm and θ in degrees.
fn pendulum_on_a_cart() -> String {
    let (dt, fine) = (0.01, 20);
    let sample = |row: f64| 2.0 * (0.021 * row).sin() + 2.0 * (0.043 * row + 1.0).sin() + (0.087 * row).cos();
    let rates = |[x, theta, v, w]: [f64; 4], f: f64| {
        let (s, c) = theta.sin_cos();
        let on_cart = f + 0.12 * s * w * w - 1.5 * v - 20.0 * x;
        let on_pendulum = -1.177 * s - 0.01 * w;
        let determinant = 1.3 * 0.06 - (0.12 * c).powi(2);
        let cart = (0.06 * on_cart - 0.12 * c * on_pendulum) / determinant;
        [v, w, cart, (1.3 * on_pendulum - 0.12 * c * on_cart) / determinant]
    };
    let mut noise = Noise(11);
    let mut state = [0.0; 4];
    let mut text = "t,f [N],x [mm],theta [deg]\n".to_owned();
    for row in 0..=4000 {
        let row = f64::from(row);
        let shown =
            [1e3 * (state[0] + 0.002 * noise.normal()), (state[1] + 0.005 * noise.normal()).to_degrees()];
        writeln!(text, "{:.2},{:.6},{:.4},{:.4}", row * dt, sample(row), shown[0], shown[1]).unwrap();
        for step in 0..fine {
            let h = dt / f64::from(fine);
            let at = (f64::from(step) + 0.5) / f64::from(fine);
            let f = sample(row) + at * (sample(row + 1.0) - sample(row));
            let moved = |by: [f64; 4], share: f64| std::array::from_fn(|i| state[i] + share * h * by[i]);
            let a = rates(state, f);
            let b = rates(moved(a, 0.5), f);
            let c = rates(moved(b, 0.5), f);
            let d = rates(moved(c, 1.0), f);
            state = std::array::from_fn(|i| state[i] + h / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i]));
        }
    }
    text
}

#[test]
fn the_page_shows_what_is_said_of_a_pendulum_on_a_cart() {
    let bench = Bench::empty();
    bench.write("run1.csv", &pendulum_on_a_cart());
    let page = read("identify.md");
    let example = page.split("## Several coordinates and inputs").nth(1).unwrap();
    let command = example.lines().find(|l| l.contains("lagrangian") && l.starts_with("greybox")).unwrap();
    let arguments: Vec<&str> = command.split_whitespace().skip(1).collect();
    let outcome = bench.greybox(&arguments);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    for line in outcome.stdout.lines().filter(|l| l.starts_with("Equation of")) {
        assert!(example.lines().any(|l| l == line), "the page has another equation than\n{line}");
    }
    let report: Value = serde_json::from_str(&bench.read("found/report.json")).unwrap();
    let of = |state: &str, expression: &str| {
        let terms = report["equations"][state]["terms"].as_array().unwrap().clone();
        terms.into_iter().find(|t| t["expression"] == expression).unwrap_or_else(|| panic!("{report:#}"))
    };
    let (cart, pendulum) =
        (of("x", "(cos(theta)*theta'' - sin(theta)*theta'^2)"), of("theta", "cos(theta)*x''"));
    assert_eq!(cart["parameter"], pendulum["parameter"]);
    assert_eq!(cart["unit"], "kg m");
    let interval: Vec<f64> = cart["ci95"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert!(interval[0] < 0.12 && 0.12 < interval[1] && interval[1] - interval[0] < 0.01, "{interval:?}");
    assert_eq!(report["equations"]["theta"]["input"], Value::Null);
    // What was written runs.
    let run = bench.json(&["simulate", "found/model.toml", "run1.csv", "--out", "simulated.csv"]);
    assert!(run["fit"]["x"]["nrmse"].as_f64().unwrap() < 0.05, "{run:#}");
}

/// What the page of `greybox watch` shows is what the command says of that throttle.
#[test]
fn the_page_of_the_watch_shows_what_the_command_says() {
    let bench = Bench::empty();
    bench.write("throttle.toml", throttle::MODEL);
    let said = bench.greybox_fed(&["watch", "throttle.toml"], &throttle::csv(&throttle::samples(190.0)));
    assert_eq!(said.code, 0, "{}", said.stderr);
    let page = read("watch.md");
    let shown: Vec<&str> =
        page.split("```text\n").skip(1).map(|block| block.split("```").next().unwrap()).collect();
    assert_eq!(shown[..2].concat(), said.stdout);
}
