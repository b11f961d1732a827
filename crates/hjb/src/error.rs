use nalgebra::Complex;

/// Why a matrix equation was not solved.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RiccatiError {
    /// A matrix has the wrong shape.
    #[error("{matrix} is {rows} by {columns}, and must be {wanted_rows} by {wanted_columns}")]
    Shape {
        /// Its name.
        matrix: &'static str,
        /// Rows it has.
        rows: usize,
        /// Columns it has.
        columns: usize,
        /// Rows it should have.
        wanted_rows: usize,
        /// Columns it should have.
        wanted_columns: usize,
    },
    /// A system without states or without inputs.
    #[error("a system of {states} states and {inputs} inputs has no feedback: give at least one of each")]
    Empty {
        /// States.
        states: usize,
        /// Inputs.
        inputs: usize,
    },
    /// A matrix holds NaN or an infinity.
    #[error("{matrix}({row}, {column}) is {value}: every element must be a finite number")]
    NotFinite {
        /// Its name.
        matrix: &'static str,
        /// Row, from 1.
        row: usize,
        /// Column, from 1.
        column: usize,
        /// What stands there.
        value: f64,
    },
    /// A weight is not symmetric.
    #[error("{matrix} is not symmetric: a quadratic cost knows only (M + Mᵀ)/2, so give that")]
    NotSymmetric {
        /// Its name.
        matrix: &'static str,
    },
    /// The weight of the inputs cannot be inverted.
    #[error(
        "R is singular to working precision: some combination of inputs costs nothing; give every input a weight"
    )]
    SingularWeight,
    /// A weight that must be positive definite is not.
    #[error("{matrix} is not positive {}: its smallest eigenvalue is {smallest:.3e}", if *definite { "definite" } else { "semidefinite" })]
    NotPositive {
        /// Its name.
        matrix: &'static str,
        /// Whether definite is asked for (else semidefinite).
        definite: bool,
        /// Smallest eigenvalue.
        smallest: f64,
    },
    /// No input moves an unstable mode.
    #[error(
        "no feedback stabilises the system: the inputs do not reach its mode at {}; add an input that moves it, or leave it out of the model",
        complex(eigenvalue)
    )]
    NotStabilisable {
        /// Its eigenvalue.
        eigenvalue: Complex<f64>,
    },
    /// There is no stabilising solution, or it is lost in rounding.
    #[error(
        "no stabilising solution was found (best relative residual {residual:.1e}, closed loop's worst eigenvalue {}): the cost may not see a mode on the stability boundary, or the numbers span too many decades",
        complex(eigenvalue)
    )]
    NotStabilising {
        /// Relative residual of the best try.
        residual: f64,
        /// Eigenvalue of its closed loop nearest to or farthest into instability.
        eigenvalue: Complex<f64>,
    },
    /// A linear matrix equation for a system that is not stable.
    #[error(
        "the {equation} equation needs a stable matrix: its solution would not be a sum of decaying terms"
    )]
    Unstable {
        /// Lyapunov or Stein.
        equation: &'static str,
    },
}

fn complex(z: &Complex<f64>) -> String {
    if z.im == 0.0 { format!("{:.4e}", z.re) } else { format!("{:.4e} ± {:.4e}i", z.re, z.im.abs()) }
}

/// Why a Hamilton–Jacobi–Bellman equation was not solved.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum HjbError {
    /// A basis that cannot be.
    #[error("a basis of degree {degree} over {states} states: {reason}")]
    Basis {
        /// States.
        states: usize,
        /// Highest degree.
        degree: u8,
        /// Why not.
        reason: &'static str,
    },
    /// A range of states that is empty.
    #[error("the range of state {state} is [{low}, {high}]: give two finite numbers, the lower one first")]
    Domain {
        /// Which state, from 1.
        state: usize,
        /// Lower bound.
        low: f64,
        /// Upper bound.
        high: f64,
    },
    /// A range of an input that its cost cannot hold.
    #[error(
        "the range of an input is [{low}, {high}], counted from the input at the origin: give a finite number below zero \
         and one above, or infinities for both"
    )]
    Range {
        /// Lower limit.
        low: f64,
        /// Upper limit.
        high: f64,
    },
    /// Limits of inputs that the cost couples.
    #[error(
        "R has elements off its diagonal, and the cost of inputs with limits is a sum over the inputs: give a diagonal R"
    )]
    CoupledInputs,
    /// No or too many collocation points, or points that determine nothing.
    #[error("{wanted} collocation points: give one count per state, and from 1 to {most} points in all")]
    Points {
        /// How many were asked for.
        wanted: f64,
        /// Most there may be.
        most: usize,
    },
    /// Weights, points, plant and basis do not belong together.
    #[error("{what} has {found} values, and the problem needs {wanted}")]
    Size {
        /// What has the wrong size.
        what: &'static str,
        /// Its size.
        found: usize,
        /// The size that fits.
        wanted: usize,
    },
    /// The plant is not finite at a point.
    #[error("the plant's equations are not finite at x = {point:?}: shrink the domain")]
    NotFinite {
        /// The state.
        point: Vec<f64>,
    },
    /// The plant moves at the origin without input: V has no minimum there.
    #[error(
        "the plant does not rest at the origin (|f(0)| = {drift:e}): shift its states to an equilibrium first"
    )]
    NotAtRest {
        /// ‖f(0)‖.
        drift: f64,
    },
    /// The linearisation at the origin or the weights admit no regulator.
    #[error("at the origin: {0}")]
    Linear(#[from] RiccatiError),
    /// An option that makes no sense.
    #[error("{option} = {value}: it must be {wanted}")]
    Option {
        /// Its name.
        option: &'static str,
        /// Its value.
        value: f64,
        /// The fix.
        wanted: &'static str,
    },
    /// The collocation points do not determine the weights.
    #[error(
        "the {points} collocation points do not determine the {functions} weights: give more points, or spread them"
    )]
    Undetermined {
        /// Points.
        points: usize,
        /// Basis functions.
        functions: usize,
    },
    /// A solution of the equation that is not a value function, or whose law does not stabilise.
    #[error(
        "the solution found is not stabilising (smallest curvature of V {curvature:.3e}, closed loop's worst eigenvalue {}): start from a stabilising policy",
        complex(eigenvalue)
    )]
    NotStabilising {
        /// Smallest eigenvalue of V's Hessian at the origin.
        curvature: f64,
        /// The closed loop's eigenvalue farthest to the right.
        eigenvalue: Complex<f64>,
    },
}
