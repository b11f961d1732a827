//! `greybox identify` as a user meets it: the equation of a Duffing oscillator, units, delay, and one clear error
//! for every bad request.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::path::Path;

use common::{Bench, names};
use noise::Noise;
use serde_json::Value;

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/noise.rs"]
mod noise;

/// Coefficients of the oscillator of the thesis, section 2.3: 2x″ + 6x + 0.1x³ + x′ + 0.2x²x′ + x′³ = f.
const TRUTH: [(&str, f64); 6] =
    [("x''", 2.0), ("x", 6.0), ("x^3", 0.1), ("x'", 1.0), ("x^2*x'", 0.2), ("x'^3", 1.0)];

/// A recording `t, f, x` of x″ = rate(x, x′, f) (Runge–Kutta of order four, ten steps per sample), x with noise and
/// times `scale`. The force is a straight line between samples, as the default hold says.
fn recorded(
    [force_header, x_header]: [&str; 2],
    scale: f64,
    seconds: f64,
    phase: f64,
    rate: impl Fn(f64, f64, f64) -> f64,
) -> String {
    let (dt, fine) = (0.01, 10);
    let sample = |t: f64| 10.0 * (t + phase).sin() + 40.0 * (4.0 * t).sin();
    let force = |t: f64| {
        let start = (t / dt + 1e-9).floor() * dt;
        sample(start) + (t - start) / dt * (sample(start + dt) - sample(start))
    };
    let h = dt / f64::from(fine);
    let mut noise = Noise(7);
    let (mut x, mut v) = (0.0, 0.0);
    let mut text = format!("t,{force_header},{x_header}\n");
    for row in 0..=(seconds / dt).round() as usize {
        let start = row as f64 * dt;
        let shown = scale * (x + 0.002 * noise.normal());
        writeln!(text, "{start:.2},{:.7},{shown:.7}", force(start)).unwrap();
        for step in 0..fine {
            let t = start + f64::from(step) * h;
            let (a1, v1) = (rate(x, v, force(t)), v);
            let (a2, v2) = (rate(x + 0.5 * h * v1, v + 0.5 * h * a1, force(t + 0.5 * h)), v + 0.5 * h * a1);
            let (a3, v3) = (rate(x + 0.5 * h * v2, v + 0.5 * h * a2, force(t + 0.5 * h)), v + 0.5 * h * a2);
            let (a4, v4) = (rate(x + h * v3, v + h * a3, force(t + h)), v + h * a3);
            x += h / 6.0 * (v1 + 2.0 * (v2 + v3) + v4);
            v += h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4);
        }
    }
    text
}

fn duffing(headers: [&str; 2], scale: f64, seconds: f64, phase: f64) -> String {
    recorded(headers, scale, seconds, phase, |x, v, f| {
        (f - 6.0 * x - 0.1 * x.powi(3) - v - 0.2 * x * x * v - v.powi(3)) / 2.0
    })
}

/// A folder with `train.csv` (40 s) and `test.csv` (20 s) of the oscillator.
fn bench() -> Bench {
    let bench = Bench::empty();
    bench.write("train.csv", &duffing(["f [N]", "x [m]"], 1.0, 40.0, 0.0));
    bench.write("test.csv", &duffing(["f [N]", "x [m]"], 1.0, 20.0, 1.0));
    bench
}

/// The usual request.
const DUFFING: [&str; 10] =
    ["identify", "train.csv", "--states", "x", "--inputs", "f", "--library", "total", "--order", "3"];

/// The linear oscillator, its parameters off.
const NOMINAL: &str = r#"
[inputs]
f = { unit = "N", hold = "linear" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 2.0, unit = "kg", fixed = true }
c = { value = 2.0, unit = "N s/m" }
k = { value = 5.0, unit = "N/m" }
[equations]
mass = "m*x'' + c*x' + k*x = f"
"#;

/// The three terms that it lacks, with their coefficients and without names.
#[test]
fn a_nominal_model_is_given_the_terms_that_it_lacks() {
    let bench = bench();
    bench.write("nominal.toml", NOMINAL);
    let request = ["identify", "train.csv", "--model", "nominal.toml", "--holdout", "test.csv", "--out", "o"];
    let outcome = bench.greybox(&request);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    let reported = outcome.stdout;
    assert!(reported.starts_with("Terms are missing from the model: "), "{reported}");
    assert!(reported.ends_with("Written: o/report.html, o/report.json, o/model.toml\n"), "{reported}");
    let report: Value = serde_json::from_str(&bench.read("o/report.json")).unwrap();
    assert_eq!((&report["terms_only"], &report["basis"]), (&Value::Bool(true), &"proposed".into()));
    assert_eq!(report["mechanisms"].as_array().unwrap().len(), 0);
    let mut found: Vec<(String, f64)> =
        report["candidates"].as_array().unwrap().iter().map(coefficient).collect();
    found.sort_by(|a, b| a.0.cmp(&b.0));
    let truth = [("cubic_damping", 1.0), ("cubic_stiffness", 0.1), ("position_dependent_damping", 0.2)];
    assert_eq!(found.iter().map(|f| &*f.0).collect::<Vec<_>>(), truth.map(|t| t.0));
    assert!(found.iter().zip(truth).all(|(f, t)| (f.1 / t.1 - 1.0).abs() < 0.1), "{found:?}");
    let model = bench.read("o/model.toml");
    assert_eq!(model.matches("proposed by greybox, not named").count(), 3, "{model}");
    // What it wrote is a model again.
    assert_eq!(bench.greybox(&["simulate", "o/model.toml", "test.csv", "--out", "again.csv"]).code, 0);
    // Equations and their channels cannot both be given.
    let both = [&request[..], &["--states", "x"]].concat();
    bench.refuses(&both, &["--model", "--states"]);
    bench.refuses(&["identify", "train.csv", "--out", "p"], &["--states"]);
}

/// Kind and only coefficient of a candidate.
fn coefficient(candidate: &Value) -> (String, f64) {
    let values = candidate["parameters"].as_object().unwrap();
    assert_eq!(values.len(), 1, "{candidate}");
    let value = values.values().next().unwrap()["value"].as_f64().unwrap();
    (candidate["kind"].as_str().unwrap().to_owned(), value)
}

/// The terms of the only equation.
fn terms(report: &Value) -> &Vec<Value> {
    report["equations"]["x"]["terms"].as_array().unwrap()
}

#[test]
fn the_duffing_oscillator_is_found_and_simulates_as_well_as_the_report_says() {
    let bench = bench();
    let report =
        bench.json(&[&DUFFING as &[&str], &["--holdout", "test.csv", "--out", "new/found"]].concat());
    let found = terms(&report);
    let mut expressions: Vec<&str> = found.iter().map(|t| t["expression"].as_str().unwrap()).collect();
    assert_eq!(expressions[0], "x''");
    expressions.sort_unstable();
    let mut expected = TRUTH.map(|t| t.0);
    expected.sort_unstable();
    assert_eq!(expressions, expected);
    for (expression, truth) in TRUTH {
        let term = found.iter().find(|t| t["expression"] == expression).unwrap();
        let (value, low) = (term["value"].as_f64().unwrap(), term["ci95"][0].as_f64().unwrap());
        let half = value - low;
        assert!((value - truth).abs() < 2.0 * half, "{expression}: {value} ± {half}, not {truth}");
        assert!(half < 0.3 * truth, "{expression}: ± {half} says nothing");
    }
    let cubic = found.iter().find(|t| t["expression"] == "x^2*x'").unwrap();
    assert_eq!(cubic["powers"], serde_json::json!({ "x": 2, "x'": 1 }));
    assert_eq!(cubic["unit"], "kg/(m^2 s)");
    assert!(cubic["inclusion"].as_f64().unwrap() > 0.5);
    assert_eq!(report["equations"]["x"]["input"], "f");
    assert!(report["order"]["by_order"][0].as_array().unwrap().len() == 2);

    assert_eq!(names(&bench.path("new/found")), ["model.toml", "report.html", "report.json"]);
    let written: Value = serde_json::from_str(&bench.read("new/found/report.json")).unwrap();
    assert_eq!(written, report);
    let said = report["fit"]["holdout"]["improved"]["x"]["nrmse"].as_f64().unwrap();
    let run = bench.json(&["simulate", "new/found/model.toml", "test.csv", "--out", "simulated.csv"]);
    let nrmse = run["fit"]["x"]["nrmse"].as_f64().unwrap();
    assert!((nrmse / said - 1.0).abs() < 0.05, "{nrmse} {said}");
    let floor = report["noise_floor"]["x"].as_f64().unwrap();
    assert!(nrmse < 2.0 * floor, "{nrmse} {floor}");
}

#[test]
fn every_part_of_the_library_makes_an_equation() {
    let bench = Bench::empty();
    let pendulum =
        recorded(["f [N m]", "theta [rad]"], 1.0, 20.0, 0.0, |x, v, f| 0.2 * f - 9.0 * x.sin() - 0.5 * v);
    bench.write("train.csv", &pendulum);
    let request = |library: &'static str| {
        let names = ["identify", "train.csv", "--states", "theta", "--inputs", "f", "--order", "1"];
        [&names[..], &["--replicates", "1", "--library", library, "--out", "out"]].concat()
    };
    for library in ["tensor", "total", "separate", "constant", "friction", "trigonometric", "lagrangian"] {
        let outcome = bench.greybox(&request(library));
        assert_eq!(outcome.code, 0, "{library}: {}", outcome.stderr);
    }
    let report = bench.json(&request("separate,constant,friction,trigonometric"));
    let sine = report["equations"]["theta"]["terms"].as_array().unwrap().iter();
    assert!(sine.clone().any(|t| t["expression"] == "sin(theta)"), "{report:#}");
    assert!(bench.read("out/model.toml").contains("a_sin*sin(theta)"));
    bench.write("length.csv", &pendulum.replace("[rad]", "[m]"));
    let mut lengths = request("trigonometric");
    lengths[1] = "length.csv";
    bench.refuses(&lengths, &["none of the states (theta) is an angle", "`rad` or `deg`"]);
}

#[test]
fn every_state_needs_an_order_of_its_own_that_is_one_or_two() {
    let bench = bench();
    let train = bench.read("train.csv");
    let both = train.replacen("x [m]", "x [m],y [m]", 1);
    let rows = both.lines().enumerate().map(|(i, line)| match i {
        0 => line.to_owned(),
        _ => format!("{line},{}", line.rsplit(',').next().unwrap()),
    });
    bench.write("both.csv", &rows.collect::<Vec<_>>().join("\n"));
    let request =
        ["identify", "both.csv", "--states", "x,y", "--inputs", "f", "--out", "out", "--derivatives"];
    bench.refuses(&[&request[..], &["2,1,1"]].concat(), &["3 orders of leading derivatives", "x, y"]);
    bench.refuses(&[&request[..], &["2,3"]].concat(), &["leading derivative is 3"]);
}

#[test]
fn a_recording_is_read_in_blocks_and_the_stages_are_told() {
    let bench = bench();
    let blocks = ["--block", "1000", "--out", "out", "--json", "--log"];
    let outcome = bench.greybox(&[&DUFFING as &[&str], &blocks].concat());
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    let report: Value = serde_json::from_str(&outcome.stdout).unwrap();
    let found: Vec<&str> = terms(&report).iter().map(|t| t["expression"].as_str().unwrap()).collect();
    assert_eq!(found.len(), TRUTH.len(), "{found:?}");
    assert!(TRUTH.iter().all(|(name, _)| found.contains(name)), "{found:?}");
    assert_eq!(report["fit"]["holdout_source"], "the last block of the recordings");
    // 4001 rows: four blocks of 1000, the last with the row that is left and held out.
    assert_eq!(report["blocks"]["samples"], 3000);
    assert_eq!(report["blocks"]["blocks"], 3);
    assert_eq!(report["blocks"]["settled"], true);
    assert!(report["findings"].as_array().unwrap().iter().any(|f| f["code"] == "blocks"));
    // One line a stage as it begins, then what each sort of them cost.
    let log: Vec<&str> = outcome.stderr.lines().collect();
    assert!(log[0].ends_with(" s  first estimates (weak form)"), "{}", log[0]);
    assert!(log.iter().any(|l| l.ends_with("  done")) && log.iter().any(|l| l.starts_with("stage ")));
    // Without the flag there is nothing on standard error.
    let quiet = bench.greybox(&[&DUFFING as &[&str], &blocks[..5]].concat());
    assert_eq!((quiet.code, quiet.stderr.as_str()), (0, ""));
    assert_eq!(quiet.stdout, outcome.stdout);

    bench.write("late.csv", "t,f,x\n0,1,2\n0.1,1,oops\n");
    let broken =
        bench.greybox(&["identify", "late.csv", "--states", "x", "--block", "1000", "--out", "none"]);
    assert_eq!(broken.code, 2);
    assert!(broken.stderr.contains("late.csv:3:"), "{}", broken.stderr);
    assert!(!bench.path("none/report.json").exists());
}

#[test]
fn the_story_has_the_equation_the_prediction_and_the_terms() {
    let bench = bench();
    let outcome = bench.greybox(&[&DUFFING as &[&str], &["--out", "out"]].concat());
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    for part in [
        "Equation of x: ",
        " x″ + ",
        " = f.\nRunning freely, the model follows the held-out data",
        "\nx: m*x'' + ",
        "chosen in",
        "kg s/m²",
        "Held out: the last fifth of each recording.",
        "Written: out/report.html",
    ] {
        assert!(outcome.stdout.contains(part), "`{part}` is not in:\n{}", outcome.stdout);
    }
}

/// The equations count in SI, whatever the unit of the recording; the model that is written says the same.
#[test]
fn other_units_give_the_same_equation_and_a_model_that_fits_the_same_file() {
    let bench = Bench::empty();
    let metres = duffing(["f [N]", "x [m]"], 1.0, 20.0, 0.0);
    bench.write("train.csv", &metres);
    let reference = bench.json(&[&DUFFING as &[&str], &["--out", "m"]].concat());
    let cases = [
        ("f [N]", "x [mm]", 1e3, "m", "kg"),
        ("f [N m]", "x [deg]", 180.0 / std::f64::consts::PI, "rad", "kg m^2"),
    ];
    for (force, position, scale, coherent, mass) in cases {
        bench.write("train.csv", &duffing([force, position], scale, 20.0, 0.0));
        let report = bench.json(&[&DUFFING as &[&str], &["--out", "other"]].concat());
        assert_eq!(report["variables"]["x"]["unit"], coherent);
        assert_eq!(terms(&report)[0]["unit"], mass);
        assert_eq!(terms(&report).len(), terms(&reference).len());
        for (a, b) in terms(&report).iter().zip(terms(&reference)) {
            let (a, b) = (a["value"].as_f64().unwrap(), b["value"].as_f64().unwrap());
            assert!((a / b - 1.0).abs() < 0.02, "{position}: {a} {b}");
        }
        let run = bench.json(&["simulate", "other/model.toml", "train.csv", "--out", "simulated.csv"]);
        let nrmse = run["fit"]["x"]["nrmse"].as_f64().unwrap();
        let said = report["fit"]["train"]["improved"]["x"]["nrmse"].as_f64().unwrap();
        assert!((nrmse / said - 1.0).abs() < 0.2, "{position}: {nrmse} {said}");
    }
}

#[test]
fn without_units_no_unit_is_claimed() {
    let bench = Bench::empty();
    bench.write("train.csv", &duffing(["f", "x"], 1.0, 20.0, 0.0));
    let report = bench.json(&[&DUFFING as &[&str], &["--out", "out"]].concat());
    assert_eq!(report["variables"]["x"]["unit"], "");
    assert!(terms(&report).iter().all(|t| t.get("unit").is_none()), "{report}");
    let run = bench.json(&["simulate", "out/model.toml", "train.csv", "--out", "simulated.csv"]);
    assert!(run["fit"]["x"]["nrmse"].as_f64().unwrap() < 0.01);
}

/// 1.5x″ + 2x′ + 8x − 3x(t − 0.2 s) = f, integrated by semi-implicit Euler with steps of 1 ms.
fn delayed() -> String {
    let force = |t: f64| {
        3.0 * (1.3 * t).sin() + 4.0 * (2.9 * t + 1.0).sin() + 3.0 * (5.1 * t).sin() + 3.0 * (9.3 * t).sin()
    };
    let mut noise = Noise(3);
    let (mut history, mut x, mut v) = (vec![0.0; 200], 0.0, 0.0);
    let mut text = String::from("t,f [N],x [m]\n");
    for step in 0..40_000u32 {
        let t = f64::from(step) * 1e-3;
        if step % 10 == 0 {
            writeln!(text, "{t:.2},{:.7},{:.7}", force(t), x + 2e-4 * noise.normal()).unwrap();
        }
        let delayed = history[step as usize];
        history.push(x);
        v += 1e-3 * (force(t) + 3.0 * delayed - 8.0 * x - 2.0 * v) / 1.5;
        x += 1e-3 * v;
    }
    text
}

/// 40 s of 2x″ + x′ + 6x + 0.1x³ = f whose force is recorded 0.07 s before it acts.
fn late() -> String {
    let prompt =
        recorded(["f [N]", "x [m]"], 1.0, 40.0, 0.0, |x, v, f| (f - 6.0 * x - 0.1 * x.powi(3) - v) / 2.0);
    let rows: Vec<Vec<&str>> = prompt.lines().skip(1).map(|row| row.split(',').collect()).collect();
    let mut text = "t,f [N],x [m]\n".to_owned();
    for (row, later) in rows.iter().zip(&rows[7..]) {
        writeln!(text, "{},{},{}", row[0], later[1], row[2]).unwrap();
    }
    text
}

#[test]
fn a_dead_time_is_told_and_the_model_with_it_is_one_for_the_other_commands() {
    let bench = Bench::empty();
    bench.write("train.csv", &late());
    let request =
        ["identify", "train.csv", "--states", "x", "--inputs", "f", "--library", "total", "--order", "3"];
    let asked = ["--dead-time", "f=0.3", "--hold", "linear", "--replicates", "5", "--out", "found"];
    let outcome = bench.greybox(&[&request[..], &asked].concat());
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/identify.md");
    let page = std::fs::read_to_string(page).unwrap();
    for said in ["= f(t − 0.0", "The dead time of f is (0.0"] {
        let line = outcome.stdout.lines().find(|line| line.contains(said)).unwrap();
        assert!(page.contains(line), "the book has another output: {line}");
    }
    let report: Value = serde_json::from_str(&bench.read("found/report.json")).unwrap();
    let dead_time = &report["dead_time"]["f"];
    let (value, low) = (dead_time["value"].as_f64().unwrap(), dead_time["ci95"][0].as_f64().unwrap());
    assert!((value - 0.07).abs() < 3.0 * (value - low) && value - low < 0.005, "{dead_time}");
    assert_eq!((&dead_time["longest"], &dead_time["parameter"]), (&0.3.into(), &"tau_f".into()));
    assert!(dead_time["warning"].is_null(), "{dead_time}");
    let model = bench.read("found/model.toml");
    assert!(model.contains("delay(f, tau_f)") && model.contains("95 % interval 0.0"), "{model}");
    assert!(bench.read("found/report.html").contains("Dead time"));
    for command in [
        &["simulate", "found/model.toml", "train.csv", "--out", "again.csv"][..],
        &["calibrate", "found/model.toml", "train.csv", "--out", "calibrated"],
        &["diagnose", "found/model.toml", "train.csv", "--out", "diagnosed"],
    ] {
        let outcome = bench.greybox(command);
        assert_eq!(outcome.code, 0, "{command:?}: {}", outcome.stderr);
    }
    let verdict: Value = serde_json::from_str(&bench.read("diagnosed/report.json")).unwrap();
    assert_eq!(verdict["verdict"], "consistent");
}

#[test]
fn a_delay_has_its_interval_and_its_bound() {
    let bench = Bench::empty();
    bench.write("train.csv", &delayed());
    let request = ["identify", "train.csv", "--states", "x", "--inputs", "f", "--order", "1", "--delay", "x"];
    let report =
        bench.json(&[&request as &[&str], &["--gain", "3", "--longest", "0.6", "--out", "out"]].concat());
    let delay = &report["delay"]["x"];
    assert_eq!((delay["unit"].as_str(), delay["gain"].as_f64()), (Some("s"), Some(3.0)), "{delay}");
    assert!(delay["gain_ci95"].is_null(), "a gain that was given has no interval");
    let value = delay["value"].as_f64().unwrap();
    assert!((value - 0.2).abs() < 0.02, "{delay}");
    assert!(delay["ci95"][0].as_f64().unwrap() < value && delay["bound"].as_f64().unwrap() > 0.0, "{delay}");
    let model = bench.read("out/model.toml");
    assert!(model.contains("delay(x, tau)") && model.contains("tau = {"), "{model}");
    let run = bench.json(&["simulate", "out/model.toml", "train.csv", "--out", "simulated.csv"]);
    assert!(run["fit"]["x"]["nrmse"].as_f64().unwrap() < 0.02, "{run}");
}

#[test]
fn requests_that_cannot_be_met() {
    let bench = Bench::empty();
    let motion = duffing(["f [N]", "x [m]"], 1.0, 10.0, 0.0);
    let rows = motion.lines().skip(1).map(|row| format!("{row},0.5,{}\n", row.len()));
    bench.write("run.csv", &format!("t,f [N],x [m],still [m],bad name\n{}", rows.collect::<String>()));
    bench.write("model.toml", "[states]\n[equations]\n");
    let cases: [(&[&str], &[&str]); 25] = [
        (&["--inputs", "f"], &["--states"]),
        (&["--states", "", "--inputs", "f"], &["no state is named"]),
        (&["--states", "z", "--inputs", "f"], &["run.csv", "no channel `z`", "`f`, `x`", "help:"]),
        (&["--states", "x", "--inputs", "g"], &["run.csv", "no channel `g`"]),
        (&["--states", "x,x", "--inputs", "f"], &["`x` is named twice", "as state and as state"]),
        (&["--states", "x", "--inputs", "x"], &["`x` is named twice", "as state and as input"]),
        (&["--states", "bad name", "--inputs", "f"], &["`bad name` cannot be a name", "header"]),
        (&["--states", "sin", "--inputs", "f"], &["`sin` cannot be a name"]),
        (&["--states", "still", "--inputs", "f"], &["`still` does not move"]),
        (&["--states", "x", "--inputs", "f", "--delay", "f"], &["`f` is not among the states x"]),
        (&["--states", "x", "--delay", "x"], &["an input must be named"]),
        (&["--states", "x", "--inputs", "f", "--delay", "x", "--longest", "-1"], &["longest delay is -1"]),
        (&["--states", "x", "--inputs", "f", "--gain", "2"], &["--delay"]),
        (&["--states", "x", "--inputs", "f", "--dead-time", "x"], &["`x`", "not among the inputs (f)"]),
        (&["--states", "x", "--inputs", "f", "--dead-time", "f=-1"], &["longest dead time is -1"]),
        (
            &["--states", "x", "--inputs", "f", "--dead-time", "f=soon"],
            &["`soon` is not a number of seconds"],
        ),
        (
            &["--states", "x", "--inputs", "f", "--dead-time", "f", "--delay", "x"],
            &["not looked for together"],
        ),
        (&["--states", "x", "--inputs", "f", "--order", "0"], &["order of the library is 0", "1 to 12"]),
        (&["--states", "x", "--inputs", "f", "--derivatives", "3"], &["leading derivative is 3"]),
        (&["--states", "x", "--inputs", "f", "--library", "cubic"], &["cubic", "tensor, total, separate"]),
        (&["--states", "x", "--inputs", "f", "--library", "tensor,total"], &["two kinds", "help:"]),
        (&["--states", "x", "--inputs", "f", "--term", "x*("], &["term `x*(`"]),
        (&["--states", "x", "--inputs", "f", "--term", "q*x"], &["`q` is neither a state nor an input"]),
        (&["--states", "x", "--inputs", "f", "--hold", "cubic"], &["cubic", "zero, linear, band_limited"]),
        (&["--states", "x", "--inputs", "f", "--replicates", "0"], &["--replicates"]),
    ];
    for (request, expected) in cases {
        bench.refuses(&[&["identify", "run.csv", "--out", "out"], request].concat(), expected);
    }
    let usual = ["--states", "x", "--inputs", "f", "--out", "out"];
    bench.refuses(&[&["identify", "model.toml"] as &[&str], &usual].concat(), &["this is a model"]);
    bench.refuses(&[&["identify", "nowhere.csv"] as &[&str], &usual].concat(), &["no such file"]);
    let twice = [&["identify", "run.csv", "--holdout", "run.csv"] as &[&str], &usual].concat();
    bench.refuses(&twice, &["named twice", "help:"]);
}

#[test]
fn a_json_error_names_the_channel() {
    let bench = bench();
    let request = ["identify", "train.csv", "--states", "z", "--inputs", "f", "--out", "out", "--json"];
    let json: Value = serde_json::from_str(&bench.greybox(&request).stdout).unwrap();
    assert_eq!(json["error"]["file"], "train.csv", "{json}");
    assert_eq!(json["error"]["channel"], "z", "{json}");
}
