//! Reports as plain language for a terminal.

use std::fmt::Write as _;

use greybox_report::contract::{
    Finding, Fit, FitSet, Mechanism, Ordered, Parameter, Report, Score, Severity, Verdict,
};
use greybox_report::identified::{Equation, IdentifyReport};
use greybox_report::notes::grouped;
use greybox_report::summary::{Spread, Summary};
use greybox_report::{expression, format, sentence};

/// The story of a diagnosis: the conclusion, the mechanisms with their alternatives, the fit, and what to know.
pub fn diagnosis(report: &Report) -> String {
    let mut text = String::new();
    let written = sentence::summary(report);
    for line in if report.summary.is_empty() { &written } else { &report.summary } {
        let _ = writeln!(text, "{line}");
    }
    for (number, mechanism) in report.mechanisms.iter().enumerate() {
        text.push('\n');
        text.push_str(&mechanism_in_words(number + 1, mechanism));
    }
    text.push('\n');
    text.push_str(&fit_table(&report.fit, &report.noise_floor));
    text.push_str(&notes(&report.findings));
    text
}

/// The story of an identification: the equations, how well they predict, the doubts, and every term.
pub fn identification(report: &IdentifyReport) -> String {
    let mut text = String::new();
    for line in &report.summary {
        let _ = writeln!(text, "{line}");
    }
    for (state, equation) in &report.equations {
        text.push('\n');
        text.push_str(&term_table(state, equation));
    }
    let rows: Vec<Vec<String>> = [("training", &report.fit.train), ("held out", &report.fit.holdout)]
        .into_iter()
        .flat_map(|(role, set)| set.improved.iter().map(move |(channel, score)| (role, set, channel, score)))
        .map(|(role, set, channel, score)| {
            let floor = report.fit.floor_in(set, channel, &report.noise_floor);
            let name = format!("{role}, {}", expression::text(channel));
            vec![name, format::percent(score.nrmse), format::percent(floor)]
        })
        .collect();
    let header = ["", "identified", "noise"].map(str::to_owned).to_vec();
    let _ = write!(text, "\nFree-run error (nrmse):\n{}", aligned(&[vec![header], rows].concat()));
    text.push_str(&held_out(&report.fit));
    text.push_str(&notes(&report.findings));
    text
}

/// The story of many recordings: the conclusion, the verdict on each, the errors over all, and what failed.
pub fn summary(summary: &Summary) -> String {
    let mut text = String::new();
    for line in &summary.summary {
        let _ = writeln!(text, "{line}");
    }
    let of = &summary.statistics;
    let mut rows = vec![["recording", "verdict", "missing"].map(str::to_owned).to_vec()];
    for r in &of.recordings {
        let kinds: Vec<String> = r.mechanisms.iter().map(|m| format::kind_in_sentence(&m.law.kind)).collect();
        rows.push(vec![r.recording.clone(), verdict(r.verdict).to_owned(), kinds.join(", ")]);
    }
    let _ = write!(text, "\n{}", aligned(&rows));
    let mut rows = vec![["", "nominal", "calibrated", "improved"].map(str::to_owned).to_vec()];
    for (channel, errors) in &summary.holdout {
        let cells = [&errors.nominal, &errors.calibrated, &errors.improved].map(spread);
        rows.push([vec![expression::text(channel)], cells.to_vec()].concat());
    }
    let _ =
        write!(text, "\nHeld-out error (nrmse), median and range over the recordings:\n{}", aligned(&rows));
    for failure in &of.failed {
        let _ = writeln!(text, "Note: {} could not be diagnosed: {}", failure.recording, failure.message);
        if let Some(help) = &failure.help {
            let _ = writeln!(text, "      help: {help}");
        }
    }
    text
}

fn verdict(of: Verdict) -> &'static str {
    match of {
        Verdict::Consistent => "consistent",
        Verdict::MissingPhysics => "missing physics",
        Verdict::Unexplained => "unexplained",
    }
}

fn spread(s: &Spread) -> String {
    match s.finite {
        0 | 1 => format::percent(s.median),
        _ => format!(
            "{} ({} … {})",
            format::percent(s.median),
            format::percent(s.smallest),
            format::percent(s.largest)
        ),
    }
}

/// The terms of one equation, as they stand in the model.
fn term_table(state: &str, equation: &Equation) -> String {
    let mut rows = vec![["", "value", "95 % interval", "chosen in", "unit"].map(str::to_owned).to_vec()];
    for term in &equation.terms {
        rows.push(vec![
            term.expression.clone(),
            format::with_interval(term.value, term.ci95),
            format::interval(term.ci95),
            term.inclusion.map_or_else(|| "always".to_owned(), format::probability),
            term.unit.as_deref().map(format::unit).unwrap_or_default(),
        ]);
    }
    format!("{state}: {}\n{}", equation.expression, aligned(&rows))
}

/// Where the held-out data came from.
fn held_out(fit: &Fit) -> String {
    let source = fit.holdout_source.trim_start_matches("recordings held out: ");
    format!("Held out: {}.\n", source.trim_end_matches('.'))
}

fn mechanism_in_words(number: usize, mechanism: &Mechanism) -> String {
    let mut text = format!(
        "{number}. {}: {}\n   explains {} of the residual, confidence {}\n",
        format::kind(&mechanism.kind),
        expression::text(&mechanism.expression),
        format::probability(mechanism.share_explained),
        format::probability(mechanism.confidence)
    );
    for other in &mechanism.alternatives {
        let standing = match other.equivalent {
            true => "these data cannot tell it apart".to_owned(),
            false => format!("confidence {}", format::probability(other.confidence)),
        };
        let name = sentence::alternative_name(other, mechanism);
        let _ = write!(text, "   or {name} ({standing})");
        if let Some(separate) = other.separate.as_deref().filter(|s| !s.is_empty()) {
            let _ = write!(text, "; to tell: {}", separate.trim_end_matches('.'));
        }
        text.push('\n');
    }
    if let Some(experiment) = mechanism.experiment.as_ref().filter(|e| e.input.is_some()) {
        let _ = writeln!(text, "   to separate them: {}", experiment.text);
    }
    text
}

/// Free-run errors of the models there are, one row per role and channel.
pub fn fit_table(fit: &Fit, noise_floor: &Ordered<f64>) -> String {
    let improved = !(fit.train.improved.is_empty() && fit.holdout.improved.is_empty());
    let mut rows = vec![vec!["".to_owned(), "nominal".to_owned(), "calibrated".to_owned()]];
    rows[0].extend(improved.then(|| "improved".to_owned()));
    rows[0].push("noise".to_owned());
    for (role, set) in [("training", &fit.train), ("held out", &fit.holdout)] {
        for channel in set.channels() {
            let mut row = vec![format!("{role}, {}", expression::text(channel))];
            row.extend(models(set, improved).iter().map(|scores| percent(scores.get(channel))));
            row.push(format::percent(fit.floor_in(set, channel, noise_floor)));
            rows.push(row);
        }
    }
    format!("Free-run error (nrmse):\n{}{}", aligned(&rows), held_out(fit))
}

fn models(set: &FitSet, improved: bool) -> Vec<&Ordered<Score>> {
    let mut models = vec![&set.nominal, &set.calibrated];
    models.extend(improved.then_some(&set.improved));
    models
}

fn percent(score: Option<&Score>) -> String {
    format::percent(score.map_or(f64::NAN, |s| s.nrmse))
}

/// The parameters before and after.
pub fn parameter_table(parameters: &Ordered<Parameter>) -> String {
    let mut rows = vec![["", "nominal", "calibrated", ""].map(str::to_owned).to_vec()];
    for (name, p) in parameters {
        let value = match p.fixed {
            true => "fixed".to_owned(),
            false => format::with_interval(p.value, p.ci95),
        };
        let unit = p.unit.as_deref().map_or(String::new(), format::unit);
        rows.push(vec![name.clone(), format::number(p.nominal), value, unit]);
    }
    format!("Parameters (± half the 95 % interval):\n{}", aligned(&rows))
}

/// What a reader must know of the data, one line for what a channel has in common over recordings; mere facts stay in the
/// report.
pub fn notes(findings: &[Finding]) -> String {
    let mut text = String::new();
    for note in grouped(findings).iter().filter(|n| n.severity > Severity::Info) {
        let place = if note.place.is_empty() { String::new() } else { format!("{}: ", note.place) };
        let _ = writeln!(text, "Note: {place}{}", note.message);
        if let Some(help) = &note.help {
            let _ = writeln!(text, "      help: {help}");
        }
    }
    text
}

/// Columns two spaces apart, indented by two.
fn aligned(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |c: usize| rows.iter().filter_map(|r| r.get(c)).map(|s| s.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for row in rows {
        let cells: Vec<String> =
            row.iter().zip(&widths).map(|(cell, &width)| format!("{cell:width$}")).collect();
        let _ = writeln!(text, "  {}", cells.join("  ").trim_end());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_diagnosis_tells_what_where_how_sure_and_how_well() {
        let json = r#"{
          "verdict": "missing_physics",
          "mechanisms": [{"kind": "coulomb_friction", "equation": "hub", "expression": "fc*sign(theta')",
            "parameters": {"fc": {"value": 0.115, "ci95": [0.111, 0.119], "unit": "N m"}},
            "share_explained": 0.81, "confidence": 0.93,
            "alternatives": [{"kind": "stribeck_friction", "confidence": 0.06, "separate": "slow sweeps."},
                             {"kind": "input_dead_zone", "confidence": 0.9, "equivalent": true}],
            "experiment": {"text": "drive v slowly", "input": "v"},
            "location": {"region": {"theta'": [-0.2, 0.2]}}}],
          "remainder": {"significant": false, "location": {}, "share_of_residual": 0.03},
          "parameters": {},
          "fit": {"train": {"nominal": {"theta": {"nrmse": 0.31}}, "calibrated": {"theta": {"nrmse": 0.22}},
                            "improved": {"theta": {"nrmse": 0.02}}},
                  "holdout": {"nominal": {"theta": {"nrmse": null}}, "calibrated": {"theta": {"nrmse": 0.24}},
                              "improved": {"theta": {"nrmse": 0.021}}},
                  "holdout_source": "run3.csv"},
          "noise_floor": {"theta": 0.015},
          "findings": [{"severity": "warning", "code": "clipping", "recording": "a.csv", "channel": "v",
                        "message": "clipped.", "help": "lower the gain."}]}"#;
        let text = diagnosis(&Report::from_json(json).unwrap());
        for part in [
            "Coulomb friction is missing in the hub equation; fc = 0.115 ± 0.004 N m; it acts when |θ′| < 0.2",
            "1. Coulomb friction: fc·sign(θ′)\n   explains 81 % of the residual, confidence 93 %\n",
            "   or Stribeck friction (confidence 6 %); to tell: slow sweeps\n",
            "   or input dead zone (these data cannot tell it apart)\n   to separate them: drive v slowly\n",
            "               nominal  calibrated  improved  noise\n",
            "  held out, θ  –        24.0 %      2.10 %    1.50 %\n",
            "Held out: run3.csv.\n",
            "Note: a.csv, v: clipped.\n      help: lower the gain.\n",
        ] {
            assert!(text.contains(part), "`{part}` is not in:\n{text}");
        }
    }
}
