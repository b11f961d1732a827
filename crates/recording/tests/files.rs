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
