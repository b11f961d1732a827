//! Where a recording lies: a file, or one of the episodes of a file, named by its number after `#`.

use std::path::{Path, PathBuf};

/// Endings of the files that may hold a recording. Whether this build reads all of them, its features say
/// (`mat`, `hdf5`, `npz`, `mcap`, `parquet`); [`read`](crate::read) tells which is missing.
pub const EXTENSIONS: [&str; 8] = ["csv", "mat", "h5", "hdf5", "npz", "npy", "mcap", "parquet"];

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
}
