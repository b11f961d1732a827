//! Reports that differ as a test wants them to.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use std::sync::OnceLock;

use greybox_report::contract::{Estimate, Interval, Report};

use crate::sample;

/// The sample's report, whose signals take a while to make.
pub(crate) fn sampled() -> &'static Report {
    static REPORT: OnceLock<Report> = OnceLock::new();
    REPORT.get_or_init(|| sample::page().report)
}

/// The sample's report with this much friction.
pub(crate) fn with_friction(fc: f64, half: f64) -> Report {
    let mut report = sampled().clone();
    let estimate =
        Estimate { value: fc, ci95: Some(Interval::new(fc - half, fc + half)), unit: "N m".into() };
    report.mechanisms[0].parameters.insert("fc".into(), estimate);
    report
}
