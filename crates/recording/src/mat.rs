//! Reading MAT-files of MATLAB and Simulink (feature `mat`).
//!
//! Read are files of level 5: those of `save` with `-v6` and `-v7` (compressed), also those that SciPy and Octave
//! write. Those of `-v7.3` (HDF5) are read with the feature `hdf5`; without, they are an error that names the fix.
//!
//! The time is the vector `t`, `time`, `tout` or `timestamp`, in s; every real array with a value for each time is a signal:
//!
//! | in the file | channels |
//! |---|---|
//! | vectors `t`, `theta`, `v` | `theta`, `v` |
//! | structure `s` with the fields `t`, `theta`, `v` | `theta`, `v` |
//! | matrix `y`, one column (or row) per signal | `y_1`, `y_2`, … |
//! | matrix `y` and texts `y_names`, `names`, `labels`, `columns` or `channels` | the texts, each `name` or `name [unit]`; one may be the time |
//! | structure with time of Simulink: `time`, `signals(k).values`, `signals(k).label` | the labels; without, the variable's name |
//! | one matrix alone, its first column (or row) increasing | the matrix's name with `_1`, `_2`, … |
//! | structure `units` with a text per signal | units of the signals |
//! | dSPACE: `X(k).Data` and `Y(k).Data` with `Name` and `Unit` | the names |
//! | several times, each in a structure of its own or called `t_NAME`, `NAME_t`, `time_NAME`, … | those of all, on one grid |
//!
//! Signals of several times are joined as [`Recording::from_clocks`] does. A signal belongs to the time of the structure
//! around it, or to the only one of its length; of several to the one whose `NAME` stands in its own. Truth values are held
//! until the next one.
//!
//! Structures within structures are looked through. A name that would stand twice gets the structures' names before
//! it (`hub_theta`). NaN is a missing sample. What is left out is told in the warnings of the recording.

mod level5;

use crate::error::{Place, RecordingError};
use crate::file::ROOM;
use crate::layout;
use crate::recording::Recording;
use crate::selection::Selection;
use level5::Fault;
use std::borrow::Cow;

/// Reads a recording called `name` from the bytes of a MAT-file.
///
/// # Errors
/// [`RecordingError::Format`], [`RecordingError::Damaged`] or [`RecordingError::TooLarge`] where the bytes cannot be read,
/// [`RecordingError::NotBuiltIn`] for a file of `-v7.3` where the feature `hdf5` is off;
/// [`RecordingError::NoTime`], [`RecordingError::SeveralTimes`] or [`RecordingError::NoSignals`] where they make no recording;
/// else as [`Recording::from_columns`] and, of several times, as [`Recording::from_clocks`].
///
/// ```
/// let error = greybox_recording::parse_mat(b"t,u\n0,1\n", "run1.mat").unwrap_err();
/// assert!(error.to_string().starts_with("run1.mat: the file is damaged"));
/// ```
pub fn parse_mat(bytes: &[u8], name: &str) -> Result<Recording, RecordingError> {
    parse(Cow::Borrowed(bytes), name, name, &Selection::default())
}

pub(crate) fn parse(
    bytes: Cow<'_, [u8]>,
    label: &str,
    name: &str,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    #[cfg(feature = "hdf5")]
    if level5::is_hdf5(&bytes) {
        return crate::hdf5::parse(bytes.into_owned(), label, name, selection);
    }
    let variables = level5::variables(&bytes).map_err(|fault| refused(fault, Place::file(label)))?;
    layout::recording(&variables, label, name, selection)
}

fn refused(fault: Fault, place: Place) -> RecordingError {
    match fault {
        Fault::Hdf5 => RecordingError::NotBuiltIn {
            place,
            format: "MAT-files of version 7.3 (HDF5)",
            feature: "hdf5",
            instead: level5::SAVE_V7,
        },
        Fault::Format(found, help) => RecordingError::Format { place, found: found.to_owned(), help },
        Fault::Damaged { variable, what, at } => {
            RecordingError::Damaged { place, variable, found: format!("{what} (byte {at})") }
        }
        Fault::TooLarge { variable } => RecordingError::TooLarge { place, variable, limit_gib: ROOM >> 30 },
    }
}
