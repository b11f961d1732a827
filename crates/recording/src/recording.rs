//! The recording itself: channels as in the file, pieces on a uniform grid.

use crate::finding::Finding;
use std::ops::Range;

/// Fewest samples a recording or a piece of it may have.
pub const MIN_SAMPLES: usize = 8;

/// One measured signal, as in the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// Name from the header.
    pub name: String,
    /// Unit from the header's brackets, as written; `None` where the header states none.
    pub unit: Option<String>,
    /// One value per row of the file, in `unit`; NaN = missing.
    pub values: Vec<f64>,
}

impl Channel {
    /// The header cell: `name` or `name [unit]`; `name[x] []` where a bracket ends the name, and there is no unit.
    pub fn header(&self) -> String {
        match &self.unit {
            Some(unit) => format!("{} [{unit}]", self.name),
            None if self.name.ends_with(']') => format!("{} []", self.name),
            None => self.name.clone(),
        }
    }
}

/// A stretch without gaps on the uniform grid t = start + k Δt.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// Time of the first sample, s after the recording's first sample.
    pub start: f64,
    /// Step, s; the same in all pieces of a recording.
    pub dt: f64,
    /// Rows of the file it came from (0 = the first row under the header).
    pub rows: Range<usize>,
    /// Number of grid points; equals `rows.len()` unless the piece was resampled.
    pub len: usize,
    /// Per channel (in the order of [`Recording::channels`]) the `len` samples; NaN = missing.
    pub columns: Vec<Vec<f64>>,
    /// Whether the samples were interpolated linearly onto the grid because the times were not uniform; [`Recording::held`] has
    /// those of a channel that keeps its values instead.
    pub resampled: bool,
}

impl Piece {
    /// Time of sample `k`, s after the recording's first sample.
    pub fn time(&self, k: usize) -> f64 {
        self.start + k as f64 * self.dt
    }

    /// Time from the first to the last sample, s.
    pub fn duration(&self) -> f64 {
        self.len.saturating_sub(1) as f64 * self.dt
    }
}

/// One continuous experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// File name without its folder.
    pub name: String,
    /// The measured signals, in the order of the file.
    pub channels: Vec<Channel>,
    /// Time of every row as in the file, s.
    pub time: Vec<f64>,
    /// The recording on a uniform grid, split at gaps; at least one.
    pub pieces: Vec<Piece>,
    /// What the reader had to fix: gaps, jitter, pieces left out.
    pub warnings: Vec<Finding>,
}

impl Recording {
    /// The samples of a piece's channel that keeps each value until the next row (a command, a switch). In a
    /// [resampled](Piece::resampled) piece sample k is the mean of what was held in the step that begins there,
    ///
    /// ```text
    /// u(k) = (1/dt) ∫ u(t) dt   from k dt to (k + 1) dt,
    /// ```
    ///
    /// so that an integrator that it drives ends where the recorded one did; NaN before the first value. In other pieces the
    /// samples are those of [`Piece::columns`]. One value per sample, in the channel's unit.
    ///
    /// # Panics
    /// If `piece` is of another recording, or there is no such channel.
    ///
    /// ```
    /// use greybox_recording::{Channel, Recording};
    /// let time = vec![0.0, 1.0, 1.8, 3.0, 4.1, 5.0, 6.2, 7.0, 7.9, 9.0];
    /// let values = vec![0.0, 0.0, 5.0, 5.0, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    /// let switch = Channel { name: "on".into(), unit: None, values };
    /// let log = Recording::from_columns("log.csv", time, vec![switch])?;
    /// let piece = &log.pieces[0];
    /// assert!(piece.resampled);
    /// // On from 1.8 s to 5 s.
    /// let delivered = log.held(piece, 0).iter().sum::<f64>() * piece.dt;
    /// assert!((delivered - 5.0 * 3.2).abs() < 1e-9);
    /// # Ok::<(), greybox_recording::RecordingError>(())
    /// ```
    pub fn held(&self, piece: &Piece, channel: usize) -> Vec<f64> {
        if !piece.resampled {
            return piece.columns[channel].clone();
        }
        let time = &self.time[piece.rows.clone()];
        let values = &self.channels[channel].values[piece.rows.clone()];
        let mut rows = time.iter().map(|t| t - time[0]).zip(values).filter(|(_, v)| !v.is_nan()).peekable();
        let mut last = f64::NAN;
        let held = (0..piece.len).map(|k| {
            let (from, to) = (k as f64 * piece.dt, (k + 1) as f64 * piece.dt);
            let (mut at, mut sum, mut changed) = (from, 0.0, false);
            while let Some((t, v)) = rows.next_if(|(t, _)| *t < to) {
                if *v != last {
                    changed |= t > at;
                    sum += if t > at { (t - at) * last } else { 0.0 };
                    (at, last) = (t.max(at), *v);
                }
            }
            if changed { (sum + (to - at) * last) / piece.dt } else { last }
        });
        held.collect()
    }

    /// Step Δt that all pieces share, s.
    pub fn dt(&self) -> f64 {
        self.pieces.first().map_or(f64::NAN, |piece| piece.dt)
    }

    /// Time from the first to the last row, s.
    pub fn duration(&self) -> f64 {
        match (self.time.first(), self.time.last()) {
            (Some(first), Some(last)) => last - first,
            _ => 0.0,
        }
    }

    /// Position of the channel called `name`, in [`channels`](Self::channels) and in every piece's columns.
    pub fn channel_index(&self, name: &str) -> Option<usize> {
        self.channels.iter().position(|channel| channel.name == name)
    }

    /// The channel called `name`.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// The longest piece.
    pub fn longest_piece(&self) -> Option<&Piece> {
        self.pieces.iter().rev().max_by_key(|piece| piece.len)
    }
}

/// Sizes that values and sampling steps may have: their squares and sums of squares stay numbers.
pub const SIZES: std::ops::RangeInclusive<f64> = 1e-100..=1e100;
