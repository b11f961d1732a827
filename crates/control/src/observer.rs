//! State and disturbance from the measured states.

use greybox_eso::{Design, EsoError, Fal, Observer as Chain, Scheme};
use greybox_hjb::{Linear, dare};
use nalgebra::{DMatrix, DVector};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

use crate::equilibrium::Equilibrium;
use crate::error::{ControlError, listed};
use crate::plant::Plant;
use crate::stability;

/// The longest step of the prediction, in units of the fastest time constant of the plant.
const LONGEST: f64 = 0.5;
/// Most steps of the prediction between two samples.
const MOST_SUBSTEPS: usize = 64;
/// Most samples by which a command may be late.
const MOST_LATE: usize = 40;
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
    late: Lateness,
}

/// How late the command acts: whole samples, and a part of one, s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lateness {
    /// Whole samples.
    pub samples: usize,
    /// What is left, below one sample, s.
    pub part: f64,
}

impl Lateness {
    fn new(delay: f64, dt: f64) -> Result<Lateness, ControlError> {
        let all = delay / dt;
        let whole = (all + WHOLE).floor();
        let late = Lateness {
            samples: whole as usize,
            part: if all - whole < WHOLE { 0.0 } else { delay - whole * dt },
        };
        let samples = late.samples + usize::from(late.part > 0.0);
        if samples > MOST_LATE {
            return Err(ControlError::LongDelay { samples, most: MOST_LATE });
        }
        Ok(late)
    }

    /// Whether the command acts at once.
    #[must_use]
    pub fn is_none(&self) -> bool {
        self.samples == 0 && self.part == 0.0
    }
}

#[derive(Debug, Clone)]
enum Kind {
    Kalman {
        /// L, (states and d) × measured.
        gain: DMatrix<f64>,
    },
    Eso(Vec<Coordinate>),
}

/// A measured coordinate with its chain of derivatives.
#[derive(Debug, Clone)]
struct Coordinate {
    /// Index of the first of its states; the others follow.
    first: usize,
    /// Number of its states.
    order: usize,
    /// Gain of the command in the highest derivative, at the design point.
    input: f64,
    chain: AnyChain,
}

/// Observers of the orders that occur.
#[derive(Debug, Clone)]
enum AnyChain {
    Two(Chain<2>),
    Three(Chain<3>),
    Four(Chain<4>),
}

impl AnyChain {
    fn new(order: usize, bandwidth: f64, dt: f64, input: f64) -> Result<Option<AnyChain>, EsoError> {
        fn chain<const N: usize>(bandwidth: f64, dt: f64, input: f64) -> Result<Chain<N>, EsoError> {
            let design = Design::from_bandwidth(bandwidth, [Fal::LINEAR; N])?;
            Chain::new(design, dt, Scheme::Trapezoidal)?.with_extended_state(input)
        }
        Ok(match order {
            1 => Some(AnyChain::Two(chain(bandwidth, dt, input)?)),
            2 => Some(AnyChain::Three(chain(bandwidth, dt, input)?)),
            3 => Some(AnyChain::Four(chain(bandwidth, dt, input)?)),
            _ => None,
        })
    }

    fn update(&mut self, y: f64, u: f64) -> Vec<f64> {
        match self {
            AnyChain::Two(chain) => chain.update(y, u).to_vec(),
            AnyChain::Three(chain) => chain.update(y, u).to_vec(),
            AnyChain::Four(chain) => chain.update(y, u).to_vec(),
        }
    }

    fn start_at(&mut self, z: &[f64], y: f64) {
        fn start<const N: usize>(chain: &mut Chain<N>, z: &[f64], y: f64) {
            chain.start_at(std::array::from_fn(|i| z.get(i).copied().unwrap_or(0.0)), y);
        }
        match self {
            AnyChain::Two(chain) => start(chain, z, y),
            AnyChain::Three(chain) => start(chain, z, y),
            AnyChain::Four(chain) => start(chain, z, y),
        }
    }
}

/// One step of an extended-state observer in matrices, (z⁺ = A z + b₀ y + b₁ y⁺ + g u).
#[derive(Debug, Clone, PartialEq)]
pub struct EsoStep {
    /// Index of the coordinate's first state.
    pub first: usize,
    /// A, row by row; its size is the coordinate's order and one.
    pub a: Vec<Vec<f64>>,
    /// b₀, of the measurement of the last sample.
    pub before: Vec<f64>,
    /// b₁, of the measurement now.
    pub now: Vec<f64>,
    /// g, of the command since the last sample.
    pub input: Vec<f64>,
    /// b, the command's gain in the coordinate's highest derivative.
    pub gain: f64,
    /// Weight of this coordinate in d̂: one over the square of the size of its last state.
    pub weight: f64,
}

/// An observer in numbers, for code that runs it elsewhere.
#[derive(Debug, Clone, PartialEq)]
pub enum Form {
    /// L, (states and d) × measured.
    Kalman {
        /// L, row by row.
        gain: Vec<Vec<f64>>,
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

/// An observer's tangent: c⁺ = M c + Γ₁ u₁ + Γ₀ u₀ + N y⁺, with x̂ and d̂ = E c. Over a sample first u₁ acts, then u₀.
pub(crate) struct Tangent {
    pub(crate) carry: DMatrix<f64>,
    pub(crate) older: DMatrix<f64>,
    pub(crate) newer: DMatrix<f64>,
    pub(crate) measured: DMatrix<f64>,
    pub(crate) estimate: DMatrix<f64>,
}

impl Observer {
    /// The observer of a plant sampled every `dt` s, designed at `at`; `sensors` are those of the measured states, in
    /// the order of the plant's.
    pub(crate) fn new(
        plant: &Plant,
        at: &Equilibrium,
        dt: f64,
        method: &ObserverMethod,
        sensors: &[Sensor],
    ) -> Result<Observer, ControlError> {
        let measured: Vec<usize> = (0..plant.order()).filter(|i| plant.measured()[*i]).collect();
        if measured.is_empty() {
            return Err(ControlError::NothingMeasured { known: listed(plant.state_names()) });
        }
        let late = Lateness::new(plant.input_delay(), dt)?;
        let tangent = plant.frictionless_tangent(&at.state, at.input);
        let fastest = stability::poles(&tangent.a, plant.sizes())
            .ok_or(ControlError::NoPoles { set_point: 0.0 })?
            .iter()
            .fold(0.0f64, |fastest, p| fastest.max(p.magnitude()));
        let substeps = ((fastest * dt / LONGEST).ceil() as usize).clamp(1, MOST_SUBSTEPS);
        let kind = match *method {
            ObserverMethod::Kalman { disturbance } => kalman(plant, at, dt, disturbance, &measured, sensors)?,
            ObserverMethod::Eso { bandwidth } => Kind::Eso(chains(plant, at, dt, bandwidth, &measured)?),
        };
        Ok(Observer { plant: plant.clone(), dt, measured, kind, substeps, late })
    }

    /// Indices of the measured states.
    #[must_use]
    pub fn measured(&self) -> &[usize] {
        &self.measured
    }

    /// Steps of a prediction over one sample.
    #[must_use]
    pub fn substeps(&self) -> usize {
        self.substeps
    }

    /// How late the command acts.
    #[must_use]
    pub fn late(&self) -> Lateness {
        self.late
    }

    /// The observer in numbers.
    #[must_use]
    pub fn form(&self) -> Form {
        match &self.kind {
            Kind::Kalman { gain } => {
                Form::Kalman { gain: gain.row_iter().map(|row| row.iter().copied().collect()).collect() }
            }
            Kind::Eso(coordinates) => Form::Eso(coordinates.iter().map(|c| c.step(&self.plant)).collect()),
        }
    }

    pub(crate) fn start(&self) -> Memory {
        let chains = match &self.kind {
            Kind::Kalman { .. } => Vec::new(),
            Kind::Eso(coordinates) => coordinates.iter().map(|c| c.chain.clone()).collect(),
        };
        let past = vec![0.0; self.late.samples + 2];
        Memory { estimate: vec![0.0; self.plant.order() + 1], chains, past, started: false }
    }

    /// The estimate at a sample from its measurements `y` and the last command `u` (behind the dead zone). The first sample finds the machine at rest. A measurement that is not a number is left out.
    pub(crate) fn update(&self, memory: &mut Memory, y: &[f64], u: f64) {
        memory.past.rotate_right(1);
        memory.past[0] = u;
        if !memory.started {
            for (&i, y) in self.measured.iter().zip(y) {
                memory.estimate[i] = if y.is_finite() { *y } else { 0.0 };
            }
        }
        match &self.kind {
            Kind::Kalman { gain } => {
                if memory.started {
                    let Lateness { samples, part } = self.late;
                    self.predict(&mut memory.estimate, memory.past[samples + 1], part);
                    self.predict(&mut memory.estimate, memory.past[samples], self.dt - part);
                    let innovation = |(&i, y): (&usize, &f64)| match y.is_finite() {
                        true => y - memory.estimate[i],
                        false => 0.0,
                    };
                    let innovations: Vec<f64> = self.measured.iter().zip(y).map(innovation).collect();
                    let correction = gain * DVector::from_vec(innovations);
                    memory.estimate.iter_mut().zip(correction.iter()).for_each(|(x, c)| *x += c);
                }
            }
            Kind::Eso(coordinates) => {
                let Lateness { samples, part } = self.late;
                let share = part / self.dt;
                let acted = share * memory.past[samples + 1] + (1.0 - share) * memory.past[samples];
                self.follow(memory, coordinates, y, acted);
            }
        }
        memory.started = true;
    }

    /// x̂ and d̂ when the next command will act: over the delay by the commands that were given.
    pub(crate) fn ahead(&self, memory: &Memory) -> Vec<f64> {
        let Lateness { samples, part } = self.late;
        let mut estimate = memory.estimate.clone();
        self.predict(&mut estimate, memory.past[samples], part);
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

    /// x̂ from the chains, and d̂ by least squares over what f does not explain of their lumped disturbances.
    fn follow(&self, memory: &mut Memory, coordinates: &[Coordinate], y: &[f64], u: f64) {
        let n = self.plant.order();
        let mut lumped = Vec::with_capacity(coordinates.len());
        for (coordinate, chain) in coordinates.iter().zip(&mut memory.chains) {
            let at = self.measured.iter().position(|i| *i == coordinate.first);
            let y = at.and_then(|at| y.get(at)).copied().unwrap_or(f64::NAN);
            let z = chain.update(y, u);
            memory.estimate[coordinate.first..][..coordinate.order].copy_from_slice(&z[..coordinate.order]);
            lumped.push(z[coordinate.order] + coordinate.input * u);
        }
        let x = &memory.estimate[..n];
        let rest = self.plant.frictionless_rate(x, u);
        let mut g = vec![0.0; n];
        self.plant.frictionless_input(x, &mut g);
        let (mut above, mut below) = (0.0, 0.0);
        for (coordinate, lumped) in coordinates.iter().zip(lumped) {
            let row = coordinate.first + coordinate.order - 1;
            let weight = g[row] / (self.plant.sizes()[row] * self.plant.sizes()[row]);
            above += weight * (lumped - rest[row]);
            below += weight * g[row];
        }
        memory.estimate[n] = if below > 0.0 { above / below } else { 0.0 };
    }

    /// The tangent at a state of rest.
    pub(crate) fn tangent(&self, at: &Equilibrium, set_point: f64) -> Result<Tangent, ControlError> {
        let (n, m) = (self.plant.order(), self.measured.len());
        let plant = self.plant.frictionless_tangent(&at.state, at.input);
        match &self.kind {
            Kind::Kalman { gain } => {
                let held = self.held(&plant, self.dt, set_point)?;
                let all = extended(&held.a, &held.b);
                let [older, newer] = self.inputs(&plant, set_point)?;
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
            Kind::Eso(coordinates) => {
                // c: the chains one after the other, the last measurements, the last command.
                let steps: Vec<EsoStep> = coordinates.iter().map(|c| c.step(&self.plant)).collect();
                let chains: usize = steps.iter().map(|s| s.a.len()).sum();
                let size = chains + m + 1;
                let mut tangent = Tangent {
                    carry: DMatrix::zeros(size, size),
                    older: DMatrix::zeros(size, 1),
                    newer: DMatrix::zeros(size, 1),
                    measured: DMatrix::zeros(size, m),
                    estimate: DMatrix::zeros(n + 1, size),
                };
                let below: f64 = coordinates.iter().map(|c| c.weight(&self.plant, &plant.b)).sum();
                let share_older = self.late.part / self.dt;
                let mut first = 0;
                for (coordinate, step) in coordinates.iter().zip(&steps) {
                    let at = self.measured.iter().position(|i| *i == step.first).unwrap_or(0);
                    let order = coordinate.order;
                    for i in 0..=order {
                        for j in 0..=order {
                            tangent.carry[(first + i, first + j)] = step.a[i][j];
                        }
                        tangent.carry[(first + i, chains + at)] = step.before[i];
                        tangent.measured[(first + i, at)] = step.now[i];
                        tangent.older[(first + i, 0)] = share_older * step.input[i];
                        tangent.newer[(first + i, 0)] = (1.0 - share_older) * step.input[i];
                    }
                    for i in 0..order {
                        tangent.estimate[(step.first + i, first + i)] = 1.0;
                    }
                    let row = step.first + order - 1;
                    let share = coordinate.weight(&self.plant, &plant.b) / (plant.b[row] * below);
                    if below > 0.0 && plant.b[row] != 0.0 {
                        tangent.estimate[(n, first + order)] += share;
                        tangent.estimate[(n, size - 1)] += share * (coordinate.input - plant.b[row]);
                    }
                    first += order + 1;
                }
                // What f explains, once the states stand in their rows.
                for coordinate in coordinates {
                    let row = coordinate.first + coordinate.order - 1;
                    if below > 0.0 && plant.b[row] != 0.0 {
                        let share = coordinate.weight(&self.plant, &plant.b) / (plant.b[row] * below);
                        for c in 0..size {
                            let explained: f64 =
                                (0..n).map(|j| plant.a[(row, j)] * tangent.estimate[(j, c)]).sum();
                            tangent.estimate[(n, c)] -= share * explained;
                        }
                    }
                }
                for i in 0..m {
                    tangent.measured[(chains + i, i)] = 1.0;
                }
                tangent.older[(size - 1, 0)] = share_older;
                tangent.newer[(size - 1, 0)] = 1.0 - share_older;
                Ok(tangent)
            }
        }
    }

    /// Φ and Γ of a time with the command held.
    fn held(&self, plant: &Linear, time: f64, set_point: f64) -> Result<Linear, ControlError> {
        stability::held(plant, time, self.plant.sizes(), self.plant.input_size())
            .ok_or(ControlError::NoPoles { set_point })
    }

    /// What the commands do that act over one sample, first the older one, then the newer: Γ₁, Γ₀.
    pub(crate) fn inputs(&self, plant: &Linear, set_point: f64) -> Result<[DMatrix<f64>; 2], ControlError> {
        let first = self.held(plant, self.late.part, set_point)?;
        let rest = self.held(plant, self.dt - self.late.part, set_point)?;
        Ok([&rest.a * first.b, rest.b])
    }

    /// x̂ over the delay: what the estimate, d̂ and the last commands do, the latest first.
    pub(crate) fn prediction(
        &self,
        plant: &Linear,
        set_point: f64,
    ) -> Result<(DMatrix<f64>, DMatrix<f64>, Vec<DMatrix<f64>>), ControlError> {
        let whole = self.held(plant, self.dt, set_point)?;
        let part = self.held(plant, self.late.part, set_point)?;
        let mut power = DMatrix::identity(self.plant.order(), self.plant.order());
        let mut commands = Vec::with_capacity(self.late.samples + 1);
        for _ in 0..self.late.samples {
            commands.push(&power * &whole.b);
            power = &power * &whole.a;
        }
        commands.push(&power * part.b);
        let disturbance = commands.iter().fold(DMatrix::zeros(self.plant.order(), 1), |sum, c| sum + c);
        Ok((power * part.a, disturbance, commands))
    }

    /// C: which of `columns` states are measured.
    pub(crate) fn selection(&self, columns: usize) -> DMatrix<f64> {
        let entry = |i: usize, j: usize| f64::from(u8::from(self.measured[i] == j));
        DMatrix::from_fn(self.measured.len(), columns, entry)
    }
}

impl Coordinate {
    /// (g / size)².
    fn weight(&self, plant: &Plant, g: &DMatrix<f64>) -> f64 {
        let row = self.first + self.order - 1;
        (g[row] / plant.sizes()[row]).powi(2)
    }

    /// The matrices of a step, by unit answers of the observer, which is linear.
    fn step(&self, plant: &Plant) -> EsoStep {
        let n = self.order + 1;
        let answer = |z: &[f64], before: f64, now: f64, u: f64| {
            let mut chain = self.chain.clone();
            chain.start_at(z, before);
            chain.update(now, u)
        };
        let unit = |j: usize| -> Vec<f64> { (0..n).map(|i| f64::from(u8::from(i == j))).collect() };
        let zero = vec![0.0; n];
        let columns: Vec<Vec<f64>> = (0..n).map(|j| answer(&unit(j), 0.0, 0.0, 0.0)).collect();
        EsoStep {
            first: self.first,
            a: (0..n).map(|i| columns.iter().map(|c| c[i]).collect()).collect(),
            before: answer(&zero, 1.0, 0.0, 0.0),
            now: answer(&zero, 0.0, 1.0, 0.0),
            input: answer(&zero, 0.0, 0.0, 1.0),
            gain: self.input,
            weight: plant.sizes()[self.first + self.order - 1].powi(-2),
        }
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
    at: &Equilibrium,
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
    let n = plant.order();
    let tangent = plant.frictionless_tangent(&at.state, at.input);
    let held = stability::held(&tangent, dt, plant.sizes(), plant.input_size())
        .ok_or(ControlError::NoPoles { set_point: 0.0 })?;
    let all = extended(&held.a, &held.b);
    // In units of the sizes and of the sensors' noise.
    let size = |i: usize| plant.sizes().get(i).copied().unwrap_or_else(|| plant.input_size());
    let deviations: Vec<f64> = sensors.iter().map(Sensor::deviation).collect();
    let transposed = DMatrix::from_fn(n + 1, n + 1, |i, j| all[(j, i)] * size(i) / size(j));
    let read =
        DMatrix::from_fn(
            n + 1,
            measured.len(),
            |i, k| {
                if measured[k] == i { size(i) / deviations[k] } else { 0.0 }
            },
        );
    let mut walk = DMatrix::zeros(n + 1, n + 1);
    walk[(n, n)] = (disturbance / plant.input_size()).powi(2) * dt;
    let unit = DMatrix::identity(measured.len(), measured.len());
    let predicted = dare(&transposed, &read, &walk, &unit, None)
        .map_err(|source| ControlError::Observer { source })?
        .solution;
    let innovation = read.transpose() * &predicted * &read + unit;
    let weights = innovation
        .cholesky()
        .ok_or(ControlError::NoPoles { set_point: 0.0 })?
        .solve(&(read.transpose() * &predicted));
    let gain = DMatrix::from_fn(n + 1, measured.len(), |i, k| weights[(k, i)] * size(i) / deviations[k]);
    Ok(Kind::Kalman { gain })
}

/// A chain for each measured coordinate; together they must have every state.
fn chains(
    plant: &Plant,
    at: &Equilibrium,
    dt: f64,
    bandwidth: f64,
    measured: &[usize],
) -> Result<Vec<Coordinate>, ControlError> {
    let symbols = plant.symbols();
    let tangent = plant.frictionless_tangent(&at.state, at.input);
    let mut coordinates = Vec::new();
    for (first, (name, primes)) in symbols.iter().enumerate() {
        if *primes > 0 {
            continue;
        }
        let order = symbols.iter().filter(|(n, _)| n == name).count();
        let is_chain = symbols[first..]
            .iter()
            .take(order)
            .enumerate()
            .all(|(k, (n, p))| n == name && usize::from(*p) == k);
        if !(measured.contains(&first) && is_chain) {
            return Err(ControlError::Unmeasured { name: name.clone() });
        }
        let input = tangent.b[first + order - 1];
        let chain = AnyChain::new(order, bandwidth, dt, input)
            .map_err(|source| ControlError::Eso { source })?
            .ok_or_else(|| ControlError::EsoOrder { name: name.clone(), order })?;
        coordinates.push(Coordinate { first, order, input, chain });
    }
    Ok(coordinates)
}
