//! From signals and their times to the recording.

use super::pairing::{Unclear, same_times};
use super::{Clock, Found, Signal};
use crate::clocks::{self, Series};
use crate::error::{Place, RecordingError};
use crate::finding::Finding;
use crate::recording::{Channel, Recording};
use crate::selection::Selection;
use std::collections::HashMap;

/// The recording of what was found. Signals of one time are its channels as they are; those of several are joined on one
/// grid, of which the selection says which count.
pub(super) fn recording(
    found: Found,
    label: &str,
    name: &str,
    selection: &Selection,
    mut notes: Vec<Finding>,
) -> Result<Recording, RecordingError> {
    let Found { clocks, unclear, .. } = found;
    let mut clocks = distinct(clocks);
    tell_apart(&mut clocks);
    if clocks.len() > 1 || !unclear.is_empty() {
        let available: Vec<&str> = clocks.iter().flat_map(|c| &c.signals).map(|s| s.name.as_str()).collect();
        let wanted: Option<Vec<String>> =
            selection.among(&available).map(|names| names.into_iter().map(str::to_owned).collect());
        if let (None, Some(Unclear { path, times })) = (&wanted, unclear.into_iter().next()) {
            return Err(RecordingError::SeveralTimes { place: Place::file(label), signal: path, times });
        }
        if let Some(wanted) = wanted {
            clocks.iter_mut().for_each(|clock| clock.signals.retain(|signal| wanted.contains(&signal.name)));
            clocks.retain(|clock| !clock.signals.is_empty());
        }
    }
    unique(label, &clocks)?;
    if clocks.len() > 1 {
        return clocks::recording(label, name, clocks.into_iter().map(Clock::joined).collect(), notes);
    }
    let Some(Clock { time, resolution, signals, .. }) = clocks.into_iter().next() else {
        return Err(RecordingError::NoChannels { place: Place::file(label) });
    };
    let channel = |Signal { name, unit, values, .. }| Channel { name, unit, values };
    let channels = signals.into_iter().map(channel).collect();
    let mut recording = Recording::checked(label, name, time, channels, resolution)?;
    notes.append(&mut recording.warnings);
    recording.warnings = notes;
    Ok(recording)
}

/// The clocks that have signals; those of the same times are one.
fn distinct(clocks: Vec<Clock>) -> Vec<Clock> {
    let mut all: Vec<Clock> = Vec::new();
    for clock in clocks.into_iter().filter(|clock| !clock.signals.is_empty()) {
        match all.iter_mut().find(|other| same_times(&other.time, &clock.time)) {
            Some(same) => same.signals.extend(clock.signals),
            None => all.push(clock),
        }
    }
    all
}

impl Clock {
    fn joined(self) -> clocks::Clock {
        let series = |Signal { name, unit, held, values, .. }| Series { name, unit, held, values };
        clocks::Clock {
            name: self.path,
            time: self.time,
            resolution: self.resolution,
            series: self.signals.into_iter().map(series).collect(),
        }
    }
}

/// Sees that no two channels have one name.
fn unique(label: &str, clocks: &[Clock]) -> Result<(), RecordingError> {
    let mut places = HashMap::new();
    for (c, signal) in clocks.iter().flat_map(|clock| &clock.signals).enumerate() {
        if let Some(first) = places.insert(&signal.name, c) {
            return Err(RecordingError::DuplicateName {
                place: Place::file(label).column(c + 1, &signal.path),
                name: signal.name.clone(),
                first: first + 2,
            });
        }
    }
    Ok(())
}

/// Signals that share a name get those of the structures around them.
fn tell_apart(clocks: &mut [Clock]) {
    let mut times = HashMap::new();
    for signal in clocks.iter().flat_map(|clock| &clock.signals) {
        *times.entry(signal.name.clone()).or_insert(0) += 1;
    }
    for signal in clocks.iter_mut().flat_map(|clock| &mut clock.signals) {
        if times.get(&signal.name).is_some_and(|&times| times > 1) {
            let words =
                signal.path.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|w| !w.is_empty());
            signal.name = words.collect::<Vec<_>>().join("_");
        }
    }
}
