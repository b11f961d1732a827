//! Printing expressions in the model language, with the fewest parentheses that keep the tree.

use crate::expr::{BinOp, Expr, Func};
use crate::model::Equation;
use std::fmt;

/// Prints in the model language; parsing the text gives the same tree again, as long as its numbers
/// are finite and no [`Expr::Neg`] stands directly over a number (the parser reads `-2` as one
/// number).
///
/// ```
/// use greybox_model::parse;
/// let e = parse("((J)*theta''+(B*theta'))-(ks*(alpha-beta))")?.expr;
/// assert_eq!(e.to_string(), "J*theta'' + B*theta' - ks*(alpha - beta)");
/// # Ok::<(), greybox_model::SyntaxError>(())
/// ```
impl fmt::Display for Expr {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write(self, Tightness::Loose, f)
    }
}

/// `lhs = rhs`, as it stands in a file.
impl fmt::Display for Equation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} = {}", self.lhs, self.rhs)
    }
}

/// How tightly an expression must hold together where it stands, loosest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Tightness {
    /// Anything.
    Loose,
    /// Right operand of `+` or `-`, operand of a sign: a product, no leading sign.
    Term,
    /// Left operand of `*` or `/`: a product without a leading sign.
    Product,
    /// Right operand of `*` or `/`: a power.
    Factor,
    /// Exponent: a power, or one with a leading sign.
    Exponent,
    /// Base of a power.
    Atom,
}

fn write(e: &Expr, needed: Tightness, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    use Tightness::*;
    let fits = match e {
        Expr::Num(v) if v.is_sign_negative() => needed == Loose || needed == Exponent,
        Expr::Num(_) | Expr::Var { .. } | Expr::Call(..) => true,
        Expr::Neg(a) => match needed {
            Loose => true,
            // `x^-y`, but `x^(-(a*b))`.
            Exponent => matches!(**a, Expr::Var { .. } | Expr::Call(..) | Expr::Bin(BinOp::Pow, ..)),
            _ => false,
        },
        Expr::Bin(BinOp::Add | BinOp::Sub, ..) => needed == Loose,
        Expr::Bin(BinOp::Mul | BinOp::Div, ..) => needed <= Product,
        Expr::Bin(BinOp::Pow, ..) => needed <= Exponent,
    };
    if !fits {
        f.write_str("(")?;
        write(e, Loose, f)?;
        return f.write_str(")");
    }
    match e {
        Expr::Num(v) => number(*v, f),
        Expr::Var { name, primes } => {
            f.write_str(name)?;
            (0..*primes).try_for_each(|_| f.write_str("'"))
        }
        Expr::Neg(a) => {
            f.write_str("-")?;
            // A bare number after the sign would be read as one number.
            let operand = if matches!(**a, Expr::Num(_)) { Atom } else { Term };
            write(a, operand, f)
        }
        Expr::Bin(op, a, b) => {
            let (left, sign, right) = match op {
                BinOp::Add => (Loose, " + ", Term),
                BinOp::Sub => (Loose, " - ", Term),
                BinOp::Mul => (Product, "*", Factor),
                BinOp::Div => (Product, "/", Factor),
                BinOp::Pow => (Atom, "^", Exponent),
            };
            write(a, left, f)?;
            f.write_str(sign)?;
            write(b, right, f)
        }
        Expr::Call(function, args) => {
            f.write_str(function.name())?;
            f.write_str("(")?;
            match (function, args.split_first()) {
                (Func::Table, Some((x, rest))) => {
                    write(x, Loose, f)?;
                    let (knots, values) = rest.split_at(rest.len() / 2);
                    for list in [knots, values] {
                        f.write_str(", [")?;
                        separated(list, f)?;
                        f.write_str("]")?;
                    }
                }
                _ => separated(args, f)?,
            }
            f.write_str(")")
        }
    }
}

fn separated(all: &[Expr], f: &mut fmt::Formatter<'_>) -> fmt::Result {
    for (i, e) in all.iter().enumerate() {
        f.write_str(if i > 0 { ", " } else { "" })?;
        write(e, Tightness::Loose, f)?;
    }
    Ok(())
}

/// The shortest decimal that reads back as the same number.
fn number(v: f64, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    if v == 0.0 || (1e-4..1e15).contains(&v.abs()) { write!(f, "{v}") } else { write!(f, "{v:e}") }
}
