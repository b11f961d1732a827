//! The result of an identification in plain language, worded from the numbers of an [`IdentifyReport`].

use crate::contract::{FitSet, Ordered};
use crate::identified::{DeadTime, Delay, Equation, IdentifyReport, Term};
use crate::{expression, format};

/// Correlation of delay and gain beyond which a warning is due.
const ENTANGLED: f64 = 0.95;

/// What is left over the noise, as a ratio, beyond which the equation is called incomplete. The noise itself
/// is known to about ten percent only.
const INCOMPLETE: f64 = 1.3;

/// The summary: the equations first, then how well they predict, then every doubt.
pub fn summary(report: &IdentifyReport) -> Vec<String> {
    let mut out: Vec<String> = report
        .equations
        .iter()
        .map(|(state, e)| format!("Equation of {state}: {}.", with_values(e, &Delays::of(report))))
        .collect();
    out.extend(prediction(report));
    out.extend(report.misfit.iter().filter(|(_, misfit)| **misfit > INCOMPLETE).map(|(channel, misfit)| {
        format!(
            "What the equation leaves of {} is {} times the noise: it may lack a term that the library does not have.",
            expression::text(channel),
            format::significant(*misfit, 2)
        )
    }));
    out.extend(report.equations.iter().flat_map(|(state, e)| doubts(state, e, report.equations.len() > 1)));
    out.extend(report.delay.iter().map(|(state, d)| delay(state, d)));
    out.extend(report.delay.values().filter_map(|d| d.warning.clone()));
    out.extend(report.dead_time.iter().map(|(input, d)| dead_time(input, d)));
    out.extend(report.dead_time.values().filter_map(|d| d.warning.clone()));
    out
}

/// `2 x″ + 0.9 x′ + 1.2 x³ = f`, values to four digits.
pub fn with_values(equation: &Equation, delays: &Delays<'_>) -> String {
    let mut text = String::new();
    for term in &equation.terms {
        let factor = match (delays.of_term(term), term.expression.as_str()) {
            (Some((signal, delay)), _) => late(signal, delay),
            (None, "1") => String::new(),
            (None, expression) => expression::text(expression),
        };
        push_signed(&mut text, term.value, &factor);
    }
    let right = equation.input.as_deref().map_or_else(
        || "0".to_owned(),
        |input| match delays.of_input(input) {
            Some(delay) => late(input, delay),
            None => expression::text(input),
        },
    );
    format!("{text} = {right}")
}

/// `f(t − 0.073 s)`, or `f` where the delay is none.
fn late(signal: &str, delay: f64) -> String {
    let signal = expression::text(signal);
    match delay == 0.0 {
        true => signal,
        false => format!("{signal}(t − {} s)", format::significant(delay, 4)),
    }
}

/// The delays of a report.
#[derive(Debug, Clone, Copy)]
pub struct Delays<'a> {
    feedback: &'a Ordered<Delay>,
    inputs: &'a Ordered<DeadTime>,
}

impl<'a> Delays<'a> {
    /// Those of this report.
    pub fn of(report: &'a IdentifyReport) -> Delays<'a> {
        Delays { feedback: &report.delay, inputs: &report.dead_time }
    }

    /// The dead time of an input, s.
    pub(crate) fn of_input(&self, input: &str) -> Option<f64> {
        self.inputs.get(input).map(|d| d.value)
    }

    /// The state or input of a term `delay(q, tau)`, and the delay, s.
    pub(crate) fn of_term<'t>(&self, term: &'t Term) -> Option<(&'t str, f64)> {
        let inside = term.expression.strip_prefix("delay(")?;
        let signal = inside.split(',').next()?.trim();
        let delay = self.feedback.get(signal).map(|d| d.value).or_else(|| self.of_input(signal))?;
        Some((signal, delay))
    }
}

fn push_signed(text: &mut String, value: f64, factor: &str) {
    text.push_str(format::joint(text.is_empty(), value));
    let size = value.abs();
    if size != 1.0 || factor.is_empty() {
        text.push_str(&format::significant(size, 4));
        if !factor.is_empty() {
            // A factor that begins with a digit would read as part of the number.
            text.push_str(if factor.starts_with(|c: char| c.is_ascii_digit()) { "·" } else { " " });
        }
    }
    text.push_str(factor);
}

/// How well the model predicts what it never saw.
fn prediction(report: &IdentifyReport) -> Option<String> {
    let held = !report.fit.holdout.is_empty();
    let set = if held { &report.fit.holdout } else { &report.fit.train };
    let where_ = if held { "held-out" } else { "training" };
    let parts: Vec<String> = channels(report, set);
    if parts.is_empty() {
        return None;
    }
    Some(format!(
        "Running freely, the model follows the {where_} data with an error of {}.",
        super::joined(&parts, "and")
    ))
}

/// `1.2 % (noise alone 1.1 %)` for each channel, with its name where there are several.
fn channels(report: &IdentifyReport, set: &FitSet) -> Vec<String> {
    let several = set.improved.len() > 1;
    set.improved
        .iter()
        .map(|(channel, score)| {
            let of = if several { format!(" of {}", expression::text(channel)) } else { String::new() };
            let noise = match report.noise_floor.contains_key(channel) {
                true => {
                    let floor = report.fit.floor_in(set, channel, &report.noise_floor);
                    format!(" (noise alone {})", format::percent_short(floor))
                }
                false => String::new(),
            };
            if score.nrmse.is_finite() {
                format!("{}{of}{noise}", format::percent_short(score.nrmse))
            } else {
                format!("no finite size{of}: the simulation diverges")
            }
        })
        .collect()
}

/// The terms in doubt, one sentence for those that were kept and one for those left out.
pub fn doubts(state: &str, equation: &Equation, several: bool) -> Vec<String> {
    let of = if several { format!(" in the equation of {}", expression::text(state)) } else { String::new() };
    let named = |chosen: bool| -> Vec<String> {
        let those = equation.doubtful.iter().filter(|d| d.chosen == chosen);
        those
            .map(|d| format!("{} ({})", expression::text(&d.expression), format::probability(d.inclusion)))
            .collect()
    };
    let (kept, left_out) = (named(true), named(false));
    let mut out = Vec::new();
    if !kept.is_empty() {
        out.push(format!(
            "Kept{of}, but not surely there: {}; in brackets the share of resampled data that choose it.",
            super::joined(&kept, "and")
        ));
    }
    if !left_out.is_empty() {
        out.push(format!(
            "Left out{of}, but not ruled out: {}; in brackets the share of resampled data that choose it.",
            super::joined(&left_out, "and")
        ));
    }
    out
}

fn delay(state: &str, d: &Delay) -> String {
    format!(
        "The feedback of {} is delayed by {}; its gain is {}{}.",
        expression::text(state),
        format::with_unit(&format::with_interval(d.value, d.ci95), "s"),
        format::with_unit(
            &format::with_interval(d.gain, d.gain_ci95),
            d.gain_unit.as_deref().unwrap_or_default()
        ),
        if d.gain_ci95.is_none() { " (as given)" } else { "" }
    )
}

/// The warning where delay and gain cannot be told apart, or the delay from none.
///
/// A feedback that is slow against the delay acts as k_p q − k_p τ q′: only the sum of k_p with the
/// stiffness and the product k_p τ (with the damping) show in the recordings.
pub fn delay_warning(d: &Delay) -> Option<String> {
    let entangled = d.correlation.filter(|rho| rho.abs() > ENTANGLED);
    let mut parts = Vec::new();
    if let Some(rho) = entangled {
        let rho = if rho.abs() < 0.9995 { format::significant(rho, 3) } else { "beyond ±0.999".to_owned() };
        parts.push(format!(
            "delay and gain move together (correlation {rho}): these recordings hardly separate them; give the gain \
             with --gain, or record faster motion"
        ));
    }
    if d.ci95.is_none_or(|ci| ci.low.is_nan() || ci.low <= 0.0) {
        parts.push(
            "the interval of the delay holds zero or is unknown: a feedback without delay may explain these \
             recordings as well"
                .to_owned(),
        );
    }
    if d.gain_ci95.is_some_and(|ci| ci.low <= 0.0 && ci.high >= 0.0) {
        parts.push(
            "the interval of the gain holds zero: these recordings do not show that there is such a feedback"
                .to_owned(),
        );
    }
    if parts.is_empty() {
        return None;
    }
    let text = parts.join("; ");
    let mut letters = text.chars();
    let first = letters.next().map(|c| c.to_uppercase().collect::<String>()).unwrap_or_default();
    Some(format!("{first}{}.", letters.as_str()))
}

fn dead_time(input: &str, d: &DeadTime) -> String {
    format!(
        "The dead time of {} is {}.",
        expression::text(input),
        format::with_unit(&format::with_interval(d.value, d.ci95), "s")
    )
}

/// The warning where a dead time ended on the longest looked for, or cannot be told from none.
pub fn dead_time_warning(input: &str, d: &DeadTime) -> Option<String> {
    let name = expression::text(input);
    match d.ci95 {
        None => Some(format!(
            "The dead time of {name} ended on the longest looked for, {} s, or its interval is unknown: it may be longer; \
             allow more with --dead-time {input}=SECONDS.",
            format::number(d.longest)
        )),
        Some(ci) if ci.low.is_nan() || ci.low <= 0.0 => Some(format!(
            "The interval of the dead time of {name} holds zero: these recordings do not tell it from none; it is at most {} \
             s.",
            format::significant(ci.high, 2)
        )),
        Some(_) => None,
    }
}
