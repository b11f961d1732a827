//! One number from several estimates of it: the methods of meta-analysis.
//!
//! Each of k recordings gives an estimate θᵢ with a standard error σᵢ. Were the true value the same in all, the
//! best estimate would weigh each by its inverse variance (fixed effect), and Cochran's Q would follow a χ²
//! distribution with k − 1 degrees of freedom:
//!
//! ```text
//! wᵢ = 1/σᵢ²      θ = Σ wᵢθᵢ / Σ wᵢ      σ² = 1/Σ wᵢ
//! Q  = Σ wᵢ (θᵢ − θ)²                    I² = max(0, (Q − (k − 1)) / Q)
//! ```
//!
//! Where Q is too large for that, the true value differs from recording to recording, with a variance τ² about its
//! mean that the method of moments estimates. The mean is then the random-effects estimate, with the weights
//! wᵢ* = 1/(σᵢ² + τ²) in the place of wᵢ:
//!
//! ```text
//! τ² = max(0, (Q − (k − 1)) / (Σ wᵢ − Σ wᵢ²/Σ wᵢ))
//! ```
//!
//! # References
//! - W. G. Cochran, "The combination of estimates from different experiments", Biometrics 10(1), 1954, 101–129.
//! - R. DerSimonian, N. Laird, "Meta-analysis in clinical trials", Controlled Clinical Trials 7(3), 1986, 177–188,
//!   <https://doi.org/10.1016/0197-2456(86)90046-2>.
//! - J. P. T. Higgins, S. G. Thompson, "Quantifying heterogeneity in a meta-analysis", Statistics in Medicine 21(11),
//!   2002, 1539–1558, <https://doi.org/10.1002/sim.1186>.

use statrs::distribution::{ChiSquared, ContinuousCDF};

/// Half the width of a 95 % interval of a normal distribution, in standard deviations.
pub(crate) const NORMAL_95: f64 = 1.959_963_984_540_054;

/// Below this probability of so large a Q, the recordings disagree.
pub const DISAGREE: f64 = 0.05;

/// An estimate and its standard error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Effect {
    /// θᵢ.
    pub value: f64,
    /// σᵢ.
    pub error: f64,
}

impl Effect {
    /// The estimate whose 95 % interval this is, if it were normally distributed; `None` where value or width is not
    /// a finite number, or the width is zero, as of a number that is known exactly.
    pub fn of(value: f64, ci95: Option<[f64; 2]>) -> Option<Effect> {
        let [low, high] = ci95?;
        let effect = Effect { value, error: 0.5 * (high - low) / NORMAL_95 };
        (value.is_finite() && effect.weight(0.0).is_finite() && effect.weight(0.0) > 0.0).then_some(effect)
    }

    fn weight(&self, between: f64) -> f64 {
        1.0 / (self.error * self.error + between)
    }
}

/// How much estimates differ beyond what their standard errors allow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heterogeneity {
    /// Cochran's Q.
    pub q: f64,
    /// k − 1.
    pub degrees_of_freedom: usize,
    /// Probability of so large a Q where all true values are the same.
    pub p_value: f64,
    /// I², the share of the scatter that is not due to the standard errors, 0 to 1.
    pub i_squared: f64,
    /// τ², the variance of the true values about their mean.
    pub between: f64,
}

impl Heterogeneity {
    /// Whether the estimates disagree: so large a Q has a probability below [`DISAGREE`].
    pub fn disagrees(&self) -> bool {
        self.p_value < DISAGREE
    }
}

/// Estimates pooled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pool {
    /// θ: the fixed-effect estimate, or the random-effects one where the estimates disagree.
    pub value: f64,
    /// Its standard error.
    pub error: f64,
    /// Their disagreement; `None` for a single estimate.
    pub heterogeneity: Option<Heterogeneity>,
}

impl Pool {
    /// The 95 % interval of the value.
    pub fn ci95(&self) -> [f64; 2] {
        let half = NORMAL_95 * self.error;
        [self.value - half, self.value + half]
    }
}

/// Pools estimates of one number; `None` where there are none.
///
/// ```
/// use greybox_fleet::pool::{Effect, pool};
/// // Weights 1, 1 and 1/4: θ = (1 + 3 + 4/4)/2.25 = 20/9, and Q = (11/9)² + (7/9)² + (16/9)²/4 = 26/9.
/// let effects = [(1.0, 1.0), (3.0, 1.0), (4.0, 2.0)].map(|(value, error)| Effect { value, error });
/// let pooled = pool(&effects).unwrap();
/// assert!((pooled.value - 5.0 / 2.25).abs() < 1e-12);
/// assert!((pooled.error - 1.0 / 1.5).abs() < 1e-12);
/// assert!((pooled.heterogeneity.unwrap().q - 26.0 / 9.0).abs() < 1e-12);
/// ```
pub fn pool(effects: &[Effect]) -> Option<Pool> {
    let fixed = mean(effects, 0.0)?;
    let Some(degrees_of_freedom) = effects.len().checked_sub(1).filter(|&d| d > 0) else {
        return Some(fixed);
    };
    let heterogeneity = heterogeneity(effects, fixed.value, degrees_of_freedom);
    let chosen = if heterogeneity.disagrees() { mean(effects, heterogeneity.between)? } else { fixed };
    Some(Pool { heterogeneity: Some(heterogeneity), ..chosen })
}

/// The weighted mean, with the variance `between` added to that of each estimate.
fn mean(effects: &[Effect], between: f64) -> Option<Pool> {
    let total: f64 = effects.iter().map(|e| e.weight(between)).sum();
    let value = effects.iter().map(|e| e.weight(between) * e.value).sum::<f64>() / total;
    (total > 0.0).then(|| Pool { value, error: total.recip().sqrt(), heterogeneity: None })
}

fn heterogeneity(effects: &[Effect], value: f64, degrees_of_freedom: usize) -> Heterogeneity {
    let weights = || effects.iter().map(|e| e.weight(0.0));
    let q: f64 = effects.iter().map(|e| e.weight(0.0) * (e.value - value).powi(2)).sum();
    let freedom = degrees_of_freedom as f64;
    let excess = (q - freedom).max(0.0);
    let total: f64 = weights().sum();
    // Shares of the total first: squares of weights can leave the range of numbers.
    let scale = total * (1.0 - weights().map(|w| (w / total).powi(2)).sum::<f64>());
    Heterogeneity {
        q,
        degrees_of_freedom,
        p_value: ChiSquared::new(freedom).map_or(f64::NAN, |d| d.sf(q)),
        i_squared: if excess > 0.0 { excess / q } else { 0.0 },
        between: if scale > 0.0 { excess / scale } else { 0.0 },
    }
}

/// Log risk ratios of thirteen trials of the BCG vaccine (G. A. Colditz et al., JAMA 271(9), 1994, 698–702).
#[cfg(test)]
pub(crate) fn vaccine_trials() -> [Effect; 13] {
    let trials: [[f64; 4]; 13] = [
        [4.0, 119.0, 11.0, 128.0],
        [6.0, 300.0, 29.0, 274.0],
        [3.0, 228.0, 11.0, 209.0],
        [62.0, 13536.0, 248.0, 12619.0],
        [33.0, 5036.0, 47.0, 5761.0],
        [180.0, 1361.0, 372.0, 1079.0],
        [8.0, 2537.0, 10.0, 619.0],
        [505.0, 87886.0, 499.0, 87892.0],
        [29.0, 7470.0, 45.0, 7232.0],
        [17.0, 1699.0, 65.0, 1600.0],
        [186.0, 50448.0, 141.0, 27197.0],
        [5.0, 2493.0, 3.0, 2338.0],
        [27.0, 16886.0, 29.0, 17825.0],
    ];
    trials.map(|[a, b, c, d]| Effect {
        value: (a / (a + b) / (c / (c + d))).ln(),
        error: (1.0 / a - 1.0 / (a + b) + 1.0 / c - 1.0 / (c + d)).sqrt(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f64, b: f64, tolerance: f64) {
        assert!((a - b).abs() <= tolerance, "{a} is not {b}");
    }

    fn effects<const N: usize>(pairs: [(f64, f64); N]) -> [Effect; N] {
        pairs.map(|(value, error)| Effect { value, error })
    }

    /// By hand: w = (4, 1, 4), Σw = 9, θ = (4·1 + 1·4 + 4·2)/9 = 16/9; Q = 4(7/9)² + (20/9)² + 4(2/9)² = 612/81,
    /// beyond the 95 % quantile of χ²₂ (5.99): p = exp(−Q/2). τ² = (Q − 2)/(9 − 33/9) = (50/9)/(16/3) = 25/24, and
    /// with it w* = (24/31, 24/49, 24/31).
    #[test]
    fn a_small_example_is_as_by_hand() {
        let pooled = pool(&effects([(1.0, 0.5), (4.0, 1.0), (2.0, 0.5)])).unwrap();
        let h = pooled.heterogeneity.unwrap();
        close(h.q, 612.0 / 81.0, 1e-12);
        assert_eq!(h.degrees_of_freedom, 2);
        close(h.p_value, (-306.0_f64 / 81.0).exp(), 1e-12);
        close(h.i_squared, 450.0 / 612.0, 1e-12);
        close(h.between, 25.0 / 24.0, 1e-12);
        let (a, b) = (24.0 / 31.0, 24.0 / 49.0);
        close(pooled.value, (3.0 * a + 4.0 * b) / (2.0 * a + b), 1e-12);
        close(pooled.error, 1.0 / f64::sqrt(2.0 * a + b), 1e-12);
    }

    /// Where Q is no larger than chance makes it, inverse variances alone decide.
    #[test]
    fn estimates_that_agree_are_pooled_by_inverse_variance() {
        let pooled = pool(&effects([(1.0, 0.5), (2.0, 1.0)])).unwrap();
        close(pooled.value, 1.2, 1e-15);
        close(pooled.error, 1.0 / 5f64.sqrt(), 1e-15);
        let h = pooled.heterogeneity.unwrap();
        close(h.q, 0.8, 1e-15);
        assert_eq!((h.between, h.i_squared), (0.0, 0.0));
        assert!(!h.disagrees());
        close(pooled.ci95()[1] - 1.2, NORMAL_95 / 5f64.sqrt(), 1e-15);
    }

    /// The [`vaccine_trials`] as analysed in W. Viechtbauer, "Conducting meta-analyses in R with the metafor package", J. Stat. Softw. 36(3),
    /// 2010: fixed effect −0.4303 (0.0405), Q = 152.2330; DerSimonian–Laird τ² = 0.3088, I² = 92.12 %, and the
    /// random-effects estimate −0.7141 (0.1787).
    #[test]
    fn the_trials_of_a_vaccine_give_the_published_figures() {
        let effects = vaccine_trials();
        let fixed = mean(&effects, 0.0).unwrap();
        close(fixed.value, -0.4303, 5e-5);
        close(fixed.error, 0.0405, 5e-5);
        let pooled = pool(&effects).unwrap();
        let h = pooled.heterogeneity.unwrap();
        close(h.q, 152.2330, 5e-5);
        close(h.between, 0.3088, 5e-5);
        close(h.i_squared, 0.9212, 5e-5);
        assert!(h.disagrees() && h.p_value < 1e-4);
        close(pooled.value, -0.7141, 5e-5);
        close(pooled.error, 0.1787, 5e-5);
    }

    #[test]
    fn one_estimate_is_itself_and_none_is_none() {
        assert_eq!(pool(&[]), None);
        let one = pool(&effects([(2.0, 0.5)])).unwrap();
        assert_eq!((one.value, one.error, one.heterogeneity), (2.0, 0.5, None));
    }

    #[test]
    fn what_has_no_width_or_is_no_number_is_no_estimate() {
        assert_eq!(Effect::of(1.0, None), None);
        assert_eq!(Effect::of(1.0, Some([1.0, 1.0])), None);
        assert_eq!(Effect::of(f64::NAN, Some([0.0, 1.0])), None);
        assert_eq!(Effect::of(1.0, Some([f64::NEG_INFINITY, 1.0])), None);
        close(Effect::of(1.0, Some([0.0, 2.0])).unwrap().error, 1.0 / NORMAL_95, 1e-15);
    }
}
