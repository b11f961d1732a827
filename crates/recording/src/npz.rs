//! Reading archives of NumPy arrays, `.npz` of `np.savez` and `np.savez_compressed`, and a single array, `.npy` (feature
//! `npz`).
//!
//! The rules are those of MAT-files: the time is the vector `t`, `time`, `tout` or `timestamp`, in s, and every array of real
//! numbers with a value for each time is a signal, or one per column.
//!
//! | in the file | channels |
//! |---|---|
//! | vectors `t`, `theta`, `v` | `theta`, `v` |
//! | matrix `y` beside `t`, one column per signal | `y_1`, `y_2`, … |
//! | matrix `y` and texts `y_names`, `names`, `labels`, `columns` or `channels` | the texts, each `name` or `name [unit]`; one may be the time |
//! | array of records with the fields `t`, `theta`, `v` | `theta`, `v` |
//! | vectors `t_motor`, `motor_angle`, `t_load`, `load_angle` | `motor_angle`, `load_angle`, on one grid |
//! | one matrix alone, its first column increasing | the array's name with `_1`, `_2`, …; that of a `.npy` is `y` |
//!
//! Numbers, truth values (0 and 1) and texts are read in both byte orders. Python objects (pickles), dates and complex
//! numbers are left out, which the warnings of the recording tell; nothing of a file is run.

mod archive;
mod array;
mod literal;

use crate::error::{Place, RecordingError};
use crate::file::ROOM;
use crate::layout;
use crate::recording::Recording;
use crate::selection::Selection;
use crate::variables::{Value, Variable};

/// Reads a recording called `name` from the bytes of an `.npz` or `.npy`.
///
/// # Errors
/// [`RecordingError::Format`], [`RecordingError::Damaged`] or [`RecordingError::TooLarge`] where the bytes cannot be read;
/// [`RecordingError::NoTime`], [`RecordingError::SeveralTimes`] or [`RecordingError::NoSignals`] where they make no recording;
/// else as [`Recording::from_columns`] and, of several times, as [`Recording::from_clocks`].
///
/// ```
/// let error = greybox_recording::parse_npz(b"t,u\n0,1\n", "run1.npz").unwrap_err();
/// assert!(error.to_string().starts_with("run1.npz: it is no archive of NumPy"));
/// ```
pub fn parse_npz(bytes: &[u8], name: &str) -> Result<Recording, RecordingError> {
    parse(bytes, name, name, &Selection::default())
}

pub(crate) fn parse(
    bytes: &[u8],
    label: &str,
    name: &str,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    let variables = variables(bytes, ROOM).map_err(|(variable, fault)| {
        let place = Place::file(label);
        match fault {
            Fault::Format(found) => RecordingError::Format { place, found: found.to_owned(), help: SAVE },
            Fault::Damaged(what) => RecordingError::Damaged { place, variable, found: what.to_owned() },
            Fault::TooLarge => RecordingError::TooLarge { place, variable, limit_gib: ROOM >> 30 },
        }
    })?;
    layout::recording(&variables, label, name, selection)
}

/// The fix for what is not read.
const SAVE: &str = "write it with `np.savez('run.npz', t=t, y=y)`";

/// Why bytes are not read.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    /// They are of another format: what it is.
    Format(&'static str),
    /// They end too early, or have no meaning: what was found.
    Damaged(&'static str),
    /// Unpacked they need more than the room.
    TooLarge,
}

/// A fault, and the variable where that is known.
type Found<T> = Result<T, (Option<String>, Fault)>;

/// The variables of a file whose values may need `room` bytes.
fn variables(bytes: &[u8], mut room: u64) -> Found<Vec<Variable>> {
    if array::is_array(bytes) {
        let value = array::value(bytes, &mut room).map_err(|fault| (None, fault))?;
        return Ok(match value {
            // The fields of records are the variables.
            Value::Structure { count: 1, fields } => fields
                .into_iter()
                .filter_map(|(name, values)| Some(Variable { name, value: values.into_iter().next()? }))
                .collect(),
            value => vec![Variable { name: "y".to_owned(), value }],
        });
    }
    let mut variables = Vec::new();
    for entry in archive::entries(bytes).map_err(|fault| (None, fault))? {
        let name = entry.name.strip_suffix(".npy").unwrap_or(&entry.name).to_owned();
        let read = entry.unpacked(bytes, &mut room).and_then(|bytes| match array::is_array(&bytes) {
            true => array::value(&bytes, &mut room),
            false => Ok(Value::Other("no array")),
        });
        let value = read.map_err(|fault| (Some(name.clone()), fault))?;
        variables.push(Variable { name, value });
    }
    Ok(variables)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_unpacked_is_counted() {
        let bytes = include_bytes!("../tests/npz/packed.npz");
        assert!(bytes.len() < 6000);
        let read = variables(bytes, 2000);
        assert!(matches!(read, Err((Some(_), Fault::TooLarge))), "{read:?}");
        assert!(variables(bytes, 20_000).is_ok());
    }
}
