//! A first pass over the learned seconds: how long a block is, and how far states and scores scatter.

use crate::blocks::{Block, Scores, together};
use crate::error::WatchError;
use crate::learn::{First, WIDE};
use crate::options::{BLOCK_SAMPLES, BLOCKS, Options};
use crate::tracker::{Conditions, Effects, Scratch, Tracker};

/// Fewest blocks that the learned seconds are left with.
const FEWEST: usize = 12;

/// What a first pass over the learned seconds tells.
pub(crate) struct FirstPass {
    /// The filter at their end.
    pub(crate) tracker: Tracker,
    /// Seconds of a block.
    pub(crate) block_seconds: f64,
    /// Whole blocks, and the one that has begun at a time.
    pub(crate) blocks: Vec<Block>,
    pub(crate) begun: (Block, f64),
    /// Mean and standard deviation of the state.
    pub(crate) rest: (Vec<f64>, Vec<f64>),
    /// Variance of the scores over that of white innovations.
    pub(crate) inflation: f64,
    /// How far every effect may be from where it is.
    pub(crate) wide: Vec<f64>,
}

/// Short blocks of the learned seconds, and how far the state scatters.
struct Short {
    tracker: Tracker,
    seconds: f64,
    /// Each with the time of its end.
    blocks: Vec<(Block, f64)>,
    begun: (Block, f64),
    rest: (Vec<f64>, Vec<f64>),
}

/// Runs the filter over the learned seconds.
fn short_blocks(first: &First, options: &Options) -> Result<Short, WatchError> {
    let First { machine, usual, start, samples, .. } = first;
    let mut tracker = Tracker::new(machine, (&start.0, &start.1), Effects::Everything)?;
    let effects = tracker.count(machine);
    let seconds = samples[samples.len() - 1].t - samples[0].t;
    let parts = (samples.len() / BLOCK_SAMPLES).clamp(BLOCKS.0, BLOCKS.1);
    let short = (seconds / parts as f64).max(usual.dt);
    let empty = Block::new(effects, machine.system.ny);
    let (mut block, mut blocks, mut began) = (empty.clone(), Vec::new(), samples[0].t);
    let nx = machine.system.nx;
    let (mut sum, mut squares, mut count) = (vec![0.0; nx], vec![0.0; nx], 0.0);
    let mut scratch = Scratch::default();
    // (What is before a gap is no past of what comes after it.)
    let mut first = 0;
    for (k, pair) in samples.windows(2).enumerate() {
        let earlier = &samples[first..k];
        let by = Conditions { machine, usual, place: &usual.place, memory: options.memory, earlier };
        if pair[1].t - pair[0].t > short {
            tracker.restart((&start.0, &start.1));
            block.clear();
            (began, first) = (pair[1].t, k + 1);
            continue;
        }
        if !tracker.advance(&by, (&pair[0], &pair[1]), &mut scratch, None, |c, i| block.push(c, &i)) {
            return Err(WatchError::Diverged);
        }
        count += 1.0;
        for (i, x) in tracker.filter.state().iter().enumerate() {
            sum[i] += x;
            squares[i] += x * x;
        }
        if pair[1].t - began >= short - 0.5 * usual.dt {
            blocks.push((std::mem::replace(&mut block, empty.clone()), pair[1].t));
            began = pair[1].t;
        }
    }
    let mean: Vec<f64> = sum.iter().map(|s| s / count).collect();
    let std = squares.iter().zip(&mean).map(|(s, m)| (s / count - m * m).max(0.0).sqrt()).collect();
    Ok(Short { tracker, seconds: short, blocks, begun: (block, began), rest: (mean, std) })
}

/// Blocks one after the other as one.
fn merged(blocks: &[(Block, f64)]) -> Option<Block> {
    let ((first, _), others) = blocks.split_first()?;
    let mut sum = first.clone();
    others.iter().for_each(|(b, _)| sum.merge(b));
    Some(sum)
}

/// Runs the filter over the learned seconds, chooses the length of a block, and measures how far states and scores scatter.
pub(crate) fn first_pass(first: &First, options: &Options) -> Result<FirstPass, WatchError> {
    let Short { tracker, seconds, blocks, begun, rest } = short_blocks(first, options)?;
    // (The first block still feels where the filter began.)
    let blocks = &blocks[1.min(blocks.len())..];
    let scores: Vec<Scores> = blocks.iter().map(|(b, _)| b.scores()).collect();
    let doubled = together(&scores, FEWEST);
    let whole = blocks.chunks_exact(doubled);
    let left = whole.remainder();
    // The block that has begun: the short ones that are left, and the begun one.
    let end = blocks[..blocks.len() - left.len()].last().map(|(_, t)| *t);
    let mut over = begun.0;
    left.iter().for_each(|(b, _)| over.merge(b));
    let began = if left.is_empty() { begun.1 } else { end.unwrap_or(begun.1) };
    let blocks: Vec<Block> = whole.filter_map(merged).collect();
    let np = first.usual.free.len();
    let scores: Vec<Scores> = blocks.iter().map(Block::scores).collect();
    let square: f64 = scores.iter().map(|s| (0..np).map(|h| s.deviate(h).powi(2)).sum::<f64>()).sum::<f64>();
    let inflation = (square / (scores.len() * np) as f64).max(1.0);
    let all = Scores::sum(&scores);
    let tells = |information: f64| {
        let std = WIDE / information.sqrt();
        if std.is_finite() && std > 0.0 { std } else { 1.0 }
    };
    let parameters = first.usual.free.iter().map(|f| f.std);
    let wide = parameters.chain(all.information.iter().skip(np).map(|i| tells(*i))).collect();
    let block_seconds = seconds * doubled as f64;
    Ok(FirstPass { tracker, block_seconds, blocks, begun: (over, began), rest, inflation, wide })
}
