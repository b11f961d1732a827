//! The state of a watch as data.

use greybox_model::System;
use greybox_recursive::{Chart, LeastSquares};
use serde::{Deserialize, Serialize};

use crate::blocks::{Block, Scores};
use crate::event::Irregular;
use crate::learn::{Sample, Usual};
use crate::tracker::{Effects, Tracker};

/// The state of a watch as data: what [`Watch::restore`](crate::Watch::restore) goes on from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Saved {
    pub(crate) version: u32,
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
    pub(crate) charts: Vec<Chart>,
    pub(crate) block: Block,
    pub(crate) began: f64,
    pub(crate) history: Vec<Scores>,
    pub(crate) last: Sample,
    pub(crate) settling: Option<Settling>,
    pub(crate) irregular: Irregular,
    /// Blocks that irregularities wait until they are reported, and the next wait: it doubles while they go on.
    pub(crate) wait: (u32, u32),
}

/// A change that settles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Settling {
    pub(crate) until: f64,
    /// When the fit begins once more, at parameters that are near by then: rows from before are of another linearisation.
    pub(crate) again: Option<f64>,
    /// The channel whose scatter it is; else a parameter, a force or an offset.
    pub(crate) noise: Option<usize>,
    pub(crate) since: f64,
    /// Means of all charts before.
    pub(crate) means: Vec<f64>,
}

/// Version of [`Saved`].
pub(crate) const VERSION: u32 = 1;

impl Saved {
    /// Whether its parts have the sizes that they have of each other: it may have been written by anybody.
    pub(crate) fn is_consistent(&self, system: &System) -> bool {
        let (np, nx, ny) = (self.usual.free.len(), system.nx, system.ny);
        let effects = np + system.nz + ny;
        let scores = |s: &Scores| s.gradient.len() == effects && s.information.len() == effects;
        let settles =
            |s: &Settling| s.means.len() == effects + ny && s.noise.is_none_or(|channel| channel < ny);
        let times = [self.block_seconds, self.memory, self.usual.dt, self.inflation, self.alarms_per_day];
        times.iter().all(|v| *v > 0.0)
            && self.values.len() == system.np
            && self.usual.rates.iter().all(|r| r.entry < nx)
            && self.usual.steps.count() > 0
            && self.rest.1.len() == nx
            && self.last.measured.len() == ny
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
