//! What a uniformly sampled signal did between its samples.

use crate::smooth::missing_runs;

/// Half width of the interpolation kernel, samples.
const HALF_WIDTH: usize = 32;

/// Shape parameter of the Kaiser window: about 90 dB, flat up to 0.9 of the Nyquist frequency.
const KAISER_BETA: f64 = 9.0;

/// Band-limited interpolation of a uniform signal onto a grid `factor` times finer.
///
/// ```text
/// u(t) = Σ_k u_k sinc(t − k) w(t − k) ,   w = Kaiser window of half width 32 samples, β = 9 ,
/// ```
///
/// evaluated phase by phase; each phase is normalised to the sum 1, so that constants come out exactly, and the
/// samples themselves are copied. Beyond its ends the signal is continued by odd reflection,
/// u₋ₖ = 2u₀ − uₖ. A sine at 0.8 of the Nyquist frequency is right to 1e-4 a kernel's half width away from
/// the ends.
///
/// Returns `(n − 1)·factor + 1` values (none for none); a factor below 2 returns a copy. Missing samples (NaN)
/// spoil their surroundings: fill them first, see [`fill_missing`].
///
/// ```
/// use greybox_recording::interpolate::upsample_band_limited;
/// assert_eq!(upsample_band_limited(&[2.5; 4], 3), vec![2.5; 10]);
/// ```
pub fn upsample_band_limited(u: &[f64], factor: usize) -> Vec<f64> {
    if factor < 2 || u.len() < 2 {
        return u.to_vec();
    }
    let n = u.len();
    // Samples −HALF_WIDTH+1 … n−1+HALF_WIDTH of the continued signal.
    let padded: Vec<f64> =
        (1 - HALF_WIDTH as isize..(n + HALF_WIDTH) as isize).map(|k| continued(u, k)).collect();
    let kernels: Vec<Vec<f64>> =
        (1..factor).map(|phase| phase_kernel(phase as f64 / factor as f64)).collect();
    let mut fine = Vec::with_capacity((n - 1) * factor + 1);
    for k in 0..n - 1 {
        fine.push(u[k]);
        let around = &padded[k..k + 2 * HALF_WIDTH];
        // Interpolating the departure from the sample keeps a constant exact to the last bit.
        fine.extend(kernels.iter().map(|kernel| {
            u[k] + kernel.iter().zip(around).map(|(weight, sample)| weight * (sample - u[k])).sum::<f64>()
        }));
    }
    fine.push(u[n - 1]);
    fine
}

/// Sample `k` of the signal continued beyond both ends by odd reflection (`u` has at least two samples).
fn continued(u: &[f64], mut k: isize) -> f64 {
    let last = u.len() as isize - 1;
    let (mut offset, mut sign) = (0.0, 1.0);
    loop {
        if k < 0 {
            offset += sign * 2.0 * u[0];
            sign = -sign;
            k = -k;
        } else if k > last {
            offset += sign * 2.0 * u[last as usize];
            sign = -sign;
            k = 2 * last - k;
        } else {
            return offset + sign * u[k as usize];
        }
    }
}

/// Weights of the 2·HALF_WIDTH samples around the point `fraction` of a step after the middle left sample.
fn phase_kernel(fraction: f64) -> Vec<f64> {
    let mut weights: Vec<f64> = (0..2 * HALF_WIDTH)
        .map(|j| {
            let x = fraction + (HALF_WIDTH - 1) as f64 - j as f64;
            let inside = (1.0 - (x / HALF_WIDTH as f64).powi(2)).max(0.0);
            sinc(x) * bessel_i0(KAISER_BETA * inside.sqrt())
        })
        .collect();
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum);
    weights
}

fn sinc(x: f64) -> f64 {
    let angle = std::f64::consts::PI * x;
    if angle == 0.0 { 1.0 } else { angle.sin() / angle }
}

/// Modified Bessel function I₀ by its power series Σ ((x/2)ᵏ/k!)².
fn bessel_i0(x: f64) -> f64 {
    let quarter = 0.25 * x * x;
    let (mut term, mut sum) = (1.0, 1.0);
    for k in 1..200 {
        term *= quarter / f64::from(k * k);
        sum += term;
        if term < 1e-17 * sum {
            break;
        }
    }
    sum
}

/// Fills missing samples (NaN) by linear interpolation, and holds the first and last sample beyond the ends.
/// A signal with no sample at all is returned as it is.
pub fn fill_missing(u: &[f64]) -> Vec<f64> {
    let mut full = u.to_vec();
    for run in missing_runs(u) {
        let left = run.start.checked_sub(1).map(|k| u[k]);
        let right = u.get(run.end).copied();
        let steps = run.len() as f64 + 1.0;
        let first = run.start;
        for k in run {
            let share = ((k - first) as f64 + 1.0) / steps;
            full[k] = match (left, right) {
                (Some(a), Some(b)) => a + share * (b - a),
                (Some(end), None) | (None, Some(end)) => end,
                (None, None) => f64::NAN,
            };
        }
    }
    full
}

/// Fills missing samples (NaN) with the sample before, and the first ones with the first sample there is. A signal with no
/// sample at all is returned as it is.
///
/// ```
/// use greybox_recording::interpolate::hold_missing;
/// let nan = f64::NAN;
/// assert_eq!(hold_missing(&[nan, 1.0, nan, 4.0]), [1.0, 1.0, 1.0, 4.0]);
/// ```
pub fn hold_missing(u: &[f64]) -> Vec<f64> {
    let mut last = u.iter().copied().find(|v| !v.is_nan()).unwrap_or(f64::NAN);
    let held = u.iter().map(|&v| {
        if !v.is_nan() {
            last = v;
        }
        last
    });
    held.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bessel_function_at_tabulated_points() {
        // Abramowitz & Stegun, table 9.8.
        for (x, tabulated) in [(0.0, 1.0), (1.0, 1.266_065_877_752_008), (5.0, 27.239_871_823_604_44)] {
            assert!((bessel_i0(x) / tabulated - 1.0).abs() < 1e-13);
        }
    }

    #[test]
    fn odd_reflection_continues_a_line_for_ever() {
        let line = [3.0, 5.0, 7.0];
        for k in -50..50 {
            assert!((continued(&line, k) - (3.0 + 2.0 * k as f64)).abs() < 1e-12);
        }
    }

    #[test]
    fn missing_samples_are_bridged() {
        let nan = f64::NAN;
        assert_eq!(fill_missing(&[nan, 1.0, nan, nan, 4.0, nan]), vec![1.0, 1.0, 2.0, 3.0, 4.0, 4.0]);
        assert!(fill_missing(&[nan, nan])[0].is_nan());
    }
}
