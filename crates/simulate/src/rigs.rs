//! Virtual rigs: the plants of G. Leylaz's thesis (University of California, Merced, 2021), and a throttle that wears, written
//! out in Rust.
//!
//! A rig makes recordings whose physics is known. It is written without the model language and without this
//! crate's integrator, so that nothing which later explains a recording can share an error with what made it.
//! A rig has no random numbers: noise enters through what the caller feeds in.
//!
//! ```
//! use greybox_simulate::rigs::{ProportionalController, RotaryFlexibleLink, Sampling, square_wave};
//!
//! let rig = RotaryFlexibleLink::IDENTIFIED;
//! let controller = ProportionalController::THESIS;
//! let sampling = Sampling { dt: 0.002, substeps: 4 };
//! let run = rig.run(sampling, [0.0; 4], 1000, |k, [theta, _alpha]| {
//!     let reference = square_wave(30_f64.to_radians(), 0.66, k as f64 * sampling.dt);
//!     controller.command(reference, theta, 0.0)
//! })?;
//! assert!(run.states.iter().all(|[theta, ..]| theta.abs() < 30_f64.to_radians()));
//! # Ok::<(), greybox_simulate::rigs::RigError>(())
//! ```
mod delayed;
mod throttle;

pub use delayed::{DelayedDuffing, JointRun, RotaryFlexibleJoint};
pub use throttle::Throttle;

use std::f64::consts::{PI, TAU};

/// Why a rig stopped.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RigError {
    /// The sampling interval is not a positive finite number, or there are no substeps.
    #[error(
        "the rig cannot step with dt = {dt} s in {substeps} substeps: give a positive dt and at least one substep"
    )]
    Sampling {
        /// Sampling interval, s.
        dt: f64,
        /// Integration steps per sample.
        substeps: usize,
    },
    /// The plant left the range its coefficients were identified in, where they mean nothing (or overflowed).
    #[error(
        "the {coordinate} of the rig reached {value} at t = {time} s, outside ±{limit}: excite it less or lower the gain"
    )]
    OutOfRange {
        /// Name of the coordinate.
        coordinate: &'static str,
        /// Time of the sample that ends the step, s.
        time: f64,
        /// Value reached there (not finite when the integration overflowed).
        value: f64,
        /// Largest magnitude allowed.
        limit: f64,
    },
    /// The delay of a feedback is negative, not finite, or shorter than an integration step.
    #[error("a delay of {delay} s cannot be stepped over in {step} s: give zero, or at least one substep")]
    Delay {
        /// Delay, s.
        delay: f64,
        /// Integration step, s.
        step: f64,
    },
    /// The command of the caller is not a finite number.
    #[error("the command at t = {time} s is {value}: a rig needs a finite one")]
    Command {
        /// Time of the sample, s.
        time: f64,
        /// The command.
        value: f64,
    },
}

/// How a rig is stepped: samples every `dt` seconds, each made of `substeps` Runge–Kutta steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sampling {
    /// Sampling interval, s; the command is held over it.
    pub dt: f64,
    /// Fourth-order Runge–Kutta steps per sample.
    pub substeps: usize,
}

impl Sampling {
    fn substep(self) -> Result<f64, RigError> {
        if self.dt > 0.0 && self.dt.is_finite() && self.substeps > 0 {
            Ok(self.dt / self.substeps as f64)
        } else {
            Err(RigError::Sampling { dt: self.dt, substeps: self.substeps })
        }
    }
}

/// One equation of the rotary flexible link as a balance of voltages (thesis Eq 2.24 and 2.25):
///
/// ```text
/// a q″ + b₁ θ̇ + b₃ θ̇³ + c₁ θ + c₂ θ² + c₃ θ³ + d α̇ + e₁ α + e₂ α² + f sign(θ̇) = V
/// ```
///
/// with q = θ in the first and q = α in the second. Every coefficient is in volts per SI unit of its term.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoltageBalance {
    /// a: of θ″ in the first equation, of α″ in the second, V s²/rad.
    pub acceleration: f64,
    /// b₁, V s/rad.
    pub rate: f64,
    /// b₃, V s³/rad³.
    pub rate_cubed: f64,
    /// c₁, V/rad.
    pub angle: f64,
    /// c₂, V/rad².
    pub angle_squared: f64,
    /// c₃, V/rad³.
    pub angle_cubed: f64,
    /// d, V s/rad.
    pub deflection_rate: f64,
    /// e₁, V/rad.
    pub deflection: f64,
    /// e₂, V/rad².
    pub deflection_squared: f64,
    /// f: Coulomb friction, V.
    pub coulomb: f64,
}

impl VoltageBalance {
    /// The terms without acceleration and without Coulomb friction, V.
    fn smooth(&self, [theta, alpha, theta_dot, alpha_dot]: [f64; 4]) -> f64 {
        let hub_motion = theta_dot * (self.rate + theta_dot * theta_dot * self.rate_cubed);
        let hub_place = theta * (self.angle + theta * (self.angle_squared + theta * self.angle_cubed));
        let link =
            alpha_dot * self.deflection_rate + alpha * (self.deflection + alpha * self.deflection_squared);
        hub_motion + hub_place + link
    }

    /// ∂ of [`smooth`](Self::smooth) by (θ, α, θ̇, α̇).
    fn gradient(&self, [theta, alpha, theta_dot, _]: [f64; 4]) -> [f64; 4] {
        [
            self.angle + theta * (2.0 * self.angle_squared + 3.0 * theta * self.angle_cubed),
            self.deflection + 2.0 * alpha * self.deflection_squared,
            self.rate + 3.0 * theta_dot * theta_dot * self.rate_cubed,
            self.deflection_rate,
        ]
    }
}

/// Quanser's rotary flexible link: a servomotor turns a hub by θ, a flexible link clamped to the hub deflects
/// by α. State (θ, α, θ̇, α̇) in rad and rad/s, input the motor voltage V.
///
/// Friction is true Coulomb friction: sign(0) is any value in \[−1, 1\]. While the hub sticks, the first
/// equation with θ̇ = θ″ = 0 gives that value, and the second takes the same.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotaryFlexibleLink {
    /// Balance of the hub (θ″), thesis Eq 2.24.
    pub hub: VoltageBalance,
    /// Balance of the link (α″), thesis Eq 2.25.
    pub link: VoltageBalance,
    /// Largest |θ| for which the coefficients mean anything, rad.
    pub theta_limit: f64,
}

impl RotaryFlexibleLink {
    /// Thesis Table 2.3, columns "Identified". Valid inside ±40° only: the data rested at ±30°, where the
    /// cubic term cancels the linear one, and beyond that the plant runs off. The "α̇" of Eq 2.25's first term
    /// is α″ (as the table has it).
    pub const IDENTIFIED: Self = Self {
        hub: VoltageBalance {
            acceleration: 0.0190,
            rate: 0.6623,
            rate_cubed: -0.0065,
            angle: 0.4151,
            angle_squared: 0.0933,
            angle_cubed: -1.5354,
            deflection_rate: -0.0420,
            deflection: -6.3840,
            deflection_squared: 5.8953,
            coulomb: 0.1151,
        },
        link: VoltageBalance {
            acceleration: -0.0118,
            rate: 0.5890,
            rate_cubed: 0.0,
            angle: 0.7113,
            angle_squared: 0.0935,
            angle_cubed: -2.7442,
            deflection_rate: -0.0872,
            deflection: -13.1712,
            deflection_squared: 6.2922,
            coulomb: 0.1474,
        },
        theta_limit: 40.0 * PI / 180.0,
    };

    /// Thesis Table 2.3, columns "Quanser": the linear model of Eq 2.21 with the maker's constants.
    pub const QUANSER: Self = Self {
        hub: VoltageBalance {
            acceleration: 0.016231,
            rate: 0.7323,
            rate_cubed: 0.0,
            angle: 0.0,
            angle_squared: 0.0,
            angle_cubed: 0.0,
            deflection_rate: 0.0,
            deflection: -10.124,
            deflection_squared: 0.0,
            coulomb: 0.0,
        },
        link: VoltageBalance {
            acceleration: -0.016231,
            rate: 0.7323,
            rate_cubed: 0.0,
            angle: 0.0,
            angle_squared: 0.0,
            angle_cubed: 0.0,
            deflection_rate: 0.0,
            deflection: -15.672,
            deflection_squared: 0.0,
            coulomb: 0.0,
        },
        theta_limit: f64::INFINITY,
    };

    /// The matrix A of ẋ = A x + … at the state `at`, Coulomb friction left out; x = (θ, α, θ̇, α̇).
    #[must_use]
    pub fn linearised(&self, at: [f64; 4]) -> [[f64; 4]; 4] {
        let by_row = |row: &VoltageBalance| row.gradient(at).map(|g| -g / row.acceleration);
        [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], by_row(&self.hub), by_row(&self.link)]
    }

    /// The drift f(x) of ẋ = f(x) + g V at x = (θ, α, θ̇, α̇), in rad/s and rad/s², with `sign` in the place of the
    /// set-valued sign(θ̇): for laws, which need a number there.
    #[must_use]
    pub fn drift(&self, x: [f64; 4], sign: f64) -> [f64; 4] {
        let by_row = |row: &VoltageBalance| -(row.smooth(x) + row.coulomb * sign) / row.acceleration;
        [x[2], x[3], by_row(&self.hub), by_row(&self.link)]
    }

    /// The input vector g of ẋ = f(x) + g V: (0, 0, B_θ, B_α) of thesis Eq 4.2, in rad/(V s²).
    #[must_use]
    pub fn input(&self) -> [f64; 4] {
        [0.0, 0.0, 1.0 / self.hub.acceleration, 1.0 / self.link.acceleration]
    }

    /// The same link without Coulomb friction.
    #[must_use]
    pub fn without_friction(&self) -> Self {
        let free = |row: VoltageBalance| VoltageBalance { coulomb: 0.0, ..row };
        Self { hub: free(self.hub), link: free(self.link), ..*self }
    }

    /// Runs `samples` samples from `start` = (θ, α, θ̇, α̇). At sample k `command` gets k and the true (θ, α)
    /// and returns the voltage held until the next sample: sensor, noise and controller are its business.
    ///
    /// # Errors
    /// A bad sampling, a command that is not finite, or a hub outside ±[`theta_limit`](Self::theta_limit).
    pub fn run(
        &self,
        sampling: Sampling,
        start: [f64; 4],
        samples: usize,
        mut command: impl FnMut(usize, [f64; 2]) -> f64,
    ) -> Result<LinkRun, RigError> {
        self.run_with_state(sampling, start, samples, |k, [theta, alpha, ..]| command(k, [theta, alpha]))
    }

    /// Like [`run`](Self::run), with a command that gets the whole true state (θ, α, θ̇, α̇).
    ///
    /// # Errors
    /// As [`run`](Self::run).
    pub fn run_with_state(
        &self,
        sampling: Sampling,
        start: [f64; 4],
        samples: usize,
        mut command: impl FnMut(usize, [f64; 4]) -> f64,
    ) -> Result<LinkRun, RigError> {
        let h = sampling.substep()?;
        let mut run = LinkRun { voltages: Vec::with_capacity(samples), states: Vec::with_capacity(samples) };
        let mut x = start;
        let mut contact = Contact::Stick;
        for k in 0..samples {
            let time = k as f64 * sampling.dt;
            let within = x[0].abs() <= self.theta_limit && x.iter().all(|x| x.is_finite());
            if !within {
                let limit = self.theta_limit;
                return Err(RigError::OutOfRange { coordinate: "hub angle", time, value: x[0], limit });
            }
            let voltage = command(k, x);
            if !voltage.is_finite() {
                return Err(RigError::Command { time, value: voltage });
            }
            run.voltages.push(voltage);
            run.states.push(x);
            let driven = DrivenLink { link: self, voltage };
            if k == 0 || contact == Contact::Stick {
                contact = driven.contact(x);
            }
            for _ in 0..sampling.substeps {
                (x, contact) = driven.step(x, contact, h);
            }
        }
        Ok(run)
    }
}

/// The link under a held voltage.
struct DrivenLink<'a> {
    link: &'a RotaryFlexibleLink,
    voltage: f64,
}

impl Frictional<4> for DrivenLink<'_> {
    const VELOCITY: usize = 2;

    fn coulomb(&self) -> f64 {
        self.link.hub.coulomb
    }

    fn holding_sign(&self, x: [f64; 4]) -> f64 {
        (self.voltage - self.link.hub.smooth(x)) / self.link.hub.coulomb
    }

    fn rate(&self, x: [f64; 4], contact: Contact) -> [f64; 4] {
        let sign = match contact {
            Contact::Slip(sign) => sign,
            Contact::Stick => self.holding_sign(x),
        };
        let acceleration =
            |row: &VoltageBalance| (self.voltage - row.smooth(x) - row.coulomb * sign) / row.acceleration;
        let hub = if contact == Contact::Stick { 0.0 } else { acceleration(&self.link.hub) };
        [x[2], x[3], hub, acceleration(&self.link.link)]
    }
}

/// A plant with true Coulomb friction on one of its velocities: sign(0) is any value in [−1, 1].
trait Frictional<const N: usize> {
    /// Which component of the state is the velocity under friction.
    const VELOCITY: usize;

    /// Level of the friction; zero for none.
    fn coulomb(&self) -> f64;

    /// The value of the sign that keeps a resting body at rest; it can stay when the magnitude is at most 1.
    fn holding_sign(&self, x: [f64; N]) -> f64;

    /// ẋ in the given contact.
    fn rate(&self, x: [f64; N], contact: Contact) -> [f64; N];

    /// What the body does next at the state `x`.
    fn contact(&self, x: [f64; N]) -> Contact {
        let speed = x[Self::VELOCITY];
        if self.coulomb() == 0.0 {
            return Contact::Slip(if speed == 0.0 { 0.0 } else { speed.signum() });
        }
        if speed != 0.0 {
            return Contact::Slip(speed.signum());
        }
        let sign = self.holding_sign(x);
        if sign.abs() <= 1.0 { Contact::Stick } else { Contact::Slip(sign.signum()) }
    }

    /// One substep; the instants where the body stops or breaks loose are found by bisection, and the rest of
    /// the substep continues in the new contact.
    fn step(&self, mut x: [f64; N], mut contact: Contact, h: f64) -> ([f64; N], Contact) {
        // One contact changes at most a few times in a substep; the bound only stops a loop on rounding.
        const CHANGES: usize = 8;
        let mut left = h;
        for _ in 0..CHANGES {
            let ahead = |h: f64| runge_kutta(x, h, |x| self.rate(x, contact));
            let stays = |x: [f64; N]| match contact {
                Contact::Slip(sign) => sign * x[Self::VELOCITY] >= 0.0,
                Contact::Stick => self.holding_sign(x).abs() <= 1.0,
            };
            let end = ahead(left);
            if self.coulomb() == 0.0 || stays(end) || !end.iter().all(|x| x.is_finite()) {
                return (end, contact);
            }
            let (mut before, mut after) = (0.0, left);
            for _ in 0..60 {
                let middle = 0.5 * (before + after);
                if stays(ahead(middle)) { before = middle } else { after = middle }
            }
            x = ahead(after);
            x[Self::VELOCITY] = 0.0;
            left -= after;
            contact = self.contact(x);
            if left <= 0.0 {
                return (x, contact);
            }
        }
        (runge_kutta(x, left, |x| self.rate(x, contact)), contact)
    }
}

/// What a body under Coulomb friction does: it moves in the direction of the sign, or rests.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Contact {
    Slip(f64),
    Stick,
}

/// What the rotary flexible link did, one entry per sample.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkRun {
    /// Voltage held from this sample to the next, V.
    pub voltages: Vec<f64>,
    /// True state (θ, α, θ̇, α̇) at the sample, rad and rad/s.
    pub states: Vec<[f64; 4]>,
}

/// The position loop of the thesis: V = kₚ (r − θ) + dither, limited by the amplifier.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProportionalController {
    /// kₚ, V/rad.
    pub gain: f64,
    /// Largest |V| the amplifier gives, V.
    pub limit: f64,
    /// Resolution of the output, V; zero for none.
    pub resolution: f64,
}

impl ProportionalController {
    /// kₚ = √10 V/rad (from thesis Table 3.5), ±10 V, no output quantisation.
    pub const THESIS: Self = Self { gain: 3.162_277_660_168_379_5, limit: 10.0, resolution: 0.0 };

    /// The voltage for a reference and a measured angle (rad), with `dither` (V) added.
    #[must_use]
    pub fn command(&self, reference: f64, theta: f64, dither: f64) -> f64 {
        let voltage = self.gain * (reference - theta) + dither;
        quantise(voltage.max(-self.limit).min(self.limit), self.resolution)
    }
}

/// Angle of one count of a 4096-count encoder, rad.
pub const ENCODER_4096: f64 = TAU / 4096.0;

/// The multiple of `step` nearest to `value`; `value` itself when `step` is zero.
#[must_use]
pub fn quantise(value: f64, step: f64) -> f64 {
    if step > 0.0 { (value / step).round() * step } else { value }
}

/// A square wave that starts with its positive half; `frequency` in Hz, `t` in s.
#[must_use]
pub fn square_wave(amplitude: f64, frequency: f64, t: f64) -> f64 {
    if (frequency * t).rem_euclid(1.0) < 0.5 { amplitude } else { -amplitude }
}

/// One sine: amplitude·sin(2π·frequency·t + phase).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sine {
    /// Amplitude, in the unit of the signal.
    pub amplitude: f64,
    /// Frequency, Hz.
    pub frequency: f64,
    /// Phase at t = 0, rad.
    pub phase: f64,
}

/// The sum of sines at the time `t`, s.
#[must_use]
pub fn multisine(sines: &[Sine], t: f64) -> f64 {
    sines.iter().map(|s| s.amplitude * (TAU * s.frequency * t + s.phase).sin()).sum()
}

/// The forced oscillator of thesis Eq 2.18, state (x, ẋ):
///
/// ```text
/// m ẍ + k₁ x + k₃ x³ + c₁ ẋ + c₂ x² ẋ + c₃ ẋ³ = f(t)
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Duffing {
    /// Mass m, kg.
    pub m: f64,
    /// Linear stiffness k₁, N/m.
    pub k1: f64,
    /// Cubic stiffness k₃, N/m³.
    pub k3: f64,
    /// Linear damping c₁, N s/m.
    pub c1: f64,
    /// Damping that grows with the displacement c₂, N s/m³.
    pub c2: f64,
    /// Cubic damping c₃, N s³/m³.
    pub c3: f64,
}

impl Duffing {
    /// The thesis's numbers. The text gives no mass; the first row of Table 2.1 does: 2.
    pub const THESIS: Self = Self { m: 2.0, k1: 6.0, k3: 0.1, c1: 1.0, c2: 0.2, c3: 1.0 };

    /// The force of thesis Eq 2.19 without its noise, N: 10 sin t + 40 sin 4t.
    #[must_use]
    pub fn thesis_force(t: f64) -> f64 {
        10.0 * t.sin() + 40.0 * (4.0 * t).sin()
    }

    /// Kinetic and potential energy, J: ½ m ẋ² + ½ k₁ x² + ¼ k₃ x⁴.
    #[must_use]
    pub fn energy(&self, [x, v]: [f64; 2]) -> f64 {
        0.5 * self.m * v * v + x * x * (0.5 * self.k1 + 0.25 * self.k3 * x * x)
    }

    /// Runs `samples` samples from `start` = (x, ẋ) under a force given in continuous time (s → N); returns
    /// (x, ẋ) at the samples.
    ///
    /// # Errors
    /// A bad sampling, or a state that overflowed (a softening spring pulled over its top, a force that is not
    /// finite).
    pub fn run(
        &self,
        sampling: Sampling,
        start: [f64; 2],
        samples: usize,
        force: impl Fn(f64) -> f64,
    ) -> Result<Vec<[f64; 2]>, RigError> {
        let h = sampling.substep()?;
        let mut states = Vec::with_capacity(samples);
        let mut x = start;
        for k in 0..samples {
            let time = k as f64 * sampling.dt;
            if !x.iter().all(|x| x.is_finite()) {
                let limit = f64::MAX;
                return Err(RigError::OutOfRange { coordinate: "displacement", time, value: x[0], limit });
            }
            states.push(x);
            for i in 0..sampling.substeps {
                let t = time + i as f64 * h;
                let [x0, v0, _] = runge_kutta([x[0], x[1], t], h, |[x, v, t]| {
                    let restoring = x * (self.k1 + self.k3 * x * x);
                    let damping = v * (self.c1 + self.c2 * x * x + self.c3 * v * v);
                    [v, (force(t) - restoring - damping) / self.m, 1.0]
                });
                x = [x0, v0];
            }
        }
        Ok(states)
    }
}

/// One classical fourth-order Runge–Kutta step of length `h`.
fn runge_kutta<const N: usize>(x: [f64; N], h: f64, rate: impl Fn([f64; N]) -> [f64; N]) -> [f64; N] {
    let along = |k: &[f64; N], h: f64| std::array::from_fn(|i| x[i] + h * k[i]);
    let k1 = rate(x);
    let k2 = rate(along(&k1, 0.5 * h));
    let k3 = rate(along(&k2, 0.5 * h));
    let k4 = rate(along(&k3, h));
    std::array::from_fn(|i| x[i] + h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]))
}
