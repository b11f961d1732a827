//! Where a force could act: read off the nominal equations.
//!
//! Each equation has a coordinate of its own (matched through the mass matrix). Beyond that, every
//! parameter p whose derivative of the equations is rank one, ∂(equations)/∂p = w·g with constant w
//! and g affine in the coordinates (or rates), shows an element of the machine: a spring or a damper
//! that acts on the motion d = g with the weights w on the equations, so that action equals reaction.
//! What stands in g beside the coordinates is a reference, a parameter or an input: the ambient
//! temperature of a heat loss, the road under a tire. A missing force F(d, d') at that element enters equation e as w_e F.
//!
//! The other places: an equation as a whole, an input, a measurement, a parameter (that may drift), a
//! spring (a parameter k whose element is a position, so that its term is w k d), a pair of coordinates
//! (that may be coupled), and a motion with the force that its joint transmits.

use greybox_model::{Dimension, Expr, Model};

use crate::library::{Domain, arbitrary};

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
    let mut add = |motion: Option<Motion>| {
        if let Some(motion) = motion
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
        add(motion(model, w, c));
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
                        alone: element.reference == Reference::None,
                    });
                }
            }
            let motion = motion(model, element.weights, element.coefficients);
            add(motion.and_then(|m| m.about(model, element.reference, element.level)));
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
    let about = |sign: f64| {
        let pairs = [(&a.position, &b.position), (&a.rate, &b.rate)];
        pairs.into_iter().all(|(a, b)| match (a, b) {
            (Some(a), Some(b)) => agree(a, &(Expr::Num(sign) * b.clone())),
            (a, b) => a.is_none() && b.is_none(),
        })
    };
    (close(&a.coefficients, &b.coefficients) && close(&a.weights, &b.weights) && about(1.0))
        || (close(&a.coefficients, &flipped) && close(&a.weights, &against) && about(-1.0))
}

/// An element of the machine behind a parameter p: its term in equation e is `factor`·w_e·p·(g + rest).
struct Element {
    weights: Vec<f64>,
    coefficients: Vec<f64>,
    factor: f64,
    /// Primes of the states in g.
    level: u8,
    reference: Reference,
}

/// What stands beside the states in the motion of an element.
#[derive(Debug, Clone, PartialEq)]
enum Reference {
    /// Nothing.
    None,
    /// What is added to the motion: −Ta in T − Ta.
    Of(Expr),
    /// Not the same in all equations.
    Several,
}

/// The element behind a parameter, if it is one.
fn rank_one(model: &Model, parameter: &str) -> Option<Element> {
    let n = model.states.len();
    let mut rows: Vec<Option<(u8, Vec<f64>, Expr)>> = Vec::new();
    for equation in &model.equations {
        let g = equation.residual().derivative(parameter, 0).simplify();
        if g == Expr::Num(0.0) {
            rows.push(None);
            continue;
        }
        rows.push(Some(affine_form(model, &g)?));
    }
    let (level, form, rest) = rows.iter().flatten().next()?.clone();
    let lead = form.iter().copied().find(|c| *c != 0.0)?;
    let coefficients: Vec<f64> = form.iter().map(|c| c / lead).collect();
    let beside = |rest: &Expr, w: f64| (Expr::Num(1.0 / w) * rest.clone()).simplify();
    let mut reference = match beside(&rest, lead) {
        Expr::Num(0.0) => Reference::None,
        other => Reference::Of(other),
    };
    let mut weights = vec![0.0; n];
    for (e, row) in rows.iter().enumerate() {
        if let Some((l, form, rest)) = row {
            if *l != level {
                return None;
            }
            let at = coefficients.iter().position(|c| *c != 0.0)?;
            let w = form[at];
            if form.iter().zip(&coefficients).any(|(f, c)| (f - w * c).abs() > 1e-9) {
                return None;
            }
            weights[e] = w;
            let is_same = match &reference {
                Reference::None => rest.simplify() == Expr::Num(0.0),
                Reference::Of(one) => agree(one, &beside(rest, w)),
                Reference::Several => true,
            };
            if !is_same {
                reference = Reference::Several;
            }
        }
    }
    // A parameter of the inertia is no place for a force.
    if model.states.iter().zip(&coefficients).any(|(s, c)| *c != 0.0 && level as usize >= s.order) {
        return None;
    }
    // Force per unit weight: make the largest weight one, so that F is the force itself.
    let factor = weights.iter().fold(0.0f64, |m, w| m.max(w.abs()));
    let weights = weights.iter().map(|w| w / factor).collect();
    Some(Element { weights, coefficients, factor, level, reference })
}

/// Whether two expressions have the same value, at a few arbitrary points.
fn agree(a: &Expr, b: &Expr) -> bool {
    (0..4).all(|point| {
        let of = |e: &Expr| e.eval(&|name, primes| Some(arbitrary(point, name, primes)));
        of(a).zip(of(b)).is_some_and(|(a, b)| (a - b).abs() <= 1e-9 * a.abs().max(b.abs()))
    })
}

/// `g` as an affine form: constant coefficients in the states' derivatives of one common level, and what
/// stands beside them, without states.
fn affine_form(model: &Model, g: &Expr) -> Option<(u8, Vec<f64>, Expr)> {
    for level in 0..2u8 {
        let symbols: Vec<(&str, u8)> = model.states.iter().map(|s| (s.name.as_str(), level)).collect();
        if let Some((coefficients, rest)) = g.affine_in(&symbols)
            && !rest.variables().iter().any(|(n, _)| model.state(n).is_some())
        {
            let numbers: Option<Vec<f64>> = coefficients.iter().map(|c| c.simplify().constant()).collect();
            if let Some(numbers) = numbers
                && numbers.iter().any(|c| *c != 0.0)
            {
                return Some((level, numbers, rest));
            }
        }
    }
    None
}

impl Motion {
    /// The motion about a reference that stands beside its states at this level. A force may depend on what of it is known:
    /// the derivative of a reference that moves is not.
    fn about(self, model: &Model, reference: Reference, level: u8) -> Option<Motion> {
        let reference = match reference {
            Reference::None => return Some(self),
            Reference::Of(reference) => reference,
            Reference::Several => return None,
        };
        // A bare number is where the coordinate has its origin, nothing that something moves about.
        let named = |name: &str| model.parameter(name).is_some() || model.input(name).is_some();
        if !reference.variables().iter().any(|(name, _)| named(name)) {
            return None;
        }
        let beside = |d: Option<Expr>| d.map(|d| (d + reference.clone()).simplify());
        let moves =
            reference.variables().iter().any(|(name, _)| &**name == "t" || model.input(name).is_some());
        let still = |d: Option<Expr>| d.filter(|_| !moves);
        let (position, rate) = match (level, self.position) {
            (0, Some(position)) => (beside(Some(position)), still(self.rate)),
            // Relative to a speed the position is not known. (A first-order velocity, at level 0, is the rate of its motion.)
            _ => (None, beside(self.rate)),
        };
        let acceleration = still(self.acceleration);
        Some(Motion { weights: self.weights, coefficients: self.coefficients, position, rate, acceleration })
    }
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
    /// The motions of a model beside those of its own coordinates: position, rate, acceleration.
    fn elements(model: &str) -> Vec<[Option<String>; 3]> {
        let model = Model::from_toml(model, "model.toml").unwrap();
        let text = |e: &Option<Expr>| e.as_ref().map(|e| e.to_string());
        let of = |place: Place| match place {
            Place::Motion(m) => Some([text(&m.position), text(&m.rate), text(&m.acceleration)]),
            _ => None,
        };
        places(&model).into_iter().filter_map(of).skip(model.states.len()).collect()
    }

    #[test]
    fn an_element_moves_about_its_reference() {
        let known = |names: [&str; 3]| names.map(|n| (!n.is_empty()).then(|| n.to_owned()));
        // A loss to the room, whose temperature is a parameter or measured.
        let heater = |room: &str| {
            elements(&format!(
                "{room}[states]\nT = {{ unit = \"degC\" }}\n[equations]\nblock = \"C*T' + h*(T - Ta) = 0\"\n"
            ))
        };
        let parameters =
            "[parameters]\nC = { value = 80, unit = \"J/K\" }\nh = { value = 0.3, unit = \"W/K\" }\n";
        let constant = format!("{parameters}Ta = {{ value = 22, unit = \"degC\" }}\n");
        let measured = format!("[inputs]\nTa = {{ unit = \"degC\" }}\n{parameters}");
        for room in [constant, measured] {
            assert_eq!(heater(&room), [known(["T - Ta", "", ""])]);
        }
        // A tire on a road that moves: how fast, the model does not know. A hanger that stands is no such reference.
        let mass = |reference: &str| {
            elements(&format!(
                "{reference}[states]\nx = {{}}\n[parameters]\nm = {{ value = 1 }}\nk = {{ value = 100 }}\n[equations]\nbody = \"m*x'' + k*(x - r) = 0\"\n"
            ))
        };
        assert_eq!(mass("[inputs]\nr = {}\n"), [known(["x - r", "", ""])]);
        let hanger = elements(
            "[states]\nx = {}\n[parameters]\nm = { value = 1 }\nk = { value = 100 }\nx0 = { value = 0.1 }\n[equations]\nbody = \"m*x'' + 2*k*(x0 - x) = 0\"\n",
        );
        assert_eq!(hanger, [known(["x - x0", "x'", "x''"])]);
        // An origin of the coordinate is no reference.
        let origin = "[states]\nx = {}\n[parameters]\nk = { value = 100 }\n[equations]\nbody = \"x'' + k*(x - 3.14) = 0\"\n";
        assert!(elements(origin).is_empty());
        // A slider on a belt.
        let belt = elements(
            "[inputs]\nv = {}\n[states]\nx = {}\n[parameters]\nm = { value = 1 }\nb = { value = 2 }\n[equations]\nbody = \"m*x'' + b*(x' - v) = 0\"\n",
        );
        assert_eq!(belt, [known(["", "x' - v", ""])]);
        let cart = elements(
            "[inputs]\nwind = { unit = \"m/s\" }\n[states]\nv = { unit = \"m/s\" }\n[parameters]\nm = { value = 1, unit = \"kg\" }\nb = { value = 2, unit = \"N s/m\" }\n[equations]\nbody = \"m*v' + b*(v - wind) = 0\"\n",
        );
        assert_eq!(cart, [known(["", "v - wind", ""])]);
        // Between two bodies the same in both equations, or no element.
        let pair = |second: &str| {
            elements(&format!(
                "[states]\nx = {{}}\ny = {{}}\n[parameters]\nk = {{ value = 100 }}\nl = {{ value = 0.1 }}\n[equations]\none = \"x'' + k*(x - y - l) = 0\"\nother = \"y'' - k*(x - y - {second}) = 0\"\n"
            ))
        };
        assert_eq!(pair("l"), [known(["x - y - l", "x' - y'", "x'' - y''"])]);
        assert!(pair("2*l").is_empty());
    }
}
