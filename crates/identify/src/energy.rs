//! Candidate terms from energies: what rigid bodies on joints add to the equations of Lagrange.
//!
//! d/dt ∂T/∂q̇ₑ − ∂T/∂qₑ + ∂V/∂qₑ = Qₑ is linear in the coefficients of the energies
//!
//! ```text
//! T = Σ p · F(a) q̇ⱼ q̇ₖ (½ F(a) q̇ⱼ² for j = k),   V = −Σ v · cos a or Σ v · sin a,   F = 1, sin or cos,
//! ```
//!
//! with a an angle, or the sum or difference of several (the orientation of a link). One coefficient stands in every
//! equation that its energy enters: that ties the equations together, so that no combination of them passes for
//! another one, and leaves the few base parameters of robot identification (Khalil & Dombre, *Modeling,
//! Identification and Control of Robots*, 2002, chapter 12) to choose from.
//!
//! The weak form integrates d/dt (F q̇ₖ) by parts: no acceleration is looked up in a smoothed signal.

use std::collections::BTreeMap;

use crate::setting::Setting;
use crate::structure::{Integral, Part, Term};

/// Most angles whose sums and differences of all of them are orientations; of more, those of two.
const ALL: usize = 3;

/// s₁ q₁ + s₂ q₂ + …, every s one of −1, 0, 1.
struct Orientation {
    /// Sign of each state.
    signs: Vec<i32>,
    /// In the model language.
    text: String,
    /// As part of a name.
    label: String,
}

fn orientations(setting: &Setting<'_>) -> Vec<Orientation> {
    let angles: Vec<usize> = (0..setting.states.len()).filter(|i| setting.angles[*i]).collect();
    let most = if angles.len() <= ALL { angles.len() } else { 2 };
    let mut out = Vec::new();
    for code in 1..3usize.pow(angles.len() as u32) {
        let mut signs = vec![0; setting.states.len()];
        let mut rest = code;
        for &angle in &angles {
            signs[angle] = [0, 1, -1][rest % 3];
            rest /= 3;
        }
        let first = signs.iter().find(|s| **s != 0);
        if first != Some(&1) || signs.iter().filter(|s| **s != 0).count() > most {
            continue;
        }
        let (mut text, mut label) = (String::new(), String::new());
        for (sign, state) in signs.iter().zip(setting.states).filter(|(s, _)| **s != 0) {
            if !text.is_empty() {
                text.push_str(if *sign > 0 { " + " } else { " - " });
                label.push_str(if *sign > 0 { "_plus_" } else { "_minus_" });
            }
            text.push_str(state);
            label.push_str(state);
        }
        out.push(Orientation { signs, text, label });
    }
    out.sort_by_key(|o| o.signs.iter().filter(|s| **s != 0).count());
    out
}

/// F of an orientation.
#[derive(Clone, Copy, PartialEq)]
enum Shape {
    Cosine,
    Sine,
}

impl Shape {
    fn name(self) -> &'static str {
        match self {
            Shape::Cosine => "cos",
            Shape::Sine => "sin",
        }
    }

    /// dF/da: its sign and its shape.
    fn derivative(self) -> (f64, Shape) {
        match self {
            Shape::Cosine => (-1.0, Shape::Sine),
            Shape::Sine => (1.0, Shape::Cosine),
        }
    }

    fn of(self, orientation: &Orientation) -> String {
        format!("{}({})", self.name(), orientation.text)
    }
}

/// `factor * text`, with its sign in front.
fn scaled(factor: f64, text: &str) -> String {
    let sign = if factor < 0.0 { "-" } else { "" };
    if factor.abs() == 1.0 { format!("{sign}{text}") } else { format!("{sign}{}*{text}", factor.abs()) }
}

/// A sum; in parentheses where it has several terms or a sign.
fn sum(terms: &[String]) -> String {
    match terms {
        [one] if !one.starts_with('-') => one.clone(),
        several => format!("({})", several.join(" + ").replace("+ -", "- ")),
    }
}

/// The candidate terms of the energies. Their names are taken.
pub(crate) fn terms(setting: &mut Setting<'_>) -> Vec<Term> {
    // What is known only to second order has a kinetic energy.
    let moving: Vec<usize> = (0..setting.states.len()).filter(|i| setting.derivatives[*i] == 2).collect();
    let orientations = orientations(setting);
    let states = setting.states;
    let mut out: Vec<(String, bool, Vec<Part>)> = Vec::new();
    for (n, &j) in moving.iter().enumerate() {
        for &k in &moving[n..] {
            if j != k {
                let part =
                    |equation: usize, other: usize| Part::new(equation, &format!("{}''", states[other]));
                out.push((format!("m_{}_{}", states[j], states[k]), false, vec![part(j, k), part(k, j)]));
            }
            for orientation in &orientations {
                for shape in [Shape::Cosine, Shape::Sine] {
                    let name =
                        format!("m_{}_{}_{}_{}", shape.name(), orientation.label, states[j], states[k]);
                    let parts = kinetic(states, &moving, orientation, shape, j, k);
                    out.push((name, shape == Shape::Sine, parts));
                }
            }
        }
    }
    for orientation in &orientations {
        // V = −cos a: the force is s sin a; V = sin a: s cos a.
        for shape in [Shape::Sine, Shape::Cosine] {
            let force = shape.of(orientation);
            let parts = moving.iter().filter(|e| orientation.signs[**e] != 0).map(|&e| {
                let expression = sum(&[scaled(f64::from(orientation.signs[e]), &force)]);
                Part::new(e, &expression)
            });
            let name = format!("g_{}_{}", shape.name(), orientation.label);
            out.push((name, shape == Shape::Cosine, parts.collect()));
        }
    }
    out.into_iter()
        .filter(|(_, _, parts)| !parts.is_empty())
        .map(|(name, even, parts)| Term {
            parts,
            parameter: setting.name(name),
            powers: Vec::new(),
            order: 1,
            even,
            optional: true,
        })
        .collect()
}

/// What T = F(a) q̇ⱼ q̇ₖ (½ F(a) q̇ⱼ²) adds to each equation.
fn kinetic(
    states: &[String],
    moving: &[usize],
    orientation: &Orientation,
    shape: Shape,
    j: usize,
    k: usize,
) -> Vec<Part> {
    let own = if j == k { 0.5 } else { 1.0 };
    let (sign, slope) = shape.derivative();
    let (value, slope) = (shape.of(orientation), slope.of(orientation));
    let s = |i: usize| f64::from(orientation.signs[i]);
    let pair = |a: usize, b: usize| (a.min(b), a.max(b));
    let product = |(a, b): (usize, usize)| {
        if a == b { format!("{}'^2", states[a]) } else { format!("{}'*{}'", states[a], states[b]) }
    };
    moving
        .iter()
        .filter_map(|&e| {
            // ∂T/∂q̇ₑ = F q̇ of these.
            let momenta: Vec<usize> = match (e == j, e == k) {
                (true, _) => vec![k],
                (false, true) => vec![j],
                (false, false) => Vec::new(),
            };
            // Coefficients of F′ q̇ q̇.
            let mut squares: BTreeMap<(usize, usize), f64> = BTreeMap::new();
            let (mut strong, mut integrals) = (Vec::new(), Vec::new());
            for &m in &momenta {
                strong.push(format!("{value}*{}''", states[m]));
                integrals.push(Integral { signal: format!("{value}*{}'", states[m]), order: 1 });
                for i in 0..states.len() {
                    *squares.entry(pair(i, m)).or_default() += sign * s(i);
                }
            }
            *squares.entry(pair(j, k)).or_default() -= sign * own * s(e);
            for (of, factor) in squares.into_iter().filter(|(_, factor)| *factor != 0.0) {
                strong.push(scaled(factor, &format!("{slope}*{}", product(of))));
            }
            if s(e) != 0.0 {
                let force = scaled(-sign * own * s(e), &format!("{slope}*{}", product(pair(j, k))));
                integrals.push(Integral { signal: force, order: 0 });
            }
            (!strong.is_empty()).then(|| Part { equation: e, expression: sum(&strong), integrals })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(states: &[&str], angles: &[bool]) -> Vec<Term> {
        let states: Vec<String> = states.iter().map(|s| (*s).to_string()).collect();
        let derivatives = vec![2; states.len()];
        terms(&mut Setting {
            states: &states,
            derivatives: &derivatives,
            inputs: &[],
            orders: 1,
            angles: angles.to_vec(),
            taken: Vec::new(),
        })
    }

    fn parts<'a>(terms: &'a [Term], parameter: &str) -> Vec<(usize, &'a str)> {
        let term = terms.iter().find(|t| t.parameter == parameter).unwrap();
        term.parts.iter().map(|p| (p.equation, p.expression.as_str())).collect()
    }

    #[test]
    fn a_pendulum_on_a_cart_has_the_equations_of_the_textbook() {
        let terms = of(&["x", "theta"], &[false, true]);
        // T = p cos θ ẋ θ̇: p (cos θ θ̈ − sin θ θ̇²) on the cart, p cos θ ẍ on the pendulum.
        assert_eq!(
            parts(&terms, "m_cos_theta_x_theta"),
            [(0, "(cos(theta)*theta'' - sin(theta)*theta'^2)"), (1, "cos(theta)*x''")]
        );
        assert_eq!(parts(&terms, "g_sin_theta"), [(1, "sin(theta)")]);
        assert_eq!(parts(&terms, "m_x_theta"), [(0, "theta''"), (1, "x''")]);
        // Three pairs of rates by cosine and sine, one pair of constant coupling, gravity's two.
        assert_eq!(terms.len(), 3 * 2 + 1 + 2);
    }

    #[test]
    fn two_links_have_the_coriolis_and_centrifugal_terms_of_the_textbook() {
        // T = h cos q₂ (q̇₁² + q̇₁ q̇₂): twice the term of ½ q̇₁² and that of q̇₁ q̇₂.
        let terms = of(&["q1", "q2"], &[true, true]);
        assert_eq!(
            parts(&terms, "m_cos_q2_q1_q1"),
            [(0, "(cos(q2)*q1'' - sin(q2)*q1'*q2')"), (1, "0.5*sin(q2)*q1'^2")]
        );
        assert_eq!(
            parts(&terms, "m_cos_q2_q1_q2"),
            [(0, "(cos(q2)*q2'' - sin(q2)*q2'^2)"), (1, "cos(q2)*q1''")]
        );
        assert_eq!(parts(&terms, "g_cos_q1_plus_q2"), [(0, "cos(q1 + q2)"), (1, "cos(q1 + q2)")]);
        assert_eq!(parts(&terms, "g_sin_q1_minus_q2"), [(0, "sin(q1 - q2)"), (1, "(-sin(q1 - q2))")]);
    }

    /// d/dt ∂T/∂q̇ₑ − ∂T/∂qₑ by central differences along a motion.
    fn euler_lagrange(
        energy: &dyn Fn(&[f64; 2], &[f64; 2]) -> f64,
        motion: &dyn Fn(f64) -> ([f64; 2], [f64; 2]),
        t: f64,
        e: usize,
    ) -> f64 {
        let h = 1e-4;
        let momentum = |t: f64| {
            let (q, v) = motion(t);
            let shifted = |by: f64| {
                let mut v = v;
                v[e] += by;
                energy(&q, &v)
            };
            (shifted(h) - shifted(-h)) / (2.0 * h)
        };
        let (q, v) = motion(t);
        let moved = |by: f64| {
            let mut q = q;
            q[e] += by;
            energy(&q, &v)
        };
        (momentum(t + h) - momentum(t - h)) / (2.0 * h) - (moved(h) - moved(-h)) / (2.0 * h)
    }

    #[test]
    fn every_kinetic_term_is_what_the_equations_of_lagrange_make_of_its_energy() {
        use greybox_model::parse;
        let motion = |t: f64| {
            let q = [0.7 * (1.3 * t).sin() + 0.2, 0.9 * (0.8 * t + 0.4).cos()];
            let v = [0.7 * 1.3 * (1.3 * t).cos(), -0.9 * 0.8 * (0.8 * t + 0.4).sin()];
            (q, v)
        };
        let acceleration = |t: f64| [-0.7 * 1.69 * (1.3 * t).sin(), -0.9 * 0.64 * (0.8 * t + 0.4).cos()];
        let names = ["a", "b"];
        let mut tested = 0;
        for term in of(&names, &[true, true]).iter().filter(|t| t.parameter.starts_with("m_")) {
            // The energy from the name: m_cos_a_plus_b_a_b.
            let words: Vec<&str> = term.parameter.split('_').collect();
            let [.., j, k] = words.as_slice() else { panic!("{words:?}") };
            let at = |name: &str| usize::from(name == "b");
            let (j, k) = (at(j), at(k));
            let shape = words[1];
            let signs = match words.get(2..words.len() - 2).unwrap_or_default() {
                ["a"] => [1.0, 0.0],
                ["b"] => [0.0, 1.0],
                [_, "plus", _] => [1.0, 1.0],
                [_, "minus", _] => [1.0, -1.0],
                _ => [0.0, 0.0],
            };
            let energy = |q: &[f64; 2], v: &[f64; 2]| {
                let angle = signs[0] * q[0] + signs[1] * q[1];
                let factor = match shape {
                    "cos" => angle.cos(),
                    "sin" => angle.sin(),
                    _ => 1.0,
                };
                factor * v[j] * v[k] * if j == k { 0.5 } else { 1.0 }
            };
            for e in 0..2 {
                let t = 0.37;
                let expected = euler_lagrange(&energy, &motion, t, e);
                let found = term.part(e).map_or(0.0, |part| {
                    let (q, v) = motion(t);
                    let read = |name: &str, primes: u8| {
                        let i = usize::from(name == "b");
                        Some([q[i], v[i], acceleration(t)[i]][usize::from(primes)])
                    };
                    value(&parse(&part.expression).unwrap().expr, &read)
                });
                assert!((found - expected).abs() < 1e-5, "{} in {e}: {found}, {expected}", term.parameter);
                tested += 1;
            }
        }
        assert_eq!(tested, 2 * (3 * 8 + 1));
    }

    fn value(expr: &greybox_model::Expr, read: &dyn Fn(&str, u8) -> Option<f64>) -> f64 {
        use greybox_model::tape::{Column, LeafKind, Tape};
        let variables: Vec<(String, u8)> =
            expr.variables().into_iter().map(|(name, primes)| (name.to_string(), primes)).collect();
        let resolve = |name: &str, primes: u8| variables.iter().position(|v| v.0 == name && v.1 == primes);
        let tape =
            Tape::compile(std::slice::from_ref(expr), vec![LeafKind::Input; variables.len()], &resolve)
                .unwrap();
        let values: Vec<[f64; 1]> = variables.iter().map(|v| [read(&v.0, v.1).unwrap()]).collect();
        tape.eval_batch(1, &|i: usize| Column::Series(&values[i]))[0][0]
    }
}
