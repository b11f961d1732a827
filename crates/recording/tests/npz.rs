//! Files of NumPy as `np.savez`, `np.savez_compressed` and `np.save` write them (`tests/npz/make.py`), and damaged ones.
#![cfg(feature = "npz")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use crate::files::{self, headers, stands_at_every, third, told};
use greybox_recording::{Recording, RecordingError, Selection, parse_npz, read};
use std::path::{Path, PathBuf};

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/npz").join(name)
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

#[test]
fn every_form_gives_the_same_recording() {
    let [t, v, theta] = samples();
    for (name, wanted) in [
        ("plain.npz", ["v", "theta"]),
        ("packed.npz", ["v", "theta"]),
        ("matrix.npz", ["v [V]", "theta [deg]"]),
        ("columns.npz", ["v [V]", "theta [deg]"]),
        ("first.npz", ["run_1", "run_2"]),
        ("records.npz", ["v", "theta"]),
        ("records.npy", ["v", "theta"]),
        ("matrix.npy", ["y_1", "y_2"]),
    ] {
        let recording = recording(name);
        assert_eq!(headers(&recording), wanted, "{name}");
        assert_eq!(recording.time, t, "{name}");
        assert_eq!(recording.channels[0].values, v, "{name}");
        assert_eq!(recording.channels[1].values, theta, "{name}");
    }
}

#[test]
fn every_kind_of_number_is_read_and_what_is_left_out_is_told() {
    let kinds = recording("kinds.npz");
    let [_, v, _] = samples();
    assert_eq!(headers(&kinds), ["big", "half", "wide", "byte", "on"]);
    for k in 0..60 {
        let value = |name: &str| kinds.channel(name).unwrap().values[k];
        assert_eq!((value("big"), value("half")), (f64::from(v[k] as f32), k as f64 / 4.0 - 5.0));
        assert_eq!((value("wide"), value("byte"), value("on")), (-(k as f64), k as f64, (k % 2) as f64));
    }
    let told = &kinds.warnings[0].message;
    for part in ["`z` (complex numbers)", "`when` (dates or durations)", "`things` (Python objects)"] {
        assert!(told.contains(part), "{told}");
    }
}

#[test]
fn what_is_no_recording_is_refused_with_its_help() {
    let timeless = parse_npz(&bytes("no_time.npz"), "bad.npz").unwrap_err();
    assert!(matches!(timeless, RecordingError::NoTime { .. }), "{timeless}");
    assert!(timeless.to_string().contains("`v` (60×1), `theta` (60×1)"), "{timeless}");
    let unclear = parse_npz(&bytes("unclear.npz"), "bad.npz").unwrap_err();
    assert!(matches!(unclear, RecordingError::SeveralTimes { .. }), "{unclear}");
    assert!(
        unclear.to_string().starts_with("bad.npz: `gap` may belong to any of the times `t_a`, `t_b`"),
        "{unclear}"
    );
    let text = parse_npz(b"t,v\n0,1\n", "bad.npz").unwrap_err().to_string();
    assert!(text.contains("no archive of NumPy") && text.contains("np.savez"), "{text}");
}

#[test]
fn times_find_their_signals_by_length_and_by_name() {
    let [t, v, theta] = samples();
    let (late, closed) = third(&theta);
    for (name, fast) in [("two_times.npz", "motor_v"), ("beside.npz", "v")] {
        let recording = recording(name);
        assert_eq!(headers(&recording), [fast, "load_theta", "load_closed"], "{name}");
        assert_eq!(recording.time, t[..58], "{name}");
        stands_at_every(&recording, fast, 1, &v);
        stands_at_every(&recording, "load_theta", 3, &late);
        stands_at_every(&recording, "load_closed", 3, &closed);
    }
    let names = ["a_v", "b_theta"].map(str::to_owned).to_vec();
    let selection = Selection { channels: names.clone(), ..Selection::default() };
    let chosen = greybox_recording::parse(bytes("unclear.npz"), "a.npz", "a.npz", &selection).unwrap();
    assert_eq!(headers(&chosen), names);
    assert!(told(&chosen).contains("`t_b` has its own clock"), "{}", told(&chosen));
}

#[test]
fn no_cut_makes_a_recording() {
    for name in ["plain.npz", "packed.npz", "records.npy"] {
        let whole = bytes(name);
        for end in 1..whole.len() {
            assert!(parse_npz(&whole[..end], "cut.npz").is_err(), "{name} {end}");
        }
    }
}

/// A changed byte is an error or other names; of the values, the checksum tells.
#[test]
fn no_changed_byte_makes_a_fault() {
    for (name, share) in [("plain.npz", 0.8), ("packed.npz", 0.8), ("records.npy", 0.02)] {
        let whole = bytes(name);
        let mut refused = 0;
        for at in 0..whole.len() {
            for change in [0x01, 0x80, 0xff] {
                let mut changed = whole.clone();
                changed[at] ^= change;
                refused += usize::from(parse_npz(&changed, "changed.npz").is_err());
            }
        }
        assert!(
            refused as f64 > share * 3.0 * whole.len() as f64,
            "{name}: {refused} of {}",
            3 * whole.len()
        );
    }
}
