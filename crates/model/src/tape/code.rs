//! What is run at every point: the operations in their order, frequent pairs in one.
//!
//! A pair writes both of its registers (tangents need them), and rounds as its two operations do. In a sum of products each
//! operation needs the result before it. That result is at hand: to read it back from the memory of its register would take longer
//! than to add.

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
    /// z + a. (z: the result before.)
    Plus(Reg),
    /// z − a.
    Less(Reg),
    /// z a.
    Times(Reg),
    /// a b, then z + a b.
    PlusMul(Reg, Reg),
    /// a b, then z − a b.
    LessMul(Reg, Reg),
}

/// The program of `ops`, whose results stand in the registers from `first` on.
pub(super) fn compile(ops: &[Op], first: usize) -> Vec<Code> {
    let mut code = Vec::with_capacity(ops.len());
    let mut i = 0;
    while i < ops.len() {
        let product = (first + i) as Reg;
        let (next, taken) = match ops.get(i + 1).and_then(|&next| pair(ops[i], product, next)) {
            Some(two) => (two, 2),
            None => (single(ops[i]), 1),
        };
        // (The first operation has none before it.)
        code.push(if i > 0 { chained(next, product - 1) } else { next });
        i += taken;
    }
    code
}

/// The same where an operand is the result `before`.
fn chained(code: Code, before: Reg) -> Code {
    match code {
        Code::One(Op::Add(z, a) | Op::Add(a, z)) if z == before => Code::Plus(a),
        Code::One(Op::Sub(z, a)) if z == before => Code::Less(a),
        Code::One(Op::Mul(z, a) | Op::Mul(a, z)) if z == before => Code::Times(a),
        Code::MulAdd(a, b, z) if z == before => Code::PlusMul(a, b),
        Code::SubMul(a, b, z) if z == before => Code::LessMul(a, b),
        code => code,
    }
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

/// The value of one operation. With `NATURAL` a mode is taken from the arguments' values and left in `modes`; else `lambda[k]`
/// is the value of a sticking sign `k`.
#[inline(always)]
fn value<const NATURAL: bool>(
    op: Op,
    switches: &[Switch],
    regs: &[f64],
    modes: &mut [i8],
    lambda: &[f64],
) -> f64 {
    let g = |r: Reg| regs[r as usize];
    match op {
        Op::Of(f, a) => f.value(g(a)),
        Op::Add(a, b) => g(a) + g(b),
        Op::Sub(a, b) => g(a) - g(b),
        Op::Mul(a, b) => g(a) * g(b),
        Op::Div(a, b) => g(a) / g(b),
        Op::Powi(a, n) => powi(g(a), n),
        Op::Pow(a, b) => g(a).powf(g(b)),
        Op::Switch(k) => {
            let s = &switches[k as usize];
            let (a, b) = (g(s.a), g(s.b));
            if NATURAL {
                modes[k as usize] = s.natural_mode(a, b);
                s.value(modes[k as usize], 0.0, a, b)
            } else {
                s.value(modes[k as usize], lambda[k as usize], a, b)
            }
        }
    }
}

/// A product, and what is made of it.
#[inline(always)]
fn with(product: f64, f: impl FnOnce(f64) -> f64) -> (Option<f64>, f64) {
    (Some(product), f(product))
}

/// Runs `code`, whose results go to the registers from `first` on; modes as in [`value`].
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
    let mut z = 0.0;
    for op in code {
        let g = |r: Reg| regs[r as usize];
        let mul = |a: Reg, b: Reg| g(a) * g(b);
        // A product's register is written beside that of the result that uses it.
        let (product, result) = match *op {
            Code::One(op) => (None, value::<NATURAL>(op, switches, regs, modes, lambda)),
            Code::Square(a) => (None, mul(a, a)),
            Code::Cube(a) => (None, mul(a, a) * g(a)),
            Code::MulAdd(a, b, c) => with(mul(a, b), |p| p + g(c)),
            Code::MulSub(a, b, c) => with(mul(a, b), |p| p - g(c)),
            Code::SubMul(a, b, c) => with(mul(a, b), |p| g(c) - p),
            Code::MulMul(a, b, c) => with(mul(a, b), |p| p * g(c)),
            Code::Plus(a) => (None, z + g(a)),
            Code::Less(a) => (None, z - g(a)),
            Code::Times(a) => (None, z * g(a)),
            Code::PlusMul(a, b) => with(mul(a, b), |p| z + p),
            Code::LessMul(a, b) => with(mul(a, b), |p| z - p),
        };
        if let Some(product) = product {
            regs[out] = product;
            out += 1;
        }
        z = result;
        regs[out] = z;
        out += 1;
    }
}

/// Runs `ops` again, each with its register.
#[inline]
pub(super) fn again(
    ops: &[(Reg, Op)],
    switches: &[Switch],
    regs: &mut [f64],
    modes: &mut [i8],
    lambda: &[f64],
) {
    for &(out, op) in ops {
        regs[out as usize] = value::<false>(op, switches, regs, modes, lambda);
    }
}

/// The operations that depend on the value of switch `k`, it included, in their order.
pub(super) fn after(k: usize, ops: &[Op], first: usize, switches: &[Switch]) -> Vec<(Reg, Op)> {
    let mut depends = vec![false; first + ops.len()];
    let mut found = Vec::new();
    for (i, op) in ops.iter().enumerate() {
        let on = |r: Reg| depends[r as usize];
        let is_after = match *op {
            Op::Switch(j) => j as usize == k || on(switches[j as usize].a) || on(switches[j as usize].b),
            Op::Of(_, a) | Op::Powi(a, _) => on(a),
            Op::Add(a, b) | Op::Sub(a, b) | Op::Mul(a, b) | Op::Div(a, b) | Op::Pow(a, b) => on(a) || on(b),
        };
        if is_after {
            depends[first + i] = true;
            found.push(((first + i) as Reg, *op));
        }
    }
    found
}
