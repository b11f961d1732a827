//! Where a model is evaluated.

use crate::problem::Point;
use crate::setup::{Segmentation, Setup};

/// Where a model is evaluated: its residuals are r = (y − ŷ(x₀, p))/scale for the parameters p and the starts x₀ of a point, each
/// segment simulated from its own start.
#[derive(Clone, Copy)]
pub struct FitPoint<'a> {
    /// Model, data, free parameters.
    pub setup: &'a Setup,
    /// The segments.
    pub level: &'a Segmentation,
    /// Residual scale, one for each channel, SI.
    pub scale: &'a [f64],
    /// p, all of the model's, and x₀, one state for each segment, SI.
    pub point: &'a Point,
}
