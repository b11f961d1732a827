//! Is the loop stable? Poles inside the boundary layer, in continuous time and with a held command.
//!
//! [`Design`](crate::Design) does all of this; here are the pieces, to look at a loop or to check one law against
//! several plants.
//!
//! ```
//! use greybox_smc::{BoundaryLayer, Surface, Tangent, check::ClosedLoop};
//! use greybox_smc::{FlatOutput, Law, Rate};
//! let cart = Tangent::new([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0]);
//! let (flat, layer) = (FlatOutput::new(&cart)?, BoundaryLayer::new(20.0, 1.0)?);
//! let law = Law::new(flat, Surface::repeated(5.0)?, layer, f64::INFINITY, Rate::Chain)?;
//! // The plant has a spring that the law does not know of.
//! let sprung = Tangent::new([[0.0, 1.0], [-30.0, 0.0]], [0.0, 1.0]);
//! let closed = ClosedLoop::new(sprung, law.gains(&cart)?)?;
//! // −5 and −20 became the roots of s² + 25 s + 130.
//! let [slow, fast] = closed.poles()?;
//! assert!((slow.re + 7.377).abs() < 1e-3 && (fast.re + 17.623).abs() < 1e-3);
//! closed.check(1e-3)?;
//! # Ok::<(), greybox_smc::SmcError>(())
//! ```
use crate::eigen::{characteristic, eigenvalues};
use crate::matrix::{Matrix, identity, is_finite, norm_1, product, times};
use crate::{SmcError, Tangent};

pub use crate::pole::Pole;

/// The linear loop ẋ = (A − b K) x of a plant and a state feedback u = −K x.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClosedLoop<const N: usize> {
    plant: Tangent<N>,
    gains: [f64; N],
}

impl<const N: usize> ClosedLoop<N> {
    /// `gains` is K, as [`Law::gains`](crate::Law::gains) gives it.
    ///
    /// # Errors
    /// [`SmcError::NotFinite`].
    pub fn new(plant: Tangent<N>, gains: [f64; N]) -> Result<Self, SmcError> {
        plant.check_finite("the tangent of the plant")?;
        if !gains.iter().all(|gain| gain.is_finite()) {
            return Err(SmcError::NotFinite { what: "the gains of the loop" });
        }
        Ok(Self { plant, gains })
    }

    /// A − b K.
    #[must_use]
    pub fn matrix(&self) -> [[f64; N]; N] {
        let Tangent { a, b } = &self.plant;
        core::array::from_fn(|i| core::array::from_fn(|j| a[i][j] - b[i] * self.gains[j]))
    }

    /// The poles in 1/s, the rightmost first.
    ///
    /// # Errors
    /// [`SmcError::NoPoles`] where the iteration does not end (or the loop overflows).
    pub fn poles(&self) -> Result<[Pole; N], SmcError> {
        eigenvalues(&self.matrix()).ok_or(SmcError::NoPoles)
    }

    /// c₀ … c_{N−1} of the characteristic polynomial sᴺ + c_{N−1} sᴺ⁻¹ + … + c₀.
    ///
    /// To decide on stability use [`poles`](Self::poles): in the coefficients a slow pole drowns beside fast ones.
    #[must_use]
    pub fn characteristic(&self) -> [f64; N] {
        characteristic(&self.matrix())
    }

    /// The poles in z of the loop with the command held over `dt` s: the eigenvalues of Φ − Γ K with Φ = e^{A dt} and
    /// Γ = ∫ e^{Aτ} b dτ, the largest magnitude first. The loop is stable when all magnitudes are below 1.
    ///
    /// # Errors
    /// [`SmcError::SampleTime`] where `dt` is not positive and finite, [`SmcError::NoPoles`].
    pub fn sampled_poles(&self, dt: f64) -> Result<[Pole; N], SmcError> {
        let mut poles = self.delta_poles(dt)?.map(|mu| Pole { re: 1.0 + dt * mu.re, im: dt * mu.im });
        poles.sort_unstable_by(|a, b| b.magnitude().total_cmp(&a.magnitude()));
        Ok(poles)
    }

    /// The largest magnitude of a pole in z.
    ///
    /// # Errors
    /// As [`sampled_poles`](Self::sampled_poles).
    pub fn spectral_radius(&self, dt: f64) -> Result<f64, SmcError> {
        Ok(self.sampled_poles(dt)?.iter().fold(0.0, |radius: f64, pole| radius.max(pole.magnitude())))
    }

    /// All poles in the left half plane, and with the command held over `dt` s within the unit circle.
    ///
    /// # Errors
    /// [`SmcError::Unstable`] with the rightmost pole, [`SmcError::UnstableSampled`] with a sample time that would
    /// do, [`SmcError::SampleTime`], [`SmcError::NoPoles`].
    pub fn check(&self, dt: f64) -> Result<(), SmcError> {
        if !(dt > 0.0 && dt.is_finite()) {
            return Err(SmcError::SampleTime { dt });
        }
        let poles = self.poles()?;
        let size = poles.iter().fold(0.0_f64, |size, pole| size.max(pole.magnitude()));
        // A pole at zero is found anywhere within the rounding errors of the largest one.
        let rounding = 16.0 * N as f64 * f64::EPSILON * size;
        if let Some(&pole) = poles.first().filter(|pole| pole.re >= -rounding) {
            return Err(SmcError::Unstable { pole });
        }
        // A loop too fast for floating point is as good as an unstable one.
        if self.is_stable_sampled(dt) {
            return Ok(());
        }
        let spectral_radius = self.spectral_radius(dt).unwrap_or(f64::INFINITY);
        Err(SmcError::UnstableSampled { dt, spectral_radius, longest: self.longest_sample_time(dt) })
    }

    /// A stable sample time below the unstable `dt`, near the longest; zero where none is found.
    fn longest_sample_time(&self, dt: f64) -> f64 {
        let (mut stable, mut unstable) = (0.5 * dt, dt);
        let mut halvings = 0;
        while !self.is_stable_sampled(stable) {
            halvings += 1;
            if halvings == 60 {
                return 0.0;
            }
            unstable = stable;
            stable *= 0.5;
        }
        for _ in 0..20 {
            let middle = 0.5 * (stable + unstable);
            if self.is_stable_sampled(middle) {
                stable = middle;
            } else {
                unstable = middle;
            }
        }
        stable
    }

    /// |1 + dt μ| < 1 for all poles μ of the delta operator, said without the 1 that rounds small poles away.
    fn is_stable_sampled(&self, dt: f64) -> bool {
        let Ok(poles) = self.delta_poles(dt) else { return false };
        let size = poles.iter().fold(0.0_f64, |size, pole| size.max(pole.magnitude()));
        let rounding = 32.0 * N as f64 * f64::EPSILON * size;
        poles.iter().all(|mu| 2.0 * mu.re + dt * (mu.re * mu.re + mu.im * mu.im) < -rounding)
    }

    /// The eigenvalues μ = (z − 1)/dt of (Φ − I − Γ K)/dt, which for short sample times are the poles themselves.
    fn delta_poles(&self, dt: f64) -> Result<[Pole; N], SmcError> {
        if !(dt > 0.0 && dt.is_finite()) {
            return Err(SmcError::SampleTime { dt });
        }
        let (change, gamma) = hold(&self.plant, dt).ok_or(SmcError::NoPoles)?;
        let delta: Matrix<N> = core::array::from_fn(|i| {
            core::array::from_fn(|j| (change[i][j] - gamma[i] * self.gains[j]) / dt)
        });
        eigenvalues(&delta).ok_or(SmcError::NoPoles)
    }
}

/// (e^{A t} − I, ∫₀ᵗ e^{Aτ} dτ b): what a state and a held input become over the time `t` > 0; nothing where that
/// overflows.
///
/// Scaling and doubling (Moler and Van Loan, SIAM Review 45(1), 2003, doi:10.1137/S00361445024180): the Taylor
/// series of φ(M) = (e^M − I)/M to degree 17 on M = A t/2ˢ, ‖M‖₁ ≤ ½, where it ends below rounding, then s
/// doublings of the time. The identity stays out of the sums, so that nothing of a short time is rounded away.
fn hold<const N: usize>(plant: &Tangent<N>, t: f64) -> Option<(Matrix<N>, [f64; N])> {
    let norm = norm_1(&plant.a) * t;
    if !norm.is_finite() {
        return None;
    }
    let doublings = if norm > 0.5 { libm::ceil(libm::log2(2.0 * norm)) as i32 } else { 0 };
    let h = libm::ldexp(t, -doublings);
    let m = plant.a.map(|row| row.map(|entry| entry * h));
    let mut phi = identity();
    for degree in (2..=18).rev() {
        phi = product(&m, &phi);
        for i in 0..N {
            for j in 0..N {
                phi[i][j] = phi[i][j] / f64::from(degree) + if i == j { 1.0 } else { 0.0 };
            }
        }
    }
    let mut change = product(&m, &phi);
    let mut gamma = times(&phi, &plant.b).map(|entry| h * entry);
    for _ in 0..doublings {
        let (turned, squared) = (times(&change, &gamma), product(&change, &change));
        for i in 0..N {
            gamma[i] = 2.0 * gamma[i] + turned[i];
            for j in 0..N {
                change[i][j] = 2.0 * change[i][j] + squared[i][j];
            }
        }
    }
    (is_finite(&change) && gamma.iter().all(|entry| entry.is_finite())).then_some((change, gamma))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_held_input_as_integrated_by_hand() {
        // A double integrator: Φ = [1 t; 0 1], Γ = (t²/2, t).
        let (change, gamma) = hold(&Tangent::new([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0]), 0.3).unwrap();
        assert_eq!(change, [[0.0, 0.3], [0.0, 0.0]]);
        assert!((gamma[0] - 0.045).abs() < 1e-17 && (gamma[1] - 0.3).abs() < 1e-17);
        // One state, over times that need no doubling and many: e^{at} − 1 and (e^{at} − 1) b/a.
        for t in [1e-9, 0.1, 1.0, 7.0] {
            let ([[change]], [gamma]) = hold(&Tangent::new([[-3.0]], [2.0]), t).unwrap();
            let exact = libm::expm1(-3.0 * t);
            assert!((change / exact - 1.0).abs() < 1e-13, "{t}: {change} {exact}");
            assert!((gamma / (-2.0 / 3.0 * exact) - 1.0).abs() < 1e-13, "{t}");
        }
        // A rotation by more than one turn.
        let (change, gamma) = hold(&Tangent::new([[0.0, 5.0], [-5.0, 0.0]], [0.0, 1.0]), 2.0).unwrap();
        let (sin, cos) = (libm::sin(10.0), libm::cos(10.0));
        assert!((change[0][0] - (cos - 1.0)).abs() < 1e-13 && (change[0][1] - sin).abs() < 1e-13);
        assert!((gamma[0] - (1.0 - cos) / 5.0).abs() < 1e-13 && (gamma[1] - sin / 5.0).abs() < 1e-13);
        assert!(hold(&Tangent::new([[1e3]], [2.0]), 1.0).is_none());
    }

    #[test]
    fn a_held_command_has_a_longest_sample_time() {
        // ẋ = u = −10 x, held: z = 1 − 10 dt.
        let closed = ClosedLoop::new(Tangent::new([[0.0]], [1.0]), [10.0]).unwrap();
        assert_eq!(closed.check(0.19), Ok(()));
        assert!((closed.spectral_radius(0.19).unwrap() - 0.9).abs() < 1e-14);
        let Err(SmcError::UnstableSampled { spectral_radius, longest, .. }) = closed.check(0.25) else {
            panic!("unstable")
        };
        assert!((spectral_radius - 1.5).abs() < 1e-14);
        assert!(longest < 0.2 && longest > 0.1999);
        // Poles that are slow against the sampling are not lost in the 1 that is near them.
        let slow = ClosedLoop::new(Tangent::new([[0.0]], [1.0]), [1e-9]).unwrap();
        assert_eq!(slow.check(1e-9), Ok(()));
        // Fast stable plants overflow nothing; fast unstable ones are refused.
        let fast = ClosedLoop::new(Tangent::new([[-1e7]], [1.0]), [1.0]).unwrap();
        assert_eq!(fast.check(1.0), Ok(()));
        let held = ClosedLoop::new(Tangent::new([[1e7]], [1.0]), [2e7]).unwrap();
        assert!(
            matches!(held.check(1.0), Err(SmcError::UnstableSampled { spectral_radius, .. }) if spectral_radius > 1e9)
        );
        assert!(held.check(1e-8).is_ok());
    }

    #[test]
    fn margins_and_bad_numbers_are_refused() {
        let at =
            |a: f64| ClosedLoop::new(Tangent::new([[a, 1.0], [0.0, -1e3]], [0.0, 1.0]), [0.0; 2]).unwrap();
        assert!(matches!(at(0.0).check(1e-3), Err(SmcError::Unstable { .. })));
        assert!(
            matches!(at(0.5).check(1e-3), Err(SmcError::Unstable { pole }) if (pole.re - 0.5).abs() < 1e-12)
        );
        assert_eq!(at(-1e-3).check(1e-3), Ok(()));
        for dt in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(at(-1.0).check(dt), Err(SmcError::SampleTime { .. })));
            assert!(matches!(at(-1.0).sampled_poles(dt), Err(SmcError::SampleTime { .. })));
        }
        assert!(ClosedLoop::new(Tangent::new([[f64::NAN]], [1.0]), [1.0]).is_err());
        assert!(ClosedLoop::new(Tangent::new([[1.0]], [1.0]), [f64::INFINITY]).is_err());
    }
}
