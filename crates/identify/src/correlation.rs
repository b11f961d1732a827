//! How far residuals are from white.

use greybox_calibrate::qr;
use serde::{Deserialize, Serialize};

/// Σ eₖ eₖ₊ₗ over stretches of one channel, for lags from zero on; additive over stretches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Lagged {
    sums: Vec<f64>,
    samples: usize,
}

/// Lags over which a correlation time is summed at most.
pub(crate) const LONGEST: usize = 400;

/// Lags that mostly tell.
pub(crate) const FEW: usize = 20;

impl Lagged {
    /// Lags from 0 to `lags` of stretches of residuals.
    pub(crate) fn of<'a>(stretches: impl IntoIterator<Item = &'a [f64]>, lags: usize) -> Lagged {
        let mut lagged = Lagged { sums: vec![0.0; lags + 1], samples: 0 };
        for e in stretches {
            lagged.samples += e.len();
            for (lag, sum) in lagged.sums.iter_mut().enumerate().take(e.len()) {
                *sum += qr::dot(&e[lag..], &e[..e.len() - lag]);
            }
        }
        lagged
    }

    /// Those of further stretches.
    pub(crate) fn add(&mut self, other: &Lagged) {
        self.sums.iter_mut().zip(&other.sums).for_each(|(a, b)| *a += b);
        self.samples += other.samples;
    }

    /// ρ of the lags from one on, as far as it is beyond chance.
    fn beyond(&self) -> impl Iterator<Item = f64> {
        let zero = self.sums[0];
        let chance = 2.5 / (self.samples as f64).sqrt();
        self.sums[1..].iter().map(move |s| s / zero).take_while(move |rho| zero > 0.0 && *rho >= chance)
    }

    /// 1 + 2 Σ ρ, summed over lags while ρ is beyond chance.
    pub(crate) fn time(&self) -> f64 {
        self.beyond().fold(1.0, |time, rho| time + 2.0 * rho)
    }

    /// Whether ρ falls to chance within the lags: more of them would not change [`time`](Self::time).
    pub(crate) fn is_enough(&self) -> bool {
        self.beyond().count() + 1 < self.sums.len()
    }

    /// Whether they look white: Ljung–Box over twenty lags at the 0.1 % level.
    pub(crate) fn is_white(&self) -> bool {
        let (zero, n) = (self.sums[0], self.samples as f64);
        let lags = self.sums[1..].iter().take(FEW).enumerate();
        let q = lags.map(|(l, c)| (c / zero).powi(2) / (n - l as f64 - 1.0).max(1.0)).sum::<f64>()
            * n
            * (n + 2.0);
        // Upper 0.1 % point of χ² with so many degrees of freedom.
        q < 45.315
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An autoregression of order one and its correlation time (1 + ρ)/(1 − ρ).
    fn autoregression(rho: f64, n: usize) -> Vec<f64> {
        let mut seed = 1_u64;
        let mut uniform = move || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (seed >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let mut x = 0.0;
        (0..n)
            .map(|_| {
                x = rho * x + uniform();
                x
            })
            .collect()
    }

    #[test]
    fn the_correlation_time_of_an_autoregression_and_of_white_noise() {
        let coloured = autoregression(0.8, 200_000);
        let lagged = Lagged::of([&coloured[..]], LONGEST);
        assert!((lagged.time() / 9.0 - 1.0).abs() < 0.1, "{}", lagged.time());
        assert!(!lagged.is_white());
        let white = autoregression(0.0, 200_000);
        let lagged = Lagged::of([&white[..]], LONGEST);
        assert!(lagged.is_white() && lagged.time() < 1.1);
    }

    #[test]
    fn a_few_lags_are_enough_where_more_say_the_same() {
        for (rho, enough) in [(0.0, true), (0.5, true), (0.95, false)] {
            let e = autoregression(rho, 100_000);
            let [few, all] = [FEW, LONGEST].map(|lags| Lagged::of([&e[..]], lags));
            assert_eq!(few.is_enough(), enough, "{rho}");
            assert_eq!(few.time() == all.time(), enough, "{rho}");
        }
    }

    #[test]
    fn stretches_add_up() {
        let e = autoregression(0.5, 3000);
        let whole = Lagged::of(e.chunks(1000), 30);
        let mut sum = Lagged::of([&e[..1000]], 30);
        sum.add(&Lagged::of([&e[1000..2000], &e[2000..]], 30));
        assert_eq!(sum.samples, whole.samples);
        assert!(sum.sums.iter().zip(&whole.sums).all(|(a, b)| (a - b).abs() <= 1e-12 * whole.sums[0]));
    }
}
