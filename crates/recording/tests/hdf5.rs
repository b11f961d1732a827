//! HDF5 and MAT-files of `-v7.3` as h5py and hdf5storage write them (`tests/hdf5/make.py`), and damaged ones.
#![cfg(feature = "hdf5")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use crate::files::{self, headers, stands_at_every, third, told};
use greybox_recording::{Recording, RecordingError, parse_hdf5, parse_mat, read};
use std::path::{Path, PathBuf};

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hdf5").join(name)
}

fn bytes(name: &str) -> Vec<u8> {
    std::fs::read(path(name)).unwrap()
}

#[track_caller]
fn recording(name: &str) -> Recording {
    read(path(name)).unwrap_or_else(|e| panic!("{e}"))
}

/// The samples of all files.
fn samples() -> [Vec<f64>; 3] {
    files::samples(&bytes("samples.bin"))
}

#[track_caller]
fn is_the_experiment(recording: &Recording, v: &str, theta: &str) {
    let [t, volts, angle] = samples();
    assert_eq!(recording.time, t);
    assert_eq!(recording.dt(), 0.01);
    assert_eq!(recording.channel(v).unwrap().values, volts);
    assert_eq!(recording.channel(theta).unwrap().values, angle);
}

#[test]
fn every_form_gives_the_same_recording() {
    for (name, wanted) in [
        ("vectors.mat", ["theta", "v"]),
        ("structure.mat", ["v", "theta [deg]"]),
        ("matrix.mat", ["v [V]", "theta [deg]"]),
        ("cells.mat", ["v [V]", "theta [deg]"]),
        ("simulink.mat", ["v", "theta [deg]"]),
        ("scales.h5", ["theta", "v"]),
        ("records.h5", ["v", "theta"]),
    ] {
        let recording = recording(name);
        assert_eq!(headers(&recording), wanted, "{name}");
        is_the_experiment(&recording, "v", "theta");
    }
}

#[test]
fn every_kind_of_number_is_read() {
    let kinds = recording("kinds.mat");
    assert_eq!(headers(&kinds), ["count", "on", "theta", "v"]);
    let [t, v, theta] = samples();
    assert_eq!((&kinds.time, &kinds.channel("theta").unwrap().values), (&t, &theta));
    for (k, v) in v.iter().enumerate() {
        let value = |name: &str| kinds.channel(name).unwrap().values[k];
        assert_eq!(value("v"), f64::from(*v as f32));
        assert_eq!((value("count"), value("on")), (k as f64 - 30.0, (k % 2) as f64));
    }
}

#[test]
fn groups_and_storage_of_both_kinds_are_read() {
    let [_, v, theta] = samples();
    let plain = recording("plain.h5");
    assert_eq!(headers(&plain), ["big", "half", "on", "theta [deg]", "v [V]", "wide", "a [V]", "b", "code"]);
    assert_eq!(plain.dt(), 0.01);
    for k in 0..60 {
        let value = |name: &str| plain.channel(name).unwrap().values[k];
        assert_eq!((value("v"), value("theta"), value("a"), value("b")), (v[k], theta[k], v[k], theta[k]));
        assert_eq!((value("big"), value("half")), (f64::from(v[k] as f32), k as f64 / 4.0 - 5.0));
        assert_eq!((value("on"), value("wide"), value("code")), ((k % 2) as f64, -(k as f64), k as f64));
    }
    let latest = recording("latest.h5");
    assert_eq!(headers(&latest), ["big", "half", "on", "theta [deg]", "wide", "a [V]", "b", "code"]);
    for channel in &latest.channels {
        assert_eq!(channel.values, plain.channel(&channel.name).unwrap().values, "{}", channel.name);
    }
}

#[test]
fn columns_are_signals_though_there_are_as_many_rows() {
    let square = recording("square.h5");
    assert_eq!(square.channels.len(), 8);
    let second: Vec<f64> = (0..8).map(|row| 8.0 * f64::from(row) + 1.0).collect();
    assert_eq!(square.channel("y_2").unwrap().values, second);
}

#[test]
fn what_is_left_out_is_told() {
    let told = |name: &str| {
        let recording = recording(name);
        assert_eq!(recording.warnings[0].code, "left_out", "{name}");
        recording.warnings[0].message.clone()
    };
    for (name, parts) in [
        ("kinds.mat", &["`table` (3×4)", "`z` (complex numbers)"] as &[&str]),
        ("object.mat", &["`ts` (an object)", "`s` (a sparse matrix)", "`f` (a function)"]),
        ("plain.h5", &["`run.lists` (lists of different lengths)"]),
        ("latest.h5", &["`run.v` (stored in the layout of HDF5 2.0, which is not read)"]),
        ("unread.h5", &["`packed` (packed with a filter that is not read)", "`far` (stored in other files)"]),
    ] {
        let message = told(name);
        for part in parts {
            assert!(message.contains(part), "{name}: {message}");
        }
    }
    assert!(recording("structure.mat").warnings.is_empty());
}

#[test]
fn what_is_no_recording_is_refused_with_its_help() {
    let error = |name: &str| parse_hdf5(bytes(name), "bad.h5").unwrap_err();
    for (name, part) in [("loop.mat", "nested too deeply"), ("again.mat", "in circles")] {
        let circle = error(name).to_string();
        assert!(circle.contains("damaged in the variable `c") && circle.contains(part), "{circle}");
    }
    let text = parse_hdf5(b"t,v\n0,1\n".to_vec(), "bad.h5").unwrap_err();
    assert!(matches!(text, RecordingError::Damaged { .. }), "{text}");
}

#[test]
fn groups_and_scales_with_times_of_their_own_are_joined() {
    let [t, v, theta] = samples();
    let (late, closed) = third(&theta);
    let groups = recording("two_clocks.h5");
    assert_eq!(headers(&groups), ["fast_v", "slow_v"]);
    assert_eq!(groups.time, t);
    stands_at_every(&groups, "fast_v", 1, &v);
    stands_at_every(&groups, "slow_v", 2, &v);
    for (name, wanted) in [
        ("two_scales.h5", ["v", "closed", "theta"]),
        ("two_rasters.mat", ["v [V]", "theta [deg]", "closed [1]"]),
    ] {
        let recording = recording(name);
        assert_eq!(headers(&recording), wanted, "{name}");
        assert_eq!(recording.dt(), 0.01);
        stands_at_every(&recording, "v", 1, &v);
        stands_at_every(&recording, "theta", 3, &late);
        stands_at_every(&recording, "closed", 3, &closed);
        let told = told(&recording);
        assert!(
            told.contains("has its own clock (33.33 Hz)") && told.contains("(100 Hz), by at most 0 ms"),
            "{told}"
        );
    }
}

#[test]
fn elements_may_be_empty() {
    assert_eq!(headers(&recording("empty.mat")), ["v"]);
}

#[test]
fn a_mat_file_of_7_3_is_one_by_any_door() {
    let bytes = bytes("structure.mat");
    assert_eq!(parse_mat(&bytes, "a").unwrap(), parse_hdf5(bytes, "a").unwrap());
}

/// A file that is cut off says in its head how long it was.
#[test]
fn no_cut_makes_a_recording() {
    for name in ["vectors.mat", "kinds.mat", "plain.h5", "latest.h5"] {
        let whole = bytes(name);
        for end in 0..whole.len() {
            let error = parse_hdf5(whole[..end].to_vec(), "cut.h5").expect_err(name);
            assert!(matches!(error, RecordingError::Damaged { .. }), "{name} {end}: {error}");
        }
    }
}

/// Every byte of a small file, and some of larger ones.
#[test]
fn no_changed_byte_makes_a_fault() {
    for (name, step) in
        [("vectors.mat", 1), ("simulink.mat", 11), ("cells.mat", 11), ("plain.h5", 11), ("latest.h5", 11)]
    {
        let whole = bytes(name);
        let mut refused = 0;
        for at in (0..whole.len()).step_by(step) {
            for change in [0x01, 0x80, 0xff] {
                let mut changed = whole.clone();
                changed[at] ^= change;
                refused += usize::from(parse_hdf5(changed, "changed.h5").is_err());
            }
        }
        assert!(refused > 100, "{name}: {refused}");
    }
}
