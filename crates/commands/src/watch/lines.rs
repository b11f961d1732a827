//! Lines to rows: time, inputs and measurements of a model, SI.

use greybox_calibrate::data::recorded_unit;
use greybox_model::{Expr, Model, Unit};
use greybox_recording::{CsvLines, Rename, listed};
use serde_json::Value;

use super::influx;
use crate::failure::Failure;

/// What the samples are called in messages.
pub(super) const LABEL: &str = "standard input";

/// How lines are read: told by the first of them.
#[derive(Debug)]
pub(super) struct Lines {
    format: Format,
    /// Of every input, then of every measurement.
    pub(super) columns: Vec<Column>,
}

#[derive(Debug)]
enum Format {
    Csv(CsvLines),
    /// Keys of the channels, in the order of the columns.
    Json(Vec<String>),
    /// The same.
    Influx(Vec<String>),
}

/// Where a channel stands in a line.
#[derive(Debug)]
pub(super) struct Column {
    /// As the model calls it.
    pub(super) channel: String,
    /// Place after the time.
    index: usize,
    /// Unit there.
    pub(super) unit: Unit,
}

impl Lines {
    /// Reads the first line: the header of a CSV file, a JSON object, or a line of the Influx protocol.
    ///
    /// # Errors
    /// Bad input: a header without the model's channels, or a unit that does not fit.
    pub(super) fn new(model: &Model, map: &[Rename], text: &str, line: u64) -> Result<Lines, Failure> {
        let influx = influx::is_influx(text);
        let csv = match influx || is_json(text) {
            true => None,
            false => Some(CsvLines::new(text, LABEL, line)?),
        };
        let (mut keys, mut columns) = (Vec::new(), Vec::new());
        for (place, wanted) in wanted(model).into_iter().enumerate() {
            let channel = wanted.channel.to_owned();
            let rename = map.iter().find(|r| r.name == channel);
            let has =
                |name: &str| csv.as_ref().is_some_and(|csv| csv.columns().iter().any(|(n, _)| n == name));
            let (name, given) = rename.map_or((wanted.channel, None), |r| r.meant(has));
            let (index, header) = match &csv {
                None => (place, None),
                Some(csv) => {
                    let found = csv.columns().iter().position(|(n, _)| n == name);
                    let index = found.ok_or_else(|| missing(csv, name, &channel, line))?;
                    (index, csv.columns()[index].1.as_deref())
                }
            };
            let stated = header.or(given);
            let unit = unit(model, &wanted, stated, line)?;
            keys.push(name.to_owned());
            columns.push(Column { channel, index, unit });
        }
        let format = match csv {
            Some(csv) => Format::Csv(csv),
            None if influx => Format::Influx(keys),
            None => Format::Json(keys),
        };
        Ok(Lines { format, columns })
    }

    /// Whether the first line was a sample already.
    pub(super) fn begins_with_a_sample(&self) -> bool {
        !matches!(self.format, Format::Csv(_))
    }

    /// Whether a line may be the header again, of a log that is written on.
    pub(super) fn may_be_a_header(&self, text: &str) -> bool {
        matches!(self.format, Format::Csv(_)) && text.trim_start_matches(['"', ' ']).starts_with('t')
    }

    /// Time and columns of a line, SI; `None` for one that has nothing of the model: a blank one, a comment, a line of
    /// another measurement.
    ///
    /// # Errors
    /// What is wrong with the line, and where.
    pub(super) fn row(&self, text: &str, line: u64) -> Result<Option<Vec<f64>>, String> {
        let values = match &self.format {
            Format::Csv(lines) => match lines.row(text, line).map_err(|e| e.to_string())? {
                Some(values) => values,
                None => return Ok(None),
            },
            Format::Influx(_) if text.trim().is_empty() || text.starts_with('#') => return Ok(None),
            Format::Influx(keys) => {
                let row = influx::parse(text).and_then(|found| found.row(keys));
                match row.map_err(|e| format!("{LABEL}:{line}: {e}"))? {
                    Some(values) => values,
                    None => return Ok(None),
                }
            }
            Format::Json(keys) => from_json(text, keys).map_err(|e| format!("{LABEL}:{line}: {e}"))?,
        };
        let columns = self.columns.iter().map(|c| c.unit.to_si(values[c.index + 1]));
        Ok(Some(std::iter::once(values[0]).chain(columns).collect()))
    }
}

fn is_json(text: &str) -> bool {
    text.trim_start().starts_with('{')
}

/// A channel that a model needs.
struct Wanted<'a> {
    channel: &'a str,
    unit: &'a Unit,
    /// What it measures, if it does.
    measured: Option<&'a Expr>,
}

/// The channels of inputs, then of measurements.
fn wanted(model: &Model) -> Vec<Wanted<'_>> {
    let inputs = model.inputs.iter().map(|i| Wanted { channel: &i.channel, unit: &i.unit, measured: None });
    let measured = model.measurements.iter();
    let measured = measured.map(|m| Wanted { channel: &m.channel, unit: &m.unit, measured: Some(&m.expr) });
    inputs.chain(measured).collect()
}

fn missing(csv: &CsvLines, name: &str, channel: &str, line: u64) -> Failure {
    let available = listed(csv.columns().iter().map(|(n, _)| format!("`{n}`")).collect());
    Failure::input(format!(
        "{LABEL}:{line}: there is no channel `{name}`, which the model needs; the header has {available}"
    ))
    .help(format!("name the channel that is `{channel}`: `--map \"{channel}=CHANNEL\"`"))
}

fn unit(model: &Model, wanted: &Wanted<'_>, stated: Option<&str>, line: u64) -> Result<Unit, Failure> {
    let channel = wanted.channel;
    let found = recorded_unit(model, stated, wanted.unit, wanted.measured)
        .map_err(|e| Failure::input(format!("{LABEL}:{line}: channel `{channel}`: {e}")))?;
    if found.dimension.same(&wanted.unit.dimension) {
        return Ok(found);
    }
    Err(Failure::input(format!(
        "{LABEL}:{line}: channel `{channel}` is in [{}], but the model has it in [{}]",
        found.text, wanted.unit.text
    ))
    .help("correct the unit in the header or in the model"))
}

/// Time and values of a JSON object; a key that is not there, or is `null`, is a missing sample. A key with points may lead
/// into objects: `motor.angle`.
fn from_json(text: &str, keys: &[String]) -> Result<Vec<f64>, String> {
    let object: Value = serde_json::from_str(text).map_err(|e| format!("this is no JSON object: {e}"))?;
    let find = |key: &str| {
        object.get(key).or_else(|| key.split('.').try_fold(&object, |inner, part| inner.get(part)))
    };
    let number = |key: &str, value: &Value| match value {
        Value::Null => Ok(f64::NAN),
        value => value.as_f64().ok_or_else(|| format!("`{key}` is {value}, not a number")),
    };
    let time = find("t").ok_or("there is no time `t`, in seconds")?;
    let mut row = vec![number("t", time)?];
    if row[0].is_nan() {
        return Err("the time `t` is null".to_owned());
    }
    for key in keys {
        row.push(find(key).map_or(Ok(f64::NAN), |value| number(key, value))?);
    }
    Ok(row)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_json_object_is_a_row() {
        let keys = ["u".to_owned(), "motor.angle".to_owned(), "not.there".to_owned()];
        let row = from_json(r#"{"t": 2, "motor": {"angle": -1.5}, "u": null, "x": "y"}"#, &keys).unwrap();
        assert_eq!((row[0], row[2]), (2.0, -1.5));
        assert!(row[1].is_nan() && row[3].is_nan());
        // A key that has a point of its own comes first.
        assert_eq!(from_json(r#"{"t": 0, "a.b": 3, "a": {"b": 4}}"#, &["a.b".to_owned()]).unwrap()[1], 3.0);
        for (text, part) in [
            ("{", "no JSON object"),
            ("[1]", "no time `t`"),
            ("{\"u\": 1}", "no time `t`"),
            ("{\"t\": null}", "`t` is null"),
            ("{\"t\": 1, \"u\": \"x\"}", "`u` is \"x\", not a number"),
        ] {
            let said = from_json(text, &keys).unwrap_err();
            assert!(said.contains(part), "{said}");
        }
    }
}
