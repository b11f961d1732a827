//! Rows compressed by orthogonal transformation: the R factor of [P p].
//!
//! Householder QR acts on every column alone, so R of `[P D, p]` is R of `[P, p]` with its columns scaled by
//! the diagonal D: the factor, its rank test (relative to each column's norm) and the back substitution do not
//! notice columns of very different size. With R everything a linear model needs costs p³ and no row is read
//! again; residual sums come out as norms, without the cancellation of pᵀp − 2cᵀPᵀp + cᵀPᵀP c.

use std::ops::Range;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::qr::no_pivoting::factor::{qr_in_place, qr_in_place_scratch, recommended_block_size};
use faer::{Mat, Par};

use crate::error::SparseError;
use crate::gram::{Gram, PANEL};
use crate::product::{add_products, divide};
use crate::rows::{Rows, count, panels};

/// A column whose part orthogonal to its predecessors is below this fraction of its norm is dependent.
pub const RANK_TOLERANCE: f64 = 1e-12;

/// A Gram matrix whose relative pivot is below this is not factorised: half its digits would be gone.
const PIVOT_TOLERANCE: f64 = 1e-9;

/// From so many rows per column on it pays to read the rows twice rather than to reflect them.
const TALL: usize = 8;

/// Squares of norms between this and its inverse are far from where numbers lose digits.
const SMALLEST_SQUARE: f64 = 1e-200;

/// The upper triangular factor R of `[P p]` = Q R for n rows and k columns: (k + 1) × (k + 1).
///
/// ```
/// use greybox_sparse::{Rows, Triangle};
/// let (a, b) = ([1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 2.0, 3.0]);
/// let y = [1.0, 3.0, 5.0, 7.0];
/// let triangle = Triangle::of_rows(&Rows::new(&[&a, &b], &y)?, &[0..4])?;
/// let fit = triangle.fit(&[0, 1])?;
/// assert!((fit.coefficients[0] - 1.0).abs() < 1e-12 && (fit.coefficients[1] - 2.0).abs() < 1e-12);
/// assert!(fit.rss < 1e-24);
/// # Ok::<(), greybox_sparse::SparseError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Triangle {
    /// k + 1.
    order: usize,
    /// Column-major, zero below the diagonal.
    r: Vec<f64>,
    rows: usize,
}

/// A least-squares fit: coefficients over all columns (zero outside the model) and its residual sum of squares.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// One per column of the problem.
    pub coefficients: Vec<f64>,
    /// ‖p − P c‖².
    pub rss: f64,
}

impl Fit {
    /// Indices of the non-zero coefficients.
    #[must_use]
    pub fn support(&self) -> Vec<usize> {
        support(&self.coefficients)
    }
}

/// Indices of the non-zero entries.
#[must_use]
pub fn support(coefficients: &[f64]) -> Vec<usize> {
    (0..coefficients.len()).filter(|&j| coefficients[j] != 0.0).collect()
}

impl Triangle {
    /// Factorises the rows in `ranges`: by Cholesky QR in two passes where the columns are independent enough for it
    /// to be as accurate as Householder's (each pass runs at the machine's speed of multiplication), else by blocked
    /// Householder QR.
    ///
    /// # Errors
    /// [`SparseError::RowRange`] or [`SparseError::Empty`] for unusable ranges.
    pub fn of_rows(rows: &Rows<'_>, ranges: &[Range<usize>]) -> Result<Self, SparseError> {
        crate::rows::check_ranges(ranges, rows.rows())?;
        let n = count(ranges);
        let k = rows.columns();
        if n >= TALL * (k + 1)
            && let Some(triangle) = Self::of_tall_rows(rows, ranges)
        {
            return Ok(triangle);
        }
        let mut a = Mat::zeros(n, k + 1);
        for j in 0..=k {
            let from = if j < k { rows.column(j) } else { rows.target() };
            let mut to = a.col_mut(j).try_as_col_major_mut().map(|c| c.as_slice_mut());
            let mut at = 0;
            for range in ranges {
                let piece = &from[range.clone()];
                if let Some(to) = to.as_deref_mut() {
                    to[at..at + piece.len()].copy_from_slice(piece);
                }
                at += piece.len();
            }
        }
        Ok(Self::factor(a, n))
    }

    /// Cholesky QR, twice: R₁ of the Gram matrix, then R₂ of the Gram matrix of P R₁⁻¹, which is nearly orthonormal;
    /// R = R₂ R₁ (Yamamoto, Nakatsukasa, Yanagisawa & Fukaya, ETNA 44 (2015)). `None` where a column or the target
    /// depends so much on the columns before that the first factor keeps too few digits, or where squares overflow.
    fn of_tall_rows(rows: &Rows<'_>, ranges: &[Range<usize>]) -> Option<Self> {
        let gram = Gram::of_rows(rows, ranges).ok()?;
        let (k, n) = (gram.columns(), gram.rows());
        let order = k + 1;
        if !(0..order).all(|j| (SMALLEST_SQUARE..=1.0 / SMALLEST_SQUARE).contains(&gram.augmented(j, j))) {
            return None;
        }
        let first = Self::of_gram(&gram).ok()?;
        if first.last_square() <= PIVOT_TOLERANCE * gram.target_square() {
            return None;
        }
        let mut sums = vec![0.0; order * order];
        let mut panel = vec![0.0; order * PANEL.min(n)];
        let mut columns: Vec<&[f64]> = Vec::with_capacity(order);
        for range in panels(ranges, PANEL) {
            let count = range.len();
            columns.clear();
            columns.extend((0..k).map(|j| &rows.column(j)[range.clone()]));
            columns.push(&rows.target()[range]);
            divide(&columns, &first.r, &mut panel[..order * count]);
            let orthonormal: Vec<&[f64]> = panel[..order * count].chunks_exact(count).collect();
            add_products(&orthonormal, &mut sums);
        }
        let second = Self::of_gram(&Gram::from_lower(sums, k, n)).ok()?;
        let mut r = vec![0.0; order * order];
        for j in 0..order {
            for i in 0..=j {
                r[j * order + i] = (i..=j).map(|l| second.at(i, l) * first.at(l, j)).sum();
            }
        }
        r.iter().all(|v| v.is_finite()).then_some(Self { order, r, rows: n })
    }

    /// The factor of all rows behind several triangles over the same columns.
    ///
    /// # Errors
    /// [`SparseError::Empty`] without triangles, [`SparseError::Length`] for unequal numbers of columns.
    pub fn stacked(parts: &[&Self]) -> Result<Self, SparseError> {
        let first = parts.first().ok_or(SparseError::Empty { what: "row parts" })?;
        let order = first.order;
        if let Some(bad) = parts.iter().find(|t| t.order != order) {
            return Err(SparseError::Length {
                what: "the columns of a part".into(),
                found: bad.columns(),
                expected: first.columns(),
            });
        }
        if let [one] = parts {
            return Ok((*one).clone());
        }
        let rows = parts.iter().map(|t| t.rows).sum();
        let a = Mat::from_fn(parts.len() * order, order, |i, j| parts[i / order].at(i % order, j));
        Ok(Self::factor(a, rows))
    }

    /// The Cholesky factor of a Gram matrix. It has only half the digits of the QR factor.
    ///
    /// # Errors
    /// [`SparseError::IllConditioned`] if a column keeps too few digits; factorise the rows then.
    pub fn of_gram(gram: &Gram) -> Result<Self, SparseError> {
        let order = gram.columns() + 1;
        let mut r = vec![0.0; order * order];
        for j in 0..order {
            let norm2 = gram.augmented(j, j);
            for i in 0..=j {
                let (head, tail) = r.split_at(j * order);
                let dot: f64 = (0..i)
                    .map(|l| if i == j { tail[l] * tail[l] } else { head[i * order + l] * tail[l] })
                    .sum();
                let left = gram.augmented(i, j) - dot;
                if i < j {
                    let pivot = r[i * order + i];
                    r[j * order + i] = if pivot > 0.0 { left / pivot } else { 0.0 };
                } else if j + 1 < order && left <= PIVOT_TOLERANCE * norm2 {
                    return Err(SparseError::IllConditioned {
                        column: j,
                        pivot: if norm2 > 0.0 { left / norm2 } else { 0.0 },
                    });
                } else {
                    r[j * order + j] = left.max(0.0).sqrt();
                }
            }
        }
        Ok(Self { order, r, rows: gram.rows() })
    }

    fn factor(mut a: Mat<f64>, rows: usize) -> Self {
        let (m, n) = (a.nrows(), a.ncols());
        let size = m.min(n);
        let block = recommended_block_size::<f64>(m, n);
        let mut coefficients = Mat::zeros(block, size);
        qr_in_place(
            a.as_mut(),
            coefficients.as_mut(),
            Par::Seq,
            MemStack::new(&mut MemBuffer::new(qr_in_place_scratch::<f64>(
                m,
                n,
                block,
                Par::Seq,
                Default::default(),
            ))),
            Default::default(),
        );
        let mut r = vec![0.0; n * n];
        for j in 0..n {
            for i in 0..=j.min(size.saturating_sub(1)) {
                r[j * n + i] = a[(i, j)];
            }
        }
        Self { order: n, r, rows }
    }

    #[inline]
    fn at(&self, i: usize, j: usize) -> f64 {
        self.r[j * self.order + i]
    }

    fn column(&self, j: usize) -> &[f64] {
        &self.r[j * self.order..(j + 1) * self.order]
    }

    /// Number of columns k (without the target).
    #[must_use]
    pub fn columns(&self) -> usize {
        self.order - 1
    }

    /// Number of rows behind the factor.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// ‖column j‖₂ over the rows; j = k is the target.
    #[must_use]
    pub fn norm(&self, j: usize) -> f64 {
        if j < self.order { norm(self.column(j)) } else { 0.0 }
    }

    /// ‖p‖₂ over the rows.
    #[must_use]
    pub fn target_norm(&self) -> f64 {
        self.norm(self.order - 1)
    }

    /// The factor for the first `count` columns and the target: no arithmetic beyond one norm.
    #[must_use]
    pub fn first_columns(&self, count: usize) -> Self {
        let k = count.min(self.columns());
        let order = k + 1;
        let mut r = vec![0.0; order * order];
        for j in 0..k {
            r[j * order..(j + 1) * order].copy_from_slice(&self.column(j)[..order]);
        }
        let target = self.column(self.order - 1);
        r[k * order..k * order + k].copy_from_slice(&target[..k]);
        r[k * order + k] = norm(&target[k..]);
        Self { order, r, rows: self.rows }
    }

    /// The factor for the chosen columns, in the order given, and the target.
    ///
    /// # Errors
    /// [`SparseError::NoSuchColumn`].
    pub fn select(&self, columns: &[usize]) -> Result<Self, SparseError> {
        if let Some(&column) = columns.iter().find(|&&j| j >= self.columns()) {
            return Err(SparseError::NoSuchColumn { column, columns: self.columns() });
        }
        if columns.iter().enumerate().all(|(i, &j)| i == j) {
            return Ok(self.first_columns(columns.len()));
        }
        let k = columns.len();
        let a = Mat::from_fn(self.order, k + 1, |i, j| {
            self.at(i, if j < k { columns[j] } else { self.order - 1 })
        });
        Ok(Self::factor(a, self.rows))
    }

    /// The factor without column `column`: its successors move left and Givens rotations restore the triangle.
    ///
    /// # Errors
    /// [`SparseError::NoSuchColumn`].
    pub fn without(&self, column: usize) -> Result<Self, SparseError> {
        if column >= self.columns() {
            return Err(SparseError::NoSuchColumn { column, columns: self.columns() });
        }
        let (old, new) = (self.order, self.order - 1);
        // One row more than columns until the rotations have emptied the last.
        let mut work: Vec<f64> = Vec::with_capacity(old * new);
        for j in (0..old).filter(|&j| j != column) {
            work.extend_from_slice(self.column(j));
        }
        for j in column..new {
            let (a, b) = (work[j * old + j], work[j * old + j + 1]);
            let h = a.hypot(b);
            if h == 0.0 {
                continue;
            }
            let (c, s) = (a / h, b / h);
            for l in j..new {
                let (u, v) = (work[l * old + j], work[l * old + j + 1]);
                work[l * old + j] = c * u + s * v;
                work[l * old + j + 1] = c * v - s * u;
            }
        }
        let r = work.chunks(old).flat_map(|column| column[..new].iter().copied()).collect();
        Ok(Self { order: new, r, rows: self.rows })
    }

    /// ‖p − P c‖² over the rows behind the factor; coefficients beyond the columns are ignored.
    #[must_use]
    pub fn rss(&self, coefficients: &[f64]) -> f64 {
        let mut left = self.column(self.order - 1).to_vec();
        for (j, &c) in coefficients.iter().enumerate().take(self.columns()) {
            if c != 0.0 {
                for (l, &v) in left.iter_mut().zip(&self.column(j)[..=j]) {
                    *l -= c * v;
                }
            }
        }
        let size = norm(&left);
        size * size
    }

    /// The first column that depends on its predecessors, with the fraction of it that does not.
    #[must_use]
    pub fn first_dependent(&self) -> Option<(usize, f64)> {
        (0..self.columns()).find_map(|j| {
            let (size, own) = (norm(self.column(j)), self.at(j, j).abs());
            (own <= RANK_TOLERANCE * size).then_some((j, if size > 0.0 { own / size } else { 0.0 }))
        })
    }

    /// A largest independent set of columns, ascending: the protected ones first, then the others in their
    /// order, each taken if it does not depend on those taken before.
    ///
    /// # Errors
    /// [`SparseError::RankDeficient`] if the protected columns are dependent.
    pub fn independent(&self, protected: &[usize]) -> Result<Vec<usize>, SparseError> {
        let mut order: Vec<usize> = protected.to_vec();
        order.extend((0..self.columns()).filter(|j| !protected.contains(j)));
        loop {
            match self.select(&order)?.first_dependent() {
                None => break,
                Some((at, relative)) if at < protected.len() => {
                    return Err(SparseError::RankDeficient { column: order[at], relative });
                }
                Some((at, _)) => {
                    order.remove(at);
                }
            }
        }
        order.sort_unstable();
        Ok(order)
    }

    /// Solution of the full model behind this factor by back substitution.
    ///
    /// # Errors
    /// [`SparseError::RankDeficient`] naming the dependent column.
    pub fn solve(&self) -> Result<Fit, SparseError> {
        if let Some((column, relative)) = self.first_dependent() {
            return Err(SparseError::RankDeficient { column, relative });
        }
        let k = self.columns();
        let mut c = self.column(k)[..k].to_vec();
        self.back_substitute(&mut c);
        let last = self.at(k, k);
        Ok(Fit { coefficients: c, rss: last * last })
    }

    /// Least squares on the columns in `active` only.
    ///
    /// # Errors
    /// [`SparseError::NoSuchColumn`], [`SparseError::RankDeficient`] (naming the column of the problem).
    pub fn fit(&self, active: &[usize]) -> Result<Fit, SparseError> {
        let part = self.select(active)?.solve().map_err(|error| match error {
            SparseError::RankDeficient { column, relative } => {
                SparseError::RankDeficient { column: active[column], relative }
            }
            other => other,
        })?;
        let mut coefficients = vec![0.0; self.columns()];
        for (&j, &c) in active.iter().zip(&part.coefficients) {
            coefficients[j] = c;
        }
        Ok(Fit { coefficients, rss: part.rss })
    }

    /// The first `count` entries of column `j` of R (the target is column k).
    pub(crate) fn head(&self, j: usize, count: usize) -> Vec<f64> {
        self.column(j)[..count].to_vec()
    }

    /// Residual sum of squares of the model on all columns behind this factor.
    pub(crate) fn last_square(&self) -> f64 {
        self.at(self.order - 1, self.order - 1).powi(2)
    }

    /// x ← R⁻¹ x for the k × k leading part.
    pub(crate) fn back_substitute(&self, x: &mut [f64]) {
        for j in (0..x.len()).rev() {
            x[j] /= self.at(j, j);
            let value = x[j];
            for (x, &r) in x[..j].iter_mut().zip(self.column(j)) {
                *x -= r * value;
            }
        }
    }

    /// (PᵀP)⁻¹ of the full model, k × k column-major and symmetric.
    ///
    /// # Errors
    /// [`SparseError::RankDeficient`].
    pub fn inverse_gram(&self) -> Result<Vec<f64>, SparseError> {
        if let Some((column, relative)) = self.first_dependent() {
            return Err(SparseError::RankDeficient { column, relative });
        }
        let k = self.columns();
        let mut inverse = vec![0.0; k * k];
        for j in 0..k {
            let x = &mut inverse[j * k..j * k + j + 1];
            x[j] = 1.0;
            self.back_substitute(x);
        }
        let mut out = vec![0.0; k * k];
        for a in 0..k {
            for b in 0..=a {
                let sum: f64 = (a..k).map(|l| inverse[l * k + a] * inverse[l * k + b]).sum();
                out[a * k + b] = sum;
                out[b * k + a] = sum;
            }
        }
        Ok(out)
    }

    /// The same rows as a Gram matrix RᵀR.
    #[must_use]
    pub fn gram(&self) -> Gram {
        let m = self.order;
        let mut values = vec![0.0; m * m];
        for a in 0..m {
            for b in 0..=a {
                let sum: f64 = self.column(a)[..=b].iter().zip(self.column(b)).map(|(x, y)| x * y).sum();
                values[a * m + b] = sum;
                values[b * m + a] = sum;
            }
        }
        Gram::from_augmented(values, m - 1, self.rows)
    }

    /// The factor of the rows after the first `count` columns have been projected out of the others and the
    /// target (Frisch–Waugh): the trailing triangle.
    #[must_use]
    pub(crate) fn trailing(&self, count: usize) -> Self {
        let order = self.order - count.min(self.columns());
        let from = self.order - order;
        let r = (from..self.order).flat_map(|j| self.column(j)[from..].iter().copied()).collect();
        Self { order, r, rows: self.rows }
    }
}

/// Euclidean norm, safe against overflow and underflow of the squares.
pub(crate) fn norm(values: &[f64]) -> f64 {
    let largest = values.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    if largest == 0.0 || !largest.is_finite() {
        return largest;
    }
    if (1e-140..1e140).contains(&largest) {
        return values.iter().map(|v| v * v).sum::<f64>().sqrt();
    }
    largest * values.iter().map(|v| (v / largest).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::testing::{design, normal};

    fn rows_of(columns: &[Vec<f64>], y: &[f64]) -> Triangle {
        Triangle::of_rows(&Rows::from_vecs(columns, y).unwrap(), &[0..y.len()]).unwrap()
    }

    #[test]
    fn hilbert_like_polynomial_is_solved() {
        // Degree 9 on [0, 1]: the Gram matrix has condition 1e13, R only its root.
        let n = 200;
        let t: Vec<f64> = (0..n).map(|i| i as f64 / (n - 1) as f64).collect();
        let columns: Vec<Vec<f64>> = (0..10).map(|p| t.iter().map(|t| t.powi(p)).collect()).collect();
        let y: Vec<f64> = (0..n).map(|i| columns.iter().map(|c| c[i]).sum()).collect();
        let triangle = rows_of(&columns, &y);
        let fit = triangle.solve().unwrap();
        for c in fit.coefficients {
            assert!((c - 1.0).abs() < 1e-8, "{c}");
        }
        assert!(matches!(Triangle::of_gram(&triangle.gram()), Err(SparseError::IllConditioned { .. })));
    }

    #[test]
    fn twelve_decades_of_scale() {
        let (columns, _) = design(300, 6, 3);
        let noise = normal(300, 9);
        let scales = [1e6, 1e-6, 1.0, 1e3, 1e-3, 1e5];
        let y: Vec<f64> = (0..300)
            .map(|i| columns[0][i] - 2.0 * columns[1][i] + 0.5 * columns[4][i] + 0.01 * noise[i])
            .collect();
        let scaled: Vec<Vec<f64>> =
            columns.iter().zip(scales).map(|(c, s)| c.iter().map(|v| v * s).collect()).collect();
        let plain = rows_of(&columns, &y).solve().unwrap();
        let fit = rows_of(&scaled, &y).solve().unwrap();
        for j in 0..6 {
            let back = fit.coefficients[j] * scales[j];
            assert!((back - plain.coefficients[j]).abs() < 1e-13 * 10.0);
        }
        assert!((fit.rss - plain.rss).abs() < 1e-12 * plain.rss);
    }

    #[test]
    fn selection_deletion_and_stacking_agree_with_direct_factors() {
        let (columns, y) = design(120, 7, 5);
        let rows = Rows::from_vecs(&columns, &y).unwrap();
        let all = Triangle::of_rows(&rows, &[0..120]).unwrap();
        let parts: Vec<Triangle> =
            [0..50, 50..51, 51..120].into_iter().map(|r| Triangle::of_rows(&rows, &[r]).unwrap()).collect();
        let stacked = Triangle::stacked(&parts.iter().collect::<Vec<_>>()).unwrap();
        assert_eq!(stacked.rows(), 120);
        let direct = {
            let chosen: Vec<Vec<f64>> = [0, 2, 3, 5, 6].iter().map(|&j| columns[j].clone()).collect();
            rows_of(&chosen, &y).solve().unwrap()
        };
        let deleted = all.without(1).unwrap().without(3).unwrap().solve().unwrap();
        for t in [&all, &stacked] {
            let fit = t.fit(&[0, 2, 3, 5, 6]).unwrap();
            let compact: Vec<f64> = fit.support().iter().map(|&j| fit.coefficients[j]).collect();
            for ((a, b), c) in compact.iter().zip(&direct.coefficients).zip(&deleted.coefficients) {
                assert!((a - b).abs() < 1e-12 && (a - c).abs() < 1e-12);
            }
            assert!((fit.rss - direct.rss).abs() < 1e-11 * direct.rss);
            assert!((t.rss(&fit.coefficients) - direct.rss).abs() < 1e-11 * direct.rss);
        }
        assert!((deleted.rss - direct.rss).abs() < 1e-11 * direct.rss);
    }

    #[test]
    fn dependent_columns_are_left_out_or_named() {
        let (mut columns, y) = design(60, 3, 7);
        let sum: Vec<f64> = (0..60).map(|i| columns[0][i] + 1e6 * columns[2][i]).collect();
        columns.push(sum);
        columns.push(vec![0.0; 60]);
        let triangle = rows_of(&columns, &y);
        assert_eq!(triangle.independent(&[]).unwrap(), [0, 1, 2]);
        assert_eq!(triangle.independent(&[3]).unwrap(), [0, 1, 3]);
        assert!(matches!(triangle.independent(&[4]), Err(SparseError::RankDeficient { column: 4, .. })));
        assert!(matches!(triangle.fit(&[0, 2, 3]), Err(SparseError::RankDeficient { column: 3, .. })));
        assert!(matches!(triangle.fit(&[9]), Err(SparseError::NoSuchColumn { column: 9, .. })));
    }

    #[test]
    fn fewer_rows_than_columns_is_an_error_not_a_panic() {
        let (columns, y) = design(3, 5, 8);
        let triangle = rows_of(&columns, &y);
        assert!(matches!(triangle.solve(), Err(SparseError::RankDeficient { column: 3, .. })));
        assert_eq!(triangle.independent(&[]).unwrap(), [0, 1, 2]);
    }
}
