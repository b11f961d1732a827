//! Upper triangular factors, row by row, and Givens rotations.

use alloc::vec;
use alloc::vec::Vec;

/// The upper triangular factor R of rows A: RᵀR = AᵀA. It holds all that a least-squares fit can ask of the rows, in n²
/// numbers however many they are, and the condition of the rows is not squared.
///
/// ```
/// use greybox_recursive::Triangle;
/// let (mut first, mut second) = (Triangle::new(2), Triangle::new(2));
/// first.push(&[3.0, 1.0]);
/// second.push(&[4.0, -2.0]);
/// first.merge(&second);
/// assert!((first.product(0, 0) - 25.0).abs() < 1e-12 && (first.product(0, 1) + 5.0).abs() < 1e-12);
/// assert_eq!(first.count(), 2);
/// ```
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Triangle {
    n: usize,
    factor: Vec<f64>,
    row: Vec<f64>,
    count: u64,
}

impl Triangle {
    /// Of no rows yet, of `n` entries each.
    pub fn new(n: usize) -> Triangle {
        Triangle { n, factor: vec![0.0; n * n], row: vec![0.0; n], count: 0 }
    }

    /// Takes a row. One of another length, or with a value that is not finite, changes nothing: `false`.
    pub fn push(&mut self, row: &[f64]) -> bool {
        if row.len() != self.n || !row.iter().all(|v| v.is_finite()) {
            return false;
        }
        self.row.copy_from_slice(row);
        absorb(&mut self.factor, self.n, &mut self.row);
        self.count += 1;
        true
    }

    /// Takes all rows of another triangle; one of another size changes nothing.
    pub fn merge(&mut self, other: &Triangle) {
        if other.n == self.n {
            for k in 0..self.n {
                self.row.copy_from_slice(other.row(k));
                absorb(&mut self.factor, self.n, &mut self.row);
            }
            self.count += other.count;
        }
    }

    /// Forgets all rows.
    pub fn clear(&mut self) {
        self.factor.fill(0.0);
        self.count = 0;
    }

    /// Row k of the factor; its entries before k are zero.
    pub fn row(&self, k: usize) -> &[f64] {
        &self.factor[k * self.n..(k + 1) * self.n]
    }

    /// Product of two columns of the rows, Σ aᵢ aⱼ.
    pub fn product(&self, i: usize, j: usize) -> f64 {
        (0..=i.min(j)).map(|k| self.factor[k * self.n + i] * self.factor[k * self.n + j]).sum()
    }

    /// Rows that were taken.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Entries of a row, where the sizes of all parts agree: a triangle that was restored from data may be anything.
    pub fn size(&self) -> Option<usize> {
        (self.n.checked_mul(self.n) == Some(self.factor.len()) && self.row.len() == self.n).then_some(self.n)
    }
}

/// Rotates `row` into the upper triangular factor R of `n` rows, each of `row.len()` ≥ n entries: afterwards RᵀR is what it
/// was plus rowᵀ row. Columns from `n` on are right-hand sides; what the rotations leave of them stands in `row`.
///
/// G. H. Golub, C. F. Van Loan, *Matrix Computations*, 4th ed., 2013, §5.1.8 and §6.5.3.
pub(crate) fn absorb(r: &mut [f64], n: usize, row: &mut [f64]) {
    let width = row.len();
    for k in 0..n {
        if row[k] == 0.0 {
            continue;
        }
        let own = &mut r[k * width..(k + 1) * width];
        let length = libm::hypot(own[k], row[k]);
        let (c, s) = (own[k] / length, row[k] / length);
        own[k] = length;
        row[k] = 0.0;
        for (a, b) in own[k + 1..].iter_mut().zip(&mut row[k + 1..]) {
            (*a, *b) = (c * *a + s * *b, c * *b - s * *a);
        }
    }
}

/// Solves R x = z for the upper triangle of `r` (rows of `width` entries); a direction that R does not have stays 0.
pub(crate) fn solve(r: &[f64], width: usize, z: impl Fn(usize) -> f64, x: &mut [f64]) {
    for k in (0..x.len()).rev() {
        let row = &r[k * width..];
        let rest: f64 = (k + 1..x.len()).map(|j| row[j] * x[j]).sum();
        x[k] = if row[k] == 0.0 { 0.0 } else { (z(k) - rest) / row[k] };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows in two triangles that are merged are rows in one, and one that is no row changes nothing.
    #[test]
    fn triangles_hold_the_products_of_their_rows() {
        let rows = [[3.0, 1.0, 2.0], [4.0, -2.0, 1.0], [0.0, 5.0, -3.0], [1.0, 1.0, 1.0], [-2.0, 0.5, 0.0]];
        let (mut a, mut b) = (Triangle::new(3), Triangle::new(3));
        rows[..2].iter().for_each(|r| assert!(a.push(r)));
        rows[2..].iter().for_each(|r| assert!(b.push(r)));
        assert!(!a.push(&[f64::NAN, 0.0, 0.0]) && !a.push(&[1.0]));
        a.merge(&b);
        for i in 0..3 {
            for j in 0..3 {
                let product: f64 = rows.iter().map(|r| r[i] * r[j]).sum();
                assert!((a.product(i, j) - product).abs() < 1e-12);
            }
        }
        assert_eq!((a.count(), a.size()), (5, Some(3)));
        a.clear();
        assert_eq!((a.count(), a.product(1, 1)), (0, 0.0));
    }

    #[test]
    fn a_rotated_row_adds_its_square() {
        let rows = [[3.0, 1.0, 2.0], [4.0, -2.0, 1.0], [0.0, 5.0, -3.0], [1.0, 1.0, 1.0]];
        let mut r = [0.0; 6];
        let mut left = 0.0;
        for row in rows {
            let mut row = row;
            absorb(&mut r, 2, &mut row);
            left += row[2] * row[2];
        }
        let mut x = [0.0; 2];
        solve(&r, 3, |k| r[k * 3 + 2], &mut x);
        // The normal equations of the four rows: [26 −4; −4 31] x = [11; −14].
        let expected = [285.0 / 790.0, -320.0 / 790.0];
        assert!((x[0] - expected[0]).abs() < 1e-14 && (x[1] - expected[1]).abs() < 1e-14, "{x:?}");
        let sum: f64 = rows.iter().map(|r| (r[0] * x[0] + r[1] * x[1] - r[2]).powi(2)).sum();
        assert!((left - sum).abs() < 1e-13);
    }
}
