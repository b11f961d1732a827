//! A mode far faster than the samples: followed in small steps, or refused by name.
#![allow(missing_docs, clippy::unwrap_used)]

mod common;
use std::sync::Arc;

use common::*;
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
    let told = laid_out(1e-9).unwrap_err().to_string();
    assert!(told.starts_with("the model is stiff: it has a mode of about 1.0e9 1/s"), "{told}");
}
