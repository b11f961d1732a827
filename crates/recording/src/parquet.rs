//! Reading Parquet files (feature `parquet`).
//!
//! A column is a channel, under the name `name` or `name [unit]`; the time is the column `t`, `time`, `tout` or
//! `timestamp`, in s (or `t [ms]`, `t [us]`) or a timestamp, which counts from the first row. Read are real numbers and
//! truth values (0 and 1); a missing value (null) or NaN is a missing sample. Lists that are of one length in all rows, as
//! data sets of robot learning have them (`observation.state`), are the channels `observation.state[0]`,
//! `observation.state[1]`, …. What else there is (texts, lists of different lengths, decimals) is left out, and reported in
//! the warnings of the recording. Compression: Snappy, Zstandard, LZ4, gzip.
//!
//! A file whose times restart with the value of its column `episode_index` holds several recordings. The name `data.parquet#3`
//! names the one of the rows where it is 3, wherever they stand: their order among themselves is that of the file, and errors
//! count them alone.

mod episodes;

use crate::error::{Place, RecordingError};
use crate::file::{ROOM, guarded};
use crate::finding::{Finding, Severity, listed};
use crate::header::{TIMES, header_cell, seconds};
use crate::location::split;
use crate::recording::{Channel, Recording};
use ::parquet::basic::{LogicalType, Repetition, TimeUnit, Type};
use ::parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use ::parquet::data_type::DataType;
use ::parquet::errors::ParquetError;
use ::parquet::file::reader::{ChunkReader, FileReader, SerializedFileReader};
use ::parquet::schema::types::{ColumnDescriptor, SchemaDescriptor};
use bytes::Bytes;
pub(crate) use episodes::episodes;
use std::collections::HashMap;
use std::ops::Range;

/// Reads a recording called `name` from the bytes of a Parquet file; where the name ends in `.parquet#3`, episode 3.
///
/// # Errors
/// [`RecordingError::Damaged`] or [`RecordingError::TooLarge`] where the bytes cannot be read; [`RecordingError::NoTime`] or
/// [`RecordingError::NoSignals`] where they make no recording, [`RecordingError::SeveralEpisodes`] where they make several;
/// [`RecordingError::NoSuchEpisode`], [`RecordingError::NoEpisodes`] or [`RecordingError::EpisodeNumber`] where the episode
/// named is none; else as [`Recording::from_columns`].
///
/// ```
/// let error = greybox_recording::parse_parquet(b"t,u\n0,1\n".to_vec(), "run1.parquet").unwrap_err();
/// assert!(error.to_string().starts_with("run1.parquet: the file is damaged"));
/// ```
pub fn parse_parquet(bytes: Vec<u8>, name: &str) -> Result<Recording, RecordingError> {
    parse(bytes, name, name, split(name).map(|(_, episode)| episode))
}

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

impl Meaning {
    /// Seconds per unit of a column with this unit, where it may be a time.
    fn scale(self, unit: Option<&str>) -> Option<f64> {
        match self {
            Meaning::Timestamp(scale) => Some(scale),
            Meaning::Number | Meaning::Unsigned => seconds(unit),
        }
    }
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
    /// The numbers of all rows that are read, NaN = missing.
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

/// A file that is being read.
struct Table<R: ChunkReader> {
    file: SerializedFileReader<R>,
    /// Bytes of the file.
    length: u64,
    /// What errors call it.
    label: String,
}

impl<R: ChunkReader + 'static> Table<R> {
    fn open(source: R, label: &str) -> Result<Table<R>, RecordingError> {
        let length = source.len();
        let label = label.to_owned();
        match SerializedFileReader::new(source) {
            Ok(file) => Ok(Table { file, length, label }),
            Err(error) => Err(RecordingError::Damaged {
                place: Place::file(&label),
                variable: None,
                found: error.to_string(),
            }),
        }
    }

    fn place(&self) -> Place {
        Place::file(&self.label)
    }

    fn too_large(&self, variable: Option<String>) -> RecordingError {
        RecordingError::TooLarge { place: self.place(), variable, limit_gib: ROOM >> 30 }
    }

    fn schema(&self) -> &SchemaDescriptor {
        self.file.metadata().file_metadata().schema_descr()
    }

    /// How many rows the file states.
    fn rows(&self) -> u64 {
        u64::try_from(self.file.metadata().file_metadata().num_rows()).unwrap_or(u64::MAX)
    }

    /// How many values the file states that a column has, those that are missing included.
    fn stated(&self, column: usize) -> u64 {
        let groups = self.file.metadata().row_groups().iter();
        let values = groups.filter_map(|group| Some(group.columns().get(column)?.num_values()));
        values.map(|n| u64::try_from(n).unwrap_or(u64::MAX)).fold(0, u64::saturating_add)
    }

    /// The cells of a column in these rows.
    fn cells(
        &self,
        column: usize,
        shape: Shape,
        meaning: Meaning,
        rows: &Rows,
    ) -> Result<Cells, RecordingError> {
        self.unchecked_cells(column, shape, meaning, rows).map_err(|error| RecordingError::Damaged {
            place: self.place(),
            variable: Some(self.schema().column(column).path().string()),
            found: error.to_string(),
        })
    }
}

/// Rows of a file, in increasing order.
struct Rows {
    runs: Vec<Range<usize>>,
}

impl Rows {
    fn all(rows: u64) -> Rows {
        let all = 0..usize::try_from(rows).unwrap_or(usize::MAX);
        Rows { runs: std::iter::once(all).collect() }
    }

    fn count(&self) -> u64 {
        self.runs.iter().map(|run| run.len() as u64).fold(0, u64::saturating_add)
    }

    /// Those of a range of rows, counted from its first one.
    fn within(&self, range: Range<usize>) -> impl Iterator<Item = Range<usize>> {
        let first = self.runs.partition_point(|run| run.end <= range.start);
        let runs = self.runs.iter().skip(first).take_while(move |run| run.start < range.end);
        runs.map(move |run| run.start.max(range.start) - range.start..run.end.min(range.end) - range.start)
    }
}

pub(crate) fn parse(
    bytes: Vec<u8>,
    label: &str,
    name: &str,
    episode: Option<&str>,
) -> Result<Recording, RecordingError> {
    guarded(label, || {
        let table = Table::open(Bytes::from(bytes), label)?;
        let rows = match episode {
            Some(episode) => episodes::rows(&table, episode)?,
            None => episodes::only(&table, name)?,
        };
        read(&table, name, &rows)
    })
}

fn read(table: &Table<Bytes>, name: &str, rows: &Rows) -> Result<Recording, RecordingError> {
    let label = &table.label;
    let (columns, left_out) = columns(table, rows)?;
    let left_out = listed(left_out);
    let (time, columns) = time_apart(label, columns, &left_out)?;
    let Column { channel: time, scale, single } = time;
    if columns.is_empty() {
        return Err(RecordingError::NoSignals {
            place: table.place(),
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
            let place = table.place().column(c + 1, &channel.name);
            return Err(RecordingError::DuplicateName {
                place,
                name: channel.name.clone(),
                first: first + 2,
            });
        }
    }
    let longest = times.iter().fold(0.0f64, |most, t| most.max(t.abs()));
    let resolution = if single { longest * f64::from(f32::EPSILON) } else { 0.0 };
    let mut recording = Recording::checked(label, name, times, channels, resolution)?;
    if !left_out.is_empty() {
        let message = format!("Left out of the file, holding no plain numbers: {left_out}.");
        recording.warnings.insert(0, Finding::new(Severity::Info, "left_out", message));
    }
    Ok(recording)
}

/// The columns of numbers, and the names of the others.
fn columns(table: &Table<Bytes>, rows: &Rows) -> Result<(Vec<Column>, Vec<String>), RecordingError> {
    let schema = table.schema();
    let mut needed = rows.count().saturating_mul(8 * schema.num_columns() as u64);
    if needed > ROOM {
        return Err(table.too_large(None));
    }
    let (mut columns, mut left_out) = (Vec::new(), Vec::new());
    for (c, column) in schema.columns().iter().enumerate() {
        let path = column.path().string();
        let (Some(meaning), Some(shape)) = (meaning(column), Shape::of(schema, c)) else {
            left_out.push(format!("`{path}`"));
            continue;
        };
        let path = if shape.is_list { column.path().parts()[0].clone() } else { path };
        let (name, unit) = header_cell(&path, || table.place().column(c, &path))?;
        if shape.is_list {
            needed = needed.saturating_add(expected(table, c, rows).saturating_mul(8));
            if needed > ROOM {
                return Err(table.too_large(Some(path)));
            }
        }
        let scale = meaning.scale(unit.as_deref());
        let cells = table.cells(c, shape, meaning, rows)?;
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
    Ok((columns, left_out))
}

/// How many values a column of lists has in these rows, were they of one length.
fn expected(table: &Table<Bytes>, column: usize, rows: &Rows) -> u64 {
    let share = u128::from(table.stated(column)) * u128::from(rows.count());
    u64::try_from(share.div_ceil(u128::from(table.rows().max(1)))).unwrap_or(u64::MAX)
}

/// The column of times, and the others.
fn time_apart(
    label: &str,
    mut columns: Vec<Column>,
    left_out: &str,
) -> Result<(Column, Vec<Column>), RecordingError> {
    let time =
        TIMES.iter().find_map(|t| columns.iter().position(|c| c.channel.name == *t && c.scale.is_some()));
    let Some(time) = time else {
        let mut found: Vec<String> = columns.iter().map(|c| format!("`{}`", c.channel.header())).collect();
        found.extend((!left_out.is_empty()).then_some(left_out.to_owned()));
        let help = "call the column of times, in s, `t`";
        return Err(RecordingError::NoTime { place: Place::file(label), found: listed(found), help });
    };
    let time = columns.remove(time);
    Ok((time, columns))
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

impl<R: ChunkReader + 'static> Table<R> {
    /// The cells of a column in these rows; timestamps count from the first one.
    fn unchecked_cells(
        &self,
        column: usize,
        shape: Shape,
        meaning: Meaning,
        rows: &Rows,
    ) -> Result<Cells, ParquetError> {
        let file = &self.file;
        let mut cells = Cells::default();
        let mut first = None;
        let mut begin = 0usize;
        let most = usize::try_from(self.stated(column).min(ROOM / 8)).unwrap_or(usize::MAX);
        for (group, metadata) in file.metadata().row_groups().iter().enumerate() {
            check_place(file, group, column, self.length)?;
            if shape.is_list {
                check_pages(file, group, column)?;
            }
            let end = begin.saturating_add(usize::try_from(metadata.num_rows()).unwrap_or(0));
            let wanted = Wanted { runs: rows.within(begin..end).collect(), most };
            begin = end;
            if wanted.runs.is_empty() {
                continue;
            }
            let cells = &mut cells;
            match file.get_row_group(group)?.get_column_reader(column)? {
                ColumnReader::BoolColumnReader(r) => {
                    append(cells, r, shape, &wanted, |v| f64::from(u8::from(v)))?;
                }
                ColumnReader::Int32ColumnReader(r) if meaning == Meaning::Unsigned => {
                    append(cells, r, shape, &wanted, |v| f64::from(v.cast_unsigned()))?;
                }
                ColumnReader::Int32ColumnReader(r) => append(cells, r, shape, &wanted, f64::from)?,
                ColumnReader::Int64ColumnReader(r) => match meaning {
                    Meaning::Unsigned => append(cells, r, shape, &wanted, |v| v.cast_unsigned() as f64)?,
                    // As a number since 1970 a double has no room for fractions of a microsecond.
                    Meaning::Timestamp(_) => {
                        append(cells, r, shape, &wanted, |v| v.wrapping_sub(*first.get_or_insert(v)) as f64)?;
                    }
                    Meaning::Number => append(cells, r, shape, &wanted, |v| v as f64)?,
                },
                ColumnReader::FloatColumnReader(r) => append(cells, r, shape, &wanted, f64::from)?,
                ColumnReader::DoubleColumnReader(r) => append(cells, r, shape, &wanted, |v| v)?,
                _ => return Err(ParquetError::General("the column changes its type".to_owned())),
            }
        }
        Ok(cells)
    }
}

/// Sees that a column of a row group lies within the `length` bytes of the file: the library takes that for granted.
fn check_place<R: ChunkReader + 'static>(
    file: &SerializedFileReader<R>,
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
fn check_pages<R: ChunkReader + 'static>(
    file: &SerializedFileReader<R>,
    group: usize,
    column: usize,
) -> Result<(), ParquetError> {
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

/// What is read of a row group.
struct Wanted {
    /// Its rows, in increasing order.
    runs: Vec<Range<usize>>,
    /// Most values that the column may have in the whole file.
    most: usize,
}

/// Appends what a row group has of a column in the rows that are wanted.
fn append<T: DataType>(
    cells: &mut Cells,
    mut reader: ColumnReaderImpl<T>,
    shape: Shape,
    wanted: &Wanted,
    mut number: impl FnMut(T::T) -> f64,
) -> Result<(), ParquetError> {
    let mut at = 0;
    for run in &wanted.runs {
        at += reader.skip_records(run.start.saturating_sub(at))?;
        // (Where rows are missing, the column is shorter than the time.)
        while at < run.end {
            let read = append_block(cells, &mut reader, shape, run.end - at, &mut number)?;
            if read == 0 {
                break;
            }
            at += read;
            if cells.values.len() > wanted.most {
                return Err(ParquetError::General("it has more values than it states".to_owned()));
            }
        }
    }
    Ok(())
}

/// Appends at most so many rows of a column; how many it were.
fn append_block<T: DataType>(
    cells: &mut Cells,
    reader: &mut ColumnReaderImpl<T>,
    shape: Shape,
    rows: usize,
    mut number: impl FnMut(T::T) -> f64,
) -> Result<usize, ParquetError> {
    const BLOCK: usize = 1 << 16;
    let (mut levels, mut repeats, mut present) = (Vec::new(), Vec::new(), Vec::new());
    let block = if shape.is_list { BLOCK.min(1 << 10) } else { BLOCK };
    let (read, ..) =
        reader.read_records(block.min(rows), Some(&mut levels), Some(&mut repeats), &mut present)?;
    let mut present = present.into_iter();
    if shape.full == 0 {
        cells.values.extend(present.map(&mut number));
        return Ok(read);
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
    Ok(read)
}
