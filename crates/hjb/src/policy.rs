//! Gauss–Newton on the residuals, which is policy iteration.

use faer::MatRef;
use faer::linalg::solvers::SolveLstsq;
use nalgebra::DMatrix;

use crate::error::HjbError;
use crate::problem::Problem;

/// Settings of [`policy_iteration`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PolicyOptions {
    /// Most steps.
    pub steps: usize,
    /// A relative change of the weights that ends it.
    pub tolerance: f64,
    /// Whether the weights of degree two stay as they are: those of the Riccati equation at the origin, where the law
    /// is then optimal exactly, while the higher degrees follow the nonlinearity (E. Al'brekht 1961).
    pub hold_quadratic: bool,
}

impl Default for PolicyOptions {
    fn default() -> PolicyOptions {
        PolicyOptions { steps: 50, tolerance: 1e-14, hold_quadratic: false }
    }
}

/// What policy iteration came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    /// Weights, N values.
    pub weights: Vec<f64>,
    /// J = ½ eᵀe over the points.
    pub loss: f64,
    /// Steps made.
    pub steps: usize,
    /// Whether the weights stood still within the tolerance.
    pub converged: bool,
}

/// From the weights of a stabilising policy, steps that each solve the Lyapunov equation (thesis Eq 4.23) of the last
/// policy for its value in the least-squares sense, and take the policy of that value (thesis Eq 4.27).
///
/// The Lyapunov equation at the points is J W' = −(q + ¼‖BᵀW‖²) with J = ∂e/∂W: the Gauss–Newton step for ½ eᵀe, which
/// for a linear plant and a quadratic basis is D. Kleinman's method (1968): from a stabilising start it converges,
/// quadratically, to the stabilising solution and no other. With limits ([`Problem::within`]) the right side is
/// −(q + U(u)), which is the successive approximation of M. Abu-Khalaf and F. L. Lewis (2005). A step that does not lower the loss is halved.
///
/// # Errors
/// [`HjbError::Size`] for a start of another size, [`HjbError::Undetermined`] when the points do not determine the
/// weights.
pub fn policy_iteration(
    problem: &Problem,
    start: &[f64],
    options: PolicyOptions,
) -> Result<Policy, HjbError> {
    problem.check(start)?;
    let free: Vec<usize> = problem
        .basis()
        .exponents()
        .enumerate()
        .filter(|(_, e)| !options.hold_quadratic || e.iter().map(|e| u32::from(*e)).sum::<u32>() > 2)
        .map(|(j, _)| j)
        .collect();
    let undetermined = HjbError::Undetermined { points: problem.points(), functions: free.len() };
    if problem.points() < free.len() {
        return Err(undetermined);
    }
    let loss_of = |e: &[f64]| 0.5 * e.iter().map(|e| e * e).sum::<f64>();
    let mut w = start.to_vec();
    let (mut e, mut inputs) = problem.evaluate(&w);
    let mut policy = Policy { weights: Vec::new(), loss: loss_of(&e), steps: 0, converged: false };
    while policy.steps < options.steps && !policy.converged && !free.is_empty() {
        let jacobian = problem.jacobian(&inputs).select_columns(&free);
        let found = least_squares(&jacobian, &e).ok_or(undetermined.clone())?;
        let mut step = vec![0.0; w.len()];
        for (j, s) in free.iter().zip(found) {
            step[*j] = s;
        }
        policy.steps += 1;
        let size = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>().sqrt();
        policy.converged = size(&step) <= options.tolerance * size(&w);
        let mut share = 1.0;
        loop {
            let next: Vec<f64> = w.iter().zip(&step).map(|(w, s)| w - share * s).collect();
            let (after, after_inputs) = problem.evaluate(&next);
            let loss = loss_of(&after);
            if loss < policy.loss {
                (w, e, inputs, policy.loss) = (next, after, after_inputs, loss);
                break;
            }
            share *= 0.5;
            if share < 1e-3 {
                // No step lowers the loss any more: rounding is all that is left.
                policy.converged = true;
                break;
            }
        }
    }
    policy.weights = w;
    Ok(policy)
}

/// The x that minimises ‖M x − y‖ for as many rows as columns or more, columns scaled to unit norm; `None` when M has not
/// full rank.
fn least_squares(m: &DMatrix<f64>, y: &[f64]) -> Option<Vec<f64>> {
    let (rows, columns) = m.shape();
    let norms: Vec<f64> = m.column_iter().map(|c| c.norm()).collect();
    if norms.iter().any(|n| *n == 0.0 || !n.is_finite()) {
        return None;
    }
    let mut scaled = m.clone().insert_column(columns, 0.0);
    for (mut column, norm) in scaled.column_iter_mut().zip(&norms) {
        column /= *norm;
    }
    scaled.column_mut(columns).copy_from_slice(y);
    // Nearly all of the work is in the factor of all rows, [M y] = Q [R z], which goes by blocks where it need not
    // pivot; the pivots that tell the rank are then those of R.
    let whole = MatRef::from_column_major_slice(scaled.as_slice(), rows, columns + 1).qr();
    let triangle = whole.thin_R();
    let qr = triangle.get(..columns, ..columns).col_piv_qr();
    let r = qr.R();
    let (first, last) = (r[(0, 0)].abs(), r[(columns - 1, columns - 1)].abs());
    if last <= 1e-13 * first {
        return None;
    }
    let solution = qr.solve_lstsq(triangle.get(..columns, columns..));
    Some(norms.iter().enumerate().map(|(j, n)| solution[(j, 0)] / n).collect())
}
