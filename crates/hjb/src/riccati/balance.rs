use nalgebra::DMatrix;

use crate::dense::power_of_two;

/// Most sweeps.
const SWEEPS: usize = 20;

/// A diagonal change of states x = D x̂ and of the unit of cost, by powers of two: X = ρ D⁻¹ X̂ D⁻¹.
pub(super) struct Balance {
    d: Vec<f64>,
    pub(super) rho: f64,
}

impl Balance {
    /// Rows and columns of the Hamiltonian [[A, −G], [−Q, −Aᵀ]] to equal size (P. Benner, *Symplectic balancing of
    /// Hamiltonian matrices*, SIAM J. Sci. Comput. 22, 2001).
    pub(super) fn of(a: &DMatrix<f64>, g: &DMatrix<f64>, q: &DMatrix<f64>) -> Balance {
        let n = a.nrows();
        let mut d = vec![1.0f64; n];
        for _ in 0..SWEEPS {
            let mut changed = false;
            for i in 0..n {
                // Column i of the scaled [A; −Q] is proportional to dᵢ, row i of [A, −G] to 1/dᵢ.
                let (mut column, mut row) = (0.0, 0.0);
                for k in 0..n {
                    if k != i {
                        column += (a[(k, i)] / d[k]).abs();
                        row += (a[(i, k)] * d[k]).abs();
                    }
                    column += (q[(k, i)] * d[k]).abs();
                    row += (g[(i, k)] / d[k]).abs();
                }
                let (column, row) = (column * d[i], row / d[i]);
                if column > 0.0 && row > 0.0 {
                    let f = power_of_two((row / column).sqrt());
                    if column * f + row / f < 0.9 * (column + row) {
                        d[i] *= f;
                        changed = true;
                    }
                }
            }
            if !changed {
                break;
            }
        }
        Balance { d, rho: 1.0 }
    }

    /// D⁻¹ M D.
    pub(super) fn similar(&self, m: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| m[(i, j)] / self.d[i] * self.d[j])
    }

    /// D⁻¹ M.
    pub(super) fn rows(&self, m: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| m[(i, j)] / self.d[i])
    }

    /// D M.
    pub(super) fn rows_back(&self, m: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| m[(i, j)] * self.d[i])
    }

    /// D M D.
    pub(super) fn congruent(&self, m: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| m[(i, j)] * self.d[i] * self.d[j])
    }

    /// The solution in the states as given: ρ D⁻¹ X̂ D⁻¹.
    pub(super) fn undo(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(x.nrows(), x.ncols(), |i, j| x[(i, j)] * self.rho / self.d[i] / self.d[j])
    }

    /// A gain in the states as given: K̂ D⁻¹.
    pub(super) fn undo_gain(&self, k: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(k.nrows(), k.ncols(), |i, j| k[(i, j)] / self.d[j])
    }
}
