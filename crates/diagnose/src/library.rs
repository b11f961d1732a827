//! The mechanisms that diagnosis can name: one file each, written in the model language.
//!
//! ```toml
//! kind   = "coulomb_friction"
//! family = "friction"
//! on     = "motion"              # motion | equation | input | measurement
//! force  = "fc*sign(d')"         # `replace = "…"` for input (u) and measurement (y)
//! linear = ["fc"]                # enter linearly: the score test gives their first values
//! positive = ["fc"]              # physically positive
//! [inner]                        # the others: a grid of first values, later refined
//! vs = { grid = [0.03, 0.1], scale = "rms(d')" }
//! [location]                     # where the law acts, if it has a threshold
//! variable = "d'"
//! low = "-2*vs"
//! high = "2*vs"
//! [about]
//! signature = "…"
//! confused_with = ["…"]
//! separate = "…"
//! ```

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
    /// Parameters that enter linearly.
    pub linear: Vec<String>,
    /// Parameters that are physically positive.
    pub positive: Vec<String>,
    /// The other parameters.
    pub inner: Vec<Inner>,
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
    replace: Option<String>,
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
struct InnerFile {
    grid: Vec<f64>,
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
        let law = match (&raw.force, &raw.replace, raw.on) {
            (Some(force), None, On::Motion | On::Equation) => expression(force, "force")?,
            (None, Some(replace), On::Input | On::Measurement) => expression(replace, "replace")?,
            _ => {
                return Err(fail(
                    "a mechanism on a motion or an equation has `force`, one on an input or a measurement has `replace`, and none has both".into(),
                ));
            }
        };
        let mut inner = Vec::new();
        for (name, value) in raw.inner {
            let entry: InnerFile = value
                .try_into()
                .map_err(|e: toml::de::Error| fail(format!("[inner] {name}: {}", e.message())))?;
            if entry.grid.is_empty() || !entry.grid.iter().all(|v| v.is_finite()) {
                return Err(fail(format!("[inner] {name}: `grid` must list finite first values")));
            }
            let scale = match entry.scale.as_deref() {
                None | Some("1") => Scale::One,
                Some("dt") => Scale::Step,
                Some(text) => {
                    let (f, rest) = text.split_once('(').ok_or_else(|| {
                        fail(format!(
                            "[inner] {name}: scale `{text}` is none of `1`, `dt`, `rms(…)`, `max(…)`, `top(…)`, `range(…)`"
                        ))
                    })?;
                    let of = expression(rest.trim_end().strip_suffix(')').unwrap_or(rest), "scale")?;
                    match f.trim() {
                        "rms" => Scale::Rms(of),
                        "max" => Scale::Max(of),
                        "top" => Scale::Top(of),
                        "range" => Scale::Range(of),
                        other => {
                            return Err(fail(format!(
                                "[inner] {name}: unknown scale function `{other}`; use rms, max, top or range"
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
            inner.push(Inner { name, grid: entry.grid, scale, low, high });
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
        // Every name in the law is a placeholder or a parameter.
        let placeholders: &[&str] = match raw.on {
            On::Motion => &["d", "t", "pi"],
            On::Equation => &["t", "pi"],
            On::Input => &["u", "t", "pi"],
            On::Measurement => &["y", "t", "pi"],
        };
        let known = |n: &str| {
            placeholders.contains(&n)
                || raw.linear.iter().any(|l| l == n)
                || inner.iter().any(|i| i.name == n)
        };
        let mut unknown = None;
        law.walk(&mut |e| {
            if let Expr::Var { name, .. } = e
                && !known(name)
            {
                unknown = Some(name.to_string());
            }
        });
        if let Some(name) = unknown {
            return Err(fail(format!(
                "the law uses `{name}`, which is neither a parameter (list it under `linear` or `[inner]`) nor one of {}",
                placeholders.join(", ")
            )));
        }
        for name in &raw.positive {
            if !raw.linear.contains(name) && !inner.iter().any(|i| &i.name == name) {
                return Err(fail(format!(
                    "`positive` names `{name}`, which is no parameter of this mechanism"
                )));
            }
        }
        for name in &raw.linear {
            if law.derivative(name, 0).mentions(name) {
                return Err(fail(format!("`{name}` is listed as linear, but the law is not linear in it")));
            }
        }
        Ok(Mechanism {
            kind: raw.kind,
            family: raw.family,
            on: raw.on,
            law,
            linear: raw.linear,
            positive: raw.positive,
            inner,
            mirror: raw.mirror,
            refines: raw.refines,
            require: raw.require.iter().map(|t| expression(t, "require")).collect::<Result<_, _>>()?,
            surcharge: raw.surcharge,
            region,
            equals,
            about: raw.about,
        })
    }

    /// Number of parameters plus the surcharge.
    pub fn complexity(&self) -> f64 {
        (self.linear.len() + self.inner.len()) as f64 + self.surcharge
    }

    /// Names of the parameters, linear ones first.
    pub fn parameters(&self) -> impl Iterator<Item = &str> {
        self.linear.iter().map(String::as_str).chain(self.inner.iter().map(|i| i.name.as_str()))
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
            assert_eq!(format!("{}.toml", mechanism.kind), *file);
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
