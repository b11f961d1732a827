//! Prototype over seeds: the flexible link.
#![allow(missing_docs, clippy::print_stdout, clippy::unwrap_used)]
use greybox_identify::{Library, Monomials, Options, Quiet, identify};
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::{
    ProportionalController, RotaryFlexibleLink, Sampling, Sine, multisine, square_wave,
};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};

fn main() {
    let a: Vec<f64> = std::env::args().skip(1).map(|v| v.parse().unwrap()).collect();
    let (dt, sigma, t, seeds, first, amp, order) =
        (a[0], a[1], a[2], a[3] as u64, a[4] as u64, a[5], a[6] as usize);
    let mut exact = [0; 2];
    for seed in first..first + seeds {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let normal = Normal::new(0.0, sigma).unwrap();
        let dither = [0.7, 1.3, 2.9, 4.3, 6.1, 8.9].map(|frequency| Sine {
            amplitude: amp,
            frequency,
            phase: rng.random_range(0.0..std::f64::consts::TAU),
        });
        let n = (t / dt).round() as usize;
        let (mut theta, mut alpha) = (vec![], vec![]);
        let run = RotaryFlexibleLink::IDENTIFIED.run(
            Sampling { dt, substeps: (dt / 0.00025).round() as usize },
            [0.0; 4],
            n,
            |k, angles| {
                let (y0, y1) = (angles[0] + normal.sample(&mut rng), angles[1] + normal.sample(&mut rng));
                theta.push(y0);
                alpha.push(y1);
                let t = k as f64 * dt;
                ProportionalController::THESIS.command(
                    square_wave(30f64.to_radians(), 0.66, t),
                    y0,
                    multisine(&dither, t),
                )
            },
        );
        let run = match run {
            Ok(r) => r,
            Err(e) => {
                println!("{seed}: {e}");
                continue;
            }
        };
        let time: Vec<f64> = (0..n).map(|k| k as f64 * dt).collect();
        let ch = |name: &str, unit: &str, values: Vec<f64>| Channel {
            name: name.into(),
            unit: Some(unit.into()),
            values,
        };
        let recording = Recording::from_columns(
            "link.csv",
            time,
            vec![ch("v", "V", run.voltages), ch("theta", "rad", theta), ch("alpha", "rad", alpha)],
        )
        .unwrap();
        let options = Options {
            library: Library { monomials: Monomials::Separate, friction: true, ..Library::default() },
            order,
            hold: Some(greybox_model::Hold::Zero),
            replicates: 0,
            ..Options::new(&["theta", "alpha"], &["v"])
        };
        let go = std::time::Instant::now();
        let found =
            identify(std::slice::from_ref(&recording), std::slice::from_ref(&recording), &options, &Quiet)
                .unwrap();
        let truth: [&[(&str, f64)]; 2] = [
            &[
                ("theta''", 0.0190),
                ("theta'", 0.6623),
                ("theta'^3", -0.0065),
                ("theta", 0.4151),
                ("theta^2", 0.0933),
                ("theta^3", -1.5354),
                ("alpha'", -0.0420),
                ("alpha", -6.3840),
                ("alpha^2", 5.8953),
                ("sign(theta')", 0.1151),
            ],
            &[
                ("alpha''", -0.0118),
                ("theta'", 0.5890),
                ("theta", 0.7113),
                ("theta^2", 0.0935),
                ("theta^3", -2.7442),
                ("alpha'", -0.0872),
                ("alpha", -13.1712),
                ("alpha^2", 6.2922),
                ("sign(theta')", 0.1474),
            ],
        ];
        println!(
            "{seed} rounds {} segments {} {:.1}s misfit {:?}",
            found.rounds,
            found.segments,
            go.elapsed().as_secs_f64(),
            found.misfit
        );
        for e in 0..2 {
            let set: Vec<&str> = found.equations[e].terms.iter().map(|t| t.expression.as_str()).collect();
            let ok = set.len() == truth[e].len() && truth[e].iter().all(|t| set.contains(&t.0));
            exact[e] += usize::from(ok);
            let names: Vec<String> = found.equations[e]
                .terms
                .iter()
                .map(|t| {
                    let err = truth[e]
                        .iter()
                        .find(|r| r.0 == t.expression)
                        .map_or("FALSE".into(), |r| format!("{:.1}%", 100.0 * (t.value / r.1 - 1.0)));
                    format!("{} {:.4} {err}", t.expression, t.value)
                })
                .collect();
            let missing: Vec<&str> = truth[e].iter().filter(|t| !set.contains(&t.0)).map(|t| t.0).collect();
            println!("  {ok} {} | missing {missing:?}", names.join("  "));
        }
    }
    println!("== exact {exact:?} of {seeds}");
}
