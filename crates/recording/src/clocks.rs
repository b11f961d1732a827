//! Signals with clocks of their own, to the columns of one recording.
//!
//! The clock with the most samples in what all of them cover is the grid's, as it is, or laid on a uniform grid as any
//! recording where its times depart from one. What has the same times is copied. Of any other signal each sample goes to the
//! instant of the grid that is nearest,
//!
//! ```text
//! y(g) = y(tᵢ) + (g − tᵢ) (y(tᵢ₊₁) − y(tᵢ)) / (tᵢ₊₁ − tᵢ) ,   |g − tᵢ| ≤ Δt/2 ,
//! ```
//!
//! on the line to its neighbour on that side, and no sample is made where there was none: everything else is missing, so
//! that the noise of a sample stays its own. With curvature |y″| ≤ c the line is off by at most c (tᵢ₊₁ − tᵢ)²/8.
//!
//! A value that is held (a command, a switch: [`Series::held`]) is known until the next one comes, and between the two levels
//! there is no third: it goes to the nearest instant as it is, late or early by at most Δt/2. The instants that follow stay
//! missing as well, because a model says what its inputs do there: missing samples of an input with `hold = "zero"` are
//! filled with the value before, others along straight lines. What was last known before the first instant, or within a
//! gap of the grid, goes to the next instant. Its clock may end early, because its value stays.

use crate::error::{Place, RecordingError};
use crate::finding::{Finding, Severity, listed, number};
use crate::recording::{Channel, MIN_SAMPLES, Recording, SIZES};

/// Most that an instant may be away from a sample, in steps: half of one, and the jitter at which times are a grid.
const NEAREST: f64 = 0.51;

/// A signal of a [`Clock`].
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// What the channel is called.
    pub name: String,
    /// Its unit as written; `None` = not stated.
    pub unit: Option<String>,
    /// Whether each value is kept until the next one (a command, a switch), instead of being a sample of something that
    /// moves.
    pub held: bool,
    /// One for each time of the clock; NaN = missing.
    pub values: Vec<f64>,
}

/// Times and the signals that have a value for each: one clock of [`Recording::from_clocks`].
#[derive(Debug, Clone, PartialEq)]
pub struct Clock {
    /// What the warnings call it.
    pub name: String,
    /// Times, s, in any order.
    pub time: Vec<f64>,
    /// Distance of two times that are not told apart, s: the last digit of times that were rounded; 0 = exact.
    pub resolution: f64,
    /// Its signals.
    pub series: Vec<Series>,
}

impl Recording {
    /// A recording from signals with clocks of their own, on one grid.
    ///
    /// The clock with the most samples in what all of them cover is the grid's. What has the same times is copied, to the
    /// bit. Any other sample goes to the nearest instant of the grid, at most half a step Δt away, along the straight line
    /// to its neighbour (a held value as it is); everything between is missing. Times that go back are put in order, of
    /// those that repeat the last counts, and an infinite value is missing. The warnings tell all of it (`clocks`).
    ///
    /// # Errors
    /// [`RecordingError::NoChannels`] without a signal; [`RecordingError::ColumnLength`] where a signal has not one value
    /// for each time of its clock; [`RecordingError::NoOverlap`] where no instant is covered by all;
    /// [`RecordingError::DuplicateName`]; else as [`Recording::from_columns`] of the signals of the grid's clock.
    ///
    /// ```
    /// use greybox_recording::{Clock, Recording, Series};
    /// let clock = |name: &str, rate: f64, count: u32| Clock {
    ///     name: name.into(),
    ///     time: (0..count).map(|k| f64::from(k) / rate).collect(),
    ///     resolution: 0.0,
    ///     series: vec![Series {
    ///         name: format!("{name}.x"),
    ///         unit: None,
    ///         held: false,
    ///         values: (0..count).map(f64::from).collect(),
    ///     }],
    /// };
    /// let run = Recording::from_clocks("run", vec![clock("slow", 50.0, 51), clock("fast", 100.0, 101)])?;
    /// assert_eq!(run.time.len(), 101);
    /// let slow = run.channel("slow.x").unwrap();
    /// assert_eq!((slow.values[0], slow.values[2]), (0.0, 1.0));
    /// assert!(slow.values[1].is_nan());
    /// # Ok::<(), greybox_recording::RecordingError>(())
    /// ```
    pub fn from_clocks(name: &str, clocks: Vec<Clock>) -> Result<Self, RecordingError> {
        let lengths = clocks.iter().flat_map(|clock| clock.series.iter().map(|s| (s, clock.time.len())));
        for (c, (series, expected)) in lengths.clone().enumerate() {
            if series.values.len() != expected {
                let place = Place::file(name).column(c + 1, &series.name);
                return Err(RecordingError::ColumnLength { place, found: series.values.len(), expected });
            }
        }
        if lengths.count() == 0 {
            return Err(RecordingError::NoChannels { place: Place::file(name) });
        }
        recording(name, name, clocks, Vec::new())
    }
}

/// The recording of several clocks; `label` names the file in errors, `notes` come before what is told here.
///
/// # Errors
/// [`RecordingError::NoOverlap`] where no instant is covered by all; a name that stands twice; else as
/// [`Recording::from_columns`] of the signals of the grid's clock.
pub(crate) fn recording(
    label: &str,
    name: &str,
    mut clocks: Vec<Clock>,
    mut notes: Vec<Finding>,
) -> Result<Recording, RecordingError> {
    for clock in &mut clocks {
        notes.extend(clock.tidy());
    }
    notes.extend(lone(&clocks));
    let rows = clocks.iter().map(|clock| clock.time.len()).max().unwrap_or(0);
    clocks.retain(|clock| !clock.is_lone() && !clock.series.is_empty());
    unique(label, &clocks)?;
    let (from, to) = overlap(label, &clocks)?;
    let inside = |clock: &Clock| clock.time.iter().filter(|t| (from..=to).contains(*t)).count();
    let counts: Vec<usize> = clocks.iter().map(inside).collect();
    let most = counts.iter().max().copied().unwrap_or(0);
    let fastest = counts.iter().position(|count| *count == most).unwrap_or(0);
    let Some(grid) = clocks.get(fastest).map(|clock| clock.within(from, to)) else {
        let (place, help) = (Place::file(label), "record for longer or export all samples");
        return Err(RecordingError::TooFewRows { place, rows, needed: MIN_SAMPLES, help });
    };
    notes.extend(cut(&clocks, from, to));
    let of_grid = grid.series.into_iter().map(Series::channel).collect();
    let mut base = Recording::checked(label, name, grid.time, of_grid, grid.resolution)?;
    if clocks.len() == 1 {
        base.warnings.splice(0..0, notes);
        return Ok(base);
    }
    let (time, mut own, resampled) = instants(base);
    let step = median_step(&time);
    let mut channels = Vec::new();
    for (k, clock) in clocks.iter().enumerate() {
        if k == fastest {
            channels.append(&mut own);
            continue;
        }
        let (columns, carried) = clock.carry(&time, step);
        // As many as the grid's, none of them moved: the same instants.
        let apart = carried.farthest > 0.0 || carried.lost > 0 || counts[k] < most;
        let told = apart.then(|| carried.told(clock, &clocks[fastest]));
        notes.extend(told.iter().flat_map(|told| columns.iter().map(|column| told.clone().on(&column.name))));
        channels.extend(columns);
    }
    let mut all = Recording::checked(label, name, time, channels, 0.0)?;
    notes.extend(resampled);
    all.warnings.splice(0..0, notes);
    Ok(all)
}

/// The instants of the grid and the channels on it: those of the recording, or of its pieces where it was resampled, then
/// with the warnings that say so.
fn instants(base: Recording) -> (Vec<f64>, Vec<Channel>, Vec<Finding>) {
    if !base.pieces.iter().any(|piece| piece.resampled) {
        return (base.time, base.channels, Vec::new());
    }
    let origin = base.time.first().copied().unwrap_or(0.0);
    let time = base.pieces.iter().flat_map(|piece| (0..piece.len).map(|k| origin + piece.time(k))).collect();
    let channels = base.channels.into_iter().enumerate().map(|(c, channel)| Channel {
        values: base.pieces.iter().filter_map(|piece| piece.columns.get(c)).flatten().copied().collect(),
        ..channel
    });
    let told = |warning: &Finding| matches!(warning.code, "jitter" | "short_piece");
    (time, channels.collect(), base.warnings.into_iter().filter(told).collect())
}

fn median_step(time: &[f64]) -> f64 {
    let steps: Vec<f64> = time.windows(2).map(|w| w[1] - w[0]).collect();
    crate::median::median(&steps)
}

/// What all clocks cover, s. A held value is known from its first sample on; what is sampled also up to its last.
fn overlap(label: &str, clocks: &[Clock]) -> Result<(f64, f64), RecordingError> {
    let first = |clock: &&Clock| clock.time.first().copied().unwrap_or(f64::NEG_INFINITY);
    let last = |clock: &&Clock| clock.time.last().copied().unwrap_or(f64::INFINITY);
    let sampled = clocks.iter().filter(|clock| clock.series.iter().any(|series| !series.held));
    let late = clocks.iter().max_by(|a, b| first(a).total_cmp(&first(b)));
    let early = sampled.min_by(|a, b| last(a).total_cmp(&last(b)));
    match (late, early) {
        (Some(late), Some(early)) if first(&late) > last(&early) => Err(RecordingError::NoOverlap {
            place: Place::file(label),
            late: late.name.clone(),
            begin: first(&late),
            early: early.name.clone(),
            end: last(&early),
        }),
        (Some(late), early) => Ok((first(&late), early.as_ref().map_or(f64::INFINITY, last))),
        _ => Ok((f64::NEG_INFINITY, f64::INFINITY)),
    }
}

/// What lies outside of what all clocks cover, in words.
fn cut(clocks: &[Clock], from: f64, to: f64) -> Option<Finding> {
    let samples: usize = clocks.iter().map(|clock| clock.time.len()).sum();
    let outside = |clock: &Clock| {
        let before = clock.time.partition_point(|t| *t < from);
        // Of what is held, the last value before the first instant counts.
        let known = usize::from(before > 0 && clock.series.iter().all(|series| series.held));
        before - known + clock.time.iter().filter(|t| **t > to).count()
    };
    let left_out: usize = clocks.iter().map(outside).sum();
    if left_out == 0 {
        return None;
    }
    let begins = clocks.iter().find(|clock| clock.time.first() == Some(&from));
    let ends = clocks.iter().find(|clock| clock.time.last() == Some(&to));
    let bounds = [(begins, "begins", from), (ends, "ends", to)]
        .into_iter()
        .filter_map(|(clock, what, at)| Some(format!("`{}` {what} at t = {} s", clock?.name, number(at))));
    let message = format!(
        "Only what all clocks cover counts: {left_out} of {samples} samples are left out ({}).",
        bounds.collect::<Vec<_>>().join(", ")
    );
    let help = "Read fewer channels with `--channels` where a clock begins late or ends early.";
    Some(Finding::new(Severity::Info, "clocks", message).help(help))
}

/// The clocks that are left out because one sample says nothing of what moves, in words.
fn lone(clocks: &[Clock]) -> Option<Finding> {
    let lone: Vec<String> = clocks.iter().filter(|c| c.is_lone()).map(|c| format!("`{}`", c.name)).collect();
    let message = || format!("Left out, having less than two samples: {}.", listed(lone.clone()));
    (!lone.is_empty()).then(|| Finding::new(Severity::Info, "left_out", message()))
}

fn unique(label: &str, clocks: &[Clock]) -> Result<(), RecordingError> {
    let mut seen = std::collections::BTreeMap::new();
    for (c, series) in clocks.iter().flat_map(|clock| &clock.series).enumerate() {
        if let Some(first) = seen.insert(series.name.as_str(), c) {
            return Err(RecordingError::DuplicateName {
                place: Place::file(label).column(c + 1, &series.name),
                name: series.name.clone(),
                first: first + 2,
            });
        }
    }
    Ok(())
}

impl Series {
    fn channel(self) -> Channel {
        Channel { name: self.name, unit: self.unit, values: self.values }
    }
}

/// What became of the samples of a clock.
#[derive(Debug, Default)]
struct Carried {
    samples: usize,
    /// Largest distance to the instant, s.
    farthest: f64,
    /// Samples that share their instant with another one, or have none.
    lost: usize,
    held: bool,
    sampled: bool,
}

impl Clock {
    /// Puts the times in order, the last of those that repeat alone; a value that cannot be computed with is missing.
    fn tidy(&mut self) -> Option<Finding> {
        let mut order: Vec<usize> = (0..self.time.len()).filter(|&k| self.time[k].is_finite()).collect();
        let timeless = self.time.len() - order.len();
        let back = order.windows(2).filter(|w| self.time[w[1]] < self.time[w[0]]).count();
        order.sort_by(|&a, &b| self.time[a].total_cmp(&self.time[b]));
        let all = order.len();
        let mut kept: Vec<usize> = Vec::with_capacity(all);
        for k in order {
            match kept.last_mut() {
                Some(last) if self.time[*last] == self.time[k] => *last = k,
                _ => kept.push(k),
            }
        }
        let repeated = all - kept.len();
        let mut beyond = 0;
        for series in &mut self.series {
            series.values = kept.iter().map(|&k| series.values.get(k).copied().unwrap_or(f64::NAN)).collect();
            for value in series.values.iter_mut().filter(|value| value.abs() > *SIZES.end()) {
                *value = f64::NAN;
                beyond += 1;
            }
        }
        self.time = kept.iter().map(|&k| self.time[k]).collect();
        let told: Vec<String> = [
            (timeless, "without a time left out"),
            (repeated, "left out whose time repeats"),
            (back, "put in order whose time goes back"),
            (beyond, "taken as missing whose value is infinite or beyond 1e100"),
        ]
        .into_iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, what)| format!("{count} {what}"))
        .collect();
        let message = || format!("Of the samples of `{}`: {}.", self.name, listed(told.clone()));
        (!told.is_empty()).then(|| Finding::new(Severity::Info, "clocks", message()))
    }

    /// Whether it has no sample, or one of something that moves.
    fn is_lone(&self) -> bool {
        self.time.is_empty() || (self.time.len() == 1 && self.series.iter().any(|series| !series.held))
    }

    /// The part from `from` to `to`, s.
    fn within(&self, from: f64, to: f64) -> Clock {
        let begin = self.time.partition_point(|t| *t < from);
        let rows = begin..self.time.partition_point(|t| *t <= to).max(begin);
        let part =
            |series: &Series| Series { values: series.values[rows.clone()].to_vec(), ..series.clone() };
        Clock {
            name: self.name.clone(),
            resolution: self.resolution,
            series: self.series.iter().map(part).collect(),
            time: self.time[rows.clone()].to_vec(),
        }
    }

    /// Its signals at the instants `grid` of about the step `step`, s.
    fn carry(&self, grid: &[f64], step: f64) -> (Vec<Channel>, Carried) {
        let mut carried = Carried::default();
        let columns = self.series.iter().map(|series| {
            let values = match series.held {
                true => self.held(series, grid, step, &mut carried),
                false => self.sampled(series, grid, step, &mut carried),
            };
            Channel { name: series.name.clone(), unit: series.unit.clone(), values }
        });
        (columns.collect(), carried)
    }

    fn held(&self, series: &Series, grid: &[f64], step: f64, carried: &mut Carried) -> Vec<f64> {
        let mut column = vec![f64::NAN; grid.len()];
        let mut count = Count::default();
        for (&t, &value) in self.time.iter().zip(&series.values).filter(|(_, value)| !value.is_nan()) {
            let place = nearest(grid, t);
            let shift = place.map_or(f64::INFINITY, |place| (grid[place] - t).abs());
            let near = shift <= NEAREST * step;
            let place = if near { place } else { Some(grid.partition_point(|g| *g < t)) };
            if let Some(cell) = place.and_then(|place| column.get_mut(place)) {
                match cell.is_nan() {
                    true => count.samples += 1,
                    false => count.lost += 1,
                }
                count.farthest = if near { count.farthest.max(shift) } else { count.farthest };
                *cell = value;
            }
        }
        carried.held = true;
        carried.add(count);
        column
    }

    fn sampled(&self, series: &Series, grid: &[f64], step: f64, carried: &mut Carried) -> Vec<f64> {
        let there = self.time.iter().copied().zip(series.values.iter().copied());
        let samples: Vec<(f64, f64)> = there.filter(|(_, value)| !value.is_nan()).collect();
        let mut column = vec![f64::NAN; grid.len()];
        // How far the sample at each instant came.
        let mut shifts = vec![f64::INFINITY; grid.len()];
        let mut count = Count::default();
        for (k, &(t, value)) in samples.iter().enumerate() {
            let Some(place) = nearest(grid, t) else { continue };
            let at = grid[place];
            let shift = (at - t).abs();
            if shift > NEAREST * step {
                count.lost += usize::from(t > grid[0] && t < grid[grid.len() - 1]);
                continue;
            }
            let other =
                if at > t { samples.get(k + 1) } else { k.checked_sub(1).and_then(|k| samples.get(k)) };
            let there = match other {
                _ if at == t => value,
                Some((s, other)) => value + (at - t) * (other - value) / (s - t),
                None => continue,
            };
            match shifts[place].is_finite() {
                true => count.lost += 1,
                false => count.samples += 1,
            }
            if shift < shifts[place] {
                (column[place], shifts[place]) = (there, shift);
                count.farthest = count.farthest.max(shift);
            }
        }
        carried.sampled = true;
        carried.add(count);
        column
    }

    /// Samples per second.
    fn rate(&self) -> String {
        match (self.time.first(), self.time.last()) {
            (Some(first), Some(last)) if last > first => {
                format!("{} Hz", number((self.time.len() - 1) as f64 / (last - first)))
            }
            _ => "one sample".to_owned(),
        }
    }
}

/// What became of the samples of one signal.
#[derive(Debug, Default)]
struct Count {
    samples: usize,
    farthest: f64,
    lost: usize,
}

impl Carried {
    /// Signals of one clock miss different samples; told is the largest of each number.
    fn add(&mut self, count: Count) {
        self.samples = self.samples.max(count.samples);
        self.farthest = self.farthest.max(count.farthest);
        self.lost = self.lost.max(count.lost);
    }

    fn told(&self, clock: &Clock, grid: &Clock) -> Finding {
        let how = match (self.sampled, self.held) {
            (true, false) => "carried along straight lines to the nearest instants of",
            _ => "moved as they are to the nearest instants of",
        };
        let lost = match self.lost {
            0 => String::new(),
            lost => format!("; {lost} are left out that share their instant with another one or have none"),
        };
        let between = match self.held {
            true => {
                "Between them the values are missing: an input with `hold = \"zero\"` keeps the one before"
            }
            false => "Between them it is missing",
        };
        let message = format!(
            "`{}` has its own clock ({}): its {} samples were {how} `{}` ({}), by at most {} ms{lost}. {between}.",
            clock.name,
            clock.rate(),
            self.samples,
            grid.name,
            grid.rate(),
            number(1e3 * self.farthest),
        );
        Finding::new(Severity::Info, "clocks", message).value(1e3 * self.farthest, Some("ms"))
    }
}

/// The place of the time that is nearest to `t`; the earlier one of two.
fn nearest(grid: &[f64], t: f64) -> Option<usize> {
    let right = grid.partition_point(|g| *g < t);
    match (right.checked_sub(1), grid.get(right)) {
        (Some(left), Some(g)) if t - grid[left] > g - t => Some(right),
        (Some(left), _) => Some(left),
        (None, Some(_)) => Some(right),
        (None, None) => None,
    }
}

#[cfg(test)]
mod tests;
