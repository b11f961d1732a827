//! What does a nonlinear law save over the linear regulator? A rotor in a magnetic bearing whose permanent magnets pull
//! it off the middle, the harder the closer it comes: `cargo run --release --package example-optimal`.
#![allow(clippy::print_stdout)]

use greybox_hjb::{Affine, Domain, HjbError, Optimal, Plant, design};
use nalgebra::dmatrix;

/// Pull over displacement and mass in the middle, 1/ms²; gap, mm; 1/mass, mm/ms² per N (a rotor of 5 kg).
const BEARING: [f64; 3] = [0.2, 0.4, 2e-4];
/// Largest displacement (mm) and speed (mm/ms) that the law is for.
const DOMAIN: [f64; 2] = [0.22, 0.12];
/// Sizes of displacement, speed and force (N) in the cost ∫ Σ (xᵢ/sizeᵢ)² + (u/size)² dt.
const SIZES: [f64; 3] = [0.1, 0.1, 200.0];
/// Where the rotor is let go, mm.
const STARTS: [f64; 4] = [0.05, 0.1, 0.15, 0.2];

/// x″ = a x/(1 − (x/gap)²)² + u/m.
fn bearing() -> impl Plant {
    let [pull, gap, force] = BEARING;
    Affine {
        states: 2,
        inputs: 1,
        drift: move |x: &[f64], f: &mut [f64]| {
            f.copy_from_slice(&[x[1], pull * x[0] / (1.0 - (x[0] / gap).powi(2)).powi(2)]);
        },
        input: move |_: &[f64], g: &mut [f64]| g.copy_from_slice(&[0.0, force]),
    }
}

/// The law whose value function is an even polynomial of this degree; 2 is the linear regulator.
fn law(degree: u8) -> Result<Optimal, HjbError> {
    let [x, v, u] = SIZES.map(|size| size.powi(-2));
    let (q, r) = (dmatrix![x, 0.0; 0.0, v], dmatrix![u]);
    design(&bearing(), &q, &r, &Domain::symmetric(&DOMAIN)?, degree, false)
}

/// The cost of the closed loop from rest, ms, by Runge and Kutta's method; the cost is a third state. Infinite where the
/// rotor does not come to the middle.
fn cost(law: &Optimal, start: f64) -> f64 {
    let plant = bearing();
    let rate = |x: [f64; 3]| {
        let (mut f, mut g) = ([0.0; 2], [0.0; 2]);
        plant.drift(&x[..2], &mut f);
        plant.input(&x[..2], &mut g);
        let u = law.feedback.control(&x[..2], &g)[0];
        let shares = [x[0] / SIZES[0], x[1] / SIZES[1], u / SIZES[2]];
        [f[0] + g[0] * u, f[1] + g[1] * u, shares.iter().map(|s| s * s).sum()]
    };
    let (mut x, step) = ([start, 0.0, 0.0], 0.01);
    let along = |x: [f64; 3], k: [f64; 3], h: f64| [x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2]];
    for _ in 0..10_000 {
        let k1 = rate(x);
        let k2 = rate(along(x, k1, 0.5 * step));
        let k3 = rate(along(x, k2, 0.5 * step));
        let k4 = rate(along(x, k3, step));
        for i in 0..3 {
            x[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
    }
    if x[0].abs() < 1e-5 { x[2] } else { f64::INFINITY }
}

fn main() -> Result<(), HjbError> {
    println!("               cost of the closed loop, let go at");
    println!("degree  residual  {}", STARTS.map(|start| format!("{start:4.2} mm")).join("   "));
    for degree in [2, 4, 6, 10] {
        let law = law(degree)?;
        let costs = STARTS.map(|start| format!("{:7.4}", cost(&law, start)));
        println!("{degree:6}  {:8.5}  {}", law.verification.residual, costs.join("   "));
    }
    let (linear, quartic, best) = (law(2)?, law(4)?, law(10)?);
    println!("\nlet go at   value of degree 10   its cost   more than its cost: degree 2   degree 4");
    for start in STARTS {
        let (value, least) = (best.feedback.value(&[start, 0.0]), cost(&best, start));
        let more = [&linear, &quartic].map(|law| 100.0 * (cost(law, start) / least - 1.0));
        println!("{start:6.2} mm   {value:18.4}   {least:8.4}   {:26.3} %   {:6.3} %", more[0], more[1]);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_function_of_high_degree_is_the_cost_of_its_law() {
        let best = law(10).unwrap();
        assert!(best.verification.holds_everywhere());
        for start in STARTS {
            let (value, cost) = (best.feedback.value(&[start, 0.0]), cost(&best, start));
            assert!((value / cost - 1.0).abs() < 5e-4, "{start}: {value} for {cost}");
        }
    }

    #[test]
    fn each_degree_costs_less() {
        let start = STARTS[3];
        let least = cost(&law(10).unwrap(), start);
        for (degree, more) in [(2, 0.0503), (4, 1.12e-3), (6, 3.8e-5)] {
            let found = cost(&law(degree).unwrap(), start) / least - 1.0;
            assert!(found > 0.5 * more && found < 2.0 * more, "{degree}: {found}");
        }
    }

    /// Of x″ = a x + u/m with these weights: K₁ = m (a + √(a² + q₁/(r m²))), K₂ = √(q₂/r + 2 m K₁).
    #[test]
    fn in_the_middle_every_law_is_the_regulator() {
        let ([a, _, b], [x, v, u]) = (BEARING, SIZES);
        let first = (a + (a * a + (b * u / x).powi(2)).sqrt()) / b;
        let second = ((u / v).powi(2) + 2.0 * first / b).sqrt();
        for degree in [2, 4, 10] {
            let gain = law(degree).unwrap().feedback.gain(&dmatrix![0.0; b]);
            assert!((gain[0] / first - 1.0).abs() < 1e-8 && (gain[1] / second - 1.0).abs() < 1e-8, "{gain}");
        }
    }
}
