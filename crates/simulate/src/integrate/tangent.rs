//! Forward sensitivities: the derivative of every stage along the lanes.

use greybox_model::system::System;
use pulp::{Simd, WithSimd};

use super::{Core, lerp, locate};
use crate::small;

/// out = x + Σ h · weight · k, k one block as long as x after the other; a weight of zero takes no part.
#[inline(always)]
pub(super) fn tangents_along(out: &mut [f64], x: &[f64], k: &[f64], weights: &[f64], h: f64) {
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
            24 => core.tangent_step_of(h, 24),
            32 => core.tangent_step_of(h, 32),
            width => core.tangent_step_of(h, width),
        }
    }
}

/// The stride of a row of `lanes` tangents: a multiple of four, of eight where there are many, whose spare lanes are zero.
pub(super) fn width(lanes: usize) -> usize {
    match lanes {
        0..=2 => lanes,
        3..=16 => lanes.next_multiple_of(4),
        _ => lanes.next_multiple_of(8),
    }
}

impl Core<'_> {
    /// Tangents of all registers at stage `b` for the tangents of the state at the step's start.
    pub(super) fn tangent_here(&mut self, b: usize) {
        let width = self.width;
        self.d.copy_within(self.at_dx..self.at_dk, System::STATES * width);
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
            let rows = self.signal_rows(k);
            for (j, (i, change)) in self.seeds.signals.inputs.iter().enumerate() {
                let row = &mut self.d[(system.inputs() + i) * width + first..][..count];
                if self.long.active {
                    self.long.lane_input(j, st.s, self.env.dt, row);
                } else {
                    lerp(change, rows, w, count, row);
                }
            }
        }
        if !system.rhs.delays.is_empty() {
            self.tangent_delays(b);
        }
        let st = &self.stages[b];
        system.rhs.tangent(&self.tangents, &st.regs, &self.modes, width, &mut self.d);
    }

    /// The rows of the signals at sample `k` and at the next.
    pub(super) fn signal_rows(&self, k: usize) -> [usize; 2] {
        [k, (k + 1).min(self.env.len - 1)].map(|k| self.seeds.signals.row(k))
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

    /// Derivative of stage `b`'s ẋ along the lanes into its rows, for the state tangents that stand in `self.d`.
    #[inline(always)]
    fn tangent_stage(&mut self, b: usize, width: usize) {
        self.tangent_at(b, width);
        let system = self.system;
        let (nx, nz) = (system.nx, system.nz);
        let outputs = &system.rhs.outputs;
        let st = &self.stages[b];
        let (d, rest) = self.d.split_at_mut(self.at_dx);
        let rows = &mut rest[self.at_b - self.at_dx..];
        for i in 0..nz {
            let row = &mut rows[i * width..][..width];
            let h = &d[outputs[nz * nz + i] as usize * width..][..width];
            for (r, h) in row.iter_mut().zip(h) {
                *r = -h;
            }
            for j in 0..nz {
                let reg = outputs[i * nz + j];
                if self.tangents.is_active(reg) {
                    let z = st.regs[system.highest() + j];
                    for (r, m) in row.iter_mut().zip(&d[reg as usize * width..][..width]) {
                        *r -= m * z;
                    }
                }
            }
        }
        if !self.seeds.signals.force.is_empty() {
            self.tangent_forces(b);
        }
        let st = &self.stages[b];
        small::solve_rows(&st.lu, &st.pivots, nz, &mut self.d[self.at_b..], width);
        let (known, solved) = self.d.split_at_mut(self.at_b);
        let (d, rest) = known.split_at_mut(self.at_dx);
        let dk = &mut rest[self.at_dk - self.at_dx..][b * nx * width..][..nx * width];
        for (dk, &source) in dk.chunks_exact_mut(width).zip(&self.source) {
            let from = match source.checked_sub(system.highest()) {
                Some(j) => &solved[j * width..][..width],
                None => &d[source * width..][..width],
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
        if self.long.active {
            for i in 0..self.system.nz {
                let weights = &signals.weights[i * count..][..count];
                let row = &mut self.d[self.at_b + i * self.width + first..][..count];
                self.long.take_lane_forces(weights, st.s, self.env.dt, row);
            }
            return;
        }
        let (k, w) = locate(st.s, st.mid, self.env.dt, self.env.len);
        let [a, c] = self.signal_rows(k).map(|row| &signals.force[row * count..][..count]);
        for i in 0..self.system.nz {
            let weights = &signals.weights[i * count..][..count];
            let row = &mut self.d[self.at_b + i * self.width + first..][..count];
            for l in 0..count {
                row[l] -= weights[l] * (a[l] + w * (c[l] - a[l]));
            }
        }
    }

    /// dλ keeps the derivative of ġ zero: ∇g·(dẋ + Σ pull dλ) = 0.
    pub(super) fn tangent_sticking(&mut self, b: usize) {
        let (nx, width) = (self.system.nx, self.width);
        let held = &self.stages[b].held;
        let dk = &mut self.d[self.at_dk..][b * nx * width..][..nx * width];
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

    /// Derivatives along the lanes of ẋ at the step's start, stage 0, into its rows.
    pub(super) fn rate_here(&mut self) {
        let width = self.width;
        self.d.copy_within(self.at_dx..self.at_dk, System::STATES * width);
        self.tangent_stage(0, width);
    }

    /// The sensitivities' step that belongs to the trial step of length `h`.
    pub(super) fn tangent_step(&mut self, h: f64) {
        if let Some(step) = self.step.take() {
            self.compiled_step(&step, h);
            self.step = Some(step);
            return;
        }
        self.arch.dispatch(TangentStep { core: self, h });
    }

    #[inline(always)]
    fn tangent_step_of(&mut self, h: f64, width: usize) {
        let n = self.system.nx * width;
        let tableau = self.tableau;
        for i in 0..tableau.b.len() {
            let (d, rest) = self.d.split_at_mut(self.at_dx);
            let (dx, dk) = rest.split_at(n);
            tangents_along(&mut d[System::STATES * width..][..n], dx, dk, tableau.a[i], h);
            self.tangent_stage(i, width);
        }
        let (d, rest) = self.d.split_at_mut(self.at_dx);
        let (dx, dk) = rest.split_at_mut(n);
        let rows = &mut d[System::STATES * width..][..n];
        tangents_along(rows, dx, dk, tableau.b, h);
        dx.copy_from_slice(rows);
    }
}
