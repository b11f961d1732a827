//! Recordings laid out for a model: inputs and measurements in SI on uniform grids.

use std::ops::Range;
use std::sync::OnceLock;

use greybox_model::{Dimension, Expr, Func, Hold, Input, Model, Unit, UnitError, nearest};
use greybox_recording::interpolate::{fill_missing, hold_missing};
use greybox_recording::{Recording, SIZES, smooth::Smoothed};
use greybox_simulate::{Environment, FINE, Signal};

/// A recording that does not fit the model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// A channel that the model needs is not in the file.
    #[error(
        "{file}: there is no channel `{channel}`, which the model's {role} needs; the file has {available}. {help}"
    )]
    MissingChannel {
        /// File.
        file: String,
        /// What was looked for.
        channel: String,
        /// Input, state or measurement of the model.
        role: String,
        /// What there is instead.
        available: String,
        /// How to give the model a channel of the file.
        help: String,
    },
    /// The header's unit and the model's do not measure the same thing.
    #[error(
        "{file}: channel `{channel}` is in [{found}], but the model's {role} has the unit `{expected}`; they do not measure the same thing. Correct the header or the model"
    )]
    Unit {
        /// File.
        file: String,
        /// Channel.
        channel: String,
        /// Header unit.
        found: String,
        /// Input, state or measurement of the model.
        role: String,
        /// The model's unit.
        expected: String,
    },
    /// The header's unit cannot be read.
    #[error("{file}: channel `{channel}`: {message}")]
    UnreadableUnit {
        /// File.
        file: String,
        /// Channel.
        channel: String,
        /// Why.
        message: String,
    },
    /// A channel without a single value.
    #[error(
        "{file}: channel `{channel}` has no value at all; fill the column, or take the channel out of the model"
    )]
    EmptyChannel {
        /// File.
        file: String,
        /// Channel.
        channel: String,
    },
    /// A channel whose squares are no numbers.
    #[error(
        "{file}: channel `{channel}` reaches {largest:e} in SI units, too much to compute with: check the column and its unit, and empty the cells that are no measurements"
    )]
    OutOfRange {
        /// File.
        file: String,
        /// Channel.
        channel: String,
        /// Its largest magnitude, SI.
        largest: f64,
    },
    /// The derivative of a channel that has none.
    #[error("{file}: input `{input}` is the derivative of channel `{channel}`, {reason}. {help}")]
    Derivative {
        /// File.
        file: String,
        /// Input of the model.
        input: String,
        /// The channel.
        channel: String,
        /// Why there is none.
        reason: String,
        /// What to do instead.
        help: String,
    },
    /// The model measures nothing.
    #[error("the model has no measured state: give one a channel, or add [measurements]")]
    NothingMeasured,
}

/// A measured channel.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelInfo {
    /// Name in the recordings.
    pub name: String,
    /// Unit in the model.
    pub unit: Unit,
}

/// The unit in which a channel is recorded: that of its header, else that of the model. `measured` is the expression
/// that it measures; a difference of temperatures has no zero, whatever the header says.
///
/// # Errors
/// [`UnitError`] where the header's text is no unit, neither built in nor declared by the model.
pub fn recorded_unit(
    model: &Model,
    header: Option<&str>,
    unit: &Unit,
    measured: Option<&Expr>,
) -> Result<Unit, UnitError> {
    let stated = header.map(|text| model.units.parse(text)).transpose()?;
    let unit = stated.unwrap_or_else(|| unit.clone());
    let difference = unit.offset != 0.0 && measured.is_some_and(|e| model.is_difference(e));
    Ok(if difference { unit.of_difference() } else { unit })
}

/// One uniformly sampled stretch.
#[derive(Debug)]
pub struct PieceData {
    /// Which recording it belongs to.
    pub recording: usize,
    /// Rows of the file.
    pub rows: Range<usize>,
    /// Time of the first sample on the recording's clock, s.
    pub start: f64,
    /// Sample interval, s.
    pub dt: f64,
    /// Number of samples.
    pub len: usize,
    /// Inputs in the model's order, SI, missing samples interpolated.
    pub inputs: Vec<Vec<f64>>,
    /// Measurements in the model's order, SI, NaN = missing.
    pub measured: Vec<Vec<f64>>,
    /// The measurements smoothed.
    pub smooth: Vec<Smoothed>,
    fine: Vec<OnceLock<Vec<f64>>>,
}

/// All recordings of one role (training or held out), laid out for one model.
#[derive(Debug)]
pub struct Data {
    /// File names.
    pub recordings: Vec<String>,
    /// Measured channels in the model's order.
    pub channels: Vec<ChannelInfo>,
    /// The pieces, recording by recording.
    pub pieces: Vec<PieceData>,
    /// Standard deviation of the measurement noise per channel (SI), median over the recordings.
    pub sigma: Vec<f64>,
    /// RMS about the mean per channel over all samples (SI).
    pub spread: Vec<f64>,
}

impl Data {
    /// Lays `recordings` out for `model`.
    ///
    /// # Errors
    /// [`DataError`] when a channel is missing or empty, or a unit in a header does not fit.
    pub fn new(model: &Model, recordings: &[Recording]) -> Result<Data, DataError> {
        if model.measurements.is_empty() {
            return Err(DataError::NothingMeasured);
        }
        let mut pieces = Vec::new();
        let mut sigmas: Vec<Vec<f64>> = vec![Vec::new(); model.measurements.len()];
        for (index, recording) in recordings.iter().enumerate() {
            let mut inputs = Vec::new();
            for input in &model.inputs {
                inputs.push(find_input(model, input, recording)?);
            }
            let mut measured = Vec::new();
            for m in &model.measurements {
                let state = model.states.iter().find(|s| s.channel.as_ref() == Some(&m.channel));
                let wanted = Wanted {
                    channel: &m.channel,
                    role: format!("measurement `{}`", m.expr),
                    name: state.map(|s| s.name.as_str()),
                    unit: &m.unit,
                    measured: Some(&m.expr),
                };
                measured.push(find_channel(model, recording, wanted)?);
            }
            let scaled = |(channel, unit): &(usize, Unit), piece: &greybox_recording::Piece| -> Vec<f64> {
                piece.columns[*channel].iter().map(|v| unit.to_si(*v)).collect()
            };
            let mut of_recording: Vec<Vec<f64>> = vec![Vec::new(); measured.len()];
            for piece in &recording.pieces {
                let ys: Vec<Vec<f64>> = measured.iter().map(|m| scaled(m, piece)).collect();
                let mut smooth = Vec::new();
                for (c, y) in ys.iter().enumerate() {
                    let sigma = noise_level(y);
                    of_recording[c].push(sigma);
                    let sigma = if sigma.is_finite() { sigma } else { 0.0 };
                    smooth.push(greybox_recording::smooth::adaptive(y, piece.dt, sigma));
                }
                pieces.push(PieceData {
                    recording: index,
                    rows: piece.rows.clone(),
                    start: piece.start,
                    dt: piece.dt,
                    len: piece.len,
                    inputs: inputs
                        .iter()
                        .zip(&model.inputs)
                        .map(|(found, input)| {
                            let (channel, unit) = &found.column;
                            if found.differentiated {
                                let values = scaled(&found.column, piece);
                                derivative(&fill_missing(&values), piece.dt, input.hold)
                            } else if input.hold == Hold::Zero {
                                hold_missing(&recording.held(piece, *channel))
                                    .iter()
                                    .map(|v| unit.to_si(*v))
                                    .collect()
                            } else {
                                fill_missing(&scaled(&found.column, piece))
                            }
                        })
                        .collect(),
                    measured: ys,
                    smooth,
                    fine: inputs.iter().map(|_| OnceLock::new()).collect(),
                });
            }
            for (c, values) in of_recording.iter().enumerate() {
                sigmas[c].push(greybox_recording::noise::median(values));
            }
        }
        let channels: Vec<ChannelInfo> = model
            .measurements
            .iter()
            .map(|m| ChannelInfo { name: m.channel.clone(), unit: m.unit.clone() })
            .collect();
        let spread: Vec<f64> = (0..channels.len())
            .map(|c| {
                let values: Vec<f64> = pieces
                    .iter()
                    .flat_map(|p| p.measured[c].iter().copied())
                    .filter(|v| !v.is_nan())
                    .collect();
                spread(&values)
            })
            .collect();
        let sigma = sigmas
            .iter()
            .zip(&spread)
            .map(|(s, spread)| {
                let sigma = greybox_recording::noise::median(s);
                // A recording without noise (a simulation) still has rounding and integration error.
                let floor = 1e-6 * spread;
                if sigma.is_finite() { sigma.max(floor) } else { floor.max(f64::MIN_POSITIVE) }
            })
            .collect();
        Ok(Data {
            recordings: recordings.iter().map(|r| r.name.clone()).collect(),
            channels,
            pieces,
            sigma,
            spread,
        })
    }

    /// Every n-th sample of each piece (n = `every`, at least 1), nΔt apart, all in SI as before. Inputs are means over what is left
    /// out, so that an integrator that they drive ends where it did:
    ///
    /// ```text
    /// ū(kn) = 1/n Σ u(kn + i), 0 ≤ i < n               an input that is held
    /// ū(kn) = Σ (n − |i|) u(kn + i) / Σ (n − |i|), |i| < n    any other
    /// ```
    ///
    /// (over the samples that there are). What is known of the noise is that of all samples.
    pub fn thinned(&self, model: &Model, every: usize) -> Data {
        let every = every.max(1);
        let pick = |values: &[f64]| -> Vec<f64> { values.iter().step_by(every).copied().collect() };
        let piece = |piece: &PieceData| {
            let thin = |(u, input): (&Vec<f64>, &Input)| match input.hold {
                Hold::Zero => {
                    u.chunks(every).map(|held| held.iter().sum::<f64>() / held.len() as f64).collect()
                }
                Hold::Linear | Hold::BandLimited => triangular_means(u, every),
            };
            let smooth = |s: &Smoothed| Smoothed {
                value: pick(&s.value),
                d1: pick(&s.d1),
                d2: pick(&s.d2),
                window: s.window.div_ceil(every),
                derivative_window: s.derivative_window.div_ceil(every),
                ..s.clone()
            };
            let measured: Vec<Vec<f64>> = piece.measured.iter().map(|y| pick(y)).collect();
            PieceData {
                recording: piece.recording,
                rows: piece.rows.clone(),
                start: piece.start,
                dt: piece.dt * every as f64,
                len: piece.len.div_ceil(every),
                inputs: piece.inputs.iter().zip(&model.inputs).map(thin).collect(),
                measured,
                smooth: piece.smooth.iter().map(smooth).collect(),
                fine: piece.inputs.iter().map(|_| OnceLock::new()).collect(),
            }
        };
        Data {
            recordings: self.recordings.clone(),
            channels: self.channels.clone(),
            pieces: self.pieces.iter().map(piece).collect(),
            sigma: self.sigma.clone(),
            spread: self.spread.clone(),
        }
    }

    /// Environments of all pieces under the given holds (one per input).
    pub fn environments(&self, holds: &[Hold]) -> Vec<Environment> {
        self.pieces
            .iter()
            .map(|piece| Environment {
                start: piece.start,
                dt: piece.dt,
                len: piece.len,
                inputs: piece
                    .inputs
                    .iter()
                    .zip(&piece.fine)
                    .zip(holds)
                    .map(|((u, fine), &hold)| {
                        Signal::new(hold, piece.dt, u, |u| {
                            fine.get_or_init(|| {
                                greybox_recording::interpolate::upsample_band_limited(u, FINE)
                            })
                            .clone()
                        })
                    })
                    .collect(),
                forces: Vec::new(),
            })
            .collect()
    }

    /// Whether an input moves within a piece. One that does not is a known constant: nothing in these data tells what the
    /// model does with its changes.
    pub fn input_moves(&self, input: usize) -> bool {
        let moves = |u: &Vec<f64>| u.iter().any(|v| *v != u[0]);
        self.pieces.iter().filter_map(|p| p.inputs.get(input)).any(moves)
    }

    /// Whether an input has more than one value, in one piece or in several.
    pub fn input_varies(&self, input: usize) -> bool {
        let first = self.pieces.first().and_then(|p| p.inputs.get(input)?.first());
        let differs = |u: &Vec<f64>| u.first() != first;
        self.input_moves(input) || self.pieces.iter().filter_map(|p| p.inputs.get(input)).any(differs)
    }

    /// Number of samples of each channel, over all pieces.
    pub fn samples(&self) -> usize {
        self.pieces.iter().map(|p| p.len).sum()
    }

    /// Periods of the channels of all pieces that move, samples: 2π·(RMS about the mean)/(RMS of the rate), which is a sine's
    /// own period.
    pub fn periods(&self) -> Vec<f64> {
        let period = |swing: f64, rate: &[f64], dt: f64| {
            let rate = (rate.iter().map(|v| v * v).sum::<f64>() / rate.len().max(1) as f64).sqrt();
            (swing > 0.0 && rate > 0.0).then(|| 2.0 * std::f64::consts::PI * swing / rate / dt)
        };
        let channels = self.pieces.iter().flat_map(|piece| piece.smooth.iter().map(|s| (s, piece.dt)));
        channels.filter_map(|(s, dt)| period(spread(&s.value), &s.d1, dt)).collect()
    }

    /// Number of samples of each piece.
    pub fn lengths(&self) -> Vec<usize> {
        self.pieces.iter().map(|p| p.len).collect()
    }

    /// The data up to, and from, the sample where the last `share` of each recording begins: used when
    /// no recording is held out.
    pub fn split_tail(recordings: &[Recording], share: f64) -> (Vec<Recording>, Vec<Recording>) {
        let cut = |r: &Recording, head: bool| -> Option<Recording> {
            let n = r.time.len();
            let at = ((n as f64) * (1.0 - share)).round() as usize;
            let range = if head { 0..at } else { at..n };
            let channels = r
                .channels
                .iter()
                .map(|c| greybox_recording::Channel { values: c.values[range.clone()].to_vec(), ..c.clone() })
                .collect();
            let mut part = Recording::from_columns(&r.name, r.time[range].to_vec(), channels).ok()?;
            part.name = r.name.clone();
            if !head {
                // Still on the recording's own clock: `t` and `step` mean the same as before.
                let offset = r.time[at] - r.time[0];
                part.pieces.iter_mut().for_each(|p| p.start += offset);
            }
            Some(part)
        };
        recordings
            .iter()
            .filter_map(|r| match (cut(r, true), cut(r, false)) {
                (Some(a), Some(b)) => Some((a, b)),
                _ => None,
            })
            .unzip()
    }
}

/// Means of a signal about every n-th sample, with weights that fall linearly to zero at n samples from it.
fn triangular_means(u: &[f64], every: usize) -> Vec<f64> {
    let mean = |at: usize| {
        let (from, to) = (at.saturating_sub(every - 1), (at + every).min(u.len()));
        let weight = |k: usize| (every - k.abs_diff(at)) as f64;
        let sum: f64 = (from..to).map(|k| weight(k) * u[k]).sum();
        sum / (from..to).map(weight).sum::<f64>()
    };
    (0..u.len()).step_by(every).map(mean).collect()
}

/// How to give the model, which looks for `channel`, one that the recording has; `name` is that of the input or state, with
/// the primes of its channel.
fn help(channel: &str, name: Option<(&str, &str)>, recording: &Recording) -> String {
    let there = recording.channels.iter().map(|c| c.name.as_str());
    // Of a name of one or two letters, any other is a slip away.
    let near = nearest(channel, there).filter(|_| channel.chars().count() > 2);
    let (slip, column) = match near {
        Some(near) => (format!("Did you mean `{near}`? "), near),
        None => (String::new(), "…"),
    };
    let in_model = match name {
        Some((name, primes)) => format!("`{name} = {{ channel = \"{column}{primes}\" }}`"),
        None => format!("`{column}` in the place of `{channel}` under `[measurements]`"),
    };
    format!(
        "{slip}Name the column on the command line, `--map {channel}={column}`, or in the model, {in_model}"
    )
}

/// Where an input is found.
struct FoundInput {
    /// Column and its unit, before it is differentiated.
    column: (usize, Unit),
    differentiated: bool,
}

/// Where a recording has an input of the model: in the channel of its name, or in that whose derivative it is.
fn find_input(model: &Model, input: &Input, recording: &Recording) -> Result<FoundInput, DataError> {
    let role = format!("input `{}`", input.name);
    let base = input.derivative_of().filter(|_| recording.channel(&input.channel).is_none());
    let Some(base) = base else {
        let (channel, name) = (&input.channel, Some(&*input.name));
        let wanted = Wanted { channel, role, name, unit: &input.unit, measured: None };
        return Ok(FoundInput { column: find_channel(model, recording, wanted)?, differentiated: false });
    };
    let refused = |reason: &str, help: String| DataError::Derivative {
        file: recording.name.clone(),
        input: input.name.clone(),
        channel: base.to_owned(),
        reason: reason.to_owned(),
        help,
    };
    if base.ends_with('\'') {
        return Err(refused(
            "and only the first derivative of a channel is taken",
            format!("Record it as a channel `{}`", input.channel),
        ));
    }
    let itself = model.inputs.iter().find(|other| other.channel == base);
    if let Some(held) = itself.filter(|other| other.hold == Hold::Zero) {
        return Err(refused(
            &format!(
                "which input `{}` keeps between its samples (`hold = \"zero\"`), so that it jumps",
                held.name
            ),
            format!(
                "If the channel is a measured signal, write `hold = \"linear\"` at input `{}`; else record its derivative \
                 as a channel `{}`",
                held.name, input.channel
            ),
        ));
    }
    // A column without a unit is in that of the model: of the input or the measurement that it also is.
    let measured = model.measurements.iter().find(|m| m.channel == base).map(|m| &m.unit);
    let mut unit = match itself.map(|other| &other.unit).or(measured) {
        Some(unit) => unit.clone(),
        None => {
            let dimension = input.unit.dimension * Dimension::TIME;
            Unit { factor: input.unit.factor, ..Unit::si(dimension) }
        }
    };
    let known = unit.dimension / Dimension::TIME;
    if (itself.is_some() || measured.is_some()) && !known.same(&input.unit.dimension) {
        return Err(refused(
            &format!("which the model has in `{}`, but its own unit is `{}`", unit.text, input.unit.text),
            format!("Write `unit = \"{}/s\"` at input `{}`", unit.text, input.name),
        ));
    }
    unit.dimension = input.unit.dimension * Dimension::TIME;
    let role = format!("{role} (its derivative)");
    let wanted = Wanted { channel: base, role, name: None, unit: &unit, measured: None };
    let column = find_channel(model, recording, wanted).map_err(|error| match error {
        DataError::MissingChannel { file, channel, role, available, .. } => {
            let help = help(base, Some((&input.name, "'")), recording);
            DataError::MissingChannel { file, channel, role, available, help }
        }
        other => other,
    })?;
    Ok(FoundInput { column, differentiated: true })
}

/// Samples of the derivative of a signal without missing samples. What stays constant between samples is the slope of the
/// straight lines; the others go through the derivative at the samples.
pub(crate) fn derivative(u: &[f64], dt: f64, hold: Hold) -> Vec<f64> {
    let n = u.len();
    if n < 2 {
        return vec![0.0; n];
    }
    match hold {
        Hold::Zero => (0..n).map(|k| k.min(n - 2)).map(|k| (u[k + 1] - u[k]) / dt).collect(),
        Hold::Linear => (0..n)
            .map(|k| {
                let (a, b) = (k.saturating_sub(1), (k + 1).min(n - 1));
                (u[b] - u[a]) / ((b - a) as f64 * dt)
            })
            .collect(),
        Hold::BandLimited => {
            let fine = greybox_recording::interpolate::upsample_band_limited(u, FINE);
            let (h, last) = (dt / FINE as f64, fine.len() - 1);
            let at = |k: usize| match (k.checked_sub(2), k + 2 <= last) {
                (Some(_), true) => {
                    (8.0 * (fine[k + 1] - fine[k - 1]) - (fine[k + 2] - fine[k - 2])) / (12.0 * h)
                }
                (None, _) => (4.0 * fine[1] - 3.0 * fine[0] - fine[2]) / (2.0 * h),
                _ => (3.0 * fine[last] - 4.0 * fine[last - 1] + fine[last - 2]) / (2.0 * h),
            };
            (0..n).map(|k| at(k * FINE)).collect()
        }
    }
}

/// What is looked for in a recording.
struct Wanted<'a> {
    channel: &'a str,
    /// What it is for, in words.
    role: String,
    /// The input or the state which it feeds alone.
    name: Option<&'a str>,
    unit: &'a Unit,
    /// The expression that it measures.
    measured: Option<&'a Expr>,
}

/// Column and unit of a channel.
fn find_channel(
    model: &Model,
    recording: &Recording,
    wanted: Wanted<'_>,
) -> Result<(usize, Unit), DataError> {
    let Wanted { channel, role, name, unit, measured } = wanted;
    let file = recording.name.clone();
    let Some(index) = recording.channels.iter().position(|c| c.name == channel) else {
        let available: Vec<String> = recording.channels.iter().map(|c| format!("`{}`", c.name)).collect();
        return Err(DataError::MissingChannel {
            file,
            channel: channel.to_string(),
            role,
            available: greybox_recording::listed(available),
            help: help(channel, name.map(|name| (name, "")), recording),
        });
    };
    let found = &recording.channels[index];
    if found.values.iter().all(|v| v.is_nan()) {
        return Err(DataError::EmptyChannel { file, channel: channel.to_string() });
    }
    let recorded = recorded_unit(model, found.unit.as_deref(), unit, measured).map_err(|e| {
        DataError::UnreadableUnit { file: file.clone(), channel: channel.to_string(), message: e.to_string() }
    })?;
    if !recorded.dimension.same(&unit.dimension) {
        return Err(DataError::Unit {
            file,
            channel: channel.to_string(),
            found: recorded.text,
            role,
            expected: unit.text.clone(),
        });
    }
    let largest = found.values.iter().map(|v| recorded.to_si(*v).abs()).fold(0.0, f64::max);
    if largest > *SIZES.end() {
        return Err(DataError::OutOfRange { file, channel: channel.to_string(), largest });
    }
    Ok((index, recorded))
}

/// Noise of a channel. Fourth differences are blind where the signal itself is fast (nine samples per
/// period look like noise to them), the floor of the spectrum where the noise is coloured; both are
/// upper bounds of what white noise there is, so the smaller counts, but never less than the
/// quantisation allows.
fn noise_level(y: &[f64]) -> f64 {
    use greybox_recording::noise::{noise_sigma, quantisation_step, spectral_floor_sigma};
    let (differences, floor) = (noise_sigma(y), spectral_floor_sigma(y));
    let rounding = quantisation_step(y).map_or(0.0, |q| q / 12f64.sqrt());
    let least = if floor.is_finite() && floor > 0.0 { differences.min(floor) } else { differences };
    if least.is_nan() { least } else { least.max(rounding) }
}

/// RMS about the mean; exactly zero where nothing moves.
pub fn spread(values: &[f64]) -> f64 {
    // The mean of equal values is not always that value.
    if values.iter().all(|v| *v == values[0]) {
        return 0.0;
    }
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / values.len() as f64).sqrt()
}

/// What the measurements alone say of the states: value, derivative and their standard errors.
#[derive(Debug, Clone)]
pub struct SmoothedStates {
    /// Per piece, per entry of the state vector: the smoothed signal, where a channel measures it.
    pub states: Vec<Vec<Option<Vec<f64>>>>,
    /// Per entry of the state vector: standard deviation to allow a start value.
    pub tolerance: Vec<f64>,
    /// Per piece, per state of the model: smoothed highest derivative where the state is measured.
    pub highest: Vec<Vec<Option<Vec<f64>>>>,
}

impl SmoothedStates {
    /// Smoothed states of every piece: coordinates measured by a channel of their own (q and, from the
    /// same window, q'), and rates measured by one. A coordinate that a channel measures through a reading (q + so) is there
    /// too, at the model's values of the parameters; since those may change it is not known. Where only a late sensor measures a
    /// coordinate, its readings are not shifted in time: [`Setup::start`](crate::Setup::start) does that.
    pub fn new(model: &Model, data: &Data) -> SmoothedStates {
        SmoothedStates::made(model, data, false)
    }

    /// The same where the model's values of the parameters are right: then a reading tells its coordinate, unless it reads two
    /// values as one.
    pub(crate) fn of_known(model: &Model, data: &Data) -> SmoothedStates {
        SmoothedStates::made(model, data, true)
    }

    fn made(model: &Model, data: &Data, readings_are_known: bool) -> SmoothedStates {
        let mut sources: Vec<Option<(usize, usize)>> = Vec::new(); // (channel, derivative)
        let mut highest = Vec::new();
        // By entry: how its coordinate is read, and which entry that is.
        let mut readings: Vec<Option<Reading>> = Vec::new();
        let mut first = Vec::new();
        let prompt = without_delays(model);
        for state in &model.states {
            let channel = |primes| {
                model
                    .measurement_of(&state.name, primes)
                    .or_else(|| prompt.measurement_of(&state.name, primes))
            };
            let (position, rate) = (channel(0), channel(1));
            let reading = match (position, rate) {
                (None, None) => Reading::of(model, &prompt, &state.name),
                _ => None,
            };
            let read = position.or(reading.as_ref().map(|r| r.channel));
            first.extend(vec![readings.len(); state.order]);
            readings.extend(vec![reading; state.order]);
            for i in 0..state.order {
                sources.push(match i {
                    0 => read.map(|c| (c, 0)),
                    1 => rate.map(|c| (c, 0)).or(read.map(|c| (c, 1))),
                    2 => rate.map(|c| (c, 1)).or(read.map(|c| (c, 2))),
                    _ => None,
                });
            }
            highest.push(match state.order {
                1 => position.map(|c| (c, 1)),
                2 => rate.map(|c| (c, 1)).or(position.map(|c| (c, 2))),
                _ => None,
            });
        }
        let pick = |piece: &PieceData, source: &Option<(usize, usize)>, reading: Option<&Reading>| {
            source.map(|(c, d)| {
                let s = &piece.smooth[c];
                match (reading, d) {
                    (Some(reading), d) => reading.undone(s, d),
                    (None, 0) => s.value.clone(),
                    (None, 1) => s.d1.clone(),
                    (None, _) => s.d2.clone(),
                }
            })
        };
        let of_piece = |p: &PieceData| -> Vec<Option<Vec<f64>>> {
            sources.iter().zip(&readings).map(|(s, r)| pick(p, s, r.as_ref())).collect()
        };
        let states: Vec<Vec<Option<Vec<f64>>>> = data.pieces.iter().map(of_piece).collect();
        let tolerance = sources
            .iter()
            .enumerate()
            .map(|(i, source)| match source {
                None => f64::INFINITY,
                Some(_) if readings[i].as_ref().is_some_and(|r| r.is_late || !readings_are_known) => {
                    f64::INFINITY
                }
                Some((c, d)) => {
                    let sigma = data.sigma[*c];
                    let errors: Vec<f64> = data
                        .pieces
                        .iter()
                        .map(|p| match d {
                            0 => p.smooth[*c].value_std_error(sigma),
                            1 => p.smooth[*c].d1_std_error(sigma),
                            _ => f64::INFINITY,
                        })
                        .collect();
                    let bend = data
                        .pieces
                        .iter()
                        .map(|p| if *d == 0 { p.smooth[*c].value_bend } else { p.smooth[*c].d1_bend })
                        .fold(0.0, f64::max);
                    let all = states.iter().filter_map(|s| s[i].as_ref()).flatten();
                    let all: Vec<f64> = all.copied().filter(|v| v.is_finite()).collect();
                    // Ten standard errors: noise of real sensors is coloured, and the estimate of it from
                    // fast differences is too small then; and room for what the smoothing bends, whose
                    // peaks stand well above its RMS.
                    let room = 10.0 * errors.iter().copied().fold(0.0, f64::max) + 5.0 * bend;
                    let slope = readings[i].as_ref().map_or(1.0, |reading| {
                        let slopes = states.iter().map(|s| reading.least_slope(s[first[i]].as_deref()));
                        slopes.fold(f64::INFINITY, f64::min)
                    });
                    room / slope + 1e-3 * spread(&all)
                }
            })
            .collect();
        let highest =
            data.pieces.iter().map(|p| highest.iter().map(|s| pick(p, s, None)).collect()).collect();
        SmoothedStates { states, tolerance, highest }
    }
}

/// How a sensor reads one coordinate, where that is not the coordinate itself: with an offset or a gain, or along a curve.
#[derive(Debug, Clone)]
struct Reading {
    channel: usize,
    /// The coordinate.
    of: String,
    /// It reads where the machine was.
    is_late: bool,
    /// The reading over it, its slope, and the slope of that, with numbers for the parameters.
    law: [Expr; 3],
}

impl Reading {
    /// The first channel that reads this coordinate alone; `prompt` is the model [without delays](without_delays).
    fn of(model: &Model, prompt: &Model, state: &str) -> Option<Reading> {
        let number = |name: &str, primes: u8| {
            let value = model.parameter(name).filter(|_| primes == 0).map(|i| model.parameters[i].value);
            value.map(Expr::Num)
        };
        prompt.measurements.iter().enumerate().find_map(|(channel, measurement)| {
            let law = measurement.expr.substitute(&number);
            let alone = law.variables().iter().all(|(name, primes)| **name == *state && *primes == 0);
            let slope = law.derivative(state, 0).simplify();
            let bend = slope.derivative(state, 0).simplify();
            (alone && law.mentions(state)).then(|| Reading {
                channel,
                of: state.to_string(),
                is_late: *measurement != model.measurements[channel],
                law: [law, slope, bend],
            })
        })
    }

    fn at(&self, derivative: usize, x: f64) -> f64 {
        self.law[derivative].eval(&|name, _| (*name == *self.of).then_some(x)).unwrap_or(f64::NAN)
    }

    /// The coordinate (or its first or second derivative) along a smoothed channel; not a number where no value is read so.
    fn undone(&self, channel: &Smoothed, derivative: usize) -> Vec<f64> {
        const STEPS: usize = 30;
        let inverse = |y: f64| {
            let mut x = y;
            for _ in 0..STEPS {
                let step = (self.at(0, x) - y) / self.at(1, x);
                x -= step;
                if step.abs() <= 1e-12 * (x.abs() + y.abs()) {
                    return x;
                }
            }
            f64::NAN
        };
        let of = |k: usize| {
            let x = inverse(channel.value[k]);
            let slope = self.at(1, x);
            match derivative {
                0 => x,
                1 => channel.d1[k] / slope,
                _ => (channel.d2[k] - self.at(2, x) * (channel.d1[k] / slope).powi(2)) / slope,
            }
        };
        (0..channel.value.len()).map(of).collect()
    }

    /// The least slope within twice the reach of the coordinate; zero where it changes its sign: another value is read the same.
    fn least_slope(&self, coordinate: Option<&[f64]>) -> f64 {
        const POINTS: i32 = 50;
        let finite = coordinate.unwrap_or(&[]).iter().filter(|x| x.is_finite());
        let reach = 2.0 * finite.fold(0.0f64, |m, x| m.max(x.abs()));
        let at = |i: i32| self.at(1, reach * f64::from(i) / f64::from(POINTS));
        let slopes: Vec<f64> = (-POINTS..=POINTS).map(at).collect();
        let is_one_way = slopes.iter().all(|s| *s > 0.0) || slopes.iter().all(|s| *s < 0.0);
        if is_one_way { slopes.iter().fold(f64::INFINITY, |m, s| m.min(s.abs())) } else { 0.0 }
    }
}

/// The model with sensors that are not late.
fn without_delays(model: &Model) -> Model {
    let mut prompt = model.clone();
    for measurement in &mut prompt.measurements {
        measurement.expr = measurement.expr.map(&mut |e| match e {
            Expr::Call(Func::Delay, mut arguments) if !arguments.is_empty() => arguments.swap_remove(0),
            e => e,
        });
    }
    prompt
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_recording::Channel;

    /// A held input keeps its integral, a line stays a line away from its ends, and measured values are those of their samples.
    #[test]
    fn thinned_data_keep_what_drives_the_machine() {
        let model = Model::from_toml(
            "[inputs]\nu = { unit = \"m/s\", hold = \"zero\" }\nw = { unit = \"m/s\", hold = \"linear\" }\n[states]\nx = { unit = \"m\" }\n[equations]\nrate = \"x' = u + w\"\n",
            "rate.toml",
        )
        .unwrap();
        let column = |name: &str, of: fn(f64) -> f64| Channel {
            name: name.into(),
            unit: None,
            values: (0..40).map(|k| of(f64::from(k))).collect(),
        };
        let time = (0..40).map(|k| 0.5 * f64::from(k)).collect();
        let channels = vec![column("u", |k| k * k % 7.0), column("w", |k| 3.0 * k), column("x", f64::sqrt)];
        let recording = Recording::from_columns("rate.csv", time, channels).unwrap();
        let data = Data::new(&model, &[recording]).unwrap();
        let thin = data.thinned(&model, 4);
        let (all, piece) = (&data.pieces[0], &thin.pieces[0]);
        assert_eq!((piece.len, piece.dt, piece.smooth[0].value.len()), (10, 2.0, 10));
        let integral = |u: &[f64], dt: f64| u.iter().sum::<f64>() * dt;
        assert!((integral(&piece.inputs[0], 2.0) - integral(&all.inputs[0], 0.5)).abs() < 1e-12);
        assert!((1..9).all(|k| (piece.inputs[1][k] - all.inputs[1][4 * k]).abs() < 1e-12));
        assert!((0..10).all(|k| piece.measured[0][k] == all.measured[0][4 * k]));
        assert_eq!(thin.sigma, data.sigma);
    }
}
