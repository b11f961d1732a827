//! Which time a signal was sampled at.
//!
//! | the times in reach | the signal belongs to |
//! |---|---|
//! | none has as many values as the signal | none: it is left out |
//! | one that is called `t`, `time`, … has its length | that one |
//! | one whose name without `t` or `time` stands in the signal's path (`t_motor` and `motor_angle`), of its length | that one |
//! | such a one, of another length | nobody knows |
//! | one has its length, or several that are the same times | that one |
//! | several that differ have its length | nobody knows |
//!
//! In reach are the times of the structure around the signal; of the structures around that one, where it has no time that
//! is called `t`, `time`, ….

use super::{Array, Clock, Named, Signal, is_vector, split, time_scale};
use crate::header::TIMES;
use crate::recording::MIN_SAMPLES;
use crate::variables::Class;

/// A signal, and the times that it may belong to.
pub(super) struct Unclear {
    pub(super) path: String,
    pub(super) times: Vec<String>,
}

/// Where a signal belongs.
enum Place {
    Clock(usize),
    Nowhere,
    Unclear(Vec<usize>),
}

/// The array that is called as a time is.
pub(super) fn plain_time(arrays: &[Named]) -> Option<usize> {
    let is_time =
        |a: &Named, wanted: &str| a.name == wanted && is_vector(&a.array) && time_scale(a).is_some();
    TIMES.iter().find_map(|wanted| arrays.iter().position(|a| is_time(a, wanted)))
}

/// Whether an array is a time beside others: called `t`, `t_NAME`, `NAME_t` or as much with another word for the time, it
/// increases, and is as long as a recording.
pub(super) fn is_further_time(named: &Named) -> bool {
    let values = &named.array.values;
    word(&named.name).is_some()
        && named.array.class != Class::Truth
        && is_vector(&named.array)
        && time_scale(named).is_some()
        && values.len() >= MIN_SAMPLES
        && values.iter().all(|t| t.is_finite())
        && values.windows(2).all(|w| w[1] > w[0])
}

/// What the name of a time says beside that it is one: `motor` of `t_motor`, nothing of `t`.
fn word(name: &str) -> Option<&str> {
    TIMES.iter().find_map(|time| match name == *time {
        true => Some(""),
        false => name
            .strip_prefix(time)
            .and_then(|rest| rest.strip_prefix('_'))
            .or_else(|| name.strip_suffix(time).and_then(|rest| rest.strip_suffix('_')))
            .filter(|word| !word.is_empty()),
    })
}

/// Whether the words of `name` stand in a path, one after the other.
fn stands_in(name: &str, path: &str) -> bool {
    let words = |text: &str| -> Vec<String> {
        let parts = text.split(|c: char| !c.is_alphanumeric()).filter(|w| !w.is_empty());
        parts.map(str::to_lowercase).collect()
    };
    let (name, path) = (words(name), words(path));
    !name.is_empty() && path.windows(name.len()).any(|part| part == name)
}

/// Whether two times are the same up to rounding.
pub(super) fn same_times(a: &[f64], b: &[f64]) -> bool {
    let span = a.last().unwrap_or(&0.0) - a.first().unwrap_or(&0.0);
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-9 * span.abs())
}

fn place(named: &Named, clocks: &[Clock], reach: &[usize]) -> Place {
    let fits = |c: &usize| split(&named.array, clocks[*c].time.len()).is_some();
    let of_its_name = |c: &usize| word(&clocks[*c].name).is_some_and(|word| stands_in(word, &named.path));
    let by_length: Vec<usize> = reach.iter().copied().filter(fits).collect();
    let by_name: Vec<usize> = reach.iter().copied().filter(of_its_name).collect();
    let both: Vec<usize> = by_name.iter().copied().filter(fits).collect();
    let plain: Vec<usize> = by_length.iter().copied().filter(|&c| clocks[c].is_plain()).collect();
    let candidates = match (plain.is_empty(), by_name.is_empty()) {
        (false, _) => plain,
        (true, true) => by_length,
        (true, false) if both.is_empty() && !by_length.is_empty() => {
            return Place::Unclear(by_length.into_iter().chain(by_name).collect());
        }
        (true, false) => both,
    };
    let Some(&first) = candidates.first() else { return Place::Nowhere };
    match candidates.iter().all(|&c| same_times(&clocks[first].time, &clocks[c].time)) {
        true => Place::Clock(first),
        false => Place::Unclear(candidates),
    }
}

/// Gives an array to the one of the clocks in `reach` that it belongs to.
///
/// # Errors
/// The array, where no clock has its length; why it is not clear which one, else.
pub(super) fn give(
    named: Named,
    clocks: &mut [Clock],
    reach: &[usize],
) -> Result<(), Result<Named, Unclear>> {
    match place(&named, clocks, reach) {
        Place::Nowhere => Err(Ok(named)),
        Place::Clock(c) => clocks[c].take(named).map_err(Ok),
        Place::Unclear(times) => {
            let times = times.into_iter().map(|c| format!("`{}`", clocks[c].path)).collect();
            Err(Err(Unclear { path: named.path, times }))
        }
    }
}

impl Clock {
    /// Whether it is called `t`, `time`, … and no more.
    pub(super) fn is_plain(&self) -> bool {
        word(&self.name) == Some("")
    }

    /// Takes the signals of an array that has a value for each time, and gives back any other.
    pub(super) fn take(&mut self, named: Named) -> Result<(), Named> {
        let Some(signals) = split(&named.array, self.time.len()) else { return Err(named) };
        let several = signals.len() > 1;
        let Array { class, .. } = named.array;
        self.signals.extend(signals.into_iter().enumerate().map(|(k, values)| Signal {
            name: if several { format!("{}_{}", named.name, k + 1) } else { named.name.clone() },
            path: named.path.clone(),
            unit: named.unit.clone(),
            held: class == Class::Truth,
            values,
        }));
        Ok(())
    }
}
