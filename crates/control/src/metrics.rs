//! What a closed loop reached.

/// Half width of the band of settling, relative to the step.
pub const BAND: f64 = 0.02;
/// The share of a set point's time, at its end, over which the final error is averaged.
const LAST: f64 = 0.05;
/// The share of a set point's time, at its end, in which the loop should be at rest.
const REST: f64 = 0.25;

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
    /// Largest less least tracked state in the last quarter of the time: what a limit cycle (friction hunted by an
    /// integral action, quantisation) moves, where the final error averages it.
    pub peak_to_peak: f64,
    /// Root mean square of (tracked state − set point) over the whole of the time.
    pub rms_error: f64,
    /// Largest |u|.
    pub largest_command: f64,
    /// Share of the samples at which the command is at an end of its range.
    pub saturated: f64,
    /// ∫ u² dt.
    pub effort: f64,
}

impl Metrics {
    /// Of one set point, given at the first of the samples `y` of the tracked state, `dt` s apart; `u` are the commands
    /// (one fewer, or as many), which stay within `limits`. `None` where there is no sample.
    ///
    /// ```
    /// use greybox_control::Metrics;
    /// let m = Metrics::of(&[0.0, 5.0, 11.0, 10.1, 9.9], &[4.0, 1.0, -1.0, 0.0], 10.0, 0.5, (-4.0, 4.0)).unwrap();
    /// assert_eq!((m.settling, m.saturated, m.effort), (Some(1.5), 0.25, 9.0));
    /// assert!((m.overshoot - 0.1).abs() < 1e-12 && (m.final_error + 0.1).abs() < 1e-12);
    /// ```
    #[must_use]
    pub fn of(y: &[f64], u: &[f64], set_point: f64, dt: f64, limits: (f64, f64)) -> Option<Metrics> {
        let step = set_point - *y.first()?;
        let band = BAND * step.abs();
        let outside = y.iter().rposition(|y| y.is_nan() || (y - set_point).abs() > band);
        let settling = match outside {
            None => Some(0.0),
            Some(k) if k + 1 < y.len() => Some((k + 1) as f64 * dt),
            Some(_) => None,
        };
        let beyond = y.iter().map(|y| (y - set_point) * step.signum()).fold(0.0, f64::max);
        let tail = &y[y.len() - ((y.len() as f64 * LAST) as usize).max(1)..];
        let rest = &y[y.len() - ((y.len() as f64 * REST) as usize).max(1)..];
        let largest = rest.iter().fold(f64::NEG_INFINITY, |m, y| m.max(*y));
        let least = rest.iter().fold(f64::INFINITY, |m, y| m.min(*y));
        let mean = |values: &[f64], of: fn(f64) -> f64| {
            values.iter().map(|y| of(y - set_point)).sum::<f64>() / values.len() as f64
        };
        let at_an_end = u.iter().filter(|u| **u <= limits.0 || **u >= limits.1).count();
        Some(Metrics {
            set_point,
            step,
            settling,
            overshoot: if step == 0.0 { 0.0 } else { beyond / step.abs() },
            final_error: mean(tail, |e| e),
            peak_to_peak: largest - least,
            rms_error: mean(y, |e| e * e).sqrt(),
            largest_command: u.iter().fold(0.0, |m, u| m.max(u.abs())),
            saturated: at_an_end as f64 / u.len().max(1) as f64,
            effort: u.iter().map(|u| u * u * dt).sum(),
        })
    }
}

/// Tracked state less reference, over a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackingError {
    /// Root mean square.
    pub rms: f64,
    /// Largest magnitude.
    pub largest: f64,
}

impl TrackingError {
    fn of(y: &[f64], r: &[f64]) -> TrackingError {
        let errors = || y.iter().zip(r).map(|(y, r)| y - r);
        TrackingError {
            rms: (errors().map(|e| e * e).sum::<f64>() / y.len().max(1) as f64).sqrt(),
            // Not `f64::max`: an error that is not a number is none that is small.
            largest: errors().map(f64::abs).fold(0.0, |m, e| if e <= m { m } else { e }),
        }
    }
}

/// How a trajectory was followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tracking {
    /// Largest less least reference.
    pub span: f64,
    /// Over the whole of the time.
    pub error: TrackingError,
    /// Without the first quarter of the time, in which a loop that begins at rest comes onto a trajectory that does not.
    pub later_error: TrackingError,
    /// Largest |u|.
    pub largest_command: f64,
    /// Share of the samples at which the command is at an end of its range.
    pub saturated: f64,
    /// ∫ u² dt.
    pub effort: f64,
}

impl Tracking {
    /// Of samples `y` of the tracked state and `r` of the reference, `dt` s apart; `u` are the commands (one fewer, or as
    /// many), which stay within `limits`. `None` where there is no sample, or not as many of both.
    ///
    /// ```
    /// use greybox_control::Tracking;
    /// let r = [0.0, 1.0, 2.0, 3.0, 4.0];
    /// let t = Tracking::of(&[0.0, 0.5, 1.75, 3.0, 4.25], &r, &[2.0, 1.0, 1.0, 1.0], 0.5, (-2.0, 2.0)).unwrap();
    /// assert_eq!((t.span, t.error.largest, t.later_error.largest), (4.0, 0.5, 0.5));
    /// assert_eq!((t.saturated, t.effort, t.largest_command), (0.25, 3.5, 2.0));
    /// ```
    #[must_use]
    pub fn of(y: &[f64], r: &[f64], u: &[f64], dt: f64, limits: (f64, f64)) -> Option<Tracking> {
        if y.is_empty() || y.len() != r.len() {
            return None;
        }
        let first = y.len() / 4;
        let largest = r.iter().fold(f64::NEG_INFINITY, |m, r| m.max(*r));
        let least = r.iter().fold(f64::INFINITY, |m, r| m.min(*r));
        let at_an_end = u.iter().filter(|u| **u <= limits.0 || **u >= limits.1).count();
        Some(Tracking {
            span: largest - least,
            error: TrackingError::of(y, r),
            later_error: TrackingError::of(&y[first..], &r[first..]),
            largest_command: u.iter().fold(0.0, |m, u| m.max(u.abs())),
            saturated: at_an_end as f64 / u.len().max(1) as f64,
            effort: u.iter().map(|u| u * u * dt).sum(),
        })
    }

    /// Whether the tracked state stays within 2 % of the reference's span around it after the first quarter of the time.
    #[must_use]
    pub fn is_close(&self) -> bool {
        self.later_error.largest <= BAND * self.span
    }
}

/// What simulated loops did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The loop settles at every set point, and so does every perturbed plant that was tried.
    Settles,
    /// The loop stays within 2 % of the span of its trajectory, and so does every perturbed plant that was tried.
    Tracks,
    /// The loop settles, or tracks, on the model, but not on every perturbed plant.
    Fragile,
    /// The loop does not settle at every set point.
    Unsettled,
    /// The loop does not stay within 2 % of the span of its trajectory.
    Strays,
    /// The loop leaves every bound.
    Diverges,
}

impl Verdict {
    /// `settles`, `tracks`, `fragile`, `unsettled`, `strays` or `diverges`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Verdict::Settles => "settles",
            Verdict::Tracks => "tracks",
            Verdict::Fragile => "fragile",
            Verdict::Unsettled => "unsettled",
            Verdict::Strays => "strays",
            Verdict::Diverges => "diverges",
        }
    }
}
