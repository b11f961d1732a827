//! Which variables are the time, which the signals, and how the signals are called.

mod axes;
mod join;
mod pairing;

use crate::error::{Place, RecordingError};
use crate::finding::{Finding, Severity, listed};
use crate::header::{header_cell, seconds};
use crate::recording::{MIN_SAMPLES, Recording};
use crate::selection::Selection;
use crate::variables::{Array, Class, Value, Variable};
use pairing::Unclear;

/// Names of a list of column names, alone or behind the matrix's name and `_`.
const NAMES: [&str; 6] = ["names", "labels", "columns", "channels", "header", "headers"];

/// Names that say nothing of a signal: it is called as the structure around it.
const NAMELESS: [&str; 4] = ["values", "data", "Values", "Data"];

/// What a structure calls the signal in it.
const LABELS: [&str; 3] = ["label", "name", "Name"];

/// A signal that is sampled at the times of its clock.
struct Signal {
    name: String,
    /// The variable and the fields that lead to it.
    path: String,
    unit: Option<String>,
    held: bool,
    values: Vec<f64>,
}

/// A time and the signals that have a value for each.
struct Clock {
    /// What the array is called.
    name: String,
    path: String,
    time: Vec<f64>,
    /// Distance of two times that `single` cannot tell apart, s.
    resolution: f64,
    signals: Vec<Signal>,
}

/// An array and what it is called.
struct Named {
    name: String,
    path: String,
    unit: Option<String>,
    array: Array,
}

/// What was found in the file.
#[derive(Default)]
struct Found {
    clocks: Vec<Clock>,
    /// Arrays that no clock goes with.
    loose: Vec<Named>,
    /// Signals that may belong to several clocks.
    unclear: Vec<Unclear>,
    /// What is not read, in words.
    others: Vec<String>,
    objects: bool,
}

/// The entries of a workspace or a structure.
type Entries<'a> = Vec<(&'a str, &'a Value)>;

/// The recording in the variables of a file; of one whose signals have several clocks what is selected.
pub(crate) fn recording(
    variables: &[Variable],
    label: &str,
    name: &str,
    selection: &Selection,
) -> Result<Recording, RecordingError> {
    let mut found = Found::default();
    found.scope("", "signal", &variables.iter().map(|v| (v.name.as_str(), &v.value)).collect(), &[]);
    let mut warnings = Vec::new();
    found.put_back();
    if found.clocks.is_empty()
        && let Some(clock) = found.first_column()
    {
        warnings.push(Finding::new(
            Severity::Info,
            "time_column",
            format!("No variable is called `t` or `time`: {} is taken as the time, in s.", clock.path),
        ));
        found.clocks.push(clock);
    }
    let left_out = found.listed();
    if !left_out.is_empty() {
        let message = format!("Left out of the file, having no value for each time: {left_out}.");
        warnings.push(Finding::new(Severity::Info, "left_out", message));
    }
    if found.clocks.iter().all(|clock| clock.signals.is_empty()) && found.unclear.is_empty() {
        return Err(found.nothing(label, left_out));
    }
    join::recording(found, label, name, selection, warnings)
}

impl Found {
    /// Looks through the entries of a workspace or a structure; `called` is what a signal without a name of its own is
    /// called, `around` the times of what stands around it.
    fn scope(&mut self, path: &str, called: &str, entries: &Entries<'_>, around: &[usize]) {
        let mut arrays = Vec::new();
        for &(name, value) in entries {
            let path = joined(path, name);
            match value {
                Value::Numbers(array) => arrays.extend(named(entries, name, path, called, array)),
                Value::Other(what) => {
                    self.objects |= *what == "an object";
                    self.others.push(format!("`{path}` ({what})"));
                }
                Value::Text(_) | Value::Structure { .. } | Value::Cells(_) => {}
            }
        }
        // Numbers that stand alone are settings.
        arrays.retain(|a| a.array.values.len() > 1);
        let reach = self.times(&mut arrays, around);
        for array in arrays {
            self.give(array, &reach);
        }
        let axes = axes::find(entries);
        if let Some(axes) = &axes {
            self.axes(axes, path, called);
        }
        let entries = entries.iter().filter(|(name, _)| axes.is_none() || !axes::NAMES.contains(name));
        self.inside(path, called, &entries.copied().collect(), &reach);
    }

    /// Takes the times out of the arrays of a scope; those that its signals may belong to.
    fn times(&mut self, arrays: &mut Vec<Named>, around: &[usize]) -> Vec<usize> {
        let plain = pairing::plain_time(arrays).map(|index| self.clock(arrays.remove(index)));
        let mut reach: Vec<usize> = plain.map_or_else(|| around.to_vec(), |plain| vec![plain]);
        // What has the length of a time that is there already is a signal.
        let lengths: Vec<usize> = reach.iter().map(|&c| self.clocks[c].time.len()).collect();
        let is_further =
            |a: &mut Named| pairing::is_further_time(a) && !lengths.contains(&a.array.values.len());
        let further: Vec<Named> = arrays.extract_if(.., is_further).collect();
        reach.extend(further.into_iter().map(|time| self.clock(time)));
        reach
    }

    fn clock(&mut self, time: Named) -> usize {
        self.clocks.push(Clock::new(time));
        self.clocks.len() - 1
    }

    /// Gives an array to the one of the clocks in `reach` that it belongs to.
    fn give(&mut self, array: Named, reach: &[usize]) {
        match pairing::give(array, &mut self.clocks, reach) {
            Ok(()) => {}
            Err(Ok(array)) => self.loose.push(array),
            Err(Err(unclear)) => self.unclear.push(unclear),
        }
    }

    /// Looks through the structures and cells of a scope.
    fn inside(&mut self, path: &str, called: &str, entries: &Entries<'_>, reach: &[usize]) {
        for &(name, value) in entries.iter().filter(|(name, _)| !matches!(*name, "units" | "unit")) {
            let path = joined(path, name);
            // `signals` is Simulink's word for the signals of the structure around it.
            let called = if name == "signals" { called } else { name };
            match value {
                Value::Structure { count, fields } => {
                    for k in 0..if fields.is_empty() { 0 } else { *count } {
                        let (path, called) = numbered(&path, called, k, *count);
                        let entries =
                            fields.iter().filter_map(|(n, v)| Some((n.as_str(), v.get(k)?))).collect();
                        self.scope(&path, &called, &entries, reach);
                    }
                }
                Value::Cells(cells) => {
                    for (k, cell) in cells.iter().enumerate() {
                        if let Value::Structure { count: 1, fields } = cell {
                            let (path, called) = numbered(&path, called, k, cells.len());
                            let entries =
                                fields.iter().filter_map(|(n, v)| Some((n.as_str(), v.first()?))).collect();
                            self.scope(&path, &called, &entries, reach);
                        }
                    }
                }
                _ => {}
            }
        }
    }

    /// The only matrix of the file, its first column (or row) being the time: what Simulink's `Array` and `To File` write.
    fn first_column(&mut self) -> Option<Clock> {
        let is_matrix = |a: &Named| a.array.dimensions.len() == 2 && !is_vector(&a.array);
        let mut matrices = (0..self.loose.len()).filter(|&k| is_matrix(&self.loose[k]));
        let (index, None) = (matrices.next()?, matrices.next()) else { return None };
        let Array { dimensions, class, .. } = &self.loose[index].array;
        let (long, class, which) = if dimensions[0] >= dimensions[1] {
            (dimensions[0], *class, "column")
        } else {
            (dimensions[1], *class, "row")
        };
        let signals = split(&self.loose[index].array, long)?;
        let (time, values) = signals.split_first()?;
        let rises = time.windows(2).all(|w| w[1] > w[0]) && time.iter().all(|t| t.is_finite());
        if !rises || time.len() < MIN_SAMPLES {
            return None;
        }
        let (time, values) = (time.clone(), values.to_vec());
        let Named { name, path, .. } = self.loose.remove(index);
        let several = values.len() > 1;
        let signals = values.into_iter().enumerate().map(|(k, values)| Signal {
            name: if several { format!("{name}_{}", k + 1) } else { name.clone() },
            path: path.clone(),
            unit: None,
            held: false,
            values,
        });
        let signals = signals.collect();
        let array = Array { dimensions: vec![time.len(), 1], values: time, class };
        let named =
            Named { name: String::new(), path: format!("the first {which} of `{path}`"), unit: None, array };
        Some(Clock { signals, ..Clock::new(named) })
    }

    /// Names the further times that no signal goes with among what is left out.
    fn put_back(&mut self) {
        let idle = |clock: &mut Clock| clock.signals.is_empty() && !clock.is_plain();
        let idle = self.clocks.extract_if(.., idle);
        self.others.extend(idle.map(|clock| format!("`{}` ({} times)", clock.path, clock.time.len())));
    }

    /// Why the file is no recording.
    fn nothing(&self, label: &str, found: String) -> RecordingError {
        let place = Place::file(label);
        if let Some(clock) = self.clocks.first() {
            return RecordingError::NoSignals {
                place,
                time: clock.path.clone(),
                rows: clock.time.len(),
                found,
            };
        }
        RecordingError::NoTime {
            place,
            found: if found.is_empty() { "nothing".to_owned() } else { found },
            help: match self.objects {
                true => {
                    "the content of MATLAB's objects (timeseries, tables, Simulink's data sets) is not kept in a form \
                     that others can read: save the arrays, `t = ts.Time; y = ts.Data; save('run.mat', 't', 'y', '-v7')`"
                }
                false => "call the vector of times, in s, `t`",
            },
        }
    }

    /// What is not read, in words.
    fn listed(&self) -> String {
        let arrays = self.loose.iter().map(|a| {
            let size: Vec<String> = a.array.dimensions.iter().map(usize::to_string).collect();
            format!("`{}` ({})", a.path, size.join("×"))
        });
        listed(arrays.chain(self.others.iter().cloned()).collect())
    }
}

impl Clock {
    fn new(time: Named) -> Clock {
        let scale = time_scale(&time).unwrap_or(1.0);
        let longest = time.array.values.iter().fold(0.0f64, |most, t| most.max(t.abs()));
        Clock {
            resolution: if time.array.class == Class::Single {
                scale * longest * f64::from(f32::EPSILON)
            } else {
                0.0
            },
            time: time.array.values.into_iter().map(|t| scale * t).collect(),
            name: time.name,
            path: time.path,
            signals: Vec::new(),
        }
    }
}

/// Seconds per unit of a time.
fn time_scale(time: &Named) -> Option<f64> {
    seconds(time.unit.as_deref())
}

fn is_vector(array: &Array) -> bool {
    array.dimensions.contains(&array.values.len())
}

/// The signals of `n` samples in an array: all of a vector, the columns of a matrix, or the rows where it has `n` columns;
/// with more dimensions the last one counts the samples.
fn split(array: &Array, n: usize) -> Option<Vec<Vec<f64>>> {
    let (first, last) = (*array.dimensions.first()?, *array.dimensions.last()?);
    let Array { values, dimensions, .. } = array;
    if n == 0 || values.is_empty() {
        None
    } else if values.len() == n && is_vector(array) {
        Some(vec![values.clone()])
    } else if dimensions.len() == 2 && first == n {
        Some(values.chunks(n).map(<[f64]>::to_vec).collect())
    } else if last == n {
        let count = values.len() / n;
        Some((0..count).map(|k| values.iter().skip(k).step_by(count).copied().collect()).collect())
    } else {
        None
    }
}

/// An array of a scope, under the name it goes by; the columns of a matrix where the scope names them.
fn named(entries: &Entries<'_>, name: &str, path: String, called: &str, array: &Array) -> Vec<Named> {
    let unit = entries.iter().find_map(|(other, value)| match value {
        Value::Structure { count: 1, fields } if matches!(*other, "units" | "unit") => {
            fields.iter().find(|(field, _)| field == name).and_then(|(_, value)| text(value.first()?))
        }
        _ => None,
    });
    if let (Some(names), [rows, columns]) = (column_names(entries, name), array.dimensions.as_slice())
        && !is_vector(array)
        && let Some(samples) =
            [(columns, rows), (rows, columns)].into_iter().find(|(n, _)| **n == names.len())
        && let Some(signals) = split(array, *samples.1)
        && signals.len() == names.len()
    {
        let column = |(text, values): (&String, Vec<f64>)| {
            let (name, unit) = cell(text);
            let array = Array { dimensions: vec![values.len(), 1], values, class: array.class };
            Named { name, path: path.clone(), unit, array }
        };
        return names.iter().zip(signals).map(column).collect();
    }
    let (name, own) = if NAMELESS.contains(&name) {
        let label =
            entries.iter().filter(|(other, _)| LABELS.contains(other)).find_map(|(_, value)| text(value));
        label.map_or_else(|| (called.to_owned(), None), |label| cell(&label))
    } else {
        (name.to_owned(), None)
    };
    vec![Named { name, path, unit: own.or(unit), array: array.clone() }]
}

/// The names that a scope states for the columns of its matrix `name`.
fn column_names(entries: &Entries<'_>, name: &str) -> Option<Vec<String>> {
    let own = |other: &str| other.strip_prefix(name)?.strip_prefix('_').map(|rest| NAMES.contains(&rest));
    let lists = entries.iter().filter(|(other, _)| own(other) == Some(true));
    lists.chain(entries.iter().filter(|(other, _)| NAMES.contains(other))).find_map(
        |(_, value)| match value {
            Value::Text(rows) if rows.len() > 1 => Some(rows.clone()),
            Value::Cells(cells) => cells.iter().map(text).collect(),
            _ => None,
        },
    )
}

/// A text of one line that is not empty.
fn text(value: &Value) -> Option<String> {
    match value {
        Value::Text(rows) if rows.len() == 1 && !rows[0].trim().is_empty() => Some(rows[0].trim().to_owned()),
        _ => None,
    }
}

/// `name` or `name [unit]`, without the brackets that Simulink puts around the names it passes on.
fn cell(text: &str) -> (String, Option<String>) {
    let bare = text.trim().trim_start_matches('<').trim_end_matches('>');
    header_cell(bare, || Place::file("")).unwrap_or_else(|_| (bare.to_owned(), None))
}

fn joined(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") }
}

/// Path and name of the `k`th of `count`.
fn numbered(path: &str, called: &str, k: usize, count: usize) -> (String, String) {
    match count {
        1 => (path.to_owned(), called.to_owned()),
        _ => (format!("{path}({})", k + 1), format!("{called}_{}", k + 1)),
    }
}
