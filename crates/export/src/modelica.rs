//! A model in Modelica.

use std::fmt::Write as _;

use greybox_model::expr::Func;
use greybox_model::{Expr, Model, System, Table, Unit};

use crate::error::ExportError;
use crate::infix::{Dialect, atom, number, quoted, text};
use crate::names::{Names, ascii};

/// Keywords of Modelica (Language Specification 3.6, 2.3.3), its functions and predefined types, and names
/// that the model itself uses.
const TAKEN: &[&str] = &[
    "algorithm",
    "and",
    "annotation",
    "block",
    "break",
    "class",
    "connect",
    "connector",
    "constant",
    "constrainedby",
    "der",
    "discrete",
    "each",
    "else",
    "elseif",
    "elsewhen",
    "encapsulated",
    "end",
    "enumeration",
    "equation",
    "expandable",
    "extends",
    "external",
    "false",
    "final",
    "flow",
    "for",
    "function",
    "if",
    "import",
    "impure",
    "in",
    "initial",
    "inner",
    "input",
    "loop",
    "model",
    "not",
    "operator",
    "or",
    "outer",
    "output",
    "package",
    "parameter",
    "partial",
    "protected",
    "public",
    "pure",
    "record",
    "redeclare",
    "replaceable",
    "return",
    "stream",
    "then",
    "true",
    "type",
    "when",
    "while",
    "within",
    "Real",
    "Integer",
    "Boolean",
    "String",
    "Clock",
    "StateSelect",
    "AssertionLevel",
    "ExternalObject",
    "abs",
    "sign",
    "sqrt",
    "div",
    "mod",
    "rem",
    "ceil",
    "floor",
    "integer",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "atan2",
    "sinh",
    "cosh",
    "tanh",
    "exp",
    "log",
    "log10",
    "delay",
    "cardinality",
    "homotopy",
    "semiLinear",
    "inStream",
    "actualStream",
    "spatialDistribution",
    "getInstanceName",
    "noEvent",
    "smooth",
    "sample",
    "pre",
    "edge",
    "change",
    "reinit",
    "terminal",
    "assert",
    "terminate",
    "min",
    "max",
    "sum",
    "product",
    "size",
    "ndims",
    "scalar",
    "vector",
    "matrix",
    "identity",
    "diagonal",
    "zeros",
    "ones",
    "fill",
    "linspace",
    "transpose",
    "outerProduct",
    "symmetric",
    "cross",
    "skew",
    "cat",
    "array",
    "promote",
    "time",
    "sign_width",
    "Modelica",
];

/// The model as a Modelica model: parameters with units, `der` for primes, `delay`, and `if` for the
/// functions that Modelica lacks. The equations stand as they are written in the model; all numbers are SI.
///
/// The set-valued `sign(0)`, by which friction sticks, has no counterpart in Modelica: `sign(x)` becomes the
/// straight line x/`sign_width` within ±`sign_width` and ±1 outside, in SI of its argument, so that a body
/// that sticks creeps by less than `sign_width`. States start from `initial` of the model and from zero where
/// it says nothing.
///
/// ```
/// use greybox_model::Model;
/// let model = Model::from_toml(
///     "[states]\nx = { unit = \"m\" }\n[parameters]\nk = { value = 40, unit = \"1/s^2\" }\n[equations]\ncart = \"x'' + k*x = 0\"\n",
///     "cart.toml",
/// )?;
/// let text = greybox_export::modelica(&model)?;
/// assert!(text.contains("parameter Real k(unit = \"1/s2\") = 40;"));
/// assert!(text.contains("der(x_dot) + k*x = 0 \"cart\";"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`ExportError::Compile`] for a model that was edited by hand into nonsense.
pub fn modelica(model: &Model) -> Result<String, ExportError> {
    System::compile(model)?;
    let mut names = Names::new(TAKEN);
    let class = names.fresh(&class_name(&model.name));
    for p in &model.parameters {
        names.add(&p.name, 0);
    }
    for i in &model.inputs {
        names.add(&i.name, 0);
    }
    for s in &model.states {
        for primes in 0..s.order {
            names.add(&s.name, primes as u8);
        }
    }
    let outputs: Vec<String> =
        model.measurements.iter().map(|m| names.fresh(&format!("y_{}", ascii(&m.channel)))).collect();
    let tables: Vec<(Expr, String)> =
        tables(model).into_iter().map(|call| (call, names.fresh("table"))).collect();
    let mut writer = Text { names: &names, model, signs: false, tables: &tables };
    let mut equations = String::new();
    for s in &model.states {
        for primes in 1..s.order as u8 {
            let (own, below) = (writer.symbol(&s.name, primes), writer.symbol(&s.name, primes - 1));
            let _ = writeln!(equations, "  der({below}) = {own};");
        }
    }
    for (call, own) in &tables {
        if let Expr::Call(_, args) = call
            && let Some(table) = Table::of(args)
        {
            let _ = writeln!(equations, "  {own} = {};", branches(&table, &mut writer));
        }
    }
    for e in &model.equations {
        let (lhs, rhs) = (text(&e.lhs, &mut writer), text(&e.rhs, &mut writer));
        let _ = writeln!(equations, "  {lhs} = {rhs} {};", string(&e.name));
    }
    for (m, own) in model.measurements.iter().zip(&outputs) {
        let _ = writeln!(equations, "  {own} = {};", text(&m.expr, &mut writer));
    }

    let mut out = String::new();
    let _ = writeln!(out, "model {class} {}", string(&model.name));
    let _ = writeln!(
        out,
        "  // Made by greybox {} from a model file. All numbers are SI; time counts from zero.",
        env!("CARGO_PKG_VERSION")
    );
    for p in &model.parameters {
        let own = writer.symbol(&p.name, 0);
        let attributes = attributes(p.unit.as_ref().and_then(unit), &[]);
        let _ =
            writeln!(out, "  parameter Real {own}{attributes} = {}{};", number(p.value), said(&own, &p.name));
    }
    if writer.signs {
        out.push_str("  parameter Real sign_width(min = 0) = 1e-4 \"Where sign(x) is a straight line: |x| < sign_width, SI of x\";\n");
    }
    for i in &model.inputs {
        let own = writer.symbol(&i.name, 0);
        let _ = writeln!(out, "  input Real {own}{}{};", attributes(unit(&i.unit), &[]), said(&own, &i.name));
    }
    for s in &model.states {
        for primes in 0..s.order {
            let own = writer.symbol(&s.name, primes as u8);
            let start = s.initial.get(primes).copied().unwrap_or(0.0);
            let unit = if primes == 0 { unit(&s.unit) } else { None };
            let start = [format!("start = {}", number(start)), "fixed = true".to_owned()];
            let name = Expr::prime(&s.name, primes as u8).to_string();
            let _ = writeln!(out, "  Real {own}{}{};", attributes(unit, &start), said(&own, &name));
        }
    }
    for (m, own) in model.measurements.iter().zip(&outputs) {
        let _ =
            writeln!(out, "  output Real {own}{} {};", attributes(unit(&m.unit), &[]), string(&m.channel));
    }
    for (_, own) in &tables {
        let _ = writeln!(out, "  Real {own};");
    }
    let _ = write!(out, "equation\n{equations}end {class};\n");
    Ok(out)
}

/// Every table of the model, once.
fn tables(model: &Model) -> Vec<Expr> {
    let sides = model.equations.iter().flat_map(|e| [&e.lhs, &e.rhs]);
    let mut all: Vec<Expr> = Vec::new();
    sides.chain(model.measurements.iter().map(|m| &m.expr)).for_each(|e| {
        e.walk(&mut |e| {
            if matches!(e, Expr::Call(Func::Table, _)) && !all.contains(e) {
                all.push(e.clone());
            }
        });
    });
    all
}

/// `if x <= k1 then v1 elseif x < k2 then v1 + (v2 - v1)*(x - k1)/(k2 - k1) … else vn`
fn branches(table: &Table<'_>, writer: &mut Text<'_>) -> String {
    let x = atom(table.x, writer);
    let knots = &table.knots;
    let values: Vec<String> = table.values.iter().map(|v| atom(v, writer)).collect();
    let mut out = format!("if {x} <= {} then {}", number(knots[0]), values[0]);
    for (k, v) in knots.windows(2).zip(values.windows(2)) {
        let from = atom(&Expr::Num(k[0]), writer);
        let _ = write!(
            out,
            " elseif {x} < {} then {} + ({} - {})*({x} - {from})/{}",
            number(k[1]),
            v[0],
            v[1],
            v[0],
            number(k[1] - k[0])
        );
    }
    let _ = write!(out, " else {}", values[values.len() - 1]);
    out
}

struct Text<'a> {
    names: &'a Names,
    model: &'a Model,
    /// Whether a `sign` was written.
    signs: bool,
    /// The tables, and the variables that have their values.
    tables: &'a [(Expr, String)],
}

impl Dialect for Text<'_> {
    const POWER: &'static str = "^";

    fn symbol(&mut self, name: &str, primes: u8) -> String {
        if let Some(own) = self.names.get(name, primes) {
            return own.to_owned();
        }
        // The highest derivative has no variable of its own.
        if self.model.state(name).is_some() {
            let below = self.names.get(name, primes.saturating_sub(1)).unwrap_or(name);
            return format!("der({below})");
        }
        if name == "pi" { number(std::f64::consts::PI) } else { "time".to_owned() }
    }

    fn call(&mut self, function: Func, arguments: &[Expr]) -> String {
        let written: Vec<String> = arguments.iter().map(|a| text(a, self)).collect();
        let a = &written[0];
        // Behind a sign.
        let b = atom(arguments.get(1).unwrap_or(&arguments[0]), self);
        let name = match function {
            Func::Sign => {
                self.signs = true;
                return format!(
                    "(if {a} > sign_width then 1 elseif {a} < -sign_width then -1 else {b}/sign_width)"
                );
            }
            Func::Deadzone => {
                return format!("(if {a} > {b} then {a} - {b} elseif {a} < -{b} then {a} + {b} else 0)");
            }
            Func::Saturate => return format!("(if {a} > {b} then {b} elseif {a} < -{b} then -{b} else {a})"),
            Func::Step => return format!("(if {a} < {b} then 0 else 1)"),
            Func::Table => {
                let own = |(call, own): &(Expr, String)| {
                    matches!(call, Expr::Call(_, known) if known == arguments).then(|| own.clone())
                };
                return self.tables.iter().find_map(own).unwrap_or_default();
            }
            Func::Ln => "log",
            // Modelica's own, with its events.
            _ => function.name(),
        };
        format!("{name}({})", written.join(", "))
    }
}

/// `(unit = "…", start = …)`
fn attributes(unit: Option<String>, others: &[String]) -> String {
    let unit = unit.map(|u| format!("unit = {}", string(&u)));
    let all: Vec<String> = unit.into_iter().chain(others.iter().cloned()).collect();
    if all.is_empty() { String::new() } else { format!("({})", all.join(", ")) }
}

/// The comment of a variable that is not called as the model calls it.
fn said(own: &str, name: &str) -> String {
    if own == name { String::new() } else { format!(" {}", string(name)) }
}

/// A string; Modelica's escapes are those of C.
fn string(text: &str) -> String {
    quoted(text, |out, c| out.push(if c.is_control() { ' ' } else { c }))
}

/// The letters and digits of a name, each word with a capital.
fn class_name(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|w| !w.is_empty());
    let joined: String = words.map(|w| w[..1].to_ascii_uppercase() + &w[1..]).collect();
    match joined.starts_with(|c: char| c.is_ascii_alphabetic()) {
        true => joined,
        false => format!("Model{joined}"),
    }
}

/// The unit in SI base units, as Modelica writes units (Specification 3.6, chapter 19): `kg.m2/(s2.A)`. `None`
/// where it has none, a fractional exponent or a dimension that only the model knows.
fn unit(unit: &Unit) -> Option<String> {
    let exponents = unit.dimension.si_exponents();
    if exponents.iter().any(|e| e.fract() != 0.0) || unit.dimension.declared().next().is_some() {
        return None;
    }
    // Plane angles are plain numbers to a model, but a reader wants to know.
    if unit.dimension.is_none() {
        return Some(if unit.text == "rad" || unit.text == "deg" {
            "rad".to_owned()
        } else {
            "1".to_owned()
        });
    }
    let part = |sign: f64| -> Vec<String> {
        ["m", "kg", "s", "A", "K", "mol", "cd"]
            .iter()
            .zip(exponents)
            .filter(|(_, e)| e * sign > 0.0)
            .map(
                |(symbol, e)| {
                    if e.abs() == 1.0 { (*symbol).to_owned() } else { format!("{symbol}{}", e.abs()) }
                },
            )
            .collect()
    };
    let (above, below) = (part(1.0), part(-1.0));
    let above = if above.is_empty() { "1".to_owned() } else { above.join(".") };
    Some(match below.as_slice() {
        [] => above,
        [one] => format!("{above}/{one}"),
        _ => format!("{above}/({})", below.join(".")),
    })
}
