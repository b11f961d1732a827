//! The same request gives the same bytes, in files and in words, on 1, 2 and 8 threads and in every process.
#![allow(missing_docs, clippy::unwrap_used)]

use common::{Bench, names};
use spring::{MODEL, recording};

#[allow(dead_code)]
mod common;
#[path = "common/spring.rs"]
mod spring;

/// Runs the request, which ends with `--out`, on several numbers of threads, and compares all that came of it.
#[track_caller]
fn the_same_whatever_the_threads(bench: &Bench, request: &[&str], files: &[&str]) {
    let mut first = None;
    // Twice with 8: what hangs on the address space or on the keys of a hash differs between two processes.
    for (run, threads) in ["1", "2", "8", "8"].into_iter().enumerate() {
        let out = "out";
        let outcome = bench.greybox_with(&[request, &[out]].concat(), &[("RAYON_NUM_THREADS", threads)]);
        assert_eq!(outcome.code, 0, "{request:?}: {}", outcome.stderr);
        // Moved away, so that the name of the folder is the same in all words.
        let kept = bench.path(&format!("kept{run}"));
        std::fs::rename(bench.path(out), &kept).unwrap();
        let written = if kept.is_dir() { names(&kept) } else { vec![String::new()] };
        let path = |name: &String| if name.is_empty() { kept.clone() } else { kept.join(name) };
        let bytes: Vec<Vec<u8>> = written.iter().map(|name| std::fs::read(path(name)).unwrap()).collect();
        assert!(files.iter().all(|f| written.iter().any(|w| w == f)), "{request:?} wrote {written:?}");
        let all = (outcome.stdout, written, bytes);
        match &first {
            None => first = Some(all),
            Some(first) => {
                assert_eq!(all.0, first.0, "{request:?} on {threads} threads: the words");
                assert_eq!(all.1, first.1, "{request:?} on {threads} threads: the files");
                for ((name, a), b) in first.1.iter().zip(&first.2).zip(&all.2) {
                    assert!(a == b, "{request:?} on {threads} threads: {name} differs");
                }
            }
        }
    }
    for run in 0..4 {
        let kept = bench.path(&format!("kept{run}"));
        if kept.is_dir() { std::fs::remove_dir_all(kept) } else { std::fs::remove_file(kept) }.unwrap();
    }
}

/// The model lacks damping, so that something is found.
fn bench() -> Bench {
    let bench = Bench::empty();
    let without_damping =
        MODEL.replace("b*x' + ", "").replace("b = { value = 0.5, unit = \"N s/m\" } # a guess\n", "");
    bench.write("model.toml", &without_damping);
    bench.write("run1.csv", &recording(700, 0.0));
    bench.write("run2.csv", &recording(500, 1.0));
    bench
}

#[test]
fn diagnose() {
    let files = ["improved.toml", "report.html", "report.json"];
    let request = ["diagnose", "model.toml", "run1.csv", "run2.csv", "--out"];
    the_same_whatever_the_threads(&bench(), &request, &files);
}

/// The log says how every law was weighed; what it asks for costs the search nothing.
#[test]
fn what_is_told_changes_nothing() {
    let bench = bench();
    let reported = |out: &str, log: &[&str]| {
        let request = ["diagnose", "model.toml", "run1.csv", "run2.csv", "--out", out];
        let outcome = bench.greybox(&[&request, log].concat());
        assert_eq!(outcome.code, 0, "{}", outcome.stderr);
        outcome.stderr
    };
    assert_eq!(reported("silent", &[]), "");
    let log = reported("told", &["--log"]);
    let weighed = log.lines().find(|line| line.contains("viscous_friction: score ")).unwrap();
    assert!(weighed.contains(", robust ") && weighed.ends_with(": accepted"), "{log}");
    for file in ["improved.toml", "report.json"] {
        assert_eq!(bench.read(&format!("silent/{file}")), bench.read(&format!("told/{file}")), "{file}");
    }
}

#[test]
fn calibrate() {
    let request = ["calibrate", "model.toml", "run1.csv", "run2.csv", "--out"];
    the_same_whatever_the_threads(&bench(), &request, &["model.toml", "report.json"]);
}

#[test]
fn identify() {
    let files = ["model.toml", "report.html", "report.json"];
    let request =
        ["identify", "run1.csv", "run2.csv", "--states", "x", "--inputs", "f", "--seed", "4", "--out"];
    the_same_whatever_the_threads(&bench(), &request, &files);
}

/// Block by block through a file, in as many blocks at a time as there are threads for.
#[test]
fn identify_in_blocks() {
    let bench = Bench::empty();
    bench.write("long.csv", &recording(6500, 0.0));
    let request = ["identify", "long.csv", "--states", "x", "--inputs", "f", "--block", "1000", "--out"];
    the_same_whatever_the_threads(&bench, &request, &["model.toml", "report.json"]);
}

#[test]
fn simulate() {
    let request = ["simulate", "model.toml", "run1.csv", "--out"];
    the_same_whatever_the_threads(&bench(), &request, &[]);
}

#[test]
fn control() {
    let bench = Bench::empty();
    bench.write(
        "arm.toml",
        "[inputs]\nv = { unit = \"V\" }\n[states]\ntheta = { unit = \"rad\" }\n[parameters]\n\
         J = { value = 0.02, unit = \"kg m^2\", std = 0.002 }\nb = { value = 0.15, unit = \"N m s/rad\" }\n\
         mgl = { value = 0.5, unit = \"N m\", std = 0.03 }\nkt = { value = 0.4, unit = \"N m/V\" }\n[equations]\n\
         arm = \"J*theta'' + b*theta' + mgl*sin(theta) = kt*v\"\n",
    );
    for method in ["lqr", "hjb", "smc"] {
        let request = [
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
        ];
        let files = ["law.c", "law.rs", "report.html", "report.json", "vectors.csv"];
        the_same_whatever_the_threads(&bench, &request, &files);
    }
}
