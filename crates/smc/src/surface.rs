//! Sliding surfaces of any relative degree.

use crate::SmcError;

/// The sliding surface of a plant of relative degree N (thesis Eq 4.11, there N = 4):
///
/// ```text
/// s = a₀ e + a₁ ė + … + a_{N−2} e⁽ᴺ⁻²⁾ + e⁽ᴺ⁻¹⁾        e = y_f − y_d
/// ```
///
/// While s = 0 the error obeys this linear differential equation; the surface is a good one when its polynomial
/// (Eq 4.12) is Hurwitz, and a value of this type is.
///
/// ```
/// use greybox_smc::Surface;
/// assert_eq!(Surface::<4>::repeated(16.0)?.coefficients(), [4096.0, 768.0, 48.0, 1.0]);
/// assert!(Surface::new([1.0, 1.0, 0.5, 1.0]).is_err());
/// # Ok::<(), greybox_smc::SmcError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface<const N: usize> {
    pub(crate) coefficients: [f64; N],
}

impl<const N: usize> Surface<N> {
    /// s = (d/dt + λ)ᴺ⁻¹ e, thesis Eq 4.13: all N − 1 poles at −λ (`lambda` in 1/s).
    ///
    /// # Errors
    /// [`SmcError::SurfacePole`] where λ is not positive or its powers overflow.
    pub fn repeated(lambda: f64) -> Result<Self, SmcError> {
        const { assert!(N > 0, "a plant has at least one state") };
        let mut coefficients = [1.0; N];
        for k in (0..N - 1).rev() {
            // a_k / a_{k+1} = λ C(N−1, k) / C(N−1, k+1)
            coefficients[k] = coefficients[k + 1] * lambda * (k + 1) as f64 / (N - 1 - k) as f64;
        }
        let usable = coefficients.iter().all(|a| a.is_normal() && *a > 0.0);
        if lambda > 0.0 && lambda.is_finite() && usable {
            Ok(Self { coefficients })
        } else {
            Err(SmcError::SurfacePole { lambda })
        }
    }

    /// Any Hurwitz polynomial a₀ + a₁ q + … + a_{N−1} qᴺ⁻¹ (thesis Eq 4.12), coefficients by rising power; they
    /// are divided by the last one. aₖ is in sᵏ⁻ᴺ⁺¹.
    ///
    /// # Errors
    /// [`SmcError::NotFinite`], [`SmcError::SurfaceLeading`] where the last coefficient is not positive, and
    /// [`SmcError::SurfaceNotHurwitz`] with the row of Routh's array that says so.
    pub fn new(coefficients: [f64; N]) -> Result<Self, SmcError> {
        const { assert!(N > 0, "a plant has at least one state") };
        if !coefficients.iter().all(|a| a.is_finite()) {
            return Err(SmcError::NotFinite { what: "the coefficients of the surface" });
        }
        let leading = coefficients[N - 1];
        let coefficients = coefficients.map(|a| a / leading);
        if !(leading > 0.0 && coefficients.iter().all(|a| a.is_finite())) {
            return Err(SmcError::SurfaceLeading { value: leading });
        }
        let mut array = coefficients;
        match routh(1.0, &mut array[..N - 1]) {
            None => Ok(Self { coefficients }),
            Some((row, value)) => Err(SmcError::SurfaceNotHurwitz { row, value }),
        }
    }

    /// a₀ … a_{N−1}, the last one 1.
    #[must_use]
    pub fn coefficients(&self) -> [f64; N] {
        self.coefficients
    }

    /// s of an error and its derivatives e, ė, … e⁽ᴺ⁻¹⁾.
    #[must_use]
    pub fn value(&self, errors: &[f64; N]) -> f64 {
        crate::matrix::dot(&self.coefficients, errors)
    }
}

/// Routh's test of p₀ + p₁ q + … + `leading` qⁿ (`lower` holds p₀ … pₙ₋₁ and is overwritten): nothing where all
/// roots have negative real parts, else the first row of Routh's array, counted from 1, whose first element is
/// not positive, and that element.
pub(crate) fn routh(leading: f64, lower: &mut [f64]) -> Option<(usize, f64)> {
    let degree = lower.len();
    let mut leading = leading;
    if leading.is_nan() || leading <= 0.0 {
        return Some((1, leading));
    }
    // The polynomial loses its leading power, row by row; lower[..left] is what remains below it.
    for left in (1..=degree).rev() {
        let next = lower[left - 1];
        if next.is_nan() || next <= 0.0 {
            return Some((degree - left + 2, next));
        }
        // q^(left) takes with it q^(left−2), q^(left−4), …
        let mut j = left - 1;
        while j >= 2 {
            lower[j - 1] -= leading / next * lower[j - 2];
            j -= 2;
        }
        leading = next;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn binomial_coefficients() {
        assert_eq!(Surface::<1>::repeated(3.0).unwrap().coefficients(), [1.0]);
        assert_eq!(Surface::<2>::repeated(3.0).unwrap().coefficients(), [3.0, 1.0]);
        assert_eq!(Surface::<5>::repeated(2.0).unwrap().coefficients(), [16.0, 32.0, 24.0, 8.0, 1.0]);
        let surface = Surface::new([8.0, 12.0, 6.0, 1.0]).unwrap();
        assert_eq!(Some(surface), Surface::repeated(2.0).ok());
        assert_eq!(surface.value(&[1.0, -1.0, 2.0, 0.5]), 8.0 - 12.0 + 12.0 + 0.5);
        assert_eq!(Surface::new([4.0, 2.0]).unwrap().coefficients(), [2.0, 1.0]);
    }

    #[test]
    fn routh_agrees_with_known_roots() {
        // (s + 1)(s² + 2 s + 10), s³ + s² + s + 2 and (s² + 1)(s + 1), which is on the margin.
        assert_eq!(routh(1.0, &mut [10.0, 12.0, 3.0]), None);
        assert_eq!(routh(1.0, &mut [2.0, 1.0, 1.0]), Some((3, -1.0)));
        assert_eq!(routh(1.0, &mut [1.0, 1.0, 1.0]), Some((3, 0.0)));
        assert_eq!(routh(1.0, &mut [-1.0, 2.0]), Some((3, -1.0)));
        assert_eq!(routh(1.0, &mut [1.0, -2.0]), Some((2, -2.0)));
        assert_eq!(routh(1.0, &mut []), None);
        // (s + 1)⁵ and (s + 3)(s² + 4)(s + 1)(s + 2) with its pair moved right by 0.1.
        assert_eq!(routh(1.0, &mut [1.0, 5.0, 10.0, 10.0, 5.0]), None);
        let moved = multiply(&[6.0, 11.0, 6.0, 1.0], &[4.01, -0.2, 1.0]);
        assert!(routh(1.0, &mut moved[..5].to_vec()).is_some());
        let kept = multiply(&[6.0, 11.0, 6.0, 1.0], &[4.01, 0.2, 1.0]);
        assert_eq!(routh(1.0, &mut kept[..5].to_vec()), None);
    }

    fn multiply(a: &[f64], b: &[f64]) -> std::vec::Vec<f64> {
        let mut product = std::vec![0.0; a.len() + b.len() - 1];
        for (i, a) in a.iter().enumerate() {
            for (j, b) in b.iter().enumerate() {
                product[i + j] += a * b;
            }
        }
        product
    }

    #[test]
    fn surfaces_that_do_not_converge_are_refused() {
        for lambda in [0.0, -4.0, f64::NAN, f64::INFINITY, 1e120] {
            assert!(matches!(Surface::<4>::repeated(lambda), Err(SmcError::SurfacePole { .. })), "{lambda}");
        }
        assert_eq!(
            Surface::new([2.0, 1.0, 1.0, 1.0]),
            Err(SmcError::SurfaceNotHurwitz { row: 3, value: -1.0 })
        );
        assert_eq!(Surface::new([0.0, 1.0]), Err(SmcError::SurfaceNotHurwitz { row: 2, value: 0.0 }));
        assert_eq!(Surface::new([1.0, -1.0]), Err(SmcError::SurfaceLeading { value: -1.0 }));
        assert!(matches!(Surface::new([f64::NAN, 1.0]), Err(SmcError::NotFinite { .. })));
    }
}
