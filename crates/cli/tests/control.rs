//! `greybox control`: a law from a model file, and code that gives the same commands.
#![allow(missing_docs, clippy::print_stdout, clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;

use assert_cmd::cargo::CommandCargoExt as _;

const MODEL: &str = r#"name = "Arm"

[inputs]
v = { unit = "V" }

[states]
theta = { unit = "rad" }

[parameters]
J = { value = 0.02, unit = "kg m^2", std = 0.002 }
b = { value = 0.15, unit = "N m s/rad" }
fc = { value = 0.005, unit = "N m", std = 0.001 }
mgl = { value = 0.5, unit = "N m", std = 0.03 }
kt = { value = 0.4, unit = "N m/V" }

[equations]
arm = "J*theta'' + b*theta' + fc*sign(theta') + mgl*sin(theta) = kt*v"
"#;

fn greybox(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::cargo_bin("greybox").unwrap().current_dir(folder).args(arguments).output().unwrap();
    let text = |b: Vec<u8>| String::from_utf8(b).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn every_method_gives_a_law_that_tracks_and_code_that_agrees() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("arm.toml"), MODEL).unwrap();
    let bounded: &[&str] = &["--bounded"];
    for (method, name, more) in
        [("lqr", "lqr", &[][..]), ("hjb", "hjb", &[]), ("hjb", "bounded", bounded), ("smc", "smc", &[])]
    {
        let arguments = [
            "control",
            "arm.toml",
            "--method",
            method,
            "--to",
            "0.8",
            "--size",
            "theta=0.4",
            "--size",
            "theta'=4",
            "--input-size",
            "5",
            "--limit",
            "10",
            "--dt",
            "0.002",
            "--members",
            "10",
            "--out",
            name,
            "--json",
        ];
        let (code, out, err) = greybox(folder.path(), &[&arguments[..], more].concat());
        assert_eq!(code, Some(0), "{name}: {err}");
        let report: serde_json::Value = serde_json::from_str(&out).unwrap();
        assert_eq!(report["bounded"], !more.is_empty());
        assert_eq!(report["law"][0].as_str().unwrap().contains("tanh("), !more.is_empty(), "{report}");
        assert_eq!(report["closed_loop"]["diverged"], false);
        for point in report["closed_loop"]["set_points"].as_array().unwrap() {
            assert!(point["final_error"].as_f64().unwrap().abs() < 0.02, "{name}: {point}");
        }
        assert_eq!(report["family"]["diverged"], 0, "{name}");
        let of = |name: &str, which: &str| report["family"]["margins"][name][which].as_f64().unwrap();
        let own = |name: &str| {
            let all = report["checks"].as_array().unwrap().iter();
            all.map(|c| c["margins"][name].as_f64().unwrap()).fold(f64::INFINITY, f64::min)
        };
        for margin in ["gain", "phase", "delay"] {
            let (worst, median) = (of(margin, "worst"), of(margin, "median"));
            // Ten plants, perturbed by a tenth: some are worse than the model, and none is without margin.
            assert!(
                0.5 * own(margin) < worst && worst < own(margin),
                "{name} {margin}: {worst} {}",
                own(margin)
            );
            assert!(worst < median, "{name} {margin}: {worst} {median}");
        }
        assert_eq!(report["family"]["unstable"], 0, "{name}");
        for figure in ["effort", "peak_to_peak"] {
            assert!(
                report["family"][figure]["worst"].as_f64() >= report["family"][figure]["median"].as_f64()
            );
        }
        assert_eq!(report["verdict"], "settles", "{name}");
        for check in report["checks"].as_array().unwrap() {
            let radius = |p: &serde_json::Value| p[0].as_f64().unwrap().hypot(p[1].as_f64().unwrap());
            let held: Vec<f64> = check["held_poles"].as_array().unwrap().iter().map(radius).collect();
            assert_eq!(held[0], check["spectral_radius"].as_f64().unwrap());
            assert!(held.len() == 2 && held[1] <= held[0] && held[0] < 1.0, "{name}: {check}");
        }
        let read = |file: &str| std::fs::read_to_string(folder.path().join(name).join(file)).unwrap();
        assert!(
            read("law.rs").contains("pub fn control_law(state: &[f64; 2], set_point: &[f64; 1]) -> [f64; 1]")
        );
        agrees(&folder.path().join(name), &read("vectors.csv"));
        page_says(&read("report.html"), &report);
    }
}

/// The page has the sections in order, the numbers of the JSON, and nothing from elsewhere.
fn page_says(html: &str, report: &serde_json::Value) {
    let places: Vec<usize> = ["verdict", "loop", "family", "law", "stability", "promises", "reading"]
        .iter()
        .map(|id| html.find(&format!("<section id=\"{id}\"")).unwrap_or_else(|| panic!("no section {id}")))
        .collect();
    assert!(places.is_sorted(), "{places:?}");
    let law = report["law"][0].as_str().unwrap().replace('\'', "&#39;");
    assert!(html.contains(&law), "{law}");
    assert!(html.contains("settle at every set point") && html.contains("Controller of Arm"));
    for link in html.split("href=\"").skip(1) {
        assert!(link.starts_with('#'), "a link leaves the page");
    }
}

#[test]
fn a_loop_that_does_not_settle_is_not_praised() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("arm.toml"), MODEL).unwrap();
    let verdict = |more: &[&str]| {
        let all = [&["control", "arm.toml", "--to", "0.3", "--out", "o", "--json"], more].concat();
        let (code, out, err) = greybox(folder.path(), &all);
        assert_eq!(code, Some(0), "{err}");
        let report: serde_json::Value = serde_json::from_str(&out).unwrap();
        let html = std::fs::read_to_string(folder.path().join("o/report.html")).unwrap();
        (report["verdict"].as_str().unwrap().to_owned(), html)
    };
    // A set point for too short a time.
    let (reported, html) = verdict(&["--hold", "0.05", "--members", "0"]);
    assert_eq!(reported, "unsettled");
    assert!(html.contains("does not come to stay within 2") && html.contains("No perturbed plants"));
    assert!(!html.contains("<section id=\"family\""));
    // A gravity so uncertain that a law without integral action is often off.
    std::fs::write(folder.path().join("arm.toml"), MODEL.replace("std = 0.03", "std = 0.2")).unwrap();
    let (reported, html) = verdict(&["--size", "theta=0.2", "--hold", "4", "--members", "40"]);
    assert_eq!(reported, "fragile");
    assert!(html.contains("not on every perturbed plant"));
}

/// The C law, compiled freestanding with all warnings as errors, gives the commands of the vectors.
fn agrees(folder: &Path, vectors: &str) {
    if Command::new("gcc").arg("--version").output().is_err() {
        println!("skipped: no C compiler here");
        return;
    }
    let rows: Vec<&str> = vectors.lines().skip(1).collect();
    assert!(rows.len() >= 64);
    // The state, the reference with what derivatives the law reads, the command.
    let columns = rows[0].split(',').count();
    let main = format!(
        "#include <stdio.h>\nvoid control_law(const double state[2], const double set_point[{r}], double out[1]);\n\
         static const double in[{n}][{columns}] = {{{}}};\nint main(void) {{\n double worst = 0.0;\n\
         for (int i = 0; i < {n}; i++) {{\n  double u[1];\n  control_law(in[i], in[i] + 2, u);\n\
         const double off = u[0] > in[i][{last}] ? u[0] - in[i][{last}] : in[i][{last}] - u[0];\n\
         if (!(off <= worst)) worst = off;\n }}\n printf(\"%.3e\\n\", worst);\n return 0;\n}}\n",
        rows.iter().map(|r| format!("{{{r}}}")).collect::<Vec<_>>().join(", "),
        n = rows.len(),
        r = columns - 3,
        last = columns - 1
    );
    std::fs::write(folder.join("main.c"), main).unwrap();
    let strict = ["-std=c99", "-O2", "-ffreestanding", "-Wall", "-Werror", "-c", "law.c", "-o", "law.o"];
    let links = ["main.c", "law.o", "-lm", "-o", "run"];
    for arguments in [&strict[..], &links[..]] {
        let made = Command::new("gcc").current_dir(folder).args(arguments).output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    }
    let worst = Command::new(folder.join("run")).output().unwrap();
    let worst: f64 = String::from_utf8(worst.stdout).unwrap().trim().parse().unwrap();
    assert!(worst < 1e-9, "{worst:e}");
}

#[test]
fn what_cannot_be_controlled_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("arm.toml", MODEL);
    write("late.toml", &MODEL.replace("= kt*v", "= kt*delay(v, 0.1)"));
    write(
        "shaken.toml",
        &MODEL.replace("= kt*v", "= kt*v + ad*sin(om*t)").replace(
            "[eq",
            "ad = { value = 0.1, unit = \"N m\" }\nom = { value = 7, unit = \"1/s\" }\n\n[eq",
        ),
    );
    write(
        "two.toml",
        &MODEL
            .replace("v = { unit = \"V\" }", "v = { unit = \"V\" }\nw = { unit = \"N m\" }")
            .replace("= kt*v", "= kt*v + w"),
    );
    for (arguments, part) in [
        (&["control", "arm.toml", "--track", "phi", "--out", "o"][..], "no state `phi`"),
        (&["control", "arm.toml", "--input", "w", "--out", "o"], "no input `w`"),
        (&["control", "arm.toml", "--size", "theta", "--out", "o"], "NAME=VALUE"),
        (&["control", "arm.toml", "--dt", "0", "--out", "o"], "sample time is 0"),
        (
            &["control", "arm.toml", "--to", "1.5", "--limit", "0.1", "--out", "o"],
            "the actuator gives -0.1 to 0.1",
        ),
        (&["control", "late.toml", "--out", "o"], "delay"),
        (&["control", "shaken.toml", "--out", "o"], "time"),
        (&["control", "two.toml", "--out", "o"], "--input"),
        (&["control", "missing.toml", "--out", "o"], "no such file"),
    ] {
        let (code, _, err) = greybox(folder.path(), arguments);
        assert_eq!(code, Some(2), "{arguments:?}: {err}");
        assert!(err.contains(part), "{arguments:?}: {err}");
        assert!(!folder.path().join("o").exists());
    }
    // With the disturbance left out of the design, the loop is simulated with it.
    let (code, out, err) = greybox(
        folder.path(),
        &["control", "shaken.toml", "--ignore-time-terms", "--to", "0.5", "--out", "o"],
    );
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("left out of arm"), "{out}");
}

/// With an observer the loop rests on the set point in spite of friction and load, and its code, fed with what the sensors
/// said, gives the commands of the simulated loop, in C and in Rust alike, also where a measurement is missing.
#[test]
fn output_feedback_gives_code_that_repeats_the_loop() {
    let folder = tempfile::tempdir().unwrap();
    let sticky = MODEL.replace("value = 0.005", "value = 0.05");
    let late = |tau: &str| {
        let parameter = format!("tau = {{ value = {tau}, unit = \"s\" }}\n\n[eq");
        sticky.replace("= kt*v", "= kt*delay(v, tau)").replace("\n[eq", &parameter)
    };
    // The command acts at once, after whole samples, and after a part of one too.
    for (name, text) in [("arm", sticky.clone()), ("whole", late("0.014")), ("late", late("0.015"))] {
        std::fs::write(folder.path().join(format!("{name}.toml")), text).unwrap();
    }
    let settings = [
        "--to",
        "0.8",
        "--size",
        "theta=0.4",
        "--size",
        "theta'=4",
        "--input-size",
        "5",
        "--limit",
        "10",
        "--dt",
        "0.002",
        "--members",
        "10",
        "--hold",
        "3",
        "--json",
    ];
    let both = |model| [(model, "kalman"), (model, "eso")];
    for (model, observer) in ["arm", "whole", "late"].into_iter().flat_map(both) {
        let place = format!("{model}-{observer}");
        let own =
            ["--feedback", "output", "--observer", observer, "--resolution", "theta=0.0015", "--out", &place];
        let file = format!("{model}.toml");
        let all = [&["control", &file][..], &settings, &own].concat();
        let (code, out, err) = greybox(folder.path(), &all);
        assert_eq!(code, Some(0), "{place}: {err}");
        let report: serde_json::Value = serde_json::from_str(&out).unwrap();
        assert_eq!((&report["observer"]["kind"], &report["verdict"]), (&observer.into(), &"settles".into()));
        assert_eq!(report["family"]["settled"], 10, "{place}");
        for point in report["closed_loop"]["set_points"].as_array().unwrap() {
            assert!(point["final_error"].as_f64().unwrap().abs() < 2.0 * 0.0015, "{place}: {point}");
            assert!(point["peak_to_peak"].as_f64().unwrap() < 2.0 * 0.0015, "{place}: {point}");
        }
        for check in report["checks"].as_array().unwrap() {
            let with = &check["with_observer"]["margins"];
            let own = with["phase"].as_f64().unwrap();
            // With the full state alone there is no law for a late command.
            let full = check["margins"]["phase"].as_f64();
            assert!(own > 0.4 && full.is_none_or(|full| own < full), "{place}: {own} {full:?}");
            assert_eq!(full.is_some(), model == "arm");
        }
        let read = |name: &str| std::fs::read_to_string(folder.path().join(&place).join(name)).unwrap();
        let html = read("report.html");
        assert!(
            html.contains("Margins of the sampled loop with its observer")
                && html.contains("What is measured")
        );
        assert!(!html.contains("There is no integral action"));
        repeats(&folder.path().join(&place), &read("observer_vectors.csv"), None);
    }
    // What belongs to an observer is not for the full state.
    let more = ["--noise", "theta=0.1", "--out", "o"];
    let (code, _, err) = greybox(folder.path(), &[&["control", "arm.toml"][..], &settings, &more].concat());
    assert!(code == Some(2) && err.contains("--feedback output"), "{err}");
}

#[test]
fn an_option_of_another_method_or_observer_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("arm.toml"), MODEL).unwrap();
    for (given, belongs) in [
        ("--degree 6", "--method hjb"),
        ("--bounded", "--method hjb"),
        ("--lambda 20 --method hjb", "--method smc"),
        ("--rate 20", "--method smc"),
        ("--eta 3", "--method smc"),
        ("--compensate-friction", "--method smc"),
        ("--feedback output --bandwidth 30", "--observer eso"),
        ("--feedback output --observer eso --disturbance 1", "--observer kalman"),
    ] {
        let given: Vec<&str> = given.split(' ').collect();
        let (code, _, err) =
            greybox(folder.path(), &[&["control", "arm.toml", "--out", "o"][..], &given].concat());
        assert!(code == Some(2) && err.contains(&format!("add `{belongs}`")), "{given:?}: {err}");
    }
}

/// A delay of the loop counts in its margins, and one beyond the delay margin leaves none.
#[test]
fn the_delay_of_the_loop_counts_in_the_margins() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("arm.toml"), MODEL).unwrap();
    let margins = |delay: &str, out: &str| {
        let settings = "--size theta=0.4 --size theta'=4 --input-size 5 --limit 10 --dt 0.002 --members 3 --feedback output --json";
        let settings: Vec<&str> = settings.split(' ').chain(["--delay", delay, "--out", out]).collect();
        let (code, text, err) = greybox(folder.path(), &[&["control", "arm.toml"][..], &settings].concat());
        assert_eq!(code, Some(0), "{err}");
        let report: serde_json::Value = serde_json::from_str(&text).unwrap();
        let check = &report["checks"][0];
        let state = &check["margins"]["delay"];
        let output = &check["with_observer"]["margins"]["delay"];
        let family = &report["family"]["margins"]["delay"]["worst"];
        [state, output, family].map(|delay| delay.as_f64().unwrap())
    };
    let own = margins("0", "a");
    let late = margins("0.004", "b");
    assert!((0..2).all(|i| (own[i] - late[i] - 0.004).abs() < 1e-9), "{own:?} {late:?}");
    let beyond = margins(&format!("{}", 1.5 * own[1]), "c");
    assert!(beyond[0] > 0.0 && beyond[1..] == [0.0, 0.0], "{beyond:?}");
}

/// The code of an integral action at rest repeats the loop too: its memory is that of the simulated law.
#[test]
fn integral_action_at_rest_is_in_the_code() {
    let folder = tempfile::tempdir().unwrap();
    let sticky = MODEL.replace("value = 0.005", "value = 0.05");
    let late = sticky.replace("= kt*v", "= kt*delay(v, tau)");
    let late = late.replace("\n[eq", "tau = { value = 0.005, unit = \"s\" }\n\n[eq");
    for (name, text) in [("arm", sticky), ("late", late)] {
        std::fs::write(folder.path().join(format!("{name}.toml")), text).unwrap();
    }
    for (model, observer) in [("arm", "kalman"), ("arm", "eso"), ("late", "kalman")] {
        let place = format!("{model}-{observer}");
        let settings = "--to 0.8 --size theta=0.4 --size theta'=4 --input-size 5 --limit 10 --dt 0.002 --members 0 --hold 3 \
                        --json --feedback output --resolution theta=0.0015 --integral-at-rest";
        let file = format!("{model}.toml");
        let own = ["--observer", observer, "--out", &place];
        let all: Vec<&str> =
            ["control", &file].into_iter().chain(settings.split_whitespace()).chain(own).collect();
        let (code, out, err) = greybox(folder.path(), &all);
        assert_eq!(code, Some(0), "{place}: {err}");
        let report: serde_json::Value = serde_json::from_str(&out).unwrap();
        let rest = &report["observer"]["rest"];
        assert_eq!((&report["observer"]["integral"], rest["step"].as_f64()), (&true.into(), Some(0.0015)));
        let velocity = rest["velocity"].as_f64().unwrap() * rest["time"].as_f64().unwrap();
        assert!((velocity - 0.0015).abs() < 1e-12 && rest["integral_time"].as_f64().unwrap() > 0.0, "{rest}");
        for point in report["closed_loop"]["set_points"].as_array().unwrap() {
            assert!(point["final_error"].as_f64().unwrap().abs() < 2.0 * 0.0015, "{place}: {point}");
        }
        let read = |name: &str| std::fs::read_to_string(folder.path().join(&place).join(name)).unwrap();
        let html = read("report.html");
        assert!(html.contains("its integral action is the error of a machine at rest"), "{place}");
        assert!(read("observer.c").contains("memory->offset"));
        repeats(&folder.path().join(&place), &read("observer_vectors.csv"), None);
    }
    for other in [&["--feedback", "output", "--no-integral"][..], &[]] {
        let all = [&["control", "arm.toml", "--integral-at-rest", "--out", "o"], other].concat();
        let (code, _, err) = greybox(folder.path(), &all);
        assert!(code == Some(2) && err.contains("--integral-at-rest"), "{err}");
    }
}

/// Runs the observer's code over the measurements, in C and in Rust; it starts at the first of them where a command is held, or
/// at zero.
fn repeats(folder: &Path, vectors: &str, held: Option<f64>) {
    let rows: Vec<Vec<f64>> =
        vectors.lines().skip(1).map(|line| line.split(',').map(|v| v.parse().unwrap()).collect()).collect();
    // Time, angle, the reference with what derivatives the law reads, the command.
    let (n, last) = (rows.len(), rows[0].len() - 1);
    assert!(
        vectors.starts_with("t,theta,set_point,") && (1000..=2000).contains(&n) && [3, 5].contains(&last)
    );
    let cells = |open: &str, close: &str| {
        let row = |r: &Vec<f64>| {
            let given: Vec<String> = r[1..last].iter().map(|v| format!("{v:?}")).collect();
            format!("{open}{}{close}", given.join(", "))
        };
        rows.iter().map(row).collect::<Vec<_>>().join(", ")
    };
    let rust = format!(
        "#![allow(dead_code)]\nmod libm {{\n pub fn sin(x: f64) -> f64 {{ x.sin() }}\n pub fn cos(x: f64) -> f64 {{ x.cos() }}\n \
         pub fn pow(x: f64, y: f64) -> f64 {{ x.powf(y) }}\n pub fn fabs(x: f64) -> f64 {{ x.abs() }}\n}}\n\
         mod law {{\n use super::libm;\n include!(\"law.rs\");\n}}\nmod observer {{\n use super::libm;\n include!(\"observer.rs\");\n}}\n\
         static IN: [[f64; {width}]; {n}] = [{}];\nfn main() {{\n for missing in [false, true] {{\n  let mut o = {start};\n  \
         for (k, given) in IN.iter().enumerate() {{\n   let y = if missing && k % 50 == 7 {{ f64::NAN }} else {{ given[0] }};\n   \
         let r = core::array::from_fn(|i| given[i + 1]);\n   \
         println!(\"{{:?}}\", o.step(&[y], &r, law::control_law));\n  }}\n }}\n}}\n",
        cells("[", "]"),
        width = last - 1,
        start = match held {
            Some(held) => format!("observer::Observer::start_at(&[IN[0][0]], {held:?}).unwrap()"),
            None => "observer::Observer::new()".into(),
        }
    );
    std::fs::write(folder.join("main.rs"), rust).unwrap();
    let run = |program: &str| -> Vec<f64> {
        let run = Command::new(folder.join(program)).output().unwrap();
        String::from_utf8(run.stdout).unwrap().lines().map(|l| l.parse().unwrap()).collect()
    };
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let made = Command::new(rustc)
        .current_dir(folder)
        .args(["--edition", "2024", "-O", "-A", "unused_imports", "-o", "run_rust", "main.rs"])
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let by_rust = run("run_rust");
    let off = |a: &[f64], b: &mut dyn Iterator<Item = f64>| {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, |worst: f64, d| if d <= worst { worst } else { d })
    };
    let worst = off(&by_rust[..n], &mut rows.iter().map(|r| r[last]));
    assert!(by_rust.len() == 2 * n && worst < 1e-8, "{worst:e}");
    // Forty missing measurements change little, and end nothing.
    let missing = off(&by_rust[n..], &mut rows.iter().map(|r| r[last]));
    assert!(missing > 1e-6 && missing < 8.0, "{missing}");
    if Command::new("gcc").arg("--version").output().is_err() {
        println!("skipped: no C compiler here");
        return;
    }
    let head: String = std::fs::read_to_string(folder.join("observer.c")).unwrap();
    let kind = head.split("typedef struct").nth(1).unwrap().split("observer_memory;").next().unwrap();
    let main = format!(
        "#include <math.h>\n#include <stdio.h>\ntypedef struct{kind}observer_memory;\nvoid observer_start(observer_memory *memory);\n\
         int observer_start_at(observer_memory *memory, const double measured[1], double command);\n\
         double observer_step(observer_memory *memory, const double measured[1], const double set_point[{references}]);\n\
         static const double in[{n}][{width}] = {{{}}};\nint main(void) {{\n for (int missing = 0; missing < 2; missing++) {{\n  \
         observer_memory m;\n  {start}\n  for (int i = 0; i < {n}; i++) {{\n   double y[1];\n   \
         y[0] = missing && i % 50 == 7 ? NAN : in[i][0];\n   printf(\"%.17g\\n\", observer_step(&m, y, in[i] + 1));\n  }}\n }}\n \
         return 0;\n}}\n",
        cells("{", "}"),
        width = last - 1,
        references = last - 2,
        start = match held {
            // What is no number is refused.
            Some(held) => format!(
                "double none[1] = {{NAN}};\n  if (observer_start_at(&m, none, 0.0) || observer_start_at(&m, in[0], INFINITY)) return 1;\n  \
                 if (!observer_start_at(&m, in[0], {held:?})) return 1;"
            ),
            None => "observer_start(&m);".into(),
        }
    );
    std::fs::write(folder.join("main.c"), main).unwrap();
    let strict = [
        "-std=c99",
        "-O2",
        "-ffreestanding",
        "-Wall",
        "-Wextra",
        "-Wpedantic",
        "-Wconversion",
        "-Werror",
        "-c",
    ];
    let links = ["main.c", "law.o", "observer.o", "-lm", "-o", "run_c"];
    for arguments in
        [[&strict[..], &["law.c"]].concat(), [&strict[..], &["observer.c"]].concat(), links.to_vec()]
    {
        let made = Command::new("gcc").current_dir(folder).args(arguments).output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    }
    let by_c = run("run_c");
    let worst = off(&by_c, &mut by_rust.iter().copied());
    assert!(by_c.len() == 2 * n && worst < 1e-8, "{worst:e}");
}

/// Half a radian at 1 Hz, in degrees, every 20 ms.
fn sine() -> String {
    let mut text = "t [s],theta [deg]\n".to_owned();
    for k in 0..=150 {
        let t = 0.02 * f64::from(k);
        text += &format!("{t},{}\n", (0.5 * (std::f64::consts::TAU * t).sin()).to_degrees());
    }
    text
}

/// The law that reads derivatives stays with a sine, behind an observer too, and its code reads them; the one that does not
/// lags, and is not praised.
#[test]
fn a_trajectory_is_followed() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("arm.toml"), MODEL).unwrap();
    std::fs::write(folder.path().join("sine.csv"), sine()).unwrap();
    let settings = [
        "--reference",
        "sine.csv",
        "--size",
        "theta=0.4",
        "--size",
        "theta'=4",
        "--input-size",
        "5",
        "--dt",
        "0.002",
        "--members",
        "6",
        "--json",
    ];
    let run = |place: &str, more: &[&str]| -> (serde_json::Value, String) {
        let all = [&["control", "arm.toml", "--out", place][..], &settings, more].concat();
        let (code, out, err) = greybox(folder.path(), &all);
        assert_eq!(code, Some(0), "{place}: {err}");
        let html = std::fs::read_to_string(folder.path().join(place).join("report.html")).unwrap();
        (serde_json::from_str(&out).unwrap(), html)
    };
    let error = |report: &serde_json::Value| {
        report["closed_loop"]["tracking"]["later_error"]["largest"].as_f64().unwrap()
    };
    let read =
        |place: &str, name: &str| std::fs::read_to_string(folder.path().join(place).join(name)).unwrap();
    let (lagging, html) = run("static", &["--feed-forward", "static"]);
    assert_eq!((&lagging["verdict"], &lagging["reads_derivatives"]), (&"strays".into(), &false.into()));
    assert!(html.contains("The loop does not stay with its trajectory"));
    assert!(read("static", "law.c").contains("const double set_point[1]"));
    agrees(&folder.path().join("static"), &read("static", "vectors.csv"));
    for (place, more) in
        [("state", &[][..]), ("output", &["--feedback", "output", "--resolution", "theta=0.0015"])]
    {
        let (report, html) = run(place, more);
        assert_eq!((&report["verdict"], &report["reads_derivatives"]), (&"tracks".into(), &true.into()));
        println!("{place}: {} of {}", error(&report), error(&lagging));
        assert!(error(&report) < 0.02 * error(&lagging), "{place}: {} {}", error(&report), error(&lagging));
        assert_eq!(report["family"]["settled"], 6, "{place}");
        assert!(report["family"]["settling"]["worst"].is_null());
        let worst = report["family"]["largest_error"]["worst"].as_f64().unwrap();
        assert!(worst > error(&report) && worst < 0.02, "{place}: {worst}");
        assert!(report["closed_loop"]["set_points"].as_array().unwrap().is_empty());
        assert!(
            html.contains("The loop stays with its trajectory")
                && html.contains("6 stay with the trajectory")
        );
        assert!(read(place, "law.c").contains("const double set_point[3]"));
        let loop_ = read(place, "closed_loop.csv");
        assert_eq!(
            (loop_.lines().next(), loop_.lines().count()),
            (Some("t,set_point,command,theta,theta'"), 1502)
        );
    }
    assert_eq!(read("state", "vectors.csv").lines().next(), Some("theta,theta',r,r',r'',v"));
    agrees(&folder.path().join("state"), &read("state", "vectors.csv"));
    let observed = read("output", "observer_vectors.csv");
    assert_eq!(observed.lines().next(), Some("t,theta,set_point,set_point',set_point'',command"));
    repeats(&folder.path().join("output"), &observed, Some(0.0));
}

/// A flexible joint, or an arm, that rests away from zero is not thrown when its controller is switched on: the observer starts at
/// what is measured and at the command that holds it, in the simulated loop and in its code.
#[test]
fn a_machine_that_rests_is_not_thrown() {
    const JOINT: &str = r#"name = "joint"

[inputs]
v = { unit = "V" }

[states]
theta = { unit = "rad" }
phi = { unit = "rad", measured = false }

[parameters]
Jm = { value = 0.004, unit = "kg m^2" }
Jl = { value = 0.01, unit = "kg m^2" }
bm = { value = 0.05, unit = "N m s/rad" }
bl = { value = 0.002, unit = "N m s/rad" }
k = { value = 4.0, unit = "N m/rad" }
mgl = { value = 0.3, unit = "N m" }
kt = { value = 0.4, unit = "N m/V" }

[equations]
motor = "Jm*theta'' + bm*theta' + k*(theta - phi) = kt*v"
link = "Jl*phi'' + bl*phi' + k*(phi - theta) + mgl*sin(phi) = 0"
"#;
    let folder = tempfile::tempdir().unwrap();
    let late = MODEL.replace("= kt*v", "= kt*delay(v, tau)");
    let late = late.replace("\n[eq", "tau = { value = 0.005, unit = \"s\" }\n\n[eq");
    for (name, text) in [("joint", JOINT), ("arm", MODEL), ("late", &late)] {
        std::fs::write(folder.path().join(format!("{name}.toml")), text).unwrap();
    }
    // At rest for a second, then two tenths of a radian on.
    let mut reference = "t [s],theta [rad]\n".to_owned();
    for k in 0..=120 {
        let t = 0.02 * f64::from(k);
        let share = ((t - 1.0) / 1.0).clamp(0.0, 1.0);
        reference +=
            &format!("{t},{}\n", 0.4 + 0.2 * share.powi(3) * (10.0 - 15.0 * share + 6.0 * share * share));
    }
    std::fs::write(folder.path().join("move.csv"), reference).unwrap();
    for (model, observer, rest) in [
        ("joint", "kalman", &[][..]),
        ("arm", "eso", &[]),
        ("late", "kalman", &["--integral-at-rest"]),
        ("late", "eso", &["--integral-at-rest"]),
    ] {
        let place = format!("{model}-{observer}");
        let settings = "--reference move.csv --track theta --size theta=0.4 --size theta'=4 --input-size 5 --dt 0.002 --members 0 \
                        --json --feedback output --noise theta=1e-6";
        let file = format!("{model}.toml");
        let own = ["--observer", observer, "--out", &place];
        let all: Vec<&str> = ["control", &file]
            .into_iter()
            .chain(settings.split_whitespace())
            .chain(own)
            .chain(rest.iter().copied())
            .collect();
        let (code, out, err) = greybox(folder.path(), &all);
        assert_eq!(code, Some(0), "{place}: {err}");
        let report: serde_json::Value = serde_json::from_str(&out).unwrap();
        let held = report["closed_loop"]["held_command"].as_f64().unwrap();
        assert!(held > 0.1, "{place}: {held}");
        let start = &report["observer"]["start"];
        assert_eq!((start.is_null(), start["matrix"].is_null()), (observer == "eso", observer == "eso"));
        let read = |name: &str| std::fs::read_to_string(folder.path().join(&place).join(name)).unwrap();
        let table: Vec<Vec<f64>> = read("closed_loop.csv")
            .lines()
            .skip(1)
            .map(|line| line.split(',').map(|v| v.parse().unwrap()).collect())
            .collect();
        let resting = table.iter().take_while(|row| row[0] < 0.9);
        let (moved, command) = resting.fold((0.0f64, 0.0f64), |(moved, command), row| {
            (moved.max((row[3] - 0.4).abs()), command.max((row[2] - held).abs()))
        });
        println!("{place}: {moved:.1e} rad, {command:.1e} V");
        assert!(moved < 1e-4, "{place}: {moved}");
        repeats(&folder.path().join(&place), &read("observer_vectors.csv"), Some(held));
    }
}
