//! One evaluation of the right-hand side.

use greybox_jit::Values;
use greybox_model::system::System;

use super::{Core, locate};
use crate::small;

/// One evaluation of the right-hand side, kept for the tangent pass.
pub(super) struct Stage {
    pub(super) regs: Vec<f64>,
    pub(super) lu: Vec<f64>,
    pub(super) pivots: Vec<usize>,
    pub(super) slopes: Vec<f64>,
    pub(super) delayed_slopes: Vec<f64>,
    pub(super) s: f64,
    pub(super) mid: f64,
    pub(super) lambda: Vec<f64>,
    pub(super) held: Held,
}

/// What holds the sticking switches of a stage: ġ = a + Bλ = 0.
#[derive(Default)]
pub(super) struct Held {
    /// For each: gradient of its argument (nx), and f(λ=1) − f(λ=0) (nx).
    pub(super) gradient: Vec<f64>,
    pub(super) pull: Vec<f64>,
    pub(super) a: Vec<f64>,
    /// B, factored.
    pub(super) b: Vec<f64>,
    pub(super) pivots: Vec<usize>,
    pub(super) diagonal: Vec<f64>,
    pub(super) ok: bool,
    /// f(λ=0).
    pub(super) f0: Vec<f64>,
}

impl Held {
    pub(super) fn resize(&mut self, switches: usize, states: usize) {
        self.gradient.resize(switches * states, 0.0);
        self.pull.resize(switches * states, 0.0);
        self.a.resize(switches, 0.0);
        self.b.resize(switches * switches, 0.0);
        self.pivots.resize(switches, 0);
        self.diagonal.resize(switches, 0.0);
        self.f0.resize(states, 0.0);
    }
}

/// ẋ of every stage.
pub(super) struct Rates {
    /// Entry by entry, the stages of one side by side; behind them what the programs of a step share ([`super::compiled`]).
    pub(super) f: Vec<f64>,
    pub(super) stages: usize,
    entries: usize,
}

impl Rates {
    pub(super) fn new(entries: usize, stages: usize, shared: usize) -> Rates {
        Rates { f: vec![0.0; shared], stages, entries }
    }

    pub(super) fn at(&self, stage: usize, entry: usize) -> f64 {
        self.f[entry * self.stages + stage]
    }

    pub(super) fn set(&mut self, stage: usize, entry: usize, value: f64) {
        self.f[entry * self.stages + stage] = value;
    }

    pub(super) fn stage(&self, stage: usize) -> impl Iterator<Item = f64> {
        self.f[..self.entries * self.stages].iter().skip(stage).step_by(self.stages).copied()
    }

    pub(super) fn swap(&mut self, a: usize, b: usize) {
        self.f[..self.entries * self.stages].chunks_exact_mut(self.stages).for_each(|entry| entry.swap(a, b));
    }

    /// out = x + h Σ weight · f over the stages that have a weight, in their order.
    #[inline(always)]
    pub(super) fn along(&self, out: &mut [f64], x: &[f64], weights: &[f64], h: f64) {
        for ((out, x), f) in out.iter_mut().zip(x).zip(self.f.chunks_exact(self.stages)) {
            let mut terms = weights.iter().zip(f).filter(|(w, _)| **w != 0.0).map(|(w, f)| w * f);
            let first = terms.next().unwrap_or(0.0);
            *out = x + h * terms.fold(first, |sum, term| sum + term);
        }
    }
}

#[inline(always)]
pub(super) fn dot(weights: &[f64], f: &[f64]) -> f64 {
    weights.iter().zip(f).fold(0.0, |sum, (w, f)| sum + w * f)
}

impl Core<'_> {
    pub(super) fn delayed_input(&self, arg: Option<u32>) -> Option<usize> {
        let leaf = arg? as usize;
        (self.system.inputs()..self.system.inputs() + self.system.nu)
            .contains(&leaf)
            .then(|| leaf - self.system.inputs())
    }

    /// Evaluates the right-hand side at the state `self.x` into stage `b`.
    pub(super) fn eval(&mut self, b: usize, s: f64, mid: f64) {
        self.stages[b].regs[System::STATES..][..self.system.nx].copy_from_slice(&self.x);
        self.eval_stage(b, s, mid);
    }

    /// Evaluates the right-hand side at the state that stands in the registers of stage `b`.
    #[inline]
    pub(super) fn eval_stage(&mut self, b: usize, s: f64, mid: f64) {
        self.set_instant(b, s, mid);
        if !self.system.rhs.delays.is_empty() {
            self.eval_delays(b, s, mid);
        }
        if b == 0
            && let Some(values) = self.values.take()
        {
            self.compiled_start(&values);
            self.values = Some(values);
        } else if self.sticking.is_empty() {
            self.eval_free(b);
        } else {
            self.eval_sticking(b, None);
        }
    }

    /// Time and inputs of stage `b`.
    #[inline(always)]
    pub(super) fn set_instant(&mut self, b: usize, s: f64, mid: f64) {
        let system = self.system;
        if mid != self.mid && !self.long.active {
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

    /// The right-hand side of stage `b`, with the values of sticking signs as they stand.
    #[inline]
    fn eval_free(&mut self, b: usize) {
        let st = &mut self.stages[b];
        self.system.rhs.eval(&mut st.regs, &mut self.modes, &st.lambda);
        self.solve(b);
    }

    /// The right-hand side of stage `b` again, where the values of these sticking signs have changed: by its program, or what depends
    /// on them.
    fn eval_again(&mut self, b: usize, program: Option<(&Values, usize)>, changed: &[usize]) {
        if let Some((values, which)) = program {
            self.compiled_free(values, which, b);
            return;
        }
        let st = &mut self.stages[b];
        for &k in changed {
            self.system.rhs.eval_after(k, &mut st.regs, &mut self.modes, &st.lambda);
        }
        self.solve(b);
    }

    /// Highest derivatives (into their registers) and ẋ of stage `b`, whose equations are evaluated.
    #[inline(always)]
    pub(super) fn solve(&mut self, b: usize) {
        let system = self.system;
        let nz = system.nz;
        let st = &mut self.stages[b];
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
            for (i, force) in self.env.forces.iter().enumerate() {
                let (a, b) = (force.samples[k], force.samples[(k + 1).min(self.env.len - 1)]);
                let long = self.long.active.then(|| self.long.force(i, st.s, self.env.dt));
                let v = long.unwrap_or(a + w * (b - a));
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

    /// The right-hand side while some signs stick: λ solves ġ = a + Bλ = 0. By the program of the stage, where it has one.
    pub(super) fn eval_sticking(&mut self, b: usize, program: Option<(&Values, usize)>) {
        let tape = &self.system.rhs;
        let nx = self.system.nx;
        let sticking = std::mem::take(&mut self.sticking);
        let m = sticking.len();
        for &k in &sticking {
            self.stages[b].lambda[k] = 0.0;
        }
        match program {
            Some((values, which)) => self.compiled_free(values, which, b),
            None => self.eval_free(b),
        }
        let mut held = std::mem::take(&mut self.stages[b].held);
        held.resize(m, nx);
        let f0 = &mut held.f0;
        f0.iter_mut().zip(self.rates.stage(b)).for_each(|(f0, f)| *f0 = f);
        self.gradients(b, &sticking, &mut held);
        for (i, &k) in sticking.iter().enumerate() {
            // (Each is seen without the others.)
            let before = i.saturating_sub(1);
            self.stages[b].lambda[sticking[before]] = 0.0;
            self.stages[b].lambda[k] = 1.0;
            self.eval_again(b, program, &sticking[before..=i]);
            for ((p, f1), f0) in held.pull[i * nx..].iter_mut().zip(self.rates.stage(b)).zip(&held.f0) {
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
        }
        for (&k, a) in sticking.iter().zip(&held.a) {
            self.stages[b].lambda[k] = if held.ok { *a } else { 0.0 };
        }
        self.eval_again(b, program, &sticking);
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

    /// Gradients ∇g of the arguments of the sticking signs with respect to the state, and what ġ is without their values:
    /// `held.a` = −ġ.
    fn gradients(&mut self, b: usize, sticking: &[usize], held: &mut Held) {
        let tape = &self.system.rhs;
        let nx = self.system.nx;
        let leaf = |k: usize| tape.switches[k].a as usize;
        let states = System::STATES..System::STATES + nx;
        // Mostly, what is held at zero is a state.
        if sticking.iter().all(|&k| states.contains(&leaf(k))) {
            held.gradient[..sticking.len() * nx].fill(0.0);
            for (i, &k) in sticking.iter().enumerate() {
                let entry = leaf(k) - states.start;
                held.gradient[i * nx + entry] = 1.0;
                held.a[i] = -held.f0[entry];
            }
            return;
        }
        // (The last lane collects explicit time.)
        let lanes = nx + 1;
        self.slopes(b, true);
        for (i, &k) in sticking.iter().enumerate() {
            let row = &self.gd[tape.switches[k].a as usize * lanes..][..lanes];
            held.gradient[i * nx..(i + 1) * nx].copy_from_slice(&row[..nx]);
            held.a[i] = -(row[nx] + row[..nx].iter().zip(&held.f0).map(|(g, f)| g * f).sum::<f64>());
        }
    }

    /// Time derivatives of the registers at stage `b` into `self.gd`: with `split` one lane per state
    /// plus one for explicit time, else one lane along the flow.
    pub(super) fn slopes(&mut self, b: usize, split: bool) {
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
}
