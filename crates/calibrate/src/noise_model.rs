//! Coloured measurement noise: an autoregression per channel, and its whitening filter.
//!
//! A residual e that is not white is modelled as
//!
//! ```text
//! e(k) = Σᵢ aᵢ e(k−i) + w(k),      w white with variance v_p,      i = 1 … p
//! ```
//!
//! **Estimation.** Burg's method (J. P. Burg, *Maximum entropy spectral analysis*, Stanford 1975;
//! S. M. Kay, *Modern Spectral Estimation*, 1988, ch. 7.5), pooled over stretches: with the forward and
//! backward prediction errors f and b of order m − 1,
//!
//! ```text
//! κ_m = 2 Σ f(k) b(k−1) / Σ (f(k)² + b(k−1)²)      (sums over all stretches)
//! a_m = κ_m,   a_i ← a_i − κ_m a_{m−i},   v_m = (1 − κ_m²) v_{m−1}
//! ```
//!
//! which keeps every |κ| < 1, hence the model stationary. The order minimises BIC = n ln v_p + p ln n
//! (G. Schwarz, Ann. Stat. 6, 1978); a gain below 2 % of the variance is no colour.
//!
//! **Whitening** multiplies by the inverse Cholesky factor of the stationary covariance (but for a
//! common factor), by the Levinson recursion's own predictors: row k ≥ p is e(k) − Σ aᵢ e(k−i); row
//! k < p uses the predictor of order k and is scaled by √(v_p/v_k), so that all rows have the variance
//! v_p. The sum of squares over v_p is then the exact quadratic form of the Gaussian likelihood of a
//! stationary stretch, with no transient at its start; the determinant is a constant for a fixed model.

/// Largest magnitude of a reflection coefficient: a pole closer to the unit circle is a drift, not noise.
const CLIP: f64 = 0.9995;
/// Largest order tried by [`Autoregression::fit`] where nothing else is said.
pub const MOST: usize = 6;
/// Share of the variance that must be predictable before a channel counts as coloured.
const LEAST_GAIN: f64 = 0.02;
/// Least share of the samples that whitening must leave (missing samples cost their followers).
const LEAST_KEPT: f64 = 0.8;

/// A stationary autoregression with its predictors of every lower order.
#[derive(Debug, Clone, PartialEq)]
pub struct Autoregression {
    /// `predictors[j]` has the j coefficients a₁ … a_j of the best predictor of order j.
    predictors: Vec<Vec<f64>>,
    /// Variance of its error; `variances[0]` is that of the noise itself.
    variances: Vec<f64>,
}

impl Autoregression {
    /// White noise.
    pub fn white(variance: f64) -> Autoregression {
        Autoregression { predictors: vec![Vec::new()], variances: vec![variance] }
    }

    /// From reflection coefficients κ₁ … κ_p (clipped to ±0.9995) and the variance of the noise, by the
    /// Levinson recursion.
    pub fn from_reflections(reflections: &[f64], variance: f64) -> Autoregression {
        let mut model = Autoregression::white(variance);
        reflections.iter().for_each(|&k| model.grow(k));
        model
    }

    fn grow(&mut self, reflection: f64) {
        let reflection = reflection.clamp(-CLIP, CLIP);
        let old = &self.predictors[self.order()];
        let mut next: Vec<f64> = old.iter().zip(old.iter().rev()).map(|(a, b)| a - reflection * b).collect();
        next.push(reflection);
        self.variances.push(self.variance() * (1.0 - reflection * reflection));
        self.predictors.push(next);
    }

    /// Fits stretches of zero-mean noise; NaN = missing, which cuts a stretch. The order is at most
    /// `most`, and small enough for [`whiten`](Self::whiten) to leave four fifths of the samples.
    /// Nothing to fit gives white noise of variance zero.
    pub fn fit(stretches: &[&[f64]], most: usize) -> Autoregression {
        let runs: Vec<&[f64]> =
            stretches.iter().flat_map(|s| s.split(|v| !v.is_finite())).filter(|r| !r.is_empty()).collect();
        let n: usize = runs.iter().map(|r| r.len()).sum();
        if n == 0 {
            return Autoregression::white(0.0);
        }
        let mut full = burg(&runs, n, most);
        let missing: Vec<Vec<bool>> =
            stretches.iter().map(|s| s.iter().map(|v| !v.is_finite()).collect()).collect();
        let count = n as f64;
        let bic = |p: usize| count * full.variances[p].ln() + p as f64 * count.ln();
        let kept = |p: usize| missing.iter().map(|m| m.len() - lost(m, p)).sum::<usize>() as f64;
        let order = (0..=full.order())
            .filter(|&p| full.variances[p] > 0.0 && kept(p) >= LEAST_KEPT * count)
            .min_by(|&a, &b| bic(a).total_cmp(&bic(b)))
            .unwrap_or(0);
        let order = if full.variances[order] > (1.0 - LEAST_GAIN) * full.variances[0] { 0 } else { order };
        full.predictors.truncate(order + 1);
        full.variances.truncate(order + 1);
        full
    }

    /// The order p; 0 is white noise.
    pub fn order(&self) -> usize {
        self.predictors.len() - 1
    }

    /// The coefficients a₁ … a_p.
    pub fn coefficients(&self) -> &[f64] {
        &self.predictors[self.order()]
    }

    /// Variance v_p of the innovations, in the square of the noise's unit.
    pub fn variance(&self) -> f64 {
        self.variances[self.order()]
    }

    /// Variance v₀ of the noise itself.
    pub fn total_variance(&self) -> f64 {
        self.variances[0]
    }

    /// The same for noise `factor` times as large.
    pub fn scaled(&self, factor: f64) -> Autoregression {
        Autoregression {
            predictors: self.predictors.clone(),
            variances: self.variances.iter().map(|v| v * factor * factor).collect(),
        }
    }

    /// Whitens a stretch in place. Rows that are missing, or whose predictor would touch a missing
    /// one, become zero. Returns how many those are.
    ///
    /// `x` and `missing` are of the same length; what `x` holds in a missing row does not matter.
    ///
    /// ```
    /// use greybox_calibrate::Autoregression;
    /// // e(k) = 0.8 e(k−1) + w(k), innovations of variance 0.36.
    /// let noise = Autoregression::from_reflections(&[0.8], 1.0);
    /// let mut e = [1.0, 1.0, 0.5, 0.4];
    /// assert_eq!(noise.whiten(&mut e, &[false; 4]), 0);
    /// for (e, w) in e.iter().zip([0.6, 0.2, -0.3, 0.0]) {
    ///     assert!((e - w).abs() < 1e-12);
    /// }
    /// ```
    pub fn whiten(&self, x: &mut [f64], missing: &[bool]) -> usize {
        let p = self.order();
        let v = self.variance();
        let mut zeroed = 0;
        // Backwards, so that the samples before are still the given ones.
        for k in (0..x.len()).rev() {
            let j = k.min(p);
            if missing[k - j..=k].contains(&true) {
                x[k] = 0.0;
                zeroed += 1;
                continue;
            }
            let prediction: f64 =
                self.predictors[j].iter().zip(x[..k].iter().rev()).map(|(a, x)| a * x).sum();
            // With j = p the factor is one; white noise of variance zero stays what it is.
            let factor = if j < p { (v / self.variances[j]).sqrt() } else { 1.0 };
            x[k] = factor * (x[k] - prediction);
        }
        zeroed
    }

    /// The quadratic form xᵀ Γ x of the noise's stationary covariance Γ over a stretch is `variance()` times the sum
    /// of squares of what this leaves in `x`: with the whitening W of a stretch without missing samples,
    /// Γ = v_p W⁻¹ W⁻ᵀ, and `x` becomes W⁻ᵀ x.
    ///
    /// ```
    /// use greybox_calibrate::Autoregression;
    /// // γ(h) = 2 · 0.8^|h|: the sum of two neighbours has the variance 2 (1 + 1 + 2 · 0.8).
    /// let noise = Autoregression::from_reflections(&[0.8], 2.0);
    /// let mut x = [0.0, 1.0, 1.0, 0.0];
    /// noise.colour_transposed(&mut x);
    /// let form = noise.variance() * x.iter().map(|v| v * v).sum::<f64>();
    /// assert!((form - 7.2).abs() < 1e-12);
    /// ```
    pub fn colour_transposed(&self, x: &mut [f64]) {
        let (p, v) = (self.order(), self.variance());
        for k in (0..x.len()).rev() {
            let j = k.min(p);
            // What is known from `whiten`: row k of W is `factor` times (…, −a₂, −a₁, 1).
            let row = x[k];
            for (a, x) in self.predictors[j].iter().zip(x[..k].iter_mut().rev()) {
                *x += a * row;
            }
            if j < p {
                x[k] = row * (self.variances[j] / v).sqrt();
            }
        }
    }

    /// How many rows [`whiten`](Self::whiten) makes zero.
    pub fn lost(&self, missing: &[bool]) -> usize {
        lost(missing, self.order())
    }
}

/// Rows that a whitening filter of order `p` cannot form.
fn lost(missing: &[bool], p: usize) -> usize {
    let mut reach = 0;
    let mut count = 0;
    for &m in missing {
        reach = if m { p + 1 } else { reach };
        if reach > 0 {
            reach -= 1;
            count += 1;
        }
    }
    count
}

/// The recursion up to order `most` over runs of `n` samples in all.
fn burg(runs: &[&[f64]], n: usize, most: usize) -> Autoregression {
    let power = runs.iter().flat_map(|r| r.iter()).map(|v| v * v).sum::<f64>() / n as f64;
    let mut model = Autoregression::white(power);
    let mut errors: Vec<(Vec<f64>, Vec<f64>)> = runs.iter().map(|r| (r.to_vec(), r.to_vec())).collect();
    for m in 1..=most {
        let (mut cross, mut sum) = (0.0, 0.0);
        for (f, b) in errors.iter().filter(|(f, _)| f.len() > m) {
            for (f, b) in f[m..].iter().zip(&b[m - 1..]) {
                cross += f * b;
                sum += f * f + b * b;
            }
        }
        // Too short, or predicted to rounding: a higher order has nothing to go by.
        if sum <= 1e-20 * power * n as f64 {
            break;
        }
        let reflection = (2.0 * cross / sum).clamp(-CLIP, CLIP);
        model.grow(reflection);
        for (f, b) in &mut errors {
            for k in (m..f.len()).rev() {
                let (old_f, old_b) = (f[k], b[k - 1]);
                f[k] = old_f - reflection * old_b;
                b[k] = old_b - reflection * old_f;
            }
        }
    }
    model
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// A stationary stretch of e(k) = Σ aᵢ e(k−i) + w(k) with innovations of variance one.
    fn series(a: &[f64], seed: u64, n: usize) -> Vec<f64> {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let start = 2000;
        let mut e: Vec<f64> = Vec::new();
        for k in 0..start + n {
            let w: f64 = StandardNormal.sample(&mut rng);
            let past: f64 = a.iter().zip(1..).map(|(a, i)| if k >= i { a * e[k - i] } else { 0.0 }).sum();
            e.push(past + w);
        }
        e.split_off(start)
    }

    /// Autocorrelation at `lag`.
    fn correlation(x: &[f64], lag: usize) -> f64 {
        let power: f64 = x.iter().map(|v| v * v).sum();
        x.iter().zip(&x[lag..]).map(|(a, b)| a * b).sum::<f64>() / power
    }

    #[test]
    fn coefficients_and_innovations_of_known_series_are_recovered() {
        for (truth, seed) in [(vec![0.97], 1), (vec![1.6, -0.8], 2), (vec![-0.5], 3)] {
            let e = series(&truth, seed, 20_000);
            let stretches: Vec<&[f64]> = e.chunks(500).collect();
            let model = Autoregression::fit(&stretches, MOST);
            assert_eq!(model.order(), truth.len(), "{model:?}");
            for (a, b) in model.coefficients().iter().zip(&truth) {
                // Three standard errors of the most variable one, √((1 − a²)/n) ≤ 0.0071.
                assert!((a - b).abs() < 0.02, "{model:?}");
            }
            assert!((model.variance() - 1.0).abs() < 0.035, "{}", model.variance());
        }
        let white = Autoregression::fit(&[&series(&[], 4, 20_000)], MOST);
        assert_eq!(white.order(), 0);
    }

    /// Ljung–Box: n(n+2) Σ r²/(n−h) over 20 lags is χ² with 20 − p degrees of freedom.
    #[test]
    fn whitened_series_are_white() {
        for (truth, seed) in [(vec![0.97], 5), (vec![1.6, -0.8], 6)] {
            let e = series(&truth, seed, 20_000);
            let model = Autoregression::fit(&[&e], MOST);
            let mut w = e.clone();
            assert_eq!(model.whiten(&mut w, &vec![false; e.len()]), 0);
            let statistic = |x: &[f64]| {
                let n = x.len() as f64;
                n * (n + 2.0) * (1..=20).map(|h| correlation(x, h).powi(2) / (n - h as f64)).sum::<f64>()
            };
            assert!(statistic(&w) < 45.0, "{}", statistic(&w));
            assert!(statistic(&e) > 1e4);
        }
    }

    /// Every row of a short stretch has the innovation's variance and none knows another.
    #[test]
    fn the_first_rows_are_innovations_too() {
        let kappas = [8.0 / 9.0, -0.8]; // a = (1.6, −0.8)
        let total = 1.0 / kappas.iter().map(|k| 1.0 - k * k).product::<f64>();
        let model = Autoregression::from_reflections(&kappas, total);
        assert!((model.coefficients()[0] - 1.6).abs() < 1e-12 && (model.variance() - 1.0).abs() < 1e-12);
        let (runs, n) = (20_000, 5);
        let mut moments = [[0.0; 5]; 5];
        for (run, stretch) in series(&[1.6, -0.8], 7, runs * 50).chunks(50).enumerate() {
            let mut x = stretch[..n].to_vec();
            model.whiten(&mut x, &[false; 5]);
            assert!(run < runs);
            for (row, a) in moments.iter_mut().zip(&x) {
                for (m, b) in row.iter_mut().zip(&x) {
                    *m += a * b / runs as f64;
                }
            }
        }
        for (i, row) in moments.iter().enumerate() {
            for (j, m) in row.iter().enumerate() {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((m - expected).abs() < 0.04, "{i} {j} {m}");
            }
        }
    }

    /// W⁻ᵀ against W itself, whose rows are the whitened unit vectors' transposes.
    #[test]
    fn colouring_transposed_undoes_whitening_transposed() {
        let model = Autoregression::from_reflections(&[0.9, -0.6, 0.3], 2.5);
        let n = 9;
        let columns: Vec<Vec<f64>> = (0..n)
            .map(|j| {
                let mut e = vec![0.0; n];
                e[j] = 1.0;
                model.whiten(&mut e, &[false; 9]);
                e
            })
            .collect();
        let x: Vec<f64> = (0..n).map(|k| ((k * k) as f64).sin()).collect();
        let mut g = x.clone();
        model.colour_transposed(&mut g);
        for (column, x) in columns.iter().zip(&x) {
            let back: f64 = column.iter().zip(&g).map(|(w, g)| w * g).sum();
            assert!((back - x).abs() < 1e-12, "{back} {x}");
        }
    }

    #[test]
    fn missing_samples_cost_their_followers_and_nothing_panics() {
        let model = Autoregression::from_reflections(&[0.9, 0.1], 1.0);
        let mut x = vec![1.0, 2.0, f64::NAN, 3.0, 4.0, 5.0, 6.0];
        let missing: Vec<bool> = x.iter().map(|v| v.is_nan()).collect();
        let given = x.clone();
        assert_eq!(model.whiten(&mut x, &missing), 3);
        assert_eq!(model.lost(&missing), 3);
        assert_eq!(x[2..5], [0.0; 3]);
        let a = model.coefficients();
        assert!((x[5] - (given[5] - a[0] * given[4] - a[1] * given[3])).abs() < 1e-15);

        assert_eq!(Autoregression::fit(&[], MOST), Autoregression::white(0.0));
        assert_eq!(Autoregression::fit(&[&[f64::NAN; 5]], MOST), Autoregression::white(0.0));
        assert_eq!(Autoregression::fit(&[&[0.0; 50]], MOST).order(), 0);
        assert_eq!(Autoregression::fit(&[&[1.0]], MOST).order(), 0);
        assert!(Autoregression::fit(&[&[1.0, 1.0, 1.0]], MOST).variance().is_finite());
        // A drift is held below the unit circle.
        let drift: Vec<f64> = (0..5000).map(|k| 1.0 + 1e-4 * k as f64).collect();
        let model = Autoregression::fit(&[&drift], MOST);
        assert!(model.variance() > 0.0);
        assert!(Autoregression::white(0.0).whiten(&mut [], &[]) == 0);
        // Every third sample missing: no order beyond what is left to predict from.
        let mut e = series(&[0.97], 8, 3000);
        e.iter_mut().step_by(3).for_each(|v| *v = f64::NAN);
        let model = Autoregression::fit(&[&e], MOST);
        assert_eq!(model.order(), 0);
        let total = 1.0 / (1.0 - 0.97f64 * 0.97);
        assert!((model.total_variance() / total - 1.0).abs() < 0.5);
    }
}
