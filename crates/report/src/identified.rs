//! `report.json` of an identification: equations that greybox found, without a nominal model.
//!
//! A document of its own: an identification has no verdict and no mechanisms. What both documents say, they
//! say alike: [`Fit`], `noise_floor`, [`InputHold`] and [`Finding`] are the types of [`crate::contract`]. The
//! identified model stands in `fit.train.improved` and `fit.holdout.improved`; `nominal` and `calibrated` stay
//! empty, since there is no model to begin with. `docs/identify.schema.json` is generated from these types by
//! [`schema`].
//!
//! **The equation reads: Σ value × term = input**, with states and inputs in the units of
//! [`Variable::unit`], which are SI; `model.toml` means the same numbers.

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::ReportError;
use crate::contract::{
    Finding, Fit, InputHold, Interval, ModelId, Ordered, Producer, document, number, number_map,
    number_map_schema, number_schema, schema_of,
};

/// The whole of `report.json`, as `greybox identify` writes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(title = "greybox identification")]
pub struct IdentifyReport {
    /// What produced this report.
    #[serde(default)]
    pub greybox: Producer,
    /// The model file that was written.
    #[serde(default)]
    pub model: ModelId,
    /// The result in plain language, one sentence per entry, most important first.
    #[serde(default)]
    pub summary: Vec<String>,
    /// The equations, by the state that each governs.
    pub equations: Ordered<Equation>,
    /// The states and inputs of the equations and their units.
    #[serde(default)]
    pub variables: Ordered<Variable>,
    /// How the order of the library was chosen.
    pub order: Order,
    /// Delayed feedback, by the state that is fed back; absent where none was asked for.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    pub delay: Ordered<Delay>,
    /// Dead times of inputs, by the input; absent where none was asked for.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    pub dead_time: Ordered<DeadTime>,
    /// How well the identified model (`improved`) reproduces the measurements.
    pub fit: Fit,
    /// How the recordings were read, where in blocks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocks: Option<Blocks>,
    /// Estimated measurement-noise RMS over RMS(measurement − its mean), by channel: the `nrmse` that no
    /// model can beat.
    #[serde(with = "number_map")]
    #[schemars(schema_with = "number_map_schema")]
    pub noise_floor: Ordered<f64>,
    /// RMS of what the fit leaves over the RMS of the noise, by channel: 1 where nothing but noise is left.
    #[serde(default, with = "number_map")]
    #[schemars(schema_with = "number_map_schema")]
    pub misfit: Ordered<f64>,
    /// What happens between samples of each input; `hold_given` is empty where none was given.
    #[serde(default)]
    pub inputs: Ordered<InputHold>,
    /// Data health and other observations that a reader must know.
    #[serde(default)]
    pub findings: Vec<Finding>,
}

/// Recordings that were read in blocks; `fit.train` is that of the first one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Blocks {
    /// Blocks that the equations were fitted to.
    pub blocks: usize,
    /// Their samples.
    pub samples: usize,
    /// Samples of blocks on which the model could not be simulated.
    pub lost: usize,
    /// Passes over the recordings.
    pub passes: usize,
    /// Whether the last pass moved no coefficient by more than a tenth of its interval's half-width.
    pub settled: bool,
}

/// One equation: Σ value × term = input.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Equation {
    /// The input on its right side; `null` where that side is zero.
    pub input: Option<String>,
    /// The equation as `model.toml` has it, coefficients by name.
    #[serde(default)]
    pub expression: String,
    /// Its terms, the leading derivative first.
    pub terms: Vec<Term>,
    /// Terms that were left out although the recordings do not rule them out, or kept although they hardly
    /// show them.
    #[serde(default)]
    pub doubtful: Vec<Doubtful>,
}

/// A term with its coefficient.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Term {
    /// The term without its coefficient, in the model language.
    pub expression: String,
    /// Exponents of the variables, for a monomial: `{"x": 2, "x'": 1}` is x²x′.
    #[serde(default, skip_serializing_if = "Ordered::is_empty")]
    pub powers: Ordered<u32>,
    /// Name of the coefficient in `model.toml`. Absent for the leading term of an equation without input, whose
    /// coefficient is one, and for a delayed feedback, whose coefficient is minus its gain.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parameter: Option<String>,
    /// The coefficient.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub value: f64,
    /// 95 % confidence interval of the coefficient; `null` where it sets the scale and is known.
    pub ci95: Option<Interval>,
    /// Unit of the coefficient as text; absent where the recordings state no units.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Share of bootstrap replicates that choose the term, 0 to 1; absent for a term that is not open to
    /// choice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inclusion: Option<f64>,
}

/// A term in doubt.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Doubtful {
    /// The term, in the model language.
    pub expression: String,
    /// Whether the model has it.
    pub chosen: bool,
    /// Share of bootstrap replicates that choose it, 0 to 1.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub inclusion: f64,
}

/// A state or an input of the equations.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Variable {
    /// `state` or `input`.
    pub role: VariableRole,
    /// Unit of the channel in the recordings; empty where none is stated.
    pub channel_unit: String,
    /// Unit in the equations: the SI unit of the same dimension (`mm` → `m`, `deg` → `rad`).
    pub unit: String,
}

/// What a variable is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum VariableRole {
    /// A coordinate with an equation of its own.
    State,
    /// A signal that drives the machine.
    Input,
}

/// How the order of the library was chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Order {
    /// The order of the chosen terms.
    pub chosen: usize,
    /// Criterion of `by_order`; the smallest value is best.
    pub criterion: String,
    /// The criterion for each order searched, over all equations.
    pub by_order: Vec<OrderValue>,
}

/// The criterion at one order, in JSON a list of two numbers: `[3, -10786.0]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrderValue {
    /// Order of the library.
    pub order: usize,
    /// The criterion; NaN (`null`) where no model of that order could be fitted.
    pub value: f64,
}

impl Serialize for OrderValue {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (self.order, self.value.is_finite().then_some(self.value)).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for OrderValue {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let (order, value) = <(usize, Option<f64>)>::deserialize(deserializer)?;
        Ok(OrderValue { order, value: value.unwrap_or(f64::NAN) })
    }
}

impl JsonSchema for OrderValue {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "OrderValue".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": "An order of the library and the criterion there; null where nothing could be fitted.",
            "type": "array",
            "prefixItems": [{"type": "integer", "minimum": 1}, {"type": ["number", "null"]}],
            "minItems": 2,
            "maxItems": 2,
        })
    }
}

/// A delayed feedback of the state q: gain · q(t − value) is added to the first input, so that it stands on the
/// left side of every equation as the term `delay(q, tau)` with the value −gain (thesis Eq 3.3).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Delay {
    /// The delay.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub value: f64,
    /// 95 % confidence interval of the delay.
    pub ci95: Option<Interval>,
    /// Unit of delay, interval and bound: `s`.
    pub unit: String,
    /// Cramér–Rao bound of the standard deviation of the delay at the noise found: no unbiased method can
    /// do better on these recordings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<f64>,
    /// Gain of the feedback.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub gain: f64,
    /// 95 % confidence interval of the gain; `null` where the gain was given.
    pub gain_ci95: Option<Interval>,
    /// Unit of the gain as text; absent where the recordings state no units.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain_unit: Option<String>,
    /// Correlation of the two estimates, −1 to 1, where both were estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub correlation: Option<f64>,
    /// What to beware of, in plain language: delay and gain that these recordings cannot separate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warning: Option<String>,
}

/// The dead time τ of an input u: every equation that u enters has u(t − τ), in the model language
/// `delay(u, parameter)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DeadTime {
    /// Name of τ in `model.toml`.
    pub parameter: String,
    /// τ.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub value: f64,
    /// 95 % confidence interval of τ, which does not go below zero; `null` where τ ended on the longest looked for.
    pub ci95: Option<Interval>,
    /// Unit of τ, interval, bound and longest: `s`.
    pub unit: String,
    /// Cramér–Rao bound of the standard deviation of τ at the noise found: no unbiased method can do better on these
    /// recordings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<f64>,
    /// Longest τ looked for.
    #[serde(with = "number")]
    #[schemars(schema_with = "number_schema")]
    pub longest: f64,
    /// What to beware of, in plain language: a dead time that these recordings do not tell from none, or that ended on
    /// the longest looked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warning: Option<String>,
}

impl IdentifyReport {
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
    /// where it is of a later version than [`SCHEMA`](crate::contract::SCHEMA).
    pub fn from_json(text: &str) -> Result<Self, ReportError> {
        let report: Self = serde_json::from_str(text)?;
        report.greybox.check()?;
        Ok(report)
    }
}

/// JSON schema (draft 2020-12) of an identification's `report.json`, generated from the types of this module.
pub fn schema() -> serde_json::Value {
    schema_of::<IdentifyReport>()
}
