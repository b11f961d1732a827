//! How precise the coefficients are, and how sure the choice of terms.

use greybox_calibrate::{qr, student_quantile};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::correlation::{FEW, Lagged};
use crate::options::Options;
use crate::output_error::{self, Linearised, Refined};
use crate::structure::Structure;

/// Standard errors and inclusion probabilities.
#[derive(Debug, Clone, Default)]
pub(crate) struct Precision {
    /// Half-width of the 95 % interval per candidate; none where it is not estimated.
    pub half: Vec<Option<f64>>,
    /// The same for the parameters outside the choice.
    pub extra_half: Vec<Option<f64>>,
    /// Their Cramér–Rao standard deviations.
    pub extra_bound: Vec<Option<f64>>,
    /// Correlation of the first two of them: gain and delay of a feedback.
    pub extra_correlation: Option<f64>,
    /// Share of bootstrap replicates that choose each candidate; empty without replicates.
    pub inclusion: Vec<f64>,
}

impl Precision {
    /// 95 % interval of a candidate's coefficient.
    pub(crate) fn interval(&self, term: usize, value: f64) -> Option<(f64, f64)> {
        self.half.get(term).copied().flatten().map(|h| (value - h, value + h))
    }

    /// 95 % interval of a parameter outside the choice.
    pub(crate) fn extra_interval(&self, index: usize, value: f64) -> Option<(f64, f64)> {
        self.extra_half.get(index).copied().flatten().map(|h| (value - h, value + h))
    }

    /// Cramér–Rao standard deviation of a parameter outside the choice.
    pub(crate) fn extra_bound(&self, index: usize) -> Option<f64> {
        self.extra_bound.get(index).copied().flatten()
    }
}

/// Blocks of the sandwich and of the bootstrap.
pub(crate) const BLOCKS: usize = 60;

/// Covariances at the fit, and the bootstrap of the choice.
pub(crate) fn assess(
    structure: &Structure,
    refined: &Refined,
    allowed: &[bool],
    options: &Options,
) -> Precision {
    let setup = &refined.setup;
    let np = setup.free.len();
    let point = &refined.fit.point;
    let rows = setup.with_problem(&refined.level, &refined.scale, |p| p.rows(point, true, None));
    // Sensitivities to the parameters with what the starts can absorb projected off.
    let projected: Vec<(Vec<f64>, &[f64], usize)> = rows
        .par_iter()
        .map(|s| {
            let (_, j) = output_error::project_start(s.rows, s.jx.clone(), s.jp.clone());
            (j, s.r.as_slice(), s.rows)
        })
        .collect();
    let total: usize = projected.iter().map(|p| p.2).sum();
    let mut stacked = vec![0.0; total * np];
    let mut at = 0;
    for (j, _, m) in &projected {
        for c in 0..np {
            stacked[c * total + at..c * total + at + m].copy_from_slice(&j[c * m..(c + 1) * m]);
        }
        at += m;
    }
    let triangle = qr::triangle(&mut stacked, total, np);
    let starts: usize = rows.len() * setup.system.nx;
    let count: usize = refined.fit.count.iter().sum();
    let freedom = (count as f64 - np as f64 - starts as f64).max(1.0);
    let rss: f64 = projected.iter().map(|p| qr::dot(p.1, p.1)).sum();
    let numerical = numerical(&setup.data.spread, &refined.scale);
    let white = |c: usize| {
        let stretches = rows.iter().zip(&refined.level.segments).map(|(s, segment)| {
            let m = segment.range.len();
            &s.r[c * m..(c + 1) * m]
        });
        Lagged::of(stretches, FEW).is_white()
    };
    let correlated = !(0..setup.system.ny).all(white);
    let gradients = if correlated { gradients(&projected, np) } else { Vec::new() };
    let spread = Spread::new(&triangle, np, rss / freedom + numerical * count as f64, freedom, &gradients);
    let gauss: Vec<f64> = (0..np).map(|i| spread.covariance(i, i).sqrt()).collect();
    let position =
        |name: &str| setup.model.parameter(name).and_then(|i| setup.free.iter().position(|f| f.index == i));
    let of_terms = |values: &[f64]| -> Vec<Option<f64>> {
        structure
            .terms
            .iter()
            .zip(&refined.state.active)
            .map(|(t, active)| if *active { position(&t.parameter).map(|i| values[i]) } else { None })
            .collect()
    };
    let width = &spread.half;
    let extras: Vec<Option<usize>> = structure.outside().map(|(name, _)| position(name)).collect();
    let of_extras = |values: &[f64]| extras.iter().map(|i| i.map(|i| values[i])).collect();
    let extra_correlation = match extras.as_slice() {
        [Some(a), Some(b), ..] => Some(spread.covariance(*a, *b) / (gauss[*a] * gauss[*b])),
        _ => None,
    };
    Precision {
        half: of_terms(width),
        extra_half: of_extras(width),
        extra_bound: of_extras(&gauss),
        extra_correlation,
        inclusion: resampling(structure, refined, allowed, options),
    }
}

/// Standard deviations by the cluster-robust sandwich (RᵀR)⁻¹ Σ g gᵀ (RᵀR)⁻¹, g the gradients summed over
/// blocks of consecutive rows.
fn sandwich(gradients: &[Vec<f64>], inverse: &[f64], np: usize) -> Vec<f64> {
    let blocks = gradients.len() as f64;
    let correction = (blocks / (blocks - 1.0).max(1.0)).sqrt();
    (0..np)
        .map(|i| {
            // Row i of (RᵀR)⁻¹ = R⁻¹ R⁻ᵀ.
            let row: Vec<f64> =
                (0..np).map(|k| (0..np).map(|l| inverse[i * np + l] * inverse[k * np + l]).sum()).collect();
            correction * gradients.iter().map(|g| qr::dot(&row, g).powi(2)).sum::<f64>().sqrt()
        })
        .collect()
}

/// Gradients Jᵀr over blocks of consecutive rows.
fn gradients(projected: &[(Vec<f64>, &[f64], usize)], np: usize) -> Vec<Vec<f64>> {
    let total: usize = projected.iter().map(|p| p.2).sum();
    let length = total.div_ceil(BLOCKS).max(1);
    let mut gradients: Vec<Vec<f64>> = Vec::new();
    for (j, r, m) in projected {
        for from in (0..*m).step_by(length) {
            let to = (from + length).min(*m);
            gradients.push((0..np).map(|c| qr::dot(&j[c * m + from..c * m + to], &r[from..to])).collect());
        }
    }
    gradients
}

/// Mean square of whitened rows that integration may add: it is right to about 10⁻⁶ of the signal, and such errors
/// repeat from sample to sample, so that they do not average out over rows.
pub(crate) fn numerical(spread: &[f64], scale: &[f64]) -> f64 {
    spread.iter().zip(scale).map(|(spread, scale)| (1e-6 * spread / scale).powi(2)).fold(0.0, f64::max)
}

/// How far estimates may be off.
pub(crate) struct Spread {
    inverse: Vec<f64>,
    variance: f64,
    /// Half-widths of the 95 % intervals.
    pub half: Vec<f64>,
}

impl Spread {
    /// From the triangle of the sensitivities and the variance of the rows; where these are correlated, with the
    /// gradients of blocks.
    pub(crate) fn new(
        triangle: &[f64],
        np: usize,
        variance: f64,
        freedom: f64,
        gradients: &[Vec<f64>],
    ) -> Spread {
        let mut spread = Spread { inverse: qr::invert_triangle(triangle, np), variance, half: Vec::new() };
        let gauss = (0..np).map(|i| spread.covariance(i, i).sqrt());
        spread.half = if gradients.is_empty() {
            gauss.map(|g| student_quantile(freedom) * g).collect()
        } else {
            let robust = sandwich(gradients, &spread.inverse, np);
            gauss.zip(robust).map(|(g, s)| student_quantile(BLOCKS as f64 - 1.0) * s.max(g)).collect()
        };
        spread
    }

    /// variance · (RᵀR)⁻¹.
    fn covariance(&self, i: usize, j: usize) -> f64 {
        let np = self.inverse.len().isqrt();
        let row = |i: usize| &self.inverse[i * np..(i + 1) * np];
        self.variance * row(i).iter().zip(row(j)).map(|(a, b)| a * b).sum::<f64>()
    }
}

/// [`inclusion`] of a fit in memory.
fn resampling(structure: &Structure, refined: &Refined, allowed: &[bool], options: &Options) -> Vec<f64> {
    if options.replicates == 0 {
        return Vec::new();
    }
    let linear = output_error::linearise(structure, refined, allowed, BLOCKS);
    linear.map_or_else(Vec::new, |linear| inclusion(structure, &linear, allowed, options))
}

/// Share of block-bootstrap replicates of the linearised problem that choose each candidate.
pub(crate) fn inclusion(
    structure: &Structure,
    linear: &Linearised,
    allowed: &[bool],
    options: &Options,
) -> Vec<f64> {
    if options.replicates == 0 {
        return Vec::new();
    }
    let roles = linear.roles(structure, allowed);
    let counts: Vec<Vec<usize>> = (0..options.replicates as u64)
        .into_par_iter()
        .map(|replicate| {
            let stream = options.seed ^ replicate.wrapping_mul(0x9e37_79b9_7f4a_7c15);
            let mut rng: Pcg64Mcg = rand::SeedableRng::seed_from_u64(stream);
            let blocks = linear.blocks.len();
            let drawn: Vec<usize> = (0..blocks).map(|_| rng.random_range(0..blocks)).collect();
            linear.resampled(&drawn).choose(&roles).columns
        })
        .collect();
    linear
        .column
        .iter()
        .map(|c| {
            c.map_or(0.0, |c| {
                counts.iter().filter(|chosen| chosen.contains(&c)).count() as f64 / counts.len() as f64
            })
        })
        .collect()
}
