//! C99 and Rust.

use std::fmt::Write as _;

use greybox_model::expr::Func;

use crate::error::ExportError;
use crate::function::{Function, symbol};
use crate::graph::{Graph, Node, Operator};
use crate::keywords::is_identifier;
use crate::names::ascii;

/// A language that functions are written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Language {
    /// C99 with `<math.h>`.
    C99,
    /// Rust without the standard library, with the crate `libm`.
    Rust,
}

/// A name for a constant of the model, whatever it is called there.
fn constant_name(function: &Function, name: &str) -> String {
    let mut candidate = ascii(name);
    let taken = |c: &str| c == function.name || function.arguments.iter().any(|g| g.name == c);
    let other = |c: &str| function.constants.iter().any(|o| o.name != name && o.name == c);
    while !is_identifier(&candidate) || taken(&candidate) || (candidate != name && other(&candidate)) {
        candidate = format!("p_{candidate}");
    }
    candidate
}

impl Function {
    /// The code of the function, a file of its own.
    ///
    /// # Errors
    /// [`ExportError`]: names that are none, symbols that are not given, functions of time.
    pub fn code(&self, language: Language) -> Result<String, ExportError> {
        self.check()?;
        Ok(write(self, &Graph::of(self), language))
    }
}

struct Writer<'a> {
    function: &'a Function,
    graph: &'a Graph,
    language: Language,
    /// Names of the nodes that have one.
    names: Vec<Option<String>>,
}

/// The file of a function.
fn write(function: &Function, graph: &Graph, language: Language) -> String {
    let mut writer = Writer { function, graph, language, names: vec![None; graph.nodes.len()] };
    let mut out = String::new();
    writer.head(&mut out);
    writer.helpers(&mut out);
    writer.signature(&mut out);
    writer.body(&mut out);
    out.push_str("}\n");
    out
}

/// The shortest text that reads back as the same number.
pub(crate) fn number(v: f64) -> String {
    format!("{v:?}")
}

/// Text that ends no comment.
pub(crate) fn comment(text: &str) -> String {
    text.replace("*/", "* /").replace(['\n', '\r'], " ")
}

impl Writer<'_> {
    fn note(&self, text: &str) -> String {
        match self.language {
            Language::C99 => format!("/* {} */", comment(text)),
            Language::Rust => format!("// {}", comment(text)),
        }
    }

    fn head(&self, out: &mut String) {
        let mut line = |text: &str| {
            let _ = writeln!(out, "{}", self.note(text));
        };
        for text in &self.function.summary {
            line(text);
        }
        for group in &self.function.arguments {
            for (k, member) in group.members.iter().enumerate() {
                let unit = if member.unit.is_empty() { String::new() } else { format!(", {}", member.unit) };
                line(&format!("{}[{k}]: {}{unit}", group.name, member.symbol()));
            }
        }
        for (k, (name, _)) in self.function.outputs.iter().enumerate() {
            line(&format!("out[{k}]: {name}"));
        }
        line(
            "Straight-line code made by greybox: no allocation, no state; an argument that is not a number gives none.",
        );
        if self.language == Language::C99 {
            out.push_str("#include <math.h>\n");
        }
        out.push('\n');
    }

    fn helpers(&self, out: &mut String) {
        let helpers = [
            (
                Func::Sign,
                "static double sign(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x == 0.0 ? 0.0 : x; }",
                "fn sign(x: f64) -> f64 {\n    if x > 0.0 { 1.0 } else if x < 0.0 { -1.0 } else if x == 0.0 { 0.0 } else { x }\n}",
            ),
            (
                Func::Min,
                "static double smaller(double a, double b) { return a < b || a != a ? a : b; }",
                "fn smaller(a: f64, b: f64) -> f64 {\n    if a < b || a.is_nan() { a } else { b }\n}",
            ),
            (
                Func::Max,
                "static double larger(double a, double b) { return a > b || a != a ? a : b; }",
                "fn larger(a: f64, b: f64) -> f64 {\n    if a > b || a.is_nan() { a } else { b }\n}",
            ),
            (
                Func::Deadzone,
                "static double deadzone(double x, double gap) { return x > gap ? x - gap : x < -gap ? x + gap : x - x; }",
                "fn deadzone(x: f64, gap: f64) -> f64 {\n    if x > gap { x - gap } else if x < -gap { x + gap } else { x - x }\n}",
            ),
            (
                Func::Saturate,
                "static double saturate(double x, double limit) { return x > limit ? limit : x < -limit ? -limit : x; }",
                "fn saturate(x: f64, limit: f64) -> f64 {\n    if x > limit { limit } else if x < -limit { -limit } else { x }\n}",
            ),
            (
                Func::Table,
                "static double table(int n, double x, const double knots[], const double values[]) {\n    int i = 1;\n    if (x <= knots[0]) return values[0];\n    if (x >= knots[n - 1]) return values[n - 1];\n    while (i < n - 1 && x >= knots[i]) i++;\n    return values[i - 1] + (values[i] - values[i - 1]) / (knots[i] - knots[i - 1]) * (x - knots[i - 1]);\n}",
                "fn table<const N: usize>(x: f64, knots: [f64; N], values: [f64; N]) -> f64 {\n    if x <= knots[0] {\n        return values[0];\n    }\n    if x >= knots[N - 1] {\n        return values[N - 1];\n    }\n    let mut i = 1;\n    while i < N - 1 && x >= knots[i] {\n        i += 1;\n    }\n    values[i - 1] + (values[i] - values[i - 1]) / (knots[i] - knots[i - 1]) * (x - knots[i - 1])\n}",
            ),
        ];
        for (_, c, rust) in helpers.iter().filter(|h| self.graph.calls(h.0)) {
            let text = if self.language == Language::C99 { c } else { rust };
            let _ = writeln!(out, "{text}\n");
        }
    }

    fn signature(&self, out: &mut String) {
        let (name, outputs) = (&self.function.name, self.function.outputs.len());
        let groups = self.function.arguments.iter().map(|g| (&g.name, g.members.len()));
        match self.language {
            Language::C99 => {
                let mut all: Vec<String> = groups.map(|(g, n)| format!("const double {g}[{n}]")).collect();
                all.push(format!("double out[{outputs}]"));
                let all = all.join(", ");
                let _ = writeln!(out, "void {name}({all});\n\nvoid {name}({all})\n{{");
                for group in self.function.arguments.iter().filter(|g| !self.reads(&g.name)) {
                    let _ = writeln!(out, "    (void){};", group.name);
                }
            }
            Language::Rust => {
                let all: Vec<String> = groups.map(|(g, n)| format!("{g}: &[f64; {n}]")).collect();
                let _ = writeln!(
                    out,
                    "#[allow(non_snake_case, unused_variables, clippy::all)]\n#[must_use]\npub fn {name}({}) -> [f64; {outputs}] {{",
                    all.join(", ")
                );
            }
        }
    }

    /// Whether an output reads an element of an argument.
    fn reads(&self, group: &str) -> bool {
        self.graph.nodes.iter().any(|node| match node {
            Node::Symbol(name, primes) => {
                self.function.argument(name, *primes).is_some_and(|(g, _)| g.name == group)
            }
            _ => false,
        })
    }

    fn body(&mut self, out: &mut String) {
        let declare = |name: &str, value: &str| match self.language {
            Language::C99 => format!("    const double {name} = {value};"),
            Language::Rust => format!("    let {name}: f64 = {value};"),
        };
        for k in 0..self.graph.nodes.len() {
            let Node::Symbol(name, primes) = &self.graph.nodes[k] else { continue };
            self.names[k] = Some(match self.function.argument(name, *primes) {
                Some((group, at)) => format!("{}[{at}]", group.name),
                None => {
                    let (value, unit) = match self.function.constant(name, *primes) {
                        Some(c) => (c.value, c.unit.as_str()),
                        None => (std::f64::consts::PI, ""),
                    };
                    let own = constant_name(self.function, name);
                    let said = if own == *name {
                        unit.to_owned()
                    } else {
                        format!("{}, {unit}", symbol(name, *primes))
                    };
                    let said = said.trim_end_matches([',', ' ']);
                    let note = if said.is_empty() { String::new() } else { format!(" {}", self.note(said)) };
                    let _ = writeln!(out, "{}{note}", declare(&own, &number(value)));
                    own
                }
            });
        }
        let mut temporaries = 0;
        for k in 0..self.graph.nodes.len() {
            let leaf = matches!(self.graph.nodes[k], Node::Number(_) | Node::Symbol(..));
            if !leaf && self.graph.uses[k] > 1 {
                let value = self.text(k, 0);
                let name = format!("t{temporaries}");
                temporaries += 1;
                let _ = writeln!(out, "{}", declare(&name, &value));
                self.names[k] = Some(name);
            }
        }
        let values: Vec<String> = self.graph.outputs.iter().map(|&k| self.text(k, 0)).collect();
        match self.language {
            Language::C99 => {
                for (k, value) in values.iter().enumerate() {
                    let _ = writeln!(out, "    out[{k}] = {value};");
                }
            }
            Language::Rust => {
                let _ = writeln!(out, "    [{}]", values.join(", "));
            }
        }
    }

    /// A node as text; `above` is the precedence around it: 1 for a sum, 2 for a product, 3 for a right operand of one.
    fn text(&self, k: usize, above: u8) -> String {
        if let Some(name) = &self.names[k] {
            return name.clone();
        }
        let wrap = |text: String, own: u8| if own < above { format!("({text})") } else { text };
        match &self.graph.nodes[k] {
            Node::Number(bits) => {
                let value = f64::from_bits(*bits);
                wrap(number(value), if value.is_sign_negative() { 0 } else { 4 })
            }
            Node::Symbol(name, primes) => symbol(name, *primes),
            Node::Negative(a) => wrap(format!("-{}", self.text(*a, 3)), 0),
            Node::Binary(op, a, b) => match op {
                Operator::Add => wrap(format!("{} + {}", self.text(*a, 1), self.text(*b, 2)), 1),
                Operator::Subtract => wrap(format!("{} - {}", self.text(*a, 1), self.text(*b, 2)), 1),
                Operator::Multiply => wrap(format!("{} * {}", self.text(*a, 2), self.text(*b, 3)), 2),
                Operator::Divide => wrap(format!("{} / {}", self.text(*a, 2), self.text(*b, 3)), 2),
                Operator::Power => {
                    let name = if self.language == Language::C99 { "pow" } else { "libm::pow" };
                    format!("{name}({}, {})", self.text(*a, 0), self.text(*b, 0))
                }
            },
            Node::Call(f, args) => {
                let args: Vec<String> = args.iter().map(|a| self.text(*a, 0)).collect();
                if *f == Func::Table {
                    return self.table(&args);
                }
                format!("{}({})", self.call(*f), args.join(", "))
            }
        }
    }

    /// The argument, the knots and the values of a table.
    fn table(&self, args: &[String]) -> String {
        let n = args.len() / 2;
        let (knots, values) = (args[1..=n].join(", "), args[n + 1..].join(", "));
        match self.language {
            Language::C99 => {
                format!("table({n}, {}, (const double[]){{{knots}}}, (const double[]){{{values}}})", args[0])
            }
            Language::Rust => format!("table({}, [{knots}], [{values}])", args[0]),
        }
    }

    fn call(&self, f: Func) -> &'static str {
        let (c, rust) = match f {
            Func::Sin => ("sin", "libm::sin"),
            Func::Cos => ("cos", "libm::cos"),
            Func::Tan => ("tan", "libm::tan"),
            Func::Exp => ("exp", "libm::exp"),
            Func::Ln => ("log", "libm::log"),
            Func::Sqrt => ("sqrt", "libm::sqrt"),
            Func::Tanh => ("tanh", "libm::tanh"),
            Func::Atan => ("atan", "libm::atan"),
            Func::Abs => ("fabs", "libm::fabs"),
            Func::Sign => ("sign", "sign"),
            Func::Min => ("smaller", "smaller"),
            Func::Max => ("larger", "larger"),
            Func::Deadzone => ("deadzone", "deadzone"),
            Func::Saturate => ("saturate", "saturate"),
            Func::Table => ("table", "table"),
            // Refused before.
            Func::Delay => ("delay", "delay"),
            Func::Step => ("step", "step"),
        };
        if self.language == Language::C99 { c } else { rust }
    }
}
