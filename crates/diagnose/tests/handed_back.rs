//! What is handed back where no equation of the library is the machine's: a room that the sun heats too, which nobody
//! measured. Whatever is proposed in its stead fits the training recording no worse than the calibrated model, and predicts
//! another month no worse.

use greybox_diagnose::diagnosis::Role;
use greybox_diagnose::{Options, Quiet, Verdict, diagnose};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const ROOM: &str = r#"
name = "room, one heat store"
[inputs]
P = { unit = "kW", hold = "zero" }
To = { unit = "K", hold = "linear" }
[states]
T = { unit = "K" }
[parameters]
C = { value = 9.0, unit = "kW h/K" }
R = { value = 4.0, unit = "K/kW" }
[equations]
room = "C*T' = (To - T)/R + P"
"#;

/// C T' = (To − T)/R + P + s, every hour for three weeks; s is clouds and sun, people and windows: an Ornstein–Uhlenbeck
/// process of 30 h, ±0.1 kW.
fn month(seed: u64) -> Recording {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let (hours, fine) = (500, 20);
    let (mut t, mut s, mut weather) = (292.0, 0.0, 0.0);
    let [mut power, mut outside, mut inside] = [const { Vec::new() }; 3];
    for k in 0..hours {
        let day = std::f64::consts::TAU * f64::from(k) / 24.0;
        weather += 0.3 * normal() - 0.01 * weather;
        let to = 275.0 + weather - 3.0 * day.cos();
        let p = if t < 292.5 + 1.5 * (day - 2.0).sin() { 6.0 } else { 2.0 };
        power.push(p);
        outside.push(to);
        inside.push(t + 0.01 * normal());
        for _ in 0..fine {
            let h = 1.0 / f64::from(fine);
            s += -h * s / 30.0 + 0.1 * (2.0 * h / 30.0f64).sqrt() * normal();
            t += h * ((to - t) / 4.4 + p + s) / 8.0;
        }
    }
    let time = (0..hours).map(|k| 3600.0 * f64::from(k)).collect();
    let channel = |name: &str, unit: &str, values| {
        let unit = Some(unit.to_string());
        Channel { name: name.into(), unit, values }
    };
    let columns = vec![channel("P", "kW", power), channel("To", "K", outside), channel("T", "K", inside)];
    Recording::from_columns(&format!("month{seed}.csv"), time, columns).unwrap()
}

#[test]
fn what_fits_by_chance_is_not_handed_back() {
    let model = Model::from_toml(ROOM, "room.toml").unwrap();
    let mut worse = 0;
    for seed in 0..6 {
        let (train, held) = ([month(seed)], [month(seed + 100)]);
        let found = diagnose(&model, &train, &held, &Options::default(), &Quiet).unwrap();
        assert_ne!(found.verdict, Verdict::Consistent, "seed {seed}");
        let errors = |role: &Role| (role.calibrated.scores[0].nrmse, role.improved.scores[0].nrmse);
        let (calibrated, improved) = errors(&found.train);
        assert!(improved <= calibrated * (1.0 + 1e-6), "seed {seed}: {calibrated} -> {improved} in training");
        for part in found.mechanisms.iter().chain(&found.candidates) {
            let timed = ["step_disturbance", "periodic_disturbance", "parameter_drift"];
            assert!(
                !timed.contains(&part.kind.as_str()),
                "seed {seed}: {} at the same hour of every month",
                part.kind
            );
        }
        let (calibrated, improved) = errors(&found.holdout);
        worse += usize::from(improved > 1.05 * calibrated);
    }
    // Without the gates three of six are.
    assert!(worse <= 1, "{worse} of 6 are worse in another month");
}
