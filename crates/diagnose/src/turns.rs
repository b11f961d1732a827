//! Angles that come back to the same place after a turn.
//!
//! Where an angle enters the equations of a machine under sines and cosines alone, q and q + 2π are one configuration. A
//! force that tells them apart (a power of the angle) may follow a recording of small swings, and grows without bound
//! where the machine turns over.

use std::f64::consts::TAU;

use greybox_model::Model;

use crate::candidate::Candidate;
use crate::library::{Mechanism, arbitrary};

/// Points at which equations are compared.
const POINTS: u8 = 16;
/// Rounding.
const SAME: f64 = 1e-9;

/// The angles of a model that come round.
pub(crate) struct Turns<'a> {
    model: &'a Model,
    angles: Vec<String>,
}

impl<'a> Turns<'a> {
    pub(crate) fn of(model: &'a Model) -> Turns<'a> {
        let acts = |q: &&String| model.equations.iter().any(|e| e.residual().contains(q, 0));
        let angles = model.states.iter().map(|s| &s.name).filter(acts).filter(|q| comes_round(model, q));
        Turns { model, angles: angles.cloned().collect() }
    }

    /// Whether the angles that come round do so with a law, too.
    pub(crate) fn admits(&self, candidate: &Candidate, mechanism: &Mechanism) -> bool {
        let mut with = self.model.clone();
        candidate.insert(&mut with, mechanism, &vec![1.0; mechanism.parameters().count()]);
        self.angles.iter().all(|q| comes_round(&with, q))
    }
}

/// Whether all equations hold as before where this state is larger by a turn: by numbers, at several points.
fn comes_round(model: &Model, angle: &str) -> bool {
    (0..POINTS).all(|point| {
        model.equations.iter().all(|equation| {
            let at = |by: f64| {
                let moved = |n: &str, p: u8| if n == angle && p == 0 { by } else { 0.0 };
                equation.residual().eval(&|n, p| Some(arbitrary(point, n, p) + moved(n, p)))
            };
            let Some((before, after)) = at(0.0).zip(at(TAU)) else { return false };
            (after - before).abs() <= SAME * (1.0 + before.abs() + after.abs())
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::candidate::candidates;
    use crate::place::places;

    /// A pendulum on a cart between springs: its angle comes round, the cart's position does not.
    const CRANE: &str = r#"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
q = { unit = "rad" }
[parameters]
m = { value = 1.0, unit = "kg" }
k = { value = 20.0, unit = "N/m" }
p = { value = 0.3, unit = "kg m" }
j = { value = 0.2, unit = "kg m^2" }
g = { value = 9.81, unit = "m/s^2", fixed = true }
[equations]
cart = "m*x'' + p*cos(q)*q'' - p*sin(q)*q'^2 + k*x = f"
arm  = "j*q'' + p*cos(q)*x'' + p*g*sin(q) = 0"
"#;

    #[test]
    fn a_power_of_an_angle_that_comes_round_is_not_admitted() {
        let model = Model::from_toml(CRANE, "crane.toml").unwrap();
        let turns = Turns::of(&model);
        assert_eq!(turns.angles, ["q"]);
        let library = crate::built_in().unwrap();
        let admitted = |kind: &str, equation: &str| {
            let all = candidates(&model, &library, &places(&model));
            let mut here = all.iter().filter(|c| {
                library[c.mechanism].kind == kind && c.place.equations(&model) == [equation.to_owned()]
            });
            here.any(|c| turns.admits(c, &library[c.mechanism]))
        };
        assert!(admitted("cubic_stiffness", "cart") && !admitted("cubic_stiffness", "arm"));
        assert!(admitted("coulomb_friction", "arm") && admitted("cubic_damping", "arm"));
        assert!(!admitted("quadratic_coupling", "cart") && admitted("quadratic_coupling", "arm"));
    }

    /// Of an angle that the equations do not know, nothing says that it comes round.
    #[test]
    fn an_angle_that_does_not_act_may_have_a_spring() {
        let text = "[states]\nq = { unit = \"rad\" }\n[parameters]\nj = { value = 1.0, unit = \"kg m^2\" }\n\
                    [equations]\nwheel = \"j*q'' = 0\"\n";
        let model = Model::from_toml(text, "wheel.toml").unwrap();
        assert!(Turns::of(&model).angles.is_empty());
    }
}
