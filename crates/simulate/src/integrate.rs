//! The integrator: explicit Runge–Kutta on the tape, with events, true stick–slip, delays and
//! forward sensitivities.
//!
//! **Within a step** every non-smooth function keeps its branch (its *mode*), so the right-hand side
//! is smooth and the method keeps its order. After a trial step the arguments tell whether a mode was
//! left; the instant is then located by the Illinois method on re-integrated partial steps, the mode
//! changes there, and the rest of the step goes on.
//!
//! **Sticking.** When the argument g of a `sign` reaches zero, the value λ that keeps ġ = 0 is
//! computed from ġ = a + Bλ. If |λ| ≤ 1 (and B < 0) the set-valued sign holds: λ takes that value at
//! every stage and g stays exactly zero, until |λ| would exceed 1 (Filippov's solution; no
//! smoothing, no chatter).
//!
//! **Sensitivities.** S = ∂x/∂(parameters, initial state, signal amplitudes) obeys the variational
//! equation Ṡ = f_x S + f_p, integrated by differentiating each Runge–Kutta stage (so S is the exact
//! derivative of the computed trajectory between events). At an event on g(t, x, p) = 0 it jumps by
//! the saltation term
//!
//! ```text
//! S⁺ = S⁻ + (f⁻ − f⁺) dtₑ,      dtₑ = −(∇g·S⁻ + g_p) / ġ⁻
//! ```
//!
//! (Hiskens & Pai, "Trajectory sensitivity analysis of hybrid systems", IEEE Trans. Circuits Syst. I
//! 47(2), 2000).
//!
//! **Going on.** A stretch may start where another ended ([`Simulation::run_on`]): hidden states, their
//! tangents and the past of delayed expressions go on, while other states start anew. Where those
//! jump, the past of a delayed expression is bent to the new start within the last eight steps, so that
//! the trajectory stays a smooth function of the delay (a jump would pass the stages of the method
//! one by one as the delay changes).

use greybox_model::Hold;
use greybox_model::system::System;
use greybox_model::tape::{SwitchKind, Tangents};
use pulp::{Arch, Simd, WithSimd};

use crate::aligned::Aligned;
use crate::signal::{Piece, Signal};
use crate::small;

/// How to step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Method {
    /// Classical fourth-order Runge–Kutta, `substeps` equal steps between two samples.
    Rk4 {
        /// Steps per sample interval (≥ 1).
        substeps: usize,
    },
    /// Dormand–Prince 5 with fixed steps.
    Dp5 {
        /// Steps per sample interval (≥ 1).
        substeps: usize,
    },
    /// The eighth-order method of Dormand and Prince (DOP853, twelve stages) with fixed steps.
    Dop853 {
        /// Steps per sample interval (≥ 1).
        substeps: usize,
    },
    /// Dormand–Prince 5(4) with error control; steps never straddle a sample.
    Adaptive {
        /// Relative tolerance.
        rtol: f64,
        /// Absolute tolerance, relative to the magnitude each state has reached so far.
        atol: f64,
    },
}

/// Everything from outside that acts on the system during one uniformly sampled piece.
#[derive(Debug, Clone)]
pub struct Environment {
    /// Time of the first sample on the recording's clock, s.
    pub start: f64,
    /// Sample interval, s.
    pub dt: f64,
    /// Number of samples.
    pub len: usize,
    /// One signal per input of the model.
    pub inputs: Vec<Signal>,
    /// Exogenous generalised forces, linear between samples.
    pub forces: Vec<Force>,
}

/// An exogenous force F(t) that enters equation e as `weights[e] * F` on its left side.
#[derive(Debug, Clone)]
pub struct Force {
    /// One weight per equation.
    pub weights: Vec<f64>,
    /// One value per sample.
    pub samples: Vec<f64>,
}

/// Directions of the sensitivities, in the order of the lanes of the result: parameters, then
/// initial states, then signals.
#[derive(Debug, Clone, Default)]
pub struct Seeds {
    /// Indices of parameters.
    pub parameters: Vec<usize>,
    /// Indices into the state vector.
    pub initial: Vec<usize>,
    /// Exogenous directions.
    pub signals: std::sync::Arc<SignalLanes>,
}

/// Directions that are signals: each adds a force, or a change of an input, to the trajectory.
#[derive(Debug, Clone, Default)]
pub struct SignalLanes {
    /// How many.
    pub lanes: usize,
    /// Weight of each lane's force in each equation, `equations × lanes`.
    pub weights: Vec<f64>,
    /// The forces, `samples × lanes` (empty: none).
    pub force: Vec<f64>,
    /// Changes of inputs: (input, `samples × lanes`).
    pub inputs: Vec<(usize, Vec<f64>)>,
    /// Changes of outputs: (channel, `samples × lanes`).
    pub outputs: Vec<(usize, Vec<f64>)>,
}

impl Seeds {
    /// Number of directions.
    pub fn lanes(&self) -> usize {
        self.parameters.len() + self.initial.len() + self.signals.lanes
    }
}

/// A simulated stretch of `n` samples.
#[derive(Debug, Clone, Default)]
pub struct Trajectory {
    /// Number of samples.
    pub n: usize,
    /// Outputs, channel by channel: `y[c * n + k]`.
    pub y: Vec<f64>,
    /// States: `x[i * n + k]`.
    pub x: Vec<f64>,
    /// Sensitivities of the outputs: `dy[(lane * ny + c) * n + k]`.
    pub dy: Vec<f64>,
    /// First sample at which the solution had left every reasonable bound; it is frozen from there.
    pub diverged: Option<usize>,
    /// Number of located events.
    pub events: usize,
    /// Evaluations of the right-hand side.
    pub evaluations: usize,
    /// Accepted steps.
    pub steps: usize,
}

struct Tableau {
    a: &'static [&'static [f64]],
    b: &'static [f64],
    c: &'static [f64],
    /// Error weights, the last for the derivative at the step's end.
    e: &'static [f64],
}

static RK4: Tableau = Tableau {
    a: &[&[], &[0.5], &[0.0, 0.5], &[0.0, 0.0, 1.0]],
    b: &[1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0],
    c: &[0.0, 0.5, 0.5, 1.0],
    e: &[],
};

// Dormand & Prince, J. Comp. Appl. Math. 6 (1980) 19–26.
static DP5: Tableau = Tableau {
    a: &[
        &[],
        &[1.0 / 5.0],
        &[3.0 / 40.0, 9.0 / 40.0],
        &[44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0],
        &[19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0],
        &[9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0],
    ],
    b: &[35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0],
    c: &[0.0, 0.2, 0.3, 0.8, 8.0 / 9.0, 1.0],
    e: &[71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0, -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0],
};

// Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.5: the eighth-order method of DOP853.
static DOP853: Tableau = Tableau {
    a: &[
        &[],
        &[0.05260015195876773],
        &[0.0197250569845379, 0.0591751709536137],
        &[0.02958758547680685, 0.0, 0.08876275643042054],
        &[0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792],
        &[0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242],
        &[0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125],
        &[
            0.03709200011850479,
            0.0,
            0.0,
            0.17038392571223998,
            0.10726203044637328,
            -0.015319437748624402,
            0.008273789163814023,
        ],
        &[
            0.6241109587160757,
            0.0,
            0.0,
            -3.3608926294469414,
            -0.868219346841726,
            27.59209969944671,
            20.154067550477894,
            -43.48988418106996,
        ],
        &[
            0.47766253643826434,
            0.0,
            0.0,
            -2.4881146199716677,
            -0.590290826836843,
            21.230051448181193,
            15.279233632882423,
            -33.28821096898486,
            -0.020331201708508627,
        ],
        &[
            -0.9371424300859873,
            0.0,
            0.0,
            5.186372428844064,
            1.0914373489967295,
            -8.149787010746927,
            -18.52006565999696,
            22.739487099350505,
            2.4936055526796523,
            -3.0467644718982196,
        ],
        &[
            2.273310147516538,
            0.0,
            0.0,
            -10.53449546673725,
            -2.0008720582248625,
            -17.9589318631188,
            27.94888452941996,
            -2.8589982771350235,
            -8.87285693353063,
            12.360567175794303,
            0.6433927460157636,
        ],
    ],
    b: &[
        0.054293734116568765,
        0.0,
        0.0,
        0.0,
        0.0,
        4.450312892752409,
        1.8915178993145003,
        -5.801203960010585,
        0.3111643669578199,
        -0.1521609496625161,
        0.20136540080403034,
        0.04471061572777259,
    ],
    c: &[
        0.0,
        0.05260015195876773,
        0.0789002279381516,
        0.1183503419072274,
        0.2816496580927726,
        0.3333333333333333,
        0.25,
        0.3076923076923077,
        0.6512820512820513,
        0.6,
        0.8571428571428571,
        1.0,
    ],
    e: &[],
};

/// One evaluation of the right-hand side, kept for the tangent pass.
struct Stage {
    regs: Vec<f64>,
    lu: Vec<f64>,
    pivots: Vec<usize>,
    slopes: Vec<f64>,
    delayed_slopes: Vec<f64>,
    s: f64,
    mid: f64,
    lambda: Vec<f64>,
    held: Held,
}

/// What holds the sticking switches of a stage: ġ = a + Bλ = 0.
#[derive(Default)]
struct Held {
    /// For each: gradient of its argument (nx), and f(λ=1) − f(λ=0) (nx).
    gradient: Vec<f64>,
    pull: Vec<f64>,
    a: Vec<f64>,
    /// B, factored.
    b: Vec<f64>,
    pivots: Vec<usize>,
    diagonal: Vec<f64>,
    ok: bool,
    /// f(λ=0).
    f0: Vec<f64>,
}

impl Held {
    fn resize(&mut self, switches: usize, states: usize) {
        self.gradient.resize(switches * states, 0.0);
        self.pull.resize(switches * states, 0.0);
        self.a.resize(switches, 0.0);
        self.b.resize(switches * switches, 0.0);
        self.pivots.resize(switches, 0);
        self.diagonal.resize(switches, 0.0);
        self.f0.resize(states, 0.0);
    }
}

/// Past values of a delayed expression.
#[derive(Debug, Clone, Default, PartialEq)]
struct History {
    s: Vec<f64>,
    value: Vec<f64>,
    slope: Vec<f64>,
    lanes: Vec<f64>,
    /// Ends where another stretch did; the next entry tells where this one starts.
    seam: bool,
    /// Sensitivities of the first slope, where the expression goes straight on before its first value.
    rate: Vec<f64>,
}

impl History {
    fn push(&mut self, s: f64, value: f64, slope: f64, lanes: &[f64]) {
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
    fn bend(&mut self, value: f64, lanes: &[f64]) {
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
    fn at(&self, s: f64) -> (f64, f64, usize, f64) {
        let n = self.s.len();
        if n == 0 || s <= self.s[0] {
            return (self.value.first().copied().unwrap_or(0.0), 0.0, 0, 0.0);
        }
        let i = self.s.partition_point(|&t| t <= s).min(n - 1).max(1) - 1;
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

    /// What a stretch from `s` on may still read with a delay of at most `tau`.
    fn recent(&self, s: f64, tau: f64, lanes: usize) -> History {
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
    fn with_lanes(&self, map: &LaneMap) -> History {
        let rate = map.apply(&self.rate, usize::from(!self.rate.is_empty()));
        History { lanes: map.apply(&self.lanes, self.s.len()), rate, ..self.clone() }
    }
}

/// Where each lane of a stretch comes from among the lanes of the stretch before it.
struct LaneMap {
    from: usize,
    source: Vec<Option<usize>>,
}

impl LaneMap {
    fn new(before: &Carry, seeds: &Seeds) -> LaneMap {
        let parameters = seeds.parameters.iter().map(|p| before.parameters.iter().position(|q| q == p));
        // Another stretch's initial states are not this one's.
        let initial = seeds.initial.iter().map(|_| None);
        let first = before.parameters.len() + before.initial;
        let same = before.signals == seeds.signals.lanes;
        let signals = (0..seeds.signals.lanes).map(|l| same.then_some(first + l));
        LaneMap { from: first + before.signals, source: parameters.chain(initial).chain(signals).collect() }
    }

    fn apply(&self, rows: &[f64], count: usize) -> Vec<f64> {
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
/// back. Made and used by [`Simulation::run_on`].
#[derive(Debug, Clone, PartialEq)]
pub struct Carry {
    sample: usize,
    x: Vec<f64>,
    dx: Vec<f64>,
    reach: Vec<f64>,
    h_next: f64,
    /// Lanes of `dx` and of the histories: these parameters, so many initial states and signals.
    parameters: Vec<usize>,
    initial: usize,
    signals: usize,
    rhs_history: Vec<History>,
    out_history: Vec<History>,
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

/// Everything a simulation needs apart from where it starts and ends.
#[derive(Debug, Clone, Copy)]
pub struct Simulation<'a> {
    /// The compiled model.
    pub system: &'a System,
    /// Inputs and forces; one input signal per input of the model.
    pub environment: &'a Environment,
    /// Parameter values, SI (`system.np`).
    pub parameters: &'a [f64],
    /// Integration.
    pub method: Method,
    /// Directions of the sensitivities.
    pub seeds: &'a Seeds,
}

impl Simulation<'_> {
    /// Samples `range` from state `x0` (`system.nx` entries: the chains q, q', … in the order of the
    /// states, SI) at the first of them. Before it, delayed expressions of the equations hold their
    /// initial value; a state whose measurement is delayed goes straight back along its rate.
    pub fn run(&self, x0: &[f64], range: std::ops::Range<usize>) -> Trajectory {
        let s = range.start as f64 * self.environment.dt;
        Core::new(self, x0, s).run(range, false)
    }

    /// Samples `range`, going on from where another stretch ended.
    ///
    /// The states `carried` (indices of the state vector) start where `before` ended, with their
    /// tangents, whatever `x0` says; the other states start at `x0`. The delayed expressions remember
    /// what `before` remembers; where the state jumps (`x0` is not where the other stretch ended), they
    /// bend to the new start within the last eight steps before it. Before the first sample of all
    /// they do as in [`run`](Simulation::run).
    ///
    /// Sensitivities to parameters and to signals go on. Those to the initial state belong to the
    /// stretch: the initial states of earlier stretches have no lane here, and a carried state no
    /// initial value of its own (its lane, if seeded, is zero).
    ///
    /// The returned [`Carry`] belongs to sample `range.end`, one step beyond the last one of the
    /// result, where the environment reaches so far; else to the last one. A stretch that starts there
    /// with that very state (all entries carried) continues as if it had never been cut. After a
    /// divergence it holds the last good state, with zero tangents.
    ///
    /// `before` must come from the same system, environment and parameters; one that does not belong
    /// to sample `range.start`, or to a system of other dimensions, is not used.
    ///
    /// ```
    /// # use greybox_model::{Model, System};
    /// use greybox_simulate::{Environment, Method, Seeds, Simulation};
    /// # let model = Model::from_toml(r#"
    /// # [parameters]
    /// # a = { value = 2.0, unit = "1/s" }
    /// # [states]
    /// # x = { unit = "m", initial = 1.0 }
    /// # [equations]
    /// # decay = "x' + a*x = 0"
    /// # "#, "model.toml").unwrap();
    /// # let system = System::compile(&model).unwrap();
    /// let environment = Environment { start: 0.0, dt: 0.01, len: 100, inputs: vec![], forces: vec![] };
    /// let simulation = Simulation {
    ///     system: &system,
    ///     environment: &environment,
    ///     parameters: &[2.0],
    ///     method: Method::Rk4 { substeps: 1 },
    ///     seeds: &Seeds::default(),
    /// };
    /// let whole = simulation.run(&[1.0], 0..100);
    /// let (_, carry) = simulation.run_on(&[1.0], 0..40, None, &[]);
    /// let (rest, _) = simulation.run_on(&[f64::NAN], 40..100, Some(&carry), &[0]);
    /// assert_eq!(rest.y, whole.y[40..]);
    /// ```
    pub fn run_on(
        &self,
        x0: &[f64],
        range: std::ops::Range<usize>,
        before: Option<&Carry>,
        carried: &[usize],
    ) -> (Trajectory, Carry) {
        let s = range.start as f64 * self.environment.dt;
        let end = range.end.min(self.environment.len.saturating_sub(1)).max(range.start);
        let mut x0 = x0.to_vec();
        let before = before.filter(|b| {
            b.sample == range.start
                && b.x.len() == self.system.nx
                && b.rhs_history.len() == self.system.rhs.delays.len()
                && b.out_history.len() == self.system.output.delays.len()
        });
        if let Some(before) = before {
            for &i in carried {
                x0[i] = before.x[i];
            }
        }
        let mut core = Core::new(self, &x0, s);
        if let Some(before) = before {
            core.go_on(before, carried);
        }
        let trajectory = core.run(range, true);
        let carry = core.into_carry(end, &trajectory);
        (trajectory, carry)
    }
}

/// Steps (samples for a measurement) within which the past of a delayed expression bends to a new
/// start.
const BEND: usize = 8;
/// The trajectory's magnitude, relative to its inputs and start, beyond which it counts as diverged.
const LIMIT: f64 = 1e9;
/// Events in one sample interval beyond which events are no longer located (a contact that
/// bounces infinitely often in finite time).
const MOST_EVENTS: usize = 200;

/// Steps shorter than this share of the sample interval are taken whatever their error, so that every
/// simulation ends.
const SMALLEST_STEP: f64 = 1e-5;

/// Simulates samples `range` of `env` from state `x0` at the first of them.
///
/// `x0` has `system.nx` entries (the chains q, q', … in the order of the states), `parameters`
/// `system.np`, all SI; `env.inputs` holds one signal per input. The caller answers for these lengths.
pub fn integrate(
    system: &System,
    env: &Environment,
    parameters: &[f64],
    x0: &[f64],
    range: std::ops::Range<usize>,
    method: Method,
    seeds: &Seeds,
) -> Trajectory {
    Simulation { system, environment: env, parameters, method, seeds }.run(x0, range)
}

/// ẋ of every stage.
struct Rates {
    /// Entry by entry, the stages of one side by side.
    f: Vec<f64>,
    stages: usize,
}

impl Rates {
    fn new(entries: usize, stages: usize) -> Rates {
        Rates { f: vec![0.0; entries * stages], stages }
    }

    fn at(&self, stage: usize, entry: usize) -> f64 {
        self.f[entry * self.stages + stage]
    }

    fn set(&mut self, stage: usize, entry: usize, value: f64) {
        self.f[entry * self.stages + stage] = value;
    }

    fn stage(&self, stage: usize) -> impl Iterator<Item = f64> {
        self.f.iter().skip(stage).step_by(self.stages).copied()
    }

    fn swap(&mut self, a: usize, b: usize) {
        self.f.chunks_exact_mut(self.stages).for_each(|entry| entry.swap(a, b));
    }

    /// out = x + h Σ weight · f over the stages that have a weight.
    #[inline(always)]
    fn along(&self, out: &mut [f64], x: &[f64], weights: &[f64], h: f64) {
        for ((out, x), f) in out.iter_mut().zip(x).zip(self.f.chunks_exact(self.stages)) {
            *out = x + h * dot(weights, f);
        }
    }
}

#[inline(always)]
fn dot(weights: &[f64], f: &[f64]) -> f64 {
    weights.iter().zip(f).fold(0.0, |sum, (w, f)| sum + w * f)
}

/// out = x + Σ h · weight · k, k one block as long as x after the other; a weight of zero takes no part.
#[inline(always)]
fn tangents_along(out: &mut [f64], x: &[f64], k: &[f64], weights: &[f64], h: f64) {
    let n = x.len();
    let mut terms =
        weights.iter().enumerate().filter(|w| *w.1 != 0.0).map(|(j, w)| (h * w, &k[j * n..][..n]));
    let out = &mut out[..n];
    match (terms.next(), terms.next()) {
        (None, _) => out.copy_from_slice(x),
        (Some((a, ka)), None) => {
            for e in 0..n {
                out[e] = x[e] + a * ka[e];
            }
        }
        (Some((a, ka)), Some((b, kb))) => {
            for e in 0..n {
                out[e] = x[e] + a * ka[e] + b * kb[e];
            }
        }
    }
    while let Some((a, ka)) = terms.next() {
        match terms.next() {
            None => {
                for e in 0..n {
                    out[e] += a * ka[e];
                }
            }
            Some((b, kb)) => {
                for e in 0..n {
                    out[e] = out[e] + a * ka[e] + b * kb[e];
                }
            }
        }
    }
}

/// The sensitivities' step, with the machine's widest vectors (which round as any others: products and sums are not
/// fused).
struct TangentStep<'c, 'a> {
    core: &'c mut Core<'a>,
    h: f64,
}

impl WithSimd for TangentStep<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let TangentStep { core, h } = self;
        // Loops of known length for the usual widths.
        match core.width {
            4 => core.tangent_step_of(h, 4),
            8 => core.tangent_step_of(h, 8),
            12 => core.tangent_step_of(h, 12),
            16 => core.tangent_step_of(h, 16),
            width => core.tangent_step_of(h, width),
        }
    }
}

/// The stride of a row of `lanes` tangents: a multiple of four, whose spare lanes are zero.
fn width(lanes: usize) -> usize {
    if lanes > 2 { lanes.next_multiple_of(4) } else { lanes }
}

struct Core<'a> {
    arch: Arch,
    system: &'a System,
    env: &'a Environment,
    seeds: &'a Seeds,
    tableau: &'static Tableau,
    substeps: usize,
    tolerance: Option<(f64, f64)>,
    lanes: usize,
    /// Stride of a row of tangents.
    width: usize,
    stages: Vec<Stage>,
    rates: Rates,
    /// What the inputs do around the time `mid`.
    pieces: Vec<Piece>,
    mid: f64,
    /// The register that each entry of ẋ is.
    source: Vec<usize>,
    modes: Vec<i8>,
    sticking: Vec<usize>,
    live: Vec<usize>,
    scale: Vec<f64>,
    s: f64,
    x: Vec<f64>,
    x1: Vec<f64>,
    reach: Vec<f64>,
    dx: Aligned,
    dk: Aligned,
    d: Aligned,
    tangents: Tangents,
    b: Aligned,
    /// Tangents of what holds the sticking switches.
    dl: Vec<f64>,
    gd: Vec<f64>,
    along: Tangents,
    h_next: f64,
    fresh: bool,
    /// Whether the delayed expressions remember this stretch's start.
    begun: bool,
    /// Whether a step left every reasonable bound after the last recorded sample.
    lost: bool,
    zero_hold: bool,
    events_here: usize,
    rhs_history: Vec<History>,
    out_regs: Vec<f64>,
    out_modes: Vec<i8>,
    out_d: Aligned,
    out_tangents: Tangents,
    out_history: Vec<History>,
    result: Trajectory,
}

impl<'a> Core<'a> {
    fn new(simulation: &Simulation<'a>, x0: &[f64], s: f64) -> Core<'a> {
        let Simulation { system, environment: env, parameters, method, seeds } = *simulation;
        let (nx, nz) = (system.nx, system.nz);
        let lanes = seeds.lanes();
        let width = width(lanes);
        let (tableau, substeps, tolerance) = match method {
            Method::Rk4 { substeps } => (&RK4, substeps.max(1), None),
            Method::Dp5 { substeps } => (&DP5, substeps.max(1), None),
            Method::Dop853 { substeps } => (&DOP853, substeps.max(1), None),
            Method::Adaptive { rtol, atol } => (&DP5, 1, Some((rtol, atol))),
        };
        let tape = &system.rhs;
        let mut modes = vec![1i8; tape.switches.len()];
        let mut regs = vec![0.0; tape.registers()];
        regs[system.parameters()..][..system.np].copy_from_slice(parameters);
        tape.prepare(&mut regs, &mut modes);
        let stage = |regs: &Vec<f64>| Stage {
            regs: regs.clone(),
            lu: vec![0.0; nz * nz],
            pivots: vec![0; nz],
            slopes: vec![0.0; system.nu],
            delayed_slopes: vec![0.0; tape.delays.len()],
            s: 0.0,
            mid: 0.0,
            lambda: vec![0.0; tape.switches.len()],
            held: Held { ok: true, ..Held::default() },
        };
        let mut stages: Vec<Stage> = (0..=tableau.b.len()).map(|_| stage(&regs)).collect();
        if system.mass_is_fixed {
            for st in &mut stages {
                for (m, &r) in st.lu.iter_mut().zip(&tape.outputs[..nz * nz]) {
                    *m = regs[r as usize];
                }
                small::factor(&mut st.lu, &mut st.pivots, nz);
            }
        }
        // Which registers have tangents.
        let mut leaf_active = vec![false; tape.leaves()];
        let seeded_states = lanes > 0;
        leaf_active[System::STATES..System::STATES + nx].fill(seeded_states);
        for &p in &seeds.parameters {
            leaf_active[system.parameters() + p] = true;
        }
        for (i, _) in &seeds.signals.inputs {
            leaf_active[system.inputs() + i] = true;
        }
        for leaf in &mut leaf_active[system.delayed()..] {
            *leaf = seeded_states;
        }
        let tangents = tape.tangents(&leaf_active);
        let mut d = Aligned::zeros(tape.registers() * width);
        for (l, &p) in seeds.parameters.iter().enumerate() {
            d[(system.parameters() + p) * width + l] = 1.0;
        }
        if lanes > 0 {
            tape.prepare_tangent(&tangents, &regs, &modes, width, &mut d);
        }
        let mut gleaf = vec![true; tape.leaves()];
        gleaf[system.parameters()..system.parameters() + system.np].fill(false);
        let along = tape.tangents(&gleaf);

        let out = &system.output;
        let mut out_regs = vec![0.0; out.registers()];
        out_regs[system.parameters()..][..system.np].copy_from_slice(parameters);
        let mut out_modes = vec![1i8; out.switches.len()];
        out.prepare(&mut out_regs, &mut out_modes);
        let mut out_leaf_active = vec![seeded_states; out.leaves()];
        out_leaf_active[System::TIME] = false;
        let out_tangents = out.tangents(&out_leaf_active);
        let mut out_d = Aligned::zeros(out.registers() * width);
        for (l, &p) in seeds.parameters.iter().enumerate() {
            out_d[(system.parameters() + p) * width + l] = 1.0;
        }
        if lanes > 0 {
            out.prepare_tangent(&out_tangents, &out_regs, &out_modes, width, &mut out_d);
        }
        let mut dx = Aligned::zeros(nx * width);
        for (l, &i) in seeds.initial.iter().enumerate() {
            dx[i * width + seeds.parameters.len() + l] = 1.0;
        }
        // A state delay shorter than the step would read the future: shorten the steps.
        let mut substeps = substeps;
        for delay in &tape.delays {
            if !input_leaf(system, delay.arg_leaf) {
                let tau = regs[delay.tau as usize];
                if tau > 0.0 && tau < env.dt / substeps as f64 {
                    substeps = ((env.dt / tau).ceil() as usize).clamp(substeps, 64);
                }
            }
        }
        let live = (0..tape.switches.len()).filter(|&k| tape.switches[k].live).collect();
        let mut source: Vec<usize> = (0..nx).map(|r| System::STATES + r + 1).collect();
        for j in 0..nz {
            source[system.offsets[j] + system.orders[j] - 1] = system.highest() + j;
        }
        Core {
            arch: Arch::new(),
            system,
            env,
            seeds,
            tableau,
            substeps,
            tolerance,
            lanes,
            width,
            rates: Rates::new(nx, stages.len()),
            pieces: env.inputs.iter().map(|u| u.piece(s)).collect(),
            mid: s,
            source,
            sticking: Vec::new(),
            live,
            scale: vec![0.0; modes.len()],
            modes,
            s,
            x: x0.to_vec(),
            x1: vec![0.0; nx],
            reach: x0.iter().map(|v| v.abs()).collect(),
            dx,
            dk: Aligned::zeros(tableau.b.len() * nx * width),
            d,
            tangents,
            b: Aligned::zeros(nz * width),
            dl: Vec::new(),
            gd: Vec::new(),
            along,
            h_next: env.dt,
            fresh: false,
            begun: false,
            lost: false,
            zero_hold: env.inputs.iter().any(|u| u.hold() == Hold::Zero),
            events_here: 0,
            rhs_history: vec![History::default(); tape.delays.len()],
            out_regs,
            out_modes,
            out_d,
            out_tangents,
            out_history: vec![History::default(); out.delays.len()],
            result: Trajectory::default(),
            stages,
        }
    }

    /// Takes over what `before` remembers, and its tangents of the states `carried`.
    fn go_on(&mut self, before: &Carry, carried: &[usize]) {
        let map = LaneMap::new(before, self.seeds);
        for &i in carried {
            let row = map.apply(&before.dx[i * map.from..(i + 1) * map.from], 1);
            self.dx[i * self.width..][..self.lanes].copy_from_slice(&row);
        }
        for (reach, old) in self.reach.iter_mut().zip(&before.reach) {
            *reach = reach.max(*old);
        }
        self.h_next = before.h_next;
        self.rhs_history = before.rhs_history.iter().map(|h| h.with_lanes(&map)).collect();
        self.out_history = before.out_history.iter().map(|h| h.with_lanes(&map)).collect();
    }

    /// What the next stretch needs, at `sample`; `trajectory` is what was recorded up to there.
    fn into_carry(self, sample: usize, trajectory: &Trajectory) -> Carry {
        let (nx, n, lanes) = (self.system.nx, trajectory.n, self.lanes);
        let s = sample as f64 * self.env.dt;
        let (x, dx) = if (self.lost || trajectory.diverged.is_some()) && n > 0 {
            ((0..nx).map(|i| trajectory.x[i * n + n - 1]).collect(), vec![0.0; nx * lanes])
        } else {
            let rows = self.dx.chunks_exact(self.width.max(1)).flat_map(|row| &row[..lanes]);
            (self.x, rows.copied().collect())
        };
        let keep = |histories: &[History], taus: Vec<f64>| {
            histories.iter().zip(taus).map(|(h, tau)| h.recent(s, tau.max(0.0), lanes)).collect()
        };
        let rhs = self.system.rhs.delays.iter().map(|d| self.stages[0].regs[d.tau as usize]).collect();
        let out = self.system.output.delays.iter().map(|d| self.out_regs[d.tau as usize]).collect();
        Carry {
            sample,
            x,
            dx,
            reach: self.reach,
            h_next: self.h_next,
            parameters: self.seeds.parameters.clone(),
            initial: self.seeds.initial.len(),
            signals: self.seeds.signals.lanes,
            rhs_history: keep(&self.rhs_history, rhs),
            out_history: keep(&self.out_history, out),
        }
    }

    /// Records the samples of `range`; with `go_on` the state then moves on to sample `range.end`.
    fn run(&mut self, range: std::ops::Range<usize>, go_on: bool) -> Trajectory {
        let n = range.len();
        let (nx, ny, lanes) = (self.system.nx, self.system.ny, self.lanes);
        self.result = Trajectory {
            n,
            y: vec![0.0; ny * n],
            x: vec![0.0; nx * n],
            dy: vec![0.0; lanes * ny * n],
            ..Trajectory::default()
        };
        self.start_modes();
        for (row, k) in range.clone().enumerate() {
            self.s = k as f64 * self.env.dt;
            self.record(row);
            if self.result.diverged.is_some() {
                self.freeze(row, n);
                break;
            }
            if row + 1 < n {
                self.cross_interval(k);
            } else if go_on && k + 1 < self.env.len {
                self.cross_interval(k);
                self.lost = self.result.diverged.take().is_some();
                if !self.lost && !self.out_history.is_empty() {
                    self.observe();
                }
            }
        }
        std::mem::take(&mut self.result)
    }

    /// From sample `k` to the next.
    fn cross_interval(&mut self, k: usize) {
        let s0 = k as f64 * self.env.dt;
        let s1 = (k + 1) as f64 * self.env.dt;
        self.events_here = 0;
        if self.zero_hold {
            self.fresh = false;
        }
        for (at, delay) in self.breakpoints(s0) {
            self.advance(at);
            self.jump_of_delay(delay, at, s1);
        }
        let substeps = self.substeps;
        if self.tolerance.is_none() && substeps > 1 {
            let h = self.env.dt / substeps as f64;
            for i in 1..substeps {
                let at = s0 + i as f64 * h;
                if at > self.s {
                    self.advance(at);
                }
            }
        }
        self.advance(s1);
    }

    /// Instants inside (s0, s0 + dt) at which a delayed zero-order-hold input jumps.
    fn breakpoints(&self, s0: f64) -> Vec<(f64, usize)> {
        let mut found = Vec::new();
        if !self.zero_hold {
            return found;
        }
        for (i, delay) in self.system.rhs.delays.iter().enumerate() {
            let Some(u) = self.delayed_input(delay.arg_leaf) else { continue };
            if self.env.inputs[u].hold() == Hold::Zero {
                let tau = self.stages[0].regs[delay.tau as usize];
                let offset = tau.rem_euclid(self.env.dt);
                found.push((s0 + offset, i));
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found
    }

    /// Sensitivity to the delay where the delayed zero-order-hold input jumps: dtₑ = dτ.
    fn jump_of_delay(&mut self, delay: usize, at: f64, next: f64) {
        if self.lanes == 0 {
            self.fresh = false;
            return;
        }
        self.eval(0, at, at - 1e-6 * self.env.dt);
        let before: Vec<f64> = self.rates.stage(0).collect();
        self.eval(0, at, 0.5 * (at + next.max(at + 1e-9 * self.env.dt)));
        let tau = self.system.rhs.delays[delay].tau as usize;
        for i in 0..self.system.nx {
            let jump = before[i] - self.rates.at(0, i);
            if jump != 0.0 {
                for l in 0..self.width {
                    self.dx[i * self.width + l] += jump * self.d[tau * self.width + l];
                }
            }
        }
        self.fresh = false;
    }

    fn delayed_input(&self, arg: Option<u32>) -> Option<usize> {
        let leaf = arg? as usize;
        (self.system.inputs()..self.system.inputs() + self.system.nu)
            .contains(&leaf)
            .then(|| leaf - self.system.inputs())
    }

    /// Evaluates the right-hand side at the state `self.x` into stage `b`.
    fn eval(&mut self, b: usize, s: f64, mid: f64) {
        self.stages[b].regs[System::STATES..][..self.system.nx].copy_from_slice(&self.x);
        self.eval_stage(b, s, mid);
    }

    /// Evaluates the right-hand side at the state that stands in the registers of stage `b`.
    #[inline]
    fn eval_stage(&mut self, b: usize, s: f64, mid: f64) {
        let system = self.system;
        if mid != self.mid {
            self.mid = mid;
            for (piece, input) in self.pieces.iter_mut().zip(&self.env.inputs) {
                *piece = input.piece(mid);
            }
        }
        let st = &mut self.stages[b];
        st.s = s;
        st.mid = mid;
        st.regs[System::TIME] = self.env.start + s;
        for (i, piece) in self.pieces.iter().enumerate() {
            let (v, slope) = piece.at(s);
            st.regs[system.inputs() + i] = v;
            st.slopes[i] = slope;
        }
        if !system.rhs.delays.is_empty() {
            self.eval_delays(b, s, mid);
        }
        if self.sticking.is_empty() {
            self.eval_free(b);
        } else {
            self.eval_sticking(b);
        }
    }

    /// The delayed values of stage `b`.
    fn eval_delays(&mut self, b: usize, s: f64, mid: f64) {
        let tape = &self.system.rhs;
        for i in 0..tape.delays.len() {
            let delay = tape.delays[i];
            let tau = self.stages[b].regs[delay.tau as usize].max(0.0);
            let (v, slope) = match self.delayed_input(delay.arg_leaf) {
                Some(u) => self.env.inputs[u].at(s - tau, mid - tau),
                None => {
                    let (v, slope, ..) = self.rhs_history[i].at(s - tau);
                    (v, slope)
                }
            };
            let st = &mut self.stages[b];
            st.regs[delay.leaf as usize] = v;
            st.delayed_slopes[i] = slope;
        }
    }

    /// Highest derivatives (into their registers) and ẋ of stage `b`, with the values of sticking signs as they stand.
    #[inline]
    fn eval_free(&mut self, b: usize) {
        let system = self.system;
        let nz = system.nz;
        let st = &mut self.stages[b];
        system.rhs.eval(&mut st.regs, &mut self.modes, &st.lambda);
        self.result.evaluations += 1;
        let outputs = &system.rhs.outputs;
        if !system.mass_is_fixed {
            for (m, &r) in st.lu.iter_mut().zip(&outputs[..nz * nz]) {
                *m = st.regs[r as usize];
            }
            small::factor(&mut st.lu, &mut st.pivots, nz);
        }
        let highest = system.highest();
        for i in 0..nz {
            st.regs[highest + i] = -st.regs[outputs[nz * nz + i] as usize];
        }
        let z = &mut st.regs[highest..highest + nz];
        if !self.env.forces.is_empty() {
            let (k, w) = locate(st.s, st.mid, self.env.dt, self.env.len);
            for force in &self.env.forces {
                let (a, b) = (force.samples[k], force.samples[(k + 1).min(self.env.len - 1)]);
                let v = a + w * (b - a);
                for (z, weight) in z.iter_mut().zip(&force.weights) {
                    *z -= weight * v;
                }
            }
        }
        small::solve_one(&st.lu, &st.pivots, nz, z);
        for (r, &source) in self.source.iter().enumerate() {
            self.rates.set(b, r, st.regs[source]);
        }
    }

    /// The right-hand side while some signs stick: λ solves ġ = a + Bλ = 0.
    fn eval_sticking(&mut self, b: usize) {
        let tape = &self.system.rhs;
        let nx = self.system.nx;
        let sticking = std::mem::take(&mut self.sticking);
        let m = sticking.len();
        for &k in &sticking {
            self.stages[b].lambda[k] = 0.0;
        }
        self.eval_free(b);
        // Gradient of the arguments with respect to the state; the last lane collects explicit time.
        self.slopes(b, true);
        let lanes = nx + 1;
        let mut held = std::mem::take(&mut self.stages[b].held);
        held.resize(m, nx);
        let f0 = &mut held.f0;
        f0.iter_mut().zip(self.rates.stage(b)).for_each(|(f0, f)| *f0 = f);
        for (i, &k) in sticking.iter().enumerate() {
            let row = &self.gd[tape.switches[k].a as usize * lanes..][..lanes];
            held.gradient[i * nx..(i + 1) * nx].copy_from_slice(&row[..nx]);
            held.a[i] = -(row[nx] + row[..nx].iter().zip(&*f0).map(|(g, f)| g * f).sum::<f64>());
        }
        for (i, &k) in sticking.iter().enumerate() {
            self.stages[b].lambda[k] = 1.0;
            self.eval_free(b);
            self.stages[b].lambda[k] = 0.0;
            for ((p, f1), f0) in held.pull[i * nx..].iter_mut().zip(self.rates.stage(b)).zip(&*f0) {
                *p = f1 - f0;
            }
        }
        for i in 0..m {
            for j in 0..m {
                let (g, p) = (&held.gradient[i * nx..(i + 1) * nx], &held.pull[j * nx..(j + 1) * nx]);
                held.b[i * m + j] = g.iter().zip(p).map(|(g, p)| g * p).sum();
            }
            held.diagonal[i] = held.b[i * m + i];
        }
        held.ok = small::factor(&mut held.b, &mut held.pivots, m);
        if held.ok {
            small::solve(&held.b, &held.pivots, m, &mut held.a, 1);
            for (i, &k) in sticking.iter().enumerate() {
                self.stages[b].lambda[k] = held.a[i];
            }
        }
        self.eval_free(b);
        let st = &mut self.stages[b];
        if held.ok {
            // A velocity that is held does not change, not even by rounding: relative error control
            // would chase that noise with ever smaller steps.
            for &k in &sticking {
                let leaf = tape.switches[k].a as usize;
                if (System::STATES..System::STATES + nx).contains(&leaf) {
                    self.rates.set(b, leaf - System::STATES, 0.0);
                }
            }
        }
        st.held = held;
        self.sticking = sticking;
    }

    /// Time derivatives of the registers at stage `b` into `self.gd`: with `split` one lane per state
    /// plus one for explicit time, else one lane along the flow.
    fn slopes(&mut self, b: usize, split: bool) {
        let system = self.system;
        let tape = &system.rhs;
        let nx = system.nx;
        let lanes = if split { nx + 1 } else { 1 };
        self.gd.clear();
        self.gd.resize(tape.registers() * lanes, 0.0);
        let st = &self.stages[b];
        let last = lanes - 1;
        self.gd[System::TIME * lanes + last] = 1.0;
        for i in 0..nx {
            if split {
                self.gd[(System::STATES + i) * lanes + i] = 1.0;
            } else {
                self.gd[System::STATES + i] = self.rates.at(b, i);
            }
        }
        for i in 0..system.nu {
            self.gd[(system.inputs() + i) * lanes + last] = st.slopes[i];
        }
        for (i, delay) in tape.delays.iter().enumerate() {
            self.gd[delay.leaf as usize * lanes + last] = st.delayed_slopes[i];
        }
        tape.tangent(&self.along, &st.regs, &self.modes, lanes, &mut self.gd);
    }

    /// Modes at the very start: natural, with a decision where a sign's argument is exactly zero.
    fn start_modes(&mut self) {
        if self.live.is_empty() {
            return;
        }
        self.eval(0, self.s, self.s + 0.25 * self.env.dt);
        // Natural modes need the arguments, which may depend on other switches: settle by passes.
        for _ in 0..3 {
            let tape = &self.system.rhs;
            let st = &mut self.stages[0];
            tape.eval_natural(&mut st.regs, &mut self.modes);
        }
        self.note_scale(0);
        for i in 0..self.live.len() {
            let k = self.live[i];
            if self.system.rhs.switches[k].kind == SwitchKind::Sign && self.modes[k] == 0 {
                self.modes[k] = 1;
                self.decide(k, 0.25 * self.env.dt);
            }
        }
        self.fresh = false;
    }

    fn note_scale(&mut self, b: usize) {
        let st = &self.stages[b];
        for &k in &self.live {
            let sw = &self.system.rhs.switches[k];
            let size = st.regs[sw.a as usize].abs().max(st.regs[sw.b as usize].abs());
            if size > self.scale[k] && size.is_finite() {
                self.scale[k] = size;
            }
        }
    }

    /// How far inside its mode switch `k` is at stage `b`, with a rounding tolerance added.
    fn slack(&self, b: usize, k: usize) -> f64 {
        let st = &self.stages[b];
        let sw = &self.system.rhs.switches[k];
        if sw.kind == SwitchKind::Sign && self.modes[k] == 0 {
            return 1.0 - st.lambda[k].abs() + 1e-9;
        }
        sw.margin(self.modes[k], st.regs[sw.a as usize], st.regs[sw.b as usize]) + 1e-12 * self.scale[k]
    }

    fn least_slack(&self, b: usize) -> f64 {
        self.live.iter().map(|&k| self.slack(b, k)).fold(f64::INFINITY, f64::min)
    }

    /// One trial step of length `h` from (s, x), stage 0 evaluated there; the result in `x1`.
    fn trial(&mut self, h: f64, end: bool) {
        let nx = self.system.nx;
        let tableau = self.tableau;
        let mid = self.s + 0.5 * h;
        for i in 1..tableau.b.len() {
            let xs = &mut self.stages[i].regs[System::STATES..][..nx];
            self.rates.along(xs, &self.x, tableau.a[i], h);
            self.eval_stage(i, self.s + tableau.c[i] * h, mid);
        }
        let last = tableau.b.len();
        self.rates.along(&mut self.x1, &self.x, tableau.b, h);
        if end {
            self.stages[last].regs[System::STATES..][..nx].copy_from_slice(&self.x1);
            self.eval_stage(last, self.s + h, mid);
        }
    }

    /// Integrates to `to`, through whatever events lie before it.
    fn advance(&mut self, to: f64) {
        let end = self.tableau.b.len();
        let tiny = 1e-13 * (self.env.dt + to.abs());
        let watch = !self.live.is_empty();
        while to - self.s > tiny {
            if self.result.diverged.is_some() {
                self.s = to;
                return;
            }
            if !self.fresh {
                self.begin(to);
            }
            let remaining = to - self.s;
            let mut h = remaining;
            if self.tolerance.is_some() && self.h_next < remaining {
                // Two equal steps rather than a long and a very short one.
                h = if self.h_next > 0.5 * remaining { 0.5 * remaining } else { self.h_next };
            }
            let need_end = watch || self.tolerance.is_some() || !self.rhs_history.is_empty();
            self.trial(h, need_end);
            if let Some((rtol, atol)) = self.tolerance {
                let error = self.error(h, rtol, atol);
                let grow = (0.9 * error.max(1e-10).powf(-0.2)).clamp(0.2, 5.0);
                if error > 1.0 && h > SMALLEST_STEP * self.env.dt {
                    self.h_next = h * grow.min(0.9);
                    continue;
                }
                if h >= 0.99 * self.h_next.min(remaining) || grow < 1.0 {
                    self.h_next = h * grow;
                }
            }
            let mut event = false;
            if watch && self.events_here < MOST_EVENTS && self.least_slack(end) < 0.0 {
                h = self.locate_event(h);
                event = true;
            }
            self.accept(h, need_end);
            if event {
                self.events_here += 1;
                self.result.events += 1;
                self.handle_event(to);
            } else if watch && self.events_here >= MOST_EVENTS {
                let st = &mut self.stages[0];
                self.system.rhs.eval_natural(&mut st.regs, &mut self.modes);
                self.update_sticking();
                self.fresh = false;
            }
        }
        self.s = to;
    }

    /// Evaluates stage 0 anew (a signal may have jumped) and settles the modes there.
    fn begin(&mut self, to: f64) {
        let mid = 0.5 * (self.s + to);
        self.eval(0, self.s, mid);
        if !self.begun {
            self.begun = true;
            if !self.rhs_history.is_empty() {
                // The very start: what was before it is the expression's initial value.
                self.remember(0);
                self.eval(0, self.s, mid);
                self.remember(0); // with the slope that follows from it
            }
        }
        for _ in 0..8 {
            let mut changed = false;
            for i in 0..self.live.len() {
                let k = self.live[i];
                let sw = self.system.rhs.switches[k];
                if self.slack(0, k) < 0.0 {
                    let sticking = sw.kind == SwitchKind::Sign && self.modes[k] == 0;
                    let (a, b) = (self.stages[0].regs[sw.a as usize], self.stages[0].regs[sw.b as usize]);
                    self.modes[k] = if sticking {
                        if self.stages[0].lambda[k] > 0.0 { 1 } else { -1 }
                    } else {
                        sw.natural_mode(a, b)
                    };
                    changed = true;
                }
            }
            if !changed {
                break;
            }
            self.update_sticking();
            self.eval(0, self.s, mid);
        }
        self.note_scale(0);
        self.fresh = true;
    }

    fn update_sticking(&mut self) {
        self.sticking.clear();
        for &k in &self.live {
            if self.system.rhs.switches[k].kind == SwitchKind::Sign && self.modes[k] == 0 {
                self.sticking.push(k);
            }
        }
    }

    fn error(&self, h: f64, rtol: f64, atol: f64) -> f64 {
        let nx = self.system.nx;
        let mut sum = 0.0;
        // (Backwards: a chain's noise comes from its end.)
        let mut noise = 0.0;
        for r in (0..nx).rev() {
            noise = match self.source[r].checked_sub(self.system.highest()) {
                Some(_) => h * self.rounding(r),
                None => h * noise,
            };
            let e = dot(self.tableau.e, &self.rates.f[r * self.rates.stages..]) * h;
            let e = (e.abs() - noise).max(0.0);
            let size = self.x[r].abs().max(self.x1[r].abs());
            let floor = self.reach[r].max(size).max(f64::MIN_POSITIVE);
            let e = e / (atol * floor + rtol * size);
            sum += e * e;
        }
        let error = (sum / nx as f64).sqrt();
        if error.is_finite() { error } else { 1e10 }
    }

    /// What rounding of the forces that hold the sticking signs does to entry `r` of ẋ. Where all else is at rest,
    /// error control relative to the motion would chase it with ever smaller steps.
    fn rounding(&self, r: usize) -> f64 {
        const ROUNDED: f64 = 64.0 * f64::EPSILON;
        let (nx, st) = (self.system.nx, &self.stages[0]);
        let pull = |(i, &k): (usize, &usize)| (st.held.pull[i * nx + r] * st.lambda[k]).abs();
        ROUNDED * self.sticking.iter().enumerate().map(pull).sum::<f64>()
    }

    /// Finds the first h' ≤ h at which a mode is left; leaves the trial of h' in place.
    fn locate_event(&mut self, h: f64) -> f64 {
        let end = self.tableau.b.len();
        let (mut lo, mut hi) = (0.0, h);
        let mut flo = self.least_slack(0).max(0.0);
        let mut fhi = self.least_slack(end);
        let mut side = 0;
        for i in 0..80 {
            if hi - lo <= 1e-14 * h || fhi.abs() <= 1e-15 {
                break;
            }
            // Illinois, with a bisection now and then for functions with a corner.
            let t = if i % 6 == 5 || !fhi.is_finite() {
                0.5 * (lo + hi)
            } else {
                (lo * fhi - hi * flo) / (fhi - flo)
            };
            // (A state that overflows within the step leaves no slack to interpolate.)
            let t = if t.is_finite() { t } else { 0.5 * (lo + hi) };
            let (least, most) = (lo + 1e-3 * (hi - lo), hi - 1e-3 * (hi - lo));
            if least > most || least.is_nan() || most.is_nan() {
                break;
            }
            let t = t.clamp(least, most);
            self.trial(t, true);
            let f = self.least_slack(end);
            if f < 0.0 {
                hi = t;
                fhi = f;
                if side == -1 {
                    flo *= 0.5;
                }
                side = -1;
                // Just past the event by no more than rounding: good enough.
                let violated = self.live.iter().filter(|&&k| self.slack(end, k) < 0.0);
                if violated.into_iter().all(|&k| self.slack(end, k) > -self.event_tolerance(k)) {
                    return t;
                }
            } else {
                lo = t;
                flo = f;
                if side == 1 {
                    fhi *= 0.5;
                }
                side = 1;
            }
        }
        self.trial(hi, true);
        hi
    }

    fn event_tolerance(&self, k: usize) -> f64 {
        let sticking = self.system.rhs.switches[k].kind == SwitchKind::Sign && self.modes[k] == 0;
        if sticking { 1e-9 } else { 1e-11 * self.scale[k] }
    }

    /// Takes the trial step over: sensitivities, state, time, history.
    fn accept(&mut self, h: f64, has_end: bool) {
        if self.lanes > 0 {
            self.tangent_step(h);
        }
        std::mem::swap(&mut self.x, &mut self.x1);
        self.s += h;
        self.result.steps += 1;
        let mut bad = false;
        for (x, reach) in self.x.iter().zip(&mut self.reach) {
            *reach = reach.max(x.abs());
            bad |= !x.is_finite() || x.abs() > LIMIT;
        }
        if bad {
            self.result.diverged = Some(usize::MAX);
            return;
        }
        if has_end {
            let end = self.tableau.b.len();
            self.stages.swap(0, end);
            self.rates.swap(0, end);
            self.fresh = true;
            self.remember(0);
        } else {
            self.fresh = false;
        }
    }

    /// Stores the delayed expressions' values at stage `b`.
    fn remember(&mut self, b: usize) {
        if self.rhs_history.is_empty() {
            return;
        }
        let tape = &self.system.rhs;
        let needed = (0..tape.delays.len()).any(|i| self.delayed_input(tape.delays[i].arg_leaf).is_none());
        if !needed {
            return;
        }
        self.slopes(b, false);
        if self.lanes > 0 {
            self.tangent_here(b);
        }
        for i in 0..tape.delays.len() {
            let arg = tape.delays[i].arg as usize;
            let st = &self.stages[b];
            let lanes = &self.d[arg * self.width..][..self.lanes];
            self.rhs_history[i].push(st.s, st.regs[arg], self.gd[arg], lanes);
        }
    }

    /// Tangents of all registers at stage `b` for the tangents of the state at the step's start.
    fn tangent_here(&mut self, b: usize) {
        let width = self.width;
        self.d[System::STATES * width..][..self.dx.len()].copy_from_slice(&self.dx);
        self.tangent_at(b, width);
    }

    /// Tangents of all registers at stage `b` for the state tangents that stand in `self.d`.
    #[inline(always)]
    fn tangent_at(&mut self, b: usize, width: usize) {
        let system = self.system;
        let st = &self.stages[b];
        if !self.seeds.signals.inputs.is_empty() {
            let first = self.seeds.parameters.len() + self.seeds.initial.len();
            let count = self.seeds.signals.lanes;
            let (k, w) = locate(st.s, st.mid, self.env.dt, self.env.len);
            for (i, change) in &self.seeds.signals.inputs {
                let row = &mut self.d[(system.inputs() + i) * width + first..][..count];
                lerp(change, k, w, self.env.len, count, row);
            }
        }
        if !system.rhs.delays.is_empty() {
            self.tangent_delays(b);
        }
        let st = &self.stages[b];
        system.rhs.tangent(&self.tangents, &st.regs, &self.modes, width, &mut self.d);
    }

    /// Tangents of the delayed values of stage `b`.
    fn tangent_delays(&mut self, b: usize) {
        let (lanes, width) = (self.lanes, self.width);
        let st = &self.stages[b];
        for (i, delay) in self.system.rhs.delays.iter().enumerate() {
            let tau = delay.tau as usize;
            let slope = st.delayed_slopes[i];
            let leaf = delay.leaf as usize;
            for l in 0..lanes {
                self.d[leaf * width + l] = -slope * self.d[tau * width + l];
            }
            if self.delayed_input(delay.arg_leaf).is_none() {
                let history = &self.rhs_history[i];
                let at = st.s - st.regs[tau].max(0.0);
                let (_, _, j, w) = history.at(at);
                if !history.s.is_empty() {
                    let next = (j + 1).min(history.s.len() - 1);
                    for l in 0..lanes {
                        let (a, b) = (history.lanes[j * lanes + l], history.lanes[next * lanes + l]);
                        self.d[leaf * width + l] += a + w * (b - a);
                    }
                }
            }
        }
    }

    /// Derivative of stage `b`'s ẋ along the lanes into `self.dk[b]`, for the state tangents that stand in `self.d`.
    #[inline(always)]
    fn tangent_stage(&mut self, b: usize, width: usize) {
        self.tangent_at(b, width);
        let system = self.system;
        let (nx, nz) = (system.nx, system.nz);
        let outputs = &system.rhs.outputs;
        let st = &self.stages[b];
        for i in 0..nz {
            let row = &mut self.b[i * width..][..width];
            let h = &self.d[outputs[nz * nz + i] as usize * width..][..width];
            for (r, h) in row.iter_mut().zip(h) {
                *r = -h;
            }
            for j in 0..nz {
                let reg = outputs[i * nz + j];
                if self.tangents.is_active(reg) {
                    let z = st.regs[system.highest() + j];
                    for (r, m) in row.iter_mut().zip(&self.d[reg as usize * width..][..width]) {
                        *r -= m * z;
                    }
                }
            }
        }
        if !self.seeds.signals.force.is_empty() {
            self.tangent_forces(b);
        }
        let st = &self.stages[b];
        small::solve_rows(&st.lu, &st.pivots, nz, &mut self.b, width);
        let dk = &mut self.dk[b * nx * width..][..nx * width];
        for (dk, &source) in dk.chunks_exact_mut(width).zip(&self.source) {
            let from = match source.checked_sub(system.highest()) {
                Some(j) => &self.b[j * width..][..width],
                None => &self.d[source * width..][..width],
            };
            dk.copy_from_slice(from);
        }
        if !self.sticking.is_empty() && st.held.ok {
            self.tangent_sticking(b);
        }
    }

    /// The lanes of exogenous forces, into the right-hand side of the equations' tangents.
    fn tangent_forces(&mut self, b: usize) {
        let st = &self.stages[b];
        let signals = &self.seeds.signals;
        let first = self.seeds.parameters.len() + self.seeds.initial.len();
        let count = signals.lanes;
        let (k, w) = locate(st.s, st.mid, self.env.dt, self.env.len);
        let a = &signals.force[k * count..][..count];
        let c = &signals.force[(k + 1).min(self.env.len - 1) * count..][..count];
        for i in 0..self.system.nz {
            let weights = &signals.weights[i * count..][..count];
            let row = &mut self.b[i * self.width + first..][..count];
            for l in 0..count {
                row[l] -= weights[l] * (a[l] + w * (c[l] - a[l]));
            }
        }
    }

    /// dλ keeps the derivative of ġ zero: ∇g·(dẋ + Σ pull dλ) = 0.
    fn tangent_sticking(&mut self, b: usize) {
        let (nx, width) = (self.system.nx, self.width);
        let held = &self.stages[b].held;
        let dk = &mut self.dk[b * nx * width..][..nx * width];
        let m = self.sticking.len();
        let dl = &mut self.dl;
        dl.clear();
        dl.resize(m * width, 0.0);
        for i in 0..m {
            for r in 0..nx {
                let g = held.gradient[i * nx + r];
                if g != 0.0 {
                    for l in 0..width {
                        dl[i * width + l] -= g * dk[r * width + l];
                    }
                }
            }
        }
        small::solve(&held.b, &held.pivots, m, dl, width);
        for i in 0..m {
            for r in 0..nx {
                let p = held.pull[i * nx + r];
                if p != 0.0 {
                    for l in 0..width {
                        dk[r * width + l] += p * dl[i * width + l];
                    }
                }
            }
        }
    }

    /// Derivatives along the lanes of ẋ at the step's start, stage 0, into `self.dk[0]`.
    fn rate_here(&mut self) {
        let width = self.width;
        self.d[System::STATES * width..][..self.dx.len()].copy_from_slice(&self.dx);
        self.tangent_stage(0, width);
    }

    /// The sensitivities' step that belongs to the trial step of length `h`.
    fn tangent_step(&mut self, h: f64) {
        self.arch.dispatch(TangentStep { core: self, h });
    }

    #[inline(always)]
    fn tangent_step_of(&mut self, h: f64, width: usize) {
        let n = self.system.nx * width;
        let tableau = self.tableau;
        for i in 0..tableau.b.len() {
            let rows = &mut self.d[System::STATES * width..][..n];
            tangents_along(rows, &self.dx[..n], &self.dk, tableau.a[i], h);
            self.tangent_stage(i, width);
        }
        let rows = &mut self.d[System::STATES * width..][..n];
        tangents_along(rows, &self.dx[..n], &self.dk, tableau.b, h);
        self.dx.copy_from_slice(rows);
    }

    /// At (s, x), with stage 0 evaluated there in the old modes: changes the modes that were left.
    fn handle_event(&mut self, to: f64) {
        let (lanes, width) = (self.lanes, self.width);
        let left: Vec<usize> = self.live.iter().copied().filter(|&k| self.slack(0, k) < 0.0).collect();
        let Some(&primary) = left.first() else { return };
        let before: Vec<f64> = self.rates.stage(0).collect();
        // dtₑ of the primary event, in the old modes.
        let mut dte = Vec::new();
        let released = self.system.rhs.switches[primary].kind == SwitchKind::Sign && self.modes[primary] == 0;
        if lanes > 0 && !released {
            self.slopes(0, false);
            let sw = self.system.rhs.switches[primary];
            let (ra, rb) = (sw.a as usize, sw.b as usize);
            let two = ra != rb;
            // Dead zone and saturation: g = |a| − b on the side where it happens.
            let two_sided = matches!(sw.kind, SwitchKind::Deadzone | SwitchKind::Saturate);
            let side = if two_sided && self.stages[0].regs[ra] < 0.0 { -1.0 } else { 1.0 };
            let rate = side * self.gd[ra] - if two { self.gd[rb] } else { 0.0 };
            let size = before.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            if rate.abs() > 1e-12 * size.max(1e-300) {
                self.tangent_here(0);
                dte = (0..lanes)
                    .map(|l| {
                        let g =
                            side * self.d[ra * width + l] - if two { self.d[rb * width + l] } else { 0.0 };
                        -g / rate
                    })
                    .collect();
            }
        }
        let mid = 0.5 * (self.s + to);
        for &k in &left {
            let sw = self.system.rhs.switches[k];
            match sw.kind {
                SwitchKind::Sign if self.modes[k] == 0 => {
                    self.modes[k] = if self.stages[0].lambda[k] > 0.0 { 1 } else { -1 };
                    self.update_sticking();
                }
                SwitchKind::Sign => self.decide(k, mid - self.s),
                SwitchKind::Deadzone | SwitchKind::Saturate => {
                    self.modes[k] = match self.modes[k] {
                        0 => {
                            if self.stages[0].regs[sw.a as usize] < 0.0 {
                                -1
                            } else {
                                1
                            }
                        }
                        _ => 0,
                    }
                }
                _ => self.modes[k] = -self.modes[k],
            }
        }
        self.eval(0, self.s, mid);
        self.fresh = true;
        if !dte.is_empty() {
            for i in 0..self.system.nx {
                let jump = before[i] - self.rates.at(0, i);
                if jump != 0.0 {
                    for l in 0..lanes {
                        self.dx[i * width + l] += jump * dte[l];
                    }
                }
            }
        }
        self.remember(0);
    }

    /// Sign `k` has reached zero: sticks when its multiplier may hold it, else crosses.
    fn decide(&mut self, k: usize, ahead: f64) {
        let old = self.modes[k];
        self.modes[k] = 0;
        self.update_sticking();
        let at = self.sticking.iter().position(|&j| j == k).unwrap_or(0);
        self.eval(0, self.s, self.s + ahead);
        let st = &self.stages[0];
        let (lambda, slope) = (st.lambda[k], st.held.diagonal.get(at).copied().unwrap_or(0.0));
        if st.held.ok && slope < 0.0 {
            if lambda.abs() <= 1.0 {
                let leaf = self.system.rhs.switches[k].a as usize;
                if (System::STATES..System::STATES + self.system.nx).contains(&leaf) {
                    self.x[leaf - System::STATES] = 0.0;
                }
                return;
            }
            self.modes[k] = if lambda > 0.0 { 1 } else { -1 };
        } else {
            self.modes[k] = -old;
        }
        self.stages[0].lambda[k] = 0.0;
        self.update_sticking();
    }

    /// Writes sample `row` of the result.
    fn record(&mut self, row: usize) {
        let system = self.system;
        let (nx, ny, lanes, n) = (system.nx, system.ny, self.lanes, self.result.n);
        if self.result.diverged.is_some() {
            self.result.diverged = Some(row);
            return;
        }
        for i in 0..nx {
            self.result.x[i * n + row] = self.x[i];
        }
        self.observe();
        let out = &system.output;
        for (c, &reg) in out.outputs.iter().enumerate() {
            self.result.y[c * n + row] = self.out_regs[reg as usize];
        }
        if lanes > 0 {
            for (c, &reg) in out.outputs.iter().enumerate() {
                let d = &self.out_d[reg as usize * self.width..][..lanes];
                for (l, v) in d.iter().enumerate() {
                    self.result.dy[(l * ny + c) * n + row] = *v;
                }
            }
            let first = self.seeds.parameters.len() + self.seeds.initial.len();
            let count = self.seeds.signals.lanes;
            let k = ((self.s / self.env.dt).round() as usize).min(self.env.len.saturating_sub(1));
            for (c, change) in &self.seeds.signals.outputs {
                for (l, v) in change[k * count..(k + 1) * count].iter().enumerate() {
                    self.result.dy[((first + l) * ny + c) * n + row] += v;
                }
            }
        }
    }

    /// The outputs and their tangents now, into `out_regs` and `out_d`; delayed ones remember it.
    fn observe(&mut self) {
        let system = self.system;
        let (nx, lanes, width) = (system.nx, self.lanes, self.width);
        // The output belongs to the instant of the sample: inputs with the value they take then.
        let inside = self.s + 1e-6 * self.env.dt;
        if system.output_needs_z {
            self.eval(0, self.s, inside);
            self.fresh = false;
            let highest = system.highest()..system.highest() + system.nz;
            self.out_regs[highest.clone()].copy_from_slice(&self.stages[0].regs[highest.clone()]);
            if lanes > 0 {
                self.rate_here();
                for (r, &to) in self.source.iter().enumerate().filter(|s| highest.contains(s.1)) {
                    self.out_d[to * width..][..width].copy_from_slice(&self.dk[r * width..][..width]);
                }
            }
        }
        let out = &system.output;
        self.out_regs[System::TIME] = self.env.start + self.s;
        self.out_regs[System::STATES..System::STATES + nx].copy_from_slice(&self.x);
        for (i, u) in self.env.inputs.iter().enumerate() {
            self.out_regs[system.inputs() + i] = u.at(self.s, inside).0;
        }
        if lanes > 0 {
            self.out_d[System::STATES * width..][..nx * width].copy_from_slice(&self.dx);
            let first = self.seeds.parameters.len() + self.seeds.initial.len();
            let count = self.seeds.signals.lanes;
            for (i, change) in &self.seeds.signals.inputs {
                let (k, w) = locate(self.s, inside, self.env.dt, self.env.len);
                let to = &mut self.out_d[(system.inputs() + i) * width + first..][..count];
                lerp(change, k, w, self.env.len, count, to);
            }
        }
        if !out.delays.is_empty() {
            self.output_delays();
        }
        out.eval_natural(&mut self.out_regs, &mut self.out_modes);
        if lanes > 0 {
            out.tangent(&self.out_tangents, &self.out_regs, &self.out_modes, width, &mut self.out_d);
        }
    }

    /// Delayed values of the measurements (sensor delays), sample by sample.
    fn output_delays(&mut self) {
        let system = self.system;
        let (out, lanes, width) = (&system.output, self.lanes, self.width);
        // The arguments now, for the history; nested delays read the values of earlier samples.
        out.eval_natural(&mut self.out_regs, &mut self.out_modes);
        if lanes > 0 {
            out.tangent(&self.out_tangents, &self.out_regs, &self.out_modes, width, &mut self.out_d);
        }
        // A state's slope is its rate; before the start it goes straight on along it.
        let states = || out.delays.iter().map(|d| state_leaf(system, d.arg_leaf));
        let begins = states().zip(&self.out_history).any(|(x, h)| x.is_some() && h.s.is_empty());
        if begins || (!self.fresh && states().any(|x| x.is_some())) {
            let inside = self.s + 1e-6 * self.env.dt;
            self.eval(0, self.s, inside);
            self.fresh = false;
            if begins && lanes > 0 {
                self.rate_here();
            }
        }
        for (i, delay) in out.delays.iter().enumerate() {
            let arg = delay.arg as usize;
            // Slope by the flow where the argument is a state, else by the last difference.
            let value = self.out_regs[arg];
            let history = &mut self.out_history[i];
            let slope = match history.s.last() {
                Some(&s) if self.s > s => (value - history.value[history.value.len() - 1]) / (self.s - s),
                // Where the stretch goes on from another, which left its slope here.
                Some(_) => history.slope[history.slope.len() - 1],
                None => 0.0,
            };
            let first = history.s.is_empty();
            let slope = match state_leaf(system, delay.arg_leaf) {
                Some(x) => {
                    if first {
                        history.rate = self.dk[x * width..][..lanes].to_vec();
                    }
                    self.rates.at(0, x)
                }
                None => slope,
            };
            history.push(self.s, value, slope, &self.out_d[arg * width..][..lanes]);
            let tau = delay.tau as usize;
            let at = self.s - self.out_regs[tau].max(0.0);
            if at < history.s[0] {
                // Straight on, before the start.
                let back = at - history.s[0];
                self.out_regs[delay.leaf as usize] = history.value[0] + back * history.slope[0];
                for l in 0..lanes {
                    let rate = history.rate.get(l).copied().unwrap_or(0.0);
                    self.out_d[delay.leaf as usize * width + l] =
                        history.lanes[l] + back * rate - history.slope[0] * self.out_d[tau * width + l];
                }
                continue;
            }
            let (v, slope, j, w) = history.at(at);
            self.out_regs[delay.leaf as usize] = v;
            let next = (j + 1).min(history.s.len() - 1);
            for l in 0..lanes {
                let (a, b) = (history.lanes[j * lanes + l], history.lanes[next * lanes + l]);
                self.out_d[delay.leaf as usize * width + l] =
                    a + w * (b - a) - slope * self.out_d[tau * width + l];
            }
        }
    }

    /// After divergence: the last good sample is held to the end, its sensitivities are zero.
    fn freeze(&mut self, row: usize, n: usize) {
        self.result.diverged = Some(row);
        let from = row.saturating_sub(1);
        for column in self.result.y.chunks_mut(n).chain(self.result.x.chunks_mut(n)) {
            let held = column[from];
            column[row..].fill(held);
        }
        for column in self.result.dy.chunks_mut(n) {
            column[row..].fill(0.0);
        }
    }
}

/// Entry of the state vector that a leaf is.
fn state_leaf(system: &System, arg: Option<u32>) -> Option<usize> {
    let leaf = arg? as usize;
    (System::STATES..System::STATES + system.nx).contains(&leaf).then(|| leaf - System::STATES)
}

fn input_leaf(system: &System, arg: Option<u32>) -> bool {
    arg.is_some_and(|l| (system.inputs()..system.inputs() + system.nu).contains(&(l as usize)))
}

/// Sample before `s` and the weight of the next one; `inside` says which side of a sample.
#[inline]
fn locate(s: f64, inside: f64, dt: f64, len: usize) -> (usize, f64) {
    let k = (inside / dt).floor().clamp(0.0, (len - 1) as f64);
    let w = (s / dt - k).clamp(0.0, 1.0);
    (k as usize, w)
}

#[inline]
fn lerp(table: &[f64], k: usize, w: f64, len: usize, count: usize, out: &mut [f64]) {
    let a = &table[k * count..][..count];
    let b = &table[(k + 1).min(len - 1) * count..][..count];
    for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
        *o = a + w * (b - a);
    }
}
