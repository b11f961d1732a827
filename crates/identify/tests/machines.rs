//! Machines with several coordinates and inputs: which input drives which equation is found, not told.

use greybox_identify::{DelayedState, Identification, IdentifyError, Library, Options, Quiet, identify};
use greybox_model::Hold;
use greybox_recording::{Channel, Recording};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;

const STEP: f64 = 0.01;
const SAMPLES: usize = 2500;

/// Sines of random phase between 0.3 and 2.5 Hz.
fn excitation(random: &mut Pcg64Mcg, size: f64) -> Vec<f64> {
    let sines: Vec<(f64, f64)> = (0..8)
        .map(|i| {
            (
                std::f64::consts::TAU * 0.3 * 8.0_f64.powf(f64::from(i) / 7.0),
                random.random_range(0.0..std::f64::consts::TAU),
            )
        })
        .collect();
    let at = |t: f64| 0.5 * size * sines.iter().map(|(w, phase)| (w * t + phase).sin()).sum::<f64>();
    (0..SAMPLES).map(|k| at(k as f64 * STEP)).collect()
}

/// A column of a recording: name and unit.
type Column = (&'static str, &'static str);

/// A recording of ẋ = rates(x, u) from rest, RK4 with inputs linear between samples; the first states are measured
/// with a noise of `share` of what they move.
fn record(
    seed: u64,
    share: f64,
    states: (usize, &[Column]),
    inputs: &[(Column, f64)],
    rates: impl Fn(&[f64], &[f64]) -> Vec<f64>,
) -> Recording {
    const SUBSTEPS: usize = 8;
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let u: Vec<Vec<f64>> = inputs.iter().map(|(_, size)| excitation(&mut random, *size)).collect();
    let (order, measured) = states;
    let h = STEP / SUBSTEPS as f64;
    let mut x = vec![0.0; order];
    let mut y = vec![Vec::new(); measured.len()];
    for k in 0..SAMPLES {
        y.iter_mut().zip(&x).for_each(|(y, x)| y.push(*x));
        for s in 0..SUBSTEPS {
            let drive = |w: f64| -> Vec<f64> {
                let at = (s as f64 + w) / SUBSTEPS as f64;
                u.iter().map(|u| u[k] + at * (u[(k + 1).min(SAMPLES - 1)] - u[k])).collect()
            };
            let moved =
                |r: &[f64], w: f64| -> Vec<f64> { x.iter().zip(r).map(|(x, r)| x + w * h * r).collect() };
            let a = rates(&x, &drive(0.0));
            let b = rates(&moved(&a, 0.5), &drive(0.5));
            let c = rates(&moved(&b, 0.5), &drive(0.5));
            let d = rates(&moved(&c, 1.0), &drive(1.0));
            x.iter_mut().enumerate().for_each(|(i, x)| *x += h / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i]));
        }
    }
    let mut channels = Vec::new();
    let mut add = |(name, unit): Column, values| {
        channels.push(Channel { name: name.to_string(), unit: Some(unit.to_string()), values });
    };
    inputs.iter().zip(u).for_each(|((column, _), values)| add(*column, values));
    for (column, y) in measured.iter().zip(y) {
        let mean = y.iter().sum::<f64>() / y.len() as f64;
        let spread = (y.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / y.len() as f64).sqrt();
        let normal = Normal::new(0.0, share * spread).unwrap();
        add(*column, y.iter().map(|v| v + normal.sample(&mut random)).collect());
    }
    let time = (0..SAMPLES).map(|k| k as f64 * STEP).collect();
    Recording::from_columns("machine.csv", time, channels).unwrap()
}

fn found(recording: &Recording, options: &Options) -> Identification {
    let one = std::slice::from_ref(recording);
    identify(one, one, options, &Quiet).unwrap()
}

fn options(states: &[&str], inputs: &[&str], order: usize) -> Options {
    Options { order, hold: Some(Hold::Linear), replicates: 0, ..Options::new(states, inputs) }
}

/// The equation of a state as `terms = input`, the terms sorted.
fn written(found: &Identification, equation: usize) -> String {
    let mut terms: Vec<&str> =
        found.equations[equation].terms.iter().map(|t| t.expression.as_str()).collect();
    terms.sort_unstable();
    format!("{} = {}", terms.join(" + "), found.equations[equation].input.as_deref().unwrap_or("0"))
}

fn value(found: &Identification, equation: usize, expression: &str) -> f64 {
    let terms = &found.equations[equation].terms;
    terms.iter().find(|t| t.expression == expression).map_or(f64::NAN, |t| t.value)
}

fn near(found: &Identification, equation: usize, expected: &[(&str, f64)], share: f64) {
    for (expression, truth) in expected {
        let value = value(found, equation, expression);
        assert!((value / truth - 1.0).abs() < share, "{expression}: {value}, not {truth}");
    }
}

/// m₁ = 1.2, m₂ = 0.8, springs 40 to the ground and 60 between, dampers 0.6 and 0.3; a share of the force on each mass.
fn chain(seed: u64, on: [f64; 2]) -> Recording {
    let measured: [Column; 2] = [("x1", "m"), ("x2", "m")];
    record(seed, 0.01, (4, &measured), &[(("f", "N"), 5.0)], |x, u| {
        let between = 60.0 * (x[1] - x[0]) + 0.3 * (x[3] - x[2]);
        let first = (on[0] * u[0] + between - 40.0 * x[0] - 0.6 * x[2]) / 1.2;
        vec![x[2], x[3], first, (on[1] * u[0] - between) / 0.8]
    })
}

const FIRST: &str = "x1 + x1' + x1'' + x2 + x2'";
const SECOND: &str = "x1 + x1' + x2 + x2' + x2''";

#[test]
fn a_force_is_found_on_the_mass_that_it_acts_on_over_seeds() {
    let options = options(&["x1", "x2"], &["f"], 2);
    let (mut right, mut tried) = (0, 0);
    for seed in 0..10 {
        for (on, inputs) in [([1.0, 0.0], ["f", "0"]), ([0.0, 1.0], ["0", "f"])] {
            let found = found(&chain(70 + seed, on), &options);
            let expected = [format!("{FIRST} = {}", inputs[0]), format!("{SECOND} = {}", inputs[1])];
            tried += 1;
            right += usize::from([written(&found, 0), written(&found, 1)] == expected);
        }
    }
    assert!(right >= tried - 1, "{right} of {tried}");
}

#[test]
fn the_equation_without_the_force_is_divided_by_its_mass() {
    let found = found(&chain(3, [1.0, 0.0]), &options(&["x1", "x2"], &["f"], 2));
    near(&found, 0, &[("x1''", 1.2), ("x1", 100.0), ("x1'", 0.9), ("x2", -60.0)], 0.03);
    assert_eq!(value(&found, 1, "x2''"), 1.0);
    assert!(found.equations[1].terms[0].ci95.is_none(), "what sets the scale is not estimated");
    near(&found, 1, &[("x2", 75.0), ("x1", -75.0), ("x2'", 0.375)], 0.03);
}

#[test]
fn a_force_between_two_masses_has_its_sign_and_share_in_both_equations() {
    let found = found(&chain(5, [0.5, -0.25]), &options(&["x1", "x2"], &["f"], 2));
    assert_eq!(written(&found, 0), format!("{FIRST} = f"));
    assert_eq!(written(&found, 1), format!("{SECOND} = f"));
    near(&found, 0, &[("x1''", 2.4), ("x1", 200.0)], 0.03);
    near(&found, 1, &[("x2''", -3.2), ("x2", -240.0)], 0.03);
}

#[test]
fn an_input_that_does_nothing_is_left_out_even_if_it_is_named_first() {
    let recording =
        record(9, 0.01, (2, &[("x", "m")]), &[(("idle", "V"), 1.0), (("f", "N"), 5.0)], |x, u| {
            vec![x[1], (u[1] - 30.0 * x[0] - 0.8 * x[1]) / 1.5]
        });
    let found = found(&recording, &options(&["x"], &["idle", "f"], 3));
    assert_eq!(written(&found, 0), "x + x' + x'' = f");
    near(&found, 0, &[("x''", 1.5), ("x", 30.0), ("x'", 0.8)], 0.02);
}

#[test]
fn a_drive_has_a_motion_of_second_order_and_a_current_of_first() {
    // J θ″ + b θ′ − k i = 0, L i′ + R i + k θ′ = v.
    let recording = record(4, 0.01, (3, &[("theta", "rad"), ("i", "A")]), &[(("v", "V"), 4.0)], |x, u| {
        vec![x[2], (u[0] - 1.5 * x[1] - 0.12 * x[2]) / 0.08, (0.12 * x[1] - 0.015 * x[2]) / 0.02]
    });
    let options = Options { derivatives: vec![2, 1], ..options(&["theta", "i"], &["v"], 2) };
    let found = found(&recording, &options);
    assert_eq!(written(&found, 0), "i + theta' + theta'' = 0");
    assert_eq!(written(&found, 1), "i + i' + theta' = v");
    near(&found, 0, &[("i", -6.0), ("theta'", 0.75)], 0.05);
    near(&found, 1, &[("i'", 0.08), ("i", 1.5), ("theta'", 0.12)], 0.05);
}

/// A pendulum hanging from a cart on a spring, the force on the cart.
fn cart(seed: u64) -> Recording {
    let measured: [Column; 2] = [("x", "m"), ("theta", "rad")];
    record(seed, 0.01, (4, &measured), &[(("f", "N"), 6.0)], |x, u| {
        let (s, c) = x[1].sin_cos();
        let on_cart = u[0] + 0.12 * s * x[3] * x[3] - 1.5 * x[2] - 20.0 * x[0];
        let on_pendulum = -1.18 * s - 0.02 * x[3];
        let (a, b, d) = (1.3, 0.12 * c, 0.06);
        let determinant = a * d - b * b;
        let v = (d * on_cart - b * on_pendulum) / determinant;
        vec![x[2], x[3], v, (a * on_pendulum - b * on_cart) / determinant]
    })
}

fn rigid(states: &[&str], inputs: &[&str]) -> Options {
    let usual = options(states, inputs, 1);
    Options { library: Library { lagrangian: true, ..usual.library.clone() }, ..usual }
}

#[test]
fn inertia_that_couples_a_pendulum_to_its_cart_is_one_coefficient_in_both_equations() {
    let on_cart = "(cos(theta)*theta'' - sin(theta)*theta'^2) + x + x' + x'' = f";
    let on_pendulum = "cos(theta)*x'' + sin(theta) + theta' + theta'' = 0";
    let mut right = 0;
    for seed in 0..8 {
        let found = found(&cart(20 + seed), &rigid(&["x", "theta"], &["f"]));
        if written(&found, 0) != on_cart || written(&found, 1) != on_pendulum {
            continue;
        }
        right += 1;
        near(&found, 0, &[("x''", 1.3), ("x", 20.0), ("x'", 1.5)], 0.02);
        near(&found, 1, &[("theta''", 0.06), ("sin(theta)", 1.18), ("cos(theta)*x''", 0.12)], 0.02);
        let parameter = |e: usize, t: &str| {
            found.equations[e]
                .terms
                .iter()
                .find(|f| f.expression == t)
                .map(|f| (f.parameter.clone(), f.value))
        };
        assert_eq!(
            parameter(0, "(cos(theta)*theta'' - sin(theta)*theta'^2)"),
            parameter(1, "cos(theta)*x''"),
            "the coefficient is shared"
        );
    }
    assert!(right >= 7, "{right} of 8");
}

#[test]
fn two_torques_of_strength_one_stand_on_the_right_of_their_equations() {
    // Two links in the plane; the angle of the second is counted from the first.
    let measured: [Column; 2] = [("q1", "rad"), ("q2", "rad")];
    let inputs = [(("t2", "N*m"), 0.6), (("t1", "N*m"), 3.0)];
    let recording = record(8, 0.005, (4, &measured), &inputs, |x, u| {
        let (s, c) = x[1].sin_cos();
        let gravity = 1.57 * (x[0] + x[1]).sin();
        let h = 0.08;
        let first =
            u[1] + h * s * (2.0 * x[2] * x[3] + x[3] * x[3]) - 7.6 * x[0].sin() - gravity - 0.3 * x[2];
        let second = u[0] - h * s * x[2] * x[2] - gravity - 0.08 * x[3];
        let (a, b, d) = (0.4 + 2.0 * h * c, 0.052 + h * c, 0.052);
        let determinant = a * d - b * b;
        vec![x[2], x[3], (d * first - b * second) / determinant, (a * second - b * first) / determinant]
    });
    let found = found(&recording, &rigid(&["q1", "q2"], &["t2", "t1"]));
    let inputs: Vec<Option<&str>> = found.equations.iter().map(|e| e.input.as_deref()).collect();
    assert_eq!(inputs, [Some("t1"), Some("t2")]);
    near(&found, 0, &[("q1''", 0.4), ("q2''", 0.052), ("sin(q1)", 7.6), ("sin(q1 + q2)", 1.57)], 0.02);
    near(&found, 1, &[("q2''", 0.052), ("q1''", 0.052), ("0.5*sin(q2)*q1'^2", 0.16), ("q2'", 0.08)], 0.03);
    assert_eq!(found.equations[0].terms.len() + found.equations[1].terms.len(), 13, "nothing else");
}

#[test]
fn an_input_that_does_nothing_sets_no_scale_of_rigid_bodies_and_orders_are_found_beside_energies() {
    // A pendulum with a cubic spring: θ″ + 0.3 θ′ + 9 sin θ + 4 θ³ = f.
    let inputs = [(("idle", "V"), 1.0), (("f", "N*m"), 6.0)];
    let recording = record(13, 0.005, (2, &[("theta", "rad")]), &inputs, |x, u| {
        vec![x[1], u[1] - 0.3 * x[1] - 9.0 * x[0].sin() - 4.0 * x[0].powi(3)]
    });
    let found = found(&recording, &Options { order: 3, ..rigid(&["theta"], &["idle", "f"]) });
    assert_eq!(written(&found, 0), "sin(theta) + theta' + theta'' + theta^3 = f");
    near(&found, 0, &[("theta''", 1.0), ("sin(theta)", 9.0), ("theta^3", 4.0)], 0.03);
    assert_eq!(found.order.chosen, 3);
}

#[test]
fn energies_without_an_angle_or_leading_derivatives_for_other_states_are_refused() {
    let recording = chain(1, [1.0, 0.0]);
    let error = |options: Options| {
        let one = std::slice::from_ref(&recording);
        identify(one, one, &options, &Quiet).unwrap_err()
    };
    assert!(matches!(error(rigid(&["x1", "x2"], &["f"])), IdentifyError::NoAngle { .. }));
    let recording = cart(1);
    let delay = DelayedState { state: "x".to_string(), gain: None, longest: 0.5 };
    let delayed = Options { delay: Some(delay), ..rigid(&["x", "theta"], &["f"]) };
    let refused = identify(std::slice::from_ref(&recording), &[], &delayed, &Quiet).unwrap_err();
    assert!(matches!(refused, IdentifyError::DelayWithEnergies), "{refused}");
    let one_order = Options { derivatives: vec![2], ..options(&["x1", "x2"], &["f"], 1) };
    let text = error(one_order).to_string();
    assert!(text.contains("1 orders") && text.contains("x1, x2"), "{text}");
}
