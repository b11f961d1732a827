//! The rotary flexible link of the thesis under five laws, with and without Coulomb friction:
//! `cargo run --release -p greybox-smc --example link`.
#![allow(clippy::print_stdout)]

#[path = "../tests/rig/mod.rs"]
mod rig;

use greybox_simulate::rigs::RotaryFlexibleLink;
use greybox_smc::thesis::{LinkTangent, PrintedLaw};
use greybox_smc::{BoundaryLayer, Design, Rate, Surface, Target};
use rig::{DT, Figures, LIMIT, f, follow, rest};

fn row(name: &str, angle: f64, figures: Result<Figures, Box<dyn std::error::Error>>) {
    match figures {
        Ok(r) => println!(
            "{name:28} {angle:3.0}°  {:6.3} s  {:5.1} %  {:8.4}°  {:5.1}°  {:5.1} V  {:6.1} V  {:6.1}",
            r.settling, r.overshoot, r.last_error, r.deflection, r.voltage, r.unlimited, r.surface
        ),
        Err(error) => println!("{name:28} {angle:3.0}°  {error}"),
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (lambda, eta, phi) = (16.0, 5e4, 500.0);
    let (surface, layer) = (Surface::repeated(lambda)?, BoundaryLayer::new(eta, phi)?);
    let link = LinkTangent::IDENTIFIED;
    let printed = PrintedLaw::new(link, lambda, eta, phi, LIMIT)?;
    println!("law                          square  settled  over    last       α      V     unlimited  |s|");
    for (what, rig) in [
        ("with friction", RotaryFlexibleLink::IDENTIFIED),
        ("without friction", RotaryFlexibleLink::IDENTIFIED.without_friction()),
    ] {
        // Let overshoots beyond ±40° be seen.
        let rig = RotaryFlexibleLink { theta_limit: 60_f64.to_radians(), ..rig };
        println!("{what}");
        let (zero, at_zero) = rest(&rig, 0.0)?;
        assert!(zero.input.abs() < 1e-9);
        for angle in [10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0] {
            let amplitude = f64::to_radians(angle);
            let figures = follow(&rig, amplitude, |x, wanted| printed.step(&x, f(&rig, x)[2], wanted));
            row("printed, corrected", angle, figures);
            let (up, at_up) = rest(&rig, amplitude)?;
            let (down, at_down) = rest(&rig, -amplitude)?;
            let link = LinkTangent::IDENTIFIED.tangent();
            for (name, flat, rate) in [
                ("tangent of Eq 4.5, chain", [link; 2], Rate::Chain),
                ("tangent of Eq 4.5, model", [link; 2], Rate::Model),
                ("tangent at zero, model", [at_zero; 2], Rate::Model),
                ("tangent at ±θ_d, model", [at_up, at_down], Rate::Model),
            ] {
                let design = |flat| {
                    let design = Design::new(flat, surface, layer, DT).input_gain(link.b[3]).plant(at_zero);
                    design.rate(rate).limited_to(LIMIT)
                };
                let (to_up, to_down) = (design(flat[0]).law()?, design(flat[1]).law()?);
                let figures = follow(&rig, amplitude, |x, wanted| {
                    let (law, end) = if wanted > 0.0 { (&to_up, &up) } else { (&to_down, &down) };
                    law.step(&x, &f(&rig, x), &rig.input(), &Target::rest(end.state))
                });
                row(name, angle, figures);
            }
        }
    }
    Ok(())
}
