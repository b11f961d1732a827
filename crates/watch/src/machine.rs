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

    /// Inputs on the way from one sample to the next, where samples are missing between them; `share` of it is behind.
    pub(crate) fn inputs_between(&self, from: &[f64], to: &[f64], share: f64, out: &mut Vec<f64>) {
        let between = self.holds.iter().zip(from.iter().zip(to));
        out.clear();
        out.extend(between.map(|(hold, (a, b))| match hold {
            Hold::Zero if share < 1.0 => *a,
            _ => a + share * (b - a),
        }));
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

#[cfg(test)]
mod tests {
    use super::*;

    const MODEL: &str = r#"
[inputs]
u = { unit = "N", hold = "zero" }
w = { unit = "m" }
[parameters]
m = { value = 2.0, unit = "kg", fixed = true }
c = { value = 0.6, unit = "N*s/m" }
k = { value = 8.0, unit = "N/m" }
[states]
x = { unit = "m" }
[equations]
body = "m*x'' + c*x' + k*(x - w) = u"
"#;

    fn machine() -> Machine {
        let model = Model::from_toml(MODEL, "body.toml").unwrap();
        let system = Arc::new(System::compile(&model).unwrap());
        Machine::new(model, system, Method::Rk4 { substeps: 2 }, vec![1, 2])
    }

    /// State and output after a step, and what differences say of their derivatives.
    #[test]
    fn the_derivatives_of_a_step_are_those_of_differences() {
        let machine = machine();
        let span = Span { from: 3.0, dt: 0.05, before: &[1.0, 0.2], after: &[-1.0, 0.3] };
        let at = |p: [f64; 3], x: [f64; 2]| {
            let mut step = Step::default();
            assert!(machine.step(&p, &x, &span, &mut step));
            step
        };
        let (p, x, h) = ([2.0, 0.6, 8.0], [0.4, -0.7], 1e-5);
        let step = at(p, x);
        for i in 0..2 {
            for j in 0..2 {
                let moved = |sign: f64| {
                    let (mut q, mut y) = (p, x);
                    q[j + 1] += sign * h;
                    y[j] += sign * h;
                    (at(q, x).state[i], at(p, y).state[i])
                };
                let ((high_p, high_x), (low_p, low_x)) = (moved(1.0), moved(-1.0));
                let by_parameter = (high_p - low_p) / (2.0 * h);
                let by_state = (high_x - low_x) / (2.0 * h);
                assert!((step.by_parameters[i * 2 + j] - by_parameter).abs() < 1e-8);
                assert!((step.by_state[i * 2 + j] - by_state).abs() < 1e-8);
            }
        }
        assert_eq!(step.outputs, [step.state[0]]);
        assert_eq!(
            (&step.outputs_by_state[..], &step.outputs_by_parameters[..]),
            (&[1.0, 0.0][..], &[0.0; 2][..])
        );
    }

    #[test]
    fn a_held_input_stays_where_samples_are_missing() {
        let machine = machine();
        let mut between = Vec::new();
        machine.inputs_between(&[1.0, 1.0], &[3.0, 3.0], 0.25, &mut between);
        assert_eq!(between, [1.0, 1.5]);
        machine.inputs_between(&[1.0, 1.0], &[3.0, 3.0], 1.0, &mut between);
        assert_eq!(between, [3.0, 3.0]);
    }
}
