//! The tape, a simulation and its sensitivities, on an oscillator with a cubic spring.
#![allow(missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_model::{Hold, Model, System};
use greybox_simulate::{Environment, Method, Seeds, Signal, Simulation};

const MODEL: &str = r#"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
k1 = { value = 3.0, unit = "1/s^2" }
k3 = { value = 0.05, unit = "1/(m^2 s^2)" }
c1 = { value = 0.5, unit = "1/s" }
c3 = { value = 0.5, unit = "s/m^2" }
b  = { value = 0.5, unit = "1/kg" }
[equations]
motion = "x'' + k1*x + k3*x^3 + c1*x' + c3*x'^3 = b*f"
"#;

fn all(c: &mut Criterion) {
    let model = match Model::from_toml(MODEL, "bench.toml") {
        Ok(model) => model,
        Err(e) => panic!("{e}"),
    };
    let system = match System::compile(&model) {
        Ok(system) => system,
        Err(e) => panic!("{e}"),
    };
    let parameters: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    let tape = &system.rhs;
    let (mut registers, mut modes) = (vec![0.5; tape.registers()], Vec::new());
    registers[system.parameters()..][..system.np].copy_from_slice(&parameters);
    tape.prepare(&mut registers, &mut modes);
    c.bench_function("tape, one evaluation", |b| b.iter(|| tape.eval(&mut registers, &mut modes, &[])));
    let force: Vec<f64> = (0..1000).map(|k| 10.0 * (0.01 * f64::from(k)).sin()).collect();
    let input = Signal::new(Hold::Linear, 0.01, &force, |_| Vec::new());
    let environment = Environment { start: 0.0, dt: 0.01, len: 1000, inputs: vec![input], forces: vec![] };
    let with = Seeds { parameters: (0..5).collect(), initial: vec![0, 1], ..Seeds::default() };
    let without = Seeds::default();
    for (name, seeds) in [("simulation, 1000 samples", &without), ("with 7 sensitivities", &with)] {
        let run = Simulation {
            system: &system,
            environment: &environment,
            parameters: &parameters,
            method: Method::Rk4 { substeps: 1 },
            seeds,
        };
        c.bench_function(name, |b| b.iter(|| run.run(&[1.0, 0.0], 0..1000)));
    }
}

criterion_group!(group, all);
criterion_main!(group);
