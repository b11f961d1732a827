//! Free-run simulation of whole recordings, and how well it fits.

use greybox_simulate::{Seeds, Simulation, integrate};
use rayon::prelude::*;

use crate::problem::{Limits, Point, Segment};
use crate::setup::{Level, Setup};

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

/// Which samples of a piece may serve to estimate its initial state: a quarter, as DESIGN says for
/// held-out recordings.
pub const START_SHARE: f64 = 0.25;

/// Samples from which an initial state is estimated first, and fewest that tell states no sensor sees.
const FIRST_HORIZON: usize = 15;
const LEAST_UNMEASURED: usize = 60;

impl Setup {
    /// Simulates every piece from an initial state estimated on its first quarter (prior: what the
    /// smoothed measurements say of the first sample; the residuals weigh `1/scale`).
    pub fn free_run(&self, parameters: &[f64], scale: &[f64]) -> FreeRun {
        let pieces: Vec<(Vec<f64>, greybox_simulate::Trajectory)> = (0..self.data.pieces.len())
            .into_par_iter()
            .map(|i| {
                let x0 = self.estimate_start(i, parameters, scale);
                let n = self.data.pieces[i].len;
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

    /// Initial state of a piece by output error on a growing part of its first quarter.
    pub fn estimate_start(&self, piece: usize, parameters: &[f64], scale: &[f64]) -> Vec<f64> {
        let n = self.data.pieces[piece].len;
        let most = ((n as f64 * START_SHARE) as usize).clamp(2, n);
        self.grow_start(piece, parameters, scale, most)
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
            let level = Level { segments: vec![Segment { piece, range: 0..horizon }], priors: vec![prior] };
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
    /// `window` seconds restart from a state estimated on their first quarter.
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
        let data = &self.data.pieces[piece];
        let (n, ny) = (data.len, self.system.ny);
        let length = ((window / data.dt).round() as usize).max(2);
        let mut y = vec![0.0; ny * n];
        let simulation = Simulation {
            system: &self.system,
            environment: &self.environments[piece],
            parameters,
            method: self.method,
            seeds: &Seeds::default(),
        };
        let fixed = Setup { free: Vec::new(), noise: None, carried: Vec::new(), ..self.clone() };
        let mut before = None;
        let mut a = 0;
        while a < n {
            let b = (a + length).min(n);
            let mut x0: Vec<f64> = (0..self.system.nx).map(|i| run.x[piece][i * n + a]).collect();
            let mut prior = self.start_prior(piece, a);
            for (i, (x, (mean, std))) in x0.iter_mut().zip(&mut prior).enumerate() {
                if std.is_finite() {
                    // (The free run has its start from more than the smoothing.)
                    if a > 0 {
                        *x = *mean;
                    }
                } else {
                    let state = &run.x[piece][i * n..(i + 1) * n];
                    (*mean, *std) = (*x, (0.3 * crate::data::spread(state)).max(f64::MIN_POSITIVE));
                }
            }
            let horizon = a..a + ((b - a) as f64 * START_SHARE) as usize;
            // Where the past matters, a stretch without it would be fitted to the wrong start.
            if horizon.len() >= 2 && !greybox_simulate::has_history(&self.system) {
                let level = Level { segments: vec![Segment { piece, range: horizon }], priors: vec![prior] };
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
            for c in 0..ny {
                y[c * n + a..c * n + b].copy_from_slice(&part.y[c * (b - a)..(c + 1) * (b - a)]);
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
    let wanted = (longest / 20.0).max(20.0 * dt);
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
