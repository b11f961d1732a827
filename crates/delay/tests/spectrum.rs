//! Characteristic roots against closed forms, the flexible joint's reference and simulation.
use greybox_delay::spectrum::{DelaySystem, Root, SpectrumError};
use greybox_simulate::rigs::{RotaryFlexibleJoint, Sampling};

fn joint(plant: RotaryFlexibleJoint) -> DelaySystem {
    let [undelayed, delayed] = plant.linearised();
    DelaySystem::new(&undelayed, &delayed, plant.delay).expect("valid input")
}

fn near(root: Root, re: f64, im: f64, tolerance: f64) {
    assert!((root.re - re).abs() < tolerance && (root.im - im).abs() < tolerance, "{root:?} {re} {im}");
}

#[test]
fn flexible_joint_roots_are_the_reference() {
    let roots = joint(RotaryFlexibleJoint::LINEAR).roots(4).unwrap();
    near(roots[0], -0.628_708_777_461_740_1, 5.305_293_458_471_738, 1e-9);
    near(roots[1], -0.628_708_777_461_740_1, -5.305_293_458_471_738, 1e-9);
    near(roots[2], -4.771_700_750_095_052, 20.352_589_817_797_735, 1e-9);
    near(roots[3], -4.771_700_750_095_052, -20.352_589_817_797_735, 1e-9);
}

#[test]
fn flexible_joint_loses_stability_where_the_notes_say() {
    let system = joint(RotaryFlexibleJoint::LINEAR);
    let gain = RotaryFlexibleJoint::LINEAR.gain * system.critical_gain(0.5, 2.0, 6).unwrap().value;
    assert!((gain - 4.16).abs() < 0.02, "{gain}");
    let delay = system.critical_delay(0.1, 0.4, 6).unwrap();
    assert!(delay.value > 0.25 && delay.value < 0.30, "{delay:?}");
    // Simulation agrees on both sides of the limit.
    let last_swing = |delay: f64| {
        let plant = RotaryFlexibleJoint { delay, ..RotaryFlexibleJoint::LINEAR };
        let sampling = Sampling { dt: 0.001, substeps: 1 };
        let run = plant.run(sampling, [0.1, 0.0, 0.0, 0.0], 40_000, |_| 0.0).unwrap();
        run.states[35_000..].iter().fold(0.0, |m: f64, x| m.max(x[0].abs()))
    };
    assert!(last_swing(delay.value - 0.01) < 0.1);
    assert!(last_swing(delay.value + 0.01) > 0.1);
}

#[test]
fn scalar_equation_has_the_branches_of_lambert_w() {
    // λ = −e^(−λ): λ = W_k(−1), W_0(−1) = −0.318131505204764 + 1.337235701430689 i and so on.
    let roots = DelaySystem::new(&[[0.0]], &[[-1.0]], 1.0).unwrap().roots(8).unwrap();
    near(roots[0], -0.318_131_505_204_764, 1.337_235_701_430_689, 1e-12);
    near(roots[2], -2.062_277_729_598_284, 7.588_631_178_472_513, 1e-11);
    assert_eq!(roots.len(), 8);
    for r in &roots {
        let (re, im) = (-(-r.re).exp() * r.im.cos(), (-r.re).exp() * r.im.sin());
        assert!((re - r.re).abs() < 1e-9 && (im - r.im).abs() < 1e-9, "{r:?}");
    }
    // Roots stay sorted.
    assert!(roots.windows(2).all(|w| w[0].re >= w[1].re - 1e-9), "{roots:?}");
}

#[test]
fn two_delays_share_a_mesh() {
    // ẋ = −x(t−1) − x(t−0.35): every root must satisfy its equation, and the first agrees with a simulation-free
    // closed check by residual.
    let system = DelaySystem::new(&[[0.0]], &[[-1.0]], 1.0).unwrap().and(&[[-1.0]], 0.35).unwrap();
    for root in system.roots(6).unwrap() {
        let late = |delay: f64| {
            (
                -(-root.re * delay).exp() * (root.im * delay).cos(),
                (-root.re * delay).exp() * (root.im * delay).sin(),
            )
        };
        let ((a, b), (c, d)) = (late(1.0), late(0.35));
        assert!((a + c - root.re).abs() < 1e-10 && (b + d - root.im).abs() < 1e-10, "{root:?}");
    }
}

#[test]
fn without_delay_the_roots_are_eigenvalues() {
    let a0 = [[0.0, 1.0], [-2.0, -3.0]];
    let a1 = [[0.0, 0.0], [0.0, 1.0]];
    let roots = DelaySystem::new(&a0, &a1, 0.0).unwrap().roots(5).unwrap();
    assert_eq!(roots.len(), 2);
    near(roots[0], -1.0, 1.0, 1e-12);
    // A delay on a zero matrix changes nothing.
    let roots = DelaySystem::new(&a0, &[[0.0; 2]; 2], 0.7).unwrap().roots(5).unwrap();
    assert_eq!(roots.len(), 2);
    near(roots[0], -1.0, 0.0, 1e-12);
    near(roots[1], -2.0, 0.0, 1e-12);
}

#[test]
fn a_long_delay_takes_more_points() {
    // |λ|τ of about 30: the first mesh cannot resolve it.
    let a0 = [[0.0, 1.0], [-1.0, -0.1]];
    let a1 = [[0.0, 0.0], [0.05, 0.0]];
    let system = DelaySystem::new(&a0, &a1, 30.0).unwrap();
    let roots = system.roots(4).unwrap();
    assert!(roots.iter().all(|&r| system.residual(r) < 1e-12), "{roots:?}");
}

#[test]
fn extreme_systems_end_in_an_answer_or_an_error() {
    // Thousands of roots of nearly one real part: no mesh resolves them, and that is said.
    let system = DelaySystem::new(&[[-1000.0]], &[[1e-3]], 10.0).unwrap();
    assert!(matches!(system.rightmost(), Err(SpectrumError::Unresolved { points: 129, wanted: 1 })));
    // e^(−λτ) overflows at the eigenvalue of the undelayed part.
    assert_eq!(system.residual(Root { re: -1000.0, im: 0.0 }), f64::INFINITY);
    for scale in [1e-300, 1e-30, 1e30, 1e150, 1e300] {
        let system = DelaySystem::new(&[[-scale, scale], [0.0, -scale]], &[[scale, 0.0], [scale, 0.0]], 1.0);
        if let Ok(roots) = system.unwrap().roots(2) {
            assert!(roots.iter().all(|r| r.re.is_finite() && r.im.is_finite()), "{scale} {roots:?}");
        }
    }
}

#[test]
fn bad_input_is_refused() {
    let square = [[0.0, 1.0], [1.0, 0.0]];
    let empty: [[f64; 1]; 0] = [];
    assert!(matches!(DelaySystem::new(&empty, &empty, 1.0), Err(SpectrumError::Shape { .. })));
    assert!(matches!(DelaySystem::new(&square, &square[..1], 1.0), Err(SpectrumError::Shape { .. })));
    let ragged = [vec![0.0, 1.0], vec![1.0]];
    assert!(matches!(DelaySystem::new(&ragged, &ragged, 1.0), Err(SpectrumError::Shape { .. })));
    let nan = [[f64::NAN]];
    assert!(matches!(DelaySystem::new(&nan, &nan, 1.0), Err(SpectrumError::Entry { .. })));
    assert!(matches!(DelaySystem::new(&[[0.0]], &[[1.0]], -1.0), Err(SpectrumError::Delay { .. })));
    let system = DelaySystem::new(&[[-1.0]], &[[0.1]], 1.0).unwrap();
    assert!(matches!(system.critical_delay(0.5, 0.4, 3), Err(SpectrumError::Range { .. })));
    let error = system.critical_delay(0.1, 2.0, 3).unwrap_err();
    assert!(error.to_string().contains("is stable over the whole range"), "{error}");
}
