//! A mechanism at a place: what it adds to the model.

use std::iter;

use greybox_calibrate::{FreeParameter, Prior};
use greybox_model::{Equation, Expr, Model, Parameter, State, Unit};

use crate::library::{Mechanism, On, arbitrary};
use crate::place::{Motion, Place};

/// A mechanism at a place.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Index of the mechanism in the library.
    pub mechanism: usize,
    /// Where.
    pub place: Place,
    /// Whether d stands for −d.
    pub mirrored: bool,
}

/// An accepted (or tried) mechanism with the names its parameters got in the model.
#[derive(Debug, Clone, PartialEq)]
pub struct Instance {
    /// What and where.
    pub candidate: Candidate,
    /// Names of the parameters in the model, in the order of [`Mechanism::parameters`].
    pub names: Vec<String>,
    /// Names of its states in the model, in the order of the file.
    pub states: Vec<String>,
    /// The law as it stands in the model (a force), or the replacement.
    pub expression: Expr,
}

/// All sensible pairs of mechanism and place.
pub fn candidates(model: &Model, library: &[Mechanism], places: &[Place]) -> Vec<Candidate> {
    let mut out = Vec::new();
    for (i, mechanism) in library.iter().enumerate() {
        let symmetric = mechanism.reaction.as_ref().is_some_and(|r| swapped(&mechanism.law) == *r);
        let mut pairs: Vec<(&Motion, &Motion)> = Vec::new();
        for place in places {
            let fits = match (mechanism.on, place) {
                (On::Motion, Place::Motion(m)) => has(mechanism, "d", m),
                (On::Spring, Place::Spring { motion, level: 0, alone: true, .. })
                | (On::Feedback, Place::Spring { motion, .. }) => has(mechanism, "d", motion),
                (On::Load, Place::Load { motion, .. }) => has(mechanism, "d", motion),
                (On::Drive, Place::Load { motion, load }) => {
                    let is_driven = model.inputs.iter().any(|input| load.mentions(&input.name));
                    is_driven && has(mechanism, "d", motion)
                }
                (On::Pair, Place::Pair { own, other }) => {
                    let seen = symmetric && pairs.contains(&(other, own));
                    pairs.push((own, other));
                    !seen && has(mechanism, "d", own) && has(mechanism, "o", other)
                }
                (On::Equation, Place::Equation(_))
                | (On::Measurement, Place::Measurement(_))
                | (On::Parameter, Place::Parameter(_)) => true,
                (On::Input, Place::Input(i)) => {
                    let name = &model.inputs[*i].name;
                    model.equations.iter().any(|e| e.residual().mentions(name))
                }
                _ => false,
            };
            let candidate = Candidate { mechanism: i, place: place.clone(), mirrored: false };
            // About a reference that stands, the rate is that of the coordinate.
            let is_known =
                |other: &Candidate| other.mechanism == i && candidate.is_as(other, model, mechanism);
            if fits
                && !out.iter().any(is_known)
                && place.admits(mechanism.domain, model)
                && candidate.has_units(model, mechanism)
                && !candidate.duplicates(model, mechanism)
            {
                let mirror = mechanism.mirror.then(|| Candidate { mirrored: true, ..candidate.clone() });
                out.push(candidate);
                out.extend(mirror);
            }
        }
    }
    out
}

/// Whether a motion knows everything that the mechanism asks of it.
fn has(mechanism: &Mechanism, placeholder: &str, m: &Motion) -> bool {
    let known = [&m.position, &m.rate, &m.acceleration];
    (0..=3u8).all(|primes| {
        !mechanism.depends_on(placeholder, primes) || known.get(primes as usize).is_some_and(|e| e.is_some())
    })
}

/// The law with d and o exchanged.
fn swapped(law: &Expr) -> Expr {
    law.substitute(&|n, primes| match n {
        "d" => Some(Expr::prime("o", primes)),
        "o" => Some(Expr::prime("d", primes)),
        _ => None,
    })
}

fn level(m: &Motion, primes: u8) -> Option<Expr> {
    match primes {
        0 => m.position.clone(),
        1 => m.rate.clone(),
        2 => m.acceleration.clone(),
        _ => None,
    }
}

/// What becomes of the inputs that are the derivative of an input's channel where `law` takes the input's place; `states`
/// are those of the law.
fn rates_of_input(model: &Model, input: usize, states: &[String], law: &Expr) -> Vec<(String, Expr)> {
    let (name, channel) = (&model.inputs[input].name, &model.inputs[input].channel);
    let derivatives = model.inputs.iter().filter(|d| d.derivative_of() == Some(channel));
    derivatives
        .map(|d| {
            let rate = law.time_derivative(&|n| n == name || states.iter().any(|s| s == n));
            let raw = |n: &str, primes: u8| (n == name && primes == 1).then(|| Expr::var(&d.name));
            (d.name.clone(), rate.substitute(&raw).simplify())
        })
        .collect()
}

/// A weight in front of a law: `w*law`.
fn weighted(w: f64, law: Expr) -> Expr {
    if w == 1.0 {
        law
    } else if w == -1.0 {
        -law
    } else {
        Expr::Num(w) * law
    }
}

impl Candidate {
    /// Whether the model's units admit it (the sine of a length has none).
    fn has_units(&self, model: &Model, mechanism: &Mechanism) -> bool {
        let mut with = model.clone();
        self.insert(&mut with, mechanism, &vec![1.0; mechanism.parameters().count()]);
        with.resolve_units().is_ok() || model.clone().resolve_units().is_err()
    }

    /// Whether the same mechanism is the same force on a motion as another.
    fn is_as(&self, other: &Candidate, model: &Model, mechanism: &Mechanism) -> bool {
        let (Place::Motion(one), Place::Motion(two)) = (&self.place, &other.place) else { return false };
        let keep = |n: &str| n.to_owned();
        let law = |c: &Candidate| -> Vec<Expr> {
            let of_states = mechanism.states.iter().flat_map(|s| [&s.lhs, &s.rhs]);
            iter::once(&mechanism.law)
                .chain(of_states)
                .map(|e| c.translate(model, e, &keep).simplify())
                .collect()
        };
        one.weights == two.weights && law(self) == law(other)
    }

    /// Whether it is collinear with a free parameter of the model: its force is in every equation the
    /// same multiple of what that parameter multiplies. (Judged at a few arbitrary points.)
    fn duplicates(&self, model: &Model, mechanism: &Mechanism) -> bool {
        let [name] = &mechanism.linear[..] else { return false };
        if !mechanism.states.is_empty() || !mechanism.inner.is_empty() || !mechanism.first.is_empty() {
            return false;
        }
        let mut with = model.clone();
        let instance = self.insert(&mut with, mechanism, &[0.0]);
        debug_assert_eq!(mechanism.parameters().next(), Some(name.as_str()));
        let own = &instance.names[0];
        let slopes = |of: &str| -> Vec<Expr> {
            with.equations.iter().map(|e| e.residual().derivative(of, 0).simplify()).collect()
        };
        let values = |slopes: &[Expr], point: u8| -> Option<Vec<f64>> {
            // What the model gives a value is positive; a motion goes either way.
            let value = |n: &str, primes: u8| {
                let any = arbitrary(point, n, primes);
                Some(if with.parameter(n).is_some() { 0.3 + any.abs() } else { any })
            };
            slopes.iter().map(|e| e.eval(&value)).collect()
        };
        let mine = slopes(own);
        model.parameters.iter().filter(|p| !p.fixed).any(|p| {
            let theirs = slopes(&p.name);
            let mut ratio: Option<f64> = None;
            (0..8).all(|point| {
                let (Some(a), Some(b)) = (values(&mine, point), values(&theirs, point)) else { return false };
                let here = a.iter().zip(&b).find(|(a, _)| **a != 0.0).map(|(a, b)| b / a);
                let Some(r) = here.filter(|r| *r != 0.0) else { return false };
                let same = *ratio.get_or_insert(r);
                (r / same - 1.0).abs() < 1e-9
                    && a.iter().zip(&b).all(|(a, b)| (b - r * a).abs() <= 1e-9 * b.abs().max(1e-12))
            })
        })
    }

    /// The motion it acts on, where it acts on one.
    pub fn motion(&self) -> Option<&Motion> {
        match &self.place {
            Place::Motion(m) | Place::Spring { motion: m, .. } | Place::Load { motion: m, .. } => Some(m),
            Place::Pair { own, .. } => Some(own),
            _ => None,
        }
    }

    /// An expression of the mechanism file in the model's own names; `rename` maps its parameters and
    /// states.
    pub fn translate(&self, model: &Model, e: &Expr, rename: &dyn Fn(&str) -> String) -> Expr {
        e.substitute(&|name, primes| match (name, &self.place) {
            ("d", Place::Pair { own, .. }) => level(own, primes),
            ("d", _) => {
                let d = self.motion().and_then(|m| level(m, primes));
                d.map(|d| if self.mirrored { -d } else { d })
            }
            ("o", Place::Pair { other, .. }) => level(other, primes),
            ("load", Place::Load { load, .. }) if primes == 0 => Some(load.clone()),
            ("u", Place::Input(i)) => Some(Expr::prime(&model.inputs[*i].name, primes)),
            ("y", Place::Measurement(c)) if primes == 0 => Some(model.measurements[*c].expr.clone()),
            ("p", Place::Parameter(p)) if primes == 0 => Some(Expr::var(&model.parameters[*p].name)),
            ("k", Place::Spring { parameter, factor, .. }) if primes == 0 => {
                Some(weighted(*factor, Expr::var(&model.parameters[*parameter].name)))
            }
            ("t" | "pi", _) => None,
            _ => Some(Expr::prime(&rename(name), primes)),
        })
    }

    /// What the law stands in for: zero for a force.
    pub fn base(&self, model: &Model) -> Expr {
        match &self.place {
            Place::Input(i) => Expr::var(&model.inputs[*i].name),
            Place::Measurement(c) => model.measurements[*c].expr.clone(),
            Place::Parameter(p) => Expr::var(&model.parameters[*p].name),
            Place::Spring { motion, parameter, factor, .. } => {
                let k = weighted(*factor, Expr::var(&model.parameters[*parameter].name));
                k * motion.position.clone().unwrap_or(Expr::Num(0.0))
            }
            _ => Expr::Num(0.0),
        }
    }

    /// Names for the mechanism's parameters and states that the model does not use yet: as the library
    /// writes them, else with the equation's name behind.
    pub fn names(&self, model: &Model, mechanism: &Mechanism) -> (Vec<String>, Vec<String>) {
        let taken = |n: &str| {
            model.parameter(n).is_some()
                || model.state(n).is_some()
                || model.input(n).is_some()
                || matches!(n, "t" | "pi")
        };
        let suffix = self.place.equations(model).first().cloned().unwrap_or_default();
        let plain: Vec<String> = mechanism
            .parameters()
            .chain(mechanism.states.iter().map(|s| s.name.as_str()))
            .map(str::to_string)
            .collect();
        let mut all = if plain.iter().any(|n| taken(n)) {
            plain
                .iter()
                .map(|n| {
                    let with = format!("{n}_{suffix}");
                    if taken(&with) { model.fresh_name(&with) } else { with }
                })
                .collect()
        } else {
            plain
        };
        let states = all.split_off(mechanism.parameters().count());
        (all, states)
    }

    /// Adds the mechanism to a model, its parameters at `values` (order of
    /// [`Mechanism::parameters`]).
    pub fn insert(&self, model: &mut Model, mechanism: &Mechanism, values: &[f64]) -> Instance {
        let (names, states) = self.names(model, mechanism);
        let plain: Vec<String> = mechanism
            .parameters()
            .chain(mechanism.states.iter().map(|s| s.name.as_str()))
            .map(str::to_string)
            .collect();
        let new: Vec<&String> = names.iter().chain(&states).collect();
        let rename =
            |n: &str| plain.iter().position(|p| p == n).map_or_else(|| n.to_string(), |i| new[i].clone());
        let mut law = self.translate(model, &mechanism.law, &rename).simplify();
        // The states' equations and units, before anything is replaced in the model.
        let equations: Vec<(Expr, Expr, Unit)> = mechanism
            .states
            .iter()
            .map(|s| {
                let of = |e: &Expr| self.translate(model, e, &rename);
                let dimension = model.dimension_of(&of(&s.unit)).unwrap_or_default();
                (of(&s.lhs), of(&s.rhs), Unit::si(dimension))
            })
            .collect();
        match &self.place {
            Place::Motion(motion) | Place::Load { motion, .. } => {
                if self.mirrored {
                    // A push towards −d is a negative force along d.
                    law = (-law).simplify();
                }
                for (e, &w) in motion.weights.iter().enumerate() {
                    if w != 0.0 {
                        model.add_term(e, weighted(w, law.clone()));
                    }
                }
            }
            Place::Pair { own, other } => {
                for (e, &w) in own.weights.iter().enumerate() {
                    if w != 0.0 {
                        model.add_term(e, weighted(w, law.clone()));
                    }
                }
                if let Some(reaction) = &mechanism.reaction {
                    let reaction = self.translate(model, reaction, &rename).simplify();
                    for (e, &w) in other.weights.iter().enumerate() {
                        if w != 0.0 {
                            model.add_term(e, weighted(w, reaction.clone()));
                        }
                    }
                }
            }
            Place::Spring { motion, parameter, alone, .. } => {
                let name = model.parameters[*parameter].name.clone();
                let base = self.base(model);
                for (e, &w) in motion.weights.iter().enumerate() {
                    if w == 0.0 {
                        continue;
                    }
                    if *alone {
                        // The law stands where the term stood.
                        let without = |e: &Expr| {
                            if !e.mentions(&name) {
                                return e.clone();
                            }
                            e.substitute(&|n, p| (n == name && p == 0).then_some(Expr::Num(0.0))).simplify()
                        };
                        let equation = &mut model.equations[e];
                        equation.lhs = without(&equation.lhs);
                        equation.rhs = without(&equation.rhs);
                        model.add_term(e, weighted(w, law.clone()));
                    } else {
                        model.add_term(e, weighted(w, law.clone()));
                        model.add_term(e, weighted(-w, base.clone()));
                    }
                }
            }
            Place::Equation(e) => model.add_term(*e, law.clone()),
            Place::Input(i) => {
                let name = model.inputs[*i].name.clone();
                // Raw inputs stand in what takes their place, hence the input first.
                model.replace(&name, 0, &law);
                for (derivative, rate) in rates_of_input(model, *i, &states, &law) {
                    model.replace(&derivative, 0, &rate);
                }
            }
            Place::Measurement(c) => model.measurements[*c].expr = law.clone(),
            Place::Parameter(p) => {
                let name = model.parameters[*p].name.clone();
                let measured: Vec<Expr> = model.measurements.iter().map(|m| m.expr.clone()).collect();
                model.replace(&name, 0, &law);
                for (m, expr) in model.measurements.iter_mut().zip(measured) {
                    m.expr = expr;
                }
            }
        }
        for (name, value) in names.iter().zip(values) {
            model.parameters.push(Parameter {
                name: name.clone(),
                value: *value,
                unit: None,
                std: None,
                fixed: false,
                positive: None,
            });
        }
        for (name, (lhs, rhs, unit)) in states.iter().zip(equations) {
            model.states.push(State {
                name: name.clone(),
                unit,
                order: 1,
                channel: None,
                initial: Vec::new(),
            });
            model.equations.push(Equation { name: name.clone(), lhs, rhs });
        }
        model.recompute_orders();
        Instance { candidate: self.clone(), names, states, expression: law }
    }

    /// The mechanism's parameters as unknowns of a fit; `scales[i]` is the size of inner parameter i.
    pub fn free(&self, mechanism: &Mechanism, first: usize, scales: &[f64]) -> Vec<FreeParameter> {
        let positive = |n: &str| mechanism.positive.iter().any(|p| p == n);
        mechanism
            .parameters()
            .enumerate()
            .filter_map(|(at, name)| {
                let (lower, upper) = match mechanism.inner(name) {
                    Some((_, inner)) if inner.fixed => return None,
                    Some((i, inner)) => {
                        let (low, high) = inner.bounds(scales[i].abs().max(1e-300));
                        // A positive parameter may run down to zero unless the file says otherwise.
                        let free_to_zero = positive(name) && inner.low <= 1e-3;
                        (if free_to_zero { 0.0 } else { low }, high)
                    }
                    None => (if positive(name) { 0.0 } else { f64::NEG_INFINITY }, f64::INFINITY),
                };
                // (What a shape's changes of slope are normal with is its size.)
                let prior = match mechanism.shape {
                    Some(_) => Prior::Normal { mean: 0.0, std: 1.0 },
                    None => Prior::Flat,
                };
                Some(FreeParameter { index: first + at, prior, lower, upper })
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::place::places;

    /// A damper's law is collinear with the damper's parameter. A force that does not turn with the motion is not.
    #[test]
    fn an_even_force_is_collinear_with_no_parameter() {
        let text = "[inputs]\nf = { unit = \"N\" }\n[states]\nx = { unit = \"m\" }\n[parameters]\n\
                    m = { value = 1.0, unit = \"kg\" }\nc = { value = 1.0, unit = \"N s/m\" }\n\
                    k = { value = 9.0, unit = \"N/m\" }\n[equations]\nmass = \"m*x'' + c*x' + k*x = f\"\n";
        let model = Model::from_toml(text, "mass.toml").unwrap();
        let library = crate::built_in().unwrap();
        let all = candidates(&model, &library, &places(&model));
        let is_offered = |kind: &str| all.iter().any(|c| library[c.mechanism].kind == kind);
        assert!(!is_offered("viscous_friction") && !is_offered("linear_stiffness"));
        assert!(is_offered("asymmetric_damping") && is_offered("asymmetric_stiffness"));
    }

    /// About a reference that stands, a law of the position is another one, and a law of the rate is not.
    #[test]
    fn a_law_of_the_rate_knows_no_reference() {
        let text = "[states]\nx = { unit = \"m\" }\n[parameters]\nm = { value = 1.0, unit = \"kg\" }\n\
                    k = { value = 9.0, unit = \"N/m\" }\nx0 = { value = 0.1, unit = \"m\" }\n\
                    [equations]\nmass = \"m*x'' + k*(x - x0) = 0\"\n";
        let model = Model::from_toml(text, "mass.toml").unwrap();
        let library = crate::built_in().unwrap();
        let all = candidates(&model, &library, &places(&model));
        let offered = |kind: &str| all.iter().filter(|c| library[c.mechanism].kind == kind).count();
        assert_eq!(["cubic_stiffness", "coulomb_friction", "quadratic_drag"].map(offered), [2, 1, 1]);
    }

    /// The force of a spring is a load as that of an input is, and only the latter drives, a torque that falls with the speed
    /// as well.
    #[test]
    fn what_acts_on_a_drive_is_offered_where_an_input_is() {
        let offered = |right: &str| {
            let text = format!(
                "[inputs]\nf = {{ unit = \"N\" }}\n[states]\nx = {{ unit = \"m\" }}\n[parameters]\n\
                 m = {{ value = 1.0, unit = \"kg\" }}\nk = {{ value = 9.0, unit = \"N/m\" }}\n\
                 c = {{ value = 1.0, unit = \"N s/m\" }}\n\
                 [equations]\nmass = \"m*x'' + k*x = {right}\"\n"
            );
            let model = Model::from_toml(&text, "mass.toml").unwrap();
            let library = crate::built_in().unwrap();
            let all = candidates(&model, &library, &places(&model));
            ["load_dependent_friction", "load_dependent_damping", "position_dependent_drive"]
                .map(|kind| all.iter().filter(|c| library[c.mechanism].kind == kind).count())
        };
        assert_eq!(offered("f"), [2, 1, 1]);
        assert_eq!(offered("2*(f - c*x')"), [2, 1, 1]);
        assert_eq!(offered("-c*x'"), [1, 0, 0]);
    }
}
