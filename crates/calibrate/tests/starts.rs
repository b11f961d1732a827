//! What is believed of the states at the start of a segment.

use crate::common::*;
use greybox_calibrate::{Limits, Point};
use greybox_model::Model;

/// A sensor that is late by τ shows where the machine was: its state has gone on by τ times its rate, and the
/// prior of a start allows for that much.
#[test]
fn a_late_sensor_shows_where_the_machine_was() {
    let (n, dt) = (600, 0.01);
    let f = force(7, n, dt, 1.0, 5.0);
    let with_delay = "k = { value = 20.0, unit = \"N/m\" }\ntau = { value = 0.03, unit = \"s\" }";
    let prompt = OSCILLATOR.replace("k = { value = 20.0, unit = \"N/m\" }", with_delay);
    let prompt = Model::from_toml(&prompt, "prompt.toml").unwrap();
    let measured = measure(&prompt, &f, dt, &[0.0, 0.0]);
    // The sensor: three samples late.
    let late: Vec<f64> = (0..n).map(|k| measured[0][k.saturating_sub(3)]).collect();
    let before = setup(&prompt, &f, dt, &[late]);
    let mut model = prompt.clone();
    model.measurements[0].expr = greybox_model::parse("delay(x, tau)").unwrap().expr;
    let after = before.with_model(model, before.free.clone()).unwrap();
    let (mut off, mut mended) = (0.0, 0.0);
    for k in (20..n - 20).step_by(20) {
        let truth = measured[0][k];
        off += (before.start(0, k)[0] - truth).powi(2);
        mended += (after.start(0, k)[0] - truth).powi(2);
        let ((mean, std), (_, plain)) = (after.start_prior(0, k)[0], before.start_prior(0, k)[0]);
        let moved = after.start(0, k)[0] - before.start(0, k)[0];
        assert!((mean - after.start(0, k)[0]).abs() < 1e-15);
        assert!((std - plain.hypot(moved)).abs() < 1e-15);
    }
    // The rate times τ misses ẍ τ²/2: a fifteenth of the whole for ωτ = 0.13.
    assert!(mended < 0.05 * off, "{mended} {off}");
}

/// A free decay whose frequency depends on its amplitude: the start is found beside the one that one-sided smoothing
/// believes in, in free runs and in fits that begin elsewhere.
#[test]
fn the_start_of_a_free_decay_is_found() {
    let (n, dt, noise, x0) = (2500, 0.015, 0.012, [0.4, 0.0]);
    let hardening = OSCILLATOR
        .replace("k*x = f", "k*x + k3*x^3 = f")
        .replace("[equations]", "k3 = { value = 4000, unit = \"N/m^3\" }\n[equations]");
    let model = Model::from_toml(&hardening, "hardening.toml").unwrap();
    let (mut runs, mut fits) = (0, 0);
    for seed in 0..10 {
        let f = force(seed, n, dt, 0.5, 2.0);
        let mut y = measure(&model, &f, dt, &x0);
        for (y, e) in y[0].iter_mut().zip(normal(100 + seed, n)) {
            *y += noise * e;
        }
        let setup = setup(&model, &f, dt, &y);
        let near = |x: &[f64]| (x[0] - x0[0]).abs() < 0.03 && (x[1] - x0[1]).abs() < 1.0;
        let sigma = setup.data.sigma.clone();
        runs += usize::from(near(&setup.estimate_start(0, &setup.values(), &sigma)));
        // A fit with the wrong physics has led the start away.
        let level = setup.level(4);
        let mut starts = setup.starts(&level, &setup.values());
        starts[0] = vec![0.6, -15.0];
        let point = Point { parameters: setup.values(), starts };
        let limits = Limits { iterations: 20, tolerance: 1e-6 };
        fits += usize::from(near(&setup.fit(&level, &sigma, &[point], limits).point.starts[0]));
    }
    assert!(runs >= 9 && fits >= 9, "{runs} free runs and {fits} fits of 10");
}
