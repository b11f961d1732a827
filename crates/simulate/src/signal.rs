//! Sampled signals and what they do between their samples.

use std::sync::Arc;

use greybox_model::Hold;

/// Oversampling of the band-limited interpolation.
pub const FINE: usize = 8;

/// A uniformly sampled input signal with its hold.
#[derive(Debug, Clone)]
pub struct Signal {
    hold: Hold,
    /// Samples of the grid per second.
    rate: f64,
    /// Samples; for a band-limited signal [`FINE`] times denser.
    grid: Arc<[f64]>,
}

impl Signal {
    /// A signal of `samples` every `dt` seconds. `samples` must be finite and not empty; `fine`
    /// gives the band-limited signal on a [`FINE`] times denser grid (length `(n-1)*FINE + 1`),
    /// which only [`Hold::BandLimited`] uses.
    pub fn new(hold: Hold, dt: f64, samples: &[f64], fine: impl FnOnce(&[f64]) -> Vec<f64>) -> Signal {
        match hold {
            Hold::BandLimited if samples.len() > 1 => {
                Signal { hold, rate: FINE as f64 / dt, grid: fine(samples).into() }
            }
            _ => Signal { hold, rate: 1.0 / dt, grid: samples.into() },
        }
    }

    /// What it does between samples.
    pub fn hold(&self) -> Hold {
        self.hold
    }

    /// Value and slope at time `s` (seconds after the first sample). `inside` is a time within the
    /// same smooth stretch as `s` (the middle of the integration step): it decides which side of a
    /// sample's jump or kink is meant. Before the first sample the first value holds, after the
    /// last the last.
    #[inline]
    pub fn at(&self, s: f64, inside: f64) -> (f64, f64) {
        self.piece(inside).at(s)
    }

    /// The smooth stretch that time `inside` lies in.
    #[inline]
    pub(crate) fn piece(&self, inside: f64) -> Piece {
        let g = &self.grid;
        let last = g.len() - 1;
        let place = inside * self.rate;
        let constant = |value: f64| Piece { c: [value, 0.0, 0.0, 0.0], k: 0.0, rate: 0.0 };
        if place < 0.0 {
            return constant(g[0]);
        }
        let k = place as usize;
        if k >= last {
            return constant(g[last]);
        }
        let (b, c) = (g[k], g[k + 1]);
        let c = match self.hold {
            Hold::Zero => return constant(b),
            Hold::Linear => [b, c - b, 0.0, 0.0],
            Hold::BandLimited => {
                // Cubic Lagrange on the four neighbours of the dense grid.
                let a = if k > 0 { g[k - 1] } else { 2.0 * b - c };
                let d = if k + 2 <= last { g[k + 2] } else { 2.0 * c - b };
                [b, c - a / 3.0 - b / 2.0 - d / 6.0, 0.5 * (a + c) - b, (d - a) / 6.0 + 0.5 * (b - c)]
            }
        };
        Piece { c, k: k as f64, rate: self.rate }
    }

    /// The parabola that stands for the signal over `intervals` samples from `sample` on: `fit` gives its coefficients, in
    /// powers of the grid's intervals that have passed, for the values of the grid there.
    pub(crate) fn parabola(
        &self,
        sample: usize,
        intervals: usize,
        fit: impl FnOnce(&[f64]) -> [f64; 3],
    ) -> Piece {
        let denser = if self.hold == Hold::BandLimited { FINE } else { 1 };
        let last = self.grid.len() - 1;
        let (from, to) = ((sample * denser).min(last), ((sample + intervals) * denser).min(last));
        let [c0, c1, c2] = fit(&self.grid[from..=to]);
        Piece { c: [c0, c1, c2, 0.0], k: from as f64, rate: self.rate }
    }
}

/// A signal within one smooth stretch: a cubic in time over the grid's interval.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Piece {
    c: [f64; 4],
    /// Where the stretch begins, and samples per second.
    k: f64,
    rate: f64,
}

impl Piece {
    /// Value and slope at time `s`.
    #[inline(always)]
    pub(crate) fn at(&self, s: f64) -> (f64, f64) {
        let [c0, c1, c2, c3] = self.c;
        let x = s * self.rate - self.k;
        (c0 + x * (c1 + x * (c2 + x * c3)), (c1 + x * (2.0 * c2 + 3.0 * x * c3)) * self.rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_hold_does_what_it_says() {
        let u = [1.0, 3.0, 2.0];
        let none = |_: &[f64]| unreachable!();
        let zero = Signal::new(Hold::Zero, 0.5, &u, none);
        assert_eq!(zero.at(0.5, 0.25), (1.0, 0.0)); // left of the jump
        assert_eq!(zero.at(0.5, 0.75), (3.0, 0.0)); // right of it
        let linear = Signal::new(Hold::Linear, 0.5, &u, none);
        assert_eq!(linear.at(0.25, 0.25), (2.0, 4.0));
        assert_eq!(linear.at(-1.0, -1.0), (1.0, 0.0));
        assert_eq!(linear.at(9.0, 9.0), (2.0, 0.0));
        // A cubic on the dense grid is reproduced exactly, value and slope.
        let cubic = |t: f64| 1.0 - t + 2.0 * t * t - 0.5 * t * t * t;
        let fine =
            Signal::new(Hold::BandLimited, 0.5, &u, |_| (0..=16).map(|i| cubic(i as f64 * 0.0625)).collect());
        let (v, slope) = fine.at(0.3, 0.3);
        assert!((v - cubic(0.3)).abs() < 1e-13);
        assert!((slope - (-1.0 + 4.0 * 0.3 - 1.5 * 0.09)).abs() < 1e-11);
    }
}
