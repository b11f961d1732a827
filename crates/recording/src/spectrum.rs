//! Spectra and correlations for the health checks.

use rustfft::FftPlanner;
use rustfft::num_complex::Complex;

/// One-sided power per line of a record's periodogram.
pub(crate) struct Periodogram {
    /// Power in line k (k = 0 is empty: the mean is removed), unit².
    pub(crate) power: Vec<f64>,
    /// Distance of two lines, Hz.
    pub(crate) resolution: f64,
}

/// Hann-windowed periodogram of `y` (no missing samples) less its mean, sampled every `dt` s.
pub(crate) fn periodogram(y: &[f64], dt: f64) -> Periodogram {
    let n = y.len();
    let mean = y.iter().sum::<f64>() / n as f64;
    let mut lines: Vec<Complex<f64>> = y
        .iter()
        .enumerate()
        .map(|(k, v)| {
            let angle = 2.0 * std::f64::consts::PI * k as f64 / n as f64;
            Complex::new((v - mean) * (0.5 - 0.5 * angle.cos()), 0.0)
        })
        .collect();
    FftPlanner::new().plan_fft_forward(n).process(&mut lines);
    let mut power: Vec<f64> = lines[..n / 2 + 1].iter().map(|line| line.norm_sqr()).collect();
    power[0] = 0.0;
    Periodogram { power, resolution: 1.0 / (n as f64 * dt) }
}

impl Periodogram {
    pub(crate) fn total(&self) -> f64 {
        self.power.iter().sum()
    }

    /// Lowest frequency, Hz, below which the given share of the power lies.
    pub(crate) fn frequency_below(&self, share: f64) -> f64 {
        let goal = share * self.total();
        let mut sum = 0.0;
        let line = self.power.iter().position(|p| {
            sum += p;
            sum >= goal
        });
        line.unwrap_or(self.power.len() - 1) as f64 * self.resolution
    }

    /// Number of the strongest line.
    pub(crate) fn strongest(&self) -> usize {
        (0..self.power.len()).max_by(|&a, &b| self.power[a].total_cmp(&self.power[b])).unwrap_or(0)
    }

    /// Share of the power in lines `first..=last`.
    pub(crate) fn share(&self, first: usize, last: usize) -> f64 {
        let last = last.min(self.power.len() - 1);
        if first > last {
            return 0.0;
        }
        self.power[first..=last].iter().sum::<f64>() / self.total()
    }

    /// Number of sines it would take to spread the power so: the local maxima that carry at least a thousandth of
    /// the strongest line's power, or half of (Σp)²/Σp² where that is more (a sweep has no maxima; a sine under a
    /// Hann window counts two).
    pub(crate) fn significant_lines(&self) -> usize {
        let limit = 1e-3 * self.power[self.strongest()];
        let at = |k: usize| self.power.get(k).copied().unwrap_or(0.0);
        let peaks = (1..self.power.len())
            .filter(|&k| at(k) >= limit && at(k) > 0.0 && at(k) > at(k - 1) && at(k) >= at(k + 1))
            .count();
        let spread = self.total().powi(2) / self.power.iter().map(|p| p * p).sum::<f64>();
        peaks.max((0.5 * spread) as usize)
    }
}

/// Correlation Σ a_k b_{k+lag} / √(Σa² Σb²) for lags −`reach` … `reach`, by FFT.
pub(crate) fn correlation(a: &[f64], b: &[f64], reach: usize) -> Vec<f64> {
    let n = a.len().max(b.len());
    let size = (n + reach + 1).next_power_of_two();
    let mut planner = FftPlanner::new();
    let forward = planner.plan_fft_forward(size);
    let transform = |x: &[f64]| {
        let mut lines: Vec<Complex<f64>> = x.iter().map(|&v| Complex::new(v, 0.0)).collect();
        lines.resize(size, Complex::new(0.0, 0.0));
        forward.process(&mut lines);
        lines
    };
    let (fa, fb) = (transform(a), transform(b));
    let mut product: Vec<Complex<f64>> = fa.iter().zip(&fb).map(|(x, y)| x.conj() * y).collect();
    planner.plan_fft_inverse(size).process(&mut product);
    let power = |x: &[f64]| x.iter().map(|v| v * v).sum::<f64>();
    let scale = 1.0 / (size as f64 * (power(a) * power(b)).sqrt());
    (0..=2 * reach).map(|k| product[(size + k - reach) % size].re * scale).collect()
}

/// Differences of `y`, then the residual of an autoregression of `order`: a sequence as white as that allows.
///
/// `None` when the autoregression predicts all but a 10⁻⁷th of the power: what is left of such a signal (a sine, a
/// sweep, a few sines) is rounding and noise, and a correlation with that means nothing.
pub(crate) fn whiten(y: &[f64], order: usize) -> Option<Vec<f64>> {
    let mut steps: Vec<f64> = y.windows(2).map(|w| w[1] - w[0]).collect();
    let mean = steps.iter().sum::<f64>() / steps.len() as f64;
    steps.iter_mut().for_each(|d| *d -= mean);
    let r = &correlation(&steps, &steps, order)[order..];
    let filter = levinson(r);
    let residual: Vec<f64> = (0..steps.len())
        .map(|k| filter.iter().take(k + 1).enumerate().map(|(j, c)| c * steps[k - j]).sum())
        .collect();
    let power = |x: &[f64]| x.iter().skip(order).map(|v| v * v).sum::<f64>();
    (power(&residual) > 1e-7 * power(&steps)).then_some(residual)
}

/// Prediction-error filter 1, a₁, … of the autocorrelation r₀, r₁, … (Levinson–Durbin recursion), with a trace
/// of white noise added so that perfectly predictable signals stay solvable.
fn levinson(r: &[f64]) -> Vec<f64> {
    let mut filter = vec![1.0];
    let mut error = r[0] * (1.0 + 1e-9);
    for m in 1..r.len() {
        if error.is_nan() || error <= 0.0 {
            break;
        }
        let reflection = -filter.iter().enumerate().map(|(j, a)| a * r[m - j]).sum::<f64>() / error;
        filter.push(0.0);
        let mirrored: Vec<f64> = filter.iter().rev().copied().collect();
        filter.iter_mut().zip(&mirrored).for_each(|(a, b)| *a += reflection * b);
        error *= 1.0 - reflection * reflection;
    }
    filter
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sine_is_one_line_at_its_frequency() {
        let y: Vec<f64> = (0..1000)
            .map(|k| 3.0 + (2.0 * std::f64::consts::PI * 12.5 * 0.01 * f64::from(k)).sin())
            .collect();
        let spectrum = periodogram(&y, 0.01);
        assert_eq!(spectrum.strongest(), 125);
        assert_eq!(spectrum.significant_lines(), 1);
        assert!(spectrum.share(123, 127) > 0.999);
        assert!((spectrum.frequency_below(0.5) - 12.5).abs() < 0.11);
    }

    #[test]
    fn correlation_finds_a_shift() {
        let a: Vec<f64> = (0..64).map(|k| f64::from((k * k * 7 + 3 * k) % 31) - 15.0).collect();
        let mut b = vec![0.0; 5];
        b.extend(&a[..59]);
        let c = correlation(&a, &b, 10);
        let best = (0..c.len()).max_by(|&i, &j| c[i].total_cmp(&c[j])).unwrap();
        assert_eq!(best as isize - 10, 5);
        assert!((correlation(&a, &a, 3)[3] - 1.0).abs() < 1e-12);
    }

    #[test]
    fn levinson_recovers_an_autoregression() {
        // x_k = 0.5 x_{k−1} + e: r_m = 0.5^m.
        let filter = levinson(&[1.0, 0.5, 0.25, 0.125]);
        for (a, exact) in filter.iter().zip([1.0, -0.5, 0.0, 0.0]) {
            assert!((a - exact).abs() < 1e-8);
        }
    }
}
