//! Which cases a seed stands for: rounds in which every kind occurs once, with nulls and outsiders between.

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use greybox_plants::kind::{Kind, LIBRARY, OUTSIDE};

/// Nulls in a round: 7 of 42.
const NULLS: usize = 7;
/// Cases outside the library in a round: 5 of 42.
const OUTSIDERS: usize = 5;
/// Cases in a round.
pub(crate) const ROUND: usize = LIBRARY.len() + NULLS + OUTSIDERS;

/// How strongly an effect shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Tier {
    Easy,
    Medium,
    Hard,
}

impl Tier {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Tier::Easy => "easy",
            Tier::Medium => "medium",
            Tier::Hard => "hard",
        }
    }

    /// Target of the ratio misfit/noise (RMS) of a recalibrated model without the effect.
    pub(crate) fn target(self, rng: &mut Pcg64Mcg) -> f64 {
        match self {
            Tier::Easy => rng.random_range(9.0..16.0),
            Tier::Medium => rng.random_range(3.5..4.5),
            Tier::Hard => rng.random_range(1.6..2.0),
        }
    }

    /// The tier to which a ratio belongs; `None` where it is too small for any.
    pub(crate) fn of(ratio: f64) -> Option<Tier> {
        match ratio {
            r if r >= 6.5 => Some(Tier::Easy),
            r if r >= 2.7 => Some(Tier::Medium),
            r if r >= 1.4 => Some(Tier::Hard),
            _ => None,
        }
    }
}

/// What makes a case difficult beside its effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Mask {
    /// Nominal parameters 12–30 % off (mildly off they always are).
    WrongParameters,
    /// A controller drives the machine from the noisy measurement.
    ClosedLoop,
    /// The effect acts in few samples.
    Rare,
    /// A coordinate or a current is not measured.
    Unmeasured,
    /// AR(1) measurement noise.
    Coloured,
    /// An encoder's steps.
    Quantised,
    /// A second effect.
    TwoEffects,
    /// The effect acts on a coordinate that no input drives.
    NotDriven,
}

/// All maskings.
pub(crate) const MASKS: [Mask; 8] = [
    Mask::WrongParameters,
    Mask::ClosedLoop,
    Mask::Rare,
    Mask::Unmeasured,
    Mask::Coloured,
    Mask::Quantised,
    Mask::TwoEffects,
    Mask::NotDriven,
];

impl Mask {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Mask::WrongParameters => "wrong_parameters",
            Mask::ClosedLoop => "closed_loop",
            Mask::Rare => "rare",
            Mask::Unmeasured => "unmeasured",
            Mask::Coloured => "coloured",
            Mask::Quantised => "quantised",
            Mask::TwoEffects => "two_effects",
            Mask::NotDriven => "not_driven",
        }
    }
}

/// What a case leaves out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Left {
    Nothing,
    Effect(Kind),
}

/// What is asked of a case; its own seed decides the rest.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Slot {
    /// Number in the suite.
    pub(crate) index: usize,
    /// Seed of everything random in it.
    pub(crate) seed: u64,
    pub(crate) left: Left,
    pub(crate) tier: Tier,
    /// Maskings in the order in which they are tried; the first that fits is used.
    pub(crate) masks: Vec<Mask>,
}

impl Slot {
    /// Its name, which reveals nothing.
    pub(crate) fn id(&self) -> String {
        format!("{:08x}", mix(self.seed ^ 0x6361_7365) >> 32)
    }
}

/// A step of splitmix64 (Steele, Lea & Flood 2014).
fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// The first `count` cases of a seed. More cases leave the first ones as they are.
pub(crate) fn plan(seed: u64, count: usize) -> Vec<Slot> {
    let rounds = count.div_ceil(ROUND);
    let mut slots: Vec<Slot> = (0..rounds).flat_map(|r| round(seed, r)).collect();
    slots.truncate(count);
    slots
}

fn round(seed: u64, round: usize) -> Vec<Slot> {
    // What must go round over the rounds is drawn from the seed alone.
    let mut shared = Pcg64Mcg::seed_from_u64(mix(seed));
    let turn: Vec<usize> = (0..LIBRARY.len()).map(|_| shared.random_range(0..24)).collect();
    let mut outside = OUTSIDE.to_vec();
    outside.shuffle(&mut shared);

    let mut rng = Pcg64Mcg::seed_from_u64(mix(mix(seed) ^ round as u64));
    let mut drawn: Vec<(f64, Left, usize)> = Vec::with_capacity(ROUND);
    // Each class is spread evenly over the round, in random order within.
    let mut spread = |mut class: Vec<(Left, usize)>, drawn: &mut Vec<(f64, Left, usize)>| {
        class.shuffle(&mut rng);
        let n = class.len() as f64;
        for (i, (left, turn)) in class.into_iter().enumerate() {
            drawn.push(((i as f64 + rng.random_range(0.0..1.0)) / n, left, turn));
        }
    };
    spread(LIBRARY.iter().zip(&turn).map(|(&k, &t)| (Left::Effect(k), t + round)).collect(), &mut drawn);
    spread((0..NULLS).map(|i| (Left::Nothing, i + NULLS * round)).collect(), &mut drawn);
    spread(
        (0..OUTSIDERS)
            .map(|i| {
                let number = OUTSIDERS * round + i;
                (Left::Effect(outside[number % outside.len()]), number)
            })
            .collect(),
        &mut drawn,
    );
    drawn.sort_by(|a, b| a.0.total_cmp(&b.0));
    drawn
        .into_iter()
        .enumerate()
        .map(|(i, (_, left, turn))| {
            let index = ROUND * round + i;
            // Not symmetric: no seed shares a case with another.
            let own = mix(mix(mix(seed)) ^ index as u64);
            let mut order = MASKS.to_vec();
            // Each round takes the next masking first.
            order.rotate_left(turn % MASKS.len());
            if left == Left::Nothing {
                order.retain(|m| !matches!(m, Mask::Rare | Mask::TwoEffects | Mask::NotDriven));
                let by = turn % order.len();
                order.rotate_left(by);
            }
            let tier = [Tier::Easy, Tier::Medium, Tier::Hard][turn % 3];
            Slot { index, seed: own, left, tier, masks: order }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_holds_every_kind_once_and_its_share_of_nulls_and_outsiders() {
        let slots = plan(5, 3 * ROUND);
        for r in 0..3 {
            let round = &slots[ROUND * r..ROUND * (r + 1)];
            for kind in LIBRARY {
                assert_eq!(round.iter().filter(|s| s.left == Left::Effect(kind)).count(), 1);
            }
            let nulls = round.iter().filter(|s| s.left == Left::Nothing).count();
            assert!(6 * nulls >= ROUND && 10 * OUTSIDERS >= ROUND);
        }
        // Over three rounds every kind is met easy, medium and hard.
        for kind in LIBRARY {
            let mut tiers: Vec<Tier> =
                slots.iter().filter(|s| s.left == Left::Effect(kind)).map(|s| s.tier).collect();
            tiers.sort();
            assert_eq!(tiers, [Tier::Easy, Tier::Medium, Tier::Hard]);
        }
        // Every effect outside the library occurs.
        for kind in OUTSIDE {
            assert!(slots.iter().any(|s| s.left == Left::Effect(kind)));
        }
    }

    #[test]
    fn a_longer_plan_begins_like_a_shorter_one_and_names_do_not_repeat() {
        let (short, long) = (plan(9, 10), plan(9, 200));
        assert_eq!(short, long[..10]);
        let mut ids: Vec<String> = long.iter().map(Slot::id).collect();
        ids.sort();
        ids.dedup();
        assert_eq!(ids.len(), 200);
        assert_ne!(plan(10, 10), short);
        // Nor does another seed hold any of them.
        for other in 0..9 {
            assert!(plan(other, 200).iter().all(|s| ids.binary_search(&s.id()).is_err()));
        }
    }

    #[test]
    fn a_short_suite_is_a_fair_sample() {
        for seed in 0..20 {
            let slots = plan(seed, 16);
            let nulls = slots.iter().filter(|s| s.left == Left::Nothing).count();
            assert!((2..=4).contains(&nulls), "{seed}: {nulls}");
        }
    }
}
