//! A model as a Python module that simulates it.

use std::fmt::Write as _;

use greybox_model::expr::Func;
use greybox_model::system::CompileError;
use greybox_model::{Expr, Hold, Model, System, Unit};

use crate::error::ExportError;
use crate::infix::{Dialect, number, quoted, text};
use crate::names::Names;

/// The part that is the same for every model: inputs between samples, events, delays, steps.
const RUNTIME: &str = include_str!("python/runtime.py");

/// Keywords of Python 3 (Language Reference, 2.3.1), and the module that the equations call.
const TAKEN: &[&str] = &[
    "False", "None", "True", "and", "as", "assert", "async", "await", "break", "case", "class", "continue",
    "def", "del", "elif", "else", "except", "finally", "for", "from", "global", "if", "import", "in", "is",
    "lambda", "match", "math", "nonlocal", "not", "or", "pass", "raise", "return", "try", "type", "while",
    "with", "yield", "abs", "min", "max", "t",
];

/// The model as a Python module of its own, on NumPy and SciPy:
///
/// * `simulate(t, inputs, initial, **parameters)` computes what `greybox simulate` computes, to the
///   tolerance of the integration: the same holds between samples, friction that truly sticks, delays;
/// * `rhs(t, x, u)` and `outputs(t, x, u)` evaluate the equations
///
/// ```text
/// M(t, x, u, p) z + h(t, x, u, p) = 0,      z: the highest derivatives
/// ```
///
///   and the channels at one point, for tools that bring their own integrator.
///
/// All numbers are SI. Names stay as they are in the model: they are keys of dictionaries, and parameters
/// are keyword arguments. No text of the model becomes code.
///
/// ```
/// use greybox_model::Model;
/// let model = Model::from_toml(
///     "[states]\nx = { unit = \"m\" }\n[parameters]\nk = { value = 40, unit = \"1/s^2\" }\n[equations]\ncart = \"x'' + k*x = 0\"\n",
///     "cart.toml",
/// )?;
/// let module = greybox_export::python(&model)?;
/// assert!(module.contains("def simulate(t, inputs=None, initial=None, /, **parameters):"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`ExportError::Refused`] for a `sign` whose argument holds a `delay`: whether it sticks then depends on
/// the rate of the past. [`ExportError::Compile`] for a model that was edited by hand into nonsense.
pub fn python(model: &Model) -> Result<String, ExportError> {
    let system = System::compile(model)?;
    let mut names = Names::new(TAKEN);
    let parameters: Vec<String> = model.parameters.iter().map(|p| names.add(&p.name, 0)).collect();
    let mut states = Vec::new();
    let mut highest = Vec::new();
    for s in &model.states {
        let order = s.order as u8;
        states.extend((0..order).map(|primes| names.add(&s.name, primes)));
        highest.push(names.add(&s.name, order));
    }
    let inputs: Vec<String> = model.inputs.iter().map(|i| names.add(&i.name, 0)).collect();
    let slopes: Vec<String> = inputs.iter().map(|i| names.fresh(&format!("{i}_slope"))).collect();
    let module = Module { model, system: &system, names, parameters, states, highest, inputs, slopes };
    module.write()
}

struct Module<'a> {
    model: &'a Model,
    system: &'a System,
    names: Names,
    parameters: Vec<String>,
    states: Vec<String>,
    highest: Vec<String>,
    inputs: Vec<String>,
    slopes: Vec<String>,
}

/// The delays and the switches of some expressions, as they are met.
struct Text<'a> {
    names: &'a Names,
    /// Argument and delay; a delay inside a delay stands before it.
    delays: Vec<(Expr, Expr)>,
    /// Non-smooth functions whose branch the integrator keeps; `None` where each is taken at the point.
    switches: Option<Vec<(Func, Vec<Expr>)>>,
}

impl Dialect for Text<'_> {
    const POWER: &'static str = "**";

    fn power(&mut self, base: &Expr, exponent: &Expr) -> Option<String> {
        // Python makes a fractional power of a negative number complex; the model language has no number there.
        let whole = exponent.constant().is_some_and(|v| v.fract() == 0.0);
        (!whole).then(|| format!("math.pow({}, {})", text(base, self), text(exponent, self)))
    }

    fn symbol(&mut self, name: &str, primes: u8) -> String {
        match self.names.get(name, primes) {
            Some(identifier) => identifier.to_owned(),
            None if name == "pi" => "math.pi".to_owned(),
            // Compiled before: what is left is the time.
            None => "t".to_owned(),
        }
    }

    fn call(&mut self, function: Func, arguments: &[Expr]) -> String {
        if function == Func::Delay {
            return self.delay(&arguments[0], &arguments[1]);
        }
        let written: Vec<String> = arguments.iter().map(|a| text(a, self)).collect();
        let written = written.join(", ");
        if let (Some(switches), true) = (&mut self.switches, is_switch(function)) {
            let known = switches.iter().position(|(f, a)| *f == function && a == arguments);
            let k = known.unwrap_or_else(|| {
                switches.push((function, arguments.to_vec()));
                switches.len() - 1
            });
            return format!("_switch({k}, {written})");
        }
        let name = match function {
            Func::Sin => "math.sin",
            Func::Cos => "math.cos",
            Func::Tan => "math.tan",
            Func::Exp => "math.exp",
            Func::Ln => "math.log",
            Func::Sqrt => "math.sqrt",
            Func::Tanh => "math.tanh",
            Func::Atan => "math.atan",
            Func::Abs => "abs",
            Func::Min => "min",
            Func::Max => "max",
            Func::Sign => "_sign",
            Func::Deadzone => "_deadzone",
            Func::Saturate => "_saturate",
            Func::Table => {
                let written: Vec<String> = arguments.iter().map(|a| text(a, self)).collect();
                let n = written.len() / 2;
                let (knots, values) = (written[1..=n].join(", "), written[n + 1..].join(", "));
                return format!("_table({}, ({knots}), ({values}))", written[0]);
            }
            Func::Step | Func::Delay => "_step",
        };
        format!("{name}({written})")
    }
}

impl Text<'_> {
    fn delay(&mut self, argument: &Expr, tau: &Expr) -> String {
        // Those inside it first.
        argument.walk(&mut |e| {
            if let Expr::Call(Func::Delay, inner) = e {
                self.delay(&inner[0], &inner[1]);
            }
        });
        let known = self.delays.iter().position(|(a, d)| a == argument && d == tau);
        let k = known.unwrap_or_else(|| {
            self.delays.push((argument.clone(), tau.clone()));
            self.delays.len() - 1
        });
        format!("_d[{k}]")
    }
}

fn is_switch(f: Func) -> bool {
    matches!(f, Func::Sign | Func::Abs | Func::Min | Func::Max | Func::Deadzone | Func::Saturate | Func::Step)
}

impl Module<'_> {
    fn text(&self) -> Text<'_> {
        Text { names: &self.names, delays: Vec::new(), switches: None }
    }

    fn write(&self) -> Result<String, ExportError> {
        let (model, system) = (self.model, self.system);
        self.no_delay_in_sign()?;
        let chains: Vec<(&str, u8)> = model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let mut equations = Text { switches: Some(Vec::new()), ..self.text() };
        let (mut mass, mut force) = (Vec::new(), Vec::new());
        for equation in &model.equations {
            let split = equation.residual().affine_in(&chains);
            let (row, rest) =
                split.ok_or_else(|| CompileError::NotAffine { equation: equation.name.clone() })?;
            mass.push(row.iter().map(|m| text(m, &mut equations)).collect::<Vec<_>>());
            force.push(text(&rest, &mut equations));
        }
        let mut channels = self.text();
        let shown: Vec<String> = model.measurements.iter().map(|m| text(&m.expr, &mut channels)).collect();

        let mut out = String::new();
        self.head(&mut out, &equations, &channels);
        self.equations(&mut out, &equations, &mass, &force);
        let signature = "t, _x, _z, _u, _d, _p";
        let _ = writeln!(out, "\n\ndef _outputs({signature}):\n    \"\"\"What the channels show.\"\"\"");
        let all: Vec<&Expr> = model.measurements.iter().map(|m| &m.expr).collect();
        self.unpack(&mut out, &all, true);
        list(&mut out, "    return [", &shown);
        self.delays(&mut out, "_delayed", "_delay_times", "_DELAYED", &equations.delays);
        self.delays(&mut out, "_delayed_output", "_output_delay_times", "_DELAYED_OUTPUTS", &channels.delays);
        self.sign_rates(&mut out, equations.switches.as_deref().unwrap_or_default());
        let last: Vec<String> = system
            .offsets
            .iter()
            .zip(&system.orders)
            .map(|(at, order)| (at + order - 1).to_string())
            .collect();
        let _ = writeln!(
            out,
            "# Where each coordinate's chain ends in the state vector.\nLAST = [{}]",
            last.join(", ")
        );
        let _ = writeln!(
            out,
            "OUTPUTS_NEED_HIGHEST = {}\n\n",
            if system.output_needs_z { "True" } else { "False" }
        );
        out.push_str(RUNTIME);
        Ok(out)
    }

    fn no_delay_in_sign(&self) -> Result<(), ExportError> {
        for equation in &self.model.equations {
            let mut found = false;
            equation.residual().walk(&mut |e| {
                if let Expr::Call(Func::Sign, arguments) = e {
                    arguments[0].walk(&mut |inner| found |= matches!(inner, Expr::Call(Func::Delay, _)));
                }
            });
            if found {
                return Err(ExportError::Refused {
                    equation: equation.name.clone(),
                    function: "sign",
                    language: "Python",
                    reason: "whether the sign of a delayed expression sticks depends on the rate of the past",
                    help: "let the sign act on a state of its own, or write tanh(…/width) for it",
                });
            }
        }
        Ok(())
    }

    fn head(&self, out: &mut String, equations: &Text<'_>, channels: &Text<'_>) {
        let model = self.model;
        let _ = write!(
            out,
            "\"\"\"A simulation, made by greybox {} from a model file; needs NumPy and SciPy. All numbers are SI.\n\n\
             simulate(t, inputs, initial, **parameters) is what `greybox simulate` computes.\n\"\"\"\n\n\
             import bisect\nimport collections\nimport math\nimport warnings\n\n\
             import numpy as np\nimport scipy.integrate\n\n",
            env!("CARGO_PKG_VERSION")
        );
        let _ = writeln!(out, "NAME = {}\nEQUATIONS = {{", literal(&model.name));
        for equation in &model.equations {
            let _ = writeln!(out, "    {}: {},", literal(&equation.name), literal(&equation.to_string()));
        }
        out.push_str("}\n# name: value, SI\nPARAMETERS = {\n");
        for p in &model.parameters {
            let unit = p.unit.as_ref().map(|u| comment(&format!("in {}", u.text))).unwrap_or_default();
            let _ = writeln!(out, "    {}: {},{unit}", literal(&p.name), number(p.value));
        }
        out.push_str("}\n# The state vector.\nSTATES = (\n");
        for s in &model.states {
            for primes in 0..s.order {
                let unit = if primes == 0 { comment(&s.unit.text) } else { String::new() };
                let name = Expr::prime(&s.name, primes as u8).to_string();
                let _ = writeln!(out, "    {},{unit}", literal(&name));
            }
        }
        out.push_str(")\n# What the model itself says of the start.\nINITIAL = {");
        let initial = model.states.iter().filter(|s| !s.initial.is_empty());
        let initial: Vec<String> = initial
            .map(|s| {
                let values: Vec<String> = s.initial.iter().map(|&v| number(v)).collect();
                format!("{}: [{}]", literal(&s.name), values.join(", "))
            })
            .collect();
        let _ = writeln!(out, "{}}}", initial.join(", "));
        let holds: Vec<String> = model
            .inputs
            .iter()
            .map(|i| {
                let hold = match i.hold {
                    Hold::Zero => "zero",
                    Hold::Linear => "linear",
                    Hold::BandLimited => "band_limited",
                };
                format!("{}: \"{hold}\"", literal(&i.name))
            })
            .collect();
        let _ = writeln!(
            out,
            "# What an input does between its samples: zero | linear | band_limited\nHOLDS = {{{}}}",
            holds.join(", ")
        );
        out.push_str("# name: unit in the model, and SI value of one\n");
        units(out, "INPUTS", model.inputs.iter().map(|i| (&i.name, &i.unit)));
        units(out, "CHANNELS", model.measurements.iter().map(|m| (&m.channel, &m.unit)));
        let written = |delays: &[(Expr, Expr)]| -> Vec<String> {
            delays
                .iter()
                .map(|(a, tau)| Expr::call(Func::Delay, vec![a.clone(), tau.clone()]).to_string())
                .collect()
        };
        tuple(out, "DELAYED", written(&equations.delays).into_iter());
        tuple(out, "DELAYED_OUTPUTS", written(&channels.delays).into_iter());
        out.push_str("# Non-smooth functions of the equations; _equations calls them by number.\n");
        let switches = equations.switches.as_deref().unwrap_or_default();
        tuple(out, "SWITCHES", switches.iter().map(|(f, _)| f.name().to_owned()));
        let state = |e: &Expr| self.state_index(e).map_or("None".to_owned(), |k| k.to_string());
        let states: Vec<String> = switches.iter().map(|(_, a)| state(&a[0])).collect();
        let _ = writeln!(
            out,
            "# The state whose sign is taken, where it is one.\nSIGN_OF_STATE = [{}]",
            states.join(", ")
        );
    }

    /// The index in the state vector of an expression that is one of its entries.
    fn state_index(&self, e: &Expr) -> Option<usize> {
        let Expr::Var { name, primes } = e else { return None };
        let k = self.model.state(name)?;
        (usize::from(*primes) < self.system.orders[k]).then(|| self.system.offsets[k] + usize::from(*primes))
    }

    fn equations(&self, out: &mut String, equations: &Text<'_>, mass: &[Vec<String>], force: &[String]) {
        out.push_str("\n\ndef _equations(t, _x, _u, _d, _p, _switch):\n    \"\"\"M and h of M z + h = 0, row by row as in EQUATIONS.\"\"\"\n");
        let residuals: Vec<Expr> = self.model.equations.iter().map(|e| e.residual()).collect();
        self.unpack(out, &residuals.iter().collect::<Vec<_>>(), false);
        for (k, (function, arguments)) in equations.switches.iter().flatten().enumerate() {
            let call = Expr::call(*function, arguments.clone()).to_string();
            let _ = writeln!(out, "  {}", comment(&format!("_switch({k}): {call}")));
        }
        let rows: Vec<String> = mass.iter().map(|row| format!("[{}]", row.join(", "))).collect();
        list(out, "    _mass = [", &rows);
        list(out, "    _force = [", force);
        out.push_str("    return _mass, _force\n");
    }

    /// Names for what the expressions read; the highest derivatives only where they are at hand.
    fn unpack(&self, out: &mut String, expressions: &[&Expr], highest: bool) {
        let model = self.model;
        let reads = |name: &str| expressions.iter().any(|e| e.mentions(name));
        let of_highest =
            model.states.iter().any(|s| expressions.iter().any(|e| e.contains(&s.name, s.order as u8)));
        let groups = [
            (&self.parameters, "_p", model.parameters.iter().any(|p| reads(&p.name))),
            (&self.states, "_x", model.states.iter().any(|s| reads(&s.name))),
            (&self.highest, "_z", highest && of_highest),
            (&self.inputs, "_u", model.inputs.iter().any(|i| reads(&i.name))),
        ];
        for (names, from, read) in groups {
            if read {
                wrapped(out, names, from);
            }
        }
    }

    /// One function per delayed expression, the table of them, and the function of their delays.
    fn delays(&self, out: &mut String, function: &str, times: &str, table: &str, delays: &[(Expr, Expr)]) {
        let mut rows = Vec::new();
        let mut taus = Vec::new();
        for (k, (argument, tau)) in delays.iter().enumerate() {
            // The inner delays have the numbers that they have among all.
            let mut inner = Text { delays: delays[..k].to_vec(), ..self.text() };
            let value = text(argument, &mut inner);
            let _ = writeln!(out, "\n\ndef {function}_{k}(t, _x, _u, _d, _p):");
            self.unpack(out, &[argument], false);
            let _ = writeln!(out, "    return {value}");
            let on_state = self.model.states.iter().any(|s| argument.mentions(&s.name));
            let mut nested = false;
            argument.walk(&mut |e| nested |= matches!(e, Expr::Call(Func::Delay, _)));
            let truth = |b: bool| if b { "True" } else { "False" };
            let state = self.state_index(argument).map_or("None".to_owned(), |s| s.to_string());
            rows.push(format!("_Delay({function}_{k}, {}, {}, {state})", truth(on_state), truth(nested)));
            taus.push(text(tau, &mut self.text()));
        }
        let _ = writeln!(out, "\n\ndef {times}(_p):");
        let all: Vec<&Expr> = delays.iter().map(|(_, tau)| tau).collect();
        self.unpack(out, &all, false);
        list(out, "    return [", &taus);
        if function == "_delayed" {
            out.push_str(
                "\n\n_Delay = collections.namedtuple(\"_Delay\", \"function on_state nested state\")\n",
            );
        } else {
            out.push_str("\n\n");
        }
        list(out, &format!("{table} = ["), &rows);
    }

    /// For each sign how its argument changes: the gradient in the state, and the rate with the state held.
    fn sign_rates(&self, out: &mut String, switches: &[(Func, Vec<Expr>)]) {
        let mut table = Vec::new();
        for (k, (function, arguments)) in switches.iter().enumerate() {
            if *function != Func::Sign {
                table.push("None".to_owned());
                continue;
            }
            let argument = &arguments[0];
            let states =
                self.model.states.iter().flat_map(|s| (0..s.order).map(|primes| (&s.name, primes as u8)));
            let gradient: Vec<Expr> =
                states.map(|(name, primes)| argument.derivative(name, primes)).collect();
            let mut rate = vec![(argument.derivative("t", 0), None)];
            rate.extend(
                self.model
                    .inputs
                    .iter()
                    .zip(&self.slopes)
                    .map(|(i, slope)| (argument.derivative(&i.name, 0), Some(slope))),
            );
            rate.retain(|(e, _)| *e != Expr::Num(0.0));
            let mut writer = self.text();
            let gradient_text: Vec<String> = gradient.iter().map(|g| text(g, &mut writer)).collect();
            let terms: Vec<String> = rate
                .iter()
                .map(|(e, slope)| match slope {
                    None => format!("({})", text(e, &mut writer)),
                    Some(slope) => format!("({})*{slope}", text(e, &mut writer)),
                })
                .collect();
            let _ = writeln!(out, "\n\ndef _sign_rate_{k}(t, _x, _u, _slopes, _p):");
            let all: Vec<&Expr> = gradient.iter().chain(rate.iter().map(|(e, _)| e)).collect();
            self.unpack(out, &all, false);
            if rate.iter().any(|(_, slope)| slope.is_some()) {
                wrapped(out, &self.slopes, "_slopes");
            }
            let rate_text = if terms.is_empty() { "0.0".to_owned() } else { terms.join(" + ") };
            let _ = writeln!(out, "    return [{}], {rate_text}", gradient_text.join(", "));
            table.push(format!("_sign_rate_{k}"));
        }
        out.push_str("\n\n");
        list(out, "_SIGN_RATES = [", &table);
    }
}

/// `NAME = {"a": ("mm", 0.001)}`; what has a zero of its own is given in SI.
fn units<'a>(out: &mut String, name: &str, entries: impl Iterator<Item = (&'a String, &'a Unit)>) {
    let entries: Vec<String> = entries
        .map(|(name, unit)| {
            let si = (unit.offset != 0.0).then(|| Unit::si(unit.dimension));
            let unit = si.as_ref().unwrap_or(unit);
            format!("{}: ({}, {})", literal(name), literal(&unit.text), number(unit.factor))
        })
        .collect();
    let _ = writeln!(out, "{name} = {{{}}}", entries.join(", "));
}

/// `NAME = ("a", "b")`
fn tuple(out: &mut String, name: &str, texts: impl Iterator<Item = String>) {
    let texts: Vec<String> = texts.map(|t| literal(&t)).collect();
    let comma = if texts.len() == 1 { "," } else { "" };
    let _ = writeln!(out, "{name} = ({}{comma})", texts.join(", "));
}

/// `head` and the elements, one a line where there are several.
fn list(out: &mut String, head: &str, elements: &[String]) {
    let indent = " ".repeat(head.len() - head.trim_start().len());
    match elements {
        [] => {
            let _ = writeln!(out, "{head}]");
        }
        [one] => {
            let _ = writeln!(out, "{head}{one}]");
        }
        _ => {
            let _ = writeln!(out, "{head}");
            for e in elements {
                let _ = writeln!(out, "{indent}    {e},");
            }
            let _ = writeln!(out, "{indent}]");
        }
    }
}

/// `(a, b, …) = from`, in lines of a readable length.
fn wrapped(out: &mut String, names: &[String], from: &str) {
    out.push_str("    (");
    let mut width = 5;
    for name in names {
        if width + name.len() > 100 {
            out.push_str("\n     ");
            width = 5;
        }
        let _ = write!(out, "{name}, ");
        width += name.len() + 2;
    }
    // A tuple of one keeps its comma.
    out.truncate(out.len() - if names.len() > 1 { 2 } else { 1 });
    let _ = writeln!(out, ") = {from}");
}

/// A comment at the end of a line, of text that cannot end it.
fn comment(text: &str) -> String {
    let line: String = text
        .chars()
        .map(|c| if c.is_control() || c == '\u{2028}' || c == '\u{2029}' { ' ' } else { c })
        .collect();
    format!("  # {line}")
}

/// A string literal; what does not show is written by its code point.
fn literal(text: &str) -> String {
    quoted(text, |out, c| {
        if c.is_alphanumeric() || c.is_ascii_graphic() || c == ' ' {
            out.push(c);
        } else {
            let _ = write!(out, "\\U{:08x}", c as u32);
        }
    })
}
