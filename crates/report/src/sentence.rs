//! The conclusion in plain language, worded from the numbers of a [`Report`]; [`identified`] does the same
//! for an identification, [`recordings`] for many recordings, [`machines`] for many machines.

pub mod comparison;
pub mod control;
pub mod identified;
pub mod machines;
pub mod recordings;

use crate::contract::{
    Alternative, Criterion, Fit, Gate, Interval, Location, Mechanism, Names, RejectedLaw, Report, Score,
    Verdict,
};
use crate::{expression, format};

/// Forces of free shape that explain less of the residual than this explain nothing.
const SHAPELESS: f64 = 0.05;

/// A held-out error that is larger by less than this is the same.
const LOSS: f64 = 1.02;

/// The summary of a report: the headline first, then what a reader must know beside it.
///
/// Every number is taken from the report as it is. Meant to fill [`Report::summary`]; the page uses it where
/// that is empty.
pub fn summary(report: &Report) -> Vec<String> {
    let mut out = Vec::new();
    match report.verdict {
        Verdict::Consistent => {
            let agrees = "The model agrees with the recordings: once its parameters are calibrated,";
            out.push(match report.remainder.significant {
                true => {
                    format!("{agrees} what is left passes for measurement noise, but for a small part of it.")
                }
                false => format!("{agrees} nothing beyond measurement noise is missing."),
            });
            out.extend(error_change(&report.fit, Baseline::Nominal).map(|change| {
                format!(
                    "Calibration changes the held-out error{} from {} to {}.",
                    change.of, change.from, change.to
                )
            }));
        }
        Verdict::Unexplained => unexplained(report, &mut out),
        Verdict::MissingPhysics => {
            missing(report, &mut out);
            out.extend(beside(report));
        }
    }
    if report.verdict != Verdict::Unexplained && report.remainder.significant {
        out.push(format!(
            "Something smaller is still missing{}: {} of the calibrated model's residual is left and is not noise.",
            place(&report.remainder.location),
            format::probability(report.remainder.share_of_residual)
        ));
    }
    if let (Criterion::Windowed, Some(window)) = (report.fit.criterion, report.fit.window_s) {
        out.push(format!(
            "Small errors of the initial state grow beyond the signal within a free run of this machine: simulations \
             restarted every {} s judge the models.",
            format::significant(window, 3)
        ));
    }
    for (name, hold) in &report.inputs {
        if hold.hold_given != hold.hold_best {
            out.push(format!(
                "Input {} is stated with hold {}, but the recordings fit {} better.",
                expression::text(name),
                hold.hold_given.replace('_', " "),
                hold.hold_best.replace('_', " ")
            ));
        }
    }
    out
}

/// What is told where no name is believed, or none was looked for.
fn unexplained(report: &Report, out: &mut Vec<String>) {
    if report.terms_only && !report.candidates.is_empty() {
        let terms = sums(&report.candidates).unwrap_or_else(|| joined_laws(&report.candidates));
        out.push(format!("Terms are missing from the model: {terms}{}.", change(&report.fit)));
        out.extend(losses(&report.fit));
        out.push("The terms have no names: `greybox diagnose` looks for mechanisms.".to_owned());
        return;
    }
    let place = place(&report.remainder.location);
    let share = format::probability(report.remainder.share_of_residual);
    let what = if report.terms_only { "term" } else { "mechanism" };
    out.push(if report.remainder.share_of_residual < SHAPELESS {
        format!(
            "Something is missing from the model{place}, and neither a {what} of the library nor a force of any other \
             shape explains it ({share} of the residual). Look at the model before its physics: the signs, the units, \
             and what each channel measures (`greybox check --model` tells)."
        )
    } else {
        format!(
            "Something is missing from the model{place}, and no {what} in the library explains it; it makes up {share} of \
             the residual."
        )
    });
    out.extend(proposed(report));
    out.extend(rejected(report));
    let experiment = report.remainder.experiment.as_deref();
    out.extend(experiment.map(|e| format!("To find out what it is: {}.", e.trim_end_matches('.'))));
}

/// The laws that were tried in place of what has no name and are not handed back, and why.
pub fn rejected(report: &Report) -> Option<String> {
    let closure = report.closure_rejected.as_ref()?;
    let why = match closure.gate {
        Gate::Clock => "it acts at certain times of a single recording, and nothing says that it acts again",
        Gate::Determined => "the recordings do not determine its coefficients",
        Gate::Training => "it simulates whole recordings worse than the calibrated model",
        Gate::Inertia => "it makes an inertia negative",
        Gate::Parameters => "with it the machine's own parameters are far from what the model states of them",
        Gate::CrossValidation => {
            "it does not predict data that it was not fitted to better than the calibrated model"
        }
        Gate::Comparison => "it does no better than the improved model",
        Gate::Names => "it leaves more than noise and lacks a law that is named",
    };
    let law =
        |law: &RejectedLaw| format!("{}{}", expression::text(&law.expression), equations(&law.equation));
    let laws: Vec<String> = closure.laws.iter().map(law).collect();
    Some(format!("Tried and rejected: {}. As a model of what is missing, {why}.", joined(&laws, "and")))
}

/// How the held-out error changes from the calibrated to the improved model, to end a sentence with.
fn change(fit: &Fit) -> String {
    error_change(fit, Baseline::Calibrated)
        .map(|c| format!(": the held-out error{} falls from {} to {}", c.of, c.from, c.to))
        .unwrap_or_default()
}

/// What the improved model holds where no name is believed.
fn proposed(report: &Report) -> Vec<String> {
    if report.candidates.is_empty() {
        return Vec::new();
    }
    let change = change(&report.fit);
    let mut out = vec![format!(
        "The improved model has in its stead {} and predicts what it was not fitted to better than the calibrated \
         one{change}. What is missing may be something else.",
        laws(&report.candidates)
    )];
    out.extend(losses(&report.fit));
    out
}

/// What the improved model holds beside the mechanisms that are believed.
fn beside(report: &Report) -> Option<String> {
    let change = change(&report.fit);
    (!report.candidates.is_empty()).then(|| {
        format!(
            "The improved model also has {} and predicts what it was not fitted to better than the calibrated \
             one{change}. What stands beside the named may be something else.",
            laws(&report.candidates)
        )
    })
}

/// What is proposed: each candidate with its law, or the sums of several forces.
fn laws(candidates: &[Mechanism]) -> String {
    match sums(candidates) {
        Some(sums) if candidates.len() > 1 => format!("the terms {sums}, proposed and not named,"),
        _ => joined_laws(candidates),
    }
}

/// Each candidate with its law.
fn joined_laws(candidates: &[Mechanism]) -> String {
    joined(&candidates.iter().map(law).collect::<Vec<_>>(), "and")
}

/// Forces times one coefficient each, one sum for each equation: `0.0533·θ − 0.197·θ³ in the hub equation`; `None` where
/// a candidate is none.
fn sums(candidates: &[Mechanism]) -> Option<String> {
    let terms: Vec<Term<'_>> = candidates.iter().map(term).collect::<Option<_>>()?;
    let mut sums: Vec<(&Names, String)> = Vec::new();
    for term in &terms {
        let known = sums.iter().position(|s| s.0.as_slice() == term.equations.as_slice());
        let at = known.unwrap_or_else(|| {
            sums.push((term.equations, String::new()));
            sums.len() - 1
        });
        let sum = &mut sums[at].1;
        let joint = format::joint(sum.is_empty(), term.coefficient);
        let times = if term.function.is_empty() { "" } else { "·" };
        let size = format::number(term.coefficient.abs());
        sum.push_str(&format!("{joint}{size}{times}{}", term.function));
    }
    let sums: Vec<String> =
        sums.into_iter().map(|(names, sum)| format!("{sum}{}", equations(names))).collect();
    let memory: Vec<String> = terms.into_iter().flat_map(|term| term.memory).collect();
    let memory = if memory.is_empty() { String::new() } else { format!(", with {}", joined(&memory, "and")) };
    Some(format!("{}{memory} (SI units)", joined(&sums, "and")))
}

/// A force that is one coefficient times a function.
#[derive(Debug, PartialEq)]
struct Term<'a> {
    equations: &'a Names,
    coefficient: f64,
    /// The function, its constants as numbers.
    function: String,
    /// The equations of the states that the function remembers by, likewise: `z′ = 0.32·(x − z)`.
    memory: Vec<String>,
}

/// A candidate as a term; `None` where its force is none.
fn term(candidate: &Mechanism) -> Option<Term<'_>> {
    let value = |name: &str| {
        let (_, estimate) = candidate.parameters.iter().find(|(known, _)| *known == name)?;
        Some(estimate.value)
    };
    let numbers = |tokens: &[&str]| -> String {
        let number = |token: &&str| match value(token) {
            Some(value) if value < 0.0 => format!("({})", format::number(value)),
            Some(value) => format::number(value),
            None => (*token).to_owned(),
        };
        expression::text(&tokens.iter().map(number).collect::<String>())
    };
    let tokens = expression::tokens(&candidate.expression);
    let (sign, tokens) = match &tokens[..] {
        ["-", rest @ ..] => (-1.0, rest),
        all => (1.0, all),
    };
    let (coefficient, rest) = match tokens {
        [first] => (value(first)?, &[][..]),
        [first, "*", rest @ ..] if !rest.contains(first) => (value(first)?, rest),
        _ => return None,
    };
    let mut depth = 0;
    let is_sum = rest.iter().any(|token| {
        depth += match *token {
            "(" => 1,
            ")" => -1,
            _ => 0,
        };
        depth == 0 && matches!(*token, "+" | "-")
    });
    let memory = candidate.states.iter().map(|(_, equation)| numbers(&expression::tokens(equation)));
    (!is_sum).then(|| Term {
        equations: &candidate.equation,
        coefficient: sign * coefficient,
        function: numbers(rest),
        memory: memory.collect(),
    })
}

/// A candidate and its law.
fn law(candidate: &Mechanism) -> String {
    format!("{} ({})", format::kind_in_sentence(&candidate.kind), expression::text(&candidate.expression))
}

fn missing(report: &Report, out: &mut Vec<String>) {
    // (What others do beside them is told with these.)
    let all = report.candidates.is_empty();
    let change = all.then(|| error_change(&report.fit, Baseline::Calibrated)).flatten();
    let single = report.mechanisms.len() == 1;
    for mechanism in &report.mechanisms {
        let mut sentence = mechanism_sentence(mechanism);
        if let (true, Some(change)) = (single, &change) {
            sentence.push_str(&format!(
                "; held-out error{} falls from {} to {}",
                change.of, change.from, change.to
            ));
        }
        sentence.push('.');
        out.push(sentence);
    }
    if let (false, Some(change)) = (single, change) {
        let all = match report.mechanisms.len() {
            2 => "both".to_owned(),
            n => format!("all {n}"),
        };
        out.push(format!(
            "With {all} mechanisms the held-out error{} falls from {} to {}.",
            change.of, change.from, change.to
        ));
    }
    out.extend(losses(&report.fit));
    for mechanism in &report.mechanisms {
        out.extend(inseparable(mechanism));
    }
}

/// What the recordings cannot separate from a mechanism: each name once, and none that is its own.
fn inseparable(mechanism: &Mechanism) -> Option<String> {
    let equivalent = || mechanism.alternatives.iter().filter(|alternative| alternative.equivalent);
    let kind = format::kind_in_sentence(&mechanism.kind);
    let placed = own_name(mechanism);
    let (mut twins, mut elsewhere): (Vec<String>, bool) = (Vec::new(), false);
    for alternative in equivalent() {
        let twin = alternative_name(alternative, mechanism);
        // Of its own kind, one at another place says something.
        if twin != kind && twin != placed && !twins.contains(&twin) {
            twins.push(twin);
            elsewhere |= alternative.kind == mechanism.kind;
        }
    }
    let own = if elsewhere { placed } else { kind };
    (!twins.is_empty())
        .then(|| format!("These recordings cannot separate {own} from {}.", joined(&twins, "or")))
}

/// The kind of a mechanism with its place, for the middle of a sentence.
fn own_name(mechanism: &Mechanism) -> String {
    let channel = mechanism.channel.clone().map(Names::One);
    let symbol = mechanism.replaces.as_ref().or(mechanism.drifting.as_ref());
    let equation = mechanism.location.equation.as_ref().unwrap_or(&mechanism.equation);
    named(&mechanism.kind, channel.as_ref(), symbol, Some(equation))
}

/// The name of an alternative of a mechanism for the middle of a sentence: with the channel, the input or the parameter
/// that it is about, and with its equation where that, or the kind, does not say enough: `input offset of v`, `viscous
/// friction in the hub equation`.
pub fn alternative_name(alternative: &Alternative, mechanism: &Mechanism) -> String {
    let a = alternative;
    let symbol = a.replaces.as_ref().or(a.drifting.as_ref());
    let is = |names: &Names| {
        let mut sorted: [Vec<&String>; 2] =
            [a.equation.iter().flat_map(Names::as_slice).collect(), names.as_slice().iter().collect()];
        sorted.iter_mut().for_each(|names| names.sort());
        sorted[0] == sorted[1]
    };
    let elsewhere = !is(&mechanism.equation) && !mechanism.location.equation.as_ref().is_some_and(is);
    let same_kind = |other: &&Alternative| other.kind == a.kind && other.equation != a.equation;
    let ambiguous = a.kind == mechanism.kind || mechanism.alternatives.iter().any(|other| same_kind(&other));
    let equation = a.equation.as_ref().filter(|_| elsewhere || ambiguous);
    named(&a.kind, a.channel.as_ref(), symbol, equation)
}

/// A kind and its place: the symbol that it is about says more than the equations.
fn named(kind: &str, channel: Option<&Names>, symbol: Option<&String>, equation: Option<&Names>) -> String {
    let kind = format::kind_in_sentence(kind);
    match (channel.map(Names::as_slice), symbol) {
        (Some([one]), _) => format!("{kind} of {}", expression::text(one)),
        (Some(many), _) if !many.is_empty() => {
            let names: Vec<String> = many.iter().map(|name| expression::text(name)).collect();
            format!("{kind} of {} together", joined(&names, "and"))
        }
        (_, Some(symbol)) => format!("{kind} of {}", expression::text(symbol)),
        _ => format!("{kind}{}", equation.map(equations).unwrap_or_default()),
    }
}

/// `Coulomb friction is missing in the hub equation; fc = 0.115 ± 0.004 N m; it acts when |θ′| < 0.2`,
/// without the final full stop.
pub fn mechanism_sentence(mechanism: &Mechanism) -> String {
    let mut text = format!("{} is missing", format::kind(&mechanism.kind));
    match &mechanism.channel {
        Some(channel) => text.push_str(&format!(" in the measurement of {}", expression::text(channel))),
        None => text.push_str(&equations(&mechanism.equation)),
    }
    if let Some(parameter) = &mechanism.drifting {
        text.push_str(&format!(" (in {})", expression::text(parameter)));
    }
    let values: Vec<String> = mechanism
        .parameters
        .iter()
        .map(|(name, estimate)| {
            let value = format::with_interval(estimate.value, estimate.ci95);
            let unit = format::unit(&estimate.unit);
            let space = if unit.is_empty() { "" } else { " " };
            format!("{} = {value}{space}{unit}", expression::text(name))
        })
        .collect();
    if !values.is_empty() {
        text.push_str(&format!("; {}", values.join(", ")));
    }
    let when = region(&mechanism.location);
    if !when.is_empty() {
        text.push_str(&format!("; it acts when {}", joined(&when, "and")));
    }
    text
}

/// ` in the hub equation`, ` in the hub and link equations`, or nothing.
pub fn equations(names: &Names) -> String {
    match names.as_slice() {
        [] => String::new(),
        [one] => format!(" in the {one} equation"),
        many => format!(" in the {} equations", joined(many, "and")),
    }
}

/// The ranges of a region as conditions: `|θ′| < 0.2`, `x > 0.1`, `−0.1 < v < 0.4`.
pub fn region(location: &Location) -> Vec<String> {
    let mut out = Vec::new();
    for (source, &range) in &location.region {
        let unit = location.region_units.get(source);
        out.extend(condition(source, range, unit.map_or("", String::as_str)));
    }
    out
}

/// A range as a condition, with `unit` where it is not empty; `None` for a range without ends.
pub fn condition(source: &str, [low, high]: [Option<f64>; 2], unit: &str) -> Option<String> {
    let shown = expression::text(source);
    let (low, high) = (low.filter(|v| v.is_finite()), high.filter(|v| v.is_finite()));
    let number = |value| format::with_unit(&format::plain(value), unit);
    Some(match (low, high) {
        (Some(low), Some(high)) if low < 0.0 && (low + high).abs() <= 0.02 * (high - low) => {
            format!("|{shown}| < {}", number(0.5 * (high - low)))
        }
        (Some(0.0), Some(high)) if source.starts_with("abs(") => format!("{shown} < {}", number(high)),
        (Some(low), Some(high)) => format!("{} < {shown} < {}", format::plain(low), number(high)),
        (Some(low), None) => format!("{shown} > {}", number(low)),
        (None, Some(high)) => format!("{shown} < {}", number(high)),
        (None, None) => return None,
    })
}

/// A frequency band as text, `0.1 … 2 Hz`, or `None` where unknown.
pub fn band(band_hz: Option<Interval>) -> Option<String> {
    let band = band_hz?;
    match (band.low.is_finite(), band.high.is_finite()) {
        (true, true) => Some(format!("{} … {} Hz", format::plain(band.low), format::plain(band.high))),
        (false, true) => Some(format!("below {} Hz", format::plain(band.high))),
        (true, false) => Some(format!("above {} Hz", format::plain(band.low))),
        (false, false) => None,
    }
}

fn place(location: &Location) -> String {
    let mut text = location.equation.as_ref().map(equations).unwrap_or_default();
    let when = region(location);
    if !when.is_empty() {
        text.push_str(&format!(", when {}", joined(&when, "and")));
    }
    if let Some(band) = band(location.band_hz) {
        text.push_str(&format!(", at {band}"));
    }
    text
}

#[derive(Clone, Copy, PartialEq)]
enum Baseline {
    Nominal,
    Calibrated,
}

struct Change {
    /// ` of θ` where there is more than one channel.
    of: String,
    from: String,
    to: String,
}

/// The channel whose error changes most, from the baseline to the final model. Without a usable
/// improved fit the calibrated model is the final one.
fn error_change(fit: &Fit, baseline: Baseline) -> Option<Change> {
    let set = &fit.holdout;
    let (before, after) = match baseline {
        Baseline::Nominal => (&set.nominal, &set.calibrated),
        Baseline::Calibrated => (&set.calibrated, &set.improved),
    };
    let error = |score: &Score| match fit.criterion {
        Criterion::FreeRun => Some(score.nrmse),
        Criterion::Windowed => score.nrmse_windowed,
    };
    let pairs = before.iter().filter_map(|(channel, from)| {
        let (from, to) = (error(from)?, error(after.get(channel)?)?);
        (from.is_finite() && to.is_finite()).then_some((channel, from, to))
    });
    let best = pairs.max_by(|a, b| (a.1 - a.2).total_cmp(&(b.1 - b.2)))?;
    if baseline == Baseline::Calibrated && best.2 >= best.1 {
        return None;
    }
    let of = if before.len() > 1 { format!(" of {}", expression::text(best.0)) } else { String::new() };
    Some(Change { of, from: format::percent_short(best.1), to: format::percent_short(best.2) })
}

/// The channels of the held-out recordings that the improved model simulates worse than the calibrated one does.
fn losses(fit: &Fit) -> impl Iterator<Item = String> + '_ {
    let before = &fit.holdout.calibrated;
    let several = before.len() > 1;
    before.iter().filter_map(move |(channel, from)| {
        let to = fit.holdout.improved.get(channel)?;
        let judged = match fit.criterion {
            Criterion::FreeRun => (from.nrmse, to.nrmse),
            Criterion::Windowed => {
                (from.nrmse_windowed.unwrap_or(f64::NAN), to.nrmse_windowed.unwrap_or(f64::NAN))
            }
        };
        if judged.1.is_nan() || judged.1 <= LOSS * judged.0 {
            return None;
        }
        let of = if several { format!(" of {}", expression::text(channel)) } else { String::new() };
        let change = |a: f64, b: f64| {
            let verb = if b > a { "rises" } else { "falls" };
            format!("{verb} from {} to {}", format::percent_short(a), format::percent_short(b))
        };
        let windows = match (from.nrmse_windowed, to.nrmse_windowed, fit.window_s) {
            (Some(a), Some(b), Some(window)) => {
                format!(" (restarted every {} s it {})", format::significant(window, 3), change(a, b))
            }
            _ => String::new(),
        };
        let carries = match (from.nrmse_windowed, to.nrmse_windowed) {
            (Some(a), Some(b)) if a > LOSS * b => {
                "what was found carries over for that time, and not for a whole recording"
            }
            _ => "what was found describes the training recordings and does not carry over",
        };
        Some(format!("The held-out error{of} {}{windows}: {carries}.", change(from.nrmse, to.nrmse)))
    })
}

/// `a`, `a and b`, `a, b and c`.
pub(crate) fn joined<S: AsRef<str>>(items: &[S], last: &str) -> String {
    match items {
        [] => String::new(),
        [one] => one.as_ref().to_owned(),
        [head @ .., tail] => {
            let head: Vec<&str> = head.iter().map(AsRef::as_ref).collect();
            format!("{} {last} {}", head.join(", "), tail.as_ref())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_read_as_conditions() {
        let one = |name: &str, range| condition(name, range, "").unwrap_or_default();
        assert_eq!(one("theta'", [Some(-0.2), Some(0.2)]), "|θ′| < 0.2");
        assert_eq!(one("x1 - x2", [Some(-1.0), Some(1.0)]), "|x₁ − x₂| < 1");
        assert_eq!(one("x", [Some(-0.1), Some(0.4)]), "−0.1 < x < 0.4");
        assert_eq!(one("v", [Some(2.0), None]), "v > 2");
        assert_eq!(one("abs(v)", [Some(0.0), Some(1.0)]), "|v| < 1");
        assert_eq!(one("v", [None, Some(f64::INFINITY)]), "");
    }

    #[test]
    fn a_number_that_is_not_in_the_unit_of_the_model_has_its_unit() {
        let location = Location {
            region: [("theta".to_owned(), [Some(1.0), None]), ("v".to_owned(), [None, Some(2.0)])].into(),
            region_units: [("theta".to_owned(), "rad".to_owned())].into(),
            ..Location::default()
        };
        assert_eq!(region(&location), ["θ > 1 rad", "v < 2"]);
    }

    fn mechanism(kind: &str, equation: &str, alternatives: Vec<Alternative>) -> Mechanism {
        Mechanism {
            kind: kind.to_owned(),
            family: String::new(),
            equation: equation.into(),
            channel: None,
            expression: String::new(),
            replaces: None,
            states: Default::default(),
            drifting: None,
            parameters: Default::default(),
            share_explained: 1.0,
            confidence: 0.9,
            alternatives,
            experiment: None,
            location: Location::default(),
        }
    }

    fn equal(kind: &str) -> Alternative {
        Alternative { kind: kind.to_owned(), confidence: 0.9, equivalent: true, ..Alternative::default() }
    }

    #[test]
    fn what_cannot_be_separated_is_listed_once_by_distinct_names() {
        let at = |kind: &str, equation: &str| Alternative { equation: Some(equation.into()), ..equal(kind) };
        let input = |name: &str| Alternative { replaces: Some(name.to_owned()), ..at("input_offset", "hub") };
        let sensors = |names: &[&str]| {
            let names: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
            Alternative { channel: Some(names.into()), ..equal("sensor_offset") }
        };
        let reported = |kind, alternatives| inseparable(&mechanism(kind, "hub", alternatives));
        // As a report without places has it.
        assert_eq!(reported("presliding_friction", vec![equal("presliding_friction")]), None);
        assert_eq!(
            reported(
                "presliding_friction",
                vec![at("presliding_friction", "hub"), at("presliding_friction", "link")]
            )
            .as_deref(),
            Some(
                "These recordings cannot separate presliding friction in the hub equation from presliding friction \
                 in the link equation."
            )
        );
        assert_eq!(
            reported(
                "constant_offset",
                vec![input("u1"), input("u2"), sensors(&["x1"]), sensors(&["x1", "x2"])]
            )
            .as_deref(),
            Some(
                "These recordings cannot separate constant offset from input offset of u₁, input offset of u₂, sensor \
                 offset of x₁ or sensor offset of x₁ and x₂ together."
            )
        );
        assert_eq!(
            reported(
                "coulomb_friction",
                vec![
                    at("stribeck_friction", "hub"),
                    at("stribeck_friction", "hub"),
                    at("viscous_friction", "link")
                ]
            )
            .as_deref(),
            Some(
                "These recordings cannot separate Coulomb friction from Stribeck friction or viscous friction in the \
                 link equation."
            )
        );
    }

    #[test]
    fn terms_are_told_as_one_sum_for_each_equation() {
        let term = |equation: &str, name: &str, expression: &str, value: f64| {
            let estimate = crate::contract::Estimate { value, ci95: None, unit: String::new() };
            Mechanism {
                expression: expression.into(),
                parameters: [(name.to_owned(), estimate)].into(),
                ..mechanism("cubic_stiffness", equation, Vec::new())
            }
        };
        let cube = term("hub", "k3", "k3*theta^3", -0.1974);
        assert_eq!(laws(std::slice::from_ref(&cube)), "cubic stiffness (k₃·θ³)");
        let both = [
            cube.clone(),
            term("link", "f0", "f0", 0.5),
            term("hub", "cg", "-cg*(theta' - alpha')", 0.0012),
            term("hub", "fc", "fc*sign(theta' - alpha')", 0.01478),
        ];
        assert_eq!(
            laws(&both),
            "the terms −0.197·θ³ − 0.00120·(θ′ − α′) + 0.0148·sign(θ′ − α′) in the hub equation and 0.500 in the link \
             equation (SI units), proposed and not named,"
        );
        // Constants are numbers, memories are told.
        let mut brake = term("hub", "bs", "bs*theta'/(1 + (theta'/vs)^2)", 2.808);
        brake.parameters.extend(term("hub", "vs", "", 0.385).parameters);
        let mut series = term("hub", "km", "km*(theta - z)", 8.05);
        series.parameters.extend(term("hub", "wm", "", 0.5).parameters);
        series.states = [("z".to_owned(), "z' = wm*(theta - z)".to_owned())].into();
        assert_eq!(
            laws(&[brake, series]),
            "the terms 2.81·θ′/(1 + (θ′/0.385)²) + 8.05·(θ − z) in the hub equation, with z′ = 0.500·(θ − z) (SI units), \
             proposed and not named,"
        );
        // A sum of two coefficients is no term.
        let mut two = term("hub", "k3", "k3*theta^3 + k5*theta^5", 1.0);
        assert_eq!(super::term(&two), None);
        two.parameters.extend(term("hub", "k5", "", 2.0).parameters);
        assert_eq!(super::term(&two), None);
        assert_eq!(laws(&[two, cube]), "cubic stiffness (k₃·θ³ + k₅·θ⁵) and cubic stiffness (k₃·θ³)");
    }

    #[test]
    fn terms_that_nobody_looked_a_name_up_for_are_told_as_such() {
        let json = r#"{
          "verdict": "unexplained", "terms_only": true, "basis": "proposed", "mechanisms": [],
          "candidates": [{"kind": "cubic_stiffness", "equation": "hub", "expression": "k3*theta^3",
            "parameters": {"k3": {"value": -0.197, "ci95": [-0.2, -0.194], "unit": "N m"}},
            "share_explained": 0.9, "confidence": 0.5, "location": {}}],
          "remainder": {"significant": true, "location": {}, "share_of_residual": 0.9},
          "parameters": {},
          "fit": {"train": {"nominal": {}, "calibrated": {}, "improved": {}},
                  "holdout": {"nominal": {}, "calibrated": {"theta": {"nrmse": 0.63}},
                              "improved": {"theta": {"nrmse": 0.0019}}},
                  "holdout_source": "b.csv"},
          "noise_floor": {}}"#;
        let mut report = Report::from_json(json).unwrap();
        let reported = super::summary(&report);
        assert_eq!(
            reported[0],
            "Terms are missing from the model: −0.197·θ³ in the hub equation (SI units): the held-out error falls from \
             63 % to 0.19 %."
        );
        assert_eq!(reported[1], "The terms have no names: `greybox diagnose` looks for mechanisms.");
        report.candidates.clear();
        let reported = super::summary(&report);
        assert!(reported[0].contains("no term in the library explains it"), "{reported:?}");
    }

    #[test]
    fn lists_and_equations() {
        assert_eq!(joined(&["a", "b", "c"], "or"), "a, b or c");
        assert_eq!(
            equations(&Names::Many(vec!["hub".into(), "link".into()])),
            " in the hub and link equations"
        );
        assert_eq!(equations(&Names::Many(Vec::new())), "");
    }
}
