//! Libraries of candidate terms, nested by order (thesis Eq 2.2, Algorithm 1 lines 3 to 5).

use std::fmt;

use crate::SparseError;

/// A function of one variable that multiplies the powers of a term.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Function {
    /// sin(n·v) of variable number `variable` with the harmonic n.
    Sin {
        /// Index of the variable.
        variable: usize,
        /// n ≥ 1.
        harmonic: u32,
    },
    /// cos(n·v).
    Cos {
        /// Index of the variable.
        variable: usize,
        /// n ≥ 1.
        harmonic: u32,
    },
    /// sign(v), 0 at v = 0: Coulomb friction of a velocity.
    Sign {
        /// Index of the variable.
        variable: usize,
    },
    /// |v|.
    Abs {
        /// Index of the variable.
        variable: usize,
    },
    /// A function the caller evaluates, known by its text.
    User(String),
}

/// One column of a library: Π vᵢ^eᵢ, times a function where there is one.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Term {
    /// Exponent of every variable.
    pub powers: Vec<u32>,
    /// The other factor.
    pub function: Option<Function>,
}

impl Term {
    /// The term in the variables' names, such as `x^2*x'`, `sin(2*theta)` or `1`.
    ///
    /// ```
    /// let term = greybox_sparse::Term { powers: vec![2, 1], function: None };
    /// assert_eq!(term.display(&["x".into(), "x'".into()]).to_string(), "x^2*x'");
    /// ```
    #[must_use]
    pub fn display<'a>(&'a self, variables: &'a [String]) -> TermText<'a> {
        TermText { term: self, variables }
    }
}

/// A term with its variables' names, to be printed.
#[derive(Debug)]
pub struct TermText<'a> {
    term: &'a Term,
    variables: &'a [String],
}

impl fmt::Display for TermText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = |i: usize| self.variables.get(i).map_or("?", String::as_str);
        let harmonic = |n: u32| if n == 1 { String::new() } else { format!("{n}*") };
        let mut factors: Vec<String> = Vec::new();
        for (i, &power) in self.term.powers.iter().enumerate() {
            match power {
                0 => {}
                1 => factors.push(name(i).to_owned()),
                e => factors.push(format!("{}^{e}", name(i))),
            }
        }
        match &self.term.function {
            None => {}
            Some(Function::Sin { variable, harmonic: n }) => {
                factors.push(format!("sin({}{})", harmonic(*n), name(*variable)));
            }
            Some(Function::Cos { variable, harmonic: n }) => {
                factors.push(format!("cos({}{})", harmonic(*n), name(*variable)));
            }
            Some(Function::Sign { variable }) => factors.push(format!("sign({})", name(*variable))),
            Some(Function::Abs { variable }) => factors.push(format!("abs({})", name(*variable))),
            Some(Function::User(text)) => factors.push(text.clone()),
        }
        f.write_str(if factors.is_empty() { "1" } else { "" })?;
        f.write_str(&factors.join("*"))
    }
}

/// Terms ordered so that order N+1 only adds terms behind those of order N: one Gram matrix serves all orders.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Library {
    variables: Vec<String>,
    terms: Vec<Term>,
    sizes: Vec<usize>,
}

impl Library {
    /// All Π vᵢ^eᵢ with eᵢ ≤ `limits[i]` but the constant (thesis Eq 2.2: for x, x' and N = M = 3 there are 15).
    /// Order n holds those with every exponent ≤ n.
    ///
    /// ```
    /// let library = greybox_sparse::Library::tensor(&["x", "x'"], &[3, 3]);
    /// assert_eq!(library.sizes(), [3, 8, 15]);
    /// assert_eq!(library.names()[..3], ["x", "x'", "x*x'"]);
    /// ```
    #[must_use]
    pub fn tensor(variables: &[&str], limits: &[u32]) -> Self {
        let limit = |i: usize| limits.get(i).copied().unwrap_or(0);
        let mut powers = vec![Vec::new()];
        for i in 0..variables.len() {
            powers = extend(&powers, |_| limit(i));
        }
        let highest = (0..variables.len()).map(limit).max().unwrap_or(0);
        Self::by_order(variables, powers, highest, |p| p.iter().copied().max().unwrap_or(0))
    }

    /// All monomials of total degree 1 to `degree` (0 to `degree` with `constant`, which then stands first).
    #[must_use]
    pub fn total_degree(variables: &[&str], degree: u32, constant: bool) -> Self {
        let mut powers = vec![Vec::new()];
        for _ in variables {
            powers = extend(&powers, |p| degree - p.iter().sum::<u32>());
        }
        let library = Self::by_order(variables, powers, degree, |p| p.iter().sum());
        if constant {
            library.with_leading(&[Term { powers: vec![0; variables.len()], function: None }])
        } else {
            library
        }
    }

    /// Powers of each variable alone, vᵢ^n, n ≤ `order` (the thesis' library for the rotary flexible link).
    #[must_use]
    pub fn separate(variables: &[&str], order: u32) -> Self {
        let count = variables.len();
        let powers = (1..=order)
            .flat_map(|n| (0..count).map(move |i| (0..count).map(|q| if q == i { n } else { 0 }).collect()))
            .collect();
        Self::by_order(variables, powers, order, |p| p.iter().copied().max().unwrap_or(0))
    }

    /// sin(n vᵢ) and cos(n vᵢ) of each variable; order n adds the harmonic n.
    #[must_use]
    pub fn trigonometric(variables: &[&str], harmonics: u32) -> Self {
        let mut library = Self::by_order(variables, Vec::new(), 0, |_| 0);
        for harmonic in 1..=harmonics {
            for variable in 0..variables.len() {
                for function in [Function::Sin { variable, harmonic }, Function::Cos { variable, harmonic }] {
                    library.terms.push(Term { powers: vec![0; variables.len()], function: Some(function) });
                }
            }
            library.sizes.push(library.terms.len());
        }
        library
    }

    /// Terms of the caller's choice, all of order 1.
    #[must_use]
    pub fn user(variables: &[&str], terms: &[Term]) -> Self {
        let names = variables.iter().map(|v| (*v).to_owned()).collect();
        Self { variables: names, terms: terms.to_vec(), sizes: vec![terms.len()] }
    }

    /// The same library with terms put in front that belong to every order, such as sign(theta').
    #[must_use]
    pub fn with_leading(mut self, terms: &[Term]) -> Self {
        let new: Vec<Term> = terms.iter().filter(|t| !self.terms.contains(t)).cloned().collect();
        self.sizes.iter_mut().for_each(|s| *s += new.len());
        if self.sizes.is_empty() {
            self.sizes.push(new.len());
        }
        self.terms.splice(0..0, new);
        self
    }

    /// Both libraries order by order: order n holds the terms of order n of either, each once. A library with
    /// fewer orders stays at its last. Both must be over the same variables.
    ///
    /// # Errors
    /// [`SparseError::Length`] when the numbers of variables differ.
    pub fn merge(&self, other: &Self) -> Result<Self, SparseError> {
        if self.variables.len() != other.variables.len() {
            return Err(SparseError::Length {
                what: "the second library's list of variables".into(),
                found: other.variables.len(),
                expected: self.variables.len(),
            });
        }
        let mut out = Self { variables: self.variables.clone(), terms: Vec::new(), sizes: Vec::new() };
        for order in 1..=self.orders().max(other.orders()) {
            for term in self.added(order).iter().chain(other.added(order)) {
                if !out.terms.contains(term) {
                    out.terms.push(term.clone());
                }
            }
            out.sizes.push(out.terms.len());
        }
        Ok(out)
    }

    /// The terms, those of a higher order behind those of a lower one.
    #[must_use]
    pub fn terms(&self) -> &[Term] {
        &self.terms
    }

    /// Number of orders.
    #[must_use]
    pub fn orders(&self) -> usize {
        self.sizes.len()
    }

    /// How many leading terms make up order 1, 2, ….
    #[must_use]
    pub fn sizes(&self) -> &[usize] {
        &self.sizes
    }

    /// Every term as text.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        self.terms.iter().map(|t| t.display(&self.variables).to_string()).collect()
    }

    /// All columns (one per term) from the variables' samples, each power and product by one multiplication.
    /// `user` gives the values of [`Function::User`] factors by their text.
    ///
    /// # Errors
    /// [`SparseError::Length`] for slices of different length or number, [`SparseError::NoUserValues`],
    /// [`SparseError::NoSuchColumn`] when a function names a variable that is not there.
    ///
    /// ```
    /// use greybox_sparse::Library;
    /// let library = Library::tensor(&["x", "x'"], &[2, 2]);
    /// let columns = library.evaluate(&[&[2.0], &[3.0]], &[])?;
    /// assert_eq!(library.names()[7], "x^2*x'^2");
    /// assert_eq!(columns[7], [36.0]);
    /// # Ok::<(), greybox_sparse::SparseError>(())
    /// ```
    pub fn evaluate(
        &self,
        variables: &[&[f64]],
        user: &[(&str, &[f64])],
    ) -> Result<Vec<Vec<f64>>, SparseError> {
        if variables.len() != self.variables.len() {
            return Err(SparseError::Length {
                what: "the list of variables".into(),
                found: variables.len(),
                expected: self.variables.len(),
            });
        }
        let rows = variables.first().map_or_else(|| user.first().map_or(0, |u| u.1.len()), |v| v.len());
        let lengths = variables.iter().zip(&self.variables).map(|(v, n)| (n.as_str(), v.len()));
        for (name, found) in lengths.chain(user.iter().map(|u| (u.0, u.1.len()))) {
            if found != rows {
                return Err(SparseError::Length { what: name.into(), found, expected: rows });
            }
        }
        let powers = self.power_tables(variables);
        self.terms.iter().map(|term| self.column(term, variables, &powers, user, rows)).collect()
    }

    /// `tables[i][e − 2]` = variable i to the power e ≥ 2.
    fn power_tables(&self, variables: &[&[f64]]) -> Vec<Vec<Vec<f64>>> {
        variables
            .iter()
            .enumerate()
            .map(|(i, v)| {
                let highest = self.terms.iter().filter_map(|t| t.powers.get(i)).copied().max().unwrap_or(0);
                let mut table: Vec<Vec<f64>> = Vec::new();
                for _ in 2..=highest {
                    let last: &[f64] = table.last().map_or(v, Vec::as_slice);
                    table.push(last.iter().zip(*v).map(|(a, b)| a * b).collect());
                }
                table
            })
            .collect()
    }

    fn column(
        &self,
        term: &Term,
        variables: &[&[f64]],
        powers: &[Vec<Vec<f64>>],
        user: &[(&str, &[f64])],
        rows: usize,
    ) -> Result<Vec<f64>, SparseError> {
        let variable = |i: usize| {
            variables.get(i).copied().ok_or(SparseError::NoSuchColumn {
                what: "a term of the library",
                column: i,
                columns: variables.len(),
            })
        };
        let mut out: Option<Vec<f64>> = match &term.function {
            None => None,
            Some(Function::Sin { variable: v, harmonic }) => {
                Some(variable(*v)?.iter().map(|x| (f64::from(*harmonic) * x).sin()).collect())
            }
            Some(Function::Cos { variable: v, harmonic }) => {
                Some(variable(*v)?.iter().map(|x| (f64::from(*harmonic) * x).cos()).collect())
            }
            Some(Function::Sign { variable: v }) => {
                Some(variable(*v)?.iter().map(|x| if *x == 0.0 { 0.0 } else { x.signum() }).collect())
            }
            Some(Function::Abs { variable: v }) => Some(variable(*v)?.iter().map(|x| x.abs()).collect()),
            Some(Function::User(name)) => {
                let values =
                    user.iter().find(|(n, _)| n == name).ok_or_else(|| SparseError::NoUserValues {
                        term: term.display(&self.variables).to_string(),
                        name: name.clone(),
                    })?;
                Some(values.1.to_vec())
            }
        };
        for (i, &power) in term.powers.iter().enumerate().filter(|(_, p)| **p > 0) {
            let values = if power == 1 { variable(i)? } else { powers[i][power as usize - 2].as_slice() };
            match &mut out {
                Some(column) => column.iter_mut().zip(values).for_each(|(c, v)| *c *= v),
                None => out = Some(values.to_vec()),
            }
        }
        Ok(out.unwrap_or_else(|| vec![1.0; rows]))
    }

    fn by_order(
        variables: &[&str],
        powers: Vec<Vec<u32>>,
        orders: u32,
        order: impl Fn(&[u32]) -> u32,
    ) -> Self {
        let mut library = Self {
            variables: variables.iter().map(|v| (*v).to_owned()).collect(),
            terms: Vec::new(),
            sizes: Vec::new(),
        };
        for n in 1..=orders {
            let new = powers.iter().filter(|p| order(p) == n);
            library.terms.extend(new.map(|p| Term { powers: p.clone(), function: None }));
            library.sizes.push(library.terms.len());
        }
        library
    }

    /// The terms that `order` (from 1) adds.
    fn added(&self, order: usize) -> &[Term] {
        let at = |n: usize| if n == 0 { 0 } else { self.sizes[n - 1] };
        if order > self.sizes.len() { &[] } else { &self.terms[at(order - 1)..at(order)] }
    }
}

/// Every list with one more exponent 0 ..= limit(list), the last variable slowest, so that of equal order
/// x stands before x'.
fn extend(powers: &[Vec<u32>], limit: impl Fn(&[u32]) -> u32) -> Vec<Vec<u32>> {
    let highest = powers.iter().map(|p| limit(p)).max().unwrap_or(0);
    (0..=highest)
        .flat_map(|e| {
            powers
                .iter()
                .filter(|p| e <= limit(p))
                .map(move |p| p.iter().copied().chain([e]).collect())
                .collect::<Vec<_>>()
        })
        .collect()
}
