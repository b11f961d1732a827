//! Bootstrap of a sparse model: inclusion probabilities, standard deviations, intervals.
//!
//! Rows of one recording are correlated, so drawing single rows (thesis Algorithm 2) understates the spread by
//! far; blocks of rows longer than the correlation keep it. Blocks are drawn from Gram matrices computed once,
//! so a replicate costs no pass over the rows.
//!
//! Every replicate has its own random stream, so the result does not depend on threads.
//!
//! References: Künsch, Ann. Statist. 17 (1989) (moving blocks); Politis & Romano (1992) (circular blocks);
//! Meinshausen & Bühlmann, J. R. Statist. Soc. B 72 (2010) (stability selection).

use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::error::{SparseError, check_range};
use crate::gram::{BlockGram, Gram};
use crate::rows::{Rows, check_ranges, count};
use crate::select::{Options, Problem, Search, Selector, path};
use crate::triangle::Triangle;

/// Cells per block: block starts lie on this fraction of the block length.
const CELLS: usize = 4;

/// How a replicate draws its rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Resample {
    /// Blocks of `length` consecutive rows of one piece, starting on a grid of a quarter of the length, until
    /// the number of rows is reached. Circular blocks run on from a piece's end to its start, so that rows at
    /// the ends are drawn as often as the others. A piece shorter than a block is one block.
    Blocks {
        /// Rows per block; longer than the correlation of the residuals.
        length: usize,
        /// Whether blocks wrap around the ends of a piece.
        circular: bool,
    },
    /// Single rows with replacement, `ratio` of their number (thesis Algorithm 2: one half). Too optimistic
    /// for correlated rows.
    Rows {
        /// Rows drawn per row there is, in (0, 1].
        ratio: f64,
    },
}

/// Settings of [`bootstrap`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BootstrapOptions {
    /// Number of replicates.
    pub replicates: usize,
    /// How rows are drawn.
    pub resample: Resample,
    /// Probability inside the percentile interval, in (0, 1).
    pub coverage: f64,
    /// Seed; replicate i uses a stream of its own made of the seed and i.
    pub seed: u64,
}

impl Default for BootstrapOptions {
    /// 200 replicates of circular blocks of 200 rows, 95 % intervals.
    fn default() -> Self {
        Self {
            replicates: 200,
            resample: Resample::Blocks { length: 200, circular: true },
            coverage: 0.95,
            seed: 0,
        }
    }
}

/// The spread of a sparse model over the replicates; one entry per column everywhere.
#[derive(Debug, Clone, PartialEq)]
pub struct Bootstrap {
    /// Fraction of the replicates whose model holds the column.
    pub inclusion: Vec<f64>,
    /// Mean coefficient (zero where a replicate leaves the column out: thesis Algorithm 2 line 17).
    pub mean: Vec<f64>,
    /// Standard deviation of the coefficient.
    pub deviation: Vec<f64>,
    /// Percentile interval of the coefficient.
    pub interval: Vec<(f64, f64)>,
    /// The coefficients of every replicate.
    pub replicates: Vec<Vec<f64>>,
}

impl Bootstrap {
    /// Columns included with at least this probability (stability selection).
    #[must_use]
    pub fn stable(&self, probability: f64) -> Vec<usize> {
        (0..self.inclusion.len()).filter(|&j| self.inclusion[j] >= probability).collect()
    }
}

/// Refits a sparse model on resampled rows of the pieces `ranges`. With [`Selector::StlsqRaw`] and λ = 0 all
/// columns given are refitted: the spread of a fixed model.
///
/// # Errors
/// [`SparseError::Option`] for bad settings, [`SparseError::RowRange`], [`SparseError::TooFewRows`] if a row
/// set is smaller than a block, and those of the selector.
pub fn bootstrap(
    rows: &Rows<'_>,
    ranges: &[Range<usize>],
    protected: &[usize],
    selector: Selector,
    lambda: f64,
    options: &BootstrapOptions,
) -> Result<Bootstrap, SparseError> {
    check_ranges(ranges, rows.rows())?;
    check_range("bootstrap coverage", options.coverage, f64::MIN_POSITIVE, 1.0 - f64::EPSILON, "in (0, 1)")?;
    if options.replicates == 0 {
        return Err(SparseError::Empty { what: "bootstrap replicates" });
    }
    let sampler = Sampler::new(rows, ranges, options.resample)?;
    let replicates: Vec<Vec<f64>> = (0..options.replicates)
        .into_par_iter()
        .map(|i| {
            let triangle = sampler.draw(rows, &mut stream(options.seed, i as u64))?;
            let fit = path(selector, &triangle, protected, &[lambda])?.pop();
            Ok(fit.ok_or(SparseError::Empty { what: "values of λ" })?.coefficients)
        })
        .collect::<Result<_, SparseError>>()?;
    Ok(summary(replicates, rows.columns(), options.coverage))
}

/// [`bootstrap`] of the chosen model of a search: its order's columns, its selector and its λ, on the training
/// rows. The entries cover all columns of the problem; those outside the order are never included.
///
/// # Errors
/// As [`bootstrap`].
pub fn stability(
    problem: &Problem<'_>,
    settings: &Options,
    found: &Search,
    options: &BootstrapOptions,
) -> Result<Bootstrap, SparseError> {
    let model = found.model();
    let rows = problem.rows().first_columns(model.candidates);
    let mut out = bootstrap(
        &rows,
        &problem.split().train,
        problem.protected(),
        settings.selector,
        model.lambda(),
        options,
    )?;
    let columns = problem.rows().columns();
    for list in [&mut out.inclusion, &mut out.mean, &mut out.deviation] {
        list.resize(columns, 0.0);
    }
    out.interval.resize(columns, (0.0, 0.0));
    for replicate in &mut out.replicates {
        replicate.resize(columns, 0.0);
    }
    Ok(out)
}

/// A generator for one replicate: seed and number pass through SplitMix64, so that streams do not overlap.
fn stream(seed: u64, replicate: u64) -> Pcg64Mcg {
    let mix = |mut z: u64| {
        z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    Pcg64Mcg::seed_from_u64(mix(mix(seed) ^ replicate))
}

/// What replicates are drawn from.
enum Sampler {
    /// Cells, and for every possible block the cells in it.
    Blocks { cells: BlockGram, ranges: Vec<Range<usize>>, blocks: Vec<Vec<usize>>, rows: usize },
    /// The row numbers, and how many of them to draw.
    Rows { rows: Vec<usize>, draws: usize },
}

impl Sampler {
    fn new(rows: &Rows<'_>, ranges: &[Range<usize>], resample: Resample) -> Result<Self, SparseError> {
        match resample {
            Resample::Rows { ratio } => {
                check_range("bootstrap ratio", ratio, f64::MIN_POSITIVE, 1.0, "in (0, 1]")?;
                let all: Vec<usize> = ranges.iter().cloned().flatten().collect();
                let draws = ((ratio * all.len() as f64).round() as usize).max(1);
                Ok(Self::Rows { rows: all, draws })
            }
            Resample::Blocks { length, circular } => {
                let total = count(ranges);
                if length == 0 || 2 * length > total {
                    return Err(SparseError::Option {
                        name: "bootstrap block length",
                        found: length as f64,
                        expected: "at least 1 and at most half of the rows",
                    });
                }
                let cell = length.div_ceil(CELLS);
                let mut cells: Vec<Range<usize>> = Vec::new();
                let mut blocks: Vec<Vec<usize>> = Vec::new();
                for piece in ranges {
                    let first = cells.len();
                    cells.extend(
                        piece.clone().step_by(cell).map(|start| start..(start + cell).min(piece.end)),
                    );
                    let own = cells.len() - first;
                    let per_block = length.div_ceil(cell).min(own);
                    let starts = if circular && own > per_block { own } else { own - per_block + 1 };
                    blocks.extend((0..starts).map(|s| (s..s + per_block).map(|c| first + c % own).collect()));
                }
                Ok(Self::Blocks {
                    cells: BlockGram::of_rows(rows, &cells)?,
                    ranges: cells,
                    blocks,
                    rows: total,
                })
            }
        }
    }

    /// The factor of one resampled set of rows; from the Gram matrix, or by QR if that is ill-conditioned.
    fn draw(&self, rows: &Rows<'_>, rng: &mut Pcg64Mcg) -> Result<Triangle, SparseError> {
        match self {
            Self::Blocks { cells, ranges, blocks, rows: total } => {
                let mut drawn: Vec<usize> = Vec::new();
                let mut found = 0;
                while found < *total {
                    for &cell in &blocks[rng.random_range(0..blocks.len())] {
                        found += ranges[cell].end - ranges[cell].start;
                        drawn.push(cell);
                    }
                }
                factor(&cells.sum(drawn.iter().copied()), || {
                    let factors: Vec<Triangle> = drawn
                        .iter()
                        .map(|&c| Triangle::of_rows(rows, std::slice::from_ref(&ranges[c])))
                        .collect::<Result<_, _>>()?;
                    Triangle::stacked(&factors.iter().collect::<Vec<_>>())
                })
            }
            Self::Rows { rows: numbers, draws } => {
                let mut weights = vec![0_u32; rows.rows()];
                for _ in 0..*draws {
                    weights[numbers[rng.random_range(0..numbers.len())]] += 1;
                }
                factor(&Gram::of_weighted_rows(rows, &weights)?, || weighted_triangle(rows, &weights))
            }
        }
    }
}

fn factor(
    gram: &Gram,
    by_rows: impl FnOnce() -> Result<Triangle, SparseError>,
) -> Result<Triangle, SparseError> {
    match Triangle::of_gram(gram) {
        Err(SparseError::IllConditioned { .. }) => by_rows(),
        other => other,
    }
}

/// QR of the rows drawn, each times the root of how often it was.
fn weighted_triangle(rows: &Rows<'_>, weights: &[u32]) -> Result<Triangle, SparseError> {
    let scaled = |from: &[f64]| -> Vec<f64> {
        from.iter().zip(weights).filter(|&(_, &w)| w > 0).map(|(v, &w)| v * f64::from(w).sqrt()).collect()
    };
    let columns: Vec<Vec<f64>> = (0..rows.columns()).map(|j| scaled(rows.column(j))).collect();
    let target = scaled(rows.target());
    let rows = Rows::from_vecs(&columns, &target)?;
    let all = 0..target.len();
    Triangle::of_rows(&rows, std::slice::from_ref(&all))
}

fn summary(replicates: Vec<Vec<f64>>, columns: usize, coverage: f64) -> Bootstrap {
    let n = replicates.len() as f64;
    let mut out = Bootstrap {
        inclusion: Vec::with_capacity(columns),
        mean: Vec::with_capacity(columns),
        deviation: Vec::with_capacity(columns),
        interval: Vec::with_capacity(columns),
        replicates: Vec::new(),
    };
    for j in 0..columns {
        let mut values: Vec<f64> = replicates.iter().map(|r| r[j]).collect();
        let mean = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        out.inclusion.push(values.iter().filter(|v| **v != 0.0).count() as f64 / n);
        out.mean.push(mean);
        out.deviation.push(variance.sqrt());
        values.sort_by(f64::total_cmp);
        let tail = 0.5 * (1.0 - coverage);
        out.interval.push((quantile(&values, tail), quantile(&values, 1.0 - tail)));
    }
    out.replicates = replicates;
    out
}

/// Linear interpolation between order statistics (Hyndman & Fan's type 7); NaN without values.
fn quantile(sorted: &[f64], probability: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let at = probability.clamp(0.0, 1.0) * last as f64;
    let low = at.floor() as usize;
    let high = (low + 1).min(last);
    sorted[low] + (at - low as f64) * (sorted[high] - sorted[low])
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::testing::{ar1, normal};

    fn options(resample: Resample) -> BootstrapOptions {
        BootstrapOptions { replicates: 200, resample, coverage: 0.95, seed: 7 }
    }

    #[test]
    fn blocks_cover_on_correlated_rows_and_single_rows_do_not() {
        // y = 1·x + e with x and e both AR(1): the plain error is too small by √((1+φ²)/(1−φ²)) ≈ 3.
        let phi = 0.9;
        let (mut blocks_hit, mut rows_hit) = (0, 0);
        for seed in 0..40 {
            let n = 4000;
            let (x, e) = (ar1(n, phi, 2 * seed), ar1(n, phi, 2 * seed + 1));
            let y: Vec<f64> = x.iter().zip(&e).map(|(x, e)| x + e).collect();
            let rows = Rows::new(&[&x], &y).unwrap();
            let run = |resample| {
                let found =
                    bootstrap(&rows, &[0..n], &[0], Selector::StlsqRaw, 0.0, &options(resample)).unwrap();
                let (low, high) = found.interval[0];
                usize::from(low <= 1.0 && 1.0 <= high)
            };
            blocks_hit += run(Resample::Blocks { length: 100, circular: true });
            rows_hit += run(Resample::Rows { ratio: 1.0 });
        }
        assert!(blocks_hit >= 34, "blocks: {blocks_hit} of 40");
        assert!(rows_hit <= 28, "rows: {rows_hit} of 40");
    }

    #[test]
    fn independent_rows_give_the_textbook_deviation() {
        let n = 2000;
        let (x, e) = (normal(n, 1), normal(n, 2));
        let y: Vec<f64> = x.iter().zip(&e).map(|(x, e)| 2.0 * x + e).collect();
        let rows = Rows::new(&[&x], &y).unwrap();
        let textbook = 1.0 / (n as f64).sqrt();
        for resample in [
            Resample::Rows { ratio: 1.0 },
            Resample::Blocks { length: 20, circular: true },
            Resample::Blocks { length: 20, circular: false },
        ] {
            let found = bootstrap(&rows, &[0..n], &[], Selector::StlsqRaw, 0.0, &options(resample)).unwrap();
            assert!(
                (found.deviation[0] / textbook - 1.0).abs() < 0.25,
                "{resample:?}: {}",
                found.deviation[0]
            );
            assert!((found.mean[0] - 2.0).abs() < 5.0 * textbook);
        }
        // Half the rows: √2 wider.
        let half = options(Resample::Rows { ratio: 0.5 });
        let found = bootstrap(&rows, &[0..n], &[], Selector::StlsqRaw, 0.0, &half).unwrap();
        assert!((found.deviation[0] / textbook / 2f64.sqrt() - 1.0).abs() < 0.25);
    }

    #[test]
    fn stability_selection_finds_the_true_terms() {
        let n = 1500;
        let columns: Vec<Vec<f64>> = (0..6).map(|j| ar1(n, 0.8, 50 + j)).collect();
        let e = ar1(n, 0.8, 99);
        let y: Vec<f64> = (0..n).map(|i| columns[1][i] - 0.7 * columns[4][i] + 0.5 * e[i]).collect();
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let resample = Resample::Blocks { length: 60, circular: true };
        let found =
            bootstrap(&rows, &[0..700, 700..n], &[], Selector::StlsqNormalised, 0.2, &options(resample))
                .unwrap();
        assert_eq!(found.stable(0.9), [1, 4]);
        let again =
            bootstrap(&rows, &[0..700, 700..n], &[], Selector::StlsqNormalised, 0.2, &options(resample))
                .unwrap();
        assert_eq!(found, again);
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let serial = one.install(|| {
            bootstrap(&rows, &[0..700, 700..n], &[], Selector::StlsqNormalised, 0.2, &options(resample))
                .unwrap()
        });
        assert_eq!(found, serial);
    }

    #[test]
    fn ill_conditioned_columns_fall_back_to_qr() {
        let n = 400;
        let x = normal(n, 3);
        let near: Vec<f64> = x.iter().zip(normal(n, 4)).map(|(x, e)| x + 1e-6 * e).collect();
        let y: Vec<f64> = (0..n).map(|i| x[i] + near[i]).collect();
        let rows = Rows::new(&[&x, &near], &y).unwrap();
        for resample in [Resample::Rows { ratio: 0.5 }, Resample::Blocks { length: 20, circular: false }] {
            let mut o = options(resample);
            o.replicates = 10;
            let found = bootstrap(&rows, &[0..n], &[], Selector::StlsqRaw, 0.0, &o).unwrap();
            assert!((found.mean[0] - 1.0).abs() < 1e-6 && (found.mean[1] - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn circular_blocks_hold_every_cell_equally_often_and_stay_in_their_piece() {
        let x = normal(100, 3);
        let rows = Rows::new(&[&x], &x).unwrap();
        let pieces = [0..64, 64..70, 70..100];
        for circular in [true, false] {
            let resample = Resample::Blocks { length: 16, circular };
            let Sampler::Blocks { ranges, blocks, .. } = Sampler::new(&rows, &pieces, resample).unwrap()
            else {
                panic!("blocks were asked for");
            };
            assert_eq!(ranges.len(), 16 + 2 + 8);
            let held = |cell: usize| blocks.iter().filter(|b| b.contains(&cell)).count();
            for (cell, range) in ranges.iter().enumerate() {
                let short = (64..70).contains(&range.start);
                let expected = if short { 1 } else { 4 };
                if circular || short {
                    assert_eq!(held(cell), expected, "cell {cell}");
                }
            }
            assert_eq!(held(0), if circular { 4 } else { 1 });
            for block in &blocks {
                let piece = |c: usize| pieces.iter().position(|p| p.contains(&ranges[c].start));
                assert!(block.iter().all(|&c| piece(c) == piece(block[0])));
            }
        }
    }

    #[test]
    fn bad_settings_are_errors() {
        let x = normal(30, 3);
        let rows = Rows::new(&[&x], &x).unwrap();
        let run = |o: &BootstrapOptions| bootstrap(&rows, &[0..30], &[], Selector::StlsqRaw, 0.0, o);
        assert!(run(&options(Resample::Blocks { length: 0, circular: true })).is_err());
        assert!(run(&options(Resample::Blocks { length: 16, circular: true })).is_err());
        assert!(run(&options(Resample::Rows { ratio: 0.0 })).is_err());
        let mut o = options(Resample::Rows { ratio: 0.5 });
        o.replicates = 0;
        assert!(matches!(run(&o), Err(SparseError::Empty { .. })));
        o.replicates = 1;
        o.coverage = 1.0;
        assert!(matches!(run(&o), Err(SparseError::Option { .. })));
    }
}
