//! `cargo xtask reproduce`: every table and figure of the thesis that can honestly be made again, beside its
//! numbers, judged against the bounds in `fixtures/thesis`.
//!
//! One table or figure is one function that returns a `Piece`; the chapters list theirs. What the thesis
//! prints stands in `fixtures/thesis/*.json`, corrected by the errata that each file names; what we measure
//! stands in the piece, and its bounds in the file. Nothing is random but for fixed seeds.

// A command that measures: its answers go to standard output, its complaints to standard error.
#![allow(clippy::disallowed_methods, clippy::print_stdout, clippy::print_stderr)]

mod algorithm2;
mod chapter2;
mod chapter3;
mod chapter4;
mod delayed;
mod delayed_joint;
mod duffing;
mod fixture;
mod index;
pub mod link;
mod optimal;
mod pages;
mod prose;
mod sampling;
mod sliding;
mod story;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

pub use self::chapter2::relative_rms;
pub use self::optimal::F16;
use fixture::Fixture;
use greybox_dev::{Ending, median};

/// What `reproduce` takes.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Only this table or figure, for example "Table 2.1" (may be given more than once)
    #[arg(long, value_name = "ID")]
    only: Vec<String>,
    /// Where to write [default: target/reproduction]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// What `greybox demo link --out DIR` left: the story reads its models in place of diagnosing again
    #[arg(long, value_name = "DIR")]
    demo: Option<PathBuf>,
    /// Write what is measured into the book (a whole run, with --demo)
    #[arg(long, requires = "demo", conflicts_with = "only")]
    write_docs: bool,
}

/// How a table or figure stands to that of the thesis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Status {
    /// Made again from the same experiment.
    Reproduced,
    /// Made from a virtual rig, because the recordings are not public.
    VirtualRig,
    /// Data-sheet values and what follows from them.
    Constants,
    /// Cannot be made again, or comes out differently; `why` says how.
    Differs,
}

impl Status {
    /// As in `index.json`.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Reproduced => "reproduced",
            Self::VirtualRig => "virtual_rig",
            Self::Constants => "constants",
            Self::Differs => "differs",
        }
    }

    /// Whether our values must be bounded, so that a change that spoils them is seen.
    fn needs_bounds(self) -> bool {
        matches!(self, Self::Reproduced | Self::VirtualRig)
    }
}

/// A column of ours beside those of the thesis, by the names of its rows.
#[derive(Debug, Clone)]
pub(crate) struct Column {
    /// Its heading.
    pub(crate) title: String,
    /// (name of the row, value).
    pub(crate) values: Vec<(String, f64)>,
}

/// A table of ours that has no counterpart in the thesis.
#[derive(Debug, Clone)]
pub(crate) struct Table {
    /// What it shows.
    pub(crate) caption: String,
    /// Its headings.
    pub(crate) headings: Vec<String>,
    /// Its cells, as long as the headings.
    pub(crate) rows: Vec<Vec<String>>,
}

/// A drawing.
#[derive(Debug, Clone)]
pub(crate) struct Drawing {
    /// What it shows.
    pub(crate) caption: String,
    /// The `<svg>` element.
    pub(crate) svg: String,
}

/// A measured value that has a bound in the fixture.
#[derive(Debug, Clone)]
pub(crate) struct Check {
    /// Its key among the bounds.
    pub(crate) name: String,
    /// What was measured.
    pub(crate) measured: f64,
}

impl Check {
    /// A measured value.
    pub(crate) fn new(name: impl Into<String>, measured: f64) -> Self {
        Self { name: name.into(), measured }
    }
}

/// A table or figure of the thesis, made again.
#[derive(Debug, Clone)]
pub(crate) struct Piece {
    /// How it stands.
    pub(crate) status: Status,
    /// Why, in a sentence or two.
    pub(crate) why: String,
    /// Our columns beside those of the thesis.
    pub(crate) columns: Vec<Column>,
    /// Further tables.
    pub(crate) tables: Vec<Table>,
    /// Drawings.
    pub(crate) figures: Vec<Drawing>,
    /// What is judged.
    pub(crate) checks: Vec<Check>,
}

impl Piece {
    /// A piece with nothing in it yet.
    pub(crate) fn new(status: Status, why: impl Into<String>) -> Self {
        let why = why.into();
        Self { status, why, columns: vec![], tables: vec![], figures: vec![], checks: vec![] }
    }
}

/// Makes a piece; the fixture holds the thesis's numbers.
pub(crate) type Maker = fn(&Fixture) -> Result<Piece>;

/// Makes a piece from what `greybox demo` left in a folder.
pub(crate) type Reader = fn(&Path) -> Result<Piece>;

/// A table or figure of the thesis and who makes it again.
pub(crate) struct Entry {
    /// As the thesis calls it: "Table 2.1".
    pub(crate) id: &'static str,
    /// Its maker; `None` while nobody has written it.
    pub(crate) make: Option<Maker>,
    /// Who makes the same from the answer of `greybox demo`, for a piece that diagnoses it.
    pub(crate) read: Option<Reader>,
    /// Whether it takes longer than a test may; it is judged by the command alone.
    pub(crate) slow: bool,
}

impl Entry {
    /// A table or figure made in a moment.
    fn new(id: &'static str, make: Maker) -> Self {
        Self { id, make: Some(make), read: None, slow: false }
    }

    /// One that takes many seconds.
    fn slow(self) -> Self {
        Self { slow: true, ..self }
    }

    /// One that may be made from the answer of `greybox demo`.
    fn or_from_demo(self, read: Reader) -> Self {
        Self { read: Some(read), ..self }
    }
}

/// All tables and figures, in the order of the thesis, and what follows from them. A further chapter is one more line
/// here.
fn registry() -> Vec<Entry> {
    let mut entries = chapter2::entries();
    entries.extend(chapter3::entries());
    entries.extend(chapter4::entries());
    entries.push(sampling::entry());
    entries.push(story::entry());
    entries
}

/// A piece with its fixture and what is wrong with it.
pub(crate) struct Outcome {
    /// The thesis's side.
    pub(crate) fixture: Fixture,
    /// Ours.
    pub(crate) piece: Piece,
    /// Values out of their bounds, and bounds or values that miss their counterpart.
    pub(crate) failures: Vec<String>,
}

/// Runs `reproduce`.
///
/// # Errors
/// When a fixture cannot be read, a piece cannot be computed or a file cannot be written.
pub fn run(root: &Path, arguments: &Arguments) -> Result<Ending> {
    let registry = registry();
    let known = |id: &String| registry.iter().any(|entry| entry.id.eq_ignore_ascii_case(id));
    if let Some(unknown) = arguments.only.iter().find(|id| !known(id)) {
        let all: Vec<&str> = registry.iter().map(|entry| entry.id).collect();
        eprintln!(
            "error: `{unknown}` is no table or figure of chapters 2 to 4; there are {}",
            all.join(", ")
        );
        return Ok(Ending::Refused);
    }
    let wanted = |entry: &&Entry| {
        arguments.only.is_empty() || arguments.only.iter().any(|id| entry.id.eq_ignore_ascii_case(id))
    };

    let folder = root.join("fixtures").join("thesis");
    let errata = fixture::errata(&folder)?;
    let (mut outcomes, mut missing) = (Vec::new(), Vec::new());
    for entry in registry.iter().filter(wanted) {
        let fixture = Fixture::read(&folder, entry.id)?;
        let Some(make) = entry.make else {
            missing.push(fixture);
            continue;
        };
        let piece = match (&arguments.demo, entry.read) {
            (Some(demo), Some(read)) => read(demo),
            _ => {
                if entry.slow {
                    eprintln!("{}: this takes a while", entry.id);
                }
                make(&fixture)
            }
        }
        .with_context(|| entry.id.to_owned())?;
        let failures = judge(&piece, &fixture);
        println!("{:<11} {}", entry.id, piece.status.name());
        for failure in &failures {
            eprintln!("{}: {failure}", entry.id);
        }
        outcomes.push(Outcome { fixture, piece, failures });
    }
    let out = arguments.out.clone().unwrap_or_else(|| root.join("target").join("reproduction"));
    index::write(&out, &outcomes, &missing, &errata)?;
    if !missing.is_empty() {
        let ids: Vec<&str> = missing.iter().map(|fixture| fixture.id.as_str()).collect();
        println!("not made yet: {}", ids.join(", "));
    }
    println!("{}", out.join("index.html").display());
    let mut holds = outcomes.iter().all(|o| o.failures.is_empty());
    if arguments.only.is_empty() && arguments.demo.is_some() {
        // (The models of a diagnosis that is made here have more digits than those of its files.)
        if arguments.write_docs {
            pages::write(root, &outcomes)?;
        } else if !pages::is_current(root, &outcomes)? {
            eprintln!("docs/src/reproduction.md says what is no longer measured: run this with --write-docs");
            holds = false;
        }
        for fault in prose::faults(root, &folder, pages::PAGE, &outcomes)? {
            eprintln!("docs/src/{}: {fault}", pages::PAGE);
            holds = false;
        }
    }
    Ok(if holds { Ending::Done } else { Ending::Missed })
}

/// What is wrong with a piece: a value out of its bounds, a value without bounds, a bound without a value, a
/// column that names a row which the thesis does not have.
fn judge(piece: &Piece, fixture: &Fixture) -> Vec<String> {
    let mut failures = Vec::new();
    for check in &piece.checks {
        match fixture.bounds.get(&check.name) {
            None => {
                failures.push(format!("`{}` = {} has no bounds in the fixture", check.name, check.measured))
            }
            Some(bound) if !bound.holds(check.measured) => {
                failures.push(format!("`{}` = {} is outside {bound}", check.name, check.measured));
            }
            Some(bound) if bound.why.is_none() && !bound.is_narrow(check.measured) => {
                failures.push(format!(
                    "`{}` = {} is bounded by {bound}, more than a factor of two away: narrow it, or say `why`",
                    check.name, check.measured
                ));
            }
            Some(_) => {}
        }
    }
    for name in fixture.bounds.keys() {
        if !piece.checks.iter().any(|check| check.name == *name) {
            failures.push(format!("nothing was measured for the bounds `{name}`"));
        }
    }
    if piece.status.needs_bounds() && piece.checks.is_empty() {
        failures.push(format!("`{}` needs a bound on at least one value", piece.status.name()));
    }
    for column in &piece.columns {
        for (row, _) in &column.values {
            if fixture.row(row).is_none() {
                failures.push(format!("column `{}`: the thesis has no row `{row}`", column.title));
            }
        }
    }
    failures
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixture(bounds: &str) -> Fixture {
        let text = format!(
            r#"{{"id": "Table 9.9", "title": "t", "source": "s", "errata": [], "notes": [],
                "columns": [{{"key": "thesis", "title": "thesis"}}],
                "rows": [{{"name": "m", "thesis": 1.5}}], "bounds": {bounds}}}"#
        );
        Fixture::parse(&text).unwrap()
    }

    #[test]
    fn every_value_is_bounded_and_every_bound_is_measured() {
        let mut piece = Piece::new(Status::Reproduced, "");
        assert_eq!(judge(&piece, &fixture("{}")).len(), 1, "a reproduced piece needs a bound");
        piece.checks.push(Check::new("m error", 0.2));
        assert!(judge(&piece, &fixture("{}"))[0].contains("no bounds"));
        let bounded = fixture(r#"{"m error": {"max": 0.1}}"#);
        assert!(judge(&piece, &bounded)[0].contains("`m error` = 0.2 is outside ≤ 0.1"));
        piece.checks[0].measured = f64::NAN;
        assert_eq!(judge(&piece, &bounded).len(), 1, "not a number is outside");
        piece.checks[0].measured = 0.1;
        assert!(judge(&piece, &bounded).is_empty());
        piece.checks[0].measured = 0.04;
        assert!(judge(&piece, &bounded)[0].contains("more than a factor of two"));
        assert!(judge(&piece, &fixture(r#"{"m error": {"max": 0.1, "why": "seeds"}}"#)).is_empty());
        for (value, bound, narrow) in [
            (0.3, r#"{"min": 0.14}"#, false),
            (0.3, r#"{"min": 0.16, "max": 0.59}"#, true),
            (-0.3, r#"{"min": -0.59, "max": 0.59}"#, true),
            (-0.3, r#"{"min": -0.61}"#, false),
            (-0.3, r#"{"max": -0.14}"#, false),
            (0.0, r#"{"max": 0}"#, true),
            (0.0, r#"{"max": 0.1}"#, false),
        ] {
            let bound: fixture::Bound = serde_json::from_str(bound).unwrap();
            assert!(bound.holds(value) && bound.is_narrow(value) == narrow, "{value}: {bound}");
        }
        piece.checks.clear();
        piece.status = Status::Constants;
        assert!(judge(&piece, &bounded)[0].contains("nothing was measured"));
        piece.columns.push(Column { title: "ours".into(), values: vec![("k".into(), 1.0)] });
        assert!(judge(&piece, &fixture("{}"))[0].contains("no row `k`"));
    }

    #[test]
    fn every_table_and_figure_has_its_fixture_and_known_errata() {
        let folder = greybox_dev::root().join("fixtures").join("thesis");
        let errata = fixture::errata(&folder).unwrap();
        for entry in registry() {
            let fixture = Fixture::read(&folder, entry.id).unwrap();
            assert_eq!(fixture.id, entry.id);
            for erratum in fixture.named_errata() {
                assert!(errata.contains_key(erratum), "{}: {erratum}", entry.id);
            }
            assert!(entry.make.is_some() || fixture.bounds.is_empty(), "{}: bounds without maker", entry.id);
        }
    }

    #[test]
    fn what_is_made_in_a_moment_holds_its_bounds() {
        let folder = greybox_dev::root().join("fixtures").join("thesis");
        for entry in registry().into_iter().filter(|entry| !entry.slow) {
            let Some(make) = entry.make else { continue };
            let fixture = Fixture::read(&folder, entry.id).unwrap();
            let failures = judge(&make(&fixture).unwrap(), &fixture);
            assert!(failures.is_empty(), "{}: {failures:?}", entry.id);
        }
    }

    #[test]
    fn the_folder_is_written_whole() {
        let out = tempfile::tempdir().unwrap();
        let arguments = Arguments {
            only: vec!["table 2.2".into(), "Figure 2.1".into()],
            out: Some(out.path().into()),
            demo: None,
            write_docs: false,
        };
        assert_eq!(run(&greybox_dev::root(), &arguments).unwrap(), Ending::Done);
        let json = std::fs::read_to_string(out.path().join("index.json")).unwrap();
        let entries: Vec<serde_json::Value> = serde_json::from_str(&json).unwrap();
        assert_eq!(entries.len(), 2);
        for entry in entries {
            for file in entry["files"].as_array().unwrap() {
                assert!(out.path().join(file.as_str().unwrap()).is_file(), "{file}");
            }
        }
        let page = std::fs::read_to_string(out.path().join("index.html")).unwrap();
        assert!(page.contains("Table 2.2") && page.contains("<svg") && !page.contains("src="));
        let wrong = Arguments { only: vec!["Table 7.7".into()], out: None, demo: None, write_docs: false };
        assert_eq!(run(&greybox_dev::root(), &wrong).unwrap(), Ending::Refused);
    }
}
