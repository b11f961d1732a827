//! Mechanism files: TOML to a [`Mechanism`], with the line of every fault.

use std::collections::BTreeMap;

use greybox_model::{Expr, parse};
use serde::Deserialize;

use super::{
    About, Domain, Excitation, First, Inner, Mechanism, MechanismError, Memory, On, Region, Scale, Shape,
};

/// A fault: the key it is at (the section, the key in it), and what is wrong with the fix.
pub(super) struct Fault {
    pub(super) section: String,
    pub(super) key: String,
    pub(super) message: String,
}

impl Fault {
    pub(super) fn new(section: &str, key: &str, message: impl Into<String>) -> Fault {
        Fault { section: section.to_string(), key: key.to_string(), message: message.into() }
    }
}

/// The line of `key` in `[section]` of a TOML text (the empty section stands before the first header), else
/// that of the section's header, counted from 1. A key without a section of its own is looked for as
/// `section = { … }` too.
pub(super) fn line_of(text: &str, section: &str, key: &str) -> Option<usize> {
    let (mut current, mut header) = (String::new(), None);
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.trim();
        if let Some(name) = line.strip_prefix('[').and_then(|l| l.split(']').next()) {
            current = name.trim().to_string();
            if current == section {
                header = Some(number);
            }
        } else if let Some((name, _)) = line.split_once('=') {
            let name = name.trim().trim_matches('"');
            if current == section && name == key {
                return Some(number);
            }
            if format!("{current}.{name}").trim_start_matches('.') == section {
                header = Some(number);
            }
        }
    }
    header
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    kind: String,
    family: String,
    domain: Option<Domain>,
    on: On,
    #[serde(default = "yes")]
    named: bool,
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
    steady: bool,
    #[serde(default)]
    absolute: bool,
    #[serde(default)]
    reversals: usize,
    #[serde(default)]
    linear: Vec<String>,
    #[serde(default)]
    positive: Vec<String>,
    #[serde(default)]
    mirror: bool,
    #[serde(default)]
    refines: Vec<String>,
    #[serde(default)]
    doubts: Vec<String>,
    #[serde(default)]
    require: Vec<String>,
    #[serde(default)]
    surcharge: f64,
    #[serde(default)]
    inner: toml::map::Map<String, toml::Value>,
    shape: Option<ShapeFile>,
    location: Option<LocationFile>,
    experiment: Option<ExperimentFile>,
    #[serde(default)]
    equals: toml::map::Map<String, toml::Value>,
    #[serde(default)]
    special_case: toml::map::Map<String, toml::Value>,
    #[serde(default)]
    about: About,
}

fn yes() -> bool {
    true
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ShapeFile {
    of: String,
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
struct ExperimentFile {
    drive: Drive,
    at: Option<String>,
}

#[derive(Deserialize, Clone, Copy)]
#[serde(rename_all = "snake_case")]
enum Drive {
    Slow,
    Wide,
    Loud,
    Silent,
    Again,
    Around,
    Ramp,
    Beyond,
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
    carrier: Option<String>,
    #[serde(default)]
    scale: Option<String>,
    low: Option<f64>,
    high: Option<f64>,
}

impl Mechanism {
    /// Reads a mechanism file.
    ///
    /// # Errors
    /// [`MechanismError`] names the file, the line, and what is wrong with the fix. What depends on other
    /// files (`refines`, `doubts`, `[equals]`, `[special_case]`) is checked by [`combine`](super::combine).
    pub fn from_toml(text: &str, file: &str) -> Result<Mechanism, MechanismError> {
        let raw: File = toml::from_str(text).map_err(|e| MechanismError {
            file: file.to_string(),
            line: e.span().map(|span| 1 + text[..span.start].matches('\n').count()),
            message: e.message().to_string(),
        })?;
        Mechanism::from_file(raw).map_err(|fault| MechanismError {
            file: file.to_string(),
            line: line_of(text, &fault.section, &fault.key),
            message: fault.message,
        })
    }

    fn from_file(raw: File) -> Result<Mechanism, Fault> {
        let law = match (&raw.force, &raw.replace) {
            (Some(force), None) if !raw.on.replaces() => expression(force, "", "force")?,
            (None, Some(replace)) if raw.on.replaces() => expression(replace, "", "replace")?,
            (force, _) => {
                let key = if force.is_some() { "force" } else { "replace" };
                return Err(Fault::new(
                    "",
                    key,
                    "a mechanism on a motion, a load, a pair or an equation has `force`, one on an input, a measurement, a parameter, a spring or a feedback has `replace`, and none has both",
                ));
            }
        };
        if raw.reaction.is_some() && raw.on != On::Pair {
            return Err(Fault::new("", "reaction", "only a mechanism on a pair has a `reaction`; remove it"));
        }
        if !(raw.surcharge.is_finite() && raw.surcharge >= 0.0) {
            return Err(Fault::new("", "surcharge", "`surcharge` must be zero or positive"));
        }
        let formula = |section: &str, name: &str, value: &toml::Value| match value.as_str() {
            Some(text) => Ok(text.to_string()),
            None => {
                Err(Fault::new(section, name, format!("[{section}] {name}: write the formula as a string")))
            }
        };
        let mut first = Vec::new();
        for (name, value) in raw.first {
            let value = first_value(&formula("first", &name, &value)?, &name)?;
            first.push((name, value));
        }
        let mut report = Vec::new();
        for (name, value) in raw.report {
            let value = expression(&formula("report", &name, &value)?, "report", &name)?;
            report.push((name, value));
        }
        let mut inner: Vec<Inner> =
            raw.inner.into_iter().map(|(name, value)| inner(name, value)).collect::<Result<_, _>>()?;
        let (mut law, mut linear) = (law, raw.linear);
        let mut shape = None;
        if let Some(of) = raw.shape {
            let of = expression(&of.of, "shape", "of")?;
            if raw.named || !linear.is_empty() || !inner.is_empty() || !law.mentions("shape") {
                return Err(Fault::new(
                    "shape",
                    "of",
                    "a law of free shape has `named = false`, writes `shape` where the function stands, and has no parameters of its own",
                ));
            }
            linear = Shape::changes();
            inner = [Scale::Rms(of.clone()), Scale::One]
                .into_iter()
                .zip(Shape::SIZES)
                .map(|(scale, name)| Inner::fixed(name, scale))
                .collect();
            let free = Shape { of, law };
            law = free.expanded();
            shape = Some(free);
        }
        let mut mechanism = Mechanism {
            kind: raw.kind,
            family: raw.family,
            domain: raw.domain,
            on: raw.on,
            named: raw.named,
            law,
            reaction: raw.reaction.as_deref().map(|t| expression(t, "", "reaction")).transpose()?,
            states: raw
                .states
                .into_iter()
                .map(|(name, value)| memory(name, value))
                .collect::<Result<_, _>>()?,
            linear,
            positive: raw.positive,
            inner,
            shape,
            first,
            report,
            own: Vec::new(),
            rank: raw.rank.unwrap_or(if raw.on == On::Measurement || !raw.named {
                2
            } else {
                u8::from(raw.on == On::Input)
            }),
            rare: raw.rare,
            steady: raw.steady,
            absolute: raw.absolute,
            reversals: raw.reversals,
            mirror: raw.mirror,
            refines: raw.refines,
            doubts: raw.doubts,
            require: raw.require.iter().map(|t| expression(t, "", "require")).collect::<Result<_, _>>()?,
            surcharge: raw.surcharge,
            region: raw.location.map(region).transpose()?,
            equals: of_others("equals", raw.equals)?,
            special_case: of_others("special_case", raw.special_case)?,
            excitation: raw.experiment.map(excitation).transpose()?,
            about: raw.about,
        };
        mechanism.own = mechanism.names().filter(|n| mechanism.uses(n)).map(str::to_string).collect();
        mechanism.check_names()?;
        mechanism.check_parameters()?;
        mechanism.check_data()?;
        mechanism.check_excitation()?;
        mechanism.check_linear()?;
        if !mechanism.named && !mechanism.is_term() {
            return Err(Fault::new(
                "",
                "named",
                "a law without a name is a force, or a change of an input or a measurement, that vanishes with its strengths under `linear`, without `reaction`, `doubts`, `[equals]` and the time `t`",
            ));
        }
        Ok(mechanism)
    }
}

/// A section that gives values to the parameters of other kinds: (kind, parameter, value).
fn of_others(
    section: &str,
    raw: toml::map::Map<String, toml::Value>,
) -> Result<Vec<(String, String, Expr)>, Fault> {
    let mut all = Vec::new();
    for (kind, value) in raw {
        let table: BTreeMap<String, String> = value.try_into().map_err(|e: toml::de::Error| {
            Fault::new(section, &kind, format!("[{section}] {kind}: {}", e.message()))
        })?;
        for (parameter, text) in table {
            all.push((kind.clone(), parameter, expression(&text, section, &kind)?));
        }
    }
    Ok(all)
}

fn expression(text: &str, section: &str, key: &str) -> Result<Expr, Fault> {
    parse(text).map(|p| p.expr).map_err(|e| Fault::new(section, key, format!("`{key} = \"{text}\"`: {e}")))
}

fn memory(name: String, value: toml::Value) -> Result<Memory, Fault> {
    let section = format!("states.{name}");
    let entry: StateFile = value
        .try_into()
        .map_err(|e: toml::de::Error| Fault::new(&section, "", format!("[{section}]: {}", e.message())))?;
    let equation = greybox_model::parse_equation(&entry.equation).map_err(|e| {
        Fault::new(&section, "equation", format!("[{section}] `equation = \"{}\"`: {e}", entry.equation))
    })?;
    if !(equation.lhs.expr.mentions(&name) || equation.rhs.expr.mentions(&name)) {
        return Err(Fault::new(
            &section,
            "equation",
            format!("[{section}]: its equation does not mention `{name}`"),
        ));
    }
    Ok(Memory {
        unit: expression(&entry.unit, &section, "unit")?,
        start: entry.start.iter().map(|t| expression(t, &section, "start")).collect::<Result<_, _>>()?,
        name,
        lhs: equation.lhs.expr,
        rhs: equation.rhs.expr,
    })
}

fn inner(name: String, value: toml::Value) -> Result<Inner, Fault> {
    let fault = |message: String| Fault::new("inner", &name, format!("[inner] {name}: {message}"));
    let entry: InnerFile = value.try_into().map_err(|e: toml::de::Error| fault(e.message().to_string()))?;
    let of = |text: &Option<String>| text.as_deref().map(|t| expression(t, "inner", &name)).transpose();
    let (spectral, carrier) = (of(&entry.spectral)?, of(&entry.carrier)?);
    if carrier.is_some() && spectral.is_none() {
        return Err(fault("`carrier` is what a law with a `spectral` variable is multiplied by".into()));
    }
    if (entry.grid.is_empty() && spectral.is_none()) || !entry.grid.iter().all(|v| v.is_finite()) {
        return Err(fault("`grid` must list finite first values, such as [0.1, 0.3]".into()));
    }
    let scale = match entry.scale.as_deref() {
        None => Scale::One,
        Some(text) => scale(text, &name)?,
    };
    let (low, high) = (entry.low.unwrap_or(1e-3), entry.high.unwrap_or(1e3));
    let enclosed = low < high && entry.grid.iter().all(|g| (low..=high).contains(g));
    if !enclosed {
        return Err(fault(format!("`low` ({low}) and `high` ({high}) must enclose the grid")));
    }
    Ok(Inner { name, grid: entry.grid, scale, low, high, spectral, carrier, fixed: false })
}

fn scale(text: &str, name: &str) -> Result<Scale, Fault> {
    let fault = |message: String| Err(Fault::new("inner", name, format!("[inner] {name}: {message}")));
    let (function, rest) = match (text, text.split_once('(')) {
        ("1", _) => return Ok(Scale::One),
        ("dt", _) => return Ok(Scale::Step),
        ("duration", _) => return Ok(Scale::Duration),
        ("1/duration", _) => return Ok(Scale::PerDuration),
        (_, Some(parts)) => parts,
        (_, None) => {
            return fault(format!(
                "scale `{text}` is none of `1`, `dt`, `duration`, `1/duration`, `rms(…)`, `max(…)`, `top(…)`, `range(…)`, `1/range(…)`, `freq(…)`"
            ));
        }
    };
    let of = expression(rest.trim_end().strip_suffix(')').unwrap_or(rest), "inner", name)?;
    match function.trim() {
        "rms" => Ok(Scale::Rms(of)),
        "max" => Ok(Scale::Max(of)),
        "top" => Ok(Scale::Top(of)),
        "range" => Ok(Scale::Range(of)),
        "1/range" => Ok(Scale::PerRange(of)),
        "freq" => Ok(Scale::Frequency(of)),
        other => {
            fault(format!("unknown scale function `{other}`; use rms, max, top, range, 1/range or freq"))
        }
    }
}

fn region(entry: LocationFile) -> Result<Region, Fault> {
    let end = |text: Option<String>, key: &str| text.map(|t| expression(&t, "location", key)).transpose();
    Ok(Region {
        variable: expression(&entry.variable, "location", "variable")?,
        low: end(entry.low, "low")?,
        high: end(entry.high, "high")?,
    })
}

fn excitation(entry: ExperimentFile) -> Result<Excitation, Fault> {
    let at = entry.at.map(|text| expression(&text, "experiment", "at")).transpose()?;
    match (entry.drive, at) {
        (Drive::Slow, None) => Ok(Excitation::Slow),
        (Drive::Wide, None) => Ok(Excitation::Wide),
        (Drive::Loud, None) => Ok(Excitation::Loud),
        (Drive::Silent, None) => Ok(Excitation::Silent),
        (Drive::Again, None) => Ok(Excitation::Again),
        (Drive::Around, Some(at)) => Ok(Excitation::Around(at)),
        (Drive::Ramp, Some(at)) => Ok(Excitation::Ramp(at)),
        (Drive::Beyond, Some(at)) => Ok(Excitation::Beyond(at)),
        (_, Some(_)) => Err(Fault::new(
            "experiment",
            "at",
            "[experiment] at: only `around`, `ramp` and `beyond` have it; remove it",
        )),
        (_, None) => Err(Fault::new(
            "experiment",
            "drive",
            "[experiment] drive: state the frequency in Hz, or the magnitude of the input, as `at = \"formula\"`",
        )),
    }
}

fn first_value(text: &str, name: &str) -> Result<First, Fault> {
    let whole = || expression(text, "first", name).map(First::Value);
    let Some(inside) = text.trim().strip_prefix("angle(").and_then(|t| t.strip_suffix(')')) else {
        return whole();
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
            expression(&inside[..at], "first", name)?,
            expression(&inside[at + 1..], "first", name)?,
        )),
        None => whole(),
    }
}
