//! Where the plant rests with a wanted value of one state, and with which input.

use nalgebra::{DMatrix, DVector};

use crate::error::ControlError;
use crate::plant::Plant;

/// Newton steps allowed; four or five are usual.
const MOST_STEPS: usize = 60;
/// A step this small, counted in the stated sizes, is the last.
pub(crate) const LAST_STEP: f64 = 1e-10;
/// The shortest share of a Newton step that is tried.
const LEAST_SHARE: f64 = 1e-4;
/// Reciprocal condition, rows and columns scaled, below which the equations do not determine the unknowns.
pub(crate) const LEAST_CONDITION: f64 = 1e-12;

/// A state that a constant input holds: f(x) + g(x) u = 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Equilibrium {
    /// x_e.
    pub state: Vec<f64>,
    /// u_e.
    pub input: f64,
}

impl Equilibrium {
    /// All zero: a first guess.
    #[must_use]
    pub fn origin(states: usize) -> Equilibrium {
        Equilibrium { state: vec![0.0; states], input: 0.0 }
    }
}

/// The equilibrium at which the state of index `tracked` is `value`: the other n − 1 states and the input are the n
/// unknowns of f(x) + g(x) u = 0, with Coulomb friction dropped (at rest it holds a whole interval of them; this is
/// the middle one).
///
/// Newton's method with exact derivatives. A step is halved until the next one, with the same derivatives, would be
/// shorter (the natural monotonicity test: P. Deuflhard, *Newton Methods for Nonlinear Problems*, Springer 2004,
/// section 3.3), so that units play no part. Where several exist, the one found is usually that of the `guess`.
///
/// ```
/// use greybox_control::{Equilibrium, Plant, PlantOptions, equilibrium};
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
/// let held = equilibrium(&plant, 0, 1.2, &Equilibrium::origin(2))?;
/// assert_eq!(held.state, [1.2, 0.0]);
/// assert!((held.input - 0.5 * 1.2f64.sin()).abs() < 1e-12);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`ControlError::SingularEquilibrium`] with the state that is not determined, [`ControlError::NoEquilibrium`],
/// [`ControlError::NotFinite`], [`ControlError::Size`], [`ControlError::Option`] for a value that is not finite.
pub fn equilibrium(
    plant: &Plant,
    tracked: usize,
    value: f64,
    guess: &Equilibrium,
) -> Result<Equilibrium, ControlError> {
    let n = plant.order();
    let names = plant.state_names();
    let Some(name) = names.get(tracked) else {
        return Err(ControlError::Size { what: "the index of the tracked state", found: tracked, wanted: n });
    };
    if guess.state.len() != n {
        return Err(ControlError::Size { what: "the guess of a state", found: guess.state.len(), wanted: n });
    }
    if !value.is_finite() {
        let what = format!("the wanted value of `{name}`");
        return Err(ControlError::Option { what, value, wanted: "a finite number" });
    }
    // The unknowns, counted in their sizes: the states, with the input in the place of the tracked one.
    let mut sizes = plant.sizes().to_vec();
    sizes[tracked] = plant.input_size();
    let at = |unknowns: &[f64]| {
        let mut state: Vec<f64> = unknowns.iter().zip(&sizes).map(|(y, s)| y * s).collect();
        let input = std::mem::replace(&mut state[tracked], value);
        Equilibrium { state, input }
    };
    let residual = |unknowns: &[f64]| {
        let Equilibrium { state, input } = at(unknowns);
        DVector::from(plant.frictionless_rate(&state, input))
    };
    let mut unknowns: Vec<f64> = guess.state.iter().zip(&sizes).map(|(x, s)| x / s).collect();
    unknowns[tracked] = guess.input / sizes[tracked];
    let mut here = residual(&unknowns);
    let mut last = f64::INFINITY;
    for _ in 0..MOST_STEPS {
        let point = at(&unknowns);
        let tangent = plant.frictionless_tangent(&point.state, point.input);
        let slope = DMatrix::from_fn(n, n, |i, j| {
            sizes[j] * if j == tracked { tangent.b[i] } else { tangent.a[(i, j)] }
        });
        if !slope.iter().chain(here.iter()).all(|v| v.is_finite()) {
            return Err(ControlError::NotFinite { state: point.state });
        }
        let newton = Newton::of(slope).map_err(|column| {
            let by = match column {
                Some(j) if j == tracked => {
                    format!(" (the input `{}` does not act on it)", plant.input_name())
                }
                Some(j) => format!(" (that of `{}` is not)", names[j]),
                None => String::new(),
            };
            ControlError::SingularEquilibrium { tracked: name.clone(), value, by }
        })?;
        let step = newton.step(&here);
        let length = relative(&step, &unknowns);
        last = length;
        let along = |share: f64| -> Vec<f64> {
            unknowns.iter().zip(step.iter()).map(|(y, s)| y + share * s).collect()
        };
        if length <= LAST_STEP {
            return Ok(at(&along(1.0)));
        }
        let mut share = 1.0;
        loop {
            let next = along(share);
            let there = residual(&next);
            let finite = there.iter().all(|r| r.is_finite());
            if finite && relative(&newton.step(&there), &unknowns) <= (1.0 - 0.25 * share) * length {
                (unknowns, here) = (next, there);
                break;
            }
            share *= 0.5;
            if share < LEAST_SHARE {
                return Err(ControlError::NoEquilibrium { tracked: name.clone(), value, step: length });
            }
        }
    }
    Err(ControlError::NoEquilibrium { tracked: name.clone(), value, step: last })
}

/// What the derivatives of a moving reference add to an equilibrium of the tangent ẋ = A x + B u: X₀, X₁, … and U₀, U₁, … of
/// x_d = Σ Xₖ r⁽ᵏ⁾, u_d = Σ Uₖ r⁽ᵏ⁾, from A X₀ + B U₀ = 0 with a tracked entry of one, and
///
/// ```text
/// A Xₖ + B Uₖ = Xₖ₋₁        with a tracked entry of zero
/// ```
///
/// # Errors
/// [`ControlError::SingularEquilibrium`].
pub(crate) fn along(
    plant: &Plant,
    tracked: usize,
    at: &Equilibrium,
    derivatives: usize,
) -> Result<Vec<Equilibrium>, ControlError> {
    let n = plant.order();
    let mut sizes = plant.sizes().to_vec();
    sizes[tracked] = plant.input_size();
    let tangent = plant.frictionless_tangent(&at.state, at.input);
    let slope =
        DMatrix::from_fn(n, n, |i, j| sizes[j] * if j == tracked { tangent.b[i] } else { tangent.a[(i, j)] });
    let name = plant.state_names().swap_remove(tracked);
    let newton = Newton::of(slope).map_err(|_| ControlError::SingularEquilibrium {
        tracked: name,
        value: at.state[tracked],
        by: String::new(),
    })?;
    let mut found: Vec<Equilibrium> = Vec::with_capacity(derivatives + 1);
    for k in 0..=derivatives {
        let right = match found.last() {
            None => tangent.a.column(tracked).into_owned(),
            Some(before) => -DVector::from_column_slice(&before.state),
        };
        let unknowns = newton.step(&right);
        let mut state: Vec<f64> = unknowns.iter().zip(&sizes).map(|(y, s)| y * s).collect();
        let input = std::mem::replace(&mut state[tracked], if k == 0 { 1.0 } else { 0.0 });
        found.push(Equilibrium { state, input });
    }
    Ok(found)
}

/// Rows scaled and factored.
struct Newton {
    rows: Vec<f64>,
    lu: nalgebra::LU<f64, nalgebra::Dyn, nalgebra::Dyn>,
}

impl Newton {
    /// `Err` with the unknown that the equations say least about.
    fn of(mut slope: DMatrix<f64>) -> Result<Newton, Option<usize>> {
        let n = slope.nrows();
        if let Some(j) = (0..n).find(|&j| slope.column(j).amax() == 0.0) {
            return Err(Some(j));
        }
        let rows: Vec<f64> = (0..n).map(|i| slope.row(i).amax()).collect();
        for (i, row) in rows.iter().enumerate() {
            if *row == 0.0 {
                return Err(None);
            }
            slope.row_mut(i).scale_mut(1.0 / row);
        }
        let mut scaled = slope.clone();
        for j in 0..n {
            let size = scaled.column(j).amax();
            scaled.column_mut(j).scale_mut(1.0 / size);
        }
        let svd = scaled.svd(false, true);
        let (small, large) = (svd.singular_values.min(), svd.singular_values.max());
        if small.is_nan() || small <= LEAST_CONDITION * large {
            let row = svd.v_t.map(|v| v.row(svd.singular_values.imin()).transpose());
            return Err(row.map(|v| v.iamax()));
        }
        Ok(Newton { rows, lu: slope.lu() })
    }

    fn step(&self, residual: &DVector<f64>) -> DVector<f64> {
        let scaled = DVector::from_fn(residual.len(), |i, _| -residual[i] / self.rows[i]);
        self.lu.solve(&scaled).unwrap_or_else(|| DVector::repeat(residual.len(), f64::NAN))
    }
}

/// The largest entry of a step, or relative to the unknown where that is larger.
fn relative(step: &DVector<f64>, unknowns: &[f64]) -> f64 {
    // Not `f64::max`: a step that is not a number has no length.
    step.iter()
        .zip(unknowns)
        .map(|(s, y)| s.abs() / y.abs().max(1.0))
        .fold(0.0, |m, l| if l > m || l.is_nan() { l } else { m })
}
