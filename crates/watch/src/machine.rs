//! A model as a filter needs it: from one sample to the next with all derivatives.

use std::sync::Arc;

use greybox_model::{Hold, Model, System};
use greybox_simulate::{Environment, Method, Past, Seeds, Signal, SignalLanes, Simulation, delays};

use crate::sample::Sample;

/// How far back what is delayed is remembered, over the longest delay when a machine is first seen: a delay may grow.
const REACH: f64 = 2.0;
/// How many times finer than the samples the grid of the inputs before a step may be: it is as fine as the step, and two samples may
/// lie next to each other. A shorter step takes for a delayed input what it was a little later, for less than this share of a sample.
const FINEST: usize = 16;

/// Signals of an input at both ends of a step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span<'a> {
    /// Samples before it, of which a delayed input takes its values.
    pub(crate) earlier: &'a [Sample],
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
    /// Seconds of the past that are remembered; zero where nothing is delayed.
    pub(crate) reach: f64,
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
    /// By other effects, through what is delayed alone.
    pub(crate) by_others: Vec<f64>,
    pub(crate) outputs_by_others: Vec<f64>,
    by_lanes: Vec<f64>,
}

/// Where a step begins.
#[derive(Debug)]
pub(crate) struct Beginning<'a> {
    pub(crate) x: &'a [f64],
    /// How x depends on the effects: a row for each entry, the parameters that may move first.
    pub(crate) by_effects: &'a [f64],
    /// What the delayed expressions were; after the step, what they were by then.
    pub(crate) past: &'a mut Vec<Past>,
}

impl Machine {
    /// A machine whose parameters are first seen at `values`.
    pub(crate) fn new(
        model: Model,
        system: Arc<System>,
        method: Method,
        free: Vec<usize>,
        values: &[f64],
    ) -> Machine {
        // (Between its last two samples a band-limited signal is a line: the next ones are not known.)
        let holds = model
            .inputs
            .iter()
            .map(|i| if i.hold == Hold::BandLimited { Hold::Linear } else { i.hold })
            .collect();
        let reach = REACH * delays(&system, values).into_iter().fold(0.0, f64::max);
        // (Forces and offsets have lanes for what is delayed.)
        let lanes = if reach > 0.0 { system.nz + system.ny } else { 0 };
        let signals = SignalLanes { lanes, ..SignalLanes::default() };
        let seeds = Seeds { parameters: free, initial: (0..system.nx).collect(), signals: signals.into() };
        Machine { model, system, method, holds, seeds, reach }
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

    /// The inputs of a span, and on its grid those before it that are remembered; how many intervals these are.
    fn signals(&self, span: &Span<'_>) -> (Vec<Signal>, usize) {
        let Span { earlier, from, dt, before, after } = *span;
        let first = earlier.first().map_or(from, |s| s.t);
        let back = (self.reach.min(from - first).max(0.0) / dt).ceil() as usize;
        let back = back.min(FINEST * earlier.len());
        let mut grid: Vec<Vec<f64>> = vec![Vec::with_capacity(back + 2); self.holds.len()];
        let mut next = earlier.partition_point(|s| s.t <= from - (back as f64 - 0.5) * dt);
        for k in (1..=back).rev() {
            let t = from - k as f64 * dt;
            // (A held value is that of the nearest sample: times may be a little early or late.)
            while next < earlier.len() && earlier[next].t <= t + 0.5 * dt {
                next += 1;
            }
            for (i, (values, hold)) in grid.iter_mut().zip(&self.holds).enumerate() {
                values.push(match hold {
                    Hold::Zero => earlier[next.max(1) - 1].inputs[i],
                    _ => at(earlier, next, (from, before), t, i),
                });
            }
        }
        let ends = before.iter().zip(after);
        let signals = grid.into_iter().zip(&self.holds).zip(ends).map(|((mut values, hold), (a, b))| {
            values.extend([*a, *b]);
            Signal::new(*hold, dt, &values, |_| Vec::new())
        });
        (signals.collect(), back)
    }

    /// Goes from a state over a span. `false` where the simulation leaves every bound.
    pub(crate) fn step(
        &self,
        parameters: &[f64],
        from: Beginning<'_>,
        span: &Span<'_>,
        out: &mut Step,
    ) -> bool {
        let (inputs, back) = self.signals(span);
        let start = span.from - back as f64 * span.dt;
        let environment = Environment { start, dt: span.dt, len: back + 2, inputs, forces: Vec::new() };
        let simulation = Simulation {
            system: &self.system,
            environment: &environment,
            parameters,
            method: self.method,
            seeds: &self.seeds,
        };
        let mut stepper = simulation.stepper_from(back, from.x, from.past);
        if !stepper.step() {
            return false;
        }
        let (nx, np) = (self.system.nx, self.seeds.parameters.len());
        out.state.clear();
        out.state.extend_from_slice(stepper.state());
        out.by_state.clear();
        out.by_parameters.clear();
        out.by_others.clear();
        for entry in 0..nx {
            let tangents = stepper.tangents(entry);
            out.by_parameters.extend_from_slice(&tangents[..np]);
            out.by_state.extend_from_slice(&tangents[np..np + nx]);
            out.by_others.extend_from_slice(&tangents[np + nx..]);
        }
        for entry in 0..nx {
            let tangents = stepper.tangents_mut(entry);
            tangents[..np].fill(0.0);
            tangents[np + nx..].fill(0.0);
        }
        self.by_lanes(from.by_effects, &mut out.by_lanes);
        stepper.restart_lanes_after(&out.by_lanes);
        if self.reach > 0.0 {
            *from.past = stepper.past(self.reach);
        }
        stepper.observe();
        out.outputs.clear();
        out.outputs_by_state.clear();
        out.outputs_by_parameters.clear();
        out.outputs_by_others.clear();
        for channel in 0..self.system.ny {
            out.outputs.push(stepper.output(channel));
            let tangents = stepper.output_tangents(channel);
            out.outputs_by_parameters.extend_from_slice(&tangents[..np]);
            out.outputs_by_state.extend_from_slice(&tangents[np..np + nx]);
            out.outputs_by_others.extend_from_slice(&tangents[np + nx..]);
        }
        [&out.state, &out.by_state, &out.by_parameters, &out.outputs]
            .iter()
            .all(|v| v.iter().all(|v| v.is_finite()))
    }

    /// Rows of derivatives by effects, of which there may be fewer, as rows by the lanes of the parameters and the other effects.
    fn by_lanes(&self, by_effects: &[f64], out: &mut Vec<f64>) {
        let lanes = self.seeds.parameters.len() + self.seeds.signals.lanes;
        out.clear();
        for row in by_effects.chunks_exact((by_effects.len() / self.system.nx.max(1)).max(1)) {
            out.extend(row.iter().copied().chain(std::iter::repeat(0.0)).take(lanes));
        }
    }

    /// Moves what was delayed as far as effects that move by `change` take it.
    pub(crate) fn follow(&self, past: &mut [Past], change: &[f64]) {
        let (np, nx) = (self.seeds.parameters.len(), self.system.nx);
        let parameters = change.iter().take(np).enumerate();
        let others = change.iter().skip(np).take(self.seeds.signals.lanes).enumerate();
        let changes: Vec<(usize, f64)> =
            parameters.map(|(l, c)| (l, *c)).chain(others.map(|(l, c)| (np + nx + l, *c))).collect();
        let lanes = self.seeds.lanes().max(1);
        for past in past {
            for (value, row) in past.value.iter_mut().zip(past.lanes.chunks_exact(lanes)) {
                *value += changes.iter().map(|(l, c)| row[*l] * c).sum::<f64>();
            }
        }
    }

    /// Whether a past is that of all delayed expressions, or none.
    pub(crate) fn has(&self, past: &[Past]) -> bool {
        let delayed = self.system.rhs.delays.len();
        (past.is_empty() || past.len() == delayed) && past.iter().all(|p| p.is_consistent(self.seeds.lanes()))
    }
}

/// An input that is linear between samples, at the time `t`; `next` is the first of the `earlier` samples that is clearly later,
/// and after the last of them comes the sample `before` the span, at its beginning `from`.
fn at(earlier: &[Sample], next: usize, (from, before): (f64, &[f64]), t: f64, input: usize) -> f64 {
    let sample = |k: usize| earlier.get(k).map_or((from, before[input]), |s| (s.t, s.inputs[input]));
    let middle = next.max(1) - 1;
    // (The nearest sample may be on either side.)
    let low = if sample(middle).0 > t { middle.max(1) - 1 } else { middle };
    let ((t0, u0), (t1, u1)) = (sample(low), sample(low + 1));
    if t1 > t0 { u0 + (u1 - u0) * ((t - t0) / (t1 - t0)).clamp(0.0, 1.0) } else { u1 }
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
        Machine::new(model, system, Method::Rk4 { substeps: 2 }, vec![1, 2], &[2.0, 0.6, 8.0])
    }

    /// From a state that depends on nothing.
    fn beginning<'a>(x: &'a [f64], past: &'a mut Vec<Past>) -> Beginning<'a> {
        Beginning { x, by_effects: &[], past }
    }

    /// State and output after a step, and what differences say of their derivatives.
    #[test]
    fn the_derivatives_of_a_step_are_those_of_differences() {
        let machine = machine();
        let span = Span { earlier: &[], from: 3.0, dt: 0.05, before: &[1.0, 0.2], after: &[-1.0, 0.3] };
        let at = |p: [f64; 3], x: [f64; 2]| {
            let mut step = Step::default();
            assert!(machine.step(&p, beginning(&x, &mut Vec::new()), &span, &mut step));
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

    const LATE: &str = r#"
[inputs]
u = { unit = "N", hold = "zero" }
w = { unit = "m" }
[parameters]
m = { value = 2.0, unit = "kg", fixed = true }
c = { value = 0.6, unit = "N*s/m" }
k = { value = 8.0, unit = "N/m" }
tau = { value = 0.13, unit = "s" }
[states]
x = { unit = "m" }
[equations]
body = "m*x'' + c*x' + 0.4*k*x + 0.6*k*delay(x, 0.5*tau) = delay(u, tau) + k*delay(w, tau)"
"#;

    /// Steps from sample to sample, each from where the last one ended, are the simulation of all of them, and so are their
    /// derivatives, put together: what is delayed, of the state and of inputs of either hold, was what it was, and depends on what
    /// it depended on.
    #[test]
    fn steps_remember_what_is_delayed() {
        let model = Model::from_toml(LATE, "late.toml").unwrap();
        let system = Arc::new(System::compile(&model).unwrap());
        let (values, method, dt) = ([2.0, 0.6, 8.0, 0.13], Method::Dp5 { substeps: 2 }, 0.05);
        let machine = Machine::new(model, system.clone(), method, vec![1, 3], &values);
        let inputs = |k: usize| vec![(1.3 * k as f64).sin(), (0.4 * k as f64).cos()];
        let samples: Vec<Sample> = (0..200)
            .map(|k| Sample { t: 7.0 + dt * k as f64, inputs: inputs(k), measured: vec![None] })
            .collect();
        let column = |i: usize| samples.iter().map(|s| s.inputs[i]).collect::<Vec<f64>>();
        let signal = |i: usize| Signal::new(machine.holds[i], dt, &column(i), |_| Vec::new());
        let environment =
            Environment { start: 7.0, dt, len: 200, inputs: vec![signal(0), signal(1)], forces: Vec::new() };
        let seeds = Seeds { parameters: vec![1, 3], initial: vec![0, 1], ..Seeds::default() };
        let (system, environment) = (&*system, &environment);
        let whole = Simulation { system, environment, parameters: &values, method, seeds: &seeds };
        let mut whole = whole.stepper(&[0.4, -0.7]);

        let (mut past, mut step) = (Vec::new(), Step { state: vec![0.4, -0.7], ..Step::default() });
        let mut by_effects = vec![0.0; 4];
        for k in 0..199usize {
            // (As far back as is remembered, and a sample more or less.)
            let earlier = &samples[k.saturating_sub(5 + k % 3)..k];
            let (before, after) = (&samples[k].inputs[..], &samples[k + 1].inputs[..]);
            let span = Span { earlier, from: samples[k].t, dt, before, after };
            let x = step.state.clone();
            let start = Beginning { x: &x, by_effects: &by_effects, past: &mut past };
            assert!(whole.step() && machine.step(&values, start, &span, &mut step));
            let before = by_effects.clone();
            for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                let through: f64 = (0..2).map(|k| step.by_state[i * 2 + k] * before[k * 2 + j]).sum();
                by_effects[i * 2 + j] = step.by_parameters[i * 2 + j] + through;
                let (found, right) = (by_effects[i * 2 + j], whole.tangents(i)[j]);
                assert!((found - right).abs() < 1e-10, "{k} {i} {j}: {found} {right}");
            }
            for (found, right) in step.state.iter().zip(whole.state()) {
                assert!((found - right).abs() < 1e-11, "{k}: {found} {right}");
            }
            assert!(past[0].time.len() < 14, "{}", past[0].time.len());
        }
    }

    /// By how much a longer delay moves the state after a step, whatever was before.
    #[test]
    fn the_derivative_by_a_delay_is_that_of_differences() {
        let model = Model::from_toml(&LATE.replace("\"zero\"", "\"linear\""), "late.toml").unwrap();
        let system = Arc::new(System::compile(&model).unwrap());
        let machine =
            Machine::new(model, system, Method::Dp5 { substeps: 2 }, vec![1, 3], &[2.0, 0.6, 8.0, 0.13]);
        let sample = |k: usize| Sample {
            t: 0.05 * k as f64,
            inputs: vec![(1.3 * k as f64).sin(), (0.4 * k as f64).cos()],
            measured: vec![None],
        };
        let earlier: Vec<Sample> = (0..9).map(sample).collect();
        let (before, after) = (sample(9).inputs, sample(10).inputs);
        let span = Span { earlier: &earlier, from: 0.45, dt: 0.05, before: &before, after: &after };
        let time: Vec<f64> = (0..10).map(|k| 0.05 * f64::from(k) - 0.45).collect();
        let value: Vec<f64> = time.iter().map(|t| (3.0 * t).sin()).collect();
        let slope: Vec<f64> = time.iter().map(|t| 3.0 * (3.0 * t).cos()).collect();
        let known = vec![Past { time, value, slope, lanes: Vec::new() }; 3];
        let at = |tau: f64| {
            let mut step = Step::default();
            assert!(machine.step(
                &[2.0, 0.6, 8.0, tau],
                beginning(&[0.0, 3.0], &mut known.clone()),
                &span,
                &mut step
            ));
            step
        };
        let h = 1e-5;
        let (low, step, high) = (at(0.13 - h), at(0.13), at(0.13 + h));
        for i in 0..2 {
            let difference = (high.state[i] - low.state[i]) / (2.0 * h);
            let tangent = step.by_parameters[i * 2 + 1];
            assert!(
                (tangent - difference).abs() < 1e-6 && tangent.abs() > 1e-3,
                "{i}: {tangent} {difference}"
            );
        }
    }

    /// Times that are a little early or late do not move a delayed input by a sample.
    #[test]
    fn a_clock_that_jitters_moves_no_delayed_input() {
        let model = Model::from_toml(LATE, "late.toml").unwrap();
        let system = Arc::new(System::compile(&model).unwrap());
        let machine =
            Machine::new(model, system, Method::Rk4 { substeps: 1 }, vec![1], &[2.0, 0.6, 8.0, 0.13]);
        let t = |k: usize| 0.05 * k as f64 + if k.is_multiple_of(2) { 0.01 } else { -0.01 };
        let earlier: Vec<Sample> =
            (0..8).map(|k| Sample { t: t(k), inputs: vec![k as f64, t(k)], measured: vec![None] }).collect();
        let (before, after) = ([8.0, t(8)], [9.0, t(9)]);
        let span = Span { earlier: &earlier, from: t(8), dt: 0.05, before: &before, after: &after };
        let (signals, back) = machine.signals(&span);
        assert_eq!(back, 6);
        for k in 2..8 {
            let s = 0.05 * (k as f64 - 2.0);
            assert_eq!(signals[0].at(s + 0.025, s + 0.025).0, k as f64);
            // (Linear in time: the same value wherever the samples are.)
            assert!((signals[1].at(s, s).0 - (t(8) + s - 0.3)).abs() < 1e-12);
        }
    }

    /// A sample a nanosecond after another asks for no grid of nanoseconds.
    #[test]
    fn a_tiny_step_asks_for_no_more_than_what_is_remembered() {
        let model = Model::from_toml(LATE, "late.toml").unwrap();
        let system = Arc::new(System::compile(&model).unwrap());
        let machine =
            Machine::new(model, system, Method::Rk4 { substeps: 1 }, vec![1], &[2.0, 0.6, 8.0, 0.13]);
        let earlier: Vec<Sample> = (0..8)
            .map(|k| Sample { t: 0.05 * f64::from(k), inputs: vec![1.0, 2.0], measured: vec![None] })
            .collect();
        let (before, after) = ([1.0, 2.0], [1.0, 2.0]);
        let span = Span { earlier: &earlier, from: 0.4, dt: 1e-9, before: &before, after: &after };
        assert_eq!(machine.signals(&span).1, 8 * FINEST);
        let mut step = Step::default();
        assert!(machine.step(
            &[2.0, 0.6, 8.0, 0.13],
            beginning(&[0.3, 0.1], &mut Vec::new()),
            &span,
            &mut step
        ));
        assert!((step.state[0] - 0.3).abs() < 1e-9, "{:?}", step.state);
    }
}
