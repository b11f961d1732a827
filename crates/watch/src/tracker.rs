//! A filter on a model: from sample to sample, and what each innovation tells of parameters, forces and offsets.

use greybox_recursive::{Filter, Innovation, Measured, Predicted, RecursiveError};
use serde::{Deserialize, Serialize};

use crate::learn::{Sample, Usual};
use crate::machine::{Machine, Span, Step};

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
}

/// What one sample is predicted with.
pub(crate) struct Conditions<'a> {
    pub(crate) machine: &'a Machine,
    pub(crate) usual: &'a Usual,
    /// All parameters, SI.
    pub(crate) values: &'a [f64],
    /// Seconds that the state remembers.
    pub(crate) memory: f64,
}

impl Tracker {
    pub(crate) fn new(
        machine: &Machine,
        (state, deviation): (&[f64], &[f64]),
        effects: Effects,
    ) -> Result<Tracker, RecursiveError> {
        Ok(Tracker { filter: Filter::new(state, deviation, count(machine, effects))?, effects })
    }

    /// States and effects, where the sizes of all parts agree.
    pub(crate) fn shape(&self) -> Option<(usize, usize, Effects)> {
        self.filter.shape().map(|(n, p)| (n, p, self.effects))
    }

    /// The state begins anew with this mean and these standard deviations.
    pub(crate) fn restart(&mut self, (mean, deviation): (&[f64], &[f64])) {
        self.filter.restart(mean, deviation);
    }

    /// Number of effects.
    pub(crate) fn count(&self, machine: &Machine) -> usize {
        count(machine, self.effects)
    }

    /// Goes to the next sample; `learn` receives channel and innovation. `false` where the model leaves every bound.
    pub(crate) fn advance(
        &mut self,
        by: &Conditions<'_>,
        from: &Sample,
        to: &Sample,
        learn: impl FnMut(usize, Innovation<'_>),
    ) -> bool {
        let (machine, usual) = (by.machine, by.usual);
        let system = &machine.system;
        let (nx, ny, np) = (system.nx, system.ny, machine.free().len());
        let width = self.count(machine);
        // As many steps as samples should have been.
        let seconds = to.t - from.t;
        let steps = (seconds / usual.dt).round().max(1.0);
        let dt = seconds / steps;
        let mut step = Step::default();
        let mut wide = vec![0.0; nx * width];
        let mut before = from.inputs.clone();
        for k in 0..steps as usize {
            let after = machine.inputs_between(&from.inputs, &to.inputs, (k + 1) as f64 / steps);
            let span = Span { from: from.t + dt * k as f64, dt, before: &before, after: &after };
            let mut noise = vec![0.0; nx];
            for rate in &usual.rates {
                noise[rate.entry] = rate.variance(self.filter.state(), dt).sqrt();
            }
            if !machine.step(by.values, self.filter.state(), &span, &mut step) {
                return false;
            }
            for i in 0..nx {
                wide[i * width..i * width + np].copy_from_slice(&step.by_parameters[i * np..(i + 1) * np]);
            }
            if self.effects == Effects::Everything {
                for j in 0..system.nz {
                    wide[(system.offsets[j] + system.orders[j] - 1) * width + np + j] = dt;
                }
            }
            let predicted = Predicted {
                state: &step.state,
                by_state: &step.by_state,
                by_parameters: &wide,
                noise: &noise,
                memory: (-dt / by.memory).exp(),
            };
            if !self.filter.predict(&predicted) {
                return false;
            }
            before = after;
        }
        let mut rows = vec![0.0; ny * width];
        for c in 0..ny {
            rows[c * width..c * width + np]
                .copy_from_slice(&step.outputs_by_parameters[c * np..(c + 1) * np]);
            if self.effects == Effects::Everything {
                rows[c * width + np + system.nz + c] = 1.0;
            }
        }
        let measured = (0..ny).map(|c| Measured {
            error: to.measured[c].map_or(f64::NAN, |y| y - step.outputs[c]),
            by_state: &step.outputs_by_state[c * nx..(c + 1) * nx],
            by_parameters: &rows[c * width..(c + 1) * width],
            noise: usual.noise[c],
        });
        self.filter.correct(measured, learn);
        self.filter.state().iter().all(|v| v.is_finite())
    }
}

fn count(machine: &Machine, effects: Effects) -> usize {
    let parameters = machine.free().len();
    match effects {
        Effects::Parameters => parameters,
        Effects::Everything => parameters + machine.system.nz + machine.system.ny,
    }
}
