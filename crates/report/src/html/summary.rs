//! The page of a summary: the recordings, each mechanism and parameter over them, the held-out errors.

use askama::Template;

use super::machines::MachinesView;
use super::{Assets, Common};
use crate::contract::Verdict;
use crate::machines::{Runs, runs};
use crate::sentence::recordings::{place, probability};
use crate::summary::{MechanismOver, Method, ParameterOver, Pooled, RecordingResult, Spread, Summary};
use crate::{ReportError, expression, format, svg};

/// Most recordings that are listed: a table that a browser still scrolls at once.
const MAX_LISTED: usize = 1000;

/// Most forest rows that are drawn; a longer plot is no overview.
const MAX_ROWS: usize = 60;

impl Summary {
    /// Renders `summary.html`.
    ///
    /// # Errors
    /// [`ReportError::Html`] if a writer fails; no content leads to that.
    pub fn to_html(&self) -> Result<String, ReportError> {
        let view = View::new(self);
        Ok(SummaryTemplate { view: &view, common: &view.common, assets: Assets { data: "" } }.render()?)
    }
}

#[derive(Template)]
#[template(path = "summary.html")]
struct SummaryTemplate<'a> {
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
    /// Channels of the errors in the table of recordings.
    channels: Vec<String>,
    recordings: Vec<RecordingView>,
    failed: Vec<[String; 3]>,
    /// Recordings that are not listed, and failures.
    left_out: usize,
    failed_left_out: usize,
    mechanisms: Vec<MechanismView>,
    parameters: Vec<ParameterView>,
    errors: Vec<ErrorView>,
    /// A table says which machine was recorded.
    has_machines: bool,
}

struct RecordingView {
    name: String,
    page: Option<String>,
    verdict: &'static str,
    mechanisms: String,
    samples: String,
    /// (calibrated, improved) by channel.
    errors: Vec<[String; 2]>,
}

struct MechanismView {
    title: String,
    expression_html: String,
    place: String,
    found: String,
    /// In how many machines, and the interval of the share.
    machines: Option<[String; 2]>,
    share: String,
    confidence: String,
    parameters: Vec<PooledView>,
}

struct ParameterView {
    nominal: String,
    pooled: PooledView,
}

struct PooledView {
    name_html: String,
    value: String,
    unit: String,
    method: &'static str,
    changes: bool,
    /// Q, degrees of freedom and p; I²; τ.
    heterogeneity: Option<[String; 3]>,
    plot: Option<Forest>,
    machines: Option<MachinesView>,
}

pub(super) struct Forest {
    svg: String,
    /// How many estimates are not drawn.
    left_out: usize,
}

struct ErrorView {
    channel: String,
    cells: [[String; 2]; 3],
}

impl View {
    fn new(summary: &Summary) -> View {
        let counts = &summary.verdicts;
        let (verdict, verdict_class) = match (counts.missing_physics, counts.unexplained, counts.consistent) {
            (0, 0, 0) => ("No recording was diagnosed", "failed"),
            (0, 0, _) => ("The model agrees with the data", "consistent"),
            (0, _, _) => ("Something is missing, unexplained", "unexplained"),
            _ => ("Physics is missing", "missing"),
        };
        let mut sentences: Vec<String> = summary.summary.iter().map(|s| format::tie(s)).collect();
        let headline = if sentences.is_empty() { String::new() } else { sentences.remove(0) };
        let (name, file) = (&summary.model.name, &summary.model.file);
        let statistics = &summary.statistics;
        let runs = runs(&statistics.recordings);
        View {
            common: Common {
                product: "greybox diagnosis of many recordings",
                title: if name.is_empty() { file.clone() } else { name.clone() },
                meta: vec![("Model", file.clone()), ("Recordings", statistics.recordings.len().to_string())],
                version: summary.greybox.version.clone(),
                seed: summary.greybox.seed,
                ..Common::default()
            },
            verdict,
            verdict_class,
            headline,
            sentences,
            has_machines: !runs.is_empty(),
            channels: summary.holdout.keys().map(|c| expression::text(c)).collect(),
            left_out: statistics.recordings.len().saturating_sub(MAX_LISTED),
            failed_left_out: statistics.failed.len().saturating_sub(MAX_LISTED),
            recordings: statistics
                .recordings
                .iter()
                .take(MAX_LISTED)
                .map(|r| recording(r, summary.holdout.keys()))
                .collect(),
            failed: statistics
                .failed
                .iter()
                .take(MAX_LISTED)
                .map(|f| [f.recording.clone(), f.message.clone(), f.help.clone().unwrap_or_default()])
                .collect(),
            mechanisms: summary.mechanisms.iter().map(|m| mechanism(m, counts.diagnosed(), &runs)).collect(),
            parameters: summary.parameters.iter().map(|(name, p)| parameter(name, p, &runs)).collect(),
            errors: summary
                .holdout
                .iter()
                .map(|(channel, e)| ErrorView {
                    channel: expression::text(channel),
                    cells: [&e.nominal, &e.calibrated, &e.improved].map(spread),
                })
                .collect(),
        }
    }
}

fn recording<'a>(of: &RecordingResult, channels: impl Iterator<Item = &'a String>) -> RecordingView {
    let names: Vec<String> = of.mechanisms.iter().map(|m| format::kind(&m.law.kind)).collect();
    RecordingView {
        name: of.recording.clone(),
        page: of.page.clone(),
        verdict: match of.verdict {
            Verdict::Consistent => "consistent",
            Verdict::MissingPhysics => "physics missing",
            Verdict::Unexplained => "unexplained",
        },
        mechanisms: names.join(", "),
        samples: format!("{} + {}", of.samples.train, of.samples.holdout),
        errors: channels
            .map(|channel| {
                [&of.holdout.calibrated, &of.holdout.improved]
                    .map(|set| set.get(channel).map_or_else(|| "–".to_owned(), |s| format::percent(s.nrmse)))
            })
            .collect(),
    }
}

fn mechanism(over: &MechanismOver, diagnosed: usize, runs: &Runs<'_>) -> MechanismView {
    MechanismView {
        title: format::kind(&over.law.kind),
        expression_html: expression::html(&over.law.expression),
        place: place(&over.law),
        found: format!("{} of {diagnosed}", over.found_in.len()),
        machines: over.machines.as_ref().map(|share| {
            let ends = [share.ci95.low, share.ci95.high].map(format::percent_short);
            [format!("{} of {}", share.found_in.len(), share.of), format!("{} to {}", ends[0], ends[1])]
        }),
        share: format::probability(over.share_explained.median),
        confidence: format::probability(over.confidence.median),
        parameters: over.parameters.iter().map(|(name, p)| pooled(name, p, runs)).collect(),
    }
}

fn parameter(name: &str, over: &ParameterOver, runs: &Runs<'_>) -> ParameterView {
    ParameterView { nominal: format::number(over.nominal), pooled: pooled(name, &over.pooled, runs) }
}

fn pooled(name: &str, over: &Pooled, runs: &Runs<'_>) -> PooledView {
    let heterogeneity = over.heterogeneity.map(|h| {
        [
            format!("{} on {}, {}", format::number(h.q), h.degrees_of_freedom, probability(h.p_value)),
            format::percent_short(h.i_squared),
            format::significant(h.tau, 2),
        ]
    });
    PooledView {
        name_html: expression::html(name),
        value: format::cell(over.value, over.ci95),
        unit: format::unit(&over.unit),
        method: match over.method {
            Method::None => "no interval",
            Method::Single => "one recording",
            Method::FixedEffect => "agree",
            Method::RandomEffects => "change",
        },
        changes: over.method == Method::RandomEffects,
        heterogeneity,
        plot: forest(name, over, "recording"),
        machines: MachinesView::of(name, over, runs),
    }
}

/// `name` or `name [unit]`.
pub(super) fn labelled(name: &str, unit: &str) -> String {
    if unit.is_empty() { name.to_owned() } else { format!("{name} [{unit}]") }
}

/// Drawn from two estimates on.
pub(super) fn forest(name: &str, over: &Pooled, of: &str) -> Option<Forest> {
    if over.estimates.len() < 2 {
        return None;
    }
    let left_out = over.estimates.len().saturating_sub(MAX_ROWS);
    let shown = Pooled {
        estimates: over.estimates.iter().take(MAX_ROWS).cloned().collect(),
        unit: over.unit.clone(),
        machines: None,
        ..*over
    };
    let label = labelled(name, &over.unit);
    let alt = format!("{} of each {of}, with 95 % intervals, and pooled", expression::text(name));
    Some(Forest { svg: svg::forest_plot(&shown, &label, &alt)?, left_out })
}

/// The median, and the range with what diverged.
fn spread(s: &Spread) -> [String; 2] {
    let mut range = match s.finite {
        0 | 1 => String::new(),
        _ => format!("{} … {}", format::percent(s.smallest), format::percent(s.largest)),
    };
    if s.diverged > 0 {
        let comma = if range.is_empty() { "" } else { ", " };
        range.push_str(&format!("{comma}{} diverged", s.diverged));
    }
    [format::percent(s.median), range]
}
