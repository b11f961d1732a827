//! Algorithm 2 on the flexible joint of section 3.4, as a virtual rig with friction.

use std::sync::OnceLock;

use anyhow::{Context, Result, anyhow};
use greybox_algebraic::{Column, Hold, Kernel};
use greybox_delay::exact::{self, Gain};
use greybox_delay::taylor::{self, Data, Model, Order, Search};
use greybox_delay::windows::{self, Before, Windowed};
use greybox_recording::smooth::savitzky_golay;
use greybox_simulate::rigs::{RotaryFlexibleJoint, Sampling, Sine, multisine, square_wave};
use greybox_sparse::select::logspace;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

use super::delayed::Which;
use super::link::Equation;

/// Sample time of the thesis's records, s.
pub(crate) const STEP: f64 = 1e-3;
/// The joint with the constants of Table 3.5 and Coulomb friction of 0.02 N m.
pub(crate) const RIG: RotaryFlexibleJoint = RotaryFlexibleJoint::WITH_FRICTION;
/// a kp, N m/rad.
pub(crate) const TORQUE_PER_RADIAN: f64 = RIG.torque_per_volt * RIG.gain;
/// Highest order of the polynomials.
pub(crate) const ORDERS: usize = 7;
/// Standard deviation of the noise on both angles, rad.
const NOISE: f64 = 1e-3;
/// The velocity over which the sign of θ' is smoothed, rad/s.
const SIGN_WIDTH: f64 = 0.05;

/// What is recorded of the joint, with smoothed velocities.
#[derive(Debug, Clone)]
struct Record {
    theta: Vec<f64>,
    alpha: Vec<f64>,
    theta_rate: Vec<f64>,
    alpha_rate: Vec<f64>,
    reference: Vec<f64>,
}

impl Record {
    /// One minute on 2 sin(2π 0.66 t), the training record, or on a square wave of ±1 rad at 0.66 Hz.
    fn new(which: Which, seed: u64) -> Result<Self> {
        let sine = [Sine { amplitude: 2.0, frequency: 0.66, phase: 0.0 }];
        let reference = |t: f64| match which {
            Which::Training => multisine(&sine, t),
            Which::Test => square_wave(1.0, 0.66, t),
        };
        let samples = (60.0 / STEP).round() as usize + 1;
        let run = RIG.run(Sampling { dt: STEP, substeps: 1 }, [0.0; 4], samples, reference)?;
        let mut random = Pcg64Mcg::seed_from_u64(2 * seed + u64::from(which == Which::Test));
        let normal = Normal::new(0.0, NOISE)?;
        let mut measured =
            |i: usize| -> Vec<f64> { run.states.iter().map(|s| s[i] + normal.sample(&mut random)).collect() };
        let (theta, alpha) = (measured(0), measured(1));
        let rate = |signal: &[f64]| savitzky_golay(signal, STEP, 61, 5).d1;
        Ok(Self {
            theta_rate: rate(&theta),
            alpha_rate: rate(&alpha),
            theta,
            alpha,
            reference: (0..samples).map(|k| reference(k as f64 * STEP)).collect(),
        })
    }

    fn sign(&self) -> Vec<f64> {
        self.theta_rate.iter().map(|v| (v / SIGN_WIDTH).tanh()).collect()
    }
}

/// Names of the columns of an equation.
pub(crate) fn terms(equation: Equation, order: usize) -> Vec<String> {
    let mut names = vec!["theta''".to_owned()];
    if equation == Equation::Alpha {
        names.push("alpha''".into());
    }
    names.push("sign(theta')".into());
    for n in 1..=order {
        let power = |name: &str| if n == 1 { name.to_owned() } else { format!("{name}^{n}") };
        names.extend(["theta", "theta'", "alpha", "alpha'"].map(power));
    }
    names
}

/// Columns and target.
type Rows = (Vec<Vec<f64>>, Vec<f64>);

/// The left side of equation 3.24 (or 3.25, whose right side has the other sign) by terms, and its right side
/// a kp (θ_d − θ) + b θ'.
fn rows(record: &Record, equation: Equation, order: usize) -> Result<Rows> {
    let kernel = Kernel::new(2, 3, 500, STEP)?;
    let smooth = |signal, order| Column { signal, order, hold: Hold::Smooth };
    let sign = record.sign();
    let power = |s: &[f64], n: usize| -> Vec<f64> { s.iter().map(|s| s.powi(n as i32)).collect() };
    let signals = [&record.theta, &record.theta_rate, &record.alpha, &record.alpha_rate];
    let library: Vec<Vec<f64>> = (1..=order).flat_map(|n| signals.map(|s| power(s, n))).collect();
    let mut columns = vec![smooth(&record.theta, 2)];
    if equation == Equation::Alpha {
        columns.push(smooth(&record.alpha, 2));
    }
    columns.push(smooth(&sign, 0));
    columns.extend(library.iter().enumerate().map(|(i, term)| match i {
        1 => smooth(&record.theta, 1),
        3 => smooth(&record.alpha, 1),
        _ => smooth(term, 0),
    }));
    columns.push(Column { signal: &record.reference, order: 0, hold: Hold::Zero });
    columns.push(smooth(&record.theta, 0));
    columns.push(smooth(&record.theta, 1));
    let mut rows = greybox_algebraic::rows(&kernel, &columns, 20)?.columns;
    let rate = rows.pop().context("no columns")?;
    let angle = rows.pop().context("no columns")?;
    let reference = rows.pop().context("no columns")?;
    let side = if equation == Equation::Theta { 1.0 } else { -1.0 };
    let torque = |i: usize| TORQUE_PER_RADIAN * (reference[i] - angle[i]) + RIG.back_emf * rate[i];
    let target = (0..rate.len()).map(|i| side * torque(i)).collect();
    Ok((rows, target))
}

/// Algorithm 2 with the numbers of section 3.4: trained on the sine, tested on the square wave.
fn search(equation: Equation, seed: u64) -> Result<Search> {
    let train = rows(&Record::new(Which::Training, seed)?, equation, ORDERS)?;
    let test = rows(&Record::new(Which::Test, seed)?, equation, ORDERS)?;
    let orders: Vec<Order> =
        (1..=ORDERS).map(|order| Order { order, columns: terms(equation, order).len() }).collect();
    let protected = if equation == Equation::Theta { 1 } else { 2 };
    let options = taylor::Options {
        replicates: 10,
        thresholds: logspace(1e-10, 1.0, 100),
        ..taylor::Options::thesis(protected, seed)
    };
    let data = [&train, &test].map(|(columns, target)| Data { columns, target });
    Ok(taylor::search(data[0], data[1], &orders, &options)?)
}

/// A term's mean and standard deviation over the bootstrap; zero where fewer than half of the replicates have it.
pub(crate) fn estimate(model: &Model, equation: Equation, term: &str) -> (f64, f64) {
    let place = terms(equation, model.order).iter().position(|name| name == term);
    let kept = place.filter(|j| model.inclusion.get(*j).is_some_and(|share| *share >= 0.5));
    kept.map_or((0.0, 0.0), |j| (model.coefficients[j], model.std[j]))
}

/// Regression with θ(t − τ) itself: coefficients Jeq, Beq, −ks and the friction.
pub(crate) fn exact_delay(which: Which) -> Result<exact::Fit> {
    let record = Record::new(which, SEED)?;
    let kernel = Kernel::new(2, 3, 500, STEP)?;
    let sign = record.sign();
    let column = |signal, order, hold| Column { signal, order, hold };
    let known = [
        (TORQUE_PER_RADIAN, column(&record.reference, 0, Hold::Zero)),
        (RIG.back_emf, column(&record.theta, 1, Hold::Smooth)),
    ];
    let columns = [
        column(&record.theta, 2, Hold::Smooth),
        column(&record.theta, 1, Hold::Smooth),
        column(&record.alpha, 0, Hold::Smooth),
        column(&sign, 0, Hold::Smooth),
    ];
    let held = Before::Held(0.5);
    let rows = Windowed::new(&kernel, 10, &known, &columns, &record.theta, Hold::Zero, held)?;
    Ok(windows::fit(&[rows], &exact::Options::new(Gain::Known(TORQUE_PER_RADIAN), 0.0, 0.5))?)
}

/// Seed of the records behind the page's tables and figures.
const SEED: u64 = 1;

/// Both equations by Algorithm 2.
pub(crate) fn of_the_page() -> Result<&'static [Search; 2]> {
    static ONCE: OnceLock<Result<[Search; 2]>> = OnceLock::new();
    let made = ONCE.get_or_init(|| Ok([search(Equation::Theta, SEED)?, search(Equation::Alpha, SEED)?]));
    made.as_ref().map_err(|e| anyhow!("{e:#}"))
}
