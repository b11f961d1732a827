//! The rotary flexible link of the thesis, written in the model language.

use crate::common::link;
use greybox_control::{DesignOptions, Method, Plant, PlantOptions, Weights, design};
use greybox_hjb::Plant as _;
use greybox_simulate::rigs::RotaryFlexibleLink;

fn options() -> PlantOptions {
    let sizes = [("theta", 0.35), ("theta'", 3.0), ("alpha", 0.1), ("alpha'", 2.0)];
    PlantOptions {
        sizes: sizes.iter().map(|(n, s)| ((*n).to_owned(), *s)).collect(),
        input_size: 5.0,
        ..PlantOptions::default()
    }
}

/// (θ, α, θ̇, α̇) of the rig to (θ, θ̇, α, α̇) of the model.
fn ours(x: [f64; 4]) -> [f64; 4] {
    [x[0], x[2], x[1], x[3]]
}

#[test]
fn f_and_g_are_those_of_the_rig() {
    let plant = Plant::of(&link(1.0), "v", &options()).unwrap();
    assert_eq!(plant.state_names(), ["theta", "theta'", "alpha", "alpha'"]);
    let rig = RotaryFlexibleLink::IDENTIFIED;
    for k in 0..50 {
        let wave = |i: usize| ((7 * k + 3 * i) as f64 * 0.7).sin();
        let x = [0.6 * wave(0), 0.2 * wave(1), 5.0 * wave(2), 3.0 * wave(3)];
        let sign = (x[2] / (0.01 * 3.0)).tanh();
        let (mut f, mut g) = ([0.0; 4], [0.0; 4]);
        plant.drift(&ours(x), &mut f);
        plant.input(&ours(x), &mut g);
        let (exact_f, exact_g) = (ours(rig.drift(x, sign)), ours(rig.input()));
        for i in 0..4 {
            assert!(
                (f[i] - exact_f[i]).abs() <= 1e-12 * exact_f[i].abs().max(1.0),
                "{} {}",
                f[i],
                exact_f[i]
            );
            assert!(
                (g[i] - exact_g[i]).abs() <= 1e-12 * exact_g[i].abs().max(1.0),
                "{} {}",
                g[i],
                exact_g[i]
            );
        }
    }
    // The tangent at the origin and elsewhere, friction dropped.
    for at in [[0.0; 4], [0.3, -0.05, 1.0, 0.4]] {
        let tangent = plant.frictionless_tangent(&ours(at), 1.0);
        let exact = rig.linearised(at);
        let order = [0, 2, 1, 3];
        for i in 0..4 {
            for j in 0..4 {
                let wanted = exact[order[i]][order[j]];
                assert!((tangent.a[(i, j)] - wanted).abs() <= 1e-12 * wanted.abs().max(1.0), "{i} {j}");
            }
        }
    }
}

#[test]
fn the_regulator_has_the_gains_of_the_thesis() {
    let plant = Plant::of(&link(1.0), "v", &options()).unwrap();
    let mut wanted = DesignOptions::new("theta", &[0.0], 1e-3);
    wanted.weights = Some(Weights { states: ours([121.0, 1.0, 1.0, 5.0]).to_vec(), input: 1.0 });
    let law = design(&plant, &Method::Lqr, &wanted).unwrap();
    for (found, exact) in law.gains().iter().zip(ours([12.2224, -31.1157, 1.1325, -1.3939])) {
        assert!((found - exact).abs() < 5e-4, "{:?}", law.gains());
    }
}

fn methods() -> [Method; 3] {
    [
        Method::Lqr,
        Method::Hjb { degree: 4, domain: vec![0.75, 6.0, 0.25, 6.0], bounded: false },
        Method::Smc { lambda: 16.0, eta: 50.0, phi: 0.5 },
    ]
}

#[test]
fn every_method_tracks_a_square_without_steady_state_error() {
    use greybox_control::{ClosedLoop, LoopOptions, Reference};
    let model = link(0.0);
    let plant = Plant::of(&model, "v", &options()).unwrap();
    let angle = 20f64.to_radians();
    let mut wanted = DesignOptions::new("theta", &[-angle, angle], 1e-3);
    wanted.limit = Some(10.0);
    wanted.weights = Some(Weights { states: ours([121.0, 1.0, 1.0, 5.0]).to_vec(), input: 1.0 });
    for method in methods() {
        let law = design(&plant, &method, &wanted).unwrap();
        let run = ClosedLoop::new(&model, &law, &LoopOptions::default())
            .unwrap()
            .run(&Reference::square(angle, 3.0, 3))
            .unwrap();
        assert_eq!((run.diverged, run.metrics.len()), (None, 3));
        for m in &run.metrics {
            assert!(m.final_error.abs() < 1e-5, "{}: {m:?}", method.name());
            assert!(m.settling.is_some_and(|t| t < 2.0), "{}: {m:?}", method.name());
        }
    }
}

#[test]
fn the_sliding_mode_law_is_that_of_its_crate() {
    use greybox_smc::{BoundaryLayer, Design, Rate, Surface, Tangent, Target};
    let plant = Plant::of(&link(0.0), "v", &options()).unwrap();
    let angle = 0.3;
    let mut wanted = DesignOptions::new("theta", &[0.0, angle], 1e-3);
    wanted.limit = Some(10.0);
    let law = design(&plant, &Method::Smc { lambda: 16.0, eta: 50.0, phi: 0.5 }, &wanted).unwrap();
    let at = &law.design_point().equilibrium;
    let linear = plant.frictionless_tangent(&at.state, at.input);
    let a = std::array::from_fn(|i| std::array::from_fn(|j| linear.a[(i, j)]));
    let tangent = Tangent::<4>::new(a, std::array::from_fn(|i| linear.b[i]));
    let (surface, layer) = (Surface::repeated(16.0).unwrap(), BoundaryLayer::new(50.0, 0.5).unwrap());
    let there = Design::new(tangent, surface, layer, 1e-3).limited_to(10.0).rate(Rate::Model).law().unwrap();
    let target = Target::rest(law.checks()[1].equilibrium.state.clone().try_into().unwrap());
    for k in 0..40 {
        let wave = |i: usize| ((5 * k + 3 * i) as f64 * 0.9).sin();
        let x = [angle + 0.1 * wave(0), 1.0 * wave(1), 0.03 * wave(2), 0.5 * wave(3)];
        let (mut f, mut g) = ([0.0; 4], [0.0; 4]);
        plant.drift(&x, &mut f);
        plant.input(&x, &mut g);
        let wanted = there.step(&x, &f, &g, &target).unwrap().u;
        assert!((law.command(&x, angle) - wanted).abs() < 1e-5, "{} {wanted}", law.command(&x, angle));
    }
}

#[test]
fn a_compensation_of_friction_that_hunts_is_refused() {
    use greybox_control::ControlError;
    let plant = Plant::of(&link(1.0), "v", &options()).unwrap();
    let mut wanted = DesignOptions::new("theta", &[0.0], 1e-3);
    wanted.compensate_friction = true;
    let method = Method::Smc { lambda: 16.0, eta: 50.0, phi: 0.5 };
    let error = design(&plant, &method, &wanted).unwrap_err();
    assert!(matches!(error, ControlError::Unstable { pole, .. } if pole.re > 1.0), "{error}");
}

#[test]
fn the_law_prints_as_it_computes() {
    // What is exported is text of the model language: read again, it gives the command.
    let plant = Plant::of(&link(1.0), "v", &options()).unwrap();
    let angle = 20f64.to_radians();
    let mut wanted = DesignOptions::new("theta", &[-angle, angle], 1e-3);
    wanted.limit = Some(10.0);
    for method in methods() {
        let law = design(&plant, &method, &wanted).unwrap();
        let again = greybox_model::parse(&law.law()[0].to_string()).unwrap().expr;
        let x = [0.1, -0.3, 0.02, 0.4];
        let value = again.eval(&|name, primes| match (name, primes) {
            ("theta", p) => Some(x[usize::from(p)]),
            ("alpha", p) => Some(x[2 + usize::from(p)]),
            ("r", 0) => Some(0.2),
            _ => plant.parameters().iter().find(|(n, _)| n == name).map(|(_, v)| *v),
        });
        assert!((value.unwrap() - law.command(&x, 0.2)).abs() < 1e-12, "{}", method.name());
        assert_eq!(law.law().len(), 1);
    }
}

#[test]
fn with_true_friction_the_error_is_that_of_sticking() {
    use greybox_control::{ClosedLoop, LoopOptions, Reference};
    let model = link(1.0);
    let plant = Plant::of(&model, "v", &options()).unwrap();
    let angle = 20f64.to_radians();
    let mut wanted = DesignOptions::new("theta", &[-angle, angle], 1e-3);
    wanted.limit = Some(10.0);
    wanted.weights = Some(Weights { states: ours([121.0, 1.0, 1.0, 5.0]).to_vec(), input: 1.0 });
    for method in methods() {
        let law = design(&plant, &method, &wanted).unwrap();
        let looped = ClosedLoop::new(&model, &law, &LoopOptions::default()).unwrap();
        let run = looped.run(&Reference::square(angle, 2.0, 3)).unwrap();
        for m in &run.metrics {
            println!("{}: {:.3} deg, {:?} s", method.name(), m.final_error.to_degrees(), m.settling);
            // The hub sticks where the law asks for less than the friction: |K error| < f.
            assert!(m.final_error.abs() < 1.5 * 0.1474 / law.gains()[0], "{}: {m:?}", method.name());
        }
        assert_eq!(run.diverged, None);
    }
}
