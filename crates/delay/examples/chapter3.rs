//! The numbers of thesis chapter 3 on its virtual rigs: Figures 3.1 and 3.5, Tables 3.1, 3.2, 3.4 and 3.5, and what
//! exact delay regression and the spectrum add. `cargo run --release -p greybox-delay --example chapter3`.
//!
//! Every figure and table is a function of its own that returns its numbers.
#![allow(clippy::print_stdout)]
use greybox_algebraic::{Column, Hold, Initial, Iterated, Kernel, Restart};
use greybox_delay::exact::{self, Gain};
use greybox_delay::expansion::{Expansion, Reading};
use greybox_delay::spectrum::{Critical, DelaySystem, Root};
use greybox_delay::taylor::{self, Data, Model, Order, Search};
use greybox_delay::windows::{self, Before, Windowed};
use greybox_recording::smooth::savitzky_golay;
use greybox_simulate::rigs::{DelayedDuffing, RotaryFlexibleJoint, Sampling, Sine, multisine, square_wave};
use greybox_sparse::select::logspace;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

type Failure = Box<dyn std::error::Error>;

/// Sampling interval of both rigs, s.
const DT: f64 = 0.001;

/// Columns and target.
type Rows = (Vec<Vec<f64>>, Vec<f64>);

// --- The delayed Duffing oscillator, §3.3 ---------------------------------------------------------------------

/// What is recorded of the oscillator, with the true velocity.
struct Oscillation {
    x: Vec<f64>,
    velocity: Vec<f64>,
    force: Vec<f64>,
}

/// Which of the two recordings of §3.3.
#[derive(Clone, Copy, PartialEq)]
enum Which {
    Training,
    Test,
}

/// A recording with noise of 0.01 on displacement and force.
fn oscillation(which: Which, seconds: f64, seed: u64) -> Result<Oscillation, Failure> {
    let (start, force): (_, fn(f64) -> f64) = match which {
        Which::Training => (DelayedDuffing::TRAINING_START, DelayedDuffing::training_force),
        Which::Test => (DelayedDuffing::TEST_START, DelayedDuffing::test_force),
    };
    let samples = (seconds / DT).round() as usize + 1;
    let states = DelayedDuffing::THESIS.run(Sampling { dt: DT, substeps: 1 }, start, samples, force)?;
    let mut rng = Pcg64Mcg::seed_from_u64(2 * seed + u64::from(which == Which::Test));
    let normal = Normal::new(0.0, 0.01)?;
    Ok(Oscillation {
        x: states.iter().map(|s| s[0] + normal.sample(&mut rng)).collect(),
        velocity: states.iter().map(|s| s[1]).collect(),
        force: (0..samples).map(|k| force(k as f64 * DT) + normal.sample(&mut rng)).collect(),
    })
}

/// How signals become rows.
#[derive(Clone, Copy, Debug)]
enum Operation {
    /// Eq 3.10 at every tenth sample of one window over the recording, initial condition of x‴ left in (E13).
    Printed,
    /// The same with E13 corrected.
    Corrected,
    /// Windows of 1 s every 10 ms with the kernel t²(T − t)².
    Windows,
}

/// Exponents (i, j) of xⁱ x′ʲ without the constant, nested: order N adds those with max(i, j) = N.
fn powers(order: i32) -> Vec<(i32, i32)> {
    let added = |n: i32| (0..n).map(move |i| (i, n)).chain((0..=n).map(move |j| (n, j)));
    (1..=order).flat_map(added).collect()
}

/// x‴, x″ and the library; then the force.
fn duffing_rows(r: &Oscillation, order: i32, operation: Operation) -> Result<Rows, Failure> {
    let powers = powers(order);
    let product =
        |&(i, j): &(i32, i32)| r.x.iter().zip(&r.velocity).map(|(x, v)| x.powi(i) * v.powi(j)).collect();
    let products: Vec<Vec<f64>> = powers.iter().map(product).collect();
    let smooth = |signal, order| Column { signal, order, hold: Hold::Smooth };
    let mut columns = vec![smooth(&r.x, 3), smooth(&r.x, 2)];
    columns.extend(powers.iter().zip(&products).map(|(power, product)| match power {
        (0, 1) => smooth(&r.x, 1),
        _ => smooth(product, 0),
    }));
    columns.push(smooth(&r.force, 0));
    let growing = |initial| {
        let restart = Restart { intervals: r.x.len() - 1, hop: 1, every: 10 };
        Iterated::new(2, 3, DT)?.with_initial(initial).rows(&columns, restart)
    };
    let mut rows = match operation {
        Operation::Printed => growing(Initial::Separate)?,
        Operation::Corrected => growing(Initial::FirstSample)?,
        Operation::Windows => {
            let kernel = Kernel::new(2, 3, 1000, DT)?.with_initial(Initial::FirstSample);
            greybox_algebraic::rows(&kernel, &columns, 10)?
        }
    }
    .columns;
    let target = rows.pop().ok_or("no columns")?;
    Ok((rows, target))
}

/// Algorithm 2 on the oscillator: Figure 3.1 is the test error of its models, Table 3.1 the model of order 3.
fn duffing_search(operation: Operation, seconds: f64, last: i32, seed: u64) -> Result<Search, Failure> {
    let train = duffing_rows(&oscillation(Which::Training, seconds, seed)?, last, operation)?;
    let test = duffing_rows(&oscillation(Which::Test, seconds, seed)?, last, operation)?;
    let orders: Vec<Order> =
        (1..=last).map(|n| Order { order: n as usize, columns: 2 + powers(n).len() }).collect();
    let data = [&train, &test].map(|(columns, target)| Data { columns, target });
    Ok(taylor::search(data[0], data[1], &orders, &taylor::Options::thesis(2, seed))?)
}

/// One line of Table 3.1.
struct Coefficient {
    term: String,
    exact: f64,
    estimate: f64,
    std: f64,
}

/// Table 3.1: the terms that are in the model, or should be.
fn table_3_1(model: &Model) -> Result<Vec<Coefficient>, Failure> {
    let p = DelayedDuffing::THESIS;
    let delayed = Expansion::new(-p.gain, 3)?;
    let exact = |j: usize, power: Option<&(i32, i32)>| match (j, power) {
        (0, _) => delayed.coefficient(3, p.delay),
        (1, _) => p.m + delayed.coefficient(2, p.delay),
        (_, Some((0, 1))) => p.c1 + delayed.coefficient(1, p.delay),
        (_, Some((1, 0))) => p.k1 + delayed.coefficient(0, p.delay),
        (_, Some((2, 1))) => p.c2,
        (_, Some((0, 3))) => p.c3,
        (_, Some((3, 0))) => p.k3,
        _ => 0.0,
    };
    let powers = powers(model.order as i32);
    let lines = model.coefficients.iter().zip(&model.std).enumerate().map(|(j, (&estimate, &std))| {
        let power = j.checked_sub(2).and_then(|j| powers.get(j));
        let term = match (j, power) {
            (0, _) => "x'''".to_owned(),
            (1, _) => "x''".to_owned(),
            (_, Some((i, j))) => format!("x^{i} x'^{j}"),
            _ => String::new(),
        };
        Coefficient { term, exact: exact(j, power), estimate, std }
    });
    Ok(lines.filter(|l| l.exact != 0.0 || l.estimate != 0.0).collect())
}

/// Table 3.2: τ from the jerk's coefficient, then m, c₁ and k₁ from theirs; with τ from x′ if c₁ were known.
struct Parameters {
    tau: Reading,
    m: f64,
    c1: f64,
    k1: f64,
    tau_if_c1_known: Reading,
}

/// Table 3.2 from the model of Table 3.1.
fn table_3_2(model: &Model) -> Result<Parameters, Failure> {
    let p = DelayedDuffing::THESIS;
    let delayed = Expansion::new(-p.gain, 3)?;
    let of = |power| {
        let place = powers(model.order as i32).iter().position(|&p| p == power).map(|j| j + 2);
        place.and_then(|j| model.coefficients.get(j)).copied().unwrap_or(0.0)
    };
    let tau = delayed.read(3, model.coefficients[0], 0.0)?;
    Ok(Parameters {
        tau,
        m: model.coefficients[1] - delayed.coefficient(2, tau.delay),
        c1: of((0, 1)) - delayed.coefficient(1, tau.delay),
        k1: of((1, 0)) - delayed.coefficient(0, tau.delay),
        tau_if_c1_known: delayed.read(1, of((0, 1)), p.c1)?,
    })
}

/// Exact delay regression on both recordings with the true terms; the velocity of x′³ true or smoothed.
fn duffing_exact(seconds: f64, gain: Gain, smoothed: bool, seed: u64) -> Result<exact::Fit, Failure> {
    let kernel = Kernel::new(2, 3, 1000, DT)?;
    let mut recordings = Vec::new();
    for which in [Which::Training, Which::Test] {
        let r = oscillation(which, seconds, seed)?;
        let velocity = if smoothed { savitzky_golay(&r.x, DT, 101, 5).d1 } else { r.velocity };
        let cube: Vec<f64> = r.x.iter().map(|x| x.powi(3)).collect();
        let third: Vec<f64> = cube.iter().map(|x| x / 3.0).collect();
        let drag: Vec<f64> = velocity.iter().map(|v| v.powi(3)).collect();
        let smooth = |signal, order| Column { signal, order, hold: Hold::Smooth };
        // x² x′ = (x³/3)′ needs no velocity.
        let columns = [
            smooth(&r.x, 2),
            smooth(&r.x, 1),
            smooth(&third, 1),
            smooth(&drag, 0),
            smooth(&r.x, 0),
            smooth(&cube, 0),
        ];
        let force = [(1.0, smooth(&r.force, 0))];
        recordings.push(Windowed::new(&kernel, 20, &force, &columns, &r.x, Hold::Smooth, Before::Held(0.5))?);
    }
    Ok(windows::fit(&recordings, &exact::Options::new(gain, 0.0, 0.5))?)
}

// --- The rotary flexible joint, §3.4 --------------------------------------------------------------------------

/// What is recorded of the joint.
struct Motion {
    theta: Vec<f64>,
    alpha: Vec<f64>,
    theta_rate: Vec<f64>,
    alpha_rate: Vec<f64>,
    reference: Vec<f64>,
}

/// 60 s on a sine of 2 rad or a square wave of 1 rad (0.66 Hz), noise of 1 mrad, smoothed velocities.
fn motion(which: Which, seed: u64) -> Result<Motion, Failure> {
    let samples = 60_001;
    let sine = [Sine { amplitude: 2.0, frequency: 0.66, phase: 0.0 }];
    let reference = |t: f64| match which {
        Which::Training => multisine(&sine, t),
        Which::Test => square_wave(1.0, 0.66, t),
    };
    let sampling = Sampling { dt: DT, substeps: 1 };
    let run = RotaryFlexibleJoint::WITH_FRICTION.run(sampling, [0.0; 4], samples, reference)?;
    let mut rng = Pcg64Mcg::seed_from_u64(2 * seed + u64::from(which == Which::Test));
    let normal = Normal::new(0.0, 1e-3)?;
    let mut measured =
        |i: usize| -> Vec<f64> { run.states.iter().map(|s| s[i] + normal.sample(&mut rng)).collect() };
    let (theta, alpha) = (measured(0), measured(1));
    let rate = |signal: &[f64]| savitzky_golay(signal, DT, 61, 5).d1;
    Ok(Motion {
        theta_rate: rate(&theta),
        alpha_rate: rate(&alpha),
        theta,
        alpha,
        reference: (0..samples).map(|k| reference(k as f64 * DT)).collect(),
    })
}

/// The two equations of the joint.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Equation {
    /// Eq 3.24: θ″ is protected.
    Theta,
    /// Eq 3.25: α″ and θ″ are protected.
    Alpha,
}

impl Equation {
    fn protected(self) -> usize {
        match self {
            Self::Theta => 1,
            Self::Alpha => 2,
        }
    }
}

/// Names of the columns of an equation, in the order of [`joint_rows`].
fn joint_terms(equation: Equation, order: usize) -> Vec<String> {
    let mut terms: Vec<String> = match equation {
        Equation::Theta => vec!["θ''".to_owned()],
        Equation::Alpha => vec!["θ''".to_owned(), "α''".to_owned()],
    };
    terms.push("sign θ'".to_owned());
    for n in 1..=order {
        terms.extend(["θ", "θ'", "α", "α'"].map(|s| format!("{s}^{n}")));
    }
    terms
}

/// Protected second derivatives, sign θ′ and the powers of θ, θ′, α, α′; then the right-hand side of Eq 3.24
/// (or 3.25, which has the other sign): a kₚ (θ_d − θ) + b θ′.
fn joint_rows(r: &Motion, equation: Equation, order: usize) -> Result<Rows, Failure> {
    let plant = RotaryFlexibleJoint::WITH_FRICTION;
    let kernel = Kernel::new(2, 3, 500, DT)?;
    let smooth = |signal, order| Column { signal, order, hold: Hold::Smooth };
    let sign: Vec<f64> = r.theta_rate.iter().map(|v| (v / 0.05).tanh()).collect();
    let power = |s: &[f64], n: usize| -> Vec<f64> { s.iter().map(|s| s.powi(n as i32)).collect() };
    let signals = [&r.theta, &r.theta_rate, &r.alpha, &r.alpha_rate];
    let library: Vec<Vec<f64>> = (1..=order).flat_map(|n| signals.map(|s| power(s, n))).collect();
    let mut columns = vec![smooth(&r.theta, 2)];
    if equation == Equation::Alpha {
        columns.push(smooth(&r.alpha, 2));
    }
    columns.push(smooth(&sign, 0));
    for (i, term) in library.iter().enumerate() {
        columns.push(match i {
            1 => smooth(&r.theta, 1),
            3 => smooth(&r.alpha, 1),
            _ => smooth(term, 0),
        });
    }
    columns.push(Column { signal: &r.reference, order: 0, hold: Hold::Zero });
    columns.push(smooth(&r.theta, 0));
    columns.push(smooth(&r.theta, 1));
    let mut rows = greybox_algebraic::rows(&kernel, &columns, 20)?.columns;
    let known = rows.split_off(rows.len() - 3);
    let gain = plant.torque_per_volt * plant.gain;
    let side = if equation == Equation::Theta { 1.0 } else { -1.0 };
    let target = (0..known[0].len())
        .map(|i| side * (gain * (known[0][i] - known[1][i]) + plant.back_emf * known[2][i]))
        .collect();
    Ok((rows, target))
}

/// Algorithm 2 on the joint, trained on the sine and tested on the square: Figure 3.5 is the test error of its
/// models, Table 3.4 the coefficients.
fn joint_search(equation: Equation, last: usize, seed: u64) -> Result<Search, Failure> {
    let train = joint_rows(&motion(Which::Training, seed)?, equation, last)?;
    let test = joint_rows(&motion(Which::Test, seed)?, equation, last)?;
    let orders: Vec<Order> =
        (1..=last).map(|order| Order { order, columns: joint_terms(equation, order).len() }).collect();
    let options = taylor::Options {
        replicates: 10,
        thresholds: logspace(1e-10, 1.0, 100),
        ..taylor::Options::thesis(equation.protected(), seed)
    };
    let data = [&train, &test].map(|(columns, target)| Data { columns, target });
    Ok(taylor::search(data[0], data[1], &orders, &options)?)
}

/// Table 3.5: the three routes to τ, from θ″ and θ′ of Eq 3.24 (J_eq, B_eq known) and from θ″ of Eq 3.25.
fn table_3_5(theta: &Model, alpha: &Model) -> Result<[Reading; 3], Failure> {
    let plant = RotaryFlexibleJoint::WITH_FRICTION;
    let gain = plant.torque_per_volt * plant.gain;
    let delayed = Expansion::new(gain, 2)?;
    let rate = joint_terms(Equation::Theta, 1).iter().position(|t| t == "θ'^1").ok_or("no θ' column")?;
    Ok([
        delayed.read(2, theta.coefficients[0], plant.base_inertia)?,
        delayed.read(1, theta.coefficients[rate], plant.base_damping)?,
        Expansion::new(-gain, 2)?.read(2, alpha.coefficients[0], 0.0)?,
    ])
}

/// Exact delay regression of Eq 3.21's base with Coulomb friction: coefficients J_eq, B_eq, −k_s, f_c.
fn joint_exact(which: Which, seed: u64) -> Result<exact::Fit, Failure> {
    let r = motion(which, seed)?;
    let plant = RotaryFlexibleJoint::WITH_FRICTION;
    let kernel = Kernel::new(2, 3, 500, DT)?;
    let sign: Vec<f64> = r.theta_rate.iter().map(|v| (v / 0.05).tanh()).collect();
    let column = |signal, order, hold| Column { signal, order, hold };
    let gain = plant.torque_per_volt * plant.gain;
    let known =
        [(gain, column(&r.reference, 0, Hold::Zero)), (plant.back_emf, column(&r.theta, 1, Hold::Smooth))];
    let columns = [
        column(&r.theta, 2, Hold::Smooth),
        column(&r.theta, 1, Hold::Smooth),
        column(&r.alpha, 0, Hold::Smooth),
        column(&sign, 0, Hold::Smooth),
    ];
    let rows = Windowed::new(&kernel, 10, &known, &columns, &r.theta, Hold::Zero, Before::Held(0.5))?;
    Ok(windows::fit(&[rows], &exact::Options::new(Gain::Known(gain), 0.0, 0.5))?)
}

/// The joint's rightmost roots, critical gain (V/rad) and critical delay (s).
fn joint_stability() -> Result<(Vec<Root>, f64, Critical), Failure> {
    let plant = RotaryFlexibleJoint::LINEAR;
    let [undelayed, delayed] = plant.linearised();
    let system = DelaySystem::new(&undelayed, &delayed, plant.delay)?;
    let gain = plant.gain * system.critical_gain(0.1, 3.0, 30)?.value;
    Ok((system.roots(4)?, gain, system.critical_delay(0.01, 0.5, 30)?))
}

// --- The pages ------------------------------------------------------------------------------------------------

fn main() -> Result<(), Failure> {
    for (operation, seconds) in
        [(Operation::Printed, 5.0), (Operation::Corrected, 5.0), (Operation::Windows, 10.0)]
    {
        println!("== Delayed Duffing, {operation:?}, {seconds} s, seed 0");
        let search = duffing_search(operation, seconds, 6, 0)?;
        println!("Figure 3.1 (order, test MSE):");
        search.models.iter().for_each(|m| println!("  {} {:.3e}", m.order, m.test_error));
        let third = &search.models[2];
        println!("Table 3.1 (order 3; chosen {}):", search.models[search.chosen].order);
        for line in table_3_1(third)? {
            let Coefficient { term, exact, estimate, std } = line;
            println!("  {term:<10} {exact:>10.6} {estimate:>10.6} ± {std:.6}");
        }
        let p = table_3_2(third)?;
        println!("Table 3.2: τ {:.4} m {:.4} c1 {:.4} k1 {:.4}", p.tau.delay, p.m, p.c1, p.k1);
        println!("  τ from x' with c1 known: {:.4}", p.tau_if_c1_known.delay);
    }
    println!("== Exact delay regression, both recordings, 20 s (τ ± std, relative error %)");
    for (gain, smoothed) in
        [(Gain::Known(-2.0), false), (Gain::Known(-2.0), true), (Gain::Free, false), (Gain::Free, true)]
    {
        for seed in 0..4 {
            let fit = duffing_exact(20.0, gain, smoothed, seed)?;
            let error = 100.0 * (fit.delay / 0.2 - 1.0);
            let (tau, std, warnings) = (fit.delay, fit.delay_std, fit.separability.warnings);
            println!("  {gain:?} smoothed {smoothed}: {tau:.5} ± {std:.5} ({error:+.2}) {warnings:?}");
        }
    }
    println!("== Rotary flexible joint, Algorithm 2, seed 0");
    let theta = joint_search(Equation::Theta, 7, 0)?;
    let alpha = joint_search(Equation::Alpha, 7, 0)?;
    for (equation, search) in [(Equation::Theta, &theta), (Equation::Alpha, &alpha)] {
        println!("Figure 3.5, {equation:?} (order, test MSE):");
        search.models.iter().for_each(|m| println!("  {} {:.3e}", m.order, m.test_error));
        let model = &search.models[search.chosen];
        println!("Table 3.4, {equation:?}, order {}:", model.order);
        let terms = joint_terms(equation, model.order);
        for j in model.active() {
            println!("  {:<8} {:>9.5} ± {:.5}", terms[j], model.coefficients[j], model.std[j]);
        }
    }
    for order in [1, 5] {
        let routes = table_3_5(&theta.models[order - 1], &alpha.models[order - 1])?;
        println!("Table 3.5, order {order}: τ from θ'' and θ' of Eq 3.24, from θ'' of Eq 3.25:");
        routes.iter().for_each(|r| println!("  {:.4} admissible {}", r.delay, r.admissible));
    }
    for (which, name) in [(Which::Training, "sine"), (Which::Test, "square")] {
        let fit = joint_exact(which, 0)?;
        println!("Exact, {name}: τ {:.5} ± {:.5}, {:?}", fit.delay, fit.delay_std, fit.coefficients);
    }
    let (roots, gain, delay) = joint_stability()?;
    println!("Roots {roots:?}; critical gain {gain:.4} V/rad; critical delay {:.4} s", delay.value);
    Ok(())
}
