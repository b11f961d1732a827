//! Loops that follow a trajectory.

use crate::common::load;
use crate::loops::CART_POLE;
use greybox_control::{
    ClosedLoop, ControlError, Controller, DesignOptions, FamilyOptions, Feedback, Integral, LoopOptions,
    Method, ObserverMethod, OutputFeedback, OutputOptions, Plant, PlantOptions, Reference, Run, Sensor,
    Tracking, Trajectory, Verdict, design,
};
use greybox_model::Model;

fn arm(friction: f64, delay: f64) -> Model {
    load(&format!(
        r#"
[inputs]
v = {{ unit = "V" }}
[states]
theta = {{ unit = "rad" }}
[parameters]
J = {{ value = 0.02, unit = "kg m^2" }}
b = {{ value = 0.15, unit = "N m s/rad" }}
fc = {{ value = {friction}, unit = "N m" }}
mgl = {{ value = 0.5, unit = "N m" }}
kt = {{ value = 0.4, unit = "N m/V" }}
tau = {{ value = {delay}, unit = "s" }}
[equations]
arm = "J*theta'' + b*theta' + fc*sign(theta') + mgl*sin(theta) = kt*{}"
"#,
        if delay > 0.0 { "delay(v, tau)" } else { "v" }
    ))
}

fn law(model: &Model, method: &Method, reference: &Trajectory, trajectories: bool) -> Controller {
    let sizes = vec![("theta".to_string(), 0.2), ("theta'".to_string(), 4.0)];
    let options =
        PlantOptions { sizes, input_size: 5.0, predict_input_delay: true, ..PlantOptions::default() };
    let plant = Plant::of(model, "v", &options).unwrap();
    let (least, most) = reference.range();
    let wanted = DesignOptions { trajectories, ..DesignOptions::new("theta", &[least, most], 2e-3) };
    design(&plant, method, &wanted).unwrap()
}

fn run(model: &Model, law: &Controller, options: &LoopOptions, reference: &Trajectory) -> Run {
    let reference = Reference::Trajectory(reference.clone());
    ClosedLoop::new(model, law, options).unwrap().run(&reference).unwrap()
}

fn followed(model: &Model, law: &Controller, reference: &Trajectory) -> Tracking {
    run(model, law, &LoopOptions::default(), reference).tracking.unwrap()
}

fn sampled(duration: f64, value: impl Fn(f64) -> f64) -> Trajectory {
    let count = (duration / 0.01).round() as u32;
    Trajectory::new(0.01, (0..=count).map(|k| value(0.01 * f64::from(k))).collect()).unwrap()
}

/// Half a radian at 1 Hz.
fn sine() -> Trajectory {
    sampled(4.0, |t| 0.5 * (std::f64::consts::TAU * t).sin())
}

/// From rest to rest, one radian in a second: the quintic, without jumps of the acceleration.
fn move_of_a_second() -> Trajectory {
    sampled(2.0, |t| {
        let s = (t - 0.25).clamp(0.0, 1.0);
        s.powi(3) * (10.0 - 15.0 * s + 6.0 * s * s) - 0.5
    })
}

fn methods() -> [Method; 3] {
    [
        Method::Lqr,
        Method::Hjb { degree: 4, domain: vec![1.0, 8.0], bounded: false },
        Method::Smc { lambda: 15.0, eta: 50.0, phi: 1.0 },
    ]
}

/// A law that reads r′ and r″ follows a smooth trajectory; one that takes every value for a set point lags. What is left is
/// what holding the command over a sample costs.
#[test]
fn derivatives_take_out_the_lag() {
    let model = arm(0.0, 0.0);
    for method in methods() {
        for (name, reference, bound) in [("sine", sine(), 2e-3), ("move", move_of_a_second(), 1.5e-3)] {
            let [lagging, following] = [false, true].map(|trajectories| {
                let start =
                    LoopOptions { start: Some(vec![reference.at(0.0)[0], 0.0]), ..LoopOptions::default() };
                let law = law(&model, &method, &reference, trajectories);
                assert_eq!(law.trajectories(), trajectories);
                run(&model, &law, &start, &reference).tracking.unwrap()
            });
            println!(
                "{} {name}: {:.2e} {:.2e} without, {:.2e} {:.2e} with",
                method.name(),
                lagging.later_error.rms,
                lagging.later_error.largest,
                following.later_error.rms,
                following.later_error.largest
            );
            assert!(following.is_close() && !lagging.is_close(), "{} {name}", method.name());
            assert!(
                following.later_error.largest < bound * lagging.later_error.largest,
                "{} {name}: {following:?} {lagging:?}",
                method.name()
            );
        }
    }
}

/// A law within limits follows as one without does, where what the motion takes is well within them, and never goes beyond.
#[test]
fn a_bounded_law_follows_within_its_limits() {
    let (model, reference) = (arm(0.0, 0.0), sine());
    let method = Method::Hjb { degree: 4, domain: vec![1.0, 8.0], bounded: true };
    let options = PlantOptions {
        sizes: vec![("theta".to_string(), 0.2), ("theta'".to_string(), 4.0)],
        input_size: 5.0,
        ..PlantOptions::default()
    };
    let plant = Plant::of(&model, "v", &options).unwrap();
    let error = |limit: f64, trajectories: bool| {
        let wanted = DesignOptions {
            trajectories,
            limit: Some(limit),
            ..DesignOptions::new("theta", &[-0.5, 0.5], 2e-3)
        };
        let law = design(&plant, &method, &wanted).unwrap();
        assert!(law.command_along(&[-9.0, -90.0], &[0.5, 9.0, 99.0]) <= limit);
        followed(&model, &law, &reference).later_error.largest
    };
    let [wide, narrow] = [40.0, 8.0].map(|limit| error(limit, true));
    let lag = error(8.0, false);
    println!("{wide:.2e} {narrow:.2e} {lag:.2e}");
    assert!(wide.max(narrow) < 2e-3 * lag, "{wide} {narrow} {lag}");
}

/// At rest both are one law: what the derivatives add is zero with them, and the gains are those of the set points.
#[test]
fn a_set_point_is_a_trajectory_at_rest() {
    let model = arm(0.0, 0.0);
    for method in methods() {
        let [plain, moving] = [false, true].map(|t| law(&model, &method, &sine(), t));
        assert_eq!(plain.gains(), moving.gains());
        for k in 0..50 {
            let s = |a: f64| 2.0 * (f64::from(k) * a).fract() - 1.0;
            let (x, r) = ([s(0.618), 5.0 * s(0.414)], 0.5 * s(0.732));
            let (a, b) = (plain.command(&x, r), moving.command(&x, r));
            assert!((a - b).abs() <= 1e-12 * a.abs().max(1.0), "{} {a} {b}", method.name());
            // A law of set points does not read them.
            assert_eq!(plain.command_along(&x, &[r, 3.0, -7.0]), a);
            assert_ne!(moving.command_along(&x, &[r, 3.0, -7.0]), b);
        }
        assert!(moving.command_along(&[0.0, 0.0], &[0.0, f64::NAN, 0.0]).is_nan());
    }
}

/// The regulator equations, in closed form: the inverse dynamics of an arm are J r″ + b r′ + mgl sin r.
#[test]
fn the_feed_forward_of_an_arm_is_its_inverse_dynamics() {
    let law = law(&arm(0.0, 0.0), &Method::Lqr, &sine(), true);
    for [r, rate, acceleration] in [[0.3, 2.0, -5.0], [-0.5, -1.0, 20.0], [0.0, 0.0, 1.0]] {
        let wanted = (0.02 * acceleration + 0.15 * rate + 0.5 * f64::sin(r)) / 0.4;
        let found = law.command_along(&[r, rate], &[r, rate, acceleration]);
        assert!((found - wanted).abs() < 1e-6, "{found} {wanted}");
    }
}

/// Of a pole on a cart the cart is tracked, whose zeros are unstable: no inverse of it exists, the series of the regulator
/// equations does. What is left falls with the third derivative, by eight where the move takes twice the time.
#[test]
fn an_output_with_unstable_zeros_is_followed_slowly() {
    let model = load(CART_POLE);
    let sizes = [("x", 0.3), ("x'", 1.0), ("th", 0.2), ("th'", 1.0)].map(|(n, s)| (n.to_owned(), s));
    let options = PlantOptions { sizes: sizes.to_vec(), input_size: 10.0, ..PlantOptions::default() };
    let plant = Plant::of(&model, "u", &options).unwrap();
    let error = |period: f64, trajectories| {
        let reference = sampled(3.0 * period, |t| 0.3 * (std::f64::consts::TAU * t / period).sin());
        let wanted = DesignOptions { trajectories, ..DesignOptions::new("x", &[-0.3, 0.3], 5e-3) };
        let law = design(&plant, &Method::Lqr, &wanted).unwrap();
        followed(&model, &law, &reference).later_error.largest
    };
    let [slow, slower] = [8.0, 16.0].map(|period| error(period, true));
    let lag = error(8.0, false);
    println!("{slow:.2e} {slower:.2e} {lag:.2e}");
    assert!(slow < 0.1 * lag, "{slow} {lag}");
    assert!((6.0..10.0).contains(&(slow / slower)), "{slow} {slower}");
}

/// With an observer, friction, and a command that acts late: the law is given the reference of when its command acts.
#[test]
fn an_observer_follows_with_a_late_command() {
    let reference = sine();
    for delay in [0.0, 0.02] {
        let model = arm(0.02, delay);
        let law = law(&model, &Method::Lqr, &reference, true);
        let output = OutputFeedback::new(
            &law,
            &OutputOptions {
                method: ObserverMethod::Kalman { disturbance: 1.0 },
                sensors: vec![("theta".into(), Sensor { noise: 0.0, resolution: 0.0015 })],
                integral: Integral::Disturbance,
            },
        )
        .unwrap();
        let options = LoopOptions { feedback: Feedback::Output(Box::new(output)), ..LoopOptions::default() };
        let run = run(&model, &law, &options, &reference);
        let t = run.tracking.unwrap();
        println!("{delay}: {t:?}");
        assert!(t.is_close() && run.metrics.is_empty(), "{t:?}");
        // What the law is given is ahead of the reference by the delay.
        let k = 500;
        let given = run.given.each_ref().map(|r| r[k]);
        assert_eq!(given, reference.at(run.t[k] + delay));
        assert_eq!(run.r[k], reference.at(run.t[k])[0]);
    }
}

#[test]
fn a_family_follows_or_strays() {
    let model = arm(0.0, 0.0);
    let reference = Reference::Trajectory(sine());
    let verdict = |trajectories, deviation| {
        let law = law(&model, &Method::Lqr, &sine(), trajectories);
        let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
        let run = looped.run(&reference).unwrap();
        let options = FamilyOptions { deviations: vec![("mgl".into(), deviation)], members: 12, seed: 1 };
        let family = looped.family(&reference, &options).unwrap();
        let spread = family.tracking.unwrap();
        assert!(spread.rms_error.worst < spread.largest_error.worst && family.settling.worst.is_nan());
        assert!(family.largest_command.worst > 0.0 && family.effort.worst >= family.effort.median);
        let own = run.tracking.unwrap().later_error.rms;
        assert!(spread.rms_error.worst > own);
        run.verdict(Some(&family))
    };
    assert_eq!(verdict(true, 0.01), Verdict::Tracks);
    assert_eq!(verdict(true, 0.5), Verdict::Fragile);
    assert_eq!(verdict(false, 0.01), Verdict::Strays);
}

#[test]
fn a_trajectory_that_ends_at_once_is_refused() {
    let model = arm(0.0, 0.0);
    let short = Trajectory::new(1e-4, vec![0.0, 0.1, 0.2, 0.3]).unwrap();
    let law = law(&model, &Method::Lqr, &sine(), true);
    let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
    assert!(matches!(looped.run(&Reference::Trajectory(short)), Err(ControlError::Option { .. })));
}
