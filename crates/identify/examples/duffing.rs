//! Prototype over seeds.
#![allow(missing_docs, clippy::print_stdout, clippy::unwrap_used)]
use greybox_identify::{Library, Monomials, Options, Quiet, identify};
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};

fn main() {
    let a: Vec<f64> = std::env::args().skip(1).map(|v| v.parse().unwrap()).collect();
    let (dt, sigma, t, seeds, first) = (a[0], a[1], a[2], a[3] as u64, a[4] as u64);
    let truth = ["x''", "x", "x^3", "x'", "x^2*x'", "x'^3"];
    let (mut exact, mut covered, mut tested) = (0, 0, 0);
    let begin = std::time::Instant::now();
    for seed in first..first + seeds {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let normal = Normal::new(0.0, 1.0).unwrap();
        let n = (t / dt).round() as usize + 1;
        let f: Vec<f64> = (0..n)
            .map(|k| {
                let t = k as f64 * dt;
                10.0 * t.sin() + 40.0 * (4.0 * t).sin() + 0.01 * normal.sample(&mut rng)
            })
            .collect();
        let sub = (dt / 0.001).round() as usize * 2;
        let h = dt / sub as f64;
        let (mut x, mut v) = (0.0, 0.0);
        let mut clean = Vec::with_capacity(n);
        for k in 0..n {
            clean.push(x);
            if k + 1 == n {
                break;
            }
            for s in 0..sub {
                let force = |w: f64| f[k] + (f[k + 1] - f[k]) * ((s as f64 + w) / sub as f64);
                let rate = |x: f64, v: f64, w: f64| {
                    (v, (force(w) - 6.0 * x - 0.1 * x * x * x - v - 0.2 * x * x * v - v * v * v) / 2.0)
                };
                let k1 = rate(x, v, 0.0);
                let k2 = rate(x + 0.5 * h * k1.0, v + 0.5 * h * k1.1, 0.5);
                let k3 = rate(x + 0.5 * h * k2.0, v + 0.5 * h * k2.1, 0.5);
                let k4 = rate(x + h * k3.0, v + h * k3.1, 1.0);
                x += h / 6.0 * (k1.0 + 2.0 * (k2.0 + k3.0) + k4.0);
                v += h / 6.0 * (k1.1 + 2.0 * (k2.1 + k3.1) + k4.1);
            }
        }
        let y: Vec<f64> = clean.iter().map(|x| x + sigma * normal.sample(&mut rng)).collect();
        let time: Vec<f64> = (0..n).map(|k| k as f64 * dt).collect();
        let recording = Recording::from_columns(
            "d.csv",
            time,
            vec![
                Channel { name: "f".into(), unit: None, values: f },
                Channel { name: "x".into(), unit: None, values: y },
            ],
        )
        .unwrap();
        let options = Options {
            library: Library { monomials: Monomials::TotalDegree, constant: true, ..Library::default() },
            order: 3,
            hold: Some(greybox_model::Hold::Linear),
            ..Options::new(&["x"], &["f"])
        };
        let go = std::time::Instant::now();
        let found =
            identify(std::slice::from_ref(&recording), std::slice::from_ref(&recording), &options, &Quiet)
                .unwrap();
        let e = &found.equations[0];
        let names: Vec<String> = e.terms.iter().map(|t| format!("{:.5} {}", t.value, t.expression)).collect();
        let set: Vec<&str> = e.terms.iter().map(|t| t.expression.as_str()).collect();
        let right = [2.0, 6.0, 0.1, 1.0, 0.2, 1.0];
        for (t, r) in truth.iter().zip(right) {
            if let Some(f) = e.terms.iter().find(|f| f.expression == *t) {
                let (a, b) = f.ci95.unwrap();
                covered += usize::from(a <= r && r <= b);
                tested += 1;
            }
        }
        let ok = set.len() == truth.len() && truth.iter().all(|t| set.contains(t));
        exact += usize::from(ok);
        let doubt: Vec<String> =
            e.doubtful.iter().map(|d| format!("{} {:.2}", d.expression, d.inclusion)).collect();
        println!(
            "{seed} {ok} rounds {} segments {} {:.2}s  {} | {}",
            found.rounds,
            found.segments,
            go.elapsed().as_secs_f64(),
            names.join("  "),
            doubt.join(", ")
        );
    }
    println!("== {exact}/{seeds} in {:.1}s; intervals {covered}/{tested}", begin.elapsed().as_secs_f64());
}
