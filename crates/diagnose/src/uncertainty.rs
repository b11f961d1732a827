//! How precise the parameters of a fit are.

use greybox_calibrate::{qr, student_quantile};

use crate::screen::project;
use crate::search::Fitted;

/// Covariance of the free parameters, twice: Gauss–Newton, and the sandwich over blocks of samples; of any
/// figure, the larger of the two variances counts.
#[derive(Debug, Clone)]
pub(crate) struct Uncertainty {
    /// Number of free parameters.
    np: usize,
    /// σ² (JᵀJ + Λ)⁻¹.
    naive: Vec<f64>,
    /// H⁻¹ (Σ s sᵀ) H⁻¹ over the blocks' scores.
    sandwich: Vec<f64>,
    /// Quantile of Student's t.
    t: f64,
}

impl Uncertainty {
    /// At the optimum of a fit.
    pub(crate) fn of(fitted: &Fitted, scale: &[f64]) -> Uncertainty {
        let setup = &fitted.setup;
        let (nx, ny, np) = (setup.system.nx, setup.system.ny, setup.free.len());
        if np == 0 {
            return Uncertainty { np, naive: Vec::new(), sandwich: Vec::new(), t: 2.0 };
        }
        let rows = setup.with_problem(&fitted.level, scale, |p| p.rows(&fitted.fit.point, true, None));
        let total: usize = fitted.level.segments.iter().map(|s| s.range.len()).sum();
        let length = (total / 40).max(1);
        let mut h = vec![0.0; np * np];
        let mut scores: Vec<Vec<f64>> = Vec::new();
        let (mut rss, mut count) = (0.0, 0usize);
        for (segment, rows) in fitted.level.segments.iter().zip(rows) {
            let p = project(rows, nx);
            let (n, m) = (segment.range.len(), p.rows);
            rss += qr::dot(&p.r, &p.r);
            count += ny * n;
            for a in 0..np {
                for b in 0..np {
                    h[a * np + b] += qr::dot(&p.jp[a * m..(a + 1) * m], &p.jp[b * m..(b + 1) * m]);
                }
            }
            let parts = (n as f64 / length as f64).round().max(1.0) as usize;
            for b in 0..parts {
                let (from, to) = (b * n / parts, (b + 1) * n / parts);
                let score = |a: usize| -> f64 {
                    let column = &p.jp[a * m..(a + 1) * m];
                    (0..ny)
                        .map(|c| c * n + from..c * n + to)
                        .map(|r| qr::dot(&column[r.clone()], &p.r[r]))
                        .sum()
                };
                scores.push((0..np).map(score).collect());
            }
        }
        for (i, f) in setup.free.iter().enumerate() {
            if f.std.is_finite() && f.std > 0.0 {
                h[i * np + i] += 1.0 / (f.std * f.std);
            }
        }
        let d: Vec<f64> = (0..np).map(|i| h[i * np + i].max(1e-300).sqrt()).collect();
        let scaled: Vec<f64> = (0..np * np).map(|i| h[i] / (d[i / np] * d[i % np])).collect();
        let inverse: Vec<Vec<f64>> = (0..np)
            .map(|i| {
                let mut e = vec![0.0; np];
                e[i] = 1.0;
                let column = qr::solve_spd(&scaled, np, &e);
                column.iter().zip(&d).map(|(x, dj)| x / (dj * d[i])).collect()
            })
            .collect();
        let variance = rss / (count.saturating_sub(np)).max(1) as f64;
        let blocks = scores.len();
        let freedom = (blocks as f64 - np as f64).max(2.0);
        let t = student_quantile(freedom);
        let moved: Vec<Vec<f64>> =
            scores.iter().map(|s| inverse.iter().map(|row| qr::dot(row, s)).collect()).collect();
        let inflate = blocks as f64 / freedom;
        let (mut naive, mut sandwich) = (vec![0.0; np * np], vec![0.0; np * np]);
        for a in 0..np {
            for b in 0..np {
                naive[a * np + b] = inverse[a][b] * variance;
                sandwich[a * np + b] = inflate * moved.iter().map(|m| m[a] * m[b]).sum::<f64>();
            }
        }
        Uncertainty { np, naive, sandwich, t }
    }

    /// Half width of the 95 % interval of a figure with this gradient in the free parameters.
    pub(crate) fn width(&self, gradient: &[f64]) -> f64 {
        let form = |m: &[f64]| -> f64 {
            (0..self.np).map(|a| gradient[a] * qr::dot(&m[a * self.np..(a + 1) * self.np], gradient)).sum()
        };
        self.t * form(&self.naive).max(form(&self.sandwich)).max(0.0).sqrt()
    }

    /// Half widths of the 95 % intervals of all free parameters.
    pub(crate) fn widths(&self) -> Vec<f64> {
        (0..self.np)
            .map(|i| {
                let at = i * self.np + i;
                self.t * self.naive[at].max(self.sandwich[at]).max(0.0).sqrt()
            })
            .collect()
    }
}
