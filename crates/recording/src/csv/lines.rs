//! CSV one line at a time, as it comes from a running machine.

use super::{Header, bad_cell, cell_count, check_text, header, is_blank, number};
use crate::error::{Place, RecordingError};
use crate::header::{exponent, header_cell};
use crate::stamp::Stamp;
use ::csv::{ByteRecord, ReaderBuilder};

/// Lines of a CSV file that is still being written: the header first, then row after row; or rows alone, whose columns are
/// [`named`](CsvLines::named).
///
/// A row is what [`read_csv`](super::read_csv) takes, but that its time may be anything: whether it is late or repeated is
/// for the caller to judge. A fault of one row leaves the reader as it was.
///
/// ```
/// use greybox_recording::CsvLines;
/// let lines = CsvLines::new("t [ms],angle [deg],torque", "standard input", 1)?;
/// assert_eq!(lines.columns()[0], ("angle".to_owned(), Some("deg".to_owned())));
/// let (time, row) = lines.row("20,1.5,", 2)?.expect("a row");
/// assert_eq!((time.after(0), row[0]), (0.02, 1.5));
/// assert!(row[1].is_nan());                    // an empty cell is a missing sample
/// let (time, _) = lines.row("2026-11-29T12:34:56.789Z,1.5,", 2)?.expect("a row");
/// assert_eq!(time.zone, greybox_recording::Zone::Offset(0));
/// assert!(lines.row("", 3)?.is_none());
/// assert!(lines.row("40,1.5", 4).is_err());
/// # Ok::<(), greybox_recording::RecordingError>(())
/// ```
#[derive(Debug, Clone)]
pub struct CsvLines {
    label: String,
    cells: Vec<Cell>,
    /// Name and unit of every column that is read, without the time.
    columns: Vec<(String, Option<String>)>,
    /// Whether the columns were named by the caller.
    named: bool,
}

/// What stands in a cell of a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cell {
    /// The time, or a part of it: power of ten of its unit.
    Time(i32),
    Value,
    /// Anything: it is not read.
    Skipped,
}

/// The name of a column that is not read.
const SKIPPED: &str = "_";

impl CsvLines {
    /// Reads the header, which stands in this line of what errors call `label`.
    ///
    /// # Errors
    /// [`RecordingError`]: a header as [`read_csv`](super::read_csv) refuses it.
    pub fn new(header_line: &str, label: &str, line: u64) -> Result<CsvLines, RecordingError> {
        let text = check_text(header_line.as_bytes(), label, line - 1)?;
        let record = cells(text, label)?;
        let Header { time_exponent, columns } = header(&record, &Place::line(label, line), text)?;
        let values = columns.iter().map(|_| Cell::Value);
        let cells = std::iter::once(Cell::Time(time_exponent)).chain(values).collect();
        Ok(CsvLines { label: label.to_owned(), cells, columns, named: false })
    }

    /// Names the columns of rows that have no header, as one would: `name` or `name [unit]`. A column `_`, or one without a
    /// name, is not read and may hold text. The time `t` may be any column. Several are its parts and add up, each in a
    /// unit of its own. Errors call the names `stated`, and the rows `label`.
    ///
    /// ```
    /// use greybox_recording::CsvLines;
    /// let lines = CsvLines::named("t [s],t [ns],_,angle [deg]", "columns", "standard input")?;
    /// let (time, row) = lines.row("1795955696,123456789,arm,1.5", 1)?.expect("a row");
    /// assert_eq!((time.seconds, time.rest, row), (1_795_955_696, 0.123_456_789, vec![1.5]));
    /// # Ok::<(), greybox_recording::RecordingError>(())
    /// ```
    ///
    /// # Errors
    /// [`RecordingError`]: names as a header may not have them, no time, or no column beside it.
    pub fn named(names: &str, stated: &str, label: &str) -> Result<CsvLines, RecordingError> {
        let record = cells(check_text(names.as_bytes(), stated, 0)?, stated)?;
        let place = || Place::file(stated);
        let refused = |place, found, help| Err(RecordingError::Columns { place, found, help });
        let (mut read, mut columns): (Vec<Cell>, Vec<(String, Option<String>)>) = (Vec::new(), Vec::new());
        for (c, text) in record.iter().enumerate() {
            let text = String::from_utf8_lossy(text).trim().to_owned();
            if text.is_empty() || text == SKIPPED {
                read.push(Cell::Skipped);
                continue;
            }
            let place = || place().column(c, &text);
            let (name, unit) = header_cell(&text, place)?;
            if name != "t" {
                if columns.iter().any(|(other, _)| *other == name) {
                    let help = "name the one that is not meant `_`: it is not read then";
                    return refused(place(), format!("the name `{name}` stands twice"), help);
                }
                columns.push((name, unit));
                read.push(Cell::Value);
                continue;
            }
            let Some(exponent) = exponent(unit.as_deref()) else {
                let unit = unit.unwrap_or_default();
                return refused(place(), format!("a time is not in [{unit}]"), "state it in s, ms, us or ns");
            };
            if read.contains(&Cell::Time(exponent)) {
                let help = "of a time in several columns, each has a unit of its own: `t [s],t [ns]`";
                return refused(place(), "the time stands twice in one unit".to_owned(), help);
            }
            read.push(Cell::Time(exponent));
        }
        if !read.iter().any(|cell| matches!(cell, Cell::Time(_))) {
            let help = "name its column `t`, or `t [ms]` with its unit; the parts of one in two columns `t [s],t [ns]`";
            return refused(place(), "there is no time".to_owned(), help);
        }
        if columns.is_empty() {
            return Err(RecordingError::NoChannels { place: place() });
        }
        Ok(CsvLines { label: label.to_owned(), cells: read, columns, named: true })
    }

    /// Name and unit of every column that is read, without the time.
    pub fn columns(&self) -> &[(String, Option<String>)] {
        &self.columns
    }

    /// The time, and the value of every column that is read (NaN = missing); `None` for a blank line.
    ///
    /// # Errors
    /// [`RecordingError`]: another number of cells than there are columns, a cell that is no number, no time.
    pub fn row(&self, text: &str, line: u64) -> Result<Option<(Stamp, Vec<f64>)>, RecordingError> {
        let record = cells(text.as_bytes(), &self.label)?;
        if is_blank(&record) {
            return Ok(None);
        }
        let place = || Place::line(&self.label, line);
        if record.len() != self.cells.len() {
            return Err(self.miscounted(&record, place()));
        }
        let (mut time, mut values): (Option<Stamp>, _) = (None, Vec::with_capacity(self.columns.len()));
        for (c, (text, cell)) in record.iter().map(<[u8]>::trim_ascii).zip(&self.cells).enumerate() {
            match cell {
                Cell::Skipped => {}
                Cell::Time(_) if text.is_empty() => {
                    return Err(RecordingError::MissingTime { place: place().column(c, "t") });
                }
                Cell::Time(exponent) => {
                    let part = self.time(text, *exponent);
                    let part = part.ok_or_else(|| bad_cell(text, 0, place().column(c, "t")))?;
                    time = Some(time.map_or(part, |time| time.plus(part)));
                }
                Cell::Value => {
                    let name = &self.columns[values.len()].0;
                    let value = self.value(text);
                    values.push(value.ok_or_else(|| bad_cell(text, c.max(1), place().column(c, name)))?);
                }
            }
        }
        let time = time.ok_or_else(|| RecordingError::MissingTime { place: place() })?;
        Ok(Some((time, values)))
    }

    /// The time in a cell, or a part of it: dates have no parts.
    fn time(&self, cell: &[u8], exponent: i32) -> Option<Stamp> {
        let text = std::str::from_utf8(cell).ok()?;
        match self.cells.iter().filter(|cell| matches!(cell, Cell::Time(_))).count() {
            1 => Stamp::decimal(text, exponent).or_else(|| Stamp::date(text)),
            _ => Stamp::part(text, exponent),
        }
    }

    /// The value in a cell. Programs that write no header, as those of ROS, write `nan` where nothing was measured.
    fn value(&self, cell: &[u8]) -> Option<f64> {
        match self.named && cell.eq_ignore_ascii_case(b"nan") {
            true => Some(f64::NAN),
            false => number(cell),
        }
    }

    fn miscounted(&self, record: &ByteRecord, place: Place) -> RecordingError {
        let (found, width) = (record.len(), self.cells.len());
        match self.named {
            true => RecordingError::Columns {
                place,
                found: format!("cells in the row: {found}; columns that are named: {width}"),
                help: "name every column, those that are not read `_`",
            },
            false => cell_count(record, width, place),
        }
    }
}

fn cells(text: &[u8], label: &str) -> Result<ByteRecord, RecordingError> {
    // (To make a reader takes longer than to read a line.)
    if !text.contains(&b'"') {
        return Ok(text.trim_ascii_end().split(|b| *b == b',').collect());
    }
    let mut record = ByteRecord::new();
    ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .buffer_capacity(text.len().max(1))
        .from_reader(text)
        .read_byte_record(&mut record)
        .map_err(|error| RecordingError::Io {
            place: Place::file(label),
            action: "read",
            source: error.into(),
        })?;
    Ok(record)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_read_as_in_a_file() {
        let text = "t,x [m],\"y\"\n0,1,2\n0.1,,-3e-2\n";
        let whole = crate::parse_csv(
            format!("{text}0.2,1,1\n0.3,1,1\n0.4,1,1\n0.5,1,1\n0.6,1,1\n0.7,1,1\n").as_bytes(),
            "a",
        )
        .unwrap();
        let mut read = text.lines();
        let lines = CsvLines::new(read.next().unwrap(), "a", 1).unwrap();
        let (time, row) = lines.row("\"0.5\",\"1\",2\r\n", 9).unwrap().unwrap();
        assert_eq!((time.after(0), &row[..]), (0.5, &[1.0, 2.0][..]));
        for (k, line) in read.enumerate() {
            let (time, row) = lines.row(line, k as u64 + 2).unwrap().unwrap();
            assert_eq!(time.after(0), whole.time[k]);
            for (c, channel) in whole.channels.iter().enumerate() {
                assert_eq!(channel.name, lines.columns()[c].0);
                assert_eq!(row[c].to_bits(), channel.values[k].to_bits());
            }
        }
    }

    #[test]
    fn faults_name_their_place() {
        let lines = CsvLines::new("t,x", "in", 4).unwrap();
        for (row, part) in [("1,a", "in:7"), ("1", "in:7"), (",2", "in:7"), ("1,inf", "in:7")] {
            let said = lines.row(row, 7).unwrap_err().to_string();
            assert!(said.starts_with(part), "{said}");
        }
        assert!(CsvLines::new("1,2", "in", 1).is_err());
    }

    #[test]
    fn rows_without_a_header_have_the_names_that_are_given() {
        let lines = CsvLines::named("_,angle [deg], t [ms],,\"a,b\"", "names", "in").unwrap();
        assert_eq!(lines.columns(), [("angle".to_owned(), Some("deg".to_owned())), ("a,b".to_owned(), None)]);
        let (time, row) = lines.row("any text,1.5,20,\"more, of it\",nan", 1).unwrap().unwrap();
        assert_eq!((time.after(0), row[0], row[1].is_nan()), (0.02, 1.5, true));
        let (date, _) = lines.row(",1.5,2026-11-29T12:34:56.5Z,,", 1).unwrap().unwrap();
        assert_eq!((date.seconds, date.rest), (1_795_955_696, 0.5));
        for (row, part) in [
            ("x,1,20,x", "in:7: cells in the row: 4; columns that are named: 5; name every column"),
            ("x,1,,x,1", "in:7:t (column 3): the time is missing"),
            ("x,1,soon,x,1", "in:7:t (column 3): `soon` is not a number; write the time"),
            ("x,y,20,x,1", "in:7:angle (column 2): `y` is not a number; write a number"),
            ("x,inf,20,x,1", "in:7:angle (column 2): `inf` is not a measured value"),
        ] {
            let said = lines.row(row, 7).unwrap_err().to_string();
            assert!(said.starts_with(part), "{said}");
        }
    }

    /// Parts of a time add up to every nanosecond of it, as if it stood in one cell.
    #[test]
    fn a_time_may_stand_in_several_columns() {
        let lines = CsvLines::named("t [ns],x,t", "names", "in").unwrap();
        let time = |row: &str| lines.row(row, 1).unwrap().unwrap().0;
        for (parts, whole) in [
            ("123456789,0,1795955696", "1795955696.123456789"),
            ("999999999,0,1795955696", "1795955696.999999999"),
            ("3,0,1795955696", "1795955696.000000003"),
            ("2500000000,0,1795955694", "1795955696.5"),
            ("250000000,0,-2000000000", "-1999999999.75"),
        ] {
            assert_eq!(time(parts), Stamp::decimal(whole, 0).unwrap(), "{parts}");
        }
        assert_eq!(time("340000000,0,12").after(0), 12.34);
        // What is written with an exponent, or with more digits than an integer has, is a number all the same.
        assert_eq!(time("5e8,0,1").after(0), 1.5);
        assert_eq!(time(&format!("{},0,1", "9".repeat(60))).seconds, i64::MAX);
        let said = lines.row("0,0,2026-11-29T12:34:56Z", 1).unwrap_err().to_string();
        assert!(said.starts_with("in:1:t (column 3): `2026-11-29T12:34:56Z` is not a number"), "{said}");
        assert!(lines.row(",0,1", 1).is_err());
    }

    #[test]
    fn names_that_do_not_fit_say_why() {
        for (names, part) in [
            ("", "names: there is no time"),
            ("a,b", "names: there is no time; name its column `t`"),
            ("t,_,", "names: there is no column beside the time"),
            ("t,a,a [m]", "names:a [m] (column 3): the name `a` stands twice"),
            ("t [s],t,a", "names:t (column 2): the time stands twice in one unit"),
            ("t [min],a", "names:t [min] (column 1): a time is not in [min]"),
            ("t,a [m", "names:a [m (column 2): the header cell `a [m` is not `name` or `name [unit]`"),
            ("t,[m]", "names:[m] (column 2): the header cell"),
        ] {
            let said = CsvLines::named(names, "names", "in").unwrap_err().to_string();
            assert!(said.starts_with(part), "{said}");
        }
    }
}
