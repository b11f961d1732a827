//! Properties of gridding, noise estimates, smoothing and interpolation on signals that are known.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use greybox_recording::interpolate::upsample_band_limited;
use greybox_recording::noise::{
    channel_sigma, noise_sigma, quantisation_step, recording_sigma, spectral_floor_sigma,
};
use greybox_recording::smooth::{WINDOWS, adaptive, savitzky_golay};
use greybox_recording::{Channel, Recording, RecordingError};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::PI;

fn white(seed: u64, n: usize, sigma: f64) -> Vec<f64> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let normal = Normal::new(0.0, sigma).unwrap();
    (0..n).map(|_| normal.sample(&mut rng)).collect()
}

fn channel(values: Vec<f64>) -> Channel {
    Channel { name: "y".to_owned(), unit: Some("m".to_owned()), values }
}

fn codes(recording: &Recording) -> Vec<&'static str> {
    recording.warnings.iter().map(|w| w.code).collect()
}

#[test]
fn long_gaps_split_and_short_pieces_go() {
    let kept = |k: usize| !(100..140).contains(&k) && !(145..190).contains(&k);
    let time: Vec<f64> = (0..300).filter(|&k| kept(k)).map(|k| 5.0 + 0.01 * k as f64).collect();
    let values: Vec<f64> = time.iter().map(|t| t.sin()).collect();
    let recording = Recording::from_columns("g.csv", time, vec![channel(values.clone())]).unwrap();
    assert_eq!(codes(&recording), ["gap", "short_piece"]);
    let rows: Vec<_> = recording.pieces.iter().map(|p| p.rows.clone()).collect();
    assert_eq!(rows, [0..100, 105..215]);
    assert_eq!(recording.warnings[0].value, Some(85.0));
    assert!(recording.warnings[0].message.contains("from t = 5.99 s to 6.4 s"), "{}", recording.warnings[0]);
    for piece in &recording.pieces {
        assert_eq!((piece.dt, piece.resampled, piece.len), (0.01, false, piece.rows.len()));
        assert_eq!(piece.columns[0], values[piece.rows.clone()]);
    }
    assert!((recording.pieces[1].start - 1.9).abs() < 1e-12);
}

/// Rows that were left out of a log, and the same rows with empty cells, are the same recording; whatever the gaps.
#[test]
fn rows_left_out_are_rows_with_empty_cells() {
    let mut rng = Pcg64Mcg::seed_from_u64(11);
    for (share, long) in [(0.2, 0), (0.02, 20), (0.0, 90)] {
        let lost: Vec<bool> = (0..600)
            .map(|k| {
                (k > 0 && k < 599 && rng.random_range(0.0..1.0) < share) || (200..200 + long).contains(&k)
            })
            .collect();
        let (t, y) = (|k: usize| 0.01 * k as f64, |k: usize| (0.05 * k as f64).sin());
        let left = || (0..600).filter(|&k| !lost[k]);
        let without =
            Recording::from_columns("g", left().map(t).collect(), vec![channel(left().map(y).collect())])
                .unwrap();
        let cells: Vec<f64> = (0..600).map(|k| if lost[k] { f64::NAN } else { y(k) }).collect();
        let with = Recording::from_columns("g", (0..600).map(t).collect(), vec![channel(cells)]).unwrap();
        assert_eq!(without.pieces.len(), if long > 60 { 2 } else { 1 });
        assert_eq!(without.pieces.len(), with.pieces.len());
        for (a, b) in without.pieces.iter().zip(&with.pieces) {
            assert_eq!((a.len, a.dt), (b.len, b.dt));
            assert!((a.start - b.start).abs() < 1e-9);
            let bits =
                |p: &greybox_recording::Piece| p.columns[0].iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(a), bits(b));
        }
    }
}

/// A logger that writes a row every second while something happens and every minute at rest, faster in a pulse.
#[test]
fn an_event_driven_log_is_one_piece() {
    let mut time = Vec::new();
    let mut t: f64 = 0.0;
    for burst in 0..20 {
        for k in 0..120 {
            t += if burst == 7 && k < 40 { 0.1 } else { 1.0 };
            time.push(t);
        }
        for k in 0..30 {
            t += if k == 3 { 24.6 } else { 60.0 };
            time.push(t);
        }
    }
    let values: Vec<f64> = time.iter().map(|t| (0.001 * t).sin()).collect();
    let recording = Recording::from_columns("e.csv", time.clone(), vec![channel(values)]).unwrap();
    assert_eq!((recording.pieces.len(), recording.dt()), (1, 1.0));
    let piece = &recording.pieces[0];
    let seen: Vec<usize> = (0..piece.len).filter(|&k| !piece.columns[0][k].is_nan()).collect();
    assert!(seen.len() > 20 * (80 + 30), "{}", seen.len());
    for k in seen {
        // Rows off the grid stand at most half a step beside their time.
        assert!((piece.columns[0][k] - (0.001 * (time[0] + piece.time(k))).sin()).abs() < 0.6e-3);
    }
}

#[test]
fn nothing_but_gaps_is_an_error() {
    let time: Vec<f64> = (0..40).map(|k| f64::from(k / 4) + 0.01 * f64::from(k % 4)).collect();
    let error = Recording::from_columns("g.csv", time.clone(), vec![channel(time)]).unwrap_err();
    assert!(matches!(error, RecordingError::NoUsablePiece { pieces: 10, .. }), "{error}");
}

#[test]
fn small_jitter_is_taken_and_large_jitter_resampled() {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    for (jitter, resampled) in [(0.008, false), (0.1, true)] {
        let dt = 0.02;
        let time: Vec<f64> =
            (0..2000).map(|k| dt * (f64::from(k) + rng.random_range(-jitter..jitter))).collect();
        let values: Vec<f64> = time.iter().map(|t| (3.0 * t).sin()).collect();
        let recording = Recording::from_columns("j.csv", time.clone(), vec![channel(values)]).unwrap();
        assert_eq!(recording.pieces.len(), 1);
        let piece = &recording.pieces[0];
        assert!((piece.dt / dt - 1.0).abs() < 1e-5, "{}", piece.dt);
        assert_eq!(piece.resampled, resampled);
        assert_eq!(codes(&recording), if resampled { vec!["jitter"] } else { vec![] });
        if resampled {
            for (k, y) in piece.columns[0].iter().enumerate() {
                let exact = (3.0 * (time[0] + piece.time(k))).sin();
                // Linear interpolation: h²/8 · |y''| = 0.024² / 8 · 9.
                assert!((y - exact).abs() < 7e-4, "{k}: {y} {exact}");
            }
        }
    }
}

#[test]
fn missing_samples_stay_missing_through_resampling() {
    let time: Vec<f64> = (0..200).map(|k| f64::from(k) + if k % 2 == 0 { 0.0 } else { 0.1 }).collect();
    let mut values = time.clone();
    values[50..60].fill(f64::NAN);
    let recording = Recording::from_columns("m.csv", time, vec![channel(values)]).unwrap();
    let y = &recording.pieces[0].columns[0];
    assert!(recording.pieces[0].resampled);
    assert!(y[51..59].iter().all(|v| v.is_nan()));
    assert!(y[..49].iter().chain(&y[61..]).all(|v| v.is_finite()));
}

#[test]
fn columns_in_memory_are_checked() {
    let time: Vec<f64> = (0..20).map(f64::from).collect();
    let build = |time: Vec<f64>, values: Vec<f64>| Recording::from_columns("c", time, vec![channel(values)]);
    assert!(matches!(build(time.clone(), vec![0.0; 19]), Err(RecordingError::ColumnLength { .. })));
    assert!(matches!(build(vec![0.0; 20], vec![0.0; 20]), Err(RecordingError::TimeNotIncreasing { .. })));
    assert!(matches!(build(vec![f64::NAN; 20], vec![0.0; 20]), Err(RecordingError::NotFinite { .. })));
    assert!(matches!(build(time.clone(), vec![f64::INFINITY; 20]), Err(RecordingError::NotFinite { .. })));
    assert!(matches!(
        build(time[..7].to_vec(), vec![0.0; 7]),
        Err(RecordingError::TooFewRows { rows: 7, .. })
    ));
}

#[test]
fn noise_is_estimated_within_five_per_cent() {
    for seed in 0..20 {
        let sigma = 0.01;
        let noise = white(seed, 8000, sigma);
        let mut y: Vec<f64> =
            (0..8000).map(|k| (2.0 * PI * f64::from(k) / 150.0).sin() + noise[k as usize]).collect();
        let estimate = noise_sigma(&y);
        assert!((estimate / sigma - 1.0).abs() < 0.05, "seed {seed}: {estimate}");
        // Missing samples thin the windows out and bias nothing.
        (0..8000).step_by(37).for_each(|k| y[k] = f64::NAN);
        let estimate = noise_sigma(&y);
        assert!((estimate / sigma - 1.0).abs() < 0.05, "seed {seed}, with missing samples: {estimate}");
    }
    assert!(noise_sigma(&[1.0; 4]).is_nan() && noise_sigma(&[]).is_nan());
}

#[test]
fn the_spectral_floor_sees_under_a_signal_that_fourth_differences_take_for_noise() {
    for seed in 0..5 {
        let noise = white(seed, 20_000, 1e-3);
        let y: Vec<f64> = (0..20_000).map(|k| (2.0 * PI * 0.11 * k as f64).sin() + noise[k]).collect();
        assert!(noise_sigma(&y) > 10e-3);
        let floor = spectral_floor_sigma(&y);
        assert!((floor / 1e-3 - 1.0).abs() < 0.05, "seed {seed}: {floor}");
    }
    assert!(spectral_floor_sigma(&[1.0; 10]).is_nan());
}

#[test]
fn noise_is_never_differenced_across_a_gap() {
    let noise = white(5, 2000, 1e-3);
    let time: Vec<f64> = (0..2000).map(|k| f64::from(k) + if k < 1000 { 0.0 } else { 500.0 }).collect();
    let values: Vec<f64> = (0..2000).map(|k| if k < 1000 { 0.0 } else { 100.0 } + noise[k]).collect();
    let recording = Recording::from_columns("n.csv", time, vec![channel(values)]).unwrap();
    assert!((recording_sigma(&recording, 0) / 1e-3 - 1.0).abs() < 0.08);
    assert!(recording_sigma(&recording, 9).is_nan());
}

#[test]
fn quantisation_is_found_and_counted() {
    for (q, amplitude) in [(0.01, 1.0), (2.0 * PI / 2000.0, 0.2), (1e-7, 1e-3)] {
        let y: Vec<f64> =
            (0..5000).map(|k| (amplitude * (f64::from(k) * 0.003).sin() / q).round() * q + 0.3 * q).collect();
        let found = quantisation_step(&y).expect("quantised");
        assert!((found / q - 1.0).abs() < 1e-3, "{found} {q}");
        assert!(channel_sigma(&y) >= 0.999 * q / 12f64.sqrt());
    }
    for seed in 0..5 {
        assert_eq!(quantisation_step(&white(seed, 5000, 1.0)), None);
        let exact: Vec<f64> = (0..5000).map(|k| (f64::from(k) * 0.003).sin()).collect();
        assert_eq!(quantisation_step(&exact), None);
    }
}

#[test]
fn a_few_samples_off_the_raster_do_not_hide_it() {
    let mut y: Vec<f64> = (0..5000).map(|k| (40.0 * (f64::from(k) * 0.01).sin()).round() * 0.5).collect();
    y[1000] += 0.07;
    y[3000] -= 0.11;
    let q = quantisation_step(&y).expect("quantised");
    assert!((q - 0.5).abs() < 1e-3, "{q}");
}

fn cubic(t: f64) -> (f64, f64, f64) {
    (2.0 - t + 0.5 * t * t - 0.3 * t.powi(3), -1.0 + t - 0.9 * t * t, 1.0 - 1.8 * t)
}

#[test]
fn savitzky_golay_is_exact_on_cubics_ends_and_missing_samples_included() {
    let dt = 0.01;
    let exact: Vec<_> = (0..300).map(|k| cubic(dt * f64::from(k))).collect();
    for missing in [vec![], vec![0, 1, 2], vec![40, 42, 43, 44, 45, 150, 299], (100..108).collect()] {
        let mut y: Vec<f64> = exact.iter().map(|e| e.0).collect();
        for &k in &missing {
            y[k] = f64::NAN;
        }
        for window in [5, 7, 11, 41, 131] {
            let smooth = savitzky_golay(&y, dt, window, 3);
            for (k, e) in exact.iter().enumerate() {
                if missing.len() >= window && missing.contains(&k) {
                    continue; // A run as long as the window is bridged by a line.
                }
                assert!((smooth.value[k] - e.0).abs() < 1e-10, "{window} {k}");
                assert!((smooth.d1[k] - e.1).abs() < 1e-7, "{window} {k} {} {}", smooth.d1[k], e.1);
                assert!((smooth.d2[k] - e.2).abs() < 1e-4, "{window} {k} {} {}", smooth.d2[k], e.2);
            }
        }
    }
}

#[test]
fn long_missing_runs_are_bridged_by_a_line() {
    let mut y: Vec<f64> = (0..100).map(|k| 3.0 + 2.0 * f64::from(k)).collect();
    y[30..60].fill(f64::NAN);
    y[..10].fill(f64::NAN);
    let smooth = savitzky_golay(&y, 0.5, 7, 2);
    for k in 10..100 {
        assert!((smooth.value[k] - 3.0 - 2.0 * k as f64).abs() < 1e-9);
        assert!((smooth.d1[k] - 4.0).abs() < 1e-9);
    }
    assert!(smooth.value[..10].iter().all(|v| (v - 23.0).abs() < 1e-9), "held before the first sample");
    assert!(savitzky_golay(&[f64::NAN; 20], 0.5, 7, 2).value.iter().all(|v| v.is_nan()));
}

#[test]
fn savitzky_golay_survives_every_small_size() {
    for n in 0..12 {
        for window in 0..15 {
            for order in 0..6 {
                for every in [1, 2, 3] {
                    let y: Vec<f64> =
                        (0..n).map(|k| if k % every == 0 { k as f64 } else { f64::NAN }).collect();
                    let smooth = savitzky_golay(&y, 1.0, window, order);
                    assert_eq!((smooth.value.len(), smooth.d1.len(), smooth.d2.len()), (n, n, n));
                    assert!(smooth.value.iter().all(|v| v.is_finite()), "{n} {window} {order} {every}");
                }
            }
        }
        assert_eq!(adaptive(&vec![1.0; n], 1.0, 0.1).value.len(), n);
    }
}

/// A sine of nine samples per period, with hardly any noise: a cubic over seven samples bends its derivative, and
/// `adaptive` says by how much. A slow sine under noise is not bent, and the noise is not taken for it.
#[test]
fn the_smoothing_says_what_it_bends() {
    let (dt, sigma) = (0.01, 1e-4);
    for (per_period, bends) in [(9.0, true), (400.0, false)] {
        let omega = 2.0 * PI / (per_period * dt);
        let t: Vec<f64> = (0..4000).map(|k| f64::from(k) * dt).collect();
        let y: Vec<f64> = t.iter().zip(white(11, 4000, sigma)).map(|(t, n)| (omega * t).sin() + n).collect();
        let smooth = adaptive(&y, dt, sigma);
        let inner = 20..3980;
        let rms = |made: &[f64], truth: &dyn Fn(f64) -> f64| {
            let sum: f64 = inner.clone().map(|k| (made[k] - truth(t[k])).powi(2)).sum();
            (sum / inner.len() as f64).sqrt()
        };
        let (value, d1) =
            (rms(&smooth.value, &|t| (omega * t).sin()), rms(&smooth.d1, &|t| omega * (omega * t).cos()));
        if bends {
            assert!((smooth.value_bend / value - 1.0).abs() < 0.2, "{} of {value}", smooth.value_bend);
            // By the next even order, which is bent too, but less.
            assert!((0.6..1.1).contains(&(smooth.d1_bend / d1)), "{} of {d1}", smooth.d1_bend);
        } else {
            assert!(smooth.value_bend < sigma, "{}", smooth.value_bend);
            assert!(smooth.d1_bend < 2.0 * smooth.d1_std_error(sigma), "{}", smooth.d1_bend);
        }
    }
}

#[test]
fn the_adaptive_window_follows_the_noise() {
    let dt = 1e-3;
    let signal = |k: usize| (2.0 * PI * 4.0 * dt * k as f64).sin();
    let slope = |k: usize| 2.0 * PI * 4.0 * (2.0 * PI * 4.0 * dt * k as f64).cos();
    let mut previous = 0;
    for sigma in [1e-7, 1e-4, 1e-2, 0.1] {
        let noise = white(11, 4000, sigma);
        let y: Vec<f64> = (0..4000).map(|k| signal(k) + noise[k]).collect();
        let smooth = adaptive(&y, dt, sigma);
        assert!(WINDOWS.contains(&smooth.window) && smooth.window >= previous, "{}", smooth.window);
        assert!(smooth.derivative_window >= 7);
        previous = smooth.window;
        let inside = 100..3900;
        let rms = |error: &dyn Fn(usize) -> f64| {
            (inside.clone().map(|k| error(k).powi(2)).sum::<f64>() / inside.len() as f64).sqrt()
        };
        let value_error = rms(&|k| smooth.value[k] - signal(k));
        let slope_error = rms(&|k| smooth.d1[k] - slope(k));
        // The rule lets the signal bend by up to √(1.15² − 1) σ beyond the predicted error.
        let limit = sigma * (smooth.value_gain.powi(2) + 0.3225).sqrt();
        assert!(value_error < limit, "{sigma}: {value_error}");
        assert!(slope_error >= 0.8 * smooth.d1_std_error(sigma), "{sigma}: {slope_error}");
        assert!(slope_error < 0.05 * 2.0 * PI * 4.0, "{sigma}: {slope_error}");
    }
    assert!(previous >= 61, "{previous}");
}

#[test]
fn predicted_standard_errors_hold_on_pure_noise() {
    let y = white(2, 20_000, 0.5);
    let smooth = savitzky_golay(&y, 0.01, 25, 3);
    let rms = |x: &[f64]| (x[20..19_980].iter().map(|v| v * v).sum::<f64>() / 19_960.0).sqrt();
    assert!((rms(&smooth.value) / smooth.value_std_error(0.5) - 1.0).abs() < 0.03);
    assert!((rms(&smooth.d1) / smooth.d1_std_error(0.5) - 1.0).abs() < 0.03);
}

#[test]
fn band_limited_upsampling_reproduces_sines() {
    let n = 400;
    let factor = 8;
    for (frequency, phase) in [(0.1, 0.0), (0.4, 0.0), (0.4, 0.7), (0.25, 1.3)] {
        let wave = |x: f64| (2.0 * PI * frequency * x + phase).sin();
        let u: Vec<f64> = (0..n).map(|k| wave(k as f64)).collect();
        let fine = upsample_band_limited(&u, factor);
        assert_eq!(fine.len(), (n - 1) * factor + 1);
        for (j, v) in fine.iter().enumerate() {
            let x = j as f64 / factor as f64;
            let inside = x > 32.0 && x < n as f64 - 33.0;
            let error = (v - wave(x)).abs();
            assert!(!inside || error < 1e-4, "{frequency} {phase} at {x}: {error}");
            if j % factor == 0 {
                assert_eq!(*v, u[j / factor], "exact at the samples");
            }
        }
    }
    // At the ends the odd reflection is exact for a sine through zero.
    let u: Vec<f64> = (0..101).map(|k| (2.0 * PI * 0.4 * f64::from(k)).sin()).collect();
    let worst = upsample_band_limited(&u, 8)
        .iter()
        .enumerate()
        .map(|(j, v)| (v - (2.0 * PI * 0.4 * j as f64 / 8.0).sin()).abs())
        .fold(0.0, f64::max);
    assert!(worst < 3e-2, "{worst}");
}

#[test]
fn upsampling_keeps_constants_and_lines_and_small_sizes() {
    for n in 1..80 {
        let fine = upsample_band_limited(&vec![0.1; n], 5);
        assert_eq!(fine, vec![0.1; 5 * (n - 1) + 1]);
        let line: Vec<f64> = (0..n).map(|k| 2.0 - 3.0 * k as f64).collect();
        for (j, v) in upsample_band_limited(&line, 4).iter().enumerate() {
            assert!((v - (2.0 - 0.75 * j as f64)).abs() < 2e-2, "{n} {j} {v}");
        }
    }
    assert!(upsample_band_limited(&[], 4).is_empty());
    assert_eq!(upsample_band_limited(&[1.0, 2.0], 0), [1.0, 2.0]);
}
