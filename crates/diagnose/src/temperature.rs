//! The zero of the temperature scale.
//!
//! Kelvin and degrees Celsius differ by a convention. Equations that know only differences of temperatures,
//! C T′ = (Tₒ − T)/R + P, hold on either scale, and what is added to them must too: the cube of a temperature, a
//! threshold that lies about zero, or a gain in front of a thermometer's reading would be fitted otherwise to the same
//! recording in another unit.

use greybox_model::{Dimension, Expr, Measurement, Model, Unit};

use crate::candidate::Candidate;
use crate::library::{Mechanism, arbitrary};

/// Most parameters that are temperatures, each of which may be one on the scale or a difference.
const MOST: usize = 8;
/// Points at which equations are compared.
const POINTS: u8 = 16;
/// How far the scale is moved, K.
const SHIFT: f64 = 0.83;
/// Rounding.
const SAME: f64 = 1e-9;

/// Which candidates hold on any scale of temperature that the model's own equations hold on; all of them where it has no
/// temperatures, or equations that hold on one scale alone.
pub(crate) struct AnyScale<'a> {
    model: &'a Model,
    /// Parameters of the model that are temperatures on the scale, where its equations hold on any.
    moved: Option<Vec<String>>,
}

impl<'a> AnyScale<'a> {
    pub(crate) fn of(model: &'a Model) -> AnyScale<'a> {
        let temperatures = model.states.iter().map(|s| &s.unit).chain(model.inputs.iter().map(|u| &u.unit));
        let any = temperatures.into_iter().any(is_temperature);
        AnyScale { model, moved: any.then(|| moved(model, 0, &[])).flatten() }
    }

    pub(crate) fn admits(&self, candidate: &Candidate, mechanism: &Mechanism) -> bool {
        let Some(moved_alone) = &self.moved else { return true };
        if mechanism.absolute {
            return true;
        }
        let mut with = self.model.clone();
        candidate.insert(&mut with, mechanism, &vec![1.0; mechanism.parameters().count()]);
        with.resolve_units().is_err() || moved(&with, self.model.parameters.len(), moved_alone).is_some()
    }
}

fn is_temperature(unit: &Unit) -> bool {
    unit.dimension.same(&Dimension::TEMPERATURE)
}

/// The parameters that move with the scale of temperature where all equations and measurements then hold as before, if
/// there are such: of those from index `first` any, of those before it these.
fn moved(model: &Model, first: usize, before: &[String]) -> Option<Vec<String>> {
    let open: Vec<&String> = model.parameters[first..]
        .iter()
        .filter(|p| p.unit.as_ref().is_some_and(is_temperature))
        .map(|p| &p.name)
        .collect();
    if open.len() > MOST {
        return None;
    }
    (0..1usize << open.len()).find_map(|set| {
        let chosen = open.iter().enumerate().filter(|(i, _)| set >> i & 1 == 1).map(|(_, n)| (*n).clone());
        let all: Vec<String> = before.iter().cloned().chain(chosen).collect();
        holds(model, &all).then_some(all)
    })
}

/// Whether every equation has the same residual, and every measured temperature has moved along, where the temperatures
/// and these parameters have moved: by numbers, at several points.
fn holds(model: &Model, parameters: &[String]) -> bool {
    let moves = |name: &str, primes: u8| {
        let state = model.state(name).map(|i| &model.states[i].unit);
        let signal = state.or_else(|| model.input(name).map(|i| &model.inputs[i].unit));
        primes == 0 && (signal.is_some_and(is_temperature) || parameters.iter().any(|p| p == name))
    };
    let at = |point: u8, expr: &Expr, by: f64| {
        expr.eval(&|n, p| Some(arbitrary(point, n, p) + if moves(n, p) { by } else { 0.0 }))
    };
    let differs = |point: u8, expr: &Expr, by: f64| {
        let Some((before, after)) = at(point, expr, 0.0).zip(at(point, expr, SHIFT)) else { return false };
        let far = (after - before - by).abs() > SAME * (1.0 + before.abs() + after.abs());
        far && before.is_finite() && after.is_finite()
    };
    (0..POINTS).all(|point| {
        let equations = model.equations.iter().all(|e| !differs(point, &e.residual(), 0.0));
        let measured = |m: &Measurement| {
            let by = if is_temperature(&m.unit) { SHIFT } else { 0.0 };
            !differs(point, &m.expr, by)
        };
        equations && model.measurements.iter().all(measured)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::candidate::candidates;
    use crate::place::places;

    const ROOM: &str = r#"
[inputs]
P  = { unit = "kW" }
To = { unit = "K" }
[states]
T = { unit = "K" }
[parameters]
C  = { value = 9.0, unit = "kW h/K" }
R  = { value = 4.0, unit = "K/kW" }
Tg = { value = 283.0, unit = "K" }
Rg = { value = 9.0, unit = "K/kW" }
[equations]
room = "C*T' = (To - T)/R + (Tg - T)/Rg + P"
"#;

    fn offered(text: &str, library: &[Mechanism]) -> Vec<(String, String)> {
        let model = Model::from_toml(text, "room.toml").unwrap();
        let scale = AnyScale::of(&model);
        let all = candidates(&model, library, &places(&model));
        let admitted = all.iter().filter(|c| scale.admits(c, &library[c.mechanism]));
        admitted
            .map(|c| {
                let mechanism = &library[c.mechanism];
                let mut with = model.clone();
                let values = vec![1.0; mechanism.parameters().count()];
                (mechanism.kind.clone(), c.insert(&mut with, mechanism, &values).expression.to_string())
            })
            .collect()
    }

    #[test]
    fn a_parameter_may_be_a_temperature_on_the_scale() {
        let model = Model::from_toml(ROOM, "room.toml").unwrap();
        assert_eq!(AnyScale::of(&model).moved, Some(vec!["Tg".to_owned()]));
        let without = ROOM.replace("(To - T)/R", "To/R - T/Rg");
        assert_eq!(AnyScale::of(&Model::from_toml(&without, "room.toml").unwrap()).moved, None);
    }

    #[test]
    fn what_is_added_to_differences_of_temperatures_knows_no_zero() {
        let library = crate::built_in().unwrap();
        let all = offered(ROOM, &library);
        let has = |kind: &str, part: &str| all.iter().any(|(k, e)| k == kind && e.contains(part));
        for (kind, part) in [
            ("constant_offset", "f0"),
            ("sensor_offset", "T"),
            ("input_delay", "To"),
            ("input_saturation", "P"),
            ("actuator_lag", ""),
            ("parameter_drift", "R*"),
        ] {
            assert!(has(kind, part), "{kind} {part}: {all:?}");
        }
        for (kind, part) in [
            ("cubic_stiffness", "T"),
            ("quadratic_stiffness", "T"),
            ("input_saturation", "To"),
            ("input_dead_zone", "To"),
            ("parameter_drift", "Tg"),
        ] {
            assert!(!has(kind, part), "{kind} {part}: {all:?}");
        }
    }

    /// Where the model itself knows the zero, or no temperature is in it, everything is offered as before.
    #[test]
    fn other_machines_are_offered_everything() {
        let library = crate::built_in().unwrap();
        let count = |text: &str| {
            let model = Model::from_toml(text, "m.toml").unwrap();
            (offered(text, &library).len(), candidates(&model, &library, &places(&model)).len())
        };
        let (some, all) = count(ROOM);
        assert!(some < all);
        let radiates = ROOM
            .replace("+ P", "+ P - s*T^4")
            .replace("Tg =", "s = { value = 1e-9, unit = \"kW/K^4\" }\nTg =");
        let (some, all) = count(&radiates);
        assert_eq!(some, all);
        let (some, all) = count(&ROOM.replace("\"K\"", "\"m\"").replace("/K", "/m").replace("K/", "m/"));
        assert_eq!(some, all);
    }

    #[test]
    fn a_law_may_claim_the_absolute_zero() {
        let file = |absolute: &str| {
            let text = format!(
                "kind = \"radiation\"\nfamily = \"loss\"\non = \"motion\"\nforce = \"er*d^4\"\nlinear = [\"er\"]\n{absolute}\n"
            );
            vec![Mechanism::from_toml(&text, "radiation.toml").unwrap()]
        };
        assert_eq!(offered(ROOM, &file("")), []);
        assert_eq!(offered(ROOM, &file("absolute = true")).len(), 1);
    }
}
