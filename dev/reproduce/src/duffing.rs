//! The oscillator of section 2.2 and Algorithm 1 on it: as the thesis prints it, and with what makes it work.

use std::sync::OnceLock;

use anyhow::{Context, Result, anyhow};
use greybox_algebraic::{Column, Hold, Iterated, Kernel, Restart};
use greybox_eso::{Design, Observer, Scheme, record};
use greybox_identify::{Identification, Options, Quiet, identify};
use greybox_recording::smooth::savitzky_golay;
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::{Duffing, Sampling};
use greybox_sparse::folds::train_test;
use greybox_sparse::select::{self, FoldKind, Selector};
use greybox_sparse::{Library, Problem, Rows, Search};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

/// Sample time, s; the thesis does not say which it used in this example.
pub(crate) const STEP: f64 = 1e-3;
/// Length of the record, s; not stated either.
pub(crate) const SECONDS: f64 = 60.0;
/// Standard deviation of the noise on the displacement and on the force.
const NOISE: f64 = 0.01;
/// Highest order of the polynomial.
pub(crate) const ORDERS: u32 = 6;
/// The terms that are in equation 2.18, with their coefficients.
pub(crate) const TRUTH: [(&str, f64); 6] =
    [("x''", 2.0), ("x", 6.0), ("x'", 1.0), ("x^3", 0.1), ("x^2*x'", 0.2), ("x'^3", 1.0)];

/// What is recorded, and the velocity that is not.
#[derive(Debug, Clone)]
pub(crate) struct Record {
    /// Displacement with noise.
    displacement: Vec<f64>,
    /// True velocity.
    velocity: Vec<f64>,
    /// Force with noise.
    force: Vec<f64>,
}

impl Record {
    /// Equation 2.18 under the force 2.19 from x = 1, at rest.
    pub(crate) fn new(seed: u64) -> Result<Self> {
        let samples = (SECONDS / STEP).round() as usize + 1;
        let sampling = Sampling { dt: STEP, substeps: 1 };
        let states = Duffing::THESIS.run(sampling, [1.0, 0.0], samples, Duffing::thesis_force)?;
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let normal = Normal::new(0.0, NOISE)?;
        Ok(Self {
            displacement: states.iter().map(|s| s[0] + normal.sample(&mut random)).collect(),
            velocity: states.iter().map(|s| s[1]).collect(),
            force: (0..samples)
                .map(|k| Duffing::thesis_force(k as f64 * STEP) + normal.sample(&mut random))
                .collect(),
        })
    }

    fn velocity(&self, from: Velocity) -> Result<Vec<f64>> {
        Ok(match from {
            Velocity::True => self.velocity.clone(),
            Velocity::Observer => observed(&self.displacement)?,
            Velocity::Smoothed => savitzky_golay(&self.displacement, STEP, 401, 5).d1,
        })
    }
}

/// The velocity by the observer of equations 2.22 and 3.27, every millisecond, as it runs in real time.
pub(crate) fn observed(position: &[f64]) -> Result<Vec<f64>> {
    let observer = Observer::new(Design::thesis(), STEP, Scheme::Euler)?;
    let mut states = vec![[0.0; 2]; position.len()];
    record::forward(&observer, position, None, &mut states)?;
    Ok(states.iter().map(|z| z[1]).collect())
}

/// Where the velocity in the nonlinear terms comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Velocity {
    /// Known without error.
    True,
    /// The second state of the observer 2.22, as it runs in real time.
    Observer,
    /// The derivative of a Savitzky–Golay fit of order 5 over 0.4 s, without a lag.
    Smoothed,
}

/// Over what the equation of motion is integrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Integrals {
    /// Equation 2.10 from the start of the record, a row every 10 samples.
    WholeRecord,
    /// Windows of 1 s with the kernel t²(T − t)², one every 20 ms.
    Windows,
}

/// A variant of Algorithm 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Variant {
    /// Where the velocity comes from.
    pub(crate) velocity: Velocity,
    /// Over what is integrated.
    pub(crate) integrals: Integrals,
    /// How sparse models are found.
    pub(crate) selector: Selector,
    /// How the folds are made.
    pub(crate) folds: FoldKind,
    /// The smallest λ that is tried; the largest is one, and there are 20 in a decade.
    pub(crate) smallest: f64,
}

impl Variant {
    /// What the thesis prints: equation 2.10 over the whole record with the observer's velocity.
    pub(crate) const PRINTED: Self =
        Self { velocity: Velocity::Observer, integrals: Integrals::WholeRecord, ..Self::WINDOWED };
    /// What makes it work.
    pub(crate) const WINDOWED: Self = Self {
        velocity: Velocity::Smoothed,
        integrals: Integrals::Windows,
        selector: Selector::StlsqRaw,
        folds: FoldKind::Contiguous,
        smallest: 1e-2,
    };
}

/// Names of the columns that Algorithm 1 chooses from, in their order.
pub(crate) fn terms() -> Vec<String> {
    let mut names = vec!["x''".to_owned()];
    names.extend(library().labels());
    names
}

fn library() -> Library {
    Library::tensor(&["x", "x'"], &[ORDERS, ORDERS])
}

/// Algorithm 1: orders 1 to 6, half of the rows for training, λ by cross-validation with five folds, AIC.
pub(crate) fn search(record: &Record, variant: Variant) -> Result<Search> {
    let velocity = record.velocity(variant.velocity)?;
    let library = library();
    let products = library.evaluate(&[&record.displacement, &velocity], &[])?;
    let column = |signal, order| Column { signal, order, hold: Hold::Smooth };
    let mut columns = vec![column(&record.displacement, 2)];
    columns.extend(library.labels().iter().zip(&products).map(|(label, product)| match label.as_str() {
        // Equation 2.10 has the damping's velocity as a derivative of x.
        "x'" => column(&record.displacement, 1),
        _ => column(product, 0),
    }));
    columns.push(column(&record.force, 0));
    let (mut rows, gap) = match variant.integrals {
        Integrals::WholeRecord => {
            let restart = Restart { intervals: record.force.len() - 1, hop: 1, every: 10 };
            (Iterated::new(2, 2, STEP)?.rows(&columns, restart)?.columns, 0)
        }
        Integrals::Windows => {
            let (intervals, hop) = (1000, 20);
            let kernel = Kernel::new(2, 3, intervals, STEP)?;
            (greybox_algebraic::rows(&kernel, &columns, hop)?.columns, intervals / hop)
        }
    };
    let target = rows.pop().context("no columns")?;
    let orders: Vec<usize> = library.lengths().iter().map(|length| length + 1).collect();
    let all = 0..target.len();
    let split = train_test(std::slice::from_ref(&all), 0.5, gap)?;
    let problem = Problem::new(Rows::from_vecs(&rows, &target)?, &orders, &[0], split)?;
    let count = (-20.0 * variant.smallest.log10()).round() as usize;
    let grid = select::logspace(variant.smallest, 1.0, count);
    let options = select::Options {
        selector: variant.selector,
        fold_kind: variant.folds,
        grid,
        ..select::Options::raw()
    };
    Ok(select::search(&problem, &options)?)
}

/// Whether the terms chosen are those of equation 2.18.
pub(crate) fn is_exact(search: &Search) -> bool {
    let names = terms();
    let mut chosen: Vec<&str> = search.model().support.iter().map(|&j| names[j].as_str()).collect();
    let mut wanted: Vec<&str> = TRUTH.iter().map(|(name, _)| *name).collect();
    chosen.sort_unstable();
    wanted.sort_unstable();
    chosen == wanted
}

/// The coefficient of a term in the model of an order.
pub(crate) fn coefficient(search: &Search, order: usize, term: &str) -> f64 {
    let place = terms().iter().position(|name| name == term);
    place.and_then(|j| search.orders.get(order - 1)?.coefficients.get(j).copied()).unwrap_or(0.0)
}

/// What a variant finds in several records.
#[derive(Debug, Clone)]
pub(crate) struct Tally {
    /// Records.
    pub(crate) records: usize,
    /// Of these, with the least AIC at order 3 (a tie goes to the smaller order).
    pub(crate) order_three: usize,
    /// With exactly the terms of equation 2.18 at the least AIC.
    pub(crate) exact: usize,
    /// Median |error| of the coefficients in the order of [`TRUTH`], in %; a missing term is 100 % off.
    pub(crate) medians: [f64; 6],
}

/// Runs a variant on records of consecutive seeds.
pub(crate) fn tally(records: &[Record], variant: Variant) -> Result<Tally> {
    let searches = records.iter().map(|record| search(record, variant)).collect::<Result<Vec<_>>>()?;
    let error = |search: &Search, (term, truth): (&str, f64)| {
        100.0 * (coefficient(search, search.model().order, term) / truth - 1.0).abs()
    };
    Ok(Tally {
        records: records.len(),
        order_three: searches.iter().filter(|s| s.model().order == 3).count(),
        exact: searches.iter().filter(|s| is_exact(s)).count(),
        medians: TRUTH.map(|term| super::median(searches.iter().map(|s| error(s, term)).collect())),
    })
}

/// The record behind the page's tables and figures.
const SEED: u64 = 1;

/// The search of a variant on the record of the page.
pub(crate) fn of_the_page(variant: Variant) -> Result<Search> {
    search(&Record::new(SEED)?, variant)
}

/// What `greybox identify` makes of the record of the page: it fits the displacement, not the equation.
pub(crate) fn identified() -> Result<&'static Identification> {
    static ONCE: OnceLock<Result<Identification>> = OnceLock::new();
    let made = ONCE.get_or_init(|| {
        let record = Record::new(SEED)?;
        let time = (0..record.force.len()).map(|k| k as f64 * STEP).collect();
        let channel = |name: &str, values| Channel { name: name.into(), unit: None, values };
        let channels = vec![channel("f", record.force), channel("x", record.displacement)];
        let recording = Recording::from_columns("oscillator.csv", time, channels)?;
        let hold = Some(greybox_model::Hold::Linear);
        let options = Options { hold, replicates: 0, ..Options::new(&["x"], &["f"]) };
        let recordings = [recording];
        Ok(identify(&recordings, &recordings, &options, &Quiet)?)
    });
    made.as_ref().map_err(|e| anyhow!("{e:#}"))
}
