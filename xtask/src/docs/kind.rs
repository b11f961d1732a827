//! The page of one kind of mechanism.

use std::fmt::Write;

use anyhow::{Context, Result};
use greybox_diagnose::candidate::{Candidate, candidates};
use greybox_diagnose::library::{Domain, Excitation, First, Inner, Mechanism, On, Scale};
use greybox_diagnose::place::{Place, places};
use greybox_model::{Model, WriteOptions};
use greybox_report::format;

use super::{EXAMPLE, Kind, capital};

/// The page; `all` are the kinds that it may link to.
pub(super) fn page(kind: &Kind, all: &[Kind]) -> Result<String> {
    let mut page = format!(
        "# {}\n\n<!-- Made by `cargo xtask docs` from crates/diagnose/mechanisms; do not edit. -->\n\n\
         Kind `{}`, family {}.\n",
        format::kind(&kind.name),
        kind.name,
        kind.family().replace('_', " ")
    );
    if kind.forms.len() > 1 {
        writeln!(page, "It has {} forms; the diagnosis tries each.", kind.forms.len())?;
    }
    for (file, m) in &kind.forms {
        if kind.forms.len() > 1 {
            let reaction = m.reaction.as_ref().map_or_else(String::new, |e| format!(" and `{e}`"));
            write!(page, "\n## `{}`{reaction}\n", m.law)?;
        }
        form(&mut page, file, m, all)?;
    }
    let mut takers: Vec<&str> = Vec::new();
    for other in all.iter().filter(|k| k.name != kind.name) {
        if other.forms.iter().any(|(_, m)| m.about.confused_with.contains(&kind.name)) {
            takers.push(&other.name);
        }
    }
    if !takers.is_empty() {
        let links: Vec<String> = takers.iter().map(|k| link(k, all)).collect();
        write!(page, "\n---\n\nPages that compare themselves with this kind: {}.\n", links.join(", "))?;
    }
    Ok(page)
}

fn form(page: &mut String, file: &str, m: &Mechanism, all: &[Kind]) -> Result<()> {
    write!(page, "\n{}.\n\n", capital(&m.about.physics))?;
    writeln!(page, "{}:\n\n```text\n{} = {}", acts_on(m.on), role(m.on), m.law)?;
    if let Some(reaction) = &m.reaction {
        writeln!(page, "reaction on o's equation = {reaction}")?;
    }
    for state in &m.states {
        writeln!(page, "{} = {}", state.lhs, state.rhs)?;
    }
    page.push_str("```\n\n");
    parameters(page, m)?;
    writeln!(page, "\n**In the data:** {}.", m.about.signature)?;
    if !m.about.confused_with.is_empty() {
        let links: Vec<String> = m.about.confused_with.iter().map(|k| link(k, all)).collect();
        writeln!(page, "\n**Taken for:** {}.", links.join(", "))?;
    }
    writeln!(page, "\n**The recording that separates them:** {}.", m.about.separate)?;
    if let Some(excitation) = &m.excitation {
        writeln!(page, "\n**Its excitation:** {}.", drive(excitation))?;
    }
    if !m.about.elsewhere.is_empty() {
        writeln!(
            page,
            "\n**Where nothing moves (a temperature, a level, a voltage):** {}.",
            m.about.elsewhere
        )?;
    }
    if m.domain == Some(Domain::Mechanical) {
        writeln!(
            page,
            "\n**Where it is tried:** not in equations that units show to be thermal or electrical."
        )?;
    }
    writeln!(page, "\n**How it is found:** {}", found(m))?;
    writeln!(page, "\n**Where it acts:** {}", located(m))?;
    let lines = changed_lines(m).with_context(|| file.to_owned())?;
    write!(
        page,
        "\n**In `improved.toml`,** found in the [example](../mechanisms.md#the-example) (new lines, without the parameters):\n\n```toml,part\n{lines}```\n\nSource: `crates/diagnose/mechanisms/{file}`.\n"
    )?;
    Ok(())
}

fn link(kind: &str, all: &[Kind]) -> String {
    let words = format::kind_in_sentence(kind);
    if all.iter().any(|k| k.name == kind) { format!("[{words}]({kind}.md)") } else { words }
}

fn acts_on(on: On) -> &'static str {
    match on {
        On::Motion => "A force on a motion `d`, a coordinate or the stretch of an element of the machine",
        On::Equation => "A force in an equation as a whole",
        On::Input => "What stands in for an input `u`",
        On::Measurement => "What stands in for a measurement `y`",
        On::Parameter => "What stands in for a parameter `p`, not in the measurements",
        On::Spring => "What stands in for the term `k*d` of an existing spring",
        On::Feedback => "What stands in for the term `k*d` of a spring, a damper or a feedback gain",
        On::Pair => "A force in the equation of the coordinate `d`, from another coordinate `o`",
        On::Load => "A force on a motion `d` whose joint transmits the force `load`",
        On::Drive => "A force on a motion `d` that an input drives with the force `load`",
    }
}

fn role(on: On) -> &'static str {
    match on {
        On::Input => "u →",
        On::Measurement => "y →",
        On::Parameter => "p →",
        On::Spring | On::Feedback => "k*d →",
        On::Motion | On::Equation | On::Pair | On::Load | On::Drive => "force",
    }
}

/// The example with the mechanism at its first place.
fn inserted(m: &Mechanism) -> Result<(Model, Vec<String>)> {
    let mut model = Model::from_toml(EXAMPLE, "example")?;
    let mut at = candidates(&model, std::slice::from_ref(m), &places(&model));
    if at.is_empty() {
        // What is a free parameter of the example already: shown beside known ones.
        let mut known = model.clone();
        known.parameters.iter_mut().for_each(|p| p.fixed = true);
        at = candidates(&known, std::slice::from_ref(m), &places(&known));
    }
    // A drift of the friction reads better than one of an inertia.
    let friction = model.parameter("b");
    let chosen = at.iter().find(|c| matches!(c.place, Place::Parameter(p) if Some(p) == friction));
    let chosen: Candidate =
        chosen.or(at.first()).context("the mechanism has no place in the example")?.clone();
    let instance = chosen.insert(&mut model, m, &vec![1.0; m.parameters().count()]);
    // Where the law leaves a unit open, it stays open.
    let _ = model.resolve_units();
    Ok((model, instance.names))
}

/// The lines of the improved model that the example does not have, under their sections; parameters apart.
fn changed_lines(m: &Mechanism) -> Result<String> {
    let (model, names) = inserted(m)?;
    let text = model.to_toml(&WriteOptions { original: Some(EXAMPLE), comments: &[] });
    Model::from_toml(&text, "improved example")?;
    let old: Vec<&str> = EXAMPLE.lines().collect();
    let parameter =
        |line: &str| line.split('=').next().is_some_and(|key| names.iter().any(|n| n == key.trim()));
    let (mut lines, mut section) = (String::new(), None);
    for line in text.lines().filter(|line| !line.trim().is_empty()) {
        if line.starts_with('[') {
            section = Some(line);
        } else if !old.contains(&line) && (section != Some("[parameters]") || !parameter(line)) {
            if let Some(header) = section.take() {
                lines.push_str(if lines.is_empty() { "" } else { "\n" });
                lines.push_str(header);
                lines.push('\n');
            }
            lines.push_str(line);
            lines.push('\n');
        }
    }
    Ok(lines)
}

fn parameters(page: &mut String, m: &Mechanism) -> Result<()> {
    let (model, names) = inserted(m)?;
    page.push_str("| parameter | is | unit in the example | first value |\n|---|---|---|---|\n");
    for (name, inserted) in m.parameters().zip(&names) {
        let what = m.about.parameters.get(name).map_or("", String::as_str);
        let sign = if m.positive.iter().any(|p| p == name) { ", ≥ 0" } else { "" };
        let unit = model.parameter(inserted).and_then(|i| model.parameters[i].unit.as_ref());
        let unit = unit.map_or_else(|| "–".to_owned(), |u| u.text.clone());
        writeln!(page, "| `{name}` | {what}{sign} | {unit} | {} |", first_value(m, name))?;
    }
    let shapes: Vec<&Inner> = m.inner.iter().filter(|i| !m.parameters().any(|p| p == i.name)).collect();
    if !shapes.is_empty() {
        let shapes: Vec<String> = shapes.iter().map(|i| format!("`{}`: {}", i.name, grid(i))).collect();
        write!(page, "\nThe first values use {}.\n", shapes.join("; "))?;
    }
    if !m.report.is_empty() {
        let figures: Vec<String> = m.report.iter().map(|(n, e)| format!("`{n} = {e}`")).collect();
        write!(page, "\nReported too: {}.\n", figures.join(", "))?;
    }
    Ok(())
}

fn first_value(m: &Mechanism, name: &str) -> String {
    if let Some((_, first)) = m.first.iter().find(|(n, _)| n == name) {
        return match first {
            First::Value(e) => format!("`{e}`"),
            First::Angle(y, x) => format!("the angle of the vector ({x}, {y})"),
        };
    }
    match m.inner(name) {
        Some((_, inner)) => grid(inner),
        None => "score test".to_owned(),
    }
}

fn grid(inner: &Inner) -> String {
    let values: Vec<String> = inner.grid.iter().map(|v| format!("{v}")).collect();
    let of = match &inner.scale {
        Scale::One => String::new(),
        Scale::Step => " sample intervals".to_owned(),
        Scale::Rms(e) => format!(" × RMS of `{e}`"),
        Scale::Max(e) => format!(" × largest `abs({e})`"),
        Scale::Top(e) => format!(" × largest `{e}`"),
        Scale::Range(e) => format!(" × range of `{e}`"),
        Scale::PerRange(e) => format!(" / range of `{e}`"),
        Scale::Frequency(e) => format!(" × mean frequency of `{e}`, rad/s"),
        Scale::Duration => " × duration".to_owned(),
        Scale::PerDuration => " / duration".to_owned(),
    };
    let mut text = match values.as_slice() {
        [] => String::new(),
        [first, .., last] if values.len() > 8 => {
            format!("{} values from {first} to {last}{of}", values.len())
        }
        values => format!("{}{of}", values.join(", ")),
    };
    if let Some(variable) = &inner.spectral {
        if !text.is_empty() {
            text.push_str("; ");
        }
        write!(text, "peaks of what is left over, as a spectrum along `{variable}`").ok();
    }
    text
}

fn found(m: &Mechanism) -> String {
    let mut text = match (m.linear.as_slice(), m.inner.is_empty()) {
        ([], _) => "the score test takes the difference that each first value of the table makes, along the smoothed recording".to_owned(),
        (linear, inner) => {
            let names: Vec<String> = linear.iter().map(|n| format!("`{n}`")).collect();
            let each = if inner { "" } else { ", for each first value of the others" };
            format!("the score test finds {} by linear regression along the smoothed recording{each}", names.join(" and "))
        }
    };
    text.push_str("; the best go on to a full fit.");
    let mut also: Vec<String> = Vec::new();
    if m.mirror {
        also.push("The mirror image, d → −d, is a candidate of its own.".into());
    }
    if m.rare {
        also.push("It acts rarely, and is judged by what it gains where it does.".into());
    }
    if !m.refines.is_empty() {
        let kinds: Vec<String> = m.refines.iter().map(|k| format::kind_in_sentence(k)).collect();
        also.push(format!("Where it is accepted, it takes the place of {}.", kinds.join(", ")));
    }
    for e in &m.require {
        also.push(format!("`{e}` cannot be negative."));
    }
    if m.surcharge > 0.0 {
        let s = if m.surcharge == 1.0 { "" } else { "s" };
        also.push(format!("Its freedom to mimic others counts as {} parameter{s} more.", m.surcharge));
    }
    if !m.equals.is_empty() {
        let parts: Vec<String> = m
            .equals
            .iter()
            .map(|(kind, p, e)| format!("{} with `{p} = {e}`", format::kind_in_sentence(kind)))
            .collect();
        also.push(format!("It equals the sum of {}; where both are candidates, that sum is reported, and this kind as its equivalent.", parts.join(" and ")));
    }
    for sentence in also {
        text.push(' ');
        text.push_str(&sentence);
    }
    text
}

fn located(m: &Mechanism) -> String {
    let Some(region) = &m.region else {
        return "where its effect departs from what the model's linear terms could take up: instants, range of its variable and frequency band.".to_owned();
    };
    let range = match (&region.low, &region.high) {
        (Some(low), Some(high)) => format!("`{low}` ≤ `{}` ≤ `{high}`", region.variable),
        (Some(low), None) => format!("`{}` ≥ `{low}`", region.variable),
        (None, Some(high)) => format!("`{}` ≤ `{high}`", region.variable),
        (None, None) => format!("over all of `{}`", region.variable),
    };
    let rate = [&region.low, &region.high].into_iter().flatten().any(|e| e.mentions("rms_rate"));
    let note = if rate { " (`rms_rate`: RMS of the rate)" } else { "" };
    format!("{range}{note}, with the instants and the frequency band of its force.")
}

/// An excitation in words.
fn drive(excitation: &Excitation) -> String {
    match excitation {
        Excitation::Slow => "slowly, up to the present amplitude".to_owned(),
        Excitation::Wide => "slowly, and further than now".to_owned(),
        Excitation::Loud => "as now, and louder".to_owned(),
        Excitation::Silent => "the input at zero".to_owned(),
        Excitation::Again => "the same again".to_owned(),
        Excitation::Around(at) => format!("a sine around `{at}` Hz"),
        Excitation::Ramp(at) => format!("a slow ramp of the input to `{at}`"),
        Excitation::Beyond(at) => format!("steps of the input beyond `{at}`"),
    }
}
