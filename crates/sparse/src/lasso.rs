//! The LASSO by its active set and by coordinate descent, on the Gram matrix.
//!
//! With unit columns x̂ⱼ = Pⱼ/‖Pⱼ‖ and unit target ŷ = p/‖p‖ it minimises
//!
//! ```text
//! ½ ‖ŷ − Σ βⱼ x̂ⱼ‖² + λ Σ wⱼ |βⱼ|,      cⱼ = βⱼ ‖p‖ / ‖Pⱼ‖
//! ```
//!
//! so that λ ∈ [0, 1] has no unit and no term is judged by its scale. Columns of weight 0 are protected: they
//! are projected out of the others and of the target first (Frisch–Waugh; exact, by the triangular factor), and
//! take no part in the descent. Thesis Eq 2.14 is this with ½ and the norms taken into λ.
//!
//! With the signs of the coefficients known the minimiser solves a linear system; from one λ to the next the active set
//! changes by few columns, so that its Cholesky factor is kept and the steps are exact (feature-sign search). Where the
//! columns are too dependent for that, coordinate descent takes over.
//!
//! References: Lee, Battle, Raina & Ng, NIPS 19 (2006), feature-sign search; Friedman, Hastie & Tibshirani, J. Stat.
//! Softw. 33 (2010), covariance updates; the stopping rule is the duality gap (Kim et al., IEEE J. Sel. Top. Signal
//! Process. 1 (2007)).

use crate::error::{SparseError, check_range};
use crate::triangle::{Fit, RANK_TOLERANCE, Triangle};

/// When the descent stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LassoOptions {
    /// Largest duality gap relative to ½‖ŷ‖² after projection (default 1e-10).
    pub tolerance: f64,
    /// Most steps and sweeps over the columns per λ (default 20 000).
    pub max_sweeps: usize,
}

impl Default for LassoOptions {
    fn default() -> Self {
        Self { tolerance: 1e-10, max_sweeps: 20_000 }
    }
}

/// The minimiser for one λ.
#[derive(Debug, Clone, PartialEq)]
pub struct LassoFit {
    /// The penalty.
    pub lambda: f64,
    /// Coefficients of the unscaled columns and their residual sum of squares; shrunk, not refitted.
    pub fit: Fit,
    /// Relative duality gap reached: an upper bound of the relative excess of the objective.
    pub gap: f64,
    /// Whether the gap is within the tolerance.
    pub converged: bool,
    /// Steps of the active set and sweeps of the descent used.
    pub sweeps: usize,
}

/// The problem after normalisation and projection.
struct Normalised {
    /// Columns of the problem behind each coordinate.
    optional: Vec<usize>,
    protected: Vec<usize>,
    /// cⱼ = scale βⱼ for each coordinate.
    scale: Vec<f64>,
    /// x̂ᵢᵀ x̂ⱼ / (wᵢ wⱼ), column-major.
    gram: Vec<f64>,
    /// x̂ⱼᵀ ŷ / wⱼ.
    moment: Vec<f64>,
    target_square: f64,
    /// The factor with the protected columns first.
    ordered: Triangle,
    /// The problem's column at each position of `ordered`.
    order: Vec<usize>,
}

impl Normalised {
    fn new(triangle: &Triangle, weights: &[f64]) -> Result<Self, SparseError> {
        let k = triangle.columns();
        if weights.len() != k {
            return Err(SparseError::Length {
                what: "the list of penalty weights".into(),
                found: weights.len(),
                expected: k,
            });
        }
        for &w in weights {
            check_range("penalty weight", w, 0.0, f64::MAX, "finite and not negative")?;
        }
        let target = triangle.target_norm();
        if target == 0.0 {
            return Err(SparseError::ZeroTarget);
        }
        let protected: Vec<usize> = (0..k).filter(|&j| weights[j] == 0.0).collect();
        let mut order = protected.clone();
        order.extend((0..k).filter(|&j| weights[j] > 0.0));
        let ordered = triangle.select(&order)?;
        if let Some((at, relative)) = ordered.first_dependent()
            && at < protected.len()
        {
            return Err(SparseError::RankDeficient { column: protected[at], relative });
        }
        let trailing = ordered.trailing(protected.len());
        let all = trailing.gram();
        let norms: Vec<f64> = order[protected.len()..].iter().map(|&j| triangle.norm(j)).collect();
        // What the protected columns explain wholly has nothing left to explain with.
        let kept: Vec<usize> =
            (0..norms.len()).filter(|&i| trailing.norm(i) > RANK_TOLERANCE * norms[i]).collect();
        let optional: Vec<usize> = kept.iter().map(|&i| order[protected.len() + i]).collect();
        let factor: Vec<f64> =
            kept.iter().zip(&optional).map(|(&i, &j)| 1.0 / (norms[i] * weights[j])).collect();
        let m = kept.len();
        let mut gram = vec![0.0; m * m];
        for a in 0..m {
            for b in 0..m {
                gram[a * m + b] = all.product(kept[a], kept[b]) * factor[a] * factor[b];
            }
        }
        let moment = (0..m).map(|a| all.moment(kept[a]) * factor[a] / target).collect();
        let scale = factor.iter().map(|f| f * target).collect();
        let target_square = trailing.target_norm().powi(2) / (target * target);
        Ok(Self { optional, protected, scale, gram, moment, target_square, ordered, order })
    }

    fn coefficients(&self, beta: &[f64], columns: usize) -> Vec<f64> {
        let mut c = vec![0.0; columns];
        for ((&j, &b), &s) in self.optional.iter().zip(beta).zip(&self.scale) {
            c[j] = b * s;
        }
        // The protected ones solve R₁₁ c₁ = Q₁ᵀ p − R₁₂ c₂.
        let count = self.protected.len();
        let mut head = self.ordered.head(self.ordered.columns(), count);
        for (at, &j) in self.order.iter().enumerate().skip(count) {
            if c[j] != 0.0 {
                for (h, v) in head.iter_mut().zip(self.ordered.head(at, count)) {
                    *h -= c[j] * v;
                }
            }
        }
        self.ordered.back_substitute(&mut head);
        for (&j, &value) in self.protected.iter().zip(&head) {
            c[j] = value;
        }
        c
    }
}

/// The smallest λ for which only protected columns remain: max |x̂ⱼᵀ ŷ| / wⱼ after projection.
///
/// # Errors
/// As [`lasso_path`].
pub fn largest_lambda(triangle: &Triangle, weights: &[f64]) -> Result<f64, SparseError> {
    Ok(Normalised::new(triangle, weights)?.moment.iter().fold(0.0, |m, v| m.max(v.abs())))
}

/// The LASSO for every λ given, in that order; the descent runs from the largest to the smallest, each
/// started from its predecessor. `weights` has one entry per column; 0 protects the column.
///
/// # Errors
/// [`SparseError::Length`] or [`SparseError::Option`] for bad weights, λ or options, [`SparseError::Empty`]
/// without λ, [`SparseError::RankDeficient`] for dependent protected columns, [`SparseError::ZeroTarget`].
///
/// ```
/// use greybox_sparse::lasso::{LassoOptions, lasso_path};
/// use greybox_sparse::{Rows, Triangle};
/// // Orthogonal columns: every coefficient is the least-squares one, shrunk by λ (soft threshold).
/// let (a, b) = ([1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]);
/// let y = [3.0, 3.0, 4.0, -4.0];
/// let triangle = Triangle::of_rows(&Rows::new(&[&a, &b], &y)?, &[0..4])?;
/// let path = lasso_path(&triangle, &[1.0, 1.0], &[0.1], &LassoOptions::default())?;
/// let c = &path[0].fit.coefficients;
/// assert!((c[0] - 2.5).abs() < 1e-9 && (c[1] - 3.5).abs() < 1e-9);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn lasso_path(
    triangle: &Triangle,
    weights: &[f64],
    lambdas: &[f64],
    options: &LassoOptions,
) -> Result<Vec<LassoFit>, SparseError> {
    if lambdas.is_empty() {
        return Err(SparseError::Empty { what: "penalties λ" });
    }
    for &lambda in lambdas {
        check_range("lambda", lambda, 0.0, f64::MAX, "finite and not negative")?;
    }
    check_range("LASSO tolerance", options.tolerance, 0.0, 1.0, "between 0 and 1")?;
    let problem = Normalised::new(triangle, weights)?;
    let mut order: Vec<usize> = (0..lambdas.len()).collect();
    order.sort_by(|&a, &b| lambdas[b].total_cmp(&lambdas[a]));
    let mut state = Descent::new(&problem);
    let mut found: Vec<Option<LassoFit>> = vec![None; lambdas.len()];
    for at in order {
        let (gap, sweeps) = state.run(lambdas[at], options);
        let coefficients = problem.coefficients(&state.beta, triangle.columns());
        let rss = triangle.rss(&coefficients);
        found[at] = Some(LassoFit {
            lambda: lambdas[at],
            fit: Fit { coefficients, rss },
            gap,
            converged: gap <= options.tolerance,
            sweeps,
        });
    }
    Ok(found.into_iter().flatten().collect())
}

/// A column outside the active set enters when its gradient exceeds λ by more than this share: less is rounding.
const ENTERS: f64 = 1e-9;

/// The Cholesky factor of the active columns' Gram matrix, with what follows from it for every λ.
#[derive(Debug, Default)]
struct Active {
    /// Coordinates in the order they entered.
    columns: Vec<usize>,
    signs: Vec<f64>,
    /// L row by row, row i of i + 1 entries.
    factor: Vec<f64>,
    /// L⁻¹ of the moments and of the signs.
    moments: Vec<f64>,
    pulls: Vec<f64>,
}

impl Active {
    fn clear(&mut self) {
        self.truncate(0);
    }

    fn truncate(&mut self, count: usize) {
        self.columns.truncate(count);
        self.signs.truncate(count);
        self.factor.truncate(count * (count + 1) / 2);
        self.moments.truncate(count);
        self.pulls.truncate(count);
    }

    /// Row i of L.
    fn row(&self, i: usize) -> &[f64] {
        &self.factor[i * (i + 1) / 2..(i + 1) * (i + 2) / 2]
    }

    /// Takes a coordinate in; false, and no change, where it depends on those before.
    fn push(&mut self, problem: &Normalised, j: usize, sign: f64) -> bool {
        let (m, k) = (problem.moment.len(), self.columns.len());
        let start = self.factor.len();
        let column = &problem.gram[j * m..(j + 1) * m];
        let (mut left, mut moment, mut pull) = (column[j], problem.moment[j], sign);
        for i in 0..k {
            let (known, new) = self.factor.split_at(start);
            let row = &known[i * (i + 1) / 2..];
            let dot: f64 = row[..i].iter().zip(new).map(|(a, b)| a * b).sum();
            let value = (column[self.columns[i]] - dot) / row[i];
            left -= value * value;
            moment -= value * self.moments[i];
            pull -= value * self.pulls[i];
            self.factor.push(value);
        }
        if left.is_nan() || left <= RANK_TOLERANCE * column[j] {
            self.factor.truncate(start);
            return false;
        }
        let diagonal = left.sqrt();
        self.factor.push(diagonal);
        self.moments.push(moment / diagonal);
        self.pulls.push(pull / diagonal);
        self.columns.push(j);
        self.signs.push(sign);
        true
    }

    /// Takes the coordinates out for which `gone` says so; those behind the first are factorised again.
    fn retain(&mut self, problem: &Normalised, gone: impl Fn(usize) -> bool) -> bool {
        let Some(first) = self.columns.iter().position(|&j| gone(j)) else { return true };
        let rest: Vec<(usize, f64)> = self.columns[first..]
            .iter()
            .copied()
            .zip(self.signs[first..].iter().copied())
            .filter(|&(j, _)| !gone(j))
            .collect();
        self.truncate(first);
        rest.into_iter().all(|(j, sign)| self.push(problem, j, sign))
    }

    /// The minimiser with these signs: (Gₐₐ)⁻¹ (mₐ − λ sₐ).
    fn solve(&self, lambda: f64, x: &mut Vec<f64>) {
        x.clear();
        x.extend(self.moments.iter().zip(&self.pulls).map(|(m, p)| m - lambda * p));
        for i in (0..x.len()).rev() {
            let row = self.row(i);
            let value = x[i] / row[i];
            x[i] = value;
            for (x, &l) in x[..i].iter_mut().zip(row) {
                *x -= l * value;
            }
        }
    }
}

/// The state of a path, with the gradient x̂ⱼᵀ r kept up to date.
struct Descent<'a> {
    problem: &'a Normalised,
    beta: Vec<f64>,
    gradient: Vec<f64>,
    active: Active,
    /// The active set is that of `beta`.
    followed: bool,
    solution: Vec<f64>,
}

impl<'a> Descent<'a> {
    fn new(problem: &'a Normalised) -> Self {
        Self {
            problem,
            beta: vec![0.0; problem.moment.len()],
            gradient: problem.moment.clone(),
            active: Active::default(),
            followed: true,
            solution: Vec::new(),
        }
    }

    /// Minimises for one λ; returns the relative gap and the steps and sweeps.
    fn run(&mut self, lambda: f64, options: &LassoOptions) -> (f64, usize) {
        let steps = self.follow(lambda, options.max_sweeps);
        let gap = self.gap(lambda);
        if gap <= options.tolerance || steps >= options.max_sweeps {
            return (gap, steps);
        }
        let (before, start) = (gap, self.beta.clone());
        let (gap, sweeps) = self.descend(lambda, options, steps);
        if gap <= before {
            self.followed = false;
            return (gap, sweeps);
        }
        // At the minimum but for rounding.
        self.beta = start;
        self.refresh();
        (before, sweeps)
    }

    /// Steps from active set to active set; at the minimum in the end, unless columns depend on one another or the
    /// steps are used up. Every step lowers the objective.
    fn follow(&mut self, lambda: f64, most: usize) -> usize {
        let m = self.beta.len();
        if !self.followed {
            self.active.clear();
            for j in 0..m {
                let b = self.beta[j];
                if b != 0.0 && !self.active.push(self.problem, j, b.signum()) {
                    return 0;
                }
            }
            self.followed = true;
        }
        let mut steps = 0;
        while steps < most.min(8 * m + 32) {
            steps += 1;
            self.active.solve(lambda, &mut self.solution);
            // How far the signs stay as they are.
            let mut share = 1.0_f64;
            for ((&j, &sign), &x) in self.active.columns.iter().zip(&self.active.signs).zip(&self.solution) {
                if x * sign <= 0.0 {
                    let b = self.beta[j];
                    share = share.min(if b == 0.0 { 0.0 } else { b / (b - x) });
                }
            }
            if share < 1.0 {
                for ((&j, &sign), &x) in
                    self.active.columns.iter().zip(&self.active.signs).zip(&self.solution)
                {
                    let b = self.beta[j];
                    // Those that reach zero first are zero exactly.
                    let reaches = x * sign <= 0.0 && (b == 0.0 || b / (b - x) <= share);
                    self.beta[j] = if reaches { 0.0 } else { b + share * (x - b) };
                }
                let beta = &self.beta;
                self.followed = self.active.retain(self.problem, |j| beta[j] == 0.0);
                // A column that turns back at once is one that rounding let in.
                if share == 0.0 || !self.followed {
                    break;
                }
                continue;
            }
            for (&j, &x) in self.active.columns.iter().zip(&self.solution) {
                self.beta[j] = x;
            }
            self.refresh();
            let steepest = (0..m)
                .filter(|&j| self.beta[j] == 0.0)
                .max_by(|&a, &b| self.gradient[a].abs().total_cmp(&self.gradient[b].abs()));
            let Some(j) = steepest else { return steps };
            if self.gradient[j].abs() <= lambda * (1.0 + ENTERS) {
                return steps;
            }
            if !self.active.push(self.problem, j, self.gradient[j].signum()) {
                return steps;
            }
        }
        self.refresh();
        steps
    }

    /// Coordinate descent: sweeps the active coordinates to rest between full sweeps.
    fn descend(&mut self, lambda: f64, options: &LassoOptions, steps: usize) -> (f64, usize) {
        let m = self.beta.len();
        let mut sweeps = steps;
        loop {
            let change = self.sweep(lambda, 0..m);
            sweeps += 1;
            let gap = self.gap(lambda);
            if gap <= options.tolerance || sweeps >= options.max_sweeps || change == 0.0 {
                self.refresh();
                return (self.gap(lambda), sweeps);
            }
            let active: Vec<usize> = (0..m).filter(|&j| self.beta[j] != 0.0).collect();
            // The gap is quadratic in the step near the minimum: a tenth of the full sweep's is enough here.
            for _ in 0..50 {
                let inner = self.sweep(lambda, active.iter().copied());
                sweeps += 1;
                if inner <= 0.1 * change || sweeps >= options.max_sweeps {
                    break;
                }
            }
        }
    }

    /// One pass of exact coordinate minimisations; the largest change of √Gⱼⱼ βⱼ.
    fn sweep(&mut self, lambda: f64, which: impl Iterator<Item = usize>) -> f64 {
        let m = self.beta.len();
        let mut largest = 0.0_f64;
        for j in which {
            let column = &self.problem.gram[j * m..(j + 1) * m];
            let diagonal = column[j];
            let old = self.beta[j];
            let new = soft_threshold(self.gradient[j] + diagonal * old, lambda) / diagonal;
            let step = new - old;
            if step != 0.0 {
                self.beta[j] = new;
                for (g, &x) in self.gradient.iter_mut().zip(column) {
                    *g -= step * x;
                }
                largest = largest.max(step.abs() * diagonal.sqrt());
            }
        }
        largest
    }

    /// Recomputes the gradient from scratch: the updates leave rounding behind.
    fn refresh(&mut self) {
        let m = self.beta.len();
        self.gradient.clone_from(&self.problem.moment);
        for j in (0..m).filter(|&j| self.beta[j] != 0.0) {
            let b = self.beta[j];
            for (g, &x) in self.gradient.iter_mut().zip(&self.problem.gram[j * m..(j + 1) * m]) {
                *g -= b * x;
            }
        }
    }

    /// Duality gap ½‖r‖²(1 − s)² + λ‖β‖₁ − s βᵀX̂ᵀr at the dual point s r, relative to ½‖ŷ‖².
    fn gap(&self, lambda: f64) -> f64 {
        let p = self.problem;
        if p.target_square == 0.0 {
            return 0.0;
        }
        let steepest = self.gradient.iter().fold(0.0_f64, |m, g| m.max(g.abs()));
        let s = if steepest <= lambda { 1.0 } else { lambda / steepest };
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let along = dot(&self.beta, &self.gradient);
        let residual = (p.target_square - dot(&self.beta, &p.moment) - along).max(0.0);
        let size: f64 = self.beta.iter().map(|b| b.abs()).sum();
        let gap = 0.5 * residual * (1.0 - s) * (1.0 - s) + (lambda * size - s * along);
        2.0 * gap.max(0.0) / p.target_square
    }
}

/// sign(x) max(|x| − λ, 0).
#[must_use]
pub fn soft_threshold(x: f64, lambda: f64) -> f64 {
    if x > lambda {
        x - lambda
    } else if x < -lambda {
        x + lambda
    } else {
        0.0
    }
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::rows::Rows;
    use crate::testing::{design, normal};

    fn triangle(columns: &[Vec<f64>], y: &[f64]) -> Triangle {
        Triangle::of_rows(&Rows::from_vecs(columns, y).unwrap(), &[0..y.len()]).unwrap()
    }

    fn size(v: &[f64]) -> f64 {
        v.iter().map(|v| v * v).sum::<f64>().sqrt()
    }

    /// Columns with strong correlation and scales over six decades.
    fn hard() -> (Vec<Vec<f64>>, Vec<f64>) {
        let (mut columns, y) = design(150, 8, 31);
        let common = normal(150, 4);
        for (j, c) in columns.iter_mut().enumerate() {
            let scale = 10f64.powi(j as i32 - 4);
            for (v, u) in c.iter_mut().zip(&common) {
                *v = scale * (*v + 2.0 * u);
            }
        }
        (columns, y)
    }

    #[test]
    fn kkt_conditions_hold_along_the_path() {
        let (columns, y) = hard();
        let t = triangle(&columns, &y);
        let weights = [1.0, 0.5, 0.0, 2.0, 1.0, 1.0, 0.0, 1.0];
        let top = largest_lambda(&t, &weights).unwrap();
        let grid: Vec<f64> = (0..12).map(|i| top * 0.5f64.powi(i)).collect();
        let options = LassoOptions { tolerance: 1e-13, ..Default::default() };
        let path = lasso_path(&t, &weights, &grid, &options).unwrap();
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        for fit in &path {
            assert!(fit.converged, "{fit:?}");
            let r = rows.residuals(&fit.fit.coefficients, &[0..150]);
            assert!((fit.fit.rss - r.iter().map(|r| r * r).sum::<f64>()).abs() < 1e-10 * fit.fit.rss);
            for (j, column) in columns.iter().enumerate() {
                let pull: f64 =
                    column.iter().zip(&r).map(|(x, r)| x * r).sum::<f64>() / size(column) / size(&y);
                let bound = fit.lambda * weights[j];
                let c = fit.fit.coefficients[j];
                if c == 0.0 {
                    assert!(pull.abs() <= bound + 1e-6, "column {j}: {pull} > {bound}");
                } else {
                    assert!((pull - bound * c.signum()).abs() < 1e-6, "column {j}: {pull} vs {bound}");
                }
            }
        }
        let optional = |f: &LassoFit| f.fit.support().iter().filter(|&&j| weights[j] > 0.0).count();
        assert_eq!(optional(&path[0]), 0);
        assert!(optional(&path[1]) > 0);
    }

    /// Proximal gradient (ISTA) on the rows: slow, and shares no code with the descent.
    fn reference(columns: &[Vec<f64>], y: &[f64], lambda: f64) -> Vec<f64> {
        let target = size(y);
        let unit: Vec<Vec<f64>> = columns.iter().map(|c| c.iter().map(|v| v / size(c)).collect()).collect();
        let step = 1.0 / unit.len() as f64;
        let mut beta = vec![0.0; unit.len()];
        for _ in 0..60_000 {
            let mut r: Vec<f64> = y.iter().map(|v| v / target).collect();
            for (c, b) in unit.iter().zip(&beta) {
                r.iter_mut().zip(c).for_each(|(r, v)| *r -= b * v);
            }
            for (b, c) in beta.iter_mut().zip(&unit) {
                let g: f64 = c.iter().zip(&r).map(|(c, r)| c * r).sum();
                *b = soft_threshold(*b + step * g, lambda * step);
            }
        }
        beta.iter().zip(columns).map(|(b, c)| b * target / size(c)).collect()
    }

    #[test]
    fn equals_proximal_gradient_on_the_rows() {
        let (columns, y) = hard();
        let t = triangle(&columns, &y);
        let grid = [0.01, 0.1, 0.03];
        let options = LassoOptions { tolerance: 1e-14, ..Default::default() };
        let path = lasso_path(&t, &[1.0; 8], &grid, &options).unwrap();
        for fit in path {
            let truth = reference(&columns, &y, fit.lambda);
            for j in 0..8 {
                let scale = size(&columns[j]) / size(&y);
                assert!((fit.fit.coefficients[j] - truth[j]).abs() * scale < 1e-6);
            }
        }
    }

    #[test]
    fn orthogonal_design_is_the_soft_threshold() {
        let n = 64;
        let columns: Vec<Vec<f64>> = (1..6)
            .map(|h| (0..n).map(|i| (std::f64::consts::TAU * (h * i) as f64 / n as f64).sin()).collect())
            .collect();
        let y: Vec<f64> = normal(n, 12);
        let t = triangle(&columns, &y);
        let free = t.solve().unwrap();
        for lambda in [0.0, 0.05, 0.2] {
            let fit = &lasso_path(&t, &[1.0; 5], &[lambda], &LassoOptions::default()).unwrap()[0].fit;
            for j in 0..5 {
                let unit = size(&y) / size(&columns[j]);
                let truth = soft_threshold(free.coefficients[j], lambda * unit);
                assert!((fit.coefficients[j] - truth).abs() < 1e-10);
            }
        }
    }

    #[test]
    fn the_gap_is_primal_minus_dual() {
        // After one sweep, far from the minimum, where every term of the gap counts.
        let (columns, y) = hard();
        let t = triangle(&columns, &y);
        let options = LassoOptions { tolerance: 0.0, max_sweeps: 1 };
        let lambda = 0.05;
        let found = &lasso_path(&t, &[1.0; 8], &[lambda], &options).unwrap()[0];
        assert!(!found.converged);
        let target = size(&y);
        let r: Vec<f64> = Rows::from_vecs(&columns, &y)
            .unwrap()
            .residuals(&found.fit.coefficients, &[0..150])
            .iter()
            .map(|r| r / target)
            .collect();
        let pull = |c: &[f64]| c.iter().zip(&r).map(|(c, r)| c * r).sum::<f64>() / size(c);
        let steepest = columns.iter().fold(0.0_f64, |m, c| m.max(pull(c).abs()));
        let s = (lambda / steepest).min(1.0);
        let penalty: f64 =
            columns.iter().zip(&found.fit.coefficients).map(|(c, b)| (b * size(c) / target).abs()).sum();
        let primal = 0.5 * size(&r).powi(2) + lambda * penalty;
        let far: Vec<f64> = y.iter().zip(&r).map(|(y, r)| y / target - s * r).collect();
        let dual = 0.5 - 0.5 * size(&far).powi(2);
        assert!(
            (found.gap - 2.0 * (primal - dual)).abs() < 1e-10,
            "{} vs {}",
            found.gap,
            2.0 * (primal - dual)
        );
        assert!(s < 0.9);
    }

    #[test]
    fn zero_and_duplicate_columns_do_no_harm() {
        let (mut columns, y) = design(80, 3, 3);
        columns.push(vec![0.0; 80]);
        columns.push(columns[0].clone());
        let t = triangle(&columns, &y);
        let path = lasso_path(&t, &[0.0, 1.0, 1.0, 1.0, 1.0], &[0.02], &LassoOptions::default()).unwrap();
        assert_eq!(path[0].fit.coefficients[3], 0.0);
        assert_eq!(path[0].fit.coefficients[4], 0.0);
        assert!(path[0].converged);
        let both = lasso_path(&t, &[0.0, 1.0, 1.0, 1.0, 0.0], &[0.02], &LassoOptions::default());
        assert!(matches!(both, Err(SparseError::RankDeficient { column: 4, .. })));
    }

    #[test]
    fn bad_input_is_an_error() {
        let (columns, y) = design(20, 2, 3);
        let t = triangle(&columns, &y);
        let options = LassoOptions::default();
        assert!(matches!(lasso_path(&t, &[1.0], &[0.1], &options), Err(SparseError::Length { .. })));
        assert!(matches!(lasso_path(&t, &[1.0, -1.0], &[0.1], &options), Err(SparseError::Option { .. })));
        assert!(matches!(lasso_path(&t, &[1.0, 1.0], &[], &options), Err(SparseError::Empty { .. })));
        assert!(lasso_path(&t, &[1.0, 1.0], &[f64::NAN], &options).is_err());
    }
}
