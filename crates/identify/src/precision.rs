//! How precise the coefficients are, and how sure the choice of terms.

use greybox_calibrate::qr;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::identify::Options;
use crate::output_error::{self, Refined};
use crate::structure::Structure;

/// Standard errors and inclusion probabilities.
#[derive(Debug, Clone, Default)]
pub(crate) struct Precision {
    /// Half-width of the 95 % interval per candidate; none where it is not estimated.
    pub half: Vec<Option<f64>>,
    /// The same for the parameters of the extras.
    pub extra_half: Vec<Option<f64>>,
    /// Their Cramér–Rao standard deviations.
    pub extra_bound: Vec<Option<f64>>,
    /// Correlation of the first two parameters of the extras.
    pub extra_correlation: Option<f64>,
    /// Share of bootstrap replicates that choose each candidate; empty without replicates.
    pub inclusion: Vec<f64>,
}

impl Precision {
    /// 95 % interval of a candidate's coefficient.
    pub(crate) fn interval(&self, term: usize, value: f64) -> Option<(f64, f64)> {
        self.half.get(term).copied().flatten().map(|h| (value - h, value + h))
    }

    /// 95 % interval of a parameter of the extras.
    pub(crate) fn extra_interval(&self, index: usize, value: f64) -> Option<(f64, f64)> {
        self.extra_half.get(index).copied().flatten().map(|h| (value - h, value + h))
    }

    /// Cramér–Rao standard deviation of a parameter of the extras.
    pub(crate) fn extra_bound(&self, index: usize) -> Option<f64> {
        self.extra_bound.get(index).copied().flatten()
    }
}

/// Blocks of the sandwich and of the bootstrap.
const BLOCKS: usize = 60;

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
    let inverse = qr::invert_triangle(&triangle, np);
    let starts: usize = rows.len() * setup.system.nx;
    let count: usize = refined.fit.count.iter().sum();
    let freedom = (count as f64 - np as f64 - starts as f64).max(1.0);
    let rss: f64 = projected.iter().map(|p| qr::dot(p.1, p.1)).sum();
    // Integration is right to about 10⁻⁶ of the signal; such errors repeat from sample to sample, so that they do
    // not average out over rows.
    let numerical = refined
        .scale
        .iter()
        .zip(&setup.data.spread)
        .map(|(scale, spread)| (1e-6 * spread / scale).powi(2))
        .fold(0.0, f64::max);
    let variance = rss / freedom + numerical * count as f64;
    let covariance = |i: usize, j: usize| -> f64 {
        variance * (0..np).map(|k| inverse[i * np + k] * inverse[j * np + k]).sum::<f64>()
    };
    let gauss: Vec<f64> = (0..np).map(|i| covariance(i, i).sqrt()).collect();
    let correlated = (0..setup.system.ny).any(|c| !white(&rows, &refined.level, c));
    let width = if correlated {
        sandwich(&projected, &inverse, np)
            .iter()
            .zip(&gauss)
            .map(|(s, g)| quantile(BLOCKS as f64 - 1.0) * s.max(*g))
            .collect()
    } else {
        gauss.iter().map(|g| quantile(freedom) * g).collect::<Vec<f64>>()
    };
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
    let extras: Vec<Option<usize>> =
        structure.extras.iter().flat_map(|e| &e.parameters).map(|p| position(&p.0)).collect();
    let of_extras = |values: &[f64]| extras.iter().map(|i| i.map(|i| values[i])).collect();
    let extra_correlation = match extras.as_slice() {
        [Some(a), Some(b), ..] => Some(covariance(*a, *b) / (gauss[*a] * gauss[*b])),
        _ => None,
    };
    Precision {
        half: of_terms(&width),
        extra_half: of_extras(&width),
        extra_bound: of_extras(&gauss),
        extra_correlation,
        inclusion: inclusion(structure, refined, allowed, options),
    }
}

fn quantile(freedom: f64) -> f64 {
    use statrs::distribution::{ContinuousCDF, StudentsT};
    StudentsT::new(0.0, 1.0, freedom.max(1.0)).map_or(1.96, |t| t.inverse_cdf(0.975))
}

/// Whether a channel's residual is white: Ljung–Box over twenty lags at the 0.1 % level.
fn white(rows: &[greybox_calibrate::SegmentRows], level: &greybox_calibrate::Level, channel: usize) -> bool {
    const LAGS: usize = 20;
    let (mut zero, mut n) = (0.0, 0usize);
    let mut lagged = [0.0; LAGS];
    for (s, segment) in rows.iter().zip(&level.segments) {
        let m = segment.range.len();
        let r = &s.r[channel * m..(channel + 1) * m];
        zero += qr::dot(r, r);
        n += m;
        for (l, sum) in lagged.iter_mut().enumerate() {
            if l + 1 < m {
                *sum += qr::dot(&r[l + 1..], &r[..m - l - 1]);
            }
        }
    }
    let n = n as f64;
    let q: f64 = lagged
        .iter()
        .enumerate()
        .map(|(l, c)| (c / zero).powi(2) / (n - l as f64 - 1.0).max(1.0))
        .sum::<f64>()
        * n
        * (n + 2.0);
    // Upper 0.1 % point of χ² with twenty degrees of freedom.
    q < 45.315
}

/// Standard deviations by the cluster-robust sandwich (RᵀR)⁻¹ Σ g gᵀ (RᵀR)⁻¹, g the gradients summed over
/// blocks of consecutive rows.
fn sandwich(projected: &[(Vec<f64>, &[f64], usize)], inverse: &[f64], np: usize) -> Vec<f64> {
    let total: usize = projected.iter().map(|p| p.2).sum();
    let length = total.div_ceil(BLOCKS).max(1);
    let mut gradients: Vec<Vec<f64>> = Vec::new();
    for (j, r, m) in projected {
        for from in (0..*m).step_by(length) {
            let to = (from + length).min(*m);
            gradients.push((0..np).map(|c| qr::dot(&j[c * m + from..c * m + to], &r[from..to])).collect());
        }
    }
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

/// Share of block-bootstrap replicates of the linearised problem that choose each candidate.
fn inclusion(structure: &Structure, refined: &Refined, allowed: &[bool], options: &Options) -> Vec<f64> {
    let none = Vec::new();
    if options.replicates == 0 {
        return none;
    }
    let Some(linear) = output_error::linearise(structure, refined, allowed, BLOCKS) else { return none };
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
