//! The time of one step of the law: `cargo run --release -p greybox-smc --example step_time`.
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use greybox_smc::thesis::LinkTangent;
use greybox_smc::{BoundaryLayer, FlatOutput, Law, Rate, SmcError, Surface, Tangent, Target};

const STEPS: u32 = 2_000_000;

/// The shortest of some runs, ns per step.
fn time<const N: usize>(law: &Law<N>, g: [f64; N]) -> f64 {
    let f = [0.3; N];
    let target = Target::rest([0.1; N]);
    let mut best = f64::INFINITY;
    for _ in 0..5 {
        let start = Instant::now();
        let mut x = [0.0; N];
        for _ in 0..STEPS {
            let command = law.step(black_box(&x), black_box(&f), black_box(&g), black_box(&target));
            // The next state depends on the command, so that steps do not overlap.
            x[0] = command.map_or(f64::NAN, |command| 1e-3 * command.u);
        }
        assert!(x[0].is_finite(), "a step failed");
        best = best.min(start.elapsed().as_secs_f64() / f64::from(STEPS));
    }
    1e9 * best
}

/// The same of a chain of integrators.
fn chain<const N: usize>(rate: Rate) -> Result<f64, SmcError> {
    let mut a = [[0.0; N]; N];
    for i in 1..N {
        a[i - 1][i] = 1.0;
    }
    let mut b = [0.0; N];
    b[N - 1] = 1.0;
    let flat = FlatOutput::new(&Tangent::new(a, b))?;
    let law = Law::new(flat, Surface::repeated(3.0)?, BoundaryLayer::new(50.0, 1.0)?, 10.0, rate)?;
    Ok(time(&law, b))
}

fn main() -> Result<(), SmcError> {
    let link = LinkTangent::IDENTIFIED.tangent();
    let flat = FlatOutput::new(&link)?;
    let (surface, layer) = (Surface::repeated(16.0)?, BoundaryLayer::new(590.0, 5.9)?);
    for rate in [Rate::Chain, Rate::Model] {
        println!("rate: {rate:?}");
        let law = Law::new(flat, surface, layer, 10.0, rate)?;
        println!("  flexible link, 4 states: {:6.1} ns", time(&law, link.b));
        println!("  chain of 2 integrators:  {:6.1} ns", chain::<2>(rate)?);
        println!("  chain of 8 integrators:  {:6.1} ns", chain::<8>(rate)?);
    }
    Ok(())
}
