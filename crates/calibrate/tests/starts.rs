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
    let before = setup(&prompt, &f, dt, std::slice::from_ref(&late));
    let mut model = prompt.clone();
    model.measurements[0].expr = greybox_model::parse("delay(x, tau)").unwrap().expr;
    let after = before.with_model(model.clone(), before.free.clone()).unwrap();
    let stated = setup(&model, &f, dt, std::slice::from_ref(&late));
    let (mut off, mut corrected) = (0.0, 0.0);
    for k in (20..n - 20).step_by(20) {
        let truth = measured[0][k];
        off += (before.start(0, k)[0] - truth).powi(2);
        corrected += (after.start(0, k)[0] - truth).powi(2);
        let ((mean, std), (_, plain)) = (after.start_prior(0, k)[0], before.start_prior(0, k)[0]);
        let moved = after.start(0, k)[0] - before.start(0, k)[0];
        assert!((mean - after.start(0, k)[0]).abs() < 1e-15);
        assert_eq!(
            (stated.start(0, k), stated.start_prior(0, k)),
            (after.start(0, k), after.start_prior(0, k))
        );
        assert!((std - plain.hypot(moved)).abs() < 1e-15);
    }
    // Beside a sensor that is not late the late one tells nothing, whichever comes first.
    let mut both = prompt.clone();
    both.measurements.insert(
        0,
        greybox_model::Measurement { channel: "late".to_string(), ..both.measurements[0].clone() },
    );
    both.measurements[0].expr = model.measurements[0].expr.clone();
    let both = setup(&both, &f, dt, &[late, measured[0].clone()]);
    let alone = setup(&prompt, &f, dt, &measured);
    assert!((20..n - 20).all(|k| both.start(0, k) == alone.start(0, k)));
    // The rate times τ misses ẍ τ²/2: a fifteenth of the whole for ωτ = 0.13.
    assert!(corrected < 0.05 * off, "{corrected} {off}");
}

/// Segments that begin only where the past of a late input is known: as many, of what is left.
#[test]
fn segments_may_leave_out_the_beginning_of_every_piece() {
    let (n, dt) = (600, 0.01);
    let f = force(7, n, dt, 1.0, 5.0);
    let model = Model::from_toml(OSCILLATOR, "plain.toml").unwrap();
    let measured = measure(&model, &f, dt, &[0.0, 0.0]);
    let setup = setup(&model, &f, dt, &measured);
    assert_eq!(setup.level_after(4, 0.0).segments, setup.level(4).segments);
    // 0.255 s: 26 samples.
    let late = setup.level_after(4, 0.255);
    assert_eq!((late.segments[0].range.start, late.segments[3].range.end), (26, n));
    assert!(late.segments.windows(2).all(|s| s[0].range.end == s[1].range.start));
    assert_eq!(late.priors[0], setup.start_prior(0, 26));
    assert!(setup.level_after(4, 100.0).segments.is_empty());
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

/// What a sensor reads along a line or a curve tells where the machine is, once the parameters of that are known.
#[test]
fn a_sensor_with_a_characteristic_shows_where_the_machine_is() {
    let (n, dt) = (600, 0.01);
    let f = force(7, n, dt, 1.0, 5.0);
    let plain = Model::from_toml(OSCILLATOR, "plain.toml").unwrap();
    let x0 = [0.3, 0.0];
    let truth = measure(&plain, &f, dt, &x0).remove(0);
    let rate = |k: usize| (truth[k + 1] - truth[k - 1]) / (2.0 * dt);
    let more = "so = { value = -0.5, unit = \"m\" }\ncr = { value = 2.0, unit = \"1/m^2\" }\n[equations]";
    for (reading, slope) in [("x + so", 1.0), ("3*x - so", 3.0), ("x + cr*x^3 + so", 1.0)] {
        let mut model = Model::from_toml(&OSCILLATOR.replace("[equations]", more), "reads.toml").unwrap();
        model.measurements[0].expr = greybox_model::parse(reading).unwrap().expr;
        let mut y = measure(&model, &f, dt, &x0);
        y[0].iter_mut().zip(normal(3, n)).for_each(|(y, e)| *y += 1e-3 * e);
        let free = setup(&model, &f, dt, &y);
        let held = free.for_simulations_of(free.data.clone(), &free.values(), &[1e-4]);
        for k in (20..n - 20).step_by(20) {
            let start = held.start(0, k);
            let prior = held.start_prior(0, k);
            let [position, speed] = [(start[0] - truth[k]).abs(), (start[1] - rate(k)).abs()];
            assert!(position < 2e-3 && speed < 0.08, "{reading} at {k}: {position} {speed}");
            // (Of a curve whose slope grows along it the least counts.)
            assert!(prior[0].1 < 0.01 / slope && prior[1].1 < 0.6 / slope, "{reading}: {prior:?}");
            assert!(position < prior[0].1 && speed < prior[1].1, "{reading} at {k}: {prior:?}");
            // Where the parameters are free, it is a place to begin and no more.
            assert_eq!(free.start(0, k), start);
            assert!(free.start_prior(0, k).iter().all(|p| p.1.is_infinite()));
        }
        let run = held.free_run(&held.values(), &[1e-3]);
        let start = &run.starts[0];
        assert!((start[0] - x0[0]).abs() < 6e-4 && (start[1] - x0[1]).abs() < 2e-3, "{reading}: {start:?}");
    }
    // A sine reads other angles as the same.
    let mut model = plain.clone();
    model.measurements[0].expr = greybox_model::parse("sin(3*x)").unwrap().expr;
    let y = measure(&model, &f, dt, &x0);
    let held = setup(&model, &f, dt, &y);
    let held = held.for_simulations_of(held.data.clone(), &held.values(), &[1e-4]);
    assert!((held.start(0, 30)[0] - truth[30]).abs() < 0.01, "{:?}", held.start(0, 30));
    assert!(held.start_prior(0, 30)[0].1.is_infinite());
}
