//! A model compiled to a first-order system ẋ = f(t, x, u, p), y = g(t, x, z, u, p).
//!
//! The equations are affine in the highest derivatives z (one per state):
//!
//! ```text
//! M(t, x, u, p) z + h(t, x, u, p) = 0,      e.g.  J θ'' + B θ' − k v = 0:  M = J, h = B θ' − k v
//! ```
//!
//! The state vector chains each coordinate with its lower derivatives: (q₁, q₁', q₂, q₂', …), and ẋ
//! is the chain's successor or z.

use crate::expr::Expr;
use crate::model::Model;
use crate::tape::{LeafKind, Tape, UnknownName};

/// A compiled model. Immutable; simulations share it between threads.
#[derive(Debug, Clone)]
pub struct System {
    /// Length of the state vector.
    pub nx: usize,
    /// Number of equations, and of highest derivatives.
    pub nz: usize,
    /// Number of inputs.
    pub nu: usize,
    /// Number of parameters.
    pub np: usize,
    /// Number of measured channels.
    pub ny: usize,
    /// Where each state's chain begins in the state vector.
    pub offsets: Vec<usize>,
    /// Order of each state (length of its chain).
    pub orders: Vec<usize>,
    /// Outputs: M row by row (`nz × nz`), then h (`nz`).
    pub rhs: Tape,
    /// Outputs: the measurements (`ny`); its z leaves hold the highest derivatives.
    pub output: Tape,
    /// Whether M depends on parameters alone.
    pub mass_is_fixed: bool,
    /// Whether a measurement needs the highest derivatives (an accelerometer).
    pub output_needs_z: bool,
    /// Whether a measurement needs an input.
    pub output_needs_inputs: bool,
}

/// Why a model could not be compiled. A [`Model`] made by `Model::from_toml` always compiles; one
/// edited by hand may not.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CompileError {
    /// A name that is neither input, state, parameter, `t` nor `pi`.
    #[error("{place}: {name}")]
    UnknownName {
        /// Equation or measurement.
        place: String,
        /// What was not found.
        name: UnknownName,
    },
    /// An equation is not affine in the highest derivatives.
    #[error("equation \"{equation}\" is not affine in the highest derivatives")]
    NotAffine {
        /// Name of the equation.
        equation: String,
    },
    /// There are not as many equations as states.
    #[error("{equations} equations for {states} states")]
    Count {
        /// Number of equations.
        equations: usize,
        /// Number of states.
        states: usize,
    },
}

impl System {
    /// The same system, whose equations are interpreted and never compiled to machine code: the oracle of what is.
    #[must_use]
    pub fn interpreted(&self) -> System {
        System { rhs: self.rhs.interpreted(), output: self.output.interpreted(), ..self.clone() }
    }

    /// Compiles a model.
    ///
    /// # Errors
    /// [`CompileError`] when a name is unknown, an equation is not affine in the highest
    /// derivatives, or the number of equations is not that of the states.
    pub fn compile(model: &Model) -> Result<System, CompileError> {
        let nz = model.states.len();
        if model.equations.len() != nz {
            return Err(CompileError::Count { equations: model.equations.len(), states: nz });
        }
        let orders: Vec<usize> = model.states.iter().map(|s| s.order).collect();
        let mut offsets = Vec::with_capacity(nz);
        let mut nx = 0;
        for order in &orders {
            offsets.push(nx);
            nx += order;
        }
        let (nu, np) = (model.inputs.len(), model.parameters.len());
        let resolve = |name: &str, primes: u8| -> Option<usize> {
            let primes = primes as usize;
            if let Some(j) = model.state(name) {
                return match primes.cmp(&orders[j]) {
                    std::cmp::Ordering::Less => Some(1 + offsets[j] + primes),
                    std::cmp::Ordering::Equal => Some(1 + nx + j),
                    std::cmp::Ordering::Greater => None,
                };
            }
            if primes > 0 {
                return None;
            }
            if let Some(i) = model.input(name) {
                return Some(1 + nx + nz + i);
            }
            if let Some(i) = model.parameter(name) {
                return Some(1 + nx + nz + nu + i);
            }
            (name == "t").then_some(0)
        };
        let mut kinds = vec![LeafKind::Varying; 1 + nx + nz];
        kinds.extend(std::iter::repeat_n(LeafKind::Input, nu));
        kinds.extend(std::iter::repeat_n(LeafKind::Parameter, np));

        let highest: Vec<(&str, u8)> =
            model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let mut mass = Vec::with_capacity(nz * nz);
        let mut force = Vec::with_capacity(nz);
        for equation in &model.equations {
            let (coefficients, rest) = equation
                .residual()
                .affine_in(&highest)
                .ok_or_else(|| CompileError::NotAffine { equation: equation.name.clone() })?;
            mass.extend(coefficients.iter().map(Expr::simplify));
            force.push(rest.simplify());
        }
        let unknown = |place: String| move |name| CompileError::UnknownName { place, name };
        for (i, equation) in model.equations.iter().enumerate() {
            let row: Vec<Expr> =
                mass[i * nz..(i + 1) * nz].iter().chain(std::iter::once(&force[i])).cloned().collect();
            Tape::compile(&row, kinds.clone(), &resolve)
                .map_err(unknown(format!("equation \"{}\"", equation.name)))?;
        }
        let exprs: Vec<Expr> = mass.into_iter().chain(force).collect();
        let rhs = Tape::compile(&exprs, kinds.clone(), &resolve).map_err(unknown("equations".to_string()))?;
        let measured: Vec<Expr> = model.measurements.iter().map(|m| m.expr.clone()).collect();
        let output =
            Tape::compile(&measured, kinds, &resolve).map_err(unknown("measurements".to_string()))?;
        let output_needs_z = model.measurements.iter().any(|m| {
            let mut found = false;
            m.expr.walk(&mut |e| {
                if let Expr::Var { name, primes } = e {
                    found |= highest.iter().any(|&(n, p)| n == &**name && p == *primes);
                }
            });
            found
        });
        let needs_input = |e: &Expr| model.inputs.iter().any(|i| e.mentions(&i.name));
        let output_needs_inputs = model.measurements.iter().any(|m| needs_input(&m.expr));
        let mass_is_fixed = rhs.outputs[..nz * nz].iter().all(|&r| rhs.is_fixed(r));
        Ok(System {
            nx,
            nz,
            nu,
            np,
            ny: measured.len(),
            offsets,
            orders,
            rhs,
            output,
            mass_is_fixed,
            output_needs_z,
            output_needs_inputs,
        })
    }

    /// Leaf of the time.
    pub const TIME: usize = 0;

    /// First leaf of the state vector.
    pub const STATES: usize = 1;

    /// First leaf of the highest derivatives.
    pub fn highest(&self) -> usize {
        1 + self.nx
    }

    /// First leaf of the inputs.
    pub fn inputs(&self) -> usize {
        1 + self.nx + self.nz
    }

    /// First leaf of the parameters.
    pub fn parameters(&self) -> usize {
        1 + self.nx + self.nz + self.nu
    }

    /// First leaf of the delayed values.
    pub fn delayed(&self) -> usize {
        1 + self.nx + self.nz + self.nu + self.np
    }
}
