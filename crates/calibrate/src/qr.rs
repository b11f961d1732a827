//! Dense least squares on tall, thin matrices stored column by column.
//!
//! Everything here goes through orthogonal factors, never through normal equations, so that the
//! conditioning of the problem is not squared.

/// Householder QR of the `m × n` matrix `a` (column major, overwritten); returns R as `n × n`, row
/// major, upper triangular. Rows beyond `m` count as zero when `m < n`.
///
/// With the right-hand side as the last column, the last column of R holds Qᵀb and the corner
/// the norm of the residual.
pub fn triangle(a: &mut [f64], m: usize, n: usize) -> Vec<f64> {
    let mut r = vec![0.0; n * n];
    for k in 0..n {
        let (done, rest) = a.split_at_mut((k + 1) * m);
        let column = &mut done[k * m..];
        if k < m {
            let norm = norm(&column[k..]);
            if norm > 0.0 {
                let alpha = if column[k] > 0.0 { -norm } else { norm };
                let pivot = column[k] - alpha;
                column[k] = pivot;
                // H = I − v vᵀ / (norm·(norm + |a_k|)), v = column[k..]
                let scale = 1.0 / (norm * pivot.abs());
                for other in rest.chunks_exact_mut(m) {
                    let f = dot(&column[k..], &other[k..]) * scale;
                    for (o, v) in other[k..].iter_mut().zip(&column[k..]) {
                        *o -= f * v;
                    }
                }
                column[k] = alpha;
            }
        }
        for i in 0..=k.min(m.saturating_sub(1)) {
            r[i * n + k] = column[i];
        }
    }
    r
}

/// Solves R x = b for upper triangular `r` (`stride` entries a row, top left `n × n`). A negligible
/// pivot gives a zero component.
pub fn back_substitute(r: &[f64], stride: usize, n: usize, b: &[f64]) -> Vec<f64> {
    let largest = (0..n).map(|i| r[i * stride + i].abs()).fold(0.0, f64::max);
    let mut x = vec![0.0; n];
    for i in (0..n).rev() {
        let mut v = b[i];
        for j in i + 1..n {
            v -= r[i * stride + j] * x[j];
        }
        let pivot = r[i * stride + i];
        x[i] = if pivot.abs() > 1e-14 * largest { v / pivot } else { 0.0 };
    }
    x
}

/// Inverse of an upper triangular `n × n` matrix; a negligible pivot gives zero rows and columns.
pub fn invert_triangle(r: &[f64], n: usize) -> Vec<f64> {
    let mut inverse = vec![0.0; n * n];
    let mut e = vec![0.0; n];
    for j in 0..n {
        e.fill(0.0);
        e[j] = 1.0;
        let x = back_substitute(r, n, n, &e);
        for i in 0..n {
            inverse[i * n + j] = x[i];
        }
    }
    inverse
}

/// Orthonormal basis of the columns of `a` (`m × n`, column major) by modified Gram–Schmidt done
/// twice; dependent columns become zero.
pub fn orthonormalise(a: &mut [f64], m: usize, n: usize) {
    for k in 0..n {
        let (before, rest) = a.split_at_mut(k * m);
        let column = &mut rest[..m];
        let start = norm(column);
        for _ in 0..2 {
            for q in before.chunks_exact(m) {
                let dot = dot(q, column);
                for (c, q) in column.iter_mut().zip(q) {
                    *c -= dot * q;
                }
            }
        }
        let length = norm(column);
        let inverse = if length > 1e-10 * start && start > 0.0 { 1.0 / length } else { 0.0 };
        column.iter_mut().for_each(|c| *c *= inverse);
    }
}

/// Removes from `column` its part in the span of the orthonormal columns `q`.
pub fn project_off(q: &[f64], m: usize, column: &mut [f64]) {
    for q in q.chunks_exact(m) {
        let dot = dot(q, column);
        if dot != 0.0 {
            for (c, q) in column.iter_mut().zip(q) {
                *c -= dot * q;
            }
        }
    }
}

/// Dot product over the shorter of the two: eight partial sums, which the compiler keeps in vector registers (one sum
/// would wait for each addition), the same on every machine.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len().min(b.len());
    let ((a, a_rest), (b, b_rest)) = (a[..n].as_chunks::<8>(), b[..n].as_chunks::<8>());
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    let mut sums = [0.0; 8];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..8 {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let [a, b, c, d, e, f, g, h] = sums;
    ((a + b) + (c + d)) + ((e + f) + (g + h)) + rest
}

fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}

/// P ← F P Fᵀ of a symmetric P, both `n × n`; `scratch` is as large as they are.
pub fn sandwich(f: &[f64], p: &mut [f64], scratch: &mut [f64], n: usize) {
    scratch[..n * n].fill(0.0);
    for i in 0..n {
        for (l, f) in f[i * n..(i + 1) * n].iter().enumerate() {
            if *f != 0.0 {
                let row = &mut scratch[i * n..(i + 1) * n];
                row.iter_mut().zip(&p[l * n..(l + 1) * n]).for_each(|(s, p)| *s += f * p);
            }
        }
    }
    for i in 0..n {
        for j in 0..=i {
            let (row, f) = (&scratch[i * n..(i + 1) * n], &f[j * n..(j + 1) * n]);
            let v: f64 = row.iter().zip(f).map(|(s, f)| s * f).sum();
            p[i * n + j] = v;
            p[j * n + i] = v;
        }
    }
}

/// Cholesky's lower factor L of a positive definite `n × n` matrix A = L Lᵀ with a unit diagonal, a trace of which keeps it from
/// being singular.
pub fn cholesky(a: &[f64], n: usize) -> Vec<f64> {
    let mut l = vec![0.0; n * n];
    for j in 0..n {
        let mut pivot = a[j * n + j] + 1e-12;
        for k in 0..j {
            pivot -= l[j * n + k] * l[j * n + k];
        }
        let root = pivot.max(1e-12).sqrt();
        l[j * n + j] = root;
        for i in j + 1..n {
            let mut v = a[i * n + j];
            for k in 0..j {
                v -= l[i * n + k] * l[j * n + k];
            }
            l[i * n + j] = v / root;
        }
    }
    l
}

/// ln of the determinant of a positive definite `n × n` matrix, from Cholesky's factor of the matrix with a unit diagonal.
pub fn log_determinant(a: &[f64], n: usize) -> f64 {
    let d: Vec<f64> = (0..n).map(|i| a[i * n + i].max(1e-300).sqrt()).collect();
    let scaled: Vec<f64> = (0..n * n).map(|i| a[i] / (d[i / n] * d[i % n])).collect();
    let l = cholesky(&scaled, n);
    (0..n).map(|j| 2.0 * (l[j * n + j].ln() + d[j].ln())).sum()
}

/// Solves the symmetric positive (semi)definite `n × n` system by Cholesky with a relative floor on
/// the pivots; small systems only (fold tests, Gram blocks).
pub fn solve_spd(a: &[f64], n: usize, b: &[f64]) -> Vec<f64> {
    let mut l = a.to_vec();
    let floor = 1e-13 * (0..n).map(|i| a[i * n + i]).fold(0.0, f64::max);
    for j in 0..n {
        let mut d = l[j * n + j];
        for k in 0..j {
            d -= l[j * n + k] * l[j * n + k];
        }
        let ok = d > floor;
        let root = if ok { d.sqrt() } else { f64::INFINITY };
        l[j * n + j] = root;
        for i in j + 1..n {
            let mut v = l[i * n + j];
            for k in 0..j {
                v -= l[i * n + k] * l[j * n + k];
            }
            l[i * n + j] = if ok { v / root } else { 0.0 };
        }
    }
    let mut x = b.to_vec();
    for i in 0..n {
        for k in 0..i {
            x[i] -= l[i * n + k] * x[k];
        }
        x[i] /= l[i * n + i];
    }
    for i in (0..n).rev() {
        for k in i + 1..n {
            x[i] -= l[k * n + i] * x[k];
        }
        x[i] /= l[i * n + i];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tall() -> (Vec<f64>, Vec<f64>, [f64; 3]) {
        let (m, x) = (40, [2.0, -1.0, 0.5]);
        let t = |i: usize| i as f64 / 39.0;
        let mut a: Vec<f64> = (0..3).flat_map(|p| (0..m).map(move |i| t(i).powi(p))).collect();
        let b: Vec<f64> = (0..m).map(|i| (0..3).map(|p| x[p] * a[p * m + i]).sum()).collect();
        a.extend(&b);
        (a, b, x)
    }

    #[test]
    fn a_determinant_is_the_product_of_its_factors() {
        let a = [4.0, 2.0, 0.0, 2.0, 9.0, 3.0, 0.0, 3.0, 16.0];
        // 4·(9·16 − 9) − 2·(2·16)
        assert!((log_determinant(&a, 3) - 476f64.ln()).abs() < 1e-9);
        let scaled: Vec<f64> = a.iter().map(|v| v * 1e-20).collect();
        assert!((log_determinant(&scaled, 3) - 476f64.ln() + 60.0 * 10f64.ln()).abs() < 1e-9);
    }

    #[test]
    fn a_sandwich_is_the_product_of_three() {
        let (f, mut p, mut scratch) = ([1.0, 2.0, 0.0, -1.0], [4.0, 1.0, 1.0, 3.0], [0.0; 4]);
        sandwich(&f, &mut p, &mut scratch, 2);
        // F P = (6 7; −1 −3), and that by Fᵀ.
        assert_eq!(p, [20.0, -7.0, -7.0, 3.0]);
    }

    #[test]
    fn triangle_solves_least_squares_and_keeps_the_residual_norm() {
        let (mut a, _, x) = tall();
        // A residual orthogonal to nothing in particular.
        for i in 0..40 {
            a[120 + i] += if i % 2 == 0 { 0.1 } else { -0.1 };
        }
        let original = a.clone();
        let r = triangle(&mut a, 40, 4);
        let rhs: Vec<f64> = (0..3).map(|i| r[i * 4 + 3]).collect();
        let got = back_substitute(&r, 4, 3, &rhs);
        let residual: f64 = (0..40)
            .map(|i| {
                let fit: f64 = (0..3).map(|p| got[p] * original[p * 40 + i]).sum();
                (original[120 + i] - fit).powi(2)
            })
            .sum::<f64>()
            .sqrt();
        assert!((residual - r[15].abs()).abs() < 1e-12);
        for (g, x) in got.iter().zip(x) {
            assert!((g - x).abs() < 0.05);
        }
    }

    #[test]
    fn projection_leaves_nothing_of_the_span() {
        let (a, b, _) = tall();
        let mut q = a[..120].to_vec();
        orthonormalise(&mut q, 40, 3);
        let mut column = b.clone();
        project_off(&q, 40, &mut column);
        assert!(dot(&column, &column).sqrt() < 1e-12);
    }

    #[test]
    fn cholesky_and_inverse() {
        let a = [4.0, 1.0, 0.5, 1.0, 3.0, -0.2, 0.5, -0.2, 2.0];
        let x = [1.0, -2.0, 0.3];
        let b: Vec<f64> = (0..3).map(|i| dot(&a[i * 3..i * 3 + 3], &x)).collect();
        for (got, want) in solve_spd(&a, 3, &b).iter().zip(x) {
            assert!((got - want).abs() < 1e-12);
        }
        let r = [2.0, 1.0, 0.0, 0.5];
        let i = invert_triangle(&r, 2);
        assert_eq!(i, vec![0.5, -1.0, 0.0, 2.0]);
    }
}
