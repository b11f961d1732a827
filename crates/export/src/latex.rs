//! A model as a textbook prints it.

use std::fmt::Write as _;

use greybox_model::expr::{BinOp, Func};
use greybox_model::{Expr, Model};

use crate::infix::number;

/// The equations of the model as an `align` environment of LaTeX (package `amsmath`), ready for `\input`.
///
/// Derivatives are dots, quotients fractions, |x| bars; `sign`, `deadzone` and `saturate` are operators;
/// `delay(x, tau)` is x(t − τ) for a symbol and a bar with the instant for an expression. Greek names are
/// letters, and what follows `_` or trailing digits is an index, as in the report. Equations longer than a line of an
/// article break before a term, and then all stand at the left.
///
/// ```
/// use greybox_model::Model;
/// let model = Model::from_toml(
///     "[states]\ntheta = { unit = \"rad\" }\n[parameters]\ng = { value = 9.81, unit = \"m/s^2\" }\nl = { value = 1, unit = \"m\" }\n\
///      [equations]\nswing = \"theta'' + g/l*sin(theta) = 0\"\n",
///     "pendulum.toml",
/// )?;
/// let equations = greybox_export::latex(&model);
/// assert!(equations.contains(r"\ddot{\theta} + \frac{g}{l}\,\sin\left(\theta\right) &= 0"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[must_use]
pub fn latex(model: &Model) -> String {
    // The terms of both sides.
    let mut sides: Vec<[Vec<String>; 2]> =
        model.equations.iter().map(|e| [&e.lhs, &e.rhs].map(terms)).collect();
    sides.extend(
        model
            .measurements
            .iter()
            .filter(|m| !is_own_channel(model, &m.channel, &m.expr))
            .map(|m| [vec![format!("y_{{\\text{{{}}}}}", escaped(&m.channel))], terms(&m.expr)]),
    );
    // Aligned at their signs, all left sides are as wide as the widest.
    let widest = |side: usize| -> usize {
        let widths = sides.iter().map(|both| both[side].iter().map(|term| width(term) + 1).sum());
        widths.max().unwrap_or(0)
    };
    let row = if widest(0) + widest(1) <= WIDTH { on_one_line } else { on_lines };
    let rows: Vec<String> = sides.iter().map(row).collect();
    format!("\\begin{{align}}\n  {}\n\\end{{align}}\n", rows.join(" \\\\\n  "))
}

/// Letters and signs of an equation that a line of an article holds beside the number.
const WIDTH: usize = 54;

/// An equation, aligned at its sign.
fn on_one_line([left, right]: &[Vec<String>; 2]) -> String {
    format!("{} &= {}", left.join(" "), right.join(" "))
}

/// An equation on as many lines as its terms need, all but the first indented.
fn on_lines([left, right]: &[Vec<String>; 2]) -> String {
    let (first, rest) = right.split_first().map_or(("0", &[][..]), |(first, rest)| (first.as_str(), rest));
    let terms = left.iter().cloned().chain(std::iter::once(format!("= {first}"))).chain(rest.iter().cloned());
    let mut text = String::from("& ");
    let mut used = 0;
    for term in terms {
        let size = width(&term) + 1;
        if used > 0 && used + size > WIDTH {
            text.push_str("\\notag \\\\\n  & \\quad {} ");
            used = 2;
        }
        text.push_str(&term);
        text.push(' ');
        used += size;
    }
    text.trim_end().to_owned()
}

/// The terms of a sum, each but the first with its sign in front.
fn terms(e: &Expr) -> Vec<String> {
    match e {
        Expr::Bin(op @ (BinOp::Add | BinOp::Sub), a, b) => {
            let mut all = terms(a);
            all.push(match op {
                BinOp::Add => format!("+ {}", math(b, Level::Term)),
                _ => format!("- {}", math(b, Level::Product)),
            });
            all
        }
        _ => vec![math(e, Level::Sum)],
    }
}

/// About how many letters and signs a formula shows.
fn width(formula: &str) -> usize {
    // Commands that show nothing of their own; of operators, the name in braces is shown.
    const SILENT: [&str; 8] = ["left", "right", "frac", "mathit", "operatorname", "text", "dot", "ddot"];
    let mut shown = 0;
    let mut rest = formula.chars().peekable();
    while let Some(c) = rest.next() {
        match c {
            '\\' => {
                let mut name = String::new();
                while let Some(letter) = rest.next_if(char::is_ascii_alphabetic) {
                    name.push(letter);
                }
                if name.is_empty() {
                    rest.next(); // a space or a brace
                } else if !SILENT.contains(&name.as_str()) {
                    // A Greek letter, or a function by its name.
                    let function = ["sin", "cos", "tan", "exp", "ln", "tanh", "arctan", "min", "max"];
                    shown += if function.contains(&name.as_str()) { name.len() } else { 1 };
                }
            }
            '{' | '}' | '^' | '_' | ' ' => {}
            _ => shown += 1,
        }
    }
    shown
}

/// The model as a LaTeX document of its own: the equations of [`latex`], what its functions mean, and the
/// parameters with values and units as the model states them.
#[must_use]
pub fn latex_document(model: &Model) -> String {
    let name = if model.name.is_empty() { "Model".to_owned() } else { escaped(&model.name) };
    let mut out = format!(
        "\\documentclass{{article}}\n\\usepackage[utf8]{{inputenc}}\n\\usepackage[T1]{{fontenc}}\n\
         \\usepackage{{amsmath,booktabs}}\n\\title{{{name}}}\n\\author{{}}\n\\date{{}}\n\\begin{{document}}\n\\maketitle\n\n{}",
        latex(model)
    );
    let meanings = meanings(model);
    if !meanings.is_empty() {
        out.push_str("\n\\noindent where\n\\begin{align*}\n  ");
        out.push_str(&meanings.join(" \\\\\n  "));
        out.push_str("\n\\end{align*}\n");
    }
    let signals = model
        .states
        .iter()
        .map(|s| (&s.name, &s.unit.text, if s.channel.is_some() { "state" } else { "state, not measured" }))
        .chain(model.inputs.iter().map(|i| (&i.name, &i.unit.text, "input")));
    let signals: Vec<String> = signals
        .map(|(name, unit, role)| format!("  ${}$ & {role} & {} \\\\\n", symbol(name, 0), unit_text(unit)))
        .collect();
    table(&mut out, "lll", "symbol & role & unit", &signals);
    let parameters: Vec<String> = model
        .parameters
        .iter()
        .map(|p| {
            let (value, unit) =
                p.unit.as_ref().map_or((p.value, ""), |u| (u.from_si(p.value), u.text.as_str()));
            let value = decimal(value);
            format!("  ${}$ & ${value}$ & {} \\\\\n", symbol(&p.name, 0), unit_text(unit))
        })
        .collect();
    table(&mut out, "lrl", "parameter & value & unit", &parameters);
    out.push_str("\n\\end{document}\n");
    out
}

fn table(out: &mut String, columns: &str, head: &str, rows: &[String]) {
    if !rows.is_empty() {
        let _ = write!(
            out,
            "\n\\begin{{center}}\n\\begin{{tabular}}{{{columns}}}\n  \\toprule\n  {head} \\\\\n  \\midrule\n{}  \\bottomrule\n\\end{{tabular}}\n\\end{{center}}\n",
            rows.concat()
        );
    }
}

/// Whether a measurement says no more than that a state's channel is called as the state.
fn is_own_channel(model: &Model, channel: &str, expr: &Expr) -> bool {
    model.states.iter().any(|s| s.name == channel && *expr == Expr::var(&s.name))
}

/// What the functions stand for that no textbook takes for granted.
fn meanings(model: &Model) -> Vec<String> {
    let sides = model.equations.iter().flat_map(|e| [&e.lhs, &e.rhs]);
    let all: Vec<&Expr> = sides.chain(model.measurements.iter().map(|m| &m.expr)).collect();
    let uses = |f: Func| {
        let mut found = false;
        all.iter().for_each(|e| e.walk(&mut |e| found |= matches!(e, Expr::Call(g, _) if *g == f)));
        found
    };
    let known = [
        (
            Func::Sign,
            r"\operatorname{sign}(x) &= x/|x| \text{ for } x \neq 0, \quad \operatorname{sign}(0) \in [-1, 1] \text{ (friction sticks)}",
        ),
        (
            Func::Deadzone,
            r"\operatorname{deadzone}(x, g) &= \begin{cases} x - g & x > g \\ 0 & |x| \le g \\ x + g & x < -g \end{cases}",
        ),
        (Func::Saturate, r"\operatorname{sat}(x, l) &= \max(-l, \min(x, l))"),
        (
            Func::Step,
            r"\operatorname{step}(t, t_0) &= \begin{cases} 0 & t < t_0 \\ 1 & t \ge t_0 \end{cases}",
        ),
        (
            Func::Table,
            r"\operatorname{table}(x; k\; v) &: \text{ linear between the values } v \text{ at the knots } k, \text{ held beyond them}",
        ),
    ];
    known.into_iter().filter(|(f, _)| uses(*f)).map(|(_, text)| text.to_owned()).collect()
}

/// How tightly an expression must hold together where it stands.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Level {
    Sum,
    /// Right of a `+` or `-`: no leading sign.
    Term,
    Product,
    Atom,
}

fn math(e: &Expr, needed: Level) -> String {
    let (text, own) = match e {
        Expr::Num(v) => {
            let own = if v.is_sign_negative() {
                Level::Sum
            } else if decimal(*v).contains("\\cdot") {
                Level::Product
            } else {
                Level::Atom
            };
            (decimal(*v), own)
        }
        Expr::Var { name, primes } => (symbol(name, *primes), Level::Atom),
        Expr::Neg(a) => (format!("-{}", math(a, Level::Term)), Level::Sum),
        Expr::Bin(BinOp::Add, a, b) => {
            (format!("{} + {}", math(a, Level::Sum), math(b, Level::Term)), Level::Sum)
        }
        Expr::Bin(BinOp::Sub, a, b) => {
            (format!("{} - {}", math(a, Level::Sum), math(b, Level::Product)), Level::Sum)
        }
        Expr::Bin(BinOp::Mul, a, b) => (product(a, b), Level::Product),
        Expr::Bin(BinOp::Div, a, b) => {
            (format!("\\frac{{{}}}{{{}}}", math(a, Level::Sum), math(b, Level::Sum)), Level::Product)
        }
        Expr::Bin(BinOp::Pow, a, b) => (format!("{}^{{{}}}", base(a), math(b, Level::Sum)), Level::Product),
        Expr::Call(f, arguments) => (call(*f, arguments), Level::Atom),
    };
    if own < needed { format!("\\left({text}\\right)") } else { text }
}

fn product(a: &Expr, b: &Expr) -> String {
    // Two numbers side by side would be one.
    let starts_with_number = |e: &Expr| {
        let text = math(e, Level::Product);
        text.starts_with(|c: char| c.is_ascii_digit())
    };
    let sign = if starts_with_number(b) { " \\cdot " } else { "\\," };
    format!("{}{sign}{}", math(a, Level::Product), math(b, Level::Product))
}

/// The base of a power; dots and functions do not carry an exponent unambiguously.
fn base(e: &Expr) -> String {
    match e {
        Expr::Var { primes: 0, .. } => math(e, Level::Atom),
        Expr::Num(v) if v.is_sign_positive() && !decimal(*v).contains("\\cdot") => math(e, Level::Atom),
        Expr::Var { primes: 1..=2, .. } => math(e, Level::Atom),
        _ => format!("\\left({}\\right)", math(e, Level::Sum)),
    }
}

fn call(f: Func, arguments: &[Expr]) -> String {
    let inner: Vec<String> = arguments.iter().map(|a| math(a, Level::Sum)).collect();
    let name = match f {
        Func::Abs => return format!("\\left|{}\\right|", inner[0]),
        Func::Sqrt => return format!("\\sqrt{{{}}}", inner[0]),
        Func::Delay => {
            let tau = math(&arguments[1], Level::Product);
            return match &arguments[0] {
                Expr::Var { .. } => format!("{}(t - {tau})", inner[0]),
                _ => format!("\\left.\\left({}\\right)\\right|_{{t - {tau}}}", inner[0]),
            };
        }
        Func::Sin => "\\sin",
        Func::Cos => "\\cos",
        Func::Tan => "\\tan",
        Func::Exp => "\\exp",
        Func::Ln => "\\ln",
        Func::Tanh => "\\tanh",
        Func::Atan => "\\arctan",
        Func::Min => "\\min",
        Func::Max => "\\max",
        Func::Sign => "\\operatorname{sign}",
        Func::Deadzone => "\\operatorname{deadzone}",
        Func::Saturate => "\\operatorname{sat}",
        Func::Step => "\\operatorname{step}",
        Func::Table => {
            let (knots, values) = inner[1..].split_at(inner.len() / 2);
            let pair = |(k, v): (&String, &String)| format!("{k} & {v}");
            let rows: Vec<String> = knots.iter().zip(values).map(pair).collect();
            let rows = rows.join(" \\\\ ");
            return format!(
                "\\operatorname{{table}}\\left({};\\; \\begin{{smallmatrix}} {rows} \\end{{smallmatrix}}\\right)",
                inner[0]
            );
        }
    };
    format!("{name}\\left({}\\right)", inner.join(", "))
}

/// A number, its power of ten as such.
fn decimal(v: f64) -> String {
    // Rounding of a unit's factor is no information.
    let rounded: f64 = format!("{v:.11e}").parse().unwrap_or(v);
    let text = number(if rounded.is_finite() { rounded } else { v });
    match text.split_once('e') {
        Some((mantissa, exponent)) => format!("{} \\cdot 10^{{{exponent}}}", mantissa.trim_end_matches(".0")),
        None => text,
    }
}

/// A name with its dots and indices.
fn symbol(name: &str, primes: u8) -> String {
    let (stem, suffix) = name.split_once('_').filter(|(stem, _)| !stem.is_empty()).unwrap_or((name, ""));
    let letters = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let (letters, digits) = if letters.is_empty() { (stem, "") } else { stem.split_at(letters.len()) };
    let letter = match greek(letters) {
        Some(command) => command,
        None if letters.chars().count() == 1 && letters.is_ascii() => letters.to_owned(),
        None if letters.is_ascii() => format!("\\mathit{{{}}}", escaped(letters)),
        None => format!("\\text{{{}}}", escaped(letters)),
    };
    let dotted = match primes {
        0 => letter,
        1 => format!("\\dot{{{letter}}}"),
        2 => format!("\\ddot{{{letter}}}"),
        3 => format!("\\dddot{{{letter}}}"),
        n => format!("{letter}^{{({n})}}"),
    };
    let suffix = if suffix.is_empty() { String::new() } else { format!("\\text{{{}}}", escaped(suffix)) };
    match (digits, suffix.as_str()) {
        ("", "") => dotted,
        ("", index) | (index, "") => format!("{dotted}_{{{index}}}"),
        (digits, suffix) => format!("{dotted}_{{{digits},{suffix}}}"),
    }
}

/// The command of a Greek letter, spelt out or as the letter itself.
fn greek(name: &str) -> Option<String> {
    const SPELT: &[(&str, char)] = &[
        ("alpha", 'α'),
        ("beta", 'β'),
        ("gamma", 'γ'),
        ("delta", 'δ'),
        ("epsilon", 'ε'),
        ("zeta", 'ζ'),
        ("eta", 'η'),
        ("theta", 'θ'),
        ("iota", 'ι'),
        ("kappa", 'κ'),
        ("lambda", 'λ'),
        ("mu", 'μ'),
        ("nu", 'ν'),
        ("xi", 'ξ'),
        ("pi", 'π'),
        ("rho", 'ρ'),
        ("sigma", 'σ'),
        ("tau", 'τ'),
        ("upsilon", 'υ'),
        ("phi", 'φ'),
        ("chi", 'χ'),
        ("psi", 'ψ'),
        ("omega", 'ω'),
        ("Gamma", 'Γ'),
        ("Delta", 'Δ'),
        ("Theta", 'Θ'),
        ("Lambda", 'Λ'),
        ("Xi", 'Ξ'),
        ("Pi", 'Π'),
        ("Sigma", 'Σ'),
        ("Phi", 'Φ'),
        ("Psi", 'Ψ'),
        ("Omega", 'Ω'),
    ];
    let mut letters = name.chars();
    let single = letters.next().filter(|_| letters.next().is_none());
    let found = SPELT.iter().find(|(spelt, letter)| *spelt == name || single == Some(*letter));
    found.map(|(spelt, _)| format!("\\{spelt}"))
}

fn unit_text(unit: &str) -> String {
    // `m/s^2`: exponents are raised, the rest is text.
    let mut out = String::new();
    let mut rest = unit;
    while let Some((before, after)) = rest.split_once('^') {
        let digits =
            after.find(|c: char| !(c.is_ascii_digit() || c == '-' || c == '.')).unwrap_or(after.len());
        let _ = write!(out, "{}$^{{{}}}$", escaped(before), &after[..digits]);
        rest = &after[digits..];
    }
    out.push_str(&escaped(rest));
    out
}

/// Text in which no character is a command.
fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\\' => out.push_str("\\textbackslash{}"),
            '~' => out.push_str("\\textasciitilde{}"),
            '^' => out.push_str("\\textasciicircum{}"),
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => {
                out.push('\\');
                out.push(c);
            }
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}
