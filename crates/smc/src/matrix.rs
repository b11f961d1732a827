//! Small dense matrices of fixed size, as arrays of rows.

/// Entry (i, j) is `m[i][j]`.
pub(crate) type Matrix<const N: usize> = [[f64; N]; N];

pub(crate) fn identity<const N: usize>() -> Matrix<N> {
    let mut m = [[0.0; N]; N];
    for i in 0..N {
        m[i][i] = 1.0;
    }
    m
}

pub(crate) fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    let mut sum = 0.0;
    for i in 0..N {
        sum += a[i] * b[i];
    }
    sum
}

/// M v.
pub(crate) fn times<const N: usize>(m: &Matrix<N>, v: &[f64; N]) -> [f64; N] {
    core::array::from_fn(|i| dot(&m[i], v))
}

/// vᵀ M.
pub(crate) fn row_times<const N: usize>(v: &[f64; N], m: &Matrix<N>) -> [f64; N] {
    let mut out = [0.0; N];
    for i in 0..N {
        for j in 0..N {
            out[j] += v[i] * m[i][j];
        }
    }
    out
}

pub(crate) fn product<const N: usize>(a: &Matrix<N>, b: &Matrix<N>) -> Matrix<N> {
    core::array::from_fn(|i| row_times(&a[i], b))
}

/// The largest sum of magnitudes in a column.
pub(crate) fn norm_1<const N: usize>(m: &Matrix<N>) -> f64 {
    let mut largest = 0.0_f64;
    for j in 0..N {
        let mut sum = 0.0;
        for row in m {
            sum += row[j].abs();
        }
        largest = if sum > largest || sum.is_nan() { sum } else { largest };
    }
    largest
}

pub(crate) fn is_finite<const N: usize>(m: &Matrix<N>) -> bool {
    m.iter().flatten().all(|entry| entry.is_finite())
}

/// The power of two nearest to a positive `x`, by its logarithm: multiplying by it rounds nothing.
pub(crate) fn power_of_two(x: f64) -> f64 {
    libm::exp2(libm::round(libm::log2(x)))
}

/// M⁻¹ v by elimination with scaled partial pivoting; nothing where M is singular to working precision.
pub(crate) fn solve<const N: usize>(m: &Matrix<N>, v: &[f64; N]) -> Option<[f64; N]> {
    let (mut m, mut v) = (*m, *v);
    // Rows of the largest entry 1, so that the pivots can be compared.
    for i in 0..N {
        let largest = m[i].iter().fold(0.0_f64, |largest, entry| largest.max(entry.abs()));
        if !(largest > 0.0 && largest.is_finite()) {
            return None;
        }
        let scale = 1.0 / power_of_two(largest);
        m[i] = m[i].map(|entry| scale * entry);
        v[i] *= scale;
    }
    // A column that is small in all rows belongs to a small unknown, and is no sign of singularity.
    let column: [f64; N] =
        core::array::from_fn(|j| m.iter().fold(0.0_f64, |largest, row| largest.max(row[j].abs())));
    for k in 0..N {
        let mut pivot = k;
        for i in k + 1..N {
            if m[i][k].abs() > m[pivot][k].abs() {
                pivot = i;
            }
        }
        let diagonal = m[pivot][k];
        let singular = 4.0 * N as f64 * f64::EPSILON * column[k];
        if diagonal.is_nan() || diagonal.abs() <= singular {
            return None;
        }
        m.swap(k, pivot);
        v.swap(k, pivot);
        for i in k + 1..N {
            let factor = m[i][k] / diagonal;
            for j in k..N {
                m[i][j] -= factor * m[k][j];
            }
            v[i] -= factor * v[k];
        }
    }
    for i in (0..N).rev() {
        let mut sum = v[i];
        for j in i + 1..N {
            sum -= m[i][j] * v[j];
        }
        v[i] = sum / m[i][i];
    }
    v.iter().all(|x| x.is_finite()).then_some(v)
}

/// The reflection I − τ v vᵀ that maps a vector x onto ρ times a unit vector.
pub(crate) struct Reflection<const N: usize> {
    v: [f64; N],
    tau: f64,
    /// ρ = ±‖x‖.
    pub(crate) length: f64,
}

impl<const N: usize> Reflection<N> {
    /// Of x, its entries before `first` left alone, onto the unit vector number `first`.
    pub(crate) fn of(x: &[f64; N], first: usize) -> Self {
        let scale = x.iter().skip(first + 1).fold(0.0_f64, |largest, x| largest.max(x.abs()));
        if scale == 0.0 {
            return Self { v: [0.0; N], tau: 0.0, length: x[first] };
        }
        let scale = scale.max(x[first].abs());
        let mut v: [f64; N] = core::array::from_fn(|i| if i < first { 0.0 } else { x[i] / scale });
        let norm = libm::sqrt(dot(&v, &v));
        let length = -libm::copysign(norm, v[first]);
        v[first] -= length;
        Self { tau: 2.0 / dot(&v, &v), v, length: scale * length }
    }

    /// M ← (I − τ v vᵀ) M.
    pub(crate) fn apply_left(&self, m: &mut Matrix<N>) {
        let along = row_times(&self.v, m);
        for i in 0..N {
            for j in 0..N {
                m[i][j] -= self.tau * self.v[i] * along[j];
            }
        }
    }

    /// M ← M (I − τ v vᵀ).
    pub(crate) fn apply_right(&self, m: &mut Matrix<N>) {
        for row in m {
            let along = self.tau * dot(row, &self.v);
            for j in 0..N {
                row[j] -= along * self.v[j];
            }
        }
    }
}

/// M ← Qᵀ M Q, upper Hessenberg, and `q` ← q Q; Q leaves the first unit vector alone.
pub(crate) fn hessenberg<const N: usize>(m: &mut Matrix<N>, q: &mut Matrix<N>) {
    for k in 0..N.saturating_sub(2) {
        let column: [f64; N] = core::array::from_fn(|i| m[i][k]);
        let reflection = Reflection::of(&column, k + 1);
        reflection.apply_left(m);
        reflection.apply_right(m);
        reflection.apply_right(q);
        m[k + 1][k] = reflection.length;
        for i in k + 2..N {
            m[i][k] = 0.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_system_of_mixed_units_is_solved() {
        let m = [[1e12, 2.0, 0.0], [3e6, 4e-6, 5e-9], [1e-3, -2e-12, 3e-18]];
        let x = [1e-9, -3e3, 7e6];
        let found = solve(&m, &times(&m, &x)).unwrap();
        for i in 0..3 {
            assert!((found[i] / x[i] - 1.0).abs() < 1e-9, "{found:?}");
        }
        assert_eq!(solve(&[[1.0, 2.0], [2.0, 4.0]], &[1.0, 2.0]), None);
        assert_eq!(solve(&[[0.0, 0.0], [2.0, 4.0]], &[1.0, 2.0]), None);
        assert_eq!(solve(&[[f64::NAN, 0.0], [2.0, 4.0]], &[1.0, 2.0]), None);
        assert_eq!(solve(&[[0.0, 2.0], [1.0, 0.0]], &[4.0, 3.0]), Some([3.0, 2.0]));
    }

    #[test]
    fn the_hessenberg_form_is_similar_to_the_matrix() {
        let m = [[1.0, 2.0, -1.0, 4.0], [3.0, -2.0, 0.5, 1.0], [0.0, 7.0, 2.0, -3.0], [1.0, 1.0, 5.0, 0.3]];
        let (mut h, mut q) = (m, identity());
        hessenberg(&mut h, &mut q);
        assert_eq!([h[2][0], h[3][0], h[3][1]], [0.0; 3]);
        assert_eq!([q[0][0], q[0][1], q[0][2], q[0][3]], [1.0, 0.0, 0.0, 0.0]);
        let (left, right) = (product(&m, &q), product(&q, &h));
        for i in 0..4 {
            for j in 0..4 {
                assert!((left[i][j] - right[i][j]).abs() < 1e-13);
            }
        }
    }
}
