//! From the model of an arm to a regulator behind an observer, and both as functions that can be written as C.

use std::error::Error;

use greybox_control::observer::Form;
use greybox_control::{
    Controller, DesignOptions, Integral, Method, ObserverMethod, OutputFeedback, OutputOptions, Plant,
    PlantOptions, Sensor, design,
};
use greybox_export::{Constant, Function, Group, Member, ObserverCode, ObserverForm, StartForm};
use greybox_model::{Expr, Model};

/// A geared motor turns an arm; θ from hanging down.
pub const ARM: &str = r#"
[inputs]
v = { unit = "V" }
[states]
theta = { unit = "rad" }
[parameters]
J = { value = 0.03, unit = "kg m^2" }
b = { value = 0.12, unit = "N m s/rad" }
fc = { value = 0.02, unit = "N m" }
mgl = { value = 0.8, unit = "N m" }
kt = { value = 0.3, unit = "N m/V" }
vmax = { value = 12, unit = "V" }
[equations]
arm = "J*theta'' + b*theta' + fc*sign(theta') + mgl*sin(theta) = kt*saturate(v, vmax)"
"#;
/// Set points, rad; the regulator is designed in the middle of their range.
pub const SET_POINTS: [f64; 3] = [-0.5, 0.5, 1.5];
/// Sizes of the angle (rad), its rate (rad/s) and the voltage (V): the weights of the regulator, by Bryson's rule.
pub const SIZES: [f64; 3] = [0.3, 4.0, 6.0];
/// Sample time, s.
pub const STEP: f64 = 2e-3;
/// One count of the encoder, rad.
pub const COUNT: f64 = std::f64::consts::TAU / 4096.0;

/// The regulator, and the same behind a Kalman filter of the encoder, whose estimated disturbance is taken off.
///
/// # Errors
/// Where the machine cannot be held at a set point, or a loop is not stable there.
pub fn designed(model: &Model) -> Result<(Controller, OutputFeedback), Box<dyn Error>> {
    let sizes = vec![("theta".to_string(), SIZES[0]), ("theta'".to_string(), SIZES[1])];
    let options = PlantOptions { sizes, input_size: SIZES[2], ..PlantOptions::default() };
    let plant = Plant::of(model, "v", &options)?;
    let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &SET_POINTS, STEP))?;
    let options = OutputOptions {
        method: ObserverMethod::Kalman { disturbance: 2.0 },
        sensors: vec![("theta".into(), Sensor { noise: 0.0, resolution: COUNT })],
        integral: Integral::Disturbance,
    };
    let output = OutputFeedback::new(&law, &options)?;
    Ok((law, output))
}

/// The law and its observer, to be written in a language.
///
/// # Errors
/// Where the observer is no Kalman filter.
pub fn code(law: &Controller, output: &OutputFeedback) -> Result<ObserverCode, Box<dyn Error>> {
    let Form::Kalman { gain, start } = output.observer().form() else {
        return Err("no Kalman filter".into());
    };
    let plant = law.plant();
    let group =
        |name: &str, member: &str| Group { name: name.into(), members: vec![Member::new(member, 0, "SI")] };
    let state = || {
        let members = plant.symbols().iter().map(|(name, primes)| Member::new(name, *primes, "SI"));
        Group { name: "state".into(), members: members.collect() }
    };
    let values = plant.parameters().iter();
    let constants: Vec<Constant> = values.map(|(name, value)| Constant::new(name, *value, "SI")).collect();
    // ẋ = f(x) + g(x) u.
    let (f, g) = plant.frictionless();
    let input = Expr::var(plant.input_name());
    let rates = f.iter().zip(g).map(|(f, g)| (f.clone() + g.clone() * input.clone()).simplify());
    let named = plant.state_names().into_iter().map(|name| format!("rate of {name}"));
    let rate = Function {
        name: "plant_rate".into(),
        summary: vec!["Equations of motion of the arm, friction dropped.".into()],
        arguments: vec![state(), group("command", plant.input_name())],
        constants: constants.clone(),
        outputs: named.zip(rates).collect(),
    };
    let command = Function {
        name: "control_law".into(),
        summary: vec![format!("Voltage of the arm's motor. Call it every {STEP} s and hold the command.")],
        arguments: vec![
            state(),
            group("disturbance", output.disturbance()),
            group("set_point", law.reference()),
        ],
        constants,
        outputs: vec![("voltage, V".into(), output.law().clone())],
    };
    Ok(ObserverCode {
        summary: vec!["Kalman filter of the arm's encoder. Call observer_step once a sample.".into()],
        rate,
        law: command,
        dt: law.dt(),
        measured: output.observer().measured().to_vec(),
        dead_zone: plant.dead_zone(),
        substeps: output.observer().substeps(),
        input_delay: (0, 0.0),
        form: ObserverForm::Kalman {
            gain,
            start: StartForm {
                point: start.point,
                sizes: start.sizes,
                matrix: start.matrix,
                most_steps: start.most_steps,
                last_step: start.last_step,
                close: start.close,
            },
        },
        rest: None,
    })
}
