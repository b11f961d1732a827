//! Steps across several samples: taken where they change nothing that the data could tell.

use crate::common::*;
use greybox_calibrate::Setup;
use greybox_model::Model;
use greybox_simulate::Method;

/// The oscillator for six seconds every `dt`, with a noise of one part in a hundred of its motion.
fn recorded(dt: f64) -> (Setup, f64) {
    let n = (6.0 / dt) as usize;
    let model = Model::from_toml(OSCILLATOR, "model.toml").unwrap();
    // From wrong values.
    let mut guess = model.clone();
    guess.parameters[2].value = 25.0;
    let f = force(3, n, dt, 1.0, 5.0);
    let clean = &measure(&model, &f, dt, &[0.0, 0.0])[0];
    let sigma = 0.01 * (clean.iter().map(|x| x * x).sum::<f64>() / n as f64).sqrt();
    let noisy: Vec<f64> = clean.iter().zip(normal(4, n)).map(|(x, e)| x + sigma * e).collect();
    (setup(&guess, &f, dt, &[noisy]), sigma)
}

#[test]
fn a_fast_record_is_fitted_in_long_steps_to_the_same_parameters() {
    let (plain, sigma) = recorded(1e-3);
    assert_eq!(plain.method.stride(), 1, "nobody asked for it");
    let long = plain.clone().with_strides();
    assert!(long.method.stride() >= 8, "{:?}", long.method);
    let (level, scale) = (plain.level(1), [sigma]);
    let (before, after) = (fit(&plain, &level, &scale).point, fit(&long, &level, &scale).point);
    let errors = plain.with_problem(&level, &scale, |p| standard_errors(p, &before));
    for (i, free) in plain.free.iter().enumerate() {
        let moved = (after.parameters[free.index] - before.parameters[free.index]).abs() / errors[i];
        assert!(moved < 0.1, "{}: {moved} standard errors", plain.model.parameters[free.index].name);
    }
    let work = |setup: &Setup| {
        let before = setup.work.done();
        fit(setup, &level, &scale);
        setup.work.done() - before
    };
    assert!(5 * work(&long) < work(&plain));
}

#[test]
fn a_record_that_just_follows_the_motion_is_not() {
    let (plain, _) = recorded(0.05);
    assert_eq!(plain.clone().with_strides().method, plain.method);
}

/// What was chosen for one model is not taken for another, which may be faster, nor for other recordings.
#[test]
fn steps_are_chosen_anew_for_another_model_and_for_other_recordings() {
    let (plain, _) = recorded(1e-3);
    let long = plain.with_strides();
    let every = Method::Rk4 { substeps: 1 };
    assert_eq!(long.with_model(long.model.clone(), long.free.clone()).unwrap().method, every);
    let other = long.with_data(long.data.clone());
    assert_eq!(other.method, every);
    let again = long.for_simulations_of(long.data.clone(), &long.values(), &[1.0]);
    assert_eq!(again.method, long.method);
}
