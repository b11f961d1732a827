//! Recordings of experiments: time series with units, read from files, checked and smoothed.
//!
//! A recording is one continuous experiment: a strictly increasing time tᵢ and, for every channel c, the
//! samples y_c(tᵢ) in the channel's unit, some of them missing (NaN). The reader turns it into *pieces*, each
//! on a uniform grid with the step Δt that all pieces of the recording share,
//!
//! ```text
//! t = start + k Δt ,   k = 0 … len − 1 ,
//! ```
//!
//! so that everything downstream (differences, filters, simulation) may rely on a constant step and never
//! works across a gap.
//!
//! | module | what it answers |
//! |---|---|
//! | [`csv`](mod@csv) | what stands in the file, or exactly which cell is wrong and how to fix it |
//! | `mat`, `hdf5`, `npz`, `mcap`, `parquet` | the same for MAT-files, HDF5, arrays of NumPy, MCAP logs and Parquet files, each behind a feature of its name |
//! | [`noise`] | how large the measurement noise is, and whether a channel is quantised |
//! | [`smooth`] | value, first and second derivative of a noisy channel (Savitzky–Golay) |
//! | [`interpolate`] | what an input did between its samples (band-limited, linear) |
//! | [`health`] | is this recording good enough to identify anything from, in plain sentences |
//!
//! The functions of `noise`, `smooth` and `interpolate` take slices and return values; only [`read()`] and
//! [`csv`](mod@csv) touch files.
//!
//! ```
//! use greybox_recording::{health, parse_csv};
//! let mut text = String::from("t,u [V],y [m]\n");
//! for k in 0..200 {
//!     let t = 0.01 * f64::from(k);
//!     text += &format!("{t:.2},{:.4},{:.5}\n", (9.0 * t).sin(), 0.1 * (9.0 * t - 0.4).sin());
//! }
//! let recording = parse_csv(text.as_bytes(), "run1.csv")?;
//! assert_eq!(recording.pieces.len(), 1);
//! assert_eq!(recording.pieces[0].dt, 0.01);
//! for finding in health::check(&recording, &["u"], &["y"]) {
//!     println!("{finding}");
//! }
//! # Ok::<(), greybox_recording::RecordingError>(())
//! ```

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

mod character;
mod clocks;
mod columns;
mod correlation;
pub mod csv;
mod episode;
mod error;
mod file;
mod finding;
mod grid;
#[cfg(feature = "hdf5")]
pub mod hdf5;
mod header;
pub mod health;
pub mod interpolate;
#[cfg(feature = "mat")]
mod layout;
mod location;
#[cfg(feature = "mat")]
pub mod mat;
#[cfg(feature = "mcap")]
pub mod mcap;
mod median;
pub mod noise;
#[cfg(feature = "npz")]
pub mod npz;
#[cfg(any(feature = "hdf5", feature = "npz"))]
mod number;
mod outliers;
#[cfg(feature = "parquet")]
pub mod parquet;
mod read;
mod recording;
mod rename;
mod selection;
pub mod smooth;
mod spectrum;
mod stamp;
#[cfg(feature = "mat")]
mod variables;

pub use crate::character::{Character, character};
pub use crate::clocks::{Clock, Series};
pub use crate::correlation::Correlation;
pub use crate::csv::{CsvBlocks, CsvLines, parse_csv, read_csv, write_csv, write_csv_file};
pub use crate::episode::episodes;
#[cfg(feature = "parquet")]
pub use crate::episode::parse_episodes;
pub use crate::error::{Place, RecordingError};
pub use crate::file::{content, is_device, write_whole};
pub use crate::finding::{Finding, Severity, listed};
#[cfg(feature = "hdf5")]
pub use crate::hdf5::parse_hdf5;
pub use crate::location::{EXTENSIONS, Location};
#[cfg(feature = "mat")]
pub use crate::mat::parse_mat;
#[cfg(feature = "mcap")]
pub use crate::mcap::parse_mcap;
#[cfg(feature = "npz")]
pub use crate::npz::parse_npz;
#[cfg(feature = "parquet")]
pub use crate::parquet::parse_parquet;
pub use crate::read::{parse, parse_episode, read, read_selected};
pub use crate::recording::{Channel, MIN_SAMPLES, Piece, Recording, SIZES};
pub use crate::rename::{Rename, RenameError};
pub use crate::selection::Selection;
pub use crate::stamp::{ROOM, Stamp, Zone};
