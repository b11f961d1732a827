//! Episodes: several recordings in one file.

use crate::error::RecordingError;
use std::path::Path;

/// The episodes of the file at `path`, in increasing order, each of which is a recording of its own: `data.parquet#0`,
/// `data.parquet#1`, …. None where the file is one recording: it has no column `episode_index`, or its times go on from episode
/// to episode. Of a Parquet file only that column and the times are read; no other format has episodes, nor has any where
/// this build lacks the feature `parquet`.
///
/// # Errors
/// A Parquet file that cannot be read, or an `episode_index` that is no whole number.
///
/// ```
/// assert!(greybox_recording::episodes("run1.csv")?.is_empty());
/// # Ok::<(), greybox_recording::RecordingError>(())
/// ```
pub fn episodes(path: impl AsRef<Path>) -> Result<Vec<i64>, RecordingError> {
    let path = path.as_ref();
    #[cfg(feature = "parquet")]
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("parquet")) {
        let (label, _) = crate::file::check_file(path)?;
        let file = std::fs::File::open(path).map_err(|source| crate::file::unread(&label, source))?;
        return crate::parquet::episodes(file, &label);
    }
    let _ = path;
    Ok(Vec::new())
}

/// As [`episodes`], of the bytes of a Parquet file, which errors call `label`.
///
/// # Errors
/// As [`episodes`].
///
/// ```
/// # #[cfg(feature = "parquet")] {
/// let error = greybox_recording::parse_episodes(b"t,u\n0,1\n".to_vec(), "run1.parquet").unwrap_err();
/// assert!(error.to_string().starts_with("run1.parquet: the file is damaged"));
/// # }
/// ```
#[cfg(feature = "parquet")]
pub fn parse_episodes(bytes: Vec<u8>, label: &str) -> Result<Vec<i64>, RecordingError> {
    crate::parquet::episodes(bytes::Bytes::from(bytes), label)
}
