//! Where a force could act: read off the nominal equations.
//!
//! Each equation has a coordinate of its own (matched through the mass matrix). Beyond that, every
//! parameter p whose derivative of the equations is rank one, ∂(equations)/∂p = w·g with constant w
//! and g linear in the coordinates (or rates), shows an element of the machine: a spring or a damper
//! that acts on the motion d = g with the weights w on the equations, so that action equals reaction.
//! A missing force F(d, d') at that element enters equation e as w_e F.
//!
//! The other places: an equation as a whole, an input, a measurement, a parameter (that may drift), a
//! spring (a parameter k whose element is a position, so that its term is w k d), a pair of coordinates
//! (that may be coupled), and a motion with the force that its joint transmits.

use greybox_model::{Dimension, Expr, Model};

use crate::library::Domain;

/// A place of the model.
#[derive(Debug, Clone, PartialEq)]
pub enum Place {
    /// A motion with its weights on the equations.
    Motion(Motion),
    /// An equation as a whole.
    Equation(usize),
    /// An input.
    Input(usize),
    /// A measurement.
    Measurement(usize),
    /// A parameter of the nominal model.
    Parameter(usize),
    /// The term w·k·d of a parameter k.
    Spring {
        /// d with its weights.
        motion: Motion,
        /// Index of k.
        parameter: usize,
        /// The term is `factor`·k·d.
        factor: f64,
        /// Primes of the coordinates in d; the motion's `position` is d at this level.
        level: u8,
        /// The parameter multiplies nothing but d (no reference that a feedback compares d with).
        alone: bool,
    },
    /// The equation of one coordinate and another coordinate.
    Pair {
        /// d.
        own: Motion,
        /// o.
        other: Motion,
    },
    /// A motion with the force that its joint transmits.
    Load {
        /// d.
        motion: Motion,
        /// The force, without highest derivatives.
        load: Expr,
    },
}

/// A motion on which forces can act.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Weight of the force in each equation.
    pub weights: Vec<f64>,
    /// Coefficients of the motion in the states.
    pub coefficients: Vec<f64>,
    /// d, where the model knows it.
    pub position: Option<Expr>,
    /// d', where the model knows it.
    pub rate: Option<Expr>,
    /// d'', where the motion is that of second-order coordinates.
    pub acceleration: Option<Expr>,
}

impl Place {
    /// Names of the equations where it enters, the one that the report names first.
    pub fn equations(&self, model: &Model) -> Vec<String> {
        match self {
            Place::Motion(m) | Place::Spring { motion: m, .. } | Place::Load { motion: m, .. } => {
                weighted_equations(model, &m.weights, &m.coefficients)
            }
            Place::Pair { own, .. } => weighted_equations(model, &own.weights, &own.coefficients),
            Place::Parameter(p) => {
                let name = &model.parameters[*p].name;
                let with = model.equations.iter().filter(|e| e.residual().mentions(name));
                with.map(|e| e.name.clone()).collect()
            }
            Place::Equation(e) => vec![model.equations[*e].name.clone()],
            Place::Input(i) => {
                let name = &model.inputs[*i].name;
                model
                    .equations
                    .iter()
                    .filter(|e| e.residual().mentions(name))
                    .map(|e| e.name.clone())
                    .collect()
            }
            Place::Measurement(c) => {
                let expr = &model.measurements[*c].expr;
                let mut names = Vec::new();
                for (e, own) in model.equations.iter().zip(own_coordinates(model)) {
                    if own.is_some_and(|j| expr.mentions(&model.states[j].name)) {
                        names.push(e.name.clone());
                    }
                }
                names
            }
        }
    }
}

/// What an equation is about, as far as its order and its units show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Realm {
    /// Something moves: its coordinate is of second order, or a velocity.
    Motion,
    /// Heat or electricity: of first order, with the units of either.
    ThermalOrElectrical,
    /// Something else of first order, or unknown.
    Other,
}

fn realm(model: &Model, equation: usize, own: Option<usize>) -> Realm {
    let Some(state) = own.map(|j| &model.states[j]) else { return Realm::Other };
    let unit = state.unit.dimension;
    if state.order > 1 || is_velocity(&unit) {
        return Realm::Motion;
    }
    // The exponents of A and K.
    let shows = |d: &Dimension| d.si_exponents()[3..5].iter().any(|e| *e != 0.0);
    let length = Dimension::from_si([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let power = Dimension::from_si([2.0, 1.0, -3.0, 0.0, 0.0, 0.0, 0.0]);
    // A position or an angle may be driven by a voltage.
    let position = unit.is_none() || unit.same(&length);
    let balance = || model.dimension_of(&model.equations[equation].residual()).ok();
    match shows(&unit) || (!position && balance().is_some_and(|d| shows(&d) || d.same(&power))) {
        true => Realm::ThermalOrElectrical,
        false => Realm::Other,
    }
}

impl Place {
    fn realms(&self, model: &Model) -> Vec<Realm> {
        let own = own_coordinates(model);
        let names = self.equations(model);
        let of = |name: &String| {
            let e = model.equation(name)?;
            Some(realm(model, e, own.get(e).copied().flatten()))
        };
        names.iter().filter_map(of).collect()
    }

    /// Whether something moves in one of its equations, or nothing is known of them.
    pub fn moves(&self, model: &Model) -> bool {
        let realms = self.realms(model);
        realms.is_empty() || realms.contains(&Realm::Motion)
    }

    /// Whether a mechanism of this domain makes sense there: bodies do not rub in a thermal or an electrical equation.
    /// Where units do not show what an equation is about, everything does.
    pub fn admits(&self, domain: Option<Domain>, model: &Model) -> bool {
        match domain {
            None => true,
            Some(Domain::Mechanical) => {
                let realms = self.realms(model);
                realms.is_empty() || realms.iter().any(|r| *r != Realm::ThermalOrElectrical)
            }
        }
    }
}

/// Names of the equations with weight, the one whose own coordinate is the motion first.
fn weighted_equations(model: &Model, weights: &[f64], coefficients: &[f64]) -> Vec<String> {
    let own = own_coordinates(model);
    let mut named: Vec<usize> = (0..weights.len().min(own.len())).filter(|&e| weights[e] != 0.0).collect();
    named.sort_by_key(|&e| {
        let alone =
            own[e].is_some_and(|j| coefficients.iter().enumerate().all(|(i, c)| (*c != 0.0) == (i == j)));
        (!alone, e)
    });
    named.into_iter().map(|e| model.equations[e].name.clone()).collect()
}

/// The state each equation governs: a matching of equations to states through the mass matrix that
/// prefers, for each equation, a coordinate that also appears in its other terms.
pub fn own_coordinates(model: &Model) -> Vec<Option<usize>> {
    let n = model.states.len();
    let highest: Vec<(&str, u8)> = model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
    let mut likes = vec![vec![0u8; n]; n];
    for (e, equation) in model.equations.iter().enumerate() {
        if let Some((mass, rest)) = equation.residual().affine_in(&highest) {
            for j in 0..n {
                if mass[j].simplify() != Expr::Num(0.0) {
                    likes[e][j] = 1 + rest.mentions(&model.states[j].name) as u8;
                }
            }
        }
    }
    // n is small: the best assignment by depth-first search, the first best one counts.
    fn search(
        likes: &[Vec<u8>],
        e: usize,
        used: &mut Vec<Option<usize>>,
        best: &mut (u32, Vec<Option<usize>>),
        score: u32,
    ) {
        if e == likes.len() {
            if score > best.0 || best.1.is_empty() {
                *best = (score, used.clone());
            }
            return;
        }
        for j in 0..likes.len() {
            if likes[e][j] > 0 && !used[..e].contains(&Some(j)) {
                used[e] = Some(j);
                search(likes, e + 1, used, best, score + 100 + likes[e][j] as u32);
                used[e] = None;
            }
        }
        if n_too_many(likes.len()) {
            return;
        }
        search(likes, e + 1, used, best, score);
    }
    fn n_too_many(n: usize) -> bool {
        n > 8
    }
    let mut best = (0, Vec::new());
    search(&likes, 0, &mut vec![None; n], &mut best, 0);
    if best.1.is_empty() { vec![None; n] } else { best.1 }
}

/// All places of a model: motions (own coordinates first, then rank-one elements), equations, inputs,
/// measurements, parameters, springs, pairs, loads.
pub fn places(model: &Model) -> Vec<Place> {
    let n = model.states.len();
    let mut motions: Vec<Motion> = Vec::new();
    let mut add = |weights: Vec<f64>, coefficients: Vec<f64>| {
        if let Some(motion) = motion(model, weights, coefficients)
            && !motions.iter().any(|m| same(m, &motion))
        {
            motions.push(motion);
        }
    };
    let alone = |e: usize, j: usize| {
        let (mut w, mut c) = (vec![0.0; n], vec![0.0; n]);
        w[e] = 1.0;
        c[j] = 1.0;
        (w, c)
    };
    let own: Vec<(usize, usize)> =
        own_coordinates(model).into_iter().enumerate().filter_map(|(e, own)| own.map(|j| (e, j))).collect();
    for &(e, j) in &own {
        let (w, c) = alone(e, j);
        add(w, c);
    }
    let mut springs = Vec::new();
    for (index, parameter) in model.parameters.iter().enumerate() {
        if let Some(element) = rank_one(model, &parameter.name) {
            if let Some(mut motion) = motion(model, element.weights.clone(), element.coefficients.clone()) {
                let at_level = if element.level == 0 { motion.position.clone() } else { motion.rate.clone() };
                if element.level == 1 || at_level.is_some() {
                    motion.position = at_level;
                    springs.push(Place::Spring {
                        motion,
                        parameter: index,
                        factor: element.factor,
                        level: element.level,
                        alone: element.alone,
                    });
                }
            }
            if element.alone {
                add(element.weights, element.coefficients);
            }
        }
    }
    let mut out: Vec<Place> = motions.into_iter().map(Place::Motion).collect();
    out.extend((0..model.equations.len()).map(Place::Equation));
    out.extend((0..model.inputs.len()).map(Place::Input));
    out.extend((0..model.measurements.len()).map(Place::Measurement));
    out.extend(
        (0..model.parameters.len())
            .filter(|&p| {
                let name = &model.parameters[p].name;
                !model.parameters[p].fixed && model.equations.iter().any(|e| e.residual().mentions(name))
            })
            .map(Place::Parameter),
    );
    out.extend(springs);
    let single: Vec<Motion> = own
        .iter()
        .filter_map(|&(e, j)| {
            let (w, c) = alone(e, j);
            motion(model, w, c)
        })
        .collect();
    for (i, own) in single.iter().enumerate() {
        for (k, other) in single.iter().enumerate() {
            if i != k && own.position.is_some() == other.position.is_some() {
                out.push(Place::Pair { own: own.clone(), other: other.clone() });
            }
        }
    }
    for (motion, &(e, j)) in single.iter().zip(&own) {
        if motion.rate.is_some() {
            out.extend(
                loads(model, e, j).into_iter().map(|load| Place::Load { motion: motion.clone(), load }),
            );
        }
    }
    out
}

/// What the joint of coordinate `own` may transmit: the drive terms of its equation together, and its
/// position terms together. Constant factors of one common sign stay; highest derivatives never appear. A drive that weakens
/// with the speed is one, written as a product: the torque k·(v − k·ω)/R of a motor behind its winding.
fn loads(model: &Model, equation: usize, own: usize) -> Vec<Expr> {
    let residual = model.equations[equation].residual();
    let (mut drive, mut position): (Option<Expr>, Option<Expr>) = (None, None);
    for (negative, term) in residual.terms() {
        let mut highest = false;
        let mut rate = false;
        let mut input = false;
        let mut coordinate = false;
        for (name, primes) in term.variables() {
            if let Some(j) = model.state(&name) {
                let order = model.states[j].order;
                highest |= primes as usize >= order;
                rate |= primes > 0;
                coordinate |= primes == 0 && (j != own || order > 1);
            }
            input |= model.input(&name).is_some();
        }
        if highest || (rate && !input) {
            continue;
        }
        let sum = if input {
            &mut drive
        } else if coordinate {
            &mut position
        } else {
            continue;
        };
        *sum = Some(match (sum.take(), negative) {
            (None, false) => term.clone(),
            (None, true) => -term.clone(),
            (Some(s), false) => s + term.clone(),
            (Some(s), true) => s - term.clone(),
        });
    }
    // The sign does not matter under abs(): without a leading minus.
    [drive, position]
        .into_iter()
        .flatten()
        .map(|e| match e {
            Expr::Neg(inner) => *inner,
            other => other,
        })
        .collect()
}

fn same(a: &Motion, b: &Motion) -> bool {
    let close = |x: &[f64], y: &[f64]| x.iter().zip(y).all(|(x, y)| (x - y).abs() < 1e-9);
    let flipped: Vec<f64> = b.coefficients.iter().map(|c| -c).collect();
    let against: Vec<f64> = b.weights.iter().map(|c| -c).collect();
    (close(&a.coefficients, &b.coefficients) && close(&a.weights, &b.weights))
        || (close(&a.coefficients, &flipped) && close(&a.weights, &against))
}

/// An element of the machine behind a parameter p: its term in equation e is `factor`·w_e·p·(g + rest).
struct Element {
    weights: Vec<f64>,
    coefficients: Vec<f64>,
    factor: f64,
    /// Primes of the states in g.
    level: u8,
    /// Nothing but states in it (no reference that a feedback compares with).
    alone: bool,
}

/// The element behind a parameter, if it is one.
fn rank_one(model: &Model, parameter: &str) -> Option<Element> {
    let n = model.states.len();
    let mut rows: Vec<Option<(u8, Vec<f64>)>> = Vec::new();
    let mut alone = true;
    for equation in &model.equations {
        let g = equation.residual().derivative(parameter, 0).simplify();
        if g == Expr::Num(0.0) {
            rows.push(None);
            continue;
        }
        let (level, form, pure) = linear_form(model, &g)?;
        alone &= pure;
        rows.push(Some((level, form)));
    }
    let (level, form) = rows.iter().flatten().next()?.clone();
    let lead = form.iter().copied().find(|c| *c != 0.0)?;
    let coefficients: Vec<f64> = form.iter().map(|c| c / lead).collect();
    let mut weights = vec![0.0; n];
    for (e, row) in rows.iter().enumerate() {
        if let Some((l, form)) = row {
            if *l != level {
                return None;
            }
            let at = coefficients.iter().position(|c| *c != 0.0)?;
            let w = form[at];
            if form.iter().zip(&coefficients).any(|(f, c)| (f - w * c).abs() > 1e-9) {
                return None;
            }
            weights[e] = w;
        }
    }
    // A parameter of the inertia is no place for a force.
    if model.states.iter().zip(&coefficients).any(|(s, c)| *c != 0.0 && level as usize >= s.order) {
        return None;
    }
    // Force per unit weight: make the largest weight one, so that F is the force itself.
    let factor = weights.iter().fold(0.0f64, |m, w| m.max(w.abs()));
    let weights = weights.iter().map(|w| w / factor).collect();
    Some(Element { weights, coefficients, factor, level, alone })
}

/// `g` as a linear form with constant coefficients in the states' derivatives of one common level, and
/// whether nothing stands beside them.
fn linear_form(model: &Model, g: &Expr) -> Option<(u8, Vec<f64>, bool)> {
    for level in 0..2u8 {
        let symbols: Vec<(&str, u8)> = model.states.iter().map(|s| (s.name.as_str(), level)).collect();
        if let Some((coefficients, rest)) = g.affine_in(&symbols)
            && !rest.variables().iter().any(|(n, _)| model.state(n).is_some())
        {
            let pure = rest.simplify() == Expr::Num(0.0);
            let numbers: Option<Vec<f64>> = coefficients.iter().map(|c| c.simplify().constant()).collect();
            if let Some(numbers) = numbers
                && numbers.iter().any(|c| *c != 0.0)
            {
                return Some((level, numbers, pure));
            }
        }
    }
    None
}

/// The expressions of a motion. A first-order state whose unit is a velocity (m/s, 1/s) is the rate of
/// a motion whose position the model does not know; any other first-order state is a position whose
/// rate is the highest derivative, on which no force may depend.
fn motion(model: &Model, weights: Vec<f64>, coefficients: Vec<f64>) -> Option<Motion> {
    let mut kinds = Vec::new();
    for (state, c) in model.states.iter().zip(&coefficients) {
        if *c != 0.0 {
            kinds.push(match state.order {
                1 if is_velocity(&state.unit.dimension) => 1,
                1 => 0,
                _ => 2,
            });
        }
    }
    let first = *kinds.first()?;
    if kinds.iter().any(|k| *k != first) {
        return None;
    }
    let combine = |primes: u8| {
        let mut sum: Option<Expr> = None;
        for (state, &c) in model.states.iter().zip(&coefficients) {
            if c == 0.0 {
                continue;
            }
            let symbol = Expr::prime(&state.name, primes);
            let term = if c.abs() == 1.0 { symbol } else { Expr::Num(c.abs()) * symbol };
            sum = Some(match (sum, c > 0.0) {
                (None, true) => term,
                (None, false) => -term,
                (Some(s), true) => s + term,
                (Some(s), false) => s - term,
            });
        }
        sum
    };
    let (position, rate, acceleration) = match first {
        1 => (None, combine(0), combine(1)),
        0 => (combine(0), None, None),
        _ => (combine(0), combine(1), combine(2)),
    };
    Some(Motion { weights, coefficients, position, rate, acceleration })
}

fn is_velocity(d: &Dimension) -> bool {
    // m/s, or 1/s (rad/s)
    let declared = d.declared().next().is_some();
    let d = d.si_exponents();
    !declared
        && d[2] == -1.0
        && d[1] == 0.0
        && d[3..].iter().all(|v| *v == 0.0)
        && (d[0] == 1.0 || d[0] == 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOM: &str = r#"
        [inputs]
        P = { unit = "W" }
        [states]
        T = { unit = "K" }
        h = { unit = "m" }
        q = { unit = "C" }
        x = { unit = "m" }
        w = { unit = "rad/s" }
        s = { unit = "m" }
        [parameters]
        C = { value = 1.0, unit = "J/K" }
        G = { value = 1.0, unit = "W/K" }
        A = { value = 1.0, unit = "m^2" }
        r = { value = 1.0, unit = "m^2/s" }
        R = { value = 1.0, unit = "Ohm" }
        D = { value = 1.0, unit = "F" }
        m = { value = 1.0, unit = "kg" }
        k = { value = 1.0, unit = "N/m" }
        J = { value = 1.0, unit = "kg m^2" }
        b = { value = 1.0, unit = "N m s" }
        E = { value = 1.0, unit = "V s/m" }
        e = { value = 1.0, unit = "V/m" }
        [equations]
        room    = "C*T' + G*T = P"
        tank    = "A*h' + r*h = 0"
        circuit = "R*q' + q/D = 0"
        slide   = "m*x'' + k*x = 0"
        rotor   = "J*w' + b*w = 0"
        servo   = "E*s' + e*s = 0"
    "#;

    #[test]
    fn units_and_order_show_what_an_equation_is_about() {
        let model = Model::from_toml(ROOM, "room.toml").unwrap();
        let own = own_coordinates(&model);
        let realms: Vec<Realm> = own.iter().enumerate().map(|(e, own)| realm(&model, e, *own)).collect();
        use Realm::{Motion, Other, ThermalOrElectrical};
        assert_eq!(realms, [ThermalOrElectrical, Other, ThermalOrElectrical, Motion, Motion, Other]);
        let moves: Vec<bool> = (0..6).map(|e| Place::Equation(e).moves(&model)).collect();
        assert_eq!(moves, [false, false, false, true, true, false]);
        let admits = |e| Place::Equation(e).admits(Some(Domain::Mechanical), &model);
        assert_eq!((0..6).map(admits).collect::<Vec<bool>>(), [false, true, false, true, true, true]);
        assert!((0..6).all(|e| Place::Equation(e).admits(None, &model)));
        // Without units nothing is known, and nothing is left out.
        let bare: String = ROOM
            .lines()
            .map(|line| match line.split_once("unit = ") {
                Some((before, _)) => format!("{}}}\n", before.trim_end_matches([',', ' '])),
                None => format!("{line}\n"),
            })
            .collect();
        let bare = Model::from_toml(&bare, "bare.toml").unwrap();
        assert!((0..6).all(|e| Place::Equation(e).admits(Some(Domain::Mechanical), &bare)));
    }
}
