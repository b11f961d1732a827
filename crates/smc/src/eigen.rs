//! Eigenvalues and the characteristic polynomial of a small real matrix.

use crate::matrix::{Matrix, hessenberg, identity, power_of_two};
use crate::pole::Pole;

/// Iterations allowed per eigenvalue. Two or three are usual, but a repeated pole, which the laws here are made for,
/// can take a hundred.
const MAX_ITERATIONS: usize = 500;

/// D⁻¹ M D with D of powers of two, rows and columns of about equal size (Parlett and Reinsch, Numerische
/// Mathematik 13, 1969, doi:10.1007/BF02165404): eigenvalues do not depend on the units of the states.
fn balanced<const N: usize>(m: &Matrix<N>) -> Matrix<N> {
    let mut m = *m;
    for _ in 0..50 {
        let mut settled = true;
        for i in 0..N {
            let (mut row, mut column) = (0.0, 0.0);
            for j in 0..N {
                if j != i {
                    row += m[i][j].abs();
                    column += m[j][i].abs();
                }
            }
            if !(row > 0.0 && column > 0.0 && row.is_finite() && column.is_finite()) {
                continue;
            }
            let factor = power_of_two(libm::sqrt(row) / libm::sqrt(column));
            if column * factor + row / factor < 0.95 * (column + row) {
                settled = false;
                for j in 0..N {
                    m[i][j] /= factor;
                    m[j][i] *= factor;
                }
            }
        }
        if settled {
            break;
        }
    }
    m
}

/// Eigenvalues by falling real part, conjugate pairs side by side; nothing where the iteration does not end.
///
/// Balancing, reduction to Hessenberg form and Francis' double shifts, as `hqr` of EISPACK does it (Martin,
/// Peters and Wilkinson, Numerische Mathematik 14, 1970, 219–231). The roots of the
/// characteristic polynomial would be the same numbers, but its coefficients hide a slow pole beside fast ones.
pub(crate) fn eigenvalues<const N: usize>(m: &Matrix<N>) -> Option<[Pole; N]> {
    let mut h = balanced(m);
    hessenberg(&mut h, &mut identity());
    let norm = h.iter().flatten().fold(0.0, |sum, entry| sum + entry.abs());
    if !norm.is_finite() {
        return None;
    }
    let mut poles = [Pole { re: 0.0, im: 0.0 }; N];
    let mut iteration = 0;
    // Rows and columns from `end` on are done.
    let mut end = N;
    while end > 0 {
        let last = end - 1;
        let mut first = last;
        while first > 0 {
            let size = h[first - 1][first - 1].abs() + h[first][first].abs();
            let size = if size == 0.0 { norm } else { size };
            if h[first][first - 1].abs() <= f64::EPSILON * size {
                h[first][first - 1] = 0.0;
                break;
            }
            first -= 1;
        }
        if first == last {
            poles[last] = Pole { re: h[last][last], im: 0.0 };
            end -= 1;
            iteration = 0;
        } else if first + 1 == last {
            let block = [[h[last - 1][last - 1], h[last - 1][last]], [h[last][last - 1], h[last][last]]];
            (poles[last - 1], poles[last]) = pair(block);
            end -= 2;
            iteration = 0;
        } else {
            if iteration == MAX_ITERATIONS {
                return None;
            }
            let mut x = h[last][last];
            let mut y = h[last - 1][last - 1];
            let mut w = h[last][last - 1] * h[last - 1][last];
            if iteration % 10 == 9 {
                // An exceptional shift breaks the rare cycles.
                let s = h[last][last - 1].abs() + h[last - 1][last - 2].abs();
                x += 0.75 * s;
                y = x;
                w = -0.4375 * s * s;
            }
            iteration += 1;
            double_step(&mut h, first, last, [x, y, w]);
        }
    }
    poles.sort_unstable_by(|a, b| {
        b.re.total_cmp(&a.re).then(b.im.abs().total_cmp(&a.im.abs())).then(b.im.total_cmp(&a.im))
    });
    Some(poles)
}

/// Eigenvalues of a 2 × 2 block.
fn pair([[y, upper], [lower, x]]: [[f64; 2]; 2]) -> (Pole, Pole) {
    let p = 0.5 * (y - x);
    let w = lower * upper;
    let q = p * p + w;
    let root = libm::sqrt(q.abs());
    if q >= 0.0 {
        let z = p + libm::copysign(root, p);
        let other = if z == 0.0 { x } else { x - w / z };
        (Pole { re: x + z, im: 0.0 }, Pole { re: other, im: 0.0 })
    } else {
        (Pole { re: x + p, im: root }, Pole { re: x + p, im: -root })
    }
}

/// One Francis step on rows and columns `first` to `last` (at least three), with the shifts that are the
/// eigenvalues of a block of diagonal `y`, `x` and product `w` of the others.
fn double_step<const N: usize>(h: &mut Matrix<N>, first: usize, last: usize, [x, y, w]: [f64; 3]) {
    // The first column of (H − s₁)(H − s₂), from where two subdiagonals in a row are small.
    let mut start = last - 2;
    let mut top;
    loop {
        let z = h[start][start];
        let (r, s) = (x - z, y - z);
        top = [
            (r * s - w) / h[start + 1][start] + h[start][start + 1],
            h[start + 1][start + 1] - z - r - s,
            h[start + 2][start + 1],
        ];
        let size = top[0].abs() + top[1].abs() + top[2].abs();
        if size > 0.0 {
            top = top.map(|t| t / size);
        }
        if start == first {
            break;
        }
        let small = h[start][start - 1].abs() * (top[1].abs() + top[2].abs());
        let large = top[0].abs() * (h[start - 1][start - 1].abs() + z.abs() + h[start + 1][start + 1].abs());
        if small <= f64::EPSILON * large {
            break;
        }
        start -= 1;
    }
    for i in start + 2..=last {
        h[i][i - 2] = 0.0;
        if i > start + 2 {
            h[i][i - 3] = 0.0;
        }
    }
    // Chase the bulge down.
    let [mut p, mut q, mut r] = top;
    for k in start..last {
        let three = k + 1 < last;
        let mut size = 1.0;
        if k > start {
            p = h[k][k - 1];
            q = h[k + 1][k - 1];
            r = if three { h[k + 2][k - 1] } else { 0.0 };
            size = p.abs() + q.abs() + r.abs();
            if size > 0.0 {
                p /= size;
                q /= size;
                r /= size;
            }
        }
        let s = libm::copysign(libm::sqrt(p * p + q * q + r * r), p);
        if s == 0.0 {
            continue;
        }
        if k > start {
            h[k][k - 1] = -s * size;
        } else if first < start {
            h[k][k - 1] = -h[k][k - 1];
        }
        p += s;
        let (x, y, z) = (p / s, q / s, r / s);
        q /= p;
        r /= p;
        for j in k..=last {
            let mut sum = h[k][j] + q * h[k + 1][j];
            if three {
                sum += r * h[k + 2][j];
                h[k + 2][j] -= sum * z;
            }
            h[k + 1][j] -= sum * y;
            h[k][j] -= sum * x;
        }
        for i in first..=last.min(k + 3) {
            let mut sum = x * h[i][k] + y * h[i][k + 1];
            if three {
                sum += z * h[i][k + 2];
                h[i][k + 2] -= sum * r;
            }
            h[i][k + 1] -= sum * q;
            h[i][k] -= sum;
        }
    }
}

/// c₀ … c_{N−1} of det(s I − M) = sᴺ + c_{N−1} sᴺ⁻¹ + … + c₀.
///
/// From the Hessenberg form, by expanding along its last column (La Budde's method; Rehman and Ipsen,
/// arXiv:1104.3769).
pub(crate) fn characteristic<const N: usize>(m: &Matrix<N>) -> [f64; N] {
    let mut h = balanced(m);
    hessenberg(&mut h, &mut identity());
    // minors[k] holds the lower coefficients of the monic polynomial of the leading k + 1 rows and columns.
    let mut minors = [[0.0; N]; N];
    for k in 0..N {
        // (s − h_kk) p_{k−1}
        for power in 0..=k {
            let shifted = if power > 0 { coefficient(&minors, k, power - 1) } else { 0.0 };
            minors[k][power] = shifted - h[k][k] * coefficient(&minors, k, power);
        }
        // − Σ h_ik (h_{i+1,i} … h_{k,k−1}) p_{i−1}
        let mut chain = 1.0;
        for i in (0..k).rev() {
            chain *= h[i + 1][i];
            for power in 0..=i {
                minors[k][power] -= h[i][k] * chain * coefficient(&minors, i, power);
            }
        }
    }
    minors.last().copied().unwrap_or([0.0; N])
}

/// The coefficient of a power of s in the characteristic polynomial of the leading `size` rows.
fn coefficient<const N: usize>(minors: &[[f64; N]; N], size: usize, power: usize) -> f64 {
    if power == size {
        1.0
    } else if power < size {
        minors[size - 1][power]
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poles<const N: usize>(m: Matrix<N>) -> [(f64, f64); N] {
        eigenvalues(&m).unwrap().map(|pole| (pole.re, pole.im))
    }

    fn near<const N: usize>(found: [(f64, f64); N], expected: [(f64, f64); N], tolerance: f64) {
        for (f, e) in found.iter().zip(expected) {
            assert!((f.0 - e.0).abs() < tolerance && (f.1 - e.1).abs() < tolerance, "{found:?}");
        }
    }

    #[test]
    fn known_eigenvalues() {
        assert_eq!(poles([[7.0]]), [(7.0, 0.0)]);
        near(poles([[0.0, 1.0], [-2.0, -3.0]]), [(-1.0, 0.0), (-2.0, 0.0)], 1e-14);
        near(poles([[1.0, -2.0], [2.0, 1.0]]), [(1.0, 2.0), (1.0, -2.0)], 1e-15);
        near(
            poles([[2.0, 0.0, 0.0], [5.0, 3.0, 0.0], [7.0, 1.0, 1.0]]),
            [(3.0, 0.0), (2.0, 0.0), (1.0, 0.0)],
            1e-13,
        );
        // The companion of (s + ½)(s + 2)(s² + 2 s + 10).
        let companion =
            [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-10.0, -27.0, -16.0, -4.5]];
        near(poles(companion), [(-0.5, 0.0), (-1.0, 3.0), (-1.0, -3.0), (-2.0, 0.0)], 1e-12);
        // A cyclic permutation needs the exceptional shift.
        let cycle = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let half = libm::sqrt(0.75);
        near(poles(cycle), [(1.0, 0.0), (-0.5, half), (-0.5, -half)], 1e-14);
        assert_eq!(eigenvalues(&[[f64::NAN, 1.0], [0.0, 1.0]]), None);
        assert_eq!(poles([[0.0; 3]; 3]), [(0.0, 0.0); 3]);
    }

    #[test]
    fn a_slow_pole_beside_fast_ones_and_wild_units_survives() {
        // Poles −1e6, −2e3, −0.2 in coordinates of very different size.
        let diagonal = [-1e6, -2e3, -0.2];
        let t = [[1.0, 0.4, 0.3], [0.5, 1.0, 0.6], [-0.2, 0.7, 1.0]];
        let inverse: Matrix<3> = {
            let columns: [[f64; 3]; 3] = core::array::from_fn(|j| {
                crate::matrix::solve(&t, &core::array::from_fn(|i| f64::from(u8::from(i == j)))).unwrap()
            });
            core::array::from_fn(|i| core::array::from_fn(|j| columns[j][i]))
        };
        let mut m = [[0.0; 3]; 3];
        for i in 0..3 {
            for j in 0..3 {
                for k in 0..3 {
                    m[i][j] += t[i][k] * diagonal[k] * inverse[k][j];
                }
            }
        }
        for units in [[1e-8, 1.0, 1e9], [1e9, 1e-8, 1.0], [1.0, 1e9, 1e-8], [1e9, 1.0, 1e-8]] {
            let m = core::array::from_fn(|i| core::array::from_fn(|j| m[i][j] * units[i] / units[j]));
            let found = poles::<3>(m);
            for (f, e) in found.iter().zip([-0.2, -2e3, -1e6]) {
                assert!((f.0 / e - 1.0).abs() < 1e-7, "{units:?}: {found:?}");
            }
        }
    }

    #[test]
    fn the_characteristic_polynomial_is_that_of_the_poles() {
        let companion =
            [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-10.0, -27.0, -16.0, -4.5]];
        for (found, expected) in characteristic(&companion).iter().zip([10.0, 27.0, 16.0, 4.5]) {
            assert!((found - expected).abs() < 1e-12);
        }
        assert_eq!(characteristic(&[[3.0]]), [-3.0]);
        assert_eq!(characteristic(&[[1.0, 2.0], [3.0, 4.0]]), [-2.0, -5.0]);
    }
}
