//! A trajectory from a recording.

use std::path::Path;

use greybox_calibrate::data::recorded_unit;
use greybox_control::Trajectory;
use greybox_model::{Expr, Model, Unit, parse};
use greybox_recording::{Piece, Recording};

use crate::failure::Failure;
use crate::loading::LoadedModel;

/// The state to track, with its primes: the model's first where none is named.
fn tracked(model: &Model, track: Option<&str>) -> Option<(String, u8)> {
    let Some(track) = track else { return model.states.first().map(|s| (s.name.clone(), 0)) };
    match parse(track).ok()?.expr {
        Expr::Var { name, primes } if model.state(&name).is_some() => Some((name.to_string(), primes)),
        _ => None,
    }
}

/// The channel that a recording must have to be a reference of the tracked state: that which measures it, else its name.
#[must_use]
pub fn channel(model: &Model, track: Option<&str>) -> Option<String> {
    let (name, primes) = tracked(model, track)?;
    Some(match model.measurement_of(&name, primes) {
        Some(measurement) => model.measurements[measurement].channel.clone(),
        None => Expr::prime(&name, primes).to_string(),
    })
}

/// The trajectory that a recording, read at `path`, has for the tracked state, in SI.
///
/// # Errors
/// Bad input: no state to track, no channel for it, a unit of something else, gaps, or a channel that does not move.
pub fn trajectory(
    loaded: &LoadedModel,
    track: Option<&str>,
    recording: &Recording,
    path: &Path,
) -> Result<Trajectory, Failure> {
    let model = &loaded.model;
    let Some((name, primes)) = tracked(model, track) else {
        let known: Vec<&str> = model.states.iter().map(|s| s.name.as_str()).collect();
        let what = match track {
            Some(track) => format!("the model has no state `{track}` to track"),
            None => "the model has no state to track".to_owned(),
        };
        return Err(Failure::file(&loaded.path, what).help(format!("track one of {}", known.join(", "))));
    };
    let wanted = channel(model, track).unwrap_or_default();
    let Some(at) = recording.channel_index(&wanted) else {
        let there: Vec<&str> = recording.channels.iter().map(|c| c.name.as_str()).collect();
        return Err(Failure::file(
            path,
            format!("no channel `{wanted}` says where `{}` is to be", Expr::prime(&name, primes)),
        )
        .help(format!(
            "the channels are {}; call the reference `{wanted}`, with its unit in brackets, or name another state with `--track`",
            there.join(", ")
        )));
    };
    let [piece] = recording.pieces.as_slice() else {
        return Err(
            Failure::file(path, "the reference has gaps").help("a trajectory is one piece: fill the gaps")
        );
    };
    let unit = unit(model, &name, primes, recording.channels[at].unit.as_deref())
        .map_err(|(what, help)| Failure::file(path, format!("channel `{wanted}`: {what}")).help(help))?;
    let values = samples(piece, at, &unit).ok_or_else(|| {
        Failure::file(path, format!("channel `{wanted}` has missing values"))
            .help("a trajectory is one piece: fill the gaps")
    })?;
    Trajectory::new(piece.dt, values).map_err(|e| Failure::file(path, format!("channel `{wanted}`: {e}")))
}

/// The unit of the channel, or what is wrong with it and the help.
fn unit(model: &Model, name: &str, primes: u8, header: Option<&str>) -> Result<Unit, (String, String)> {
    let state = model.state(name).map(|i| &model.states[i].unit);
    let measured = model.measurement_of(name, primes).map(|m| &model.measurements[m].unit);
    let own = match (measured, state) {
        (Some(unit), _) => unit.clone(),
        (None, Some(state)) => {
            let mut dimension = state.dimension;
            (0..primes).for_each(|_| dimension = dimension / greybox_model::Dimension::TIME);
            if primes == 0 { state.clone() } else { Unit::si(dimension) }
        }
        (None, None) => return Err(("no state of the model".into(), "name one with `--track`".into())),
    };
    let expr = Expr::prime(name, primes);
    let found = recorded_unit(model, header, &own, Some(&expr))
        .map_err(|e| (e.to_string(), format!("write the unit of the header as `{}`", own.text)))?;
    if !found.dimension.same(&own.dimension) {
        return Err((
            format!("`{}` is no unit of `{expr}`, which is in `{}`", found.text, own.text),
            format!("write `[{}]` in the header, or track another state with `--track`", own.text),
        ));
    }
    Ok(found)
}

/// In SI; none where one is missing.
fn samples(piece: &Piece, channel: usize, unit: &Unit) -> Option<Vec<f64>> {
    piece.columns[channel].iter().map(|v| v.is_finite().then(|| unit.to_si(*v))).collect()
}
