//! The noise floor is a floor: no model is below it, and where fast motion passes for noise the answer says that the noise
//! is not known.

use greybox_diagnose::{Options, Quiet, Verdict, diagnose};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const LAG: &str = r#"
[inputs]
u = { unit = "m/s", hold = "zero" }
[states]
x = { unit = "m" }
[parameters]
a = { value = 0.8, unit = "1/s" }
[equations]
lag = "x' + a*x = u"
"#;

/// x' + x = u, u another random value every 2 s, as often as x is read: a spectrum as flat as noise has. ±`noise` of the
/// motion is the sensor's.
fn record(seed: u64, noise: f64) -> Recording {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let dt = 2.0f64;
    let (mut u, mut y, mut x) = (Vec::new(), Vec::new(), 0.0);
    for _ in 0..400 {
        let held = normal();
        u.push(held);
        y.push(x + noise * normal());
        x = held + (x - held) * (-dt).exp();
    }
    let channel = |name: &str, unit: &str, values| {
        let unit = Some(unit.to_string());
        Channel { name: name.into(), unit, values }
    };
    let time = (0..400).map(|k| f64::from(k) * dt).collect();
    let columns = vec![channel("u", "m/s", u), channel("x", "m", y)];
    Recording::from_columns(&format!("run{seed}.csv"), time, columns).unwrap()
}

#[test]
fn no_model_is_below_the_noise_floor() {
    let model = Model::from_toml(LAG, "lag.toml").unwrap();
    let found =
        diagnose(&model, &[record(1, 0.01)], &[record(2, 0.01)], &Options::default(), &Quiet).unwrap();
    assert_eq!(found.verdict, Verdict::Consistent, "{:?}", found.mechanisms);
    let reached = found.train.calibrated.scores[0].nrmse;
    assert!(reached < 0.02, "{reached}");
    assert!(found.noise_floor[0] <= reached, "{} {reached}", found.noise_floor[0]);
    assert_eq!(found.unknown_noise, [0], "what differences take for noise is motion");
}
