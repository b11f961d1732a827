//! What commands write into pages of the book: tables between markers, and figures.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

const END: &str = "<!-- End of the table. -->";

fn place(root: &Path, name: &str) -> PathBuf {
    root.join("docs").join("src").join(name)
}

/// Whether a page has the marker `begin` and that of the table's end.
#[must_use]
pub fn has_table(root: &Path, page: &str, begin: &str) -> bool {
    std::fs::read_to_string(place(root, page)).is_ok_and(|text| between(&text, begin, "").is_ok())
}

/// Puts a table behind the marker `begin` of a page, in the stead of what is there up to the marker of its end.
///
/// # Errors
/// When the page cannot be read or written, or lacks a marker.
pub fn put_table(root: &Path, page: &str, begin: &str, table: &str) -> Result<()> {
    let path = place(root, page);
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
    let text = between(&text, begin, table).with_context(|| path.display().to_string())?;
    put_file(root, page, &text)
}

/// Whether a page has this table behind the marker `begin`.
///
/// # Errors
/// When the page cannot be read or lacks a marker.
pub fn is_table(root: &Path, page: &str, begin: &str, table: &str) -> Result<bool> {
    let path = place(root, page);
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
    Ok(between(&text, begin, table).with_context(|| path.display().to_string())? == text)
}

/// Writes a file beside the pages.
///
/// # Errors
/// When it cannot be written.
pub fn put_file(root: &Path, name: &str, text: &str) -> Result<()> {
    let path = place(root, name);
    std::fs::write(&path, text).with_context(|| format!("{} cannot be written", path.display()))
}

fn between(page: &str, begin: &str, table: &str) -> Result<String> {
    let parts = page.split_once(begin).and_then(|(head, rest)| Some((head, rest.split_once(END)?.1)));
    let Some((head, tail)) = parts else { bail!("the markers of the table are missing") };
    Ok(format!("{head}{begin}\n\n{table}\n{END}{tail}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_stands_between_its_markers() {
        let begin = "<!-- Made. -->";
        let page = format!("# Speed\n{begin}\nold\n{END}\nrest\n");
        let new = between(&page, begin, "| new |\n").unwrap();
        assert!(new.contains("| new |") && !new.contains("old") && new.ends_with("rest\n"));
        assert_eq!(between(&new, begin, "| new |\n").unwrap(), new);
        assert!(between("# Speed\n", begin, "").is_err());
    }
}
