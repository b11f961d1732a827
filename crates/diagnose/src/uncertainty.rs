//! How precise the parameters of a fit are.
//!
//! With the Jacobian J of the residual r (its starts eliminated), H = JᵀJ + Λ and the priors' precision Λ, a fit
//! moves with its noise as δθ = H⁻¹ Jᵀ r. Two estimates of the covariance of the scores Jᵀ r:
//!
//! * **stationary noise**: Σ_c J_cᵀ Γ_c J_c + s² Λ over the channels, Γ_c the covariance of an autoregression fitted
//!   to the residual ([`Autoregression`]; white where it has no colour, which is Gauss–Newton's s² H). Precise, and
//!   right where what is left over is noise.
//! * **blocks**: Σ_b s_b s_bᵀ over the scores of some 40 blocks of samples (the sandwich of H. White, Econometrica
//!   48, 1980, over blocks), right for misfits that depend on the motion too, but with the scatter of 40 numbers.
//!
//! The first counts, unless the second says more than that scatter explains.
//!
//! By how much the one that counts exceeds the covariance in white noise is what a ratio of likelihoods is adjusted by
//! ([`Uncertainty::inflation`]).

use std::ops::Range;

use greybox_calibrate::noise_model::MOST;
use greybox_calibrate::{Autoregression, qr, student_quantile};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::evidence::Inflation;
use crate::fitted::FittedModel;
use crate::screen::{Projected, project};

/// Blocks of samples over all recordings.
const BLOCKS: usize = 40;
/// How seldom the blocks' scatter alone may make their variance count.
const CHANCE: f64 = 0.1;

/// Covariance of the free parameters, twice.
#[derive(Debug, Clone)]
pub(crate) struct Uncertainty {
    /// Number of free parameters.
    np: usize,
    stationary: Estimated,
    blocks: Estimated,
    /// Ratio of the second variance to the first from which the second counts.
    surplus: f64,
    /// The parameters that change no sample and have no prior: nothing is known of them.
    unseen: Vec<bool>,
}

/// A covariance and the degrees of freedom that it was estimated with.
#[derive(Debug, Clone)]
struct Estimated {
    covariance: Vec<f64>,
    freedom: f64,
}

impl Estimated {
    fn variance(&self, gradient: &[f64]) -> f64 {
        let np = gradient.len();
        (0..np)
            .map(|a| gradient[a] * qr::dot(&self.covariance[a * np..(a + 1) * np], gradient))
            .sum::<f64>()
            .max(0.0)
    }

    /// Half width of the 95 % interval.
    fn width(&self, gradient: &[f64]) -> f64 {
        student_quantile(self.freedom) * self.variance(gradient).sqrt()
    }
}

/// A fit's model linearised at its optimum, its starts eliminated.
struct Linearised<'a> {
    fitted: &'a FittedModel,
    segments: Vec<Projected>,
    /// Precision of the priors.
    priors: Vec<f64>,
    /// Rows of H⁻¹.
    inverse: Vec<Vec<f64>>,
    /// Whether H has nothing on the diagonal.
    unseen: Vec<bool>,
}

impl Linearised<'_> {
    fn of<'a>(fitted: &'a FittedModel, scale: &[f64]) -> Linearised<'a> {
        let setup = &fitted.setup;
        let (nx, np) = (setup.system.nx, setup.free.len());
        let rows = setup.with_problem(&fitted.level, scale, |p| p.rows(&fitted.fit.point, true, None));
        let segments: Vec<Projected> = rows.into_iter().map(|rows| project(rows, nx)).collect();
        let mut h = gram(&segments, np);
        let at = &fitted.fit.point.parameters;
        let priors: Vec<f64> = setup.free.iter().map(|f| f.prior.precision(at[f.index])).collect();
        priors.iter().enumerate().for_each(|(i, prior)| h[i * np + i] += prior);
        let unseen = (0..np).map(|i| h[i * np + i] == 0.0).collect();
        Linearised { fitted, segments, priors, inverse: inverse(&h, np), unseen }
    }

    /// How many of these parameters the residual decides: their number less what their priors do (MacKay, *Bayesian
    /// interpolation*, Neural Computation 4, 1992).
    fn decided(&self, of: impl Iterator<Item = usize>) -> f64 {
        of.map(|i| 1.0 - self.priors[i] * self.inverse[i][i]).sum()
    }

    /// Covariance of the parameters, given that of their scores.
    fn covariance(&self, meat: &[f64]) -> Vec<f64> {
        between(&self.inverse, meat, self.priors.len())
    }

    /// Segments with the rows of channel `c`.
    fn channel(&self, c: usize) -> impl Iterator<Item = (&Projected, Range<usize>)> {
        self.segments.iter().zip(&self.fitted.level.segments).map(move |(p, s)| {
            let n = s.range.len();
            (p, c * n..(c + 1) * n)
        })
    }

    /// Samples over degrees of freedom, and the variance of all rows.
    fn spent(&self) -> (f64, f64) {
        let samples = self.fitted.level.segments.iter().map(|s| s.range.len()).sum::<usize>();
        let measured = self.fitted.setup.system.ny * samples;
        let freedom = measured.saturating_sub(self.priors.len()).max(1) as f64;
        let rss: f64 = self.segments.iter().map(|p| qr::dot(&p.r, &p.r)).sum();
        (measured as f64 / freedom, rss / freedom)
    }

    /// Adds what the priors of starts and parameters say, which is as uncertain as the samples are.
    fn add_priors(&self, meat: &mut [f64]) {
        let (ny, np) = (self.fitted.setup.system.ny, self.priors.len());
        let (_, variance) = self.spent();
        for (p, s) in self.segments.iter().zip(&self.fitted.level.segments) {
            let columns: Vec<&[f64]> =
                (0..np).map(|a| &p.jp[a * p.rows..(a + 1) * p.rows][ny * s.range.len()..]).collect();
            add_gram(meat, &columns, variance);
        }
        self.priors.iter().enumerate().for_each(|(i, prior)| meat[i * np + i] += variance * prior);
    }

    /// Covariance of the scores in stationary noise, and how many independent samples it was estimated with.
    fn stationary(&self) -> (Vec<f64>, f64) {
        let (ny, np) = (self.fitted.setup.system.ny, self.priors.len());
        let mut meat = vec![0.0; np * np];
        let (inflate, _) = self.spent();
        let mut independent = 0.0;
        for c in 0..ny {
            // A residual of zero is a sample that is missing, or that a whitening before has no row for.
            let residuals: Vec<Vec<f64>> = self
                .channel(c)
                .map(|(p, range)| p.r[range].iter().map(|r| if *r == 0.0 { f64::NAN } else { *r }).collect())
                .collect();
            let stretches: Vec<&[f64]> = residuals.iter().map(Vec::as_slice).collect();
            let noise = Autoregression::fit(&stretches, MOST);
            let present = stretches.iter().flat_map(|s| s.iter()).filter(|r| r.is_finite()).count();
            if noise.total_variance() > 0.0 {
                independent += present as f64 * noise.variance() / noise.total_variance();
            }
            for (p, range) in self.channel(c) {
                let coloured = |a: usize| {
                    let mut column = p.jp[a * p.rows..(a + 1) * p.rows][range.clone()].to_vec();
                    noise.colour_transposed(&mut column);
                    column
                };
                let columns: Vec<Vec<f64>> = (0..np).map(coloured).collect();
                add_gram(&mut meat, &columns, inflate * noise.variance());
            }
        }
        self.add_priors(&mut meat);
        (meat, (independent - np as f64).max(2.0))
    }

    /// Covariance of the scores in white noise of each channel's variance.
    fn white(&self) -> Vec<f64> {
        let (ny, np) = (self.fitted.setup.system.ny, self.priors.len());
        let mut meat = vec![0.0; np * np];
        let (inflate, _) = self.spent();
        for c in 0..ny {
            let present = self.channel(c).flat_map(|(p, range)| &p.r[range]).filter(|r| **r != 0.0);
            let (count, power) = present.fold((0.0_f64, 0.0), |(n, sum), r| (n + 1.0, sum + r * r));
            for (p, range) in self.channel(c) {
                let columns: Vec<&[f64]> =
                    (0..np).map(|a| &p.jp[a * p.rows..(a + 1) * p.rows][range.clone()]).collect();
                add_gram(&mut meat, &columns, inflate * power / count.max(1.0));
            }
        }
        self.add_priors(&mut meat);
        meat
    }
}

impl Uncertainty {
    /// At the optimum of a fit.
    pub(crate) fn of(fitted: &FittedModel, scale: &[f64]) -> Uncertainty {
        Uncertainty::at(&Linearised::of(fitted, scale))
    }

    fn at(model: &Linearised<'_>) -> Uncertainty {
        let np = model.priors.len();
        let (meat, freedom) = model.stationary();
        let stationary = Estimated { covariance: model.covariance(&meat), freedom };
        let scores = block_scores(model.fitted, &model.segments);
        let count = scores.len() as f64;
        let freedom = (count - model.decided(0..np)).max(2.0);
        let mut meat = vec![0.0; np * np];
        for s in &scores {
            for a in 0..np {
                for b in 0..np {
                    meat[a * np + b] += count / freedom * s[a] * s[b];
                }
            }
        }
        let blocks = Estimated { covariance: model.covariance(&meat), freedom };
        let surplus =
            ChiSquared::new(freedom).map_or(1.0, |chi| chi.inverse_cdf(1.0 - CHANCE) / freedom).max(1.0);
        Uncertainty { np, stationary, blocks, surplus, unseen: model.unseen.clone() }
    }

    /// tr(V⁻¹ S)/tr(V⁻¹ S₀) of the parameters θ at these positions among those that are free: S is the part of their covariance
    /// that comes from the residual, S₀ the same in white noise, and V = (H⁻¹)_θ what a fit of unit variance knows of them with
    /// their priors. (Where a prior decides, the residual says nothing, however it is distributed.)
    pub(crate) fn inflation(fitted: &FittedModel, scale: &[f64], tested: &[usize]) -> Inflation {
        if tested.is_empty() {
            return Inflation { factor: 1.0, freedom: f64::INFINITY, parameters: 0.0 };
        }
        let model = Linearised::of(fitted, scale);
        let (own, white) = (Uncertainty::at(&model), model.covariance(&model.white()));
        let t = tested.len();
        let block = |at: &dyn Fn(usize, usize) -> f64| -> Vec<f64> {
            (0..t * t).map(|i| at(tested[i / t], tested[i % t])).collect()
        };
        let known = block(&|a, b| model.inverse[a][b]);
        let certainty = inverse(&known, t);
        // What the priors of θ are uncertain by, in the covariances that count them.
        let (_, variance) = model.spent();
        let by_priors = block(&|a, b| {
            let of = |&i: &usize| model.inverse[a][i] * model.priors[i] * model.inverse[i][b];
            variance * tested.iter().map(of).sum::<f64>()
        });
        let size = |covariance: &[f64], counted: f64| -> f64 {
            let of = block(&|a, b| covariance[a * own.np + b]);
            let of: Vec<f64> = of.iter().zip(&by_priors).map(|(c, p)| c - counted * p).collect();
            (0..t).map(|a| qr::dot(&certainty[a], &of[a * t..(a + 1) * t])).sum()
        };
        let white = size(&white, 1.0);
        let stationary = size(&own.stationary.covariance, 1.0) / white;
        let blocks = size(&own.blocks.covariance, 0.0) / white;
        let (factor, freedom) = if blocks > own.surplus * stationary {
            (blocks, own.blocks.freedom)
        } else {
            (stationary, f64::INFINITY)
        };
        let factor = if factor.is_finite() { factor.max(1.0) } else { 1.0 };
        Inflation { factor, freedom, parameters: model.decided(tested.iter().copied()) }
    }

    /// Covariance of the parameters at these positions in white noise of the fit's scale.
    pub(crate) fn known(fitted: &FittedModel, scale: &[f64], positions: &[usize]) -> Vec<f64> {
        let model = Linearised::of(fitted, scale);
        let t = positions.len();
        (0..t * t).map(|i| model.inverse[positions[i / t]][positions[i % t]]).collect()
    }

    /// Half width of the 95 % interval of a figure with this gradient in the free parameters; infinite where it depends on one
    /// that no sample shows.
    pub(crate) fn width(&self, gradient: &[f64]) -> f64 {
        if self.unseen.iter().zip(gradient).any(|(unseen, g)| *unseen && *g != 0.0) {
            return f64::INFINITY;
        }
        let width = self.stationary.width(gradient);
        if self.blocks.variance(gradient) > self.surplus * self.stationary.variance(gradient) {
            width.max(self.blocks.width(gradient))
        } else {
            width
        }
    }

    /// Correlation of the estimates of two free parameters, by the covariance in stationary noise.
    pub(crate) fn correlation(&self, a: usize, b: usize) -> f64 {
        let along = |weights: &[(usize, f64)]| {
            let mut gradient = vec![0.0; self.np];
            weights.iter().for_each(|&(i, w)| gradient[i] += w);
            self.stationary.variance(&gradient)
        };
        let [per_a, per_b] = [a, b].map(|i| 1.0 / along(&[(i, 1.0)]).sqrt());
        ((along(&[(a, per_a), (b, per_b)]) - along(&[(a, per_a), (b, -per_b)])) / 4.0).clamp(-1.0, 1.0)
    }

    /// Half widths of the 95 % intervals of all free parameters.
    pub(crate) fn widths(&self) -> Vec<f64> {
        let unit = |i: usize| (0..self.np).map(|j| if i == j { 1.0 } else { 0.0 }).collect::<Vec<f64>>();
        (0..self.np).map(|i| self.width(&unit(i))).collect()
    }
}

/// Adds `weight` CᵀC of the columns to a matrix.
fn add_gram(sum: &mut [f64], columns: &[impl AsRef<[f64]>], weight: f64) {
    let np = columns.len();
    for (a, left) in columns.iter().enumerate() {
        for (b, right) in columns.iter().enumerate() {
            sum[a * np + b] += weight * qr::dot(left.as_ref(), right.as_ref());
        }
    }
}

/// JᵀJ.
fn gram(segments: &[Projected], np: usize) -> Vec<f64> {
    let mut h = vec![0.0; np * np];
    for p in segments {
        let columns: Vec<&[f64]> = p.jp.chunks(p.rows.max(1)).collect();
        add_gram(&mut h, &columns, 1.0);
    }
    h
}

/// Rows of the inverse of a symmetric matrix, solved with a diagonal of ones.
fn inverse(h: &[f64], np: usize) -> Vec<Vec<f64>> {
    let d: Vec<f64> = (0..np).map(|i| h[i * np + i].max(1e-300).sqrt()).collect();
    let scaled: Vec<f64> = (0..np * np).map(|i| h[i] / (d[i / np] * d[i % np])).collect();
    (0..np)
        .map(|i| {
            let mut e = vec![0.0; np];
            e[i] = 1.0;
            let column = qr::solve_spd(&scaled, np, &e);
            column.iter().zip(&d).map(|(x, dj)| x / (dj * d[i])).collect()
        })
        .collect()
}

/// H⁻¹ M H⁻¹.
fn between(inverse: &[Vec<f64>], meat: &[f64], np: usize) -> Vec<f64> {
    let half: Vec<Vec<f64>> = inverse
        .iter()
        .map(|row| (0..np).map(|b| qr::dot(row, &meat[b * np..(b + 1) * np])).collect())
        .collect();
    (0..np * np).map(|i| qr::dot(&half[i / np], &inverse[i % np])).collect()
}

/// Jᵀ r over each block of samples.
fn block_scores(fitted: &FittedModel, segments: &[Projected]) -> Vec<Vec<f64>> {
    let (ny, np) = (fitted.setup.system.ny, fitted.setup.free.len());
    let total: usize = fitted.level.segments.iter().map(|s| s.range.len()).sum();
    let length = (total / BLOCKS).max(1);
    let mut scores = Vec::new();
    for (segment, p) in fitted.level.segments.iter().zip(segments) {
        let (n, m) = (segment.range.len(), p.rows);
        let parts = (n as f64 / length as f64).round().max(1.0) as usize;
        for b in 0..parts {
            let (from, to) = (b * n / parts, (b + 1) * n / parts);
            let score = |a: usize| -> f64 {
                let column = &p.jp[a * m..(a + 1) * m];
                (0..ny).map(|c| c * n + from..c * n + to).map(|r| qr::dot(&column[r.clone()], &p.r[r])).sum()
            };
            scores.push((0..np).map(score).collect());
        }
    }
    scores
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use greybox_calibrate::{Data, Limits, Point, Setup, free_parameters};
    use greybox_model::Model;
    use greybox_recording::{Channel, Recording};
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    const LINE: &str = r#"
name = "Line"
[inputs]
f = {}
[states]
rest = { measured = false, initial = 0 }
[parameters]
b = { value = 2.0 }
[equations]
rest = "rest' = 0"
[measurements]
y = "b*f"
"#;

    fn sine(k: i32) -> f64 {
        (0.3 * f64::from(k)).sin()
    }

    /// A model fitted to one recording of these channels, one sample a second, from these parameters.
    fn fit(model: &Model, channels: &[(&str, &[f64])], from: &[f64]) -> FittedModel {
        let time = (0..channels[0].1.len()).map(|k| k as f64).collect();
        let channel = |(name, values): &(&str, &[f64])| Channel {
            name: (*name).into(),
            unit: None,
            values: values.to_vec(),
        };
        let channels = channels.iter().map(channel).collect();
        let recording = Recording::from_columns("line", time, channels).unwrap();
        let data = Arc::new(Data::new(model, &[recording]).unwrap());
        let setup = Setup::new(model, data, free_parameters(model)).unwrap();
        let level = setup.level(1);
        let start = Point { parameters: from.to_vec(), starts: setup.starts(&level, from) };
        let fit = setup.fit(&level, &[0.1], &[start], Limits::default());
        FittedModel { setup, parts: Vec::new(), level, fit }
    }

    /// b, half of its interval and its inflation from one recording of the input f(k), in errors made of it and a first-order autoregression.
    fn estimate(
        seed: u64,
        colour: f64,
        input: fn(i32) -> f64,
        error: fn(f64, f64) -> f64,
    ) -> (f64, f64, Inflation) {
        let model = Model::from_toml(LINE, "model.toml").unwrap();
        let n = 1200;
        let f: Vec<f64> = (0..n).map(input).collect();
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let mut state = 0.0;
        let mut noise = || {
            let white: f64 = StandardNormal.sample(&mut random);
            state = colour * state + (1.0 - colour * colour).sqrt() * white;
            state
        };
        let y: Vec<f64> = f.iter().map(|f| 2.0 * f + 0.1 * error(*f, noise())).collect();
        let fitted = fit(&model, &[("f", &f), ("y", &y)], &[1.9]);
        let estimate = fitted.fit.point.parameters[0];
        let width = Uncertainty::of(&fitted, &[0.1]).widths()[0];
        (estimate, width, Uncertainty::inflation(&fitted, &[0.1], &[0]))
    }

    /// A dead zone wider than its input ever is changes no sample, and its prior says nothing: nothing is known of it.
    #[test]
    fn a_parameter_that_no_sample_shows_is_not_known() {
        let text = LINE.replace("b = {", "gap = { value = 3.0 }\nb = {");
        let text = text.replace("\"b*f\"", "\"b*f + deadzone(f, gap)\"");
        let model = Model::from_toml(&text, "model.toml").unwrap();
        let f: Vec<f64> = (0..200).map(sine).collect();
        let y: Vec<f64> = f.iter().enumerate().map(|(k, f)| 2.0 * f + 0.1 * sine(7 * k as i32)).collect();
        let mut fitted = fit(&model, &[("f", &f), ("y", &y)], &[3.0, 2.0]);
        let gap = fitted.setup.free.iter().position(|f| f.index == 0).unwrap();
        fitted.setup.free[gap].prior = greybox_calibrate::Prior::Flat;
        let known = Uncertainty::of(&fitted, &[0.1]);
        let widths = known.widths();
        assert!(widths[gap].is_infinite() && (0.0..0.1).contains(&widths[1 - gap]), "{widths:?}");
        assert!(known.width(&[0.0, 0.0]) == 0.0);
    }

    /// Share of 400 intervals of b that hold it.
    fn coverage(colour: f64, error: fn(f64, f64) -> f64) -> f64 {
        let seeds = 400;
        let holds = |seed: &u64| {
            let (estimate, width, _) = estimate(*seed, colour, sine, error);
            (estimate - 2.0).abs() <= width
        };
        100.0 * (0..seeds).filter(holds).count() as f64 / seeds as f64
    }

    /// A first-order autoregression of ρ = 0.8 tells (1 + ρ)/(1 − ρ) = 9 times less of what stays, and more than white noise
    /// of what changes its sign every sample.
    #[test]
    fn a_slow_residual_overstates_what_is_slow() {
        let mean = |input: fn(i32) -> f64, error: fn(f64, f64) -> f64| {
            (0..20).map(|seed| estimate(seed, 0.8, input, error).2.factor).sum::<f64>() / 20.0
        };
        let slow = mean(|_| 1.0, |_, noise| noise);
        assert!((slow - 9.0).abs() < 2.0, "{slow}");
        let fast = mean(|k| if k % 2 == 0 { 1.0 } else { -1.0 }, |_, noise| noise);
        assert!((1.0..1.1).contains(&fast), "{fast}");
    }

    /// Of y = b f + c g in white noise the correlation of the estimates is −⟨f, g⟩/(‖f‖ ‖g‖), in whatever units: with
    /// g = 1000 (0.6 f + 0.8 h), h ⟂ f, that is −0.6.
    #[test]
    fn estimates_are_correlated_against_their_signals() {
        let text = LINE
            .replace("f = {}", "f = {}\ng = {}")
            .replace("b = { value = 2.0 }", "b = { value = 2.0 }\nc = { value = 0.003 }");
        let model = Model::from_toml(&text.replace("b*f", "b*f + c*g"), "model.toml").unwrap();
        let angle = |k: i32| 2.0 * std::f64::consts::PI * 60.0 * f64::from(k) / 1200.0;
        let f: Vec<f64> = (0..1200).map(|k| angle(k).sin()).collect();
        let g: Vec<f64> = (0..1200).map(|k| 1e3 * (0.6 * angle(k).sin() + 0.8 * angle(k).cos())).collect();
        let mut random = Pcg64Mcg::seed_from_u64(7);
        let mut noise = || -> f64 { StandardNormal.sample(&mut random) };
        let y: Vec<f64> = f.iter().zip(&g).map(|(f, g)| 2.0 * f + 0.003 * g + 0.1 * noise()).collect();
        let fitted = fit(&model, &[("f", &f), ("g", &g), ("y", &y)], &[1.9, 0.002]);
        let uncertainty = Uncertainty::of(&fitted, &[0.1]);
        for (a, b, expected) in [(0, 1, -0.6), (1, 0, -0.6), (0, 0, 1.0)] {
            let correlation = uncertainty.correlation(a, b);
            assert!((correlation - expected).abs() < 0.03, "{a}, {b}: {correlation}");
        }
    }

    /// Where the strength itself comes and goes, the samples agree less about it than their autocorrelation lets them.
    #[test]
    fn what_comes_and_goes_with_the_motion_is_known_less() {
        let of = |error: fn(f64, f64) -> f64| {
            (0..20).map(|seed| estimate(seed, 0.9, sine, error).2.factor).sum::<f64>() / 20.0
        };
        let (plain, coming) = (of(|_, noise| noise), of(|f, noise| f * noise));
        assert!(coming > 2.0 * plain, "{plain} {coming}");
    }

    // Three standard deviations of 400 draws at 95 % are 3.3 %.
    #[test]
    fn intervals_hold_the_truth_in_white_and_coloured_noise() {
        for colour in [0.0, 0.8, -0.6] {
            let rate = coverage(colour, |_, noise| noise);
            assert!((91.7..=98.3).contains(&rate), "{colour}: {rate} %");
        }
    }

    /// A slope that changes slowly: to a stationary noise it looks half as bad as it is.
    #[test]
    fn intervals_hold_the_truth_where_the_misfit_depends_on_the_motion() {
        let rate = coverage(0.5, |f, noise| f * noise);
        assert!((91.7..=98.3).contains(&rate), "{rate} %");
    }
}
