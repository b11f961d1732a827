//! Poles of linear loops, continuous and with a held command.

use greybox_hjb::{Linear, eigenvalues};
use greybox_smc::check::Pole;
use nalgebra::DMatrix;

/// Eigenvalues, the rightmost first; `None` where a number is not finite or the iteration does not end. `sizes` are
/// those of the states: they balance the matrix.
pub(crate) fn poles(a: &DMatrix<f64>, sizes: &[f64]) -> Option<Vec<Pole>> {
    let n = a.nrows();
    let balanced = DMatrix::from_fn(n, n, |i, j| a[(i, j)] / sizes[i] * sizes[j]);
    let mut poles: Vec<Pole> = eigenvalues(&balanced)?.iter().map(|z| Pole { re: z.re, im: z.im }).collect();
    if !poles.iter().all(|p| p.re.is_finite() && p.im.is_finite()) {
        return None;
    }
    poles.sort_by(|a, b| b.re.total_cmp(&a.re).then(b.im.total_cmp(&a.im)));
    Some(poles)
}

/// The plant over one sample of the command held: Φ = e^{A dt}, Γ = ∫ e^{Aτ} dτ b, by the exponential of
/// \[A b; 0 0\] dt.
pub(crate) fn held(plant: &Linear, dt: f64, sizes: &[f64], input_size: f64) -> Option<Linear> {
    let n = plant.a.nrows();
    let mut both = DMatrix::zeros(n + 1, n + 1);
    for i in 0..n {
        for j in 0..n {
            both[(i, j)] = plant.a[(i, j)] / sizes[i] * sizes[j] * dt;
        }
        both[(i, n)] = plant.b[i] / sizes[i] * input_size * dt;
    }
    if !both.iter().all(|v| v.is_finite()) {
        return None;
    }
    let e = both.exp();
    let a = DMatrix::from_fn(n, n, |i, j| e[(i, j)] * sizes[i] / sizes[j]);
    let b = DMatrix::from_fn(n, 1, |i, _| e[(i, n)] * sizes[i] / input_size);
    (a.iter().chain(b.iter()).all(|v| v.is_finite())).then_some(Linear { a, b })
}

/// The loop of a plant and a feedback u = k x, one row.
pub(crate) fn closed(plant: &Linear, feedback: &DMatrix<f64>) -> DMatrix<f64> {
    &plant.a + &plant.b * feedback
}
