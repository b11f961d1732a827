//! Dimensional analysis: every equation and measurement is checked, and units that were not stated
//! are inferred.
//!
//! The dimension of a product is linear in the (seven) exponents of its factors, so "all terms of a
//! sum share a dimension" is a linear system over the unknown exponents. It is eliminated row by row
//! as the expressions are walked; a row without unknowns left is a check.

use crate::error::{ModelError, Place, Problem};
use crate::expr::{BinOp, Expr, Func};
use crate::model::Model;
use crate::units::{Dimension, Unit};

/// Something whose unit is not stated: index into the parameters, states or inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Unstated {
    Parameter(usize),
    State(usize),
    Input(usize),
}

/// A fault and the expression to point at.
pub(crate) type Fault = (ModelError, Expr);

impl Model {
    /// Checks that every sum in the equations and measurements adds terms of one dimension, and
    /// gives each parameter without a stated unit the SI unit that the equations imply (`1` where
    /// they leave it open). Afterwards every [`Parameter::unit`](crate::Parameter::unit) is `Some`.
    ///
    /// A literal 0 fits any dimension; every other bare number is dimensionless.
    ///
    /// # Errors
    /// [`Problem::Dimension`] and its relatives name the equation and the term in the minority. The
    /// model is unchanged then.
    pub fn resolve_units(&mut self) -> Result<(), ModelError> {
        self.resolve_units_of(&[]).map_err(|(_, (error, _))| error)
    }

    /// As [`Model::resolve_units`], where the units of the states and inputs in `unstated` are
    /// inferred as well. The error comes with its place and the expression to point at.
    pub(crate) fn resolve_units_of(&mut self, unstated: &[Unstated]) -> Result<(), (Place, Fault)> {
        let mut checker = Checker::new(self, unstated);
        checker.whole_model()?;
        let found: Vec<(Unstated, Dimension)> = checker
            .unstated
            .iter()
            .enumerate()
            .map(|(i, which)| (*which, checker.reduce(&checker.unknown(i)).known))
            .collect();
        for (which, dimension) in found {
            match which {
                Unstated::Parameter(i) => self.parameters[i].unit = Some(Unit::si(dimension)),
                Unstated::State(i) => self.states[i].unit = Unit::si(dimension),
                Unstated::Input(i) => self.inputs[i].unit = Unit::si(dimension),
            }
        }
        Ok(())
    }

    /// The dimension of an expression over this model's names. Parameters without a unit count as
    /// [`Model::resolve_units`] would resolve them; a literal 0 alone counts as dimensionless.
    ///
    /// # Errors
    /// As [`Model::resolve_units`], for the expression (and for the equations where units have to be
    /// inferred); [`Problem::Undefined`] for a name that the model lacks.
    pub fn dimension_of(&self, expr: &Expr) -> Result<Dimension, ModelError> {
        let mut checker = Checker::new(self, &[]);
        if !checker.unstated.is_empty() {
            checker.whole_model().map_err(|(_, (error, _))| error)?;
        }
        match checker.dimension(expr, &Place::Expression).map_err(|(error, _)| error)? {
            Dim::Any => Ok(Dimension::NONE),
            Dim::Is(quantity) => Ok(checker.reduce(&quantity).known),
        }
    }
}

/// Exponents: a known part and multiples of the unknown dimensions.
#[derive(Debug, Clone)]
struct Quantity {
    known: Dimension,
    unknown: Vec<f64>,
}

impl Quantity {
    fn combine(&self, other: &Quantity, scale: f64) -> Quantity {
        Quantity {
            known: self.known * other.known.pow(scale),
            unknown: self.unknown.iter().zip(&other.unknown).map(|(a, b)| a + scale * b).collect(),
        }
    }

    fn pow(&self, exponent: f64) -> Quantity {
        Quantity {
            known: self.known.pow(exponent),
            unknown: self.unknown.iter().map(|a| a * exponent).collect(),
        }
    }

    fn pivot(&self) -> Option<usize> {
        self.unknown.iter().position(|c| c.abs() > 1e-9)
    }
}

/// The dimension of an expression; a literal zero has any.
#[derive(Debug, Clone)]
enum Dim {
    Any,
    Is(Quantity),
}

struct Checker<'a> {
    model: &'a Model,
    /// Parameters first: they are solved for, and what stays free (dimensionless) is a state.
    unstated: Vec<Unstated>,
    /// Reduced rows: `quantity` has no dimension, and its pivot occurs in no other row with factor 1.
    rows: Vec<(usize, Quantity)>,
}

impl<'a> Checker<'a> {
    fn new(model: &'a Model, unstated: &[Unstated]) -> Self {
        let parameters = model.parameters.iter().enumerate().filter(|(_, p)| p.unit.is_none());
        let mut all: Vec<Unstated> = parameters.map(|(i, _)| Unstated::Parameter(i)).collect();
        all.extend(unstated);
        Checker { model, unstated: all, rows: Vec::new() }
    }

    fn whole_model(&mut self) -> Result<(), (Place, Fault)> {
        for equation in &self.model.equations {
            let place = Place::Equation(equation.name.clone());
            let terms = [&equation.lhs, &equation.rhs].into_iter().flat_map(Expr::terms);
            let terms: Vec<&Expr> = terms.map(|(_, term)| term).collect();
            self.shared(&terms, &place).map_err(|fault| (place, fault))?;
        }
        for measurement in &self.model.measurements {
            let place = Place::Measurement(measurement.channel.clone());
            self.dimension(&measurement.expr, &place).map_err(|fault| (place, fault))?;
        }
        Ok(())
    }

    fn known(&self, known: Dimension) -> Quantity {
        Quantity { known, unknown: vec![0.0; self.unstated.len()] }
    }

    fn unknown(&self, index: usize) -> Quantity {
        let mut q = self.known(Dimension::NONE);
        q.unknown[index] = 1.0;
        q
    }

    /// The quantity with the solved unknowns replaced; the free ones keep their multiples.
    fn reduce(&self, q: &Quantity) -> Quantity {
        self.rows.iter().fold(q.clone(), |q, (pivot, row)| q.combine(row, -q.unknown[*pivot]))
    }

    /// Demands that `q` has no dimension; the leftover dimension where that cannot be.
    fn demand_none(&mut self, q: &Quantity) -> Result<(), Dimension> {
        let q = self.reduce(q);
        let Some(pivot) = q.pivot() else {
            return if q.known.is_none() { Ok(()) } else { Err(q.known) };
        };
        let row = q.pow(1.0 / q.unknown[pivot]);
        for (_, old) in &mut self.rows {
            *old = old.combine(&row, -old.unknown[pivot]);
        }
        self.rows.push((pivot, row));
        Ok(())
    }

    /// The dimension of a name, without primes.
    fn symbol(&self, name: &str) -> Option<Quantity> {
        let of = |which: Unstated, unit: Option<&Unit>| match self.unstated.iter().position(|u| *u == which) {
            Some(i) => self.unknown(i),
            None => self.known(unit.map_or(Dimension::NONE, |u| u.dimension)),
        };
        if let Some(i) = self.model.parameter(name) {
            return Some(of(Unstated::Parameter(i), self.model.parameters[i].unit.as_ref()));
        }
        if let Some(i) = self.model.state(name) {
            return Some(of(Unstated::State(i), Some(&self.model.states[i].unit)));
        }
        if let Some(i) = self.model.input(name) {
            return Some(of(Unstated::Input(i), Some(&self.model.inputs[i].unit)));
        }
        match name {
            "t" => Some(self.known(Dimension::TIME)),
            "pi" => Some(self.known(Dimension::NONE)),
            _ => None,
        }
    }

    fn dimension(&mut self, e: &Expr, place: &Place) -> Result<Dim, Fault> {
        match e {
            Expr::Num(v) if *v == 0.0 => Ok(Dim::Any),
            Expr::Num(_) => Ok(Dim::Is(self.known(Dimension::NONE))),
            Expr::Var { name, primes } => match self.symbol(name) {
                Some(q) => {
                    let time = self.known(Dimension::TIME);
                    Ok(Dim::Is(q.combine(&time, -f64::from(*primes))))
                }
                None => {
                    let problem = Problem::Undefined { place: place.clone(), name: name.to_string() };
                    Err((ModelError::new(problem), e.clone()))
                }
            },
            Expr::Neg(a) => self.dimension(a, place),
            Expr::Bin(BinOp::Add | BinOp::Sub, ..) => {
                let terms: Vec<&Expr> = e.terms().into_iter().map(|(_, term)| term).collect();
                self.shared(&terms, place)
            }
            Expr::Bin(op @ (BinOp::Mul | BinOp::Div), a, b) => {
                let scale = if *op == BinOp::Mul { 1.0 } else { -1.0 };
                match (self.dimension(a, place)?, self.dimension(b, place)?) {
                    (Dim::Is(a), Dim::Is(b)) => Ok(Dim::Is(a.combine(&b, scale))),
                    _ => Ok(Dim::Any),
                }
            }
            Expr::Bin(BinOp::Pow, a, b) => self.power(e, a, b, place),
            Expr::Call(f, args) => self.call(e, *f, args, place),
        }
    }

    fn power(&mut self, e: &Expr, a: &Expr, b: &Expr, place: &Place) -> Result<Dim, Fault> {
        let Dim::Is(base) = self.dimension(a, place)? else { return Ok(Dim::Any) };
        if let Some(exponent) = b.constant() {
            return Ok(Dim::Is(base.pow(exponent)));
        }
        self.need(e, b, Dimension::NONE, &format!("the exponent of `{e}`"), place)?;
        self.demand_none(&base).map_err(|dimension| {
            let problem = Problem::Exponent { place: place.clone(), term: e.to_string(), dimension };
            let help = format!("divide `{a}` by a reference value of the same unit, or write a number");
            (ModelError::new(problem).with_help(help), e.clone())
        })?;
        Ok(Dim::Is(self.known(Dimension::NONE)))
    }

    fn call(&mut self, e: &Expr, f: Func, args: &[Expr], place: &Place) -> Result<Dim, Fault> {
        let none = Dim::Is(self.known(Dimension::NONE));
        match (f, args) {
            (Func::Sin | Func::Cos | Func::Tan | Func::Exp | Func::Ln | Func::Tanh | Func::Atan, [a]) => {
                self.need(e, a, Dimension::NONE, &format!("the argument of `{}`", f.name()), place)?;
                Ok(none)
            }
            (Func::Sign, [a]) => {
                self.dimension(a, place)?;
                Ok(none)
            }
            (Func::Abs, [a]) => self.dimension(a, place),
            (Func::Sqrt, [a]) => Ok(match self.dimension(a, place)? {
                Dim::Any => Dim::Any,
                Dim::Is(q) => Dim::Is(q.pow(0.5)),
            }),
            (Func::Min | Func::Max | Func::Deadzone | Func::Saturate, [a, b]) => self.shared(&[a, b], place),
            (Func::Delay, [a, tau]) => {
                self.need(e, tau, Dimension::TIME, "the delay of `delay`", place)?;
                self.dimension(a, place)
            }
            (Func::Step, [t, t0]) => {
                self.need(e, t, Dimension::TIME, "the first argument of `step`", place)?;
                self.need(e, t0, Dimension::TIME, "the second argument of `step`", place)?;
                Ok(none)
            }
            (Func::Table, [x, rest @ ..]) => {
                self.need(e, x, Dimension::NONE, "the first argument of `table`", place)?;
                let values: Vec<&Expr> = rest[rest.len() / 2..].iter().collect();
                self.shared(&values, place)
            }
            // The parser lets no other number of arguments through.
            _ => Ok(none),
        }
    }

    /// Demands that `e`, a part of `whole`, is in `expected`.
    fn need(
        &mut self,
        whole: &Expr,
        e: &Expr,
        expected: Dimension,
        role: &str,
        place: &Place,
    ) -> Result<(), Fault> {
        let Dim::Is(q) = self.dimension(e, place)? else { return Ok(()) };
        let ratio = q.combine(&self.known(expected), -1.0);
        self.demand_none(&ratio).map_err(|leftover| {
            let dimension = expected * leftover;
            let problem = Problem::Needs {
                place: place.clone(),
                role: role.to_owned(),
                term: e.to_string(),
                dimension,
                expected,
            };
            (ModelError::new(problem).with_help(self.help(e, dimension, expected)), whole.clone())
        })
    }

    /// Demands that all terms share a dimension, and gives it.
    fn shared(&mut self, terms: &[&Expr], place: &Place) -> Result<Dim, Fault> {
        let mut group: Vec<(&Expr, Quantity)> = Vec::new();
        for &term in terms {
            if let Dim::Is(q) = self.dimension(term, place)? {
                group.push((term, q));
            }
        }
        let Some(first) = group.first() else { return Ok(Dim::Any) };

        // Those that are known already: the largest set of equals is taken to be right.
        let known: Vec<(&Expr, Dimension)> = group
            .iter()
            .map(|(term, q)| (*term, self.reduce(q)))
            .filter(|(_, q)| q.pivot().is_none())
            .map(|(term, q)| (term, q.known))
            .collect();
        let votes = |d: &Dimension| known.iter().filter(|(_, other)| other.same(d)).count();
        let mut majority: Option<(bool, usize, Dimension)> = None;
        for (term, d) in &known {
            // Of two sets of one size, bare numbers are the suspects.
            let rank = (votes(d), term.constant().is_none());
            if majority.is_none_or(|(named, count, _)| rank > (count, named)) {
                majority = Some((rank.1, rank.0, *d));
            }
        }
        if let Some((_, _, expected)) = majority
            && let Some((term, dimension)) = known.iter().find(|(_, d)| !d.same(&expected))
        {
            let others: Vec<String> =
                known.iter().filter(|(_, d)| d.same(&expected)).map(|(e, _)| format!("`{e}`")).collect();
            let problem = Problem::Dimension {
                place: place.clone(),
                term: term.to_string(),
                dimension: *dimension,
                several: others.len() > 1,
                others: others.join(", "),
                expected,
            };
            let error = ModelError::new(problem).with_help(self.help(term, *dimension, expected));
            return Err((error, (*term).clone()));
        }

        let (other, reference) = match majority {
            Some((_, _, d)) => (known.iter().find(|k| k.1.same(&d)).map_or(first.0, |k| k.0), self.known(d)),
            None => (first.0, first.1.clone()),
        };
        for (term, q) in &group {
            let ratio = q.combine(&reference, -1.0);
            self.demand_none(&ratio).map_err(|left| {
                let names: Vec<String> = term
                    .variables()
                    .iter()
                    .chain(&other.variables())
                    .filter(|(name, _)| self.symbol(name).is_some_and(|q| q.pivot().is_some()))
                    .map(|(name, _)| format!("`{name}`"))
                    .collect();
                let mut parameters = names.clone();
                parameters.dedup();
                let problem = Problem::Contradiction {
                    place: place.clone(),
                    term: term.to_string(),
                    other: other.to_string(),
                    parameters: parameters.join(", "),
                    ratio: left,
                };
                let help = "state the units of these parameters, and check the units of the other names";
                (ModelError::new(problem).with_help(help), (*term).clone())
            })?;
        }
        Ok(Dim::Is(self.reduce(&reference)))
    }

    /// What to change so that `term`, in `dimension`, comes out in `expected`.
    fn help(&self, term: &Expr, dimension: Dimension, expected: Dimension) -> String {
        if term.constant().is_some() {
            return format!("a bare number is dimensionless: make it a parameter with the unit {expected}");
        }
        let ratio = expected / dimension;
        for (name, exponent) in factors(term) {
            if let Some(i) = self.model.parameter(&name)
                && let Some(unit) = &self.model.parameters[i].unit
            {
                let needed = unit.dimension * ratio.pow(1.0 / exponent);
                return format!(
                    "check the unit of `{name}`, stated as {}: with {needed} the term would fit",
                    unit.text
                );
            }
        }
        let named: Vec<String> = term
            .variables()
            .iter()
            .filter_map(|(name, _)| Some((name, self.reduce(&self.symbol(name)?).known)))
            .map(|(name, d)| format!("`{name}` is in {d}"))
            .collect();
        if named.is_empty() {
            "check the units".into()
        } else {
            format!("check the units: {}", named.join(", "))
        }
    }
}

/// The names that multiply or divide the whole term, with their exponents.
fn factors(term: &Expr) -> Vec<(String, f64)> {
    fn collect(e: &Expr, exponent: f64, into: &mut Vec<(String, f64)>) {
        match e {
            Expr::Var { name, primes: 0 } => into.push((name.to_string(), exponent)),
            Expr::Neg(a) => collect(a, exponent, into),
            Expr::Bin(BinOp::Mul, a, b) => {
                collect(a, exponent, into);
                collect(b, exponent, into);
            }
            Expr::Bin(BinOp::Div, a, b) => {
                collect(a, exponent, into);
                collect(b, -exponent, into);
            }
            _ => {}
        }
    }
    let mut into = Vec::new();
    collect(term, 1.0, &mut into);
    into
}
