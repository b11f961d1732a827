//! Is this recording good enough to find anything in it? Checks with plain answers.
//!
//! Each check is a small function over the samples of the longest piece (the counts over all pieces); [`check`]
//! runs them all. The limits are set so that a sound recording yields only [`Severity::Info`].

use crate::finding::{self, Finding, Severity, number, quantity};
use crate::interpolate::fill_missing;
use crate::median::median;
use crate::noise::{finite_range, noise_sigma, quantisation_step, recording_sigma, spectral_floor_sigma};
use crate::recording::{Channel, Recording};
use crate::spectrum::{Periodogram, correlation, periodogram, whiten};

/// What a channel is to the experiment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Input,
    Output,
    Unknown,
}

/// Everything that can be said about the health of a recording, whole-recording findings first, then channel by
/// channel, then the delays between inputs and outputs.
///
/// `inputs` and `outputs` name channels; a channel in neither list is checked as far as that goes without
/// knowing its role. A name that the recording does not have is reported as a [`Severity::Problem`].
pub fn check(recording: &Recording, inputs: &[&str], outputs: &[&str]) -> Vec<Finding> {
    let mut findings = vec![sampling(recording)];
    findings.extend(recording.warnings.iter().cloned());
    findings.extend(unknown_channels(recording, inputs, outputs));
    let moves = |name: &&str| recording.channel(name).is_some_and(|c| range_of_motion(&c.values).is_some());
    let driven = inputs.iter().any(moves);
    for (c, channel) in recording.channels.iter().enumerate() {
        let role = match (inputs.contains(&channel.name.as_str()), outputs.contains(&channel.name.as_str())) {
            (true, false) => Role::Input,
            (false, true) => Role::Output,
            _ => Role::Unknown,
        };
        findings.extend(check_channel(recording, c, role, driven));
    }
    for input in inputs {
        for output in outputs {
            findings.extend(delay(recording, input, output));
        }
    }
    findings
}

/// `driven`: some input of the recording moves.
fn check_channel(recording: &Recording, c: usize, role: Role, driven: bool) -> Vec<Finding> {
    let channel = &recording.channels[c];
    let present: Vec<f64> = channel.values.iter().copied().filter(|v| !v.is_nan()).collect();
    // What is missing between the samples of a clock of its own is reported there.
    let own_clock =
        |warning: &Finding| warning.code == "clocks" && warning.channel.as_ref() == Some(&channel.name);
    let reported = !present.is_empty() && recording.warnings.iter().any(own_clock);
    let mut findings: Vec<Finding> = match reported {
        true => Vec::new(),
        false => missing(channel, &recording.time).into_iter().collect(),
    };
    if present.is_empty() {
        return findings;
    }
    if let Some(found) = flat(channel, &present, role, driven) {
        findings.push(found);
        return findings;
    }
    let sigma = recording_sigma(recording, c);
    let pieces: Vec<&[f64]> = recording.pieces.iter().map(|piece| piece.columns[c].as_slice()).collect();
    let longest = pieces.iter().copied().max_by_key(|y| y.len()).unwrap_or(&[]);
    let clipped = clipping(channel, longest);
    let rails: Vec<f64> = clipped.iter().filter_map(|finding| finding.value).collect();
    findings.extend(clipped);
    // Levels that somebody set, and pulses between them, are what was commanded.
    if role == Role::Output || !is_set_level_by_level(longest) {
        findings.extend(quantisation(channel, longest));
        findings.extend(stands_out(recording, c, &rails));
    }
    let full = fill_missing(longest);
    if full.len() < 16 || finite_range(&full).is_none_or(|(low, high)| low == high) {
        return findings;
    }
    let spectrum = periodogram(&full, recording.dt());
    if role == Role::Input {
        findings.push(excitation(channel, &present, &spectrum));
    } else {
        findings.extend(noise_level(channel, &present, &full, sigma));
        findings.extend(bandwidth(channel, &spectrum, recording.dt()));
        findings.extend(record_length(channel, &full, &spectrum));
    }
    findings
}

fn sampling(recording: &Recording) -> Finding {
    let dt = recording.dt();
    let used: usize = recording.pieces.iter().map(|piece| piece.len).sum();
    let pieces = match recording.pieces.len() {
        1 => String::new(),
        count => format!(" in {count} pieces"),
    };
    Finding::new(
        Severity::Info,
        "sampling",
        format!(
            "{used} samples{pieces} every {} s ({} Hz), {} s in all.",
            number(dt),
            number(1.0 / dt),
            number(recording.duration())
        ),
    )
    .value(1.0 / dt, Some("Hz"))
}

fn unknown_channels(recording: &Recording, inputs: &[&str], outputs: &[&str]) -> Vec<Finding> {
    let known = finding::listed(recording.channels.iter().map(|channel| channel.name.clone()).collect());
    let absent = inputs.iter().chain(outputs).filter(|name| recording.channel(name).is_none());
    absent
        .map(|name| {
            Finding::new(
                Severity::Problem,
                "unknown_channel",
                format!("{} has no channel of this name.", recording.name),
            )
            .on(name)
            .help(format!("Its channels are {known}."))
        })
        .collect()
}

fn missing(channel: &Channel, time: &[f64]) -> Option<Finding> {
    let count = channel.values.iter().filter(|v| v.is_nan()).count();
    let first = channel.values.iter().position(|v| v.is_nan())?;
    let rows = channel.values.len();
    let share = 100.0 * count as f64 / rows as f64;
    let (severity, message) = if count == rows {
        (Severity::Problem, "No sample at all: every cell is empty.".to_owned())
    } else {
        let severity = if share > 20.0 { Severity::Warning } else { Severity::Info };
        let message = format!(
            "{count} of {rows} samples are missing ({} %), the first at t = {} s; they are left out of every fit.",
            number(share),
            number(time[first])
        );
        (severity, message)
    };
    Some(Finding::new(severity, "missing", message).on(&channel.name).value(count as f64, None))
}

/// Smallest and largest value of a channel that moves.
fn range_of_motion(values: &[f64]) -> Option<(f64, f64)> {
    finite_range(values).filter(|(low, high)| high - low > 1e-12 * low.abs().max(high.abs()))
}

fn flat(channel: &Channel, present: &[f64], role: Role, driven: bool) -> Option<Finding> {
    let (low, _) = finite_range(present)?;
    if range_of_motion(present).is_some() {
        return None;
    }
    let value = quantity(low, channel.unit.as_deref());
    let finding = match role {
        Role::Input if driven => Finding::new(
            Severity::Info,
            "constant_input",
            format!(
                "The input is a known constant here ({value}): what it multiplies cannot be told from a parameter by \
                 this recording alone."
            ),
        )
        .help("If its effect matters, add a recording in which it has another value."),
        Role::Input => Finding::new(
            Severity::Warning,
            "excitation",
            format!(
                "The input is constant ({value}): nothing that depends on it can be told apart from a constant \
                 offset."
            ),
        )
        .help("Move the input: steps of several sizes, a sweep or a multisine over the working range."),
        Role::Output => {
            Finding::new(Severity::Problem, "flat", format!("The channel never moves (always {value})."))
                .help("Check that the sensor was connected and that the right column was exported.")
        }
        Role::Unknown => {
            Finding::new(Severity::Warning, "flat", format!("The channel never moves (always {value})."))
        }
    };
    Some(finding.on(&channel.name).value(low, channel.unit.as_deref()))
}

/// Value and length of a run of equal neighbouring samples.
type Run = (f64, usize);

/// The runs of equal neighbouring samples.
fn runs(y: &[f64], tolerance: f64) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for &v in y.iter().filter(|v| !v.is_nan()) {
        match runs.last_mut() {
            Some((value, length)) if (v - *value).abs() <= tolerance => *length += 1,
            _ => runs.push((v, 1)),
        }
    }
    runs
}

/// Clipping: the signal stands at its extreme again and again, longer than a turning point would.
///
/// Near a smooth turning point the time within w of the extreme grows as √w, so that the extreme level of a
/// quantised signal holds at most 1/(√5 − 1) ≈ 0.8 times as many samples as the next four levels together; a
/// clipped one holds many times as many. Asked for are twice as many, in two runs of three samples or more, and
/// runs three times as long as elsewhere (which spares staircases). Signals of a few levels (switches) and a
/// rest at zero are not clipping.
fn clipping(channel: &Channel, y: &[f64]) -> Vec<Finding> {
    let Some((low, high)) = finite_range(y) else { return Vec::new() };
    let tolerance = 1e-9 * (high - low);
    let runs = runs(y, tolerance);
    let total: usize = runs.iter().map(|run| run.1).sum();
    let mut levels: Vec<f64> = runs.iter().map(|run| run.0).collect();
    levels.sort_unstable_by(f64::total_cmp);
    levels.dedup_by(|a, b| (*a - *b).abs() <= tolerance);
    if levels.len() < 12 {
        return Vec::new();
    }
    let level_step = quantisation_step(y).unwrap_or(0.0).max(1e-4 * (high - low));
    let mean_length =
        |runs: &[&Run]| runs.iter().map(|run| run.1).sum::<usize>() as f64 / runs.len().max(1) as f64;
    let mut findings = Vec::new();
    for (extreme, which) in [(low, "smallest"), (high, "largest")] {
        let (at, elsewhere): (Vec<&Run>, Vec<&Run>) =
            runs.iter().partition(|run| (run.0 - extreme).abs() <= tolerance);
        let held: usize = at.iter().map(|run| run.1).sum();
        let beside: usize =
            elsewhere.iter().filter(|run| (run.0 - extreme).abs() < 4.5 * level_step).map(|run| run.1).sum();
        let plateaus = at.iter().filter(|run| run.1 >= 3).count();
        let clipped = plateaus >= 2
            && held > 2 * beside
            && mean_length(&at) > 3.0 * mean_length(&elsewhere)
            && extreme != 0.0;
        if clipped {
            let unit = channel.unit.as_deref();
            findings.push(
                Finding::new(
                    Severity::Warning,
                    "clipping",
                    format!(
                        "The signal stands still at its {which} value {} in {plateaus} places ({} % of the \
                         samples): it looks clipped there.",
                        quantity(extreme, unit),
                        number(100.0 * held as f64 / total as f64)
                    ),
                )
                .help("Widen the sensor or amplifier range, or model the limit (input_saturation, end_stop).")
                .on(&channel.name)
                .value(extreme, unit),
            );
        }
    }
    findings
}

/// Whether a signal stands still most of the time and then jumps, mostly over several of its steps: levels that
/// somebody set, no rounded motion, which goes from one step to the next.
fn is_set_level_by_level(y: &[f64]) -> bool {
    let Some(q) = quantisation_step(y) else { return false };
    let moves: Vec<f64> = y.windows(2).map(|w| (w[1] - w[0]).abs()).filter(|d| *d > 0.5 * q).collect();
    5 * moves.len() < y.len() && median(&moves) > 1.5 * q
}

fn quantisation(channel: &Channel, y: &[f64]) -> Option<Finding> {
    let q = quantisation_step(y)?;
    let noise = noise_sigma(y);
    let (low, high) = finite_range(y)?;
    let unit = channel.unit.as_deref();
    let coarse = (high - low) / q;
    // Below this the rounding drowns in the noise and no reader needs to know.
    if q < 0.5 * noise {
        return None;
    }
    let (severity, help) = if coarse < 50.0 {
        (
            Severity::Warning,
            Some("Use a finer sensor or amplifier range: fewer than 50 steps span the motion."),
        )
    } else {
        (Severity::Info, None)
    };
    let mut finding = Finding::new(
        severity,
        "quantisation",
        format!(
            "The values come in steps of {} ({} steps over the range); that rounding is counted as noise of {}.",
            quantity(q, unit),
            number(coarse.round()),
            quantity(q / 12f64.sqrt(), unit)
        ),
    )
    .on(&channel.name)
    .value(q, unit);
    finding.help = help.map(str::to_owned);
    Some(finding)
}

/// Rows of a channel that stand out of their neighbours on either side, away from the values at which the signal is clipped: single
/// faults of a measurement, by no model but a polynomial of a few samples. None near a gap or the ends of the recording.
///
/// ```
/// use greybox_recording::{Channel, Recording, health};
/// let time: Vec<f64> = (0..200).map(|k| 0.01 * f64::from(k)).collect();
/// let mut values: Vec<f64> = (0..200).map(|k| (0.1 * f64::from(k)).sin() + 1e-3 * f64::from(k * k * 7919 % 101)).collect();
/// values[120] = 25.0;
/// let channel = Channel { name: "x".into(), unit: None, values };
/// let log = Recording::from_columns("log.csv", time, vec![channel])?;
/// assert_eq!(health::outliers(&log, 0), [120]);
/// # Ok::<(), greybox_recording::RecordingError>(())
/// ```
pub fn outliers(recording: &Recording, channel: usize) -> Vec<usize> {
    let Some(channel) = recording.channels.get(channel) else { return Vec::new() };
    let rows = recording.pieces.iter().map(|piece| piece.rows.clone());
    rows.flat_map(|rows| {
        let values = &channel.values[rows.clone()];
        let rails: Vec<f64> = clipping(channel, values).iter().filter_map(|finding| finding.value).collect();
        crate::outliers::outliers(values, &rails).into_iter().map(move |k| rows.start + k)
    })
    .collect()
}

/// Single samples that stand out of their neighbours, away from the values at which the signal is clipped.
fn stands_out(recording: &Recording, c: usize, rails: &[f64]) -> Option<Finding> {
    let (mut count, mut first) = (0usize, None);
    for piece in &recording.pieces {
        for k in crate::outliers::outliers(&piece.columns[c], rails) {
            count += 1;
            first.get_or_insert(recording.time[0] + piece.time(k));
        }
    }
    let first = first?;
    Some(
        Finding::new(
            Severity::Warning,
            "outliers",
            format!(
                "{} from {} neighbours by far more than the noise, the first at t = {} s.",
                if count == 1 {
                    "One sample stands out".to_owned()
                } else {
                    format!("{count} samples stand out")
                },
                if count == 1 { "its" } else { "their" },
                number(first)
            ),
        )
        .help("Look at these samples; empty their cells if they are faults of the measurement.")
        .on(&recording.channels[c].name)
        .value(count as f64, None),
    )
}

fn rms_about_mean(present: &[f64]) -> f64 {
    let n = present.len() as f64;
    let mean = present.iter().sum::<f64>() / n;
    (present.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / n).sqrt()
}

fn excitation(channel: &Channel, present: &[f64], spectrum: &Periodogram) -> Finding {
    let unit = channel.unit.as_deref();
    let rms = rms_about_mean(present);
    let peak = spectrum.strongest();
    let size = format!("RMS {} about its mean", quantity(rms, unit));
    if peak >= 3 && spectrum.share(peak.saturating_sub(2), peak + 2) > 0.99 {
        return Finding::new(
            Severity::Warning,
            "excitation",
            format!(
                "The input is practically a single sine of {} Hz ({size}): one frequency fixes two parameters, and a mechanism \
                 can hide behind a wrong one.",
                number(peak as f64 * spectrum.resolution)
            ),
        )
        .help("Add frequencies and amplitudes: a sweep, a multisine, or steps of several sizes.")
        .on(&channel.name)
        .value(1.0, None);
    }
    let lines = spectrum.significant_lines();
    let (severity, help) = if lines < 3 {
        (
            Severity::Warning,
            Some("Add frequencies: a sweep, a multisine, or steps of several sizes.".to_owned()),
        )
    } else {
        (Severity::Info, None)
    };
    let richness = match lines {
        50.. => "power in more than 50 spectral lines: it excites richly".to_owned(),
        _ => format!(
            "the power of about {lines} sines, enough for about {} parameters of a linear model",
            2 * lines
        ),
    };
    let mut finding = Finding::new(
        severity,
        "excitation",
        format!(
            "The input has {size}, 95 % of its power below {} Hz and {richness}.",
            number(spectrum.frequency_below(0.95))
        ),
    )
    .on(&channel.name)
    .value(lines as f64, None);
    finding.help = help;
    finding
}

fn noise_level(channel: &Channel, present: &[f64], full: &[f64], sigma: f64) -> Option<Finding> {
    let rms = rms_about_mean(present);
    if sigma.is_nan() || rms <= 0.0 {
        return None;
    }
    let ratio = sigma / rms;
    let unit = channel.unit.as_deref();
    let level = format!("{} ({} % of the signal's RMS)", quantity(sigma, unit), number(100.0 * ratio));
    let floor = spectral_floor_sigma(full);
    let finding = if sigma > 1.5 * floor {
        Finding::new(
            Severity::Info,
            "noise",
            format!(
                "The measurement noise is at most {level}; part of that is fast motion or coloured noise, since the \
                 floor of the spectrum is {}.",
                quantity(floor, unit)
            ),
        )
    } else if ratio > 0.3 {
        Finding::new(Severity::Warning, "noise", format!("The measurement noise is about {level}: much."))
            .help("Excite harder, average the sensor, or record for longer.")
    } else {
        Finding::new(Severity::Info, "noise", format!("The measurement noise is about {level}."))
    };
    Some(finding.on(&channel.name).value(sigma, unit))
}

fn bandwidth(channel: &Channel, spectrum: &Periodogram, dt: f64) -> Option<Finding> {
    let top = spectrum.frequency_below(0.95);
    let per_period = 1.0 / (top * dt);
    (per_period < 5.0).then(|| {
        Finding::new(
            Severity::Warning,
            "bandwidth",
            format!(
                "The fastest motion has only {} samples per period (95 % of the power lies below {} Hz, the \
                 sampling allows {} Hz): what the input does between samples matters.",
                number(per_period),
                number(top),
                number(0.5 / dt)
            ),
        )
        .help("Sample at least ten times per period, or state the input's true `hold` in the model.")
        .on(&channel.name)
        .value(per_period, None)
    })
}

fn record_length(channel: &Channel, full: &[f64], spectrum: &Periodogram) -> Option<Finding> {
    let slow = spectrum.share(1, 2);
    let (start, end) = (full[0], full[full.len() - 1]);
    let (low, high) = finite_range(full)?;
    if slow < 0.5 {
        return None;
    }
    let share = number(100.0 * slow);
    let finding = if (end - start).abs() > 0.7 * (high - low) {
        let message = format!(
            "The signal travels once through its range in the whole recording ({share} % of its power): slow \
             effects cannot be told from that travel."
        );
        Finding::new(Severity::Info, "record_length", message)
    } else {
        let message = format!(
            "{share} % of the motion is slower than half the recording ({} s): its slowest part is seen about once.",
            number(0.5 / spectrum.resolution)
        );
        Finding::new(Severity::Warning, "record_length", message)
            .help("Record for longer, or use several recordings, if slow effects (drift, leakage) matter.")
    };
    Some(finding.on(&channel.name).value(100.0 * slow, Some("%")))
}

/// Correlations larger than this multiple of [`chance`] are none.
const BEYOND: f64 = 6.0;

/// How one channel follows another.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lag {
    /// Samples by which the second follows the first.
    samples: isize,
    /// Correlation of the whitened signals at that lag.
    correlation: f64,
}

/// Correlation of two signals (no missing samples), both differenced and whitened (autoregression), at lags from as many
/// samples below zero as above.
fn whitened_correlation(u: &[f64], y: &[f64]) -> Option<Vec<f64>> {
    let n = u.len();
    if n < 64 {
        return None;
    }
    let order = (n / 20).min(32);
    Some(correlation(&whiten(u, order)?, &whiten(y, order)?, (n / 4).min(2000)))
}

/// What a correlation is where there is none: the robust standard deviation over all lags.
fn chance(correlation: &[f64]) -> f64 {
    1.4826 * median(&correlation.iter().map(|v| v.abs()).collect::<Vec<_>>())
}

/// Lag of the largest [`whitened_correlation`]. A minimum-phase plant vanishes in the whitening, so that a pure delay is
/// what is left.
fn lag(u: &[f64], y: &[f64]) -> Option<Lag> {
    peak(u, y, (8.0 / (u.len() as f64).sqrt()).max(0.3))
}

/// Lag of the largest [`whitened_correlation`], where that is at least so large and beyond [`chance`].
fn peak(u: &[f64], y: &[f64], least: f64) -> Option<Lag> {
    let c = whitened_correlation(u, y)?;
    let reach = c.len() / 2;
    let size = |k: usize| c[k].abs();
    let largest = (0..c.len()).map(size).fold(0.0, f64::max);
    // A periodic input repeats the peak every period: of nearly equal peaks, the one closest to no lag.
    let best = (0..c.len()).filter(|&k| size(k) >= 0.95 * largest).min_by_key(|k| k.abs_diff(reach))?;
    if largest.is_nan() || largest < least || largest < BEYOND * chance(&c) {
        return None;
    }
    Some(Lag { samples: best as isize - reach as isize, correlation: c[best] })
}

/// The [`lag`] from an input to an output in the longest piece, in words.
fn delay(recording: &Recording, input: &str, output: &str) -> Option<Finding> {
    let piece = recording.longest_piece()?;
    let (i, o) = (recording.channel_index(input)?, recording.channel_index(output)?);
    if i == o {
        return None;
    }
    let Lag { samples, correlation } =
        lag(&fill_missing(&piece.columns[i]), &fill_missing(&piece.columns[o]))?;
    let seconds = samples as f64 * piece.dt;
    let sense = match samples {
        0 => format!("The output answers `{input}` within one sample"),
        1.. => format!("The output follows `{input}` after about {}", counted(samples, piece.dt)),
        _ => format!(
            "The output runs ahead of `{input}` by about {}, as behind a feedback loop or with clocks that disagree",
            counted(-samples, piece.dt)
        ),
    };
    Some(
        Finding::new(
            Severity::Info,
            "delay",
            format!("{sense} (correlation {} of the whitened signals).", number(correlation)),
        )
        .on(output)
        .value(seconds, Some("s")),
    )
}

/// `3 samples (0.03 s)`.
fn counted(samples: isize, dt: f64) -> String {
    let seconds = number(samples as f64 * dt);
    if samples == 1 { format!("1 sample ({seconds} s)") } else { format!("{samples} samples ({seconds} s)") }
}

/// The [`lag`], also where noise drowns it in the single samples: of these, of averages of two, four and eight. With it
/// the samples by which it may be wrong: that of averages is looked for again among the single samples nearby.
fn averaged_lag(a: &[f64], b: &[f64], lag: impl Fn(&[f64], &[f64]) -> Option<Lag>) -> Option<(Lag, isize)> {
    let average = |y: &[f64], count: usize| -> Vec<f64> {
        y.chunks_exact(count).map(|y| y.iter().sum::<f64>() / count as f64).collect()
    };
    let (count, rough) = [1, 2, 4, 8]
        .into_iter()
        .find_map(|count| Some((count, lag(&average(a, count), &average(b, count))?)))?;
    let width = count as isize;
    let near = rough.samples * width;
    let fine = whitened_correlation(a, b).and_then(|c| {
        let reach = (c.len() / 2) as isize;
        let size = |samples: &isize| c.get((samples + reach) as usize).map_or(0.0, |v| v.abs());
        let nearby = near - width..=near + width;
        nearby.max_by(|x, y| size(x).total_cmp(&size(y))).filter(|best| size(best) > BEYOND * chance(&c))
    });
    Some(match fine {
        Some(samples) => (Lag { samples, ..rough }, 1),
        None => (Lag { samples: near, ..rough }, width),
    })
}

/// Smallest offset that is reported, in samples (or times what the lag may be wrong by): what one sample more or less is may
/// be the sampling alone.
const LEAST_OFFSET: isize = 2;

/// Parts of a recording that are asked one by one, and fewest samples of one.
const PARTS: usize = 8;
const PART: usize = 256;

/// A channel that seems late, and by how much.
#[derive(Debug, Clone, Copy)]
struct Offset {
    /// Positions of the channels; the second is the later one.
    pair: [usize; 2],
    /// How far it is behind; at least [`LEAST_OFFSET`].
    lag: Lag,
    /// Samples by which that may be wrong.
    within: isize,
    /// Parts of the recording that say so, and those that can tell.
    parts: [usize; 2],
}

/// Most pairs of channels whose clocks are compared.
const MOST_PAIRS: usize = 2000;

/// Channels that were recorded later than others by a constant number of samples, as by another logger.
///
/// Asked is every pair of outputs, and every output that runs ahead of an input; with no roles stated, every pair. Of two
/// channels that move with one cause, what is left after whitening must meet at the same sample. It is reported where the
/// longest piece shows a lag of two samples or more and three of four of its parts, asked one by one, show the same within
/// a sample (some samples, where only averages of a few samples stand out of the noise): an offset is constant, and an accident is not. A sensor's own delay looks the same, and with no roles
/// stated so does an input with a late answer: then it is no more than information.
pub fn clock_offsets(recording: &Recording, inputs: &[&str], outputs: &[&str]) -> Vec<Finding> {
    let Some(piece) = recording.longest_piece() else { return Vec::new() };
    let columns: Vec<Vec<f64>> = piece.columns.iter().map(|column| fill_missing(column)).collect();
    let is = |names: &[&str], c: usize| names.contains(&recording.channels[c].name.as_str());
    let roles = !inputs.is_empty() && !outputs.is_empty();
    let (driven, measured): (Vec<bool>, Vec<bool>) =
        (0..columns.len()).map(|c| (is(inputs, c), is(outputs, c))).unzip();
    let asked = |&(a, b): &(usize, usize)| {
        let known = [a, b].iter().all(|&c| driven[c] || measured[c]);
        (!roles || known) && !(driven[a] && driven[b])
    };
    let pairs = (0..columns.len()).flat_map(|a| (a + 1..columns.len()).map(move |b| (a, b)));
    let mut pairs = pairs.filter(asked);
    // That an output comes after its input is what outputs do.
    let mut offsets: Vec<Offset> = pairs
        .by_ref()
        .take(MOST_PAIRS)
        .filter_map(|(a, b)| offset(&columns, a, b))
        .filter(|offset| !(roles && driven[offset.pair[0]]))
        .collect();
    let mut findings = Vec::new();
    if pairs.next().is_some() {
        findings.push(
            Finding::new(
                Severity::Info,
                "clock_offset_limit",
                format!("Only the first {MOST_PAIRS} pairs of channels were compared to find clocks that disagree."),
            )
            .help("State the channels that count: by a model, or in a file with fewer columns."),
        );
    }
    while let Some(late) = odd_one(&offsets, columns.len()) {
        let against = offsets.iter().filter(|o| o.pair.contains(&late));
        let Some(strongest) =
            against.max_by(|a, b| a.lag.correlation.abs().total_cmp(&b.lag.correlation.abs())).copied()
        else {
            break;
        };
        let finding = clocks_differ(recording, &strongest, piece.dt, roles && is(inputs, strongest.pair[1]));
        // Without roles it may be an input and its answer.
        let severity = if roles { Severity::Warning } else { Severity::Info };
        findings.push(Finding { severity, ..finding });
        offsets.retain(|o| !o.pair.contains(&late));
    }
    findings
}

/// The offset between two columns, where the data tell it.
fn offset(columns: &[Vec<f64>], a: usize, b: usize) -> Option<Offset> {
    let (whole, within) = averaged_lag(&columns[a], &columns[b], lag)?;
    if whole.samples.abs() < LEAST_OFFSET * within {
        return None;
    }
    let length = (columns[a].len() / PARTS).max(PART).max(4 * whole.samples.unsigned_abs());
    let (mut agree, mut tell) = (0, 0);
    for (a, b) in columns[a].chunks_exact(length).zip(columns[b].chunks_exact(length)) {
        // That parts agree tells more than how large the correlation is in each.
        if let Some((part, also)) = averaged_lag(a, b, |a, b| peak(a, b, 0.0)) {
            tell += 1;
            agree += usize::from((part.samples - whole.samples).abs() <= within.max(also));
        }
    }
    if tell < 2 || 4 * agree < 3 * tell {
        return None;
    }
    let (pair, samples) = if whole.samples > 0 { ([a, b], whole.samples) } else { ([b, a], -whole.samples) };
    Some(Offset { pair, lag: Lag { samples, ..whole }, within, parts: [agree, tell] })
}

/// The channel in most of the offsets; of two such, the later one.
fn odd_one(offsets: &[Offset], channels: usize) -> Option<usize> {
    let times = |c: usize| {
        let pairs = offsets.iter().filter(|o| o.pair.contains(&c)).count();
        (pairs, offsets.iter().filter(|o| o.pair[1] == c).count())
    };
    (0..channels).max_by_key(|&c| times(c)).filter(|&c| times(c).0 > 0)
}

/// That the clocks of two channels differ by this offset.
fn clocks_differ(recording: &Recording, offset: &Offset, dt: f64, acausal: bool) -> Finding {
    let [early, late] = offset.pair.map(|c| recording.channels[c].name.as_str());
    let Lag { samples, correlation } = offset.lag;
    let [agree, tell] = offset.parts;
    let sure = match (agree == tell, tell >= 4) {
        (true, true) => "sure",
        (true, false) => "likely",
        (false, _) => "probable",
    };
    let cause = match acausal {
        true => format!(
            "`{early}` cannot answer before its cause: unless `{late}` is computed from it (feedback), their clocks disagree"
        ),
        false => {
            "as with the clock of another logger, or a delay of its sensor or of the motion itself".to_owned()
        }
    };
    Finding::new(
        Severity::Warning,
        "clock_offset",
        format!(
            "Recorded {} {} later than `{early}`: {cause}. The lag is {sure}: {agree} of {tell} parts of the recording \
             that can tell show the same within {} (correlation {} of the whitened signals).",
            // What the motion itself takes hides as much of it.
            if acausal { "at least" } else { "about" },
            counted(samples, dt),
            counted(offset.within, dt),
            number(correlation)
        ),
    )
    .help(format!(
        "If the machine does not explain it, move the column `{late}` up by {samples} rows, or record all channels with one clock."
    ))
    .on(late)
    .value(samples as f64 * dt, Some("s"))
}
