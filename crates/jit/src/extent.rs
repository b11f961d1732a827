//! What a program touches: which registers, modes, held values, shared numbers and rows, and which numbers of its own.

use crate::program::{Operand, Operation, Row, Rule};

fn local(operand: Operand) -> Option<u32> {
    match operand {
        Operand::Local(l) => Some(l),
        Operand::Register(_) | Operand::Shared(_) | Operand::Constant(_) => None,
    }
}

impl Operation {
    /// The numbers of the program's own that it reads.
    pub(crate) fn locals(&self) -> impl Iterator<Item = u32> {
        let none = Operand::Constant(0.0);
        let read = match *self {
            Operation::Negative(a)
            | Operation::Root(a)
            | Operation::Unary(_, a)
            | Operation::Power(_, a, _) => [a, none, none],
            Operation::Sum(a, b)
            | Operation::Difference(a, b)
            | Operation::Product(a, b)
            | Operation::Quotient(a, b)
            | Operation::Binary(_, a, b) => [a, b, none],
            Operation::Mode(_) | Operation::HeldMode(_) => [none; 3],
            Operation::Select(_, cases) => cases,
        };
        read.into_iter().filter_map(local)
    }
}

impl Rule {
    /// The numbers of the program's own that it reads.
    pub(crate) fn locals(&self) -> impl Iterator<Item = u32> {
        let of = |row: Row| match row {
            Row::Scale(k, _) | Row::PlusScaled(_, k, _) | Row::MinusScaled(_, k, _) => [Some(k), None],
            Row::Blend(k, _, l, _) => [Some(k), Some(l)],
            Row::Zero | Row::Copy(_) | Row::Sum(..) | Row::Difference(..) => [None, None],
        };
        let read = match *self {
            Rule::Always(row) => [of(row), [None; 2], [None; 2]],
            Rule::Select(_, cases) => cases.map(of),
        };
        read.into_iter().flatten().flatten().filter_map(local)
    }
}

/// How much a program reads and writes: one more than the highest number of each kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Extent {
    pub(crate) registers: usize,
    pub(crate) locals: usize,
    pub(crate) shared: usize,
    pub(crate) modes: usize,
    pub(crate) held: usize,
    pub(crate) rows: usize,
    pub(crate) calls: bool,
}

impl Extent {
    pub(crate) fn operand(&mut self, operand: Operand) {
        match operand {
            Operand::Register(r) => self.registers = self.registers.max(r as usize + 1),
            Operand::Shared(s) => self.shared = self.shared.max(s as usize + 1),
            Operand::Local(l) => self.locals = self.locals.max(l as usize + 1),
            Operand::Constant(_) => {}
        }
    }

    pub(crate) fn operation(&mut self, operation: &Operation) {
        match *operation {
            Operation::Negative(a) | Operation::Root(a) => self.operand(a),
            Operation::Sum(a, b)
            | Operation::Difference(a, b)
            | Operation::Product(a, b)
            | Operation::Quotient(a, b) => [a, b].into_iter().for_each(|o| self.operand(o)),
            Operation::Unary(_, a) | Operation::Power(_, a, _) => {
                self.operand(a);
                self.calls = true;
            }
            Operation::Binary(_, a, b) => {
                [a, b].into_iter().for_each(|o| self.operand(o));
                self.calls = true;
            }
            Operation::Mode(k) => self.mode(k),
            Operation::HeldMode(k) => {
                self.mode(k);
                self.held = self.held.max(k as usize + 1);
            }
            Operation::Select(k, cases) => {
                self.mode(k);
                cases.into_iter().for_each(|o| self.operand(o));
            }
        }
    }

    fn mode(&mut self, k: u32) {
        self.modes = self.modes.max(k as usize + 1);
    }

    fn row(&mut self, row: u32) {
        self.rows = self.rows.max(row as usize + 1);
    }

    pub(crate) fn rule(&mut self, out: u32, rule: &Rule) {
        self.row(out);
        match *rule {
            Rule::Always(row) => self.of_row(row),
            Rule::Select(k, cases) => {
                self.mode(k);
                cases.into_iter().for_each(|row| self.of_row(row));
            }
        }
    }

    fn of_row(&mut self, row: Row) {
        match row {
            Row::Zero => {}
            Row::Copy(a) => self.row(a),
            Row::Sum(a, b) | Row::Difference(a, b) => [a, b].into_iter().for_each(|r| self.row(r)),
            Row::Scale(k, a) => {
                self.operand(k);
                self.row(a);
            }
            Row::PlusScaled(a, k, b) | Row::MinusScaled(a, k, b) => {
                self.operand(k);
                [a, b].into_iter().for_each(|r| self.row(r));
            }
            Row::Blend(k, a, l, b) => {
                [k, l].into_iter().for_each(|o| self.operand(o));
                [a, b].into_iter().for_each(|r| self.row(r));
            }
        }
    }
}
