//! Rows of many windows: one dot product per window and column.

use crate::error::AlgebraicError;
use crate::kernel::{Kernel, Weights, dot};
use crate::quadrature::Hold;

/// One column of the equation: a derivative of a sampled signal.
///
/// The signal is anything known at the samples: a channel, an input, a library term such as x²x' — which is
/// also the first derivative of x³/3, and better asked for so, since no velocity is needed then.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column<'a> {
    /// The samples, one every Δt.
    pub signal: &'a [f64],
    /// Order n of the derivative that the column stands for; 0 is the signal itself.
    pub order: usize,
    /// How the samples are joined.
    pub hold: Hold,
}

/// Rows of all windows, column by column. Windows may overlap; none crosses from one piece into the next.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rows {
    /// One vector per column, each with one value per row: a design matrix in column-major order.
    pub columns: Vec<Vec<f64>>,
    /// Piece of each row.
    pub pieces: Vec<usize>,
    /// First sample of each row's window, counted within its piece.
    pub starts: Vec<usize>,
    /// Last sample of each row's window, counted within its piece.
    pub ends: Vec<usize>,
    /// Rows left out because a sample of their window is not finite (missing) in some column.
    pub dropped: usize,
}

impl Rows {
    /// Number of rows.
    pub fn len(&self) -> usize {
        self.starts.len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.starts.is_empty()
    }

    /// No rows yet, for `columns` columns.
    pub(crate) fn empty(columns: usize) -> Self {
        Self { columns: vec![Vec::new(); columns], ..Self::default() }
    }
}

/// Rows of windows of one continuous piece, one every `hop` samples.
///
/// Row k is the window that starts at sample k · hop. A window in which any column has a missing sample (NaN or
/// infinite) is dropped and counted.
///
/// # Errors
/// Those of [`Kernel::weights`]; [`AlgebraicError::Hop`], [`AlgebraicError::NoColumns`],
/// [`AlgebraicError::Lengths`], [`AlgebraicError::TooShort`], [`AlgebraicError::NoRows`].
///
/// ```
/// use greybox_algebraic::{rows, Column, Hold, Kernel};
/// // y' + 2 y = 0 from y alone, whatever y(0) is.
/// let y: Vec<f64> = (0..500).map(|k| 7.0 * (-0.02 * f64::from(k)).exp()).collect();
/// let column = |order| Column { signal: &y, order, hold: Hold::Smooth };
/// let rows = rows(&Kernel::new(1, 2, 100, 0.01)?, &[column(1), column(0)], 20)?;
/// assert!((rows.columns[0][0] / rows.columns[1][0] + 2.0).abs() < 1e-8);
/// # Ok::<(), greybox_algebraic::AlgebraicError>(())
/// ```
pub fn rows(kernel: &Kernel, columns: &[Column<'_>], hop: usize) -> Result<Rows, AlgebraicError> {
    rows_of_pieces(kernel, &[columns], hop)
}

/// Rows of several pieces (recordings, or the parts of one between gaps); see [`rows`].
///
/// Every piece has the same columns: same number, orders and holds. Pieces shorter than a window give no rows.
///
/// # Errors
/// As [`rows`], and [`AlgebraicError::ColumnsDiffer`].
pub fn rows_of_pieces<'a, P: AsRef<[Column<'a>]>>(
    kernel: &Kernel,
    pieces: &[P],
    hop: usize,
) -> Result<Rows, AlgebraicError> {
    if hop == 0 {
        return Err(AlgebraicError::Hop { what: "the hop between windows" });
    }
    check_pieces(pieces, kernel.samples())?;
    let kinds = pieces[0].as_ref();
    let weights = distinct_weights(kernel, kinds.iter().map(|c| (c.order, c.hold)))?;
    let mut rows = Rows::empty(kinds.len());
    for (piece, columns) in pieces.iter().enumerate() {
        let columns = columns.as_ref();
        let first_row = rows.len();
        for start in (0..(columns[0].signal.len() + 1).saturating_sub(kernel.samples())).step_by(hop) {
            rows.pieces.push(piece);
            rows.starts.push(start);
            rows.ends.push(start + kernel.intervals());
        }
        drop_missing(&mut rows, first_row, columns);
        for (out, (column, weights)) in rows.columns.iter_mut().zip(columns.iter().zip(weights.of_columns()))
        {
            out.extend(
                rows.starts[first_row..]
                    .iter()
                    .map(|&start| dot(weights.values(), &column.signal[start..start + kernel.samples()])),
            );
        }
    }
    if rows.is_empty() {
        return Err(AlgebraicError::NoRows { dropped: rows.dropped });
    }
    Ok(rows)
}

/// Whether the pieces have the same columns, of equal lengths, and one of them is as long as a window.
pub(crate) fn check_pieces<'a, P: AsRef<[Column<'a>]>>(
    pieces: &[P],
    samples: usize,
) -> Result<(), AlgebraicError> {
    let mut longest = 0;
    let kinds = pieces.first().map_or(&[][..], |p| p.as_ref());
    for (piece, columns) in pieces.iter().enumerate() {
        let columns = columns.as_ref();
        let expected = columns.first().ok_or(AlgebraicError::NoColumns { piece })?.signal.len();
        let same = |a: &Column<'_>, b: &Column<'_>| a.order == b.order && a.hold == b.hold;
        let agreeing = columns.iter().zip(kinds).take_while(|(a, b)| same(a, b)).count();
        if agreeing < columns.len().max(kinds.len()) {
            return Err(AlgebraicError::ColumnsDiffer { piece, column: agreeing });
        }
        if let Some(column) = columns.iter().position(|c| c.signal.len() != expected) {
            let found = columns[column].signal.len();
            return Err(AlgebraicError::Lengths { piece, column, found, expected });
        }
        longest = longest.max(expected);
    }
    if longest < samples {
        return Err(AlgebraicError::TooShort { longest, needed: samples });
    }
    Ok(())
}

/// Takes the rows from `first_row` on whose window holds a sample that is not finite out of the list.
fn drop_missing(rows: &mut Rows, first_row: usize, columns: &[Column<'_>]) {
    let mut missing: Vec<usize> = columns
        .iter()
        .flat_map(|c| c.signal.iter().enumerate().filter(|(_, y)| !y.is_finite()).map(|(k, _)| k))
        .collect();
    if missing.is_empty() {
        return;
    }
    missing.sort_unstable();
    let mut kept = first_row;
    for row in first_row..rows.len() {
        let next = missing.partition_point(|&k| k < rows.starts[row]);
        if missing.get(next).is_some_and(|&k| k <= rows.ends[row]) {
            continue;
        }
        (rows.starts[kept], rows.ends[kept]) = (rows.starts[row], rows.ends[row]);
        kept += 1;
    }
    rows.dropped += rows.len() - kept;
    rows.pieces.truncate(kept);
    rows.starts.truncate(kept);
    rows.ends.truncate(kept);
}

/// Weights of several columns, made once per kind (order, hold).
#[derive(Debug, Clone)]
pub(crate) struct DistinctWeights {
    distinct: Vec<Weights>,
    /// Which of them each column takes.
    index: Vec<usize>,
}

impl DistinctWeights {
    /// The weights column by column.
    pub(crate) fn of_columns(&self) -> impl Iterator<Item = &Weights> {
        self.index.iter().map(|&i| &self.distinct[i])
    }
}

/// The weights of columns of the given (order, hold).
pub(crate) fn distinct_weights(
    kernel: &Kernel,
    kinds: impl Iterator<Item = (usize, Hold)>,
) -> Result<DistinctWeights, AlgebraicError> {
    let mut all = DistinctWeights { distinct: Vec::new(), index: Vec::new() };
    for (order, hold) in kinds {
        let known = all.distinct.iter().position(|w| (w.order(), w.hold()) == (order, hold));
        if known.is_none() {
            all.distinct.push(kernel.weights(order, hold)?);
        }
        all.index.push(known.unwrap_or(all.distinct.len() - 1));
    }
    Ok(all)
}
