use super::*;
use std::f64::consts::PI;

/// `count` samples of a clock from `start` on, s, at `rate`, Hz.
fn times(start: f64, rate: f64, count: usize) -> Vec<f64> {
    (0..count).map(|k| start + k as f64 / rate).collect()
}

fn clock(name: &str, time: Vec<f64>, held: bool, signal: impl Fn(f64) -> f64) -> Clock {
    let values = time.iter().map(|t| signal(*t)).collect();
    Clock {
        name: name.to_owned(),
        series: vec![Series { name: format!("{name}.x"), unit: None, held, values }],
        time,
        resolution: 0.0,
    }
}

fn put_together(clocks: Vec<Clock>) -> Recording {
    recording("log", "log", clocks, Vec::new()).unwrap()
}

fn told(recording: &Recording) -> String {
    let told = recording.warnings.iter().filter(|w| w.code == "clocks").map(|w| w.message.as_str());
    told.collect::<Vec<_>>().join("\n")
}

#[test]
fn the_same_stamps_are_copied_to_the_bit() {
    let time: Vec<f64> =
        times(0.0, 500.0, 400).iter().enumerate().map(|(k, t)| t + 1e-6 * (k % 3) as f64).collect();
    let signal = |t: f64| (7.0 * t).sin() / 3.0;
    let other = |t: f64| (5.0 * t).cos() / 7.0;
    let together = put_together(vec![
        clock("a", time.clone(), false, signal),
        clock("b", time.clone(), false, other),
        clock("c", time.clone(), true, other),
    ]);
    assert_eq!(together.time, time);
    for (channel, signal) in together.channels.iter().zip([&signal as &dyn Fn(f64) -> f64, &other, &other]) {
        for (t, value) in time.iter().zip(&channel.values) {
            assert_eq!(value.to_bits(), signal(*t).to_bits());
        }
    }
    assert_eq!(told(&together), "");
}

/// A sine sampled at 90 Hz on a grid of 500 Hz: off by no more than the line's bound, and nothing is made up.
#[test]
fn a_slower_sine_is_within_the_bound_of_a_line() {
    let omega = 2.0 * PI * 5.0;
    let slow = clock("slow", times(0.0003, 90.0, 180), false, |t| (omega * t).sin());
    let fast = clock("fast", times(0.0, 500.0, 1000), false, |t| t);
    for together in [put_together(vec![slow.clone(), fast.clone()]), put_together(vec![fast, slow])] {
        assert_eq!(together.dt(), 0.002);
        let (fast, slow) = (together.channel("fast.x").unwrap(), together.channel("slow.x").unwrap());
        assert!(fast.values.iter().zip(&together.time).all(|(x, t)| x == t));
        let bound = omega * omega / (8.0 * 90.0 * 90.0);
        let present: Vec<(f64, f64)> = together
            .time
            .iter()
            .copied()
            .zip(slow.values.iter().copied())
            .filter(|(_, x)| !x.is_nan())
            .collect();
        let worst = present.iter().map(|(t, x)| (x - (omega * t).sin()).abs()).fold(0.0, f64::max);
        assert!(worst <= bound, "{worst} {bound}");
        // The line itself, not the sample as it was: that is off by more.
        let moved = omega * 0.001;
        assert!(worst < 0.5 * moved, "{worst} {moved}");
        assert!((178..=180).contains(&present.len()), "{}", present.len());
        let told = told(&together);
        assert!(
            told.contains("`slow` has its own clock (90 Hz)") && told.contains("`fast` (500 Hz), by at most"),
            "{told}"
        );
    }
}

/// A command that steps between two levels has no third one, is never late by more than half a step, and holds to the end.
#[test]
fn a_held_command_keeps_its_levels() {
    let level = |t: f64| if (t * 10.0).floor() as i64 % 2 == 0 { 1.0 } else { -1.0 };
    let command = clock("cmd", times(0.0007, 50.0, 40), true, level);
    let state = clock("state", times(0.0, 500.0, 1000), false, f64::sin);
    let together = put_together(vec![command.clone(), state]);
    let values = &together.channel("cmd.x").unwrap().values;
    assert!(values.iter().all(|v| v.is_nan() || v.abs() == 1.0));
    assert_eq!(values.iter().filter(|v| !v.is_nan()).count(), 40);
    let filled = crate::interpolate::hold_missing(values);
    for (t, v) in together.time.iter().zip(&filled) {
        let known = command.time.iter().rposition(|sent| *sent <= t + 0.001).unwrap_or(0);
        assert_eq!(*v, command.series[0].values[known], "at {t}");
    }
    assert_eq!(together.time.last(), Some(&1.998), "its last value stays");
    let told = told(&together);
    assert!(told.contains("its 40 samples were moved as they are"), "{told}");
    assert!(told.contains("hold = \"zero\""), "{told}");
}

/// What was last sent before the state begins is known at its first instant, and what was sent in a gap behind it.
#[test]
fn a_command_is_known_where_it_was_sent_before() {
    let state_time: Vec<f64> =
        times(1.0, 100.0, 300).into_iter().filter(|t| !(2.0..2.2).contains(t)).collect();
    let state = clock("state", state_time, false, f64::sin);
    let command = clock("cmd", vec![0.2, 0.5, 1.5, 2.1], true, |t| t);
    let together = put_together(vec![command, state]);
    let values = &together.channel("cmd.x").unwrap().values;
    let known: Vec<(f64, f64)> =
        together.time.iter().copied().zip(values.iter().copied()).filter(|(_, v)| !v.is_nan()).collect();
    assert_eq!(known, [(1.0, 0.5), (1.5, 1.5), (2.2, 2.1)]);
}

#[test]
fn only_what_all_clocks_cover_counts() {
    let a = clock("a", times(0.0, 100.0, 300), false, f64::sin);
    let b = clock("b", times(0.5, 50.0, 100), false, f64::cos);
    let together = put_together(vec![a, b]);
    assert_eq!((together.time[0], together.time[together.time.len() - 1]), (0.5, 2.48));
    let told = told(&together);
    assert!(
        told.contains("101 of 400 samples are left out (`b` begins at t = 0.5 s, `b` ends at t = 2.48 s)"),
        "{told}"
    );
    let early = clock("early", times(0.0, 100.0, 50), false, f64::sin);
    let late = clock("late", times(0.6, 100.0, 50), false, f64::sin);
    let error = recording("log", "log", vec![late, early], Vec::new()).unwrap_err().to_string();
    assert!(error.contains("log: `late` begins at 0.6 s, after `early` has ended at 0.49 s"), "{error}");
}

#[test]
fn times_that_repeat_or_go_back_are_put_in_order_and_told() {
    let mut time = times(0.0, 100.0, 50);
    time.swap(10, 11);
    time[20] = time[19];
    time[30] = f64::NAN;
    let mut a = clock("a", time, false, |_| 0.0);
    a.series[0].values = (0..50).map(f64::from).collect();
    a.series[0].values[40] = f64::INFINITY;
    let together = put_together(vec![a]);
    assert_eq!(together.time.len(), 48);
    assert_eq!(together.channels[0].values[10..12], [11.0, 10.0]);
    assert_eq!(together.channels[0].values[19], 20.0, "the last of two");
    assert!(together.channels[0].values.iter().all(|v| !v.is_infinite()));
    let told = told(&together);
    for part in [
        "1 without a time",
        "1 left out whose time repeats",
        "put in order",
        "1 taken as missing whose value is infinite",
    ] {
        assert!(told.contains(part), "{told}");
    }
}

/// Times that jitter are laid on a uniform grid, and a slower signal keeps its samples there.
#[test]
fn a_jittering_grid_keeps_the_samples_of_others() {
    let jitter = |k: usize| 0.0004 * ((k * 7919 % 13) as f64 / 6.0 - 1.0);
    let fast_time: Vec<f64> = (0..1000).map(|k| 0.002 * k as f64 + jitter(k)).collect();
    let fast = clock("fast", fast_time, false, |t| (2.0 * t).sin());
    let slow = clock("slow", times(0.0, 100.0, 199), false, |t| t);
    let together = put_together(vec![fast, slow]);
    assert!(together.pieces.iter().all(|piece| !piece.resampled));
    assert_eq!(together.warnings.iter().filter(|w| w.code == "jitter").count(), 1);
    let piece = &together.pieces[0];
    assert!((piece.dt - 0.002).abs() < 1e-6);
    let slow: Vec<(f64, f64)> = (0..piece.len)
        .map(|k| (together.time[0] + piece.time(k), piece.columns[1][k]))
        .filter(|(_, v)| !v.is_nan())
        .collect();
    assert!(slow.len() >= 197, "{}", slow.len());
    assert!(slow.iter().all(|(t, v)| (t - v).abs() < 1e-9));
}

/// What was sent once is known from then on; what was sampled once says nothing, and shortens nothing.
#[test]
fn one_sample_is_a_setting_or_nothing() {
    let state = clock("state", times(0.0, 100.0, 100), false, f64::sin);
    let payload = clock("payload", vec![-3.0], true, |_| 2.5);
    let fix = clock("fix", vec![0.5], false, |_| 7.0);
    let together = put_together(vec![payload, fix, state]);
    assert_eq!(together.time.len(), 100);
    assert!(together.channel("fix.x").is_none());
    assert_eq!(together.channel("payload.x").unwrap().values[0], 2.5);
    assert_eq!(together.warnings[0].code, "left_out");
    assert!(together.warnings[0].message.contains("less than two samples: `fix`"), "{}", told(&together));
}

#[test]
fn names_are_unique_and_short_logs_are_refused() {
    let a = || clock("a", times(0.0, 100.0, 50), false, f64::sin);
    let twice = recording("log", "log", vec![a(), a()], Vec::new()).unwrap_err();
    assert!(matches!(twice, RecordingError::DuplicateName { .. }), "{twice}");
    let short = recording("log", "log", vec![clock("a", times(0.0, 1.0, 5), false, f64::sin)], Vec::new())
        .unwrap_err();
    assert!(matches!(short, RecordingError::TooFewRows { .. }), "{short}");
    let none = recording("log", "log", Vec::new(), Vec::new()).unwrap_err();
    assert!(matches!(none, RecordingError::TooFewRows { rows: 0, .. }), "{none}");
    let none = Recording::from_clocks("log", Vec::new()).unwrap_err();
    assert!(matches!(none, RecordingError::NoChannels { .. }), "{none}");
    let mut long = a();
    long.series[0].values.push(0.0);
    let long = Recording::from_clocks("log", vec![long]).unwrap_err();
    assert!(matches!(long, RecordingError::ColumnLength { found: 51, expected: 50, .. }), "{long}");
}
