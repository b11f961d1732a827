//! What changed from one run to another, in plain language.

use crate::comparison::{Change, Comparison, MechanismChange};
use crate::contract::{Report, Verdict};
use crate::{expression, format};

use super::joined;
use super::recordings::place;

/// The changes, most important first: the verdict, mechanisms, the model's parameters, the held-out error.
pub fn summary(comparison: &Comparison) -> Vec<String> {
    let (before, after) = (&comparison.before, &comparison.after);
    let mut out = vec![match before.verdict == after.verdict {
        true => format!("Both runs say: {}.", verdict(after.verdict)),
        false => format!("Before: {}. After: {}.", verdict(before.verdict), verdict(after.verdict)),
    }];
    let named = |m: &MechanismChange| format!("{} {}", format::kind(&m.law.kind), place(&m.law));
    out.extend(comparison.mechanisms.iter().map(|m| {
        let twins = comparison.mechanisms.iter().filter(|other| named(other) == named(m)).count();
        // Two of one kind in one place are told apart by what they are.
        let law =
            if twins > 1 { format!(", {},", expression::text(&m.law.expression)) } else { String::new() };
        mechanism(&format!("{}{law}", named(m)), m)
    }));
    let changed: Vec<String> = comparison
        .parameters
        .iter()
        .filter(|(_, c)| c.changed == Some(true))
        .map(|(name, c)| values(name, c))
        .collect();
    if !changed.is_empty() {
        out.push(format!(
            "Of the model's own parameters these changed by more than their intervals: {}.",
            joined(&changed, "and")
        ));
    } else if comparison.parameters.values().any(|c| c.changed.is_some()) {
        out.push("None of the model's own parameters changed by more than its interval.".to_owned());
    }
    for (channel, errors) in &comparison.holdout {
        let (Some(before), Some(after)) = (errors.before, errors.after) else { continue };
        out.push(format!(
            "Held-out error of {}: {} before, {} after.",
            expression::text(channel),
            format::percent_short(before.improved),
            format::percent_short(after.improved)
        ));
    }
    if before.remainder != after.remainder {
        out.push(
            match after.remainder {
                true => "Something is left unexplained that was not before.",
                false => "What was left unexplained before is no longer.",
            }
            .to_owned(),
        );
    }
    out
}

/// Why figures of the two may not be held against each other.
pub fn cautions(before: &Report, after: &Report) -> Vec<String> {
    let mut out = Vec::new();
    if before.model != after.model {
        out.push(format!(
            "The nominal models have different names: {} ({}) and {} ({}).",
            before.model.name, before.model.file, after.model.name, after.model.file
        ));
    }
    let nominal = |report: &Report| -> Vec<(String, u64)> {
        report.parameters.iter().map(|(name, p)| (name.clone(), p.nominal.to_bits())).collect()
    };
    if nominal(before) != nominal(after) {
        out.push("The nominal models have different parameters, or different values of them.".to_owned());
    }
    let recordings = |report: &Report| report.fit.recordings.keys().cloned().collect::<Vec<_>>();
    let same = recordings(before) == recordings(after)
        && before.samples == after.samples
        && before.fit.holdout_source == after.fit.holdout_source;
    if !same {
        out.push(
            "The runs were judged on different recordings: an error that differs need not come from the model."
                .to_owned(),
        );
    }
    if before.greybox.version != after.greybox.version {
        out.push(format!(
            "The reports are from greybox {} and {}.",
            before.greybox.version, after.greybox.version
        ));
    }
    out
}

/// The conclusion without a capital and a full stop.
pub fn verdict(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Consistent => "the model agrees with the recordings",
        Verdict::MissingPhysics => "physics is missing",
        Verdict::Unexplained => "something is missing that no mechanism explains",
    }
}

fn mechanism(what: &str, m: &MechanismChange) -> String {
    match (m.before, m.after) {
        (None, _) => format!("{what} is new."),
        (_, None) => format!("{what} is gone."),
        _ => {
            let changed: Vec<String> = m
                .parameters
                .iter()
                .filter(|(_, c)| c.changed == Some(true))
                .map(|(name, c)| values(name, c))
                .collect();
            match changed.is_empty() {
                true => format!("{what} is in both, unchanged within its intervals."),
                false => format!("{what} is in both, but changed: {}.", joined(&changed, "and")),
            }
        }
    }
}

/// `fc = 0.11 ± 0.01 → 0.14 ± 0.01 N m`.
fn values(name: &str, change: &Change) -> String {
    let shown = |e: &Option<crate::contract::Estimate>| {
        e.as_ref().map_or_else(|| "–".to_owned(), |e| format::with_interval(e.value, e.ci95))
    };
    let unit = change.after.as_ref().or(change.before.as_ref()).map_or("", |e| e.unit.as_str());
    let unit = format::unit(unit);
    let space = if unit.is_empty() { "" } else { " " };
    format!("{} = {} → {}{space}{unit}", expression::text(name), shown(&change.before), shown(&change.after))
}
