//! Each health check fires on its fault and stays silent on a sound recording.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use greybox_recording::health::{check, clock_offsets};
use greybox_recording::{Channel, Finding, Recording, Severity};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::PI;

const DT: f64 = 0.01;
const N: usize = 4000;

fn white(seed: u64, sigma: f64) -> Vec<f64> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let normal = Normal::new(0.0, sigma).unwrap();
    (0..N).map(|_| normal.sample(&mut rng)).collect()
}

/// Eight sines between 0.3 and 5 Hz.
fn multisine() -> Vec<f64> {
    (0..N)
        .map(|k| {
            let t = DT * k as f64;
            (1..=8).map(|h| (2.0 * PI * 0.61 * f64::from(h) * t + f64::from(h * h)).sin()).sum()
        })
        .collect()
}

fn recording(columns: &[(&str, Vec<f64>)]) -> Recording {
    let time = (0..N).map(|k| DT * k as f64).collect();
    let channels = columns
        .iter()
        .map(|(name, values)| Channel {
            name: (*name).to_owned(),
            unit: Some("V".to_owned()),
            values: values.clone(),
        })
        .collect();
    Recording::from_columns("r.csv", time, channels).unwrap()
}

fn find<'a>(findings: &'a [Finding], code: &str) -> Option<&'a Finding> {
    findings.iter().find(|f| f.code == code)
}

/// The finding of one output channel under one check.
fn of_output(values: Vec<f64>, code: &str) -> Option<Finding> {
    let findings = check(&recording(&[("y", values)]), &[], &["y"]);
    find(&findings, code).cloned()
}

fn noisy_multisine() -> Vec<f64> {
    multisine().iter().zip(white(1, 0.01)).map(|(a, b)| a + b).collect()
}

#[test]
fn a_sound_recording_has_nothing_worse_than_information() {
    let findings = check(&recording(&[("u", multisine()), ("y", noisy_multisine())]), &["u"], &["y"]);
    for finding in &findings {
        assert_eq!(finding.severity, Severity::Info, "{finding}");
    }
    let rate = find(&findings, "sampling").unwrap();
    assert!((rate.value.unwrap() - 100.0).abs() < 1e-6 && rate.unit.as_deref() == Some("Hz"));
    let noise = find(&findings, "noise").unwrap();
    assert!((noise.value.unwrap() / 0.01 - 1.0).abs() < 0.08, "{noise}");
    let excitation = find(&findings, "excitation").unwrap();
    assert_eq!(excitation.value, Some(8.0), "{excitation}");
    assert!(excitation.message.contains("about 8 sines"));
}

#[test]
fn channels_without_a_role_are_checked_too() {
    let findings = check(&recording(&[("a", multisine()), ("b", vec![2.0; N])]), &[], &[]);
    let flat = find(&findings, "flat").unwrap();
    assert_eq!((flat.severity, flat.channel.as_deref()), (Severity::Warning, Some("b")));
    assert!(findings.iter().any(|f| f.channel.as_deref() == Some("a")));
}

#[test]
fn a_name_that_is_not_there_is_a_problem() {
    let findings = check(&recording(&[("y", multisine())]), &["torque"], &["y"]);
    let unknown = find(&findings, "unknown_channel").unwrap();
    assert_eq!((unknown.severity, unknown.channel.as_deref()), (Severity::Problem, Some("torque")));
    assert!(unknown.help.as_deref().unwrap().contains('y'));
}

#[test]
fn clipping_is_told_from_turning_points_switches_staircases_and_encoders() {
    let clipped: Vec<f64> = multisine().iter().map(|v| v.min(2.5)).collect();
    let finding = of_output(clipped.clone(), "clipping").expect("clipped");
    assert!(
        finding.severity == Severity::Warning
            && finding.value == Some(2.5)
            && finding.message.contains("largest")
    );
    let coarse = |y: Vec<f64>, q: f64| y.iter().map(|v| (v / q).round() * q).collect::<Vec<_>>();
    assert!(of_output(coarse(clipped, 0.1), "clipping").is_some(), "clipped and quantised");

    let slow_sine: Vec<f64> = (0..N).map(|k| (2.0 * PI * 0.2 * DT * k as f64).sin()).collect();
    let mut staircase = white(7, 1.0);
    for k in 0..N {
        staircase[k] = staircase[k - k % 40];
    }
    let switch: Vec<f64> = (0..N).map(|k| if k % 200 < 100 { 1.0 } else { 5.0 }).collect();
    let printed = coarse(slow_sine.clone(), 1e-4);
    let sound = [
        multisine(),
        coarse(multisine(), 0.1),
        coarse(slow_sine.clone(), 0.02),
        slow_sine,
        printed,
        white(3, 1.0),
        coarse(white(3, 1.0), 0.2),
        staircase,
        switch,
    ];
    for (case, y) in sound.into_iter().enumerate() {
        let finding = of_output(y, "clipping");
        assert!(finding.is_none(), "case {case}: {}", finding.unwrap());
    }
}

#[test]
fn coarse_quantisation_is_a_warning_and_fine_one_is_not_mentioned() {
    let coarse: Vec<f64> = multisine().iter().map(|v| (v / 0.5).round() * 0.5).collect();
    let finding = of_output(coarse, "quantisation").expect("quantised");
    assert!(
        finding.severity == Severity::Warning && (finding.value.unwrap() - 0.5).abs() < 1e-9,
        "{finding}"
    );
    let drowned: Vec<f64> = noisy_multisine().iter().map(|v| (v / 1e-3).round() * 1e-3).collect();
    assert_eq!(of_output(drowned, "quantisation"), None);
}

#[test]
fn levels_that_were_commanded_are_no_quantisation() {
    // Every half second another of whole volts; as a sensor's reading it would be coarse.
    let levels = [1.0, -2.0, 3.0, 2.0, -3.0, 1.0, -1.0];
    let steps: Vec<f64> = (0..N).map(|k| levels[(k / 50) % levels.len()]).collect();
    let both = recording(&[("u", steps.clone())]);
    assert_eq!(find(&check(&both, &["u"], &[]), "quantisation"), None);
    assert_eq!(find(&check(&both, &[], &[]), "quantisation"), None);
    assert!(of_output(steps, "quantisation").is_some());
    // A slow command through a coarse converter goes from one step to the next.
    let coarse: Vec<f64> =
        (0..N).map(|k| ((2.0 * PI * 0.05 * DT * k as f64).sin() / 0.1).round() * 0.1).collect();
    let input = check(&recording(&[("u", coarse)]), &["u"], &[]);
    assert_eq!(find(&input, "quantisation").unwrap().severity, Severity::Warning);
}

#[test]
fn spikes_are_counted_and_steps_are_not() {
    let mut y = noisy_multisine();
    y[1234] += 0.5;
    y[3000] -= 0.7;
    let finding = of_output(y, "outliers").expect("two spikes");
    assert_eq!(finding.value, Some(2.0));
    assert!(finding.message.contains("t = 12.34 s"), "{finding}");
    let mut step = noisy_multisine();
    step[2000..].iter_mut().for_each(|v| *v += 3.0);
    assert_eq!(of_output(step, "outliers"), None);
}

/// The outliers found in a channel of this role, by their number.
fn outliers(y: Vec<f64>, input: bool) -> usize {
    let recording = recording(&[("y", y)]);
    let findings = if input { check(&recording, &["y"], &[]) } else { check(&recording, &[], &["y"]) };
    find(&findings, "outliers").map_or(0, |finding| finding.value.unwrap() as usize)
}

/// Sine of 0.2 Hz at a phase of its own.
fn slow(seed: u64) -> impl Fn(usize) -> f64 {
    move |k| (2.0 * PI * 0.2 * DT * k as f64 + seed as f64).sin()
}

fn rounded(v: f64, q: f64) -> f64 {
    (v / q).round() * q
}

const SEEDS: u64 = 100;

#[test]
fn spikes_of_ten_noise_deviations_are_found() {
    // Noise, the step to which it is rounded, a rail, size of the spikes.
    for (sigma, q, rail, size) in [
        (0.0_f64, 0.0, f64::INFINITY, 0.2),
        (0.02, 0.0, f64::INFINITY, 0.2),
        (0.2, 0.0, f64::INFINITY, 2.0),
        (0.0, 0.01, f64::INFINITY, 0.2),
        (0.02, 0.01, f64::INFINITY, 0.25),
        (0.02, 0.0, 0.8, 0.2),
    ] {
        let (mut found, mut more) = (0, 0);
        for seed in 0..SEEDS {
            let (slow, noise) = (slow(seed), white(seed, sigma.max(1e-12)));
            let mut y: Vec<f64> = (0..N).map(|k| slow(k) + noise[k]).collect();
            // Half-way down a flank, far from a rail.
            let at =
                (500..N - 500).find(|&k| slow(k) > 0.1 && slow(k + 1) < slow(k) && slow(k) < 0.15).unwrap();
            y[at] += if seed % 2 == 0 { size } else { -size };
            y[at + 20] += size;
            let y = y.iter().map(|v| if q > 0.0 { rounded(*v, q) } else { *v }.min(rail)).collect();
            let count = outliers(y, false);
            found += count.min(2);
            more += usize::from(count > 2);
        }
        assert!(
            found >= 190 && more <= 2,
            "noise {sigma}, step {q}, rail {rail}: {found} found, {more} more"
        );
    }
}

#[test]
fn quantised_saturated_and_stepped_signals_have_no_outliers() {
    type Signal = fn(u64, &[f64]) -> Vec<f64>;
    let commanded = |noise: &[f64]| {
        let mut level = 0.0;
        let step = |w: &f64| {
            if w.abs() < 0.03 {
                level = 0.1 * (1e4 * w).rem_euclid(20.0).floor();
            }
            level
        };
        noise.iter().map(step).collect::<Vec<f64>>()
    };
    let cases: [(&str, bool, Signal); 8] = [
        ("an encoder", false, |seed, _| (0..N).map(|k| rounded(slow(seed)(k), 0.02)).collect()),
        ("a coarse sensor with noise", false, |seed, w| {
            (0..N).map(|k| rounded(slow(seed)(k) + 0.02 * w[k], 0.05)).collect()
        }),
        ("a slow throttle of few levels", true, |seed, _| {
            (0..N).map(|k| rounded(0.1 + 0.09 * slow(seed)(k / 4), 0.005)).collect()
        }),
        ("a saturated signal", false, |seed, _| (0..N).map(|k| (2.0 * slow(seed)(k)).min(1.2)).collect()),
        ("a saturated signal with noise", false, |seed, w| {
            (0..N).map(|k| (2.0 * slow(seed)(k) + 0.05 * w[k]).clamp(-1.0, 1.2)).collect()
        }),
        ("a square wave with noise", false, |seed, w| {
            (0..N).map(|k| slow(seed)(k).signum() + 0.01 * w[k]).collect()
        }),
        ("a binary excitation", true, |seed, w| {
            let bits = white(seed + 1000, 1.0);
            (0..N).map(|k| bits[k / 5].signum() + 0.01 * w[k]).collect()
        }),
        ("corners", false, |seed, w| (0..N).map(|k| slow(seed)(k).abs() + 0.002 * w[k]).collect()),
    ];
    for (name, input, signal) in cases {
        let alarms = (0..SEEDS).filter(|&seed| outliers(signal(seed, &white(seed, 1.0)), input) > 0).count();
        assert!(alarms <= 2, "{name}: an alarm in {alarms} recordings");
    }
    // Commanded levels, some for one sample only.
    let alarms = (0..SEEDS).filter(|&seed| outliers(commanded(&white(seed, 1.0)), true) > 0).count();
    assert!(alarms <= 2, "commanded levels: an alarm in {alarms} recordings");
}

#[test]
fn missing_and_flat_channels_are_reported() {
    let mut y = noisy_multisine();
    y[100..200].fill(f64::NAN);
    let some = of_output(y, "missing").unwrap();
    assert_eq!((some.severity, some.value), (Severity::Info, Some(100.0)));
    assert!(some.message.contains("t = 1 s"), "{some}");
    let none = of_output(vec![f64::NAN; N], "missing").unwrap();
    assert_eq!(none.severity, Severity::Problem);
    assert_eq!(of_output(vec![0.0; N], "flat").unwrap().severity, Severity::Problem);
}

#[test]
fn poor_excitation_is_named() {
    let input = |u: Vec<f64>| {
        let findings = check(&recording(&[("u", u), ("y", noisy_multisine())]), &["u"], &["y"]);
        find(&findings, "excitation").unwrap().clone()
    };
    let constant = input(vec![1.5; N]);
    assert!(
        constant.severity == Severity::Warning && constant.message.contains("constant (1.5 V)"),
        "{constant}"
    );
    // Beside an input that moves it is a known constant.
    let run = recording(&[("u", white(4, 2.0)), ("V", vec![7.4; N]), ("y", noisy_multisine())]);
    let findings = check(&run, &["u", "V"], &["y"]);
    let of_supply: Vec<&Finding> = findings.iter().filter(|f| f.channel.as_deref() == Some("V")).collect();
    assert_eq!(
        (of_supply.len(), of_supply[0].code, of_supply[0].severity),
        (1, "constant_input", Severity::Info)
    );
    let sine = input((0..N).map(|k| (2.0 * PI * 1.7 * DT * k as f64).sin()).collect());
    assert!(sine.severity == Severity::Warning && sine.message.contains("single sine of 1.7 Hz"), "{sine}");
    let sweep = input((0..N).map(|k| (2.0 * PI * 0.05 * (DT * k as f64).powi(2)).sin()).collect());
    assert!(sweep.severity == Severity::Info, "{sweep}");
    let random = input(white(4, 2.0));
    assert!(random.severity == Severity::Info && random.value.unwrap() > 100.0, "{random}");
}

#[test]
fn slow_and_fast_content_is_named() {
    let drift: Vec<f64> = (0..N).map(|k| k as f64).collect();
    let finding = of_output(drift, "record_length").expect("a drift");
    assert!(finding.message.contains("travels once"), "{finding}");
    let fast: Vec<f64> = (0..N).map(|k| (2.0 * PI * 31.0 * DT * k as f64).sin()).collect();
    let finding = of_output(fast, "bandwidth").expect("three samples per period");
    assert!((finding.value.unwrap() - 100.0 / 31.0).abs() < 0.05, "{finding}");
}

#[test]
fn heavy_noise_is_a_warning_and_fast_motion_is_not_called_noise() {
    let heavy: Vec<f64> = multisine().iter().zip(white(8, 1.0)).map(|(a, b)| a + b).collect();
    let finding = of_output(heavy, "noise").unwrap();
    assert!(
        finding.severity == Severity::Warning && (finding.value.unwrap() - 1.0).abs() < 0.08,
        "{finding}"
    );
    let fast: Vec<f64> = (0..N).map(|k| (2.0 * PI * 0.11 * k as f64).sin()).collect();
    let fast = fast.iter().zip(white(8, 1e-3)).map(|(a, b)| a + b).collect();
    let finding = of_output(fast, "noise").unwrap();
    assert!(finding.message.contains("at most") && finding.message.contains("floor"), "{finding}");
}

/// A damped oscillator driven by white noise, its position delayed by `delay` samples, with noise on top.
fn driven(u: &[f64], delay: usize, sigma: f64) -> Vec<f64> {
    let (omega, zeta, sub) = (2.0 * PI * 2.0, 0.1, 20);
    let (mut q, mut v) = (0.0, 0.0);
    let mut y = vec![0.0; N];
    for k in 0..N {
        y[k] = q;
        for _ in 0..sub {
            v += DT / f64::from(sub) * (u[k] - 2.0 * zeta * omega * v - omega * omega * q);
            q += DT / f64::from(sub) * v;
        }
    }
    let noise = white(99, sigma);
    (0..N).map(|k| if k >= delay { y[k - delay] } else { 0.0 } + noise[k]).collect()
}

#[test]
fn the_delay_is_found_through_the_dynamics() {
    let u = white(12, 1.0);
    for delay in [0usize, 7, 40] {
        let y = driven(&u, delay, 1e-6);
        let findings = check(&recording(&[("u", u.clone()), ("y", y)]), &["u"], &["y"]);
        let finding = find(&findings, "delay").expect("a clear correlation");
        // The position answers a held force one sample later, with half of it two samples later.
        let expected = DT * (delay as f64 + 1.0);
        assert!((finding.value.unwrap() - expected).abs() < 1.1 * DT, "{finding}");
        assert_eq!(finding.unit.as_deref(), Some("s"));
    }
    let unrelated = check(&recording(&[("u", u), ("y", white(13, 1.0))]), &["u"], &["y"]);
    assert!(find(&unrelated, "delay").is_none());
}

/// A first-order lag driven by `u`.
fn lagged(u: &[f64]) -> Vec<f64> {
    let mut x = 0.0;
    u.iter()
        .map(|u| {
            x += 0.2 * (u - x);
            x
        })
        .collect()
}

/// `y` as a logger has it that is `samples` behind.
fn late(y: &[f64], samples: usize) -> Vec<f64> {
    (0..y.len()).map(|k| if k >= samples { y[k - samples] } else { y[0] }).collect()
}

#[test]
fn a_clock_that_is_behind_is_found() {
    let u = white(12, 1.0);
    let (y, z) = (driven(&u, 0, 1e-6), lagged(&u));
    let found = |u: &[f64], y: &[f64], z: &[f64], roles: bool| {
        let recording = recording(&[("u", u.to_vec()), ("y", y.to_vec()), ("z", z.to_vec())]);
        let (inputs, outputs): (&[&str], &[&str]) = if roles { (&["u"], &["y", "z"]) } else { (&[], &[]) };
        clock_offsets(&recording, inputs, outputs)
    };
    for roles in [true, false] {
        for (channel, samples, findings) in [
            ("y", 9, found(&u, &late(&y, 9), &z, roles)),
            ("z", 30, found(&u, &y, &late(&z, 30), roles)),
            ("u", 12, found(&late(&u, 12), &y, &z, roles)),
        ] {
            assert_eq!(findings.len(), 1, "{channel}, {roles}: {findings:?}");
            let finding = &findings[0];
            assert_eq!((finding.code, finding.channel.as_deref()), ("clock_offset", Some(channel)));
            assert_eq!(finding.severity, if roles { Severity::Warning } else { Severity::Info });
            assert!((finding.value.unwrap() / DT - f64::from(samples)).abs() < 2.1, "{finding}");
            assert!(finding.message.contains("The lag is sure: 8 of 8 parts"), "{finding}");
            // The plant's own answer hides a part of what its input is late.
            let acausal = roles && channel == "u";
            assert_eq!(finding.message.contains("Recorded at least"), acausal, "{finding}");
        }
        assert_eq!(found(&u, &y, &z, roles), [], "clocks that agree");
        assert_eq!(found(&u, &white(13, 1.0), &white(14, 1.0), roles), [], "nothing in common");
        let wave = |shift: f64| -> Vec<f64> { (0..N).map(|k| (0.1 * (k as f64 - shift)).sin()).collect() };
        assert_eq!(found(&wave(0.0), &wave(9.0), &wave(17.0), roles), [], "a sine tells no delay");
    }
    // Noise that hides the lag in the single samples leaves it in averages: the damped positions are slow.
    let noisy =
        |y: &[f64], seed: u64| -> Vec<f64> { y.iter().zip(white(seed, 2e-4)).map(|(y, e)| y + e).collect() };
    let slow = |y: &[f64]| lagged(&lagged(y));
    let (p, q) = (
        noisy(&driven(&u, 0, 1e-6), 21),
        noisy(&slow(&slow(&u)).iter().map(|z| 0.02 * z).collect::<Vec<_>>(), 22),
    );
    let findings = found(&u, &late(&p, 16), &q, true);
    assert_eq!(findings.len(), 1, "{findings:?}");
    assert_eq!(findings[0].channel.as_deref(), Some("y"));
    assert!((findings[0].value.unwrap() / DT - 16.0).abs() < 4.1, "{}", findings[0]);
    assert_eq!(found(&u, &p, &q, true), []);
    // Behind for half of the recording is no clock's offset.
    let half: Vec<f64> = late(&y, 9)[..N / 2].iter().chain(&y[N / 2..]).copied().collect();
    assert_eq!(found(&u, &half, &z, true), []);
}
