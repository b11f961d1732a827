//! A mechanism at a place: what it adds to the model.

use greybox_calibrate::Free;
use greybox_model::{Expr, Model, Parameter};

use crate::library::{Mechanism, On};
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
    /// The law as it stands in the model (a force), or the replacement.
    pub expression: Expr,
}

/// All sensible pairs of mechanism and place.
pub fn candidates(model: &Model, library: &[Mechanism], places: &[Place]) -> Vec<Candidate> {
    let mut out = Vec::new();
    for (i, mechanism) in library.iter().enumerate() {
        for place in places {
            let fits = match (mechanism.on, place) {
                (On::Motion, Place::Motion(m)) => {
                    let needs_position = mentions(&mechanism.law, 0);
                    let needs_rate = mentions(&mechanism.law, 1);
                    (!needs_position || m.position.is_some()) && (!needs_rate || m.rate.is_some())
                }
                (On::Equation, Place::Equation(_)) => true,
                (On::Input, Place::Input(i)) => {
                    let name = &model.inputs[*i].name;
                    model.equations.iter().any(|e| e.residual().mentions(name))
                }
                (On::Measurement, Place::Measurement(_)) => true,
                _ => false,
            };
            if fits {
                out.push(Candidate { mechanism: i, place: place.clone(), mirrored: false });
                if mechanism.mirror {
                    out.push(Candidate { mechanism: i, place: place.clone(), mirrored: true });
                }
            }
        }
    }
    out
}

fn mentions(law: &Expr, primes: u8) -> bool {
    law.contains("d", primes)
}

impl Candidate {
    /// An expression of the mechanism file in the model's own names; `rename` maps its parameters.
    pub fn translate(&self, model: &Model, e: &Expr, rename: &dyn Fn(&str) -> String) -> Expr {
        e.substitute(&|name, primes| match (name, &self.place) {
            ("d", Place::Motion(Motion { position, rate, .. })) => {
                let of = if primes == 0 { position } else { rate };
                of.clone().map(|d| if self.mirrored { -d } else { d })
            }
            ("u", Place::Input(i)) if primes == 0 => Some(Expr::var(&model.inputs[*i].name)),
            ("y", Place::Measurement(c)) if primes == 0 => Some(model.measurements[*c].expr.clone()),
            ("t" | "pi" | "d" | "u" | "y", _) => None,
            _ => Some(Expr::var(&rename(name))),
        })
    }

    /// Names for the mechanism's parameters that the model does not use yet: as the library writes
    /// them, else with the equation's name behind.
    pub fn names(&self, model: &Model, mechanism: &Mechanism) -> Vec<String> {
        let taken = |n: &str| {
            model.parameter(n).is_some()
                || model.state(n).is_some()
                || model.input(n).is_some()
                || matches!(n, "t" | "pi")
        };
        let suffix = self.place.equations(model).first().cloned().unwrap_or_default();
        let plain: Vec<String> = mechanism.parameters().map(str::to_string).collect();
        if plain.iter().any(|n| taken(n)) {
            plain
                .iter()
                .map(|n| {
                    let with = format!("{n}_{suffix}");
                    if taken(&with) { model.fresh_name(&with) } else { with }
                })
                .collect()
        } else {
            plain
        }
    }

    /// Adds the mechanism to a model, its parameters at `values` (order of
    /// [`Mechanism::parameters`]).
    pub fn insert(&self, model: &mut Model, mechanism: &Mechanism, values: &[f64]) -> Instance {
        let names = self.names(model, mechanism);
        let plain: Vec<String> = mechanism.parameters().map(str::to_string).collect();
        let rename =
            |n: &str| plain.iter().position(|p| p == n).map_or_else(|| n.to_string(), |i| names[i].clone());
        let mut law = self.translate(model, &mechanism.law, &rename).simplify();
        match &self.place {
            Place::Motion(motion) => {
                if self.mirrored {
                    // A push towards −d is a negative force along d.
                    law = (-law).simplify();
                }
                for (e, &w) in motion.weights.iter().enumerate() {
                    if w != 0.0 {
                        let term = if w == 1.0 {
                            law.clone()
                        } else if w == -1.0 {
                            -law.clone()
                        } else {
                            Expr::Num(w) * law.clone()
                        };
                        model.add_term(e, term);
                    }
                }
            }
            Place::Equation(e) => model.add_term(*e, law.clone()),
            Place::Input(i) => {
                let name = model.inputs[*i].name.clone();
                model.replace(&name, 0, &law);
            }
            Place::Measurement(c) => model.measurements[*c].expr = law.clone(),
        }
        for (name, value) in names.iter().zip(values) {
            model.parameters.push(Parameter {
                name: name.clone(),
                value: *value,
                unit: None,
                std: None,
                fixed: false,
            });
        }
        Instance { candidate: self.clone(), names, expression: law }
    }

    /// The mechanism's parameters as unknowns of a fit; `scales[i]` is the size of inner parameter i.
    pub fn free(&self, mechanism: &Mechanism, first: usize, scales: &[f64]) -> Vec<Free> {
        let positive = |n: &str| mechanism.positive.iter().any(|p| p == n);
        let mut out = Vec::new();
        for (i, name) in mechanism.linear.iter().enumerate() {
            let lower = if positive(name) { 0.0 } else { f64::NEG_INFINITY };
            out.push(Free { index: first + i, mean: 0.0, std: f64::INFINITY, lower, upper: f64::INFINITY });
        }
        for (i, inner) in mechanism.inner.iter().enumerate() {
            let scale = scales[i].abs().max(1e-300);
            // A positive parameter may run down to zero unless the file says otherwise.
            let free_to_zero = positive(&inner.name) && inner.low <= 1e-3;
            out.push(Free {
                index: first + mechanism.linear.len() + i,
                mean: 0.0,
                std: f64::INFINITY,
                lower: if free_to_zero { 0.0 } else { inner.low * scale },
                upper: inner.high * scale,
            });
        }
        out
    }
}
