//! Integral action of a loop that sticks.

use crate::controller::Controller;
use crate::error::{ControlError, listed};
use crate::observer::Sensor;

/// T is this share of the fastest time constant of the loop.
const SHARE: f64 = 0.25;

/// The integral action of a law behind an observer.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Integral {
    /// None: u = κ(x̂, r).
    Off,
    /// The estimated disturbance: u = κ(x̂, r) − d̂.
    #[default]
    Disturbance,
    /// The error at rest, for a machine that sticks: [`Rest`].
    AtRest {
        /// T, s: the tracked state rests while its reading stays within one step over this time. A quarter of the
        /// fastest time constant of the loop where none is given.
        time: Option<f64>,
    },
}

/// Integral action for a machine that sticks. It remembers an offset o and has two modes:
///
/// ```text
/// in motion    u = κ(x̂, r) − o                        o′ = 0
/// at rest      u = κ(x̄, r) − o,   x̄ = (y, x̂ held)     o′ = −[κ(x̄, r) − κ(x̄ with y at the edge of r ± δ, r)] / Tᵢ
/// ```
///
/// δ is one step of the sensor of the tracked state. The machine is at rest while the reading y stays within one step
/// over a time T, or |ẏ̂| < δ/T: it is in motion again when neither holds, or when r changes. At rest the law is given
/// y and otherwise the estimate of the moment at which the machine came to rest, so that the command moves with y
/// and o alone. o moves only while y stays within one step over T *and* is more than δ off, at the rate of a
/// proportional-integral law with the integral time Tᵢ, the slowest time constant of the loop.
///
/// Two things make a loop hunt about a set point where it sticks. An integral that goes on in motion has to be
/// unwound beyond the set point (B. Armstrong-Hélouvry, P. Dupont and C. Canudas de Wit, *Automatica* 30(7), 1994,
/// section on hunting; R. Beerens et al., *Automatica* 107, 2019): here it stands. And while friction holds the tracked
/// state, feedback of the other states acts on another plant than the one that the law is made for, of which friction takes its
/// share of the command. That loop may be unstable, and then the machine cannot stay at rest, whatever the integral
/// does: here it is open.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rest {
    /// T, s.
    pub time: f64,
    /// δ: resolution and 6 √2 standard deviations of the noise of the tracked state's sensor (three of the difference of two
    /// readings to either side), SI.
    pub step: f64,
    /// Tᵢ, s.
    pub integral_time: f64,
    /// T in samples.
    samples: usize,
    dt: f64,
    tracked: usize,
    /// Which measurement is the tracked state's.
    measurement: usize,
    /// The state that is its rate.
    rate: Option<usize>,
}

/// What it remembers.
#[derive(Debug, Clone)]
pub(crate) struct RestMemory {
    pub(crate) offset: f64,
    /// The reading from which rest is counted; not a number before the first.
    reading: f64,
    reference: f64,
    /// Samples for which the reading has stayed.
    stayed: usize,
    /// The states as they were when the machine came to rest.
    held: Option<Vec<f64>>,
}

impl Rest {
    pub(crate) fn new(
        controller: &Controller,
        time: Option<f64>,
        measured: &[usize],
        sensors: &[Sensor],
    ) -> Result<Rest, ControlError> {
        let (plant, dt, tracked) = (controller.plant(), controller.dt(), controller.tracked());
        let magnitudes = || controller.design_point().poles.iter().map(|p| p.magnitude());
        let time = time.unwrap_or_else(|| SHARE / magnitudes().fold(0.0, f64::max));
        if !(time > 0.0 && time.is_finite()) {
            let what = "the time after which the machine is at rest".to_owned();
            return Err(ControlError::Option { what, value: time, wanted: "a positive finite time" });
        }
        let names = plant.state_names();
        let measurement = measured.iter().position(|i| *i == tracked);
        let sensor = measurement.and_then(|m| sensors.get(m));
        let (Some(measurement), Some(sensor)) = (measurement, sensor) else {
            let name = names.get(tracked).cloned().unwrap_or_default();
            return Err(ControlError::NotMeasured {
                name,
                known: listed(measured.iter().map(|&i| &names[i])),
            });
        };
        let symbols = plant.symbols();
        let rate = symbols
            .get(tracked)
            .and_then(|(name, primes)| symbols.iter().position(|(n, p)| n == name && *p == primes + 1));
        Ok(Rest {
            time,
            step: sensor.resolution + 6.0 * std::f64::consts::SQRT_2 * sensor.noise,
            integral_time: 1.0 / magnitudes().fold(f64::INFINITY, f64::min),
            samples: ((time / dt - 1e-9).ceil() as usize).max(1),
            dt,
            tracked,
            measurement,
            rate,
        })
    }

    /// T in samples.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.samples
    }

    /// Index of the tracked state among the measured ones.
    #[must_use]
    pub fn measurement(&self) -> usize {
        self.measurement
    }

    /// Index of the state that is the rate of the tracked one; none where the plant has none.
    #[must_use]
    pub fn rate(&self) -> Option<usize> {
        self.rate
    }

    /// |ẏ̂| below which the machine is at rest: δ/T.
    #[must_use]
    pub fn velocity(&self) -> f64 {
        self.step / self.time
    }

    pub(crate) fn start(offset: f64) -> RestMemory {
        RestMemory { offset, reading: f64::NAN, reference: f64::NAN, stayed: 0, held: None }
    }

    /// The command from the estimate `x` of the states, the measurements and the reference; `law` is κ(x, r) − o
    /// within the limits, of the states and o.
    pub(crate) fn command(
        &self,
        memory: &mut RestMemory,
        (x, y, r): (&[f64], &[f64], f64),
        law: impl Fn(&[f64], f64) -> f64,
    ) -> f64 {
        let y = y.get(self.measurement).copied().unwrap_or(f64::NAN);
        let is_new = memory.reference != r;
        memory.reference = r;
        // Not so where either is not a number.
        let is_same = (y - memory.reading).abs() <= 0.5 * self.step;
        if is_same && !is_new {
            memory.stayed = (memory.stayed + 1).min(self.samples);
        } else {
            memory.reading = y;
            memory.stayed = 0;
        }
        let stays = memory.stayed == self.samples;
        let is_slow = self.rate.is_some_and(|rate| x[rate].abs() < self.velocity());
        if is_new || !y.is_finite() || !(stays || is_slow) {
            memory.held = None;
            return law(x, memory.offset);
        }
        let held = memory.held.get_or_insert_with(|| x.to_vec());
        held[self.tracked] = y;
        let u = law(held, memory.offset);
        let error = r - y;
        if !(stays && error.abs() > self.step) {
            return u;
        }
        held[self.tracked] = r - self.step * error.signum();
        let change = u - law(held, memory.offset);
        held[self.tracked] = y;
        if change.is_finite() {
            memory.offset -= change * self.dt / self.integral_time;
        }
        law(held, memory.offset)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// u = 2 (r − y) − o about r = 0, ten samples to rest.
    #[test]
    fn the_offset_moves_while_the_reading_stays() {
        let rest = Rest {
            time: 0.1,
            step: 0.1,
            integral_time: 0.5,
            samples: 10,
            dt: 0.01,
            tracked: 0,
            measurement: 0,
            rate: Some(1),
        };
        let law = |x: &[f64], offset: f64| -2.0 * x[0] + 7.0 * x[2] - offset;
        let run = |y: &dyn Fn(usize) -> f64, velocity: f64| {
            let mut memory = Rest::start(0.0);
            let u: Vec<f64> = (0..20)
                .map(|k| rest.command(&mut memory, (&[0.0, velocity, k as f64], &[y(k)], 0.0), law))
                .collect();
            (memory.offset, u)
        };
        // Slow from the second sample on: what is not read is held. Ten integrations of 2 (0.5 − 0.1).
        let (offset, u) = run(&|_| 0.5, 0.1);
        assert!((offset - 10.0 * 0.8 * 0.01 / 0.5).abs() < 1e-12, "{offset}");
        assert_eq!((u[0], u[1], u[5]), (0.0, 7.0 - 1.0, 7.0 - 1.0));
        assert!((u[19] - (7.0 - 1.0 - offset)).abs() < 1e-12, "{u:?}");
        // Fast by the estimate, at rest by the reading.
        assert!(run(&|_| 0.5, 9.0).0 > 0.0);
        // A reading that creeps, one that is a step off, and one that is none.
        assert_eq!(run(&|k| 0.5 + 0.2 * k as f64, 0.1).0, 0.0);
        assert_eq!(run(&|_| 0.1, 0.1).0, 0.0);
        let (offset, u) = run(&|_| f64::NAN, 0.1);
        assert_eq!((offset, u[5]), (0.0, 35.0));
    }
}
