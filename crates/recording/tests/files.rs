//! What tests of file formats share.
#![cfg(feature = "mat")]

use greybox_recording::Recording;

pub(crate) fn headers(recording: &Recording) -> Vec<String> {
    recording.channels.iter().map(|c| c.header()).collect()
}

/// Time, voltage and angle of 60 samples, to the bit as NumPy made them, from the bytes of `samples.bin`.
#[cfg(any(feature = "hdf5", feature = "npz"))]
pub(crate) fn samples(bytes: &[u8]) -> [Vec<f64>; 3] {
    let numbers: Vec<f64> =
        bytes.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect();
    [0, 60, 120].map(|at| numbers[at..at + 60].to_vec())
}

/// Sees that a channel has the samples at every `every`th instant, to the bit, and nothing else.
#[track_caller]
pub(crate) fn stands_at_every(recording: &Recording, channel: &str, every: usize, samples: &[f64]) {
    let values = &recording.channel(channel).unwrap().values;
    for (k, value) in values.iter().enumerate() {
        let wanted = if k % every == 0 { samples.get(k / every).copied() } else { None };
        assert_eq!(value.to_bits(), wanted.unwrap_or(f64::NAN).to_bits(), "{channel} {k}");
    }
    let there = values.iter().filter(|value| !value.is_nan()).count();
    assert!(there >= values.len().div_ceil(every), "{channel}: {there}");
}

/// The numbers of every third of 60 instants, and whether the first of them is past 30.
pub(crate) fn third(values: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let closed = (0..20).map(|k| f64::from(u8::from(3 * k > 30)));
    (values.iter().step_by(3).copied().collect(), closed.collect())
}

/// What was done to the clocks, in words.
pub(crate) fn told(recording: &Recording) -> String {
    let told = recording.warnings.iter().filter(|w| w.code == "clocks").map(|w| w.message.as_str());
    told.collect::<Vec<_>>().join("\n")
}
