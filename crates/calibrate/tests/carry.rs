//! Memory that no sensor sees, and delays, through the seams of the segments.

use crate::common::*;
use greybox_calibrate::{Segment, Segmentation};
use greybox_model::Model;

const BOUC_WEN: &str = r#"
name = "Bouc–Wen oscillator"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
z = { unit = "m", measured = false, initial = 0 }
[parameters]
m  = { value = 1.0, unit = "kg", fixed = true }
c  = { value = 1.5, unit = "N s/m", fixed = true }
k  = { value = 20.0, unit = "N/m", fixed = true }
kh = { value = 30.0, unit = "N/m" }
be = { value = 8.0, unit = "1/m" }
ga = { value = 4.0, unit = "1/m" }
[equations]
mass = "m*x'' + c*x' + k*x + kh*z = f"
hysteresis = "z' = x' - be*abs(x')*z - ga*x'*abs(z)"
"#;

const DELAYED: &str = r#"
name = "Delayed feedback"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m   = { value = 1.0, unit = "kg", fixed = true }
c   = { value = 1.5, unit = "N s/m" }
k   = { value = 20.0, unit = "N/m" }
g   = { value = 8.0, unit = "N/m" }
tau = { value = 0.3, unit = "s" }
[equations]
mass = "m*x'' + c*x' + k*x + g*delay(x, tau) = f"
"#;

const DT: f64 = 0.02;

fn noisy(y: &[Vec<f64>], sigma: f64, seed: u64) -> Vec<Vec<f64>> {
    y.iter().map(|y| y.iter().zip(normal(seed, y.len())).map(|(y, e)| y + sigma * e).collect()).collect()
}

/// The model with other first values of the free parameters.
fn off(model: &Model, by: &[f64]) -> Model {
    let mut model = model.clone();
    for (p, f) in model.parameters.iter_mut().filter(|p| !p.fixed).zip(by) {
        p.value *= f;
    }
    model
}

#[test]
fn hysteresis_is_recovered_when_its_memory_is_carried() {
    let truth = Model::from_toml(BOUC_WEN, "model.toml").unwrap();
    let f = force(1, 3000, DT, 1.5, 8.0);
    let clean = measure(&truth, &f, DT, &[0.0; 3]);
    let sigma = 0.01 * greybox_calibrate::data::spread(&clean[0]);
    let names = ["kh", "be", "ga"];
    for seed in 10..14 {
        let free = setup(&off(&truth, &[0.7, 1.4, 0.6]), &f, DT, &noisy(&clean, sigma, seed));
        let carried = free.with_carried(&["z".to_string()]).unwrap();
        assert_eq!(carried.carried, [2]);
        let level = carried.level(15);
        assert_eq!(level.segments.len(), 15);
        let scale = [sigma];
        let got = fit(&carried, &level, &scale);
        let rows = carried.with_problem(&level, &scale, |p| p.rows(&got.point, true, None));
        let errors = carried.with_problem(&level, &scale, |p| standard_errors(p, &got.point));
        for (i, segment) in rows.iter().enumerate() {
            let column = &segment.jx[2 * segment.rows..3 * segment.rows];
            assert!(column.iter().all(|v| *v == 0.0));
            let t = &segment.trajectory;
            if i > 0 {
                assert!(segment.jx[..segment.rows].iter().any(|v| *v != 0.0));
                // Where the memory was left is where it goes on, and the point says so.
                assert_eq!(got.point.starts[i][2], t.x[2 * t.n]);
            }
        }
        for (j, name) in names.iter().enumerate() {
            let value = |f: &greybox_calibrate::Fit| f.point.parameters[3 + j];
            let exact = truth.parameters[3 + j].value;
            let z = (value(&got) - exact) / errors[j];
            assert!(z.abs() < 4.0, "{name}: {} ± {}", value(&got), errors[j]);
        }
        let reduced = got.cost / got.count[0] as f64;
        assert!((0.85..1.1).contains(&reduced), "{reduced}");
        // In short segments a memory that is free says little; carried, it says nearly as much.
        let short = carried.level(60);
        let of = |s: &greybox_calibrate::Setup, level: &Segmentation| {
            let point = fit(s, level, &scale).point;
            s.with_problem(level, &scale, |p| standard_errors(p, &point))
        };
        let (with, without) = (of(&carried, &short), of(&free, &short));
        assert!(with.iter().zip(&without).all(|(a, b)| *a < 0.75 * b), "{with:?} {without:?}");
    }
}

#[test]
fn delayed_feedback_keeps_its_past_in_short_segments() {
    let truth = Model::from_toml(DELAYED, "model.toml").unwrap();
    let f = force(2, 3000, DT, 1.5, 8.0);
    let clean = measure(&truth, &f, DT, &[0.0; 2]);
    let sigma = 0.005 * greybox_calibrate::data::spread(&clean[0]);
    let scale = [sigma];
    let mut bias = [[0.0f64; 4]; 2];
    let seeds = 4;
    for seed in 0..seeds {
        let s = setup(&off(&truth, &[1.2, 0.9, 0.8, 1.2]), &f, DT, &noisy(&clean, sigma, 20 + seed));
        let level = s.level(60);
        // One sample short of the next: nothing goes on there, and what was before is read off the measurement.
        let cut = Segmentation {
            segments: level
                .segments
                .iter()
                .map(|s| Segment { piece: s.piece, range: s.range.start..s.range.end - 1 })
                .collect(),
            priors: level.priors.clone(),
        };
        for (b, level) in bias.iter_mut().zip([&level, &cut]) {
            let got = fit(&s, level, &scale);
            for (j, b) in b.iter_mut().enumerate() {
                *b += (got.point.parameters[1 + j] / truth.parameters[1 + j].value - 1.0) / seeds as f64;
            }
        }
    }
    // Measured: 8, 2, 9 and 3 % going on (a third of every segment hangs on the one before; these are what 30
    // iterations leave), 6, 2, 6 and 2 % from the measured past; 90, 14, 42 and 78 % when every segment forgets.
    for bias in bias.iter().flatten() {
        assert!(bias.abs() < 0.1, "{bias:?}");
    }
    // From there longer segments are as good as the noise allows.
    let s = setup(&off(&truth, &[1.2, 0.9, 0.8, 1.2]), &f, DT, &noisy(&clean, sigma, 20));
    let (short, level) = (s.level(60), s.level(8));
    let point = s.stitch(&short, &fit(&s, &short, &scale).point, &level, &scale);
    let got = s.fit(&level, &scale, &[point], greybox_calibrate::Limits::default());
    let point = got.point;
    let errors = s.with_problem(&level, &scale, |p| standard_errors(p, &point));
    for (j, error) in errors.iter().enumerate() {
        let z = (point.parameters[1 + j] - truth.parameters[1 + j].value) / error;
        assert!(z.abs() < 4.0, "{}: {z:.2} standard errors", truth.parameters[1 + j].name);
    }
}

#[test]
fn a_gap_between_segments_starts_a_new_chain() {
    let model = Model::from_toml(BOUC_WEN, "model.toml").unwrap();
    let f = force(1, 400, DT, 1.5, 8.0);
    let clean = measure(&model, &f, DT, &[0.0; 3]);
    let s = setup(&model, &f, DT, &clean).with_carried(&["z".to_string()]).unwrap();
    let segments: Vec<Segment> =
        [200..300, 0..100, 100..180, 300..400].map(|range| Segment { piece: 0, range }).into();
    let priors = segments.iter().map(|g| s.start_prior(0, g.range.start)).collect();
    let level = Segmentation { segments, priors };
    s.with_problem(&level, &[1.0], |p| assert_eq!(p.chains(), [vec![1, 2], vec![0, 3]]));
    // What is asked for is said when it is not there; another model carries nothing.
    let error = s.with_carried(&["y".to_string()]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the model has no state `y` to carry from segment to segment; its states are `x`, `z`"
    );
    assert!(s.with_model(model, vec![]).unwrap().carried.is_empty());
}

/// Restarted simulations of a model with a delay know what was before the window.
#[test]
fn windows_of_a_score_remember_what_was_before() {
    let truth = Model::from_toml(DELAYED, "model.toml").unwrap();
    let f = force(2, 1500, DT, 1.5, 8.0);
    let clean = measure(&truth, &f, DT, &[0.0; 2]);
    let s = setup(&truth, &f, DT, &clean);
    let run = s.free_run(&s.values(), &[s.data.sigma[0]]);
    let score = s.scores(&run, &s.values(), 1.0, None)[0];
    assert!(score.nrmse < 1e-3 && score.nrmse_windowed < 5e-3, "{score:?}");
}
