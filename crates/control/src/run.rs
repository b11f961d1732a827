//! A reference over the time, a run along it, and what it reached.

use crate::error::ControlError;
use crate::metrics::{Metrics, Tracking};
use crate::trajectory::Trajectory;

/// Most samples of one run.
pub const MOST_SAMPLES: usize = 10_000_000;

/// What the tracked state is to be over the time.
#[derive(Debug, Clone, PartialEq)]
pub enum Reference {
    /// Set points, each held until the next one.
    SetPoints {
        /// From which time on (s, rising, the first at zero) which set point (SI).
        set_points: Vec<(f64, f64)>,
        /// Length of the run, s.
        duration: f64,
    },
    /// A trajectory, from its first to its last sample.
    Trajectory(Trajectory),
}

impl Reference {
    /// One set point from the start on.
    #[must_use]
    pub fn step(value: f64, duration: f64) -> Reference {
        Reference::SetPoints { set_points: vec![(0.0, value)], duration }
    }

    /// `value` and −`value` in turn, each for `half_period` s, `count` set points in all.
    #[must_use]
    pub fn square(value: f64, half_period: f64, count: usize) -> Reference {
        let at = |k: usize| (k as f64 * half_period, if k.is_multiple_of(2) { value } else { -value });
        let set_points = (0..count).map(at).collect();
        Reference::SetPoints { set_points, duration: count as f64 * half_period }
    }

    /// The reference at a time with its first two derivatives; those of a set point are zero.
    #[must_use]
    pub fn at(&self, t: f64) -> [f64; 3] {
        match self {
            Reference::SetPoints { set_points, duration } => {
                let later = set_points.partition_point(|(start, _)| *start <= t + 1e-9 * duration);
                [set_points.get(later.saturating_sub(1)).map_or(0.0, |(_, r)| *r), 0.0, 0.0]
            }
            Reference::Trajectory(trajectory) => trajectory.at(t),
        }
    }

    /// Length of the run, s.
    #[must_use]
    pub fn duration(&self) -> f64 {
        match self {
            Reference::SetPoints { duration, .. } => *duration,
            Reference::Trajectory(trajectory) => trajectory.duration(),
        }
    }

    /// The largest magnitude.
    pub(crate) fn largest(&self) -> f64 {
        match self {
            Reference::SetPoints { set_points, .. } => {
                set_points.iter().fold(0.0f64, |m, (_, r)| m.max(r.abs()))
            }
            Reference::Trajectory(trajectory) => {
                let (least, most) = trajectory.range();
                least.abs().max(most.abs())
            }
        }
    }

    /// The number of samples, `dt` s apart.
    pub(crate) fn check(&self, dt: f64) -> Result<usize, ControlError> {
        let samples = (self.duration() / dt).round();
        if !(samples >= 1.0 && samples <= MOST_SAMPLES as f64) {
            let what = "the length of the run, in samples".to_owned();
            return Err(ControlError::Option { what, value: samples, wanted: "one to ten millions" });
        }
        let Reference::SetPoints { set_points, .. } = self else { return Ok(samples as usize) };
        let starts = set_points.first().is_some_and(|(t, _)| *t == 0.0);
        let rising = set_points.windows(2).all(|w| w[0].0 < w[1].0);
        let finite = set_points.iter().all(|(t, r)| t.is_finite() && r.is_finite());
        if !(starts && rising && finite) {
            return Err(ControlError::Option {
                what: "the list of set points".into(),
                value: set_points.len() as f64,
                wanted: "finite, with rising times from zero on",
            });
        }
        Ok(samples as usize)
    }
}

/// A simulated run, sampled where the command changes.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// Time, s.
    pub t: Vec<f64>,
    /// The reference.
    pub r: Vec<f64>,
    /// What the law is given of it: r, r′ and r″, of the time at which the command acts.
    pub given: [Vec<f64>; 3],
    /// Command, held until the next sample.
    pub u: Vec<f64>,
    /// States of the model (all, also those that the law does not know), one series each.
    pub x: Vec<Vec<f64>>,
    /// What the sensors of an observer said, one series for each measured state; none without an observer.
    pub y: Vec<Vec<f64>>,
    /// Names of the states.
    pub states: Vec<String>,
    /// The tracked state's index.
    pub tracked: usize,
    /// The sample at which the run ended because the state or the command left every bound.
    pub diverged: Option<usize>,
    /// What was reached, for each set point; none along a trajectory.
    pub metrics: Vec<Metrics>,
    /// How a trajectory was followed; none for set points, and where the run ended before the trajectory did.
    pub tracking: Option<Tracking>,
}

/// For each set point that was begun.
pub(crate) fn metrics(run: &Run, reference: &Reference, dt: f64, limits: (f64, f64)) -> Vec<Metrics> {
    let Reference::SetPoints { set_points, .. } = reference else { return Vec::new() };
    let y = &run.x[run.tracked];
    let starts: Vec<usize> =
        set_points.iter().map(|(t, _)| (t / dt - 1e-6).ceil().max(0.0) as usize).collect();
    let mut found = Vec::with_capacity(starts.len());
    for (i, &(_, r)) in set_points.iter().enumerate() {
        let first = starts[i];
        // The sample at which the next set point is given still belongs to this one's motion.
        let last = starts.get(i + 1).copied().unwrap_or(y.len()).min(y.len().saturating_sub(1));
        if first >= last {
            continue;
        }
        let cut = run.diverged.is_some() && last + 1 == run.t.len();
        let reached = Metrics::of(&y[first..=last], &run.u[first..last], r, dt, limits);
        found.extend(reached.map(|m| if cut { Metrics { settling: None, ..m } } else { m }));
    }
    found
}
