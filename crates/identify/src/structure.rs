//! What an equation may be made of: candidate terms, and the model a choice of them writes.

use greybox_model::{Hold, Model, ModelError};

/// A candidate term of one equation.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Term {
    /// Index of the equation.
    pub equation: usize,
    /// The term in the model language, without its coefficient.
    pub expression: String,
    /// Name of its coefficient.
    pub parameter: String,
    /// Exponents of the variables, for a monomial.
    pub powers: Vec<(String, u32)>,
    /// Smallest order of the library that has it.
    pub order: usize,
    /// Whether the term keeps its sign when all variables change theirs.
    pub even: bool,
    /// Whether selection may leave it out.
    pub optional: bool,
}

/// An input or a state of the structure.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Signal {
    /// Name, also the recording's channel.
    pub name: String,
    /// Unit, as the recording's header writes it.
    pub unit: Option<String>,
}

/// A part of every equation that is not a coefficient times a term: a delayed feedback beside the input.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Extra {
    /// Expression in the model language.
    pub expression: String,
    /// Its parameters: name, first value, whether known.
    pub parameters: Vec<(String, f64, bool)>,
}

/// One equation: Σ coefficient × term + extras = input.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Equation {
    /// Name (that of the state it governs).
    pub name: String,
    /// The input on the right; none: zero, and the leading coefficient is one.
    pub input: Option<String>,
}

/// Everything a search may choose from.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Structure {
    /// Title of the model.
    pub title: String,
    /// Inputs with their hold.
    pub inputs: Vec<(Signal, Hold)>,
    /// Measured states.
    pub states: Vec<Signal>,
    /// One equation per state.
    pub equations: Vec<Equation>,
    /// All candidates.
    pub terms: Vec<Term>,
    /// Parts outside the choice.
    pub extras: Vec<Extra>,
}

impl Structure {
    /// The model with the terms in `active` and their `values` (one per candidate).
    ///
    /// # Errors
    /// What the model language refuses: a channel's name that is no name there, units that do not fit.
    pub(crate) fn model(&self, active: &[bool], values: &[f64], extras: &[f64]) -> Result<Model, ModelError> {
        Model::from_toml(&self.toml(active, values, extras), "model.toml")
    }

    /// The text of [`model`](Self::model).
    pub(crate) fn toml(&self, active: &[bool], values: &[f64], extras: &[f64]) -> String {
        use std::fmt::Write;
        let mut text = String::new();
        let quote = |s: &str| toml_string(s);
        let _ = writeln!(text, "name = {}\n", quote(&self.title));
        let table = |text: &mut String, signal: &Signal, more: &str| {
            let unit = signal.unit.as_ref().map(|u| format!("unit = {}", quote(u)));
            let inside: Vec<String> =
                unit.into_iter().chain((!more.is_empty()).then(|| more.to_string())).collect();
            let _ = writeln!(text, "{} = {{ {} }}", signal.name, inside.join(", "));
        };
        if !self.inputs.is_empty() {
            text.push_str("[inputs]\n");
            for (signal, hold) in &self.inputs {
                table(&mut text, signal, &format!("hold = \"{}\"", hold.name()));
            }
            text.push('\n');
        }
        text.push_str("[states]\n");
        for signal in &self.states {
            table(&mut text, signal, "");
        }
        text.push_str("\n[parameters]\n");
        for (i, term) in self.terms.iter().enumerate().filter(|(i, _)| active[*i]) {
            if self.has_coefficient(i) {
                let _ = writeln!(text, "{} = {{ value = {:?} }}", term.parameter, values[i]);
            }
        }
        for ((name, _, known), value) in self.extras.iter().flat_map(|e| &e.parameters).zip(extras) {
            let _ = writeln!(text, "{name} = {{ value = {value:?}, fixed = {known} }}");
        }
        text.push_str("\n[equations]\n");
        for (e, equation) in self.equations.iter().enumerate() {
            let mut left: Vec<String> = self
                .terms
                .iter()
                .enumerate()
                .filter(|(i, t)| t.equation == e && active[*i])
                .map(|(i, t)| match (self.has_coefficient(i), t.expression.as_str()) {
                    (false, expression) => expression.to_string(),
                    (true, "1") => t.parameter.clone(),
                    (true, expression) => format!("{}*{expression}", t.parameter),
                })
                .collect();
            left.extend(self.extras.iter().map(|x| x.expression.clone()));
            let left = left.join(" + ").replace("+ -", "- ");
            let right = equation.input.as_deref().unwrap_or("0");
            let _ = writeln!(text, "{} = \"{left} = {right}\"", equation.name);
        }
        text
    }

    /// Whether a candidate has a coefficient to estimate: all but the leading term of an equation without
    /// input, which sets the scale.
    pub(crate) fn has_coefficient(&self, term: usize) -> bool {
        let t = &self.terms[term];
        t.optional || self.equations[t.equation].input.is_some()
    }
}

fn toml_string(text: &str) -> String {
    let mut out = String::with_capacity(text.len() + 2);
    out.push('"');
    for c in text.chars() {
        match c {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}
