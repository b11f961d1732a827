//! A model with mechanisms, fitted, and what a search found.

use greybox_calibrate::{Fit, FitPoint, Segmentation, Setup};
use greybox_model::{Hold, Model};

use crate::candidate::{Candidate, Instance};
use crate::evidence::{Evidence, least_effective_sample_ratio};

/// Residual over noise from which a fit may be stuck.
pub(crate) const STUCK: f64 = 1.2;
/// Information per sample from which a residual counts as white.
pub(crate) const WHITE: f64 = 0.8;

/// A mechanism in a model, with the sizes its inner parameters are searched at.
#[derive(Debug, Clone, PartialEq)]
pub struct MechanismTerm {
    /// What and where.
    pub candidate: Candidate,
    /// As it stands in the model.
    pub instance: Instance,
    /// Sizes of the inner parameters.
    pub scales: Vec<f64>,
}

/// A law at a place, the values of its parameters, and the sizes of the inner ones.
pub(crate) type Law = (Candidate, Vec<f64>, Vec<f64>);

/// Whether two models have the same parts, in whatever order.
pub(crate) fn is_same(a: &[Candidate], b: &[Candidate]) -> bool {
    a.len() == b.len() && a.iter().all(|c| b.contains(c))
}

/// The laws of a model with the values that its parameters give them.
pub(crate) fn laws(parts: &[MechanismTerm], model: &Model, parameters: &[f64]) -> Vec<Law> {
    let value = |name: &String| model.parameter(name).map(|i| parameters[i]);
    let law = |part: &MechanismTerm| {
        let values = part.instance.names.iter().filter_map(value).collect();
        (part.candidate.clone(), values, part.scales.clone())
    };
    parts.iter().map(law).collect()
}

/// A model fitted at a level.
#[derive(Debug, Clone)]
pub struct FittedModel {
    /// Model, data, free parameters.
    pub setup: Setup,
    /// Mechanisms beyond the nominal equations.
    pub parts: Vec<MechanismTerm>,
    /// The segments.
    pub level: Segmentation,
    /// The fit; its `rss` is in units of the scale it was fitted with.
    pub fit: Fit,
}

impl FittedModel {
    /// Where it was fitted.
    pub fn at<'a>(&'a self, scale: &'a [f64]) -> FitPoint<'a> {
        FitPoint { setup: &self.setup, level: &self.level, scale, point: &self.fit.point }
    }

    /// Residual sum of squares over all channels, in units of the fit's scale.
    pub(crate) fn rss(&self) -> f64 {
        self.fit.rss.iter().sum()
    }

    /// Largest residual RMS over the noise.
    pub fn misfit(&self, scale: &[f64]) -> f64 {
        rms(&self.fit, scale).iter().zip(&self.setup.data.sigma).map(|(r, s)| r / s).fold(0.0, f64::max)
    }

    /// Whether a residual with this ratio of independent samples is white, and no larger than the noise.
    pub(crate) fn is_white(&self, effective_sample_ratio: f64, scale: &[f64]) -> bool {
        effective_sample_ratio > WHITE && self.misfit(scale) < STUCK
    }

    /// Whether nothing is left over but white noise, for which no noise model had to stand in.
    pub fn leaves_white_noise(&self, scale: &[f64]) -> bool {
        self.setup.noise.is_none() && self.is_white(least_effective_sample_ratio(self.at(scale)), scale)
    }
}

/// What was tried beside an accepted mechanism.
#[derive(Debug, Clone)]
pub struct AlternativeTerm {
    /// What and where.
    pub candidate: Candidate,
    /// As it would stand in the model.
    pub instance: Instance,
    /// Its evidence.
    pub evidence: Evidence,
    /// The data cannot separate it from the accepted one.
    pub equivalent: bool,
}

/// An accepted mechanism with the evidence for it.
#[derive(Debug, Clone)]
pub struct SelectedTerm {
    /// What and where.
    pub candidate: Candidate,
    /// Evidence when it was accepted.
    pub evidence: Evidence,
    /// The others of that round.
    pub alternatives: Vec<AlternativeTerm>,
}

/// Result of the search.
pub struct Found {
    /// The nominal equations with fitted parameters, at the last level.
    pub calibrated: FittedModel,
    /// With the mechanisms.
    pub improved: FittedModel,
    /// Evidence for each part of `improved`, in the same order.
    pub accepted: Vec<SelectedTerm>,
    /// Holds that explain the recording better than the stated ones: (input, stated, better).
    pub better_holds: Vec<(usize, Hold, Hold)>,
    /// Residual scale of the improved model per channel, SI.
    pub scale: Vec<f64>,
    /// The work ran out before the search had come to its end.
    pub limited: bool,
    /// With the best single candidate, and the best pair, of the last round that found nothing to be believed.
    pub rejected: Vec<FittedModel>,
    /// The mechanisms are believed beside an error of the model, by their posterior probability.
    pub errs: bool,
    /// The improved model is a closure: a sum of terms that is proposed as a whole.
    pub closed: bool,
}

/// Residual RMS per channel in SI.
pub fn rms(fit: &Fit, scale: &[f64]) -> Vec<f64> {
    rms_of(&fit.rss, &fit.count, scale)
}

pub(crate) fn rms_of(rss: &[f64], count: &[usize], scale: &[f64]) -> Vec<f64> {
    rss.iter().zip(count).zip(scale).map(|((r, n), s)| s * (r / (*n).max(1) as f64).sqrt()).collect()
}

/// The scale for the next comparison: the model's own residual, never below 0.7 of the noise.
pub fn next_scale(fit: &Fit, scale: &[f64], sigma: &[f64]) -> Vec<f64> {
    rms(fit, scale).iter().zip(sigma).map(|(r, s)| r.max(0.7 * s)).collect()
}
