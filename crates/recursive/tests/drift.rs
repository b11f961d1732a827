//! Parameters that drift, followed from a noisy position: rows of the algebraic method into recursive least squares.

use greybox_algebraic::{Hold, Kernel, Stream, Term};
use greybox_recursive::LeastSquares;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const DT: f64 = 0.01;

/// x'' + d x' + a x + b x³ = u, with a stiffness that falls by 40 % over a thousand seconds.
fn stiffness(t: f64) -> f64 {
    2.0 - 0.8 * t / 1000.0
}

fn input(t: f64) -> f64 {
    3.0 * (1.1 * t).sin() + 2.0 * (2.3 * t).cos()
}

fn acceleration(t: f64, x: f64, v: f64) -> f64 {
    input(t) - 0.4 * v - stiffness(t) * x - 0.5 * x.powi(3)
}

/// (x, u) at every sample, by the classical Runge–Kutta method.
fn recording(n: usize, noise: f64, seed: u64) -> Vec<[f64; 2]> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let (mut x, mut v) = (0.1, 0.0);
    (0..n)
        .map(|k| {
            let t = DT * k as f64;
            let e: f64 = StandardNormal.sample(&mut rng);
            let out = [x + noise * e, input(t)];
            let (k1x, k1v) = (v, acceleration(t, x, v));
            let (k2x, k2v) =
                (v + 0.5 * DT * k1v, acceleration(t + 0.5 * DT, x + 0.5 * DT * k1x, v + 0.5 * DT * k1v));
            let (k3x, k3v) =
                (v + 0.5 * DT * k2v, acceleration(t + 0.5 * DT, x + 0.5 * DT * k2x, v + 0.5 * DT * k2v));
            let (k4x, k4v) = (v + DT * k3v, acceleration(t + DT, x + DT * k3x, v + DT * k3v));
            x += DT / 6.0 * (k1x + 2.0 * k2x + 2.0 * k3x + k4x);
            v += DT / 6.0 * (k1v + 2.0 * k2v + 2.0 * k3v + k4v);
            out
        })
        .collect()
}

/// Largest error of the stiffness in the second half of the drift, and of the constants at its end, with this forgetting
/// per window.
fn followed(forgetting: f64, seed: u64) -> (f64, f64) {
    let column = |signal, order| Term { signal, order, hold: Hold::Smooth };
    let terms = [column(0, 2), column(0, 1), column(0, 0), column(1, 0), column(2, 0)];
    // Windows of two seconds, one every half a second.
    let mut stream = Stream::new(&Kernel::new(2, 3, 200, DT).unwrap(), 3, &terms, 50).unwrap();
    let mut fit = LeastSquares::new(&[0.0; 3], &[10.0; 3]).unwrap();
    let (mut row, mut worst, mut last) = ([0.0; 5], 0.0f64, [0.0; 3]);
    for (k, [x, u]) in recording(100_000, 0.01, seed).iter().enumerate() {
        if stream.push(&[*x, x.powi(3), *u], &mut row).unwrap().is_none() {
            continue;
        }
        let [second, first, zeroth, cube, force] = row;
        let scale = 0.005;
        fit.forget(forgetting);
        assert!(fit.update(&[first / scale, zeroth / scale, cube / scale], (force - second) / scale));
        fit.estimate_into(&mut last);
        let t = DT * k as f64;
        if t > 500.0 {
            worst = worst.max((last[1] - stiffness(t)).abs());
        }
    }
    (worst, (last[0] - 0.4).abs().max((last[2] - 0.5).abs()))
}

/// With a memory of fifty windows the stiffness is followed within 5 % of its change; without forgetting, it is not.
#[test]
fn a_drifting_duffing_oscillator_is_followed() {
    for seed in 0..5 {
        let (drifting, constant) = followed(0.98, seed);
        assert!(drifting < 0.08 && constant < 0.05, "seed {seed}: {drifting} {constant}");
        let (stale, _) = followed(1.0, seed);
        assert!(stale > 0.15, "seed {seed}: {stale}");
    }
}
