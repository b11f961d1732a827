//! What is measured at a sample.

use greybox_model::system::System;

use super::{Core, lerp, locate, state_leaf};

impl Core<'_> {
    /// Writes sample `row` of the result.
    pub(super) fn record(&mut self, row: usize) {
        let system = self.system;
        let (nx, ny, lanes, n) = (system.nx, system.ny, self.lanes, self.result.n);
        if self.result.diverged.is_some() {
            self.result.diverged = Some(row);
            self.result.exhausted = self.result.exhausted.map(|_| row);
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
            let k = self.seeds.signals.row(k);
            for (c, change) in &self.seeds.signals.outputs {
                for (l, v) in change[k * count..(k + 1) * count].iter().enumerate() {
                    self.result.dy[((first + l) * ny + c) * n + row] += v;
                }
            }
        }
    }

    /// The outputs and their tangents now, into `out_regs` and `out_d`; delayed ones remember it.
    pub(super) fn observe(&mut self) {
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
                    self.out_d[to * width..][..width]
                        .copy_from_slice(&self.d[self.at_dk + r * width..][..width]);
                }
            }
        }
        let out = &system.output;
        self.out_regs[System::TIME] = self.env.start + self.s;
        self.out_regs[System::STATES..System::STATES + nx].copy_from_slice(&self.x);
        if system.output_needs_inputs {
            for (i, u) in self.env.inputs.iter().enumerate() {
                self.out_regs[system.inputs() + i] = u.at(self.s, inside).0;
            }
        }
        if lanes > 0 {
            self.out_d[System::STATES * width..][..nx * width]
                .copy_from_slice(&self.d[self.at_dx..self.at_dk]);
            let first = self.seeds.parameters.len() + self.seeds.initial.len();
            let count = self.seeds.signals.lanes;
            for (i, change) in &self.seeds.signals.inputs {
                let (k, w) = locate(self.s, inside, self.env.dt, self.env.len);
                let rows = self.signal_rows(k);
                let to = &mut self.out_d[(system.inputs() + i) * width + first..][..count];
                lerp(change, rows, w, count, to);
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
                        history.rate = self.d[self.at_dk + x * width..][..lanes].to_vec();
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
    pub(super) fn freeze(&mut self, row: usize, n: usize) {
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
