//! The share of machines that have something.

use statrs::distribution::{Beta, ContinuousCDF};

/// A share with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Share {
    /// How many have it.
    pub count: usize,
    /// Of how many.
    pub of: usize,
    /// Both ends of the interval.
    pub ci95: [f64; 2],
}

/// The share of machines, with the interval of Jeffreys: quantiles of Beta(x + ½, n − x + ½), with the ends 0 and 1 where
/// none or all have it (L. D. Brown, T. T. Cai, A. DasGupta, "Interval estimation for a binomial proportion", Statistical
/// Science 16(2), 2001, 101–133, <https://doi.org/10.1214/ss/1009213286>).
///
/// ```
/// let share = greybox_fleet::share(9, 10);
/// assert!((share.ci95[0] - 0.6188).abs() < 5e-4 && (share.ci95[1] - 0.9889).abs() < 5e-4);
/// ```
pub fn share(count: usize, of: usize) -> Share {
    let (x, n) = (count as f64, of as f64);
    let quantile =
        |p: f64| Beta::new(x + 0.5, (n - x).max(0.0) + 0.5).map_or(f64::NAN, |beta| beta.inverse_cdf(p));
    let low = if count == 0 { 0.0 } else { quantile(0.025) };
    let high = if count >= of { 1.0 } else { quantile(0.975) };
    Share { count, of, ci95: [low, high] }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The interval covers the true share 95 % of the time, on average over shares.
    #[test]
    fn intervals_cover() {
        let n = 20;
        let mut covered = 0.0;
        let shares: Vec<f64> = (1..200).map(|k| f64::from(k) / 200.0).collect();
        for &truth in &shares {
            let mut mass = (1.0 - truth).powi(n);
            for x in 0..=n {
                let [low, high] = share(x as usize, n as usize).ci95;
                if (low..=high).contains(&truth) {
                    covered += mass;
                }
                mass *= f64::from(n - x) / f64::from(x + 1) * truth / (1.0 - truth);
            }
        }
        let rate = covered / shares.len() as f64;
        assert!((rate - 0.95).abs() < 0.01, "{rate}");
    }

    #[test]
    fn none_and_all_reach_the_ends() {
        assert_eq!(share(0, 5).ci95[0], 0.0);
        assert_eq!(share(5, 5).ci95[1], 1.0);
        assert_eq!(share(0, 0).ci95, [0.0, 1.0]);
    }
}
