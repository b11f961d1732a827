//! Stretches that go on from one another against the run that was never cut.
#![allow(missing_docs, clippy::unwrap_used)]

mod common;
use common::*;
use greybox_model::{Hold, Model, System};
use greybox_simulate::{
    Carry, Environment, Method, Seeds, SignalLanes, Simulation, delayed_states, has_history,
};

struct Case {
    name: &'static str,
    model: Model,
    /// Entries of the state vector that no sensor sees.
    hidden: Vec<usize>,
    x0: Vec<f64>,
    method: Method,
}

fn cases() -> Vec<Case> {
    let bouc_wen = model(
        &["f"],
        &[("x", 2), ("z", 1)],
        &[("c", 0.4), ("k", 6.0), ("a", 9.0), ("be", 1.3), ("ga", 0.6)],
        &["x'' + c*x' + k*x + z = f", "z' = a*x' - be*abs(x')*z - ga*x'*abs(z)"],
        &["x"],
    );
    let lag = model(
        &["f"],
        &[("x", 2), ("u", 1)],
        &[("c", 0.4), ("k", 6.0), ("ta", 0.15)],
        &["x'' + c*x' + k*x = u", "ta*u' + u = f"],
        &["x"],
    );
    let feedback = model(
        &["f"],
        &[("x", 2)],
        &[("c", 0.8), ("k", 6.0), ("g", 1.7), ("tau", 0.137)],
        &["x'' + c*x' + k*x + g*delay(x, tau) = f"],
        &["x"],
    );
    // An expression of the state, delayed twice over, read by a sensor that is late as well.
    let late = model(
        &["f"],
        &[("x", 2)],
        &[("c", 0.8), ("k", 6.0), ("g", 0.3), ("tau", 0.211), ("td", 0.083)],
        &["x'' + c*x' + k*x + g*delay(x*x', tau) = f"],
        &["delay(x, td)", "delay(x + 0.1*x', 2*td) + f"],
    );
    let sensor = model(
        &["f"],
        &[("x", 2)],
        &[("c", 0.4), ("k", 6.0), ("td", 0.083)],
        &["x'' + c*x' + k*x = f"],
        &["delay(x, td)"],
    );
    let rk4 = Method::Rk4 { substeps: 1 };
    let hidden = vec![2];
    vec![
        Case {
            name: "Bouc–Wen",
            model: bouc_wen.clone(),
            hidden: hidden.clone(),
            x0: vec![0.2, 0.0, 0.3],
            method: rk4,
        },
        Case {
            name: "Bouc–Wen, adaptive",
            model: bouc_wen,
            hidden: hidden.clone(),
            x0: vec![0.2, 0.0, 0.3],
            method: Method::Adaptive { rtol: 1e-8, atol: 1e-9 },
        },
        Case { name: "lag", model: lag, hidden, x0: vec![0.2, 0.0, 0.3], method: rk4 },
        Case {
            name: "delayed feedback",
            model: feedback,
            hidden: vec![],
            x0: vec![0.2, 0.0],
            method: Method::Dp5 { substeps: 2 },
        },
        Case {
            name: "late sensor and feedback",
            model: late,
            hidden: vec![],
            x0: vec![0.2, 0.1],
            method: rk4,
        },
        Case { name: "late sensor", model: sensor, hidden: vec![], x0: vec![0.2, 0.1], method: rk4 },
    ]
}

const N: usize = 240;
const DT: f64 = 0.02;
const CUTS: [usize; 4] = [0, 97, 160, N];

fn environment() -> Environment {
    let u: Vec<f64> = (0..N)
        .map(|k| {
            let t = k as f64 * DT;
            3.0 * (2.1 * t).sin() + 2.0 * (0.7 * t * t).cos()
        })
        .collect();
    driven(Hold::Linear, DT, &u)
}

/// Outputs and sensitivities of the stretches put together: `[lane][channel][sample]`, lane 0 the
/// output. `starts` are the initial states of the stretches.
fn in_stretches(
    case: &Case,
    parameters: &[f64],
    starts: &[Vec<f64>],
    carried: &[usize],
    seeds: &Seeds,
    keep: bool,
) -> Vec<Vec<Vec<f64>>> {
    let system = System::compile(&case.model).unwrap();
    let environment = environment();
    let simulation =
        Simulation { system: &system, environment: &environment, parameters, method: case.method, seeds };
    let lanes = seeds.lanes();
    let mut out = vec![vec![Vec::new(); system.ny]; 1 + lanes];
    let mut before: Option<Carry> = None;
    for (i, x0) in starts.iter().enumerate() {
        let range = CUTS[i]..CUTS[i + 1];
        let (t, carry) = simulation.run_on(x0, range.clone(), before.as_ref(), carried);
        assert_eq!(carry.sample(), range.end.min(N - 1));
        for c in 0..system.ny {
            out[0][c].extend(&t.y[c * t.n..(c + 1) * t.n]);
            for l in 0..lanes {
                out[1 + l][c].extend(&t.dy[(l * system.ny + c) * t.n..][..t.n]);
            }
        }
        before = keep.then_some(carry);
    }
    out
}

fn worst(a: &[Vec<f64>], b: &[Vec<f64>]) -> f64 {
    let size = b.iter().flatten().fold(1e-12f64, |m, v| m.max(v.abs()));
    a.iter().flatten().zip(b.iter().flatten()).fold(0.0f64, |m, (a, b)| m.max((a - b).abs())) / size
}

#[test]
fn a_cut_run_whose_measured_states_start_where_they_were_is_the_whole_run() {
    for case in cases() {
        let system = System::compile(&case.model).unwrap();
        let environment = environment();
        let p: Vec<f64> = case.model.parameters.iter().map(|p| p.value).collect();
        let seeds = Seeds { parameters: (0..p.len()).collect(), ..Seeds::default() };
        let simulation = Simulation {
            system: &system,
            environment: &environment,
            parameters: &p,
            method: case.method,
            seeds: &seeds,
        };
        let whole = simulation.run(&case.x0, 0..N);
        let part = |from: &[f64], l: usize| -> Vec<Vec<f64>> {
            (0..system.ny).map(|c| from[(l * system.ny + c) * N..][..N].to_vec()).collect()
        };
        let starts: Vec<Vec<f64>> = CUTS[..3]
            .iter()
            .map(|&k| {
                let mut x: Vec<f64> = (0..system.nx).map(|i| whole.x[i * N + k]).collect();
                if k > 0 {
                    // What is carried is not read here.
                    case.hidden.iter().for_each(|&i| x[i] = f64::NAN);
                }
                x
            })
            .collect();
        let cut = in_stretches(&case, &p, &starts, &case.hidden, &seeds, true);
        let error = worst(&cut[0], &part(&whole.y, 0));
        assert!(error < 1e-11, "{}: {error:.1e}", case.name);

        // The same without memory is another run.
        let mut plain = starts.clone();
        for x in &mut plain {
            case.hidden.iter().for_each(|&i| x[i] = 0.0);
        }
        let forgetful = in_stretches(&case, &p, &plain, &case.hidden, &seeds, false);
        let error = worst(&forgetful[0], &part(&whole.y, 0));
        assert!(error > 1e-3, "{}: {error:.1e}", case.name);

        // With everything carried the sensitivities are those of the whole run.
        let all: Vec<usize> = (0..system.nx).collect();
        let mut starts = vec![vec![f64::NAN; system.nx]; 3];
        starts[0] = case.x0.clone();
        let cut = in_stretches(&case, &p, &starts, &all, &seeds, true);
        for l in 0..p.len() {
            let error = worst(&cut[1 + l], &part(&whole.dy, l));
            assert!(error < 1e-11, "{} {}: {error:.1e}", case.name, case.model.parameters[l].name);
        }
    }
}

#[test]
fn sensitivities_of_the_cut_run_are_its_differences() {
    for case in cases() {
        let system = System::compile(&case.model).unwrap();
        let p: Vec<f64> = case.model.parameters.iter().map(|p| p.value).collect();
        let np = p.len();
        let seeds = Seeds { parameters: (0..np).collect(), initial: vec![0, 1], ..Seeds::default() };
        // Starts that are no continuation, as in a fit that has not converged.
        let starts: Vec<Vec<f64>> = (0..3)
            .map(|i| (0..system.nx).map(|j| 0.2 - 0.15 * i as f64 + 0.1 * j as f64).collect())
            .collect();
        let cut = in_stretches(&case, &p, &starts, &case.hidden, &seeds, true);
        let differences = |shift: &dyn Fn(f64) -> (Vec<f64>, Vec<Vec<f64>>), h: f64| -> Vec<Vec<f64>> {
            let run = |sign: f64| {
                let (p, starts) = shift(sign * h);
                in_stretches(&case, &p, &starts, &case.hidden, &Seeds::default(), true).swap_remove(0)
            };
            run(1.0)
                .iter()
                .zip(&run(-1.0))
                .map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a - b) / (2.0 * h)).collect())
                .collect()
        };
        // The past is a cubic between steps, or samples for a late sensor, its sensitivities are linear.
        let limit = if system.output.delays.is_empty() { 2e-4 } else { 2e-2 };
        for l in 0..np {
            let shift = |h: f64| {
                let mut p = p.clone();
                p[l] += h;
                (p, starts.clone())
            };
            let numeric = differences(&shift, 1e-6);
            let error = worst(&cut[1 + l], &numeric);
            assert!(error < limit, "{} {}: {error:.1e}", case.name, case.model.parameters[l].name);
        }
        // A stretch's own initial state: later stretches have no lane for it.
        for j in 0..2 {
            let shift = |h: f64| {
                let mut starts = starts.clone();
                starts[0][j] += h;
                (p.clone(), starts)
            };
            let numeric: Vec<Vec<f64>> =
                differences(&shift, 1e-6).iter().map(|c| c[..CUTS[1]].to_vec()).collect();
            let own: Vec<Vec<f64>> = cut[1 + np + j].iter().map(|c| c[..CUTS[1]].to_vec()).collect();
            let error = worst(&own, &numeric);
            assert!(error < limit, "{} start {j}: {error:.1e}", case.name);
        }
    }
}

/// Signals go on, a carried state has no initial value of its own, and what does not fit is not used.
#[test]
fn lanes_of_signals_go_on_and_those_of_carried_starts_are_zero() {
    let case = &cases()[2];
    let system = System::compile(&case.model).unwrap();
    let environment = environment();
    let p: Vec<f64> = case.model.parameters.iter().map(|p| p.value).collect();
    let force: Vec<f64> = (0..N).map(|k| if (20..90).contains(&k) { 1.0 } else { 0.0 }).collect();
    let signals = SignalLanes { lanes: 1, weights: vec![0.0, 1.0], force, ..SignalLanes::default() }.into();
    let seeds = Seeds { parameters: vec![2], initial: vec![0, 1, 2], signals };
    let simulation = Simulation {
        system: &system,
        environment: &environment,
        parameters: &p,
        method: case.method,
        seeds: &seeds,
    };
    let whole = simulation.run(&case.x0, 0..N);
    let (_, carry) = simulation.run_on(&case.x0, 0..97, None, &[]);
    let (rest, last) = simulation.run_on(&[f64::NAN; 3], 97..N, Some(&carry), &[0, 1, 2]);
    let lane = |t: &greybox_simulate::Trajectory, l: usize| t.dy[l * t.n..(l + 1) * t.n].to_vec();
    let tail = lane(&whole, 4)[97..].to_vec();
    assert!(worst(&[lane(&rest, 4)], &[tail]) < 1e-12);
    for l in 1..4 {
        assert!(lane(&rest, l).iter().all(|v| *v == 0.0));
    }
    assert_eq!(last.sample(), N - 1);
    assert_eq!(last.state(), [0, 1, 2].map(|i| whole.x[i * N + N - 1]));
    // A carry that does not belong here.
    let x0 = [0.1, 0.2, 0.3];
    assert_eq!(simulation.run_on(&x0, 96..N, Some(&carry), &[0]).0.y, simulation.run(&x0, 96..N).y);
}

#[test]
fn a_stretch_that_diverges_leaves_its_last_good_state() {
    let m = model(&[], &[("x", 1)], &[("a", 30.0)], &["x' = a*x*x"], &["x"]);
    let system = System::compile(&m).unwrap();
    let environment = free(60, 0.01);
    let seeds = Seeds { parameters: vec![0], ..Seeds::default() };
    let simulation = Simulation {
        system: &system,
        environment: &environment,
        parameters: &[30.0],
        method: Method::Rk4 { substeps: 1 },
        seeds: &seeds,
    };
    let (t, carry) = simulation.run_on(&[1.0], 0..30, None, &[]);
    assert!(t.diverged.is_some());
    assert_eq!(carry.state(), [t.y[29]]);
    assert!(carry.state()[0].is_finite());
    let (t, _) = simulation.run_on(&[0.0], 30..60, Some(&carry), &[0]);
    assert!(t.y.iter().chain(&t.dy).all(|v| v.is_finite()));
    // An empty stretch hands on where it stands.
    let (t, carry) = simulation.run_on(&[0.5], 7..7, None, &[]);
    assert_eq!((t.n, carry.sample(), carry.state()), (0, 7, &[0.5][..]));
}

/// A stretch that is told where a delayed state was goes on as if it had never been cut; told nothing, it believes
/// that the state had always been where it starts.
#[test]
fn a_remembered_past_stands_in_for_the_stretch_before() {
    let case = cases().into_iter().find(|c| c.name == "delayed feedback").unwrap();
    let system = System::compile(&case.model).unwrap();
    assert_eq!(delayed_states(&system), [0]);
    let environment = environment();
    let parameters: Vec<f64> = case.model.parameters.iter().map(|p| p.value).collect();
    // A direction of the start, to see that the past has none.
    let seeds = Seeds { initial: vec![0], ..Seeds::default() };
    let simulation = Simulation {
        system: &system,
        environment: &environment,
        parameters: &parameters,
        method: case.method,
        seeds: &seeds,
    };
    let whole = simulation.run(&case.x0, 0..N);
    let (position, rate) = whole.x.split_at(N);
    let cut = 97;
    let x0 = [position[cut], rate[cut]];
    let past = |values| Carry::remembered(&system, cut, DT, &[values, None]);
    let off = |before: Option<&Carry>| {
        let (t, _) = simulation.run_on(&x0, cut..N, before, &[]);
        t.y.iter().zip(&whole.y[cut..]).fold(0.0f64, |m, (a, b)| m.max((a - b).abs()))
    };
    let size = whole.y.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let (reported, untold, unknown) =
        (off(Some(&past(Some(&position[..=cut])))), off(None), off(Some(&past(None))));
    // Slopes by central differences are off by dt² x‴/6.
    assert!(reported < 1e-4 * size, "{reported}");
    assert!(untold > 100.0 * reported, "{untold} {reported}");
    assert_eq!(untold, unknown);
    // A past shorter than the delay holds its first value.
    let short = off(Some(&past(Some(&position[cut - 3..=cut]))));
    assert!(reported < short && short < untold, "{short}");
}

#[test]
fn only_delays_of_more_than_an_input_have_a_history() {
    let of = |equation: &str, measured: &str| {
        let m = model(&["f"], &[("x", 1)], &[("a", 1.0), ("tau", 0.1)], &[equation], &[measured]);
        has_history(&System::compile(&m).unwrap())
    };
    assert!(!of("x' + a*x = delay(f, tau)", "x"));
    assert!(of("x' + a*delay(x, tau) = f", "x"));
    assert!(of("x' + a*x = f", "delay(x, tau)"));
}
