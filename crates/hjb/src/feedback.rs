//! The law of a value function, and whether it can be trusted.

use nalgebra::{Cholesky, Complex, DMatrix, DVector};

use crate::basis::Monomials;
use crate::error::{HjbError, RiccatiError};
use crate::plant::{Linear, Plant, tangent};
use crate::range::InputRange;

/// u(x) = −½ R⁻¹ g(x)ᵀ ∇φ(x)ᵀ W (thesis Eq 4.27), or the saturated law of [`InputRange`] where inputs have limits.
#[derive(Debug, Clone)]
pub struct Feedback {
    basis: Monomials,
    weights: Vec<f64>,
    r: Cholesky<f64, nalgebra::Dyn>,
    /// Empty where no input has limits.
    ranges: Vec<InputRange>,
}

impl Feedback {
    /// Of N weights; `r` is m × m positive definite.
    ///
    /// # Errors
    /// [`HjbError::Size`] for another number of weights, [`RiccatiError::NotPositive`] for a weight that is no cost.
    pub fn new(basis: Monomials, weights: Vec<f64>, r: &DMatrix<f64>) -> Result<Feedback, HjbError> {
        if weights.len() != basis.len() {
            let (found, wanted) = (weights.len(), basis.len());
            return Err(HjbError::Size { what: "the list of weights", found, wanted });
        }
        crate::check::square("R", r)?;
        crate::check::finite("R", r)?;
        crate::check::symmetric("R", r)?;
        let cholesky = Cholesky::new(r.clone()).ok_or_else(|| {
            let smallest = r.clone().symmetric_eigenvalues().min();
            RiccatiError::NotPositive { matrix: "R", definite: true, smallest }
        })?;
        Ok(Feedback { basis, weights, r: cholesky, ranges: Vec::new() })
    }

    /// The same with inputs that stay within ranges, one for each ([`InputRange::command`]).
    ///
    /// # Errors
    /// [`HjbError::Size`] for another number of ranges, [`HjbError::CoupledInputs`] for limits with an R that is not
    /// diagonal.
    pub fn within(mut self, ranges: &[InputRange]) -> Result<Feedback, HjbError> {
        crate::check::ranges(ranges, &self.r.l())?;
        self.ranges = if ranges.iter().any(InputRange::is_limited) { ranges.to_vec() } else { Vec::new() };
        Ok(self)
    }

    /// The basis.
    #[must_use]
    pub fn basis(&self) -> &Monomials {
        &self.basis
    }

    /// The weights.
    #[must_use]
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// V(x).
    #[must_use]
    pub fn value(&self, x: &[f64]) -> f64 {
        self.basis.value(&self.weights, x)
    }

    /// u(x), m values, for a plant's g(x) (n × m by columns); not numbers where x or g has another size.
    #[must_use]
    pub fn control(&self, x: &[f64], g: &[f64]) -> Vec<f64> {
        let inputs = self.r.l_dirty().nrows();
        if x.len() != self.basis.states() || g.len() != x.len() * inputs {
            return vec![f64::NAN; inputs];
        }
        let gradient = self.basis.gradient(&self.weights, x);
        let products = g.chunks(x.len()).map(|g| g.iter().zip(&gradient).map(|(g, v)| g * v).sum());
        let right = DVector::from_iterator(inputs, products);
        if self.ranges.is_empty() {
            return (self.r.solve(&right) * -0.5).as_slice().to_vec();
        }
        let limited = self.ranges.iter().enumerate().zip(right.iter());
        limited.map(|((k, range), p)| range.command(*p, self.weight(k))).collect()
    }

    /// R's element of an input, where inputs are not coupled.
    fn weight(&self, input: usize) -> f64 {
        self.r.l_dirty()[(input, input)].powi(2)
    }

    /// What an input u costs: uᵀRu, or U(u) of [`InputRange::cost`] where inputs have limits; not a number for another
    /// number of inputs.
    #[must_use]
    pub fn input_cost(&self, u: &[f64]) -> f64 {
        let inputs = self.r.l_dirty().nrows();
        if u.len() != inputs {
            return f64::NAN;
        }
        if self.ranges.is_empty() {
            return (self.r.l().transpose() * DVector::from_column_slice(u)).norm_squared();
        }
        self.ranges.iter().zip(u).enumerate().map(|(k, (range, u))| range.cost(*u, self.weight(k))).sum()
    }

    /// The gain K, m × n, of the law's linear part u = −K x at the origin, which no limit changes.
    #[must_use]
    pub fn gain(&self, b: &DMatrix<f64>) -> DMatrix<f64> {
        let n = self.basis.states();
        let p = DMatrix::from_row_slice(n, n, &self.basis.hessian(&self.weights));
        self.r.solve(&(b.transpose() * p))
    }
}

/// What a law was found to do.
#[derive(Debug, Clone, PartialEq)]
pub struct Verification {
    /// Smallest eigenvalue of the Hessian ½∂²V/∂x² at the origin: a value function has a positive one.
    pub curvature: f64,
    /// Eigenvalues of the closed loop's tangent at the origin.
    pub closed_loop: Vec<Complex<f64>>,
    /// Root of Σe² over Σ(xᵀQx)², over the points: 1 for V = 0.
    pub residual: f64,
    /// Points away from the origin with V > 0.
    pub positive: usize,
    /// Points away from the origin with V̇ = ∇V·(f + g u) < 0.
    pub decreasing: usize,
    /// Points away from the origin.
    pub points: usize,
    /// The largest c such that V > 0 and V̇ < 0 at every point with V ≤ c: every trajectory that starts in the part of
    /// {V ≤ c} around the origin returns there, as far as the points can tell, as long as that part lies inside the
    /// domain. Infinite when no point contradicts.
    pub level: f64,
}

impl Verification {
    /// V has a minimum at the origin and the closed loop's tangent is stable there: the least that a law must do. A
    /// residual of zero does not imply it.
    #[must_use]
    pub fn is_stabilising(&self) -> bool {
        self.curvature > 0.0 && !self.closed_loop.is_empty() && self.closed_loop.iter().all(|l| l.re < 0.0)
    }

    /// [`is_stabilising`](Verification::is_stabilising), and V is a Lyapunov function at every point of the domain.
    #[must_use]
    pub fn holds_everywhere(&self) -> bool {
        self.is_stabilising() && self.positive == self.points && self.decreasing == self.points
    }
}

/// Checks a law on its plant with running cost xᵀQx + uᵀRu, or that of its [`InputRange`]s: at the origin and at points of n values.
///
/// # Errors
/// [`HjbError`]: sizes, a plant that is not finite.
pub fn verify(
    plant: &impl Plant,
    q: &DMatrix<f64>,
    feedback: &Feedback,
    points: &[Vec<f64>],
) -> Result<Verification, HjbError> {
    let (n, m) = (plant.states(), plant.inputs());
    if feedback.basis.states() != n {
        let found = feedback.basis.states();
        return Err(HjbError::Size { what: "the basis' state", found, wanted: n });
    }
    crate::check::shape("Q", q, n, n)?;
    // Steps of the differences: the size of the states the law is for.
    let size = |i: usize| points.iter().map(|p| p[i].abs()).fold(0.0, f64::max);
    if let Some(p) = points.iter().find(|p| p.len() != n) {
        return Err(HjbError::Size { what: "a point", found: p.len(), wanted: n });
    }
    let sizes: Vec<f64> = (0..n).map(size).map(|s| if s > 0.0 { s } else { 1.0 }).collect();
    let Linear { a, b } = tangent(plant, &sizes);
    let p = DMatrix::from_row_slice(n, n, &feedback.basis.hessian(&feedback.weights));
    let closed = a - &b * feedback.gain(&b);
    let mut found = Verification {
        curvature: p.symmetric_eigenvalues().min(),
        closed_loop: crate::dense::eigenvalues(&closed).unwrap_or_default(),
        residual: 0.0,
        positive: 0,
        decreasing: 0,
        points: 0,
        level: f64::INFINITY,
    };
    let (mut f, mut g) = (vec![0.0; n], vec![0.0; n * m]);
    let (mut squares, mut costs) = (0.0, 0.0);
    for x in points {
        plant.drift(x, &mut f);
        plant.input(x, &mut g);
        let u = feedback.control(x, &g);
        let v = feedback.value(x);
        let gradient = feedback.basis.gradient(&feedback.weights, x);
        let rate = |i: usize| f[i] + (0..m).map(|j| g[j * n + i] * u[j]).sum::<f64>();
        let falling: f64 = (0..n).map(|i| gradient[i] * rate(i)).sum();
        let state_cost: f64 = (0..n * n).map(|k| x[k / n] * q[(k / n, k % n)] * x[k % n]).sum();
        let input_cost: f64 = if feedback.ranges.is_empty() {
            // u minimises the Hamiltonian: uᵀRu = −½ ∇Vᵀ g u.
            -0.5 * (0..n).map(|i| gradient[i] * (0..m).map(|j| g[j * n + i] * u[j]).sum::<f64>()).sum::<f64>()
        } else {
            feedback.input_cost(&u)
        };
        let e = falling + state_cost + input_cost;
        if !e.is_finite() {
            return Err(HjbError::NotFinite { point: x.clone() });
        }
        squares += e * e;
        costs += state_cost * state_cost;
        if x.iter().all(|x| *x == 0.0) {
            continue;
        }
        found.points += 1;
        found.positive += usize::from(v > 0.0);
        found.decreasing += usize::from(falling < 0.0);
        if !(v > 0.0 && falling < 0.0) {
            found.level = found.level.min(v.max(0.0));
        }
    }
    found.residual = if costs > 0.0 { (squares / costs).sqrt() } else { 0.0 };
    Ok(found)
}
