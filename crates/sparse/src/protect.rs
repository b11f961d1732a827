//! Protected columns: the terms that must stay.

use crate::error::SparseError;

/// Ascending and each once.
pub(crate) fn checked(protected: &[usize], columns: usize) -> Result<Vec<usize>, SparseError> {
    let mut out = protected.to_vec();
    out.sort_unstable();
    out.dedup();
    match out.last() {
        Some(&column) if column >= columns => Err(SparseError::NoSuchColumn { column, columns }),
        _ => Ok(out),
    }
}
