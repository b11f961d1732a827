//! Integral action at rest: a machine that sticks does not hunt.

use std::f64::consts::TAU;

use crate::common::{link, sticky_arm};
use greybox_control::{
    ClosedLoop, ControlError, Controller, DesignOptions, Feedback, Integral, LoopOptions, Method, Metrics,
    ObserverMethod, OutputFeedback, OutputOptions, Plant, PlantOptions, Reference, Sensor, design,
};
use greybox_model::Model;
use greybox_simulate::rigs::RotaryFlexibleLink;

/// One count of an encoder of 4096 counts a turn, rad.
const COUNT: f64 = TAU / 4096.0;
const AT_REST: Integral = Integral::AtRest { time: None };
const KALMAN: ObserverMethod = ObserverMethod::Kalman { disturbance: 1.0 };

/// The regulator of the flexible link in its typical sizes.
fn regulator(model: &Model, angle: f64) -> Controller {
    let sizes = [("theta", 0.35), ("alpha", 0.1), ("theta'", 5.0), ("alpha'", 5.0)];
    let sizes = sizes.map(|(name, size)| (name.to_owned(), size)).to_vec();
    let options = PlantOptions { sizes, input_size: 5.0, ..PlantOptions::default() };
    let plant = Plant::of(model, "v", &options).unwrap();
    let wanted = DesignOptions { limit: Some(10.0), ..DesignOptions::new("theta", &[-angle, angle], 1e-3) };
    design(&plant, &Method::Lqr, &wanted).unwrap()
}

/// An extended-state observer four times as fast as the loop.
fn eso(law: &Controller) -> ObserverMethod {
    ObserverMethod::Eso {
        bandwidth: 4.0 * law.design_point().poles.iter().fold(0.0f64, |f, p| f.max(p.magnitude())),
    }
}

fn output(
    law: &Controller,
    method: ObserverMethod,
    integral: Integral,
) -> Result<OutputFeedback, ControlError> {
    let names = law.plant().state_names();
    let encoder = Sensor { noise: 0.0, resolution: COUNT };
    let sensors = names.iter().zip(law.plant().measured());
    let sensors =
        sensors.filter(|(_, measured)| **measured).map(|(name, _)| (name.clone(), encoder)).collect();
    OutputFeedback::new(law, &OutputOptions { method, sensors, integral })
}

/// What is reached at each step but the first, from the encoders alone.
fn reached(machine: &Model, law: &Controller, output: OutputFeedback, reference: &Reference) -> Vec<Metrics> {
    let options = LoopOptions { feedback: Feedback::Output(Box::new(output)), ..LoopOptions::default() };
    let run = ClosedLoop::new(machine, law, &options).unwrap().run(reference).unwrap();
    assert_eq!(run.diverged, None);
    run.metrics[1..].to_vec()
}

fn worst(metrics: &[Metrics], of: fn(&Metrics) -> f64) -> f64 {
    metrics.iter().map(of).fold(0.0, f64::max)
}

/// The thesis's link with its own friction, and with friction that turns the hub alone (as its reaction in α″).
fn links() -> [(&'static str, Model); 2] {
    let rig = RotaryFlexibleLink::IDENTIFIED;
    let mut hub_alone = link(1.0);
    let at = hub_alone.parameter("fl").unwrap();
    hub_alone.parameters[at].value = -rig.hub.coulomb / rig.hub.acceleration * rig.link.acceleration;
    [("thesis", link(1.0)), ("hub alone", hub_alone)]
}

/// The goal is two counts of the encoder, 0.176°, from the encoders alone.
#[test]
fn a_flexible_link_that_sticks_comes_to_rest_within_two_counts() {
    for (name, model) in links() {
        for degrees in [20f64, 15.0, 10.0, 5.0] {
            let angle = degrees.to_radians();
            let law = regulator(&model, angle);
            let reference = Reference::square(angle, 4.0, 5);
            for method in [KALMAN, eso(&law)] {
                let ends = |integral| {
                    let reached = reached(&model, &law, output(&law, method, integral).unwrap(), &reference);
                    let settling = worst(&reached, |m| m.settling.unwrap_or(f64::INFINITY));
                    let error = worst(&reached, |m| m.final_error.abs() / COUNT);
                    (settling, error, worst(&reached, |m| m.peak_to_peak / COUNT))
                };
                let (disturbance, rest) = (ends(Integral::Disturbance), ends(AT_REST));
                println!("{name} {degrees} {method:?}: {disturbance:.2?} {rest:.2?}");
                assert!(
                    rest.0 < 1.5 && rest.1 < 1.5 && rest.2 < 2.0,
                    "{name} {degrees} {method:?}: {rest:?}"
                );
                if name == "thesis" {
                    assert!(disturbance.2 > 12.0, "{name} {degrees} {method:?}: {disturbance:?}");
                }
            }
        }
    }
}

/// An arm with a load and with friction that its law does not know, also where friction at rest is twice that in motion.
#[test]
fn an_arm_that_sticks_comes_to_rest() {
    let sizes = vec![("theta".to_owned(), 0.2), ("theta'".to_owned(), 4.0)];
    let options = PlantOptions { sizes, input_size: 5.0, ..PlantOptions::default() };
    let plant = Plant::of(&sticky_arm(0.0, 0.0, 0.5), "v", &options).unwrap();
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[-1.0, 1.0], 2e-3)).unwrap();
    let reference = Reference::square(0.5, 5.0, 5);
    for method in [KALMAN, eso(&law)] {
        let ends = |friction: f64, excess: f64, integral| {
            let output = output(&law, method, integral).unwrap();
            let reached = reached(&sticky_arm(friction, excess, 0.6), &law, output, &reference);
            let error = worst(&reached, |m| m.final_error.abs() / COUNT);
            (error, worst(&reached, |m| m.peak_to_peak / COUNT))
        };
        let (off, rest) = (ends(0.05, 0.0, Integral::Off), ends(0.05, 0.0, AT_REST));
        // What it is not for: friction that breaks away, and no friction at all.
        let (breaks, free) = (ends(0.05, 1.0, AT_REST), ends(0.0, 0.0, AT_REST));
        println!("{method:?}: {off:.2?} {rest:.2?}, breaks away {breaks:.2?}, free {free:.2?}");
        assert!(off.0 > 2.5 && rest.0 < 2.0 && rest.1 < 0.1, "{method:?}: {off:?} {rest:?}");
        assert!(breaks.0 < 2.0 && breaks.1 < 12.0, "{method:?}: {breaks:?}");
        assert!((6.0..25.0).contains(&free.1), "{method:?}: {free:?}");
    }
}

/// Why the link hunts, and does so with the true state too: while friction holds the hub, the voltage acts on the deflection
/// by what friction leaves of it, and the law of the moving link is unstable there. Where friction turns the hub alone it is not.
#[test]
fn the_law_of_the_moving_link_is_unstable_where_the_hub_sticks() {
    for (name, model) in links() {
        let law = regulator(&model, 20f64.to_radians());
        let check = law.design_point();
        assert_eq!(check.stuck_poles.len(), 2, "{name}");
        // With the hub held: α″ = (a₃ⱼ − s a₁ⱼ) xⱼ + …, where s is the share of the friction of θ″ that α″ has.
        let plant = law.plant();
        let value = |name: &str| plant.parameters().iter().find(|(n, _)| n == name).unwrap().1;
        assert_eq!(plant.state_names(), ["theta", "theta'", "alpha", "alpha'"]);
        let tangent = plant.frictionless_tangent(&check.equilibrium.state, check.equilibrium.input);
        let share = (value("fl") / value("al")) / (value("fh") / value("ah"));
        let row = |j: usize| tangent.a[(3, j)] - share * tangent.a[(1, j)];
        let gain = tangent.b[3] - share * tangent.b[1];
        let (stiffness, damping) = (gain * law.gains()[2] - row(2), gain * law.gains()[3] - row(3));
        let by_hand = -0.5 * damping + (0.25 * damping * damping - stiffness).max(0.0).sqrt();
        let fastest = check.stuck_poles[0].re;
        println!("{name}: {fastest:.1} 1/s, open {:.0} {:.1}", -row(2), -row(3));
        assert!((fastest - by_hand).abs() < 1e-6 * by_hand.abs(), "{name}: {fastest} {by_hand}");
        // Open it is stable in both.
        assert!(row(2) < 0.0 && row(3) < 0.0);
        match name {
            "thesis" => assert!((20.0..35.0).contains(&fastest), "{fastest}"),
            _ => assert!(fastest < -5.0, "{fastest}"),
        }
    }
    // Nothing is held without friction.
    let frictionless = {
        let mut model = link(1.0);
        for name in ["fh", "fl"] {
            let at = model.parameter(name).unwrap();
            model.parameters[at].value = 0.0;
        }
        model
    };
    assert_eq!(regulator(&frictionless, 0.3).design_point().stuck_poles, []);
}

#[test]
fn a_time_to_rest_that_is_not_positive_is_refused() {
    let law = regulator(&link(1.0), 0.3);
    for time in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let made = output(&law, KALMAN, Integral::AtRest { time: Some(time) });
        assert!(matches!(made, Err(ControlError::Option { .. })), "{time}");
    }
    let made = output(&law, KALMAN, AT_REST).unwrap();
    let rest = made.rest().unwrap();
    let poles: Vec<f64> = law.design_point().poles.iter().map(|p| p.magnitude()).collect();
    let (slowest, fastest) = poles.iter().fold((f64::INFINITY, 0.0f64), |(s, f), p| (s.min(*p), f.max(*p)));
    assert_eq!((rest.step, rest.integral_time, rest.time), (COUNT, 1.0 / slowest, 0.25 / fastest));
    assert_eq!((rest.samples(), rest.measurement(), rest.rate()), (3, 0, Some(1)));
}
