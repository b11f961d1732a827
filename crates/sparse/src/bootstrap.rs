//! Bootstrap of a sparse regression: how sure are its terms and coefficients (thesis §3.2.3, Eq 3.18).

use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::SparseError;
use crate::design::{Design, count};
use crate::gram::{Gram, Sample};
use crate::lasso::support;
use crate::select::Selector;

/// What is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Resampling {
    /// Single rows with replacement, `ratio` times as many as there are (thesis Algorithm 2: 0.5). On correlated
    /// rows the spread it gives is far too small; there use [`Resampling::Blocks`].
    Rows {
        /// Drawn rows over all rows, in (0, 1].
        ratio: f64,
    },
    /// Blocks of `length` consecutive rows with replacement until the number of rows is reached (moving blocks
    /// that start at multiples of a quarter of the length, so that Gram matrices of the quarters serve all).
    Blocks {
        /// Rows of a block: several times the correlation length of the residual.
        length: usize,
    },
    /// Half of the non-overlapping blocks of `length` rows, without replacement: stability selection
    /// (Meinshausen, Bühlmann 2010, doi:10.1111/j.1467-9868.2010.00740.x).
    HalfOfBlocks {
        /// Rows of a block.
        length: usize,
    },
}

/// How the penalty of a replicate is chosen.
#[derive(Debug, Clone, PartialEq)]
pub enum Penalty {
    /// This one.
    Fixed(f64),
    /// From a grid, the one with the smallest error on these rows (thesis Eq 3.16); of equal ones the sparser.
    Validated {
        /// Values to try.
        grid: Vec<f64>,
        /// Validation rows, not among the resampled ones.
        rows: Vec<Range<usize>>,
    },
}

/// Result of [`bootstrap`].
#[derive(Debug, Clone, PartialEq)]
pub struct Bootstrap {
    /// Coefficients of every replicate.
    pub replicates: Vec<Vec<f64>>,
    /// Share of the replicates that hold the column.
    pub inclusion: Vec<f64>,
    /// Mean coefficient over all replicates (thesis Eq 3.18).
    pub mean: Vec<f64>,
    /// Standard deviation over the replicates.
    pub deviation: Vec<f64>,
}

impl Bootstrap {
    /// Percentile interval of column j at `level` (for instance 0.95); `None` when the column does not exist.
    #[must_use]
    pub fn interval(&self, j: usize, level: f64) -> Option<(f64, f64)> {
        let mut values: Vec<f64> = self.replicates.iter().filter_map(|c| c.get(j).copied()).collect();
        values.sort_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        let at = |q: f64| values[((q.clamp(0.0, 1.0) * last as f64).round() as usize).min(last)];
        Some((at((1.0 - level) / 2.0), at((1.0 + level) / 2.0)))
    }
}

/// Fit `replicates` resamples of `rows` with a selector on the first `columns` columns. Replicate r draws from its
/// own stream seeded by `seed` and r, so the result does not depend on the number of threads.
///
/// # Errors
/// Those of the selector; [`SparseError::Option`] for a ratio outside (0, 1] or no replicates;
/// [`SparseError::Folds`] when fewer than two blocks fit into the rows.
#[allow(clippy::too_many_arguments)]
pub fn bootstrap(
    design: &Design<'_>,
    rows: &[Range<usize>],
    columns: usize,
    selector: Selector,
    penalty: &Penalty,
    protected: &[usize],
    resampling: Resampling,
    replicates: usize,
    seed: u64,
) -> Result<Bootstrap, SparseError> {
    design.check_rows(rows)?;
    if replicates == 0 {
        return Err(SparseError::Option { name: "replicates", value: 0.0, expected: "at least 1" });
    }
    let plan = Plan::new(design, rows, resampling)?;
    let (grid, validation) = match penalty {
        Penalty::Fixed(lambda) => (vec![*lambda], None),
        Penalty::Validated { grid, rows } => (grid.clone(), Some(Sample::new(design, rows)?)),
    };
    let drawn: Result<Vec<Vec<f64>>, SparseError> = (0..replicates)
        .into_par_iter()
        .map(|r| {
            let stream = (r as u64).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let mut random = Pcg64Mcg::seed_from_u64(seed ^ stream);
            let sample = plan.draw(design, &mut random);
            let path = selector.path(&sample, columns, &grid, protected)?;
            let error = |c: &Vec<f64>| validation.as_ref().map_or(0.0, |v| v.rss(c));
            let best = path
                .into_iter()
                .map(|c| (error(&c), support(&c).len(), c))
                .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            Ok(best.map_or_else(|| vec![0.0; columns], |b| b.2))
        })
        .collect();
    let drawn = drawn?;
    let count = drawn.len() as f64;
    let over = |f: &dyn Fn(usize, f64) -> f64| -> Vec<f64> {
        (0..columns).map(|j| drawn.iter().map(|c| f(j, c[j])).sum::<f64>()).collect()
    };
    let mean: Vec<f64> = over(&|_, c| c).iter().map(|s| s / count).collect();
    let square = over(&|j, c| (c - mean[j]).powi(2));
    let deviation = square.iter().map(|s| (s / (count - 1.0).max(1.0)).sqrt()).collect();
    let inclusion = over(&|_, c| f64::from(u8::from(c != 0.0))).iter().map(|s| s / count).collect();
    Ok(Bootstrap { inclusion, mean, deviation, replicates: drawn })
}

/// Pieces of the rows with their Gram matrices, computed once.
struct Plan {
    resampling: Resampling,
    rows: Vec<Range<usize>>,
    tiles: Vec<(Range<usize>, Gram)>,
    /// First tiles of the blocks.
    starts: Vec<usize>,
}

/// Tiles of a moving block.
const TILES: usize = 4;

impl Plan {
    fn new(design: &Design<'_>, rows: &[Range<usize>], resampling: Resampling) -> Result<Self, SparseError> {
        let mut plan = Self { resampling, rows: rows.to_vec(), tiles: Vec::new(), starts: Vec::new() };
        let (length, per_block) = match resampling {
            Resampling::Rows { ratio } if ratio > 0.0 && ratio <= 1.0 => return Ok(plan),
            Resampling::Rows { ratio } => {
                return Err(SparseError::Option { name: "ratio", value: ratio, expected: "in (0, 1]" });
            }
            Resampling::Blocks { length } => (length.div_ceil(TILES), TILES),
            Resampling::HalfOfBlocks { length } => (length, 1),
        };
        for range in rows {
            let tiles = range.len().checked_div(length).unwrap_or(0);
            let first = plan.tiles.len();
            for t in 0..tiles {
                let tile = range.start + t * length..range.start + (t + 1) * length;
                plan.tiles.push((tile.clone(), Gram::new(design, &[tile])));
            }
            plan.starts.extend((0..(tiles + 1).saturating_sub(per_block)).map(|s| first + s));
        }
        if plan.starts.len() < 2 {
            return Err(SparseError::Folds { rows: count(rows), folds: 2, gap: 0 });
        }
        Ok(plan)
    }

    fn draw<'a>(&self, design: &'a Design<'a>, random: &mut Pcg64Mcg) -> Sample<'a> {
        match self.resampling {
            Resampling::Rows { ratio } => {
                let all: Vec<usize> = self.rows.iter().cloned().flatten().collect();
                let mut held = vec![0u32; all.len()];
                for _ in 0..((ratio * all.len() as f64).ceil() as usize) {
                    held[random.random_range(0..all.len())] += 1;
                }
                let pieces: Vec<_> = all
                    .iter()
                    .zip(&held)
                    .filter(|(_, h)| **h > 0)
                    .map(|(&row, &h)| (row..row + 1, f64::from(h)))
                    .collect();
                let gram = Gram::weighted(design, &pieces);
                Sample::from_weighted(design, pieces, gram)
            }
            Resampling::Blocks { .. } => {
                let blocks = (self.tiles.len() / TILES).max(1);
                let mut held = vec![0u32; self.tiles.len()];
                for _ in 0..blocks {
                    let start = self.starts[random.random_range(0..self.starts.len())];
                    held[start..start + TILES].iter_mut().for_each(|h| *h += 1);
                }
                self.assemble(design, &held)
            }
            Resampling::HalfOfBlocks { .. } => {
                let mut order: Vec<usize> = (0..self.tiles.len()).collect();
                for i in (1..order.len()).rev() {
                    order.swap(i, random.random_range(0..=i));
                }
                let mut held = vec![0u32; self.tiles.len()];
                order[..self.tiles.len() / 2].iter().for_each(|&t| held[t] = 1);
                self.assemble(design, &held)
            }
        }
    }

    fn assemble<'a>(&self, design: &'a Design<'a>, held: &[u32]) -> Sample<'a> {
        let chosen = || self.tiles.iter().zip(held).filter(|(_, h)| **h > 0);
        let pieces: Vec<_> = chosen().map(|((r, _), h)| (r.clone(), f64::from(*h))).collect();
        let mut gram: Option<Gram> = None;
        for ((_, g), h) in chosen() {
            match &mut gram {
                Some(sum) => sum.add(g, f64::from(*h)),
                None => gram = Some(g.scaled(f64::from(*h))),
            }
        }
        let gram = gram.unwrap_or_else(|| Gram::weighted(design, &pieces));
        Sample::from_weighted(design, pieces, gram)
    }
}
