//! Reading HDF5, and MAT-files of `save -v7.3`, which are HDF5 (feature `hdf5`).
//!
//! The rules are those of [MAT-files](mod@crate::mat): a group is a structure, a data set an array, and the time is the vector
//! `t`, `time`, `tout` or `timestamp`, in s. What is HDF5's own:
//!
//! | in the file | channels |
//! |---|---|
//! | attribute `units` or `unit` of a data set | its unit; the time may be in `s`, `ms` or `us` |
//! | data set of n rows and m columns, beside n times | one channel per column |
//! | dimension scale that is called `time` or has a unit of time, where no data set is called `t` or `time` | the time; several of them in one group are `time_NAME` |
//! | records (compound) of numbers | each field as if it were a data set of its own |
//! | enumerations, truth values | their numbers |
//!
//! Of MATLAB's, attribute `MATLAB_class`: arrays stand transposed, texts are numbers of 16 bits, cells and arrays of
//! structures are references. Its objects (`timeseries`, tables), complex numbers and sparse matrices are no signals.
//!
//! Groups of the old and the new kind, chunks, deflate, shuffle, LZF, Fletcher's checksum and both byte orders are read. What
//! is packed with another filter, spread over files (virtual, external), or stored in the layout of HDF5 2.0
//! (`libver="latest"`) is left out, which the warnings of the recording tell.

mod tree;
mod value;

use crate::error::{Place, RecordingError};
use crate::file::{ROOM, guarded};
use crate::layout;
use crate::recording::Recording;
use crate::selection::Selection;
use tree::Fault;

/// Reads a recording called `name` from the bytes of an HDF5 file, or of a MAT-file of `-v7.3`.
///
/// # Errors
/// [`RecordingError::Damaged`] or [`RecordingError::TooLarge`] where the bytes cannot be read; [`RecordingError::NoTime`],
/// [`RecordingError::SeveralTimes`] or [`RecordingError::NoSignals`] where they make no recording; else as
/// [`Recording::from_columns`] and, of several times, as [`Recording::from_clocks`].
///
/// ```
/// let error = greybox_recording::parse_hdf5(b"t,u\n0,1\n".to_vec(), "run1.h5").unwrap_err();
/// assert!(error.to_string().starts_with("run1.h5: the file is damaged"));
/// ```
pub fn parse_hdf5(bytes: Vec<u8>, name: &str) -> Result<Recording, RecordingError> {
    parse(bytes, name, name, &Selection::default())
}

pub(crate) fn parse(
    bytes: Vec<u8>,
    label: &str,
    name: &str,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    guarded(label, || {
        let variables = tree::variables(bytes, ROOM).map_err(|fault| refused(fault, Place::file(label)))?;
        layout::recording(&variables, label, name, selection)
    })
}

fn refused(fault: Fault, place: Place) -> RecordingError {
    match fault {
        Fault::Damaged { variable, what } => RecordingError::Damaged { place, variable, found: what },
        Fault::TooLarge { variable } => {
            RecordingError::TooLarge { place, variable: Some(variable), limit_gib: ROOM >> 30 }
        }
    }
}
