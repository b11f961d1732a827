//! Simulations by machine code and by the interpreter are the same to the last bit.

#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use greybox_model::{Hold, Model, System};
use greybox_simulate::{Environment, Method, Seeds, Signal, SignalLanes, Simulation};

/// Inputs and parameters of all machines here.
const PARTS: &str = r#"
[inputs]
u = { unit = "N", hold = "linear" }
[parameters]
m = { value = 1.3, unit = "kg" }
k = { value = 4.0, unit = "N/m" }
c = { value = 0.2, unit = "N s/m" }
fc = { value = 0.6, unit = "N" }
drag = { value = 0.2, unit = "kg/m" }
a = { value = 0.5, unit = "m" }
low = { value = -0.3, unit = "N" }
high = { value = 0.2, unit = "N" }
gap = { value = 0.1, unit = "m" }
tau = { value = 0.031, unit = "s" }
"#;

/// One body with dry friction that sticks.
const ONE: &str = r#"
[states]
x = { unit = "m" }
[equations]
first = "m*x'' + drag*x'*abs(x') + k*x + fc*sign(x') = u"
"#;

/// Two, with a play between them and an output that saturates. (The second equation stands first: rows change places.)
const TWO: &str = r#"
[states]
x = { unit = "m" }
y = { unit = "m" }
[equations]
second = "m*y'' + c*y' + k*a*sin(y/a) - k*deadzone(x - y, gap) + table(y/a, [-1, 0, 1], [low, 0, high]) = 0"
first = "m*x'' + m/5*cos(y/a)*y'' + drag*x'*abs(x') + k*deadzone(x - y, gap) + k*x + fc*sign(x') = u"
[measurements]
x = "saturate(x, a)"
y = "y"
"#;

/// Two whose inertias are constants. (Here too rows change places.)
const RIGID: &str = r#"
[states]
x = { unit = "m" }
y = { unit = "m" }
[equations]
second = "m/5*x'' + m*y'' + c*y' + k*(y - x) + fc*sign(y') = 0"
first = "m*x'' + m/5*y'' + drag*x'*abs(x') + k*x + k*(x - y) + fc*sign(x') = u"
"#;

/// Three, of which one stands apart from the others.
const THREE: &str = r#"
[states]
x = { unit = "m" }
y = { unit = "m" }
z = { unit = "m" }
[equations]
first = "m*x'' + k*x + k*(x - y) + fc*sign(x') = u"
second = "m*y'' + m/5*z'' + c*y' + k*(y - x) = 0"
third = "m*z'' + m/5*y'' + c*z' + k*z = u"
"#;

/// Three whose rows change places one after the other, whatever is left of them.
const TURNED: &str = r#"
[states]
x = { unit = "m" }
y = { unit = "m" }
z = { unit = "m" }
[equations]
second = "m/5*x'' + m*y'' + m/4*z'' + c*y' + k*(y - x) + fc*sign(y') = 0"
third = "m/9*x'' + m/8*y'' + m*z'' + c*z' + k*z = u"
first = "m*x'' + m/7*y'' + m/6*z'' + k*x + k*(x - y) + fc*sign(x') = u"
"#;

/// Four: inertias that change on the way, signs of which several stick at once, and a memory (Dahl's friction).
const FOUR: &str = r#"
[states]
x = { unit = "m" }
y = { unit = "m" }
z = { unit = "m" }
s = { unit = "m" }
[equations]
second = "m/5*x'' + m*y'' + c*y' + k*(y - x) + fc*sign(y') = 0"
first = "m*x'' + m/5*cos(y/a)*y'' + k*x + k*(x - y) + k*s + fc*sign(x') = u"
memory = "s' - z'*(1 - s*sign(z')/a) = 0"
third = "m*z'' + m/7*y'' + k*z + fc*sign(z') + fc*sign(z' - x') = u"
"#;

/// Five, of which programs solve none.
const FIVE: &str = r#"
[states]
x = { unit = "m" }
y = { unit = "m" }
z = { unit = "m" }
v = { unit = "m" }
w = { unit = "m" }
[equations]
first = "m*x'' + k*x + k*(x - y) + fc*sign(x') = u"
second = "m*y'' + m/5*z'' + c*y' + k*(y - x) = 0"
third = "m*z'' + m/5*y'' + c*z' + k*z = u"
fourth = "m*v'' + c*v' + k*v + fc*sign(v') = u"
fifth = "m*w'' + m/9*v'' + c*w' + k*w = u"
"#;

/// A rate that was there a while ago.
const DELAYED: &str = r#"
[states]
x = { unit = "m" }
[equations]
first = "m*x'' + c*delay(x', tau) + c*x' + k*x + fc*sign(x') = u"
"#;

fn assert_same_simulation(machine: &str, fewest_events: usize) {
    let text = format!("{PARTS}{machine}");
    let model = Model::from_toml(&text, "machine.toml").unwrap();
    let system = System::compile(&model).unwrap();
    let oracle = system.interpreted();
    let (len, dt) = (600, 0.01);
    let force: Vec<f64> = (0..len).map(|k| 2.5 * (1.9 * dt * k as f64).sin()).collect();
    let environment = Environment {
        start: 0.0,
        dt,
        len,
        inputs: vec![Signal::new(Hold::Linear, dt, &force, |s| s.to_vec())],
        forces: vec![],
    };
    let parameters: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    let x0: Vec<f64> = (0..system.nx).map(|i| 0.4 - 0.3 * i as f64).collect();
    for lanes in [0, 1, 5, 8, 12] {
        let seeds = Seeds {
            parameters: (0..lanes.min(10)).collect(),
            initial: (0..lanes.saturating_sub(10)).collect(),
            signals: Arc::new(SignalLanes::default()),
        };
        for method in [
            Method::Rk4 { substeps: 2 },
            Method::Dop853 { substeps: 1 },
            Method::Adaptive { rtol: 1e-7, atol: 1e-7 },
        ] {
            let of = |system: &System| {
                let simulation = Simulation {
                    system,
                    environment: &environment,
                    parameters: &parameters,
                    method,
                    seeds: &seeds,
                };
                simulation.run(&x0, 0..len)
            };
            let (compiled, interpreted) = (of(&system), of(&oracle));
            assert!(interpreted.events >= fewest_events, "{}", interpreted.events);
            assert!(interpreted.diverged.is_none());
            let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&compiled.x), bits(&interpreted.x), "{method:?}");
            assert_eq!(bits(&compiled.y), bits(&interpreted.y), "{method:?}");
            assert_eq!(bits(&compiled.dy), bits(&interpreted.dy), "{method:?}, {lanes} lanes");
            assert_eq!(
                (compiled.events, compiled.evaluations, compiled.steps),
                (interpreted.events, interpreted.evaluations, interpreted.steps)
            );
        }
    }
}

#[test]
fn machine_code_simulates_what_the_interpreter_does() {
    assert_same_simulation(ONE, 5);
    assert_same_simulation(TWO, 10);
    assert_same_simulation(RIGID, 5);
    assert_same_simulation(THREE, 5);
    assert_same_simulation(TURNED, 5);
    assert_same_simulation(FOUR, 10);
    assert_same_simulation(FIVE, 5);
    assert_same_simulation(DELAYED, 5);
}
