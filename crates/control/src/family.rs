//! The same law on plants that are not quite the model.

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::closed_loop::ClosedLoop;
use crate::error::ControlError;
use crate::metrics::{Metrics, Verdict};
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

/// What a family of plants did under one law. Members that diverge count as infinite.
#[derive(Debug, Clone, PartialEq)]
pub struct Family {
    /// Members.
    pub members: usize,
    /// Members whose state or command left every bound.
    pub diverged: usize,
    /// Members that settled to 2 % at every set point.
    pub settled: usize,
    /// Settling time, s.
    pub settling: Spread,
    /// Overshoot over the step.
    pub overshoot: Spread,
    /// Size of the final error.
    pub final_error: Spread,
    /// Largest |u|.
    pub largest_command: Spread,
    /// ∫ u² dt over all set points.
    pub effort: Spread,
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
    metrics: Vec<Option<Vec<Metrics>>>,
    tracked: Envelope,
    command: Envelope,
}

impl Members {
    fn with(mut self, mut run: Run) -> Members {
        if run.diverged.is_some() {
            self.metrics.push(None);
            return self;
        }
        self.tracked = self.tracked.join(Envelope::of(&run.x[run.tracked]));
        self.command = self.command.join(Envelope::of(&run.u));
        self.metrics.push(Some(std::mem::take(&mut run.metrics)));
        self
    }

    fn join(mut self, other: Members) -> Members {
        self.metrics.extend(other.metrics);
        self.tracked = self.tracked.join(other.tracked);
        self.command = self.command.join(other.command);
        self
    }
}

impl ClosedLoop<'_> {
    /// Runs the law, made for the model's own parameters, on plants with other ones. A parameter keeps its sign: a
    /// draw beyond zero is drawn again. An example stands on the [crate's page](crate).
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
        let member = |member: usize| {
            let mut random = Pcg64Mcg::seed_from_u64(options.seed ^ (member as u64).wrapping_mul(STRIDE));
            let mut parameters = self.parameters.clone();
            for &(at, deviation) in &varied {
                parameters[at] = draw(self.parameters[at], deviation, &mut random);
            }
            self.run_with(&parameters, reference)
        };
        let Members { metrics: runs, tracked, command } = (0..options.members)
            .into_par_iter()
            .map(member)
            .try_fold(Members::default, |before, run| Ok::<_, ControlError>(before.with(run?)))
            .try_reduce(Members::default, |a, b| Ok(a.join(b)))?;
        let spread = |of: &dyn Fn(&[Metrics]) -> f64| {
            let mut values: Vec<f64> =
                runs.iter().map(|run| run.as_ref().map_or(f64::INFINITY, |m| of(m))).collect();
            values.sort_by(f64::total_cmp);
            Spread { median: values[values.len() / 2], worst: values[values.len() - 1] }
        };
        let worst = |of: fn(&Metrics) -> f64| move |m: &[Metrics]| m.iter().map(of).fold(0.0, f64::max);
        let settled = |m: &Vec<Metrics>| m.iter().all(|m| m.settling.is_some());
        Ok(Family {
            members: runs.len(),
            diverged: runs.iter().filter(|run| run.is_none()).count(),
            settled: runs.iter().flatten().filter(|m| settled(m)).count(),
            settling: spread(&worst(|m| m.settling.unwrap_or(f64::INFINITY))),
            overshoot: spread(&worst(|m| m.overshoot)),
            final_error: spread(&worst(|m| m.final_error.abs())),
            largest_command: spread(&worst(|m| m.largest_command)),
            effort: spread(&|m: &[Metrics]| m.iter().map(|m| m.effort).sum()),
            tracked,
            command,
        })
    }
}

impl Run {
    /// What this run did, and the same law on perturbed plants, where they were tried.
    #[must_use]
    pub fn verdict(&self, family: Option<&Family>) -> Verdict {
        if self.diverged.is_some() {
            Verdict::Diverges
        } else if self.metrics.is_empty() || self.metrics.iter().any(|m| m.settling.is_none()) {
            Verdict::Unsettled
        } else if family.is_some_and(|f| f.settled < f.members) {
            Verdict::Fragile
        } else {
            Verdict::Settles
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
