//! The flexible link from its nominal model (`greybox identify --model`): Table 2.3 as the terms that the maker's linear
//! equations lack.

use anyhow::{Context, Result, ensure};
use greybox_diagnose::{Options, Quiet, diagnose};
use greybox_model::Model;
use greybox_simulate::rigs::{LinkRun, RotaryFlexibleLink};
use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use super::super::Figure;
use super::{link_recording, median, share};
use greybox_dev::demo::Demo;
use greybox_reproduce::link::{self, Terms};
use greybox_reproduce::relative_rms;

/// Sample time and length of the records, s; noise of both angles, rad; length of the closed loop, s.
const DT: f64 = 0.005;
const SECONDS: f64 = 60.0;
const NOISE: f64 = 1e-3;
const LOOP_SECONDS: f64 = 6.0;

/// What an equation may hold, as functions of (θ, α, θ′, α′, θ″, α″, V).
type Monomial = (&'static str, fn([f64; 7]) -> f64);
const MONOMIALS: [Monomial; 12] = [
    ("theta''", |z| z[4]),
    ("alpha''", |z| z[5]),
    ("theta'", |z| z[2]),
    ("theta'^3", |z| z[2].powi(3)),
    ("theta", |z| z[0]),
    ("theta^2", |z| z[0].powi(2)),
    ("theta^3", |z| z[0].powi(3)),
    ("alpha'", |z| z[3]),
    ("alpha", |z| z[1]),
    ("alpha^2", |z| z[1].powi(2)),
    ("sign(theta')", |z| z[2].signum()),
    ("v", |z| z[6]),
];
const NAMES: [&str; 7] = ["theta", "alpha", "theta'", "alpha'", "theta''", "alpha''", "v"];

/// An equation as coefficients of the monomials; `None` where it holds anything else.
fn coefficients(model: &Model, equation: &str) -> Option<DVector<f64>> {
    let residual = model.equations[model.equation(equation)?].residual();
    let mut random = Pcg64Mcg::seed_from_u64(1);
    let points: Vec<[f64; 7]> =
        (0..60).map(|_| std::array::from_fn(|_| random.random_range(-1.0..1.0))).collect();
    let design = DMatrix::from_fn(points.len(), MONOMIALS.len(), |i, j| MONOMIALS[j].1(points[i]));
    let value = |z: &[f64; 7]| {
        residual.eval(&|name, primes| {
            let primed = format!("{name}{}", "'".repeat(usize::from(primes)));
            let parameter = || Some(model.parameters[model.parameter(name)?].value);
            NAMES.iter().position(|n| *n == primed).map(|at| z[at]).or_else(parameter)
        })
    };
    let values: Vec<f64> = points.iter().map(value).collect::<Option<_>>()?;
    let values = DVector::from(values);
    let found = design.clone().svd(true, true).solve(&values, 0.0).ok()?;
    ((&design * &found - &values).norm() < 1e-9 * values.norm()).then_some(found)
}

/// One seed's result.
struct Trial {
    /// Whether the hub and the link hold the monomials of the rig and no others.
    exact: [bool; 2],
    /// Relative RMS errors of θ and α in the closed loop; `None` where the equations hold anything else.
    closed_loop: Option<[f64; 2]>,
}

impl Trial {
    fn of(seed: u64, nominal: &Model, truth: &LinkRun) -> Result<Self> {
        let train = [link_recording(seed, DT, SECONDS, NOISE)?];
        let holdout = [link_recording(seed + 10_000, DT, 15.0, NOISE)?];
        let options = Options { terms_only: true, ..Options::default() };
        let found = diagnose(nominal, &train, &holdout, &options, &Quiet)?;
        let equations = ["hub", "link"].map(|name| coefficients(&found.improved, name));
        let [Some(hub), Some(link)] = equations else {
            return Ok(Trial { exact: [false; 2], closed_loop: None });
        };
        let holds = |equation: &DVector<f64>, name: &str| {
            let at = MONOMIALS.iter().position(|m| m.0 == name).unwrap_or(0);
            equation[at].abs() > 1e-12 * equation.norm()
        };
        // θ² is in the second equation 1/500 of what it is in the first: no record shows it.
        let is_exact = |equation: &DVector<f64>, without: &str, open: &str| {
            MONOMIALS.iter().all(|m| m.0 == open || holds(equation, m.0) == (m.0 != without))
        };
        let exact = [is_exact(&hub, "alpha''", ""), is_exact(&link, "v", "theta^2")];
        Ok(Trial { exact, closed_loop: closed_loop(&hub, &link, truth)? })
    }
}

/// The errors of the closed loop, of equations in the form of the thesis: θ″ eliminated from the second.
fn closed_loop(hub: &DVector<f64>, link: &DVector<f64>, truth: &LinkRun) -> Result<Option<[f64; 2]>> {
    let [theta_accelerates, alpha_accelerates, volts] = [0, 1, MONOMIALS.len() - 1];
    let eliminated = hub - link * (hub[theta_accelerates] / link[theta_accelerates]);
    let balances = [hub / -hub[volts], eliminated / -hub[volts]];
    if balances[0][alpha_accelerates].abs() > 1e-9 * balances[0].norm() {
        return Ok(None);
    }
    let terms = balances.map(|balance| -> Terms {
        let named = MONOMIALS.iter().zip(balance.iter()).take(volts);
        let own = named.filter(|(_, value)| value.abs() > 1e-12);
        own.map(|(monomial, value)| (monomial.0.to_owned(), *value)).collect()
    });
    let [theta, alpha] = &terms;
    let run = link::closed_loop(&link::rig(theta, alpha)?, LOOP_SECONDS)?;
    let angle = |run: &LinkRun, k: usize| -> Vec<f64> { run.states.iter().map(|state| state[k]).collect() };
    Ok(Some([0, 1].map(|k| relative_rms(&angle(&run, k), &angle(truth, k)))))
}

pub(super) fn case(seeds: &[u64]) -> Result<Vec<Figure>> {
    let nominal = Demo::read()?.model;
    let truth = link::closed_loop(&RotaryFlexibleLink::IDENTIFIED, LOOP_SECONDS)?;
    let trials: Vec<Trial> = seeds
        .par_iter()
        .map(|&seed| Trial::of(seed, &nominal, &truth).with_context(|| format!("seed {seed}")))
        .collect::<Result<_>>()?;
    let n = trials.len();
    ensure!(n > 0, "no seeds");
    let both = trials.iter().filter(|t| t.exact == [true; 2]).count();
    let errors = [0, 1].map(|k| {
        let each = || trials.iter().map(move |t| t.closed_loop.map_or(f64::INFINITY, |errors| errors[k]));
        (median(each().collect()), each().fold(0.0, f64::max))
    });
    let text = errors.map(|(middle, worst)| format!("{:.2} %, {:.2} %", 100.0 * middle, 100.0 * worst));
    Ok(vec![
        Figure::judged(
            "both equations exact",
            format!("{both} of {n}"),
            ">= 18 of 20",
            both >= share(18, 20, n),
        ),
        Figure::judged(
            "closed loop, error of theta and alpha: median, worst",
            text.join("; "),
            "medians <= 0.5 %; <= 3 %",
            errors[0].0 <= 0.005 && errors[1].0 <= 0.03,
        ),
    ])
}
