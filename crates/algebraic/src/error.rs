//! Why a kernel, a row or a stream cannot be made: what was found, what is needed, the fix.

/// Why a kernel, its weights, the rows of a recording or a stream cannot be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum AlgebraicError {
    /// The sampling step is not a positive, finite number.
    #[error("the sampling step is {dt} s; give the positive time between two samples")]
    Step {
        /// The step that was given, s.
        dt: f64,
    },
    /// The equation is not integrated at all, so that no derivative can be removed.
    #[error("the equation is integrated 0 times; a kernel needs at least one integration")]
    NoIntegration,
    /// The polynomial kernel is of a higher degree than its factors can be told apart in double precision.
    #[error(
        "{s_derivatives} derivatives by s and {integrations} integrations make a kernel of degree {degree}; the \
         highest degree is {highest}: take fewer of both (one more than the highest derivative of the equation \
         is enough)"
    )]
    Degree {
        /// Number of derivatives by s, r.
        s_derivatives: usize,
        /// Number of integrations, q.
        integrations: usize,
        /// r + q − 1.
        degree: usize,
        /// The highest degree allowed.
        highest: usize,
    },
    /// The window has too few steps for the derivative and the way the samples are joined.
    #[error(
        "a window of {intervals} steps is too short for a derivative of order {order}: it needs {needed} steps; \
         lengthen the window"
    )]
    Window {
        /// Steps in the window that was given.
        intervals: usize,
        /// Order of the derivative.
        order: usize,
        /// The fewest steps that will do.
        needed: usize,
    },
    /// Initial conditions enter the integral and are not known (erratum E13 of the thesis's Eq 3.10).
    #[error(
        "a derivative of order {order} keeps its initial conditions when the equation is differentiated \
         {s_derivatives} times by s: take {order} derivatives{}",
        if *order == s_derivatives + 1 { ", or take the value at the start from the first sample" } else { "" }
    )]
    InitialConditions {
        /// Order of the derivative, n.
        order: usize,
        /// Number of derivatives by s, r < n.
        s_derivatives: usize,
    },
    /// Derivatives at the end of the window enter the integral and are not measured.
    #[error(
        "a derivative of order {order} is not removed by {integrations} integrations: integrate at least {order} \
         times ({} keep the raw last sample out as well)",
        order + 1
    )]
    EndDerivatives {
        /// Order of the derivative, n.
        order: usize,
        /// Number of integrations, q < n.
        integrations: usize,
    },
    /// The step between rows is zero.
    #[error("{what} is 0 samples: rows would repeat for ever; give at least 1")]
    Hop {
        /// Which of the steps: `the hop between windows`, `the step between rows`.
        what: &'static str,
    },
    /// No column was asked for.
    #[error("piece {piece} has no columns: give at least one signal")]
    NoColumns {
        /// Index of the piece.
        piece: usize,
    },
    /// Pieces differ in the number of columns, or a column differs in order or hold from the first piece's.
    #[error(
        "column {column} of piece {piece} is not the column {column} of the first piece (number, order or hold \
         differ): give every piece the same columns"
    )]
    ColumnsDiffer {
        /// Index of the piece.
        piece: usize,
        /// Index of the first column that differs.
        column: usize,
    },
    /// The signals of one piece have different lengths.
    #[error(
        "column {column} of piece {piece} has {found} samples where column 0 has {expected}: give signals on the \
         same time grid"
    )]
    Lengths {
        /// Index of the piece.
        piece: usize,
        /// Index of the column.
        column: usize,
        /// Its samples.
        found: usize,
        /// Samples of column 0.
        expected: usize,
    },
    /// No piece is as long as one window.
    #[error("the longest piece has {longest} samples and one window needs {needed}: shorten the window")]
    TooShort {
        /// Samples of the longest piece, 0 when there is none.
        longest: usize,
        /// Samples of one window.
        needed: usize,
    },
    /// Every row touches a sample that is missing.
    #[error(
        "each of the {dropped} rows touches a missing sample: shorten the window or repair the recording"
    )]
    NoRows {
        /// Number of rows that would have been there.
        dropped: usize,
    },
    /// A term of a stream names a signal that is not there.
    #[error("term {term} names signal {signal}, but the stream has {signals} signals counted from 0")]
    Signal {
        /// Index of the term.
        term: usize,
        /// The signal that it names.
        signal: usize,
        /// Number of signals.
        signals: usize,
    },
    /// A slice given to a stream, or to weights, has the wrong length.
    #[error("{what} has {found} values where {expected} are needed")]
    SliceLength {
        /// Which slice.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length needed.
        expected: usize,
    },
}
