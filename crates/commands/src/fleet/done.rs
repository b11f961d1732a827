//! The mark of a finished diagnosis: what it was made from and what it wrote, so that the same work is not done twice.

use serde::{Deserialize, Serialize};

/// Name of the mark among the results.
pub const DONE: &str = "done.json";

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

    /// The same content under another name.
    pub(crate) fn called(&self, name: impl Into<String>) -> Fingerprint {
        Fingerprint { name: name.into(), fnv1a: self.fnv1a.clone() }
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

    /// The content of the result `wanted` where `read` gives a mark that says that it was made from `inputs`, and all
    /// results as they were written. Anything else, whatever it is, is no finished diagnosis.
    pub(crate) fn read(
        read: impl Fn(&str) -> Option<Vec<u8>>,
        inputs: &Inputs,
        wanted: &str,
    ) -> Option<String> {
        let done: Done = serde_json::from_slice(&read(DONE)?).ok()?;
        if done.inputs != *inputs {
            return None;
        }
        let mut found = None;
        for fingerprint in &done.results {
            let content = read(&fingerprint.name)?;
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
        let results: [(&str, &[u8]); 2] = [("a", b"1"), ("b", b"2")];
        let mark = serde_json::to_vec(&Done::new(inputs(b"x"), &results)).unwrap();
        let read = |files: &[(&str, &[u8])], recording: &[u8]| {
            let file = |name: &str| files.iter().find(|(n, _)| *n == name).map(|(_, c)| c.to_vec());
            Done::read(file, &inputs(recording), "b")
        };
        let whole = [results[0], results[1], (DONE, &mark)];
        assert_eq!(read(&[], b"x"), None, "nothing is there");
        assert_eq!(read(&whole, b"x").as_deref(), Some("2"));
        assert_eq!(read(&whole, b"y"), None, "another recording");
        assert_eq!(read(&[("a", b"3"), results[1], (DONE, &mark)], b"x"), None, "a result was changed");
        assert_eq!(read(&whole[1..], b"x"), None, "a result is gone");
        assert_eq!(
            read(&[results[0], results[1], (DONE, &mark[..mark.len() / 2])], b"x"),
            None,
            "half a mark"
        );
    }
}
