//! Output feedback: an observer between the sensors and the law.

use greybox_model::Expr;
use nalgebra::DMatrix;

use crate::compiled::Compiled;
use crate::controller::Controller;
use crate::design::{free_name, limited};
use crate::equilibrium::Equilibrium;
use crate::error::{ControlError, listed};
use crate::margins::{Margins, OpenLoop};
use crate::observer::{InputDelay, Memory, Observer, ObserverMethod, Prediction, Sensor, Tangent};
use crate::plant::Plant;
use crate::rest::{Integral, Rest, RestMemory};
use crate::stability;

/// Noise of a sensor of which nothing is stated, over the size of its state.
pub const UNSTATED_NOISE: f64 = 1e-3;

/// An observer to put between the sensors and the law.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputOptions {
    /// How the state is estimated.
    pub method: ObserverMethod,
    /// Sensors by the name of the measured state; those not named have noise of [`UNSTATED_NOISE`] of the state's size.
    pub sensors: Vec<(String, Sensor)>,
    /// The integral action of the law.
    pub integral: Integral,
}

/// The loop with the observer at a set point, friction dropped.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputCheck {
    /// The set point.
    pub set_point: f64,
    /// Largest magnitude of the poles in z of plant and observer together.
    pub spectral_radius: f64,
    /// Margins of the loop with the observer, cut at the command.
    pub margins: Margins,
}

/// A controller that is given what the sensors say. At each sample the observer takes the measurements y and the last
/// command, and the command is
///
/// ```text
/// u = κ(x̂, r) − d̂          within the limits
/// ```
///
/// with the law κ of the [`Controller`]. The estimated disturbance d̂ is its integral action: friction, loads and wrong
/// parameters leave no error where the loop comes to rest. The observer is given the command as it is after the limits,
/// so that nothing winds up. For a machine that sticks, integral action at rest ([`Rest`]) stands in its place; without
/// integral action d̂ stays out of the command.
///
/// Where the command acts late ([`PlantOptions::predict_input_delay`](crate::PlantOptions)), x̂ is predicted over the delay by the
/// commands that were given, and the law acts on the state that its command will meet (O. J. M. Smith, *Chem. Eng.
/// Prog.* 53, 1957; A. Z. Manitius and A. W. Olbrot, IEEE Trans. Autom. Control 24(4), 1979).
///
/// ```
/// use greybox_control::{
///     ClosedLoop, DesignOptions, Feedback, Integral, LoopOptions, Method, ObserverMethod, OutputFeedback, OutputOptions, Plant,
///     PlantOptions, Reference, Sensor, design,
/// };
/// # let model = greybox_model::Model::from_toml(r#"
/// # [inputs]
/// # tau = { unit = "N m" }
/// # [states]
/// # theta = { unit = "rad" }
/// # [parameters]
/// # J = { value = 0.02, unit = "kg m^2" }
/// # mgl = { value = 0.5, unit = "N m" }
/// # fc = { value = 0.02, unit = "N m" }
/// # [equations]
/// # arm = "J*theta'' + fc*sign(theta') + mgl*sin(theta) = tau"
/// # "#, "pendulum.toml")?;
/// let sizes = vec![("theta".to_string(), 0.3)];
/// let plant = Plant::of(&model, "tau", &PlantOptions { sizes, ..PlantOptions::default() })?;
/// let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[-0.5, 0.5], 1e-3))?;
/// // An encoder of 4096 counts a turn is all that is measured.
/// let encoder = Sensor { noise: 0.0, resolution: std::f64::consts::TAU / 4096.0 };
/// let observer = OutputFeedback::new(&law, &OutputOptions {
///     method: ObserverMethod::Kalman { disturbance: 1.0 },
///     sensors: vec![("theta".into(), encoder)],
///     integral: Integral::Disturbance,
/// })?;
/// let options = LoopOptions { feedback: Feedback::Output(Box::new(observer)), ..LoopOptions::default() };
/// let run = ClosedLoop::new(&model, &law, &options)?.run(&Reference::square(0.5, 5.0, 2))?;
/// assert!(run.metrics.iter().all(|m| m.final_error.abs() < encoder.resolution));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct OutputFeedback {
    pub(crate) observer: Observer,
    sensors: Vec<Sensor>,
    disturbance: String,
    law: Expr,
    compiled: Compiled,
    limits: (f64, f64),
    dead_zone: f64,
    method: ObserverMethod,
    integral: Integral,
    rest: Option<Rest>,
    checks: Vec<OutputCheck>,
}

/// What a controller with an observer remembers between two samples.
#[derive(Debug, Clone)]
pub struct OutputMemory {
    observer: Memory,
    rest: RestMemory,
    /// The last command.
    command: f64,
}

impl OutputMemory {
    /// x̂, in the plant's order.
    #[must_use]
    pub fn state(&self) -> &[f64] {
        &self.observer.estimate[..self.observer.estimate.len() - 1]
    }

    /// d̂, in units of the command.
    #[must_use]
    pub fn disturbance(&self) -> f64 {
        self.observer.estimate[self.observer.estimate.len() - 1]
    }

    /// o of the integral action at rest ([`Rest`]), in units of the command; zero with another one.
    #[must_use]
    pub fn offset(&self) -> f64 {
        self.rest.offset
    }
}

impl OutputFeedback {
    /// An observer for a controller, checked with it at each of its set points.
    ///
    /// # Errors
    /// [`ControlError::NothingMeasured`], [`ControlError::EsoUnmeasured`] and [`ControlError::EsoOrder`] for states that the
    /// observer does not reach, [`ControlError::Observer`] where the measured states do not determine the others,
    /// [`ControlError::Eso`], [`ControlError::Option`], [`ControlError::NotMeasured`], [`ControlError::LongDelay`],
    /// [`ControlError::UnstableOutput`].
    pub fn new(controller: &Controller, options: &OutputOptions) -> Result<OutputFeedback, ControlError> {
        let plant = controller.plant();
        let names = plant.state_names();
        let measured: Vec<usize> = (0..plant.order()).filter(|i| plant.measured()[*i]).collect();
        let mut sensors: Vec<Sensor> = measured
            .iter()
            .map(|&i| Sensor { noise: UNSTATED_NOISE * plant.sizes()[i], resolution: 0.0 })
            .collect();
        for (name, sensor) in &options.sensors {
            let at = measured.iter().position(|&i| names[i] == *name).ok_or_else(|| {
                ControlError::NotMeasured {
                    name: name.clone(),
                    known: listed(measured.iter().map(|&i| &names[i])),
                }
            })?;
            for (what, value) in [("noise", sensor.noise), ("resolution", sensor.resolution)] {
                if !(value >= 0.0 && value.is_finite()) {
                    let what = format!("the {what} of `{name}`");
                    return Err(ControlError::Option {
                        what,
                        value,
                        wanted: "a finite number, zero or more",
                    });
                }
            }
            if sensor.deviation() == 0.0 {
                let what = format!("the noise and the resolution of `{name}`");
                return Err(ControlError::Option {
                    what,
                    value: 0.0,
                    wanted: "above zero, at least one of them",
                });
            }
            sensors[at] = *sensor;
        }
        let point = controller.design_point();
        let observer = Observer::new(plant, point, controller.dt(), &options.method, &sensors)?;
        let disturbance = free_name(plant, "d", &[controller.reference()]);
        let (low, high) = controller.limits();
        let law = match options.integral {
            Integral::Off => controller.unlimited().clone(),
            Integral::Disturbance | Integral::AtRest { .. } => {
                controller.unlimited().clone() - Expr::var(&disturbance)
            }
        };
        let rest = match options.integral {
            Integral::AtRest { time } => Some(Rest::new(controller, time, &measured, &sensors)?),
            Integral::Off | Integral::Disturbance => None,
        };
        let law = limited(&law, plant, low, high);
        let mut variables = plant.symbols().to_vec();
        variables.push((disturbance.clone(), 0));
        variables.extend((0..3).map(|primes| (controller.reference().to_owned(), primes)));
        let compiled = Compiled::new(std::slice::from_ref(&law), &variables, plant.parameters())?;
        let mut feedback = OutputFeedback {
            observer,
            sensors,
            disturbance,
            law,
            compiled,
            limits: (low, high),
            dead_zone: plant.dead_zone(),
            method: options.method,
            integral: options.integral,
            rest,
            checks: Vec::new(),
        };
        for check in controller.checks() {
            let found = feedback.check(controller, check.set_point, &check.equilibrium)?;
            feedback.checks.push(found);
        }
        Ok(feedback)
    }

    /// The observer.
    #[must_use]
    pub fn observer(&self) -> &Observer {
        &self.observer
    }

    /// How it was designed.
    #[must_use]
    pub fn method(&self) -> &ObserverMethod {
        &self.method
    }

    /// The integral action.
    #[must_use]
    pub fn integral(&self) -> Integral {
        self.integral
    }

    /// The numbers of the integral action at rest.
    #[must_use]
    pub fn rest(&self) -> Option<&Rest> {
        self.rest.as_ref()
    }

    /// The sensors, in the order of [`Observer::measured`].
    #[must_use]
    pub fn sensors(&self) -> &[Sensor] {
        &self.sensors
    }

    /// The command, within the limits, as an expression of the states, the disturbance
    /// ([`disturbance`](Self::disturbance)), which is the offset of an integral action at rest, the set point and the
    /// plant's parameters.
    #[must_use]
    pub fn law(&self) -> &Expr {
        &self.law
    }

    /// The name of the disturbance in the law: `d`, unless the model has a name like that.
    #[must_use]
    pub fn disturbance(&self) -> &str {
        &self.disturbance
    }

    /// The loop at each set point of the controller.
    #[must_use]
    pub fn checks(&self) -> &[OutputCheck] {
        &self.checks
    }

    /// What there is to remember before the first sample.
    #[must_use]
    pub fn start(&self) -> OutputMemory {
        OutputMemory { observer: self.observer.start(), rest: Rest::start(0.0), command: 0.0 }
    }

    /// What there is to remember at a machine that rests at its measurements `y` (in the order of [`Observer::measured`]) under
    /// a held command ([`observer::Start`](crate::observer::Start)): the estimate is that state of rest, its disturbance is the integral's,
    /// and every command on its way is the held one. With the set point where the machine rests the first command is the held one:
    /// the law of that place is u_e = u + d̂, and d̂ is taken off. Without integral action it is u + d̂. Friction that
    /// holds the machine is a disturbance.
    ///
    /// ```
    /// # use greybox_control::{
    /// #     DesignOptions, Integral, Method, ObserverMethod, OutputFeedback, OutputOptions, Plant, PlantOptions, design,
    /// # };
    /// # let model = greybox_model::Model::from_toml(r#"
    /// # [inputs]
    /// # tau = { unit = "N m" }
    /// # [states]
    /// # theta = { unit = "rad" }
    /// # [parameters]
    /// # J = { value = 0.02, unit = "kg m^2" }
    /// # k = { value = 0.5, unit = "N m/rad" }
    /// # [equations]
    /// # arm = "J*theta'' + k*theta = tau"
    /// # "#, "arm.toml")?;
    /// let plant = Plant::of(&model, "tau", &PlantOptions::default())?;
    /// let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[-0.5, 0.5], 1e-3))?;
    /// let output = OutputFeedback::new(&law, &OutputOptions {
    ///     method: ObserverMethod::Kalman { disturbance: 1.0 },
    ///     sensors: Vec::new(),
    ///     integral: Integral::Disturbance,
    /// })?;
    /// // Held at 0.4 rad by 0.3 N m, where the model says that 0.2 would do.
    /// let mut memory = output.start_at(&[0.4], 0.3)?;
    /// assert!((memory.state()[0] - 0.4).abs() < 1e-12 && (memory.disturbance() + 0.1).abs() < 1e-12);
    /// assert!((output.command(&mut memory, &[0.4], 0.4) - 0.3).abs() < 1e-9);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`ControlError::Size`], [`ControlError::NoStart`] where no state of rest is found: [`start`](Self::start) is there for it.
    pub fn start_at(&self, y: &[f64], command: f64) -> Result<OutputMemory, ControlError> {
        let wanted = self.observer.measured().len();
        if y.len() != wanted {
            return Err(ControlError::Size { what: "the measurements", found: y.len(), wanted });
        }
        let observer = self
            .observer
            .start_at(y, self.behind_dead_zone(command))
            .ok_or_else(|| ControlError::NoStart { measured: y.to_vec(), command })?;
        let offset = if self.rest.is_some() { observer.estimate[self.observer.order()] } else { 0.0 };
        Ok(OutputMemory { observer, rest: Rest::start(offset), command })
    }

    /// What a command does.
    fn behind_dead_zone(&self, u: f64) -> f64 {
        u - u.clamp(-self.dead_zone, self.dead_zone)
    }

    /// The command at a sample, from its measurements (in the order of [`Observer::measured`]) and the set point. A
    /// measurement that is not a number is left out of the estimate. Not a number where the law is none there: the
    /// caller must then do what is safe.
    pub fn command(&self, memory: &mut OutputMemory, y: &[f64], r: f64) -> f64 {
        self.command_along(memory, y, &[r, 0.0, 0.0])
    }

    /// The same for a reference r that moves, with r′ and r″ ([`Controller::command_along`]); where the command acts late, those of
    /// the time at which it acts.
    pub fn command_along(&self, memory: &mut OutputMemory, y: &[f64], reference: &[f64; 3]) -> f64 {
        let u = memory.command;
        let behind = if u.is_finite() { self.behind_dead_zone(u) } else { 0.0 };
        self.observer.update(&mut memory.observer, y, behind);
        let estimate = self.observer.ahead(&memory.observer);
        let (x, d) = estimate.split_at(self.observer.order());
        memory.command = match &self.rest {
            Some(rest) => {
                let law = |x: &[f64], offset: f64| self.law_at(x, offset, reference);
                rest.command(&mut memory.rest, (x, y, reference[0]), law)
            }
            None => self.law_at(x, d[0], reference),
        };
        memory.command
    }

    /// The law, within the limits; not a number where it is none.
    fn law_at(&self, x: &[f64], disturbance: f64, reference: &[f64; 3]) -> f64 {
        let mut at = x.to_vec();
        at.push(disturbance);
        at.extend(reference);
        let mut u = [f64::NAN];
        if at.iter().all(|v| v.is_finite()) {
            self.compiled.eval(&at, 0, &mut u);
        }
        // The comparisons of a limit would make a number of what is none.
        if u[0].is_nan() { f64::NAN } else { u[0].max(self.limits.0).min(self.limits.1) }
    }

    fn check(
        &self,
        controller: &Controller,
        set_point: f64,
        at: &Equilibrium,
    ) -> Result<OutputCheck, ControlError> {
        let open = self.open_loop(controller, controller.plant(), set_point, at)?;
        let spectral_radius =
            open.radius(&vec![1.0; open.a.nrows()]).ok_or(ControlError::NoPoles { set_point })?;
        if spectral_radius.is_nan() || spectral_radius >= 1.0 {
            let dt = controller.dt();
            return Err(ControlError::UnstableOutput { set_point, dt, radius: spectral_radius });
        }
        Ok(OutputCheck { set_point, spectral_radius, margins: open.margins(controller.dt(), 0.0) })
    }

    /// Margins of law and observer, as they are, on another plant ([`Plant::with_parameters`]), in the order of the
    /// controller's checks: linearised where its own plant rests, friction dropped, with the delay that the other
    /// plant has. [`Margins::NONE`] where that loop is unstable, or the delay too long to compute; none where a number is
    /// not finite, or the plant has other states.
    #[must_use]
    pub fn margins_with(&self, controller: &Controller, plant: &Plant) -> Vec<Option<Margins>> {
        self.margins_late(controller, plant, 0.0)
    }

    /// The same with a further delay of the loop, s, that neither law nor observer knows of ([`LoopOptions`]'s `delay`).
    ///
    /// [`LoopOptions`]: crate::LoopOptions
    #[must_use]
    pub fn margins_late(&self, controller: &Controller, plant: &Plant, late: f64) -> Vec<Option<Margins>> {
        let of = |check: &crate::check::Check| {
            if plant.symbols() != controller.plant().symbols() {
                return None;
            }
            match self.open_loop(controller, plant, check.set_point, &check.equilibrium) {
                Ok(open) => open.margins_if_stable(&vec![1.0; open.a.nrows()], controller.dt(), late),
                Err(ControlError::LongDelay { .. }) => Some(Margins::NONE),
                Err(_) => None,
            }
        };
        controller.checks().iter().map(of).collect()
    }

    /// u = c z of z = (x̂ and d̂ as the observer remembers them, the last commands that the law gave).
    fn law_of_memory(
        &self,
        gain: &DMatrix<f64>,
        observer: &Tangent,
        ahead: &Prediction,
    ) -> (DMatrix<f64>, Vec<f64>) {
        let n = gain.ncols();
        // An integral action at rest is none in motion.
        let taken_off = f64::from(u8::from(self.integral == Integral::Disturbance));
        let state = gain * &ahead.state;
        let disturbance = (gain * &ahead.disturbance)[0] - taken_off;
        let of_estimate = DMatrix::from_fn(1, n + 1, |_, j| if j < n { state[j] } else { disturbance });
        (of_estimate * &observer.estimate, ahead.commands.iter().map(|c| (gain * c)[0]).collect())
    }

    /// A plant, the observer and the law as one linear system at a state of rest. Its state is x, the commands that the
    /// plant was given and that still act or will, the observer's memory, and the commands as the law gave them, as many
    /// as the observer remembers.
    fn open_loop(
        &self,
        controller: &Controller,
        truth: &Plant,
        set_point: f64,
        at: &Equilibrium,
    ) -> Result<OpenLoop, ControlError> {
        let plant = controller.plant();
        let tangent = plant.frictionless_tangent(&at.state, at.input);
        let true_tangent = truth.frictionless_tangent(&at.state, at.input);
        let delay = InputDelay::new(truth.input_delay(), controller.dt())?;
        let held = stability::held(&true_tangent, controller.dt(), plant.sizes(), plant.input_size())
            .ok_or(ControlError::NoPoles { set_point })?;
        let observer = self.observer.tangent(at, set_point)?;
        let [older, newer] = self.observer.inputs(&true_tangent, delay.remainder, set_point)?;
        let ahead = self.observer.prediction(&tangent, set_point)?;
        let gain =
            DMatrix::from_row_slice(1, plant.order(), &controller.frictionless_gain(&at.state, set_point));
        let (of_memory, of_commands) = self.law_of_memory(&gain, &observer, &ahead);

        let (n, size) = (plant.order(), observer.carry.nrows());
        let (acting, past) = (delay.samples + 1, self.observer.input_delay().samples + 1);
        let (given, own, made) = (n, n + acting, n + acting + size);
        let all = made + past;
        let mut c = DMatrix::zeros(1, all);
        c.view_mut((0, own), (1, size)).copy_from(&of_memory);
        for (j, of_command) in of_commands.iter().enumerate() {
            c[(0, made + j)] = *of_command;
        }
        let (mut a, mut b) = (DMatrix::zeros(all, all), DMatrix::zeros(all, 1));
        let mut add = |row: usize, column: usize, part: &DMatrix<f64>| {
            let mut view = a.view_mut((row, column), part.shape());
            view += part;
        };
        add(0, 0, &held.a);
        add(0, given + acting - 1, &older);
        add(own, own, &observer.carry);
        add(own, made + past - 1, &observer.older);
        // The newer command of a sample is the one that is just made, unless it is late by a sample or more.
        if acting == 1 {
            b.view_mut((0, 0), (n, 1)).copy_from(&newer);
        } else {
            add(0, given + acting - 2, &newer);
        }
        if past == 1 {
            add(own, 0, &(&observer.newer * &c));
        } else {
            add(own, made + past - 2, &observer.newer);
        }
        b[(given, 0)] = 1.0;
        add(made, 0, &c);
        for j in 1..acting {
            a[(given + j, given + j - 1)] = 1.0;
        }
        for j in 1..past {
            a[(made + j, made + j - 1)] = 1.0;
        }
        // What is measured is the next state.
        let measures = &observer.measured * self.observer.selection(n);
        let (next_a, next_b) = (&measures * a.rows(0, n), &measures * b.rows(0, n));
        let mut view = a.view_mut((own, 0), (size, all));
        view += next_a;
        let mut view = b.view_mut((own, 0), (size, 1));
        view += next_b;
        Ok(OpenLoop { a, b, c })
    }
}

impl Controller {
    /// ∂u/∂x at a state of rest, friction dropped.
    pub(crate) fn frictionless_gain(&self, x: &[f64], r: f64) -> Vec<f64> {
        let mut at = x.to_vec();
        at.extend([r, 0.0, 0.0]);
        self.frictionless.jacobian(&at).row(0).iter().take(x.len()).copied().collect()
    }

    /// Margins of the loop with the full state fed back, at each set point; none where a number is not finite.
    #[must_use]
    pub fn margins(&self) -> Vec<Option<Margins>> {
        self.margins_with(&self.plant)
    }

    /// The same of the law, as it is, on another plant ([`Plant::with_parameters`]), linearised where its own plant rests,
    /// friction dropped. [`Margins::NONE`] where that loop is unstable; none also where the plant has other states.
    ///
    /// ```
    /// use greybox_control::{DesignOptions, Method, Plant, PlantOptions, design};
    /// # let model = greybox_model::Model::from_toml(r#"
    /// # [inputs]
    /// # u = { unit = "V" }
    /// # [states]
    /// # theta = { unit = "rad" }
    /// # [parameters]
    /// # J = { value = 0.02, unit = "kg m^2" }
    /// # kt = { value = 0.4, unit = "N m/V" }
    /// # [equations]
    /// # arm = "J*theta'' = kt*u"
    /// # "#, "arm.toml")?;
    /// let plant = Plant::of(&model, "u", &PlantOptions::default())?;
    /// let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[0.0], 0.01))?;
    /// // A motor that is half as strong again takes that much off the gain that may be added.
    /// let stronger = plant.with_parameters(&[0.02, 0.6])?;
    /// let (own, on_it) = (law.margins()[0].ok_or("none")?, law.margins_with(&stronger)[0].ok_or("none")?);
    /// assert!((own.gain / on_it.gain - 1.5).abs() < 1e-9);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[must_use]
    pub fn margins_with(&self, plant: &Plant) -> Vec<Option<Margins>> {
        self.margins_late(plant, 0.0)
    }

    /// The same with a further delay of the loop, s, that the law does not know of.
    #[must_use]
    pub fn margins_late(&self, plant: &Plant, late: f64) -> Vec<Option<Margins>> {
        let of = |check: &crate::check::Check| {
            // A law of the state alone is none where the command is late.
            if plant.input_delay() > 0.0 || plant.symbols() != self.plant.symbols() {
                return None;
            }
            let at = &check.equilibrium;
            let tangent = plant.frictionless_tangent(&at.state, at.input);
            let held = stability::held(&tangent, self.dt(), self.plant.sizes(), self.plant.input_size())?;
            let gain = self.frictionless_gain(&at.state, check.set_point);
            let c = DMatrix::from_row_slice(1, plant.order(), &gain);
            OpenLoop { a: held.a, b: held.b, c }.margins_if_stable(self.plant.sizes(), self.dt(), late)
        };
        self.checks().iter().map(of).collect()
    }
}
