//! Dead times of inputs: what a request may ask for, and where a criterion over several of them is lowest.

use crate::error::IdentifyError;
use crate::options::Options;

/// The dead times of a request, checked against the inputs; `recorded` is the longest stretch without a gap, s.
///
/// # Errors
/// An input that is none or stands twice, a bound that is not positive or as long as the recording, a delayed feedback beside.
pub(crate) fn check(options: &Options, recorded: f64) -> Result<(), IdentifyError> {
    for (i, dead_time) in options.dead_times.iter().enumerate() {
        let name = &dead_time.input;
        if !options.inputs.contains(name) {
            return Err(IdentifyError::LateInput { name: name.clone(), inputs: options.inputs.join(", ") });
        }
        if options.dead_times[..i].iter().any(|d| d.input == *name) {
            return Err(IdentifyError::TwoDeadTimes { name: name.clone() });
        }
        let Some(longest) = dead_time.longest else { continue };
        if !(longest > 0.0 && longest.is_finite()) {
            let what = "the longest dead time";
            return Err(IdentifyError::Range { what, found: longest, range: "(0, ∞) s" });
        }
        if longest >= recorded {
            return Err(IdentifyError::LongestDelay { longest, recorded });
        }
    }
    if options.delay.is_some() && !options.dead_times.is_empty() {
        return Err(IdentifyError::DelayAndDeadTime);
    }
    Ok(())
}

/// One coordinate of a search: from zero to `longest`, first in steps of `coarse`, then of half of that and so on down to
/// `fine`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Axis {
    pub longest: f64,
    pub coarse: f64,
    pub fine: f64,
}

/// Most passes over all coordinates at one step.
const PASSES: usize = 6;

/// Where `criterion` is lowest, one coordinate after the other: the whole grid of each until none moves, then neighbours at
/// ever shorter steps. A point without a value is not looked at.
///
/// Coordinates that act on the criterion independently are found in one pass, others in as many as it takes the descent to
/// come to rest.
pub(crate) fn lowest(axes: &[Axis], criterion: &mut dyn FnMut(&[f64]) -> Option<f64>) -> Vec<f64> {
    let mut at = vec![0.0; axes.len()];
    let mut best = criterion(&at).unwrap_or(f64::INFINITY);
    let mut offer = |at: &mut Vec<f64>, i: usize, value: f64| {
        let before = std::mem::replace(&mut at[i], value);
        if value == before {
            return false;
        }
        match criterion(at) {
            Some(found) if found < best => {
                best = found;
                true
            }
            _ => {
                at[i] = before;
                false
            }
        }
    };
    for _ in 0..PASSES {
        let mut moved = false;
        for (i, axis) in axes.iter().enumerate() {
            let count = (axis.longest / axis.coarse).ceil().max(1.0) as usize;
            for k in 0..=count {
                moved |= offer(&mut at, i, axis.longest * k as f64 / count as f64);
            }
        }
        if !moved || axes.len() == 1 {
            break;
        }
    }
    let mut share = 0.5;
    while axes.iter().any(|axis| share * axis.coarse >= axis.fine) {
        for _ in 0..PASSES {
            let mut moved = false;
            for (i, axis) in axes.iter().enumerate() {
                let step = share * axis.coarse;
                for value in [at[i] - step, at[i] + step] {
                    moved |= offer(&mut at, i, value.clamp(0.0, axis.longest));
                }
            }
            if !moved {
                break;
            }
        }
        share *= 0.5;
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(longest: f64) -> Axis {
        Axis { longest, coarse: longest / 16.0, fine: 1e-4 }
    }

    #[test]
    fn the_lowest_of_several_valleys_is_found_to_the_finest_step() {
        let mut valleys = |x: &[f64]| Some((x[0] - 0.731).powi(2) - 0.05 * (30.0 * (x[0] - 0.731)).cos());
        let found = lowest(&[axis(1.0)], &mut valleys);
        assert!((found[0] - 0.731).abs() < 2e-4, "{found:?}");
    }

    #[test]
    fn coordinates_that_depend_on_each_other_come_to_rest_at_the_lowest_point() {
        // Correlation 0.8.
        let mut bowl = |x: &[f64]| {
            let (a, b) = (x[0] - 0.2, x[1] - 0.9);
            Some(a * a + b * b + 1.6 * a * b)
        };
        let found = lowest(&[axis(1.0), axis(2.0)], &mut bowl);
        assert!((found[0] - 0.2).abs() < 1e-3 && (found[1] - 0.9).abs() < 1e-3, "{found:?}");
    }

    #[test]
    fn what_is_lowest_at_an_end_or_has_no_value_ends_there() {
        assert_eq!(lowest(&[axis(0.5)], &mut |x| Some(x[0])), [0.0]);
        assert_eq!(lowest(&[axis(0.5)], &mut |x| Some(-x[0])), [0.5]);
        assert_eq!(lowest(&[axis(0.5)], &mut |_| None), [0.0]);
    }
}
