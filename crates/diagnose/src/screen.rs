//! The score test: what every candidate would explain, to first order, at the cost of one lane of the
//! sensitivity integration each.
//!
//! A candidate force c·φ(x̂(t)) is evaluated along the smoothed measured states and injected as an
//! exogenous force; its output response g, the residual r and the sensitivities J of the parameters
//! already in the model are projected off the segments' free initial states. With everything else
//! refitted to first order,
//!
//! ```text
//! c = (GᵀPG)⁻¹ GᵀPr,    gain = cᵀGᵀPG c / rᵀPr,    P = I − J(JᵀJ + Λ)⁻¹Jᵀ
//! ```
//!
//! (a Lagrange-multiplier test; Λ is the prior's precision). Working in output space, it neither
//! differentiates measurements nor suffers from the bias of a wrong nominal parameter.

use std::ops::Range;

use greybox_calibrate::{Level, Point, SegmentRows, Setup, qr};
use greybox_simulate::SignalLanes;
use rayon::prelude::*;

use crate::along::Along;
use crate::candidate::Candidate;
use crate::library::{Mechanism, On, Scale};
use crate::place::Place;

/// One candidate with one choice of its inner parameters, as columns of the regression.
pub struct Variant {
    /// Index of the candidate.
    pub candidate: usize,
    /// Values of the inner parameters.
    pub inner: Vec<f64>,
    /// Sizes of the inner parameters.
    pub scales: Vec<f64>,
    /// Lanes.
    pub columns: Range<usize>,
    /// The single column is the whole change (an input transformed), its coefficient 1 when the inner
    /// values are right; `Some(true)` when the coefficient may rescale the inner value.
    pub secant: Option<bool>,
}

/// What the score test says of a candidate's best variant.
#[derive(Debug, Clone)]
pub struct Scored {
    /// Index of the candidate.
    pub candidate: usize,
    /// Share of the residual sum of squares explained, to first order.
    pub gain: f64,
    /// First values of the parameters, linear ones first.
    pub values: Vec<f64>,
    /// First-order shift of the free parameters that goes with them.
    pub shift: Vec<f64>,
    /// Sizes of the inner parameters.
    pub scales: Vec<f64>,
}

/// Exogenous signals of a set of candidates.
pub struct Lanes {
    /// Per piece.
    pub signals: Vec<SignalLanes>,
    /// The variants behind the lanes.
    pub variants: Vec<Variant>,
}

/// Sizes read off the data for a mechanism's inner parameters at a place.
pub fn inner_scales(
    mechanism: &Mechanism,
    candidate: &Candidate,
    along: &Along<'_>,
    setup: &Setup,
) -> Option<Vec<f64>> {
    let keep = |n: &str| n.to_string();
    mechanism
        .inner
        .iter()
        .map(|inner| {
            let series = |e| -> Option<Vec<f64>> {
                let e = candidate.translate(&setup.model, e, &keep);
                Some(along.eval(&[e], &[])?.pop()?.concat())
            };
            let size = match &inner.scale {
                Scale::One => 1.0,
                Scale::Step => setup.data.pieces.iter().map(|p| p.dt).fold(0.0, f64::max),
                Scale::Rms(e) => {
                    let v = series(e)?;
                    (v.iter().map(|x| x * x).sum::<f64>() / v.len().max(1) as f64).sqrt()
                }
                Scale::Max(e) => series(e)?.iter().fold(0.0f64, |m, x| m.max(x.abs())),
                Scale::Top(e) => series(e)?.iter().fold(f64::NEG_INFINITY, |m, x| m.max(*x)),
                Scale::Range(e) => {
                    let v = series(e)?;
                    v.iter().fold(f64::NEG_INFINITY, |m, x| m.max(*x))
                        - v.iter().fold(f64::INFINITY, |m, x| m.min(*x))
                }
            };
            (size.is_finite() && size > 0.0).then_some(size)
        })
        .collect()
}

/// Builds the lanes of all candidates along given states.
pub fn lanes(setup: &Setup, library: &[Mechanism], candidates: &[Candidate], along: &Along<'_>) -> Lanes {
    let nz = setup.system.nz;
    // Columns first, then interleaved per piece.
    enum Column {
        Force(Vec<f64>, Vec<Vec<f64>>),
        Input(usize, Vec<Vec<f64>>),
    }
    let mut columns: Vec<Column> = Vec::new();
    let mut variants = Vec::new();
    for (index, candidate) in candidates.iter().enumerate() {
        let mechanism = &library[candidate.mechanism];
        let Some(scales) = inner_scales(mechanism, candidate, along, setup) else { continue };
        for grid in grid(mechanism) {
            let inner: Vec<f64> = grid.iter().zip(&scales).map(|(g, s)| g * s).collect();
            let mut extra: Vec<(&str, f64)> = Vec::new();
            for (name, value) in mechanism
                .parameters()
                .zip(std::iter::repeat_n(0.0, mechanism.linear.len()).chain(inner.iter().copied()))
            {
                extra.push((name, value));
            }
            // The file's own parameter names may also be names of the model: mark them.
            let marked: Vec<String> = extra.iter().map(|e| format!("mechanism#{}", e.0)).collect();
            let rename = |n: &str| {
                if mechanism.parameters().any(|p| p == n) { format!("mechanism#{n}") } else { n.to_string() }
            };
            let extra: Vec<(&str, f64)> =
                marked.iter().map(String::as_str).zip(extra.iter().map(|e| e.1)).collect();
            let law = candidate.translate(&setup.model, &mechanism.law, &rename);
            // The law's derivatives with respect to its linear parameters: one column each.
            let slopes = || {
                let slopes: Vec<_> = marked[..mechanism.linear.len()]
                    .iter()
                    .map(|n| law.derivative(n, 0).simplify())
                    .collect();
                along.eval(&slopes, &extra)
            };
            let first = columns.len();
            let mut secant = None;
            match (&candidate.place, mechanism.on) {
                (Place::Motion(motion), On::Motion) => {
                    let sign = if candidate.mirrored { -1.0 } else { 1.0 };
                    let weights: Vec<f64> = motion.weights.iter().map(|w| w * sign).collect();
                    let Some(series) = slopes() else { continue };
                    for s in series {
                        columns.push(Column::Force(weights.clone(), s));
                    }
                }
                (Place::Equation(e), On::Equation) => {
                    let mut weights = vec![0.0; nz];
                    weights[*e] = 1.0;
                    let Some(series) = slopes() else { continue };
                    for s in series {
                        columns.push(Column::Force(weights.clone(), s));
                    }
                }
                (Place::Input(i), On::Input) => {
                    let u = greybox_model::Expr::var(&setup.model.inputs[*i].name);
                    if mechanism.linear.is_empty() {
                        let change = |values: &[f64]| {
                            let extra: Vec<(&str, f64)> =
                                marked.iter().map(String::as_str).zip(values.iter().copied()).collect();
                            along.eval(&[law.clone() - u.clone()], &extra)?.pop()
                        };
                        let Some(series) = change(&inner) else { continue };
                        let tiny: Vec<f64> = inner.iter().map(|v| v * 1e-6).collect();
                        let size = |s: &[Vec<f64>]| s.iter().flatten().fold(0.0f64, |m, v| m.max(v.abs()));
                        let vanishes = change(&tiny).is_some_and(|s| size(&s) < 1e-3 * size(&series));
                        secant = Some(vanishes && inner.len() == 1);
                        if size(&series) == 0.0 {
                            continue;
                        }
                        columns.push(Column::Input(*i, series));
                    } else {
                        let Some(series) = slopes() else { continue };
                        for s in series {
                            columns.push(Column::Input(*i, s));
                        }
                    }
                }
                _ => continue,
            }
            variants.push(Variant {
                candidate: index,
                inner,
                scales: scales.clone(),
                columns: first..columns.len(),
                secant,
            });
        }
    }
    let count = columns.len();
    let signals = setup
        .data
        .pieces
        .iter()
        .enumerate()
        .map(|(p, piece)| {
            let mut lanes = SignalLanes {
                lanes: count,
                weights: vec![0.0; nz * count],
                force: vec![0.0; piece.len * count],
                inputs: Vec::new(),
            };
            for (l, column) in columns.iter().enumerate() {
                match column {
                    Column::Force(weights, series) => {
                        for (e, w) in weights.iter().enumerate() {
                            lanes.weights[e * count + l] = *w;
                        }
                        for (k, v) in series[p].iter().enumerate() {
                            lanes.force[k * count + l] = if v.is_finite() { *v } else { 0.0 };
                        }
                    }
                    Column::Input(i, series) => {
                        let at = match lanes.inputs.iter().position(|t| t.0 == *i) {
                            Some(at) => at,
                            None => {
                                lanes.inputs.push((*i, vec![0.0; piece.len * count]));
                                lanes.inputs.len() - 1
                            }
                        };
                        for (k, v) in series[p].iter().enumerate() {
                            lanes.inputs[at].1[k * count + l] = if v.is_finite() { *v } else { 0.0 };
                        }
                    }
                }
            }
            lanes
        })
        .collect();
    Lanes { signals, variants }
}

fn grid(mechanism: &Mechanism) -> Vec<Vec<f64>> {
    let mut out: Vec<Vec<f64>> = vec![Vec::new()];
    for inner in &mechanism.inner {
        out = out
            .iter()
            .flat_map(|head| {
                inner.grid.iter().map(move |g| {
                    let mut v = head.clone();
                    v.push(*g);
                    v
                })
            })
            .collect();
    }
    out
}

/// Inner products of residual, sensitivities and candidate responses, all projected off the initial
/// states.
pub struct Gram {
    np: usize,
    /// JᵀJ + Λ.
    pub jj: Vec<f64>,
    /// Jᵀr with the prior's pull.
    pub jr: Vec<f64>,
    /// rᵀr.
    pub rr: f64,
    /// JᵀG, `np × lanes`.
    jg: Vec<f64>,
    /// Gᵀr.
    gr: Vec<f64>,
    /// GᵀG block by block.
    gg: Vec<Vec<f64>>,
    blocks: Vec<Range<usize>>,
    lanes: usize,
}

/// A segment's columns with the initial states projected off.
pub struct Projected {
    /// Number of rows.
    pub rows: usize,
    /// Residual.
    pub r: Vec<f64>,
    /// Sensitivities, column by column.
    pub jp: Vec<f64>,
    /// Candidate responses, column by column.
    pub g: Vec<f64>,
}

/// Projects a segment's rows off its initial states.
pub fn project(rows: SegmentRows, nx: usize) -> Projected {
    let SegmentRows { rows: m, mut r, jx, mut jp, mut signals, .. } = rows;
    let mut q = jx;
    qr::orthonormalise(&mut q, m, nx);
    for column in std::iter::once(&mut r[..]).chain(jp.chunks_mut(m)).chain(signals.chunks_mut(m)) {
        qr::project_off(&q, m, column);
    }
    Projected { rows: m, r, jp, g: signals }
}

/// Simulates with the lanes and gathers the inner products; `blocks` are the groups of lanes whose
/// mutual products are wanted.
pub fn gram(
    setup: &Setup,
    level: &Level,
    scale: &[f64],
    point: &Point,
    signals: &[SignalLanes],
    blocks: Vec<Range<usize>>,
) -> Gram {
    let nx = setup.system.nx;
    let np = setup.free.len();
    let lanes = signals.first().map_or(0, |s| s.lanes);
    let rows = setup.with_problem(level, scale, |p| p.rows(point, true, Some(signals)));
    let parts: Vec<Gram> = rows
        .into_par_iter()
        .map(|rows| {
            let s = project(rows, nx);
            let m = s.rows;
            let j = |a: usize| &s.jp[a * m..(a + 1) * m];
            let g = |a: usize| &s.g[a * m..(a + 1) * m];
            let mut part = Gram {
                np,
                jj: vec![0.0; np * np],
                jr: (0..np).map(|a| qr::dot(j(a), &s.r)).collect(),
                rr: qr::dot(&s.r, &s.r),
                jg: vec![0.0; np * lanes],
                gr: (0..lanes).map(|a| qr::dot(g(a), &s.r)).collect(),
                gg: Vec::new(),
                blocks: blocks.clone(),
                lanes,
            };
            for a in 0..np {
                for b in 0..=a {
                    let v = qr::dot(j(a), j(b));
                    part.jj[a * np + b] = v;
                    part.jj[b * np + a] = v;
                }
                for l in 0..lanes {
                    part.jg[a * lanes + l] = qr::dot(j(a), g(l));
                }
            }
            for block in &blocks {
                let n = block.len();
                let mut gg = vec![0.0; n * n];
                for a in 0..n {
                    for b in 0..=a {
                        let v = qr::dot(g(block.start + a), g(block.start + b));
                        gg[a * n + b] = v;
                        gg[b * n + a] = v;
                    }
                }
                part.gg.push(gg);
            }
            part
        })
        .collect();
    // Summed in the order of the segments: the same bytes whatever the number of threads.
    let mut total: Option<Gram> = None;
    for part in parts {
        match &mut total {
            None => total = Some(part),
            Some(t) => {
                t.rr += part.rr;
                let add = |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
                add(&mut t.jj, &part.jj);
                add(&mut t.jr, &part.jr);
                add(&mut t.jg, &part.jg);
                add(&mut t.gr, &part.gr);
                for (a, b) in t.gg.iter_mut().zip(&part.gg) {
                    add(a, b);
                }
            }
        }
    }
    let mut total = total.unwrap_or(Gram {
        np,
        jj: vec![0.0; np * np],
        jr: vec![0.0; np],
        rr: 0.0,
        jg: vec![0.0; np * lanes],
        gr: vec![0.0; lanes],
        gg: blocks.iter().map(|b| vec![0.0; b.len() * b.len()]).collect(),
        blocks: blocks.clone(),
        lanes,
    });
    for (i, f) in setup.free.iter().enumerate() {
        if f.std.is_finite() && f.std > 0.0 {
            total.jj[i * np + i] += 1.0 / (f.std * f.std);
            total.jr[i] += (f.mean - point.parameters[f.index]) / (f.std * f.std);
        }
    }
    total
}

/// A block regressed on the residual, everything else refitted.
pub struct Regressed {
    /// Coefficients of the block's columns (zero where dropped).
    pub coefficients: Vec<f64>,
    /// Share of the residual explained.
    pub gain: f64,
    /// Shift of the free parameters.
    pub shift: Vec<f64>,
}

impl Gram {
    /// rᵀPr: what remains after refitting the parameters to first order.
    pub fn remaining(&self) -> f64 {
        let x = self.solve(&self.jr);
        (self.rr - qr::dot(&x, &self.jr)).max(0.0)
    }

    fn solve(&self, b: &[f64]) -> Vec<f64> {
        // Scaled to unit diagonal: the parameters' units differ by many decades.
        let n = self.np;
        let d: Vec<f64> =
            (0..n).map(|i| if self.jj[i * n + i] > 0.0 { self.jj[i * n + i].sqrt() } else { 1.0 }).collect();
        let a: Vec<f64> = (0..n * n).map(|i| self.jj[i] / (d[i / n] * d[i % n])).collect();
        let b: Vec<f64> = b.iter().zip(&d).map(|(b, d)| b / d).collect();
        qr::solve_spd(&a, n, &b).iter().zip(&d).map(|(x, d)| x / d).collect()
    }

    /// Regresses block `index`; `positive[i]` drops column i when its coefficient comes out negative.
    /// `None` when the block adds nothing that the parameters cannot do already.
    pub fn regress(&self, index: usize, positive: &[bool], ridge: f64) -> Option<Regressed> {
        let block = self.blocks[index].clone();
        let n = block.len();
        let np = self.np;
        let columns: Vec<Vec<f64>> = block
            .clone()
            .map(|l| self.solve(&(0..np).map(|a| self.jg[a * self.lanes + l]).collect::<Vec<_>>()))
            .collect();
        let base = self.solve(&self.jr);
        let jg = |a: usize, l: usize| self.jg[a * self.lanes + block.start + l];
        let mut gg = vec![0.0; n * n];
        let mut gr = vec![0.0; n];
        for a in 0..n {
            for b in 0..n {
                gg[a * n + b] =
                    self.gg[index][a * n + b] - (0..np).map(|i| jg(i, a) * columns[b][i]).sum::<f64>();
            }
            gr[a] = self.gr[block.start + a] - (0..np).map(|i| jg(i, a) * base[i]).sum::<f64>();
        }
        let mut kept: Vec<usize> =
            (0..n).filter(|&a| gg[a * n + a] > 1e-6 * self.gg[index][a * n + a]).collect();
        let rr = self.remaining();
        loop {
            if kept.is_empty() {
                return None;
            }
            let m = kept.len();
            let d: Vec<f64> = kept.iter().map(|&a| gg[a * n + a].sqrt()).collect();
            let mut a: Vec<f64> = vec![0.0; m * m];
            for i in 0..m {
                for j in 0..m {
                    a[i * m + j] = gg[kept[i] * n + kept[j]] / (d[i] * d[j]);
                }
                a[i * m + i] += ridge / (d[i] * d[i]) + 1e-12;
            }
            let b: Vec<f64> = (0..m).map(|i| gr[kept[i]] / d[i]).collect();
            let x = qr::solve_spd(&a, m, &b);
            let bad: Vec<usize> = (0..m).filter(|&i| positive[kept[i]] && x[i] < 0.0).collect();
            if let Some(&worst) = bad.iter().min_by(|&&i, &&j| x[i].total_cmp(&x[j])) {
                kept.remove(worst);
                continue;
            }
            let mut coefficients = vec![0.0; n];
            let mut explained = 0.0;
            for i in 0..m {
                coefficients[kept[i]] = x[i] / d[i];
                explained += x[i] * b[i];
            }
            let shift = (0..np)
                .map(|i| base[i] - (0..n).map(|c| columns[c][i] * coefficients[c]).sum::<f64>())
                .collect();
            return Some(Regressed { coefficients, gain: explained / rr.max(1e-300), shift });
        }
    }
}

/// Scores every candidate at the point of a fit, best first.
pub fn screen(
    setup: &Setup,
    library: &[Mechanism],
    candidates: &[Candidate],
    level: &Level,
    scale: &[f64],
    point: &Point,
) -> Vec<Scored> {
    let along = Along::smoothed(setup, level, scale, point);
    let lanes = lanes(setup, library, candidates, &along);
    let blocks: Vec<Range<usize>> = lanes.variants.iter().map(|v| v.columns.clone()).collect();
    let gram = gram(setup, level, scale, point, &lanes.signals, blocks);
    let mut best: Vec<Option<Scored>> = vec![None; candidates.len()];
    for (index, variant) in lanes.variants.iter().enumerate() {
        let candidate = &candidates[variant.candidate];
        let mechanism = &library[candidate.mechanism];
        let positive: Vec<bool> = if variant.secant.is_some() {
            vec![true]
        } else {
            mechanism.linear.iter().map(|n| mechanism.positive.contains(n)).collect()
        };
        let Some(regressed) = gram.regress(index, &positive, 0.0) else { continue };
        let (gain, values) = match variant.secant {
            None => {
                let mut values = regressed.coefficients.clone();
                values.extend(&variant.inner);
                (regressed.gain, values)
            }
            Some(scalable) => {
                let c = regressed.coefficients[0];
                if scalable && c < 3.0 {
                    (regressed.gain, variant.inner.iter().map(|v| v * c).collect())
                } else {
                    // Gain with the coefficient held at one: c(2 − 1/c) of the best.
                    let gain = if c > 0.0 { regressed.gain * (2.0 / c - 1.0 / (c * c)) } else { 0.0 };
                    (gain, variant.inner.clone())
                }
            }
        };
        if gain <= 0.0 || gain.is_nan() {
            continue;
        }
        let slot = &mut best[variant.candidate];
        if slot.as_ref().is_none_or(|s| gain > s.gain) {
            *slot = Some(Scored {
                candidate: variant.candidate,
                gain,
                values,
                shift: regressed.shift,
                scales: variant.scales.clone(),
            });
        }
    }
    let mut scored: Vec<Scored> = best.into_iter().flatten().collect();
    scored.sort_by(|a, b| b.gain.total_cmp(&a.gain).then(a.candidate.cmp(&b.candidate)));
    scored
}
