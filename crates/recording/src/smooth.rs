//! Savitzky–Golay smoothing: value and derivatives by local least squares.
//!
//! Around every sample a polynomial of the given order is fitted to the samples of a centred window; its
//! value and derivatives at the sample are the result. Near the ends the window stays whole and becomes
//! one-sided; missing samples are left out of the fit.
//!
//! Source: Savitzky & Golay, Anal. Chem. 36 (1964) 1627, doi:10.1021/ac60214a047; ends as in Gorry, Anal. Chem.
//! 62 (1990) 570, doi:10.1021/ac00205a007.

/// Windows tried by [`adaptive`], in samples.
pub const WINDOWS: [usize; 9] = [5, 7, 11, 17, 25, 41, 61, 91, 131];

/// Shortest window from which [`adaptive`] takes derivatives.
const SHORTEST_DERIVATIVE_WINDOW: usize = 7;

/// A smoothed channel with its first two derivatives.
#[derive(Debug, Clone, PartialEq)]
pub struct Smoothed {
    /// Smoothed value, the channel's unit.
    pub value: Vec<f64>,
    /// First derivative, unit/s.
    pub d1: Vec<f64>,
    /// Second derivative, unit/s².
    pub d2: Vec<f64>,
    /// Window of `value`, samples.
    pub window: usize,
    /// Window of `d1` and `d2`, samples.
    pub derivative_window: usize,
    /// Standard error of `value` per unit of white noise, away from the ends (the norm of the kernel).
    pub value_gain: f64,
    /// Standard error of `d1` per unit of white noise, 1/s, away from the ends.
    pub d1_gain: f64,
    /// What the smoothing bends `value` by, RMS (estimated by [`adaptive`]; zero otherwise).
    pub value_bend: f64,
    /// What the smoothing bends `d1` by, RMS, unit/s (estimated by [`adaptive`]; zero otherwise).
    pub d1_bend: f64,
}

impl Smoothed {
    /// Approximate standard error of `value` under white noise of standard deviation `sigma`; it leaves out
    /// what the smoothing itself bends, and the ends are a few times worse.
    pub fn value_std_error(&self, sigma: f64) -> f64 {
        sigma * self.value_gain
    }

    /// Approximate standard error of `d1`, unit/s, under white noise of standard deviation `sigma`.
    pub fn d1_std_error(&self, sigma: f64) -> f64 {
        sigma * self.d1_gain
    }
}

/// Savitzky–Golay smoothing of `y`, sampled every `dt` s, by polynomials of `order` over `window` samples.
///
/// An even window is widened by one; a window longer than `y` is cut to it, and an order too high for the
/// window is lowered (`window − 1`). Where missing samples leave fewer than half of a window, it grows until it
/// holds that many (and at least order + 2). Inside a missing run of at least `window` samples the value is
/// interpolated linearly between the smoothed neighbours (held constant beyond the first and last sample).
/// A channel with no sample at all stays NaN.
///
/// ```
/// let y: Vec<f64> = (0..40).map(|k| (0.1 * f64::from(k)).powi(3)).collect();
/// let smooth = greybox_recording::smooth::savitzky_golay(&y, 0.1, 11, 3);
/// assert!((smooth.d1[0] - 0.0).abs() < 1e-9 && (smooth.d1[20] - 12.0).abs() < 1e-9);
/// ```
pub fn savitzky_golay(y: &[f64], dt: f64, window: usize, order: usize) -> Smoothed {
    let fit = LocalFit::new(y.len(), window, order);
    let [value, d1, d2] = fit.apply::<3>(y, dt);
    Smoothed {
        value,
        d1,
        d2,
        window: fit.window,
        derivative_window: fit.window,
        value_gain: norm(&fit.centre[0]),
        d1_gain: norm(&fit.centre[1]) / dt,
        value_bend: 0.0,
        d1_bend: 0.0,
    }
}

/// Savitzky–Golay smoothing of order 3 with the longest window that does not bend the signal: it grows over
/// [`WINDOWS`] while
///
/// ```text
/// RMS(y − y_s) < 1.15 σ √(1 − 2.25/w) ,
/// ```
///
/// the residual that pure noise of standard deviation `sigma` would leave (2.25/w is the share of the noise that
/// a cubic over w samples keeps), with 15 % to spare. Derivatives come from the same window, seven samples at
/// least. Missing samples as in [`savitzky_golay`].
///
/// Where even the shortest windows bend the signal (few samples per period), it says by how much: the value by
/// what the residual holds beyond noise, the derivative by what a polynomial of order 5 over the same window
/// says otherwise, beyond the noise in that difference (σ² (‖k₅‖² − ‖k₃‖²), the kernels being projections).
pub fn adaptive(y: &[f64], dt: f64, sigma: f64) -> Smoothed {
    const ORDER: usize = 3;
    let mut best = LocalFit::new(y.len(), WINDOWS[0], ORDER);
    let [mut value] = best.apply::<1>(y, dt);
    for &window in WINDOWS[1..].iter().take_while(|&&window| window <= y.len()) {
        let fit = LocalFit::new(y.len(), window, ORDER);
        let [candidate] = fit.apply::<1>(y, dt);
        let limit = 1.15 * sigma * (1.0 - 2.25 / window as f64).sqrt();
        // Written so that a NaN (no sample, no sigma) stops the growth.
        if residual_rms(y, &candidate) < limit {
            best = fit;
            value = candidate;
        } else {
            break;
        }
    }
    let derivative_fit = if best.window < SHORTEST_DERIVATIVE_WINDOW {
        LocalFit::new(y.len(), SHORTEST_DERIVATIVE_WINDOW, ORDER)
    } else {
        best.clone()
    };
    let [_, d1, d2] = derivative_fit.apply::<3>(y, dt);
    let beyond = |power: f64, noise: f64| (power - noise).max(0.0).sqrt();
    let kept = sigma * sigma * (1.0 - 2.25 / best.window as f64);
    let value_bend = beyond(residual_rms(y, &value).powi(2), kept);
    let finer = LocalFit::new(y.len(), derivative_fit.window, ORDER + 2);
    let [_, fine] = finer.apply::<2>(y, dt);
    let (rough_gain, fine_gain) = (norm(&derivative_fit.centre[1]) / dt, norm(&finer.centre[1]) / dt);
    let noise = sigma * sigma * (fine_gain * fine_gain - rough_gain * rough_gain);
    let d1_bend = beyond(residual_rms(&fine, &d1).powi(2), noise);
    Smoothed {
        value,
        d1,
        d2,
        window: best.window,
        derivative_window: derivative_fit.window,
        value_gain: norm(&best.centre[0]),
        d1_gain: rough_gain,
        value_bend,
        d1_bend,
    }
}

/// RMS of the difference over the samples that are present; NaN if none is.
fn residual_rms(y: &[f64], smooth: &[f64]) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for (a, b) in y.iter().zip(smooth) {
        if !a.is_nan() {
            sum += (a - b) * (a - b);
            count += 1;
        }
    }
    (sum / count as f64).sqrt()
}

fn norm(weights: &[f64]) -> f64 {
    weights.iter().map(|w| w * w).sum::<f64>().sqrt()
}

/// Weights over the samples of a window, for the value and the first two derivatives (per step) at one point.
type Kernel = [Vec<f64>; 3];

/// Local fits of one window and order to a channel of `n` samples.
#[derive(Debug, Clone)]
struct LocalFit {
    window: usize,
    order: usize,
    /// Kernel at the centre of the window.
    centre: Kernel,
}

impl LocalFit {
    fn new(n: usize, window: usize, order: usize) -> Self {
        // An odd window; only a channel shorter than it may force an even one.
        let window = (window.max(1) | 1).min(n.max(1));
        let order = order.min(window - 1);
        let centre = kernel(&offsets(0..window, window / 2), order);
        Self { window, order, centre }
    }

    /// The first `D` of value, first and second derivative at every sample.
    fn apply<const D: usize>(&self, y: &[f64], dt: f64) -> [Vec<f64>; D] {
        let n = y.len();
        let mut out: [Vec<f64>; D] = std::array::from_fn(|_| vec![f64::NAN; n]);
        if n == 0 {
            return out;
        }
        let scale = [1.0, 1.0 / dt, 1.0 / (dt * dt)];
        let half = self.window / 2;
        let last_first = n - self.window;
        let mut fit = |at: usize, first: usize, kernel: &Kernel| {
            let samples = &y[first..first + self.window];
            for d in 0..D {
                out[d][at] = scale[d] * dot(&kernel[d], samples);
            }
        };
        for at in half..=last_first + half {
            fit(at, at - half, &self.centre);
        }
        for at in (0..half).chain(last_first + half + 1..n) {
            let first = at.saturating_sub(half).min(last_first);
            fit(at, first, &kernel(&offsets(first..first + self.window, at), self.order));
        }
        if y.iter().any(|v| v.is_nan()) {
            self.help_missing(y, scale, &mut out);
        }
        out
    }

    /// Fits again where the window holds missing samples, then bridges the long missing runs.
    fn help_missing<const D: usize>(&self, y: &[f64], scale: [f64; 3], out: &mut [Vec<f64>; D]) {
        let n = y.len();
        let needed = (self.window.div_ceil(2)).max(self.order + 2);
        let mut long = vec![false; n];
        for run in missing_runs(y) {
            if run.len() >= self.window {
                long[run].fill(true);
            }
        }
        let half = self.window / 2;
        let mut weighted: Vec<usize> = Vec::with_capacity(2 * self.window);
        for at in 0..n {
            if !out[0][at].is_nan() || long[at] {
                continue;
            }
            let mut first = at.saturating_sub(half).min(n - self.window);
            let mut end = first + self.window;
            weighted.clear();
            weighted.extend((first..end).filter(|&j| !y[j].is_nan()));
            while weighted.len() < needed && (first > 0 || end < n) {
                if first > 0 {
                    first -= 1;
                    if !y[first].is_nan() {
                        weighted.push(first);
                    }
                }
                if end < n {
                    if !y[end].is_nan() {
                        weighted.push(end);
                    }
                    end += 1;
                }
            }
            if weighted.is_empty() {
                continue;
            }
            let kernel = kernel(&offsets(weighted.iter().copied(), at), self.order.min(weighted.len() - 1));
            for d in 0..D {
                out[d][at] = scale[d] * weighted.iter().zip(&kernel[d]).map(|(&j, w)| w * y[j]).sum::<f64>();
            }
        }
        for run in missing_runs(y).filter(|run| run.len() >= self.window) {
            let left = run.start.checked_sub(1);
            let right = (run.end < n).then_some(run.end);
            let (from, slope) = match (left, right) {
                (Some(a), Some(b)) => (a, (out[0][b] - out[0][a]) / (b - a) as f64),
                (Some(end), None) | (None, Some(end)) => (end, 0.0),
                (None, None) => continue,
            };
            let base = out[0][from];
            for at in run {
                let line = [base + slope * (at as f64 - from as f64), slope * scale[1], 0.0];
                for d in 0..D {
                    out[d][at] = line[d];
                }
            }
        }
    }
}

/// Sample numbers relative to `at`.
fn offsets(samples: impl IntoIterator<Item = usize>, at: usize) -> Vec<f64> {
    samples.into_iter().map(|j| j as f64 - at as f64).collect()
}

/// Four partial sums, so that the compiler may keep them in one vector register.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 4];
    let (a_fours, b_fours) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a_fours.remainder().iter().zip(b_fours.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a_fours.zip(b_fours) {
        for lane in 0..4 {
            sums[lane] += x[lane] * y[lane];
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Stretches of missing samples.
pub(crate) fn missing_runs(y: &[f64]) -> impl Iterator<Item = std::ops::Range<usize>> + '_ {
    let mut at = 0;
    std::iter::from_fn(move || {
        let first = at + y[at..].iter().position(|v| v.is_nan())?;
        let end = y[first..].iter().position(|v| !v.is_nan()).map_or(y.len(), |k| first + k);
        at = end;
        Some(first..end)
    })
}

/// Weights that turn samples at the given offsets (in steps) into value, first and second derivative at offset
/// zero of their least-squares polynomial.
///
/// With the scaled Vandermonde matrix V = QR the fit's coefficients are R⁻¹Qᵀy, so the weights of the d-th
/// coefficient are Q R⁻ᵀ e_d. Gram–Schmidt runs twice: the columns are then orthogonal to rounding.
fn kernel(offsets: &[f64], order: usize) -> Kernel {
    let reach = offsets.iter().fold(1.0, |m: f64, x| m.max(x.abs()));
    let terms = order + 1;
    let mut q: Vec<Vec<f64>> = Vec::with_capacity(terms);
    let mut r = vec![vec![0.0; terms]; terms];
    for p in 0..terms {
        let mut column: Vec<f64> = offsets.iter().map(|x| (x / reach).powi(p as i32)).collect();
        for _ in 0..2 {
            for (i, earlier) in q.iter().enumerate() {
                let share = dot(earlier, &column);
                r[i][p] += share;
                for (c, e) in column.iter_mut().zip(earlier) {
                    *c -= share * e;
                }
            }
        }
        r[p][p] = norm(&column);
        column.iter_mut().for_each(|c| *c /= r[p][p]);
        q.push(column);
    }
    std::array::from_fn(|d| {
        let mut weights = vec![0.0; offsets.len()];
        if d > order {
            return weights;
        }
        // Forward substitution with Rᵀ, right side e_d times d!/reach^d.
        let mut z = vec![0.0; terms];
        for i in d..terms {
            let right = if i == d { [1.0, 1.0, 2.0][d] / reach.powi(d as i32) } else { 0.0 };
            z[i] = (right - (d..i).map(|j| r[j][i] * z[j]).sum::<f64>()) / r[i][i];
        }
        for (column, share) in q.iter().zip(&z) {
            for (w, c) in weights.iter_mut().zip(column) {
                *w += share * c;
            }
        }
        weights
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn centre_kernels_are_the_published_ones() {
        // Savitzky & Golay 1964, tables I and III: cubic over five and seven points.
        let five = LocalFit::new(100, 5, 3).centre;
        for (w, published) in five[0].iter().zip([-3.0, 12.0, 17.0, 12.0, -3.0]) {
            assert!((w - published / 35.0).abs() < 1e-14);
        }
        let seven = LocalFit::new(100, 7, 3).centre;
        for (w, published) in seven[1].iter().zip([22.0, -67.0, -58.0, 0.0, 58.0, 67.0, -22.0]) {
            assert!((w - published / 252.0).abs() < 1e-14);
        }
    }

    #[test]
    fn missing_runs_are_found_at_both_ends() {
        let nan = f64::NAN;
        let runs: Vec<_> = missing_runs(&[nan, 1.0, nan, nan, 2.0, nan]).collect();
        assert_eq!(runs, vec![0..1, 2..4, 5..6]);
        assert_eq!(missing_runs(&[]).count(), 0);
    }
}
