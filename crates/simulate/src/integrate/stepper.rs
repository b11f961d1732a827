//! A simulation that goes from sample to sample and may be set elsewhere at each of them.

use super::history::{History, Past};
use super::{Core, Simulation};

/// A simulation that goes from sample to sample: its state, and the tangents of the state, may be set at each of them, as a
/// filter does that corrects its prediction by a measurement. Nothing is allocated per sample, unless an expression is
/// delayed.
///
/// The lanes of the tangents are those of [`Seeds`](crate::Seeds): parameters, then initial states, then signals. What the
/// state was before a sample goes into the past of delayed expressions as it was predicted; the new state counts from the
/// sample on.
///
/// ```
/// # use greybox_model::{Model, System};
/// use greybox_simulate::{Environment, Method, Seeds, Simulation};
/// # let model = Model::from_toml(r#"
/// # [parameters]
/// # a = { value = 2.0, unit = "1/s" }
/// # [states]
/// # x = { unit = "m" }
/// # [equations]
/// # decay = "x' + a*x = 0"
/// # "#, "model.toml").unwrap();
/// # let system = System::compile(&model).unwrap();
/// let environment = Environment { start: 0.0, dt: 0.01, len: 100, inputs: vec![], forces: vec![] };
/// let seeds = Seeds { initial: vec![0], ..Seeds::default() };
/// let simulation = Simulation {
///     system: &system,
///     environment: &environment,
///     parameters: &[2.0],
///     method: Method::Rk4 { substeps: 1 },
///     seeds: &seeds,
/// };
/// let mut stepper = simulation.stepper(&[1.0]);
/// assert!(stepper.step());
/// let decay = (-0.02f64).exp();
/// assert!((stepper.state()[0] - decay).abs() < 1e-9);
/// stepper.set_state(&[5.0]);
/// stepper.tangents_mut(0)[0] = 1.0;
/// assert!(stepper.step());
/// assert!((stepper.state()[0] - 5.0 * decay).abs() < 1e-8 && (stepper.tangents(0)[0] - decay).abs() < 1e-9);
/// ```
pub struct Stepper<'a> {
    core: Core<'a>,
    sample: usize,
    /// The state was set here, and the past of delayed expressions does not know yet.
    moved: bool,
    /// Entries of the past that depend on no initial state of the present lanes.
    known: Vec<usize>,
}

/// Entries of the past that are kept beyond those in reach, so that it is cut but now and then.
const SPARE: usize = 256;

impl<'a> Simulation<'a> {
    /// A simulation from the state `x0` (`system.nx` entries, SI) at the first sample that goes on one sample at a time.
    pub fn stepper(&self, x0: &[f64]) -> Stepper<'a> {
        let mut core = Core::new(self, x0, 0.0);
        core.start_modes();
        let known = vec![0; core.rhs_history.len()];
        Stepper { core, sample: 0, moved: false, known }
    }

    /// A simulation that goes on at `sample` from the state `x0`, where the delayed expressions of the equations were what
    /// `past` says of each: a stepper that was at that sample leaves it ([`Stepper::past`]). An expression without a past
    /// holds its initial value. The past depends on the lanes as it says, but not on those of the initial states.
    ///
    /// ```
    /// # use greybox_model::{Model, System};
    /// use greybox_simulate::{Environment, Method, Seeds, Simulation};
    /// # let model = Model::from_toml(r#"
    /// # [parameters]
    /// # a = { value = 1.0, unit = "1/s" }
    /// # tau = { value = 0.25, unit = "s" }
    /// # [states]
    /// # x = { unit = "m" }
    /// # [equations]
    /// # late = "x' + a*delay(x, tau) = 0"
    /// # "#, "model.toml").unwrap();
    /// # let system = System::compile(&model).unwrap();
    /// let environment = Environment { start: 0.0, dt: 0.01, len: 100, inputs: vec![], forces: vec![] };
    /// let simulation = Simulation {
    ///     system: &system,
    ///     environment: &environment,
    ///     parameters: &[1.0, 0.25],
    ///     method: Method::Rk4 { substeps: 1 },
    ///     seeds: &Seeds::default(),
    /// };
    /// let mut whole = simulation.stepper(&[1.0]);
    /// (0..40).for_each(|_| assert!(whole.step()));
    /// let mut rest = simulation.stepper_from(whole.sample(), whole.state(), &whole.past(0.25));
    /// (0..40).for_each(|_| assert!(whole.step() && rest.step()));
    /// assert!((rest.state()[0] - whole.state()[0]).abs() < 1e-12);
    /// ```
    pub fn stepper_from(&self, sample: usize, x0: &[f64], past: &[Past]) -> Stepper<'a> {
        let s = sample as f64 * self.environment.dt;
        let mut core = Core::new(self, x0, s);
        let lanes = core.lanes;
        for (history, past) in core.rhs_history.iter_mut().zip(past) {
            *history = History::known(past, s, lanes);
        }
        core.start_modes();
        let known = core.rhs_history.iter().map(|h| h.s.len().saturating_sub(1)).collect();
        Stepper { core, sample, moved: false, known }
    }
}

impl Stepper<'_> {
    /// The sample at which the simulation is.
    pub fn sample(&self) -> usize {
        self.sample
    }

    /// Evaluations of the right-hand side so far.
    pub fn evaluations(&self) -> usize {
        self.core.result.evaluations
    }

    /// The state, SI.
    pub fn state(&self) -> &[f64] {
        &self.core.x
    }

    /// Goes on from another state at the same sample.
    pub fn set_state(&mut self, x: &[f64]) {
        self.core.x.copy_from_slice(x);
        self.core.fresh = false;
        self.moved = true;
    }

    /// The tangents of an entry of the state along all lanes.
    pub fn tangents(&self, entry: usize) -> &[f64] {
        &self.core.d[self.core.at_dx..][entry * self.core.width..][..self.core.lanes]
    }

    /// The tangents of an entry of the state, to be changed.
    pub fn tangents_mut(&mut self, entry: usize) -> &mut [f64] {
        self.moved = true;
        &mut self.core.d[self.core.at_dx..][entry * self.core.width..][..self.core.lanes]
    }

    /// The lanes of the initial states begin anew: each is the derivative by its entry of the state as it is now. What was
    /// before does not depend on that.
    pub fn restart_lanes(&mut self) {
        self.restart_lanes_after(&[]);
    }

    /// As [`restart_lanes`](Self::restart_lanes), where the initial states of before depended on the other lanes: `by` has a
    /// row for each initial state, with the derivatives by the parameters and then by the signals of the
    /// [`Seeds`](crate::Seeds). What was before depends on these as its initial states did.
    pub fn restart_lanes_after(&mut self, by: &[f64]) {
        let (first, entries) = (self.core.seeds.parameters.len(), &self.core.seeds.initial);
        let (lanes, width) = (self.core.lanes, self.core.width);
        for i in 0..self.core.system.nx {
            for (l, entry) in entries.iter().enumerate() {
                self.core.d[self.core.at_dx + i * width + first + l] = f64::from(u8::from(i == *entry));
            }
        }
        let initial = first..first + entries.len();
        for (history, known) in self.core.rhs_history.iter_mut().zip(&mut self.known) {
            let end = history.s.len();
            for entry in history.lanes[*known * lanes..].chunks_exact_mut(lanes.max(1)) {
                for (l, by) in initial.clone().zip(by.chunks_exact((lanes - entries.len()).max(1))) {
                    let d = std::mem::take(&mut entry[l]);
                    entry[..first].iter_mut().zip(by).for_each(|(e, by)| *e += d * by);
                    entry[initial.end..].iter_mut().zip(&by[first..]).for_each(|(e, by)| *e += d * by);
                }
                entry[initial.clone()].fill(0.0);
            }
            // (The last entry is that of the state now: it is entered anew, with the lanes that begin here.)
            *known = end.saturating_sub(1);
        }
        self.moved = true;
    }

    /// Evaluates the outputs at this sample, for [`output`](Self::output) and [`output_tangents`](Self::output_tangents).
    pub fn observe(&mut self) {
        self.core.observe();
        let seeds = self.core.seeds;
        let (first, count) = (seeds.parameters.len() + seeds.initial.len(), seeds.signals.lanes);
        for (c, change) in &seeds.signals.outputs {
            let register = self.core.system.output.outputs[*c] as usize;
            let row = &mut self.core.out_d[register * self.core.width + first..][..count];
            let change = &change[self.sample * count..][..count];
            row.iter_mut().zip(change).for_each(|(d, v)| *d += v);
        }
    }

    /// The output of a channel when it was last observed, SI.
    pub fn output(&self, channel: usize) -> f64 {
        self.core.out_regs[self.core.system.output.outputs[channel] as usize]
    }

    /// The tangents of a channel's output along all lanes when it was last observed.
    pub fn output_tangents(&self, channel: usize) -> &[f64] {
        let register = self.core.system.output.outputs[channel] as usize;
        &self.core.out_d[register * self.core.width..][..self.core.lanes]
    }

    /// Goes on to the next sample. `false` where there is none, or where the solution has left every reasonable bound.
    pub fn step(&mut self) -> bool {
        if self.sample + 1 >= self.core.env.len || self.core.result.diverged.is_some() {
            return false;
        }
        if self.moved && !self.core.rhs_history.is_empty() {
            self.core.begin((self.sample + 1) as f64 * self.core.env.dt);
            self.core.remember(0);
        }
        self.moved = false;
        self.core.cross_interval(self.sample);
        self.sample += 1;
        self.core.s = self.sample as f64 * self.core.env.dt;
        self.forget();
        self.core.result.diverged.is_none()
    }

    /// What the delayed expressions of the equations were in the last `seconds`, as they were simulated.
    pub fn past(&self, seconds: f64) -> Vec<Past> {
        self.core.rhs_history.iter().map(|h| h.past(self.core.s, seconds, self.core.lanes)).collect()
    }

    /// Cuts off what no delay reaches any more.
    fn forget(&mut self) {
        let delays = &self.core.system.rhs.delays;
        for ((history, delay), known) in self.core.rhs_history.iter_mut().zip(delays).zip(&mut self.known) {
            let reach = self.core.stages[0].regs[delay.tau as usize].max(0.0) + self.core.env.dt;
            let old = history.s.partition_point(|s| *s <= self.core.s - reach).saturating_sub(1);
            if old > SPARE {
                history.cut(old, self.core.lanes);
                *known = known.saturating_sub(old);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use greybox_model::{Hold, Model, System};

    use crate::{Environment, Method, Seeds, Signal, Simulation};

    const LATE: &str = r#"
[inputs]
u = { unit = "m/s" }
[parameters]
a = { value = 3.0, unit = "1/s" }
tau = { value = 0.07, unit = "s" }
[states]
x = { unit = "m", initial = 0.2 }
[equations]
late = "x' + a*delay(x, tau) = u"
"#;

    /// The state after `n` steps where it is set to `x` at sample `k`, and its derivative by `x`.
    fn after(k: usize, x: f64, n: usize) -> (f64, f64) {
        let model = Model::from_toml(LATE, "late.toml").unwrap();
        let system = System::compile(&model).unwrap();
        let u: Vec<f64> = (0..400).map(|k| (0.1 * f64::from(k)).sin()).collect();
        let environment = Environment {
            start: 0.0,
            dt: 0.01,
            len: 400,
            inputs: vec![Signal::new(Hold::Linear, 0.01, &u, |_| Vec::new())],
            forces: Vec::new(),
        };
        let seeds = Seeds { initial: vec![0], ..Seeds::default() };
        let simulation = Simulation {
            system: &system,
            environment: &environment,
            parameters: &[3.0, 0.07],
            method: Method::Dp5 { substeps: 2 },
            seeds: &seeds,
        };
        let mut stepper = simulation.stepper(&[0.2]);
        for _ in 0..k {
            assert!(stepper.step());
        }
        stepper.set_state(&[x]);
        stepper.restart_lanes();
        for _ in 0..n {
            assert!(stepper.step());
        }
        (stepper.state()[0], stepper.tangents(0)[0])
    }

    /// With nothing set, a stepper is the simulation; a set state is felt after the delay, and the tangent says how much.
    #[test]
    fn tangents_of_a_state_that_was_set_are_its_derivatives_through_the_delay() {
        for (k, n) in [(150, 3), (150, 10), (150, 40), (390, 5)] {
            let h = 1e-4;
            let ((high, _), (low, _)) = (after(k, 0.3 + h, n), after(k, 0.3 - h, n));
            let (_, tangent) = after(k, 0.3, n);
            let difference = (high - low) / (2.0 * h);
            assert!((tangent - difference).abs() < 2e-3, "{k} {n}: {tangent} {difference}");
        }
        // Before the delay has passed since the start the state does not know its own past.
        assert!((after(150, 0.3, 3).1 - 1.0).abs() < 1e-9);
    }

    /// Lanes that begin anew at every sample: the state after a step does not depend on the one before it by what was delayed,
    /// as long as the delay is longer than the step.
    #[test]
    fn what_was_before_does_not_move_with_the_state_that_is_now() {
        let model = Model::from_toml(LATE, "late.toml").unwrap();
        let system = System::compile(&model).unwrap();
        let u: Vec<f64> = (0..60).map(|k| (0.1 * f64::from(k)).sin()).collect();
        let inputs = vec![Signal::new(Hold::Linear, 0.01, &u, |_| Vec::new())];
        let environment = Environment { start: 0.0, dt: 0.01, len: 60, inputs, forces: Vec::new() };
        let seeds = Seeds { initial: vec![0], ..Seeds::default() };
        let simulation = Simulation {
            system: &system,
            environment: &environment,
            parameters: &[3.0, 0.07],
            method: Method::Rk4 { substeps: 1 },
            seeds: &seeds,
        };
        let mut stepper = simulation.stepper(&[0.2]);
        let mut tangents = Vec::new();
        for _ in 0..40 {
            assert!(stepper.step());
            tangents.push(stepper.tangents(0)[0]);
            stepper.restart_lanes();
        }
        assert!(tangents[8..].iter().all(|d| (d - 1.0).abs() < 1e-12), "{tangents:?}");
        // And of one that goes on from the past of another.
        let mut rest = simulation.stepper_from(stepper.sample(), stepper.state(), &stepper.past(0.2));
        for _ in 0..10 {
            assert!(rest.step());
            assert!((rest.tangents(0)[0] - 1.0).abs() < 1e-12);
            rest.restart_lanes();
        }
    }
}
