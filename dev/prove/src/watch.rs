//! `cargo xtask prove --watch`: a machine that runs and changes, over seeds; delays, names and false alarms, beside control
//! charts on the residual of the calibrated model.
//!
//! The machine is a spring-loaded throttle with Coulomb friction, a virtual rig: it shares nothing with what watches it.

use std::path::Path;

use anyhow::{Context, Result};
use greybox_dev::book;
use greybox_model::{Hold, Model, System};
use greybox_recording::csv::write_csv_file;
use greybox_recording::{Channel, Recording};
use greybox_recursive::Chart;
use greybox_simulate::rigs::Throttle;
use greybox_simulate::{Environment, Method, Seeds, Signal, Simulation};
use greybox_watch::{Event, Learned, Options, Subject, Watch};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use statrs::distribution::{DiscreteCDF, Poisson};

use crate::{Figure, Outcome};

/// Seeds of each case.
const SEEDS: usize = 20;
/// Sampling, s.
const STEP: f64 = 0.01;
/// When something happens, s.
const CHANGE: f64 = 600.0;
/// Seconds watched afterwards; of the machine to which nothing happens, seconds in all.
const AFTER: f64 = 300.0;
const SOUND: f64 = 3660.0;
/// False alarms an hour that are asked for.
const ALARMS: f64 = 1.0;
/// Page and mark of the table.
const PAGE: &str = "watch.md";
const BEGIN: &str = "<!-- Made by `cargo xtask prove --watch --write-docs`; do not edit. -->";

const MODEL: &str = r#"
name = "throttle"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.03, unit = "N*m*s/rad" }
c = { value = 0.08, unit = "N*m" }
k = { value = 0.7, unit = "N*m/rad" }
[states]
angle = { unit = "rad" }
[equations]
plate = "J*angle'' + b*angle' + c*sign(angle') + k*angle = torque"
"#;

/// The model of a machine whose torque acts late.
fn late_model() -> String {
    MODEL
        .replace("[states]", "tau = { value = 0.05, unit = \"s\" }\n[states]")
        .replace("= torque", "= delay(torque, tau)")
}

/// Steps of the machine from sample to sample.
const SUBSTEPS: usize = 20;

/// What the machine and its sensor are at one time.
#[derive(Clone, Copy)]
struct Now {
    throttle: Throttle,
    /// Steps after which the torque acts, of the machine whose model has a delay.
    late: Option<usize>,
    /// Offset and noise of the sensor, rad.
    offset: f64,
    noise: f64,
}

const USUAL: Now = Now { throttle: Throttle::NEW, late: None, offset: 0.0, noise: 0.002 };
/// A machine that is not quite what the model says: its spring stiffens.
const ODD: Now = with(Throttle { stiffening: 0.01, ..Throttle::NEW });

/// One whose torque acts 35 ms late.
const LATE: Now = Now { late: Some(70), ..USUAL };

const fn with(throttle: Throttle) -> Now {
    Now { throttle, ..USUAL }
}

struct Case {
    name: &'static str,
    /// The machine before the change, and so many seconds after it.
    usual: Now,
    at: fn(f64) -> Now,
    /// Names that are right; none where nothing happens.
    right: &'static [Name],
    goes: Goes,
}

impl Case {
    fn model(&self) -> Result<Model> {
        let text = if self.usual.late.is_some() { late_model() } else { MODEL.to_owned() };
        Model::from_toml(&text, "throttle.toml").context("the throttle's model")
    }
}

/// How a change goes on.
#[derive(Clone, Copy, PartialEq)]
enum Goes {
    /// It stays: what is said after the alarm is false.
    Stays,
    /// It goes on.
    On,
    /// Half a memory later something else happens, with these names.
    Then(&'static [Name]),
}

/// Half of a memory, s.
const HALF: f64 = 15.0;

/// A name without its parameter's text.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Name {
    Parameter(&'static str),
    Force,
    Offset,
    Noise,
}

impl Name {
    fn is(self, subject: &Subject) -> bool {
        match (self, subject) {
            (Name::Parameter(name), Subject::Parameter(found)) => name == found,
            (Name::Force, Subject::Force(_))
            | (Name::Offset, Subject::Offset(_))
            | (Name::Noise, Subject::Noise(_)) => true,
            _ => false,
        }
    }
}

const CASES: &[Case] = &[
    Case {
        name: "Coulomb friction + 30 %",
        usual: USUAL,
        at: |_| with(Throttle { coulomb: 0.13, ..Throttle::NEW }),
        right: &[Name::Parameter("c")],
        goes: Goes::Stays,
    },
    Case {
        name: "Coulomb friction + 6 % a minute",
        usual: USUAL,
        at: |s| with(Throttle { coulomb: 0.1 * (1.0 + 0.001 * s), ..Throttle::NEW }),
        right: &[Name::Parameter("c")],
        goes: Goes::On,
    },
    Case {
        name: "viscous friction + 30 %",
        usual: USUAL,
        at: |_| with(Throttle { viscous: 0.026, ..Throttle::NEW }),
        right: &[Name::Parameter("b")],
        goes: Goes::Stays,
    },
    Case {
        name: "spring − 2 %",
        usual: USUAL,
        at: |_| with(Throttle { spring: 0.784, ..Throttle::NEW }),
        right: &[Name::Parameter("k")],
        goes: Goes::Stays,
    },
    // A throttle that moves about its rest tells a load from an offset by the friction alone.
    Case {
        name: "load of 2 % of the largest torque",
        usual: USUAL,
        at: |_| with(Throttle { load: 0.02, ..Throttle::NEW }),
        right: &[Name::Force, Name::Offset],
        goes: Goes::Stays,
    },
    Case {
        name: "sensor: offset of twice its noise",
        usual: USUAL,
        at: |_| Now { offset: 0.004, ..USUAL },
        right: &[Name::Offset, Name::Force],
        goes: Goes::Stays,
    },
    Case {
        name: "sensor: noise + 50 %",
        usual: USUAL,
        at: |_| Now { noise: 0.003, ..USUAL },
        right: &[Name::Noise],
        goes: Goes::Stays,
    },
    Case {
        name: "Coulomb friction + 30 %, half a memory later the sensor's offset",
        usual: USUAL,
        at: |s| Now {
            offset: if s < HALF { 0.0 } else { 0.004 },
            ..with(Throttle { coulomb: 0.13, ..Throttle::NEW })
        },
        right: &[Name::Parameter("c")],
        goes: Goes::Then(&[Name::Offset, Name::Force]),
    },
    Case {
        name: "Coulomb friction + 30 %, half a memory later the spring − 2 %",
        usual: USUAL,
        at: |s| {
            let spring = if s < HALF { 0.8 } else { 0.784 };
            with(Throttle { coulomb: 0.13, spring, ..Throttle::NEW })
        },
        right: &[Name::Parameter("c")],
        goes: Goes::Then(&[Name::Parameter("k")]),
    },
    Case {
        name: "sensor: noise + 50 %, half a memory later Coulomb friction + 30 %",
        usual: USUAL,
        at: |s| {
            let coulomb = if s < HALF { 0.1 } else { 0.13 };
            Now { noise: 0.003, ..with(Throttle { coulomb, ..Throttle::NEW }) }
        },
        right: &[Name::Noise],
        goes: Goes::Then(&[Name::Parameter("c")]),
    },
    Case {
        name: "torque that acts 35 ms late: 7 ms later",
        usual: LATE,
        at: |_| Now { late: Some(84), ..LATE },
        right: &[Name::Parameter("tau")],
        goes: Goes::Stays,
    },
    Case {
        name: "torque that acts 35 ms late: Coulomb friction + 30 %",
        usual: LATE,
        at: |_| Now { throttle: Throttle { coulomb: 0.13, ..Throttle::NEW }, ..LATE },
        right: &[Name::Parameter("c")],
        goes: Goes::Stays,
    },
    Case { name: "nothing", usual: USUAL, at: |_| USUAL, right: &[], goes: Goes::Stays },
    Case {
        name: "model lacks a stiffening: Coulomb friction + 30 %",
        usual: ODD,
        at: |_| with(Throttle { coulomb: 0.13, ..ODD.throttle }),
        right: &[Name::Parameter("c")],
        goes: Goes::Stays,
    },
    Case {
        name: "model lacks a stiffening: nothing",
        usual: ODD,
        at: |_| ODD,
        right: &[],
        goes: Goes::Stays,
    },
];

/// Time, torque and measured angle of every sample.
fn record(case: &Case, seed: u64) -> [Vec<f64>; 3] {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let seconds = if case.right.is_empty() { SOUND } else { CHANGE + AFTER };
    let (mut state, mut torque) = ([0.0, 0.0], 0.0);
    let mut out = [Vec::new(), Vec::new(), Vec::new()];
    for k in 0..(seconds / STEP) as usize {
        let t = k as f64 * STEP;
        let now = if t < CHANGE { case.usual } else { (case.at)(t - CHANGE) };
        if k % 30 == 0 {
            torque = 0.5 * normal();
        }
        out[0].push(t);
        out[1].push(torque);
        out[2].push(state[0] + now.offset + now.noise * normal());
        let Some(late) = now.late else {
            state = now.throttle.step(state, torque, STEP, SUBSTEPS);
            continue;
        };
        for step in k * SUBSTEPS..(k + 1) * SUBSTEPS {
            let acts = step.checked_sub(late).map_or(0.0, |before| out[1][before / SUBSTEPS]);
            state = now.throttle.step(state, acts, STEP / SUBSTEPS as f64, 1);
        }
    }
    out
}

/// One seed of a case.
struct Trial {
    /// Seconds from the change to the alarm; `None`: not within the time watched.
    delay: Option<f64>,
    /// The alarm names it alone, or first among what it cannot tell apart; or at all.
    named: (bool, bool),
    /// What settled bears the right name; a wrong one, without the right one among what it cannot tell apart.
    settled: Option<bool>,
    wrong: bool,
    /// Alarms after the last change was seen, and hours.
    further: (usize, f64),
    /// False alarms and hours.
    false_alarms: (usize, f64),
    /// Delay and false alarms of charts on the residual.
    residual: (Option<f64>, usize),
}

fn trial(case: &Case, seed: u64) -> Result<Trial> {
    let [time, torque, angle] = record(case, seed);
    let model = case.model()?;
    let options = Options { alarms_per_day: 24.0 * ALARMS, ..Options::default() };
    let count = time.iter().take_while(|t| **t < options.learn).count();
    let column = |name: &str, values: &[f64]| Channel {
        name: name.to_string(),
        unit: None,
        values: values[..count].to_vec(),
    };
    let first = Recording::from_columns(
        "first",
        time[..count].to_vec(),
        vec![column("torque", &torque), column("angle", &angle)],
    )?;
    let (mut watch, Event::Learned(learned)) = Watch::learn(&model, &first, &options)? else {
        anyhow::bail!("nothing was learned");
    };
    let mut events = Vec::new();
    for k in count..time.len() {
        events.extend(watch.push(time[k], &torque[k..=k], &angle[k..=k]));
    }
    let changed = if case.right.is_empty() { f64::INFINITY } else { CHANGE };
    let mut trial = judged(case, &events, &options);
    trial.residual = on_residual(&model, &learned, &time, &torque, &angle, changed)?;
    Ok(trial)
}

/// What was said of a case.
fn judged(case: &Case, events: &[Event], options: &Options) -> Trial {
    let changed = if case.right.is_empty() { f64::INFINITY } else { CHANGE };
    // What is looked for: the change, or the one after it.
    let (right, at) = match case.goes {
        Goes::Then(names) => (names, changed + HALF),
        _ => (case.right, changed),
    };
    let is_right = |subject: &Subject| right.iter().any(|name| name.is(subject));
    let mut trial = Trial {
        delay: None,
        named: (false, false),
        settled: None,
        wrong: false,
        further: (0, 0.0),
        false_alarms: (0, (changed.min(SOUND) - options.learn) / 3600.0),
        residual: (None, 0),
    };
    for event in events {
        match event {
            Event::Changed(change) if change.t < changed => trial.false_alarms.0 += 1,
            // (That of the first change.)
            Event::Changed(change) if change.t < at => {}
            Event::Changed(change) if trial.delay.is_none() => {
                let first = is_right(&change.subject);
                let among = first || change.or.iter().any(is_right);
                // (What comes after a memory was not seen while the first change settled.)
                if at == changed || among && change.t < at + options.memory {
                    trial.delay = Some(change.t - at);
                    trial.named = (first, among);
                    trial.further.1 = (CHANGE + AFTER - change.t) / 3600.0;
                }
            }
            Event::Changed(_) => trial.further.0 += 1,
            // (The first change is reported together with the second one.)
            Event::Settled(change)
                if trial.settled.is_none() && trial.delay.is_some_and(|delay| change.t > at + delay) =>
            {
                let right = is_right(&change.subject);
                trial.settled = Some(right);
                trial.wrong = !right && !change.or.iter().any(is_right);
            }
            _ => {}
        }
    }
    trial
}

/// The free run of the calibrated model, less what was measured.
fn residual(model: &Model, learned: &Learned, torque: &[f64], angle: &[f64]) -> Result<Vec<f64>> {
    let system = System::compile(model)?;
    let mut values: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
    for p in &learned.parameters {
        let index = model.parameter(&p.name).context("a parameter of the model")?;
        values[index] = p.value;
    }
    let environment = Environment {
        start: 0.0,
        dt: STEP,
        len: torque.len(),
        inputs: vec![Signal::new(Hold::Zero, STEP, torque, |_| Vec::new())],
        forces: Vec::new(),
    };
    let simulation = Simulation {
        system: &system,
        environment: &environment,
        parameters: &values,
        method: Method::Rk4 { substeps: 4 },
        seeds: &Seeds::default(),
    };
    let mut stepper = simulation.stepper(&[angle[0], 0.0]);
    let mut out = Vec::with_capacity(angle.len());
    for measured in angle {
        out.push(measured - stepper.state()[0]);
        stepper.step();
    }
    Ok(out)
}

/// Charts of mean and scatter of the residual, at the same rate of false alarms: delay, and false alarms before the change.
fn on_residual(
    model: &Model,
    learned: &Learned,
    time: &[f64],
    torque: &[f64],
    angle: &[f64],
    changed: f64,
) -> Result<(Option<f64>, usize)> {
    let residual = residual(model, learned, torque, angle)?;
    let per_block = (learned.block / STEP).round().max(1.0) as usize;
    let values = 2.0 * 3600.0 / learned.block / ALARMS;
    let mut charts = [Chart::new(1.0, values)?, Chart::new(1.0, values)?];
    let (mut delay, mut count) = (None, 0);
    for (k, block) in residual.chunks_exact(per_block).enumerate() {
        let mean = block.iter().sum::<f64>() / per_block as f64;
        let scatter = (block.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / per_block as f64).ln();
        let alarms = [charts[0].push(mean), charts[1].push(scatter)];
        if alarms.iter().all(Option::is_none) {
            continue;
        }
        charts.iter_mut().for_each(Chart::restart);
        let t = time[(k + 1) * per_block - 1];
        if t >= changed {
            delay.get_or_insert(t - changed);
        } else if t > Options::default().learn {
            count += 1;
        }
    }
    Ok((delay, count))
}

/// Runs the cases whose names contain `only`.
///
/// # Errors
/// A machine that cannot be watched.
pub(crate) fn run(first: u64, count: Option<usize>, only: Option<&str>) -> Result<Vec<Outcome>> {
    let seeds: Vec<u64> = (first..first + count.unwrap_or(SEEDS) as u64).collect();
    let chosen: Vec<&Case> = CASES.iter().filter(|c| only.is_none_or(|o| c.name.contains(o))).collect();
    anyhow::ensure!(!chosen.is_empty(), "no case of --watch has that in its name");
    chosen
        .iter()
        .map(|case| {
            let trials: Vec<Trial> =
                seeds.par_iter().map(|seed| trial(case, *seed)).collect::<Result<_>>()?;
            Ok(outcome(case, &trials))
        })
        .collect()
}

/// Median of the delays, those without an alarm counted as the longest.
fn median(delays: impl Iterator<Item = Option<f64>>) -> f64 {
    let mut all: Vec<f64> = delays.map(|d| d.unwrap_or(f64::INFINITY)).collect();
    all.sort_by(f64::total_cmp);
    all[all.len() / 2]
}

fn seconds(delay: f64) -> String {
    if delay.is_finite() { format!("{delay:.1} s") } else { "not seen".to_string() }
}

/// What a Poisson variable of this mean exceeds as rarely as a normal one exceeds three standard deviations: few alarms are
/// not normal.
fn most(mean: f64) -> usize {
    const RARELY: f64 = 0.001_35;
    // (There is no such variable without a time to alarm in.)
    Poisson::new(mean).map_or(0, |alarms| alarms.inverse_cdf(1.0 - RARELY) as usize)
}

fn outcome(case: &Case, trials: &[Trial]) -> Outcome {
    let n = trials.len();
    let hours: f64 = trials.iter().map(|t| t.false_alarms.1).sum();
    let alarms: usize = trials.iter().map(|t| t.false_alarms.0).sum();
    let residual: usize = trials.iter().map(|t| t.residual.1).sum();
    let share = |is: &dyn Fn(&Trial) -> bool| trials.iter().filter(|t| is(t)).count();
    let mut figures = Vec::new();
    if !case.right.is_empty() {
        let seen = share(&|t| t.delay.is_some());
        let settled = share(&|t| t.settled == Some(true));
        figures.push(Figure::judged(
            "seen",
            format!("{seen} of {n}"),
            "≥ 95 %",
            seen as f64 >= 0.95 * n as f64,
        ));
        figures.push(Figure::plain("median delay", seconds(median(trials.iter().map(|t| t.delay)))));
        let (alone, among) = (share(&|t| t.named.0), share(&|t| t.named.1));
        figures.push(Figure::plain("named at the alarm", format!("first {alone}, among {among} of {n}")));
        figures.push(Figure::judged(
            "named when settled",
            format!("{settled} of {n}, wrongly {}", share(&|t| t.wrong)),
            "≥ 90 %",
            settled as f64 >= 0.9 * n as f64,
        ));
        if case.goes != Goes::On {
            let hours: f64 = trials.iter().map(|t| t.further.1).sum();
            let alarms: usize = trials.iter().map(|t| t.further.0).sum();
            figures.push(Figure::judged(
                "further alarms",
                format!("{:.2} an hour ({alarms} in {hours:.1} h)", alarms as f64 / hours),
                format!("≤ {ALARMS} an hour"),
                alarms <= most(ALARMS * hours),
            ));
        }
    }
    if !case.right.is_empty() && !matches!(case.goes, Goes::Then(_)) {
        let delays = trials.iter().map(|t| t.residual.0);
        let residual_seen = share(&|t| t.residual.0.is_some());
        figures.push(Figure::plain(
            "charts on the residual",
            format!("{residual_seen} of {n}, {}", seconds(median(delays))),
        ));
    }
    // (Before a change the machines are those to which nothing happens.)
    if case.right.is_empty() {
        figures.push(Figure::judged(
            "false alarms",
            format!("{:.2} an hour ({alarms} in {hours:.1} h)", alarms as f64 / hours),
            format!("≤ {ALARMS} an hour"),
            alarms <= most(ALARMS * hours),
        ));
        figures.push(Figure::plain(
            "false alarms of charts on the residual",
            format!("{:.2} an hour", residual as f64 / hours),
        ));
    }
    Outcome { case: case.name.to_string(), figures }
}

/// The table of the book.
///
/// # Errors
/// Where a case was left out, or the page cannot be written.
pub(crate) fn write(root: &Path, outcomes: &[Outcome]) -> Result<()> {
    anyhow::ensure!(outcomes.len() == CASES.len(), "the table in the book has all cases");
    let mut text = "| what changed | seen | median delay | named at the alarm | named when settled | further alarms an hour | false alarms an hour | charts on the residual: seen, median delay | their false alarms an hour |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |\n".to_string();
    for outcome in outcomes {
        let of = |name: &str| {
            outcome.figures.iter().find(|f| f.name == name).map_or("–", |f| f.measured.as_str())
        };
        let hourly = |name: &str| of(name).split(" an hour").next().unwrap_or_default().to_string();
        text += &format!(
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} |\n",
            outcome.case,
            of("seen"),
            of("median delay"),
            of("named at the alarm"),
            of("named when settled"),
            hourly("further alarms"),
            hourly("false alarms"),
            of("charts on the residual"),
            hourly("false alarms of charts on the residual")
        );
    }
    book::put_table(root, PAGE, BEGIN, &text)
}

/// Writes the recordings of all cases with the residual of the calibrated model, for other detectors: `NUMBER-SEED.csv`.
///
/// # Errors
/// A machine that cannot be watched, or a folder that cannot be written.
pub(crate) fn keep(folder: &Path, first: u64, count: Option<usize>) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} cannot be made", folder.display()))?;
    let options = Options::default();
    for (number, case) in CASES.iter().enumerate() {
        let model = case.model()?;
        for seed in first..first + count.unwrap_or(SEEDS) as u64 {
            let [time, torque, angle] = record(case, seed);
            let n = time.iter().take_while(|t| **t < options.learn).count();
            let column = |name: &str, values: &[f64]| Channel {
                name: name.into(),
                unit: None,
                values: values[..n].to_vec(),
            };
            let channels = vec![column("torque", &torque), column("angle", &angle)];
            let first = Recording::from_columns("first", time[..n].to_vec(), channels)?;
            let (_, Event::Learned(learned)) = Watch::learn(&model, &first, &options)? else { continue };
            let residual = residual(&model, &learned, &torque, &angle)?;
            let columns = [
                ("torque [N*m]", &torque[..]),
                ("angle [rad]", &angle[..]),
                ("residual [rad]", &residual[..]),
            ];
            write_csv_file(folder.join(format!("{number}-{seed}.csv")), &time, &columns)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of many alarms it is three standard deviations; of few the distribution is skew: at 1/6, two come one time in eighty, three one
    /// in fifteen hundred.
    #[test]
    fn few_alarms_are_counted_by_poisson() {
        assert_eq!(most(1.0 / 6.0), 2);
        assert_eq!(most(0.0), 0);
        assert!(most(400.0).abs_diff(460) <= 2, "{}", most(400.0));
    }

    #[test]
    fn a_machine_whose_torque_is_late_has_a_model_that_says_so() {
        for case in CASES {
            let system = greybox_model::System::compile(&case.model().unwrap()).unwrap();
            assert_eq!(system.rhs.delays.len() == 1, case.usual.late.is_some(), "{}", case.name);
        }
    }

    #[test]
    fn the_page_has_a_place_for_the_table() {
        assert!(book::has_table(&greybox_dev::root(), PAGE, BEGIN));
    }

    /// The throttle's free motion from one push: it stops within a whole number of half periods, at rest between ±c/k.
    #[test]
    fn the_throttle_sticks_where_friction_holds_the_spring() {
        let case = Case {
            name: "",
            usual: Now { noise: 0.0, ..USUAL },
            at: |_| USUAL,
            right: &[],
            goes: Goes::Stays,
        };
        let [_, torque, angle] = record(&case, 1);
        let mut held = 0;
        for k in (29..50_000).step_by(30) {
            // At rest at the end of a step of the torque: what is left of the push is within the friction.
            if angle[k] == angle[k - 1] {
                held += 1;
                assert!((torque[k] - Throttle::NEW.spring * angle[k]).abs() <= Throttle::NEW.coulomb * 1.001);
            }
        }
        assert!(held > 21, "{held}");
    }
}
