//! The integration tests, in one program: to link one for each file takes longer than most of them run.
#![allow(missing_docs, clippy::unwrap_used)]

mod bad_files;
mod blocks;
#[cfg(any(feature = "npz", feature = "hdf5", feature = "mcap"))]
mod corpus;
mod files;
mod hdf5;
mod health;
mod mat;
mod mcap;
mod npz;
mod parquet;
mod real_recordings;
mod signals;
#[cfg(any(feature = "npz", feature = "hdf5", feature = "mcap"))]
mod sound;
