//! The state of a watch as data.

use greybox_recursive::{Chart, LeastSquares};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

use crate::blocks::{Block, Scores};
use crate::event::Irregular;
use crate::identity::Identity;
use crate::learn::{Place, Usual};
use crate::machine::Machine;
use crate::released::{Louder, Released};
use crate::sample::Sample;
use crate::tracker::{self, Effects, Tracker};

/// The state of a watch as data: what [`Watch::restore`](crate::Watch::restore) goes on from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Saved {
    /// (It comes first, so that a state of another version is refused as such.)
    #[serde(deserialize_with = "this_version")]
    pub(crate) version: u32,
    /// The model that it was learned with.
    pub(crate) model: Identity,
    pub(crate) alarms_per_day: f64,
    pub(crate) memory: f64,
    /// Seconds of a block.
    pub(crate) block_seconds: f64,
    pub(crate) usual: Usual,
    /// Mean and standard deviation of the state while it learned: where it begins anew.
    pub(crate) rest: (Vec<f64>, Vec<f64>),
    /// Variance of the scores over that of white innovations.
    pub(crate) inflation: f64,
    /// The filter that keeps to what is usual, and the one whose parameters follow the machine.
    pub(crate) reference: Tracker,
    pub(crate) adaptive: Tracker,
    pub(crate) fit: LeastSquares,
    /// Parameters that follow the machine, SI.
    pub(crate) values: Vec<f64>,
    /// How far every effect may be from where it is.
    pub(crate) wide: Vec<f64>,
    /// What the learned seconds tell of the parameters that may move: their covariance, row by row.
    pub(crate) covered: Vec<f64>,
    /// Per channel, what its last value was like.
    pub(crate) gate: Vec<tracker::Before>,
    /// What is usual moves for a while after a change.
    pub(crate) released: Option<Released>,
    pub(crate) louder: Option<Louder>,
    pub(crate) charts: Vec<Chart>,
    pub(crate) block: Block,
    pub(crate) began: f64,
    pub(crate) history: Vec<Scores>,
    pub(crate) last: Sample,
    /// Samples before it, as far as the model delays something.
    pub(crate) earlier: Vec<Sample>,
    pub(crate) settling: Option<Settling>,
    pub(crate) irregular: Irregular,
    /// Blocks that irregularities wait until they are reported, and the next wait: it doubles while they go on.
    pub(crate) wait: (u32, u32),
}

/// A change that settles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Settling {
    pub(crate) until: f64,
    /// When the fits begin once more, at parameters that are near by then: rows from before are of another linearisation. Nothing
    /// is watched until they end where they began.
    pub(crate) again: Option<f64>,
    pub(crate) begun_again: bool,
    /// The channel whose scatter it is; else a parameter, a force or an offset.
    pub(crate) noise: Option<usize>,
    pub(crate) since: f64,
    /// Means of all charts before.
    pub(crate) means: Vec<f64>,
    /// What was usual before, by which the change is named; none where the scatter has changed.
    pub(crate) before: Option<Before>,
    /// The last blocks, so that what was known of the change can be told when another one began on the way.
    pub(crate) trail: Vec<Known>,
}

/// A filter that keeps to what was usual before a change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Before {
    pub(crate) tracker: Tracker,
    pub(crate) place: Place,
    /// What was known of it.
    pub(crate) fit: LeastSquares,
    pub(crate) block: Block,
    /// Of the blocks since the change began.
    pub(crate) history: Vec<Scores>,
}

/// What was known at the end of a block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Known {
    pub(crate) t: f64,
    /// Of everything that was set free.
    pub(crate) fit: Option<LeastSquares>,
    /// Parameters that follow the machine, SI, and standard deviations of those that may move.
    pub(crate) values: Vec<f64>,
    pub(crate) deviations: Vec<f64>,
}

/// Version of [`Saved`].
pub(crate) const VERSION: u32 = 4;

/// The version, where it is this one.
fn this_version<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    let version = u32::deserialize(deserializer)?;
    if version == VERSION {
        return Ok(version);
    }
    Err(D::Error::custom(format!(
        "the state has version {version}, and this is version {VERSION}: delete it, or name another file"
    )))
}

/// Blocks that are remembered to tell how large a change is, and what was known after each of the last ones.
const REMEMBERED: usize = 512;
const TRAIL: usize = 32;

impl Settling {
    pub(crate) fn know(&mut self, known: Known) {
        self.trail.push(known);
        if self.trail.len() > TRAIL {
            self.trail.remove(0);
        }
    }
}

impl Saved {
    pub(crate) fn remember(&mut self, scores: Scores) {
        self.history.push(scores);
        if self.history.len() > REMEMBERED {
            self.history.remove(0);
        }
    }

    /// Whether its parts have the sizes that they have of each other: it may have been written by anybody.
    pub(crate) fn is_consistent(&self, machine: &Machine) -> bool {
        let system = &machine.system;
        let (np, nx, ny) = (self.usual.free.len(), system.nx, system.ny);
        let effects = np + system.nz + ny;
        let scores = |s: &Scores| s.gradient.len() == effects && s.information.len() == effects;
        let place =
            |p: &Place| p.values.len() == system.np && p.forces.len() == system.nz && p.offsets.len() == ny;
        let fit = |f: &LeastSquares| f.len() == effects && f.is_consistent();
        let before = |b: &Before| {
            b.tracker.has_past_of(machine)
                && b.tracker.shape() == Some((nx, effects, Effects::Everything))
                && place(&b.place)
                && fit(&b.fit)
                && b.block.is_consistent(effects, ny)
                && b.history.iter().all(scores)
                && !b.history.is_empty()
        };
        let known =
            |k: &Known| k.fit.iter().all(fit) && k.values.len() == system.np && k.deviations.len() == np;
        let settles = |s: &Settling| {
            s.means.len() == effects + ny
                && s.noise.is_none_or(|channel| channel < ny)
                && s.before.iter().all(before)
                && s.trail.iter().all(known)
        };
        let times = [self.block_seconds, self.memory, self.usual.dt, self.inflation, self.alarms_per_day];
        times.iter().all(|v| *v > 0.0)
            && self.values.len() == system.np
            && self.usual.rates.iter().all(|r| r.entry < nx)
            && self.usual.steps.count() > 0
            && place(&self.usual.place)
            && self.usual.noise.iter().all(|v| *v > 0.0)
            && self.wide.len() == effects
            && self.wide.iter().all(|v| v.is_finite() && *v > 0.0)
            && self.covered.len() == np * np
            && self.covered.iter().all(|v| v.is_finite())
            && self.gate.len() == ny
            && self.gate.iter().all(tracker::Before::is_consistent)
            && self.released.iter().all(|r| r.is_consistent(effects))
            && self.louder.is_none_or(|l| l.channel < ny)
            && self.rest.1.len() == nx
            && self.last.measured.len() == ny
            && self.earlier.iter().all(|s| s.inputs.len() == system.nu && s.t < self.last.t)
            && self.earlier.windows(2).all(|w| w[0].t < w[1].t)
            && self.reference.has_past_of(machine)
            && self.adaptive.has_past_of(machine)
            && self.reference.shape() == Some((nx, effects, Effects::Everything))
            && self.adaptive.shape() == Some((nx, np, Effects::Parameters))
            && self.fit.len() == np
            && self.fit.is_consistent()
            && self.charts.len() == effects + ny
            && self.charts.iter().all(Chart::is_consistent)
            && self.block.is_consistent(effects, ny)
            && self.history.iter().all(scores)
            && self.settling.as_ref().is_none_or(settles)
    }
}
