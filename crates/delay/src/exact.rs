//! The delay itself as an unknown: regression with x(t − τ) as a column, τ by variable projection.
//!
//! ```text
//! Σⱼ cⱼ φⱼ(t) + g x(t − τ) = f(t)
//! ```
//!
//! is linear but for τ. For every τ the coefficients (and g, if it is free) follow by least squares; what is left,
//! RSS(τ), is scanned over a grid and its deepest minima are refined by Gauss–Newton steps on the variable
//! projection functional (G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10, 1973, in Kaufman's form, whose gradient
//! is exact), halved until they descend. No Taylor expansion, so no truncation error.
//!
//! Both sides may first go through any operation that commutes with a shift in time, above all a window integral
//! ∫w(s) φ(t+s) ds: then `delayed` is that integral of x at *every* sample, and the column for a delay is read off
//! it by a spline, the derivative with respect to τ too. The rows need not be as dense.
//!
//! Least squares takes the columns as free of noise. Noise on x biases τ: windows make the bias small, the refined
//! fit of a simulation removes it.
use crate::bound::standardised;
use crate::qr::{Factors, dot, to_rows};
use crate::spline::Spline;
use nalgebra::DMatrix;

/// Why there is no estimate.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ExactError {
    /// No recording was given.
    #[error("no recording was given: a delay is estimated from at least one")]
    NoRecording,
    /// The sampling interval is not a positive finite number.
    #[error("recording {recording} has the sampling interval {dt} s: it must be positive")]
    Sampling {
        /// Index of the recording.
        recording: usize,
        /// Interval, s.
        dt: f64,
    },
    /// Lengths or numbers of columns do not agree.
    #[error("recording {recording} has {found} {what} where {expected} are needed")]
    Shape {
        /// Index of the recording.
        recording: usize,
        /// What does not agree.
        what: &'static str,
        /// Number found.
        found: usize,
        /// Number needed.
        expected: usize,
    },
    /// A value is not finite.
    #[error(
        "recording {recording} has a value in {what} that is not finite, at row {row}: drop such rows first"
    )]
    NotFinite {
        /// Index of the recording.
        recording: usize,
        /// Where: `target`, `columns` or `delayed`.
        what: &'static str,
        /// Row (sample for `delayed`), from 0.
        row: usize,
    },
    /// A row stands at a sample that `delayed` does not have.
    #[error(
        "row {row} of recording {recording} stands at sample {place} of a delayed signal of {samples} samples"
    )]
    Place {
        /// Index of the recording.
        recording: usize,
        /// Row, from 0.
        row: usize,
        /// Its sample.
        place: usize,
        /// Samples of the delayed signal.
        samples: usize,
    },
    /// Rows are not in the order of time.
    #[error("row {row} of recording {recording} stands before the row above it: rows must follow time")]
    Order {
        /// Index of the recording.
        recording: usize,
        /// Row, from 0.
        row: usize,
    },
    /// The range of delays or its grid is empty.
    #[error(
        "delays from {from} to {to} s in {grid} values are no range: give 0 ≤ from < to and at least 3 values"
    )]
    Range {
        /// Smallest delay, s.
        from: f64,
        /// Largest delay, s.
        to: f64,
        /// Values of the grid.
        grid: usize,
    },
    /// The known gain is zero or not finite.
    #[error("a feedback gain of {gain} carries no information on its delay")]
    Gain {
        /// The gain.
        gain: f64,
    },
    /// Too few rows remain after those without enough past are dropped.
    #[error(
        "{rows} rows remain for {unknowns} unknowns once those without {to} s of past are dropped: use longer \
         recordings or shorter delays"
    )]
    TooFewRows {
        /// Rows that remain.
        rows: usize,
        /// Unknowns.
        unknowns: usize,
        /// Largest delay, s.
        to: f64,
    },
    /// A column is a combination of others.
    #[error("column {column} is a combination of those before it: leave it out")]
    Dependent {
        /// Index of the column.
        column: usize,
    },
    /// Squares overflow.
    #[error("the sum of squares overflows: state the signals in larger units")]
    Overflow,
    /// The delayed signal does not depend on the delay (it is constant), or is one of the columns for every delay.
    #[error("the delayed signal says nothing on the delay: it is constant, or a combination of the columns")]
    NoInformation,
}

/// The rows of one recording (without a gap), all in the same units in every recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rows<'a> {
    /// Right-hand side f, one value per row.
    pub target: &'a [f64],
    /// The columns φⱼ that are not delayed, each one value per row.
    pub columns: &'a [Vec<f64>],
    /// The signal that acts late, at every sample, after the same operation as the columns.
    pub delayed: &'a [f64],
    /// The sample of `delayed` that belongs to each row when there is no delay; ascending.
    pub places: &'a [usize],
    /// Sampling interval of `delayed`, s.
    pub dt: f64,
}

/// What is known of the gain g of the delayed term.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Gain {
    /// Known: the delayed term moves to the right side. Prefer it: a free gain multiplies the variance of τ.
    Known(f64),
    /// Estimated along.
    Free,
}

/// How to search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// The gain.
    pub gain: Gain,
    /// Smallest delay, s.
    pub from: f64,
    /// Largest delay, s.
    pub to: f64,
    /// Delays of the scan; neighbours should be well below a quarter of the shortest period in the signal.
    pub grid: usize,
    /// Over how many neighbouring rows residuals may be correlated (Newey–West bandwidth): twice the number of rows
    /// that share samples with one row. Zero for independent rows.
    pub correlated_rows: usize,
}

impl Options {
    /// 201 delays between `from` and `to`, s; independent rows.
    #[must_use]
    pub fn new(gain: Gain, from: f64, to: f64) -> Self {
        Self { gain, from, to, grid: 201, correlated_rows: 0 }
    }
}

/// A delay with its regression.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// τ, s.
    pub delay: f64,
    /// g.
    pub gain: f64,
    /// cⱼ.
    pub coefficients: Vec<f64>,
    /// Covariance, by rows, in the order τ, g (only if free), c₀, c₁, …: Newey–West over
    /// [`Options::correlated_rows`], from the Jacobian that holds g ∂x(t − τ)/∂τ beside the columns.
    pub covariance: Vec<Vec<f64>>,
    /// Standard deviation of τ, s.
    pub delay_std: f64,
    /// Standard deviation of the residual, in units of the target.
    pub residual_std: f64,
    /// Rows used.
    pub rows: usize,
    /// Independent rows that carry as much information on a mean, from the residual's autocorrelation.
    pub effective_rows: f64,
    /// (τ, RSS) of the scan.
    pub profile: Vec<(f64, f64)>,
    /// Whether τ can be told apart from the rest.
    pub separability: Separability,
}

/// How far the delay is told apart from the coefficients by these rows, whatever their noise.
#[derive(Debug, Clone, PartialEq)]
pub struct Separability {
    /// Correlation of τ with g; `None` when the gain is known.
    pub gain_correlation: Option<f64>,
    /// Correlation of τ with every coefficient.
    pub correlations: Vec<f64>,
    /// Variance of τ over what it would be with everything else known (variance inflation).
    pub inflation: f64,
    /// Condition number of the normalised Jacobian.
    pub condition: f64,
    /// What to distrust; empty when all is well.
    pub warnings: Vec<Warning>,
}

/// Why an estimated delay is not to be believed as it stands.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Warning {
    /// The minimum lies at an end of the range: the delay is not found but bounded.
    AtEdge {
        /// That end, s.
        delay: f64,
    },
    /// τ and the gain act alike ([`ENTANGLED`] or more in correlation) and there is enough noise for it to matter
    /// (a standard deviation of τ above [`PRECISE`] of τ).
    Entangled {
        /// Their correlation.
        correlation: f64,
    },
    /// The standard deviation is no smaller than half that of a uniform guess over the range: the data add little
    /// to it.
    Uninformative {
        /// Standard deviation of τ, s.
        std: f64,
    },
    /// Another delay fits as well within noise (likelihood ratio below the 99 % point of χ² with one degree of
    /// freedom, counted on effective rows).
    Ambiguous {
        /// That delay, s.
        delay: f64,
    },
}

/// Correlation of τ and g from which a fit is called entangled: 0.95 inflates the variance of τ by
/// 1/(1 − 0.95²) ≈ 10 against a known gain, the usual line of serious collinearity; from there on the noise in
/// the columns themselves, which no covariance of least squares counts, biases both.
pub const ENTANGLED: f64 = 0.95;

/// Share of τ below which its standard deviation makes a correlation harmless: with little noise even strongly
/// correlated parameters are well determined.
pub const PRECISE: f64 = 0.01;

/// 99 % point of χ² with one degree of freedom.
const CHI_SQUARED_99: f64 = 6.634_896_601;

/// The delay, the gain and the coefficients that explain all recordings together.
///
/// # Errors
/// Input that does not fit together, rows that are not finite, fewer rows than unknowns, dependent columns.
pub fn fit(recordings: &[Rows<'_>], options: &Options) -> Result<Fit, ExactError> {
    let problem = Problem::new(recordings, options)?;
    let profile: Vec<(f64, f64)> =
        problem.grid(options).map(|tau| (tau, problem.residual(tau).rss)).collect();
    let minima = local_minima(&profile);
    let mut refined: Vec<(f64, f64)> = minima
        .iter()
        .take(3)
        .map(|&i| {
            let low = profile[i.saturating_sub(1)].0;
            let high = profile[(i + 1).min(profile.len() - 1)].0;
            problem.refine(profile[i].0, low, high)
        })
        .collect();
    refined.sort_by(|a, b| a.1.total_cmp(&b.1));
    let Some(&(delay, rss)) = refined.first() else { return Err(ExactError::NoInformation) };
    if !rss.is_finite() {
        return Err(ExactError::Overflow);
    }
    problem.finish(delay, refined.get(1).copied(), profile, options)
}

/// One recording, checked, with the spline of its delayed signal.
struct Piece<'a> {
    rows: Rows<'a>,
    /// Rows from this one on have enough past.
    first: usize,
    spline: Spline<'a>,
}

/// All rows, with the columns factored once.
struct Problem<'a> {
    pieces: Vec<Piece<'a>>,
    gain: Gain,
    rows: usize,
    target: Vec<f64>,
    /// `None` without columns.
    factors: Option<Factors>,
    /// Target orthogonal to the columns.
    bare_target: Vec<f64>,
}

/// The regression at one delay.
struct Residual {
    rss: f64,
    gain: f64,
    residual: Vec<f64>,
    /// Derivative of the residual with respect to τ (Kaufman).
    slope: Vec<f64>,
}

impl<'a> Problem<'a> {
    fn new(recordings: &[Rows<'a>], options: &Options) -> Result<Self, ExactError> {
        let Options { gain, from, to, grid, .. } = *options;
        if !(from >= 0.0 && from < to && to.is_finite() && grid >= 3) {
            return Err(ExactError::Range { from, to, grid });
        }
        if let Gain::Known(gain) = gain
            && !(gain.is_finite() && gain != 0.0)
        {
            return Err(ExactError::Gain { gain });
        }
        let columns = recordings.first().ok_or(ExactError::NoRecording)?.columns.len();
        let pieces = recordings
            .iter()
            .enumerate()
            .map(|(i, rows)| Piece::new(i, *rows, columns, to))
            .collect::<Result<Vec<_>, _>>()?;
        let rows = pieces.iter().map(Piece::len).sum();
        let unknowns = columns + 1 + usize::from(gain == Gain::Free);
        if rows <= unknowns {
            return Err(ExactError::TooFewRows { rows, unknowns, to });
        }
        let target: Vec<f64> = pieces.iter().flat_map(|p| p.rows.target[p.first..].iter().copied()).collect();
        let factors = if columns == 0 {
            None
        } else {
            Some(
                Factors::new(stack(&pieces, columns))
                    .map_err(|d| ExactError::Dependent { column: d.column })?,
            )
        };
        let mut problem = Self { pieces, gain, rows, bare_target: target.clone(), target, factors };
        let mut bare = std::mem::take(&mut problem.bare_target);
        problem.project_out(&mut bare);
        problem.bare_target = bare;
        Ok(problem)
    }

    fn grid(&self, options: &Options) -> impl Iterator<Item = f64> + use<> {
        let Options { from, to, grid, .. } = *options;
        (0..grid).map(move |i| (from + (to - from) * i as f64 / (grid - 1) as f64).min(to))
    }

    fn project_out(&self, v: &mut [f64]) {
        if let Some(factors) = &self.factors {
            factors.project_out(v);
        }
    }

    /// x(t − τ) and its derivative with respect to τ, row by row.
    fn delayed(&self, tau: f64) -> (Vec<f64>, Vec<f64>) {
        let mut value = Vec::with_capacity(self.rows);
        let mut slope = Vec::with_capacity(self.rows);
        for piece in &self.pieces {
            for &place in &piece.rows.places[piece.first..] {
                let (x, dx) = piece.spline.at(place as f64 - tau / piece.rows.dt);
                value.push(x);
                slope.push(-dx / piece.rows.dt);
            }
        }
        (value, slope)
    }

    fn residual(&self, tau: f64) -> Residual {
        let (mut d, mut e) = self.delayed(tau);
        self.project_out(&mut d);
        self.project_out(&mut e);
        let gain = match self.gain {
            Gain::Known(gain) => gain,
            Gain::Free => {
                let size = dot(&d, &d);
                if size == 0.0 {
                    0.0
                } else {
                    let along = dot(&d, &e) / size;
                    e.iter_mut().zip(&d).for_each(|(e, d)| *e -= along * d);
                    dot(&d, &self.bare_target) / size
                }
            }
        };
        let residual: Vec<f64> = self.bare_target.iter().zip(&d).map(|(f, d)| f - gain * d).collect();
        e.iter_mut().for_each(|e| *e *= -gain);
        Residual { rss: dot(&residual, &residual), gain, residual, slope: e }
    }

    /// The minimum of RSS near `start`, within `low` and `high`: (τ, RSS).
    fn refine(&self, start: f64, low: f64, high: f64) -> (f64, f64) {
        let mut tau = start;
        let mut now = self.residual(tau);
        for _ in 0..60 {
            let size = dot(&now.slope, &now.slope);
            if size == 0.0 {
                break;
            }
            let full = (tau - dot(&now.slope, &now.residual) / size).clamp(low, high) - tau;
            let mut step = full;
            let better = (0..40).find_map(|_| {
                let at = (tau + step).clamp(low, high);
                let trial = self.residual(at);
                if trial.rss < now.rss {
                    return Some((at, trial));
                }
                step *= 0.5;
                None
            });
            let Some((at, trial)) = better else { break };
            (tau, now) = (at, trial);
            if step.abs() <= 1e-13 * (high - low) {
                break;
            }
        }
        (tau, now.rss)
    }

    /// Coefficients, covariance and warnings at the delay found.
    fn finish(
        &self,
        delay: f64,
        second: Option<(f64, f64)>,
        profile: Vec<(f64, f64)>,
        options: &Options,
    ) -> Result<Fit, ExactError> {
        let at = self.residual(delay);
        let (value, slope) = self.delayed(delay);
        let left: Vec<f64> = self.target.iter().zip(&value).map(|(f, d)| f - at.gain * d).collect();
        let coefficients = self.factors.as_ref().map_or(Vec::new(), |f| f.solve(&left));
        let free = usize::from(self.gain == Gain::Free);
        let columns = coefficients.len();
        // The columns first, so that what is found dependent is the delayed part.
        let mut jacobian = DMatrix::zeros(self.rows, columns + 1 + free);
        if columns > 0 {
            jacobian.view_mut((0, 0), (self.rows, columns)).copy_from(&stack(&self.pieces, columns));
        }
        if free == 1 {
            jacobian.column_mut(columns).copy_from_slice(&value);
        }
        let weighted: Vec<f64> = slope.iter().map(|e| at.gain * e).collect();
        jacobian.column_mut(columns + free).copy_from_slice(&weighted);
        let lone = dot(&weighted, &weighted);
        let factors = Factors::new(jacobian).map_err(|_| ExactError::NoInformation)?;
        let root = factors.inverse_factor();
        // τ stands first in what is returned.
        let order: Vec<usize> =
            std::iter::once(columns + free).chain((columns..columns + free).chain(0..columns)).collect();
        let permuted =
            |m: &DMatrix<f64>| DMatrix::from_fn(order.len(), order.len(), |i, j| m[(order[i], order[j])]);
        let geometry = permuted(&(&root * root.transpose()));
        let meat = self.score_covariance(&factors, &at.residual, options.correlated_rows);
        let unknowns = order.len() as f64;
        let small_sample = self.rows as f64 / (self.rows as f64 - unknowns);
        let covariance = to_rows(&permuted(&(&root * meat * root.transpose() * small_sample)));
        let residual_std = (at.rss / (self.rows as f64 - unknowns)).sqrt();
        let effective_rows = self.effective_rows(&at.residual);
        let (_, correlation) = standardised(&to_rows(&geometry));
        let gain_correlation = (free == 1).then(|| correlation[0][1]);
        let delay_std = covariance[0][0].sqrt();
        let mut warnings = Vec::new();
        let span = options.to - options.from;
        for edge in [options.from, options.to] {
            if (delay - edge).abs() <= 1e-9 * span {
                warnings.push(Warning::AtEdge { delay: edge });
            }
        }
        if let Some(correlation) = gain_correlation
            && correlation.abs() >= ENTANGLED
            && delay_std > PRECISE * delay
        {
            warnings.push(Warning::Entangled { correlation });
        }
        if delay_std >= 0.5 * span / 12.0_f64.sqrt() {
            warnings.push(Warning::Uninformative { std: delay_std });
        }
        let step = span / (options.grid - 1) as f64;
        if let Some((other, rss)) = second
            && (other - delay).abs() > step
            && effective_rows * (rss / at.rss).ln() < CHI_SQUARED_99
        {
            warnings.push(Warning::Ambiguous { delay: other });
        }
        let separability = Separability {
            gain_correlation,
            correlations: correlation[0][1 + free..].to_vec(),
            inflation: geometry[(0, 0)] * lone,
            condition: factors.condition(),
            warnings,
        };
        Ok(Fit {
            delay,
            gain: at.gain,
            coefficients,
            covariance,
            delay_std,
            residual_std,
            rows: self.rows,
            effective_rows,
            profile,
            separability,
        })
    }

    /// Σ over lags of the covariance of Qᵀr (Newey–West with Bartlett weights), recordings apart.
    fn score_covariance(&self, factors: &Factors, residual: &[f64], lags: usize) -> DMatrix<f64> {
        let k = factors.q.ncols();
        let scores = DMatrix::from_fn(k, self.rows, |j, i| factors.q[(i, j)] * residual[i]);
        let mut sum = DMatrix::zeros(k, k);
        let mut top = 0;
        for piece in &self.pieces {
            let n = piece.len();
            let own = scores.columns(top, n);
            sum += own * own.transpose();
            for lag in 1..=lags.min(n.saturating_sub(1)) {
                let weight = 1.0 - lag as f64 / (lags as f64 + 1.0);
                let cross = own.columns(0, n - lag) * own.columns(lag, n - lag).transpose() * weight;
                sum += &cross + cross.transpose();
            }
            top += n;
        }
        sum
    }

    /// n over 1 + 2Σρ, the autocorrelations ρ of the residual summed until the first that is not positive.
    fn effective_rows(&self, residual: &[f64]) -> f64 {
        let variance = dot(residual, residual);
        let n = self.rows as f64;
        if variance == 0.0 {
            return n;
        }
        let longest = self.pieces.iter().map(Piece::len).max().unwrap_or(0);
        let mut sum = 0.0;
        for lag in 1..longest {
            let mut product = 0.0;
            let mut top = 0;
            for piece in &self.pieces {
                let own = &residual[top..top + piece.len()];
                if lag < own.len() {
                    product += dot(&own[lag..], &own[..own.len() - lag]);
                }
                top += piece.len();
            }
            if product <= 0.0 {
                break;
            }
            sum += product / variance;
        }
        (n / (1.0 + 2.0 * sum)).clamp(1.0, n)
    }
}

impl<'a> Piece<'a> {
    fn new(recording: usize, rows: Rows<'a>, columns: usize, longest: f64) -> Result<Self, ExactError> {
        let Rows { target, columns: given, delayed, places, dt } = rows;
        if !(dt > 0.0 && dt.is_finite()) {
            return Err(ExactError::Sampling { recording, dt });
        }
        let shape = |what, found, expected| {
            if found == expected {
                Ok(())
            } else {
                Err(ExactError::Shape { recording, what, found, expected })
            }
        };
        shape("columns", given.len(), columns)?;
        shape("places", places.len(), target.len())?;
        for column in given {
            shape("rows of a column", column.len(), target.len())?;
        }
        let finite = |what, values: &[f64]| match values.iter().position(|v| !v.is_finite()) {
            Some(row) => Err(ExactError::NotFinite { recording, what, row }),
            None => Ok(()),
        };
        finite("target", target)?;
        given.iter().try_for_each(|c| finite("columns", c))?;
        finite("delayed", delayed)?;
        let samples = delayed.len();
        if let Some((row, &place)) = places.iter().enumerate().find(|(_, p)| **p >= samples) {
            return Err(ExactError::Place { recording, row, place, samples });
        }
        let spline = Spline::new(delayed).ok_or(ExactError::Shape {
            recording,
            what: "samples",
            found: samples,
            expected: 4,
        })?;
        if let Some(row) = places.windows(2).position(|w| w[1] < w[0]) {
            return Err(ExactError::Order { recording, row: row + 1 });
        }
        let past = longest / dt;
        let first = places.iter().position(|&p| p as f64 >= past).unwrap_or(places.len());
        Ok(Self { rows, first, spline })
    }

    fn len(&self) -> usize {
        self.rows.target.len() - self.first
    }
}

/// The columns of all pieces on top of each other.
fn stack(pieces: &[Piece<'_>], columns: usize) -> DMatrix<f64> {
    let rows = pieces.iter().map(Piece::len).sum();
    let values = (0..columns)
        .flat_map(|j| pieces.iter().flat_map(move |p| p.rows.columns[j][p.first..].iter().copied()));
    DMatrix::from_iterator(rows, columns, values)
}

/// Indices of the local minima, deepest first; an end counts when it lies below its neighbour.
fn local_minima(profile: &[(f64, f64)]) -> Vec<usize> {
    let rss = |i: usize| profile[i].1;
    let last = profile.len() - 1;
    let mut minima: Vec<usize> = (0..=last)
        .filter(|&i| (i == 0 || rss(i) <= rss(i - 1)) && (i == last || rss(i) < rss(i + 1)))
        .collect();
    minima.sort_by(|&a, &b| rss(a).total_cmp(&rss(b)));
    minima
}
