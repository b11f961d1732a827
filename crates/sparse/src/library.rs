//! Libraries of candidate terms, nested by order.
//!
//! A library of order N + 1 holds that of order N in its first columns ("add new polynomial terms only",
//! Algorithm 1 line 5), so one evaluation and one factorisation serve all orders.

use std::collections::BTreeMap;
use std::fmt;

use crate::error::SparseError;
use crate::rows::first_not_finite;

/// A function of one variable, or an expression the caller evaluates.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Function {
    /// sin(h x).
    Sin {
        /// Index of the variable.
        variable: usize,
        /// The harmonic h ≥ 1.
        harmonic: u32,
    },
    /// cos(h x).
    Cos {
        /// Index of the variable.
        variable: usize,
        /// The harmonic h ≥ 1.
        harmonic: u32,
    },
    /// sign(x), zero at zero (Coulomb friction).
    Sign {
        /// Index of the variable.
        variable: usize,
    },
    /// |x|.
    Abs {
        /// Index of the variable.
        variable: usize,
    },
    /// A named expression whose values the caller supplies.
    Expression(String),
}

/// One candidate term: a product of powers of the variables and at most one function.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Term {
    powers: Vec<u32>,
    function: Option<Function>,
}

impl Term {
    /// The product of `variable[i]^powers[i]`; all zero is the constant 1.
    #[must_use]
    pub fn powers(powers: &[u32]) -> Self {
        Self { powers: powers.to_vec(), function: None }
    }

    /// A function alone.
    #[must_use]
    pub fn function(function: Function) -> Self {
        Self { powers: Vec::new(), function: Some(function) }
    }

    /// This term times a function (which replaces one it had).
    #[must_use]
    pub fn times(mut self, function: Function) -> Self {
        self.function = Some(function);
        self
    }

    /// The power of variable `i`.
    #[must_use]
    pub fn power(&self, i: usize) -> u32 {
        self.powers.get(i).copied().unwrap_or(0)
    }

    /// Sum of the powers.
    #[must_use]
    pub fn degree(&self) -> u32 {
        self.powers.iter().sum()
    }

    /// The function, if there is one.
    #[must_use]
    pub fn its_function(&self) -> Option<&Function> {
        self.function.as_ref()
    }

    /// Text such as `x^2*x'`, `sin(2*theta)`, `sign(theta')`, `1`; variables beyond `names` print as `?`.
    #[must_use]
    pub fn label(&self, names: &[String]) -> String {
        let name = |i: usize| names.get(i).map_or("?", String::as_str);
        let mut factors: Vec<String> = self
            .powers
            .iter()
            .enumerate()
            .filter(|&(_, &p)| p > 0)
            .map(|(i, &p)| if p == 1 { name(i).to_owned() } else { format!("{}^{p}", name(i)) })
            .collect();
        let angle = |v: usize, h: u32| if h == 1 { name(v).to_owned() } else { format!("{h}*{}", name(v)) };
        match &self.function {
            Some(Function::Sin { variable, harmonic }) => {
                factors.push(format!("sin({})", angle(*variable, *harmonic)));
            }
            Some(Function::Cos { variable, harmonic }) => {
                factors.push(format!("cos({})", angle(*variable, *harmonic)));
            }
            Some(Function::Sign { variable }) => factors.push(format!("sign({})", name(*variable))),
            Some(Function::Abs { variable }) => factors.push(format!("abs({})", name(*variable))),
            Some(Function::Expression(text)) => factors.push(text.clone()),
            None => {}
        }
        if factors.is_empty() { "1".to_owned() } else { factors.join("*") }
    }

    fn largest_variable(&self) -> Option<usize> {
        let of_powers = self.powers.iter().rposition(|&p| p > 0);
        let of_function = match self.function {
            Some(
                Function::Sin { variable, .. }
                | Function::Cos { variable, .. }
                | Function::Sign { variable }
                | Function::Abs { variable },
            ) => Some(variable),
            _ => None,
        };
        of_powers.max(of_function)
    }
}

/// Terms over named variables, nested by order: order r is the first [`Library::len_of_order`]`(r)` terms.
///
/// ```
/// use greybox_sparse::Library;
/// // Thesis Eq 2.2 with N = M = 3: fifteen terms, no constant.
/// let library = Library::tensor(&["x", "x'"], &[3, 3]);
/// assert_eq!(library.len(), 15);
/// assert_eq!(library.len_of_order(1), 3);
/// assert_eq!(library.labels()[..3], ["x", "x'", "x*x'"]);
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Library {
    variables: Vec<String>,
    terms: Vec<Term>,
    /// Number of terms in each order 1, 2, …
    lengths: Vec<usize>,
}

impl Library {
    /// All products x₁^i₁ x₂^i₂ … with i_k ≤ `highest[k]`, without the constant (thesis Eq 2.2). Order r holds
    /// those with i_k ≤ min(r, `highest[k]`). A missing entry of `highest` counts as 0.
    #[must_use]
    pub fn tensor(variables: &[&str], highest: &[u32]) -> Self {
        let bound = |r: u32| -> Vec<u32> {
            (0..variables.len()).map(|k| highest.get(k).copied().unwrap_or(0).min(r)).collect()
        };
        let orders = highest.iter().take(variables.len()).copied().max().unwrap_or(0);
        Self::from_shells(
            variables,
            (1..=orders).map(|r| {
                let mut shell = multi_indices(&bound(r));
                shell.retain(|powers| powers.iter().copied().max() == Some(r));
                shell
            }),
        )
    }

    /// All monomials of total degree ≤ `degree`; order r holds those of degree ≤ r. With `constant` the term 1
    /// stands first and is in every order.
    #[must_use]
    pub fn total_degree(variables: &[&str], degree: u32, constant: bool) -> Self {
        let library = Self::from_shells(
            variables,
            (1..=degree).map(|r| {
                let mut shell = multi_indices(&vec![r; variables.len()]);
                shell.retain(|powers| powers.iter().sum::<u32>() == r);
                shell
            }),
        );
        if constant { library.with_in_every_order(Term::powers(&[])) } else { library }
    }

    /// The separate powers x_k^i, i ≤ `order`, of every variable (thesis §2.3, the flexible link).
    #[must_use]
    pub fn separate_powers(variables: &[&str], order: u32) -> Self {
        let n = variables.len();
        Self::from_shells(
            variables,
            (1..=order)
                .map(|r| (0..n).map(|k| (0..n).map(|i| if i == k { r } else { 0 }).collect()).collect()),
        )
    }

    /// sin(h x) and cos(h x) of every variable, h ≤ `harmonics`; order r holds h ≤ r.
    #[must_use]
    pub fn trigonometric(variables: &[&str], harmonics: u32) -> Self {
        let mut library = Self::empty(variables);
        for harmonic in 1..=harmonics {
            for variable in 0..variables.len() {
                library.terms.push(Term::function(Function::Sin { variable, harmonic }));
                library.terms.push(Term::function(Function::Cos { variable, harmonic }));
            }
            library.lengths.push(library.terms.len());
        }
        library
    }

    /// The given terms, all in order 1; repeated terms are taken once.
    #[must_use]
    pub fn user(variables: &[&str], terms: &[Term]) -> Self {
        let mut library = Self::empty(variables);
        for term in terms {
            library.push_new(term.clone());
        }
        library.lengths.push(library.terms.len());
        library
    }

    /// This library with `term` put first, so that it is in every order (as sign(θ') for Coulomb friction).
    #[must_use]
    pub fn with_in_every_order(mut self, term: Term) -> Self {
        let term = self.normal(term);
        if let Some(at) = self.terms.iter().position(|t| *t == term) {
            self.terms.remove(at);
            for length in &mut self.lengths {
                if *length > at {
                    *length -= 1;
                }
            }
        }
        self.terms.insert(0, term);
        if self.lengths.is_empty() {
            self.lengths.push(0);
        }
        for length in &mut self.lengths {
            *length += 1;
        }
        self
    }

    /// Order by order the terms of both libraries (over the same variables), each once. A library with fewer
    /// orders stays at its last one.
    ///
    /// # Errors
    /// [`SparseError::Length`] if the libraries have different variables.
    pub fn union(&self, other: &Self) -> Result<Self, SparseError> {
        if self.variables != other.variables {
            return Err(SparseError::Length {
                what: "the list of variables both libraries share".into(),
                found: self.variables.iter().filter(|v| other.variables.contains(v)).count(),
                expected: self.variables.len().max(other.variables.len()),
            });
        }
        let mut out = Self { variables: self.variables.clone(), terms: Vec::new(), lengths: Vec::new() };
        for order in 1..=self.orders().max(other.orders()) {
            for library in [self, other] {
                for term in &library.terms[..library.len_of_order(order)] {
                    out.push_new(term.clone());
                }
            }
            out.lengths.push(out.terms.len());
        }
        Ok(out)
    }

    /// Number of terms of the highest order.
    #[must_use]
    pub fn len(&self) -> usize {
        self.terms.len()
    }

    /// Whether there are no terms.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.terms.is_empty()
    }

    /// Number of nested orders; they count from 1.
    #[must_use]
    pub fn orders(&self) -> usize {
        self.lengths.len()
    }

    /// Number of terms of order `order` (the highest order's beyond it, 0 for order 0).
    #[must_use]
    pub fn len_of_order(&self, order: usize) -> usize {
        match order {
            0 => 0,
            _ => self.lengths.get(order - 1).copied().unwrap_or(self.terms.len()),
        }
    }

    /// Number of terms of every order, ascending.
    #[must_use]
    pub fn lengths(&self) -> &[usize] {
        &self.lengths
    }

    /// The terms.
    #[must_use]
    pub fn terms(&self) -> &[Term] {
        &self.terms
    }

    /// The variables' names.
    #[must_use]
    pub fn variables(&self) -> &[String] {
        &self.variables
    }

    /// The terms as text.
    #[must_use]
    pub fn labels(&self) -> Vec<String> {
        self.terms.iter().map(|t| t.label(&self.variables)).collect()
    }

    /// Values of every term, one column each, from the variables' samples and those of the named expressions.
    /// A monomial costs one multiplication per sample wherever the library holds its factor of one degree less.
    ///
    /// # Errors
    /// [`SparseError::Length`] for a wrong number of variables or unequal lengths,
    /// [`SparseError::UnknownExpression`], [`SparseError::NotFinite`] for a variable that is not finite or a
    /// term that overflows.
    pub fn evaluate(
        &self,
        variables: &[&[f64]],
        expressions: &[(&str, &[f64])],
    ) -> Result<Vec<Vec<f64>>, SparseError> {
        let n = self.check_variables(variables)?;
        let mut columns: Vec<Vec<f64>> = Vec::with_capacity(self.terms.len());
        let mut known: BTreeMap<&[u32], usize> = BTreeMap::new();
        for (index, term) in self.terms.iter().enumerate() {
            let mut column = match (&term.function, lowered(&term.powers)) {
                (None, Some((parent, by))) => match known.get(parent.as_slice()) {
                    Some(&at) => product(&columns[at], variables[by]),
                    None => monomial(&term.powers, variables, n),
                },
                _ => monomial(&term.powers, variables, n),
            };
            if let Some(function) = &term.function {
                multiply_by(&mut column, function, variables, expressions)?;
            } else {
                known.insert(&term.powers, index);
            }
            if let Some(row) = first_not_finite(&column) {
                return Err(SparseError::NotFinite {
                    what: format!("term {}", term.label(&self.variables)),
                    row,
                });
            }
            columns.push(column);
        }
        Ok(columns)
    }

    fn check_variables(&self, variables: &[&[f64]]) -> Result<usize, SparseError> {
        let needed = self
            .terms
            .iter()
            .filter_map(Term::largest_variable)
            .max()
            .map_or(0, |v| v + 1)
            .max(self.variables.len());
        if variables.len() != needed {
            return Err(SparseError::Length {
                what: "the list of variables".into(),
                found: variables.len(),
                expected: needed,
            });
        }
        let n = variables.first().map_or(0, |v| v.len());
        for (i, v) in variables.iter().enumerate() {
            let what =
                || self.variables.get(i).map_or_else(|| format!("variable {i}"), |n| format!("variable {n}"));
            if v.len() != n {
                return Err(SparseError::Length { what: what(), found: v.len(), expected: n });
            }
            if let Some(row) = first_not_finite(v) {
                return Err(SparseError::NotFinite { what: what(), row });
            }
        }
        Ok(n)
    }

    fn empty(variables: &[&str]) -> Self {
        let variables = variables.iter().map(|&v| v.to_owned()).collect();
        Self { variables, terms: Vec::new(), lengths: Vec::new() }
    }

    /// Each shell sorted by degree and then first variable first.
    fn from_shells(variables: &[&str], shells: impl Iterator<Item = Vec<Vec<u32>>>) -> Self {
        let mut library = Self::empty(variables);
        for mut shell in shells {
            shell.sort_by(|a, b| a.iter().sum::<u32>().cmp(&b.iter().sum()).then(b.cmp(a)));
            library.terms.extend(shell.iter().map(|powers| Term::powers(powers)));
            library.lengths.push(library.terms.len());
        }
        library
    }

    /// The term with one power per variable, so that equal terms compare equal.
    fn normal(&self, mut term: Term) -> Term {
        while term.powers.last() == Some(&0) && term.powers.len() > self.variables.len() {
            term.powers.pop();
        }
        if term.powers.len() < self.variables.len() {
            term.powers.resize(self.variables.len(), 0);
        }
        term
    }

    fn push_new(&mut self, term: Term) {
        let term = self.normal(term);
        if !self.terms.iter().any(|t| self.normal(t.clone()) == term) {
            self.terms.push(term);
        }
    }
}

impl fmt::Display for Library {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.labels().join(", "))
    }
}

/// All multi-indices with entry k in 0..=highest[k].
fn multi_indices(highest: &[u32]) -> Vec<Vec<u32>> {
    highest.iter().fold(vec![Vec::new()], |found, &top| {
        found
            .into_iter()
            .flat_map(|head| {
                (0..=top).map(move |p| {
                    let mut powers = head.clone();
                    powers.push(p);
                    powers
                })
            })
            .collect()
    })
}

/// The powers with the last non-zero one lowered by one, and whose it was.
fn lowered(powers: &[u32]) -> Option<(Vec<u32>, usize)> {
    let by = powers.iter().rposition(|&p| p > 0)?;
    let mut parent = powers.to_vec();
    parent[by] -= 1;
    Some((parent, by))
}

fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

fn monomial(powers: &[u32], variables: &[&[f64]], n: usize) -> Vec<f64> {
    let mut column: Option<Vec<f64>> = None;
    for (&p, &v) in powers.iter().zip(variables) {
        for _ in 0..p {
            column = Some(match column {
                None => v.to_vec(),
                Some(c) => product(&c, v),
            });
        }
    }
    column.unwrap_or_else(|| vec![1.0; n])
}

fn multiply_by(
    column: &mut [f64],
    function: &Function,
    variables: &[&[f64]],
    expressions: &[(&str, &[f64])],
) -> Result<(), SparseError> {
    let rows = column.len();
    let mut apply = |values: &[f64], f: &dyn Fn(f64) -> f64| {
        for (c, &v) in column.iter_mut().zip(values) {
            *c *= f(v);
        }
    };
    match function {
        Function::Sin { variable, harmonic } => {
            let h = f64::from(*harmonic);
            apply(variables[*variable], &|v| (h * v).sin());
        }
        Function::Cos { variable, harmonic } => {
            let h = f64::from(*harmonic);
            apply(variables[*variable], &|v| (h * v).cos());
        }
        Function::Sign { variable } => {
            apply(variables[*variable], &|v| if v == 0.0 { 0.0 } else { v.signum() });
        }
        Function::Abs { variable } => apply(variables[*variable], &f64::abs),
        Function::Expression(name) => {
            let values = expressions
                .iter()
                .find(|(n, _)| n == name)
                .map(|&(_, v)| v)
                .ok_or_else(|| SparseError::UnknownExpression { name: name.clone() })?;
            if values.len() != rows {
                return Err(SparseError::Length {
                    what: format!("the expression '{name}'"),
                    found: values.len(),
                    expected: rows,
                });
            }
            apply(values, &|v| v);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tensor_counts_and_nesting() {
        let sizes: Vec<usize> = Library::tensor(&["x", "v"], &[6, 6]).lengths().to_vec();
        assert_eq!(sizes, [3, 8, 15, 24, 35, 48]);
        let three = Library::tensor(&["x", "v"], &[3, 3]);
        let four = Library::tensor(&["x", "v"], &[4, 4]);
        assert_eq!(three.terms(), &four.terms()[..15]);
        assert_eq!(Library::tensor(&["x", "v"], &[3, 1]).len(), 7);
        assert!(!three.labels().contains(&"1".to_owned()));
    }

    #[test]
    fn total_degree_and_separate_powers() {
        let library = Library::total_degree(&["x", "v"], 3, true);
        assert_eq!(library.lengths(), [3, 6, 10]);
        assert_eq!(library.labels()[..6], ["1", "x", "v", "x^2", "x*v", "v^2"]);
        let rig = Library::separate_powers(&["theta", "theta'"], 2)
            .with_in_every_order(Term::function(Function::Sign { variable: 1 }));
        assert_eq!(rig.labels(), ["sign(theta')", "theta", "theta'", "theta^2", "theta'^2"]);
        assert_eq!(rig.lengths(), [3, 5]);
    }

    #[test]
    fn values_equal_direct_powers() {
        let x = [0.5, -1.5, 2.0];
        let v = [1.0, 3.0, -0.25];
        for library in [Library::tensor(&["x", "v"], &[4, 3]), Library::total_degree(&["x", "v"], 4, true)] {
            let columns = library.evaluate(&[&x, &v], &[]).unwrap();
            for (term, column) in library.terms().iter().zip(&columns) {
                for i in 0..3 {
                    let direct = x[i].powi(term.power(0) as i32) * v[i].powi(term.power(1) as i32);
                    assert!((column[i] - direct).abs() <= 1e-12 * direct.abs().max(1.0));
                }
            }
        }
    }

    #[test]
    fn functions_expressions_and_union() {
        let t = [0.0, 1.0, -2.0];
        let e = [5.0, 6.0, 7.0];
        let extra = Library::user(
            &["q"],
            &[
                Term::powers(&[1]).times(Function::Abs { variable: 0 }),
                Term::function(Function::Expression("drive".into())),
                Term::function(Function::Sign { variable: 0 }),
                Term::powers(&[1]),
            ],
        );
        let library = Library::trigonometric(&["q"], 2).union(&extra).unwrap();
        assert_eq!(
            library.labels(),
            ["sin(q)", "cos(q)", "q*abs(q)", "drive", "sign(q)", "q", "sin(2*q)", "cos(2*q)"]
        );
        let columns = library.evaluate(&[&t], &[("drive", &e)]).unwrap();
        assert_eq!(columns[2], [0.0, 1.0, -4.0]);
        assert_eq!(columns[3], e);
        assert_eq!(columns[4], [0.0, 1.0, -1.0]);
        assert!((columns[6][1] - 2f64.sin()).abs() < 1e-15);
        assert!(matches!(library.evaluate(&[&t], &[]), Err(SparseError::UnknownExpression { .. })));
    }

    #[test]
    fn overflow_and_bad_input_are_named() {
        let library = Library::total_degree(&["x"], 2, false);
        let error = library.evaluate(&[&[1.0, 1e200]], &[]).unwrap_err();
        assert_eq!(error, SparseError::NotFinite { what: "term x^2".into(), row: 1 });
        assert!(matches!(library.evaluate(&[], &[]), Err(SparseError::Length { .. })));
        let error = library.evaluate(&[&[f64::NAN]], &[]).unwrap_err();
        assert_eq!(error, SparseError::NotFinite { what: "variable x".into(), row: 0 });
        let outside = Library::user(&["x"], &[Term::function(Function::Sign { variable: 3 })]);
        assert!(outside.evaluate(&[&[1.0]], &[]).is_err());
    }
}
