//! A file whatever its format: its bytes, what errors call it, and how much its values may need.

use crate::error::{Place, RecordingError};
use crate::location::Location;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

/// Most bytes that the values of a file may need, unpacked. A variable of a MAT-file has at most so many anyway.
#[cfg(any(feature = "mat", feature = "mcap", feature = "parquet"))]
pub(crate) const ROOM: u64 = 2 << 30;

/// The content of the file at `path`, for [`parse`](crate::parse); where the path names an episode, that of the whole file.
///
/// # Errors
/// No such file, a folder or a device in its place, or a file that cannot be read.
pub fn content(path: impl AsRef<Path>) -> Result<Vec<u8>, RecordingError> {
    bytes(&Location::of(path).file).map(|(content, ..)| content)
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

/// Writes a file whole or not at all: beside its place under a temporary name, which is then renamed.
///
/// # Errors
/// What the system says; then the file is as it was.
pub fn write_whole(path: impl AsRef<Path>, bytes: impl AsRef<[u8]>) -> std::io::Result<()> {
    let path = path.as_ref();
    let mut beside = path.as_os_str().to_owned();
    beside.push(format!(".{}.tmp", std::process::id()));
    fs::write(&beside, bytes).and_then(|()| fs::rename(&beside, path)).inspect_err(|_| {
        // (The temporary file may not exist; the first error is the one to report.)
        let _ = fs::remove_file(&beside);
    })
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

/// What `read` returns; where the library panics on damaged bytes, an error like the others. Nothing outlives the call.
#[cfg(any(feature = "hdf5", feature = "mcap", feature = "parquet"))]
pub(crate) fn guarded<T>(
    label: &str,
    read: impl FnOnce() -> Result<T, RecordingError>,
) -> Result<T, RecordingError> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(read)).unwrap_or_else(|_| {
        Err(RecordingError::Damaged {
            place: Place::file(label),
            variable: None,
            found: "its parts contradict each other".to_owned(),
        })
    })
}
