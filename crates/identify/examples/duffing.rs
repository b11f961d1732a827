//! Prototype over seeds.
#![allow(missing_docs, clippy::print_stdout, clippy::unwrap_used)]
use greybox_calibrate::Data;
use greybox_identify::output_error::{State, refine};
use greybox_identify::structure::*;
use greybox_model::Hold;
use greybox_recording::{Channel, Recording};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};
use std::sync::Arc;

fn main() {
    let a: Vec<f64> = std::env::args().skip(1).map(|v| v.parse().unwrap()).collect();
    let (dt, sigma, t, seeds, first) = (a[0], a[1], a[2], a[3] as u64, a[4] as u64);
    let truth = ["x''", "x", "x^3", "x'", "x^2*x'", "x'^3"];
    let mut exact = 0;
    let begin = std::time::Instant::now();
    for seed in first..first + seeds {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let normal = Normal::new(0.0, 1.0).unwrap();
        let n = (t / dt).round() as usize + 1;
        let f: Vec<f64> = (0..n).map(|k| { let t = k as f64 * dt; 10.0 * t.sin() + 40.0 * (4.0 * t).sin() + 0.01 * normal.sample(&mut rng) }).collect();
        let sub = (dt / 0.001).round() as usize * 2;
        let h = dt / sub as f64;
        let (mut x, mut v) = (0.0, 0.0);
        let mut clean = Vec::with_capacity(n);
        for k in 0..n {
            clean.push(x);
            if k + 1 == n { break; }
            for s in 0..sub {
                let force = |w: f64| f[k] + (f[k + 1] - f[k]) * ((s as f64 + w) / sub as f64);
                let rate = |x: f64, v: f64, w: f64| (v, (force(w) - 6.0 * x - 0.1 * x * x * x - v - 0.2 * x * x * v - v * v * v) / 2.0);
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
        let recording = Recording::from_columns("d.csv", time, vec![
            Channel { name: "f".into(), unit: None, values: f },
            Channel { name: "x".into(), unit: None, values: y },
        ]).unwrap();
        let mut terms = vec![Term { equation: 0, expression: "x''".into(), parameter: "m".into(), powers: vec![], order: 1, even: false, optional: false }];
        for total in 0..=3u32 { for j in 0..=total { let i = total - j;
            let mut e = Vec::new();
            if i > 0 { e.push(if i == 1 { "x".to_string() } else { format!("x^{i}") }); }
            if j > 0 { e.push(if j == 1 { "x'".to_string() } else { format!("x'^{j}") }); }
            let expression = if e.is_empty() { "1".to_string() } else { e.join("*") };
            terms.push(Term { equation: 0, expression, parameter: format!("g{i}{j}"), powers: vec![], order: total as usize, even: total % 2 == 0, optional: true });
        } }
        let structure = Structure { title: "d".into(), inputs: vec![(Signal { name: "f".into(), unit: None }, Hold::Linear)], states: vec![Signal { name: "x".into(), unit: None }], equations: vec![Equation { name: "eq".into(), input: Some("f".into()) }], terms, extras: vec![] };
        let all = vec![true; structure.terms.len()];
        let zero: Vec<f64> = structure.terms.iter().map(|t| match t.expression.as_str() { "x''" => 1.5, "x" => 4.0, "x'" => 2.0, "x'^3" => 0.5, _ => 0.0 }).collect();
        let active: Vec<bool> = zero.iter().map(|v| *v != 0.0).collect();
        let model = structure.model(&all, &zero, &[]).unwrap();
        let data = Arc::new(Data::new(&model, std::slice::from_ref(&recording)).unwrap());
        let go = std::time::Instant::now();
        let refined = refine(&structure, &data, State { active, values: zero, extras: vec![] }, &all).unwrap();
        let names: Vec<String> = structure.terms.iter().enumerate().filter(|(i, _)| refined.state.active[*i]).map(|(i, t)| format!("{:.5} {}", refined.state.values[i], t.expression)).collect();
        let set: Vec<&str> = structure.terms.iter().enumerate().filter(|(i, _)| refined.state.active[*i]).map(|(_, t)| t.expression.as_str()).collect();
        let ok = set.len() == truth.len() && truth.iter().all(|t| set.contains(t));
        exact += usize::from(ok);
        println!("{seed} {ok} rounds {} method {:?} sigma {:.6} {:.2}s  {}", refined.rounds, refined.setup.method, refined.scale[0], go.elapsed().as_secs_f64(), names.join("  "));
    }
    println!("{exact}/{seeds} in {:.1}s", begin.elapsed().as_secs_f64());
}
