//! The LASSO on normalised columns, from the Gram matrix (Friedman, Hastie, Tibshirani 2010,
//! doi:10.18637/jss.v033.i01; sign-fixed steps after Lee et al., NIPS 2006).

use crate::SparseError;
use crate::gram::{Normalised, Sample};
use crate::least_squares::{cholesky, cholesky_back};
use crate::stlsq::{check_grid, live_columns};

/// Relative duality gap at which an iterate is accepted.
const GAP: f64 = 1e-12;
/// The gap that must at least be reached when the sweeps are used up.
const GAP_FAIL: f64 = 1e-7;
/// Sweeps of coordinate descent between two exact steps.
const SWEEPS_PER_STEP: usize = 5;
/// Exact steps tried before giving up.
const STEPS: usize = 2000;

/// For every λ of the grid the minimiser of
///
/// ```text
/// ½ ‖p̂ − Σ βⱼ âⱼ‖² + λ Σ wⱼ |βⱼ| ,    âⱼ = aⱼ/‖aⱼ‖ , p̂ = p/‖p‖ , cⱼ = βⱼ ‖p‖/‖aⱼ‖ ,
/// ```
///
/// (thesis Eq 2.14 on columns and target of unit length, so λ in 0..1 is free of units: no column is active
/// beyond λ = maxⱼ |âⱼᵀp̂|/wⱼ ≤ 1/min wⱼ). `weights` has one wⱼ ≥ 0 per column or is empty (all 1); a column with
/// wⱼ = 0 is protected: it is eliminated exactly, so it always stays. The path is run from the largest λ
/// down with warm starts and returned in the order of the grid: one coefficient cⱼ per column.
///
/// # Errors
/// [`SparseError::RankDeficient`] when the protected columns are dependent, [`SparseError::NotConverged`],
/// [`SparseError::Length`] and [`SparseError::Option`] for weights and grid.
pub fn lasso(
    sample: &Sample<'_>,
    columns: usize,
    grid: &[f64],
    weights: &[f64],
) -> Result<Vec<Vec<f64>>, SparseError> {
    check_grid(grid)?;
    sample.check_size(columns)?;
    if !weights.is_empty() && weights.len() != columns {
        return Err(SparseError::Length {
            what: "the list of weights".into(),
            found: weights.len(),
            expected: columns,
        });
    }
    if let Some(&value) = weights.iter().find(|w| !(w.is_finite() && **w >= 0.0)) {
        return Err(SparseError::Option { name: "weight", value, expected: "a finite number >= 0" });
    }
    let weight = |j: usize| weights.get(j).copied().unwrap_or(1.0);
    let protected: Vec<usize> = (0..columns).filter(|&j| weight(j) == 0.0).collect();
    let normalised = sample.normalised(columns);
    let live = live_columns(&normalised, &protected)?;
    let free: Vec<usize> = live.iter().copied().filter(|j| weight(*j) > 0.0).collect();
    let problem = Projected::new(&normalised, &protected, free, weight)?;

    let mut order: Vec<usize> = (0..grid.len()).collect();
    order.sort_by(|&a, &b| grid[b].total_cmp(&grid[a]));
    let mut path = vec![Vec::new(); grid.len()];
    let mut beta = vec![0.0; problem.free.len()];
    for i in order {
        problem.minimise(grid[i], &mut beta)?;
        path[i] = problem.coefficients(&beta, &normalised);
    }
    Ok(path)
}

/// The problem left when the protected columns are eliminated: Schur complement of ρ and of r.
struct Projected {
    free: Vec<usize>,
    protected: Vec<usize>,
    weight: Vec<f64>,
    /// Column-major, one column per free column.
    q: Vec<f64>,
    r: Vec<f64>,
    /// ‖p̂‖² less the part explained by the protected columns.
    energy: f64,
    /// Cholesky factor of the protected part.
    factor: Vec<f64>,
}

impl Projected {
    fn new(
        normalised: &Normalised,
        protected: &[usize],
        free: Vec<usize>,
        weight: impl Fn(usize) -> f64,
    ) -> Result<Self, SparseError> {
        let k = normalised.columns;
        let factor =
            cholesky(&normalised.correlation, k, protected).ok_or_else(|| SparseError::RankDeficient {
                column: protected.last().copied().unwrap_or(0),
                others: protected.to_vec(),
            })?;
        let eliminated = |source: &dyn Fn(usize) -> f64| -> Vec<f64> {
            let mut x: Vec<f64> = protected.iter().map(|&i| source(i)).collect();
            cholesky_back(&factor, &mut x);
            x
        };
        let target = eliminated(&|i| normalised.cross[i]);
        let dot = |x: &[f64], j: usize| -> f64 {
            protected.iter().zip(x).map(|(&i, x)| x * normalised.correlation[j * k + i]).sum()
        };
        let mut q = Vec::with_capacity(free.len() * free.len());
        for &j in &free {
            let x = eliminated(&|i| normalised.correlation[j * k + i]);
            q.extend(free.iter().map(|&i| normalised.correlation[j * k + i] - dot(&x, i)));
        }
        let r = free.iter().map(|&j| normalised.cross[j] - dot(&target, j)).collect();
        let explained: f64 = protected.iter().zip(&target).map(|(&i, x)| x * normalised.cross[i]).sum();
        let weight = free.iter().map(|&j| weight(j)).collect();
        Ok(Self {
            free,
            protected: protected.to_vec(),
            weight,
            q,
            r,
            energy: (1.0 - explained).max(0.0),
            factor,
        })
    }

    fn column(&self, j: usize) -> &[f64] {
        let m = self.free.len();
        &self.q[j * m..(j + 1) * m]
    }

    /// r − Qβ.
    fn gradient(&self, beta: &[f64]) -> Vec<f64> {
        let mut g = self.r.clone();
        for (j, b) in beta.iter().enumerate().filter(|(_, b)| **b != 0.0) {
            g.iter_mut().zip(self.column(j)).for_each(|(g, q)| *g -= q * b);
        }
        g
    }

    /// Coordinate descent with exact steps for fixed signs until the duality gap closes.
    fn minimise(&self, lambda: f64, beta: &mut [f64]) -> Result<(), SparseError> {
        let mut last = f64::INFINITY;
        for step in 0..STEPS {
            let mut g = self.gradient(beta);
            last = self.gap(lambda, beta, &g);
            if last <= GAP {
                return Ok(());
            }
            for sweep in 0..SWEEPS_PER_STEP {
                // The first sweep visits every column, the following ones the active set.
                for j in 0..beta.len() {
                    if sweep == 0 || beta[j] != 0.0 {
                        self.update(j, lambda, beta, &mut g);
                    }
                }
            }
            self.sign_step(lambda, beta);
            if step + 1 == STEPS {
                last = self.gap(lambda, beta, &self.gradient(beta));
            }
        }
        if last <= GAP_FAIL {
            return Ok(());
        }
        Err(SparseError::NotConverged { lambda, gap: last, sweeps: STEPS * SWEEPS_PER_STEP })
    }

    /// βⱼ ← S(gⱼ + qⱼⱼ βⱼ, λ wⱼ)/qⱼⱼ and the gradient with it.
    fn update(&self, j: usize, lambda: f64, beta: &mut [f64], g: &mut [f64]) {
        let column = self.column(j);
        let diagonal = column[j];
        if diagonal <= 1e-14 {
            return;
        }
        let new = soft_threshold(g[j] + diagonal * beta[j], lambda * self.weight[j]) / diagonal;
        let change = new - beta[j];
        if change != 0.0 {
            beta[j] = new;
            g.iter_mut().zip(column).for_each(|(g, q)| *g -= q * change);
        }
    }

    /// Go to the minimiser for the present active set and signs, or to the first sign change on the way there
    /// (the objective is a convex quadratic along that segment, so it never rises).
    fn sign_step(&self, lambda: f64, beta: &mut [f64]) {
        let m = self.free.len();
        loop {
            let active: Vec<usize> = (0..m).filter(|&j| beta[j] != 0.0).collect();
            let Some(l) = cholesky(&self.q, m, &active) else { return };
            let mut goal: Vec<f64> =
                active.iter().map(|&j| self.r[j] - lambda * self.weight[j] * beta[j].signum()).collect();
            cholesky_back(&l, &mut goal);
            let mut step = 1.0;
            let mut stopped = None;
            for (&j, &to) in active.iter().zip(&goal) {
                if to * beta[j] < 0.0 || to == 0.0 {
                    let share = beta[j] / (beta[j] - to);
                    if share < step {
                        (step, stopped) = (share, Some(j));
                    }
                }
            }
            for (&j, &to) in active.iter().zip(&goal) {
                beta[j] += step * (to - beta[j]);
            }
            match stopped {
                Some(j) => beta[j] = 0.0,
                None => return,
            }
        }
    }

    /// Duality gap: primal value less the dual value of the residual scaled into the feasible set.
    fn gap(&self, lambda: f64, beta: &[f64], g: &[f64]) -> f64 {
        let linear: f64 = beta.iter().zip(&self.r).map(|(b, r)| b * r).sum();
        let inner: f64 = beta.iter().zip(g).map(|(b, g)| b * g).sum();
        // ‖p − Aβ‖² = pᵀp − βᵀr − βᵀg and pᵀ(p − Aβ) = pᵀp − βᵀr.
        let rss = (self.energy - linear - inner).max(0.0);
        let along = self.energy - linear;
        let penalty: f64 = beta.iter().zip(&self.weight).map(|(b, w)| w * b.abs()).sum::<f64>() * lambda;
        let worst = g.iter().zip(&self.weight).map(|(g, w)| g.abs() / w).fold(0.0, f64::max);
        let shrink = if worst > lambda { lambda / worst } else { 1.0 };
        0.5 * rss + penalty - shrink * along + 0.5 * shrink * shrink * rss
    }

    /// All coefficients in own units, the protected ones by back substitution.
    fn coefficients(&self, beta: &[f64], normalised: &Normalised) -> Vec<f64> {
        let k = normalised.columns;
        let mut full = vec![0.0; k];
        let mut rest: Vec<f64> = self.protected.iter().map(|&i| normalised.cross[i]).collect();
        for (&j, &b) in self.free.iter().zip(beta) {
            full[j] = b * normalised.unit[j];
            for (rest, &i) in rest.iter_mut().zip(&self.protected) {
                *rest -= b * normalised.correlation[j * k + i];
            }
        }
        cholesky_back(&self.factor, &mut rest);
        for (&j, b) in self.protected.iter().zip(rest) {
            full[j] = b * normalised.unit[j];
        }
        full
    }
}

/// S(z, γ) = sign(z) max(|z| − γ, 0).
///
/// ```
/// assert_eq!(greybox_sparse::soft_threshold(-3.0, 1.0), -2.0);
/// assert_eq!(greybox_sparse::soft_threshold(0.5, 1.0), 0.0);
/// ```
#[must_use]
pub fn soft_threshold(z: f64, gamma: f64) -> f64 {
    if z.abs() > gamma { z - gamma * z.signum() } else { 0.0 }
}

/// Least squares on the support of every point of a path ("refit after LASSO").
///
/// # Errors
/// As [`Sample::solve`].
pub fn refit(sample: &Sample<'_>, path: &[Vec<f64>]) -> Result<Vec<Vec<f64>>, SparseError> {
    let columns = path.iter().map(Vec::len).max().unwrap_or(0);
    if columns > 0 {
        sample.check_size(columns)?;
    }
    let normalised = sample.normalised(columns);
    path.iter()
        .map(|c| {
            let active = support(c);
            let mut full = vec![0.0; columns];
            for (&j, c) in active.iter().zip(sample.solve(&active, &normalised)?) {
                full[j] = c;
            }
            Ok(full)
        })
        .collect()
}

/// The columns whose coefficient is not zero.
#[must_use]
pub fn support(coefficients: &[f64]) -> Vec<usize> {
    (0..coefficients.len()).filter(|&j| coefficients[j] != 0.0).collect()
}
