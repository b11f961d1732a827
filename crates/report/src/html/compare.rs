//! The page of a comparison: both runs, their mechanisms, parameters and errors side by side.

use askama::Template;

use super::{Assets, Common, severity};
use crate::comparison::{Change, Comparison, Errors, MechanismChange, Run, Weight};
use crate::contract::{Estimate, Interval};
use crate::notes::{self, Note};
use crate::sentence::comparison as words;
use crate::sentence::recordings::place;
use crate::{ReportError, expression, format, svg};

impl Comparison {
    /// Renders `comparison.html`.
    ///
    /// # Errors
    /// [`ReportError::Html`] if a writer fails; no content leads to that.
    pub fn to_html(&self) -> Result<String, ReportError> {
        let view = View::new(self);
        Ok(CompareTemplate { view: &view, common: &view.common, assets: Assets { data: "" } }.render()?)
    }
}

#[derive(Template)]
#[template(path = "compare.html")]
struct CompareTemplate<'a> {
    view: &'a View,
    common: &'a Common,
    assets: Assets<'a>,
}

struct View {
    common: Common,
    verdict: &'static str,
    verdict_class: &'static str,
    headline: String,
    sentences: Vec<String>,
    cautions: Vec<String>,
    /// What it is, before, after.
    runs: Vec<[String; 3]>,
    mechanisms: Vec<MechanismView>,
    parameters: Rows,
    errors: Vec<ErrorView>,
    findings: Vec<(&'static str, Vec<String>)>,
}

struct MechanismView {
    title: String,
    place: String,
    expression_html: String,
    state: &'static str,
    changed: bool,
    rows: Rows,
}

struct Rows(Vec<RowView>);

impl Rows {
    /// Whether any difference can be told; without one its columns are left out.
    fn differ(&self) -> bool {
        self.0.iter().any(|row| !row.change.is_empty())
    }
}

struct RowView {
    name_html: String,
    /// A word and no symbol.
    word: bool,
    before: String,
    after: String,
    unit: String,
    /// After minus before, and whether that is more than the intervals allow.
    change: String,
    changed: bool,
    /// Both intervals on one scale.
    drawing: Option<String>,
}

struct ErrorView {
    channel: String,
    /// Which model, and its error before and after.
    rows: Vec<(&'static str, [String; 2])>,
}

impl View {
    fn new(c: &Comparison) -> View {
        let different = c.is_changed();
        let mut sentences: Vec<String> = c.summary.iter().map(|s| format::tie(s)).collect();
        let headline = if sentences.is_empty() { String::new() } else { sentences.remove(0) };
        let title = |run: &Run| {
            if run.model.name.is_empty() { run.model.file.clone() } else { run.model.name.clone() }
        };
        View {
            common: Common {
                product: "greybox comparison of two diagnoses",
                title: title(&c.after),
                meta: vec![("Before", c.before.name.clone()), ("After", c.after.name.clone())],
                version: env!("CARGO_PKG_VERSION").to_owned(),
                seed: c.after.greybox.seed,
                ..Common::default()
            },
            verdict: if different { "Changed" } else { "Unchanged" },
            verdict_class: if different { "missing" } else { "consistent" },
            headline,
            sentences,
            cautions: c.cautions.clone(),
            runs: runs(&c.before, &c.after),
            mechanisms: c.mechanisms.iter().map(mechanism).collect(),
            parameters: Rows(c.parameters.iter().map(|(name, change)| row(name, change)).collect()),
            errors: c
                .holdout
                .iter()
                .map(|(channel, e)| {
                    let names = ["Nominal", "Calibrated", "Improved", "Noise alone"];
                    let both = errors(e.before).into_iter().zip(errors(e.after)).map(|(b, a)| [b, a]);
                    ErrorView {
                        channel: expression::text(channel),
                        rows: names.into_iter().zip(both).collect(),
                    }
                })
                .collect(),
            findings: [("Only before", &c.findings_gone), ("Only after", &c.findings_new)]
                .into_iter()
                .filter(|(_, list)| !list.is_empty())
                .map(|(when, list)| (when, notes::grouped(list).iter().map(note).collect()))
                .collect(),
        }
    }
}

fn runs(before: &Run, after: &Run) -> Vec<[String; 3]> {
    let both = |name: &str, of: fn(&Run) -> String| [name.to_owned(), of(before), of(after)];
    vec![
        both("Verdict", |r| words::verdict(r.verdict).to_owned()),
        both("Model", |r| format!("{} ({})", r.model.name, r.model.file)),
        both("Samples", |r| format!("{} training, {} held out", r.samples.train, r.samples.holdout)),
        both("Held out", |r| r.holdout_source.clone()),
        both("Left unexplained", |r| {
            if r.remainder { "something" } else { "nothing beyond noise" }.to_owned()
        }),
        both("greybox", |r| format!("{}, seed {}", r.greybox.version, r.greybox.seed)),
    ]
}

/// In which run it is, and whether it changed.
fn state(m: &MechanismChange) -> &'static str {
    match (m.before, m.after) {
        (None, _) => "new",
        (_, None) => "gone",
        _ if m.is_changed() => "in both, changed",
        _ => "in both",
    }
}

fn mechanism(m: &MechanismChange) -> MechanismView {
    let weight = |w: Option<Weight>, of: fn(Weight) -> f64| {
        w.map_or_else(|| "–".to_owned(), |w| format::probability(of(w)))
    };
    let share = |name: &str, of: fn(Weight) -> f64| RowView {
        name_html: name.to_owned(),
        word: true,
        before: weight(m.before, of),
        after: weight(m.after, of),
        unit: String::new(),
        change: String::new(),
        changed: false,
        drawing: None,
    };
    let mut rows: Vec<RowView> = m.parameters.iter().map(|(name, change)| row(name, change)).collect();
    rows.push(share("explains", |w| w.share_explained));
    rows.push(share("confidence", |w| w.confidence));
    MechanismView {
        title: format::kind(&m.law.kind),
        place: place(&m.law),
        expression_html: expression::html(&m.law.expression),
        state: state(m),
        changed: m.is_changed(),
        rows: Rows(rows),
    }
}

fn row(name: &str, change: &Change) -> RowView {
    let shown =
        |e: &Option<Estimate>| e.as_ref().map_or_else(|| "–".to_owned(), |e| format::cell(e.value, e.ci95));
    let unit = change.after.as_ref().or(change.before.as_ref()).map_or("", |e| e.unit.as_str());
    RowView {
        name_html: expression::html(name),
        word: false,
        before: shown(&change.before),
        after: shown(&change.after),
        unit: format::unit(unit),
        change: difference(change),
        changed: change.changed == Some(true),
        drawing: match (&change.before, &change.after) {
            (Some(a), Some(b)) if a.unit == b.unit => svg::change_plot((a.value, a.ci95), (b.value, b.ci95)),
            _ => None,
        },
    }
}

/// `+0.030 ± 0.006, changed`; empty where nothing can be said.
fn difference(change: &Change) -> String {
    let (Some(changed), Some((by, half))) = (change.changed, change.difference()) else {
        return String::new();
    };
    let sign = if by > 0.0 { "+" } else { "" };
    let by = format::cell(by, Some(Interval::new(by - half, by + half)));
    format!("{sign}{by}, {}", if changed { "changed" } else { "within the intervals" })
}

fn errors(of: Option<Errors>) -> [String; 4] {
    match of {
        Some(e) => [e.nominal, e.calibrated, e.improved, e.noise].map(format::percent),
        None => ["–"; 4].map(str::to_owned),
    }
}

fn note(of: &Note) -> String {
    let place = if of.place.is_empty() { String::new() } else { format!("{}: ", of.place) };
    format!("{}: {place}{}", severity(of.severity).0, of.message)
}
