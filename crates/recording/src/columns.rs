//! From columns in memory to a recording: the checks, then the pieces.

use crate::error::{Place, RecordingError};
use crate::grid;
use crate::recording::{Channel, MIN_SAMPLES, Recording, SIZES};

impl Recording {
    /// A recording from columns in memory: a simulation, a test, another file format.
    ///
    /// `time` in s, strictly increasing; one value per time in every channel, NaN = missing.
    ///
    /// # Errors
    /// A length that differs from the time's, a time that is not finite or does not increase, an infinite
    /// value, fewer than 8 rows, or gaps that leave no piece of 8 samples. Lines count rows from 1 here.
    pub fn from_columns(name: &str, time: Vec<f64>, channels: Vec<Channel>) -> Result<Self, RecordingError> {
        Self::checked(name, name, time, channels, 0.0)
    }

    /// As [`from_columns`](Self::from_columns); `label` and `resolution` as in [`assemble`](Self::assemble).
    pub(crate) fn checked(
        label: &str,
        name: &str,
        time: Vec<f64>,
        channels: Vec<Channel>,
        resolution: f64,
    ) -> Result<Self, RecordingError> {
        for (k, &t) in time.iter().enumerate() {
            let place = || Place::line(label, k as u64 + 1).column(0, "t");
            if !t.is_finite() {
                return Err(RecordingError::NotFinite { place: place(), found: t.to_string() });
            }
            if k > 0 && t <= time[k - 1] {
                return Err(RecordingError::TimeNotIncreasing {
                    place: place(),
                    found: t,
                    previous: time[k - 1],
                    help: "sort the rows and remove repeated times",
                });
            }
        }
        for (c, channel) in channels.iter().enumerate() {
            if channel.values.len() != time.len() {
                return Err(RecordingError::ColumnLength {
                    place: Place::file(label).column(c + 1, &channel.name),
                    found: channel.values.len(),
                    expected: time.len(),
                });
            }
            if let Some(k) = channel.values.iter().position(|v| v.is_infinite()) {
                return Err(RecordingError::NotFinite {
                    place: Place::line(label, k as u64 + 1).column(c + 1, &channel.name),
                    found: channel.values[k].to_string(),
                });
            }
        }
        Self::assemble(label, name, time, channels, resolution)
    }

    /// Builds the pieces; `label` names the file in errors, `resolution` is the last printed digit of the
    /// times, s (0 = exact). The caller has checked that the times are finite and increase.
    pub(crate) fn assemble(
        label: &str,
        name: &str,
        time: Vec<f64>,
        channels: Vec<Channel>,
        resolution: f64,
    ) -> Result<Self, RecordingError> {
        if time.len() < MIN_SAMPLES {
            return Err(RecordingError::TooFewRows {
                place: Place::file(label),
                rows: time.len(),
                needed: MIN_SAMPLES,
                help: "record for longer or export all samples",
            });
        }
        check_sizes(label, &channels)?;
        let grid = grid::find(&time, resolution);
        if !SIZES.contains(&grid.dt) {
            let place = Place::file(label).column(0, "t");
            return Err(RecordingError::Scale { place, what: "a sampling step", found: grid.dt });
        }
        let (pieces, warnings) = grid::pieces(&grid, &time, &channels);
        if pieces.is_empty() {
            return Err(RecordingError::NoUsablePiece {
                place: Place::file(label),
                pieces: grid.stretches.len(),
                needed: MIN_SAMPLES,
            });
        }
        Ok(Self { name: name.to_owned(), channels, time, pieces, warnings })
    }
}

/// No channel is larger than can be computed with, nor so small that its squares are zero.
fn check_sizes(label: &str, channels: &[Channel]) -> Result<(), RecordingError> {
    for (c, channel) in channels.iter().enumerate() {
        let largest = channel.values.iter().fold(0.0f64, |most, v| most.max(v.abs()));
        if largest != 0.0 && !SIZES.contains(&largest) {
            let place = Place::file(label).column(c + 1, &channel.name);
            return Err(RecordingError::Scale { place, what: "a value", found: largest });
        }
    }
    Ok(())
}
