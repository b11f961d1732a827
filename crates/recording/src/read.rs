//! Files to recordings: the format by the ending of the name.

use crate::csv;
#[cfg(not(all(feature = "mat", feature = "parquet")))]
use crate::error::Place;
use crate::error::RecordingError;
use crate::file::bytes;
use crate::recording::Recording;
use std::path::Path;

/// Endings of the files that may hold a recording. Whether this build reads all of them, its features say
/// (`mat`, `parquet`); [`read`] tells which is missing.
pub const EXTENSIONS: [&str; 3] = ["csv", "mat", "parquet"];

/// Reads the recording in the file at `path`: a MAT-file where the name ends in `.mat`, a Parquet file where it ends
/// in `.parquet`, CSV else.
///
/// # Errors
/// Any [`RecordingError`]; its place names the file as given. [`RecordingError::NotBuiltIn`] where this build lacks the
/// feature `mat` or `parquet`.
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
    let path = path.as_ref();
    let (bytes, label, name) = bytes(path)?;
    parse(bytes, &label, &name)
}

/// The recording in the bytes of a file: what errors call the file, and its name, whose ending says the format as for
/// [`read`].
///
/// # Errors
/// As [`read`].
pub fn parse(bytes: Vec<u8>, label: &str, name: &str) -> Result<Recording, RecordingError> {
    let ending = Path::new(name).extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    match ending.unwrap_or_default().as_str() {
        #[cfg(feature = "mat")]
        "mat" => crate::mat::parse(&bytes, label, name),
        #[cfg(feature = "parquet")]
        "parquet" => crate::parquet::parse(bytes, label, name),
        #[cfg(not(feature = "mat"))]
        "mat" => {
            Err(RecordingError::NotBuiltIn { place: Place::file(label), format: "MAT-files", feature: "mat" })
        }
        #[cfg(not(feature = "parquet"))]
        "parquet" => Err(RecordingError::NotBuiltIn {
            place: Place::file(label),
            format: "Parquet files",
            feature: "parquet",
        }),
        _ => csv::parse(&bytes, label, name, 0),
    }
}
