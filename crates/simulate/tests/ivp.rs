//! The integrator with error control on the Test Set for IVP Solvers (Bari, CWI; Hairer, Nørsett & Wanner): as accurate
//! as SciPy at equal tolerance where explicit methods are made for the problem, and told to be stiff elsewhere.
#![allow(missing_docs, clippy::unwrap_used, clippy::print_stdout)]

use std::path::PathBuf;

use greybox_model::{Model, System};
use greybox_simulate::{Environment, MOST_TRIALS, Method, Seeds, Simulation, Trajectory};
use serde_json::Value;

/// The problems, where they are at hand: `$GREYBOX_TRUST`, or beside the repository.
fn problem(id: &str) -> Option<Value> {
    let root = std::env::var_os("GREYBOX_TRUST")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/trust"));
    let Ok(text) = std::fs::read_to_string(root.join("ivp/ivp.json")) else {
        println!("skipped: no initial value problems at ../shared/trust or $GREYBOX_TRUST");
        return None;
    };
    let all: Vec<Value> = serde_json::from_str(&text).unwrap();
    all.into_iter().find(|p| p["id"] == id)
}

fn numbers(v: &Value) -> Vec<f64> {
    serde_json::from_value(v.clone()).unwrap()
}

fn words(v: &Value) -> Vec<&str> {
    v.as_array().unwrap().iter().map(|s| s.as_str().unwrap()).collect()
}

/// The solution from the start to the end of the problem, at `samples` equal intervals.
fn solve(problem: &Value, samples: usize, rtol: f64, atol: f64) -> Trajectory {
    let (states, rates) = (words(&problem["states"]), words(&problem["rhs"]));
    let start = numbers(&problem["y0"]);
    let declared: String = states
        .iter()
        .zip(&start)
        .map(|(s, x)| format!("{s} = {{ unit = \"1\", measured = false, initial = {x} }}\n"))
        .collect();
    let equations: String =
        states.iter().zip(&rates).map(|(s, f)| format!("{s} = \"{s}' = rate*({f})\"\n")).collect();
    let text = format!(
        "[parameters]\nrate = {{ value = 1, unit = \"1/s\", fixed = true }}\n[states]\n{declared}[equations]\n{equations}"
    );
    let model = Model::from_toml(&text, "problem.toml").unwrap();
    let system = System::compile(&model).unwrap();
    let span = numbers(&problem["t"]);
    let environment = Environment {
        start: span[0],
        dt: (span[1] - span[0]) / samples as f64,
        len: samples + 1,
        inputs: Vec::new(),
        forces: Vec::new(),
    };
    let simulation = Simulation {
        system: &system,
        environment: &environment,
        parameters: &[1.0],
        method: Method::Adaptive { rtol, atol },
        seeds: &Seeds::default(),
    };
    simulation.run(&start, 0..samples + 1)
}

/// The largest error at the end, relative to the reference as the peers' is.
fn error(problem: &Value, solution: &Trajectory) -> f64 {
    let reference = numbers(&problem["ref"]);
    let end = |i: usize| solution.x[i * solution.n + solution.n - 1];
    reference
        .iter()
        .enumerate()
        .map(|(i, r)| (end(i) - r).abs() / if *r == 0.0 { 1.0 } else { r.abs() })
        .fold(0.0, f64::max)
}

/// SciPy's DOP853 at the same relative tolerance of 1e-10 ends with errors of 2.1e-8 and 7.3e-4.
#[test]
fn orbits_end_as_near_their_reference_as_with_scipy() {
    for (id, samples, peer) in [("pleiades", 300, 2.1e-8), ("arenstorf", 1000, 7.3e-4)] {
        let Some(problem) = problem(id) else { return };
        let solution = solve(&problem, samples, 1e-10, 1e-12);
        let error = error(&problem, &solution);
        println!("{id}: error {error:.1e} in {} steps, SciPy {peer:.1e}", solution.steps);
        assert!(error <= peer && !solution.is_stiff(), "{id}: {error:e}");
    }
}

/// Mildly stiff chemistry is followed all the same; it takes more steps than its accuracy asks for.
#[test]
fn a_mildly_stiff_problem_is_solved_to_its_tolerance() {
    let Some(problem) = problem("hires") else { return };
    for (rtol, stiff) in [(1e-6, true), (1e-10, false)] {
        let solution = solve(&problem, 1000, rtol, 1e-2 * rtol);
        let error = error(&problem, &solution);
        println!("hires: error {error:.1e} in {} steps at {rtol:e}", solution.steps);
        assert!(error <= rtol, "{error:e}");
        assert_eq!(solution.is_stiff(), stiff);
    }
}

/// What an implicit method is made for is refused, with how fast the fastest mode is.
#[test]
fn stiff_problems_are_refused() {
    for (id, samples) in [("vdpol_stiff", 20), ("rober", 1000)] {
        let Some(problem) = problem(id) else { return };
        for rtol in [1e-6, 1e-10] {
            let solution = solve(&problem, samples, rtol, 1e-2 * rtol);
            let span = numbers(&problem["t"]);
            let dt = (span[1] - span[0]) / samples as f64;
            println!("{id}: given up at sample {:?}, {:.1e} 1/s", solution.exhausted, solution.fastest);
            assert_eq!((solution.exhausted, solution.diverged), (Some(1), Some(1)), "{id}");
            assert!(solution.fastest * dt > 3.25 * MOST_TRIALS as f64, "{id}: {:e}", solution.fastest);
        }
    }
}
