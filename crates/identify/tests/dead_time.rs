//! Dead times of inputs: found with the equation, told where they cannot be found.

use greybox_identify::{
    DeadTime, DelayedState, FoundDeadTime, Identification, IdentifyError, Library, Options, Quiet, identify,
    identify_blocks,
};
use greybox_model::Hold;
use greybox_recording::{Channel, Recording};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;

const STEP: f64 = 0.01;
/// Samples for which a machine moves before its recording.
const LEAD: usize = 200;
const TENTHS: usize = 10;

/// A recording of ẋ = rates(x, u), the inputs u as many tenths of a sample late as stated; channels u0, u1 … and x0 … with
/// a noise of `noise` of what they move. RK4 in tenths of a sample, so that no step crosses a bend or a jump.
fn record(
    seed: u64,
    (samples, hold, noise): (usize, Hold, f64),
    late: &[usize],
    (order, measured): (usize, usize),
    rates: impl Fn(&[f64], &[f64]) -> Vec<f64>,
) -> Recording {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let inputs: Vec<Vec<f64>> = late
        .iter()
        .map(|_| {
            let sines: Vec<(f64, f64)> = (0..8)
                .map(|i| {
                    (2.0 * 8.0_f64.powf(f64::from(i) / 7.0), random.random_range(0.0..std::f64::consts::TAU))
                })
                .collect();
            let at = |t: f64| sines.iter().map(|(w, phase)| (w * t + phase).sin()).sum::<f64>();
            (0..LEAD + samples).map(|k| at(k as f64 * STEP)).collect()
        })
        .collect();
    let h = STEP / TENTHS as f64;
    let mut x = vec![0.0; order];
    let mut y = vec![Vec::new(); measured];
    for k in 0..LEAD + samples {
        y.iter_mut().zip(&x).for_each(|(y, x)| y.push(*x));
        for s in 0..TENTHS {
            let drive = |w: f64| -> Vec<f64> {
                let one = |(u, late): (&Vec<f64>, &usize)| {
                    let tenths = (k * TENTHS + s).saturating_sub(*late);
                    let (k, s) = (tenths / TENTHS, tenths % TENTHS);
                    let share = if hold == Hold::Zero { 0.0 } else { (s as f64 + w) / TENTHS as f64 };
                    u[k] + share * (u[(k + 1).min(u.len() - 1)] - u[k])
                };
                inputs.iter().zip(late).map(one).collect()
            };
            let moved =
                |r: &[f64], w: f64| -> Vec<f64> { x.iter().zip(r).map(|(x, r)| x + w * h * r).collect() };
            let a = rates(&x, &drive(0.0));
            let b = rates(&moved(&a, 0.5), &drive(0.5));
            let c = rates(&moved(&b, 0.5), &drive(0.5));
            let d = rates(&moved(&c, 1.0), &drive(1.0));
            x.iter_mut().enumerate().for_each(|(i, x)| *x += h / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i]));
        }
    }
    let channel = |name: String, values| Channel { name, unit: None, values };
    let mut channels: Vec<Channel> = Vec::new();
    for (i, u) in inputs.iter().enumerate() {
        channels.push(channel(format!("u{i}"), u[LEAD..].to_vec()));
    }
    for (i, y) in y.iter().enumerate() {
        let y = &y[LEAD..];
        let spread = (y.iter().map(|v| v * v).sum::<f64>() / y.len() as f64).sqrt();
        let normal = Normal::new(0.0, noise * spread).unwrap();
        let noisy = y.iter().map(|v| v + normal.sample(&mut random)).collect();
        channels.push(channel(format!("x{i}"), noisy));
    }
    let time = (0..samples).map(|k| k as f64 * STEP).collect();
    Recording::from_columns("run.csv", time, channels).unwrap()
}

/// 1.2 ẍ + 1.5 ẋ + 40 x = u, the input late.
fn oscillator(seed: u64, settings: (usize, Hold, f64), late: usize) -> Recording {
    record(seed, settings, &[late], (2, 1), |x, u| vec![x[1], (u[0] - 1.5 * x[1] - 40.0 * x[0]) / 1.2])
}

fn asked(states: &[&str], inputs: &[&str], longest: &[Option<f64>], hold: Hold) -> Options {
    let dead_times = inputs
        .iter()
        .zip(longest)
        .map(|(input, longest)| DeadTime { input: (*input).to_string(), longest: *longest })
        .collect();
    Options { order: 3, hold: Some(hold), replicates: 0, dead_times, ..Options::new(states, inputs) }
}

fn run(recordings: &[Recording], options: &Options) -> Identification {
    identify(recordings, recordings, options, &Quiet).unwrap()
}

fn only(found: &Identification) -> &FoundDeadTime {
    let [one] = &found.dead_times[..] else { panic!("{:?}", found.dead_times) };
    one
}

fn expressions(found: &Identification, equation: usize) -> Vec<&str> {
    found.equations[equation].terms.iter().map(|t| t.expression.as_str()).collect()
}

#[test]
fn without_noise_the_dead_time_is_that_of_the_machine_in_both_holds() {
    for hold in [Hold::Linear, Hold::Zero] {
        let data = [oscillator(1, (2000, hold, 0.0), 73)];
        let found = run(&data, &asked(&["x0"], &["u0"], &[Some(0.3)], hold));
        let dead_time = only(&found);
        let error = dead_time.value / STEP - 7.3;
        assert!(error.abs() < 2e-3, "{hold:?}: {error} samples");
        assert_eq!(expressions(&found, 0).len(), 3, "{hold:?}: {:?}", expressions(&found, 0));
        let written = found.model.to_toml(&Default::default());
        assert!(written.contains("delay(u0, tau_u0)"), "{written}");
        assert!(found.misfit.iter().all(|m| m.is_finite()));
    }
}

#[test]
fn two_inputs_have_dead_times_of_their_own_over_several_files() {
    // Two carts, each with its own force, joined by a spring.
    let make = |seed| {
        record(seed, (1500, Hold::Linear, 0.01), &[34, 118], (4, 2), |x, u| {
            let between = 30.0 * (x[1] - x[0]);
            vec![x[2], x[3], u[0] - 20.0 * x[0] + between - x[2], u[1] - 20.0 * x[1] - between - x[3]]
        })
    };
    let data = [make(2), make(3)];
    let options = asked(&["x0", "x1"], &["u0", "u1"], &[None, Some(0.25)], Hold::Linear);
    let found = identify(&data, &[make(4)], &options, &Quiet).unwrap();
    assert_eq!(found.dead_times.len(), 2);
    for (dead_time, truth) in found.dead_times.iter().zip([3.4, 11.8]) {
        let (low, high) = dead_time.ci95.unwrap();
        let error = dead_time.value / STEP - truth;
        // The interval is about two standard errors to either side; four never miss.
        assert!(error.abs() < (high - low) / STEP && (high - low) / STEP < 0.5, "{error}: {low} … {high}");
    }
    let inputs: Vec<_> = found.equations.iter().map(|e| e.input.as_deref()).collect();
    assert_eq!(inputs, [Some("u0"), Some("u1")]);
    assert!(found.holdout.unwrap().scores.iter().all(|s| s.nrmse < 0.05));
}

#[test]
fn an_input_without_a_dead_time_has_an_interval_that_holds_zero() {
    let data = [oscillator(5, (2000, Hold::Linear, 0.01), 0)];
    let found = run(&data, &asked(&["x0"], &["u0"], &[None], Hold::Linear));
    let (low, high) = only(&found).ci95.unwrap();
    assert!(low == 0.0 && high > 0.0 && high < STEP, "{low} … {high}");
    assert!(only(&found).longest > 10.0 * STEP, "{}", only(&found).longest);
}

#[test]
fn a_dead_time_beyond_the_longest_looked_for_ends_there_and_has_no_interval() {
    let data = [oscillator(6, (2000, Hold::Linear, 0.01), 150)];
    let found = run(&data, &asked(&["x0"], &["u0"], &[Some(0.1)], Hold::Linear));
    let dead_time = only(&found);
    assert!(dead_time.is_at_longest() && dead_time.ci95.is_none(), "{dead_time:?}");
    let enough = run(&data, &asked(&["x0"], &["u0"], &[Some(0.2)], Hold::Linear));
    assert!((only(&enough).value / STEP - 15.0).abs() < 0.5 && only(&enough).ci95.is_some());
}

#[test]
fn an_input_that_acts_on_nothing_has_no_dead_time_and_one_in_a_product_has() {
    // ẋ = −2 x + u₀ + 0.8 x u₀; u₁ does nothing.
    let data = [record(7, (3000, Hold::Zero, 0.005), &[46, 0], (1, 1), |x, u| {
        vec![-2.0 * x[0] + u[0] + 0.8 * x[0] * u[0]]
    })];
    let wanted = asked(&["x0"], &["u0", "u1"], &[Some(0.2), Some(0.2)], Hold::Zero);
    let library = Library { terms: vec!["x0*u0".to_string()], ..wanted.library.clone() };
    let found = run(&data, &Options { derivatives: vec![1], order: 2, library, ..wanted });
    assert_eq!(found.without_effect, ["u1"]);
    assert!((only(&found).value / STEP - 4.6).abs() < 0.2, "{:?}", only(&found));
    assert!(expressions(&found, 0).contains(&"(x0*delay(u0, tau_u0))"), "{:?}", expressions(&found, 0));
}

#[test]
fn a_piece_as_short_as_the_dead_time_is_left_out() {
    let long = oscillator(8, (2000, Hold::Linear, 0.01), 73);
    let short = oscillator(9, (25, Hold::Linear, 0.01), 73);
    let found = run(&[short, long], &asked(&["x0"], &["u0"], &[Some(0.3)], Hold::Linear));
    assert!((only(&found).value / STEP - 7.3).abs() < 0.5, "{:?}", only(&found));
}

#[test]
fn wrong_requests_name_the_help() {
    let data = [oscillator(1, (500, Hold::Linear, 0.01), 0)];
    let error = |options: &Options| identify(&data, &data, options, &Quiet).unwrap_err();
    let ask = |input: &str, longest: Option<f64>| Options {
        dead_times: vec![DeadTime { input: input.to_string(), longest }],
        ..asked(&["x0"], &["u0"], &[], Hold::Linear)
    };
    assert!(matches!(error(&ask("u9", None)), IdentifyError::LateInput { .. }));
    assert!(matches!(error(&ask("x0", None)), IdentifyError::LateInput { .. }));
    for longest in [-0.1, 0.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(error(&ask("u0", Some(longest))), IdentifyError::Range { .. }), "{longest}");
    }
    assert!(matches!(error(&ask("u0", Some(5.0))), IdentifyError::LongestDelay { .. }));
    // Nothing is left to fit.
    assert!(matches!(
        error(&ask("u0", Some(4.95))),
        IdentifyError::TooManyTerms { .. } | IdentifyError::TooShort { .. }
    ));
    let mut twice = ask("u0", None);
    twice.dead_times.push(twice.dead_times[0].clone());
    assert!(matches!(error(&twice), IdentifyError::TwoDeadTimes { .. }));
    let delay = DelayedState { state: "x0".to_string(), gain: None, longest: 0.5 };
    let both = Options { delay: Some(delay), ..ask("u0", None) };
    assert!(matches!(error(&both), IdentifyError::DelayAndDeadTime));
    // A single block is identified as usual, several are not.
    let open = || Ok::<_, IdentifyError>([&data[0], &data[0]].into_iter().cloned().map(Ok));
    let refused = identify_blocks(open, &[], &ask("u0", None), &Quiet).unwrap_err();
    assert!(matches!(refused, IdentifyError::DeadTimeInBlocks), "{refused}");
}
