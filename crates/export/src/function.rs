//! A function of named arrays, in expressions.

use greybox_model::Expr;
use greybox_model::expr::Func;

use crate::error::ExportError;
use crate::keywords::is_identifier;

/// One argument's element: a symbol of the expressions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Member {
    /// Name of the symbol.
    pub name: String,
    /// Its primes.
    pub primes: u8,
    /// Unit, for the comment; may be empty.
    pub unit: String,
}

impl Member {
    /// A symbol with primes and unit.
    #[must_use]
    pub fn new(name: &str, primes: u8, unit: &str) -> Member {
        Member { name: name.into(), primes, unit: unit.into() }
    }

    /// As in the model language.
    pub(crate) fn symbol(&self) -> String {
        symbol(&self.name, self.primes)
    }
}

/// The symbol as in the model language.
pub(crate) fn symbol(name: &str, primes: u8) -> String {
    Expr::prime(name, primes).to_string()
}

/// An argument: an array of symbols.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    /// Name of the array.
    pub name: String,
    /// Its elements, in order.
    pub members: Vec<Member>,
}

/// A named number inside the function.
#[derive(Debug, Clone, PartialEq)]
pub struct Constant {
    /// Name of the symbol.
    pub name: String,
    /// Value.
    pub value: f64,
    /// Unit, for the comment; may be empty.
    pub unit: String,
}

impl Constant {
    /// A constant with its unit.
    #[must_use]
    pub fn new(name: &str, value: f64, unit: &str) -> Constant {
        Constant { name: name.into(), value, unit: unit.into() }
    }
}

/// A function from arrays of numbers to an array of numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Function {
    /// Its name in the code.
    pub name: String,
    /// Lines of the comment above it.
    pub summary: Vec<String>,
    /// Arguments, in order.
    pub arguments: Vec<Group>,
    /// Constants; those that no output uses are left out of the code.
    pub constants: Vec<Constant>,
    /// What is computed: description and expression in the symbols of arguments and constants.
    pub outputs: Vec<(String, Expr)>,
}

/// Numbers that the code must reproduce.
#[derive(Debug, Clone, PartialEq)]
pub struct Vector {
    /// All arguments' elements, one after the other.
    pub arguments: Vec<f64>,
    /// The outputs.
    pub outputs: Vec<f64>,
}

impl Function {
    /// What the expressions give for arguments: all elements, one after the other, one list per vector.
    ///
    /// # Errors
    /// As [`code`](Self::code); [`ExportError::NotFinite`] where an argument is not a finite number or is missing.
    pub fn vectors(&self, arguments: &[Vec<f64>]) -> Result<Vec<Vector>, ExportError> {
        self.check()?;
        let members: Vec<&Member> = self.arguments.iter().flat_map(|g| &g.members).collect();
        let one = |given: &Vec<f64>| -> Result<Vector, ExportError> {
            for (k, member) in members.iter().enumerate() {
                let value = given.get(k).copied().unwrap_or(f64::NAN);
                if !value.is_finite() {
                    return Err(ExportError::NotFinite { name: member.symbol(), value });
                }
            }
            let value = |name: &str, primes: u8| {
                let argument = members.iter().position(|m| m.name == name && m.primes == primes);
                argument.map(|k| given[k]).or_else(|| self.constant(name, primes).map(|c| c.value))
            };
            let outputs = self.outputs.iter().map(|(_, e)| e.eval(&value).unwrap_or(f64::NAN)).collect();
            Ok(Vector { arguments: given.clone(), outputs })
        };
        arguments.iter().map(one).collect()
    }

    pub(crate) fn constant(&self, name: &str, primes: u8) -> Option<&Constant> {
        self.constants.iter().find(|c| primes == 0 && c.name == name)
    }

    /// The argument and the element of a symbol.
    pub(crate) fn argument(&self, name: &str, primes: u8) -> Option<(&Group, usize)> {
        self.arguments
            .iter()
            .find_map(|g| g.members.iter().position(|m| m.name == name && m.primes == primes).map(|k| (g, k)))
    }

    /// That it can be written.
    pub(crate) fn check(&self) -> Result<(), ExportError> {
        for name in self.arguments.iter().map(|g| &g.name).chain([&self.name]) {
            if !is_identifier(name) {
                return Err(ExportError::Name { name: name.clone() });
            }
        }
        let symbols = self.arguments.iter().flat_map(|g| g.members.iter().map(Member::symbol));
        let all: Vec<String> = symbols.chain(self.constants.iter().map(|c| c.name.clone())).collect();
        let arrays: Vec<String> = self.arguments.iter().map(|g| g.name.clone()).collect();
        for names in [all, arrays] {
            for (k, name) in names.iter().enumerate() {
                if names[..k].contains(name) {
                    return Err(ExportError::Twice { name: name.clone() });
                }
            }
        }
        if let Some(c) = self.constants.iter().find(|c| !c.value.is_finite()) {
            return Err(ExportError::NotFinite { name: c.name.clone(), value: c.value });
        }
        for (output, expression) in &self.outputs {
            let mut fault = None;
            expression.walk(&mut |e| {
                let output = output.clone();
                match e {
                    Expr::Num(value) if !value.is_finite() => {
                        fault = Some(ExportError::NotFinite { name: output, value: *value });
                    }
                    Expr::Var { name, primes } => {
                        let known = self.argument(name, *primes).is_some()
                            || self.constant(name, *primes).is_some()
                            || (&**name == "pi" && *primes == 0);
                        if !known {
                            fault = Some(ExportError::Unknown { output, symbol: symbol(name, *primes) });
                        }
                    }
                    Expr::Call(f @ (Func::Delay | Func::Step), _) => {
                        fault = Some(ExportError::Time { output, function: f.name() });
                    }
                    _ => {}
                }
            });
            if let Some(fault) = fault {
                return Err(fault);
            }
        }
        Ok(())
    }
}
