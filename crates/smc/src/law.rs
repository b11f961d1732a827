//! The control law and its boundary layer.

use crate::matrix::{dot, row_times};
use crate::{Fault, FlatOutput, SmcError, Surface, Tangent};

/// The law gives no command where the input acts on the surface with less than this share of the strength that it
/// had at the tangent of the design: what it would ask for is far beyond any input.
const LEAST_AUTHORITY: f64 = 1e-3;

/// The saturation of thesis Eq 4.20: s/φ inside the boundary layer |s| < φ, the sign of s outside.
///
/// ```
/// use greybox_smc::sat;
/// assert_eq!([sat(-9.0, 5.0), sat(2.0, 5.0), sat(5.0, 5.0), sat(f64::INFINITY, 5.0)], [-1.0, 0.4, 1.0, 1.0]);
/// ```
#[must_use]
#[inline]
pub fn sat(s: f64, phi: f64) -> f64 {
    (s / phi).clamp(-1.0, 1.0)
}

/// The reaching law ṡ = −η sat(s/φ) of thesis Eq 4.16 and 4.20.
///
/// Outside the layer |s| < φ the surface is approached at the rate η; a disturbance d of ṡ takes |d| of it at most,
/// so that η must be larger than any. Inside, s decays at the rate η/φ and the law is a linear one as far as the
/// plant is ([`Law::gains`]); a constant disturbance leaves s = φ d/η.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundaryLayer {
    eta: f64,
    phi: f64,
}

impl BoundaryLayer {
    /// η (`eta`) in units of s per s, that is of y_f⁽ᴺ⁾ (of the input where its gain is 1), and φ (`phi`) in units
    /// of s.
    ///
    /// # Errors
    /// [`SmcError::ReachingRate`] or [`SmcError::LayerWidth`] where one is not positive and finite, or their
    /// ratio is not.
    pub fn new(eta: f64, phi: f64) -> Result<Self, SmcError> {
        if !(eta > 0.0 && eta.is_finite()) {
            return Err(SmcError::ReachingRate { eta });
        }
        let rate = eta / phi;
        if !(phi > 0.0 && phi.is_finite() && rate > 0.0 && rate.is_finite()) {
            return Err(SmcError::LayerWidth { phi });
        }
        Ok(Self { eta, phi })
    }

    /// η.
    #[must_use]
    pub fn eta(&self) -> f64 {
        self.eta
    }

    /// φ.
    #[must_use]
    pub fn phi(&self) -> f64 {
        self.phi
    }

    /// η/φ in 1/s: how fast s decays inside the layer.
    #[must_use]
    pub fn rate(&self) -> f64 {
        self.eta / self.phi
    }
}

/// What the law takes the rates of y_f, ẏ_f, … y_f⁽ᴺ⁻²⁾ to be. For a linear plant with the tangent of the design
/// the two are one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Rate {
    /// d/dt of y_f⁽ᵏ⁾ is y_f⁽ᵏ⁺¹⁾, read off the state by the tangent, and only the last rate comes from f: the law
    /// of the thesis (Eq 4.18 and 4.19).
    #[default]
    Chain,
    /// Every rate comes from f and g: ṡ = Σ aₖ c Aᵏ (f + g u). The reaching law then holds exactly, whatever the
    /// plant's nonlinearity; what that does to the chain moves into the motion on the surface.
    Model,
}

/// Where the plant should go.
///
/// ```text
/// e⁽ᵏ⁾ = c Aᵏ (x − origin) − desired[k]
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target<const N: usize> {
    /// The state from which errors are taken: an equilibrium of the nonlinear plant.
    pub origin: [f64; N],
    /// y_d, ẏ_d, … y_d⁽ᴺ⁻¹⁾: the desired flat output and its derivatives, from `origin`.
    pub desired: [f64; N],
    /// y_d⁽ᴺ⁾.
    pub highest: f64,
}

impl<const N: usize> Target<N> {
    /// To rest at a state: an equilibrium of the nonlinear model, from [`EquilibriumSolver`], with the wanted value
    /// pinned. At a state that is no equilibrium the law leaves an error, as the printed one of the thesis does
    /// with (θ_d, 0, 0, 0).
    ///
    /// [`EquilibriumSolver`]: crate::EquilibriumSolver
    #[must_use]
    pub const fn rest(state: [f64; N]) -> Self {
        Self { origin: state, desired: [0.0; N], highest: 0.0 }
    }

    /// To follow y_d(t), given by its value and N derivatives at this instant, `desired` = y_d … y_d⁽ᴺ⁻¹⁾ and
    /// `highest` = y_d⁽ᴺ⁾, around the state zero. Set `origin` for a motion around another equilibrium.
    #[must_use]
    pub const fn trajectory(desired: [f64; N], highest: f64) -> Self {
        Self { origin: [0.0; N], desired, highest }
    }
}

/// What the law wants.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Command {
    /// The input, within the limit.
    pub u: f64,
    /// The input that the law would give without the limit.
    pub unlimited: f64,
    /// The surface s; the boundary layer is |s| < φ.
    pub surface: f64,
    /// Whether the limit changed the input.
    pub saturated: bool,
}

/// A flat-output sliding-mode law for ẋ = f(x) + g(x) u (thesis Eq 4.19, corrected and for any plant):
///
/// ```text
/// e⁽ᵏ⁾ = c Aᵏ (x − x_e) − y_d⁽ᵏ⁾                                   k = 0 … N−1
/// s    = Σ aₖ e⁽ᵏ⁾                                                  a_{N−1} = 1
///
///      y_d⁽ᴺ⁾ − c Aᴺ⁻¹ f(x) − Σ_{k<N−1} aₖ e⁽ᵏ⁺¹⁾ − η sat(s/φ)
/// u  = ───────────────────────────────────────────────────────      |u| ≤ u_max
///                         c Aᴺ⁻¹ g(x)
/// ```
///
/// With [`Rate::Model`] L = Σ aₖ c Aᵏ stands in the place of c Aᴺ⁻¹, and only the aₖ y_d⁽ᵏ⁺¹⁾ are left of the sum.
///
/// f and g are the caller's, evaluated at the measured state, with friction smoothed ([`smooth_sign`]). Inside the
/// boundary layer, around an equilibrium of the tangent of the design, the closed loop has N − 1 poles where the
/// surface has them and one at −η/φ.
///
/// A law made by [`Design`] is checked against the plant, the law of [`Law::new`] is not.
///
/// [`smooth_sign`]: crate::smooth_sign
/// [`Design`]: crate::Design
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Law<const N: usize> {
    flat: FlatOutput<N>,
    surface: Surface<N>,
    layer: BoundaryLayer,
    limit: f64,
    rate: Rate,
    /// What multiplies f and g: c Aᴺ⁻¹, or Σ aₖ c Aᵏ where every rate comes from the model.
    onto_rate: [f64; N],
}

impl<const N: usize> Law<N> {
    /// The law with the input limited to ±`limit` (which may be infinite), unchecked against any plant.
    ///
    /// # Errors
    /// [`SmcError::InputLimit`] where the limit is not positive, [`SmcError::Overflow`] where the rows of the flat
    /// output and the surface overflow when multiplied.
    pub fn new(
        flat: FlatOutput<N>,
        surface: Surface<N>,
        layer: BoundaryLayer,
        limit: f64,
        rate: Rate,
    ) -> Result<Self, SmcError> {
        if limit.is_nan() || limit <= 0.0 {
            return Err(SmcError::InputLimit { limit });
        }
        let rows = flat.rows();
        let onto_rate = match rate {
            Rate::Chain => rows[N - 1],
            Rate::Model => row_times(&surface.coefficients(), &rows),
        };
        if !onto_rate.iter().all(|entry| entry.is_finite()) {
            return Err(SmcError::Overflow);
        }
        Ok(Self { flat, surface, layer, limit, rate, onto_rate })
    }

    /// The command at the state `x`, where the model has the values `f` = f(x) and `g` = g(x).
    ///
    /// Nothing is allocated, nothing panics, and the time does not depend on the numbers.
    ///
    /// # Errors
    /// [`Fault::NotFinite`] where an argument is not finite or the law overflows; [`Fault::Authority`] where
    /// |c Aᴺ⁻¹ g(x)| has fallen below a thousandth of what it was in the design. There is no command then, and what
    /// is safe (hold the last one, or zero) is for the caller to say.
    #[inline]
    pub fn step(
        &self,
        x: &[f64; N],
        f: &[f64; N],
        g: &[f64; N],
        target: &Target<N>,
    ) -> Result<Command, Fault> {
        let (rows, a) = (&self.flat.rows, &self.surface.coefficients);
        // A plain loop: the bounds checks of a closure are not always optimised away.
        let mut from_origin = [0.0; N];
        for i in 0..N {
            from_origin[i] = x[i] - target.origin[i];
        }
        let (mut surface, mut wanted) = (0.0, target.highest);
        for k in 0..N {
            let error = dot(&rows[k], &from_origin) - target.desired[k];
            surface += a[k] * error;
            if k > 0 {
                wanted -= match self.rate {
                    Rate::Chain => a[k - 1] * error,
                    Rate::Model => -a[k - 1] * target.desired[k],
                };
            }
        }
        let gain = dot(&self.onto_rate, g);
        let share = gain / self.flat.input_gain();
        if share.abs() < LEAST_AUTHORITY {
            return Err(Fault::Authority { share });
        }
        let switching = self.layer.eta * sat(surface, self.layer.phi);
        let unlimited = (wanted - dot(&self.onto_rate, f) - switching) / gain;
        // The saturation and the quotient make finite numbers of infinite ones.
        if !(unlimited.is_finite() && surface.is_finite() && gain.is_finite()) {
            return Err(Fault::NotFinite);
        }
        let u = unlimited.max(-self.limit).min(self.limit);
        Ok(Command { u, unlimited, surface, saturated: u != unlimited })
    }

    /// The state feedback u = u_e − K (x − x_e) that the law is inside its boundary layer: K, in units of the input
    /// per unit of the states.
    ///
    /// `model` is the tangent, at x_e, of the f and g that the caller will pass; that need not be the tangent of the
    /// design, nor that of the plant.
    ///
    /// # Errors
    /// [`SmcError::NotFinite`], and [`SmcError::NoAuthority`] where the model's input does not act on the surface.
    pub fn gains(&self, model: &Tangent<N>) -> Result<[f64; N], SmcError> {
        model.check_finite("the tangent of the model")?;
        let (rows, a) = (self.flat.rows(), self.surface.coefficients());
        let gain = dot(&self.onto_rate, &model.b);
        let share = gain / self.flat.input_gain();
        if share.is_nan() || share.abs() < LEAST_AUTHORITY {
            return Err(SmcError::NoAuthority { share });
        }
        let mut gains = row_times(&self.onto_rate, &model.a);
        for j in 0..N {
            for k in 0..N {
                if k > 0 && self.rate == Rate::Chain {
                    gains[j] += a[k - 1] * rows[k][j];
                }
                gains[j] += self.layer.rate() * a[k] * rows[k][j];
            }
            gains[j] /= gain;
        }
        if gains.iter().all(|gain| gain.is_finite()) { Ok(gains) } else { Err(SmcError::Overflow) }
    }

    /// The flat output.
    #[must_use]
    pub fn flat(&self) -> &FlatOutput<N> {
        &self.flat
    }

    /// The sliding surface.
    #[must_use]
    pub fn surface(&self) -> &Surface<N> {
        &self.surface
    }

    /// The boundary layer.
    #[must_use]
    pub fn layer(&self) -> BoundaryLayer {
        self.layer
    }

    /// u_max.
    #[must_use]
    pub fn limit(&self) -> f64 {
        self.limit
    }

    /// Where the rates of the flat output come from.
    #[must_use]
    pub fn rate(&self) -> Rate {
        self.rate
    }

    /// η/|β|: the input that the switching term asks for outside the layer.
    ///
    /// Far above the limit, as with the numbers of the thesis (590 V for an amplifier of 10 V), it says that the law
    /// never leaves its layer before the input saturates: it is the linear law of [`gains`](Self::gains).
    #[must_use]
    pub fn switching_input(&self) -> f64 {
        self.layer.eta / self.flat.input_gain().abs()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn double_integrator(rate: Rate) -> Law<2> {
        let flat = FlatOutput::new(&Tangent::new([[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0])).unwrap();
        let layer = BoundaryLayer::new(10.0, 0.5).unwrap();
        Law::new(flat, Surface::repeated(3.0).unwrap(), layer, 4.0, rate).unwrap()
    }

    #[test]
    fn sat_is_odd_rising_and_bounded() {
        let mut last = -1.0;
        for k in -300..=300 {
            let s = 0.01 * f64::from(k);
            let value = sat(s, 0.8);
            assert_eq!(sat(-s, 0.8), -value);
            assert!(value >= last && value.abs() <= 1.0);
            assert!(s.abs() >= 0.8 || (value - s / 0.8).abs() < 1e-15);
            last = value;
        }
        assert_eq!([sat(0.8, 0.8), sat(-0.8, 0.8), sat(0.0, 0.8)], [1.0, -1.0, 0.0]);
        assert!(sat(f64::NAN, 0.8).is_nan());
    }

    #[test]
    fn the_law_by_hand() {
        // y_f = x₁/2, e = (x₁ − 1)/2, ė = x₂/2, s = 3 e + ė, u = −ẍ/2 − 3 ė − 10 sat(s/0.5).
        let target = Target::rest([1.0, 0.0]);
        for rate in [Rate::Chain, Rate::Model] {
            let law = double_integrator(rate);
            let command = law.step(&[1.1, -0.2], &[-0.2, 0.7], &[0.0, 2.0], &target).unwrap();
            let s = 3.0 * 0.05 - 0.1;
            assert!((command.surface - s).abs() < 1e-15);
            assert!((command.unlimited - (-0.35 + 0.3 - 20.0 * s)).abs() < 1e-13, "{command:?}");
            assert!(command.u == command.unlimited && !command.saturated);
            // Far away: outside the layer, and beyond the limit.
            let command = law.step(&[-9.0, 0.0], &[0.0; 2], &[0.0, 2.0], &target).unwrap();
            assert_eq!((command.u, command.unlimited, command.saturated), (4.0, 10.0, true));
            assert_eq!(command.surface, -15.0);
        }
    }

    #[test]
    fn a_trajectory_is_followed_without_error() {
        // y_d = ½ sin t: on it, whatever the law, u = ÿ_d.
        let t = 0.7;
        let target = Target::trajectory([0.5 * libm::sin(t), 0.5 * libm::cos(t)], -0.5 * libm::sin(t));
        let x = [libm::sin(t), libm::cos(t)];
        for rate in [Rate::Chain, Rate::Model] {
            let command = double_integrator(rate).step(&x, &[x[1], 0.0], &[0.0, 2.0], &target).unwrap();
            assert!((command.unlimited + 0.5 * libm::sin(t)).abs() < 1e-15, "{rate:?}");
            // Off it by (0.01, 0): s = 3 · 0.005, u = ÿ_d − 20 s.
            let off = [x[0] + 0.01, x[1]];
            let command = double_integrator(rate).step(&off, &[x[1], 0.0], &[0.0, 2.0], &target).unwrap();
            assert!((command.unlimited + 0.5 * libm::sin(t) + 0.3).abs() < 1e-13, "{rate:?}");
        }
    }

    #[test]
    fn the_rate_of_the_model_keeps_the_reaching_law() {
        // ẋ₁ is not x₂ here: f₁ = x₂ + x₁². Only Rate::Model knows.
        let (x, f, g) = ([0.2, 0.1], [0.14, -0.5], [0.3, 2.0]);
        let rate_of_surface = |law: Law<2>| {
            let command = law.step(&x, &f, &g, &Target::rest([0.0; 2])).unwrap();
            let xdot = [f[0] + g[0] * command.u, f[1] + g[1] * command.u];
            let sdot = 0.5 * (3.0 * xdot[0] + xdot[1]);
            (sdot, -10.0 * sat(command.surface, 0.5))
        };
        let law = Law { limit: f64::INFINITY, ..double_integrator(Rate::Model) };
        let (sdot, wanted) = rate_of_surface(law);
        assert!((sdot - wanted).abs() < 1e-13);
        let law = Law { limit: f64::INFINITY, ..double_integrator(Rate::Chain) };
        let (sdot, wanted) = rate_of_surface(law);
        assert!((sdot - wanted).abs() > 0.01);
    }

    #[test]
    fn the_gains_are_the_law_inside_the_layer() {
        let model = Tangent::new([[0.1, 1.2], [-4.0, -0.3]], [0.05, 1.7]);
        for rate in [Rate::Chain, Rate::Model] {
            let law = double_integrator(rate);
            let gains = law.gains(&model).unwrap();
            let x = [0.01, -0.03];
            let f = [0.1 * x[0] + 1.2 * x[1], -4.0 * x[0] - 0.3 * x[1]];
            let command = law.step(&x, &f, &model.b, &Target::rest([0.0; 2])).unwrap();
            assert!((command.u + gains[0] * x[0] + gains[1] * x[1]).abs() < 1e-13, "{rate:?}");
        }
    }

    #[test]
    fn no_number_makes_a_command_of_nonsense() {
        let law = double_integrator(Rate::Chain);
        let (x, f, g, target) = ([0.1, 0.2], [0.2, 0.0], [0.0, 2.0], Target::rest([1.0, 0.0]));
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for i in 0..2 {
                let put = |v: [f64; 2]| {
                    let mut v = v;
                    v[i] = bad;
                    v
                };
                assert_eq!(law.step(&put(x), &f, &g, &target), Err(Fault::NotFinite));
                assert_eq!(law.step(&x, &put(f), &g, &target), Err(Fault::NotFinite));
                assert!(law.step(&x, &f, &put(g), &target).is_err());
                let origin = Target { origin: put(target.origin), ..target };
                assert_eq!(law.step(&x, &f, &g, &origin), Err(Fault::NotFinite));
                let desired = Target { desired: put(target.desired), ..target };
                assert_eq!(law.step(&x, &f, &g, &desired), Err(Fault::NotFinite));
            }
            let highest = Target { highest: bad, ..target };
            assert_eq!(law.step(&x, &f, &g, &highest), Err(Fault::NotFinite));
        }
        for g in [[0.0, 0.0], [5.0, 0.0], [0.0, 1e-9], [0.0, -1e-5]] {
            let fault = law.step(&x, &f, &g, &target).unwrap_err();
            assert!(matches!(fault, Fault::Authority { .. }), "{g:?}: {fault:?}");
        }
        assert!(law.step(&x, &f, &[0.0, -2.0], &target).is_ok());
    }
}
