use nalgebra::{Complex, DMatrix, LU};

use super::balance::Balance;
use super::{BAD, GOOD, NEWTON_STEPS, Riccati, UNIT_ROUNDOFF, checked, doubling, unreachable};
use crate::compensated::{Pair, Twofold, column};
use crate::dense::{eigenvalues, is_finite, power_of_two, solve_refined, symmetric_part};
use crate::error::RiccatiError;
use crate::lyapunov;

/// Parameters γ of the Cayley transform, relative to the size of the Hamiltonian, in the order tried.
const CAYLEY: [f64; 5] = [1.0, 0.3, 3.0, 0.03, 30.0];
/// Shifts A + αI, relative to the size of A, whose solutions start Newton's method where the doubling ends on the
/// wrong side of a stability boundary.
const SHIFTS: [f64; 4] = [1e-7, 1e-5, 1e-3, 1e-1];

/// Solves AᵀX + XA − (XB + S)R⁻¹(BᵀX + Sᵀ) + Q = 0 for the X that makes A − B K stable, K = R⁻¹(BᵀX + Sᵀ).
///
/// With Q ⪰ 0, R ≻ 0, S = 0 it is the cost ∫ (xᵀQx + uᵀRu) dt of the linear-quadratic regulator u = −K x (thesis
/// Eq 4.28 for a linear system); use [`lqr`](crate::lqr) then, which checks that. Here Q and R may be indefinite.
///
/// `a` n × n, `b` n × m, `q` n × n symmetric, `r` m × m symmetric and invertible, `s` n × m.
///
/// ```
/// use greybox_hjb::care;
/// use nalgebra::dmatrix;
/// // A double integrator: X = [[√3, 1], [1, √3]].
/// let (a, b) = (dmatrix![0.0, 1.0; 0.0, 0.0], dmatrix![0.0; 1.0]);
/// let x = care(&a, &b, &dmatrix![1.0, 0.0; 0.0, 1.0], &dmatrix![1.0], None)?;
/// assert!((x.solution[(0, 0)] - 3f64.sqrt()).abs() < 1e-15);
/// assert!(x.closed_loop.iter().all(|l| l.re < 0.0));
/// # Ok::<(), greybox_hjb::RiccatiError>(())
/// ```
///
/// # Errors
/// [`RiccatiError`]: shapes, numbers, a singular R, a mode that no feedback stabilises, or no stabilising solution
/// at this precision. A solution that does not stabilise is never returned.
pub fn care(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
    s: Option<&DMatrix<f64>>,
) -> Result<Riccati, RiccatiError> {
    let s = checked(a, b, q, r, s)?;
    let n = a.nrows();
    // G = B R⁻¹ Bᵀ; the cross weight moves into A and Q.
    let mut right = DMatrix::zeros(b.ncols(), 2 * n);
    right.columns_mut(0, n).tr_copy_from(b);
    right.columns_mut(n, n).tr_copy_from(&s);
    let solved = solve_refined(r, &right).ok_or(RiccatiError::SingularWeight)?;
    let (input, cross) = (solved.columns(0, n).into_owned(), solved.columns(n, n).into_owned());
    let given = Equation {
        a: a - b * &cross,
        g: symmetric_part(&(b * &input)),
        q: symmetric_part(&(q - &s * &cross)),
    };
    let mut balance = Balance::of(&given.a, &given.g, &given.q);
    let scaled = given.balanced(&balance);
    let (size_q, size_g) = (scaled.q.norm(), scaled.g.norm());
    if size_q > 0.0 && size_g > 0.0 {
        balance.rho = power_of_two((size_q / size_g).sqrt());
    }
    let equation = given.balanced(&balance);
    let fail = |residual: f64, x: Option<&DMatrix<f64>>| {
        if let Some(eigenvalue) = unreachable(&balance.similar(a), &balance.rows(b), |l| l.re >= 0.0) {
            return RiccatiError::NotStabilisable { eigenvalue };
        }
        let worst = x.and_then(|x| eigenvalues(&equation.closed_loop(x))).and_then(|l| rightmost(&l));
        RiccatiError::NotStabilising { residual, eigenvalue: worst.unwrap_or(Complex::new(f64::NAN, 0.0)) }
    };
    let Some(x) = equation.solve() else { return Err(fail(f64::NAN, None)) };
    let residual = equation.residual(&x).1;
    let solution = balance.undo(&x);
    let gain = &input * &solution + &cross;
    // Of the balanced system: the same eigenvalues, to more digits.
    let closed_loop = eigenvalues(&equation.closed_loop(&x)).unwrap_or_default();
    let stable = closed_loop.iter().all(|l| l.re < 0.0) && !closed_loop.is_empty();
    if !is_finite(&solution) || !stable || residual > BAD || residual.is_nan() {
        return Err(fail(residual, Some(&x)));
    }
    Ok(Riccati { solution, gain, closed_loop, residual })
}

/// The eigenvalue farthest to the right.
fn rightmost(l: &[Complex<f64>]) -> Option<Complex<f64>> {
    l.iter().copied().max_by(|a, b| a.re.total_cmp(&b.re))
}

/// AᵀX + XA − XGX + Q = 0.
struct Equation {
    a: DMatrix<f64>,
    g: DMatrix<f64>,
    q: DMatrix<f64>,
}

impl Equation {
    /// The residual in twice the precision, and its norm over the sum of the norms of its terms.
    fn residual(&self, x: &DMatrix<f64>) -> (DMatrix<f64>, f64) {
        let n = x.nrows();
        // G and X are symmetric: their columns are their rows.
        let gx = Pair::product_of_transposed(&self.g, x);
        let mut residual = DMatrix::zeros(n, n);
        for j in 0..n {
            for i in 0..=j {
                let mut sum = Twofold::new(self.q[(i, j)]);
                sum.add_dot(column(&self.a, i), column(x, j));
                sum.add_dot(column(x, i), column(&self.a, j));
                gx.sub_dot(&mut sum, column(x, i), j);
                residual[(i, j)] = sum.value();
                residual[(j, i)] = sum.value();
            }
        }
        let terms = 2.0 * (x * &self.a).norm() + (x * &gx.high).norm() + self.q.norm();
        let relative = if terms > 0.0 { residual.norm() / terms } else { 0.0 };
        (residual, relative)
    }

    fn balanced(&self, balance: &Balance) -> Equation {
        Equation {
            a: balance.similar(&self.a),
            g: balance.rows(&balance.rows(&self.g).transpose()) * balance.rho,
            q: balance.congruent(&self.q) / balance.rho,
        }
    }

    fn closed_loop(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        &self.a - &self.g * x
    }

    /// The Hamiltonian's Frobenius norm.
    fn size(&self) -> f64 {
        (2.0 * self.a.norm_squared() + self.g.norm_squared() + self.q.norm_squared()).sqrt()
    }

    /// Doubling from several Cayley parameters, then Newton steps.
    fn solve(&self) -> Option<DMatrix<f64>> {
        let mut best: Option<(DMatrix<f64>, f64)> = None;
        for gamma in CAYLEY {
            let Some(x) = self.doubled(gamma * self.size() / (2.0 * self.a.nrows() as f64).sqrt(), 0.0)
            else {
                continue;
            };
            let relative = self.residual(&x).1;
            if best.as_ref().is_none_or(|b| relative < b.1) {
                best = Some((x, relative));
            }
            if relative < GOOD {
                break;
            }
        }
        let (x, _) = best?;
        if let Some(x) = self.refined(x.clone()) {
            return Some(x);
        }
        // Not stabilising: from the solution of a system farther into instability, whose feedback stabilises
        // this one and from where Newton's method converges on the stable side (Kleinman).
        let size = self.a.norm();
        for alpha in SHIFTS {
            let start = CAYLEY.iter().find_map(|gamma| {
                self.doubled(gamma * self.size() / (2.0 * self.a.nrows() as f64).sqrt(), alpha * size)
            });
            if let Some(x) = start.and_then(|x| self.refined(x)) {
                return Some(x);
            }
        }
        Some(x)
    }

    /// The solution for A + αI by the doubling algorithm on the Cayley transform with parameter γ.
    fn doubled(&self, gamma: f64, alpha: f64) -> Option<DMatrix<f64>> {
        let n = self.a.nrows();
        let mut shifted = self.a.clone();
        for i in 0..n {
            shifted[(i, i)] += alpha - gamma;
        }
        let lu = LU::new(shifted.clone());
        let to_g = lu.solve(&self.g)?;
        let inverse = lu.try_inverse()?;
        let w = LU::new(shifted.transpose() + &self.q * &to_g).try_inverse()?;
        let mut a = w.transpose() * (2.0 * gamma);
        for i in 0..n {
            a[(i, i)] += 1.0;
        }
        let g = symmetric_part(&(to_g * &w)) * (2.0 * gamma);
        let h = symmetric_part(&(w * &self.q * inverse)) * (2.0 * gamma);
        doubling(a, g, h)
    }

    /// Newton steps X ← X + D with A_cᵀD + DA_c + residual = 0 while they help; `None` when the closed loop of `x`
    /// is not stable.
    fn refined(&self, mut x: DMatrix<f64>) -> Option<DMatrix<f64>> {
        let (mut residual, mut relative) = self.residual(&x);
        let mut first = true;
        for _ in 0..NEWTON_STEPS {
            let Some(step) = lyapunov::solve(&self.closed_loop(&x), &residual) else {
                if first {
                    return None;
                }
                break;
            };
            first = false;
            if step.norm() <= UNIT_ROUNDOFF * x.norm() {
                break;
            }
            let next = symmetric_part(&(&x + step));
            let (r, next_relative) = self.residual(&next);
            if !is_finite(&next) || next_relative.is_nan() || next_relative >= relative {
                break;
            }
            (x, residual, relative) = (next, r, next_relative);
        }
        Some(x)
    }
}
