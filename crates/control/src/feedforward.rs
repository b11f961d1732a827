//! The equilibrium as a function of the set point, as an expression.

use greybox_model::{Expr, Func};
use nalgebra::{DMatrix, DVector};

use crate::equilibrium::{Equilibrium, along, equilibrium};
use crate::error::ControlError;
use crate::plant::Plant;

/// Intervals of the range of set points at whose ends equilibria are computed.
const INTERVALS: usize = 80;
/// Highest degree of the polynomials.
const MOST_DEGREES: usize = 9;
/// Error of a polynomial, in the stated sizes, with which its degree is high enough.
const GOOD: f64 = 1e-7;
/// Part of a state or the input, in its size and at the fastest rate of the plant, below which what a derivative of the reference
/// adds is rounding.
const ROUNDING: f64 = 1e-9;
/// Error above which a broken line is tried.
const POOR: f64 = 1e-5;

/// x_e(r) and u_e(r) over a range of set points.
///
/// ```
/// use greybox_control::{Equilibrium, FeedForward, Plant, PlantOptions};
/// # let model = greybox_model::Model::from_toml(r#"
/// # [inputs]
/// # tau = { unit = "N m" }
/// # [states]
/// # theta = { unit = "rad" }
/// # [parameters]
/// # J = { value = 0.02, unit = "kg m^2" }
/// # mgl = { value = 0.5, unit = "N m" }
/// # [equations]
/// # arm = "J*theta'' + mgl*sin(theta) = tau"
/// # "#, "pendulum.toml")?;
/// let plant = Plant::of(&model, "tau", &PlantOptions::default())?;
/// let held = FeedForward::new(&plant, 0, (-1.0, 1.0), &Equilibrium::origin(2), "r")?;
/// let torque = held.input.eval(&|name, _| (name == "r").then_some(0.7)).ok_or("a name is missing")?;
/// assert!((torque - 0.5 * 0.7f64.sin()).abs() < 1e-7 && held.input_error < 1e-7);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct FeedForward {
    /// The range; outside of it the set point is taken to be the nearer end.
    pub range: (f64, f64),
    /// Equilibria on an even grid of the range, ends included: what the expressions were fitted to.
    pub equilibria: Vec<Equilibrium>,
    /// x_e(r), an expression for each state.
    pub state: Vec<Expr>,
    /// u_e(r).
    pub input: Expr,
    /// The set point within the range.
    pub held: Expr,
    /// Largest error of each x_e(r) on the grid, in the state's unit.
    pub state_error: Vec<f64>,
    /// Largest error of u_e(r) on the grid, in the input's unit.
    pub input_error: f64,
}

impl FeedForward {
    /// Equilibria of the plant over `range`, found from the middle outwards starting at `guess`, each fitted by the
    /// polynomial of least degree (nine at most) that is within 1e-7 of the stated size, or by a line broken at
    /// forty points where that is nearer (a stop or a dead zone). `reference` names the set point.
    ///
    /// # Errors
    /// All of [`equilibrium`]; [`ControlError::Option`] for a range that is none.
    pub fn new(
        plant: &Plant,
        tracked: usize,
        range: (f64, f64),
        guess: &Equilibrium,
        reference: &str,
    ) -> Result<FeedForward, ControlError> {
        let (low, high) = range;
        if !(low.is_finite() && high.is_finite() && low <= high) {
            let what = "the width of the range of set points".to_owned();
            return Err(ControlError::Option {
                what,
                value: high - low,
                wanted: "a finite number, zero or more",
            });
        }
        let n = plant.order();
        let r = Expr::var(reference);
        let intervals = if low < high { INTERVALS } else { 0 };
        let value = |k: usize| {
            if intervals == 0 { low } else { low + (high - low) * k as f64 / intervals as f64 }
        };
        let middle = intervals / 2;
        let start = equilibrium(plant, tracked, value(middle), guess)?;
        let mut equilibria = vec![start; intervals + 1];
        for k in middle + 1..=intervals {
            equilibria[k] = equilibrium(plant, tracked, value(k), &equilibria[k - 1])?;
        }
        for k in (0..middle).rev() {
            equilibria[k] = equilibrium(plant, tracked, value(k), &equilibria[k + 1])?;
        }
        let held = if intervals == 0 {
            Expr::Num(low)
        } else {
            Expr::call(Func::Min, vec![Expr::call(Func::Max, vec![r, Expr::Num(low)]), Expr::Num(high)])
        };
        let mut this = FeedForward {
            range,
            equilibria,
            state: Vec::with_capacity(n),
            input: Expr::Num(0.0),
            held,
            state_error: Vec::with_capacity(n),
            input_error: 0.0,
        };
        for i in 0..n {
            let values: Vec<f64> = this.equilibria.iter().map(|e| e.state[i]).collect();
            let tracks = i == tracked;
            let (e, error) =
                if tracks { (this.held.clone(), 0.0) } else { this.curve(&values, plant.sizes()[i]) };
            this.state.push(e);
            this.state_error.push(error);
        }
        let values: Vec<f64> = this.equilibria.iter().map(|e| e.input).collect();
        (this.input, this.input_error) = this.curve(&values, plant.input_size());
        Ok(this)
    }

    /// Where the plant is to be. With `trajectories`, at every equilibrium of the grid what r′ and r″ add is computed and
    /// fitted as the equilibria are.
    ///
    /// # Errors
    /// [`ControlError::SingularEquilibrium`].
    pub(crate) fn target(
        &self,
        plant: &Plant,
        tracked: usize,
        reference: &str,
        trajectories: bool,
    ) -> Result<Target, ControlError> {
        let n = plant.order();
        let mut target =
            Target { state: self.state.clone(), input: self.input.clone(), rate: vec![Expr::Num(0.0); n] };
        if !trajectories {
            return Ok(target);
        }
        let all = self.equilibria.iter().map(|at| along(plant, tracked, at, 2));
        let all = all.collect::<Result<Vec<_>, _>>()?;
        let fastest = fastest(plant, &self.equilibria[self.equilibria.len() / 2]);
        // Column n is the input.
        let part = |k: usize, i: usize| -> Expr {
            let of = |at: &Equilibrium| at.state.get(i).copied().unwrap_or(at.input);
            let values: Vec<f64> = all.iter().map(|at| of(&at[k])).collect();
            let largest = values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let size = plant.sizes().get(i).copied().unwrap_or_else(|| plant.input_size());
            if largest * fastest.powi(k as i32) * plant.sizes()[tracked] <= ROUNDING * size {
                return Expr::Num(0.0);
            }
            self.curve(&values, largest).0
        };
        let derivative = |k: usize| Expr::prime(reference, k as u8);
        let add = |sum: &mut Expr, k: usize, i: usize, times: usize| {
            *sum = (sum.clone() + part(k, i) * derivative(times)).simplify();
        };
        for k in 1..=2 {
            for i in 0..n {
                add(&mut target.state[i], k, i, k);
                add(&mut target.rate[i], k - 1, i, k);
            }
            add(&mut target.input, k, n, k);
        }
        Ok(target)
    }

    /// An expression of the set point through values at the equilibria, and its largest error.
    pub(crate) fn curve(&self, values: &[f64], size: f64) -> (Expr, f64) {
        let (low, high) = self.range;
        if values.len() < 2 {
            return (Expr::Num(values.first().copied().unwrap_or(0.0)), 0.0);
        }
        let shifted = (self.held.clone() - Expr::Num(0.5 * (low + high))).simplify();
        curve(values, size, &(shifted / Expr::Num(0.5 * (high - low))))
    }
}

/// Where the plant is to be while the reference moves,
///
/// ```text
/// x_d = x_e(r) + X₁(r) r′ + X₂(r) r″,    u_d = u_e(r) + U₁(r) r′ + U₂(r) r″,    ẋ_d = X₀(r) r′ + X₁(r) r″
/// ```
///
/// the solution of the regulator equations of the tangent at x_e(r) for a reference whose third derivative is zero (B. A.
/// Francis, SIAM J. Control Optim. 15(3), 1977; A. Isidori and C. I. Byrnes, IEEE Trans. Autom. Control 35(2), 1990): along
/// such a reference a linear plant is tracked without an error. Of an arm with linear friction the series ends there, so that any smooth
/// reference is; elsewhere what is left is of the order of r‴ and of r′². No inverse of the plant is needed, so that one whose zeros are
/// unstable is tracked too. Without trajectories it is x_e(r), u_e(r), and ẋ_d zero.
#[derive(Debug, Clone, PartialEq)]
pub struct Target {
    /// x_d, an expression for each state.
    pub state: Vec<Expr>,
    /// u_d.
    pub input: Expr,
    /// ẋ_d.
    pub rate: Vec<Expr>,
}

/// A bound of the poles of the plant, 1/s: the largest row sum of A with the states counted in their sizes.
fn fastest(plant: &Plant, at: &Equilibrium) -> f64 {
    let (tangent, sizes) = (plant.frictionless_tangent(&at.state, at.input), plant.sizes());
    let row = |i: usize| (0..sizes.len()).map(|j| (tangent.a[(i, j)] * sizes[j] / sizes[i]).abs()).sum();
    (0..sizes.len()).map(row).fold(0.0, f64::max)
}

/// A curve through values on an even grid of s ∈ [−1, 1], and its largest error. Fitted to every other one.
fn curve(values: &[f64], size: f64, s: &Expr) -> (Expr, f64) {
    let last = values.len() - 1;
    let at = |k: usize| 2.0 * k as f64 / last as f64 - 1.0;
    let mut best: (Vec<f64>, f64) = (vec![0.0], f64::INFINITY);
    for degree in 0..=MOST_DEGREES {
        let rows = last / 2 + 1;
        let basis = DMatrix::from_fn(rows, degree + 1, |i, d| at(2 * i).powi(d as i32));
        let right = DVector::from_fn(rows, |i, _| values[2 * i]);
        let Ok(mut fitted) = basis.svd(true, true).solve(&right, 1e-14) else { continue };
        // What is rounding is not written down.
        fitted.iter_mut().filter(|c| c.abs() < 1e-13 * size).for_each(|c| *c = 0.0);
        let value = |s: f64| fitted.iter().rev().fold(0.0, |sum, c| sum * s + c);
        let error = (0..=last).map(|k| (value(at(k)) - values[k]).abs()).fold(0.0, f64::max);
        if error < 0.9 * best.1 {
            best = (fitted.iter().copied().collect(), error);
        }
        if best.1 <= GOOD * size {
            break;
        }
    }
    if best.1 > POOR * size {
        let knots: Vec<(f64, f64)> = (0..=last / 2).map(|i| (at(2 * i), values[2 * i])).collect();
        let between = |k: usize| 0.5 * (values[k - 1] + values[k + 1]);
        let error = (1..last).step_by(2).map(|k| (between(k) - values[k]).abs()).fold(0.0, f64::max);
        if error < best.1 {
            return (broken_line(&knots, s), error);
        }
    }
    let horner = best.0.iter().rev().fold(Expr::Num(0.0), |sum, c| sum * s.clone() + Expr::Num(*c));
    (horner.simplify(), best.1)
}

/// y₀ + m₀ (s − s₀) + Σ (mₖ − mₖ₋₁) max(s − sₖ, 0).
fn broken_line(knots: &[(f64, f64)], s: &Expr) -> Expr {
    let slopes: Vec<f64> = knots.windows(2).map(|w| (w[1].1 - w[0].1) / (w[1].0 - w[0].0)).collect();
    let steepest = slopes.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let mut sum = Expr::Num(knots[0].1) + Expr::Num(slopes[0]) * (s.clone() - Expr::Num(knots[0].0));
    for (k, change) in slopes.windows(2).map(|w| w[1] - w[0]).enumerate() {
        if change.abs() > 1e-13 * steepest {
            let past = s.clone() - Expr::Num(knots[k + 1].0);
            sum = sum + Expr::Num(change) * Expr::call(Func::Max, vec![past, Expr::Num(0.0)]);
        }
    }
    sum.simplify()
}
