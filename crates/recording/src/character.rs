//! How a signal moves: what may drive a machine, and what may be its state.

use serde::Serialize;

/// How a signal moves from sample to sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Character {
    /// It never moves.
    Constant,
    /// It keeps its value at more than half of the samples: a command in steps, a switch.
    Steps,
    /// The sample before says no more of a sample than the mean does: a command of many frequencies, or noise.
    Broadband,
    /// The sample before says more: what has inertia.
    Smooth,
}

/// How a signal moves; missing samples (NaN) are passed over. With x̄ the mean, smooth is where
///
/// ```text
/// Σ (xₖ − xₖ₋₁)² < Σ (xₖ − x̄)² .
/// ```
///
/// `None` for fewer than two samples.
///
/// ```
/// use greybox_recording::{Character, character};
/// let sine: Vec<f64> = (0..100).map(|k| (0.1 * f64::from(k)).sin()).collect();
/// assert_eq!(character(&sine), Some(Character::Smooth));
/// let steps: Vec<f64> = (0..100).map(|k| f64::from(k / 10 % 2)).collect();
/// assert_eq!(character(&steps), Some(Character::Steps));
/// ```
pub fn character(values: &[f64]) -> Option<Character> {
    let present: Vec<f64> = values.iter().copied().filter(|v| !v.is_nan()).collect();
    if present.len() < 2 {
        return None;
    }
    let mean = present.iter().sum::<f64>() / present.len() as f64;
    let spread: f64 = present.iter().map(|v| (v - mean).powi(2)).sum();
    let steps = present.windows(2).map(|w| w[1] - w[0]);
    let kept = steps.clone().filter(|step| *step == 0.0).count();
    let changes: f64 = steps.map(|step| step * step).sum();
    Some(if kept == present.len() - 1 {
        Character::Constant
    } else if 2 * kept > present.len() - 1 {
        Character::Steps
    } else if changes < spread {
        Character::Smooth
    } else {
        Character::Broadband
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_move_in_four_ways() {
        let signal = |f: &dyn Fn(usize) -> f64| character(&(0..400).map(f).collect::<Vec<_>>());
        assert_eq!(signal(&|_| 3.0), Some(Character::Constant));
        assert_eq!(signal(&|k| (k / 3 % 5) as f64), Some(Character::Steps));
        assert_eq!(signal(&|k| (k * 7919 % 401) as f64), Some(Character::Broadband));
        assert_eq!(signal(&|k| (0.3 * k as f64).sin()), Some(Character::Smooth));
        // Samples that are missing between others do not count as kept.
        assert_eq!(
            signal(&|k| if k % 10 == 0 { (0.03 * k as f64).sin() } else { f64::NAN }),
            Some(Character::Smooth)
        );
        assert_eq!(character(&[1.0, f64::NAN]), None);
    }
}
