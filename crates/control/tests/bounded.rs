//! Laws whose limits are in the cost.

use crate::common::{CART, PENDULUM, link, load};
use greybox_control::{
    ClosedLoop, ControlError, Controller, DesignOptions, FamilyOptions, LoopOptions, Method, Metrics, Plant,
    PlantOptions, Reference, Weights, design,
};
use greybox_model::Model;

fn sized(sizes: &[(&str, f64)], input_size: f64) -> PlantOptions {
    PlantOptions {
        sizes: sizes.iter().map(|(n, s)| ((*n).to_owned(), *s)).collect(),
        input_size,
        ..PlantOptions::default()
    }
}

fn hjb(degree: u8, domain: &[f64], bounded: bool) -> Method {
    Method::Hjb { degree, domain: domain.to_vec(), bounded }
}

/// A pendulum whose torque has a dead zone of 0.2 and reaches from −1.2 to 3.2 N m.
fn lopsided() -> (Model, Plant) {
    let text = PENDULUM.replace("saturate(tau, lim)", "min(max(deadzone(tau, gap), -weak), lim)").replace(
        "[equations]",
        "gap = { value = 0.2, unit = \"N m\" }\nweak = { value = 1.0, unit = \"N m\" }\n[equations]",
    );
    let model = load(&text);
    let plant = Plant::of(&model, "tau", &sized(&[("theta", 1.0), ("theta'", 10.0)], 1.0)).unwrap();
    (model, plant)
}

#[test]
fn a_bounded_law_stays_within_its_limits_and_is_the_free_one_near_rest() {
    let (_, plant) = lopsided();
    let set_points = [-0.8, 0.0, 0.5, 1.0];
    let wanted = DesignOptions::new("theta", &set_points, 2e-3);
    let law = |bounded| design(&plant, &hjb(4, &[2.0, 12.0], bounded), &wanted).unwrap();
    let (bounded, free) = (law(true), law(false));
    assert_eq!(bounded.limits(), (-1.2, 3.2));
    // It rests where the other rests, with the poles that the other has, at every set point.
    for (ours, theirs) in bounded.checks().iter().zip(free.checks()) {
        let (x, r) = (&ours.equilibrium.state, ours.set_point);
        assert!((bounded.command(x, r) - free.command(x, r)).abs() < 1e-12, "{ours:?}");
        for (a, b) in ours.poles.iter().zip(&theirs.poles) {
            assert!((a.re - b.re).abs() + (a.im - b.im).abs() < 1e-9, "{ours:?} {theirs:?}");
        }
    }
    // Before the dead zone is made up for, it uses the range of −1 to 3 N m, and does not leave it.
    let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
    for k in 0..2000 {
        let wave = |i: usize| (1.7 * (k * (2 * i + 3)) as f64).sin();
        let (x, r) = ([2.0 * wave(0), 12.0 * wave(1)], wave(2));
        let u = bounded
            .unlimited()
            .eval(&|name, primes| match (name, primes) {
                ("theta", p) => Some(x[usize::from(p)]),
                ("r", 0) => Some(r),
                _ => plant.parameters().iter().find(|(n, _)| n == name).map(|(_, v)| *v),
            })
            .unwrap();
        (lowest, highest) = (lowest.min(u), highest.max(u));
    }
    println!("command from {lowest} to {highest}");
    assert!((-1.0 - 1e-12..-0.99).contains(&lowest) && (2.8..3.0 + 1e-12).contains(&highest));
    assert!(bounded.verification().unwrap().holds_everywhere());
}

/// Largest overshoot and settling time over the steps of a run and of perturbed plants.
fn steps(model: &Model, law: &Controller, reference: &Reference, family: &FamilyOptions) -> [f64; 4] {
    let looped = ClosedLoop::new(model, law, &LoopOptions::default()).unwrap();
    let run = looped.run(reference).unwrap();
    let worst = |of: fn(&Metrics) -> f64| run.metrics.iter().map(of).fold(0.0, f64::max);
    let family = looped.family(reference, family).unwrap();
    let settling = |m: &Metrics| m.settling.unwrap_or(f64::INFINITY);
    [worst(|m| m.overshoot), worst(settling), family.overshoot.worst, family.settling.worst]
}

#[test]
fn a_cart_pushed_to_its_limit_brakes_in_time() {
    let text =
        CART.replace(" + fc*sign(x')", "").replace("fc = { value = 1.5, unit = \"N\", std = 0.3 }\n", "");
    let model = load(&text);
    // Speed and force hardly cost, and 4 N is little: the regulator asks for up to 100 N.
    let plant = Plant::of(&model, "u", &sized(&[("x", 1.0), ("x'", 50.0)], 100.0)).unwrap();
    let mut wanted = DesignOptions::new("x", &[-0.5, 0.5], 2e-3);
    wanted.limit = Some(4.0);
    let family = FamilyOptions { deviations: vec![("m".into(), 0.3)], members: 12, seed: 1 };
    let found = [Method::Lqr, hjb(4, &[1.2, 2.0], true), hjb(6, &[1.2, 2.0], true)].map(|method| {
        let law = design(&plant, &method, &wanted).unwrap();
        if let Method::Hjb { .. } = method {
            assert!(law.law()[0].to_string().starts_with("saturate(-4*tanh("), "{}", law.law()[0]);
        }
        let [overshoot, settling, worst, slowest] =
            steps(&model, &law, &Reference::square(0.5, 4.0, 3), &family);
        println!(
            "cart, {}: overshoot {overshoot:.3}, settling {settling:.2} s; family {worst:.3}, {slowest:.2} s",
            method.name()
        );
        [overshoot, settling, worst, slowest]
    });
    let [clipped, fourth, sixth] = found;
    assert!(clipped[0] > 0.12 && clipped[2] > 0.16 && clipped[1] > 1.9, "{clipped:?}");
    assert!(fourth[0] < 0.006 && fourth[2] < 0.014 && fourth[1] < 0.85 * clipped[1], "{fourth:?}");
    assert!(sixth[0] < 0.028 && sixth[2] < 0.17 && sixth[1] < 0.7 * clipped[1], "{sixth:?}");
}

#[test]
fn a_pendulum_gains_nothing() {
    // Where speed costs enough, clipping does no harm, and the bounded law is the slower one.
    let model = load(PENDULUM);
    let plant = Plant::of(&model, "tau", &sized(&[("theta", 1.0), ("theta'", 10.0)], 5.0)).unwrap();
    let mut wanted = DesignOptions::new("theta", &[-1.0, 1.0], 2e-3);
    wanted.limit = Some(1.0);
    let deviations = vec![("J".into(), 0.003), ("mgl".into(), 0.02)];
    let family = FamilyOptions { deviations, members: 12, seed: 1 };
    let found = [Method::Lqr, hjb(6, &[3.3, 20.0], false), hjb(6, &[3.3, 20.0], true)].map(|method| {
        let law = design(&plant, &method, &wanted).unwrap();
        let [overshoot, settling, worst, slowest] = steps(&model, &law, &Reference::square(1.0, 3.0, 3), &family);
        println!(
            "pendulum, {method:?}: overshoot {overshoot:.3}, settling {settling:.3} s; family {worst:.3}, {slowest:.3} s"
        );
        assert!(overshoot < 1e-3 && worst < 0.024);
        settling
    });
    assert!(found[2] > 1.1 * found[0] && found[2] < 1.4 * found[0], "{found:?}");
}

#[test]
fn a_link_whose_limit_hardly_binds_gains_little() {
    let model = link(0.0);
    let sizes = [("theta", 0.35), ("theta'", 3.0), ("alpha", 0.1), ("alpha'", 2.0)];
    let plant = Plant::of(&model, "v", &sized(&sizes, 5.0)).unwrap();
    let angle = 20f64.to_radians();
    let mut wanted = DesignOptions::new("theta", &[-angle, angle], 1e-3);
    wanted.limit = Some(5.0);
    wanted.weights = Some(Weights { states: vec![121.0, 1.0, 1.0, 5.0], input: 1.0 });
    let family = FamilyOptions { deviations: vec![("ah".into(), 0.03)], members: 6, seed: 1 };
    let domain = [0.75, 6.0, 0.25, 6.0];
    let found = [false, true].map(|bounded| {
        let law = design(&plant, &hjb(4, &domain, bounded), &wanted).unwrap();
        let [overshoot, settling, worst, slowest] =
            steps(&model, &law, &Reference::square(angle, 3.0, 3), &family);
        println!(
            "link, bounded {bounded}: overshoot {overshoot:.3}, settling {settling:.3} s; family {worst:.3}, {slowest:.3} s"
        );
        [overshoot, settling, worst, slowest]
    });
    let [free, bounded] = found;
    assert!((free[0] - bounded[0]).abs() < 2e-3 && (free[2] - bounded[2]).abs() < 3e-3, "{found:?}");
    assert!(bounded[1] < free[1] && bounded[1] > 0.8 * free[1], "{found:?}");
}

#[test]
fn limits_that_bound_nothing_are_refused() {
    let plant = Plant::of(&load(CART), "u", &PlantOptions::default()).unwrap();
    let wanted = DesignOptions::new("x", &[0.0, 1.0], 1e-2);
    let error = design(&plant, &hjb(4, &[], true), &wanted).unwrap_err();
    assert!(matches!(error, ControlError::Option { .. }), "{error}");
    assert!(error.to_string().contains("a limit of the input"), "{error}");
    // 0.5 sin 1.2 N m hold the pendulum there; −1 to 0.46 N m are left behind a dead zone, if at all.
    let (_, plant) = lopsided();
    let wanted = DesignOptions::new("theta", &[0.0, 1.2], 2e-3);
    let within = |limit: f64| {
        let options = DesignOptions { limit: Some(limit), ..wanted.clone() };
        design(&plant, &hjb(4, &[2.0, 12.0], true), &options)
    };
    let held = 0.5 * 1.2f64.sin();
    for limit in [0.1, 0.3, held + 0.2, held + 0.2 + 1e-9] {
        let error = within(limit).unwrap_err();
        assert!(matches!(error, ControlError::Unholdable { .. }), "{limit}: {error}");
    }
    assert!(within(held + 0.25).is_ok());
}
