//! Set points over the time, a run along them, and what it reached at each.

use crate::error::ControlError;
use crate::metrics::Metrics;

/// Most samples of one run.
pub const MOST_SAMPLES: usize = 10_000_000;

/// Set points over the time.
#[derive(Debug, Clone, PartialEq)]
pub struct Reference {
    /// From which time on (s, rising, the first at zero) which set point (SI).
    pub set_points: Vec<(f64, f64)>,
    /// Length of the run, s.
    pub duration: f64,
}

impl Reference {
    /// One set point from the start on.
    #[must_use]
    pub fn step(value: f64, duration: f64) -> Reference {
        Reference { set_points: vec![(0.0, value)], duration }
    }

    /// `value` and −`value` in turn, each for `half_period` s, `count` set points in all.
    #[must_use]
    pub fn square(value: f64, half_period: f64, count: usize) -> Reference {
        let at = |k: usize| (k as f64 * half_period, if k.is_multiple_of(2) { value } else { -value });
        Reference { set_points: (0..count).map(at).collect(), duration: count as f64 * half_period }
    }

    /// The set point at a time.
    #[must_use]
    pub fn at(&self, t: f64) -> f64 {
        let later = self.set_points.partition_point(|(start, _)| *start <= t + 1e-9 * self.duration);
        self.set_points.get(later.saturating_sub(1)).map_or(0.0, |(_, r)| *r)
    }

    /// The number of samples, `dt` s apart.
    pub(crate) fn check(&self, dt: f64) -> Result<usize, ControlError> {
        let samples = (self.duration / dt).round();
        if !(samples >= 1.0 && samples <= MOST_SAMPLES as f64) {
            let what = "the length of the run, in samples".to_owned();
            return Err(ControlError::Option { what, value: samples, wanted: "one to ten millions" });
        }
        let starts = self.set_points.first().is_some_and(|(t, _)| *t == 0.0);
        let rising = self.set_points.windows(2).all(|w| w[0].0 < w[1].0);
        let finite = self.set_points.iter().all(|(t, r)| t.is_finite() && r.is_finite());
        if !(starts && rising && finite) {
            return Err(ControlError::Option {
                what: "the list of set points".into(),
                value: self.set_points.len() as f64,
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
    /// Set point.
    pub r: Vec<f64>,
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
    /// What was reached, for each set point.
    pub metrics: Vec<Metrics>,
}

/// For each set point that was begun.
pub(crate) fn metrics(run: &Run, reference: &Reference, dt: f64, limits: (f64, f64)) -> Vec<Metrics> {
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
        let cut = run.diverged.is_some() && last + 1 == run.t.len();
        let reached = Metrics::of(&y[first..=last], &run.u[first..last], r, dt, limits);
        found.extend(reached.map(|m| if cut { Metrics { settling: None, ..m } } else { m }));
    }
    found
}
