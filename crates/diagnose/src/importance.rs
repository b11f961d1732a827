//! The importance of a mechanism: its share of the residual that all of them explain.

use rayon::prelude::*;

use crate::diagnosis::Subset;
use crate::fitted::FittedModel;
use crate::search::Search;

/// Residual sum of squares with each part alone, refitted; `without` is that without each part, `base` that without all.
pub(crate) fn rss_alone(
    search: &Search<'_>,
    (calibrated, improved): (&FittedModel, &FittedModel),
    scale: &[f64],
    without: &[f64],
    base: f64,
) -> Vec<f64> {
    match without {
        // All there is, and without the other.
        [] | [_] => vec![0.0; without.len()],
        [first, second] => vec![*second, *first],
        _ => (0..without.len())
            .into_par_iter()
            .map(|i| {
                let others: Vec<usize> = (0..without.len()).rev().filter(|&j| j != i).collect();
                search.rss_without(improved, &others, calibrated, scale).unwrap_or(base)
            })
            .collect(),
    }
}

/// What is left of the residual with each part `alone` and `without` each, for parts that are reported in the order of their
/// shares; nothing where there are no two.
pub(crate) fn subsets_of(shares: &[f64], [alone, without]: [Vec<f64>; 2], all: f64) -> Vec<Subset> {
    let n = shares.len();
    if n < 2 {
        return Vec::new();
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| shares[*b].total_cmp(&shares[*a]));
    let mut subsets = vec![Subset { mechanisms: Vec::new(), left: 1.0 }];
    subsets.extend(order.iter().enumerate().map(|(at, i)| Subset { mechanisms: vec![at], left: alone[*i] }));
    if n > 2 {
        subsets.extend(order.iter().enumerate().rev().map(|(at, i)| Subset {
            mechanisms: (0..n).filter(|other| *other != at).collect(),
            left: without[*i],
        }));
    }
    subsets.push(Subset { mechanisms: (0..n).collect(), left: all });
    subsets
}

/// What each part explains of a residual of which they explain `all`: the mean of what it takes away alone (`gained`)
/// and of what is missed without it (`lost`), which are two figures where parts take over from each other, scaled so
/// that they add up. Of two parts it is Shapley's value (L. S. Shapley, *A value for n-person games*, 1953).
pub(crate) fn divided(lost: &[f64], gained: &[f64], all: f64) -> Vec<f64> {
    if lost.len() < 2 {
        return lost.to_vec();
    }
    let means: Vec<f64> = lost.iter().zip(gained).map(|(l, g)| 0.5 * (l + g)).collect();
    let sum: f64 = means.iter().sum();
    means.into_iter().map(|m| if sum > 0.0 { m * all / sum } else { 0.0 }).collect()
}
