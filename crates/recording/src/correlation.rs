//! Correlation of a residual with itself and with an input, and what chance gives.
//!
//! A residual that is noise is white and knows nothing of the input (L. Ljung, *System Identification*, 2nd ed. 1999,
//! ch. 16.6). For a residual e and an input u of n samples, means removed,
//!
//! ```text
//! r_ue(h) = Σ u(k) e(k+h) / √(Σ u² Σ e²),      h = −H … H
//! ```
//!
//! which has, where u and e are independent, the variance Σ_h ρ_u(h) ρ_e(h) / n (M. S. Bartlett, *Stochastic Processes*,
//! 1955), and that of e with itself, where e is white, 1/n. A correlation beyond the bound at a lag h > 0 says that the
//! model lacks an effect of the input of h samples ago; at h < 0, that the input knows the residual: a closed loop.

use crate::spectrum;

/// Two-sided 99 % quantile of a normal variable.
const NINETY_NINE: f64 = 2.575_829_303_548_901;

/// Correlations at the lags −H … H.
#[derive(Debug, Clone, PartialEq)]
pub struct Correlation {
    /// 2 H + 1 values.
    pub values: Vec<f64>,
    /// What 99 % of the values stay below, in magnitude, where there is nothing to find.
    pub bound: f64,
}

impl Correlation {
    /// A residual with itself, to the lag `reach`. `None` where it does not vary, or is shorter than two reaches. NaN =
    /// missing.
    pub fn of(e: &[f64], reach: usize) -> Option<Correlation> {
        let (e, n) = centred(e, reach)?;
        Some(Correlation { values: spectrum::correlation(&e, &e, reach), bound: NINETY_NINE / n.sqrt() })
    }

    /// An input with a residual of as many samples.
    ///
    /// ```
    /// use greybox_recording::Correlation;
    /// let u: Vec<f64> = (0..2000_u64).map(|k| ((k * k * 7919) % 101) as f64).collect();
    /// // What is left over is the input of three samples ago.
    /// let e: Vec<f64> = (0..2000).map(|k| if k < 3 { 0.0 } else { 0.1 * u[k - 3] }).collect();
    /// let found = Correlation::between(&u, &e, 10).unwrap();
    /// assert!(found.values[10 + 3] > 0.99 && found.bound < 0.2);
    /// ```
    pub fn between(u: &[f64], e: &[f64], reach: usize) -> Option<Correlation> {
        let ((u, _), (e, n)) = (centred(u, reach)?, centred(e, reach)?);
        let far = (4 * reach).min(u.len().min(e.len()) / 4);
        let [own, other] = [&u, &e].map(|x| spectrum::correlation(x, x, far));
        let together: f64 = own.iter().zip(&other).map(|(a, b)| a * b).sum();
        let bound = NINETY_NINE * (together.max(1.0) / n).sqrt();
        Some(Correlation { values: spectrum::correlation(&u, &e, reach), bound })
    }
}

/// The samples without their mean, missing ones zero, and how many there are.
fn centred(x: &[f64], reach: usize) -> Option<(Vec<f64>, f64)> {
    let present = || x.iter().filter(|v| v.is_finite());
    let n = present().count() as f64;
    if n < (2 * reach).max(2) as f64 {
        return None;
    }
    let mean = present().sum::<f64>() / n;
    let centred: Vec<f64> = x.iter().map(|v| if v.is_finite() { v - mean } else { 0.0 }).collect();
    let power: f64 = centred.iter().map(|v| v * v).sum();
    (power.is_finite() && power > 1e-24 * n * mean * mean && power > 0.0).then_some((centred, n))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// White noise of variance 1/12 through a first-order lag.
    fn noise(seed: u64, colour: f64, n: usize) -> Vec<f64> {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let mut y = 0.0;
        (0..n)
            .map(|_| {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                y = colour * y + ((state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5);
                y
            })
            .collect()
    }

    /// Share of the lags beyond the bound, over seeds.
    fn beyond(of: impl Fn(u64) -> Correlation) -> f64 {
        let (mut out, mut all) = (0, 0);
        for seed in 1..=100 {
            let found = of(seed);
            let reach = found.values.len() / 2;
            let lags = found.values[reach + 1..].iter();
            out += lags.filter(|v| v.abs() > found.bound).count();
            all += reach;
        }
        100.0 * f64::from(out as u32) / f64::from(all as u32)
    }

    #[test]
    fn one_lag_of_a_hundred_is_beyond_the_bound_by_chance() {
        let white = beyond(|s| Correlation::of(&noise(s, 0.0, 4000), 40).unwrap());
        assert!((0.5..1.6).contains(&white), "{white} %");
        // An input and a residual of long memory; without Bartlett's sum it is a third.
        let coloured = beyond(|s| {
            Correlation::between(&noise(2 * s + 1000, 0.9, 4000), &noise(2 * s + 1, 0.9, 4000), 40).unwrap()
        });
        assert!((0.2..2.5).contains(&coloured), "{coloured} %");
    }

    #[test]
    fn what_the_input_leaves_stands_at_positive_lags() {
        let u = noise(5, 0.0, 2000);
        let e: Vec<f64> = noise(6, 0.0, 2000)
            .iter()
            .enumerate()
            .map(|(k, w)| w + if k < 7 { 0.0 } else { 0.5 * u[k - 7] })
            .collect();
        let found = Correlation::between(&u, &e, 20).unwrap();
        let beyond: Vec<usize> = (0..41).filter(|&i| found.values[i].abs() > 2.0 * found.bound).collect();
        assert_eq!(beyond, [27]);
        let itself = Correlation::of(&e, 20).unwrap();
        assert!((itself.values[20] - 1.0).abs() < 1e-12);
    }

    #[test]
    fn samples_that_say_nothing_give_nothing() {
        for x in [&[][..], &[1.0; 50], &[f64::NAN; 50], &[0.0; 50]] {
            assert_eq!(Correlation::of(x, 10), None);
        }
        let mut e = noise(7, 0.0, 500);
        e[100..120].fill(f64::NAN);
        let found = Correlation::between(&noise(8, 0.0, 500), &e, 30).unwrap();
        assert!(found.values.iter().all(|v| v.is_finite()) && found.bound.is_finite());
        assert_eq!(Correlation::of(&noise(9, 0.0, 15), 10), None);
    }
}
