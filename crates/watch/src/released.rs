//! What is watched while a change settles, and until what has become of it is known as well as what was usual.

use greybox_recursive::{LeastSquares, RecursiveError};
use serde::{Deserialize, Serialize};

use crate::blocks::Block;

/// Blocks after which what is usual moves no more: as many as a chart ranks a value among.
const MOST: u64 = 1000;

/// Parameters, forces and offsets, all of them set free when something changed, and estimated from the blocks since then.
///
/// The innovations of a block that is not yet part of the estimate, at which the model is, are recursive residuals (R. L. Brown,
/// J. Durbin, J. M. Evans, *Techniques for testing the constancy of regression relationships over time*, J. Roy. Stat. Soc. B
/// 37, 1975). With the covariance P of the estimate, a block's score has mean zero and
///
/// ```text
/// zᵢ = Σ ψᵢν / √(Σψᵢ² + uᵢᵀ P uᵢ),     uᵢⱼ = Σ ψᵢψⱼ
/// ```
///
/// has variance one and does not depend on the blocks before, whatever the change was, as long as there was no other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Released {
    pub(crate) fit: LeastSquares,
    blocks: u64,
    /// Where the fit began.
    began: Vec<f64>,
}

impl Released {
    /// From where everything is, with standard deviations of how far it may be from there.
    pub(crate) fn new(at: &[f64], deviations: &[f64]) -> Result<Released, RecursiveError> {
        Ok(Released { fit: LeastSquares::new(at, deviations)?, blocks: 0, began: at.to_vec() })
    }

    /// zᵢ of every effect.
    pub(crate) fn deviates(&self, block: &Block) -> Vec<f64> {
        let (scores, covariance) = (block.scores(), self.fit.covariance());
        let n = scores.gradient.len();
        (0..n)
            .map(|i| {
                let u = block.information(i);
                let known = |a: usize| (0..n).map(|b| covariance[a * n + b] * u[b]).sum::<f64>();
                let variance = u[i] + (0..n).map(|a| u[a] * known(a)).sum::<f64>();
                if variance > 0.0 { scores.gradient[i] / variance.sqrt() } else { 0.0 }
            })
            .collect()
    }

    /// Takes a block whose innovations are those of a model that is `at` these effects. `false` where it was the last one.
    pub(crate) fn learn(&mut self, block: &Block, at: &[f64]) -> bool {
        for (row, value) in block.all() {
            let here: f64 = row.iter().zip(at).map(|(r, a)| r * a).sum();
            self.fit.update(row, value + here);
        }
        self.blocks += 1;
        self.blocks < MOST
    }

    /// Begins once more, at these effects.
    pub(crate) fn restart(&mut self, at: Vec<f64>) {
        self.fit.restart();
        (self.blocks, self.began) = (0, at);
    }

    /// Whether the estimate is where the fit began, as far as that was known by as many blocks: the linearisation is that of the
    /// estimate then. `inflation` is the variance of the scores.
    pub(crate) fn has_arrived(&self, inflation: f64) -> bool {
        let n = self.began.len() as f64;
        // Mean and three standard deviations of χ², of the difference of two estimates.
        self.fit.distance(&self.began) < 2.0 * inflation * (n + 3.0 * (2.0 * n).sqrt())
    }

    pub(crate) fn is_consistent(&self, effects: usize) -> bool {
        self.fit.len() == effects && self.fit.is_consistent() && self.began.len() == effects
    }
}

/// The scatter of a channel that has changed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Louder {
    pub(crate) channel: usize,
    /// Standard deviation of the sensor before, SI, and the value of its chart.
    pub(crate) first: f64,
    usual: f64,
    /// Sum of what the chart's value would have been at the first standard deviation.
    sum: f64,
    blocks: u64,
}

impl Louder {
    pub(crate) fn new(channel: usize, first: f64, usual: f64) -> Louder {
        Louder { channel, first, usual, sum: 0.0, blocks: 0 }
    }

    /// The standard deviation that a block, whose chart has the value `scatter` at the present one, says; `None` after the last.
    pub(crate) fn learn(&mut self, scatter: f64, now: f64) -> Option<f64> {
        if scatter.is_finite() {
            self.sum += scatter + 2.0 * (now / self.first).ln();
            self.blocks += 1;
        }
        let mean = self.sum / self.blocks.max(1) as f64;
        let next = self.first * (0.5 * (mean - self.usual)).exp();
        (self.blocks > 0 && self.blocks < MOST && next.is_finite() && next > 0.0).then_some(next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_recursive::Innovation;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// Blocks of a regression on two effects, which changed by 3 and −5 before the first of them: from the first on, z has
    /// variance one and does not depend on the one before.
    #[test]
    fn recursive_residuals_are_white_however_large_the_change() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(8);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let (mut squares, mut products, mut count) = ([0.0; 2], [0.0; 2], 0.0);
        for _ in 0..400 {
            let (truth, mut at) = ([3.0, -5.0], [0.0; 2]);
            let mut released = Released::new(&at, &[100.0; 2]).unwrap();
            let mut last = None::<Vec<f64>>;
            for _ in 0..12 {
                let mut block = Block::new(2, 1);
                for _ in 0..10 {
                    let row = [normal(), 0.5 * normal() + 1.0];
                    let left: f64 = (0..2).map(|k| row[k] * (truth[k] - at[k])).sum();
                    let value = left + normal();
                    block.push(0, &Innovation { value, row: &row, deviation: 1.0 });
                }
                let z = released.deviates(&block);
                for i in 0..2 {
                    squares[i] += z[i] * z[i];
                    products[i] += last.as_ref().map_or(0.0, |l| l[i] * z[i]);
                }
                count += 1.0;
                last = Some(z);
                released.learn(&block, &at);
                released.fit.estimate_into(&mut at);
            }
            assert!((at[0] - 3.0).abs() < 0.6 && (at[1] + 5.0).abs() < 0.6, "{at:?}");
        }
        for i in 0..2 {
            let (variance, correlation) = (squares[i] / count, products[i] / count);
            assert!((variance - 1.0).abs() < 0.1 && correlation.abs() < 0.06, "{variance} {correlation}");
        }
    }

    /// A sensor that scatters half as much again, by blocks whose chart is what the present standard deviation leaves.
    #[test]
    fn the_scatter_of_a_channel_is_followed() {
        let (mut louder, mut now) = (Louder::new(0, 0.002, -0.1), 0.002f64);
        for k in 0..200 {
            let noise = 0.2 * (f64::from(k * k * 7919 % 101) / 50.0 - 1.0);
            now = louder.learn(-0.1 + 2.0 * (0.003 / now).ln() + noise, now).unwrap();
        }
        assert!((now - 0.003).abs() < 1e-4, "{now}");
        assert_eq!(louder.learn(f64::NAN, now), Some(now));
    }
}
