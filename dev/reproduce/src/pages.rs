//! The book's page: what was measured stands in it as this command writes it, and a run says where it no longer does.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result};
use greybox_dev::book;

use super::Outcome;

pub(crate) const PAGE: &str = "reproduction.md";
const MEASURED: &str = "<!-- Written by cargo xtask reproduce --write-docs: what is measured. -->";
const STORY: &str = "<!-- Written by cargo xtask reproduce --write-docs: the story. -->";
const SAMPLING: &str = "<!-- Written by cargo xtask reproduce --write-docs: points against dimension. -->";
/// Below this a value is rounding, and its size means nothing.
const ROUNDING: f64 = 1e-9;
/// Columns of the story's table of runs that the page shows: design, model, steps, settling, error left, peak to peak,
/// effort.
const STORY_SHOWN: [usize; 7] = [0, 1, 2, 3, 5, 6, 9];
const SAMPLING_SHOWN: [usize; 10] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9];

/// Puts the tables of a whole run into the page.
///
/// # Errors
/// When the page cannot be read or written, or lacks a marker.
pub(crate) fn write(root: &Path, outcomes: &[Outcome]) -> Result<()> {
    for (marker, table) in tables(outcomes)? {
        book::put_table(root, PAGE, marker, &table)?;
    }
    Ok(())
}

/// Whether the page has the tables of a whole run.
///
/// # Errors
/// When the page cannot be read or lacks a marker.
pub(crate) fn is_current(root: &Path, outcomes: &[Outcome]) -> Result<bool> {
    for (marker, table) in tables(outcomes)? {
        if !book::is_table(root, PAGE, marker, &table)? {
            return Ok(false);
        }
    }
    Ok(true)
}

fn tables(outcomes: &[Outcome]) -> Result<[(&'static str, String); 3]> {
    Ok([
        (MEASURED, measured(outcomes)),
        (STORY, table(outcomes, "Story", 1, &STORY_SHOWN)?),
        (SAMPLING, table(outcomes, "Sampling", 0, &SAMPLING_SHOWN)?),
    ])
}

/// Every judged value with its bounds.
fn measured(outcomes: &[Outcome]) -> String {
    let mut out = String::from("| piece | judged | measured | bounds |\n| --- | --- | --- | --- |\n");
    for outcome in outcomes {
        for (k, check) in outcome.piece.checks.iter().enumerate() {
            let piece = if k == 0 { outcome.fixture.id.as_str() } else { "" };
            let bound = outcome.fixture.bounds.get(&check.name);
            let (bounds, why) = bound.map_or_else(Default::default, |b| {
                (
                    b.to_string().replace('-', "−"),
                    b.why.as_ref().map_or_else(String::new, |w| format!(": {w}")),
                )
            });
            let name = check.name.replace('|', "\\|");
            let _ = writeln!(out, "| {piece} | {name} | {} | {bounds}{why} |", short(check.measured));
        }
    }
    out
}

/// Columns of a table of a piece.
fn table(outcomes: &[Outcome], id: &str, index: usize, shown: &[usize]) -> Result<String> {
    let outcome =
        outcomes.iter().find(|o| o.fixture.id == id).with_context(|| format!("{id} was not made"))?;
    let table = outcome.piece.tables.get(index).with_context(|| format!("{id} has no table {index}"))?;
    let row = |cells: &[String], to: &dyn Fn(&str) -> String| {
        let shown = shown.iter().map(|i| cells.get(*i).map_or_else(String::new, |c| to(c)));
        format!("| {} |\n", shown.collect::<Vec<_>>().join(" | "))
    };
    let mut out = row(&table.headings, &str::to_owned);
    out.push_str(&format!("|{}\n", " --- |".repeat(shown.len())));
    for cells in &table.rows {
        out.push_str(&row(cells, &|cell| match cell.replace('−', "-").parse::<f64>() {
            Ok(value) => short(value),
            Err(_) => cell.to_owned(),
        }));
    }
    Ok(out)
}

/// Three digits.
fn short(value: f64) -> String {
    if !value.is_finite() {
        return "never".into();
    }
    if value != 0.0 && value.abs() < ROUNDING {
        return "rounding".into();
    }
    let scientific = format!("{value:.2e}");
    let rounded: f64 = scientific.parse().unwrap_or(value);
    let plain = (1e-3..1e6).contains(&rounded.abs()) || rounded == 0.0;
    (if plain { rounded.to_string() } else { scientific }).replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_has_three_digits() {
        for (value, text) in [
            (0.0, "0"),
            (0.58149, "0.581"),
            (-20.534, "−20.5"),
            (2.6304e-6, "2.63e−6"),
            (3.1e-15, "rounding"),
            (1_495_734.0, "1.50e6"),
            (300.0, "300"),
            (f64::INFINITY, "never"),
        ] {
            assert_eq!(short(value), text);
        }
    }
}
