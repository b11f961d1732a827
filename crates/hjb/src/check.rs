//! Checks of what a caller gives.

use nalgebra::DMatrix;

use crate::dense::is_symmetric;
use crate::error::RiccatiError;

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
