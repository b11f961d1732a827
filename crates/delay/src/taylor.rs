//! Thesis Algorithm 2: a governing equation and its delay, by sparse regression on the Taylor expansion of the
//! delayed term, with bootstrap.
//!
//! Once g x(t − τ) is expanded ([`crate::expansion`]), its derivatives are columns like any other. Those that carry
//! the delay are small and would fall to a threshold; they are *protected*: never dropped. The algorithm, for every
//! polynomial order in turn:
//!
//! 1. draw a share of the training rows with replacement;
//! 2. for every threshold λ, sequentially thresholded least squares (drop |c| < λ, refit, until nothing changes);
//! 3. keep the λ with the smallest mean square error on the test recording (Eq 3.16);
//! 4. after all replicates, average the coefficients (Eq 3.18) and take the error of the average (Eq 3.17).
//!
//! The order with the smallest error is the model. Two remarks that the thesis does not make: the standard
//! deviations over replicates that draw single rows understate the truth by far, because neighbouring rows share
//! noise ([`Options::block`] draws stretches instead); and the truncation of the expansion biases the delay however
//! long the recording is ([`crate::expansion::Expansion::truncation`]), so the result is a start for
//! [`crate::exact`].
//!
//! Columns come from any operation on the signals: windows, or the iterated integrals of Eq 3.10.
use crate::qr::{Compressed, Factors};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::{Rng, SeedableRng};

/// Why there is no model.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TaylorError {
    /// Lengths or numbers of columns do not agree.
    #[error("the {data} data have {found} {what} where {expected} are needed")]
    Shape {
        /// `training` or `test`.
        data: &'static str,
        /// What does not agree.
        what: &'static str,
        /// Number found.
        found: usize,
        /// Number needed.
        expected: usize,
    },
    /// A value is not finite.
    #[error("row {row} of the {data} data is not finite: drop such rows first")]
    NotFinite {
        /// `training` or `test`.
        data: &'static str,
        /// Row, from 0.
        row: usize,
    },
    /// The orders are not nested: the number of columns must grow, and hold the protected ones.
    #[error(
        "order {order} has {columns} columns: orders must be nested, each with more columns than the one before"
    )]
    Orders {
        /// The order.
        order: usize,
        /// Its columns.
        columns: usize,
    },
    /// No order was given.
    #[error("no polynomial order was given")]
    NoOrder,
    /// An option is out of range.
    #[error("the option {name} is {value}: {mend}")]
    Option {
        /// Its name.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What to give.
        mend: &'static str,
    },
    /// A replicate has fewer rows than columns.
    #[error(
        "a replicate draws {rows} rows for {columns} columns: use more rows, a larger ratio or a lower order"
    )]
    TooFewRows {
        /// Rows of a replicate.
        rows: usize,
        /// Columns.
        columns: usize,
    },
    /// A protected column is a combination of other protected ones.
    #[error("the protected column {column} is a combination of the others: it cannot be estimated")]
    Dependent {
        /// Index of the column.
        column: usize,
    },
}

/// Columns and right-hand side of one recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Data<'a> {
    /// One `Vec` per column, one value per row; the protected ones first.
    pub columns: &'a [Vec<f64>],
    /// One value per row.
    pub target: &'a [f64],
}

/// A polynomial order and how many of the leading columns it has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Order {
    /// The order N.
    pub order: usize,
    /// Its columns are the first so many.
    pub columns: usize,
}

/// How to run Algorithm 2.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Leading columns that are never dropped.
    pub protected: usize,
    /// Bootstrap replicates.
    pub replicates: usize,
    /// Rows of a replicate over rows of the training data.
    pub ratio: f64,
    /// Consecutive rows drawn together: 1 as printed; the rows that share noise for honest standard deviations.
    pub block: usize,
    /// Thresholds λ on the coefficients as they stand.
    pub thresholds: Vec<f64>,
    /// Share of the smallest test error within which the simpler choice is taken: the larger threshold, the lower
    /// order. Zero is the bare minimum, as printed.
    pub tolerance: f64,
    /// Seed: the same seed gives the same result.
    pub seed: u64,
}

impl Options {
    /// The numbers of thesis §3.3: 30 replicates of half the rows, 50 thresholds from 10⁻⁶ to 1; 5 % tolerance.
    #[must_use]
    pub fn thesis(protected: usize, seed: u64) -> Self {
        Self {
            protected,
            replicates: 30,
            ratio: 0.5,
            block: 1,
            thresholds: logarithmic(1e-6, 1.0, 50),
            tolerance: 0.05,
            seed,
        }
    }
}

/// `count` values from `from` to `to` with equal ratios.
#[must_use]
pub fn logarithmic(from: f64, to: f64, count: usize) -> Vec<f64> {
    let steps = count.saturating_sub(1).max(1) as f64;
    (0..count).map(|i| from * (to / from).powf(i as f64 / steps)).collect()
}

/// The model of one order.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// The order N.
    pub order: usize,
    /// Mean of the coefficients over the replicates (Eq 3.18), one per column.
    pub coefficients: Vec<f64>,
    /// Their standard deviation over the replicates.
    pub std: Vec<f64>,
    /// Share of the replicates that keep each column.
    pub inclusion: Vec<f64>,
    /// Mean square error of the mean coefficients on the test data (Eq 3.17).
    pub test_error: f64,
    /// Threshold chosen in each replicate.
    pub thresholds: Vec<f64>,
}

impl Model {
    /// Columns that at least half of the replicates keep.
    #[must_use]
    pub fn active(&self) -> Vec<usize> {
        (0..self.inclusion.len()).filter(|&j| self.inclusion[j] >= 0.5).collect()
    }
}

/// The models of all orders.
#[derive(Debug, Clone, PartialEq)]
pub struct Search {
    /// One per order.
    pub models: Vec<Model>,
    /// Index of the chosen one.
    pub chosen: usize,
}

impl Search {
    /// The chosen model.
    #[must_use]
    pub fn model(&self) -> Option<&Model> {
        self.models.get(self.chosen)
    }
}

/// Algorithm 2 over nested orders.
///
/// # Errors
/// Data that do not fit together, options out of range, fewer rows than columns.
pub fn search(
    train: Data<'_>,
    test: Data<'_>,
    orders: &[Order],
    options: &Options,
) -> Result<Search, TaylorError> {
    check(train, test, orders, options)?;
    let widest = orders.iter().map(|o| o.columns).max().unwrap_or(0);
    let judge = Compressed::new(&test.columns[..widest], test.target, &all(test.target.len()));
    let replicates: Vec<Compressed> = (0..options.replicates)
        .map(|r| {
            let rows = draw(train.target.len(), options, r as u64);
            Compressed::new(&train.columns[..widest], train.target, &rows)
        })
        .collect();
    let models = orders
        .iter()
        .map(|&order| model(order, &replicates, &judge, options))
        .collect::<Result<Vec<Model>, _>>()?;
    let least = models.iter().map(|m| m.test_error).fold(f64::INFINITY, f64::min);
    let good = |m: &Model| m.test_error <= least * (1.0 + options.tolerance);
    let chosen = models.iter().position(good).unwrap_or(0);
    Ok(Search { models, chosen })
}

fn all(rows: usize) -> Vec<usize> {
    (0..rows).collect()
}

/// The model of one order: every replicate with its best threshold, averaged.
fn model(
    order: Order,
    replicates: &[Compressed],
    judge: &Compressed,
    options: &Options,
) -> Result<Model, TaylorError> {
    let k = order.columns;
    let (mut sum, mut squares, mut kept) = (vec![0.0; k], vec![0.0; k], vec![0usize; k]);
    let mut thresholds = Vec::with_capacity(replicates.len());
    for rows in replicates {
        let (threshold, coefficients) = best(rows, judge, k, options)?;
        thresholds.push(threshold);
        for (j, c) in coefficients.iter().enumerate() {
            sum[j] += c;
            squares[j] += c * c;
            kept[j] += usize::from(*c != 0.0);
        }
    }
    let n = replicates.len() as f64;
    let coefficients: Vec<f64> = sum.iter().map(|s| s / n).collect();
    let spread = |(q, c): (&f64, &f64)| ((q - n * c * c).max(0.0) / (n - 1.0).max(1.0)).sqrt();
    let std = squares.iter().zip(&coefficients).map(spread).collect();
    let inclusion = kept.iter().map(|&m| m as f64 / n).collect();
    let test_error = judge.mean_square_error(&coefficients);
    Ok(Model { order: order.order, coefficients, std, inclusion, test_error, thresholds })
}

/// The largest threshold whose test error comes within the tolerance of the smallest, and its coefficients.
fn best(
    rows: &Compressed,
    judge: &Compressed,
    columns: usize,
    options: &Options,
) -> Result<(f64, Vec<f64>), TaylorError> {
    let mut thresholds = options.thresholds.clone();
    thresholds.sort_by(|a, b| b.total_cmp(a));
    let path = thresholds
        .into_iter()
        .map(|threshold| {
            let coefficients = thresholded(rows, columns, options.protected, threshold)?;
            Ok((judge.mean_square_error(&coefficients), threshold, coefficients))
        })
        .collect::<Result<Vec<_>, TaylorError>>()?;
    let least = path.iter().map(|(error, ..)| *error).fold(f64::INFINITY, f64::min);
    let good = path.into_iter().find(|(error, ..)| *error <= least * (1.0 + options.tolerance));
    Ok(good.map_or((0.0, vec![0.0; columns]), |(_, threshold, coefficients)| (threshold, coefficients)))
}

/// Sequentially thresholded least squares: drop |c| < λ but for the protected, refit, until nothing changes.
fn thresholded(
    rows: &Compressed,
    columns: usize,
    protected: usize,
    threshold: f64,
) -> Result<Vec<f64>, TaylorError> {
    let mut active = all(columns);
    loop {
        let values = match Factors::new(rows.r.select_columns(&active)) {
            Ok(factors) => factors.solve(&rows.z),
            Err(dependent) if active[dependent.column] < protected => {
                return Err(TaylorError::Dependent { column: active[dependent.column] });
            }
            // What is a combination of the columns before it explains nothing more.
            Err(dependent) => {
                active.remove(dependent.column);
                continue;
            }
        };
        let kept: Vec<usize> = active
            .iter()
            .zip(&values)
            .filter(|&(&j, c)| j < protected || c.abs() >= threshold)
            .map(|(&j, _)| j)
            .collect();
        if kept.len() == active.len() {
            let mut coefficients = vec![0.0; columns];
            active.iter().zip(values).for_each(|(&j, c)| coefficients[j] = c);
            return Ok(coefficients);
        }
        active = kept;
        if active.is_empty() {
            return Ok(vec![0.0; columns]);
        }
    }
}

/// Rows of a replicate: blocks of consecutive rows, drawn with replacement.
fn draw(rows: usize, options: &Options, replicate: u64) -> Vec<usize> {
    // One stream per replicate: the result does not depend on the order of work.
    let mut random = Pcg64Mcg::seed_from_u64(mixed(options.seed ^ mixed(replicate)));
    let wanted = replicate_rows(rows, options);
    let block = options.block.min(rows);
    let starts = rows - block + 1;
    let mut drawn = Vec::with_capacity(wanted + block);
    while drawn.len() < wanted {
        // The bias of a remainder of 64 random bits by any number of rows is negligible.
        let start = (random.next_u64() % starts as u64) as usize;
        drawn.extend(start..start + block);
    }
    drawn.truncate(wanted);
    drawn
}

/// SplitMix64's finaliser: neighbouring numbers become unrelated ones.
fn mixed(number: u64) -> u64 {
    let z = number.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

fn replicate_rows(rows: usize, options: &Options) -> usize {
    (rows as f64 * options.ratio).round().max(1.0) as usize
}

fn check(train: Data<'_>, test: Data<'_>, orders: &[Order], options: &Options) -> Result<(), TaylorError> {
    let last = orders.last().ok_or(TaylorError::NoOrder)?;
    for (i, o) in orders.iter().enumerate() {
        let before = if i == 0 { 0 } else { orders[i - 1].columns };
        if o.columns <= before || o.columns < options.protected {
            return Err(TaylorError::Orders { order: o.order, columns: o.columns });
        }
    }
    for (name, data) in [("training", train), ("test", test)] {
        let shape = |what, found, expected| TaylorError::Shape { data: name, what, found, expected };
        if data.columns.len() < last.columns {
            return Err(shape("columns", data.columns.len(), last.columns));
        }
        let rows = data.target.len();
        if rows == 0 {
            return Err(shape("rows", 0, 1));
        }
        if let Some(column) = data.columns.iter().find(|c| c.len() != rows) {
            return Err(shape("rows of a column", column.len(), rows));
        }
        let spoiled = |c: &[f64]| c.iter().position(|v| !v.is_finite());
        let columns = data.columns.iter().map(Vec::as_slice);
        if let Some(row) = columns.chain([data.target]).find_map(spoiled) {
            return Err(TaylorError::NotFinite { data: name, row });
        }
    }
    let option = |name, value, mend| Err(TaylorError::Option { name, value, mend });
    if options.replicates == 0 {
        return option("replicates", 0.0, "give at least one");
    }
    if options.block == 0 {
        return option("block", 0.0, "give at least one row");
    }
    if !(options.ratio > 0.0 && options.ratio <= 10.0) {
        return option("ratio", options.ratio, "give a positive share of the rows, 0.5 as in the thesis");
    }
    if !(options.tolerance >= 0.0 && options.tolerance.is_finite()) {
        return option("tolerance", options.tolerance, "give zero or a small share");
    }
    if options.thresholds.is_empty() {
        return option("thresholds", 0.0, "give at least one");
    }
    if let Some(&value) = options.thresholds.iter().find(|t| !(**t >= 0.0 && t.is_finite())) {
        return option("thresholds", value, "give finite values, zero or more");
    }
    let rows = replicate_rows(train.target.len(), options);
    if rows < last.columns {
        return Err(TaylorError::TooFewRows { rows, columns: last.columns });
    }
    Ok(())
}
