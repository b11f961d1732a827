//! A free run of the model on a recording's inputs.

use std::fmt::Write as _;
use std::sync::Arc;

use greybox_calibrate::data::recorded_unit;
use greybox_calibrate::{Data, FreeRun, Score, Setup, window_length};
use greybox_model::Model;
use greybox_recording::{Piece, Recording};
use greybox_report::format;
use serde_json::{Map, json};

use crate::failure::Failure;
use crate::loading::LoadedModel;

/// A free run over a recording.
#[derive(Debug)]
pub struct Simulated {
    /// Per measured channel its header and its values at the recording's rows; NaN = not simulated.
    pub columns: Vec<(String, Vec<f64>)>,
    /// What is to be reported of it.
    pub story: String,
    /// The same for machines.
    pub json: serde_json::Value,
}

/// Simulates a model on the inputs of a recording; `stage` hears what is being done.
///
/// # Errors
/// Bad input: a recording that lacks what the model needs, or a model that does not compile.
pub fn simulate(
    loaded: &LoadedModel,
    recording: &Recording,
    stage: &dyn Fn(&str),
) -> Result<Simulated, Failure> {
    let model = &loaded.model;
    let data = Arc::new(Data::new(model, std::slice::from_ref(recording))?);
    stage("compiling");
    let setup = Setup::new(model, data, Vec::new()).map_err(|e| Failure::file(&loaded.path, e))?;
    stage("simulating");
    let parameters = setup.values();
    let free_run = settled_run(&setup, &parameters);
    let scores = setup.scores(&free_run, &parameters, window(&setup.data), None);

    let columns = columns(model, recording, &free_run);
    let channels: Vec<&str> = setup.data.channels.iter().map(|c| c.name.as_str()).collect();
    let rows = recording.time.len();
    let empty = columns.iter().map(|(_, v)| v.iter().filter(|v| v.is_nan()).count()).max().unwrap_or(0);
    let mut story = format!("{rows} rows simulated on the inputs of {}\n", recording.name);
    for (channel, score) in channels.iter().zip(&scores) {
        let _ = writeln!(story, "  {channel}: nrmse {}", format::percent(score.nrmse));
    }
    if free_run.diverged {
        story.push_str("  warning: the simulation diverges; the cells from there on are empty\n");
    } else if empty > 0 {
        let _ = writeln!(
            story,
            "  {empty} rows lie outside the pieces that can be simulated; their cells are empty"
        );
    }
    let json = json!({
        "rows": rows,
        "empty_rows": empty,
        "diverged": free_run.diverged,
        "initial_si": free_run.starts.iter().map(|x0| initial_json(model, x0)).collect::<Vec<_>>(),
        "fit": channels.iter().zip(&scores).map(|(c, s)| ((*c).to_owned(), score_json(s))).collect::<Map<_, _>>(),
    });
    Ok(Simulated { columns, story, json })
}

/// The initial state of a piece: each coordinate with its derivatives, SI.
fn initial_json(model: &Model, x0: &[f64]) -> serde_json::Value {
    let mut rest = x0;
    let mut chains = Map::new();
    for state in &model.states {
        let (chain, behind) = rest.split_at(state.order.min(rest.len()));
        chains.insert(state.name.clone(), json!(chain));
        rest = behind;
    }
    chains.into()
}

fn score_json(score: &Score) -> serde_json::Value {
    json!({ "nrmse": score.nrmse, "rmse_si": score.rmse, "nrmse_windowed": score.nrmse_windowed })
}

/// Length of the windows in which simulations are restarted for `nrmse_windowed`, s.
fn window(data: &Data) -> f64 {
    let durations: Vec<f64> = data.pieces.iter().map(|p| p.len as f64 * p.dt).collect();
    window_length(&durations, data.pieces.first().map_or(1.0, |p| p.dt))
}

/// A free run whose initial states weigh the residuals by the model's own error, so that a model that
/// leaves something out does not bend its start to hide it.
pub(crate) fn settled_run(setup: &Setup, parameters: &[f64]) -> FreeRun {
    let data = &setup.data;
    let rough: Vec<f64> = data.spread.iter().map(|s| s.max(f64::MIN_POSITIVE)).collect();
    let run = setup.free_run(parameters, &rough);
    setup.free_run(parameters, &own_error(setup, &run, &rough))
}

/// RMS error of a run over the first quarters of the pieces, never below the noise; `rough` where it is
/// not finite. Only the first quarters may serve to choose an initial state.
fn own_error(setup: &Setup, run: &FreeRun, rough: &[f64]) -> Vec<f64> {
    let data = &setup.data;
    (0..data.channels.len())
        .map(|c| {
            let (mut sum, mut count) = (0.0, 0usize);
            for (piece, y) in data.pieces.iter().zip(&run.y) {
                let simulated = &y[c * piece.len..(c + 1) * piece.len];
                let quarter = (piece.len / 4).max(2).min(piece.len);
                for (m, s) in piece.measured[c].iter().zip(simulated).take(quarter) {
                    if !m.is_nan() {
                        sum += (m - s).powi(2);
                        count += 1;
                    }
                }
            }
            let rms = (sum / count.max(1) as f64).sqrt();
            if rms.is_finite() { rms.max(0.7 * data.sigma[c]) } else { rough[c] }
        })
        .collect()
}

/// One column per measurement, at the rows of the file and in the unit of its header; NaN = not simulated.
fn columns(model: &Model, recording: &Recording, run: &FreeRun) -> Vec<(String, Vec<f64>)> {
    model
        .measurements
        .iter()
        .enumerate()
        .filter_map(|(c, measurement)| {
            let channel = recording.channel(&measurement.channel)?;
            let unit =
                recorded_unit(model, channel.unit.as_deref(), &measurement.unit, Some(&measurement.expr));
            let unit = unit.unwrap_or_else(|_| measurement.unit.clone());
            let mut values = vec![f64::NAN; recording.time.len()];
            for ((piece, y), length) in recording.pieces.iter().zip(&run.y).zip(&run.lengths) {
                let mut simulated = y[c * piece.len..(c + 1) * piece.len].to_vec();
                simulated[(*length).min(piece.len)..].fill(f64::NAN);
                let simulated = &simulated;
                at_rows(piece, &recording.time, simulated, &mut values);
            }
            for v in &mut values {
                *v = if v.is_finite() { unit.from_si(*v) } else { f64::NAN };
            }
            Some((channel.header(), values))
        })
        .collect()
}

/// Writes what was simulated on a piece's grid to the rows the piece came from: row by row, or
/// interpolated linearly where the piece was resampled (the last row may lie up to a step beyond the grid).
fn at_rows(piece: &Piece, time: &[f64], simulated: &[f64], rows: &mut [f64]) {
    if !piece.resampled && piece.len == piece.rows.len() {
        rows[piece.rows.clone()].copy_from_slice(simulated);
        return;
    }
    let first = time[piece.rows.start];
    for row in piece.rows.clone() {
        let position = (time[row] - first) / piece.dt;
        let k = (position.floor() as usize).min(simulated.len().saturating_sub(2));
        let share = position - k as f64;
        rows[row] = simulated[k] + share * (simulated[k + 1] - simulated[k]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use greybox_recording::Channel;

    #[test]
    fn resampled_pieces_return_to_the_times_of_the_file() {
        // Jittered times; the simulation is the ramp 3t, exact under linear interpolation.
        let time: Vec<f64> = (0..40).map(|k| 0.1 * f64::from(k) + 0.02 * f64::from(k % 3)).collect();
        let values = time.clone();
        let channels = vec![Channel { name: "y".into(), unit: None, values }];
        let recording = Recording::from_columns("r", time.clone(), channels).unwrap();
        let piece = &recording.pieces[0];
        assert!(piece.resampled);
        let simulated: Vec<f64> = (0..piece.len).map(|k| 3.0 * k as f64 * piece.dt).collect();
        let mut rows = vec![f64::NAN; 40];
        at_rows(piece, &time, &simulated, &mut rows);
        for (row, t) in rows.iter().zip(&time) {
            assert!((row - 3.0 * (t - time[0])).abs() < 1e-12, "{row} at {t}");
        }
    }
}
