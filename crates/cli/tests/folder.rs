//! `greybox diagnose` on a folder of recordings.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(missing_docs, clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use common::{Bench, names};
use serde_json::{Value, json};
use spring::{MODEL, recording};

#[allow(dead_code, reason = "not every test file uses all of it")]
mod common;
#[path = "common/spring.rs"]
mod spring;

/// The model without its damping, and a folder `runs` of two recordings that show it, beside another file.
fn bench() -> Bench {
    let bench = Bench::empty();
    let damping = ("b*x' + ", "b = { value = 0.5, unit = \"N s/m\" } # a guess\n");
    bench.write("model.toml", &MODEL.replace(damping.0, "").replace(damping.1, ""));
    fs::create_dir(bench.path("runs")).unwrap();
    bench.write("runs/monday.csv", &recording(400, 0.0));
    bench.write("runs/friday.csv", &recording(500, 1.0));
    bench.write("runs/notes.txt", "no recording");
    bench
}

/// All files below a folder with their contents.
fn tree(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    for name in names(folder) {
        let path = folder.join(&name);
        if path.is_dir() {
            all.extend(tree(&path).into_iter().map(|(below, content)| (format!("{name}/{below}"), content)));
        } else {
            all.insert(name, fs::read(path).unwrap());
        }
    }
    all
}

const DIAGNOSE: [&str; 4] = ["diagnose", "model.toml", "runs", "--out"];

#[test]
fn every_recording_is_diagnosed_by_itself_and_a_bad_one_ends_nothing() {
    let bench = bench();
    bench.write("runs/broken.csv", "t,f [N],x [mm]\n0.0,1.0,2.0\n0.1,one,2.0\n");
    let outcome = bench.greybox(&[&DIAGNOSE as &[&str], &["out"]].concat());
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    for part in [
        "2 recordings diagnosed: physics is missing in 2; 1 recording could not be diagnosed.\n",
        "Viscous friction in the body equation, ",
        " is found in 2 of 2; ",
        "\n  monday.csv  missing physics  viscous friction\n",
        "\nNote: broken.csv could not be diagnosed: runs/broken.csv:3:f (column 2)",
        "\nWritten: out/summary.html, out/summary.json, and a folder for each recording in out\n",
    ] {
        assert!(outcome.stdout.contains(part), "`{part}` is not in:\n{}", outcome.stdout);
    }
    assert!(!outcome.stdout.contains("done before"), "{}", outcome.stdout);
    assert_eq!(names(&bench.path("out")), ["friday", "monday", "summary.html", "summary.json"]);
    assert_eq!(
        names(&bench.path("out/monday")),
        ["done.json", "improved.toml", "report.html", "report.json"]
    );

    // What stands in the folder of a recording is what its diagnosis alone writes.
    let alone = bench.greybox(&["diagnose", "model.toml", "runs/friday.csv", "--out", "alone"]);
    assert_eq!(alone.code, 0, "{}", alone.stderr);
    for file in names(&bench.path("alone")) {
        assert_eq!(bench.read(&format!("alone/{file}")), bench.read(&format!("out/friday/{file}")), "{file}");
    }

    let summary: Value = serde_json::from_str(&bench.read("out/summary.json")).unwrap();
    assert_eq!(
        summary["verdicts"],
        json!({"consistent": 0, "missing_physics": 2, "unexplained": 0, "failed": 1})
    );
    assert_eq!(summary["recordings"][0]["page"], "friday/report.html");
    assert_eq!(summary["recordings"][0]["samples"], json!({"train": 400, "holdout": 100}));
    assert_eq!(summary["failed"][0]["recording"], "broken.csv");
    let friction = &summary["mechanisms"][0];
    assert_eq!((&friction["kind"], &friction["family"]), (&json!("viscous_friction"), &json!("friction")));
    assert_eq!(friction["found_in"], json!(["friday.csv", "monday.csv"]));
    let (_, damping) = friction["parameters"].as_object().unwrap().iter().next().unwrap();
    assert!((damping["value"].as_f64().unwrap() - spring::TRUTH.0).abs() < 0.05, "{damping}");
    assert_eq!(
        (&damping["method"], damping["estimates"].as_array().unwrap().len()),
        (&json!("fixed_effect"), 2)
    );
    assert!((summary["parameters"]["k"]["value"].as_f64().unwrap() - spring::TRUTH.1).abs() < 0.2);
    assert_eq!(summary["parameters"]["k"]["nominal"], 30.0);
    assert!(
        summary["holdout"]["x"]["improved"]["largest"].as_f64().unwrap() < 0.05,
        "{}",
        summary["holdout"]
    );
    let page = bench.read("out/summary.html");
    assert!(page.contains("href=\"monday/report.html\"") && page.contains("broken.csv"), "{page}");

    // Again, as JSON: nothing is left to do, and what is said is what is written.
    let mut again = bench.json(&[&DIAGNOSE as &[&str], &["out"]].concat());
    assert_eq!(again.as_object_mut().unwrap().remove("done_before"), Some(json!(2)));
    assert_eq!(again, summary);
}

#[test]
fn a_run_that_was_ended_is_gone_on_with_and_leaves_the_same_bytes() {
    let bench = bench();
    bench.write("runs/sunday.csv", &recording(450, 2.0));
    let run = |out: &str, threads: &str| {
        let outcome =
            bench.greybox_with(&[&DIAGNOSE as &[&str], &[out]].concat(), &[("RAYON_NUM_THREADS", threads)]);
        assert_eq!(outcome.code, 0, "{}", outcome.stderr);
        outcome.stdout
    };
    let whole_words = run("whole", "2");
    let whole = tree(&bench.path("whole"));

    // Killed as soon as the first recording is done.
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("greybox"))
        .current_dir(bench.path(""))
        .args([&DIAGNOSE as &[&str], &["killed"]].concat())
        .env("RAYON_NUM_THREADS", "1")
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    while !bench.path("killed/friday").exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let words = run("killed", "1");
    assert!(words.contains("of 3 done before.\n"), "{words}");
    assert_eq!(tree(&bench.path("killed")), whole);

    // As a kill at other moments leaves it: one folder gone, one without its mark, files that still wait.
    fs::remove_dir_all(bench.path("killed/monday")).unwrap();
    fs::remove_file(bench.path("killed/sunday/done.json")).unwrap();
    fs::remove_file(bench.path("killed/summary.json")).unwrap();
    fs::create_dir(bench.path("killed/.greybox-1-2.partial")).unwrap();
    bench.write("killed/.greybox-1-2.partial/report.json", "half");
    let words = run("killed", "2");
    assert_eq!(words.replace("1 of 3 done before.\n", ""), whole_words.replace("whole", "killed"));
    assert_eq!(tree(&bench.path("killed")), whole);
}

#[test]
fn whatever_changes_the_results_runs_them_anew() {
    let bench = bench();
    fs::remove_file(bench.path("runs/friday.csv")).unwrap();
    bench.write("test.csv", &recording(300, 3.0));
    let before = |more: &[&str]| {
        bench.json(&[&DIAGNOSE as &[&str], &["out"], more].concat())["done_before"].as_u64().unwrap()
    };
    assert_eq!(before(&[]), 0);
    assert_eq!(before(&[]), 1);
    assert_eq!(before(&["--seed", "1"]), 0);
    assert_eq!(before(&["--seed", "1", "--work", "9"]), 0);
    assert_eq!(before(&["--holdout", "test.csv"]), 0);
    bench.write("test.csv", &recording(320, 3.0));
    assert_eq!(before(&["--holdout", "test.csv"]), 0);
    bench.write("model.toml", &format!("# mine\n{}", bench.read("model.toml")));
    assert_eq!(before(&["--holdout", "test.csv"]), 0);
    assert_eq!(before(&["--holdout", "test.csv"]), 1);
    bench.write("runs/monday.csv", &recording(420, 0.0));
    assert_eq!(before(&["--holdout", "test.csv"]), 0);
}

#[test]
fn what_is_held_out_of_the_folder_only_judges() {
    let bench = bench();
    let json = bench.json(&[&DIAGNOSE as &[&str], &["out", "--holdout", "runs/friday.csv"]].concat());
    let recordings: Vec<&Value> =
        json["recordings"].as_array().unwrap().iter().map(|r| &r["recording"]).collect();
    assert_eq!(recordings, ["monday.csv"]);
    let report: Value = serde_json::from_str(&bench.read("out/monday/report.json")).unwrap();
    assert_eq!(report["fit"]["holdout_source"], "recordings held out: friday.csv");
    assert_eq!(json["recordings"][0]["samples"], json!({"train": 400, "holdout": 500}));
}

#[test]
fn folders_that_cannot_be_worked_through() {
    let bench = bench();
    fs::create_dir(bench.path("empty")).unwrap();
    fs::create_dir(bench.path("other")).unwrap();
    bench.write("other/notes.txt", "no recording");
    for folder in ["empty", "other"] {
        bench.refuses(
            &["diagnose", "model.toml", folder, "--out", "out"],
            &[folder, "holds no recording", "help:"],
        );
    }
    let mixed = ["diagnose", "model.toml", "runs/monday.csv", "runs", "--out", "out"];
    bench.refuses(&mixed, &["error: runs: ", "stands alone", "help:"]);
    bench.refuses(&["diagnose", "model.toml", "runs", "other", "--out", "out"], &["stands alone", "help:"]);
    bench.refuses(
        &[
            "diagnose",
            "model.toml",
            "runs",
            "--holdout",
            "runs/monday.csv",
            "runs/friday.csv",
            "--out",
            "out",
        ],
        &["runs", "every recording of this folder is held out", "help:"],
    );
    bench.write("bad.csv", "t,f [N],x [mm]\n0.0,1.0,?\n");
    bench.refuses(
        &["diagnose", "model.toml", "runs", "--holdout", "bad.csv", "--out", "out"],
        &["error: bad.csv:2:x"],
    );
    bench.refuses(&["diagnose", "model.toml", "nowhere", "--out", "out"], &["nowhere", "no such file"]);
    // Nothing may take the place of an input, or of a file that is no folder.
    fs::create_dir_all(bench.path("results/monday")).unwrap();
    bench.write("results/monday/improved.toml", &bench.read("model.toml"));
    bench.refuses(
        &["diagnose", "results/monday/improved.toml", "runs", "--out", "results"],
        &["improved.toml", "overwrite", "help:"],
    );
    bench.write("results/friday", "mine");
    bench.refuses(&["diagnose", "model.toml", "runs", "--out", "results"], &["results/friday", "help:"]);
    bench.write("runs/monday.CSV", "t,f,x\n");
    bench.refuses(
        &["diagnose", "model.toml", "runs", "--out", "out"],
        &["runs/monday.csv", "would go where those of `runs/monday.CSV` go", "rename"],
    );
}

/// Each of three machines was recorded twice; the table lies among the recordings.
#[test]
fn a_table_says_which_machine_a_recording_is_of() {
    let bench = bench();
    let mut table = String::from("recording,machine,date,temperature [degC]\n");
    for (k, name) in ["a1", "a2", "b1", "b2", "friday", "monday"].iter().enumerate() {
        if k < 4 {
            bench.write(&format!("runs/{name}.csv"), &recording(400, 2.0 + k as f64));
        }
        table += &format!("{name}.csv,{},2026-0{}-01,2{k}.5\n", ["A", "B", "C"][k / 2], k + 1);
    }
    bench.write("runs/machines.csv", &table);
    let runs = [&DIAGNOSE as &[&str], &["out", "--runs", "runs/machines.csv"]].concat();
    let outcome = bench.greybox(&runs);
    assert_eq!(outcome.code, 0, "{}", outcome.stderr);
    assert!(
        outcome.stdout.contains(" is found in 6 of 6 recordings, in 3 of 3 machines ("),
        "{}",
        outcome.stdout
    );
    let summary: Value = serde_json::from_str(&bench.read("out/summary.json")).unwrap();
    let first = &summary["recordings"][0]["run"];
    assert_eq!((&first["machine"], &first["date"]), (&json!("A"), &json!("2026-01-01")));
    assert_eq!(first["covariates"]["temperature [degC]"], 20.5);
    let stiffness = &summary["parameters"]["k"]["machines"];
    assert!((stiffness["value"].as_f64().unwrap() - spring::TRUTH.1).abs() < 0.2, "{stiffness}");
    assert_eq!(stiffness["machines"][2]["machine"], "C");
    // The table changes the summary alone: nothing is diagnosed again, and without it the summary is the one without.
    let again = bench.greybox(&runs);
    assert!(again.stdout.contains("\n6 of 6 done before.\n"), "{}", again.stdout);
    assert_eq!(serde_json::from_str::<Value>(&bench.read("out/summary.json")).unwrap(), summary);

    bench.write("short.csv", "recording,machine\nmonday.csv,A\n");
    let short = [&DIAGNOSE as &[&str], &["new", "--runs", "short.csv"]].concat();
    bench.refuses(&short, &["error: short.csv: there is no row for the recording `a1.csv`"]);
    assert!(!bench.path("new").exists());
    let alone = ["diagnose", "model.toml", "runs/a1.csv", "--runs", "runs/machines.csv", "--out", "new"];
    bench.refuses(&alone, &["runs/machines.csv", "`--runs` tells of the recordings of a folder", "help:"]);
}

#[test]
fn where_no_recording_can_be_diagnosed_nothing_is_written() {
    let bench = bench();
    bench.write("runs/monday.csv", "t,f [N],x [mm]\n0.0,1.0,?\n");
    bench.write("runs/friday.csv", &recording(50, 0.0).replace("x [mm]", "y [mm]"));
    bench.refuses(
        &["diagnose", "model.toml", "runs", "--out", "a/b"],
        &[
            "error: runs: no recording of this folder",
            "\n  runs/monday.csv:2:x",
            "\n  friday.csv: there is no channel `x`",
        ],
    );
}

#[cfg(unix)]
#[test]
fn two_runs_do_not_write_to_one_folder() {
    let bench = bench();
    fs::create_dir(bench.path("out")).unwrap();
    let taken = File::open(bench.path("out")).unwrap();
    taken.lock().unwrap();
    bench.refuses(&[&DIAGNOSE as &[&str], &["out"]].concat(), &["error: out: another run", "help:"]);
    assert_eq!(names(&bench.path("out")), [""; 0]);
}

#[test]
fn two_diagnoses_are_held_against_each_other() {
    let bench = bench();
    let out = bench.greybox(&[&DIAGNOSE as &[&str], &["out"]].concat());
    assert_eq!(out.code, 0, "{}", out.stderr);
    let compare = ["compare", "out/monday", "out/friday/report.json"];
    let said = bench.greybox(&[&compare as &[&str], &["--out", "change"]].concat());
    assert_eq!(said.code, 0, "{}", said.stderr);
    for part in [
        "Both runs say: physics is missing.\n",
        "Viscous friction in the body equation is in both, ",
        "caution: The runs were judged on different recordings",
        "change/comparison.html",
    ] {
        assert!(said.stdout.contains(part), "{part}: {}", said.stdout);
    }
    assert_eq!(names(&bench.path("change")), ["comparison.html", "comparison.json"]);
    let json: Value =
        serde_json::from_slice(&fs::read(bench.path("change/comparison.json")).unwrap()).unwrap();
    assert_eq!(json["mechanisms"][0]["kind"], "viscous_friction");
    let printed = bench.greybox(&[&compare as &[&str], &["--json"]].concat());
    assert_eq!(serde_json::from_str::<Value>(&printed.stdout).unwrap(), json);

    // As a test: a run that concludes the same, one that lost its mechanism, one that is less exact.
    let said = fs::read_to_string(bench.path("out/monday/report.json")).unwrap();
    let mut other: Value = serde_json::from_str(&said).unwrap();
    other["mechanisms"] = Value::Array(Vec::new());
    bench.write("gone.json", &other.to_string());
    let mut other: Value = serde_json::from_str(&said).unwrap();
    for (_, score) in other["fit"]["holdout"]["improved"].as_object_mut().unwrap() {
        score["nrmse"] = (1.2 * score["nrmse"].as_f64().unwrap()).into();
    }
    bench.write("worse.json", &other.to_string());
    let fail_if = |after: &str, options: &[&str]| {
        bench.greybox(&[&["compare", "out/monday", after, "--json"], options].concat())
    };
    let (changed, worse) = (["--fail-if", "changed"], ["--fail-if", "worse"]);
    let both = [changed, worse].concat();
    assert_eq!(fail_if("out/monday", &both).code, 0);
    for (after, options, part) in
        [("gone.json", &changed[..], "conclude differently"), ("worse.json", &both, "more than 10 %")]
    {
        let failed = fail_if(after, options);
        assert_eq!(failed.code, 3, "{after}: {}", failed.stderr);
        assert!(failed.stderr.starts_with("failed: ") && failed.stderr.contains(part), "{}", failed.stderr);
        assert_eq!(failed.stderr.lines().count(), 1, "{}", failed.stderr);
        assert!(serde_json::from_str::<Value>(&failed.stdout).is_ok(), "{}", failed.stdout);
    }
    assert_eq!(fail_if("worse.json", &changed).code, 0);
    assert_eq!(fail_if("worse.json", &[&worse[..], &["--margin", "25"]].concat()).code, 0);
    assert_eq!(fail_if("worse.json", &[&worse[..], &["--margin", "-1"]].concat()).code, 2);

    bench.write("no.json", "{\"verdict\": 3}");
    for (path, part) in [("no.json", "not a diagnosis report"), ("nowhere", "no such file")] {
        let refused = bench.greybox(&["compare", path, "out/friday", "--out", "none"]);
        assert_eq!(refused.code, 2, "{}", refused.stderr);
        assert!(
            refused.stderr.contains(part) && refused.stderr.contains("report.json"),
            "{}",
            refused.stderr
        );
    }
    assert!(!bench.path("none").exists());
}
