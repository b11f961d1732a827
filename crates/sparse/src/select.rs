//! Algorithm 1 of the thesis for one target: sparse models of nested orders, λ by cross-validation on the
//! training rows, the order by an information criterion on the test rows.
//!
//! The rows are read twice: once to factorise the folds' parts, once for the residuals on the test rows. All
//! orders, folds and λ work on the triangular factors.

use std::ops::Range;

use rayon::prelude::*;

use crate::criteria::{Criterion, Moment, choose, effective_sample_size};
use crate::error::{SparseError, check_range};
use crate::folds::{Split, contiguous, minimum, one_standard_error, random_for_demonstration};
use crate::lasso::{LassoOptions, lasso_path};
use crate::protect::checked;
use crate::rows::{Rows, check_ranges, count};
use crate::stlsq::{Threshold, stlsq_path};
use crate::subset::{backward_elimination, best_subsets};
use crate::triangle::{Fit, Triangle, support};

/// How a sparse model is found for one value of the path parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Selector {
    /// Thresholded least squares, λ compared with |cⱼ|.
    StlsqRaw,
    /// Thresholded least squares, λ compared with |cⱼ|‖Pⱼ‖/‖p‖.
    StlsqNormalised,
    /// LASSO with its shrunken coefficients. A λ whose descent stops at the sweep limit is used as it stands; call
    /// [`lasso_path`] to see its duality gap.
    Lasso,
    /// LASSO, its support refitted by least squares.
    LassoRefit,
    /// Backward elimination; the path parameter is the number of columns kept.
    Backward,
    /// Best subsets; the path parameter is the number of columns kept.
    BestSubset,
}

/// How λ follows from the cross-validation curve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rule {
    /// The least mean squared error.
    Minimum,
    /// The sparsest within one standard error of it.
    OneStandardError,
}

/// How the folds are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FoldKind {
    /// Consecutive rows.
    Contiguous,
    /// Rows at random with this seed: **wrong for time series**, for demonstration only.
    RandomForDemonstration(u64),
}

/// Which sample size the criteria count.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleSize {
    /// The test rows (thesis Eq 2.17).
    Rows,
    /// The effective number of test rows by the autocorrelation of the squared residuals
    /// ([`Moment::Square`]) of the order with the least test RSS; one number for all orders, since criteria
    /// with different ones cannot be compared.
    Effective,
}

/// Settings of [`search`].
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// How sparse models are found.
    pub selector: Selector,
    /// The λ to try, in any order; not used by [`Selector::Backward`] and [`Selector::BestSubset`].
    pub grid: Vec<f64>,
    /// Number of folds K ≥ 2.
    pub folds: usize,
    /// How the folds are made.
    pub fold_kind: FoldKind,
    /// Rows next to a held-out row that are not trained on.
    pub gap: usize,
    /// How λ is chosen.
    pub rule: Rule,
    /// Which criterion chooses the order.
    pub criterion: Criterion,
    /// The sample size in the criteria.
    pub sample_size: SampleSize,
}

impl Default for Options {
    /// [`Options::normalised`]: the choice of terms does not depend on the units of the columns.
    fn default() -> Self {
        Self::normalised()
    }
}

impl Options {
    /// Thresholds on raw coefficients, 40 values in 10⁻²..1, minimum of 5 contiguous folds, AIC: what recovers
    /// the thesis' Duffing oscillator (coefficients of one size).
    ///
    /// **The choice depends on the units.** The same oscillator in millimetres has a stiffness and a cubic term below
    /// every threshold of the grid that would part them from nothing. Where the coefficients are not known to be of
    /// one size near 1, take [`Options::normalised`].
    #[must_use]
    pub fn raw() -> Self {
        Self {
            selector: Selector::StlsqRaw,
            grid: logspace(1e-2, 1.0, 40),
            folds: 5,
            fold_kind: FoldKind::Contiguous,
            gap: 0,
            rule: Rule::Minimum,
            criterion: Criterion::Aic,
            sample_size: SampleSize::Rows,
        }
    }

    /// Thresholds on normalised coefficients, 50 values in 10⁻⁵..10⁻¹, one-standard-error rule of 10 contiguous
    /// folds, AIC: what recovers the thesis' flexible link (coefficients over three decades).
    #[must_use]
    pub fn normalised() -> Self {
        Self {
            selector: Selector::StlsqNormalised,
            grid: logspace(1e-5, 1e-1, 50),
            folds: 10,
            rule: Rule::OneStandardError,
            ..Self::raw()
        }
    }
}

/// `count` values from `low` to `high` (both positive) in equal ratios.
#[must_use]
pub fn logspace(low: f64, high: f64, count: usize) -> Vec<f64> {
    let last = count.saturating_sub(1).max(1) as f64;
    (0..count).map(|i| low * (high / low).powf(i as f64 / last)).collect()
}

/// One target and its nested candidate columns, checked.
#[derive(Debug, Clone)]
pub struct Problem<'a> {
    rows: Rows<'a>,
    orders: Vec<usize>,
    protected: Vec<usize>,
    split: Split,
}

impl<'a> Problem<'a> {
    /// `orders[r]` is the number of leading columns that order r + 1 may use
    /// ([`Library::lengths`](crate::Library::lengths) plus any columns in front of the library). Protected
    /// columns must be among those of the first order.
    ///
    /// # Errors
    /// [`SparseError::Empty`] without orders, [`SparseError::Length`] if they do not ascend within the columns,
    /// [`SparseError::NoSuchColumn`] for protected columns outside order 1, [`SparseError::RowRange`] for a
    /// split outside the rows.
    pub fn new(
        rows: Rows<'a>,
        orders: &[usize],
        protected: &[usize],
        split: Split,
    ) -> Result<Self, SparseError> {
        let first = *orders.first().ok_or(SparseError::Empty { what: "orders" })?;
        let mut last = 1;
        for (r, &length) in orders.iter().enumerate() {
            if length < last || length > rows.columns() {
                return Err(SparseError::Length {
                    what: format!("order {} (orders ascend, up to all {} columns)", r + 1, rows.columns()),
                    found: length,
                    expected: length.clamp(last.min(rows.columns()), rows.columns()),
                });
            }
            last = length;
        }
        check_ranges(&split.train, rows.rows())?;
        check_ranges(&split.test, rows.rows())?;
        Ok(Self { protected: checked(protected, first)?, rows, orders: orders.to_vec(), split })
    }

    /// The rows.
    #[must_use]
    pub fn rows(&self) -> &Rows<'a> {
        &self.rows
    }

    /// The split.
    #[must_use]
    pub fn split(&self) -> &Split {
        &self.split
    }

    /// The protected columns, ascending.
    #[must_use]
    pub fn protected(&self) -> &[usize] {
        &self.protected
    }
}

/// What was found for one order.
#[derive(Debug, Clone, PartialEq)]
pub struct OrderModel {
    /// The order, counted from 1.
    pub order: usize,
    /// Candidate columns of this order.
    pub candidates: usize,
    /// The path parameter from the densest to the sparsest model: λ ascending, or columns kept descending.
    pub grid: Vec<f64>,
    /// MSE_cv of every value: mean over the folds of RSS / rows on the held-out rows.
    pub cv_mean: Vec<f64>,
    /// Its standard error: standard deviation over the folds / √K.
    pub cv_error: Vec<f64>,
    /// Index of the chosen value.
    pub chosen: usize,
    /// Coefficients over all columns of the problem, from all training rows (least squares on the support,
    /// except for [`Selector::Lasso`]).
    pub coefficients: Vec<f64>,
    /// Columns with non-zero coefficients.
    pub support: Vec<usize>,
    /// Residual sum of squares on the training rows.
    pub train_rss: f64,
    /// Residual sum of squares on the test rows, not below rounding, (64 ε ‖p‖)².
    pub test_rss: f64,
    /// AIC on the test rows.
    pub aic: f64,
    /// AICc on the test rows.
    pub aicc: f64,
    /// BIC on the test rows.
    pub bic: f64,
}

impl OrderModel {
    /// The chosen path parameter.
    #[must_use]
    pub fn lambda(&self) -> f64 {
        self.grid[self.chosen]
    }
}

/// The models of all orders and the choice among them.
#[derive(Debug, Clone, PartialEq)]
pub struct Search {
    /// One per order.
    pub orders: Vec<OrderModel>,
    /// Index into `orders` of the least criterion; ties go to the smaller model, then the lower order.
    pub chosen: usize,
    /// Number of test rows.
    pub test_rows: usize,
    /// The sample size the criteria used.
    pub effective_rows: f64,
}

impl Search {
    /// The model of the chosen order.
    #[must_use]
    pub fn model(&self) -> &OrderModel {
        &self.orders[self.chosen]
    }
}

/// The sparse models along a grid (densest first as ordered by [`ordered_grid`]) from one factor.
///
/// # Errors
/// Those of the selector.
pub fn path(
    selector: Selector,
    triangle: &Triangle,
    protected: &[usize],
    grid: &[f64],
) -> Result<Vec<Fit>, SparseError> {
    let by_size = |models: Vec<Fit>| -> Vec<Fit> {
        // Models come largest first, each one column smaller than the one before.
        let most = models
            .first()
            .map_or(0, |m| triangle.independent(protected).map_or(m.coefficients.len(), |i| i.len()));
        grid.iter()
            .filter_map(|&size| {
                let at = most.saturating_sub(size.max(0.0) as usize).min(models.len() - 1);
                models.get(at).cloned()
            })
            .collect()
    };
    match selector {
        Selector::StlsqRaw => stlsq_path(triangle, protected, grid, Threshold::Raw),
        Selector::StlsqNormalised => stlsq_path(triangle, protected, grid, Threshold::Normalised),
        Selector::Lasso | Selector::LassoRefit => {
            let protected = checked(protected, triangle.columns())?;
            let weights: Vec<f64> = (0..triangle.columns())
                .map(|j| if protected.binary_search(&j).is_ok() { 0.0 } else { 1.0 })
                .collect();
            let fits = lasso_path(triangle, &weights, grid, &LassoOptions::default())?;
            fits.into_iter()
                .map(|f| match selector {
                    Selector::LassoRefit => refit(triangle, &f.fit.support(), &protected),
                    _ => Ok(f.fit),
                })
                .collect()
        }
        Selector::Backward => Ok(by_size(backward_elimination(triangle, protected)?)),
        Selector::BestSubset => Ok(by_size(best_subsets(triangle, protected)?)),
    }
}

/// Least squares on the support and the protected columns, without columns that depend on those before.
fn refit(triangle: &Triangle, found: &[usize], protected: &[usize]) -> Result<Fit, SparseError> {
    let mut active: Vec<usize> = found.iter().chain(protected).copied().collect();
    active.sort_unstable();
    active.dedup();
    let local: Vec<usize> =
        (0..active.len()).filter(|&i| protected.binary_search(&active[i]).is_ok()).collect();
    let independent = triangle.select(&active)?.independent(&local)?;
    triangle.fit(&independent.into_iter().map(|i| active[i]).collect::<Vec<_>>())
}

/// The path parameter from the densest to the sparsest model, for `candidates` columns: the values of `grid`
/// ascending, or the numbers of columns kept descending for [`Selector::Backward`] and [`Selector::BestSubset`].
///
/// # Errors
/// [`SparseError::Empty`] without λ, [`SparseError::Option`] for a negative or non-finite one.
pub fn ordered_grid(
    selector: Selector,
    grid: &[f64],
    candidates: usize,
    protected: usize,
) -> Result<Vec<f64>, SparseError> {
    if matches!(selector, Selector::Backward | Selector::BestSubset) {
        return Ok((protected..=candidates).rev().map(|k| k as f64).collect());
    }
    if grid.is_empty() {
        return Err(SparseError::Empty { what: "values of λ" });
    }
    for &lambda in grid {
        check_range("lambda", lambda, 0.0, f64::MAX, "finite and not negative")?;
    }
    let mut grid = grid.to_vec();
    grid.sort_by(f64::total_cmp);
    Ok(grid)
}

/// Mean square error of every fit on held-out rows, not below rounding.
pub(crate) fn held_out_errors(held: &Triangle, fits: &[Fit]) -> Vec<f64> {
    let floor = (ROUNDING * held.target_norm()).powi(2);
    fits.iter().map(|f| held.rss(&f.coefficients).max(floor) / held.rows() as f64).collect()
}

/// Runs Algorithm 1.
///
/// # Errors
/// Those of the folds, of the selector, and of the criteria.
pub fn search(problem: &Problem<'_>, options: &Options) -> Result<Search, SparseError> {
    let train = &problem.split.train;
    let folds = match options.fold_kind {
        FoldKind::Contiguous => contiguous(train, options.folds, options.gap)?,
        FoldKind::RandomForDemonstration(seed) => random_for_demonstration(train, options.folds, seed)?,
    };
    let parts: Vec<Triangle> = folds
        .parts
        .par_iter()
        .map(|ranges| Triangle::of_rows(&problem.rows, ranges))
        .collect::<Result<_, _>>()?;
    let stack = |which: &[usize]| Triangle::stacked(&which.iter().map(|&i| &parts[i]).collect::<Vec<_>>());
    let pairs: Vec<(Triangle, Triangle)> = (0..folds.len())
        .into_par_iter()
        .map(|k| Ok((stack(&folds.training[k])?, stack(&folds.held_out[k])?)))
        .collect::<Result<_, SparseError>>()?;
    let whole = stack(&(0..parts.len()).collect::<Vec<_>>())?;
    let mut models: Vec<OrderModel> = (0..problem.orders.len())
        .into_par_iter()
        .map(|r| order_model(problem, options, r, &pairs, &whole))
        .collect::<Result<_, _>>()?;
    let test = &problem.split.test;
    let test_rows = count(test);
    let mut all: Vec<&[f64]> = models.iter().map(|m| &m.coefficients[..]).collect();
    // Without a model: the target itself.
    all.push(&[]);
    let mut squares = problem.rows.squares(&all, test);
    let floor = ROUNDING * ROUNDING * squares.pop().unwrap_or(0.0);
    for (model, rss) in models.iter_mut().zip(squares) {
        model.test_rss = rss.max(floor);
    }
    let effective_rows = effective(problem, options, &models, test_rows)?;
    for model in &mut models {
        let value = |criterion: Criterion| {
            criterion.value(model.test_rss, test_rows, effective_rows, model.support.len())
        };
        (model.aic, model.aicc, model.bic) =
            (value(Criterion::Aic)?, value(Criterion::Aicc)?, value(Criterion::Bic)?);
    }
    let values: Vec<f64> = models
        .iter()
        .map(|m| match options.criterion {
            Criterion::Aic => m.aic,
            Criterion::Aicc => m.aicc,
            Criterion::Bic => m.bic,
        })
        .collect();
    let sizes: Vec<usize> = models.iter().map(|m| m.support.len()).collect();
    let chosen = choose(&values, &sizes, effective_rows).unwrap_or(0);
    Ok(Search { orders: models, chosen, test_rows, effective_rows })
}

/// Residuals below this fraction of the target are rounding: models that reach it are equally good, and the
/// sparser one is taken. Matters only for data without noise.
const ROUNDING: f64 = 64.0 * f64::EPSILON;

/// Cross-validation and the final fit of one order; the criteria follow once all orders are known.
fn order_model(
    problem: &Problem<'_>,
    options: &Options,
    r: usize,
    pairs: &[(Triangle, Triangle)],
    whole: &Triangle,
) -> Result<OrderModel, SparseError> {
    let candidates = problem.orders[r];
    let grid = ordered_grid(options.selector, &options.grid, candidates, problem.protected.len())?;
    let errors: Vec<Vec<f64>> = pairs
        .par_iter()
        .map(|(train, held)| {
            let (train, held) = (train.first_columns(candidates), held.first_columns(candidates));
            let fits = path(options.selector, &train, &problem.protected, &grid)?;
            Ok(held_out_errors(&held, &fits))
        })
        .collect::<Result<_, SparseError>>()?;
    let (cv_mean, cv_error): (Vec<f64>, Vec<f64>) =
        (0..grid.len()).map(|i| mean_and_error(errors.iter().map(|fold| fold[i]))).unzip();
    let chosen = match options.rule {
        Rule::Minimum => minimum(&cv_mean),
        Rule::OneStandardError => one_standard_error(&cv_mean, &cv_error),
    }
    .unwrap_or(0);
    let fit =
        path(options.selector, &whole.first_columns(candidates), &problem.protected, &grid[chosen..=chosen])?
            .pop()
            .ok_or(SparseError::Empty { what: "values of λ" })?;
    let mut coefficients = fit.coefficients;
    coefficients.resize(problem.rows.columns(), 0.0);
    Ok(OrderModel {
        order: r + 1,
        candidates,
        grid,
        cv_mean,
        cv_error,
        chosen,
        support: support(&coefficients),
        coefficients,
        train_rss: fit.rss,
        test_rss: f64::NAN,
        aic: f64::NAN,
        aicc: f64::NAN,
        bic: f64::NAN,
    })
}

fn effective(
    problem: &Problem<'_>,
    options: &Options,
    models: &[OrderModel],
    test_rows: usize,
) -> Result<f64, SparseError> {
    match options.sample_size {
        SampleSize::Rows => Ok(test_rows as f64),
        SampleSize::Effective => {
            let best = models.iter().min_by(|a, b| a.test_rss.total_cmp(&b.test_rss));
            let best = best.ok_or(SparseError::Empty { what: "orders" })?;
            let ranges: &[Range<usize>] = &problem.split.test;
            effective_sample_size(&problem.rows.residuals(&best.coefficients, ranges), Moment::Square)
        }
    }
}

/// Mean and standard error of the mean.
fn mean_and_error(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let n = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / n;
    let variance = values.map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (mean, (variance / n).sqrt())
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::folds::train_test;
    use crate::library::Library;
    use crate::testing::{ar1, normal};

    /// y = 2x + x v² − 0.5 v³ in a tensor library, rows and noise autocorrelated.
    fn problem_data(n: usize, seed: u64, noise: f64) -> (Vec<Vec<f64>>, Vec<f64>) {
        let (x, v) = (ar1(n, 0.97, seed), ar1(n, 0.97, seed + 10_000));
        let e = ar1(n, 0.9, seed + 20_000);
        let columns = Library::tensor(&["x", "v"], &[4, 4]).evaluate(&[&x, &v], &[]).unwrap();
        let y = (0..n).map(|i| 2.0 * x[i] + x[i] * v[i] * v[i] - 0.5 * v[i].powi(3) + noise * e[i]).collect();
        (columns, y)
    }

    fn truth() -> Vec<usize> {
        let labels = Library::tensor(&["x", "v"], &[4, 4]).labels();
        let mut at: Vec<usize> =
            ["x", "x*v^2", "v^3"].iter().map(|t| labels.iter().position(|l| l == t).unwrap()).collect();
        at.sort_unstable();
        at
    }

    fn run(columns: &[Vec<f64>], y: &[f64], options: &Options) -> Search {
        let rows = Rows::from_vecs(columns, y).unwrap();
        let split = train_test(&[0..y.len()], 0.5, 20).unwrap();
        let problem = Problem::new(rows, &[3, 8, 15, 24], &[], split).unwrap();
        search(&problem, options).unwrap()
    }

    #[test]
    fn finds_order_three_and_its_terms() {
        let (columns, y) = problem_data(4000, 1, 0.02);
        for selector in [Selector::StlsqRaw, Selector::StlsqNormalised, Selector::Backward] {
            let mut options = Options::raw();
            options.selector = selector;
            options.rule = Rule::OneStandardError;
            let found = run(&columns, &y, &options);
            assert_eq!(found.model().order, 3, "{selector:?}");
            assert_eq!(found.model().support, truth(), "{selector:?}");
            let c = &found.model().coefficients;
            assert!((c[truth()[0]] - 2.0).abs() < 0.01);
            let n = found.test_rows as f64;
            let aic = n * (found.model().test_rss / n).ln() + 6.0;
            assert!((found.model().aic - aic).abs() < 1e-9 * n);
            assert!(found.orders[0].test_rss > 10.0 * found.model().test_rss);
        }
    }

    #[test]
    fn data_without_noise_give_the_sparse_model_of_the_lowest_order() {
        let (columns, y) = problem_data(1000, 3, 0.0);
        let mut options = Options::raw();
        options.grid = logspace(1e-16, 1.0, 30);
        let found = run(&columns, &y, &options);
        assert_eq!(found.model().support, truth());
        assert_eq!(found.model().order, 3);
    }

    #[test]
    fn contiguous_folds_recover_and_random_folds_do_not() {
        // The pitfall of the thesis' notes: with correlated rows random folds leak and keep noise terms.
        let (mut contiguous_hits, mut random_hits) = (0, 0);
        for seed in 0..20 {
            let (columns, y) = problem_data(2000, 100 + seed, 0.3);
            let mut options = Options::raw();
            options.grid = logspace(1e-3, 1.0, 40);
            options.gap = 20;
            contiguous_hits += usize::from(run(&columns, &y, &options).orders[2].support == truth());
            options.fold_kind = FoldKind::RandomForDemonstration(seed);
            random_hits += usize::from(run(&columns, &y, &options).orders[2].support == truth());
        }
        assert!(contiguous_hits >= 14, "contiguous: {contiguous_hits}");
        assert!(random_hits <= 4, "random: {random_hits}");
    }

    #[test]
    fn every_selector_runs_and_keeps_the_protected_column() {
        let (columns, y) = problem_data(600, 5, 0.05);
        let columns: Vec<Vec<f64>> = columns[..8].to_vec();
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let split = train_test(&[0..600], 0.5, 0).unwrap();
        let problem = Problem::new(rows, &[3, 8], &[2], split).unwrap();
        for selector in [
            Selector::StlsqRaw,
            Selector::StlsqNormalised,
            Selector::Lasso,
            Selector::LassoRefit,
            Selector::Backward,
            Selector::BestSubset,
        ] {
            let mut options = Options::normalised();
            options.selector = selector;
            options.grid = logspace(1e-4, 10.0, 12);
            options.sample_size = SampleSize::Effective;
            let found = search(&problem, &options).unwrap();
            for model in &found.orders {
                assert!(model.support.contains(&2), "{selector:?}");
                assert_eq!(model.cv_mean.len(), model.grid.len());
                assert!(model.aic.is_finite() && model.bic.is_finite());
            }
            assert!(found.effective_rows < found.test_rows as f64);
            // Deterministic whatever the threads do.
            assert_eq!(found, search(&problem, &options).unwrap());
        }
    }

    #[test]
    fn ties_between_orders_go_to_the_lower() {
        let n = 400;
        let x = normal(n, 3);
        let columns = Library::separate_powers(&["x"], 3).evaluate(&[&x], &[]).unwrap();
        let y: Vec<f64> = x.iter().zip(normal(n, 4)).map(|(x, e)| 3.0 * x + 0.01 * e).collect();
        let split = train_test(&[0..n], 0.5, 0).unwrap();
        let problem = Problem::new(Rows::from_vecs(&columns, &y).unwrap(), &[1, 2, 3], &[], split).unwrap();
        let mut options = Options::raw();
        options.grid = vec![0.5];
        let found = search(&problem, &options).unwrap();
        assert_eq!(found.orders[2].support, [0]);
        assert_eq!(found.model().order, 1);
    }

    #[test]
    fn bad_problems_are_errors() {
        let (columns, y) = problem_data(50, 5, 0.1);
        let rows = || Rows::from_vecs(&columns, &y).unwrap();
        let split = || train_test(&[0..50], 0.5, 0).unwrap();
        assert!(matches!(Problem::new(rows(), &[], &[], split()), Err(SparseError::Empty { .. })));
        assert!(matches!(Problem::new(rows(), &[8, 3], &[], split()), Err(SparseError::Length { .. })));
        assert!(matches!(Problem::new(rows(), &[99], &[], split()), Err(SparseError::Length { .. })));
        assert!(matches!(Problem::new(rows(), &[3], &[5], split()), Err(SparseError::NoSuchColumn { .. })));
        let outside = Split { train: vec![0..10], test: vec![40..51] };
        assert!(matches!(Problem::new(rows(), &[3], &[], outside), Err(SparseError::RowRange { .. })));
        let problem = Problem::new(rows(), &[3], &[], split()).unwrap();
        let mut options = Options::raw();
        options.grid.clear();
        assert!(matches!(search(&problem, &options), Err(SparseError::Empty { .. })));
        options = Options::raw();
        options.folds = 1;
        assert!(matches!(search(&problem, &options), Err(SparseError::Option { .. })));
        options.folds = 30;
        assert!(matches!(search(&problem, &options), Err(SparseError::TooFewRows { .. })));
    }
}
