//! `report.json`: the machine-readable result of a diagnosis.
//!
//! The types here *are* the contract. Keys may be added, and a renamed key is still read under its old name.
//! `docs/report.schema.json` is generated from them by [`schema`]. They hold plain data, so that whatever produces a diagnosis can fill
//! them field by field, and they decide nothing.
//!
//! Conventions:
//! - A number that is not finite (a channel whose RMS is zero, a parameter without an interval) is written
//!   as `null` and read back as NaN. The schema allows `null` wherever that can happen.
//! - Maps keep the order in which they were filled: channels and parameters read in the order of the model.
//! - Times in s from the start of the recording, frequencies in Hz, everything else in the model's units.
//! - An optional key that has nothing to say is left out, except where the contract promises it.

use indexmap::IndexMap;
use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::ReportError;

/// A map that keeps the order of insertion, so that equal diagnoses give equal bytes.
pub type Ordered<V> = IndexMap<String, V>;

/// The whole of `report.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(title = "greybox report")]
pub struct Report {
    /// What produced this report.
    #[serde(default)]
    pub greybox: Producer,
    /// The nominal model that was examined.
    #[serde(default)]
    pub model: ModelId,
    /// How many samples it learnt from and was judged on.
    #[serde(default)]
    pub samples: Samples,
    /// The conclusion.
    pub verdict: Verdict,
    /// The conclusion in plain language, one sentence per entry, most important first.
    #[serde(default)]
    pub summary: Vec<String>,
    /// What is missing was identified as terms and not looked for by name (`greybox identify --model`).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub terms_only: bool,
    /// What the improved model rests on.
    #[serde(default)]
    pub basis: Basis,
    /// What the model leaves out, sorted by `share_explained`, largest first. Empty unless the verdict is
    /// `missing_physics`.
    pub mechanisms: Vec<Mechanism>,
    /// What the improved model holds although it is not believed to be what is missing: it predicts recordings that it
    /// was not fitted to. Sorted by `share_explained`; empty where `basis` is `named` or `calibrated`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub candidates: Vec<Mechanism>,
    /// How far the candidates can be trusted. Absent where there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub closure: Option<Closure>,
    /// The sum of laws that was tried in place of what has no name and is not in the improved model. Absent where none was
    /// found, or it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub closure_rejected: Option<ClosureRejected>,
    /// What fewer of several mechanisms would leave: none, each alone, all but one, all. Empty where there is one, or
    /// none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub subsets: Vec<Subset>,
    /// What is still unexplained, whatever the verdict.
    pub remainder: Remainder,
    /// The model's own parameters before and after, in the order of the model.
    pub parameters: Ordered<Parameter>,
    /// How well the nominal, the calibrated and the improved model reproduce the measurements.
    pub fit: Fit,
    /// Estimated measurement-noise RMS over RMS(measurement − its mean) of the training data, by channel: the `nrmse`
    /// there that no model can beat.
    #[serde(with = "number_map")]
    #[schemars(schema_with = "number_map_schema")]
    pub noise_floor: Ordered<f64>,
    /// What happens between samples of each input: as stated and as the recording prefers it.
    #[serde(default)]
    pub inputs: Ordered<InputHold>,
    /// Data health and other observations that a reader must know.
    #[serde(default)]
    pub findings: Vec<Finding>,
}

/// Version of the documents that this program writes. It goes up when a key changes its name or its meaning; keys of earlier
/// versions are still read.
///
/// | version | change |
/// |---|---|
/// | 2 | `schema` itself; `subsets[].left` is `residual_share`, `findings[].mend` is `help` |
pub const SCHEMA: u32 = 2;

/// The program that wrote the report.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Producer {
    /// Version of greybox, e.g. `0.1.0`.
    pub version: String,
    /// Version of the document; 0 where it states none, as before version 2.
    #[serde(default)]
    pub schema: u32,
    /// Seed of every random choice; the same seed and inputs give the same report.
    pub seed: u64,
}

impl Producer {
    /// This program, with the seed of a run.
    #[must_use]
    pub fn this(seed: u64) -> Producer {
        Producer { version: env!("CARGO_PKG_VERSION").to_owned(), schema: SCHEMA, seed }
    }

    /// # Errors
    /// [`ReportError::Newer`] for a document of a later version than this program knows.
    pub(crate) fn check(&self) -> Result<(), ReportError> {
        if self.schema > SCHEMA {
            let Producer { version, schema, .. } = self;
            return Err(ReportError::Newer { version: version.clone(), schema: *schema });
        }
        Ok(())
    }
}

/// Which model was examined.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ModelId {
    /// The `name` in the model file.
    pub name: String,
    /// File name of the model, without its directory.
    pub file: String,
}

/// Samples of each channel, over all recordings of a role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Samples {
    /// To choose and fit with.
    pub train: usize,
    /// Held out.
    pub holdout: usize,
}

/// The conclusion of a diagnosis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing beyond noise is missing once the parameters are calibrated.
    Consistent,
    /// The physics listed under `mechanisms` is missing.
    MissingPhysics,
    /// Something is missing, located and sized, but nothing in the library explains it.
    Unexplained,
}

/// What the improved model rests on. It is the best simulation that can be defended, whatever the verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Basis {
    /// The mechanisms listed, which are believed.
    Named,
    /// The mechanisms listed, which are believed, and the candidates listed, which are not.
    NamedAndProposed,
    /// The candidates listed, which are not.
    Proposed,
    /// The given equations with refitted parameters.
    #[default]
    Calibrated,
}

/// Some of the mechanisms, and how well the model does with these alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Subset {
    /// Indices into `mechanisms`, counted from 0, rising.
    pub mechanisms: Vec<usize>,
    /// Residual sum of squares, noise included, over that of the calibrated model, 0 to 1; the parameters are refitted
    /// with these mechanisms.
    #[serde(with = "number", alias = "left")]
    #[schemars(schema_with = "number_schema")]
    pub residual_share: f64,
}

/// One piece of missing physics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Mechanism {
    /// Kind of the mechanism library, e.g. `coulomb_friction`.
    pub kind: String,
    /// Family of the kind, e.g. `friction`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub family: String,
    /// Equation (or equations) of the model in which it acts.
    pub equation: Names,
    /// Measured channel, for the sensing kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<String>,
    /// Force on the left side of the equation, in the model language, or what stands in place of `replaces`.
    pub expression: String,
    /// What the expression replaces (an input, a measurement, a parameter); absent when it is added.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaces: Option<String>,
    /// Equations of the mechanism's own states, by state, e.g. `z` → `z' = q' - s0/fc*abs(q')*z`.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    pub states: Ordered<String>,
    /// The model parameter that drifts, for `parameter_drift`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drifting: Option<String>,
    /// Identified parameters of the expression, and the figures that follow from them (a resonance: `f0` in
    /// Hz, `zeta`).
    pub parameters: Ordered<Estimate>,
    /// Share of the calibrated model's residual that it explains, 0 to 1: of several, the mean of what it takes away
    /// alone and of what is missed without it, scaled so that they add up to what all explain.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub share_explained: f64,
    /// Probability that this kind is right, 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub confidence: f64,
    /// Other explanations considered, most confident first.
    #[serde(default)]
    pub alternatives: Vec<Alternative>,
    /// The experiment that separates it from its alternatives; absent where there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub experiment: Option<Experiment>,
    /// Where it acts.
    pub location: Location,
}

/// A recording to make. Every number comes from the present recordings or from the law; one that neither
/// gives is absent.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Experiment {
    /// In plain language.
    pub text: String,
    /// Input of the model to drive.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<String>,
    /// Its smallest and largest magnitude, in its unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub amplitude: Option<Interval>,
    /// Frequencies in Hz.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band_hz: Option<Interval>,
    /// Expression of the model that should pass through `range`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub variable: Option<String>,
    /// The range; an open end is `null`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<[Option<f64>; 2]>,
}

/// A name, or a list of names where more than one equation is meant.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Names {
    /// Exactly one.
    One(String),
    /// Several, e.g. every equation in which an input enters.
    Many(Vec<String>),
}

impl Names {
    /// The names as a slice, whichever form they have.
    pub fn as_slice(&self) -> &[String] {
        match self {
            Names::One(name) => std::slice::from_ref(name),
            Names::Many(names) => names,
        }
    }
}

impl From<&str> for Names {
    fn from(name: &str) -> Self {
        Names::One(name.to_owned())
    }
}

impl From<String> for Names {
    fn from(name: String) -> Self {
        Names::One(name)
    }
}

/// One name stays a plain string; any other number becomes a list.
impl From<Vec<String>> for Names {
    fn from(mut names: Vec<String>) -> Self {
        match names.pop() {
            Some(only) if names.is_empty() => Names::One(only),
            Some(last) => {
                names.push(last);
                Names::Many(names)
            }
            None => Names::Many(names),
        }
    }
}

/// How far laws that the improved model holds without a name can be trusted: their range of validity, their
/// cross-validation, and the parameters of the machine that they are correlated with.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Closure {
    /// By variable of their forces, an expression of the model, where it was in the training recordings, SI.
    pub range: Ordered<Range>,
    /// Share of the held-out samples where a variable is outside its range, 0 to 1; `null` where there is none.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub outside: f64,
    /// How the models predict each part of the training recordings, fitted without it.
    pub cross_validation: Vec<Fold>,
    /// By parameter of a candidate, the parameter of the machine whose estimate is most correlated with its own.
    pub correlated_with: Ordered<Correlated>,
}

/// A sum of laws that fails at a gate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ClosureRejected {
    /// The first gate that it fails at.
    pub gate: Gate,
    /// Its laws.
    pub laws: Vec<RejectedLaw>,
}

/// What a sum of laws must pass to be handed back, in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Gate {
    /// No law acts at certain times of a single recording.
    Clock,
    /// The recordings determine its coefficients, and these are what its laws require of them.
    Determined,
    /// It simulates the training recordings no worse than the calibrated model.
    Training,
    /// No inertia is negative.
    Inertia,
    /// The machine's own parameters are within what the model states of them (`std`), or no farther from there than those of the
    /// calibrated model or of what stands without it.
    Parameters,
    /// It predicts what is left out of its fit better than the calibrated model, beyond chance.
    CrossValidation,
    /// It simulates the training recordings better than what stands without it, and predicts what is left out better.
    Comparison,
    /// It leaves no more than noise, or holds every law that is named.
    Names,
}

/// A law of a sum that is rejected.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct RejectedLaw {
    /// The kind of law.
    pub kind: String,
    /// The equation or equations that it enters.
    pub equation: Names,
    /// The law, an expression of the model language; its parameters have no values.
    pub expression: String,
}

/// Where a variable was.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Range {
    /// Least and largest value in the training recordings, as the improved model simulates them, SI.
    pub train: Interval,
    /// Share of the held-out samples outside, 0 to 1; `null` where there are none.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub outside: f64,
}

/// What was left out of a fit, and how it was predicted: RMS error over the RMS of the measurement about its mean, geometric
/// mean over the channels; `null` where a simulation diverges.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Fold {
    /// File names of the recordings.
    pub recordings: Vec<String>,
    /// The part that is judged, s from the start, where it is not whole recordings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub window_s: Option<Interval>,
    /// Of the calibrated model.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub calibrated: f64,
    /// Of the improved model.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub improved: f64,
}

/// A parameter of the machine whose estimate is correlated with another one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Correlated {
    /// Its name.
    pub parameter: String,
    /// Correlation of the two estimates, −1 to 1: near either end the recordings hardly tell the two apart.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub correlation: f64,
}

/// An identified number with its uncertainty.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Estimate {
    /// Best estimate.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub value: f64,
    /// 95 % confidence interval; `null` where none could be computed.
    pub ci95: Option<Interval>,
    /// Unit as text; empty for a pure number.
    #[serde(default)]
    pub unit: String,
}

/// A model parameter before and after.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Parameter {
    /// Value in the model file.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub nominal: f64,
    /// Value in the improved model (in the calibrated one where nothing is missing).
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub value: f64,
    /// 95 % confidence interval of `value`; `null` for a fixed parameter.
    pub ci95: Option<Interval>,
    /// Unit as text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// The model file holds this parameter fixed, so nothing moved it.
    #[serde(default)]
    pub fixed: bool,
    /// Value after refitting the unchanged equations: what the parameter had to become to hide what is
    /// missing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibrated: Option<f64>,
    /// 95 % confidence interval of `calibrated`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibrated_ci95: Option<Interval>,
}

/// An explanation that was considered beside the reported one.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Alternative {
    /// Kind of the mechanism library.
    pub kind: String,
    /// Probability that this kind is right instead, 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub confidence: f64,
    /// True where these data cannot separate it from the reported mechanism.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub equivalent: bool,
    /// Its expression in the model language.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expression: Option<String>,
    /// The recording that would separate the two, in plain language.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub separate: Option<String>,
    /// Equation or equations in which it would act.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub equation: Option<Names>,
    /// Channel of the recording, for a fault of a sensor; several where only their faults together are the alternative.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<Names>,
    /// Input that it would stand in for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaces: Option<String>,
    /// Parameter that would drift.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drifting: Option<String>,
}

/// Where something acts: in which equation, when, in which part of the state space, at which frequencies.
/// An unknown equation or band is left out; unknown windows and regions are empty.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Location {
    /// Equation or equations of the model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub equation: Option<Names>,
    /// Time windows in s from the start of each recording, by file name.
    #[serde(default)]
    pub windows_s: Ordered<Vec<Interval>>,
    /// Ranges of expressions of the model language (`theta'`, `abs(v)`); an open end is `null`.
    #[serde(default)]
    pub region: Ordered<[Option<f64>; 2]>,
    /// SI unit of those expressions of `region` whose variables have another unit in the model (`rad` for `deg`).
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    pub region_units: Ordered<String>,
    /// Frequency band in Hz.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band_hz: Option<Interval>,
}

impl Location {
    /// True when nothing is known about where.
    pub fn is_empty(&self) -> bool {
        *self == Location::default()
    }
}

/// What is left unexplained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Remainder {
    /// True when what is left exceeds what noise can do.
    pub significant: bool,
    /// Where it acts.
    pub location: Location,
    /// Its share of the calibrated model's residual variance (above noise), 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub share_of_residual: f64,
    /// The recording that would tell what it is, in plain language.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub experiment: Option<String>,
    /// The same with its numbers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub experiment_plan: Option<Experiment>,
}

/// How well the models reproduce the measurements.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Fit {
    /// On the recordings (or parts of them) that were used to choose and fit.
    pub train: FitSet,
    /// On data that was never used to choose or fit anything.
    pub holdout: FitSet,
    /// Length in s after which the windowed simulations restart from the estimated state.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub window_s: Option<f64>,
    /// Which figure judges the models: `nrmse`, or `nrmse_windowed` where a small error of the initial state grows
    /// beyond the signal within a free run.
    #[serde(default)]
    pub criterion: Criterion,
    /// Where the held-out data came from, in plain language.
    #[serde(default)]
    pub holdout_source: String,
    /// The same by recording, by file name.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    pub recordings: Ordered<RecordingFit>,
}

/// Which figure judges a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Criterion {
    /// `nrmse` of the simulation over the whole recording.
    #[default]
    FreeRun,
    /// `nrmse_windowed`: the machine is unstable, chaotic or integrates.
    Windowed,
}

impl Fit {
    /// What `noise_floor`, taken on the training data, is in another set, whose signals vary more or less: the `nrmse`
    /// there that no model can beat. The floor itself where the scores do not tell how much they vary.
    ///
    /// Both `nrmse` and `rmse` are of the same simulation, so that rmse/nrmse is the RMS of the measurement about its
    /// mean, s; of the floor σ/s₁ in the training data, σ/s₂ = σ/s₁ · s₁/s₂ is left in the other.
    pub fn floor_in(&self, set: &FitSet, channel: &str, noise_floor: &Ordered<f64>) -> f64 {
        let floor = noise_floor.get(channel).copied().unwrap_or(f64::NAN);
        match (self.train.spread(channel), set.spread(channel)) {
            (Some(train), Some(other)) => floor * train / other,
            _ => floor,
        }
    }
}

/// Scores of one recording; a recording whose last part is held out has both.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RecordingFit {
    /// On the part used for fitting.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub train: Option<FitSet>,
    /// On the part held out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub holdout: Option<FitSet>,
}

/// Scores of the three models, each by channel.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FitSet {
    /// The model as given.
    pub nominal: Ordered<Score>,
    /// The same equations with the free parameters refitted: the fair baseline.
    pub calibrated: Ordered<Score>,
    /// With the mechanisms found.
    pub improved: Ordered<Score>,
}

impl FitSet {
    /// True when no model has a score.
    pub fn is_empty(&self) -> bool {
        self.nominal.is_empty() && self.calibrated.is_empty() && self.improved.is_empty()
    }

    /// RMS of a channel about its mean, in its unit.
    fn spread(&self, channel: &str) -> Option<f64> {
        [&self.nominal, &self.calibrated, &self.improved]
            .into_iter()
            .filter_map(|model| model.get(channel))
            .filter_map(|score| score.rmse.map(|rmse| rmse / score.nrmse))
            .find(|spread| spread.is_finite() && *spread > 0.0)
    }

    /// The channels in order of first appearance over the three models.
    pub fn channels(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for model in [&self.nominal, &self.calibrated, &self.improved] {
            for name in model.keys() {
                if !names.contains(&name.as_str()) {
                    names.push(name);
                }
            }
        }
        names
    }
}

/// Fit of one channel: `nrmse` = RMS(simulation − measurement) / RMS(measurement − its mean).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Score {
    /// Free-run simulation over the whole recording; `null` where the simulation diverged.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub nrmse: f64,
    /// RMS(simulation − measurement) in the channel's unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rmse: Option<f64>,
    /// As `nrmse`, for simulations restarted every `window_s` from the estimated state.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nrmse_windowed: Option<f64>,
    /// As `rmse`, for simulations restarted every `window_s` from the estimated state.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rmse_windowed: Option<f64>,
}

/// What happens between samples of an input: `zero`, `linear` or `band_limited`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct InputHold {
    /// As stated in the model (or its default).
    pub hold_given: String,
    /// The one that explains the recordings best.
    pub hold_best: String,
}

/// An observation about the data or the model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// Stable short name, e.g. `clipping`.
    pub code: String,
    /// Recording concerned, by file name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording: Option<String>,
    /// Channel concerned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<String>,
    /// What was found, in plain language.
    pub message: String,
    /// What to do about it.
    #[serde(default, alias = "mend", skip_serializing_if = "Option::is_none")]
    pub help: Option<String>,
}

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Good to know.
    Info,
    /// May have influenced the result.
    Warning,
    /// The result should not be trusted before this is fixed.
    Error,
}

/// A closed interval, in JSON a list of two numbers; an end that is not finite is `null`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Interval {
    /// The interval [low, high].
    pub const fn new(low: f64, high: f64) -> Self {
        Interval { low, high }
    }

    /// Half the width.
    pub fn half_width(self) -> f64 {
        0.5 * (self.high - self.low)
    }
}

impl From<[f64; 2]> for Interval {
    fn from([low, high]: [f64; 2]) -> Self {
        Interval { low, high }
    }
}

impl Serialize for Interval {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        [finite(self.low), finite(self.high)].serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Interval {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let [low, high] = <[Option<f64>; 2]>::deserialize(deserializer)?;
        Ok(Interval { low: low.unwrap_or(f64::NAN), high: high.unwrap_or(f64::NAN) })
    }
}

impl JsonSchema for Interval {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Interval".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": "Lower and upper end; null where not finite or open.",
            "type": "array",
            "items": {"type": ["number", "null"]},
            "minItems": 2,
            "maxItems": 2,
        })
    }
}

/// A document as indented JSON with a final newline.
pub(crate) fn document<T: Serialize>(of: &T) -> Result<String, ReportError> {
    let mut text = serde_json::to_string_pretty(of)?;
    text.push('\n');
    Ok(text)
}

/// JSON schema (draft 2020-12) of a document.
pub(crate) fn schema_of<T: JsonSchema>() -> serde_json::Value {
    SchemaSettings::draft2020_12().for_serialize().into_generator().into_root_schema_for::<T>().to_value()
}

impl Report {
    /// The report as indented JSON with a final newline.
    ///
    /// # Errors
    /// [`ReportError::Json`] if serialisation fails; the types leave no known way for that.
    pub fn to_json(&self) -> Result<String, ReportError> {
        document(self)
    }

    /// Reads a report; `null` numbers become NaN and keys that are not known are skipped.
    ///
    /// # Errors
    /// [`ReportError::Json`] with line and column where the text is not JSON or misses a promised key, [`ReportError::Newer`]
    /// where it is of a later version than [`SCHEMA`].
    pub fn from_json(text: &str) -> Result<Self, ReportError> {
        let report: Self = serde_json::from_str(text)?;
        report.greybox.check()?;
        Ok(report)
    }
}

/// JSON schema (draft 2020-12) of `report.json`, generated from the types of this module.
pub fn schema() -> serde_json::Value {
    schema_of::<Report>()
}

fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

pub(crate) fn number_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({"type": ["number", "null"]})
}

pub(crate) fn number_map_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({"type": "object", "additionalProperties": {"type": ["number", "null"]}})
}

/// A number that may be not finite: `null` in JSON, NaN when read back.
pub(crate) mod number {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub(crate) fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        super::finite(*value).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        Ok(Option::<f64>::deserialize(deserializer)?.unwrap_or(f64::NAN))
    }
}

/// A map of numbers that may be not finite.
pub(crate) mod number_map {
    use super::Ordered;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(crate) fn serialize<S: Serializer>(map: &Ordered<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(map.iter().map(|(name, value)| (name, super::finite(*value))))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Ordered<f64>, D::Error> {
        let map = Ordered::<Option<f64>>::deserialize(deserializer)?;
        Ok(map.into_iter().map(|(name, value)| (name, value.unwrap_or(f64::NAN))).collect())
    }
}
