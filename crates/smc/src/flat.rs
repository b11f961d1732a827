//! The flat output of a controllable pair.

use crate::matrix::{
    Matrix, Reflection, dot, hessenberg, identity, is_finite, norm_1, power_of_two, row_times, solve, times,
};
use crate::{SmcError, Tangent};

/// A pair whose controllability matrix is worse conditioned than this gives a flat output with fewer than four
/// trustworthy digits, and is refused.
const LEAST_RECIPROCAL_CONDITION: f64 = 1e-12;

/// The flat output y_f = c x of a controllable tangent (A, b), and its derivatives.
///
/// c is the last row of the inverse of the controllability matrix \[b, A b, …, Aᴺ⁻¹ b\] times the *input gain* β.
/// The input then reaches only the last derivative:
///
/// ```text
/// y_f⁽ᵏ⁾ = c Aᵏ x               k < N
/// y_f⁽ᴺ⁾ = c Aᴺ x + β u         β = c Aᴺ⁻¹ b
/// ```
///
/// (H. Sira-Ramírez and S. K. Agrawal, *Differentially Flat Systems*, Marcel Dekker 2004.) For the
/// flexible link without stiffness and damping of its hub this is thesis Eq 4.7, with β = B_α: see
/// [`thesis::LinkTangent`](crate::thesis::LinkTangent). A plant with several inputs has no such c; treat one
/// input at a time.
///
/// ```
/// use greybox_smc::{FlatOutput, Tangent};
/// // Two carts of 1 kg and 2 kg on a spring of 6 N/m, the first one pushed; x = (x₁, x₂, ẋ₁, ẋ₂).
/// let a = [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-6.0, 6.0, 0.0, 0.0], [3.0, -3.0, 0.0, 0.0]];
/// let flat = FlatOutput::new(&Tangent::new(a, [0.0, 0.0, 1.0, 0.0]))?;
/// // The flat output is the place of the second cart, over which no force acts but the spring's.
/// let [c, ..] = flat.rows();
/// for (c, expected) in c.iter().zip([0.0, 1.0 / 3.0, 0.0, 0.0]) {
///     assert!((c - expected).abs() < 1e-15);
/// }
/// # Ok::<(), greybox_smc::SmcError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlatOutput<const N: usize> {
    pub(crate) rows: [[f64; N]; N],
    highest: [f64; N],
    input_gain: f64,
    reciprocal_condition: f64,
}

impl<const N: usize> FlatOutput<N> {
    /// The flat output of a tangent, with the input gain β = 1: y_f⁽ᴺ⁾ is in units of the input.
    ///
    /// Nothing is inverted. The states are measured in units of what the input does to them, then orthogonal
    /// reflections bring b to the first axis and A to Hessenberg form H: c is the last axis divided by the product
    /// of ‖b‖ and the subdiagonal of H (the staircase form: C. C. Paige, IEEE Trans. Autom. Control 26(1), 1981,
    /// 130–138).
    ///
    /// # Errors
    /// [`SmcError::NotFinite`]; [`SmcError::Unreached`] where a state stands outside every chain that starts at
    /// the input; [`SmcError::NotControllable`] where the states cannot be moved independently, or hardly;
    /// [`SmcError::Overflow`].
    pub fn new(tangent: &Tangent<N>) -> Result<Self, SmcError> {
        const { assert!(N > 0, "a plant has at least one state") };
        tangent.check_finite("the tangent of the flat output")?;
        let sizes = reachable_sizes(tangent)?;
        let mut h: Matrix<N> =
            core::array::from_fn(|i| core::array::from_fn(|j| tangent.a[i][j] / sizes[i] * sizes[j]));
        let b: [f64; N] = core::array::from_fn(|i| tangent.b[i] / sizes[i]);
        if !is_finite(&h) || !b.iter().all(|b| b.is_finite()) {
            return Err(SmcError::Overflow);
        }

        let mut q = identity();
        let reflection = Reflection::of(&b, 0);
        reflection.apply_left(&mut h);
        reflection.apply_right(&mut h);
        reflection.apply_right(&mut q);
        hessenberg(&mut h, &mut q);

        let reciprocal_condition = reciprocal_condition(&h);
        if reciprocal_condition < LEAST_RECIPROCAL_CONDITION {
            return Err(SmcError::NotControllable { reciprocal_condition });
        }
        let chain = (1..N).fold(reflection.length, |product, k| product * h[k][k - 1]);
        let mut row = [0.0; N];
        row[N - 1] = 1.0 / chain;
        let to_states = |row: &[f64; N]| -> [f64; N] {
            let row = times(&q, row);
            core::array::from_fn(|j| row[j] / sizes[j])
        };
        let mut rows = [[0.0; N]; N];
        for k in 0..N {
            rows[k] = to_states(&row);
            row = row_times(&row, &h);
        }
        let highest = to_states(&row);
        let finite = rows.iter().flatten().chain(&highest).all(|entry| entry.is_finite());
        if finite && chain != 0.0 && chain.is_finite() {
            Ok(Self { rows, highest, input_gain: 1.0, reciprocal_condition })
        } else {
            Err(SmcError::Overflow)
        }
    }

    /// The same flat output in another unit, so that y_f⁽ᴺ⁾ = c Aᴺ x + β u with the given β.
    ///
    /// β scales the sliding surface, and with it the numbers η and φ of a [`BoundaryLayer`]; only β = 1 gives η
    /// the unit of the input.
    ///
    /// [`BoundaryLayer`]: crate::BoundaryLayer
    ///
    /// # Errors
    /// [`SmcError::InputGain`] where β is zero or not finite, or where a row overflows.
    pub fn with_input_gain(self, beta: f64) -> Result<Self, SmcError> {
        let factor = beta / self.input_gain;
        let scaled = Self {
            rows: self.rows.map(|row| row.map(|entry| factor * entry)),
            highest: self.highest.map(|entry| factor * entry),
            input_gain: beta,
            reciprocal_condition: self.reciprocal_condition,
        };
        let finite = scaled.rows.iter().flatten().chain(&scaled.highest).all(|entry| entry.is_finite());
        if finite && factor.is_normal() { Ok(scaled) } else { Err(SmcError::InputGain { beta }) }
    }

    /// The rows c, c A, …, c Aᴺ⁻¹: what multiplies x in y_f, ẏ_f, …, y_f⁽ᴺ⁻¹⁾.
    #[must_use]
    pub fn rows(&self) -> [[f64; N]; N] {
        self.rows
    }

    /// c Aᴺ: what multiplies x in y_f⁽ᴺ⁾.
    #[must_use]
    pub fn highest(&self) -> [f64; N] {
        self.highest
    }

    /// β = c Aᴺ⁻¹ b.
    #[must_use]
    pub fn input_gain(&self) -> f64 {
        self.input_gain
    }

    /// How far the tangent is from one that cannot be controlled: 1 is best, zero uncontrollable.
    ///
    /// This is 1/(‖K‖₁ ‖K⁻¹‖₁) of the controllability matrix K, its columns scaled to unit length and its states
    /// measured in units of what the input does to them: units of states, input and time play (almost) no part.
    /// Its reciprocal says by how much errors of A and b grow in c.
    #[must_use]
    pub fn reciprocal_condition(&self) -> f64 {
        self.reciprocal_condition
    }

    /// (y_f, ẏ_f, …, y_f⁽ᴺ⁻¹⁾) at a state (a difference from the equilibrium).
    #[must_use]
    pub fn coordinates(&self, x: &[f64; N]) -> [f64; N] {
        times(&self.rows, x)
    }

    /// The state at which y_f and its derivatives have the values `z`: thesis Eq 4.8, generalised.
    ///
    /// # Errors
    /// [`SmcError::NotFinite`] where `z` is not finite or the state overflows.
    pub fn state(&self, z: &[f64; N]) -> Result<[f64; N], SmcError> {
        solve(&self.rows, z).ok_or(SmcError::NotFinite { what: "the flat output and its derivatives" })
    }

    /// The input, a difference from the equilibrium's, that gives y_f⁽ᴺ⁾ the value `highest` at a state:
    /// u = (y_f⁽ᴺ⁾ − c Aᴺ x)/β.
    #[must_use]
    pub fn input(&self, x: &[f64; N], highest: f64) -> f64 {
        (highest - dot(&self.highest, x)) / self.input_gain
    }
}

/// For every state the size of what the input does to it, as a power of two: the row factors rᵢ that bring the entries
/// of the controllability matrix nearest to 1, the sum of (log |Kᵢₖ| − log rᵢ − log cₖ)² over its entries being
/// smallest (A. R. Curtis and J. K. Reid, IMA J. Appl. Math. 10(1), 1972, doi:10.1093/imamat/10.1.118).
fn reachable_sizes<const N: usize>(tangent: &Tangent<N>) -> Result<[f64; N], SmcError> {
    // log₂ |Kᵢₖ|; nothing where the entry is zero.
    let mut logarithms = [[None; N]; N];
    let mut column = tangent.b;
    // A bound on the rounding errors of the column, entry by entry: what lies below is a zero by cancellation.
    let mut error = [0.0; N];
    for k in 0..N {
        for i in 0..N {
            if column[i].abs() <= error[i] {
                column[i] = 0.0;
            }
        }
        let size = column.iter().fold(0.0_f64, |size, entry| size.max(entry.abs()));
        if size == 0.0 {
            break;
        }
        if !size.is_finite() {
            return Err(SmcError::Overflow);
        }
        let scale = 1.0 / power_of_two(size);
        for i in 0..N {
            column[i] *= scale;
            error[i] *= scale;
            if column[i] != 0.0 {
                logarithms[i][k] = Some(libm::log2(column[i].abs()));
            }
        }
        let (mut next, mut next_error) = ([0.0; N], [0.0; N]);
        for i in 0..N {
            for j in 0..N {
                let entry = tangent.a[i][j];
                next[i] += entry * column[j];
                next_error[i] += entry.abs() * (error[j] + 2.0 * N as f64 * f64::EPSILON * column[j].abs());
            }
        }
        (column, error) = (next, next_error);
    }
    // Means of rows and columns by turns; where no entry is missing, the first is the answer.
    let (mut rows, mut columns) = ([0.0; N], [0.0; N]);
    for _ in 0..40 {
        for i in 0..N {
            let row = (0..N).filter_map(|k| logarithms[i][k].map(|log: f64| log - columns[k]));
            rows[i] = mean(row).ok_or(SmcError::Unreached { state: i })?;
        }
        for k in 0..N {
            let column = (0..N).filter_map(|i| logarithms[i][k].map(|log: f64| log - rows[i]));
            columns[k] = mean(column).unwrap_or(0.0);
        }
    }
    Ok(rows.map(|log| libm::exp2(libm::round(log))))
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    (count > 0.0).then_some(sum / count)
}

/// 1/(‖K‖₁ ‖K⁻¹‖₁) of the controllability matrix K = \[e₁, H e₁, …\] of a Hessenberg matrix, with columns of unit
/// length. K is upper triangular.
fn reciprocal_condition<const N: usize>(h: &Matrix<N>) -> f64 {
    let mut krylov = [[0.0; N]; N];
    let mut column = [0.0_f64; N];
    column[0] = 1.0;
    for k in 0..N {
        let scale = column.iter().fold(0.0_f64, |size, entry| size.max(entry.abs()));
        let shortened = column.map(|entry| entry / scale);
        let length = libm::sqrt(dot(&shortened, &shortened));
        let unit = shortened.map(|entry| entry / length);
        for i in 0..N {
            krylov[i][k] = unit[i];
        }
        column = times(h, &unit);
    }
    // The inverse of the triangle, column by column.
    let mut inverse = [[0.0; N]; N];
    for j in 0..N {
        for i in (0..=j).rev() {
            let mut sum = if i == j { 1.0 } else { 0.0 };
            for k in i + 1..=j {
                sum -= krylov[i][k] * inverse[k][j];
            }
            inverse[i][j] = sum / krylov[i][i];
        }
    }
    let rcond = 1.0 / (norm_1(&krylov) * norm_1(&inverse));
    if rcond.is_nan() { 0.0 } else { rcond }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CARTS: Tangent<4> = Tangent::new(
        [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-6.0, 6.0, -0.2, 0.1], [3.0, -3.0, 0.05, -0.3]],
        [0.0, 0.0, 1.0, 0.0],
    );

    #[test]
    fn the_input_reaches_only_the_last_derivative() {
        let flat = FlatOutput::new(&CARTS).unwrap();
        let rows = flat.rows();
        for k in 0..4 {
            let reached = dot(&rows[k], &CARTS.b);
            assert!((reached - if k == 3 { 1.0 } else { 0.0 }).abs() < 1e-14, "{k}: {reached}");
            let next = row_times(&rows[k], &CARTS.a);
            let expected = if k == 3 { flat.highest() } else { rows[k + 1] };
            for j in 0..4 {
                assert!((next[j] - expected[j]).abs() < 1e-13, "{k}");
            }
        }
        assert!(flat.reciprocal_condition() > 1e-2, "{}", flat.reciprocal_condition());
    }

    #[test]
    fn states_follow_from_the_flat_output() {
        let flat = FlatOutput::new(&CARTS).unwrap().with_input_gain(-3.0).unwrap();
        let x = [0.3, -0.2, 1.5, 4.0];
        let back = flat.state(&flat.coordinates(&x)).unwrap();
        for i in 0..4 {
            assert!((back[i] - x[i]).abs() < 1e-12);
        }
        let u = flat.input(&x, 0.7);
        assert!((dot(&flat.highest(), &x) - 3.0 * u - 0.7).abs() < 1e-12);
        assert!(flat.state(&[f64::NAN; 4]).is_err());
    }

    #[test]
    fn units_play_no_part() {
        let flat = FlatOutput::new(&CARTS).unwrap();
        let units = [1e-9, 1e6, 3e-4, 7e11];
        let (input, time) = (1e-7, 1e5);
        let a: Matrix<4> =
            core::array::from_fn(|i| core::array::from_fn(|j| CARTS.a[i][j] * units[i] / units[j] / time));
        let b = core::array::from_fn(|i| CARTS.b[i] * units[i] / input / time);
        let scaled = FlatOutput::new(&Tangent::new(a, b)).unwrap();
        // c is fixed by c Aᴺ⁻¹ b = 1: it takes the unit of the input times time⁴.
        let unit = input * time.powi(4);
        for k in 0..4 {
            for j in 0..4 {
                let expected = flat.rows()[k][j] * unit / time.powi(k as i32) / units[j];
                let size = unit / time.powi(k as i32) / units[j];
                assert!((scaled.rows()[k][j] - expected).abs() < 1e-12 * size, "{k} {j}");
            }
        }
        let ratio = scaled.reciprocal_condition() / flat.reciprocal_condition();
        assert!((0.1..10.0).contains(&ratio), "{ratio}");
    }

    #[test]
    fn what_cannot_be_controlled_is_refused_and_named() {
        let refused = |a, b| FlatOutput::new(&Tangent::<2>::new(a, b)).unwrap_err();
        assert_eq!(refused([[0.0, 0.0], [1.0, 0.0]], [0.0, 1.0]), SmcError::Unreached { state: 0 });
        assert_eq!(refused([[0.0, 1.0], [0.0, 0.0]], [0.0, 0.0]), SmcError::Unreached { state: 0 });
        // Two equal systems beside each other: no input tells them apart.
        let SmcError::NotControllable { reciprocal_condition } =
            refused([[-1.0, 0.0], [0.0, -1.0]], [1.0, 1.0])
        else {
            panic!("controllable?")
        };
        assert!(reciprocal_condition < 1e-15, "{reciprocal_condition}");
        assert!(matches!(refused([[f64::NAN, 0.0], [1.0, 0.0]], [1.0, 1.0]), SmcError::NotFinite { .. }));
        assert!(matches!(
            refused([[0.0, 0.0], [1.0, 0.0]], [f64::INFINITY, 1.0]),
            SmcError::NotFinite { .. }
        ));
        // A state that the input reaches only by rounding.
        let third = 1.0 / 3.0;
        let a = [[-0.1, third, 0.0], [third, -0.1, 0.0], [0.7, -0.7, -1.0]];
        let b = [0.1 + 0.2, 0.3, 0.0];
        let refused = FlatOutput::new(&Tangent::new(a, b)).unwrap_err();
        assert!(
            matches!(refused, SmcError::Unreached { state: 2 } | SmcError::NotControllable { .. }),
            "{refused:?}"
        );
    }

    #[test]
    fn hardly_controllable_plants_are_told_from_good_ones() {
        // Two modes that differ by ε.
        let pair = |epsilon: f64| Tangent::new([[-1.0, 0.0], [0.0, -1.0 - epsilon]], [1.0, 1.0]);
        for epsilon in [1e-2, 1e-5, 1e-8] {
            let flat = FlatOutput::new(&pair(epsilon)).unwrap();
            let rcond = flat.reciprocal_condition();
            assert!(rcond < epsilon && rcond > 0.05 * epsilon, "{epsilon}: {rcond}");
            assert!((flat.rows()[0][0] * epsilon - 1.0).abs() < 1e-14 / epsilon);
        }
        assert!(matches!(FlatOutput::new(&pair(1e-13)), Err(SmcError::NotControllable { .. })));
    }

    #[test]
    fn a_zero_by_cancellation_is_no_size() {
        // The input reaches three states alike, and the first one feels 0.1 + 0.2 − 0.3 of them: 6·10⁻¹⁷ in floating
        // point, where sixteenths give zero.
        let plant = |feels: [f64; 3]| {
            let [p, q, r] = feels;
            let a = [[0.0, p, q, r], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -2.0, 0.0], [0.0, 0.0, 0.0, -4.0]];
            Tangent::new(a, [0.0, 1.0, 1.0, 1.0])
        };
        let rounded = reachable_sizes(&plant([0.1, 0.2, -0.3])).unwrap();
        let exact = reachable_sizes(&plant([0.0625, 0.125, -0.1875])).unwrap();
        for i in 0..4 {
            assert!((0.5..=2.0).contains(&(rounded[i] / exact[i])), "{rounded:?} {exact:?}");
        }
    }

    #[test]
    fn an_input_gain_must_be_a_scale() {
        let flat = FlatOutput::new(&CARTS).unwrap();
        for beta in [0.0, f64::NAN, f64::INFINITY, 1e308] {
            assert!(matches!(flat.with_input_gain(beta), Err(SmcError::InputGain { .. })), "{beta}");
        }
        assert_eq!(flat.with_input_gain(-2.0).unwrap().input_gain(), -2.0);
    }

    #[test]
    fn one_state_is_enough() {
        let flat = FlatOutput::new(&Tangent::new([[-3.0]], [-4.0])).unwrap();
        assert_eq!(flat.rows(), [[-0.25]]);
        assert_eq!(flat.highest(), [0.75]);
        assert_eq!(flat.reciprocal_condition(), 1.0);
    }
}
