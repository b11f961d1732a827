//! Libraries of candidate terms, nested by order.
//!
//! A library of order N + 1 holds that of order N in its first columns ("add new polynomial terms only",
//! Algorithm 1 line 5), so one evaluation and one factorisation serve all orders.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;

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

    /// The terms whose coefficient is not zero, as text, each with it: a found model to be read. `coefficients` are those
    /// of the library's terms in their order; what lies beyond them is left out.
    ///
    /// ```
    /// use greybox_sparse::Library;
    /// let library = Library::total_degree(&["x", "v"], 2, false);
    /// assert_eq!(library.labels(), ["x", "v", "x^2", "x*v", "v^2"]);
    /// let model = library.named(&[-75.0, 0.0, 0.0, 0.5, 0.0]);
    /// assert_eq!(model, [("x".to_string(), -75.0), ("x*v".to_string(), 0.5)]);
    /// ```
    #[must_use]
    pub fn named(&self, coefficients: &[f64]) -> Vec<(String, f64)> {
        let present = self.terms.iter().zip(coefficients).filter(|(_, c)| **c != 0.0);
        present.map(|(term, &c)| (term.label(&self.variables), c)).collect()
    }

    /// Values of every term, one column each, from the variables' samples and those of the named expressions (an empty
    /// slice where the library has no [`Function::Expression`]).
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
        let plan = self.plan(variables, expressions)?;
        let n = plan.rows();
        let mut columns: Vec<Vec<f64>> = Vec::with_capacity(self.terms.len());
        for index in 0..self.terms.len() {
            let mut column = vec![0.0; n];
            plan.monomial(index, 0..n, |at| &columns[at], &mut column);
            plan.finish(index, 0..n, &mut column)?;
            columns.push(column);
        }
        Ok(columns)
    }

    /// How every term follows from those before it; checks the variables and the expressions.
    pub(crate) fn plan<'a>(
        &'a self,
        variables: &'a [&'a [f64]],
        expressions: &'a [(&'a str, &'a [f64])],
    ) -> Result<Plan<'a>, SparseError> {
        let rows = self.check_variables(variables)?;
        let mut known: BTreeMap<&[u32], usize> = BTreeMap::new();
        let mut steps = Vec::with_capacity(self.terms.len());
        for (index, term) in self.terms.iter().enumerate() {
            let parent = lowered(&term.powers).filter(|_| term.function.is_none());
            let parent = parent.and_then(|(parent, by)| Some((*known.get(parent.as_slice())?, by)));
            let values = match &term.function {
                Some(Function::Expression(name)) => Some(named(name, expressions, rows)?),
                Some(_) => None,
                None => {
                    known.insert(&term.powers, index);
                    None
                }
            };
            steps.push(Step { parent, values });
        }
        Ok(Plan { library: self, variables, steps, rows })
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

/// The samples of a named expression.
fn named<'a>(
    name: &str,
    expressions: &'a [(&'a str, &'a [f64])],
    rows: usize,
) -> Result<&'a [f64], SparseError> {
    let found = expressions.iter().find(|(n, _)| *n == name).map(|&(_, v)| v);
    let values = found.ok_or_else(|| SparseError::UnknownExpression { name: name.to_owned() })?;
    if values.len() == rows {
        Ok(values)
    } else {
        let what = format!("the expression '{name}'");
        Err(SparseError::Length { what, found: values.len(), expected: rows })
    }
}

/// How one term is computed.
struct Step<'a> {
    /// A term before it, and the variable that it is to be multiplied by.
    parent: Option<(usize, usize)>,
    /// The samples of its named expression.
    values: Option<&'a [f64]>,
}

/// A library with the samples of its variables, ready to be evaluated on any rows.
pub(crate) struct Plan<'a> {
    library: &'a Library,
    variables: &'a [&'a [f64]],
    steps: Vec<Step<'a>>,
    rows: usize,
}

impl<'a> Plan<'a> {
    /// Number of rows.
    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    /// All terms on the rows of `range`, one after the other; allocates nothing.
    pub(crate) fn evaluate(&self, range: Range<usize>, out: &mut [f64]) -> Result<(), SparseError> {
        let n = range.len();
        for index in 0..self.steps.len() {
            let (done, rest) = out.split_at_mut(index * n);
            let column = &mut rest[..n];
            self.monomial(index, range.clone(), |at| &done[at * n..(at + 1) * n], column);
            self.finish(index, range.clone(), column)?;
        }
        Ok(())
    }

    /// The monomial of a term from one of the terms `before` it, or from the variables.
    fn monomial<'b>(
        &self,
        index: usize,
        range: Range<usize>,
        before: impl Fn(usize) -> &'b [f64],
        column: &mut [f64],
    ) {
        if let Some((parent, by)) = self.steps[index].parent {
            let factors = before(parent).iter().zip(&self.variables[by][range]);
            column.iter_mut().zip(factors).for_each(|(c, (a, b))| *c = a * b);
            return;
        }
        column.fill(1.0);
        for (&p, variable) in self.library.terms[index].powers.iter().zip(self.variables) {
            for _ in 0..p {
                column.iter_mut().zip(&variable[range.clone()]).for_each(|(c, v)| *c *= v);
            }
        }
    }

    /// Multiplies by the term's function, and checks that the values are finite.
    fn finish(&self, index: usize, range: Range<usize>, column: &mut [f64]) -> Result<(), SparseError> {
        let mut apply = |values: &[f64], f: &dyn Fn(f64) -> f64| {
            column.iter_mut().zip(&values[range.clone()]).for_each(|(c, &v)| *c *= f(v));
        };
        let term = &self.library.terms[index];
        match &term.function {
            Some(Function::Sin { variable, harmonic }) => {
                let h = f64::from(*harmonic);
                apply(self.variables[*variable], &|v| (h * v).sin());
            }
            Some(Function::Cos { variable, harmonic }) => {
                let h = f64::from(*harmonic);
                apply(self.variables[*variable], &|v| (h * v).cos());
            }
            Some(Function::Sign { variable }) => {
                apply(self.variables[*variable], &|v| if v == 0.0 { 0.0 } else { v.signum() });
            }
            Some(Function::Abs { variable }) => apply(self.variables[*variable], &f64::abs),
            Some(Function::Expression(_)) => apply(self.steps[index].values.unwrap_or(&[]), &|v| v),
            None => {}
        }
        // Without an early end the check runs on vectors.
        let finite = column.iter().fold(true, |all, v| all & v.is_finite());
        match if finite { None } else { first_not_finite(column) } {
            None => Ok(()),
            Some(row) => {
                let what = format!("term {}", term.label(&self.library.variables));
                Err(SparseError::NotFinite { what, row: range.start + row })
            }
        }
    }
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
