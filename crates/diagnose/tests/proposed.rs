//! What is proposed without a name, and how far it can be trusted.

use greybox_diagnose::diagnosis::{Basis, IdentifiedMechanism};
use greybox_diagnose::{Options, Quiet, Verdict, diagnose};
use greybox_model::{Hold, Model, System, WriteOptions};
use greybox_recording::{Channel, Recording};
use greybox_simulate::{Environment, Method, Seeds, Signal, integrate};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

const DT: f64 = 0.02;
const N: usize = 800;

const NOMINAL: &str = r#"
[inputs]
f = { unit = "N", hold = "linear" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.0, unit = "kg", fixed = true }
b = { value = 0.8, unit = "N s/m" }
k = { value = 20.0, unit = "N/m" }
[equations]
mass = "m*x'' + b*x' + k*x = f"
"#;

/// The machine under a force of this size, with more in its equation and an equation beside it, of parameters p and q.
fn record((more, beside): (&str, &str), [p, q]: [f64; 2], size: f64, seed: u64) -> Recording {
    let memory = if beside.is_empty() { "" } else { "z = {}" };
    let own =
        if more.is_empty() { String::new() } else { format!("p = {{ value = {p} }}\nq = {{ value = {q} }}") };
    let text = format!(
        "[inputs]\nf = {{ hold = \"linear\" }}\n[states]\nx = {{}}\n{memory}\n[parameters]\nm = {{ value = 1 }}\n\
         b = {{ value = 0.7 }}\nk = {{ value = 21 }}\n{own}\n[equations]\nmass = \"m*x'' + b*x' + k*x{more} = f\"\n\
         {beside}\n"
    );
    let truth = Model::from_toml(&text, "truth.toml").unwrap();
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let mut low = 0.0;
    let force: Vec<f64> = (0..N)
        .map(|_| {
            low += 0.1 * (normal() - low);
            4.0 * size * low
        })
        .collect();
    let inputs = vec![Signal::new(Hold::Linear, DT, &force, |_| unreachable!("linear hold"))];
    let environment = Environment { start: 0.0, dt: DT, len: N, inputs, forces: vec![] };
    let p: Vec<f64> = truth.parameters.iter().map(|p| p.value).collect();
    let system = System::compile(&truth).unwrap();
    let method = Method::Dp5 { substeps: 4 };
    let rest = vec![0.0; system.nx];
    let run = integrate(&system, &environment, &p, &rest, 0..N, method, &Seeds::default());
    let x: Vec<f64> = run.x[..N].iter().map(|x| x + 5e-5 * normal()).collect();
    let time = (0..N).map(|k| DT * k as f64).collect();
    let channel =
        |name: &str, unit: &str, values| Channel { name: name.into(), unit: Some(unit.into()), values };
    Recording::from_columns("run.csv", time, vec![channel("f", "N", force), channel("x", "m", x)]).unwrap()
}

/// An input whose effect falls with how large it was.
#[test]
fn an_input_that_fades_is_proposed_with_its_constants() {
    let model = Model::from_toml(NOMINAL, "nominal.toml").unwrap();
    let fading = |size, seed| record((" - p*f*z", "lag = \"z' = q*(abs(f) - z)\""), [-0.2, 1.0], size, seed);
    let (train, held) = ([fading(1.0, 1), fading(1.0, 2)], [fading(1.3, 3)]);
    let found = diagnose(&model, &train, &held, &Options::default(), &Quiet).unwrap();
    let [candidate] = &found.candidates[..] else { panic!("{} candidates", found.candidates.len()) };
    assert_eq!((&*candidate.kind, candidate.input.as_deref()), ("fading_input", Some("f")));
    let value = |name: &str| candidate.parameters.iter().find(|p| p.0 == name).unwrap().2.value;
    assert!(
        (value("cf") / -0.2 - 1.0).abs() < 0.1 && (value("wf") - 1.0).abs() < 0.2,
        "{:?}",
        candidate.parameters
    );
    let [calibrated, improved] =
        [&found.holdout.calibrated, &found.holdout.improved].map(|r| r.scores[0].rmse);
    assert!(improved < 0.2 * calibrated, "{improved} {calibrated}");
}

/// A magnet beside the mass, which no formula of the library is near: the improved model has its force in a table.
#[test]
fn a_force_without_a_formula_is_proposed_as_a_table() {
    let model = Model::from_toml(NOMINAL, "nominal.toml").unwrap();
    let magnet = |size, seed| record((" + p*exp(-((x - q)/q)^2)", ""), [1.5, 0.05], size, seed);
    let train = [magnet(1.2, 11), magnet(1.2, 12), magnet(1.2, 13)];
    let held = [magnet(1.0, 14)];
    let mut library = greybox_diagnose::built_in().unwrap();
    let kinds = [
        "constant_offset",
        "quadratic_stiffness",
        "cubic_stiffness",
        "free_position_force",
        "free_rate_force",
    ];
    library.retain(|m| kinds.contains(&&*m.kind));
    let options = Options { library: Some(library), ..Options::default() };
    let found = diagnose(&model, &train, &held, &options, &Quiet).unwrap();
    assert_eq!(found.verdict, Verdict::Unexplained);
    let kinds: Vec<&str> = found.candidates.iter().map(|c| &*c.kind).collect();
    assert!(kinds.contains(&"free_position_force"), "{kinds:?}");
    let [calibrated, improved] =
        [&found.holdout.calibrated, &found.holdout.improved].map(|r| r.scores[0].rmse);
    assert!(improved < 0.1 * calibrated, "{improved} {calibrated}");
    // Its equation, written and read again, has the force.
    let improved =
        Model::from_toml(&found.improved.to_toml(&WriteOptions::default()), "improved.toml").unwrap();
    let residual = improved.equations[0].residual();
    for i in -5..=5 {
        let x = 0.03 * f64::from(i);
        let of = |name: &str, primes: u8| match (name, primes) {
            ("x", 0) => Some(x),
            ("x" | "f", _) => Some(0.0),
            _ => improved.parameter(name).map(|i| improved.parameters[i].value),
        };
        let (force, truth) =
            (residual.eval(&of).unwrap(), 21.0 * x + 1.5 * (-((x - 0.05) / 0.05).powi(2)).exp());
        assert!((force - truth).abs() < 0.15, "{x}: {force} {truth}");
    }
}

#[test]
fn a_brake_without_a_name_is_proposed_with_its_validity() {
    let model = Model::from_toml(NOMINAL, "nominal.toml").unwrap();
    let brake = |size, seed| record((" + p*x'/(1 + (x'/q)^2)", ""), [3.0, 0.15], size, seed);
    let (train, held) = ([brake(1.0, 1)], [brake(1.6, 2)]);
    let found = diagnose(&model, &train, &held, &Options::default(), &Quiet).unwrap();
    assert_eq!((found.verdict, found.basis), (Verdict::Unexplained, Basis::Proposed));
    let [candidate] = &found.candidates[..] else { panic!("{} candidates", found.candidates.len()) };
    assert_eq!(candidate.kind, "eddy_current_damping");
    assert!(candidate.states.is_empty());
    let proposal = found.proposal.unwrap();
    // The force depends on the speed, which the stronger drive takes beyond what is known.
    let [range] = &proposal.ranges[..] else { panic!("{:?}", proposal.ranges) };
    assert_eq!(range.variable, "x'");
    assert!(range.low < -0.2 && range.high > 0.2, "{range:?}");
    assert_eq!(range.outside, proposal.outside);
    assert!((0.001..0.3).contains(&proposal.outside), "{}", proposal.outside);
    // A single recording of 16 s: four blocks of its second half.
    assert_eq!(proposal.folds.len(), 4);
    for (k, fold) in proposal.folds.iter().enumerate() {
        let (from, to) = fold.window.unwrap();
        assert!((from - (8.0 + 2.0 * k as f64)).abs() < 0.1 && (to - from - 2.0).abs() < 0.1, "{fold:?}");
        assert_eq!(fold.recordings, ["run.csv"]);
        assert!(fold.improved < 0.5 * fold.calibrated, "{fold:?}");
    }
    // The brake is a damper at small speed.
    let (strength, with) = &proposal.correlations[0];
    assert_eq!((strength.as_str(), with.parameter.as_str()), ("bs", "b"));
    assert!((0.3..0.99).contains(&with.correlation.abs()), "{with:?}");
}

#[test]
fn a_memory_is_told_with_its_equation() {
    let model = Model::from_toml(NOMINAL, "nominal.toml").unwrap();
    let spring = |size, seed| record((" + p*(x - z)", "z = \"z' = q*(x - z)\""), [12.0, 4.0], size, seed);
    let (train, held) = ([spring(1.0, 3), spring(1.0, 4)], [spring(1.0, 5)]);
    let found = diagnose(&model, &train, &held, &Options::default(), &Quiet).unwrap();
    let candidate = found.candidates.iter().find(|c| c.kind == "maxwell_element").expect("a Maxwell element");
    assert_eq!(candidate.expression, "km*(x - z)");
    assert_eq!(candidate.states, [("z".to_owned(), "z' = wm*(x - z)".to_owned())]);
    // Of two recordings each is predicted by the other, and judged in halves.
    let proposal = found.proposal.unwrap();
    let windows = proposal.folds.iter().map(|fold| fold.window.unwrap());
    let wanted = [(0.0, 8.0), (8.0, 16.0), (0.0, 8.0), (8.0, 16.0)];
    assert!(windows.zip(wanted).all(|(a, b)| (a.0 - b.0).abs() < 0.1 && (a.1 - b.1).abs() < 0.1));
    assert_eq!(proposal.folds.len(), 4);
    assert!(proposal.folds.iter().all(|fold| fold.improved < fold.calibrated));
}

#[test]
fn nothing_is_proposed_where_nothing_is_missing() {
    let model = Model::from_toml(NOMINAL, "nominal.toml").unwrap();
    let (train, held) = ([record(("", ""), [0.0; 2], 1.0, 6)], [record(("", ""), [0.0; 2], 1.0, 7)]);
    for terms_only in [false, true] {
        let options = Options { terms_only, ..Options::default() };
        let found = diagnose(&model, &train, &held, &options, &Quiet).unwrap();
        assert_eq!((found.verdict, found.terms_only), (Verdict::Consistent, terms_only));
        assert!(found.proposal.is_none() && found.candidates.is_empty());
    }
}

/// What has a name is a term like any other where no name is asked for.
#[test]
fn terms_alone_are_never_named() {
    let model = Model::from_toml(NOMINAL, "nominal.toml").unwrap();
    let spring = |size, seed| record((" + p*x^3", ""), [300.0, 0.0], size, seed);
    let (train, held) = ([spring(1.0, 8)], [spring(1.0, 9)]);
    let found = |terms_only| {
        diagnose(&model, &train, &held, &Options { terms_only, ..Options::default() }, &Quiet).unwrap()
    };
    let named = found(false);
    assert_eq!((named.verdict, named.basis), (Verdict::MissingPhysics, Basis::Named));
    let terms = found(true);
    assert_eq!((terms.verdict, terms.basis), (Verdict::Unexplained, Basis::Proposed));
    assert!(terms.mechanisms.is_empty());
    let of = |found: &[IdentifiedMechanism]| {
        let [one] = found else { panic!("{} terms", found.len()) };
        (one.kind.clone(), one.parameters[0].2.value)
    };
    let (reported, term) = (of(&named.mechanisms), of(&terms.candidates));
    assert_eq!((&*reported.0, &*term.0), ("cubic_stiffness", "cubic_stiffness"));
    assert!(
        (term.1 / 300.0 - 1.0).abs() < 0.02 && (reported.1 / term.1 - 1.0).abs() < 0.01,
        "{reported:?} {term:?}"
    );
}
