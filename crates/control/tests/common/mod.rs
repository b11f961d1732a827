#![allow(unreachable_pub)]
use greybox_model::Model;
use greybox_simulate::rigs::{RotaryFlexibleLink, VoltageBalance};

pub fn load(text: &str) -> Model {
    Model::from_toml(text, "model.toml").unwrap()
}

/// Thesis Eqs 2.24 and 2.25 with the identified coefficients; `coulomb` scales the friction.
pub fn link(coulomb: f64) -> Model {
    let rig = RotaryFlexibleLink::IDENTIFIED;
    let parameters = |s: &str, b: &VoltageBalance, coulomb: f64| {
        format!(
            "a{s} = {{ value = {} }}\nb{s} = {{ value = {} }}\nbb{s} = {{ value = {} }}\nc{s} = {{ value = {} }}\n\
             cc{s} = {{ value = {} }}\nccc{s} = {{ value = {} }}\nd{s} = {{ value = {} }}\ne{s} = {{ value = {} }}\n\
             ee{s} = {{ value = {} }}\nf{s} = {{ value = {} }}\n",
            b.acceleration,
            b.rate,
            b.rate_cubed,
            b.angle,
            b.angle_squared,
            b.angle_cubed,
            b.deflection_rate,
            b.deflection,
            b.deflection_squared,
            coulomb * b.coulomb
        )
    };
    let row = |s: &str, q: &str| {
        format!(
            "a{s}*{q}'' + b{s}*theta' + bb{s}*theta'^3 + c{s}*theta + cc{s}*theta^2 + ccc{s}*theta^3 + d{s}*alpha' \
             + e{s}*alpha + ee{s}*alpha^2 + f{s}*sign(theta') = v"
        )
    };
    load(&format!(
        "[inputs]\nv = {{ unit = \"V\" }}\n[states]\ntheta = {{ unit = \"rad\" }}\nalpha = {{ unit = \"rad\" }}\n\
         [parameters]\n{}{}[equations]\nhub = \"{}\"\nlink = \"{}\"\n",
        parameters("h", &rig.hub, coulomb),
        parameters("l", &rig.link, coulomb),
        row("h", "theta"),
        row("l", "alpha"),
    ))
}

/// An arm with friction, `excess` of it more at rest than in motion, and a gravity torque `mgl`.
pub fn sticky_arm(friction: f64, excess: f64, mgl: f64) -> Model {
    load(&format!(
        r#"
[inputs]
v = {{ unit = "V" }}
[states]
theta = {{ unit = "rad" }}
[parameters]
J = {{ value = 0.02, unit = "kg m^2" }}
b = {{ value = 0.15, unit = "N m s/rad" }}
fc = {{ value = {friction}, unit = "N m" }}
more = {{ value = {excess}, unit = "1" }}
vs = {{ value = 0.05, unit = "rad/s" }}
mgl = {{ value = {mgl}, unit = "N m" }}
kt = {{ value = 0.4, unit = "N m/V" }}
umax = {{ value = 10.0, unit = "V" }}
[equations]
arm = "J*theta'' + b*theta' + fc*(1 + more*exp(-(theta'/vs)^2))*sign(theta') + mgl*sin(theta) = kt*saturate(v, umax)"
"#
    ))
}

pub const PENDULUM: &str = r#"
[inputs]
tau = { unit = "N m" }
[states]
theta = { unit = "rad" }
[parameters]
J = { value = 0.02, unit = "kg m^2" }
b = { value = 0.01, unit = "N m s/rad" }
mgl = { value = 0.5, unit = "N m" }
lim = { value = 3.0, unit = "N m" }
[equations]
arm = "J*theta'' + b*theta' + mgl*sin(theta) = saturate(tau, lim)"
"#;

pub const CART: &str = r#"
[inputs]
u = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 2.0, unit = "kg", std = 0.2 }
b = { value = 1.0, unit = "N s/m", std = 0.2 }
fc = { value = 1.5, unit = "N", std = 0.3 }
[equations]
cart = "m*x'' + b*x' + fc*sign(x') = u"
"#;
