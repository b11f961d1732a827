//! A drive whose torque acts late, and which a controller of its own, that is late too, keeps in place.

use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::Throttle;
use greybox_watch::{Change, Event, Options, Subject, Watch};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const MODEL: &str = r#"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.05, unit = "N*m*s/rad" }
k = { value = 0.75, unit = "N*m/rad" }
gain = { value = 0.25, unit = "N*m/rad" }
dead = { value = 0.05, unit = "s" }
late = { value = 0.08, unit = "s", fixed = true }
[states]
angle = { unit = "rad" }
[equations]
drive = "J*angle'' + b*angle' + k*angle + gain*delay(angle, late) = delay(torque, dead)"
"#;

const DT: f64 = 0.02;
/// Steps of the drive from sample to sample.
const FINE: usize = 20;
/// When something happens, s.
const EVENT: f64 = 150.0;

/// What the drive is at a time: the gain of its controller, N·m/rad, and the dead time of its torque, in fine steps.
type Drive = fn(f64) -> (f64, usize);

/// Time, torque and measured angle of every sample.
fn run(drive: Drive, seconds: f64, seed: u64) -> Vec<[f64; 3]> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let (mut state, mut torque) = ([0.0, 0.0], 0.0);
    let (mut torques, mut angles, mut out) = (Vec::new(), Vec::new(), Vec::new());
    let before =
        |values: &[f64], steps: usize| values.len().checked_sub(steps + 1).map_or(0.0, |k| values[k]);
    for k in 0..(seconds / DT) as usize {
        let t = DT * k as f64;
        if k % 10 == 0 {
            torque = 0.5 * normal();
        }
        out.push([t, torque, state[0] + 0.002 * normal()]);
        let (gain, dead) = drive(t);
        for _ in 0..FINE {
            torques.push(torque);
            angles.push(state[0]);
            let acts = before(&torques, dead) - gain * before(&angles, 80);
            let drive = Throttle { viscous: 0.06, coulomb: 0.0, ..Throttle::NEW };
            state = drive.step(state, acts, DT / FINE as f64, 1);
        }
    }
    out
}

/// Learns from the first minute.
fn learned(samples: &[[f64; 3]]) -> (Watch, usize) {
    let count = samples.iter().take_while(|s| s[0] < 60.0).count();
    let column = |i: usize| samples[..count].iter().map(|s| s[i]).collect::<Vec<f64>>();
    let channel =
        |name: &str, unit: &str, i| Channel { name: name.into(), unit: Some(unit.into()), values: column(i) };
    let channels = vec![channel("torque", "N*m", 1), channel("angle", "rad", 2)];
    let first = Recording::from_columns("first", column(0), channels).unwrap();
    let model = Model::from_toml(MODEL, "drive.toml").unwrap();
    let (watch, event) = Watch::learn(&model, &first, &Options::default()).unwrap();
    let Event::Learned(learned) = event else { panic!("{event:?}") };
    for (found, right) in learned.parameters.iter().zip([0.06, 0.8, 0.2, 0.06]) {
        assert!((found.value - right).abs() < 5.0 * found.std + 0.003 * right, "{found:?}");
    }
    (watch, count)
}

fn push(watch: &mut Watch, samples: &[[f64; 3]]) -> Vec<Event> {
    samples.iter().flat_map(|[t, torque, angle]| watch.push(*t, &[*torque], &[*angle])).collect()
}

/// What is said of a change of the drive: at the alarm, and when it has settled.
fn told(drive: Drive, seed: u64) -> (Change, Change) {
    let samples = run(drive, 240.0, seed);
    let (mut watch, count) = learned(&samples);
    let mut events = push(&mut watch, &samples[count..]);
    events.retain(|e| !matches!(e, Event::Estimates(_)));
    let [Event::Changed(alarm), Event::Settled(settled)] = &events[..] else {
        panic!("seed {seed}: {events:?}")
    };
    (alarm.clone(), settled.clone())
}

#[test]
fn a_dead_time_that_grows_is_seen_named_and_measured() {
    for seed in 0..6 {
        let (alarm, settled) = told(|t| (0.2, if t < EVENT { 60 } else { 72 }), seed);
        assert!((0.0..4.0).contains(&(alarm.t - EVENT)), "{alarm:?}");
        assert_eq!(settled.subject, Subject::Parameter("dead".into()), "{settled:?}");
        assert!((settled.now - 0.072).abs() < 5.0 * settled.std + 2e-4 && settled.std < 5e-4, "{settled:?}");
    }
}

#[test]
fn a_gain_that_acts_late_is_seen_named_and_measured() {
    for seed in 0..6 {
        let (alarm, settled) = told(|t| (if t < EVENT { 0.2 } else { 0.26 }, 60), seed);
        assert!((0.0..4.0).contains(&(alarm.t - EVENT)), "{alarm:?}");
        assert_eq!(settled.subject, Subject::Parameter("gain".into()), "{settled:?}");
        assert!((settled.now - 0.26).abs() < 5.0 * settled.std + 5e-4 && settled.std < 2e-3, "{settled:?}");
    }
}

/// Saved and restored in the middle, the past goes on to the last digit.
#[test]
fn a_saved_past_goes_on_as_if_nothing_had_been() {
    let samples = run(|t| (if t < EVENT { 0.2 } else { 0.3 }, 60), 200.0, 5);
    let (mut watch, count) = learned(&samples);
    let mut saved = serde_json::to_string(watch.saved()).unwrap();
    let whole = push(&mut watch, &samples[count..]);
    let mut parts = Vec::new();
    let model = Model::from_toml(MODEL, "drive.toml").unwrap();
    for chunk in samples[count..].chunks(1111) {
        let mut watch = Watch::restore(&model, serde_json::from_str(&saved).unwrap()).unwrap();
        parts.extend(push(&mut watch, chunk));
        saved = serde_json::to_string(watch.saved()).unwrap();
    }
    assert_eq!(whole, parts);
    let cut = saved.replacen("\"past\":[[[", "\"past\":[[[0.5,", 1);
    assert_ne!(cut, saved);
    assert!(Watch::restore(&model, serde_json::from_str(&cut).unwrap()).is_err());
}
