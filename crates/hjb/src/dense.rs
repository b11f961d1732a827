//! What the Riccati solvers need of dense algebra.

use faer::MatRef;
use nalgebra::{Complex, DMatrix, LU};

use crate::compensated::{Twofold, column};

/// Rounds of refinement of a linear solve.
const REFINEMENTS: usize = 4;
/// Relative residual up to which a refined linear solve counts as solved.
const SOLVED: f64 = 1e-10;

/// (M + Mᵀ)/2.
pub(crate) fn symmetric_part(m: &DMatrix<f64>) -> DMatrix<f64> {
    (m + m.transpose()) * 0.5
}

/// ‖M − Mᵀ‖ ≤ 1e-8 ‖M‖: symmetric but for rounding.
pub(crate) fn is_symmetric(m: &DMatrix<f64>) -> bool {
    (m - m.transpose()).norm() <= 1e-8 * m.norm()
}

pub(crate) fn is_finite(m: &DMatrix<f64>) -> bool {
    m.iter().all(|v| v.is_finite())
}

/// M⁻¹ B, refined with residuals in twice the precision until it is right to the last digits. `None` when M is
/// singular to working precision, so that refinement does not help.
pub(crate) fn solve_refined(m: &DMatrix<f64>, b: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let lu = LU::new(m.clone());
    let rows = m.transpose();
    let mut x = lu.solve(b)?;
    for _ in 0..REFINEMENTS {
        let residual = DMatrix::from_fn(b.nrows(), b.ncols(), |i, j| {
            let mut sum = Twofold::new(b[(i, j)]);
            sum.sub_dot(column(&rows, i), column(&x, j));
            sum.value()
        });
        let correction = lu.solve(&residual)?;
        let done = correction.norm() <= 1e-17 * x.norm();
        x += correction;
        if done {
            break;
        }
    }
    let left = (m * &x - b).norm();
    (is_finite(&x) && left <= SOLVED * (b.norm() + m.norm() * x.norm())).then_some(x)
}

/// Eigenvalues of a square matrix, in the order of the real Schur form; `None` for one that is not square or not
/// finite, or when the iteration does not converge.
#[must_use]
pub fn eigenvalues(m: &DMatrix<f64>) -> Option<Vec<Complex<f64>>> {
    let n = m.nrows();
    if n != m.ncols() || !is_finite(m) {
        return None;
    }
    MatRef::from_column_major_slice(m.as_slice(), n, n).eigenvalues().ok()
}

/// A power of two near a positive number: multiplying by it rounds nothing.
pub(crate) fn power_of_two(x: f64) -> f64 {
    if x.is_finite() && x > 0.0 { x.log2().round().clamp(-1000.0, 1000.0).exp2() } else { 1.0 }
}
