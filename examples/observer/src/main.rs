//! The estimator on a simulated drive: `cargo run --release --package example-observer`.
#![allow(clippy::print_stdout)]

use example_observer::{Estimate, Estimator};

/// Inertia, kg m².
const INERTIA: f64 = 0.004;
/// Sample time, s.
const STEP: f64 = 1e-3;
/// Noise of the encoder, rad.
const NOISE: f64 = 2e-4;
/// The load from 2 s on, N m.
const LOAD: f64 = -0.05;

/// A drive at 2 rad/s when it is switched on, its torque known; after each sample the truth and the estimate.
fn run(estimator: &mut Estimator) -> Vec<(Estimate, Estimate)> {
    let (mut angle, mut speed, mut torque, mut noise) = (0.3, 2.0, 0.0, Noise(7));
    let mut out = Vec::new();
    for sample in 0..4000 {
        let t = STEP * f64::from(sample);
        let load = if t < 2.0 { 0.0 } else { LOAD };
        out.push((Estimate { angle, speed, load }, estimator.update(angle + NOISE * noise.next(), torque)));
        torque = 0.08 * (6.0 * t).sin();
        let acceleration = (torque + load) / INERTIA;
        angle += STEP * speed + 0.5 * STEP * STEP * acceleration;
        speed += STEP * acceleration;
    }
    out
}

/// Normal noise of variance 1, nearly: the sum of twelve uniform numbers (Numerical Recipes' generator).
struct Noise(u32);

impl Noise {
    fn next(&mut self) -> f64 {
        let mut uniform = || {
            self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(self.0) / f64::from(u32::MAX) - 0.5
        };
        (0..12).map(|_| uniform()).sum()
    }
}

/// RMS errors of speed and load over a time in which the load does not change, s.
fn errors(samples: &[(Estimate, Estimate)], from: f64, to: f64) -> (f64, f64) {
    let chosen = &samples[(from / STEP) as usize..(to / STEP) as usize];
    let rms = |error: &dyn Fn(&(Estimate, Estimate)) -> f64| {
        (chosen.iter().map(|s| error(s).powi(2)).sum::<f64>() / chosen.len() as f64).sqrt()
    };
    (rms(&|(truth, found)| found.speed - truth.speed), rms(&|(truth, found)| found.load - truth.load))
}

fn main() -> Result<(), greybox_eso::EsoError> {
    println!("bandwidth  lag of load  noise foretold: speed, load     errors: speed, load");
    for bandwidth in [20.0, 50.0, 100.0, 200.0] {
        let mut estimator = Estimator::new(INERTIA, bandwidth, STEP)?;
        let samples = run(&mut estimator);
        let (lag, (speed, load)) = (estimator.lag()?, estimator.noise(NOISE)?);
        let (speed_error, load_error) = errors(&samples, 1.0, 2.0);
        println!(
            "{bandwidth:4} rad/s  {lag:6.3} s     {speed:.5} rad/s, {load:.6} N m  {speed_error:.5} rad/s, {load_error:.6} N m"
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_and_load_are_as_noisy_as_foretold() {
        for bandwidth in [50.0, 100.0, 200.0] {
            let mut estimator = Estimator::new(INERTIA, bandwidth, STEP).unwrap();
            let samples = run(&mut estimator);
            let (speed, load) = estimator.noise(NOISE).unwrap();
            for (from, to) in [(1.0, 2.0), (3.0, 4.0)] {
                let (speed_error, load_error) = errors(&samples, from, to);
                assert!((speed_error / speed - 1.0).abs() < 0.2, "{bandwidth}: {speed_error} for {speed}");
                assert!((load_error / load - 1.0).abs() < 0.2, "{bandwidth}: {load_error} for {load}");
            }
        }
    }

    #[test]
    fn a_step_of_the_load_is_seen_after_its_lag() {
        let mut estimator = Estimator::new(INERTIA, 50.0, STEP).unwrap();
        let samples = run(&mut estimator);
        let half = samples.iter().skip(2000).position(|(_, found)| found.load < 0.5 * LOAD).unwrap();
        // Three poles at −ω pass a half at 2.67/ω, a little before the lag of 3/ω.
        assert!((STEP * half as f64 - 2.67 / 50.0).abs() < 0.01, "{half}");
    }
}
