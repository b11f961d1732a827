//! Subset selection on the triangular factor: backward elimination and exhaustive best subsets.

use crate::error::SparseError;
use crate::protect::checked;
use crate::triangle::{Fit, Triangle};

/// The most optional columns [`best_subsets`] takes.
pub const MOST_OPTIONAL: usize = 16;

/// A factor of some of a problem's columns, with their numbers.
#[derive(Clone)]
struct Model {
    triangle: Triangle,
    columns: Vec<usize>,
}

impl Model {
    /// The largest independent model, the protected columns first.
    fn start(triangle: &Triangle, protected: &[usize]) -> Result<Self, SparseError> {
        let independent = triangle.independent(protected)?;
        let mut columns = protected.to_vec();
        columns.extend(independent.into_iter().filter(|j| protected.binary_search(j).is_err()));
        Ok(Self { triangle: triangle.select(&columns)?, columns })
    }

    fn without(&self, at: usize) -> Result<Self, SparseError> {
        let mut columns = self.columns.clone();
        let triangle = self.triangle.without(at)?;
        columns.remove(at);
        Ok(Self { triangle, columns })
    }

    fn fit(&self, all: usize) -> Result<Fit, SparseError> {
        let fit = self.triangle.solve()?;
        let mut coefficients = vec![0.0; all];
        for (&j, &c) in self.columns.iter().zip(&fit.coefficients) {
            coefficients[j] = c;
        }
        Ok(Fit { coefficients, rss: fit.rss })
    }
}

/// Backward elimination: from all independent columns down to the protected ones, always without the column
/// whose removal increases the residual sum of squares least, cⱼ² / [(PᵀP)⁻¹]ⱼⱼ. Free of column scales.
/// Returns the nested models, the largest first.
///
/// # Errors
/// [`SparseError::NoSuchColumn`], [`SparseError::RankDeficient`] for the protected columns.
pub fn backward_elimination(triangle: &Triangle, protected: &[usize]) -> Result<Vec<Fit>, SparseError> {
    let protected = checked(protected, triangle.columns())?;
    let mut model = Model::start(triangle, &protected)?;
    let mut path = vec![model.fit(triangle.columns())?];
    while model.columns.len() > protected.len() {
        let k = model.columns.len();
        let fit = model.triangle.solve()?;
        let inverse = model.triangle.inverse_gram()?;
        let increase = |at: usize| fit.coefficients[at].powi(2) / inverse[at * k + at];
        let Some(weakest) = (protected.len()..k).min_by(|&a, &b| increase(a).total_cmp(&increase(b))) else {
            break;
        };
        model = model.without(weakest)?;
        path.push(model.fit(triangle.columns())?);
    }
    Ok(path)
}

/// The model of least residual sum of squares of every size, the largest first: exhaustive in effect, by
/// branch and bound on the tree of single deletions (Furnival & Wilson 1974; Gatu & Kontoghiorghes 2006). A
/// branch is left when even its largest model is no better than what is known for all its sizes.
///
/// # Errors
/// [`SparseError::TooManyColumns`] over [`MOST_OPTIONAL`] optional columns, [`SparseError::NoSuchColumn`],
/// [`SparseError::RankDeficient`] for the protected columns.
pub fn best_subsets(triangle: &Triangle, protected: &[usize]) -> Result<Vec<Fit>, SparseError> {
    let protected = checked(protected, triangle.columns())?;
    let start = Model::start(triangle, &protected)?;
    let optional = start.columns.len() - protected.len();
    if optional > MOST_OPTIONAL {
        return Err(SparseError::TooManyColumns { optional, most: MOST_OPTIONAL });
    }
    // Entry s: the best model with s optional columns.
    let mut best: Vec<Option<(f64, Vec<usize>)>> = vec![None; optional + 1];
    branch(&start, protected.len(), protected.len(), &mut best)?;
    best.into_iter()
        .rev()
        .flatten()
        .map(|(_, mut columns)| {
            columns.sort_unstable();
            triangle.fit(&columns)
        })
        .collect()
}

/// Visits the sub-models that keep the first `fixed` columns of `model`.
fn branch(
    model: &Model,
    fixed: usize,
    protected: usize,
    best: &mut [Option<(f64, Vec<usize>)>],
) -> Result<(), SparseError> {
    // The leading part of a triangle is the triangle of the leading columns.
    let k = model.columns.len();
    let head = model.triangle.head(k, k);
    let bound = model.triangle.last_square();
    let mut rss = bound;
    for size in (fixed..=k).rev() {
        let known = &mut best[size - protected];
        if known.as_ref().is_none_or(|(value, _)| rss < *value) {
            *known = Some((rss, model.columns[..size].to_vec()));
        }
        if size > 0 {
            rss += head[size - 1] * head[size - 1];
        }
    }
    for at in (fixed..k).rev() {
        // Sizes at .. k−1 come from deleting position `at` or later ones before it.
        let hopeless =
            (at..k).all(|size| best[size - protected].as_ref().is_some_and(|(value, _)| *value <= bound));
        if !hopeless {
            branch(&model.without(at)?, at, protected, best)?;
        }
    }
    Ok(())
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::rows::Rows;
    use crate::testing::{design, normal};

    fn correlated(k: usize, seed: u64) -> Triangle {
        let (mut columns, y) = design(80, k, seed);
        let common = normal(80, seed + 500);
        for (j, c) in columns.iter_mut().enumerate() {
            let scale = 10f64.powi(j as i32 % 5 - 2);
            c.iter_mut().zip(&common).for_each(|(v, u)| *v = scale * (*v + u));
        }
        Triangle::of_rows(&Rows::from_vecs(&columns, &y).unwrap(), &[0..80]).unwrap()
    }

    #[test]
    fn best_subsets_equal_the_full_enumeration() {
        for seed in 0..6 {
            let t = correlated(8, seed);
            for protected in [vec![], vec![3], vec![0, 5]] {
                let found = best_subsets(&t, &protected).unwrap();
                assert_eq!(found.len(), 9 - protected.len());
                for (i, fit) in found.iter().enumerate() {
                    let size = 8 - i;
                    let mut least = f64::INFINITY;
                    for mask in 0..256_u32 {
                        let set: Vec<usize> = (0..8).filter(|j| mask >> j & 1 == 1).collect();
                        if set.len() == size && protected.iter().all(|p| set.contains(p)) {
                            least = least.min(t.fit(&set).unwrap().rss);
                        }
                    }
                    assert_eq!(fit.support().len(), size);
                    assert!((fit.rss - least).abs() < 1e-10 * least, "seed {seed}, size {size}");
                }
            }
        }
    }

    #[test]
    fn each_elimination_is_the_cheapest() {
        let t = correlated(9, 11);
        let path = backward_elimination(&t, &[2]).unwrap();
        assert_eq!(path.len(), 9);
        for pair in path.windows(2) {
            let set = pair[0].support();
            let least = set
                .iter()
                .filter(|&&j| j != 2)
                .map(|&out| {
                    let rest: Vec<usize> = set.iter().copied().filter(|&j| j != out).collect();
                    t.fit(&rest).unwrap().rss
                })
                .fold(f64::INFINITY, f64::min);
            assert!((pair[1].rss - least).abs() < 1e-10 * least);
            assert!(pair[1].support().contains(&2));
        }
    }

    #[test]
    fn too_many_columns_is_an_error() {
        let t = correlated(18, 1);
        assert!(matches!(best_subsets(&t, &[]), Err(SparseError::TooManyColumns { optional: 18, .. })));
        assert!(best_subsets(&t, &[0, 1]).is_ok());
    }
}
