//! The table of the book's page on speed.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Result;

use super::{Report, duration, long, scale};
use greybox_dev::book;

/// The page.
const NAME: &str = "speed.md";
/// Marker of the table.
const BEGIN: &str = "<!-- Made by `cargo xtask bench --peers --write-docs`; do not edit. -->";
/// Marker of the table of cost against length.
const SCALE: &str = "<!-- Made by `cargo xtask bench --scale --write-docs`; do not edit. -->";

/// Marker of the table of a diagnosis's cost against length.
const LONG: &str = "<!-- Made by `cargo xtask bench --long --write-docs`; do not edit. -->";

/// Puts the table between the markers.
pub(super) fn write(root: &Path, report: &Report) -> Result<()> {
    book::put_table(root, NAME, BEGIN, &table(report))
}

/// The same of cost against length, with its plot.
pub(crate) fn write_scale(root: &Path, lengths: &[scale::Length]) -> Result<()> {
    book::put_table(root, NAME, SCALE, &scale::table(lengths))?;
    book::put_file(root, "speed-scale.svg", &scale::plot(lengths)?)
}

/// The same of a diagnosis.
pub(crate) fn write_long(root: &Path, lengths: &[long::Length]) -> Result<()> {
    book::put_table(root, NAME, LONG, &long::table(lengths))
}

fn table(report: &Report) -> String {
    let mut text = format!("Machine: {}, {} cores.\n", report.machine.processor, report.machine.cores);
    if let Some(peak) = report.peak {
        let _ = writeln!(text, "Peak of one core: {:.0}·10⁹ operations a second.", 1e-9 * peak);
    }
    text += "\n| what | greybox | beside | theirs | ratio | goal | |\n|---|---|---|---|---|---|---|\n";
    for row in &report.rows {
        let ours = format!("{} per {}", duration(row.ours), row.unit);
        if row.comparisons.is_empty() {
            let _ = writeln!(text, "| {} | {ours} | | | | | |", row.what);
        }
        for (i, c) in row.comparisons.iter().enumerate() {
            let (what, ours) = if i == 0 { (row.what.as_str(), ours.as_str()) } else { ("", "") };
            let theirs = c.theirs.map_or_else(String::new, duration);
            let (ratio, goal) = (c.times(c.ratio), c.times(c.goal));
            let _ = writeln!(
                text,
                "| {what} | {ours} | {} | {theirs} | {ratio} | {goal} | {} |",
                c.with,
                c.verdict()
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_the_markers_of_its_tables() {
        assert!([BEGIN, SCALE, LONG].iter().all(|begin| book::has_table(&greybox_dev::root(), NAME, begin)));
    }
}
