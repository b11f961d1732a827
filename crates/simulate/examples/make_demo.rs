//! Makes the recordings of `greybox demo`: `cargo run --release -p greybox-simulate --example make_demo`
//! writes them where they are checked in. Same seed, same bytes; a test compares.
use std::path::Path;

use greybox_recording::write_csv;
use greybox_simulate::rigs::{
    ENCODER_4096, ProportionalController, RotaryFlexibleLink, Sampling, Sine, multisine, quantise,
    square_wave,
};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;

type Error = Box<dyn std::error::Error>;

/// The seed of the checked-in recordings: the year of the thesis.
pub(crate) const SEED: u64 = 2021;

const SAMPLING: Sampling = Sampling { dt: 0.005, substeps: 20 };
const AMPLITUDE: f64 = 30.0 * std::f64::consts::PI / 180.0;
/// RMS noise of the strain gauge, rad.
const GAUGE_NOISE: f64 = 1e-3;
/// Frequencies of the dither, Hz: below, around and above the resonance of the link at 4.5 Hz.
const DITHER_HZ: [f64; 6] = [0.7, 1.3, 2.9, 4.3, 6.1, 8.9];

/// The files of the demo: name and content.
///
/// # Errors
/// What the rig or the writer reports; neither happens with the settings above.
pub(crate) fn demo(seed: u64) -> Result<[(&'static str, Vec<u8>); 4], Error> {
    let [link_train, link_test] = link(seed)?;
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let [train, test] = [30.0, 15.0].map(|seconds| cart(&mut random, seconds));
    Ok([
        ("cart_train.csv", train?),
        ("cart_test.csv", test?),
        ("rotary_link_train.csv", link_train),
        ("rotary_link_test.csv", link_test),
    ])
}

/// Of the cart: m x″ + c x′ + k x + fc sign(x′) = f in kg, N and m, sampled every 10 ms. The force is a sum of sines, held
/// between samples; the sensor has white noise of 0.2 mm RMS and shows tenths of a millimetre.
fn cart(random: &mut Pcg64Mcg, seconds: f64) -> Result<Vec<u8>, Error> {
    const MASS: f64 = 1.5;
    const DAMPING: f64 = 1.2;
    const STIFFNESS: f64 = 25.0;
    const FRICTION: f64 = 0.8;
    const SUBSTEPS: usize = 100;
    let count = (100.0 * seconds) as usize;
    let sines = [0.13, 0.31, 0.53, 0.83, 1.37].map(|frequency| Sine {
        amplitude: 1.2,
        frequency,
        phase: random.random_range(0.0..std::f64::consts::TAU),
    });
    let noise = Normal::new(0.0, 2e-4)?;
    let rounded = |x: f64, per_unit: f64| (x * per_unit).round() / per_unit + 0.0;
    let time: Vec<f64> = (0..count).map(|k| k as f64 / 100.0).collect();
    let force: Vec<f64> = time.iter().map(|t| rounded(multisine(&sines, *t), 1e3)).collect();
    let h = 0.01 / SUBSTEPS as f64;
    let (mut x, mut v) = (0.0_f64, 0.0_f64);
    let mut position = Vec::new();
    for f in &force {
        position.push(rounded(x + noise.sample(random), 1e4));
        for _ in 0..SUBSTEPS {
            let free = f - STIFFNESS * x;
            if v == 0.0 && free.abs() <= FRICTION {
                continue; // it sticks
            }
            let direction = if v == 0.0 { free.signum() } else { v.signum() };
            let acceleration =
                |x: f64, v: f64| (f - DAMPING * v - STIFFNESS * x - FRICTION * direction) / MASS;
            // The midpoint rule, up to where it comes to rest.
            let half = [x + 0.5 * h * v, v + 0.5 * h * acceleration(x, v)];
            x += h * half[1];
            v += h * acceleration(half[0], half[1]);
            if v * direction < 0.0 {
                v = 0.0;
            }
        }
    }
    let mut csv = Vec::new();
    write_csv(&mut csv, &time, &[("f [N]", &force), ("x [m]", &position)])?;
    Ok(csv)
}

/// Of the flexible link, to train and to test.
fn link(seed: u64) -> Result<[Vec<u8>; 2], Error> {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let levels = random_levels(&mut random, 30.0);
    // The dither opens the loop for identification: without it V = kp (reference - theta) ties the voltage to
    // the angle.
    let dither = DITHER_HZ.map(|frequency| Sine {
        amplitude: 0.05,
        frequency,
        phase: random.random_range(0.0..std::f64::consts::TAU),
    });
    let train = record(&mut random, &levels, |t| multisine(&dither, t))?;
    // The experiment of thesis figure 2.7 at 20 degrees instead of 30: from 18 degrees on the identified spring pushes
    // the hub outwards, so that a replay of the voltage without the loop would magnify any error of a model.
    let square: Vec<f64> =
        (0..samples(15.0)).map(|k| square_wave(20_f64.to_radians(), 0.66, k as f64 * SAMPLING.dt)).collect();
    let test = record(&mut random, &square, |_| 0.0)?;
    Ok([train, test])
}

fn samples(seconds: f64) -> usize {
    (seconds / SAMPLING.dt).round() as usize
}

/// A reference of random levels within the amplitude, each held for 0.3 s to 1.2 s.
fn random_levels(random: &mut Pcg64Mcg, seconds: f64) -> Vec<f64> {
    let mut reference = Vec::new();
    while reference.len() < samples(seconds) {
        let level = random.random_range(-AMPLITUDE..AMPLITUDE);
        let held = samples(random.random_range(0.3..1.2));
        reference.extend(std::iter::repeat_n(level, held));
    }
    reference.truncate(samples(seconds));
    reference
}

/// Runs the identified rig in its position loop and writes what its sensors saw as CSV.
fn record(random: &mut Pcg64Mcg, reference: &[f64], dither: impl Fn(f64) -> f64) -> Result<Vec<u8>, Error> {
    let noise = Normal::new(0.0, GAUGE_NOISE)?;
    let controller = ProportionalController { resolution: 1e-4, ..ProportionalController::THESIS };
    let (mut theta, mut alpha) = (Vec::new(), Vec::new());
    let run = RotaryFlexibleLink::IDENTIFIED.run(SAMPLING, [0.0; 4], reference.len(), |k, angles| {
        let encoder = quantise(angles[0], ENCODER_4096);
        theta.push(encoder);
        alpha.push(angles[1] + noise.sample(random));
        controller.command(reference[k], encoder, dither(k as f64 * SAMPLING.dt))
    })?;
    let time: Vec<f64> = (0..reference.len()).map(|k| (5 * k) as f64 / 1000.0).collect();
    let rounded = |values: &[f64], per_unit: f64| -> Vec<f64> {
        // Adding zero makes a negative zero positive.
        values.iter().map(|x| (x * per_unit).round() / per_unit + 0.0).collect()
    };
    let (v, theta, alpha) = (rounded(&run.voltages, 1e4), rounded(&theta, 1e5), rounded(&alpha, 1e5));
    let mut csv = Vec::new();
    write_csv(&mut csv, &time, &[("v [V]", &v), ("theta [rad]", &theta), ("alpha [rad]", &alpha)])?;
    Ok(csv)
}

#[allow(dead_code, reason = "the test of the checked-in files includes this file as a module")]
fn main() -> Result<(), Error> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../cli/demo");
    for (name, content) in demo(SEED)? {
        std::fs::write(folder.join(name), content)?;
    }
    Ok(())
}
