//! Output feedback: an observer between the sensors and the law.

use std::f64::consts::TAU;

use crate::common::sticky_arm;
use greybox_control::{
    ClosedLoop, ControlError, Controller, DesignOptions, FamilyOptions, Feedback, Integral, LoopOptions,
    Method, ObserverMethod, OutputFeedback, OutputOptions, Plant, PlantOptions, Reference, Run, Sensor,
    design,
};
use greybox_model::Model;

const KALMAN: ObserverMethod = ObserverMethod::Kalman { disturbance: 1.0 };
const ESO: ObserverMethod = ObserverMethod::Eso { bandwidth: 80.0 };

fn arm(friction: f64) -> Model {
    sticky_arm(friction, 0.0, 0.5)
}

fn law(model: &Model) -> Controller {
    let sizes = vec![("theta".to_string(), 0.2), ("theta'".to_string(), 4.0)];
    let plant =
        Plant::of(model, "v", &PlantOptions { sizes, input_size: 5.0, ..PlantOptions::default() }).unwrap();
    design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[-1.0, 1.0], 2e-3)).unwrap()
}

fn with(law: &Controller, method: ObserverMethod, sensor: Sensor) -> LoopOptions {
    let options =
        OutputOptions { method, sensors: vec![("theta".into(), sensor)], integral: Integral::Disturbance };
    let output = OutputFeedback::new(law, &options).unwrap();
    LoopOptions { feedback: Feedback::Output(Box::new(output)), ..LoopOptions::default() }
}

fn run(model: &Model, law: &Controller, options: &LoopOptions, reference: &Reference) -> Run {
    ClosedLoop::new(model, law, options).unwrap().run(reference).unwrap()
}

/// With a fine sensor and nothing unknown, the loop with the observer is that with the full state. (The extended-state
/// observer knows nothing of the plant: it lags by 3/ω where the motor brakes from its limit.)
#[test]
fn with_nothing_unknown_the_observer_gives_the_loop_of_the_full_state() {
    let model = arm(0.0);
    let law = law(&model);
    let reference = Reference::square(0.5, 2.0, 3);
    let full = run(&model, &law, &LoopOptions::default(), &reference);
    let fine = Sensor { noise: 1e-6, resolution: 0.0 };
    for (method, bound) in [(KALMAN, 8e-5), (ESO, 0.08)] {
        let seen = run(&model, &law, &with(&law, method, fine), &reference);
        let far = full.x[0].iter().zip(&seen.x[0]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        println!("{method:?}: {far:.2e}");
        assert!(far < bound, "{method:?}: {far}");
    }
}

/// Friction leaves an error to a law without an integral. The disturbance takes it out and does not hunt about the
/// encoder's last count, also where friction at rest is twice that in motion.
#[test]
fn friction_and_a_wrong_parameter_leave_no_error_and_no_limit_cycle() {
    let nominal = arm(0.0);
    let law = law(&nominal);
    // The machine: friction that the law knows nothing of, and a heavier arm.
    let reference = Reference::square(0.5, 10.0, 4);
    let encoder = Sensor { noise: 0.0, resolution: TAU / 4096.0 };
    for excess in [0.0, 1.0] {
        let mut machine = sticky_arm(0.05, excess, 0.5);
        let at = machine.parameter("mgl").unwrap();
        machine.parameters[at].value = 0.6;
        let full = run(&machine, &law, &LoopOptions::default(), &reference);
        assert!(full.metrics.iter().all(|m| m.final_error.abs() > 0.005), "{:?}", full.metrics);
        for method in [KALMAN, ESO] {
            let seen = run(&machine, &law, &with(&law, method, encoder), &reference);
            for m in &seen.metrics {
                println!(
                    "{excess} {method:?}: {:.2} {:.2}",
                    m.final_error / encoder.resolution,
                    m.peak_to_peak / encoder.resolution
                );
                assert!(m.final_error.abs() <= 0.8 * encoder.resolution, "{method:?}: {m:?}");
                assert!(m.peak_to_peak <= 0.5 * encoder.resolution, "{method:?}: {m:?}");
            }
        }
    }
}

/// The margins are those of the loop that is simulated: with a delay below the margin it comes to rest, beyond it does not.
#[test]
fn the_delay_margin_is_that_of_the_simulated_loop() {
    let model = arm(0.0);
    let law = law(&model);
    let sensor = Sensor { noise: 1e-4, resolution: 0.0 };
    let reference = Reference::step(0.02, 4.0);
    for method in [KALMAN, ESO] {
        let mut options = with(&law, method, sensor);
        let Feedback::Output(output) = &options.feedback else { unreachable!() };
        let margin = output.checks().iter().map(|c| c.margins.delay).fold(f64::INFINITY, f64::min);
        assert!(margin > 1e-3 && margin < 0.1, "{margin}");
        let mut end = |delay: f64| {
            options.delay = delay;
            let run = run(&model, &law, &options, &reference);
            run.metrics.first().map_or(f64::INFINITY, |m| {
                if run.diverged.is_some() { f64::INFINITY } else { m.peak_to_peak }
            })
        };
        let (below, beyond) = (end(0.9 * margin), end(1.1 * margin));
        println!("{method:?}: {below:.1e} {beyond:.1e}");
        assert!(below < 1e-3, "{method:?}: {below}");
        assert!(beyond > 0.025, "{method:?}: {beyond}");
    }
}

/// LQR with the full state has the classical margins, near them when sampled fast.
#[test]
fn the_regulator_has_the_margins_of_the_book() {
    let model = arm(0.0);
    let law = law(&model);
    for margins in law.margins() {
        let m = margins.unwrap();
        assert!(m.phase > 58f64.to_radians() && m.lower_gain < 0.52 && m.gain > 5.0, "{m:?}");
    }
}

/// The estimate follows the state: friction as the disturbance, behind the command.
#[test]
fn the_disturbance_is_the_load() {
    let nominal = arm(0.0);
    let law = law(&nominal);
    let mut machine = arm(0.0);
    let at = machine.parameter("mgl").unwrap();
    machine.parameters[at].value = 0.9;
    let noise = Sensor { noise: 1e-4, resolution: 0.0 };
    for method in [KALMAN, ESO] {
        let options = with(&law, method, noise);
        let Feedback::Output(output) = &options.feedback else { unreachable!() };
        let seen = run(&machine, &law, &options, &Reference::step(1.0, 3.0));
        let mut memory = output.start();
        let mut d = 0.0;
        for (k, theta) in seen.x[0].iter().enumerate() {
            let u = output.command(&mut memory, &[*theta], seen.r[k]);
            assert!(u.is_finite());
            // The mean of the last second.
            if k + 500 >= seen.t.len() {
                d += memory.disturbance() / 500.0;
            }
        }
        let load = -(0.9 - 0.5) * 1f64.sin() / 0.4;
        println!("{method:?}: {d} {load}");
        assert!((d / load - 1.0).abs() < 0.02, "{method:?}: {d} {load}");
        assert!((memory.state()[0] - 1.0).abs() < 0.01);
    }
}

/// The same seed gives the same noise, another one other noise; a family runs with it.
#[test]
fn noise_is_that_of_its_seed() {
    let model = arm(0.02);
    let law = law(&model);
    let mut options = with(&law, KALMAN, Sensor { noise: 1e-3, resolution: 0.0 });
    let reference = Reference::square(0.5, 1.0, 2);
    let first = run(&model, &law, &options, &reference);
    assert_eq!(first, run(&model, &law, &options, &reference));
    options.seed = 1;
    assert_ne!(first.u, run(&model, &law, &options, &reference).u);
    let deviations = vec![("J".to_string(), 0.002), ("mgl".to_string(), 0.05)];
    let looped = ClosedLoop::new(&model, &law, &options).unwrap();
    let family = looped.family(&reference, &FamilyOptions { deviations, members: 8, seed: 1 }).unwrap();
    assert_eq!((family.diverged, family.unstable), (0, 0));
    let own = looped.controller().checks().len();
    let Feedback::Output(output) = &options.feedback else { unreachable!() };
    assert_eq!(output.checks().len(), own);
    let own = output.checks().iter().map(|c| c.margins).reduce(greybox_control::Margins::worse).unwrap();
    let margins = family.margins.unwrap();
    // Margins with the observer, not those with the full state, which are twice as large.
    assert!(
        margins.worst().phase < own.phase && margins.worst().phase > 0.7 * own.phase,
        "{margins:?} {own:?}"
    );
    assert!(margins.median().phase > margins.worst().phase && margins.median().gain > margins.worst().gain);
    let none = FamilyOptions { deviations: Vec::new(), members: 1, seed: 1 };
    let same = looped.family(&reference, &none).unwrap().margins.unwrap().worst();
    assert_eq!(same, own);
}

#[test]
fn what_cannot_be_observed_is_refused() {
    let model = arm(0.0);
    let law = law(&model);
    let make = |method, sensors| {
        OutputFeedback::new(&law, &OutputOptions { method, sensors, integral: Integral::Disturbance })
    };
    let sensor = |noise, resolution| vec![("theta".to_string(), Sensor { noise, resolution })];
    assert!(matches!(make(KALMAN, sensor(-1.0, 0.0)), Err(ControlError::Option { .. })));
    assert!(matches!(make(KALMAN, sensor(0.0, 0.0)), Err(ControlError::Option { .. })));
    assert!(matches!(make(KALMAN, sensor(f64::NAN, 0.0)), Err(ControlError::Option { .. })));
    let rate = vec![("theta'".to_string(), Sensor { noise: 1e-3, resolution: 0.0 })];
    assert!(matches!(make(KALMAN, rate), Err(ControlError::NotMeasured { .. })));
    for disturbance in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let method = ObserverMethod::Kalman { disturbance };
        assert!(matches!(make(method, Vec::new()), Err(ControlError::Option { .. })), "{disturbance}");
    }
    for bandwidth in [0.0, -1.0, f64::NAN] {
        let method = ObserverMethod::Eso { bandwidth };
        assert!(matches!(make(method, Vec::new()), Err(ControlError::Eso { .. })), "{bandwidth}");
    }
}

/// A command that acts 25 ms late loses the loop of a law that does not know it. An observer that predicts over the delay
/// keeps the loop that was designed, shifted by the delay; its margins are those of the simulated loop.
#[test]
fn a_late_command_is_predicted_over() {
    let late = |tau: f64| {
        let mut model = arm(0.0);
        model.parameters.push(greybox_model::model::Parameter {
            name: "tau".into(),
            value: tau,
            ..model.parameters[0].clone()
        });
        let text = "J*theta'' + b*theta' + mgl*sin(theta)";
        model.equations[0].lhs = greybox_model::parse(text).unwrap().expr;
        model.equations[0].rhs = greybox_model::parse("kt*saturate(delay(v, tau), umax)").unwrap().expr;
        model
    };
    let sizes = || vec![("theta".to_string(), 0.2), ("theta'".to_string(), 4.0)];
    let options = PlantOptions {
        sizes: sizes(),
        input_size: 5.0,
        predict_input_delay: true,
        ..PlantOptions::default()
    };
    let set_points = DesignOptions::new("theta", &[-1.0, 1.0], 2e-3);
    let prompt = law(&arm(0.0));
    // At rest first: what a delayed command was before the start is what it is there.
    let reference =
        Reference::SetPoints { set_points: vec![(0.0, 0.0), (0.2, 0.5), (3.2, -0.5)], duration: 6.2 };
    let fine = Sensor { noise: 1e-5, resolution: 0.0 };
    let wanted = run(&arm(0.0), &prompt, &LoopOptions::default(), &reference);
    // A part of a sample, whole samples, both.
    for (tau, samples) in [(0.0013, 0), (0.024, 12), (0.025, 12)] {
        let model = late(tau);
        let plant = Plant::of(&model, "v", &options).unwrap();
        assert_eq!(plant.input_delay(), tau);
        let law = design(&plant, &Method::Lqr, &set_points).unwrap();
        assert_eq!(law.gains(), prompt.gains());
        if samples > 0 {
            let lost = run(&model, &prompt, &with(&prompt, KALMAN, fine), &reference);
            assert!(lost.metrics.iter().skip(1).any(|m| m.settling.is_none()), "{tau}");
        }
        for (method, bound) in [(KALMAN, 4e-4), (ESO, 0.12)] {
            let mut loop_options = with(&law, method, fine);
            let Feedback::Output(output) = &loop_options.feedback else { unreachable!() };
            assert_eq!(output.observer().input_delay().samples, samples);
            let margin = output.checks().iter().map(|c| c.margins.delay).fold(f64::INFINITY, f64::min);
            let seen = run(&model, &law, &loop_options, &reference);
            let shift = (tau / 2e-3).round() as usize;
            let is_whole = (tau / 2e-3 - shift as f64).abs() < 1e-9;
            let far = (shift..seen.t.len())
                // (A set point that is just given acts in one sample and not in the other.)
                .map(|k| (seen.x[0][k] - wanted.x[0][k - shift]).abs())
                .fold(0.0, f64::max);
            println!("{tau} {method:?}: {far:.1e}, margin {margin:.4}");
            // Only whole samples later can the two be compared sample by sample.
            if is_whole {
                assert!(far < bound, "{tau} {method:?}: {far}");
            }
            assert!(seen.metrics.iter().skip(1).all(|m| m.settling.is_some()), "{tau} {method:?}");
            let mut end = |delay: f64| {
                loop_options.delay = delay;
                let run = run(&model, &law, &loop_options, &Reference::step(0.02, 6.0));
                if run.diverged.is_some() { f64::INFINITY } else { run.metrics[0].peak_to_peak }
            };
            let (below, beyond) = (end(0.85 * margin), end(1.2 * margin));
            println!("  {below:.1e} {beyond:.1e}");
            assert!(beyond > 20.0 * below, "{tau} {method:?}: {below} {beyond}");
        }
    }
    let twice = late(0.01);
    let mut other = twice.clone();
    other.equations[0].rhs = greybox_model::parse("kt*delay(v, tau) + 0.1*kt*v").unwrap().expr;
    assert!(matches!(Plant::of(&other, "v", &options), Err(ControlError::SeveralDelays { .. })));
    let long = Plant::of(&late(0.5), "v", &options).unwrap();
    let law = design(&long, &Method::Lqr, &set_points).unwrap();
    let made = OutputFeedback::new(
        &law,
        &OutputOptions { method: KALMAN, sensors: Vec::new(), integral: Integral::Disturbance },
    );
    assert!(matches!(made, Err(ControlError::LongDelay { samples: 250, .. })));
}

/// A motor's current that no sensor has: the Kalman filter has it from the angle, the extended-state observer cannot. And
/// where only the current is measured, nothing tells the angle.
#[test]
fn what_no_sensor_has_is_estimated_or_refused() {
    let motor = |measured: &str| {
        let flag = |name: &str| if name == measured { "" } else { ", measured = false" };
        let text = format!(
            r#"
[inputs]
v = {{ unit = "V" }}
[states]
theta = {{ unit = "rad"{} }}
i = {{ unit = "A"{} }}
[parameters]
J = {{ value = 0.02, unit = "kg m^2" }}
b = {{ value = 0.05, unit = "N m s/rad" }}
k = {{ value = 0.4, unit = "N m/A" }}
ke = {{ value = 0.4, unit = "V s/rad" }}
L = {{ value = 0.01, unit = "H" }}
R = {{ value = 1.0, unit = "ohm" }}
[equations]
arm = "J*theta'' + b*theta' = k*i"
coil = "L*i' + R*i + ke*theta' = v"
"#,
            flag("theta"),
            flag("i")
        );
        Model::from_toml(&text, "motor.toml").unwrap()
    };
    let sizes = [("theta", 0.2), ("theta'", 4.0), ("i", 2.0)].map(|(n, s)| (n.to_owned(), s)).to_vec();
    let law = |model: &Model| {
        let options = PlantOptions { sizes: sizes.clone(), input_size: 5.0, ..PlantOptions::default() };
        let plant = Plant::of(model, "v", &options).unwrap();
        design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[-1.0, 1.0], 2e-3)).unwrap()
    };
    let model = motor("theta");
    let law_of_angle = law(&model);
    let reference = Reference::square(0.5, 2.0, 3);
    let full = run(&model, &law_of_angle, &LoopOptions::default(), &reference);
    let fine = Sensor { noise: 1e-6, resolution: 0.0 };
    let seen = run(&model, &law_of_angle, &with(&law_of_angle, KALMAN, fine), &reference);
    let far = full.x[2].iter().zip(&seen.x[2]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let largest = full.x[2].iter().fold(0.0f64, |m, i| m.max(i.abs()));
    println!("current {far:.1e} of {largest:.1}");
    assert!(far < 8e-3 * largest, "{far}");
    let made = |law: &Controller, method| {
        OutputFeedback::new(
            law,
            &OutputOptions { method, sensors: Vec::new(), integral: Integral::Disturbance },
        )
    };
    let refused = made(&law_of_angle, ESO).unwrap_err();
    assert!(matches!(&refused, ControlError::EsoUnmeasured { name } if name == "i"), "{refused}");
    assert!(matches!(made(&law(&motor("i")), KALMAN), Err(ControlError::Observer { .. })));
}

/// With law and observer as they are, what a plant does to the margins is known: a motor `p` times as strong takes a factor `p`
/// off the gain margin, and `k` samples of further delay take `k dt` off the delay margin. Where that is all, the loop is
/// unstable, and there is none.
#[test]
fn margins_on_another_plant_are_those_of_the_plant() {
    let text = r#"
[inputs]
v = { unit = "V" }
[states]
theta = { unit = "rad" }
[parameters]
J = { value = 0.02, unit = "kg m^2" }
b = { value = 0.15, unit = "N m s/rad" }
mgl = { value = 0.5, unit = "N m" }
kt = { value = 0.4, unit = "N m/V" }
tau = { value = 0.008, unit = "s" }
[equations]
arm = "J*theta'' + b*theta' + mgl*sin(theta) = kt*delay(v, tau)"
"#;
    let model = Model::from_toml(text, "arm.toml").unwrap();
    let sizes = vec![("theta".to_string(), 0.2), ("theta'".to_string(), 4.0)];
    let options =
        PlantOptions { sizes, input_size: 5.0, predict_input_delay: true, ..PlantOptions::default() };
    let plant = Plant::of(&model, "v", &options).unwrap();
    let dt = 2e-3;
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[-1.0, 0.5], dt)).unwrap();
    let with = |kt: f64, tau: f64| plant.with_parameters(&[0.02, 0.15, 0.5, kt, tau]).unwrap();
    for method in [KALMAN, ESO] {
        let wanted = OutputOptions { method, sensors: Vec::new(), integral: Integral::Disturbance };
        let output = OutputFeedback::new(&law, &wanted).unwrap();
        let on = |plant: &Plant| -> Vec<_> {
            output.margins_with(&law, plant).into_iter().map(Option::unwrap).collect()
        };
        let own: Vec<_> = output.checks().iter().map(|c| c.margins).collect();
        assert_eq!(on(&plant), own, "{method:?}");
        let p = 0.5 * (1.0 + own[0].gain);
        let samples = (0.5 * own[0].delay / dt).floor();
        println!("{method:?} {own:?} {p} {samples}");
        assert!(samples >= 1.0);
        let (stronger, later) = (on(&with(0.4 * p, 0.008)), on(&with(0.4, 0.008 + samples * dt)));
        for ((own, stronger), later) in own.iter().zip(stronger).zip(later) {
            assert!((own.gain / stronger.gain / p - 1.0).abs() < 1e-9, "{method:?}: {own:?} {stronger:?}");
            assert!((own.delay - later.delay - samples * dt).abs() < 1e-9, "{method:?}: {own:?} {later:?}");
        }
        // Less delay than the observer predicts over is another loop too, and one with margins of its own.
        assert!(on(&with(0.4, 0.0)).iter().zip(&own).all(|(less, own)| less.delay > own.delay));
        for lost in [with(0.4 * 1.01 * own[0].gain, 0.008), with(0.4, 0.008 + own[0].delay + 2.0 * dt)] {
            assert_eq!(on(&lost)[0], greybox_control::Margins::NONE, "{method:?}");
        }
        assert_eq!(on(&with(0.4, 5.0))[0], greybox_control::Margins::NONE, "{method:?}");
    }
    assert!(matches!(plant.with_parameters(&[1.0]), Err(ControlError::Size { .. })));
    for wrong in [f64::NAN, -1.0] {
        let wrong = plant.with_parameters(&[0.02, 0.15, 0.5, 0.4, wrong]);
        assert!(matches!(wrong, Err(ControlError::Option { .. })));
    }
}
