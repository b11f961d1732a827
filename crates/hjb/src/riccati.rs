//! Algebraic Riccati equations, continuous and discrete.
//!
//! The stabilising solution by the structure-preserving doubling algorithm (E. Chu, H. Fan, W. Lin, *A
//! structure-preserving doubling algorithm for continuous-time algebraic Riccati equations*, Linear Algebra Appl.
//! 396, 2005; for discrete time B. Anderson, *Second-order convergent algorithms for the steady-state Riccati
//! equation*, Int. J. Control 28, 1978), on symplectically balanced matrices; then Newton's method (D. Kleinman
//! 1968, G. Hewer 1971) on residuals computed in twice the precision. Every step keeps the symmetry of X, and
//! nothing is returned whose closed loop is not stable.
//!
//! Rounds of doubling square the distance to the solution, so that a dozen does for a well-damped closed loop and
//! fifty for one within 1e-13 of the stability boundary.

mod balance;
mod continuous;
mod discrete;

use nalgebra::{Complex, DMatrix, LU};

pub use continuous::care;
pub use discrete::dare;

use crate::check::{finite, shape, square, symmetric};
use crate::dense::{is_finite, symmetric_part};
use crate::error::RiccatiError;

/// Most rounds of doubling: what lies nearer to the stability boundary than 2⁻⁸⁰ is not told from it.
const DOUBLINGS: usize = 80;
/// Most Newton steps after the doubling.
const NEWTON_STEPS: usize = 40;
/// A step relative to the solution that rounding it swallows.
const UNIT_ROUNDOFF: f64 = 1e-17;
/// Residual, relative to the sum of its terms, that ends the search for a better starting point.
const GOOD: f64 = 1e-13;
/// A residual relative to the sum of its terms above which a solution is no solution.
const BAD: f64 = 1e-4;

/// The stabilising solution of a Riccati equation.
#[derive(Debug, Clone, PartialEq)]
pub struct Riccati {
    /// X, n × n, symmetric: the optimal cost from x is xᵀ X x.
    pub solution: DMatrix<f64>,
    /// K, m × n: the optimal feedback is u = −K x.
    pub gain: DMatrix<f64>,
    /// Eigenvalues of A − B K: in the open left half plane (continuous) or inside the unit circle (discrete).
    pub closed_loop: Vec<Complex<f64>>,
    /// Frobenius norm of the residual over the sum of the norms of its terms, computed in twice the precision.
    pub residual: f64,
}

/// Shapes and numbers of a problem; the cross weight with zeros where none is given.
fn checked(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
    s: Option<&DMatrix<f64>>,
) -> Result<DMatrix<f64>, RiccatiError> {
    let n = square("A", a)?;
    let m = b.ncols();
    if n == 0 || m == 0 {
        return Err(RiccatiError::Empty { states: n, inputs: m });
    }
    shape("B", b, n, m)?;
    shape("Q", q, n, n)?;
    shape("R", r, m, m)?;
    for (name, matrix) in [("A", a), ("B", b), ("Q", q), ("R", r)] {
        finite(name, matrix)?;
    }
    symmetric("Q", q)?;
    symmetric("R", r)?;
    match s {
        None => Ok(DMatrix::zeros(n, m)),
        Some(s) => {
            shape("S", s, n, m)?;
            finite("S", s)?;
            Ok(s.clone())
        }
    }
}

/// Doubles A ← A(I+GH)⁻¹A, G ← G + A(I+GH)⁻¹GAᵀ, H ← H + AᵀH(I+GH)⁻¹A until H, which tends to the solution of
/// Aᵀ H (I+GH)⁻¹ A − H + H₀ = 0, stands still. `None` when it does not.
fn doubling(mut a: DMatrix<f64>, mut g: DMatrix<f64>, mut h: DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = a.nrows();
    for _ in 0..DOUBLINGS {
        let mut m = &g * &h;
        for i in 0..n {
            m[(i, i)] += 1.0;
        }
        let lu = LU::new(m);
        let a_reduced = lu.solve(&a)?;
        let g_reduced = lu.solve(&g)?;
        let transposed = a.transpose();
        let more = symmetric_part(&(&transposed * (&h * &a_reduced)));
        g += symmetric_part(&(&a * g_reduced * transposed));
        a = &a * a_reduced;
        h += &more;
        if !is_finite(&h) || !is_finite(&g) {
            return None;
        }
        if more.norm() <= 1e-16 * h.norm() {
            return Some(h);
        }
    }
    None
}

/// PBH test: a mode that is not stable and that no input reaches.
fn unreachable(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    unstable: impl Fn(Complex<f64>) -> bool,
) -> Option<Complex<f64>> {
    let n = a.nrows();
    let scale = a.norm().max(f64::MIN_POSITIVE);
    crate::dense::eigenvalues(a)?.into_iter().filter(|l| unstable(*l)).find(|l| {
        // Rank of [A − λI, B] by its smallest singular value, B at the size of A.
        let wide = DMatrix::from_fn(n, n + b.ncols(), |i, j| {
            if j < n {
                Complex::new(a[(i, j)], 0.0) - if i == j { *l } else { Complex::new(0.0, 0.0) }
            } else {
                Complex::new(b[(i, j - n)] * scale / b.norm().max(f64::MIN_POSITIVE), 0.0)
            }
        });
        let rows = &wide * wide.adjoint();
        // λ itself is known to ε^(1/k) for a chain of k, and the product squares the singular values.
        rows.symmetric_eigenvalues().min() < 1e-18 * scale * scale
    })
}
