//! The corpus of the fuzz targets (`fuzz/corpus`) of the formats that not every build reads; xtask replays the others.

use crate::sound;
use std::path::{Path, PathBuf};

/// The files of a target.
fn corpus(target: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus").join(target);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    entries.map(|entry| entry.unwrap().path()).collect()
}

#[track_caller]
fn replayed(target: &str, name: &str) {
    let (mut read, mut refused) = (0, 0);
    for file in corpus(target) {
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
