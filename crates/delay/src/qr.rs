//! Least squares by Householder QR of normalised columns, with the orthogonal factor: variable projection needs it at
//! every delay, and the triangles of `greybox-sparse` do not keep it.
use nalgebra::DMatrix;

/// A = Q R diag(scale): columns are divided by their norms first, so that units do not matter.
pub(crate) struct Factors {
    /// Orthonormal columns, n × k.
    pub(crate) q: DMatrix<f64>,
    /// Upper triangle of the normalised columns, k × k.
    r: DMatrix<f64>,
    /// Norms of the columns.
    scale: Vec<f64>,
}

/// A column depends linearly on those before it.
pub(crate) struct Dependent {
    /// Index of the column.
    pub(crate) column: usize,
}

/// A normalised column whose part orthogonal to those before it is smaller is taken as dependent: what is left of
/// it is rounding.
const RANK: f64 = 1e-12;

impl Factors {
    /// Factors a matrix with at least as many rows as columns. A column that is zero, or whose numbers
    /// overflowed, is as good as dependent.
    pub(crate) fn new(mut a: DMatrix<f64>) -> Result<Self, Dependent> {
        let mut scale = Vec::with_capacity(a.ncols());
        for (column, mut entries) in a.column_iter_mut().enumerate() {
            // In two steps, so that squares neither overflow nor vanish.
            let largest = entries.amax();
            entries /= largest;
            let norm = entries.norm();
            if !(largest > 0.0 && (largest * norm).is_finite() && norm.is_finite()) {
                return Err(Dependent { column });
            }
            entries /= norm;
            scale.push(largest * norm);
        }
        let (q, r) = a.qr().unpack();
        match (0..r.ncols()).find(|&j| r[(j, j)].abs() < RANK) {
            Some(column) => Err(Dependent { column }),
            None => Ok(Self { q, r, scale }),
        }
    }

    /// The coefficients that minimise |A c − b|.
    pub(crate) fn solve(&self, b: &[f64]) -> Vec<f64> {
        let k = self.scale.len();
        let mut c: Vec<f64> = (0..k).map(|j| dot(self.q.column(j).as_slice(), b)).collect();
        for j in (0..k).rev() {
            c[j] /= self.r[(j, j)];
            for i in 0..j {
                c[i] -= self.r[(i, j)] * c[j];
            }
        }
        c.iter().zip(&self.scale).map(|(c, s)| c / s).collect()
    }

    /// Removes from `v` what lies in the span of the columns. Applied twice, it is orthogonal to rounding.
    pub(crate) fn project_out(&self, v: &mut [f64]) {
        for _ in 0..2 {
            for q in self.q.column_iter() {
                let along = dot(q.as_slice(), v);
                v.iter_mut().zip(q.iter()).for_each(|(v, q)| *v -= along * q);
            }
        }
    }

    /// R⁻¹ with the scaling undone: (AᵀA)⁻¹ = S Sᵀ.
    pub(crate) fn inverse_factor(&self) -> DMatrix<f64> {
        let k = self.scale.len();
        let mut inverse = DMatrix::<f64>::zeros(k, k);
        for j in 0..k {
            inverse[(j, j)] = 1.0 / self.r[(j, j)];
            for i in (0..j).rev() {
                let sum: f64 = (i + 1..=j).map(|l| self.r[(i, l)] * inverse[(l, j)]).sum();
                inverse[(i, j)] = -sum / self.r[(i, i)];
            }
        }
        for (i, scale) in self.scale.iter().enumerate() {
            inverse.row_mut(i).iter_mut().for_each(|e| *e /= scale);
        }
        inverse
    }

    /// Condition number of the normalised columns.
    pub(crate) fn condition(&self) -> f64 {
        let svd = self.r.clone().try_svd(false, false, f64::EPSILON, 100 * self.scale.len());
        svd.map_or(f64::INFINITY, |svd| svd.singular_values.max() / svd.singular_values.min())
    }
}

pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Rows of a symmetric matrix.
pub(crate) fn to_rows(m: &DMatrix<f64>) -> Vec<Vec<f64>> {
    m.row_iter().map(|row| row.iter().copied().collect()).collect()
}
