//! Two carts, each on a spring of its own, with a damper between them: a constant force that was left out, the zero of a
//! sensor and the zero of the actuator are one and the same, and the report says so.

use greybox_diagnose::{Options, Quiet, diagnose};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};

const CARTS: &str = r#"
[inputs]
f = { unit = "N" }
[states]
x1 = { unit = "m" }
x2 = { unit = "m" }
[parameters]
m1 = { value = 1.0, unit = "kg", fixed = true }
m2 = { value = 0.7, unit = "kg", fixed = true }
c  = { value = 0.9, unit = "N s/m" }
k1 = { value = 42.0, unit = "N/m" }
k2 = { value = 31.0, unit = "N/m" }
[equations]
first  = "m1*x1'' + c*(x1' - x2') + k1*x1 = f"
second = "m2*x2'' + c*(x2' - x1') + k2*x2 = 0"
"#;

/// The carts with a constant force on the first, by small semi-implicit steps.
fn record(seed: u64, constant: f64) -> Recording {
    let (n, dt, fine) = (700, 0.02, 100);
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let gauss = Normal::new(0.0, 5e-4).unwrap();
    let phase = seed as f64;
    let force = |t: f64| [1.3, 4.7, 6.1].iter().map(|w| 2.0 * (w * t + phase * w).sin()).sum::<f64>();
    let samples: Vec<f64> = (0..n).map(|k| force(k as f64 * dt)).collect();
    let (mut x, mut v) = ([0.0f64; 2], [0.0f64; 2]);
    let h = dt / f64::from(fine);
    let mut y = [Vec::new(), Vec::new()];
    for k in 0..n {
        for (y, x) in y.iter_mut().zip(x) {
            y.push(x + gauss.sample(&mut rng));
        }
        let next = samples[(k + 1).min(n - 1)];
        for i in 0..fine {
            let f = samples[k] + f64::from(i) / f64::from(fine) * (next - samples[k]);
            let damper = 0.9 * (v[0] - v[1]);
            v[0] += h * (f - damper - 42.0 * x[0] - constant);
            v[1] += h * (damper - 31.0 * x[1]) / 0.7;
            x = [x[0] + h * v[0], x[1] + h * v[1]];
        }
    }
    let channel =
        |name: &str, unit: &str, values| Channel { name: name.into(), unit: Some(unit.into()), values };
    let [y1, y2] = y;
    let channels = vec![channel("f", "N", samples), channel("x1", "m", y1), channel("x2", "m", y2)];
    let time = (0..n).map(|k| k as f64 * dt).collect();
    Recording::from_columns(&format!("run{seed}.csv"), time, channels).unwrap()
}

#[test]
fn a_sensor_offset_stands_beside_a_constant_force_on_a_linear_machine() {
    let model = Model::from_toml(CARTS, "carts.toml").unwrap();
    let found = diagnose(&model, &[record(1, 0.5)], &[record(2, 0.5)], &Options::default(), &Quiet).unwrap();
    let [force] = &found.mechanisms[..] else { panic!("{:?}", found.mechanisms) };
    assert_eq!((force.kind.as_str(), &force.equations[..]), ("constant_offset", &["first".to_owned()][..]));
    let equal: Vec<(&str, &[String], Option<&str>)> = force
        .alternatives
        .iter()
        .filter(|a| a.equivalent)
        .map(|a| (a.kind.as_str(), &a.site.channels[..], a.site.input.as_deref()))
        .collect();
    assert!(equal.contains(&("sensor_offset", &["x1".to_owned()], None)), "{equal:?}");
    assert!(equal.contains(&("input_offset", &[], Some("f"))), "{equal:?}");
    assert!(!equal.iter().any(|e| e.1.contains(&"x2".to_owned())), "{equal:?}");
    let sensor = force.alternatives.iter().find(|a| a.kind == "sensor_offset").unwrap();
    assert!(sensor.separate.contains("rests without force, read off independently"), "{}", sensor.separate);
}
