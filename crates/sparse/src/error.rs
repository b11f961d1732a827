//! What can be wrong with a regression's input.

use thiserror::Error;

/// Why a sparse regression could not be done. Every variant says what to change.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SparseError {
    /// A column, target or option list has the wrong length.
    #[error("{what} has {found} entries where {expected} are needed")]
    Length {
        /// What was counted, as `column 3` or `term x*x'`.
        what: String,
        /// The length found.
        found: usize,
        /// The length needed.
        expected: usize,
    },
    /// A value is NaN or infinite.
    #[error("{what} is not finite in row {row}: drop that row (or leave a gap there) before the regression")]
    NotFinite {
        /// The column, target, variable or term.
        what: String,
        /// Row counted from 0.
        row: usize,
    },
    /// There are no rows, columns, orders or λ to work on.
    #[error("there are no {what}: give at least one")]
    Empty {
        /// What is missing.
        what: &'static str,
    },
    /// A set of rows holds too few of them for what is asked.
    #[error(
        "{what} has {found} rows, but at least {needed} are needed: use fewer parts, a smaller gap or a longer recording"
    )]
    TooFewRows {
        /// The set of rows, as `fold 2` or `the test rows`.
        what: String,
        /// Rows found.
        found: usize,
        /// Rows needed.
        needed: usize,
    },
    /// A range of rows lies outside the data, is empty or overlaps its neighbour.
    #[error(
        "the row range {start}..{end} is empty, overlaps its predecessor or passes the last of {rows} rows: give ascending, separate, non-empty ranges"
    )]
    RowRange {
        /// First row of the range.
        start: usize,
        /// One past the last row.
        end: usize,
        /// Rows there are.
        rows: usize,
    },
    /// A column index is outside the columns there are.
    #[error("column {column} does not exist: there are {columns} columns, counted from 0")]
    NoSuchColumn {
        /// The index found.
        column: usize,
        /// The number of columns.
        columns: usize,
    },
    /// Columns that must be in the model are linearly dependent.
    #[error(
        "column {column} must stay in the model but is zero or a linear combination of the columns before it (what is left of it: {relative:.1e} of its norm): remove or merge it, or excite the system further"
    )]
    RankDeficient {
        /// The dependent column.
        column: usize,
        /// ‖column − projection‖ / ‖column‖.
        relative: f64,
    },
    /// A Gram matrix is too ill-conditioned for a Cholesky factorisation; use the rows.
    #[error(
        "the Gram matrix loses column {column} to rounding (relative pivot {pivot:.1e}): factorise the rows by QR instead"
    )]
    IllConditioned {
        /// The column whose pivot vanished.
        column: usize,
        /// Pivot divided by the column's squared norm.
        pivot: f64,
    },
    /// No model of a grid has a finite error on the rows that judge it.
    #[error("the sums of squares overflow: state the columns and the target in larger units")]
    Overflow,
    /// The target is zero in every row.
    #[error("the target is zero in every row: nothing is to be explained")]
    ZeroTarget,
    /// An option has a value outside its range.
    #[error("option {name} is {found}: it must be {expected}")]
    Option {
        /// The option's name.
        name: &'static str,
        /// The value found.
        found: f64,
        /// The range or kind needed.
        expected: &'static str,
    },
    /// An expression named by a library has no values.
    #[error("no values were given for the expression '{name}' of the library")]
    UnknownExpression {
        /// The expression's name.
        name: String,
    },
    /// Exhaustive search over too many columns.
    #[error(
        "best subset over {optional} optional columns is too many (at most {most}): use backward elimination"
    )]
    TooManyColumns {
        /// Optional columns asked for.
        optional: usize,
        /// The most allowed.
        most: usize,
    },
}

/// `Ok` if `value` is finite and within `[low, high]`.
pub(crate) fn check_range(
    name: &'static str,
    value: f64,
    low: f64,
    high: f64,
    expected: &'static str,
) -> Result<(), SparseError> {
    if value.is_finite() && value >= low && value <= high {
        Ok(())
    } else {
        Err(SparseError::Option { name, found: value, expected })
    }
}
