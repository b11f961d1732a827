//! The integrator against solutions in closed form.

mod common;
use common::*;
use greybox_model::Hold;
use greybox_simulate::Method;

const FINE: Method = Method::Adaptive { rtol: 1e-11, atol: 1e-13 };

#[test]
fn damped_oscillator_with_an_order_of_four_of_five_and_of_eight() {
    let m = model(&[], &[("x", 2)], &[("c", 0.4), ("k", 9.0)], &["x'' + c*x' + k*x = 0"], &["x"]);
    let exact = |t: f64| {
        let (s, w) = (0.2, (9.0f64 - 0.04).sqrt());
        (-s * t).exp() * ((w * t).cos() + s / w * (w * t).sin())
    };
    let error = |method, n: usize| {
        let env = free(n + 1, 6.0 / n as f64);
        let y = run(&m, &env, &[1.0, 0.0], method).y;
        (0..=n).map(|k| (y[k] - exact(6.0 * k as f64 / n as f64)).abs()).fold(0.0, f64::max)
    };
    let (a, b) = (error(Method::Rk4 { substeps: 1 }, 120), error(Method::Rk4 { substeps: 1 }, 240));
    assert!((a / b).log2() > 3.8 && (a / b).log2() < 4.3, "{a} {b}");
    let (a, b) = (error(Method::Dp5 { substeps: 1 }, 60), error(Method::Dp5 { substeps: 1 }, 120));
    assert!((a / b).log2() > 4.7 && (a / b).log2() < 5.4, "{a} {b}");
    let (a, b) = (error(Method::Dop853 { substeps: 1 }, 8), error(Method::Dop853 { substeps: 2 }, 8));
    assert!((a / b).log2() > 7.6 && (a / b).log2() < 9.0, "{a} {b}");
    assert!(error(FINE, 30) < 1e-9);
}

/// A drive at rest that its friction holds while the force grows: the link on it does not move, and what rounding
/// makes of that is not worth small steps.
#[test]
fn a_rig_at_rest_is_simulated_in_few_steps() {
    let parameters = [("J", 0.0021), ("Jl", 0.0039), ("ks", 1.3), ("fc", 0.11)];
    let hub = "J*q'' - ks*a + fc*sign(q') = u";
    let m = model(&["u"], &[("q", 2), ("a", 2)], &parameters, &[hub, "Jl*(q'' + a'') + ks*a = 0"], &["a"]);
    let ramp: Vec<f64> = (0..200).map(|k| 1e-3 * k as f64).collect();
    let t = run(&m, &driven(Hold::Linear, 0.01, &ramp), &[0.0; 4], FINE);
    // It breaks loose at 0.11 of 0.199: sample 110.
    assert!(t.y[..110].iter().all(|a| a.abs() < 1e-12));
    assert!(t.y[199].abs() > 1e-3);
    assert!(t.steps < 100 * 200, "{} steps", t.steps);
}

/// Coulomb-damped free decay: each half swing loses 2 fc/k of amplitude, and the mass sticks inside
/// |x| ≤ fc/k (Den Hartog 1931).
#[test]
fn coulomb_damped_decay_sticks_where_theory_says() {
    let m = model(&[], &[("x", 2)], &[("fc", 1.0), ("k", 100.0)], &["x'' + fc*sign(x') + k*x = 0"], &["x"]);
    let n = 4000;
    let dt = 0.001;
    for method in [Method::Rk4 { substeps: 1 }, FINE] {
        let t = run(&m, &free(n, dt), &[0.115, 0.0], method);
        // 0.115 → −0.095 → 0.075 → −0.055 → 0.035 → −0.015 → stops when |x| ≤ 0.01:
        // −0.015 is outside, so one more half swing about −0.01 ends at −0.005 and sticks there.
        let half = std::f64::consts::PI / 10.0;
        let exact = |time: f64| {
            let i = (time / half).floor().min(6.0);
            if i >= 6.0 {
                return -0.005;
            }
            let start = (0.115 - 0.02 * i) * if i as i64 % 2 == 0 { 1.0 } else { -1.0 };
            let centre = 0.01 * start.signum();
            centre + (start - centre) * (10.0 * (time - i * half)).cos()
        };
        for k in 0..n {
            let error = (t.y[k] - exact(k as f64 * dt)).abs();
            assert!(error < 2e-9, "{method:?} t={} error {error}", k as f64 * dt);
        }
        // Stuck for good: no velocity, no chatter.
        assert_eq!(t.x[n + n - 1], 0.0);
        assert_eq!(t.y[n - 1], t.y[2000]);
        assert!(t.events < 12, "{} events", t.events);
    }
}

/// A root of what a switch keeps positive goes on through zero, where the switch is held for the rest of a step: a drag
/// between viscous and quadratic, as a power, as a root, on a motion that turns round (`x' = sin t`).
#[test]
fn a_fractional_power_of_a_speed_that_changes_sign() {
    for drag in ["abs(v)^1.5*sign(v)", "sqrt(abs(v))*v", "max(v, 0)^1.5 - max(-v, 0)^1.5"] {
        let equation = format!("v' + c*({drag}) = cos(t) + c*sqrt(abs(sin(t)))*sin(t)");
        let m = model(&[], &[("v", 1)], &[("c", 0.8)], &[&equation], &["v"]);
        let n = 400;
        for (method, within) in [(Method::Rk4 { substeps: 2 }, 1e-6), (FINE, 1e-9)] {
            let t = run(&m, &free(n, 0.05), &[0.0], method);
            for k in 0..n {
                let error = (t.y[k] - (0.05 * k as f64).sin()).abs();
                assert!(error < within, "{drag} {method:?} t={} error {error}", 0.05 * k as f64);
            }
        }
    }
}

/// Driven block: sticks until the force exceeds the friction, then slips.
#[test]
fn a_ramp_breaks_the_block_loose_at_the_right_instant() {
    let m = model(&["f"], &[("x", 2)], &[("fc", 1.0)], &["2*x'' + fc*sign(x') = f"], &["x"]);
    let dt = 0.01;
    let u: Vec<f64> = (0..300).map(|k| 0.8 * k as f64 * dt).collect();
    let t = run(&m, &driven(Hold::Linear, dt, &u), &[0.0, 0.0], Method::Rk4 { substeps: 1 });
    for k in 0..300 {
        let since = (k as f64 * dt - 1.25f64).max(0.0);
        let exact = 0.8 * since.powi(3) / 12.0; // 2 x'' = 0.8 (t − 1.25)
        assert!((t.y[k] - exact).abs() < 1e-9, "{k}: {} {exact}", t.y[k]);
    }
}

/// A mass thrown against a one-sided spring: free flight, half a sine in contact, free flight.
#[test]
fn bouncing_end_stop() {
    let m = model(&[], &[("x", 2)], &[("k", 400.0), ("xs", 0.1)], &["x'' + k*max(x - xs, 0) = 0"], &["x"]);
    let (dt, n) = (0.003, 300);
    for method in [Method::Rk4 { substeps: 1 }, FINE] {
        let t = run(&m, &free(n, dt), &[0.0, 0.5], method);
        let (hit, contact) = (0.2, std::f64::consts::PI / 20.0);
        for k in 0..n {
            let time = k as f64 * dt;
            let exact = if time < hit {
                0.5 * time
            } else if time < hit + contact {
                0.1 + 0.5 / 20.0 * (20.0 * (time - hit)).sin()
            } else {
                0.1 - 0.5 * (time - hit - contact)
            };
            let tolerance = if method == FINE { 1e-10 } else { 3e-8 };
            assert!((t.y[k] - exact).abs() < tolerance, "{k} {} {exact}", t.y[k] - exact);
        }
        assert_eq!(t.events, 2);
    }
}

/// A spring given by its values: half a sine where it is a straight line, held beyond its ends.
#[test]
fn a_spring_given_by_a_table() {
    let (dt, n) = (0.01, 400);
    let parameters = [("fa", -9.0), ("fb", 0.0), ("fc", 4.0), ("x0", 0.1)];
    let table = ["x'' + table(x/x0, [-2, 0, 1], [fa, fb, fc]) = 0"];
    let table = model(&[], &[("x", 2)], &parameters, &table, &["x"]);
    let sums = ["x'' + 4*max(min(x/x0, 1), 0) + 4.5*min(max(x/x0, -2), 0) = 0"];
    let sums = model(&[], &[("x", 2)], &parameters, &sums, &["x"]);
    let from = |m: &greybox_model::Model, start: [f64; 2]| run(m, &free(n, dt), &start, FINE);
    // Inside of its ends: a quarter of a period on the stiffer side is π/2/√45 s.
    let small = from(&table, [-0.1, 0.0]);
    let quarter = (std::f64::consts::FRAC_PI_2 / 45f64.sqrt() / dt) as usize;
    for k in 0..quarter {
        let exact = -0.1 * (45f64.sqrt() * dt * k as f64).cos();
        assert!((small.y[k] - exact).abs() < 1e-10, "{k}: {} {exact}", small.y[k]);
    }
    let (a, b) = (from(&table, [0.3, 1.0]), from(&sums, [0.3, 1.0]));
    assert!(a.events > 4);
    for k in 0..n {
        assert!((a.y[k] - b.y[k]).abs() < 1e-9, "{k}: {} {}", a.y[k], b.y[k]);
    }
}

/// A late sensor on an oscillator in the middle of its motion: before the start the state goes straight back
/// along its rate (error at most ẍ τ²/2, in the first sample alone), between samples it is a cubic.
#[test]
fn a_late_sensor_sees_the_motion_before_the_start() {
    let parameters = [("w", 3.0), ("tau", 0.004)];
    let m = model(&[], &[("x", 2)], &parameters, &["x'' + w^2*x = 0"], &["delay(x, tau)"]);
    let (x0, v0, w, tau) = (0.3, 1.2, 3.0, 0.004);
    let eighth = Method::Dop853 { substeps: 1 };
    for method in [Method::Rk4 { substeps: 1 }, Method::Dp5 { substeps: 1 }, eighth, FINE] {
        let y = run(&m, &free(300, 0.01), &[x0, v0], method).y;
        let exact = |k: usize| {
            let t = k as f64 * 0.01 - tau;
            x0 * (w * t).cos() + v0 / w * (w * t).sin()
        };
        assert!((y[0] - (x0 - tau * v0)).abs() < 1e-12, "{method:?}: {}", y[0] - (x0 - tau * v0));
        assert!((y[0] - exact(0)).abs() < w * w * x0 * tau * tau / 2.0 * 1.1);
        for k in 1..300 {
            assert!((y[k] - exact(k)).abs() < 1e-6, "{method:?} {k}: {}", y[k] - exact(k));
        }
        // Sensitivities are linear between samples.
        let error = sensitivity_error(&m, &free(100, 0.01), &[x0, v0], method, 1e-6);
        assert!(error < 2e-3, "{method:?}: {error:.1e}");
    }
}

/// q' = −q(t − 1), q = 1 before the start: polynomial by the method of steps.
#[test]
fn a_delayed_state_follows_the_method_of_steps() {
    let m = model(&[], &[("q", 1)], &[("tau", 1.0)], &["q' + delay(q, tau) = 0"], &["q"]);
    let n = 201;
    let t = run(&m, &free(n, 0.01), &[1.0], Method::Rk4 { substeps: 1 });
    for k in 0..n {
        let time = k as f64 * 0.01;
        let exact = if time <= 1.0 { 1.0 - time } else { 1.0 - time + (time - 1.0) * (time - 1.0) / 2.0 };
        assert!((t.y[k] - exact).abs() < 1e-8, "{time}: {}", t.y[k] - exact);
    }
}

#[test]
fn delayed_inputs_of_either_hold() {
    let (dt, n) = (0.1, 40);
    let u: Vec<f64> = (0..n).map(|k| (0.7 * k as f64 * dt).sin()).collect();
    let m = model(&["u"], &[("x", 1)], &[("tau", 0.23)], &["x' = delay(u, tau)"], &["x"]);
    // Zero hold: the integral of a staircase, shifted by 0.23 s.
    let t = run(&m, &driven(Hold::Zero, dt, &u), &[0.0], Method::Rk4 { substeps: 1 });
    let staircase = |s: f64| {
        if s <= 0.0 {
            return u[0] * s;
        }
        let k = (s / dt + 1e-9).floor() as usize;
        u[..k].iter().sum::<f64>() * dt + u[k] * (s - k as f64 * dt)
    };
    for k in 0..n {
        let exact = staircase(k as f64 * dt - 0.23) - staircase(-0.23);
        assert!((t.y[k] - exact).abs() < 1e-12, "{k}: {} {exact}", t.y[k]);
    }
    assert!(
        sensitivity_error(&m, &driven(Hold::Zero, dt, &u), &[0.0], Method::Rk4 { substeps: 1 }, 1e-5) < 1e-8
    );
    // Linear between samples: the trapezoids, shifted; no step crosses a bend.
    let linear = driven(Hold::Linear, dt, &u);
    let t = run(&m, &linear, &[0.0], Method::Rk4 { substeps: 1 });
    let trapezoids = |s: f64| {
        if s <= 0.0 {
            return u[0] * s;
        }
        let k = (s / dt + 1e-9).floor() as usize;
        let w = s / dt - k as f64;
        let whole: f64 = (0..k).map(|i| 0.5 * (u[i] + u[i + 1])).sum();
        dt * (whole + w * u[k] + 0.5 * w * w * (u[k + 1] - u[k]))
    };
    for k in 0..n {
        let exact = trapezoids(k as f64 * dt - 0.23) - trapezoids(-0.23);
        assert!((t.y[k] - exact).abs() < 1e-12, "{k}: {} {exact}", t.y[k]);
    }
    let error = sensitivity_error(&m, &linear, &[0.0], Method::Rk4 { substeps: 1 }, 1e-5);
    assert!(error < 1e-8, "{error}");
}

#[test]
fn a_step_in_time_is_exact_and_its_instant_has_a_sensitivity() {
    let m = model(&[], &[("x", 1)], &[("a", 2.0), ("t0", 0.537)], &["x' = a*step(t, t0)"], &["x"]);
    let t = run(&m, &free(20, 0.1), &[0.0], Method::Rk4 { substeps: 1 });
    for k in 0..20 {
        assert!((t.y[k] - 2.0 * (0.1 * k as f64 - 0.537).max(0.0)).abs() < 1e-10);
    }
    assert!(sensitivity_error(&m, &free(20, 0.1), &[0.0], Method::Rk4 { substeps: 1 }, 1e-5) < 1e-7);
}

#[test]
fn coupled_mass_matrix_and_accelerometer() {
    // m1 x1'' + m2 (x1'' + x2'') = f; m2 (x1'' + x2'') + k x2 = 0; the second mass's acceleration.
    let m = model(
        &["f"],
        &[("x1", 2), ("x2", 2)],
        &[("m1", 2.0), ("m2", 0.5), ("k", 8.0)],
        &["m1*x1'' + m2*(x1'' + x2'') = f", "m2*(x1'' + x2'') + k*x2 = 0"],
        &["x1", "x1'' + x2''"],
    );
    let u = vec![1.0; 400];
    let t = run(&m, &driven(Hold::Linear, 0.01, &u), &[0.0; 4], Method::Rk4 { substeps: 1 });
    // The centre of mass moves by f t²/2 / (m1 + m2); m2's acceleration is −k x2/m2.
    for k in 0..400 {
        let time = k as f64 * 0.01;
        let centre = (2.0 * t.x[k] + 0.5 * (t.x[k] + t.x[800 + k])) / 2.5;
        assert!((centre - time * time / 5.0).abs() < 1e-9);
        assert!((t.y[400 + k] + 16.0 * t.x[800 + k]).abs() < 1e-12);
    }
    assert!(
        sensitivity_error(
            &m,
            &driven(Hold::Linear, 0.01, &u),
            &[0.1, 0.0, -0.05, 0.2],
            Method::Rk4 { substeps: 1 },
            1e-5
        ) < 1e-7
    );
}

/// Stick, slip and sticking again under a sine; sensitivities through all the events.
#[test]
fn sensitivities_survive_stick_and_slip() {
    let m = model(
        &["f"],
        &[("x", 2)],
        &[("m", 1.3), ("c", 0.2), ("k", 20.0), ("fc", 1.4)],
        &["m*x'' + c*x' + k*x + fc*sign(x') = f"],
        &["x"],
    );
    let dt = 0.005;
    let u: Vec<f64> = (0..1200).map(|k| 1.8 * (2.3 * k as f64 * dt).sin()).collect();
    let env = driven(Hold::Linear, dt, &u);
    let t = run(&m, &env, &[0.1, -0.3], Method::Rk4 { substeps: 1 });
    assert!(t.events > 4, "{}", t.events);
    let stuck = t.x[1200..].iter().filter(|v| **v == 0.0).count();
    assert!(stuck > 20, "{stuck}");
    let error = sensitivity_error(&m, &env, &[0.1, -0.3], Method::Rk4 { substeps: 1 }, 1e-6);
    assert!(error < 2e-5, "{error}");
}

#[test]
fn sensitivities_through_gaps_stops_and_saturation() {
    let m = model(
        &["u"],
        &[("x", 2)],
        &[("g", 0.05), ("us", 0.8), ("xs", 0.12)],
        &["x'' + 0.6*x' + 40*deadzone(x, g) - 300*max(-x - xs, 0) = 6*saturate(u, us)"],
        &["x"],
    );
    let dt = 0.01;
    let u: Vec<f64> = (0..600).map(|k| 1.3 * (2.9 * k as f64 * dt).sin()).collect();
    let error =
        sensitivity_error(&m, &driven(Hold::Linear, dt, &u), &[0.02, 0.1], Method::Rk4 { substeps: 2 }, 1e-6);
    assert!(error < 3e-5, "{error}");
}

/// Two bodies with friction between them and to the ground: both signs may stick at once.
/// Where all switching functions are states, the evaluation before an input jumps is spared, and the gradient of a speed that
/// is held is known. Beside a switch on the input nothing is spared; behind a factor of one the gradient is computed. The motion
/// is the same.
#[test]
fn switching_on_the_state_alone_only_spares_work() {
    let parameters =
        [("J", 0.5), ("Jl", 0.4), ("ks", 9.0), ("fc", 0.6), ("fl", 0.2), ("one", 1.0), ("none", 0.0)];
    let of = |q: &str, a: &str, more: &str| {
        let hub = format!("J*q'' - ks*a + fc*sign({q}) = u{more}");
        let link = format!("Jl*(q'' + a'') + ks*a + 0.05*a' + fl*sign({a}) = 0");
        model(&["u"], &[("q", 2), ("a", 2)], &parameters, &[&hub, &link], &["q", "a"])
    };
    let swing = |k: usize| if (k / 23).is_multiple_of(3) { 4.4 } else { -2.8 };
    let u: Vec<f64> = (0..400).map(|k| swing(k) * (k % 7) as f64 / 6.0).collect();
    for hold in [Hold::Zero, Hold::Linear] {
        let env = driven(hold, 0.02, &u);
        let run = |m: &greybox_model::Model| run(m, &env, &[0.0; 4], Method::Rk4 { substeps: 2 });
        let t = run(&of("q'", "a'", ""));
        assert!(t.events > 50 && t.y[399].abs() > 0.01, "{} {}", t.events, t.y[399]);
        let watched = run(&of("q'", "a'", " + none*abs(u - 5)"));
        assert_eq!((&t.y, t.events), (&watched.y, watched.events));
        let spared = watched.evaluations as f64 / t.evaluations as f64 - 1.0;
        let expected = if hold == Hold::Zero { 0.05..0.1 } else { 0.0..1e-9 };
        assert!(expected.contains(&spared), "{hold:?}: {spared}");
        let computed = run(&of("one*q'", "one*a'", ""));
        let largest = t.y.iter().zip(&computed.y).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(largest < 4e-11, "{hold:?}: {largest}");
    }
}

#[test]
fn two_frictions_stick_together() {
    let m = model(
        &["f"],
        &[("a", 2), ("b", 2)],
        &[("f1", 0.5), ("f2", 1.0)],
        &["a'' + f1*sign(a' - b') = 0", "2*b'' + f2*sign(b') - f1*sign(a' - b') = f"],
        &["a", "b"],
    );
    let dt = 0.01;
    // f < f2: nothing moves. Then f = 2: both move together (a'' = 1/3 < 0.5). Then f = 4: slip.
    let u: Vec<f64> = (0..300)
        .map(|k| {
            if k < 100 {
                0.9
            } else if k < 200 {
                2.0
            } else {
                4.0
            }
        })
        .collect();
    let t = run(&m, &driven(Hold::Zero, dt, &u), &[0.0; 4], Method::Rk4 { substeps: 1 });
    for k in 0..300 {
        let time = k as f64 * dt;
        let (a, b) = (t.y[k], t.y[300 + k]);
        if time <= 1.0 {
            assert_eq!((a, b), (0.0, 0.0));
        } else if time <= 2.0 {
            let both = (time - 1.0).powi(2) / 6.0;
            assert!((a - both).abs() < 1e-10 && (b - both).abs() < 1e-10, "{time} {a} {b} {both}");
        } else {
            let s = time - 2.0;
            assert!((a - (1.0 / 6.0 + s / 3.0 + 0.25 * s * s)).abs() < 1e-9);
            assert!((b - (1.0 / 6.0 + s / 3.0 + (4.0 - 1.0 - 0.5) / 4.0 * s * s)).abs() < 1e-9);
        }
    }
}

#[test]
fn a_system_that_blows_up_is_frozen_and_said() {
    let m = model(&[], &[("x", 2)], &[("k", 3.0)], &["x'' - k*x^3 = 0"], &["x"]);
    for method in [Method::Rk4 { substeps: 1 }, FINE] {
        let t = run(&m, &free(400, 0.05), &[1.0, 0.0], method);
        let at = t.diverged.expect("it diverges");
        assert!(at > 5 && at < 100);
        assert!(t.y.iter().all(|v| v.is_finite()));
    }
}

/// A fast decay towards a slow motion, x' = −a (x − z), z'' = −z.
#[test]
fn a_mode_far_faster_than_the_samples_ends_the_simulation() {
    let run = |a: f64| {
        let m = model(&[], &[("x", 1), ("z", 2)], &[("a", a)], &["x' = a*(z - x)", "z'' = -z"], &["x"]);
        run(&m, &free(50, 0.1), &[1.0, 1.0, 0.0], Method::Adaptive { rtol: 1e-6, atol: 1e-8 })
    };
    let slow = run(1.0);
    assert!(!slow.is_stiff() && slow.exhausted.is_none());
    let stiff = run(1e4);
    assert!(stiff.is_stiff() && stiff.exhausted.is_none() && stiff.diverged.is_none());
    assert!((stiff.fastest / 1e4 - 1.0).abs() < 0.01, "{}", stiff.fastest);
    assert!((stiff.y[49] - 4.9f64.cos()).abs() < 3e-4, "{}", stiff.y[49]);
    let refused = run(1e9);
    assert_eq!(refused.exhausted, Some(1));
    assert!((refused.fastest / 1e9 - 1.0).abs() < 0.01, "{}", refused.fastest);
}
