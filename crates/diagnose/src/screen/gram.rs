//! Gram matrices of residual, sensitivities and candidates, with the initial states projected off, and regressions on them.

use std::ops::Range;
use std::sync::Arc;

use greybox_calibrate::{FitPoint, FreeParameter, SegmentRows, qr};
use greybox_simulate::SignalLanes;
use rayon::prelude::*;

use super::INDEPENDENT;

/// Inner products of residual, sensitivities and candidate responses, all projected off the initial
/// states.
#[derive(Clone)]
pub struct Gram {
    pub(super) np: usize,
    /// JᵀJ + Λ.
    pub jj: Vec<f64>,
    /// Λ, the prior's precision per parameter.
    prior: Vec<f64>,
    /// Jᵀr with the prior's pull.
    pub jr: Vec<f64>,
    /// rᵀr.
    pub rr: f64,
    /// JᵀG, `np × lanes`.
    pub(super) jg: Vec<f64>,
    /// Gᵀr.
    pub(super) gr: Vec<f64>,
    /// GᵀG block by block.
    pub(super) gg: Vec<Vec<f64>>,
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
    project_columns(rows, nx, None)
}

/// [`project`] with each column the sum of several lanes.
fn project_columns(rows: SegmentRows, nx: usize, columns: Option<&[Range<usize>]>) -> Projected {
    let SegmentRows { rows: m, mut r, jx, mut jp, mut signals, .. } = rows;
    if let Some(columns) = columns
        && columns.len() * m != signals.len()
    {
        let mut sums = vec![0.0; columns.len() * m];
        for (lanes, sum) in columns.iter().zip(sums.chunks_mut(m)) {
            for lane in lanes.clone() {
                sum.iter_mut().zip(&signals[lane * m..(lane + 1) * m]).for_each(|(a, b)| *a += b);
            }
        }
        signals = sums;
    }
    let mut q = jx;
    qr::orthonormalise(&mut q, m, nx);
    for column in std::iter::once(&mut r[..]).chain(jp.chunks_mut(m)).chain(signals.chunks_mut(m)) {
        qr::project_off(&q, m, column);
    }
    Projected { rows: m, r, jp, g: signals }
}

/// A block with the parameters projected off.
pub(super) struct Projection {
    pub(super) gg: Vec<f64>,
    pub(super) gr: Vec<f64>,
    /// What the parameters do for each column, and for the residual.
    pub(super) columns: Vec<Vec<f64>>,
    pub(super) base: Vec<f64>,
}

impl Gram {
    /// No rows yet: of `np` parameters and so many lanes, with the mutual products of these blocks of them.
    pub fn new(np: usize, lanes: usize, blocks: &[Range<usize>]) -> Gram {
        Gram {
            np,
            jj: vec![0.0; np * np],
            prior: vec![0.0; np],
            jr: vec![0.0; np],
            rr: 0.0,
            jg: vec![0.0; np * lanes],
            gr: vec![0.0; lanes],
            gg: blocks.iter().map(|b| vec![0.0; b.len() * b.len()]).collect(),
            blocks: blocks.to_vec(),
            lanes,
        }
    }

    /// Adds a row of unit variance: residual, sensitivities, candidate responses.
    pub fn add_row(&mut self, r: f64, j: &[f64], g: &[f64]) {
        let (np, lanes) = (self.np, self.lanes);
        self.rr += r * r;
        for a in 0..np {
            self.jr[a] += j[a] * r;
            for b in 0..np {
                self.jj[a * np + b] += j[a] * j[b];
            }
            let row = &mut self.jg[a * lanes..(a + 1) * lanes];
            row.iter_mut().zip(g).for_each(|(s, g)| *s += j[a] * g);
        }
        self.gr.iter_mut().zip(g).for_each(|(s, g)| *s += g * r);
        for (block, gg) in self.blocks.iter().zip(&mut self.gg) {
            let g = &g[block.clone()];
            for (a, row) in g.iter().zip(gg.chunks_exact_mut(g.len().max(1))) {
                row.iter_mut().zip(g).for_each(|(s, b)| *s += a * b);
            }
        }
    }

    /// Adds the rows of another of the same shape.
    pub fn add(&mut self, other: &Gram) {
        self.rr += other.rr;
        let add = |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        add(&mut self.jj, &other.jj);
        add(&mut self.jr, &other.jr);
        add(&mut self.jg, &other.jg);
        add(&mut self.gr, &other.gr);
        for (a, b) in self.gg.iter_mut().zip(&other.gg) {
            add(a, b);
        }
    }

    /// Adds what is known of the parameters at these values, where a row's square is worth `weight` of the priors'.
    pub fn add_priors(&mut self, free: &[FreeParameter], parameters: &[f64], weight: f64) {
        for (i, f) in free.iter().enumerate() {
            let (g, slope) = f.prior.at(parameters[f.index]);
            self.jj[i * self.np + i] += slope * slope / weight;
            self.prior[i] = slope * slope / weight;
            self.jr[i] -= slope * g / weight;
        }
    }
}

/// Simulates with the lanes and gathers the inner products; `blocks` are the groups of lanes whose
/// mutual products are wanted.
pub fn gram(
    at: FitPoint<'_>,
    signals: &[Arc<SignalLanes>],
    columns: &[Range<usize>],
    blocks: Vec<Range<usize>>,
) -> Gram {
    let FitPoint { setup, level, scale, point } = at;
    let nx = setup.system.nx;
    let np = setup.free.len();
    let lanes = columns.len();
    let rows = setup.with_problem(level, scale, |p| p.rows(point, true, (lanes > 0).then_some(signals)));
    let parts: Vec<Gram> = rows
        .into_par_iter()
        .map(|rows| {
            let s = project_columns(rows, nx, Some(columns));
            let m = s.rows;
            let j = |a: usize| &s.jp[a * m..(a + 1) * m];
            let g = |a: usize| &s.g[a * m..(a + 1) * m];
            let mut part = Gram {
                np,
                jj: vec![0.0; np * np],
                prior: vec![0.0; np],
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
    let mut total = Gram::new(np, lanes, &blocks);
    parts.iter().for_each(|part| total.add(part));
    total.add_priors(&setup.free, &point.parameters, 1.0);
    total
}

/// Solves a x = b, scaled to unit diagonal: the parameters' units differ by many decades.
fn solve_scaled(a: &[f64], n: usize, b: &[f64]) -> Vec<f64> {
    let d: Vec<f64> = (0..n).map(|i| if a[i * n + i] > 0.0 { a[i * n + i].sqrt() } else { 1.0 }).collect();
    let scaled: Vec<f64> = (0..n * n).map(|i| a[i] / (d[i / n] * d[i % n])).collect();
    let b: Vec<f64> = b.iter().zip(&d).map(|(b, d)| b / d).collect();
    qr::solve_spd(&scaled, n, &b).iter().zip(&d).map(|(x, d)| x / d).collect()
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

    /// Share of a column's sum of squares that the parameters cannot do, whatever the prior says of them.
    pub(super) fn independence(&self, column: usize, size: f64) -> f64 {
        let jg: Vec<f64> = (0..self.np).map(|a| self.jg[a * self.lanes + column]).collect();
        let mut data = self.jj.clone();
        for (i, p) in self.prior.iter().enumerate() {
            // A trace of the diagonal keeps unseen parameters from everything.
            let d = (data[i * self.np + i] - p).max(0.0);
            data[i * self.np + i] = d * (1.0 + 1e-9);
        }
        let x = solve_scaled(&data, self.np, &jg);
        1.0 - qr::dot(&x, &jg) / size.max(1e-300)
    }

    pub(super) fn solve(&self, b: &[f64]) -> Vec<f64> {
        solve_scaled(&self.jj, self.np, b)
    }

    /// The same without some of the parameters, each where it would be if its value were lower by so much: what it did is in
    /// the residual.
    #[must_use]
    pub fn without(&self, gone: &[(usize, f64)]) -> Gram {
        let (np, lanes) = (self.np, self.lanes);
        let kept: Vec<usize> = (0..np).filter(|a| gone.iter().all(|g| g.0 != *a)).collect();
        let mut all = self.clone();
        for (i, by) in gone {
            // r + J by, column by column.
            all.rr += 2.0 * by * all.jr[*i] + by * by * self.jj[i * np + i];
            for a in 0..np {
                all.jr[a] += by * self.jj[a * np + i];
            }
            for l in 0..lanes {
                all.gr[l] += by * self.jg[i * lanes + l];
            }
        }
        let n = kept.len();
        let mut out =
            Gram { np: n, jj: vec![0.0; n * n], prior: vec![0.0; n], jr: Vec::new(), jg: Vec::new(), ..all };
        for (i, a) in kept.iter().enumerate() {
            for (j, b) in kept.iter().enumerate() {
                out.jj[i * n + j] = self.jj[a * np + b];
            }
            out.prior[i] = self.prior[*a];
            out.jr.push(all.jr[*a]);
            out.jg.extend_from_slice(&self.jg[a * lanes..(a + 1) * lanes]);
        }
        out
    }

    /// The same with what some columns do, by so much each, in the residual. Of one block.
    #[must_use]
    pub(super) fn with_columns(&self, did: &[(usize, f64)]) -> Gram {
        let (np, lanes) = (self.np, self.lanes);
        let mut out = self.clone();
        for (i, by) in did {
            out.rr += 2.0 * by * out.gr[*i] + by * by * self.gg[0][i * lanes + i];
            for a in 0..np {
                out.jr[a] += by * self.jg[a * lanes + i];
            }
            for l in 0..lanes {
                out.gr[l] += by * self.gg[0][l * lanes + i];
            }
        }
        out
    }

    /// GᵀG and Gᵀr of block `index` with the parameters projected off.
    pub fn projected(&self, index: usize) -> (Vec<f64>, Vec<f64>) {
        let Projection { gg, gr, .. } = self.projection(index);
        (gg, gr)
    }

    pub(super) fn projection(&self, index: usize) -> Projection {
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
        Projection { gg, gr, columns, base }
    }

    /// Regresses block `index`; `positive[i]` drops column i when its coefficient comes out negative.
    /// `None` when the block adds nothing that the parameters cannot do already.
    pub fn regress(&self, index: usize, positive: &[bool], ridge: f64) -> Option<Regressed> {
        let block = self.blocks[index].clone();
        let (n, np) = (block.len(), self.np);
        let Projection { gg, gr, columns, base } = self.projection(index);
        let mut kept: Vec<usize> = (0..n)
            .filter(|&a| {
                let size = self.gg[index][a * n + a];
                gg[a * n + a] > 0.0 && self.independence(block.start + a, size) > INDEPENDENT
            })
            .collect();
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
