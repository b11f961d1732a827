//! Changes of a stream of numbers: a self-starting CUSUM with a stated rate of false alarms.

use crate::error::RecursiveError;

/// A two-sided cumulative-sum chart that learns the mean and the scatter of its numbers from the numbers themselves.
///
/// Number n is compared with those before it, T = √((n−1)/n) (x − mean)/scatter. While nothing changes and the numbers are
/// independent and normal, T has Student's distribution with n − 2 degrees of freedom, independent of all before; made normal
/// (z, by Wallace's approximation) it goes into
///
/// ```text
/// up ← max(0, up + z − k)        down ← max(0, down − z − k)        alarm where one exceeds h
/// ```
///
/// (D. M. Hawkins, *Self-starting CUSUM charts for location and scale*, The Statistician 36, 1987.) Hence a stretch that is
/// learned first is not needed, and its length does not distort the rate of false alarms. h follows from the mean number of
/// values between false alarms L of both sides together (D. Siegmund, *Sequential Analysis*, 1985, §II.5):
///
/// ```text
/// 2 L = (exp(2kb) − 2kb − 1) / (2k²),     b = h + 1.166
/// ```
///
/// After an alarm, [`restart`](Self::restart) begins anew: what it became is what it is from then on.
///
/// ```
/// use greybox_recursive::{Chart, Direction};
/// let mut chart = Chart::new(1.0, 1000.0)?;
/// let noise = |k: i32| f64::from(k * k * 7919 % 101) / 50.0 - 1.0;
/// assert!((0..100).all(|k| chart.push(noise(k)).is_none()));
/// // The mean rises by two standard deviations.
/// let alarm = (100..120).find_map(|k| chart.push(noise(k) + 1.2)).expect("seen within 20 values");
/// assert_eq!(alarm.direction, Direction::Up);
/// assert!(alarm.since <= 20);
/// # Ok::<(), greybox_recursive::RecursiveError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Chart {
    reference: f64,
    limit: f64,
    count: u64,
    mean: f64,
    squares: f64,
    up: Sum,
    down: Sum,
}

/// One side of a chart.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
struct Sum {
    value: f64,
    /// Values since it was last zero.
    since: u64,
}

impl Sum {
    const ZERO: Sum = Sum { value: 0.0, since: 0 };

    fn push(&mut self, increment: f64) {
        self.value += increment;
        self.since += 1;
        if self.value <= 0.0 {
            *self = Sum::ZERO;
        }
    }
}

/// Which way a mean went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Direction {
    /// It rose.
    Up,
    /// It fell.
    Down,
}

/// A change that a chart has seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alarm {
    /// Which way.
    pub direction: Direction,
    /// How many values ago it began, by maximum likelihood: since the sum was last zero.
    pub since: u64,
    /// The sum over its limit.
    pub excess: f64,
}

/// Values before the first that is judged: Wallace's approximation of Student's distribution is good from three degrees of
/// freedom on.
const FIRST: u64 = 5;

/// Wallace's normal deviate of a value of Student's distribution (D. L. Wallace, *Bounds on normal approximations to Student's
/// and the chi-square distributions*, Ann. Math. Stat. 30, 1959).
fn normal_of_student(t: f64, freedom: f64) -> f64 {
    let factor = (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0);
    libm::copysign(factor * libm::sqrt(freedom * libm::log1p(t * t / freedom)), t)
}

/// Mean run length of one side (Siegmund).
fn run_length(reference: f64, limit: f64) -> f64 {
    let (k, b) = (reference, limit + 1.166);
    (libm::exp(2.0 * k * b) - 2.0 * k * b - 1.0) / (2.0 * k * k)
}

impl Chart {
    /// A chart that is quickest for a mean that moves by `change` standard deviations of a single value, with
    /// `values_between_false_alarms` on the average.
    ///
    /// # Errors
    /// [`RecursiveError::Design`] where one of them is not positive and finite.
    pub fn new(change: f64, values_between_false_alarms: f64) -> Result<Chart, RecursiveError> {
        for (what, value) in [
            ("the change", change),
            ("the mean number of values between false alarms", values_between_false_alarms),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(RecursiveError::Design { what, value });
            }
        }
        let reference = 0.5 * change;
        let (mut low, mut high) = (0.0, 1.0);
        while run_length(reference, high) < 2.0 * values_between_false_alarms {
            high *= 2.0;
        }
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if run_length(reference, middle) < 2.0 * values_between_false_alarms {
                low = middle;
            } else {
                high = middle;
            }
        }
        Ok(Chart {
            reference,
            limit: high,
            count: 0,
            mean: 0.0,
            squares: 0.0,
            up: Sum::ZERO,
            down: Sum::ZERO,
        })
    }

    /// The limit h, in standard deviations of a value.
    pub fn limit(&self) -> f64 {
        self.limit
    }

    /// Values so far, since the chart began.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Mean of the values since the chart began.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// The larger of both sums over the limit: 1 is an alarm.
    pub fn level(&self) -> f64 {
        self.up.value.max(self.down.value) / self.limit
    }

    /// Takes the next value, and says whether the mean has changed. What is not finite is passed over.
    pub fn push(&mut self, value: f64) -> Option<Alarm> {
        if !value.is_finite() {
            return None;
        }
        let before = self.count as f64;
        if self.count >= FIRST {
            let scatter = libm::sqrt(self.squares / (before - 1.0));
            if scatter > 0.0 {
                let t = libm::sqrt(before / (before + 1.0)) * (value - self.mean) / scatter;
                let z = normal_of_student(t, before - 1.0);
                self.up.push(z - self.reference);
                self.down.push(-z - self.reference);
            }
        }
        self.count += 1;
        let off = value - self.mean;
        self.mean += off / self.count as f64;
        self.squares += off * (value - self.mean);
        let (direction, side) = if self.up.value >= self.down.value {
            (Direction::Up, self.up)
        } else {
            (Direction::Down, self.down)
        };
        (side.value > self.limit).then(|| Alarm {
            direction,
            since: side.since,
            excess: side.value / self.limit,
        })
    }

    /// Forgets all, and learns anew what is usual.
    pub fn restart(&mut self) {
        (self.count, self.mean, self.squares) = (0, 0.0, 0.0);
        (self.up, self.down) = (Sum::ZERO, Sum::ZERO);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use std::vec::Vec;

    fn run(
        chart: &mut Chart,
        rng: &mut rand_pcg::Pcg64,
        shift: impl Fn(u64) -> f64,
        most: u64,
    ) -> Option<u64> {
        (0..most).find(|k| {
            let noise: f64 = StandardNormal.sample(rng);
            chart.push(40.0 + 3.0 * (noise + shift(*k))).is_some()
        })
    }

    /// Runs until a false alarm: their mean is what was asked for. (A run length is nearly exponential, so that the mean of
    /// 400 has a standard error of a twentieth; Siegmund's formula is good for a few hundredths.)
    #[test]
    fn false_alarms_come_as_rarely_as_stated() {
        for (change, asked) in [(1.0, 200.0), (1.0, 1000.0), (0.5, 300.0)] {
            let mut rng = rand_pcg::Pcg64::seed_from_u64(11);
            let lengths: Vec<f64> = (0..400)
                .map(|_| {
                    let mut chart = Chart::new(change, asked).unwrap();
                    run(&mut chart, &mut rng, |_| 0.0, 1_000_000).unwrap() as f64
                })
                .collect();
            let mean = lengths.iter().sum::<f64>() / 400.0;
            assert!((0.85..1.2).contains(&(mean / asked)), "{change} {asked}: {mean}");
        }
    }

    /// A change by two standard deviations after 50 values is seen within 20, in the right direction, and where it began.
    #[test]
    fn a_change_is_seen_soon() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let (mut delays, mut sinces) = (Vec::new(), Vec::new());
        for k in 0..200 {
            let mut chart = Chart::new(1.0, 100_000.0).unwrap();
            assert_eq!(run(&mut chart, &mut rng, |_| 0.0, 50), None);
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            let mut alarm = None;
            let mut delay = 0u64;
            while alarm.is_none() && delay < 60 {
                let noise: f64 = StandardNormal.sample(&mut rng);
                alarm = chart.push(40.0 + 3.0 * (noise + 2.0 * sign));
                delay += 1;
            }
            let alarm = alarm.unwrap();
            assert_eq!(alarm.direction, if sign > 0.0 { Direction::Up } else { Direction::Down });
            delays.push(delay as f64);
            sinces.push(alarm.since as f64 - delay as f64);
        }
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
        assert!((5.0..12.0).contains(&mean(&delays)), "{}", mean(&delays));
        // (By chance the sum is above zero when the change comes: its last zero lies earlier.)
        assert!((0.0..3.0).contains(&mean(&sinces)), "{}", mean(&sinces));
    }

    #[test]
    fn bad_designs_are_refused() {
        for (change, length) in [(0.0, 10.0), (1.0, 0.0), (f64::NAN, 10.0), (1.0, f64::INFINITY)] {
            assert!(matches!(Chart::new(change, length), Err(RecursiveError::Design { .. })));
        }
        // Numbers that are all the same have no scatter, and NaN is no number.
        let mut chart = Chart::new(1.0, 100.0).unwrap();
        assert!((0..100).all(|_| chart.push(5.0).is_none()));
        assert!(chart.push(f64::NAN).is_none());
        assert_eq!(chart.count(), 100);
    }
}
