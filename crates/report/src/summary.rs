//! `summary.json`: what many recordings of one machine say together.
//!
//! [`Statistics`] is what one recording leaves, and what any number of them leave: [`crate::merge`] makes it of a
//! report, joins it, and draws the [`Summary`] from it. The conventions are those of [`crate::contract`]; keys may be
//! added, none is renamed, and `docs/summary.schema.json` is generated from these types by [`schema`].

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ReportError;
use crate::contract::{
    Estimate, FitSet, Interval, ModelId, Names, Ordered, Parameter, Producer, Samples, Verdict, document,
    number, number_schema, schema_of,
};

/// What recordings leave for a summary. Both lists are sets: sorted by the name of the recording, none twice.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Statistics {
    /// The recordings that were diagnosed.
    pub recordings: Vec<RecordingResult>,
    /// Those that could not be.
    pub failed: Vec<RecordingFailure>,
}

/// The diagnosis of one recording in figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RecordingResult {
    /// Name of the recording.
    pub recording: String,
    /// Path of its `report.html` from the summary; absent where there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub page: Option<String>,
    /// The conclusion.
    pub verdict: Verdict,
    /// How many samples it learnt from and was judged on.
    pub samples: Samples,
    /// What the model leaves out, as in the report.
    pub mechanisms: Vec<MechanismResult>,
    /// The model's own parameters before and after.
    pub parameters: Ordered<Parameter>,
    /// The three models on data held out.
    pub holdout: FitSet,
    /// Which machine was recorded, when and under what conditions; absent where no table says so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<Run>,
}

/// Which machine was recorded, when and under what conditions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Run {
    /// Name of the machine.
    pub machine: String,
    /// Date, as the table has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub date: Option<String>,
    /// Values by the header of their column, `name` or `name [unit]`, those that are known; `date [a]` is the date in
    /// Julian years since 1970.
    pub covariates: Ordered<f64>,
}

/// A recording that could not be diagnosed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct RecordingFailure {
    /// Name of the recording.
    pub recording: String,
    /// What is wrong, in plain language.
    pub message: String,
    /// What to do about it, where the message does not say.
    #[serde(default, alias = "mend", skip_serializing_if = "Option::is_none")]
    pub help: Option<String>,
}

/// Which law acts where: what makes a mechanism of one recording the same as that of another.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
pub struct Law {
    /// Kind of the mechanism library.
    pub kind: String,
    /// Family of the kind.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub family: String,
    /// Equation or equations of the model in which it acts.
    pub equation: Names,
    /// Measured channel, for the sensing kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<String>,
    /// The law in the model language.
    pub expression: String,
    /// What the expression replaces; absent when it is added.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaces: Option<String>,
    /// The model parameter that drifts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drifting: Option<String>,
}

/// A mechanism of one recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MechanismResult {
    /// Which law acts where.
    #[serde(flatten)]
    pub law: Law,
    /// Its parameters and the figures that follow from them.
    pub parameters: Ordered<Estimate>,
    /// Share of the calibrated model's residual variance (above noise) that it explains, 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub share_explained: f64,
    /// Probability that this kind is right, 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub confidence: f64,
}

/// The whole of `summary.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(title = "greybox summary")]
pub struct Summary {
    /// What produced this summary.
    pub greybox: Producer,
    /// The nominal model that was examined.
    pub model: ModelId,
    /// The conclusion in plain language, one sentence per entry, most important first.
    pub summary: Vec<String>,
    /// How many recordings ended how.
    pub verdicts: Verdicts,
    /// The mechanisms, the most often found first.
    pub mechanisms: Vec<MechanismOver>,
    /// The model's own parameters over the recordings, fixed ones left out.
    pub parameters: Ordered<ParameterOver>,
    /// Free-run errors (`nrmse`) on data held out, over the recordings, by channel.
    pub holdout: Ordered<ErrorsOver>,
    /// What the figures above are drawn from.
    #[serde(flatten)]
    pub statistics: Statistics,
}

/// Counts of recordings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Verdicts {
    /// Nothing is missing.
    pub consistent: usize,
    /// Physics is missing and named.
    pub missing_physics: usize,
    /// Something is missing that no mechanism explains.
    pub unexplained: usize,
    /// Could not be diagnosed.
    pub failed: usize,
}

impl Verdicts {
    /// How many were diagnosed.
    pub fn diagnosed(&self) -> usize {
        self.consistent + self.missing_physics + self.unexplained
    }
}

/// A mechanism over the recordings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MechanismOver {
    /// Which law acts where.
    #[serde(flatten)]
    pub law: Law,
    /// Names of the recordings in which it is found.
    pub found_in: Vec<String>,
    /// In how many machines it is found; absent where no table says which machine was recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machines: Option<ShareOver>,
    /// Share explained, over those recordings.
    pub share_explained: Spread,
    /// Confidence, over those recordings.
    pub confidence: Spread,
    /// Its parameters, over those recordings.
    pub parameters: Ordered<Pooled>,
}

/// A parameter of the nominal model over the recordings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ParameterOver {
    /// Value in the model file.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub nominal: f64,
    /// Its value in the improved model of each recording, and pooled.
    #[serde(flatten)]
    pub pooled: Pooled,
}

/// A number estimated in several recordings ([`greybox_fleet::pool()`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Pooled {
    /// Pooled estimate; `null` where no recording gives an interval.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub value: f64,
    /// 95 % confidence interval of `value`.
    pub ci95: Option<Interval>,
    /// Unit as text; empty for a pure number.
    pub unit: String,
    /// How it is pooled.
    pub method: Method,
    /// How much the recordings differ; absent where fewer than two give an interval.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heterogeneity: Option<Heterogeneity>,
    /// The estimates, in the order of the recordings.
    pub estimates: Vec<RecordingEstimate>,
    /// Over the machines; absent where no table says which machine was recorded, or fewer than three give an interval.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machines: Option<MachinesOver>,
}

/// The share of machines in which a mechanism is found ([`greybox_fleet::share()`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ShareOver {
    /// Names of the machines in which it is found: in at least half of their recordings.
    pub found_in: Vec<String>,
    /// How many machines have a diagnosed recording.
    pub of: usize,
    /// 95 % confidence interval of the share among all machines of the kind.
    pub ci95: Interval,
}

/// A number over machines, by a mixed-effects model ([`greybox_fleet::machines`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MachinesOver {
    /// Mean over the machines that do not differ, at the mean of the covariates.
    pub value: f64,
    /// 95 % confidence interval of `value`.
    pub ci95: Interval,
    /// Standard deviation of the true value from machine to machine.
    pub between: f64,
    /// Standard deviation of the true value from recording to recording of one machine; absent where no machine has two.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub within: Option<f64>,
    /// How it depends on the covariates.
    pub slopes: Vec<SlopeOver>,
    /// Each machine, in the order of the names.
    pub machines: Vec<MachineEstimate>,
}

/// How a number depends on a covariate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SlopeOver {
    /// Header of the covariate's column.
    pub covariate: String,
    /// From recording to recording of one machine, or from machine to machine.
    pub level: Level,
    /// Change per unit of the covariate.
    pub value: f64,
    /// 95 % confidence interval of `value`.
    pub ci95: Interval,
    /// Probability of so steep a slope where there is none.
    pub p_value: f64,
    /// Whether it is taken for real: the probability is below 0.05 over the number of slopes.
    pub significant: bool,
}

/// What a slope is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// One machine changes with the covariate.
    Within,
    /// Machines of other covariates are other machines.
    Between,
}

/// The value of one machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MachineEstimate {
    /// Name of the machine.
    pub machine: String,
    /// How many of its recordings give an interval.
    pub recordings: usize,
    /// Best estimate, drawn towards the other machines unless it differs from them.
    pub value: f64,
    /// 95 % confidence interval of `value`.
    pub ci95: Interval,
    /// Probability of so large a difference from the others; present where the machine is taken to differ.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub differs: Option<f64>,
}

/// How estimates are pooled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// No recording gives an interval.
    None,
    /// One recording gives an interval: its estimate.
    Single,
    /// By inverse variance: the recordings agree.
    FixedEffect,
    /// The mean of values that differ from recording to recording (DerSimonian–Laird).
    RandomEffects,
}

/// How much the estimates of several recordings differ.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Heterogeneity {
    /// Cochran's Q.
    pub q: f64,
    /// Number of estimates less one.
    pub degrees_of_freedom: usize,
    /// Probability of so large a Q where the true value is the same in all recordings.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub p_value: f64,
    /// I², the share of the scatter that the intervals do not account for, 0 to 1.
    pub i_squared: f64,
    /// τ, the standard deviation of the true value from recording to recording, in the unit of the value.
    pub tau: f64,
}

/// The estimate of one recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RecordingEstimate {
    /// Name of the recording.
    pub recording: String,
    /// Best estimate.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub value: f64,
    /// 95 % confidence interval; `null` where none could be computed.
    pub ci95: Option<Interval>,
}

/// Errors of the three models, each over the recordings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ErrorsOver {
    /// The model as given.
    pub nominal: Spread,
    /// Refitted to each recording.
    pub calibrated: Spread,
    /// With the mechanisms found in each recording.
    pub improved: Spread,
}

/// A figure over several recordings.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Spread {
    /// Median; `null` where there is no finite value.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub median: f64,
    /// Smallest.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub smallest: f64,
    /// Largest.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub largest: f64,
    /// How many recordings give a finite value.
    pub finite: usize,
    /// How many do not: their simulations diverged.
    pub diverged: usize,
}

impl Spread {
    /// The spread of some values.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Spread {
        let (mut finite, rest): (Vec<f64>, Vec<f64>) = values.into_iter().partition(|v| v.is_finite());
        finite.sort_by(f64::total_cmp);
        let at = |i: usize| finite.get(i).copied().unwrap_or(f64::NAN);
        let n = finite.len();
        Spread {
            median: 0.5 * (at(n.saturating_sub(1) / 2) + at(n / 2)),
            smallest: at(0),
            largest: at(n.saturating_sub(1)),
            finite: n,
            diverged: rest.len(),
        }
    }
}

impl Summary {
    /// The summary as indented JSON with a final newline.
    ///
    /// # Errors
    /// [`ReportError::Json`] if serialisation fails; the types leave no known way for that.
    pub fn to_json(&self) -> Result<String, ReportError> {
        document(self)
    }
}

/// JSON schema (draft 2020-12) of `summary.json`, generated from the types of this module.
pub fn schema() -> serde_json::Value {
    schema_of::<Summary>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_has_its_median_and_counts_what_diverged() {
        let s = Spread::of([3.0, f64::INFINITY, 1.0, 2.0, f64::NAN, 10.0]);
        assert_eq!((s.median, s.smallest, s.largest, s.finite, s.diverged), (2.5, 1.0, 10.0, 4, 2));
        assert_eq!(Spread::of([3.0, 1.0, 2.0]).median, 2.0);
        assert!(Spread::of([]).median.is_nan());
    }
}
