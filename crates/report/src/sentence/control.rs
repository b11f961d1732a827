//! What a control engineer wants to know first, in plain language.

use greybox_control::{Metrics, Tracking, Verdict};

use crate::control::{ControlPage, IntegralAction, PerturbedMargins};
use crate::{expression, format};

/// The conclusion, most important first: how the loop settles, then what holds on perturbed plants, then the command.
pub fn summary(page: &ControlPage) -> Vec<String> {
    let unit = page.states.get(page.tracked).map_or("", |s| s.quantity.unit.as_str());
    let mut out = vec![reached(page, &tracked(page), unit)];
    out.push(match &page.family {
        None => "No perturbed plants were tried: nothing is said about a plant that is not quite the model."
            .into(),
        Some(family) => {
            let diverged = match family.diverged {
                0 => "none diverges".to_owned(),
                1 => "one diverges".to_owned(),
                n => format!("{n} diverge"),
            };
            format!(
                "Of {} plants with parameters drawn around the model's, {} {}; {diverged}.",
                family.members,
                family.settled,
                if page.is_trajectory { "stay with the trajectory" } else { "settle at every set point" },
            )
        }
    });
    out.extend(page.family.as_ref().and_then(|f| f.margins).map(|m| margins(&m)));
    out.extend(hunts(page));
    out.push(command(page));
    out
}

/// That a loop cannot stay at rest, by its poles while friction holds the tracked state; not of a law that holds the command
/// there.
pub fn hunts(page: &ControlPage) -> Option<String> {
    let is_held = page.observer.as_ref().is_some_and(|o| matches!(o.integral, IntegralAction::AtRest { .. }));
    let stuck = page.set_points.iter().flat_map(|s| &s.stuck_poles);
    let rightmost = stuck.map(|[re, _]| *re).fold(f64::NEG_INFINITY, f64::max);
    (rightmost > 0.0 && !is_held).then(|| {
        format!(
            "While friction holds {}, the loop has a pole at +{} 1/s: it cannot stay at rest, and hunts. Integral action at rest, of \
             a law with an observer, holds the command there.",
            tracked(page),
            format::number(rightmost)
        )
    })
}

/// The name of the tracked state.
fn tracked(page: &ControlPage) -> String {
    let state = page.states.get(page.tracked);
    state.map_or_else(|| "The tracked state".to_owned(), |s| expression::text(&s.quantity.name))
}

/// What the loop has to spare on the worst of the perturbed plants.
fn margins(of: &PerturbedMargins) -> String {
    match of.unstable {
        0 => {}
        1 => return "On one of them the linearised loop is unstable at a set point.".to_owned(),
        n => return format!("On {n} of them the linearised loop is unstable at a set point."),
    }
    let bounded = |v: f64, unit: &str| {
        if v.is_finite() { format!("at least {}{unit}", format::number(v)) } else { "unlimited".to_owned() }
    };
    format!(
        "On all of them the gain margin is {}, the phase margin {} and the delay margin {}.",
        bounded(of.worst.gain, ""),
        bounded(of.worst.phase.to_degrees(), "°"),
        bounded(of.worst.delay, " s"),
    )
}

fn reached(page: &ControlPage, name: &str, unit: &str) -> String {
    if let Some(t) = page.run.diverged {
        return format!("{name} leaves every bound after {} s.", format::plain(t));
    }
    if let Some(tracking) = &page.tracking {
        return followed(tracking, name, unit);
    }
    let worst = |of: fn(&Metrics) -> f64| page.steps.iter().map(of).fold(0.0, f64::max);
    let missed = page.steps.iter().filter(|s| s.settling.is_none()).count();
    let left = format::with_unit(&format::number(worst(|s| s.final_error.abs())), unit);
    if page.verdict == Verdict::Unsettled || missed > 0 {
        return format!(
            "{name} does not come to stay within 2 % of the step at {missed} of {} set points; it ends up to {left} off.",
            page.steps.len()
        );
    }
    format!(
        "{name} stays within 2 % of every step after at most {} s, overshoots by {} at most and ends within {left} of its \
         set point.",
        format::number(worst(|s| s.settling.unwrap_or(f64::NAN))),
        format::percent_short(worst(|s| s.overshoot)),
    )
}

fn followed(t: &Tracking, name: &str, unit: &str) -> String {
    let value = |v: f64| format::with_unit(&format::number(v), unit);
    let share = |v: f64| format::percent_short(v / t.span);
    format!(
        "After the first quarter of the time {name} is {} from its trajectory at most, {} of its span, and {} in the root mean \
         square; over the whole of the time {} at most.",
        value(t.later_error.largest),
        share(t.later_error.largest),
        value(t.later_error.rms),
        value(t.error.largest),
    )
}

fn command(page: &ControlPage) -> String {
    let along = page.tracking.iter();
    let steps = || page.steps.iter();
    let largest = steps().map(|s| s.largest_command).chain(along.clone().map(|t| t.largest_command));
    let largest = largest.fold(0.0, f64::max);
    let reaches = format!(
        "{} reaches {}",
        expression::text(&page.input.name),
        format::with_unit(&format::number(largest), &page.input.unit)
    );
    let saturated = steps().map(|s| s.saturated).chain(along.map(|t| t.saturated)).fold(0.0, f64::max);
    if page.limits.iter().all(|l| l.is_infinite()) {
        format!("{reaches}; no limit of the actuator was stated.")
    } else if saturated > 0.0 {
        format!(
            "{reaches}, its limit, and is there for {} of {}.",
            format::percent_short(saturated),
            if page.is_trajectory { "the time" } else { "a step at most" }
        )
    } else {
        format!("{reaches} and stays within its limits.")
    }
}
