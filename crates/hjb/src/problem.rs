//! The Hamilton–Jacobi–Bellman equation at collocation points, as equations for the weights.

use nalgebra::{Cholesky, DMatrix};

use crate::basis::Monomials;
use crate::error::{HjbError, RiccatiError};
use crate::plant::Plant;

/// Residuals of thesis Eq 4.37 at P points, for N weights:
///
/// e(x) = Wᵀ∇φ f − ¼ Wᵀ∇φ g R⁻¹ gᵀ∇φᵀ W + xᵀQx = aᵀW − ¼‖BᵀW‖² + q, with a = ∇φ f, B = ∇φ g R^(−1/2).
#[derive(Debug, Clone)]
pub struct Problem {
    basis: Monomials,
    inputs: usize,
    /// P × N.
    a: DMatrix<f64>,
    /// P × N for each input.
    b: Vec<DMatrix<f64>>,
    /// P.
    q: Vec<f64>,
}

impl Problem {
    /// The equations of a plant with running cost xᵀQx + uᵀRu.
    ///
    /// `q` is n × n, `r` m × m positive definite; every point has n values.
    ///
    /// # Errors
    /// [`HjbError`]: sizes that do not fit, weights that are no cost, a plant that is not finite at a point.
    pub fn new(
        plant: &impl Plant,
        q: &DMatrix<f64>,
        r: &DMatrix<f64>,
        basis: Monomials,
        points: &[Vec<f64>],
    ) -> Result<Problem, HjbError> {
        let (n, m, count) = (plant.states(), plant.inputs(), basis.len());
        let size = |what, found, wanted| {
            if found == wanted { Ok(()) } else { Err(HjbError::Size { what, found, wanted }) }
        };
        size("the basis' state", basis.states(), n)?;
        crate::check::shape("Q", q, n, n)?;
        crate::check::shape("R", r, m, m)?;
        crate::check::finite("Q", q)?;
        crate::check::finite("R", r)?;
        crate::check::symmetric("R", r)?;
        if points.is_empty() {
            return Err(HjbError::Points { wanted: 0.0, most: crate::points::MOST_POINTS });
        }
        // R = L Lᵀ: ‖L⁻¹ gᵀ∇φᵀW‖² is the quadratic term.
        let cholesky = Cholesky::new(r.clone()).ok_or_else(|| {
            let smallest = r.clone().symmetric_eigenvalues().min();
            RiccatiError::NotPositive { matrix: "R", definite: true, smallest }
        })?;
        let mut problem = Problem {
            basis,
            inputs: m,
            a: DMatrix::zeros(points.len(), count),
            b: vec![DMatrix::zeros(points.len(), count); m],
            q: Vec::with_capacity(points.len()),
        };
        let (mut f, mut g) = (vec![0.0; n], DMatrix::zeros(n, m));
        for (p, x) in points.iter().enumerate() {
            size("a point", x.len(), n)?;
            plant.drift(x, &mut f);
            plant.input(x, g.as_mut_slice());
            if !f.iter().chain(g.iter()).all(|v| v.is_finite()) {
                return Err(HjbError::NotFinite { point: x.clone() });
            }
            // g L⁻ᵀ, n × m.
            let scaled = cholesky.l().solve_lower_triangular(&g.transpose()).map(|s| s.transpose());
            let scaled = scaled.unwrap_or_else(|| g.clone());
            let jacobian = problem.basis.jacobian(x);
            for (j, row) in jacobian.chunks(n).enumerate() {
                problem.a[(p, j)] = row.iter().zip(&f).map(|(d, f)| d * f).sum();
                for k in 0..m {
                    problem.b[k][(p, j)] = row.iter().zip(scaled.column(k).iter()).map(|(d, g)| d * g).sum();
                }
            }
            problem.q.push((0..n * n).map(|k| x[k / n] * q[(k / n, k % n)] * x[k % n]).sum());
        }
        Ok(problem)
    }

    /// The basis.
    #[must_use]
    pub fn basis(&self) -> &Monomials {
        &self.basis
    }

    /// Number of points.
    #[must_use]
    pub fn points(&self) -> usize {
        self.q.len()
    }

    /// Number of inputs.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// e at every point for N weights.
    ///
    /// # Errors
    /// [`HjbError::Size`] for another number of weights.
    pub fn residuals(&self, weights: &[f64]) -> Result<Vec<f64>, HjbError> {
        self.check(weights)?;
        Ok(self.evaluate(weights).0)
    }

    pub(crate) fn check(&self, weights: &[f64]) -> Result<(), HjbError> {
        let wanted = self.basis.len();
        if weights.len() == wanted {
            Ok(())
        } else {
            Err(HjbError::Size { what: "the start", found: weights.len(), wanted })
        }
    }

    /// Residuals, and BᵀW per input.
    pub(crate) fn evaluate(&self, weights: &[f64]) -> (Vec<f64>, Vec<Vec<f64>>) {
        let mut e = self.q.clone();
        accumulate(&self.a, weights, &mut e);
        let mut inputs = Vec::with_capacity(self.inputs);
        for b in &self.b {
            let mut c = vec![0.0; e.len()];
            accumulate(b, weights, &mut c);
            for (e, c) in e.iter_mut().zip(&c) {
                *e -= 0.25 * c * c;
            }
            inputs.push(c);
        }
        (e, inputs)
    }

    /// ∂e/∂W = a − ½ B BᵀW at every point, P × N: the Lyapunov operator (thesis Eq 4.23) of the policy that W stands
    /// for.
    pub(crate) fn jacobian(&self, inputs: &[Vec<f64>]) -> DMatrix<f64> {
        let mut jacobian = self.a.clone();
        for (b, c) in self.b.iter().zip(inputs) {
            for j in 0..jacobian.ncols() {
                for (p, c) in c.iter().enumerate() {
                    jacobian[(p, j)] -= 0.5 * c * b[(p, j)];
                }
            }
        }
        jacobian
    }

    /// The residuals as linear functions of the weights and their products: P × (1 + N + N(N+1)/2), so that
    /// e = F θ with θ = (1, Wᵢ, WᵢWⱼ for i ≤ j).
    pub(crate) fn features(&self) -> DMatrix<f64> {
        let count = self.basis.len();
        let mut f = DMatrix::zeros(self.points(), 1 + count + count * (count + 1) / 2);
        f.column_mut(0).copy_from_slice(&self.q);
        f.columns_mut(1, count).copy_from(&self.a);
        let mut at = 1 + count;
        for i in 0..count {
            for j in i..count {
                let factor = if i == j { -0.25 } else { -0.5 };
                for b in &self.b {
                    for p in 0..self.points() {
                        f[(p, at)] += factor * b[(p, i)] * b[(p, j)];
                    }
                }
                at += 1;
            }
        }
        f
    }
}

/// y += M w, column by column.
fn accumulate(m: &DMatrix<f64>, w: &[f64], y: &mut [f64]) {
    for (column, w) in m.column_iter().zip(w) {
        for (y, v) in y.iter_mut().zip(column.iter()) {
            *y += w * v;
        }
    }
}
