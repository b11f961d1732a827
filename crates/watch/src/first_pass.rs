//! A first pass over the learned seconds: how long a block is, and how far states and scores scatter.

use crate::blocks::{Block, Scores, together};
use crate::error::WatchError;
use crate::learn::First;
use crate::options::{BLOCK_SAMPLES, BLOCKS, Options};
use crate::tracker::{Conditions, Effects, Tracker};

/// Fewest blocks that the learned seconds are left with.
const FEWEST: usize = 12;

/// What a first pass over the learned seconds tells.
pub(crate) struct FirstPass {
    /// Seconds of a block.
    pub(crate) block_seconds: f64,
    /// Mean and standard deviation of the state.
    pub(crate) rest: (Vec<f64>, Vec<f64>),
    /// Variance of the scores over that of white innovations.
    pub(crate) inflation: f64,
}

/// Chooses the length of a block, and measures how far states and scores scatter.
pub(crate) fn first_pass(first: &First, options: &Options) -> Result<FirstPass, WatchError> {
    let First { machine, usual, start, samples } = first;
    let mut tracker = Tracker::new(machine, (&start.0, &start.1), Effects::Everything)?;
    let effects = tracker.count(machine);
    let by = Conditions { machine, usual, values: &usual.values, memory: options.memory };
    let seconds = samples[samples.len() - 1].t - samples[0].t;
    let parts = (samples.len() / BLOCK_SAMPLES).clamp(BLOCKS.0, BLOCKS.1);
    let short = (seconds / parts as f64).max(usual.dt);
    let mut block = Block::new(effects, machine.system.ny);
    let (mut blocks, mut began) = (Vec::new(), samples[0].t);
    let nx = machine.system.nx;
    let (mut sum, mut squares, mut count) = (vec![0.0; nx], vec![0.0; nx], 0.0);
    for pair in samples.windows(2) {
        if pair[1].t - pair[0].t > short {
            tracker.restart((&start.0, &start.1));
            block.clear();
            began = pair[1].t;
            continue;
        }
        if !tracker.advance(&by, &pair[0], &pair[1], |c, i| block.push(c, &i)) {
            return Err(WatchError::Diverged);
        }
        count += 1.0;
        for (i, x) in tracker.filter.state().iter().enumerate() {
            sum[i] += x;
            squares[i] += x * x;
        }
        if pair[1].t - began >= short - 0.5 * usual.dt {
            blocks.push(block.scores());
            block.clear();
            began = pair[1].t;
        }
    }
    // (The first block still feels where the filter began.)
    let blocks = &blocks[1.min(blocks.len())..];
    let doubled = together(blocks, FEWEST);
    let merged: Vec<Scores> = blocks.chunks_exact(doubled).map(Scores::sum).collect();
    let np = machine.free().len();
    let square: f64 = merged.iter().map(|s| (0..np).map(|h| s.deviate(h).powi(2)).sum::<f64>()).sum::<f64>();
    let inflation = (square / (merged.len() * np) as f64).max(1.0);
    let mean: Vec<f64> = sum.iter().map(|s| s / count).collect();
    let std = squares.iter().zip(&mean).map(|(s, m)| (s / count - m * m).max(0.0).sqrt()).collect();
    Ok(FirstPass { block_seconds: short * doubled as f64, rest: (mean, std), inflation })
}
