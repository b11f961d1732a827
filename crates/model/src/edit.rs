//! Changing a model: adding terms, replacing symbols, fresh names.

use crate::expr::{BinOp, Expr, Func};
use crate::model::Model;

impl Model {
    /// Adds `term` to the left side of the equation with index `equation`, `- x` for a negative one:
    /// as a force that the nominal model leaves out. Nothing happens for a term that simplifies to
    /// zero, or for an index out of range; the rest of the equation stays as it is written.
    ///
    /// ```
    /// # use greybox_model::{Model, parse};
    /// # let mut model = Model::from_toml(r#"
    /// #     [states]
    /// #     z = { unit = "m" }
    /// #     [parameters]
    /// #     g = { value = 9.81, unit = "m/s^2" }
    /// #     c = { value = 1, unit = "1/m" }
    /// #     [equations]
    /// #     fall = "z'' = -g"
    /// # "#, "fall.toml")?;
    /// model.add_term(0, parse("c*z'*abs(z')")?.expr);
    /// assert_eq!(model.equations[0].to_string(), "z'' + c*z'*abs(z') = -g");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn add_term(&mut self, equation: usize, term: Expr) {
        let Some(equation) = self.equations.get_mut(equation) else { return };
        let old = std::mem::replace(&mut equation.lhs, Expr::Num(0.0));
        equation.lhs = match term.simplify() {
            Expr::Num(0.0) => old,
            term if old == Expr::Num(0.0) => term,
            Expr::Neg(term) => old - *term,
            Expr::Num(v) if v < 0.0 => old - Expr::Num(-v),
            // A sum is added term by term, so that no parentheses appear.
            term @ Expr::Bin(BinOp::Add | BinOp::Sub, ..) => {
                term.terms().into_iter().fold(old, |sum, (negative, term)| match (negative, term) {
                    (false, term) => sum + term.clone(),
                    (true, term) => sum - term.clone(),
                })
            }
            term => old + term,
        };
        self.recompute_orders();
    }

    /// Puts `by` for the symbol `name` with exactly `primes` primes in all equations and
    /// measurements. Expressions without the symbol stay as they are.
    pub fn replace(&mut self, name: &str, primes: u8, by: &Expr) {
        let put = |e: &mut Expr| {
            if e.contains(name, primes) {
                *e = e.substitute(&|n, p| (n == name && p == primes).then(|| by.clone()));
            }
        };
        for equation in &mut self.equations {
            put(&mut equation.lhs);
            put(&mut equation.rhs);
        }
        for measurement in &mut self.measurements {
            put(&mut measurement.expr);
        }
        self.recompute_orders();
    }

    /// `wanted`, or `wanted_2`, `wanted_3`, … : the first that is neither a name of the model nor one
    /// of the language.
    pub fn fresh_name(&self, wanted: &str) -> String {
        let taken = |name: &str| {
            self.parameter(name).is_some()
                || self.state(name).is_some()
                || self.input(name).is_some()
                || name == "t"
                || name == "pi"
                || Func::from_name(name).is_some()
        };
        if !taken(wanted) {
            return wanted.to_owned();
        }
        (2usize..).map(|i| format!("{wanted}_{i}")).find(|name| !taken(name)).unwrap_or_default()
    }

    /// Sets the order of each state to the highest number of primes it has in the equations, at
    /// least 1; start values beyond the order are dropped only if the order fell.
    pub fn recompute_orders(&mut self) {
        for state in &mut self.states {
            let mut highest = 1;
            let mut look = |e: &Expr| {
                if let Expr::Var { name, primes } = e
                    && **name == *state.name
                {
                    highest = highest.max(usize::from(*primes));
                }
            };
            for equation in &self.equations {
                equation.lhs.walk(&mut look);
                equation.rhs.walk(&mut look);
            }
            if highest < state.order {
                state.initial.truncate(highest);
            }
            state.order = highest;
        }
    }
}
