//! What the checks let through, and what they refuse in which words.

use greybox_smc::check::ClosedLoop;
use greybox_smc::thesis::{LinkTangent, PrintedLaw};
use greybox_smc::{
    BoundaryLayer, Design, Equilibrium, EquilibriumSolver, Fault, FlatOutput, Law, Rate, SmcError, Surface,
    Tangent, Target,
};

/// Two carts of 1 kg on a spring of 100 N/m with little damping, the first one pushed; x = (x₁, x₂, ẋ₁, ẋ₂).
const CARTS: Tangent<4> = Tangent::new(
    [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-100.0, 100.0, -0.3, 0.3], [100.0, -100.0, 0.3, -0.3]],
    [0.0, 0.0, 1.0, 0.0],
);

fn design(tangent: Tangent<4>) -> Design<4> {
    Design::new(tangent, Surface::repeated(6.0).unwrap(), BoundaryLayer::new(400.0, 10.0).unwrap(), 1e-3)
}

/// The error, which must say what to change.
fn refused<T: std::fmt::Debug, E: std::fmt::Display>(result: Result<T, E>, help: &str) -> E {
    let error = result.unwrap_err();
    assert!(error.to_string().contains(help), "`{error}` does not say `{help}`");
    error
}

#[test]
fn a_sound_design_passes_and_keeps_its_numbers() {
    let law = design(CARTS).limited_to(80.0).rate(Rate::Model).input_gain(-2.0).law().unwrap();
    assert_eq!((law.limit(), law.rate(), law.flat().input_gain()), (80.0, Rate::Model, -2.0));
    assert_eq!((law.layer().eta(), law.layer().phi(), law.layer().rate()), (400.0, 10.0, 40.0));
    assert_eq!(law.surface().coefficients(), [216.0, 108.0, 18.0, 1.0]);
    assert_eq!(law.switching_input(), 200.0);
}

#[test]
fn bad_numbers_are_refused_with_the_help() {
    let mut broken = CARTS;
    broken.a[2][1] = f64::NAN;
    let error = refused(design(broken).law(), "look where they come from");
    assert!(matches!(error, SmcError::NotFinite { .. }));
    let error = refused(design(CARTS).plant(broken).law(), "the tangent of the plant");
    assert!(matches!(error, SmcError::NotFinite { .. }));
    let error = refused(design(CARTS).model(broken).plant(CARTS).law(), "the tangent of the model");
    assert!(matches!(error, SmcError::NotFinite { .. }));
    for lambda in [0.0, -1.0, f64::NAN] {
        let error = refused(Surface::<4>::repeated(lambda), "must be positive");
        assert!(matches!(error, SmcError::SurfacePole { .. }));
    }
    let error = refused(Surface::new([6.0, 1.0, 1.0, 1.0]), "row 3 of Routh's array starts with -5");
    assert_eq!(error, SmcError::SurfaceNotHurwitz { row: 3, value: -5.0 });
    refused(Surface::new([6.0, 1.0, 1.0, 1.0]), "Surface::repeated");
    refused(Surface::new([1.0, 0.0]), "the last one 1");
    for bad in [0.0, -5.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(refused(BoundaryLayer::new(bad, 1.0), "positive"), SmcError::ReachingRate { .. }));
        assert!(matches!(refused(BoundaryLayer::new(1.0, bad), "positive"), SmcError::LayerWidth { .. }));
        let error = refused(design(CARTS).input_gain(bad * 0.0).law(), "1 gives the surface");
        assert!(matches!(error, SmcError::InputGain { .. }));
    }
    for limit in [0.0, -1.0, f64::NAN] {
        let error = refused(design(CARTS).limited_to(limit).law(), "or infinity for none");
        assert!(matches!(error, SmcError::InputLimit { .. }));
    }
    for dt in [0.0, -1e-3, f64::NAN, f64::INFINITY] {
        let (surface, layer) = (Surface::repeated(6.0).unwrap(), BoundaryLayer::new(40.0, 1.0).unwrap());
        let error = refused(Design::new(CARTS, surface, layer, dt).law(), "positive and finite");
        assert!(matches!(error, SmcError::SampleTime { .. }), "{dt}: {error:?}");
    }
}

#[test]
fn what_cannot_be_controlled_is_refused() {
    // A third cart that touches nothing.
    let mut apart = CARTS;
    apart.a[3] = [0.0, 0.0, 0.0, -0.1];
    let error = refused(design(apart).law(), "leave the state out");
    assert_eq!(error, SmcError::Unreached { state: 1 });
    // Two equal pendulums, driven alike: their difference cannot be moved.
    let twins = Tangent::new(
        [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-9.0, 0.0, 0.0, 0.0], [0.0, -9.0, 0.0, 0.0]],
        [0.0, 0.0, 1.0, 1.0],
    );
    let error = refused(design(twins).law(), "leave out states that move together");
    assert!(
        matches!(error, SmcError::NotControllable { reciprocal_condition } if reciprocal_condition < 1e-12)
    );
    // Lengths that differ a little make it possible, on paper: the law would need enormous gains.
    let mut nearly = twins;
    nearly.a[3][1] = -9.0 * (1.0 + 1e-3);
    let flat = FlatOutput::new(&nearly).unwrap();
    assert!(flat.reciprocal_condition() < 1e-3, "{}", flat.reciprocal_condition());
}

#[test]
fn the_layer_must_outlast_a_sample() {
    let surface = Surface::repeated(6.0).unwrap();
    let at = |rate: f64, dt: f64| Design::new(CARTS, surface, BoundaryLayer::new(rate, 1.0).unwrap(), dt);
    let error = refused(at(100.0, 0.02).law(), "sample faster than every 2.000e-2 s");
    assert_eq!(error, SmcError::LayerTooThin { rate: 100.0, dt: 0.02 });
    // Below that bound the exact test of the held loop still refuses, and names a sample time that does.
    let error = refused(at(100.0, 0.0199).law(), "or faster, or lower lambda or eta/phi");
    let SmcError::UnstableSampled { longest, spectral_radius, .. } = error else { panic!("{error:?}") };
    assert!(spectral_radius >= 1.0 && longest > 1e-3 && longest < 0.0199, "{error:?}");
    assert!(at(100.0, longest).law().is_ok());
    assert!(at(100.0, 1.05 * longest).law().is_err());
}

/// Within half a unit of the last digit that is given.
fn has_poles(closed: &ClosedLoop<4>, expected: [(f64, f64, f64); 4]) {
    let poles = closed.poles().unwrap();
    for (pole, (re, im, digit)) in poles.iter().zip(expected) {
        assert!((pole.re - re).abs() <= 0.51 * digit && (pole.im - im).abs() <= 0.51 * digit, "{poles:?}");
    }
}

#[test]
fn a_law_for_another_plant_is_refused_with_its_pole() {
    // The flat output of the link without stiffness and damping of the hub, on the whole identified link.
    let rig = greybox_simulate::rigs::RotaryFlexibleLink::IDENTIFIED;
    let link = LinkTangent::IDENTIFIED.tangent();
    let whole = Tangent::new(rig.linearised([0.0; 4]), link.b);
    let layer = BoundaryLayer::new(5e4, 500.0).unwrap();
    let flat = FlatOutput::new(&link).unwrap().with_input_gain(link.b[3]).unwrap();
    let closed = |lambda: f64| {
        let law = Law::new(flat, Surface::repeated(lambda).unwrap(), layer, 10.0, Rate::Chain).unwrap();
        ClosedLoop::new(whole, law.gains(&whole).unwrap()).unwrap()
    };
    // The figures of an independent program, for f_α itself in the law …
    has_poles(&closed(16.0), [(-4.2, 0.0, 0.1), (-23.3, 15.4, 0.1), (-23.3, -15.4, 0.1), (-101.0, 0.0, 1.0)]);
    closed(16.0).check(5e-4).unwrap();
    let SmcError::Unstable { pole } = refused(closed(4.0).check(5e-4), "a pole at +1.248 1/s") else {
        panic!()
    };
    assert!((pole.re - 1.25).abs() < 0.005 && pole.im == 0.0, "{pole}");
    // … and for α/C_α + (B_α/B_θ) f_θ in its place, as the thesis has it.
    let printed = |lambda: f64| {
        let law = PrintedLaw::new(LinkTangent::IDENTIFIED, lambda, 5e4, 500.0, 10.0).unwrap();
        ClosedLoop::new(whole, law.gains(&whole).unwrap()).unwrap()
    };
    has_poles(
        &printed(16.0),
        [(-4.57, 0.0, 0.01), (-23.5, 14.0, 0.1), (-23.5, -14.0, 0.1), (-100.2, 0.0, 0.1)],
    );
    refused(printed(4.0).check(5e-4), "a pole at +0.572");

    let design = |tangent, lambda: f64| {
        let surface = Surface::repeated(lambda).unwrap();
        Design::new(tangent, surface, layer, 5e-4).input_gain(link.b[3]).plant(whole).law()
    };
    let error = refused(design(link, 4.0), "raise lambda");
    refused(design(link, 4.0), "take the flat output from the tangent of the plant itself");
    assert!(matches!(error, SmcError::Unstable { .. }));
    design(link, 16.0).unwrap();
    design(whole, 4.0).unwrap();
}

#[test]
fn a_model_whose_input_points_elsewhere_is_refused() {
    let mut reversed = CARTS;
    reversed.b[2] = -1.0;
    let error = refused(design(CARTS).model(CARTS).plant(reversed).law(), "is not the plant's");
    assert!(matches!(error, SmcError::Unstable { .. }));
    let mut idle = CARTS;
    idle.b = [0.0, 0.0, 1e-6, 0.0];
    let error = refused(design(CARTS).model(idle).plant(CARTS).law(), "near the one of the model");
    assert!(matches!(error, SmcError::NoAuthority { .. }));
}

#[test]
fn a_fault_of_a_step_says_what_to_do() {
    let law = design(CARTS).law().unwrap();
    let (x, g, target) = ([0.0; 4], CARTS.b, Target::rest([1.0, 1.0, 0.0, 0.0]));
    let fault = refused(law.step(&[f64::NAN; 4], &[0.0; 4], &g, &target), "hold the last command");
    assert_eq!(fault, Fault::NotFinite);
    let fault = refused(law.step(&x, &[0.0; 4], &[0.0; 4], &target), "nearer to the point of the design");
    assert_eq!(fault, Fault::Authority { share: 0.0 });
}

#[test]
fn equilibria_that_do_not_exist_are_refused_with_the_help() {
    let pendulum = |x: &[f64; 2], u: f64| [x[1], u.tanh() - 3.0 * x[0].sin()];
    let solver = EquilibriumSolver::new(0).unwrap();
    solver.solve(pendulum, 0.3, &Equilibrium::ORIGIN).unwrap();
    let error = solver.solve(pendulum, 1.0, &Equilibrium::ORIGIN).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("within the reach of the plant") || text.contains("farther from"), "{text}");
    refused(EquilibriumSolver::<2>::new(7), "counted from 0");
    refused(solver.with_sizes([1.0, -1.0], 1.0), "must be positive");
}

#[test]
fn a_law_by_hand_is_that_of_the_design() {
    let flat = FlatOutput::new(&CARTS).unwrap();
    let (surface, layer) = (Surface::repeated(6.0).unwrap(), BoundaryLayer::new(400.0, 10.0).unwrap());
    let by_hand = Law::new(flat, surface, layer, 80.0, Rate::Chain).unwrap();
    assert_eq!(design(CARTS).limited_to(80.0).law(), Ok(by_hand));
}
