//! A controller that is switched on at a machine that rests away from zero.

use crate::common::load;
use greybox_control::{
    ClosedLoop, ControlError, Controller, DesignOptions, Feedback, Integral, LoopOptions, Method,
    ObserverMethod, OutputFeedback, OutputOptions, Plant, PlantOptions, Reference, Run, Sensor, design,
    equilibrium,
};
use greybox_model::Model;

const KALMAN: ObserverMethod = ObserverMethod::Kalman { disturbance: 1.0 };
const ESO: ObserverMethod = ObserverMethod::Eso { bandwidth: 120.0 };
const LQR: Method = Method::Lqr;
const SMC: Method = Method::Smc { lambda: 8.0, eta: 50.0, phi: 1.0 };

/// A motor turns a link through a spring; the load of the link is `weight` of its gravity torque. `more` goes to the state of
/// the link, and `command` is what acts.
fn joint(weight: f64, more: &str, command: &str) -> Model {
    load(&format!(
        r#"
[inputs]
v = {{ unit = "V" }}
[states]
q = {{ unit = "rad" }}
p = {{ unit = "rad"{more} }}
[parameters]
Jm = {{ value = 0.004, unit = "kg m^2" }}
Jl = {{ value = 0.01, unit = "kg m^2" }}
bm = {{ value = 0.05, unit = "N m s/rad" }}
bl = {{ value = 0.002, unit = "N m s/rad" }}
k = {{ value = 4.0, unit = "N m/rad" }}
mgl = {{ value = {weight}, unit = "N m" }}
kt = {{ value = 0.4, unit = "N m/V" }}
tau = {{ value = 0.005, unit = "s" }}
gap = {{ value = 0.2, unit = "V" }}
[equations]
motor = "Jm*q'' + bm*q' + k*(q - p) = kt*{command}"
link = "Jl*p'' + bl*p' + k*(p - q) + mgl*sin(p) = 0"
"#
    ))
}

fn law(model: &Model, method: &Method) -> Controller {
    let sizes = [("q", 0.3), ("q'", 3.0), ("p", 0.3), ("p'", 3.0)].map(|(n, s)| (n.to_owned(), s)).to_vec();
    let options =
        PlantOptions { sizes, input_size: 5.0, predict_input_delay: true, ..PlantOptions::default() };
    let plant = Plant::of(model, "v", &options).unwrap();
    design(&plant, method, &DesignOptions::new("p", &[-0.6, 0.6], 2e-3)).unwrap()
}

fn with(law: &Controller, method: ObserverMethod, integral: Integral) -> OutputFeedback {
    let names = law.plant().state_names();
    let measured = (0..names.len()).filter(|i| law.plant().measured()[*i]);
    let sensors = measured.map(|i| (names[i].clone(), Sensor { noise: 1e-6, resolution: 0.0 })).collect();
    OutputFeedback::new(law, &OutputOptions { method, sensors, integral }).unwrap()
}

/// The loop from the rest at `at`, where the set point is, with the observer started there or at zero.
fn run(model: &Model, law: &Controller, output: &OutputFeedback, at: f64, is_started: bool) -> Run {
    let rest = equilibrium(law.plant(), law.tracked(), at, &law.design_point().equilibrium).unwrap();
    let options = LoopOptions {
        start: Some(rest.state),
        feedback: Feedback::Output(Box::new(output.clone())),
        held: is_started.then_some(law.plant().before_dead_zone(rest.input)),
        ..LoopOptions::default()
    };
    let reference = Reference::SetPoints { set_points: vec![(0.0, at)], duration: 2.0 };
    ClosedLoop::new(model, law, &options).unwrap().run(&reference).unwrap()
}

/// How far the tracked state goes from where it rests.
fn bump(run: &Run, at: f64) -> f64 {
    assert_eq!(run.diverged, None);
    run.x[run.tracked].iter().map(|x| (x - at).abs()).fold(0.0, f64::max)
}

/// The command at the held one moves the estimate by nothing, and gives itself again, in the linear case up to rounding; from
/// zero it throws the link by a tenth of a radian.
#[test]
fn a_joint_that_rests_is_not_thrown() {
    const HIDDEN: &str = ", measured = false";
    // (The feed-forward of a gravity torque is a polynomial, and right to its fit.)
    for (weight, more, command, exact) in [
        (0.0, HIDDEN, "v", 1e-12),
        (0.0, "", "v", 1e-12),
        (0.3, HIDDEN, "v", 1e-4),
        (0.3, "", "v", 1e-4),
        (0.3, HIDDEN, "delay(v, tau)", 1e-4),
        (0.3, HIDDEN, "deadzone(v, gap)", 1e-4),
    ] {
        let model = joint(weight, more, command);
        for (method, observer) in [(&LQR, KALMAN), (&LQR, ESO), (&SMC, KALMAN)] {
            let what = format!("{weight} {more} {command} {method:?} {observer:?}");
            if observer == ESO && !more.is_empty() {
                continue;
            }
            let law = law(&model, method);
            for integral in [Integral::Disturbance, Integral::AtRest { time: None }, Integral::Off] {
                if matches!(integral, Integral::AtRest { .. }) && !more.is_empty() {
                    continue;
                }
                let output = with(&law, observer, integral);
                for at in [0.4, -0.55] {
                    let rest =
                        equilibrium(law.plant(), law.tracked(), at, &law.design_point().equilibrium).unwrap();
                    let held = law.plant().before_dead_zone(rest.input);
                    let y: Vec<f64> = output.observer().measured().iter().map(|&i| rest.state[i]).collect();
                    let mut memory = output.start_at(&y, held).unwrap();
                    let first = memory.state().to_vec();
                    let off = first.iter().zip(&rest.state).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(off < 1e-9 && memory.disturbance().abs() < 1e-8, "{what}: {off}");
                    for _ in 0..50 {
                        let u = output.command(&mut memory, &y, at);
                        assert!((u - held).abs() < 50.0 * exact * 5.0, "{what} {integral:?}: {u} {held}");
                    }
                    let moved = first.iter().zip(memory.state()).map(|(a, b)| (a - b).abs());
                    let moved = moved.fold(0.0, f64::max);
                    assert!(moved < 50.0 * exact, "{what} {integral:?}: {moved}");
                }
            }
            let output = with(&law, observer, Integral::Disturbance);
            let started = bump(&run(&model, &law, &output, 0.4, true), 0.4);
            let zero = bump(&run(&model, &law, &output, 0.4, false), 0.4);
            println!("{what}: {started:.1e}, from zero {zero:.1e}");
            assert!(started < 1e-5, "{what}: {started}");
            if !more.is_empty() {
                assert!(zero > 0.1, "{what}: {zero}");
            }
        }
    }
}

/// A command that is not that of the model is a disturbance, and the integral has it from the first sample on: the first command
/// is the held one.
#[test]
fn the_first_command_is_the_held_one() {
    for (more, observer) in [(", measured = false", KALMAN), ("", KALMAN), ("", ESO)] {
        let model = joint(0.0, more, "v");
        let law = law(&model, &LQR);
        for integral in [Integral::Disturbance, Integral::AtRest { time: None }] {
            if matches!(integral, Integral::AtRest { .. }) && !more.is_empty() {
                continue;
            }
            let output = with(&law, observer, integral);
            let y = vec![0.4; output.observer().measured().len()];
            let mut memory = output.start_at(&y, 1.5).unwrap();
            assert!((memory.disturbance() + 1.5).abs() < 1e-9, "{observer:?}: {}", memory.disturbance());
            let u = output.command(&mut memory, &y, 0.4);
            assert!((u - 1.5).abs() < 1e-9, "{observer:?} {integral:?}: {u}");
        }
        // Without an integral the command is that of the model.
        let output = with(&law, observer, Integral::Off);
        let y = vec![0.4; output.observer().measured().len()];
        let mut memory = output.start_at(&y, 1.5).unwrap();
        assert!(output.command(&mut memory, &y, 0.4).abs() < 1e-9);
    }
}

/// Two sensors that disagree: the state is one of rest, and nearer to the better sensor by the squares of their noise.
#[test]
fn sensors_that_disagree_are_weighted() {
    let model = joint(0.0, "", "v");
    let law = law(&model, &LQR);
    let sensor = |name: &str, noise: f64| (name.to_owned(), Sensor { noise, resolution: 0.0 });
    let sensors = vec![sensor("q", 1e-3), sensor("p", 3e-3)];
    let options = OutputOptions { method: KALMAN, sensors, integral: Integral::Disturbance };
    let memory = OutputFeedback::new(&law, &options).unwrap().start_at(&[0.4, 0.5], 0.0).unwrap();
    // (0.4/1 + 0.5/9)/(1 + 1/9)
    let mean = 0.41;
    let rest = [mean, 0.0, mean, 0.0];
    let off = memory.state().iter().zip(rest).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(off < 1e-9 && memory.disturbance().abs() < 1e-9, "{:?}", memory.state());
}

#[test]
fn what_is_no_rest_is_refused() {
    let model = joint(0.3, ", measured = false", "v");
    let law = law(&model, &LQR);
    let output = with(&law, KALMAN, Integral::Disturbance);
    for (y, u) in [(f64::NAN, 0.0), (0.4, f64::NAN), (f64::INFINITY, 0.0), (1e300, 0.0)] {
        let refused = output.start_at(&[y], u);
        assert!(matches!(refused, Err(ControlError::NoStart { .. })), "{y} {u}: {refused:?}");
    }
    assert!(matches!(output.start_at(&[], 0.0), Err(ControlError::Size { .. })));
}
