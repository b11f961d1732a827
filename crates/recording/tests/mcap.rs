//! MCAP logs as the reference library writes them (`tests/mcap/make.py` made those read here), and damaged ones.
#![cfg(feature = "mcap")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use greybox_recording::{Recording, RecordingError, Rename, Selection, health, parse_mcap, read_selected};
use std::path::{Path, PathBuf};

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/mcap").join(format!("{name}.mcap"))
}

fn bytes(name: &str) -> Vec<u8> {
    std::fs::read(path(name)).unwrap()
}

fn only(channels: &[&str]) -> Selection {
    Selection { channels: channels.iter().map(|&c| c.to_owned()).collect(), ..Selection::default() }
}

fn read(name: &str, channels: &[&str]) -> Recording {
    parse_mcap(&bytes(name), name, &only(channels)).unwrap_or_else(|e| panic!("{e}"))
}

/// Sample `k` of signal `i`, as `make.py` computes it.
fn value(k: usize, i: usize) -> f64 {
    (k * 37 % 101) as f64 / 7.0 - i as f64
}

#[track_caller]
fn is(recording: &Recording, channel: &str, wanted: impl Fn(usize) -> f64) {
    let found = &recording.channel(channel).unwrap_or_else(|| panic!("no {channel}")).values;
    assert!(found.len() >= 10, "{channel}");
    for (k, found) in found.iter().enumerate() {
        assert_eq!(found.to_bits(), wanted(k).to_bits(), "{channel} {k}: {found} {}", wanted(k));
    }
}

fn told(recording: &Recording) -> String {
    recording.warnings.iter().map(|w| format!("{w}\n")).collect()
}

const JOINTS: [&str; 3] = ["shoulder", "elbow", "wrist.roll"];

/// Packed or not: the joints of a state are series of their own, to the bit, at the stamps.
#[test]
fn joint_states_are_read_to_the_bit() {
    for name in ["arm_zstd", "arm_lz4", "arm_none"] {
        let named: Vec<String> = JOINTS
            .iter()
            .flat_map(|j| ["position", "velocity"].map(|f| format!("/joint_states.{f}[{j}]")))
            .collect();
        let names: Vec<&str> = named.iter().map(String::as_str).collect();
        let recording = read(name, &names);
        assert_eq!(recording.channels.len(), 6, "{name}");
        assert_eq!(recording.time, (0..120).map(|k| (k * 10_000_000) as f64 / 1e9).collect::<Vec<_>>());
        assert_eq!(recording.dt(), 0.01);
        for (i, joint) in JOINTS.iter().enumerate() {
            is(&recording, &format!("/joint_states.position[{joint}]"), |k| value(k, i));
            is(&recording, &format!("/joint_states.velocity[{joint}]"), |k| 2.0 * value(k, i));
        }
        assert!(
            told(&recording).contains("stamps in the headers of `/joint_states`"),
            "{}",
            told(&recording)
        );
    }
}

/// A command at 20 Hz beside a state at 100 Hz: its values stand at the nearest instants as they were sent.
#[test]
fn a_command_is_laid_on_the_clock_of_the_state() {
    let recording = read("arm_zstd", &["/cmd.data", "/joint_states.position[elbow]"]);
    let names: Vec<&str> = recording.channels.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["/cmd.data", "/joint_states.position[elbow]"]);
    // The first command is logged 1 ms after the first state.
    assert_eq!((recording.time.len(), recording.time[0]), (119, 0.01));
    is(&recording, "/joint_states.position[elbow]", |k| value(k + 1, 1));
    let command = &recording.channel("/cmd.data").unwrap().values;
    let sent: Vec<(usize, f64)> =
        command.iter().copied().enumerate().filter(|(_, v)| !v.is_nan()).map(|(k, v)| (k + 1, v)).collect();
    let wanted = (0..24).map(|k| (if k == 0 { 1 } else { 5 * k }, value(k, 0)));
    assert_eq!(sent, wanted.collect::<Vec<_>>());
    let told = told(&recording);
    for part in [
        "`/cmd` has its own clock (20 Hz): its 24 samples were moved as they are to the nearest instants of `/joint_states` \
         (100 Hz), by at most 1 ms.",
        "those at which `/cmd` were logged",
        "1 of 144 samples are left out",
    ] {
        assert!(told.contains(part), "{told}");
    }
    let findings = health::check(&recording, &["/cmd.data"], &["/joint_states.position[elbow]"]);
    let worries = |f: &&greybox_recording::Finding| f.severity > greybox_recording::Severity::Info;
    assert!(!findings.iter().any(|f| f.code == "missing"), "{findings:?}");
    assert!(
        findings.iter().filter(worries).all(|f| f.channel.as_deref() != Some("/cmd.data")),
        "{findings:?}"
    );
    assert!(findings.iter().any(|f| f.code == "clocks" && f.channel.as_deref() == Some("/cmd.data")));
}

/// What is read of a file as a whole: every number, and a word on what is none.
#[test]
fn everything_is_read_or_told() {
    let recording = read("arm_lz4", &[]);
    let has = |name: &str| recording.channel(name).is_some();
    for name in [
        "/joint_states.position[wrist.roll]",
        "/cmd.data",
        "/cmd_vel.linear.x",
        "/imu.angular_velocity.z",
        "/imu.orientation_covariance[8]",
        "/status.load",
        "/status.on",
        "/status.pack.cells[1]",
        "/camera.height",
    ] {
        assert!(has(name), "{name}");
    }
    assert!(!has("/camera.data[0]") && !has("/scan.ranges[0]"));
    let told = told(&recording);
    for part in
        ["`/proto` (its messages are `protobuf`)", "`/camera.data` (bytes)", "`/scan.ranges` (long arrays)"]
    {
        assert!(told.contains(part), "{told}");
    }
    let unit = |name: &str| recording.channel(name).unwrap().unit.as_deref();
    assert_eq!(unit("/cmd_vel.linear.y"), Some("m/s"));
    assert_eq!(unit("/cmd_vel.angular.y"), Some("rad/s"));
    assert_eq!(unit("/imu.linear_acceleration.x"), Some("m/s^2"));
    assert_eq!(unit("/imu.linear_acceleration_covariance[0]"), None);
    assert_eq!(unit("/joint_states.position[elbow]"), None);
}

#[test]
fn topics_alone_are_read_to_the_bit() {
    let imu = read(
        "arm_none",
        &["/imu.angular_velocity.y", "/imu.linear_acceleration.x", "/imu.orientation_covariance[3]"],
    );
    is(&imu, "/imu.angular_velocity.y", |k| value(k, 1));
    is(&imu, "/imu.linear_acceleration.x", |k| value(k, 3));
    is(&imu, "/imu.orientation_covariance[3]", |_| 0.75);
    assert_eq!(imu.dt(), 0.02);
    let twist = read("arm_zstd", &["/cmd_vel.linear.x", "/cmd_vel.angular.z"]);
    is(&twist, "/cmd_vel.linear.x", |k| value(k, 0));
    is(&twist, "/cmd_vel.angular.z", |k| value(k, 5));
    let status = read("arm_zstd", &["/status.load", "/status.on", "/status.pack.cells[1]"]);
    is(&status, "/status.load", |k| value(k, 0));
    is(&status, "/status.on", |k| (k % 2) as f64);
    is(&status, "/status.pack.cells[1]", |k| (k + 1) as f64);
}

/// Against the reference writer: every type at every alignment, also in structures and in lists of them.
#[test]
fn every_kind_of_field_is_read_to_the_bit() {
    let all = read("kinds", &[]);
    assert_eq!(all.channels.len(), 32, "{:?}", all.channels.iter().map(|c| &c.name).collect::<Vec<_>>());
    let sure = |field: &str, wanted: &dyn Fn(usize) -> f64| is(&all, &format!("/kinds.{field}"), wanted);
    sure("on", &|k| ((k + 1) % 2) as f64);
    sure("i8", &|k| 0.0 - k as f64);
    sure("raw", &|k| (200 + k) as f64);
    sure("letter", &|k| (65 + k) as f64);
    sure("i16", &|k| 0.0 - (1000 * k) as f64);
    sure("u8", &|k| (2 * k) as f64);
    sure("f64", &|k| value(k, 0));
    sure("u16", &|k| (60_000 + k) as f64);
    sure("i32", &|k| 0.0 - (100_000 * k) as f64);
    sure("f32", &|k| k as f64 / 4.0);
    sure("u32", &|k| 4e9 + k as f64);
    sure("i64", &|k| 0.0 - ((1u64 << 40) * k as u64) as f64);
    sure("last", &|k| f64::from(u8::from(k % 3 == 0)));
    sure("u64", &|k| ((1u64 << 60) * k as u64) as f64);
    sure("fixed[1]", &|k| 0.0 - k as f64);
    sure("bounded[1]", &|k| value(k, 1));
    sure("wait", &|k| k as f64 - 4.75);
    sure("parts[1].n", &|_| 3.0);
    sure("parts[0].x[p0]", &|k| value(k, 0));
    sure("parts[1].x[p2]", &|k| value(k, 2));
    sure("one.x[p1]", &|k| value(k, 1));
    sure("flags[0]", &|_| 1.0);
    sure("end", &|k| value(k, 2));
    assert_eq!(all.channel("/kinds.wait").unwrap().unit.as_deref(), Some("s"));
}

/// A name of the model may be a channel with a bracket of its own, and then a unit; a model's names alone choose the clocks.
#[test]
fn names_choose_what_is_read() {
    let rename: Vec<Rename> = ["theta=/joint_states.position[elbow] [deg]", "u=/cmd.data"]
        .iter()
        .map(|t| t.parse().unwrap())
        .collect();
    let mut recording = read_selected(path("arm_zstd"), &Selection::of(&[], &rename)).unwrap();
    recording.rename(&rename).unwrap();
    let headers: Vec<String> = recording.channels.iter().map(|c| c.header()).collect();
    assert_eq!(headers, ["u", "theta [deg]"]);
    // One that is not there: everything is read, for the error that lists it.
    let wrong: Vec<Rename> = vec!["theta=/joint_states.position[elbw]".parse().unwrap()];
    let mut everything = read_selected(path("arm_zstd"), &Selection::of(&[], &wrong)).unwrap();
    assert!(everything.channels.len() > 40);
    let error = everything.rename(&wrong).unwrap_err().to_string();
    assert!(
        error.contains("no channel `/joint_states.position[elbw]`; the file has `/cmd_vel.linear.x`"),
        "{error}"
    );
    let named = Selection { named: vec![vec!["/cmd.data".to_owned()]], ..Selection::default() };
    assert_eq!(read_selected(path("arm_zstd"), &named).unwrap().channels.len(), 1);
}

#[test]
fn a_log_without_numbers_is_refused() {
    let empty = parse_mcap(&[], "empty.mcap", &Selection::default()).unwrap_err();
    assert!(matches!(empty, RecordingError::Damaged { .. }), "{empty}");
    let other = parse_mcap(&[b'a'; 300], "other.mcap", &Selection::default()).unwrap_err().to_string();
    assert!(other.starts_with("other.mcap: the file is damaged: Bad magic number"), "{other}");
}

/// A file cut off anywhere is an error; a changed byte is one too, or other values.
#[test]
fn no_cut_and_no_changed_byte_makes_a_fault() {
    let whole = bytes("small");
    let parse = |bytes: &[u8]| parse_mcap(bytes, "bad.mcap", &Selection::default());
    assert_eq!(parse(&whole).unwrap().channels.len(), 2);
    for end in 0..whole.len() {
        let error = parse(&whole[..end]).unwrap_err();
        assert!(matches!(error, RecordingError::Damaged { .. }), "{end}: {error}");
        assert!(end == 0 || error.to_string().contains("`mcap recover`"), "{end}: {error}");
    }
    let mut refused = 0;
    for at in 0..whole.len() {
        for change in [0x01, 0x80, 0xff] {
            let mut changed = whole.clone();
            changed[at] ^= change;
            refused += usize::from(parse(&changed).is_err());
        }
    }
    assert!(refused > whole.len(), "{refused} of {}", 3 * whole.len());
}

/// Without checksums and packing a changed byte reaches the messages themselves.
#[test]
fn no_changed_byte_of_a_message_makes_a_fault() {
    let whole = bytes("kinds");
    let (mut refused, mut read) = (0, 0);
    for at in (0..whole.len()).step_by(3) {
        for change in [0x01, 0xff] {
            let mut changed = whole.clone();
            changed[at] ^= change;
            match parse_mcap(&changed, "bad.mcap", &Selection::default()) {
                Ok(_) => read += 1,
                Err(_) => refused += 1,
            }
        }
    }
    assert!(refused > 100 && read > 100, "{refused} refused, {read} read");
}
