//! From a finished [`Identification`] to the report's types: units, names and order change here, nothing is
//! decided.

use std::sync::Arc;

use greybox_calibrate::HoldoutSource;
use greybox_identify::{FoundDeadTime, FoundDelay, FoundEquation, Identification, Role as RoleRun};
use greybox_model::{Hold, Model, Unit, WriteOptions};
use greybox_recording::Recording;

use super::{
    coherent, correlations, health_findings, interval, names, recordings, residual, scores, spectra,
    state_map, times,
};
use crate::contract::{
    Criterion, Finding, Fit, FitSet, InputHold, ModelId, Ordered, Producer, RecordingFit, Severity,
};
use crate::format;
use crate::identified::{
    Blocks, DeadTime, Delay, Doubtful, Equation, IdentifyReport, Order, OrderValue, Term, Variable,
    VariableRole,
};
use crate::page::{self, IdentifyPage, Residual};
use crate::sentence;

/// What the conversion needs beside the identification.
#[derive(Debug, Clone, Copy)]
pub struct Sources<'a> {
    /// Training recordings.
    pub train: &'a [Recording],
    /// Held-out recordings.
    pub holdout: &'a [Recording],
    /// The hold of the inputs as given; none: it was looked for.
    pub hold: Option<Hold>,
}

/// File name of the model that an identification writes.
pub const MODEL_FILE: &str = "model.toml";

/// The contract's report.
pub fn report(found: &Identification, sources: &Sources<'_>) -> IdentifyReport {
    let channels = names(&found.train.data);
    let variables = variables(&found.model, sources);
    let units = units_stated(&variables);
    let mut report = IdentifyReport {
        greybox: Producer::this(found.seed),
        model: ModelId { name: found.model.name.clone(), file: MODEL_FILE.to_owned() },
        summary: Vec::new(),
        equations: found
            .equations
            .iter()
            .zip(&found.model.equations)
            .map(|(e, written)| (e.state.clone(), equation(e, written, &found.model, units)))
            .collect(),
        variables,
        order: Order {
            chosen: found.order.chosen,
            criterion: found.order.criterion.to_owned(),
            by_order: found
                .order
                .by_order
                .iter()
                .map(|&(order, value)| OrderValue { order, value })
                .collect(),
        },
        delay: found.delays.iter().map(|d| (d.state.clone(), delay(d, &found.model, units))).collect(),
        dead_time: found.dead_times.iter().map(|d| (d.input.clone(), dead_time(d))).collect(),
        fit: fit(found),
        blocks: found.blocks.map(|b| Blocks {
            blocks: b.blocks,
            samples: b.samples,
            lost: b.lost,
            passes: b.passes,
            settled: b.settled,
        }),
        noise_floor: channels.iter().cloned().zip(found.noise_floor.iter().copied()).collect(),
        misfit: channels.into_iter().zip(found.misfit.iter().copied()).collect(),
        inputs: found
            .model
            .inputs
            .iter()
            .map(|input| {
                let hold = InputHold {
                    hold_given: sources.hold.map_or_else(String::new, |hold| hold.name().to_owned()),
                    hold_best: input.hold.name().to_owned(),
                };
                (input.name.clone(), hold)
            })
            .collect(),
        findings: health_findings(&found.model, sources.train.iter().chain(sources.holdout)),
    };
    report.findings.extend(report.blocks.iter().flat_map(blocks));
    report.findings.extend(found.limited.then(limit));
    report.findings.extend(found.without_effect.iter().map(|input| without_effect(input)));
    report.summary = sentence::identified::summary(&report);
    report
}

/// The search ended before its end.
fn limit() -> Finding {
    Finding {
        severity: Severity::Warning,
        code: "limit".to_owned(),
        recording: None,
        channel: None,
        message: "the search ended at its limit of work: the terms were not all tried, and the fit may be unfinished"
            .to_owned(),
        help: Some("give it more with `--work`, a smaller library, or the input that drives the machine".to_owned()),
    }
}

/// An input whose dead time was asked for enters no equation.
fn without_effect(input: &str) -> Finding {
    Finding {
        severity: Severity::Warning,
        code: "dead_time".to_owned(),
        recording: None,
        channel: Some(input.to_owned()),
        message: format!("no equation has the input {input}, so that there is no dead time of it"),
        help: Some(format!("if it does act, allow a longer dead time with `--dead-time {input}=SECONDS`")),
    }
}

/// What reading in blocks means for the report.
fn blocks(found: &Blocks) -> Vec<Finding> {
    let finding = |severity, code: &str, message: String, help: Option<&str>| Finding {
        severity,
        code: code.to_owned(),
        recording: None,
        channel: None,
        message,
        help: help.map(str::to_owned),
    };
    let Blocks { blocks, samples, lost, passes, settled } = *found;
    let read = format!(
        "the equations were fitted to {samples} samples in {blocks} blocks, read {passes} times; training figures and \
         plots show the first block"
    );
    let mut out = vec![finding(Severity::Info, "blocks", read, None)];
    if lost > 0 {
        let message =
            format!("the model cannot be simulated on blocks with {lost} samples, which were left out");
        let help = "look at these stretches: a channel may be missing there, or another physics at work";
        out.push(finding(Severity::Warning, "lost_blocks", message, Some(help)));
    }
    if !settled {
        let message = "the choice of terms still changed in the last pass over the blocks".to_owned();
        let help =
            "the recordings do not settle it: look at the doubtful terms, or ask for a smaller library";
        out.push(finding(Severity::Warning, "unsettled", message, Some(help)));
    }
    out
}

/// Unit of a parameter; none where the recordings leave it open.
fn unit_of<'a>(model: &'a Model, parameter: &str) -> Option<&'a Unit> {
    model.parameter(parameter).and_then(|index| model.parameters[index].unit.as_ref())
}

/// Whether every state and input has a unit in the recordings. Where one has none, its unit counts as 1 in the
/// model, but the unit of a coefficient cannot be said.
fn units_stated(variables: &Ordered<Variable>) -> bool {
    variables.values().all(|variable| !variable.channel_unit.is_empty())
}

fn equation(
    found: &FoundEquation,
    written: &greybox_model::Equation,
    model: &Model,
    units: bool,
) -> Equation {
    let terms = found
        .terms
        .iter()
        .map(|term| {
            let unit = unit_of(model, &term.parameter);
            let factor = unit.map_or(1.0, |u| u.factor);
            let own = model.parameter(&term.parameter).is_some() && term.parameter != DELAY_GAIN;
            Term {
                expression: term.expression.clone(),
                powers: term.powers.iter().cloned().collect(),
                parameter: own.then(|| term.parameter.clone()),
                value: term.value / factor,
                ci95: interval(term.ci95, |v| v / factor),
                unit: unit.filter(|_| units).map(|u| u.text.clone()),
                inclusion: term.inclusion,
            }
        })
        .collect();
    let doubtful = found
        .doubtful
        .iter()
        .map(|term| Doubtful {
            expression: term.expression.clone(),
            chosen: term.chosen,
            inclusion: term.inclusion,
        })
        .collect();
    Equation { input: found.input.clone(), expression: written.to_string(), terms, doubtful }
}

/// States and inputs, with the unit of their channel and the one in which the equations count.
fn variables(model: &Model, sources: &Sources<'_>) -> Ordered<Variable> {
    let entry = |name: &str, channel: &str, unit: &Unit, role: VariableRole| {
        let stated = sources.train.iter().find_map(|r| r.channel(channel)?.unit.clone());
        let variable = Variable {
            role,
            unit: stated.as_ref().map_or_else(String::new, |_| coherent(unit)),
            channel_unit: stated.unwrap_or_default(),
        };
        (name.to_owned(), variable)
    };
    let states = model
        .states
        .iter()
        .filter_map(|s| Some(entry(&s.name, s.channel.as_deref()?, &s.unit, VariableRole::State)));
    let inputs = model.inputs.iter().map(|i| entry(&i.name, &i.channel, &i.unit, VariableRole::Input));
    states.chain(inputs).collect()
}

fn delay(found: &FoundDelay, model: &Model, units: bool) -> Delay {
    let gain_unit = unit_of(model, DELAY_GAIN);
    let factor = gain_unit.map_or(1.0, |u| u.factor);
    let mut delay = Delay {
        value: found.value,
        ci95: interval(found.ci95, |v| v),
        unit: "s".to_owned(),
        bound: found.bound,
        gain: found.gain / factor,
        gain_ci95: interval(found.gain_ci95, |v| v / factor),
        gain_unit: gain_unit.filter(|_| units).map(|u| u.text.clone()),
        correlation: found.correlation,
        warning: None,
    };
    delay.warning = sentence::identified::delay_warning(&delay);
    delay
}

fn dead_time(found: &FoundDeadTime) -> DeadTime {
    let mut dead_time = DeadTime {
        parameter: found.parameter.clone(),
        value: found.value,
        ci95: interval(found.ci95, |v| v),
        unit: "s".to_owned(),
        bound: found.bound,
        longest: found.longest,
        warning: None,
    };
    dead_time.warning = sentence::identified::dead_time_warning(&found.input, &dead_time);
    dead_time
}

/// Names of the feedback's gain and delay in the identified model.
const DELAY_GAIN: &str = "kp";
const DELAY: &str = "tau";

/// The identified model alone: it stands where a diagnosis has its improved one.
fn fit_set(role: &RoleRun, of: &[greybox_calibrate::Score]) -> FitSet {
    FitSet { improved: scores(&role.data, of), ..FitSet::default() }
}

fn fit(found: &Identification) -> Fit {
    let by_recording = |role: &RoleRun| -> Vec<(String, FitSet)> {
        let sets = role.by_recording.iter().map(|of| fit_set(role, of));
        role.data.recordings.iter().cloned().zip(sets).collect()
    };
    let mut by_name: Ordered<RecordingFit> = Ordered::new();
    for (name, set) in by_recording(&found.train) {
        by_name.entry(name).or_default().train = Some(set);
    }
    for (name, set) in found.holdout.iter().flat_map(by_recording) {
        by_name.entry(name).or_default().holdout = Some(set);
    }
    Fit {
        train: fit_set(&found.train, &found.train.scores),
        holdout: found.holdout.as_ref().map(|role| fit_set(role, &role.scores)).unwrap_or_default(),
        window_s: Some(found.window),
        criterion: Criterion::FreeRun,
        holdout_source: match (&found.holdout, found.holdout_source) {
            (Some(role), source) => super::held_out(source, &role.data.recordings),
            (None, HoldoutSource::LastFifth) => super::held_out(HoldoutSource::LastFifth, &[]),
            (None, _) => "none: the recordings are too short to hold anything out".to_owned(),
        },
        recordings: by_name,
    }
}

/// The identified model in the model language, each coefficient with its interval.
pub fn model_toml(found: &Identification) -> String {
    let terms = found.equations.iter().flat_map(|e| &e.terms);
    let coefficients = terms.filter(|t| t.parameter != DELAY_GAIN).map(|t| (t.parameter.as_str(), t.ci95));
    let feedback = found.delays.iter().flat_map(|d| [(DELAY_GAIN, d.gain_ci95), (DELAY, d.ci95)]);
    let comments: Vec<(String, String)> = coefficients
        .chain(feedback)
        .chain(found.dead_times.iter().map(|d| (d.parameter.as_str(), d.ci95)))
        .filter_map(|(name, ci95)| {
            let factor = unit_of(&found.model, name).map_or(1.0, |u| u.factor);
            let ci = interval(ci95, |v| v / factor)?;
            let (low, high) = (format::significant(ci.low, 4), format::significant(ci.high, 4));
            Some((name.to_owned(), format!("95 % interval {low} to {high}")))
        })
        .collect();
    found.model.to_toml(&WriteOptions { original: None, comments: &comments })
}

/// The page: the report and what its plots show.
pub fn page(found: &Identification, report: IdentifyReport) -> IdentifyPage {
    let roles =
        [Some((&found.train, page::Role::Train)), found.holdout.as_ref().map(|h| (h, page::Role::Holdout))];
    let states: Vec<&str> = found.equations.iter().map(|e| e.state.as_str()).collect();
    IdentifyPage {
        title: format!("Equations of {}", sentence::joined(&states, "and")),
        recordings: roles
            .into_iter()
            .flatten()
            .flat_map(|(role, kind)| {
                recordings(&role.data, &found.model, kind, [None, None, Some(&role.run)])
            })
            .collect(),
        residuals: residuals(found),
        model_text: model_toml(found),
        report,
    }
}

/// Residuals of the free runs on the training recordings, per channel.
fn residuals(found: &Identification) -> Vec<Residual> {
    let data = Arc::as_ref(&found.train.data);
    let run = &found.train.run;
    (0..data.recordings.len())
        .flat_map(|r| data.channels.iter().enumerate().map(move |(c, info)| (r, c, info)))
        .map(|(r, c, info)| {
            let after = residual(data, run, r, c, info.unit.factor);
            let noise_sigma = data.sigma[c] / info.unit.factor;
            Residual {
                recording: data.recordings[r].clone(),
                channel: info.name.clone(),
                unit: info.unit.text.clone(),
                t: times(data, r),
                spectrum: spectra(data, r, &[], &after, noise_sigma),
                map: state_map(&found.model, data, [run, run], r, c),
                correlations: correlations(&found.model, data, [None, Some(run)], r, c),
                before: Vec::new(),
                after,
                noise_sigma,
                windows: Vec::new(),
            }
        })
        .collect()
}
