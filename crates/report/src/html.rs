//! The self-contained HTML page.
//!
//! One file that loads nothing: style, script, data and uPlot stand inside, and a content security policy
//! forbids every connection. Numbers and words stand in the page itself as tables and sentences; the script
//! only draws. Text from a file reaches the page in three ways, each escaped: through the template (escaped
//! by askama), through [`crate::expression::escape`], and as JSON in the data island, where `<`, `>` and `&`
//! are written as `\u00XX` so that nothing in it can close the element.

mod compare;
mod control;
mod identified;
mod machines;
mod summary;

use std::fmt::Write as _;

use askama::Template;
use greybox_model::Func;
use serde::Serialize;

use crate::contract::{
    Closure, Finding, Fit, FitSet, InputHold, Interval, Location, Mechanism, ModelId, Names, Ordered,
    Producer, RecordingFit, Report, Score, Severity, Subset, Verdict,
};
use crate::decimate::{Buckets, MAX_POINTS, round_to_range};
use crate::diff::{Edit, diff};
use crate::expression::{self, escape};
use crate::notes;
use crate::page::{Channel, Lagged, MechanismPlot, Page, Recording, Residual, Role};
use crate::{ReportError, format, sentence, svg};

const UPLOT_JS: &str = include_str!("../assets/uPlot.iife.min.js");
const UPLOT_CSS: &str = include_str!("../assets/uPlot.min.css");
const UPLOT_LICENSE: &str = include_str!("../assets/uPlot.LICENSE");
const STYLE: &str = include_str!("../assets/report.css");
const SCRIPT: &str = include_str!("../assets/report.js");

/// Most points of a spectrum, on a logarithmic axis.
const MAX_SPECTRUM_POINTS: usize = 800;

impl Page {
    /// Renders the page.
    ///
    /// # Errors
    /// [`ReportError::Html`] or [`ReportError::Json`] if a writer fails; no content leads to that.
    pub fn to_html(&self) -> Result<String, ReportError> {
        let mut island = Island::default();
        let view = View::new(self, &mut island);
        let data = island.to_json()?;
        Ok(ReportTemplate { view: &view, common: &view.common, assets: Assets { data: &data } }.render()?)
    }
}

/// What every page carries: style, script and the data of its plots.
struct Assets<'a> {
    data: &'a str,
}

impl Assets<'_> {
    fn uplot_css(&self) -> &'static str {
        UPLOT_CSS
    }

    fn style(&self) -> &'static str {
        STYLE
    }

    fn uplot_license(&self) -> &'static str {
        UPLOT_LICENSE
    }

    fn uplot_js(&self) -> &'static str {
        UPLOT_JS
    }

    fn script(&self) -> &'static str {
        SCRIPT
    }
}

#[derive(Template)]
#[template(path = "report.html")]
struct ReportTemplate<'a> {
    view: &'a View,
    common: &'a Common,
    assets: Assets<'a>,
}

// ---------------------------------------------------------------------------------------------------------
// Data island

/// What the script draws.
#[derive(Serialize, Default)]
struct Island {
    axes: Vec<Vec<Option<f64>>>,
    plots: Vec<PlotData>,
}

#[derive(Serialize)]
struct PlotData {
    kind: &'static str,
    axis: usize,
    sync: String,
    height: u32,
    x: &'static str,
    series: Vec<SeriesData>,
    bands: Vec<[f64; 2]>,
    /// Pairs of series (upper, lower) with the area between them filled.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    fills: Vec<[usize; 2]>,
    sigma: Option<f64>,
    split: Option<f64>,
}

#[derive(Serialize)]
struct SeriesData {
    label: String,
    role: &'static str,
    data: Vec<Option<f64>>,
}

impl Island {
    fn axis(&mut self, mut x: Vec<f64>) -> usize {
        round_to_range(&mut x, 6);
        let x = optional(x);
        // Residuals are mostly on the time axis of a recording that is already there.
        if let Some(index) = self.axes.iter().position(|known| *known == x) {
            return index;
        }
        self.axes.push(x);
        self.axes.len() - 1
    }

    fn push(&mut self, plot: PlotData) -> usize {
        self.plots.push(plot);
        self.plots.len() - 1
    }

    fn to_json(&self) -> Result<String, ReportError> {
        Ok(island_text(&serde_json::to_string(self)?))
    }
}

/// JSON for a `<script type="application/json">` element: no character that HTML gives a meaning to.
fn island_text(json: &str) -> String {
    let mut out = String::with_capacity(json.len());
    for c in json.chars() {
        match c {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => {
                let _ = write!(out, "\\u{:04x}", c as u32);
            }
            other => out.push(other),
        }
    }
    out
}

fn optional(values: Vec<f64>) -> Vec<Option<f64>> {
    values.into_iter().map(|value| value.is_finite().then_some(value)).collect()
}

fn series(label: &str, role: &'static str, buckets: &Buckets, values: &[f64]) -> Option<SeriesData> {
    if !values.iter().any(|value| value.is_finite()) {
        return None;
    }
    let mut thinned = buckets.values(values);
    round_to_range(&mut thinned, 5);
    Some(SeriesData { label: label.to_owned(), role, data: optional(thinned) })
}

// ---------------------------------------------------------------------------------------------------------
// View: what the template prints. Fields named `…_html` hold HTML made here from escaped parts.

/// What the pages of a diagnosis and of an identification share: heading, fit, signals, residual, data health.
#[derive(Default)]
struct Common {
    product: &'static str,
    title: String,
    meta: Vec<(&'static str, String)>,
    fit_title: &'static str,
    /// Whether there is a calibrated model to compare with.
    compared: bool,
    columns: Vec<&'static Shown>,
    fit: Vec<FitGroup>,
    fit_recordings: Vec<FitGroup>,
    fit_columns: usize,
    window: Option<String>,
    holdout_source: String,
    recordings: Vec<RecordingView>,
    residual_lead: &'static str,
    map_note: &'static str,
    residuals: Vec<ResidualView>,
    findings: Vec<FindingView>,
    inputs: Vec<[String; 3]>,
    thinned: bool,
    version: String,
    seed: u64,
}

/// A model as a page shows it.
struct Shown {
    /// Its key in the contract; also its colour.
    key: &'static str,
    /// Its name in legends.
    name: &'static str,
    /// Its name above a column.
    head: &'static str,
    /// What it is, below that.
    note: &'static str,
}

/// The models of a diagnosis, in the order of the contract.
const DIAGNOSIS: [Shown; 3] = [
    Shown { key: "nominal", name: "nominal", head: "Nominal", note: "as given" },
    Shown { key: "calibrated", name: "calibrated", head: "Calibrated", note: "refitted" },
    Shown { key: "improved", name: "improved", head: "Improved", note: "with what was missing" },
];

impl Shown {
    fn scores<'a>(&self, set: &'a FitSet) -> &'a Ordered<Score> {
        match self.key {
            "nominal" => &set.nominal,
            "calibrated" => &set.calibrated,
            _ => &set.improved,
        }
    }

    fn line(&self, channel: &Channel, buckets: &Buckets) -> Option<SeriesData> {
        let values = match self.key {
            "nominal" => &channel.nominal,
            "calibrated" => &channel.calibrated,
            _ => &channel.improved,
        };
        series(self.name, self.key, buckets, values)
    }
}

/// What tables and plots of the fit are made from.
struct Scene<'a> {
    models: &'static [Shown],
    fit: &'a Fit,
    noise_floor: &'a Ordered<f64>,
    recordings: &'a [Recording],
    residuals: &'a [Residual],
}

struct View {
    common: Common,
    verdict: &'static str,
    verdict_class: &'static str,
    terms_only: bool,
    headline: String,
    sentences: Vec<String>,
    equations: Vec<EquationView>,
    shares: Vec<ShareView>,
    mechanisms: Vec<MechanismView>,
    /// What the improved model holds without being believed.
    candidates: Vec<CandidateView>,
    closure: Option<ClosureView>,
    /// Which mechanisms, how many, and what is left with these alone.
    subsets: Vec<[String; 3]>,
    remainder: RemainderView,
    parameters: Vec<ParameterView>,
    calibrated_known: bool,
    model: Option<ModelView>,
    nominal_text: String,
}

struct EquationView {
    name: String,
    html: String,
}

struct ShareView {
    label: String,
    text: String,
    width: String,
    class: String,
}

struct FitGroup {
    title: String,
    rows: Vec<FitRow>,
}

struct FitRow {
    channel: String,
    cells: Vec<FitCell>,
    floor: String,
}

struct FitCell {
    model: &'static str,
    text: String,
    detail: String,
    windowed: String,
    bar: String,
}

struct RecordingView {
    name: String,
    role: &'static str,
    role_class: &'static str,
    note: String,
    plots: Vec<PlotView>,
}

struct PlotView {
    index: usize,
    title_html: String,
    note: String,
    alt: String,
}

struct ResidualView {
    title_html: String,
    note: String,
    time: PlotView,
    map_svg: Option<String>,
    spectrum: Option<PlotView>,
    correlations: Vec<CorrelationView>,
}

/// A correlation: caption, note and drawing.
struct CorrelationView {
    title_html: String,
    note: String,
    svg: String,
}

/// A law that is proposed without its name.
struct CandidateView {
    title: String,
    place: String,
    expression_html: String,
    /// Name, value with its interval, unit.
    parameters: Vec<[String; 3]>,
    /// Equations of its own states.
    states_html: Vec<String>,
    /// What each of the parameters is correlated with.
    correlated: Vec<String>,
    share: String,
}

/// How far the candidates can be trusted.
struct ClosureView {
    /// Variable, least and largest value, share of the held-out samples outside.
    range: Vec<[String; 3]>,
    outside: String,
    /// What is left out, error of the calibrated and of the improved model.
    folds: Vec<[String; 3]>,
}

struct MechanismView {
    title: String,
    place: String,
    expression_html: String,
    states_html: Vec<String>,
    share: String,
    confidence: String,
    parameters: Vec<[String; 4]>,
    location: Vec<(&'static str, String)>,
    alternatives: Vec<AlternativeView>,
    experiment: String,
    plots: Vec<LawView>,
}

struct AlternativeView {
    title: String,
    expression_html: String,
    confidence: String,
    equivalent: bool,
    separate: String,
}

struct LawView {
    title: String,
    svg: String,
    note: String,
    dots: bool,
    law: bool,
}

struct RemainderView {
    significant: bool,
    text: String,
    rejected: Option<String>,
    experiment: Option<String>,
    plots: Vec<LawView>,
}

struct ParameterView {
    name_html: String,
    code: String,
    unit: String,
    nominal: String,
    calibrated: String,
    value: String,
    change: String,
    fixed: bool,
}

struct ModelView {
    lines: Vec<DiffLine>,
    added: usize,
    removed: usize,
}

struct DiffLine {
    class: &'static str,
    mark: &'static str,
    html: String,
}

struct FindingView {
    severity: &'static str,
    class: &'static str,
    code: String,
    place: String,
    message: String,
    help: Option<String>,
}

impl View {
    fn new(page: &Page, island: &mut Island) -> Self {
        let report = &page.report;
        let mut sentences =
            if report.summary.is_empty() { sentence::summary(report) } else { report.summary.clone() };
        for text in &mut sentences {
            *text = format::tie(text);
        }
        let headline = if sentences.is_empty() { String::new() } else { sentences.remove(0) };
        let (verdict, verdict_class) = match report.verdict {
            _ if report.terms_only && !report.candidates.is_empty() => ("Terms are missing", "missing"),
            Verdict::Consistent => ("The model agrees with the data", "consistent"),
            Verdict::MissingPhysics => ("Physics is missing", "missing"),
            Verdict::Unexplained => ("Something is missing, unexplained", "unexplained"),
        };
        let scene = Scene {
            models: &DIAGNOSIS,
            fit: &report.fit,
            noise_floor: &report.noise_floor,
            recordings: &page.recordings,
            residuals: &page.residuals,
        };
        let common = Common {
            product: if report.terms_only { "greybox identification" } else { "greybox diagnosis" },
            title: page.title.clone(),
            meta: meta(&report.model, &scene),
            fit_title: "Before and after",
            compared: scene.improved_known(),
            residual_lead: "Measurement minus simulation on training data, before (calibrated) and after (improved).",
            map_note: "before; RMS in each cell",
            findings: findings(&report.findings),
            inputs: inputs(&report.inputs),
            ..scene.common(&report.greybox, island)
        };
        View {
            common,
            verdict,
            verdict_class,
            terms_only: report.terms_only,
            headline,
            sentences,
            equations: equations(page),
            shares: shares(page),
            mechanisms: report
                .mechanisms
                .iter()
                .enumerate()
                .map(|(index, mechanism)| mechanism_view(page, index, mechanism))
                .collect(),
            candidates: report
                .candidates
                .iter()
                .map(|m| candidate_view(m, report.closure.as_ref()))
                .collect(),
            closure: report.closure.as_ref().map(closure_view),
            subsets: subsets(report),
            remainder: remainder_view(page),
            parameters: parameters(page),
            calibrated_known: report.parameters.values().any(|parameter| parameter.calibrated.is_some()),
            model: model_view(&page.models.nominal, &page.models.improved),
            nominal_text: page.models.nominal.clone(),
        }
    }
}

impl Scene<'_> {
    /// Fit, signals and residuals; the caller says what differs from page to page.
    fn common(&self, producer: &Producer, island: &mut Island) -> Common {
        let recordings: Vec<RecordingView> = self
            .recordings
            .iter()
            .enumerate()
            .map(|(index, recording)| recording_view(self, recording, index, island))
            .collect();
        let residuals = self.residuals.iter().map(|residual| residual_view(self, residual, island)).collect();
        let columns = self.columns();
        let fit = [("Held-out data", &self.fit.holdout), ("Training data", &self.fit.train)];
        Common {
            product: "greybox",
            title: String::new(),
            meta: Vec::new(),
            fit_title: "Fit",
            compared: false,
            fit_columns: columns.len() + 2,
            columns,
            fit: fit.into_iter().filter_map(|(title, set)| fit_group(title, set, self, None)).collect(),
            fit_recordings: fit_by_recording(&self.fit.recordings, self),
            window: self.fit.window_s.map(format::plain),
            holdout_source: self.fit.holdout_source.clone(),
            recordings,
            residual_lead: "",
            map_note: "RMS in each cell",
            residuals,
            findings: Vec::new(),
            inputs: Vec::new(),
            thinned: self.recordings.iter().any(|recording| recording.t.len() > MAX_POINTS),
            version: producer.version.clone(),
            seed: producer.seed,
        }
    }

    /// Whether there is an improved model at all; without one its column is left out.
    fn improved_known(&self) -> bool {
        !self.fit.train.improved.is_empty() || !self.fit.holdout.improved.is_empty()
    }

    fn columns(&self) -> Vec<&'static Shown> {
        self.models.iter().filter(|model| model.key != "improved" || self.improved_known()).collect()
    }
}

fn inputs(holds: &Ordered<InputHold>) -> Vec<[String; 3]> {
    let stated = |hold: &str| if hold.is_empty() { "not stated".to_owned() } else { hold.replace('_', " ") };
    holds
        .iter()
        .map(|(name, hold)| [name.clone(), stated(&hold.hold_given), stated(&hold.hold_best)])
        .collect()
}

fn meta(model: &ModelId, scene: &Scene<'_>) -> Vec<(&'static str, String)> {
    let mut out = Vec::new();
    match (model.name.is_empty(), model.file.is_empty()) {
        (false, false) => out.push(("Model", format!("{} ({})", model.name, model.file))),
        (false, true) => out.push(("Model", model.name.clone())),
        (true, false) => out.push(("Model", model.file.clone())),
        (true, true) => {}
    }
    for (role, title) in [(Role::Train, "Trained on"), (Role::Holdout, "Held out")] {
        let names: Vec<&str> =
            scene.recordings.iter().filter(|r| r.role == role).map(|r| r.name.as_str()).collect();
        if !names.is_empty() {
            out.push((title, names.join(", ")));
        } else if role == Role::Holdout && !scene.fit.holdout_source.is_empty() {
            out.push((title, scene.fit.holdout_source.clone()));
        }
    }
    out
}

// -- equations --------------------------------------------------------------------------------------------

/// The equations that changed, new terms marked. A model text that is not TOML gives none: the diff below
/// still shows it.
fn equations(page: &Page) -> Vec<EquationView> {
    let before = equation_texts(&page.models.nominal);
    let after = equation_texts(&page.models.improved);
    let mut out = Vec::new();
    for (name, new) in &after {
        let old = before.iter().find(|(known, _)| known == name).map_or("", |(_, text)| text);
        if old != new {
            out.push(EquationView { name: name.clone(), html: marked_equation(old, new) });
        }
    }
    out
}

fn equation_texts(model: &str) -> Vec<(String, String)> {
    let Ok(table) = model.parse::<toml::Table>() else { return Vec::new() };
    let Some(equations) = table.get("equations").and_then(toml::Value::as_table) else { return Vec::new() };
    equations.iter().filter_map(|(name, value)| Some((name.clone(), value.as_str()?.to_owned()))).collect()
}

/// The new equation in textbook form. Runs of tokens that are not in the old one are marked; a mark is cut
/// where parentheses would not balance inside it, since every run is prettified on its own.
fn marked_equation(old: &str, new: &str) -> String {
    let shown_old = expression::text(old);
    let shown_new = expression::text(new);
    if old.is_empty() {
        return format!("<ins>{}</ins>", expression::html(new));
    }
    // Compare the printed forms (blanks no longer matter), character runs by token.
    let (a, b) = (expression::tokens(&shown_old), expression::tokens(&shown_new));
    let mut out = String::new();
    let mut added = String::new();
    let flush = |added: &mut String, out: &mut String| {
        if !added.trim().is_empty() {
            let _ = write!(out, "<ins>{}</ins>", italic(added.trim()));
            if added.ends_with(' ') {
                out.push(' ');
            }
        } else {
            out.push_str(added);
        }
        added.clear();
    };
    for edit in diff(&a, &b) {
        match edit {
            Edit::Same(token) => {
                flush(&mut added, &mut out);
                out.push_str(&italic(token));
            }
            Edit::Added(token) => {
                if added.is_empty() && token.starts_with(' ') {
                    out.push(' ');
                }
                added.push_str(token);
            }
            Edit::Removed(_) => {}
        }
    }
    flush(&mut added, &mut out);
    out
}

/// Escapes prettified text and sets its names in italics.
fn italic(shown: &str) -> String {
    let mut out = String::new();
    for token in expression::tokens(shown) {
        if token.starts_with(char::is_alphabetic) && Func::from_name(token).is_none() {
            let _ = write!(out, "<var>{}</var>", escape(token));
        } else {
            out.push_str(&escape(token));
        }
    }
    out
}

// -- where the residual comes from ------------------------------------------------------------------------

fn subsets(report: &Report) -> Vec<[String; 3]> {
    let titles: Vec<String> = report.mechanisms.iter().map(|m| format::kind(&m.kind)).collect();
    // Two of one kind are told apart by their place in the list.
    let named = |index: &usize| {
        let title = titles.get(*index).map_or("?", String::as_str);
        let twins = titles.iter().filter(|t| *t == title).count() > 1;
        if twins { format!("{title} ({})", index + 1) } else { title.to_owned() }
    };
    let row = |s: &Subset| {
        let what = match s.mechanisms.len() {
            0 => "None (calibrated)".to_owned(),
            n if n == titles.len() => "All".to_owned(),
            _ => s.mechanisms.iter().map(named).collect::<Vec<_>>().join(", "),
        };
        [escape(&what), s.mechanisms.len().to_string(), format::percent(s.residual_share)]
    };
    report.subsets.iter().map(row).collect()
}

fn shares(page: &Page) -> Vec<ShareView> {
    let report = &page.report;
    if report.verdict != Verdict::MissingPhysics {
        return Vec::new();
    }
    let known = |share: f64| if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 };
    let mut parts: Vec<(String, f64, String)> = report
        .mechanisms
        .iter()
        .enumerate()
        .map(|(index, m)| {
            (format::kind(&m.kind), known(m.share_explained), format!("share-{}", index.min(3)))
        })
        .collect();
    let proposed = report.candidates.iter().map(|m| known(m.share_explained)).sum();
    parts.push(("Proposed, not named".to_owned(), proposed, "share-proposed".to_owned()));
    let explained: f64 = parts.iter().map(|part| part.1).sum();
    let rest = known(report.remainder.share_of_residual);
    parts.push(("Unexplained".to_owned(), rest, "share-rest".to_owned()));
    let total = (explained + rest).max(1.0);
    parts
        .into_iter()
        .filter(|part| part.1 > 0.0)
        .map(|(label, share, class)| ShareView {
            label,
            text: format::probability(share),
            width: format!("{:.2}", 100.0 * share / total),
            class,
        })
        .collect()
}

// -- fit --------------------------------------------------------------------------------------------------

fn unit_of<'a>(scene: &Scene<'a>, channel: &str) -> &'a str {
    let mut channels = scene.recordings.iter().flat_map(|recording| &recording.channels);
    channels.find(|known| known.name == channel).map_or("", |known| known.unit.as_str())
}

fn fit_group(title: &str, set: &FitSet, scene: &Scene<'_>, suffix: Option<&str>) -> Option<FitGroup> {
    if set.is_empty() {
        return None;
    }
    let rows = set.channels().into_iter().map(|channel| fit_row(channel, set, scene)).collect();
    let title = suffix.map_or_else(|| title.to_owned(), |suffix| format!("{title}, {suffix}"));
    Some(FitGroup { title, rows })
}

fn fit_row(channel: &str, set: &FitSet, scene: &Scene<'_>) -> FitRow {
    let unit = unit_of(scene, channel);
    let models = scene.columns();
    let largest = models
        .iter()
        .filter_map(|model| model.scores(set).get(channel))
        .map(|score| score.nrmse)
        .filter(|nrmse| nrmse.is_finite())
        .fold(0.0, f64::max);
    let cells =
        models.into_iter().map(|model| fit_cell(model.key, model.scores(set).get(channel), unit, largest));
    let floor = scene.fit.floor_in(set, channel, scene.noise_floor);
    FitRow { channel: expression::text(channel), cells: cells.collect(), floor: format::percent(floor) }
}

fn fit_cell(model: &'static str, score: Option<&Score>, unit: &str, largest: f64) -> FitCell {
    let Some(score) = score else {
        let text = format::UNKNOWN.to_owned();
        return FitCell { model, text, detail: String::new(), windowed: String::new(), bar: "0".to_owned() };
    };
    let bar = if score.nrmse.is_finite() && largest > 0.0 { 100.0 * score.nrmse / largest } else { 0.0 };
    let rmse = score.rmse.filter(|rmse| rmse.is_finite());
    FitCell {
        model,
        text: format::percent(score.nrmse),
        detail: rmse.map(|rmse| format::with_unit(&format::number(rmse), unit)).unwrap_or_default(),
        windowed: score.nrmse_windowed.map(format::percent).unwrap_or_default(),
        bar: format!("{bar:.1}"),
    }
}

fn fit_by_recording(recordings: &Ordered<RecordingFit>, scene: &Scene<'_>) -> Vec<FitGroup> {
    let mut out = Vec::new();
    for (file, fit) in recordings {
        for (set, suffix) in [(&fit.holdout, "held out"), (&fit.train, "training")] {
            out.extend(set.as_ref().and_then(|set| fit_group(file, set, scene, Some(suffix))));
        }
    }
    out
}

// -- signals ----------------------------------------------------------------------------------------------

fn recording_view(
    scene: &Scene<'_>,
    recording: &Recording,
    index: usize,
    island: &mut Island,
) -> RecordingView {
    let buckets = Buckets::even(recording.t.len(), MAX_POINTS);
    let axis = island.axis(buckets.axis(&recording.t));
    let sync = format!("recording {index}");
    let mut plots = Vec::new();
    for channel in &recording.channels {
        // The last model is drawn over the measurement, the others under it.
        let (last, others) = scene.models.split_last().map_or((None, scene.models), |(l, o)| (Some(l), o));
        let lines: Vec<SeriesData> = others
            .iter()
            .map(|model| model.line(channel, &buckets))
            .chain([series("measured", "measured", &buckets, &channel.measured)])
            .chain(last.map(|model| model.line(channel, &buckets)))
            .flatten()
            .collect();
        if lines.is_empty() {
            continue;
        }
        let note = scores_note(scene, &recording.name, recording.role, &channel.name);
        let alt = time_alt(recording, channel, &lines, &note);
        let plot = PlotData {
            kind: "time",
            axis,
            sync: sync.clone(),
            height: 270,
            x: "time in s",
            series: lines,
            bands: Vec::new(),
            fills: Vec::new(),
            sigma: None,
            split: recording.holdout_from.filter(|t| t.is_finite()),
        };
        plots.push(PlotView {
            index: island.push(plot),
            title_html: quantity_html(&channel.name, &channel.unit),
            note,
            alt,
        });
    }
    for input in &recording.inputs {
        let Some(line) = series(&expression::text(&input.name), "input", &buckets, &input.values) else {
            continue;
        };
        let plot = PlotData {
            kind: "time",
            axis,
            sync: sync.clone(),
            height: 170,
            x: "time in s",
            series: vec![line],
            bands: Vec::new(),
            fills: Vec::new(),
            sigma: None,
            split: None,
        };
        let alt = format!(
            "Input {} of {} over {}{}",
            expression::text(&input.name),
            recording.name,
            span(&recording.t),
            extent(&input.values, &input.unit)
        );
        plots.push(PlotView {
            index: island.push(plot),
            title_html: format!("Input {}", quantity_html(&input.name, &input.unit)),
            note: String::new(),
            alt,
        });
    }
    let (role, role_class) = match recording.role {
        Role::Train => ("training", "train"),
        Role::Holdout => ("held out", "holdout"),
    };
    let mut note = format!("{} samples, {}", recording.t.len(), span(&recording.t));
    if let Some(from) = recording.holdout_from.filter(|t| t.is_finite()) {
        let _ = write!(note, "; held out from {} s (dashed line)", format::plain(from));
    }
    RecordingView { name: recording.name.clone(), role, role_class, note, plots }
}

/// `θ <small>in rad</small>`
fn quantity_html(name: &str, unit: &str) -> String {
    let unit = format::unit(unit);
    let name = expression::html(name);
    if unit.is_empty() { name } else { format!("{name} <small>in {}</small>", escape(&unit)) }
}

fn span(t: &[f64]) -> String {
    match (t.first(), t.last()) {
        (Some(first), Some(last)) => format!("{} s", format::plain(last - first)),
        _ => "no time".to_owned(),
    }
}

fn extent(values: &[f64], unit: &str) -> String {
    let finite = || values.iter().copied().filter(|value| value.is_finite());
    let (low, high) = (finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max));
    if low > high {
        return String::new();
    }
    format!(": {} to {}", format::number(low), format::with_unit(&format::number(high), unit))
}

/// `error: nominal 31 %, calibrated 22 %, improved 2.0 %` for this channel of this recording.
fn scores_note(scene: &Scene<'_>, file: &str, role: Role, channel: &str) -> String {
    let Some(entry) = scene.fit.recordings.get(file) else { return String::new() };
    let set = match role {
        Role::Train => entry.train.as_ref(),
        Role::Holdout => entry.holdout.as_ref(),
    };
    let Some(set) = set else { return String::new() };
    let parts: Vec<String> = scene
        .models
        .iter()
        .filter_map(|model| {
            let score = model.scores(set).get(channel)?;
            Some(format!("{} {}", model.name, format::percent_short(score.nrmse)))
        })
        .collect();
    if parts.is_empty() { String::new() } else { format::tie(&format!("error: {}", parts.join(", "))) }
}

fn time_alt(recording: &Recording, channel: &Channel, lines: &[SeriesData], note: &str) -> String {
    let names: Vec<&str> = lines.iter().map(|line| line.label.as_str()).collect();
    let mut alt = format!(
        "{} of {} over {}: {}. Measured range{}",
        expression::text(&channel.name),
        recording.name,
        span(&recording.t),
        sentence::joined(&names, "and"),
        extent(&channel.measured, &channel.unit)
    );
    if !note.is_empty() {
        let _ = write!(alt, "; {note}");
    }
    alt
}

// -- residual ---------------------------------------------------------------------------------------------

fn residual_view(scene: &Scene<'_>, residual: &Residual, island: &mut Island) -> ResidualView {
    let buckets = Buckets::even(residual.t.len(), MAX_POINTS);
    let recording = scene.recordings.iter().position(|known| known.name == residual.recording);
    let sync = match recording {
        Some(index) => format!("recording {index}"),
        None => format!("residual {}", island.plots.len()),
    };
    let shown = expression::text(&residual.channel);
    let sigma = Some(residual.noise_sigma).filter(|sigma| sigma.is_finite() && *sigma > 0.0);
    let bands: Vec<[f64; 2]> = residual
        .windows
        .iter()
        .filter(|window| window.low.is_finite() && window.high.is_finite())
        .map(|window| [window.low, window.high])
        .collect();
    let mut note_parts = Vec::new();
    if !bands.is_empty() {
        note_parts.push("shaded: where the mechanism acts".to_owned());
    }
    if let Some(sigma) = sigma {
        let size = format::with_unit(&format::number(2.0 * sigma), &residual.unit);
        note_parts.push(format!("grey band: ±2σ of the noise, {size}"));
    }
    let after = scene.models.last().map_or("improved", |model| model.name);
    let time_lines = [
        series("calibrated", "calibrated", &buckets, &residual.before),
        series(after, "improved", &buckets, &residual.after),
    ];
    let rms_text = |values: &[f64]| format::with_unit(&format::number(rms(values)), &residual.unit);
    let sizes: Vec<String> = [("calibrated", &residual.before), (after, &residual.after)]
        .into_iter()
        .filter(|(_, values)| !values.is_empty())
        .map(|(name, values)| format!("RMS {} with the {name} model", rms_text(values)))
        .collect();
    let alt = format!("Residual of {shown} on {} over time: {}", residual.recording, sizes.join(", "));
    let time = PlotView {
        index: island_time(island, &residual.t, &buckets, sync, time_lines, bands, sigma),
        title_html: "Over time".to_owned(),
        note: format::tie(&note_parts.join(" · ")),
        alt,
    };
    let map_svg = residual.map.as_ref().and_then(|map| {
        let alt = format!(
            "Magnitude of the residual of {shown} over {} and {}",
            expression::label(&map.x_label),
            expression::label(&map.y_label)
        );
        svg::state_map(map, &alt)
    });
    let spectrum = residual.spectrum.as_ref().and_then(|spectrum| {
        let start = spectrum.freq.iter().position(|&f| f > 0.0)?;
        let freq = &spectrum.freq[start..];
        let buckets = Buckets::logarithmic(freq, MAX_SPECTRUM_POINTS);
        let positive = |values: &[f64]| -> Vec<f64> {
            let tail = values.get(start..).unwrap_or(&[]);
            tail.iter().map(|&v| if v > 0.0 { v } else { f64::NAN }).collect()
        };
        let lines: Vec<SeriesData> = [
            log_series("noise", "noise", &buckets, &positive(&spectrum.noise)),
            log_series("calibrated", "calibrated", &buckets, &positive(&spectrum.before)),
            log_series(after, "improved", &buckets, &positive(&spectrum.after)),
        ]
        .into_iter()
        .flatten()
        .collect();
        if lines.is_empty() {
            return None;
        }
        let axis = island.axis_exact(buckets.axis(freq));
        let plot = PlotData {
            kind: "spectrum",
            axis,
            sync: format!("spectrum {}", island.plots.len()),
            height: 300,
            x: "frequency in Hz",
            series: lines,
            bands: Vec::new(),
            fills: Vec::new(),
            sigma: None,
            split: None,
        };
        let unit = format::unit(&residual.unit);
        let unit = if unit.is_empty() { "1".to_owned() } else { unit };
        Some(PlotView {
            index: island.push(plot),
            title_html: format!("Over frequency <small>in {}/√Hz</small>", escape(&unit)),
            note: String::new(),
            alt: format!("Amplitude spectrum of the residual of {shown} and of the noise"),
        })
    });
    ResidualView {
        title_html: expression::html(&residual.channel),
        note: residual.recording.clone(),
        time,
        map_svg,
        spectrum,
        correlations: residual
            .correlations
            .iter()
            .filter_map(|c| correlation_view(&shown, after, c))
            .collect(),
    }
}

fn correlation_view(shown: &str, after: &str, found: &Lagged) -> Option<CorrelationView> {
    let outside = |values: &[f64]| {
        let beyond = values.iter().filter(|v| v.abs() > found.bound).count();
        format!("{beyond} of {} lags", values.len())
    };
    let sizes: Vec<String> = [("calibrated", &found.before), (after, &found.after)]
        .into_iter()
        .filter(|(_, values)| !values.is_empty())
        .map(|(name, values)| format!("{} {name}", outside(values)))
        .collect();
    let sizes = sizes.join(", ");
    let (title_html, with) = match &found.with {
        None => ("Correlation with itself".to_owned(), "itself".to_owned()),
        Some(input) => {
            (format!("Correlation with the input {}", expression::html(input)), expression::text(input))
        }
    };
    let alt = format!(
        "Correlation of the residual of {shown} with {with} by lag; outside of what chance gives: {sizes}"
    );
    let svg = svg::correlation_plot(found, &alt)?;
    Some(CorrelationView { title_html, note: format::tie(&format!("beyond chance (99 %): {sizes}")), svg })
}

fn island_time(
    island: &mut Island,
    t: &[f64],
    buckets: &Buckets,
    sync: String,
    lines: [Option<SeriesData>; 2],
    bands: Vec<[f64; 2]>,
    sigma: Option<f64>,
) -> usize {
    let axis = island.axis(buckets.axis(t));
    island.push(PlotData {
        kind: "time",
        axis,
        sync,
        height: 230,
        x: "time in s",
        series: lines.into_iter().flatten().collect(),
        bands,
        fills: Vec::new(),
        sigma,
        split: None,
    })
}

impl Island {
    /// An axis whose values span decades: four significant digits each instead of a share of the range.
    fn axis_exact(&mut self, x: Vec<f64>) -> usize {
        self.axes.push(optional(x.into_iter().map(four_digits).collect()));
        self.axes.len() - 1
    }
}

fn log_series(label: &str, role: &'static str, buckets: &Buckets, values: &[f64]) -> Option<SeriesData> {
    if !values.iter().any(|value| value.is_finite()) {
        return None;
    }
    let thinned = buckets.values(values).into_iter().map(four_digits).collect();
    Some(SeriesData { label: label.to_owned(), role, data: optional(thinned) })
}

/// Rounds to five significant digits.
fn four_digits(value: f64) -> f64 {
    if value.is_finite() { format!("{value:.4e}").parse().unwrap_or(value) } else { value }
}

fn rms(values: &[f64]) -> f64 {
    let (sum, count) = values
        .iter()
        .filter(|value| value.is_finite())
        .fold((0.0, 0usize), |(sum, count), value| (sum + value * value, count + 1));
    if count == 0 { f64::NAN } else { (sum / count as f64).sqrt() }
}

// -- mechanisms -------------------------------------------------------------------------------------------

/// Where a mechanism acts, in words.
fn placed(mechanism: &Mechanism) -> String {
    let place = match &mechanism.channel {
        Some(channel) => format!("in the measurement of {}", expression::text(channel)),
        None => sentence::equations(&mechanism.equation).trim_start().to_owned(),
    };
    match &mechanism.drifting {
        Some(parameter) => format!("of {} {place}", expression::text(parameter)),
        None => place,
    }
}

/// Its law, with what it replaces.
fn law_html(mechanism: &Mechanism) -> String {
    let law = expression::html(&mechanism.expression);
    match &mechanism.replaces {
        Some(replaced) => format!("{} → {law}", expression::html(replaced)),
        None => law,
    }
}

fn candidate_view(candidate: &Mechanism, closure: Option<&Closure>) -> CandidateView {
    let parameters = candidate.parameters.iter().map(|(name, estimate)| {
        [expression::html(name), format::cell(estimate.value, estimate.ci95), format::unit(&estimate.unit)]
    });
    let correlated = candidate.parameters.keys().filter_map(|name| {
        let with = closure?.correlated_with.get(name)?;
        Some(format!("{} {}", expression::html(&with.parameter), format::significant(with.correlation, 2)))
    });
    CandidateView {
        title: format::kind(&candidate.kind),
        place: placed(candidate),
        expression_html: law_html(candidate),
        parameters: parameters.collect(),
        states_html: states_html(candidate),
        correlated: correlated.collect(),
        share: format::probability(candidate.share_explained),
    }
}

/// Equations of the states that a law remembers by.
fn states_html(law: &Mechanism) -> Vec<String> {
    law.states.values().map(|equation| expression::html(equation)).collect()
}

fn closure_view(closure: &Closure) -> ClosureView {
    let share = |of: f64| match of {
        0.0 => "none".to_owned(),
        _ if of.is_finite() => format::probability(of),
        _ => "–".to_owned(),
    };
    let range = closure.range.iter().map(|(variable, range)| {
        [
            format!("<span class=\"math\">{}</span>", expression::html(variable)),
            format::interval(Some(range.train)),
            share(range.outside),
        ]
    });
    let error = |of: f64| if of.is_finite() { format::percent(of) } else { "diverges".to_owned() };
    let folds = closure.cross_validation.iter().map(|fold| {
        let window = fold.window_s.map_or_else(String::new, |w| {
            format!(", {} to {} s", format::number(w.low), format::number(w.high))
        });
        [
            escape(&format!("{}{window}", fold.recordings.join(", "))),
            error(fold.calibrated),
            error(fold.improved),
        ]
    });
    ClosureView { range: range.collect(), outside: share(closure.outside), folds: folds.collect() }
}

fn mechanism_view(page: &Page, index: usize, mechanism: &Mechanism) -> MechanismView {
    let parameters = mechanism.parameters.iter().map(|(name, estimate)| {
        [
            expression::html(name),
            format::cell(estimate.value, estimate.ci95),
            format::interval(estimate.ci95),
            format::unit(&estimate.unit),
        ]
    });
    let alternatives = mechanism.alternatives.iter().map(|alternative| AlternativeView {
        title: format::capital(&crate::sentence::alternative_name(alternative, mechanism)),
        expression_html: alternative.expression.as_deref().map(expression::html).unwrap_or_default(),
        confidence: format::probability(alternative.confidence),
        equivalent: alternative.equivalent,
        separate: alternative.separate.clone().unwrap_or_default(),
    });
    MechanismView {
        title: format::kind(&mechanism.kind),
        place: placed(mechanism),
        expression_html: law_html(mechanism),
        states_html: states_html(mechanism),
        share: format::probability(mechanism.share_explained),
        confidence: format::probability(mechanism.confidence),
        parameters: parameters.collect(),
        location: location(&mechanism.location, page),
        alternatives: alternatives.collect(),
        experiment: mechanism.experiment.as_ref().map_or_else(String::new, |e| e.text.clone()),
        plots: law_views(page, Some(index)),
    }
}

fn law_views(page: &Page, mechanism: Option<usize>) -> Vec<LawView> {
    page.mechanism_plots.iter().filter(|plot| plot.mechanism == mechanism).filter_map(law_view).collect()
}

fn law_view(plot: &MechanismPlot) -> Option<LawView> {
    let law = plot.curve.iter().any(|p| p[0].is_finite() && p[1].is_finite());
    let dots = plot.points.iter().any(|p| p[0].is_finite() && p[1].is_finite());
    let alt = format!(
        "{}: {} over {}{}",
        plot.title,
        expression::label(&plot.y_label),
        expression::label(&plot.x_label),
        if law { ", points from the data and the fitted law" } else { ", points from the data" }
    );
    let drawn = svg::law_plot(plot, &alt)?;
    let mut note = Vec::new();
    if drawn.every > 1 {
        note.push(format!("one point in {} drawn", drawn.every));
    }
    if drawn.outside > 0 {
        note.push(format!("{} of {} points lie outside the frame", drawn.outside, plot.points.len()));
    }
    Some(LawView { title: plot.title.clone(), svg: drawn.svg, note: note.join("; "), dots, law })
}

fn location(location: &Location, page: &Page) -> Vec<(&'static str, String)> {
    let mut out = Vec::new();
    let names = location.equation.as_ref().map(Names::as_slice).unwrap_or(&[]);
    if !names.is_empty() {
        out.push(("Equation", names.join(", ")));
    }
    let when = sentence::region(location);
    if !when.is_empty() {
        out.push(("Acts when", sentence::joined(&when, "and")));
    }
    if let Some(band) = sentence::band(location.band_hz) {
        out.push(("Band", band));
    }
    for (file, windows) in &location.windows_s {
        out.push(("Windows", windows_text(file, windows, page)));
    }
    out
}

/// `6 windows in train.csv, 5.2 s of 20 s: 1.2 … 1.9 s, …`
fn windows_text(file: &str, windows: &[Interval], page: &Page) -> String {
    let total: f64 = windows.iter().map(|w| w.high - w.low).filter(|length| length.is_finite()).sum();
    let length = page
        .recordings
        .iter()
        .find(|recording| recording.name == file)
        .and_then(|recording| Some(recording.t.last()? - recording.t.first()?));
    let of = length.map(|length| format!(" of {}", format::plain(length))).unwrap_or_default();
    let noun = if windows.len() == 1 { "window" } else { "windows" };
    let mut text = format!("{} {noun} in {file}, {}{of} s", windows.len(), format::plain(total));
    const SHOWN: usize = 6;
    let listed: Vec<String> = windows
        .iter()
        .take(SHOWN)
        .map(|w| format!("{}–{}", format::plain(w.low), format::plain(w.high)))
        .collect();
    if !listed.is_empty() {
        let more = if windows.len() > SHOWN { ", …" } else { "" };
        let _ = write!(text, " (at {}{more})", listed.join(", "));
    }
    text
}

fn remainder_view(page: &Page) -> RemainderView {
    let remainder = &page.report.remainder;
    let share = format::probability(remainder.share_of_residual);
    let mut text = if remainder.significant {
        format!("{share} of the calibrated model's residual is still unexplained: more than noise can do.")
    } else {
        format!("{share} of the calibrated model's residual is left: no more than noise can do.")
    };
    for (title, value) in location(&remainder.location, page) {
        let _ = write!(text, " {title}: {value}.");
    }
    RemainderView {
        significant: remainder.significant,
        text,
        rejected: sentence::rejected(&page.report),
        experiment: remainder.experiment.clone(),
        plots: law_views(page, None),
    }
}

// -- parameters, model, findings --------------------------------------------------------------------------

fn parameters(page: &Page) -> Vec<ParameterView> {
    let rows = page.report.parameters.iter().map(|(name, parameter)| {
        let change = parameter.value / parameter.nominal - 1.0;
        let change = if parameter.fixed {
            "held fixed".to_owned()
        } else if !change.is_finite() {
            format::UNKNOWN.to_owned()
        } else {
            let percent = format!("{:+.1}\u{a0}%", 100.0 * change).replace('-', "−");
            if matches!(percent.as_str(), "+0.0\u{a0}%" | "−0.0\u{a0}%") {
                "0.0\u{a0}%".to_owned()
            } else {
                percent
            }
        };
        ParameterView {
            name_html: expression::html(name),
            code: name.clone(),
            unit: parameter.unit.as_deref().map(format::unit).unwrap_or_default(),
            nominal: format::number(parameter.nominal),
            calibrated: match parameter.calibrated {
                Some(value) => format::cell(value, parameter.calibrated_ci95),
                None => format::UNKNOWN.to_owned(),
            },
            value: format::cell(parameter.value, parameter.ci95),
            change,
            fixed: parameter.fixed,
        }
    });
    rows.collect()
}

fn model_view(nominal: &str, improved: &str) -> Option<ModelView> {
    if improved.trim().is_empty() {
        return None;
    }
    let (a, b): (Vec<&str>, Vec<&str>) = (nominal.lines().collect(), improved.lines().collect());
    let edits = diff(&a, &b);
    let mut lines = Vec::with_capacity(edits.len());
    let mut rest = edits.as_slice();
    while let Some(first) = rest.first() {
        if let Edit::Same(text) = first {
            lines.push(DiffLine { class: "same", mark: " ", html: escape(text) });
            rest = &rest[1..];
            continue;
        }
        let hunk = rest.iter().take_while(|edit| !matches!(edit, Edit::Same(_))).count();
        let (changed, tail) = rest.split_at(hunk);
        push_hunk(changed, &mut lines);
        rest = tail;
    }
    let added = edits.iter().filter(|edit| matches!(edit, Edit::Added(_))).count();
    let removed = edits.iter().filter(|edit| matches!(edit, Edit::Removed(_))).count();
    Some(ModelView { lines, added, removed })
}

/// The lines of one change. An added line that stands for a removed one (the same key before the `=`)
/// follows it directly, with its new tokens marked; all other lines keep their order.
fn push_hunk(hunk: &[Edit<&str>], lines: &mut Vec<DiffLine>) {
    let removed: Vec<&str> = hunk
        .iter()
        .filter_map(|edit| if let Edit::Removed(text) = edit { Some(*text) } else { None })
        .collect();
    let key = |line: &str| line.split_once('=').map(|(key, _)| key.trim().to_owned());
    let mut shown = 0;
    let minus = |text: &str| DiffLine { class: "removed", mark: "−", html: escape(text) };
    for edit in hunk {
        let Edit::Added(text) = edit else { continue };
        let own = key(text);
        let twin = removed[shown..].iter().position(|old| own.is_some() && key(old) == own);
        let html = match twin {
            Some(offset) => {
                lines.extend(removed[shown..=shown + offset].iter().map(|old| minus(old)));
                shown += offset + 1;
                marked_tokens(removed[shown - 1], text)
            }
            None => escape(text),
        };
        lines.push(DiffLine { class: "added", mark: "+", html });
    }
    lines.extend(removed[shown..].iter().map(|old| minus(old)));
}

fn marked_tokens(old: &str, new: &str) -> String {
    let (a, b) = (expression::tokens(old), expression::tokens(new));
    let mut out = String::new();
    let mut marked = false;
    for edit in diff(&a, &b) {
        let (token, is_new) = match edit {
            Edit::Same(token) => (token, false),
            Edit::Added(token) => (token, true),
            Edit::Removed(_) => continue,
        };
        if is_new != marked {
            out.push_str(if is_new { "<mark>" } else { "</mark>" });
            marked = is_new;
        }
        out.push_str(&escape(token));
    }
    if marked {
        out.push_str("</mark>");
    }
    out
}

/// A severity in a word, and its class on the page.
fn severity(of: Severity) -> (&'static str, &'static str) {
    match of {
        Severity::Info => ("note", "info"),
        Severity::Warning => ("warning", "warning"),
        Severity::Error => ("error", "error"),
    }
}

fn findings(found: &[Finding]) -> Vec<FindingView> {
    let mut notes = notes::grouped(found);
    notes.sort_by_key(|note| std::cmp::Reverse(note.severity));
    let view = notes.into_iter().map(|note| {
        let (severity, class) = severity(note.severity);
        FindingView {
            severity,
            class,
            code: note.code.replace('_', " "),
            place: note.place,
            message: note.message,
            help: note.help,
        }
    });
    view.collect()
}
