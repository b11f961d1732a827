//! The mechanisms that diagnosis can name: one file each, written in the model language.
//!
//! ```toml
//! kind   = "presliding_friction"
//! family = "friction"
//! on     = "motion"              # motion | equation | input | measurement | parameter | spring | …
//! force  = "s0*z"                # `replace = "…"` for an input (u), measurement (y), parameter (p), spring (k*d)
//! linear = ["s0"]                # enter linearly: the score test gives their first values
//! positive = ["s0", "fc"]        # physically positive
//! [states.z]                     # memory: a state with an equation of its own
//! equation = "z' = d' - s0/fc*abs(d')*z"
//! unit     = "d'*t"              # has the unit of this expression
//! [inner]                        # the others: a grid of first values, later refined
//! zc = { grid = [0.01, 0.1], scale = "range(d)" }
//! [first]                        # parameters of the law that the score test reaches through others
//! fc = "s0*zc"
//! [location]                     # where the law acts, if it has a threshold
//! variable = "d'"
//! low = "-2*vs"
//! high = "2*vs"
//! [report]                       # further figures that users expect
//! breakaway = "fc/s0"
//! [about]
//! signature = "…"
//! confused_with = ["…"]
//! separate = "…"
//! ```
//!
//! What a law acts on decides which placeholders it may use:
//!
//! | `on` | acts on | placeholders |
//! |---|---|---|
//! | `motion` | a coordinate or a difference of coordinates d | `d`, `d'`, `d''` |
//! | `load` | a motion and the torque that its joint transmits | `d`, `d'`, `load` |
//! | `pair` | the equation of a motion d, from another coordinate o; `reaction` acts on o's equation | `d`, `o` and primes |
//! | `spring` | the term k·d of an existing spring, which `replace` stands in for | `k`, `d` |
//! | `feedback` | the same, also of a damper or of a gain on a difference from a reference | `k`, `d` |
//! | `equation` | an equation as a whole | – |
//! | `input`, `measurement`, `parameter` | the symbol, which `replace` stands in for | `u`; `y`; `p` |
//!
//! `t` and `pi` are known everywhere. A name listed under `linear` or `[inner]` that the law does not use
//! is a *shape*: it serves the score test, and `[first]` turns it into the law's own parameters (`angle(y,
//! x)` is the angle of the vector (x, y)). The law must be linear in the `linear` names, through `[first]`
//! if need be.

use greybox_model::{Expr, parse};
use serde::Deserialize;

/// What a mechanism acts on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum On {
    /// A motion d: a coordinate or a difference of coordinates; `force` enters as F(d, d').
    Motion,
    /// An equation as a whole; `force` does not depend on a motion.
    Equation,
    /// An input u, which `replace` stands in for.
    Input,
    /// A measurement y, which `replace` stands in for.
    Measurement,
    /// A parameter p of the nominal model, which `replace` stands in for.
    Parameter,
    /// The term k·d of an existing spring, which `replace` stands in for.
    Spring,
    /// The same, also where a parameter multiplies a rate or compares d with a reference: a feedback.
    Feedback,
    /// The equation of a motion d, driven by another coordinate o.
    Pair,
    /// A motion together with the force that its joint transmits.
    Load,
}

impl On {
    /// Names a law may use besides its parameters and states.
    fn placeholders(self) -> &'static [&'static str] {
        match self {
            On::Motion => &["d", "t", "pi"],
            On::Equation => &["t", "pi"],
            On::Input => &["u", "t", "pi"],
            On::Measurement => &["y", "t", "pi"],
            On::Parameter => &["p", "t", "pi"],
            On::Spring | On::Feedback => &["k", "d", "t", "pi"],
            On::Pair => &["d", "o", "t", "pi"],
            On::Load => &["d", "load", "t", "pi"],
        }
    }

    /// Whether its law stands in for something (else it is a force that is added).
    pub fn replaces(self) -> bool {
        matches!(self, On::Input | On::Measurement | On::Parameter | On::Spring | On::Feedback)
    }
}

/// A parameter that does not enter linearly.
#[derive(Debug, Clone, PartialEq)]
pub struct Inner {
    /// Its name.
    pub name: String,
    /// First values, in units of the scale.
    pub grid: Vec<f64>,
    /// The scale.
    pub scale: Scale,
    /// Smallest admissible value, in units of the scale.
    pub low: f64,
    /// Largest admissible value, in units of the scale.
    pub high: f64,
    /// The parameter is an angular frequency over this variable: first values come from the spectrum of
    /// what is left over, besides the grid.
    pub spectral: Option<Expr>,
}

/// A state of a mechanism's own.
#[derive(Debug, Clone, PartialEq)]
pub struct Memory {
    /// Its name.
    pub name: String,
    /// Left side of its equation.
    pub lhs: Expr,
    /// Right side.
    pub rhs: Expr,
    /// An expression of its unit.
    pub unit: Expr,
    /// What it and its derivatives are likely to be when a recording starts (zero where not said).
    pub start: Vec<Expr>,
}

/// First value of a parameter, from those of the score test.
#[derive(Debug, Clone, PartialEq)]
pub enum First {
    /// An expression.
    Value(Expr),
    /// The angle of the vector (x, y): `angle(y, x)`.
    Angle(Expr, Expr),
}

impl First {
    fn eval(&self, value: &dyn Fn(&str) -> Option<f64>) -> Option<f64> {
        let of = |e: &Expr| e.eval(&|n, _| value(n));
        match self {
            First::Value(e) => of(e),
            First::Angle(y, x) => Some(of(y)?.atan2(of(x)?)),
        }
    }
}

/// A size read off the data.
#[derive(Debug, Clone, PartialEq)]
pub enum Scale {
    /// One.
    One,
    /// The sample interval.
    Step,
    /// Root mean square of an expression.
    Rms(Expr),
    /// Largest absolute value.
    Max(Expr),
    /// Largest value (one-sided).
    Top(Expr),
    /// Largest minus smallest value.
    Range(Expr),
    /// One over the range.
    PerRange(Expr),
    /// Angular frequency: root mean square of the time derivative over that of the expression.
    Frequency(Expr),
    /// Length of the longest recording, s.
    Duration,
    /// One over the duration.
    PerDuration,
}

/// Where a law with a threshold acts: `low ≤ variable ≤ high`, open where not given.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Expression in d, d', u.
    pub variable: Expr,
    /// Lower end, an expression in the parameters.
    pub low: Option<Expr>,
    /// Upper end.
    pub high: Option<Expr>,
}

/// Prose for the report.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
pub struct About {
    /// What it looks like in data.
    pub signature: String,
    /// Kinds it is taken for.
    #[serde(default)]
    pub confused_with: Vec<String>,
    /// The recording that would separate them.
    pub separate: String,
}

/// One mechanism.
#[derive(Debug, Clone, PartialEq)]
pub struct Mechanism {
    /// Name of the kind.
    pub kind: String,
    /// Family of kinds.
    pub family: String,
    /// What it acts on.
    pub on: On,
    /// The force, or the replacement.
    pub law: Expr,
    /// On a pair: the force on the other coordinate's equation.
    pub reaction: Option<Expr>,
    /// States of its own.
    pub states: Vec<Memory>,
    /// Parameters that enter linearly.
    pub linear: Vec<String>,
    /// Parameters that are physically positive.
    pub positive: Vec<String>,
    /// The other parameters.
    pub inner: Vec<Inner>,
    /// Parameters of the law that the score test reaches through others.
    pub first: Vec<(String, First)>,
    /// Further figures for the report, expressions in the parameters.
    pub report: Vec<(String, Expr)>,
    /// Names of the law's own parameters: as they stand in an improved model.
    own: Vec<String>,
    /// Rank among equals: the lower is named, the others are its equivalents.
    pub rank: u8,
    /// The law acts rarely: judged by what it gains where it acts.
    pub rare: bool,
    /// Whether the mirror image (d → −d) is another candidate.
    pub mirror: bool,
    /// Kinds of which this one is a refinement: at the same place it replaces them.
    pub refines: Vec<String>,
    /// Expressions in the parameters that must not be negative (fs − fc of Stribeck friction).
    pub require: Vec<Expr>,
    /// Extra complexity beyond the number of parameters.
    pub surcharge: f64,
    /// Where it acts, for laws with a threshold.
    pub region: Option<Region>,
    /// The sum of other mechanisms at the same place that it equals exactly: (kind, parameter,
    /// expression in this mechanism's parameters). Where all of them are candidates, it is reported as
    /// that sum, with itself as an equivalent alternative.
    pub equals: Vec<(String, String, Expr)>,
    /// Prose.
    pub about: About,
}

/// A mechanism file that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{file}: {message}")]
pub struct MechanismError {
    /// Name of the file.
    pub file: String,
    /// What is wrong and the mend.
    pub message: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    kind: String,
    family: String,
    on: On,
    force: Option<String>,
    reaction: Option<String>,
    replace: Option<String>,
    #[serde(default)]
    states: toml::map::Map<String, toml::Value>,
    #[serde(default)]
    first: toml::map::Map<String, toml::Value>,
    #[serde(default)]
    report: toml::map::Map<String, toml::Value>,
    #[serde(default)]
    rank: Option<u8>,
    #[serde(default)]
    rare: bool,
    #[serde(default)]
    linear: Vec<String>,
    #[serde(default)]
    positive: Vec<String>,
    #[serde(default)]
    mirror: bool,
    #[serde(default)]
    refines: Vec<String>,
    #[serde(default)]
    require: Vec<String>,
    #[serde(default)]
    surcharge: f64,
    #[serde(default)]
    inner: toml::map::Map<String, toml::Value>,
    location: Option<LocationFile>,
    #[serde(default)]
    equals: toml::map::Map<String, toml::Value>,
    #[serde(default)]
    about: About,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LocationFile {
    variable: String,
    low: Option<String>,
    high: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StateFile {
    equation: String,
    unit: String,
    #[serde(default)]
    start: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct InnerFile {
    #[serde(default)]
    grid: Vec<f64>,
    spectral: Option<String>,
    #[serde(default)]
    scale: Option<String>,
    low: Option<f64>,
    high: Option<f64>,
}

impl Mechanism {
    /// Reads a mechanism file.
    ///
    /// # Errors
    /// [`MechanismError`] names the file and what is wrong with it.
    pub fn from_toml(text: &str, file: &str) -> Result<Mechanism, MechanismError> {
        let fail = |message: String| MechanismError { file: file.to_string(), message };
        let raw: File = toml::from_str(text).map_err(|e| fail(e.to_string()))?;
        let expression = |text: &str, key: &str| {
            parse(text).map(|p| p.expr).map_err(|e| fail(format!("`{key} = \"{text}\"`: {e}")))
        };
        let law = match (&raw.force, &raw.replace) {
            (Some(force), None) if !raw.on.replaces() => expression(force, "force")?,
            (None, Some(replace)) if raw.on.replaces() => expression(replace, "replace")?,
            _ => {
                return Err(fail(
                    "a mechanism on a motion, a load, a pair or an equation has `force`, one on an input, a measurement, a parameter or a spring has `replace`, and none has both".into(),
                ));
            }
        };
        if raw.reaction.is_some() && raw.on != On::Pair {
            return Err(fail("only a mechanism on a pair has a `reaction`".into()));
        }
        let reaction = raw.reaction.as_deref().map(|t| expression(t, "reaction")).transpose()?;
        let mut states = Vec::new();
        for (name, value) in raw.states {
            let entry: StateFile = value
                .try_into()
                .map_err(|e: toml::de::Error| fail(format!("[states.{name}]: {}", e.message())))?;
            let equation = greybox_model::parse_equation(&entry.equation)
                .map_err(|e| fail(format!("[states.{name}] `equation = \"{}\"`: {e}", entry.equation)))?;
            if !(equation.lhs.expr.mentions(&name) || equation.rhs.expr.mentions(&name)) {
                return Err(fail(format!("[states.{name}]: its equation does not mention `{name}`")));
            }
            states.push(Memory {
                unit: expression(&entry.unit, "unit")?,
                start: entry.start.iter().map(|t| expression(t, "start")).collect::<Result<_, _>>()?,
                name,
                lhs: equation.lhs.expr,
                rhs: equation.rhs.expr,
            });
        }
        let mut inner = Vec::new();
        for (name, value) in raw.inner {
            let entry: InnerFile = value
                .try_into()
                .map_err(|e: toml::de::Error| fail(format!("[inner] {name}: {}", e.message())))?;
            let spectral = entry.spectral.as_deref().map(|t| expression(t, "spectral")).transpose()?;
            if (entry.grid.is_empty() && spectral.is_none()) || !entry.grid.iter().all(|v| v.is_finite()) {
                return Err(fail(format!("[inner] {name}: `grid` must list finite first values")));
            }
            let scale = match entry.scale.as_deref() {
                None | Some("1") => Scale::One,
                Some("dt") => Scale::Step,
                Some("duration") => Scale::Duration,
                Some("1/duration") => Scale::PerDuration,
                Some(text) => {
                    let (f, rest) = text.split_once('(').ok_or_else(|| {
                        fail(format!(
                            "[inner] {name}: scale `{text}` is none of `1`, `dt`, `duration`, `1/duration`, `rms(…)`, `max(…)`, `top(…)`, `range(…)`, `1/range(…)`, `freq(…)`"
                        ))
                    })?;
                    let of = expression(rest.trim_end().strip_suffix(')').unwrap_or(rest), "scale")?;
                    match f.trim() {
                        "rms" => Scale::Rms(of),
                        "max" => Scale::Max(of),
                        "top" => Scale::Top(of),
                        "range" => Scale::Range(of),
                        "1/range" => Scale::PerRange(of),
                        "freq" => Scale::Frequency(of),
                        other => {
                            return Err(fail(format!(
                                "[inner] {name}: unknown scale function `{other}`; use rms, max, top, range, 1/range or freq"
                            )));
                        }
                    }
                }
            };
            let (low, high) = (entry.low.unwrap_or(1e-3), entry.high.unwrap_or(1e3));
            if low >= high
                || low.is_nan()
                || high.is_nan()
                || entry.grid.iter().any(|g| *g < low || *g > high)
            {
                return Err(fail(format!("[inner] {name}: `low` and `high` must enclose the grid")));
            }
            inner.push(Inner { name, grid: entry.grid, scale, low, high, spectral });
        }
        let region = match raw.location {
            None => None,
            Some(l) => Some(Region {
                variable: expression(&l.variable, "variable")?,
                low: l.low.as_deref().map(|t| expression(t, "low")).transpose()?,
                high: l.high.as_deref().map(|t| expression(t, "high")).transpose()?,
            }),
        };
        let mut equals = Vec::new();
        for (kind, value) in raw.equals {
            let table: std::collections::BTreeMap<String, String> = value
                .try_into()
                .map_err(|e: toml::de::Error| fail(format!("[equals] {kind}: {}", e.message())))?;
            for (parameter, text) in table {
                equals.push((kind.clone(), parameter, expression(&text, "equals")?));
            }
        }
        let mut first = Vec::new();
        for (name, value) in raw.first {
            let Some(text) = value.as_str() else {
                return Err(fail(format!("[first] {name}: write the formula as a string")));
            };
            first.push((name, first_value(text, &expression)?));
        }
        let mut report = Vec::new();
        for (name, value) in raw.report {
            let Some(text) = value.as_str() else {
                return Err(fail(format!("[report] {name}: write the formula as a string")));
            };
            report.push((name, expression(text, "report")?));
        }
        let mut mechanism = Mechanism {
            kind: raw.kind,
            family: raw.family,
            on: raw.on,
            law,
            reaction,
            states,
            linear: raw.linear,
            positive: raw.positive,
            inner,
            first,
            report,
            own: Vec::new(),
            rank: raw.rank.unwrap_or(if raw.on == On::Measurement { 2 } else { u8::from(raw.on == On::Input) }),
            rare: raw.rare,
            mirror: raw.mirror,
            refines: raw.refines,
            require: raw.require.iter().map(|t| expression(t, "require")).collect::<Result<_, _>>()?,
            surcharge: raw.surcharge,
            region,
            equals,
            about: raw.about,
        };
        mechanism.own = mechanism.named().filter(|n| mechanism.uses(n)).map(str::to_string).collect();
        mechanism.check().map_err(fail)?;
        Ok(mechanism)
    }

    /// Every name given to a parameter or a shape.
    fn named(&self) -> impl Iterator<Item = &str> {
        self.linear
            .iter()
            .map(String::as_str)
            .chain(self.inner.iter().map(|i| i.name.as_str()))
            .chain(self.first.iter().map(|f| f.0.as_str()))
    }

    /// The law with everything that belongs to it.
    fn expressions(&self) -> impl Iterator<Item = &Expr> {
        std::iter::once(&self.law)
            .chain(&self.reaction)
            .chain(self.states.iter().flat_map(|s| [&s.lhs, &s.rhs]))
    }

    fn uses(&self, name: &str) -> bool {
        self.expressions().any(|e| e.mentions(name))
    }

    /// Whether the law depends on the placeholder with this many primes.
    pub fn depends_on(&self, placeholder: &str, primes: u8) -> bool {
        self.expressions().any(|e| e.contains(placeholder, primes))
    }

    /// What a file may not say.
    fn check(&self) -> Result<(), String> {
        let placeholders = self.on.placeholders();
        let state = |n: &str| self.states.iter().any(|s| s.name == n);
        let mut seen: Vec<&str> = Vec::new();
        for name in self.named().chain(self.states.iter().map(|s| s.name.as_str())) {
            if placeholders.contains(&name) {
                return Err(format!("`{name}` already means something in a law; give the parameter another name"));
            }
            if seen.contains(&name) {
                return Err(format!("`{name}` is listed twice among `linear`, `[inner]`, `[first]` and `[states]`"));
            }
            seen.push(name);
        }
        for e in self.expressions() {
            let unknown = e.variables().into_iter().find(|(n, _)| !placeholders.contains(&&**n) && !seen.contains(&&**n));
            if let Some((name, _)) = unknown {
                return Err(format!(
                    "the law uses `{name}`, which is neither a parameter (list it under `linear`, `[inner]` or `[first]`) nor one of {}",
                    placeholders.join(", ")
                ));
            }
        }
        for (key, names) in [("positive", &self.positive), ("linear", &self.linear)] {
            for name in names {
                let known = self.named().any(|n| n == name);
                if !known || state(name) {
                    return Err(format!("`{key}` names `{name}`, which is no parameter of this mechanism"));
                }
            }
        }
        for (name, first) in &self.first {
            let sources = match first {
                First::Value(e) => e.variables(),
                First::Angle(y, x) => [y.variables(), x.variables()].concat(),
            };
            let source = |n: &str| self.linear.iter().any(|l| l == n) || self.inner.iter().any(|i| i.name == n) || n == "pi";
            if let Some((n, _)) = sources.iter().find(|(n, _)| !source(n)) {
                return Err(format!("[first] {name}: `{n}` is neither under `linear` nor under `[inner]`"));
            }
            if !self.uses(name) {
                return Err(format!("[first] {name}: the law does not use `{name}`"));
            }
        }
        for (name, e) in &self.report {
            if let Some((n, _)) = e.variables().iter().find(|(n, _)| &**n != "pi" && !self.own.iter().any(|p| **p == **n)) {
                return Err(format!("[report] {name}: `{n}` is no parameter of the law"));
            }
        }
        if self.first.is_empty() {
            for name in &self.linear {
                if self.law.derivative(name, 0).mentions(name) {
                    return Err(format!("`{name}` is listed as linear, but the law is not linear in it"));
                }
                if self.states.iter().any(|s| s.lhs.mentions(name) || s.rhs.mentions(name)) {
                    return Err(format!(
                        "`{name}` is listed as linear, but a state's equation depends on it; reach it through `[first]`"
                    ));
                }
            }
        }
        Ok(())
    }

    /// The law's own parameters at values of the score test (linear ones, inner ones).
    pub fn values(&self, linear: &[f64], inner: &[f64]) -> Option<Vec<f64>> {
        let given = |n: &str| {
            if n == "pi" {
                return Some(std::f64::consts::PI);
            }
            if let Some(i) = self.linear.iter().position(|l| l == n) {
                return linear.get(i).copied();
            }
            self.inner.iter().position(|i| i.name == n).and_then(|i| inner.get(i).copied())
        };
        self.own
            .iter()
            .map(|n| match self.first.iter().find(|f| f.0 == *n) {
                Some((_, first)) => first.eval(&given),
                None => given(n),
            })
            .collect()
    }

    /// Number of parameters plus the surcharge.
    pub fn complexity(&self) -> f64 {
        self.own.len() as f64 + self.surcharge
    }

    /// Names of the law's own parameters.
    pub fn parameters(&self) -> impl Iterator<Item = &str> {
        self.own.iter().map(String::as_str)
    }

    /// The inner parameter of this name.
    pub fn inner(&self, name: &str) -> Option<(usize, &Inner)> {
        self.inner.iter().enumerate().find(|i| i.1.name == name)
    }
}

fn first_value(
    text: &str,
    expression: &dyn Fn(&str, &str) -> Result<Expr, MechanismError>,
) -> Result<First, MechanismError> {
    let Some(inside) = text.trim().strip_prefix("angle(").and_then(|t| t.strip_suffix(')')) else {
        return Ok(First::Value(expression(text, "first")?));
    };
    // The comma between the two arguments: the first outside parentheses.
    let mut depth = 0;
    let comma = inside.char_indices().find(|(_, c)| {
        match c {
            '(' => depth += 1,
            ')' => depth -= 1,
            _ => {}
        }
        depth == 0 && *c == ','
    });
    match comma {
        Some((at, _)) => Ok(First::Angle(
            expression(&inside[..at], "first")?,
            expression(&inside[at + 1..], "first")?,
        )),
        None => expression(text, "first").map(First::Value),
    }
}

static BUILT_IN: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/mechanisms.rs"));

/// The built-in library, in the order of the file names.
///
/// # Errors
/// Only when a built-in file is wrong, which a test excludes.
pub fn built_in() -> Result<Vec<Mechanism>, MechanismError> {
    BUILT_IN.iter().map(|(file, text)| Mechanism::from_toml(text, file)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_library_reads_and_its_kinds_are_its_file_names() {
        let library = built_in().unwrap();
        assert!(library.len() >= 11);
        for (mechanism, (file, _)) in library.iter().zip(BUILT_IN) {
            assert!(file.starts_with(&mechanism.kind), "{file}: {}", mechanism.kind);
            assert!(!mechanism.about.signature.is_empty());
        }
    }

    #[test]
    fn wrong_files_are_refused_with_the_mend() {
        let base = "kind = \"k\"\nfamily = \"f\"\non = \"motion\"\n";
        let error =
            |rest: &str| Mechanism::from_toml(&format!("{base}{rest}"), "x.toml").unwrap_err().to_string();
        assert!(error("force = \"fc*sign(d')\"").contains("uses `fc`"));
        assert!(error("replace = \"d\"").contains("has `force`"));
        assert!(error("force = \"fc*sign(d'\"\nlinear = [\"fc\"]").contains("force"));
        assert!(error("force = \"fc^2*d\"\nlinear = [\"fc\"]").contains("not linear"));
        assert!(error("force = \"d\"\npositive = [\"q\"]").contains("no parameter"));
        assert!(error("force = \"d\"\ncolour = 1").contains("colour"));
        assert!(
            error("force = \"k*d/x\"\nlinear = [\"k\"]\n[inner]\nx = { grid = [1.0], scale = \"mean(d)\" }")
                .contains("unknown scale function `mean`")
        );
    }
}
