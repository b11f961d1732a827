//! The mark of a finished diagnosis: what it was made from and what it wrote, so that the same work is not done twice.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

/// Name of the mark among the results.
pub(crate) const FILE: &str = "done.json";

/// The content of a mark.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Done {
    /// Everything that the results depend on.
    pub(crate) inputs: Inputs,
    /// The results beside the mark.
    results: Vec<Fingerprint>,
}

/// Everything that the results of a diagnosis depend on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Inputs {
    /// Version of greybox.
    pub(crate) greybox: String,
    pub(crate) seed: u64,
    /// Most work of the search, in operations.
    pub(crate) work: u64,
    pub(crate) model: Fingerprint,
    pub(crate) recording: Fingerprint,
    pub(crate) holdout: Vec<Fingerprint>,
    /// New names of channels.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) map: Vec<String>,
    /// Channels that alone were read.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) channels: Vec<String>,
    /// Mechanisms beside the built-in ones.
    pub(crate) mechanisms: Vec<Fingerprint>,
}

/// A file by its name and its content.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Fingerprint {
    name: String,
    /// [`fnv1a`] of the content, in hexadecimal digits.
    fnv1a: String,
}

impl Fingerprint {
    pub(crate) fn of(name: impl Into<String>, content: &[u8]) -> Fingerprint {
        Fingerprint { name: name.into(), fnv1a: format!("{:032x}", fnv1a(content)) }
    }
}

/// The hash FNV-1a of 128 bits (G. Fowler, L. C. Noll, K.-P. Vo, <http://www.isthe.com/chongo/tech/comp/fnv/>): it tells
/// files apart that differ by accident, and does not resist one who makes two files of one hash.
fn fnv1a(content: &[u8]) -> u128 {
    const BASIS: u128 = 0x6c62_272e_07bb_0142_62b8_2175_6295_c58d;
    const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
    content.iter().fold(BASIS, |hash, byte| (hash ^ u128::from(*byte)).wrapping_mul(PRIME))
}

impl Done {
    /// The mark of results (name, content).
    pub(crate) fn new(inputs: Inputs, results: &[(&str, &[u8])]) -> Done {
        Done {
            inputs,
            results: results.iter().map(|&(name, content)| Fingerprint::of(name, content)).collect(),
        }
    }

    /// The content of the file `wanted` in a folder whose mark says that it was made from `inputs`, and whose results are
    /// all as they were written. Anything else, whatever it is, is no finished diagnosis.
    pub(crate) fn read(folder: &Path, inputs: &Inputs, wanted: &str) -> Option<String> {
        let done: Done = serde_json::from_slice(&fs::read(folder.join(FILE)).ok()?).ok()?;
        if done.inputs != *inputs {
            return None;
        }
        let mut found = None;
        for fingerprint in &done.results {
            let content = fs::read(folder.join(&fingerprint.name)).ok()?;
            if Fingerprint::of(fingerprint.name.clone(), &content) != *fingerprint {
                return None;
            }
            if fingerprint.name == wanted {
                found = String::from_utf8(content).ok();
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Test vectors of the authors.
    #[test]
    fn the_hash_is_fnv1a() {
        assert_eq!(fnv1a(b""), 0x6c62272e07bb014262b821756295c58d);
        assert_eq!(fnv1a(b"foobar"), 0x343e1662793c64bf6f0d3597ba446f18);
    }

    fn inputs(recording: &[u8]) -> Inputs {
        Inputs {
            greybox: "0.1.0".into(),
            seed: 0,
            work: 1,
            model: Fingerprint::of("m.toml", b"model"),
            recording: Fingerprint::of("r.csv", recording),
            holdout: vec![],
            map: vec![],
            channels: vec![],
            mechanisms: vec![],
        }
    }

    #[test]
    fn only_whole_results_of_the_same_inputs_are_taken() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        let results: [(&str, &[u8]); 2] = [("a", b"1"), ("b", b"2")];
        let mark = serde_json::to_vec(&Done::new(inputs(b"x"), &results)).unwrap();
        let write = || {
            results.iter().for_each(|(name, content)| fs::write(path.join(name), content).unwrap());
            fs::write(path.join(FILE), &mark).unwrap();
        };
        assert_eq!(Done::read(path, &inputs(b"x"), "b"), None, "nothing is there");
        write();
        assert_eq!(Done::read(path, &inputs(b"x"), "b").as_deref(), Some("2"));
        assert_eq!(Done::read(path, &inputs(b"y"), "b"), None, "another recording");
        fs::write(path.join("a"), "3").unwrap();
        assert_eq!(Done::read(path, &inputs(b"x"), "b"), None, "a result was changed");
        fs::remove_file(path.join("a")).unwrap();
        assert_eq!(Done::read(path, &inputs(b"x"), "b"), None, "a result is gone");
        write();
        fs::write(path.join(FILE), &mark[..mark.len() / 2]).unwrap();
        assert_eq!(Done::read(path, &inputs(b"x"), "b"), None, "half a mark");
    }
}
