//! Why a regression could not be set up or solved.

/// Why a regression could not be set up or solved. Rows and columns are counted from 0.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SparseError {
    /// A column, a target or a residual has the wrong length.
    #[error("{what} has {found} rows, expected {expected}; cut all to the same rows")]
    Length {
        /// Which slice.
        what: String,
        /// Its length.
        found: usize,
        /// The length of the others.
        expected: usize,
    },
    /// A value is NaN or infinite.
    #[error("{what}, row {row}: the value is {value}; leave out rows that are not finite")]
    NotFinite {
        /// Which slice.
        what: String,
        /// The first bad row.
        row: usize,
        /// What stands there.
        value: f64,
    },
    /// There are no rows, no columns, or nothing but zeros where numbers are needed.
    #[error("{what} is empty; {mend}")]
    Empty {
        /// What is empty.
        what: String,
        /// What to do about it.
        mend: &'static str,
    },
    /// A column number does not exist.
    #[error("{what} names column {column}, but there are {columns} columns (0 to {})", columns.saturating_sub(1))]
    NoSuchColumn {
        /// Who names it.
        what: &'static str,
        /// The number.
        column: usize,
        /// How many columns there are.
        columns: usize,
    },
    /// A range of rows lies outside the data or is reversed.
    #[error("rows {start}..{end} do not exist: there are {rows} rows")]
    NoSuchRows {
        /// First row of the range.
        start: usize,
        /// One after the last row of the range.
        end: usize,
        /// How many rows there are.
        rows: usize,
    },
    /// The column depends linearly on the other ones, so its coefficient is not determined.
    #[error(
        "column {column} is a linear combination of the columns {others:?} on these rows; leave it out or excite the system more richly"
    )]
    RankDeficient {
        /// The dependent column.
        column: usize,
        /// The other columns of the model.
        others: Vec<usize>,
    },
    /// Fewer rows than unknowns.
    #[error("{rows} rows cannot determine {unknowns} coefficients; take more rows or fewer columns")]
    TooFewRows {
        /// How many rows.
        rows: usize,
        /// How many coefficients.
        unknowns: usize,
    },
    /// The rows cannot be divided as asked.
    #[error(
        "{rows} rows cannot be divided into {folds} folds with a gap of {gap} rows; take fewer folds or a smaller gap"
    )]
    Folds {
        /// How many rows.
        rows: usize,
        /// How many folds were asked for.
        folds: usize,
        /// Rows dropped between folds.
        gap: usize,
    },
    /// An option lies outside its range.
    #[error("{name} = {value}, expected {expected}")]
    Option {
        /// The option.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The values allowed.
        expected: &'static str,
    },
    /// Exhaustive search over too many columns.
    #[error("exhaustive search over {found} optional columns (at most {limit}); use backward elimination")]
    TooManyColumns {
        /// Optional columns found.
        found: usize,
        /// The limit.
        limit: usize,
    },
    /// A term names a user function for which no values were given.
    #[error("term {term}: no values were given for the function `{name}`; pass them as (name, values)")]
    NoUserValues {
        /// The term as text.
        term: String,
        /// The function's name.
        name: String,
    },
    /// An iteration did not reach its tolerance.
    #[error("LASSO at lambda = {lambda:e}: duality gap {gap:e} after {sweeps} sweeps; take a larger lambda")]
    NotConverged {
        /// The penalty.
        lambda: f64,
        /// The relative duality gap reached.
        gap: f64,
        /// Sweeps done.
        sweeps: usize,
    },
}
