//! The page of an identification: equations, terms, doubts, order, delay; fit and signals as on every page.

use askama::Template;

use super::{Assets, Common, Island, LawView, Scene, Shown, findings, inputs, meta};
use crate::expression::{self, escape};
use crate::identified::{DeadTime, Delay, Equation, IdentifyReport, Order, Term, VariableRole};
use crate::page::{IdentifyPage, MechanismPlot};
use crate::sentence::identified::Delays;
use crate::{ReportError, format, sentence, svg};

/// The one model of an identification.
const IDENTIFICATION: [Shown; 1] =
    [Shown { key: "improved", name: "identified", head: "Identified", note: "free run" }];

impl IdentifyPage {
    /// Renders the page.
    ///
    /// # Errors
    /// [`ReportError::Html`] or [`ReportError::Json`] if a writer fails; no content leads to that.
    pub fn to_html(&self) -> Result<String, ReportError> {
        let mut island = Island::default();
        let view = View::new(self, &mut island);
        let data = island.to_json()?;
        let template = IdentifyTemplate { view: &view, common: &view.common, assets: Assets { data: &data } };
        Ok(template.render()?)
    }
}

#[derive(Template)]
#[template(path = "identify.html")]
struct IdentifyTemplate<'a> {
    view: &'a View,
    common: &'a Common,
    assets: Assets<'a>,
}

struct View {
    common: Common,
    sentences: Vec<String>,
    equations: Vec<EquationView>,
    variables: Vec<[String; 4]>,
    orders: Vec<OrderRow>,
    criterion: String,
    curve: Option<LawView>,
    delays: Vec<DelayView>,
    model_text: String,
}

struct EquationView {
    state_html: String,
    /// With the coefficients by name, as in the model.
    symbols_html: String,
    /// With the values in their place.
    values_html: String,
    terms: Vec<TermView>,
}

struct TermView {
    term_html: String,
    parameter_html: String,
    value: String,
    interval: String,
    inclusion: String,
    /// Width of the bar of the inclusion, percent.
    bar: Option<String>,
    unit: String,
}

struct OrderRow {
    order: usize,
    value: String,
    chosen: bool,
}

struct DelayView {
    title_html: String,
    rows: Vec<(&'static str, String)>,
    warning: Option<String>,
}

impl View {
    fn new(page: &IdentifyPage, island: &mut Island) -> View {
        let report = &page.report;
        let scene = Scene {
            models: &IDENTIFICATION,
            fit: &report.fit,
            noise_floor: &report.noise_floor,
            recordings: &page.recordings,
            residuals: &page.residuals,
        };
        let common = Common {
            product: "greybox identification",
            title: page.title.clone(),
            meta: meta(&report.model, &scene),
            fit_title: "How well it predicts",
            residual_lead: "Measurement minus free run of the identified model on training data.",
            findings: findings(&report.findings),
            inputs: inputs(&report.inputs),
            ..scene.common(&report.greybox, island)
        };
        // The equations come first and are typeset.
        let all = if report.summary.is_empty() {
            sentence::identified::summary(report)
        } else {
            report.summary.clone()
        };
        let sentences = all.iter().skip(report.equations.len()).map(|text| format::tie(text)).collect();
        View {
            common,
            sentences,
            equations: report
                .equations
                .iter()
                .map(|(state, e)| equation_view(state, e, &Delays::of(report)))
                .collect(),
            variables: variables(report),
            orders: report
                .order
                .by_order
                .iter()
                .map(|o| OrderRow {
                    order: o.order,
                    value: format::significant(o.value, 6),
                    chosen: o.order == report.order.chosen,
                })
                .collect(),
            criterion: report.order.criterion.to_uppercase(),
            curve: order_curve(&report.order),
            delays: report
                .delay
                .iter()
                .map(|(state, d)| delay_view(state, d))
                .chain(report.dead_time.iter().map(|(input, d)| dead_time_view(input, d)))
                .collect(),
            model_text: page.model_text.clone(),
        }
    }
}

fn equation_view(state: &str, equation: &Equation, delays: &Delays<'_>) -> EquationView {
    EquationView {
        state_html: expression::html(state),
        symbols_html: expression::html(&equation.expression),
        values_html: values_html(equation, delays),
        terms: equation.terms.iter().map(term_view).collect(),
    }
}

/// `2.00 x″ + 1.2 x³ = f`
fn values_html(equation: &Equation, delays: &Delays<'_>) -> String {
    let late = |signal: &str, delay: f64| {
        let seconds = escape(&format::significant(delay, 4));
        format!("{}(<var>t</var> − {seconds}\u{202f}s)", expression::html(signal))
    };
    let mut out = String::new();
    let mut push = |value: f64, factor: &str| {
        out.push_str(format::joint(out.is_empty(), value));
        let size = value.abs();
        if size != 1.0 || factor.is_empty() {
            out.push_str(&escape(&format::significant(size, 4)));
            out.push_str(if factor.is_empty() { "" } else { "\u{202f}" });
        }
        out.push_str(factor);
    };
    for term in &equation.terms {
        let factor = match (delays.of_term(term), term.expression.as_str()) {
            (Some((signal, delay)), _) => late(signal, delay),
            (None, "1") => String::new(),
            (None, expression) => expression::html(expression),
        };
        push(term.value, &factor);
    }
    let right = equation.input.as_deref().map_or_else(
        || "0".to_owned(),
        |input| match delays.of_input(input) {
            Some(delay) => late(input, delay),
            None => expression::html(input),
        },
    );
    format!("{out} = {right}")
}

fn term_view(term: &Term) -> TermView {
    TermView {
        term_html: expression::html(&term.expression),
        parameter_html: term.parameter.as_deref().map(expression::html).unwrap_or_default(),
        value: format::cell(term.value, term.ci95),
        interval: format::interval(term.ci95),
        inclusion: term.inclusion.map_or_else(|| "always".to_owned(), format::probability),
        bar: term
            .inclusion
            .filter(|share| share.is_finite())
            .map(|share| format!("{:.1}", 100.0 * share.clamp(0.0, 1.0))),
        unit: term.unit.as_deref().map(format::unit).unwrap_or_default(),
    }
}

fn variables(report: &IdentifyReport) -> Vec<[String; 4]> {
    let unit = |text: &str| if text.is_empty() { "not stated".to_owned() } else { format::unit(text) };
    report
        .variables
        .iter()
        .map(|(name, variable)| {
            let role = match variable.role {
                VariableRole::State => "state",
                VariableRole::Input => "input",
            };
            [expression::html(name), role.to_owned(), unit(&variable.channel_unit), unit(&variable.unit)]
        })
        .collect()
}

/// The criterion over the order; drawn from three orders on.
fn order_curve(order: &Order) -> Option<LawView> {
    let points: Vec<[f64; 2]> =
        order.by_order.iter().filter(|o| o.value.is_finite()).map(|o| [o.order as f64, o.value]).collect();
    if points.len() < 3 {
        return None;
    }
    let criterion = order.criterion.to_uppercase();
    let plot = MechanismPlot {
        mechanism: None,
        title: format!("{criterion} over the order of the library"),
        x_label: "order".to_owned(),
        y_label: criterion.clone(),
        points: Vec::new(),
        curve: points,
    };
    let drawn = svg::law_plot(&plot, &format!("{criterion} over the order of the library"))?;
    Some(LawView { title: plot.title, svg: drawn.svg, note: String::new(), dots: false, law: true })
}

fn delay_view(state: &str, d: &Delay) -> DelayView {
    let seconds = |value: f64| format::with_unit(&format::number(value), &d.unit);
    let gain_unit = d.gain_unit.as_deref().unwrap_or_default();
    let mut rows = vec![
        ("Delay", format::with_unit(&format::with_interval(d.value, d.ci95), &d.unit)),
        ("95 % interval", format::with_unit(&format::interval(d.ci95), &d.unit)),
    ];
    rows.extend(d.bound.map(|bound| ("Cramér–Rao bound (standard deviation)", seconds(bound))));
    rows.push(("Gain", format::with_unit(&format::with_interval(d.gain, d.gain_ci95), gain_unit)));
    rows.push(match d.gain_ci95 {
        Some(ci) => ("95 % interval of the gain", format::with_unit(&format::interval(Some(ci)), gain_unit)),
        None => ("95 % interval of the gain", "held at the value given".to_owned()),
    });
    rows.extend(d.correlation.map(|rho| ("Correlation of delay and gain", format::significant(rho, 2))));
    DelayView {
        title_html: format!("Feedback of {}", expression::html(state)),
        rows,
        warning: d.warning.clone(),
    }
}

fn dead_time_view(input: &str, d: &DeadTime) -> DelayView {
    let seconds = |value: f64| format::with_unit(&format::number(value), &d.unit);
    let mut rows = vec![
        ("Dead time", format::with_unit(&format::with_interval(d.value, d.ci95), &d.unit)),
        ("95 % interval", format::with_unit(&format::interval(d.ci95), &d.unit)),
    ];
    rows.extend(d.bound.map(|bound| ("Cramér–Rao bound (standard deviation)", seconds(bound))));
    rows.push(("Longest looked for", seconds(d.longest)));
    DelayView { title_html: format!("Input {}", expression::html(input)), rows, warning: d.warning.clone() }
}
