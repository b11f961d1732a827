//! From operations to instructions: every result is stored, and the last ones also stay in vector registers.

use crate::assembler::{
    Arithmetic, Assembler, Condition, General, Jump, R13, R14, RBP, RBX, RCX, RDI, RDX, RSI, RSP, Source,
    Vector, Width,
};
use crate::extent::Extent;
use crate::program::{Operand, Operation, Row, Rule};

/// Registers that hold results; the two above them serve single operations.
const SLOTS: u8 = 14;
const SPARE: Vector = 14;
const OTHER: Vector = 15;

/// Most bytes on the stack, and most entries of an array that an address can reach.
const MOST_ROOM: usize = 3584;
const MOST_ENTRIES: usize = 1 << 24;

/// Whether a program of this extent can be compiled for so many lanes.
pub(crate) fn fits(extent: &Extent, lanes: usize) -> bool {
    extent.locals * 8 <= MOST_ROOM
        && extent.registers <= MOST_ENTRIES
        && extent.shared <= MOST_ENTRIES
        && extent.modes <= MOST_ENTRIES
        && extent.held <= MOST_ENTRIES
        && extent.rows.checked_mul(lanes.max(1)).is_some_and(|n| n <= MOST_ENTRIES)
}

/// Where the arguments of a program stand while it runs.
#[derive(Clone, Copy)]
struct Bases {
    registers: General,
    modes: General,
    held: General,
    /// Rows of tangents, or the numbers that programs share.
    rows: General,
}

/// As they are handed over: the first four of the System V calling convention.
const HANDED_OVER: Bases = Bases { registers: RDI, modes: RSI, held: RDX, rows: RCX };
/// Where a call leaves them alone.
const KEPT: Bases = Bases { registers: RBX, modes: RBP, held: R13, rows: R14 };

/// What a vector register holds.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Held {
    Register(u32),
    Shared(u32),
    Local(u32),
    Row(u32),
}

struct Compiler<'a> {
    assembler: &'a mut Assembler,
    bases: Bases,
    room: i32,
    calls: bool,
    slots: [Option<Held>; SLOTS as usize],
    next: u8,
}

/// A program that computes registers.
pub(crate) fn values(assembler: &mut Assembler, extent: &Extent, operations: &[(Operand, Operation)]) {
    let mut compiler = Compiler::new(assembler, extent);
    operations.iter().for_each(|(to, operation)| compiler.operation(*to, operation));
    compiler.leave();
}

/// A program that computes rows of `lanes` tangents, after some numbers that they need.
pub(crate) fn rows(
    assembler: &mut Assembler,
    extent: &Extent,
    before: &[(Operand, Operation)],
    rules: &[(u32, Rule)],
    lanes: usize,
    widest: Width,
) {
    let mut compiler = Compiler::new(assembler, extent);
    before.iter().for_each(|(to, operation)| compiler.operation(*to, operation));
    // The whole program for as many lanes as a vector has, then for the next: results stay in registers.
    let mut lane = 0;
    while lane < lanes {
        let left = lanes - lane;
        let fitting = [Width::Eight, Width::Four, Width::Two, Width::One];
        let is_fitting = |w: &Width| w.lanes() <= left && w.lanes() <= widest.lanes();
        let width = fitting.into_iter().find(is_fitting).unwrap_or(Width::One);
        compiler.forget();
        for (out, rule) in rules {
            compiler.rule(*out, rule, (lanes, lane, width));
        }
        lane += width.lanes();
    }
    compiler.leave();
}

/// Lanes of a row, the first of those that are worked on, and how many they are.
type Lanes = (usize, usize, Width);

impl<'a> Compiler<'a> {
    fn new(assembler: &'a mut Assembler, extent: &Extent) -> Compiler<'a> {
        let calls = extent.calls;
        // Four registers are pushed beside the address of the caller; a call needs the stack at a multiple of 16.
        let room = (extent.locals * 8).next_multiple_of(16) + if calls { 8 } else { 0 };
        let bases = if calls { KEPT } else { HANDED_OVER };
        if calls {
            let pairs = [
                (KEPT.registers, HANDED_OVER.registers),
                (KEPT.modes, HANDED_OVER.modes),
                (KEPT.held, HANDED_OVER.held),
                (KEPT.rows, HANDED_OVER.rows),
            ];
            pairs.into_iter().for_each(|(kept, _)| assembler.push(kept));
            pairs.into_iter().for_each(|(kept, from)| assembler.copy(kept, from));
        }
        if room > 0 {
            assembler.make_room(room as i32);
        }
        Compiler { assembler, bases, room: room as i32, calls, slots: [None; SLOTS as usize], next: 0 }
    }

    fn leave(self) {
        if self.room > 0 {
            self.assembler.make_room(-self.room);
        }
        if self.calls {
            for register in [KEPT.rows, KEPT.held, KEPT.modes, KEPT.registers] {
                self.assembler.pop(register);
            }
        }
        self.assembler.end();
    }

    fn forget(&mut self) {
        self.slots = [None; SLOTS as usize];
    }

    fn slot(&self, what: Held) -> Option<Vector> {
        self.slots.iter().position(|s| *s == Some(what)).map(|i| i as Vector)
    }

    /// A register for a result, none of these.
    fn fresh(&mut self, but: &[Source]) -> Vector {
        loop {
            let at = self.next;
            self.next = (self.next + 1) % SLOTS;
            if !but.contains(&Source::Vector(at)) {
                self.slots[usize::from(at)] = None;
                return at;
            }
        }
    }

    /// The result in `at` is `what` from now on.
    fn keep(&mut self, at: Vector, what: Held) {
        self.slots.iter_mut().filter(|s| **s == Some(what)).for_each(|s| *s = None);
        self.slots[usize::from(at)] = Some(what);
    }

    fn memory(&mut self, operand: Operand) -> Source {
        match operand {
            Operand::Register(r) => Source::Memory(self.bases.registers, 8 * r as i32),
            Operand::Shared(s) => Source::Memory(self.bases.rows, 8 * s as i32),
            Operand::Local(l) => Source::Memory(RSP, 8 * l as i32),
            Operand::Constant(v) => Source::Constant(self.assembler.constant(v)),
        }
    }

    fn source(&mut self, operand: Operand) -> Source {
        let slot = match operand {
            Operand::Register(r) => self.slot(Held::Register(r)),
            Operand::Shared(s) => self.slot(Held::Shared(s)),
            Operand::Local(l) => self.slot(Held::Local(l)),
            Operand::Constant(_) => None,
        };
        slot.map_or_else(|| self.memory(operand), Source::Vector)
    }

    /// The number in a vector register: its own, or this one.
    fn at_hand(&mut self, operand: Operand, at: Vector) -> Vector {
        match self.source(operand) {
            Source::Vector(v) => v,
            memory => {
                self.assembler.load(Width::One, at, memory);
                at
            }
        }
    }

    fn operation(&mut self, to: Operand, operation: &Operation) {
        let out = match *operation {
            Operation::Negative(a) => {
                let first = self.at_hand(a, SPARE);
                let out = self.fresh(&[]);
                self.assembler.negative(out, first);
                out
            }
            Operation::Root(a) => {
                let source = self.source(a);
                let out = self.fresh(&[source]);
                self.assembler.zero(out);
                self.assembler.root(out, source);
                out
            }
            Operation::Sum(a, b) => self.arithmetic(Arithmetic::Add, a, b),
            Operation::Difference(a, b) => self.arithmetic(Arithmetic::Subtract, a, b),
            Operation::Product(a, b) => self.arithmetic(Arithmetic::Multiply, a, b),
            Operation::Quotient(a, b) => self.arithmetic(Arithmetic::Divide, a, b),
            Operation::Unary(f, a) => {
                self.argument(0, a);
                self.call(f as usize as u64)
            }
            Operation::Binary(f, a, b) => {
                // (Moved one after the other: the first may stand where the second goes.)
                let (first, second) = (self.at_hand(a, SPARE), self.at_hand(b, OTHER));
                self.assembler.load(Width::One, SPARE, Source::Vector(first));
                self.assembler.load(Width::One, 1, Source::Vector(second));
                self.assembler.load(Width::One, 0, Source::Vector(SPARE));
                self.call(f as usize as u64)
            }
            Operation::Power(f, a, n) => {
                self.argument(0, a);
                self.assembler.integer(n);
                self.call(f as usize as u64)
            }
            Operation::Mode(k) => {
                let out = self.fresh(&[]);
                self.assembler.test_byte(self.bases.modes, k as i32);
                self.assembler.convert_integer(out);
                out
            }
            Operation::HeldMode(k) => {
                let out = self.fresh(&[]);
                self.assembler.test_byte(self.bases.modes, k as i32);
                let is_zero = self.assembler.jump(Condition::Zero);
                self.assembler.convert_integer(out);
                let end = self.assembler.jump(Condition::Always);
                self.assembler.land(is_zero);
                self.assembler.load(Width::One, out, Source::Memory(self.bases.held, 8 * k as i32));
                self.assembler.land(end);
                out
            }
            Operation::Select(k, cases) => {
                let sources = cases.map(|case| self.source(case));
                let out = self.fresh(&sources);
                self.assembler.test_byte(self.bases.modes, k as i32);
                self.by_sign(|compiler, case| {
                    compiler.assembler.load(Width::One, out, sources[case]);
                });
                out
            }
        };
        match to {
            Operand::Register(r) => {
                self.assembler.store(Width::One, self.bases.registers, 8 * r as i32, out);
                self.keep(out, Held::Register(r));
            }
            Operand::Shared(s) => {
                self.assembler.store(Width::One, self.bases.rows, 8 * s as i32, out);
                self.keep(out, Held::Shared(s));
            }
            Operand::Local(l) => {
                self.assembler.store(Width::One, RSP, 8 * l as i32, out);
                self.keep(out, Held::Local(l));
            }
            // (Nothing is written to a constant.)
            Operand::Constant(_) => {}
        }
    }

    /// Three cases one after the other, of which the tested mode's sign takes one: negative, zero, positive.
    fn by_sign(&mut self, mut case: impl FnMut(&mut Self, usize)) {
        let is_negative = self.assembler.jump(Condition::Negative);
        let is_zero = self.assembler.jump(Condition::NotPositive);
        case(self, 2);
        let mut ends: Vec<Jump> = vec![self.assembler.jump(Condition::Always)];
        self.assembler.land(is_zero);
        case(self, 1);
        ends.push(self.assembler.jump(Condition::Always));
        self.assembler.land(is_negative);
        case(self, 0);
        ends.into_iter().for_each(|end| self.assembler.land(end));
    }

    fn argument(&mut self, at: Vector, operand: Operand) {
        let source = self.source(operand);
        if source != Source::Vector(at) {
            self.assembler.load(Width::One, at, source);
        }
    }

    /// Calls a function whose arguments stand where they belong. No vector register survives it.
    fn call(&mut self, address: u64) -> Vector {
        self.assembler.call(address);
        self.forget();
        self.next = 1;
        0
    }

    fn arithmetic(&mut self, op: Arithmetic, a: Operand, b: Operand) -> Vector {
        let (a, b) = (self.source(a), self.source(b));
        let out = self.fresh(&[a, b]);
        // (Sums and products are the same either way round.)
        let turns = matches!(op, Arithmetic::Add | Arithmetic::Multiply);
        match (a, b) {
            (Source::Vector(first), second) => {
                self.assembler.arithmetic(Width::One, op, out, first, second);
            }
            (second, Source::Vector(first)) if turns => {
                self.assembler.arithmetic(Width::One, op, out, first, second);
            }
            (first, second) => {
                self.assembler.load(Width::One, out, first);
                self.assembler.arithmetic(Width::One, op, out, out, second);
            }
        }
        out
    }

    fn row_memory(&self, row: u32, (lanes, lane, _): Lanes) -> Source {
        Source::Memory(self.bases.rows, 8 * (row as usize * lanes + lane) as i32)
    }

    fn row_source(&self, row: u32, lanes: Lanes) -> Source {
        self.slot(Held::Row(row)).map_or_else(|| self.row_memory(row, lanes), Source::Vector)
    }

    fn rule(&mut self, to: u32, rule: &Rule, lanes: Lanes) {
        let out = match *rule {
            Rule::Always(row) => {
                let out = self.fresh(&self.sources(&row, lanes));
                self.row(out, row, lanes);
                out
            }
            Rule::Select(k, cases) => {
                let but: Vec<Source> = cases.iter().flat_map(|row| self.sources(row, lanes)).collect();
                let out = self.fresh(&but);
                self.assembler.test_byte(self.bases.modes, k as i32);
                self.by_sign(|compiler, case| compiler.row(out, cases[case], lanes));
                out
            }
        };
        let Source::Memory(base, displacement) = self.row_memory(to, lanes) else { return };
        self.assembler.store(lanes.2, base, displacement, out);
        self.keep(out, Held::Row(to));
    }

    fn sources(&self, row: &Row, lanes: Lanes) -> Vec<Source> {
        match *row {
            Row::Zero => Vec::new(),
            Row::Copy(a) | Row::Scale(_, a) => vec![self.row_source(a, lanes)],
            Row::Sum(a, b)
            | Row::Difference(a, b)
            | Row::PlusScaled(a, _, b)
            | Row::MinusScaled(a, _, b)
            | Row::Blend(_, a, _, b) => {
                vec![self.row_source(a, lanes), self.row_source(b, lanes)]
            }
        }
    }

    /// Writes a row's lanes into `out`. Nothing else changes that later rows count on.
    fn row(&mut self, out: Vector, row: Row, lanes: Lanes) {
        let width = lanes.2;
        let of = |compiler: &Self, r: u32| compiler.row_source(r, lanes);
        match row {
            Row::Zero => self.assembler.zero(out),
            Row::Copy(a) => {
                let a = of(self, a);
                self.assembler.load(width, out, a);
            }
            Row::Sum(a, b) => {
                let (a, b) = (of(self, a), of(self, b));
                self.two(Arithmetic::Add, out, a, b, width);
            }
            Row::Difference(a, b) => {
                let (a, b) = (of(self, a), of(self, b));
                self.two(Arithmetic::Subtract, out, a, b, width);
            }
            Row::Scale(k, a) => {
                let a = of(self, a);
                self.scaled(out, k, a, width);
            }
            Row::PlusScaled(a, k, b) => {
                let (a, b) = (of(self, a), of(self, b));
                self.scaled(SPARE, k, b, width);
                self.assembler.arithmetic(width, Arithmetic::Add, out, SPARE, a);
            }
            Row::MinusScaled(a, k, b) => {
                let (a, b) = (of(self, a), of(self, b));
                self.scaled(SPARE, k, b, width);
                self.two(Arithmetic::Subtract, out, a, Source::Vector(SPARE), width);
            }
            Row::Blend(k, a, l, b) => {
                let (a, b) = (of(self, a), of(self, b));
                self.scaled(SPARE, l, b, width);
                self.scaled(out, k, a, width);
                self.assembler.arithmetic(width, Arithmetic::Add, out, out, Source::Vector(SPARE));
            }
        }
    }

    fn two(&mut self, op: Arithmetic, out: Vector, a: Source, b: Source, width: Width) {
        let first = match a {
            Source::Vector(first) => first,
            memory => {
                self.assembler.load(width, out, memory);
                out
            }
        };
        self.assembler.arithmetic(width, op, out, first, b);
    }

    /// to = k row.
    fn scaled(&mut self, to: Vector, k: Operand, row: Source, width: Width) {
        let factor = self.memory(k);
        match row {
            Source::Vector(first) if width == Width::Eight => self.assembler.multiply_by(to, first, factor),
            row => {
                self.assembler.broadcast(width, to, factor);
                self.assembler.arithmetic(width, Arithmetic::Multiply, to, to, row);
            }
        }
    }
}
