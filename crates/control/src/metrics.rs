//! What a closed loop reached.

use crate::closed_loop::{Reference, Run};

/// Half width of the band of settling, relative to the step.
pub const BAND: f64 = 0.02;
/// The share of a set point's time, at its end, over which the final error is averaged.
const LAST: f64 = 0.05;

/// How one set point was reached.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Metrics {
    /// The set point.
    pub set_point: f64,
    /// Its distance from where the tracked state was when it was given.
    pub step: f64,
    /// Time after which the tracked state stays within 2 % of the step around the set point, s; none where it does
    /// not until the next one.
    pub settling: Option<f64>,
    /// The largest excursion beyond the set point over the size of the step; zero where there is none, and where
    /// there is no step.
    pub overshoot: f64,
    /// Mean of (tracked state − set point) over the last twentieth of the time.
    pub final_error: f64,
    /// Largest |u|.
    pub largest_command: f64,
    /// ∫ u² dt.
    pub effort: f64,
}

/// For each set point that was begun.
pub(crate) fn metrics(run: &Run, reference: &Reference, dt: f64) -> Vec<Metrics> {
    let y = &run.x[run.tracked];
    let starts: Vec<usize> =
        reference.set_points.iter().map(|(t, _)| (t / dt - 1e-6).ceil().max(0.0) as usize).collect();
    let mut found = Vec::with_capacity(starts.len());
    for (i, &(_, r)) in reference.set_points.iter().enumerate() {
        let first = starts[i];
        // The sample at which the next set point is given still belongs to this one's motion.
        let last = starts.get(i + 1).copied().unwrap_or(y.len()).min(y.len().saturating_sub(1));
        if first >= last {
            continue;
        }
        let (y, u) = (&y[first..=last], &run.u[first..last]);
        let step = r - y[0];
        let band = BAND * step.abs();
        let outside = y.iter().rposition(|y| y.is_nan() || (y - r).abs() > band);
        let cut = run.diverged.is_some() && last + 1 == run.t.len();
        let settling = match outside {
            _ if cut => None,
            None => Some(0.0),
            Some(k) if k + 1 < y.len() => Some((k + 1) as f64 * dt),
            Some(_) => None,
        };
        let beyond = y.iter().map(|y| (y - r) * step.signum()).fold(0.0, f64::max);
        let tail = &y[y.len() - ((y.len() as f64 * LAST) as usize).max(1)..];
        found.push(Metrics {
            set_point: r,
            step,
            settling,
            overshoot: if step == 0.0 { 0.0 } else { beyond / step.abs() },
            final_error: tail.iter().map(|y| y - r).sum::<f64>() / tail.len() as f64,
            largest_command: u.iter().fold(0.0, |m, u| m.max(u.abs())),
            effort: u.iter().map(|u| u * u * dt).sum(),
        });
    }
    found
}
