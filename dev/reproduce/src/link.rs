//! The rotary flexible link of section 2.3 as a virtual rig: its coefficients are those that the thesis identified
//! (Table 2.3), its recordings stand for those that are not public.

use std::f64::consts::TAU;
use std::sync::OnceLock;

use anyhow::{Context, Result, anyhow, bail};
use greybox_algebraic::{Column, Hold, Iterated, Kernel, Restart};
use greybox_identify::{
    FoundEquation, Identification, Library as Candidates, Monomials, Options, Quiet, identify,
};
use greybox_recording::smooth::savitzky_golay;
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::{
    LinkRun, ProportionalController, RotaryFlexibleLink, Sampling, Sine, VoltageBalance, multisine,
    square_wave,
};
use greybox_sparse::folds::train_test;
use greybox_sparse::select;
use greybox_sparse::{Function, Library, Problem, Rows, Search, Term};
use rand::RngExt;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

use super::duffing::{Integrals, Velocity};

/// Sample time of the thesis's records, s.
pub(crate) const STEP: f64 = 1e-3;
/// Length of a record, s.
pub(crate) const SECONDS: f64 = 60.0;
/// Standard deviation of the noise on both angles, rad.
const NOISE: f64 = 1e-3;
/// Highest order of the polynomials.
pub(crate) const ORDERS: u32 = 4;
/// Frequencies of the dither, Hz: below, around and above the link's resonance at 4.5 Hz.
const DITHER_HZ: [f64; 6] = [0.7, 1.3, 2.9, 4.3, 6.1, 8.9];
/// Amplitude of each of its sines, V.
const DITHER: f64 = 0.12;

/// The angles as measured, the voltage, and the true velocities, which are not recorded.
#[derive(Debug, Clone)]
pub(crate) struct Record {
    theta: Vec<f64>,
    alpha: Vec<f64>,
    volts: Vec<f64>,
    rates: [Vec<f64>; 2],
}

/// The reference of the thesis: ±30°, 0.66 Hz.
pub(crate) fn reference(t: f64) -> f64 {
    square_wave(30f64.to_radians(), 0.66, t)
}

impl Record {
    /// The loop V = kp (θ_d − θ) with kp = √10 (E16) closed over the measured angle, with or without a dither.
    pub(crate) fn new(seed: u64, dithered: bool) -> Result<Self> {
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let normal = Normal::new(0.0, NOISE)?;
        let amplitude = if dithered { DITHER } else { 0.0 };
        let dither =
            DITHER_HZ.map(|frequency| Sine { amplitude, frequency, phase: random.random_range(0.0..TAU) });
        let samples = (SECONDS / STEP).round() as usize;
        let (mut theta, mut alpha) = (Vec::with_capacity(samples), Vec::with_capacity(samples));
        let sampling = Sampling { dt: STEP, substeps: 4 };
        let run = RotaryFlexibleLink::IDENTIFIED.run(sampling, [0.0; 4], samples, |k, angles| {
            let measured = angles.map(|angle| angle + normal.sample(&mut random));
            theta.push(measured[0]);
            alpha.push(measured[1]);
            let t = k as f64 * STEP;
            ProportionalController::THESIS.command(reference(t), measured[0], multisine(&dither, t))
        })?;
        let rates = [2, 3].map(|i| run.states.iter().map(|state| state[i]).collect());
        Ok(Self { theta, alpha, volts: run.voltages, rates })
    }
}

/// The two equations of motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Equation {
    /// Equation 2.24.
    Theta,
    /// Equation 2.25.
    Alpha,
}

impl Equation {
    /// Both, in order.
    pub(crate) const BOTH: [Self; 2] = [Self::Theta, Self::Alpha];

    /// Its number in the thesis, which starts the names of its rows.
    pub(crate) fn number(self) -> &'static str {
        match self {
            Self::Theta => "2.24",
            Self::Alpha => "2.25",
        }
    }

    /// Its angle.
    pub(crate) fn symbol(self) -> &'static str {
        match self {
            Self::Theta => "θ",
            Self::Alpha => "α",
        }
    }

    fn acceleration(self) -> &'static str {
        match self {
            Self::Theta => "theta''",
            Self::Alpha => "alpha''",
        }
    }

    fn balance(self, link: &RotaryFlexibleLink) -> &VoltageBalance {
        match self {
            Self::Theta => &link.hub,
            Self::Alpha => &link.link,
        }
    }

    /// The terms of the virtual rig, those with a coefficient.
    pub(crate) fn truth(self) -> Vec<(&'static str, f64)> {
        let mut balance = *self.balance(&RotaryFlexibleLink::IDENTIFIED);
        let mut terms: Vec<_> =
            places(&mut balance).into_iter().map(|(name, value)| (name, *value)).collect();
        terms.insert(0, (self.acceleration(), balance.acceleration));
        terms.retain(|(_, value)| *value != 0.0);
        terms
    }
}

/// The coefficients of a balance but for the acceleration's, by the names of their terms.
fn places(balance: &mut VoltageBalance) -> [(&'static str, &mut f64); 9] {
    [
        ("theta'", &mut balance.rate),
        ("theta'^3", &mut balance.rate_cubed),
        ("theta", &mut balance.angle),
        ("theta^2", &mut balance.angle_squared),
        ("theta^3", &mut balance.angle_cubed),
        ("alpha'", &mut balance.deflection_rate),
        ("alpha", &mut balance.deflection),
        ("alpha^2", &mut balance.deflection_squared),
        ("sign(theta')", &mut balance.coulomb),
    ]
}

/// Terms with their coefficients.
pub type Terms = Vec<(String, f64)>;

/// The balance of the terms found.
///
/// # Errors
/// When a term is none of the rig's.
fn balance(equation: Equation, terms: &Terms) -> Result<VoltageBalance> {
    let mut out = VoltageBalance {
        acceleration: f64::NAN,
        rate: 0.0,
        rate_cubed: 0.0,
        angle: 0.0,
        angle_squared: 0.0,
        angle_cubed: 0.0,
        deflection_rate: 0.0,
        deflection: 0.0,
        deflection_squared: 0.0,
        coulomb: 0.0,
    };
    for (name, value) in terms {
        if name == equation.acceleration() {
            out.acceleration = *value;
            continue;
        }
        match places(&mut out).into_iter().find(|(term, _)| term == name) {
            Some((_, place)) => *place = *value,
            None => bail!("the rig has no term {name} that could be simulated"),
        }
    }
    Ok(out)
}

/// The rig of the terms found for both equations.
///
/// # Errors
/// When a term is none of the rig's.
pub fn rig(theta: &Terms, alpha: &Terms) -> Result<RotaryFlexibleLink> {
    let theta_limit = RotaryFlexibleLink::IDENTIFIED.theta_limit;
    Ok(RotaryFlexibleLink {
        hub: balance(Equation::Theta, theta)?,
        link: balance(Equation::Alpha, alpha)?,
        theta_limit,
    })
}

/// The closed loop without noise and dither.
///
/// # Errors
/// When it cannot be simulated.
pub fn closed_loop(rig: &RotaryFlexibleLink, seconds: f64) -> Result<LinkRun> {
    let samples = (seconds / STEP).round() as usize;
    let sampling = Sampling { dt: STEP, substeps: 4 };
    Ok(rig.run(sampling, [0.0; 4], samples, |k, [theta, _]| {
        ProportionalController::THESIS.command(reference(k as f64 * STEP), theta, 0.0)
    })?)
}

fn library() -> Library {
    let friction = Term::function(Function::Expression("sign(theta')".into()));
    Library::separate_powers(&["theta", "theta'", "alpha", "alpha'"], ORDERS).with_in_every_order(friction)
}

/// What Algorithm 1 finds for one equation.
#[derive(Debug, Clone)]
pub(crate) struct Found {
    /// The search.
    pub(crate) search: Search,
    names: Vec<String>,
}

impl Found {
    /// The terms of the model of an order, or of the chosen one.
    pub(crate) fn terms(&self, order: Option<usize>) -> Terms {
        let model = order.map_or(self.search.model(), |order| &self.search.orders[order - 1]);
        model.support.iter().map(|&j| (self.names[j].clone(), model.coefficients[j])).collect()
    }

    /// Whether the terms of an order are those of the rig.
    pub(crate) fn is_exact(&self, equation: Equation, order: Option<usize>) -> bool {
        let terms = self.terms(order);
        let truth = equation.truth();
        terms.len() == truth.len() && truth.iter().all(|(name, _)| terms.iter().any(|(term, _)| term == name))
    }
}

/// Algorithm 1 for one equation: orders 1 to 4, half of the rows for training, λ relative to the term's share of
/// the voltage, ten folds and the rule of one standard error, AIC.
pub(crate) fn search(
    record: &Record,
    equation: Equation,
    velocity: Velocity,
    integrals: Integrals,
) -> Result<Found> {
    let (theta, alpha) = (&record.theta, &record.alpha);
    let rates = match velocity {
        Velocity::True => record.rates.clone(),
        Velocity::Observer => [super::duffing::observed(theta)?, super::duffing::observed(alpha)?],
        Velocity::Smoothed => [theta, alpha].map(|angle| savitzky_golay(angle, STEP, 61, 5).d1),
    };
    // At rest the sign is zero.
    let sign: Vec<f64> = rates[0].iter().map(|v| if *v == 0.0 { 0.0 } else { v.signum() }).collect();
    let library = library();
    let values = library.evaluate(&[theta, &rates[0], alpha, &rates[1]], &[("sign(theta')", &sign)])?;
    let labels = library.labels();
    let column = |signal, order, hold| Column { signal, order, hold };
    let accelerated = if equation == Equation::Theta { theta } else { alpha };
    let mut columns = vec![column(accelerated, 2, Hold::Smooth)];
    columns.extend(labels.iter().zip(&values).map(|(label, value)| match label.as_str() {
        "theta'" => column(theta, 1, Hold::Smooth),
        "alpha'" => column(alpha, 1, Hold::Smooth),
        _ => column(value, 0, Hold::Smooth),
    }));
    // The voltage is held between the samples; to join it otherwise makes it half a sample late.
    columns.push(column(&record.volts, 0, Hold::Zero));
    let (mut rows, gap) = match integrals {
        Integrals::WholeRecord => {
            let restart = Restart { intervals: theta.len() - 1, hop: 1, every: 10 };
            (Iterated::new(2, 2, STEP)?.rows(&columns, restart)?.columns, 0)
        }
        Integrals::Windows => {
            let (intervals, hop) = (400, 10);
            let kernel = Kernel::new(2, 3, intervals, STEP)?;
            (greybox_algebraic::rows(&kernel, &columns, hop)?.columns, intervals / hop)
        }
    };
    let target = rows.pop().context("no columns")?;
    let orders: Vec<usize> = library.lengths().iter().map(|length| length + 1).collect();
    let all = 0..target.len();
    let split = train_test(std::slice::from_ref(&all), 0.5, gap)?;
    let problem = Problem::new(Rows::from_vecs(&rows, &target)?, &orders, &[0], split)?;
    let mut names = vec![equation.acceleration().to_owned()];
    names.extend(labels);
    Ok(Found { search: select::search(&problem, &select::Options::normalised())?, names })
}

/// Seed of the record behind the page's tables and figures.
pub(crate) const SEED: u64 = 1;

/// Both equations by Algorithm 1 on the dithered record of the page.
pub(crate) fn of_the_page() -> Result<&'static [Found; 2]> {
    static ONCE: OnceLock<Result<[Found; 2]>> = OnceLock::new();
    let made = ONCE.get_or_init(|| with_velocities(Velocity::Smoothed));
    made.as_ref().map_err(|e| anyhow!("{e:#}"))
}

/// The same with other velocities.
pub(crate) fn with_velocities(velocity: Velocity) -> Result<[Found; 2]> {
    let record = Record::new(SEED, true)?;
    let find = |equation| search(&record, equation, velocity, Integrals::Windows);
    Ok([find(Equation::Theta)?, find(Equation::Alpha)?])
}

/// Seconds of the record that `greybox identify` gets: it simulates all of them many times.
pub(crate) const IDENTIFIED_SECONDS: f64 = 30.0;

/// What `greybox identify` makes of the first half of the record of the page.
pub(crate) fn identified() -> Result<&'static Identification> {
    static ONCE: OnceLock<Result<Identification>> = OnceLock::new();
    let made = ONCE.get_or_init(|| {
        let Record { theta, alpha, volts, .. } = Record::new(SEED, true)?;
        let samples = (IDENTIFIED_SECONDS / STEP).round() as usize;
        let channel = |name: &str, unit: &str, mut values: Vec<f64>| {
            values.truncate(samples);
            Channel { name: name.into(), unit: Some(unit.into()), values }
        };
        let channels =
            vec![channel("v", "V", volts), channel("theta", "rad", theta), channel("alpha", "rad", alpha)];
        let time = (0..samples).map(|k| k as f64 * STEP).collect();
        let recordings = [Recording::from_columns("link.csv", time, channels)?];
        let library = Candidates { monomials: Monomials::Separate, friction: true, ..Candidates::default() };
        let hold = Some(greybox_model::Hold::Zero);
        let options =
            Options { library, order: 4, hold, replicates: 0, ..Options::new(&["theta", "alpha"], &["v"]) };
        Ok(identify(&recordings, &recordings, &options, &Quiet)?)
    });
    made.as_ref().map_err(|e| anyhow!("{e:#}"))
}

/// The terms of an identified equation.
pub(crate) fn terms_of(equation: &FoundEquation) -> Terms {
    equation.terms.iter().map(|term| (term.expression.clone(), term.value)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rig_of_its_own_terms_is_the_rig() {
        let own = |equation: Equation| -> Terms {
            equation.truth().into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
        };
        let again = rig(&own(Equation::Theta), &own(Equation::Alpha)).unwrap();
        assert_eq!(again, RotaryFlexibleLink::IDENTIFIED);
        assert!(rig(&vec![("theta^4".into(), 1.0)], &own(Equation::Alpha)).is_err());
    }
}
