//! Thinning of long series for drawing, keeping every extreme.
//!
//! A drawing a thousand pixels wide cannot show more than the span of the values within each pixel. So the
//! samples are put into buckets, and a bucket becomes two points: the smallest and the largest value of each
//! series, in the order in which they occurred. All series of one plot share the two times of a bucket; an
//! extreme is therefore moved by less than one bucket.

use std::ops::Range;

/// Most points a series has on the page.
pub const MAX_POINTS: usize = 2500;

/// A partition of the samples 0 … n−1 into buckets of neighbouring samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Buckets {
    ranges: Vec<Range<usize>>,
}

impl Buckets {
    /// Buckets of equal size so that `n` samples become at most `max_points` points; one sample per bucket
    /// where no thinning is needed.
    pub fn even(n: usize, max_points: usize) -> Self {
        if n <= max_points {
            return Buckets { ranges: (0..n).map(|i| i..i + 1).collect() };
        }
        let count = (max_points / 2).max(1);
        // i*n/count never overflows for lengths that fit in memory twice over; u128 makes that certain.
        let edge = |i: usize| (i as u128 * n as u128 / count as u128) as usize;
        Buckets { ranges: (0..count).map(|i| edge(i)..edge(i + 1)).filter(|r| !r.is_empty()).collect() }
    }

    /// Buckets of equal ratio of ascending positive `x` (a logarithmic axis).
    pub fn logarithmic(x: &[f64], max_points: usize) -> Self {
        let n = x.len();
        let (Some(&first), Some(&last)) = (x.first(), x.last()) else { return Buckets::even(n, max_points) };
        if n <= max_points || first.is_nan() || first <= 0.0 || last.is_nan() || last <= first {
            return Buckets::even(n, max_points);
        }
        let count = (max_points / 2).max(1);
        let step = (last / first).ln() / count as f64;
        let mut ranges = Vec::with_capacity(count);
        let mut start = 0;
        for bucket in 1..=count {
            let edge = first * (step * bucket as f64).exp();
            let mut end = start;
            while end < n && (bucket == count || x[end] < edge) {
                end += 1;
            }
            if end > start {
                ranges.push(start..end);
                start = end;
            }
        }
        Buckets { ranges }
    }

    /// The shared abscissa: one value for a bucket of one sample, else the values a quarter from both ends.
    /// The first and the last sample keep their place, so that the axis spans the whole recording.
    pub fn axis(&self, x: &[f64]) -> Vec<f64> {
        let mut out = Vec::with_capacity(2 * self.ranges.len());
        let final_bucket = self.ranges.len().saturating_sub(1);
        for (index, range) in self.ranges.iter().enumerate() {
            let length = range.len();
            let at = |i: usize| x.get(i).copied().unwrap_or(f64::NAN);
            if length == 1 {
                out.push(at(range.start));
                continue;
            }
            out.push(at(if index == 0 { range.start } else { range.start + length / 4 }));
            out.push(at(if index == final_bucket { range.end - 1 } else { range.start + 3 * length / 4 }));
        }
        out
    }

    /// The thinned values: of each bucket its smallest and largest in order of occurrence. A value that is
    /// not finite is skipped; a bucket without any finite value gives NaN. A series that ends early gives
    /// NaN from there on.
    pub fn values(&self, y: &[f64]) -> Vec<f64> {
        let mut out = Vec::with_capacity(2 * self.ranges.len());
        for range in &self.ranges {
            if range.len() == 1 {
                out.push(y.get(range.start).copied().unwrap_or(f64::NAN));
                continue;
            }
            let end = range.end.min(y.len());
            let inside = y.get(range.start.min(end)..end).unwrap_or(&[]);
            let (mut low, mut high) = ((0, f64::NAN), (0, f64::NAN));
            for (index, &value) in inside.iter().enumerate() {
                if !value.is_finite() {
                    continue;
                }
                if low.1.is_nan() || value < low.1 {
                    low = (index, value);
                }
                if high.1.is_nan() || value > high.1 {
                    high = (index, value);
                }
            }
            let (first, second) = if low.0 <= high.0 { (low.1, high.1) } else { (high.1, low.1) };
            out.push(first);
            out.push(second);
        }
        out
    }
}

/// Rounds a series to about five digits of its own range, so that the page stays small; the error is under
/// 1/50 000 of the range, far below a pixel.
pub fn round_to_range(values: &mut [f64], digits: i32) {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for &value in values.iter().filter(|value| value.is_finite()) {
        low = low.min(value);
        high = high.max(value);
    }
    let range = high - low;
    if !range.is_finite() || range <= 0.0 {
        return;
    }
    let place = range.log10().floor() as i32 - digits;
    // Powers of ten up to 22 are exact, so n / 10^k is the double nearest to the short decimal.
    if !(-22..=22).contains(&place) {
        return;
    }
    let scale = 10f64.powi(place.abs());
    for value in values.iter_mut().filter(|value| value.is_finite()) {
        let rounded =
            if place < 0 { (*value * scale).round() / scale } else { (*value / scale).round() * scale };
        *value = if rounded == 0.0 { 0.0 } else { rounded };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_series_are_kept_as_they_are() {
        let x = [0.0, 0.1, 0.2];
        let buckets = Buckets::even(3, 10);
        assert_eq!(buckets.axis(&x), x);
        assert_eq!(buckets.values(&[1.0, f64::INFINITY, 3.0])[0], 1.0);
        assert_eq!(Buckets::even(0, 10).axis(&[]), Vec::<f64>::new());
    }

    #[test]
    fn extremes_survive_in_their_order() {
        let n = 65_000;
        let x: Vec<f64> = (0..n).map(|i| i as f64 * 1e-3).collect();
        let mut y: Vec<f64> = x.iter().map(|t| (3.0 * t).sin()).collect();
        y[12_345] = 40.0; // one sample wide
        y[54_321] = -50.0;
        let buckets = Buckets::even(n, MAX_POINTS);
        let (tx, ty) = (buckets.axis(&x), buckets.values(&y));
        assert_eq!(tx.len(), ty.len());
        assert!(tx.len() <= MAX_POINTS);
        assert_eq!((tx[0], tx[tx.len() - 1]), (x[0], x[n - 1]));
        assert!(tx.windows(2).all(|w| w[0] < w[1]), "the axis ascends");
        let spike = ty.iter().position(|&v| v == 40.0).expect("spike kept");
        let dip = ty.iter().position(|&v| v == -50.0).expect("dip kept");
        let bucket = 1e-3 * n as f64 / (MAX_POINTS / 2) as f64;
        assert!((tx[spike] - x[12_345]).abs() < bucket);
        assert!((tx[dip] - x[54_321]).abs() < bucket);
    }

    #[test]
    fn rising_and_falling_ends_are_told_apart() {
        let buckets = Buckets::even(8, 2);
        assert_eq!(buckets.values(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]), [1.0, 8.0]);
        assert_eq!(buckets.values(&[8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0]), [8.0, 1.0]);
    }

    #[test]
    fn gaps_and_short_series_give_nan() {
        let buckets = Buckets::even(8, 4);
        let out = buckets.values(&[f64::NAN, f64::NAN, f64::NAN, f64::NAN, 1.0, f64::NAN]);
        assert!(out[0].is_nan() && out[1].is_nan());
        assert_eq!(&out[2..], [1.0, 1.0]);
        assert!(buckets.values(&[]).iter().all(|v| v.is_nan()));
    }

    #[test]
    fn logarithmic_buckets_cover_every_sample_once() {
        let x: Vec<f64> = (1..=50_000).map(|i| i as f64 * 0.01).collect();
        let buckets = Buckets::logarithmic(&x, 600);
        assert!(buckets.axis(&x).len() <= 600);
        let mut expected = 0;
        for range in &buckets.ranges {
            assert_eq!(range.start, expected);
            expected = range.end;
        }
        assert_eq!(expected, x.len());
        assert_eq!(buckets.axis(&x)[0], 0.01, "the lowest frequencies are not thinned");
    }

    #[test]
    fn rounding_is_far_below_a_pixel() {
        let mut y: Vec<f64> = (0..100).map(|i| 1e-7 * (i as f64).sqrt()).collect();
        let exact = y.clone();
        round_to_range(&mut y, 5);
        let range = exact[99] - exact[0];
        assert!(y.iter().zip(&exact).all(|(a, b)| (a - b).abs() < 2e-5 * range));
        assert!(serde_json::to_string(&y[7]).unwrap().len() < 12);
        let mut odd = [f64::NAN, 1.0, f64::INFINITY];
        round_to_range(&mut odd, 5);
        assert_eq!(odd[1], 1.0);
    }
}
