//! Free-run simulation of whole recordings, and how well it fits.

use greybox_simulate::{Seeds, Simulation, integrate};
use rayon::prelude::*;

use crate::problem::{Limits, Point, Segment};
use crate::setup::{Segmentation, Setup};

/// A free run over every piece of the data.
#[derive(Debug, Clone)]
pub struct FreeRun {
    /// Initial state per piece.
    pub starts: Vec<Vec<f64>>,
    /// Simulated outputs per piece, `y[c * n + k]`, SI.
    pub y: Vec<Vec<f64>>,
    /// Simulated states per piece, `x[i * n + k]`.
    pub x: Vec<Vec<f64>>,
    /// Whether a piece diverged.
    pub diverged: bool,
    /// Samples per piece that were simulated before it diverged, or all; the last of them is held to the end.
    pub lengths: Vec<usize>,
}

impl FreeRun {
    /// Whether no piece could be followed beyond its first samples.
    pub fn is_lost(&self) -> bool {
        const FIRST: usize = 3;
        self.diverged && self.lengths.iter().all(|n| *n <= FIRST)
    }
}

/// Fit of one channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// RMS of simulation minus measurement, SI.
    pub rmse: f64,
    /// The same over the RMS of the measurement about its mean.
    pub nrmse: f64,
    /// RMS when the simulation restarts from the estimated state every window, SI.
    pub rmse_windowed: f64,
    /// The same over the RMS of the measurement about its mean.
    pub nrmse_windowed: f64,
}

/// By which figure simulations of a machine are judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Criterion {
    /// The free run over whole recordings.
    FreeRun,
    /// Simulations restarted every window: an error of the start, however small, outgrows the motion within a recording.
    Windowed,
}

impl Criterion {
    /// The mean over the channels of the logarithm of the figure that judges; infinite where it diverges.
    pub fn misfit(self, scores: &[Score]) -> f64 {
        let of = |s: &Score| match self {
            Criterion::FreeRun => s.nrmse,
            Criterion::Windowed => s.nrmse_windowed,
        };
        scores.iter().map(|s| of(s).max(f64::MIN_POSITIVE).ln()).sum::<f64>() / scores.len().max(1) as f64
    }
}

/// Which samples of a piece may serve to estimate its initial state: a quarter, as DESIGN says for
/// held-out recordings.
pub const START_SHARE: f64 = 0.25;

/// How many of `n` samples this share of them is, at least two.
fn start_samples(n: usize, share: f64) -> usize {
    ((n as f64 * share) as usize).clamp(2.min(n), n)
}

/// Information on an initial state that is given, more than any samples hold.
const GIVEN: f64 = 1e100;

/// Samples from which an initial state is estimated first, and fewest that tell states no sensor sees.
const FIRST_HORIZON: usize = 15;
const LEAST_UNMEASURED: usize = 60;

impl Setup {
    /// Simulates every piece from an initial state estimated on its first quarter (prior: what the
    /// smoothed measurements say of the first sample; the residuals weigh `1/scale`).
    pub fn free_run(&self, parameters: &[f64], scale: &[f64]) -> FreeRun {
        self.run_freely(parameters, scale, START_SHARE)
    }

    /// [`free_run`](Self::free_run) over recordings that the parameters were fitted to: the initial state is fitted to
    /// the whole of each, as the parameters are.
    pub fn training_run(&self, parameters: &[f64], scale: &[f64]) -> FreeRun {
        self.run_freely(parameters, scale, 1.0)
    }

    fn run_freely(&self, parameters: &[f64], scale: &[f64], share: f64) -> FreeRun {
        let pieces: Vec<(Vec<f64>, greybox_simulate::Trajectory)> = (0..self.data.pieces.len())
            .into_par_iter()
            .map(|i| {
                let n = self.data.pieces[i].len;
                let x0 = self.grow_start(i, parameters, scale, start_samples(n, share));
                let environment = &self.environments[i];
                let seeds = Seeds::default();
                let run = integrate(&self.system, environment, parameters, &x0, 0..n, self.method, &seeds);
                (x0, run)
            })
            .collect();
        let diverged = pieces.iter().any(|(_, run)| run.diverged.is_some());
        let mut out = FreeRun { starts: vec![], y: vec![], x: vec![], diverged, lengths: vec![] };
        for ((x0, run), piece) in pieces.into_iter().zip(&self.data.pieces) {
            out.lengths.push(run.diverged.unwrap_or(piece.len));
            out.starts.push(x0);
            out.y.push(run.y);
            out.x.push(run.x);
        }
        out
    }

    /// Which figure judges simulations with these parameters, by the machine's own growth of errors, and the longest
    /// window (s) over which it can be predicted.
    ///
    /// The start of a free run is estimated on its first quarter. Its covariance there, P = (Σ JᵀJ/s² + P₀⁻¹)⁻¹ with
    /// the tangents J of the outputs, the residual s and what the smoothed measurements say, P₀, is carried on by the
    /// tangents: √(J P Jᵀ) is the error of the output at every later sample. Where it outgrows the spread of a channel (an
    /// unstable or a chaotic machine, an integrating one on a long record), or the run diverges, restarted windows judge;
    /// they are no longer than that.
    pub fn criterion(&self, parameters: &[f64], scale: &[f64]) -> (Criterion, f64) {
        let reach: Vec<f64> = (0..self.data.pieces.len())
            .into_par_iter()
            .map(|i| self.predictable(i, parameters, scale))
            .collect();
        let whole = |(r, p): (&f64, &crate::PieceData)| *r >= p.len.saturating_sub(1) as f64 * p.dt;
        let criterion = match reach.iter().zip(&self.data.pieces).all(whole) {
            true => Criterion::FreeRun,
            false => Criterion::Windowed,
        };
        (criterion, reach.into_iter().fold(f64::INFINITY, f64::min))
    }

    /// Seconds until an error of a piece's start outgrows the motion; infinite where it does not.
    fn predictable(&self, piece: usize, parameters: &[f64], scale: &[f64]) -> f64 {
        let data = &self.data.pieces[piece];
        let (n, ny, nx) = (data.len, self.system.ny, self.system.nx);
        let seeds = Seeds { initial: (0..nx).collect(), ..Seeds::default() };
        let x0 = self.estimate_start(piece, parameters, scale);
        let run =
            integrate(&self.system, &self.environments[piece], parameters, &x0, 0..n, self.method, &seeds);
        let tangent = |c: usize, k: usize, l: usize| run.dy[(l * ny + c) * n + k];
        let end = run.diverged.unwrap_or(n);
        let mut information = vec![0.0; nx * nx];
        for (l, (_, std)) in self.start_prior(piece, 0).iter().enumerate() {
            // (An initial state that is given is known.)
            information[l * nx + l] = if *std > 0.0 { std.powi(-2) } else { GIVEN };
        }
        for c in 0..ny {
            let seen = |k: &usize| !data.measured[c][*k].is_nan();
            for k in (0..start_samples(n, START_SHARE).min(end)).filter(seen) {
                for i in 0..nx {
                    for j in 0..nx {
                        information[i * nx + j] += tangent(c, k, i) * tangent(c, k, j) / scale[c].powi(2);
                    }
                }
            }
        }
        // What neither the prior nor the first quarter knows of has no part in the outputs there.
        for l in 0..nx {
            if information[l * nx + l] == 0.0 {
                information[l * nx + l] = 1.0;
            }
        }
        let mut pivots = vec![0; nx];
        if !greybox_simulate::small::factor(&mut information, &mut pivots, nx) {
            return 0.0;
        }
        let outgrown = |k: usize| {
            (0..ny).any(|c| {
                let own: Vec<f64> = (0..nx).map(|l| tangent(c, k, l)).collect();
                let mut carried = own.clone();
                greybox_simulate::small::solve(&information, &pivots, nx, &mut carried, 1);
                let variance: f64 = own.iter().zip(&carried).map(|(a, b)| a * b).sum();
                !variance.is_finite() || variance > self.data.spread[c].powi(2)
            })
        };
        match (0..end).find(|&k| outgrown(k)).or(run.diverged) {
            Some(k) => k as f64 * data.dt,
            None => f64::INFINITY,
        }
    }

    /// Initial state of a piece by output error on a growing part of its first quarter.
    pub fn estimate_start(&self, piece: usize, parameters: &[f64], scale: &[f64]) -> Vec<f64> {
        let n = self.data.pieces[piece].len;
        self.grow_start(piece, parameters, scale, start_samples(n, START_SHARE))
    }

    /// Initial state of a piece by output error on a growing part of its first `most` samples. The smoothed
    /// measurements, one-sided there, may take a free decay for one twice as large, and far beyond its first period
    /// an output error has many minima.
    pub(crate) fn grow_start(
        &self,
        piece: usize,
        parameters: &[f64],
        scale: &[f64],
        most: usize,
    ) -> Vec<f64> {
        let prior = self.start_prior(piece, 0);
        let mut x0 = self.start(piece, 0);
        for (x, (mean, std)) in x0.iter_mut().zip(&prior) {
            if *std == 0.0 {
                *x = *mean;
            }
        }
        if prior.iter().all(|p| p.1 == 0.0) {
            return x0;
        }
        let fixed = Setup { free: Vec::new(), noise: None, ..self.clone() };
        let mut horizons = Vec::new();
        let mut h = FIRST_HORIZON;
        while h < most {
            horizons.push(h);
            h *= 2;
        }
        horizons.push(most);
        for horizon in horizons {
            // What no sensor sees stays where it is until there is enough to tell it from.
            let hold = |(j, p): (usize, &(f64, f64))| {
                if horizon < LEAST_UNMEASURED && p.1.is_infinite() { (x0[j], 0.0) } else { *p }
            };
            let prior = prior.iter().enumerate().map(hold).collect();
            let level =
                Segmentation { segments: vec![Segment { piece, range: 0..horizon }], priors: vec![prior] };
            let point = Point { parameters: parameters.to_vec(), starts: vec![x0.clone()] };
            let fit = fixed
                .with_problem(&level, scale, |p| p.fit(point, Limits { iterations: 12, tolerance: 1e-6 }));
            if fit.point.starts[0].iter().all(|v| v.is_finite()) {
                x0 = fit.point.starts[0].clone();
            }
        }
        x0
    }

    /// Scores per channel of a free run, over all pieces or those of one recording. Windows of
    /// `window` seconds restart from a state estimated on their first quarter. The error of a simulation that diverges
    /// is infinite.
    pub fn scores(
        &self,
        run: &FreeRun,
        parameters: &[f64],
        window: f64,
        recording: Option<usize>,
    ) -> Vec<Score> {
        let chosen: Vec<usize> = (0..self.data.pieces.len())
            .filter(|&i| recording.is_none_or(|r| self.data.pieces[i].recording == r))
            .collect();
        let windowed: Vec<Vec<f64>> =
            chosen.par_iter().map(|&i| self.windowed(i, run, parameters, window)).collect();
        (0..self.system.ny)
            .map(|c| {
                let (mut sum, mut sum_windowed, mut count) = (0.0, 0.0, 0usize);
                let mut values = Vec::new();
                for (&i, w) in chosen.iter().zip(&windowed) {
                    let n = self.data.pieces[i].len;
                    if run.lengths[i] < n {
                        // Frozen from there on, at a value that may happen to fit.
                        sum = f64::INFINITY;
                    }
                    for (k, y) in self.data.pieces[i].measured[c].iter().enumerate() {
                        if !y.is_nan() {
                            sum += (run.y[i][c * n + k] - y).powi(2);
                            sum_windowed += (w[c * n + k] - y).powi(2);
                            count += 1;
                            values.push(*y);
                        }
                    }
                }
                let spread = crate::data::spread(&values);
                let rms = |s: f64| (s / count.max(1) as f64).sqrt();
                Score {
                    rmse: rms(sum),
                    nrmse: rms(sum) / spread,
                    rmse_windowed: rms(sum_windowed),
                    nrmse_windowed: rms(sum_windowed) / spread,
                }
            })
            .collect()
    }

    /// Outputs of simulations restarted every window, `y[c * n + k]`, each from a state estimated on the
    /// window's first quarter (prior: the smoothed measurements; what no sensor sees, the free run). What
    /// was before a window stays known to delayed expressions.
    fn windowed(&self, piece: usize, run: &FreeRun, parameters: &[f64], window: f64) -> Vec<f64> {
        self.restarted(piece, 0..self.data.pieces[piece].len, &run.x[piece], parameters, window)
    }

    /// Outputs over samples `range` of a piece, `y[c * range.len() + k]`, of simulations restarted every window (s), each
    /// from a state estimated on the window's first quarter (prior: the smoothed measurements; what no sensor sees, the
    /// `states[i * n + k]` of a run over the whole piece). Infinite in a window that diverges.
    pub fn restarted(
        &self,
        piece: usize,
        range: std::ops::Range<usize>,
        states: &[f64],
        parameters: &[f64],
        window: f64,
    ) -> Vec<f64> {
        let data = &self.data.pieces[piece];
        let (n, ny, m) = (data.len, self.system.ny, range.len());
        let length = ((window / data.dt).round() as usize).max(2);
        let mut y = vec![0.0; ny * m];
        let simulation = Simulation {
            system: &self.system,
            environment: &self.environments[piece],
            parameters,
            method: self.method,
            seeds: &Seeds::default(),
        };
        let fixed = Setup { free: Vec::new(), noise: None, carried: Vec::new(), ..self.clone() };
        let mut before = None;
        let mut a = range.start;
        while a < range.end {
            let b = a.saturating_add(length).min(range.end);
            let mut x0: Vec<f64> = (0..self.system.nx).map(|i| states[i * n + a]).collect();
            let mut prior = self.start_prior(piece, a);
            for (i, (x, (mean, std))) in x0.iter_mut().zip(&mut prior).enumerate() {
                if std.is_finite() {
                    // (The free run has its start from more than the smoothing.)
                    if a > 0 {
                        *x = *mean;
                    }
                } else {
                    let state = &states[i * n..(i + 1) * n];
                    (*mean, *std) = (*x, (0.3 * crate::data::spread(state)).max(f64::MIN_POSITIVE));
                }
            }
            let horizon = a..a + ((b - a) as f64 * START_SHARE) as usize;
            // Where the past matters, a stretch without it would be fitted to the wrong start.
            if horizon.len() >= 2 && !greybox_simulate::has_history(&self.system) {
                let level =
                    Segmentation { segments: vec![Segment { piece, range: horizon }], priors: vec![prior] };
                let point = Point { parameters: parameters.to_vec(), starts: vec![x0.clone()] };
                let limits = Limits { iterations: 6, tolerance: 1e-4 };
                let fit = fixed.with_problem(&level, &self.data.sigma, |p| p.fit(point, limits));
                if let Some(found) = fit.point.starts.into_iter().next()
                    && found.iter().all(|v| v.is_finite())
                {
                    x0 = found;
                }
            }
            let (part, carry) = simulation.run_on(&x0, a..b, before.as_ref(), &[]);
            before = Some(carry);
            let (from, to) = (a - range.start, b - range.start);
            for c in 0..ny {
                match part.diverged {
                    Some(_) => y[c * m + from..c * m + to].fill(f64::INFINITY),
                    None => {
                        y[c * m + from..c * m + to].copy_from_slice(&part.y[c * (b - a)..(c + 1) * (b - a)])
                    }
                }
            }
            a = b;
        }
        y
    }
}

/// Window for restarted simulations: the 1-2-5 number of seconds nearest below a twentieth of the
/// longest piece, at least 20 samples.
pub fn window_length(durations: &[f64], dt: f64) -> f64 {
    let longest = durations.iter().copied().fold(0.0, f64::max);
    window_of(longest / 20.0, dt)
}

/// The 1-2-5 number of seconds nearest below `wanted`, at least 20 samples.
pub fn window_of(wanted: f64, dt: f64) -> f64 {
    let wanted = wanted.max(20.0 * dt);
    let decade = 10f64.powf(wanted.log10().floor());
    let mantissa = wanted / decade * (1.0 + 1e-9);
    let round = [5.0, 2.0, 1.0].into_iter().find(|m| mantissa >= *m).unwrap_or(1.0) * decade;
    if round < 20.0 * dt { 20.0 * dt } else { round }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_are_round_numbers() {
        assert!((window_length(&[24.84], 0.001) - 1.0).abs() < 1e-12);
        assert!((window_length(&[106.6, 20.0], 0.0016) - 5.0).abs() < 1e-12);
        assert!((window_length(&[2.8], 1.0 / 15.0) - 20.0 / 15.0).abs() < 1e-12);
    }
}
