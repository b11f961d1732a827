//! Inputs and references of the experiments.

use std::f64::consts::TAU;

use rand::RngExt;
use rand_pcg::Pcg64Mcg;

/// Shape of an excitation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// Sines of random phases.
    Multisine,
    /// One sine of rising frequency, back and forth.
    Sweep,
    /// Levels held for a while, with ramps in between.
    Steps,
}

impl Shape {
    /// One of them, half of the time a multisine.
    pub fn draw(rng: &mut Pcg64Mcg) -> Shape {
        [Shape::Multisine, Shape::Multisine, Shape::Sweep, Shape::Steps][rng.random_range(0..4)]
    }

    /// `samples` values of zero mean and unit RMS, `dt` apart, at frequencies around `f`, Hz.
    pub fn draw_signal(self, samples: usize, dt: f64, f: f64, rng: &mut Pcg64Mcg) -> Vec<f64> {
        let time = (0..samples).map(|k| k as f64 * dt);
        let mut signal: Vec<f64> = match self {
            Shape::Multisine => {
                let lines = rng.random_range(14..32);
                let sines: Vec<[f64; 3]> = (0..lines)
                    .map(|i| {
                        let ratio = (i as f64 + rng.random_range(0.0..1.0)) / lines as f64;
                        // From a tenth of f to two and a half times f, evenly by octaves.
                        [0.1 * 25f64.powf(ratio) * f, rng.random_range(0.0..TAU), rng.random_range(0.6..1.4)]
                    })
                    .collect();
                time.map(|t| sines.iter().map(|[f, phase, a]| a * (TAU * f * t + phase).sin()).sum())
                    .collect()
            }
            Shape::Sweep => {
                let length = samples as f64 * dt;
                let period = length / f64::from(rng.random_range(2..5));
                let (low, high) = (0.15 * f, rng.random_range(1.8..3.0) * f);
                let mut phase = rng.random_range(0.0..TAU);
                time.map(|t| {
                    let saw = 1.0 - (2.0 * (t / period).fract() - 1.0).abs();
                    phase += TAU * dt * low * (high / low).powf(saw);
                    phase.sin()
                })
                .collect()
            }
            Shape::Steps => {
                let mut out = Vec::with_capacity(samples);
                let mut level = 0.0;
                let mut sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                while out.len() < samples {
                    let next: f64 = sign * rng.random_range(0.3..1.5);
                    sign = -sign;
                    let ramp = (rng.random_range(0.08..0.4) / (f * dt)).ceil().max(2.0) as usize;
                    let hold = (rng.random_range(0.2..1.6) / (f * dt)).ceil() as usize;
                    out.extend((0..ramp).map(|i| level + (next - level) * i as f64 / ramp as f64));
                    out.extend(std::iter::repeat_n(next, hold));
                    level = next;
                }
                out.truncate(samples);
                out
            }
        };
        let mean = signal.iter().sum::<f64>() / samples as f64;
        signal.iter_mut().for_each(|x| *x -= mean);
        let rms = rms(&signal);
        signal.iter_mut().for_each(|x| *x /= rms);
        signal
    }
}

/// Root of the mean square; 0 for nothing.
pub fn rms(x: &[f64]) -> f64 {
    (x.iter().map(|x| x * x).sum::<f64>() / x.len().max(1) as f64).sqrt()
}

/// Standard deviation around the mean.
pub fn spread(x: &[f64]) -> f64 {
    let mean = x.iter().sum::<f64>() / x.len().max(1) as f64;
    (x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / x.len().max(1) as f64).sqrt()
}

/// The value below which the share `q` of the samples lies.
pub fn quantile(x: &[f64], q: f64) -> f64 {
    let mut sorted = x.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = (q * (sorted.len().max(1) - 1) as f64).round() as usize;
    sorted.get(at).copied().unwrap_or(f64::NAN)
}
