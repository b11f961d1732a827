//! Prototype over seeds: the delayed oscillator.
#![allow(missing_docs, clippy::print_stdout, clippy::unwrap_used)]
use greybox_identify::{DelayedState, Options, Quiet, identify};
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::{DelayedDuffing, Sampling};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};

fn main() {
    let a: Vec<f64> = std::env::args().skip(1).map(|v| v.parse().unwrap()).collect();
    let (t, seeds, first, known) = (a[0], a[1] as u64, a[2] as u64, a[3] > 0.0);
    let mut errors = vec![];
    for seed in first..first + seeds {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let normal = Normal::new(0.0, 0.01).unwrap();
        let n = (t / 0.001).round() as usize;
        let mut record = |name: &str, start, force: fn(f64) -> f64| {
            let run =
                DelayedDuffing::THESIS.run(Sampling { dt: 0.001, substeps: 1 }, start, n, force).unwrap();
            let time: Vec<f64> = (0..n).map(|k| k as f64 * 0.001).collect();
            let f = time.iter().map(|t| force(*t) + normal.sample(&mut rng)).collect();
            let x = run.iter().map(|s| s[0] + normal.sample(&mut rng)).collect();
            Recording::from_columns(
                name,
                time,
                vec![
                    Channel { name: "f".into(), unit: None, values: f },
                    Channel { name: "x".into(), unit: None, values: x },
                ],
            )
            .unwrap()
        };
        let recs = vec![
            record("train.csv", DelayedDuffing::TRAINING_START, DelayedDuffing::training_force),
            record("test.csv", DelayedDuffing::TEST_START, DelayedDuffing::test_force),
        ];
        let options = Options {
            order: 3,
            hold: Some(greybox_model::Hold::Linear),
            replicates: 0,
            delay: Some(DelayedState { state: "x".into(), gain: known.then_some(2.0), longest: 0.5 }),
            ..Options::new(&["x"], &["f"])
        };
        let go = std::time::Instant::now();
        let found = identify(&recs, &recs[..1], &options, &Quiet).unwrap();
        let names: Vec<String> =
            found.equations[0].terms.iter().map(|t| format!("{:.4} {}", t.value, t.expression)).collect();
        let d = &found.delays[0];
        errors.push((d.value / 0.2 - 1.0).abs() * 100.0);
        println!(
            "{seed} {:.1}s rounds {} tau {:.5} ({:+.2}%) bound {:.2}% gain {:.3} corr {:?} {}",
            go.elapsed().as_secs_f64(),
            found.rounds,
            d.value,
            100.0 * (d.value / 0.2 - 1.0),
            d.bound.unwrap_or(0.0) / 0.2 * 100.0,
            d.gain,
            d.correlation,
            names.join("  ")
        );
    }
    errors.sort_by(f64::total_cmp);
    println!("== median {:.2}% worst {:.2}%", errors[errors.len() / 2], errors[errors.len() - 1]);
}
