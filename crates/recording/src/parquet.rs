//! Reading Parquet files (feature `parquet`).
//!
//! A column is a channel, under the name `name` or `name [unit]`; the time is the column `t`, `time` or `tout`, in s (or
//! `t [ms]`, `t [us]`) or a timestamp, which counts from the first row. Read are real numbers and truth values (0 and
//! 1); a missing value (null) or NaN is a missing sample. What else there is (texts, lists, decimals) is left out, and
//! told in the warnings of the recording. Compression: Snappy, Zstandard, LZ4, gzip.

use crate::error::{Place, RecordingError};
use crate::file::{ROOM, guarded};
use crate::finding::{Finding, Severity, listed};
use crate::header::{TIMES, header_cell, seconds};
use crate::recording::{Channel, Recording};
use ::parquet::basic::{LogicalType, TimeUnit, Type};
use ::parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use ::parquet::data_type::DataType;
use ::parquet::errors::ParquetError;
use ::parquet::file::reader::{FileReader, SerializedFileReader};
use ::parquet::schema::types::ColumnDescriptor;
use bytes::Bytes;

/// Reads a recording called `name` from the bytes of a Parquet file.
///
/// # Errors
/// [`RecordingError::Damaged`] or [`RecordingError::TooLarge`] where the bytes cannot be read; [`RecordingError::NoTime`] or
/// [`RecordingError::NoSignals`] where they make no recording; else as [`Recording::from_columns`].
///
/// ```
/// let error = greybox_recording::parse_parquet(b"t,u\n0,1\n".to_vec(), "run1.parquet").unwrap_err();
/// assert!(error.to_string().starts_with("run1.parquet: the file is damaged"));
/// ```
pub fn parse_parquet(bytes: Vec<u8>, name: &str) -> Result<Recording, RecordingError> {
    parse(bytes, name, name)
}

/// How the numbers of a column are meant.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meaning {
    Number,
    Unsigned,
    /// Seconds per unit, from any instant.
    Timestamp(f64),
}

pub(crate) fn parse(bytes: Vec<u8>, label: &str, name: &str) -> Result<Recording, RecordingError> {
    guarded(label, || read(bytes, label, name))
}

fn read(bytes: Vec<u8>, label: &str, name: &str) -> Result<Recording, RecordingError> {
    let place = || Place::file(label);
    let damaged = |variable: Option<&str>, error: &ParquetError| RecordingError::Damaged {
        place: Place::file(label),
        variable: variable.map(str::to_owned),
        found: error.to_string(),
    };
    let length = bytes.len() as u64;
    let file = SerializedFileReader::new(Bytes::from(bytes)).map_err(|e| damaged(None, &e))?;
    let schema = file.metadata().file_metadata().schema_descr();
    let rows = u64::try_from(file.metadata().file_metadata().num_rows()).unwrap_or(u64::MAX);
    if rows.saturating_mul(8 * schema.num_columns() as u64) > ROOM {
        return Err(RecordingError::TooLarge { place: place(), variable: None, limit_gib: ROOM >> 30 });
    }
    let (mut columns, mut left_out) = (Vec::new(), Vec::new());
    for (c, column) in schema.columns().iter().enumerate() {
        let path = column.path().string();
        let Some(meaning) = meaning(column) else {
            left_out.push(format!("`{path}`"));
            continue;
        };
        let (name, unit) = header_cell(&path, || place().column(c, &path))?;
        let scale = match meaning {
            Meaning::Timestamp(scale) => Some(scale),
            _ => seconds(unit.as_deref()),
        };
        let values = values(&file, c, column.max_def_level(), meaning, rows, length)
            .map_err(|e| damaged(Some(&path), &e))?;
        columns.push((Channel { name, unit, values }, scale));
    }
    let left_out = listed(left_out);
    let time =
        TIMES.iter().find_map(|t| columns.iter().position(|(c, scale)| c.name == *t && scale.is_some()));
    let Some(time) = time else {
        let mut found: Vec<String> = columns.iter().map(|(c, _)| format!("`{}`", c.header())).collect();
        found.extend((!left_out.is_empty()).then_some(left_out));
        let help = "call the column of times, in s, `t`";
        return Err(RecordingError::NoTime { place: place(), found: listed(found), help });
    };
    let (time, scale) = columns.remove(time);
    if columns.is_empty() {
        return Err(RecordingError::NoSignals {
            place: place(),
            time: time.name,
            rows: time.values.len(),
            found: left_out,
        });
    }
    if let Some(row) = time.values.iter().position(|t| t.is_nan()) {
        return Err(RecordingError::MissingTime {
            place: Place::line(label, row as u64 + 1).column(0, &time.name),
        });
    }
    let scale = scale.unwrap_or(1.0);
    let times = time.values.iter().map(|t| scale * t).collect();
    let channels: Vec<Channel> = columns.into_iter().map(|(channel, _)| channel).collect();
    for (c, channel) in channels.iter().enumerate() {
        if let Some(first) = channels[..c].iter().position(|other| other.name == channel.name) {
            let place = place().column(c + 1, &channel.name);
            return Err(RecordingError::DuplicateName {
                place,
                name: channel.name.clone(),
                first: first + 2,
            });
        }
    }
    let mut recording = Recording::checked(label, name, times, channels, 0.0)?;
    if !left_out.is_empty() {
        let message = format!("Left out of the file, holding no plain numbers: {left_out}.");
        recording.warnings.insert(0, Finding::new(Severity::Info, "left_out", message));
    }
    Ok(recording)
}

/// What a column's numbers mean; `None` where it holds none that are read.
fn meaning(column: &ColumnDescriptor) -> Option<Meaning> {
    if column.max_rep_level() > 0 {
        return None;
    }
    match (column.physical_type(), column.logical_type_ref()) {
        (Type::INT32 | Type::INT64, Some(LogicalType::Integer(integer))) if !integer.is_signed => {
            Some(Meaning::Unsigned)
        }
        (Type::INT64, Some(LogicalType::Timestamp(timestamp))) => {
            Some(Meaning::Timestamp(match timestamp.unit {
                TimeUnit::MILLIS => 1e-3,
                TimeUnit::MICROS => 1e-6,
                TimeUnit::NANOS => 1e-9,
            }))
        }
        (Type::INT32 | Type::INT64, None | Some(LogicalType::Integer(_))) => Some(Meaning::Number),
        (Type::FLOAT | Type::DOUBLE | Type::BOOLEAN, _) => Some(Meaning::Number),
        _ => None,
    }
}

/// The numbers of a column, NaN = missing; timestamps count from the first one.
fn values(
    file: &SerializedFileReader<Bytes>,
    column: usize,
    full: i16,
    meaning: Meaning,
    rows: u64,
    length: u64,
) -> Result<Vec<f64>, ParquetError> {
    let mut values = Vec::new();
    let mut first = None;
    for group in 0..file.num_row_groups() {
        check_place(file, group, column, length)?;
        let expected = (rows as usize).saturating_sub(values.len());
        let read = match file.get_row_group(group)?.get_column_reader(column)? {
            ColumnReader::BoolColumnReader(r) => numbers(r, full, expected, |v| f64::from(u8::from(v)))?,
            ColumnReader::Int32ColumnReader(r) if meaning == Meaning::Unsigned => {
                numbers(r, full, expected, |v| f64::from(v.cast_unsigned()))?
            }
            ColumnReader::Int32ColumnReader(r) => numbers(r, full, expected, f64::from)?,
            ColumnReader::Int64ColumnReader(r) => match meaning {
                Meaning::Unsigned => numbers(r, full, expected, |v| v.cast_unsigned() as f64)?,
                // As a number since 1970 a double has no room for fractions of a microsecond.
                Meaning::Timestamp(_) => {
                    numbers(r, full, expected, |v| v.wrapping_sub(*first.get_or_insert(v)) as f64)?
                }
                Meaning::Number => numbers(r, full, expected, |v| v as f64)?,
            },
            ColumnReader::FloatColumnReader(r) => numbers(r, full, expected, f64::from)?,
            ColumnReader::DoubleColumnReader(r) => numbers(r, full, expected, |v| v)?,
            _ => return Err(ParquetError::General("the column changes its type".to_owned())),
        };
        values.extend(read);
    }
    Ok(values)
}

/// Sees that a column of a row group lies within the `length` bytes of the file: the library takes that for granted.
fn check_place(
    file: &SerializedFileReader<Bytes>,
    group: usize,
    column: usize,
    length: u64,
) -> Result<(), ParquetError> {
    let chunk = file.metadata().row_group(group).columns().get(column);
    let inside = chunk.is_some_and(|chunk| {
        let start = chunk.dictionary_page_offset().unwrap_or(chunk.data_page_offset());
        let place = (u64::try_from(start), u64::try_from(chunk.compressed_size()));
        matches!(place, (Ok(start), Ok(size)) if start.checked_add(size).is_some_and(|end| end <= length))
    });
    match inside {
        true => Ok(()),
        false => Err(ParquetError::General("its data lie outside the file".to_owned())),
    }
}

/// The numbers of a column of one row group, at most `most`; those present have the definition level `full`.
fn numbers<T: DataType>(
    mut reader: ColumnReaderImpl<T>,
    full: i16,
    most: usize,
    mut number: impl FnMut(T::T) -> f64,
) -> Result<Vec<f64>, ParquetError> {
    const BLOCK: usize = 1 << 16;
    let mut all = Vec::new();
    while all.len() < most {
        let (mut levels, mut present) = (Vec::new(), Vec::new());
        let (read, _, _) =
            reader.read_records(BLOCK.min(most - all.len()), Some(&mut levels), None, &mut present)?;
        if read == 0 {
            break;
        }
        let mut present = present.into_iter();
        if full == 0 {
            all.extend(present.map(&mut number));
        } else {
            all.extend(levels.iter().map(|&level| match level == full {
                true => present.next().map_or(f64::NAN, &mut number),
                false => f64::NAN,
            }));
        }
    }
    Ok(all)
}
