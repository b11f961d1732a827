//! Symbolic algebra: simplify, differentiate, substitute, evaluate, split off linear unknowns.

use crate::expr::{BinOp, Expr, Func};
use crate::table::{Table, interpolate};
use std::f64::consts::PI;
use std::sync::Arc;

impl Expr {
    /// An equal expression with constants folded and the rules of 0, 1 and signs applied.
    ///
    /// Signs move outward (`a*(-b)` becomes `-a*b`, `a + -b` becomes `a - b`) and sums and products
    /// lean to the left. Nothing changes where the expression is finite; `sign(0)` is kept, because
    /// it is set-valued, and a fold that would not be finite is not made.
    pub fn simplify(&self) -> Expr {
        self.map(&mut simplify_node)
    }

    /// The symbolic partial derivative with respect to the symbol `name` with `primes` primes,
    /// simplified; every other symbol (so also `theta'` for `theta`) counts as constant.
    ///
    /// It is the derivative of what [`Expr::eval`] computes, wherever that has one: `abs` gives
    /// `sign`; `min`, `max`, `deadzone`, `saturate` and `table` give switches made of `sign`, with the mean of
    /// both sides on the kink; `sign` and `step` give zero. `delay(x, tau)` gives
    /// `delay(∂x, tau)`: the delay is linear in its argument; the dependence on a symbol inside
    /// `tau` is *not* part of it (that needs the history of x).
    ///
    /// ```
    /// use greybox_model::parse;
    /// let e = parse("k3*x^3 + fc*abs(x)*x'")?.expr;
    /// assert_eq!(e.derivative("x", 0).to_string(), "k3*3*x^2 + fc*sign(x)*x'");
    /// assert_eq!(e.derivative("x", 1).to_string(), "fc*abs(x)");
    /// # Ok::<(), greybox_model::SyntaxError>(())
    /// ```
    pub fn derivative(&self, name: &str, primes: u8) -> Expr {
        let seed = |n: &str, p: u8| (n == name && p == primes).then_some(Expr::Num(1.0));
        differentiate(self, &seed).unwrap_or(Expr::Num(0.0))
    }

    /// The total derivative with respect to time, simplified: each name for which `is_varying` holds
    /// gains a prime, `t` has slope 1, all else is constant. `delay(x, tau)` becomes `delay(x', tau)`
    /// (a constant delay); the impulses at switches of `sign` and `step` are left out.
    pub fn time_derivative(&self, is_varying: &dyn Fn(&str) -> bool) -> Expr {
        let seed = |n: &str, p: u8| {
            if n == "t" && p == 0 {
                Some(Expr::Num(1.0))
            } else if is_varying(n) {
                Some(Expr::prime(n, p.saturating_add(1)))
            } else {
                None
            }
        };
        differentiate(self, &seed).unwrap_or(Expr::Num(0.0))
    }

    /// Every symbol for which `by` gives an expression is replaced by it; nothing is simplified.
    pub fn substitute(&self, by: &dyn Fn(&str, u8) -> Option<Expr>) -> Expr {
        self.map(&mut |e| match &e {
            Expr::Var { name, primes } => by(name, *primes).unwrap_or(e),
            _ => e,
        })
    }

    /// The value where `value_of` gives the value of each symbol; `None` if it lacks one.
    ///
    /// `pi` is known. Pointwise meaning: `sign(0)` = 0, and `delay(x, tau)` is x now. The result may
    /// be infinite or not a number, as floating-point arithmetic says.
    pub fn eval(&self, value_of: &dyn Fn(&str, u8) -> Option<f64>) -> Option<f64> {
        Some(match self {
            Expr::Num(v) => *v,
            Expr::Var { name, primes: 0 } if &**name == "pi" => PI,
            Expr::Var { name, primes } => value_of(name, *primes)?,
            Expr::Neg(a) => -a.eval(value_of)?,
            Expr::Bin(op, a, b) => apply(*op, a.eval(value_of)?, b.eval(value_of)?),
            Expr::Call(Func::Table, args) => {
                let table = Table::of(args)?;
                let values: Option<Vec<f64>> = table.values.iter().map(|v| v.eval(value_of)).collect();
                interpolate(&table.knots, &values?, table.x.eval(value_of)?)
            }
            Expr::Call(f, args) => match args.as_slice() {
                [a] => call(*f, a.eval(value_of)?, 0.0),
                [a, b] => call(*f, a.eval(value_of)?, b.eval(value_of)?),
                _ => return None,
            },
        })
    }

    /// The symbols (name, primes) in the order of their first appearance, each once, `t` and `pi`
    /// included.
    pub fn variables(&self) -> Vec<(Arc<str>, u8)> {
        let mut found: Vec<(Arc<str>, u8)> = Vec::new();
        self.walk(&mut |e| {
            if let Expr::Var { name, primes } = e
                && !found.iter().any(|(n, p)| n == name && p == primes)
            {
                found.push((name.clone(), *primes));
            }
        });
        found
    }

    /// Whether the symbol occurs with exactly this number of primes.
    pub fn contains(&self, wanted: &str, wanted_primes: u8) -> bool {
        let mut found = false;
        self.walk(&mut |e| {
            if let Expr::Var { name, primes } = e {
                found |= &**name == wanted && *primes == wanted_primes;
            }
        });
        found
    }

    /// The value if no symbol but `pi` occurs.
    pub fn constant(&self) -> Option<f64> {
        self.eval(&|_, _| None)
    }

    /// The coefficients c and the remainder r with `self` = Σ cᵢ·nameᵢ + r, where none of the
    /// symbols `names` occurs in any cᵢ or in r; all simplified.
    ///
    /// Decided from the form, hence exact: `None` means that the expression as written is not
    /// affine (a symbol inside a function, a power, a denominator, or in both factors of a product).
    pub fn affine_in(&self, names: &[(&str, u8)]) -> Option<(Vec<Expr>, Expr)> {
        let (coefficients, remainder) = affine(self, names)?;
        Some((coefficients.iter().map(Expr::simplify).collect(), remainder.simplify()))
    }

    /// The additive terms with their signs: `a - (b + c)` has the terms a (+), b (−) and c (−).
    pub fn terms(&self) -> Vec<(bool, &Expr)> {
        fn collect<'a>(e: &'a Expr, negative: bool, into: &mut Vec<(bool, &'a Expr)>) {
            match e {
                Expr::Bin(BinOp::Add, a, b) => {
                    collect(a, negative, into);
                    collect(b, negative, into);
                }
                Expr::Bin(BinOp::Sub, a, b) => {
                    collect(a, negative, into);
                    collect(b, !negative, into);
                }
                Expr::Neg(a) => collect(a, !negative, into),
                _ => into.push((negative, e)),
            }
        }
        let mut into = Vec::new();
        collect(self, false, &mut into);
        into
    }
}

fn apply(op: BinOp, a: f64, b: f64) -> f64 {
    match op {
        BinOp::Add => a + b,
        BinOp::Sub => a - b,
        BinOp::Mul => a * b,
        BinOp::Div => a / b,
        BinOp::Pow => a.powf(b),
    }
}

/// `b` is ignored by functions of one argument; a table has more than two.
fn call(f: Func, a: f64, b: f64) -> f64 {
    match f {
        Func::Sin => a.sin(),
        Func::Cos => a.cos(),
        Func::Tan => a.tan(),
        Func::Exp => a.exp(),
        Func::Ln => a.ln(),
        Func::Sqrt => a.sqrt(),
        Func::Tanh => a.tanh(),
        Func::Atan => a.atan(),
        Func::Abs => a.abs(),
        Func::Sign if a == 0.0 => 0.0,
        Func::Sign => a.signum(),
        Func::Min => a.min(b),
        Func::Max => a.max(b),
        Func::Delay => a,
        Func::Deadzone if a > b => a - b,
        Func::Deadzone if a < -b => a + b,
        Func::Deadzone => 0.0,
        Func::Saturate => a.max(-b).min(b),
        Func::Step => f64::from(u8::from(a >= b)),
        Func::Table => f64::NAN,
    }
}

const ZERO: Expr = Expr::Num(0.0);
const ONE: Expr = Expr::Num(1.0);

fn is(e: &Expr, v: f64) -> bool {
    matches!(e, Expr::Num(x) if *x == v)
}

/// Simplifies a node whose children are simple already.
fn simplify_node(e: Expr) -> Expr {
    match e {
        Expr::Neg(a) => match *a {
            Expr::Num(v) => Expr::Num(-v),
            Expr::Neg(b) => *b,
            a => -a,
        },
        Expr::Bin(op, a, b) => simplify_binary(op, *a, *b),
        Expr::Call(f, args) => simplify_call(f, args),
        e => e,
    }
}

fn simplify_binary(op: BinOp, a: Expr, b: Expr) -> Expr {
    use BinOp::*;
    if let (Expr::Num(x), Expr::Num(y)) = (&a, &b) {
        let value = apply(op, *x, *y);
        if value.is_finite() {
            return Expr::Num(value);
        }
    }
    match (op, a, b) {
        (Add, a, b) if is(&a, 0.0) => b,
        (Add | Sub, a, b) if is(&b, 0.0) => a,
        (Sub, a, b) if is(&a, 0.0) => simplify_node(-b),
        (Add, a, Expr::Neg(b)) => simplify_binary(Sub, a, *b),
        (Sub, a, Expr::Neg(b)) => simplify_binary(Add, a, *b),
        (Add, a, Expr::Num(v)) if v < 0.0 => a - Expr::Num(-v),
        (Sub, a, Expr::Num(v)) if v < 0.0 => a + Expr::Num(-v),
        (Add, a, Expr::Bin(inner @ (Add | Sub), b, c)) => {
            simplify_binary(inner, simplify_binary(Add, a, *b), *c)
        }
        (Sub, a, b) if a == b => ZERO,

        (Mul, a, b) if is(&a, 0.0) || is(&b, 0.0) => ZERO,
        (Mul, a, b) if is(&a, 1.0) => b,
        (Mul | Div, a, b) if is(&b, 1.0) => a,
        (Div, a, b) if is(&a, 0.0) && !is(&b, 0.0) => ZERO,
        (Mul | Div, Expr::Neg(a), b) => simplify_node(-simplify_binary(op, *a, b)),
        (Mul | Div, a, Expr::Neg(b)) => simplify_node(-simplify_binary(op, a, *b)),
        (Mul | Div, Expr::Num(v), b) if v < 0.0 => simplify_node(-simplify_binary(op, Expr::Num(-v), b)),
        (Mul | Div, a, Expr::Num(v)) if v < 0.0 => simplify_node(-simplify_binary(op, a, Expr::Num(-v))),
        (Mul, a, Expr::Bin(Mul, b, c)) => simplify_binary(Mul, simplify_binary(Mul, a, *b), *c),

        (Pow, a, b) if is(&b, 1.0) => a,
        (Pow, a, b) if is(&b, 0.0) || is(&a, 1.0) => ONE,
        (op, a, b) => Expr::Bin(op, Box::new(a), Box::new(b)),
    }
}

fn simplify_call(f: Func, args: Vec<Expr>) -> Expr {
    let numbers: Option<Vec<f64>> =
        args.iter().map(|a| if let Expr::Num(v) = a { Some(*v) } else { None }).collect();
    if let Some(v) = numbers
        && let Some(&a) = v.first()
        && (f, a) != (Func::Sign, 0.0)
    {
        let value = match Table::of(&args) {
            Some(table) if f == Func::Table => interpolate(&table.knots, &v[1 + table.knots.len()..], a),
            _ => call(f, a, v.get(1).copied().unwrap_or(0.0)),
        };
        if value.is_finite() {
            return Expr::Num(value);
        }
    }
    match (f, args.as_slice()) {
        // A constant is the same at any time.
        (Func::Delay, [Expr::Num(v), _]) => Expr::Num(*v),
        (Func::Delay, [a, Expr::Num(0.0)]) => a.clone(),
        (Func::Deadzone, [a, Expr::Num(0.0)]) => a.clone(),
        (Func::Abs, [Expr::Neg(a)]) => Expr::Call(f, vec![(**a).clone()]),
        _ => Expr::Call(f, args),
    }
}

fn add(a: Expr, b: Expr) -> Expr {
    simplify_binary(BinOp::Add, a, b)
}
fn sub(a: Expr, b: Expr) -> Expr {
    simplify_binary(BinOp::Sub, a, b)
}
fn mul(a: Expr, b: Expr) -> Expr {
    simplify_binary(BinOp::Mul, a, b)
}
fn div(a: Expr, b: Expr) -> Expr {
    simplify_binary(BinOp::Div, a, b)
}
fn call1(f: Func, a: Expr) -> Expr {
    simplify_call(f, vec![a])
}

/// 1 where x > 0, 0 where x < 0, ½ at 0: (1 + sign(x))/2.
fn switch(x: Expr) -> Expr {
    div(add(ONE, call1(Func::Sign, x)), Expr::Num(2.0))
}

/// The derivative of `e` along the direction that `seed` gives for each symbol (`None`: zero);
/// `None` where it vanishes identically.
fn differentiate(e: &Expr, seed: &dyn Fn(&str, u8) -> Option<Expr>) -> Option<Expr> {
    let d = |e: &Expr| differentiate(e, seed);
    let simple = |e: &Expr| e.simplify();
    let sum = |a: Option<Expr>, b: Option<Expr>| match (a, b) {
        (Some(a), Some(b)) => Some(add(a, b)),
        (a, b) => a.or(b),
    };
    let result = match e {
        Expr::Num(_) => None,
        Expr::Var { name, primes } => seed(name, *primes),
        Expr::Neg(a) => d(a).map(|da| simplify_node(-da)),
        Expr::Bin(BinOp::Add, a, b) => sum(d(a), d(b)),
        Expr::Bin(BinOp::Sub, a, b) => sum(d(a), d(b).map(|db| simplify_node(-db))),
        Expr::Bin(BinOp::Mul, a, b) => {
            let left = d(a).map(|da| mul(da, simple(b)));
            sum(left, d(b).map(|db| mul(simple(a), db)))
        }
        Expr::Bin(BinOp::Div, a, b) => {
            let left = d(a).map(|da| div(da, simple(b)));
            let right = d(b).map(|db| {
                let squared = simplify_binary(BinOp::Pow, simple(b), Expr::Num(2.0));
                simplify_node(-div(mul(simple(a), db), squared))
            });
            sum(left, right)
        }
        Expr::Bin(BinOp::Pow, a, b) => {
            let (sa, sb) = (simple(a), simple(b));
            let base = d(a).map(|da| {
                let lowered = simplify_binary(BinOp::Pow, sa.clone(), sub(sb.clone(), ONE));
                mul(mul(sb.clone(), lowered), da)
            });
            let exponent = d(b).map(|db| mul(mul(simple(e), call1(Func::Ln, sa)), db));
            sum(base, exponent)
        }
        Expr::Call(f, args) => differentiate_call(*f, args, &d),
    };
    result.filter(|e| !is(e, 0.0))
}

/// Of a table: its slope at x times dx, and the table of the derivatives of its values.
fn differentiate_table(args: &[Expr], d: &dyn Fn(&Expr) -> Option<Expr>) -> Option<Expr> {
    let Table { x, knots, values } = Table::of(args)?;
    let x = x.simplify();
    let by_x = d(&x).map(|dx| {
        let n = knots.len();
        let simple: Vec<Expr> = values.iter().map(Expr::simplify).collect();
        let slope = |i: usize| {
            let rise = sub(simple[i + 1].clone(), simple[i].clone());
            div(rise, Expr::Num(knots[i + 1] - knots[i]))
        };
        let mut sum = ZERO;
        for (i, knot) in knots.iter().enumerate() {
            let before = if i > 0 { slope(i - 1) } else { ZERO };
            let after = if i + 1 < n { slope(i) } else { ZERO };
            sum = add(sum, mul(sub(after, before), switch(sub(x.clone(), Expr::Num(*knot)))));
        }
        mul(sum, dx)
    });
    let slopes: Vec<Option<Expr>> = values.iter().map(d).collect();
    let by_values = slopes.iter().any(Option::is_some).then(|| {
        let slopes = slopes.into_iter().map(|s| s.unwrap_or(ZERO)).collect();
        simplify_node(Table::call(x, &knots, slopes))
    });
    match (by_x, by_values) {
        (Some(a), Some(b)) => Some(add(a, b)),
        (a, b) => a.or(b),
    }
}

fn differentiate_call(f: Func, args: &[Expr], d: &dyn Fn(&Expr) -> Option<Expr>) -> Option<Expr> {
    if f == Func::Table {
        return differentiate_table(args, d);
    }
    let (a, b) = match args {
        [a] => (a, None),
        [a, b] => (a, Some(b)),
        _ => return None,
    };
    let x = a.simplify();
    let same = |f: Func| simplify_call(f, args.iter().map(Expr::simplify).collect());
    if let Some(b) = b {
        let y = b.simplify();
        let (da, db) = (d(a), d(b));
        if da.is_none() && db.is_none() {
            return None;
        }
        // f' = inside·∂x + outside·(x-side of the kink)
        let weigh = |weight: Expr, slope: Option<Expr>| slope.map_or(ZERO, |s| mul(weight, s));
        return match f {
            Func::Min => {
                let first = weigh(switch(sub(y.clone(), x.clone())), da);
                Some(add(first, weigh(switch(sub(x, y)), db)))
            }
            Func::Max => {
                let first = weigh(switch(sub(x.clone(), y.clone())), da);
                Some(add(first, weigh(switch(sub(y, x)), db)))
            }
            Func::Deadzone => {
                let outside = switch(sub(call1(Func::Abs, x.clone()), y));
                let slope = sub(da.unwrap_or(ZERO), weigh(call1(Func::Sign, x), db));
                Some(mul(outside, slope))
            }
            Func::Saturate => {
                let size = call1(Func::Abs, x.clone());
                let inside = weigh(switch(sub(y.clone(), size.clone())), da);
                let outside = weigh(mul(switch(sub(size, y)), call1(Func::Sign, x)), db);
                Some(add(inside, outside))
            }
            Func::Delay => da.map(|da| simplify_call(Func::Delay, vec![da, y])),
            _ => None,
        };
    }
    let da = d(a)?;
    let slope = match f {
        Func::Sin => call1(Func::Cos, x),
        Func::Cos => simplify_node(-call1(Func::Sin, x)),
        Func::Tan => add(ONE, simplify_binary(BinOp::Pow, same(f), Expr::Num(2.0))),
        Func::Exp => same(f),
        Func::Ln => return Some(div(da, x)),
        Func::Sqrt => return Some(div(da, mul(Expr::Num(2.0), same(f)))),
        Func::Tanh => sub(ONE, simplify_binary(BinOp::Pow, same(f), Expr::Num(2.0))),
        Func::Atan => return Some(div(da, add(ONE, simplify_binary(BinOp::Pow, x, Expr::Num(2.0))))),
        Func::Abs => call1(Func::Sign, x),
        _ => return None,
    };
    Some(mul(slope, da))
}

/// Coefficients and remainder before simplification.
fn affine(e: &Expr, names: &[(&str, u8)]) -> Option<(Vec<Expr>, Expr)> {
    if !names.iter().any(|(n, p)| e.contains(n, *p)) {
        return Some((vec![ZERO; names.len()], e.clone()));
    }
    let both = |(ca, ra): (Vec<Expr>, Expr), f: &dyn Fn(Expr) -> Expr| {
        (ca.into_iter().map(f).collect::<Vec<_>>(), f(ra))
    };
    let free = |e: &Expr| !names.iter().any(|(n, p)| e.contains(n, *p));
    match e {
        Expr::Var { name, primes } => {
            let coefficient = |(n, p): &(&str, u8)| if *n == &**name && p == primes { ONE } else { ZERO };
            Some((names.iter().map(coefficient).collect(), ZERO))
        }
        Expr::Neg(a) => Some(both(affine(a, names)?, &|e| simplify_node(-e))),
        Expr::Bin(op @ (BinOp::Add | BinOp::Sub), a, b) => {
            let ((ca, ra), (cb, rb)) = (affine(a, names)?, affine(b, names)?);
            let join = |a, b| simplify_binary(*op, a, b);
            Some((ca.into_iter().zip(cb).map(|(a, b)| join(a, b)).collect(), join(ra, rb)))
        }
        Expr::Bin(BinOp::Mul, a, b) if free(a) => Some(both(affine(b, names)?, &|e| mul((**a).clone(), e))),
        Expr::Bin(BinOp::Mul, a, b) if free(b) => Some(both(affine(a, names)?, &|e| mul(e, (**b).clone()))),
        Expr::Bin(BinOp::Div, a, b) if free(b) => Some(both(affine(a, names)?, &|e| div(e, (**b).clone()))),
        Expr::Bin(BinOp::Pow, a, b) if is(b, 1.0) => affine(a, names),
        _ => None,
    }
}
