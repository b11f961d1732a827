//! Parquet files, written by the same library that reads them or by pandas and PyArrow (`tests/parquet/make.py`), and damaged
//! ones.
#![cfg(feature = "parquet")]
// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use std::path::Path;
use std::sync::Arc;

use greybox_recording::{Recording, RecordingError, parse_parquet, read};
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
    for part in ["holds 3 episodes (column `episode_index`)", "a file for each value of `episode_index`"] {
        assert!(error.to_string().contains(part), "{error}");
    }
    assert_eq!(made("one_time.parquet").unwrap().time.len(), 60, "episodes of one clock are one recording");
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
