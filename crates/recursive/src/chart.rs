//! Changes of a stream of numbers: a CUSUM of sequential ranks with a stated rate of false alarms.

use alloc::vec::Vec;

use crate::error::RecursiveError;

/// A two-sided cumulative-sum chart of the sequential ranks of its numbers, which needs to know nothing of their distribution.
///
/// The rank r of number n among all numbers so far is uniform on 1 … n while nothing changes and the numbers are independent,
/// whatever their distribution, and independent of the ranks before (M. A. Parent, *Sequential ranking procedures*, 1965;
/// D. McDonald, *A CUSUM procedure based on sequential ranks*, Naval Research Logistics 37, 1990). Its normal score goes into
///
/// ```text
/// z = Φ⁻¹((r − ½)/n)        up ← max(0, up + z − k)        down ← max(0, down − z − k)        alarm where one exceeds h
/// ```
///
/// Hence a stretch that is learned first is not needed, and neither its length nor heavy tails distort the rate of false alarms.
/// h follows from the mean number of values between false alarms L of both sides together (D. Siegmund, *Sequential Analysis*,
/// 1985, §II.5):
///
/// ```text
/// 2 L = (exp(2kb) − 2kb − 1) / (2k²),     b = h + 1.166
/// ```
///
/// Scores may still depend on the one before. With ρ = Σ zₙ zₙ₋₁ / (Σ zₙ² + 40), z is divided by √((1 + ρ)/(1 − ρ)), by which
/// correlation widens a sum. The sums leave out the last twenty scores: a change that begins makes those alike. The 40 stands
/// for scores without correlation before the first.
///
/// The price: one number, however far off, adds Φ⁻¹(1 − 1/(2n)) at most (2.6 of a hundred, 3.3 of a thousand), so that an alarm
/// takes a few. Ranks are those among the last thousand numbers.
///
/// After an alarm, [`restart`](Self::restart) begins anew: what it became is what it is from then on. Where the numbers are
/// what they were again (the change has been taken out of them), [`resume`](Self::resume) goes on with the last ranks instead.
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
    /// The last numbers; from `oldest` on they go round.
    values: Vec<f64>,
    oldest: usize,
    /// The last scores: a change that begins makes them alike, which is no correlation.
    recent: Vec<f64>,
    /// Of the scores before those: the last, and sums of squares and of products of successive ones, which fade.
    before: f64,
    squares: f64,
    products: f64,
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

/// Values before the first that is judged, and most that are remembered.
const FIRST: usize = 5;
const MOST: usize = 1000;
/// Last scores of which the correlation is not yet taken.
const RECENT: usize = 20;
/// Scores without correlation that are taken to be there beforehand.
const UNCORRELATED: f64 = 40.0;

/// Φ⁻¹: Abramowitz & Stegun 26.2.23, then one step of Halley's on the error function.
fn normal_quantile(p: f64) -> f64 {
    let tail = p.min(1.0 - p);
    let t = libm::sqrt(-2.0 * libm::log(tail));
    let guess = t
        - (2.515_517 + t * (0.802_853 + t * 0.010_328))
            / (1.0 + t * (1.432_788 + t * (0.189_269 + t * 0.001_308)));
    let error = 0.5 * libm::erfc(guess * core::f64::consts::FRAC_1_SQRT_2) - tail;
    let density = libm::exp(-0.5 * guess * guess) / libm::sqrt(core::f64::consts::TAU);
    let step = error / density;
    let z = guess + step / (1.0 + 0.5 * guess * step);
    if p < 0.5 { -z } else { z }
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
            values: Vec::with_capacity(MOST),
            oldest: 0,
            recent: Vec::with_capacity(RECENT + 1),
            before: 0.0,
            squares: 0.0,
            products: 0.0,
            up: Sum::ZERO,
            down: Sum::ZERO,
        })
    }

    /// The limit h, in standard deviations of a value.
    pub fn limit(&self) -> f64 {
        self.limit
    }

    /// Whether its parts agree: a chart that was restored from data may be anything.
    pub fn is_consistent(&self) -> bool {
        self.limit > 0.0
            && self.reference > 0.0
            && self.values.len() <= MOST
            && self.recent.len() <= RECENT
            && self.oldest <= self.values.len().saturating_sub(1)
    }

    /// Values that are remembered.
    pub fn count(&self) -> usize {
        self.values.len()
    }

    /// Mean of the values that are remembered.
    pub fn mean(&self) -> f64 {
        self.values.iter().sum::<f64>() / self.values.len().max(1) as f64
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
        // Where some are equal, their mean rank.
        let n = self.values.len();
        let less = self.values.iter().filter(|v| **v < value).count();
        let equal = self.values.iter().filter(|v| **v == value).count();
        if n >= FIRST {
            let rank = less as f64 + 0.5 * equal as f64 + 0.5;
            let score = normal_quantile(rank / (n + 1) as f64);
            let z = score / libm::sqrt(self.spread());
            self.up.push(z - self.reference);
            self.down.push(-z - self.reference);
            self.recent.push(score);
            if self.recent.len() > RECENT {
                let settled = self.recent.remove(0);
                let fading = 1.0 - 1.0 / MOST as f64;
                self.products = fading * self.products + settled * self.before;
                self.squares = fading * self.squares + settled * settled;
                self.before = settled;
            }
        }
        if n < MOST {
            self.values.push(value);
        } else {
            self.values[self.oldest] = value;
            self.oldest = (self.oldest + 1) % MOST;
        }
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

    /// By how much correlation makes sums of scores scatter more: (1 + ρ)/(1 − ρ), at least 1.
    fn spread(&self) -> f64 {
        let correlation = (self.products / (self.squares + UNCORRELATED)).clamp(0.0, 0.9);
        (1.0 + correlation) / (1.0 - correlation)
    }

    /// Goes on after an alarm: the sums begin anew, and numbers are ranked among the last `kept` of before; the `changed` last
    /// ones are forgotten. Where the numbers that come have the mean `mean`, those that are kept are moved to it.
    pub fn resume(&mut self, kept: usize, changed: usize, mean: Option<f64>) {
        let oldest = self.oldest.min(self.values.len());
        self.values.rotate_left(oldest);
        self.values.truncate(self.values.len().saturating_sub(changed));
        self.values.drain(..self.values.len().saturating_sub(kept));
        self.recent.truncate(self.recent.len().saturating_sub(changed));
        if let Some(mean) = mean.filter(|m| m.is_finite()) {
            let shift = mean - self.mean();
            self.values.iter_mut().for_each(|v| *v += shift);
        }
        self.oldest = 0;
        (self.up, self.down) = (Sum::ZERO, Sum::ZERO);
    }

    /// Forgets all, and learns anew what is usual.
    pub fn restart(&mut self) {
        self.values.clear();
        self.oldest = 0;
        self.recent.clear();
        (self.before, self.squares, self.products) = (0.0, 0.0, 0.0);
        (self.up, self.down) = (Sum::ZERO, Sum::ZERO);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// Runs until a false alarm, numbers being what `shape` makes of normal ones.
    fn run_length(change: f64, asked: f64, shape: fn(f64) -> f64, rng: &mut rand_pcg::Pcg64) -> f64 {
        let mut chart = Chart::new(change, asked).unwrap();
        let mut next = || shape(StandardNormal.sample(rng));
        (1..1_000_000).find(|_| chart.push(next()).is_some()).unwrap() as f64
    }

    /// The mean of run lengths is what was asked for, whatever the distribution: normal, or with the tails of the fifth power
    /// of a normal number. (A run length is nearly exponential, so that the mean of 400 has a standard error of a
    /// twentieth; Siegmund's formula is good for a few hundredths; the few ranks of the first numbers make it longer.)
    #[test]
    fn false_alarms_come_as_rarely_as_stated() {
        for (change, asked) in [(1.0, 300.0), (1.0, 1000.0), (0.5, 300.0)] {
            for shape in [|x: f64| 40.0 + 3.0 * x, |x: f64| x.powi(5), |x: f64| x.exp()] {
                let mut rng = rand_pcg::Pcg64::seed_from_u64(11);
                let sum: f64 = (0..400).map(|_| run_length(change, asked, shape, &mut rng)).sum();
                let ratio = sum / 400.0 / asked;
                assert!((0.9..1.4).contains(&ratio), "{change} {asked}: {ratio}");
            }
        }
    }

    /// Numbers that depend on the one before by 0.3: without the correction, false alarms would be six times as many.
    #[test]
    fn correlated_numbers_raise_no_more_false_alarms() {
        let (mut sum, asked) = (0.0, 1000.0);
        let mut rng = rand_pcg::Pcg64::seed_from_u64(12);
        for _ in 0..200 {
            let mut chart = Chart::new(1.0, asked).unwrap();
            let mut x = 0.0;
            let length = (1..1_000_000).find(|_| {
                let noise: f64 = StandardNormal.sample(&mut rng);
                x = 0.3 * x + noise;
                chart.push(x).is_some()
            });
            sum += length.unwrap() as f64;
        }
        let ratio = sum / 200.0 / asked;
        assert!((0.5..1.2).contains(&ratio), "{ratio}");
    }

    #[test]
    fn quantiles_of_the_normal_distribution() {
        for (p, z) in [(0.5, 0.0), (0.975, 1.959_963_985), (0.001, -3.090_232_306), (0.9995, 3.290_526_731)] {
            assert!((normal_quantile(p) - z).abs() < 1e-6, "{p}: {}", normal_quantile(p));
        }
    }

    /// A change by two standard deviations after 50 values is seen within 20, in the right direction, and where it began.
    #[test]
    fn a_change_is_seen_soon() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let (mut delays, mut sinces) = (Vec::new(), Vec::new());
        for k in 0..200 {
            let mut chart = Chart::new(1.0, 100_000.0).unwrap();
            for _ in 0..50 {
                let noise: f64 = StandardNormal.sample(&mut rng);
                assert_eq!(chart.push(40.0 + 3.0 * noise), None);
            }
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

    /// Numbers that go on as before are ranked among those of before: as many false alarms as stated, and the next change is
    /// seen as soon as the first.
    #[test]
    fn a_chart_that_goes_on_knows_what_is_usual() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let (mut delays, mut resumed) = ([0u32; 2], Chart::new(1.0, 1e5).unwrap());
        for _ in 0..100 {
            let mut chart = Chart::new(1.0, 1e5).unwrap();
            for _ in 0..MOST + 300 {
                chart.push(normal());
            }
            chart.resume(100, 0, None);
            assert_eq!((chart.count(), chart.level()), (100, 0.0));
            let last = chart.values.clone();
            chart.resume(1000, 0, Some(f64::NAN));
            assert_eq!(chart.values, last);
            resumed = chart.clone();
            chart.restart();
            for (chart, delay) in [&mut chart, &mut resumed].into_iter().zip(&mut delays) {
                *delay += (0..200).take_while(|_| chart.push(normal() + 2.0).is_none()).count() as u32;
            }
        }
        // (A chart that begins anew takes the change for what is usual.)
        assert!(delays[1] < 1200 && delays[0] > 10 * delays[1], "{delays:?}");
        let (asked, mut sum) = (300.0, 0.0);
        for _ in 0..400 {
            let mut chart = Chart::new(1.0, asked).unwrap();
            for k in 0..208 {
                chart.push(normal() + if k < 200 { 0.0 } else { 30.0 });
            }
            chart.resume(200, 8, Some(5.0));
            sum += (1..1_000_000).find(|_| chart.push(normal() + 5.0).is_some()).unwrap() as f64;
        }
        let ratio = sum / 400.0 / asked;
        assert!((0.9..1.4).contains(&ratio), "{ratio}");
        assert!(resumed.count() >= 100);
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
