//! State and disturbance from the measured states.

mod chains;
mod start;
mod tangent;

use greybox_hjb::{Linear, dare};
use nalgebra::{DMatrix, DVector};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

pub use self::chains::EsoStep;
use self::chains::{AnyChain, Chains};
pub use self::start::Start;
pub(crate) use self::tangent::{Prediction, Tangent};
use crate::check::Check;
use crate::equilibrium::Equilibrium;
use crate::error::{ControlError, listed};
use crate::plant::Plant;
use crate::stability;

/// The longest step of the prediction, in units of the fastest time constant of the plant.
const LONGEST: f64 = 0.5;
/// Most steps of the prediction between two samples.
const MOST_SUBSTEPS: usize = 64;
/// Longest delay of the command, samples.
const MOST_DELAYED: usize = 40;
/// A share of a sample that is rounding.
const WHOLE: f64 = 1e-9;

/// How the state is estimated. Both observers also estimate the disturbance d of ẋ = f(x) + g(x) (u + d): friction,
/// loads and wrong parameters, as seen from the command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ObserverMethod {
    /// The steady-state Kalman filter of the plant, its friction dropped and d a random walk:
    ///
    /// ```text
    /// x̂⁻ = x̂ + ∫ f(x̂) + g(x̂) (u + d̂) dt,    (x̂, d̂) = (x̂⁻, d̂) + L (y − C x̂⁻)
    /// ```
    ///
    /// L is that of the tangent at the design point (B. D. O. Anderson and J. B. Moore, *Optimal Filtering*, 1979,
    /// chapter 4).
    Kalman {
        /// Standard deviation of the change of d in one second, in units of the command.
        disturbance: f64,
    },
    /// An extended-state observer for each measured coordinate ([`greybox_eso`]): linear, all poles at −`bandwidth`.
    /// It knows of the plant only the gain of the command; all else is its lumped disturbance, of which d is what f
    /// does not explain (J. Han, IEEE Trans. Ind. Electron. 56(3), 2009; Z. Gao, American Control Conference 2003).
    Eso {
        /// ω, 1/s.
        bandwidth: f64,
    },
}

/// What a sensor does to a state.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sensor {
    /// Standard deviation of its noise, SI; white.
    pub noise: f64,
    /// Step of its values, SI: one count of an encoder; zero for none.
    pub resolution: f64,
}

impl Sensor {
    /// Standard deviation of noise and rounding, q²/12, together.
    #[must_use]
    pub fn deviation(&self) -> f64 {
        (self.noise * self.noise + self.resolution * self.resolution / 12.0).sqrt()
    }

    /// What it says of a value.
    pub(crate) fn read(&self, value: f64, random: &mut Pcg64Mcg) -> f64 {
        let normal: f64 = if self.noise > 0.0 { StandardNormal.sample(random) } else { 0.0 };
        let noisy = value + self.noise * normal;
        if self.resolution > 0.0 { (noisy / self.resolution).round() * self.resolution } else { noisy }
    }
}

/// An observer of a plant.
#[derive(Debug, Clone)]
pub struct Observer {
    plant: Plant,
    dt: f64,
    measured: Vec<usize>,
    kind: Kind,
    /// Runge–Kutta steps of a prediction over one sample.
    substeps: usize,
    input_delay: InputDelay,
}

/// The delay of the command in samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InputDelay {
    /// Whole samples.
    pub samples: usize,
    /// What is left, less than one sample, s.
    pub remainder: f64,
}

impl InputDelay {
    pub(crate) fn new(delay: f64, dt: f64) -> Result<InputDelay, ControlError> {
        let all = delay / dt;
        let whole = (all + WHOLE).floor();
        let remainder = if all - whole < WHOLE { 0.0 } else { delay - whole * dt };
        let found = InputDelay { samples: whole as usize, remainder };
        let samples = found.samples + usize::from(remainder > 0.0);
        if samples > MOST_DELAYED {
            return Err(ControlError::LongDelay { samples, most: MOST_DELAYED });
        }
        Ok(found)
    }
}

#[derive(Debug, Clone)]
enum Kind {
    Kalman {
        /// L, (states and d) × measured.
        gain: DMatrix<f64>,
        start: Start,
    },
    Eso(Chains),
}

/// An observer in numbers, for code that runs it elsewhere.
#[derive(Debug, Clone, PartialEq)]
pub enum Form {
    /// L, (states and d) × measured.
    Kalman {
        /// L, row by row.
        gain: Vec<Vec<f64>>,
        /// Where it starts at a machine at rest.
        start: Start,
    },
    /// The chains.
    Eso(Vec<EsoStep>),
}

/// What an observer remembers.
#[derive(Debug, Clone)]
pub struct Memory {
    /// x̂ and d̂.
    pub(crate) estimate: Vec<f64>,
    chains: Vec<AnyChain>,
    /// The last commands, the latest first, as many as still act or will.
    past: Vec<f64>,
    started: bool,
}

impl Observer {
    /// The observer of a plant sampled every `dt` s, designed at the equilibrium of `point`; `sensors` are those of the
    /// measured states, in the order of the plant's.
    pub(crate) fn new(
        plant: &Plant,
        point: &Check,
        dt: f64,
        method: &ObserverMethod,
        sensors: &[Sensor],
    ) -> Result<Observer, ControlError> {
        let measured: Vec<usize> = (0..plant.order()).filter(|i| plant.measured()[*i]).collect();
        if measured.is_empty() {
            return Err(ControlError::NothingMeasured { known: listed(plant.state_names()) });
        }
        let input_delay = InputDelay::new(plant.input_delay(), dt)?;
        let at = &point.equilibrium;
        let tangent = plant.frictionless_tangent(&at.state, at.input);
        let fastest = stability::poles(&tangent.a, plant.sizes())
            .ok_or(ControlError::NoPoles { set_point: point.set_point })?
            .iter()
            .fold(0.0f64, |fastest, p| fastest.max(p.magnitude()));
        let substeps = ((fastest * dt / LONGEST).ceil() as usize).clamp(1, MOST_SUBSTEPS);
        let kind = match *method {
            ObserverMethod::Kalman { disturbance } => {
                kalman(plant, point, dt, disturbance, &measured, sensors)?
            }
            ObserverMethod::Eso { bandwidth } => {
                Kind::Eso(Chains::design(plant, at, dt, bandwidth, &measured)?)
            }
        };
        Ok(Observer { plant: plant.clone(), dt, measured, kind, substeps, input_delay })
    }

    /// Indices of the measured states.
    #[must_use]
    pub fn measured(&self) -> &[usize] {
        &self.measured
    }

    pub(crate) fn order(&self) -> usize {
        self.plant.order()
    }

    /// Steps of a prediction over one sample.
    #[must_use]
    pub fn substeps(&self) -> usize {
        self.substeps
    }

    /// The delay of the command.
    #[must_use]
    pub fn input_delay(&self) -> InputDelay {
        self.input_delay
    }

    /// The observer in numbers.
    #[must_use]
    pub fn form(&self) -> Form {
        match &self.kind {
            Kind::Kalman { gain, start } => Form::Kalman {
                gain: gain.row_iter().map(|row| row.iter().copied().collect()).collect(),
                start: start.clone(),
            },
            Kind::Eso(chains) => Form::Eso(chains.steps(&self.plant)),
        }
    }

    pub(crate) fn start(&self) -> Memory {
        let chains = match &self.kind {
            Kind::Kalman { .. } => Vec::new(),
            Kind::Eso(chains) => chains.start(),
        };
        let past = vec![0.0; self.input_delay.samples + 2];
        Memory { estimate: vec![0.0; self.plant.order() + 1], chains, past, started: false }
    }

    /// What is remembered at a machine that rests at the measurements `y` under the command `u` (behind the dead zone): the next
    /// sample with the same measurements and the same command leaves it as it is. None where no state of rest is found.
    pub(crate) fn start_at(&self, y: &[f64], u: f64) -> Option<Memory> {
        if y.len() != self.measured.len() || !y.iter().chain([&u]).all(|v| v.is_finite()) {
            return None;
        }
        let mut memory = self.start();
        memory.past.fill(u);
        memory.started = true;
        match &self.kind {
            Kind::Kalman { start, .. } => memory.estimate = start.at(&self.plant, &self.measured, y, u)?,
            Kind::Eso(chains) => {
                let memory = (memory.estimate.as_mut_slice(), memory.chains.as_mut_slice());
                chains.rest(&self.plant, &self.measured, memory, y, u);
            }
        }
        memory.estimate.iter().all(|v| v.is_finite()).then_some(memory)
    }

    /// The estimate at a sample from its measurements `y` and the last command `u` (behind the dead zone). The first
    /// sample finds the machine at rest. A measurement that is not a number is left out.
    pub(crate) fn update(&self, memory: &mut Memory, y: &[f64], u: f64) {
        memory.past.rotate_right(1);
        memory.past[0] = u;
        if !memory.started {
            for (&i, y) in self.measured.iter().zip(y) {
                memory.estimate[i] = if y.is_finite() { *y } else { 0.0 };
            }
        }
        match &self.kind {
            Kind::Kalman { gain, .. } => {
                if memory.started {
                    let InputDelay { samples, remainder } = self.input_delay;
                    self.predict(&mut memory.estimate, memory.past[samples + 1], remainder);
                    self.predict(&mut memory.estimate, memory.past[samples], self.dt - remainder);
                    let innovation = |(&i, y): (&usize, &f64)| match y.is_finite() {
                        true => y - memory.estimate[i],
                        false => 0.0,
                    };
                    let innovations: Vec<f64> = self.measured.iter().zip(y).map(innovation).collect();
                    let correction = gain * DVector::from_vec(innovations);
                    memory.estimate.iter_mut().zip(correction.iter()).for_each(|(x, c)| *x += c);
                }
            }
            Kind::Eso(chains) => {
                let InputDelay { samples, remainder } = self.input_delay;
                let share = remainder / self.dt;
                let acted = share * memory.past[samples + 1] + (1.0 - share) * memory.past[samples];
                let memory = (memory.estimate.as_mut_slice(), memory.chains.as_mut_slice());
                chains.follow(&self.plant, &self.measured, memory, y, acted);
            }
        }
        memory.started = true;
    }

    /// x̂ and d̂ when the next command will act: over the delay by the commands that were given.
    pub(crate) fn ahead(&self, memory: &Memory) -> Vec<f64> {
        let InputDelay { samples, remainder } = self.input_delay;
        let mut estimate = memory.estimate.clone();
        self.predict(&mut estimate, memory.past[samples], remainder);
        for k in (0..samples).rev() {
            self.predict(&mut estimate, memory.past[k], self.dt);
        }
        estimate
    }

    /// The steps of a prediction over a time.
    #[must_use]
    pub fn steps(&self, time: f64) -> usize {
        ((time / self.dt * self.substeps as f64 - WHOLE).ceil() as usize).max(1)
    }

    /// x̂ a time later under a command, by the classical Runge–Kutta method.
    fn predict(&self, estimate: &mut [f64], u: f64, time: f64) {
        if time == 0.0 {
            return;
        }
        let n = self.plant.order();
        let substeps = self.steps(time);
        let h = time / substeps as f64;
        let input = u + estimate[n];
        let along =
            |x: &[f64], k: &[f64], h: f64| -> Vec<f64> { x.iter().zip(k).map(|(x, k)| x + h * k).collect() };
        for _ in 0..substeps {
            let x = estimate[..n].to_vec();
            let k1 = self.plant.frictionless_rate(&x, input);
            let k2 = self.plant.frictionless_rate(&along(&x, &k1, 0.5 * h), input);
            let k3 = self.plant.frictionless_rate(&along(&x, &k2, 0.5 * h), input);
            let k4 = self.plant.frictionless_rate(&along(&x, &k3, h), input);
            for i in 0..n {
                estimate[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
            }
        }
    }

    /// The tangent at a state of rest.
    pub(crate) fn tangent(&self, at: &Equilibrium, set_point: f64) -> Result<Tangent, ControlError> {
        let n = self.plant.order();
        let plant = self.plant.frictionless_tangent(&at.state, at.input);
        match &self.kind {
            Kind::Kalman { gain, .. } => {
                let held = self.held(&plant, self.dt, set_point)?;
                let all = extended(&held.a, &held.b);
                let [older, newer] = self.inputs(&plant, self.input_delay.remainder, set_point)?;
                let below = |b: DMatrix<f64>| b.insert_row(n, 0.0);
                let left = DMatrix::identity(n + 1, n + 1) - gain * self.selection(n + 1);
                Ok(Tangent {
                    carry: &left * all,
                    older: &left * below(older),
                    newer: left * below(newer),
                    measured: gain.clone(),
                    estimate: DMatrix::identity(n + 1, n + 1),
                })
            }
            Kind::Eso(chains) => {
                Ok(chains.tangent(&self.plant, &plant, &self.measured, self.input_delay.remainder / self.dt))
            }
        }
    }

    /// Φ and Γ of a time with the command held.
    fn held(&self, plant: &Linear, time: f64, set_point: f64) -> Result<Linear, ControlError> {
        stability::held(plant, time, self.plant.sizes(), self.plant.input_size())
            .ok_or(ControlError::NoPoles { set_point })
    }

    /// What the commands do that act over one sample, `remainder` late beside whole samples, first the older one, then
    /// the newer: Γ₁, Γ₀.
    pub(crate) fn inputs(
        &self,
        plant: &Linear,
        remainder: f64,
        set_point: f64,
    ) -> Result<[DMatrix<f64>; 2], ControlError> {
        let first = self.held(plant, remainder, set_point)?;
        let rest = self.held(plant, self.dt - remainder, set_point)?;
        Ok([&rest.a * first.b, rest.b])
    }

    /// x̂ over the delay: what the estimate, d̂ and the last commands do, the latest first.
    pub(crate) fn prediction(&self, plant: &Linear, set_point: f64) -> Result<Prediction, ControlError> {
        let whole = self.held(plant, self.dt, set_point)?;
        let part = self.held(plant, self.input_delay.remainder, set_point)?;
        let mut power = DMatrix::identity(self.plant.order(), self.plant.order());
        let mut commands = Vec::with_capacity(self.input_delay.samples + 1);
        for _ in 0..self.input_delay.samples {
            commands.push(&power * &whole.b);
            power = &power * &whole.a;
        }
        commands.push(&power * part.b);
        let disturbance = commands.iter().fold(DMatrix::zeros(self.plant.order(), 1), |sum, c| sum + c);
        Ok(Prediction { state: power * part.a, disturbance, commands })
    }

    /// C: which of `columns` states are measured.
    pub(crate) fn selection(&self, columns: usize) -> DMatrix<f64> {
        let entry = |i: usize, j: usize| f64::from(u8::from(self.measured[i] == j));
        DMatrix::from_fn(self.measured.len(), columns, entry)
    }
}

/// (x, d): x⁺ = Φ x + Γ d, d⁺ = d.
fn extended(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    let n = a.nrows();
    DMatrix::from_fn(n + 1, n + 1, |i, j| match (i == n, j == n) {
        (false, false) => a[(i, j)],
        (false, true) => b[i],
        (true, false) => 0.0,
        (true, true) => 1.0,
    })
}

fn kalman(
    plant: &Plant,
    point: &Check,
    dt: f64,
    disturbance: f64,
    measured: &[usize],
    sensors: &[Sensor],
) -> Result<Kind, ControlError> {
    if !(disturbance > 0.0 && disturbance.is_finite()) {
        return Err(ControlError::Option {
            what: "the disturbance of the observer".into(),
            value: disturbance,
            wanted: "a positive finite number",
        });
    }
    let (n, at) = (plant.order(), &point.equilibrium);
    let none = || ControlError::NoPoles { set_point: point.set_point };
    let tangent = plant.frictionless_tangent(&at.state, at.input);
    let held = stability::held(&tangent, dt, plant.sizes(), plant.input_size()).ok_or_else(none)?;
    let all = extended(&held.a, &held.b);
    // In units of the sizes and of the sensors' noise.
    let size = |i: usize| plant.sizes().get(i).copied().unwrap_or_else(|| plant.input_size());
    let deviations: Vec<f64> = sensors.iter().map(Sensor::deviation).collect();
    let transposed = DMatrix::from_fn(n + 1, n + 1, |i, j| all[(j, i)] * size(i) / size(j));
    let seen = |i: usize, k: usize| if measured[k] == i { size(i) / deviations[k] } else { 0.0 };
    let read = DMatrix::from_fn(n + 1, measured.len(), seen);
    let mut walk = DMatrix::zeros(n + 1, n + 1);
    walk[(n, n)] = (disturbance / plant.input_size()).powi(2) * dt;
    let unit = DMatrix::identity(measured.len(), measured.len());
    let predicted = dare(&transposed, &read, &walk, &unit, None)
        .map_err(|source| ControlError::Observer { source })?
        .solution;
    let innovation = read.transpose() * &predicted * &read + unit;
    let weights = innovation.cholesky().ok_or_else(none)?.solve(&(read.transpose() * &predicted));
    let gain = DMatrix::from_fn(n + 1, measured.len(), |i, k| weights[(k, i)] * size(i) / deviations[k]);
    let start = Start::design(plant, point, measured, &deviations).ok_or_else(none)?;
    Ok(Kind::Kalman { gain, start })
}
