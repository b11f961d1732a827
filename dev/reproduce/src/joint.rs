//! The rotary flexible joint of section 3.4 as a virtual rig: equation 3.21 with the delayed feedback 3.22.

use super::chapter2::Beam;

/// Sample time of the thesis's records, s.
pub(crate) const STEP: f64 = 1e-3;
/// Delay put into the feedback, s.
pub(crate) const DELAY: f64 = 0.2;

/// A record of the closed loop, one entry per sample.
#[derive(Debug, Clone, Default)]
pub(crate) struct Record {
    /// Desired angle of the base, rad.
    pub(crate) reference: Vec<f64>,
    /// Motor voltage, V.
    pub(crate) voltage: Vec<f64>,
    /// [θ, α, θ', α'], rad and rad/s.
    pub(crate) states: Vec<[f64; 4]>,
}

impl Record {
    /// One state over the record.
    pub(crate) fn column(&self, state: usize) -> Vec<f64> {
        self.states.iter().map(|s| s[state]).collect()
    }
}

/// The linear joint (B_l = 0) under V = kp (θ_d(t) − θ(t − 0.2 s)), kp = √10 (E16), from rest; θ = 0 before the
/// start.
///
/// Classical Runge–Kutta at the sample time; the delayed angle between samples is the cubic through both
/// neighbours and their slopes.
pub(crate) fn run(joint: &Beam, reference: impl Fn(f64) -> f64, seconds: f64) -> Record {
    let (a, kp) = (1.0 / joint.volts_per_torque(), 10f64.sqrt());
    let delay = (DELAY / STEP).round() as usize;
    let samples = (seconds / STEP).round() as usize + 1;
    let mut record = Record::default();
    let mut state = [0.0; 4];
    for k in 0..samples {
        let t = k as f64 * STEP;
        record.states.push(state);
        let past = |k: usize| k.checked_sub(delay).map_or([0.0; 4], |at| record.states[at]);
        // A step behind the present always exists: the delay is many steps long.
        let (before, after) = (past(k), past(k + 1));
        let middle = 0.5 * (before[0] + after[0]) + STEP / 8.0 * (before[2] - after[2]);
        let voltage = |t: f64, delayed: f64| kp * (reference(t) - delayed);
        let rates = |[_, alpha, dtheta, dalpha]: [f64; 4], volts: f64| {
            let hub = joint.hub_acceleration(a * volts, dtheta, alpha);
            [dtheta, dalpha, hub, -hub - joint.spring_over_link() * alpha]
        };
        let along = |s: [f64; 4], r: [f64; 4], h: f64| std::array::from_fn(|i| s[i] + h * r[i]);
        let volts = [voltage(t, before[0]), voltage(t + 0.5 * STEP, middle), voltage(t + STEP, after[0])];
        record.reference.push(reference(t));
        record.voltage.push(volts[0]);
        let first = rates(state, volts[0]);
        let second = rates(along(state, first, 0.5 * STEP), volts[1]);
        let third = rates(along(state, second, 0.5 * STEP), volts[1]);
        let fourth = rates(along(state, third, STEP), volts[2]);
        for i in 0..4 {
            state[i] += STEP / 6.0 * (first[i] + 2.0 * (second[i] + third[i]) + fourth[i]);
        }
    }
    record
}
