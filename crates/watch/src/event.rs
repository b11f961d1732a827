//! What a watch says.

use greybox_recursive::Direction;
use serde::{Deserialize, Serialize};

/// What a watch says. All values are in the units of the model file, times in seconds on the clock of the samples.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Event {
    /// It is known what is usual.
    Learned(Learned),
    /// Where the parameters are now: one at the end of every block.
    Estimates(Estimates),
    /// Something has changed.
    Changed(Change),
    /// What changed has settled, and is usual from here on: the same change, known better. Where something else has changed on
    /// the way, it is told just before that.
    Settled(Change),
    /// The machine does what it did not while it was learned what is usual: nothing is said of it, and it is time to learn anew,
    /// from samples that have this ([`Watch::learn`](crate::Watch::learn)).
    Outside(Outside),
    /// Samples were not as they should be.
    Irregular(Irregular),
    /// The clock jumped, or samples were missing for longer than a block: the state begins anew.
    Restarted(Clock),
}

/// A parameter with its standard deviation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Parameter {
    /// Name in the model.
    pub name: String,
    /// Value.
    pub value: f64,
    /// Standard deviation.
    pub std: f64,
    /// Unit, as the model file has it.
    pub unit: Option<String>,
}

/// What is usual.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Learned {
    /// Time of the last sample of it.
    pub t: f64,
    /// Samples a second.
    pub rate: f64,
    /// Seconds of a block: one value of each chart.
    pub block: f64,
    /// False alarms a day, of all charts together.
    pub alarms_per_day: f64,
    /// Number of charts.
    pub charts: usize,
    /// Parameters as learned.
    pub parameters: Vec<Parameter>,
    /// Those of which the learned seconds tell less than was known beforehand: nothing that they do not excite is watched.
    pub undetermined: Vec<String>,
}

/// Where the parameters are now.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Estimates {
    /// Time of the last sample.
    pub t: f64,
    /// Parameters.
    pub parameters: Vec<Parameter>,
    /// Their covariance, row by row, in the units of the parameters.
    pub covariance: Vec<f64>,
    /// Missing on the rate of each state's highest derivative over the last block, by name of the state and its unit (of the
    /// highest derivative, SI), with its standard deviation.
    pub missing: Vec<Parameter>,
    /// RMS of the innovations of the learned model over the last block, by channel, in standard deviations.
    pub innovations: Vec<(String, f64)>,
}

/// What changed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "what", content = "name", rename_all = "snake_case")]
pub enum Subject {
    /// A parameter of the model.
    Parameter(String),
    /// A constant force (heat flow, current, …) in the equation of this state.
    Force(String),
    /// The zero of this channel's sensor.
    Offset(String),
    /// The scatter of this channel, which no parameter explains.
    Noise(String),
}

impl Subject {
    /// Name of the parameter, state or channel.
    pub fn name(&self) -> &str {
        match self {
            Subject::Parameter(n) | Subject::Force(n) | Subject::Offset(n) | Subject::Noise(n) => n,
        }
    }
}

/// Something has changed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Change {
    /// Time at which this is said.
    pub t: f64,
    /// What has changed most likely.
    #[serde(flatten)]
    pub subject: Subject,
    /// What the block cannot tell from it.
    pub or: Vec<Subject>,
    /// Which way.
    #[serde(serialize_with = "direction")]
    pub direction: Direction,
    /// When it began, by maximum likelihood.
    pub since: f64,
    /// Value before: one for the scatter.
    pub before: f64,
    /// Value since then. Of a parameter that has settled, where the followed model has it; else to first order.
    pub now: f64,
    /// Standard deviation of the difference.
    pub std: f64,
    /// Unit.
    pub unit: Option<String>,
}

impl Change {
    /// The change over the value before, where there is one: a force or an offset is compared with nothing.
    pub fn relative(&self) -> Option<f64> {
        let of_itself = matches!(self.subject, Subject::Parameter(_) | Subject::Noise(_));
        (of_itself && self.before != 0.0).then(|| (self.now - self.before) / self.before.abs())
    }
}

fn direction<S: serde::Serializer>(direction: &Direction, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(match direction {
        Direction::Up => "up",
        Direction::Down => "down",
    })
}

/// Samples since the last such report that were not as they should be; while they go on, reports come at doubling intervals.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Irregular {
    /// Samples older than the one before: passed over.
    pub late: u64,
    /// Samples at the time of the one before: passed over.
    pub repeated: u64,
    /// Samples missing between two that came.
    pub missing: u64,
    /// Measured values that are no number, or none that can be computed with: not used.
    pub not_measured: u64,
    /// Measured values that stand alone, far from what was predicted or from their neighbours: not used.
    #[serde(default)]
    pub outliers: u64,
    /// Inputs that are no number, or none that can be computed with: the value before held on.
    pub input_held: u64,
    /// Times the simulation left every bound and the state began anew.
    pub diverged: u64,
}

impl Irregular {
    /// Whether there is nothing to report.
    pub fn is_empty(&self) -> bool {
        *self == Irregular::default()
    }
}

/// What was not part of what was learned.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Outside {
    /// Time of the last sample of the block, s.
    pub t: f64,
    /// Parameters of which the block says more than all that was learned, that of which it says most first.
    pub parameters: Vec<String>,
}

/// A clock that jumped.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Clock {
    /// Time of the sample before.
    pub from: f64,
    /// Time of this sample.
    pub t: f64,
}
