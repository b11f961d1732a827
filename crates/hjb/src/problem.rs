//! The Hamilton–Jacobi–Bellman equation at collocation points, as equations for the weights.

use nalgebra::{Cholesky, DMatrix};

use crate::basis::Monomials;
use crate::error::{HjbError, RiccatiError};
use crate::plant::Plant;
use crate::range::InputRange;

/// Residuals of thesis Eq 4.37 at P points, for N weights:
///
/// e(x) = Wᵀ∇φ f − ¼ Wᵀ∇φ g R⁻¹ gᵀ∇φᵀ W + xᵀQx = aᵀW − ¼‖BᵀW‖² + q, with a = ∇φ f, B = ∇φ g R^(−1/2).
///
/// Where inputs have limits ([`Problem::within`]), −¼ (BᵀW)² of each is the least of [`InputRange::least`], for limits
/// ±ū −2 ū² r ln cosh(BᵀW/(2 ū √r)).
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
    /// L of R = L Lᵀ.
    factor: DMatrix<f64>,
    /// Of Lᵀu, one for each input.
    ranges: Vec<InputRange>,
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
            factor: cholesky.l(),
            ranges: vec![InputRange::UNLIMITED; m],
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

    /// The same with inputs that stay within ranges, one for each, at the cost of [`InputRange`].
    ///
    /// # Errors
    /// [`HjbError::Size`] for another number of ranges, [`HjbError::CoupledInputs`] for limits with an R that is not
    /// diagonal.
    pub fn within(mut self, ranges: &[InputRange]) -> Result<Problem, HjbError> {
        crate::check::ranges(ranges, &self.factor)?;
        self.ranges = ranges.iter().enumerate().map(|(k, r)| r.times(self.factor[(k, k)])).collect();
        Ok(self)
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

    /// Whether the residuals are polynomials of degree two in the weights: no input has limits.
    pub(crate) fn is_quadratic(&self) -> bool {
        !self.ranges.iter().any(InputRange::is_limited)
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
        for (b, range) in self.b.iter().zip(&self.ranges) {
            let mut c = vec![0.0; e.len()];
            accumulate(b, weights, &mut c);
            for (e, c) in e.iter_mut().zip(&c) {
                *e += range.least(*c, 1.0);
            }
            inputs.push(c);
        }
        (e, inputs)
    }

    /// ∂e/∂W = a + B u* at every point, P × N, with u* = −½ BᵀW where there are no limits: the Lyapunov operator (thesis
    /// Eq 4.23) of the policy that W stands for, for u* minimises what it is put into.
    pub(crate) fn jacobian(&self, inputs: &[Vec<f64>]) -> DMatrix<f64> {
        let mut jacobian = self.a.clone();
        for ((b, c), range) in self.b.iter().zip(inputs).zip(&self.ranges) {
            let commands: Vec<f64> = c.iter().map(|c| range.command(*c, 1.0)).collect();
            for j in 0..jacobian.ncols() {
                for (p, u) in commands.iter().enumerate() {
                    jacobian[(p, j)] += u * b[(p, j)];
                }
            }
        }
        jacobian
    }

    /// The residuals as linear functions of the weights and their products: P × (1 + N + N(N+1)/2), so that
    /// e = F θ with θ = (1, Wᵢ, WᵢWⱼ for i ≤ j); where no input has limits.
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
