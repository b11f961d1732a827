//! Reading a model from TOML, with every check that the text allows.

use crate::dimension::Unstated;
use crate::error::{ModelError, Place, Problem};
use crate::expr::{Expr, Func};
use crate::model::{Equation, Hold, Input, Measurement, Model, Parameter, State};
use crate::nearest::nearest;
use crate::parse::{Parsed, ParsedEquation, SyntaxError, parse, parse_equation};
use crate::units::{OWN, Unit, UnitError, Units, refused_symbol};
use std::ops::Range;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Most inputs, states and parameters of a model, each.
const MOST_NAMES: usize = 500;

/// Longest definition of a unit, bytes.
const LONGEST_DEFINITION: usize = 1000;

const TABLES: [&str; 7] = ["name", "units", "inputs", "states", "parameters", "equations", "measurements"];

impl Model {
    /// Reads a model from the text of a TOML file; `file` is its name for messages.
    ///
    /// Values are converted to SI here. Everything that the text alone can tell is checked: keys,
    /// names, syntax, that the equations can be solved for the highest derivatives, and units
    /// ([`Model::resolve_units`]). Units of states and inputs that are not stated are inferred like
    /// those of parameters.
    ///
    /// ```
    /// use greybox_model::Model;
    /// let model = Model::from_toml(r#"
    ///     [inputs]
    ///     u = { unit = "N" }
    ///     [states]
    ///     y = { unit = "mm", initial = 5 }
    ///     [parameters]
    ///     m = { value = 200, unit = "g", fixed = true }
    ///     k = { value = 3, std = 1 }
    ///     [equations]
    ///     mass = "m*y'' + k*y = u"
    /// "#, "mass.toml")?;
    /// assert_eq!(model.states[0].initial, [0.005]);
    /// assert_eq!(model.parameters[0].value, 0.2);
    /// assert_eq!(model.parameters[1].unit.as_ref().map(|u| u.text.as_str()), Some("N/m"));
    /// # Ok::<(), greybox_model::ModelError>(())
    /// ```
    ///
    /// # Errors
    /// [`ModelError`] with file, line, column, what is wrong and the fix; the first fault only.
    pub fn from_toml(text: &str, file: &str) -> Result<Model, ModelError> {
        load(text).map_err(|(error, span)| error.at(file, text, span))
    }
}

/// A fault with the bytes to point at.
type Located = (ModelError, Option<Range<usize>>);

fn fault(problem: Problem, span: Range<usize>, help: impl Into<String>) -> Located {
    (ModelError::new(problem).with_help(help), Some(span))
}

/// An expression's text inside the file.
struct Source {
    /// Of the TOML value, quotes included.
    value: Range<usize>,
    /// Offset of the expression's text, where it stands in the file as it is (no escapes).
    inner: Option<usize>,
}

impl Source {
    fn new(text: &str, value: Range<usize>, decoded: &str) -> Source {
        let raw = text.get(value.clone()).unwrap_or("");
        // One quote, or three and perhaps a line break.
        let inner = [1, 3, 4, 5]
            .into_iter()
            .find(|&k| raw.get(k..).is_some_and(|r| r.starts_with(decoded) && r.len() > decoded.len()));
        Source { inner: inner.map(|k| value.start + k), value }
    }

    /// Bytes of the file for bytes of the expression.
    fn span(&self, span: Option<Range<usize>>) -> Range<usize> {
        match (self.inner, span) {
            (Some(offset), Some(s)) => offset + s.start..offset + s.end,
            _ => self.value.clone(),
        }
    }
}

type Entry<'a, 'i> = (&'a str, Range<usize>, &'a Spanned<DeValue<'i>>);

fn entries<'a, 'i>(table: &'a DeTable<'i>) -> impl Iterator<Item = Entry<'a, 'i>> {
    table.iter().map(|(key, value)| (key.get_ref().as_ref(), key.span(), value))
}

fn load(text: &str) -> Result<Model, Located> {
    let document = DeTable::parse(text).map_err(|e| (toml_fault(e.message()), e.span()))?;
    let root = document.get_ref();
    check_keys(root, &TABLES, "the model")?;

    let mut model = Model {
        name: String::new(),
        units: read_units(root)?,
        inputs: Vec::new(),
        states: Vec::new(),
        parameters: Vec::new(),
        equations: Vec::new(),
        measurements: Vec::new(),
    };
    let mut unstated = Vec::new();
    let mut declared: Vec<(String, &'static str)> = Vec::new();
    let mut state_spans = Vec::new();
    if let Some(name) = root.get("name") {
        model.name = string(name, "`name`")?.to_owned();
    }
    for (name, at, value) in section(root, "inputs")? {
        declare(name, &at, "input", &mut declared)?;
        let (input, stated) = read_input(name, value, &model.units)?;
        if !stated {
            unstated.push(Unstated::Input(model.inputs.len()));
        }
        model.inputs.push(input);
    }
    for (name, at, value) in section(root, "states")? {
        declare(name, &at, "state", &mut declared)?;
        let (state, stated) = read_state(name, value, &model.units)?;
        if !stated {
            unstated.push(Unstated::State(model.states.len()));
        }
        model.states.push(state);
        state_spans.push(at);
    }
    for (name, at, value) in section(root, "parameters")? {
        declare(name, &at, "parameter", &mut declared)?;
        model.parameters.push(read_parameter(name, value, &model.units)?);
    }
    check_size(&model, root)?;
    // Parameters come first in the elimination, states next, inputs last.
    unstated.reverse();

    let mut equations: Vec<(Source, ParsedEquation, Range<usize>)> = Vec::new();
    for (name, at, value) in section(root, "equations")? {
        let place = Place::Equation(name.to_owned());
        let decoded = string(value, &format!("equation \"{name}\""))?;
        let source = Source::new(text, value.span(), decoded);
        let parsed = parse_equation(decoded).map_err(|e| syntax(place, &source, e))?;
        model.equations.push(Equation {
            name: name.to_owned(),
            lhs: parsed.lhs.expr.clone(),
            rhs: parsed.rhs.expr.clone(),
        });
        equations.push((source, parsed, at));
    }
    let mut measurements: Vec<(Source, Parsed)> = Vec::new();
    let mut explicit: Vec<(Measurement, Option<Unit>, Range<usize>)> = Vec::new();
    for (channel, at, value) in section(root, "measurements")? {
        let item = format!("measurement \"{channel}\"");
        let (expression, unit) = match value.get_ref() {
            DeValue::Table(table) => {
                check_keys(table, &["expression", "unit"], &item)?;
                let expression = table.get("expression").ok_or_else(|| {
                    let problem = Problem::MissingKey { key: "expression".into(), table: item.clone() };
                    fault(problem, value.span(), "write `{ expression = \"…\", unit = \"…\" }`")
                })?;
                (expression, read_unit(table, &item, &model.units)?)
            }
            _ => (value, None),
        };
        let decoded = string(expression, &item)?;
        let source = Source::new(text, expression.span(), decoded);
        let parsed =
            parse(decoded).map_err(|e| syntax(Place::Measurement(channel.to_owned()), &source, e))?;
        let measurement = Measurement {
            channel: channel.to_owned(),
            expr: parsed.expr.clone(),
            unit: Unit::dimensionless(),
        };
        explicit.push((measurement, unit, at));
        measurements.push((source, parsed));
    }

    for (equation, (source, parsed, _)) in model.equations.iter().zip(&equations) {
        let place = Place::Equation(equation.name.clone());
        check_names(&model, &place, source, &parsed.lhs)?;
        check_names(&model, &place, source, &parsed.rhs)?;
        check_arguments(&model, &place, source, &parsed.lhs)?;
        check_arguments(&model, &place, source, &parsed.rhs)?;
    }
    model.recompute_orders();
    for ((measurement, ..), (source, parsed)) in explicit.iter().zip(&measurements) {
        let place = Place::Measurement(measurement.channel.clone());
        check_names(&model, &place, source, parsed)?;
        check_arguments(&model, &place, source, parsed)?;
        check_measured_order(&model, &place, source, parsed)?;
    }
    check_states(&model, &state_spans, root)?;
    let residual_spans: Vec<Range<usize>> = equations.iter().map(|(s, ..)| s.value.clone()).collect();
    check_counts(&model, root, &residual_spans)?;
    check_solvable(&model, &equations)?;
    collect_measurements(&mut model, explicit.clone(), root)?;

    let find_source = |place: &Place, wanted: &Expr| match place {
        Place::Equation(name) => {
            let (source, parsed, _) = &equations[model_index(&model.equations, name)?];
            let span = parsed.lhs.span_of(wanted).or_else(|| parsed.rhs.span_of(wanted));
            Some(source.span(span))
        }
        Place::Measurement(channel) => {
            let i = explicit.iter().position(|(m, ..)| m.channel == *channel)?;
            let (source, parsed) = &measurements[i];
            Some(source.span(parsed.span_of(wanted)))
        }
        Place::Expression => None,
    };
    let mut resolved = model.clone();
    resolved
        .resolve_units_of(&unstated)
        .map_err(|(place, (error, wanted))| (error, find_source(&place, &wanted)))?;
    set_measurement_units(&mut resolved, &explicit)?;
    Ok(resolved)
}

fn toml_fault(message: &str) -> ModelError {
    let help = if message.contains("duplicate") {
        "a name stands once in its table: rename or delete one of the two"
    } else if message.contains("recurs") {
        "a model needs two levels: a table, and one line `name = { key = value }` per entry"
    } else {
        "tables are `[name]`, lines below them `key = value`, texts stand in quotes"
    };
    ModelError::new(Problem::Toml { message: message.to_owned() }).with_help(help)
}

/// A model is no larger than its fits can hold in memory.
fn check_size(model: &Model, root: &DeTable<'_>) -> Result<(), Located> {
    for (what, count) in [
        ("inputs", model.inputs.len()),
        ("states", model.states.len()),
        ("parameters", model.parameters.len()),
    ] {
        if count > MOST_NAMES {
            let message = format!("{count} {what}; at most {MOST_NAMES} can be computed with");
            let help = "leave out what the equations do not use, or put numbers into them";
            return Err(bad(&format!("[{what}]"), message, root_span(root, what), help));
        }
    }
    Ok(())
}

fn model_index(equations: &[Equation], name: &str) -> Option<usize> {
    equations.iter().position(|e| e.name == name)
}

/// The entries of a table of the root; none if it is absent.
fn section<'a, 'i>(root: &'a DeTable<'i>, name: &str) -> Result<Vec<Entry<'a, 'i>>, Located> {
    match root.get(name) {
        None => Ok(Vec::new()),
        Some(value) => match value.get_ref() {
            DeValue::Table(table) => Ok(entries(table).collect()),
            other => {
                let message = format!("expected a table, found {}", kind(other));
                let problem = Problem::BadValue { item: format!("`{name}`"), message };
                Err(fault(problem, value.span(), format!("write `[{name}]` and one key per line below it")))
            }
        },
    }
}

/// The place of a top-level key, or of the end of the first line.
fn root_span(root: &DeTable<'_>, name: &str) -> Range<usize> {
    entries(root).find(|(key, ..)| *key == name).map_or(0..0, |(_, span, _)| span)
}

fn kind(value: &DeValue<'_>) -> String {
    match value {
        DeValue::Integer(v) => format!("the number {}", v.as_str()),
        DeValue::Float(v) => format!("the number {}", v.as_str()),
        DeValue::String(s) => format!("the string \"{s}\""),
        DeValue::Boolean(b) => format!("{b}"),
        DeValue::Array(_) => "a list".into(),
        DeValue::Table(_) => "a table".into(),
        other => format!("a {}", other.type_str()),
    }
}

fn bad(item: &str, message: impl Into<String>, span: Range<usize>, help: impl Into<String>) -> Located {
    fault(Problem::BadValue { item: item.to_owned(), message: message.into() }, span, help)
}

fn syntax(place: Place, source: &Source, error: SyntaxError) -> Located {
    let located = ModelError::new(Problem::Syntax { place, message: error.message });
    let located = match error.help {
        Some(help) => located.with_help(help),
        None => located,
    };
    (located, Some(source.span(Some(error.span))))
}

fn check_keys(table: &DeTable<'_>, known: &[&str], place: &str) -> Result<(), Located> {
    for (key, span, _) in entries(table) {
        if !known.contains(&key) {
            let help = match nearest(key, known.iter().copied()) {
                Some(near) => format!("did you mean `{near}`?"),
                None => format!("known keys are {}", known.join(", ")),
            };
            let problem = Problem::UnknownKey { key: key.to_owned(), table: place.to_owned() };
            return Err(fault(problem, span, help));
        }
    }
    Ok(())
}

fn string<'a>(value: &'a Spanned<DeValue<'_>>, item: &str) -> Result<&'a str, Located> {
    match value.get_ref() {
        DeValue::String(s) => Ok(s.as_ref()),
        other => Err(bad(
            item,
            format!("expected a string, found {}", kind(other)),
            value.span(),
            "put it in quotes",
        )),
    }
}

fn boolean(table: &DeTable<'_>, key: &str, item: &str) -> Result<Option<bool>, Located> {
    let Some(value) = table.get(key) else { return Ok(None) };
    match value.get_ref() {
        DeValue::Boolean(b) => Ok(Some(*b)),
        other => {
            let message = format!("`{key}` must be true or false, found {}", kind(other));
            Err(bad(item, message, value.span(), format!("write `{key} = true` or `{key} = false`")))
        }
    }
}

fn number(value: &Spanned<DeValue<'_>>, key: &str, item: &str) -> Result<f64, Located> {
    let parsed = match value.get_ref() {
        // TOML's integers have 64 bits; what writes a model back reads no others.
        DeValue::Integer(v) => match i64::from_str_radix(v.as_str(), v.radix()) {
            Ok(v) => Some(v as f64),
            Err(_) => {
                let message = format!("`{key}` is an integer of more than 64 bits");
                return Err(bad(item, message, value.span(), "write it with an exponent, like `5e20`"));
            }
        },
        DeValue::Float(v) => v.as_str().parse::<f64>().ok(),
        other => {
            let message = format!("`{key}` must be a number, found {}", kind(other));
            return Err(bad(item, message, value.span(), format!("write `{key} = 0.5`, without quotes")));
        }
    };
    match parsed {
        Some(v) if v.is_finite() => Ok(v),
        _ => {
            let message = format!("`{key}` must be a finite number, found {}", kind(value.get_ref()));
            Err(bad(item, message, value.span(), "write a finite number"))
        }
    }
}

/// A number in SI.
fn quantity(
    to_si: impl Fn(f64) -> f64,
    given: &Spanned<DeValue<'_>>,
    key: &str,
    item: &str,
) -> Result<f64, Located> {
    let value = to_si(number(given, key, item)?);
    if value.is_finite() {
        return Ok(value);
    }
    let message = format!("`{key}` is too large in SI units");
    Err(bad(item, message, given.span(), "numbers reach 1.7e308"))
}

/// `[units]`: a definition may use symbols that stand above or below it.
fn read_units(root: &DeTable<'_>) -> Result<Units, Located> {
    let mut units = Units::default();
    let mut open = Vec::new();
    for (symbol, at, value) in section(root, "units")? {
        if let Some((reason, help)) = refused_symbol(symbol) {
            let problem = Problem::BadName { name: symbol.to_owned(), what: "unit", reason };
            return Err(fault(problem, at, help));
        }
        open.push((symbol, value, definition(symbol, value)?));
    }
    if open.len() > MOST_NAMES {
        let message = format!("{} units; at most {MOST_NAMES} can be declared", open.len());
        return Err(bad("[units]", message, root_span(root, "units"), "leave out what is not used"));
    }
    while !open.is_empty() {
        let before = open.len();
        let mut waiting = Vec::new();
        let mut first = None;
        for (symbol, value, text) in open {
            let Err(e) = units.declare(symbol, &text) else { continue };
            first.get_or_insert((symbol, value, text.clone(), e));
            waiting.push((symbol, value, text));
        }
        open = waiting;
        if let Some((symbol, value, text, error)) = first.filter(|_| open.len() == before) {
            let circular = error.unknown.as_ref().filter(|u| open.iter().any(|(s, ..)| s == u));
            let item = format!("unit `{symbol}`");
            return Err(match circular {
                Some(other) => {
                    let message = format!("its definition leads through `{other}` back to itself");
                    let help =
                        format!("declare one of them as `\"{OWN}\"`, or as a multiple of a known unit");
                    bad(&item, message, value.span(), help)
                }
                None if text.trim() == OWN => {
                    let help = error.help.unwrap_or_else(|| "write `0.5 rad`".into());
                    bad(&item, error.message, value.span(), help)
                }
                None => unit_fault(&item, value, &text, error, "0.5 rad"),
            });
        }
    }
    Ok(units)
}

/// What a unit stands for: `"2*pi/4096 rad"`, `"own"`, a bare number, or `{ value = …, unit = "…" }`.
fn definition(symbol: &str, value: &Spanned<DeValue<'_>>) -> Result<String, Located> {
    let item = format!("unit `{symbol}`");
    match value.get_ref() {
        DeValue::String(text) if text.len() > LONGEST_DEFINITION => {
            let message = format!("its definition is longer than {LONGEST_DEFINITION} bytes");
            Err(bad(&item, message, value.span(), "write a number and a unit"))
        }
        DeValue::String(text) => Ok(text.as_ref().to_owned()),
        DeValue::Integer(_) | DeValue::Float(_) => Ok(format!("{:?}", number(value, symbol, &item)?)),
        DeValue::Table(table) => {
            check_keys(table, &["value", "unit"], &item)?;
            let part = |key: &str| {
                table.get(key).ok_or_else(|| {
                    let problem = Problem::MissingKey { key: key.to_owned(), table: item.clone() };
                    fault(
                        problem,
                        value.span(),
                        format!("write `{symbol} = {{ value = 0.5, unit = \"rad\" }}`"),
                    )
                })
            };
            Ok(format!("{:?} {}", number(part("value")?, "value", &item)?, string(part("unit")?, &item)?))
        }
        other => {
            let message = format!("expected a definition, found {}", kind(other));
            let help = format!(
                "write `{symbol} = \"0.5 rad\"`, or `{symbol} = \"{OWN}\"` for a dimension of its own"
            );
            Err(bad(&item, message, value.span(), help))
        }
    }
}

fn read_unit(table: &DeTable<'_>, item: &str, units: &Units) -> Result<Option<Unit>, Located> {
    let Some(value) = table.get("unit") else { return Ok(None) };
    let text = string(value, item)?;
    units.parse(text).map(Some).map_err(|e| unit_fault(item, value, text, e, "N m/V"))
}

/// A text that is no unit, at its token where it stands in the file as it is.
fn unit_fault(
    item: &str,
    value: &Spanned<DeValue<'_>>,
    text: &str,
    error: UnitError,
    example: &str,
) -> Located {
    let problem = Problem::Unit { item: item.to_owned(), text: text.to_owned(), message: error.message };
    // Without escapes the string is its text between two quotes.
    let plain = value.get_ref().is_str() && value.span().len() == text.len() + 2;
    let inner = if plain {
        let start = value.span().start + 1;
        start + error.span.start..start + error.span.end
    } else {
        value.span()
    };
    fault(problem, inner, error.help.unwrap_or_else(|| format!("write units like `{example}`")))
}

fn table_of<'a, 'i>(
    value: &'a Spanned<DeValue<'i>>,
    known: &[&str],
    item: &str,
    example: &str,
) -> Result<&'a DeTable<'i>, Located> {
    match value.get_ref() {
        DeValue::Table(table) => {
            check_keys(table, known, item)?;
            Ok(table)
        }
        other => {
            let message = format!("expected a table, found {}", kind(other));
            Err(bad(item, message, value.span(), format!("write `{example}`")))
        }
    }
}

/// Notes a name and rejects those that are taken or no names.
fn declare(
    name: &str,
    span: &Range<usize>,
    what: &'static str,
    declared: &mut Vec<(String, &'static str)>,
) -> Result<(), Located> {
    let reject = |reason: &str, help: String| {
        let problem = Problem::BadName { name: name.to_owned(), what, reason: reason.to_owned() };
        Err(fault(problem, span.clone(), help))
    };
    if name == "t" || name == "pi" {
        let reason = if name == "t" { "it is the time" } else { "it is the constant 3.14159…" };
        return reject(reason, format!("choose another name, such as `{name}_1`"));
    }
    if Func::from_name(name).is_some() {
        return reject("it is a function", format!("choose another name, such as `{name}_1`"));
    }
    let mut letters = name.chars();
    let starts = letters.next().is_some_and(|c| c.is_alphabetic() || c == '_');
    if !starts || !letters.all(|c| c.is_alphabetic() || c.is_ascii_digit() || c == '_') {
        let clean: String = name.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).collect();
        let help = if starts { clean } else { format!("x{clean}") };
        let help =
            format!("write `{help}` in the equations, and `channel = \"{name}\"` if a channel is called so");
        return reject("a name is a letter, then letters, digits and `_`", help);
    }
    if let Some((_, first)) = declared.iter().find(|(n, _)| n == name) {
        let article = |what: &'static str| match what {
            "input" => "an input",
            "state" => "a state",
            _ => "a parameter",
        };
        let problem =
            Problem::DuplicateName { name: name.to_owned(), first: article(first), second: article(what) };
        return Err(fault(problem, span.clone(), "rename one of them"));
    }
    declared.push((name.to_owned(), what));
    Ok(())
}

fn read_input(name: &str, value: &Spanned<DeValue<'_>>, units: &Units) -> Result<(Input, bool), Located> {
    let item = format!("input `{name}`");
    let table = table_of(
        value,
        &["unit", "hold", "channel", "range"],
        &item,
        &format!("{name} = {{ unit = \"V\" }}"),
    )?;
    let unit = read_unit(table, &item, units)?;
    let channel = match table.get("channel") {
        None => name.to_owned(),
        Some(value) => string(value, &item)?.to_owned(),
    };
    let hold = match table.get("hold") {
        None => Input::usual_hold(&channel),
        Some(value) => {
            let text = string(value, &item)?;
            Hold::from_name(text).ok_or_else(|| {
                let known = "write `hold = \"zero\"`, `\"linear\"` or `\"band_limited\"`";
                bad(&item, format!("unknown hold \"{text}\""), value.span(), known)
            })?
        }
    };
    let stated = unit.is_some();
    let unit = unit.unwrap_or_else(Unit::dimensionless);
    let range = table.get("range").map(|given| read_range(given, &unit, &item)).transpose()?;
    Ok((Input { name: name.to_owned(), channel, unit, hold, range }, stated))
}

/// `[low, high]` in the unit of the input.
fn read_range(given: &Spanned<DeValue<'_>>, unit: &Unit, item: &str) -> Result<[f64; 2], Located> {
    let wrong = |found: String| {
        let help = "write the lowest and the highest value that the actuator can make: `range = [-10, 10]`";
        bad(item, format!("`range` must be two rising numbers, found {found}"), given.span(), help)
    };
    let DeValue::Array(list) = given.get_ref() else { return Err(wrong(kind(given.get_ref()))) };
    let [low, high] = list.iter().collect::<Vec<_>>()[..] else {
        return Err(wrong(format!("{} in a list", list.len())));
    };
    let end = |given| quantity(|v| unit.to_si(v), given, "range", item);
    let range = [end(low)?, end(high)?];
    if range[0] < range[1] { Ok(range) } else { Err(wrong("one that is not below the other".to_owned())) }
}

fn read_state(name: &str, value: &Spanned<DeValue<'_>>, units: &Units) -> Result<(State, bool), Located> {
    let item = format!("state `{name}`");
    let known = ["unit", "channel", "measured", "initial"];
    let table = table_of(value, &known, &item, &format!("{name} = {{ unit = \"m\" }}"))?;
    let unit = read_unit(table, &item, units)?;
    let stated = unit.is_some();
    let unit = unit.unwrap_or_else(Unit::dimensionless);
    let measured = boolean(table, "measured", &item)?;
    let channel = match table.get("channel") {
        Some(value) if measured == Some(false) => {
            let problem = Problem::Measurement {
                item,
                message: "it names a channel, but `measured = false` says that none measures it".into(),
            };
            return Err(fault(problem, value.span(), "remove `channel` or `measured = false`"));
        }
        Some(value) => Some(string(value, &item)?.to_owned()),
        None => (measured != Some(false)).then(|| name.to_owned()),
    };
    let initial = match table.get("initial") {
        None => Vec::new(),
        Some(value) => match value.get_ref() {
            DeValue::Array(list) => list
                .iter()
                .enumerate()
                .map(|(primes, v)| quantity(|v| unit.initial_to_si(primes, v), v, "initial", &item))
                .collect::<Result<Vec<f64>, Located>>()?,
            _ => vec![quantity(|v| unit.to_si(v), value, "initial", &item)?],
        },
    };
    Ok((State { name: name.to_owned(), unit, order: 1, channel, initial }, stated))
}

fn read_parameter(name: &str, value: &Spanned<DeValue<'_>>, units: &Units) -> Result<Parameter, Located> {
    let item = format!("parameter `{name}`");
    let known = ["value", "unit", "std", "fixed", "positive"];
    let shown = match value.get_ref() {
        DeValue::Integer(v) => v.as_str().to_owned(),
        DeValue::Float(v) => v.as_str().to_owned(),
        _ => "1.0".to_owned(),
    };
    let table = table_of(value, &known, &item, &format!("{name} = {{ value = {shown} }}"))?;
    let unit = read_unit(table, &item, units)?;
    let written = unit.clone().unwrap_or_else(Unit::dimensionless);
    let given = table.get("value").ok_or_else(|| {
        let problem = Problem::MissingKey { key: "value".into(), table: item.clone() };
        fault(problem, value.span(), format!("write `{name} = {{ value = 1.0 }}`; calibration may move it"))
    })?;
    let std = match table.get("std") {
        None => None,
        Some(v) => {
            let std = number(v, "std", &item)?;
            if std <= 0.0 {
                let message = format!("`std` must be positive, found {std}");
                let help = "write the 1-sigma uncertainty, or `fixed = true` if the value is exact";
                return Err(bad(&item, message, v.span(), help));
            }
            Some(quantity(|v| written.difference_to_si(v), v, "std", &item)?)
        }
    };
    let fixed = boolean(table, "fixed", &item)?.unwrap_or(false);
    let positive = boolean(table, "positive", &item)?;
    let value = quantity(|v| written.to_si(v), given, "value", &item)?;
    if positive == Some(true) && value <= 0.0 {
        let message = format!("`positive = true`, and its value is {value}");
        let help = "correct the value, or write `positive = false` if the parameter may have either sign";
        return Err(bad(&item, message, given.span(), help));
    }
    Ok(Parameter { name: name.to_owned(), value, unit, std, fixed, positive })
}

/// Every name is declared, and primes stand on states only.
fn check_names(model: &Model, place: &Place, source: &Source, parsed: &Parsed) -> Result<(), Located> {
    for (name, primes, span) in &parsed.names {
        let symbol = format!("{name}{}", "'".repeat(usize::from(*primes)));
        let at = source.span(Some(span.clone()));
        let reason = if model.state(name).is_some() {
            continue;
        } else if model.parameter(name).is_some() {
            (
                "a parameter is constant, its derivative is zero",
                "remove the term, or declare a state".to_owned(),
            )
        } else if let Some(i) = model.input(name) {
            ("an input has no primes", instead_of_primes(model, &model.inputs[i], *primes))
        } else if matches!(&**name, "t" | "pi") {
            ("it has no derivative here", "write the derivative as a number".to_owned())
        } else {
            return Err(undefined(model, place, name, at));
        };
        if *primes > 0 {
            let problem = Problem::Primes { place: place.clone(), symbol, reason: reason.0.into() };
            return Err(fault(problem, at, reason.1));
        }
    }
    Ok(())
}

/// How to have the derivative of an input: as an input of its own, which is taken from the same channel.
fn instead_of_primes(model: &Model, input: &Input, primes: u8) -> String {
    let (name, column) = (&input.name, &input.channel);
    if primes > 1 || input.derivative_of().is_some() {
        return "record this derivative as a channel and declare it as an input of its own, or integrate the equation \
                until no more than the first derivative of an input is left"
            .to_owned();
    }
    let channel = format!("{column}'");
    if let Some(known) = model.inputs.iter().find(|i| i.channel == channel) {
        return format!("`{}` is this derivative: write `{}`", known.name, known.name);
    }
    let mut own = format!("d{name}");
    while names(model).any(|n| *n == own) {
        own.push('_');
    }
    let hold = match input.hold {
        Hold::Zero => format!(
            " (and `hold = \"linear\"` for `{name}` if it is a measured signal: one that is kept between its samples jumps)"
        ),
        Hold::Linear => String::new(),
        Hold::BandLimited => ", with `hold = \"band_limited\"`".to_owned(),
    };
    // A unit that is not stated is not known yet.
    let text = &input.unit.text;
    let unit = if text == "1" { String::new() } else { format!("unit = \"{text}/s\", ") };
    format!(
        "declare the derivative of the channel in [inputs], `{own} = {{ {unit}channel = \"{channel}\" }}`{hold}, and write \
         `{own}`"
    )
}

fn undefined(model: &Model, place: &Place, name: &str, at: Range<usize>) -> Located {
    let known: Vec<&str> = names(model).chain(["pi"]).collect();
    // `x_dot`, `xdot` and `dx` are how other languages write x'.
    let base = |name: &str| {
        let stems = [("", "_ddot", 2), ("", "ddot", 2), ("", "_dot", 1), ("", "dot", 1), ("d", "", 1)];
        stems.iter().find_map(|(before, after, primes)| {
            let stem = name.strip_prefix(before)?.strip_suffix(after)?;
            model.state(stem).map(|_| format!("{stem}{}", "'".repeat(*primes)))
        })
    };
    let help = if let Some(derivative) = base(name) {
        format!("a time derivative is written with primes: `{derivative}`")
    } else if let Some(near) = nearest(name, known.iter().copied()) {
        format!("did you mean `{near}`?")
    } else {
        format!("declare `{name}` in [parameters], [states] or [inputs]; declared are {}", known.join(", "))
    };
    fault(Problem::Undefined { place: place.clone(), name: name.to_owned() }, at, help)
}

fn names(model: &Model) -> impl Iterator<Item = &str> {
    let inputs = model.inputs.iter().map(|i| i.name.as_str());
    let states = model.states.iter().map(|s| s.name.as_str());
    inputs.chain(states).chain(model.parameters.iter().map(|p| p.name.as_str()))
}

/// `step` wants the time first; delays and switching times are constants.
fn check_arguments(model: &Model, place: &Place, source: &Source, parsed: &Parsed) -> Result<(), Located> {
    let mut found: Option<Located> = None;
    parsed.expr.walk(&mut |e| {
        let Expr::Call(f @ (Func::Step | Func::Delay), args) = e else { return };
        let [first, second] = args.as_slice() else { return };
        let mut reject = |reason: &str, help: String| {
            let problem =
                Problem::Argument { place: place.clone(), call: e.to_string(), reason: reason.to_owned() };
            found.get_or_insert(fault(problem, source.span(parsed.span_of(e)), help));
        };
        if *f == Func::Step && *first != Expr::var("t") {
            reject("the first argument of `step` must be the time `t`", format!("write `step(t, {second})`"));
        }
        let moving =
            second.variables().into_iter().find(|(n, _)| &**n != "pi" && model.parameter(n).is_none());
        if let Some((name, _)) = moving {
            let what = if *f == Func::Delay { "the delay" } else { "the switching time" };
            reject(
                &format!("{what} must consist of parameters and numbers, found `{name}`"),
                format!("make {what} a parameter"),
            );
        }
        let value = |name: &str, _| model.parameter(name).map(|i| model.parameters[i].value);
        if *f == Func::Delay && second.eval(&value).is_some_and(|tau| tau < 0.0 || tau.is_nan()) {
            reject("the delay is negative", "a delay is zero or positive".into());
        }
    });
    found.map_or(Ok(()), Err)
}

fn check_measured_order(
    model: &Model,
    place: &Place,
    source: &Source,
    parsed: &Parsed,
) -> Result<(), Located> {
    for (name, primes, span) in &parsed.names {
        if let Some(i) = model.state(name)
            && usize::from(*primes) > model.states[i].order
        {
            let highest = format!("{name}{}", "'".repeat(model.states[i].order));
            let problem = Problem::Primes {
                place: place.clone(),
                symbol: format!("{name}{}", "'".repeat(usize::from(*primes))),
                reason: format!("the equations know derivatives up to `{highest}`"),
            };
            return Err(fault(problem, source.span(Some(span.clone())), format!("use at most `{highest}`")));
        }
    }
    Ok(())
}

/// Every state moves, and has no more initial values than it needs.
fn check_states(model: &Model, spans: &[Range<usize>], root: &DeTable<'_>) -> Result<(), Located> {
    if model.states.is_empty() {
        let problem = Problem::MissingKey { key: "states".into(), table: "the model".into() };
        let help = "add `[states]` with one line per coordinate, such as `x = { unit = \"m\" }`";
        return Err(fault(problem, root_span(root, "states"), help));
    }
    if model.equations.is_empty() {
        let problem = Problem::MissingKey { key: "equations".into(), table: "the model".into() };
        let help = "add `[equations]` with one equation per state, such as `motion = \"m*x'' + k*x = f\"`";
        return Err(fault(problem, root_span(root, "equations"), help));
    }
    for (state, span) in model.states.iter().zip(spans) {
        let name = &state.name;
        let primed = |e: &Expr| e.variables().iter().any(|(n, p)| **n == **name && *p > 0);
        if !model.equations.iter().any(|e| primed(&e.lhs) || primed(&e.rhs)) {
            let help = format!(
                "write an equation that contains `{name}'`; a quantity without dynamics is put into the \
                 equations as an expression, or follows it with a lag: `ta*{name}' + {name} = …`"
            );
            return Err(fault(Problem::Algebraic { state: name.clone() }, span.clone(), help));
        }
        if state.initial.len() > state.order {
            let item = format!("state `{name}`");
            let message =
                format!("`initial` has {} values, its order is {}", state.initial.len(), state.order);
            let meant: Vec<String> = (0..state.order).map(|p| format!("{name}{}", "'".repeat(p))).collect();
            return Err(bad(&item, message, span.clone(), format!("give at most [{}]", meant.join(", "))));
        }
    }
    Ok(())
}

fn check_counts(model: &Model, root: &DeTable<'_>, spans: &[Range<usize>]) -> Result<(), Located> {
    let (equations, states) = (model.equations.len(), model.states.len());
    if equations == states {
        return Ok(());
    }
    let list: Vec<String> = model.states.iter().map(|s| format!("`{}`", s.name)).collect();
    let help = if equations < states {
        format!("write one equation per state ({}), or make a state an input", list.join(", "))
    } else {
        format!(
            "write one equation per state ({}): join equations, or declare the missing state",
            list.join(", ")
        )
    };
    let at = match spans.get(states) {
        Some(surplus) => surplus.clone(),
        None => root_span(root, "equations"),
    };
    Err(fault(Problem::EquationCount { equations, states }, at, help))
}

/// The equations are affine in the highest derivatives, and each can be given one of its own.
fn check_solvable(
    model: &Model,
    equations: &[(Source, ParsedEquation, Range<usize>)],
) -> Result<(), Located> {
    let highest: Vec<(&str, u8)> =
        model.states.iter().map(|s| (s.name.as_str(), u8::try_from(s.order).unwrap_or(u8::MAX))).collect();
    let shown: Vec<String> =
        highest.iter().map(|(n, p)| format!("{n}{}", "'".repeat(usize::from(*p)))).collect();
    let mut contains: Vec<Vec<bool>> = Vec::new();
    for (equation, (source, parsed, _)) in model.equations.iter().zip(equations) {
        let place = Place::Equation(equation.name.clone());
        for side in [&parsed.lhs, &parsed.rhs] {
            for (_, term) in side.expr.terms() {
                if term.affine_in(&highest).is_none() {
                    return Err(not_affine(place, source.span(side.span_of(term)), term, &highest, &shown));
                }
            }
        }
        let Some((coefficients, _)) = equation.residual().affine_in(&highest) else {
            return Err(not_affine(place, source.value.clone(), &equation.residual(), &highest, &shown));
        };
        contains.push(coefficients.iter().map(|c| *c != Expr::Num(0.0)).collect());
    }
    let owner = match_equations(&contains, highest.len());
    let Some(state) = owner.iter().position(Option::is_none) else { return Ok(()) };
    let left = (0..contains.len()).find(|e| !owner.contains(&Some(*e))).unwrap_or(0);
    let quote = |i: usize| format!("`{}`", shown[i]);
    let own: Vec<usize> = (0..shown.len()).filter(|&i| contains[left][i]).collect();
    let reason = if own.is_empty() {
        let list: Vec<String> = (0..shown.len()).map(quote).collect();
        format!(
            "it contains no highest derivative ({}); no equation is left for {}",
            list.join(", "),
            quote(state)
        )
    } else {
        let list: Vec<String> = own.iter().map(|&i| quote(i)).collect();
        let taken: Vec<String> = own
            .iter()
            .filter_map(|&i| owner[i])
            .map(|e| format!("\"{}\"", model.equations[e].name))
            .collect();
        format!(
            "it contains {}, which {} determines already; no equation is left for {}",
            list.join(", "),
            taken.join(", "),
            quote(state)
        )
    };
    let problem = Problem::Singular {
        place: Place::Equation(model.equations[left].name.clone()),
        state: model.states[state].name.clone(),
        reason,
    };
    let help = format!(
        "each equation must determine the highest derivative of one state: write one that contains {}",
        quote(state)
    );
    Err(fault(problem, equations[left].0.value.clone(), help))
}

fn not_affine(
    place: Place,
    span: Range<usize>,
    term: &Expr,
    highest: &[(&str, u8)],
    shown: &[String],
) -> Located {
    let which = highest.iter().position(|(n, p)| term.contains(n, *p)).unwrap_or(0);
    let (name, primes) = highest[which];
    let mut function = None;
    term.walk(&mut |e| {
        if let Expr::Call(f, args) = e
            && args.iter().any(|a| a.contains(name, primes))
        {
            function = Some(f.name());
        }
    });
    let reason = match function {
        Some(f) => format!("it stands inside `{f}`"),
        None => "it enters as a power, in a denominator or in a product with another one".to_owned(),
    };
    let unknown = shown[which].clone();
    let help = format!("solve the equation for `{unknown}`, or express the term by lower derivatives");
    fault(Problem::NotAffine { place, term: term.to_string(), unknown, reason }, span, help)
}

/// Maximum bipartite matching by augmenting paths; for each column the row that owns it.
fn match_equations(contains: &[Vec<bool>], columns: usize) -> Vec<Option<usize>> {
    fn augment(row: usize, contains: &[Vec<bool>], seen: &mut [bool], owner: &mut [Option<usize>]) -> bool {
        for column in 0..owner.len() {
            if contains[row][column] && !seen[column] {
                seen[column] = true;
                let free = owner[column].is_none_or(|other| augment(other, contains, seen, owner));
                if free {
                    owner[column] = Some(row);
                    return true;
                }
            }
        }
        false
    }
    let mut owner = vec![None; columns];
    for row in 0..contains.len() {
        augment(row, contains, &mut vec![false; columns], &mut owner);
    }
    owner
}

/// Measured states first, then the explicit measurements; each channel once.
fn collect_measurements(
    model: &mut Model,
    explicit: Vec<(Measurement, Option<Unit>, Range<usize>)>,
    root: &DeTable<'_>,
) -> Result<(), Located> {
    let conflict = |item: String, message: String, span: Range<usize>, help: &str| {
        Err(fault(Problem::Measurement { item, message }, span, help))
    };
    for (measurement, _, span) in &explicit {
        let channel = &measurement.channel;
        if let Some(i) = model.state(channel)
            && let Some(own) = &model.states[i].channel
            && own != channel
        {
            let message =
                format!("the state of this name is measured by channel `{own}`, and by this expression too");
            let help = "remove the state's `channel`, or give it `measured = false`";
            return conflict(format!("measurement \"{channel}\""), message, span.clone(), help);
        }
    }
    let mut measurements: Vec<Measurement> = Vec::new();
    for state in &model.states {
        let Some(channel) = &state.channel else { continue };
        if explicit.iter().any(|(m, ..)| m.channel == *channel) {
            continue;
        }
        if let Some(other) = measurements.iter().find(|m| m.channel == *channel) {
            let message = format!("channel `{channel}` measures `{}` already", other.expr);
            let span = section(root, "states")?
                .into_iter()
                .find(|(name, ..)| *name == state.name)
                .map_or(0..0, |(_, span, _)| span);
            let help = "give each state a channel of its own, or `measured = false`";
            return conflict(format!("state `{}`", state.name), message, span, help);
        }
        measurements.push(Measurement {
            channel: channel.clone(),
            expr: Expr::var(&state.name),
            unit: state.unit.clone(),
        });
    }
    measurements.extend(explicit.into_iter().map(|(m, ..)| m));
    model.measurements = measurements;
    Ok(())
}

/// Gives every measurement the unit in which its results are printed.
fn set_measurement_units(
    model: &mut Model,
    explicit: &[(Measurement, Option<Unit>, Range<usize>)],
) -> Result<(), Located> {
    for i in 0..model.measurements.len() {
        let measurement = &model.measurements[i];
        let stated = explicit.iter().find(|(m, ..)| m.channel == measurement.channel);
        let default = model.default_measurement_unit(&measurement.expr).map_err(|e| (e, None))?;
        let unit = match stated {
            Some((_, Some(unit), span)) if !unit.dimension.same(&default.dimension) => {
                let item = format!("measurement \"{}\"", measurement.channel);
                let message = format!(
                    "its unit is {}, but `{}` is in {}",
                    unit.text, measurement.expr, default.dimension
                );
                return Err(bad(
                    &item,
                    message,
                    span.clone(),
                    format!("write `unit = \"{}\"`", default.text),
                ));
            }
            Some((_, Some(unit), span)) if unit.offset != 0.0 && model.is_difference(&measurement.expr) => {
                let message = format!(
                    "its unit {} is that of an absolute temperature, but `{}` is a difference",
                    unit.text, measurement.expr
                );
                let item = format!("measurement \"{}\"", measurement.channel);
                return Err(bad(&item, message, span.clone(), "write `unit = \"K\"`"));
            }
            Some((_, Some(unit), _)) => unit.clone(),
            _ => default,
        };
        model.measurements[i].unit = unit;
    }
    Ok(())
}

impl Model {
    /// The unit of an expression if none is stated: that of the first state in it with the same
    /// dimension, else the SI unit. A difference of temperatures has no zero, and is in K.
    pub(crate) fn default_measurement_unit(&self, expr: &Expr) -> Result<Unit, ModelError> {
        let dimension = self.dimension_of(expr)?;
        let difference = self.is_difference(expr);
        let of_state = expr.variables().into_iter().find_map(|(name, primes)| {
            let unit = &self.states[self.state(&name)?].unit;
            let fits = unit.dimension.same(&dimension) && !(difference && unit.offset != 0.0);
            (primes == 0 && fits).then(|| unit.clone())
        });
        Ok(of_state.unwrap_or_else(|| Unit::si(dimension)))
    }
}

impl Hold {
    /// The hold of this name in the model language.
    pub fn from_name(name: &str) -> Option<Hold> {
        [Hold::Zero, Hold::Linear, Hold::BandLimited].into_iter().find(|h| h.name() == name)
    }

    /// Its name in the model language.
    pub fn name(self) -> &'static str {
        match self {
            Hold::Zero => "zero",
            Hold::Linear => "linear",
            Hold::BandLimited => "band_limited",
        }
    }
}
