//! What is usual: parameters, noise and model error of the first seconds.

use std::sync::Arc;

use greybox_calibrate::stochastic::{Filter, Fitted, RateNoise, Stochastic};
use greybox_calibrate::{Data, Prior, Setup, free_parameters};
use greybox_model::Model;
use greybox_recording::{Channel, Recording, health};
use greybox_simulate::Method;
use serde::{Deserialize, Serialize};

use crate::error::WatchError;
use crate::event::Irregular;
use crate::machine::Machine;
use crate::options::{BLOCK_SAMPLES, BLOCKS, Options};
use crate::sample::Sample;

/// Steps of the fit.
const ITERATIONS: usize = 60;
/// Thinning from which on one step of the fourth order from sample to sample replaces those of higher ones.
const CLOSE: usize = 8;
/// Samples that are enough for the fit, as many as its shortest horizon corrects by; and samples that it takes at least in a
/// period of the fastest channel.
const ENOUGH: usize = 5000;
const IN_PERIOD: f64 = 50.0;
/// Standard deviation of a parameter of which nothing is known beforehand, over what the first seconds tell of it.
pub(crate) const WIDE: f64 = 100.0;

/// A parameter that may move.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Free {
    pub(crate) index: usize,
    /// Name in the model, to tell models apart.
    pub(crate) name: String,
    /// How far it may be from the learned value.
    pub(crate) std: f64,
    /// Bounds, where physics sets them.
    pub(crate) lower: Option<f64>,
    pub(crate) upper: Option<f64>,
}

/// What disturbs a rate: [`RateNoise`] as data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Rate {
    pub(crate) entry: usize,
    pub(crate) intensity: f64,
    pub(crate) slow: Option<f64>,
}

impl Rate {
    pub(crate) fn variance(&self, x: &[f64], dt: f64) -> f64 {
        RateNoise { entry: self.entry, intensity: self.intensity, slow: self.slow }.variance(x, dt)
    }
}

/// How the model is integrated from sample to sample.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) enum Steps {
    Rk4(usize),
    Dp5(usize),
    Dop853(usize),
}

impl Steps {
    /// Of a method that a recording thinned so much chose; one that chooses its steps itself takes the steps of the fifth order.
    /// Between samples that are much closer, the fourth order is as good with as many evaluations.
    fn of(method: Method, thinning: usize) -> Steps {
        let least = |substeps: usize| substeps.div_ceil(thinning);
        match method {
            Method::Rk4 { .. } | Method::Dp5 { .. } | Method::Dop853 { .. } if thinning >= CLOSE => {
                Steps::Rk4((method.evaluations() / (4 * thinning) as f64).ceil().max(1.0) as usize)
            }
            // (A filter goes from sample to sample.)
            Method::Rk4Stride { .. } => Steps::Rk4(1),
            Method::Rk4 { substeps } => Steps::Rk4(least(substeps)),
            Method::Dp5 { substeps } => Steps::Dp5(least(substeps)),
            Method::Dop853 { substeps } => Steps::Dop853(least(substeps)),
            Method::Adaptive { .. } => Steps::Dp5(4),
        }
    }

    /// Steps from sample to sample.
    pub(crate) fn count(self) -> usize {
        match self {
            Steps::Rk4(n) | Steps::Dp5(n) | Steps::Dop853(n) => n,
        }
    }

    pub(crate) fn method(self) -> Method {
        match self {
            Steps::Rk4(substeps) => Method::Rk4 { substeps },
            Steps::Dp5(substeps) => Method::Dp5 { substeps },
            Steps::Dop853(substeps) => Method::Dop853 { substeps },
        }
    }
}

/// Where a model is, SI.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Place {
    /// All parameters of the model.
    pub(crate) values: Vec<f64>,
    /// A constant force per equation, in the unit of its highest derivative.
    pub(crate) forces: Vec<f64>,
    /// An offset per sensor.
    pub(crate) offsets: Vec<f64>,
}

impl Place {
    /// All that may change: parameters, forces, offsets.
    pub(crate) fn effects(&self, free: &[Free]) -> Vec<f64> {
        let parameters = free.iter().map(|f| self.values[f.index]);
        parameters.chain(self.forces.iter().copied()).chain(self.offsets.iter().copied()).collect()
    }

    /// Goes to the effects `to`, or those of them that come first; how far. A bound is never reached, only half of the way
    /// to it.
    pub(crate) fn go(&mut self, free: &[Free], to: &[f64]) -> Vec<f64> {
        let parameters = free.iter().map(|f| (Some(f.index), f.lower, f.upper));
        let others = self.forces.len() + self.offsets.len();
        let bounds: Vec<_> = parameters.chain((0..others).map(|_| (None, None, None))).collect();
        let (forces, np) = (self.forces.len(), free.len());
        let mut change = Vec::with_capacity(to.len());
        for (k, (to, (index, lower, upper))) in to.iter().zip(bounds).enumerate() {
            let at = match index {
                Some(index) => &mut self.values[index],
                None if k - np < forces => &mut self.forces[k - np],
                None => &mut self.offsets[k - np - forces],
            };
            let to = match (lower, upper) {
                (Some(low), _) if *to <= low => 0.5 * (*at + low),
                (_, Some(high)) if *to >= high => 0.5 * (*at + high),
                _ => *to,
            };
            change.push(to - *at);
            *at = to;
        }
        change
    }
}

/// What is usual.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Usual {
    /// Where the model is.
    pub(crate) place: Place,
    pub(crate) free: Vec<Free>,
    /// Standard deviation of each sensor, SI.
    pub(crate) noise: Vec<f64>,
    pub(crate) rates: Vec<Rate>,
    /// Seconds between two samples.
    pub(crate) dt: f64,
    pub(crate) steps: Steps,
}

/// The first seconds.
pub(crate) struct First {
    pub(crate) machine: Machine,
    pub(crate) usual: Usual,
    /// First state and its standard deviations.
    pub(crate) start: (Vec<f64>, Vec<f64>),
    pub(crate) samples: Vec<Sample>,
    /// What was not as it should be.
    pub(crate) irregular: Irregular,
}

/// Fits the model with its own error and the sensors' noise to the first seconds.
pub(crate) fn learn(model: &Model, recording: &Recording, options: &Options) -> Result<First, WatchError> {
    let (recording, irregular) = without_outliers(model, recording);
    let recording = &recording;
    let data = Arc::new(Data::new(model, std::slice::from_ref(recording))?);
    let longest = data.pieces.iter().map(|p| p.len).max().unwrap_or(0);
    let needed = BLOCKS.0 * BLOCK_SAMPLES;
    if longest < needed {
        return Err(WatchError::TooShort { seconds: options.learn, samples: longest, needed });
    }
    let free = free_parameters(model);
    if free.is_empty() {
        return Err(WatchError::NothingFree);
    }
    let thinning = thinning(&data);
    let thin = if thinning > 1 { Arc::new(data.thinned(model, thinning)) } else { data.clone() };
    let setup = Setup::new(model, thin, free)?;
    if !setup.system.output.delays.is_empty() {
        return Err(WatchError::DelayedMeasurement);
    }
    let filter = Filter::new(&setup);
    let weight = 1.0 / filter.strides().len() as f64;
    let first =
        Stochastic { parameters: setup.values(), errors: filter.first_errors(), starts: Vec::new(), setup };
    let fitted = filter.fit(first, weight, ITERATIONS).ok_or(WatchError::Diverged)?;
    let (x, covariance) = filter.start(&fitted.at, 0);
    let nx = x.len();
    let deviations = (0..nx).map(|i| covariance[i * nx + i].sqrt()).collect();
    let usual = usual(&fitted, &filter.rate_noise(&fitted.at), weight, thinning);
    let setup = fitted.at.setup;
    let indices = setup.free.iter().map(|f| f.index).collect();
    let (system, steps) = (setup.system.clone(), usual.steps.method());
    let machine = Machine::new(model.clone(), system, steps, indices, &usual.place.values);
    Ok(First {
        machine,
        usual,
        start: (x, deviations),
        samples: samples(&data, recording.time[0]),
        irregular,
    })
}

/// The recording without the measured values that stand out of their neighbours, which are not measured then, and what is not as
/// it should be in it. The likelihood of the fit is that of normal innovations, which one such value among n moves without bound:
/// the variance by its square over n. That rejection needs no model, so that what a model leaves is no outlier (a hard rejection by
/// a robust scale: F. R. Hampel et al., *Robust Statistics*, 1986, §1.4). What inputs do is no fault of a measurement.
fn without_outliers(model: &Model, recording: &Recording) -> (Recording, Irregular) {
    let unmeasured = |name: &str| recording.channel(name).map_or(&[][..], |c: &Channel| &c.values[..]);
    let missing = |name: &str| unmeasured(name).iter().filter(|v| v.is_nan()).count() as u64;
    let mut irregular = Irregular {
        not_measured: model.measurements.iter().map(|m| missing(&m.channel)).sum(),
        input_held: model.inputs.iter().map(|i| missing(&i.channel)).sum(),
        ..Irregular::default()
    };
    let is_input = |name: &str| model.inputs.iter().any(|i| i.column(|_| true) == name);
    let mut channels = recording.channels.clone();
    for m in model.measurements.iter().filter(|m| !is_input(&m.channel)) {
        let Some(c) = recording.channel_index(&m.channel) else { continue };
        for row in health::outliers(recording, c) {
            channels[c].values[row] = f64::NAN;
            irregular.outliers += 1;
        }
    }
    let cleaned = (irregular.outliers > 0)
        .then(|| Recording::from_columns(&recording.name, recording.time.clone(), channels).ok())
        .flatten();
    (cleaned.unwrap_or_else(|| recording.clone()), irregular)
}

/// Samples from one to the next that the fit takes: as long as enough are left, and many in a period of the fastest channel.
fn thinning(data: &Data) -> usize {
    let period = data.periods().into_iter().fold(f64::INFINITY, f64::min);
    let slow = (period / IN_PERIOD) as usize;
    (data.samples() / ENOUGH).min(slow).max(1)
}

fn usual(fitted: &Fitted, noise: &[RateNoise], weight: f64, thinning: usize) -> Usual {
    let at = &fitted.at;
    let n = fitted.pass.gradient.len();
    let finite = |v: f64| v.is_finite().then_some(v);
    let free = at
        .setup
        .free
        .iter()
        .enumerate()
        .map(|(a, f)| {
            let estimated = 1.0 / (weight * fitted.pass.information[a * n + a]).sqrt();
            let wide =
                if estimated.is_finite() { WIDE * estimated } else { at.parameters[f.index].abs().max(1.0) };
            let std = match f.prior {
                Prior::Normal { std, .. } => std,
                Prior::Cauchy { scale, .. } => scale.max(0.5 * at.parameters[f.index].abs()),
                Prior::Flat => wide,
            };
            Free {
                index: f.index,
                name: at.setup.model.parameters[f.index].name.clone(),
                std,
                lower: finite(f.lower),
                upper: finite(f.upper),
            }
        })
        .collect();
    let dt = at.setup.data.pieces.iter().max_by_key(|p| p.len).map_or(1.0, |p| p.dt) / thinning as f64;
    Usual {
        place: Place {
            values: at.parameters.clone(),
            forces: vec![0.0; at.setup.system.nz],
            offsets: vec![0.0; at.setup.system.ny],
        },
        free,
        noise: at.errors.noise(),
        rates: noise.iter().map(|r| Rate { entry: r.entry, intensity: r.intensity, slow: r.slow }).collect(),
        dt,
        steps: Steps::of(at.setup.method, thinning),
    }
}

/// All samples, on the clock of the recording: its pieces count from its `first` time.
fn samples(data: &Data, first: f64) -> Vec<Sample> {
    data.pieces
        .iter()
        .flat_map(|piece| {
            (0..piece.len).map(|k| Sample {
                t: first + piece.start + piece.dt * k as f64,
                inputs: piece.inputs.iter().map(|u| u[k]).collect(),
                measured: piece.measured.iter().map(|y| Some(y[k]).filter(|v| v.is_finite())).collect(),
            })
        })
        .collect()
}
