//! Whether the machine's own parameters are where the model states them.
//!
//! ```text
//! D = Σᵢ ((pᵢ − valueᵢ)/stdᵢ)²
//! ```
//!
//! over the k parameters of the nominal model with a stated `std`. If the statements hold, D of the true values is that of a
//! chi-squared distribution with k degrees of freedom. A law that describes something else draws parameters away to make up for
//! what it does; the right one lets them go back.

use greybox_calibrate::{FreeParameter, Prior};
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// How seldom true values would be stated so badly that parameters are called implausible.
const SELDOM: f64 = 1e-3;

/// How far parameters are from what the model states of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Deviation {
    /// D, a squared distance in standard deviations.
    squares: f64,
    /// k.
    stated: usize,
}

impl Deviation {
    /// Of these values of all parameters, of which the first `own` are the machine's.
    pub(crate) fn of(free: &[FreeParameter], own: usize, parameters: &[f64]) -> Deviation {
        let of = |f: &FreeParameter| match f.prior {
            Prior::Normal { .. } => Some(f.prior.at(parameters[f.index]).0.powi(2)),
            Prior::Flat | Prior::Cauchy { .. } => None,
        };
        let squares: Vec<f64> = free.iter().filter(|f| f.index < own).filter_map(of).collect();
        Deviation { squares: squares.iter().sum(), stated: squares.len() }
    }

    /// The larger of two.
    pub(crate) fn larger(self, other: Deviation) -> Deviation {
        if other.squares > self.squares { other } else { self }
    }

    /// Whether values as far from what is stated are rarer than one in a thousand, and farther than those of `other`.
    pub(crate) fn is_implausible_beside(self, other: Deviation) -> bool {
        let seldom = ChiSquared::new(self.stated as f64).is_ok_and(|chi| chi.sf(self.squares) < SELDOM);
        seldom && self.squares > other.squares
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    fn stated(count: usize) -> Vec<FreeParameter> {
        let prior = |i: usize| Prior::Normal { mean: i as f64, std: 0.1 + i as f64 };
        let free =
            |i| FreeParameter { index: i, prior: prior(i), lower: f64::NEG_INFINITY, upper: f64::INFINITY };
        (0..count).map(free).collect()
    }

    #[test]
    fn values_as_stated_are_implausible_one_time_in_a_thousand() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        let none = Deviation { squares: 0.0, stated: 0 };
        for count in [1, 4] {
            let free = stated(count);
            let draw = |f: &FreeParameter, rng: &mut rand_pcg::Pcg64| match f.prior {
                Prior::Normal { mean, std } => {
                    let z: f64 = StandardNormal.sample(rng);
                    mean + std * z
                }
                _ => unreachable!("all are stated"),
            };
            let draws = 100_000;
            let implausible = (0..draws)
                .filter(|_| {
                    let values: Vec<f64> = free.iter().map(|f| draw(f, &mut rng)).collect();
                    Deviation::of(&free, count, &values).is_implausible_beside(none)
                })
                .count();
            // (100 are expected, ± 10.)
            assert!((60..=140).contains(&implausible), "{count}: {implausible}");
        }
    }

    #[test]
    fn only_what_is_stated_of_the_machine_counts_and_what_was_farther_away_before_is_no_objection() {
        let mut free = stated(3);
        free[1].prior = Prior::Cauchy { centre: 1.0, scale: 0.5 };
        // The third is a law's.
        let far = Deviation::of(&free, 2, &[0.5, 40.0, 90.0]);
        assert!((far.squares - 25.0).abs() < 1e-12 && far.stated == 1, "{far:?}");
        let near = Deviation::of(&free, 2, &[0.3, 1.0, 2.0]);
        let farther = Deviation::of(&free, 2, &[-0.7, 1.0, 2.0]);
        assert!(far.is_implausible_beside(near) && !far.is_implausible_beside(farther));
        // Three standard deviations are seen one time in 370.
        assert!(!near.is_implausible_beside(Deviation { squares: 0.0, stated: 1 }));
        let nothing = Deviation::of(&free, 0, &[0.5, 40.0, 90.0]);
        assert!(!nothing.is_implausible_beside(near), "nothing is stated");
    }
}
