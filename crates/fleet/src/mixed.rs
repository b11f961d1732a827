//! A linear mixed-effects model of estimates that have standard errors, by restricted maximum likelihood.
//!
//! Estimate yᵢ of machine m(i), with known standard error σᵢ and regressors xᵢ, is
//!
//! ```text
//! yᵢ = xᵢᵀβ + u_m(i) + vᵢ + eᵢ      u ~ N(0, τ_b²)   v ~ N(0, τ_w²)   e ~ N(0, σᵢ²)
//! ```
//!
//! u is what a machine has of its own, v what changes from recording to recording of one machine. The covariance V of
//! the estimates is block diagonal, and a block is a diagonal and a rank one, so that everything below costs O(n p²):
//!
//! ```text
//! wᵢ = 1/(σᵢ² + τ_w²)     W = Σ wᵢ     V⁻¹a = w∘a − w c (wᵀa)     c = τ_b²/(1 + τ_b² W)
//! 2ℓ = −ln|V| − ln|A| − rᵀV⁻¹r      A = XᵀV⁻¹X      β = A⁻¹XᵀV⁻¹y      r = y − Xβ
//! ```
//!
//! ℓ is maximised over τ_b² and τ_w² ≥ 0 by Newton steps with the average-information matrix. A machine's own value is
//! its best linear unbiased prediction, drawn towards the others by 1 − λ:
//!
//! ```text
//! θ_m = x̄ᵀβ + λ (ȳ − x̃ᵀβ)    λ = τ_b² W/(1 + τ_b² W)    var(θ_m) = τ_b²(1 − λ) + dᵀA⁻¹d    d = x̄ − λ x̃
//! ```
//!
//! with the weighted means ȳ, x̃ and the plain mean x̄ of the machine's regressors.
//!
//! # References
//! - D. A. Harville, "Maximum likelihood approaches to variance component estimation and to related problems", Journal
//!   of the American Statistical Association 72(358), 1977, 320–338, <https://doi.org/10.1080/01621459.1977.10480998>.
//! - A. R. Gilmour, R. Thompson, B. R. Cullis, "Average information REML: an efficient algorithm for variance parameter
//!   estimation in linear mixed models", Biometrics 51(4), 1995, 1440–1450, <https://doi.org/10.2307/2533274>.

use std::ops::Range;

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Newton steps at most; ten are usual.
const STEPS: usize = 100;

/// A change of ln-likelihood that is none.
const CONVERGED: f64 = 1e-9;

/// Estimates of one number, those of a machine one after the other.
#[derive(Debug, Clone)]
pub(crate) struct Problem {
    /// Which estimates are of which machine.
    groups: Vec<Range<usize>>,
    values: Vec<f64>,
    variances: Vec<f64>,
    /// p regressors of each estimate.
    rows: Vec<DVector<f64>>,
}

/// The maximum.
#[derive(Debug, Clone)]
pub(crate) struct Fit {
    /// β.
    pub(crate) beta: DVector<f64>,
    /// A.
    information: DMatrix<f64>,
    /// A⁻¹, the covariance of β.
    pub(crate) covariance: DMatrix<f64>,
    /// τ_b² and τ_w².
    pub(crate) variances: [f64; 2],
}

/// A number and its standard error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Predicted {
    pub(crate) value: f64,
    pub(crate) error: f64,
}

/// V⁻¹ of one machine.
struct Block<'a> {
    weights: Vec<f64>,
    total: f64,
    /// c.
    shared: f64,
    rows: &'a [DVector<f64>],
    values: &'a [f64],
}

impl Block<'_> {
    /// Σ wᵢxᵢ.
    fn weighted_rows(&self) -> DVector<f64> {
        let mut sum = DVector::zeros(self.rows.first().map_or(0, |row| row.len()));
        for (w, row) in self.weights.iter().zip(self.rows) {
            sum.axpy(*w, row, 1.0);
        }
        sum
    }

    fn weighted(&self, values: &[f64]) -> f64 {
        self.weights.iter().zip(values).map(|(w, v)| w * v).sum()
    }

    /// V⁻¹ a.
    fn solve(&self, values: &[f64]) -> Vec<f64> {
        let shift = self.shared * self.weighted(values);
        self.weights.iter().zip(values).map(|(w, v)| w * (v - shift)).collect()
    }
}

/// ℓ at some variances, with what its derivatives need.
struct Point {
    beta: DVector<f64>,
    information: DMatrix<f64>,
    factor: Cholesky<f64, Dyn>,
    likelihood: f64,
}

impl Problem {
    /// `estimates` hold (machine, value, variance, regressors). Machines without an estimate are left out; the others keep
    /// the order in which they first come.
    pub(crate) fn new(
        estimates: impl IntoIterator<Item = (usize, f64, f64, DVector<f64>)>,
    ) -> (Problem, Vec<usize>) {
        let mut machines: Vec<usize> = Vec::new();
        let mut by_machine: Vec<Vec<(f64, f64, DVector<f64>)>> = Vec::new();
        let mut place = std::collections::HashMap::new();
        for (machine, value, variance, row) in estimates {
            let at = *place.entry(machine).or_insert_with(|| {
                machines.push(machine);
                by_machine.push(Vec::new());
                by_machine.len() - 1
            });
            by_machine[at].push((value, variance, row));
        }
        let mut problem = Problem { groups: vec![], values: vec![], variances: vec![], rows: vec![] };
        for group in by_machine {
            let start = problem.values.len();
            for (value, variance, row) in group {
                problem.values.push(value);
                problem.variances.push(variance);
                problem.rows.push(row);
            }
            problem.groups.push(start..problem.values.len());
        }
        (problem, machines)
    }

    /// How many machines there are.
    pub(crate) fn machines(&self) -> usize {
        self.groups.len()
    }

    /// How many estimates a machine has.
    pub(crate) fn recordings(&self, machine: usize) -> usize {
        self.groups[machine].len()
    }

    /// The machines but one.
    pub(crate) fn without(&self, machine: usize) -> Problem {
        let kept = self.groups.iter().enumerate().filter(|(m, _)| *m != machine);
        let estimates = kept.flat_map(|(m, group)| {
            group.clone().map(move |i| (m, self.values[i], self.variances[i], self.rows[i].clone()))
        });
        Problem::new(estimates).0
    }

    fn width(&self) -> usize {
        self.rows.first().map_or(0, |row| row.len())
    }

    fn block(&self, group: &Range<usize>, [between, within]: [f64; 2]) -> Block<'_> {
        let weights: Vec<f64> = self.variances[group.clone()].iter().map(|v| 1.0 / (v + within)).collect();
        let total: f64 = weights.iter().sum();
        Block {
            shared: between / (1.0 + between * total),
            weights,
            total,
            rows: &self.rows[group.clone()],
            values: &self.values[group.clone()],
        }
    }

    /// ℓ; `None` where the regressors leave a coefficient undetermined.
    fn at(&self, variances: [f64; 2]) -> Option<Point> {
        let p = self.width();
        let (mut information, mut right) = (DMatrix::zeros(p, p), DVector::zeros(p));
        let mut log_determinant = 0.0;
        for group in &self.groups {
            let block = self.block(group, variances);
            let sum = block.weighted_rows();
            for ((w, row), value) in block.weights.iter().zip(block.rows).zip(block.values) {
                information.ger(*w, row, row, 1.0);
                right.axpy(w * value, row, 1.0);
                log_determinant -= w.ln();
            }
            information.ger(-block.shared, &sum, &sum, 1.0);
            right.axpy(-block.shared * block.weighted(block.values), &sum, 1.0);
            log_determinant += (variances[0] * block.total).ln_1p();
        }
        let factor = Cholesky::new(information.clone())?;
        let beta = factor.solve(&right);
        let mut square = 0.0;
        for group in &self.groups {
            let block = self.block(group, variances);
            let residual = self.residual(group, &beta);
            square += residual.iter().zip(block.solve(&residual)).map(|(a, b)| a * b).sum::<f64>();
        }
        let likelihood = -0.5 * (log_determinant + factor.ln_determinant() + square);
        likelihood.is_finite().then_some(Point { beta, information, factor, likelihood })
    }

    fn residual(&self, group: &Range<usize>, beta: &DVector<f64>) -> Vec<f64> {
        group.clone().map(|i| self.values[i] - self.rows[i].dot(beta)).collect()
    }

    /// ∂ℓ/∂(τ_b², τ_w²) and the average information.
    fn slopes(&self, variances: [f64; 2], point: &Point) -> ([f64; 2], [[f64; 2]; 2]) {
        let p = self.width();
        let mut traces = [0.0; 2];
        let mut squares = [0.0; 2];
        // XᵀV⁻¹K V⁻¹X, XᵀV⁻¹h and hᵀV⁻¹h for K = ZZᵀ and I, h = K V⁻¹r.
        let mut spread = [DMatrix::zeros(p, p), DMatrix::zeros(p, p)];
        let mut crossed = [DVector::zeros(p), DVector::zeros(p)];
        let mut inner = [[0.0; 2]; 2];
        for group in &self.groups {
            let block = self.block(group, variances);
            let solved = block.solve(&self.residual(group, &point.beta));
            let sum: f64 = solved.iter().sum();
            let scores = [vec![sum; solved.len()], solved.clone()];
            squares[0] += sum * sum;
            squares[1] += solved.iter().map(|g| g * g).sum::<f64>();
            traces[0] += block.total / (1.0 + variances[0] * block.total);
            traces[1] += block.weights.iter().map(|w| w - block.shared * w * w).sum::<f64>();
            let weighted = block.weighted_rows();
            // V⁻¹X, row by row, and its sum over the machine.
            let mut all = DVector::zeros(p);
            for (w, row) in block.weights.iter().zip(block.rows) {
                let solved_row = *w * (row - block.shared * &weighted);
                spread[1].ger(1.0, &solved_row, &solved_row, 1.0);
                all += solved_row;
            }
            spread[0].ger(1.0, &all, &all, 1.0);
            for (k, h) in scores.iter().enumerate() {
                let solved_h = block.solve(h);
                for (s, row) in solved_h.iter().zip(block.rows) {
                    crossed[k].axpy(*s, row, 1.0);
                }
                for (l, other) in scores.iter().enumerate() {
                    inner[k][l] += solved_h.iter().zip(other).map(|(a, b)| a * b).sum::<f64>();
                }
            }
        }
        let score = [0, 1].map(|k| {
            let lost = point.factor.solve(&spread[k]).trace();
            0.5 * (squares[k] - (traces[k] - lost))
        });
        let information = [0, 1]
            .map(|k| [0, 1].map(|l| 0.5 * (inner[k][l] - crossed[k].dot(&point.factor.solve(&crossed[l])))));
        (score, information)
    }

    /// The maximum over the variances that `free` allows (the others are 0), from `start`.
    pub(crate) fn fit(&self, start: [f64; 2], free: [bool; 2]) -> Option<Fit> {
        let mut variances = [0, 1].map(|k| if free[k] { start[k].max(0.0) } else { 0.0 });
        let mut point = self.at(variances)?;
        for _ in 0..STEPS {
            let (score, information) = self.slopes(variances, &point);
            let step = step(variances, free, score, information);
            let mut length = 1.0;
            let next = loop {
                let tried = [0, 1].map(|k| (variances[k] + length * step[k]).max(0.0));
                match self.at(tried) {
                    Some(there) if there.likelihood > point.likelihood => break Some((tried, there)),
                    _ if length < 1e-6 => break None,
                    _ => length *= 0.5,
                }
            };
            let Some((tried, there)) = next else { break };
            let gain = there.likelihood - point.likelihood;
            (variances, point) = (tried, there);
            if gain < CONVERGED {
                break;
            }
        }
        Some(Fit {
            covariance: point.factor.inverse(),
            beta: point.beta,
            information: point.information,
            variances,
        })
    }

    /// What a machine has of its own, θ_m.
    pub(crate) fn shrunken(&self, machine: usize, fit: &Fit) -> Predicted {
        let group = &self.groups[machine];
        let block = self.block(group, fit.variances);
        let pull = fit.variances[0] * block.total / (1.0 + fit.variances[0] * block.total);
        let weighted = block.weighted_rows() / block.total;
        let mean = self.mean_row(machine);
        let own = block.weighted(block.values) / block.total;
        let value = mean.dot(&fit.beta) + pull * (own - weighted.dot(&fit.beta));
        let d = mean - pull * weighted;
        let variance = fit.variances[0] * (1.0 - pull) + (&fit.covariance * &d).dot(&d);
        Predicted { value, error: variance.max(0.0).sqrt() }
    }

    /// A machine's value from its own estimates alone, with the coefficients of the others.
    pub(crate) fn alone(&self, machine: usize, fit: &Fit) -> Predicted {
        let block = self.block(&self.groups[machine], [0.0, fit.variances[1]]);
        let weighted = block.weighted_rows() / block.total;
        let own = block.weighted(block.values) / block.total;
        let value = own + (self.mean_row(machine) - weighted).dot(&fit.beta);
        Predicted { value, error: block.total.recip().sqrt() }
    }

    fn mean_row(&self, machine: usize) -> DVector<f64> {
        let group = self.groups[machine].clone();
        let count = group.len() as f64;
        group.fold(DVector::zeros(self.width()), |sum, i| sum + &self.rows[i]) / count
    }

    /// How far a machine's estimates are from what `fit`, which has not seen it, says of a new machine: the difference over
    /// its standard deviation.
    pub(crate) fn deviation(&self, machine: usize, fit: &Fit) -> f64 {
        self.deviation_by(machine, &fit.beta, &fit.covariance, fit.variances)
    }

    /// As [`deviation`](Self::deviation), with the machine taken out of a fit that has seen it, its variances kept.
    pub(crate) fn deleted(&self, machine: usize, fit: &Fit) -> Option<f64> {
        let block = self.block(&self.groups[machine], fit.variances);
        let sum = block.weighted_rows();
        let mut information = fit.information.clone();
        let mut right = &fit.information * &fit.beta;
        for ((w, row), value) in block.weights.iter().zip(block.rows).zip(block.values) {
            information.ger(-*w, row, row, 1.0);
            right.axpy(-w * value, row, 1.0);
        }
        information.ger(block.shared, &sum, &sum, 1.0);
        right.axpy(block.shared * block.weighted(block.values), &sum, 1.0);
        let factor = Cholesky::new(information)?;
        Some(self.deviation_by(machine, &factor.solve(&right), &factor.inverse(), fit.variances))
    }

    fn deviation_by(
        &self,
        machine: usize,
        beta: &DVector<f64>,
        covariance: &DMatrix<f64>,
        variances: [f64; 2],
    ) -> f64 {
        let block = self.block(&self.groups[machine], variances);
        let weighted = block.weighted_rows() / block.total;
        let own = block.weighted(block.values) / block.total;
        let variance = variances[0] + block.total.recip() + (covariance * &weighted).dot(&weighted);
        (own - weighted.dot(beta)) / variance.sqrt()
    }
}

/// A Newton step: uphill, and with no variance at 0 led below it.
fn step(variances: [f64; 2], free: [bool; 2], score: [f64; 2], information: [[f64; 2]; 2]) -> [f64; 2] {
    let moves = [0, 1].map(|k| free[k] && (variances[k] > 0.0 || score[k] > 0.0));
    let alone = [0, 1].map(|k| {
        let curvature = information[k][k];
        if moves[k] && curvature > 0.0 { score[k] / curvature } else { 0.0 }
    });
    let [[a, b], [_, d]] = information;
    let determinant = a * d - b * b;
    if moves != [true, true] || determinant <= 1e-12 * a * d {
        return alone;
    }
    let both = [(d * score[0] - b * score[1]) / determinant, (a * score[1] - b * score[0]) / determinant];
    match both[0] * score[0] + both[1] * score[1] > 0.0 {
        true => both,
        false => alone,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f64, b: f64, tolerance: f64) {
        assert!((a - b).abs() <= tolerance, "{a} is not {b}");
    }

    fn problem(estimates: &[(usize, f64, f64, f64)]) -> Problem {
        let rows = estimates.iter().map(|&(m, y, s, x)| (m, y, s * s, DVector::from_vec(vec![1.0, x])));
        Problem::new(rows).0
    }

    const DATA: [(usize, f64, f64, f64); 9] = [
        (0, 1.0, 0.1, -1.0),
        (0, 1.3, 0.2, 0.5),
        (0, 0.8, 0.1, 0.3),
        (1, 2.1, 0.3, -0.2),
        (1, 2.6, 0.2, 0.9),
        (2, 0.2, 0.1, 0.1),
        (2, 0.6, 0.3, -0.7),
        (3, 1.5, 0.2, 0.4),
        (3, 1.1, 0.1, -0.3),
    ];

    /// V, A, β and ℓ with dense matrices.
    fn dense(p: &Problem, [between, within]: [f64; 2]) -> (f64, DVector<f64>, DMatrix<f64>, DMatrix<f64>) {
        let n = p.values.len();
        let mut v = DMatrix::zeros(n, n);
        for group in &p.groups {
            for i in group.clone() {
                for j in group.clone() {
                    v[(i, j)] = between;
                }
                v[(i, i)] += within + p.variances[i];
            }
        }
        let x = DMatrix::from_fn(n, 2, |i, j| p.rows[i][j]);
        let y = DVector::from_vec(p.values.clone());
        let inverse = v.clone().try_inverse().unwrap();
        let a = x.transpose() * &inverse * &x;
        let beta = a.clone().try_inverse().unwrap() * x.transpose() * &inverse * &y;
        let r = &y - &x * &beta;
        let l =
            -0.5 * (v.determinant().ln() + a.determinant().ln() + (r.transpose() * &inverse * &r)[(0, 0)]);
        let projection =
            &inverse - &inverse * &x * a.clone().try_inverse().unwrap() * x.transpose() * &inverse;
        (l, beta, a, projection)
    }

    #[test]
    fn blocks_give_what_dense_matrices_give() {
        let p = problem(&DATA);
        for variances in [[0.0, 0.0], [0.3, 0.0], [0.2, 0.05]] {
            let (likelihood, beta, a, _) = dense(&p, variances);
            let point = p.at(variances).unwrap();
            close(point.likelihood, likelihood, 1e-10);
            close((point.beta - beta).norm(), 0.0, 1e-10);
            close((point.information - a).norm(), 0.0, 1e-9);
        }
    }

    #[test]
    fn slopes_are_the_derivatives_of_the_likelihood() {
        let p = problem(&DATA);
        let at = [0.2, 0.05];
        let (score, information) = p.slopes(at, &p.at(at).unwrap());
        for k in 0..2 {
            let moved = |by: f64| {
                let mut there = at;
                there[k] += by;
                p.at(there).unwrap().likelihood
            };
            close(score[k], (moved(1e-6) - moved(-1e-6)) / 2e-6, 1e-6);
        }
        // The average information, by its definition.
        let (_, _, _, projection) = dense(&p, at);
        let y = DVector::from_vec(p.values.clone());
        let n = p.values.len();
        let mut same = DMatrix::zeros(n, n);
        for group in &p.groups {
            group.clone().for_each(|i| group.clone().for_each(|j| same[(i, j)] = 1.0));
        }
        let k = [same, DMatrix::identity(n, n)];
        for (i, a) in k.iter().enumerate() {
            for (j, b) in k.iter().enumerate() {
                let g = &projection * &y;
                let wanted = 0.5 * (g.transpose() * a * &projection * b * &g)[(0, 0)];
                close(information[i][j], wanted, 1e-9);
            }
        }
    }

    /// No variance nearby is more likely.
    #[test]
    fn the_fit_is_a_maximum() {
        let p = problem(&DATA);
        let fit = p.fit([0.1, 0.1], [true, true]).unwrap();
        let best = p.at(fit.variances).unwrap().likelihood;
        for (k, factor) in [(0, 0.9), (0, 1.1), (1, 0.9), (1, 1.1)] {
            let mut there = fit.variances;
            there[k] = (there[k] * factor).max(1e-4);
            assert!(p.at(there).unwrap().likelihood < best, "{:?}", fit.variances);
        }
        assert!(fit.variances[0] > 0.1);
    }

    /// The trials of [`crate::pool`] by REML in W. Viechtbauer, "Conducting meta-analyses in R with the metafor package",
    /// J. Stat. Softw. 36(3), 2010: τ² = 0.3132 and −0.7145 (0.1798).
    #[test]
    fn the_trials_of_a_vaccine_give_the_published_figures() {
        let effects = crate::pool::vaccine_trials();
        let estimates = effects
            .iter()
            .enumerate()
            .map(|(k, effect)| (k, effect.value, effect.error.powi(2), DVector::from_vec(vec![1.0])));
        let (problem, _) = Problem::new(estimates);
        let fit = problem.fit([0.1, 0.0], [true, false]).unwrap();
        close(fit.variances[0], 0.3132, 5e-5);
        close(fit.beta[0], -0.7145, 5e-5);
        close(fit.covariance[(0, 0)].sqrt(), 0.1798, 5e-5);
    }

    /// By hand: one machine, two estimates 1 and 3 of σ = 1, τ_b² = 1/2, β = 0 known to none: λ = 1/2.
    #[test]
    fn a_machine_is_drawn_towards_the_others() {
        let row = || DVector::from_vec(vec![1.0]);
        let (p, _) = Problem::new([(0, 1.0, 1.0, row()), (0, 3.0, 1.0, row()), (1, 0.0, 1e-12, row())]);
        let fit = Fit {
            beta: DVector::from_vec(vec![0.0]),
            information: DMatrix::from_element(1, 1, 1e30),
            covariance: DMatrix::zeros(1, 1),
            variances: [0.5, 0.0],
        };
        let drawn = p.shrunken(0, &fit);
        close(drawn.value, 1.0, 1e-12);
        close(drawn.error, 0.5, 1e-12);
        close(p.alone(0, &fit).value, 2.0, 1e-12);
        close(p.deviation(0, &fit), 2.0, 1e-12);
    }

    #[test]
    fn a_machine_taken_out_is_as_if_it_had_never_been_in() {
        let p = problem(&DATA);
        let fit = p.fit([0.1, 0.1], [true, true]).unwrap();
        let rest = p.without(1);
        let point = rest.at(fit.variances).unwrap();
        let without = Fit {
            covariance: point.factor.inverse(),
            beta: point.beta,
            information: point.information,
            variances: fit.variances,
        };
        close(p.deleted(1, &fit).unwrap(), p.deviation(1, &without), 1e-9);
    }
}
