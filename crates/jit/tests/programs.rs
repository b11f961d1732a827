//! Compiled programs give the bits of the same operations done one by one.

use greybox_jit::{Operand, Operation, Row, Rule, Tangents, Values};

/// A generator of test numbers (Marsaglia's xorshift).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    fn number(&mut self) -> f64 {
        match self.below(40) {
            0 => 0.0,
            1 => -0.0,
            2 => f64::INFINITY,
            3 => 1e-310,
            _ => (self.next() as f64 / u64::MAX as f64 - 0.5) * 8.0,
        }
    }
}

#[cfg(target_arch = "x86_64")]
macro_rules! function {
    ($name:ident, ($($argument:ident: $kind:ty),+), $value:expr) => {
        extern "sysv64" fn $name($($argument: $kind),+) -> f64 { $value }
    };
}
#[cfg(not(target_arch = "x86_64"))]
macro_rules! function {
    ($name:ident, ($($argument:ident: $kind:ty),+), $value:expr) => {
        extern "C" fn $name($($argument: $kind),+) -> f64 { $value }
    };
}

function!(sine, (x: f64), x.sin());
function!(skewed, (x: f64, y: f64), x - 2.0 * y);
function!(power, (x: f64, n: i32), x.powi(n));

const REGISTERS: usize = 24;
const LOCALS: usize = 20;
const SHARED: usize = 6;
const MODES: usize = 5;

/// What a program works on.
#[derive(Clone)]
struct State {
    registers: Vec<f64>,
    shared: Vec<f64>,
    locals: Vec<f64>,
    modes: Vec<i8>,
    held: Vec<f64>,
}

impl State {
    fn new(random: &mut Random) -> State {
        State {
            registers: (0..REGISTERS).map(|_| random.number()).collect(),
            shared: (0..SHARED).map(|_| random.number()).collect(),
            locals: vec![0.0; LOCALS],
            modes: (0..MODES).map(|_| random.below(3) as i8 - 1).collect(),
            held: (0..MODES).map(|_| random.number()).collect(),
        }
    }

    fn get(&self, operand: Operand) -> f64 {
        match operand {
            Operand::Register(r) => self.registers[r as usize],
            Operand::Shared(s) => self.shared[s as usize],
            Operand::Local(l) => self.locals[l as usize],
            Operand::Constant(v) => v,
        }
    }

    fn value(&self, operation: Operation) -> f64 {
        let g = |o: Operand| self.get(o);
        let sign = |k: u32| (self.modes[k as usize] + 1) as usize;
        match operation {
            Operation::Negative(a) => -g(a),
            Operation::Root(a) => g(a).sqrt(),
            Operation::Sum(a, b) => g(a) + g(b),
            Operation::Difference(a, b) => g(a) - g(b),
            Operation::Product(a, b) => g(a) * g(b),
            Operation::Quotient(a, b) => g(a) / g(b),
            Operation::Unary(f, a) => f(g(a)),
            Operation::Binary(f, a, b) => f(g(a), g(b)),
            Operation::Power(f, a, n) => f(g(a), n),
            Operation::Mode(k) => f64::from(self.modes[k as usize]),
            Operation::HeldMode(k) if self.modes[k as usize] == 0 => self.held[k as usize],
            Operation::HeldMode(k) => f64::from(self.modes[k as usize]),
            Operation::Select(k, cases) => g(cases[sign(k)]),
        }
    }

    fn run(&mut self, program: &[(Operand, Operation)]) {
        for (to, operation) in program {
            let value = self.value(*operation);
            match *to {
                Operand::Register(r) => self.registers[r as usize] = value,
                Operand::Shared(s) => self.shared[s as usize] = value,
                Operand::Local(l) => self.locals[l as usize] = value,
                Operand::Constant(_) => {}
            }
        }
    }
}

/// An operand that is known: any register, one of the first locals, or a constant.
fn operand(random: &mut Random, locals: usize) -> Operand {
    match random.below(8) {
        0 => Operand::Constant(random.number()),
        1 | 2 if locals > 0 => Operand::Local(random.below(locals) as u32),
        _ => Operand::Register(random.below(REGISTERS) as u32),
    }
}

fn operation(random: &mut Random, locals: usize, calls: bool) -> Operation {
    let k = random.below(MODES) as u32;
    let (a, b) = (operand(random, locals), operand(random, locals));
    match random.below(if calls { 14 } else { 11 }) {
        0 => Operation::Negative(a),
        1 => Operation::Root(a),
        2 | 3 => Operation::Sum(a, b),
        4 => Operation::Difference(a, b),
        5 | 6 => Operation::Product(a, b),
        7 => Operation::Quotient(a, b),
        8 => Operation::Mode(k),
        9 => Operation::HeldMode(k),
        10 => Operation::Select(k, [a, b, operand(random, locals)]),
        11 => Operation::Unary(sine, a),
        12 => Operation::Binary(skewed, a, b),
        _ => Operation::Power(power, a, random.below(9) as i32 - 3),
    }
}

fn program(random: &mut Random, calls: bool) -> Vec<(Operand, Operation)> {
    let mut locals = 0;
    (0..60)
        .map(|_| {
            let from = Operand::Shared(random.below(SHARED) as u32);
            let operation = match random.below(8) {
                0 => Operation::Product(from, operand(random, locals)),
                _ => operation(random, locals, calls),
            };
            let to = if random.below(3) == 0 && locals < LOCALS {
                locals += 1;
                Operand::Local(locals as u32 - 1)
            } else if random.below(6) == 0 {
                Operand::Shared(random.below(SHARED) as u32)
            } else {
                Operand::Register(random.below(REGISTERS) as u32)
            };
            (to, operation)
        })
        .collect()
}

/// The same bits, or both no number.
fn same(a: &[f64], b: &[f64]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan())
}

/// Whether this machine compiles; where it does not there is nothing to test.
#[allow(clippy::print_stderr)]
fn compiles() -> bool {
    let can = Values::compile(&[&[]]).is_some();
    if !can {
        eprintln!("skipped: no compiler for this machine");
    }
    can
}

#[test]
fn programs_give_the_bits_of_their_operations() {
    if !compiles() {
        return;
    }
    let mut random = Random(0x9E37_79B9_7F4A_7C15);
    for round in 0..400 {
        let programs: Vec<_> = (0..3).map(|_| program(&mut random, round % 2 == 0)).collect();
        let views: Vec<&[(Operand, Operation)]> = programs.iter().map(Vec::as_slice).collect();
        let compiled = Values::compile(&views).unwrap();
        for (which, program) in programs.iter().enumerate() {
            let mut wanted = State::new(&mut random);
            let mut found = wanted.registers.clone();
            let mut shared = wanted.shared.clone();
            compiled.run(which, &mut found, &wanted.modes, &wanted.held, &mut shared);
            wanted.run(program);
            assert!(
                same(&shared, &wanted.shared) && same(&found, &wanted.registers),
                "round {round}: {program:?}"
            );
        }
    }
}

/// A row of the interpreter.
fn row(d: &[f64], lanes: usize, r: u32) -> Vec<f64> {
    d[r as usize * lanes..][..lanes].to_vec()
}

fn lanes_of(state: &State, d: &[f64], lanes: usize, rule: Row) -> Vec<f64> {
    let row = |r: u32| row(d, lanes, r);
    let two = |a: Vec<f64>, b: Vec<f64>, f: &dyn Fn(f64, f64) -> f64| {
        a.iter().zip(&b).map(|(a, b)| f(*a, *b)).collect()
    };
    match rule {
        Row::Zero => vec![0.0; lanes],
        Row::Copy(a) => row(a),
        Row::Sum(a, b) => two(row(a), row(b), &|a, b| a + b),
        Row::Difference(a, b) => two(row(a), row(b), &|a, b| a - b),
        Row::Scale(k, a) => row(a).iter().map(|a| state.get(k) * a).collect(),
        Row::PlusScaled(a, k, b) => two(row(a), row(b), &|a, b| a + state.get(k) * b),
        Row::MinusScaled(a, k, b) => two(row(a), row(b), &|a, b| a - state.get(k) * b),
        Row::Blend(k, a, l, b) => {
            let (k, l) = (state.get(k), state.get(l));
            two(row(a), row(b), &|a, b| k * a + l * b)
        }
    }
}

fn random_row(random: &mut Random, locals: usize) -> Row {
    let (a, b) = (random.below(REGISTERS) as u32, random.below(REGISTERS) as u32);
    match random.below(10) {
        8 => Row::PlusScaled(a, operand(random, locals), b),
        9 => Row::MinusScaled(a, operand(random, locals), b),
        0 => Row::Zero,
        1 => Row::Copy(a),
        2 => Row::Sum(a, b),
        3 => Row::Difference(a, b),
        4 | 5 => Row::Scale(operand(random, locals), a),
        _ => Row::Blend(operand(random, locals), a, operand(random, locals), b),
    }
}

#[test]
fn tangents_give_the_bits_of_their_rules_for_every_number_of_lanes() {
    if !compiles() {
        return;
    }
    let mut random = Random(42);
    for round in 0..300 {
        let lanes = 1 + round % 25;
        let locals = random.below(LOCALS);
        let before: Vec<_> = (0..locals)
            .map(|l| {
                loop {
                    let operation = operation(&mut random, l, round % 3 == 0);
                    if !matches!(operation, Operation::HeldMode(_)) {
                        break (Operand::Local(l as u32), operation);
                    }
                }
            })
            .collect();
        let rules: Vec<(u32, Rule)> = (0..40)
            .map(|_| {
                let mut of = || random_row(&mut random, locals);
                let (always, select) = (of(), [of(), of(), of()]);
                let rule = match random.below(4) {
                    0 => Rule::Select(random.below(MODES) as u32, select),
                    _ => Rule::Always(always),
                };
                (random.below(REGISTERS) as u32, rule)
            })
            .collect();
        let compiled = Tangents::compile(&before, &rules, lanes).unwrap();
        assert_eq!(compiled.lanes(), lanes);
        let mut state = State::new(&mut random);
        let mut wanted: Vec<f64> = (0..REGISTERS * lanes).map(|_| random.number()).collect();
        let mut found = wanted.clone();
        compiled.run(&state.registers, &state.modes, &mut found);
        state.run(&before);
        for (out, rule) in &rules {
            let rule = match *rule {
                Rule::Always(row) => row,
                Rule::Select(k, cases) => cases[(state.modes[k as usize] + 1) as usize],
            };
            let lanes_found = lanes_of(&state, &wanted, lanes, rule);
            wanted[*out as usize * lanes..][..lanes].copy_from_slice(&lanes_found);
        }
        assert!(same(&found, &wanted), "round {round}, {lanes} lanes: {before:?} {rules:?}");
    }
}

#[test]
fn what_would_reach_beyond_a_slice_is_not_run() {
    if !compiles() {
        return;
    }
    let (far, near) = (Operand::Register(9), Operand::Register(0));
    let program = [
        (near, Operation::Sum(far, near)),
        (near, Operation::HeldMode(2)),
        (Operand::Shared(4), Operation::Mode(0)),
    ];
    let values = Values::compile(&[&program]).unwrap();
    let is_refused = |registers: usize, modes: usize, held: usize, shared: usize| {
        std::panic::catch_unwind(|| {
            values.run(
                0,
                &mut vec![0.0; registers],
                &vec![0; modes],
                &vec![0.0; held],
                &mut vec![0.0; shared],
            );
        })
        .is_err()
    };
    assert!(!is_refused(10, 3, 3, 5));
    assert!(is_refused(9, 3, 3, 5) && is_refused(10, 2, 3, 5) && is_refused(10, 3, 2, 5));
    assert!(is_refused(10, 3, 3, 4));
    let tangents = Tangents::compile(&[], &[(3, Rule::Always(Row::Scale(far, 1)))], 8).unwrap();
    let is_refused = |registers: usize, rows: usize| {
        std::panic::catch_unwind(|| tangents.run(&vec![0.0; registers], &[], &mut vec![0.0; rows])).is_err()
    };
    assert!(!is_refused(10, 32));
    assert!(is_refused(9, 32) && is_refused(10, 31));
}

#[test]
fn what_cannot_be_compiled_is_said() {
    if !compiles() {
        return;
    }
    let too_many: Vec<_> =
        (0..2000).map(|l| (Operand::Local(l), Operation::Negative(Operand::Register(0)))).collect();
    assert!(Values::compile(&[&too_many]).is_none(), "the stack is not for so much");
    let writes = [(Operand::Register(0), Operation::Mode(0))];
    assert!(Tangents::compile(&writes, &[], 4).is_none(), "the registers are only read");
    let shared = [(1, Rule::Always(Row::Scale(Operand::Shared(0), 0)))];
    assert!(Tangents::compile(&[], &shared, 4).is_none(), "rows stand in that place");
    assert!(Tangents::compile(&[], &[], 0).is_none());
    let (local, register) = (Operand::Local(0), Operand::Register(0));
    let unwritten = [(register, Operation::Sum(register, local)), (local, Operation::Mode(0))];
    assert!(Values::compile(&[&unwritten]).is_none(), "nobody knows what stands there");
    let rows = [(1, Rule::Always(Row::Scale(local, 0)))];
    assert!(Tangents::compile(&[], &rows, 4).is_none());
    let far = [(Operand::Register(u32::MAX), Operation::Mode(0))];
    assert!(Values::compile(&[&far]).is_none(), "no address reaches so far");
}
