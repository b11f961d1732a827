//! Inputs that are constant, known constants that differ between recordings, and derivatives of inputs: a diagnosis runs,
//! and offers nothing that only the changes of an input could tell.

use std::sync::Arc;

use greybox_calibrate::{Data, Setup, free_parameters};
use greybox_diagnose::library::On;
use greybox_diagnose::place::Place;
use greybox_diagnose::search::Search;
use greybox_diagnose::{Options, Quiet, built_in, calibrate, diagnose};
use greybox_model::{Expr, Model, System, parse};
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const DT: f64 = 0.01;
const N: usize = 1200;

const CART: &str = r#"
name = "cart with a payload"
[inputs]
d  = { unit = "1", hold = "linear" }
V  = { unit = "V", hold = "zero" }
mp = { unit = "kg", hold = "zero" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.2, unit = "kg", std = 0.4 }
c = { value = 0.5, unit = "N s/m", std = 0.5 }
k = { value = 38.0, unit = "N/m", std = 8.0 }
g = { value = 0.3, unit = "N/V", fixed = true }
[equations]
mass = "(m + mp)*x'' + c*x' + k*x = g*V*d"
"#;

/// (1 + mp) x'' = 0.3·7.4 d − 0.6 x' − 42 x − 2500 x³.
fn record(seed: u64, payload: f64) -> Recording {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let phases: Vec<f64> = (0..6).map(|_| 6.0 * normal()).collect();
    let lines = [1.3, 2.9, 4.7, 6.1, 7.9, 11.3];
    let d: Vec<f64> =
        (0..N).map(|k| lines.iter().zip(&phases).map(|(w, p)| (w * k as f64 * DT + p).sin()).sum()).collect();
    let (fine, mut x, mut v, mut y) = (50, 0.0, 0.0, Vec::new());
    let h = DT / f64::from(fine);
    for k in 0..N {
        y.push(x + 2e-4 * normal());
        for i in 0..fine {
            let w = f64::from(i) / f64::from(fine);
            let d = d[k] + w * (d[(k + 1).min(N - 1)] - d[k]);
            v += h * (2.22 * d - 0.6 * v - 42.0 * x - 2500.0 * x * x * x) / (1.0 + payload);
            x += h * v;
        }
    }
    let channel = |name: &str, values| Channel { name: name.into(), unit: None, values };
    let time = (0..N).map(|k| k as f64 * DT).collect();
    let (supply, payload) = (vec![7.4; N], vec![payload; N]);
    let columns = vec![channel("d", d), channel("V", supply), channel("mp", payload), channel("x", y)];
    Recording::from_columns(&format!("run{seed}.csv"), time, columns).unwrap()
}

fn search(model: &Model, recordings: &[Recording]) -> Vec<(String, Place)> {
    let library = built_in().unwrap();
    let data = Arc::new(Data::new(model, recordings).unwrap());
    let setup = Setup::new(model, data, free_parameters(model)).unwrap();
    let search = Search::new(setup, &library, &Quiet);
    let offered = search.candidates().iter();
    offered.map(|c| (library[c.mechanism].kind.clone(), c.place.clone())).collect()
}

#[test]
fn mechanisms_of_an_input_ask_for_its_changes() {
    let model = Model::from_toml(CART, "cart.toml").unwrap();
    let offered = search(&model, &[record(1, 0.0), record(2, 0.5)]);
    let at = |u: usize| offered.iter().filter(|(_, place)| *place == Place::Input(u)).count();
    assert!(at(0) > 3, "{offered:?}");
    assert_eq!((at(1), at(2)), (0, 0));
}

#[test]
fn constant_inputs_leave_a_calibration_and_a_diagnosis_finite() {
    let model = Model::from_toml(CART, "cart.toml").unwrap();
    let (train, held) = ([record(1, 0.0), record(2, 0.5)], [record(3, 0.25)]);
    let calibration = calibrate(&model, &train, &held, &Quiet).unwrap();
    let scores = [&calibration.train.0, &calibration.train.1, &calibration.holdout.1];
    assert!(scores.into_iter().flatten().all(|s| s.nrmse.is_finite()));
    assert!(calibration.parameters.iter().all(|p| p.calibrated.value.is_finite()));
    let d = diagnose(&model, &train, &held, &Options::default(), &Quiet).unwrap();
    let kinds: Vec<&str> = d.mechanisms.iter().map(|m| m.kind.as_str()).collect();
    assert_eq!(kinds, ["cubic_stiffness"]);
    let m = d.parameters.iter().find(|p| p.index == 0).unwrap();
    assert!((m.improved.value - 1.0).abs() < 0.02, "{}", m.improved.value);
    assert!(d.remainder.share_of_residual.is_finite());
}

/// What takes the place of an input takes that of its derivative.
#[test]
fn a_mechanism_of_an_input_reaches_its_derivative() {
    let text = r#"
[inputs]
u  = { unit = "m" }
du = { unit = "m/s", channel = "u'" }
[states]
x = { unit = "m" }
[parameters]
b = { value = 2.0, unit = "1/s" }
k = { value = 60.0, unit = "1/s^2" }
[equations]
mass = "x'' + b*(x' - du) + k*(x - u) = 0"
"#;
    let library = built_in().unwrap();
    let model = Model::from_toml(text, "base.toml").unwrap();
    let inserted = |kind: &str| -> String {
        let mechanism = library.iter().position(|m| m.kind == kind).unwrap();
        assert_eq!(library[mechanism].on, On::Input);
        let mut with = model.clone();
        let values = vec![0.1; library[mechanism].parameters().count()];
        let candidate =
            greybox_diagnose::candidate::Candidate { mechanism, place: Place::Input(0), mirrored: false };
        candidate.insert(&mut with, &library[mechanism], &values);
        assert!(System::compile(&with).is_ok(), "{kind}");
        with.equations[0].to_string()
    };
    let equation = |u: &str, du: &str| format!("x'' + b*(x' - {du}) + k*(x - {u}) = 0");
    assert_eq!(inserted("input_delay"), equation("delay(u, tau)", "delay(du, tau)"));
    assert_eq!(inserted("actuator_lag"), equation("ua", "ua'"));
    assert_eq!(inserted("input_offset"), equation("(u + uo)", "du"));
    // Within the limit the derivative is its own, beyond it none.
    let limited = inserted("input_saturation");
    let rate =
        limited.split_once("b*(x' - ").unwrap().1.split_once(") + k*(x - saturate(u, usat))").unwrap().0;
    let rate: Expr = parse(rate).unwrap().expr;
    let at = |u: f64| {
        let value = |name: &str, _: u8| {
            Some(if name == "u" {
                u
            } else if name == "du" {
                3.0
            } else {
                1.0
            })
        };
        rate.eval(&value).unwrap()
    };
    assert_eq!((at(0.5), at(2.0), at(-2.0)), (3.0, 0.0, 0.0), "{limited}");
    // And none is offered for the derivative alone.
    let u: Vec<f64> = (0..400).map(|k| (0.03 * f64::from(k)).sin()).collect();
    let channel =
        |name: &str, values: &[f64]| Channel { name: name.into(), unit: None, values: values.to_vec() };
    let time = (0..400).map(|k| f64::from(k) * DT).collect();
    let run = Recording::from_columns("run.csv", time, vec![channel("u", &u), channel("x", &u)]).unwrap();
    let offered = search(&model, &[run]);
    assert!(offered.iter().any(|(_, place)| *place == Place::Input(0)));
    assert!(!offered.iter().any(|(_, place)| *place == Place::Input(1)));
}
