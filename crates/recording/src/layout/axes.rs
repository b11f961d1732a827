//! Recordings of dSPACE: a structure with `X(k)`, a time of each raster, and `Y(k)`, the signals.

use super::{Entries, Found, LABELS, Named, cell, is_vector, joined, numbered, text, time_scale};
use crate::variables::Value;

/// What the axes are called.
pub(super) const NAMES: [&str; 2] = ["X", "Y"];

/// An array of structures with `Data`: of each its fields.
type Elements<'a> = Vec<Entries<'a>>;

/// The times and the signals.
pub(super) struct Axes<'a> {
    times: Elements<'a>,
    signals: Elements<'a>,
}

/// The axes among the entries of a structure.
pub(super) fn find<'a>(entries: &Entries<'a>) -> Option<Axes<'a>> {
    let of =
        |name: &str| entries.iter().find(|(other, _)| *other == name).and_then(|(_, value)| elements(value));
    Some(Axes { times: of(NAMES[0])?, signals: of(NAMES[1])? })
}

/// The structures of a field that all hold `Data`.
fn elements(value: &Value) -> Option<Elements<'_>> {
    let Value::Structure { count, fields } = value else { return None };
    let element =
        |k| fields.iter().filter_map(|(name, values)| Some((name.as_str(), values.get(k)?))).collect();
    fields.iter().any(|(name, _)| name == "Data").then(|| (0..*count).map(element).collect())
}

fn field<'a>(entries: &Entries<'a>, name: &str) -> Option<&'a Value> {
    entries.iter().find(|(other, _)| *other == name).map(|(_, value)| *value)
}

impl Found {
    /// Takes the times and gives each signal to one: that of its `XIndex`, or of its `Raster`, or of its length.
    pub(super) fn axes(&mut self, axes: &Axes<'_>, path: &str, called: &str) {
        let mut clocks = Vec::with_capacity(axes.times.len());
        for (k, entries) in axes.times.iter().enumerate() {
            let time = axis(entries, joined(path, NAMES[0]), "", k, axes.times.len());
            let is_time = |time: &Named| is_vector(&time.array) && time_scale(time).is_some();
            clocks.push(time.filter(is_time).map(|time| self.clock(Named { name: String::new(), ..time })));
        }
        let raster = |entries: &Entries<'_>| field(entries, "Raster").and_then(text);
        for (k, entries) in axes.signals.iter().enumerate() {
            let Some(signal) = axis(entries, joined(path, NAMES[1]), called, k, axes.signals.len()) else {
                continue;
            };
            let same_raster =
                |x: &usize| raster(&axes.times[*x]).is_some_and(|of| Some(of) == raster(entries));
            let rasters: Vec<usize> = (0..clocks.len()).filter(same_raster).collect();
            let reach: Vec<usize> = match (index(entries), rasters.as_slice()) {
                (Some(x), _) => clocks.get(x).copied().flatten().into_iter().collect(),
                (None, &[x]) => clocks[x].into_iter().collect(),
                (None, _) => clocks.iter().copied().flatten().collect(),
            };
            self.give(signal, &reach);
        }
    }
}

/// The place of the time that a signal states, from 0.
fn index(entries: &Entries<'_>) -> Option<usize> {
    match field(entries, "XIndex")? {
        Value::Numbers(array) => match array.values.as_slice() {
            &[x] if x >= 1.0 && x.fract() == 0.0 => Some(x as usize - 1),
            _ => None,
        },
        _ => None,
    }
}

/// The data of a time or a signal, with the name and the unit that it states.
fn axis(entries: &Entries<'_>, path: String, called: &str, k: usize, count: usize) -> Option<Named> {
    let Some(Value::Numbers(array)) = field(entries, "Data") else { return None };
    let (path, called) = numbered(&path, called, k, count);
    let label = LABELS.iter().find_map(|label| field(entries, label).and_then(text));
    let (name, unit) = label.map_or((called, None), |label| cell(&label));
    let unit = unit.or_else(|| field(entries, "Unit").and_then(text));
    Some(Named { name, path: joined(&path, "Data"), unit, array: array.clone() })
}
