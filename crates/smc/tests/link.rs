//! The laws on the virtual rotary flexible link of the thesis (chapter 4.2): 0.5 ms, 10 V, square waves of 0.25 Hz.

use crate::rig::{DT, Figures, LIMIT, f, follow, rest};
use greybox_simulate::rigs::RotaryFlexibleLink;
use greybox_smc::check::ClosedLoop;
use greybox_smc::thesis::{LinkTangent, PrintedLaw};
use greybox_smc::{BoundaryLayer, Design, FlatOutput, Rate, Surface, Tangent, Target};

const RIG: RotaryFlexibleLink = RotaryFlexibleLink::IDENTIFIED;
const ANGLES: [f64; 5] = [10.0, 15.0, 20.0, 25.0, 30.0];

fn printed(eta: f64, phi: f64) -> PrintedLaw {
    PrintedLaw::new(LinkTangent::IDENTIFIED, 16.0, eta, phi, LIMIT).unwrap()
}

#[test]
fn the_general_flat_output_is_that_of_equation_4_7() {
    let link = LinkTangent::IDENTIFIED;
    assert!((link.a1 - 336.0).abs() < 1e-9 && (link.a2 + 1116.20).abs() < 0.005);
    assert!((link.b_theta - 52.632).abs() < 5e-4 && (link.b_alpha + 84.746).abs() < 5e-4);
    let (c_theta, c_alpha) = link.flat_output();
    assert!((c_theta + 2.79939e-3).abs() < 5e-9 && (c_alpha + 1.73857e-3).abs() < 5e-9);
    let flat = FlatOutput::new(&link.tangent()).unwrap();
    // Up to a factor, which is B_α …
    let [c, ..] = flat.rows();
    assert!((c[0] / c[1] - c_theta / c_alpha).abs() < 1e-14);
    // … and with it ÿ_f = α, y_f‴ = α̇ and y_f⁗ = A₂ α + B_α u (Eq 4.8 and 4.9).
    let flat = flat.with_input_gain(link.b_alpha).unwrap();
    let expected = [
        [c_theta, c_alpha, 0.0, 0.0],
        [0.0, 0.0, c_theta, c_alpha],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ];
    for k in 0..4 {
        for j in 0..4 {
            assert!((flat.rows()[k][j] - expected[k][j]).abs() < 1e-12, "{k} {j}");
            let highest = [0.0, link.a2, 0.0, 0.0][j];
            assert!((flat.highest()[j] - highest).abs() < 1e-11);
        }
    }
    // Eq 4.8: θ = (y_f − C_α α)/C_θ.
    let [theta, alpha, ..] = flat.state(&[0.002, 0.0, 0.05, 0.0]).unwrap();
    assert!((alpha - 0.05).abs() < 1e-12 && (theta - (0.002 - c_alpha * 0.05) / c_theta).abs() < 1e-11);
}

#[test]
fn acceptance_c6_the_corrected_printed_law() {
    let law = printed(5e4, 500.0);
    let figures = follow(&RIG, 30_f64.to_radians(), |x, wanted| law.step(&x, f(&RIG, x)[2], wanted)).unwrap();
    assert!(figures.settling <= 0.6 && figures.overshoot <= 2.0 && figures.deflection <= 10.0, "{figures:?}");
    // The reference has .507 s, .3 %, 14.3 V wanted, |s| up to 12, and an error that stays near .9°.
    assert!((figures.settling - 0.507).abs() < 0.01 && (figures.overshoot - 0.3).abs() < 0.2, "{figures:?}");
    assert!((figures.unlimited - 14.3).abs() < 0.3 && (figures.surface - 12.0).abs() < 0.3, "{figures:?}");
    assert!((0.7..1.1).contains(&figures.last_error) && figures.voltage == LIMIT, "{figures:?}");
    // At 15° its error is 2.5°, half of the amplitude of the band.
    let figures = follow(&RIG, 15_f64.to_radians(), |x, wanted| law.step(&x, f(&RIG, x)[2], wanted)).unwrap();
    assert!((figures.last_error - 2.5).abs() < 0.3 && (figures.overshoot - 8.3).abs() < 0.5, "{figures:?}");
    assert!((figures.voltage - 7.25).abs() < 0.3 && (figures.deflection - 5.0).abs() < 0.3, "{figures:?}");
}

#[test]
fn erratum_e21_the_law_never_leaves_its_layer() {
    let (wide, narrow) = (printed(5e4, 500.0), printed(500.0, 5.0));
    assert!((wide.law().switching_input() - 590.0).abs() < 1e-9 && narrow.law().switching_input() < LIMIT);
    for angle in [15.0, 30.0] {
        let run = |law: &PrintedLaw| {
            follow(&RIG, f64::to_radians(angle), |x, wanted| law.step(&x, f(&RIG, x)[2], wanted)).unwrap()
        };
        let (wide, narrow) = (run(&wide), run(&narrow));
        assert!(wide.surface < 18.0, "{wide:?}");
        assert!((wide.last_error - narrow.last_error).abs() < 0.01, "{wide:?} {narrow:?}");
        assert!((wide.overshoot - narrow.overshoot).abs() < 0.1);
        assert!((narrow.unlimited - 5.95).abs() < 0.1, "{narrow:?}");
    }
}

#[test]
fn erratum_e20_by_the_letter_the_loop_diverges() {
    let law = printed(5e4, 500.0);
    let mut last = 0.0;
    let (mut samples, mut largest) = (0, 0.0_f64);
    let run = follow(&RIG, 30_f64.to_radians(), |x, wanted| {
        // y_f⁗ of the last sample: α″ under the voltage that was held.
        let fourth = f(&RIG, x)[3] + RIG.input()[3] * last;
        let command = law.step_by_the_letter(&x, f(&RIG, x)[2], fourth, wanted)?;
        last = command.u;
        samples += 1;
        largest = largest.max(command.unlimited.abs());
        Ok(command)
    });
    assert!(run.is_err(), "{run:?}");
    assert!(f64::from(samples) * DT < 0.5, "{samples} samples");
    assert!(largest > 1000.0, "{largest} V");
}

/// A law with the flat output of each of two tangents, to rest at ±`angle` degrees.
fn with_feed_forward(
    rig: &RotaryFlexibleLink,
    angle: f64,
    tangent: impl Fn(f64) -> Tangent<4>,
    rate: Rate,
) -> Result<Figures, String> {
    let amplitude = angle.to_radians();
    let (surface, layer) = (Surface::repeated(16.0).unwrap(), BoundaryLayer::new(5e4, 500.0).unwrap());
    let to = |theta: f64| {
        let (end, whole) = rest(rig, theta).unwrap();
        let design =
            Design::new(tangent(theta), surface, layer, DT).plant(whole).rate(rate).limited_to(LIMIT);
        let law = design.input_gain(LinkTangent::IDENTIFIED.b_alpha).law().unwrap();
        (law, Target::rest(end.state))
    };
    let (up, down) = (to(amplitude), to(-amplitude));
    follow(rig, amplitude, |x, wanted| {
        let (law, target) = if wanted > 0.0 { &up } else { &down };
        law.step(&x, &f(rig, x), &rig.input(), target)
    })
    .map_err(|e| e.to_string())
}

#[test]
fn acceptance_c6_with_feed_forward_of_the_equilibrium_no_error_is_left() {
    let rig = RIG.without_friction();
    for angle in ANGLES {
        for rate in [Rate::Chain, Rate::Model] {
            let link = |_| LinkTangent::IDENTIFIED.tangent();
            let figures = with_feed_forward(&rig, angle, link, rate).unwrap();
            assert!(figures.last_error <= 0.05, "{angle}° {rate:?}: {figures:?}");
            // The reference: at most .003°, no overshoot, .54 to .93 s.
            assert!(figures.last_error <= 0.003 && figures.overshoot < 0.1, "{angle}° {rate:?}: {figures:?}");
            assert!((0.5..0.95).contains(&figures.settling), "{angle}° {rate:?}: {figures:?}");
        }
    }
}

#[test]
fn the_tangent_at_the_target_needs_less_voltage_and_reaches_farther() {
    let rig = RIG.without_friction();
    for angle in [10.0, 15.0, 20.0, 25.0, 30.0, 35.0] {
        let there = |theta: f64| rest(&rig, theta).unwrap().1;
        let figures = with_feed_forward(&rig, angle, there, Rate::Model).unwrap();
        assert!(figures.last_error <= 1e-3 && figures.overshoot < 0.1, "{angle}°: {figures:?}");
        assert!(figures.settling < 0.85 && figures.voltage < LIMIT, "{angle}°: {figures:?}");
        assert!(figures.deflection < 7.0, "{angle}°: {figures:?}");
    }
    // That of zero is a poor guide to 30°, where the stiffness of the hub has gone.
    let zero = |_| rest(&rig, 0.0).unwrap().1;
    let figures = with_feed_forward(&rig, 30.0, zero, Rate::Model).unwrap();
    assert!(figures.overshoot > 5.0 && figures.last_error <= 0.01, "{figures:?}");
}

#[test]
fn with_friction_an_error_is_left_where_the_hub_sticks() {
    for angle in ANGLES {
        let link = |_| LinkTangent::IDENTIFIED.tangent();
        let figures = with_feed_forward(&RIG, angle, link, Rate::Chain).unwrap();
        assert!((0.0..0.85).contains(&figures.last_error), "{angle}°: {figures:?}");
    }
}

#[test]
fn the_flat_output_of_the_whole_link_gives_the_wanted_poles() {
    for theta in [-30.0, 0.0, 20.0, 30.0] {
        let (_, whole) = rest(&RIG, f64::to_radians(theta)).unwrap();
        let (surface, layer) = (Surface::repeated(16.0).unwrap(), BoundaryLayer::new(5e4, 500.0).unwrap());
        let law = Design::new(whole, surface, layer, DT).law().unwrap();
        let closed = ClosedLoop::new(whole, law.gains(&whole).unwrap()).unwrap();
        // (s + 100)(s + 16)³
        let expected = [409_600.0, 80_896.0, 5_568.0, 148.0];
        for (found, expected) in closed.characteristic().iter().zip(expected) {
            assert!((found / expected - 1.0).abs() < 1e-9, "{theta}°: {found} {expected}");
        }
    }
}
