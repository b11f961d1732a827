//! The tape as machine code, where the machine has a compiler; bit for bit what the interpreter computes, which stands in where it
//! has none.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use greybox_jit::{Operand, Operation, Operations, Values};

use super::tangents::Tangents;
use super::{Op, Reg, Smooth, Switch, SwitchKind};

/// Programs for tangents that are kept: a diagnosis has some for each model, for fits and for screening.
const MOST_KEPT: usize = 32;

/// What was compiled of a tape; shared by its copies.
#[derive(Debug, Default)]
pub(super) struct Compiled {
    values: OnceLock<Option<Values>>,
    tangents: Mutex<Vec<Known<Arc<Tangents>>>>,
    programs: Mutex<Vec<Known<Option<Programs>>>>,
    framed: Mutex<Vec<Known<Option<Arc<Values>>>>>,
}

/// Programs that whoever simulates the tape made of its tangents.
pub(super) type Programs = Arc<Vec<greybox_jit::Tangents>>;

/// What was made for the leaves that have tangents, with so many lanes, and for one purpose.
#[derive(Debug)]
struct Known<T> {
    leaves: Vec<bool>,
    lanes: usize,
    purpose: usize,
    made: T,
}

/// What is known, or is made now.
fn known<T: Clone>(
    all: &Mutex<Vec<Known<T>>>,
    (leaves, lanes, purpose): (&[bool], usize, usize),
    make: impl FnOnce() -> T,
) -> T {
    let mut all = all.lock().unwrap_or_else(PoisonError::into_inner);
    let is_it = |k: &&Known<T>| k.lanes == lanes && k.purpose == purpose && k.leaves == leaves;
    if let Some(found) = all.iter().find(is_it) {
        return found.made.clone();
    }
    if all.len() == MOST_KEPT {
        all.clear();
    }
    let made = make();
    all.push(Known { leaves: leaves.to_vec(), lanes, purpose, made: made.clone() });
    made
}

impl Compiled {
    /// The body, and behind it for every switch what depends on its value.
    #[inline]
    pub(super) fn values(&self, make: impl FnOnce() -> Option<Values>) -> Option<&Values> {
        self.values.get_or_init(make).as_ref()
    }

    pub(super) fn tangents(
        &self,
        leaves: &[bool],
        lanes: usize,
        make: impl FnOnce() -> Tangents,
    ) -> Arc<Tangents> {
        known(&self.tangents, (leaves, lanes, 0), || Arc::new(make()))
    }

    pub(super) fn framed(
        &self,
        purpose: usize,
        make: impl FnOnce() -> Option<Values>,
    ) -> Option<Arc<Values>> {
        known(&self.framed, (&[], 0, purpose), || make().map(Arc::new))
    }

    pub(super) fn programs(
        &self,
        for_what: (&[bool], usize, usize),
        make: impl FnOnce() -> Option<Vec<greybox_jit::Tangents>>,
    ) -> Option<Programs> {
        known(&self.programs, for_what, || make().map(Arc::new))
    }
}

/// Makes a function of Rust one that a program can call.
macro_rules! callable {
    ($name:ident, ($($argument:ident: $kind:ty),+), $value:expr) => {
        #[cfg(target_arch = "x86_64")]
        extern "sysv64" fn $name($($argument: $kind),+) -> f64 {
            $value
        }
        #[cfg(not(target_arch = "x86_64"))]
        extern "C" fn $name($($argument: $kind),+) -> f64 {
            $value
        }
    };
}

callable!(sin, (x: f64), Smooth::Sin.value(x));
callable!(cos, (x: f64), Smooth::Cos.value(x));
callable!(tan, (x: f64), Smooth::Tan.value(x));
callable!(exp, (x: f64), Smooth::Exp.value(x));
callable!(ln, (x: f64), Smooth::Ln.value(x));
callable!(tanh, (x: f64), Smooth::Tanh.value(x));
callable!(atan, (x: f64), Smooth::Atan.value(x));
callable!(positive, (x: f64), Smooth::Positive.value(x));
callable!(slope_of_root, (x: f64, y: f64), Smooth::Sqrt.slope(x, y));
callable!(slope_of_sin, (x: f64, y: f64), Smooth::Sin.slope(x, y));
callable!(slope_of_cos, (x: f64, y: f64), Smooth::Cos.slope(x, y));
callable!(slope_of_tan, (x: f64, y: f64), Smooth::Tan.slope(x, y));
callable!(slope_of_exp, (x: f64, y: f64), Smooth::Exp.slope(x, y));
callable!(slope_of_ln, (x: f64, y: f64), Smooth::Ln.slope(x, y));
callable!(slope_of_tanh, (x: f64, y: f64), Smooth::Tanh.slope(x, y));
callable!(slope_of_atan, (x: f64, y: f64), Smooth::Atan.slope(x, y));
callable!(slope_of_positive, (x: f64, y: f64), Smooth::Positive.slope(x, y));
callable!(power, (x: f64, y: f64), x.powf(y));
callable!(integer_power, (x: f64, n: i32), super::powi(x, n));

/// A list of operations that grows.
#[derive(Default)]
pub(super) struct Program {
    pub(super) operations: Operations,
    locals: u32,
}

/// A register of the tape.
pub(super) fn register(r: Reg) -> Operand {
    Operand::Register(r)
}

impl Program {
    /// The result of an operation in a number of the program's own.
    pub(super) fn local(&mut self, operation: Operation) -> Operand {
        let to = Operand::Local(self.locals);
        self.locals += 1;
        self.operations.push((to, operation));
        to
    }

    /// aⁿ, as the interpreter multiplies it out.
    pub(super) fn power(&mut self, a: Operand, n: i32) -> Operation {
        match n {
            0 => Operation::Sum(Operand::Constant(1.0), Operand::Constant(0.0)),
            1 => Operation::Product(a, Operand::Constant(1.0)),
            2 => Operation::Product(a, a),
            3 => {
                let square = self.local(Operation::Product(a, a));
                Operation::Product(square, a)
            }
            n => Operation::Power(integer_power, a, n),
        }
    }

    /// a^b.
    pub(super) fn real_power(a: Operand, b: Operand) -> Operation {
        Operation::Binary(power, a, b)
    }

    pub(super) fn logarithm(a: Operand) -> Operation {
        Operation::Unary(ln, a)
    }

    /// The derivative of a function at `x`, where it is `y`.
    pub(super) fn slope(&mut self, f: Smooth, x: Operand, y: Operand) -> Operand {
        let slope = match f {
            Smooth::Neg => return Operand::Constant(-1.0),
            Smooth::Sqrt => slope_of_root,
            Smooth::Sin => slope_of_sin,
            Smooth::Cos => slope_of_cos,
            Smooth::Tan => slope_of_tan,
            Smooth::Exp => slope_of_exp,
            Smooth::Ln => slope_of_ln,
            Smooth::Tanh => slope_of_tanh,
            Smooth::Atan => slope_of_atan,
            Smooth::Positive => slope_of_positive,
        };
        self.local(Operation::Binary(slope, x, y))
    }

    /// An operation of the tape.
    fn push(&mut self, out: Reg, op: Op, switches: &[Switch]) {
        let operation = match op {
            Op::Of(Smooth::Neg, a) => Operation::Negative(register(a)),
            Op::Of(Smooth::Sqrt, a) => Operation::Root(register(a)),
            Op::Of(Smooth::Sin, a) => Operation::Unary(sin, register(a)),
            Op::Of(Smooth::Cos, a) => Operation::Unary(cos, register(a)),
            Op::Of(Smooth::Tan, a) => Operation::Unary(tan, register(a)),
            Op::Of(Smooth::Exp, a) => Operation::Unary(exp, register(a)),
            Op::Of(Smooth::Ln, a) => Operation::Unary(ln, register(a)),
            Op::Of(Smooth::Tanh, a) => Operation::Unary(tanh, register(a)),
            Op::Of(Smooth::Atan, a) => Operation::Unary(atan, register(a)),
            Op::Of(Smooth::Positive, a) => Operation::Unary(positive, register(a)),
            Op::Add(a, b) => Operation::Sum(register(a), register(b)),
            Op::Sub(a, b) => Operation::Difference(register(a), register(b)),
            Op::Mul(a, b) => Operation::Product(register(a), register(b)),
            Op::Div(a, b) => Operation::Quotient(register(a), register(b)),
            Op::Powi(a, n) => self.power(register(a), n),
            Op::Pow(a, b) => Self::real_power(register(a), register(b)),
            Op::Switch(k) => self.switch(k, &switches[k as usize]),
        };
        self.operations.push((register(out), operation));
        // (Numbers on the way to a register serve no other.)
        self.locals = 0;
    }

    /// A non-smooth function in its mode.
    fn switch(&mut self, k: u32, switch: &Switch) -> Operation {
        let (a, b) = (register(switch.a), register(switch.b));
        let (zero, one) = (Operand::Constant(0.0), Operand::Constant(1.0));
        match switch.kind {
            SwitchKind::Sign => Operation::HeldMode(k),
            SwitchKind::Abs => {
                let mode = self.local(Operation::Mode(k));
                Operation::Product(mode, a)
            }
            SwitchKind::Max => Operation::Select(k, [b, b, a]),
            SwitchKind::Min => Operation::Select(k, [a, a, b]),
            SwitchKind::Deadzone => {
                let mode = self.local(Operation::Mode(k));
                let bound = self.local(Operation::Product(mode, b));
                let beyond = self.local(Operation::Difference(a, bound));
                Operation::Select(k, [beyond, zero, beyond])
            }
            SwitchKind::Saturate => {
                let mode = self.local(Operation::Mode(k));
                let bound = self.local(Operation::Product(mode, b));
                Operation::Select(k, [bound, a, bound])
            }
            SwitchKind::Step => Operation::Select(k, [zero, zero, one]),
        }
    }
}

/// The program of operations, each with its register.
fn program(ops: impl Iterator<Item = (Reg, Op)>, switches: &[Switch]) -> Operations {
    let mut program = Program::default();
    ops.for_each(|(out, op)| program.push(out, op, switches));
    program.operations
}

/// The program of the body, whose results stand in the registers from `first` on.
pub(super) fn body(body: &[Op], first: usize, switches: &[Switch]) -> Operations {
    program((first as Reg..).zip(body.iter().copied()), switches)
}

/// The body, whose results stand in the registers from `first` on, and for every switch what comes `after` it.
pub(super) fn values(
    body: &[Op],
    first: usize,
    after: &[Vec<(Reg, Op)>],
    switches: &[Switch],
) -> Option<Values> {
    let body = self::body(body, first, switches);
    let after: Vec<_> = after.iter().map(|ops| program(ops.iter().copied(), switches)).collect();
    let programs: Vec<&[(Operand, Operation)]> =
        std::iter::once(&body).chain(&after).map(Vec::as_slice).collect();
    Values::compile(&programs)
}

#[cfg(test)]
mod tests {
    use crate::expr::{BinOp, Expr, Func};
    use crate::tape::{LeafKind, Tape};

    /// A generator of test numbers (Marsaglia's xorshift).
    struct Random(u64);

    impl Random {
        fn below(&mut self, n: usize) -> usize {
            self.0 ^= self.0 << 13;
            self.0 ^= self.0 >> 7;
            self.0 ^= self.0 << 17;
            (self.0 % n as u64) as usize
        }

        fn number(&mut self) -> f64 {
            self.below(4001) as f64 / 1000.0 - 2.0
        }
    }

    const LEAVES: [&str; 6] = ["x", "v", "u", "k", "c", "p"];

    fn leaf(name: &str, _: u8) -> Option<usize> {
        LEAVES.iter().position(|l| *l == name)
    }

    fn kinds() -> Vec<LeafKind> {
        use LeafKind::{Input, Parameter, Varying};
        vec![Varying, Varying, Input, Parameter, Parameter, Parameter]
    }

    fn expression(random: &mut Random, depth: usize) -> Expr {
        if depth == 0 || random.below(8) == 0 {
            return match random.below(4) {
                0 => Expr::Num(random.number()),
                _ => Expr::var(LEAVES[random.below(LEAVES.len())]),
            };
        }
        let mut of = || expression(random, depth - 1);
        let (a, b) = (of(), of());
        let of_one = [
            Func::Sin,
            Func::Cos,
            Func::Tan,
            Func::Exp,
            Func::Ln,
            Func::Sqrt,
            Func::Tanh,
            Func::Atan,
            Func::Sign,
            Func::Abs,
        ];
        let of_two = [Func::Min, Func::Max, Func::Deadzone, Func::Saturate, Func::Step];
        match random.below(16) {
            0..=2 => a + b,
            3 | 4 => a - b,
            5..=7 => a * b,
            8 => a / b,
            9 => Expr::Neg(Box::new(a)),
            10 => Expr::Bin(BinOp::Pow, Box::new(a), Box::new(Expr::Num(random.below(8) as f64 - 2.0))),
            11 => Expr::Bin(BinOp::Pow, Box::new(Expr::call(Func::Abs, vec![a])), Box::new(b)),
            12 | 13 => Expr::call(of_one[random.below(of_one.len())], vec![a]),
            _ => Expr::call(of_two[random.below(of_two.len())], vec![a, b]),
        }
    }

    fn assert_same(found: &[f64], wanted: &[f64], what: &str) {
        for (i, (a, b)) in found.iter().zip(wanted).enumerate() {
            assert!(
                a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan(),
                "{what}, entry {i}: {a:e}, not {b:e}"
            );
        }
    }

    /// Every function, in every mode, one point and many directions: the bits of the interpreter.
    #[test]
    fn machine_code_gives_the_bits_of_the_interpreter() {
        let mut random = Random(0x2545_F491_4F6C_DD1D);
        let mut has_code = 0;
        for round in 0..300 {
            let exprs: Vec<Expr> = (0..3).map(|_| expression(&mut random, 5)).collect();
            let tape = Tape::compile(&exprs, kinds(), &leaf).unwrap();
            let oracle = tape.interpreted();
            assert!(oracle.values().is_none());
            has_code += usize::from(tape.values().is_some());
            let mut regs = vec![0.0; tape.registers()];
            regs[..6].iter_mut().for_each(|r| *r = random.number());
            let mut modes = vec![0; tape.switches.len()];
            tape.prepare(&mut regs, &mut modes);
            for (mode, switch) in modes.iter_mut().zip(&tape.switches) {
                if switch.live {
                    *mode = random.below(3) as i8 - 1;
                }
            }
            let mut lambda: Vec<f64> = modes.iter().map(|_| random.number() / 2.0).collect();
            let mut own = regs.clone();
            tape.eval(&mut regs, &mut modes.clone(), &lambda);
            oracle.eval(&mut own, &mut modes.clone(), &lambda);
            assert_same(&regs, &own, &format!("round {round}: {exprs:?}"));
            for k in 0..modes.len() {
                lambda[k] = random.number() / 2.0;
                tape.eval_after(k, &mut regs, &mut modes.clone(), &lambda);
                oracle.eval_after(k, &mut own, &mut modes.clone(), &lambda);
                assert_same(&regs, &own, &format!("round {round}, after {k}: {exprs:?}"));
            }
            let active: Vec<bool> = (0..tape.leaves()).map(|i| (round >> (i % 3)) & 1 == 0).collect();
            let lanes = [1, 2, 3, 4, 8, 12, 16, 24][round % 8];
            let compiled = tape.compiled_tangents(&active, lanes);
            let rules = oracle.compiled_tangents(&active, lanes);
            let has_code = |t: &super::Tangents| t.code(&tape.switches, lanes).is_some();
            assert!(has_code(&compiled) == tape.values().is_some() && !has_code(&rules));
            let mut d = vec![0.0; tape.registers() * lanes];
            for (row, _) in d.chunks_mut(lanes).zip(&active).filter(|(_, active)| **active) {
                row.iter_mut().for_each(|d| *d = random.number());
            }
            tape.prepare_tangent(&compiled, &regs, &modes, lanes, &mut d);
            let mut wanted = d.clone();
            tape.tangent(&compiled, &regs, &modes, lanes, &mut d);
            oracle.tangent(&rules, &regs, &modes, lanes, &mut wanted);
            assert_same(&d, &wanted, &format!("round {round}, {lanes} lanes: {exprs:?}"));
        }
        // A machine with a compiler compiles all of it, another nothing.
        let wanted = if greybox_jit::Values::compile(&[&[]]).is_some() { 300 } else { 0 };
        assert_eq!(has_code, wanted);
    }

    /// What was made for some leaves and lanes is made once, for all copies of a tape.
    #[test]
    fn tangents_are_made_once() {
        let tape = Tape::compile(&[Expr::var("x") * Expr::var("k")], kinds(), &leaf).unwrap();
        let leaves = [true; 6];
        let first = tape.compiled_tangents(&leaves, 4);
        assert!(std::sync::Arc::ptr_eq(&first, &tape.clone().compiled_tangents(&leaves, 4)));
        assert!(!std::sync::Arc::ptr_eq(&first, &tape.compiled_tangents(&leaves, 8)));
        for lanes in 0..3 * super::MOST_KEPT {
            tape.compiled_tangents(&leaves, lanes);
        }
        let kept = tape.compiled.as_ref().unwrap().tangents.lock().unwrap().len();
        assert!(kept <= super::MOST_KEPT, "{kept}");
    }
}
