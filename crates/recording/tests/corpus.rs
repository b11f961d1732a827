//! The corpus of the fuzz targets (`fuzz/corpus`) of the formats that not every build reads; xtask replays the others.

use crate::sound;
use std::path::{Path, PathBuf};

/// The files of a target; none where the crate stands alone.
fn corpus(target: &str) -> Option<Vec<PathBuf>> {
    let place = Path::new("fuzz").join("corpus").join(target);
    let mut folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().map(|folder| folder.join(&place));
    let entries = std::fs::read_dir(folders.find(|folder| folder.is_dir())?).unwrap();
    Some(entries.map(|entry| entry.unwrap().path()).collect())
}

#[track_caller]
fn replayed(target: &str, name: &str) {
    let Some(files) = corpus(target) else { return };
    let (mut read, mut refused) = (0, 0);
    for file in files {
        match sound::read(name, &std::fs::read(&file).unwrap(), None) {
            Ok(_) => read += 1,
            Err(_) => refused += 1,
        }
    }
    assert!(read >= 5 && refused >= 2, "{target}: {read} of the files are read, {refused} are refused");
}

#[cfg(feature = "npz")]
#[test]
fn npz() {
    replayed("npz", "fuzz.npz");
}

#[cfg(feature = "hdf5")]
#[test]
fn hdf5() {
    replayed("hdf5", "fuzz.h5");
}

#[cfg(feature = "mcap")]
#[test]
fn mcap() {
    replayed("mcap", "fuzz.mcap");
}
