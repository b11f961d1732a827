//! Equilibria of the nonlinear model, for the feed-forward of a set point.

use crate::matrix::{Matrix, solve};
use crate::{SmcError, Tangent};

/// Newton steps allowed; four or five are usual.
const MAX_ITERATIONS: usize = 60;

/// A step this small, relative to the typical sizes, is the last: the next would be of the size of its square, or
/// of the error of the differences.
const LAST_STEP: f64 = 1e-9;

/// The shortest share of a Newton step that is tried.
const LEAST_SHARE: f64 = 1e-4;

/// A state that a constant input holds: f(x) + g(x) u = 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Equilibrium<const N: usize> {
    /// x_e.
    pub state: [f64; N],
    /// u_e.
    pub input: f64,
}

impl<const N: usize> Equilibrium<N> {
    /// All zero: a first guess.
    pub const ORIGIN: Self = Self { state: [0.0; N], input: 0.0 };
}

/// Finds the equilibrium at which one state has a wanted value: the other N − 1 states and the input are the N
/// unknowns of f(x) + g(x) u = 0.
///
/// Errors taken from this equilibrium ([`Target::rest`]) remove the steady-state error of the printed law, whose
/// target (θ_d, 0, 0, 0) is no equilibrium: with a stiffness at the hub the link rests deflected.
///
/// Newton's method with central differences. A step is halved until the next one, with the same derivatives, would
/// be shorter (the natural monotonicity test: P. Deuflhard, *Newton Methods for Nonlinear Problems*, Springer 2004,
/// section 3.3): the equations may be in any units.
///
/// ```
/// use greybox_smc::{Equilibrium, EquilibriumSolver};
/// // A motor θ carries a pendulum q by a spring of 40 N m/rad; gravity pulls with 8 N m at most.
/// let arm = |x: &[f64; 4], u: f64| {
///     let [theta, q, omega, rate] = *x;
///     let spring = 40.0 * (theta - q);
///     [omega, rate, 10.0 * (u - spring), spring - 8.0 * q.sin()]
/// };
/// let solver = EquilibriumSolver::new(1)?;
/// let held = solver.solve(arm, 0.5, &Equilibrium::ORIGIN)?;
/// assert!((held.input - 8.0 * 0.5_f64.sin()).abs() < 1e-9);
/// assert!((held.state[0] - (0.5 + held.input / 40.0)).abs() < 1e-9);
/// # Ok::<(), greybox_smc::SmcError>(())
/// ```
///
/// [`Target::rest`]: crate::Target::rest
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EquilibriumSolver<const N: usize> {
    pinned: usize,
    states: [f64; N],
    input: f64,
}

impl<const N: usize> EquilibriumSolver<N> {
    /// Pins a state (counted from 0); all typical sizes are 1.
    ///
    /// # Errors
    /// [`SmcError::PinnedState`].
    pub fn new(pinned: usize) -> Result<Self, SmcError> {
        if pinned < N {
            Ok(Self { pinned, states: [1.0; N], input: 1.0 })
        } else {
            Err(SmcError::PinnedState { state: pinned, states: N })
        }
    }

    /// The typical sizes of the states and of the input, where they are far from 1: differences are taken over some
    /// millionths of them, and convergence is measured by them.
    ///
    /// # Errors
    /// [`SmcError::TypicalSize`] for one that is not positive and finite.
    pub fn with_sizes(self, states: [f64; N], input: f64) -> Result<Self, SmcError> {
        for size in states.into_iter().chain([input]) {
            if !(size > 0.0 && size.is_finite()) {
                return Err(SmcError::TypicalSize { size });
            }
        }
        Ok(Self { states, input, ..self })
    }

    /// The equilibrium at which the pinned state is `value`. `model` returns f(x) + g(x) u, with a smooth friction
    /// or none: at rest both give the same.
    ///
    /// Where several exist, the one found is usually that of the `guess`: go from one value to the next.
    ///
    /// # Errors
    /// [`SmcError::NotFinite`] where the value, the guess or the model at the guess is not finite;
    /// [`SmcError::SingularEquilibrium`]; [`SmcError::NoEquilibrium`].
    pub fn solve(
        &self,
        mut model: impl FnMut(&[f64; N], f64) -> [f64; N],
        value: f64,
        guess: &Equilibrium<N>,
    ) -> Result<Equilibrium<N>, SmcError> {
        let p = self.pinned;
        // The unknowns: the states, with the input in the place of the pinned one.
        let mut unknowns = guess.state;
        unknowns[p] = guess.input;
        if !(value.is_finite() && unknowns.iter().all(|x| x.is_finite())) {
            return Err(SmcError::NotFinite { what: "the pinned value and the guess of the equilibrium" });
        }
        let mut sizes = self.states;
        sizes[p] = self.input;
        let equilibrium = |unknowns: &[f64; N]| {
            let mut state = *unknowns;
            state[p] = value;
            Equilibrium { state, input: unknowns[p] }
        };
        let mut residual = |unknowns: &[f64; N]| {
            let Equilibrium { state, input } = equilibrium(unknowns);
            model(&state, input).map(|r| -r)
        };
        let mut here = residual(&unknowns);
        if !here.iter().all(|r| r.is_finite()) {
            return Err(SmcError::NotFinite { what: "the model at the guess of the equilibrium" });
        }
        let mut last = f64::INFINITY;
        for iterations in 0..MAX_ITERATIONS {
            // Steps are counted in typical sizes, so that the columns are.
            let derivatives = differences(&mut residual, &unknowns, &sizes);
            let slope: Matrix<N> =
                core::array::from_fn(|i| core::array::from_fn(|j| -derivatives[i][j] * sizes[j]));
            let Some(step) = solve(&slope, &here) else {
                return Err(SmcError::SingularEquilibrium { value });
            };
            let length = relative_length(&step, &unknowns, &sizes);
            last = length;
            let along = |share: f64| core::array::from_fn(|j| unknowns[j] + share * step[j] * sizes[j]);
            if length <= LAST_STEP {
                return Ok(equilibrium(&along(1.0)));
            }
            let mut share = 1.0;
            loop {
                let next: [f64; N] = along(share);
                let there = residual(&next);
                // A residual that is not finite has no step, and is too far.
                let shorter = solve(&slope, &there).is_some_and(|step| {
                    relative_length(&step, &unknowns, &sizes) <= (1.0 - 0.25 * share) * length
                });
                if shorter {
                    (unknowns, here) = (next, there);
                    break;
                }
                share *= 0.5;
                if share < LEAST_SHARE {
                    return Err(SmcError::NoEquilibrium { value, iterations: iterations + 1, step: length });
                }
            }
        }
        Err(SmcError::NoEquilibrium { value, iterations: MAX_ITERATIONS, step: last })
    }

    /// The tangent of the model at an equilibrium, by central differences.
    ///
    /// `model` returns f(x) + g(x) u as in [`solve`](Self::solve). What is not smooth is not linearised: a
    /// smoothed friction gives its steep slope at rest.
    ///
    /// # Errors
    /// [`SmcError::NotFinite`] where the equilibrium or the model around it is not finite.
    pub fn tangent(
        &self,
        mut model: impl FnMut(&[f64; N], f64) -> [f64; N],
        at: &Equilibrium<N>,
    ) -> Result<Tangent<N>, SmcError> {
        let a = differences(&mut |x: &[f64; N]| model(x, at.input), &at.state, &self.states);
        let h = width(at.input, self.input);
        let (above, below) = (model(&at.state, at.input + h), model(&at.state, at.input - h));
        let b = core::array::from_fn(|i| (above[i] - below[i]) / (2.0 * h));
        let tangent = Tangent::new(a, b);
        tangent.check_finite("the model around the equilibrium")?;
        Ok(tangent)
    }
}

/// Half the width of a central difference at `x`, a power of two times the size: the best compromise between
/// rounding and curvature is near the cube root of the rounding error.
fn width(x: f64, size: f64) -> f64 {
    x.abs().max(size) * libm::exp2(-17.0)
}

/// ∂(function)ᵢ/∂xⱼ.
fn differences<const N: usize>(
    function: &mut impl FnMut(&[f64; N]) -> [f64; N],
    x: &[f64; N],
    sizes: &[f64; N],
) -> Matrix<N> {
    let mut slopes = [[0.0; N]; N];
    for j in 0..N {
        let h = width(x[j], sizes[j]);
        let (mut above, mut below) = (*x, *x);
        above[j] += h;
        below[j] -= h;
        let distance = above[j] - below[j];
        let (above, below) = (function(&above), function(&below));
        for i in 0..N {
            slopes[i][j] = (above[i] - below[i]) / distance;
        }
    }
    slopes
}

/// The largest entry of a step counted in typical sizes, or relative to the unknown where that is larger.
fn relative_length<const N: usize>(step: &[f64; N], unknowns: &[f64; N], sizes: &[f64; N]) -> f64 {
    let mut length = 0.0_f64;
    for j in 0..N {
        length = length.max(step[j].abs() * sizes[j] / unknowns[j].abs().max(sizes[j]));
    }
    length
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mass m on a spring k x + k₃ x³ with damping c, pushed by u.
    fn spring(x: &[f64; 2], u: f64) -> [f64; 2] {
        [x[1], (u - 3.0 * x[0] - 5.0 * x[0].powi(3) - 0.4 * x[1]) / 2.0]
    }

    #[test]
    fn the_input_that_holds_a_spring() {
        let solver = EquilibriumSolver::new(0).unwrap();
        for value in [-2.0, -0.3, 0.0, 0.7, 40.0] {
            let held = solver.solve(spring, value, &Equilibrium::ORIGIN).unwrap();
            let force = 3.0 * value + 5.0 * value.powi(3);
            assert!((held.input - force).abs() <= 1e-9 * force.abs().max(1.0), "{value}: {held:?}");
            assert_eq!((held.state[0], held.state[1].abs() < 1e-9), (value, true));
            let tangent = solver.tangent(spring, &held).unwrap();
            let exact = [[0.0, 1.0], [-(3.0 + 15.0 * value * value) / 2.0, -0.2]];
            for i in 0..2 {
                for j in 0..2 {
                    let size = exact[i][j].abs().max(1.0);
                    assert!((tangent.a[i][j] - exact[i][j]).abs() < 1e-6 * size, "{value}");
                }
                assert!((tangent.b[i] - [0.0, 0.5][i]).abs() < 1e-6 * value.abs().max(1.0).powi(3));
            }
        }
    }

    #[test]
    fn a_hard_start_is_damped() {
        // atan has a Newton step that overshoots ever more from |x| > 1.39.
        let model = |x: &[f64; 2], u: f64| [x[1], (20.0 * (u - x[0])).atan()];
        let solver = EquilibriumSolver::new(0).unwrap();
        let held = solver.solve(model, 0.5, &Equilibrium { state: [0.0; 2], input: -3.0 }).unwrap();
        assert!((held.input - 0.5).abs() < 1e-9);
        // A model that ends, as a square root does.
        let model = |x: &[f64; 1], u: f64| [u.sqrt() - 0.01 - x[0]];
        let solver = EquilibriumSolver::new(0).unwrap();
        let held = solver.solve(model, 0.04, &Equilibrium { state: [0.0], input: 1.0 }).unwrap();
        assert!((held.input - 0.0025).abs() < 1e-9);
    }

    #[test]
    fn small_units_need_typical_sizes_only() {
        // The spring in micrometres and mega-newtons.
        let model = |x: &[f64; 2], u: f64| {
            let [v, a] = spring(&[1e-6 * x[0], 1e-6 * x[1]], 1e6 * u);
            [1e6 * v, 1e6 * a]
        };
        let solver = EquilibriumSolver::new(0).unwrap().with_sizes([1e6, 1e6], 1e-6).unwrap();
        let held = solver.solve(model, 0.7e6, &Equilibrium::ORIGIN).unwrap();
        assert!((held.input * 1e6 / (2.1 + 5.0 * 0.343) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn what_has_no_equilibrium_is_said() {
        let solver = EquilibriumSolver::<2>::new(0).unwrap();
        let none = |x: &[f64; 2], u: f64| [x[1], u * u + 1.0 + x[0] * x[0]];
        let error = solver.solve(none, 0.3, &Equilibrium { state: [0.0; 2], input: 2.0 }).unwrap_err();
        assert!(
            matches!(error, SmcError::NoEquilibrium { .. } | SmcError::SingularEquilibrium { .. }),
            "{error:?}"
        );
        // The velocity cannot be held at a value.
        let moving = EquilibriumSolver::new(1).unwrap();
        let error = moving.solve(spring, 0.3, &Equilibrium::ORIGIN).unwrap_err();
        assert!(matches!(error, SmcError::SingularEquilibrium { .. }), "{error:?}");
        assert_eq!(EquilibriumSolver::<2>::new(2), Err(SmcError::PinnedState { state: 2, states: 2 }));
        for size in [0.0, -1.0, f64::NAN] {
            assert!(matches!(solver.with_sizes([1.0, size], 1.0), Err(SmcError::TypicalSize { .. })));
            assert!(matches!(solver.with_sizes([1.0, 1.0], size), Err(SmcError::TypicalSize { .. })));
        }
        assert!(matches!(
            solver.solve(spring, f64::NAN, &Equilibrium::ORIGIN),
            Err(SmcError::NotFinite { .. })
        ));
        let broken = |_: &[f64; 2], _: f64| [0.0, f64::NAN];
        assert!(matches!(solver.solve(broken, 0.1, &Equilibrium::ORIGIN), Err(SmcError::NotFinite { .. })));
        assert!(solver.tangent(broken, &Equilibrium::ORIGIN).is_err());
    }
}
