//! One case: a machine with something left out, its experiments, and the truth about them.

use std::f64::consts::TAU;

use anyhow::{Result, bail};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;

use super::plan::{Left, Mask, Slot, Tier};
use greybox_plants::excite::{Shape, quantile, rms, spread};
use greybox_plants::family::places;
use greybox_plants::kind::Kind;
use greybox_plants::machine::{Drive, Effect, FAMILIES, Family, Hold, Machine, Run, SUBSTEPS};
use greybox_plants::text::{self, Writing};

/// Draws before a slot is given up.
const ATTEMPTS: usize = 60;
/// Runge–Kutta steps per sample where only sizes matter.
const ROUGH: usize = 3;

/// A recording as a sensor would have made it.
#[derive(Debug, Clone)]
pub(crate) struct Recording {
    /// File name.
    pub(crate) name: String,
    /// What happened.
    pub(crate) run: Run,
    /// What the sensors show, by coordinate.
    pub(crate) shown: Vec<Vec<f64>>,
}

/// A case, complete.
#[derive(Debug, Clone)]
pub(crate) struct Case {
    pub(crate) machine: Machine,
    /// Parameters that the nominal model states.
    pub(crate) nominal: Vec<f64>,
    pub(crate) std: Vec<Option<f64>>,
    pub(crate) measured: Vec<bool>,
    pub(crate) hold: Hold,
    pub(crate) units: bool,
    pub(crate) dt: f64,
    /// The last one is held out.
    pub(crate) recordings: Vec<Recording>,
    pub(crate) truth: Truth,
}

/// What only the scorer reads.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Truth {
    pub(crate) id: String,
    pub(crate) index: usize,
    pub(crate) system: &'static str,
    /// `effect`, `null` or `outside`.
    pub(crate) class: &'static str,
    /// Of the weakest effect, by what was reached; absent in nulls.
    pub(crate) tier: Option<Tier>,
    pub(crate) masks: Vec<Mask>,
    pub(crate) effects: Vec<TruthEffect>,
    /// Outside the library: kinds a fair judge accepts.
    pub(crate) relatives: &'static [&'static str],
    /// Outside the library: the term without a name that is this law.
    pub(crate) term: Option<&'static str>,
    /// Channels that nothing pulls back: their free runs drift.
    pub(crate) drifting: Vec<String>,
    /// RMS of the measurement noise, by channel.
    pub(crate) noise: Vec<(String, f64)>,
    /// The model's parameters as they are.
    pub(crate) parameters: Vec<(String, f64)>,
    pub(crate) training: Vec<String>,
}

/// An effect as a report should show it.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct TruthEffect {
    pub(crate) kind: &'static str,
    pub(crate) family: &'static str,
    /// Equations in which it enters; any of them is right.
    pub(crate) equations: Vec<String>,
    /// For the sensing kinds.
    pub(crate) channel: Option<String>,
    pub(crate) drifting: Option<String>,
    pub(crate) parameters: Vec<(&'static str, f64)>,
    /// Kinds that state exactly the same here.
    pub(crate) twins: Vec<&'static str>,
    /// Where it acts in time, for the kinds with a threshold, by training recording.
    pub(crate) windows: Vec<(String, Vec<[f64; 2]>)>,
    /// RMS misfit over noise RMS of the model refitted without it: worst channel, first training
    /// recording, parameters and initial state refitted by a few Gauss–Newton steps.
    pub(crate) severity: f64,
}

impl Serialize for Tier {
    fn serialize<S: serde::Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.serialize_str(self.name())
    }
}

impl Serialize for Mask {
    fn serialize<S: serde::Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.serialize_str(self.name())
    }
}

fn log_uniform(rng: &mut Pcg64Mcg, low: f64, high: f64) -> f64 {
    low * (high / low).powf(rng.random_range(0.0..1.0))
}

/// Whether a masking can be had with a kind at a place of a family.
fn mask_fits(mask: Mask, kind: Option<Kind>, family: Family, place: usize) -> bool {
    match mask {
        Mask::WrongParameters | Mask::Quantised => true,
        Mask::Coloured => !matches!(kind, Some(Kind::SineOfPower)),
        Mask::ClosedLoop => {
            !matches!(family, Family::QuarterCar | Family::FlexibleLink)
                // The loop stands before what they change, so that its gain is not what it seems.
                && !matches!(kind, Some(Kind::FeedbackDelay | Kind::UnmodeledResonance | Kind::SensorDelay))
        }
        Mask::Rare => {
            matches!(kind, Some(Kind::EndStop | Kind::InputSaturation | Kind::StepDisturbance))
        }
        Mask::Unmeasured => match family {
            Family::DcMotor => true,
            Family::TwoMass | Family::QuarterCar => {
                // The second coordinate is not seen: what acts there alone, or on its sensor, is too weakly seen.
                kind.is_none_or(|k| !(k.on_measurement() && place == 1))
                    && !(family == Family::TwoMass && place == 1)
            }
            _ => false,
        },
        Mask::TwoEffects => kind.is_some_and(|k| !k.is_outside()),
        Mask::NotDriven => kind.is_some_and(|k| {
            !k.on_input() && !k.on_measurement() && k != Kind::ParameterDrift && !family.driven(place)
        }),
    }
}

/// Second effects that can be told from nearly every first one.
const SECOND: [Kind; 8] = [
    Kind::CoulombFriction,
    Kind::QuadraticDrag,
    Kind::CubicStiffness,
    Kind::InputSaturation,
    Kind::PeriodicDisturbance,
    Kind::ConstantOffset,
    Kind::Cogging,
    Kind::InputDeadZone,
];

/// The surroundings in which effects are sized.
struct Scene {
    dt: f64,
    samples: usize,
    omega: f64,
    /// The bare machine's run.
    run: Run,
    rare: bool,
}

impl Scene {
    fn motion(&self, family: Family, place: usize) -> (Vec<f64>, Vec<f64>) {
        let c = family.places()[place].c;
        let along = |x: &[Vec<f64>]| -> Vec<f64> {
            (0..x[0].len()).map(|k| c[0] * x[0][k] + x.get(1).map_or(0.0, |x| c[1] * x[k])).collect()
        };
        (along(&self.run.q), along(&self.run.v))
    }

    /// RMS of the force of inertia along a place.
    fn force(&self, machine: &Machine, place: usize) -> f64 {
        let (_, rate) = self.motion(machine.family, place);
        let acceleration: Vec<f64> = rate.windows(2).map(|w| (w[1] - w[0]) / self.dt).collect();
        inertia(machine, place) * rms(&acceleration)
    }
}

/// Mass or inertia that moves along a place.
fn inertia(machine: &Machine, place: usize) -> f64 {
    let p = &machine.p;
    match (machine.family, place) {
        (Family::TwoMass, 1) => p[4],
        (Family::TwoMass, 2) => p[0] * p[4] / (p[0] + p[4]),
        (Family::FlexibleLink, 1) => p[3],
        (Family::Table, 1) => p[2],
        _ => p[0],
    }
}

/// An effect of growing strength: from nothing at 0 to as much as is sensible at 1.
struct Growing {
    effect: Effect,
    /// The parameters at a strength.
    at: Box<dyn Fn(f64) -> [f64; 3]>,
    /// Its strength is given and the noise is fitted to it instead.
    given: bool,
}

impl Growing {
    fn with(&self, strength: f64) -> Effect {
        Effect { p: (self.at)(strength), ..self.effect.clone() }
    }
}

fn grow(kind: Kind, place: usize, machine: &Machine, scene: &Scene, rng: &mut Pcg64Mcg) -> Growing {
    let family = machine.family;
    let at_place = if kind.on_input() || kind.on_measurement() { 0 } else { place };
    let (d, r) = scene.motion(family, at_place);
    let force = scene.force(machine, at_place).max(1e-12);
    let (rd, rr) = (rms(&d).max(1e-12), rms(&r).max(1e-12));
    let top = d.iter().fold(0f64, |m, x| m.max(x.abs())).max(1e-12);
    let period = TAU / scene.omega;
    let length = scene.samples as f64 * scene.dt;
    let sub = scene.dt / SUBSTEPS as f64;
    let either = |rng: &mut Pcg64Mcg| if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let (mut which, mut given) = (0, false);
    let one = |x: f64| -> Box<dyn Fn(f64) -> [f64; 3]> { Box::new(move |s| [s * x, 0.0, 0.0]) };
    let at: Box<dyn Fn(f64) -> [f64; 3]> = match kind {
        Kind::ViscousFriction => one(0.6 * force / rr),
        Kind::CoulombFriction => one(0.6 * force),
        Kind::AsymmetricCoulombFriction => {
            let part = rng.random_range(0.25..0.6) * either(rng);
            Box::new(move |s| [0.6 * s * force * (1.0 + part), 0.6 * s * force * (1.0 - part), 0.0])
        }
        Kind::StribeckFriction => {
            let (more, vs) = (rng.random_range(1.5..2.5), rng.random_range(0.1..0.5) * rr);
            Box::new(move |s| [0.4 * s * force, 0.4 * s * force * more, vs])
        }
        Kind::PreslidingFriction => {
            let zc = rng.random_range(0.02..0.15) * rd;
            Box::new(move |s| [0.6 * s * force / zc, 0.6 * s * force, 0.0])
        }
        Kind::QuadraticDrag => one(0.7 * force / (rr * rr)),
        Kind::LoadDependentFriction => one(0.6),
        Kind::LinearStiffness => one(0.8 * force / rd),
        Kind::QuadraticStiffness => one(0.4 * force / (rd * rd) * either(rng)),
        Kind::CubicStiffness => one(0.8 * force / rd.powi(3)),
        Kind::DeadZone => one(0.8 * rd),
        Kind::EndStop => {
            let side = if scene.rare { rng.random_range(0.965..0.985) } else { rng.random_range(0.82..0.93) };
            let xst = quantile(&d, side);
            let stiff = 40.0 * inertia(machine, at_place) * scene.omega * scene.omega;
            Box::new(move |s| [s * stiff, xst, 0.0])
        }
        Kind::BoucWenHysteresis => {
            let be = rng.random_range(0.7..2.5) / rd;
            let ga = rng.random_range(-0.3..0.6) * be;
            Box::new(move |s| [s * force * (be + ga), be, ga])
        }
        Kind::InputSaturation => {
            let size: Vec<f64> = scene.run.u[place].iter().map(|u| u.abs()).collect();
            given = scene.rare;
            let share = if scene.rare { rng.random_range(0.955..0.98) } else { 0.2 };
            let (most, least) = (quantile(&size, 1.0), quantile(&size, share));
            Box::new(move |s| [most - s * (most - least), 0.0, 0.0])
        }
        Kind::InputDeadZone => one(0.8 * rms(&scene.run.u[place])),
        Kind::InputDelay | Kind::SensorDelay => {
            let most = 0.3 * period;
            Box::new(move |s| [(s * most / sub).round().max(4.0) * sub, 0.0, 0.0])
        }
        Kind::FeedbackDelay => {
            // Below the delay at which the spring would take all the damping.
            let (c, k) = match family {
                Family::Table => (machine.p[3], machine.p[4]),
                _ => (machine.p[1], machine.p[2]),
            };
            let most = (0.8 * c / k).min(0.25 * period);
            Box::new(move |s| [(s * most / sub).round().max(4.0) * sub, 0.0, 0.0])
        }
        Kind::ActuatorLag => one(0.3 * period),
        Kind::InputOffset => one(0.8 * rms(&scene.run.u[place]) * either(rng)),
        Kind::Gravity => one(1.5 * force),
        Kind::Cogging => {
            let (low, high) = (quantile(&d, 0.0), quantile(&d, 1.0));
            let n = TAU * rng.random_range(3.0..10.0) / (high - low);
            let phase = rng.random_range(0.2..2.9);
            Box::new(move |s| [s * force, n, phase])
        }
        Kind::PositionDependentInertia => {
            let (je, n) = (0.7 * inertia(machine, at_place), f64::from(rng.random_range(1..3)));
            Box::new(move |s| [s * je, n, 0.0])
        }
        Kind::Coupling => {
            let (other, other_rate) = scene.motion(family, 1 - place);
            let acceleration: Vec<f64> = other_rate.windows(2).map(|w| (w[1] - w[0]) / scene.dt).collect();
            let order = rng.random_range(0..3);
            which = usize::from(rng.random_bool(0.6));
            // In both equations a mass and a spring must leave the machine positive.
            let (m1, m2, k2) = (machine.p[0], machine.p[2], machine.p[4]);
            let size = match order {
                0 => (0.6 * force / rms(&other)).min(0.5 * k2),
                1 => 0.6 * force / rms(&other_rate),
                _ => (0.6 * force / rms(&acceleration)).min(0.5 * (m1 * m2).sqrt()),
            };
            if order == 0 && which == 1 {
                // A spring between an axis that nothing holds and the other would tip it over.
                which = 0;
            }
            let sign = either(rng);
            Box::new(move |s| {
                let mut p = [0.0; 3];
                p[order] = sign * s * size;
                p
            })
        }
        Kind::UnmodeledResonance => {
            let own = inertia(machine, at_place);
            let (omega, zeta) = (scene.omega * rng.random_range(1.4..2.6), rng.random_range(0.02..0.08));
            Box::new(move |s| {
                let ma = 0.6 * s * own;
                [ma, ma * omega * omega, 2.0 * zeta * omega * ma]
            })
        }
        Kind::ConstantOffset => one(0.8 * force * either(rng)),
        Kind::PeriodicDisturbance => {
            let f = scene.omega / TAU * log_uniform(rng, 0.25, 1.8);
            let phase = rng.random_range(0.2..2.9);
            Box::new(move |s| [s * force, f, phase])
        }
        Kind::StepDisturbance => {
            let part = if scene.rare { rng.random_range(0.955..0.975) } else { rng.random_range(0.3..0.8) };
            let t0 = ((part * scene.samples as f64).floor() + 0.5) * scene.dt;
            let sign = either(rng);
            Box::new(move |s| [1.5 * s * force * sign, t0, 0.0])
        }
        Kind::ParameterDrift => {
            let free: Vec<usize> = (0..machine.p.len())
                .filter(|&i| !family.parameters()[i].fixed && machine.p[i] != 0.0)
                .collect();
            which = free[rng.random_range(0..free.len())];
            let sign = either(rng);
            Box::new(move |s| {
                let rate = s / length;
                [if sign > 0.0 { 1.5 * rate } else { -0.6 * rate }, 0.0, 0.0]
            })
        }
        Kind::SensorOffset => one(rms(&scene.run.q[place]) * either(rng)),
        Kind::DisplacementDamping => one(0.6 * force / (rd * rd * rr)),
        Kind::SineOfPower => {
            let n = rng.random_range(2.0..5.0) / (rd * rr);
            Box::new(move |s| [s * force, n, 0.0])
        }
        Kind::BreathingQuadratic => {
            let f = scene.omega / TAU * rng.random_range(0.05..0.2);
            Box::new(move |s| [0.4 * s * force / (rd * rd), f, 0.0])
        }
        Kind::PositionFriction => one(0.8 * force / (rd * rd)),
        Kind::ProductCoupling => one(0.8 * force / (rms(&scene.run.q[0]) * rd)),
        Kind::TiringActuator => {
            let (size, time) = (rms(&scene.run.u[place]), rng.random_range(0.3..2.0) * period);
            Box::new(move |s| [2.0 * s / size, time, 0.0])
        }
        Kind::QuinticStiffness => one(0.3 * force / (rd.powi(5)).max(top.powi(5) * 0.02)),
        Kind::ParametricExcitation => {
            let f = scene.omega / TAU * rng.random_range(0.15..0.6);
            Box::new(move |s| [0.5 * s * force / rd, f, 0.0])
        }
        Kind::EddyBrake => {
            let vb = rng.random_range(0.4..1.2) * rr;
            Box::new(move |s| [1.5 * s * force / vb, vb, 0.0])
        }
        Kind::MaxwellElement => {
            let time = rng.random_range(0.5..2.0) / scene.omega;
            Box::new(move |s| [s * force / rd, time, 0.0])
        }
        Kind::AgeingFriction => {
            let (vw, time) = (rng.random_range(0.2..0.6) * rr, rng.random_range(0.2..0.6) * period);
            Box::new(move |s| [2.0 * s * force, vw, time])
        }
        Kind::OneWayDamper => one(force / rr),
        Kind::PowerDrag => one(0.8 * force / rr.powf(1.5)),
        Kind::LockingSpring => {
            let le = rng.random_range(0.3..0.6) * top;
            Box::new(move |s| [s * force / (rd / le).sinh(), le, 0.0])
        }
    };
    Growing { effect: Effect { kind, at: place, p: [0.0; 3], which }, at, given }
}

/// What is measured and how well, for sizing.
struct Sensors<'a> {
    measured: &'a [bool],
    sigma: &'a [f64],
}

impl Sensors<'_> {
    /// All measured channels behind one another, in units of their noise.
    fn stack(&self, y: &[Vec<f64>]) -> Vec<f64> {
        let seen = (0..y.len()).filter(|&c| self.measured[c]);
        seen.flat_map(|c| y[c].iter().map(move |x| x / self.sigma[c])).collect()
    }
}

/// The machine without its effects, as one would calibrate it: free parameters (as factors of the true
/// ones) and initial state (in parts of the motion).
struct Refit<'a> {
    bare: &'a Machine,
    start: [f64; 4],
    scene: &'a Scene,
    hold: Hold,
    sensors: &'a Sensors<'a>,
    /// What moves: parameters, then entries of the initial state with their sizes.
    free: Vec<usize>,
    initial: Vec<(usize, f64)>,
}

impl<'a> Refit<'a> {
    fn new(
        bare: &'a Machine,
        start: [f64; 4],
        scene: &'a Scene,
        hold: Hold,
        sensors: &'a Sensors<'a>,
    ) -> Self {
        let named = bare.family.parameters();
        let free = (0..bare.p.len()).filter(|&i| !named[i].fixed && bare.p[i] != 0.0).collect();
        let n = bare.family.coordinates();
        let size = |i: usize| if i < 2 { spread(&scene.run.q[i]) } else { rms(&scene.run.v[i - 2]) };
        let initial = (0..n).chain(2..2 + n).map(|i| (i, size(i))).collect();
        Refit { bare, start, scene, hold, sensors, free, initial }
    }

    /// What the sensors show, in units of their noise, for changes `x` of all that moves.
    fn simulate(&self, x: &[f64], u: &[Vec<f64>]) -> Vec<f64> {
        let (mut machine, mut start) = (self.bare.clone(), self.start);
        for (&i, x) in self.free.iter().zip(x) {
            machine.p[i] *= 1.0 + x;
        }
        for (&(i, size), x) in self.initial.iter().zip(&x[self.free.len()..]) {
            start[i] += size * x;
        }
        let run = machine.run(start, self.scene.samples, self.scene.dt, self.hold, Drive::Samples(u), ROUGH);
        if run.finite { self.sensors.stack(&run.y) } else { Vec::new() }
    }

    fn count(&self) -> usize {
        self.free.len() + self.initial.len()
    }

    /// Orthonormal responses around `x`, and the triangle that leads back to changes of `x`.
    fn basis(&self, x: &[f64], base: &[f64], u: &[Vec<f64>]) -> Basis {
        let mut basis = Basis::default();
        for i in 0..self.count() {
            let mut other = x.to_vec();
            other[i] += 1e-3;
            let shifted = self.simulate(&other, u);
            if shifted.len() == base.len() {
                basis.take(i, difference(&shifted, base).iter().map(|d| d / 1e-3).collect());
            }
        }
        basis
    }

    /// Largest RMS misfit of any channel over its noise, of the best fit to `target` that a few
    /// Gauss–Newton steps find.
    fn misfit(&self, target: &[f64], u: &[Vec<f64>]) -> f64 {
        let mut x = vec![0.0; self.count()];
        let mut residual = difference(target, &self.simulate(&x, u));
        for _ in 0..6 {
            let base = difference(target, &residual);
            let step = self.basis(&x, &base, u).solve(&residual, x.len());
            let better = [1.0, 0.5, 0.2, 0.05].iter().find_map(|part| {
                let mut trial: Vec<f64> = x.iter().zip(&step).map(|(x, s)| x + part * s).collect();
                // Parameters keep their sign.
                trial[..self.free.len()].iter_mut().for_each(|x| *x = x.max(-0.95));
                let simulated = self.simulate(&trial, u);
                let left = difference(target, &simulated);
                (simulated.len() == target.len() && rms(&left) < rms(&residual)).then_some((trial, left))
            });
            let Some((trial, left)) = better else { break };
            let gained = 1.0 - rms(&left) / rms(&residual);
            (x, residual) = (trial, left);
            if gained < 2e-3 {
                break;
            }
        }
        residual.chunks(self.scene.samples).map(rms).fold(0.0, f64::max)
    }
}

/// Columns made orthonormal one by one, and how.
#[derive(Default)]
struct Basis {
    columns: Vec<(usize, Vec<f64>)>,
    /// Row by row: what each column had of those before it, and its own length.
    triangle: Vec<Vec<f64>>,
}

impl Basis {
    fn take(&mut self, index: usize, mut column: Vec<f64>) {
        let before = rms(&column);
        let mut parts = vec![0.0; self.columns.len()];
        // Twice is enough (Kahan and Parlett).
        for _ in 0..2 {
            for (part, (_, unit)) in parts.iter_mut().zip(&self.columns) {
                *part += subtract(&mut column, unit);
            }
        }
        let size = column.iter().map(|x| x * x).sum::<f64>().sqrt();
        if rms(&column) > 1e-7 * before && size.is_finite() && size > 0.0 {
            column.iter_mut().for_each(|x| *x /= size);
            parts.push(size);
            self.columns.push((index, column));
            self.triangle.push(parts);
        }
    }

    /// What is left of a vector.
    fn project(&self, mut x: Vec<f64>) -> Vec<f64> {
        self.columns.iter().for_each(|(_, unit)| {
            subtract(&mut x, unit);
        });
        x
    }

    /// Least squares; columns that say nothing new get 0.
    fn solve(&self, target: &[f64], count: usize) -> Vec<f64> {
        let mut rest = target.to_vec();
        let along: Vec<f64> = self.columns.iter().map(|(_, unit)| subtract(&mut rest, unit)).collect();
        let mut out = vec![0.0; count];
        let n = self.columns.len();
        let mut solved = vec![0.0; n];
        for i in (0..n).rev() {
            let later: f64 = (i + 1..n).map(|j| self.triangle[j][i] * solved[j]).sum();
            solved[i] = (along[i] - later) / self.triangle[i][i];
            out[self.columns[i].0] = solved[i];
        }
        out
    }
}

fn difference(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

/// Takes the part along a unit vector away, and returns its length.
fn subtract(x: &mut [f64], unit: &[f64]) -> f64 {
    let along: f64 = x.iter().zip(unit).map(|(a, b)| a * b).sum();
    x.iter_mut().zip(unit).for_each(|(x, u)| *x -= along * u);
    along
}

/// Everything of an experiment but the machine.
struct Setup {
    dt: f64,
    hold: Hold,
    shape_rate: f64,
    /// RMS of the inputs (open loop) or of the reference.
    size: [f64; 2],
    controller: Option<Controller>,
}

/// Proportional-derivative-integral tracking of the first coordinate, with a filtered derivative.
#[derive(Clone, Copy)]
struct Controller {
    kp: f64,
    kd: f64,
    ki: f64,
    /// Share of the last derivative that the filter keeps.
    keep: f64,
}

impl Setup {
    /// Runs a machine on freshly drawn signals, with what the loop feeds back disturbed by `noise`.
    fn run(
        &self,
        machine: &Machine,
        start: [f64; 4],
        signals: &[Vec<f64>],
        noise: &[Vec<f64>],
        quantum: &[f64],
        substeps: usize,
    ) -> Run {
        let samples = signals[0].len();
        match self.controller {
            None => {
                let u: Vec<Vec<f64>> = signals
                    .iter()
                    .zip(self.size)
                    .map(|(s, size)| s.iter().map(|x| x * size).collect())
                    .collect();
                machine.run(start, samples, self.dt, self.hold, Drive::Samples(&u), substeps)
            }
            Some(law) => {
                let (mut last, mut rate, mut sum) = (None, 0.0, 0.0);
                let mut step = |k: usize, y: &[f64]| {
                    let shown = round_to(y[0] + noise[0][k], quantum[0]);
                    let error = self.size[0] * signals[0][k] - shown;
                    let raw = last.map_or(0.0, |l| (error - l) / self.dt);
                    last = Some(error);
                    rate = law.keep * rate + (1.0 - law.keep) * raw;
                    sum += error * self.dt;
                    let second = signals.get(1).map_or(0.0, |s| self.size[1] * s[k]);
                    [law.kp * error + law.kd * rate + law.ki * sum, second]
                };
                machine.run(start, samples, self.dt, self.hold, Drive::Controller(&mut step), substeps)
            }
        }
    }
}

fn round_to(x: f64, quantum: f64) -> f64 {
    if quantum > 0.0 { (x / quantum).round() * quantum } else { x }
}

/// Noise of a sensor.
#[derive(Clone, Copy)]
struct Noise {
    /// RMS.
    sigma: f64,
    /// Coefficient of the AR(1) process.
    colour: f64,
}

impl Noise {
    fn draw(self, samples: usize, rng: &mut Pcg64Mcg) -> Vec<f64> {
        let mut normal = || -> f64 { StandardNormal.sample(rng) };
        let innovation = (1.0 - self.colour * self.colour).sqrt();
        let mut now = normal();
        (0..samples)
            .map(|_| {
                let shown = now;
                now = self.colour * now + innovation * normal();
                self.sigma * shown
            })
            .collect()
    }
}

/// Makes the case of a slot.
///
/// # Errors
/// When no attempt gives a case that makes sense; the message names the slot.
pub(crate) fn make(slot: &Slot) -> Result<Case> {
    for attempt in 0..ATTEMPTS {
        let mut rng =
            Pcg64Mcg::seed_from_u64(slot.seed.wrapping_add((attempt as u64).wrapping_mul(0x9e37_79b9)));
        // A masking that cannot be had gives way to the next after some attempts.
        if let Some(case) = attempt_case(slot, attempt, &mut rng) {
            return Ok(case);
        }
    }
    bail!("case {}: no sensible machine for {:?} in {ATTEMPTS} attempts", slot.index, slot.left)
}

fn attempt_case(slot: &Slot, attempt: usize, rng: &mut Pcg64Mcg) -> Option<Case> {
    let kind = match slot.left {
        Left::Nothing => None,
        Left::Effect(kind) => Some(kind),
    };
    let mut spots: Vec<(Family, usize)> = Vec::new();
    for family in FAMILIES {
        match kind {
            None => spots.push((family, 0)),
            Some(kind) => spots.extend(places(kind, family).into_iter().map(|p| (family, p))),
        }
    }
    // The first masking that any spot allows; later attempts move on to the next.
    let possible: Vec<Mask> = slot
        .masks
        .iter()
        .copied()
        .filter(|&m| spots.iter().any(|&(f, p)| mask_fits(m, kind, f, p)))
        .collect();
    let mask = *possible.get((attempt / 8) % possible.len().max(1))?;
    spots.retain(|&(f, p)| mask_fits(mask, kind, f, p));
    // Families first, so that one with many places is not drawn more often.
    let mut families: Vec<Family> = spots.iter().map(|s| s.0).collect();
    families.dedup();
    let family = families[rng.random_range(0..families.len())];
    spots.retain(|s| s.0 == family);
    let place = spots[rng.random_range(0..spots.len())].1;

    let mut masks = vec![mask];
    let draw_mask = |m: Mask, chance: f64, masks: &mut Vec<Mask>, rng: &mut Pcg64Mcg| {
        if !masks.contains(&m) && rng.random_bool(chance) && mask_fits(m, kind, family, place) {
            masks.push(m);
        }
    };
    draw_mask(Mask::WrongParameters, 0.4, &mut masks, rng);
    if mask != Mask::Coloured {
        draw_mask(Mask::Quantised, 0.1, &mut masks, rng);
    }
    if family == Family::DcMotor && !masks.contains(&Mask::Unmeasured) {
        masks.push(Mask::Unmeasured);
    }
    let has = |m: Mask| masks.contains(&m);

    // Sampling and machine.
    let rate = [100.0, 200.0, 250.0, 400.0, 500.0, 1000.0][rng.random_range(0..6)];
    let dt = 1.0 / rate;
    let samples = 250 * rng.random_range(16..32);
    let held = samples / 3;
    let omega = TAU * rate / rng.random_range(70.0..160.0);
    let swing = matches!(kind, Some(Kind::Gravity | Kind::PositionDependentInertia | Kind::Cogging));
    let size = match family {
        f if f.rotary() && swing && f != Family::Pendulum => rng.random_range(0.8..1.6),
        Family::Pendulum => rng.random_range(0.45..0.8),
        f if f.rotary() => rng.random_range(0.3..0.9),
        _ => rng.random_range(0.01..0.05),
    };
    let mut machine = Machine { family, p: family.draw(omega, size, rng), effects: Vec::new() };
    if kind == Some(Kind::FeedbackDelay) {
        let (c, k, m) = if family == Family::Table { (3, 4, 2) } else { (1, 2, 0) };
        machine.p[c] = 2.0 * rng.random_range(0.35..0.6) * (machine.p[k] * machine.p[m]).sqrt();
    }
    if kind == Some(Kind::ViscousFriction) {
        machine.p[family.damper(place)?] = 0.0;
    }
    if kind == Some(Kind::LinearStiffness) && family == Family::Table && place != 0 {
        return None;
    }

    // The experiment, scaled until the first coordinate (or the spring's motion) has its size.
    let n = family.coordinates();
    let controller = has(Mask::ClosedLoop).then(|| tracking(&machine, omega, dt, rng));
    let hold = if controller.is_some() || rng.random_bool(0.2) { Hold::Zero } else { Hold::Linear };
    let shape = Shape::draw(rng);
    let mut setup = Setup { dt, hold, shape_rate: omega / TAU, size: [1.0; 2], controller };
    let signals = draw_signals(&setup, shape, family, samples, rng);
    let mut start = [0.0; 4];
    let silent = vec![vec![0.0; samples]; 2];
    setup.size = first_size(&machine, size, controller.is_some());
    for _ in 0..5 {
        let run = setup.run(&machine, start, &signals, &silent, &[0.0; 2], ROUGH);
        if !run.finite {
            setup.size.iter_mut().for_each(|s| *s *= 0.3);
            continue;
        }
        let moved = if family == Family::QuarterCar {
            spread(&difference(&run.q[0], &run.q[1]))
        } else {
            spread(&run.q[0])
        };
        setup.size[0] *= (size / moved).clamp(0.2, 5.0);
        if family == Family::Table {
            setup.size[1] *= (size / spread(&run.q[1])).clamp(0.2, 5.0);
        }
    }
    let run = setup.run(&machine, start, &signals, &silent, &[0.0; 2], ROUGH);
    if !run.finite || (family == Family::Pendulum && run.q[0].iter().any(|q| q.abs() > 2.6)) {
        return None;
    }
    (0..n).for_each(|i| {
        start[i] = 0.4 * spread(&run.q[i]) * rng.random_range(-1.0..1.0);
        start[2 + i] = 0.3 * rms(&run.v[i]) * rng.random_range(-1.0..1.0);
    });
    let run = setup.run(&machine, start, &signals, &silent, &[0.0; 2], ROUGH);
    if !run.finite {
        return None;
    }

    // Sensors.
    let mut measured = vec![true; n];
    if has(Mask::Unmeasured) && n == 2 {
        measured[1] = false;
    }
    let spreads: Vec<f64> = run.q.iter().map(|q| spread(q)).collect();
    let colour = if has(Mask::Coloured) { rng.random_range(0.9..0.97) } else { 0.0 };
    let mut part =
        if has(Mask::Coloured) { log_uniform(rng, 0.005, 0.04) } else { log_uniform(rng, 0.002, 0.03) };
    if has(Mask::ClosedLoop) {
        part = part.min(0.008);
    }
    let scene = Scene { dt, samples, omega, run, rare: has(Mask::Rare) };
    let sigma: Vec<f64> = spreads.iter().map(|s| part * s).collect();

    // Effects of the strength that the tier asks for.
    let mut kinds: Vec<(Kind, usize)> = kind.map(|k| (k, place)).into_iter().collect();
    if has(Mask::TwoEffects) {
        kinds.push(second(kind?, place, family, rng)?);
    }
    let mut severities = Vec::new();
    if !kinds.is_empty() {
        let sensors = Sensors { measured: &measured, sigma: &sigma };
        let bare = machine.clone();
        let refit = Refit::new(&bare, start, &scene, hold, &sensors);
        let still = vec![0.0; refit.count()];
        let basis = refit.basis(&still, &refit.simulate(&still, &scene.run.u), &scene.run.u);
        let with = |effect: &Effect| {
            let machine = Machine { effects: vec![effect.clone()], ..bare.clone() };
            let run = setup.run(&machine, start, &signals, &silent, &[0.0; 2], ROUGH);
            run.finite.then_some(run)
        };
        // The quick measure, by a linear refit around the truth; and the slow one, by a real one.
        let quick = |effect: &Effect| -> f64 {
            let Some(run) = with(effect) else { return f64::NAN };
            let without = refit.simulate(&still, &run.u);
            if without.is_empty() {
                return f64::NAN;
            }
            let left = basis.project(difference(&sensors.stack(&run.y), &without));
            left.chunks(samples).map(rms).fold(0.0, f64::max)
        };
        let slow = |effect: &Effect| -> f64 {
            with(effect).map_or(f64::NAN, |run| refit.misfit(&sensors.stack(&run.y), &run.u))
        };
        let mut scale = 1.0;
        for (number, &(kind, place)) in kinds.iter().enumerate() {
            let target = slot.tier.target(rng);
            let growing = grow(kind, place, &bare, &scene, rng);
            let mut effect = growing.with(1.0);
            let mut reached = f64::NAN;
            if growing.given {
                reached = slow(&effect);
            } else {
                let mut aim = target;
                for _ in 0..3 {
                    effect = strength_for(aim, &growing, &quick)?;
                    reached = slow(&effect);
                    if !(reached.is_finite() && (reached / target - 1.0).abs() > 0.15) {
                        break;
                    }
                    aim *= (target / reached).clamp(0.1, 10.0);
                }
            }
            if !reached.is_finite() {
                return None;
            }
            if growing.given && number == 0 {
                // The noise is fitted to the effect.
                scale = (reached / target).clamp(0.0005 / part, 0.05 / part);
            }
            reached /= scale;
            Tier::of(reached)?;
            machine.effects.push(effect);
            severities.push(reached);
        }
        if scale != 1.0 {
            part *= scale;
        }
    }
    let sigma: Vec<f64> = spreads.iter().map(|s| part * s).collect();
    // An encoder: its steps make the noise, with a little of an analogue one.
    let quantum: Vec<f64> =
        sigma.iter().map(|s| if has(Mask::Quantised) { s * 12f64.sqrt() * 0.98 } else { 0.0 }).collect();
    let noise =
        |c: usize| Noise { sigma: if has(Mask::Quantised) { 0.2 * sigma[c] } else { sigma[c] }, colour };

    // The recordings.
    let two = rng.random_bool(0.15);
    let mut recordings = Vec::new();
    let mut names = vec!["train.csv"];
    if two {
        names.push("train2.csv");
    }
    names.push("holdout.csv");
    for name in names {
        let length = match name {
            "holdout.csv" => held,
            _ if two => samples * 3 / 5,
            _ => samples,
        };
        let mut from = start;
        let own = if name == "train.csv" {
            signals.iter().map(|s| s[..length].to_vec()).collect()
        } else {
            from.iter_mut().for_each(|x| *x *= rng.random_range(-1.2..1.2));
            let shape = if rng.random_bool(0.6) { shape } else { Shape::draw(rng) };
            let mut own = draw_signals(&setup, shape, family, length, rng);
            // Not far outside what was trained on.
            own.iter_mut().flatten().for_each(|x| *x *= 0.95);
            own
        };
        let noises: Vec<Vec<f64>> = (0..n).map(|c| noise(c).draw(length, rng)).collect();
        let run = setup.run(&machine, from, &own, &noises, &quantum, SUBSTEPS);
        let bound = 12.0;
        if !run.finite || (0..n).any(|c| spread(&run.q[c]) > bound * spreads[c]) {
            return None;
        }
        if family == Family::Pendulum && run.q[0].iter().any(|q| q.abs() > 2.9) {
            return None;
        }
        let shown = (0..n)
            .map(|c| run.y[c].iter().zip(&noises[c]).map(|(y, e)| round_to(y + e, quantum[c])).collect())
            .collect();
        recordings.push(Recording { name: name.to_owned(), run, shown });
    }
    if machine.effects.iter().any(|e| !acts(e, &machine, &recordings, dt, has(Mask::Rare))) {
        return None;
    }

    // The nominal model: always a little wrong, sometimes much.
    let far = if has(Mask::WrongParameters) { 0.12..0.30 } else { 0.05..0.12 };
    let nominal: Vec<f64> = family
        .parameters()
        .iter()
        .zip(&machine.p)
        .map(|(named, &p)| {
            let off = rng.random_range(far.clone()) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            if named.fixed { significant(p, 15) } else { significant(p * (1.0 + off), 4) }
        })
        .collect();
    let stated = rng.random_bool(0.4);
    let std = nominal.iter().map(|p| stated.then_some(significant(0.25 * p.abs(), 2))).collect();
    let severities: Vec<f64> = severities;
    let truth = truth(slot, &machine, &masks, &measured, &sigma, &recordings, dt, &severities);
    Some(Case { machine, nominal, std, measured, hold, units: rng.random_bool(0.7), dt, recordings, truth })
}

/// The second effect of a pair and its place.
fn second(first: Kind, place: usize, family: Family, rng: &mut Pcg64Mcg) -> Option<(Kind, usize)> {
    let kind = SECOND[rng.random_range(0..SECOND.len())];
    let spots = places(kind, family);
    let at = *spots.get(rng.random_range(0..spots.len().max(1)))?;
    // Not of the same family at the same place: they would be hard to tell from a third.
    let near = kind.family() == first.family()
        || matches!(
            (first, kind),
            (Kind::SensorOffset, Kind::ConstantOffset)
                | (Kind::InputOffset, Kind::ConstantOffset)
                | (Kind::AsymmetricCoulombFriction, Kind::ConstantOffset)
                | (Kind::Gravity, Kind::Cogging)
                | (Kind::Gravity | Kind::LinearStiffness, Kind::CubicStiffness)
                | (Kind::BoucWenHysteresis, Kind::CoulombFriction)
                | (Kind::QuadraticStiffness, Kind::ConstantOffset)
                | (Kind::StepDisturbance, Kind::ConstantOffset)
                | (Kind::LoadDependentFriction, Kind::InputDeadZone | Kind::InputSaturation)
                | (Kind::UnmodeledResonance, Kind::PeriodicDisturbance)
        );
    let _ = place;
    (!near).then_some((kind, at))
}

/// The effect at the strength whose misfit reaches `target`, or as strong as it gets.
fn strength_for(target: f64, growing: &Growing, measure: &dyn Fn(&Effect) -> f64) -> Option<Effect> {
    let reach = |s: f64| measure(&growing.with(s));
    let (mut low, mut high) = (1e-4f64, 1.0f64);
    let mut top = reach(high);
    // A machine may not stand the strongest form.
    for _ in 0..6 {
        if top.is_finite() {
            break;
        }
        high *= 0.4;
        top = reach(high);
    }
    if !top.is_finite() {
        return None;
    }
    if top > target {
        for _ in 0..12 {
            let middle = (low * high).sqrt();
            let ratio = reach(middle);
            if ratio.is_nan() || ratio > target {
                high = middle
            } else {
                low = middle
            }
            if (ratio / target - 1.0).abs() < 0.05 {
                high = middle;
                break;
            }
        }
    }
    Some(growing.with(high))
}

/// Starting sizes of the inputs for a motion of about `size`.
fn first_size(machine: &Machine, size: f64, closed: bool) -> [f64; 2] {
    let p = &machine.p;
    if closed {
        return [size, if machine.family == Family::Table { size * p[4] } else { 0.0 }];
    }
    match machine.family {
        Family::Oscillator | Family::Duffing | Family::Pendulum => [0.3 * size * p[2], 0.0],
        Family::QuarterCar => [size, 0.0],
        Family::Table => [size * p[4] * p[0] / (p[2] * p[5]), 0.3 * size * p[4]],
        Family::TwoMass => [0.3 * size * p[2] / p[6], 0.0],
        Family::FlexibleLink => [0.3 * size * p[2] / p[5], 0.0],
        Family::DcMotor => [size * p[2] * 10.0, 0.0],
        Family::Servo => [size * p[1] * 10.0 / p[2].max(1e-9), 0.0],
    }
}

fn draw_signals(
    setup: &Setup,
    shape: Shape,
    family: Family,
    samples: usize,
    rng: &mut Pcg64Mcg,
) -> Vec<Vec<f64>> {
    (0..family.inputs()).map(|_| shape.draw_signal(samples, setup.dt, setup.shape_rate, rng)).collect()
}

fn tracking(machine: &Machine, omega: f64, dt: f64, rng: &mut Pcg64Mcg) -> Controller {
    let p = &machine.p;
    let (mass, gain) = match machine.family {
        Family::Servo => (p[0], p[2]),
        Family::TwoMass => (p[0] + p[4], p[6]),
        Family::DcMotor => (p[0], p[2] / p[4]),
        Family::Table => (p[0], p[5]),
        _ => (p[0], 1.0),
    };
    let share = if machine.family == Family::TwoMass { 0.4 } else { 1.0 };
    let wc = share * rng.random_range(0.9..1.4) * omega;
    let kp = mass * wc * wc / gain;
    let ki = if rng.random_bool(0.4) { 0.15 * kp * wc } else { 0.0 };
    Controller { kp, kd: 1.2 * mass * wc / gain, ki, keep: (-dt * 12.0 * wc).exp() }
}

/// Whether the effect is there in the training recordings, and rare or not as asked.
fn acts(effect: &Effect, machine: &Machine, recordings: &[Recording], dt: f64, rare: bool) -> bool {
    let training = &recordings[..recordings.len() - 1];
    if !effect.kind.has_threshold() {
        return true;
    }
    let (mut active, mut all) = (0, 0);
    for r in training {
        let flags = activity(effect, machine, &r.run, dt);
        active += flags.iter().filter(|&&a| a).count();
        all += flags.len();
    }
    let share = active as f64 / all.max(1) as f64;
    let least = if rare { 0.004 } else { 0.01 };
    share > least && (!rare || share < 0.08)
}

/// At which samples a law with a threshold acts, on the true states.
fn activity(effect: &Effect, machine: &Machine, run: &Run, dt: f64) -> Vec<bool> {
    let family = machine.family;
    let p = &effect.p;
    let place = if effect.kind.on_input() { 0 } else { effect.at };
    let c = family.places()[place].c;
    let along = |x: &[Vec<f64>], k: usize| c[0] * x[0][k] + x.get(1).map_or(0.0, |x| c[1] * x[k]);
    (0..run.q[0].len())
        .map(|k| match effect.kind {
            Kind::EndStop => along(&run.q, k) > p[1],
            Kind::DeadZone => along(&run.q, k).abs() < p[0],
            Kind::InputSaturation => run.u[effect.at][k].abs() > p[0],
            Kind::InputDeadZone => run.u[effect.at][k].abs() < p[0],
            Kind::StribeckFriction => along(&run.v, k).abs() < 2.0 * p[2],
            Kind::StepDisturbance => k as f64 * dt > p[1],
            _ => false,
        })
        .collect()
}

/// Runs of `true` as times.
fn windows(flags: &[bool], dt: f64) -> Vec<[f64; 2]> {
    let mut out: Vec<[f64; 2]> = Vec::new();
    let mut open = None;
    for (k, &on) in flags.iter().chain([&false]).enumerate() {
        match (on, open) {
            (true, None) => open = Some(k),
            (false, Some(from)) => {
                out.push([from as f64 * dt, k as f64 * dt]);
                open = None;
            }
            _ => {}
        }
    }
    out
}

/// Rounded to so many digits.
fn significant(x: f64, digits: usize) -> f64 {
    format!("{x:.*e}", digits - 1).parse().unwrap_or(x)
}

fn truth(
    slot: &Slot,
    machine: &Machine,
    masks: &[Mask],
    measured: &[bool],
    sigma: &[f64],
    recordings: &[Recording],
    dt: f64,
    severities: &[f64],
) -> Truth {
    let family = machine.family;
    let training = &recordings[..recordings.len() - 1];
    let effects: Vec<TruthEffect> = machine
        .effects
        .iter()
        .zip(severities)
        .map(|(e, &severity)| TruthEffect {
            kind: e.kind.name(),
            family: e.kind.family(),
            equations: equations(e, family, measured),
            channel: e.kind.on_measurement().then(|| family.states()[e.at].0.to_owned()),
            drifting: (e.kind == Kind::ParameterDrift).then(|| family.parameters()[e.which].name.to_owned()),
            parameters: canonical(e),
            twins: twins(e, family, measured),
            windows: if e.kind.has_threshold() {
                training
                    .iter()
                    .map(|r| (r.name.clone(), windows(&activity(e, machine, &r.run, dt), dt)))
                    .collect()
            } else {
                Vec::new()
            },
            severity,
        })
        .collect();
    let class = match slot.left {
        Left::Nothing => "null",
        Left::Effect(k) if k.is_outside() => "outside",
        Left::Effect(_) => "effect",
    };
    let weakest = severities.iter().copied().fold(f64::INFINITY, f64::min);
    Truth {
        id: slot.id(),
        index: slot.index,
        system: family.name(),
        class,
        tier: Tier::of(weakest).filter(|_| !severities.is_empty()),
        masks: masks.to_vec(),
        effects,
        relatives: match slot.left {
            Left::Effect(k) if k.is_outside() => k.relatives(),
            _ => &[],
        },
        term: match slot.left {
            Left::Effect(k) if k.is_outside() => k.term(),
            _ => None,
        },
        drifting: family.drifting().iter().map(|&c| family.states()[c].0.to_owned()).collect(),
        noise: (0..measured.len())
            .filter(|&c| measured[c])
            .map(|c| (family.states()[c].0.to_owned(), sigma[c]))
            .collect(),
        parameters: family
            .parameters()
            .iter()
            .zip(&machine.p)
            .filter(|(_, p)| **p != 0.0)
            .map(|(named, &p)| (named.name.to_owned(), p))
            .collect(),
        training: training.iter().map(|r| r.name.clone()).collect(),
    }
}

/// The true parameters under their canonical names, with what a report adds to them.
fn canonical(e: &Effect) -> Vec<(&'static str, f64)> {
    if e.kind == Kind::UnmodeledResonance {
        // DESIGN §2.2: an extra mode reports its frequency and damping ratio.
        let f0 = (e.p[1] / e.p[0]).sqrt() / TAU;
        return vec![("f0", f0), ("zeta", e.p[2] / (2.0 * (e.p[1] * e.p[0]).sqrt())), ("ma", e.p[0])];
    }
    e.canonical()
}

/// Equations that are right to name for an effect; empty: any.
fn equations(e: &Effect, family: Family, measured: &[bool]) -> Vec<String> {
    let name = |i: usize| family.equation_names()[i].to_owned();
    // A constant force shifts what no one sees by the difference between the two places.
    let unseen = family == Family::DcMotor || measured.contains(&false);
    match e.kind {
        Kind::ConstantOffset | Kind::InputOffset if unseen => vec![name(0), name(1)],
        k if k.on_input() => vec![name(family.entered(e.at))],
        k if k.on_measurement() => Vec::new(),
        Kind::ParameterDrift => family
            .equation_names()
            .iter()
            .enumerate()
            .filter(|(i, _)| holds(family, *i, e.which))
            .map(|(i, _)| name(i))
            .collect(),
        Kind::Coupling => {
            let mut all = vec![name(e.at)];
            if e.which == 1 {
                all.push(name(1 - e.at));
            }
            all
        }
        _ => family.equations_of(e.at),
    }
}

/// Whether a parameter stands in an equation.
fn holds(family: Family, equation: usize, parameter: usize) -> bool {
    match family {
        Family::TwoMass => match parameter {
            0 | 1 | 6 => equation == 0,
            4 | 5 => equation == 1,
            _ => true,
        },
        Family::FlexibleLink => match parameter {
            0 | 1 | 5 => equation == 0,
            3 | 4 => equation == 1,
            _ => true,
        },
        Family::DcMotor => match parameter {
            0 | 1 => equation == 0,
            3 | 4 => equation == 1,
            _ => true,
        },
        Family::QuarterCar => match parameter {
            0 => equation == 0,
            3 | 4 => equation == 1,
            _ => true,
        },
        Family::Table => (parameter < 2 || parameter == 5) == (equation == 0),
        _ => equation == 0,
    }
}

/// Kinds that state exactly the same on this machine (DESIGN §2.1 and what follows from linearity).
fn twins(e: &Effect, family: Family, measured: &[bool]) -> Vec<&'static str> {
    let held = family == Family::Oscillator || (family == Family::Table && e.at == 1);
    let one_of_each = family.inputs() == 1 && measured.iter().filter(|m| **m).count() == 1;
    match e.kind {
        Kind::InputOffset if held => vec!["constant_offset", "sensor_offset"],
        Kind::InputOffset => vec!["constant_offset"],
        Kind::ConstantOffset if held => vec!["input_offset", "sensor_offset"],
        Kind::ConstantOffset if family.driven(e.at) => vec!["input_offset"],
        Kind::ConstantOffset if family == Family::QuarterCar && !measured[1] => {
            vec!["sensor_offset", "input_offset"]
        }
        Kind::ConstantOffset if family == Family::TwoMass && !measured[1] => vec!["input_offset"],
        // A force on the body presses both springs, which only an offset of both sensors could show.
        Kind::ConstantOffset => vec![],
        Kind::SensorOffset if held => vec!["constant_offset", "input_offset"],
        Kind::SensorOffset if family == Family::QuarterCar && !measured[1] => {
            vec!["constant_offset", "input_offset"]
        }
        // Linear springs: a force across the spring moves that coordinate alone.
        Kind::SensorOffset if matches!(family, Family::QuarterCar | Family::FlexibleLink) => {
            vec!["constant_offset"]
        }
        // Nothing else hears the one input, nothing else is seen.
        Kind::InputDelay if one_of_each || family == Family::Table => vec!["sensor_delay"],
        Kind::SensorDelay if one_of_each || family == Family::Table => vec!["input_delay"],
        _ => vec![],
    }
}

impl Case {
    /// The file that greybox is given.
    pub(crate) fn nominal_model(&self) -> String {
        self.model_with(|_| None)
    }

    /// The same equations with other values where `value` has one.
    pub(crate) fn model_with(&self, value: impl Fn(&str) -> Option<f64>) -> String {
        let named = self.machine.family.parameters().iter().zip(&self.nominal);
        let values: Vec<f64> = named.map(|(named, &p)| value(named.name).unwrap_or(p)).collect();
        text::model(
            &self.machine,
            &Writing {
                name: "Machine",
                values: &values,
                std: &self.std,
                measured: &self.measured,
                hold: self.hold,
                units: self.units,
                truth: false,
                pinned: false,
            },
        )
    }

    /// The true equations with the true parameters; `pinned` as in [`Writing`].
    pub(crate) fn true_model(&self, pinned: bool) -> String {
        text::model(
            &self.machine,
            &Writing {
                name: "Truth",
                values: &self.machine.p,
                std: &self.std,
                measured: &self.measured,
                hold: self.hold,
                units: false,
                truth: true,
                pinned,
            },
        )
    }

    /// The recording that only judges.
    pub(crate) fn held_out(&self) -> &Recording {
        &self.recordings[self.recordings.len() - 1]
    }

    /// A recording as CSV, its header with or without units.
    pub(crate) fn csv(&self, recording: &Recording, units: bool) -> String {
        use std::fmt::Write as _;
        let family = self.machine.family;
        let head = |(name, unit): &(&str, &str)| {
            if units { format!(",{name} [{unit}]") } else { format!(",{name}") }
        };
        let mut text = if units { "t [s]".to_owned() } else { "t".to_owned() };
        family.input_names().iter().for_each(|n| text.push_str(&head(n)));
        let seen: Vec<usize> = (0..self.measured.len()).filter(|&c| self.measured[c]).collect();
        seen.iter().for_each(|&c| text.push_str(&head(&family.states()[c])));
        text.push('\n');
        for k in 0..recording.shown[0].len() {
            let _ = write!(text, "{}", significant(k as f64 * self.dt, 12));
            recording.run.u.iter().for_each(|u| {
                let _ = write!(text, ",{}", u[k]);
            });
            for &c in &seen {
                let _ = write!(text, ",{}", recording.shown[c][k]);
            }
            text.push('\n');
        }
        text
    }
}

/// Every kind once, for tests.
#[cfg(test)]
pub(crate) fn every_kind() -> impl Iterator<Item = Kind> {
    greybox_plants::kind::LIBRARY.into_iter().chain(greybox_plants::kind::OUTSIDE)
}
