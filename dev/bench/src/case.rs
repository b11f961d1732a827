//! What a row measures.

use std::collections::BTreeMap;

use anyhow::{Result, bail};
use serde_json::Value;

/// What the work came to: arrays by name.
pub(crate) type Answer = BTreeMap<String, Vec<f64>>;

/// Compares our answer with that of a peer (its function); an error where they disagree, else how closely they agree.
pub(crate) type Agreement = Box<dyn Fn(&str, &Answer, &Answer) -> Result<String>>;

/// A hot path, ready to run.
pub(crate) struct Case {
    /// What both sides start from.
    pub(crate) data: Vec<(&'static str, Vec<f64>)>,
    /// The same for what is not an array.
    pub(crate) settings: Value,
    /// The work.
    pub(crate) work: Box<dyn FnMut() -> Result<Answer> + Send>,
    /// Units in one call of the work.
    pub(crate) units: f64,
    /// How answers are compared.
    pub(crate) agree: Agreement,
}

impl Case {
    /// A case without peers.
    pub(crate) fn alone(units: f64, work: impl FnMut() -> Result<Answer> + Send + 'static) -> Self {
        Self {
            data: Vec::new(),
            settings: Value::Null,
            work: Box::new(work),
            units,
            agree: Box::new(|_, _, _| bail!("nothing to compare with")),
        }
    }
}

/// A tool measured beside ours.
pub(crate) struct Peer {
    /// Function of `dev/bench/peers.py`.
    pub(crate) function: &'static str,
    /// As the table names it.
    pub(crate) name: &'static str,
    /// How many times faster we want to be.
    pub(crate) goal: f64,
}

/// Against what a row is held.
pub(crate) enum Against {
    /// Nothing, or other tools.
    Peers(&'static [Peer]),
    /// The floating-point peak of the core, measured in the same run: operations of one unit, and the share wanted.
    Peak {
        /// Floating-point operations of one unit.
        operations: f64,
        /// Share of the peak wanted.
        goal: f64,
    },
    /// Itself on one core; wall-clock time on two.
    TwoCores {
        /// How many times faster two cores should be.
        goal: f64,
    },
}

impl Against {
    /// Nothing.
    pub(crate) const NOTHING: Self = Self::Peers(&[]);
}

/// A row of the table.
pub(crate) struct Row {
    /// Its name on the command line.
    pub(crate) name: &'static str,
    /// What is measured.
    pub(crate) what: &'static str,
    /// What a unit is: `search`, `step`.
    pub(crate) unit: &'static str,
    /// What it is held against.
    pub(crate) against: Against,
    /// Prepares it.
    pub(crate) make: fn() -> Result<Case>,
}

impl Row {
    pub(crate) const fn new(
        name: &'static str,
        what: &'static str,
        unit: &'static str,
        against: Against,
        make: fn() -> Result<Case>,
    ) -> Self {
        Self { name, what, unit, against, make }
    }
}

/// The array of a name; its values are finite, since NaN would agree with everything.
pub(crate) fn array<'a>(answer: &'a Answer, name: &str) -> Result<&'a [f64]> {
    match answer.get(name) {
        Some(values) if values.iter().all(|v| v.is_finite()) => Ok(values),
        Some(_) => bail!("\"{name}\" has a value that is not finite"),
        None => bail!("the answer has no array \"{name}\""),
    }
}

/// Largest difference of two arrays, relative to the largest value of the second.
pub(crate) fn difference(ours: &[f64], theirs: &[f64]) -> Result<f64> {
    if ours.len() != theirs.len() || ours.is_empty() {
        bail!("{} values against {}", ours.len(), theirs.len());
    }
    let size = theirs.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let most = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    Ok(most / size)
}

/// [`difference`], an error above `tolerance`.
pub(crate) fn close(ours: &Answer, theirs: &Answer, name: &str, tolerance: f64) -> Result<String> {
    let found = difference(array(ours, name)?, array(theirs, name)?)?;
    if found <= tolerance {
        Ok(format!("{name} within {found:.1e} (allowed {tolerance:.0e})"))
    } else {
        bail!("{name} differ by {found:.1e} of the largest; {tolerance:.0e} is allowed")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_relative_and_nan_never_agrees() {
        assert_eq!(difference(&[1.0, 4.5], &[1.0, 4.0]).unwrap(), 0.125);
        assert!(difference(&[1.0], &[1.0, 2.0]).is_err());
        let answer = |v: f64| Answer::from([("x".to_owned(), vec![v, 1.0])]);
        assert!(close(&answer(2.0), &answer(2.0), "x", 1e-9).is_ok());
        assert!(close(&answer(2.1), &answer(2.0), "x", 1e-2).is_err());
        assert!(close(&answer(f64::NAN), &answer(2.0), "x", 1.0).is_err());
        assert!(close(&answer(2.0), &answer(2.0), "y", 1.0).is_err());
    }
}
