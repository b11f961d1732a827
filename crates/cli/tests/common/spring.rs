//! A mass on a spring: a model of it, and recordings.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use std::fmt::Write as _;

use noise::Noise;

#[path = "noise.rs"]
pub(crate) mod noise;

/// The nominal model.
pub(crate) const MODEL: &str = r#"name = "Mass on a spring"

[inputs]
f = { unit = "N" }

[states]
x = { unit = "m" } # measured in mm

[parameters]
m = { value = 1.0, unit = "kg", fixed = true }
b = { value = 0.5, unit = "N s/m" } # a guess
k = { value = 30.0, unit = "N/m" }

[equations]
body = "m*x'' + b*x' + k*x = f"
"#;

/// True damping and stiffness of the recordings.
pub(crate) const TRUTH: (f64, f64) = (0.8, 25.0);

/// `t, f [N], x [mm]` of a mass on a spring that starts at rest, simulated finely (semi-implicit Euler), with a
/// noise of 0.2 mm.
pub(crate) fn recording(rows: usize, phase: f64) -> String {
    let (b, k) = TRUTH;
    let force = |t: f64| (2.0 * t + phase).sin() + (5.0 * t).sin();
    let (mut x, mut v) = (0.0, 0.0);
    let mut noise = Noise(12345);
    let mut text = String::from("t,f [N],x [mm]\n");
    let (dt, fine) = (0.01, 100);
    for row in 0..rows {
        let t = row as f64 * dt;
        writeln!(text, "{t:.2},{:.6},{:.4}", force(t), 1e3 * x + 0.2 * noise.normal()).unwrap();
        let h = dt / f64::from(fine);
        for i in 0..fine {
            v += h * (force(t + f64::from(i) * h) - b * v - k * x);
            x += h * v;
        }
    }
    text
}
