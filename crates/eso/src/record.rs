//! Whole records, where the future of a sample is known: the lag can be taken out.
//!
//! Everything works on slices of the caller; nothing is allocated.

use crate::{EsoError, Observer};

/// Runs the observer over a record, as in real time: `out[k]` is the estimate at sample k, with its lag.
///
/// `u`, where given, holds the input: `u[k]` acts from sample k to sample k + 1 (zero-order hold). The observer
/// is used as a recipe and starts afresh.
///
/// # Errors
/// [`EsoError::Length`] where `u` or `out` is not as long as `y`.
pub fn forward<const N: usize>(
    observer: &Observer<N>,
    y: &[f64],
    u: Option<&[f64]>,
    out: &mut [[f64; N]],
) -> Result<(), EsoError> {
    check_lengths(y, u, out.len())?;
    let mut running = *observer;
    running.reset();
    for k in 0..y.len() {
        out[k] = running.update(y[k], if k > 0 { held(u, k - 1) } else { 0.0 });
    }
    Ok(())
}

/// The mean of a run forward and one backward in time: phase exactly zero, amplitude that of the observer
/// times the cosine of its phase.
///
/// A first pass forward serves only to start the backward pass at rest with the record, and that one starts
/// the pass that counts: neither end shows the transient from zero velocity in full.
///
/// ```
/// use greybox_eso::{Design, Observer, Scheme, record};
/// let y: Vec<f64> = (0..4000).map(|k| (2e-3 * f64::from(k)).sin()).collect();
/// let observer = Observer::new(Design::thesis(), 1e-3, Scheme::Trapezoidal)?;
/// let mut z = vec![[0.0; 2]; y.len()];
/// record::zero_phase(&observer, &y, None, &mut z)?;
/// for k in 300..3700 {
///     assert!((z[k][1] - 2.0 * (2e-3 * k as f64).cos()).abs() < 6e-3);
/// }
/// # Ok::<(), greybox_eso::EsoError>(())
/// ```
///
/// # Errors
/// [`EsoError::Length`] where `u` or `out` is not as long as `y`.
pub fn zero_phase<const N: usize>(
    observer: &Observer<N>,
    y: &[f64],
    u: Option<&[f64]>,
    out: &mut [[f64; N]],
) -> Result<(), EsoError> {
    forward(observer, y, u, out)?;
    let (Some(last), Some(&last_y), Some(&first_y)) = (out.last().copied(), y.last(), y.first()) else {
        return Ok(());
    };
    let mut running = observer.backward();
    let mut z = mirrored(last);
    running.start_at(z, last_y);
    for k in (0..y.len()).rev() {
        if k + 1 < y.len() {
            z = running.update(y[k], held(u, k));
        }
        out[k] = mirrored(z);
    }
    let mut running = *observer;
    let mut z = mirrored(z);
    running.start_at(z, first_y);
    for k in 0..y.len() {
        if k > 0 {
            z = running.update(y[k], held(u, k - 1));
        }
        for (mean, forward) in out[k].iter_mut().zip(z) {
            *mean = 0.5 * (*mean + forward);
        }
    }
    Ok(())
}

/// Runs the observer forward and shifts every state ahead by its own lag ([`Observer::lag`]).
///
/// `scratch` receives the estimate with its lag, as [`forward`] gives it. Returns how many samples at the front
/// of `out` are complete; behind them the later states would need samples beyond the record and are NaN.
///
/// # Errors
/// [`EsoError::Length`] where `u`, `scratch` or `out` is not as long as `y`.
pub fn lag_compensated<const N: usize>(
    observer: &Observer<N>,
    y: &[f64],
    u: Option<&[f64]>,
    scratch: &mut [[f64; N]],
    out: &mut [[f64; N]],
) -> Result<usize, EsoError> {
    check_lengths(y, u, out.len())?;
    forward(observer, y, u, scratch)?;
    let mut complete = y.len();
    for state in 0..N {
        let shift = observer.lag(state)? / observer.step();
        let column = |k: usize| scratch[k][state];
        for (k, z) in out.iter_mut().enumerate() {
            // Euler's lead makes the shift of some states negative: the first samples stay at the first.
            let value = interpolated(y.len(), &column, (k as f64 + shift).max(0.0));
            if value.is_none() {
                complete = complete.min(k);
            }
            z[state] = value.unwrap_or(f64::NAN);
        }
    }
    Ok(complete)
}

/// `out[k]` = signal at k + `shift` samples, by cubic interpolation (linear at the ends of the record).
///
/// Returns how many samples could be filled; the others, beyond the end of the signal, are NaN.
///
/// ```
/// use greybox_eso::record::advance;
/// let z: Vec<f64> = (0..5).map(|k| f64::from(k * k)).collect();
/// let mut ahead = vec![0.0; 5];
/// assert_eq!(advance(&z, 1.5, &mut ahead)?, 3);
/// assert!((ahead[0] - 2.25).abs() < 1e-12 && ahead[3].is_nan());
/// # Ok::<(), greybox_eso::EsoError>(())
/// ```
///
/// # Errors
/// [`EsoError::Shift`] for a shift that is negative or not finite, [`EsoError::Length`] where the slices
/// differ in length.
pub fn advance(signal: &[f64], shift: f64, out: &mut [f64]) -> Result<usize, EsoError> {
    if !(shift >= 0.0 && shift.is_finite()) {
        return Err(EsoError::Shift { shift });
    }
    if out.len() != signal.len() {
        return Err(EsoError::Length { what: "out", found: out.len(), expected: signal.len() });
    }
    let mut filled = 0;
    for (k, value) in out.iter_mut().enumerate() {
        let found = interpolated(signal.len(), &|i| signal[i], k as f64 + shift);
        filled += usize::from(found.is_some());
        *value = found.unwrap_or(f64::NAN);
    }
    Ok(filled)
}

/// The value at a place between the samples: the cubic through the four nearest, the line where one of them is
/// outside; none outside the record.
fn interpolated(len: usize, at: &impl Fn(usize) -> f64, place: f64) -> Option<f64> {
    if len == 0 || !(place >= 0.0 && place <= (len - 1) as f64) {
        return None;
    }
    let left = place as usize;
    let x = place - left as f64;
    if x == 0.0 {
        return Some(at(left));
    }
    let (b, c) = (at(left), at(left + 1));
    if left == 0 || left + 2 >= len {
        return Some(b + x * (c - b));
    }
    let (a, d) = (at(left - 1), at(left + 2));
    Some(
        -x * (x - 1.0) * (x - 2.0) / 6.0 * a + (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0 * b
            - (x + 1.0) * x * (x - 2.0) / 2.0 * c
            + (x + 1.0) * x * (x - 1.0) / 6.0 * d,
    )
}

/// The state seen in reversed time: odd derivatives change their sign.
fn mirrored<const N: usize>(mut z: [f64; N]) -> [f64; N] {
    for odd in z.iter_mut().skip(1).step_by(2) {
        *odd = -*odd;
    }
    z
}

fn held(u: Option<&[f64]>, k: usize) -> f64 {
    u.map_or(0.0, |u| u[k])
}

fn check_lengths(y: &[f64], u: Option<&[f64]>, out: usize) -> Result<(), EsoError> {
    let expected = y.len();
    if let Some(u) = u.filter(|u| u.len() != expected) {
        return Err(EsoError::Length { what: "u", found: u.len(), expected });
    }
    if out != expected {
        return Err(EsoError::Length { what: "the output", found: out, expected });
    }
    Ok(())
}
