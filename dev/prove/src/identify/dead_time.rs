//! Machines whose inputs act late, each by a dead time of its own.

use anyhow::{Context, Result};
use greybox_identify::{DeadTime, Library, Monomials, Options, Quiet, identify};
use greybox_model::Hold;
use rayon::prelude::*;

use super::machines::{self, Machine, SPRING, STEP};
use super::{FEW, Trial, Truth, compare};
use crate::{Figure, Outcome};

/// What the names of these cases begin with.
pub(super) const PREFIX: &str = "dead time: ";

/// Longest dead time looked for, s.
const LONGEST: f64 = 0.3;

/// A dead time found, in samples.
struct Late {
    /// Its error.
    error: f64,
    /// Half of its 95 % interval over 1.96.
    standard_error: f64,
    /// Whether the interval holds the truth.
    is_covered: bool,
}

/// Identifies over seeds; `machine.late` are the true dead times.
fn run(
    seeds: &[u64],
    machine: &Machine,
    options: &Options,
    truth: &[Truth<'_>],
) -> Result<Vec<(Trial, Vec<Late>)>> {
    let options = Options {
        dead_times: options
            .inputs
            .iter()
            .map(|input| DeadTime { input: input.clone(), longest: Some(LONGEST) })
            .collect(),
        ..options.clone()
    };
    let one = |seed: u64| -> Result<(Trial, Vec<Late>)> {
        let recordings = [machine.record(seed)?];
        let found = identify(&recordings, &recordings, &options, &Quiet)?;
        let late = options.inputs.iter().zip(&machine.late).map(|(input, tenths)| {
            let truth = *tenths as f64 / 10.0;
            let dead_time = found.dead_times.iter().find(|d| d.input == *input);
            let interval = dead_time.and_then(|d| d.ci95).map(|(low, high)| (low / STEP, high / STEP));
            let value = dead_time.map_or(f64::NAN, |d| d.value / STEP);
            Late {
                error: value - truth,
                // Towards zero an interval may be cut.
                standard_error: interval.map_or(f64::NAN, |(_, high)| (high - value) / 1.96),
                is_covered: interval.is_some_and(|(low, high)| low <= truth && truth <= high),
            }
        });
        Ok((compare(&found, truth, None), late.collect()))
    };
    seeds.par_iter().map(|&seed| one(seed).with_context(|| format!("seed {seed}"))).collect()
}

/// Root mean square.
fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(s, n), v| (s + v * v, n + 1.0));
    (sum / n).sqrt()
}

/// `limits`: the largest root mean square error of each dead time, samples.
fn figures(runs: Vec<(Trial, Vec<Late>)>, limits: &[f64]) -> Vec<Figure> {
    let (trials, late): (Vec<Trial>, Vec<Vec<Late>>) = runs.into_iter().unzip();
    let mut figures = machines::figures(&trials);
    let all = || late.iter().flatten();
    let (covered, n) = (all().filter(|l| l.is_covered).count(), all().count());
    let rate = 100.0 * covered as f64 / n as f64;
    // Two standard deviations of the count, and two per cent; of few seeds only gross misses are judged.
    let least = if late.len() < FEW { 0.0 } else { 93.0 - 2.0 * (95.0 * 5.0 / n as f64).sqrt() };
    figures.push(Figure::judged(
        "95 % intervals of the dead time that hold the truth",
        format!("{rate:.1} % of {n}"),
        format!(">= {least:.0} %"),
        rate >= least,
    ));
    let errors: Vec<f64> =
        (0..limits.len()).map(|i| rms(late.iter().filter_map(|l| l.get(i)).map(|l| l.error))).collect();
    // The root mean square of n errors scatters by 1 / √(2n) of itself.
    let slack = 1.0 + 3.0 / (2.0 * late.len() as f64).sqrt();
    let met = errors.iter().zip(limits).all(|(e, limit)| *e <= limit * slack);
    let text = |values: &[f64]| values.iter().map(|v| format!("{v:.3}")).collect::<Vec<_>>().join(", ");
    figures.push(Figure::judged(
        "error of the dead time (root mean square), samples",
        text(&errors),
        format!("<= {}", text(limits)),
        met,
    ));
    let stated: Vec<f64> = (0..limits.len())
        .map(|i| rms(late.iter().filter_map(|l| l.get(i)).map(|l| l.standard_error)))
        .collect();
    figures.push(Figure::plain("its standard error as reported, samples", text(&stated)));
    figures
}

/// What is asked of the mass on a spring.
fn spring_options(hold: Hold) -> Options {
    Options {
        library: Library { monomials: Monomials::TotalDegree, constant: true, ..Library::default() },
        order: 3,
        hold: Some(hold),
        replicates: 0,
        ..Options::new(&["x"], &["f"])
    }
}

/// The mass on a stiffening spring, its force `late` tenths of a sample late.
pub(super) fn spring_case(seeds: &[u64], late: usize, held: bool, limit: f64) -> Result<Vec<Figure>> {
    let machine = machines::spring().delayed(&[late], held);
    let options = spring_options(if held { Hold::Zero } else { Hold::Linear });
    let truth = Truth { input: Some("f"), terms: &SPRING };
    Ok(figures(run(seeds, &machine, &options, &[truth])?, &[limit]))
}

/// Two masses, each with a force of its own dead time.
pub(super) fn chain_case(seeds: &[u64], late: [usize; 2], limits: [f64; 2]) -> Result<Vec<Figure>> {
    let driven = [0, 1];
    let machine = machines::chain(2, &driven).delayed(&late, false);
    let terms = machines::chain_terms(2, &driven);
    let terms: Vec<Vec<(&str, f64)>> =
        terms.iter().map(|t| t.iter().map(|(name, v)| (name.as_str(), *v)).collect()).collect();
    let truths: Vec<Truth<'_>> =
        ["f1", "f2"].iter().zip(&terms).map(|(input, terms)| Truth { input: Some(input), terms }).collect();
    Ok(figures(run(seeds, &machine, &machines::chain_options(2, &driven), &truths)?, &limits))
}

/// The rows as a table of the book.
pub(super) fn table(outcomes: &[Outcome]) -> String {
    let mut text = "| machine | terms and inputs exact | 95 % intervals of the coefficients that hold the truth | of the \
                    dead times | error of the dead times, samples | as reported |\n| --- | --- | --- | --- | --- | --- |\n"
        .to_string();
    for outcome in outcomes {
        let Some(name) = outcome.case.strip_prefix(PREFIX) else { continue };
        let measured: Vec<&str> = outcome.figures.iter().map(|f| f.measured.as_str()).collect();
        text += &format!("| {name} | {} |\n", measured.join(" | "));
    }
    text
}
