//! Where an observer starts at a machine that rests under a held command.

use nalgebra::DMatrix;

use crate::check::Check;
use crate::equilibrium::{LAST_STEP, LEAST_CONDITION};
use crate::plant::Plant;

/// Most steps of the iteration; a linear plant takes one.
const MOST_STEPS: usize = 50;
/// The last step, counted in the stated sizes, at most this long where a state of rest was found.
const CLOSE: f64 = 1e-6;

/// The state of rest and the disturbance that belong to measurements y of a machine under a held command u. Of the states that
/// the disturbance d can hold, it is the one nearest to what is measured,
///
/// ```text
/// f(x) + g(x) (u + d) = 0,    Σ ((y − C x)/σ)² least
/// ```
///
/// σ those of the sensors; what neither determines stays at the design point, as far as it can, in the stated sizes. It is found from the
/// design point (x₀, u₀ − u) by a simplified Newton method, whose matrix is that of the design point,
///
/// ```text
/// (x, d) ← (x, d) − P (f(x) + g(x) (u + d), C x − y)
/// P = [(I − N (G N)⁺ G) E⁺,  N (G N)⁺],    E = [A b],  G = C/σ,  N the null space of E
/// ```
///
/// (P. Deuflhard, *Newton Methods for Nonlinear Problems*, Springer 2004, section 2.1; least squares with equations that hold:
/// G. H. Golub and C. F. Van Loan, *Matrix Computations*, 4th edition, 2013, section 6.2). For a linear plant the first step is
/// the answer.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// x₀ and u₀ of the design point.
    pub point: Vec<f64>,
    /// The stated sizes of the states and of the command.
    pub sizes: Vec<f64>,
    /// P, row by row: (n + 1) rows of n and as many entries as there are measurements.
    pub matrix: Vec<Vec<f64>>,
    /// Most steps.
    pub most_steps: usize,
    /// A step this small, counted in the sizes, is the last.
    pub last_step: f64,
    /// The iteration found a state of rest where its last step is at most this, counted in the sizes.
    pub close: f64,
}

impl Start {
    /// None where a number is not finite. `deviations` are those of the sensors.
    pub(super) fn design(
        plant: &Plant,
        point: &Check,
        measured: &[usize],
        deviations: &[f64],
    ) -> Option<Start> {
        let (n, m, at) = (plant.order(), measured.len(), &point.equilibrium);
        let tangent = plant.frictionless_tangent(&at.state, at.input);
        let mut sizes = plant.sizes().to_vec();
        sizes.push(plant.input_size());
        let entry = |i: usize, j: usize| sizes[j] * if j == n { tangent.b[i] } else { tangent.a[(i, j)] };
        let balance = DMatrix::from_fn(n, n + 1, entry);
        let read =
            DMatrix::from_fn(m, n + 1, |k, j| if measured[k] == j { sizes[j] / deviations[k] } else { 0.0 });
        if !balance.iter().chain(read.iter()).all(|v| v.is_finite()) {
            return None;
        }
        let rows: Vec<f64> = balance.row_iter().map(|row| row.amax()).collect();
        let rows: Vec<f64> = rows.iter().map(|size| if *size > 0.0 { *size } else { 1.0 }).collect();
        let scaled = DMatrix::from_fn(n, n + 1, |i, j| balance[(i, j)] / rows[i]);
        let (held, free) = inverse_and_null_space(&scaled)?;
        let fitted = &free * inverse_and_null_space(&(&read * &free))?.0;
        let kept = &held - &fitted * (&read * &held);
        let matrix = (0..=n).map(|i| {
            let balanced = (0..n).map(|j| kept[(i, j)] / rows[j]);
            let seen = (0..m).map(|k| fitted[(i, k)] / deviations[k]);
            balanced.chain(seen).map(|v| v * sizes[i]).collect()
        });
        let matrix: Vec<Vec<f64>> = matrix.collect();
        if !matrix.iter().flatten().all(|v| v.is_finite()) {
            return None;
        }
        let mut point = at.state.clone();
        point.push(at.input);
        Some(Start { point, sizes, matrix, most_steps: MOST_STEPS, last_step: LAST_STEP, close: CLOSE })
    }

    /// x and d of measurements under a command (behind the dead zone); none where no state of rest is found.
    pub(super) fn at(&self, plant: &Plant, measured: &[usize], y: &[f64], u: f64) -> Option<Vec<f64>> {
        let n = plant.order();
        let mut found = self.point.clone();
        found[n] -= u;
        let mut last = f64::INFINITY;
        for _ in 0..self.most_steps {
            let mut off = plant.frictionless_rate(&found[..n], u + found[n]);
            off.extend(measured.iter().zip(y).map(|(&i, y)| found[i] - y));
            let step: Vec<f64> =
                self.matrix.iter().map(|row| row.iter().zip(&off).map(|(p, off)| p * off).sum()).collect();
            let squares = step.iter().zip(&self.sizes).map(|(step, size)| (step / size).powi(2));
            let length = squares.sum::<f64>().sqrt();
            // What rounding leaves does not get shorter; nor does what strays. (Nor what is not a number.)
            if length.is_nan() || length >= last {
                break;
            }
            found.iter_mut().zip(&step).for_each(|(z, step)| *z -= step);
            last = length;
            if length <= self.last_step {
                break;
            }
        }
        (last <= self.close && found.iter().all(|z| z.is_finite())).then_some(found)
    }
}

/// The pseudo-inverse of a matrix and an orthonormal basis of its null space, by singular values.
fn inverse_and_null_space(matrix: &DMatrix<f64>) -> Option<(DMatrix<f64>, DMatrix<f64>)> {
    let (rows, columns) = matrix.shape();
    if columns == 0 {
        return Some((DMatrix::zeros(0, rows), DMatrix::zeros(0, 0)));
    }
    // Rows of zeros complete the right singular vectors.
    let whole = matrix.clone().resize(rows.max(columns), columns, 0.0);
    let svd = whole.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?.transpose());
    let least = LEAST_CONDITION * svd.singular_values.max();
    let mut inverse = DMatrix::zeros(columns, rows);
    let mut null = Vec::new();
    for (k, value) in svd.singular_values.iter().enumerate() {
        if *value > least {
            inverse += v.column(k) * u.column(k).rows(0, rows).transpose() / *value;
        } else {
            null.push(v.column(k).into_owned());
        }
    }
    let null = if null.is_empty() { DMatrix::zeros(columns, 0) } else { DMatrix::from_columns(&null) };
    Some((inverse, null))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pseudo_inverse_and_the_null_space_are_those_of_the_matrix() {
        let check = |matrix: &DMatrix<f64>, nullity: usize| {
            let (inverse, null) = inverse_and_null_space(matrix).unwrap();
            assert_eq!((inverse.shape(), null.ncols()), ((matrix.ncols(), matrix.nrows()), nullity));
            assert!((matrix * &inverse * matrix - matrix).amax() < 1e-12 * matrix.amax().max(1.0));
            assert!((&inverse * matrix * &inverse - &inverse).amax() < 1e-12 * inverse.amax().max(1.0));
            assert!((matrix * &null).iter().all(|v| v.abs() < 1e-12 * matrix.amax().max(1.0)));
            assert!(
                (null.transpose() * &null - DMatrix::identity(nullity, nullity))
                    .iter()
                    .all(|v| v.abs() < 1e-12)
            );
        };
        check(&DMatrix::from_row_slice(2, 3, &[1.0, 2.0, 3.0, 0.0, 1.0, -1.0]), 1);
        check(&DMatrix::from_row_slice(2, 3, &[1.0, 2.0, 3.0, 2.0, 4.0, 6.0]), 2);
        check(&DMatrix::from_row_slice(3, 2, &[1.0, 2.0, 3.0, 5.0, 4.0, 6.0]), 0);
        check(&DMatrix::zeros(2, 2), 2);
        check(&DMatrix::zeros(2, 0), 0);
    }

    /// P is a left inverse of the equations of rest and of what is measured, also where two sensors measure more than they must:
    /// a linear plant takes one step.
    #[test]
    fn the_matrix_inverts_the_tangent() {
        let model = greybox_model::Model::from_toml(
            r#"
[inputs]
v = { unit = "V" }
[states]
q = { unit = "rad" }
p = { unit = "rad" }
[parameters]
Jm = { value = 0.004, unit = "kg m^2" }
Jl = { value = 0.01, unit = "kg m^2" }
b = { value = 0.05, unit = "N m s/rad" }
k = { value = 4.0, unit = "N m/rad" }
mgl = { value = 0.3, unit = "N m" }
kt = { value = 0.4, unit = "N m/V" }
[equations]
motor = "Jm*q'' + b*q' + k*(q - p) = kt*v"
link = "Jl*p'' + k*(p - q) + mgl*p = 0"
"#,
            "joint.toml",
        )
        .unwrap();
        let plant = Plant::of(&model, "v", &crate::PlantOptions::default()).unwrap();
        let options = crate::DesignOptions::new("p", &[0.1, 0.5], 1e-3);
        let law = crate::design(&plant, &crate::Method::Lqr, &options).unwrap();
        let at = &law.design_point().equilibrium;
        let tangent = plant.frictionless_tangent(&at.state, at.input);
        for measured in [&[0][..], &[2], &[0, 2]] {
            let deviations = &[1e-3, 3e-3][..measured.len()];
            let start = Start::design(&plant, law.design_point(), measured, deviations).unwrap();
            let equations = DMatrix::from_fn(4 + measured.len(), 5, |i, j| match (i.checked_sub(4), j) {
                (None, 4) => tangent.b[i],
                (None, j) => tangent.a[(i, j)],
                (Some(k), j) => f64::from(u8::from(measured[k] == j)),
            });
            let matrix = DMatrix::from_fn(5, equations.nrows(), |i, j| start.matrix[i][j]);
            let off =
                (matrix * equations - DMatrix::identity(5, 5)).iter().fold(0.0f64, |m, v| m.max(v.abs()));
            assert!(off < 1e-9, "{measured:?}: {off}");
            assert_eq!(start.point[..4], at.state);
        }
    }
}
