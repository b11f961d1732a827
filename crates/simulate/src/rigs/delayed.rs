//! Plants under a proportional control that acts late: the virtual rigs of thesis chapter 3.
use super::{Contact, Frictional, RigError, Sampling, runge_kutta};

/// What a coordinate was: (value, rate) at every integration step, and one value held before t = 0.
struct Past {
    step: f64,
    delay: f64,
    before: f64,
    nodes: Vec<[f64; 2]>,
}

impl Past {
    fn new(step: f64, delay: f64, before: f64, steps: usize) -> Self {
        Self { step, delay, before, nodes: Vec::with_capacity(steps + 1) }
    }

    /// The value at `t` − delay (`now` when there is no delay): the cubic through both values and rates of the
    /// interval it falls in, so that the middle of a Runge–Kutta step is known to the order of the method.
    fn delayed(&self, t: f64, now: f64) -> f64 {
        if self.delay == 0.0 {
            return now;
        }
        let s = (t - self.delay) / self.step;
        let last = self.nodes.len() - 1;
        if s < 0.0 {
            return self.before;
        }
        if last == 0 {
            return self.nodes[0][0];
        }
        let i = (s.floor() as usize).min(last - 1);
        let ([a, da], [b, db]) = (self.nodes[i], self.nodes[i + 1]);
        let u = s - i as f64;
        let (w, h) = (1.0 - u, self.step);
        w * w * ((1.0 + 2.0 * u) * a + u * h * da) + u * u * ((1.0 + 2.0 * w) * b - w * h * db)
    }
}

/// A delay must span at least one integration step, or be none.
fn check_delay(delay: f64, step: f64) -> Result<(), RigError> {
    // One rounding error more than the step itself is still the step.
    let explicit = delay >= step * (1.0 - 1e-12) && delay.is_finite();
    if delay == 0.0 || explicit { Ok(()) } else { Err(RigError::Delay { delay, step }) }
}

/// The forced oscillator with a delayed proportional feedback, thesis Eq 3.3, state (x, ẋ):
///
/// ```text
/// m ẍ + c₁ ẋ + c₂ x² ẋ + c₃ ẋ³ + k₁ x + k₃ x³ − kₚ x(t − τ) = f(t)
/// ```
///
/// Before t = 0 the displacement is its initial value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DelayedDuffing {
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
    /// Feedback gain kₚ, N/m: positive pushes away.
    pub gain: f64,
    /// Delay τ of the feedback, s.
    pub delay: f64,
}

impl DelayedDuffing {
    /// The column "Selected Value" of thesis Table 3.2, with the text's kₚ = 2.
    pub const THESIS: Self =
        Self { m: 1.0, k1: 6.0, k3: 2.0, c1: 1.0, c2: 1.0, c3: 1.0, gain: 2.0, delay: 0.2 };

    /// (x, ẋ) at t = 0 of the thesis's training recording.
    pub const TRAINING_START: [f64; 2] = [1.0, 0.0];

    /// (x, ẋ) at t = 0 of the thesis's test recording.
    pub const TEST_START: [f64; 2] = [-1.0, 0.5];

    /// The force of the training recording without its noise, N (thesis Eq 3.19): 10 sin 4t + 40 sin 4t².
    #[must_use]
    pub fn training_force(t: f64) -> f64 {
        10.0 * (4.0 * t).sin() + 40.0 * (4.0 * t * t).sin()
    }

    /// The force of the test recording without its noise, N (thesis Eq 3.20): 10 sin 2t + 40 sin 8t.
    #[must_use]
    pub fn test_force(t: f64) -> f64 {
        10.0 * (2.0 * t).sin() + 40.0 * (8.0 * t).sin()
    }

    /// Runs `samples` samples from `start` = (x, ẋ) under a force given in continuous time (s → N); returns
    /// (x, ẋ) at the samples.
    ///
    /// # Errors
    /// A bad sampling, a delay shorter than one substep, or a state that overflowed.
    pub fn run(
        &self,
        sampling: Sampling,
        start: [f64; 2],
        samples: usize,
        force: impl Fn(f64) -> f64,
    ) -> Result<Vec<[f64; 2]>, RigError> {
        let h = sampling.substep()?;
        check_delay(self.delay, h)?;
        let mut past = Past::new(h, self.delay, start[0], samples.saturating_mul(sampling.substeps));
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
                past.nodes.push(x);
                let t = time + i as f64 * h;
                let [x0, v0, _] = runge_kutta([x[0], x[1], t], h, |[x, v, t]| {
                    let restoring = x * (self.k1 + self.k3 * x * x) - self.gain * past.delayed(t, x);
                    let damping = v * (self.c1 + self.c2 * x * x + self.c3 * v * v);
                    [v, (force(t) - restoring - damping) / self.m, 1.0]
                });
                x = [x0, v0];
            }
        }
        Ok(states)
    }
}

/// Quanser's rotary flexible joint under a delayed proportional control, thesis Eq 3.21 and 3.22, with the
/// Coulomb friction that the real one has. State (θ, α, θ̇, α̇) in rad and rad/s:
///
/// ```text
/// J_eq θ″ + B_eq θ̇ − B_l α̇ − k_s α + f_c sign(θ̇) = a V + b θ̇
/// J_l (θ″ + α″) + B_l α̇ + k_s α = 0
/// V = kₚ (θ_d(t) − θ(t − τ))
/// ```
///
/// (the first line is the first of Eq 3.21 less the second). The controller is digital: it acts at the samples
/// and its voltage is held in between. Before t = 0 the angle is its initial value.
/// sign(0) is any value in \[−1, 1\]: the base truly sticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotaryFlexibleJoint {
    /// Moment of inertia of the base and its gear J_eq, kg m².
    pub base_inertia: f64,
    /// Moment of inertia of the joint's arm J_l, kg m².
    pub link_inertia: f64,
    /// Viscous damping of the base B_eq, N m s/rad.
    pub base_damping: f64,
    /// Viscous damping of the joint B_l, N m s/rad.
    pub link_damping: f64,
    /// Stiffness of the joint k_s, N m/rad.
    pub stiffness: f64,
    /// Coulomb friction of the base f_c, N m.
    pub coulomb: f64,
    /// Torque per volt a = η_g k_g η_m k_t / R_m, N m/V.
    pub torque_per_volt: f64,
    /// Back EMF b = −a k_g k_m, N m s/rad.
    pub back_emf: f64,
    /// kₚ, V/rad.
    pub gain: f64,
    /// Delay τ of the measured angle, s.
    pub delay: f64,
}

impl RotaryFlexibleJoint {
    /// Thesis Table 3.3 made consistent with Table 3.5 (J_eq = 0.00208, kₚ = √10; the printed J_eq of Table 3.3
    /// contradicts it), no joint damping, no friction, τ = 0.2 s.
    pub const LINEAR: Self = Self {
        base_inertia: 0.00208,
        link_inertia: 0.0038,
        base_damping: 0.015,
        link_damping: 0.0,
        stiffness: 1.3,
        coulomb: 0.0,
        torque_per_volt: Self::TORQUE_PER_VOLT,
        back_emf: -Self::TORQUE_PER_VOLT * 70.0 * 7.68e-3,
        gain: 3.162_277_660_168_379_5,
        delay: 0.2,
    };

    /// [`LINEAR`](Self::LINEAR) with Coulomb friction of 0.02 N m.
    pub const WITH_FRICTION: Self = Self { coulomb: 0.02, ..Self::LINEAR };

    const TORQUE_PER_VOLT: f64 = 0.9 * 70.0 * 0.69 * 7.68e-3 / 2.6;

    /// The matrices A₀ and A₁ of ẋ = A₀ x + A₁ x(t − τ) + …, friction left out; x = (θ, α, θ̇, α̇).
    #[must_use]
    pub fn linearised(&self) -> [[[f64; 4]; 4]; 2] {
        let base = [
            0.0,
            self.stiffness / self.base_inertia,
            (self.back_emf - self.base_damping) / self.base_inertia,
            self.link_damping / self.base_inertia,
        ];
        let spring = [0.0, self.stiffness / self.link_inertia, 0.0, self.link_damping / self.link_inertia];
        let link = std::array::from_fn(|i| -base[i] - spring[i]);
        let late = -self.torque_per_volt * self.gain / self.base_inertia;
        let undelayed = [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], base, link];
        let delayed = [[0.0; 4], [0.0; 4], [late, 0.0, 0.0, 0.0], [-late, 0.0, 0.0, 0.0]];
        [undelayed, delayed]
    }

    /// Runs `samples` samples from `start` = (θ, α, θ̇, α̇) under the reference θ_d (s → rad).
    ///
    /// # Errors
    /// A bad sampling, a delay shorter than one substep, or a state that overflowed (the loop is unstable).
    pub fn run(
        &self,
        sampling: Sampling,
        start: [f64; 4],
        samples: usize,
        reference: impl Fn(f64) -> f64,
    ) -> Result<JointRun, RigError> {
        let h = sampling.substep()?;
        check_delay(self.delay, h)?;
        let mut past = Past::new(h, self.delay, start[0], samples.saturating_mul(sampling.substeps));
        let mut run = JointRun { voltages: Vec::with_capacity(samples), states: Vec::with_capacity(samples) };
        let mut x = start;
        let mut contact = Contact::Stick;
        for k in 0..samples {
            let time = k as f64 * sampling.dt;
            if !x.iter().all(|x| x.is_finite()) {
                let limit = f64::MAX;
                return Err(RigError::OutOfRange { coordinate: "base angle", time, value: x[0], limit });
            }
            // The interval that holds t − τ may end at this very sample.
            past.nodes.push([x[0], x[2]]);
            let voltage = self.gain * (reference(time) - past.delayed(time, x[0]));
            run.voltages.push(voltage);
            run.states.push(x);
            let driven = DrivenJoint { joint: self, voltage };
            if k == 0 || contact == Contact::Stick {
                contact = driven.contact(x);
            }
            for i in 0..sampling.substeps {
                if i > 0 {
                    past.nodes.push([x[0], x[2]]);
                }
                (x, contact) = driven.step(x, contact, h);
            }
        }
        Ok(run)
    }
}

/// The joint under a held voltage.
struct DrivenJoint<'a> {
    joint: &'a RotaryFlexibleJoint,
    voltage: f64,
}

impl DrivenJoint<'_> {
    /// The torque on the base but for Coulomb friction, N m.
    fn torque(&self, [_, alpha, theta_dot, alpha_dot]: [f64; 4]) -> f64 {
        let j = self.joint;
        let joint = j.stiffness * alpha + j.link_damping * alpha_dot;
        j.torque_per_volt * self.voltage + (j.back_emf - j.base_damping) * theta_dot + joint
    }
}

impl Frictional<4> for DrivenJoint<'_> {
    const VELOCITY: usize = 2;

    fn coulomb(&self) -> f64 {
        self.joint.coulomb
    }

    fn holding_sign(&self, x: [f64; 4]) -> f64 {
        self.torque(x) / self.joint.coulomb
    }

    fn rate(&self, x: [f64; 4], contact: Contact) -> [f64; 4] {
        let j = self.joint;
        let base = match contact {
            Contact::Slip(sign) => (self.torque(x) - j.coulomb * sign) / j.base_inertia,
            Contact::Stick => 0.0,
        };
        let spring = (j.stiffness * x[1] + j.link_damping * x[3]) / j.link_inertia;
        [x[2], x[3], base, -base - spring]
    }
}

/// What the rotary flexible joint did, one entry per sample.
#[derive(Debug, Clone, PartialEq)]
pub struct JointRun {
    /// Voltage held from this sample to the next, V.
    pub voltages: Vec<f64>,
    /// True state (θ, α, θ̇, α̇) at the sample, rad and rad/s.
    pub states: Vec<[f64; 4]>,
}
