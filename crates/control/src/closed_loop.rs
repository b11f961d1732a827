//! The model and its controller, simulated together.

use greybox_model::{Hold, Model, System};
use greybox_simulate::{Carry, Environment, Method as Integration, Seeds, Signal, Simulation};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use crate::controller::Controller;
use crate::error::{ControlError, listed};
use crate::metrics::Tracking;
use crate::output::OutputFeedback;
use crate::run::metrics;
pub use crate::run::{MOST_SAMPLES, Reference, Run};

/// A state this many times its size, start or set point has run away.
const FAR: f64 = 1e9;
/// What the rounding of forces leaves of a state, over its size: a smaller error of the integration means nothing.
const ROUNDED: f64 = 64.0 * f64::EPSILON;

/// What the law is given of the state.
#[derive(Debug, Clone, Default)]
pub enum Feedback {
    /// All of it.
    #[default]
    FullState,
    /// Measured states, and rates by differences of the last two samples.
    Differences,
    /// What an observer makes of the measured states; their sensors have noise and resolution.
    Output(Box<OutputFeedback>),
}

/// How a closed loop is simulated.
#[derive(Debug, Clone)]
pub struct LoopOptions {
    /// Start, a value for each entry of the model's state vector; zeros where there is none.
    pub start: Option<Vec<f64>>,
    /// What the law is given.
    pub feedback: Feedback,
    /// The command that holds the machine at its start: an observer begins there at its first measurements
    /// ([`OutputFeedback::start_at`]); where there is none, at zero ([`OutputFeedback::start`]).
    pub held: Option<f64>,
    /// The law is given the state of so long ago, s: sensors, network and computing together. Between two samples it is
    /// on the line through them.
    pub delay: f64,
    /// Of the sensors' noise: the same seed gives the same noise, in every member of a family.
    pub seed: u64,
    /// Integration between two commands.
    pub integration: Integration,
}

impl Default for LoopOptions {
    fn default() -> Self {
        let integration = Integration::Adaptive { rtol: 1e-7, atol: 1e-10 };
        Self { start: None, feedback: Feedback::FullState, held: None, delay: 0.0, seed: 0, integration }
    }
}

/// A model, compiled, under a controller: friction sticks truly ([`greybox_simulate`]), the command is held over the
/// sample time of the law and stays within its limits.
///
/// The model may be fuller than the one that the law was made for: it needs the law's states and input, and may have
/// further states, delays, disturbances.
///
/// ```
/// use greybox_control::{ClosedLoop, DesignOptions, LoopOptions, Method, Plant, PlantOptions, Reference, design};
/// # let model = greybox_model::Model::from_toml(r#"
/// # [inputs]
/// # tau = { unit = "N m" }
/// # [states]
/// # theta = { unit = "rad" }
/// # [parameters]
/// # J = { value = 0.02, unit = "kg m^2" }
/// # mgl = { value = 0.5, unit = "N m" }
/// # [equations]
/// # arm = "J*theta'' + mgl*sin(theta) = tau"
/// # "#, "pendulum.toml")?;
/// let plant = Plant::of(&model, "tau", &PlantOptions::default())?;
/// let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[-0.5, 0.5], 1e-3))?;
/// let run = ClosedLoop::new(&model, &law, &LoopOptions::default())?.run(&Reference::square(0.5, 10.0, 2))?;
/// assert!(run.metrics.iter().all(|m| m.final_error.abs() < 1e-3 && m.settling.is_some()));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct ClosedLoop<'a> {
    controller: &'a Controller,
    pub(crate) system: System,
    pub(crate) names: Vec<String>,
    pub(crate) parameters: Vec<f64>,
    states: Vec<String>,
    start: Vec<f64>,
    /// Magnitudes of the states of which rounding is the absolute tolerance; zero where no size is stated.
    magnitudes: Vec<f64>,
    /// Where the law's states stand in the model's state vector.
    places: Vec<usize>,
    /// For each of the law's states by differences: the state that it is the rate of.
    rates: Vec<Option<usize>>,
    input: usize,
    held: Vec<f64>,
    integration: Integration,
    delays: bool,
    pub(crate) output: Option<OutputFeedback>,
    held_command: Option<f64>,
    pub(crate) delay: f64,
    seed: u64,
}

impl<'a> ClosedLoop<'a> {
    /// A model under a controller.
    ///
    /// # Errors
    /// [`ControlError::Compile`], [`ControlError::Foreign`] for a model that lacks what the law needs,
    /// [`ControlError::Unmeasured`], [`ControlError::Size`].
    pub fn new(
        model: &Model,
        controller: &'a Controller,
        options: &LoopOptions,
    ) -> Result<ClosedLoop<'a>, ControlError> {
        if !(options.delay >= 0.0 && options.delay.is_finite()) {
            let what = "the delay of the loop".to_owned();
            return Err(ControlError::Option {
                what,
                value: options.delay,
                wanted: "a finite time, zero or more",
            });
        }
        let system = System::compile(model)?;
        let plant = controller.plant();
        let mut states = Vec::with_capacity(system.nx);
        for state in &model.states {
            states.extend((0..state.order).map(|p| format!("{}{}", state.name, "'".repeat(p))));
        }
        let start = options.start.clone().unwrap_or_else(|| vec![0.0; system.nx]);
        if start.len() != system.nx {
            return Err(ControlError::Size { what: "the start", found: start.len(), wanted: system.nx });
        }
        if !start.iter().all(|x| x.is_finite()) {
            return Err(ControlError::NotFinite { state: start });
        }
        let names = plant.state_names();
        let foreign = |name: &str| ControlError::Foreign { name: name.to_owned() };
        let places: Vec<usize> = names
            .iter()
            .map(|name| states.iter().position(|s| s == name).ok_or_else(|| foreign(name)))
            .collect::<Result<_, _>>()?;
        let input = model.input(plant.input_name()).ok_or_else(|| foreign(plant.input_name()))?;
        let constant = |name: &str| plant.held().iter().find(|(n, _)| n == name).map_or(0.0, |(_, v)| *v);
        let held = model.inputs.iter().map(|i| constant(&i.name)).collect();
        let mut rates = vec![None; names.len()];
        if matches!(options.feedback, Feedback::Differences) {
            for (i, (name, primes)) in plant.symbols().iter().enumerate() {
                if plant.measured()[i] {
                    continue;
                }
                let below = primes.checked_sub(1).and_then(|p| {
                    plant
                        .symbols()
                        .iter()
                        .position(|(n, q)| n == name && *q == p)
                        .filter(|k| plant.measured()[*k])
                });
                rates[i] = Some(below.ok_or_else(|| ControlError::Unmeasured { name: names[i].clone() })?);
            }
        }
        let delays = !system.rhs.delays.is_empty();
        let mut magnitudes = vec![0.0; system.nx];
        if let Integration::Adaptive { atol, .. } = options.integration {
            for (&place, size) in places.iter().zip(plant.sizes()) {
                magnitudes[place] = ROUNDED * size / atol.max(ROUNDED);
            }
        }
        Ok(ClosedLoop {
            controller,
            parameters: model.parameters.iter().map(|p| p.value).collect(),
            names: model.parameters.iter().map(|p| p.name.clone()).collect(),
            system,
            states,
            start,
            magnitudes,
            places,
            rates,
            input,
            held,
            integration: options.integration,
            delays,
            output: match &options.feedback {
                Feedback::Output(output) => Some(OutputFeedback::clone(output)),
                _ => None,
            },
            held_command: options.held,
            delay: options.delay,
            seed: options.seed,
        })
    }

    /// The controller.
    #[must_use]
    pub fn controller(&self) -> &Controller {
        self.controller
    }

    /// A run with the model's own parameters.
    ///
    /// # Errors
    /// [`ControlError::Option`] for a reference that is none, [`ControlError::NoStart`].
    pub fn run(&self, reference: &Reference) -> Result<Run, ControlError> {
        self.run_with(&self.parameters, reference)
    }

    /// A run with other values (SI) of the model's parameters, in the model's order.
    ///
    /// # Errors
    /// [`ControlError::Option`] for a reference that is none, [`ControlError::Size`], [`ControlError::NoStart`].
    pub fn run_with(&self, parameters: &[f64], reference: &Reference) -> Result<Run, ControlError> {
        if parameters.len() != self.system.np {
            let (found, wanted) = (parameters.len(), self.system.np);
            return Err(ControlError::Size { what: "the list of parameters", found, wanted });
        }
        let dt = self.controller.dt();
        let samples = reference.check(dt)?;
        let mut run = Run {
            t: Vec::with_capacity(samples + 1),
            r: Vec::with_capacity(samples + 1),
            given: [const { Vec::new() }; 3],
            u: Vec::with_capacity(samples + 1),
            x: vec![Vec::with_capacity(samples + 1); self.system.nx],
            y: vec![Vec::new(); self.output.as_ref().map_or(0, |o| o.observer().measured().len())],
            states: self.states.clone(),
            tracked: self.places[self.controller.tracked()],
            diverged: None,
            metrics: Vec::new(),
            tracking: None,
        };
        let largest = reference.largest();
        let ahead = self.preview(reference);
        let sizes = self.controller.plant().sizes();
        let far: Vec<f64> = self
            .places
            .iter()
            .zip(sizes)
            .map(|(&p, s)| FAR * s.max(self.start[p].abs()).max(largest))
            .collect();
        let mut x = self.start.clone();
        let mut carry: Option<Carry> = None;
        let mut memory = self.output.as_ref().map(OutputFeedback::start);
        let mut random = Pcg64Mcg::seed_from_u64(self.seed);
        let mut known: Vec<f64> = self.places.iter().map(|&p| x[p]).collect();
        for k in 0..=samples {
            let t = k as f64 * dt;
            let given = reference.at(t + ahead);
            run.given.iter_mut().zip(given).for_each(|(series, r)| series.push(r));
            let before = known.clone();
            for (series, x) in run.x.iter_mut().zip(&x) {
                series.push(*x);
            }
            for (i, &place) in self.places.iter().enumerate() {
                known[i] = self.sensed(&run.x[place], k);
            }
            for i in 0..known.len() {
                // At the start there is no sample before: nothing moves yet.
                if let Some(below) = self.rates[i] {
                    known[i] = if k == 0 { 0.0 } else { (known[below] - before[below]) / dt };
                }
            }
            let u = match (&self.output, &mut memory) {
                (Some(output), Some(memory)) => {
                    let sensors = output.observer().measured().iter().zip(output.sensors());
                    let y: Vec<f64> = sensors.map(|(&i, s)| s.read(known[i], &mut random)).collect();
                    run.y.iter_mut().zip(&y).for_each(|(series, y)| series.push(*y));
                    if let (0, Some(held)) = (k, self.held_command) {
                        *memory = output.start_at(&y, held)?;
                    }
                    output.command_along(memory, &y, &given)
                }
                _ => self.controller.command_along(&known, &given),
            };
            run.t.push(t);
            run.r.push(reference.at(t)[0]);
            run.u.push(u);
            let away = self.places.iter().zip(&far).any(|(&p, far)| x[p].abs() > *far);
            if away || !u.is_finite() {
                run.diverged = Some(k);
                break;
            }
            if k == samples {
                break;
            }
            match self.advance(parameters, &run.u, &x, carry.take()) {
                Some((next, after)) => (x, carry) = (next, after),
                None => {
                    run.diverged = Some(k);
                    break;
                }
            }
        }
        run.metrics = metrics(&run, reference, dt, self.controller.limits());
        if matches!(reference, Reference::Trajectory(_)) && run.diverged.is_none() {
            let y = &run.x[run.tracked];
            run.tracking = Tracking::of(y, &run.r, &run.u[..samples], dt, self.controller.limits());
        }
        Ok(run)
    }

    /// How far ahead of the time the law is given the reference, s: a command that acts late is made for when it acts. A
    /// set point is not known before it is given.
    fn preview(&self, reference: &Reference) -> f64 {
        match reference {
            Reference::SetPoints { .. } => 0.0,
            Reference::Trajectory(_) => self.controller.plant().input_delay(),
        }
    }

    /// A state as the law is given it at sample `k`, the last of `series`.
    fn sensed(&self, series: &[f64], k: usize) -> f64 {
        if self.delay == 0.0 {
            return series[k];
        }
        let back = self.delay / self.controller.dt();
        if back >= k as f64 {
            return series[0];
        }
        let at = k as f64 - back;
        let (low, w) = (at.floor() as usize, at.fract());
        series[low] + w * (series[(low + 1).min(k)] - series[low])
    }

    /// The state one sample later under the last of the commands `u`; none where it left every bound.
    fn advance(
        &self,
        parameters: &[f64],
        u: &[f64],
        x: &[f64],
        carry: Option<Carry>,
    ) -> Option<(Vec<f64>, Option<Carry>)> {
        let dt = self.controller.dt();
        let k = u.len() - 1;
        // Only a delay looks back.
        let first = if self.delays { 0 } else { k };
        let signal = |i: usize| {
            let mut samples =
                if i == self.input { u[first..].to_vec() } else { vec![self.held[i]; u.len() - first] };
            samples.push(samples[samples.len() - 1]);
            Signal::new(Hold::Zero, dt, &samples, <[f64]>::to_vec)
        };
        let environment = Environment {
            start: first as f64 * dt,
            dt,
            len: k - first + 2,
            inputs: (0..self.system.nu).map(signal).collect(),
            forces: Vec::new(),
        };
        let simulation = Simulation {
            system: &self.system,
            environment: &environment,
            parameters,
            method: self.integration,
            seeds: &Seeds::default(),
        };
        let at = k - first;
        let every: Vec<usize> = (0..self.system.nx).collect();
        // A sample on its own remembers nothing but what is rounding.
        let (before, carried) = match carry.filter(|_| self.delays) {
            Some(carry) => (carry, every.as_slice()),
            None => (Carry::remembered(&self.system, at, dt, &[]).reaching(&self.magnitudes), [].as_slice()),
        };
        // Both ends are recorded: only so does a divergence between them show.
        let (trajectory, after) = simulation.run_on(x, at..at + 2, Some(&before), carried);
        let next: Vec<f64> = trajectory.x.chunks(2).filter_map(|ends| ends.get(1).copied()).collect();
        let lost =
            trajectory.diverged.is_some() || next.len() != x.len() || !next.iter().all(|x| x.is_finite());
        (!lost).then_some((next, self.delays.then_some(after)))
    }

    /// Index of a parameter.
    pub(crate) fn parameter(&self, name: &str) -> Result<usize, ControlError> {
        let unknown = || ControlError::UnknownParameter { name: name.to_owned(), known: listed(&self.names) };
        self.names.iter().position(|n| n == name).ok_or_else(unknown)
    }
}
