use nalgebra::{Complex, DMatrix, LU};

use super::balance::Balance;
use super::{BAD, GOOD, NEWTON_STEPS, Riccati, UNIT_ROUNDOFF, checked, doubling, unreachable};
use crate::compensated::{Pair, Twofold, column};
use crate::dense::{eigenvalues, is_finite, power_of_two, solve_refined, symmetric_part};
use crate::error::RiccatiError;
use crate::lyapunov::doubled;

/// Parts X₀ = σI of the solution that are taken out before doubling, relative to the size of Q, in the order tried:
/// with them R + BᵀX₀B is invertible where R is not.
const SHIFTS: [f64; 4] = [0.0, 1.0, 0.1, 10.0];

/// Solves AᵀXA − X − (AᵀXB + S)(R + BᵀXB)⁻¹(BᵀXA + Sᵀ) + Q = 0 for the X that makes A − B K stable,
/// K = (R + BᵀXB)⁻¹(BᵀXA + Sᵀ).
///
/// With Q ⪰ 0, R ≻ 0, S = 0 it is the cost Σ (xᵀQx + uᵀRu) of the sampled linear-quadratic regulator u = −K x; use
/// [`dlqr`](crate::dlqr) then, which checks that. Here Q and R may be indefinite, and R singular (deadbeat control).
///
/// `a` n × n, `b` n × m, `q` n × n symmetric, `r` m × m symmetric, `s` n × m.
///
/// ```
/// use greybox_hjb::dare;
/// use nalgebra::dmatrix;
/// // x⁺ = x + u with unit weights: X is the golden ratio.
/// let one = dmatrix![1.0];
/// let x = dare(&one, &one, &one, &one, None)?;
/// assert!((x.solution[(0, 0)] - (1.0 + 5f64.sqrt()) / 2.0).abs() < 1e-15);
/// # Ok::<(), greybox_hjb::RiccatiError>(())
/// ```
///
/// # Errors
/// [`RiccatiError`]: shapes, numbers, a mode that no feedback stabilises, or no stabilising solution at this
/// precision. A solution that does not stabilise is never returned.
pub fn dare(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
    s: Option<&DMatrix<f64>>,
) -> Result<Riccati, RiccatiError> {
    let s = checked(a, b, q, r, s)?;
    // Where R is singular its size still weighs the inputs against the states.
    let weight = r.norm().max(f64::MIN_POSITIVE);
    let balance = Balance::of(a, &(b * b.transpose() / weight), q);
    let (scaled_a, scaled_b) = (balance.similar(a), balance.rows(b));
    let (scaled_q, scaled_s) = (balance.congruent(q), balance.rows_back(&s));
    let equation = Equation { a: &scaled_a, b: &scaled_b, q: &scaled_q, r, s: &scaled_s };
    let fail = |residual: f64, gain: Option<&DMatrix<f64>>| {
        if let Some(eigenvalue) = unreachable(&scaled_a, &scaled_b, |l| l.norm() >= 1.0) {
            return RiccatiError::NotStabilisable { eigenvalue };
        }
        let worst = gain.and_then(|k| eigenvalues(&(&scaled_a - &scaled_b * k))).and_then(|l| outermost(&l));
        RiccatiError::NotStabilising { residual, eigenvalue: worst.unwrap_or(Complex::new(f64::NAN, 0.0)) }
    };
    let Some(x) = equation.solve() else { return Err(fail(f64::NAN, None)) };
    let Some(Residual { relative, gain, .. }) = equation.residual(&x) else {
        return Err(fail(f64::NAN, None));
    };
    // Of the balanced system: the same eigenvalues, to more digits.
    let closed_loop = eigenvalues(&(&scaled_a - &scaled_b * &gain)).unwrap_or_default();
    let stable = closed_loop.iter().all(|l| l.norm() < 1.0) && !closed_loop.is_empty();
    let solution = balance.undo(&x);
    if !is_finite(&solution) || !stable || relative > BAD || relative.is_nan() {
        return Err(fail(relative, Some(&gain)));
    }
    let gain = balance.undo_gain(&gain);
    Ok(Riccati { solution, gain, closed_loop, residual: relative })
}

/// The eigenvalue farthest from the origin.
fn outermost(l: &[Complex<f64>]) -> Option<Complex<f64>> {
    l.iter().copied().max_by(|a, b| a.norm().total_cmp(&b.norm()))
}

struct Equation<'a> {
    a: &'a DMatrix<f64>,
    b: &'a DMatrix<f64>,
    q: &'a DMatrix<f64>,
    r: &'a DMatrix<f64>,
    s: &'a DMatrix<f64>,
}

struct Residual {
    value: DMatrix<f64>,
    /// Its norm over the sum of the norms of its terms.
    relative: f64,
    gain: DMatrix<f64>,
}

impl Equation<'_> {
    /// The residual in twice the precision; `None` when R + BᵀXB is singular.
    fn residual(&self, x: &DMatrix<f64>) -> Option<Residual> {
        let (n, m) = self.b.shape();
        // X is symmetric: XA and XB from its columns.
        let (xa, xb) = (Pair::product_of_transposed(x, self.a), Pair::product_of_transposed(x, self.b));
        let k = Pair::from_fn(m, n, |i, j| {
            let mut sum = Twofold::new(self.s[(j, i)]);
            xa.add_dot(&mut sum, column(self.b, i), j);
            sum
        });
        let w = Pair::from_fn(m, m, |i, j| {
            let mut sum = Twofold::new(self.r[(i, j)]);
            xb.add_dot(&mut sum, column(self.b, i), j);
            sum
        });
        // T = W⁻¹K as high + low.
        let lu = LU::new(w.high.clone());
        let mut high = lu.solve(&k.high)?;
        let mut low = DMatrix::zeros(m, n);
        let rows = Pair { high: w.high.transpose(), low: w.low.transpose() };
        for _ in 0..3 {
            let left = DMatrix::from_fn(m, n, |i, j| {
                let mut sum = Twofold::new(k.high[(i, j)]);
                sum.add(k.low[(i, j)]);
                sum.sub_dot(column(&rows.high, i), column(&high, j));
                sum.sub_dot(column(&rows.high, i), column(&low, j));
                sum.sub_dot(column(&rows.low, i), column(&high, j));
                sum.value()
            });
            let correction: DMatrix<f64> = lu.solve(&left)? + &low;
            let sum = &high + &correction;
            low = correction - (&sum - &high);
            high = sum;
        }
        if !is_finite(&high) {
            return None;
        }
        let mut value = DMatrix::zeros(n, n);
        for j in 0..n {
            for i in 0..=j {
                let mut sum = Twofold::new(self.q[(i, j)]);
                sum.add(-x[(i, j)]);
                xa.add_dot(&mut sum, column(self.a, i), j);
                sum.sub_dot(column(&k.high, i), column(&high, j));
                sum.sub_dot(column(&k.low, i), column(&high, j));
                sum.sub_dot(column(&k.high, i), column(&low, j));
                value[(i, j)] = sum.value();
                value[(j, i)] = sum.value();
            }
        }
        let terms = (self.a.transpose() * &xa.high).norm()
            + x.norm()
            + (k.high.transpose() * &high).norm()
            + self.q.norm();
        let relative = if terms > 0.0 { value.norm() / terms } else { 0.0 };
        Some(Residual { value, relative, gain: high })
    }

    /// Doubling after several shifts, then Newton steps.
    fn solve(&self) -> Option<DMatrix<f64>> {
        let size = if self.q.norm() > 0.0 { self.q.norm() } else { 1.0 };
        let mut best: Option<(DMatrix<f64>, f64)> = None;
        for sigma in SHIFTS {
            let Some(x) = self.doubled(sigma * size) else { continue };
            let Some(r) = self.residual(&x) else { continue };
            let stable =
                doubled(self.a - self.b * &r.gain, DMatrix::identity(x.nrows(), x.nrows())).is_some();
            let rank = if stable { r.relative } else { r.relative.max(1.0) };
            if best.as_ref().is_none_or(|b| rank < b.1) {
                best = Some((x, rank));
            }
            if rank < GOOD {
                break;
            }
        }
        self.refined(best?.0)
    }

    /// X₀ = σI plus what the doubling algorithm finds beside it.
    fn doubled(&self, sigma: f64) -> Option<DMatrix<f64>> {
        let (n, m) = self.b.shape();
        let r = self.r + self.b.transpose() * self.b * sigma;
        let mut q = self.q + self.a.transpose() * self.a * sigma;
        for i in 0..n {
            q[(i, i)] -= sigma;
        }
        let s = self.s + self.a.transpose() * self.b * sigma;
        let mut right = DMatrix::zeros(m, 2 * n);
        right.columns_mut(0, n).tr_copy_from(self.b);
        right.columns_mut(n, n).tr_copy_from(&s);
        let solved = solve_refined(&r, &right)?;
        let cross = solved.columns(n, n);
        let g = symmetric_part(&(self.b * solved.columns(0, n)));
        let a = self.a - self.b * cross;
        let q = symmetric_part(&(q - &s * cross));
        let (size_q, size_g) = (q.norm(), g.norm());
        let rho = if size_q > 0.0 && size_g > 0.0 { power_of_two((size_q / size_g).sqrt()) } else { 1.0 };
        let mut x = doubling(a, g * rho, q / rho)? * rho;
        for i in 0..n {
            x[(i, i)] += sigma;
        }
        Some(x)
    }

    /// Newton steps X ← X + D with A_cᵀDA_c − D + residual = 0 while they help.
    fn refined(&self, mut x: DMatrix<f64>) -> Option<DMatrix<f64>> {
        let mut now = self.residual(&x)?;
        for _ in 0..NEWTON_STEPS {
            let Some(step) = doubled(self.a - self.b * &now.gain, now.value.clone()) else { break };
            if step.norm() <= UNIT_ROUNDOFF * x.norm() {
                break;
            }
            let next = symmetric_part(&(&x + step));
            let Some(after) = self.residual(&next) else { break };
            if !is_finite(&next) || after.relative.is_nan() || after.relative >= now.relative {
                break;
            }
            (x, now) = (next, after);
        }
        Some(x)
    }
}
