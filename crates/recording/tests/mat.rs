//! MAT-files as MATLAB, Simulink and SciPy write them (`tests/mat/make.py` made those read here), and damaged ones.
#![cfg(feature = "mat")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use crate::files::headers;
use greybox_recording::{Recording, RecordingError, parse_mat};
use std::path::Path;

fn bytes(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/mat").join(format!("{name}.mat")))
        .unwrap()
}

fn read(name: &str) -> Recording {
    parse_mat(&bytes(name), name).unwrap_or_else(|e| panic!("{e}"))
}

/// The experiment of all files: a time, a voltage and an angle, whatever their names.
#[track_caller]
fn is_the_experiment(recording: &Recording, v: &str, theta: &str, tolerance: f64) {
    assert_eq!(recording.time.len(), 60);
    assert_eq!(recording.pieces.len(), 1);
    assert_eq!(recording.dt(), 0.01);
    let (v, theta) = (recording.channel(v).unwrap(), recording.channel(theta).unwrap());
    for (k, t) in recording.time.iter().enumerate() {
        assert!((t - 0.01 * k as f64).abs() < 1e-12);
        assert!((v.values[k] - (3.0 * t).sin()).abs() < tolerance);
        assert!((theta.values[k] - (2.0 * t).cos()).abs() < tolerance);
    }
}

#[test]
fn every_form_gives_the_same_recording() {
    for (name, wanted) in [
        ("vectors_v6", ["v", "theta"]),
        ("structure", ["v", "theta [deg]"]),
        ("matrix", ["v [V]", "theta [deg]"]),
        ("matrix_with_time", ["v", "theta"]),
        ("simulink", ["v", "theta [deg]"]),
        ("nested", ["link_angle", "hub_angle"]),
        ("array", ["ans_1", "ans_2"]),
    ] {
        let recording = read(name);
        let mut found = headers(&recording);
        found.sort();
        let mut sorted = wanted;
        sorted.sort_unstable();
        assert_eq!(found, sorted, "{name}");
        let names = wanted.map(|w| w.split(' ').next().unwrap());
        is_the_experiment(&recording, names[0], names[1], 1e-12);
    }
}

#[test]
fn single_and_whole_numbers_and_rows_are_read() {
    let recording = read("vectors_v7");
    assert_eq!(headers(&recording), ["v", "theta", "count"]);
    is_the_experiment(&recording, "v", "theta", 1e-7);
    assert_eq!(recording.channel("count").unwrap().values[59], 59.0);
}

#[test]
fn signals_of_one_clock_are_put_together() {
    let recording = read("simulink_one");
    assert_eq!(headers(&recording), ["theta", "v"]);
    is_the_experiment(&recording, "v", "theta", 1e-12);
}

#[test]
fn what_is_left_out_or_assumed_is_told() {
    let left_out = read("vectors_v6");
    assert_eq!(left_out.warnings[0].code, "left_out");
    assert!(left_out.warnings[0].message.contains("`table` (3×4)"), "{}", left_out.warnings[0].message);
    let assumed = read("array");
    assert_eq!(assumed.warnings[0].code, "time_column");
    assert!(
        assumed.warnings[0].message.contains("the first row of `ans`"),
        "{}",
        assumed.warnings[0].message
    );
    assert!(read("structure").warnings.is_empty());
}

#[test]
fn what_is_no_recording_is_refused_with_its_help() {
    let error = |name: &str| parse_mat(&bytes(name), "bad.mat").unwrap_err();
    let two = error("two_clocks");
    assert!(matches!(two, RecordingError::SeveralTimes { .. }), "{two}");
    for part in ["bad.mat: ", "`fast.t`, `slow.t`", "in a file of its own"] {
        assert!(two.to_string().contains(part), "{two}");
    }
    let timeless = error("no_time");
    for part in
        ["bad.mat: there is no time", "`v` (60×1), `theta` (60×1)", "call the vector of times, in s, `t`"]
    {
        assert!(timeless.to_string().contains(part), "{timeless}");
    }
}

#[test]
fn other_formats_are_named_with_their_help() {
    let mut hdf5 = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".to_vec();
    hdf5.resize(600, b' ');
    let mut level4 = 0u32.to_le_bytes().to_vec();
    level4.resize(300, 1);
    for bytes in [hdf5, b"\x89HDF\r\n\x1a\n".to_vec()] {
        let error = parse_mat(&bytes, "other.mat").unwrap_err().to_string();
        let parts = match cfg!(feature = "hdf5") {
            true => ["the file is damaged", "write it again"],
            false => ["version 7.3 (HDF5): build it with the feature `hdf5`", "'-v7')"],
        };
        assert!(parts.iter().all(|part| error.contains(part)), "{error}");
    }
    for (bytes, part) in [(level4, "version 4"), (vec![b'a'; 300], "does not begin as a MAT-file")] {
        let error = parse_mat(&bytes, "other.mat").unwrap_err().to_string();
        assert!(error.starts_with("other.mat: ") && error.contains(part), "{error}");
        assert!(error.contains("'-v7')"), "{error}");
    }
    assert!(parse_mat(&[], "empty.mat").is_err());
}

/// A file cut off anywhere is an error, or a recording of the variables that are whole; never half a signal.
#[test]
fn no_cut_makes_a_fault() {
    for name in ["vectors_v6", "vectors_v7", "simulink", "matrix"] {
        let whole = bytes(name);
        let (mut damaged, mut read) = (0, 0);
        for end in 0..whole.len() {
            match parse_mat(&whole[..end], "cut.mat") {
                Ok(recording) => {
                    read += 1;
                    assert_eq!(recording.time.len(), 60);
                }
                Err(RecordingError::Damaged { .. }) => damaged += 1,
                Err(_) => {}
            }
        }
        assert!(damaged > whole.len() / 2, "{name}: {damaged} of {} cuts are seen", whole.len());
        assert!(read < whole.len() / 2, "{name}: {read}");
    }
}

/// A changed byte is an error or other values; in what is compressed, the checksum tells.
#[test]
fn no_changed_byte_makes_a_fault() {
    for (name, compressed) in [("vectors_v6", false), ("vectors_v7", true), ("simulink", true)] {
        let whole = bytes(name);
        let mut refused = 0;
        for at in 0..whole.len() {
            for change in [0x01, 0x80, 0xff] {
                let mut changed = whole.clone();
                changed[at] ^= change;
                refused += usize::from(parse_mat(&changed, "changed.mat").is_err());
            }
        }
        let after_header = 3 * (whole.len() - 128);
        assert!(!compressed || refused > after_header * 9 / 10, "{name}: {refused} of {after_header}");
        assert!(refused > 100, "{name}: {refused}");
    }
}
