//! Lines to rows: time, inputs and measurements of a model, SI.

use std::fmt;

use greybox_calibrate::data::recorded_unit;
use greybox_model::{Expr, Model, Unit};
use greybox_recording::{CsvLines, Rename, Stamp, listed};
use serde_json::Value;

use super::influx;
use crate::failure::Failure;

/// Where a line came from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place<'a> {
    /// The topic of a message; a line of standard input has none.
    pub(super) topic: Option<&'a str>,
    /// Number of the line, or of the message.
    pub(super) line: u64,
}

impl Place<'_> {
    pub(super) fn label(&self) -> String {
        self.topic.map_or_else(|| "standard input".to_owned(), |topic| format!("topic `{topic}`, message"))
    }
}

impl fmt::Display for Place<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let between = if self.topic.is_some() { ' ' } else { ':' };
        write!(f, "{}{between}{}", self.label(), self.line)
    }
}

/// The option that names the columns of rows without a header, in messages.
const COLUMNS: &str = "--columns";

/// How lines are read: chosen by the first of them.
#[derive(Debug)]
pub(super) struct Lines {
    format: Format,
    /// Of every input, then of every measurement.
    pub(super) columns: Vec<Column>,
}

#[derive(Debug)]
enum Format {
    Csv(CsvLines),
    /// JSON objects and lines of the Influx protocol.
    Keyed(Keys),
}

/// Where objects have what is read.
#[derive(Debug)]
struct Keys {
    time: String,
    /// Power of ten of the unit of times that are numbers.
    exponent: i32,
    /// Of the channels, in the order of the columns.
    channels: Vec<String>,
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
    /// Reads the first line: the header of a CSV file, a JSON object, or a line of the Influx protocol. A message has no
    /// header.
    ///
    /// # Errors
    /// Bad input: a header without the model's channels, or a unit that does not fit.
    pub(super) fn new(model: &Model, map: &[Rename], text: &str, place: Place<'_>) -> Result<Lines, Failure> {
        let csv = match place.topic.is_some() || influx::is_influx(text) || is_json(text) {
            true => None,
            false => Some(CsvLines::new(text, &place.label(), place.line)?),
        };
        Lines::of(model, map, csv, &Names { place: place.to_string(), has: "the header has" })
    }

    /// Rows of a CSV file without a header, whose columns have these names.
    ///
    /// # Errors
    /// Bad input: names that do not fit, or that lack the model's channels.
    pub(super) fn named(model: &Model, map: &[Rename], columns: &str) -> Result<Lines, Failure> {
        let label = Place { topic: None, line: 0 }.label();
        let csv = CsvLines::named(columns, COLUMNS, &label)?;
        Lines::of(model, map, Some(csv), &Names { place: COLUMNS.to_owned(), has: "it names" })
    }

    fn of(model: &Model, map: &[Rename], csv: Option<CsvLines>, stated_in: &Names) -> Result<Lines, Failure> {
        let (mut channels, mut columns) = (Vec::new(), Vec::new());
        for (number, wanted) in wanted(model).into_iter().enumerate() {
            let channel = wanted.channel.to_owned();
            let rename = map.iter().find(|r| r.name == channel);
            let has =
                |name: &str| csv.as_ref().is_some_and(|csv| csv.columns().iter().any(|(n, _)| n == name));
            let (name, given) = rename.map_or((wanted.channel, None), |r| r.meant(has));
            let (index, header) = match &csv {
                None => (number, None),
                Some(csv) => {
                    let found = csv.columns().iter().position(|(n, _)| n == name);
                    let index = found.ok_or_else(|| missing(csv, name, &channel, stated_in))?;
                    (index, csv.columns()[index].1.as_deref())
                }
            };
            let stated = header.or(given);
            let unit = unit(model, &wanted, stated, &stated_in.place)?;
            channels.push(name.to_owned());
            columns.push(Column { channel, index, unit });
        }
        let format = match csv {
            Some(csv) => Format::Csv(csv),
            None => Format::Keyed(keys(map, channels)?),
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

    /// Sees that the first line is a row, where columns have names that the caller gave.
    ///
    /// # Errors
    /// Bad input: it is a JSON object, or a line of the Influx protocol.
    pub(super) fn check_first(&self, text: &str, place: Place<'_>) -> Result<(), Failure> {
        let kind = match self.row(text, place) {
            Ok(_) => return Ok(()),
            Err(_) if is_json(text) => "a JSON object",
            Err(_) if influx::parse(text).is_ok() => "a line of the Influx protocol",
            // (The first line of a log that is followed may be the rest of one.)
            Err(_) => return Ok(()),
        };
        Err(Failure::input(format!(
            "{place}: this is {kind}, but `{COLUMNS}` names the columns of CSV without a header"
        ))
        .help("leave `--columns` out: such a line names its values itself"))
    }

    /// Time and columns of a line, SI; `None` for one that has nothing of the model: a blank one, a comment, a line of
    /// another measurement.
    ///
    /// # Errors
    /// What is wrong with the line, and where.
    pub(super) fn row(&self, text: &str, place: Place<'_>) -> Result<Option<(Stamp, Vec<f64>)>, String> {
        let row = match &self.format {
            Format::Csv(lines) => lines.row(text, place.line).map_err(|e| e.to_string())?,
            Format::Keyed(_) if text.trim().is_empty() || text.starts_with('#') => None,
            Format::Keyed(keys) if is_json(text) => {
                Some(from_json(text, keys).map_err(|e| format!("{place}: {e}"))?)
            }
            Format::Keyed(keys) => from_influx(text, &keys.channels).map_err(|e| format!("{place}: {e}"))?,
        };
        let in_si = |values: Vec<f64>| self.columns.iter().map(|c| c.unit.to_si(values[c.index])).collect();
        Ok(row.map(|(time, values)| (time, in_si(values))))
    }
}

/// The keys of objects; that of the time is `t`, or what `--map t=KEY` says.
fn keys(map: &[Rename], channels: Vec<String>) -> Result<Keys, Failure> {
    let Some(time) = map.iter().find(|r| r.name == "t") else {
        return Ok(Keys { time: "t".to_owned(), exponent: 0, channels });
    };
    let exponent = match time.unit.as_deref() {
        None | Some("s") => 0,
        Some("ms") => -3,
        Some("us" | "µs") => -6,
        Some("ns") => -9,
        Some(other) => {
            return Err(Failure::input(format!("`--map {time}`: a time is not in [{other}]"))
                .help("state it in s, ms, us or ns; a date has no unit"));
        }
    };
    Ok(Keys { time: time.channel.clone(), exponent, channels })
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

/// Where names and units of columns are stated.
struct Names {
    place: String,
    /// What it does, before a list of them.
    has: &'static str,
}

fn missing(csv: &CsvLines, name: &str, channel: &str, names: &Names) -> Failure {
    let Names { place, has } = names;
    let available = listed(csv.columns().iter().map(|(n, _)| format!("`{n}`")).collect());
    Failure::input(format!("{place}: there is no channel `{name}`, which the model needs; {has} {available}"))
        .help(format!("name the channel that is `{channel}`: `--map \"{channel}=CHANNEL\"`"))
}

fn unit(model: &Model, wanted: &Wanted<'_>, stated: Option<&str>, place: &str) -> Result<Unit, Failure> {
    let channel = wanted.channel;
    let found = recorded_unit(model, stated, wanted.unit, wanted.measured)
        .map_err(|e| Failure::input(format!("{place}: channel `{channel}`: {e}")))?;
    if found.dimension.same(&wanted.unit.dimension) {
        return Ok(found);
    }
    Err(Failure::input(format!(
        "{place}: channel `{channel}` is in [{}], but the model has it in [{}]",
        found.text, wanted.unit.text
    ))
    .help("correct the unit there or in the model"))
}

/// Time and values of a line of the Influx protocol.
fn from_influx(text: &str, channels: &[String]) -> Result<Option<(Stamp, Vec<f64>)>, String> {
    if text.trim().parse::<f64>().is_ok() {
        return Err(format!(
            "`{}` is a value alone: a sample has a time and all of its channels",
            text.trim()
        ));
    }
    let line = influx::parse(text);
    line.map_err(|e| format!("this is no JSON object, nor a line of the Influx protocol: {e}"))?.row(channels)
}

/// Time and values of a JSON object; a key that is not there, or is `null`, is a missing sample. A key with points may lead
/// into objects: `motor.angle`.
fn from_json(text: &str, keys: &Keys) -> Result<(Stamp, Vec<f64>), String> {
    let object: Value = serde_json::from_str(text).map_err(|e| format!("this is no JSON object: {e}"))?;
    let find = |key: &str| {
        object.get(key).or_else(|| key.split('.').try_fold(&object, |inner, part| inner.get(part)))
    };
    let number = |key: &str| match find(key) {
        None | Some(Value::Null) => Ok(f64::NAN),
        Some(value) => value.as_f64().ok_or_else(|| format!("`{key}` is {value}, not a number")),
    };
    let key = &keys.time;
    let time = match find(key) {
        None => return Err(format!("there is no time `{key}`, a number of seconds or a date")),
        Some(Value::Null) => return Err(format!("the time `{key}` is null")),
        Some(Value::String(text)) => Stamp::date(text),
        // (Written out, every digit of an integer is there.)
        Some(value) => Stamp::decimal(&value.to_string(), keys.exponent),
    };
    let time = time.ok_or_else(|| {
        let found = find(key).cloned().unwrap_or_default();
        format!("`{key}` is {found}, neither a number nor a date such as \"2026-11-29T12:34:56.789Z\"")
    })?;
    let values = keys.channels.iter().map(|key| number(key));
    Ok((time, values.collect::<Result<_, _>>()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_recording::Zone;

    fn keyed(time: &str, channels: &[&str]) -> Keys {
        let map: Vec<Rename> = vec![format!("t={time}").parse().unwrap()];
        keys(&map, channels.iter().map(|c| (*c).to_owned()).collect()).unwrap()
    }

    #[test]
    fn a_json_object_is_a_row() {
        let keys = keyed("t", &["u", "motor.angle", "not.there"]);
        let text = r#"{"t": 2, "motor": {"angle": -1.5}, "u": null, "x": "y"}"#;
        let (time, row) = from_json(text, &keys).unwrap();
        assert_eq!((time.after(0), row[1]), (2.0, -1.5));
        assert!(row[0].is_nan() && row[2].is_nan());
        // A key that has a point of its own comes first.
        assert_eq!(
            from_json(r#"{"t": 0, "a.b": 3, "a": {"b": 4}}"#, &keyed("t", &["a.b"])).unwrap().1,
            [3.0]
        );
        for (text, part) in [
            ("{", "no JSON object"),
            ("[1]", "no time `t`"),
            ("{\"u\": 1}", "no time `t`"),
            ("{\"t\": null}", "`t` is null"),
            ("{\"t\": true}", "`t` is true, neither a number nor a date"),
            ("{\"t\": \"noon\"}", "`t` is \"noon\", neither a number nor a date"),
            ("{\"t\": 1, \"u\": \"x\"}", "`u` is \"x\", not a number"),
        ] {
            let said = from_json(text, &keys).unwrap_err();
            assert!(said.contains(part), "{said}");
        }
    }

    #[test]
    fn the_time_of_an_object_may_be_a_date_or_count_in_other_units() {
        let time = |keys: &Keys, text: &str| from_json(text, keys).unwrap().0;
        let (keys, noon) = (keyed("t", &[]), 1_795_955_696);
        let dated = time(&keys, r#"{"t": "2026-11-29T12:34:56.789Z"}"#);
        assert_eq!((dated.after(noon), dated.zone), (0.789, Zone::Offset(0)));
        for (key, text) in [
            ("meta.at [ns]", r#"{"meta": {"at": 1795955696789123456}}"#),
            ("ts [us]", r#"{"ts": 1795955696789123.456}"#),
            ("ts [ms]", r#"{"ts": 1795955696789}"#),
        ] {
            let after = time(&keyed(key, &[]), text).after(noon);
            // (A number with a fraction is a double in JSON.)
            assert!((0.789..0.7892).contains(&after), "{text}: {after}");
            assert!(!key.contains("ns") || after == 0.789_123_456);
        }
        assert!(super::keys(&["t=ts [min]".parse().unwrap()], Vec::new()).is_err());
    }
}
