//! A step as machine code: one program for each stage, and one for the step's end; for the state, and for its sensitivities.
//!
//! A program does what [`stage`](super::stage) and [`tangent`](super::tangent) do, to the last bit: the state at the stage, all registers,
//! the equations, solved for the highest derivatives. It finds the numbers that are no registers of the tape behind them, and what
//! the stages share behind the rates.

use std::sync::Arc;

use greybox_jit::{Operand, Operation, Operations, Row, Rule, Rules, Tangents as Program, Values};
use greybox_model::system::System;
use greybox_model::tape::{Reg, Tangents, Tape};

use super::Core;
use super::stage::Stage;
use super::tableau::Tableau;

/// How many equations a program solves for the highest derivatives.
const EQUATIONS: std::ops::RangeInclusive<usize> = 1..=4;

/// What stands behind the registers of the tape, their modes and their rows.
#[derive(Debug, Clone)]
pub(super) struct Tail {
    registers: usize,
    switches: usize,
    nx: usize,
    nz: usize,
    stages: usize,
    /// Rows of the mass matrix that may change places, in the order in which they do.
    changes: Vec<(usize, usize)>,
}

impl Tail {
    pub(super) fn of(system: &System, tableau: &Tableau) -> Tail {
        Tail {
            registers: system.rhs.registers(),
            switches: system.rhs.switches.len(),
            nx: system.nx,
            nz: system.nz,
            stages: tableau.b.len(),
            changes: changes(&system.rhs, system.nz),
        }
    }

    /// Registers of a stage: the factors of the mass matrix and the weights of the stages, times the step.
    pub(super) fn registers(&self) -> usize {
        self.weight(self.stages)
    }

    /// Modes: whether rows of the mass matrix change places.
    pub(super) fn modes(&self) -> usize {
        self.switches + self.changes.len()
    }

    /// Rows behind those of the rates: the right sides of the equations, as they are and in their changed places.
    pub(super) fn sides(&self) -> usize {
        self.nz + 2 * self.changes.len()
    }

    fn factor(&self, i: usize) -> usize {
        self.registers + i
    }

    fn weight(&self, j: usize) -> usize {
        self.registers + self.nz * self.nz + j
    }

    /// The row of an entry of the state.
    fn dx(&self, r: usize) -> Reg {
        (self.registers + r) as Reg
    }

    /// The row of the rate of an entry of the state at a stage.
    fn dk(&self, stage: usize, r: usize) -> Reg {
        (self.registers + (1 + stage) * self.nx + r) as Reg
    }

    /// The row of the right side of an equation M z = −h.
    fn equation(&self, i: usize) -> Reg {
        (self.registers + (1 + self.stages) * self.nx + i) as Reg
    }

    /// What the stages share: the rates of all of them and of the step's end, the state at both ends, the length of the step.
    pub(super) fn shared(&self) -> usize {
        self.length() + 1
    }

    /// Where the rate of an entry at a stage stands among what is shared.
    fn rate(&self, stage: usize, r: usize) -> usize {
        r * (self.stages + 1) + stage
    }

    pub(super) fn x(&self) -> usize {
        self.nx * (self.stages + 1)
    }

    pub(super) fn x1(&self) -> usize {
        self.x() + self.nx
    }

    fn length(&self) -> usize {
        self.x1() + self.nx
    }

    /// Whether programs can solve the equations.
    pub(super) fn solves(&self, system: &System) -> bool {
        system.mass_is_fixed && EQUATIONS.contains(&self.nz)
    }

    /// The factors of the mass matrix to where programs find them.
    pub(super) fn set_factors(&self, stage: &mut Stage, modes: &mut [i8]) {
        stage.regs[self.factor(0)..self.weight(0)].copy_from_slice(&stage.lu);
        for (mode, (k, p)) in modes[self.switches..].iter_mut().zip(&self.changes) {
            *mode = i8::from(stage.pivots[*k] == *p);
        }
    }

    /// The programs of a trial step: the stages behind the first, the state at the end, and the rates there and at the start. `None` where
    /// expressions are delayed, or nothing is compiled.
    pub(super) fn values(
        &self,
        system: &System,
        tableau: &Tableau,
        source: &[usize],
        solves: bool,
    ) -> Option<Arc<Values>> {
        if !system.rhs.delays.is_empty() {
            return None;
        }
        let end = self.stages;
        let rates = |program: &mut Operations, stage: usize| {
            if solves {
                self.highest(program, system);
                let to = |r: usize| Operand::Shared(self.rate(stage, r) as Reg);
                program.extend(source.iter().enumerate().map(|(r, &from)| (to(r), same(from))));
            }
        };
        let stage = |i: usize| {
            move |body: &Operations| {
                let mut program =
                    self.state(tableau.a[i], |r| Operand::Register((System::STATES + r) as Reg));
                program.extend(body);
                rates(&mut program, i);
                program
            }
        };
        let stages: Vec<_> = (1..self.stages).map(stage).collect();
        let state = |_: &Operations| self.state(tableau.b, |r| Operand::Shared((self.x1() + r) as Reg));
        let at = |stage: usize| {
            move |body: &Operations| {
                let mut program = body.clone();
                rates(&mut program, stage);
                program
            }
        };
        let (last, first) = (at(end), at(0));
        let mut frames: Vec<&dyn Fn(&Operations) -> Operations> = Vec::new();
        frames.extend(stages.iter().map(|stage| stage as &dyn Fn(&Operations) -> Operations));
        frames.push(&state);
        frames.push(&last);
        frames.push(&first);
        // (Methods differ by their number of stages.)
        system.rhs.compiled_values(2 * self.stages + usize::from(solves), &frames)
    }

    /// x + h Σ wⱼ fⱼ over the stages that have a weight, in their order.
    fn state(&self, weights: &[f64], to: impl Fn(usize) -> Operand) -> Operations {
        let (sum, term) = (Operand::Local(0), Operand::Local(1));
        let mut program = Vec::new();
        for r in 0..self.nx {
            let mut so_far = None;
            for (j, weight) in weights.iter().enumerate().filter(|w| *w.1 != 0.0) {
                let rate = Operand::Shared(self.rate(j, r) as Reg);
                let product = Operation::Product(Operand::Constant(*weight), rate);
                match so_far {
                    None => program.push((sum, product)),
                    Some(so_far) => {
                        program.push((term, product));
                        program.push((sum, Operation::Sum(so_far, term)));
                    }
                }
                so_far = Some(sum);
            }
            let length = Operand::Shared(self.length() as Reg);
            let so_far = so_far.unwrap_or(Operand::Constant(0.0));
            program.push((term, Operation::Product(length, so_far)));
            program.push((to(r), Operation::Sum(Operand::Shared((self.x() + r) as Reg), term)));
        }
        program
    }

    /// The highest derivatives: M z = −h, by the factors of M.
    fn highest(&self, program: &mut Operations, system: &System) {
        let nz = self.nz;
        let register = |r: usize| Operand::Register(r as Reg);
        let z = |i: usize| register(system.highest() + i);
        let factor = |i: usize, k: usize| register(self.factor(i * nz + k));
        let term = Operand::Local(0);
        let mut locals = 1..;
        let mut local = || Operand::Local(locals.next().unwrap_or(0));
        let mut sides: Vec<Operand> = (0..nz).map(|_| local()).collect();
        for (i, side) in sides.iter().enumerate() {
            let equation = register(system.rhs.outputs[nz * nz + i] as usize);
            program.push((*side, Operation::Negative(equation)));
        }
        for (change, (k, p)) in (self.switches as u32..).zip(&self.changes) {
            let (above, below) = (sides[*k], sides[*p]);
            (sides[*k], sides[*p]) = (local(), local());
            program.push((sides[*k], Operation::Select(change, [above, above, below])));
            program.push((sides[*p], Operation::Select(change, [below, below, above])));
        }
        let less = |program: &mut Operations, i: usize, k: usize, known: Operand| {
            program.push((term, Operation::Product(factor(i, k), known)));
            program.push((sides[i], Operation::Difference(sides[i], term)));
        };
        for k in 0..nz {
            (k + 1..nz).for_each(|i| less(program, i, k, sides[k]));
        }
        for k in (0..nz).rev() {
            program.push((z(k), Operation::Product(sides[k], factor(k, k))));
            (0..k).for_each(|i| less(program, i, k, z(k)));
        }
    }

    /// The programs for these leaves; `None` where something else is to be done too, or nothing is compiled.
    pub(super) fn step(
        &self,
        system: &System,
        (leaves, lanes): (&[bool], usize),
        tableau: &Tableau,
        tangents: &Tangents,
        source: &[usize],
    ) -> Option<Arc<Vec<Program>>> {
        if !system.rhs.delays.is_empty() || !EQUATIONS.contains(&self.nz) {
            return None;
        }
        let stage = |i: usize| {
            move |rules: &Rules| {
                let mut all = self.state_at(tableau.a[i], |r| (System::STATES + r) as Reg);
                all.extend(rules);
                all.extend(self.rates(i, system, tangents, source));
                all
            }
        };
        let stages: Vec<_> = (0..self.stages).map(stage).collect();
        let end = |_: &Rules| self.state_at(tableau.b, |r| self.dx(r));
        let mut frames: Vec<&dyn Fn(&Rules) -> Rules> = Vec::new();
        frames.extend(stages.iter().map(|stage| stage as &dyn Fn(&Rules) -> Rules));
        frames.push(&end);
        // (Methods differ by their number of stages.)
        system.rhs.compiled_programs((leaves, lanes, self.stages), &frames)
    }

    /// dx + Σ h wⱼ dkⱼ over the stages that have a weight.
    fn state_at(&self, weights: &[f64], to: impl Fn(usize) -> Reg) -> Rules {
        let mut rules = Vec::new();
        for r in 0..self.nx {
            let mut from = self.dx(r);
            for (j, _) in weights.iter().enumerate().filter(|w| *w.1 != 0.0) {
                let weight = Operand::Register(self.weight(j) as Reg);
                rules.push((to(r), Rule::Always(Row::PlusScaled(from, weight, self.dk(j, r)))));
                from = to(r);
            }
            if from == self.dx(r) && from != to(r) {
                rules.push((to(r), Rule::Always(Row::Copy(from))));
            }
        }
        rules
    }

    /// The derivative of the stage's ẋ: of the equations M z + h = 0, solved for that of z.
    fn rates(&self, stage: usize, system: &System, tangents: &Tangents, source: &[usize]) -> Rules {
        let nz = self.nz;
        let outputs = &system.rhs.outputs;
        let mut rules = Rules::new();
        let push = |rules: &mut Rules, to: Reg, row: Row| rules.push((to, Rule::Always(row)));
        for i in 0..nz {
            let row = self.equation(i);
            push(&mut rules, row, Row::Scale(Operand::Constant(-1.0), outputs[nz * nz + i]));
            for j in 0..nz {
                let mass = outputs[i * nz + j];
                if tangents.is_active(mass) {
                    let z = Operand::Register((system.highest() + j) as Reg);
                    push(&mut rules, row, Row::MinusScaled(row, z, mass));
                }
            }
        }
        let factor = |i: usize, k: usize| Operand::Register(self.factor(i * nz + k) as Reg);
        let mut sides: Vec<Reg> = (0..nz).map(|i| self.equation(i)).collect();
        let mut rows = (nz..).map(|i| self.equation(i));
        let mut next = || rows.next().unwrap_or(0);
        for (change, (k, p)) in (self.switches as u32..).zip(&self.changes) {
            let (above, below) = (Row::Copy(sides[*k]), Row::Copy(sides[*p]));
            (sides[*k], sides[*p]) = (next(), next());
            rules.push((sides[*k], Rule::Select(change, [above, above, below])));
            rules.push((sides[*p], Rule::Select(change, [below, below, above])));
        }
        for k in 0..nz {
            for i in k + 1..nz {
                push(&mut rules, sides[i], Row::MinusScaled(sides[i], factor(i, k), sides[k]));
            }
        }
        for k in (0..nz).rev() {
            // What is solved for highest derivative k is the rate of this entry.
            let entry = source.iter().position(|s| *s == system.highest() + k);
            let rate = entry.map_or(sides[k], |r| self.dk(stage, r));
            push(&mut rules, rate, Row::Scale(factor(k, k), sides[k]));
            for i in 0..k {
                push(&mut rules, sides[i], Row::MinusScaled(sides[i], factor(i, k), rate));
            }
        }
        for (r, &from) in source.iter().enumerate().filter(|s| *s.1 < system.highest()) {
            push(&mut rules, self.dk(stage, r), Row::Copy(from as Reg));
        }
        rules
    }
}

/// The rows that factors with partial pivoting may change, of a matrix whose entries are the first outputs: those that have something
/// other than a constant zero in the pivot's column.
fn changes(tape: &Tape, n: usize) -> Vec<(usize, usize)> {
    let is_zero = |r: &Reg| tape.constant_value(*r) == Some(0.0);
    let mut is_there: Vec<bool> = tape.outputs[..n * n].iter().map(|r| !is_zero(r)).collect();
    let mut changes = Vec::new();
    for k in 0..n {
        let below: Vec<usize> = (k + 1..n).filter(|p| is_there[p * n + k]).collect();
        changes.extend(below.iter().map(|p| (k, *p)));
        // Each of these rows may have become any other of them, and has then had the pivot's taken from it.
        for j in 0..n {
            let any = is_there[k * n + j] || below.iter().any(|p| is_there[p * n + j]);
            below.iter().chain([&k]).for_each(|p| is_there[p * n + j] = any);
        }
    }
    changes
}

/// A register, as it is.
fn same(register: usize) -> Operation {
    Operation::Product(Operand::Register(register as Reg), Operand::Constant(1.0))
}

impl Core<'_> {
    /// A trial step of length `h` by its programs.
    pub(super) fn compiled_trial(&mut self, values: &Values, h: f64, end: bool) {
        let (tableau, nx) = (self.tableau, self.system.nx);
        let (stages, x, x1, length) = (self.tail.stages, self.tail.x(), self.tail.x1(), self.tail.length());
        let mid = self.s + 0.5 * h;
        self.rates.f[x..x1].copy_from_slice(&self.x);
        self.rates.f[length] = h;
        for i in 1..stages {
            self.set_instant(i, self.s + tableau.c[i] * h, mid);
            self.compiled_stage(values, i - 1, i);
        }
        let last = stages;
        let st = &mut self.stages[last];
        values.run(last - 1, &mut st.regs, &self.modes, &st.lambda, &mut self.rates.f);
        self.x1.copy_from_slice(&self.rates.f[x1..][..nx]);
        if end || !self.live.is_empty() {
            st.regs[System::STATES..][..nx].copy_from_slice(&self.x1);
        }
        if end {
            self.set_instant(last, self.s + h, mid);
            self.compiled_stage(values, last, last);
        }
    }

    /// The rates at the start of a step, at the state that stands in its registers.
    #[inline]
    pub(super) fn compiled_start(&mut self, values: &Values) {
        self.compiled_stage(values, self.tail.stages + 1, 0);
    }

    /// Program `which` at stage `b`, and what sticks is held.
    #[inline(always)]
    fn compiled_stage(&mut self, values: &Values, which: usize, b: usize) {
        if self.sticking.is_empty() {
            self.compiled_free(values, which, b);
        } else {
            self.eval_sticking(b, Some((values, which)));
        }
    }

    /// Program `which` at stage `b`, and the equations solved, with the values of sticking signs as they stand.
    #[inline(always)]
    pub(super) fn compiled_free(&mut self, values: &Values, which: usize, b: usize) {
        let st = &mut self.stages[b];
        values.run(which, &mut st.regs, &self.modes, &st.lambda, &mut self.rates.f);
        if self.solves {
            self.result.evaluations += 1;
        } else {
            self.solve(b);
        }
    }

    /// The sensitivities' step that belongs to the trial step of length `h`, by its programs.
    pub(super) fn compiled_step(&mut self, step: &[Program], h: f64) {
        let tableau = self.tableau;
        for i in 0..self.tail.stages {
            let (tail, st) = (&self.tail, &mut self.stages[i]);
            if !self.system.mass_is_fixed {
                tail.set_factors(st, &mut self.modes);
            }
            for (to, weight) in st.regs[tail.weight(0)..].iter_mut().zip(tableau.a[i]) {
                *to = h * weight;
            }
            step[i].run(&st.regs, &self.modes, &mut self.d);
            if !self.sticking.is_empty() && self.stages[i].held.ok {
                self.tangent_sticking(i);
            }
        }
        let (tail, st) = (&self.tail, &mut self.stages[0]);
        for (to, weight) in st.regs[tail.weight(0)..].iter_mut().zip(tableau.b) {
            *to = h * weight;
        }
        step[tail.stages].run(&st.regs, &self.modes, &mut self.d);
    }
}

#[cfg(test)]
mod tests {
    use greybox_model::Model;

    use super::*;

    /// The rows that may change places where these are the inertias of three equations.
    fn changes_of(first: &str, second: &str, third: &str) -> Vec<(usize, usize)> {
        let text = format!(
            r#"
[parameters]
m = {{ value = 1.3, unit = "kg" }}
k = {{ value = 4.0, unit = "N/m" }}
[states]
x = {{ unit = "m" }}
y = {{ unit = "m" }}
z = {{ unit = "m" }}
[equations]
first = "{first} + k*x = 0"
second = "{second} + k*y = 0"
third = "{third} + k*z = 0"
"#
        );
        let system = System::compile(&Model::from_toml(&text, "m.toml").unwrap()).unwrap();
        changes(&system.rhs, 3)
    }

    #[test]
    fn rows_change_places_where_something_may_be_larger() {
        let full = "m*x'' + m*y'' + m*z''";
        assert_eq!(changes_of(full, full, full), [(0, 1), (0, 2), (1, 2)]);
        // What stands apart stays where it is.
        assert_eq!(changes_of("m*x'' + m*y''", "m*x'' + m*y''", "m*z''"), [(0, 1)]);
        assert_eq!(changes_of("m*x''", "m*y'' + m*z''", "m*y'' + m*z''"), [(1, 2)]);
        assert_eq!(changes_of("m*x''", "m*y''", "m*z''"), []);
        // Taking the first row from the third puts something below the second pivot.
        assert_eq!(changes_of("m*x'' + m*y''", "m*y'' + m*z''", "m*x'' + m*z''"), [(0, 2), (1, 2)]);
    }
}
