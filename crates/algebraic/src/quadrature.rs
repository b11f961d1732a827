//! Exact product integration: a polynomial kernel against the local interpolant of the samples.

/// How the samples of a signal are joined, y(t) for t between the samples yₖ.
///
/// The integrals are exact for the joined signal; the order in the step Δt is that of the joining.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Hold {
    /// yₖ held over [tₖ, tₖ₊₁): exact for what a digital-to-analogue converter puts out; O(Δt) on a smooth signal.
    Zero,
    /// Straight lines between the samples: exact for piecewise linear inputs; O(Δt²) on a smooth signal.
    Linear,
    /// The cubic through the four nearest samples (three steps inside the window): O(Δt⁴); for smooth signals.
    #[default]
    Smooth,
}

impl Hold {
    /// Number of samples that determine the signal within one step.
    fn width(self) -> usize {
        match self {
            Self::Zero => 1,
            Self::Linear => 2,
            Self::Smooth => 4,
        }
    }

    /// Fewest steps of a window on which the signal can be joined.
    pub(crate) fn min_intervals(self) -> usize {
        self.width().saturating_sub(1).max(1)
    }

    /// Degree of the interpolating polynomial.
    fn degree(self) -> usize {
        self.width() - 1
    }
}

/// Gauss–Legendre rule on one step, with the interpolant's basis polynomials at its points.
///
/// A step is [0, 1]; the rule integrates `degree` of the kernel times the interpolant exactly.
#[derive(Debug, Clone)]
pub(crate) struct StepRule {
    hold: Hold,
    /// Points σ in (0, 1) and their weights.
    pub(crate) points: Vec<(f64, f64)>,
    /// `basis[o][g][i]`: basis polynomial of node `first + i` at point g, where the step starts at node
    /// `first + o`. Unused nodes have zeros.
    basis: [Vec<[f64; 4]>; 3],
}

impl StepRule {
    /// The rule that is exact for a factor of `degree` times the interpolant of `hold`.
    pub(crate) fn new(hold: Hold, degree: usize) -> Self {
        let points = gauss_legendre((degree + hold.degree()) / 2 + 1);
        let basis = std::array::from_fn(|offset| {
            points.iter().map(|&(s, _)| basis(hold, offset as f64 + s)).collect::<Vec<_>>()
        });
        Self { hold, points, basis }
    }

    /// First node and the basis (point by point) of step `k` in a window of `intervals` steps.
    pub(crate) fn at(&self, k: usize, intervals: usize) -> (usize, &[[f64; 4]]) {
        match self.hold {
            Hold::Zero | Hold::Linear => (k, &self.basis[0]),
            Hold::Smooth => {
                let first = k.saturating_sub(1).min(intervals - 3);
                (first, &self.basis[k - first])
            }
        }
    }

    /// Number of nodes of one step.
    pub(crate) fn width(&self) -> usize {
        self.hold.width()
    }
}

/// Basis polynomials of the nodes 0, 1, 2, 3 at `x`.
fn basis(hold: Hold, x: f64) -> [f64; 4] {
    match hold {
        Hold::Zero => [1.0, 0.0, 0.0, 0.0],
        Hold::Linear => [1.0 - x, x, 0.0, 0.0],
        Hold::Smooth => [
            -(x - 1.0) * (x - 2.0) * (x - 3.0) / 6.0,
            x * (x - 2.0) * (x - 3.0) / 2.0,
            -x * (x - 1.0) * (x - 3.0) / 2.0,
            x * (x - 1.0) * (x - 2.0) / 6.0,
        ],
    }
}

/// Points and weights of the `n`-point Gauss–Legendre rule on [0, 1], exact up to degree 2n − 1.
///
/// Newton's method on the Legendre polynomial from Tricomi's first values (Davis & Rabinowitz, Methods of
/// Numerical Integration, 2nd ed., §2.7).
fn gauss_legendre(n: usize) -> Vec<(f64, f64)> {
    (0..n)
        .map(|i| {
            let mut x = -(std::f64::consts::PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
            // Quadratic convergence from an error below 1/n²: six steps reach rounding for every n in use.
            for _ in 0..6 {
                let (p, slope) = legendre(n, x);
                x -= p / slope;
            }
            let (_, slope) = legendre(n, x);
            (0.5 * (1.0 + x), 1.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect()
}

/// Legendre polynomial Pₙ and its slope at |x| < 1.
fn legendre(n: usize, x: f64) -> (f64, f64) {
    let (mut before, mut p) = (1.0, x);
    for k in 2..=n {
        let k = k as f64;
        (before, p) = (p, ((2.0 * k - 1.0) * x * p - (k - 1.0) * before) / k);
    }
    (p, n as f64 * (x * p - before) / (x * x - 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gauss_rules_integrate_monomials_exactly() {
        for n in 1..=20 {
            let rule = gauss_legendre(n);
            for degree in 0..2 * n {
                let integral: f64 = rule.iter().map(|&(s, w)| w * s.powi(degree as i32)).sum();
                assert!((integral * (degree + 1) as f64 - 1.0).abs() < 1e-12, "{n} points, degree {degree}");
            }
            let beyond: f64 = rule.iter().map(|&(s, w)| w * s.powi(2 * n as i32)).sum();
            assert!(n > 8 || (beyond * (2 * n + 1) as f64 - 1.0).abs() > 1e-12, "{n} points do not reach 2n");
        }
    }

    #[test]
    fn bases_pass_through_their_nodes_and_sum_to_one() {
        for node in 0..4 {
            let at_node = basis(Hold::Smooth, node as f64);
            for (i, b) in at_node.iter().enumerate() {
                assert_eq!(*b, if i == node { 1.0 } else { 0.0 });
            }
        }
        for hold in [Hold::Zero, Hold::Linear, Hold::Smooth] {
            let sum: f64 = basis(hold, 0.37).iter().sum();
            assert!((sum - 1.0).abs() < 1e-15);
        }
    }
}
