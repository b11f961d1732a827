//! Writing a model back in its language.

use crate::expr::Expr;
use crate::model::{Equation, Hold, Input, Measurement, Model, Parameter, State};
use crate::parse::{parse, parse_equation};
use crate::units::{DeclaredUnit, Unit};
use toml_edit::{Array, DocumentMut, InlineTable, Item, Table, TableLike, Value};

/// The byte order mark.
const MARK: char = '\u{feff}';

/// How [`Model::to_toml`] writes.
#[derive(Debug, Clone, Default)]
pub struct WriteOptions<'a> {
    /// The text that the model was read from: its comments, order, formatting, names and units are
    /// kept, and only what changed is rewritten. Text that is not TOML counts as none.
    pub original: Option<&'a str>,
    /// Parameter name → comment at the end of its line, for parameters that the original lacks.
    pub comments: &'a [(String, String)],
}

impl Model {
    /// The model in its language, so that [`Model::from_toml`] gives the same model again.
    ///
    /// Values are written in the user's own units; one that changed is rounded to six significant
    /// digits, unless nine give it exactly. An equation whose expressions are unchanged keeps its
    /// text byte for byte. What the model has and the original lacks is added to its table; what the
    /// model no longer has is removed.
    ///
    /// ```
    /// # use greybox_model::{Model, WriteOptions, parse};
    /// let original = "[states]\nz = { unit = \"m\" } # height\n\n[parameters]\ng = { value = 9.81, unit = \"m/s^2\" }\n\n\
    ///                 [equations]\nfall = \"z''=-g\" # Galilei\n";
    /// let mut model = Model::from_toml(original, "fall.toml")?;
    /// model.parameters[0].value = 9.80665;
    /// let written = model.to_toml(&WriteOptions { original: Some(original), ..Default::default() });
    /// assert_eq!(written, original.replace("9.81", "9.80665"));
    /// # Ok::<(), greybox_model::ModelError>(())
    /// ```
    pub fn to_toml(&self, options: &WriteOptions<'_>) -> String {
        let parsed = options.original.and_then(|text| text.parse::<DocumentMut>().ok());
        let fresh = parsed.is_none();
        let mut document = parsed.unwrap_or_default();
        let newline = if options.original.is_some_and(|t| t.contains("\r\n")) { "\r\n" } else { "\n" };
        let old_name = document.get("name").and_then(Item::as_str);
        if old_name != Some(&self.name) && !(old_name.is_none() && self.name.is_empty()) {
            set(document.as_table_mut(), "name", Value::from(self.name.as_str()));
        }
        let root = document.as_table_mut();
        let measurements = root.get("measurements").cloned();
        // A comment inside an inline table would swallow the rest of its line.
        let may_comment = root.get("parameters").is_none_or(Item::is_table);
        let units = self.units.iter().map(|u| (u.symbol.as_str(), u));
        write_section(root, "units", units, write_definition);
        let inputs = self.inputs.iter().map(|i| (i.name.as_str(), i));
        write_section(root, "inputs", inputs, write_input);
        let states = self.states.iter().map(|s| (s.name.as_str(), s));
        write_section(root, "states", states, write_state);
        let parameters = self.parameters.iter().map(|p| (p.name.as_str(), p));
        write_section(root, "parameters", parameters, |old, parameter| {
            let mut item = write_parameter(old, parameter);
            let comment = options.comments.iter().find(|(name, _)| *name == parameter.name);
            if let (None, true, Some((_, comment)), Some(value)) =
                (old, may_comment, comment, item.as_value_mut())
            {
                // A line break would end the comment.
                let line: String = comment.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
                value.decor_mut().set_suffix(format!("  # {line}"));
            }
            item
        });
        let equations = self.equations.iter().map(|e| (e.name.as_str(), e));
        write_section(root, "equations", equations, write_equation);
        let stated = |channel: &str| {
            let table = measurements.as_ref().and_then(Item::as_table_like);
            table.is_some_and(|table| table.contains_key(channel))
        };
        let explicit = self.measurements.iter().filter(|m| stated(&m.channel) || !self.is_implied(m));
        let explicit = explicit.map(|m| (m.channel.as_str(), m));
        write_section(root, "measurements", explicit, |old, measurement| {
            write_measurement(old, measurement, self)
        });
        if fresh {
            space_sections(root);
        }
        let mut text = document.to_string();
        // The last line gets an end even where the original's has none.
        if !fresh && text.ends_with('\n') && options.original.is_some_and(|t| !t.ends_with('\n')) {
            text.pop();
        }
        let text = if newline == "\r\n" { text.replace("\r\n", "\n").replace('\n', "\r\n") } else { text };
        // Editors of Windows begin a file with a byte order mark.
        if !fresh && options.original.is_some_and(|t| t.starts_with(MARK)) {
            format!("{MARK}{text}")
        } else {
            text
        }
    }

    /// Whether this measurement is the state's own channel and needs no entry.
    fn is_implied(&self, measurement: &Measurement) -> bool {
        self.states.iter().any(|s| {
            s.channel.as_ref() == Some(&measurement.channel)
                && measurement.expr == Expr::var(&s.name)
                && measurement.unit == s.unit
        })
    }
}

/// Rewrites one table: entries are changed in place, those that are gone removed, new ones appended.
fn write_section<'a, T: 'a>(
    root: &mut Table,
    name: &str,
    wanted: impl Iterator<Item = (&'a str, &'a T)>,
    write: impl Fn(Option<&Item>, &'a T) -> Item,
) {
    let wanted: Vec<(&str, &T)> = wanted.collect();
    let present = root.get(name).is_some_and(Item::is_table_like);
    if !present {
        if wanted.is_empty() {
            root.remove(name);
            return;
        }
        let mut table = Table::new();
        table.decor_mut().set_prefix("\n");
        root.insert(name, Item::Table(table));
    }
    let Some(table) = root.get_mut(name).and_then(Item::as_table_like_mut) else { return };
    let gone: Vec<String> = table
        .iter()
        .map(|(key, _)| key.to_owned())
        .filter(|key| !wanted.iter().any(|(name, _)| name == key))
        .collect();
    if wanted.is_empty() && !gone.is_empty() {
        root.remove(name);
        return;
    }
    for key in gone {
        table.remove(&key);
    }
    for (key, value) in wanted {
        let item = write(table.get(key), value);
        replace_item(table, key, item);
    }
}

/// Inserts, keeping the key's own formatting.
fn replace_item(table: &mut dyn TableLike, key: &str, item: Item) {
    match table.get_mut(key) {
        Some(old) => *old = item,
        None => {
            table.insert(key, item);
        }
    }
}

/// Sets a plain value, keeping the spaces and the comment around the old one.
fn set(table: &mut dyn TableLike, key: &str, mut value: Value) {
    match table.get_mut(key) {
        Some(Item::Value(old)) => {
            *value.decor_mut() = old.decor().clone();
            *old = value;
        }
        Some(old) => *old = Item::Value(value),
        None => {
            table.insert(key, Item::Value(value));
        }
    }
}

/// The old entry if it is a table, else an empty inline table.
fn entry(old: Option<&Item>) -> Item {
    match old {
        Some(item) if item.is_table_like() => item.clone(),
        _ => Item::Value(Value::InlineTable(InlineTable::new())),
    }
}

/// Applies `change` to the entry's table and tidies an inline one that grew.
fn edited(old: Option<&Item>, change: impl FnOnce(&mut dyn TableLike)) -> Item {
    let mut item = entry(old);
    if let Some(table) = item.as_table_like_mut() {
        let before: Vec<String> = table.iter().map(|(key, _)| key.to_owned()).collect();
        change(table);
        let after: Vec<String> = table.iter().map(|(key, _)| key.to_owned()).collect();
        if before != after
            && let Item::Value(Value::InlineTable(inline)) = &mut item
        {
            let decor = inline.decor().clone();
            inline.fmt();
            *inline.decor_mut() = decor;
        }
    }
    item
}

fn old_str<'a>(table: &'a dyn TableLike, key: &str) -> Option<&'a str> {
    table.get(key).and_then(Item::as_str)
}

fn old_number(table: &dyn TableLike, key: &str) -> Option<f64> {
    table.get(key).and_then(as_number)
}

fn as_number(item: &Item) -> Option<f64> {
    item.as_float().or_else(|| item.as_integer().map(|v| v as f64))
}

/// Writes the unit where it differs from what stands there; an inferred one may stay unsaid.
fn write_unit(table: &mut dyn TableLike, unit: &Unit) {
    if old_str(table, "unit").map(str::trim) != Some(&unit.text) {
        set(table, "unit", Value::from(unit.text.as_str()));
    }
}

/// Whether the unit is another than SI, so that it must be said.
fn is_scaled(unit: &Unit) -> bool {
    unit.factor != 1.0 || unit.offset != 0.0
}

/// Writes a number given in SI in the stated unit, unless the old text means the same.
fn write_number(table: &mut dyn TableLike, key: &str, si: f64, unit: &Unit) {
    let unchanged = old_number(table, key).is_some_and(|v| unit.to_si(v) == si || v == unit.from_si(si));
    if !unchanged {
        set(table, key, decimal(unit.from_si(si)));
    }
}

/// A declared unit; the old entry where it says the same.
fn write_definition(old: Option<&Item>, declared: &DeclaredUnit) -> Item {
    let stated = old.and_then(|item| {
        let table = item
            .as_table_like()
            .and_then(|table| Some(format!("{:?} {}", old_number(table, "value")?, old_str(table, "unit")?)));
        let text = item.as_str().map(str::to_owned);
        text.or(as_number(item).map(|v| format!("{v:?}"))).or(table)
    });
    match old {
        Some(item) if stated.as_deref().map(str::trim) == Some(&declared.definition) => item.clone(),
        _ => text_item(old, declared.definition.clone()),
    }
}

/// As it is where nine significant digits suffice (a person wrote it), else six: more would claim
/// what no calibration knows.
fn decimal(v: f64) -> Value {
    let digits =
        |v: f64| format!("{v:e}").split('e').next().unwrap_or("").bytes().filter(u8::is_ascii_digit).count();
    let rounded: f64 = if digits(v) <= 9 { v } else { format!("{v:.5e}").parse().unwrap_or(v) };
    let size = rounded.abs();
    let text = if rounded == 0.0 || (1e-4..1e7).contains(&size) {
        format!("{rounded:?}")
    } else {
        format!("{rounded:e}")
    };
    text.parse().unwrap_or_else(|_| Value::from(rounded))
}

fn write_input(old: Option<&Item>, input: &Input) -> Item {
    edited(old, |table| {
        if old.is_none() || table.get("unit").is_some() || is_scaled(&input.unit) {
            write_unit(table, &input.unit);
        }
        let usual = Input::usual_hold(&input.channel);
        let hold = old_str(table, "hold").and_then(Hold::from_name).unwrap_or(usual);
        if hold != input.hold {
            set(table, "hold", Value::from(input.hold.name()));
        }
        if old_str(table, "channel").unwrap_or(&input.name) != input.channel {
            set(table, "channel", Value::from(input.channel.as_str()));
        }
        let old = table.get("range").and_then(Item::as_array).map(|list| {
            list.iter()
                .map(|v| {
                    v.as_float().or_else(|| v.as_integer().map(|i| i as f64)).map(|v| input.unit.to_si(v))
                })
                .collect::<Option<Vec<f64>>>()
        });
        match input.range {
            Some(range) if old.flatten().is_some_and(|old| old == range) => {}
            Some(range) => {
                let list: Array = range.iter().map(|v| decimal(input.unit.from_si(*v))).collect();
                set(table, "range", Value::Array(list));
            }
            None => {
                table.remove("range");
            }
        }
    })
}

fn write_state(old: Option<&Item>, state: &State) -> Item {
    edited(old, |table| {
        if old.is_none() || table.get("unit").is_some() || is_scaled(&state.unit) {
            write_unit(table, &state.unit);
        }
        match &state.channel {
            None => {
                table.remove("channel");
                if table.get("measured").and_then(Item::as_bool) != Some(false) {
                    set(table, "measured", Value::from(false));
                }
            }
            Some(channel) => {
                if table.get("measured").and_then(Item::as_bool) == Some(false) {
                    table.remove("measured");
                }
                // An explicit measurement named after the state carries the channel already.
                let stated = old_str(table, "channel").unwrap_or(&state.name);
                if stated != channel {
                    set(table, "channel", Value::from(channel.as_str()));
                }
            }
        }
        let unit = &state.unit;
        let old_initial: Option<Vec<f64>> = table.get("initial").and_then(|item| match item.as_array() {
            Some(list) => {
                list.iter().map(|v| v.as_float().or_else(|| v.as_integer().map(|i| i as f64))).collect()
            }
            None => as_number(item).map(|v| vec![v]),
        });
        let same = old_initial.as_ref().is_some_and(|old| {
            old.len() == state.initial.len()
                && old
                    .iter()
                    .zip(&state.initial)
                    .enumerate()
                    .all(|(k, (v, si))| unit.initial_to_si(k, *v) == *si)
        });
        match state.initial.as_slice() {
            _ if same => {}
            [] => {
                table.remove("initial");
            }
            [one] => set(table, "initial", decimal(unit.from_si(*one))),
            [position, rates @ ..] => {
                let rates = rates.iter().map(|v| unit.difference_from_si(*v));
                let list: Array = [unit.from_si(*position)].into_iter().chain(rates).map(decimal).collect();
                set(table, "initial", Value::Array(list));
            }
        }
    })
}

fn write_parameter(old: Option<&Item>, parameter: &Parameter) -> Item {
    edited(old, |table| {
        let written = parameter.unit.clone().unwrap_or_else(Unit::dimensionless);
        write_number(table, "value", parameter.value, &written);
        if let Some(unit) = &parameter.unit
            && (old.is_none() || table.get("unit").is_some() || is_scaled(unit))
        {
            write_unit(table, unit);
        }
        match parameter.std {
            Some(std) => write_number(table, "std", std, &written.of_difference()),
            None => {
                table.remove("std");
            }
        }
        if table.get("fixed").and_then(Item::as_bool).unwrap_or(false) != parameter.fixed {
            set(table, "fixed", Value::from(parameter.fixed));
        }
        match parameter.positive {
            Some(positive) => set(table, "positive", Value::from(positive)),
            None => {
                table.remove("positive");
            }
        }
    })
}

fn write_equation(old: Option<&Item>, equation: &Equation) -> Item {
    let same = old
        .and_then(Item::as_str)
        .and_then(|text| parse_equation(text).ok())
        .is_some_and(|p| p.lhs.expr == equation.lhs && p.rhs.expr == equation.rhs);
    match old {
        Some(item) if same => item.clone(),
        _ => text_item(old, equation.to_string()),
    }
}

fn write_measurement(old: Option<&Item>, measurement: &Measurement, model: &Model) -> Item {
    let stated = old.and_then(|item| {
        item.as_str().or_else(|| item.as_table_like().and_then(|table| old_str(table, "expression")))
    });
    let same = stated.and_then(|text| parse(text).ok()).is_some_and(|p| p.expr == measurement.expr);
    let default = model.default_measurement_unit(&measurement.expr).ok();
    let needs_unit = default.is_none_or(|unit| unit != measurement.unit);
    let is_table = old.is_some_and(Item::is_table_like);
    if !needs_unit && !is_table {
        return match old {
            Some(item) if same => item.clone(),
            _ => text_item(old, measurement.expr.to_string()),
        };
    }
    edited(old, |table| {
        if !same {
            set(table, "expression", Value::from(measurement.expr.to_string()));
        }
        if needs_unit || table.get("unit").is_some() {
            write_unit(table, &measurement.unit);
        }
    })
}

/// A string in double quotes (primes would end a TOML literal string), with the old one's comment.
fn text_item(old: Option<&Item>, text: String) -> Item {
    let quoted = format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\""));
    let mut value: Value = quoted.parse().unwrap_or_else(|_| Value::from(text));
    if let Some(Item::Value(old)) = old {
        *value.decor_mut() = old.decor().clone();
    }
    Item::Value(value)
}

/// A blank line before each table but the first thing in the file.
fn space_sections(root: &mut Table) {
    let mut first = true;
    for (_, item) in root.iter_mut() {
        if let Some(table) = item.as_table_mut() {
            table.decor_mut().set_prefix(if first { "" } else { "\n" });
        }
        first = false;
    }
}
