//! Reading Parquet files (feature `parquet`).
//!
//! A column is a channel, under the name `name` or `name [unit]`; the time is the column `t`, `time`, `tout` or
//! `timestamp`, in s (or `t [ms]`, `t [us]`) or a timestamp, which counts from the first row. Read are real numbers and
//! truth values (0 and 1); a missing value (null) or NaN is a missing sample. Lists that are of one length in all rows, as
//! data sets of robot learning have them (`observation.state`), are the channels `observation.state[0]`,
//! `observation.state[1]`, …. What else there is (texts, lists of different lengths, decimals) is left out, and reported in
//! the warnings of the recording. Compression: Snappy, Zstandard, LZ4, gzip.

use crate::error::{Place, RecordingError};
use crate::file::{ROOM, guarded};
use crate::finding::{Finding, Severity, listed};
use crate::header::{TIMES, header_cell, seconds};
use crate::recording::{Channel, Recording};
use ::parquet::basic::{LogicalType, Repetition, TimeUnit, Type};
use ::parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use ::parquet::data_type::DataType;
use ::parquet::errors::ParquetError;
use ::parquet::file::reader::{FileReader, SerializedFileReader};
use ::parquet::schema::types::{ColumnDescriptor, SchemaDescriptor};
use bytes::Bytes;
use std::collections::HashMap;

/// Reads a recording called `name` from the bytes of a Parquet file.
///
/// # Errors
/// [`RecordingError::Damaged`] or [`RecordingError::TooLarge`] where the bytes cannot be read; [`RecordingError::NoTime`] or
/// [`RecordingError::NoSignals`] where they make no recording, [`RecordingError::SeveralEpisodes`] where they make several;
/// else as [`Recording::from_columns`].
///
/// ```
/// let error = greybox_recording::parse_parquet(b"t,u\n0,1\n".to_vec(), "run1.parquet").unwrap_err();
/// assert!(error.to_string().starts_with("run1.parquet: the file is damaged"));
/// ```
pub fn parse_parquet(bytes: Vec<u8>, name: &str) -> Result<Recording, RecordingError> {
    parse(bytes, name, name)
}

/// Name of the column that numbers the episodes of data sets of robot learning.
const EPISODE: &str = "episode_index";

/// A channel, or the time.
struct Column {
    channel: Channel,
    /// Seconds per unit, where it may be a time.
    scale: Option<f64>,
    /// Whether its digits end after seven.
    single: bool,
}

/// How the numbers of a column are meant.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meaning {
    Number,
    Unsigned,
    /// Seconds per unit, from any instant.
    Timestamp(f64),
}

/// How the values of a column lie in its rows.
#[derive(Debug, Clone, Copy)]
struct Shape {
    /// Whether a row holds a list of values, not one.
    is_list: bool,
    /// Definition level of a value that is there.
    full: i16,
    /// Least definition level of an element of a list, be it there or null; below, the list is null or empty.
    element: i16,
}

impl Shape {
    /// That of a column; `None` where its rows hold lists of lists or of structures.
    fn of(schema: &SchemaDescriptor, column: usize) -> Option<Shape> {
        let described = schema.column(column);
        let full = described.max_def_level();
        match described.max_rep_level() {
            0 => Some(Shape { is_list: false, full, element: 0 }),
            1 if described.path().parts().len() <= 3 => {
                let root = schema.get_column_root_idx(column);
                let siblings = (0..schema.num_columns()).filter(|&c| schema.get_column_root_idx(c) == root);
                let is_optional = described.self_type().get_basic_info().repetition() == Repetition::OPTIONAL;
                let element = full - i16::from(is_optional);
                (siblings.count() == 1).then_some(Shape { is_list: true, full, element })
            }
            _ => None,
        }
    }
}

/// What the rows of a column hold.
#[derive(Debug, Default)]
struct Cells {
    rows: usize,
    /// The numbers of all rows, NaN = missing.
    values: Vec<f64>,
    /// For lists, how many there are in each row.
    lengths: Vec<usize>,
}

impl Cells {
    /// Lists of one length, one column per element; a list that is missing is missing in all. `None` where lengths differ.
    fn by_element(&self) -> Option<Vec<Vec<f64>>> {
        let width = *self.lengths.iter().find(|&&length| length > 0)?;
        if self.lengths.iter().any(|&length| length != width && length != 0) {
            return None;
        }
        let mut columns = vec![Vec::with_capacity(self.lengths.len()); width];
        let mut lists = self.values.chunks_exact(width);
        for &length in &self.lengths {
            let list = if length == 0 { None } else { lists.next() };
            for (k, column) in columns.iter_mut().enumerate() {
                column.push(list.map_or(f64::NAN, |list| list[k]));
            }
        }
        Some(columns)
    }
}

/// How many values the file states that a column has, those that are missing included.
fn stated(file: &SerializedFileReader<Bytes>, column: usize) -> u64 {
    let groups = file.metadata().row_groups().iter();
    let values = groups.filter_map(|group| Some(group.columns().get(column)?.num_values()));
    values.map(|n| u64::try_from(n).unwrap_or(u64::MAX)).fold(0, u64::saturating_add)
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
    let too_large = |variable| RecordingError::TooLarge { place: place(), variable, limit_gib: ROOM >> 30 };
    let mut needed = rows.saturating_mul(8 * schema.num_columns() as u64);
    if needed > ROOM {
        return Err(too_large(None));
    }
    let (mut columns, mut left_out) = (Vec::new(), Vec::new());
    for (c, column) in schema.columns().iter().enumerate() {
        let path = column.path().string();
        let (Some(meaning), Some(shape)) = (meaning(column), Shape::of(schema, c)) else {
            left_out.push(format!("`{path}`"));
            continue;
        };
        let path = if shape.is_list { column.path().parts()[0].clone() } else { path };
        let (name, unit) = header_cell(&path, || place().column(c, &path))?;
        if shape.is_list {
            needed = needed.saturating_add(stated(&file, c).saturating_mul(8));
            if needed > ROOM {
                return Err(too_large(Some(path)));
            }
        }
        let scale = match meaning {
            Meaning::Timestamp(scale) => Some(scale),
            _ => seconds(unit.as_deref()),
        };
        let cells = cells(&file, c, shape, meaning, rows, length).map_err(|e| damaged(Some(&path), &e))?;
        let single = column.physical_type() == Type::FLOAT;
        if !shape.is_list {
            columns.push(Column { channel: Channel { name, unit, values: cells.values }, scale, single });
        } else if let Some(lists) = cells.by_element() {
            columns.extend(lists.into_iter().enumerate().map(|(k, values)| Column {
                channel: Channel { name: format!("{name}[{k}]"), unit: unit.clone(), values },
                scale: None,
                single,
            }));
        } else {
            left_out.push(format!("`{path}` (lists of different lengths)"));
        }
    }
    let left_out = listed(left_out);
    let time =
        TIMES.iter().find_map(|t| columns.iter().position(|c| c.channel.name == *t && c.scale.is_some()));
    let Some(time) = time else {
        let mut found: Vec<String> = columns.iter().map(|c| format!("`{}`", c.channel.header())).collect();
        found.extend((!left_out.is_empty()).then_some(left_out));
        let help = "call the column of times, in s, `t`";
        return Err(RecordingError::NoTime { place: place(), found: listed(found), help });
    };
    let Column { channel: time, scale, single } = columns.remove(time);
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
    let times: Vec<f64> = time.values.iter().map(|t| scale * t).collect();
    let channels: Vec<Channel> = columns.into_iter().map(|column| column.channel).collect();
    let mut places = HashMap::new();
    for (c, channel) in channels.iter().enumerate() {
        if let Some(first) = places.insert(&channel.name, c) {
            let place = place().column(c + 1, &channel.name);
            return Err(RecordingError::DuplicateName {
                place,
                name: channel.name.clone(),
                first: first + 2,
            });
        }
    }
    check_episodes(label, &times, &channels)?;
    let longest = times.iter().fold(0.0f64, |most, t| most.max(t.abs()));
    let resolution = if single { longest * f64::from(f32::EPSILON) } else { 0.0 };
    let mut recording = Recording::checked(label, name, times, channels, resolution)?;
    if !left_out.is_empty() {
        let message = format!("Left out of the file, holding no plain numbers: {left_out}.");
        recording.warnings.insert(0, Finding::new(Severity::Info, "left_out", message));
    }
    Ok(recording)
}

/// Sees that the file holds one episode where its times restart.
fn check_episodes(label: &str, times: &[f64], channels: &[Channel]) -> Result<(), RecordingError> {
    let Some(column) = channels.iter().find(|c| c.name == EPISODE) else { return Ok(()) };
    let changes = column.values.windows(2).filter(|w| w[0] != w[1]).count();
    if changes == 0 || times.windows(2).all(|w| w[1] > w[0]) {
        return Ok(());
    }
    Err(RecordingError::SeveralEpisodes {
        place: Place::file(label),
        column: EPISODE.to_owned(),
        episodes: changes + 1,
    })
}

/// What a column's numbers mean; `None` where it holds none that are read.
fn meaning(column: &ColumnDescriptor) -> Option<Meaning> {
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

/// The cells of a column; timestamps count from the first one.
fn cells(
    file: &SerializedFileReader<Bytes>,
    column: usize,
    shape: Shape,
    meaning: Meaning,
    rows: u64,
    length: u64,
) -> Result<Cells, ParquetError> {
    let mut cells = Cells::default();
    let mut first = None;
    let most = stated(file, column);
    for group in 0..file.num_row_groups() {
        check_place(file, group, column, length)?;
        if shape.is_list {
            check_pages(file, group, column)?;
        }
        let left = Left {
            rows: (rows as usize).saturating_sub(cells.rows),
            values: (most as usize).saturating_sub(cells.values.len()),
        };
        let cells = &mut cells;
        match file.get_row_group(group)?.get_column_reader(column)? {
            ColumnReader::BoolColumnReader(r) => append(cells, r, shape, left, |v| f64::from(u8::from(v)))?,
            ColumnReader::Int32ColumnReader(r) if meaning == Meaning::Unsigned => {
                append(cells, r, shape, left, |v| f64::from(v.cast_unsigned()))?;
            }
            ColumnReader::Int32ColumnReader(r) => append(cells, r, shape, left, f64::from)?,
            ColumnReader::Int64ColumnReader(r) => match meaning {
                Meaning::Unsigned => append(cells, r, shape, left, |v| v.cast_unsigned() as f64)?,
                // As a number since 1970 a double has no room for fractions of a microsecond.
                Meaning::Timestamp(_) => {
                    append(cells, r, shape, left, |v| v.wrapping_sub(*first.get_or_insert(v)) as f64)?;
                }
                Meaning::Number => append(cells, r, shape, left, |v| v as f64)?,
            },
            ColumnReader::FloatColumnReader(r) => append(cells, r, shape, left, f64::from)?,
            ColumnReader::DoubleColumnReader(r) => append(cells, r, shape, left, |v| v)?,
            _ => return Err(ParquetError::General("the column changes its type".to_owned())),
        }
    }
    Ok(cells)
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

/// Sees that the pages of a column of lists have no more values than the row group states: a row is read whole, however
/// long it claims to be.
fn check_pages(file: &SerializedFileReader<Bytes>, group: usize, column: usize) -> Result<(), ParquetError> {
    let group = file.get_row_group(group)?;
    let stated = usize::try_from(group.metadata().column(column).num_values()).unwrap_or(0);
    let mut pages = group.get_column_page_reader(column)?;
    let mut levels = 0usize;
    while let Some(page) = pages.peek_next_page()? {
        levels = levels.saturating_add(page.num_levels.unwrap_or(0));
        pages.skip_next_page()?;
    }
    match levels <= stated {
        true => Ok(()),
        false => Err(ParquetError::General("its pages have more values than it states".to_owned())),
    }
}

/// How much of a column is still to be read.
#[derive(Debug, Clone, Copy)]
struct Left {
    rows: usize,
    values: usize,
}

/// Appends what a row group has of a column.
fn append<T: DataType>(
    cells: &mut Cells,
    mut reader: ColumnReaderImpl<T>,
    shape: Shape,
    left: Left,
    mut number: impl FnMut(T::T) -> f64,
) -> Result<(), ParquetError> {
    const BLOCK: usize = 1 << 16;
    let (end, most) = (cells.rows + left.rows, cells.values.len() + left.values);
    while cells.rows < end {
        let (mut levels, mut repeats, mut present) = (Vec::new(), Vec::new(), Vec::new());
        let block = if shape.is_list { BLOCK.min(1 << 10) } else { BLOCK };
        let block = block.min(end - cells.rows);
        let (read, ..) = reader.read_records(block, Some(&mut levels), Some(&mut repeats), &mut present)?;
        if read == 0 {
            break;
        }
        cells.rows += read;
        let mut present = present.into_iter();
        if shape.full == 0 {
            cells.values.extend(present.map(&mut number));
            continue;
        }
        for (k, &level) in levels.iter().enumerate() {
            if shape.is_list && repeats.get(k) == Some(&0) {
                cells.lengths.push(0);
            }
            if shape.is_list && level < shape.element {
                continue;
            }
            if let Some(length) = cells.lengths.last_mut() {
                *length += 1;
            }
            cells.values.push(match level == shape.full {
                true => present.next().map_or(f64::NAN, &mut number),
                false => f64::NAN,
            });
        }
        if cells.values.len() > most {
            return Err(ParquetError::General("it has more values than it states".to_owned()));
        }
    }
    Ok(())
}
