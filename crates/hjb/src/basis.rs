//! Monomials: the activation functions φ of thesis Eqs 4.41, 4.49 and 4.53, of any degree over any number of states.

use crate::error::HjbError;

/// Most functions of a basis: a least-squares problem of that many unknowns still takes seconds.
pub const MOST_FUNCTIONS: usize = 4000;

/// A set of monomials x₁^e₁ ⋯ xₙ^eₙ of degree two and more, so that V(0) = 0 and ∇V(0) = 0.
///
/// Within a degree they are ordered as the thesis does: x₁², x₁x₂, …, x₁xₙ, x₂², ….
///
/// ```
/// use greybox_hjb::Monomials;
/// let basis = Monomials::even(2, 4)?;
/// assert_eq!(basis.names(), ["x1^2", "x1*x2", "x2^2", "x1^4", "x1^3*x2", "x1^2*x2^2", "x1*x2^3", "x2^4"]);
/// # Ok::<(), greybox_hjb::HjbError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Monomials {
    states: usize,
    /// `states` exponents per function.
    exponents: Vec<u8>,
}

impl Monomials {
    /// All monomials of degrees 2, 4, …, `degree`: for systems that are symmetric about the origin, f(−x) = −f(x).
    ///
    /// # Errors
    /// [`HjbError::Basis`] unless `degree` is even and at least two and the basis of a size that can be solved for.
    pub fn even(states: usize, degree: u8) -> Result<Monomials, HjbError> {
        if degree % 2 == 1 {
            return Err(HjbError::Basis { states, degree, reason: "an even basis needs an even degree" });
        }
        Monomials::of_degrees(states, degree, 2)
    }

    /// All monomials of degrees 2, 3, …, `degree`.
    ///
    /// # Errors
    /// [`HjbError::Basis`] unless `degree` is at least two and the basis of a size that can be solved for.
    pub fn full(states: usize, degree: u8) -> Result<Monomials, HjbError> {
        Monomials::of_degrees(states, degree, 1)
    }

    fn of_degrees(states: usize, degree: u8, step: usize) -> Result<Monomials, HjbError> {
        if states == 0 || degree < 2 {
            let reason = "a value function needs a state and a degree of at least two";
            return Err(HjbError::Basis { states, degree, reason });
        }
        // The number of monomials of degree d in n variables is C(n + d − 1, d).
        let count = |d: usize| (0..d).fold(1.0, |c, i| c * (states as f64 + i as f64) / (i as f64 + 1.0));
        if (2..=usize::from(degree)).step_by(step).map(count).sum::<f64>() > MOST_FUNCTIONS as f64 {
            let reason = "it would have more than 4000 functions: lower the degree";
            return Err(HjbError::Basis { states, degree, reason });
        }
        let mut exponents = Vec::new();
        let mut one = vec![0; states];
        for d in (2..=degree).step_by(step) {
            spread(&mut one, 0, d, &mut exponents);
        }
        Ok(Monomials { states, exponents })
    }

    /// Number of functions N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.exponents.len() / self.states
    }

    /// Never: a basis has at least one function.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.exponents.is_empty()
    }

    /// Number of states n.
    #[must_use]
    pub fn states(&self) -> usize {
        self.states
    }

    /// Exponents of the functions, n each.
    pub fn exponents(&self) -> impl Iterator<Item = &[u8]> {
        self.exponents.chunks(self.states)
    }

    /// The functions as text, states named x1, x2, ….
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        let name = |e: &[u8]| -> String {
            let factors: Vec<String> = (1..)
                .zip(e)
                .filter(|(_, e)| **e > 0)
                .map(|(i, e)| if *e == 1 { format!("x{i}") } else { format!("x{i}^{e}") })
                .collect();
            factors.join("*")
        };
        self.exponents().map(name).collect()
    }

    /// The index of the function with these exponents.
    #[must_use]
    pub fn position(&self, exponents: &[u8]) -> Option<usize> {
        self.exponents().position(|e| e == exponents)
    }

    /// Σ Wⱼ φⱼ(x) for N weights at a point of n states; not a number at a point of another size.
    #[must_use]
    pub fn value(&self, weights: &[f64], x: &[f64]) -> f64 {
        if x.len() != self.states {
            return f64::NAN;
        }
        let power = |e: &[u8]| e.iter().zip(x).map(|(e, x)| x.powi(i32::from(*e))).product::<f64>();
        self.exponents().zip(weights).map(|(e, w)| w * power(e)).sum()
    }

    /// Σ Wⱼ ∇φⱼ(x), n values; not numbers at a point of another size.
    #[must_use]
    pub fn gradient(&self, weights: &[f64], x: &[f64]) -> Vec<f64> {
        if x.len() != self.states {
            return vec![f64::NAN; self.states];
        }
        let mut gradient = vec![0.0; self.states];
        for (row, w) in self.jacobian(x).chunks(self.states).zip(weights) {
            for (g, d) in gradient.iter_mut().zip(row) {
                *g += w * d;
            }
        }
        gradient
    }

    /// ∂φⱼ/∂xᵢ of every function, N rows of n: products of powers of x, which are computed once.
    pub(crate) fn jacobian(&self, x: &[f64]) -> Vec<f64> {
        let degree = self.exponents.iter().max().map_or(0, |e| usize::from(*e));
        let powers: Vec<f64> = x
            .iter()
            .flat_map(|x| (0..=degree).scan(1.0, move |power, _| Some(std::mem::replace(power, *power * x))))
            .collect();
        let power = |i: usize, e: u8| powers[i * (degree + 1) + usize::from(e)];
        let mut jacobian = vec![0.0; self.exponents.len()];
        for (row, e) in jacobian.chunks_mut(self.states).zip(self.exponents()) {
            // What stands before xᵢ, from the left; then what stands behind it, from the right.
            let mut product = 1.0;
            for (i, d) in row.iter_mut().enumerate() {
                *d = product;
                product *= power(i, e[i]);
            }
            product = 1.0;
            for (i, d) in row.iter_mut().enumerate().rev() {
                *d *= if e[i] == 0 { 0.0 } else { f64::from(e[i]) * power(i, e[i] - 1) * product };
                product *= power(i, e[i]);
            }
        }
        jacobian
    }

    /// The weights of xᵀ P x in this basis, zero for all other functions; `p(i, j)` is symmetric.
    #[must_use]
    pub fn quadratic(&self, p: impl Fn(usize, usize) -> f64) -> Vec<f64> {
        self.exponents()
            .map(|e| match pair(e) {
                Some((i, j)) if i == j => p(i, i),
                Some((i, j)) => p(i, j) + p(j, i),
                None => 0.0,
            })
            .collect()
    }

    /// The matrix P, n × n by rows, of the quadratic part xᵀ P x.
    #[must_use]
    pub fn hessian(&self, weights: &[f64]) -> Vec<f64> {
        let n = self.states;
        let mut p = vec![0.0; n * n];
        for (e, w) in self.exponents().zip(weights) {
            if let Some((i, j)) = pair(e) {
                p[i * n + j] += 0.5 * w;
                p[j * n + i] += 0.5 * w;
            }
        }
        p
    }
}

/// The two states of a monomial of degree two.
fn pair(e: &[u8]) -> Option<(usize, usize)> {
    let degree: u32 = e.iter().map(|e| u32::from(*e)).sum();
    let first = e.iter().position(|e| *e > 0)?;
    let last = e.iter().rposition(|e| *e > 0)?;
    (degree == 2).then_some((first, last))
}

/// All ways of spreading `left` over the exponents from `at` on, the first ones highest first.
fn spread(one: &mut [u8], at: usize, left: u8, out: &mut Vec<u8>) {
    if at + 1 == one.len() {
        one[at] = left;
        out.extend_from_slice(one);
        return;
    }
    for e in (0..=left).rev() {
        one[at] = e;
        spread(one, at + 1, left - e, out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_those_of_the_values() {
        let basis = Monomials::full(3, 5).unwrap();
        assert_eq!(basis.len(), 6 + 10 + 15 + 21);
        let weights: Vec<f64> = (0..basis.len()).map(|i| (i as f64).sin()).collect();
        let x = [0.3, -0.7, 1.1];
        let gradient = basis.gradient(&weights, &x);
        for i in 0..3 {
            let h = 1e-6;
            let moved = |d: f64| {
                let mut y = x;
                y[i] += d;
                basis.value(&weights, &y)
            };
            assert!((gradient[i] - (moved(h) - moved(-h)) / (2.0 * h)).abs() < 1e-8);
        }
        // The Jacobian is the gradient, function by function; zero and negative coordinates included.
        let jacobian = basis.jacobian(&x);
        let summed: f64 = (0..basis.len()).map(|j| weights[j] * jacobian[3 * j + 1]).sum();
        assert!((summed - gradient[1]).abs() < 1e-12);
        assert_eq!(Monomials::even(2, 2).unwrap().gradient(&[1.0, 1.0, 1.0], &[0.0, -2.0]), [-2.0, -4.0]);
    }

    #[test]
    fn quadratic_part_there_and_back() {
        let basis = Monomials::full(3, 3).unwrap();
        let p = [2.0, 0.5, -1.0, 0.5, 3.0, 0.25, -1.0, 0.25, 4.0];
        let weights = basis.quadratic(|i, j| p[3 * i + j]);
        assert_eq!(basis.hessian(&weights), p);
        let x = [1.0, 2.0, -1.0];
        let direct: f64 = (0..9).map(|k| p[k] * x[k / 3] * x[k % 3]).sum();
        assert!((basis.value(&weights, &x) - direct).abs() < 1e-12);
    }

    #[test]
    fn impossible_bases_are_refused() {
        for (basis, part) in [
            (Monomials::even(2, 3), "even degree"),
            (Monomials::full(2, 1), "at least two"),
            (Monomials::full(0, 2), "needs a state"),
            (Monomials::full(12, 12), "more than 4000"),
            (Monomials::full(usize::MAX, 250), "more than 4000"),
        ] {
            let message = basis.unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
