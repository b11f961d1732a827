//! From the times of a file to pieces on one uniform grid.

use crate::finding::{Finding, Severity, number};
use crate::noise::median;
use crate::recording::{Channel, MIN_SAMPLES, Piece};
use std::ops::Range;

/// Largest departure of a time from the uniform grid, in steps, at which the rows are taken as they are.
const JITTER_LIMIT: f64 = 0.01;

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
    let dt = pooled_slope(time, &stretches);
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

/// Cuts the channels into pieces on the grid and says what had to be mended.
pub(crate) fn pieces(grid: &Grid, time: &[f64], channels: &[Channel]) -> (Vec<Piece>, Vec<Finding>) {
    let dt = grid.dt;
    let (mut pieces, mut warnings) = (Vec::new(), Vec::new());
    let mut worst = 0.0f64;
    let mut resampled_rows = 0;
    let (mut short, mut short_rows) = (Vec::new(), 0);

    for rows in &grid.stretches {
        if rows.len() < MIN_SAMPLES {
            short.push(rows.clone());
            short_rows += rows.len();
            continue;
        }
        let apart = departure(time, rows, dt);
        let resampled = apart > grid.rounding + JITTER_LIMIT * dt;
        let (len, columns) = if resampled {
            worst = worst.max(apart / dt);
            resampled_rows += rows.len();
            let times = &time[rows.clone()];
            let len = ((times[times.len() - 1] - times[0]) / dt + 1e-6).floor() as usize + 1;
            let on_grid = |channel: &Channel| resample(times, &channel.values[rows.clone()], dt, len);
            (len, channels.iter().map(on_grid).collect())
        } else {
            (rows.len(), channels.iter().map(|channel| channel.values[rows.clone()].to_vec()).collect())
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
            .mend("Record with a hardware clock, or log at a higher rate, if fast motion matters.")
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
        warnings.push(
            Finding::new(
                Severity::Warning,
                "gap",
                format!(
                    "About {} rows are missing in {} ({}); the recording is split there.",
                    number(missing),
                    if holes.len() == 1 { "one gap".to_owned() } else { format!("{} gaps", holes.len()) },
                    places.join("; ")
                ),
            )
            .mend("Each piece gets its own initial state; record without dropped samples for the full power.")
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

/// Linear interpolation onto `times[0] + k dt`; NaN where a neighbour that counts is missing.
fn resample(times: &[f64], values: &[f64], dt: f64, len: usize) -> Vec<f64> {
    let mut right = 1;
    (0..len)
        .map(|k| {
            let t = times[0] + k as f64 * dt;
            while right + 1 < times.len() && times[right] < t {
                right += 1;
            }
            let (t0, t1) = (times[right - 1], times[right]);
            let share = ((t - t0) / (t1 - t0)).clamp(0.0, 1.0);
            if share < 1e-6 {
                values[right - 1]
            } else if share > 1.0 - 1e-6 {
                values[right]
            } else {
                (1.0 - share) * values[right - 1] + share * values[right]
            }
        })
        .collect()
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
