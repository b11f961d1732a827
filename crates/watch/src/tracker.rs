//! A filter on a model: from sample to sample, and what each innovation tells of parameters, forces and offsets.

use greybox_recursive::{Filter, Innovation, Measured, Predicted, RecursiveError};
use greybox_simulate::Past;
use serde::{Deserialize, Serialize};

use crate::learn::{Place, Usual};
use crate::machine::{Beginning, Machine, Span, Step};
use crate::sample::Sample;

/// What innovations are regressed on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Effects {
    /// The parameters that may move.
    Parameters,
    /// And a constant force in every equation, and an offset of every sensor.
    Everything,
}

/// A filter of a machine's state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Tracker {
    pub(crate) filter: Filter,
    effects: Effects,
    /// What the delayed expressions of the equations were, by the estimates of that time.
    #[serde(with = "past")]
    past: Vec<Past>,
}

/// [`Past`] as data: times, values, slopes and lanes.
mod past {
    use greybox_simulate::Past;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    type Columns = (Vec<f64>, Vec<f64>, Vec<f64>, Vec<f64>);

    pub(super) fn serialize<S: Serializer>(past: &[Past], serializer: S) -> Result<S::Ok, S::Error> {
        let columns = past.iter().map(|p| (&p.time, &p.value, &p.slope, &p.lanes));
        columns.collect::<Vec<_>>().serialize(serializer)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Past>, D::Error> {
        let past = Vec::<Columns>::deserialize(deserializer)?.into_iter();
        Ok(past.map(|(time, value, slope, lanes)| Past { time, value, slope, lanes }).collect())
    }
}

/// Memory of a step, used anew by each.
#[derive(Debug, Clone, Default)]
pub(crate) struct Scratch {
    step: Step,
    wide: Vec<f64>,
    rows: Vec<f64>,
    noise: Vec<f64>,
    before: Vec<f64>,
    after: Vec<f64>,
    errors: Vec<f64>,
}

/// Size from which on a value is far from what is expected, in standard deviations: the least size of an outlier of a recording too
/// ([`greybox_recording::health::outliers`]).
const FAR: f64 = 6.0;
/// Samples whose innovations tell how large they are nearby, as many as on either side of an outlier of a recording.
const NEARBY: f64 = 32.0;

/// The last values of a channel, as a [`Gate`] saw them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Before {
    /// Innovation of the last value that was taken, in standard deviations.
    innovation: f64,
    /// Mean square of those of the last [`NEARBY`] values.
    square: f64,
    /// Whether the last value was not taken.
    refused: bool,
}

impl Default for Before {
    fn default() -> Before {
        Before { innovation: 0.0, square: 1.0, refused: false }
    }
}

impl Before {
    pub(crate) fn is_consistent(&self) -> bool {
        self.innovation.is_finite() && self.square.is_finite() && self.square >= 0.0
    }
}

/// Keeps out measured values that stand alone: those whose innovation jumps from that of the value before by more than innovations
/// nearby do. What a machine does moves innovations from sample to sample by little, by √2 standard deviations where nothing changes.
/// Where the value after such a jump is far too, it is taken: a sensor's zero that moves costs one sample.
pub(crate) struct Gate<'a> {
    /// Per channel.
    pub(crate) before: &'a mut [Before],
    /// Per channel, whether this value stands alone.
    pub(crate) alone: &'a mut [bool],
}

impl Gate<'_> {
    /// Whether a channel's value with this innovation (in standard deviations) is taken.
    fn takes(&mut self, channel: usize, innovation: f64) -> bool {
        let before = &mut self.before[channel];
        let most = FAR * (2.0 * before.square.max(1.0)).sqrt();
        before.refused = !before.refused && (innovation - before.innovation).abs() > most;
        self.alone[channel] = before.refused;
        if !before.refused && innovation.is_finite() {
            before.innovation = innovation;
            // (One that is confirmed is no measure of those nearby yet.)
            before.square += (innovation.abs().min(most).powi(2) - before.square) / NEARBY;
        }
        !before.refused
    }
}

/// What one sample is predicted with.
pub(crate) struct Conditions<'a> {
    pub(crate) machine: &'a Machine,
    pub(crate) usual: &'a Usual,
    pub(crate) place: &'a Place,
    /// Seconds that the state remembers.
    pub(crate) memory: f64,
    /// Samples before the one from which it is predicted.
    pub(crate) earlier: &'a [Sample],
}

impl Tracker {
    pub(crate) fn new(
        machine: &Machine,
        (state, deviation): (&[f64], &[f64]),
        effects: Effects,
    ) -> Result<Tracker, RecursiveError> {
        let filter = Filter::new(state, deviation, count(machine, effects))?;
        Ok(Tracker { filter, effects, past: Vec::new() })
    }

    /// Is where another one is, and was where that was.
    pub(crate) fn take_state(&mut self, other: &Tracker) {
        self.filter.take_state(&other.filter);
        self.past.clone_from(&other.past);
    }

    /// Moves as far as effects that move by `change` take it.
    pub(crate) fn follow(&mut self, machine: &Machine, change: &[f64]) {
        self.filter.follow(change);
        machine.follow(&mut self.past, change);
    }

    /// Whether its past is one of this machine.
    pub(crate) fn has_past_of(&self, machine: &Machine) -> bool {
        machine.has(&self.past)
    }

    /// States and effects, where the sizes of all parts agree.
    pub(crate) fn shape(&self) -> Option<(usize, usize, Effects)> {
        self.filter.shape().map(|(n, p)| (n, p, self.effects))
    }

    /// The state begins anew with this mean and these standard deviations.
    pub(crate) fn restart(&mut self, (mean, deviation): (&[f64], &[f64])) {
        self.filter.restart(mean, deviation);
        self.past.clear();
    }

    /// Number of effects.
    pub(crate) fn count(&self, machine: &Machine) -> usize {
        count(machine, self.effects)
    }

    /// Goes to the next sample; `learn` receives channel and innovation. `false` where the model leaves every bound.
    pub(crate) fn advance(
        &mut self,
        by: &Conditions<'_>,
        (from, to): (&Sample, &Sample),
        scratch: &mut Scratch,
        gate: Option<Gate<'_>>,
        learn: impl FnMut(usize, Innovation<'_>),
    ) -> bool {
        // As many steps as samples should have been.
        let seconds = to.t - from.t;
        let steps = (seconds / by.usual.dt).round().max(1.0);
        let dt = seconds / steps;
        scratch.before.clone_from(&from.inputs);
        for k in 0..steps as usize {
            let share = (k + 1) as f64 / steps;
            by.machine.inputs_between(&from.inputs, &to.inputs, share, &mut scratch.after);
            if !self.predict(by, from.t + dt * k as f64, dt, scratch) {
                return false;
            }
            std::mem::swap(&mut scratch.before, &mut scratch.after);
        }
        self.correct(by, to, scratch, gate, learn);
        self.filter.state().iter().all(|v| v.is_finite())
    }

    /// Goes over `dt` seconds.
    fn predict(&mut self, by: &Conditions<'_>, from: f64, dt: f64, scratch: &mut Scratch) -> bool {
        let Scratch { step, wide, noise, before, after, .. } = scratch;
        let system = &by.machine.system;
        let (nx, np, width) = (system.nx, by.machine.free().len(), self.count(by.machine));
        noise.clear();
        noise.resize(nx, 0.0);
        for rate in &by.usual.rates {
            noise[rate.entry] = rate.variance(self.filter.state(), dt).sqrt();
        }
        let span = Span { earlier: by.earlier, from, dt, before, after };
        let (x, by_effects) = (self.filter.state(), self.filter.sensitivity());
        let start = Beginning { x, by_effects, past: &mut self.past };
        if !by.machine.step(&by.place.values, start, &span, step) {
            return false;
        }
        wide.clear();
        wide.resize(nx * width, 0.0);
        for i in 0..nx {
            let row = &mut wide[i * width..(i + 1) * width];
            row[..np].copy_from_slice(&step.by_parameters[i * np..(i + 1) * np]);
            row[np..].iter_mut().zip(others(&step.by_others, i, nx)).for_each(|(w, d)| *w = *d);
        }
        for (j, force) in by.place.forces.iter().enumerate() {
            let top = system.offsets[j] + system.orders[j] - 1;
            if self.effects == Effects::Everything {
                wide[top * width + np + j] += dt;
            }
            step.state[top] += force * dt;
            for c in 0..system.ny {
                step.outputs[c] += step.outputs_by_state[c * nx + top] * force * dt;
            }
        }
        self.filter.predict(&Predicted {
            state: &step.state,
            by_state: &step.by_state,
            by_parameters: wide,
            noise,
            memory: (-dt / by.memory).exp(),
        })
    }

    /// Corrects the state by what was measured.
    fn correct(
        &mut self,
        by: &Conditions<'_>,
        to: &Sample,
        scratch: &mut Scratch,
        mut gate: Option<Gate<'_>>,
        learn: impl FnMut(usize, Innovation<'_>),
    ) {
        let Scratch { step, rows, .. } = scratch;
        let system = &by.machine.system;
        let (nx, ny, np, width) = (system.nx, system.ny, by.machine.free().len(), self.count(by.machine));
        rows.clear();
        rows.resize(ny * width, 0.0);
        for c in 0..ny {
            rows[c * width..c * width + np]
                .copy_from_slice(&step.outputs_by_parameters[c * np..(c + 1) * np]);
            let row = &mut rows[c * width + np..(c + 1) * width];
            row.iter_mut().zip(others(&step.outputs_by_others, c, ny)).for_each(|(r, d)| *r = *d);
            if self.effects == Effects::Everything {
                row[system.nz + c] += 1.0;
            }
        }
        let by_state = |c: usize| &step.outputs_by_state[c * nx..(c + 1) * nx];
        let errors = &mut scratch.errors;
        errors.clear();
        errors.extend((0..ny).map(|c| {
            let error = to.measured[c].map_or(f64::NAN, |y| y - step.outputs[c] - by.place.offsets[c]);
            let innovation = |noise| error / self.filter.deviation_of(by_state(c), noise);
            let taken = match &mut gate {
                Some(gate) if error.is_finite() => gate.takes(c, innovation(by.usual.noise[c])),
                _ => true,
            };
            if taken { error } else { f64::NAN }
        }));
        let measured = (0..ny).map(|c| Measured {
            error: errors[c],
            by_state: by_state(c),
            by_parameters: &rows[c * width..(c + 1) * width],
            noise: by.usual.noise[c],
        });
        self.filter.correct(measured, learn);
    }
}

/// Row `i` of `rows`.
fn others(derivatives: &[f64], i: usize, rows: usize) -> &[f64] {
    let width = derivatives.len() / rows;
    &derivatives[i * width..(i + 1) * width]
}

fn count(machine: &Machine, effects: Effects) -> usize {
    let parameters = machine.free().len();
    match effects {
        Effects::Parameters => parameters,
        Effects::Everything => parameters + machine.system.nz + machine.system.ny,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Which of a channel's innovations are taken.
    fn taken(innovations: &[f64]) -> Vec<bool> {
        let (mut before, mut alone) = ([Before::default()], [false]);
        let mut gate = Gate { before: &mut before, alone: &mut alone };
        innovations.iter().map(|v| gate.takes(0, *v)).collect()
    }

    #[test]
    fn a_value_that_stands_alone_is_not_taken() {
        // One value, and every other one.
        assert_eq!(taken(&[0.5, 50.0, -1.0, 0.3]), [true, false, true, true]);
        assert_eq!(taken(&[0.5, -1e99, 1.0, 1e99, 0.0]), [true, false, true, false, true]);
        assert_eq!(taken(&[0.5, 1e99, 1e99, 0.0, 1.0, 1.0]), [true, false, true, false, true, true]);
        // What grows is what the machine does, and what stays is what the sensor does now.
        assert!(taken(&[0.0, 3.0, 9.0, 17.0, 24.0, 20.0, 12.0, 4.0]).iter().all(|t| *t));
        assert_eq!(taken(&[0.0, 30.0, 29.0, 31.0, 0.0, 0.5]), [true, false, true, true, false, true]);
        // Where all are large, so must one be that stands alone.
        let loud: Vec<f64> = (0..200).map(|k| if k % 2 == 0 { 4.0 } else { -4.0 }).chain([25.0]).collect();
        assert!(taken(&loud).iter().all(|t| *t));
        // White innovations of a standard deviation that is half as large again.
        assert!(taken(&[4.0, -4.0, 4.2, -3.9]).iter().all(|t| *t));
        assert_eq!(taken(&[f64::NAN, 0.0]), [true, true]);
    }
}
