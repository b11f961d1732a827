//! Characteristic roots of linear systems with delays, and where stability ends.
//!
//! ```text
//! ẋ(t) = A₀ x(t) + Σₖ Aₖ x(t − τₖ)
//! ```
//!
//! has the characteristic matrix Δ(λ) = λI − A₀ − Σₖ Aₖ e^(−λτₖ); its roots det Δ(λ) = 0 are infinitely many,
//! but only finitely many lie right of any vertical line, and the rightmost decides stability.
//!
//! The roots are the eigenvalues of the infinitesimal generator of the solution semigroup, the operator d/dθ on
//! functions over [−max τ, 0] with the system's equation as boundary condition. Collocation in N + 1 Chebyshev
//! points turns it into a matrix whose rightmost eigenvalues converge spectrally (D. Breda, S. Maset,
//! R. Vermiglio, "Pseudospectral differencing methods for characteristic roots of delay differential
//! equations", SIAM J. Sci. Comput. 27, 2005). Every root is then corrected by Newton's method on Δ itself, and N
//! grows until the correction is small: what is returned are roots of the exact equation.
//!
//! ```
//! use greybox_delay::spectrum::DelaySystem;
//!
//! // ẋ = −x(t − τ) is stable up to τ = π/2.
//! let system = DelaySystem::new(&[[0.0]], &[[-1.0]], 1.0)?;
//! let critical = system.critical_delay(0.5, 3.0, 10)?;
//! assert!((critical.value - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
//! assert!((critical.root.im.abs() - 1.0).abs() < 1e-9);
//! # Ok::<(), greybox_delay::spectrum::SpectrumError>(())
//! ```
use nalgebra::{Complex, DMatrix, Schur};

/// Why there is no spectrum.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SpectrumError {
    /// A matrix is not square, not of the order of the others, or empty.
    #[error(
        "the {which} matrix has a row of {found} entries where {expected} are needed: give square matrices of one order"
    )]
    Shape {
        /// Which matrix: `undelayed` or `delayed`.
        which: &'static str,
        /// Entries (or rows) found.
        found: usize,
        /// Entries (or rows) needed.
        expected: usize,
    },
    /// An entry is not a finite number.
    #[error("the {which} matrix has the entry {value} in row {row}, column {column}: entries must be finite")]
    Entry {
        /// Which matrix: `undelayed` or `delayed`.
        which: &'static str,
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        column: usize,
        /// The entry.
        value: f64,
    },
    /// A delay is negative or not finite.
    #[error("a delay of {delay} s is impossible: give a finite one, zero or more")]
    Delay {
        /// The delay, s.
        delay: f64,
    },
    /// The collocation did not resolve the rightmost roots.
    #[error(
        "{points} collocation points do not resolve the rightmost {wanted} roots: ask for fewer, or shorten the \
         delay (|root| times delay must stay well below the number of points)"
    )]
    Unresolved {
        /// Collocation points used last.
        points: usize,
        /// Roots asked for.
        wanted: usize,
    },
    /// The range of a search for the stability limit is empty or not finite.
    #[error(
        "the search range {from} to {to} in {steps} steps is empty: give from < to and at least one step"
    )]
    Range {
        /// Lower end.
        from: f64,
        /// Upper end.
        to: f64,
        /// Steps.
        steps: usize,
    },
    /// Stability does not change in the range searched.
    #[error(
        "the system is {} over the whole range {from} to {to} (rightmost real part {first} to {last} 1/s): widen \
         the range",
        if *.first < 0.0 { "stable" } else { "unstable" }
    )]
    NoCrossing {
        /// Lower end.
        from: f64,
        /// Upper end.
        to: f64,
        /// Rightmost real part at the lower end, 1/s.
        first: f64,
        /// Rightmost real part at the upper end, 1/s.
        last: f64,
    },
}

/// A characteristic root λ = re + i·im, 1/s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Root {
    /// Real part, 1/s: growth.
    pub re: f64,
    /// Imaginary part, rad/s: frequency.
    pub im: f64,
}

/// A parameter value at which the rightmost root lies on the imaginary axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Critical {
    /// The value.
    pub value: f64,
    /// The root there: its imaginary part is the frequency of the oscillation that sets in, rad/s.
    pub root: Root,
}

/// ẋ = A₀ x + Σₖ Aₖ x(t − τₖ).
#[derive(Debug, Clone, PartialEq)]
pub struct DelaySystem {
    undelayed: DMatrix<f64>,
    delayed: Vec<(f64, DMatrix<f64>)>,
}

/// Collocation degrees tried in turn.
const DEGREES: [usize; 4] = [16, 32, 64, 128];

/// How far Newton's method may carry an eigenvalue for it to count as resolved, relative to 1 + |λ|.
const RESOLVED: f64 = 1e-5;

impl DelaySystem {
    /// A system with one delay τ in s; matrices by rows.
    ///
    /// # Errors
    /// Matrices that are not square, of one order and finite; a delay that is negative or not finite.
    pub fn new<R: AsRef<[f64]>>(undelayed: &[R], delayed: &[R], delay: f64) -> Result<Self, SpectrumError> {
        let undelayed = square("undelayed", undelayed, undelayed.len())?;
        Self { undelayed, delayed: Vec::new() }.and(delayed, delay)
    }

    /// The same system with one more delayed term.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn and<R: AsRef<[f64]>>(mut self, delayed: &[R], delay: f64) -> Result<Self, SpectrumError> {
        check_delay(delay)?;
        let matrix = square("delayed", delayed, self.order())?;
        self.delayed.push((delay, matrix));
        Ok(self)
    }

    /// Number of states.
    #[must_use]
    pub fn order(&self) -> usize {
        self.undelayed.nrows()
    }

    /// The same system with every delayed matrix multiplied by `factor`.
    #[must_use]
    pub fn with_gain(&self, factor: f64) -> Self {
        let delayed = self.delayed.iter().map(|(delay, a)| (*delay, a * factor)).collect();
        Self { undelayed: self.undelayed.clone(), delayed }
    }

    /// The same system with every delay replaced by `delay`, s.
    ///
    /// # Errors
    /// A delay that is negative or not finite.
    pub fn with_delay(&self, delay: f64) -> Result<Self, SpectrumError> {
        check_delay(delay)?;
        let delayed = self.delayed.iter().map(|(_, a)| (delay, a.clone())).collect();
        Ok(Self { undelayed: self.undelayed.clone(), delayed })
    }

    /// The `count` rightmost roots, by falling real part (of a conjugate pair, the positive frequency first), to
    /// the accuracy of the arithmetic. Fewer when the system has fewer (one without delay has as many as states).
    ///
    /// # Errors
    /// [`SpectrumError::Unresolved`].
    pub fn roots(&self, count: usize) -> Result<Vec<Root>, SpectrumError> {
        let longest = self.delayed.iter().map(|(delay, _)| *delay).fold(0.0, f64::max);
        if longest == 0.0 || self.delayed.iter().all(|(_, a)| a.iter().all(|&a| a == 0.0)) {
            let whole = self
                .delayed
                .iter()
                .fold(self.undelayed.clone(), |sum, (delay, a)| if *delay == 0.0 { sum + a } else { sum });
            let values = eigenvalues(whole).ok_or(SpectrumError::Unresolved { points: 1, wanted: count })?;
            return Ok(rightmost(values, count));
        }
        for degree in DEGREES {
            let wanted = count.min(self.order() * (degree + 1));
            let Some(values) = eigenvalues(self.generator(degree, longest)) else { continue };
            // A pair is two roots: whoever asks for an odd count gets the first of it.
            let candidates = rightmost(values, wanted);
            let corrected: Vec<Option<Root>> = candidates.iter().map(|&root| self.corrected(root)).collect();
            if wanted == count && corrected.iter().all(Option::is_some) {
                let found = corrected.into_iter().flatten();
                return Ok(rightmost(found.map(|r| Complex::new(r.re, r.im)).collect(), count));
            }
        }
        let points = DEGREES[DEGREES.len() - 1] + 1;
        Err(SpectrumError::Unresolved { points, wanted: count })
    }

    /// The rightmost root: the system is stable when its real part is negative.
    ///
    /// # Errors
    /// As [`roots`](Self::roots).
    pub fn rightmost(&self) -> Result<Root, SpectrumError> {
        let roots = self.roots(1)?;
        roots.first().copied().ok_or(SpectrumError::Unresolved { points: 1, wanted: 1 })
    }

    /// The first factor on all delayed matrices, going from `from` to `to`, at which stability changes. The range
    /// is walked in `steps` equal steps (a pair of changes inside one step is not seen), then bisected.
    ///
    /// # Errors
    /// An empty range, no change of stability in it, or roots that are not resolved.
    pub fn critical_gain(&self, from: f64, to: f64, steps: usize) -> Result<Critical, SpectrumError> {
        crossing(|factor| Ok(self.with_gain(factor)), from, to, steps)
    }

    /// The first delay, s, going from `from` to `to`, at which stability changes; every delay of the system is set
    /// to it. The range is walked in `steps` equal steps, then bisected.
    ///
    /// # Errors
    /// An empty range, a negative delay, no change of stability, or roots that are not resolved.
    pub fn critical_delay(&self, from: f64, to: f64, steps: usize) -> Result<Critical, SpectrumError> {
        crossing(|delay| self.with_delay(delay), from, to, steps)
    }

    /// How well `root` satisfies the characteristic equation: the smallest singular value of Δ(λ) over the sum of
    /// the Frobenius norms of its terms. Zero for a root, of the order of one for any other number.
    #[must_use]
    pub fn residual(&self, root: Root) -> f64 {
        let root = Complex::new(root.re, root.im);
        let (delta, _) = self.characteristic(root);
        let late = self.delayed.iter().map(|(delay, a)| a.norm() * (-root.re * delay).exp());
        let size = root.norm() + self.undelayed.norm() + late.sum::<f64>();
        if size == 0.0 {
            0.0
        } else if size.is_finite() {
            let svd = delta.try_svd(false, false, f64::EPSILON, 100 * self.order());
            svd.map_or(f64::INFINITY, |svd| svd.singular_values.min() / size)
        } else {
            // e^(−λτ) overflowed, far to the left.
            f64::INFINITY
        }
    }

    /// Δ(λ) and dΔ/dλ = I + Σ τₖ Aₖ e^(−λτₖ).
    fn characteristic(&self, root: Complex<f64>) -> (DMatrix<Complex<f64>>, DMatrix<Complex<f64>>) {
        let n = self.order();
        let mut slope = DMatrix::<Complex<f64>>::identity(n, n);
        let mut delta = &slope * root - self.undelayed.map(Complex::from);
        for (delay, a) in &self.delayed {
            let late = a.map(Complex::from) * (-root * *delay).exp();
            slope += &late * Complex::from(*delay);
            delta -= late;
        }
        (delta, slope)
    }

    /// The root of det Δ near an eigenvalue, by Newton's method (det Δ/(det Δ)′ = 1/tr(Δ⁻¹Δ′)); `None` when
    /// there is none near enough.
    fn corrected(&self, start: Root) -> Option<Root> {
        let origin = Complex::new(start.re, start.im);
        let scale = 1.0 + origin.norm();
        let mut root = origin;
        for _ in 0..20 {
            let (delta, slope) = self.characteristic(root);
            // An exactly singular Δ is a root.
            let Some(solved) = delta.lu().solve(&slope) else { break };
            let step = solved.trace().inv();
            if !(step.re.is_finite() && step.im.is_finite()) {
                break;
            }
            root -= step;
            if (root - origin).norm() > RESOLVED * scale {
                return None;
            }
            if step.norm() <= 1e-14 * scale {
                break;
            }
        }
        // Real eigenvalues have real roots: rounding must not turn them into pairs.
        let im = if start.im == 0.0 { 0.0 } else { root.im };
        let root = Root { re: root.re, im };
        (self.residual(root) < 1e-8).then_some(root)
    }

    /// The generator collocated in the Chebyshev points θᵢ = τ(cos(iπ/N) − 1)/2, θ₀ = 0: the first block row is the
    /// system, the others differentiate.
    fn generator(&self, degree: usize, longest: f64) -> DMatrix<f64> {
        let n = self.order();
        let points: Vec<f64> =
            (0..=degree).map(|i| (i as f64 * std::f64::consts::PI / degree as f64).cos()).collect();
        let slopes = differentiation(&points);
        let mut generator = DMatrix::zeros(n * (degree + 1), n * (degree + 1));
        generator.view_mut((0, 0), (n, n)).copy_from(&self.undelayed);
        for (delay, a) in &self.delayed {
            let values = interpolation(&points, 1.0 - 2.0 * delay / longest);
            for (j, value) in values.iter().enumerate().filter(|(_, v)| **v != 0.0) {
                let mut block = generator.view_mut((0, j * n), (n, n));
                block += a * *value;
            }
        }
        for i in 1..=degree {
            for j in 0..=degree {
                for k in 0..n {
                    generator[(i * n + k, j * n + k)] = slopes[(i, j)] * 2.0 / longest;
                }
            }
        }
        generator
    }
}

fn check_delay(delay: f64) -> Result<(), SpectrumError> {
    if delay >= 0.0 && delay.is_finite() { Ok(()) } else { Err(SpectrumError::Delay { delay }) }
}

fn square<R: AsRef<[f64]>>(
    which: &'static str,
    rows: &[R],
    order: usize,
) -> Result<DMatrix<f64>, SpectrumError> {
    if rows.len() != order || order == 0 {
        return Err(SpectrumError::Shape { which, found: rows.len(), expected: order.max(1) });
    }
    for (row, entries) in rows.iter().enumerate() {
        let entries = entries.as_ref();
        if entries.len() != order {
            return Err(SpectrumError::Shape { which, found: entries.len(), expected: order });
        }
        if let Some((column, &value)) = entries.iter().enumerate().find(|(_, e)| !e.is_finite()) {
            return Err(SpectrumError::Entry { which, row, column, value });
        }
    }
    Ok(DMatrix::from_fn(order, order, |i, j| rows[i].as_ref()[j]))
}

/// Eigenvalues of a real matrix; `None` when the QR iteration does not end or overflows.
fn eigenvalues(matrix: DMatrix<f64>) -> Option<Vec<Complex<f64>>> {
    let iterations = 60 * matrix.nrows().max(10);
    let schur = Schur::try_new(matrix, f64::EPSILON, iterations)?;
    let values: Vec<Complex<f64>> = schur.complex_eigenvalues().iter().copied().collect();
    // Entries near the largest number overflow on the way.
    values.iter().all(|v| v.re.is_finite() && v.im.is_finite()).then_some(values)
}

/// The `count` rightmost, sorted by falling real part; of equal real parts the higher frequency first.
fn rightmost(values: Vec<Complex<f64>>, count: usize) -> Vec<Root> {
    let mut roots: Vec<Root> = values.into_iter().map(|z| Root { re: z.re, im: z.im }).collect();
    // Conjugates differ in rounding: they are ordered by the rounded real part.
    let key = |r: &Root| (r.re * 1e9 / (1.0 + r.re.abs())).round();
    roots.sort_by(|a, b| key(b).total_cmp(&key(a)).then(b.im.total_cmp(&a.im)));
    roots.truncate(count);
    roots
}

/// Weights of barycentric interpolation in the Chebyshev points of the second kind.
fn barycentric(points: &[f64]) -> Vec<f64> {
    let last = points.len() - 1;
    (0..=last)
        .map(|i| {
            let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
            if i == 0 || i == last { 0.5 * sign } else { sign }
        })
        .collect()
}

/// The differentiation matrix of the points; its rows sum to zero exactly.
fn differentiation(points: &[f64]) -> DMatrix<f64> {
    let w = barycentric(points);
    let n = points.len();
    let mut d =
        DMatrix::from_fn(n, n, |i, j| if i == j { 0.0 } else { w[j] / w[i] / (points[i] - points[j]) });
    for i in 0..n {
        d[(i, i)] = -d.row(i).sum();
    }
    d
}

/// Weights that give the value at `x` of the polynomial through the points.
fn interpolation(points: &[f64], x: f64) -> Vec<f64> {
    if let Some(hit) = points.iter().position(|&p| (p - x).abs() < 1e-14) {
        return (0..points.len()).map(|i| if i == hit { 1.0 } else { 0.0 }).collect();
    }
    let raw: Vec<f64> = barycentric(points).iter().zip(points).map(|(w, p)| w / (x - p)).collect();
    let sum: f64 = raw.iter().sum();
    raw.iter().map(|r| r / sum).collect()
}

/// The first sign change of the rightmost real part along a one-parameter family.
fn crossing(
    family: impl Fn(f64) -> Result<DelaySystem, SpectrumError>,
    from: f64,
    to: f64,
    steps: usize,
) -> Result<Critical, SpectrumError> {
    if !(from < to && from.is_finite() && to.is_finite() && steps > 0) {
        return Err(SpectrumError::Range { from, to, steps });
    }
    let growth = |value: f64| Ok::<f64, SpectrumError>(family(value)?.rightmost()?.re);
    let first = growth(from)?;
    let (mut low, mut last) = (from, first);
    for i in 1..=steps {
        let high = from + (to - from) * i as f64 / steps as f64;
        last = growth(high)?;
        if (last < 0.0) != (first < 0.0) {
            let (mut low, mut high) = (low, high);
            for _ in 0..200 {
                let middle = 0.5 * (low + high);
                if middle <= low || middle >= high || high - low <= 1e-13 * high.abs() {
                    break;
                }
                if (growth(middle)? < 0.0) == (first < 0.0) { low = middle } else { high = middle }
            }
            let value = 0.5 * (low + high);
            return Ok(Critical { value, root: family(value)?.rightmost()? });
        }
        low = high;
    }
    Err(SpectrumError::NoCrossing { from, to, first, last })
}
