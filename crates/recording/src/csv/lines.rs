//! CSV one line at a time, as it comes from a running machine.

use super::{Header, bad_cell, cell_count, check_text, header, is_blank, number};
use crate::error::{Place, RecordingError};
use crate::stamp::Stamp;
use ::csv::{ByteRecord, ReaderBuilder};

/// Lines of a CSV file that is still being written: the header first, then row after row.
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
    header: Header,
}

impl CsvLines {
    /// Reads the header, which stands in this line of what errors call `label`.
    ///
    /// # Errors
    /// [`RecordingError`]: a header as [`read_csv`](super::read_csv) refuses it.
    pub fn new(header_line: &str, label: &str, line: u64) -> Result<CsvLines, RecordingError> {
        let text = check_text(header_line.as_bytes(), label, line - 1)?;
        let record = cells(text, label)?;
        let header = header(&record, &Place::line(label, line), text)?;
        Ok(CsvLines { label: label.to_owned(), header })
    }

    /// Name and unit of every column after the time.
    pub fn columns(&self) -> &[(String, Option<String>)] {
        &self.header.columns
    }

    /// The time, and the value of every column after it (NaN = missing); `None` for a blank line.
    ///
    /// # Errors
    /// [`RecordingError`]: another number of cells than the header has, a cell that is no number, no time.
    pub fn row(&self, text: &str, line: u64) -> Result<Option<(Stamp, Vec<f64>)>, RecordingError> {
        let record = cells(text.as_bytes(), &self.label)?;
        if is_blank(&record) {
            return Ok(None);
        }
        let place = || Place::line(&self.label, line);
        let width = self.header.columns.len() + 1;
        if record.len() != width {
            return Err(cell_count(&record, width, place()));
        }
        let mut columns = record.iter().map(<[u8]>::trim_ascii);
        let time = columns.next().unwrap_or_default();
        if time.is_empty() {
            return Err(RecordingError::MissingTime { place: place().column(0, "t") });
        }
        let stamp = std::str::from_utf8(time)
            .ok()
            .and_then(|text| Stamp::decimal(text, self.header.time_exponent).or_else(|| Stamp::date(text)))
            .ok_or_else(|| bad_cell(time, 0, place().column(0, "t")))?;
        let values = columns.zip(&self.header.columns).enumerate().map(|(c, (cell, (name, _)))| {
            number(cell).ok_or_else(|| bad_cell(cell, c + 1, place().column(c + 1, name)))
        });
        Ok(Some((stamp, values.collect::<Result<_, _>>()?)))
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
}
