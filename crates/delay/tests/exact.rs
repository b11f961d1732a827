//! Exact delay regression on signals with closed forms.
use greybox_delay::exact::{ExactError, Fit, Gain, Options, Rows, Warning, fit};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

const DT: f64 = 0.01;

/// A signal rich enough to tell delay and gain apart, and its derivative.
fn rich(t: f64) -> (f64, f64) {
    let tones = [(1.0, 1.3), (0.7, 3.1), (0.5, 5.7), (0.2, 9.3)];
    tones.iter().fold((0.0, 0.0), |(x, v), (a, w)| (x + a * (w * t).sin(), v + a * w * (w * t).cos()))
}

struct Made {
    target: Vec<f64>,
    columns: Vec<Vec<f64>>,
    delayed: Vec<f64>,
    places: Vec<usize>,
}

impl Made {
    /// 0.8 x' + 1.5 x + gain x(t − delay) = f, sampled.
    fn new(signal: impl Fn(f64) -> (f64, f64), samples: usize, gain: f64, delay: f64) -> Self {
        let t: Vec<f64> = (0..samples).map(|k| k as f64 * DT).collect();
        let places: Vec<usize> = (0..samples).collect();
        let columns = vec![
            t.iter().map(|&t| signal(t).1).collect(),
            t.iter().map(|&t| signal(t).0).collect::<Vec<f64>>(),
        ];
        let target =
            t.iter().map(|&t| 0.8 * signal(t).1 + 1.5 * signal(t).0 + gain * signal(t - delay).0).collect();
        Self { target, delayed: columns[1].clone(), columns, places }
    }

    fn rows(&self) -> Rows<'_> {
        Rows {
            target: &self.target,
            columns: &self.columns,
            delayed: &self.delayed,
            places: &self.places,
            dt: DT,
        }
    }
}

#[test]
fn a_delay_between_samples_is_found_with_and_without_the_gain() {
    let made = Made::new(rich, 1500, -2.0, 0.2037);
    for gain in [Gain::Known(-2.0), Gain::Free] {
        let fit = fit(&[made.rows()], &Options::new(gain, 0.0, 0.5)).unwrap();
        // The spline's error at 9.3 rad/s and 10 ms is of the order (0.093)^4/384.
        assert!((fit.delay - 0.2037).abs() < 2e-6, "{}", fit.delay);
        assert!((fit.gain + 2.0).abs() < 1e-4, "{}", fit.gain);
        assert!((fit.coefficients[0] - 0.8).abs() < 1e-4 && (fit.coefficients[1] - 1.5).abs() < 1e-4);
        assert!(fit.separability.warnings.is_empty(), "{:?}", fit.separability);
    }
}

#[test]
fn recordings_are_fitted_together() {
    let a = Made::new(rich, 400, -2.0, 0.31);
    let b = Made::new(|t| rich(t + 40.0), 700, -2.0, 0.31);
    let options = Options::new(Gain::Free, 0.1, 0.6);
    let both = fit(&[a.rows(), b.rows()], &options).unwrap();
    assert!((both.delay - 0.31).abs() < 1e-5, "{}", both.delay);
    // 60 rows of each lack the past.
    assert_eq!(both.rows, 400 + 700 - 120);
}

/// Target noise only: the errors of many fits against the covariance they claim.
fn scatter(correlation: f64, lags: usize) -> (f64, f64) {
    let made = Made::new(rich, 900, -2.0, 0.2);
    let normal = Normal::new(0.0, 0.3).expect("valid input");
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    let runs = 200;
    let (mut squares, mut claimed) = (0.0, 0.0);
    for _ in 0..runs {
        let mut noise = 0.0;
        let innovation = (1.0 - correlation * correlation).sqrt();
        let target: Vec<f64> = made
            .target
            .iter()
            .map(|f| {
                noise = correlation * noise + innovation * normal.sample(&mut rng);
                f + noise
            })
            .collect();
        let rows = Rows { target: &target, ..made.rows() };
        let options = Options { correlated_rows: lags, grid: 51, ..Options::new(Gain::Free, 0.0, 0.5) };
        let fit = fit(&[rows], &options).expect("valid input");
        squares += (fit.delay - 0.2).powi(2) / f64::from(runs);
        claimed += fit.delay_std.powi(2) / f64::from(runs);
    }
    (squares.sqrt(), claimed.sqrt())
}

#[test]
fn covariance_is_what_the_estimates_scatter_by() {
    let (scatter_white, claimed) = scatter(0.0, 0);
    assert!((claimed / scatter_white - 1.0).abs() < 0.15, "{claimed} {scatter_white}");
    let (scatter_red, claimed) = scatter(0.9, 60);
    assert!((claimed / scatter_red - 1.0).abs() < 0.25, "{claimed} {scatter_red}");
    // Rows taken as independent claim too much.
    let (_, naive) = scatter(0.9, 0);
    assert!(naive < 0.7 * scatter_red, "{naive} {scatter_red}");
}

#[test]
fn a_single_tone_cannot_tell_gain_delay_and_damping_apart() {
    let tone = |t: f64| ((3.0 * t).sin(), 3.0 * (3.0 * t).cos());
    let made = Made::new(tone, 1500, -2.0, 0.2);
    // x(t − τ) of one tone is a combination of x and x': any delay fits.
    let result = fit(&[made.rows()], &Options::new(Gain::Free, 0.0, 0.5));
    let doubtful = match &result {
        Err(ExactError::NoInformation) => true,
        Ok(fit) => !fit.separability.warnings.is_empty(),
        Err(_) => false,
    };
    assert!(doubtful, "{result:?}");
}

#[test]
fn slow_signals_entangle_gain_and_delay() {
    let slow = |t: f64| {
        let tones = [(1.0, 0.5), (0.7, 0.31), (0.5, 0.83)];
        tones.iter().fold((0.0, 0.0), |(x, v), (a, w)| (x + a * (w * t).sin(), v + a * w * (w * t).cos()))
    };
    let made = Made::new(slow, 3000, -2.0, 0.2);
    let normal = Normal::new(0.0, 0.05).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let target: Vec<f64> = made.target.iter().map(|f| f + normal.sample(&mut rng)).collect();
    let rows = Rows { target: &target, ..made.rows() };
    let entangled =
        |fit: &Fit| fit.separability.warnings.iter().any(|w| matches!(w, Warning::Entangled { .. }));
    let free = fit(&[rows], &Options::new(Gain::Free, 0.0, 0.5)).unwrap();
    assert!(entangled(&free), "{:?}", free.separability);
    assert!(free.separability.inflation > 100.0);
    // Knowing the gain helps, and so does having no noise.
    let known = fit(&[rows], &Options::new(Gain::Known(-2.0), 0.0, 0.5)).unwrap();
    assert!(!entangled(&known) && known.delay_std < 0.5 * free.delay_std, "{known:?}");
    assert!(!entangled(&fit(&[made.rows()], &Options::new(Gain::Free, 0.0, 0.5)).unwrap()));
}

#[test]
fn a_delay_outside_the_range_ends_at_the_edge() {
    let made = Made::new(rich, 1500, -2.0, 0.3);
    let fit = fit(&[made.rows()], &Options::new(Gain::Known(-2.0), 0.0, 0.2)).unwrap();
    assert!(fit.separability.warnings.contains(&Warning::AtEdge { delay: 0.2 }), "{:?}", fit.separability);
}

#[test]
fn bad_input_is_refused() {
    let made = Made::new(rich, 100, -2.0, 0.2);
    let options = Options::new(Gain::Free, 0.0, 0.5);
    let run = |rows: Rows<'_>, options: &Options| -> Result<Fit, ExactError> { fit(&[rows], options) };
    let rows = made.rows();
    assert_eq!(fit(&[], &options).unwrap_err(), ExactError::NoRecording);
    assert!(matches!(run(Rows { dt: 0.0, ..rows }, &options), Err(ExactError::Sampling { .. })));
    assert!(matches!(
        run(Rows { target: &made.target[1..], ..rows }, &options),
        Err(ExactError::Shape { .. })
    ));
    assert!(matches!(
        run(Rows { delayed: &made.delayed[1..], ..rows }, &options),
        Err(ExactError::Place { .. })
    ));
    let backwards: Vec<usize> = made.places.iter().rev().copied().collect();
    let error = run(Rows { places: &backwards, ..rows }, &options).unwrap_err();
    assert_eq!(error, ExactError::Order { recording: 0, row: 1 });
    let mut spoiled = made.target.clone();
    spoiled[3] = f64::NAN;
    let error = run(Rows { target: &spoiled, ..rows }, &options).unwrap_err();
    assert_eq!(error, ExactError::NotFinite { recording: 0, what: "target", row: 3 });
    let reversed = Options { from: 0.5, to: 0.1, ..options };
    assert!(matches!(run(rows, &reversed), Err(ExactError::Range { .. })));
    assert!(matches!(
        run(rows, &Options { gain: Gain::Known(0.0), ..options }),
        Err(ExactError::Gain { .. })
    ));
    let long = Options { to: 0.98, ..options };
    assert!(matches!(run(rows, &long), Err(ExactError::TooFewRows { .. })));
    let twin = vec![made.columns[0].clone(), made.columns[0].clone()];
    let error = run(Rows { columns: &twin, ..rows }, &options).unwrap_err();
    assert_eq!(error, ExactError::Dependent { column: 1 });
    let constant = vec![1.0; 100];
    let error = run(Rows { delayed: &constant, ..rows }, &options).unwrap_err();
    assert_eq!(error, ExactError::NoInformation);
}

#[test]
fn covariance_is_the_newey_west_sandwich() {
    let made = Made::new(rich, 500, -2.0, 0.2);
    let normal = Normal::new(0.0, 0.3).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let target: Vec<f64> = made.target.iter().map(|f| f + normal.sample(&mut rng)).collect();
    let lags = 7;
    let options = Options { correlated_rows: lags, ..Options::new(Gain::Free, 0.0, 0.5) };
    let fit = fit(&[Rows { target: &target, ..made.rows() }], &options).unwrap();
    // Jacobian rows in the order τ, g, c₀, c₁, from the closed form of the signal.
    let first = 50;
    let t = |k: usize| k as f64 * DT;
    let jacobian: Vec<[f64; 4]> = (first..500)
        .map(|k| {
            let (late, slope) = rich(t(k) - fit.delay);
            [-fit.gain * slope, late, rich(t(k)).1, rich(t(k)).0]
        })
        .collect();
    let residual: Vec<f64> = (first..500)
        .map(|k| {
            let [_, late, c0, c1] = jacobian[k - first];
            target[k] - fit.gain * late - fit.coefficients[0] * c0 - fit.coefficients[1] * c1
        })
        .collect();
    let n = jacobian.len();
    let product = |i: usize, j: usize| {
        nalgebra::Vector4::from(jacobian[i])
            * residual[i]
            * residual[j]
            * nalgebra::RowVector4::from(jacobian[j])
    };
    let mut meat = nalgebra::Matrix4::zeros();
    for i in 0..n {
        meat += product(i, i);
        for lag in 1..=lags.min(n - 1 - i) {
            let weight = 1.0 - lag as f64 / (lags as f64 + 1.0);
            meat += (product(i, i + lag) + product(i + lag, i)) * weight;
        }
    }
    let information: nalgebra::Matrix4<f64> =
        jacobian.iter().map(|j| nalgebra::Vector4::from(*j) * nalgebra::RowVector4::from(*j)).sum();
    let bread = information.try_inverse().unwrap();
    let expected = bread * meat * bread * (n as f64 / (n as f64 - 4.0));
    for i in 0..4 {
        for j in 0..4 {
            let scale = (expected[(i, i)] * expected[(j, j)]).sqrt();
            let error = (fit.covariance[i][j] - expected[(i, j)]).abs() / scale;
            assert!(error < 1e-3, "{i} {j}: {} {}", fit.covariance[i][j], expected[(i, j)]);
        }
    }
}

#[test]
fn units_do_not_matter() {
    let made = Made::new(rich, 800, -2.0, 0.2037);
    let normal = Normal::new(0.0, 0.1).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    let target: Vec<f64> = made.target.iter().map(|f| f + normal.sample(&mut rng)).collect();
    let options = Options { correlated_rows: 5, ..Options::new(Gain::Free, 0.0, 0.5) };
    let plain = fit(&[Rows { target: &target, ..made.rows() }], &options).unwrap();
    // Columns in micro- and megaunits, the delayed signal in nanounits, time in milliseconds.
    let scaled = |v: &[f64], by: f64| -> Vec<f64> { v.iter().map(|v| v * by).collect() };
    let columns = vec![scaled(&made.columns[0], 1e6), scaled(&made.columns[1], 1e-6)];
    let (target, delayed) = (scaled(&target, 1e3), scaled(&made.delayed, 1e9));
    let rows = Rows { target: &target, columns: &columns, delayed: &delayed, dt: 1e3 * DT, ..made.rows() };
    let other = fit(&[rows], &Options { to: 500.0, ..options }).unwrap();
    let same = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-9;
    assert!(same(other.delay, 1e3 * plain.delay) && same(other.gain, 1e-6 * plain.gain));
    assert!(same(other.coefficients[0], 1e-3 * plain.coefficients[0]));
    assert!(same(other.coefficients[1], 1e9 * plain.coefficients[1]));
    assert!(same(other.delay_std, 1e3 * plain.delay_std));
    assert!(same(other.separability.inflation, plain.separability.inflation));
    assert!(same(other.separability.condition, plain.separability.condition));
}
