//! MAT-files as MATLAB, Simulink and SciPy write them (`tests/mat/make.py` made those read here), and damaged ones.
#![cfg(feature = "mat")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use crate::files::{headers, stands_at_every, third, told};
use greybox_recording::{Recording, RecordingError, Selection, parse_mat};
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

/// Time, voltage and angle of 60 samples.
fn experiment() -> [Vec<f64>; 3] {
    let of = |signal: fn(f64) -> f64| (0..60).map(|k| signal(0.01 * f64::from(k))).collect();
    [of(|t| t), of(|t| (3.0 * t).sin()), of(|t| (2.0 * t).cos())]
}

#[test]
fn structures_with_times_of_their_own_are_joined() {
    let [t, v, theta] = experiment();
    let recording = read("two_clocks");
    assert_eq!(headers(&recording), ["v", "theta"]);
    assert_eq!(recording.time, t);
    let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-15, "{a} {b}");
    let values = |name: &str| recording.channel(name).unwrap().values.clone();
    values("v").iter().zip(&v).for_each(|(a, b)| near(*a, *b));
    values("theta").iter().step_by(2).zip(&theta).for_each(|(a, b)| near(*a, *b));
    assert!(values("theta").iter().skip(1).step_by(2).all(|x| x.is_nan()));
    let told = told(&recording);
    assert!(told.contains("`fast.t` ends at t = 0.59 s"), "{told}");
    assert!(
        told.contains("`slow.t` has its own clock (50 Hz)") && told.contains("of `fast.t` (100 Hz)"),
        "{told}"
    );
}

#[test]
fn each_signal_finds_its_time() {
    let [t, v, theta] = experiment();
    let (late, closed) = third(&theta);
    for (name, [volts, angle], rows) in [
        ("dspace_index", ["v [V]", "theta [deg]"], 20),
        ("dspace_raster", ["v [V]", "theta [deg]"], 20),
        ("timeseries", ["v", "theta [deg]"], 58),
        ("flat", ["motor_v", "load_theta"], 58),
    ] {
        let recording = read(name);
        assert!(headers(&recording).contains(&volts.to_owned()), "{name}: {:?}", headers(&recording));
        assert!(headers(&recording).contains(&angle.to_owned()), "{name}: {:?}", headers(&recording));
        let bare = |header: &str| header.split(' ').next().unwrap().to_owned();
        assert_eq!(recording.time, t[..rows], "{name}");
        close(&recording, &bare(volts), 1, &v);
        close(&recording, &bare(angle), 3, &late);
    }
    stands_at_every(&read("flat"), "load_closed", 3, &closed);
    stands_at_every(&read("flat"), "on", 1, &(0..60).map(|k| f64::from(k % 2)).collect::<Vec<f64>>());
}

/// As [`stands_at_every`], up to the last digit of another library's sine.
#[track_caller]
fn close(recording: &Recording, channel: &str, every: usize, samples: &[f64]) {
    for (k, value) in recording.channel(channel).unwrap().values.iter().enumerate() {
        match k % every {
            0 => assert!((value - samples[k / every]).abs() < 1e-15, "{channel} {k}"),
            _ => assert!(value.is_nan(), "{channel} {k}"),
        }
    }
}

#[test]
fn the_selection_says_which_clocks_count() {
    let selected = |channels: &[&str], named: &[&str]| {
        let selection = Selection {
            channels: channels.iter().map(|&c| c.to_owned()).collect(),
            named: named.iter().map(|&n| vec![n.to_owned()]).collect(),
        };
        greybox_recording::parse(bytes("flat"), "flat.mat", "flat.mat", &selection).unwrap()
    };
    let slow = selected(&["load_theta"], &[]);
    assert_eq!((headers(&slow), slow.dt(), slow.time.len()), (vec!["load_theta".to_owned()], 0.03, 20));
    assert!(told(&slow).is_empty());
    assert_eq!(headers(&selected(&["load_theta"], &["motor_v"])), ["motor_v", "load_theta"]);
    assert_eq!(headers(&selected(&[], &["load_closed", "load_theta"])), ["load_theta", "load_closed"]);
    assert_eq!(selected(&["none"], &[]).channels.len(), 4);
    // A truth value stays, whereas of what moves nothing is known after its last sample.
    assert_eq!(selected(&["motor_v", "load_closed"], &[]).time.len(), 60);
    assert_eq!(selected(&["motor_v", "load_theta"], &[]).time.len(), 58);
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
    let unclear = error("dspace_unclear");
    assert!(matches!(unclear, RecordingError::SeveralTimes { .. }), "{unclear}");
    for part in
        ["bad.mat: `run.Y(1).Data`", "`run.X(1).Data`, `run.X(2).Data`", "a structure or group of its own"]
    {
        assert!(unclear.to_string().contains(part), "{unclear}");
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
