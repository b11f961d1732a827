//! Episodes: several recordings in one file, each named by its number after `#`.

use crate::error::RecordingError;
use crate::read::EXTENSIONS;
use std::path::{Path, PathBuf};

/// Where a recording lies: a file, and which of its episodes where the file holds several.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Location {
    /// The file.
    pub file: PathBuf,
    /// What stands behind `#`.
    pub episode: Option<String>,
}

impl Location {
    /// The location that a path names: `data.parquet#3` is episode 3 of `data.parquet`, unless a file is called so.
    ///
    /// ```
    /// use greybox_recording::Location;
    /// let third = Location::of("runs/data.parquet#3");
    /// assert_eq!((third.file.as_path(), third.episode.as_deref()), ("runs/data.parquet".as_ref(), Some("3")));
    /// assert_eq!(Location::of("runs/data.parquet").episode, None);
    /// ```
    pub fn of(path: impl AsRef<Path>) -> Location {
        let path = path.as_ref();
        let named = path.file_name().and_then(|name| split(name.to_str()?));
        match named {
            Some((file, episode)) if !path.exists() => {
                Location { file: path.with_file_name(file), episode: Some(episode.to_owned()) }
            }
            _ => Location { file: path.to_owned(), episode: None },
        }
    }
}

/// File and episode of a name that has both: the file's ending is that of a recording.
pub(crate) fn split(name: &str) -> Option<(&str, &str)> {
    let (file, episode) = name.rsplit_once('#')?;
    let ending = Path::new(file).extension()?;
    EXTENSIONS.iter().any(|e| ending.eq_ignore_ascii_case(e)).then_some((file, episode))
}

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

/// Numbers in increasing order in words: `0 … 49, 51`.
pub(crate) fn in_words(numbers: &[i64]) -> String {
    let runs = numbers.chunk_by(|a, b| b.wrapping_sub(*a) == 1);
    let words = runs.flat_map(|run| match run {
        [first, .., last] if run.len() > 2 => vec![format!("{first} … {last}")],
        few => few.iter().map(i64::to_string).collect(),
    });
    match numbers.is_empty() {
        true => "none".to_owned(),
        false => crate::finding::listed(words.collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_stands_behind_the_ending_of_a_recording() {
        for (name, expected) in [
            ("data.parquet#3", Some(("data.parquet", "3"))),
            ("a#1.PARQUET#-2", Some(("a#1.PARQUET", "-2"))),
            ("run.csv#x", Some(("run.csv", "x"))),
            ("data.parquet#", Some(("data.parquet", ""))),
            ("data.parquet", None),
            ("run#3.csv", None),
            ("data#3", None),
            (".parquet#3", None),
            ("notes.txt#3", None),
            ("data.parquet#3#4", None),
        ] {
            assert_eq!(split(name), expected, "{name}");
        }
        assert_eq!(Location::of("a.parquet#3/run.csv").episode, None);
    }

    #[test]
    fn numbers_are_told_in_runs() {
        assert_eq!(in_words(&[]), "none");
        assert_eq!(in_words(&[3]), "3");
        assert_eq!(in_words(&[-1, 0, 4, 5, 6, 9]), "-1, 0, 4 … 6, 9");
        assert_eq!(in_words(&[i64::MIN, i64::MAX]), format!("{}, {}", i64::MIN, i64::MAX));
    }
}
