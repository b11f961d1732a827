//! Expressions as infix text with the fewest parentheses, for languages that write sums and products alike.

use greybox_model::Expr;
use greybox_model::expr::{BinOp, Func};

/// What differs between the languages.
pub(crate) trait Dialect {
    /// A symbol of the model.
    fn symbol(&mut self, name: &str, primes: u8) -> String;

    /// A function, which holds together as it stands. `arguments` are as written by [`text`].
    fn call(&mut self, function: Func, arguments: &[Expr]) -> String;

    /// A power as a function, where it is none between two operands that hold together.
    fn power(&mut self, _base: &Expr, _exponent: &Expr) -> Option<String> {
        None
    }

    /// The sign of a power.
    const POWER: &'static str;
}

/// How tightly text must hold together where it stands.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Tightness {
    /// Anything; a sign may lead.
    Sum,
    /// A product.
    Product,
    /// Right operand of a product.
    Factor,
    /// Operand of a power.
    Atom,
}

/// The expression in the dialect.
pub(crate) fn text<D: Dialect>(e: &Expr, dialect: &mut D) -> String {
    write(e, Tightness::Sum, dialect)
}

/// The shortest text that reads back as the same number.
pub(crate) fn number(v: f64) -> String {
    if v.fract() == 0.0 && v.abs() < 1e15 { format!("{v}") } else { format!("{v:?}") }
}

/// A string literal in double quotes: quotes and backslashes get a backslash, `other` writes the rest.
pub(crate) fn quoted(text: &str, other: impl Fn(&mut String, char)) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        if matches!(c, '"' | '\\') {
            out.push('\\');
            out.push(c);
        } else {
            other(&mut out, c);
        }
    }
    out.push('"');
    out
}

/// The expression, with parentheses unless it holds together.
pub(crate) fn atom<D: Dialect>(e: &Expr, dialect: &mut D) -> String {
    write(e, Tightness::Atom, dialect)
}

fn write<D: Dialect>(e: &Expr, needed: Tightness, dialect: &mut D) -> String {
    if let Expr::Bin(BinOp::Pow, a, b) = e
        && let Some(call) = dialect.power(a, b)
    {
        return call;
    }
    let (text, own) = match e {
        // A leading sign stands only where a sum may.
        Expr::Num(v) => (number(*v), if v.is_sign_negative() { Tightness::Sum } else { Tightness::Atom }),
        Expr::Var { name, primes } => (dialect.symbol(name, *primes), Tightness::Atom),
        Expr::Neg(a) => (format!("-{}", write(a, Tightness::Factor, dialect)), Tightness::Sum),
        Expr::Bin(op, a, b) => {
            let (left, sign, right, own) = match op {
                BinOp::Add => (Tightness::Sum, " + ", Tightness::Product, Tightness::Sum),
                BinOp::Sub => (Tightness::Sum, " - ", Tightness::Product, Tightness::Sum),
                BinOp::Mul => (Tightness::Product, "*", Tightness::Factor, Tightness::Product),
                BinOp::Div => (Tightness::Product, "/", Tightness::Factor, Tightness::Product),
                BinOp::Pow => (Tightness::Atom, D::POWER, Tightness::Atom, Tightness::Factor),
            };
            (format!("{}{sign}{}", write(a, left, dialect), write(b, right, dialect)), own)
        }
        Expr::Call(f, arguments) => (dialect.call(*f, arguments), Tightness::Atom),
    };
    if own < needed { format!("({text})") } else { text }
}
