//! `comparison.json`: two diagnoses side by side, and what changed from the one to the other.
//!
//! Before and after a repair, an update of the model, another load, another version of greybox. The conventions are
//! those of [`crate::contract`]; `docs/comparison.schema.json` is generated from these types by [`schema`].

use crate::contract::{Estimate, Ordered, Parameter, Report, Score};
use crate::merge;
use crate::sentence::comparison as words;
use crate::summary::MechanismResult;

pub use crate::comparison::{Change, Comparison, ErrorChange, Errors, MechanismChange, Run, Weight, schema};

impl Comparison {
    /// Holds `after` against `before`; each with what it is called.
    ///
    /// ```
    /// use greybox_report::{Report, compare::Comparison};
    /// # let text = r#"{"verdict": "consistent", "mechanisms": [], "parameters": {}, "noise_floor": {},
    /// #   "remainder": {"significant": false, "location": {}, "share_of_residual": 0.0},
    /// #   "fit": {"train": {"nominal": {}, "calibrated": {}, "improved": {}},
    /// #           "holdout": {"nominal": {}, "calibrated": {}, "improved": {}}}}"#;
    /// let (march, april) = (Report::from_json(text)?, Report::from_json(text)?);
    /// let comparison = Comparison::of(("march", &march), ("april", &april));
    /// assert_eq!(comparison.summary[0], "Both runs say: the model agrees with the recordings.");
    /// # Ok::<(), greybox_report::ReportError>(())
    /// ```
    #[must_use]
    pub fn of(before: (&str, &Report), after: (&str, &Report)) -> Comparison {
        let (b, a) = (before.1, after.1);
        let fresh = |of: &Report, than: &Report| {
            of.findings.iter().filter(|f| !than.findings.contains(f)).cloned().collect()
        };
        let mut comparison = Comparison {
            summary: Vec::new(),
            before: run(before),
            after: run(after),
            cautions: words::cautions(b, a),
            mechanisms: mechanisms(b, a),
            parameters: parameters(b, a),
            holdout: holdout(b, a),
            findings_gone: fresh(b, a),
            findings_new: fresh(a, b),
        };
        comparison.summary = words::summary(&comparison);
        comparison
    }
}

fn run((name, report): (&str, &Report)) -> Run {
    Run {
        name: name.to_owned(),
        greybox: report.greybox.clone(),
        model: report.model.clone(),
        verdict: report.verdict,
        samples: report.samples,
        holdout_source: report.fit.holdout_source.clone(),
        remainder: report.remainder.significant,
    }
}

/// Two mechanisms are one where kind, place, what drifts and the names of the parameters are the same; each is paired once.
fn mechanisms(before: &Report, after: &Report) -> Vec<MechanismChange> {
    let of = |report: &Report| report.mechanisms.iter().map(merge::mechanism).collect::<Vec<_>>();
    let weight =
        |m: &MechanismResult| Weight { share_explained: m.share_explained, confidence: m.confidence };
    let mut old = of(before);
    let mut out: Vec<MechanismChange> = of(after)
        .into_iter()
        .map(|new| {
            let key = |m: &MechanismResult| {
                let law = (m.law.kind.clone(), m.law.equation.clone(), m.law.channel.clone());
                (law, m.law.drifting.clone(), m.parameters.keys().cloned().collect::<Vec<_>>())
            };
            let same = old.iter().position(|o| key(o) == key(&new)).map(|at| old.remove(at));
            let empty = Ordered::new();
            let parameters = changes(same.as_ref().map_or(&empty, |o| &o.parameters), &new.parameters);
            let (before, after) = (same.as_ref().map(weight), Some(weight(&new)));
            MechanismChange { law: new.law, before, after, parameters }
        })
        .collect();
    out.extend(old.into_iter().map(|gone| MechanismChange {
        before: Some(weight(&gone)),
        after: None,
        parameters: changes(&gone.parameters, &Ordered::new()),
        law: gone.law,
    }));
    out
}

/// The estimates of either side, those of `after` first.
fn changes(before: &Ordered<Estimate>, after: &Ordered<Estimate>) -> Ordered<Change> {
    let names = after.keys().chain(before.keys().filter(|name| !after.contains_key(*name)));
    names
        .map(|name| (name.clone(), Change::of(before.get(name).cloned(), after.get(name).cloned())))
        .collect()
}

fn parameters(before: &Report, after: &Report) -> Ordered<Change> {
    let estimates = |report: &Report| -> Ordered<Estimate> {
        report.parameters.iter().map(|(name, p)| (name.clone(), estimate(p))).collect()
    };
    let fixed = |report: &Report, name: &str| report.parameters.get(name).is_none_or(|p| p.fixed);
    let mut changes = changes(&estimates(before), &estimates(after));
    changes.retain(|name, c| {
        let same = c.before.as_ref().map(|e| e.value) == c.after.as_ref().map(|e| e.value);
        !(same && fixed(before, name) && fixed(after, name))
    });
    changes
}

fn estimate(p: &Parameter) -> Estimate {
    Estimate { value: p.value, ci95: p.ci95, unit: p.unit.clone().unwrap_or_default() }
}

fn holdout(before: &Report, after: &Report) -> Ordered<ErrorChange> {
    let errors = |report: &Report, channel: &str| {
        let of = |set: &Ordered<Score>| set.get(channel).map(|s| s.nrmse);
        let fit = &report.fit.holdout;
        let (nominal, calibrated, improved) = (of(&fit.nominal), of(&fit.calibrated), of(&fit.improved));
        nominal.or(calibrated).or(improved).map(|_| Errors {
            nominal: nominal.unwrap_or(f64::NAN),
            calibrated: calibrated.unwrap_or(f64::NAN),
            improved: improved.unwrap_or(f64::NAN),
            noise: report.fit.floor_in(fit, channel, &report.noise_floor),
        })
    };
    let mut channels = after.fit.holdout.channels();
    channels.extend(before.fit.holdout.channels());
    let pair = |c: &str| (c.to_owned(), ErrorChange { before: errors(before, c), after: errors(after, c) });
    // A channel of both comes once: a map keeps the first place.
    channels.into_iter().map(pair).collect()
}
