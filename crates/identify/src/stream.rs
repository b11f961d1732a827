//! Identification in constant memory.
//!
//! Around a model with coefficients θ₀ every block of data is a linear regression z = J θ + e in the metric of the
//! simulated output (`output_error`), with what the block's own starts can absorb projected off. All that the choice
//! of terms and their estimates need of it is the triangle R of \[J | z\] = Q R, and triangles of several blocks become
//! one by factorising them on top of each other. One pass over the data is therefore one step of Gauss–Newton on all
//! of it, whatever its length: blocks are mapped to [`Statistics`] side by side, the statistics merged in order.
//!
//! The candidates and a first model come from the first block, identified as usual.

use std::sync::Arc;

use greybox_calibrate::{Data, HoldoutSource, Limits, Point, Setup, qr};
use greybox_recording::Recording;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::choose::Reduced;
use crate::correlation::{LONGEST, Lagged};
use crate::error::IdentifyError;
use crate::identify::{self, Blocks, Identification, ProgressListener, Search, conclude, search};
use crate::options::Options;
use crate::output_error::{self, Linearised, Refined, either, floor, stack, triangle_of, widen};
use crate::precision::{self, BLOCKS, Precision, Spread};

/// Passes at most.
const PASSES: usize = 6;

/// A step below this share of the intervals' half-widths is the last.
const SETTLED: f64 = 0.1;

/// Samples to which the start of a segment is fitted.
const HEAD: usize = 500;

/// Independent samples that count in the choice of terms at most: what does not lower the mean square of the residual
/// by the penalty of a term over so many is left out, however sure it is. With 10⁸ samples every model is wrong in
/// detail.
const MOST: f64 = 1e6;

/// A model around which blocks of data are reduced to [`Statistics`].
///
/// [`identify_blocks`] drives it; an engine that works over many machines can do so itself: [`begin`](Self::begin) on
/// one block, [`map`](Self::map) on every block wherever it is, [`Statistics::merge`] in the order of the blocks,
/// [`step`](Self::step), and again until [`is_settled`](Self::is_settled); then [`conclude`](Self::conclude).
#[derive(Debug, Clone)]
pub struct Linearisation {
    search: Search,
    /// Samples of a segment.
    segment: usize,
    /// Steps made, and how far the last one went in half-widths of the intervals.
    steps: usize,
    moved: f64,
}

/// What a block of data says around a [`Linearisation`]; additive over blocks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Statistics {
    /// θ₀.
    around: Vec<f64>,
    /// Triangles of \[J | z\], each of consecutive blocks; at most twice as many as the bootstrap draws from.
    groups: Vec<Vec<f64>>,
    blocks: usize,
    segments: usize,
    samples: usize,
    lost: usize,
    /// Residual sum of squares per channel, scaled, and its number of values.
    rss: Vec<f64>,
    count: Vec<usize>,
    lagged: Vec<Lagged>,
}

impl Statistics {
    /// Samples behind them.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.samples
    }

    /// These blocks and those after them.
    ///
    /// # Errors
    /// [`IdentifyError::Mixed`] where the two were not made around the same model.
    pub fn merge(mut self, later: Self) -> Result<Self, IdentifyError> {
        if self.around != later.around {
            return Err(IdentifyError::Mixed);
        }
        self.groups.extend(later.groups);
        while self.groups.len() > 2 * BLOCKS {
            let stride = self.around.len() + 1;
            self.groups = self.groups.chunks(2).map(|pair| stack(pair, stride)).collect();
        }
        self.blocks += later.blocks;
        self.segments += later.segments;
        self.samples += later.samples;
        self.lost += later.lost;
        self.rss.iter_mut().zip(&later.rss).for_each(|(a, b)| *a += b);
        self.count.iter_mut().zip(&later.count).for_each(|(a, b)| *a += b);
        self.lagged.iter_mut().zip(&later.lagged).for_each(|(a, b)| a.add(b));
        Ok(self)
    }

    /// The triangle of all blocks.
    fn triangle(&self) -> Vec<f64> {
        stack(&self.groups, self.around.len() + 1)
    }

    /// Gradient Jᵀ(z − J θ) of a group.
    fn gradient(group: &[f64], theta: &[f64]) -> Vec<f64> {
        let stride = theta.len() + 1;
        let left: Vec<f64> = (0..theta.len())
            .map(|i| {
                let row = &group[i * stride..(i + 1) * stride];
                row[theta.len()] - qr::dot(&row[i..theta.len()], &theta[i..])
            })
            .collect();
        (0..theta.len()).map(|c| (0..=c).map(|i| group[i * stride + c] * left[i]).sum()).collect()
    }

    /// Gram matrix of a group, every row counting as `weight`.
    fn gram(group: &[f64], stride: usize, weight: f64) -> Vec<f64> {
        let entry = |i: usize, j: usize| {
            (0..=i.min(j)).map(|l| group[l * stride + i] * group[l * stride + j]).sum::<f64>()
        };
        (0..stride * stride).map(|k| weight * entry(k / stride, k % stride)).collect()
    }
}

impl Linearisation {
    /// Candidates and a first model from one block.
    ///
    /// # Errors
    /// As [`identify()`](crate::identify()); [`IdentifyError::DelayInBlocks`] and
    /// [`IdentifyError::DeadTimeInBlocks`] where a delay is asked for.
    pub fn begin(
        block: &Recording,
        options: &Options,
        listener: &dyn ProgressListener,
    ) -> Result<Self, IdentifyError> {
        if options.delay.is_some() {
            return Err(IdentifyError::DelayInBlocks);
        }
        if !options.dead_times.is_empty() {
            return Err(IdentifyError::DeadTimeInBlocks);
        }
        let search = search(std::slice::from_ref(block), options, listener)?;
        let samples = search.data.samples();
        let segment = samples.div_ceil(search.refined.level.segments.len().max(1));
        Ok(Self { search, segment, steps: 0, moved: f64::INFINITY })
    }

    /// Reduces a block.
    ///
    /// # Errors
    /// [`IdentifyError::Data`] where a channel is missing.
    pub fn map(&self, block: &Recording) -> Result<Statistics, IdentifyError> {
        let Search { structure, first, refined, .. } = &self.search;
        let data = Arc::new(Data::new(&refined.setup.model, std::slice::from_ref(block))?);
        let samples = data.samples();
        let setup = refined.setup.with_data(data);
        let still = Setup { free: Vec::new(), ..setup.clone() };
        let level = still.level((samples as f64 / self.segment as f64).round().max(1.0) as usize);
        let parameters = refined.fit.point.parameters.clone();
        let point = Point { starts: still.starts(&level, &parameters), parameters };
        // A start is fitted to the samples after it; what these leave of its error is projected off.
        let mut heads = level.clone();
        heads.segments.iter_mut().for_each(|s| s.range.end = s.range.end.min(s.range.start + HEAD));
        let limits = Limits { iterations: 10, tolerance: 1e-6 };
        let fit = still.with_problem(&heads, &refined.scale, |p| p.fit(point, limits));
        let here = Refined { setup, level, fit, ..refined.clone() };
        let ny = here.setup.system.ny;
        let around = self.theta();
        let wide = widen(structure, &here, &first.allowed).filter(|_| here.fit.cost.is_finite());
        let Some(wide) = wide else {
            return Ok(Statistics {
                around,
                groups: Vec::new(),
                blocks: 0,
                segments: 0,
                samples: 0,
                lost: samples,
                rss: vec![0.0; ny],
                count: vec![0; ny],
                lagged: vec![Lagged::of([], LONGEST); ny],
            });
        };
        Ok(Statistics {
            groups: vec![triangle_of(&wide.segments, around.len() + 1)],
            lagged: output_error::lagged(&wide.segments, &around, &here.level.segments, ny, LONGEST),
            around,
            blocks: 1,
            segments: here.level.segments.len(),
            samples,
            lost: 0,
            rss: wide.rss,
            count: wide.count,
        })
    }

    /// Coefficients of all candidates that have a column.
    fn theta(&self) -> Vec<f64> {
        let values = self.columns().into_iter().zip(&self.search.refined.state.values);
        values.filter_map(|(column, value)| column.map(|_| *value)).collect()
    }

    /// Column of each candidate.
    fn columns(&self) -> Vec<Option<usize>> {
        let Search { structure, first, refined, .. } = &self.search;
        output_error::columns(structure, &either(&refined.state.active, &first.allowed))
    }

    /// The regression of all blocks by their triangle, as many rows in it as are independent; no blocks to resample.
    fn linearised(&self, statistics: &Statistics, triangle: &[f64]) -> (Linearised, f64) {
        let np = statistics.around.len();
        let count: usize = statistics.count.iter().sum();
        let time = statistics.lagged.iter().map(Lagged::time).fold(1.0, f64::max);
        let share = (1.0 / time).min(MOST / count as f64);
        let refined = &self.search.refined;
        let floor = floor(&refined.setup.data.spread, &refined.scale);
        let reduced = Reduced::from_triangle(triangle, np, count as f64, floor).weighted(share);
        (Linearised { reduced, column: self.columns(), blocks: Vec::new() }, share)
    }

    /// The choice of terms and their estimates from all blocks: one step of Gauss–Newton.
    ///
    /// # Errors
    /// [`IdentifyError::Mixed`] for statistics made around another model, [`IdentifyError::NoFit`] where most blocks
    /// were lost.
    pub fn step(&self, statistics: &Statistics) -> Result<Self, IdentifyError> {
        if statistics.around != self.theta() {
            return Err(IdentifyError::Mixed);
        }
        if statistics.samples <= statistics.lost {
            return Err(IdentifyError::NoFit);
        }
        let Search { structure, first, refined, .. } = &self.search;
        let triangle = statistics.triangle();
        let (linear, _) = self.linearised(statistics, &triangle);
        let solution = linear.reduced.choose(&linear.roles(structure, &first.allowed));
        let half = self.half(statistics, &triangle, &solution.columns, &solution.values);
        let mut state = refined.state.clone();
        let mut moved = 0.0_f64;
        for (i, column) in linear.column.iter().enumerate() {
            let Some(column) = column else { continue };
            let at = solution.columns.iter().position(|s| s == column);
            if let Some(at) = at {
                moved = moved.max((solution.values[at] - state.values[i]).abs() / half[at]);
            }
            state.values[i] = at.map_or(0.0, |at| solution.values[at]);
            state.active[i] = at.is_some();
        }
        if state.active != refined.state.active {
            moved = f64::INFINITY;
        }
        let scales = refined.scale.iter().zip(&statistics.rss).zip(&statistics.count);
        let scale = scales.map(|((s, rss), n)| s * (rss / (*n).max(1) as f64).sqrt()).collect();
        let setup = output_error::setup(structure, &refined.setup.data, &state, Some(&refined.setup))
            .ok_or(IdentifyError::NoFit)?;
        let mut fit = refined.fit.clone();
        fit.point.parameters = setup.values();
        let refined = Refined { state, setup, fit, scale, rounds: refined.rounds + 1, ..refined.clone() };
        let search = Search { refined, ..self.search.clone() };
        Ok(Self { search, segment: self.segment, steps: self.steps + 1, moved })
    }

    /// Whether the last step left the choice as it was and moved no coefficient by a tenth of its interval.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.moved < SETTLED
    }

    /// Half-widths of the 95 % intervals of `values`, the coefficients of `columns`.
    fn half(&self, statistics: &Statistics, t: &[f64], columns: &[usize], values: &[f64]) -> Vec<f64> {
        let (np, k) = (statistics.around.len(), columns.len());
        let stride = np + 1;
        // The triangle of the chosen columns and the right-hand side.
        let mut a = vec![0.0; stride * (k + 1)];
        for (to, &from) in columns.iter().chain([&np]).enumerate() {
            for i in 0..=from {
                a[to * stride + i] = t[i * stride + from];
            }
        }
        let triangle = qr::triangle(&mut a, stride, k + 1);
        let corner = triangle[k * (k + 1) + k];
        let inner: Vec<f64> = (0..k * k).map(|i| triangle[i / k * (k + 1) + i % k]).collect();
        let refined = &self.search.refined;
        let count: usize = statistics.count.iter().sum();
        let starts = statistics.segments * refined.setup.system.nx;
        let freedom = (count as f64 - k as f64 - starts as f64).max(1.0);
        let numerical = precision::numerical(&refined.setup.data.spread, &refined.scale);
        let mut theta = vec![0.0; np];
        columns.iter().zip(values).for_each(|(c, v)| theta[*c] = *v);
        let gradients: Vec<Vec<f64>> = if statistics.lagged.iter().all(Lagged::is_white) {
            Vec::new()
        } else {
            let of = |group: &Vec<f64>| {
                let all = Statistics::gradient(group, &theta);
                columns.iter().map(|c| all[*c]).collect()
            };
            statistics.groups.iter().map(of).collect()
        };
        let variance = corner * corner / freedom + numerical * count as f64;
        Spread::new(&inner, k, variance, freedom, &gradients).half
    }

    /// Intervals and inclusion probabilities of the model from the statistics of its last step.
    fn precision(&self, statistics: &Statistics, options: &Options) -> Precision {
        let Search { structure, first, refined, .. } = &self.search;
        let triangle = statistics.triangle();
        let (mut linear, share) = self.linearised(statistics, &triangle);
        let stride = statistics.around.len() + 1;
        linear.blocks = statistics.groups.iter().map(|g| Statistics::gram(g, stride, share)).collect();
        let chosen: Vec<(usize, f64)> = linear
            .column
            .iter()
            .enumerate()
            .filter(|(i, _)| refined.state.active[*i])
            .filter_map(|(i, c)| Some(((*c)?, refined.state.values[i])))
            .collect();
        let (columns, values): (Vec<usize>, Vec<f64>) = chosen.into_iter().unzip();
        let half = self.half(statistics, &triangle, &columns, &values);
        let of = |c: &Option<usize>| columns.iter().position(|k| Some(*k) == *c).map(|at| half[at]);
        Precision {
            half: linear.column.iter().map(of).collect(),
            inclusion: precision::inclusion(structure, &linear, &first.allowed, options),
            ..Precision::default()
        }
    }

    /// The equations after the last step, whose `statistics` give their intervals; `holdout` is only simulated.
    ///
    /// # Errors
    /// [`IdentifyError::Data`] where a channel of `holdout` is missing, [`IdentifyError::NoFit`] where the model
    /// cannot be simulated on the first block.
    pub fn conclude(
        &self,
        statistics: &Statistics,
        holdout: &[Recording],
        source: HoldoutSource,
        options: &Options,
    ) -> Result<Identification, IdentifyError> {
        let precision = self.precision(statistics, options);
        let Search { structure, data, first, refined } = &self.search;
        let mut found = conclude(structure, data, refined, &precision, first, holdout, source, options)?;
        found.segments = statistics.segments;
        found.blocks = Some(Blocks {
            blocks: statistics.blocks,
            samples: statistics.samples,
            lost: statistics.lost,
            passes: self.steps,
            settled: self.is_settled(),
        });
        Ok(found)
    }
}

/// An identification from blocks, with the two that are kept.
#[derive(Debug, Clone)]
pub struct Streamed {
    /// The equations; what is shown of their fit on training data is that on the first block.
    pub found: Identification,
    /// The first block.
    pub first: Recording,
    /// The blocks or recordings held out.
    pub holdout: Vec<Recording>,
}

/// Identifies governing equations from recordings of any length, block by block and in constant memory: `open` begins
/// a pass over the blocks (`greybox_recording::CsvBlocks`). Without `holdout` the last block judges the model; recordings of a
/// single block are identified as [`identify()`](crate::identify()) does it.
///
/// # Errors
/// Those of `open` and of its blocks; as [`identify()`](crate::identify()) else; [`IdentifyError::NoBlocks`] where there are none.
pub fn identify_blocks<I, E>(
    open: impl Fn() -> Result<I, E>,
    holdout: &[Recording],
    options: &Options,
    listener: &dyn ProgressListener,
) -> Result<Streamed, E>
where
    I: Iterator<Item = Result<Recording, E>> + Send,
    E: From<IdentifyError> + Send,
{
    let mut blocks = open()?;
    let first = blocks.next().ok_or(IdentifyError::NoBlocks)??;
    let Some(second) = blocks.next().transpose()? else {
        let found = identify::identify(std::slice::from_ref(&first), holdout, options, listener)?;
        return Ok(Streamed { found, first, holdout: holdout.to_vec() });
    };
    drop((blocks, second));
    let mut around = Linearisation::begin(&first, options, listener)?;
    let (statistics, last) = loop {
        let (statistics, last) = pass(&around, open()?, holdout.is_empty(), listener)?;
        around = around.step(&statistics)?;
        if around.is_settled() || around.steps == PASSES {
            break (statistics, last);
        }
    };
    listener.stage("precision");
    let (held, source) = match last {
        Some(last) => (vec![last], HoldoutSource::LastBlock),
        None => (holdout.to_vec(), HoldoutSource::Given),
    };
    let found = around.conclude(&statistics, &held, source, options)?;
    Ok(Streamed { found, first, holdout: held })
}

/// Statistics of all blocks, the last one kept out of them where `keep` says so. While some blocks are mapped, the next
/// ones are read.
fn pass<E: From<IdentifyError> + Send>(
    around: &Linearisation,
    mut blocks: impl Iterator<Item = Result<Recording, E>> + Send,
    keep: bool,
    listener: &dyn ProgressListener,
) -> Result<(Statistics, Option<Recording>), E> {
    let most = 4 * rayon::current_num_threads().max(1);
    // Blocks to map, one held back where it may be the last, and whether there are no more.
    let mut read = |held: Option<Recording>| -> Result<(Vec<Recording>, Option<Recording>, bool), E> {
        let mut batch: Vec<Recording> = held.into_iter().collect();
        while batch.len() <= most {
            match blocks.next().transpose()? {
                Some(block) => batch.push(block),
                None => {
                    let held = if keep { batch.pop() } else { None };
                    return Ok((batch, held, true));
                }
            }
        }
        let held = batch.pop();
        Ok((batch, held, false))
    };
    let mut statistics: Option<Statistics> = None;
    let (mut batch, mut held, mut over) = read(None)?;
    loop {
        let map = || batch.par_iter().map(|block| around.map(block)).collect();
        let (mapped, next): (Vec<_>, _) = rayon::join(map, || (!over).then(|| read(held.take())));
        for block in mapped {
            let block = block?;
            statistics = Some(match statistics {
                Some(before) => before.merge(block)?,
                None => block,
            });
        }
        let Some(next) = next else {
            return Ok((statistics.ok_or(IdentifyError::NoFit)?, held));
        };
        (batch, held, over) = next?;
        let samples = statistics.as_ref().map_or(0, Statistics::samples);
        listener.stage(&format!("pass {}, {samples} samples", around.steps + 1));
    }
}
