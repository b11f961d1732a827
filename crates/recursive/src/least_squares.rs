//! Recursive least squares by an orthogonal factor of the information, which forgets towards what is known.

use alloc::vec;
use alloc::vec::Vec;

use crate::error::RecursiveError;
use crate::triangle::{absorb, solve};

/// Recursive least squares of yₖ = φₖᵀ θ + eₖ, eₖ ~ N(0, 1), with exponential forgetting towards a prior.
///
/// The information and its right-hand side are kept as one upper triangular factor [R | z] with θ̂ = R⁻¹ z, into which
/// every row is rotated: the condition of the regression is never squared (Golub & Van Loan, *Matrix Computations*, §6.5.3;
/// Bierman, *Factorization Methods for Discrete Sequential Estimation*, 1977, ch. V).
///
/// ```text
/// forget(λ):        RᵀR ← λ RᵀR + (1 − λ) R₀ᵀR₀         likewise Rᵀz
/// update(φ, y):     RᵀR ← RᵀR + φ φᵀ                     Rᵀz ← Rᵀz + φ y
/// ```
///
/// R₀, z₀ are the prior's. Where nothing excites a parameter, its estimate goes back to the prior within 1/(1 − λ) samples
/// and its variance no further than there, so that the estimator does not wind up (stabilised forgetting: Kulhavý & Zarrop,
/// *On a general concept of forgetting*, Int. J. Control 58, 1993).
///
/// Every row is divided by the standard deviation of its error beforehand. [`covariance`](Self::covariance) is that of a
/// parameter that may move: while a constant one is tracked with λ < 1, it is up to twice the variance of the estimate.
///
/// ```
/// use greybox_recursive::LeastSquares;
/// let mut fit = LeastSquares::new(&[0.0, 0.0], &[10.0, 10.0])?;
/// for k in 0..2000 {
///     let slope = if k < 1000 { 2.0 } else { 3.0 };      // changes on the way
///     let (x, noise) = ((0.1 * f64::from(k)).sin(), 0.05 * (f64::from(k * k % 17) / 8.0 - 1.0));
///     fit.forget(0.98);
///     fit.update(&[x / 0.03, 1.0 / 0.03], (slope * x + 0.5 + noise) / 0.03);
/// }
/// let estimate = fit.estimate();
/// assert!((estimate[0] - 3.0).abs() < 0.02 && (estimate[1] - 0.5).abs() < 0.02, "{estimate:?}");
/// # Ok::<(), greybox_recursive::RecursiveError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LeastSquares {
    n: usize,
    /// [R | z], row by row.
    factor: Vec<f64>,
    /// Diagonal of R₀, and z₀.
    prior: Vec<(f64, f64)>,
    row: Vec<f64>,
}

impl LeastSquares {
    /// An estimator of parameters with the prior N(mean, std²) each.
    ///
    /// # Errors
    /// [`RecursiveError`] where the two differ in length, a mean is not finite or a standard deviation not positive.
    pub fn new(mean: &[f64], std: &[f64]) -> Result<LeastSquares, RecursiveError> {
        let n = mean.len();
        if std.len() != n {
            return Err(RecursiveError::Length {
                what: "the standard deviations",
                found: std.len(),
                expected: n,
            });
        }
        let mut fit = LeastSquares {
            n,
            factor: vec![0.0; n * (n + 1)],
            prior: Vec::with_capacity(n),
            row: vec![0.0; n + 1],
        };
        for (index, (mean, std)) in mean.iter().zip(std).enumerate() {
            if !mean.is_finite() {
                return Err(RecursiveError::NotFinite { what: "the prior's mean", index });
            }
            if !(std.is_finite() && *std > 0.0 && (1.0 / std).is_finite() && (mean / std).is_finite()) {
                return Err(RecursiveError::Deviation { index, value: *std });
            }
            fit.prior.push((1.0 / std, mean / std));
        }
        fit.restart();
        Ok(fit)
    }

    /// Number of parameters.
    pub fn len(&self) -> usize {
        self.n
    }

    /// Whether the sizes of all parts agree: an estimator that was restored from data may be anything.
    pub fn is_consistent(&self) -> bool {
        let width = self.n.checked_add(1);
        let size = width.and_then(|w| w.checked_mul(self.n));
        size == Some(self.factor.len()) && self.prior.len() == self.n && width == Some(self.row.len())
    }

    /// Whether there is nothing to estimate.
    pub fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// Back to the prior.
    pub fn restart(&mut self) {
        self.factor.fill(0.0);
        for (k, (r, z)) in self.prior.iter().enumerate() {
            self.factor[k * (self.n + 1) + k] = *r;
            self.factor[k * (self.n + 1) + self.n] = *z;
        }
    }

    /// Gives what is known the weight `factor` (0 to 1), and the rest of the weight to the prior.
    pub fn forget(&mut self, factor: f64) {
        let factor = factor.clamp(0.0, 1.0);
        let (kept, rest) = (libm::sqrt(factor), libm::sqrt(1.0 - factor));
        if rest == 0.0 {
            return;
        }
        self.factor.iter_mut().for_each(|v| *v *= kept);
        for k in 0..self.n {
            self.row.fill(0.0);
            self.row[k] = rest * self.prior[k].0;
            self.row[self.n] = rest * self.prior[k].1;
            absorb(&mut self.factor, self.n, &mut self.row);
        }
    }

    /// Learns from `target` = `row`·θ + e with e ~ N(0, 1). A row of another length, or one with a value that is not finite,
    /// is no information and changes nothing: `false`.
    pub fn update(&mut self, row: &[f64], target: f64) -> bool {
        if row.len() != self.n || !target.is_finite() || !row.iter().all(|v| v.is_finite()) {
            return false;
        }
        self.row[..self.n].copy_from_slice(row);
        self.row[self.n] = target;
        absorb(&mut self.factor, self.n, &mut self.row);
        true
    }

    /// Learns what another estimator of the same parameters knows, its prior included, of those that are `shared`; the others
    /// are other parameters there, about which it may know anything. With the other's triangular factor R and right side z, the
    /// shared parameters ordered last, its last rows are of them alone, and they are taken as rows here:
    ///
    /// ```text
    /// ‖R x − z‖² = ‖R₁₁ x₁ + R₁₂ x₂ − z₁‖² + ‖R₂₂ x₂ − z₂‖² ,   x₂ shared
    /// ```
    ///
    /// (G. J. Bierman, *Factorization Methods for Discrete Sequential Estimation*, 1977, ch. VI). Nothing is learned from an
    /// estimator of another number of parameters.
    pub fn merge(&mut self, other: &LeastSquares, shared: impl Fn(usize) -> bool) {
        if other.n != self.n {
            return;
        }
        // Ordered so that the factor's last rows are without the others.
        let order: Vec<usize> =
            (0..self.n).filter(|k| !shared(*k)).chain((0..self.n).filter(|k| shared(*k))).collect();
        let own = order.iter().filter(|k| !shared(**k)).count();
        let width = self.n + 1;
        let mut factor = vec![0.0; self.n * width];
        for row in other.factor.chunks_exact(width) {
            order.iter().enumerate().for_each(|(to, from)| self.row[to] = row[*from]);
            self.row[self.n] = row[self.n];
            absorb(&mut factor, self.n, &mut self.row);
        }
        for row in factor.chunks_exact(width).skip(own) {
            order.iter().enumerate().for_each(|(from, to)| self.row[*to] = row[from]);
            self.row[self.n] = row[self.n];
            absorb(&mut self.factor, self.n, &mut self.row);
        }
    }

    /// Square of the distance of a point x from the estimate x̂ in its covariance P,
    ///
    /// ```text
    /// (x − x̂)ᵀ P⁻¹ (x − x̂) = ‖R x − z‖² :
    /// ```
    ///
    /// of the true parameters, χ² with as many degrees of freedom as there are of them. Infinite where the lengths differ.
    pub fn distance(&self, from: &[f64]) -> f64 {
        if from.len() != self.n {
            return f64::INFINITY;
        }
        let width = self.n + 1;
        let left = |k: usize| -> f64 {
            let row = &self.factor[k * width..(k + 1) * width];
            row[self.n] - row[k..self.n].iter().zip(&from[k..]).map(|(r, x)| r * x).sum::<f64>()
        };
        (0..self.n).map(|k| left(k) * left(k)).sum()
    }

    /// The estimate θ̂.
    pub fn estimate(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.n];
        self.estimate_into(&mut out);
        out
    }

    /// The estimate into `out`, without allocation; entries beyond the parameters stay.
    pub fn estimate_into(&self, out: &mut [f64]) {
        let n = self.n.min(out.len());
        if n == self.n {
            let width = self.n + 1;
            solve(&self.factor, width, |k| self.factor[k * width + self.n], &mut out[..n]);
        }
    }

    /// The covariance R⁻¹R⁻ᵀ, row by row.
    pub fn covariance(&self) -> Vec<f64> {
        let n = self.n;
        // Columns of R⁻¹.
        let mut inverse = vec![0.0; n * n];
        for (j, column) in inverse.chunks_exact_mut(n.max(1)).enumerate() {
            solve(&self.factor, n + 1, |k| f64::from(u8::from(k == j)), column);
        }
        let mut out = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                out[a * n + b] = (0..n).map(|j| inverse[j * n + a] * inverse[j * n + b]).sum();
            }
        }
        out
    }

    /// Standard deviation of each parameter.
    pub fn deviations(&self) -> Vec<f64> {
        let covariance = self.covariance();
        (0..self.n).map(|k| libm::sqrt(covariance[k * self.n + k])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    fn rows(n: usize, seed: u64) -> Vec<([f64; 3], f64)> {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        (0..n)
            .map(|_| {
                let row = [normal(), 2.0 * normal(), normal()];
                (row, 1.5 * row[0] - 0.7 * row[1] + 0.2 * row[2] + normal())
            })
            .collect()
    }

    /// Information and right-hand side with every weight written out.
    #[test]
    fn forgetting_is_the_weighted_sum() {
        let (mean, std, factor) = ([1.0, 0.0, -1.0], [2.0, 3.0, 0.5], 0.9f64);
        let mut fit = LeastSquares::new(&mean, &std).unwrap();
        let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
        for k in 0..3 {
            a[k][k] = std[k].powi(-2);
            b[k] = mean[k] * std[k].powi(-2);
        }
        for (row, y) in rows(40, 1) {
            fit.forget(factor);
            assert!(fit.update(&row, y));
            for i in 0..3 {
                for j in 0..3 {
                    let prior = if i == j { std[i].powi(-2) } else { 0.0 };
                    a[i][j] = factor * a[i][j] + (1.0 - factor) * prior + row[i] * row[j];
                }
                b[i] = factor * b[i] + (1.0 - factor) * mean[i] * std[i].powi(-2) + row[i] * y;
            }
        }
        let (x, c) = (fit.estimate(), fit.covariance());
        for i in 0..3 {
            let left: f64 = (0..3).map(|j| a[i][j] * x[j]).sum();
            assert!((left - b[i]).abs() < 1e-12 * b[i].abs().max(1.0), "{left} {}", b[i]);
            for j in 0..3 {
                let unit: f64 = (0..3).map(|k| a[i][k] * c[k * 3 + j]).sum();
                assert!((unit - f64::from(u8::from(i == j))).abs() < 1e-12);
            }
        }
    }

    /// Of 400 estimates of constants, without forgetting, as many lie within their 95 % intervals as should.
    #[test]
    fn intervals_hold_what_they_say() {
        let truth = [1.5, -0.7, 0.2];
        let mut within = 0;
        for seed in 0..400 {
            let mut fit = LeastSquares::new(&[0.0; 3], &[100.0; 3]).unwrap();
            rows(60, 100 + seed).iter().for_each(|(row, y)| assert!(fit.update(row, *y)));
            let (x, std) = (fit.estimate(), fit.deviations());
            within += (0..3).filter(|i| (x[*i] - truth[*i]).abs() < 1.96 * std[*i]).count();
        }
        // 1200 of them: 0.95 ± 3 · 0.0063.
        assert!((1117..=1163).contains(&within), "{within} of 1200");
    }

    /// Two stretches of which the first two parameters are the same, and the third is not: as one regression of four.
    #[test]
    fn what_is_shared_is_learned_from_another() {
        let [mut first, mut second] = [(); 2].map(|()| LeastSquares::new(&[0.0; 3], &[10.0; 3]).unwrap());
        let mut all =
            LeastSquares::new(&[0.0; 4], &[10.0 / 2f64.sqrt(), 10.0 / 2f64.sqrt(), 10.0, 10.0]).unwrap();
        for (row, y) in rows(30, 3) {
            first.update(&row, y + 3.0 * row[2]);
            all.update(&[row[0], row[1], row[2], 0.0], y + 3.0 * row[2]);
        }
        for (row, y) in rows(20, 4) {
            second.update(&row, y);
            all.update(&[row[0], row[1], 0.0, row[2]], y);
        }
        second.merge(&first, |k| k < 2);
        let (x, together) = (second.estimate(), all.estimate());
        for (k, l) in [(0, 0), (1, 1), (2, 3)] {
            assert!((x[k] - together[l]).abs() < 1e-12, "{x:?} {together:?}");
            assert!((second.deviations()[k] - all.deviations()[l]).abs() < 1e-12);
        }
        assert!(second.distance(&x) < 1e-20 && second.distance(&[0.0]).is_infinite());
        let (moved, covariance) = ([x[0] + 0.3, x[1], x[2]], second.covariance());
        // Along the first parameter alone: the step over its standard deviation where the others are known.
        let others = covariance[4] * covariance[8] - covariance[5] * covariance[7];
        let det = covariance[0] * others
            - covariance[1] * (covariance[3] * covariance[8] - covariance[5] * covariance[6])
            + covariance[2] * (covariance[3] * covariance[7] - covariance[4] * covariance[6]);
        assert!((second.distance(&moved) - 0.09 * others / det).abs() < 1e-9);
        let before = second.clone();
        second.merge(&all, |_| true);
        assert_eq!(second.estimate(), before.estimate());
    }

    /// Without excitation the covariance stays the prior's and the estimate goes back to it: no wind-up.
    #[test]
    fn what_is_not_excited_goes_back_to_the_prior() {
        let mut fit = LeastSquares::new(&[1.0, 4.0], &[0.5, 0.5]).unwrap();
        for _ in 0..500 {
            fit.forget(0.95);
            fit.update(&[10.0, 0.0], 20.0);
        }
        fit.update(&[0.0, 100.0], 900.0);
        assert!((fit.estimate()[1] - 9.0).abs() < 0.01);
        for _ in 0..5000 {
            fit.forget(0.95);
            fit.update(&[10.0, 0.0], 20.0);
        }
        let (x, std) = (fit.estimate(), fit.deviations());
        assert!((x[0] - 2.0).abs() < 0.01 && (x[1] - 4.0).abs() < 1e-6, "{x:?}");
        assert!((std[1] - 0.5).abs() < 1e-9, "{std:?}");
    }

    /// A Hilbert-like regression, whose normal equations have lost every digit.
    #[test]
    fn the_condition_is_not_squared() {
        let n = 8;
        let mut fit = LeastSquares::new(&vec![0.0; n], &vec![1e8; n]).unwrap();
        for k in 0..60 {
            let x = f64::from(k) / 59.0;
            let row: Vec<f64> = (0..n).map(|j| 1e6 * x.powi(j as i32)).collect();
            let y = row.iter().sum();
            fit.update(&row, y);
        }
        let worst = fit.estimate().iter().fold(0.0f64, |m, v| m.max((v - 1.0).abs()));
        assert!(worst < 1e-7, "{worst}");
    }

    #[test]
    fn bad_arguments_are_refused_and_bad_rows_change_nothing() {
        assert!(matches!(LeastSquares::new(&[0.0], &[]), Err(RecursiveError::Length { .. })));
        assert!(matches!(LeastSquares::new(&[f64::NAN], &[1.0]), Err(RecursiveError::NotFinite { .. })));
        assert!(matches!(LeastSquares::new(&[0.0], &[0.0]), Err(RecursiveError::Deviation { .. })));
        let mut fit = LeastSquares::new(&[1.0], &[1.0]).unwrap();
        let before = fit.clone();
        assert!(!fit.update(&[f64::NAN], 1.0) && !fit.update(&[1.0], f64::INFINITY) && !fit.update(&[], 1.0));
        assert_eq!(fit, before);
    }
}
