//! Directional derivatives of the registers: which have any, and the rule of each.

use std::sync::OnceLock;

use greybox_jit::{Operand, Operation, Operations, Row as Lanes, Rule as Code, Rules};

use super::compiled::{Program, register};
use super::{Op, Reg, Smooth, Switch, SwitchKind, powi};

/// Which registers can have a non-zero derivative, and what computes it. Made once by
/// [`Tape::tangents`](super::Tape::tangents), for the leaves that have one.
#[derive(Debug)]
pub struct Tangents {
    active: Vec<bool>,
    pub(super) prologue: Vec<Row>,
    pub(super) body: Vec<Row>,
    /// The number of lanes for which the body may be compiled, and the body once it was run with so many.
    pub(super) lanes: Option<usize>,
    pub(super) code: OnceLock<Option<greybox_jit::Tangents>>,
}

impl Tangents {
    /// Whether the register can have a non-zero derivative.
    #[inline]
    pub fn is_active(&self, r: Reg) -> bool {
        self.active[r as usize]
    }

    /// The rules of `ops`, of which the first `prologue` depend on parameters alone.
    pub(super) fn new(
        ops: &[Op],
        prologue: usize,
        first: usize,
        switches: &[Switch],
        leaf_active: &[bool],
    ) -> Tangents {
        let mut active = vec![false; first + ops.len()];
        active[..leaf_active.len()].copy_from_slice(leaf_active);
        let mut rows = [Vec::new(), Vec::new()];
        for (i, op) in ops.iter().enumerate() {
            let out = (first + i) as Reg;
            if let Some(rule) = Rule::of(*op, switches, &|r| active[r as usize]) {
                active[out as usize] = true;
                rows[usize::from(i >= prologue)].push(Row { out, rule });
            }
        }
        let [prologue, body] = rows;
        Tangents { active, prologue, body, lanes: None, code: OnceLock::new() }
    }
}

/// The derivative of one register.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row {
    out: Reg,
    rule: Rule,
}

/// d(out) from the rows of the arguments that have one. Capitals: the argument has none.
#[derive(Debug, Clone, Copy)]
enum Rule {
    /// da.
    Same(Reg),
    /// da + db.
    Sum(Reg, Reg),
    /// da − db.
    Difference(Reg, Reg),
    /// da · B.
    Scaled(Reg, Reg),
    /// da · b + a · db.
    Product(Reg, Reg),
    /// da / B.
    Over(Reg, Reg),
    /// d(A / b).
    Under(Reg, Reg),
    /// d(a / b).
    Quotient(Reg, Reg),
    /// d f(a).
    Of(Smooth, Reg),
    /// d(aⁿ).
    Powi(Reg, i32),
    /// d(a^B).
    Base(Reg, Reg),
    /// d(A^b).
    Exponent(Reg, Reg),
    /// d(a^b).
    Pow(Reg, Reg),
    /// A non-smooth function: by its mode; which of the arguments have a row.
    Switch(u32, bool, bool),
}

impl Rule {
    fn of(op: Op, switches: &[Switch], active: &dyn Fn(Reg) -> bool) -> Option<Rule> {
        let one = |a: Reg, rule: Rule| active(a).then_some(rule);
        let two = |a: Reg, b: Reg, left: Rule, right: Rule, both: Rule| match (active(a), active(b)) {
            (true, true) => Some(both),
            (true, false) => Some(left),
            (false, true) => Some(right),
            (false, false) => None,
        };
        match op {
            Op::Of(f, a) => one(a, Rule::Of(f, a)),
            Op::Add(a, b) => two(a, b, Rule::Same(a), Rule::Same(b), Rule::Sum(a, b)),
            Op::Sub(a, b) => two(a, b, Rule::Same(a), Rule::Of(Smooth::Neg, b), Rule::Difference(a, b)),
            Op::Mul(a, b) => two(a, b, Rule::Scaled(a, b), Rule::Scaled(b, a), Rule::Product(a, b)),
            Op::Div(a, b) => two(a, b, Rule::Over(a, b), Rule::Under(a, b), Rule::Quotient(a, b)),
            Op::Powi(a, n) => one(a, Rule::Powi(a, n)),
            Op::Pow(a, b) => two(a, b, Rule::Base(a, b), Rule::Exponent(a, b), Rule::Pow(a, b)),
            Op::Switch(k) => {
                let s = &switches[k as usize];
                let (a, b) = (active(s.a), active(s.b));
                // (What a sticking sign does is the integrator's business.)
                let flat = matches!(s.kind, SwitchKind::Sign | SwitchKind::Step);
                (!flat && (a || b)).then_some(Rule::Switch(k, a, b))
            }
        }
    }
}

impl Tangents {
    /// The body as machine code for `lanes` directions: to the last bit what [`run`] gives.
    #[inline]
    pub(super) fn code(&self, switches: &[Switch], lanes: usize) -> Option<&greybox_jit::Tangents> {
        if self.lanes != Some(lanes) {
            return None;
        }
        let compile = || {
            let (before, rules) = rules(&self.body, switches);
            greybox_jit::Tangents::compile(&before, &rules, lanes)
        };
        self.code.get_or_init(compile).as_ref()
    }
}

/// What the rules multiply by, and the rows.
pub(super) fn rules(rows: &[Row], switches: &[Switch]) -> (Operations, Rules) {
    let mut before = Program::default();
    let rules = rows.iter().map(|row| (row.out, row.rule.compile(row.out, switches, &mut before))).collect();
    (before.operations, rules)
}

impl Rule {
    fn compile(self, out: Reg, switches: &[Switch], before: &mut Program) -> Code {
        let one = Operand::Constant(1.0);
        // −a / b².
        let under = |before: &mut Program, a: Reg, b: Reg| {
            let negative = before.local(Operation::Negative(register(a)));
            let square = before.local(Operation::Product(register(b), register(b)));
            before.local(Operation::Quotient(negative, square))
        };
        // b a^(b − 1).
        let by_base = |before: &mut Program, a: Reg, b: Reg| {
            let less = before.local(Operation::Difference(register(b), one));
            let power = before.local(Program::real_power(register(a), less));
            before.local(Operation::Product(register(b), power))
        };
        // a^b ln a.
        let by_exponent = |before: &mut Program, a: Reg, b: Reg| {
            let power = before.local(Program::real_power(register(a), register(b)));
            let logarithm = before.local(Program::logarithm(register(a)));
            before.local(Operation::Product(power, logarithm))
        };
        Code::Always(match self {
            Rule::Same(a) => Lanes::Copy(a),
            Rule::Sum(a, b) => Lanes::Sum(a, b),
            Rule::Difference(a, b) => Lanes::Difference(a, b),
            Rule::Scaled(a, b) => Lanes::Scale(register(b), a),
            Rule::Product(a, b) => Lanes::Blend(register(b), a, register(a), b),
            Rule::Over(a, b) => Lanes::Scale(before.local(Operation::Quotient(one, register(b))), a),
            Rule::Under(a, b) => Lanes::Scale(under(before, a, b), b),
            Rule::Quotient(a, b) => {
                let inverse = before.local(Operation::Quotient(one, register(b)));
                Lanes::Blend(inverse, a, under(before, a, b), b)
            }
            Rule::Of(f, a) => Lanes::Scale(before.slope(f, register(a), register(out)), a),
            Rule::Powi(a, n) => {
                let power = before.power(register(a), n - 1);
                let power = before.local(power);
                Lanes::Scale(before.local(Operation::Product(Operand::Constant(n as f64), power)), a)
            }
            Rule::Base(a, b) => Lanes::Scale(by_base(before, a, b), a),
            Rule::Exponent(a, b) => Lanes::Scale(by_exponent(before, a, b), b),
            Rule::Pow(a, b) => {
                let base = by_base(before, a, b);
                Lanes::Blend(base, a, by_exponent(before, a, b), b)
            }
            Rule::Switch(k, live_a, live_b) => {
                return compile_switch(k, &switches[k as usize], (live_a, live_b), before);
            }
        })
    }
}

/// [`switch`] as machine code.
fn compile_switch(k: u32, switch: &Switch, live: (bool, bool), before: &mut Program) -> Code {
    use SwitchKind::*;
    let Switch { kind, a, b, .. } = *switch;
    let mode = |before: &mut Program| before.local(Operation::Mode(k));
    let negative = |before: &mut Program| {
        let mode = mode(before);
        before.local(Operation::Negative(mode))
    };
    match kind {
        Sign | Step => Code::Always(Lanes::Zero),
        Abs => Code::Always(Lanes::Scale(mode(before), a)),
        Max => Code::Select(k, [Lanes::Copy(b), Lanes::Copy(b), Lanes::Copy(a)]),
        Min => Code::Select(k, [Lanes::Copy(a), Lanes::Copy(a), Lanes::Copy(b)]),
        Deadzone => {
            let beyond = match live {
                (true, false) => Lanes::Copy(a),
                (false, true) => Lanes::Scale(negative(before), b),
                _ => Lanes::Blend(Operand::Constant(1.0), a, negative(before), b),
            };
            Code::Select(k, [beyond, Lanes::Zero, beyond])
        }
        Saturate => {
            let bound = Lanes::Scale(mode(before), b);
            Code::Select(k, [bound, Lanes::Copy(a), bound])
        }
    }
}

/// The point at which derivatives are taken.
#[derive(Clone, Copy)]
pub(super) struct Place<'a> {
    pub(super) regs: &'a [f64],
    pub(super) modes: &'a [i8],
    pub(super) switches: &'a [Switch],
}

/// Runs the rules on `d`, `registers × lanes`.
#[inline(always)]
pub(super) fn run(rows: &[Row], at: Place<'_>, lanes: usize, d: &mut [f64]) {
    for Row { out, rule } in rows {
        let out = *out as usize;
        let (lower, upper) = d.split_at_mut(out * lanes);
        let o = &mut upper[..lanes];
        let v = |r: Reg| at.regs[r as usize];
        let row = |r: Reg| &lower[r as usize * lanes..][..lanes];
        match *rule {
            Rule::Same(a) => o.copy_from_slice(row(a)),
            Rule::Sum(a, b) => join(o, row(a), row(b), |x, y| x + y),
            Rule::Difference(a, b) => join(o, row(a), row(b), |x, y| x - y),
            Rule::Scaled(a, b) => scale(o, row(a), v(b)),
            Rule::Product(a, b) => blend(o, row(a), v(b), row(b), v(a)),
            Rule::Over(a, b) => scale(o, row(a), 1.0 / v(b)),
            Rule::Under(a, b) => scale(o, row(b), -v(a) / (v(b) * v(b))),
            Rule::Quotient(a, b) => blend(o, row(a), 1.0 / v(b), row(b), -v(a) / (v(b) * v(b))),
            Rule::Of(f, a) => scale(o, row(a), f.slope(v(a), at.regs[out])),
            Rule::Powi(a, n) => scale(o, row(a), n as f64 * powi(v(a), n - 1)),
            Rule::Base(a, b) => scale(o, row(a), v(b) * v(a).powf(v(b) - 1.0)),
            Rule::Exponent(a, b) => scale(o, row(b), v(a).powf(v(b)) * v(a).ln()),
            Rule::Pow(a, b) => {
                let (x, y) = (v(a), v(b));
                blend(o, row(a), y * x.powf(y - 1.0), row(b), x.powf(y) * x.ln());
            }
            Rule::Switch(k, a, b) => switch(o, k as usize, (a, b), at, lower),
        }
    }
}

/// d(non-smooth function) in its mode; `live` says which arguments have a row.
#[inline(never)]
fn switch(o: &mut [f64], k: usize, live: (bool, bool), at: Place<'_>, lower: &[f64]) {
    use SwitchKind::*;
    let lanes = o.len();
    let row = |r: Reg| &lower[r as usize * lanes..][..lanes];
    let Switch { kind, a, b, .. } = at.switches[k];
    let mode = at.modes[k];
    let m = mode as f64;
    match kind {
        Sign | Step => o.fill(0.0),
        Abs => scale(o, row(a), m),
        Max => o.copy_from_slice(row(if mode > 0 { a } else { b })),
        Min => o.copy_from_slice(row(if mode > 0 { b } else { a })),
        Deadzone if mode == 0 => o.fill(0.0),
        Deadzone => match live {
            (true, false) => o.copy_from_slice(row(a)),
            (false, true) => scale(o, row(b), -m),
            _ => blend(o, row(a), 1.0, row(b), -m),
        },
        Saturate if mode == 0 => o.copy_from_slice(row(a)),
        Saturate => scale(o, row(b), m),
    }
}

/// o = f(x, y).
#[inline(always)]
fn join(o: &mut [f64], x: &[f64], y: &[f64], f: impl Fn(f64, f64) -> f64) {
    let (x, y) = (&x[..o.len()], &y[..o.len()]);
    for l in 0..o.len() {
        o[l] = f(x[l], y[l]);
    }
}

/// o = k x.
#[inline(always)]
fn scale(o: &mut [f64], x: &[f64], k: f64) {
    let x = &x[..o.len()];
    for l in 0..o.len() {
        o[l] = k * x[l];
    }
}

/// o = a x + b y.
#[inline(always)]
fn blend(o: &mut [f64], x: &[f64], a: f64, y: &[f64], b: f64) {
    join(o, x, y, |x, y| a * x + b * y);
}
