//! `cargo xtask prove --statistics`: whether what greybox says of its own certainty is so, over seeds.
//!
//! *Coverage*: how many of the 95 % intervals hold the truth. *False alarms*: how often physics is missing where none
//! is. *Reliability*: of the mechanisms that are named with a confidence, how many are right. The recordings come from
//! an oscillator of this file's own, whose parameters, force and noise are drawn anew for each seed.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use greybox_diagnose::{Diagnosis, Options, Quiet, Verdict, calibrate, diagnose};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use statrs::distribution::{Binomial, DiscreteCDF};

use super::{Figure, Outcome, identify};
use greybox_dev::book;
use greybox_dev::figure::{Axis, Plot, Series, Style};

/// Seeds of every figure.
const SEEDS: usize = 400;
/// The book's page.
pub(crate) const PAGE: &str = "statistics.md";
/// Marker of its table.
pub(crate) const BEGIN: &str = "<!-- Made by `cargo xtask prove --statistics --write-docs`; do not edit. -->";
/// Bounds of the bins of confidence.
const BINS: [f64; 6] = [0.0, 0.5, 0.7, 0.9, 0.97, 1.0];

const MODEL: &str = r#"
name = "oscillator"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.0, unit = "kg" }
c = { value = 0.6, unit = "N s/m" }
k = { value = 40.0, unit = "N/m" }
[equations]
mass = "m*x'' + c*x' + k*x = f"
"#;

/// What a case leaves out of the model: kind, parameter, and the range of its strength.
#[derive(Debug, Clone, Copy)]
struct Effect {
    kind: &'static str,
    /// Begin of the law's expression, where another of this kind says something else.
    law: &'static str,
    parameter: &'static str,
    strength: (f64, f64),
    /// Force that it takes away, at position, velocity and strength.
    force: fn(f64, f64, f64) -> f64,
    /// Dry friction, which holds a body at rest: its level at velocity and strength.
    dry: fn(f64, f64) -> f64,
}

impl Effect {
    /// A force of position and velocity.
    const fn smooth(
        kind: &'static str,
        parameter: &'static str,
        strength: (f64, f64),
        force: fn(f64, f64, f64) -> f64,
    ) -> Effect {
        Effect { kind, law: "", parameter, strength, force, dry: |_, _| 0.0 }
    }

    /// Dry friction of some level.
    const fn dry(kind: &'static str, parameter: &'static str, dry: fn(f64, f64) -> f64) -> Effect {
        Effect { kind, law: "", parameter, strength: (0.2, 0.8), force: |_, _, _| 0.0, dry }
    }
}

/// Effects that have one parameter.
const EFFECTS: [Effect; 4] = [
    Effect::dry("coulomb_friction", "fc", |_, s| s),
    Effect::smooth("cubic_stiffness", "k3", (100.0, 400.0), |x, _, s| s * x * x * x),
    Effect::smooth("quadratic_drag", "cd", (0.3, 1.5), |_, v, s| s * v * v.abs()),
    Effect::smooth("constant_offset", "f0", (0.3, 1.5), |_, _, s| s),
];

/// Others that are taken for these, and for each other, where little of them is seen.
const LOOKALIKES: [Effect; 4] = [
    Effect::dry("asymmetric_coulomb_friction", "fcp", |v, s| if v > 0.0 { s } else { 0.6 * s }),
    Effect::dry("stribeck_friction", "fc", |v, s| s * (1.0 + 0.8 * (-(v / 0.1).powi(2)).exp())),
    Effect::smooth("quadratic_stiffness", "k2", (20.0, 80.0), |x, _, s| s * x * x),
    // A second spring, which takes hold on either side of the middle.
    Effect {
        law: "kd*",
        ..Effect::smooth("dead_zone", "gap", (0.03, 0.1), |x, _, s| 60.0 * (x - x.clamp(-s, s)))
    },
];

/// How much is recorded of a machine.
#[derive(Debug, Clone, Copy)]
struct Plan {
    /// Samples.
    train: usize,
    holdout: usize,
    /// Sines of the force.
    sines: usize,
    /// Factor of the strengths of effects.
    weaker: f64,
    /// Bounds of the noise over the motion.
    noise: (f64, f64),
}

impl Plan {
    const fn rich(noise: (f64, f64)) -> Plan {
        Plan { train: 1200, holdout: 600, sines: 8, weaker: 1.0, noise }
    }

    /// Short, with two frequencies, of effects that are hardly there: what several laws explain.
    const POOR: Plan = Plan { train: 400, holdout: 300, sines: 2, weaker: 0.4, noise: (0.01, 0.3) };
}

/// Noise of a sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Noise {
    White,
    /// First-order autoregression with this coefficient.
    Coloured(f64),
}

/// A machine and how it was recorded.
#[derive(Debug, Clone)]
struct Drawn {
    /// m, c and k.
    truth: [f64; 3],
    effect: Option<(Effect, f64)>,
    train: Recording,
    holdout: Recording,
}

/// Draws a machine of a case.
fn draw(seed: u64, effect: Option<Effect>, noise: Noise, plan: Plan) -> Result<Drawn> {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut around = |value: f64| value * random.random_range(0.85..1.15);
    let truth = [around(1.0), around(0.6), around(40.0)];
    let effect = effect.map(|e| (e, plan.weaker * random.random_range(e.strength.0..e.strength.1)));
    let level = (random.random_range(plan.noise.0.ln()..=plan.noise.1.ln())).exp();
    let mut record = |n| record(&mut random, &truth, effect, (noise, level), (plan.sines, n));
    let (train, holdout) = (record(plan.train)?, record(plan.holdout)?);
    Ok(Drawn { truth, effect, train, holdout })
}

/// x'' = (f − c x' − k x − effect)/m by the leapfrog, 200 steps a sample; dry friction takes at most the momentum there
/// is, so that it sticks exactly.
fn record(
    random: &mut Pcg64Mcg,
    truth: &[f64; 3],
    effect: Option<(Effect, f64)>,
    (noise, level): (Noise, f64),
    (sines, n): (usize, usize),
) -> Result<Recording> {
    let [m, c, k] = *truth;
    let (dt, fine) = (0.01, 200);
    let sines: Vec<[f64; 2]> = (0..sines)
        .map(|_| [random.random_range(1.0_f64..14.0), random.random_range(0.0..std::f64::consts::TAU)])
        .collect();
    let time: Vec<f64> = (0..n).map(|i| i as f64 * dt).collect();
    let force: Vec<f64> =
        time.iter().map(|t| sines.iter().map(|[w, p]| 2.0 * (w * t + p).sin()).sum()).collect();
    let (mut x, mut v) = (0.02, 0.0);
    let h = dt / fine as f64;
    let mut motion = Vec::with_capacity(n);
    for i in 0..n {
        motion.push(x);
        for j in 0..fine {
            let w = (j as f64 + 0.5) / fine as f64;
            let f = force[i] + w * (force[(i + 1).min(n - 1)] - force[i]);
            let middle = x + 0.5 * h * v;
            let rate =
                |v: f64| (f - c * v - k * middle - effect.map_or(0.0, |(e, s)| (e.force)(middle, v, s))) / m;
            let free = v + h * rate(v + 0.5 * h * rate(v));
            let dry = effect.map_or(0.0, |(e, s)| h * (e.dry)(free, s) / m);
            v = if free.abs() <= dry { 0.0 } else { free - dry * free.signum() };
            x = middle + 0.5 * h * v;
        }
    }
    let rms = (motion.iter().map(|x| x * x).sum::<f64>() / n as f64).sqrt();
    let mut coloured = 0.0;
    let measured = motion.iter().map(|x| {
        let white: f64 = StandardNormal.sample(random);
        let noise = match noise {
            Noise::White => white,
            Noise::Coloured(a) => {
                coloured = a * coloured + (1.0 - a * a).sqrt() * white;
                coloured
            }
        };
        x + level * rms * noise
    });
    let measured = measured.collect();
    let channel = |name: &str, values| Channel { name: name.to_owned(), unit: None, values };
    Ok(Recording::from_columns("simulated", time, vec![channel("f", force), channel("x", measured)])?)
}

/// Intervals that hold the truth, and all.
#[derive(Debug, Clone, Copy, Default)]
struct Covered {
    held: usize,
    all: usize,
}

impl Covered {
    fn count(&mut self, truth: f64, interval: Option<(f64, f64)>) {
        if let Some((low, high)) = interval {
            self.all += 1;
            self.held += usize::from(low <= truth && truth <= high);
        }
    }

    fn and(self, other: Covered) -> Covered {
        Covered { held: self.held + other.held, all: self.all + other.all }
    }
}

/// What one diagnosis of a machine with something left out says of it.
#[derive(Debug, Clone, PartialEq)]
enum Reported {
    /// Its kind.
    Named,
    /// Another kind, which these recordings do not tell from it: the report says so.
    Equal,
    /// Something else: this kind.
    Otherwise(String),
    /// No mechanism.
    Nothing,
}

/// What one diagnosis says.
#[derive(Debug, Clone)]
struct Answer {
    reported: Reported,
    /// Kinds that it says these recordings do not tell from the first mechanism.
    equals: usize,
    /// Confidence of the first mechanism, if any.
    confidence: Option<f64>,
    /// The intervals, where just the right law is named.
    covered: Covered,
}

impl Answer {
    fn of(drawn: &Drawn, (effect, strength): (Effect, f64), diagnosis: &Diagnosis) -> Answer {
        let mut covered = Covered::default();
        if let [only] = diagnosis.mechanisms.as_slice()
            && only.kind == effect.kind
            && only.expression.starts_with(effect.law)
        {
            for (p, truth) in diagnosis.parameters.iter().zip(drawn.truth) {
                covered.count(truth, p.improved.ci95);
            }
            for (_, _, e) in only.parameters.iter().filter(|(n, ..)| n.starts_with(effect.parameter)) {
                covered.count(strength, e.ci95);
            }
        }
        let reported = match diagnosis.mechanisms.first() {
            None => Reported::Nothing,
            Some(first) if first.kind == effect.kind => Reported::Named,
            Some(first) if first.alternatives.iter().any(|a| a.equivalent && a.kind == effect.kind) => {
                Reported::Equal
            }
            Some(first) => Reported::Otherwise(first.kind.clone()),
        };
        let first = diagnosis.mechanisms.first();
        let equals = first.map_or(0, |f| f.alternatives.iter().filter(|a| a.equivalent).count());
        Answer { reported, equals, confidence: first.map(|f| f.confidence), covered }
    }

    /// The confidence stated, and whether it is right: the name, or, where equals count, one of them.
    fn judged(&self, equals_count: bool) -> Option<(f64, bool)> {
        let right = self.reported == Reported::Named || (equals_count && self.reported == Reported::Equal);
        self.confidence.map(|confidence| (confidence, right))
    }
}

/// Answers whose confidence lies in one bin.
#[derive(Debug, Clone, Copy)]
struct Bin {
    low: f64,
    high: f64,
    answers: usize,
    right: usize,
    /// Mean confidence.
    reported: f64,
}

impl Bin {
    fn rate(&self) -> f64 {
        self.right as f64 / self.answers.max(1) as f64
    }

    /// 95 % interval of the rate (Wilson, J. Am. Stat. Assoc. 22, 1927).
    fn interval(&self) -> (f64, f64) {
        let (n, p, z) = (self.answers as f64, self.rate(), 1.96_f64);
        let centre = (p + z * z / (2.0 * n)) / (1.0 + z * z / n);
        let half = z / (1.0 + z * z / n) * (p * (1.0 - p) / n + z * z / (4.0 * n * n)).sqrt();
        ((centre - half).max(0.0), (centre + half).min(1.0))
    }

    /// Whether the confidence is no higher than the answers deserve: so few right ones, or fewer, come by chance in 2.5 %
    /// at least, were it so (exact binomial test).
    fn is_honest(&self) -> bool {
        let by_chance = Binomial::new(self.reported.clamp(0.0, 1.0), self.answers as u64);
        by_chance.is_ok_and(|d| d.cdf(self.right as u64) >= 0.025)
    }
}

fn bins(answers: &[(f64, bool)]) -> Vec<Bin> {
    let bin = |bounds: &[f64]| {
        let last = bounds[1] >= 1.0;
        let inside: Vec<&(f64, bool)> =
            answers.iter().filter(|(c, _)| *c >= bounds[0] && (*c < bounds[1] || last)).collect();
        Bin {
            low: bounds[0],
            high: bounds[1],
            answers: inside.len(),
            right: inside.iter().filter(|a| a.1).count(),
            reported: inside.iter().map(|a| a.0).sum::<f64>() / inside.len().max(1) as f64,
        }
    };
    BINS.windows(2).map(bin).collect()
}

fn over<T: Send>(seeds: &[u64], work: impl Fn(u64) -> Result<T> + Sync) -> Result<Vec<T>> {
    seeds.par_iter().map(|seed| work(*seed)).collect()
}

/// Intervals of `calibrate` where the model is right.
fn calibrated(seeds: &[u64], noise: Noise) -> Result<Figure> {
    let model = Model::from_toml(MODEL, "model.toml")?;
    let counts = over(seeds, |seed| {
        let drawn = draw(seed, None, noise, Plan::rich((0.01, 0.05)))?;
        let found = calibrate(&model, &[drawn.train], &[drawn.holdout], &Quiet)?;
        let mut covered = Covered::default();
        for (p, truth) in found.parameters.iter().zip(drawn.truth) {
            covered.count(truth, p.calibrated.ci95);
        }
        Ok(covered)
    })?;
    let all = counts.into_iter().fold(Covered::default(), Covered::and);
    Ok(identify::coverage("95 % intervals that hold the truth", (all.held, all.all)))
}

/// How often `diagnose` says that nothing is missing where nothing is.
fn nulls(seeds: &[u64], noise: Noise) -> Result<Vec<Figure>> {
    let model = Model::from_toml(MODEL, "model.toml")?;
    let verdicts = over(seeds, |seed| {
        let drawn = draw(seed, None, noise, Plan::rich((0.003, 0.1)))?;
        Ok(diagnose(&model, &[drawn.train], &[drawn.holdout], &Options::default(), &Quiet)?.verdict)
    })?;
    let of = |verdict| verdicts.iter().filter(|v| **v == verdict).count();
    let (n, alarms) = (seeds.len(), of(Verdict::MissingPhysics));
    Ok(vec![
        Figure::judged(
            "false alarms",
            format!("{alarms} of {n}"),
            "<= 2 %",
            // (One of a handful proves nothing.)
            alarms as f64 <= (0.02 * n as f64).max(1.0),
        ),
        Figure::plain("unexplained", format!("{} of {n}", of(Verdict::Unexplained))),
    ])
}

/// Diagnoses of machines with one thing left out, as they are recorded.
fn effects(seeds: &[u64], drawn_from: &[Effect], plan: Plan) -> Result<Vec<(Effect, Answer)>> {
    let model = Model::from_toml(MODEL, "model.toml")?;
    let all: Vec<(usize, u64)> = seeds.iter().enumerate().map(|(i, s)| (i % drawn_from.len(), *s)).collect();
    all.par_iter()
        .map(|(kind, seed)| {
            let drawn = draw(*seed, Some(drawn_from[*kind]), Noise::White, plan)?;
            let (train, holdout) = ([drawn.train.clone()], [drawn.holdout.clone()]);
            let found = diagnose(&model, &train, &holdout, &Options::default(), &Quiet)?;
            let effect = drawn.effect.context("nothing was left out")?;
            Ok((effect.0, Answer::of(&drawn, effect, &found)))
        })
        .collect()
}

fn effect_figures(found: &[(Effect, Answer)]) -> Vec<Figure> {
    let all = found.iter().fold(Covered::default(), |sum, (_, n)| sum.and(n.covered));
    let mut figures = vec![identify::coverage("95 % intervals that hold the truth", (all.held, all.all))];
    for effect in EFFECTS.iter().chain(&LOOKALIKES) {
        let of: Vec<&Answer> = found.iter().filter(|(e, _)| e.kind == effect.kind).map(|(_, n)| n).collect();
        if !of.is_empty() {
            figures.push(Figure::plain(effect.kind, summary(&of)));
        }
    }
    figures.push(Figure::plain("in all", summary(&found.iter().map(|(_, n)| n).collect::<Vec<_>>())));
    figures
}

/// How answers name what is left out, what they take it for, and how many of their intervals hold.
fn summary(answers: &[&Answer]) -> String {
    let count = |reported: &Reported| answers.iter().filter(|a| a.reported == *reported).count();
    let mut text = format!("{} of {} named", count(&Reported::Named), answers.len());
    if count(&Reported::Equal) > 0 {
        text += &format!(", {} reported as equivalent", count(&Reported::Equal));
    }
    let mut others = BTreeMap::new();
    for answer in answers {
        if let Reported::Otherwise(kind) = &answer.reported {
            *others.entry(kind).or_insert(0) += 1;
        }
    }
    for (kind, n) in others {
        text += &format!(", {n} taken for {kind}");
    }
    let named: Vec<usize> =
        answers.iter().filter(|a| a.reported == Reported::Named).map(|a| a.equals).collect();
    if named.iter().any(|n| *n > 0) {
        let mean = named.iter().sum::<usize>() as f64 / named.len() as f64;
        text += &format!("; {mean:.2} equals beside the name");
    }
    let covered = answers.iter().fold(Covered::default(), |sum, a| sum.and(a.covered));
    if covered.all > 0 {
        let rate = 100.0 * covered.held as f64 / covered.all as f64;
        text += &format!("; {rate:.1} % of {} intervals", covered.all);
    }
    text
}

fn bin_figures(bins: &[Bin]) -> Vec<Figure> {
    let reported = |b: &Bin| {
        let (low, high) = b.interval();
        let name = format!("confidence {:.2} to {:.2}", b.low, b.high);
        let measured = format!(
            "{:.1} % of {} right ({:.0} to {:.0} %), stated {:.1} %",
            100.0 * b.rate(),
            b.answers,
            100.0 * low,
            100.0 * high,
            100.0 * b.reported
        );
        Figure::judged(name, measured, "no less than stated", b.is_honest())
    };
    bins.iter().filter(|b| b.answers > 0).map(reported).collect()
}

/// What a run found.
#[derive(Debug, Clone)]
pub(crate) struct Found {
    pub(crate) outcomes: Vec<Outcome>,
    /// Of what is recorded well, and of the rest.
    bins: [Vec<Bin>; 2],
    /// Seeds of each case.
    seeds: usize,
}

/// Puts the figures and the reliability diagram into the book.
pub(crate) fn write(root: &Path, found: &Found) -> Result<()> {
    book::put_table(root, PAGE, BEGIN, &table(found))?;
    book::put_file(root, "statistics-reliability.svg", &diagram(&found.bins)?)
}

fn table(found: &Found) -> String {
    let mut text = format!("{} seeds of every case.\n\n", found.seeds);
    text += "| case | figure | measured | goal | |\n|---|---|---|---|---|\n";
    for outcome in &found.outcomes {
        for (i, f) in outcome.figures.iter().enumerate() {
            let case = if i == 0 { outcome.case.as_str() } else { "" };
            let met = f.met.map_or("", |met| if met { "met" } else { "**missed**" });
            text += &format!("| {case} | {} | {} | {} | {met} |\n", f.name, f.measured, f.goal);
        }
    }
    text + "\n![Answers that are right against the confidence stated](statistics-reliability.svg)\n"
}

/// Answers that are right against the confidence stated, with their intervals, and the line where both agree.
fn diagram(bins: &[Vec<Bin>; 2]) -> Result<String> {
    let mut series = vec![Series::new("as stated", Style::Dashed, vec![[0.0, 0.0], [100.0, 100.0]])];
    for (name, bins) in ["measured", "measured, little recorded"].into_iter().zip(bins) {
        let reported = || bins.iter().filter(|b| b.answers > 0);
        let percent = |(low, high): (f64, f64)| (100.0 * low, 100.0 * high);
        let points = reported().map(|b| [100.0 * b.reported, 100.0 * b.rate()]).collect();
        let errors = reported().map(|b| percent(b.interval())).collect();
        series.push(Series::new(name, Style::Points, points).with_errors(errors));
    }
    let plot = Plot {
        alt: "Answers that are right against the confidence stated".into(),
        x: Axis::linear("confidence stated in %"),
        y: Axis::linear("right in %"),
        series,
    };
    plot.to_svg().context("no answer has a confidence")
}

/// Runs everything on `count` seeds (400 otherwise).
pub(crate) fn run(first: u64, count: Option<usize>, only: Option<&str>) -> Result<Found> {
    let n = count.unwrap_or(SEEDS);
    let seeds: Vec<u64> = (0..n as u64).map(|i| first.wrapping_mul(7_368_787).wrapping_add(i)).collect();
    let mut outcomes = Vec::new();
    let mut case = |name: &str, work: &mut dyn FnMut() -> Result<Vec<Figure>>| -> Result<()> {
        if only.is_none_or(|o| name.contains(o)) {
            eprintln!("{name} ({n} seeds) …");
            outcomes.push(Outcome { case: name.to_owned(), figures: work()? });
        }
        Ok(())
    };
    case("identify, white noise", &mut || Ok(vec![identify::intervals(&seeds)?]))?;
    case("calibrate, white noise", &mut || Ok(vec![calibrated(&seeds, Noise::White)?]))?;
    case("calibrate, coloured noise", &mut || Ok(vec![calibrated(&seeds, Noise::Coloured(0.8))?]))?;
    case("nothing missing, white noise", &mut || nulls(&seeds, Noise::White))?;
    case("nothing missing, coloured noise", &mut || nulls(&seeds, Noise::Coloured(0.8)))?;
    let (mut rich, mut poor) = (Vec::new(), Vec::new());
    // Where little is recorded, what these recordings cannot tell apart is no error.
    let judged = |found: &[(Effect, Answer)], equals_count: bool| {
        found.iter().filter_map(|(_, a)| a.judged(equals_count)).collect::<Vec<_>>()
    };
    for (name, noise) in [
        ("one effect missing, noise of 0.3 to 5 %", (0.003, 0.05)),
        ("one effect missing, noise of 10 to 60 %", (0.1, 0.6)),
    ] {
        case(name, &mut || {
            let found = effects(&seeds, &EFFECTS, Plan::rich(noise))?;
            rich.extend(judged(&found, false));
            Ok(effect_figures(&found))
        })?;
    }
    case("one effect missing, little of it recorded", &mut || {
        let found = effects(&seeds, &[EFFECTS, LOOKALIKES].concat(), Plan::POOR)?;
        poor.extend(judged(&found, true));
        Ok(effect_figures(&found))
    })?;
    // Apart: the many sure answers of the one would hide what the other shows.
    let bins = [bins(&rich), bins(&poor)];
    for (name, bins) in ["confidence", "confidence, little recorded"].into_iter().zip(&bins) {
        if bins.iter().any(|b| b.answers > 0) {
            outcomes.push(Outcome { case: name.into(), figures: bin_figures(bins) });
        }
    }
    Ok(Found { outcomes, bins, seeds: n })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_the_markers_of_its_table() {
        assert!(greybox_dev::book::has_table(&greybox_dev::root(), PAGE, BEGIN));
    }

    #[test]
    fn confidence_is_honest_up_to_the_scatter_of_the_answers() {
        let answers = |right: usize, wrong: usize, confidence: f64| -> Vec<(f64, bool)> {
            let mut all = vec![(confidence, true); right];
            all.extend(vec![(confidence, false); wrong]);
            all
        };
        let bin = |answers: &[(f64, bool)]| bins(answers).into_iter().find(|b| b.answers > 0).unwrap();
        let good = bin(&answers(80, 20, 0.8));
        assert_eq!((good.low, good.high, good.answers, good.right), (0.7, 0.9, 100, 80));
        // Wilson's interval of 80 of 100.
        let (low, high) = good.interval();
        assert!((low - 0.7112).abs() < 1e-4 && (high - 0.8666).abs() < 1e-4, "{low} {high}");
        assert!(good.is_honest() && bin(&answers(95, 5, 0.8)).is_honest());
        assert!(!bin(&answers(60, 40, 0.8)).is_honest());
        // One wrong answer of one proves nothing, three do: 0.2³ = 0.008.
        assert!(bin(&answers(0, 1, 0.8)).is_honest() && !bin(&answers(0, 3, 0.8)).is_honest());
        assert_eq!(bin(&answers(3, 0, 1.0)).high, 1.0);
    }

    #[test]
    fn an_interval_that_holds_its_truth_is_counted() {
        let mut covered = Covered::default();
        for interval in [Some((0.9, 1.1)), Some((1.05, 1.2)), None] {
            covered.count(1.0, interval);
        }
        assert_eq!((covered.held, covered.all), (1, 2));
    }

    #[test]
    fn the_machine_moves_as_its_equation_says() {
        let mut random = Pcg64Mcg::seed_from_u64(1);
        let truth = [1.0, 0.6, 40.0];
        let recording = record(&mut random, &truth, None, (Noise::White, 0.0), (8, 400)).unwrap();
        let column = |name: &str| recording.channel(name).unwrap().values.clone();
        let (f, x) = (column("f"), column("x"));
        // Central differences, whose error is dt²/12 times the fourth derivative.
        let (dt, size) = (0.01, f.iter().fold(0.0_f64, |a, b| a.max(b.abs())));
        for i in 1..399 {
            let (rate, bend) =
                ((x[i + 1] - x[i - 1]) / (2.0 * dt), (x[i + 1] - 2.0 * x[i] + x[i - 1]) / (dt * dt));
            assert!((bend + 0.6 * rate + 40.0 * x[i] - f[i]).abs() < 0.01 * size, "sample {i}");
        }
    }
}
