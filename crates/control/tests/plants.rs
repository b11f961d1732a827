//! Explicit forms of plants, and their limits.

use crate::common::load;
use greybox_control::{
    DesignOptions, Equilibrium, FeedForward, Method, Plant, PlantOptions, design, equilibrium,
};
use greybox_model::System;
use greybox_simulate::{Environment, Method as Integration, Seeds, Signal, integrate};
use nalgebra::{DMatrix, DVector};

/// What the diagnosis of the demo returns, with values of its size.
const DEMO: &str = r#"
[inputs]
v = { unit = "V" }
[states]
theta = { unit = "rad" }
alpha = { unit = "rad" }
[parameters]
Jeq = { value = 0.0021, unit = "kg m^2" }
Jl  = { value = 0.0019, unit = "kg m^2" }
Beq = { value = 0.004, unit = "N m s/rad" }
Bl  = { value = 0.0002, unit = "N m s/rad" }
ks  = { value = 1.3, unit = "N m/rad" }
kc  = { value = 0.05, unit = "N m/rad" }
fc  = { value = 0.02, unit = "N m" }
mc  = { value = 0.0002, unit = "kg m^2" }
kst = { value = 5.0, unit = "N m/rad" }
xst = { value = 0.5, unit = "rad" }
eta = { value = 0.62 }
Kg  = { value = 70.0 }
kt  = { value = 0.00768, unit = "N m/A" }
km  = { value = 0.00768, unit = "V s/rad" }
Rm  = { value = 2.6, unit = "ohm" }
[equations]
hub  = """Jeq*theta'' + Beq*theta' - ks*alpha + kc*(theta - alpha) + fc*sign(theta') \
          + mc*alpha'' + kst*max(theta - xst, 0) \
          = eta*Kg*kt/Rm*(v - Kg*km*theta')"""
link = "Jl*(theta'' + alpha'') + Bl*alpha' + ks*alpha + kc*(alpha - theta) + mc*theta'' = 0"
"#;

/// ẋ by the compiled system, with the mass matrix factored in numbers, signs away from zero.
fn rate(system: &System, parameters: &[f64], x: &[f64], u: &[f64]) -> Vec<f64> {
    let tape = &system.rhs;
    let (mut registers, mut modes) = (vec![0.0; tape.registers()], vec![1i8; tape.switches.len()]);
    registers[System::STATES..System::STATES + system.nx].copy_from_slice(x);
    registers[system.inputs()..system.inputs() + system.nu].copy_from_slice(u);
    registers[system.parameters()..system.parameters() + system.np].copy_from_slice(parameters);
    tape.prepare(&mut registers, &mut modes);
    tape.eval_natural(&mut registers, &mut modes);
    let n = system.nz;
    let value = |i: usize| registers[tape.outputs[i] as usize];
    let mass = DMatrix::from_fn(n, n, |i, j| value(i * n + j));
    let z = mass.lu().solve(&DVector::from_fn(n, |i, _| -value(n * n + i))).unwrap();
    let mut rates = vec![0.0; system.nx];
    for j in 0..n {
        let (at, order) = (system.offsets[j], system.orders[j]);
        for k in 0..order - 1 {
            rates[at + k] = x[at + k + 1];
        }
        rates[at + order - 1] = z[j];
    }
    rates
}

fn agrees(text: &str, input: &str, size: f64) {
    let model = load(text);
    let system = System::compile(&model).unwrap();
    let parameters: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    let options = PlantOptions { smoothing: 1e-6, ..PlantOptions::default() };
    let plant = Plant::of(&model, input, &options).unwrap();
    let at = model.input(input).unwrap();
    for k in 0..60 {
        let x: Vec<f64> = (0..system.nx).map(|i| size * ((3 * k + 7 * i + 1) as f64 * 0.83).sin()).collect();
        let mut u = vec![0.0; system.nu];
        u[at] = 2.0 * (k as f64).cos();
        let exact = rate(&system, &parameters, &x, &u);
        let found = plant.rate(&x, u[at]);
        let scale = exact.iter().fold(1.0f64, |m, v| m.max(v.abs()));
        for (found, exact) in found.iter().zip(&exact) {
            assert!((found - exact).abs() <= 1e-11 * scale, "{found} {exact}");
        }
        // Exact derivatives against differences.
        let tangent = plant.tangent(&x, u[at]);
        for j in 0..x.len() {
            let h = 1e-6;
            let moved = |d: f64| {
                let mut y = x.clone();
                y[j] += d;
                plant.rate(&y, u[at])
            };
            let (above, below) = (moved(h), moved(-h));
            for i in 0..x.len() {
                let slope = (above[i] - below[i]) / (2.0 * h);
                assert!((tangent.a[(i, j)] - slope).abs() < 1e-4 * scale.max(slope.abs()), "{i} {j}");
            }
        }
    }
}

#[test]
fn coupled_coordinates_are_solved_for() {
    agrees(DEMO, "v", 0.8);
    // Three masses of a chain with an inertia between all of them, and an actuator's lag before the first.
    let chain = r#"
[inputs]
u = { unit = "N" }
w = { unit = "N" }
[states]
a = { unit = "m" }
b = { unit = "m" }
c = { unit = "m" }
d = { unit = "m" }
lag = { unit = "N", measured = false }
[parameters]
m = { value = 1.5, unit = "kg" }
n = { value = 0.3, unit = "kg" }
k = { value = 20.0, unit = "N/m" }
e = { value = 0.8, unit = "N s/m" }
tau = { value = 0.05, unit = "s" }
L = { value = 1.0, unit = "m" }
[equations]
one = "(m + n*cos(b/L)^2)*a'' + n*b'' + n*d'' + k*(a - b) + e*a' = lag"
two = "m*b'' + n*a'' - n/2*c'' + k*(b - a) + k*(b - c) + e*b'*abs(b')/(b' + 3*e/e*(L/tau)) = w"
three = "m*c'' - n/2*b'' + n*d'' + k*(c - b) + k*(c - d) = 0"
four = "m*d'' + n*a'' + n*c'' + k*(d - c) = 0"
actuator = "tau*lag' + lag = u"
"#;
    agrees(chain, "u", 0.6);
    agrees(chain, "w", 0.6);
}

#[test]
fn the_demo_is_controlled_by_every_method() {
    let model = load(DEMO);
    let sizes = [("theta", 0.3), ("theta'", 4.0), ("alpha", 0.1), ("alpha'", 3.0)];
    let options = PlantOptions {
        sizes: sizes.iter().map(|(n, s)| ((*n).to_owned(), *s)).collect(),
        input_size: 5.0,
        ..PlantOptions::default()
    };
    let plant = Plant::of(&model, "v", &options).unwrap();
    let mut wanted = DesignOptions::new("theta", &[-0.3, 0.3], 2e-3);
    wanted.limit = Some(10.0);
    // Here the friction is the motor's own: compensating it is stable.
    wanted.compensate_friction = true;
    for method in [
        Method::Lqr,
        Method::Hjb { degree: 4, domain: vec![0.7, 10.0, 0.4, 10.0], bounded: false },
        Method::Smc { lambda: 12.0, eta: 60.0, phi: 1.0 },
    ] {
        let law = design(&plant, &method, &wanted).unwrap_or_else(|e| panic!("{}: {e}", method.name()));
        let looped = greybox_control::ClosedLoop::new(&model, &law, &Default::default()).unwrap();
        let run = looped.run(&greybox_control::Reference::square(0.3, 2.0, 3)).unwrap();
        assert_eq!(run.diverged, None);
        for m in &run.metrics {
            println!("{}: {m:?}", method.name());
            // fc over the stiffness that the law makes.
            assert!(m.final_error.abs() < 0.03, "{}: {m:?}", method.name());
        }
    }
}

#[test]
fn feed_forward_of_kinks_is_a_broken_line() {
    let model = load(DEMO);
    let plant = Plant::of(&model, "v", &PlantOptions::default()).unwrap();
    let origin = Equilibrium::origin(4);
    let smooth = FeedForward::new(&plant, 0, (-0.4, 0.4), &origin, "r").unwrap();
    assert!(smooth.input_error < 1e-9 && smooth.state_error[2] < 1e-9, "{smooth:?}");
    // The stop at 0.5 rad takes 5 N m per rad more.
    let kinked = FeedForward::new(&plant, 0, (0.0, 1.0), &origin, "r").unwrap();
    let at = |r: f64, e: &greybox_model::Expr| e.eval(&|n, _| (n == "r").then_some(r)).unwrap();
    for r in [0.0, 0.3, 0.5, 0.7, 1.0] {
        let exact = equilibrium(&plant, 0, r, &origin).unwrap();
        assert!((at(r, &kinked.input) - exact.input).abs() < 1e-9, "{r}: {kinked:?}");
        assert!((at(r, &kinked.state[2]) - exact.state[2]).abs() < 1e-9);
    }
    // Beyond the range the nearer end holds.
    assert_eq!(at(7.0, &kinked.input), at(1.0, &kinked.input));
    let one = FeedForward::new(&plant, 0, (0.2, 0.2), &origin, "r").unwrap();
    assert_eq!(one.equilibria.len(), 1);
}

#[test]
fn rest_is_rest_in_the_simulator() {
    let model = load(DEMO);
    let system = System::compile(&model).unwrap();
    let plant = Plant::of(&model, "v", &PlantOptions::default()).unwrap();
    for target in [-0.7, 0.2, 0.9] {
        let held = equilibrium(&plant, 0, target, &Equilibrium::origin(4)).unwrap();
        let parameters: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
        let signal = Signal::new(greybox_model::Hold::Zero, 1e-3, &vec![held.input; 500], <[f64]>::to_vec);
        let environment =
            Environment { start: 0.0, dt: 1e-3, len: 500, inputs: vec![signal], forces: vec![] };
        let run = integrate(
            &system,
            &environment,
            &parameters,
            &held.state,
            0..500,
            Integration::Rk4 { substeps: 2 },
            &Seeds::default(),
        );
        for (i, x) in held.state.iter().enumerate() {
            assert!((run.x[i * 500 + 499] - x).abs() < 1e-9, "{target} {i}");
        }
    }
}
