//! The tape and its integrator against the virtual rigs' own, which share no code with them.
#![allow(missing_docs, clippy::unwrap_used)]

mod common;
use common::*;
use greybox_model::Hold;
use greybox_simulate::Method;
use greybox_simulate::rigs::{Duffing, RotaryFlexibleLink, Sampling};

#[test]
fn duffing_oscillator_of_the_thesis() {
    let d = Duffing::THESIS;
    let m = model(
        &[],
        &[("x", 2)],
        &[("m", d.m), ("k1", d.k1), ("k3", d.k3), ("c1", d.c1), ("c2", d.c2), ("c3", d.c3)],
        &["m*x'' + k1*x + k3*x^3 + c1*x' + c2*x'*x^2 + c3*x'^3 = 10*sin(t) + 40*sin(4*t)"],
        &["x"],
    );
    let (n, dt) = (2001, 0.01);
    let rig = d.run(Sampling { dt, substeps: 40 }, [1.0, 0.0], n, Duffing::thesis_force).unwrap();
    for (method, limit) in
        [(Method::Adaptive { rtol: 1e-10, atol: 1e-12 }, 1e-8), (Method::Rk4 { substeps: 4 }, 1e-7)]
    {
        let y = run(&m, &free(n, dt), &[1.0, 0.0], method).y;
        let worst = (0..n).map(|k| (y[k] - rig[k][0]).abs()).fold(0.0, f64::max);
        assert!(worst < limit, "{method:?}: {worst}");
    }
}

/// Coupled equations with a held voltage and friction that sticks, slips and breaks loose.
#[test]
fn rotary_flexible_link_with_stick_and_slip() {
    let rig = RotaryFlexibleLink::IDENTIFIED;
    let (n, dt) = (1200, 0.005);
    let volts: Vec<f64> = (0..n)
        .map(|k| {
            let t = k as f64 * dt;
            if (t * 0.8).fract() < 0.5 { 0.55 * (9.0 * t).sin() } else { 0.02 }
        })
        .collect();
    let truth = rig.run(Sampling { dt, substeps: 60 }, [0.0; 4], n, |k, _| volts[k]).unwrap();
    let mut parameters: Vec<(String, f64)> = Vec::new();
    let mut equations = Vec::new();
    for (name, b) in [("hub", &rig.hub), ("link", &rig.link)] {
        let values = [
            ("p", b.rate),
            ("p3", b.rate_cubed),
            ("a", b.angle),
            ("a2", b.angle_squared),
            ("a3", b.angle_cubed),
            ("q", b.deflection_rate),
            ("d", b.deflection),
            ("d2", b.deflection_squared),
            ("fc", b.coulomb),
            ("j", b.acceleration),
        ];
        for (p, v) in values {
            parameters.push((format!("{p}_{name}"), v));
        }
        let z = if name == "hub" { "theta''" } else { "alpha''" };
        equations.push(format!(
            "j_{name}*{z} + p_{name}*theta' + p3_{name}*theta'^3 + a_{name}*theta + a2_{name}*theta^2 + a3_{name}*theta^3 + q_{name}*alpha' + d_{name}*alpha + d2_{name}*alpha^2 + fc_{name}*sign(theta') = v"
        ));
    }
    let parameters: Vec<(&str, f64)> = parameters.iter().map(|(n, v)| (n.as_str(), *v)).collect();
    let equations: Vec<&str> = equations.iter().map(String::as_str).collect();
    let m = model(&["v"], &[("theta", 2), ("alpha", 2)], &parameters, &equations, &["theta", "alpha"]);
    let t = run(&m, &driven(Hold::Zero, dt, &volts), &[0.0; 4], Method::Adaptive { rtol: 1e-9, atol: 1e-11 });
    let worst = (0..n)
        .map(|k| (t.y[k] - truth.states[k][0]).abs().max((t.y[n + k] - truth.states[k][1]).abs()))
        .fold(0.0, f64::max);
    assert!(t.events > 10, "{} events", t.events);
    assert!(worst < 1e-5, "{worst}");
}
