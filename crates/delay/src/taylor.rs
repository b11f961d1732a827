//! Thesis Algorithm 2: a governing equation and its delay, by sparse regression on the Taylor expansion of the
//! delayed term, with bootstrap.
//!
//! Once g x(t − τ) is expanded ([`crate::expansion`]), its derivatives are columns like any other. Those that carry
//! the delay are small and would fall to a threshold; they are *protected*: never dropped. The algorithm, for every
//! polynomial order in turn:
//!
//! 1. draw a share of the training rows with replacement;
//! 2. for every threshold λ, sequentially thresholded least squares (drop |c| < λ, refit, until nothing changes);
//! 3. keep the λ with the smallest square error on the test recording (Eq 3.16);
//! 4. after all replicates, average the coefficients (Eq 3.18) and take the error of the average (Eq 3.17).
//!
//! The order with the smallest error is the model. Two remarks that the thesis does not make: the standard
//! deviations over replicates that draw single rows understate the truth by far, because neighbouring rows share
//! noise ([`Resample::Blocks`] draws stretches instead); and the truncation of the expansion biases the delay
//! however long the recording is ([`crate::expansion::Expansion::truncation`]), so the result is a start for
//! [`crate::exact`].
//!
//! Columns come from any operation on the signals: windows, or the iterated integrals of Eq 3.10.
use greybox_sparse::select::logspace;
use greybox_sparse::{BootstrapOptions, Penalty, Resample, Rows, Selector, SparseError, Triangle, bootstrap};

/// Why there is no model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TaylorError {
    /// The regression cannot be set up or solved. Rows of the test data are counted behind those of the training
    /// data.
    #[error(transparent)]
    Regression(#[from] SparseError),
    /// There are fewer columns than an order asks for.
    #[error("the {data} data have {found} columns where {expected} are needed")]
    Columns {
        /// `training` or `test`.
        data: &'static str,
        /// Number found.
        found: usize,
        /// Number needed.
        expected: usize,
    },
    /// A column is not as long as the target.
    #[error(
        "column {column} of the {data} data has {found} rows, its target {expected}: cut both to the same rows"
    )]
    Rows {
        /// `training` or `test`.
        data: &'static str,
        /// The column, from 0.
        column: usize,
        /// Number found.
        found: usize,
        /// Number needed.
        expected: usize,
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
    /// The training rows of the lowest order cannot tell its columns apart.
    #[error(
        "column {column} of order {order} is zero or a combination of those before it in the training rows: leave \
         it out, or excite the system further"
    )]
    Dependent {
        /// The order.
        order: usize,
        /// The column, from 0.
        column: usize,
    },
    /// No order was given.
    #[error("no polynomial order was given")]
    NoOrder,
    /// The tolerance is negative or not finite.
    #[error("a tolerance of {tolerance} is impossible: give zero or a small share")]
    Tolerance {
        /// The tolerance.
        tolerance: f64,
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
    /// What a replicate draws: single rows as printed; blocks for honest standard deviations.
    pub resample: Resample,
    /// What is thresholded: the coefficients as they stand, as printed, or one of the others.
    pub selector: Selector,
    /// Thresholds λ.
    pub thresholds: Vec<f64>,
    /// An order is preferred to a higher one unless that lowers the test error by more than this share.
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
            resample: Resample::Rows { ratio: 0.5 },
            selector: Selector::StlsqRaw,
            thresholds: logspace(1e-6, 1.0, 50),
            tolerance: 0.05,
            seed,
        }
    }
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
    /// One per order, up to the first whose columns these rows cannot tell apart.
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
/// Data that do not fit together, options out of range, columns of the lowest order that depend on each other (as
/// they do where there are fewer rows than columns).
pub fn search(
    train: Data<'_>,
    test: Data<'_>,
    orders: &[Order],
    options: &Options,
) -> Result<Search, TaylorError> {
    let widest = check(train, test, orders, options)?;
    let both = |j: usize| [train.columns[j].as_slice(), &test.columns[j]].concat();
    let columns: Vec<Vec<f64>> = (0..widest).map(both).collect();
    let target = [train.target, test.target].concat();
    let rows = Rows::from_vecs(&columns, &target)?;
    let training = 0..train.target.len();
    let judging = training.end..target.len();
    let whole = Triangle::of_rows(&rows, std::slice::from_ref(&training))?;
    let judge = Triangle::of_rows(&rows, std::slice::from_ref(&judging))?;
    let penalty = Penalty::Validated { grid: options.thresholds.clone(), ranges: vec![judging] };
    let protected: Vec<usize> = (0..options.protected).collect();
    let draws = BootstrapOptions {
        replicates: options.replicates,
        resample: options.resample,
        seed: options.seed,
        ..BootstrapOptions::default()
    };
    let mut models = Vec::with_capacity(orders.len());
    for &Order { order, columns } in orders {
        if let Some((column, _)) = whole.first_columns(columns).first_dependent() {
            if models.is_empty() {
                return Err(TaylorError::Dependent { order, column });
            }
            // What the rows cannot tell apart, no higher order can.
            break;
        }
        let spread = bootstrap(
            &rows.first_columns(columns),
            std::slice::from_ref(&training),
            &protected,
            options.selector,
            &penalty,
            &draws,
        )?;
        let test_error = judge.rss(&spread.mean) / test.target.len() as f64;
        models.push(Model {
            order,
            coefficients: spread.mean,
            std: spread.deviation,
            inclusion: spread.inclusion,
            test_error,
        });
    }
    let least = models.iter().map(|m| m.test_error).fold(f64::INFINITY, f64::min);
    let good = |m: &Model| m.test_error <= least * (1.0 + options.tolerance);
    let chosen = models.iter().position(good).unwrap_or(0);
    Ok(Search { models, chosen })
}

/// Whether all fits together; the number of columns of the highest order.
fn check(train: Data<'_>, test: Data<'_>, orders: &[Order], options: &Options) -> Result<usize, TaylorError> {
    let expected = orders.last().ok_or(TaylorError::NoOrder)?.columns;
    for (i, o) in orders.iter().enumerate() {
        let before = if i == 0 { 0 } else { orders[i - 1].columns };
        if o.columns <= before || o.columns < options.protected {
            return Err(TaylorError::Orders { order: o.order, columns: o.columns });
        }
    }
    for (name, data) in [("training", train), ("test", test)] {
        let found = data.columns.len();
        if found < expected {
            return Err(TaylorError::Columns { data: name, found, expected });
        }
        let rows = data.target.len();
        if let Some(column) = data.columns.iter().position(|c| c.len() != rows) {
            let found = data.columns[column].len();
            return Err(TaylorError::Rows { data: name, column, found, expected: rows });
        }
    }
    if !(options.tolerance >= 0.0 && options.tolerance.is_finite()) {
        return Err(TaylorError::Tolerance { tolerance: options.tolerance });
    }
    Ok(expected)
}
