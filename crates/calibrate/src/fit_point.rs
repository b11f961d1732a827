//! Where a model is evaluated.

use crate::problem::Point;
use crate::setup::{Segmentation, Setup};

/// Where a model is evaluated: on these segments, at this point of its parameters and starts, its residuals in units of this
/// scale (SI, one for each channel).
#[derive(Clone, Copy)]
pub struct FitPoint<'a> {
    /// Model, data, free parameters.
    pub setup: &'a Setup,
    /// The segments.
    pub level: &'a Segmentation,
    /// Residual scale per channel, SI.
    pub scale: &'a [f64],
    /// Values of the parameters and of the segments' starts.
    pub point: &'a Point,
}
