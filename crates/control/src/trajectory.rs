//! A reference given by samples, twice differentiable.

use crate::error::ControlError;

/// Fewest samples of a trajectory.
const FEWEST: usize = 4;

/// A trajectory through equally spaced samples: the cubic spline, whose end slopes are those of the cubic through the four
/// samples at each end, so that the whole curve is of fourth order (C. de Boor, *A Practical Guide to Splines*, 2001,
/// chapter IV). Before and after it the reference is at rest at its first and its last value.
///
/// ```
/// use greybox_control::Trajectory;
/// let samples = (0..=200).map(|k| (0.05 * f64::from(k)).sin()).collect();
/// let sine = Trajectory::new(0.05, samples)?;
/// let [r, rate, acceleration] = sine.at(3.33);
/// assert!((r - 3.33f64.sin()).abs() < 1e-7 && (rate - 3.33f64.cos()).abs() < 1e-5);
/// assert!((acceleration + 3.33f64.sin()).abs() < 1e-3);
/// assert_eq!(sine.at(12.0), [10f64.sin(), 0.0, 0.0]);
/// # Ok::<(), greybox_control::ControlError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    dt: f64,
    values: Vec<f64>,
    /// Per sample, not per second.
    slopes: Vec<f64>,
}

impl Trajectory {
    /// Through `values` (SI), `dt` s apart, the first at the time zero.
    ///
    /// # Errors
    /// [`ControlError::Option`] for fewer than four samples, a step that is not positive, a value that is not finite, and
    /// values that are all the same: what does not move is a set point.
    pub fn new(dt: f64, values: Vec<f64>) -> Result<Trajectory, ControlError> {
        let refuse = |what: &str, value, wanted| {
            Err(ControlError::Option { what: format!("the {what} of the trajectory"), value, wanted })
        };
        if values.len() < FEWEST {
            return refuse("number of samples", values.len() as f64, "four or more");
        }
        if !(dt > 0.0 && dt.is_finite()) {
            return refuse("step", dt, "a positive finite number of seconds");
        }
        if let Some(bad) = values.iter().find(|v| !v.is_finite()) {
            return refuse("value", *bad, "a finite number");
        }
        if values.iter().all(|v| *v == values[0]) {
            return refuse("span", 0.0, "above zero: what does not move is a set point");
        }
        let slopes = slopes(&values);
        Ok(Trajectory { dt, values, slopes })
    }

    /// From the first to the last sample, s.
    #[must_use]
    pub fn duration(&self) -> f64 {
        (self.values.len() - 1) as f64 * self.dt
    }

    /// The least and the largest sample.
    #[must_use]
    pub fn range(&self) -> (f64, f64) {
        let least = self.values.iter().copied().fold(f64::INFINITY, f64::min);
        let most = self.values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (least, most)
    }

    /// r, r′ and r″ at a time.
    #[must_use]
    pub fn at(&self, t: f64) -> [f64; 3] {
        let (s, last) = (t / self.dt, self.values.len() - 1);
        // The ends themselves, with the rounding of a time that was counted in other steps.
        let slack = 1e-9 * last as f64;
        if s.is_nan() || s < -slack {
            return [self.values[0], 0.0, 0.0];
        }
        if s > last as f64 + slack {
            return [self.values[last], 0.0, 0.0];
        }
        let i = (s.max(0.0).floor() as usize).min(last - 1);
        let (a, b) = (self.values[i], self.values[i + 1]);
        let (da, db) = (self.slopes[i], self.slopes[i + 1]);
        let u = s - i as f64;
        let w = 1.0 - u;
        let value = w * w * ((1.0 + 2.0 * u) * a + u * da) + u * u * ((1.0 + 2.0 * w) * b - w * db);
        let slope = 6.0 * u * w * (b - a) + w * (w - 2.0 * u) * da + u * (u - 2.0 * w) * db;
        let curvature = 6.0 * (w - u) * (b - a) + (6.0 * u - 4.0) * da + (6.0 * u - 2.0) * db;
        [value, slope / self.dt, curvature / (self.dt * self.dt)]
    }
}

/// The spline's slopes: slopes\[i−1\] + 4 slopes\[i\] + slopes\[i+1\] = 3 (values\[i+1\] − values\[i−1\]), by Thomas' algorithm.
fn slopes(values: &[f64]) -> Vec<f64> {
    let n = values.len();
    let end = |a: f64, b: f64, c: f64, d: f64| (-11.0 * a + 18.0 * b - 9.0 * c + 2.0 * d) / 6.0;
    let first = end(values[0], values[1], values[2], values[3]);
    let last = -end(values[n - 1], values[n - 2], values[n - 3], values[n - 4]);
    let mut slopes = vec![first; n];
    let mut upper = vec![0.0; n];
    for i in 1..n - 1 {
        let pivot = 4.0 - upper[i - 1];
        upper[i] = 1.0 / pivot;
        slopes[i] = (3.0 * (values[i + 1] - values[i - 1]) - slopes[i - 1]) / pivot;
    }
    slopes[n - 1] = last;
    for i in (1..n - 1).rev() {
        slopes[i] -= upper[i] * slopes[i + 1];
    }
    slopes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_itself() {
        let p = |s: f64| [0.3 - s + 0.5 * s * s - 0.02 * s * s * s, -1.0 + s - 0.06 * s * s, 1.0 - 0.12 * s];
        let curve = Trajectory::new(0.5, (0..12).map(|i| p(0.5 * f64::from(i))[0]).collect()).unwrap();
        for t in [0.0, 0.15, 0.5, 2.4, 5.5] {
            let (found, wanted) = (curve.at(t), p(t));
            for (a, b) in found.iter().zip(wanted) {
                assert!((a - b).abs() < 1e-11, "{t}: {found:?} {wanted:?}");
            }
        }
        assert_eq!((curve.at(-0.1), curve.at(5.6)), ([p(0.0)[0], 0.0, 0.0], [p(5.5)[0], 0.0, 0.0]));
        assert_eq!(curve.duration(), 5.5);
    }

    #[test]
    fn what_is_no_trajectory_is_refused() {
        let good = vec![0.0, 1.0, 0.0, 1.0];
        for (dt, values) in [
            (0.1, vec![0.0, 1.0, 2.0]),
            (0.0, good.clone()),
            (f64::NAN, good),
            (0.1, vec![0.0, f64::NAN, 1.0, 2.0]),
            (0.1, vec![1.0; 9]),
        ] {
            assert!(matches!(Trajectory::new(dt, values), Err(ControlError::Option { .. })));
        }
    }
}
