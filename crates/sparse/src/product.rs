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

/// Sums that one pass over the rows makes at once: with a vector of a row and a factor they fill 16 registers.
const SUMS: usize = 9;

/// Rows that lie one after the other, the target first, then the columns, then zeros.
pub(crate) struct RowPanel {
    values: Vec<f64>,
    columns: usize,
    stride: usize,
}

impl RowPanel {
    /// Room for so many rows of so many columns.
    pub(crate) fn new(rows: usize, columns: usize) -> Self {
        // Whole vectors, whatever their width, and whole groups of sums.
        let stride = (1 + columns.next_multiple_of(8)).next_multiple_of(SUMS);
        Self { values: vec![0.0; rows * stride], columns, stride }
    }

    /// Takes the first rows from their columns, all of one length.
    pub(crate) fn fill<'a>(&mut self, target: &'a [f64], columns: impl Iterator<Item = &'a [f64]>) {
        for (place, column) in std::iter::once(target).chain(columns).enumerate() {
            for (row, value) in self.values.chunks_exact_mut(self.stride).zip(column) {
                row[place] = *value;
            }
        }
    }

    /// Adds w r rᵀ of every row r = [columns, target] picked, with its weight, to the lower triangle of `sums`
    /// (column-major). The order of the additions is that of the rows, whatever the width of the machine's vectors.
    pub(crate) fn add_products(&self, picked: &[(u32, f64)], sums: &mut [f64]) {
        Arch::new().dispatch(Weighted { panel: self, picked, sums });
    }
}

struct Weighted<'a> {
    panel: &'a RowPanel,
    picked: &'a [(u32, f64)],
    sums: &'a mut [f64],
}

impl WithSimd for Weighted<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Weighted { panel, picked, sums } = self;
        let (k, m) = (panel.columns, panel.columns + 1);
        let lanes = size_of::<S::f64s>() / size_of::<f64>();
        let mut tile = [0.0; SUMS * 8];
        for first in (0..k).step_by(lanes) {
            // The target, and the columns up to the last of this vector.
            for group in (0..(first + lanes).min(k) + 1).step_by(SUMS) {
                simd.vectorize(WeightedTile { panel, picked, first, group, out: &mut tile });
                for (factor, products) in (group..).zip(tile[..SUMS * lanes].chunks_exact(lanes)) {
                    for (i, product) in (first..k).zip(products) {
                        match factor.checked_sub(1) {
                            None => sums[i * m + k] += product,
                            Some(j) if j <= i => sums[j * m + i] += product,
                            Some(_) => {}
                        }
                    }
                }
            }
        }
        for &(row, weight) in picked {
            let target = panel.values[row as usize * panel.stride];
            sums[k * m + k] += weight * target * target;
        }
    }
}

/// The products of a vector of columns from `first` on with the factors from `group` on.
struct WeightedTile<'a> {
    panel: &'a RowPanel,
    picked: &'a [(u32, f64)],
    first: usize,
    group: usize,
    out: &'a mut [f64; SUMS * 8],
}

impl WithSimd for WeightedTile<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let lanes = size_of::<S::f64s>() / size_of::<f64>();
        let mut sums = [simd.splat_f64s(0.0); SUMS];
        for &(row, weight) in self.picked {
            let row = &self.panel.values[row as usize * self.panel.stride..][..self.panel.stride];
            let values = S::as_simd_f64s(&row[1 + self.first..][..lanes]).0[0];
            let factors = &row[self.group..][..SUMS];
            let weighted = simd.mul_f64s(simd.splat_f64s(weight), values);
            for b in 0..SUMS {
                sums[b] = simd.mul_add_f64s(simd.splat_f64s(factors[b]), weighted, sums[b]);
            }
        }
        for b in 0..SUMS {
            S::as_mut_simd_f64s(&mut self.out[b * lanes..][..lanes]).0[0] = sums[b];
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

    #[test]
    fn weighted_rows_equal_the_plain_sums_for_every_size() {
        for (k, n) in [(1, 1), (2, 7), (7, 9), (8, 64), (9, 33), (16, 100), (17, 65), (24, 30)] {
            let columns: Vec<Vec<f64>> = (0..=k).map(|j| normal(n, 300 + j as u64)).collect();
            let mut panel = RowPanel::new(n, k);
            panel.fill(&columns[k], columns[..k].iter().map(Vec::as_slice));
            let weights: Vec<u32> = (0..n).map(|i| (i * i % 4) as u32).collect();
            let picked: Vec<(u32, f64)> =
                (0..).zip(&weights).filter(|(_, w)| **w > 0).map(|(i, w)| (i, f64::from(*w))).collect();
            let m = k + 1;
            let mut sums = vec![1.0; m * m];
            panel.add_products(&picked, &mut sums);
            for j in 0..m {
                for i in 0..m {
                    let rows = columns[i].iter().zip(&columns[j]).zip(&weights);
                    let plain: f64 = rows.map(|((a, b), w)| f64::from(*w) * a * b).sum();
                    let wanted = if i >= j { 1.0 + plain } else { 1.0 };
                    assert!((sums[j * m + i] - wanted).abs() < 1e-12 * (n as f64 + 1.0), "{k} {n} {i} {j}");
                }
            }
        }
    }
}
