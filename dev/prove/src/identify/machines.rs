//! Machines with several coordinates and inputs, from positions alone: which input drives which equation is for the
//! identification to find.

use std::path::Path;

use anyhow::{Context, Result};
use greybox_identify::{Library, Monomials, Options};
use greybox_model::Hold;
use greybox_recording::csv::write_csv_file;
use greybox_recording::{Channel, Recording};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;

use super::{FEW, Trial, Truth, channel, coverage_within, run_seeds, times};
use crate::{Figure, Outcome};

/// What the names of these cases begin with.
pub(super) const PREFIX: &str = "machine: ";

/// Noise of every sensor, a share of what its channel moves (standard deviations).
const NOISE: f64 = 0.01;
/// Sampling, s.
pub(super) const STEP: f64 = 0.01;
/// Length of a recording, s.
const SECONDS: f64 = 40.0;
/// Samples that a machine with late inputs moves before its recording.
const LEAD: usize = 500;

/// ẋ of x and u.
type Rates = Box<dyn Fn(&[f64], &[f64]) -> Vec<f64> + Sync>;

/// A first-order system ẋ = f(x, u) whose first states are measured.
pub(super) struct Machine {
    states: Vec<&'static str>,
    /// States that are measured, with their units.
    measured: Vec<(usize, &'static str)>,
    /// Inputs, their units and their sizes.
    inputs: Vec<(&'static str, &'static str, f64)>,
    /// Frequencies that excite it, Hz.
    band: (f64, f64),
    /// How many samples each input acts late, in tenths; none: not at all. The machine then moves before the recording begins.
    pub(super) late: Vec<usize>,
    /// What the inputs do between samples: straight lines, or nothing.
    held: bool,
    rates: Rates,
}

/// Sums of sines of random phase over `band`, with the standard deviation `size`, from `lead` samples before the start.
fn excitation(
    random: &mut Pcg64Mcg,
    (low, high): (f64, f64),
    size: f64,
    (lead, samples): (usize, usize),
) -> Vec<f64> {
    const SINES: usize = 12;
    let sines: Vec<(f64, f64)> = (0..SINES)
        .map(|i| {
            let frequency =
                low * (high / low).powf((i as f64 + random.random_range(0.0..1.0)) / SINES as f64);
            (std::f64::consts::TAU * frequency, random.random_range(0.0..std::f64::consts::TAU))
        })
        .collect();
    let amplitude = size * (2.0 / SINES as f64).sqrt();
    let at = |t: f64| amplitude * sines.iter().map(|(w, phase)| (w * t + phase).sin()).sum::<f64>();
    (0..lead + samples).map(|k| at((k as f64 - lead as f64) * STEP)).collect()
}

impl Machine {
    /// The same, with inputs that act late by `late` tenths of a sample each.
    pub(super) fn delayed(self, late: &[usize], held: bool) -> Machine {
        Machine { late: late.to_vec(), held, ..self }
    }

    /// A recording from rest.
    pub(super) fn record(&self, seed: u64) -> Result<Recording> {
        // Tenths of a sample: no step crosses a bend or jump of a late input.
        const SUBSTEPS: usize = 10;
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let n = (SECONDS / STEP).round() as usize + 1;
        let lead = if self.late.is_empty() { 0 } else { LEAD };
        let inputs: Vec<Vec<f64>> = self
            .inputs
            .iter()
            .map(|(.., size)| excitation(&mut random, self.band, *size, (lead, n)))
            .collect();
        let h = STEP / SUBSTEPS as f64;
        let mut x = vec![0.0; self.states.len()];
        let mut clean = vec![Vec::with_capacity(n); self.measured.len()];
        for k in 0..lead + n {
            if k >= lead {
                clean.iter_mut().zip(&self.measured).for_each(|(c, (i, _))| c.push(x[*i]));
            }
            for s in 0..SUBSTEPS {
                let one = |(i, u): (usize, &Vec<f64>), w: f64| {
                    let tenths = (k * SUBSTEPS + s).saturating_sub(self.late.get(i).copied().unwrap_or(0));
                    let (k, s) = (tenths / SUBSTEPS, tenths % SUBSTEPS);
                    let share = if self.held { 0.0 } else { (s as f64 + w) / SUBSTEPS as f64 };
                    u[k] + share * (u[(k + 1).min(u.len() - 1)] - u[k])
                };
                let drive = |w: f64| -> Vec<f64> { inputs.iter().enumerate().map(|u| one(u, w)).collect() };
                let at =
                    |r: &[f64], w: f64| -> Vec<f64> { x.iter().zip(r).map(|(x, r)| x + w * h * r).collect() };
                let (begin, middle, end) = (drive(0.0), drive(0.5), drive(1.0));
                let a = (self.rates)(&x, &begin);
                let b = (self.rates)(&at(&a, 0.5), &middle);
                let c = (self.rates)(&at(&b, 0.5), &middle);
                let d = (self.rates)(&at(&c, 1.0), &end);
                for (i, x) in x.iter_mut().enumerate() {
                    *x += h / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i]);
                }
            }
        }
        let with_unit = |name: &str, unit: &str, values| Channel {
            unit: Some(unit.to_string()),
            ..channel(name, values)
        };
        let mut columns: Vec<Channel> = self
            .inputs
            .iter()
            .zip(inputs)
            .map(|((name, unit, _), values)| with_unit(name, unit, values[lead..].to_vec()))
            .collect();
        for ((i, unit), values) in self.measured.iter().zip(clean) {
            let mean = values.iter().sum::<f64>() / n as f64;
            let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n as f64;
            let noise = Normal::new(0.0, NOISE * variance.sqrt())?;
            let noisy = values.iter().map(|v| v + noise.sample(&mut random)).collect();
            columns.push(with_unit(self.states[*i], unit, noisy));
        }
        Ok(Recording::from_columns("machine.csv", times(n, STEP), columns)?)
    }
}

/// Writes the recordings of the linear machines, for a look with other tools: `chain2-1-SEED.csv` is a chain of two masses
/// with the force on the first.
pub(super) fn keep(folder: &Path, seeds: &[u64]) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} cannot be made", folder.display()))?;
    let machines = [
        ("chain2-1", chain(2, &[0])),
        ("chain2-2", chain(2, &[1])),
        ("chain2-12", chain(2, &[0, 1])),
        ("chain3-2", chain(3, &[1])),
        ("chain3-13", chain(3, &[0, 2])),
        ("drive", drive()),
    ];
    for (name, machine) in machines {
        for seed in seeds {
            let recording = machine.record(*seed)?;
            let columns: Vec<(String, &[f64])> = recording
                .channels
                .iter()
                .map(|c| (format!("{} [{}]", c.name, c.unit.as_deref().unwrap_or("1")), c.values.as_slice()))
                .collect();
            let columns: Vec<(&str, &[f64])> = columns.iter().map(|c| (c.0.as_str(), c.1)).collect();
            write_csv_file(folder.join(format!("{name}-{seed}.csv")), &recording.time, &columns)?;
        }
    }
    Ok(())
}

/// The machines' rows as a table of the book.
pub(super) fn table(outcomes: &[Outcome]) -> String {
    let mut text =
        "| machine | terms and inputs of every equation exact | 95 % intervals that hold the truth |\n\
                    | --- | --- | --- |\n"
            .to_string();
    for outcome in outcomes {
        let Some(name) = outcome.case.strip_prefix(PREFIX) else { continue };
        let measured: Vec<&str> = outcome.figures.iter().map(|f| f.measured.as_str()).collect();
        text += &format!("| {name} | {} |\n", measured.join(" | "));
    }
    text
}

/// Shares of equations whose terms are exactly the true ones, and of intervals that hold the truth.
pub(super) fn figures(trials: &[Trial]) -> Vec<Figure> {
    let of = |equations: &[bool]| equations.iter().all(|e| *e);
    let exact = trials.iter().filter(|t| of(&t.exact)).count();
    let n = trials.len();
    let covered = trials.iter().fold((0, 0), |s, t| (s.0 + t.covered.0, s.1 + t.covered.1));
    let least = super::share(95, 100, n);
    // The thirty intervals of two seeds scatter by 15 %: of so few only gross misses are judged.
    let most = if n < FEW { f64::INFINITY } else { 6.0 };
    vec![
        Figure::judged("all equations exact", format!("{exact} of {n}"), ">= 95 of 100", exact >= least),
        coverage_within("95 % intervals that hold the truth", covered, most),
    ]
}

const MASSES: [f64; 3] = [1.2, 0.8, 0.5];
/// Springs and dampers before each mass; the first stands on the ground.
const SPRINGS: [f64; 3] = [40.0, 60.0, 25.0];
const DAMPERS: [f64; 3] = [0.6, 0.3, 0.2];
const POSITIONS: [&str; 3] = ["x1", "x2", "x3"];
const FORCES: [&str; 3] = ["f1", "f2", "f3"];

/// A chain of `count` masses with forces on those in `driven`.
pub(super) fn chain(count: usize, driven: &[usize]) -> Machine {
    let force: Vec<Option<usize>> = (0..count).map(|i| driven.iter().position(|d| *d == i)).collect();
    Machine {
        states: [&POSITIONS[..count], &["v1", "v2", "v3"][..count]].concat(),
        measured: (0..count).map(|i| (i, "m")).collect(),
        inputs: driven.iter().map(|d| (FORCES[*d], "N", 5.0)).collect(),
        band: (0.2, 3.0),
        late: Vec::new(),
        held: false,
        rates: Box::new(move |x, u| {
            let (q, v) = x.split_at(count);
            // What the spring and damper before mass i pull it back with.
            let pull = |i: usize| {
                let before = |y: &[f64]| y[i] - if i == 0 { 0.0 } else { y[i - 1] };
                SPRINGS[i] * before(q) + DAMPERS[i] * before(v)
            };
            let acceleration = |i: usize| {
                let after = if i + 1 < count { pull(i + 1) } else { 0.0 };
                (after - pull(i) + force[i].map_or(0.0, |k| u[k])) / MASSES[i]
            };
            v.iter().copied().chain((0..count).map(acceleration)).collect()
        }),
    }
}

/// The terms of the equations of a [`chain`].
pub(super) fn chain_terms(count: usize, driven: &[usize]) -> Vec<Vec<(String, f64)>> {
    (0..count)
        .map(|i| {
            let scale = if driven.contains(&i) { 1.0 } else { 1.0 / MASSES[i] };
            let after = |values: &[f64; 3]| if i + 1 < count { values[i + 1] } else { 0.0 };
            let mut terms = vec![(format!("{}''", POSITIONS[i]), scale * MASSES[i])];
            let mut add = |j: usize, spring: f64, damper: f64| {
                terms.push((POSITIONS[j].to_string(), scale * spring));
                terms.push((format!("{}'", POSITIONS[j]), scale * damper));
            };
            add(i, SPRINGS[i] + after(&SPRINGS), DAMPERS[i] + after(&DAMPERS));
            if i > 0 {
                add(i - 1, -SPRINGS[i], -DAMPERS[i]);
            }
            if i + 1 < count {
                add(i + 1, -SPRINGS[i + 1], -DAMPERS[i + 1]);
            }
            terms
        })
        .collect()
}

/// What a chain's identification is asked for.
pub(super) fn chain_options(count: usize, driven: &[usize]) -> Options {
    let inputs: Vec<&str> = driven.iter().map(|d| FORCES[*d]).collect();
    Options {
        library: Library { constant: true, ..Options::new(&POSITIONS[..count], &inputs).library },
        order: 3,
        hold: Some(Hold::Linear),
        replicates: 0,
        ..Options::new(&POSITIONS[..count], &inputs)
    }
}

pub(super) fn chain_case(seeds: &[u64], count: usize, driven: &[usize]) -> Result<Vec<Figure>> {
    let machine = chain(count, driven);
    let force = |i: usize| driven.iter().position(|d| *d == i);
    let truths = chain_terms(count, driven);
    let truths: Vec<Vec<(&str, f64)>> =
        truths.iter().map(|t| t.iter().map(|(name, v)| (name.as_str(), *v)).collect()).collect();
    let truths: Vec<Truth<'_>> = truths
        .iter()
        .enumerate()
        .map(|(i, terms)| Truth { input: force(i).map(|_| FORCES[i]), terms })
        .collect();
    let options = chain_options(count, driven);
    let trials = run_seeds(seeds, |seed| Ok(vec![machine.record(seed)?]), &options, &truths, None)?;
    Ok(figures(&trials))
}

/// A mass on a spring that stiffens: m x″ + c x′ + k x + k₃ x³ = f.
pub(super) fn spring() -> Machine {
    let [(_, m), (_, k), (_, c), (_, k3)] = SPRING;
    Machine {
        states: vec!["x", "v"],
        measured: vec![(0, "m")],
        inputs: vec![("f", "N", 5.0)],
        band: (0.2, 3.0),
        late: Vec::new(),
        held: false,
        rates: Box::new(move |x, u| vec![x[1], (u[0] - c * x[1] - k * x[0] - k3 * x[0].powi(3)) / m]),
    }
}

/// The terms of the [`spring`].
pub(super) const SPRING: [(&str, f64); 4] = [("x''", 1.2), ("x", 40.0), ("x'", 1.5), ("x^3", 300.0)];

const INERTIA: f64 = 0.02;
const FRICTION: f64 = 0.015;
const TORQUE: f64 = 0.12;
const INDUCTANCE: f64 = 0.08;
const RESISTANCE: f64 = 1.5;

/// A motor whose position and current are measured, under a voltage and a known load: J θ″ + b θ′ − k i = τ,
/// L i′ + R i + k θ′ = v.
fn drive() -> Machine {
    Machine {
        states: vec!["theta", "i", "w"],
        measured: vec![(0, "rad"), (1, "A")],
        inputs: vec![("v", "V", 4.0), ("load", "N*m", 0.1)],
        band: (0.2, 6.0),
        late: Vec::new(),
        held: false,
        rates: Box::new(|x, u| {
            let rate = (u[0] - RESISTANCE * x[1] - TORQUE * x[2]) / INDUCTANCE;
            vec![x[2], rate, (u[1] + TORQUE * x[1] - FRICTION * x[2]) / INERTIA]
        }),
    }
}

pub(super) fn drive_case(seeds: &[u64]) -> Result<Vec<Figure>> {
    let machine = drive();
    let motion =
        Truth { input: Some("load"), terms: &[("theta''", INERTIA), ("theta'", FRICTION), ("i", -TORQUE)] };
    let current =
        Truth { input: Some("v"), terms: &[("i'", INDUCTANCE), ("i", RESISTANCE), ("theta'", TORQUE)] };
    let usual = Options::new(&["theta", "i"], &["v", "load"]);
    let options = Options {
        derivatives: vec![2, 1],
        library: Library { monomials: Monomials::Separate, constant: true, ..usual.library.clone() },
        order: 3,
        hold: Some(Hold::Linear),
        replicates: 0,
        ..usual
    };
    let trials =
        run_seeds(seeds, |seed| Ok(vec![machine.record(seed)?]), &options, &[motion, current], None)?;
    Ok(figures(&trials))
}

/// Options for rigid bodies: springs, dampers and friction at every joint beside the terms of their energies.
fn rigid(states: &[&str], inputs: &[&str]) -> Options {
    let usual = Options::new(states, inputs);
    Options {
        library: Library { constant: true, friction: true, lagrangian: true, ..usual.library.clone() },
        order: 1,
        hold: Some(Hold::Linear),
        replicates: 0,
        ..usual
    }
}

/// A pendulum that hangs from a cart on a spring: (M + m) x″ + m ℓ (cos θ θ″ − sin θ θ′²) + c x′ + k x = f,
/// J θ″ + m ℓ cos θ x″ + m g ℓ sin θ + d θ′ = 0.
pub(super) fn cart_case(seeds: &[u64]) -> Result<Vec<Figure>> {
    const MASS: f64 = 1.3;
    const MOMENT: f64 = 0.12;
    const INERTIA: f64 = 0.06;
    const GRAVITY: f64 = 9.81 * MOMENT;
    const DAMPING: f64 = 1.5;
    const SPRING: f64 = 20.0;
    const PIVOT: f64 = 0.01;
    let machine = Machine {
        states: vec!["x", "theta", "v", "w"],
        measured: vec![(0, "m"), (1, "rad")],
        inputs: vec![("f", "N", 6.0)],
        band: (0.2, 3.0),
        late: Vec::new(),
        held: false,
        rates: Box::new(|x, u| {
            let (s, c) = x[1].sin_cos();
            let on_cart = u[0] + MOMENT * s * x[3] * x[3] - DAMPING * x[2] - SPRING * x[0];
            let on_pendulum = -GRAVITY * s - PIVOT * x[3];
            let (a, b, d) = (MASS, MOMENT * c, INERTIA);
            let determinant = a * d - b * b;
            let v = (d * on_cart - b * on_pendulum) / determinant;
            let w = (a * on_pendulum - b * on_cart) / determinant;
            vec![x[2], x[3], v, w]
        }),
    };
    let cart = Truth {
        input: Some("f"),
        terms: &[
            ("x''", MASS),
            ("(cos(theta)*theta'' - sin(theta)*theta'^2)", MOMENT),
            ("x'", DAMPING),
            ("x", SPRING),
        ],
    };
    let pendulum = Truth {
        input: None,
        terms: &[
            ("theta''", INERTIA),
            ("cos(theta)*x''", MOMENT),
            ("sin(theta)", GRAVITY),
            ("theta'", PIVOT),
        ],
    };
    let options = rigid(&["x", "theta"], &["f"]);
    let trials = run_seeds(seeds, |seed| Ok(vec![machine.record(seed)?]), &options, &[cart, pendulum], None)?;
    Ok(figures(&trials))
}

/// Two links hanging from a joint, the angle of the second counted from the first.
pub(super) fn arm_case(seeds: &[u64]) -> Result<Vec<Figure>> {
    // a = I₁ + m₁ c₁² + I₂ + m₂ (ℓ₁² + c₂²), b = I₂ + m₂ c₂², h = m₂ ℓ₁ c₂.
    const A: f64 = 0.40;
    const B: f64 = 0.052;
    const H: f64 = 0.08;
    const G1: f64 = 7.6;
    const G2: f64 = 1.57;
    const D1: f64 = 0.3;
    const D2: f64 = 0.08;
    let machine = Machine {
        states: vec!["q1", "q2", "w1", "w2"],
        measured: vec![(0, "rad"), (1, "rad")],
        inputs: vec![("t1", "N*m", 3.0), ("t2", "N*m", 0.6)],
        band: (0.2, 2.0),
        late: Vec::new(),
        held: false,
        rates: Box::new(|x, u| {
            let (s, c) = x[1].sin_cos();
            let (w1, w2) = (x[2], x[3]);
            let gravity = G2 * (x[0] + x[1]).sin();
            let first = u[0] + H * s * (2.0 * w1 * w2 + w2 * w2) - G1 * x[0].sin() - gravity - D1 * w1;
            let second = u[1] - H * s * w1 * w1 - gravity - D2 * w2;
            let (a, b) = (A + 2.0 * H * c, B + H * c);
            let determinant = a * B - b * b;
            vec![w1, w2, (B * first - b * second) / determinant, (a * second - b * first) / determinant]
        }),
    };
    let first = Truth {
        input: Some("t1"),
        terms: &[
            ("q1''", A),
            ("q2''", B),
            ("(cos(q2)*q1'' - sin(q2)*q1'*q2')", 2.0 * H),
            ("(cos(q2)*q2'' - sin(q2)*q2'^2)", H),
            ("sin(q1)", G1),
            ("sin(q1 + q2)", G2),
            ("q1'", D1),
        ],
    };
    let second = Truth {
        input: Some("t2"),
        terms: &[
            ("q2''", B),
            ("q1''", B),
            ("0.5*sin(q2)*q1'^2", 2.0 * H),
            ("cos(q2)*q1''", H),
            ("sin(q1 + q2)", G2),
            ("q2'", D2),
        ],
    };
    let options = rigid(&["q1", "q2"], &["t1", "t2"]);
    let trials = run_seeds(seeds, |seed| Ok(vec![machine.record(seed)?]), &options, &[first, second], None)?;
    Ok(figures(&trials))
}
