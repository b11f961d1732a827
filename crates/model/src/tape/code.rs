//! What is run at every point: the operations in their order, frequent pairs in one.
//!
//! A pair writes both of its registers (tangents need them), and rounds as its two operations do.

use super::{Op, Reg, Switch, powi};

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Code {
    One(Op),
    /// a².
    Square(Reg),
    /// a³.
    Cube(Reg),
    /// a b, then a b + c.
    MulAdd(Reg, Reg, Reg),
    /// a b, then a b − c.
    MulSub(Reg, Reg, Reg),
    /// a b, then c − a b.
    SubMul(Reg, Reg, Reg),
    /// a b, then a b c.
    MulMul(Reg, Reg, Reg),
}

/// The program of `ops`, whose results stand in the registers from `first` on.
pub(super) fn compile(ops: &[Op], first: usize) -> Vec<Code> {
    let mut code = Vec::with_capacity(ops.len());
    let mut i = 0;
    while i < ops.len() {
        let product = (first + i) as Reg;
        match ops.get(i + 1).and_then(|&next| pair(ops[i], product, next)) {
            Some(two) => {
                code.push(two);
                i += 2;
            }
            None => {
                code.push(single(ops[i]));
                i += 1;
            }
        }
    }
    code
}

/// A product and the operation that uses it, in one.
fn pair(op: Op, product: Reg, next: Op) -> Option<Code> {
    let (a, b) = match op {
        Op::Mul(a, b) => (a, b),
        Op::Powi(a, 2) => (a, a),
        _ => return None,
    };
    let other = |x: Reg, y: Reg| match (x == product, y == product) {
        (true, false) => Some(y),
        (false, true) => Some(x),
        _ => None,
    };
    match next {
        Op::Add(x, y) => other(x, y).map(|c| Code::MulAdd(a, b, c)),
        Op::Mul(x, y) => other(x, y).map(|c| Code::MulMul(a, b, c)),
        Op::Sub(x, y) if x == product => other(x, y).map(|c| Code::MulSub(a, b, c)),
        Op::Sub(x, y) => other(x, y).map(|c| Code::SubMul(a, b, c)),
        _ => None,
    }
}

/// The commonest powers have no exponent to ask for.
fn single(op: Op) -> Code {
    match op {
        Op::Powi(a, 2) => Code::Square(a),
        Op::Powi(a, 3) => Code::Cube(a),
        op => Code::One(op),
    }
}

/// Runs `code`, whose results go to the registers from `first` on. With `NATURAL` every mode is taken from the
/// arguments' values and left in `modes`; else `lambda[k]` is the value of a sticking sign `k`.
#[inline(always)]
pub(super) fn run<const NATURAL: bool>(
    code: &[Code],
    first: usize,
    switches: &[Switch],
    regs: &mut [f64],
    modes: &mut [i8],
    lambda: &[f64],
) {
    let mut out = first;
    for op in code {
        let g = |r: Reg| regs[r as usize];
        let v = match *op {
            Code::One(Op::Of(f, a)) => f.value(g(a)),
            Code::One(Op::Add(a, b)) => g(a) + g(b),
            Code::One(Op::Sub(a, b)) => g(a) - g(b),
            Code::One(Op::Mul(a, b)) => g(a) * g(b),
            Code::One(Op::Div(a, b)) => g(a) / g(b),
            Code::One(Op::Powi(a, n)) => powi(g(a), n),
            Code::Square(a) => {
                let x = g(a);
                x * x
            }
            Code::Cube(a) => {
                let x = g(a);
                x * x * x
            }
            Code::One(Op::Pow(a, b)) => g(a).powf(g(b)),
            Code::One(Op::Switch(k)) => {
                let s = &switches[k as usize];
                let (a, b) = (g(s.a), g(s.b));
                if NATURAL {
                    modes[k as usize] = s.natural_mode(a, b);
                    s.value(modes[k as usize], 0.0, a, b)
                } else {
                    s.value(modes[k as usize], lambda[k as usize], a, b)
                }
            }
            Code::MulAdd(a, b, c) => {
                let (product, c) = (g(a) * g(b), g(c));
                regs[out] = product;
                out += 1;
                product + c
            }
            Code::MulSub(a, b, c) => {
                let (product, c) = (g(a) * g(b), g(c));
                regs[out] = product;
                out += 1;
                product - c
            }
            Code::SubMul(a, b, c) => {
                let (product, c) = (g(a) * g(b), g(c));
                regs[out] = product;
                out += 1;
                c - product
            }
            Code::MulMul(a, b, c) => {
                let (product, c) = (g(a) * g(b), g(c));
                regs[out] = product;
                out += 1;
                product * c
            }
        };
        regs[out] = v;
        out += 1;
    }
}
