//! Expressions compiled to a register tape.
//!
//! A [`Tape`] is a straight list of operations on numbered registers, shared subexpressions merged
//! and operations on parameters alone hoisted into a *prologue* that runs once per simulation.
//! It is evaluated three ways:
//!
//! * [`Tape::eval`]: one point, with the branch of every non-smooth function fixed by a *mode*, so
//!   that the right-hand side is smooth within a step and events are the integrator's business;
//! * [`Tape::tangent`]: directional derivatives for many directions (lanes) at once, beside one
//!   value: forward sensitivities of all parameters share the trajectory they belong to;
//! * [`Tape::eval_batch`]: many points at once (samples of a recording), every non-smooth function
//!   evaluated pointwise with sign(0) = 0.
//!
//! Registers: the leaves first (in the caller's layout), then constants, then one per operation.

use std::collections::HashMap;
use std::sync::Arc;

use code::Code;
use compiled::Compiled;
use greybox_jit::{Operations, Rules};
pub use tangents::Tangents;

use crate::expr::{BinOp, Expr, Func};
use crate::table::Table;

mod code;
mod compiled;
mod tangents;

/// A register number.
pub type Reg = u32;

/// Non-smooth functions, whose branch is a *mode* during a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SwitchKind {
    /// `sign(a)`: modes −1, +1, and 0 = sticking, where its value λ ∈ [−1, 1] keeps a = 0.
    Sign,
    /// `abs(a)`: modes ±1.
    Abs,
    /// `min(a, b)`: mode +1 for a > b (value b), −1 for a < b (value a).
    Min,
    /// `max(a, b)`: mode +1 for a > b (value a), −1 for a < b (value b).
    Max,
    /// `deadzone(a, b)`: modes −1 (a < −b), 0, +1 (a > b).
    Deadzone,
    /// `saturate(a, b)`: modes −1 (a < −b), 0, +1 (a > b).
    Saturate,
    /// `step(a, b)`: mode −1 for a < b, +1 for a ≥ b.
    Step,
}

/// One non-smooth node of the tape.
#[derive(Debug, Clone, Copy)]
pub struct Switch {
    /// Which function.
    pub kind: SwitchKind,
    /// First argument.
    pub a: Reg,
    /// Second argument (equal to `a` where there is none).
    pub b: Reg,
    /// Whether an argument depends on an input (its branch may jump between samples).
    pub on_input: bool,
    /// Whether an argument depends on anything but parameters.
    pub live: bool,
}

impl Switch {
    /// The mode that the arguments' values ask for; `sign(0)` asks for 0.
    #[inline]
    pub fn natural_mode(&self, a: f64, b: f64) -> i8 {
        use SwitchKind::*;
        match self.kind {
            Sign => (a > 0.0) as i8 - (a < 0.0) as i8,
            Abs => {
                if a < 0.0 {
                    -1
                } else {
                    1
                }
            }
            Min | Max | Step => {
                if a < b {
                    -1
                } else {
                    1
                }
            }
            Deadzone | Saturate => (a > b) as i8 - (a < -b) as i8,
        }
    }

    /// How far inside its mode the switch is: positive inside, negative when the mode is violated.
    /// (Sticking is judged by its multiplier, not here.)
    #[inline]
    pub fn margin(&self, mode: i8, a: f64, b: f64) -> f64 {
        use SwitchKind::*;
        let m = mode as f64;
        match self.kind {
            Sign | Abs => {
                if mode == 0 {
                    f64::INFINITY
                } else {
                    m * a
                }
            }
            Min | Max | Step => m * (a - b),
            Deadzone | Saturate => match mode {
                0 => b - a.abs(),
                _ => m * a - b,
            },
        }
    }

    #[inline]
    fn value(&self, mode: i8, lambda: f64, a: f64, b: f64) -> f64 {
        use SwitchKind::*;
        let m = mode as f64;
        match self.kind {
            Sign => {
                if mode == 0 {
                    lambda
                } else {
                    m
                }
            }
            Abs => m * a,
            Max => {
                if mode > 0 {
                    a
                } else {
                    b
                }
            }
            Min => {
                if mode > 0 {
                    b
                } else {
                    a
                }
            }
            Deadzone => {
                if mode == 0 {
                    0.0
                } else {
                    a - m * b
                }
            }
            Saturate => {
                if mode == 0 {
                    a
                } else {
                    m * b
                }
            }
            Step => {
                if mode > 0 {
                    1.0
                } else {
                    0.0
                }
            }
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Op {
    Of(Smooth, Reg),
    Add(Reg, Reg),
    Sub(Reg, Reg),
    Mul(Reg, Reg),
    Div(Reg, Reg),
    Powi(Reg, i32),
    Pow(Reg, Reg),
    Switch(u32),
}

/// A smooth function of one argument.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Smooth {
    Neg,
    Sqrt,
    Sin,
    Cos,
    Tan,
    Exp,
    Ln,
    Tanh,
    Atan,
    /// The argument, zero where it is negative: of what is never negative by its form, beyond the point where a switch in it
    /// is held (`abs(x)` is `x` there until the step ends).
    Positive,
}

impl Smooth {
    #[inline(always)]
    fn value(self, x: f64) -> f64 {
        match self {
            Smooth::Neg => -x,
            Smooth::Sqrt => x.sqrt(),
            Smooth::Sin => x.sin(),
            Smooth::Cos => x.cos(),
            Smooth::Tan => x.tan(),
            Smooth::Exp => x.exp(),
            Smooth::Ln => x.ln(),
            Smooth::Tanh => x.tanh(),
            Smooth::Atan => x.atan(),
            Smooth::Positive => x.max(0.0),
        }
    }

    /// The derivative at `x`, where the function is `y`.
    #[inline(never)]
    fn slope(self, x: f64, y: f64) -> f64 {
        match self {
            Smooth::Neg => -1.0,
            // At 0 the slope of the root is infinite; a zero derivative keeps lanes finite
            // where a state rests at the boundary of its domain (an empty tank).
            Smooth::Sqrt => {
                if y > 0.0 {
                    0.5 / y
                } else {
                    0.0
                }
            }
            Smooth::Sin => x.cos(),
            Smooth::Cos => -x.sin(),
            Smooth::Tan => 1.0 + y * y,
            Smooth::Exp => y,
            Smooth::Ln => 1.0 / x,
            Smooth::Tanh => 1.0 - y * y,
            Smooth::Atan => 1.0 / (1.0 + x * x),
            Smooth::Positive => f64::from(u8::from(x > 0.0)),
        }
    }
}

/// Whether the form of an expression keeps it from being negative, whatever its variables are.
fn is_never_negative(e: &Expr) -> bool {
    match e {
        Expr::Num(v) => *v >= 0.0,
        Expr::Bin(BinOp::Add | BinOp::Mul | BinOp::Div, a, b) => is_never_negative(a) && is_never_negative(b),
        Expr::Bin(BinOp::Pow, a, b) => {
            is_never_negative(a) || matches!(**b, Expr::Num(n) if n.rem_euclid(2.0) == 0.0)
        }
        Expr::Call(Func::Abs | Func::Exp | Func::Sqrt, _) => true,
        Expr::Call(Func::Max, args) => args.iter().any(is_never_negative),
        _ => false,
    }
}

/// A delayed value: `leaf` receives `arg` evaluated `tau` ago.
#[derive(Debug, Clone, Copy)]
pub struct Delay {
    /// Register of the undelayed argument.
    pub arg: Reg,
    /// Register of the delay (parameters only), s.
    pub tau: Reg,
    /// Leaf into which the caller writes the delayed value.
    pub leaf: Reg,
    /// The leaf of the argument when it is a bare leaf (such as an input), else `None`.
    pub arg_leaf: Option<Reg>,
}

/// What a leaf is, for dependency analysis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeafKind {
    /// A constant of the simulation.
    Parameter,
    /// An exogenous signal.
    Input,
    /// Time, a state or anything else that varies.
    Varying,
}

/// A compiled list of expressions.
#[derive(Debug, Clone)]
pub struct Tape {
    leaves: usize,
    kinds: Vec<LeafKind>,
    constants: Vec<f64>,
    ops: Vec<Op>,
    prologue: usize,
    /// What runs the prologue, and what runs the rest.
    prepared: Vec<Code>,
    code: Vec<Code>,
    /// By sign: what depends on its value.
    after: Vec<Vec<(Reg, Op)>>,
    /// Machine code for it; `None`: it is only interpreted.
    compiled: Option<Arc<Compiled>>,
    /// Registers of the compiled expressions, in the order they were given.
    pub outputs: Vec<Reg>,
    /// Non-smooth nodes in the order they are evaluated.
    pub switches: Vec<Switch>,
    /// Delayed values.
    pub delays: Vec<Delay>,
}

/// Builds a [`Tape`] expression by expression.
pub struct Compiler<'a> {
    resolve: &'a dyn Fn(&str, u8) -> Option<usize>,
    kinds: Vec<LeafKind>,
    constants: Vec<f64>,
    constant_index: HashMap<u64, usize>,
    ops: Vec<(Op, bool, bool)>, // operation, depends on parameters only, depends on an input
    op_index: HashMap<Op, usize>,
    switches: Vec<Switch>,
    switch_index: HashMap<(SwitchKind, Reg, Reg), u32>,
    delays: Vec<Delay>,
    delay_exprs: Vec<(Expr, Expr)>,
}

/// A name that the layout does not know.
#[derive(Debug, Clone, PartialEq)]
pub struct UnknownName {
    /// The name.
    pub name: String,
    /// Its number of primes.
    pub primes: u8,
}

impl std::fmt::Display for UnknownName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "unknown name `{}{}`", self.name, "'".repeat(self.primes as usize))
    }
}

impl std::error::Error for UnknownName {}

// While compiling, registers are tagged: leaves and constants and operations live in separate
// number ranges until `finish` lays them out.
const CONSTANT: Reg = 1 << 28;
const OPERATION: Reg = 1 << 29;

impl<'a> Compiler<'a> {
    /// `kinds[i]` says what leaf `i` is; `resolve` maps a name with primes to its leaf.
    pub fn new(kinds: Vec<LeafKind>, resolve: &'a dyn Fn(&str, u8) -> Option<usize>) -> Compiler<'a> {
        Compiler {
            resolve,
            kinds,
            constants: Vec::new(),
            constant_index: HashMap::new(),
            ops: Vec::new(),
            op_index: HashMap::new(),
            switches: Vec::new(),
            switch_index: HashMap::new(),
            delays: Vec::new(),
            delay_exprs: Vec::new(),
        }
    }

    fn constant(&mut self, v: f64) -> Reg {
        let next = self.constants.len();
        let index = *self.constant_index.entry(v.to_bits()).or_insert(next);
        if index == next {
            self.constants.push(v);
        }
        CONSTANT + index as Reg
    }

    fn constant_value(&self, r: Reg) -> Option<f64> {
        (CONSTANT..OPERATION).contains(&r).then(|| self.constants[(r - CONSTANT) as usize])
    }

    fn flags(&self, r: Reg) -> (bool, bool) {
        if r >= OPERATION {
            let (_, fixed, on_input) = self.ops[(r - OPERATION) as usize];
            (fixed, on_input)
        } else if r >= CONSTANT {
            (true, false)
        } else {
            match self.kinds[r as usize] {
                LeafKind::Parameter => (true, false),
                LeafKind::Input => (false, true),
                LeafKind::Varying => (false, false),
            }
        }
    }

    fn push(&mut self, op: Op, operands: &[Reg]) -> Reg {
        if let Some(&i) = self.op_index.get(&op) {
            return OPERATION + i as Reg;
        }
        let fixed = operands.iter().all(|&r| self.flags(r).0);
        let on_input = operands.iter().any(|&r| self.flags(r).1);
        let i = self.ops.len();
        self.ops.push((op, fixed, on_input));
        self.op_index.insert(op, i);
        OPERATION + i as Reg
    }

    fn smooth(&mut self, f: Smooth, a: Reg) -> Reg {
        match self.constant_value(a) {
            Some(v) => self.constant(f.value(v)),
            None => self.push(Op::Of(f, a), &[a]),
        }
    }

    /// The register of an expression, zero where a switch that is held makes negative what is not so by its form.
    fn kept_positive(&mut self, e: &Expr, register: Reg) -> Reg {
        let mut switches = false;
        e.walk(&mut |e| switches |= matches!(e, Expr::Call(Func::Abs | Func::Max, _)));
        if switches && is_never_negative(e) { self.smooth(Smooth::Positive, register) } else { register }
    }

    fn switch(&mut self, kind: SwitchKind, a: Reg, b: Reg) -> Reg {
        let next = self.switches.len() as u32;
        let index = *self.switch_index.entry((kind, a, b)).or_insert(next);
        if index == next {
            let (fixed_a, input_a) = self.flags(a);
            let (fixed_b, input_b) = self.flags(b);
            self.switches.push(Switch {
                kind,
                a,
                b,
                on_input: input_a || input_b,
                live: !(fixed_a && fixed_b),
            });
        }
        self.push(Op::Switch(index), &[a, b])
    }

    /// Compiles one expression and returns its (provisional) register for [`finish`](Self::finish).
    pub fn add(&mut self, e: &Expr) -> Result<Reg, UnknownName> {
        Ok(match e {
            Expr::Num(v) => self.constant(*v),
            Expr::Var { name, primes } => {
                if &**name == "pi" && *primes == 0 {
                    return Ok(self.constant(std::f64::consts::PI));
                }
                match (self.resolve)(name, *primes) {
                    Some(leaf) => leaf as Reg,
                    None => return Err(UnknownName { name: name.to_string(), primes: *primes }),
                }
            }
            Expr::Neg(a) => {
                let a = self.add(a)?;
                self.smooth(Smooth::Neg, a)
            }
            Expr::Bin(op, a, b) => {
                let (ra, rb) = (self.add(a)?, self.add(b)?);
                let (ca, cb) = (self.constant_value(ra), self.constant_value(rb));
                match (op, ca, cb) {
                    (BinOp::Add, Some(x), Some(y)) => self.constant(x + y),
                    (BinOp::Sub, Some(x), Some(y)) => self.constant(x - y),
                    (BinOp::Mul, Some(x), Some(y)) => self.constant(x * y),
                    (BinOp::Div, Some(x), Some(y)) => self.constant(x / y),
                    (BinOp::Pow, Some(x), Some(y)) => self.constant(x.powf(y)),
                    (BinOp::Add, Some(0.0), _) => rb,
                    (BinOp::Add | BinOp::Sub, _, Some(0.0)) => ra,
                    (BinOp::Mul, Some(1.0), _) => rb,
                    (BinOp::Mul | BinOp::Div | BinOp::Pow, _, Some(1.0)) => ra,
                    (BinOp::Mul, Some(0.0), _) | (BinOp::Mul, _, Some(0.0)) => self.constant(0.0),
                    (BinOp::Add, ..) => self.push(Op::Add(ra, rb), &[ra, rb]),
                    (BinOp::Sub, ..) => self.push(Op::Sub(ra, rb), &[ra, rb]),
                    (BinOp::Mul, ..) => self.push(Op::Mul(ra, rb), &[ra, rb]),
                    (BinOp::Div, ..) => self.push(Op::Div(ra, rb), &[ra, rb]),
                    (BinOp::Pow, _, Some(y)) if y.fract() == 0.0 && y.abs() <= 64.0 => {
                        self.push(Op::Powi(ra, y as i32), &[ra])
                    }
                    (BinOp::Pow, ..) => {
                        let ra = self.kept_positive(a, ra);
                        self.push(Op::Pow(ra, rb), &[ra, rb])
                    }
                }
            }
            Expr::Call(Func::Delay, args) => {
                let (arg, tau) = (args[0].clone(), args[1].clone());
                if let Some(i) = self.delay_exprs.iter().position(|d| d.0 == arg && d.1 == tau) {
                    return Ok(self.delays[i].leaf);
                }
                let (ra, rt) = (self.add(&arg)?, self.add(&tau)?);
                let leaf = self.kinds.len() as Reg;
                let kind = if self.flags(ra).1 { LeafKind::Input } else { LeafKind::Varying };
                self.kinds.push(kind);
                self.delays.push(Delay { arg: ra, tau: rt, leaf, arg_leaf: (ra < CONSTANT).then_some(ra) });
                self.delay_exprs.push((arg, tau));
                leaf
            }
            Expr::Call(Func::Table, args) => self.table(args)?,
            Expr::Call(f, args) => {
                let a = self.add(&args[0])?;
                match f {
                    Func::Sin => self.smooth(Smooth::Sin, a),
                    Func::Cos => self.smooth(Smooth::Cos, a),
                    Func::Tan => self.smooth(Smooth::Tan, a),
                    Func::Exp => self.smooth(Smooth::Exp, a),
                    Func::Ln => self.smooth(Smooth::Ln, a),
                    Func::Sqrt => {
                        let a = self.kept_positive(&args[0], a);
                        self.smooth(Smooth::Sqrt, a)
                    }
                    Func::Tanh => self.smooth(Smooth::Tanh, a),
                    Func::Atan => self.smooth(Smooth::Atan, a),
                    Func::Sign => self.switch(SwitchKind::Sign, a, a),
                    Func::Abs => self.switch(SwitchKind::Abs, a, a),
                    Func::Min | Func::Max | Func::Deadzone | Func::Saturate | Func::Step => {
                        let b = self.add(&args[1])?;
                        let kind = match f {
                            Func::Min => SwitchKind::Min,
                            Func::Max => SwitchKind::Max,
                            Func::Deadzone => SwitchKind::Deadzone,
                            Func::Saturate => SwitchKind::Saturate,
                            _ => SwitchKind::Step,
                        };
                        self.switch(kind, a, b)
                    }
                    Func::Delay | Func::Table => unreachable!("handled above"),
                }
            }
        })
    }

    /// A table by its kinks (see [`Table`]); what depends on its values alone is done once per simulation.
    fn table(&mut self, args: &[Expr]) -> Result<Reg, UnknownName> {
        let Some(Table { x, knots, values }) = Table::of(args) else { return Ok(self.constant(f64::NAN)) };
        let x = self.add(x)?;
        let values = values.iter().map(|v| self.add(v)).collect::<Result<Vec<_>, _>>()?;
        let knot: Vec<Reg> = knots.iter().map(|k| self.constant(*k)).collect();
        let from_first = self.switch(SwitchKind::Max, x, knot[0]);
        let held = self.switch(SwitchKind::Min, from_first, knot[knot.len() - 1]);
        let zero = self.constant(0.0);
        let (mut sum, mut before) = (values[0], None);
        for i in 0..knots.len() - 1 {
            let rise = self.push(Op::Sub(values[i + 1], values[i]), &[values[i + 1], values[i]]);
            let run = self.constant(knots[i + 1] - knots[i]);
            let slope = self.push(Op::Div(rise, run), &[rise, run]);
            let beyond = self.push(Op::Sub(held, knot[i]), &[held, knot[i]]);
            let (weight, part) = match before {
                None => (slope, beyond),
                Some(before) => (
                    self.push(Op::Sub(slope, before), &[slope, before]),
                    self.switch(SwitchKind::Max, beyond, zero),
                ),
            };
            let term = self.push(Op::Mul(weight, part), &[weight, part]);
            sum = self.push(Op::Add(sum, term), &[sum, term]);
            before = Some(slope);
        }
        Ok(sum)
    }

    /// Lays out the registers: leaves (with the delays' leaves behind the caller's), constants, the
    /// prologue's operations, the others. `outputs` are registers returned by [`add`](Self::add).
    pub fn finish(self, outputs: &[Reg]) -> Tape {
        let leaves = self.kinds.len();
        let first_op = leaves + self.constants.len();
        let mut order: Vec<usize> = (0..self.ops.len()).filter(|&i| self.ops[i].1).collect();
        let prologue = order.len();
        order.extend((0..self.ops.len()).filter(|&i| !self.ops[i].1));
        let mut place = vec![0; self.ops.len()];
        for (to, &from) in order.iter().enumerate() {
            place[from] = first_op + to;
        }
        let at = |r: Reg| -> Reg {
            if r >= OPERATION {
                place[(r - OPERATION) as usize] as Reg
            } else if r >= CONSTANT {
                leaves as Reg + (r - CONSTANT)
            } else {
                r
            }
        };
        let ops: Vec<Op> = order
            .iter()
            .map(|&i| match self.ops[i].0 {
                Op::Of(f, a) => Op::Of(f, at(a)),
                Op::Add(a, b) => Op::Add(at(a), at(b)),
                Op::Sub(a, b) => Op::Sub(at(a), at(b)),
                Op::Mul(a, b) => Op::Mul(at(a), at(b)),
                Op::Div(a, b) => Op::Div(at(a), at(b)),
                Op::Powi(a, n) => Op::Powi(at(a), n),
                Op::Pow(a, b) => Op::Pow(at(a), at(b)),
                Op::Switch(k) => Op::Switch(k),
            })
            .collect();
        let switches: Vec<Switch> =
            self.switches.iter().map(|s| Switch { a: at(s.a), b: at(s.b), ..*s }).collect();
        let after = |(k, switch): (usize, &Switch)| match switch.kind {
            SwitchKind::Sign if switch.live => code::after(k, &ops, first_op, &switches),
            _ => Vec::new(),
        };
        Tape {
            leaves,
            kinds: self.kinds,
            after: switches.iter().enumerate().map(after).collect(),
            constants: self.constants.clone(),
            prepared: code::compile(&ops[..prologue], first_op),
            code: code::compile(&ops[prologue..], first_op + prologue),
            ops,
            prologue,
            compiled: Some(Arc::default()),
            outputs: outputs.iter().map(|&r| at(r)).collect(),
            switches,
            delays: self
                .delays
                .iter()
                .map(|d| Delay { arg: at(d.arg), tau: at(d.tau), leaf: d.leaf, arg_leaf: d.arg_leaf })
                .collect(),
        }
    }
}

impl Tape {
    /// Compiles `exprs` over the leaves that `kinds` and `resolve` describe.
    pub fn compile(
        exprs: &[Expr],
        kinds: Vec<LeafKind>,
        resolve: &dyn Fn(&str, u8) -> Option<usize>,
    ) -> Result<Tape, UnknownName> {
        let mut compiler = Compiler::new(kinds, resolve);
        let outputs = exprs.iter().map(|e| compiler.add(e)).collect::<Result<Vec<_>, _>>()?;
        Ok(compiler.finish(&outputs))
    }

    /// Number of registers that [`eval`](Self::eval) needs.
    pub fn registers(&self) -> usize {
        self.leaves + self.constants.len() + self.ops.len()
    }

    /// Number of leaves, the delays' included (they come last).
    pub fn leaves(&self) -> usize {
        self.leaves
    }

    /// Number of operations evaluated at every point (without the prologue).
    pub fn body_len(&self) -> usize {
        self.ops.len() - self.prologue
    }

    /// Whether a register depends on parameters alone (it is set once per simulation).
    pub fn is_fixed(&self, r: Reg) -> bool {
        let r = r as usize;
        if r < self.leaves {
            self.kinds[r] == LeafKind::Parameter
        } else {
            r < self.first_op() + self.prologue
        }
    }

    /// The value of a register that is a constant of the program, whatever the parameters.
    pub fn constant_value(&self, r: Reg) -> Option<f64> {
        (r as usize).checked_sub(self.leaves).and_then(|i| self.constants.get(i)).copied()
    }

    fn first_op(&self) -> usize {
        self.leaves + self.constants.len()
    }

    /// Fills the constants and evaluates the operations that depend on parameters alone. The
    /// parameters' leaves must be set. Modes of switches in the prologue are set from their values.
    pub fn prepare(&self, regs: &mut [f64], modes: &mut [i8]) {
        let first = self.first_op();
        regs[self.leaves..first].copy_from_slice(&self.constants);
        code::run::<true>(&self.prepared, first, &self.switches, regs, modes, &[]);
    }

    /// Evaluates the body with fixed modes; `lambda[k]` is the value of a sticking `sign` `k`.
    #[inline]
    pub fn eval(&self, regs: &mut [f64], modes: &mut [i8], lambda: &[f64]) {
        if let Some(values) = self.values() {
            return values.run(0, regs, modes, lambda, &mut []);
        }
        code::run::<false>(&self.code, self.first_op() + self.prologue, &self.switches, regs, modes, lambda);
    }

    /// Evaluates what depends on the value `lambda[k]` of the sticking `sign` with index `k` in `switches`, after that has changed.
    /// All else in `regs` must stand as [`eval`](Self::eval) left it; the result is what `eval` would give. A switch of another
    /// kind changes nothing.
    #[inline]
    pub fn eval_after(&self, k: usize, regs: &mut [f64], modes: &mut [i8], lambda: &[f64]) {
        if let Some(values) = self.values() {
            return values.run(1 + k, regs, modes, lambda, &mut []);
        }
        code::again(&self.after[k], &self.switches, regs, modes, lambda);
    }

    /// Evaluates the body with every mode taken from the arguments' values as they are met, and
    /// leaves the modes in `modes`.
    pub fn eval_natural(&self, regs: &mut [f64], modes: &mut [i8]) {
        code::run::<true>(&self.code, self.first_op() + self.prologue, &self.switches, regs, modes, &[]);
    }

    /// Which registers can have a non-zero derivative when the leaves marked in `leaf_active` have, and how
    /// each is computed. (The value of a sticking sign counts as a constant.)
    pub fn tangents(&self, leaf_active: &[bool]) -> Tangents {
        Tangents::new(&self.ops, self.prologue, self.first_op(), &self.switches, leaf_active)
    }

    /// [`tangents`](Self::tangents) for `lanes` directions, compiled when they are first asked for, where the machine can; made once
    /// for all copies of the tape.
    pub fn compiled_tangents(&self, leaf_active: &[bool], lanes: usize) -> Arc<Tangents> {
        match &self.compiled {
            Some(compiled) => compiled.tangents(leaf_active, lanes, || {
                let mut tangents = self.tangents(leaf_active);
                tangents.lanes = Some(lanes);
                tangents
            }),
            None => Arc::new(self.tangents(leaf_active)),
        }
    }

    /// Programs made of the rules of [`tangents`](Self::tangents), in the frame of whoever simulates: each of
    /// the `frames` gets the rules and gives those of its program. Made once for all copies of the tape and one `purpose`; `None`
    /// where nothing is compiled.
    pub fn compiled_programs(
        &self,
        (leaf_active, lanes, purpose): (&[bool], usize, usize),
        frames: &[&dyn Fn(&Rules) -> Rules],
    ) -> Option<Arc<Vec<greybox_jit::Tangents>>> {
        self.compiled.as_ref()?.programs((leaf_active, lanes, purpose), || {
            let tangents = self.tangents(leaf_active);
            let (before, rules) = tangents::rules(&tangents.body, &self.switches);
            let compile = |frame: &&dyn Fn(&Rules) -> Rules| {
                greybox_jit::Tangents::compile(&before, &frame(&rules), lanes)
            };
            frames.iter().map(compile).collect()
        })
    }

    /// Programs made of the body, in the frame of whoever simulates: each of the `frames` gets the operations of
    /// [`eval`](Self::eval) and gives those of its program. Made once for all copies of the tape and one `purpose`; `None` where
    /// nothing is compiled.
    pub fn compiled_values(
        &self,
        purpose: usize,
        frames: &[&dyn Fn(&Operations) -> Operations],
    ) -> Option<Arc<greybox_jit::Values>> {
        self.compiled.as_ref()?.framed(purpose, || {
            let first = self.first_op() + self.prologue;
            let body = compiled::body(&self.ops[self.prologue..], first, &self.switches);
            let programs: Vec<_> = frames.iter().map(|frame| frame(&body)).collect();
            let programs: Vec<_> = programs.iter().map(Vec::as_slice).collect();
            greybox_jit::Values::compile(&programs)
        })
    }

    /// The same tape, never compiled: the oracle of what is.
    #[must_use]
    pub fn interpreted(&self) -> Tape {
        Tape { compiled: None, ..self.clone() }
    }

    #[inline]
    fn values(&self) -> Option<&greybox_jit::Values> {
        self.compiled.as_ref()?.values(|| {
            let first = self.first_op() + self.prologue;
            compiled::values(&self.ops[self.prologue..], first, &self.after, &self.switches)
        })
    }

    /// Directional derivatives of every register for `lanes` directions at the point whose values
    /// stand in `regs`. `d` is `registers × lanes`, row major; the leaves' rows (and, for the body,
    /// the prologue's) must be set, rows that are not active zero.
    ///
    /// Inlined, so that a caller's literal `lanes` and instruction set are those of its loops.
    #[inline(always)]
    pub fn tangent(&self, tangents: &Tangents, regs: &[f64], modes: &[i8], lanes: usize, d: &mut [f64]) {
        if let Some(code) = tangents.code(&self.switches, lanes) {
            return code.run(regs, modes, d);
        }
        let at = tangents::Place { regs, modes, switches: &self.switches };
        tangents::run(&tangents.body, at, lanes, d);
    }

    /// [`tangent`](Self::tangent) of the prologue: once per simulation.
    pub fn prepare_tangent(
        &self,
        tangents: &Tangents,
        regs: &[f64],
        modes: &[i8],
        lanes: usize,
        d: &mut [f64],
    ) {
        let at = tangents::Place { regs, modes, switches: &self.switches };
        d[self.leaves * lanes..self.first_op() * lanes].fill(0.0);
        tangents::run(&tangents.prologue, at, lanes, d);
    }

    /// Evaluates the outputs at `n` points; every non-smooth function pointwise, sign(0) = 0.
    /// `leaf(i)` gives leaf `i` as one value or one per point; delays' leaves must be given too.
    /// The result holds one vector of length `n` per output.
    pub fn eval_batch<'d>(&self, n: usize, leaf: &dyn Fn(usize) -> Column<'d>) -> Vec<Vec<f64>> {
        const LANES: usize = 16;
        let columns: Vec<Column<'d>> = (0..self.leaves).map(leaf).collect();
        let first = self.first_op();
        let mut regs = vec![[0.0; LANES]; self.registers()];
        for (r, c) in regs[self.leaves..first].iter_mut().zip(&self.constants) {
            *r = [*c; LANES];
        }
        let mut out: Vec<Vec<f64>> = vec![Vec::with_capacity(n); self.outputs.len()];
        let mut start = 0;
        while start < n {
            let width = LANES.min(n - start);
            for (r, c) in regs.iter_mut().zip(&columns) {
                match c {
                    Column::Value(v) => *r = [*v; LANES],
                    // Idle lanes of the last block repeat its last point.
                    Column::Series(s) => {
                        for (l, x) in r.iter_mut().enumerate() {
                            *x = s[start + l.min(width - 1)];
                        }
                    }
                }
            }
            for (i, op) in self.ops.iter().enumerate() {
                let (lower, upper) = regs.split_at_mut(first + i);
                let o = &mut upper[0];
                let r = |a: Reg| &lower[a as usize];
                macro_rules! map2 {
                    ($a:expr, $b:expr, $f:expr) => {
                        for ((o, x), y) in o.iter_mut().zip(r($a)).zip(r($b)) {
                            *o = $f(*x, *y);
                        }
                    };
                }
                match *op {
                    Op::Of(f, a) => {
                        for (o, x) in o.iter_mut().zip(r(a)) {
                            *o = f.value(*x);
                        }
                    }
                    Op::Add(a, b) => map2!(a, b, |x: f64, y: f64| x + y),
                    Op::Sub(a, b) => map2!(a, b, |x: f64, y: f64| x - y),
                    Op::Mul(a, b) => map2!(a, b, |x: f64, y: f64| x * y),
                    Op::Div(a, b) => map2!(a, b, |x: f64, y: f64| x / y),
                    Op::Pow(a, b) => map2!(a, b, f64::powf),
                    Op::Powi(a, n) => {
                        for (o, x) in o.iter_mut().zip(r(a)) {
                            *o = powi(*x, n);
                        }
                    }
                    Op::Switch(k) => {
                        let s = &self.switches[k as usize];
                        map2!(s.a, s.b, |x: f64, y: f64| s.value(s.natural_mode(x, y), 0.0, x, y));
                    }
                }
            }
            for (o, &reg) in out.iter_mut().zip(&self.outputs) {
                o.extend_from_slice(&regs[reg as usize][..width]);
            }
            start += width;
        }
        out
    }
}

/// A leaf of [`Tape::eval_batch`].
#[derive(Debug, Clone, Copy)]
pub enum Column<'a> {
    /// The same at every point.
    Value(f64),
    /// One value per point.
    Series(&'a [f64]),
}

#[inline]
fn powi(x: f64, n: i32) -> f64 {
    match n {
        0 => 1.0,
        1 => x,
        2 => x * x,
        3 => x * x * x,
        _ => x.powi(n),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(n: &str, primes: u8) -> Option<usize> {
        match (n, primes) {
            ("x", 0) => Some(0),
            ("x", 1) => Some(1),
            ("k", 0) => Some(2),
            _ => None,
        }
    }

    fn kinds() -> Vec<LeafKind> {
        vec![LeafKind::Varying, LeafKind::Varying, LeafKind::Parameter]
    }

    fn sample() -> Expr {
        let (x, v, k) = (Expr::var("x"), Expr::prime("x", 1), Expr::var("k"));
        let cube = x.clone().pow(Expr::Num(3.0));
        k.clone() * cube * Expr::call(Func::Sin, vec![v.clone()])
            + Expr::call(Func::Deadzone, vec![x.clone(), k.clone() / Expr::Num(8.0)])
            + Expr::call(Func::Abs, vec![v.clone()]) * (k.clone() * k.clone())
            - Expr::call(Func::Saturate, vec![x.clone(), Expr::Num(0.5)])
            + Table::call(x, &[-0.8, 0.05, 0.6], vec![k.clone(), Expr::Num(0.3), v * k])
    }

    fn by_hand(x: f64, v: f64, k: f64) -> f64 {
        let gap = k / 8.0;
        let dz = if x.abs() <= gap { 0.0 } else { x - gap * x.signum() };
        let (left, middle, right) = (k, 0.3, v * k);
        let table = match x {
            x if x < -0.8 => left,
            x if x < 0.05 => left + (middle - left) * (x + 0.8) / 0.85,
            x if x < 0.6 => middle + (right - middle) * (x - 0.05) / 0.55,
            _ => right,
        };
        k * x.powi(3) * v.sin() + dz + v.abs() * k * k - x.clamp(-0.5, 0.5) + table
    }

    #[test]
    fn one_point_batch_and_by_hand_agree() {
        let tape = Tape::compile(&[sample()], kinds(), &names).unwrap();
        let xs: Vec<f64> = (0..37).map(|i| -1.2 + 0.065 * i as f64).collect();
        let vs: Vec<f64> = (0..37).map(|i| 0.9 - 0.05 * i as f64).collect();
        let batch = tape.eval_batch(37, &|i| match i {
            0 => Column::Series(&xs),
            1 => Column::Series(&vs),
            _ => Column::Value(1.7),
        });
        for i in 0..37 {
            let mut regs = vec![0.0; tape.registers()];
            let mut modes = vec![0; tape.switches.len()];
            regs[..3].copy_from_slice(&[xs[i], vs[i], 1.7]);
            tape.prepare(&mut regs, &mut modes);
            tape.eval_natural(&mut regs, &mut modes);
            let value = regs[tape.outputs[0] as usize];
            assert!((value - by_hand(xs[i], vs[i], 1.7)).abs() < 1e-14);
            assert_eq!(value, batch[0][i]);
        }
    }

    #[test]
    fn tangents_match_central_differences() {
        let tape = Tape::compile(&[sample()], kinds(), &names).unwrap();
        for (x, v, k) in [(0.4, 0.3, 1.7), (-0.9, -0.4, 0.8), (0.1, 0.7, 2.0)] {
            let mut regs = vec![0.0; tape.registers()];
            let mut modes = vec![0; tape.switches.len()];
            regs[..3].copy_from_slice(&[x, v, k]);
            tape.prepare(&mut regs, &mut modes);
            tape.eval_natural(&mut regs, &mut modes);
            let tangents = tape.tangents(&[true, true, true]);
            let mut d = vec![0.0; tape.registers() * 3];
            for i in 0..3 {
                d[i * 3 + i] = 1.0;
            }
            tape.prepare_tangent(&tangents, &regs, &modes, 3, &mut d);
            tape.tangent(&tangents, &regs, &modes, 3, &mut d);
            let row = &d[tape.outputs[0] as usize * 3..][..3];
            let h = 1e-6;
            let numeric = [
                (by_hand(x + h, v, k) - by_hand(x - h, v, k)) / (2.0 * h),
                (by_hand(x, v + h, k) - by_hand(x, v - h, k)) / (2.0 * h),
                (by_hand(x, v, k + h) - by_hand(x, v, k - h)) / (2.0 * h),
            ];
            for l in 0..3 {
                assert!((row[l] - numeric[l]).abs() < 1e-8, "{row:?} {numeric:?}");
            }
        }
    }

    #[test]
    fn parameters_alone_are_hoisted_and_shared_terms_merged() {
        let k2 = || Expr::var("k") * Expr::var("k");
        let tape = Tape::compile(&[k2() * Expr::var("x"), k2() + Expr::var("x")], kinds(), &names).unwrap();
        assert_eq!(tape.prologue, 1);
        assert_eq!(tape.body_len(), 2);
    }

    #[test]
    fn operations_in_pairs_round_as_they_do_one_by_one() {
        let (x, v) = (|| Expr::var("x"), || Expr::prime("x", 1));
        let (k, square) = (|| Expr::var("k") * x(), || x().pow(Expr::Num(2.0)));
        let exprs = [
            x() * v() + k(),
            v() + v() * k(),
            Expr::var("k") * v() - x(),
            x() - v() * v(),
            x() * v() * k() * v(),
            v() * (k() * square()),
            square() + v(),
            (v() * k()) * (v() * k()),
            square() - square(),
        ];
        let tape = Tape::compile(&exprs, kinds(), &names).unwrap();
        assert!(tape.code.len() + 5 < tape.body_len(), "{:?}", tape.code);
        let xs: Vec<f64> = (0..40).map(|i| (0.37 * i as f64).sin() * 3.0).collect();
        let vs: Vec<f64> = (0..40).map(|i| (0.91 * i as f64).cos() * 0.7).collect();
        let batch = tape.eval_batch(40, &|i| match i {
            0 => Column::Series(&xs),
            1 => Column::Series(&vs),
            _ => Column::Value(1.0 / 3.0),
        });
        let mut regs = vec![0.0; tape.registers()];
        regs[2] = 1.0 / 3.0;
        tape.prepare(&mut regs, &mut []);
        for (i, (x, v)) in xs.iter().zip(&vs).enumerate() {
            regs[..2].copy_from_slice(&[*x, *v]);
            tape.eval(&mut regs, &mut [], &[]);
            for (one_by_one, &r) in batch.iter().zip(&tape.outputs) {
                assert_eq!(regs[r as usize].to_bits(), one_by_one[i].to_bits());
            }
        }
    }

    #[test]
    fn an_unknown_name_is_told_with_its_primes() {
        let error = Tape::compile(&[Expr::prime("y", 2)], kinds(), &names).unwrap_err();
        assert_eq!(error.to_string(), "unknown name `y''`");
    }

    /// In a chain of sums each result is the next one's operand, on either side of it.
    #[test]
    fn a_chain_rounds_as_its_operations_do() {
        let (x, v, k) = (Expr::var("x"), Expr::prime("x", 1), Expr::var("k"));
        let chain =
            x.clone() * v.clone() + k.clone() * v.clone() - x.clone() * x.clone() + v.clone() - k.clone();
        let expr = (k.clone() * (v.clone() * (chain * x.clone()))) - v * k;
        let tape = Tape::compile(&[expr], kinds(), &names).unwrap();
        let is_link = |c: &&Code| {
            use Code::*;
            matches!(c, Plus(_) | Less(_) | Times(_) | PlusMul(..) | LessMul(..))
        };
        assert!(tape.code.iter().filter(is_link).count() >= 6, "{:?}", tape.code);
        let mut regs = vec![0.0; tape.registers()];
        for i in 0..40 {
            let (x, v, k) = ((0.37 * f64::from(i)).sin() * 3.0, (0.91 * f64::from(i)).cos() * 0.7, 1.0 / 3.0);
            regs[..3].copy_from_slice(&[x, v, k]);
            tape.prepare(&mut regs, &mut []);
            tape.eval(&mut regs, &mut [], &[]);
            let chain = x * v + k * v - x * x + v - k;
            assert_eq!(regs[tape.outputs[0] as usize], k * (v * (chain * x)) - v * k);
        }
    }

    /// What a sign's value changes is evaluated again as all of it would be, whatever hangs on two signs.
    #[test]
    fn what_depends_on_a_sign_alone_is_evaluated_again() {
        let (x, v, k) = (Expr::var("x"), Expr::prime("x", 1), Expr::var("k"));
        let sign = |e: Expr| Expr::call(Func::Sign, vec![e]);
        let first = sign(v.clone()) * k.clone() + x.clone();
        let exprs = [first.clone() * sign(x.clone() - v.clone()), x.clone() * v.clone(), first, x - k];
        let tape = Tape::compile(&exprs, kinds(), &names).unwrap();
        assert_eq!(tape.after.iter().map(Vec::len).collect::<Vec<_>>(), [4, 2]);
        let mut regs = vec![0.0; tape.registers()];
        regs[..3].copy_from_slice(&[0.3, 0.7, 1.3]);
        let (mut modes, mut lambda) = ([0; 2], [0.0; 2]);
        tape.prepare(&mut regs, &mut modes);
        modes = [0; 2];
        tape.eval(&mut regs, &mut modes, &lambda);
        for (k, value) in [(0, 0.4), (1, -0.6), (0, -1.0)] {
            lambda[k] = value;
            tape.eval_after(k, &mut regs, &mut modes, &lambda);
            let mut all = regs.clone();
            tape.eval(&mut all, &mut modes, &lambda);
            assert_eq!(regs, all);
        }
    }
}
