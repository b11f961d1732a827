//! Reports of a diagnosis: JSON by contract and a self-contained HTML page.
//!
//! This crate turns a finished diagnosis into files and **decides nothing**: every number and every word of
//! the verdict comes in as plain data. [`Report`] is `report.json`; [`Page`] adds the signals and curves
//! that only the page shows.
//!
//! It depends on no other greybox crate, reads no file and prints nothing.

pub mod contract;
pub mod decimate;
pub mod diff;
pub mod expression;
pub mod format;
mod html;
pub mod page;
pub mod sentence;
pub mod svg;

pub use contract::Report;
pub use page::Page;

/// Why a report could not be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// The JSON text is malformed or misses a promised key; the source names line and column.
    #[error("report.json: {0}")]
    Json(#[from] serde_json::Error),
    /// The page could not be rendered.
    #[error("report.html: {0}")]
    Html(#[from] askama::Error),
}
