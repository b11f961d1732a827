//! Files to recordings: the format by the ending of the name.

use crate::csv;
use crate::error::{Place, RecordingError};
use crate::file::bytes;
use crate::location::{Location, split};
use crate::recording::Recording;
use crate::selection::Selection;
use std::path::Path;

/// Reads the recording in the file at `path`: a MAT-file where the name ends in `.mat`, HDF5 where it ends in `.h5` or
/// `.hdf5`, arrays of NumPy where it ends in `.npz` or `.npy`, an MCAP log where it ends in `.mcap`, a Parquet file where it
/// ends in `.parquet`, CSV else. `data.parquet#3` is episode 3 of a Parquet file, which is 3 in its column `episode_index`,
/// unless a file is called so.
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
    let path = path.as_ref();
    let Location { file, episode } = Location::of(path);
    let (bytes, mut label, mut name) = bytes(&file)?;
    if let Some(episode) = &episode {
        label = path.display().to_string();
        name = format!("{name}#{episode}");
    }
    parse_episode(bytes, &label, &name, episode.as_deref(), selection)
}

/// The recording in the bytes of a file: what errors call the file, and its name, whose ending says the format as for
/// [`read`]; of it what is selected, as for [`read_selected`]. Of the bytes of `data.parquet`, the name `data.parquet#3`
/// says that episode 3 is read.
///
/// # Errors
/// As [`read`].
///
/// ```
/// use greybox_recording::{Selection, parse};
/// let text: String = (0..20).map(|k| format!("{},{}\n", 0.1 * f64::from(k), k % 3)).collect();
/// let bytes = format!("t,u [V]\n{text}").into_bytes();
/// assert_eq!(parse(bytes.clone(), "run1.csv", "run1.csv", &Selection::default())?.channels.len(), 1);
/// let error = parse(bytes, "run1.csv#3", "run1.csv#3", &Selection::default()).unwrap_err();
/// assert!(error.to_string().contains("`#3` names an episode"));
/// # Ok::<(), greybox_recording::RecordingError>(())
/// ```
pub fn parse(
    bytes: Vec<u8>,
    label: &str,
    name: &str,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    let episode = split(name).map(|(_, episode)| episode);
    parse_episode(bytes, label, name, episode, selection)
}

/// As [`parse`], where it is known whether an episode is named: with [`Location::episode`] as `episode`, a `#` that is part
/// of the file's name stays so.
///
/// # Errors
/// As [`read`].
///
/// ```
/// use greybox_recording::{Selection, parse_episode};
/// let text: String = (0..20).map(|k| format!("{},{}\n", 0.1 * f64::from(k), k % 3)).collect();
/// let bytes = format!("t,u [V]\n{text}").into_bytes();
/// assert!(parse_episode(bytes, "run.csv#3", "run.csv#3", None, &Selection::default()).is_ok());
/// ```
pub fn parse_episode(
    bytes: Vec<u8>,
    label: &str,
    name: &str,
    episode: Option<&str>,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    #[cfg(not(any(feature = "mcap", feature = "mat")))]
    let _ = selection;
    let file = episode.and_then(|episode| name.strip_suffix(episode)?.strip_suffix('#')).unwrap_or(name);
    let ending = Path::new(file).extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    match (ending.unwrap_or_default().as_str(), episode) {
        #[cfg(feature = "parquet")]
        ("parquet", _) => crate::parquet::parse(bytes, label, name, episode),
        #[cfg(not(feature = "parquet"))]
        ("parquet", _) => Err(not_built_in(label, "Parquet files", "parquet")),
        (_, Some(episode)) => Err(RecordingError::NoEpisodes {
            place: Place::file(label),
            episode: episode.to_owned(),
            found: "only Parquet files hold episodes",
            help: "name the file without it",
        }),
        #[cfg(feature = "mat")]
        ("mat", _) => crate::mat::parse(bytes.into(), label, name, selection),
        #[cfg(feature = "hdf5")]
        ("h5" | "hdf5", _) => crate::hdf5::parse(bytes, label, name, selection),
        #[cfg(feature = "npz")]
        ("npz" | "npy", _) => crate::npz::parse(&bytes, label, name, selection),
        #[cfg(feature = "mcap")]
        ("mcap", _) => crate::mcap::parse(&bytes, label, name, selection),
        #[cfg(not(feature = "mat"))]
        ("mat", _) => Err(not_built_in(label, "MAT-files", "mat")),
        #[cfg(not(feature = "hdf5"))]
        ("h5" | "hdf5", _) => Err(not_built_in(label, "HDF5", "hdf5")),
        #[cfg(not(feature = "npz"))]
        ("npz" | "npy", _) => Err(not_built_in(label, "arrays of NumPy", "npz")),
        #[cfg(not(feature = "mcap"))]
        ("mcap", _) => Err(not_built_in(label, "MCAP logs", "mcap")),
        _ => csv::parse(&bytes, label, name, 0),
    }
}

#[cfg(not(all(feature = "mat", feature = "hdf5", feature = "npz", feature = "mcap", feature = "parquet")))]
fn not_built_in(label: &str, format: &'static str, feature: &'static str) -> RecordingError {
    let instead = "export the recording as CSV";
    RecordingError::NotBuiltIn { place: Place::file(label), format, feature, instead }
}
