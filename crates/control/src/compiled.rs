//! Expressions of states compiled for fast evaluation, with exact derivatives.

use std::sync::Arc;

use greybox_model::Expr;
use greybox_model::tape::{LeafKind, Tangents, Tape, UnknownName};
use nalgebra::DMatrix;

/// Functions of n variables.
#[derive(Debug, Clone)]
pub(crate) struct Compiled {
    tape: Tape,
    /// Registers with the parameters and what follows from them alone.
    registers: Vec<f64>,
    modes: Vec<i8>,
    variables: usize,
    tangents: Arc<Tangents>,
}

impl Compiled {
    pub(crate) fn new(
        functions: &[Expr],
        variables: &[(String, u8)],
        parameters: &[(String, f64)],
    ) -> Result<Compiled, UnknownName> {
        let n = variables.len();
        let mut kinds = vec![LeafKind::Varying; n];
        kinds.resize(n + parameters.len(), LeafKind::Parameter);
        let resolve = |name: &str, primes: u8| {
            let variable = variables.iter().position(|(v, p)| v == name && *p == primes);
            variable.or_else(|| {
                let parameter = parameters.iter().position(|(p, _)| p == name && primes == 0);
                parameter.map(|i| n + i)
            })
        };
        let tape = Tape::compile(functions, kinds, &resolve)?;
        let mut registers = vec![0.0; tape.registers()];
        let mut modes = vec![1; tape.switches.len()];
        for (register, (_, value)) in registers[n..].iter_mut().zip(parameters) {
            *register = *value;
        }
        tape.prepare(&mut registers, &mut modes);
        let leaves: Vec<bool> = (0..tape.leaves()).map(|i| i < n).collect();
        let tangents = tape.compiled_tangents(&leaves, n);
        Ok(Compiled { tape, registers, modes, variables: n, tangents })
    }

    /// The same functions with other values of the parameters, in the order that they were given in.
    pub(crate) fn with_parameters(&self, values: &[f64]) -> Compiled {
        let mut changed = self.clone();
        for (register, value) in changed.registers[self.variables..].iter_mut().zip(values) {
            *register = *value;
        }
        changed.modes.fill(1);
        changed.tape.prepare(&mut changed.registers, &mut changed.modes);
        changed
    }

    fn run(&self, x: &[f64]) -> (Vec<f64>, Vec<i8>) {
        let (mut registers, mut modes) = (self.registers.clone(), self.modes.clone());
        for (register, x) in registers[..self.variables].iter_mut().zip(x) {
            *register = *x;
        }
        self.tape.eval_natural(&mut registers, &mut modes);
        (registers, modes)
    }

    /// The values from output `first` on, as many as `out` takes.
    pub(crate) fn eval(&self, x: &[f64], first: usize, out: &mut [f64]) {
        let (registers, _) = self.run(x);
        for (out, register) in out.iter_mut().zip(self.tape.outputs.iter().skip(first)) {
            *out = registers[*register as usize];
        }
    }

    /// ∂(functions)/∂(variables), exact where the functions are smooth; at a kink that of one side.
    pub(crate) fn jacobian(&self, x: &[f64]) -> DMatrix<f64> {
        let n = self.variables;
        let (registers, modes) = self.run(x);
        let mut d = vec![0.0; registers.len() * n];
        for i in 0..n {
            d[i * n + i] = 1.0;
        }
        self.tape.tangent(&self.tangents, &registers, &modes, n, &mut d);
        DMatrix::from_fn(self.tape.outputs.len(), n, |i, j| d[self.tape.outputs[i] as usize * n + j])
    }
}
