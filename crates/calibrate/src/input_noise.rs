//! Inputs that were measured: what the noise of their sensor does to the fit.
//!
//! A model takes its inputs as exact. Where an input is a measurement, its noise drives the simulation like a part of the
//! signal, and the fit makes up for it by gains that are too small (errors in variables). How much that is follows from two
//! simulations, with the input and with the input and as much noise again: it matters where they differ by more than the
//! noise of an output.
//!
//! Noise and the fast content of a command look alike. Four things keep commands from being taken for measurements: an input
//! with `hold = "zero"` is one; what is kept for several samples or consists of noise alone is no noisy measurement; the
//! noise of a sensor is as strong at the top of the band as in its middle, while commands fall off; and a simulation that
//! follows the outputs more closely than the noise would let it proves that the noise is not there.

use greybox_model::{Hold, Input, Unit};
use greybox_recording::noise::{
    has_white_floor, median, noise_sigma, quantisation_step, spectral_floor_sigma,
};
use greybox_recording::{Finding, Severity, interpolate};
use greybox_simulate::{Environment, FINE, Seeds, Signal, integrate};
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;
use rand_pcg::Pcg64Mcg;

use crate::data::derivative;
use crate::{FreeRun, PieceData, Setup};

/// Samples of a piece that are simulated.
const MOST: usize = 20_000;
/// Simulations with a noise of their own.
const DRAWS: u64 = 3;
/// Noise of more than this share of an input's spread is its signal.
const SIGNAL: f64 = 0.3;
/// Fewest samples of a piece whose noise is looked at.
const LEAST: usize = 256;
/// So many of its samples are equal to the one before: an input that is kept, or rounded coarsely.
const KEPT: f64 = 0.4;
/// A simulation that leaves less than this part of what the noise would make of it shows that there is none. (A fit takes up
/// some of it, and of a slow answer a recording holds few.)
const REFUTED: f64 = 0.5;
/// The noise explains a good part of what the simulation leaves.
const LARGE: f64 = 0.5;

/// Noise of an input that shows in an output. SI.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InputNoise {
    /// The input; of a channel and its derivative, the channel.
    pub input: usize,
    /// Standard deviation of its noise.
    pub sigma: f64,
    /// Whether that is the rounding of its values.
    pub rounded: bool,
    /// The output where it shows most.
    pub output: usize,
    /// RMS of what it does there.
    pub effect: f64,
    /// Noise of that output.
    pub noise: f64,
    /// RMS of what the simulation leaves there.
    pub residual: f64,
}

/// The inputs whose noise, if they are measurements, shows in an output by more than the noise of that output. `run` is a
/// free run of the model with these parameters.
pub fn input_noise(setup: &Setup, parameters: &[f64], run: &FreeRun) -> Vec<InputNoise> {
    let data = &setup.data;
    let inputs = &setup.model.inputs;
    let mut found = Vec::new();
    for i in 0..inputs.len() {
        // A derivative goes with its channel, where the channel is an input too.
        let base = |j: &usize| inputs[i].derivative_of() == Some(&inputs[*j].channel);
        let commanded = inputs[i].hold == Hold::Zero && inputs[i].derivative_of().is_none();
        if commanded || (0..inputs.len()).any(|j| base(&j)) {
            continue;
        }
        let levels: Vec<Level> = data.pieces.iter().map(|p| level(p, i, &inputs[i])).collect();
        let sigma = median(&levels.iter().map(|l| l.sigma).collect::<Vec<_>>());
        if sigma.is_nan() || sigma <= 0.0 {
            continue;
        }
        let Some(effects) = effects(setup, parameters, run, i, sigma) else { continue };
        let shown = (0..data.channels.len()).filter_map(|c| {
            let (effect, residual) = effects[c];
            let noise = data.sigma[c];
            let shows = effect > noise && residual > REFUTED * effect;
            let rounded = levels.iter().all(|l| l.rounded);
            shows.then_some(InputNoise { input: i, sigma, rounded, output: c, effect, noise, residual })
        });
        found.extend(shown.max_by(|a, b| (a.effect / a.noise).total_cmp(&(b.effect / b.noise))));
    }
    found
}

/// [`input_noise`] in words: for parameters that were fitted, a warning where the noise is a good part of what they leave.
pub fn findings(setup: &Setup, parameters: &[f64], run: &FreeRun, fitted: bool) -> Vec<Finding> {
    input_noise(setup, parameters, run).into_iter().map(|found| finding(setup, &found, fitted)).collect()
}

fn finding(setup: &Setup, found: &InputNoise, fitted: bool) -> Finding {
    let input = &setup.model.inputs[found.input];
    let output = &setup.data.channels[found.output];
    let severity =
        if fitted && found.effect > LARGE * found.residual { Severity::Warning } else { Severity::Info };
    let of = |value: f64, unit: &Unit| match (significant(unit.difference_from_si(value)), &*unit.text) {
        (value, "1") => value,
        (value, unit) => format!("{value} {unit}"),
    };
    let size = of(found.sigma, &input.unit);
    let effect = of(found.effect, &output.unit);
    let message = format!(
        "If this input is a measurement, its {} of {size} moves the simulated `{}` by {effect} RMS, {} times the noise of that \
         channel. Inputs count as exact: gains come out too small, and intervals too narrow.",
        if found.rounded { "rounding" } else { "noise" },
        output.name,
        significant(found.effect / found.noise),
    );
    let help = if found.rounded {
        "Use the commanded value in its place, or a finer sensor."
    } else {
        "Use the commanded value in its place, or filter it forwards and backwards, which adds no lag. If an equation says \
         what drives it, make it a state that this channel measures."
    };
    Finding::new(severity, "input_noise", message)
        .on(&input.channel)
        .help(help)
        .value(input.unit.difference_from_si(found.sigma), Some(&input.unit.text))
}

/// Noise of an input in a piece.
struct Level {
    sigma: f64,
    rounded: bool,
}

/// The noise that an input would have if it were a smooth signal; zero for one that is kept, or that is noise itself.
fn level(piece: &PieceData, input: usize, of: &Input) -> Level {
    let u = &piece.inputs[input];
    let none = Level { sigma: 0.0, rounded: false };
    let spread = crate::spread(u);
    if u.len() < LEAST || spread <= 0.0 || spread.is_nan() {
        return none;
    }
    let moves: Vec<f64> = u.windows(2).map(|w| (w[1] - w[0]).abs()).collect();
    let kept = moves.iter().filter(|d| **d == 0.0).count() as f64 > KEPT * moves.len() as f64;
    let step = quantisation_step(u).unwrap_or(0.0);
    let moved: Vec<f64> = moves.into_iter().filter(|d| *d > 0.5 * step).collect();
    // Levels that somebody set go by several steps at a time, a rounded motion mostly by one.
    let set = kept && median(&moved) > 1.5 * step;
    let rounding = if set { 0.0 } else { step / 12f64.sqrt() };
    let noise = if kept || !has_white_floor(u) { 0.0 } else { noise_sigma(u).min(spectral_floor_sigma(u)) };
    let sigma = noise.max(rounding);
    if sigma.is_nan() || sigma > SIGNAL * spread {
        return none;
    }
    // White noise on a channel whose derivative this is.
    let factor = if of.derivative_of().is_some() { piece.dt * (70f64 / 252.0).sqrt() } else { 1.0 };
    Level { sigma: factor * sigma, rounded: rounding >= noise }
}

/// Per output: RMS of what noise on an input changes, and of what the simulation leaves of the measurements.
fn effects(
    setup: &Setup,
    parameters: &[f64],
    run: &FreeRun,
    input: usize,
    sigma: f64,
) -> Option<Vec<(f64, f64)>> {
    let data = &setup.data;
    let ny = data.channels.len();
    let (mut changed, mut left) = (vec![(0.0, 0usize); ny], vec![(0.0, 0usize); ny]);
    for (p, piece) in data.pieces.iter().enumerate() {
        let n = piece.len.min(MOST).min(run.lengths[p]);
        if n < 2 {
            continue;
        }
        for (c, left) in left.iter_mut().enumerate() {
            for (m, y) in piece.measured[c].iter().zip(&run.y[p][c * piece.len..]).take(n) {
                if !m.is_nan() {
                    *left = (left.0 + (m - y).powi(2), left.1 + 1);
                }
            }
        }
        // Again, in the same steps: what these leave out is then the same in both.
        let simulated = |environment: &Environment| {
            let (start, seeds) = (&run.starts[p], Seeds::default());
            integrate(&setup.system, environment, parameters, start, 0..n, setup.method, &seeds)
        };
        let plain = simulated(&setup.environments[p]);
        for draw in 0..DRAWS {
            let noise = white(draw * data.pieces.len() as u64 + p as u64, piece.len, sigma);
            let environment = disturbed(setup, p, input, &noise);
            let other = simulated(&environment);
            let reached = plain.diverged.unwrap_or(n).min(other.diverged.unwrap_or(n));
            for (c, changed) in changed.iter_mut().enumerate() {
                for k in 0..reached {
                    let change = other.y[c * n + k] - plain.y[c * n + k];
                    *changed = (changed.0 + change * change, changed.1 + 1);
                }
            }
        }
    }
    let rms = |(sum, count): (f64, usize)| (sum / count as f64).sqrt();
    let both: Vec<(f64, f64)> = changed.into_iter().zip(left).map(|(c, l)| (rms(c), rms(l))).collect();
    both.iter().any(|(effect, _)| effect.is_finite()).then_some(both)
}

/// A piece with noise on an input, and on the input that is its derivative.
fn disturbed(setup: &Setup, piece: usize, input: usize, noise: &[f64]) -> Environment {
    let data = &setup.data.pieces[piece];
    let inputs = &setup.model.inputs;
    let mut environment = setup.environments[piece].clone();
    for (j, other) in inputs.iter().enumerate() {
        let hold = setup.holds[j];
        let is_its_derivative = other.derivative_of() == Some(&inputs[input].channel);
        let own = j == input && other.derivative_of().is_some();
        let change = if is_its_derivative || own {
            derivative(noise, data.dt, if hold == Hold::BandLimited { Hold::Linear } else { hold })
        } else if j == input || other.channel == inputs[input].channel {
            noise.to_vec()
        } else {
            continue;
        };
        let samples: Vec<f64> = data.inputs[j].iter().zip(&change).map(|(u, e)| u + e).collect();
        environment.inputs[j] =
            Signal::new(hold, data.dt, &samples, |u| interpolate::upsample_band_limited(u, FINE));
    }
    environment
}

/// Two significant digits.
fn significant(value: f64) -> String {
    let short = format!("{value:.1e}");
    match short.parse::<f64>() {
        Ok(v) if (1e-4..1e6).contains(&v.abs()) => v.to_string(),
        _ => short,
    }
}

/// White noise, the same for the same seed.
fn white(seed: u64, n: usize, sigma: f64) -> Vec<f64> {
    let random = Pcg64Mcg::seed_from_u64(seed);
    random.sample_iter(StandardNormal).take(n).map(|e: f64| sigma * e).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_its_size_and_repeats() {
        let e = white(7, 20_000, 0.5);
        assert!((crate::spread(&e) / 0.5 - 1.0).abs() < 0.02);
        assert!(e == white(7, 20_000, 0.5) && e != white(8, 20_000, 0.5));
    }
}
