//! Compiled programs, behind checks of what they are given.

use crate::assembler::Assembler;
use crate::compile;
use crate::extent::Extent;
use crate::memory::{Executable, widest};
use crate::program::{Operand, Operation, Rule};

/// Programs that compute registers, each from the registers, modes, held values and shared numbers that it finds.
#[derive(Debug)]
pub struct Values {
    code: Executable,
    entries: Vec<(usize, Extent)>,
}

impl Values {
    /// Compiles programs. `None` where this machine has no compiler of its own here, or a program is too large for it.
    ///
    /// An operation writes to the first of its pair: a register, or a number of the program's own that later operations
    /// read. (To write to a constant does nothing.) `None` too where one of its own numbers is read before it is written.
    #[must_use]
    pub fn compile(programs: &[&[(Operand, Operation)]]) -> Option<Values> {
        widest()?;
        let mut assembler = Assembler::default();
        let mut entries = Vec::with_capacity(programs.len());
        for program in programs {
            let extent = extent_of(program);
            if !compile::fits(&extent, 0) || written_first(program, extent.locals).is_none() {
                return None;
            }
            entries.push((assembler.position(), extent));
            compile::values(&mut assembler, &extent, program);
        }
        Some(Values { code: Executable::new(&assembler.finish())?, entries })
    }

    /// Runs program number `which`.
    ///
    /// # Panics
    /// Where there is no such program, or it reads or writes beyond the end of a slice.
    #[inline]
    pub fn run(&self, which: usize, registers: &mut [f64], modes: &[i8], held: &[f64], shared: &mut [f64]) {
        let (entry, extent) = &self.entries[which];
        assert!(
            registers.len() >= extent.registers
                && modes.len() >= extent.modes
                && held.len() >= extent.held
                && shared.len() >= extent.shared,
            "a program was given too few registers, modes, held values or shared numbers"
        );
        // SAFETY: `compile::values` wrote a program at `entry`, for a processor that has AVX. It addresses the registers,
        // modes, held values and shared numbers of its extent, which `assert` has found in the slices.
        #[allow(unsafe_code)]
        unsafe {
            self.code.run(*entry, registers, modes, held, shared);
        }
    }
}

/// A program that computes rows of tangents.
#[derive(Debug)]
pub struct Tangents {
    code: Executable,
    extent: Extent,
    lanes: usize,
}

impl Tangents {
    /// Compiles a program for so many lanes: what it computes `before`, numbers of its own that the rows need, then `rules`,
    /// each with the number of its row. `None` as for [`Values::compile`], and where `before` writes a register of the
    /// caller, or anything is shared.
    #[must_use]
    pub fn compile(before: &[(Operand, Operation)], rules: &[(u32, Rule)], lanes: usize) -> Option<Tangents> {
        let widest = widest()?;
        let mut extent = extent_of(before);
        rules.iter().for_each(|(out, rule)| extent.rule(*out, rule));
        let writes = before.iter().any(|(to, _)| matches!(to, Operand::Register(_))) || extent.shared > 0;
        let holds = before.iter().any(|(_, operation)| matches!(operation, Operation::HeldMode(_)));
        if writes || holds || lanes == 0 || !compile::fits(&extent, lanes) {
            return None;
        }
        let written = written_first(before, extent.locals)?;
        if !rules.iter().all(|(_, rule)| rule.locals().all(|l| written[l as usize])) {
            return None;
        }
        let mut assembler = Assembler::default();
        compile::rows(&mut assembler, &extent, before, rules, lanes, widest);
        Some(Tangents { code: Executable::new(&assembler.finish())?, extent, lanes })
    }

    /// Number of lanes.
    #[must_use]
    pub fn lanes(&self) -> usize {
        self.lanes
    }

    /// Computes the rows, each of [`lanes`](Self::lanes) numbers, one row after the other in `tangents`.
    ///
    /// # Panics
    /// Where the program reads or writes beyond the end of a slice.
    #[inline]
    pub fn run(&self, registers: &[f64], modes: &[i8], tangents: &mut [f64]) {
        let extent = &self.extent;
        assert!(
            registers.len() >= extent.registers
                && modes.len() >= extent.modes
                && tangents.len() >= extent.rows * self.lanes,
            "a program was given too few registers, modes or rows"
        );
        // SAFETY: `compile::rows` wrote a program at the start, of the instructions that this processor has. It addresses the
        // registers, modes and rows of its extent, which `assert` has found in the slices. It writes rows and numbers of its own,
        // and no register of the caller: `compile` refuses a program that would. It has no held values.
        #[allow(unsafe_code)]
        unsafe {
            self.code.run_reading(0, registers, modes, tangents);
        }
    }
}

fn extent_of(program: &[(Operand, Operation)]) -> Extent {
    let mut extent = Extent::default();
    for (to, operation) in program {
        extent.operand(*to);
        extent.operation(operation);
    }
    extent
}

/// Which of a program's own numbers it writes; `None` where it reads one before.
fn written_first(program: &[(Operand, Operation)], locals: usize) -> Option<Vec<bool>> {
    let mut written = vec![false; locals];
    for (to, operation) in program {
        if !operation.locals().all(|l| written[l as usize]) {
            return None;
        }
        if let Operand::Local(l) = *to {
            written[l as usize] = true;
        }
    }
    Some(written)
}
