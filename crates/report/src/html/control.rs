//! The page of a controller: what its loop reached, the law, its poles, and what it does not promise.

use askama::Template;
use greybox_control::{Margins, Metrics, Tracking, Verdict};

use super::{Assets, Common, Island, PlotData, PlotView, SeriesData, extent, quantity_html, series, span};
use crate::control::{ControlPage, IntegralAction, LawKind, Quantity};
use crate::convert::control::squared;
use crate::decimate::{Buckets, MAX_POINTS};
use crate::{ReportError, expression, format, sentence, svg};

impl ControlPage {
    /// Renders the page.
    ///
    /// # Errors
    /// [`ReportError::Html`] or [`ReportError::Json`] if a writer fails; no content leads to that.
    pub fn to_html(&self) -> Result<String, ReportError> {
        let mut island = Island::default();
        let view = View::new(self, &mut island);
        let data = island.to_json()?;
        let template = ControlTemplate { view: &view, common: &view.common, assets: Assets { data: &data } };
        Ok(template.render()?)
    }
}

#[derive(Template)]
#[template(path = "control.html")]
struct ControlTemplate<'a> {
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
    figures: Vec<[String; 3]>,
    plots: Vec<PlotView>,
    envelope: bool,
    steps: Vec<Vec<String>>,
    step_heads: Vec<(&'static str, String)>,
    family: Option<FamilyView>,
    formula_html: String,
    law_text: String,
    gains: Vec<[String; 4]>,
    settings: Vec<(&'static str, String)>,
    left_out: Vec<[String; 2]>,
    equilibrium_heads: Vec<String>,
    equilibria: Vec<Vec<String>>,
    poles: Vec<PoleRow>,
    pole_plots: Vec<PolePlot>,
    pole_key: Vec<[String; 2]>,
    tracked_html: String,
    input_html: String,
    dt: String,
    is_sliding: bool,
    is_trajectory: bool,
    reads_derivatives: bool,
    fed_back: String,
    integral_promise: &'static str,
    observer: Option<ObserverView>,
    margins: Vec<[String; 6]>,
    files: Vec<(&'static str, &'static str)>,
}

struct ObserverView {
    kind: &'static str,
    disturbance_html: String,
    integral: bool,
    at_rest: Option<[String; 3]>,
    sensors: Vec<[String; 3]>,
}

struct FamilyView {
    members: usize,
    diverged: usize,
    settled: usize,
    parameters: Vec<[String; 4]>,
    figures: Vec<[String; 4]>,
    /// A row for the model, the median and the worst plant; empty without margins.
    margins: Vec<[String; 6]>,
    unstable: usize,
}

struct PoleRow {
    set_point: String,
    cells: [String; 4],
}

struct PolePlot {
    title: &'static str,
    svg: String,
    note: &'static str,
}

impl View {
    fn new(page: &ControlPage, island: &mut Island) -> View {
        let (verdict, verdict_class) = match page.verdict {
            Verdict::Settles => ("The loop settles", "consistent"),
            Verdict::Tracks => ("The loop stays with its trajectory", "consistent"),
            Verdict::Fragile if page.is_trajectory => {
                ("The loop stays with its trajectory on the model, not on every perturbed plant", "careful")
            }
            Verdict::Strays => ("The loop does not stay with its trajectory", "careful"),
            Verdict::Fragile => ("The loop settles on the model, not on every perturbed plant", "careful"),
            Verdict::Unsettled => ("The loop does not settle at every set point", "careful"),
            Verdict::Diverges => ("The loop runs away", "failed"),
        };
        let mut sentences: Vec<String> =
            sentence::control::summary(page).iter().map(|s| format::tie(s)).collect();
        let headline = if sentences.is_empty() { String::new() } else { sentences.remove(0) };
        let none = Quantity::default();
        let tracked = page.states.get(page.tracked).map_or(&none, |s| &s.quantity);
        let limit = |value: f64| format::with_unit(&format::plain(value), &page.input.unit);
        let range = match page.limits {
            [low, high] if low == -high && high.is_finite() => format!("±{}", limit(high)),
            [low, high] if low.is_finite() && high.is_finite() => {
                format!("{} … {}", format::plain(low), limit(high))
            }
            [low, _] if low.is_finite() => format!("from {} on", limit(low)),
            [_, high] if high.is_finite() => format!("up to {}", limit(high)),
            _ => "not limited".to_owned(),
        };
        let mut meta = vec![
            (
                "Model",
                match (page.model.name.is_empty(), page.model.file.is_empty()) {
                    (false, false) => format!("{} ({})", page.model.name, page.model.file),
                    (false, true) => page.model.name.clone(),
                    _ => page.model.file.clone(),
                },
            ),
            ("Method", method(page.method).to_owned()),
            ("Tracks", expression::text(&tracked.name)),
            ("Command", format!("{}, {range}", expression::text(&page.input.name))),
            ("Every", format!("{} s", format::plain(page.dt))),
        ];
        meta.retain(|(_, value)| !value.is_empty());
        let common = Common {
            product: "greybox control",
            title: page.title.clone(),
            meta,
            thinned: page.run.t.len() > MAX_POINTS,
            version: page.producer.version.clone(),
            seed: page.producer.seed,
            ..Common::default()
        };
        let (pole_plots, pole_key) = pole_plots(page, tracked);
        View {
            common,
            verdict,
            verdict_class,
            headline,
            sentences,
            figures: figures(page, &tracked.unit),
            plots: plots(page, island),
            envelope: page.family.as_ref().is_some_and(|f| !f.tracked[0].is_empty()),
            steps: steps(page),
            step_heads: step_heads(tracked, &page.input),
            family: page.family.as_ref().map(|_| family(page)).unwrap_or_default(),
            formula_html: formula(page.method, page.reads_derivatives),
            law_text: page.law.clone(),
            gains: gains(page),
            settings: page.settings.clone(),
            left_out: page
                .left_out
                .iter()
                .map(|(equation, term)| [equation.clone(), expression::html(term)])
                .collect(),
            equilibrium_heads: page
                .states
                .iter()
                .map(|s| &s.quantity)
                .chain([&page.input])
                .map(|q| quantity_html(&q.name, &q.unit))
                .collect(),
            equilibria: page
                .set_points
                .iter()
                .map(|s| {
                    let rest = s.state.iter().chain([&s.command]).map(|v| format::number(*v));
                    rest.chain([format::significant(radius(&s.held_poles), 4)]).collect()
                })
                .collect(),
            poles: poles(page),
            pole_plots,
            pole_key,
            tracked_html: expression::html(&tracked.name),
            input_html: expression::html(&page.input.name),
            dt: format::plain(page.dt),
            is_sliding: page.method == LawKind::Smc,
            is_trajectory: page.is_trajectory,
            reads_derivatives: page.reads_derivatives,
            fed_back: fed_back(page),
            integral_promise: integral_promise(page),
            observer: page.observer.as_ref().map(|o| ObserverView {
                kind: o.kind,
                disturbance_html: expression::html(&o.disturbance),
                integral: o.integral != IntegralAction::Off,
                at_rest: match o.integral {
                    IntegralAction::AtRest { time, step, integral_time } => Some([
                        format::with_unit(&format::number(time), "s"),
                        format::with_unit(&format::number(step), &tracked.unit),
                        format::with_unit(&format::number(integral_time), "s"),
                    ]),
                    IntegralAction::Off | IntegralAction::Disturbance => None,
                },
                sensors: o
                    .sensors
                    .iter()
                    .map(|s| {
                        let size = |v: f64| match v {
                            0.0 => "none".to_owned(),
                            v => format::with_unit(&format::number(v), &s.quantity.unit),
                        };
                        [expression::html(&s.quantity.name), size(s.noise), size(s.resolution)]
                    })
                    .collect(),
            }),
            margins: margins(page),
            files: page.files.clone(),
        }
    }
}

fn method(kind: LawKind) -> &'static str {
    match kind {
        LawKind::Lqr => "linear-quadratic regulator",
        LawKind::Hjb => "optimal law by the Hamilton–Jacobi–Bellman equation",
        LawKind::Smc => "flat-output sliding mode",
    }
}

/// The law before it is written out.
/// The law's equation. One that reads derivatives is about x_d and u_d in the place of the equilibrium.
fn formula(kind: LawKind, reads_derivatives: bool) -> String {
    let of_set_points = formula_of_set_points(kind);
    if !reads_derivatives {
        return of_set_points.to_owned();
    }
    of_set_points
        .replace("<sub>e</sub>(<var>r</var>)", "<sub>d</sub>")
        .replace("<var>f</var>(<var>x</var>) +", "(<var>f</var>(<var>x</var>) − <var>ẋ</var><sub>d</sub>) +")
}

fn formula_of_set_points(kind: LawKind) -> &'static str {
    match kind {
        LawKind::Lqr => {
            "<var>u</var> = <var>u</var><sub>e</sub>(<var>r</var>) − <var>K</var>\u{202f}(<var>x</var> − \
             <var>x</var><sub>e</sub>(<var>r</var>))"
        }
        LawKind::Hjb => {
            "<var>u</var> = <var>u</var><sub>e</sub>(<var>r</var>) − ½\u{202f}<var>R</var><sup>−1</sup> \
             <var>g</var>(<var>x</var>)<sup>T</sup>\u{202f}∇<var>V</var>(<var>x</var> − \
             <var>x</var><sub>e</sub>(<var>r</var>))"
        }
        LawKind::Smc => {
            "<var>u</var> = −(<var>L</var>\u{202f}<var>f</var>(<var>x</var>) + (<var>η</var>/<var>φ</var>) \
             sat<sub><var>φ</var></sub>(<var>s</var>)) / (<var>L</var>\u{202f}<var>g</var>(<var>x</var>)), \
             \u{2003}<var>s</var> = <var>L</var>\u{202f}(<var>x</var> − <var>x</var><sub>e</sub>(<var>r</var>))"
        }
    }
}

/// What the law of the simulated loop is given.
fn fed_back(page: &ControlPage) -> String {
    let what = match &page.observer {
        None => "every state known".to_owned(),
        Some(o) => format!("what its {} makes of the sensors", o.kind),
    };
    if page.delay == 0.0 { what } else { format!("{what}, {} s late", format::number(page.delay)) }
}

/// A row for each set point that has margins.
fn margins(page: &ControlPage) -> Vec<[String; 6]> {
    let unit = page.states.get(page.tracked).map_or("", |s| s.quantity.unit.as_str());
    let row = |s: &crate::control::SetPoint| {
        Some(margin_row(format::with_unit(&format::plain(s.value), unit), &s.margins?))
    };
    page.set_points.iter().filter_map(row).collect()
}

/// Of whom, gain, lower gain, phase, delay, sensitivity.
fn margin_row(of: String, m: &Margins) -> [String; 6] {
    let bounded = |v: f64| if v.is_finite() { format::number(v) } else { "any".to_owned() };
    [
        of,
        bounded(m.gain),
        format::number(m.lower_gain),
        format::number(m.phase.to_degrees()),
        bounded(m.delay),
        if m.sensitivity.is_finite() { format::number(m.sensitivity) } else { "unbounded".to_owned() },
    ]
}

/// The headline figures: name, value, what it is.
fn figures(page: &ControlPage, unit: &str) -> Vec<[String; 3]> {
    let worst = |of: fn(&Metrics) -> f64| page.steps.iter().map(of).fold(0.0, f64::max);
    let number = |v: f64, unit: &str| format::with_unit(&format::number(v), unit);
    let mut out = Vec::new();
    let mut push =
        |name: &str, value: String, small: &str| out.push([name.to_owned(), value, small.to_owned()]);
    if page.is_trajectory {
        let value = |of: fn(&Tracking) -> f64, unit: &str| {
            page.tracking.as_ref().map_or_else(|| "not reached".to_owned(), |t| number(of(t), unit))
        };
        push("RMS error", value(|t| t.later_error.rms, unit), "after the first quarter of the time");
        push("Largest error", value(|t| t.later_error.largest, unit), "after the first quarter of the time");
        push("Largest error at all", value(|t| t.error.largest, unit), "over the whole of the time");
        push("Largest command", value(|t| t.largest_command, &page.input.unit), "magnitude");
        let saturated = page.tracking.as_ref().map(|t| format::percent_short(t.saturated));
        push("At its limit", saturated.unwrap_or_else(|| format::UNKNOWN.to_owned()), "of the samples");
        push("∫ u² dt", value(|t| t.effort, &squared(&page.input.unit)), "over the whole of the time");
    } else {
        let settled = page.steps.iter().all(|s| s.settling.is_some()) && !page.steps.is_empty();
        let settling = if settled {
            number(worst(|s| s.settling.unwrap_or(0.0)), "s")
        } else {
            "not reached".to_owned()
        };
        push("Settling", settling, "to 2 % of the step, slowest");
        push("Overshoot", format::percent_short(worst(|s| s.overshoot)), "of the step, largest");
        push("Final error", number(worst(|s| s.final_error.abs()), unit), "largest");
        push("Largest command", number(worst(|s| s.largest_command), &page.input.unit), "magnitude");
        push("At its limit", format::percent_short(worst(|s| s.saturated)), "of a step’s samples, most");
    }
    if let Some(family) = &page.family {
        let value = format!("{} of {}", family.settled, family.members);
        let do_what = if page.is_trajectory { "stay with it" } else { "settle" };
        let small = match family.diverged {
            0 => format!("{do_what}; none diverges"),
            1 => format!("{do_what}; one diverges"),
            n => format!("{do_what}; {n} diverge"),
        };
        push("Perturbed plants", value, &small);
    }
    out
}

/// Tracking, command, and the other states.
fn plots(page: &ControlPage, island: &mut Island) -> Vec<PlotView> {
    let run = &page.run;
    let buckets = Buckets::even(run.t.len(), MAX_POINTS);
    let axis = island.axis(buckets.axis(&run.t));
    let mut out = Vec::new();
    let mut push =
        |quantity: &Quantity, what: &str, values: &[f64], lines: Vec<Option<SeriesData>>, height| {
            let lines: Vec<SeriesData> = lines.into_iter().flatten().collect();
            let band = lines.iter().filter(|l| l.role == "envelope").count() == 2;
            let alt = format!(
                "{what} {} over {}{}",
                expression::text(&quantity.name),
                span(&run.t),
                extent(values, &quantity.unit)
            );
            let plot = PlotData {
                kind: "time",
                axis,
                sync: "loop".to_owned(),
                height,
                x: "time in s",
                series: lines,
                bands: Vec::new(),
                fills: if band { vec![[1, 0]] } else { Vec::new() },
                sigma: None,
                split: None,
            };
            out.push(PlotView {
                index: island.push(plot),
                title_html: format!("{what} {}", quantity_html(&quantity.name, &quantity.unit)),
                note: String::new(),
                alt,
            });
        };
    let line = |label: &str, role: &'static str, values: &[f64]| series(label, role, &buckets, values);
    let envelope = |of: &[Vec<f64>; 2]| {
        [line("lowest plant", "envelope", &of[0]), line("highest plant", "envelope", &of[1])]
    };
    if let Some((quantity, values)) = run.states.get(run.tracked) {
        let mut lines: Vec<Option<SeriesData>> = Vec::new();
        if let Some(family) = &page.family {
            lines.extend(envelope(&family.tracked));
        }
        lines.push(line(
            if page.is_trajectory { "trajectory" } else { "set point" },
            "reference",
            &run.reference,
        ));
        lines.push(line(&expression::text(&quantity.name), "improved", values));
        push(quantity, "Tracked", values, lines, 300);
    }
    let mut lines: Vec<Option<SeriesData>> = Vec::new();
    if let Some(family) = &page.family {
        lines.extend(envelope(&family.command));
    }
    for (label, limit) in ["lower limit", "upper limit"].into_iter().zip(page.limits) {
        lines.push(line(label, "limit", &vec![limit; run.t.len()]));
    }
    lines.push(line(&expression::text(&page.input.name), "command", &run.command));
    push(&page.input, "Command", &run.command, lines, 230);
    for (i, (quantity, values)) in run.states.iter().enumerate() {
        if i != run.tracked {
            let lines = vec![line(&expression::text(&quantity.name), "improved", values)];
            push(quantity, "State", values, lines, 170);
        }
    }
    out
}

fn step_heads(tracked: &Quantity, input: &Quantity) -> Vec<(&'static str, String)> {
    let unit =
        |unit: &str| if unit.is_empty() { String::new() } else { format!("in {}", format::unit(unit)) };
    let squared = squared(&input.unit);
    vec![
        ("Set point", unit(&tracked.unit)),
        ("Step", unit(&tracked.unit)),
        ("Settling to 2 %", unit("s")),
        ("Overshoot", "of the step".to_owned()),
        ("Final error", unit(&tracked.unit)),
        ("Peak to peak at rest", unit(&tracked.unit)),
        ("RMS error", unit(&tracked.unit)),
        ("Largest command", unit(&input.unit)),
        ("At its limit", "of the samples".to_owned()),
        ("∫ u² dt", unit(&squared)),
    ]
}

fn steps(page: &ControlPage) -> Vec<Vec<String>> {
    let row = |s: &Metrics| {
        vec![
            format::plain(s.set_point),
            format::number(s.step),
            s.settling.map_or_else(|| "not reached".to_owned(), format::number),
            format::percent_short(s.overshoot),
            format::number(s.final_error),
            format::number(s.peak_to_peak),
            format::number(s.rms_error),
            format::number(s.largest_command),
            format::percent_short(s.saturated),
            format::number(s.effort),
        ]
    };
    page.steps.iter().map(row).collect()
}

fn family(page: &ControlPage) -> Option<FamilyView> {
    let family = page.family.as_ref()?;
    let value = |v: f64, unit: &str| match unit {
        _ if v.is_infinite() => "not reached".to_owned(),
        "%" => format::percent_short(v),
        unit => format::with_unit(&format::number(v), unit),
    };
    let parameter = |(quantity, value, deviation): &(Quantity, f64, f64)| {
        [
            expression::html(&quantity.name),
            format::number(*value),
            format::number(*deviation),
            format::unit(&quantity.unit),
        ]
    };
    let margins = family.margins.iter().flat_map(|m| {
        [("Model", m.own), ("Median plant", m.median), ("Worst plant", m.worst)]
            .map(|(of, margins)| margin_row(of.to_owned(), &margins))
    });
    Some(FamilyView {
        margins: margins.collect(),
        unstable: family.margins.map_or(0, |m| m.unstable),
        members: family.members,
        diverged: family.diverged,
        settled: family.settled,
        parameters: family.deviations.iter().map(parameter).collect(),
        figures: family
            .figures
            .iter()
            .map(|f| {
                [f.name.to_owned(), value(f.own, &f.unit), value(f.median, &f.unit), value(f.worst, &f.unit)]
            })
            .collect(),
    })
}

fn gains(page: &ControlPage) -> Vec<[String; 4]> {
    let unit = |state: &str| match (page.input.unit.as_str(), state) {
        ("" | "1", "" | "1") => String::new(),
        (input, "" | "1") => input.to_owned(),
        ("" | "1", state) => format!("1/({state})"),
        (input, state) if state.contains(['/', ' ', '*']) => format!("{input}/({state})"),
        (input, state) => format!("{input}/{state}"),
    };
    let row = |s: &crate::control::LawState| {
        [
            expression::html(&s.quantity.name),
            format::number(s.gain),
            format::unit(&unit(&s.quantity.unit)),
            format::with_unit(&format::plain(s.size), &s.quantity.unit),
        ]
    };
    page.states.iter().map(row).collect()
}

/// What the integral action does not do.
fn integral_promise(page: &ControlPage) -> &'static str {
    match page.observer.as_ref().map_or(IntegralAction::Off, |o| o.integral) {
        IntegralAction::Off => {
            "There is no integral action: a wrong parameter, a load or friction that holds leaves an error that stays."
        }
        IntegralAction::Disturbance => {
            "The disturbance takes out what acts like a constant command. What acts elsewhere, or faster than the observer follows, \
             leaves an error or a motion that does not end."
        }
        IntegralAction::AtRest { .. } => {
            "In motion there is no integral action: a load that the law does not know acts until the machine stops, and is taken \
             out then."
        }
    }
}

/// A row for each pole; of a pair, one.
fn poles(page: &ControlPage) -> Vec<PoleRow> {
    let unit = page.states.get(page.tracked).map_or("", |s| s.quantity.unit.as_str());
    let mut out = Vec::new();
    for point in &page.set_points {
        for [re, im] in point.poles.iter().filter(|p| p[1] >= 0.0) {
            let size = re.hypot(*im);
            let pole = match *im {
                0.0 => format::number(*re),
                im => format!("{} ± {}\u{202f}i", format::number(*re), format::number(im)),
            };
            out.push(PoleRow {
                set_point: format::with_unit(&format::plain(point.value), unit),
                cells: [
                    pole,
                    format::number(size / std::f64::consts::TAU),
                    if size > 0.0 { format::significant(-re / size, 2) } else { format::UNKNOWN.to_owned() },
                    format::number(-1.0 / re),
                ],
            });
        }
    }
    out
}

fn radius(poles: &[[f64; 2]]) -> f64 {
    poles.iter().map(|[re, im]| re.hypot(*im)).fold(0.0, f64::max)
}

/// Both planes, and which mark is which set point.
fn pole_plots(page: &ControlPage, tracked: &Quantity) -> (Vec<PolePlot>, Vec<[String; 2]>) {
    let continuous: Vec<&[[f64; 2]]> = page.set_points.iter().map(|s| s.poles.as_slice()).collect();
    let held: Vec<&[[f64; 2]]> = page.set_points.iter().map(|s| s.held_poles.as_slice()).collect();
    let count = continuous.first().map_or(0, |p| p.len());
    let points = page.set_points.len();
    let alt = |what: &str| {
        format!("{what}: {count} poles at each of {points} set points; the table has their numbers")
    };
    let mut out = Vec::new();
    let s = svg::pole_plot(&continuous, svg::Plane::Continuous, &alt("Poles in the s plane"));
    out.extend(s.map(|svg| PolePlot {
        title: "Continuous loop",
        svg,
        note: "Left of the line through zero the loop is stable.",
    }));
    let z = svg::pole_plot(&held, svg::Plane::Sampled, &alt("Poles in the z plane"));
    out.extend(z.map(|svg| PolePlot {
        title: "Command held over the sample time",
        svg,
        note: "Inside the unit circle the loop is stable.",
    }));
    let key = page.set_points.iter().enumerate().map(|(k, s)| {
        let value = format::with_unit(&format::plain(s.value), &tracked.unit);
        [svg::pole_mark(k).to_owned(), format!("set point {value}")]
    });
    (out, key.collect())
}
