//! Innovations of a block of samples: what each single change would explain of them.

use greybox_recursive::{Innovation, LeastSquares};
use serde::{Deserialize, Serialize};

/// Standard deviation of an effect, in those of a block's innovations, up to which all effects together are fitted.
const WIDE: f64 = 1e3;

/// Innovations of one block with their regressors on every single change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Block {
    effects: usize,
    /// Per channel the rows [ψ | ν].
    rows: Vec<Vec<f64>>,
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
        Block { effects, rows: vec![Vec::new(); channels] }
    }

    /// Whether it is one of so many effects and channels.
    pub(crate) fn is_consistent(&self, effects: usize, channels: usize) -> bool {
        self.effects == effects
            && self.rows.len() == channels
            && self.rows.iter().all(|r| r.len().is_multiple_of(effects + 1))
    }

    pub(crate) fn push(&mut self, channel: usize, innovation: &Innovation<'_>) {
        let rows = &mut self.rows[channel];
        rows.extend_from_slice(innovation.row);
        rows.push(innovation.value);
    }

    pub(crate) fn clear(&mut self) {
        self.rows.iter_mut().for_each(Vec::clear);
    }

    fn rows(&self, channel: usize) -> impl Iterator<Item = (&[f64], f64)> {
        self.rows[channel].chunks_exact(self.effects + 1).map(|row| (&row[..self.effects], row[self.effects]))
    }

    fn all(&self) -> impl Iterator<Item = (&[f64], f64)> {
        (0..self.rows.len()).flat_map(|c| self.rows(c))
    }

    pub(crate) fn scores(&self) -> Scores {
        let mut scores = Scores::zero(self.effects);
        for (row, value) in self.all() {
            for (h, psi) in row.iter().enumerate() {
                scores.gradient[h] += psi * value;
                scores.information[h] += psi * psi;
            }
            scores.squares += value * value;
            scores.count += 1.0;
        }
        scores
    }

    /// RMS of each channel's innovations; NaN where none were measured.
    pub(crate) fn rms(&self) -> Vec<f64> {
        (0..self.rows.len())
            .map(|c| {
                let n = self.rows(c).count() as f64;
                (self.rows(c).map(|(_, v)| v * v).sum::<f64>() / n).sqrt()
            })
            .collect()
    }

    /// ln of each channel's mean square that all changes together do not explain; NaN where none were measured.
    pub(crate) fn scatter(&self, scores: &Scores) -> Vec<f64> {
        let scale: Vec<f64> =
            scores.information.iter().map(|i| if *i > 0.0 { 1.0 / i.sqrt() } else { 0.0 }).collect();
        let scaled = |row: &[f64]| -> Vec<f64> { row.iter().zip(&scale).map(|(r, s)| r * s).collect() };
        let zero = vec![0.0; self.effects];
        let Ok(mut fit) = LeastSquares::new(&zero, &vec![WIDE; self.effects]) else {
            return vec![f64::NAN; self.rows.len()];
        };
        for (row, value) in self.all() {
            fit.update(&scaled(row), value);
        }
        let changes = fit.estimate();
        (0..self.rows.len())
            .map(|c| {
                let left = |(row, value): (&[f64], f64)| {
                    let explained: f64 = scaled(row).iter().zip(&changes).map(|(r, d)| r * d).sum();
                    (value - explained).powi(2)
                };
                (self.rows(c).map(left).sum::<f64>() / self.rows(c).count() as f64).ln()
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
