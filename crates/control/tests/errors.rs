//! What cannot be controlled is refused, with the fix.

use crate::common::{CART, PENDULUM, load};
use greybox_control::{
    ControlError, DesignOptions, Equilibrium, Method, Plant, PlantOptions, design, equilibrium,
};

/// A mass on a spring with one equation replaced, and the input u; other names are at hand.
fn mass(equation: &str) -> Result<Plant, ControlError> {
    mass_with(equation, &PlantOptions::default())
}

fn mass_with(equation: &str, options: &PlantOptions) -> Result<Plant, ControlError> {
    let mut model = load(MASS);
    let (lhs, rhs) = equation.split_once('=').unwrap();
    let side = |text: &str| greybox_model::parse(text).unwrap().expr;
    // Past the loader, whose units are no matter here.
    (model.equations[0].lhs, model.equations[0].rhs) = (side(lhs), side(rhs));
    Plant::of(&model, "u", options)
}

const MASS: &str = r#"
[inputs]
u = {}
w = {}
[states]
x = {}
[parameters]
m = { value = 2.0 }
k = { value = 3.0 }
tau = { value = 0.1, unit = "s" }
[equations]
motion = "m*x'' + k*x + w = u"
"#;

fn said(error: &ControlError, parts: &[&str]) {
    let message = error.to_string();
    for part in parts {
        assert!(message.contains(part), "{message}");
    }
}

fn held(name: &str, value: f64) -> PlantOptions {
    PlantOptions { held: vec![(name.into(), value)], ..PlantOptions::default() }
}

#[test]
fn names_are_checked() {
    let model = load(PENDULUM);
    let error = Plant::of(&model, "v", &PlantOptions::default()).unwrap_err();
    assert!(matches!(error, ControlError::UnknownInput { .. }));
    said(&error, &["`v`", "`tau`"]);
    let sizes =
        |name: &str, size: f64| PlantOptions { sizes: vec![(name.into(), size)], ..PlantOptions::default() };
    let error = Plant::of(&model, "tau", &sizes("phi", 1.0)).unwrap_err();
    said(&error, &["`phi`", "`theta`, `theta'`"]);
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = Plant::of(&model, "tau", &sizes("theta'", bad)).unwrap_err();
        said(&error, &["the size of `theta'`", "positive"]);
    }
    let error = Plant::of(&model, "tau", &held("tau", 1.0)).unwrap_err();
    assert!(matches!(error, ControlError::TwoRoles { .. }));
    assert!(matches!(
        Plant::of(&model, "tau", &held("w", 1.0)).unwrap_err(),
        ControlError::UnknownInput { .. }
    ));
    let plant = Plant::of(&model, "tau", &PlantOptions::default()).unwrap();
    let error = design(&plant, &Method::Lqr, &DesignOptions::new("alpha", &[0.0], 1e-3)).unwrap_err();
    assert!(matches!(error, ControlError::UnknownState { .. }));
    // Edited by hand, so that the loader did not see it.
    let mut edited = model.clone();
    edited.equations[0].lhs = greybox_model::parse("J*theta'' + nobody").unwrap().expr;
    let error = Plant::of(&edited, "tau", &PlantOptions::default()).unwrap_err();
    said(&error, &["arm", "nobody"]);
    edited.equations.clear();
    assert!(matches!(
        Plant::of(&edited, "tau", &PlantOptions::default()).unwrap_err(),
        ControlError::Count { .. }
    ));
}

#[test]
fn models_without_a_control_affine_form_are_refused() {
    let error = mass("m*x'' + k*delay(x, tau) = u").unwrap_err();
    assert!(matches!(error, ControlError::Delay { .. }));
    said(&error, &["\"motion\"", "delay(x, tau)", "leave the delay out"]);
    let error = mass("m*x'' + k*x + 2*sin(3*t) = u").unwrap_err();
    assert!(matches!(error, ControlError::Time { .. }));
    said(&error, &["2*sin(3*t)", "ignore_time_terms"]);
    let error = mass("m*x'' + k*(1 + 0.1*t)*x = u").unwrap_err();
    assert!(matches!(error, ControlError::Drift { .. }));
    for equation in [
        "m*x'' + k*x = u^2",
        "m*x'' + k*x = deadzone(u + 1, 0.1)",
        "m*(1 + u)*x'' = u",
        "m*x'' = saturate(u, x)",
    ] {
        let error = mass(equation).unwrap_err();
        assert!(matches!(error, ControlError::NotAffine { of: "the input", .. }), "{equation}: {error}");
    }
    assert!(matches!(mass("m*x'' + k*x = w").unwrap_err(), ControlError::NoAuthority { .. }));
    let error = mass("(m - 2)*x'' + k*x = u").unwrap_err();
    assert!(matches!(error, ControlError::Singular { .. }), "{error}");
    said(&error, &["`x''`", "inertia"]);
    let error = mass("m*x'' + k*x = max(u, 1)").unwrap_err();
    assert!(matches!(error, ControlError::Limits { .. }), "{error}");
}

#[test]
fn a_singular_mass_matrix_is_found_by_its_numbers() {
    let text = r#"
[inputs]
u = {}
[states]
x = {}
y = {}
[parameters]
a = { value = 1.0 }
b = { value = 2.0 }
c = { value = 4.0 }
[equations]
one = "a*x'' + b*y'' + x = u"
two = "b*x'' + c*y'' + y = 0"
"#;
    let error = Plant::of(&load(text), "u", &PlantOptions::default()).unwrap_err();
    said(&error, &["singular", "`x''`, `y''`"]);
    assert!(Plant::of(&load(&text.replace("4.0", "4.1")), "u", &PlantOptions::default()).is_ok());
}

#[test]
fn disturbances_are_dropped_on_demand_and_told() {
    let options = PlantOptions { ignore_time_terms: true, ..held("w", 0.5) };
    let plant = mass_with("m*x'' + k*x + 2*sin(3*t) = 4*(u + 3*step(t, 1)) + w", &options).unwrap();
    let dropped: Vec<String> =
        plant.dropped().iter().map(|d| format!("{}: {}", d.equation, d.term)).collect();
    assert_eq!(dropped, ["motion: 2*sin(3*t)", "motion: -12*step(t, 1)"]);
    assert_eq!(plant.rate(&[0.0, 0.0], 1.0), [0.0, 2.25]);
    assert_eq!(plant.held(), [("w".to_owned(), 0.5)]);
    let still = PlantOptions { ignore_time_terms: true, ..PlantOptions::default() };
    assert!(matches!(mass_with("m*x'' + k*t*x = u", &still).unwrap_err(), ControlError::Drift { .. }));
}

#[test]
fn designs_that_cannot_work_are_refused() {
    let plant = Plant::of(&load(CART), "u", &PlantOptions::default()).unwrap();
    let good = DesignOptions::new("x", &[0.0, 1.0], 1e-2);
    for (dt, part) in [(0.0, "sample time"), (f64::NAN, "sample time"), (-1.0, "sample time")] {
        said(&design(&plant, &Method::Lqr, &DesignOptions { dt, ..good.clone() }).unwrap_err(), &[part]);
    }
    let refused = |options: DesignOptions, method: Method, parts: &[&str]| {
        said(&design(&plant, &method, &options).unwrap_err(), parts);
    };
    refused(DesignOptions::new("x", &[], 0.01), Method::Lqr, &["one or more"]);
    refused(DesignOptions::new("x", &[f64::INFINITY], 0.01), Method::Lqr, &["set point"]);
    refused(DesignOptions { limit: Some(-1.0), ..good.clone() }, Method::Lqr, &["limit"]);
    let weights = greybox_control::Weights { states: vec![1.0], input: 1.0 };
    refused(DesignOptions { weights: Some(weights), ..good.clone() }, Method::Lqr, &["weights", "needs 2"]);
    let weights = greybox_control::Weights { states: vec![1.0, 1.0], input: 0.0 };
    refused(DesignOptions { weights: Some(weights), ..good.clone() }, Method::Lqr, &["linear design", "R"]);
    refused(good.clone(), Method::Hjb { degree: 1, domain: vec![], bounded: false }, &["degree"]);
    refused(
        good.clone(),
        Method::Hjb { degree: 4, domain: vec![1.0], bounded: false },
        &["domain", "needs 2"],
    );
    refused(good.clone(), Method::Hjb { degree: 4, domain: vec![1.0, -1.0], bounded: false }, &["`x'`"]);
    refused(good.clone(), Method::Smc { lambda: -1.0, eta: 1.0, phi: 1.0 }, &["sliding-mode"]);
    refused(good.clone(), Method::Smc { lambda: 5.0, eta: 1e4, phi: 1.0 }, &["sliding-mode", "sample"]);
    // A command held too long for the loop that it closes.
    refused(DesignOptions { dt: 5.0, ..good.clone() }, Method::Lqr, &["held over 5 s", "would do"]);
    // The velocity cannot be held at a value.
    refused(DesignOptions { tracked: "x'".into(), ..good }, Method::Lqr, &["x' = "]);
    // More than the motor can hold.
    let pendulum =
        Plant::of(&load(&PENDULUM.replace("3.0", "0.3")), "tau", &PlantOptions::default()).unwrap();
    let error = design(&pendulum, &Method::Lqr, &DesignOptions::new("theta", &[1.2], 1e-3)).unwrap_err();
    assert!(matches!(error, ControlError::Unholdable { .. }), "{error}");
    // A second state that the input never reaches, and that runs away.
    let text = "[inputs]\nu = {}\n[states]\nx = {}\ny = {}\n[parameters]\nk = { value = 3.0 }\n[equations]\n\
                one = \"x' + k*x = u\"\ntwo = \"y' - k*y = 0\"\n";
    let plant = Plant::of(&load(text), "u", &PlantOptions::default()).unwrap();
    let error = design(&plant, &Method::Lqr, &DesignOptions::new("x", &[0.0], 1e-3)).unwrap_err();
    assert!(matches!(error, ControlError::Linear { .. }), "{error}");
}

#[test]
fn equilibria_that_are_none_are_refused() {
    let plant = mass("m*x'' + k*x = u").unwrap();
    let origin = Equilibrium::origin(2);
    assert!(matches!(equilibrium(&plant, 2, 0.0, &origin).unwrap_err(), ControlError::Size { .. }));
    assert!(matches!(
        equilibrium(&plant, 0, 0.0, &Equilibrium::origin(3)).unwrap_err(),
        ControlError::Size { .. }
    ));
    assert!(matches!(equilibrium(&plant, 0, f64::NAN, &origin).unwrap_err(), ControlError::Option { .. }));
    // A memory of friction stays where it is: nothing says where.
    let text = "[inputs]\nu = {}\n[states]\nx = {}\nz = { measured = false }\n[parameters]\nm = { value = 2.0 }\n\
                s = { value = 9.0 }\nfc = { value = 1.0 }\n[equations]\nmotion = \"m*x'' + s*z = u\"\n\
                memory = \"z' = x' - s/fc*abs(x')*z\"\n";
    let plant = Plant::of(&load(text), "u", &PlantOptions::default()).unwrap();
    let error = equilibrium(&plant, 0, 0.1, &Equilibrium::origin(3)).unwrap_err();
    assert!(matches!(error, ControlError::SingularEquilibrium { .. }), "{error}");
    said(&error, &["freeze"]);
    let frozen = PlantOptions { frozen: vec![("z".into(), 0.0)], ..PlantOptions::default() };
    let plant = Plant::of(&load(text), "u", &frozen).unwrap();
    assert_eq!(plant.state_names(), ["x", "x'"]);
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("x", &[0.0, 0.5], 1e-2)).unwrap();
    assert!(law.command(&[0.5, 0.0], 0.5).abs() < 1e-9);
    assert!(law.command(&[0.5], 0.5).is_nan() && law.command(&[f64::NAN, 0.0], 0.5).is_nan());
}

#[test]
fn extreme_numbers_are_refused_and_never_panic() {
    let extremes =
        [0.0, -0.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, 1e-300, f64::MIN_POSITIVE];
    let methods = [
        Method::Lqr,
        Method::Hjb { degree: 3, domain: vec![], bounded: false },
        Method::Smc { lambda: 8.0, eta: 20.0, phi: 2.0 },
    ];
    let mut designed = 0;
    for text in [PENDULUM, CART] {
        let model = load(text);
        let (input, tracked) = (model.inputs[0].name.clone(), model.states[0].name.clone());
        for parameter in 0..model.parameters.len() {
            for value in extremes {
                let mut odd = model.clone();
                odd.parameters[parameter].value = value;
                let Ok(plant) = Plant::of(&odd, &input, &PlantOptions::default()) else { continue };
                for method in &methods {
                    let Ok(law) = design(&plant, method, &DesignOptions::new(&tracked, &[0.0, 0.3], 1e-3))
                    else {
                        continue;
                    };
                    designed += 1;
                    let options = greybox_control::LoopOptions::default();
                    let looped = greybox_control::ClosedLoop::new(&odd, &law, &options).unwrap();
                    looped.run(&greybox_control::Reference::step(0.3, 0.05)).unwrap();
                }
            }
        }
        for value in extremes {
            let sized = PlantOptions { sizes: vec![(tracked.clone(), value)], ..PlantOptions::default() };
            let Ok(plant) = Plant::of(&model, &input, &sized) else { continue };
            for method in &methods {
                for set_points in [vec![0.1], vec![value], vec![-0.1, value]] {
                    drop(design(&plant, method, &DesignOptions::new(&tracked, &set_points, 1e-3)));
                }
                drop(design(&plant, method, &DesignOptions::new(&tracked, &[0.1], value)));
            }
        }
    }
    assert!(designed > 20, "{designed}");
}
