//! A mode far faster than the samples: followed in small steps, or refused by name.

use std::sync::Arc;

use crate::common::*;
use greybox_calibrate::{Data, Setup, SetupError};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use greybox_simulate::Method;

/// The oscillator behind an actuator with a lag of `lag` seconds.
fn actuator(lag: f64) -> Model {
    let text = OSCILLATOR
        .replace(
            "x = { unit = \"m\" }",
            "x = { unit = \"m\" }\nF = { unit = \"N\", measured = false, initial = 0 }",
        )
        .replace("k*x = f\"", "k*x = F\"\nactuator = \"T*F' + F = f\"")
        .replace(
            "[equations]",
            &format!("T = {{ value = {lag:e}, unit = \"s\", fixed = true }}\n[equations]"),
        );
    Model::from_toml(&text, "model.toml").unwrap()
}

/// The model laid out on what the oscillator without a lag does, every 10 ms.
fn laid_out(lag: f64) -> Result<Setup, SetupError> {
    let (n, dt) = (1000, 0.01);
    let f = force(1, n, dt, 5.0, 10.0);
    let oscillator = Model::from_toml(OSCILLATOR, "model.toml").unwrap();
    let y = measure(&oscillator, &f, dt, &[0.0, 0.0]);
    let model = actuator(lag);
    let channel =
        |name: &str, values: &[f64]| Channel { name: name.into(), unit: None, values: values.to_vec() };
    let time = (0..n).map(|k| k as f64 * dt).collect();
    let recording =
        Recording::from_columns("simulated", time, vec![channel("f", &f), channel("x", &y[0])]).unwrap();
    let data = Arc::new(Data::new(&model, &[recording]).unwrap());
    Setup::new(&model, data, Vec::new())
}

#[test]
fn a_fast_mode_takes_the_steps_that_it_needs() {
    assert!(matches!(laid_out(0.02).unwrap().method, Method::Rk4 { .. } | Method::Dp5 { substeps: 1 }));
    // 200 time constants between two samples; a step of the method may be 3.3 of them.
    let setup = laid_out(5e-5).unwrap();
    assert!(matches!(setup.method, Method::Dp5 { substeps: 64..=128 }), "{:?}", setup.method);
    let values = setup.values();
    let run = setup.free_run(&values, &setup.data.spread);
    assert!(!run.diverged);
    let score = &setup.scores(&run, &values, 1.0, None)[0];
    assert!(score.nrmse < 2e-3, "{}", score.nrmse);
}

#[test]
fn a_mode_too_fast_to_follow_is_refused_with_its_rate() {
    for lag in [5e-6, 1e-9] {
        let Err(SetupError::Stiff { rate, dt }) = laid_out(lag) else { panic!("a lag of {lag} s was taken") };
        assert!((rate * lag - 1.0).abs() < 0.02, "{rate:e}");
        assert_eq!(dt, 0.01);
    }
    let reported = laid_out(1e-9).unwrap_err().to_string();
    assert!(reported.starts_with("the model is stiff: it has a mode of about 1.0e9 1/s"), "{reported}");
}

/// Presliding friction (Dahl): its memory fades at a rate that grows with the speed.
const DAHL: &str = r#"
name = "Mass with presliding friction"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
z = { unit = "m", measured = false, initial = 0 }
[parameters]
m = { value = 1.0, unit = "kg" }
c = { value = 1.5, unit = "N s/m" }
k = { value = 20.0, unit = "N/m" }
s = { value = 50.0, unit = "N/m" }
r = { value = 60.0, unit = "1/m" }
[equations]
mass = "m*x'' + c*x' + k*x + s*z = f"
memory = "z' = x' - r*abs(x')*z"
"#;

#[test]
fn a_faster_motion_than_the_fits_saw_is_simulated_in_finer_steps() {
    let model = Model::from_toml(DAHL, "model.toml").unwrap();
    let (n, dt) = (800, 0.05);
    let recorded = |seed: u64, size: f64| {
        let f = force(seed, n, dt, 0.5, size);
        let y = measure_in(&model, &f, dt, &[0.0; 3], 64);
        setup(&model, &f, dt, &y)
    };
    let (slow, fast) = (recorded(1, 1.0), recorded(2, 60.0));
    let values = slow.values();
    let fine = [1e-3 * fast.data.spread[0]];
    let score = |setup: &Setup| {
        let run = setup.free_run(&values, &fast.data.spread);
        setup.scores(&run, &values, 1.0, None)[0].nrmse
    };
    let error = score(&slow.for_simulations_of(fast.data.clone(), &values, &fine));
    assert!(error < 1e-2, "{error}");
    let before = score(&slow.with_data(fast.data.clone()));
    assert!(before.is_nan() || before > 10.0 * error, "{before} and {error}: the steps of the fits would do");
    // And never in coarser ones.
    let back = fast.for_simulations_of(slow.data.clone(), &values, &fine);
    assert_eq!(back.method, fast.method);
}

/// Lorenz's convection, by the second.
const LORENZ: &str = r#"
name = "Convection"
[inputs]
f = { unit = "1/s" }
[states]
x = { unit = "1" }
y = { unit = "1" }
z = { unit = "1" }
[parameters]
a = { value = 1.0, unit = "1/s" }
s = { value = 10.0 }
r = { value = 28.0 }
b = { value = 2.6666667 }
[equations]
flow = "x' = a*s*(y - x) + f"
first = "y' = a*(x*(r - z) - y)"
second = "z' = a*(x*y - b*z)"
"#;

/// Small errors grow by e each second whatever the step: the finest steps follow no further than coarser ones do.
#[test]
fn chaos_takes_no_finer_steps_than_bring_something() {
    let model = Model::from_toml(LORENZ, "model.toml").unwrap();
    let (n, dt) = (1500, 0.05);
    let f = vec![0.0; n];
    let y = measure_in(&model, &f, dt, &[1.0, 1.0, 25.0], 64);
    let mut setup = setup(&model, &f, dt, &y);
    let tolerance: Vec<f64> = setup.data.spread.iter().map(|s| 0.01 * s).collect();
    setup.choose_method(&tolerance, n);
    assert!(matches!(setup.method, Method::Dop853 { substeps: 1..=2 }), "{:?}", setup.method);
}
