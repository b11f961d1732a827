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

mod compiled;
mod event;
mod history;
mod record;
mod stage;
mod stepper;
mod stride;
mod tableau;
mod tangent;

use std::sync::Arc;

use greybox_model::Hold;
use greybox_model::system::System;
use greybox_model::tape::Tangents;
use pulp::Arch;

use self::compiled::Tail;
use self::event::MOST_EVENTS;
pub use self::history::{Carry, Past, delayed_states, delays, has_history};
use self::history::{History, LaneMap};
use self::stage::{Held, Rates, Stage, dot};
pub use self::stepper::Stepper;
use self::stride::Long;
use self::tableau::{DOP853, DP5, RK4, Tableau};
use self::tangent::width;
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
    /// Classical fourth-order Runge–Kutta, one step across so many sample intervals: for records taken far faster than the
    /// machine moves. The samples within come from the method's interpolant of the third order. Over a step, inputs are
    /// parabolas with the mean and the first and second moments of their samples. Steps end at the samples whose number is
    /// a multiple of `samples`. A model with delays, one whose outputs need the highest derivatives, and a
    /// [`Stepper`] go from sample to sample.
    Rk4Stride {
        /// Sample intervals per step (≥ 1).
        samples: usize,
    },
    /// Dormand–Prince 5(4) with error control; steps never straddle a sample.
    Adaptive {
        /// Relative tolerance.
        rtol: f64,
        /// Absolute tolerance, relative to the magnitude each state has reached so far.
        atol: f64,
    },
}

impl Method {
    /// Evaluations of the right-hand side between two samples; none are known beforehand with error control.
    pub fn evaluations(&self) -> f64 {
        let of = |stages: usize, steps: f64| stages as f64 * steps;
        match *self {
            Method::Rk4 { substeps } => of(RK4.b.len(), substeps as f64),
            Method::Dp5 { substeps } => of(DP5.b.len(), substeps as f64),
            Method::Dop853 { substeps } => of(DOP853.b.len(), substeps as f64),
            Method::Rk4Stride { samples } => of(RK4.b.len(), 1.0 / samples.max(1) as f64),
            Method::Adaptive { .. } => 0.0,
        }
    }

    /// The same where no step goes across several samples: from each to the next.
    pub fn at_every_sample(self) -> Method {
        match self {
            Method::Rk4Stride { .. } => Method::Rk4 { substeps: 1 },
            other => other,
        }
    }

    /// Sample intervals that one step goes across.
    pub fn stride(&self) -> usize {
        match *self {
            Method::Rk4Stride { samples } => samples.max(1),
            _ => 1,
        }
    }
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
    pub signals: Arc<SignalLanes>,
}

/// Directions that are signals: each adds a force, or a change of an input, to the trajectory.
#[derive(Debug, Clone, Default)]
pub struct SignalLanes {
    /// How many.
    pub lanes: usize,
    /// Weight of each lane's force in each equation, `equations × lanes`.
    pub weights: Vec<f64>,
    /// The forces, `rows × lanes` (empty: none).
    pub force: Vec<f64>,
    /// Changes of inputs: (input, `rows × lanes`).
    pub inputs: Vec<(usize, Vec<f64>)>,
    /// Changes of outputs: (channel, `rows × lanes`).
    pub outputs: Vec<(usize, Vec<f64>)>,
    /// The row of each sample (empty: a row for each). Tables need rows for what is simulated alone: those of a stretch and of the
    /// sample behind it, one after the other.
    pub rows: Vec<u32>,
}

impl SignalLanes {
    /// The row of a sample.
    #[inline]
    pub fn row(&self, sample: usize) -> usize {
        self.rows.get(sample).map_or(sample, |row| *row as usize)
    }
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
    /// Of [`Method::Adaptive`]'s accepted steps, those that stability kept short and not accuracy: h|λ| > 3.25, with
    /// |λ| estimated from the two stages at the step's end (Hairer & Wanner, Solving Ordinary Differential Equations
    /// II, section IV.2).
    pub stiff_steps: usize,
    /// The largest |λ| of all of [`Method::Adaptive`]'s accepted steps, 1/s: how fast the fastest mode is.
    pub fastest: f64,
    /// First sample that [`Method::Adaptive`] did not reach within [`MOST_TRIALS`] steps from the one before; the
    /// solution counts as diverged there.
    pub exhausted: Option<usize>,
}

impl Trajectory {
    /// Whether stability, and not accuracy, kept most of [`Method::Adaptive`]'s steps short: the model is stiff at this
    /// tolerance, and made for an implicit method.
    pub fn is_stiff(&self) -> bool {
        2 * self.stiff_steps > self.steps
    }
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

/// The trajectory's magnitude, relative to its inputs and start, beyond which it counts as diverged.
const LIMIT: f64 = 1e9;

/// Steps that [`Method::Adaptive`] tries from one sample to the next before it gives up, so that every simulation
/// ends.
pub const MOST_TRIALS: usize = 10_000;

/// Error of a step that leaves the numbers.
const UNDEFINED: f64 = 1e10;

/// Beyond this h|λ| a step of Dormand and Prince's method is at the border of its stability.
const STABLE: f64 = 3.25;

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
    /// The step across several samples.
    long: Long,
    /// The register that each entry of ẋ is.
    source: Vec<usize>,
    modes: Vec<i8>,
    sticking: Vec<usize>,
    live: Vec<usize>,
    /// Whether all switching functions depend on the state alone: no more is needed to see that a branch was left, unless a
    /// sign sticks.
    state_events: bool,
    scale: Vec<f64>,
    s: f64,
    x: Vec<f64>,
    x1: Vec<f64>,
    reach: Vec<f64>,
    /// Rows of tangents: of all registers, and behind them those of the state, of its rates at all stages, and of what the
    /// mass matrix is solved for.
    d: Aligned,
    at_dx: usize,
    at_dk: usize,
    at_b: usize,
    /// The step of the tangents as machine code, where that is all there is to it.
    step: Option<Arc<Vec<greybox_jit::Tangents>>>,
    /// The trial step as machine code.
    values: Option<Arc<greybox_jit::Values>>,
    /// Whether that solves the equations too.
    solves: bool,
    tail: Tail,
    tangents: Arc<Tangents>,
    /// Tangents of what holds the sticking switches.
    dl: Vec<f64>,
    gd: Vec<f64>,
    along: Arc<Tangents>,
    h_next: f64,
    fresh: bool,
    /// Whether the delayed expressions remember this stretch's start.
    begun: bool,
    /// Whether a step left every reasonable bound after the last recorded sample.
    lost: bool,
    zero_hold: bool,
    events_here: usize,
    /// Steps tried since the last sample, with error control.
    trials_here: usize,
    rhs_history: Vec<History>,
    out_regs: Vec<f64>,
    out_modes: Vec<i8>,
    out_d: Aligned,
    out_tangents: Arc<Tangents>,
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
            Method::Rk4Stride { .. } => (&RK4, 1, None),
            Method::Adaptive { rtol, atol } => (&DP5, 1, Some((rtol, atol))),
        };
        let tape = &system.rhs;
        let tail = Tail::of(system, tableau);
        let mut modes = vec![1i8; tail.modes()];
        let mut regs = vec![0.0; tail.registers()];
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
                tail.set_factors(st, &mut modes);
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
        let tangents = tape.compiled_tangents(&leaf_active, width);
        let at_dx = tape.registers() * width;
        let at_dk = at_dx + nx * width;
        let at_b = at_dk + tableau.b.len() * nx * width;
        let mut d = Aligned::zeros(at_b + tail.sides() * width);
        for (l, &p) in seeds.parameters.iter().enumerate() {
            d[(system.parameters() + p) * width + l] = 1.0;
        }
        if lanes > 0 {
            tape.prepare_tangent(&tangents, &regs, &modes, width, &mut d);
        }
        let mut gleaf = vec![true; tape.leaves()];
        gleaf[system.parameters()..system.parameters() + system.np].fill(false);
        let along = tape.compiled_tangents(&gleaf, 1);

        let out = &system.output;
        let mut out_regs = vec![0.0; out.registers()];
        out_regs[system.parameters()..][..system.np].copy_from_slice(parameters);
        let mut out_modes = vec![1i8; out.switches.len()];
        out.prepare(&mut out_regs, &mut out_modes);
        let mut out_leaf_active = vec![seeded_states; out.leaves()];
        out_leaf_active[System::TIME] = false;
        let out_tangents = out.compiled_tangents(&out_leaf_active, width);
        let mut out_d = Aligned::zeros(out.registers() * width);
        for (l, &p) in seeds.parameters.iter().enumerate() {
            out_d[(system.parameters() + p) * width + l] = 1.0;
        }
        if lanes > 0 {
            out.prepare_tangent(&out_tangents, &out_regs, &out_modes, width, &mut out_d);
        }
        for (l, &i) in seeds.initial.iter().enumerate() {
            d[at_dx + i * width + seeds.parameters.len() + l] = 1.0;
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
        let live: Vec<usize> = (0..tape.switches.len()).filter(|&k| tape.switches[k].live).collect();
        let is_known = |r: u32| state_leaf(system, Some(r)).is_some() || tape.is_fixed(r);
        let state_events = live.iter().all(|&k| is_known(tape.switches[k].a) && is_known(tape.switches[k].b));
        let mut source: Vec<usize> = (0..nx).map(|r| System::STATES + r + 1).collect();
        for j in 0..nz {
            source[system.offsets[j] + system.orders[j] - 1] = system.highest() + j;
        }
        let solves = tail.solves(system) && env.forces.is_empty();
        let values = tail.values(system, tableau, &source, solves);
        let moves = !seeds.signals.inputs.is_empty() || !seeds.signals.force.is_empty();
        let step = match lanes > 0 && !moves {
            true => tail.step(system, (&leaf_active, width), tableau, &tangents, &source),
            false => None,
        };
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
            rates: Rates::new(nx, stages.len(), tail.shared()),
            pieces: env.inputs.iter().map(|u| u.piece(s)).collect(),
            mid: s,
            long: Long::new(if can_stride(system) { method.stride() } else { 1 }),
            source,
            sticking: Vec::new(),
            live,
            state_events,
            scale: vec![0.0; modes.len()],
            modes,
            s,
            x: x0.to_vec(),
            x1: vec![0.0; nx],
            reach: x0.iter().map(|v| v.abs()).collect(),
            d,
            at_dx,
            at_dk,
            at_b,
            step,
            values,
            solves,
            tail,
            tangents,
            dl: Vec::new(),
            gd: Vec::new(),
            along,
            h_next: env.dt,
            fresh: false,
            begun: false,
            lost: false,
            zero_hold: env.inputs.iter().any(|u| u.hold() == Hold::Zero),
            events_here: 0,
            trials_here: 0,
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
            self.d[self.at_dx..][i * self.width..][..self.lanes].copy_from_slice(&row);
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
            let rows =
                self.d[self.at_dx..self.at_dk].chunks_exact(self.width.max(1)).flat_map(|row| &row[..lanes]);
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
        if self.long.samples > 1 {
            self.run_long(range, go_on);
            return std::mem::take(&mut self.result);
        }
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

    /// The same in steps across several samples.
    fn run_long(&mut self, range: std::ops::Range<usize>, go_on: bool) {
        let (n, recorded) = (range.len(), range.end);
        let end =
            if go_on { range.end.min(self.env.len.saturating_sub(1)) } else { range.end.saturating_sub(1) };
        let stride = self.long.samples;
        self.long.from = range.start;
        let mut k = range.start;
        while k < recorded {
            self.s = k as f64 * self.env.dt;
            self.record(k - range.start);
            // (Within a step, no sample is recorded once the solution has left every bound.)
            if self.result.diverged.is_some() {
                self.freeze(self.long.next.clamp(range.start, k) - range.start, n);
                return;
            }
            if k >= end {
                return;
            }
            let mut to = ((k / stride + 1) * stride).min(end);
            // What is beyond the last sample is no part of the result.
            if k + 1 < recorded {
                to = to.min(recorded - 1);
            }
            self.cross_samples(k, to);
            k = to;
        }
        self.lost = self.result.diverged.take().is_some();
    }

    /// From sample `k` to the next.
    fn cross_interval(&mut self, k: usize) {
        let s0 = k as f64 * self.env.dt;
        let s1 = (k + 1) as f64 * self.env.dt;
        self.events_here = 0;
        self.trials_here = 0;
        if self.zero_hold {
            self.fresh = false;
        }
        for (at, jump) in self.breakpoints(s0) {
            self.advance(at, false);
            match jump {
                Some(delay) => self.jump_of_delay(delay, at, s1),
                // The slope, and with it the sensitivity to the delay, is another after a bend.
                None => self.fresh = false,
            }
        }
        let substeps = self.substeps;
        if self.tolerance.is_none() && substeps > 1 {
            let h = self.env.dt / substeps as f64;
            for i in 1..substeps {
                let at = s0 + i as f64 * h;
                if at > self.s {
                    self.advance(at, false);
                }
            }
        }
        self.advance(s1, self.zero_hold);
    }

    /// Instants inside (s0, s0 + dt) at which a delayed input jumps (zero-order hold: with the delay that does) or bends
    /// (linear between its samples): no step crosses one.
    fn breakpoints(&self, s0: f64) -> Vec<(f64, Option<usize>)> {
        let mut found = Vec::new();
        for (i, delay) in self.system.rhs.delays.iter().enumerate() {
            let Some(u) = self.delayed_input(delay.arg_leaf) else { continue };
            let hold = self.env.inputs[u].hold();
            if hold != Hold::BandLimited {
                let tau = self.stages[0].regs[delay.tau as usize];
                let offset = tau.rem_euclid(self.env.dt);
                found.push((s0 + offset, (hold == Hold::Zero).then_some(i)));
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
                    self.d[self.at_dx + i * self.width + l] += jump * self.d[tau * self.width + l];
                }
            }
        }
        self.fresh = false;
    }

    /// One trial step of length `h` from (s, x), stage 0 evaluated there; the result in `x1`, and with `end` evaluated there.
    fn trial(&mut self, h: f64, end: bool) {
        if let Some(values) = self.values.take() {
            self.compiled_trial(&values, h, end);
            self.values = Some(values);
            return;
        }
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
        if end || !self.live.is_empty() {
            self.stages[last].regs[System::STATES..][..nx].copy_from_slice(&self.x1);
        }
        if end {
            self.eval_stage(last, self.s + h, mid);
        }
    }

    /// Integrates to `to`, through whatever events lie before it. `jumps`: an input may jump there, so that the right-hand side is
    /// evaluated anew from there on.
    fn advance(&mut self, to: f64, jumps: bool) {
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
            // Before an input jumps, an end at which the state alone shows that a branch was left need not be evaluated.
            let is_seen = self.state_events && self.sticking.is_empty() && self.events_here < MOST_EVENTS;
            let needs_end = watch && !(jumps && is_seen);
            let mut has_end = needs_end || self.tolerance.is_some() || !self.rhs_history.is_empty();
            self.trial(h, has_end);
            if let Some((rtol, atol)) = self.tolerance {
                let error = self.error(h, rtol, atol);
                let grow = (0.9 * error.max(1e-10).powf(-0.2)).clamp(0.2, 5.0);
                self.trials_here += 1;
                if self.trials_here > MOST_TRIALS {
                    self.result.exhausted = Some(usize::MAX);
                    self.result.diverged = Some(usize::MAX);
                    continue;
                }
                if error > 1.0 && h > tiny {
                    self.h_next = h * grow.min(0.9);
                    continue;
                }
                self.watch_stiffness(h);
                if h >= 0.99 * self.h_next.min(remaining) || grow < 1.0 {
                    self.h_next = h * grow;
                }
            }
            let mut event = false;
            if watch && self.events_here < MOST_EVENTS && self.least_slack(end) < 0.0 {
                h = self.locate_event(h);
                (event, has_end) = (true, true);
            }
            self.accept(h, has_end);
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
            // (The larger of zero and no number would be zero.)
            if !(e.is_finite() && noise.is_finite()) {
                return UNDEFINED;
            }
            let e = (e.abs() - noise).max(0.0);
            let size = self.x[r].abs().max(self.x1[r].abs());
            let floor = self.reach[r].max(size).max(f64::MIN_POSITIVE);
            let e = e / (atol * floor + rtol * size);
            sum += e * e;
        }
        let error = (sum / nx as f64).sqrt();
        if error.is_finite() { error } else { UNDEFINED }
    }

    /// Whether stability bounds the trial step: its last two stages are both at its end, and the difference of their
    /// rates over that of their states is the largest |λ|.
    fn watch_stiffness(&mut self, h: f64) {
        let end = self.tableau.b.len();
        let last = &self.stages[end - 1].regs[System::STATES..][..self.system.nx];
        let (mut rates, mut states, mut size) = (0.0, 0.0, 0.0);
        for (r, (x1, x)) in self.x1.iter().zip(last).enumerate() {
            rates += (self.rates.at(end, r) - self.rates.at(end - 1, r)).powi(2);
            states += (x1 - x).powi(2);
            size += x1 * x1;
        }
        // Stages that differ by rounding alone tell nothing.
        if states <= 1e-24 * size {
            return;
        }
        let rate = (rates / states).sqrt();
        if rate.is_finite() {
            self.result.stiff_steps += usize::from(h * rate > STABLE);
            self.result.fastest = self.result.fastest.max(rate);
        }
    }

    /// Takes the trial step over: sensitivities, state, time, history.
    fn accept(&mut self, h: f64, has_end: bool) {
        self.keep_start();
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
        self.record_within(h);
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
}

/// Whether a model can be simulated in steps across several samples ([`Method::Rk4Stride`]): nothing in it is delayed, and no
/// output needs the highest derivatives.
pub fn can_stride(system: &System) -> bool {
    system.rhs.delays.is_empty() && system.output.delays.is_empty() && !system.output_needs_z
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
fn lerp(table: &[f64], [a, b]: [usize; 2], w: f64, count: usize, out: &mut [f64]) {
    let a = &table[a * count..][..count];
    let b = &table[b * count..][..count];
    for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
        *o = a + w * (b - a);
    }
}
