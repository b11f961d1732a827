//! Linear matrix equations by doubling (R. Smith, *Matrix equation XA + BX = C*, SIAM J. Appl. Math. 16, 1968).

use nalgebra::{DMatrix, LU};

use crate::check::{finite, square};
use crate::dense::{is_finite, symmetric_part};
use crate::error::RiccatiError;

/// Most doublings: Aᵏ with k = 2⁶⁰.
const DOUBLINGS: usize = 60;
/// A term so small that the next, its square, no longer shows.
const NEGLIGIBLE: f64 = 1e-17;

/// Solves Aᵀ X A − X + Q = 0, the cost Σ (Aᵏ)ᵀ Q Aᵏ of a stable discrete-time system, by
/// X ← X + Mᵀ X M, M ← M².
///
/// `a` is n × n with all eigenvalues inside the unit circle, `q` symmetric n × n.
///
/// # Errors
/// [`RiccatiError::Unstable`] when an eigenvalue is on or outside the unit circle; shapes and numbers that are not
/// finite.
pub fn stein(a: &DMatrix<f64>, q: &DMatrix<f64>) -> Result<DMatrix<f64>, RiccatiError> {
    pair(a, q)?;
    doubled(a.clone(), q.clone()).ok_or(RiccatiError::Unstable { equation: "Stein" })
}

/// Solves Aᵀ X + X A + Q = 0, the cost ∫ e^(Aᵀt) Q e^(At) dt of a stable system.
///
/// The Cayley transform M = (A + γI)(A − γI)⁻¹ makes it a Stein equation, with the same solution.
///
/// `a` is n × n with all eigenvalues in the open left half plane, `q` symmetric n × n.
///
/// ```
/// use greybox_hjb::lyapunov;
/// use nalgebra::dmatrix;
/// // ẋ = −2x from x = 1 costs ∫ x² dt = ¼.
/// let x = lyapunov(&dmatrix![-2.0], &dmatrix![1.0])?;
/// assert!((x[(0, 0)] - 0.25).abs() < 1e-15);
/// # Ok::<(), greybox_hjb::RiccatiError>(())
/// ```
///
/// # Errors
/// [`RiccatiError::Unstable`] when an eigenvalue is on the imaginary axis or right of it; shapes and numbers that
/// are not finite.
pub fn lyapunov(a: &DMatrix<f64>, q: &DMatrix<f64>) -> Result<DMatrix<f64>, RiccatiError> {
    pair(a, q)?;
    solve(a, q).ok_or(RiccatiError::Unstable { equation: "Lyapunov" })
}

fn pair(a: &DMatrix<f64>, q: &DMatrix<f64>) -> Result<(), RiccatiError> {
    let n = square("A", a)?;
    crate::check::shape("Q", q, n, n)?;
    finite("A", a)?;
    finite("Q", q)?;
    crate::check::symmetric("Q", q)
}

/// [`lyapunov`] without its checks.
pub(crate) fn solve(a: &DMatrix<f64>, q: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = a.nrows();
    let gamma = a.norm() / (n as f64).sqrt();
    if gamma == 0.0 {
        return None; // A = 0 is not stable
    }
    let mut shifted = a.clone();
    for i in 0..n {
        shifted[(i, i)] -= gamma;
    }
    // With S = (A − γI)⁻¹: M = I + 2γ S and the Stein equation's right-hand side 2γ Sᵀ Q S.
    let inverse = LU::new(shifted).try_inverse()?;
    let mut m = &inverse * (2.0 * gamma);
    for i in 0..n {
        m[(i, i)] += 1.0;
    }
    doubled(m, inverse.transpose() * q * &inverse * (2.0 * gamma))
}

/// [`stein`] without its checks; `None` unless the powers of `m` die out.
pub(crate) fn doubled(mut m: DMatrix<f64>, mut x: DMatrix<f64>) -> Option<DMatrix<f64>> {
    for _ in 0..DOUBLINGS {
        let more = m.transpose() * &x * &m;
        x += &more;
        if !is_finite(&x) {
            return None;
        }
        m = &m * &m;
        // The powers, too, must have died out: a mode that Q does not see may still grow.
        if more.norm() <= NEGLIGIBLE * x.norm() && m.norm() < 1e-3 {
            return Some(symmetric_part(&x));
        }
    }
    None
}
