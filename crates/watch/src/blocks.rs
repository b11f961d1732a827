//! Innovations of a block of samples: what each single change would explain of them.

use greybox_recursive::{Innovation, LeastSquares, Triangle};
use serde::{Deserialize, Serialize};

/// Standard deviation of an effect, in those of a block's innovations, up to which all effects together are fitted.
const WIDE: f64 = 1e3;

/// Innovations of one block with their regressors on every single change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Block {
    effects: usize,
    /// Per channel the triangular factor of the rows [ψ | ν].
    channels: Vec<Triangle>,
    row: Vec<f64>,
}

/// What a block says of every single change δ: Σ ψν and Σ ψ².
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Scores {
    pub(crate) gradient: Vec<f64>,
    pub(crate) information: Vec<f64>,
    /// Σ ν², and how many there are.
    pub(crate) squares: f64,
    pub(crate) count: f64,
}

impl Scores {
    pub(crate) fn zero(effects: usize) -> Scores {
        Scores { gradient: vec![0.0; effects], information: vec![0.0; effects], squares: 0.0, count: 0.0 }
    }

    pub(crate) fn add(&mut self, other: &Scores) {
        self.gradient.iter_mut().zip(&other.gradient).for_each(|(a, b)| *a += b);
        self.information.iter_mut().zip(&other.information).for_each(|(a, b)| *a += b);
        self.squares += other.squares;
        self.count += other.count;
    }

    /// Of successive blocks together.
    pub(crate) fn sum(blocks: &[Scores]) -> Scores {
        let mut sum = Scores::zero(blocks.first().map_or(0, |s| s.gradient.len()));
        blocks.iter().for_each(|s| sum.add(s));
        sum
    }

    pub(crate) fn deviates(&self) -> Vec<f64> {
        (0..self.gradient.len()).map(|h| self.deviate(h)).collect()
    }

    /// Σψν/√Σψ²: of variance one where the innovations are white, and far from zero where this change happened.
    pub(crate) fn deviate(&self, effect: usize) -> f64 {
        let information = self.information[effect];
        if information > 0.0 { self.gradient[effect] / information.sqrt() } else { 0.0 }
    }

    /// The change by maximum likelihood, where it is the only one, and its standard deviation.
    pub(crate) fn change(&self, effect: usize) -> (f64, f64) {
        let information = self.information[effect];
        (self.gradient[effect] / information, 1.0 / information.sqrt())
    }
}

impl Block {
    pub(crate) fn new(effects: usize, channels: usize) -> Block {
        Block {
            effects,
            channels: vec![Triangle::new(effects + 1); channels],
            row: Vec::with_capacity(effects + 1),
        }
    }

    /// Whether it is one of so many effects and channels.
    pub(crate) fn is_consistent(&self, effects: usize, channels: usize) -> bool {
        self.effects == effects
            && self.channels.len() == channels
            && self.channels.iter().all(|c| c.size() == Some(effects + 1))
    }

    pub(crate) fn push(&mut self, channel: usize, innovation: &Innovation<'_>) {
        self.row.clear();
        self.row.extend_from_slice(innovation.row);
        self.row.push(innovation.value);
        self.channels[channel].push(&self.row);
    }

    pub(crate) fn merge(&mut self, other: &Block) {
        self.channels.iter_mut().zip(&other.channels).for_each(|(a, b)| a.merge(b));
    }

    pub(crate) fn clear(&mut self) {
        self.channels.iter_mut().for_each(Triangle::clear);
    }

    /// Rows [ψ | ν] of a channel, as many as tell all sums of products.
    fn rows<'a>(&'a self, channel: &'a Triangle) -> impl Iterator<Item = (&'a [f64], f64)> {
        (0..=self.effects).map(|k| {
            let row = channel.row(k);
            (&row[..self.effects], row[self.effects])
        })
    }

    pub(crate) fn all(&self) -> impl Iterator<Item = (&[f64], f64)> {
        self.channels.iter().flat_map(|c| self.rows(c))
    }

    pub(crate) fn scores(&self) -> Scores {
        let mut scores = Scores::zero(self.effects);
        for channel in &self.channels {
            for h in 0..self.effects {
                scores.gradient[h] += channel.product(h, self.effects);
                scores.information[h] += channel.product(h, h);
            }
            scores.squares += channel.product(self.effects, self.effects);
            scores.count += channel.count() as f64;
        }
        scores
    }

    /// Σψᵢψⱼ for all j.
    pub(crate) fn information(&self, effect: usize) -> Vec<f64> {
        (0..self.effects).map(|j| self.channels.iter().map(|c| c.product(effect, j)).sum()).collect()
    }

    /// By how much what is not known of the first parameters, with the covariance P (row by row), makes each score scatter, over
    /// its own variance:
    ///
    /// ```text
    /// ℓᵢ = uᵢᵀ P uᵢ / Σψᵢ²,     uᵢⱼ = Σ ψᵢψⱼ,   j a parameter
    /// ```
    pub(crate) fn leverages(&self, covariance: &[f64]) -> Vec<f64> {
        let parameters = covariance.len().isqrt();
        (0..self.effects)
            .map(|i| {
                let u = self.information(i);
                let known =
                    |a: usize| (0..parameters).map(|b| covariance[a * parameters + b] * u[b]).sum::<f64>();
                let unknown: f64 = (0..parameters).map(|a| u[a] * known(a)).sum();
                if u[i] > 0.0 { unknown / u[i] } else { 0.0 }
            })
            .collect()
    }

    /// RMS of each channel's innovations; NaN where none were measured.
    pub(crate) fn rms(&self) -> Vec<f64> {
        let last = self.effects;
        self.channels.iter().map(|c| (c.product(last, last) / c.count() as f64).sqrt()).collect()
    }

    /// ln of each channel's mean square that all changes together do not explain; NaN where none were measured.
    pub(crate) fn scatter(&self, scores: &Scores) -> Vec<f64> {
        let scale: Vec<f64> =
            scores.information.iter().map(|i| if *i > 0.0 { 1.0 / i.sqrt() } else { 0.0 }).collect();
        let scaled = |row: &[f64]| -> Vec<f64> { row.iter().zip(&scale).map(|(r, s)| r * s).collect() };
        let zero = vec![0.0; self.effects];
        let Ok(mut fit) = LeastSquares::new(&zero, &vec![WIDE; self.effects]) else {
            return vec![f64::NAN; self.channels.len()];
        };
        for (row, value) in self.all() {
            fit.update(&scaled(row), value);
        }
        let changes = fit.estimate();
        self.channels
            .iter()
            .map(|channel| {
                let left = |(row, value): (&[f64], f64)| {
                    let explained: f64 = scaled(row).iter().zip(&changes).map(|(r, d)| r * d).sum();
                    (value - explained).powi(2)
                };
                (self.rows(channel).map(left).sum::<f64>() / channel.count() as f64).ln()
            })
            .collect()
    }
}

/// Doubles blocks while the deviates of successive ones are correlated, and at least `fewest` are left; how many of the
/// given blocks one should have. The correlation of n independent numbers with the next is within 2.6/√n in 99 of 100.
pub(crate) fn together(blocks: &[Scores], fewest: usize) -> usize {
    let mut count = 1;
    loop {
        let merged: Vec<Scores> = blocks.chunks_exact(count).map(Scores::sum).collect();
        let n = merged.len();
        let effects = merged.first().map_or(0, |s| s.gradient.len());
        let correlated = (0..effects).any(|h| {
            let z: Vec<f64> = merged.iter().map(|s| s.deviate(h)).collect();
            let mean = z.iter().sum::<f64>() / n as f64;
            let square: f64 = z.iter().map(|v| (v - mean).powi(2)).sum();
            let lagged: f64 = z.windows(2).map(|w| (w[0] - mean) * (w[1] - mean)).sum();
            square > 0.0 && (lagged / square).abs() > 2.6 / (n as f64).sqrt()
        });
        if !correlated || n / 2 < fewest {
            return count;
        }
        count *= 2;
    }
}

/// A block that has ended.
pub(crate) struct Ended {
    pub(crate) t: f64,
    pub(crate) scores: Scores,
    /// Of every effect.
    pub(crate) deviates: Vec<f64>,
    /// Per channel.
    pub(crate) scatter: Vec<f64>,
    pub(crate) block: Block,
}

impl Ended {
    /// The values of all charts.
    pub(crate) fn values(&self) -> impl Iterator<Item = f64> {
        self.deviates.iter().chain(&self.scatter).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise of variance one from a small generator.
    fn noise(seed: &mut u64) -> f64 {
        let mut uniform = || {
            *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (*seed >> 33) as f64 / f64::from(1u32 << 31)
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    }

    fn scores(gradient: f64) -> Scores {
        Scores { gradient: vec![gradient], information: vec![1.0], squares: 1.0, count: 1.0 }
    }

    #[test]
    fn blocks_are_as_long_as_their_scores_are_correlated() {
        let mut seed = 1;
        let white: Vec<Scores> = (0..200).map(|_| scores(noise(&mut seed))).collect();
        assert_eq!(together(&white, 12), 1);
        let mut x = 0.0;
        let slow: Vec<Scores> = (0..200)
            .map(|_| {
                x = 0.8 * x + noise(&mut seed);
                scores(x)
            })
            .collect();
        let count = together(&slow, 12);
        assert!((4..=16).contains(&count), "{count}");
        // Few are left: no longer ones, however correlated they are.
        assert_eq!(together(&slow[..30], 16), 1);
    }

    /// Of blocks that were learned, no leverage is above one, whatever they are; one that moves as none of them did says more of a
    /// parameter than all of them.
    #[test]
    fn a_block_that_was_learned_has_no_leverage_above_one() {
        let mut seed = 3;
        let mut block = |amplitudes: [f64; 3]| {
            let mut block = Block::new(3, 1);
            for _ in 0..20 {
                let row = amplitudes.map(|a| a * noise(&mut seed));
                block.push(0, &Innovation { value: noise(&mut seed), row: &row, deviation: 1.0 });
            }
            block
        };
        let mut learned: Vec<Block> = (0..30).map(|_| block([1.0, 1e-3, 1.0])).collect();
        learned.push(block([50.0, 0.01, 3.0]));
        let mut fit = LeastSquares::new(&[0.0; 2], &[1e3; 2]).unwrap();
        for (row, value) in learned.iter().flat_map(Block::all) {
            fit.update(&row[..2], value);
        }
        let known = fit.covariance();
        for block in &learned {
            assert!(
                block.leverages(&known).iter().all(|l| (0.0..=1.0).contains(l)),
                "{:?}",
                block.leverages(&known)
            );
        }
        // The one that moved the first parameter has said most of what is known of it.
        assert!(learned[30].leverages(&known)[0] > 0.8);
        let outside = block([1.0, 1.0, 1.0]).leverages(&known);
        assert!(outside[1] > 100.0, "{outside:?}");
    }

    /// Innovations that one effect of size 3 makes, on noise: the score, its size, and the scatter that is left.
    #[test]
    fn a_block_says_how_large_a_single_change_is() {
        let mut seed = 2;
        let mut block = Block::new(2, 1);
        for k in 0..500 {
            let row = [(0.1 * f64::from(k)).sin(), 1.0];
            let value = 3.0 * row[0] + 0.5 * noise(&mut seed);
            block.push(0, &Innovation { value, row: &row, deviation: 1.0 });
        }
        let scores = block.scores();
        let (step, std) = scores.change(0);
        assert!((step - 3.0).abs() < 4.0 * 0.5 * std, "{step} {std}");
        assert!((scores.deviate(0) - step / std).abs() < 1e-9 && scores.count == 500.0);
        let scatter = block.scatter(&scores)[0];
        assert!((scatter - 0.25f64.ln()).abs() < 0.3, "{scatter}");
        assert!((block.rms()[0] - (4.5f64 + 0.25).sqrt()).abs() < 0.1);
    }
}
