//! Upper triangular factors, row by row, and Givens rotations.

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
