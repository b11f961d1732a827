//! How files name their columns: `name` or `name [unit]`, and the time.

use crate::error::{Place, RecordingError};

/// Names of the time in files that do not say which column it is; the first found counts. `tout` is what Simulink
/// calls it, `timestamp` what data sets of robot learning do.
#[cfg(any(feature = "mat", feature = "parquet"))]
pub(crate) const TIMES: [&str; 5] = ["t", "time", "Time", "tout", "timestamp"];

/// Power of ten of a unit of time, in seconds; `None` for a unit that times do not have.
pub(crate) fn exponent(unit: Option<&str>) -> Option<i32> {
    match unit {
        None | Some("s") => Some(0),
        Some("ms") => Some(-3),
        Some("us" | "µs" | "μs") => Some(-6),
        Some("ns") => Some(-9),
        Some(_) => None,
    }
}

/// Seconds per unit of a time; `None` for a unit that times do not have.
#[cfg(any(feature = "mat", feature = "mcap", feature = "parquet"))]
pub(crate) fn seconds(unit: Option<&str>) -> Option<f64> {
    exponent(unit).map(crate::stamp::scale)
}

/// `name` or `name [unit]`. A bracket before the last one belongs to the name.
pub(crate) fn header_cell(
    cell: &str,
    place: impl Fn() -> Place,
) -> Result<(String, Option<String>), RecordingError> {
    let (name, unit) = parts(cell).map_err(|help| RecordingError::HeaderCell {
        place: place(),
        found: cell.to_owned(),
        help,
    })?;
    Ok((name.to_owned(), unit.map(str::to_owned)))
}

/// A name, and the unit in the bracket at its end.
///
/// # Errors
/// What to do where brackets do not close, or nothing stands before them.
pub(crate) fn parts(text: &str) -> Result<(&str, Option<&str>), &'static str> {
    let mut open = false;
    for c in text.chars().filter(|c| matches!(c, '[' | ']')) {
        match (open, c) {
            (false, ']') => return Err("open the unit's bracket with `[`"),
            (true, '[') => return Err("close the unit's bracket at the end of the cell"),
            _ => open = !open,
        }
    }
    if open {
        return Err("close the unit's bracket at the end of the cell");
    }
    let (name, unit) = match text.strip_suffix(']').and_then(|text| text.rsplit_once('[')) {
        Some((name, unit)) => (name.trim(), Some(unit.trim()).filter(|unit| !unit.is_empty())),
        None => (text, None),
    };
    match name.is_empty() {
        true => Err("give the column a name, or delete it"),
        false => Ok((name, unit)),
    }
}
