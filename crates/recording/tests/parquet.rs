//! Parquet files, written by the same library that reads them or by pandas and PyArrow (`tests/parquet/make.py`), and damaged
//! ones.
#![cfg(feature = "parquet")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use std::path::Path;
use std::sync::Arc;

use greybox_recording::{Recording, RecordingError, Selection, episodes, parse, parse_parquet, read};
use parquet::basic::{Compression, ZstdLevel};
use parquet::data_type::{BoolType, ByteArrayType, DoubleType, FloatType, Int64Type};
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::parser::parse_message_type;

const ROWS: usize = 60;

/// Two row groups with every kind of column; `time` is the definition of the first one, `unit` its ticks per second.
fn file(time: &str, unit: f64, compression: Compression) -> Vec<u8> {
    let schema = format!(
        "message m {{ required int64 {time}; optional double theta; required float v; required boolean on;
         required binary note (UTF8); }}"
    );
    let properties = Arc::new(WriterProperties::builder().set_compression(compression).build());
    let schema = Arc::new(parse_message_type(&schema).unwrap());
    let mut writer = SerializedFileWriter::new(Vec::new(), schema, properties).unwrap();
    for rows in [0..ROWS / 2, ROWS / 2..ROWS] {
        let mut group = writer.next_row_group().unwrap();
        let mut column = group.next_column().unwrap().unwrap();
        let ticks: Vec<i64> = rows.clone().map(|k| START + (0.01 * k as f64 * unit).round() as i64).collect();
        column.typed::<Int64Type>().write_batch(&ticks, None, None).unwrap();
        column.close().unwrap();
        let mut column = group.next_column().unwrap().unwrap();
        let present: Vec<usize> = rows.clone().filter(|k| k % 7 != 3).collect();
        let theta: Vec<f64> = present.iter().map(|&k| (k as f64).cos()).collect();
        let levels: Vec<i16> = rows.clone().map(|k| i16::from(k % 7 != 3)).collect();
        column.typed::<DoubleType>().write_batch(&theta, Some(&levels), None).unwrap();
        column.close().unwrap();
        let mut column = group.next_column().unwrap().unwrap();
        let v: Vec<f32> = rows.clone().map(|k| k as f32 / 4.0).collect();
        column.typed::<FloatType>().write_batch(&v, None, None).unwrap();
        column.close().unwrap();
        let mut column = group.next_column().unwrap().unwrap();
        let on: Vec<bool> = rows.clone().map(|k| k % 2 == 1).collect();
        column.typed::<BoolType>().write_batch(&on, None, None).unwrap();
        column.close().unwrap();
        let mut column = group.next_column().unwrap().unwrap();
        let notes: Vec<_> = rows.map(|k| format!("row {k}").as_str().into()).collect();
        column.typed::<ByteArrayType>().write_batch(&notes, None, None).unwrap();
        column.close().unwrap();
        group.close().unwrap();
    }
    writer.into_inner().unwrap()
}

/// Ticks of the first row: a timestamp of today is of this size.
const START: i64 = 1_700_000_000_000_000;

#[test]
fn columns_become_channels() {
    for compression in [
        Compression::UNCOMPRESSED,
        Compression::SNAPPY,
        Compression::LZ4_RAW,
        Compression::ZSTD(ZstdLevel::default()),
        Compression::GZIP(Default::default()),
    ] {
        let bytes = file("time (TIMESTAMP(MICROS,true))", 1e6, compression);
        let recording = parse_parquet(bytes, "run.parquet").unwrap();
        assert_eq!(recording.dt(), 0.01);
        assert_eq!(recording.time.len(), ROWS);
        let names: Vec<&str> = recording.channels.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["theta", "v", "on"]);
        for k in 0..ROWS {
            let value = |name: &str| recording.channel(name).unwrap().values[k];
            assert!((recording.time[k] - 0.01 * k as f64).abs() < 1e-12);
            assert_eq!(value("theta").is_nan(), k % 7 == 3);
            assert!(k % 7 == 3 || value("theta") == (k as f64).cos());
            assert_eq!((value("v"), value("on")), (k as f64 / 4.0, (k % 2) as f64));
        }
        assert_eq!(recording.warnings[0].code, "left_out");
        assert!(recording.warnings[0].message.contains("`note`"), "{}", recording.warnings[0].message);
    }
}

#[test]
fn a_file_without_time_names_its_columns() {
    let error = parse_parquet(file("tick", 1e6, Compression::SNAPPY), "bad.parquet").unwrap_err();
    assert!(matches!(error, RecordingError::NoTime { .. }));
    for part in
        ["bad.parquet: there is no time", "`tick`, `theta`, `v`, `on`, `note`", "call the column of times"]
    {
        assert!(error.to_string().contains(part), "{error}");
    }
}

fn made(name: &str) -> Result<Recording, RecordingError> {
    read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/parquet").join(name))
}

/// `state` is [sin 3t, cos 2t, k], `action` [k/4, missing where k is even], both missing in row 17; times are k/50 as `f32`.
#[test]
fn lists_of_one_length_become_a_channel_per_element() {
    for name in ["lists.parquet", "fixed.parquet", "old_lists.parquet"] {
        let recording = made(name).unwrap();
        let names: Vec<_> = recording.channels.iter().map(|c| (c.name.as_str(), c.unit.as_deref())).collect();
        let wanted = [
            ("observation.state[0]", None),
            ("observation.state[1]", None),
            ("observation.state[2]", None),
            ("action[0]", Some("N")),
            ("action[1]", Some("N")),
            ("frame_index", None),
            ("episode_index", None),
        ];
        assert_eq!(names, wanted, "{name}");
        assert_eq!((recording.time.len(), recording.pieces.len()), (60, 1));
        assert!((recording.dt() - 0.02).abs() < 1e-9, "{name}: {}", recording.dt());
        for k in 0..60 {
            let value = |name: &str| recording.channel(name).unwrap().values[k];
            let is_missing = k == 17;
            assert_eq!(recording.time[k], f64::from((k as f64 / 50.0) as f32));
            assert_eq!(value("observation.state[2]").is_nan(), is_missing);
            assert_eq!(value("action[1]").is_nan(), is_missing || k % 2 == 0);
            if !is_missing {
                let t = k as f64 / 50.0;
                assert!((value("observation.state[0]") - (3.0 * t).sin()).abs() < 1e-7);
                assert!((value("observation.state[1]") - (2.0 * t).cos()).abs() < 1e-7);
                assert_eq!((value("observation.state[2]"), value("action[0]")), (k as f64, k as f64 / 4.0));
            }
        }
        let told = &recording.warnings[0].message;
        assert!(told.contains("`ragged` (lists of different lengths)"), "{name}: {told}");
        assert!(told.contains("`nested.list."), "{name}: {told}");
    }
}

/// At 5000 s a time as `f32` has steps of 0.5 ms: that is no jitter of the sampling.
#[test]
fn the_digits_of_a_time_end_where_its_type_says() {
    let late = made("late.parquet").unwrap();
    assert!((late.dt() - 0.02).abs() < 1e-5, "{}", late.dt());
    assert!(late.warnings.is_empty(), "{:?}", late.warnings);
}

#[test]
fn several_episodes_are_refused_where_the_time_restarts() {
    let error = made("episodes.parquet").unwrap_err();
    assert!(matches!(error, RecordingError::SeveralEpisodes { .. }), "{error}");
    for part in [
        "holds 3 episodes (4 … 6; column `episode_index`)",
        "`episodes.parquet#4`",
        "a shell expands: `episodes.parquet#{4..6}`",
        "`greybox diagnose MODEL.toml FOLDER`",
    ] {
        assert!(error.to_string().contains(part), "{error}");
    }
    assert_eq!(made("one_time.parquet").unwrap().time.len(), 60, "episodes of one clock are one recording");
}

/// Episode e of 4, 5 and 6 has the times k/50 as `f32`, and `observation.state` is [k/50, k/25] in each.
#[test]
fn an_episode_is_a_recording() {
    for e in 4..7 {
        let episode = made(&format!("episodes.parquet#{e}")).unwrap();
        assert_eq!(episode.name, format!("episodes.parquet#{e}"));
        let names: Vec<&str> = episode.channels.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["observation.state[0]", "observation.state[1]", "episode_index"]);
        let time: Vec<f64> = (0..20).map(|k| f64::from((f64::from(k) / 50.0) as f32)).collect();
        assert_eq!(episode.time, time);
        assert_eq!(episode.channels[0].values, time);
        let twice: Vec<f64> = (0..20).map(|k| f64::from((f64::from(k) / 25.0) as f32)).collect();
        assert_eq!(episode.channels[1].values, twice);
        assert_eq!(episode.channels[2].values, [f64::from(e); 20]);
    }
    let part = made("one_time.parquet#5").unwrap();
    assert_eq!((part.time.len(), part.time[0]), (20, 0.4), "one clock goes on");
}

#[test]
fn the_episodes_of_a_file_are_listed() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/parquet");
    assert_eq!(episodes(folder.join("episodes.parquet")).unwrap(), [4, 5, 6]);
    for one in ["one_time.parquet", "lists.parquet", "late.parquet"] {
        assert_eq!(episodes(folder.join(one)).unwrap(), [0i64; 0], "{one}");
    }
    assert!(matches!(episodes(folder.join("none.parquet")), Err(RecordingError::NotFound { .. })));
    assert!(matches!(episodes(folder.join("make.py")).as_deref(), Ok([])));
}

#[test]
fn an_episode_that_is_none_is_refused() {
    for (name, parts) in [
        (
            "episodes.parquet#7",
            &["episodes.parquet#7: the file has no episode 7", "`episode_index`: 4 … 6"][..],
        ),
        ("episodes.parquet#04", &["`04` is not the number of an episode; write a whole number after `#`"]),
        ("episodes.parquet#", &["`` is not the number of an episode"]),
        (
            "late.parquet#0",
            &["`#0` names an episode, but the file has no column", "name the file without it"],
        ),
        ("make.csv#0", &["make.csv: no such file"]),
        ("none.parquet#0", &["none.parquet: no such file"]),
    ] {
        let error = made(name).unwrap_err();
        assert!(parts.iter().all(|part| error.to_string().contains(part)), "{error}");
    }
    let error = parse(b"t,u\n0,1\n".to_vec(), "a/run.csv#3", "run.csv#3", &Selection::default()).unwrap_err();
    assert!(error.to_string().starts_with("a/run.csv#3: `#3` names an episode, but only Parquet"), "{error}");
}

/// A file that is called so comes first, also for the reader of its bytes.
#[test]
fn a_file_with_a_number_sign_is_that_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.csv#3");
    let rows: String = (0..20).map(|k| format!("{k},{}\n", k % 3)).collect();
    std::fs::write(&path, format!("t,u\n{rows}")).unwrap();
    assert_eq!(read(&path).unwrap().name, "run.csv#3");
    std::fs::rename(&path, folder.path().join("run.csv")).unwrap();
    assert!(matches!(read(&path), Err(RecordingError::NoEpisodes { .. })));
}

/// The rows of two episodes take turns, in three row groups; lists have one element in even rows and two in
/// odd ones. `e` is the episode of a row.
fn mixed(e: impl Fn(usize) -> f64) -> Vec<u8> {
    let schema = "message m { required double t; required double episode_index; optional double x; \
                  required group w (LIST) { repeated group list { required double element; } } }";
    let schema = Arc::new(parse_message_type(schema).unwrap());
    let mut writer = SerializedFileWriter::new(Vec::new(), schema, Arc::default()).unwrap();
    for group in 0..3 {
        let rows: Vec<usize> = (30 * group..30 * group + 30).collect();
        // Values, levels of definition and of repetition.
        type Levels = Option<Vec<i16>>;
        let columns: [(Vec<f64>, Levels, Levels); 4] = [
            (rows.iter().map(|&k| (k / 2) as f64 / 8.0).collect(), None, None),
            (rows.iter().map(|&k| e(k)).collect(), None, None),
            (
                rows.iter().filter(|k| *k % 7 != 3).map(|&k| k as f64).collect(),
                Some(rows.iter().map(|k| i16::from(k % 7 != 3)).collect()),
                None,
            ),
            (
                rows.iter().flat_map(|&k| vec![k as f64; 1 + k % 2]).collect(),
                Some(rows.iter().flat_map(|&k| vec![1; 1 + k % 2]).collect()),
                Some(rows.iter().flat_map(|&k| (0..1 + k % 2).map(|i| i16::from(i > 0))).collect()),
            ),
        ];
        let mut file = writer.next_row_group().unwrap();
        for (values, levels, repeats) in columns {
            let mut column = file.next_column().unwrap().unwrap();
            let typed = column.typed::<DoubleType>();
            typed.write_batch(&values, levels.as_deref(), repeats.as_deref()).unwrap();
            column.close().unwrap();
        }
        file.close().unwrap();
    }
    writer.into_inner().unwrap()
}

#[test]
fn episodes_whose_rows_take_turns_are_taken_apart() {
    for (e, width) in [(-2, 1), (9, 2)] {
        let bytes = mixed(|k| [-2.0, 9.0][k % 2]);
        let recording = parse_parquet(bytes, &format!("mixed.parquet#{e}")).unwrap();
        let rows: Vec<usize> = (0..90).filter(|k| k % 2 == width - 1).collect();
        assert_eq!(recording.time, rows.iter().map(|&k| (k / 2) as f64 / 8.0).collect::<Vec<_>>());
        assert_eq!(recording.channels.len(), 2 + width);
        for (i, &k) in rows.iter().enumerate() {
            let value = |c: usize| recording.channels[c].values[i];
            assert_eq!((value(0), value(1).is_nan()), (f64::from(e), k % 7 == 3));
            assert!(value(1).is_nan() || value(1) == k as f64);
            assert!((0..width).all(|j| value(2 + j) == k as f64));
        }
    }
    // Within an episode the rows are in the order of time.
    let error = parse_parquet(mixed(|k| f64::from(u8::from(k >= 40))), "mixed.parquet#1").unwrap_err();
    assert!(matches!(error, RecordingError::TimeNotIncreasing { .. }), "{error}");
    for (odd, found) in [(0.5, "`0.5`"), (f64::NAN, "`NaN`"), (1e300, "is not the number of an episode")] {
        for name in ["mixed.parquet", "mixed.parquet#1"] {
            let bytes = mixed(|k| if k == 70 { odd } else { (k % 2) as f64 });
            let error = parse_parquet(bytes, name).unwrap_err();
            assert!(matches!(error, RecordingError::EpisodeNumber { .. }), "{error}");
            assert!(
                error.to_string().starts_with(&format!("{name}:71:episode_index (column 2): ")),
                "{error}"
            );
            assert!(error.to_string().contains(found), "{error}");
        }
    }
}

#[test]
fn no_cut_and_no_changed_byte_of_an_episode_makes_a_fault() {
    let whole = mixed(|k| (k % 2) as f64);
    for end in (0..whole.len()).step_by(3) {
        assert!(parse_parquet(whole[..end].to_vec(), "cut.parquet#1").is_err(), "{end}");
    }
    let mut refused = 0;
    for at in 0..whole.len() {
        for change in [0x01, 0x80, 0xff] {
            let mut changed = whole.clone();
            changed[at] ^= change;
            refused += usize::from(parse_parquet(changed, "changed.parquet#1").is_err());
        }
    }
    assert!(refused > 100, "{refused}");
}

#[test]
fn no_cut_and_no_changed_byte_of_lists_makes_a_fault() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/parquet");
    let whole = std::fs::read(folder.join("lists.parquet")).unwrap();
    for end in 0..whole.len() {
        assert!(parse_parquet(whole[..end].to_vec(), "cut.parquet").is_err(), "{end}");
    }
    let mut refused = 0;
    for at in 0..whole.len() {
        for change in [0x01, 0x80, 0xff] {
            let mut changed = whole.clone();
            changed[at] ^= change;
            refused += usize::from(parse_parquet(changed, "changed.parquet").is_err());
        }
    }
    assert!(refused > 100, "{refused}");
}

#[test]
fn no_cut_and_no_changed_byte_makes_a_fault() {
    let whole = file("t", 1e3, Compression::SNAPPY);
    for end in 0..whole.len() {
        let error = parse_parquet(whole[..end].to_vec(), "cut.parquet").unwrap_err();
        assert!(matches!(error, RecordingError::Damaged { .. }), "{end}: {error}");
    }
    let mut refused = 0;
    for at in 0..whole.len() {
        for change in [0x01, 0x80, 0xff] {
            let mut changed = whole.clone();
            changed[at] ^= change;
            refused += usize::from(parse_parquet(changed, "changed.parquet").is_err());
        }
    }
    assert!(refused > 100, "{refused}");
}
