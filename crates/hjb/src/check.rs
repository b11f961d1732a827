//! Checks of what a caller gives.

use nalgebra::DMatrix;

use crate::dense::is_symmetric;
use crate::error::{HjbError, RiccatiError};
use crate::range::InputRange;

pub(crate) fn shape(
    matrix: &'static str,
    m: &DMatrix<f64>,
    wanted_rows: usize,
    wanted_columns: usize,
) -> Result<(), RiccatiError> {
    let (rows, columns) = m.shape();
    if (rows, columns) == (wanted_rows, wanted_columns) {
        Ok(())
    } else {
        Err(RiccatiError::Shape { matrix, rows, columns, wanted_rows, wanted_columns })
    }
}

/// The order of a square matrix.
pub(crate) fn square(matrix: &'static str, m: &DMatrix<f64>) -> Result<usize, RiccatiError> {
    shape(matrix, m, m.nrows(), m.nrows()).map(|()| m.nrows())
}

pub(crate) fn finite(matrix: &'static str, m: &DMatrix<f64>) -> Result<(), RiccatiError> {
    match m.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(at) => {
            let (row, column) = (at % m.nrows() + 1, at / m.nrows() + 1);
            Err(RiccatiError::NotFinite { matrix, row, column, value: m.as_slice()[at] })
        }
    }
}

pub(crate) fn symmetric(matrix: &'static str, m: &DMatrix<f64>) -> Result<(), RiccatiError> {
    if is_symmetric(m) { Ok(()) } else { Err(RiccatiError::NotSymmetric { matrix }) }
}

/// One range for each input, and no limit where `factor`, the Cholesky factor of R, couples inputs.
pub(crate) fn ranges(ranges: &[InputRange], factor: &DMatrix<f64>) -> Result<(), HjbError> {
    let inputs = factor.nrows();
    if ranges.len() != inputs {
        return Err(HjbError::Size { what: "the list of ranges", found: ranges.len(), wanted: inputs });
    }
    let coupled = (0..inputs).any(|j| (j + 1..inputs).any(|i| factor[(i, j)] != 0.0));
    if coupled && ranges.iter().any(InputRange::is_limited) { Err(HjbError::CoupledInputs) } else { Ok(()) }
}
