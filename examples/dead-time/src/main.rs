//! How late does this heater act? `cargo run --release --package example-dead-time`.
#![allow(clippy::print_stdout)]

use std::error::Error;

use greybox_algebraic::{Column, Hold, Kernel};
use greybox_delay::exact::{Fit, Gain, Options};
use greybox_delay::windows::{Before, Windowed, fit};

/// Sample time, s.
const STEP: f64 = 0.1;
/// Time constant of the heater, s.
const CONSTANT: f64 = 4.2;
/// K/W.
const GAIN: f64 = 0.35;
/// The time that the air takes to the sensor, s: no whole number of samples.
const LATE: f64 = 1.537;

/// Numbers without an order (Numerical Recipes' generator).
struct Random(u32);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(self.0) / f64::from(u32::MAX)
    }

    /// Normal, variance 1, nearly: the sum of twelve.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform() - 0.5).sum()
    }
}

/// Heating power (W) and the temperature (K above the room) that the sensor reads, T y′ + y = K u(t − τ), for five
/// minutes. The power is switched at random after 1 to 6 s and held between samples.
fn recording(noise: f64, seed: u32) -> [Vec<f64>; 2] {
    let mut random = Random(seed.wrapping_mul(2_654_435_761));
    let mut power = vec![20.0; 30];
    while power.len() < 3000 {
        let level = if random.uniform() < 0.5 { 20.0 } else { 60.0 };
        power.extend(std::iter::repeat_n(level, 10 + (50.0 * random.uniform()) as usize));
    }
    power.truncate(3000);
    // From sample to sample exactly: the power that arrives changes once on the way.
    let (whole, part) = ((LATE / STEP) as usize, LATE % STEP);
    let toward = |y: f64, u: f64, time: f64| GAIN * u + (y - GAIN * u) * (-time / CONSTANT).exp();
    let mut y = GAIN * power[0];
    let mut sample = |k: usize| {
        let read = y + noise * random.normal();
        y = toward(y, power[k.saturating_sub(whole + 1)], part);
        y = toward(y, power[k.saturating_sub(whole)], STEP - part);
        read
    };
    let temperature = (0..power.len()).map(&mut sample).collect();
    [power, temperature]
}

/// y′ + y/T = (K/T) u(t − τ) times a window of 4 s that is zero at both ends: the integral of y′ is one of y, so that no
/// derivative is taken of the noise. τ, K/T and 1/T are unknown.
fn dead_time([power, temperature]: &[Vec<f64>; 2]) -> Result<Fit, Box<dyn Error>> {
    let kernel = Kernel::new(2, 3, 40, STEP)?;
    let column = |order| Column { signal: temperature, order, hold: Hold::Smooth };
    // In the crate's order: the known side, the terms on the other, the signal that is late.
    let known = [(1.0, column(1))];
    let rows = Windowed::new(&kernel, 2, &known, &[column(0)], power, Hold::Zero, Before::Unknown)?;
    Ok(fit(&[rows], &Options::new(Gain::Free, 0.0, 5.0))?)
}

/// T and K.
fn heater(found: &Fit) -> [f64; 2] {
    let inverse = -found.coefficients.first().copied().unwrap_or(f64::NAN);
    [1.0 / inverse, found.gain / inverse]
}

fn main() -> Result<(), Box<dyn Error>> {
    println!("truth             {LATE:.3} s                      {CONSTANT:.2} s         {GAIN:.4} K/W");
    println!("sensor noise  dead time, 95 %    error      time constant  gain        warnings");
    for noise in [0.05, 0.2, 0.5, 1.0] {
        let found = dead_time(&recording(noise, 7))?;
        let ([constant, gain], error) = (heater(&found), 1e3 * (found.delay - LATE));
        let (delay, interval) = (found.delay, 1.96 * found.delay_std);
        println!(
            "{noise:4.2} K        {delay:.4} ± {interval:.4} s  {error:5.1} ms   {constant:.3} s        {gain:.4} K/W  {:?}",
            found.separability.warnings
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_dead_time_is_as_sure_as_stated() {
        let found: Vec<Fit> = (0..100).map(|seed| dead_time(&recording(0.2, seed)).unwrap()).collect();
        let rms = |of: &dyn Fn(&Fit) -> f64| {
            (found.iter().map(|f| of(f).powi(2)).sum::<f64>() / found.len() as f64).sqrt()
        };
        // 0.03 of a sample.
        let (error, stated) = (rms(&|f| f.delay - LATE), rms(&|f| f.delay_std));
        assert!((1.7e-3..6.8e-3).contains(&error), "{error}");
        assert!((error / stated - 1.0).abs() < 0.25, "{error}, stated {stated}");
        let within = found.iter().filter(|f| (f.delay - LATE).abs() < 1.96 * f.delay_std).count();
        assert!((88..=99).contains(&within), "{within} of 100");
        let (constant, gain) = (rms(&|f| heater(f)[0] - CONSTANT), rms(&|f| heater(f)[1] - GAIN));
        assert!(constant < 0.018 && gain < 2.1e-4, "{constant} {gain}");
        assert!(found.iter().all(|f| f.separability.warnings.is_empty()));
    }
}
