//! The Cramér–Rao bound: how well any unbiased estimator can know the parameters of a recording.
use crate::qr::{Factors, to_rows};
use nalgebra::DMatrix;

/// Why there is no bound.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BoundError {
    /// A block has another number of parameters than the first, or columns of different lengths.
    #[error("the sensitivities of output {block} have {found} {what} where {expected} are needed")]
    Shape {
        /// Index of the block.
        block: usize,
        /// `columns` or `rows`.
        what: &'static str,
        /// Number found.
        found: usize,
        /// Number needed.
        expected: usize,
    },
    /// The noise of a block is not a positive finite number.
    #[error("the noise of output {block} is {noise}: give its standard deviation, a positive number")]
    Noise {
        /// Index of the block.
        block: usize,
        /// Noise found.
        noise: f64,
    },
    /// A sensitivity is not finite.
    #[error("the sensitivity of output {block} to parameter {parameter} is {value} in row {row}")]
    NotFinite {
        /// Index of the block.
        block: usize,
        /// Index of the parameter.
        parameter: usize,
        /// Row, from 0.
        row: usize,
        /// Value found.
        value: f64,
    },
    /// Fewer samples than parameters.
    #[error("{rows} samples cannot bound {parameters} parameters")]
    TooFew {
        /// Samples.
        rows: usize,
        /// Parameters.
        parameters: usize,
    },
    /// A parameter has no effect of its own: its variance is unbounded.
    #[error(
        "parameter {parameter} acts as a combination of those before it (or not at all): it has no bound"
    )]
    NotIdentifiable {
        /// Index of the parameter.
        parameter: usize,
    },
}

/// The sensitivities of one measured output of one recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Output<'a> {
    /// ∂y/∂pⱼ at every sample, one slice per parameter.
    pub sensitivities: &'a [&'a [f64]],
    /// Standard deviation of the white measurement noise of this output, in its unit.
    pub noise: f64,
}

/// The inverse Fisher information.
#[derive(Debug, Clone, PartialEq)]
pub struct Bound {
    /// Smallest possible covariance of the parameters, by rows.
    pub covariance: Vec<Vec<f64>>,
    /// Its standard deviations.
    pub std: Vec<f64>,
    /// Its correlations, by rows: entries near ±1 say what cannot be told apart.
    pub correlation: Vec<Vec<f64>>,
}

/// The Cramér–Rao bound (Σₒ SₒᵀSₒ/σₒ²)⁻¹ for parameters seen through outputs with white Gaussian noise.
///
/// ```
/// use greybox_delay::bound::{Output, cramer_rao};
///
/// // A mean of 100 samples is known to σ/10.
/// let ones = [1.0; 100];
/// let bound = cramer_rao(&[Output { sensitivities: &[&ones], noise: 0.5 }])?;
/// assert!((bound.std[0] - 0.05).abs() < 1e-15);
/// # Ok::<(), greybox_delay::bound::BoundError>(())
/// ```
///
/// # Errors
/// Blocks that do not fit together, fewer samples than parameters, or a parameter that nothing identifies.
pub fn cramer_rao(outputs: &[Output<'_>]) -> Result<Bound, BoundError> {
    let parameters = outputs.first().map_or(0, |o| o.sensitivities.len());
    let mut rows = 0;
    for (block, output) in outputs.iter().enumerate() {
        let s = output.sensitivities;
        if s.len() != parameters {
            return Err(BoundError::Shape { block, what: "columns", found: s.len(), expected: parameters });
        }
        let expected = s.first().map_or(0, |c| c.len());
        if let Some(other) = s.iter().find(|c| c.len() != expected) {
            return Err(BoundError::Shape { block, what: "rows", found: other.len(), expected });
        }
        if !(output.noise > 0.0 && output.noise.is_finite()) {
            return Err(BoundError::Noise { block, noise: output.noise });
        }
        for (parameter, column) in s.iter().enumerate() {
            if let Some((row, &value)) = column.iter().enumerate().find(|(_, v)| !v.is_finite()) {
                return Err(BoundError::NotFinite { block, parameter, row, value });
            }
        }
        rows += expected;
    }
    if parameters == 0 || rows < parameters {
        return Err(BoundError::TooFew { rows, parameters });
    }
    let mut stacked = DMatrix::zeros(rows, parameters);
    let mut top = 0;
    for output in outputs {
        for (j, column) in output.sensitivities.iter().enumerate() {
            for (i, value) in column.iter().enumerate() {
                stacked[(top + i, j)] = value / output.noise;
            }
        }
        top += output.sensitivities.first().map_or(0, |c| c.len());
    }
    let factors = Factors::new(stacked).map_err(|d| BoundError::NotIdentifiable { parameter: d.column })?;
    let s = factors.inverse_factor();
    let covariance = to_rows(&(&s * s.transpose()));
    let (std, correlation) = standardised(&covariance);
    Ok(Bound { covariance, std, correlation })
}

/// Standard deviations and correlations of a covariance.
pub(crate) fn standardised(covariance: &[Vec<f64>]) -> (Vec<f64>, Vec<Vec<f64>>) {
    let std: Vec<f64> = (0..covariance.len()).map(|i| covariance[i][i].sqrt()).collect();
    let entry = |i: usize, j: usize| {
        let scale = std[i] * std[j];
        if i == j {
            1.0
        } else if scale > 0.0 {
            covariance[i][j] / scale
        } else {
            0.0
        }
    };
    let correlation = (0..std.len()).map(|i| (0..std.len()).map(|j| entry(i, j)).collect()).collect();
    (std, correlation)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straight_line_has_the_textbook_variance() {
        // Slope and offset of a line over t = −2..2 with noise σ: var slope = σ²/Σt², var offset = σ²/5.
        let t = [-2.0, -1.0, 0.0, 1.0, 2.0];
        let one = [1.0; 5];
        let bound = cramer_rao(&[Output { sensitivities: &[&t, &one], noise: 0.3 }]).unwrap();
        assert!((bound.covariance[0][0] - 0.09 / 10.0).abs() < 1e-15);
        assert!((bound.covariance[1][1] - 0.09 / 5.0).abs() < 1e-15);
        assert!(bound.correlation[0][1].abs() < 1e-14);
    }

    #[test]
    fn outputs_add_their_information() {
        let (a, b) = ([1.0, 2.0, 3.0], [0.5, -0.5]);
        let both = [Output { sensitivities: &[&a], noise: 0.1 }, Output { sensitivities: &[&b], noise: 0.2 }];
        let bound = cramer_rao(&both).unwrap();
        let information = 14.0 / 0.01 + 0.5 / 0.04;
        assert!((bound.std[0] - f64::sqrt(1.0 / information)).abs() < 1e-15);
    }

    #[test]
    fn what_cannot_be_bounded_says_so() {
        let a = [1.0, 2.0, 3.0];
        let twice = [2.0, 4.0, 6.0];
        let pair = cramer_rao(&[Output { sensitivities: &[&a, &twice], noise: 1.0 }]);
        assert_eq!(pair, Err(BoundError::NotIdentifiable { parameter: 1 }));
        assert!(matches!(cramer_rao(&[]), Err(BoundError::TooFew { .. })));
        let noise = cramer_rao(&[Output { sensitivities: &[&a], noise: 0.0 }]);
        assert!(matches!(noise, Err(BoundError::Noise { .. })));
        let nan = [f64::NAN, 1.0, 1.0];
        assert!(matches!(
            cramer_rao(&[Output { sensitivities: &[&nan], noise: 1.0 }]),
            Err(BoundError::NotFinite { row: 0, .. })
        ));
        let short = [1.0];
        assert!(matches!(
            cramer_rao(&[Output { sensitivities: &[&a, &short], noise: 1.0 }]),
            Err(BoundError::Shape { .. })
        ));
    }
}
