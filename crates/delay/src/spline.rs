//! A twice differentiable curve through equally spaced samples.

/// The cubic spline through samples at 0, 1, 2, …; its end slopes are those of the cubic through the four samples
/// at each end, so that the whole curve is of fourth order.
pub(crate) struct Spline<'a> {
    values: &'a [f64],
    slopes: Vec<f64>,
}

impl<'a> Spline<'a> {
    /// The spline, or `None` for fewer than four samples.
    pub(crate) fn new(values: &'a [f64]) -> Option<Self> {
        let n = values.len();
        let (&[a, b, c, d, ..], &[.., e, f, g, h]) = (values, values) else { return None };
        if n < 4 {
            return None;
        }
        let first = (-11.0 * a + 18.0 * b - 9.0 * c + 2.0 * d) / 6.0;
        let last = (11.0 * h - 18.0 * g + 9.0 * f - 2.0 * e) / 6.0;
        // slopes[i−1] + 4 slopes[i] + slopes[i+1] = 3 (values[i+1] − values[i−1]): Thomas' algorithm.
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
        Some(Self { values, slopes })
    }

    /// Value and slope (per sample) at the position `s` between the first and the last sample.
    pub(crate) fn at(&self, s: f64) -> (f64, f64) {
        let i = (s.max(0.0).floor() as usize).min(self.values.len() - 2);
        let (a, b) = (self.values[i], self.values[i + 1]);
        let (da, db) = (self.slopes[i], self.slopes[i + 1]);
        let u = s - i as f64;
        let w = 1.0 - u;
        let value = w * w * ((1.0 + 2.0 * u) * a + u * da) + u * u * ((1.0 + 2.0 * w) * b - w * db);
        let slope = 6.0 * u * w * (b - a) + w * (w - 2.0 * u) * da + u * (u - 2.0 * w) * db;
        (value, slope)
    }
}

#[cfg(test)]
mod tests {
    use super::Spline;

    #[test]
    fn cubics_are_exact_and_slopes_match() {
        let p = |s: f64| 0.3 - s + 0.5 * s * s - 0.02 * s * s * s;
        let dp = |s: f64| -1.0 + s - 0.06 * s * s;
        let values: Vec<f64> = (0..12).map(|i| p(i as f64)).collect();
        let spline = Spline::new(&values).unwrap();
        for s in [0.0, 0.3, 1.0, 4.75, 10.5, 11.0] {
            let (value, slope) = spline.at(s);
            assert!((value - p(s)).abs() < 1e-12 && (slope - dp(s)).abs() < 1e-12, "{s} {value} {slope}");
        }
    }

    #[test]
    fn a_sine_is_interpolated_to_fourth_order() {
        let error = |n: usize| {
            let step = 6.0 / n as f64;
            let values: Vec<f64> = (0..=n).map(|i| (i as f64 * step).sin()).collect();
            let spline = Spline::new(&values).unwrap();
            (0..10 * n)
                .map(|k| k as f64 / 10.0)
                .fold(0.0_f64, |m, s| m.max((spline.at(s).0 - (s * step).sin()).abs()))
        };
        let order = (error(40) / error(80)).log2();
        assert!(order > 3.7, "{order}");
    }

    #[test]
    fn three_samples_are_too_few() {
        assert!(Spline::new(&[1.0, 2.0, 3.0]).is_none());
    }
}
