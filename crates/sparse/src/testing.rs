//! Data for the unit tests.

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

pub(crate) fn normal(n: usize, seed: u64) -> Vec<f64> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    (0..n).map(|_| StandardNormal.sample(&mut rng)).collect()
}

/// First-order autoregression of unit variance.
pub(crate) fn ar1(n: usize, phi: f64, seed: u64) -> Vec<f64> {
    let mut state = 0.0;
    normal(n, seed)
        .into_iter()
        .enumerate()
        .map(|(i, e)| {
            state = if i == 0 { e } else { phi * state + (1.0 - phi * phi).sqrt() * e };
            state
        })
        .collect()
}

/// Independent normal columns and a target with coefficients 1, −1/2, 1/3, … and unit noise.
pub(crate) fn design(n: usize, k: usize, seed: u64) -> (Vec<Vec<f64>>, Vec<f64>) {
    let columns: Vec<Vec<f64>> = (0..k).map(|j| normal(n, seed * 1000 + j as u64)).collect();
    let noise = normal(n, seed * 1000 + 999);
    let y = (0..n)
        .map(|i| {
            noise[i]
                + columns
                    .iter()
                    .enumerate()
                    .map(|(j, c)| c[i] * if j % 2 == 0 { 1.0 } else { -1.0 } / (j + 1) as f64)
                    .sum::<f64>()
        })
        .collect();
    (columns, y)
}
