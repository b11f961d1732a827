//! The virtual rigs against the thesis, an independent reference and themselves at other step sizes.
use greybox_simulate::rigs::{
    DelayedDuffing, Duffing, ENCODER_4096, LinkRun, ProportionalController, RigError, RotaryFlexibleJoint,
    RotaryFlexibleLink, Sampling, Sine, multisine, quantise, square_wave,
};

#[path = "../examples/make_demo.rs"]
mod make_demo;

const AMPLITUDE: f64 = 30.0 * std::f64::consts::PI / 180.0;

/// Eigenvalues with nonnegative imaginary part, by real part.
fn poles(rig: &RotaryFlexibleLink) -> Vec<(f64, f64)> {
    let a = rig.linearised([0.0; 4]);
    let a = nalgebra::Matrix4::from_fn(|i, j| a[i][j]);
    let mut poles: Vec<(f64, f64)> =
        a.complex_eigenvalues().iter().filter(|p| p.im > -1e-9).map(|p| (p.re, p.im)).collect();
    poles.sort_by(|a, b| a.0.total_cmp(&b.0));
    poles
}

fn square_response(rig: &RotaryFlexibleLink, sampling: Sampling, seconds: f64) -> LinkRun {
    let samples = (seconds / sampling.dt).round() as usize + 1;
    rig.run(sampling, [0.0; 4], samples, |k, [theta, _]| {
        let reference = square_wave(AMPLITUDE, 0.66, k as f64 * sampling.dt);
        ProportionalController::THESIS.command(reference, theta, 0.0)
    })
    .expect("a loop inside the valid range")
}

fn largest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(0.0, |m, x| m.max(x.abs()))
}

fn assert_poles(found: &[(f64, f64)], expected: &[(f64, f64)], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{found:?}");
    for (f, e) in found.iter().zip(expected) {
        assert!((f.0 - e.0).abs() < tolerance && (f.1 - e.1).abs() < tolerance, "{found:?} {expected:?}");
    }
}

#[test]
fn open_loop_poles_of_both_columns_of_table_2_3() {
    assert_poles(&poles(&RotaryFlexibleLink::IDENTIFIED), &[(-25.6, 0.0), (-8.22, 28.1), (-0.19, 0.0)], 0.06);
    assert_poles(&poles(&RotaryFlexibleLink::QUANSER), &[(-30.1, 0.0), (-7.53, 21.4), (0.0, 0.0)], 0.06);
}

#[test]
fn linearisation_is_the_slope_of_the_motion() {
    // A short free step from a state and from its neighbours: (x(h) - x(0))/h differentiates to A.
    let rig = RotaryFlexibleLink {
        hub: greybox_simulate::rigs::VoltageBalance { coulomb: 0.0, ..RotaryFlexibleLink::IDENTIFIED.hub },
        link: greybox_simulate::rigs::VoltageBalance { coulomb: 0.0, ..RotaryFlexibleLink::IDENTIFIED.link },
        ..RotaryFlexibleLink::IDENTIFIED
    };
    let (h, e, at) = (1e-6, 1e-5, [0.2, -0.1, 1.5, 0.7]);
    let rate = |x: [f64; 4]| {
        let run = rig.run(Sampling { dt: h, substeps: 1 }, x, 2, |_, _| 0.3).unwrap();
        let end = run.states[1];
        std::array::from_fn::<f64, 4, _>(|i| (end[i] - x[i]) / h)
    };
    let a = rig.linearised(at);
    for j in 0..4 {
        let (mut up, mut down) = (at, at);
        up[j] += e;
        down[j] -= e;
        let (up, down) = (rate(up), rate(down));
        for i in 0..4 {
            let slope = (up[i] - down[i]) / (2.0 * e);
            assert!((slope - a[i][j]).abs() < 1e-3 * (1.0 + a[i][j].abs()), "{i} {j} {slope} {}", a[i][j]);
        }
    }
}

#[test]
fn position_loop_on_the_square_of_figure_2_7() {
    let run = square_response(&RotaryFlexibleLink::IDENTIFIED, Sampling { dt: 0.001, substeps: 4 }, 20.0);
    let theta = largest(run.states.iter().map(|x| x[0])).to_degrees();
    let alpha = largest(run.states.iter().map(|x| x[1])).to_degrees();
    let volts = largest(run.voltages.iter().copied());
    assert!((theta - 28.1).abs() < 0.1, "{theta}");
    assert!((alpha - 10.5).abs() < 0.1, "{alpha}");
    assert!((volts - 3.2).abs() < 0.1, "{volts}");
}

#[test]
fn agrees_with_an_independent_simulation() {
    // NumPy, RK4, loop held at 1 ms. It smooths the sign to tanh(theta'/0.01), hence the wider bound there.
    let sampling = Sampling { dt: 0.001, substeps: 4 };
    let at = |run: &LinkRun, t: f64| run.states[(t / sampling.dt).round() as usize];
    let quanser = square_response(&RotaryFlexibleLink::QUANSER, sampling, 5.0);
    let identified = square_response(&RotaryFlexibleLink::IDENTIFIED, sampling, 5.0);
    let t = [0.5, 1.0, 2.0, 5.0];
    let quanser_theta = [
        0.492_329_566_019_460_9,
        -0.080_432_025_518_365_34,
        0.453_927_769_019_177_8,
        0.438_287_043_114_735_2,
    ];
    let quanser_alpha = [
        0.004_246_261_888_498_99,
        -0.080_664_117_247_360_08,
        0.008_497_757_256_227_726,
        0.008_478_045_672_389_922,
    ];
    let identified_theta = [
        0.451_154_809_688_404_3,
        -0.211_145_136_680_241_6,
        0.439_382_887_137_385_94,
        0.429_269_994_761_676_04,
    ];
    let identified_alpha = [
        0.009_266_057_438_938_8,
        -0.080_532_221_492_103_61,
        0.011_760_318_744_267_771,
        0.013_439_829_777_419_041,
    ];
    for i in 0..4 {
        let (q, r) = (at(&quanser, t[i]), at(&identified, t[i]));
        assert!((q[0] - quanser_theta[i]).abs() < 1e-10 && (q[1] - quanser_alpha[i]).abs() < 1e-10, "{q:?}");
        assert!((r[0] - identified_theta[i]).abs() < 5e-6, "{r:?}");
        assert!((r[1] - identified_alpha[i]).abs() < 5e-6, "{r:?}");
    }
}

#[test]
fn a_hub_within_coulomb_friction_stays_and_breaks_loose_above_it() {
    let rig = RotaryFlexibleLink::IDENTIFIED;
    let sampling = Sampling { dt: 0.002, substeps: 4 };
    let still = rig.run(sampling, [0.0; 4], 10_000, |_, _| 0.02).unwrap();
    assert!(still.states.iter().all(|x| x[0] == 0.0 && x[2] == 0.0));
    // At rest the first balance gives the friction and the second must hold with the same.
    let [_, alpha, _, alpha_dot] = still.states[9_999];
    let sign = (0.02 + 6.3840 * alpha - 5.8953 * alpha * alpha) / 0.1151;
    let link = -13.1712 * alpha + 6.2922 * alpha * alpha + 0.1474 * sign;
    assert!(alpha.abs() > 1e-4 && alpha_dot.abs() < 1e-9 && (link - 0.02).abs() < 1e-9, "{alpha} {link}");
    let moves = rig.run(sampling, [0.0; 4], 500, |_, _| 0.13).unwrap();
    assert!(moves.states[499][0] > 1e-3);
}

#[test]
fn a_moving_hub_comes_to_rest_for_good() {
    let run = RotaryFlexibleLink::IDENTIFIED
        .run(Sampling { dt: 0.002, substeps: 4 }, [0.0, 0.0, 0.05, 0.0], 1000, |_, _| 0.0)
        .unwrap();
    let stop = run.states.iter().position(|x| x[2] == 0.0).expect("stops");
    let end = run.states[999];
    assert!(stop < 200, "{stop}");
    assert!(run.states[stop..].iter().all(|x| x[2] == 0.0 && x[0] == end[0]));
}

/// Error at the end of the record against the finest of the step sizes.
fn convergence(errors: &[f64]) -> Vec<f64> {
    errors.windows(2).map(|e| (e[0] / e[1]).log2()).collect()
}

#[test]
fn friction_events_keep_the_order_of_the_integrator() {
    // One command sequence, held at 4 ms; it stops and reverses the hub often.
    let rig = RotaryFlexibleLink::IDENTIFIED;
    let volts = |k: usize| 0.9 * (0.05 * k as f64).sin() + 0.25 * (0.31 * k as f64).sin();
    let end = |substeps| {
        let run = rig.run(Sampling { dt: 0.004, substeps }, [0.0; 4], 1000, |k, _| volts(k)).unwrap();
        let reversals = run.states.windows(2).filter(|x| x[0][2] * x[1][2] <= 0.0).count();
        assert!(reversals > 10, "{reversals}");
        run.states
    };
    let fine = end(64);
    let errors: Vec<f64> =
        [1, 2, 4, 8].map(|n| largest(end(n).iter().zip(&fine).map(|(a, b)| a[0] - b[0]))).to_vec();
    let orders = convergence(&errors);
    assert!(errors[2] < 1e-8, "{errors:?}");
    assert!(orders[..2].iter().all(|&p| p > 3.0), "{errors:?} {orders:?}");
}

#[test]
fn a_held_command_is_held() {
    // Two samples of 1 ms under one voltage are one sample of 2 ms.
    let rig = RotaryFlexibleLink::IDENTIFIED;
    let fine = rig.run(Sampling { dt: 0.001, substeps: 4 }, [0.0; 4], 401, |k, _| {
        if (k / 2) % 2 == 0 { 1.0 } else { -0.5 }
    });
    let coarse = rig
        .run(Sampling { dt: 0.002, substeps: 8 }, [0.0; 4], 201, |k, _| if k % 2 == 0 { 1.0 } else { -0.5 });
    let (fine, coarse) = (fine.unwrap(), coarse.unwrap());
    assert!(largest((0..4).map(|i| fine.states[400][i] - coarse.states[200][i])) < 1e-12);
}

#[test]
fn a_rig_driven_out_of_its_range_says_so() {
    let rig = RotaryFlexibleLink::IDENTIFIED;
    let sampling = Sampling { dt: 0.002, substeps: 4 };
    let error = rig.run(sampling, [0.0; 4], 5000, |_, _| 5.0).unwrap_err();
    assert!(matches!(error, RigError::OutOfRange { coordinate: "hub angle", .. }), "{error}");
    let error = rig.run(sampling, [0.0; 4], 9, |_, _| f64::NAN).unwrap_err();
    assert!(matches!(error, RigError::Command { time: 0.0, .. }), "{error}");
    for (dt, substeps) in [(0.0, 1), (-1.0, 1), (f64::NAN, 1), (f64::INFINITY, 1), (0.1, 0)] {
        let error = rig.run(Sampling { dt, substeps }, [0.0; 4], 9, |_, _| 0.0).unwrap_err();
        assert!(matches!(error, RigError::Sampling { .. }), "{error}");
    }
    let softening = Duffing { k3: -10.0, ..Duffing::THESIS };
    let error = softening.run(Sampling { dt: 0.1, substeps: 1 }, [9.0, 9.0], 999, |_| 0.0).unwrap_err();
    assert!(matches!(error, RigError::OutOfRange { coordinate: "displacement", .. }), "{error}");
}

#[test]
fn duffing_agrees_with_an_independent_simulation() {
    let states = Duffing::THESIS
        .run(Sampling { dt: 0.001, substeps: 1 }, [1.0, 0.0], 5001, Duffing::thesis_force)
        .unwrap();
    let expected = [
        (1000, 2.550_935_075_077_822, -1.228_130_128_439_885),
        (2000, 1.231_293_656_997_154_2, 3.160_320_384_476_708),
        (5000, -0.808_862_844_940_266_7, 0.473_097_235_679_966_25),
    ];
    for (k, x, v) in expected {
        assert!((states[k][0] - x).abs() < 1e-9 && (states[k][1] - v).abs() < 1e-9, "{k} {:?}", states[k]);
    }
}

#[test]
fn duffing_without_damping_and_force_keeps_its_energy() {
    let free = Duffing { c1: 0.0, c2: 0.0, c3: 0.0, k3: 3.0, ..Duffing::THESIS };
    let drift = |substeps| {
        let states = free.run(Sampling { dt: 0.1, substeps }, [1.5, 0.0], 200, |_| 0.0).unwrap();
        let e = free.energy(states[0]);
        largest(states.iter().map(|&x| free.energy(x) / e - 1.0))
    };
    let drifts: Vec<f64> = [2, 4, 8].map(drift).to_vec();
    // Runge-Kutta loses energy at the fifth order of the step.
    assert!(drifts[2] < 1e-6, "{drifts:?}");
    assert!(convergence(&drifts).iter().all(|&p| p > 3.9), "{drifts:?}");
}

#[test]
fn duffing_energy_balance_counts_force_and_damping() {
    let (d, dt) = (Duffing::THESIS, 0.001);
    let states = d.run(Sampling { dt, substeps: 1 }, [1.0, 0.0], 4001, Duffing::thesis_force).unwrap();
    let power = |k: usize| {
        let [x, v] = states[k];
        Duffing::thesis_force(k as f64 * dt) * v - v * v * (d.c1 + d.c2 * x * x + d.c3 * v * v)
    };
    // Simpson's rule over the record.
    let work: f64 =
        (0..4000).step_by(2).map(|k| dt / 3.0 * (power(k) + 4.0 * power(k + 1) + power(k + 2))).sum();
    let gained = d.energy(states[4000]) - d.energy(states[0]);
    assert!((work - gained).abs() < 1e-6 * gained.abs().max(1.0), "{work} {gained}");
}

#[test]
fn signals() {
    assert_eq!(quantise(2.4 * ENCODER_4096, ENCODER_4096), 2.0 * ENCODER_4096);
    assert_eq!(quantise(0.123, 0.0), 0.123);
    assert_eq!([0.0, 0.24, 0.26, 0.49, 0.51].map(|t| square_wave(2.0, 2.0, t)), [2.0, 2.0, -2.0, -2.0, 2.0]);
    let sine = Sine { amplitude: 3.0, frequency: 0.5, phase: 0.0 };
    assert!((multisine(&[sine, sine], 0.5) - 6.0).abs() < 1e-12);
    let limited = ProportionalController { limit: 1.0, ..ProportionalController::THESIS };
    assert_eq!(limited.command(1.0, 0.0, 0.0), 1.0);
    assert!((limited.command(0.1, 0.2, 0.5) - (0.5 - 0.1 * 10_f64.sqrt())).abs() < 1e-15);
}

#[test]
fn demo_files_are_what_the_generator_makes() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../cli/demo");
    let mut bytes = 0;
    for (name, made) in make_demo::demo(make_demo::SEED).unwrap() {
        let kept = std::fs::read(folder.join(name)).unwrap();
        assert!(made == kept, "{name} differs: cargo run --release -p greybox-simulate --example make_demo");
        bytes += made.len();
    }
    assert!(bytes < 700_000, "{bytes}");
}

#[test]
fn demo_model_is_the_linear_model_of_the_maker() {
    // Solving hub and link for the accelerations must give the "Quanser" column of Table 2.3.
    let text = include_str!("../../cli/demo/rotary_link.toml");
    let model = greybox_model::Model::from_toml(text, "rotary_link.toml").unwrap();
    let p = |name: &str| model.parameters.iter().find(|p| p.name == name).expect(name).value;
    let torque = p("eta") * p("Kg") * p("kt") / p("Rm");
    let quanser = RotaryFlexibleLink::QUANSER;
    let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 3e-3, "{a} {b}");
    near(p("Jeq") / torque, quanser.hub.acceleration);
    near(p("Beq") / torque + p("Kg") * p("km"), quanser.hub.rate);
    near(-p("ks") / torque, quanser.hub.deflection);
    near(-p("ks") / torque * (p("Jl") + p("Jeq")) / p("Jl"), quanser.link.deflection);
}

#[test]
fn delayed_duffing_agrees_with_an_independent_simulation() {
    let run = |substeps| {
        DelayedDuffing::THESIS
            .run(
                Sampling { dt: 0.001, substeps },
                DelayedDuffing::TRAINING_START,
                5001,
                DelayedDuffing::training_force,
            )
            .unwrap()
    };
    let (coarse, fine) = (run(1), run(4));
    // NumPy, RK4 with a Hermite midpoint.
    let expected = [
        (1000, 1.927_410_413_435_836_5, -3.257_522_433_816_412),
        (2000, 0.969_669_719_873_208_3, 2.159_003_278_288_193),
        (5000, -0.236_992_334_469_873, 0.125_643_563_467_443),
    ];
    for (k, x, v) in expected {
        assert!((coarse[k][0] - x).abs() < 1e-9 && (coarse[k][1] - v).abs() < 1e-9, "{k} {:?}", coarse[k]);
        assert!((fine[k][0] - x).abs() < 1e-8 && (fine[k][1] - v).abs() < 1e-8, "{k} {:?}", fine[k]);
    }
}

#[test]
fn delayed_feedback_keeps_the_order_of_the_integrator() {
    // A delay that is no multiple of the step: every history value is interpolated.
    let plant = DelayedDuffing { delay: 0.2137, ..DelayedDuffing::THESIS };
    let end = |substeps| {
        let sampling = Sampling { dt: 0.02, substeps };
        plant.run(sampling, [1.0, 0.0], 101, DelayedDuffing::training_force).unwrap()[100][0]
    };
    let exact = end(256);
    let errors: Vec<f64> = [4, 8, 16].map(|n| (end(n) - exact).abs()).to_vec();
    assert!(convergence(&errors).iter().all(|&p| p > 3.5), "{errors:?}");
}

#[test]
fn without_delay_the_feedback_is_a_negative_spring() {
    let late = DelayedDuffing { delay: 0.0, ..DelayedDuffing::THESIS };
    let plain = Duffing { m: 1.0, k1: 4.0, k3: 2.0, c1: 1.0, c2: 1.0, c3: 1.0 };
    let sampling = Sampling { dt: 0.01, substeps: 2 };
    let a = late.run(sampling, [1.0, 0.0], 300, DelayedDuffing::test_force).unwrap();
    let b = plain.run(sampling, [1.0, 0.0], 300, DelayedDuffing::test_force).unwrap();
    assert!(largest(a.iter().zip(&b).map(|(a, b)| a[0] - b[0])) < 1e-12);
}

fn sine(t: f64) -> f64 {
    multisine(&[Sine { amplitude: 2.0, frequency: 0.66, phase: 0.0 }], t)
}

#[test]
fn flexible_joint_agrees_with_an_independent_simulation() {
    let run =
        RotaryFlexibleJoint::LINEAR.run(Sampling { dt: 0.001, substeps: 1 }, [0.0; 4], 20_001, sine).unwrap();
    let expected = [
        (1000, -1.196_945_704_822_101_3, -0.007_675_481_167_542_115),
        (5000, 4.484_102_248_429_411, 0.230_778_034_388_722_96),
        (20000, 3.824_366_866_287_694, 0.202_416_930_173_430_63),
    ];
    for (k, theta, alpha) in expected {
        let x = run.states[k];
        assert!((x[0] - theta).abs() < 1e-7 && (x[1] - alpha).abs() < 1e-8, "{k} {x:?}");
    }
    // The largest excursions after 5 s; the first swings go further (notes: 4.6 to 5.3 rad).
    let settled = &run.states[5000..];
    assert!((largest(settled.iter().map(|x| x[0])) - 4.642_030_400_314_191).abs() < 1e-8);
    assert!((largest(settled.iter().map(|x| x[1])) - 0.246_692_267_580_074_18).abs() < 1e-8);
    assert!((largest(run.states.iter().map(|x| x[0])) - 5.3).abs() < 0.01);
}

#[test]
fn flexible_joint_linearisation_is_its_motion() {
    // One short step from a state with a known past: (x(h) - x(0))/h against A0 x + A1 x(-tau).
    let plant = RotaryFlexibleJoint { link_damping: 0.003, ..RotaryFlexibleJoint::LINEAR };
    let start = [0.3, 0.1, -0.2, 0.4];
    let h = 1e-7;
    let run = plant.run(Sampling { dt: h, substeps: 1 }, start, 2, |_| 0.0).unwrap();
    let [a0, a1] = plant.linearised();
    for i in 0..4 {
        let slope = (run.states[1][i] - start[i]) / h;
        let expected: f64 = (0..4).map(|j| (a0[i][j] + a1[i][j]) * start[j]).sum();
        assert!((slope - expected).abs() < 1e-3 * (1.0 + expected.abs()), "{i}: {slope} {expected}");
    }
    assert_eq!(run.voltages[0], -plant.gain * start[0]);
}

#[test]
fn flexible_joint_sticks_within_its_friction() {
    let plant = RotaryFlexibleJoint::WITH_FRICTION;
    // The torque a kp theta_d stays below 0.02 N m for |theta_d| < 0.0493 rad.
    let sampling = Sampling { dt: 0.001, substeps: 2 };
    let held = plant.run(sampling, [0.0; 4], 1000, |_| 0.04).unwrap();
    assert!(held.states.iter().all(|x| x[0] == 0.0 && x[2] == 0.0));
    let loose = plant.run(sampling, [0.0; 4], 1000, |_| 0.06).unwrap();
    assert!(loose.states[999][0] > 0.0);
    // Friction bounds the growth that too much gain gives the linear loop.
    let sharp = RotaryFlexibleJoint { gain: 4.5, ..RotaryFlexibleJoint::LINEAR };
    let ring = |plant: RotaryFlexibleJoint| {
        let run = plant.run(sampling, [0.01, 0.0, 0.0, 0.0], 20_000, |_| 0.0).unwrap();
        largest(run.states[19_000..].iter().map(|x| x[0]))
    };
    assert!(ring(sharp) > 0.05);
    assert!(ring(RotaryFlexibleJoint { coulomb: 0.02, ..sharp }) < 0.02);
}

#[test]
fn a_delay_that_cannot_be_stepped_is_refused() {
    for delay in [-0.1, 1e-5, f64::NAN, f64::INFINITY] {
        let plant = DelayedDuffing { delay, ..DelayedDuffing::THESIS };
        let error = plant.run(Sampling { dt: 0.001, substeps: 1 }, [0.0; 2], 3, |_| 0.0).unwrap_err();
        assert!(matches!(error, RigError::Delay { .. }), "{error}");
    }
}
