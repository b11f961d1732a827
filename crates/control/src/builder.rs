//! How a plant is made of a model.

use greybox_model::{Expr, Func, Model};
use nalgebra::{DMatrix, DVector};

use crate::compiled::Compiled;
use crate::error::{ControlError, listed};
use crate::explicit::{self, Unsolved};
use crate::plant::{Dropped, Plant, PlantOptions, with_primes};
use crate::terms::{self, Range};

fn positive(what: &str, value: f64) -> Result<(), ControlError> {
    if value > 0.0 && value.is_finite() {
        return Ok(());
    }
    Err(ControlError::Option { what: what.to_owned(), value, wanted: "a positive finite number" })
}

impl Plant {
    /// The plant of a model with one of its inputs as the command.
    ///
    /// # Errors
    /// [`ControlError`]: an unknown name, a delay, an explicit time, an equation that is not affine in the highest
    /// derivatives or in the input, a singular mass matrix, an input that moves nothing, options that make no sense.
    pub fn of(model: &Model, input: &str, options: &PlantOptions) -> Result<Plant, ControlError> {
        Builder::new(model, input, options)?.plant()
    }
}

struct Builder<'a> {
    model: &'a Model,
    input: &'a str,
    options: &'a PlantOptions,
    symbols: Vec<(String, u8)>,
    /// For each state of the plant, that of the model and its primes; the state vector of the whole model.
    all: Vec<(usize, u8)>,
    sizes: Vec<f64>,
    held: Vec<(String, f64)>,
}

impl<'a> Builder<'a> {
    fn new(model: &'a Model, input: &'a str, options: &'a PlantOptions) -> Result<Builder<'a>, ControlError> {
        let inputs = || listed(model.inputs.iter().map(|i| &i.name));
        let unknown = |name: &str| ControlError::UnknownInput { name: name.to_owned(), known: inputs() };
        model.input(input).ok_or_else(|| unknown(input))?;
        for (name, value) in &options.held {
            model.input(name).ok_or_else(|| unknown(name))?;
            if name == input {
                return Err(ControlError::TwoRoles { name: name.clone() });
            }
            if !value.is_finite() {
                let what = format!("the constant of the input `{name}`");
                return Err(ControlError::Option { what, value: *value, wanted: "a finite number" });
            }
        }
        let others = model.inputs.iter().filter(|i| i.name != input);
        let constant = |name: &str| options.held.iter().find(|(n, _)| n == name).map_or(0.0, |(_, v)| *v);
        let held = others.map(|i| (i.name.clone(), constant(&i.name))).collect();
        if model.equations.len() != model.states.len() {
            let (equations, states) = (model.equations.len(), model.states.len());
            return Err(ControlError::Count { equations, states });
        }
        let states = || listed(model.states.iter().map(|s| &s.name));
        for (name, value) in &options.frozen {
            let unknown = || ControlError::UnknownState { name: name.clone(), known: states() };
            model.state(name).ok_or_else(unknown)?;
            if !value.is_finite() {
                let what = format!("the constant of the state `{name}`");
                return Err(ControlError::Option { what, value: *value, wanted: "a finite number" });
            }
        }
        let mut all = Vec::new();
        for (j, state) in model.states.iter().enumerate() {
            if !options.frozen.iter().any(|(n, _)| *n == state.name) {
                all.extend((0..state.order).map(|p| (j, p as u8)));
            }
        }
        let symbols: Vec<(String, u8)> =
            all.iter().map(|&(j, p)| (model.states[j].name.clone(), p)).collect();
        positive("the size of the input", options.input_size)?;
        positive("the share of the velocity over which friction changes sign", options.smoothing)?;
        let names: Vec<String> = symbols.iter().map(|(n, p)| with_primes(n, *p)).collect();
        let mut sizes = vec![1.0; names.len()];
        for (name, size) in &options.sizes {
            let at = names
                .iter()
                .position(|n| n == name)
                .ok_or_else(|| ControlError::UnknownState { name: name.clone(), known: listed(&names) })?;
            positive(&format!("the size of `{name}`"), *size)?;
            sizes[at] = *size;
        }
        Ok(Builder { model, input, options, symbols, all, sizes, held })
    }

    fn plant(&self) -> Result<Plant, ControlError> {
        let mut range = Range::default();
        let mut dropped = Vec::new();
        let mut closed_gaps = Vec::new();
        let mut late = Vec::new();
        let mut mentions = 0;
        let residuals: Vec<Expr> = self
            .model
            .equations
            .iter()
            .map(|equation| {
                let residual = self.constant(&equation.residual());
                let residual = if self.options.predict_input_delay {
                    let value = |e: &Expr| self.value(e, &[]);
                    let prompt = terms::without_input_delay(&residual, self.input, &value, &mut late);
                    prompt.walk(&mut |e| {
                        mentions += usize::from(matches!(e, Expr::Var { name, .. } if **name == *self.input));
                    });
                    prompt
                } else {
                    residual
                };
                self.check(&equation.name, &residual)?;
                let residual = self.timeless(&equation.name, &residual, &mut dropped)?;
                let value = |e: &Expr| self.value(e, &[]);
                let free = terms::without_limits(&residual, self.input, &value, &mut range);
                let mut gaps = Vec::new();
                let bridged = terms::without_gaps(&free, &|e| self.moves(e), &mut gaps);
                let reported = |term| Dropped { equation: equation.name.clone(), term };
                closed_gaps.extend(gaps.into_iter().map(reported));
                Ok(if self.options.close_gaps { bridged } else { free }.simplify())
            })
            .collect::<Result<_, ControlError>>()?;
        // A command that acts at two times cannot be predicted over one.
        let (late_by, input_delay) = late.first().cloned().unwrap_or((Expr::Num(0.0), 0.0));
        if !late.is_empty() && (late.len() < mentions || late.iter().any(|(_, tau)| *tau != input_delay)) {
            return Err(ControlError::SeveralDelays { input: self.input.to_owned() });
        }
        let limits = range.limits;
        if !(limits.0 < limits.1 && limits.0 <= 0.0 && limits.1 >= 0.0) {
            return Err(ControlError::Limits { low: limits.0, high: limits.1 });
        }
        let smoothed: Vec<Expr> = residuals
            .iter()
            .map(|e| {
                terms::without_signs(e, &|e| self.moves(e), &|v| {
                    let width = self.options.smoothing * self.size(v);
                    Expr::call(Func::Tanh, vec![v.clone() / Expr::Num(width)])
                })
            })
            .collect();
        let still: Vec<Expr> = residuals
            .iter()
            .map(|e| terms::without_signs(e, &|e| self.moves(e), &|_| Expr::Num(0.0)).simplify())
            .collect();
        let (f, g) = self.explicit(&smoothed)?;
        let still = self.explicit(&still)?;
        if g.iter().all(|g| *g == Expr::Num(0.0)) {
            return Err(ControlError::NoAuthority { name: self.input.to_owned() });
        }
        let parameters: Vec<(String, f64)> =
            self.model.parameters.iter().map(|p| (p.name.clone(), p.value)).collect();
        let compile = |f: &[Expr], g: &[Expr]| Compiled::new(&[f, g].concat(), &self.symbols, &parameters);
        let measured = self
            .symbols
            .iter()
            .map(|(name, primes)| self.model.measurement_of(name, *primes).is_some())
            .collect();
        Ok(Plant {
            smooth: compile(&f, &g)?,
            frictionless: compile(&still.0, &still.1)?,
            symbols: self.symbols.clone(),
            input: self.input.to_owned(),
            f,
            g,
            still,
            held: self.held.clone(),
            limits,
            dead_zone: range.dead_zone.unwrap_or(0.0),
            dropped,
            input_delay,
            late_by,
            open_gaps: !self.options.close_gaps && !closed_gaps.is_empty(),
            closed_gaps: if self.options.close_gaps { closed_gaps } else { Vec::new() },
            sizes: self.sizes.clone(),
            input_size: self.options.input_size,
            measured,
            parameters,
        })
    }

    /// Whether a state or the input occurs.
    fn moves(&self, e: &Expr) -> bool {
        e.mentions(self.input) || self.model.states.iter().any(|s| e.mentions(&s.name))
    }

    /// Held inputs and frozen states as their constants.
    fn constant(&self, e: &Expr) -> Expr {
        e.substitute(&|name, primes| {
            if let Some((_, value)) = self.options.frozen.iter().find(|(n, _)| n == name) {
                // The highest derivative stays: it is the unknown of the state's own equation.
                let order = self.model.state(name).map_or(0, |j| self.model.states[j].order);
                return match primes {
                    0 => Some(Expr::Num(*value)),
                    p if usize::from(p) < order => Some(Expr::Num(0.0)),
                    _ => None,
                };
            }
            let held = self.held.iter().find(|(n, _)| n == name && primes == 0);
            held.map(|(_, value)| Expr::Num(*value))
        })
    }

    /// That every name is known, every call complete, and nothing delayed.
    fn check(&self, equation: &str, e: &Expr) -> Result<(), ControlError> {
        let mut wrong = None;
        e.walk(&mut |e| {
            let fault = match e {
                Expr::Var { name, primes } => match self.model.state(name) {
                    Some(j) => usize::from(*primes) > self.model.states[j].order,
                    None => {
                        let known = **name == *self.input
                            || self.model.parameter(name).is_some()
                            || matches!(&**name, "t" | "pi");
                        !known || *primes > 0
                    }
                },
                Expr::Call(f, args) => !f.takes(args),
                _ => false,
            };
            if fault && wrong.is_none() {
                let expression = if let Expr::Call(f, _) = e { f.name().to_owned() } else { e.to_string() };
                wrong = Some(ControlError::Meaningless { equation: equation.to_owned(), expression });
            }
        });
        e.walk(&mut |e| {
            if let Expr::Call(Func::Delay, _) = e
                && wrong.is_none()
            {
                wrong =
                    Some(ControlError::Delay { equation: equation.to_owned(), expression: e.to_string() });
            }
        });
        wrong.map_or(Ok(()), Err)
    }

    /// Without the terms that depend on the time.
    fn timeless(&self, equation: &str, e: &Expr, dropped: &mut Vec<Dropped>) -> Result<Expr, ControlError> {
        if !terms::timed(e) {
            return Ok(e.clone());
        }
        let mut kept = Expr::Num(0.0);
        for term in terms::terms(e) {
            if !terms::timed(&term) {
                kept = kept + term;
                continue;
            }
            let moving = self.moves(&term);
            let (equation, text) = (equation.to_owned(), term.to_string());
            match (self.options.ignore_time_terms, moving) {
                (false, false) => return Err(ControlError::Time { equation, term: text }),
                (_, true) => return Err(ControlError::Drift { equation, term: text }),
                (true, false) => dropped.push(Dropped { equation, term }),
            }
        }
        Ok(kept.simplify())
    }

    /// The value of an expression at a state (the origin where there is none).
    fn value(&self, e: &Expr, x: &[f64]) -> Option<f64> {
        e.eval(&|name, primes| {
            if let Some(i) = self.model.parameter(name) {
                return (primes == 0).then(|| self.model.parameters[i].value);
            }
            let at = self.symbols.iter().position(|(n, p)| n == name && *p == primes)?;
            x.get(at).copied()
        })
    }

    /// The size of a velocity: Σ |∂v/∂xᵢ| sizeᵢ.
    fn size(&self, v: &Expr) -> f64 {
        let origin = vec![0.0; self.symbols.len()];
        let slope = |(name, primes): &(String, u8)| self.value(&v.derivative(name, *primes), &origin);
        let parts =
            self.symbols.iter().zip(&self.sizes).map(|(s, size)| slope(s).map_or(0.0, |d| d.abs() * size));
        let sum: f64 = parts.sum();
        if sum > 0.0 && sum.is_finite() { sum } else { 1.0 }
    }

    /// f and g of ẋ = f + g u.
    fn explicit(&self, residuals: &[Expr]) -> Result<(Vec<Expr>, Vec<Expr>), ControlError> {
        let states = &self.model.states;
        let highest: Vec<(&str, u8)> = states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
        let unknowns =
            |which: &[usize]| listed(which.iter().map(|&j| with_primes(highest[j].0, highest[j].1)));
        let (mut mass, mut rest) = (Vec::new(), Vec::new());
        for (equation, residual) in self.model.equations.iter().zip(residuals) {
            let not_affine =
                |of, symbol: String| ControlError::NotAffine { equation: equation.name.clone(), of, symbol };
            let every =
                || not_affine("the highest derivatives", unknowns(&(0..states.len()).collect::<Vec<_>>()));
            let (row, other) = residual.affine_in(&highest).ok_or_else(every)?;
            let of_input = || not_affine("the input", format!("`{}`", self.input));
            if row.iter().any(|m| m.mentions(self.input)) {
                return Err(of_input());
            }
            let (slope, drift) = other.affine_in(&[(self.input, 0)]).ok_or_else(of_input)?;
            mass.push(row);
            rest.push(vec![drift, slope[0].clone()]);
        }
        let (z, divisors) = explicit::solve(mass, rest).map_err(|unsolved| match unsolved {
            Unsolved::Singular(which) => ControlError::Singular { unknowns: unknowns(&which), place: "" },
            Unsolved::Coupled(which) => ControlError::TooManyCoupled {
                count: which.len(),
                unknowns: unknowns(&which),
                most: explicit::MOST_COUPLED,
            },
        })?;
        for divisor in &divisors {
            if let Some(place) = self.singular(&divisor.matrix) {
                return Err(ControlError::Singular { unknowns: unknowns(&divisor.unknowns), place });
            }
        }
        let mut f = Vec::with_capacity(self.all.len());
        let mut g = Vec::with_capacity(self.all.len());
        for &(j, primes) in &self.all {
            if usize::from(primes) + 1 < states[j].order {
                f.push(Expr::prime(&states[j].name, primes + 1));
                g.push(Expr::Num(0.0));
            } else {
                // What is left of the highest derivatives of frozen states is zero: they are held.
                f.push(z[j][0].clone());
                g.push(z[j][1].clone());
            }
        }
        Ok((f, g))
    }

    /// Where a block of the mass matrix is singular: at the origin, or in the corners of the stated sizes.
    fn singular(&self, block: &[Vec<Expr>]) -> Option<&'static str> {
        let n = block.len();
        let at = |x: &[f64]| -> bool {
            let entry = |i: usize, j: usize| self.value(&block[i][j], x).unwrap_or(f64::NAN);
            let mut m = DMatrix::from_fn(n, n, entry);
            if m.iter().any(|m| !m.is_finite()) {
                return true;
            }
            // Units of rows and columns play no part.
            for _ in 0..3 {
                for i in 0..n {
                    let size = m.row(i).amax();
                    m.row_mut(i).scale_mut(if size > 0.0 { 1.0 / size } else { 1.0 });
                    let size = m.column(i).amax();
                    m.column_mut(i).scale_mut(if size > 0.0 { 1.0 / size } else { 1.0 });
                }
            }
            let singular = DVector::from(m.singular_values());
            singular.min().is_nan() || singular.min() <= 1e-12 * singular.max()
        };
        if at(&vec![0.0; self.sizes.len()]) {
            return Some(" with all states zero");
        }
        let corner = |k: usize| -> Vec<f64> {
            self.sizes
                .iter()
                .enumerate()
                .map(|(i, s)| if (k >> (i % 3)) & 1 == 1 { *s } else { -s })
                .collect()
        };
        (0..8).any(|k| at(&corner(k))).then_some(" at states of the stated sizes")
    }
}
