//! A synthetic but realistic page: a rotary flexible link whose hub has Coulomb friction that the nominal
//! model leaves out. The signals are simulated here, the scores computed from them.

use std::f64::consts::TAU;

use greybox_recording::Correlation;
use greybox_report::contract::{
    Alternative, Basis, Criterion, Estimate, Experiment, Finding, Fit, FitSet, InputHold, Interval, Location,
    Mechanism, ModelId, Ordered, Parameter, Producer, RecordingFit, Remainder, Report, Samples, Score,
    Severity, Verdict,
};
use greybox_report::page::{
    Channel, Input, Lagged, MechanismPlot, ModelTexts, Page, Recording, Residual, Role, Spectrum, StateMap,
};

const STEP: f64 = 0.002;
/// Standard deviations of the measurement noise of `theta` and `alpha`, rad.
const NOISE: [f64; 2] = [0.004, 0.0015];
const WINDOW: f64 = 1.0;

const NOMINAL_TOML: &str = r#"name = "Rotary flexible link, linear nominal"

[inputs]
v = { unit = "V" }

[states]
theta = { unit = "rad" }
alpha = { unit = "rad" }

[parameters]
J  = { value = 0.0021, unit = "kg m^2", std = 0.0002 }
B  = { value = 0.015,  unit = "N m s" }
ks = { value = 1.3,    unit = "N m", std = 0.15 }
Jl = { value = 0.0038, unit = "kg m^2", std = 0.0004 }
Bl = { value = 0.003,  unit = "N m s" }
kt = { value = 0.065,  unit = "N m/V", fixed = true }

[equations]
hub  = "J*theta'' + B*theta' - ks*alpha = kt*v"
link = "Jl*(theta'' + alpha'') + Bl*alpha' + ks*alpha = 0"
"#;

const IMPROVED_TOML: &str = r#"name = "Rotary flexible link, linear nominal, improved"

[inputs]
v = { unit = "V" }

[states]
theta = { unit = "rad" }
alpha = { unit = "rad" }

[parameters]
J  = { value = 0.00218, unit = "kg m^2", std = 0.00002 }
B  = { value = 0.0121,  unit = "N m s" }
ks = { value = 1.302,  unit = "N m", std = 0.004 }
Jl = { value = 0.00381, unit = "kg m^2", std = 0.00002 }
Bl = { value = 0.0030,  unit = "N m s" }
kt = { value = 0.065,  unit = "N m/V", fixed = true }
# found by greybox: explains 94 % of the residual, confidence 98 %
fc = { value = 0.0652,  unit = "N m", std = 0.0009 }

[equations]
hub  = "J*theta'' + B*theta' - ks*alpha + fc*sign(theta') = kt*v"
link = "Jl*(theta'' + alpha'') + Bl*alpha' + ks*alpha = 0"
"#;

/// Parameters J, B, ks, Jl, Bl, fc of the simulated link.
type Link = [f64; 6];
const TRUE: Link = [0.0022, 0.012, 1.3, 0.0038, 0.003, 0.065];
const NOMINAL: Link = [0.0021, 0.015, 1.3, 0.0038, 0.003, 0.0];
const CALIBRATED: Link = [0.0024, 0.0391, 1.31, 0.0039, 0.0034, 0.0];
const IMPROVED: Link = [0.00218, 0.0121, 1.302, 0.00381, 0.003, 0.0652];

/// A small linear congruential generator (Knuth, MMIX) with a sum of uniforms as a normal deviate.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        let mut sum = -6.0;
        for _ in 0..12 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            sum += (self.0 >> 11) as f64 / (1u64 << 53) as f64;
        }
        sum
    }
}

/// States [theta, alpha, theta', alpha'] at every step, by Runge–Kutta of fourth order in ten sub-steps, the
/// friction smoothed over 0.01 rad/s.
fn simulate(p: Link, v: &[f64]) -> Vec<[f64; 4]> {
    let [j, b, ks, jl, bl, fc] = p;
    let rate = |x: [f64; 4], v: f64| {
        let torque = 0.065 * v + ks * x[1] - b * x[2] - fc * (x[2] / 0.01).tanh();
        let hub = torque / j;
        [x[2], x[3], hub, -(bl * x[3] + ks * x[1]) / jl - hub]
    };
    let along = |x: [f64; 4], k: [f64; 4], h: f64| std::array::from_fn(|i| x[i] + h * k[i]);
    let mut x = [0.0; 4];
    let mut out = Vec::with_capacity(v.len());
    for &v in v {
        out.push(x);
        let h = STEP / 10.0;
        for _ in 0..10 {
            let k1 = rate(x, v);
            let k2 = rate(along(x, k1, 0.5 * h), v);
            let k3 = rate(along(x, k2, 0.5 * h), v);
            let k4 = rate(along(x, k3, h), v);
            x = std::array::from_fn(|i| x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]));
        }
    }
    out
}

struct Run {
    recording: Recording,
    truth: Vec<[f64; 4]>,
}

fn record(name: &str, role: Role, seconds: f64, phase: f64, noise: &mut Noise) -> Run {
    let n = (seconds / STEP) as usize + 1;
    let t: Vec<f64> = (0..n).map(|i| i as f64 * STEP).collect();
    let voltage = |t: f64| {
        1.9 * (TAU * 0.25 * t + phase).sin()
            + 1.2 * (TAU * 0.83 * t + 2.0 * phase).sin()
            + 0.5 * (TAU * (2.0 + 0.2 * t) * t).sin()
    };
    let v: Vec<f64> = t.iter().map(|&t| voltage(t)).collect();
    let truth = simulate(TRUE, &v);
    let runs = [simulate(NOMINAL, &v), simulate(CALIBRATED, &v), simulate(IMPROVED, &v)];
    let channel = |name: &str, state: usize, noise: &mut Noise| {
        let of = |run: &[[f64; 4]]| run.iter().map(|x| x[state]).collect::<Vec<f64>>();
        Channel {
            name: name.to_owned(),
            unit: "rad".to_owned(),
            measured: truth.iter().map(|x| x[state] + NOISE[state] * noise.next()).collect(),
            nominal: of(&runs[0]),
            calibrated: of(&runs[1]),
            improved: of(&runs[2]),
        }
    };
    let channels = vec![channel("theta", 0, noise), channel("alpha", 1, noise)];
    let inputs = vec![Input { name: "v".to_owned(), unit: "V".to_owned(), values: v }];
    Run {
        recording: Recording { name: name.to_owned(), role, t, holdout_from: None, channels, inputs },
        truth,
    }
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(sum, n), v| (sum + v * v, n + 1.0));
    (sum / n).sqrt()
}

fn spread(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    rms(values.iter().map(|v| v - mean))
}

fn fit_of(recordings: &[&Recording]) -> FitSet {
    let mut set = FitSet::default();
    for recording in recordings {
        for channel in &recording.channels {
            let size = spread(&channel.measured);
            for (scores, simulated, ease) in [
                (&mut set.nominal, &channel.nominal, 0.45),
                (&mut set.calibrated, &channel.calibrated, 0.4),
                (&mut set.improved, &channel.improved, 0.9),
            ] {
                let rmse = rms(simulated.iter().zip(&channel.measured).map(|(s, m)| s - m));
                let score = Score {
                    nrmse: rmse / size,
                    rmse: Some(rmse),
                    nrmse_windowed: Some(ease * rmse / size),
                    rmse_windowed: Some(ease * rmse),
                };
                scores.insert(channel.name.clone(), score);
            }
        }
    }
    set
}

/// Amplitude spectral density by Welch's method: Hann window, half overlap, a plain DFT.
fn density(values: &[f64]) -> Vec<f64> {
    const LENGTH: usize = 2048;
    const BINS: usize = 400;
    let window: Vec<f64> = (0..LENGTH).map(|i| 0.5 - 0.5 * (TAU * i as f64 / LENGTH as f64).cos()).collect();
    let power: f64 = window.iter().map(|w| w * w).sum();
    let mut sum = vec![0.0; BINS];
    let mut count = 0.0;
    for start in (0..values.len().saturating_sub(LENGTH)).step_by(LENGTH / 2) {
        count += 1.0;
        for (bin, total) in sum.iter_mut().enumerate() {
            let (mut re, mut im) = (0.0, 0.0);
            for (i, w) in window.iter().enumerate() {
                let (sin, cos) = (TAU * (bin * i % LENGTH) as f64 / LENGTH as f64).sin_cos();
                re += w * values[start + i] * cos;
                im -= w * values[start + i] * sin;
            }
            *total += 2.0 * (re * re + im * im) * STEP / power;
        }
    }
    sum.into_iter().map(|s| (s / count).sqrt()).collect()
}

/// Windows in which |theta'| stays below the limit.
fn slow_windows(run: &Run, limit: f64) -> Vec<Interval> {
    let mut out: Vec<Interval> = Vec::new();
    for (&t, x) in run.recording.t.iter().zip(&run.truth) {
        if x[2].abs() < limit {
            match out.last_mut() {
                Some(last) if t - last.high < 0.05 => last.high = t,
                _ => out.push(Interval::new(t, t)),
            }
        }
    }
    out.retain(|window| window.high - window.low > 0.06);
    out
}

fn residual(run: &Run, state: usize, windows: &[Interval]) -> Residual {
    let channel = &run.recording.channels[state];
    let minus = |simulated: &[f64]| -> Vec<f64> {
        channel.measured.iter().zip(simulated).map(|(m, s)| m - s).collect()
    };
    let (before, after) = (minus(&channel.calibrated), minus(&channel.improved));
    let noise_density = NOISE[state] * (2.0 * STEP).sqrt();
    let frequencies: Vec<f64> = (0..400).map(|i| i as f64 / (2048.0 * STEP)).collect();
    // The map shows what the hub equation lacks beyond the calibrated viscous term, which has taken over
    // at speed.
    let lacking = |x: &[f64; 4]| 0.065 * (-(x[2] / 2.2).powi(2)).exp() + 0.004;
    Residual {
        recording: run.recording.name.clone(),
        channel: channel.name.clone(),
        unit: channel.unit.clone(),
        t: run.recording.t.clone(),
        noise_sigma: NOISE[state],
        windows: windows.to_vec(),
        spectrum: Some(Spectrum {
            noise: vec![noise_density; frequencies.len()],
            freq: frequencies,
            before: density(&before),
            after: density(&after),
        }),
        map: Some(StateMap {
            x_label: "theta [rad]".to_owned(),
            y_label: "theta' [rad/s]".to_owned(),
            value_label: "lacking torque [N m]".to_owned(),
            x: run.truth.iter().map(|x| x[0]).collect(),
            y: run.truth.iter().map(|x| x[2]).collect(),
            value: run.truth.iter().map(lacking).collect(),
        }),
        correlations: vec![correlation(&before, &after)],
        before,
        after,
    }
}

fn correlation(before: &[f64], after: &[f64]) -> Lagged {
    let reach = 100;
    let [before, after] = [before, after].map(|e| Correlation::of(e, reach).expect("a residual that varies"));
    Lagged {
        with: None,
        lag: (1..=reach).map(|k| k as f64 * STEP).collect(),
        before: before.values[reach + 1..].to_vec(),
        after: after.values[reach + 1..].to_vec(),
        bound: after.bound,
    }
}

fn friction_plot(run: &Run, noise: &mut Noise) -> MechanismPlot {
    let points = run.truth.iter().step_by(4).map(|x| {
        let torque = 0.065 * (x[2] / 0.03).tanh() + 0.007 * noise.next();
        [x[2] + 0.02 * noise.next(), torque]
    });
    MechanismPlot {
        mechanism: Some(0),
        title: "Torque that the hub equation lacks".to_owned(),
        x_label: "theta' [rad/s]".to_owned(),
        y_label: "torque [N m]".to_owned(),
        points: points.collect(),
        curve: vec![[-9.0, -0.0652], [0.0, -0.0652], [0.0, 0.0652], [9.0, 0.0652]],
    }
}

fn map<V>(entries: impl IntoIterator<Item = (&'static str, V)>) -> Ordered<V> {
    entries.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

fn mechanism(windows: Vec<Interval>) -> Mechanism {
    Mechanism {
        kind: "coulomb_friction".to_owned(),
        family: "friction".to_owned(),
        equation: "hub".into(),
        channel: None,
        expression: "fc*sign(theta')".to_owned(),
        replaces: None,
        states: Ordered::new(),
        drifting: None,
        parameters: map([(
            "fc",
            Estimate { value: 0.0652, ci95: Some(Interval::new(0.0634, 0.0670)), unit: "N m".to_owned() },
        )]),
        share_explained: 0.94,
        confidence: 0.98,
        alternatives: vec![
            Alternative {
                kind: "stribeck_friction".to_owned(),
                confidence: 0.11,
                equivalent: false,
                expression: Some("(fc + (fs - fc)*exp(-(theta'/vs)^2))*sign(theta')".to_owned()),
                separate: Some("a slow sweep of v through zero velocity, below 0.1 Hz".to_owned()),
                ..Alternative::default()
            },
            Alternative {
                kind: "presliding_friction".to_owned(),
                confidence: 0.04,
                equivalent: false,
                expression: Some("s0*z".to_owned()),
                separate: Some("small reversals that stay inside the stuck zone".to_owned()),
                ..Alternative::default()
            },
        ],
        experiment: Some(Experiment {
            text:
                "drive v slowly, up to 3.5 V as now, 0.025 to 0.2 Hz, through |θ′| < 0.6: a slow sweep of v \
                   through zero velocity"
                    .to_owned(),
            input: Some("v".to_owned()),
            amplitude: Some(Interval::new(0.0, 3.5)),
            band_hz: Some(Interval::new(0.025, 0.2)),
            variable: Some("theta'".to_owned()),
            range: Some([Some(-0.6), Some(0.6)]),
        }),
        location: Location {
            equation: Some("hub".into()),
            windows_s: map([("train.csv", windows)]),
            region: map([("theta'", [Some(-0.6), Some(0.6)])]),
            band_hz: Some(Interval::new(0.1, 2.0)),
            ..Location::default()
        },
    }
}

fn parameters() -> Ordered<Parameter> {
    let rows = [
        ("J", 0, "kg m^2", 0.00005, 0.000_04),
        ("B", 1, "N m s", 0.0009, 0.0004),
        ("ks", 2, "N m", 0.02, 0.008),
        ("Jl", 3, "kg m^2", 0.00006, 0.000_03),
        ("Bl", 4, "N m s", 0.0003, 0.0001),
    ];
    let mut out: Ordered<Parameter> = rows
        .into_iter()
        .map(|(name, at, unit, before, after)| {
            let around = |value: f64, half: f64| Some(Interval::new(value - half, value + half));
            let parameter = Parameter {
                nominal: NOMINAL[at],
                value: IMPROVED[at],
                ci95: around(IMPROVED[at], after),
                unit: Some(unit.to_owned()),
                fixed: false,
                calibrated: Some(CALIBRATED[at]),
                calibrated_ci95: around(CALIBRATED[at], before),
            };
            (name.to_owned(), parameter)
        })
        .collect();
    let fixed = Parameter {
        nominal: 0.065,
        value: 0.065,
        ci95: None,
        unit: Some("N m/V".to_owned()),
        fixed: true,
        calibrated: None,
        calibrated_ci95: None,
    };
    out.insert("kt".to_owned(), fixed);
    out
}

fn findings() -> Vec<Finding> {
    vec![
        Finding {
            severity: Severity::Info,
            code: "quantisation".to_owned(),
            recording: Some("train.csv".to_owned()),
            channel: Some("theta".to_owned()),
            message: "Steps of 0.00153 rad: an encoder of 4096 counts per turn.".to_owned(),
            help: None,
        },
        Finding {
            severity: Severity::Warning,
            code: "excitation".to_owned(),
            recording: Some("train.csv".to_owned()),
            channel: Some("v".to_owned()),
            message: "Little power above 6 Hz: the link's damping rests on few cycles.".to_owned(),
            help: Some("add a sweep up to 15 Hz to the input".to_owned()),
        },
    ]
}

/// The page of the rotary link.
pub(crate) fn page() -> Page {
    let mut noise = Noise(7);
    let train = record("train.csv", Role::Train, 20.0, 0.3, &mut noise);
    let test = record("test.csv", Role::Holdout, 12.0, 1.7, &mut noise);
    let windows = slow_windows(&train, 0.6);
    let (train_fit, test_fit) = (fit_of(&[&train.recording]), fit_of(&[&test.recording]));
    let floor = |state: usize| NOISE[state] / spread(&train.recording.channels[state].measured);
    let mut report = Report {
        greybox: Producer::this(1),
        model: ModelId {
            name: "Rotary flexible link, linear nominal".to_owned(),
            file: "link.toml".to_owned(),
        },
        samples: Samples { train: train.recording.t.len(), holdout: test.recording.t.len() },
        verdict: Verdict::MissingPhysics,
        summary: Vec::new(),
        terms_only: false,
        basis: Basis::Named,
        mechanisms: vec![mechanism(windows.clone())],
        candidates: Vec::new(),
        closure: None,
        closure_rejected: None,
        subsets: Vec::new(),
        remainder: Remainder {
            significant: false,
            location: Location::default(),
            share_of_residual: 0.03,
            experiment: None,
            experiment_plan: None,
        },
        parameters: parameters(),
        fit: Fit {
            train: train_fit.clone(),
            holdout: test_fit.clone(),
            window_s: Some(WINDOW),
            criterion: Criterion::FreeRun,
            holdout_source: "test.csv, a recording of its own".to_owned(),
            recordings: map([
                ("train.csv", RecordingFit { train: Some(train_fit), holdout: None }),
                ("test.csv", RecordingFit { train: None, holdout: Some(test_fit) }),
            ]),
        },
        noise_floor: map([("theta", floor(0)), ("alpha", floor(1))]),
        inputs: map([("v", InputHold { hold_given: "linear".to_owned(), hold_best: "linear".to_owned() })]),
        findings: findings(),
    };
    report.summary = greybox_report::sentence::summary(&report);
    Page {
        title: "Rotary flexible link".to_owned(),
        report,
        residuals: vec![residual(&train, 0, &windows), residual(&train, 1, &windows)],
        mechanism_plots: vec![friction_plot(&train, &mut noise)],
        recordings: vec![test.recording, train.recording],
        models: ModelTexts { nominal: NOMINAL_TOML.to_owned(), improved: IMPROVED_TOML.to_owned() },
    }
}
