//! `cargo xtask docs`: the pages of the book that are made from the sources.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use toml::Table;

use crate::Ending;

/// Writes the generated pages, or with `check` says which are stale.
///
/// # Errors
/// When a source cannot be read, or a page cannot be written.
pub(crate) fn run(root: &Path, check: bool) -> Result<Ending> {
    let (path, wanted) = (page_path(root), mechanisms_page(root)?);
    if std::fs::read_to_string(&path).is_ok_and(|present| present == wanted) {
        println!("{} is up to date", path.display());
        return Ok(Ending::Done);
    }
    if check {
        eprintln!("error: {} is stale; run `cargo xtask docs` and commit it", path.display());
        return Ok(Ending::Missed);
    }
    std::fs::write(&path, wanted).with_context(|| format!("{} cannot be written", path.display()))?;
    println!("{} written", path.display());
    Ok(Ending::Done)
}

/// The page of the mechanisms.
pub(crate) fn page_path(root: &Path) -> PathBuf {
    root.join("docs").join("src").join("mechanisms.md")
}

/// The mechanism files, sorted by name.
pub(crate) fn mechanism_files(root: &Path) -> Result<Vec<PathBuf>> {
    let folder = root.join("crates").join("diagnose").join("mechanisms");
    let mut files = Vec::new();
    for entry in std::fs::read_dir(&folder).with_context(|| format!("{} cannot be read", folder.display()))? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == "toml") {
            files.push(path);
        }
    }
    files.sort();
    if files.is_empty() {
        bail!("{} holds no mechanism", folder.display());
    }
    Ok(files)
}

/// The text of the page: by family a table, then one section per mechanism.
pub(crate) fn mechanisms_page(root: &Path) -> Result<String> {
    let mut mechanisms = Vec::new();
    for path in mechanism_files(root)? {
        let read = || -> Result<Table> { Ok(toml::from_str(&std::fs::read_to_string(&path)?)?) };
        mechanisms.push(read().with_context(|| path.display().to_string())?);
    }
    let mut families: Vec<&str> = mechanisms.iter().map(|m| text(m, "family")).collect();
    families.sort_unstable();
    families.dedup();
    let mut page = String::from(
        "# Mechanisms\n\n\
         <!-- Made by `cargo xtask docs` from crates/diagnose/mechanisms; do not edit. -->\n\n\
         What a diagnosis can name. A force stands on the left side of its equation; `d` is the motion it acts\n\
         on (a coordinate, or a difference of coordinates), `u` the input and `y` the measurement that a\n\
         replacement stands in for. Each row is one file of `crates/diagnose/mechanisms`.\n\n\
         | family | kind | acts on | law |\n|---|---|---|---|\n",
    );
    let of = |family: &str| {
        let family = family.to_owned();
        mechanisms.iter().filter(move |m| text(m, "family") == family)
    };
    for family in &families {
        for m in of(family) {
            let kind = text(m, "kind");
            writeln!(page, "| {} | [`{kind}`](#{kind}) | {} | `{}` |", words(family), text(m, "on"), law(m))?;
        }
    }
    for family in &families {
        write!(page, "\n## {}\n", words(family))?;
        for m in of(family) {
            section(&mut page, m)?;
        }
    }
    Ok(page)
}

fn section(page: &mut String, m: &Table) -> std::fmt::Result {
    let empty = Table::new();
    let table = |key: &str| m.get(key).and_then(toml::Value::as_table).unwrap_or(&empty);
    let role = if m.contains_key("replace") { "replacement" } else { "force" };
    write!(page, "\n### {}\n\n{role}: `{}`\n\n", text(m, "kind"), law(m))?;
    let about = table("about");
    writeln!(page, "- **in the data:** {}", text(about, "signature"))?;
    let parameters: Vec<String> = list(m, "linear")
        .into_iter()
        .chain(table("inner").keys().map(String::as_str))
        .map(|name| {
            let positive = if list(m, "positive").contains(&name) { " ≥ 0" } else { "" };
            format!("`{name}`{positive}")
        })
        .collect();
    writeln!(page, "- **parameters:** {}", parameters.join(", "))?;
    for (key, words) in [("refines", "refines"), ("require", "never negative")] {
        let items: Vec<String> = list(m, key).into_iter().map(|i| format!("`{i}`")).collect();
        if !items.is_empty() {
            writeln!(page, "- **{words}:** {}", items.join(", "))?;
        }
    }
    let confused: Vec<String> = list(about, "confused_with").into_iter().map(|k| format!("`{k}`")).collect();
    if !confused.is_empty() {
        writeln!(page, "- **taken for:** {}", confused.join(", "))?;
    }
    writeln!(page, "- **what separates them:** {}", text(about, "separate"))
}

fn text<'a>(table: &'a Table, key: &str) -> &'a str {
    table.get(key).and_then(toml::Value::as_str).unwrap_or("")
}

fn law(m: &Table) -> &str {
    if m.contains_key("force") { text(m, "force") } else { text(m, "replace") }
}

fn words(name: &str) -> String {
    name.replace('_', " ")
}

fn list<'a>(table: &'a Table, key: &str) -> Vec<&'a str> {
    let values = table.get(key).and_then(toml::Value::as_array);
    values.map(|v| v.iter().filter_map(toml::Value::as_str).collect()).unwrap_or_default()
}
