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
    for method in ["lqr", "hjb", "smc"] {
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
            method,
            "--json",
        ];
        let (code, out, err) = greybox(folder.path(), &arguments);
        assert_eq!(code, Some(0), "{method}: {err}");
        let report: serde_json::Value = serde_json::from_str(&out).unwrap();
        assert_eq!(report["closed_loop"]["diverged"], false);
        for point in report["closed_loop"]["set_points"].as_array().unwrap() {
            assert!(point["final_error"].as_f64().unwrap().abs() < 0.02, "{method}: {point}");
        }
        assert_eq!(report["family"]["diverged"], 0, "{method}");
        assert_eq!(report["verdict"], "settles", "{method}");
        for check in report["checks"].as_array().unwrap() {
            let radius = |p: &serde_json::Value| p[0].as_f64().unwrap().hypot(p[1].as_f64().unwrap());
            let held: Vec<f64> = check["held_poles"].as_array().unwrap().iter().map(radius).collect();
            assert_eq!(held[0], check["spectral_radius"].as_f64().unwrap());
            assert!(held.len() == 2 && held[1] <= held[0] && held[0] < 1.0, "{method}: {check}");
        }
        let read = |name: &str| std::fs::read_to_string(folder.path().join(method).join(name)).unwrap();
        assert!(
            read("law.rs").contains("pub fn control_law(state: &[f64; 2], set_point: &[f64; 1]) -> [f64; 1]")
        );
        agrees(&folder.path().join(method), &read("vectors.csv"));
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
    let (reported, html) = verdict(&["--size", "theta=0.2", "--hold", "4"]);
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
    let main = format!(
        "#include <stdio.h>\nvoid control_law(const double state[2], const double set_point[1], double out[1]);\n\
         static const double in[{n}][4] = {{{}}};\nint main(void) {{\n double worst = 0.0;\n\
         for (int i = 0; i < {n}; i++) {{\n  double u[1];\n  control_law(in[i], in[i] + 2, u);\n\
         const double off = u[0] > in[i][3] ? u[0] - in[i][3] : in[i][3] - u[0];\n\
         if (!(off <= worst)) worst = off;\n }}\n printf(\"%.3e\\n\", worst);\n return 0;\n}}\n",
        rows.iter().map(|r| format!("{{{r}}}")).collect::<Vec<_>>().join(", "),
        n = rows.len()
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
