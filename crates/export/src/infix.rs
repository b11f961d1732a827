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
enum Hold {
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
    write(e, Hold::Sum, dialect)
}

/// The shortest text that reads back as the same number.
pub(crate) fn number(v: f64) -> String {
    if v.fract() == 0.0 && v.abs() < 1e15 { format!("{v}") } else { format!("{v:?}") }
}

fn write<D: Dialect>(e: &Expr, needed: Hold, dialect: &mut D) -> String {
    if let Expr::Bin(BinOp::Pow, a, b) = e
        && let Some(call) = dialect.power(a, b)
    {
        return call;
    }
    let (text, own) = match e {
        // A leading sign stands only where a sum may.
        Expr::Num(v) => (number(*v), if v.is_sign_negative() { Hold::Sum } else { Hold::Atom }),
        Expr::Var { name, primes } => (dialect.symbol(name, *primes), Hold::Atom),
        Expr::Neg(a) => (format!("-{}", write(a, Hold::Factor, dialect)), Hold::Sum),
        Expr::Bin(op, a, b) => {
            let (left, sign, right, own) = match op {
                BinOp::Add => (Hold::Sum, " + ", Hold::Product, Hold::Sum),
                BinOp::Sub => (Hold::Sum, " - ", Hold::Product, Hold::Sum),
                BinOp::Mul => (Hold::Product, "*", Hold::Factor, Hold::Product),
                BinOp::Div => (Hold::Product, "/", Hold::Factor, Hold::Product),
                BinOp::Pow => (Hold::Atom, D::POWER, Hold::Atom, Hold::Factor),
            };
            (format!("{}{sign}{}", write(a, left, dialect), write(b, right, dialect)), own)
        }
        Expr::Call(f, arguments) => (dialect.call(*f, arguments), Hold::Atom),
    };
    if own < needed { format!("({text})") } else { text }
}
