//! Marginal likelihoods of functions whose coefficients are unknown.

use greybox_calibrate::qr;

/// ln of what functions make of the likelihood whose coefficients are normal about zero with covariance `width`² L Lᵀ:
/// `root` = L, lower triangular, `gg` = GᵀG and `gr` = Gᵀr with the parameters projected off, each square worth `weight`.
pub(crate) fn log_marginal(root: &[f64], gg: &[f64], gr: &[f64], weight: f64, width: f64) -> f64 {
    let n = gr.len();
    // (L[a][b] at a·n + b.)
    let mut half = vec![0.0; n * n];
    for a in 0..n {
        for b in 0..n {
            half[a * n + b] = (b..n).map(|k| gg[a * n + k] * root[k * n + b]).sum::<f64>();
        }
    }
    let mut a = vec![0.0; n * n];
    let mut b = vec![0.0; n];
    let scale = weight * width * width;
    for i in 0..n {
        for j in 0..n {
            a[i * n + j] = scale * (i..n).map(|k| root[k * n + i] * half[k * n + j]).sum::<f64>();
        }
        a[i * n + i] += 1.0;
        b[i] = weight * width * (i..n).map(|k| root[k * n + i] * gr[k]).sum::<f64>();
    }
    0.5 * (qr::dot(&qr::solve_spd(&a, n, &b), &b) - qr::log_determinant(&a, n))
}

/// ln Σ exp.
pub(crate) fn log_sum(logs: &[f64]) -> f64 {
    let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if most.is_finite() { most + logs.iter().map(|l| (l - most).exp()).sum::<f64>().ln() } else { most }
}
