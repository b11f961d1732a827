//! The types of `comparison.json`, and its schema.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ReportError;
use crate::contract::{
    Estimate, Finding, ModelId, Ordered, Producer, Samples, Verdict, document, number, number_schema,
    schema_of,
};
use crate::summary::Law;

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

impl Comparison {
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
    pub(crate) fn of(before: Option<Estimate>, after: Option<Estimate>) -> Change {
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

/// Whether any of these differs by more than its intervals.
fn has_changed(changes: &Ordered<Change>) -> bool {
    changes.values().any(|c| c.changed == Some(true))
}
