//! Sums of products in twice the working precision.
//!
//! The residual of a Riccati equation is the small difference of large terms: rounded to double precision it says
//! nothing below κ ε. Computed as if in twice the precision (T. Ogita, S. Rump, S. Oishi, *Accurate sum and dot
//! product*, SIAM J. Sci. Comput. 26, 2005) it lets Newton's method refine a solution to its last digits.

use nalgebra::DMatrix;

/// An unevaluated sum `high + low`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Twofold {
    high: f64,
    low: f64,
}

/// s + e = a + b exactly (Knuth).
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let s = a + b;
    let t = s - a;
    (s, (a - (s - t)) + (b - t))
}

/// The two halves of a number, 26 bits each (Veltkamp).
fn split(a: f64) -> (f64, f64) {
    let c = 134_217_729.0 * a; // 2²⁷ + 1
    let high = c - (c - a);
    (high, a - high)
}

/// p + e = a b exactly (Dekker); exact whether or not the machine multiplies and adds in one step.
fn two_product(a: f64, b: f64) -> (f64, f64) {
    let p = a * b;
    let ((ah, al), (bh, bl)) = (split(a), split(b));
    (p, al * bl - (((p - ah * bh) - al * bh) - ah * bl))
}

impl Twofold {
    pub(crate) fn new(value: f64) -> Twofold {
        Twofold { high: value, low: 0.0 }
    }

    pub(crate) fn add(&mut self, x: f64) {
        let (s, e) = two_sum(self.high, x);
        self.high = s;
        self.low += e;
    }

    pub(crate) fn add_product(&mut self, a: f64, b: f64) {
        let (p, e) = two_product(a, b);
        self.add(p);
        self.low += e;
    }

    /// Adds Σ aᵢ bᵢ.
    pub(crate) fn add_dot(&mut self, a: &[f64], b: &[f64]) {
        for (a, b) in a.iter().zip(b) {
            self.add_product(*a, *b);
        }
    }

    /// Subtracts Σ aᵢ bᵢ.
    pub(crate) fn sub_dot(&mut self, a: &[f64], b: &[f64]) {
        for (a, b) in a.iter().zip(b) {
            self.add_product(-*a, *b);
        }
    }

    pub(crate) fn value(self) -> f64 {
        self.high + self.low
    }

    /// Rounded, and what rounding left over.
    pub(crate) fn parts(self) -> (f64, f64) {
        two_sum(self.high, self.low)
    }
}

/// A matrix in twice the precision: `high + low`.
#[derive(Debug, Clone)]
pub(crate) struct Pair {
    pub(crate) high: DMatrix<f64>,
    pub(crate) low: DMatrix<f64>,
}

impl Pair {
    /// From its elements.
    pub(crate) fn from_fn(rows: usize, columns: usize, f: impl Fn(usize, usize) -> Twofold) -> Pair {
        let mut pair = Pair { high: DMatrix::zeros(rows, columns), low: DMatrix::zeros(rows, columns) };
        for j in 0..columns {
            for i in 0..rows {
                (pair.high[(i, j)], pair.low[(i, j)]) = f(i, j).parts();
            }
        }
        pair
    }

    /// aᵀ b.
    pub(crate) fn product_of_transposed(a: &DMatrix<f64>, b: &DMatrix<f64>) -> Pair {
        Pair::from_fn(a.ncols(), b.ncols(), |i, j| {
            let mut sum = Twofold::default();
            sum.add_dot(column(a, i), column(b, j));
            sum
        })
    }

    /// Subtracts aᵀ(high + low) of column `j` from a sum.
    pub(crate) fn sub_dot(&self, sum: &mut Twofold, a: &[f64], j: usize) {
        sum.sub_dot(a, column(&self.high, j));
        sum.add(-a.iter().zip(column(&self.low, j)).map(|(a, b)| a * b).sum::<f64>());
    }

    /// Adds aᵀ(high + low) of column `j` to a sum.
    pub(crate) fn add_dot(&self, sum: &mut Twofold, a: &[f64], j: usize) {
        sum.add_dot(a, column(&self.high, j));
        sum.add(a.iter().zip(column(&self.low, j)).map(|(a, b)| a * b).sum::<f64>());
    }
}

/// Column `j` as a slice.
pub(crate) fn column(m: &DMatrix<f64>, j: usize) -> &[f64] {
    let rows = m.nrows();
    &m.as_slice()[j * rows..(j + 1) * rows]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cancellation_leaves_the_small_term() {
        // 1e16·1 + 1·1 − 1e16·1 = 1; in double precision the 1 is lost.
        let mut sum = Twofold::default();
        sum.add_dot(&[1e16, 1.0, -1e16], &[1.0, 1.0, 1.0]);
        assert_eq!(sum.value(), 1.0);
        // (1 + ε)² − 1 − 2ε = ε².
        let e = f64::EPSILON;
        let mut sum = Twofold::new(-1.0);
        sum.add_product(1.0 + e, 1.0 + e);
        sum.add(-2.0 * e);
        assert_eq!(sum.value(), e * e);
    }
}
