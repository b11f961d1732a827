//! Rows while the samples arrive.

use crate::error::AlgebraicError;
use crate::kernel::{Kernel, dot};
use crate::quadrature::Hold;
use crate::windows::{DistinctWeights, distinct_weights};

/// One column of a stream: a derivative of one of its signals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Term {
    /// Index of the signal in the samples that are pushed.
    pub signal: usize,
    /// Order n of the derivative.
    pub order: usize,
    /// How the samples are joined.
    pub hold: Hold,
}

/// Makes the rows of [`rows`](crate::rows) one sample at a time, to the last bit the same.
///
/// Memory is two windows per signal; a push allocates nothing and costs one dot product per term at the end of
/// a window, and two stores per signal otherwise.
///
/// ```
/// use greybox_algebraic::{Hold, Kernel, Stream, Term};
/// let terms = [1, 0].map(|order| Term { signal: 0, order, hold: Hold::Smooth });
/// let mut stream = Stream::new(&Kernel::new(1, 2, 100, 0.01)?, 1, &terms, 20)?;
/// let mut row = [0.0; 2];
/// let mut rates = Vec::new();
/// for k in 0..500 {
///     if stream.push(&[7.0 * (-0.02 * f64::from(k)).exp()], &mut row)?.is_some() {
///         rates.push(row[0] / row[1]);
///     }
/// }
/// assert!(rates.len() == 20 && rates.iter().all(|r| (r + 2.0).abs() < 1e-8));
/// # Ok::<(), greybox_algebraic::AlgebraicError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Stream {
    terms: Vec<Term>,
    weights: DistinctWeights,
    /// Per signal the last window twice, one behind the other, so that it is always found in one slice.
    rings: Vec<Vec<f64>>,
    samples: usize,
    hop: usize,
    /// Place in the ring of the next sample.
    place: usize,
    /// Samples pushed since the start or the last reset.
    pushed: usize,
    /// Samples pushed since a missing one.
    unbroken: usize,
    /// Samples until the next window ends.
    wait: usize,
}

impl Stream {
    /// A stream of `signals` signals; `terms` are the columns of its rows, one row every `hop` samples.
    ///
    /// # Errors
    /// Those of [`Kernel::weights`]; [`AlgebraicError::Hop`], [`AlgebraicError::NoColumns`],
    /// [`AlgebraicError::Signal`].
    pub fn new(kernel: &Kernel, signals: usize, terms: &[Term], hop: usize) -> Result<Self, AlgebraicError> {
        if hop == 0 {
            return Err(AlgebraicError::Hop { what: "the hop between windows" });
        }
        if terms.is_empty() {
            return Err(AlgebraicError::NoColumns { piece: 0 });
        }
        if let Some(term) = terms.iter().position(|t| t.signal >= signals) {
            return Err(AlgebraicError::Signal { term, signal: terms[term].signal, signals });
        }
        let samples = kernel.samples();
        Ok(Self {
            terms: terms.to_vec(),
            weights: distinct_weights(kernel, terms.iter().map(|t| (t.order, t.hold)))?,
            rings: vec![vec![0.0; 2 * samples]; signals],
            samples,
            hop,
            place: 0,
            pushed: 0,
            unbroken: 0,
            wait: samples,
        })
    }

    /// Takes one sample of every signal. When a window ends with it, fills `row` with one value per term and
    /// returns the window's first sample, counted from the start or the last [`reset`](Self::reset).
    ///
    /// A window with a sample that is not finite in a signal that some term uses gives no row.
    ///
    /// # Errors
    /// [`AlgebraicError::SliceLength`] when `sample` or `row` has the wrong length; nothing is taken then.
    pub fn push(&mut self, sample: &[f64], row: &mut [f64]) -> Result<Option<usize>, AlgebraicError> {
        let expect = |what, found, expected| match found == expected {
            true => Ok(()),
            false => Err(AlgebraicError::SliceLength { what, found, expected }),
        };
        expect("the sample", sample.len(), self.rings.len())?;
        expect("the row", row.len(), self.terms.len())?;
        for (ring, &y) in self.rings.iter_mut().zip(sample) {
            ring[self.place] = y;
            ring[self.place + self.samples] = y;
        }
        let finite = self.terms.iter().all(|t| sample[t.signal].is_finite());
        self.unbroken = if finite { self.unbroken.saturating_add(1) } else { 0 };
        self.place = (self.place + 1) % self.samples;
        self.pushed += 1;
        self.wait -= 1;
        if self.wait > 0 {
            return Ok(None);
        }
        self.wait = self.hop;
        if self.unbroken < self.samples {
            return Ok(None);
        }
        // The oldest sample stands at `place`; the window is the slice that starts there.
        for ((out, term), weights) in row.iter_mut().zip(&self.terms).zip(self.weights.of_columns()) {
            let window = &self.rings[term.signal][self.place..self.place + self.samples];
            *out = dot(weights.values(), window);
        }
        Ok(Some(self.pushed - self.samples))
    }

    /// Forgets the samples: after a gap, the next sample begins a new piece.
    pub fn reset(&mut self) {
        (self.place, self.pushed, self.unbroken, self.wait) = (0, 0, 0, self.samples);
    }
}
