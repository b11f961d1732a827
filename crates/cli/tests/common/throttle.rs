//! A spring-loaded throttle with Coulomb friction that grows by 30 % after 150 s, as lines of samples.

use std::fmt::Write as _;

use greybox_simulate::rigs::Throttle;

use crate::noise::Noise;

pub(crate) const MODEL: &str = r#"
name = "throttle"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.03, unit = "N*m*s/rad" }
c = { value = 0.08, unit = "N*m" }
k = { value = 0.7, unit = "N*m/rad" }
[states]
angle = { unit = "rad" }
[equations]
plate = "J*angle'' + b*angle' + c*sign(angle') + k*angle = torque"
"#;

/// Time, torque and measured angle of every sample, 100 a second.
pub(crate) fn samples(seconds: f64) -> Vec<[f64; 3]> {
    const DT: f64 = 0.01;
    const STEPS: usize = 20;
    let mut noise = Noise(5);
    let (mut state, mut torque) = ([0.0, 0.0], 0.0f64);
    let mut out = Vec::new();
    for k in 0..(seconds / DT).round() as usize {
        let t = (DT * k as f64 * 100.0).round() / 100.0;
        if k % 30 == 0 {
            torque = 0.5 * noise.normal();
        }
        let coulomb = if t < 150.0 { 0.1 } else { 0.13 };
        torque = (1e5 * torque).round() / 1e5;
        out.push([t, torque, state[0] + 0.002 * noise.normal()]);
        state = Throttle { coulomb, ..Throttle::NEW }.step(state, torque, DT, STEPS);
    }
    out
}

/// As CSV with a header.
pub(crate) fn csv(samples: &[[f64; 3]]) -> String {
    let mut text = "t,torque [N*m],angle [rad]\n".to_owned();
    for [t, torque, angle] in samples {
        let _ = writeln!(text, "{t},{torque:.5},{angle:.6}");
    }
    text
}
