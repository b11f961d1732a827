//! Files to recordings: the format by the ending of the name.

use crate::csv;
#[cfg(not(all(
    feature = "mat",
    feature = "hdf5",
    feature = "npz",
    feature = "mcap",
    feature = "parquet"
)))]
use crate::error::Place;
use crate::error::RecordingError;
use crate::file::bytes;
use crate::recording::Recording;
use crate::selection::Selection;
use std::path::Path;

/// Endings of the files that may hold a recording. Whether this build reads all of them, its features say
/// (`mat`, `hdf5`, `npz`, `mcap`, `parquet`); [`read`] tells which is missing.
pub const EXTENSIONS: [&str; 8] = ["csv", "mat", "h5", "hdf5", "npz", "npy", "mcap", "parquet"];

/// Reads the recording in the file at `path`: a MAT-file where the name ends in `.mat`, HDF5 where it ends in `.h5` or
/// `.hdf5`, arrays of NumPy where it ends in `.npz` or `.npy`, an MCAP log where it ends in `.mcap`, a Parquet file where it
/// ends in `.parquet`, CSV else.
///
/// # Errors
/// Any [`RecordingError`]; its place names the file as given. [`RecordingError::NotBuiltIn`] where this build lacks the
/// feature that it needs.
///
/// ```
/// let path = std::env::temp_dir().join(format!("read_{}.csv", std::process::id()));
/// let time: Vec<f64> = (0..20).map(|k| 0.01 * f64::from(k)).collect();
/// greybox_recording::write_csv_file(&path, &time, &[("x [m]", &time)])?;
/// assert_eq!(greybox_recording::read(&path)?.channels[0].unit.as_deref(), Some("m"));
/// # std::fs::remove_file(path).ok();
/// # Ok::<(), greybox_recording::RecordingError>(())
/// ```
pub fn read(path: impl AsRef<Path>) -> Result<Recording, RecordingError> {
    read_selected(path, &Selection::default())
}

/// As [`read`], of a file whose signals have several clocks only what is selected; [`Recording::select`] takes care of the
/// others.
///
/// # Errors
/// As [`read`]. A channel that the file lacks is no error here: then all of them are read.
pub fn read_selected(path: impl AsRef<Path>, selection: &Selection) -> Result<Recording, RecordingError> {
    let (bytes, label, name) = bytes(path.as_ref())?;
    parse(bytes, &label, &name, selection)
}

/// The recording in the bytes of a file: what errors call the file, and its name, whose ending says the format as for
/// [`read`]; of it what is selected, as for [`read_selected`].
///
/// # Errors
/// As [`read`].
pub fn parse(
    bytes: Vec<u8>,
    label: &str,
    name: &str,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    #[cfg(not(any(feature = "mcap", feature = "mat")))]
    let _ = selection;
    let ending = Path::new(name).extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    match ending.unwrap_or_default().as_str() {
        #[cfg(feature = "mat")]
        "mat" => crate::mat::parse(bytes.into(), label, name, selection),
        #[cfg(feature = "hdf5")]
        "h5" | "hdf5" => crate::hdf5::parse(bytes, label, name, selection),
        #[cfg(feature = "npz")]
        "npz" | "npy" => crate::npz::parse(&bytes, label, name, selection),
        #[cfg(feature = "mcap")]
        "mcap" => crate::mcap::parse(&bytes, label, name, selection),
        #[cfg(feature = "parquet")]
        "parquet" => crate::parquet::parse(bytes, label, name),
        #[cfg(not(feature = "mat"))]
        "mat" => Err(not_built_in(label, "MAT-files", "mat")),
        #[cfg(not(feature = "hdf5"))]
        "h5" | "hdf5" => Err(not_built_in(label, "HDF5", "hdf5")),
        #[cfg(not(feature = "npz"))]
        "npz" | "npy" => Err(not_built_in(label, "arrays of NumPy", "npz")),
        #[cfg(not(feature = "mcap"))]
        "mcap" => Err(not_built_in(label, "MCAP logs", "mcap")),
        #[cfg(not(feature = "parquet"))]
        "parquet" => Err(not_built_in(label, "Parquet files", "parquet")),
        _ => csv::parse(&bytes, label, name, 0),
    }
}

#[cfg(not(all(feature = "mat", feature = "hdf5", feature = "npz", feature = "mcap", feature = "parquet")))]
fn not_built_in(label: &str, format: &'static str, feature: &'static str) -> RecordingError {
    let instead = "export the recording as CSV";
    RecordingError::NotBuiltIn { place: Place::file(label), format, feature, instead }
}
