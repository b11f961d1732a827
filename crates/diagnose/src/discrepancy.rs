//! The non-parametric alternative: [free shapes](crate::shapes), to see whether anything systematic is left.
//!
//! They are injected like any candidate. What they explain on folds they were not fitted to is force that acts on the machine
//! and has a shape; noise gains nothing.

use std::sync::Arc;

use greybox_calibrate::{FitPoint, Point, Segmentation, Setup, qr};
use greybox_simulate::SignalLanes;
use rayon::prelude::*;

use crate::evidence::{cross_validation_improvement, least_effective_sample_ratio};
use crate::screen::{project, signals};
use crate::shapes::{Shapes, Variable};
use crate::trajectory::TrajectoryEval;

const FOLDS: usize = 10;
/// Samples that tell enough, and fewest segments that are kept.
const MOST_SAMPLES: usize = 20_000;
const LEAST_SEGMENTS: usize = 4;
/// Share of the samples at either end of a variable that get no knots of their own: least squares has no prior.
const RARE: f64 = 0.01;
/// Fewest independent samples (N κ) for a test of free shapes.
const LEAST_INDEPENDENT: f64 = 20.0;

/// What free shapes explain beyond the model.
#[derive(Debug, Clone, PartialEq)]
pub struct Discrepancy {
    /// Relative drop of the held-out residual sum of squares.
    pub gain: f64,
    /// Mean over standard error of the folds' drops.
    pub t: f64,
    /// The variable whose functions alone explain most, and what they gain.
    pub variable: Option<(Variable, f64)>,
    /// Samples that were looked at, over all channels.
    pub samples: usize,
    /// Independent samples that one of them is worth.
    pub effective_sample_ratio: f64,
    /// Held-out errors by fold, with the shapes.
    pub errors: Vec<f64>,
    /// Held-out error of the model without them, over all folds.
    pub without: f64,
    /// Samples of a block; every tenth block is a fold.
    pub block: usize,
}

/// Every so many-th segment, where there are more samples than the test needs (and no memory goes on from one
/// segment to the next).
fn thinned(setup: &Setup, level: &Segmentation, point: &Point) -> (Segmentation, Point) {
    let total: usize = level.segments.iter().map(|s| s.range.len()).sum();
    let step = if setup.carried.is_empty() { total.div_ceil(MOST_SAMPLES) } else { 1 };
    // Few long segments are as many blocks as they hold.
    let step = step.min(level.segments.len() / LEAST_SEGMENTS).max(1);
    let (mut segments, mut priors, mut starts) = (Vec::new(), Vec::new(), Vec::new());
    for i in (0..level.segments.len()).step_by(step) {
        segments.push(level.segments[i].clone());
        priors.push(level.priors[i].clone());
        starts.push(point.starts[i].clone());
    }
    (Segmentation { segments, priors }, Point { parameters: point.parameters.clone(), starts })
}

/// Tests a fitted model against free shapes: `scale` is one per channel, SI, `point` an optimum at `level`. `None`
/// where no motion has a shape, or where there is too little independent data.
pub fn test(at: FitPoint<'_>) -> Option<Discrepancy> {
    let FitPoint { setup, level, point, .. } = at;
    let (level, point) = &thinned(setup, level, point);
    let at = FitPoint { level, point, ..at };
    let along = TrajectoryEval::undisturbed(at);
    let Shapes { groups, forces } = Shapes::along(setup, &along, RARE)?;
    let (lanes, signals) = (forces.len(), signals(setup, &forces));
    let total: usize = level.segments.iter().map(|s| s.range.len()).sum();
    // Blocks no shorter than the residual's correlation: neighbours must not predict each other.
    let effective_sample_ratio = least_effective_sample_ratio(at);
    if (total as f64) * effective_sample_ratio < LEAST_INDEPENDENT {
        return None; // too little independent data to call anything systematic
    }
    let block = (total / 40).max((1.0 / effective_sample_ratio).ceil() as usize).max(1);
    let data = Folded::new(at, &signals, block)?;
    let np = setup.free.len();
    let parameters: Vec<usize> = (0..np).collect();
    let base = data.errors(&parameters);
    let base_sum: f64 = base.iter().sum();
    let with = |range: std::ops::Range<usize>| {
        let mut chosen = parameters.clone();
        chosen.extend(range.map(|l| np + l));
        let errors = data.errors(&chosen);
        let (total, t) = cross_validation_improvement(&base, &errors);
        (total / base_sum.max(1e-300), t, errors)
    };
    let mut all = with(0..lanes);
    let mut best: Option<(Variable, f64)> = None;
    let mut single = (0.0, 0.0, Vec::new());
    for group in &groups {
        let one = with(group.columns.clone());
        if best.as_ref().is_none_or(|b| one.0 > b.1) {
            best = Some((group.variable.clone(), one.0));
            single = one;
        }
    }
    // All functions together may overfit where one family does not: the better of the two counts.
    if single.0 > all.0 {
        all = single;
    }
    let (gain, t, errors) = all;
    Some(Discrepancy {
        gain,
        t,
        variable: best,
        samples: total * setup.system.ny,
        effective_sample_ratio,
        errors,
        without: base_sum,
        block,
    })
}

/// Held-out errors by fold of a model without free shapes, on the folds of a [`Discrepancy`] of the same level with
/// blocks of `block` samples.
pub fn held_out(at: FitPoint<'_>, block: usize) -> Option<Vec<f64>> {
    let FitPoint { setup, level, point, .. } = at;
    let (level, point) = &thinned(setup, level, point);
    let none: Vec<Arc<SignalLanes>> =
        setup.data.pieces.iter().map(|_| Arc::new(SignalLanes::default())).collect();
    let data = Folded::new(FitPoint { level, point, ..at }, &none, block)?;
    Some(data.errors(&(0..setup.free.len()).collect::<Vec<_>>()))
}

/// Gram matrices of [J | G | r], the starts projected off: of all data and fold by fold.
struct Folded {
    /// Columns of J.
    parameters: usize,
    width: usize,
    whole: Vec<f64>,
    folds: Vec<Vec<f64>>,
}

impl Folded {
    /// Every tenth block of `block` samples is a fold; `None` where there are less than four blocks.
    fn new(at: FitPoint<'_>, signals: &[Arc<SignalLanes>], block: usize) -> Option<Folded> {
        let FitPoint { setup, level, scale, point } = at;
        let (nx, ny, np) = (setup.system.nx, setup.system.ny, setup.free.len());
        let lanes = signals.first().map_or(0, |s| s.lanes);
        let width = np + lanes + 1;
        let signals = (lanes > 0).then_some(signals);
        let rows = setup.with_problem(level, scale, |p| p.rows(point, true, signals));
        let jobs: Vec<_> = rows.into_iter().zip(&level.segments).collect();
        let per_segment: Vec<Vec<Vec<f64>>> = jobs
            .into_par_iter()
            .map(|(rows, segment)| {
                let p = project(rows, nx);
                let (n, m) = (segment.range.len(), p.rows);
                let parts = (n as f64 / block as f64).round().max(1.0) as usize;
                let column = |i: usize| -> &[f64] {
                    if i < np {
                        &p.jp[i * m..(i + 1) * m]
                    } else if i < np + lanes {
                        &p.g[(i - np) * m..(i - np + 1) * m]
                    } else {
                        &p.r
                    }
                };
                (0..parts)
                    .map(|b| {
                        let (from, to) = (b * n / parts, (b + 1) * n / parts);
                        let mut gram = vec![0.0; width * width];
                        for i in 0..width {
                            for j in 0..=i {
                                let mut sum = 0.0;
                                for c in 0..ny {
                                    let r = c * n + from..c * n + to;
                                    sum += qr::dot(&column(i)[r.clone()], &column(j)[r]);
                                }
                                gram[i * width + j] = sum;
                                gram[j * width + i] = sum;
                            }
                        }
                        gram
                    })
                    .collect()
            })
            .collect();
        let blocks: Vec<Vec<f64>> = per_segment.into_iter().flatten().collect();
        let count = FOLDS.min(blocks.len());
        if count < 4 {
            return None;
        }
        let mut whole = vec![0.0; width * width];
        let mut folds = vec![vec![0.0; width * width]; count];
        for (b, gram) in blocks.iter().enumerate() {
            for (i, v) in gram.iter().enumerate() {
                whole[i] += v;
                folds[b % count][i] += v;
            }
        }
        Some(Folded { parameters: np, width, whole, folds })
    }

    /// Held-out errors by fold of a regression on the chosen columns.
    fn errors(&self, chosen: &[usize]) -> Vec<f64> {
        let Folded { parameters, width, whole, folds } = self;
        let (np, width) = (*parameters, *width);
        let n = chosen.len();
        let r = width - 1;
        folds
            .iter()
            .map(|fold| {
                let d: Vec<f64> = chosen
                    .iter()
                    .map(|&i| {
                        let v = whole[i * width + i];
                        if v > 0.0 { v.sqrt() } else { 1.0 }
                    })
                    .collect();
                let mut a = vec![0.0; n * n];
                let mut b = vec![0.0; n];
                for (x, &i) in chosen.iter().enumerate() {
                    for (y, &j) in chosen.iter().enumerate() {
                        a[x * n + y] = (whole[i * width + j] - fold[i * width + j]) / (d[x] * d[y]);
                    }
                    a[x * n + x] += if i < np { 1e-6 } else { 1e-3 };
                    b[x] = (whole[i * width + r] - fold[i * width + r]) / d[x];
                }
                let x: Vec<f64> = qr::solve_spd(&a, n, &b).iter().zip(&d).map(|(x, d)| x / d).collect();
                let mut sse = fold[r * width + r];
                for (p, &i) in chosen.iter().enumerate() {
                    sse -= 2.0 * x[p] * fold[i * width + r];
                    for (q, &j) in chosen.iter().enumerate() {
                        sse += x[p] * x[q] * fold[i * width + j];
                    }
                }
                sse
            })
            .collect()
    }
}
