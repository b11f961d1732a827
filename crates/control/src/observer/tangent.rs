//! Observers as linear systems.

use nalgebra::DMatrix;

/// An observer's tangent: c⁺ = M c + Γ₁ u₁ + Γ₀ u₀ + N y⁺, with x̂ and d̂ = E c. Over a sample first u₁ acts, then u₀.
pub(crate) struct Tangent {
    pub(crate) carry: DMatrix<f64>,
    pub(crate) older: DMatrix<f64>,
    pub(crate) newer: DMatrix<f64>,
    pub(crate) measured: DMatrix<f64>,
    pub(crate) estimate: DMatrix<f64>,
}

/// The state when the next command will act, as a linear function.
pub(crate) struct Prediction {
    /// Of the estimated state.
    pub(crate) state: DMatrix<f64>,
    /// Of the estimated disturbance.
    pub(crate) disturbance: DMatrix<f64>,
    /// Of the last commands, the latest first.
    pub(crate) commands: Vec<DMatrix<f64>>,
}
