//! Thesis Algorithm 1: for every order the penalty by cross-validation, the order by an information criterion.

use std::ops::Range;

use rayon::prelude::*;

use crate::SparseError;
use crate::criteria::{Criterion, effective_rows, smallest};
use crate::design::{Design, count};
use crate::folds::{self, Folds, Rule, Split};
use crate::gram::{Gram, Sample};
use crate::lasso::{lasso, refit, support};
use crate::least_squares::least_squares;
use crate::stlsq::{Threshold, log_grid, stlsq};
use crate::subset::{backward, best_subsets};

/// How a sparse model is found for one penalty.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Selector {
    /// Sequentially thresholded least squares on the coefficients' own units.
    StlsqRaw,
    /// The same on |cⱼ| ‖aⱼ‖/‖p‖, free of units.
    StlsqNormalised,
    /// LASSO on normalised columns, coefficients as they are (biased towards zero).
    Lasso,
    /// LASSO for the support, least squares for the coefficients.
    LassoRefit,
    /// Backward elimination; the "penalty" is the number of columns dropped.
    Backward,
    /// Best subset of every size; the "penalty" is the number of columns dropped.
    BestSubset,
}

impl Selector {
    /// Coefficients for every penalty of the grid on the first `columns` columns of a sample. For
    /// [`Selector::Backward`] and [`Selector::BestSubset`] the grid is ignored: point i has i columns dropped.
    ///
    /// # Errors
    /// Those of the selector: [`stlsq`], [`lasso`], [`backward`], [`best_subsets`].
    pub fn path(
        self,
        sample: &Sample<'_>,
        columns: usize,
        grid: &[f64],
        protected: &[usize],
    ) -> Result<Vec<Vec<f64>>, SparseError> {
        sample.check_size(columns)?;
        Design::check_columns("the protected list", protected, columns)?;
        let weights = || (0..columns).map(|j| if protected.contains(&j) { 0.0 } else { 1.0 });
        match self {
            Self::StlsqRaw => stlsq(sample, columns, grid, Threshold::Raw, protected),
            Self::StlsqNormalised => stlsq(sample, columns, grid, Threshold::Normalised, protected),
            Self::Lasso => lasso(sample, columns, grid, &weights().collect::<Vec<_>>()),
            Self::LassoRefit => refit(sample, &lasso(sample, columns, grid, &weights().collect::<Vec<_>>())?),
            Self::Backward => backward(sample, columns, protected),
            Self::BestSubset => best_subsets(sample, columns, protected),
        }
    }

    /// Whether the final coefficients are least squares on the support.
    fn refits(self) -> bool {
        self != Self::Lasso
    }
}

/// One target, candidate columns nested by order, and which rows belong to which recording.
#[derive(Debug, Clone, Copy)]
pub struct Problem<'a> {
    /// Candidate columns; order i uses the first `orders[i]` of them.
    pub columns: &'a [&'a [f64]],
    /// The target p.
    pub target: &'a [f64],
    /// Number of leading columns of every order, ascending.
    pub orders: &'a [usize],
    /// Row ranges of separate recordings, in order; empty for one recording.
    pub pieces: &'a [Range<usize>],
}

/// Settings of [`search`].
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// How sparse models are found.
    pub selector: Selector,
    /// Thresholds or penalties to try.
    pub grid: Vec<f64>,
    /// Number of contiguous folds K ≥ 2 of the training rows.
    pub folds: usize,
    /// Draw the folds at random with this seed instead: wrong for time series, see [`folds::random`].
    pub random_folds: Option<u64>,
    /// How the penalty is read from the cross-validation curve.
    pub rule: Rule,
    /// What decides between the orders.
    pub criterion: Criterion,
    /// Use the effective number of test rows ([`effective_rows`]) in the deciding criterion instead of n.
    pub effective: bool,
    /// Columns that must stay.
    pub protected: Vec<usize>,
    /// Share of the rows, from the start, that trains.
    pub train_fraction: f64,
    /// Rows dropped between training and test rows and between folds (the length of a window in rows).
    pub gap: usize,
}

impl Options {
    /// For coefficients of comparable size: raw thresholds 1e-2 … 1 (40 values), K = 5, minimum of MSE_cv, AIC
    /// on the second half of the rows (measured on the Duffing oscillator of thesis chapter 2).
    #[must_use]
    pub fn raw() -> Self {
        Self {
            selector: Selector::StlsqRaw,
            grid: log_grid(1e-2, 1.0, 40),
            folds: 5,
            random_folds: None,
            rule: Rule::Minimum,
            criterion: Criterion::Aic,
            effective: false,
            protected: Vec::new(),
            train_fraction: 0.5,
            gap: 0,
        }
    }

    /// For coefficients of very different size or unit: normalised thresholds 1e-5 … 1e-1 (50 values), K = 10,
    /// one-standard-error rule (measured on the rotary flexible link).
    #[must_use]
    pub fn normalised() -> Self {
        Self {
            selector: Selector::StlsqNormalised,
            grid: log_grid(1e-5, 1e-1, 50),
            folds: 10,
            rule: Rule::OneStandardError,
            ..Self::raw()
        }
    }
}

/// One point of a cross-validation curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathPoint {
    /// The penalty (or the number of columns dropped, for subset selectors).
    pub lambda: f64,
    /// MSE_cv(λ), thesis Eq 2.15.
    pub mse: f64,
    /// Its standard error over the folds: sd of the folds' mean squared errors / √K.
    pub standard_error: f64,
    /// Mean number of terms of the folds' models.
    pub terms: f64,
}

/// The best model of one order.
#[derive(Debug, Clone, PartialEq)]
pub struct OrderFit {
    /// Number of candidate columns.
    pub columns: usize,
    /// The cross-validation curve.
    pub path: Vec<PathPoint>,
    /// Index of the chosen point in `path`.
    pub chosen: usize,
    /// Coefficients on all training rows (refitted by QR unless the selector is [`Selector::Lasso`]).
    pub coefficients: Vec<f64>,
    /// Columns whose coefficient is not zero.
    pub active: Vec<usize>,
    /// Residual sum of squares on the training rows.
    pub train_rss: f64,
    /// Residual sum of squares on the test rows (not below (64 ε)² Σ p², where only rounding is left).
    pub test_rss: f64,
    /// Number of test rows n.
    pub test_rows: usize,
    /// Effective number of test rows.
    pub effective_rows: f64,
    /// AIC on the test rows with n (thesis Eq 2.17).
    pub aic: f64,
    /// Corrected AIC with n.
    pub aicc: f64,
    /// BIC with n.
    pub bic: f64,
    /// The value that decides ([`Options::criterion`], [`Options::effective`]).
    pub criterion: f64,
}

/// Result of [`search`].
#[derive(Debug, Clone, PartialEq)]
pub struct Search {
    /// One entry per order.
    pub orders: Vec<OrderFit>,
    /// Index of the chosen order (of equal criteria the smallest order).
    pub chosen: usize,
    /// Which rows trained and tested.
    pub split: Split,
    /// The folds of the training rows.
    pub folds: Folds,
}

impl Search {
    /// The model of the chosen order.
    #[must_use]
    pub fn best(&self) -> &OrderFit {
        &self.orders[self.chosen]
    }
}

/// Thesis Algorithm 1 for one target: split, cross-validate every order's path, fit on all training rows,
/// compare the orders on the test rows. One pass over the rows makes the Gram matrices of the folds; all else
/// but the final refits comes from them. Orders run in parallel; the result does not depend on threads.
///
/// # Errors
/// Data ([`Design::new`]), rows ([`folds::contiguous`], [`folds::train_test`]), columns and orders
/// ([`SparseError::NoSuchColumn`]), grid, and rank deficiency of an order's full set of columns.
pub fn search(problem: &Problem<'_>, options: &Options) -> Result<Search, SparseError> {
    let design = Design::new(problem.columns, problem.target)?;
    let whole = [0..design.rows()];
    let pieces = if problem.pieces.is_empty() { &whole } else { problem.pieces };
    design.check_rows(pieces)?;
    let split = folds::train_test(pieces, options.train_fraction, options.gap)?;
    search_split(&design, problem.orders, split, options)
}

/// As [`search`] with training and test rows of the caller's choice (for instance two recordings).
///
/// # Errors
/// As [`search`].
pub fn search_split(
    design: &Design<'_>,
    orders: &[usize],
    split: Split,
    options: &Options,
) -> Result<Search, SparseError> {
    design.check_rows(&split.train)?;
    design.check_rows(&split.test)?;
    if orders.is_empty() {
        return Err(SparseError::Empty { what: "the list of orders".into(), mend: "give at least one size" });
    }
    let folds = match options.random_folds {
        Some(seed) => folds::random(&split.train, options.folds, seed)?,
        None => folds::contiguous(&split.train, options.folds, options.gap)?,
    };
    let grams: Vec<Gram> = folds.par_iter().map(|rows| Gram::new(design, rows)).collect();
    let total = grams[1..].iter().fold(grams[0].clone(), |sum, g| sum.plus(g));
    let pairs: Vec<(Sample<'_>, Sample<'_>)> = folds
        .iter()
        .zip(&grams)
        .map(|(rows, gram)| {
            let others: Vec<_> = folds.iter().filter(|f| *f != rows).flatten().cloned().collect();
            let train = Sample::from_gram(design, &others, total.minus(gram));
            (train, Sample::from_gram(design, rows, gram.clone()))
        })
        .collect();
    let in_folds: Vec<_> = folds.iter().flatten().cloned().collect();
    let train = Sample::from_gram(design, &in_folds, total);
    let fits: Result<Vec<OrderFit>, SparseError> =
        orders.par_iter().map(|&columns| order(design, columns, &pairs, &train, &split, options)).collect();
    let orders = fits?;
    let chosen = smallest(&orders.iter().map(|o| o.criterion).collect::<Vec<_>>()).unwrap_or(0);
    Ok(Search { orders, chosen, split, folds })
}

fn order(
    design: &Design<'_>,
    columns: usize,
    pairs: &[(Sample<'_>, Sample<'_>)],
    train: &Sample<'_>,
    split: &Split,
    options: &Options,
) -> Result<OrderFit, SparseError> {
    let selector = options.selector;
    let full = selector.path(train, columns, &options.grid, &options.protected)?;
    let mut curves = Vec::with_capacity(pairs.len());
    for (rest, fold) in pairs {
        let path = selector.path(rest, columns, &options.grid, &options.protected)?;
        let points: Vec<(f64, usize)> =
            path.iter().map(|c| (fold.rss(c) / fold.gram().rows(), support(c).len())).collect();
        curves.push((fold.gram().rows(), points));
    }
    // A column of zeros in one fold shortens that fold's path of subsets.
    let points = curves.iter().map(|(_, c)| c.len()).fold(full.len(), usize::min);
    let path: Vec<PathPoint> = (0..points).map(|i| point(i, &curves, options)).collect();
    let mse: Vec<f64> = path.iter().map(|p| p.mse).collect();
    let se: Vec<f64> = path.iter().map(|p| p.standard_error).collect();
    let terms: Vec<f64> = path.iter().map(|p| p.terms).collect();
    let chosen = folds::choose(options.rule, &mse, &se, &terms).unwrap_or(0);

    let active = support(&full[chosen]);
    let mut coefficients = full[chosen].clone();
    if selector.refits() {
        coefficients = least_squares(design, &active, &split.train)?;
        coefficients.truncate(columns);
    }
    let sum = |r: &[f64]| r.iter().map(|e| e * e).sum::<f64>();
    let residual = design.residual(&coefficients, &split.test);
    let energy: f64 = split.test.iter().map(|r| sum(&design.target()[r.clone()])).sum();
    let test_rss = sum(&residual).max((64.0 * f64::EPSILON).powi(2) * energy);
    let test_rows = count(&split.test);
    let mut residual_pieces = Vec::new();
    let mut at = 0;
    for range in &split.test {
        residual_pieces.push(&residual[at..at + range.len()]);
        at += range.len();
    }
    let effective = effective_rows(&residual_pieces);
    let n = test_rows as f64;
    let value = |criterion: Criterion, rows| criterion.value(test_rss, n, active.len(), rows);
    Ok(OrderFit {
        columns,
        path,
        chosen,
        train_rss: sum(&design.residual(&coefficients, &split.train)),
        test_rss,
        test_rows,
        effective_rows: effective,
        aic: value(Criterion::Aic, n),
        aicc: value(Criterion::Aicc, n),
        bic: value(Criterion::Bic, n),
        criterion: value(options.criterion, if options.effective { effective } else { n }),
        coefficients,
        active,
    })
}

/// Point i of the curve from every fold's (mean squared error, terms).
fn point(i: usize, curves: &[(f64, Vec<(f64, usize)>)], options: &Options) -> PathPoint {
    let k = curves.len() as f64;
    let rows: f64 = curves.iter().map(|(n, _)| n).sum();
    let mse = curves.iter().map(|(n, c)| n * c[i].0).sum::<f64>() / rows;
    let mean = curves.iter().map(|(_, c)| c[i].0).sum::<f64>() / k;
    let variance = curves.iter().map(|(_, c)| (c[i].0 - mean).powi(2)).sum::<f64>() / (k - 1.0);
    let lambda = match options.selector {
        Selector::Backward | Selector::BestSubset => i as f64,
        _ => options.grid[i],
    };
    let terms = curves.iter().map(|(_, c)| c[i].1 as f64).sum::<f64>() / k;
    PathPoint { lambda, mse, standard_error: (variance / k).sqrt(), terms }
}
