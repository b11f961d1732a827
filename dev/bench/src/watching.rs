//! Rows of a machine that is watched while it runs.

use anyhow::{Context, Result};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::Throttle;
use greybox_watch::{Options, Watch};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

use super::case::{Against, Answer, Case, Row};

/// A throttle whose torque acts late by `delay(torque, tau)`, or at once.
const MODEL: &str = r#"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.02, unit = "N*m*s/rad" }
c = { value = 0.1, unit = "N*m" }
k = { value = 0.8, unit = "N*m/rad" }
tau = { value = 0.04, unit = "s" }
[states]
angle = { unit = "rad" }
[equations]
plate = "J*angle'' + b*angle' + c*sign(angle') + k*angle = delay(torque, tau)"
"#;

/// Seconds from sample to sample.
const STEP: f64 = 0.01;
/// Samples by which the torque is late, where it is.
const LATE: usize = 4;
/// Samples that are timed.
const TIMED: usize = 2000;

/// The rows.
pub(crate) fn rows() -> Vec<Row> {
    let row = |name, what, make| Row::new(name, what, "sample", Against::NOTHING, make);
    vec![
        row("watch", "a throttle watched: state, three parameters, six charts", || watched(false)),
        row("watch_delay", "the same with a dead time of four samples, a parameter too", || watched(true)),
    ]
}

fn watched(late: bool) -> Result<Case> {
    let mut text = MODEL.to_owned();
    if !late {
        text = text
            .replace("delay(torque, tau)", "torque")
            .replace("tau = { value = 0.04, unit = \"s\" }\n", "");
    }
    let model = Model::from_toml(&text, "throttle.toml")?;
    let options = Options::default();
    let learned = (options.learn / STEP) as usize;
    let [time, torque, angle] = run(learned + TIMED, if late { LATE } else { 0 });
    let channel = |name: &str, values: &[f64]| Channel {
        name: name.to_owned(),
        unit: None,
        values: values[..learned].to_vec(),
    };
    let channels = vec![channel("torque", &torque), channel("angle", &angle)];
    let first = Recording::from_columns("first", time[..learned].to_vec(), channels)?;
    let (watch, _) = Watch::learn(&model, &first, &options).context("the first minute")?;
    Ok(Case::alone(TIMED as f64, move || {
        let mut watch = watch.clone();
        let mut events = 0;
        for k in learned..learned + TIMED {
            events += watch.push(time[k], &torque[k..=k], &angle[k..=k]).len();
        }
        Ok(Answer::from([("events".to_owned(), vec![events as f64])]))
    }))
}

/// Time, torque and measured angle of every sample.
fn run(samples: usize, late: usize) -> [Vec<f64>; 3] {
    let mut random = Pcg64Mcg::seed_from_u64(1);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let (mut state, mut now) = ([0.0, 0.0], 0.0);
    let [mut time, mut torque, mut angle] = [(); 3].map(|()| Vec::with_capacity(samples));
    for k in 0..samples {
        if k.is_multiple_of(30) {
            now = 0.5 * normal();
        }
        time.push(STEP * k as f64);
        torque.push(now);
        angle.push(state[0] + 0.002 * normal());
        let acts = k.checked_sub(late).map_or(0.0, |before| torque[before]);
        state = Throttle::NEW.step(state, acts, STEP, 20);
    }
    [time, torque, angle]
}
