//! The least squares of `calibrate` on the Statistical Reference Datasets for nonlinear regression (StRD) of the
//! National Institute of Standards and Technology: 27 problems, each from two starts, against certified parameters.

use std::path::PathBuf;

use greybox_calibrate::{Fit, FreeParameter, Limits, Point, Prior, Problem, Segment, Work};
use greybox_model::{Hold, Model, System};
use greybox_simulate::{Environment, Method, Signal};
use serde_json::Value;

/// The problems, where they are at hand: `$GREYBOX_TRUST`, or beside the repository.
fn trust() -> Option<PathBuf> {
    let root = std::env::var_os("GREYBOX_TRUST")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/trust"));
    let folder = root.join("nist");
    folder.is_dir().then_some(folder)
}

fn numbers(v: &Value) -> Vec<f64> {
    serde_json::from_value(v.clone()).unwrap()
}

/// A model without motion, whose measurement is the regression's function of its inputs.
fn model(case: &Value) -> Model {
    let inputs: Vec<&str> = case["inputs"].as_array().unwrap().iter().map(|v| v.as_str().unwrap()).collect();
    let lines =
        |of: &dyn Fn(&str) -> String, names: &[&str]| -> String { names.iter().map(|n| of(n)).collect() };
    let parameters: Vec<String> = (1..=numbers(&case["start1"]).len()).map(|i| format!("b{i}")).collect();
    let names: Vec<&str> = parameters.iter().map(String::as_str).collect();
    let text = format!(
        "name = \"{}\"\n[inputs]\n{}[states]\nrest = {{ measured = false, initial = 0 }}\n[parameters]\n{}[equations]\n\
         rest = \"rest' = 0\"\n[measurements]\ny = \"{}\"\n",
        case["id"].as_str().unwrap(),
        lines(&|n| format!("{n} = {{}}\n"), &inputs),
        lines(&|n| format!("{n} = {{ value = 1.0 }}\n"), &names),
        case["expr"].as_str().unwrap()
    );
    Model::from_toml(&text, "regression.toml").unwrap()
}

fn solve(case: &Value, start: &[f64]) -> Fit {
    let system = System::compile(&model(case)).unwrap();
    let x: Vec<Vec<f64>> = case["x"].as_array().unwrap().iter().map(numbers).collect();
    // (Nelson's response is a logarithm, and stands so in the file.)
    let y = numbers(&case["y"]);
    let column = |i: usize| -> Vec<f64> { x.iter().map(|row| row[i]).collect() };
    let inputs =
        (0..x[0].len()).map(|i| Signal::new(Hold::Linear, 1.0, &column(i), |_| Vec::new())).collect();
    let environment = [Environment { start: 0.0, dt: 1.0, len: y.len(), inputs, forces: Vec::new() }];
    let free: Vec<FreeParameter> = (0..start.len())
        .map(|index| FreeParameter {
            index,
            prior: Prior::Flat,
            lower: f64::NEG_INFINITY,
            upper: f64::INFINITY,
        })
        .collect();
    let segments = [Segment { piece: 0, range: 0..y.len() }];
    let size = (y.iter().map(|y| y * y).sum::<f64>() / y.len() as f64).sqrt();
    let problem = Problem {
        system: &system,
        environments: &environment,
        measured: &[&[y]],
        method: Method::Rk4 { substeps: 1 },
        segments: &segments,
        start_priors: &[vec![(0.0, 0.0)]],
        free: &free,
        scale: &[size],
        carried: &[],
        past: &[vec![None]],
        noise: None,
        work: &Work::default(),
    };
    let point = Point { parameters: start.to_vec(), starts: vec![vec![0.0]] };
    problem.fit(point, Limits { iterations: 2000, tolerance: 1e-15 })
}

/// Correct digits of the worst parameter: the log relative error of the StRD.
fn digits(found: &[f64], certified: &[f64]) -> f64 {
    let digits = found.iter().zip(certified).map(|(f, c)| -((f - c) / c).abs().max(1e-11).log10());
    digits.fold(f64::INFINITY, |least, d| if d.is_nan() { 0.0 } else { least.min(d) })
}

#[test]
fn six_certified_digits_on_nearly_all_problems() {
    let Some(folder) = trust() else {
        println!("skipped: no reference data sets at ../shared/trust or $GREYBOX_TRUST");
        return;
    };
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.extension().is_some_and(|e| e == "json"))
        .collect();
    files.sort();
    assert_eq!(files.len(), 27);
    let mut good = 0;
    for file in files {
        let case: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
        let certified = numbers(&case["certified"]);
        let fits = ["start1", "start2"].map(|start| solve(&case, &numbers(&case[start])));
        let [first, second] = fits.each_ref().map(|fit| digits(&fit.point.parameters, &certified));
        println!(
            "{:<10} digits {first:4.1} {second:4.1}  steps {:4} {:4}  {:?} {:?}",
            case["id"].as_str().unwrap(),
            fits[0].iterations,
            fits[1].iterations,
            fits[0].ending,
            fits[1].ending
        );
        good += usize::from(first >= 6.0 && second >= 6.0);
    }
    println!("six digits from both starts: {good} of 27");
    assert!(good >= 26, "{good} of 27");
}
