//! What an equation may be made of: candidate terms, and the model a choice of them writes.

use greybox_model::{Expr, Func, Hold, Model, ModelError};

/// What the weak form integrates: ∫ w s⁽ᵈ⁾ dτ, derivative d of a signal s.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Integral {
    /// The signal in the model language: an input, or what the states and their derivatives below the leading one make.
    pub signal: String,
    /// Order of its derivative.
    pub order: usize,
}

/// What a term adds to one equation.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Part {
    /// Index of the equation.
    pub equation: usize,
    /// What is multiplied by the coefficient, in the model language.
    pub expression: String,
    /// Integrals whose sum is that of the expression.
    pub integrals: Vec<Integral>,
}

impl Part {
    /// A derivative of a state or an expression without leading derivatives.
    pub(crate) fn new(equation: usize, expression: &str) -> Part {
        let signal = expression.trim_end_matches('\'');
        let integral = if signal.chars().all(|c| c.is_alphanumeric() || c == '_') {
            Integral { signal: signal.to_string(), order: expression.len() - signal.len() }
        } else {
            Integral { signal: expression.to_string(), order: 0 }
        };
        Part { equation, expression: expression.to_string(), integrals: vec![integral] }
    }
}

/// A candidate term: a coefficient and what it multiplies, in one equation or, where the term stems from an energy, in
/// several.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Term {
    /// What it adds to the equations.
    pub parts: Vec<Part>,
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

/// The dead time τ of an input: wherever an equation has the input u, it has u(t − τ).
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DeadTime {
    /// The input.
    pub input: String,
    /// Name of τ in the model.
    pub parameter: String,
    /// Longest τ looked for, s; infinite as long as it is open.
    pub longest: f64,
}

/// One equation: Σ coefficient × term + extras = input.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Equation {
    /// Name (that of the state it governs).
    pub name: String,
    /// The input on the right; none: zero.
    pub input: Option<String>,
    /// Whether the leading coefficient is one: where neither an input nor another equation sets the scale.
    pub normalised: bool,
}

impl Term {
    /// What the term adds to an equation.
    pub(crate) fn part(&self, equation: usize) -> Option<&Part> {
        self.parts.iter().find(|p| p.equation == equation)
    }

    /// Whether it is `expression` in one equation alone.
    pub(crate) fn is(&self, equation: usize, expression: &str) -> bool {
        self.parts.len() == 1 && self.part(equation).is_some_and(|p| p.expression == expression)
    }
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
    /// Inputs with a dead time.
    pub dead_times: Vec<DeadTime>,
}

impl Structure {
    /// The parameters outside the choice, and whether each is known: those of the extras, then the dead times.
    pub(crate) fn outside(&self) -> impl Iterator<Item = (&str, bool)> {
        let extras =
            self.extras.iter().flat_map(|e| &e.parameters).map(|(name, _, known)| (name.as_str(), *known));
        extras.chain(self.dead_times.iter().map(|d| (d.parameter.as_str(), false)))
    }

    /// Their first values.
    pub(crate) fn outside_values(&self) -> Vec<f64> {
        let extras = self.extras.iter().flat_map(|e| &e.parameters).map(|p| p.1);
        extras.chain(self.dead_times.iter().map(|_| 0.0)).collect()
    }

    /// Where the dead times stand among the parameters outside the choice.
    pub(crate) fn first_dead_time(&self) -> usize {
        self.extras.iter().map(|e| e.parameters.len()).sum()
    }

    /// What a recording begins with that no fit can use: the longest dead time, s, over which the past of an input is
    /// not in the recording.
    pub(crate) fn unknown_past(&self) -> f64 {
        self.dead_times.iter().map(|d| d.longest).fold(0.0, f64::max)
    }

    /// An expression with every input that has a dead time as late as that.
    pub(crate) fn late(&self, expression: &str) -> String {
        let delayed = |d: &DeadTime| format!("delay({}, {})", d.input, d.parameter);
        if let Some(dead_time) = self.dead_times.iter().find(|d| d.input == expression) {
            return delayed(dead_time);
        }
        let Ok(parsed) = greybox_model::parse(expression) else { return expression.to_string() };
        if !self.dead_times.iter().any(|d| parsed.expr.contains(&d.input, 0)) {
            return expression.to_string();
        }
        let variable = |name: &str| Expr::Var { name: name.into(), primes: 0 };
        let late = parsed.expr.substitute(&|name, primes| {
            let dead_time = self.dead_times.iter().find(|d| d.input == name && primes == 0)?;
            Some(Expr::Call(Func::Delay, vec![variable(name), variable(&dead_time.parameter)]))
        });
        format!("({late})")
    }

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
        let equations = self.equations_text(active);
        for (i, ((name, known), value)) in self.outside().zip(extras).enumerate() {
            // An input that enters no equation has no dead time.
            if i < self.first_dead_time() || equations.contains(&format!(", {name})")) {
                let _ = writeln!(text, "{name} = {{ value = {value:?}, fixed = {known} }}");
            }
        }
        text.push_str("\n[equations]\n");
        text.push_str(&equations);
        text
    }

    /// The equations with the terms in `active`, one a line.
    fn equations_text(&self, active: &[bool]) -> String {
        use std::fmt::Write;
        let mut text = String::new();
        for (e, equation) in self.equations.iter().enumerate() {
            let mut left: Vec<String> = self
                .terms
                .iter()
                .enumerate()
                .filter(|(i, _)| active[*i])
                .filter_map(|(i, t)| {
                    Some((self.has_coefficient(i), &t.parameter, self.late(&t.part(e)?.expression)))
                })
                .map(|(has_coefficient, parameter, expression)| {
                    match (has_coefficient, expression.as_str()) {
                        (false, expression) => expression.to_string(),
                        (true, "1") => parameter.clone(),
                        (true, expression) => format!("{parameter}*{expression}"),
                    }
                })
                .collect();
            left.extend(self.extras.iter().map(|x| x.expression.clone()));
            let left = left.join(" + ").replace("+ -", "- ");
            let right = equation.input.as_ref().map_or_else(|| "0".to_string(), |input| self.late(input));
            let _ = writeln!(text, "{} = \"{left} = {right}\"", equation.name);
        }
        text
    }

    /// Whether a candidate has a coefficient to estimate: all but the leading term that sets an equation's scale.
    pub(crate) fn has_coefficient(&self, term: usize) -> bool {
        let t = &self.terms[term];
        t.optional || !t.parts.iter().any(|p| self.equations[p.equation].normalised)
    }

    /// The same with one scale for all equations, as terms in several of them ask for: that of one input on one of the
    /// equations; that of every input, on different equations; without any input, that of the first leading
    /// coefficient.
    pub(crate) fn scaled_together(&self) -> Vec<Structure> {
        let n = self.equations.len();
        let names: Vec<&String> = self.inputs.iter().map(|(signal, _)| &signal.name).collect();
        let mut choices: Vec<Vec<(usize, &String)>> =
            names.iter().flat_map(|name| (0..n).map(move |e| vec![(e, *name)])).collect();
        if (2..=n).contains(&names.len()) {
            let mut all = arrangements(n, names.len());
            // The first is the order of the states.
            all.truncate(if all.len() > MOST_ARRANGEMENTS { 1 } else { MOST_ARRANGEMENTS });
            choices.extend(all.into_iter().map(|a| a.into_iter().zip(names.iter().copied()).collect()));
        }
        if choices.is_empty() {
            choices.push(Vec::new());
        }
        choices
            .into_iter()
            .map(|choice| {
                let mut structure = self.clone();
                for (e, equation) in structure.equations.iter_mut().enumerate() {
                    equation.input = choice.iter().find(|(at, _)| *at == e).map(|(_, name)| (*name).clone());
                    equation.normalised = choice.is_empty() && e == 0;
                }
                structure.terms.retain(|term| !choice.iter().any(|(e, name)| term.is(*e, name)));
                structure
            })
            .collect()
    }

    /// Equations that share coefficients: each group is one regression.
    pub(crate) fn groups(&self) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = (0..self.equations.len()).map(|e| vec![e]).collect();
        for term in &self.terms {
            let (with, mut without): (Vec<Vec<usize>>, _) =
                groups.into_iter().partition(|g| term.parts.iter().any(|p| g.contains(&p.equation)));
            without.push(with.concat());
            groups = without;
        }
        groups.iter_mut().for_each(|g| g.sort_unstable());
        groups.sort_unstable();
        groups
    }
}

/// Most arrangements of inputs on equations that are tried, those of four on four; of more inputs and equations only the one
/// in the order of the states.
const MOST_ARRANGEMENTS: usize = 24;

/// All ordered choices of `count` among `0..n`.
fn arrangements(n: usize, count: usize) -> Vec<Vec<usize>> {
    let mut out: Vec<Vec<usize>> = vec![Vec::new()];
    for _ in 0..count {
        out = out
            .iter()
            .flat_map(|a| (0..n).filter(|e| !a.contains(e)).map(|e| a.iter().copied().chain([e]).collect()))
            .collect();
    }
    out
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

#[cfg(test)]
mod tests {
    use super::*;

    fn term(parts: &[(usize, &str)], optional: bool) -> Term {
        let parts = parts.iter().map(|(equation, expression)| Part::new(*equation, expression)).collect();
        let parameter = "p".to_string();
        Term { parts, parameter, powers: Vec::new(), order: 1, even: false, optional }
    }

    fn signal(name: &str) -> Signal {
        Signal { name: name.to_string(), unit: None }
    }

    /// Three states; the first two share a term. Two inputs, each a term of every equation.
    fn structure() -> Structure {
        let mut terms: Vec<Term> =
            ["x''", "y''", "z''"].iter().enumerate().map(|(e, q)| term(&[(e, q)], false)).collect();
        terms.push(term(&[(0, "cos(y)*y''"), (1, "cos(y)*x''")], true));
        terms.extend((0..3).flat_map(|e| [term(&[(e, "u")], true), term(&[(e, "w")], true)]));
        Structure {
            title: "t".to_string(),
            inputs: ["u", "w"].map(|name| (signal(name), Hold::Linear)).to_vec(),
            states: ["x", "y", "z"].map(signal).to_vec(),
            equations: ["x", "y", "z"]
                .map(|name| Equation { name: name.to_string(), input: None, normalised: true })
                .to_vec(),
            terms,
            extras: Vec::new(),
            dead_times: Vec::new(),
        }
    }

    #[test]
    fn an_input_with_a_dead_time_is_late_wherever_it_stands() {
        let mut late = structure();
        late.equations[0] =
            Equation { input: Some("w".to_string()), normalised: false, ..late.equations[0].clone() };
        late.dead_times = ["u", "w"]
            .map(|input| DeadTime {
                input: input.to_string(),
                parameter: format!("tau_{input}"),
                longest: 0.5,
            })
            .to_vec();
        assert_eq!(late.late("u"), "delay(u, tau_u)");
        assert_eq!(late.late("x^2"), "x^2");
        assert_eq!(late.late("(x*u - w)"), "(x*delay(u, tau_u) - delay(w, tau_w))");
        // x″ of the first equation alone, without u, and u in the second.
        let mut active = vec![true, true, true, false, false, false, true, false, false, false];
        let values = vec![1.0; active.len()];
        let text = late.toml(&active, &values, &[0.1, 0.2]);
        assert!(text.contains("= delay(w, tau_w)\"") && text.contains("p*delay(u, tau_u) = 0"), "{text}");
        assert!(text.contains("tau_u = { value = 0.1") && text.contains("tau_w = { value = 0.2"), "{text}");
        // What enters no equation has no dead time.
        active[6] = false;
        assert!(!late.toml(&active, &values, &[0.1, 0.2]).contains("tau_u"));
        assert_eq!(late.unknown_past(), 0.5);
    }

    #[test]
    fn equations_that_share_a_coefficient_are_one_group() {
        assert_eq!(structure().groups(), [vec![0, 1], vec![2]]);
        let mut apart = structure();
        apart.terms.remove(3);
        assert_eq!(apart.groups(), [vec![0], vec![1], vec![2]]);
    }

    #[test]
    fn one_scale_is_that_of_every_input_on_every_equation_and_of_all_inputs_on_different_ones() {
        let tried: Vec<Vec<Option<String>>> = structure()
            .scaled_together()
            .iter()
            .map(|s| s.equations.iter().map(|e| e.input.clone()).collect())
            .collect();
        // Two inputs on three equations; then 3 · 2 ordered pairs.
        assert_eq!(tried.len(), 2 * 3 + 6);
        assert!((1..tried.len()).all(|k| !tried[..k].contains(&tried[k])));
        for scaled in structure().scaled_together() {
            for (e, equation) in scaled.equations.iter().enumerate() {
                assert!(!equation.normalised, "the leading coefficient is estimated");
                let on_the_right = |t: &Term| equation.input.as_deref().is_some_and(|u| t.is(e, u));
                assert!(!scaled.terms.iter().any(on_the_right), "what stands on the right is no candidate");
            }
        }
    }

    #[test]
    fn of_many_inputs_only_their_own_order_is_tried() {
        assert_eq!(arrangements(4, 4).len(), MOST_ARRANGEMENTS);
        let names: Vec<String> = (0..5).map(|k| format!("u{k}")).collect();
        let many = Structure {
            inputs: names.iter().map(|name| (signal(name), Hold::Linear)).collect(),
            equations: names
                .iter()
                .map(|name| Equation { name: name.clone(), input: None, normalised: true })
                .collect(),
            ..structure()
        };
        let tried = many.scaled_together();
        assert_eq!(tried.len(), 5 * 5 + 1);
        let last: Vec<&str> = tried[25].equations.iter().filter_map(|e| e.input.as_deref()).collect();
        assert_eq!(last, names);
    }

    #[test]
    fn without_inputs_the_first_leading_coefficient_sets_the_scale() {
        let alone = Structure { inputs: Vec::new(), ..structure() };
        let [only] = alone.scaled_together().try_into().unwrap();
        let normalised: Vec<bool> = only.equations.iter().map(|e| e.normalised).collect();
        assert_eq!(normalised, [true, false, false]);
    }
}
