//! Where a non-smooth function leaves its branch, and what it does then.

use greybox_model::system::System;
use greybox_model::tape::SwitchKind;

use super::Core;

/// Events in one sample interval beyond which events are no longer located (a contact that
/// bounces infinitely often in finite time).
pub(super) const MOST_EVENTS: usize = 200;

impl Core<'_> {
    /// Modes at the very start: natural, with a decision where a sign's argument is exactly zero.
    pub(super) fn start_modes(&mut self) {
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

    pub(super) fn least_slack(&self, b: usize) -> f64 {
        self.live.iter().map(|&k| self.slack(b, k)).fold(f64::INFINITY, f64::min)
    }

    /// Evaluates stage 0 anew (a signal may have jumped) and settles the modes there.
    pub(super) fn begin(&mut self, to: f64) {
        // (That of a step to there, to the last bit: what the inputs do around it is looked up once.)
        let mid = self.s + 0.5 * (to - self.s);
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

    pub(super) fn update_sticking(&mut self) {
        self.sticking.clear();
        for &k in &self.live {
            if self.system.rhs.switches[k].kind == SwitchKind::Sign && self.modes[k] == 0 {
                self.sticking.push(k);
            }
        }
    }

    /// What rounding of the forces that hold the sticking signs does to entry `r` of ẋ. Where all else is at rest,
    /// error control relative to the motion would chase it with ever smaller steps.
    pub(super) fn rounding(&self, r: usize) -> f64 {
        const ROUNDED: f64 = 64.0 * f64::EPSILON;
        let (nx, st) = (self.system.nx, &self.stages[0]);
        let pull = |(i, &k): (usize, &usize)| (st.held.pull[i * nx + r] * st.lambda[k]).abs();
        ROUNDED * self.sticking.iter().enumerate().map(pull).sum::<f64>()
    }

    /// Finds the first h' ≤ h at which a mode is left; leaves the trial of h' in place.
    pub(super) fn locate_event(&mut self, h: f64) -> f64 {
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

    /// At (s, x), with stage 0 evaluated there in the old modes: changes the modes that were left.
    pub(super) fn handle_event(&mut self, to: f64) {
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
                        self.d[self.at_dx + i * width + l] += jump * dte[l];
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
}
