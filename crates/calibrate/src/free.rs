//! Which parameters a fit may move, within which bounds, and what is known of them before.

use greybox_model::{Dimension, Expr, Model};

use crate::problem::{FreeParameter, Prior};

/// Scale of the prior of a parameter whose uncertainty is not stated, over its value.
const UNSTATED: f64 = 0.5;

/// Least value of a parameter that keeps its sign, over its nominal value.
const LEAST: f64 = 1e-3;

/// Most states whose equations are matched to coordinates by trying all orders.
const MATCHED: usize = 7;

/// The parameters calibration may move: those not fixed.
///
/// | stated | prior |
/// |---|---|
/// | `std` | normal, N(value, std) |
/// | nothing | Cauchy about the value, scale \|value\|/2: a guess that may be wrong by orders of magnitude |
/// | a value of zero without `std`, or a temperature | none: where zero stands on its scale says nothing of it |
///
/// A parameter may cross zero, but for those that physics keeps from it: where `positive = true` is stated, and where
/// nothing is stated those that [`keeps_sign`] finds.
pub fn free_parameters(model: &Model) -> Vec<FreeParameter> {
    let structure = Structure::of(model);
    model
        .parameters
        .iter()
        .enumerate()
        .filter(|(_, p)| !p.fixed)
        .map(|(index, p)| {
            // Twice as many degrees are not twice as hot.
            let temperature = p.unit.as_ref().is_some_and(|u| u.dimension.same(&Dimension::TEMPERATURE));
            let prior = match p.std {
                Some(std) if std > 0.0 => Prior::Normal { mean: p.value, std },
                _ if temperature => Prior::Flat,
                _ if p.value != 0.0 => Prior::Cauchy { centre: p.value, scale: UNSTATED * p.value.abs() },
                _ => Prior::Flat,
            };
            let keeps = p.positive.unwrap_or_else(|| structure.keeps_sign(model, index));
            let (lower, upper) = if keeps && p.value > 0.0 {
                (LEAST * p.value, f64::INFINITY)
            } else if keeps && p.value < 0.0 {
                (f64::NEG_INFINITY, LEAST * p.value)
            } else {
                (f64::NEG_INFINITY, f64::INFINITY)
            };
            FreeParameter { index, prior, lower, upper }
        })
        .collect()
}

/// Whether physics keeps a parameter from crossing zero, as far as the equations tell:
///
/// * an inertia, a mass, a capacity: it adds to the coefficient of the highest derivative of an equation's own
///   coordinate;
/// * a stiffness: it adds to the coefficient of the own position of an equation of motion, with the sign of the inertia;
/// * one at whose zero, or beyond it, the equations have no value: a resistance in a denominator, the argument of a root.
///
/// An equation's own coordinate is the one with which the product of the matched entries of the mass matrix is largest.
pub fn keeps_sign(model: &Model, parameter: usize) -> bool {
    Structure::of(model).keeps_sign(model, parameter)
}

/// The mass matrix at a point that is nothing special, and each equation's own coordinate.
struct Structure {
    residuals: Vec<Expr>,
    mass: Vec<Vec<Expr>>,
    own: Vec<usize>,
}

/// A value for every symbol: parameters as given, the rest arbitrary, the same for a name every time.
fn generic(model: &Model, name: &str, primes: u8) -> f64 {
    if let Some(i) = model.parameter(name) {
        return model.parameters[i].value;
    }
    let code = name.bytes().fold(11 + u64::from(primes), |h, b| (h * 131 + u64::from(b)) % 10_007);
    0.2 + (code % 997) as f64 / 1500.0
}

impl Structure {
    fn of(model: &Model) -> Structure {
        let highest: Vec<(&str, u8)> =
            model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let residuals: Vec<Expr> = model.equations.iter().map(greybox_model::Equation::residual).collect();
        let mass: Vec<Vec<Expr>> =
            residuals.iter().map(|r| r.affine_in(&highest).map_or_else(Vec::new, |(m, _)| m)).collect();
        let sizes: Vec<Vec<f64>> = mass
            .iter()
            .map(|row| {
                let value = |e: &Expr| e.eval(&|n, p| Some(generic(model, n, p)));
                row.iter().map(|e| value(e).filter(|v| v.is_finite()).unwrap_or(0.0).abs()).collect()
            })
            .collect();
        let own = matched(&sizes);
        Structure { residuals, mass, own }
    }

    fn keeps_sign(&self, model: &Model, parameter: usize) -> bool {
        let name = &model.parameters[parameter].name;
        let at = |scale: f64| {
            move |n: &str, p: u8| {
                let value = generic(model, n, p);
                Some(if n == name { scale * value } else { value })
            }
        };
        let known = |e: &Expr, scale: f64| e.eval(&at(scale)).is_some_and(f64::is_finite);
        let measured = model.measurements.iter().map(|m| &m.expr);
        let undefined = self
            .residuals
            .iter()
            .chain(measured)
            .filter(|e| e.mentions(name) && known(e, 1.0))
            .any(|e| !known(e, 0.0) || !known(e, -1.0));
        undefined || (0..self.own.len()).any(|e| self.adds_to_own(model, e, name))
    }

    /// Whether a parameter adds to the inertia or the stiffness of an equation's own coordinate.
    fn adds_to_own(&self, model: &Model, equation: usize, name: &str) -> bool {
        let j = self.own[equation];
        let Some(inertia) = self.mass[equation].get(j) else { return false };
        let value = |e: &Expr| e.eval(&|n, p| Some(generic(model, n, p))).unwrap_or(0.0);
        let sign = value(inertia);
        // What the parameter itself adds: the slope times its value.
        let own = model.parameter(name).map_or(0.0, |i| model.parameters[i].value);
        let adds = |e: &Expr| value(&e.derivative(name, 0)) * own * sign > 0.0;
        if inertia.mentions(name) && adds(inertia) {
            return true;
        }
        let state = &model.states[j];
        let force = self.residuals[equation].derivative(name, 0).simplify();
        let slope = force.derivative(&state.name, 0).simplify();
        state.order == 2 && slope.constant().is_some_and(|k| k * own * sign > 0.0)
    }
}

/// Per row the column that it is matched to, so that the product of the matched entries is largest.
fn matched(sizes: &[Vec<f64>]) -> Vec<usize> {
    let n = sizes.len();
    let identity: Vec<usize> = (0..n).collect();
    if n > MATCHED || sizes.iter().any(|row| row.len() != n) {
        return identity;
    }
    let mut best = (f64::NEG_INFINITY, identity.clone());
    let mut order = identity;
    permute(&mut order, 0, &mut |order| {
        let product = order.iter().zip(sizes).map(|(&j, row)| row[j].ln()).sum::<f64>();
        if product > best.0 {
            best = (product, order.to_vec());
        }
    });
    best.1
}

/// Calls `visit` with every order of the entries from `first` on.
fn permute(order: &mut [usize], first: usize, visit: &mut dyn FnMut(&[usize])) {
    if first == order.len() {
        return visit(order);
    }
    for i in first..order.len() {
        order.swap(first, i);
        permute(order, first + 1, visit);
        order.swap(first, i);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn signs(text: &str) -> Vec<(String, bool)> {
        let model = Model::from_toml(text, "model.toml").unwrap();
        let free = free_parameters(&model);
        free.iter().map(|f| (model.parameters[f.index].name.clone(), f.lower.is_finite())).collect()
    }

    fn expect(text: &str, kept: &[&str]) {
        for (name, keeps) in signs(text) {
            assert_eq!(keeps, kept.contains(&name.as_str()), "{name}");
        }
    }

    #[test]
    fn inertias_stiffnesses_and_what_stands_in_a_denominator_keep_their_sign() {
        expect(
            r#"
            [inputs]
            v = { unit = "V" }
            [states]
            theta = { unit = "rad" }
            alpha = { unit = "rad" }
            [parameters]
            J  = { value = 0.002, unit = "kg m^2" }
            Jl = { value = 0.003, unit = "kg m^2" }
            ks = { value = 1.0, unit = "N m/rad" }
            B  = { value = 0.02, unit = "N m s" }
            kt = { value = 0.1, unit = "N m/A" }
            R  = { value = 2.0, unit = "ohm" }
            [equations]
            hub  = "J*theta'' + B*theta' - ks*alpha = kt/R*v"
            link = "Jl*(theta'' + alpha'') + ks*alpha = 0"
            "#,
            &["J", "Jl", "ks", "R"],
        );
    }

    #[test]
    fn an_inertia_coupling_and_the_moment_of_gravity_may_have_either_sign() {
        expect(
            r#"
            [states]
            q1 = { unit = "rad" }
            q2 = { unit = "rad" }
            [parameters]
            A = { value = 0.01, unit = "kg m^2" }
            B = { value = 0.003, unit = "kg m^2" }
            C = { value = 0.003, unit = "kg m^2" }
            G = { value = 0.5, unit = "N m" }
            [equations]
            upper = "A*q1'' + C*cos(q1 - q2)*q2'' + G*sin(q1) = 0"
            lower = "B*q2'' + C*cos(q1 - q2)*q1'' = 0"
            "#,
            &["A", "B"],
        );
    }

    /// Twice 20 degC is another temperature than twice 293.15 K.
    #[test]
    fn the_prior_of_a_temperature_does_not_depend_on_its_zero() {
        let priors = |room: &str| -> Vec<Prior> {
            let text = format!(
                "[states]\nT = {{ unit = \"degC\" }}\n[parameters]\ntau = {{ value = 4, unit = \"s\" }}\n\
                 To = {{ {room} }}\n[equations]\nheat = \"tau*T' + T = To\"\n"
            );
            let model = Model::from_toml(&text, "model.toml").unwrap();
            free_parameters(&model).into_iter().map(|f| f.prior).collect()
        };
        let weak = Prior::Cauchy { centre: 4.0, scale: 2.0 };
        for room in ["value = 20, unit = \"degC\"", "value = 293.15, unit = \"K\"", "value = 20"] {
            assert_eq!(priors(room), [weak, Prior::Flat], "{room}");
        }
        let stated = priors("value = 20, unit = \"degC\", std = 3");
        assert_eq!(stated, [weak, Prior::Normal { mean: 293.15, std: 3.0 }]);
        let stated = priors("value = 68, unit = \"degF\", std = 9");
        let Prior::Normal { mean, std } = stated[1] else { panic!("{stated:?}") };
        assert!((mean - 293.15).abs() < 1e-12 && std == 5.0);
    }

    #[test]
    fn what_is_stated_counts() {
        expect(
            r#"
            [states]
            x = { unit = "m" }
            [parameters]
            m = { value = 1.0, unit = "kg" }
            k = { value = 5.0, unit = "N/m", positive = false }
            b = { value = 0.1, unit = "N s/m", positive = true }
            [equations]
            cart = "m*x'' + b*x' + k*x = 0"
            "#,
            &["m", "b"],
        );
    }
}
