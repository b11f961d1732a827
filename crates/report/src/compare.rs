//! `comparison.json`: two diagnoses side by side, and what changed from the one to the other.
//!
//! Before and after a repair, an update of the model, another load, another version of greybox. The conventions are
//! those of [`crate::contract`]; `docs/comparison.schema.json` is generated from these types by [`schema`].

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ReportError;
use crate::contract::{
    Estimate, Finding, ModelId, Ordered, Parameter, Producer, Report, Samples, Score, Verdict, document,
    number, number_schema, schema_of,
};
use crate::merge;
use crate::sentence::comparison as words;
use crate::summary::{Law, MechanismResult};

/// The whole of `comparison.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(title = "greybox comparison")]
pub struct Comparison {
    /// What changed in plain language, one sentence per entry, most important first.
    pub summary: Vec<String>,
    /// The two runs.
    pub before: Run,
    /// See `before`.
    pub after: Run,
    /// Why figures of the two runs may not be held against each other; empty where they may.
    pub cautions: Vec<String>,
    /// Mechanisms of either run, those of `after` first.
    pub mechanisms: Vec<MechanismChange>,
    /// The model's own parameters, fixed ones that did not change left out.
    pub parameters: Ordered<Change>,
    /// Errors on data held out, by channel.
    pub holdout: Ordered<ErrorChange>,
    /// Findings that only the run before has.
    pub findings_gone: Vec<Finding>,
    /// Findings that only the run after has.
    pub findings_new: Vec<Finding>,
}

/// One of the two runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Run {
    /// What it is called here: the path that was given.
    pub name: String,
    /// What produced its report.
    pub greybox: Producer,
    /// The nominal model.
    pub model: ModelId,
    /// The conclusion.
    pub verdict: Verdict,
    /// How many samples it learnt from and was judged on.
    pub samples: Samples,
    /// Where its held-out data came from.
    pub holdout_source: String,
    /// Whether something is left unexplained.
    pub remainder: bool,
}

/// A number of the two runs; absent where a run does not have it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Change {
    /// In the run before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub before: Option<Estimate>,
    /// In the run after.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<Estimate>,
    /// Whether the two differ by more than √(h₁² + h₂²), the 95 % half-width of the difference of independent
    /// estimates with half-widths h₁ and h₂; absent where an interval is missing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub changed: Option<bool>,
}

impl Change {
    fn of(before: Option<Estimate>, after: Option<Estimate>) -> Change {
        let mut change = Change { before, after, changed: None };
        change.changed = change.difference().map(|(by, half)| by.abs() > half);
        change
    }

    /// After minus before, and the half-width of its 95 % interval; none where an interval is missing or the units
    /// differ.
    pub(crate) fn difference(&self) -> Option<(f64, f64)> {
        let (a, b) = (self.before.as_ref()?, self.after.as_ref()?);
        let half = a.ci95?.half_width().hypot(b.ci95?.half_width());
        let by = b.value - a.value;
        (a.unit == b.unit && by.is_finite() && half.is_finite()).then_some((by, half))
    }
}

/// A mechanism that either run found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MechanismChange {
    /// Which law acts where, as the later run that has it says.
    #[serde(flatten)]
    pub law: Law,
    /// In the run before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub before: Option<Weight>,
    /// In the run after.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<Weight>,
    /// Its parameters.
    pub parameters: Ordered<Change>,
}

impl MechanismChange {
    /// Whether only one run has it, or a parameter of it differs by more than its intervals.
    pub(crate) fn is_changed(&self) -> bool {
        self.before.is_none() || self.after.is_none() || has_changed(&self.parameters)
    }
}

/// How much a mechanism counts in a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Weight {
    /// Share of the calibrated model's residual variance (above noise) that it explains, 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub share_explained: f64,
    /// Probability that this kind is right, 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub confidence: f64,
}

/// Free-run errors (`nrmse`) of one channel on data held out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ErrorChange {
    /// In the run before.
    pub before: Option<Errors>,
    /// In the run after.
    pub after: Option<Errors>,
}

/// Errors of the three models beside what noise alone leaves; `null` where a simulation diverged or is missing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Errors {
    /// The model as given.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub nominal: f64,
    /// The same equations, refitted.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub calibrated: f64,
    /// With the mechanisms found.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub improved: f64,
    /// Noise alone.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub noise: f64,
}

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

    /// Whether the runs conclude differently: another verdict, a mechanism that is new, gone or changed, or a parameter
    /// that changed by more than its intervals.
    #[must_use]
    pub fn is_changed(&self) -> bool {
        self.before.verdict != self.after.verdict
            || self.mechanisms.iter().any(MechanismChange::is_changed)
            || has_changed(&self.parameters)
    }

    /// Whether the model that came of the later run is the worse one: the held-out error of a channel is more than
    /// `growth` (0.1 = 10 %) above that of the run before, is no number any more, or is not there.
    #[must_use]
    pub fn is_worse(&self, growth: f64) -> bool {
        self.holdout.values().filter_map(|errors| errors.before.map(|before| (before, errors.after))).any(
            |(before, after)| {
                let limit = before.improved * (1.0 + growth);
                let within = after.is_some_and(|after| after.improved <= limit);
                before.improved.is_finite() && !within
            },
        )
    }

    /// The comparison as indented JSON with a final newline.
    ///
    /// # Errors
    /// [`ReportError::Json`] if serialisation fails; the types leave no known way for that.
    pub fn to_json(&self) -> Result<String, ReportError> {
        document(self)
    }
}

/// JSON schema (draft 2020-12) of `comparison.json`, generated from the types of this module.
pub fn schema() -> serde_json::Value {
    schema_of::<Comparison>()
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

/// Whether any of these differs by more than its intervals.
fn has_changed(changes: &Ordered<Change>) -> bool {
    changes.values().any(|c| c.changed == Some(true))
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
