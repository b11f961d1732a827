//! A drive whose friction changes, and one whose sensor does.

use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use greybox_watch::{Event, Options, Subject, Watch};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const MODEL: &str = r#"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.05, unit = "N*m*s/rad" }
k = { value = 0.8, unit = "N*m/rad" }
[states]
angle = { unit = "rad" }
[equations]
drive = "J*angle'' + b*angle' + k*angle = torque"
"#;

const DT: f64 = 0.01;

/// What happens to the drive.
#[derive(Clone, Copy)]
struct Machine {
    /// Damping, N·m·s/rad, at a time.
    damping: fn(f64) -> f64,
    /// Offset of the sensor, rad.
    offset: fn(f64) -> f64,
    /// A torque that nobody knows, N·m.
    load: fn(f64) -> f64,
}

const SOUND: Machine = Machine { damping: |_| 0.06, offset: |_| 0.0, load: |_| 0.0 };

/// Time, torque and measured angle of every sample.
fn run(machine: Machine, seconds: f64, seed: u64) -> Vec<[f64; 3]> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let (mut angle, mut rate, mut torque) = (0.0f64, 0.0f64, 0.0);
    let mut out = Vec::new();
    for k in 0..(seconds / DT) as usize {
        let t = DT * k as f64;
        if k % 20 == 0 {
            torque = 0.5 * normal();
        }
        out.push([t, torque, angle + (machine.offset)(t) + 0.002 * normal()]);
        for _ in 0..20 {
            let h = DT / 20.0;
            let at =
                |a: f64, r: f64| (torque + (machine.load)(t) - (machine.damping)(t) * r - 0.8 * a) / 0.02;
            // (Midpoint.)
            let (am, rm) = (angle + 0.5 * h * rate, rate + 0.5 * h * at(angle, rate));
            angle += h * rm;
            rate += h * at(am, rm);
        }
    }
    out
}

fn watch(samples: &[[f64; 3]], options: &Options) -> (Watch, Vec<Event>) {
    let model = Model::from_toml(MODEL, "drive.toml").unwrap();
    let first: Vec<&[f64; 3]> = samples.iter().take_while(|s| s[0] < options.learn).collect();
    let column = |i: usize| first.iter().map(|s| s[i]).collect::<Vec<f64>>();
    let channel =
        |name: &str, unit: &str, i| Channel { name: name.into(), unit: Some(unit.into()), values: column(i) };
    let channels = vec![channel("torque", "N*m", 1), channel("angle", "rad", 2)];
    let recording = Recording::from_columns("first", column(0), channels).unwrap();
    let (mut watch, learned) = Watch::learn(&model, &recording, options).unwrap();
    let mut events = vec![learned];
    for [t, torque, angle] in &samples[first.len()..] {
        events.extend(watch.push(*t, &[*torque], &[*angle]));
    }
    (watch, events)
}

#[test]
fn look() {
    let machines = [
        ("step", Machine { damping: |t| if t < 150.0 { 0.06 } else { 0.066 }, ..SOUND }),
        ("ramp", Machine { damping: |t| 0.06 + 0.00002 * (t - 150.0).max(0.0), ..SOUND }),
        ("offset", Machine { offset: |t| if t < 150.0 { 0.0 } else { 0.002 }, ..SOUND }),
        ("load", Machine { load: |t| if t < 150.0 { 0.0 } else { 0.01 }, ..SOUND }),
        ("sound", SOUND),
    ];
    for (name, machine) in machines {
        for seed in 0..4 {
            let samples = run(machine, 300.0, seed);
            let (_, events) = watch(&samples, &Options::default());
            for e in &events {
                if !matches!(e, Event::Estimates(_) | Event::Learned(_)) {
                    eprintln!("{name} {}", serde_json::to_string(e).unwrap());
                }
            }
        }
    }
    let mut alarms = 0;
    for seed in 10..20 {
        let samples = run(SOUND, 3660.0, seed);
        let (_, events) = watch(&samples, &Options { alarms_per_day: 240.0, ..Options::default() });
        alarms += events.iter().filter(|e| matches!(e, Event::Changed(_))).count();
    }
    eprintln!("{alarms} of 100");
    let _ = Subject::Parameter("b".into());
}
