//! Measurement noise and quantisation of a channel, from its differences.

use crate::interpolate::fill_missing;
use crate::recording::Recording;
use crate::spectrum::periodogram;

pub use crate::median::median;

/// Sum of squares of the binomial weights 1, −4, 6, −4, 1 of a fourth difference.
const FOURTH_DIFFERENCE_POWER: f64 = 70.0;

/// Standard deviation of white noise on a smooth signal, by fourth differences:
///
/// ```text
/// σ² = mean((Δ⁴y)²) / 70 ,   Δ⁴y = y₀ − 4y₁ + 6y₂ − 4y₃ + y₄ .
/// ```
///
/// A cubic vanishes in Δ⁴, so that what is left of a signal sampled well above its bandwidth is the noise; 70
/// is the sum of the squared weights. Windows that contain a missing sample (NaN) are skipped. Never call it
/// across the boundary of two recordings or pieces. NaN when no five neighbouring samples are present.
///
/// ```
/// use greybox_recording::noise::noise_sigma;
/// let cubic: Vec<f64> = (0..50).map(|k| f64::from(k).powi(3)).collect();
/// assert!(noise_sigma(&cubic) < 1e-9);
/// ```
pub fn noise_sigma(y: &[f64]) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for w in y.windows(5) {
        let difference = fourth_difference(w);
        if !difference.is_nan() {
            sum += difference * difference;
            count += 1;
        }
    }
    if count == 0 { f64::NAN } else { (sum / count as f64 / FOURTH_DIFFERENCE_POWER).sqrt() }
}

/// Δ⁴ of five neighbouring samples.
fn fourth_difference(w: &[f64]) -> f64 {
    w[0] - 4.0 * w[1] + 6.0 * w[2] - 4.0 * w[3] + w[4]
}

/// Standard deviation of white noise from the floor of the spectrum: the median of the Hann-windowed periodogram
/// over the top quarter of the band, where the signal is weakest,
///
/// ```text
/// σ² = median(|Y_k|²) / (ln 2 · Σw²) ,   3/8 f_s ≤ f_k ≤ 1/2 f_s .
/// ```
///
/// (The lines of white noise are distributed exponentially: their median is ln 2 times their mean.) Where the
/// signal is fast, as at ten samples per period, [`noise_sigma`] takes it for noise and this does not; where the
/// sensor filters, this sees too little. Much above it means: σ from fourth differences is only an upper bound.
/// Missing samples are interpolated. NaN below 64 samples.
pub fn spectral_floor_sigma(y: &[f64]) -> f64 {
    let full = fill_missing(y);
    if full.len() < 64 || full[0].is_nan() {
        return f64::NAN;
    }
    let lines = periodogram(&full, 1.0).power;
    let window_power = 0.375 * full.len() as f64;
    (median(&lines[3 * lines.len() / 4..lines.len() - 1]) / (std::f64::consts::LN_2 * window_power)).sqrt()
}

/// White noise has less than so many times the power in the middle of the band that it has at its top.
const FLAT: f64 = 2.0;

/// Whether a signal ends in a floor of white noise: its spectrum is as strong at 3/8 of the band as at its top (medians
/// over an eighth of the band each, within a factor of two). A filtered command falls off there. False below 256 samples.
///
/// ```
/// use greybox_recording::noise::has_white_floor;
/// let mut seed = 1u32;
/// let mut white = || {
///     seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
///     f64::from(seed >> 8) / 16_777_216.0 - 0.5
/// };
/// let noise: Vec<f64> = (0..2000).map(|_| white()).collect();
/// let filtered: Vec<f64> = noise.windows(3).map(|w| 0.25 * (w[0] + 2.0 * w[1] + w[2])).collect();
/// assert!(has_white_floor(&noise) && !has_white_floor(&filtered));
/// ```
pub fn has_white_floor(y: &[f64]) -> bool {
    let full = fill_missing(y);
    if full.len() < 256 || full[0].is_nan() {
        return false;
    }
    let power = periodogram(&full, 1.0).power;
    let (lines, eighth) = (power.len() - 1, power.len() / 8);
    let middle = median(&power[lines * 5 / 16..lines * 7 / 16]);
    middle < FLAT * median(&power[lines - eighth..lines])
}

/// Step of a quantised channel: the largest q such that more than 99 % of the first differences are whole
/// multiples of it (to a tenth of a step). `None` for a channel that is not quantised, that never moves, or
/// that knows fewer than five levels (a switch or a binary excitation is not a quantised measurement).
///
/// Numbers printed with few digits look quantised at their last digit, and are: the caller decides whether a
/// step that small matters (compare it with [`noise_sigma`]). Differences across missing samples are skipped.
pub fn quantisation_step(y: &[f64]) -> Option<f64> {
    let (low, high) = finite_range(y)?;
    let floor = 1e-11 * low.abs().max(high.abs());
    let steps: Vec<f64> = y.windows(2).map(|w| (w[1] - w[0]).abs()).filter(|d| !d.is_nan()).collect();
    let mut moved: Vec<f64> = steps.iter().copied().filter(|&d| d > floor).collect();
    if moved.len() < 8 {
        return None;
    }
    moved.sort_unstable_by(f64::total_cmp);
    // A hundredth of the differences may sit off the raster and be smaller than its step; a signal that moves by
    // many steps at a time shows the single step more rarely than that.
    [moved.len() / 100, 0].into_iter().find_map(|first| {
        let q = refine_step(&moved[first..])?;
        let on_raster = steps.iter().filter(|&&d| (d / q - (d / q).round()).abs() < 0.1).count();
        let levels = ((high - low) / q).round() + 1.0;
        (on_raster as f64 > 0.99 * steps.len() as f64 && levels >= 5.0).then_some(q)
    })
}

/// Refines the smallest of the sorted differences to the common step: least squares of d = m q over the
/// differences whose multiple m the step known so far tells beyond doubt.
fn refine_step(sorted: &[f64]) -> Option<f64> {
    let mut q = *sorted.first()?;
    let mut reach = 1.5;
    while reach < 1e6 {
        let near = &sorted[..sorted.partition_point(|&d| d < reach * q)];
        let (mut above, mut below) = (0.0, 0.0);
        for &d in near {
            let m = (d / q).round().max(1.0);
            if (d / q - m).abs() > 0.25 {
                continue; // off the raster
            }
            above += m * d;
            below += m * m;
        }
        q = above / below;
        if near.len() == sorted.len() || !q.is_finite() {
            break;
        }
        reach *= 3.0;
    }
    (q > 0.0 && q.is_finite()).then_some(q)
}

/// Noise of a channel with its quantisation counted in: max([`noise_sigma`], q/√12), where q is the
/// [`quantisation_step`] and q/√12 the standard deviation of rounding to it.
pub fn channel_sigma(y: &[f64]) -> f64 {
    let rounding = quantisation_step(y).map_or(0.0, |q| q / 12f64.sqrt());
    // f64::max ignores NaN: an estimate that could not be made must stay one.
    let noise = noise_sigma(y);
    if noise.is_nan() { noise } else { noise.max(rounding) }
}

/// [`channel_sigma`] of channel number `channel` of a recording: the median over its pieces, so that one bad
/// stretch does not decide. NaN when no piece allows an estimate.
pub fn recording_sigma(recording: &Recording, channel: usize) -> f64 {
    let of_piece: Vec<f64> = recording
        .pieces
        .iter()
        .filter_map(|piece| piece.columns.get(channel))
        .map(|y| channel_sigma(y))
        .collect();
    median(&of_piece)
}

/// Smallest and largest value that is present.
pub(crate) fn finite_range(y: &[f64]) -> Option<(f64, f64)> {
    y.iter().filter(|v| v.is_finite()).fold(None, |range, &v| {
        Some(range.map_or((v, v), |(low, high): (f64, f64)| (low.min(v), high.max(v))))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_switch_is_not_quantised_and_a_ramp_with_rounded_cells_is() {
        let switch: Vec<f64> = (0..400).map(|k| if (k / 10) % 2 == 0 { 0.0 } else { 5.0 }).collect();
        assert_eq!(quantisation_step(&switch), None);
        assert_eq!(quantisation_step(&[1.0; 100]), None);
        assert_eq!(quantisation_step(&[]), None);
        let encoder = 2.0 * std::f64::consts::PI / 4096.0;
        // Printed with five decimals: the raster itself is rounded.
        let y: Vec<f64> = (0..4000)
            .map(|k| ((0.4 * (f64::from(k) * 0.004).sin() / encoder).round() * encoder * 1e5).round() / 1e5)
            .collect();
        let q = quantisation_step(&y).unwrap();
        assert!((q / encoder - 1.0).abs() < 0.01, "{q} {encoder}");
    }
}
