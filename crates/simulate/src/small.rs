//! LU of the mass matrix: a few equations, factored thousands of times a second.

/// Factors `a` (`n × n`, row major) in place with partial pivoting; `false` when singular.
pub fn factor(a: &mut [f64], pivots: &mut [usize], n: usize) -> bool {
    for k in 0..n {
        let mut p = k;
        for i in k + 1..n {
            if a[i * n + k].abs() > a[p * n + k].abs() {
                p = i;
            }
        }
        pivots[k] = p;
        let pivot = a[p * n + k];
        if !(pivot.abs() > 0.0 && pivot.is_finite()) {
            return false;
        }
        if p != k {
            for j in 0..n {
                a.swap(k * n + j, p * n + j);
            }
        }
        for i in k + 1..n {
            let m = a[i * n + k] / pivot;
            a[i * n + k] = m;
            for j in k + 1..n {
                a[i * n + j] -= m * a[k * n + j];
            }
        }
    }
    true
}

/// Solves for `lanes` right-hand sides at once; `b` is `n × lanes`, row major.
pub fn solve(a: &[f64], pivots: &[usize], n: usize, b: &mut [f64], lanes: usize) {
    if n == 1 {
        let inverse = 1.0 / a[0];
        b[..lanes].iter_mut().for_each(|x| *x *= inverse);
        return;
    }
    for k in 0..n {
        let p = pivots[k];
        if p != k {
            for l in 0..lanes {
                b.swap(k * lanes + l, p * lanes + l);
            }
        }
    }
    for k in 0..n {
        for i in k + 1..n {
            let m = a[i * n + k];
            if m != 0.0 {
                for l in 0..lanes {
                    b[i * lanes + l] -= m * b[k * lanes + l];
                }
            }
        }
    }
    for k in (0..n).rev() {
        let inverse = 1.0 / a[k * n + k];
        for l in 0..lanes {
            b[k * lanes + l] *= inverse;
        }
        for i in 0..k {
            let m = a[i * n + k];
            if m != 0.0 {
                for l in 0..lanes {
                    b[i * lanes + l] -= m * b[k * lanes + l];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_a_system_that_needs_pivoting_for_two_sides() {
        let m = [0.0, 2.0, 1.0, 1.0, -1.0, 3.0, 4.0, 0.5, 2.0];
        let x = [1.0, -2.0, 3.0, 0.5, -1.0, 2.0]; // 3 × 2
        let mut b = [0.0; 6];
        for i in 0..3 {
            for l in 0..2 {
                b[i * 2 + l] = (0..3).map(|j| m[i * 3 + j] * x[j * 2 + l]).sum();
            }
        }
        let (mut a, mut p) = (m, [0; 3]);
        assert!(factor(&mut a, &mut p, 3));
        solve(&a, &p, 3, &mut b, 2);
        for (b, x) in b.iter().zip(x) {
            assert!((b - x).abs() < 1e-14);
        }
        let mut singular = [1.0, 2.0, 2.0, 4.0];
        assert!(!factor(&mut singular, &mut p[..2], 2));
    }
}
