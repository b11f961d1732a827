//! Reports of a diagnosis, an identification or a controller: JSON by contract and a self-contained HTML page.
//!
//! This crate turns a finished diagnosis (or identification) into files and **decides nothing**: every number and every word of
//! the verdict comes in as plain data. [`Report`] is `report.json`; [`Page`] adds the signals and curves
//! that only the page shows.
//!
//! - [`contract`]: the types of `report.json` and its JSON schema
//! - [`identified`]: the same for an identification: [`IdentifyReport`]
//! - [`control`]: what the page of a controller shows; [`ControlPage::to_html`] writes it
//! - [`merge`]: many reports as one [`Summary`], by [`merge::map`] and [`merge::reduce`]; [`mod@summary`] has its types,
//!   `greybox-fleet` the statistics
//! - [`page`]: what the page shows beside it; [`Page::to_html`] writes the file
//! - [`sentence`]: the conclusion in plain language, to fill [`Report::summary`]
//! - [`suggest`]: the experiment that separates a mechanism from its alternatives
//! - [`mod@format`], [`expression`], [`decimate`], [`diff`], [`svg`]: the pure functions underneath
//!
//! ```
//! use greybox_report::{Report, sentence};
//!
//! let json = r#"{
//!   "verdict": "consistent", "mechanisms": [],
//!   "remainder": {"significant": false, "location": {}, "share_of_residual": 0.01},
//!   "parameters": {}, "noise_floor": {"theta": 0.015},
//!   "fit": {"train":   {"nominal": {}, "calibrated": {}, "improved": {}},
//!           "holdout": {"nominal":    {"theta": {"nrmse": 0.31}},
//!                       "calibrated": {"theta": {"nrmse": 0.016}}, "improved": {}}}
//! }"#;
//! let report = Report::from_json(json)?;
//! assert_eq!(sentence::summary(&report)[1], "Calibration changes the held-out error from 31 % to 1.6 %.");
//! # Ok::<(), greybox_report::ReportError>(())
//! ```
//!
//! [`convert`] fills these types from a finished diagnosis; nothing here decides, reads a file or prints.

/// The examples of the README are compiled and run with the documentation.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub mod compare;
mod comparison;
pub mod contract;
pub mod control;
pub mod convert;
pub mod decimate;
pub mod diff;
pub mod expression;
pub mod format;
mod html;
pub mod identified;
mod machines;
pub mod merge;
pub mod notes;
pub mod page;
pub mod sentence;
pub mod suggest;
pub mod summary;
pub mod svg;

pub use comparison::Comparison;
pub use contract::Report;
pub use control::ControlPage;
pub use identified::IdentifyReport;
pub use page::{IdentifyPage, Page};
pub use summary::Summary;

/// Why a report could not be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// The JSON text is malformed or misses a promised key; the source names line and column.
    #[error("report.json: {0}")]
    Json(#[from] serde_json::Error),
    /// A later version wrote it.
    #[error(
        "report.json: greybox {version} wrote it with schema {schema}, and this version reads schemas up to {}",
        contract::SCHEMA
    )]
    Newer {
        /// Version of greybox that wrote it.
        version: String,
        /// Version of the document.
        schema: u32,
    },
    /// The page could not be rendered.
    #[error("report.html: {0}")]
    Html(#[from] askama::Error),
}
