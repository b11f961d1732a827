//! Files to recordings: the format by the ending of the name.

use crate::csv;
use crate::error::{Place, RecordingError};
use crate::recording::Recording;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

/// Endings of the files that may hold a recording. Whether this build reads all of them, its features say
/// (`mat`, `parquet`); [`read`] tells which is missing.
pub const EXTENSIONS: [&str; 3] = ["csv", "mat", "parquet"];

/// Names of the time in files that do not say which column it is; the first found counts. `tout` is what Simulink
/// calls it.
#[cfg(any(feature = "mat", feature = "parquet"))]
pub(crate) const TIMES: [&str; 4] = ["t", "time", "Time", "tout"];

/// Most bytes that the values of a file may need, unpacked. A variable of a MAT-file has at most so many anyway.
#[cfg(any(feature = "mat", feature = "parquet"))]
pub(crate) const ROOM: u64 = 2 << 30;

/// Most variables or columns that a sentence names.
const TOLD: usize = 8;

/// A list for a sentence, cut where it gets long.
pub fn told(mut all: Vec<String>) -> String {
    if all.len() > TOLD {
        let more = all.len() - TOLD;
        all.truncate(TOLD);
        all.push(format!("{more} more"));
    }
    all.join(", ")
}

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
    let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    match ending.as_str() {
        #[cfg(feature = "mat")]
        "mat" => crate::mat::parse(&bytes, &label, &name),
        #[cfg(feature = "parquet")]
        "parquet" => crate::parquet::parse(bytes, &label, &name),
        #[cfg(not(feature = "mat"))]
        "mat" => Err(RecordingError::NotBuiltIn {
            place: Place::file(&label),
            format: "MAT-files",
            feature: "mat",
        }),
        #[cfg(not(feature = "parquet"))]
        "parquet" => Err(RecordingError::NotBuiltIn {
            place: Place::file(&label),
            format: "Parquet files",
            feature: "parquet",
        }),
        _ => csv::parse(&bytes, &label, &name, 0),
    }
}

/// The content of the file at `path`, what errors call it, and its name.
pub(crate) fn bytes(path: &Path) -> Result<(Vec<u8>, String, String), RecordingError> {
    let (label, name) = check_file(path)?;
    let bytes = fs::read(path).map_err(|source| unread(&label, source))?;
    Ok((bytes, label, name))
}

/// What errors call the file at `path`, and its name; an error where there is no file.
pub(crate) fn check_file(path: &Path) -> Result<(String, String), RecordingError> {
    let label = path.display().to_string();
    let kind = fs::metadata(path).map_err(|source| unread(&label, source))?.file_type();
    if kind.is_dir() {
        return Err(RecordingError::IsDirectory { place: Place::file(&label) });
    }
    if is_device(kind) {
        return Err(RecordingError::IsDevice { place: Place::file(&label) });
    }
    let name = path.file_name().map_or_else(|| label.clone(), |name| name.to_string_lossy().into_owned());
    Ok((label, name))
}

/// Whether it is a device, of which some never end. (A pipe is none: `<(zcat run.csv.gz)` may be read.)
pub fn is_device(kind: fs::FileType) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        kind.is_char_device() || kind.is_block_device()
    }
    #[cfg(not(unix))]
    {
        let _ = kind;
        false
    }
}

pub(crate) fn unread(label: &str, source: std::io::Error) -> RecordingError {
    match source.kind() {
        ErrorKind::NotFound => RecordingError::NotFound { place: Place::file(label) },
        _ => RecordingError::Io { place: Place::file(label), action: "read", source },
    }
}
