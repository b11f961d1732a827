//! Comparisons of fitted models: what the samples tell for the richer one, and whether that is believed.

use std::sync::Arc;

use greybox_calibrate::{Setup, Work, qr};

use super::{
    CLEAR, INDEPENDENT, LAST_STEPS, LEAST_SHARE, MEMORY_SAMPLES, MOST_MECHANISMS, MOST_SAMPLES, SHORTEST,
    STEPS_WITHOUT, Search, limits, odds,
};
use crate::Weighed;
use crate::candidate::Candidate;
use crate::evidence::{ComparedModel, Evidence, Smoothness, effective_sample_ratio, folds, robust, weigh};
use crate::fitted::{FittedModel, Found, MechanismTerm, WHITE, rms_of};
use crate::library::Mechanism;
use crate::place::Place;
use crate::screen::screen;
use crate::uncertainty::Uncertainty;

/// Residual over innovations up to which a correlated residual passes for noise: slower ones (a pole beyond
/// 0.995) are what a model leaves over.
const SLOWEST: f64 = 10.0;
/// Least mean over standard error of the folds' gains, for a force that never rests.
const STEADY: f64 = 2.5;
/// How much of the other parts a fit without some may begin with.
const FAINT: f64 = 0.1;

impl Search<'_> {
    /// The evidence for `new` over `old`, by the independent samples of the residual that `new` leaves.
    pub(super) fn weigh(&self, old: &FittedModel, new: &FittedModel, scale: &[f64]) -> Evidence {
        let ratios = effective_sample_ratio(new.at(scale));
        self.weigh_with(old, new, scale, &ratios)
    }

    /// The evidence for `new` over `old`; where residuals are whitened, by the profile likelihood: each
    /// model with the noise model that suits its own residual.
    pub(super) fn weigh_with(
        &self,
        old: &FittedModel,
        new: &FittedModel,
        scale: &[f64],
        effective_sample_ratio: &[f64],
    ) -> Evidence {
        let (before, after) = (self.side(old, new, scale), self.side(new, new, scale));
        let folds = |f: &FittedModel| folds(f.at(scale));
        let whitened = new.setup.noise.is_some();
        weigh((&before, &folds(old)), (&after, &folds(new)), &new.fit.count, effective_sample_ratio, whitened)
    }

    /// What a comparison that ends at `new` knows of a model.
    pub(super) fn side(&self, of: &FittedModel, new: &FittedModel, scale: &[f64]) -> ComparedModel {
        let rss = if new.setup.noise.is_some() { innovations(of, scale) } else { of.fit.rss.clone() };
        let mechanisms = || of.parts.iter().map(|part| &self.library[part.candidate.mechanism]);
        // (Of a free shape its size alone: the rest has a prior.)
        let parameters =
            mechanisms().map(|m| if m.shape.is_some() { 1.0 } else { m.parameters().count() as f64 });
        ComparedModel {
            rss,
            parameters: parameters.sum(),
            surcharge: mechanisms().map(|m| m.surcharge).sum(),
            shapes: self.smoothness(of, scale),
        }
    }

    /// What the free shapes of a model cost.
    fn smoothness(&self, of: &FittedModel, scale: &[f64]) -> Smoothness {
        let is_shape = |part: &&MechanismTerm| self.library[part.candidate.mechanism].shape.is_some();
        let free = |name: &String| {
            let index = of.setup.model.parameter(name)?;
            of.setup.free.iter().position(|f| f.index == index)
        };
        let names = of.parts.iter().filter(is_shape).flat_map(|part| &part.instance.names);
        let positions: Vec<usize> = names.filter_map(free).collect();
        if positions.is_empty() {
            return Smoothness::default();
        }
        let value = |&i: &usize| of.fit.point.parameters[of.setup.free[i].index];
        let known = Uncertainty::known(of, scale, &positions);
        Smoothness {
            squares: positions.iter().map(|i| value(i).powi(2)).sum(),
            certainty: -qr::log_determinant(&known, positions.len()),
        }
    }

    /// What is known of the strengths that `new` has and `old` has not ([`robust`]).
    pub(crate) fn robust(&self, old: &FittedModel, new: &FittedModel, scale: &[f64]) -> f64 {
        // Whoever listens changes nothing: what it costs is not counted.
        let work = Arc::new(Work::of_fits_within(u64::MAX));
        let uncounted = |f: &FittedModel| FittedModel {
            setup: Setup { work: work.clone(), ..f.setup.clone() },
            ..f.clone()
        };
        let (old, new) = (uncounted(old), uncounted(new));
        let inflation = Uncertainty::inflation(&new, scale, &self.tested(&old, &new));
        robust(&self.side(&old, &new, scale), &self.side(&new, &new, scale), &new.fit.count, inflation)
    }

    /// Positions, among what is free in `new`, of what stands for the laws that `old` lacks: their strengths, or all
    /// parameters of a law that has none.
    fn tested(&self, old: &FittedModel, new: &FittedModel) -> Vec<usize> {
        let is_new = |part: &&MechanismTerm| !old.parts.iter().any(|o| o.candidate == part.candidate);
        let names = new.parts.iter().filter(is_new).flat_map(|part| {
            let strengths = self.library[part.candidate.mechanism].linear.len();
            let names = &part.instance.names;
            if strengths > 0 { &names[..strengths.min(names.len())] } else { &names[..] }
        });
        let position = |name: &String| {
            let index = new.setup.model.parameter(name)?;
            new.setup.free.iter().position(|f| f.index == index)
        };
        names.filter_map(position).collect()
    }

    /// What evidence must exceed for so many laws, each one of all candidates.
    pub(super) fn threshold(&self, laws: usize) -> f64 {
        laws as f64 * odds(self.all.len()) + 6.0
    }

    /// Tells what was weighed against what.
    pub(super) fn tell(
        &self,
        (old, new): (&FittedModel, &FittedModel),
        kinds: &[&str],
        evidence: &Evidence,
        scale: &[f64],
        believed: bool,
    ) {
        let robust = || self.robust(old, new, scale);
        let threshold = self.threshold(kinds.len());
        self.listener.weighed(&Weighed { kinds, evidence, robust: &robust, threshold, believed });
    }

    /// Whether the improvement is to be believed.
    pub(super) fn accepts(
        &self,
        e: &Evidence,
        mechanism: &Mechanism,
        share: f64,
        first: bool,
        allow_rare: bool,
    ) -> bool {
        let threshold = self.threshold(1);
        // An effect that acts rarely is seen in few folds: it must pay much where it acts and cost nothing
        // elsewhere, and the baseline must have shown a misfit while its segments were short.
        // (Where the residual is white, the likelihood can be taken at its word.)
        let (times, focus) =
            if e.effective_sample_ratio > WHITE && !e.whitened { (2.0, 0.7) } else { (4.0, 0.85) };
        let rare = mechanism.rare
            && allow_rare
            && e.score > times * threshold.max(15.0)
            && e.drop > if e.whitened { 0.01 } else { 0.05 }
            && e.improvement_concentration > focus;
        if rare {
            return true;
        }
        if e.whitened {
            return e.score > threshold
                && e.drop > 0.003
                && e.cross_validation_gain > 0.0015
                && e.t > 1.5
                && e.improved_fold_fraction >= 0.6;
        }
        let enough = (e.drop > 0.02 && e.cross_validation_gain > 0.01)
            || (e.effective_sample_ratio > WHITE
                && e.drop > 0.005
                && e.cross_validation_gain > 0.004
                && e.t > 2.5);
        // Of a force that never rests, each fold brings its share of the score, with a spread near its
        // square root: where the score is beyond doubt, so is t.
        if mechanism.steady && (e.t < STEADY || e.improved_fold_fraction < 0.8) {
            return false;
        }
        // Steady over the folds; or, where a few strong moments hold most of the gain, for the better in
        // nearly every fold and to no one's loss (the sign test).
        let steady = (e.t > 2.0 && e.improved_fold_fraction >= 0.6)
            || (e.t > 1.5 && e.improved_fold_fraction >= 0.8)
            || (e.improved_fold_fraction >= 0.9 && e.improvement_concentration > 0.95);
        // A second effect may be small beside the first; it must then be seen everywhere.
        let visible =
            first || share > LEAST_SHARE || (e.drop > 0.1 && e.t > 5.0 && e.improved_fold_fraction >= 0.9);
        e.score > threshold && visible && enough && steady
    }

    /// Residual sum of squares of `calibrated` at the level of `like`, in units of `scale`, its starts refitted.
    pub fn rss_at(&self, calibrated: &FittedModel, like: &FittedModel, scale: &[f64]) -> f64 {
        let mut f = calibrated.clone();
        let fixed = Setup { free: Vec::new(), ..f.setup.clone() };
        let point = fixed.stitch(&f.level, &f.fit.point, &like.level, scale);
        f.fit = fixed.fit(&like.level, scale, &[point], limits(8));
        f.level = like.level.clone();
        calibrated_rss(&f, scale)
    }

    /// The calibrated and the improved model on the search's longest windows, with one noise model, refitted.
    pub fn comparable(&self, found: &Found) -> (FittedModel, FittedModel) {
        let length = self.lengths.last().copied().unwrap_or(SHORTEST);
        let windows = self.nominal.windows(length, MOST_SAMPLES);
        let on_windows = |f: &FittedModel| {
            let mut f = f.clone();
            f.setup.noise.clone_from(&found.improved.setup.noise);
            if f.level.segments == windows.segments {
                self.refit(&f, &found.scale, 10)
            } else {
                self.relevel(&f, windows.clone(), &found.scale, 15)
            }
        };
        (on_windows(&found.calibrated), on_windows(&found.improved))
    }

    /// Residual sum of squares of a model without some of its parts (indices falling), refitted: from where it is, or
    /// from the calibrated model with a little of each part that stays. What is left of laws that hold each other up may
    /// not even be stable.
    pub fn rss_without(
        &self,
        fitted: &FittedModel,
        parts: &[usize],
        calibrated: &FittedModel,
        scale: &[f64],
    ) -> Option<f64> {
        let mut rest = self.laws(fitted);
        parts.iter().for_each(|index| drop(rest.remove(*index)));
        let n0 = self.nominal.model.parameters.len();
        let mut reduced_start = calibrated.fit.point.parameters[..n0].to_vec();
        for (candidate, values, _) in &rest {
            let linear = self.library[candidate.mechanism].linear.len();
            reduced_start
                .extend(values.iter().enumerate().map(|(i, v)| if i < linear { FAINT * v } else { *v }));
        }
        let left = self.reassembled_from(
            fitted,
            &rest,
            vec![reduced_start],
            scale,
            STEPS_WITHOUT * parts.len().min(MOST_MECHANISMS),
        )?;
        Some(raw_rss(&left, scale).iter().sum())
    }

    /// How far the score of the law that casts doubt on part `index` is above its own; `None` where none does.
    pub fn doubt(&self, fitted: &FittedModel, index: usize, scale: &[f64]) -> Option<f64> {
        let part = &fitted.parts[index].candidate;
        let kind = &self.library[part.mechanism].kind;
        let meets = |place: &Place| match (place, &part.place) {
            // A force of the motion beside one that is a force of time alone.
            (Place::Motion(motion), Place::Equation(e)) => motion.weights[*e] != 0.0,
            (place, other) => place == other,
        };
        let doubts = |c: &&Candidate| {
            meets(&c.place) && !c.mirrored && self.library[c.mechanism].doubts.contains(kind)
        };
        let doubt = self.doubts.iter().find(doubts)?;
        let base = self.without(fitted, index, scale, 12)?;
        let scored = screen(base.at(scale), self.library, std::slice::from_ref(doubt));
        let alternative = self.extend(&base, doubt, scored.first()?, scale, LAST_STEPS)?;
        // One information per sample for both: that of the residual which fits better.
        let best = if alternative.rss() < fitted.rss() { &alternative } else { fitted };
        let ratios = effective_sample_ratio(best.at(scale));
        let score = |f: &FittedModel| self.weigh_with(&base, f, scale, &ratios).score;
        Some(score(&alternative) - score(fitted))
    }
}

/// Per channel: the residual is correlated, and its innovations stand clear of the noise that fast
/// differences show and are no tiny part of it. Coloured noise has little power at high frequencies (for an
/// autoregression with a coefficient near one, innovations are twice what the differences say); a slow misfit
/// over white noise leaves innovations of just that noise.
pub fn coloured_channels(f: &FittedModel, scale: &[f64]) -> Vec<bool> {
    let noise = f.setup.innovations(&f.level, scale, &f.fit.point);
    noise
        .iter()
        .zip(&f.setup.data.sigma)
        .zip(raw_rms(f, scale).into_iter().zip(&f.fit.count))
        .map(|((a, sigma), (rms, count))| {
            let innovation = a.variance().sqrt();
            a.order() > 0
                && innovation > CLEAR * sigma
                && rms < SLOWEST * innovation
                && (*count < MEMORY_SAMPLES || is_long(*count, rms / innovation))
        })
        .collect()
}

/// Whether so many samples tell coloured noise from what a model leaves over (of fewer than [`MEMORY_SAMPLES`] nothing tells
/// a misfit either, and they are not asked): they hold [`INDEPENDENT`] correlation times.
/// Noise with a pole ρ, whose RMS is 1/√(1 − ρ²) of its innovations, remembers (1 + ρ)/(1 − ρ) samples (Bartlett): for a
/// long memory 4 times the square of that ratio.
fn is_long(samples: usize, ratio: f64) -> bool {
    samples as f64 > INDEPENDENT * 4.0 * ratio * ratio
}

/// Whether the likelihood can be taken at its word: of innovations, and of a residual that is white and no
/// larger than the noise. Anything else holds misfits that no likelihood knows of.
pub(super) fn by_likelihood(f: &FittedModel, e: &Evidence, scale: &[f64]) -> bool {
    e.whitened || f.is_white(e.effective_sample_ratio, scale)
}

/// Sum of squared innovations per channel, each model with the noise model of its own residual.
pub(super) fn innovations(f: &FittedModel, scale: &[f64]) -> Vec<f64> {
    let noise = f.setup.innovations(&f.level, scale, &f.fit.point);
    let relative = noise.iter().zip(scale).map(|(a, s)| a.variance() / (s * s));
    relative.zip(&f.fit.count).map(|(v, n)| v * *n as f64).collect()
}

/// Twice the gain in log-likelihood from one model to another, each with the noise model of its own residual.
pub fn log_likelihood_gain(old: &FittedModel, new: &FittedModel, scale: &[f64]) -> f64 {
    let (before, after) = (innovations(old, scale), innovations(new, scale));
    let ratios = before.iter().zip(&after).filter(|(b, a)| **b > 0.0 && **a > 0.0);
    ratios.zip(&new.fit.count).map(|((b, a), n)| *n as f64 * (b / a).ln()).sum()
}

/// Residual sum of squares per channel of a fitted model, not whitened, in units of `scale`.
pub fn raw_rss(fitted: &FittedModel, scale: &[f64]) -> Vec<f64> {
    let plain = Setup { noise: None, ..fitted.setup.clone() };
    plain.with_problem(&fitted.level, scale, |p| p.rss(&p.rows(&fitted.fit.point, false, None)).0)
}

/// Residual RMS per channel in SI, not whitened.
pub fn raw_rms(fitted: &FittedModel, scale: &[f64]) -> Vec<f64> {
    rms_of(&raw_rss(fitted, scale), &fitted.fit.count, scale)
}

pub(super) fn calibrated_rss(calibrated: &FittedModel, scale: &[f64]) -> f64 {
    raw_rss(calibrated, scale).iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_residual_is_noise_only_where_the_recordings_outlast_its_memory() {
        // ρ = 0.97 remembers 66 samples.
        let ratio = 1.0 / (1.0f64 - 0.97 * 0.97).sqrt();
        assert!(is_long(2000, ratio) && !is_long(700, ratio));
        // A few runs of 15 s with a residual that hardly changes within one.
        assert!(!is_long(733, 7.0));
    }
}
