//! LU of the mass matrix: a few equations, factored thousands of times a second.

/// Factors `a` (`n × n`, row major) in place with partial pivoting, reciprocal pivots on the diagonal; `false` when
/// singular, and then no number is left in it.
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
            a[..n * n].fill(f64::NAN);
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
        a[k * n + k] = 1.0 / pivot;
    }
    true
}

/// Solves for `lanes` right-hand sides at once; `b` is `n × lanes`, row major.
pub fn solve(a: &[f64], pivots: &[usize], n: usize, b: &mut [f64], lanes: usize) {
    if lanes == 1 { solve_one(a, pivots, n, b) } else { solve_rows(a, pivots, n, b, lanes) }
}

/// [`solve`] where rows are worth cutting.
#[inline(always)]
pub(crate) fn solve_rows(a: &[f64], pivots: &[usize], n: usize, b: &mut [f64], lanes: usize) {
    if n == 1 {
        let inverse = a[0];
        b[..lanes].iter_mut().for_each(|x| *x *= inverse);
        return;
    }
    for (k, &p) in pivots[..n].iter().enumerate() {
        if p != k {
            let (low, high) = b.split_at_mut(k.max(p) * lanes);
            low[k.min(p) * lanes..][..lanes].swap_with_slice(&mut high[..lanes]);
        }
    }
    for k in 0..n {
        for i in k + 1..n {
            let (above, below) = b.split_at_mut(i * lanes);
            less(&mut below[..lanes], a[i * n + k], &above[k * lanes..][..lanes]);
        }
    }
    for k in (0..n).rev() {
        let (above, below) = b.split_at_mut(k * lanes);
        let known = &mut below[..lanes];
        let inverse = a[k * n + k];
        known.iter_mut().for_each(|x| *x *= inverse);
        for i in 0..k {
            less(&mut above[i * lanes..][..lanes], a[i * n + k], known);
        }
    }
}

/// [`solve`] of one right-hand side: numbers in the place of rows, which are not worth cutting.
#[inline]
pub(crate) fn solve_one(a: &[f64], pivots: &[usize], n: usize, b: &mut [f64]) {
    // Loops of known length for the usual sizes.
    match n {
        1 => solve_one_of(a, pivots, 1, b),
        2 => solve_one_of(a, pivots, 2, b),
        3 => solve_one_of(a, pivots, 3, b),
        n => solve_one_of(a, pivots, n, b),
    }
}

#[inline(always)]
fn solve_one_of(a: &[f64], pivots: &[usize], n: usize, b: &mut [f64]) {
    let (a, pivots, b) = (&a[..n * n], &pivots[..n], &mut b[..n]);
    for (k, &p) in pivots.iter().enumerate() {
        b.swap(k, p);
    }
    for k in 0..n {
        for i in k + 1..n {
            b[i] -= a[i * n + k] * b[k];
        }
    }
    for k in (0..n).rev() {
        b[k] *= a[k * n + k];
        for i in 0..k {
            b[i] -= a[i * n + k] * b[k];
        }
    }
}

/// row − m·known.
#[inline(always)]
fn less(row: &mut [f64], m: f64, known: &[f64]) {
    let known = &known[..row.len()];
    for l in 0..row.len() {
        row[l] -= m * known[l];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One right-hand side has loops of its own: they give the numbers of many sides, to the last digit.
    #[test]
    fn one_side_is_solved_as_many_are() {
        let m = [0.3, 2.0, 1.0, -0.7, 0.0, 1.5, 4.0, 0.5, -2.0, 0.8, 1.1, -0.4, 0.6, 0.9, -1.3, 2.2];
        for n in 1..=4 {
            let (mut a, mut p) = (m[..n * n].to_vec(), vec![0; n]);
            assert!(factor(&mut a, &mut p, n));
            let mut rows: Vec<f64> = (0..2 * n).map(|i| (1.7 * i as f64).sin()).collect();
            let mut sides = [0, 1].map(|l| rows.iter().skip(l).step_by(2).copied().collect::<Vec<_>>());
            let first = sides[0][0];
            solve(&a, &p, n, &mut rows, 2);
            for (l, side) in sides.iter_mut().enumerate() {
                solve(&a, &p, n, side, 1);
                assert!(side.iter().eq(rows.iter().skip(l).step_by(2)), "{n}: {side:?} {rows:?}");
            }
            let row: f64 = m[..n].iter().zip(&sides[0]).map(|(m, x)| m * x).sum();
            assert!((row - first).abs() < 1e-14);
        }
    }

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
        // Each side alone: the same to the last digit.
        for l in 0..2 {
            let mut side: Vec<f64> =
                (0..3).map(|i| (0..3).map(|j| m[i * 3 + j] * x[j * 2 + l]).sum()).collect();
            solve(&a, &p, 3, &mut side, 1);
            assert_eq!(side, [b[l], b[2 + l], b[4 + l]]);
        }
        for (b, x) in b.iter().zip(x) {
            assert!((b - x).abs() < 1e-14);
        }
        let mut singular = [1.0, 2.0, 2.0, 4.0];
        assert!(!factor(&mut singular, &mut p[..2], 2));
    }
}
