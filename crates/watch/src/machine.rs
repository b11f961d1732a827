//! A model as a filter needs it: from one sample to the next with all derivatives.

use std::sync::Arc;

use greybox_model::{Hold, Model, System};
use greybox_simulate::{Environment, Method, Seeds, Signal, Simulation};

/// Signals of an input at both ends of a step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span<'a> {
    /// Time of the sample before, s.
    pub(crate) from: f64,
    /// Seconds.
    pub(crate) dt: f64,
    /// Inputs there, SI.
    pub(crate) before: &'a [f64],
    /// Inputs at the end, SI.
    pub(crate) after: &'a [f64],
}

/// A compiled model and the parameters that may move.
#[derive(Debug, Clone)]
pub(crate) struct Machine {
    pub(crate) model: Model,
    pub(crate) system: Arc<System>,
    method: Method,
    holds: Vec<Hold>,
    seeds: Seeds,
}

/// A step of the model and what it measures there; matrices row by row.
#[derive(Debug, Clone, Default)]
pub(crate) struct Step {
    pub(crate) state: Vec<f64>,
    pub(crate) by_state: Vec<f64>,
    pub(crate) by_parameters: Vec<f64>,
    pub(crate) outputs: Vec<f64>,
    pub(crate) outputs_by_state: Vec<f64>,
    pub(crate) outputs_by_parameters: Vec<f64>,
}

impl Machine {
    pub(crate) fn new(model: Model, system: Arc<System>, method: Method, free: Vec<usize>) -> Machine {
        // (Between its last two samples a band-limited signal is a line: the next ones are not known.)
        let holds = model
            .inputs
            .iter()
            .map(|i| if i.hold == Hold::BandLimited { Hold::Linear } else { i.hold })
            .collect();
        let seeds = Seeds { parameters: free, initial: (0..system.nx).collect(), ..Seeds::default() };
        Machine { model, system, method, holds, seeds }
    }

    /// Indices of the parameters that may move.
    pub(crate) fn free(&self) -> &[usize] {
        &self.seeds.parameters
    }

    /// Goes from the state `x` over a span. `false` where the simulation leaves every bound.
    pub(crate) fn step(&self, parameters: &[f64], x: &[f64], span: &Span<'_>, out: &mut Step) -> bool {
        let inputs = self
            .holds
            .iter()
            .zip(span.before.iter().zip(span.after))
            .map(|(hold, (a, b))| Signal::new(*hold, span.dt, &[*a, *b], |_| Vec::new()))
            .collect();
        let environment = Environment { start: span.from, dt: span.dt, len: 2, inputs, forces: Vec::new() };
        let simulation = Simulation {
            system: &self.system,
            environment: &environment,
            parameters,
            method: self.method,
            seeds: &self.seeds,
        };
        let mut stepper = simulation.stepper(x);
        if !stepper.step() {
            return false;
        }
        let np = self.seeds.parameters.len();
        out.state.clear();
        out.state.extend_from_slice(stepper.state());
        out.by_state.clear();
        out.by_parameters.clear();
        for entry in 0..self.system.nx {
            let tangents = stepper.tangents(entry);
            out.by_parameters.extend_from_slice(&tangents[..np]);
            out.by_state.extend_from_slice(&tangents[np..]);
        }
        for entry in 0..self.system.nx {
            stepper.tangents_mut(entry)[..np].fill(0.0);
        }
        stepper.restart_lanes();
        stepper.observe();
        out.outputs.clear();
        out.outputs_by_state.clear();
        out.outputs_by_parameters.clear();
        for channel in 0..self.system.ny {
            out.outputs.push(stepper.output(channel));
            let tangents = stepper.output_tangents(channel);
            out.outputs_by_parameters.extend_from_slice(&tangents[..np]);
            out.outputs_by_state.extend_from_slice(&tangents[np..]);
        }
        [&out.state, &out.by_state, &out.by_parameters, &out.outputs]
            .iter()
            .all(|v| v.iter().all(|v| v.is_finite()))
    }
}
