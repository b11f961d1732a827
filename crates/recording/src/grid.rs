//! From the times of a file to pieces on one uniform grid.

use crate::finding::{Finding, Severity, number};
use crate::median::median;
use crate::recording::{Channel, MIN_SAMPLES, Piece};
use std::ops::Range;

/// Largest departure of a time from the uniform grid, in steps, at which the rows are taken as they are.
const JITTER_LIMIT: f64 = 0.01;

/// Departure of a stretch from a line, in steps, from which a log has several rates.
const SEVERAL_RATES: f64 = 1.0;

/// The uniform grid behind the times of a recording.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Grid {
    /// Step, s.
    pub(crate) dt: f64,
    /// Stretches of rows without a gap, in order, together all rows.
    pub(crate) stretches: Vec<Range<usize>>,
    /// Departure from the grid that the printed digits of the times explain, s.
    pub(crate) rounding: f64,
}

/// Finds step and gaps of strictly increasing times (at least two), s.
///
/// A gap is a step longer than 1.5 median steps, or beyond the jitter (4 robust standard deviations of the
/// steps) where that is larger. The step Δt is the least-squares slope of time against row, pooled over the
/// stretches between gaps, so that the rounding of printed times averages out. `resolution` is the last
/// printed digit of the times, s: a clock whose step is not a multiple of it shows two alternating steps, and
/// that is neither jitter nor a gap.
pub(crate) fn find(time: &[f64], resolution: f64) -> Grid {
    let steps: Vec<f64> = time.windows(2).map(|w| w[1] - w[0]).collect();
    let middle = median(&steps);
    let deviations: Vec<f64> = steps.iter().map(|d| (d - middle).abs()).collect();
    let uneven = deviations.iter().filter(|&&d| d > 0.5 * resolution).count();
    let rounding = 0.51 * resolution;
    let coarse_clock = resolution > 0.01 * middle && uneven as f64 > 0.02 * steps.len() as f64;

    let all = 0..time.len();
    let longest = if coarse_clock {
        let whole = std::slice::from_ref(&all);
        let dt = pooled_slope(time, whole);
        if departure(time, &all, dt) <= rounding + JITTER_LIMIT * dt {
            return Grid { dt: tidy(dt, time.len()), stretches: vec![all], rounding };
        }
        let near: Vec<f64> =
            steps.iter().copied().filter(|d| (d - middle).abs() < 1.5 * resolution).collect();
        let mean = near.iter().sum::<f64>() / near.len() as f64;
        let jitter = 4.0 * 1.4826 * median(&deviations);
        (1.5 * mean + resolution).max(middle + jitter)
    } else {
        middle + (0.5 * middle).max(4.0 * 1.4826 * median(&deviations))
    };

    let mut stretches = Vec::new();
    let mut first = 0;
    for (k, &step) in steps.iter().enumerate() {
        if step > longest {
            stretches.push(first..k + 1);
            first = k + 1;
        }
    }
    stretches.push(first..time.len());
    // Of a log with several rates no line is a fit: most rows decide.
    let slope = pooled_slope(time, &stretches);
    let several = || stretches.iter().any(|rows| departure(time, rows, slope) > SEVERAL_RATES * slope);
    let dt = if !coarse_clock && several() { middle } else { slope };
    Grid { dt: tidy(dt, time.len()), stretches, rounding }
}

/// Least-squares slope of time against row, each stretch with its own offset, over the stretches that will be
/// kept (over all of them if none will).
fn pooled_slope(time: &[f64], stretches: &[Range<usize>]) -> f64 {
    // Sums of departures from a first guess keep the digits that sums of times would lose.
    let steps = || time.windows(2).map(|w| w[1] - w[0]);
    let guess = stretches.iter().max_by_key(|rows| rows.len()).filter(|rows| rows.len() > 1).map_or_else(
        || steps().fold(f64::INFINITY, f64::min),
        |rows| (time[rows.end - 1] - time[rows.start]) / (rows.len() - 1) as f64,
    );
    let slope = |shortest: usize| {
        let (mut above, mut below) = (0.0, 0.0);
        for rows in stretches.iter().filter(|rows| rows.len() >= shortest) {
            let middle = 0.5 * (rows.len() as f64 - 1.0);
            for (k, &t) in time[rows.clone()].iter().enumerate() {
                // Σx = 0 over the stretch: its own offset drops out.
                let x = k as f64 - middle;
                above += x * (t - time[rows.start] - k as f64 * guess);
                below += x * x;
            }
        }
        (below > 0.0).then(|| guess + above / below)
    };
    slope(MIN_SAMPLES).or_else(|| slope(2)).unwrap_or(guess)
}

/// Largest distance of the times from the line of slope `dt` that halves the extremes, s.
fn departure(time: &[f64], rows: &Range<usize>, dt: f64) -> f64 {
    let origin = time[rows.start];
    let (low, high) = time[rows.clone()]
        .iter()
        .enumerate()
        .map(|(k, t)| t - origin - k as f64 * dt)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), e| (low.min(e), high.max(e)));
    0.5 * (high - low)
}

/// The shortest decimal number that stays within 10⁻⁵ steps of `dt` over `n` samples.
fn tidy(dt: f64, n: usize) -> f64 {
    (0..17)
        .filter_map(|digits| format!("{dt:.digits$e}").parse::<f64>().ok())
        .find(|short| (short - dt).abs() * n as f64 <= 1e-5 * dt)
        .unwrap_or(dt)
}

/// A gap longer than this share of the recording splits it: what the machine did meanwhile is anyone's guess.
const LONGEST_GAP: f64 = 0.1;
/// Most grid points for each row; beyond, the longest gaps split the recording.
const MOST_POINTS: f64 = 64.0;

/// Lays the channels on the grid and says what had to be fixed. Rows that are left out are the same as rows with empty
/// cells: the grid goes on, without a value. Only long gaps split the recording.
pub(crate) fn pieces(grid: &Grid, time: &[f64], channels: &[Channel]) -> (Vec<Piece>, Vec<Finding>) {
    let parts = parts(grid, time, channels);
    let grid = &Grid { dt: over_gaps(grid, time, &parts), ..grid.clone() };
    let dt = grid.dt;
    let (mut pieces, mut warnings) = (Vec::new(), Vec::new());
    let mut worst = 0.0f64;
    let mut resampled_rows = 0;
    let (mut short, mut short_rows) = (Vec::new(), 0);

    for rows in &parts {
        let observed = |row: &usize| channels.iter().any(|c| !c.values[*row].is_nan());
        if rows.len() < MIN_SAMPLES
            || (parts.len() > 1 && rows.clone().filter(observed).count() < MIN_SAMPLES)
        {
            short.push(rows.clone());
            short_rows += rows.len();
            continue;
        }
        let places = places(grid, time, rows);
        let apart = apart(time, rows, &places, dt);
        let resampled = apart > grid.rounding + JITTER_LIMIT * dt;
        let (len, columns) = if resampled {
            worst = worst.max(apart / dt);
            resampled_rows += rows.len();
            let times = &time[rows.clone()];
            let len = ((times[times.len() - 1] - times[0]) / dt + 1e-6).floor() as usize + 1;
            let ends = stretches_within(grid, rows);
            let on_grid = |channel: &Channel| resample(times, &channel.values[rows.clone()], &ends, dt, len);
            (len, channels.iter().map(on_grid).collect())
        } else {
            let len = places.last().map_or(0, |last| last + 1);
            let laid_out = |channel: &Channel| {
                let mut column = vec![f64::NAN; len];
                for (place, value) in places.iter().zip(&channel.values[rows.clone()]) {
                    column[*place] = *value;
                }
                column
            };
            (len, channels.iter().map(laid_out).collect())
        };
        if len < MIN_SAMPLES {
            short.push(rows.clone());
            short_rows += rows.len();
            continue;
        }
        pieces.push(Piece {
            start: time[rows.start] - time[0],
            dt,
            rows: rows.clone(),
            len,
            columns,
            resampled,
        });
    }

    if worst > 0.0 {
        warnings.push(
            Finding::new(
                Severity::Warning,
                "jitter",
                format!(
                    "The sampling times depart from a uniform grid by up to {} % of the step; {resampled_rows} \
                     rows were interpolated linearly onto a grid of {} s.",
                    number(100.0 * worst),
                    number(dt)
                ),
            )
            .help(
                "Record with a hardware clock, or log at a higher rate, if fast motion matters. Of an input with \
                 `hold = \"zero\"` a model sees the mean over each step instead.",
            )
            .value(100.0 * worst, Some("%")),
        );
    }
    if grid.stretches.len() > 1 {
        let holes: Vec<(f64, f64)> =
            grid.stretches.windows(2).map(|w| (time[w[0].end - 1], time[w[1].start])).collect();
        let missing: f64 = holes.iter().map(|(a, b)| ((b - a) / dt).round() - 1.0).sum();
        let mut places: Vec<String> = holes
            .iter()
            .take(3)
            .map(|(a, b)| format!("from t = {} s to {} s", number(*a), number(*b)))
            .collect();
        if holes.len() > 3 {
            places.push(format!("{} more", holes.len() - 3));
        }
        let (split, help) = match parts.len() {
            1 => (
                "they count as rows with empty cells".to_owned(),
                "What an input did there follows its `hold`; record without dropped samples if it did otherwise.",
            ),
            n => (
                format!("the recording is split into {n} pieces at the longest"),
                "Each piece gets its own initial state; record without dropped samples for the full power.",
            ),
        };
        warnings.push(
            Finding::new(
                Severity::Warning,
                "gap",
                format!(
                    "About {} rows are missing in {} ({}); {split}.",
                    number(missing),
                    if holes.len() == 1 { "one gap".to_owned() } else { format!("{} gaps", holes.len()) },
                    places.join("; ")
                ),
            )
            .help(help)
            .value(missing, None),
        );
    }
    if let Some(first) = short.first() {
        warnings.push(
            Finding::new(
                Severity::Warning,
                "short_piece",
                format!(
                    "{} between gaps shorter than {MIN_SAMPLES} samples left out ({short_rows} rows, the first at \
                     t = {} s).",
                    if short.len() == 1 { "One piece".to_owned() } else { format!("{} pieces", short.len()) },
                    number(time[first.start])
                ),
            )
            .value(short_rows as f64, None),
        );
    }
    (pieces, warnings)
}

/// The rows of each piece: the recording is split at gaps longer than [`LONGEST_GAP`] of it, whether rows are left out or
/// hold no value, and at its longest gaps where the grid would have more than [`MOST_POINTS`] points for each row.
fn parts(grid: &Grid, time: &[f64], channels: &[Channel]) -> Vec<Range<usize>> {
    let observed: Vec<usize> =
        (0..time.len()).filter(|&row| channels.iter().any(|c| !c.values[row].is_nan())).collect();
    let (Some(&first), Some(&last)) = (observed.first(), observed.last()) else {
        return std::iter::once(0..time.len()).collect();
    };
    let span = time[last] - time[first];
    let longest_step = 1.5 * grid.dt;
    // Rows before and after each gap, longest gap first.
    let mut gaps: Vec<(usize, usize)> = observed
        .windows(2)
        .map(|w| (w[0], w[1]))
        .filter(|(a, b)| time[*b] - time[*a] > longest_step)
        .collect();
    gaps.sort_by(|x, y| (time[y.1] - time[y.0]).total_cmp(&(time[x.1] - time[x.0])));
    let mut points = span / grid.dt;
    let mut cuts = Vec::new();
    for (a, b) in gaps {
        let length = time[b] - time[a];
        if length <= LONGEST_GAP * span && points <= MOST_POINTS * observed.len() as f64 {
            break;
        }
        points -= length / grid.dt;
        cuts.push((a, b));
    }
    cuts.sort_unstable();
    let mut parts = Vec::new();
    let mut from = 0;
    for (a, b) in cuts {
        parts.push(from..a + 1);
        from = b;
    }
    parts.push(from..time.len());
    parts
}

/// The step that also fits the gaps of a recording in one part: short stretches alone do not give it to many digits.
fn over_gaps(grid: &Grid, time: &[f64], parts: &[Range<usize>]) -> f64 {
    let [rows] = parts else { return grid.dt };
    if grid.stretches.len() < 2 {
        return grid.dt;
    }
    let places = places(grid, time, rows);
    let n = places.len() as f64;
    let middle = places.iter().map(|p| *p as f64).sum::<f64>() / n;
    let (mut above, mut below) = (0.0, 0.0);
    for (place, t) in places.iter().zip(&time[rows.clone()]) {
        let x = *place as f64 - middle;
        above += x * (t - time[rows.start] - *place as f64 * grid.dt);
        below += x * x;
    }
    let dt = grid.dt + if below > 0.0 { above / below } else { 0.0 };
    // Rows off the grid make it no better.
    let fits = |dt: f64| apart(time, rows, &places, dt);
    if fits(dt) < fits(grid.dt) && fits(dt) <= grid.rounding + JITTER_LIMIT * dt {
        tidy(dt, places.last().map_or(0, |last| last + 1))
    } else {
        grid.dt
    }
}

/// The stretches within these rows, counted from the first of them.
fn stretches_within(grid: &Grid, rows: &Range<usize>) -> Vec<Range<usize>> {
    grid.stretches
        .iter()
        .map(|s| s.start.max(rows.start)..s.end.min(rows.end))
        .filter(|s| s.start < s.end)
        .map(|s| s.start - rows.start..s.end - rows.start)
        .collect()
}

/// The grid point of each of these rows: within a stretch one after the other, and over a gap as many further as its
/// length holds steps.
fn places(grid: &Grid, time: &[f64], rows: &Range<usize>) -> Vec<usize> {
    let mut places = Vec::with_capacity(rows.len());
    for stretch in stretches_within(grid, rows) {
        let first = match places.last() {
            None => 0,
            Some(&before) => {
                let gap = time[rows.start + stretch.start] - time[rows.start + stretch.start - 1];
                before + ((gap / grid.dt).round() as usize).max(1)
            }
        };
        places.extend((0..stretch.len()).map(|k| first + k));
    }
    places
}

/// Largest distance of the times from the grid that halves the extremes, s.
fn apart(time: &[f64], rows: &Range<usize>, places: &[usize], dt: f64) -> f64 {
    let origin = time[rows.start];
    let (low, high) = time[rows.clone()]
        .iter()
        .zip(places)
        .map(|(t, place)| t - origin - *place as f64 * dt)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), e| (low.min(e), high.max(e)));
    0.5 * (high - low)
}

/// Linear interpolation onto `times[0] + k dt` within the `stretches`; NaN in gaps, and where a neighbour that counts is
/// missing. The ends of a stretch, which no point of the grid may meet, stand at the nearest one.
fn resample(times: &[f64], values: &[f64], stretches: &[Range<usize>], dt: f64, len: usize) -> Vec<f64> {
    let mut out = vec![f64::NAN; len];
    for stretch in stretches {
        let (t, v) = (&times[stretch.clone()], &values[stretch.clone()]);
        let place = |t: f64| (t - times[0]) / dt;
        let from = (place(t[0]) - 1e-6).ceil().max(0.0) as usize;
        let to = ((place(t[t.len() - 1]) + 1e-6).floor() as usize + 1).min(len);
        let mut right = 1.min(t.len() - 1);
        for (k, cell) in out.iter_mut().enumerate().take(to).skip(from) {
            let at = times[0] + k as f64 * dt;
            while right + 1 < t.len() && t[right] < at {
                right += 1;
            }
            let left = right.saturating_sub(1);
            let step = t[right] - t[left];
            let share = if step > 0.0 { ((at - t[left]) / step).clamp(0.0, 1.0) } else { 1.0 };
            *cell = if share < 1e-6 {
                v[left]
            } else if share > 1.0 - 1e-6 {
                v[right]
            } else {
                (1.0 - share) * v[left] + share * v[right]
            };
        }
        for end in [0, t.len() - 1] {
            let nearest = (place(t[end]).round().max(0.0) as usize).min(len - 1);
            if out[nearest].is_nan() {
                out[nearest] = v[end];
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_times_give_the_exact_step() {
        for (dt, digits, n) in
            [(1.0 / 750.0, 7, 40_961), (0.001_638_4, 8, 65_000), (0.001, 3, 24_841), (4.0, 0, 1024)]
        {
            let unit = 10f64.powi(digits);
            let time: Vec<f64> = (0..n).map(|k| (k as f64 * dt * unit).round() / unit).collect();
            let grid = find(&time, 1.0 / unit);
            assert_eq!(grid.stretches.len(), 1);
            assert!((grid.dt - dt).abs() * (n as f64) < 0.01 * dt, "{dt}: {}", grid.dt);
        }
        assert_eq!(find(&(0..600_000).map(|k| f64::from(k) / 1000.0).collect::<Vec<_>>(), 0.001).dt, 0.001);
        assert_eq!(find(&(0..100).map(|k| f64::from(k) / 1000.0).collect::<Vec<_>>(), 0.001).dt, 0.001);
    }

    #[test]
    fn a_coarse_clock_is_not_a_row_of_gaps() {
        // 750 Hz printed in ms: steps 1, 1, 2, 1, 1, 2 …
        let mut time: Vec<f64> = (0..3000).map(|k| (f64::from(k) / 0.75).round() / 1000.0).collect();
        let grid = find(&time, 0.001);
        assert_eq!(grid.stretches.len(), 1);
        assert!((grid.dt - 1.0 / 750.0).abs() < 1e-8);
        for t in &mut time[2000..] {
            *t += 0.1;
        }
        assert_eq!(find(&time, 0.001).stretches, vec![0..2000, 2000..3000]);
    }

    #[test]
    fn one_missing_row_is_a_gap_even_when_the_clock_prints_one_digit_per_step() {
        let time: Vec<f64> = (0..500).filter(|&k| k != 200).map(|k| f64::from(k) / 1000.0).collect();
        assert_eq!(find(&time, 0.001).stretches, vec![0..200, 200..499]);
    }
}
