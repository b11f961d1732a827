//! Libraries of candidate terms.

use crate::energy;
use crate::setting::{Setting, derivative};
use crate::structure::{Part, Term};

/// Which monomials of the variables (the states and their derivatives below the leading one) a library has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Monomials {
    /// All products of powers, each exponent up to the order N: xⁱ ẋʲ, i, j ≤ N (thesis Eq 2.2). For one state.
    #[default]
    Tensor,
    /// All products of powers of total degree up to N.
    TotalDegree,
    /// Powers of single variables up to N, no products (thesis Eq 2.24, 2.25).
    Separate,
}

/// What the equations may contain.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Library {
    /// The polynomial part.
    pub monomials: Monomials,
    /// A constant force.
    pub constant: bool,
    /// Coulomb friction: the sign of every velocity.
    pub friction: bool,
    /// sin q and cos q of every state that may be an angle: in rad, deg, another dimensionless unit, or none stated.
    pub trigonometric: bool,
    /// What rigid bodies on joints have: terms of the kinetic energy (inertia that couples coordinates and depends on
    /// angles) and of gravity's potential, each with one coefficient in all the equations that it enters. See
    /// the crate's page for the formulas.
    pub lagrangian: bool,
    /// Terms of the user in the model language.
    pub terms: Vec<String>,
}

/// One candidate before it has a name.
struct Candidate {
    expression: String,
    base: String,
    powers: Vec<(String, u32)>,
    order: usize,
    even: bool,
}

impl Library {
    /// Candidates of every equation, the leading derivative first, orders ascending.
    pub(crate) fn terms(&self, setting: &mut Setting<'_>) -> Vec<Term> {
        let mut candidates = self.candidates(setting);
        candidates.sort_by_key(|c| c.order);
        let several = setting.states.len() > 1;
        let mut out = Vec::new();
        for (equation, state) in setting.states.iter().enumerate() {
            let prefix = if several { format!("{state}_") } else { String::new() };
            let leading = derivative(state, setting.derivatives[equation]);
            let mut name = |base: &str| setting.name(format!("{prefix}{base}"));
            out.push(Term {
                parts: vec![Part::new(equation, &leading)],
                parameter: name("m"),
                powers: vec![(leading, 1)],
                order: 1,
                even: false,
                optional: false,
            });
            for c in &candidates {
                out.push(Term {
                    parts: vec![Part::new(equation, &c.expression)],
                    parameter: name(&c.base),
                    powers: c.powers.clone(),
                    order: c.order,
                    even: c.even,
                    optional: true,
                });
            }
        }
        if self.lagrangian {
            out.extend(energy::terms(setting));
        }
        out
    }

    fn candidates(&self, setting: &Setting<'_>) -> Vec<Candidate> {
        let several = setting.states.len() > 1;
        // Variables with the letter that names a power's coefficient: k for positions, c for rates.
        let variables: Vec<(String, &str, &String)> = setting
            .states
            .iter()
            .zip(setting.derivatives)
            .flat_map(|(s, order)| {
                (0..*order).map(move |d| (derivative(s, d), ["k", "c", "j", "s"][d.min(3)], s))
            })
            .collect();
        let mut out = Vec::new();
        if self.constant {
            out.push(Candidate {
                expression: "1".to_string(),
                base: "f0".to_string(),
                powers: Vec::new(),
                order: 1,
                even: true,
            });
        }
        let n = setting.orders as u32;
        let mut exponents = vec![0u32; variables.len()];
        // Count through all exponents up to n like an odometer.
        while let Some(i) = exponents.iter().position(|e| *e < n) {
            exponents[..i].fill(0);
            exponents[i] += 1;
            let total: u32 = exponents.iter().sum();
            let single = exponents.iter().filter(|e| **e > 0).count() == 1;
            let largest = exponents.iter().copied().max().unwrap_or(0);
            let order = match self.monomials {
                Monomials::Tensor => largest,
                Monomials::TotalDegree => total,
                Monomials::Separate if single => total,
                Monomials::Separate => continue,
            };
            if order > n {
                continue;
            }
            let mut factors = Vec::new();
            let mut base = String::new();
            let mut powers = Vec::new();
            for ((name, letter, state), e) in variables.iter().zip(&exponents).filter(|(_, e)| **e > 0) {
                factors.push(if *e == 1 { name.clone() } else { format!("{name}^{e}") });
                base.push_str(letter);
                base.push_str(&e.to_string());
                if several {
                    base.push('_');
                    base.push_str(state);
                }
                powers.push((name.clone(), *e));
            }
            out.push(Candidate {
                expression: factors.join("*"),
                base,
                powers,
                order: order as usize,
                even: total.is_multiple_of(2),
            });
        }
        let own =
            |base: &str, state: &String| if several { format!("{base}_{state}") } else { base.to_string() };
        for ((s, angle), order) in setting.states.iter().zip(&setting.angles).zip(setting.derivatives) {
            if self.friction && *order > 1 {
                out.push(Candidate {
                    expression: format!("sign({s}')"),
                    base: own("fc", s),
                    powers: Vec::new(),
                    order: 1,
                    even: false,
                });
            }
            if self.trigonometric && *angle {
                for (function, even) in [("sin", false), ("cos", true)] {
                    out.push(Candidate {
                        expression: format!("{function}({s})"),
                        base: own(&format!("a_{function}"), s),
                        powers: Vec::new(),
                        order: 1,
                        even,
                    });
                }
            }
        }
        for input in setting.inputs {
            out.push(Candidate {
                expression: input.clone(),
                base: format!("b_{input}"),
                powers: vec![(input.clone(), 1)],
                order: 1,
                even: false,
            });
        }
        for (i, term) in self.terms.iter().enumerate() {
            // A name alone needs no parentheses.
            let alone = term.chars().all(|c| c.is_alphanumeric() || c == '_');
            out.push(Candidate {
                expression: if alone { term.clone() } else { format!("({term})") },
                base: format!("a{}", i + 1),
                powers: Vec::new(),
                order: 1,
                even: false,
            });
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::setting::is_of_the_language;

    fn expressions(library: &Library, states: &[&str], orders: usize) -> Vec<String> {
        let states: Vec<String> = states.iter().map(|s| (*s).to_string()).collect();
        let angles = vec![true; states.len()];
        let mut setting = Setting {
            states: &states,
            derivatives: &vec![2; angles.len()],
            inputs: &[],
            orders,
            angles,
            taken: vec!["k1".to_string()],
        };
        library.terms(&mut setting).into_iter().map(|t| t.parts[0].expression.clone()).collect()
    }

    #[test]
    fn the_thesis_library_of_order_three_has_fifteen_terms_beside_the_mass() {
        let terms = expressions(&Library::default(), &["x"], 3);
        assert_eq!(terms.len(), 16);
        assert_eq!(terms[0], "x''");
        assert!(terms.contains(&"x^2*x'".to_string()) && terms.contains(&"x^3*x'^3".to_string()));
        assert!(!terms.contains(&"1".to_string()));
    }

    #[test]
    fn orders_are_nested() {
        for monomials in [Monomials::Tensor, Monomials::TotalDegree, Monomials::Separate] {
            let library = Library { monomials, constant: true, ..Library::default() };
            let small = expressions(&library, &["x"], 2);
            let large = expressions(&library, &["x"], 4);
            assert_eq!(large[..small.len()], small[..], "{monomials:?}");
        }
    }

    #[test]
    fn sizes_are_those_of_the_textbook() {
        let total = Library { monomials: Monomials::TotalDegree, constant: true, ..Library::default() };
        // C(2 + 3, 3) = 10 monomials of two variables up to degree three.
        assert_eq!(expressions(&total, &["x"], 3).len(), 1 + 10);
        let link = Library { monomials: Monomials::Separate, friction: true, ..Library::default() };
        assert_eq!(expressions(&link, &["theta", "alpha"], 3).len(), 2 * (1 + 4 * 3 + 2));
    }

    #[test]
    fn a_coefficient_never_takes_a_name_in_use() {
        let states = vec!["x".to_string()];
        let mut setting = Setting {
            states: &states,
            derivatives: &[2],
            inputs: &[],
            orders: 1,
            angles: vec![true],
            taken: vec!["k1".to_string()],
        };
        let names: Vec<String> =
            Library::default().terms(&mut setting).into_iter().map(|t| t.parameter).collect();
        assert_eq!(names, ["m", "k1_", "c1", "k1c1"]);
    }

    /// Every part of the library at once.
    fn whole(monomials: Monomials) -> Library {
        Library {
            monomials,
            constant: true,
            friction: true,
            trigonometric: true,
            lagrangian: true,
            terms: vec!["x'*abs(x')".to_string()],
        }
    }

    #[test]
    fn no_coefficient_is_called_as_a_function_is() {
        for monomials in [Monomials::Tensor, Monomials::TotalDegree, Monomials::Separate] {
            for states in [vec!["x".to_string()], vec!["x".to_string(), "a".to_string()]] {
                let angles = vec![true; states.len()];
                let mut setting = Setting {
                    states: &states,
                    derivatives: &vec![2; angles.len()],
                    inputs: &[],
                    orders: 3,
                    angles,
                    taken: states.clone(),
                };
                let names: Vec<String> =
                    whole(monomials).terms(&mut setting).into_iter().map(|t| t.parameter).collect();
                for (k, name) in names.iter().enumerate() {
                    assert!(!is_of_the_language(name), "{name}");
                    assert!(!names[..k].contains(name) && !states.contains(name), "{name} stands twice");
                }
                assert!(names.iter().any(|name| name.ends_with("a_sin") || name.ends_with("a_sin_x")));
            }
        }
    }

    #[test]
    fn a_length_has_no_sine() {
        let states = vec!["x".to_string(), "theta".to_string()];
        let angles = vec![false, true];
        let mut setting = Setting {
            states: &states,
            derivatives: &[2, 2],
            inputs: &[],
            orders: 1,
            angles,
            taken: Vec::new(),
        };
        let library = whole(Monomials::Separate);
        let terms: Vec<String> =
            library.terms(&mut setting).into_iter().map(|t| t.parts[0].expression.clone()).collect();
        assert!(terms.contains(&"sin(theta)".to_string()) && !terms.contains(&"sin(x)".to_string()));
    }
}
