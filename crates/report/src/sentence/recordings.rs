//! What many recordings say together, in plain language.

use crate::summary::{Law, MechanismOver, Method, Pooled, Spread, Summary, Verdicts};
use crate::{expression, format};

use super::{equations, joined, machines};

/// The conclusion, most important first: how many recordings ended how, each mechanism with its parameters pooled and over
/// the machines, the model's parameters that change, the held-out error.
pub fn summary(summary: &Summary) -> Vec<String> {
    let mut out = vec![counts(&summary.verdicts)];
    let diagnosed = summary.verdicts.diagnosed();
    for over in &summary.mechanisms {
        out.push(mechanism(over, diagnosed));
        out.extend(over.parameters.iter().flat_map(|(name, pooled)| machines::sentences(name, pooled)));
    }
    for (name, parameter) in &summary.parameters {
        let of_machines = machines::sentences(name, &parameter.pooled);
        if parameter.pooled.method == Method::RandomEffects && of_machines.is_empty() {
            out.push(format!("{}.", estimate(name, &parameter.pooled)));
        }
        out.extend(of_machines);
    }
    for (channel, errors) in &summary.holdout {
        out.push(format!(
            "Median held-out error of {}: {} calibrated, {} improved{}.",
            expression::text(channel),
            format::percent_short(errors.calibrated.median),
            format::percent_short(errors.improved.median),
            diverged(&errors.improved)
        ));
    }
    out
}

fn counts(v: &Verdicts) -> String {
    let recordings = |n: usize| if n == 1 { "1 recording".to_owned() } else { format!("{n} recordings") };
    let parts: Vec<String> = [
        (v.missing_physics, "physics is missing in"),
        (v.consistent, "the model agrees with"),
        (v.unexplained, "something unexplained is missing in"),
    ]
    .into_iter()
    .filter(|(n, _)| *n > 0)
    .map(|(n, what)| format!("{what} {n}"))
    .collect();
    let diagnosed = match parts.is_empty() {
        true => "No recording was diagnosed".to_owned(),
        false => format!("{} diagnosed: {}", recordings(v.diagnosed()), joined(&parts, "and")),
    };
    match v.failed {
        0 => format!("{diagnosed}."),
        n => format!("{diagnosed}; {} could not be diagnosed.", recordings(n)),
    }
}

/// Where a law stands: `in the hub equation`, `in the measurement of θ`.
pub fn place(law: &Law) -> String {
    match &law.channel {
        Some(channel) => format!("in the measurement of {}", expression::text(channel)),
        None => equations(&law.equation).trim_start().to_owned(),
    }
}

fn mechanism(over: &MechanismOver, diagnosed: usize) -> String {
    let mut text = format!(
        "{} {}, {}, is found in {} of {diagnosed}",
        format::kind(&over.law.kind),
        place(&over.law),
        expression::text(&over.law.expression),
        over.found_in.len()
    );
    if let Some(share) = &over.machines {
        text.push_str(&format!(" recordings, {}", machines::share(share)));
    }
    // What changes is told over the machines.
    let told = |p: &Pooled| match p.method {
        Method::None => false,
        Method::RandomEffects => p.machines.is_none(),
        Method::Single | Method::FixedEffect => true,
    };
    for (name, pooled) in over.parameters.iter().filter(|(_, p)| told(p)) {
        text.push_str(&format!("; {}", estimate(name, pooled)));
    }
    text.push('.');
    text
}

/// `fc = 0.0150 ± 0.0003 N m`, and whether it changes from recording to recording.
fn estimate(name: &str, pooled: &Pooled) -> String {
    let unit = format::unit(&pooled.unit);
    let space = if unit.is_empty() { "" } else { " " };
    let value = format::with_interval(pooled.value, pooled.ci95);
    let mut text = format!("{} = {value}{space}{unit}", expression::text(name));
    if let (Method::RandomEffects, Some(h)) = (pooled.method, &pooled.heterogeneity) {
        let tau = format::significant(h.tau, 2);
        text.push_str(&format!(
            " on average, but it changes from recording to recording by {tau}{space}{unit} ({})",
            probability(h.p_value)
        ));
    }
    text
}

/// `p = 0.013`, `p < 0.001`.
pub fn probability(p: f64) -> String {
    if p < 0.001 { "p < 0.001".to_owned() } else { format!("p = {}", format::significant(p, 2)) }
}

fn diverged(spread: &Spread) -> String {
    match spread.diverged {
        0 => String::new(),
        n => format!(" ({n} diverged)"),
    }
}
