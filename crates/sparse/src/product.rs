//! The products of all pairs of columns of a panel, as fast as the machine multiplies.

use pulp::{Arch, Simd, WithSimd};

/// Adds aᵀb of every two columns a, b of a panel to the lower triangle of `sums` (m × m, column-major).
///
/// All columns are as long as the first. The order of the additions depends on the width of the machine's vectors and
/// on nothing else.
pub(crate) fn add_products(columns: &[&[f64]], sums: &mut [f64]) {
    Arch::new().dispatch(Products { columns, sums });
}

struct Products<'a> {
    columns: &'a [&'a [f64]],
    sums: &'a mut [f64],
}

impl WithSimd for Products<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // As many sums at once as the registers hold: 32 of them with the widest vectors, else 16.
        if size_of::<S::f64s>() == 64 { self.tiles::<S, 5>(simd) } else { self.tiles::<S, 3>(simd) }
    }
}

impl Products<'_> {
    /// Tile by tile of W × W pairs, so that W² products need 2 W loads.
    #[inline(always)]
    fn tiles<S: Simd, const W: usize>(self, simd: S) {
        let m = self.columns.len();
        for right in (0..m).step_by(W) {
            for left in (right..m).step_by(W) {
                let tile = simd.vectorize(Tile::<W> { columns: self.columns, left, right });
                for j in 0..W.min(m - right) {
                    for i in 0..W.min(m - left) {
                        self.sums[(right + j) * m + left + i] += tile[j][i];
                    }
                }
            }
        }
    }
}

struct Tile<'a, const W: usize> {
    columns: &'a [&'a [f64]],
    left: usize,
    right: usize,
}

impl<const W: usize> WithSimd for Tile<'_, W> {
    type Output = [[f64; W]; W];

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> [[f64; W]; W] {
        let last = self.columns.len() - 1;
        let length = self.columns[0].len();
        let lanes = size_of::<S::f64s>() / size_of::<f64>();
        let (vectors, rest) = (length / lanes, length - length % lanes);
        // Loops, not closures: a closure is a function of its own, without the vector instructions of this one.
        let none: &[f64] = &[];
        let (mut a, mut b) = ([none; W], [none; W]);
        let (mut av, mut bv) = ([S::as_simd_f64s(none).0; W], [S::as_simd_f64s(none).0; W]);
        for i in 0..W {
            // Beyond the last column the tile repeats it; those sums are not used.
            a[i] = &self.columns[(self.left + i).min(last)][..length];
            b[i] = &self.columns[(self.right + i).min(last)][..length];
            av[i] = &S::as_simd_f64s(a[i]).0[..vectors];
            bv[i] = &S::as_simd_f64s(b[i]).0[..vectors];
        }
        let mut sums = [[simd.splat_f64s(0.0); W]; W];
        for r in 0..vectors {
            let mut x = [simd.splat_f64s(0.0); W];
            for i in 0..W {
                x[i] = av[i][r];
            }
            for j in 0..W {
                let y = bv[j][r];
                for i in 0..W {
                    sums[j][i] = simd.mul_add_f64s(x[i], y, sums[j][i]);
                }
            }
        }
        let mut out = [[0.0; W]; W];
        for j in 0..W {
            for i in 0..W {
                let mut sum = simd.reduce_sum_f64s(sums[j][i]);
                for r in rest..length {
                    sum += a[i][r] * b[j][r];
                }
                out[j][i] = sum;
            }
        }
        out
    }
}

/// Q = P R⁻¹ for the columns P of a panel and an upper triangle R (column-major): a few columns of Q after the others.
pub(crate) fn divide(columns: &[&[f64]], r: &[f64], out: &mut [f64]) {
    Arch::new().dispatch(Division { columns, r, out });
}

struct Division<'a> {
    columns: &'a [&'a [f64]],
    r: &'a [f64],
    out: &'a mut [f64],
}

impl WithSimd for Division<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // Vectors of a column, and columns, that are worked on together: as many as the registers hold.
        if size_of::<S::f64s>() == 64 { self.groups::<S, 8, 3>(simd) } else { self.groups::<S, 4, 3>(simd) }
    }
}

impl Division<'_> {
    /// Rows in groups of V vectors, C columns at a time, so that C·V products need V + C loads.
    #[inline(always)]
    fn groups<S: Simd, const V: usize, const C: usize>(self, simd: S) {
        let Division { columns, r, out } = self;
        let (m, n) = (columns.len(), columns[0].len());
        let width = V * (size_of::<S::f64s>() / size_of::<f64>());
        let whole = n - n % width;
        for start in (0..whole).step_by(width) {
            let mut first = 0;
            while first + C <= m {
                simd.vectorize(Group::<V, C> { columns, r, out, start, first });
                first += C;
            }
            for first in first..m {
                simd.vectorize(Group::<V, 1> { columns, r, out, start, first });
            }
        }
        for row in whole..n {
            for (j, column) in columns.iter().enumerate() {
                let known: f64 = (0..j).map(|i| r[j * m + i] * out[i * n + row]).sum();
                out[j * n + row] = (column[row] - known) / r[j * m + j];
            }
        }
    }
}

/// V vectors, from row `start` on, of C columns from `first` on.
struct Group<'a, const V: usize, const C: usize> {
    columns: &'a [&'a [f64]],
    r: &'a [f64],
    out: &'a mut [f64],
    start: usize,
    first: usize,
}

impl<const V: usize, const C: usize> WithSimd for Group<'_, V, C> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Group { columns, r, out, start, first } = self;
        let (m, n) = (columns.len(), columns[0].len());
        let rows = start..start + V * (size_of::<S::f64s>() / size_of::<f64>());
        let (before, rest) = out.split_at_mut(first * n);
        let mut sums = [[simd.splat_f64s(0.0); V]; C];
        for c in 0..C {
            sums[c].copy_from_slice(S::as_simd_f64s(&columns[first + c][rows.clone()]).0);
        }
        for (i, known) in before.chunks_exact(n).enumerate() {
            let known = &S::as_simd_f64s(&known[rows.clone()]).0[..V];
            for c in 0..C {
                let factor = simd.splat_f64s(-r[(first + c) * m + i]);
                for v in 0..V {
                    sums[c][v] = simd.mul_add_f64s(factor, known[v], sums[c][v]);
                }
            }
        }
        for c in 0..C {
            let factors = &r[(first + c) * m + first..][..=c];
            for b in 0..c {
                let factor = simd.splat_f64s(-factors[b]);
                for v in 0..V {
                    sums[c][v] = simd.mul_add_f64s(factor, sums[b][v], sums[c][v]);
                }
            }
            let inverse = simd.splat_f64s(1.0 / factors[c]);
            let to = S::as_mut_simd_f64s(&mut rest[c * n..][rows.clone()]).0;
            for v in 0..V {
                sums[c][v] = simd.mul_f64s(sums[c][v], inverse);
                to[v] = sums[c][v];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::normal;

    #[test]
    fn a_panel_divided_by_a_triangle_is_the_panel_again_when_multiplied() {
        for (m, n) in [(1, 1), (3, 31), (5, 64), (7, 70)] {
            let columns: Vec<Vec<f64>> = (0..m).map(|j| normal(n, 200 + j as u64)).collect();
            let views: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            let value = |i: usize, j: usize| if i == j { 2.0 + i as f64 } else { 0.3 * (i + j) as f64 };
            let mut r = vec![0.0; m * m];
            for j in 0..m {
                for i in 0..=j {
                    r[j * m + i] = value(i, j);
                }
            }
            let mut q = vec![0.0; m * n];
            divide(&views, &r, &mut q);
            for j in 0..m {
                for row in 0..n {
                    let back: f64 = (0..=j).map(|i| q[i * n + row] * value(i, j)).sum();
                    assert!((back - columns[j][row]).abs() < 1e-12, "{m} {n} {j} {row}");
                }
            }
        }
    }

    #[test]
    fn equals_the_plain_sums_for_every_size() {
        for (m, n) in [(1, 1), (2, 7), (3, 8), (5, 64), (6, 65), (11, 33), (16, 127)] {
            let columns: Vec<Vec<f64>> = (0..m).map(|j| normal(n, 100 + j as u64)).collect();
            let views: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            let mut sums = vec![1.0; m * m];
            add_products(&views, &mut sums);
            for j in 0..m {
                for i in 0..m {
                    let plain: f64 = columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum();
                    let wanted = if i >= j { 1.0 + plain } else { 1.0 };
                    // A tile on the diagonal holds both halves.
                    if i >= j {
                        assert!((sums[j * m + i] - wanted).abs() < 1e-12 * n as f64, "{m} {n} {i} {j}");
                    }
                }
            }
        }
    }
}
