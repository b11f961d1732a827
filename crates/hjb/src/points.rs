//! Collocation points: grids, Halton's sequence and Smolyak's sparse grids on a box.

use crate::error::HjbError;

/// Most points of one set.
pub const MOST_POINTS: usize = 2_000_000;

/// A box of states.
#[derive(Debug, Clone, PartialEq)]
pub struct Domain {
    bounds: Vec<(f64, f64)>,
}

impl Domain {
    /// A box from its lower and upper bound in every state. It should hold the origin: V is a series about it.
    ///
    /// # Errors
    /// [`HjbError::Domain`] for no bounds, a lower bound that is not below the upper one, or a bound that is not
    /// finite.
    pub fn new(bounds: &[(f64, f64)]) -> Result<Domain, HjbError> {
        if bounds.is_empty() {
            return Err(HjbError::Domain { state: 1, low: f64::NAN, high: f64::NAN });
        }
        match bounds.iter().position(|(a, b)| !(a.is_finite() && b.is_finite() && a < b)) {
            None => Ok(Domain { bounds: bounds.to_vec() }),
            Some(i) => Err(HjbError::Domain { state: i + 1, low: bounds[i].0, high: bounds[i].1 }),
        }
    }

    /// The box |xᵢ| ≤ sizeᵢ.
    ///
    /// # Errors
    /// [`HjbError::Domain`] for a size that is not positive and finite.
    pub fn symmetric(sizes: &[f64]) -> Result<Domain, HjbError> {
        Domain::new(&sizes.iter().map(|s| (-s, *s)).collect::<Vec<_>>())
    }

    /// Number of states.
    #[must_use]
    pub fn states(&self) -> usize {
        self.bounds.len()
    }

    /// Bounds per state.
    #[must_use]
    pub fn bounds(&self) -> &[(f64, f64)] {
        &self.bounds
    }

    fn at(&self, unit: &[f64]) -> Vec<f64> {
        self.bounds.iter().zip(unit).map(|((a, b), u)| a + (b - a) * u).collect()
    }

    /// The mesh of thesis §4.3.2.3: every combination of evenly spaced values, bounds included, the last state
    /// fastest. One count takes the middle of its range.
    ///
    /// # Errors
    /// [`HjbError::Points`] when the counts do not fit the domain or make no points, or too many.
    pub fn grid(&self, counts: &[usize]) -> Result<Vec<Vec<f64>>, HjbError> {
        let total: f64 = counts.iter().map(|c| *c as f64).product();
        if counts.len() != self.states() || !(1.0..=MOST_POINTS as f64).contains(&total) {
            return Err(HjbError::Points { wanted: total, most: MOST_POINTS });
        }
        let mut points = Vec::with_capacity(total as usize);
        let mut index = vec![0; counts.len()];
        loop {
            let unit: Vec<f64> = index
                .iter()
                .zip(counts)
                .map(|(i, c)| if *c == 1 { 0.5 } else { *i as f64 / (c - 1) as f64 })
                .collect();
            points.push(self.at(&unit));
            let Some(next) = (0..counts.len()).rev().find(|k| index[*k] + 1 < counts[*k]) else { break };
            index[next] += 1;
            index[next + 1..].fill(0);
        }
        Ok(points)
    }

    /// The first `count` points of Halton's sequence (J. Halton 1960), evenly spread whatever their number, the same
    /// every time.
    ///
    /// Three per function of the basis were enough on a family of plants of two to eight states, where a grid has to have
    /// as many values of each state as the degree of the basis to determine the weights at all:
    /// `cargo xtask reproduce --only Sampling`.
    ///
    /// # Errors
    /// [`HjbError::Points`] for none or too many.
    pub fn halton(&self, count: usize) -> Result<Vec<Vec<f64>>, HjbError> {
        if !(1..=MOST_POINTS).contains(&count) {
            return Err(HjbError::Points { wanted: count as f64, most: MOST_POINTS });
        }
        let bases = primes(self.states());
        let point = |k: usize| self.at(&bases.iter().map(|b| radical_inverse(k, *b)).collect::<Vec<_>>());
        Ok((1..=count).map(point).collect())
    }

    /// The points of Smolyak's sparse grid (S. Smolyak 1963) of Chebyshev extrema: `level` 1 is the centre, 2 the
    /// centres of all faces besides; a level more resolves a degree more in every direction, at a cost that grows
    /// with a power of the number of states and not exponentially.
    ///
    /// # Errors
    /// [`HjbError::Points`] for level zero, or too many points.
    pub fn sparse_grid(&self, level: usize) -> Result<Vec<Vec<f64>>, HjbError> {
        if level == 0 || level > 20 {
            return Err(HjbError::Points {
                wanted: if level == 0 { 0.0 } else { f64::INFINITY },
                most: MOST_POINTS,
            });
        }
        let mut points = Vec::new();
        let mut unit = vec![0.5; self.states()];
        self.sparse(&mut unit, 0, level - 1, &mut points)?;
        Ok(points)
    }

    /// All points whose levels from state `at` on add up to at most `left`; each belongs to one set of levels.
    fn sparse(
        &self,
        unit: &mut [f64],
        at: usize,
        left: usize,
        out: &mut Vec<Vec<f64>>,
    ) -> Result<(), HjbError> {
        if at == unit.len() {
            if out.len() >= MOST_POINTS {
                return Err(HjbError::Points { wanted: f64::INFINITY, most: MOST_POINTS });
            }
            out.push(self.at(unit));
            return Ok(());
        }
        for level in 0..=left {
            for u in new_nodes(level) {
                unit[at] = u;
                self.sparse(unit, at + 1, left - level, out)?;
            }
        }
        Ok(())
    }
}

/// The nodes on [0, 1] that a level adds to those below it.
fn new_nodes(level: usize) -> Vec<f64> {
    match level {
        0 => vec![0.5],
        1 => vec![0.0, 1.0],
        _ => {
            let intervals = 1usize << level;
            let node = |i: usize| 0.5 - 0.5 * (std::f64::consts::PI * i as f64 / intervals as f64).cos();
            (1..intervals).step_by(2).map(node).collect()
        }
    }
}

fn radical_inverse(mut k: usize, base: usize) -> f64 {
    let (mut value, mut digit) = (0.0, 1.0 / base as f64);
    while k > 0 {
        value += (k % base) as f64 * digit;
        k /= base;
        digit /= base as f64;
    }
    value
}

fn primes(count: usize) -> Vec<usize> {
    let mut primes: Vec<usize> = Vec::with_capacity(count);
    let mut candidate = 2;
    while primes.len() < count {
        if primes.iter().all(|p| candidate % p != 0) {
            primes.push(candidate);
        }
        candidate += 1;
    }
    primes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_has_its_corners() {
        let domain = Domain::new(&[(-5.0, 5.0), (-10.0, 10.0), (0.0, 1.0)]).unwrap();
        let points = domain.grid(&[10, 10, 5]).unwrap();
        assert_eq!(points.len(), 500);
        assert_eq!(points[0], [-5.0, -10.0, 0.0]);
        assert_eq!(points[1], [-5.0, -10.0, 0.25]);
        assert_eq!(points[499], [5.0, 10.0, 1.0]);
        assert_eq!(domain.grid(&[1, 1, 1]).unwrap(), [vec![0.0, 0.0, 0.5]]);
        assert!(domain.grid(&[0, 3, 3]).is_err() && domain.grid(&[3, 3]).is_err());
        assert!(domain.grid(&[usize::MAX; 3]).is_err());
    }

    #[test]
    fn haltons_points_are_the_published_ones() {
        let points = Domain::new(&[(0.0, 1.0), (0.0, 1.0)]).unwrap().halton(4).unwrap();
        let published = [[0.5, 1.0 / 3.0], [0.25, 2.0 / 3.0], [0.75, 1.0 / 9.0], [0.125, 4.0 / 9.0]];
        for (p, q) in points.iter().zip(published) {
            assert!((p[0] - q[0]).abs() < 1e-15 && (p[1] - q[1]).abs() < 1e-15);
        }
    }

    #[test]
    fn sparse_grids_have_the_known_sizes_and_no_point_twice() {
        // Sizes of Clenshaw–Curtis sparse grids (T. Gerstner, M. Griebel 1998).
        for (states, level, size) in
            [(2, 1, 1), (2, 2, 5), (2, 3, 13), (2, 4, 29), (4, 3, 41), (6, 3, 85), (10, 2, 21)]
        {
            let domain = Domain::symmetric(&vec![2.0; states]).unwrap();
            let mut points = domain.sparse_grid(level).unwrap();
            assert_eq!(points.len(), size, "{states} states, level {level}");
            points.sort_by(|a, b| a.partial_cmp(b).unwrap());
            points.dedup();
            assert_eq!(points.len(), size);
            assert!(points.iter().flatten().all(|x| x.abs() <= 2.0));
        }
        assert!(Domain::symmetric(&[1.0]).unwrap().sparse_grid(0).is_err());
        assert!(Domain::symmetric(&[1.0; 30]).unwrap().sparse_grid(20).is_err());
    }

    #[test]
    fn boxes_are_checked() {
        assert!(Domain::new(&[]).is_err() && Domain::symmetric(&[0.0]).is_err());
        let message = Domain::new(&[(0.0, 1.0), (2.0, f64::NAN)]).unwrap_err().to_string();
        assert!(message.contains("state 2"), "{message}");
    }
}
