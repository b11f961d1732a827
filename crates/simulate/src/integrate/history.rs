//! What a stretch remembers, and leaves to the next.

use greybox_model::system::System;

use super::{Seeds, input_leaf, state_leaf};

/// Past values of a delayed expression.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct History {
    pub(super) s: Vec<f64>,
    pub(super) value: Vec<f64>,
    pub(super) slope: Vec<f64>,
    pub(super) lanes: Vec<f64>,
    /// Ends where another stretch did; the next entry tells where this one starts.
    pub(super) seam: bool,
    /// Sensitivities of the first slope, where the expression goes straight on before its first value.
    pub(super) rate: Vec<f64>,
}

impl History {
    pub(super) fn push(&mut self, s: f64, value: f64, slope: f64, lanes: &[f64]) {
        if let Some(&last) = self.s.last()
            && s <= last
        {
            // A second visit to the same instant (an event, a new start): the newer values count.
            let n = lanes.len();
            let at = self.s.len() - 1;
            if self.seam {
                self.seam = false;
                self.bend(value, lanes);
            }
            self.value[at] = value;
            self.slope[at] = slope;
            self.lanes[at * n..].copy_from_slice(lanes);
            return;
        }
        self.s.push(s);
        self.value.push(value);
        self.slope.push(slope);
        self.lanes.extend_from_slice(lanes);
    }

    /// Bends the last [`BEND`] intervals so that they end at `value`, sensitivities alike.
    pub(super) fn bend(&mut self, value: f64, lanes: &[f64]) {
        let (n, last) = (lanes.len(), self.s.len() - 1);
        let first = last.saturating_sub(BEND);
        let width = self.s[last] - self.s[first];
        let jump = value - self.value[last];
        let jumps: Vec<f64> = lanes.iter().zip(&self.lanes[last * n..]).map(|(new, old)| new - old).collect();
        for i in first + 1..last {
            let w = (self.s[i] - self.s[first]) / width;
            let share = w * w * (3.0 - 2.0 * w);
            self.value[i] += jump * share;
            self.slope[i] += jump * 6.0 * w * (1.0 - w) / width;
            for (l, jump) in self.lanes[i * n..(i + 1) * n].iter_mut().zip(&jumps) {
                *l += jump * share;
            }
        }
    }

    /// Cubic Hermite value and slope at `s`, and the index and weight for the lanes.
    pub(super) fn at(&self, s: f64) -> (f64, f64, usize, f64) {
        let n = self.s.len();
        if n == 0 || s <= self.s[0] {
            return (self.value.first().copied().unwrap_or(0.0), 0.0, 0, 0.0);
        }
        let i = last_before(&self.s, s).min(n.max(2) - 2);
        if i + 1 >= n {
            return (self.value[n - 1], 0.0, n - 1, 0.0);
        }
        let h = self.s[i + 1] - self.s[i];
        let w = (s - self.s[i]) / h;
        let (y0, y1, d0, d1) = (self.value[i], self.value[i + 1], self.slope[i] * h, self.slope[i + 1] * h);
        if w > 1.0 {
            // A delay shorter than the step: straight on from the newest value.
            return (y1 + (w - 1.0) * d1, d1 / h, i + 1, 0.0);
        }
        let (c2, c3) = (3.0 * (y1 - y0) - 2.0 * d0 - d1, 2.0 * (y0 - y1) + d0 + d1);
        let value = y0 + w * (d0 + w * (c2 + w * c3));
        let slope = (d0 + w * (2.0 * c2 + 3.0 * w * c3)) / h;
        (value, slope, i, w)
    }

    /// Without its first entries.
    pub(super) fn cut(&mut self, entries: usize, lanes: usize) {
        self.s.drain(..entries);
        self.value.drain(..entries);
        self.slope.drain(..entries);
        self.lanes.drain(..entries * lanes);
    }

    /// What a stretch from `s` on may still read with a delay of at most `tau`.
    pub(super) fn recent(&self, s: f64, tau: f64, lanes: usize) -> History {
        let from = self.s.partition_point(|&t| t <= s - tau).saturating_sub(1);
        History {
            s: self.s[from..].to_vec(),
            value: self.value[from..].to_vec(),
            slope: self.slope[from..].to_vec(),
            lanes: self.lanes[from * lanes..].to_vec(),
            seam: true,
            rate: if from == 0 { self.rate.clone() } else { Vec::new() },
        }
    }

    /// The same with its lanes laid out for other seeds.
    pub(super) fn with_lanes(&self, map: &LaneMap) -> History {
        let rate = map.apply(&self.rate, usize::from(!self.rate.is_empty()));
        History { lanes: map.apply(&self.lanes, self.s.len()), rate, ..self.clone() }
    }
}

/// Index of the last of some increasing instants that is no later than `s`; the first is. It is looked for where even steps
/// as long as the last one would have it.
fn last_before(instants: &[f64], s: f64) -> usize {
    let n = instants.len();
    if n < 2 {
        return 0;
    }
    let (last, step) = (instants[n - 1], instants[n - 1] - instants[n - 2]);
    let back = ((last - s) / step).max(0.0).min(n as f64) as usize;
    let (mut low, mut high) = (n.saturating_sub(back + 2), n - back);
    let mut reach = 1;
    while low > 0 && instants[low] > s {
        high = low;
        low = low.saturating_sub(reach);
        reach *= 2;
    }
    let mut reach = 1;
    while high < n && instants[high] <= s {
        low = high;
        high = (high + reach).min(n);
        reach *= 2;
    }
    (low + instants[low..high].partition_point(|&t| t <= s)).max(1) - 1
}

/// Where each lane of a stretch comes from among the lanes of the stretch before it.
pub(super) struct LaneMap {
    pub(super) from: usize,
    source: Vec<Option<usize>>,
}

impl LaneMap {
    pub(super) fn new(before: &Carry, seeds: &Seeds) -> LaneMap {
        let parameters = seeds.parameters.iter().map(|p| before.parameters.iter().position(|q| q == p));
        // Another stretch's initial states are not this one's.
        let initial = seeds.initial.iter().map(|_| None);
        let first = before.parameters.len() + before.initial;
        let same = before.signals == seeds.signals.lanes;
        let signals = (0..seeds.signals.lanes).map(|l| same.then_some(first + l));
        LaneMap { from: first + before.signals, source: parameters.chain(initial).chain(signals).collect() }
    }

    pub(super) fn apply(&self, rows: &[f64], count: usize) -> Vec<f64> {
        let mut out = Vec::with_capacity(count * self.source.len());
        for r in 0..count {
            out.extend(self.source.iter().map(|l| l.map_or(0.0, |l| rows[r * self.from + l])));
        }
        out
    }
}

/// Where a stretch ended: what the next one needs to go on from there.
///
/// It holds the state and its tangents at sample [`sample`](Carry::sample), and as much of the past
/// of every delayed expression (of the equations and of the measurements) as the delays can reach
/// back. Made and used by [`Simulation::run_on`](crate::Simulation::run_on).
#[derive(Debug, Clone, PartialEq)]
pub struct Carry {
    pub(super) sample: usize,
    pub(super) x: Vec<f64>,
    pub(super) dx: Vec<f64>,
    pub(super) reach: Vec<f64>,
    pub(super) h_next: f64,
    /// Lanes of `dx` and of the histories: these parameters, so many initial states and signals.
    pub(super) parameters: Vec<usize>,
    pub(super) initial: usize,
    pub(super) signals: usize,
    pub(super) rhs_history: Vec<History>,
    pub(super) out_history: Vec<History>,
}

impl Carry {
    /// The sample at which it holds.
    pub fn sample(&self) -> usize {
        self.sample
    }

    /// The state there.
    pub fn state(&self) -> &[f64] {
        &self.x
    }

    /// Its sensitivities, `states × lanes` (parameters, initial states, signals).
    pub fn tangents(&self) -> &[f64] {
        &self.dx
    }

    /// The same, where the states are known to reach these magnitudes (one for each entry of the state vector): the absolute tolerance
    /// of [`Method::Adaptive`](crate::Method::Adaptive) is relative to them, where the states have not been larger. A
    /// motion that begins at rest in many short stretches would else be integrated to the rounding of its forces.
    ///
    /// ```
    /// # use greybox_model::{Model, System};
    /// use greybox_simulate::{Carry, Environment, Method, Seeds, Simulation};
    /// # let model = Model::from_toml(r#"
    /// # [parameters]
    /// # a = { value = 1.0, unit = "1/s" }
    /// # [states]
    /// # x = { unit = "m" }
    /// # [equations]
    /// # decay = "x' + a*x = 0"
    /// # "#, "model.toml").unwrap();
    /// # let system = System::compile(&model).unwrap();
    /// let environment = Environment { start: 0.0, dt: 1.0, len: 2, inputs: vec![], forces: vec![] };
    /// let simulation = Simulation {
    ///     system: &system,
    ///     environment: &environment,
    ///     parameters: &[1.0],
    ///     method: Method::Adaptive { rtol: 1e-9, atol: 1e-9 },
    ///     seeds: &Seeds::default(),
    /// };
    /// // Beside a metre, a micrometre takes fewer steps.
    /// let coarse = Carry::remembered(&system, 0, 1.0, &[]).reaching(&[1.0]);
    /// let (known, _) = simulation.run_on(&[1e-6], 0..2, Some(&coarse), &[]);
    /// assert!(known.steps < simulation.run(&[1e-6], 0..2).steps);
    /// ```
    #[must_use]
    pub fn reaching(mut self, magnitudes: &[f64]) -> Carry {
        self.reach = magnitudes.to_vec();
        self
    }

    /// What a stretch that starts at `sample` remembers of `states[entry][k]`, samples `dt` apart of which the last
    /// is that of the start; `None` where an entry's past is not known. Delayed expressions of the equations that
    /// are such an entry, and nothing more, read it there; the others hold their initial value, and those of the
    /// measurements do what they do at a start of their own. Nothing is carried. Values are SI; between them the past
    /// is a cubic with slopes by central differences.
    ///
    /// ```
    /// # use greybox_model::{Model, System};
    /// use greybox_simulate::{Carry, Environment, Method, Seeds, Simulation};
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
    /// let whole = simulation.run(&[1.0], 0..100);
    /// let past = Carry::remembered(&system, 60, 0.01, &[Some(&whole.y[..=60])]);
    /// let (rest, _) = simulation.run_on(&[whole.y[60]], 60..100, Some(&past), &[]);
    /// assert!((rest.y[39] - whole.y[99]).abs() < 1e-6);
    /// ```
    pub fn remembered(system: &System, sample: usize, dt: f64, states: &[Option<&[f64]>]) -> Carry {
        let history = |entry: Option<usize>| {
            let Some(values) = entry.and_then(|e| states.get(e).copied().flatten()) else {
                return History::default();
            };
            let n = values.len();
            let slope = |k: usize| {
                let (a, b) = (k.saturating_sub(1), (k + 1).min(n - 1));
                if b > a { (values[b] - values[a]) / ((b - a) as f64 * dt) } else { 0.0 }
            };
            History {
                s: (0..n).map(|k| (sample as f64 + 1.0 + k as f64 - n as f64) * dt).collect(),
                value: values.to_vec(),
                slope: (0..n).map(slope).collect(),
                seam: true,
                ..History::default()
            }
        };
        Carry {
            sample,
            x: vec![0.0; system.nx],
            dx: Vec::new(),
            reach: Vec::new(),
            h_next: dt,
            parameters: Vec::new(),
            initial: 0,
            signals: 0,
            rhs_history: system.rhs.delays.iter().map(|d| history(state_leaf(system, d.arg_leaf))).collect(),
            out_history: vec![History::default(); system.output.delays.len()],
        }
    }
}

/// What a delayed expression of the equations was before a sample.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Past {
    /// Increasing times, counted from the sample: zero and before, s.
    pub time: Vec<f64>,
    /// Its values then, SI.
    pub value: Vec<f64>,
    /// Its slopes then, SI.
    pub slope: Vec<f64>,
    /// How the values depend on the lanes of the [`Seeds`](crate::Seeds), times × lanes; empty where they depend on none.
    pub lanes: Vec<f64>,
}

impl Past {
    /// Whether all of it is there, for so many lanes, and its times increase up to zero.
    pub fn is_consistent(&self, lanes: usize) -> bool {
        let finite = |v: &[f64]| v.iter().all(|v| v.is_finite());
        self.value.len() == self.time.len()
            && self.slope.len() == self.time.len()
            && (self.lanes.is_empty() || Some(self.lanes.len()) == self.time.len().checked_mul(lanes))
            && [&self.time, &self.value, &self.slope, &self.lanes].iter().all(|v| finite(v))
            && self.time.windows(2).all(|w| w[0] < w[1])
            && self.time.last().is_none_or(|t| *t <= 0.0)
    }
}

impl History {
    /// A past before the time `s`.
    pub(super) fn known(past: &Past, s: f64, lanes: usize) -> History {
        History {
            s: past.time.iter().map(|t| s + t).collect(),
            value: past.value.clone(),
            slope: past.slope.clone(),
            lanes: match past.lanes.is_empty() {
                true => vec![0.0; past.time.len() * lanes],
                false => past.lanes.clone(),
            },
            ..History::default()
        }
    }

    /// As much of it as reaches back over `seconds` from `s`.
    pub(super) fn past(&self, s: f64, seconds: f64, lanes: usize) -> Past {
        let from = self.s.partition_point(|t| *t <= s - seconds).saturating_sub(1);
        Past {
            time: self.s[from..].iter().map(|t| t - s).collect(),
            value: self.value[from..].to_vec(),
            slope: self.slope[from..].to_vec(),
            lanes: self.lanes[from * lanes..].to_vec(),
        }
    }
}

/// The delays τ of the equations at these `parameters` (`system.np`, SI), one for each delayed expression, s; a negative one is
/// zero, as it is simulated.
///
/// ```
/// # use greybox_model::{Model, System};
/// let model = Model::from_toml(r#"
/// [parameters]
/// a = { value = 1.0, unit = "1/s" }
/// tau = { value = 0.25, unit = "s" }
/// [states]
/// x = { unit = "m" }
/// [equations]
/// late = "x' + a*delay(x, 2*tau) = 0"
/// "#, "model.toml").unwrap();
/// let system = System::compile(&model).unwrap();
/// assert_eq!(greybox_simulate::delays(&system, &[1.0, 0.2]), [0.4]);
/// ```
pub fn delays(system: &System, parameters: &[f64]) -> Vec<f64> {
    let tape = &system.rhs;
    let (mut registers, mut modes) = (vec![0.0; tape.registers()], vec![1; tape.switches.len()]);
    registers[system.parameters()..][..system.np].copy_from_slice(parameters);
    tape.prepare(&mut registers, &mut modes);
    tape.delays.iter().map(|d| registers[d.tau as usize].max(0.0)).collect()
}

/// Entries of the state vector that an equation delays as they are.
pub fn delayed_states(system: &System) -> Vec<usize> {
    system.rhs.delays.iter().filter_map(|d| state_leaf(system, d.arg_leaf)).collect()
}

/// Whether a stretch depends on what was before it by more than its initial state: an equation
/// delays something else than a plain input (whose past is known anyway), or a measurement delays
/// anything.
pub fn has_history(system: &System) -> bool {
    !system.output.delays.is_empty() || system.rhs.delays.iter().any(|d| !input_leaf(system, d.arg_leaf))
}

/// Steps (samples for a measurement) within which the past of a delayed expression bends to a new
/// start.
pub(super) const BEND: usize = 8;

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::last_before;

    proptest! {
        #[test]
        fn an_instant_is_found_wherever_it_is_among_uneven_steps(
            steps in vec(prop_oneof![4 => 1e-3..1.0, 1 => 1.0..50.0], 0..60),
            share in 0.0..1.2,
        ) {
            let mut instants = vec![0.3];
            instants.extend(steps.iter().scan(0.3, |t, step| {
                *t += step;
                Some(*t)
            }));
            let last = instants[instants.len() - 1];
            let s = 0.3 + (last - 0.3) * share;
            let counted = instants.iter().filter(|t| **t <= s).count() - 1;
            prop_assert_eq!(last_before(&instants, s), counted);
            for (i, s) in instants.iter().enumerate() {
                prop_assert_eq!(last_before(&instants, *s), i);
            }
        }
    }

    #[test]
    fn what_is_no_number_is_at_the_first_instant_and_what_is_infinite_at_the_last() {
        assert_eq!(last_before(&[0.0, 1.0], f64::NAN), 0);
        assert_eq!(last_before(&[0.0, 1.0], f64::INFINITY), 1);
    }
}
