//! Recordings read in blocks: the answer of the whole, in constant memory.

use greybox_identify::{
    HoldoutSource, Identification, IdentifyError, Library, Linearisation, Monomials, Options, Quiet,
    Statistics, identify, identify_blocks,
};
use greybox_model::Hold;
use greybox_recording::{Channel, Recording};
use greybox_simulate::rigs::{Duffing, Sampling};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;

const DT: f64 = 0.01;
const TRUTH: [(&str, f64); 6] =
    [("x''", 2.0), ("x", 6.0), ("x^3", 0.1), ("x'", 1.0), ("x^2*x'", 0.2), ("x'^3", 1.0)];

/// The oscillator of thesis equation 2.18 under incommensurate sines, cut into blocks.
fn blocks(seed: u64, count: usize, length: usize) -> Vec<Recording> {
    let n = count * length;
    let force = |t: f64| 10.0 * t.sin() + 40.0 * (4.0 * t).sin() + 15.0 * (2.39 * t).sin();
    let states = Duffing::THESIS.run(Sampling { dt: DT, substeps: 4 }, [0.0, 0.0], n, force).unwrap();
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let noise = Normal::new(0.0, 0.01).unwrap();
    let x: Vec<f64> = states.iter().map(|s| s[0] + noise.sample(&mut random)).collect();
    let f: Vec<f64> = (0..n).map(|k| force(k as f64 * DT)).collect();
    let t: Vec<f64> = (0..n).map(|k| k as f64 * DT).collect();
    (0..count)
        .map(|b| {
            let at = b * length..(b + 1) * length;
            let channel = |name: &str, unit: &str, v: &[f64]| Channel {
                name: name.into(),
                unit: Some(unit.into()),
                values: v[at.clone()].to_vec(),
            };
            Recording::from_columns(
                "run.csv",
                t[at.clone()].to_vec(),
                vec![channel("f", "N", &f), channel("x", "m", &x)],
            )
            .unwrap()
        })
        .collect()
}

fn options() -> Options {
    Options {
        library: Library { monomials: Monomials::TotalDegree, ..Library::default() },
        order: 3,
        hold: Some(Hold::BandLimited),
        replicates: 20,
        ..Options::new(&["x"], &["f"])
    }
}

fn stream(blocks: &[Recording], options: &Options) -> Result<Identification, IdentifyError> {
    let open = || Ok(blocks.iter().cloned().map(Ok));
    identify_blocks(open, &[], options, &Quiet).map(|s| s.found)
}

/// Coefficients of the oscillator's terms with their intervals; panics where another term was chosen.
fn coefficients(found: &Identification) -> Vec<(f64, (f64, f64))> {
    let terms = &found.equations[0].terms;
    assert_eq!(terms.len(), TRUTH.len(), "{:?}", terms.iter().map(|t| &t.expression).collect::<Vec<_>>());
    let of = |name: &str| terms.iter().find(|t| t.expression == name).unwrap();
    TRUTH.iter().map(|(name, _)| (of(name).value, of(name).ci95.unwrap())).collect()
}

#[test]
fn blocks_say_what_the_whole_says_and_their_intervals_hold() {
    const SEEDS: u64 = 12;
    let (mut held, mut all) = (0, 0);
    for seed in 0..SEEDS {
        // The last block is held out.
        let cut = blocks(seed, 7, 1500);
        let found = stream(&cut, &options()).unwrap();
        let terms = coefficients(&found);
        let info = found.blocks.unwrap();
        assert_eq!((info.blocks, info.samples, info.lost, info.settled), (6, 9000, 0, true));
        // The noise, relative to the displacement.
        assert!(found.holdout.unwrap().scores[0].nrmse < 0.015);
        for ((_, ci), (_, truth)) in terms.iter().zip(TRUTH) {
            held += usize::from(ci.0 <= truth && truth <= ci.1);
            all += 1;
        }
        if seed < 3 {
            let join =
                |of: fn(&Recording) -> &[f64]| cut[..6].iter().flat_map(of).copied().collect::<Vec<_>>();
            let whole = Recording::from_columns(
                "run.csv",
                join(|r| &r.time),
                vec![
                    Channel { values: join(|r| &r.channels[0].values), ..cut[0].channels[0].clone() },
                    Channel { values: join(|r| &r.channels[1].values), ..cut[0].channels[1].clone() },
                ],
            )
            .unwrap();
            let reference = identify(&[whole], &cut[6..], &options(), &Quiet).unwrap();
            for ((a, ci), (b, wanted)) in terms.iter().zip(coefficients(&reference)) {
                let half = 0.5 * (wanted.1 - wanted.0);
                assert!((a - b).abs() < 0.5 * half, "seed {seed}: {a} in blocks, {b} ± {half} as a whole");
                assert!(((ci.1 - ci.0) / (2.0 * half) - 1.0).abs() < 0.35, "{ci:?} against ± {half}");
            }
        }
    }
    // 95 % of 72 are 68; four standard deviations less.
    assert!(held >= 61, "{held} of {all} intervals hold");
}

#[test]
fn intervals_narrow_with_the_number_of_blocks() {
    let cut: Vec<Recording> = blocks(5, 21, 400);
    let one = stream(&cut[..2], &options()).unwrap();
    let all = stream(&cut, &options()).unwrap();
    let width = |found: &Identification| {
        let term = found.equations[0].terms.iter().find(|t| t.expression == "x").unwrap();
        let (low, high) = term.ci95.unwrap();
        high - low
    };
    // Twenty blocks in place of one: √20 times narrower.
    assert!(width(&all) < 0.4 * width(&one), "{} against {}", width(&all), width(&one));
}

#[test]
fn statistics_merge_in_any_grouping_and_travel_as_json() {
    let cut = blocks(1, 5, 1200);
    let around = Linearisation::begin(&cut[0], &options(), &Quiet).unwrap();
    let parts: Vec<Statistics> = cut.iter().map(|b| around.map(b).unwrap()).collect();
    let merge = |a: &Statistics, b: &Statistics| a.clone().merge(b.clone()).unwrap();
    let left = parts[1..].iter().fold(parts[0].clone(), |a, b| merge(&a, b));
    let right = parts[..4].iter().rev().fold(parts[4].clone(), |a, b| merge(b, &a));
    assert_eq!(left.samples(), 6000);
    let text = serde_json::to_string(&left).unwrap();
    assert!(serde_json::from_str::<Statistics>(&text).unwrap() == left, "a number changed on the way");
    let found = |s: &Statistics| {
        let next = around.step(s).unwrap();
        coefficients(&next.conclude(s, &[], HoldoutSource::None, &options()).unwrap())
    };
    for ((a, ci), (b, _)) in found(&left).into_iter().zip(found(&right)) {
        assert!((a - b).abs() < 1e-9 * (ci.1 - ci.0), "{a} or {b}");
    }
    // All of them count: without the last block the answer is another.
    let fewer = parts[1..4].iter().fold(parts[0].clone(), |a, b| merge(&a, b));
    assert!(
        found(&left).iter().zip(found(&fewer)).any(|((a, ci), (b, _))| (a - b).abs() > 1e-3 * (ci.1 - ci.0))
    );
    // Around another model they do not mix.
    let other = Linearisation::begin(&cut[1], &options(), &Quiet).unwrap();
    let foreign = other.map(&cut[1]).unwrap();
    assert!(matches!(parts[0].clone().merge(foreign.clone()), Err(IdentifyError::Mixed)));
    assert!(matches!(around.step(&foreign), Err(IdentifyError::Mixed)));
}

#[test]
fn the_same_for_any_number_of_threads() {
    let cut = blocks(2, 6, 1000);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        format!("{:?}", pool.install(|| stream(&cut, &options()).unwrap().equations))
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn what_cannot_be_done_in_blocks_is_told() {
    let cut = blocks(3, 2, 1000);
    let wanted = greybox_identify::DelayedState { state: "x".into(), gain: None, longest: 0.5 };
    let delayed = Options { delay: Some(wanted), ..options() };
    assert!(matches!(stream(&cut, &delayed), Err(IdentifyError::DelayInBlocks)));
    assert!(matches!(stream(&[], &options()), Err(IdentifyError::NoBlocks)));
    // A single block is identified as usual.
    assert!(stream(&cut[..1], &options()).unwrap().blocks.is_none());
    // A later block without a channel is an error that names it.
    let mut broken = cut.clone();
    broken[1].channels.truncate(1);
    broken[1].pieces[0].columns.truncate(1);
    broken.push(cut[1].clone());
    let error = stream(&broken, &options()).unwrap_err().to_string();
    assert!(error.contains("run.csv: there is no channel `x`"), "{error}");
}
