//! The tangent linearisation of a plant.

use crate::SmcError;
use crate::matrix::is_finite;

/// The tangent ẋ_δ = A x_δ + b u_δ of a plant ẋ = f(x) + g(x) u at an equilibrium (x_e, u_e), thesis Eq 4.4:
///
/// ```text
/// A = ∂f/∂x + ∂g/∂x u_e        b = g(x_e)
/// ```
///
/// States and input may have any units; time is in s. [`EquilibriumSolver::tangent`] takes one from a model by
/// differences.
///
/// [`EquilibriumSolver::tangent`]: crate::EquilibriumSolver::tangent
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tangent<const N: usize> {
    /// A, row by row: `a[i][j]` is ∂ẋᵢ/∂xⱼ.
    pub a: [[f64; N]; N],
    /// b: `b[i]` is ∂ẋᵢ/∂u.
    pub b: [f64; N],
}

impl<const N: usize> Tangent<N> {
    /// From A (by rows) and b.
    #[must_use]
    pub const fn new(a: [[f64; N]; N], b: [f64; N]) -> Self {
        Self { a, b }
    }

    pub(crate) fn check_finite(&self, what: &'static str) -> Result<(), SmcError> {
        if is_finite(&self.a) && self.b.iter().all(|b| b.is_finite()) {
            Ok(())
        } else {
            Err(SmcError::NotFinite { what })
        }
    }
}
