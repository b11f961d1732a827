//! From a plant and a cost to a law that was checked.

use nalgebra::{Complex, DMatrix};

use crate::basis::Monomials;
use crate::error::HjbError;
use crate::feedback::{Feedback, Verification, verify};
use crate::lqr::lqr;
use crate::plant::{Linear, Plant, tangent};
use crate::points::Domain;
use crate::policy::{Policy, PolicyOptions, policy_iteration};
use crate::problem::Problem;
use crate::range::InputRange;
use crate::riccati::Riccati;

/// ‖f(0)‖ over the size of f across the domain above which the origin is no equilibrium.
const AT_REST: f64 = 1e-9;
/// Points per weight. Three suffice on a family of plants of two to eight states, whatever their number (`cargo xtask
/// reproduce --only Sampling`).
const POINTS_PER_WEIGHT: usize = 8;
/// Fewest points on which a law is checked.
const CHECK_POINTS: usize = 2000;
/// Ranges of the inputs over those asked for, in the order in which they are narrowed.
const WIDER: [f64; 5] = [16.0, 8.0, 4.0, 2.0, 1.0];

/// An optimal law.
#[derive(Debug, Clone)]
pub struct Optimal {
    /// The law.
    pub feedback: Feedback,
    /// The regulator of the tangent plant, which it starts from and is compared with.
    pub linear: Riccati,
    /// The law checked at points that it was not fitted to.
    pub verification: Verification,
    /// The tangent plant's regulator at the same points.
    pub linear_verification: Verification,
    /// How the weights were found.
    pub policy: Policy,
}

/// Designs the law of least cost ∫ (xᵀQx + uᵀRu) dt with a value function of the given degree over a domain.
///
/// The weights of degree two are the Riccati solution of the tangent plant at the origin; those of higher degree are
/// found by policy iteration at Halton points of the domain, eight per weight. The law is returned when it is
/// stabilising at the origin; how far it is trustworthy says its [`Verification`].
///
/// `q` is n × n positive semidefinite, `r` m × m positive definite. `degree` 2 gives the linear regulator; a plant
/// with f(−x) = −f(x) and even g needs even degrees only, which is what an even `degree` with `odd_terms` false takes.
///
/// ```
/// use greybox_hjb::{Affine, Domain, design};
/// use nalgebra::dmatrix;
/// // ẋ = x − x³ + u: the exact law is u = −(x − x³) − x √((1 − x²)² + 1).
/// let plant = Affine {
///     states: 1,
///     inputs: 1,
///     drift: |x: &[f64], f: &mut [f64]| f[0] = x[0] - x[0].powi(3),
///     input: |_: &[f64], g: &mut [f64]| g[0] = 1.0,
/// };
/// let one = dmatrix![1.0];
/// let optimal = design(&plant, &one, &one, &Domain::symmetric(&[0.8])?, 8, false)?;
/// let x = 0.5f64;
/// let exact = -(x - x.powi(3)) - x * ((1.0 - x * x).powi(2) + 1.0).sqrt();
/// assert!((optimal.feedback.control(&[x], &[1.0])[0] - exact).abs() < 1e-4);
/// assert!(optimal.verification.holds_everywhere());
/// # Ok::<(), greybox_hjb::HjbError>(())
/// ```
///
/// # Errors
/// [`HjbError`]: sizes, a plant that does not rest at the origin or is not finite in the domain, a tangent plant that
/// no feedback stabilises.
pub fn design(
    plant: &impl Plant,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
    domain: &Domain,
    degree: u8,
    odd_terms: bool,
) -> Result<Optimal, HjbError> {
    let n = plant.states();
    if domain.states() != n {
        return Err(HjbError::Size { what: "the domain", found: domain.states(), wanted: n });
    }
    let basis = if odd_terms { Monomials::full(n, degree)? } else { Monomials::even(n, degree)? };
    let unlimited = vec![InputRange::UNLIMITED; plant.inputs()];
    design_within(plant, q, r, &unlimited, domain, &basis)
}

/// [`design`] with inputs that stay within ranges, one for each, at the cost of [`InputRange`], and with a basis.
///
/// The quadratic part of V and the gain at the origin are those without limits: near the origin no limit binds. The
/// weights of higher degree are first those without limits, from which policy iteration goes on.
///
/// No law with limits stabilises an unstable plant from everywhere. Where V is infinite no polynomial follows it: the
/// domain should lie within the states that the limits can bring back, and [`Verification::level`] says how far the
/// law was found to. Ranges that are not symmetric make V so: the basis then needs odd terms as well.
///
/// ```
/// use greybox_hjb::{Domain, InputRange, Linear, Monomials, design_within};
/// use nalgebra::dmatrix;
/// // ẋ = −x + u within ±½: far from the origin the input hardly pays.
/// let plant = Linear { a: dmatrix![-1.0], b: dmatrix![1.0] };
/// let one = dmatrix![1.0];
/// let range = InputRange::new(-0.5, 0.5)?;
/// let optimal =
///     design_within(&plant, &one, &one, &[range], &Domain::symmetric(&[3.0])?, &Monomials::even(1, 12)?)?;
/// let u = |x: f64| optimal.feedback.control(&[x], &[1.0])[0];
/// // −(√2 − 1) x near the origin, and never beyond the limit.
/// assert!((u(1e-3) + 1e-3 * (2f64.sqrt() - 1.0)).abs() < 1e-7);
/// assert!(u(3.0) > -0.5 && u(3.0) < -0.4);
/// assert!(optimal.verification.holds_everywhere());
/// # Ok::<(), greybox_hjb::HjbError>(())
/// ```
///
/// # Errors
/// Those of [`design`]; [`HjbError::Size`] for another number of ranges, [`HjbError::CoupledInputs`] for limits with an
/// R that is not diagonal.
pub fn design_within(
    plant: &impl Plant,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
    ranges: &[InputRange],
    domain: &Domain,
    basis: &Monomials,
) -> Result<Optimal, HjbError> {
    let n = plant.states();
    if domain.states() != n {
        return Err(HjbError::Size { what: "the domain", found: domain.states(), wanted: n });
    }
    let points = domain.halton((POINTS_PER_WEIGHT * basis.len()).max(CHECK_POINTS / 4))?;
    let mut problem = Problem::new(plant, q, r, basis.clone(), &points)?;
    let mut f = vec![0.0; n];
    let norm = |f: &[f64]| f.iter().map(|f| f * f).sum::<f64>().sqrt();
    let mut largest = 0.0f64;
    for x in &points {
        plant.drift(x, &mut f);
        largest = largest.max(norm(&f));
    }
    plant.drift(&vec![0.0; n], &mut f);
    let drift = norm(&f);
    if drift.is_nan() || drift > AT_REST * largest {
        return Err(HjbError::NotAtRest { drift });
    }
    let sizes: Vec<f64> = domain.bounds().iter().map(|(a, b)| a.abs().max(b.abs())).collect();
    let Linear { a, b } = tangent(plant, &sizes);
    let linear = lqr(&a, &b, q, r)?;
    let start = basis.quadratic(|i, j| linear.solution[(i, j)]);
    let options = PolicyOptions { hold_quadratic: true, ..PolicyOptions::default() };
    let mut policy = policy_iteration(&problem, &start, options)?;
    if ranges.iter().any(InputRange::is_limited) {
        for wider in WIDER {
            let ranges: Vec<InputRange> = ranges.iter().map(|r| r.times(wider)).collect();
            let before = policy.steps;
            problem = problem.within(&ranges)?;
            policy = policy_iteration(&problem, &policy.weights, options)?;
            policy.steps += before;
        }
    }
    // Checked where it was not fitted: the points of the sequence that follow.
    let unseen = domain.halton(points.len() + CHECK_POINTS)?.split_off(points.len());
    let check = |weights: Vec<f64>| -> Result<(Feedback, Verification), HjbError> {
        let feedback = Feedback::new(basis.clone(), weights, r)?.within(ranges)?;
        let verification = verify(plant, q, &feedback, &unseen)?;
        Ok((feedback, verification))
    };
    let (_, linear_verification) = check(start)?;
    let (feedback, verification) = check(policy.weights.clone())?;
    if !verification.is_stabilising() {
        let worst = verification.closed_loop.iter().max_by(|a, b| a.re.total_cmp(&b.re)).copied();
        return Err(HjbError::NotStabilising {
            curvature: verification.curvature,
            eigenvalue: worst.unwrap_or(Complex::new(f64::NAN, 0.0)),
        });
    }
    Ok(Optimal { feedback, linear, verification, linear_verification, policy })
}
