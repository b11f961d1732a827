//! `cargo xtask docs`: the pages of the book that are made from the sources.

mod kind;

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use greybox_diagnose::{Mechanism, library};
use greybox_report::format;

use greybox_dev::Ending;

/// The model that the pages show each mechanism in: a motor that turns a load through a shaft.
const EXAMPLE: &str = r#"name = "Motor, shaft and load"

[inputs]
u = { unit = "V" }

[states]
q1 = { unit = "rad" }
q2 = { unit = "rad" }

[parameters]
J1 = { value = 0.002, unit = "kg m^2" }
J2 = { value = 0.001, unit = "kg m^2" }
b  = { value = 0.01, unit = "N m s" }
c  = { value = 0.001, unit = "N m s" }
k  = { value = 1.2, unit = "N m" }
kt = { value = 0.5, unit = "N m/V" }

[equations]
motor = "J1*q1'' + b*q1' + c*(q1' - q2') + k*(q1 - q2) = kt*u"
load  = "J2*q2'' - c*(q1' - q2') - k*(q1 - q2) = 0"
"#;

/// One kind with all its files: (file, mechanism).
#[derive(Debug)]
struct Kind {
    name: String,
    forms: Vec<(String, Mechanism)>,
}

/// Writes the generated pages, or with `check` says which are stale.
///
/// # Errors
/// When a source cannot be read, or a page cannot be written.
pub(crate) fn run(root: &Path, check: bool) -> Result<Ending> {
    let mut ending = Ending::Done;
    for (path, wanted) in pages(root)? {
        let shown = path.strip_prefix(root).unwrap_or(&path).display();
        if is_current(&path, wanted.as_deref()) {
            continue;
        }
        if check {
            eprintln!("error: {shown} is stale; run `cargo xtask docs` and commit it");
            ending = Ending::Missed;
            continue;
        }
        let written = match &wanted {
            Some(text) => {
                if let Some(folder) = path.parent() {
                    std::fs::create_dir_all(folder)?;
                }
                std::fs::write(&path, text)
            }
            None => std::fs::remove_file(&path),
        };
        written.with_context(|| format!("{shown} cannot be written"))?;
        println!("{shown} {}", if wanted.is_some() { "written" } else { "removed" });
    }
    Ok(ending)
}

/// Whether the file at `path` holds this text, or where none is wanted does not exist.
pub(crate) fn is_current(path: &Path, wanted: Option<&str>) -> bool {
    let present = std::fs::read_to_string(path).ok().map(|text| text.replace("\r\n", "\n"));
    present.as_deref() == wanted
}

/// Every generated page with its text, `None` for one whose kind is gone.
///
/// # Errors
/// When a mechanism file or the book cannot be read.
pub(crate) fn pages(root: &Path) -> Result<Vec<(PathBuf, Option<String>)>> {
    let book = root.join("docs").join("src");
    let kinds = kinds()?;
    let summary = book.join("SUMMARY.md");
    let text =
        std::fs::read_to_string(&summary).with_context(|| format!("{} cannot be read", summary.display()))?;
    let mut pages = vec![
        (summary, Some(contents(&text.replace("\r\n", "\n"), &kinds))),
        (book.join("mechanisms.md"), Some(index(&kinds)?)),
    ];
    let folder = book.join("mechanisms");
    for kind in &kinds {
        pages.push((folder.join(format!("{}.md", kind.name)), Some(kind::page(kind, &kinds)?)));
    }
    for entry in std::fs::read_dir(&folder).into_iter().flatten() {
        let path = entry?.path();
        if !pages.iter().any(|(page, _)| *page == path) {
            pages.push((path, None));
        }
    }
    Ok(pages)
}

/// The built-in mechanisms by kind, in the order of the families and kinds.
fn kinds() -> Result<Vec<Kind>> {
    let mut by_kind: BTreeMap<(String, String), Vec<(String, Mechanism)>> = BTreeMap::new();
    for (file, mechanism) in library::built_in_files().zip(library::built_in()?) {
        if !mechanism.named || !mechanism.doubts.is_empty() {
            continue; // never named, so without a page
        }
        let key = (mechanism.family.clone(), mechanism.kind.clone());
        by_kind.entry(key).or_default().push((file.to_owned(), mechanism));
    }
    Ok(by_kind.into_iter().map(|((_, name), forms)| Kind { name, forms }).collect())
}

impl Kind {
    fn family(&self) -> &str {
        self.forms.first().map_or("", |(_, m)| m.family.as_str())
    }
}

/// The table of contents with one line per kind under the page of mechanisms.
fn contents(present: &str, kinds: &[Kind]) -> String {
    let mut text = String::new();
    for line in present.lines().filter(|line| !line.contains("](mechanisms/")) {
        text.push_str(line);
        text.push('\n');
        if line.contains("](mechanisms.md)") {
            for kind in kinds {
                text.push_str(&format!("  - [{}](mechanisms/{}.md)\n", format::kind(&kind.name), kind.name));
            }
        }
    }
    text
}

/// The index: by family a table of kinds and laws, and the example model.
fn index(kinds: &[Kind]) -> Result<String> {
    let mut page = String::from(
        "# Mechanisms\n\n\
         <!-- Made by `cargo xtask docs` from crates/diagnose/mechanisms; do not edit. -->\n\n\
         What a diagnosis can name: one page per kind. A force stands on the left side of its equation. `d` is \
         the motion it\nacts on (a coordinate, or a difference of coordinates), `o` another coordinate, `u` an \
         input, `y` a measurement, `p` a\nparameter, `k` the constant of a spring and `load` the force that a \
         joint transmits. Kinds of your own are\n[files of the same form](your-own-mechanism.md).\n",
    );
    let mut family = "";
    for kind in kinds {
        if kind.family() != family {
            family = kind.family();
            write!(
                page,
                "\n## {}\n\n| kind | acts on | law |\n|---|---|---|\n",
                capital(&family.replace('_', " "))
            )?;
        }
        for (i, (_, m)) in kind.forms.iter().enumerate() {
            let name = match i {
                0 => format!("[{}](mechanisms/{}.md)", format::kind(&kind.name), kind.name),
                _ => String::new(),
            };
            let states: Vec<String> = m.states.iter().map(|s| format!(", `{} = {}`", s.lhs, s.rhs)).collect();
            writeln!(page, "| {name} | {} | `{}`{} |", m.on.name(), m.law, states.concat())?;
        }
    }
    write!(
        page,
        "\n## The example\n\nThe pages show what `improved.toml` says when a mechanism is found in this \
         model:\n\n```toml\n{EXAMPLE}```\n"
    )?;
    Ok(page)
}

/// With a capital first letter.
fn capital(text: &str) -> String {
    let mut chars = text.chars();
    chars.next().map_or_else(String::new, |c| c.to_uppercase().chain(chars).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_contents_list_every_kind_once() {
        let kinds = kinds().unwrap();
        let given = "- [A](a.md)\n- [Mechanisms](mechanisms.md)\n  - [Old](mechanisms/old.md)\n- [B](b.md)\n";
        let once = contents(given, &kinds);
        assert!(!once.contains("old.md") && once.ends_with("- [B](b.md)\n"));
        assert_eq!(once.matches("](mechanisms/").count(), kinds.len());
        assert_eq!(contents(&once, &kinds), once);
    }

    #[test]
    fn every_kind_has_a_page_that_shows_it_in_the_example() {
        for kind in kinds().unwrap() {
            let page = kind::page(&kind, &[]).unwrap();
            assert_eq!(page.matches("```toml,part").count(), kind.forms.len(), "{page}");
            for (file, m) in &kind.forms {
                for parameter in m.parameters() {
                    assert!(page.contains(&format!("| `{parameter}` | ")), "{file}: {parameter}");
                }
            }
        }
    }
}
