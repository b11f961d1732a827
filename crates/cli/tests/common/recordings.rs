//! Recordings that drive a model.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use std::f64::consts::TAU;
use std::fmt::Write as _;

/// A recording whose inputs are sums of sines, each its own, and whose channels rest at zero.
pub(crate) fn driven(inputs: &[&str], channels: &[&str], rows: usize, dt: f64, amplitude: f64) -> String {
    let mut text = String::from("t");
    for name in inputs.iter().chain(channels) {
        write!(text, ",{name}").unwrap();
    }
    for row in 0..rows {
        let t = row as f64 * dt;
        write!(text, "\n{t:.6}").unwrap();
        for i in 0..inputs.len() {
            let i = i as f64;
            let sine = |share: f64, hz: f64, phase: f64| share * (TAU * hz * t + phase).sin();
            let value = sine(1.0, 0.5 + 0.3 * i, 0.0) + sine(0.7, 1.7 + 0.2 * i, i) + sine(0.4, 3.1, 0.0);
            write!(text, ",{:.9}", amplitude * value).unwrap();
        }
        text.push_str(&",0".repeat(channels.len()));
    }
    text.push('\n');
    text
}
