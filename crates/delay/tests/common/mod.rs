//! Recordings of the virtual rigs of thesis chapter 3, with noise.
use greybox_simulate::rigs::{DelayedDuffing, RotaryFlexibleJoint, Sampling, Sine, multisine, square_wave};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

pub(crate) const DT: f64 = 0.001;

/// What is measured on the delayed Duffing oscillator, and its true velocity.
pub(crate) struct Duffing {
    pub(crate) x: Vec<f64>,
    pub(crate) v: Vec<f64>,
    pub(crate) f: Vec<f64>,
}

fn noisy(values: &[f64], std: f64, rng: &mut Pcg64Mcg) -> Vec<f64> {
    if std == 0.0 {
        return values.to_vec();
    }
    let normal = Normal::new(0.0, std).expect("a standard deviation");
    values.iter().map(|v| v + normal.sample(rng)).collect()
}

impl Duffing {
    /// The thesis's training recording (Eq 3.19).
    pub(crate) fn training(seconds: f64, noise: f64, seed: u64) -> Self {
        Self::new(DelayedDuffing::TRAINING_START, DelayedDuffing::training_force, seconds, noise, seed)
    }

    /// The thesis's test recording (Eq 3.20).
    pub(crate) fn test(seconds: f64, noise: f64, seed: u64) -> Self {
        Self::new(DelayedDuffing::TEST_START, DelayedDuffing::test_force, seconds, noise, seed + 1_000_000)
    }

    fn new(start: [f64; 2], force: fn(f64) -> f64, seconds: f64, noise: f64, seed: u64) -> Self {
        let samples = (seconds / DT).round() as usize + 1;
        let states = DelayedDuffing::THESIS
            .run(Sampling { dt: DT, substeps: 1 }, start, samples, force)
            .expect("the thesis's oscillator stays bounded");
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let column = |i: usize| states.iter().map(|s| s[i]).collect::<Vec<f64>>();
        let f: Vec<f64> = (0..samples).map(|k| force(k as f64 * DT)).collect();
        Self { x: noisy(&column(0), noise, &mut rng), v: column(1), f: noisy(&f, noise, &mut rng) }
    }
}

/// What is measured on the flexible joint, and the true velocity of its base.
pub(crate) struct Joint {
    pub(crate) theta: Vec<f64>,
    pub(crate) alpha: Vec<f64>,
    pub(crate) theta_dot: Vec<f64>,
    pub(crate) reference: Vec<f64>,
}

impl Joint {
    pub(crate) fn new(square: bool, seconds: f64, noise: f64, seed: u64) -> Self {
        let samples = (seconds / DT).round() as usize + 1;
        let sine = [Sine { amplitude: 2.0, frequency: 0.66, phase: 0.0 }];
        let reference = |t: f64| if square { square_wave(1.0, 0.66, t) } else { multisine(&sine, t) };
        let run = RotaryFlexibleJoint::WITH_FRICTION
            .run(Sampling { dt: DT, substeps: 1 }, [0.0; 4], samples, reference)
            .expect("the loop is stable");
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let column = |i: usize| run.states.iter().map(|s| s[i]).collect::<Vec<f64>>();
        Self {
            theta: noisy(&column(0), noise, &mut rng),
            alpha: noisy(&column(1), noise, &mut rng),
            theta_dot: column(2),
            reference: (0..samples).map(|k| reference(k as f64 * DT)).collect(),
        }
    }
}

pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n % 2 == 1 { values[n / 2] } else { 0.5 * (values[n / 2 - 1] + values[n / 2]) }
}
