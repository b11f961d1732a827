//! The public benchmark recordings, where they are at hand: `$GREYBOX_RECORDINGS`, or `shared/recordings` beside
//! the workspace.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.
#![allow(clippy::disallowed_methods, clippy::print_stdout)]

use greybox_recording::noise::{noise_sigma, quantisation_step};
use greybox_recording::smooth::adaptive;
use greybox_recording::{Recording, Severity, health, read_csv};
use std::path::{Path, PathBuf};
use std::time::Instant;

fn folder() -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/recordings");
    let folder = std::env::var_os("GREYBOX_RECORDINGS").map_or_else(beside, PathBuf::from);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: no recordings at {}", folder.display());
    None
}

fn read(file: &str) -> Option<Recording> {
    let path = folder()?.join(file);
    if !path.is_file() {
        println!("skipped: no {}", path.display());
        return None;
    }
    Some(read_csv(&path).unwrap_or_else(|error| panic!("{error}")))
}

/// Where the steps of the clock are even, the rows are taken as they are; where they are not (a logger that writes what
/// happens, cameras that lose a marker), hardly one is lost all the same. None is a problem.
#[test]
fn every_recording_is_read_as_one_piece() {
    let Some(folder) = folder() else { return };
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .filter_map(|entry| std::fs::read_dir(entry.unwrap().path()).ok())
        .flat_map(|inner| inner.map(|entry| entry.unwrap().path()))
        .filter(|path| path.extension().is_some_and(|e| e == "csv"))
        .collect();
    files.sort();
    assert!(!files.is_empty());
    for path in files {
        let recording = read_csv(&path).unwrap_or_else(|error| panic!("{error}"));
        let piece = &recording.pieces[0];
        assert_eq!(recording.pieces.len(), 1, "{}", path.display());
        let steps: Vec<f64> = recording.time.windows(2).map(|w| w[1] - w[0]).collect();
        let even = steps.iter().all(|s| (s / recording.dt() - 1.0).abs() < 0.5);
        let seen = |values: &[f64]| values.iter().filter(|v| !v.is_nan()).count();
        if even && !piece.resampled {
            assert_eq!(piece.len, recording.time.len(), "{}", path.display());
            assert!(recording.warnings.is_empty(), "{}", path.display());
        }
        for (channel, column) in recording.channels.iter().zip(&piece.columns) {
            let (rows, kept) = (seen(&channel.values), seen(column));
            // A stretch that is logged faster than the grid keeps one row a step.
            assert!(kept as f64 > 0.7 * rows as f64, "{}: {kept} of {rows}", path.display());
        }
        let names: Vec<&str> = recording.channels.iter().map(|c| c.name.as_str()).collect();
        let (inputs, outputs): (Vec<&str>, Vec<&str>) = names.iter().partition(|n| {
            ["u", "vir", "pulse", "qg", "I", "thr", "Ph", "Ta", "goal", "enable", "gk"].contains(n)
        });
        println!("{}", path.display());
        for finding in health::check(&recording, &inputs, &outputs) {
            println!("  {finding}");
            // (The car that stood still in one of its runs.)
            assert!(finding.severity != Severity::Problem || finding.code == "flat", "{finding}");
        }
    }
}

#[test]
fn steps_are_exact_although_the_times_are_printed_with_few_digits() {
    for (file, dt, rows) in [
        ("emps/emps_train.csv", 1e-3, 24_841),
        ("silverbox/silverbox_multisine_train.csv", 1.0 / 610.351_562_5, 65_062),
        ("bouc_wen_simulated/boucwen_test_sinesweep.csv", 1.0 / 750.0, 153_000),
        ("cascaded_tanks/cascaded_tanks_train.csv", 4.0, 1024),
        ("falling_balls/golf_ball_drop1.csv", 1.0 / 15.0, 42),
    ] {
        let Some(recording) = read(file) else { continue };
        assert_eq!(recording.time.len(), rows, "{file}");
        let drift = (recording.dt() - dt).abs() * rows as f64;
        assert!(drift < 1e-3 * dt, "{file}: {} is off by {drift} s over the recording", recording.dt());
    }
}

#[test]
fn the_emps_encoder_and_the_silverbox_noise_are_as_published() {
    if let Some(emps) = read("emps/emps_train.csv") {
        assert_eq!(emps.channel("q").unwrap().unit.as_deref(), Some("m"));
        let q = quantisation_step(&emps.channel("q").unwrap().values).expect("the encoder is quantised");
        assert!((q / 5e-8 - 1.0).abs() < 0.05, "least significant bit about 0.05 µm, found {q}");
    }
    if let Some(silverbox) = read("silverbox/silverbox_multisine_train.csv") {
        let y = &silverbox.channel("y").unwrap().values;
        let sigma = noise_sigma(y);
        assert!(sigma > 1e-4 && sigma < 2e-2, "{sigma}");
    }
}

#[test]
fn reading_and_smoothing_are_fast_enough_for_long_recordings() {
    let Some(recording) = read("silverbox/silverbox_multisine_train.csv") else { return };
    let folder = folder().unwrap();
    let clock = Instant::now();
    let _ = read_csv(folder.join("silverbox/silverbox_multisine_train.csv")).unwrap();
    let reading = clock.elapsed();
    let clock = Instant::now();
    // A noise so large that every window is tried.
    let smooth = adaptive(&recording.channels[1].values, recording.dt(), 1.0);
    let smoothing = clock.elapsed();
    println!("2 MB read in {reading:?}; 65 062 samples smoothed over all windows in {smoothing:?}");
    assert_eq!(smooth.window, 131);
    assert!(reading.as_secs_f64() < 2.0 && smoothing.as_secs_f64() < 5.0, "even on a busy machine");
}

/// Throttles move in steps, a tank that overflows has corners, a servo's goal jumps: no sample of these stands out.
#[test]
fn steps_and_corners_of_real_machines_are_no_outliers() {
    for (file, inputs, outputs) in [
        ("dart/dart_00.csv", &["thr"][..], &["v"][..]),
        ("dart/dart_02.csv", &["thr"], &["v"]),
        ("dart/dart_10.csv", &["thr"], &["v"]),
        ("cascaded_tanks/cascaded_tanks_train.csv", &["u"], &["y"]),
        ("servo_pendulum_xl330/xl330_sin_time_square_kp400.csv", &["goal"], &["theta"]),
        ("leaf/leaf_dis1c_raw.csv", &["I"], &["V"]),
    ] {
        let Some(recording) = read(file) else { return };
        let findings = health::check(&recording, inputs, outputs);
        let outliers = findings.iter().find(|f| f.code == "outliers");
        assert!(outliers.is_none(), "{file}: {outliers:?}");
    }
}
