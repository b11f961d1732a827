//! Control-affine plants ẋ = f(x) + g(x) u (thesis Eq 4.1).

use nalgebra::DMatrix;

/// A plant that is affine in its inputs.
pub trait Plant {
    /// Number of states n.
    fn states(&self) -> usize;

    /// Number of inputs m.
    fn inputs(&self) -> usize;

    /// f(x), n values.
    fn drift(&self, x: &[f64], f: &mut [f64]);

    /// g(x), n × m by columns: `g[j*n + i]` is what input j does to state i.
    fn input(&self, x: &[f64], g: &mut [f64]);
}

/// ẋ = A x + B u; B must have as many rows as A, or its input is not a number.
#[derive(Debug, Clone, PartialEq)]
pub struct Linear {
    /// A, n × n.
    pub a: DMatrix<f64>,
    /// B, n × m.
    pub b: DMatrix<f64>,
}

impl Plant for Linear {
    fn states(&self) -> usize {
        self.a.nrows()
    }

    fn inputs(&self) -> usize {
        self.b.ncols()
    }

    fn drift(&self, x: &[f64], f: &mut [f64]) {
        for (i, f) in f.iter_mut().enumerate() {
            *f = self.a.row(i).iter().zip(x).map(|(a, x)| a * x).sum();
        }
    }

    fn input(&self, _: &[f64], g: &mut [f64]) {
        // Where A and B are not of one system there is no number, which every user of a plant looks for.
        let fits = self.b.len() == g.len();
        for (i, g) in g.iter_mut().enumerate() {
            *g = if fits { self.b.as_slice()[i] } else { f64::NAN };
        }
    }
}

/// A plant from two functions.
///
/// ```
/// use greybox_hjb::{Affine, Plant};
/// // A pendulum: θ″ = −sin θ + u.
/// let pendulum = Affine {
///     states: 2,
///     inputs: 1,
///     drift: |x: &[f64], f: &mut [f64]| f.copy_from_slice(&[x[1], -x[0].sin()]),
///     input: |_: &[f64], g: &mut [f64]| g.copy_from_slice(&[0.0, 1.0]),
/// };
/// let mut f = [0.0; 2];
/// pendulum.drift(&[0.0, 2.0], &mut f);
/// assert_eq!(f, [2.0, 0.0]);
/// ```
#[derive(Debug, Clone, Copy)]
pub struct Affine<F, G> {
    /// n.
    pub states: usize,
    /// m.
    pub inputs: usize,
    /// (x, f): writes f(x).
    pub drift: F,
    /// (x, g): writes g(x), n × m by columns.
    pub input: G,
}

impl<F: Fn(&[f64], &mut [f64]), G: Fn(&[f64], &mut [f64])> Plant for Affine<F, G> {
    fn states(&self) -> usize {
        self.states
    }

    fn inputs(&self) -> usize {
        self.inputs
    }

    fn drift(&self, x: &[f64], f: &mut [f64]) {
        (self.drift)(x, f);
    }

    fn input(&self, x: &[f64], g: &mut [f64]) {
        (self.input)(x, g);
    }
}

/// The tangent plant at the origin: ∂f/∂x by central differences of step 6e-6 `sizeᵢ` (the truncation and the rounding
/// error, ε^(2/3), are of one size there), and g(0).
#[must_use]
pub fn tangent(plant: &impl Plant, sizes: &[f64]) -> Linear {
    let (n, m) = (plant.states(), plant.inputs());
    let mut a = DMatrix::zeros(n, n);
    let (mut above, mut below) = (vec![0.0; n], vec![0.0; n]);
    for (j, size) in sizes.iter().enumerate().take(n) {
        let mut x = vec![0.0; n];
        let h = 6e-6 * size;
        x[j] = h;
        plant.drift(&x, &mut above);
        x[j] = -h;
        plant.drift(&x, &mut below);
        for i in 0..n {
            a[(i, j)] = (above[i] - below[i]) / (2.0 * h);
        }
    }
    let mut b = DMatrix::zeros(n, m);
    plant.input(&vec![0.0; n], b.as_mut_slice());
    Linear { a, b }
}
