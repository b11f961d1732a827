//! Bootstrap of a sparse model: inclusion probabilities, standard deviations, intervals.
//!
//! Rows of one recording are correlated, so drawing single rows (thesis Algorithm 2) understates the spread by
//! far; blocks of rows longer than the correlation keep it. Blocks are drawn from Gram matrices computed once,
//! so a replicate costs no pass over the rows.
//!
//! The spread of a model whose λ was searched is wider than that of the same search with its λ held fixed.
//! [`Penalty`] says whether every replicate repeats the search (Algorithm 2 lines 7–11) and on which rows.
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
use crate::folds::minimum;
use crate::gram::{BlockGram, Gram};
use crate::protect::checked;
use crate::rows::{Rows, check_ranges, count};
use crate::select::{Options, Problem, Search, Selector, held_out_errors, ordered_grid, path};
use crate::triangle::{Fit, Triangle};

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

/// How a replicate finds its path parameter (λ, or the number of columns kept). A search takes the value with
/// the least mean square error on rows that the replicate was not fitted to, of equal ones the sparsest. It
/// ignores its grid for [`Selector::Backward`] and [`Selector::BestSubset`], which try every size.
#[derive(Debug, Clone, PartialEq)]
pub enum Penalty {
    /// The same for all replicates.
    Fixed(f64),
    /// The best of `grid` on the rows in `ranges`, the same for all replicates: thesis Algorithm 2 with Eq 3.16.
    /// Where these rows are a recording of their own, the search is as honest as it can be.
    Validated {
        /// The λ to try, in any order.
        grid: Vec<f64>,
        /// Rows to judge by, none of them among those that are drawn.
        ranges: Vec<Range<usize>>,
    },
    /// The best of `grid` on the rows that the replicate did not draw (out of bag: some 37 % of them where as
    /// many are drawn as there are). Cross-validation inside a replicate would judge by copies of rows it was
    /// fitted to; this does not. Single rows left out are all but known from their neighbours, so correlated rows
    /// need [`Resample::Blocks`] here too.
    LeftOut {
        /// The λ to try, in any order.
        grid: Vec<f64>,
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
    /// The path parameter of every replicate.
    pub lambdas: Vec<f64>,
}

impl Bootstrap {
    /// Columns included with at least this probability (stability selection).
    #[must_use]
    pub fn stable(&self, probability: f64) -> Vec<usize> {
        (0..self.inclusion.len()).filter(|&j| self.inclusion[j] >= probability).collect()
    }
}

/// Refits a sparse model on resampled rows of the pieces `ranges`, λ fixed or searched anew in every replicate.
/// With [`Selector::StlsqRaw`] and `Penalty::Fixed(0.0)` all columns given are refitted: the spread of a fixed
/// model.
///
/// # Errors
/// [`SparseError::Option`] for bad settings; [`SparseError::NoSuchColumn`]; [`SparseError::RowRange`], also for
/// validation rows among those that are drawn; [`SparseError::Empty`] for an empty grid;
/// [`SparseError::TooFewRows`] if a replicate leaves out no row to judge by; [`SparseError::Overflow`]; and those
/// of the selector.
///
/// ```
/// use greybox_sparse::bootstrap::{BootstrapOptions, Penalty, Resample, bootstrap};
/// use greybox_sparse::{Rows, Selector, select::logspace};
/// // y = 2a, b a nuisance; every replicate searches its λ on the rows it left out.
/// let a: Vec<f64> = (0..400).map(|i| (0.3 * f64::from(i)).sin()).collect();
/// let b: Vec<f64> = (0..400).map(|i| (0.7 * f64::from(i)).cos()).collect();
/// let y: Vec<f64> = (0..400).map(|i| 2.0 * a[i] + 0.01 * (12.9898 * (i * i) as f64).sin()).collect();
/// let penalty = Penalty::LeftOut { grid: logspace(1e-3, 1.0, 20) };
/// let resample = Resample::Blocks { length: 20, circular: true };
/// let options = BootstrapOptions { replicates: 50, resample, ..BootstrapOptions::default() };
/// let rows = Rows::new(&[&a, &b], &y)?;
/// let found = bootstrap(&rows, &[0..400], &[], Selector::StlsqRaw, &penalty, &options)?;
/// assert_eq!(found.inclusion[0], 1.0);
/// assert!(found.inclusion[1] < 0.5 && (found.mean[0] - 2.0).abs() < 0.01);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
pub fn bootstrap(
    rows: &Rows<'_>,
    ranges: &[Range<usize>],
    protected: &[usize],
    selector: Selector,
    penalty: &Penalty,
    options: &BootstrapOptions,
) -> Result<Bootstrap, SparseError> {
    check_ranges(ranges, rows.rows())?;
    check_range("bootstrap coverage", options.coverage, f64::MIN_POSITIVE, 1.0 - f64::EPSILON, "in (0, 1)")?;
    if options.replicates == 0 {
        return Err(SparseError::Empty { what: "bootstrap replicates" });
    }
    let protected = &checked(protected, rows.columns())?;
    let judge = Judge::new(rows, ranges, protected.len(), selector, penalty)?;
    let sampler = Sampler::new(rows, ranges, options.resample)?;
    let replicates: Vec<(f64, Vec<f64>)> = (0..options.replicates)
        .into_par_iter()
        .map(|i| {
            let draw = sampler.draw(&mut stream(options.seed, i as u64));
            let fits = path(selector, &sampler.factor(rows, &draw)?, protected, &judge.grid)?;
            let best = match &judge.rows {
                JudgeRows::None => Some(0),
                JudgeRows::Same(held) => best(held, &fits),
                JudgeRows::LeftOut => best(&sampler.left_out(rows, ranges, &draw, i)?, &fits),
            };
            let chosen =
                best.and_then(|b| Some((*judge.grid.get(b)?, fits.into_iter().nth(b)?.coefficients)));
            chosen.ok_or(SparseError::Overflow)
        })
        .collect::<Result<_, SparseError>>()?;
    let (lambdas, coefficients) = replicates.into_iter().unzip();
    Ok(summary(coefficients, lambdas, rows.columns(), options.coverage))
}

/// Index of the fit with the least error on the held-out rows, the sparsest of equal ones.
fn best(held: &Triangle, fits: &[Fit]) -> Option<usize> {
    minimum(&held_out_errors(held, fits))
}

/// A checked [`Penalty`].
struct Judge {
    /// From the densest model to the sparsest.
    grid: Vec<f64>,
    rows: JudgeRows,
}

/// The rows that decide between the values of a grid.
enum JudgeRows {
    /// The grid has one value.
    None,
    /// Factorised once for all replicates.
    Same(Triangle),
    /// Those that a replicate did not draw.
    LeftOut,
}

impl Judge {
    fn new(
        rows: &Rows<'_>,
        drawn: &[Range<usize>],
        protected: usize,
        selector: Selector,
        penalty: &Penalty,
    ) -> Result<Self, SparseError> {
        let ordered = |grid: &[f64]| ordered_grid(selector, grid, rows.columns(), protected);
        Ok(match penalty {
            Penalty::Fixed(lambda) => Self { grid: vec![*lambda], rows: JudgeRows::None },
            Penalty::Validated { grid, ranges } => {
                let mut both = [drawn, ranges].concat();
                both.sort_by_key(|r| r.start);
                check_ranges(&both, rows.rows())?;
                Self { grid: ordered(grid)?, rows: JudgeRows::Same(Triangle::of_rows(rows, ranges)?) }
            }
            Penalty::LeftOut { grid } => Self { grid: ordered(grid)?, rows: JudgeRows::LeftOut },
        })
    }
}

/// [`bootstrap`] of the chosen model of a search: its order's columns, its selector and its λ held fixed, on the
/// training rows. The entries cover all columns of the problem; those outside the order are never included.
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
        &Penalty::Fixed(model.lambda()),
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

    /// How often one replicate holds every cell, or every row.
    fn draw(&self, rng: &mut Pcg64Mcg) -> Vec<u32> {
        match self {
            Self::Blocks { ranges, blocks, rows: total, .. } => {
                let mut held = vec![0_u32; ranges.len()];
                let mut found = 0;
                while found < *total {
                    for &cell in &blocks[rng.random_range(0..blocks.len())] {
                        found += ranges[cell].end - ranges[cell].start;
                        held[cell] += 1;
                    }
                }
                held
            }
            Self::Rows { rows: numbers, draws } => {
                let mut held = vec![0_u32; numbers.last().map_or(0, |last| last + 1)];
                for _ in 0..*draws {
                    held[numbers[rng.random_range(0..numbers.len())]] += 1;
                }
                held
            }
        }
    }

    /// The factor of one draw; from the Gram matrix, or by QR if that is ill-conditioned.
    fn factor(&self, rows: &Rows<'_>, held: &[u32]) -> Result<Triangle, SparseError> {
        match self {
            Self::Blocks { cells, ranges, .. } => {
                let drawn = || held.iter().enumerate().flat_map(|(c, &h)| (0..h).map(move |_| c));
                factor(&cells.sum(drawn()), || {
                    let factors: Vec<Triangle> = drawn()
                        .map(|c| Triangle::of_rows(rows, std::slice::from_ref(&ranges[c])))
                        .collect::<Result<_, _>>()?;
                    Triangle::stacked(&factors.iter().collect::<Vec<_>>())
                })
            }
            Self::Rows { .. } => {
                let mut weights = held.to_vec();
                weights.resize(rows.rows(), 0);
                factor(&Gram::of_weighted_rows(rows, &weights)?, || weighted_triangle(rows, &weights))
            }
        }
    }

    /// The factor of the rows of the pieces that a draw does not hold.
    fn left_out(
        &self,
        rows: &Rows<'_>,
        pieces: &[Range<usize>],
        held: &[u32],
        replicate: usize,
    ) -> Result<Triangle, SparseError> {
        let left: Vec<Range<usize>> = match self {
            Self::Blocks { ranges, .. } => {
                ranges.iter().zip(held).filter(|&(_, &h)| h == 0).map(|(r, _)| r.clone()).collect()
            }
            Self::Rows { .. } => {
                pieces.iter().cloned().flatten().filter(|&i| held[i] == 0).map(|i| i..i + 1).collect()
            }
        };
        if left.is_empty() {
            let what = format!("the rows left out of bootstrap replicate {replicate}");
            return Err(SparseError::TooFewRows { what, found: 0, needed: 1 });
        }
        Triangle::of_rows(rows, &left)
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

fn summary(replicates: Vec<Vec<f64>>, lambdas: Vec<f64>, columns: usize, coverage: f64) -> Bootstrap {
    let n = replicates.len() as f64;
    let mut out = Bootstrap {
        inclusion: Vec::with_capacity(columns),
        mean: Vec::with_capacity(columns),
        deviation: Vec::with_capacity(columns),
        interval: Vec::with_capacity(columns),
        replicates: Vec::new(),
        lambdas,
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
                let found = bootstrap(
                    &rows,
                    &[0..n],
                    &[0],
                    Selector::StlsqRaw,
                    &Penalty::Fixed(0.0),
                    &options(resample),
                )
                .unwrap();
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
            let found =
                bootstrap(&rows, &[0..n], &[], Selector::StlsqRaw, &Penalty::Fixed(0.0), &options(resample))
                    .unwrap();
            assert!(
                (found.deviation[0] / textbook - 1.0).abs() < 0.25,
                "{resample:?}: {}",
                found.deviation[0]
            );
            assert!((found.mean[0] - 2.0).abs() < 5.0 * textbook);
        }
        // Half the rows: √2 wider.
        let half = options(Resample::Rows { ratio: 0.5 });
        let found = bootstrap(&rows, &[0..n], &[], Selector::StlsqRaw, &Penalty::Fixed(0.0), &half).unwrap();
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
        let found = bootstrap(
            &rows,
            &[0..700, 700..n],
            &[],
            Selector::StlsqNormalised,
            &Penalty::Fixed(0.2),
            &options(resample),
        )
        .unwrap();
        assert_eq!(found.stable(0.9), [1, 4]);
        let again = bootstrap(
            &rows,
            &[0..700, 700..n],
            &[],
            Selector::StlsqNormalised,
            &Penalty::Fixed(0.2),
            &options(resample),
        )
        .unwrap();
        assert_eq!(found, again);
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let serial = one.install(|| {
            bootstrap(
                &rows,
                &[0..700, 700..n],
                &[],
                Selector::StlsqNormalised,
                &Penalty::Fixed(0.2),
                &options(resample),
            )
            .unwrap()
        });
        assert_eq!(found, serial);
    }

    /// Columns 1 and 4 of six count; the rest is correlated noise.
    fn six(n: usize, seed: u64) -> (Vec<Vec<f64>>, Vec<f64>) {
        let columns: Vec<Vec<f64>> = (0..6).map(|j| ar1(n, 0.8, seed + j)).collect();
        let e = ar1(n, 0.8, seed + 6);
        let y = (0..n).map(|i| columns[1][i] - 0.7 * columns[4][i] + 0.5 * e[i]).collect();
        (columns, y)
    }

    #[test]
    fn every_replicate_takes_the_best_of_the_grid_on_its_judges() {
        let (columns, y) = six(900, 300);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let grid = vec![0.5, 0.0, 0.1, 5.0, 0.02];
        for resample in [Resample::Rows { ratio: 0.5 }, Resample::Blocks { length: 60, circular: true }] {
            let mut o = options(resample);
            o.replicates = 20;
            let run = |penalty: &Penalty| {
                bootstrap(&rows, &[0..300, 300..600], &[], Selector::StlsqRaw, penalty, &o).unwrap()
            };
            // The replicates of a fixed λ are the same draws: the candidates, one row per λ.
            let fixed: Vec<Bootstrap> = grid.iter().map(|&l| run(&Penalty::Fixed(l))).collect();
            let validated = run(&Penalty::Validated { grid: grid.clone(), ranges: vec![600..900] });
            let rss = |c: &[f64]| rows.residuals(c, &[600..900]).iter().map(|r| r * r).sum::<f64>();
            for i in 0..o.replicates {
                let own = rss(&validated.replicates[i]);
                let best = fixed.iter().map(|f| rss(&f.replicates[i])).fold(f64::INFINITY, f64::min);
                assert!((own / best - 1.0).abs() < 1e-9, "{resample:?}, replicate {i}: {own} {best}");
                let at = grid.iter().position(|l| *l == validated.lambdas[i]).unwrap();
                assert_eq!(validated.replicates[i], fixed[at].replicates[i]);
            }
            // On the rows left out, by hand from the same draws.
            let sampler = Sampler::new(&rows, &[0..300, 300..600], resample).unwrap();
            let left_out = run(&Penalty::LeftOut { grid: grid.clone() });
            for i in 0..o.replicates {
                let held = sampler.draw(&mut stream(o.seed, i as u64));
                let left: Vec<usize> = match &sampler {
                    Sampler::Rows { .. } => (0..600).filter(|&r| held[r] == 0).collect(),
                    Sampler::Blocks { ranges, .. } => (0..600)
                        .filter(|r| ranges.iter().zip(&held).any(|(c, &h)| h == 0 && c.contains(r)))
                        .collect(),
                };
                assert!((30..500).contains(&left.len()), "{} rows left", left.len());
                let rss =
                    |c: &[f64]| left.iter().map(|&r| rows.residuals(c, &[r..r + 1])[0].powi(2)).sum::<f64>();
                let own = rss(&left_out.replicates[i]);
                let best = fixed.iter().map(|f| rss(&f.replicates[i])).fold(f64::INFINITY, f64::min);
                assert!((own / best - 1.0).abs() < 1e-9, "{resample:?}, replicate {i}: {own} {best}");
            }
            assert_ne!(left_out.lambdas, validated.lambdas);
            let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
            assert_eq!(left_out, one.install(|| run(&Penalty::LeftOut { grid: grid.clone() })));
        }
    }

    #[test]
    fn a_searched_penalty_keeps_the_true_terms_with_every_selector() {
        let (columns, y) = six(900, 400);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let mut o = options(Resample::Blocks { length: 60, circular: true });
        o.replicates = 30;
        for selector in
            [Selector::StlsqNormalised, Selector::LassoRefit, Selector::Backward, Selector::BestSubset]
        {
            let grid = crate::select::logspace(1e-3, 1.0, 15);
            for penalty in
                [Penalty::LeftOut { grid: grid.clone() }, Penalty::Validated { grid, ranges: vec![600..900] }]
            {
                let found = bootstrap(&rows, &[0..600], &[2], selector, &penalty, &o).unwrap();
                assert_eq!(found.stable(0.99), [1, 2, 4], "{selector:?} {penalty:?}: {:?}", found.inclusion);
                assert_eq!(found.lambdas.len(), 30);
            }
        }
    }

    #[test]
    fn of_equal_values_the_sparsest_wins() {
        // Without noise every λ below the smallest coefficient leaves nothing but rounding.
        let (columns, _) = six(300, 500);
        let y: Vec<f64> = (0..300).map(|i| columns[1][i] - 0.7 * columns[4][i]).collect();
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let mut o = options(Resample::Rows { ratio: 0.5 });
        o.replicates = 10;
        let penalty = Penalty::LeftOut { grid: vec![0.3, 0.0, 1e-18] };
        let found = bootstrap(&rows, &[0..300], &[], Selector::StlsqRaw, &penalty, &o).unwrap();
        assert_eq!(found.lambdas, [0.3; 10]);
        assert_eq!(found.inclusion, [0.0, 1.0, 0.0, 0.0, 1.0, 0.0]);
    }

    #[test]
    fn bad_penalties_are_errors() {
        let (columns, y) = six(60, 600);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let run = |penalty: Penalty, resample| {
            bootstrap(&rows, &[0..40], &[], Selector::StlsqRaw, &penalty, &options(resample)).unwrap_err()
        };
        // Named twice is protected once: every size from one column up is tried.
        let small = BootstrapOptions { replicates: 1, ..options(Resample::Rows { ratio: 1.0 }) };
        let all = Penalty::LeftOut { grid: vec![] };
        let twice = bootstrap(&rows, &[0..40], &[1; 9], Selector::Backward, &all, &small).unwrap();
        assert_eq!(twice.inclusion[1], 1.0);
        let half = Resample::Rows { ratio: 0.5 };
        let on = |ranges: Vec<Range<usize>>| Penalty::Validated { grid: vec![0.1], ranges };
        assert!(matches!(run(on(vec![39..60]), half), SparseError::RowRange { start: 39, .. }));
        assert!(matches!(run(on(vec![40..61]), half), SparseError::RowRange { end: 61, .. }));
        assert!(matches!(run(on(vec![]), half), SparseError::Empty { what: "row ranges" }));
        assert!(matches!(run(Penalty::LeftOut { grid: vec![] }, half), SparseError::Empty { .. }));
        assert!(matches!(run(Penalty::LeftOut { grid: vec![-1.0] }, half), SparseError::Option { .. }));
        assert!(matches!(run(Penalty::Fixed(f64::NAN), half), SparseError::Option { .. }));
        // Two blocks of half the rows: some replicate holds both.
        let halves = Resample::Blocks { length: 20, circular: true };
        let error = run(Penalty::LeftOut { grid: vec![0.1] }, halves);
        assert!(matches!(error, SparseError::TooFewRows { found: 0, .. }), "{error}");
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
            let found = bootstrap(&rows, &[0..n], &[], Selector::StlsqRaw, &Penalty::Fixed(0.0), &o).unwrap();
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
        let run = |o: &BootstrapOptions| {
            bootstrap(&rows, &[0..30], &[], Selector::StlsqRaw, &Penalty::Fixed(0.0), o)
        };
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
