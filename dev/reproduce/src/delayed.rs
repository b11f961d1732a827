//! The oscillator with delayed feedback of section 3.3 and Algorithm 2 on it.

use std::sync::OnceLock;

use anyhow::{Context, Result, anyhow};
use greybox_algebraic::{Column, Hold, Initial, Iterated, Kernel, Restart};
use greybox_delay::exact::{self, Gain};
use greybox_delay::taylor::{self, Data, Model, Order, Search};
use greybox_delay::windows::{self, Before, Windowed};
use greybox_identify::{DelayedState, Identification, Options, Quiet, identify};
use greybox_recording::smooth::savitzky_golay;
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::{DelayedDuffing, Sampling};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

use super::duffing::Velocity;

/// Sample time, s.
pub(crate) const STEP: f64 = 1e-3;
/// Standard deviation of the noise on displacement and force.
const NOISE: f64 = 0.01;
/// The gain of the feedback, known.
const GAIN: f64 = DelayedDuffing::THESIS.gain;
/// Highest order of the polynomial.
pub(crate) const ORDERS: usize = 6;

/// The two recordings of section 3.3.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Which {
    /// The chirp.
    Training,
    /// Two sines.
    Test,
}

/// What is recorded, and the velocity that is not.
#[derive(Debug, Clone)]
struct Record {
    displacement: Vec<f64>,
    velocity: Vec<f64>,
    force: Vec<f64>,
}

impl Record {
    fn new(which: Which, seconds: f64, seed: u64) -> Result<Self> {
        let (start, force): (_, fn(f64) -> f64) = match which {
            Which::Training => (DelayedDuffing::TRAINING_START, DelayedDuffing::training_force),
            Which::Test => (DelayedDuffing::TEST_START, DelayedDuffing::test_force),
        };
        let samples = (seconds / STEP).round() as usize + 1;
        let sampling = Sampling { dt: STEP, substeps: 1 };
        let states = DelayedDuffing::THESIS.run(sampling, start, samples, force)?;
        let mut random = Pcg64Mcg::seed_from_u64(2 * seed + u64::from(which == Which::Test));
        let normal = Normal::new(0.0, NOISE)?;
        Ok(Self {
            displacement: states.iter().map(|s| s[0] + normal.sample(&mut random)).collect(),
            velocity: states.iter().map(|s| s[1]).collect(),
            force: (0..samples).map(|k| force(k as f64 * STEP) + normal.sample(&mut random)).collect(),
        })
    }

    fn velocity(&self, from: Velocity) -> Result<Vec<f64>> {
        Ok(match from {
            Velocity::True => self.velocity.clone(),
            Velocity::Observer => super::duffing::observed(&self.displacement)?,
            Velocity::Smoothed => savitzky_golay(&self.displacement, STEP, 101, 5).d1,
        })
    }
}

/// How records become rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Variant {
    /// Where the velocity in the nonlinear terms comes from.
    pub(crate) velocity: Velocity,
    /// Whether windows of 1 s with the kernel t²(T − t)² take the place of equation 3.10 over the whole record.
    pub(crate) windows: bool,
    /// Length of the records, s.
    pub(crate) seconds: f64,
}

impl Variant {
    /// Equation 3.10 as printed, with the initial condition of x''' left in (E13), and a true velocity.
    pub(crate) const PRINTED: Self = Self { velocity: Velocity::True, windows: false, seconds: 5.0 };
    /// Windows, with a true velocity.
    pub(crate) const WINDOWED: Self = Self { velocity: Velocity::True, windows: true, seconds: 10.0 };
}

/// Exponents (i, j) of xⁱ x'ʲ without the constant; order N adds those with max(i, j) = N.
fn powers(order: usize) -> Vec<(i32, i32)> {
    let added = |n: i32| (0..n).map(move |i| (i, n)).chain((0..=n).map(move |j| (n, j)));
    (1..=order as i32).flat_map(added).collect()
}

/// Names of the columns of an order.
pub(crate) fn terms(order: usize) -> Vec<String> {
    let power = |name: &str, exponent: i32| match exponent {
        0 => None,
        1 => Some(name.to_owned()),
        n => Some(format!("{name}^{n}")),
    };
    let product = |(i, j): (i32, i32)| {
        let factors: Vec<String> = [power("x", i), power("x'", j)].into_iter().flatten().collect();
        factors.join("*")
    };
    let mut names = vec!["x'''".to_owned(), "x''".to_owned()];
    names.extend(powers(order).into_iter().map(product));
    names
}

/// The exact coefficients of the expansion to third order (E12), of the terms that are there.
pub(crate) fn truth() -> [(&'static str, f64); 7] {
    let p = DelayedDuffing::THESIS;
    [
        ("x'''", p.gain * p.delay.powi(3) / 6.0),
        ("x''", p.m - 0.5 * p.gain * p.delay.powi(2)),
        ("x", p.k1 - p.gain),
        ("x^3", p.k3),
        ("x'", p.c1 + p.gain * p.delay),
        ("x'^3", p.c3),
        ("x^2*x'", p.c2),
    ]
}

/// Columns and target.
type Rows = (Vec<Vec<f64>>, Vec<f64>);

fn rows(record: &Record, variant: Variant) -> Result<Rows> {
    let velocity = record.velocity(variant.velocity)?;
    let powers = powers(ORDERS);
    let product = |&(i, j): &(i32, i32)| -> Vec<f64> {
        record.displacement.iter().zip(&velocity).map(|(x, v)| x.powi(i) * v.powi(j)).collect()
    };
    let products: Vec<Vec<f64>> = powers.iter().map(product).collect();
    let smooth = |signal, order| Column { signal, order, hold: Hold::Smooth };
    let mut columns = vec![smooth(&record.displacement, 3), smooth(&record.displacement, 2)];
    columns.extend(powers.iter().zip(&products).map(|(power, product)| match power {
        (0, 1) => smooth(&record.displacement, 1),
        _ => smooth(product, 0),
    }));
    columns.push(smooth(&record.force, 0));
    let mut rows = if variant.windows {
        let kernel = Kernel::new(2, 3, 1000, STEP)?.with_initial(Initial::FirstSample);
        greybox_algebraic::rows(&kernel, &columns, 10)?.columns
    } else {
        let restart = Restart { intervals: record.force.len() - 1, hop: 1, every: 10 };
        Iterated::new(2, 3, STEP)?.with_initial(Initial::Separate).rows(&columns, restart)?.columns
    };
    let target = rows.pop().context("no columns")?;
    Ok((rows, target))
}

/// Algorithm 2 over orders 1 to `last`, with the numbers of section 3.3.
pub(crate) fn search(variant: Variant, last: usize, seed: u64) -> Result<Search> {
    let train = rows(&Record::new(Which::Training, variant.seconds, seed)?, variant)?;
    let test = rows(&Record::new(Which::Test, variant.seconds, seed)?, variant)?;
    let orders: Vec<Order> =
        (1..=last).map(|order| Order { order, columns: 2 + powers(order).len() }).collect();
    let data = [&train, &test].map(|(columns, target)| Data { columns, target });
    Ok(taylor::search(data[0], data[1], &orders, &taylor::Options::thesis(2, seed))?)
}

/// A term's mean and standard deviation over the bootstrap; zero where fewer than half of the replicates have it.
pub(crate) fn estimate(model: &Model, term: &str) -> (f64, f64) {
    let place = terms(model.order).iter().position(|name| name == term);
    let kept = place.filter(|j| model.inclusion.get(*j).is_some_and(|share| *share >= 0.5));
    kept.map_or((0.0, 0.0), |j| (model.coefficients[j], model.std[j]))
}

/// Whether the terms of a model are those of the oscillator.
pub(crate) fn is_exact(model: &Model) -> bool {
    let names = terms(model.order);
    let mut active: Vec<&str> = model.active().into_iter().map(|j| names[j].as_str()).collect();
    let mut wanted = truth().map(|(term, _)| term);
    active.sort_unstable();
    wanted.sort_unstable();
    active == wanted
}

/// The delay in s from the coefficient of x''', a signed root (E14: the gain is known).
pub(crate) fn delay_from_jerk(coefficient: f64) -> f64 {
    (6.0 * coefficient / GAIN).cbrt()
}

/// Regression with x(t − τ) itself instead of its expansion, the true terms and both records of 20 s.
pub(crate) fn exact_delay(velocity: Velocity, seed: u64) -> Result<exact::Fit> {
    let kernel = Kernel::new(2, 3, 1000, STEP)?;
    let mut recordings = Vec::new();
    for which in [Which::Training, Which::Test] {
        let record = Record::new(which, 20.0, seed)?;
        let velocity = record.velocity(velocity)?;
        let x = &record.displacement;
        let cube: Vec<f64> = x.iter().map(|x| x.powi(3)).collect();
        let third: Vec<f64> = cube.iter().map(|x| x / 3.0).collect();
        let drag: Vec<f64> = velocity.iter().map(|v| v.powi(3)).collect();
        let smooth = |signal, order| Column { signal, order, hold: Hold::Smooth };
        // x² x' = (x³/3)' needs no velocity.
        let columns =
            [smooth(x, 2), smooth(x, 1), smooth(&third, 1), smooth(&drag, 0), smooth(x, 0), smooth(&cube, 0)];
        let force = [(1.0, smooth(&record.force, 0))];
        recordings.push(Windowed::new(&kernel, 20, &force, &columns, x, Hold::Smooth, Before::Held(0.5))?);
    }
    // The feedback stands on the left here.
    Ok(windows::fit(&recordings, &exact::Options::new(Gain::Known(-GAIN), 0.0, 0.5))?)
}

/// `greybox identify` on both records of 20 s: terms unknown, gain known, the delay between 0 and 0.5 s.
pub(crate) fn identified(seed: u64) -> Result<Identification> {
    let record = |which, name: &str| -> Result<Recording> {
        let record = Record::new(which, 20.0, seed)?;
        let time = (0..record.force.len()).map(|k| k as f64 * STEP).collect();
        let channel = |name: &str, values| Channel { name: name.into(), unit: None, values };
        let channels = vec![channel("f", record.force), channel("x", record.displacement)];
        Ok(Recording::from_columns(name, time, channels)?)
    };
    let recordings = [record(Which::Training, "train.csv")?, record(Which::Test, "test.csv")?];
    let options = Options {
        order: 3,
        hold: Some(greybox_model::Hold::Linear),
        replicates: 0,
        delay: Some(DelayedState { state: "x".into(), gain: Some(GAIN), longest: 0.5 }),
        ..Options::new(&["x"], &["f"])
    };
    Ok(identify(&recordings, &recordings[..1], &options, &Quiet)?)
}

/// Seed of the records behind the page's tables and figures.
pub(crate) const SEED: u64 = 1;

/// The searches of the page: as printed and windowed, orders 1 to 6.
pub(crate) fn of_the_page() -> Result<&'static [Search; 2]> {
    static ONCE: OnceLock<Result<[Search; 2]>> = OnceLock::new();
    let made = ONCE.get_or_init(|| {
        let find = |variant| search(variant, ORDERS, SEED);
        Ok([find(Variant::PRINTED)?, find(Variant::WINDOWED)?])
    });
    made.as_ref().map_err(|e| anyhow!("{e:#}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exact_coefficients_are_those_of_table_3_1() {
        let folder = greybox_dev::root().join("fixtures").join("thesis");
        let table = super::super::fixture::Fixture::read(&folder, "Table 3.1").unwrap();
        for (term, value) in truth() {
            assert!((table.number(term, "truth").unwrap() - value).abs() < 1e-7, "{term}");
        }
        assert!((delay_from_jerk(truth()[0].1) - 0.2).abs() < 1e-12);
    }

    #[test]
    fn columns_have_the_names_of_table_3_1() {
        let folder = greybox_dev::root().join("fixtures").join("thesis");
        let table = super::super::fixture::Fixture::read(&folder, "Table 3.1").unwrap();
        let names = terms(3);
        assert_eq!(names.len(), 2 + 15);
        assert!(table.rows.iter().all(|row| names.iter().any(|name| row["name"] == name.as_str())));
    }
}
