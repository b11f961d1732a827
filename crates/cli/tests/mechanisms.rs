//! Mechanisms of the user's own: found when they are there, refused with line and fix when they are wrong.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use common::Bench;
use noise::Noise;

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/noise.rs"]
mod noise;

const MODEL: &str = r#"name = "Slide on a spring"

[inputs]
f = { unit = "N" }

[states]
x = { unit = "m" }

[parameters]
m = { value = 1.0, unit = "kg", fixed = true }
b = { value = 0.5, unit = "N s/m" }
k = { value = 28.0, unit = "N/m" }

[equations]
slide = "m*x'' + b*x' + k*x = f"
"#;

/// Friction per squared distance, N/m²; damping, stiffness.
const TRUTH: (f64, f64, f64) = (30.0, 0.8, 25.0);

/// The slide with friction `fb*x^2*sign(x')`, simulated finely: in each step friction takes what it can of the
/// velocity and never turns it round, so that the slide sticks. Noise of 0.2 mm.
fn recording(rows: usize, phase: f64) -> String {
    let (fb, b, k) = TRUTH;
    let force =
        |t: f64| 3.0 * (1.7 * t + phase).sin() + 2.5 * (4.1 * t).sin() + 1.5 * (9.0 * t + phase).sin();
    let (mut x, mut v) = (0.05, 0.0);
    let mut noise = Noise(2024);
    let mut text = String::from("t,f [N],x [m]\n");
    let (dt, fine) = (0.02, 200);
    for row in 0..rows {
        let t = row as f64 * dt;
        writeln!(text, "{t:.2},{:.6},{:.6}", force(t), x + 2e-4 * noise.normal()).unwrap();
        let h = dt / f64::from(fine);
        let (now, next) = (force(t), force(t + dt));
        for i in 0..fine {
            let between = now + (next - now) * f64::from(i) / f64::from(fine);
            let free: f64 = v + h * (between - b * v - k * x);
            v = free.signum() * (free.abs() - h * fb * x * x).max(0.0);
            x += h * v;
        }
    }
    text
}

/// The first mechanism of the book's page.
fn belt_friction() -> String {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/your-own-mechanism.md");
    let page = fs::read_to_string(page).unwrap().replace("\r\n", "\n");
    let block = page.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    assert!(block.contains("kind     = \"belt_friction\""), "{block}");
    block.to_owned()
}

/// A folder with the model, a recording, and `mine/belt_friction.toml`.
fn bench() -> Bench {
    let bench = Bench::empty();
    bench.write("model.toml", MODEL);
    bench.write("run.csv", &recording(1000, 0.0));
    fs::create_dir(bench.path("mine")).unwrap();
    bench.write("mine/belt_friction.toml", &belt_friction());
    bench
}

#[test]
fn a_mechanism_of_ones_own_is_found() {
    let bench = bench();
    let outcome =
        bench.greybox(&["diagnose", "model.toml", "run.csv", "--mechanisms", "mine", "--out", "result"]);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    assert!(
        outcome.stdout.contains("tried beside the built-in mechanisms: belt_friction.toml"),
        "{}",
        outcome.stdout
    );
    let report: serde_json::Value = serde_json::from_str(&bench.read("result/report.json")).unwrap();
    assert_eq!(report["verdict"], "missing_physics", "{}", outcome.stdout);
    let found = &report["mechanisms"][0];
    assert_eq!(found["kind"], "belt_friction", "{}", outcome.stdout);
    assert_eq!(found["equation"], "slide");
    assert_eq!(found["expression"], "fb*x^2*sign(x')");
    let fb = found["parameters"]["fb"]["value"].as_f64().unwrap();
    assert!((fb / TRUTH.0 - 1.0).abs() < 0.05, "fb = {fb}");
    assert!(bench.read("result/improved.toml").contains("fb*x^2*sign(x')"));
    // Without the file there is no such kind to name.
    let outcome = bench.json(&["diagnose", "model.toml", "run.csv", "--out", "plain"]);
    let kinds: Vec<&str> =
        outcome["mechanisms"].as_array().unwrap().iter().filter_map(|m| m["kind"].as_str()).collect();
    assert!(!kinds.contains(&"belt_friction"), "{kinds:?}");
}

#[test]
fn mechanisms_are_listed_and_the_example_is_one() {
    let bench = bench();
    let listed = |arguments: &[&str]| {
        let json = bench.json(&[&["mechanisms"], arguments].concat());
        let kinds = json["mechanisms"].as_array().unwrap().iter();
        kinds
            .map(|m| (m["kind"].as_str().unwrap().to_owned(), m["law"].as_str().unwrap().to_owned()))
            .collect::<Vec<_>>()
    };
    let belt = ("belt_friction".to_owned(), "fb*d^2*sign(d')".to_owned());
    assert!(!listed(&[]).contains(&belt));
    assert!(listed(&["--mechanisms", "mine"]).contains(&belt));
    let words = bench.greybox(&["mechanisms"]).stdout;
    assert!(
        words.contains("friction\n") && words.contains("  coulomb_friction (motion): fc*sign(d')\n"),
        "{words}"
    );
    // What `--example` prints can be used as it stands.
    let example = bench.greybox(&["mechanisms", "--example"]).stdout;
    bench.write("mine/belt_friction.toml", &example);
    assert!(listed(&["--mechanisms", "mine"]).contains(&belt));
}

#[test]
fn a_built_in_file_is_replaced() {
    let bench = bench();
    fs::remove_file(bench.path("mine/belt_friction.toml")).unwrap();
    let own = belt_friction().replace("belt_friction", "viscous_friction");
    bench.write("mine/viscous_friction.toml", &own);
    let json = bench.json(&["mechanisms", "--mechanisms", "mine"]);
    let laws: Vec<&str> = json["mechanisms"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|m| m["kind"] == "viscous_friction")
        .map(|m| m["law"].as_str().unwrap())
        .collect();
    assert_eq!(laws, ["fb*d^2*sign(d')"]);
    // Another built-in file counts on the parameters of the one that is replaced.
    let own = belt_friction().replace("belt_friction", "coulomb_friction");
    bench.write("mine/coulomb_friction.toml", &own);
    bench.refuses(
        &["mechanisms", "--mechanisms", "mine"],
        &[
            "the built-in asymmetric_coulomb_friction.toml",
            "no parameter `fc`",
            "help: keep the parameters' names",
        ],
    );
}

#[test]
fn wrong_mechanisms_are_refused_and_nothing_is_written() {
    let bench = bench();
    let diagnose = ["diagnose", "model.toml", "run.csv", "--mechanisms", "mine", "--out", "result"];
    let good = belt_friction();
    for (from, to, expected) in [
        (
            "linear   = [\"fb\"]\n",
            "",
            &[
                "mine/belt_friction.toml: the law uses `fb`",
                "--> mine/belt_friction.toml:4\n",
                "list it under `linear`",
            ] as &[&str],
        ),
        ("family", "famly", &["mine/belt_friction.toml: unknown field `famly`", ":2\n"]),
        ("d^2*", "(d^2*", &["`force = \"fb*(d^2*sign(d')\"`", "4 | force    = \"fb*(d^2*sign(d')\"\n"]),
        (
            "\n[about]",
            "refines = [\"rope\"]\n[about]",
            &["`refines` names `rope`, a kind that the library does not have"],
        ),
    ] {
        assert!(good.contains(from));
        bench.write("mine/belt_friction.toml", &good.replacen(from, to, 1));
        bench.refuses(&diagnose, expected);
    }
    fs::remove_file(bench.path("mine/belt_friction.toml")).unwrap();
    bench.refuses(
        &diagnose,
        &["mine: this folder holds no mechanism", "help: `greybox mechanisms --example`"],
    );
    let to = |folder: &'static str| {
        ["diagnose", "model.toml", "run.csv", "--mechanisms", folder, "--out", "result"]
    };
    bench.refuses(&to("yours"), &["yours: no such folder", "help: check the path"]);
    bench.refuses(&to("model.toml"), &["model.toml: this is a file, but `--mechanisms` takes a folder"]);
}
