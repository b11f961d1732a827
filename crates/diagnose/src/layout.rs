//! Recordings laid out for fits and for judging.

use std::sync::Arc;

use greybox_calibrate::{Data, FreeRun, HELD_OUT_SHARE, HoldoutSource};
use greybox_model::Model;
use greybox_recording::Recording;

use crate::diagnosis::DiagnoseError;

/// Training and held-out data.
pub(crate) struct Layout {
    /// Training.
    pub train: Arc<Data>,
    /// Held out.
    pub holdout: Arc<Data>,
    /// Where the held-out data come from.
    pub source: HoldoutSource,
}

/// Lays the recordings out, holding out the last fifth of each when none is held out.
///
/// # Errors
/// As [`diagnose`](crate::diagnose).
pub(crate) fn layout(
    model: &Model,
    train: &[Recording],
    holdout: &[Recording],
) -> Result<Layout, DiagnoseError> {
    if train.is_empty() {
        return Err(DiagnoseError::NoTraining);
    }
    // The whole recordings first: errors name them as they are.
    let whole = Data::new(model, train)?;
    let needed =
        4 * model.states.iter().map(|s| s.order).sum::<usize>() + 4 * model.parameters.len().min(8) + 8;
    let found = whole.samples();
    if found < needed {
        return Err(DiagnoseError::TooShort { file: whole.recordings.join(", "), found, needed });
    }
    if whole.spread.iter().all(|s| s.is_nan() || *s <= 0.0) {
        let channels: Vec<String> = whole.channels.iter().map(|c| format!("`{}`", c.name)).collect();
        return Err(DiagnoseError::Still {
            file: whole.recordings.join(", "),
            channels: channels.join(", "),
        });
    }
    if holdout.is_empty() {
        let (head, tail) = Data::split_tail(train, HELD_OUT_SHARE);
        if !head.is_empty() {
            return Ok(Layout {
                train: Arc::new(Data::new(model, &head)?),
                holdout: Arc::new(Data::new(model, &tail)?),
                source: HoldoutSource::LastFifth,
            });
        }
    }
    let held = Data::new(model, if holdout.is_empty() { train } else { holdout })?;
    let source = if holdout.is_empty() { HoldoutSource::None } else { HoldoutSource::Given };
    Ok(Layout { train: Arc::new(whole), holdout: Arc::new(held), source })
}

/// Sees that one of the runs goes beyond the first samples.
pub(crate) fn follows<const N: usize>(runs: [&FreeRun; N], data: &Data) -> Result<(), DiagnoseError> {
    match runs.iter().all(|run| run.is_lost()) {
        true => Err(DiagnoseError::Diverges { file: data.recordings.join(", ") }),
        false => Ok(()),
    }
}
