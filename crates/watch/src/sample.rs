//! What comes in.

use serde::{Deserialize, Serialize};

/// A sample, SI, in the model's order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Sample {
    pub(crate) t: f64,
    pub(crate) inputs: Vec<f64>,
    /// What is no number was not measured.
    pub(crate) measured: Vec<Option<f64>>,
}
