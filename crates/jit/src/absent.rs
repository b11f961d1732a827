//! Where there is no compiler: nothing is ever compiled, and so never run.

use crate::program::{Operand, Operation, Rule};

/// Programs that compute registers, each from the registers, modes, held values and shared numbers that it finds.
#[derive(Debug)]
pub enum Values {}

impl Values {
    /// `None`: there is no compiler for this machine.
    #[must_use]
    pub fn compile(_programs: &[&[(Operand, Operation)]]) -> Option<Values> {
        None
    }

    /// Runs program number `which`.
    pub fn run(
        &self,
        _which: usize,
        _registers: &mut [f64],
        _modes: &[i8],
        _held: &[f64],
        _shared: &mut [f64],
    ) {
        match *self {}
    }
}

/// A program that computes rows of tangents.
#[derive(Debug)]
pub enum Tangents {}

impl Tangents {
    /// `None`: there is no compiler for this machine.
    #[must_use]
    pub fn compile(
        _before: &[(Operand, Operation)],
        _rules: &[(u32, Rule)],
        _lanes: usize,
    ) -> Option<Tangents> {
        None
    }

    /// Number of lanes.
    #[must_use]
    pub fn lanes(&self) -> usize {
        match *self {}
    }

    /// Computes the rows.
    pub fn run(&self, _registers: &[f64], _modes: &[i8], _tangents: &mut [f64]) {
        match *self {}
    }
}
