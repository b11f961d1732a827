//! What must hold of a mechanism file beyond its grammar.

use greybox_model::{Expr, parse};

use super::file::Fault;
use super::{Excitation, First, Mechanism, Memory, Scale};

impl Mechanism {
    /// Names are names, each given once, and the law uses no other.
    pub(super) fn check_names(&self) -> Result<(), Fault> {
        let placeholders = self.on.placeholders();
        if self.kind.is_empty() || !self.kind.chars().all(|c| c.is_alphanumeric() || c == '_') {
            return Err(Fault::new("", "kind", "`kind` must be a name of letters, digits and `_`"));
        }
        let mut seen: Vec<&str> = Vec::new();
        let parameters = self.linear.iter().map(|n| ("", "linear", n.as_str()));
        let parameters = parameters
            .chain(self.inner.iter().map(|i| ("inner", i.name.as_str(), i.name.as_str())))
            .chain(self.first.iter().map(|f| ("first", f.0.as_str(), f.0.as_str())));
        let states = self.states.iter().map(|s| ("states", s.name.as_str(), s.name.as_str()));
        for (section, key, name) in parameters.chain(states) {
            let section = if section == "states" { format!("states.{name}") } else { section.to_string() };
            let fault = |message: String| Err(Fault::new(&section, key, message));
            if !parse(name).is_ok_and(|p| p.expr == Expr::var(name)) {
                return fault(format!(
                    "`{name}` is no name that an equation can use; take letters, digits and `_`"
                ));
            }
            if placeholders.contains(&name) {
                return fault(format!("`{name}` already means something in a law; give it another name"));
            }
            if seen.contains(&name) {
                return fault(format!(
                    "`{name}` is listed twice among `linear`, `[inner]`, `[first]` and `[states]`"
                ));
            }
            seen.push(name);
        }
        let known = |n: &str| placeholders.contains(&n) || seen.contains(&n);
        let law = if self.on.replaces() { "replace" } else { "force" };
        let laws =
            std::iter::once(("", law, &self.law)).chain(self.reaction.iter().map(|e| ("", "reaction", e)));
        for (section, key, e) in laws {
            if let Some(name) = stranger(e, known) {
                return Err(Fault::new(section, key, self.unknown("the law", &name)));
            }
        }
        for state in &self.states {
            for e in [&state.lhs, &state.rhs] {
                if let Some(name) = stranger(e, known) {
                    let section = format!("states.{}", state.name);
                    return Err(Fault::new(&section, "equation", self.unknown("the equation", &name)));
                }
            }
        }
        Ok(())
    }

    fn unknown(&self, what: &str, name: &str) -> String {
        format!(
            "{what} uses `{name}`, which is neither a parameter (list it under `linear`, `[inner]` or `[first]`), nor a state, nor one of {}",
            self.on.placeholders().join(", ")
        )
    }

    /// What is said about parameters is about this mechanism's.
    pub(super) fn check_parameters(&self) -> Result<(), Fault> {
        for name in &self.positive {
            if !self.names().any(|n| n == name) {
                return Err(Fault::new(
                    "",
                    "positive",
                    format!("`positive` names `{name}`, which is no parameter of this mechanism"),
                ));
            }
        }
        for (name, first) in &self.first {
            let sources = match first {
                First::Value(e) => vec![e],
                First::Angle(y, x) => vec![y, x],
            };
            let source = |n: &str| {
                self.linear.iter().any(|l| l == n) || self.inner.iter().any(|i| i.name == n) || n == "pi"
            };
            for e in sources {
                if let Some(n) = stranger(e, source) {
                    return Err(Fault::new(
                        "first",
                        name,
                        format!("[first] {name}: `{n}` is neither under `linear` nor under `[inner]`"),
                    ));
                }
            }
            if !self.uses(name) {
                return Err(Fault::new(
                    "first",
                    name,
                    format!("[first] {name}: the law does not use `{name}`; remove it"),
                ));
            }
        }
        if self.first.is_empty()
            && let Some(name) = self.names().find(|n| !self.uses(n))
        {
            let (section, key) = if self.inner(name).is_some() { ("inner", name) } else { ("", "linear") };
            return Err(Fault::new(
                section,
                key,
                format!(
                    "the law does not use `{name}`; remove it, or reach the law's parameters through it in `[first]`"
                ),
            ));
        }
        let own = |n: &str| n == "pi" || self.own.iter().any(|p| p == n);
        let figures = self.report.iter().map(|(name, e)| ("report", name.as_str(), e));
        let require = self.require.iter().map(|e| ("", "require", e));
        let others = self.of_others().map(|(section, kind, _, e)| (section, kind, e));
        for (section, key, e) in figures.chain(require).chain(others) {
            if let Some(n) = stranger(e, own) {
                let place =
                    if section.is_empty() { format!("`{key}`") } else { format!("[{section}] {key}") };
                return Err(Fault::new(section, key, format!("{place}: `{n}` is no parameter of the law")));
            }
        }
        match self.about.parameters.keys().find(|n| !self.own.contains(n)) {
            Some(n) => Err(Fault::new(
                "about",
                "parameters",
                format!("[about] parameters: `{n}` is no parameter of the law"),
            )),
            None => Ok(()),
        }
    }

    /// What is read off the data speaks of the placeholders only; where the law acts, of parameters too.
    pub(super) fn check_data(&self) -> Result<(), Fault> {
        let placeholders = self.on.placeholders();
        let placeholder = |n: &str| placeholders.contains(&n);
        for state in &self.states {
            let section = format!("states.{}", state.name);
            let unit = std::iter::once(("unit", &state.unit));
            for (key, e) in unit.chain(state.start.iter().map(|e| ("start", e))) {
                if let Some(n) = stranger(e, placeholder) {
                    return Err(Fault::new(
                        &section,
                        key,
                        format!(
                            "[{section}] `{key}`: `{n}` is none of {}; write an expression of them that has the state's {}",
                            placeholders.join(", "),
                            if key == "unit" { "unit, such as `d'*t`" } else { "value" }
                        ),
                    ));
                }
            }
            let order = state_order(state);
            let equation = state.lhs.clone() - state.rhs.clone();
            if order == 0 {
                return Err(Fault::new(
                    &section,
                    "equation",
                    format!(
                        "[{section}]: its equation holds no derivative of `{}`, such as `{}'`",
                        state.name, state.name
                    ),
                ));
            }
            if equation.affine_in(&[(&state.name, order)]).is_none() {
                return Err(Fault::new(
                    &section,
                    "equation",
                    format!(
                        "[{section}]: its equation must be linear in its highest derivative, `{}{}`",
                        state.name,
                        "'".repeat(order.into())
                    ),
                ));
            }
        }
        for inner in &self.inner {
            let scale = match &inner.scale {
                Scale::Rms(e)
                | Scale::Max(e)
                | Scale::Top(e)
                | Scale::Range(e)
                | Scale::PerRange(e)
                | Scale::Frequency(e) => Some(e),
                Scale::One | Scale::Step | Scale::Duration | Scale::PerDuration => None,
            };
            for e in scale.into_iter().chain(&inner.spectral).chain(&inner.carrier) {
                if let Some(n) = stranger(e, placeholder) {
                    return Err(Fault::new(
                        "inner",
                        &inner.name,
                        format!(
                            "[inner] {}: `{n}` is no channel of this law; a scale is read off {}",
                            inner.name,
                            placeholders.join(", ")
                        ),
                    ));
                }
            }
        }
        let Some(region) = &self.region else { return Ok(()) };
        let state = |n: &str| self.states.iter().any(|s| s.name == n);
        let own = |n: &str| n == "pi" || n == "rms_rate" || self.own.iter().any(|p| p == n);
        if let Some(n) = stranger(&region.variable, |n| placeholder(n) || state(n)) {
            return Err(Fault::new(
                "location",
                "variable",
                format!("[location] variable: `{n}` is none of {}", placeholders.join(", ")),
            ));
        }
        for (key, e) in [("low", &region.low), ("high", &region.high)] {
            if let Some(n) = e.as_ref().and_then(|e| stranger(e, own)) {
                return Err(Fault::new(
                    "location",
                    key,
                    format!(
                        "[location] {key}: `{n}` is no parameter of the law (they are {}), and not `rms_rate`",
                        self.own.join(", ")
                    ),
                ));
            }
        }
        Ok(())
    }

    /// Where an experiment drives the machine follows from what the report says of the mechanism.
    pub(super) fn check_excitation(&self) -> Result<(), Fault> {
        let Some(Excitation::Around(at) | Excitation::Ramp(at) | Excitation::Beyond(at)) = &self.excitation
        else {
            return Ok(());
        };
        let figures = || self.report.iter().map(|(name, _)| name);
        let known = |n: &str| n == "pi" || self.own.iter().chain(figures()).any(|own| own == n);
        match stranger(at, known) {
            Some(n) => Err(Fault::new(
                "experiment",
                "at",
                format!(
                    "[experiment] at: `{n}` is no parameter of the law (they are {}), and no figure of [report]",
                    self.own.join(", ")
                ),
            )),
            None => Ok(()),
        }
    }

    /// The law is linear in the `linear` parameters, through `[first]` if need be, and the states do not
    /// depend on them.
    pub(super) fn check_linear(&self) -> Result<(), Fault> {
        let fault = |message: String| Err(Fault::new("", "linear", message));
        if self.first.is_empty() {
            for name in &self.linear {
                if self.law.derivative(name, 0).mentions(name) {
                    return fault(format!(
                        "`{name}` is listed as linear, but the law is not linear in it; list it under [inner]"
                    ));
                }
                if self.states.iter().any(|s| s.lhs.mentions(name) || s.rhs.mentions(name)) {
                    return fault(format!(
                        "`{name}` is listed as linear, but a state's equation depends on it; reach it through `[first]`"
                    ));
                }
            }
            return Ok(());
        }
        // Through `[first]` there is no telling symbolically (the angle of two parameters): by numbers.
        let inner: Vec<f64> = (0..self.inner.len()).map(|i| 0.7 + 0.31 * i as f64).collect();
        let at = |w: f64| -> Vec<f64> {
            // From one end of a line to the other, which misses the origin.
            (0..self.linear.len())
                .map(|i| (1.0 - w) * (1.3 + 0.4 * i as f64) + w * (2.9 - 0.7 * i as f64))
                .collect()
        };
        let value = |e: &Expr, w: f64| {
            let own = self.values(&at(w), &inner)?;
            e.eval(&|n, primes| match self.own.iter().position(|p| p == n) {
                Some(i) => own.get(i).copied(),
                // Any number will do for a signal, a different one for each.
                None => {
                    Some(0.3 + 0.1 * f64::from(primes) + 0.07 * f64::from(n.bytes().next().unwrap_or(0) % 16))
                }
            })
        };
        let close = |a: f64, b: f64| (a - b).abs() <= 1e-9 * (a.abs() + b.abs());
        for e in std::iter::once(&self.law).chain(&self.reaction) {
            if let (Some(a), Some(b), Some(c)) = (value(e, 0.0), value(e, 0.5), value(e, 1.0))
                && !close(0.5 * (a + c), b)
            {
                return fault(format!(
                    "through `[first]` the law is not linear in {}",
                    self.linear.join(", ")
                ));
            }
        }
        for state in &self.states {
            let equation = state.lhs.clone() - state.rhs.clone();
            let Some((row, rest)) = equation.affine_in(&[(&state.name, state_order(state))]) else {
                continue;
            };
            let highest = |w: f64| Some(value(&rest, w)? / value(row.first()?, w)?);
            if let (Some(a), Some(b)) = (highest(0.0), highest(1.0))
                && !close(a, b)
            {
                return fault(format!(
                    "the equation of the state `{}` depends on {}, through `[first]` too; write it so that first values under [inner] determine it",
                    state.name,
                    self.linear.join(", ")
                ));
            }
        }
        Ok(())
    }

    /// What this mechanism says of others is about kinds that there are.
    pub(super) fn check_relations<'a, I>(&self, all: impl Fn() -> I) -> Result<(), Fault>
    where
        I: Iterator<Item = &'a Mechanism>,
    {
        for (key, kinds) in [("refines", &self.refines), ("doubts", &self.doubts)] {
            for kind in kinds {
                if !all().any(|m| m.kind == *kind) {
                    let message = format!("`{key}` names `{kind}`, a kind that the library does not have");
                    return Err(Fault::new("", key, message));
                }
            }
        }
        for (section, kind, parameter, _) in self.of_others() {
            let fault = |message: String| Err(Fault::new(section, kind, format!("[{section}] {message}")));
            if !all().any(|m| m.kind == *kind) {
                return fault(format!("names `{kind}`, a kind that the library does not have"));
            }
            if !all().any(|m| m.kind == *kind && m.own.iter().any(|n| n == parameter)) {
                return fault(format!("{kind}: it has no parameter `{parameter}`"));
            }
        }
        for kind in self.wider() {
            if !all().any(|m| m.kind == kind && self.is_special_case_of(m)) {
                return Err(Fault::new(
                    "special_case",
                    kind,
                    format!(
                        "[special_case] {kind}: at these values its `force` or its states' equations are not those of `{}`; give each of its parameters a value, and name the states alike",
                        self.kind
                    ),
                ));
            }
        }
        Ok(())
    }
}

/// The first name of an expression that `known` does not know.
fn stranger(e: &Expr, known: impl Fn(&str) -> bool) -> Option<String> {
    e.variables().into_iter().find(|(n, _)| !known(n)).map(|(n, _)| n.to_string())
}

/// Highest derivative of a state in its own equation.
fn state_order(state: &Memory) -> u8 {
    let primes = [&state.lhs, &state.rhs].into_iter().flat_map(|e| e.variables());
    primes.filter(|(n, _)| **n == *state.name).map(|(_, p)| p).max().unwrap_or(0)
}
