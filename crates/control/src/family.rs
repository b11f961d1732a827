//! The same law on plants that are not quite the model.

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::closed_loop::ClosedLoop;
use crate::error::ControlError;
use crate::margins::Margins;
use crate::metrics::{Metrics, Tracking, Verdict};
use crate::run::{Reference, Run};

/// Most members of a family.
pub const MOST_MEMBERS: usize = 1_000_000;
/// Draws of a parameter before its sign is given up.
const DRAWS: usize = 1000;

/// A family of plants: parameters drawn from normal distributions around the model's values.
#[derive(Debug, Clone, PartialEq)]
pub struct FamilyOptions {
    /// Standard deviations (SI) of parameters by name; those not named stay.
    pub deviations: Vec<(String, f64)>,
    /// Number of members.
    pub members: usize,
    /// Of the random numbers: the same seed gives the same family, whatever the number of threads.
    pub seed: u64,
}

/// A metric over a family: the worst over the set points of each member is taken first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Half of the members are better; infinite where half of them did not get there.
    pub median: f64,
    /// The worst member.
    pub worst: f64,
}

impl Spread {
    const UNKNOWN: Spread = Spread { median: f64::NAN, worst: f64::NAN };

    /// Of values that are better the smaller they are; none where there is no value.
    fn of(mut values: Vec<f64>) -> Option<Spread> {
        values.sort_by(f64::total_cmp);
        Some(Spread { median: *values.get(values.len() / 2)?, worst: *values.last()? })
    }
}

/// [`Tracking::later_error`] over a family.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackingSpread {
    /// Root mean square.
    pub rms_error: Spread,
    /// Largest magnitude.
    pub largest_error: Spread,
}

/// [`Margins`] over a family: the worst over the set points of each member is taken first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarginSpread {
    /// The factor by which the loop's gain may rise.
    pub gain: Spread,
    /// The factor to which it may fall.
    pub lower_gain: Spread,
    /// Phase margin, rad.
    pub phase: Spread,
    /// Delay margin, s.
    pub delay: Spread,
    /// The largest 1/|1 + L|.
    pub sensitivity: Spread,
}

impl MarginSpread {
    /// None where there is no member.
    fn of(members: &[Margins]) -> Option<MarginSpread> {
        // What is better where it is larger is sorted by what it lacks.
        let least = |of: fn(&Margins) -> f64| {
            let Spread { median, worst } = Spread::of(members.iter().map(|m| -of(m)).collect())?;
            Some(Spread { median: -median, worst: -worst })
        };
        let most = |of: fn(&Margins) -> f64| Spread::of(members.iter().map(of).collect());
        Some(MarginSpread {
            gain: least(|m| m.gain)?,
            lower_gain: most(|m| m.lower_gain)?,
            phase: least(|m| m.phase)?,
            delay: least(|m| m.delay)?,
            sensitivity: most(|m| m.sensitivity)?,
        })
    }

    /// The worst, margin by margin.
    #[must_use]
    pub fn worst(&self) -> Margins {
        self.each(|s| s.worst)
    }

    /// The median, margin by margin.
    #[must_use]
    pub fn median(&self) -> Margins {
        self.each(|s| s.median)
    }

    fn each(&self, of: fn(&Spread) -> f64) -> Margins {
        Margins {
            gain: of(&self.gain),
            lower_gain: of(&self.lower_gain),
            phase: of(&self.phase),
            delay: of(&self.delay),
            sensitivity: of(&self.sensitivity),
        }
    }
}

/// What a family of plants did under one law. Members that diverge count as infinite.
#[derive(Debug, Clone, PartialEq)]
pub struct Family {
    /// Members.
    pub members: usize,
    /// Members whose state or command left every bound.
    pub diverged: usize,
    /// Members that settled to 2 % at every set point, or stayed within 2 % of the span of a trajectory.
    pub settled: usize,
    /// Settling time, s; not a number along a trajectory, as are the next two.
    pub settling: Spread,
    /// Overshoot over the step.
    pub overshoot: Spread,
    /// Size of the final error.
    pub final_error: Spread,
    /// Errors along a trajectory after the first quarter of the time; none for set points.
    pub tracking: Option<TrackingSpread>,
    /// Largest |u|.
    pub largest_command: Spread,
    /// ∫ u² dt over all set points.
    pub effort: Spread,
    /// Largest less least tracked state in the last quarter of the time of a set point; not a number along a trajectory.
    pub peak_to_peak: Spread,
    /// Margins of the law (and its observer) on each member's plant; none where the law has none on its own.
    pub margins: Option<MarginSpread>,
    /// Members whose linearised loop is unstable at a set point: their margins are [`Margins::NONE`].
    pub unstable: usize,
    /// Between what bounds the tracked state of the members that did not diverge was, sample by sample.
    pub tracked: Envelope,
    /// The same of the command.
    pub command: Envelope,
}

/// Bounds of a signal over a family, sample by sample.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Envelope {
    /// The least value of each sample; empty where every member diverged.
    pub lowest: Vec<f64>,
    /// The largest.
    pub highest: Vec<f64>,
}

impl Envelope {
    fn of(values: &[f64]) -> Envelope {
        Envelope { lowest: values.to_vec(), highest: values.to_vec() }
    }

    /// Wide enough for both; by total order, so that it does not matter which comes first.
    fn join(mut self, other: Envelope) -> Envelope {
        if self.lowest.is_empty() {
            return other;
        }
        for (low, next) in self.lowest.iter_mut().zip(&other.lowest) {
            if next.total_cmp(low).is_lt() {
                *low = *next;
            }
        }
        for (high, next) in self.highest.iter_mut().zip(&other.highest) {
            if next.total_cmp(high).is_gt() {
                *high = *next;
            }
        }
        self
    }
}

/// Members run so far, in order.
#[derive(Default)]
struct Members {
    /// None where the run diverged.
    metrics: Vec<Option<(Vec<Metrics>, Option<Tracking>)>>,
    margins: Vec<Option<Margins>>,
    tracked: Envelope,
    command: Envelope,
}

impl Members {
    fn with(mut self, (mut run, margins): (Run, Option<Margins>)) -> Members {
        self.margins.push(margins);
        if run.diverged.is_some() {
            self.metrics.push(None);
            return self;
        }
        self.tracked = self.tracked.join(Envelope::of(&run.x[run.tracked]));
        self.command = self.command.join(Envelope::of(&run.u));
        self.metrics.push(Some((std::mem::take(&mut run.metrics), run.tracking)));
        self
    }

    fn join(mut self, other: Members) -> Members {
        self.metrics.extend(other.metrics);
        self.margins.extend(other.margins);
        self.tracked = self.tracked.join(other.tracked);
        self.command = self.command.join(other.command);
        self
    }
}

impl ClosedLoop<'_> {
    /// Runs the law, made for the model's own parameters, on plants with other ones. A parameter keeps its sign: a
    /// draw beyond zero is drawn again. Margins are those of the law's plant with the member's values of the parameters
    /// that it has ([`Controller::margins_with`](crate::Controller::margins_with)), the law and the observer's gain as they
    /// are. An example stands on the [crate's page](crate).
    ///
    /// # Errors
    /// [`ControlError::UnknownParameter`], [`ControlError::Option`].
    pub fn family(&self, reference: &Reference, options: &FamilyOptions) -> Result<Family, ControlError> {
        let option = |what: String, value: f64, wanted| ControlError::Option { what, value, wanted };
        if !(1..=MOST_MEMBERS).contains(&options.members) {
            return Err(option(
                "the size of the family".into(),
                options.members as f64,
                "from one to a million",
            ));
        }
        let mut varied = Vec::with_capacity(options.deviations.len());
        for (name, deviation) in &options.deviations {
            if !(*deviation >= 0.0 && deviation.is_finite()) {
                let what = format!("the standard deviation of `{name}`");
                return Err(option(what, *deviation, "a finite number, zero or more"));
            }
            varied.push((self.parameter(name)?, *deviation));
        }
        let member = |member: usize| -> Result<(Run, Option<Margins>), ControlError> {
            let mut random = Pcg64Mcg::seed_from_u64(options.seed ^ (member as u64).wrapping_mul(STRIDE));
            let mut parameters = self.parameters.clone();
            for &(at, deviation) in &varied {
                parameters[at] = draw(self.parameters[at], deviation, &mut random);
            }
            Ok((self.run_with(&parameters, reference)?, self.margins_with(&parameters)))
        };
        let Members { metrics: runs, margins, tracked, command } = (0..options.members)
            .into_par_iter()
            .map(member)
            .try_fold(Members::default, |before, found| Ok::<_, ControlError>(before.with(found?)))
            .try_reduce(Members::default, |a, b| Ok(a.join(b)))?;
        let settled = runs.iter().flatten().filter(|(m, tracking)| settled(m, tracking.as_ref())).count();
        let figures = Figures { runs: &runs, moves: matches!(reference, Reference::Trajectory(_)) };
        Ok(Family {
            members: runs.len(),
            diverged: runs.iter().filter(|run| run.is_none()).count(),
            settled,
            settling: figures.at_set_points(|m| m.settling.unwrap_or(f64::INFINITY)),
            overshoot: figures.at_set_points(|m| m.overshoot),
            final_error: figures.at_set_points(|m| m.final_error.abs()),
            peak_to_peak: figures.at_set_points(|m| m.peak_to_peak),
            largest_command: figures.spread(|m, t| {
                largest(m.iter().map(|m| m.largest_command).chain(t.map(|t| t.largest_command)))
            }),
            effort: figures.spread(|m, t| m.iter().map(|m| m.effort).chain(t.map(|t| t.effort)).sum()),
            tracking: figures.moves.then(|| TrackingSpread {
                rms_error: figures.spread(|_, t| t.map_or(f64::INFINITY, |t| t.later_error.rms)),
                largest_error: figures.spread(|_, t| t.map_or(f64::INFINITY, |t| t.later_error.largest)),
            }),
            unstable: margins.iter().flatten().filter(|m| **m == Margins::NONE).count(),
            margins: margins.into_iter().collect::<Option<Vec<_>>>().and_then(|all| MarginSpread::of(&all)),
            tracked,
            command,
        })
    }
}

/// Whether a run settled at every set point, or stayed with its trajectory.
fn settled(metrics: &[Metrics], tracking: Option<&Tracking>) -> bool {
    match tracking {
        Some(tracking) => tracking.is_close(),
        None => !metrics.is_empty() && metrics.iter().all(|m| m.settling.is_some()),
    }
}

fn largest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(0.0, f64::max)
}

/// What the members reached.
struct Figures<'a> {
    runs: &'a [Option<(Vec<Metrics>, Option<Tracking>)>],
    /// Along a trajectory.
    moves: bool,
}

impl Figures<'_> {
    /// A figure of every member; infinite of those that diverged.
    fn spread(&self, of: impl Fn(&[Metrics], Option<&Tracking>) -> f64) -> Spread {
        let value = |run: &Option<(Vec<Metrics>, Option<Tracking>)>| {
            run.as_ref().map_or(f64::INFINITY, |(metrics, tracking)| of(metrics, tracking.as_ref()))
        };
        Spread::of(self.runs.iter().map(value).collect()).unwrap_or(Spread::UNKNOWN)
    }

    /// The worst set point of every member.
    fn at_set_points(&self, of: fn(&Metrics) -> f64) -> Spread {
        if self.moves { Spread::UNKNOWN } else { self.spread(|m, _| largest(m.iter().map(of))) }
    }
}

impl ClosedLoop<'_> {
    /// The worst margins over the set points, with the loop's delay, on the law's plant with these values of the loop's parameters.
    fn margins_with(&self, parameters: &[f64]) -> Option<Margins> {
        let own = self.controller().plant();
        let value = |(name, value): &(String, f64)| {
            self.names.iter().position(|n| n == name).map_or(*value, |at| parameters[at])
        };
        let values: Vec<f64> = own.parameters().iter().map(value).collect();
        let plant = own.with_parameters(&values).ok()?;
        let all = match &self.output {
            Some(output) => output.margins_late(self.controller(), &plant, self.delay),
            None => self.controller().margins_late(&plant, self.delay),
        };
        all.into_iter().reduce(|a, b| Some(a?.worse(b?)))?
    }
}

impl Run {
    /// What this run did, and the same law on perturbed plants, where they were tried.
    #[must_use]
    pub fn verdict(&self, family: Option<&Family>) -> Verdict {
        let (good, bad) = match self.tracking {
            Some(_) => (Verdict::Tracks, Verdict::Strays),
            None => (Verdict::Settles, Verdict::Unsettled),
        };
        if self.diverged.is_some() {
            Verdict::Diverges
        } else if !settled(&self.metrics, self.tracking.as_ref()) {
            bad
        } else if family.is_some_and(|f| f.settled < f.members) {
            Verdict::Fragile
        } else {
            good
        }
    }
}

/// Sets the streams of the members apart.
const STRIDE: u64 = 0x9e37_79b9_7f4a_7c15;

fn draw(mean: f64, deviation: f64, random: &mut Pcg64Mcg) -> f64 {
    for _ in 0..DRAWS {
        let normal: f64 = StandardNormal.sample(random);
        let value = mean + deviation * normal;
        if mean == 0.0 || value * mean > 0.0 {
            return value;
        }
    }
    mean
}
