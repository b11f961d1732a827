//! Training by AdaMax: thesis Algorithm 3 (after D. Kingma, J. Ba, *Adam*, ICLR 2015, §7.1).

use faer::MatRef;
use nalgebra::DMatrix;

use crate::error::HjbError;
use crate::problem::Problem;

/// Settings of [`adamax`].
#[derive(Debug, Clone, PartialEq)]
pub struct AdamaxOptions {
    /// Step size α.
    pub rate: f64,
    /// Decay β₁ of the mean of the gradient.
    pub beta1: f64,
    /// Decay β₂ of its largest magnitude.
    pub beta2: f64,
    /// Most iterations.
    pub iterations: usize,
    /// A J at or below which training ends.
    pub target: f64,
    /// Iterations without a better J after which the step size is halved; a constant one keeps bursting out of the
    /// minimum, by as much as J = 5·10⁻² for the F16. `None` for the constant step of Algorithm 3.
    pub patience: Option<usize>,
    /// Record J and the weights every so many iterations; 0 for never.
    pub record_every: usize,
}

impl Default for AdamaxOptions {
    /// The thesis' settings but for the patience: α = 0.001, β₁ = 0.9, β₂ = 0.999.
    fn default() -> AdamaxOptions {
        AdamaxOptions {
            rate: 1e-3,
            beta1: 0.9,
            beta2: 0.999,
            iterations: 20_000,
            target: 0.0,
            patience: Some(1000),
            record_every: 0,
        }
    }
}

impl AdamaxOptions {
    fn check(&self) -> Result<(), HjbError> {
        let rows = [
            ("rate", self.rate, self.rate > 0.0 && self.rate.is_finite(), "a positive number"),
            ("beta1", self.beta1, (0.0..1.0).contains(&self.beta1), "in [0, 1)"),
            ("beta2", self.beta2, (0.0..1.0).contains(&self.beta2), "in [0, 1)"),
            ("target", self.target, self.target >= 0.0, "zero or more"),
            (
                "patience",
                self.patience.unwrap_or(1) as f64,
                self.patience != Some(0),
                "at least one iteration",
            ),
        ];
        match rows.iter().find(|r| !r.2) {
            None => Ok(()),
            Some((option, value, _, wanted)) => Err(HjbError::Option { option, value: *value, wanted }),
        }
    }
}

/// Why training ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainingEnd {
    /// J reached the target.
    Target,
    /// The iterations were used up.
    Limit,
    /// J or its gradient was no longer finite.
    Diverged,
}

/// A recorded iteration.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded {
    /// Iteration, from 0: the start.
    pub iteration: usize,
    /// J = ½ eᵀe there.
    pub loss: f64,
    /// Weights there.
    pub weights: Vec<f64>,
}

/// What training came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Training {
    /// The weights of the least J seen, not of the last iteration.
    pub weights: Vec<f64>,
    /// J = ½ eᵀe of these (thesis Eq 4.38, with its ½).
    pub loss: f64,
    /// The iteration they are from.
    pub best_iteration: usize,
    /// Iterations made.
    pub iterations: usize,
    /// Why it ended.
    pub end: TrainingEnd,
    /// J and weights along the way.
    pub history: Vec<Recorded>,
}

/// Minimises J(W) = ½ Σ e(xᵢ)² over the collocation points from the weights `start`, N values.
///
/// Where no input has limits, e is a polynomial of degree two in W, e = F θ(W). With more points than products of weights, an orthogonal
/// transformation F = Q R leaves J = ½‖R θ‖² as it is, to rounding, and an iteration costs the same however many points
/// there are.
///
/// A residual of zero is not yet an answer: each of the Riccati equation's real solutions has it, and all but one
/// make an unstable loop. [`verify`](crate::verify) tells.
///
/// ```
/// use greybox_hjb::{AdamaxOptions, Domain, Linear, Monomials, Problem, adamax};
/// use nalgebra::dmatrix;
/// // ẋ = x + u with unit weights: V = (1 + √2) x².
/// let plant = Linear { a: dmatrix![1.0], b: dmatrix![1.0] };
/// let points = Domain::symmetric(&[1.0])?.grid(&[11])?;
/// let one = dmatrix![1.0];
/// let problem = Problem::new(&plant, &one, &one, Monomials::even(1, 2)?, &points)?;
/// let trained = adamax(&problem, &[2.0], &AdamaxOptions { rate: 0.01, ..Default::default() })?;
/// assert!((trained.weights[0] - (1.0 + 2f64.sqrt())).abs() < 1e-9);
/// # Ok::<(), greybox_hjb::HjbError>(())
/// ```
///
/// # Errors
/// [`HjbError::Size`] for a start of another size, [`HjbError::Option`] for settings that make no sense.
pub fn adamax(problem: &Problem, start: &[f64], options: &AdamaxOptions) -> Result<Training, HjbError> {
    problem.check(start)?;
    options.check()?;
    let mut objective = Objective::of(problem);
    let n = start.len();
    let (mut w, mut mean, mut peak) = (start.to_vec(), vec![0.0; n], vec![0.0f64; n]);
    let mut gradient = vec![0.0; n];
    let mut best = Training {
        weights: w.clone(),
        loss: f64::INFINITY,
        best_iteration: 0,
        iterations: 0,
        end: TrainingEnd::Limit,
        history: Vec::new(),
    };
    let (mut rate, mut decayed, mut waited) = (options.rate, 1.0, 0);
    for k in 0..=options.iterations {
        let loss = objective.evaluate(&w, &mut gradient);
        if options.record_every > 0 && k % options.record_every == 0 {
            best.history.push(Recorded { iteration: k, loss, weights: w.clone() });
        }
        best.iterations = k;
        if loss < best.loss {
            (best.loss, best.best_iteration, waited) = (loss, k, 0);
            best.weights.copy_from_slice(&w);
        } else {
            waited += 1;
        }
        if loss <= options.target {
            best.end = TrainingEnd::Target;
            break;
        }
        if !loss.is_finite() {
            best.end = TrainingEnd::Diverged;
            break;
        }
        if options.patience.is_some_and(|p| waited >= p) {
            (rate, waited) = (0.5 * rate, 0);
        }
        decayed *= options.beta1;
        let step = rate / (1.0 - decayed);
        for i in 0..n {
            let g = gradient[i];
            mean[i] = options.beta1 * mean[i] + (1.0 - options.beta1) * g;
            peak[i] = (options.beta2 * peak[i]).max(g.abs());
            // Where a gradient has always been zero there is nothing to follow.
            if peak[i] > 0.0 {
                w[i] -= step * mean[i] / peak[i];
            }
        }
    }
    Ok(best)
}

/// J and its gradient, over the points or over R.
enum Objective<'a> {
    Points(&'a Problem),
    Compressed { r: DMatrix<f64>, theta: Vec<f64>, z: Vec<f64> },
}

impl Objective<'_> {
    fn of(problem: &Problem) -> Objective<'_> {
        let count = problem.basis().len();
        let features = 1 + count + count * (count + 1) / 2;
        if problem.points() <= features || !problem.is_quadratic() {
            return Objective::Points(problem);
        }
        let f = problem.features();
        let view = MatRef::from_column_major_slice(f.as_slice(), f.nrows(), f.ncols());
        let qr = view.qr();
        let r = qr.thin_R();
        let r = DMatrix::from_fn(features, features, |i, j| if i <= j { r[(i, j)] } else { 0.0 });
        Objective::Compressed { r, theta: vec![0.0; features], z: vec![0.0; features] }
    }

    /// J, and its gradient written to `gradient`.
    fn evaluate(&mut self, w: &[f64], gradient: &mut [f64]) -> f64 {
        match self {
            Objective::Points(problem) => {
                let (e, inputs) = problem.evaluate(w);
                let jacobian = problem.jacobian(&inputs);
                for (g, column) in gradient.iter_mut().zip(jacobian.column_iter()) {
                    *g = column.iter().zip(&e).map(|(d, e)| d * e).sum();
                }
                0.5 * e.iter().map(|e| e * e).sum::<f64>()
            }
            Objective::Compressed { r, theta, z } => {
                let n = w.len();
                theta[0] = 1.0;
                theta[1..=n].copy_from_slice(w);
                let mut at = 1 + n;
                for i in 0..n {
                    for j in i..n {
                        theta[at] = w[i] * w[j];
                        at += 1;
                    }
                }
                // z = R θ by columns of the upper triangle.
                z.fill(0.0);
                let size = theta.len();
                let columns = || r.as_slice().chunks_exact(size);
                for (k, (column, t)) in columns().zip(theta.iter()).enumerate() {
                    for (z, r) in z[..=k].iter_mut().zip(&column[..=k]) {
                        *z += t * r;
                    }
                }
                // ∂J/∂θ = Rᵀz, ∂θ/∂W by the product rule.
                gradient.fill(0.0);
                let mut columns = columns()
                    .enumerate()
                    .map(|(k, column)| column[..=k].iter().zip(&z[..=k]).map(|(r, z)| r * z).sum::<f64>());
                let _constant = columns.next();
                for g in gradient.iter_mut() {
                    *g = columns.next().unwrap_or(0.0);
                }
                for i in 0..n {
                    for j in i..n {
                        let v = columns.next().unwrap_or(0.0);
                        gradient[i] += v * w[j];
                        gradient[j] += v * w[i];
                    }
                }
                0.5 * z.iter().map(|z| z * z).sum::<f64>()
            }
        }
    }
}
