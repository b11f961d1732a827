//! What the thesis prints, and the bounds of what we measure: `fixtures/thesis/*.json`.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A table or figure as the thesis has it, corrected by the errata that it names.
#[derive(Debug, Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Fixture {
    /// "Table 2.1".
    pub(crate) id: String,
    /// The caption, shortened.
    pub(crate) title: String,
    /// Where it stands; empty for what the thesis does not have.
    pub(crate) source: String,
    /// Errata that concern it.
    pub(crate) errata: Vec<String>,
    /// The columns of `rows` that are shown, beside `name`.
    pub(crate) columns: Vec<Heading>,
    /// Remarks.
    pub(crate) notes: Vec<String>,
    /// By column; `note` and `erratum` say what was corrected.
    pub(crate) rows: Vec<BTreeMap<String, Value>>,
    /// Bounds of our measured values, by their names.
    pub(crate) bounds: BTreeMap<String, Bound>,
}

/// A column.
#[derive(Debug, Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Heading {
    /// Key in the rows.
    pub(crate) key: String,
    /// As shown.
    pub(crate) title: String,
}

/// The range in which a value must stay; an end that is missing is open. Each end is within a factor of two of what is
/// measured, or there is a reason.
#[derive(Debug, Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Bound {
    /// Least.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) min: Option<f64>,
    /// Most.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) max: Option<f64>,
    /// Why it is wider than a factor of two.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) why: Option<String>,
}

impl Bound {
    /// Whether a value stays inside; what is not a number does not.
    pub(crate) fn holds(&self, value: f64) -> bool {
        !value.is_nan() && self.min.is_none_or(|min| value >= min) && self.max.is_none_or(|max| value <= max)
    }

    /// Whether each end is within a factor of two of a value, and of its opposite where zero lies between.
    pub(crate) fn is_narrow(&self, value: f64) -> bool {
        let size = value.abs();
        let near = |end: f64| end.abs() <= 2.0 * size && (end * value <= 0.0 || end.abs() >= 0.5 * size);
        self.min.into_iter().chain(self.max).all(near)
    }
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Not a row of zeros.
        let short = |v: f64| if v != 0.0 && v.abs() < 1e-3 { format!("{v:e}") } else { v.to_string() };
        match (self.min.map(short), self.max.map(short)) {
            (Some(min), Some(max)) => write!(f, "{min} … {max}"),
            (Some(min), None) => write!(f, "≥ {min}"),
            (None, Some(max)) => write!(f, "≤ {max}"),
            (None, None) => f.write_str("anything"),
        }
    }
}

impl Fixture {
    /// Reads the file of "Table 2.1", `table-2.1.json`.
    pub(crate) fn read(folder: &Path, id: &str) -> Result<Self> {
        let path = folder.join(format!("{}.json", slug(id)));
        let text =
            std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
        Self::parse(&text).with_context(|| path.display().to_string())
    }

    /// Parses and checks a fixture: rows are named, names are unique, a bound has an end.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        let fixture: Self = serde_json::from_str(text)?;
        for (k, row) in fixture.rows.iter().enumerate() {
            let Some(name) = row.get("name").and_then(Value::as_str) else {
                bail!("row {k} has no `name`");
            };
            if fixture.rows[..k].iter().any(|r| r.get("name").and_then(Value::as_str) == Some(name)) {
                bail!("two rows are named `{name}`");
            }
        }
        if let Some((name, _)) = fixture.bounds.iter().find(|(_, b)| b.min.is_none() && b.max.is_none()) {
            bail!("the bounds `{name}` have neither `min` nor `max`");
        }
        Ok(fixture)
    }

    /// The row of a name.
    pub(crate) fn row(&self, name: &str) -> Option<&BTreeMap<String, Value>> {
        self.rows.iter().find(|row| row.get("name").and_then(Value::as_str) == Some(name))
    }

    /// The number in a cell.
    ///
    /// # Errors
    /// When there is none.
    pub(crate) fn number(&self, row: &str, column: &str) -> Result<f64> {
        let cell = self.row(row).and_then(|row| row.get(column)).and_then(Value::as_f64);
        cell.with_context(|| format!("{}: no number in row `{row}`, column `{column}`", self.id))
    }

    /// Errata of the whole and of its rows.
    pub(crate) fn named_errata(&self) -> impl Iterator<Item = &str> {
        let rows = self.rows.iter().filter_map(|row| row.get("erratum").and_then(Value::as_str));
        self.errata.iter().map(String::as_str).chain(rows)
    }
}

/// The texts of the errata, by "E1", "E2", ….
pub(crate) fn errata(folder: &Path) -> Result<BTreeMap<String, String>> {
    let path = folder.join("errata.json");
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
    serde_json::from_str(&text).with_context(|| path.display().to_string())
}

/// "Table 2.1" as part of a file name.
pub(crate) fn slug(id: &str) -> String {
    id.to_lowercase().replace(' ', "-")
}
