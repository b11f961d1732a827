//! The table that says which machine a recording is of, when it was made, and under what conditions.
//!
//! ```text
//! recording,machine,date,temperature [degC],mileage [km]
//! run1.csv,A-07,2026-03-02,21.5,1200
//! run2.csv,A-07,2026-08-19T14:30:00Z,27,5310
//! run3.csv,B-11,2026-03-04,,400
//! ```

use std::collections::BTreeMap;

use chrono::{DateTime, NaiveDate, NaiveDateTime};

/// Seconds in a Julian year, the unit in which dates are covariates.
const YEAR: f64 = 365.25 * 86400.0;

/// A table of recordings.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Runs {
    /// The covariates; a date is one, in years.
    pub covariates: Vec<Covariate>,
    rows: BTreeMap<String, Run>,
}

/// What a column of the table is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Covariate {
    /// Its name.
    pub name: String,
    /// Its unit; empty where none is stated.
    pub unit: String,
}

impl Covariate {
    /// `name` or `name [unit]`.
    pub fn header(&self) -> String {
        match self.unit.is_empty() {
            true => self.name.clone(),
            false => format!("{} [{}]", self.name, self.unit),
        }
    }
}

/// What the table says of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// The machine; the recording itself where the table has no such column.
    pub machine: String,
    /// As it stands in the table; empty where it has none.
    pub date: String,
    /// A value for each covariate; NaN where it is not known.
    pub covariates: Vec<f64>,
}

/// Why a table cannot be read. Each message is one sentence with the fix.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RunsError {
    /// The text is no CSV.
    #[error("{file}: {message}")]
    Csv {
        /// The file.
        file: String,
        /// What is wrong, with its line.
        message: String,
    },
    /// A column that must be there is not.
    #[error(
        "{file}: there is no column `recording` among {found}: call the column of the recordings' names `recording`"
    )]
    NoRecording {
        /// The file.
        file: String,
        /// The columns that there are.
        found: String,
    },
    /// Two columns have one name.
    #[error("{file}: there are two columns `{name}`: rename or delete one of them")]
    TwoColumns {
        /// The file.
        file: String,
        /// The name.
        name: String,
    },
    /// Two rows are of one recording.
    #[error("{file}:{line}: the recording `{recording}` has a row already: keep one of them")]
    TwoRows {
        /// The file.
        file: String,
        /// The second row.
        line: u64,
        /// The recording.
        recording: String,
    },
    /// A cell that holds no number.
    #[error("{file}:{line}: `{found}` in `{column}` is not a number: write one, or leave the cell empty")]
    NoNumber {
        /// The file.
        file: String,
        /// The row.
        line: u64,
        /// The column.
        column: String,
        /// The cell.
        found: String,
    },
    /// A cell that holds no date.
    #[error("{file}:{line}: `{found}` is not a date: write it like 2026-08-19 or 2026-08-19T14:30:00Z")]
    NoDate {
        /// The file.
        file: String,
        /// The row.
        line: u64,
        /// The cell.
        found: String,
    },
    /// A recording that the table does not have.
    #[error("{file}: there is no row for the recording `{recording}`: add one")]
    Missing {
        /// The file.
        file: String,
        /// The recording.
        recording: String,
    },
}

/// What a column holds.
enum Column {
    Recording,
    Machine,
    Date,
    Number(usize),
}

impl Runs {
    /// Reads the table in `text`, which errors call `file`.
    ///
    /// # Errors
    /// Any [`RunsError`] but [`RunsError::Missing`].
    ///
    /// ```
    /// let runs = greybox_fleet::Runs::parse("recording,machine,load [kg]\nrun1.csv,A,12\n", "runs.csv")?;
    /// assert_eq!(runs.of("run1.csv", "runs.csv")?.covariates, [12.0]);
    /// # Ok::<(), greybox_fleet::RunsError>(())
    /// ```
    pub fn parse(text: &str, file: &str) -> Result<Runs, RunsError> {
        let unreadable = |e: csv::Error| RunsError::Csv { file: file.to_owned(), message: e.to_string() };
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .from_reader(text.trim_start_matches('\u{feff}').as_bytes());
        let (columns, covariates) = header(reader.headers().map_err(unreadable)?, file)?;
        let mut runs = Runs { covariates, rows: BTreeMap::new() };
        for record in reader.records() {
            let record = record.map_err(unreadable)?;
            let line = record.position().map_or(0, csv::Position::line);
            let (name, run) = runs.row(&record, &columns, file, line)?;
            if runs.rows.contains_key(&name) {
                return Err(RunsError::TwoRows { file: file.to_owned(), line, recording: name });
            }
            runs.rows.insert(name, run);
        }
        Ok(runs)
    }

    fn row(
        &self,
        record: &csv::StringRecord,
        columns: &[Column],
        file: &str,
        line: u64,
    ) -> Result<(String, Run), RunsError> {
        let mut name = String::new();
        let mut run = Run {
            machine: String::new(),
            date: String::new(),
            covariates: vec![f64::NAN; self.covariates.len()],
        };
        for (column, cell) in columns.iter().zip(record) {
            match column {
                Column::Recording => cell.clone_into(&mut name),
                Column::Machine => cell.clone_into(&mut run.machine),
                Column::Date if cell.is_empty() => {}
                Column::Date => {
                    let at = self.covariates.iter().position(|c| c.name == DATE).unwrap_or(0);
                    let seconds = seconds(cell).ok_or_else(|| RunsError::NoDate {
                        file: file.to_owned(),
                        line,
                        found: cell.to_owned(),
                    })?;
                    cell.clone_into(&mut run.date);
                    run.covariates[at] = seconds / YEAR;
                }
                Column::Number(_) if cell.is_empty() => {}
                Column::Number(at) => {
                    let number = cell.parse::<f64>().ok().filter(|v| v.is_finite());
                    run.covariates[*at] = number.ok_or_else(|| RunsError::NoNumber {
                        file: file.to_owned(),
                        line,
                        column: self.covariates[*at].name.clone(),
                        found: cell.to_owned(),
                    })?;
                }
            }
        }
        if run.machine.is_empty() {
            run.machine.clone_from(&name);
        }
        Ok((name, run))
    }

    /// What the table, which errors call `file`, says of a recording.
    ///
    /// # Errors
    /// [`RunsError::Missing`].
    pub fn of(&self, recording: &str, file: &str) -> Result<&Run, RunsError> {
        self.rows
            .get(recording)
            .ok_or_else(|| RunsError::Missing { file: file.to_owned(), recording: recording.to_owned() })
    }
}

/// Name of the covariate that a date is.
const DATE: &str = "date";

/// What each column holds, and the covariates.
fn header(cells: &csv::StringRecord, file: &str) -> Result<(Vec<Column>, Vec<Covariate>), RunsError> {
    let mut covariates: Vec<Covariate> = Vec::new();
    let mut columns = Vec::with_capacity(cells.len());
    let mut seen: Vec<&str> = Vec::new();
    for cell in cells {
        let (name, unit) = match cell.split_once('[') {
            Some((name, unit)) => (name.trim(), unit.trim_end_matches(']').trim()),
            None => (cell, ""),
        };
        if seen.contains(&name) {
            return Err(RunsError::TwoColumns { file: file.to_owned(), name: name.to_owned() });
        }
        seen.push(name);
        columns.push(match name {
            "recording" => Column::Recording,
            "machine" => Column::Machine,
            _ => {
                let (unit, column) =
                    if name == DATE { ("a", Column::Date) } else { (unit, Column::Number(covariates.len())) };
                covariates.push(Covariate { name: name.to_owned(), unit: unit.to_owned() });
                column
            }
        });
    }
    if !columns.iter().any(|column| matches!(column, Column::Recording)) {
        let found = cells.iter().map(|cell| format!("`{cell}`")).collect::<Vec<_>>().join(", ");
        return Err(RunsError::NoRecording { file: file.to_owned(), found });
    }
    Ok((columns, covariates))
}

/// Seconds since 1970 of an ISO 8601 date, with or without a time; without a zone it is UTC.
fn seconds(text: &str) -> Option<f64> {
    let of = |at: NaiveDateTime| at.and_utc().timestamp_millis() as f64 * 1e-3;
    if let Ok(at) = DateTime::parse_from_rfc3339(text) {
        return Some(at.timestamp_millis() as f64 * 1e-3);
    }
    if let Ok(date) = NaiveDate::parse_from_str(text, "%Y-%m-%d") {
        return date.and_hms_opt(0, 0, 0).map(of);
    }
    ["%Y-%m-%dT%H:%M:%S%.f", "%Y-%m-%d %H:%M:%S%.f", "%Y-%m-%d %H:%M", "%Y-%m-%dT%H:%M"]
        .iter()
        .find_map(|format| NaiveDateTime::parse_from_str(text, format).ok())
        .map(of)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = "recording,machine,date,temperature [degC],mileage [km]
run1.csv,A-07,2026-03-02,21.5,1200
run2.csv,A-07,2027-03-02T06:00:00Z,27,5310
run3.csv,B-11,,,400
";

    #[test]
    fn a_table_is_read() {
        let runs = Runs::parse(TABLE, "runs.csv").unwrap();
        let names: Vec<_> = runs.covariates.iter().map(|c| (c.name.as_str(), c.unit.as_str())).collect();
        assert_eq!(names, [("date", "a"), ("temperature", "degC"), ("mileage", "km")]);
        let [first, second, third] =
            ["run1.csv", "run2.csv", "run3.csv"].map(|name| runs.of(name, "runs.csv").unwrap().clone());
        assert_eq!((first.machine.as_str(), first.date.as_str()), ("A-07", "2026-03-02"));
        assert_eq!(first.covariates[1..], [21.5, 1200.0]);
        // A Julian year has six hours more than 365 days.
        assert!((second.covariates[0] - first.covariates[0] - 1.0).abs() < 1e-9);
        assert!(third.covariates[0].is_nan() && third.covariates[1].is_nan());
        let missing = runs.of("run4.csv", "runs.csv").unwrap_err();
        assert_eq!(missing.to_string(), "runs.csv: there is no row for the recording `run4.csv`: add one");
    }

    #[test]
    fn without_a_machine_each_recording_is_one() {
        let runs = Runs::parse("recording\nrun1.csv\n", "runs.csv").unwrap();
        assert_eq!(runs.of("run1.csv", "runs.csv").unwrap().machine, "run1.csv");
    }

    #[test]
    fn dates_of_the_usual_forms_are_read() {
        for (text, wanted) in [
            ("1970-01-02", 86400.0),
            ("1970-01-01T01:00:00+01:00", 0.0),
            ("1970-01-01 00:01:00.5", 60.5),
            ("1970-01-01T00:02", 120.0),
        ] {
            assert_eq!(seconds(text), Some(wanted), "{text}");
        }
        for text in ["02.03.2026", "2026-13-01", "yesterday", ""] {
            assert_eq!(seconds(text), None, "{text}");
        }
    }

    #[test]
    fn faults_are_told_with_their_place() {
        for (text, wanted) in [
            ("run,machine\na,b\n", "r: there is no column `recording` among `run`, `machine`"),
            ("recording,x,x\na,1,2\n", "r: there are two columns `x`"),
            ("recording,x\na,1\na,2\n", "r:3: the recording `a` has a row already"),
            ("recording,x [m]\na,red\n", "r:2: `red` in `x` is not a number"),
            ("recording,x\na,inf\n", "r:2: `inf` in `x` is not a number"),
            ("recording,date\na,today\n", "r:2: `today` is not a date"),
            ("recording,x\na\n", "r: CSV error"),
        ] {
            let error = Runs::parse(text, "r").unwrap_err().to_string();
            assert!(error.starts_with(wanted), "{error}");
        }
    }
}
