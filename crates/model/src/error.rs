//! What can be wrong with a model, and where.

use crate::units::Dimension;
use std::fmt;
use std::ops::Range;

/// A model that cannot be used: what is wrong, where, and how to fix it.
///
/// Its `Display` is one paragraph, `file:line:column: what is wrong; help: …`; the parts are at
/// hand for a renderer that shows the source line.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct ModelError(Box<Details>);

#[derive(Debug, Clone, PartialEq)]
struct Details {
    problem: Problem,
    help: Option<String>,
    file: Option<String>,
    span: Option<Range<usize>>,
    line_column: Option<(usize, usize)>,
}

/// Where in the model an expression stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// The equation of this name.
    Equation(String),
    /// The measurement of this channel.
    Measurement(String),
    /// An expression given to a function of this library.
    Expression,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Place::Equation(name) => write!(f, "equation \"{name}\""),
            Place::Measurement(channel) => write!(f, "measurement \"{channel}\""),
            Place::Expression => f.write_str("expression"),
        }
    }
}

/// The kinds of faults.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// Not TOML.
    #[error("this is not TOML: {message}")]
    Toml {
        /// From the TOML parser.
        message: String,
    },
    /// A key that the language does not have.
    #[error("unknown key `{key}` in {table}")]
    UnknownKey {
        /// As written.
        key: String,
        /// Where it stands.
        table: String,
    },
    /// A key that must be there.
    #[error("{table} lacks `{key}`")]
    MissingKey {
        /// What is missing.
        key: String,
        /// Where.
        table: String,
    },
    /// A value of the wrong type or range.
    #[error("{item}: {message}")]
    BadValue {
        /// What the value belongs to.
        item: String,
        /// What is wrong with it.
        message: String,
    },
    /// A name that the language needs for itself, or that is no name.
    #[error("`{name}` cannot name a {what}: {reason}")]
    BadName {
        /// The name.
        name: String,
        /// Input, state or parameter.
        what: &'static str,
        /// Why not.
        reason: String,
    },
    /// A name used twice.
    #[error("`{name}` is {first} and {second} at once")]
    DuplicateName {
        /// The name.
        name: String,
        /// Its first use.
        first: &'static str,
        /// Its second use.
        second: &'static str,
    },
    /// An expression that does not parse.
    #[error("{place}: {message}")]
    Syntax {
        /// Where.
        place: Place,
        /// What was found and expected.
        message: String,
    },
    /// A name that is not declared.
    #[error("{place}: `{name}` is not defined")]
    Undefined {
        /// Where.
        place: Place,
        /// The name.
        name: String,
    },
    /// Primes where there is no derivative.
    #[error("{place}: `{symbol}`: {reason}")]
    Primes {
        /// Where.
        place: Place,
        /// As written, with its primes.
        symbol: String,
        /// Why not.
        reason: String,
    },
    /// A function's argument that has no meaning.
    #[error("{place}: `{call}`: {reason}")]
    Argument {
        /// Where.
        place: Place,
        /// The call.
        call: String,
        /// Why not.
        reason: String,
    },
    /// A text that is not a unit.
    #[error("{item}: the unit `{text}` cannot be read: {message}")]
    Unit {
        /// What the unit belongs to.
        item: String,
        /// As written.
        text: String,
        /// What is wrong with it.
        message: String,
    },
    /// As many equations as states are needed.
    #[error("{equations} {} for {states} {}", plural(*.equations, "equation"), plural(*.states, "state"))]
    EquationCount {
        /// Number of equations.
        equations: usize,
        /// Number of states.
        states: usize,
    },
    /// A state without any derivative in the equations.
    #[error("the state `{state}` never appears with a prime, so no equation says how it moves")]
    Algebraic {
        /// The state.
        state: String,
    },
    /// A highest derivative that does not enter linearly.
    #[error("{place}: the term `{term}` is not affine in the highest derivative `{unknown}`: {reason}")]
    NotAffine {
        /// The equation.
        place: Place,
        /// The offending term.
        term: String,
        /// The highest derivative.
        unknown: String,
        /// How it enters.
        reason: String,
    },
    /// The equations cannot be solved for the highest derivatives.
    #[error("{place} cannot be solved for a highest derivative of its own: {reason}")]
    Singular {
        /// An equation that is left over.
        place: Place,
        /// A state that no equation is left for.
        state: String,
        /// What it contains instead.
        reason: String,
    },
    /// Two claims on a channel, or a state that is measured and is not.
    #[error("{item}: {message}")]
    Measurement {
        /// The state or channel.
        item: String,
        /// What is wrong.
        message: String,
    },
    /// Terms of a sum that do not share a dimension.
    #[error("{place}: the term `{term}` is in {}, but {others} {} in {}", dim(.dimension), if *.several { "are" } else { "is" }, dim(.expected))]
    Dimension {
        /// Where.
        place: Place,
        /// The term in the minority.
        term: String,
        /// Its dimension.
        dimension: Dimension,
        /// The other terms, as text.
        others: String,
        /// Whether `others` are several.
        several: bool,
        /// Their dimension.
        expected: Dimension,
    },
    /// An expression whose dimension must be another one.
    #[error("{place}: {role} must be {}, but `{term}` is in {}", wanted(.expected), dim(.dimension))]
    Needs {
        /// Where.
        place: Place,
        /// What the expression is, such as ``the argument of `sin` ``.
        role: String,
        /// The expression.
        term: String,
        /// Its dimension.
        dimension: Dimension,
        /// The one it must have.
        expected: Dimension,
    },
    /// Stated units that contradict each other through parameters without a unit.
    #[error("{place}: no unit of {parameters} lets the term `{term}` share the dimension of `{other}`: they differ by {}", dim(.ratio))]
    Contradiction {
        /// Where.
        place: Place,
        /// A term.
        term: String,
        /// What it is compared with.
        other: String,
        /// The parameters whose units are inferred.
        parameters: String,
        /// Dimension of `term` over that of `other`.
        ratio: Dimension,
    },
    /// A power whose dimension cannot be known.
    #[error("{place}: the exponent of `{term}` must be a number, because its base has a dimension ({})", dim(.dimension))]
    Exponent {
        /// Where.
        place: Place,
        /// The power.
        term: String,
        /// The dimension of the base.
        dimension: Dimension,
    },
}

fn plural(count: usize, word: &str) -> String {
    if count == 1 { word.to_owned() } else { format!("{word}s") }
}

fn dim(d: &Dimension) -> String {
    if d.is_none() { "1 (dimensionless)".into() } else { format!("{d}") }
}

fn wanted(d: &Dimension) -> String {
    if d.is_none() { "dimensionless".into() } else { format!("in {d}") }
}

impl ModelError {
    pub(crate) fn new(problem: Problem) -> ModelError {
        ModelError(Box::new(Details { problem, help: None, file: None, span: None, line_column: None }))
    }

    #[must_use]
    pub(crate) fn with_help(mut self, help: impl Into<String>) -> ModelError {
        self.0.help = Some(help.into());
        self
    }

    /// Adds the place in `text`, unless one is known.
    #[must_use]
    pub(crate) fn at(mut self, file: &str, text: &str, span: Option<Range<usize>>) -> ModelError {
        self.0.file.get_or_insert_with(|| file.to_owned());
        if self.0.span.is_none()
            && let Some(span) = span
        {
            let start =
                (0..=span.start.min(text.len())).rev().find(|&i| text.is_char_boundary(i)).unwrap_or(0);
            let before = &text[..start];
            let line = before.matches('\n').count() + 1;
            let column = before.rsplit('\n').next().unwrap_or("").chars().count() + 1;
            self.0.line_column = Some((line, column));
            self.0.span = Some(span);
        }
        self
    }

    /// The kind of fault, with its parts.
    pub fn problem(&self) -> &Problem {
        &self.0.problem
    }

    /// Bytes of the file to point at; `None` for faults found outside a file.
    pub fn span(&self) -> Option<Range<usize>> {
        self.0.span.clone()
    }

    /// The file as named to [`Model::from_toml`](crate::Model::from_toml).
    pub fn file(&self) -> Option<&str> {
        self.0.file.as_deref()
    }

    /// Line and column (in characters) of the span's start, both from 1.
    pub fn line_column(&self) -> Option<(usize, usize)> {
        self.0.line_column
    }

    /// The fix.
    pub fn help(&self) -> Option<&str> {
        self.0.help.as_deref()
    }
}

impl fmt::Display for ModelError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(file) = self.file() {
            write!(f, "{file}:")?;
            if let Some((line, column)) = self.line_column() {
                write!(f, "{line}:{column}:")?;
            }
            f.write_str(" ")?;
        }
        write!(f, "{}", self.problem())?;
        self.help().map_or(Ok(()), |help| write!(f, "; help: {help}"))
    }
}

impl std::error::Error for ModelError {}
