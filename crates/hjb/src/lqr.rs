//! Linear-quadratic regulators.

use nalgebra::{DMatrix, SymmetricEigen};

use crate::error::RiccatiError;
use crate::riccati::{Riccati, care, dare};

/// The regulator u = −K x of ẋ = A x + B u that minimises ∫ (xᵀQx + uᵀRu) dt: thesis Eqs 4.21 and 4.27 for a linear
/// system.
///
/// `a` n × n, `b` n × m, `q` n × n positive semidefinite, `r` m × m positive definite. The gain is m × n.
///
/// ```
/// use greybox_hjb::lqr;
/// use nalgebra::{DMatrix, dmatrix};
/// // The F16 of thesis Eq 4.40 with unit weights, and the gains of Eq 4.44 (whose printed line is −u, not u).
/// let a = dmatrix![-1.01887, 0.90506, -0.00215; 0.82225, -1.07741, -0.17555; 0.0, 0.0, -1.0];
/// let f16 = lqr(&a, &dmatrix![0.0; 0.0; 1.0], &DMatrix::identity(3, 3), &dmatrix![1.0])?;
/// for (gain, printed) in f16.gain.iter().zip([-0.1352, -0.1501, 0.4329]) {
///     assert!((gain - printed).abs() < 1e-4);
/// }
/// # Ok::<(), greybox_hjb::RiccatiError>(())
/// ```
///
/// # Errors
/// [`RiccatiError::NotPositive`] for weights that are no cost; all of [`care`].
pub fn lqr(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
) -> Result<Riccati, RiccatiError> {
    cost(q, r)?;
    care(a, b, q, r, None)
}

/// The regulator u = −K x of x⁺ = A x + B u that minimises Σ (xᵀQx + uᵀRu).
///
/// `a` n × n, `b` n × m, `q` n × n positive semidefinite, `r` m × m positive definite. The gain is m × n.
///
/// # Errors
/// [`RiccatiError::NotPositive`] for weights that are no cost; all of [`dare`].
pub fn dlqr(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
) -> Result<Riccati, RiccatiError> {
    cost(q, r)?;
    dare(a, b, q, r, None)
}

fn cost(q: &DMatrix<f64>, r: &DMatrix<f64>) -> Result<(), RiccatiError> {
    for (matrix, m, definite) in [("Q", q, false), ("R", r, true)] {
        crate::check::square(matrix, m)?;
        crate::check::finite(matrix, m)?;
        crate::check::symmetric(matrix, m)?;
        if m.nrows() == 0 {
            continue;
        }
        let eigenvalues = SymmetricEigen::new(m.clone()).eigenvalues;
        let (smallest, largest) = (eigenvalues.min(), eigenvalues.amax());
        let least = if definite { 0.0 } else { -1e-12 * largest };
        if smallest < least || (definite && smallest <= 0.0) {
            return Err(RiccatiError::NotPositive { matrix, definite, smallest });
        }
    }
    Ok(())
}
