//! Speed and load torque of a drive from its encoder, one sample at a time. Without the standard library: this is what
//! runs on the controller board; `main.rs` tries it on a simulated drive.
#![no_std]

use greybox_eso::{Design, EsoError, Fal, Observer, Scheme};

/// J θ″ = torque + load: the torque is known, the load is estimated.
#[derive(Debug, Clone, Copy)]
pub struct Estimator {
    observer: Observer<3>,
    inertia: f64,
}

/// What is known after a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// rad.
    pub angle: f64,
    /// rad/s.
    pub speed: f64,
    /// N m.
    pub load: f64,
}

impl Estimator {
    /// For a drive of `inertia` (kg m²) whose encoder is read every `step` seconds. A larger `bandwidth` (rad/s) follows
    /// faster and passes more noise: [`lag`](Self::lag) and [`noise`](Self::noise) say how much.
    ///
    /// # Errors
    /// [`EsoError`] for numbers that are not positive.
    pub fn new(inertia: f64, bandwidth: f64, step: f64) -> Result<Self, EsoError> {
        let design = Design::from_bandwidth(bandwidth, [Fal::LINEAR; 3])?;
        let observer =
            Observer::new(design, step, Scheme::Trapezoidal)?.with_extended_state(1.0 / inertia)?;
        Ok(Self { observer, inertia })
    }

    /// Takes the angle read now, and the torque that acted since the reading before.
    pub fn update(&mut self, angle: f64, torque: f64) -> Estimate {
        let [angle, speed, disturbance] = self.observer.update(angle, torque);
        Estimate { angle, speed, load: self.inertia * disturbance }
    }

    /// How long the load is behind, s.
    ///
    /// # Errors
    /// None with three states.
    pub fn lag(&self) -> Result<f64, EsoError> {
        self.observer.lag(2)
    }

    /// Noise of speed (rad/s) and load (N m) for encoder noise of `angle` rad.
    ///
    /// # Errors
    /// None with three states.
    pub fn noise(&self, angle: f64) -> Result<(f64, f64), EsoError> {
        let gain = |state| self.observer.noise_gain(state);
        Ok((angle * gain(1)?, self.inertia * angle * gain(2)?))
    }
}
