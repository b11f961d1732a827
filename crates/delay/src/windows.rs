//! From sampled signals to the rows of a delay regression: window integrals of both sides of the equation.
//!
//! A window integral ∫w(s) φ(t+s) ds commutes with a shift in time, so the integral of x(t − τ) is the integral of x,
//! τ earlier. It is computed once at every sample; a column for any τ is then read off it.
use crate::exact::{self, ExactError};
use greybox_algebraic::{AlgebraicError, Column, Hold, Kernel};

/// Why there are no rows.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum WindowsError {
    /// The kernel does not fit the signals.
    #[error(transparent)]
    Algebraic(#[from] AlgebraicError),
    /// A signal has another length than the delayed one.
    #[error("{what} has {found} samples where the delayed signal has {expected}")]
    Length {
        /// Which signal.
        what: &'static str,
        /// Samples found.
        found: usize,
        /// Samples needed.
        expected: usize,
    },
    /// The delayed signal has missing samples.
    #[error("the delayed signal misses samples in {windows} windows: cut the recording there")]
    Missing {
        /// Windows with a missing sample.
        windows: usize,
    },
    /// There is no known right-hand side.
    #[error(
        "the right-hand side has no term: a delay regression needs a known force (zeros if there is none)"
    )]
    NoTarget,
}

/// What the delayed signal was before its first sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Before {
    /// Nobody knows: rows that reach back further are dropped.
    Unknown,
    /// Its first sample held, for up to this long, s (at least the longest delay searched).
    Held(f64),
}

/// The rows of one recording, ready for [`exact::fit`].
#[derive(Debug, Clone, PartialEq)]
pub struct Windowed {
    target: Vec<f64>,
    columns: Vec<Vec<f64>>,
    delayed: Vec<f64>,
    places: Vec<usize>,
    dt: f64,
    overlap: usize,
}

impl Windowed {
    /// Windows of `kernel` every `hop` samples over one gapless recording.
    ///
    /// `target` is the sum of the known terms on the right side, each with its factor; `columns` are the unknown
    /// terms on the left; `delayed` is the signal that acts late, joined between its samples as `hold` says.
    ///
    /// # Errors
    /// No target, signals of different lengths, a window that does not fit or a kernel that cannot integrate an
    /// order away.
    pub fn new(
        kernel: &Kernel,
        hop: usize,
        target: &[(f64, Column<'_>)],
        columns: &[Column<'_>],
        delayed: &[f64],
        hold: Hold,
        before: Before,
    ) -> Result<Self, WindowsError> {
        if target.is_empty() {
            return Err(WindowsError::NoTarget);
        }
        let expected = delayed.len();
        let length = |what, signal: &[f64]| {
            let found = signal.len();
            if found == expected { Ok(()) } else { Err(WindowsError::Length { what, found, expected }) }
        };
        target.iter().try_for_each(|(_, c)| length("a known term", c.signal))?;
        columns.iter().try_for_each(|c| length("a column", c.signal))?;
        let all: Vec<Column<'_>> = target.iter().map(|(_, c)| *c).chain(columns.iter().copied()).collect();
        let rows = greybox_algebraic::rows(kernel, &all, hop)?;
        let (known, unknown) = rows.columns.split_at(target.len());
        let mut sum = vec![0.0; rows.starts.len()];
        for ((factor, _), column) in target.iter().zip(known) {
            sum.iter_mut().zip(column).for_each(|(s, c)| *s += factor * c);
        }
        let padding = match before {
            Before::Unknown => 0,
            // Two samples more, for the spline's end.
            Before::Held(past) => (past.max(0.0) / kernel.dt()).ceil().min(1e9) as usize + 2,
        };
        let first = delayed.first().copied().unwrap_or(0.0);
        let padded: Vec<f64> = std::iter::repeat_n(first, padding).chain(delayed.iter().copied()).collect();
        let every = greybox_algebraic::rows(kernel, &[Column { signal: &padded, order: 0, hold }], 1)?;
        if every.dropped > 0 {
            return Err(WindowsError::Missing { windows: every.dropped });
        }
        let delayed = every.columns.into_iter().next().unwrap_or_default();
        Ok(Self {
            target: sum,
            columns: unknown.to_vec(),
            delayed,
            places: rows.starts.iter().map(|s| s + padding).collect(),
            dt: kernel.dt(),
            overlap: kernel.intervals().div_ceil(hop.max(1)),
        })
    }

    /// The rows as [`exact::fit`] takes them.
    #[must_use]
    pub fn rows(&self) -> exact::Rows<'_> {
        exact::Rows {
            target: &self.target,
            columns: &self.columns,
            delayed: &self.delayed,
            places: &self.places,
            dt: self.dt,
        }
    }

    /// Over how many rows residuals are correlated because windows share samples: twice the rows of one window, for
    /// [`exact::Options::correlated_rows`].
    #[must_use]
    pub fn correlated_rows(&self) -> usize {
        2 * self.overlap
    }
}

/// [`exact::fit`] on windowed recordings, with the bandwidth of their overlap.
///
/// # Errors
/// As [`exact::fit`].
pub fn fit(recordings: &[Windowed], options: &exact::Options) -> Result<exact::Fit, ExactError> {
    let rows: Vec<exact::Rows<'_>> = recordings.iter().map(Windowed::rows).collect();
    let overlap = recordings.iter().map(Windowed::correlated_rows).max().unwrap_or(0);
    let options = exact::Options { correlated_rows: options.correlated_rows.max(overlap), ..*options };
    exact::fit(&rows, &options)
}
