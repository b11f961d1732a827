//! The table of the book's page on speed.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result, bail};

use super::{Report, duration, scale};

const BEGIN: &str = "<!-- Made by `cargo xtask bench --peers --write-docs`; do not edit. -->";
const SCALE: &str = "<!-- Made by `cargo xtask bench --scale --write-docs`; do not edit. -->";
const END: &str = "<!-- End of the table. -->";

/// Puts the table between the markers of `docs/src/speed.md`.
pub(crate) fn write(root: &Path, report: &Report) -> Result<()> {
    put(root, BEGIN, &table(report))
}

/// The same of cost against length, with its plot.
pub(crate) fn write_scale(root: &Path, lengths: &[scale::Length]) -> Result<()> {
    put(root, SCALE, &scale::table(lengths))?;
    let path = root.join("docs").join("src").join("speed-scale.svg");
    std::fs::write(&path, scale::plot(lengths)?)
        .with_context(|| format!("{} cannot be written", path.display()))
}

fn put(root: &Path, begin: &str, table: &str) -> Result<()> {
    let path = root.join("docs").join("src").join("speed.md");
    let page =
        std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
    let page = between(&page, begin, table).with_context(|| path.display().to_string())?;
    std::fs::write(&path, page).with_context(|| format!("{} cannot be written", path.display()))
}

fn between(page: &str, begin: &str, table: &str) -> Result<String> {
    let parts = page.split_once(begin).and_then(|(head, rest)| Some((head, rest.split_once(END)?.1)));
    let Some((head, tail)) = parts else { bail!("the markers of the table are missing") };
    Ok(format!("{head}{begin}\n\n{table}\n{END}{tail}"))
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
    fn the_table_stands_between_its_markers() {
        let page = format!("# Speed\n{BEGIN}\nold\n{END}\nrest\n");
        let new = between(&page, BEGIN, "| new |\n").unwrap();
        assert!(new.contains("| new |") && !new.contains("old") && new.ends_with("rest\n"));
        assert_eq!(between(&new, BEGIN, "| new |\n").unwrap(), new);
        assert!(between("# Speed\n", BEGIN, "").is_err());
    }

    #[test]
    fn the_page_has_its_markers() {
        let page = std::fs::read_to_string(crate::root().join("docs").join("src").join("speed.md")).unwrap();
        assert!(between(&page, BEGIN, "").is_ok() && between(&page, SCALE, "").is_ok());
    }
}
