//! Reading and writing CSV files.
//!
//! UTF-8, comma separated, one header row; the first column is the time `t` in seconds (`t [ms]`, `t [us]`
//! and `t [ns]` are converted), or dates, which count from the whole second of the first one. A header cell is `name` or `name [unit]`. An empty cell is a missing sample. A byte order
//! mark, quoted cells, CRLF line ends and empty lines at the end are tolerated; everything else is an error
//! that names the cell.

use crate::error::{Place, RecordingError};
use crate::file::{self, check_file, unread};
use crate::header::{exponent, header_cell};
use crate::recording::{Channel, Recording};
use crate::stamp::{Stamp, Zone, scale};
use ::csv::{ByteRecord, ReaderBuilder, WriterBuilder};
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;

mod lines;

pub use lines::CsvLines;

/// Reads the recording in the file at `path`.
///
/// # Errors
/// Any [`RecordingError`]; its place names the file as given, the line and the column.
pub fn read_csv(path: impl AsRef<Path>) -> Result<Recording, RecordingError> {
    let (bytes, label, name) = file::bytes(path.as_ref())?;
    parse(&bytes, &label, &name, 0)
}

/// A CSV file read block by block, for recordings larger than memory: an iterator of recordings of about `rows` rows,
/// each with the file's header. What is left at the end and shorter than half a block goes to the last one.
///
/// The file is what [`read_csv`] reads, but for line breaks within quoted cells. A gap between two blocks does not
/// matter, since each is a recording of its own.
///
/// ```
/// use greybox_recording::{CsvBlocks, write_csv_file};
/// let path = std::env::temp_dir().join(format!("blocks_{}.csv", std::process::id()));
/// let time: Vec<f64> = (0..250).map(|k| 0.01 * f64::from(k)).collect();
/// write_csv_file(&path, &time, &[("x [m]", &time)])?;
/// let lengths: Vec<usize> = CsvBlocks::open(&path, 100)?
///     .map(|block| Ok(block?.time.len()))
///     .collect::<Result<_, greybox_recording::RecordingError>>()?;
/// assert_eq!(lengths, [100, 100, 50]);
/// # std::fs::remove_file(path).ok();
/// # Ok::<(), greybox_recording::RecordingError>(())
/// ```
#[derive(Debug)]
pub struct CsvBlocks {
    reader: BufReader<fs::File>,
    label: String,
    name: String,
    rows: usize,
    /// The file up to the end of its header, and its lines.
    header: Vec<u8>,
    header_lines: u64,
    /// Rows of the next block, their number and the lines of the file before them.
    next: Vec<u8>,
    next_rows: usize,
    before: u64,
    times: Times,
    /// Last time of the block before, s.
    last: Option<f64>,
    over: bool,
}

impl CsvBlocks {
    /// Opens the file at `path`; blocks have at least 8 rows.
    ///
    /// # Errors
    /// [`RecordingError`] where the file cannot be read or is empty. Faults of header and rows come with their block.
    pub fn open(path: impl AsRef<Path>, rows: usize) -> Result<Self, RecordingError> {
        let path = path.as_ref();
        let (label, name) = check_file(path)?;
        let file = fs::File::open(path).map_err(|source| unread(&label, source))?;
        let mut blocks = Self {
            reader: BufReader::with_capacity(1 << 20, file),
            label,
            name,
            rows: rows.max(crate::recording::MIN_SAMPLES),
            header: Vec::new(),
            header_lines: 0,
            next: Vec::new(),
            next_rows: 0,
            before: 0,
            times: Times::default(),
            last: None,
            over: false,
        };
        let mut line = Vec::new();
        while blocks.line(&mut line)? {
            blocks.header_lines += 1;
            blocks.header.append(&mut line);
            if !blocks.header.trim_ascii().is_empty() {
                break;
            }
        }
        if blocks.header.trim_ascii().is_empty() {
            return Err(RecordingError::Empty { place: Place::file(&blocks.label) });
        }
        blocks.before = blocks.header_lines;
        (blocks.next, blocks.next_rows) = blocks.read_rows()?;
        Ok(blocks)
    }

    fn line(&mut self, into: &mut Vec<u8>) -> Result<bool, RecordingError> {
        let read = self.reader.read_until(b'\n', into).map_err(|source| unread(&self.label, source))?;
        Ok(read > 0)
    }

    fn read_rows(&mut self) -> Result<(Vec<u8>, usize), RecordingError> {
        let (mut text, mut rows) = (Vec::with_capacity(self.next.capacity()), 0);
        while rows < self.rows && self.line(&mut text)? {
            rows += 1;
        }
        Ok((text, rows))
    }

    fn block(&mut self) -> Result<Recording, RecordingError> {
        let mut text = self.header.clone();
        let mut rows = self.next_rows;
        text.append(&mut self.next);
        (self.next, self.next_rows) = self.read_rows()?;
        if self.next_rows < self.rows.div_ceil(2) {
            rows += self.next_rows;
            text.append(&mut self.next);
            self.next_rows = 0;
        }
        let above = self.before - self.header_lines;
        let recording = parse_on(&text, &self.label, &self.name, above, &mut self.times)?;
        if let (Some(previous), Some(&found)) = (self.last, recording.time.first())
            && found <= previous
        {
            return Err(RecordingError::TimeNotIncreasing {
                place: Place::line(&self.label, self.before + 1).column(0, "t"),
                found,
                previous,
                help: "one file holds one continuous experiment: split the file here, or sort the rows",
            });
        }
        self.last = recording.time.last().copied();
        self.before += rows as u64;
        Ok(recording)
    }
}

impl Iterator for CsvBlocks {
    type Item = Result<Recording, RecordingError>;

    /// The next block; after an error there is none.
    fn next(&mut self) -> Option<Self::Item> {
        if self.over {
            return None;
        }
        let block = self.block();
        self.over = block.is_err() || self.next_rows == 0;
        Some(block)
    }
}

/// Reads a recording called `name` from anything that yields the bytes of a CSV file.
///
/// # Errors
/// Any [`RecordingError`]; its place names `name`, the line and the column.
pub fn parse_csv(mut reader: impl Read, name: &str) -> Result<Recording, RecordingError> {
    let mut bytes = Vec::new();
    reader.read_to_end(&mut bytes).map_err(|source| RecordingError::Io {
        place: Place::file(name),
        action: "read",
        source,
    })?;
    parse(&bytes, name, name, 0)
}

/// Writes a time and columns of the same length as CSV: header `t` and the given headers (`name` or
/// `name [unit]`), numbers with as many digits as their exact value needs, missing samples (NaN) as empty
/// cells.
///
/// # Errors
/// A column length that differs from the time's, an infinite value, or the writer's own failure.
///
/// ```
/// let mut file = Vec::new();
/// greybox_recording::write_csv(&mut file, &[0.0, 0.5], &[("y [m]", &[1.25, f64::NAN])])?;
/// assert_eq!(file, b"t,y [m]\n0,1.25\n0.5,\n");
/// # Ok::<(), greybox_recording::RecordingError>(())
/// ```
pub fn write_csv(writer: impl Write, time: &[f64], columns: &[(&str, &[f64])]) -> Result<(), RecordingError> {
    write(writer, "CSV output", time, columns)
}

/// Writes the file at `path` as [`write_csv`] does; the file appears whole or not at all (it is written beside
/// its place under a temporary name, then renamed).
///
/// # Errors
/// As [`write_csv`], with the file named.
pub fn write_csv_file(
    path: impl AsRef<Path>,
    time: &[f64],
    columns: &[(&str, &[f64])],
) -> Result<(), RecordingError> {
    let path = path.as_ref();
    let label = path.display().to_string();
    let failed = |source| RecordingError::Io { place: Place::file(&label), action: "written", source };
    let mut bytes = Vec::new();
    write(&mut bytes, &label, time, columns)?;
    file::write_whole(path, &bytes).map_err(failed)
}

fn write(
    writer: impl Write,
    label: &str,
    time: &[f64],
    columns: &[(&str, &[f64])],
) -> Result<(), RecordingError> {
    for (c, (header, values)) in columns.iter().enumerate() {
        if values.len() != time.len() {
            return Err(RecordingError::ColumnLength {
                place: Place::file(label).column(c + 1, header),
                found: values.len(),
                expected: time.len(),
            });
        }
    }
    let failed = |source: ::csv::Error| RecordingError::Io {
        place: Place::file(label),
        action: "written",
        source: source.into(),
    };
    let mut out = WriterBuilder::new().from_writer(writer);
    out.write_record(std::iter::once("t").chain(columns.iter().map(|(header, _)| *header)))
        .map_err(failed)?;
    let mut row = vec![String::new(); columns.len() + 1];
    for (k, &t) in time.iter().enumerate() {
        let values = std::iter::once(t).chain(columns.iter().map(|(_, values)| values[k]));
        for (c, value) in values.enumerate() {
            if value.is_infinite() || (c == 0 && value.is_nan()) {
                let name = if c == 0 { "t" } else { columns[c - 1].0 };
                return Err(RecordingError::NotFinite {
                    place: Place::line(label, k as u64 + 2).column(c, name),
                    found: value.to_string(),
                });
            }
            row[c] = cell(value);
        }
        out.write_record(&row).map_err(failed)?;
    }
    out.flush().map_err(|source| failed(source.into()))
}

/// The shortest text that reads back as exactly `value`; empty for NaN.
fn cell(value: f64) -> String {
    let size = value.abs();
    if value.is_nan() {
        String::new()
    } else if size != 0.0 && !(1e-5..1e15).contains(&size) {
        format!("{value:e}")
    } else {
        format!("{value}")
    }
}

/// The bytes of a file and what to call it.
struct Source<'a> {
    text: &'a [u8],
    label: &'a str,
    /// Lines of the file that stand before the text, for rows; its header is another line.
    above: u64,
}

impl Source<'_> {
    /// Line of the record that the CSV reader started at byte `offset`: it may still have had to skip line
    /// ends.
    fn line(&self, offset: u64) -> u64 {
        let mut start = usize::try_from(offset).map_or(self.text.len(), |o| o.min(self.text.len()));
        while start < self.text.len() && matches!(self.text[start], b'\r' | b'\n') {
            start += 1;
        }
        let before = &self.text[..start];
        let ends = before
            .iter()
            .enumerate()
            .filter(|&(i, &b)| b == b'\n' || (b == b'\r' && before.get(i + 1) != Some(&b'\n')));
        self.above + 1 + ends.count() as u64
    }

    fn place(&self, record: &ByteRecord) -> Place {
        Place::line(self.label, self.line(record.position().map_or(0, ::csv::Position::byte)))
    }
}

/// Parses a header and rows; `above` lines of the file stand before them.
pub(crate) fn parse(bytes: &[u8], label: &str, name: &str, above: u64) -> Result<Recording, RecordingError> {
    parse_on(bytes, label, name, above, &mut Times::default())
}

/// The same where rows of the file may have been parsed before.
fn parse_on(
    bytes: &[u8],
    label: &str,
    name: &str,
    above: u64,
    times: &mut Times,
) -> Result<Recording, RecordingError> {
    let text = check_text(bytes, label, above)?;
    let source = Source { text, label, above };
    let mut reader = ReaderBuilder::new().has_headers(false).flexible(true).from_reader(text);
    let mut record = ByteRecord::new();
    let mut next = |record: &mut ByteRecord| {
        // Reading from memory, with flexible rows and bytes for cells, leaves nothing to fail but the reader.
        reader.read_byte_record(record).map_err(|error| RecordingError::Io {
            place: Place::file(label),
            action: "read",
            source: error.into(),
        })
    };

    let mut found = next(&mut record)?;
    while found && is_blank(&record) {
        found = next(&mut record)?;
    }
    if !found {
        return Err(RecordingError::Empty { place: Place::file(label) });
    }
    let header_place = source.place(&record);
    let header = header(&record, &header_place, text)?;
    let width = header.columns.len() + 1;

    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); width];
    let mut decimals = Some(0);
    let mut blank: Option<Place> = None;
    while next(&mut record)? {
        if is_blank(&record) {
            blank.get_or_insert_with(|| source.place(&record));
            continue;
        }
        if let Some(place) = blank {
            // Rows without a single value are harmless at the end of a file only.
            return Err(RecordingError::MissingTime { place: place.column(0, "t") });
        }
        if record.len() != width {
            return Err(cell_count(&record, width, source.place(&record)));
        }
        for (c, cell) in record.iter().enumerate() {
            let cell = cell.trim_ascii();
            let value = match c {
                0 => times.read(cell, header.time_exponent, || source.place(&record).column(0, "t"))?,
                _ => number(cell).ok_or_else(|| {
                    bad_cell(cell, c, source.place(&record).column(c, &header.columns[c - 1].0))
                })?,
            };
            columns[c].push(value);
        }
        if columns[0].last().is_none_or(|t| t.is_nan()) {
            return Err(RecordingError::MissingTime { place: source.place(&record).column(0, "t") });
        }
        decimals = match (decimals, printed_decimals(record[0].trim_ascii())) {
            (Some(most), Some(here)) => Some(most.max(here)),
            _ => None,
        };
        let time = &mut columns[0];
        let last = time.len() - 1;
        if last > 0 && time[last] <= time[last - 1] {
            return Err(RecordingError::TimeNotIncreasing {
                place: source.place(&record).column(0, "t"),
                found: time[last],
                previous: time[last - 1],
                help: if time[last] == time[last - 1] {
                    "remove the repeated row, or write the times with more digits"
                } else {
                    "one file holds one continuous experiment: split the file here, or sort the rows"
                },
            });
        }
    }

    let mut columns = columns.into_iter();
    let time = columns.next().unwrap_or_default();
    if time.is_empty() {
        return Err(RecordingError::TooFewRows {
            place: Place::file(label),
            rows: 0,
            needed: crate::recording::MIN_SAMPLES,
            help: "there is a header and nothing under it, export the samples too",
        });
    }
    let channels = header
        .columns
        .into_iter()
        .zip(columns)
        .map(|((name, unit), values)| Channel { name, unit, values })
        .collect();
    let resolution = decimals.map_or(0.0, |d| scale(header.time_exponent) * 10f64.powi(-d));
    Recording::assemble(label, name, time, channels, resolution)
}

/// How the times of a file are read: dates count from the whole second of the first one.
#[derive(Debug, Default)]
struct Times {
    first: Option<Stamp>,
}

impl Times {
    /// The time in a cell, in seconds; NaN for an empty one.
    fn read(&mut self, cell: &[u8], exponent: i32, place: impl Fn() -> Place) -> Result<f64, RecordingError> {
        let (value, stamp) = match (number(cell), std::str::from_utf8(cell).ok().and_then(Stamp::date)) {
            (Some(value), _) if value.is_nan() => return Ok(value),
            (Some(value), _) => (value * scale(exponent), Stamp::number(0.0)),
            (None, Some(date)) => (f64::NAN, date),
            (None, None) => return Err(bad_cell(cell, 0, place())),
        };
        let first = self.first.get_or_insert(stamp);
        if !first.zone.is_as(stamp.zone) {
            let found = String::from_utf8_lossy(cell).into_owned();
            return Err(RecordingError::TimesDiffer { place: place(), found });
        }
        Ok(if stamp.zone == Zone::Seconds { value } else { stamp.after(first.seconds) })
    }
}

/// Drops the byte order mark and makes sure that the rest is UTF-8 text.
fn check_text<'a>(bytes: &'a [u8], label: &str, above: u64) -> Result<&'a [u8], RecordingError> {
    let refuse =
        |line: u64, found: String| RecordingError::NotUtf8 { place: Place::line(label, above + line), found };
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(refuse(1, "it is UTF-16, as spreadsheets write under `Unicode text`".to_owned()));
    }
    let text = bytes.strip_prefix(&[0xef, 0xbb, 0xbf]).unwrap_or(bytes);
    match std::str::from_utf8(text) {
        Err(error) => {
            let at = error.valid_up_to();
            let line = 1 + text[..at].iter().filter(|&&b| b == b'\n').count() as u64;
            Err(refuse(line, format!("invalid UTF-8 byte 0x{:02x}", text[at])))
        }
        Ok(_) => match text.iter().position(|&b| b == 0) {
            Some(at) => {
                let line = 1 + text[..at].iter().filter(|&&b| b == b'\n').count() as u64;
                Err(refuse(line, "it holds zero bytes, like a binary file".to_owned()))
            }
            None => Ok(text),
        },
    }
}

fn is_blank(record: &ByteRecord) -> bool {
    record.iter().all(|cell| cell.trim_ascii().is_empty())
}

#[derive(Debug, Clone)]
struct Header {
    /// Power of ten of the unit of the time column: −3 for milliseconds.
    time_exponent: i32,
    /// Name and unit of every column after the time.
    columns: Vec<(String, Option<String>)>,
}

fn header(record: &ByteRecord, place: &Place, text: &[u8]) -> Result<Header, RecordingError> {
    let cells: Vec<String> =
        record.iter().map(|cell| String::from_utf8_lossy(cell).trim().to_owned()).collect();
    let first = cells.first().cloned().unwrap_or_default();
    let line = cells.join(",");
    for (separator, found) in [(';', "semicolons"), ('\t', "tabs"), ('|', "vertical bars")] {
        let Some((head, _)) = line.split_once(separator) else { continue };
        if cells.len() > 1 && !head.trim().trim_matches('"').starts_with('t') {
            continue;
        }
        if first.contains(separator) {
            let rows = text.splitn(2, |&b| b == b'\n').nth(1).unwrap_or(&[]);
            let help = if rows.iter().take(4096).any(|&b| b == b',') {
                "first replace the decimal commas by points, then the separators by commas (or export with an \
                 English number format)"
            } else {
                "replace the separators by commas, or export as `CSV (comma separated)`"
            };
            return Err(RecordingError::Separator { place: place.clone(), found, help });
        }
    }
    if first.parse::<f64>().is_ok() {
        return Err(RecordingError::NoHeader { place: place.clone(), found: first });
    }

    let parsed = cells
        .iter()
        .enumerate()
        .map(|(c, cell)| header_cell(cell, || place.clone().column(c, cell)))
        .collect::<Result<Vec<_>, _>>();
    let time_column =
        |help: String| RecordingError::TimeColumn { place: place.clone(), found: first.clone(), help };
    let time = header_cell(&first, || place.clone().column(0, &first));
    let time_exponent = match &time {
        Ok((name, unit)) if name == "t" => match exponent(unit.as_deref()) {
            Some(exponent) => exponent,
            None => {
                let unit = unit.as_deref().unwrap_or_default();
                return Err(time_column(format!("convert the times from {unit} to s")));
            }
        },
        Ok(_) | Err(_) => {
            let elsewhere = parsed.as_ref().ok().and_then(|p| p.iter().position(|(name, _)| name == "t"));
            return Err(time_column(match elsewhere {
                Some(c) => format!("move column {} (`t`) to the front", c + 1),
                None => "rename the time column to `t` and make it the first".to_owned(),
            }));
        }
    };
    let parsed = parsed?;
    if parsed.len() < 2 {
        return Err(RecordingError::NoChannels { place: place.clone() });
    }
    for (c, (name, _)) in parsed.iter().enumerate() {
        if let Some(first) = parsed[..c].iter().position(|(other, _)| other == name) {
            return Err(RecordingError::DuplicateName {
                place: place.clone().column(c, name),
                name: name.clone(),
                first: first + 1,
            });
        }
    }
    Ok(Header { time_exponent, columns: parsed.into_iter().skip(1).collect() })
}

/// The number in a cell; NaN for an empty cell, `None` for anything that is not a finite number.
fn number(cell: &[u8]) -> Option<f64> {
    if cell.is_empty() {
        return Some(f64::NAN);
    }
    let value: f64 = std::str::from_utf8(cell).ok()?.parse().ok()?;
    value.is_finite().then_some(value)
}

/// Digits after the decimal point, `None` where the number has an exponent.
fn printed_decimals(cell: &[u8]) -> Option<i32> {
    if cell.iter().any(|b| matches!(b, b'e' | b'E')) {
        return None;
    }
    let point = cell.iter().position(|&b| b == b'.');
    Some(point.map_or(0, |p| cell[p + 1..].iter().take_while(|b| b.is_ascii_digit()).count() as i32))
}

fn bad_cell(cell: &[u8], c: usize, place: Place) -> RecordingError {
    let text = String::from_utf8_lossy(cell);
    let first_line = text.lines().next().unwrap_or_default();
    let open_quote = first_line.len() < text.len();
    let mut found: String = first_line.chars().take(40).collect();
    if found.len() < text.len() {
        found.push('…');
    }
    let number_like = |s: &str| s.parse::<f64>().is_ok();
    if number_like(&found) {
        return RecordingError::NotFinite { place, found };
    }
    if found.matches(',').count() == 1 && number_like(&found.replace(',', ".")) {
        return RecordingError::DecimalComma { place, found: format!("`{found}`") };
    }
    let help = if open_quote {
        "a quotation mark opens there and does not close in its line: remove it"
    } else if c == 0 {
        "write the time as a number of seconds, or as a date such as `2026-11-29T12:34:56.789Z`"
    } else {
        "write a number, or leave the cell empty for a missing sample"
    };
    RecordingError::NotANumber { place, found, help }
}

/// A row with the wrong number of cells: a decimal comma where all cells are whole numbers and too many.
fn cell_count(record: &ByteRecord, width: usize, place: Place) -> RecordingError {
    let whole = |cell: &[u8]| {
        let digits = cell.trim_ascii().strip_prefix(b"-").unwrap_or(cell.trim_ascii());
        !digits.is_empty() && digits.iter().all(u8::is_ascii_digit)
    };
    if record.len() > width && record.len() <= 2 * width && record.iter().all(whole) {
        let cells: Vec<_> = record.iter().take(6).map(String::from_utf8_lossy).collect();
        return RecordingError::DecimalComma { place, found: format!("the row `{}…`", cells.join(",")) };
    }
    let first = record.get(0).unwrap_or_default();
    let help = if record.iter().any(|cell| cell.contains(&b'\n')) {
        "a quotation mark opens in this row and does not close in its line: remove it"
    } else if record.len() == 1 && first.iter().any(|b| matches!(b, b';' | b'\t' | b'|')) {
        "separate its cells by commas, as those of the header"
    } else {
        "give every column its cell (an empty cell marks a missing sample) and no more"
    };
    RecordingError::CellCount { place, found: record.len(), expected: width, help }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_counted_through_every_kind_of_line_end() {
        for end in ["\n", "\r\n", "\r"] {
            let mut rows: Vec<String> = (0..20).map(|k| format!("{k},{k}")).collect();
            rows[12] = "12,oops".to_owned();
            let text = format!("t,y{end}{}", rows.join(end));
            let error = parse_csv(text.as_bytes(), "f.csv").unwrap_err();
            assert_eq!(error.place().line, Some(14), "{end:?}: {error}");
        }
    }

    #[test]
    fn cells_read_back_exactly() {
        for value in [0.0, -0.0, 1.0 / 3.0, 1e-24, -2.5e300, 610.3516, f64::MIN_POSITIVE] {
            assert_eq!(cell(value).parse::<f64>().unwrap().to_bits(), value.to_bits());
        }
    }

    /// Dates count from the whole second of the first one, in a file as in its blocks.
    #[test]
    fn times_may_be_dates() {
        let rows = |k: u32| format!("2026-11-29T13:34:{:02}.{:03}+01:00,{k}\n", 56 + k / 50, 20 * (k % 50));
        let text = format!("t,y\n{}", (5..105).map(rows).collect::<String>());
        let recording = parse_csv(text.as_bytes(), "f.csv").unwrap();
        assert_eq!((recording.time[0], recording.time[99]), (0.1, 2.08));
        assert_eq!((recording.pieces.len(), recording.pieces[0].dt), (1, 0.02));
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), &text).unwrap();
        let blocks = CsvBlocks::open(file.path(), 40).unwrap().map(|block| block.unwrap().time);
        assert_eq!(blocks.collect::<Vec<_>>().concat(), recording.time);
        for (row, part) in [
            ("7.5,1", "`7.5` is no time like those before it"),
            ("2026-11-29T13:40:00,1", "is no time like those before it"),
            ("soon,1", "`soon` is not a number; write the time as a number of seconds, or as a date"),
            (",1", "the time is missing"),
            ("2026-11-29T13:34:56Z,1", "does not come after"),
        ] {
            // (The row of 13:34 UTC is an hour after those of 13:34 +01:00; what comes next is before it.)
            let last = if part.starts_with("does") { rows(104) } else { String::new() };
            let said = parse_csv(format!("{text}{row}\n{last}").as_bytes(), "f.csv").unwrap_err().to_string();
            assert!(said.contains(part) && said.contains("f.csv:10"), "{said}");
        }
    }
}
