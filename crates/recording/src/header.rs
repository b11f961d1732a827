//! How files name their columns: `name` or `name [unit]`, and the time.

use crate::error::{Place, RecordingError};

/// Names of the time in files that do not say which column it is; the first found counts. `tout` is what Simulink
/// calls it, `timestamp` what data sets of
/// robot learning do.
#[cfg(any(feature = "mat", feature = "parquet"))]
pub(crate) const TIMES: [&str; 5] = ["t", "time", "Time", "tout", "timestamp"];

/// Seconds per unit of a time; `None` for a unit that times do not have.
pub(crate) fn seconds(unit: Option<&str>) -> Option<f64> {
    match unit {
        None | Some("s") => Some(1.0),
        Some("ms") => Some(1e-3),
        Some("us" | "µs" | "μs") => Some(1e-6),
        Some(_) => None,
    }
}

/// `name` or `name [unit]`.
pub(crate) fn header_cell(
    cell: &str,
    place: impl Fn() -> Place,
) -> Result<(String, Option<String>), RecordingError> {
    let refuse = |help| RecordingError::HeaderCell { place: place(), found: cell.to_owned(), help };
    let (name, unit) = match cell.split_once('[') {
        Some((name, rest)) if !name.contains(']') => match rest.strip_suffix(']') {
            Some(unit) if !unit.contains(['[', ']']) => (name.trim(), Some(unit.trim())),
            _ => return Err(refuse("close the unit's bracket at the end of the cell")),
        },
        _ if cell.contains(']') => return Err(refuse("open the unit's bracket with `[`")),
        _ => (cell, None),
    };
    if name.is_empty() {
        return Err(refuse("give the column a name, or delete it"));
    }
    Ok((name.to_owned(), unit.filter(|unit| !unit.is_empty()).map(str::to_owned)))
}

/// `name[k]` or `name[k] [unit]`, where it is an element of lists.
pub(crate) fn list_element(cell: &str) -> Option<(String, Option<String>)> {
    let (element, unit) = match cell.rsplit_once(" [") {
        Some((element, unit)) => (element.trim_end(), Some(unit.strip_suffix(']')?.trim())),
        None => (cell, None),
    };
    let (name, index) = element.strip_suffix(']')?.rsplit_once('[')?;
    let is_name = !name.is_empty() && !name.ends_with(' ') && !name.contains(['[', ']']);
    let is_index = !index.is_empty() && index.bytes().all(|b| b.is_ascii_digit());
    let is_unit = unit.is_none_or(|unit| !unit.is_empty() && !unit.contains(['[', ']']));
    (is_name && is_index && is_unit).then(|| (element.to_owned(), unit.map(str::to_owned)))
}
