//! Constants that no recording tells apart: a constant force, an offset of an input and one of a sensor may be the
//! same equations in other coordinates.
//!
//! Let R(q) = 0 be the equations and y = h(q) the measurements. Where q enters both linearly with constant
//! coefficients, q → q + c adds the constants K c to the equations and A c to the measurements, and nothing else. Of
//! constants P and Q in equations and measurements no recording tells P from s Q, where P − s Q = (K c, A c) for some c:
//! the start of a recording is unknown, so that it takes up c.

use greybox_model::{Expr, Func, Model};

use crate::candidate::Candidate;
use crate::library::Mechanism;
use crate::place::Place;

/// What is the same as a given constant in these equations.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Twin {
    /// Index of the mechanism in the library.
    pub mechanism: usize,
    /// Where it stands; several are constants that only together are the same.
    pub places: Vec<Place>,
}

/// The constants of the library that equal `candidate` in this model, itself left out; they stand at places of `nominal`,
/// whose equations come first in it. Nothing where it is no constant, or one that no recording shows at all.
pub(crate) fn twins(
    model: &Model,
    nominal: &Model,
    library: &[Mechanism],
    candidate: &Candidate,
) -> Vec<Twin> {
    let is_constant = |m: &Mechanism| m.is_constant();
    if !library.get(candidate.mechanism).is_some_and(is_constant) {
        return Vec::new();
    }
    let Some(own) = constants(model, &candidate.place) else { return Vec::new() };
    let shifts = Shifts::of(model);
    let kinds = || library.iter().enumerate().filter(|(_, m)| m.is_constant());
    let mut found = Vec::new();
    for (index, mechanism) in kinds() {
        for place in places(nominal) {
            let other = Candidate { mechanism: index, place: place.clone(), mirrored: false };
            if mechanism.on != on(&place) || other.place == candidate.place {
                continue;
            }
            if constants(model, &place).is_some_and(|other| shifts.same(&own, &other)) {
                found.push(Twin { mechanism: index, places: vec![place] });
            }
        }
    }
    for several in [shifts.as_measurements(&own), shifts.as_equations(&own)].into_iter().flatten() {
        let first = several.first().map(on);
        let known = |place: &Place| places(nominal).any(|p| p == *place);
        if several.len() > 1
            && several.iter().all(known)
            && !several.contains(&candidate.place)
            && let Some((index, _)) = kinds().find(|(_, m)| Some(m.on) == first)
        {
            found.push(Twin { mechanism: index, places: several });
        }
    }
    found
}

fn on(place: &Place) -> crate::library::On {
    use crate::library::On;
    match place {
        Place::Input(_) => On::Input,
        Place::Measurement(_) => On::Measurement,
        _ => On::Equation,
    }
}

fn places(model: &Model) -> impl Iterator<Item = Place> + use<'_> {
    let (equations, inputs, measurements) =
        (model.equations.len(), model.inputs.len(), model.measurements.len());
    (0..equations)
        .map(Place::Equation)
        .chain((0..inputs).filter(|u| model.inputs[*u].derivative_of().is_none()).map(Place::Input))
        .chain((0..measurements).map(Place::Measurement))
}

/// What a unit constant at a place adds to the equations and, behind them, to the measurements.
fn constants(model: &Model, place: &Place) -> Option<Vec<f64>> {
    let n = model.equations.len() + model.measurements.len();
    let at = |i: usize| (i < n).then(|| (0..n).map(|k| f64::from(u8::from(k == i))).collect());
    match place {
        Place::Equation(e) => at(*e),
        Place::Measurement(c) => at(model.equations.len() + c),
        Place::Input(u) => coefficients(model, &model.inputs.get(*u)?.name),
        _ => None,
    }
}

/// Coefficients of a symbol in the equations and the measurements, if they are constant and it enters in no other way.
fn coefficients(model: &Model, name: &str) -> Option<Vec<f64>> {
    let equations = model.equations.iter().map(|e| e.residual());
    let measurements = model.measurements.iter().map(|m| m.expr.clone());
    let value = |n: &str, _: u8| match model.parameter(n) {
        Some(p) => Some(model.parameters[p].value),
        None => (n == "pi").then_some(std::f64::consts::PI),
    };
    equations
        .chain(measurements)
        .map(|e| {
            let (coefficients, _) = undelayed(&e).affine_in(&[(name, 0)])?;
            let coefficient = coefficients.first()?.simplify();
            coefficient.eval(&value).filter(|v| v.is_finite())
        })
        .collect()
}

/// A constant is the same some time ago.
fn undelayed(e: &Expr) -> Expr {
    e.map(&mut |e| match e {
        Expr::Call(Func::Delay, args) => args.into_iter().next().unwrap_or(Expr::Num(0.0)),
        other => other,
    })
}

/// The constants that shifts of coordinates make.
struct Shifts {
    /// One row per coordinate that may be shifted: equations, then measurements.
    rows: Vec<Vec<f64>>,
    equations: usize,
}

impl Shifts {
    fn of(model: &Model) -> Shifts {
        // A given start is no unknown that takes up a shift.
        let free = model.states.iter().filter(|s| s.initial.is_empty());
        let rows = free.filter_map(|s| coefficients(model, &s.name)).collect();
        Shifts { rows, equations: model.equations.len() }
    }

    /// Whether `a` is a multiple of `b` but for a shift, and not a shift itself.
    fn same(&self, a: &[f64], b: &[f64]) -> bool {
        let all: Vec<&[f64]> = self.rows.iter().map(Vec::as_slice).chain([a, b]).collect();
        let scale = scales(&all);
        let basis = orthonormal(self.rows.iter().map(|row| scaled(row, &scale)));
        let rest = |v: &[f64]| beyond(&basis, scaled(v, &scale));
        match (rest(a), rest(b)) {
            (Some(a), Some(b)) => (dot(&a, &b).abs() - 1.0).abs() < TOLERANCE,
            _ => false,
        }
    }

    /// The measurements in which a constant is, where a shift takes it out of the equations, and only one does.
    fn as_measurements(&self, constant: &[f64]) -> Option<Vec<Place>> {
        self.moved(constant, 0..self.equations, Place::Measurement)
    }

    /// The equations in which a constant is, where a shift takes it out of the measurements, and only one does.
    fn as_equations(&self, constant: &[f64]) -> Option<Vec<Place>> {
        self.moved(constant, self.equations..constant.len(), Place::Equation)
    }

    /// Where a constant shows when a shift has taken it out of `from`.
    fn moved(
        &self,
        constant: &[f64],
        from: std::ops::Range<usize>,
        place: fn(usize) -> Place,
    ) -> Option<Vec<Place>> {
        let all: Vec<&[f64]> = self.rows.iter().map(Vec::as_slice).chain([constant]).collect();
        let scale = scales(&all);
        let mut left = scaled(constant, &scale);
        let mut rows: Vec<Vec<f64>> = self.rows.iter().map(|row| scaled(row, &scale)).collect();
        if norm(left.get(from.clone())?) == 0.0 {
            return None;
        }
        // The rows are made orthogonal in `from`, and the constant loses its part along each.
        for i in 0..rows.len() {
            let (done, open) = rows.split_at_mut(i);
            let row = open.first_mut()?;
            let before = norm(row.get(from.clone())?);
            for _ in 0..2 {
                for other in done.iter() {
                    take(row, other, &from)?;
                }
            }
            if before == 0.0 || norm(row.get(from.clone())?) <= TOLERANCE * before {
                return None; // a shift that `from` does not show: there is more than one way
            }
        }
        for _ in 0..2 {
            for row in &rows {
                take(&mut left, row, &from)?;
            }
        }
        if norm(left.get(from.clone())?) > TOLERANCE {
            return None;
        }
        let offset = if from.start == 0 { from.end } else { 0 };
        let rest = (0..left.len()).filter(|i| !from.contains(i));
        Some(rest.filter(|i| left[*i].abs() > TOLERANCE).map(|i| place(i - offset)).collect())
    }
}

/// Relative size of what is rounding.
const TOLERANCE: f64 = 1e-9;

/// Takes the part along `other`, by their components in `from`, out of `v`.
fn take(v: &mut [f64], other: &[f64], from: &std::ops::Range<usize>) -> Option<()> {
    let (own, along) = (v.get(from.clone())?, other.get(from.clone())?);
    let square = dot(along, along);
    if square > 0.0 {
        let factor = dot(own, along) / square;
        v.iter_mut().zip(other).for_each(|(v, o)| *v -= factor * o);
    }
    Some(())
}

/// Largest magnitude of each component: equations of different units count alike.
fn scales(all: &[&[f64]]) -> Vec<f64> {
    let n = all.iter().map(|v| v.len()).max().unwrap_or(0);
    let largest = |i: usize| all.iter().filter_map(|v| v.get(i)).fold(0.0f64, |m, v| m.max(v.abs()));
    (0..n).map(|i| if largest(i) > 0.0 { largest(i) } else { 1.0 }).collect()
}

fn scaled(v: &[f64], scale: &[f64]) -> Vec<f64> {
    v.iter().zip(scale).map(|(v, s)| v / s).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn norm(v: &[f64]) -> f64 {
    dot(v, v).sqrt()
}

fn orthonormal(rows: impl Iterator<Item = Vec<f64>>) -> Vec<Vec<f64>> {
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for row in rows {
        if let Some(new) = beyond(&basis, row) {
            basis.push(new);
        }
    }
    basis
}

/// The direction of what of `v` is not in the span of `basis`, if anything is.
fn beyond(basis: &[Vec<f64>], mut v: Vec<f64>) -> Option<Vec<f64>> {
    let before = norm(&v);
    for _ in 0..2 {
        for b in basis {
            let along = dot(&v, b);
            v.iter_mut().zip(b).for_each(|(v, b)| *v -= along * b);
        }
    }
    let after = norm(&v);
    (after > TOLERANCE * before).then(|| v.into_iter().map(|v| v / after).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::built_in;

    /// What equals a constant at a place: kinds with the names of their places.
    fn reported(text: &str, kind: &str, place: Place) -> Vec<String> {
        told_in(&Model::from_toml(text, "m.toml").unwrap(), None, kind, place)
    }

    /// The same, where `improved` is the model with mechanisms in it.
    fn told_in(model: &Model, improved: Option<&Model>, kind: &str, place: Place) -> Vec<String> {
        let library = built_in().unwrap();
        let mechanism = library.iter().position(|m| m.kind == kind).unwrap();
        let candidate = Candidate { mechanism, place, mirrored: false };
        twins(improved.unwrap_or(model), model, &library, &candidate)
            .iter()
            .map(|t| {
                let names = t.places.iter().map(|p| match p {
                    Place::Input(u) => model.inputs[*u].name.clone(),
                    Place::Measurement(c) => model.measurements[*c].channel.clone(),
                    other => other.equations(model).concat(),
                });
                format!("{} {}", library[t.mechanism].kind, names.collect::<Vec<_>>().join("+"))
            })
            .collect()
    }

    /// Two carts on springs to the wall, with `between` them.
    fn carts(between: [&str; 2]) -> String {
        format!(
            "[inputs]\nf = {{ unit = \"N\" }}\n[states]\nx1 = {{ unit = \"m\" }}\nx2 = {{ unit = \"m\" }}\n\
             [parameters]\nm = {{ value = 1.2 }}\nc = {{ value = 0.3 }}\nk1 = {{ value = 40.0 }}\nk2 = {{ value = 7.0 }}\n\
             a = {{ value = 1.0 }}\nb = {{ value = 1.0 }}\n\
             [equations]\nfirst = \"m*x1'' + c*x1' + k1*x1 + {} = f\"\nsecond = \"m*x2'' + k2*x2 + {} = 0\"\n",
            between[0], between[1]
        )
    }

    #[test]
    fn a_force_on_a_cart_with_a_spring_of_its_own_is_an_offset_of_its_sensor_and_of_its_input() {
        let damped = carts(["c*(x1' - x2')", "c*(x2' - x1')"]);
        let force = |e| reported(&damped, "constant_offset", Place::Equation(e));
        assert_eq!(force(0), ["input_offset f", "sensor_offset x1"]);
        assert_eq!(force(1), ["sensor_offset x2"]);
        let sensor = reported(&damped, "sensor_offset", Place::Measurement(0));
        assert_eq!(sensor, ["constant_offset first", "input_offset f"]);
    }

    #[test]
    fn a_force_between_carts_moves_both_of_them() {
        let sprung = carts(["k2*(x1 - x2)", "k2*(x2 - x1)"]);
        let force = reported(&sprung, "constant_offset", Place::Equation(0));
        assert_eq!(force, ["input_offset f", "sensor_offset x1+x2"]);
        let sensor = reported(&sprung, "sensor_offset", Place::Measurement(0));
        assert_eq!(sensor, ["constant_offset first+second"]);
        // Where the second cart is not measured, one sensor is enough.
        let blind = sprung.replace("x2 = { unit = \"m\" }", "x2 = { unit = \"m\", measured = false }");
        let force = reported(&blind, "constant_offset", Place::Equation(0));
        assert_eq!(force, ["constant_offset second", "input_offset f", "sensor_offset x1"]);
    }

    /// The equation of a mechanism's own state is no place for a constant, but goes along with a shift.
    #[test]
    fn a_state_of_a_mechanism_goes_along() {
        let model = Model::from_toml(&carts(["c*(x1' - x2')", "c*(x2' - x1')"]), "m.toml").unwrap();
        let library = built_in().unwrap();
        let lag = library.iter().position(|m| m.kind == "actuator_lag").unwrap();
        let mut improved = model.clone();
        let place = Place::Input(0);
        let count = library[lag].parameters().count();
        Candidate { mechanism: lag, place, mirrored: false }.insert(
            &mut improved,
            &library[lag],
            &vec![0.2; count],
        );
        assert!(improved.equations.len() > model.equations.len());
        let force = told_in(&model, Some(&improved), "constant_offset", Place::Equation(0));
        assert_eq!(force, ["input_offset f", "sensor_offset x1"]);
    }

    #[test]
    fn what_is_not_linear_or_not_free_tells_them_apart() {
        let damped = carts(["c*(x1' - x2')", "c*(x2' - x1')"]);
        for (from, to) in [
            ("k1*x1", "k1*x1 + a*x1^3"),
            ("k1*x1", "k1*x1*(1 + a*t)"),
            ("k1*x1", "k1*x1*(1 + a*x2)"),
            ("k1*x1", "k1*max(x1, 0)"),
            ("x1 = { unit = \"m\" }", "x1 = { unit = \"m\", initial = 0 }"),
            // Nothing draws it back: where it stands, no force shows.
            ("k1*x1", "0*x1"),
        ] {
            let other = damped.replace(from, to);
            assert_eq!(reported(&other, "constant_offset", Place::Equation(0)), ["input_offset f"], "{to}");
        }
        // A delay tells nothing of a constant, and dry friction asks for the direction only.
        for to in ["k1*delay(x1, b)", "k1*x1 + a*sign(x1')"] {
            let other = damped.replace("k1*x1", to);
            let force = reported(&other, "constant_offset", Place::Equation(0));
            assert_eq!(force, ["input_offset f", "sensor_offset x1"], "{to}");
        }
        // An input that enters as its square is no constant, and one in both equations is none in one.
        for to in ["= a*f^2", "= f + a*f*x2"] {
            let other = damped.replace("= f", to);
            assert_eq!(reported(&other, "constant_offset", Place::Equation(0)), ["sensor_offset x1"], "{to}");
        }
        let both = damped.replace("= 0\"", "= f\"");
        assert_eq!(reported(&both, "constant_offset", Place::Equation(0)), ["sensor_offset x1"]);
        assert_eq!(reported(&both, "input_offset", Place::Input(0)), ["sensor_offset x1+x2"]);
        assert_eq!(reported(&both, "coulomb_friction", Place::Equation(0)), [""; 0]);
    }
}
