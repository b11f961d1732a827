//! Names of a model as identifiers of a language.

use std::collections::HashSet;

/// The name in ASCII letters, digits and `_`: any other character by its code point.
///
/// A name that starts with `_` is nobody's: names of the model language start with a letter, so what
/// the generated code calls its own may start with `_` without a clash.
pub(crate) fn ascii(name: &str) -> String {
    let mut out = String::with_capacity(name.len());
    for c in name.chars() {
        if c.is_ascii_alphanumeric() || c == '_' {
            out.push(c);
        } else {
            out.push_str(&format!("_u{:x}_", c as u32));
        }
    }
    out
}

/// Identifiers given to the symbols of a model, each its own.
#[derive(Debug)]
pub(crate) struct Names {
    taken: HashSet<String>,
    given: Vec<(String, u8, String)>,
}

impl Names {
    /// No symbol has an identifier yet, and none gets one of `reserved`.
    pub(crate) fn new(reserved: &[&str]) -> Names {
        Names { taken: reserved.iter().map(|&word| word.to_owned()).collect(), given: Vec::new() }
    }

    /// An identifier for the symbol: its name with `_dot`, `_ddot`, `_d3`, … for its primes where nobody
    /// else has that, and with a digit behind it elsewhere.
    pub(crate) fn add(&mut self, name: &str, primes: u8) -> String {
        let suffix = match primes {
            0 => String::new(),
            1 => "_dot".to_owned(),
            2 => "_ddot".to_owned(),
            n => format!("_d{n}"),
        };
        let identifier = self.fresh(&format!("{}{suffix}", ascii(name)));
        self.given.push((name.to_owned(), primes, identifier.clone()));
        identifier
    }

    /// An identifier that nobody has, as near to `wanted` as can be.
    pub(crate) fn fresh(&mut self, wanted: &str) -> String {
        let wanted = if wanted.starts_with(|c: char| c.is_ascii_alphabetic()) {
            wanted.to_owned()
        } else {
            format!("u{wanted}")
        };
        let mut identifier = wanted.clone();
        let mut number = 1;
        while !self.taken.insert(identifier.clone()) {
            number += 1;
            identifier = format!("{wanted}_{number}");
        }
        identifier
    }

    /// The identifier of a symbol.
    pub(crate) fn get(&self, name: &str, primes: u8) -> Option<&str> {
        self.given.iter().find(|(n, p, _)| n == name && *p == primes).map(|(_, _, id)| id.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_symbols_share_an_identifier() {
        let mut names = Names::new(&["lambda"]);
        let symbols = [
            ("lambda", 0),
            ("lambda_2", 0),
            ("x", 1),
            ("x_dot", 0),
            ("x", 2),
            ("x", 3),
            ("θ", 0),
            ("_u3b8_", 0),
        ];
        let given: Vec<String> = symbols.iter().map(|&(name, primes)| names.add(name, primes)).collect();
        let own: HashSet<&String> = given.iter().collect();
        assert_eq!(own.len(), symbols.len(), "{given:?}");
        assert_eq!(given[..6], ["lambda_2", "lambda_2_2", "x_dot", "x_dot_2", "x_ddot", "x_d3"]);
        assert!(
            given.iter().all(|id| id.starts_with(|c: char| c.is_ascii_alphabetic()) && id.is_ascii()),
            "{given:?}"
        );
        assert_eq!(names.get("x_dot", 0), Some("x_dot_2"));
        assert_eq!(names.get("y", 0), None);
    }
}
