//! The corpus of the fuzz targets (`fuzz/corpus`), replayed on a stable compiler.

#[allow(unreachable_pub, reason = "a library of its own elsewhere")]
#[path = "../../fuzz/src/lib.rs"]
mod targets;

use std::path::PathBuf;

use rayon::prelude::*;

use greybox_dev::root;

/// The files of a target, sorted.
fn corpus(target: &str) -> Vec<PathBuf> {
    let folder = root().join("fuzz").join("corpus").join(target);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let mut files: Vec<PathBuf> = entries.map(|e| e.unwrap().path()).collect();
    files.sort();
    files
}

#[test]
fn what_the_fuzzer_found_stays_corrected() {
    for (target, check) in targets::TARGETS {
        let files = corpus(target);
        assert!(files.len() >= 10, "{target}: only {} files", files.len());
        let fails = |file: &&PathBuf| {
            let bytes = std::fs::read(file).unwrap();
            std::panic::catch_unwind(|| check(&bytes)).is_err()
        };
        let failed: Vec<&PathBuf> = files.par_iter().filter(fails).collect();
        assert!(failed.is_empty(), "{target}: {failed:?}");
    }
}

#[test]
fn every_target_has_a_binary_and_the_corpus_is_small() {
    let manifest = std::fs::read_to_string(root().join("fuzz").join("Cargo.toml")).unwrap();
    let manifest: toml::Table = toml::from_str(&manifest).unwrap();
    let binaries: Vec<&str> =
        manifest["bin"].as_array().unwrap().iter().map(|b| b["name"].as_str().unwrap()).collect();
    assert_eq!(binaries, targets::TARGETS.map(|t| t.0));
    let bytes: u64 =
        binaries.iter().flat_map(|t| corpus(t)).map(|f| std::fs::metadata(f).unwrap().len()).sum();
    assert!(bytes < 1_000_000, "the corpus has {bytes} bytes; minimise it (fuzz/README.md)");
}
