//! From a finished [`Diagnosis`] to the report's types: units, names and order change here, nothing is
//! decided. [`identification`] does the same for a finished identification.

pub mod control;
pub mod identification;

use greybox_calibrate::{Data, FreeRun, HoldoutSource, Setup, input_noise};
use greybox_diagnose::diagnosis::{
    Basis as Ground, Estimate as Estimated, IdentifiedMechanism, Role as RoleRuns, Run,
};
use greybox_diagnose::library::Excitation;
use greybox_diagnose::locate::{Location as Located, spectrum};
use greybox_diagnose::proposal::{self, Proposal};
use greybox_diagnose::{Calibration, Diagnosis, Verdict as Answer};
use greybox_model::{Dimension, Expr, Func, Model, Unit, WriteOptions};
use greybox_recording::{Correlation, Recording, health};

use crate::contract::*;
use crate::page::{self, Lagged, MechanismPlot, ModelTexts, Page, Residual, Spectrum, StateMap};
use crate::suggest::{self, InputRange, Reach, Subject};

/// What the conversion needs beside the diagnosis.
pub struct Sources<'a> {
    /// File name of the model.
    pub model_file: &'a str,
    /// Text of the model file.
    pub model_text: &'a str,
    /// Training recordings.
    pub train: &'a [Recording],
    /// Held-out recordings.
    pub holdout: &'a [Recording],
}

/// The contract's report.
pub fn report(diagnosis: &Diagnosis, sources: &Sources<'_>) -> Report {
    let d = diagnosis;
    let reach = reach(d);
    let plan = remainder_plan(d, &reach);
    let mut report = Report {
        greybox: Producer::this(d.seed),
        model: ModelId { name: d.nominal.name.clone(), file: sources.model_file.to_string() },
        samples: Samples { train: d.train.data.samples(), holdout: d.holdout.data.samples() },
        verdict: match d.verdict {
            Answer::Consistent => Verdict::Consistent,
            Answer::MissingPhysics => Verdict::MissingPhysics,
            Answer::Unexplained => Verdict::Unexplained,
        },
        summary: Vec::new(),
        terms_only: d.terms_only,
        basis: match d.basis {
            Ground::Named => Basis::Named,
            Ground::NamedAndProposed => Basis::NamedAndProposed,
            Ground::Proposed => Basis::Proposed,
            Ground::Calibrated => Basis::Calibrated,
        },
        mechanisms: d.mechanisms.iter().map(|m| mechanism(m, &d.improved, &reach)).collect(),
        candidates: d.candidates.iter().map(|m| mechanism(m, &d.improved, &reach)).collect(),
        closure: d.proposal.as_ref().map(closure),
        closure_rejected: d.rejected.as_ref().map(closure_rejected),
        subsets: d
            .subsets
            .iter()
            .map(|s| Subset { mechanisms: s.mechanisms.clone(), residual_share: s.left })
            .collect(),
        remainder: Remainder {
            significant: d.remainder.significant,
            location: location(&d.remainder.location, &d.nominal),
            share_of_residual: d.remainder.share_of_residual,
            experiment: plan.as_ref().map(|plan| plan.text.clone()),
            experiment_plan: plan,
        },
        parameters: parameters(d),
        fit: fit(d),
        noise_floor: names(&d.train.data).into_iter().zip(d.noise_floor.iter().copied()).collect(),
        inputs: d
            .nominal
            .inputs
            .iter()
            .zip(&d.holds)
            .map(|(input, (given, best))| {
                let hold =
                    InputHold { hold_given: given.name().to_string(), hold_best: best.name().to_string() };
                (input.name.clone(), hold)
            })
            .collect(),
        findings: findings(d, sources),
    };
    report.summary = crate::sentence::summary(&report);
    report
}

fn names(data: &Data) -> Vec<String> {
    data.channels.iter().map(|c| c.name.clone()).collect()
}

/// An interval in SI as one in the unit that `told` converts to.
fn interval(ci: Option<(f64, f64)>, reported: impl Fn(f64) -> f64) -> Option<Interval> {
    ci.map(|(low, high)| {
        let (a, b) = (reported(low), reported(high));
        Interval { low: a.min(b), high: a.max(b) }
    })
}

fn equation_names(list: &[String]) -> Names {
    match list {
        [one] => Names::One(one.clone()),
        many => Names::Many(many.to_vec()),
    }
}

fn some_names(list: &[String]) -> Option<Names> {
    (!list.is_empty()).then(|| equation_names(list))
}

/// What the training recordings reach.
fn reach(d: &Diagnosis) -> Reach {
    let data = &d.train.data;
    // What can be driven: no known constants, and no derivatives of other inputs.
    let drives = |u: usize| data.input_moves(u) && d.nominal.inputs[u].derivative_of().is_none();
    let inputs = d.nominal.inputs.iter().enumerate().filter(|(u, _)| drives(*u)).map(|(u, input)| {
        let values = || data.pieces.iter().filter_map(move |p| p.inputs.get(u)).flatten();
        let known = || values().filter(|v| v.is_finite());
        let count = known().count().max(1) as f64;
        let ends = known().fold(None, |ends: Option<[f64; 2]>, v| {
            Some(ends.map_or([*v, *v], |[low, high]| [low.min(*v), high.max(*v)]))
        });
        let reached = ends.unwrap_or([0.0, 0.0]);
        let shown = |v: f64| input.unit.from_si(v);
        InputRange {
            name: input.name.clone(),
            unit: input.unit.text.clone(),
            rms: (known().map(|v| shown(*v).powi(2)).sum::<f64>() / count).sqrt(),
            reached: reached.map(shown),
            stated: stated(&d.nominal, u, reached).map(|ends| ends.map(shown)),
        }
    });
    let mut coordinates = Ordered::new();
    let mut first = 0;
    for state in &d.improved.states {
        let mut range = [f64::INFINITY, f64::NEG_INFINITY];
        for (piece, x) in data.pieces.iter().zip(&d.train.improved.run.x) {
            for v in x.iter().skip(first * piece.len).take(piece.len) {
                range = [range[0].min(*v), range[1].max(*v)];
            }
        }
        if range[0] < range[1] && range.iter().all(|v| v.is_finite()) {
            coordinates.insert(state.name.clone(), range);
        }
        first += state.order;
    }
    Reach { inputs: inputs.collect(), coordinates, dt: data.pieces.iter().map(|p| p.dt).fold(0.0, f64::max) }
}

/// How far the actuator of an input goes as the model has it: as stated, else up to where the equations limit it, or as
/// far as it was seen to go. Nothing where the model says neither.
fn stated(model: &Model, input: usize, reached: [f64; 2]) -> Option<[f64; 2]> {
    let input = &model.inputs[input];
    if input.range.is_some() {
        return input.range;
    }
    let mut limits = None;
    for equation in &model.equations {
        for side in [&equation.lhs, &equation.rhs] {
            side.walk(&mut |e| {
                let found = limited(model, &input.name, e).filter(|ends| ends.iter().any(|v| v.is_finite()));
                // What stands outside limits most.
                limits = limits.or(found);
            });
        }
    }
    let [low, high] = limits?;
    let end = |limit: f64, reached: f64, further: fn(f64, f64) -> f64| {
        if limit.is_finite() { further(limit, reached) } else { reached }
    };
    Some([end(low, reached[0], f64::min), end(high, reached[1], f64::max)])
}

/// The ends of an expression that is nothing but an input with limits.
fn limited(model: &Model, input: &str, e: &Expr) -> Option<[f64; 2]> {
    let number = |e: &Expr| {
        e.eval(&|name, _| model.parameter(name).map(|p| model.parameters[p].value)).filter(|v| v.is_finite())
    };
    let ends = match e {
        Expr::Var { name, primes: 0 } if **name == *input => [f64::NEG_INFINITY, f64::INFINITY],
        Expr::Call(Func::Saturate, args) => {
            let [low, high] = limited(model, input, args.first()?)?;
            let limit = number(args.get(1)?)?;
            [low.max(-limit), high.min(limit)]
        }
        Expr::Call(of @ (Func::Min | Func::Max), args) => {
            let (a, b) = (args.first()?, args.get(1)?);
            let ([low, high], limit) = match limited(model, input, a) {
                Some(ends) => (ends, number(b)?),
                None => (limited(model, input, b)?, number(a)?),
            };
            if *of == Func::Min {
                [low.min(limit), high.min(limit)]
            } else {
                [low.max(limit), high.max(limit)]
            }
        }
        _ => return None,
    };
    (ends[0] < ends[1]).then_some(ends)
}

/// The input that stands in the first of these equations that has one.
fn reaching<'a>(model: &'a Model, equations: &[String]) -> Option<&'a str> {
    equations.iter().filter_map(|name| model.equation(name)).find_map(|e| {
        let residual = model.equations[e].residual();
        model.inputs.iter().map(|i| i.name.as_str()).find(|name| residual.mentions(name))
    })
}

fn remainder_plan(d: &Diagnosis, reach: &Reach) -> Option<Experiment> {
    let shape = d.remainder.shape.as_ref()?;
    let input = reaching(&d.nominal, &d.remainder.location.equations);
    Some(suggest::for_remainder(&location(&d.remainder.location, &d.nominal), input, reach, shape))
}

/// The experiment that separates a mechanism from its alternatives, if it has any.
fn plan(found: &IdentifiedMechanism, improved: &Model, reach: &Reach) -> Option<Experiment> {
    let reported = found.alternatives.iter().find(|a| !a.separate.is_empty());
    let alternative = reported.or(found.alternatives.first())?;
    let value = |name: &str| {
        // In the model a name may carry the equation's behind it.
        let is =
            |given: &str| given == name || given.strip_prefix(name).is_some_and(|rest| rest.starts_with('_'));
        let parameters = found.parameters.iter().map(|(n, _, e)| (n, e));
        let figures = found.figures.iter().map(|(n, e)| (n, e));
        parameters.chain(figures).find(|(n, _)| is(n)).map(|(_, e)| e.value)
    };
    // A threshold of an input is reported in the input's unit.
    let input = found.input.as_deref().or_else(|| reaching(improved, &found.equations));
    let unit = found.input.as_ref().and_then(|n| improved.input(n)).map(|i| &improved.inputs[i].unit);
    let of_input = |v: f64| unit.map_or(v, |u| u.from_si(v));
    let drive = |stated: &Option<Excitation>| {
        Some(match stated.as_ref()?.evaluated(&value)? {
            Excitation::Ramp(v) => Excitation::Ramp(of_input(v)),
            Excitation::Beyond(v) => Excitation::Beyond(of_input(v)),
            other => other,
        })
    };
    let location = location(&found.location, improved);
    Some(suggest::experiment(
        &Subject {
            own: drive(&found.excitation),
            alternative: drive(&alternative.excitation),
            input,
            location: &location,
            separate: &alternative.separate,
        },
        reach,
    ))
}

/// The SI unit in which the equations count what is recorded in `unit`.
fn coherent(unit: &Unit) -> String {
    if unit.factor == 1.0 && unit.offset == 0.0 {
        return unit.text.clone();
    }
    // An angle has no dimension, but its unit has a name.
    if unit.dimension.is_none() && ["deg", "°"].contains(&unit.text.as_str()) {
        return "rad".to_owned();
    }
    Unit::si(unit.dimension).text
}

/// The SI unit of a state, an input or a sum of them where the model states its variable in another unit, which a
/// reader would take the number for.
fn converted(expression: &str, model: &Model) -> Option<String> {
    let plain = |token: &&str| token.starts_with(|c: char| c.is_alphabetic()) && *token != "abs";
    let first = crate::expression::tokens(expression).into_iter().find(plain)?;
    let name = first.trim_end_matches('\'');
    let state = model.states.iter().find(|s| s.name == name).map(|s| &s.unit);
    let unit = state.or_else(|| model.inputs.iter().find(|i| i.name == name).map(|i| &i.unit))?;
    if (unit.factor == 1.0 && unit.offset == 0.0) || expression.contains(['*', '/', '^']) {
        return None;
    }
    let primes = (first.len() - name.len()) as u8;
    let declared = model.units.iter().any(|d| d.symbol == unit.text);
    let angle = unit.dimension.is_none() && unit.text != "%" && !declared;
    Some(if angle {
        control::per_second("rad", primes)
    } else {
        Unit::si(unit.dimension / Dimension::TIME.pow(f64::from(primes))).text
    })
}

/// The unit of a figure that follows from the parameters: frequencies in Hz, damping ratios are pure.
fn figure_unit(name: &str) -> &'static str {
    let is = |base: &str| name == base || name.strip_prefix(base).is_some_and(|rest| rest.starts_with('_'));
    if is("f0") {
        "Hz"
    } else if is("zeta") {
        "1"
    } else {
        ""
    }
}

fn mechanism(found: &IdentifiedMechanism, improved: &Model, reach: &Reach) -> Mechanism {
    let figures =
        found.figures.iter().map(|(name, e)| (name.clone(), estimate(e, figure_unit(name).to_owned())));
    Mechanism {
        kind: found.kind.clone(),
        family: found.family.clone(),
        equation: equation_names(&found.equations),
        channel: found.channel.clone(),
        expression: found.expression.clone(),
        replaces: found.input.clone(),
        states: found.states.iter().cloned().collect(),
        drifting: found.drifting.clone(),
        parameters: found
            .parameters
            .iter()
            .map(|(name, index, e)| {
                let unit = improved
                    .parameters
                    .get(*index)
                    .and_then(|p| p.unit.as_ref())
                    .map_or_else(String::new, |u| u.text.clone());
                (name.clone(), estimate(e, unit))
            })
            .chain(figures)
            .collect(),
        share_explained: found.share_explained,
        confidence: found.confidence,
        alternatives: found
            .alternatives
            .iter()
            .map(|a| Alternative {
                kind: a.kind.clone(),
                confidence: a.confidence,
                equivalent: a.equivalent,
                expression: (!a.expression.is_empty()).then(|| a.expression.clone()),
                separate: (!a.separate.is_empty()).then(|| a.separate.clone()),
                equation: some_names(&a.site.equations),
                channel: some_names(&a.site.channels),
                replaces: a.site.input.clone(),
                drifting: a.site.drifting.clone(),
            })
            .collect(),
        experiment: plan(found, improved, reach),
        location: location(&found.location, improved),
    }
}

fn closure(of: &Proposal) -> Closure {
    let range = |r: &proposal::Range| {
        (r.variable.clone(), Range { train: Interval::new(r.low, r.high), outside: r.outside })
    };
    let fold = |f: &proposal::Fold| Fold {
        recordings: f.recordings.clone(),
        window_s: interval(f.window, |t| t),
        calibrated: f.calibrated,
        improved: f.improved,
    };
    let correlated = |(law, with): &(String, proposal::Correlated)| {
        let with = Correlated { parameter: with.parameter.clone(), correlation: with.correlation };
        (law.clone(), with)
    };
    Closure {
        range: of.ranges.iter().map(range).collect(),
        outside: of.outside,
        cross_validation: of.folds.iter().map(fold).collect(),
        correlated_with: of.correlations.iter().map(correlated).collect(),
    }
}

fn closure_rejected(of: &proposal::Rejected) -> ClosureRejected {
    let gate = match of.gate {
        proposal::Gate::Clock => Gate::Clock,
        proposal::Gate::Determined => Gate::Determined,
        proposal::Gate::Training => Gate::Training,
        proposal::Gate::Inertia => Gate::Inertia,
        proposal::Gate::Parameters => Gate::Parameters,
        proposal::Gate::CrossValidation => Gate::CrossValidation,
        proposal::Gate::Comparison => Gate::Comparison,
        proposal::Gate::Names => Gate::Names,
    };
    let law = |law: &proposal::RejectedLaw| RejectedLaw {
        kind: law.kind.clone(),
        equation: equation_names(&law.equations),
        expression: law.expression.clone(),
    };
    ClosureRejected { gate, laws: of.laws.iter().map(law).collect() }
}

fn estimate(e: &Estimated, unit: String) -> Estimate {
    Estimate { value: e.value, ci95: interval(e.ci95, |v| v), unit }
}

fn location(l: &Located, model: &Model) -> Location {
    Location {
        equation: (!l.equations.is_empty()).then(|| equation_names(&l.equations)),
        windows_s: l
            .windows
            .iter()
            .map(|(file, w)| (file.clone(), w.iter().map(|(a, b)| Interval { low: *a, high: *b }).collect()))
            .collect(),
        region: l.region.iter().map(|(e, lo, hi)| (e.clone(), [*lo, *hi])).collect(),
        region_units: l
            .region
            .iter()
            .filter_map(|(e, ..)| converted(e, model).map(|unit| (e.clone(), unit)))
            .collect(),
        band_hz: l.band.map(|(a, b)| Interval { low: a, high: b }),
    }
}

fn parameters(d: &Diagnosis) -> Ordered<Parameter> {
    d.parameters
        .iter()
        .map(|p| {
            let parameter = &d.nominal.parameters[p.index];
            let reported = |si: f64| parameter.unit.as_ref().map_or(si, |u| u.from_si(si));
            let entry = Parameter {
                nominal: reported(p.nominal),
                value: reported(p.improved.value),
                ci95: interval(p.improved.ci95, reported),
                unit: parameter.unit.as_ref().map(|u| u.text.clone()),
                fixed: parameter.fixed,
                calibrated: Some(reported(p.calibrated.value)),
                calibrated_ci95: interval(p.calibrated.ci95, reported),
            };
            (parameter.name.clone(), entry)
        })
        .collect()
}

/// Scores by channel, in the units of the model; what a simulation that diverges has no value for is left out.
pub fn scores(data: &Data, scores: &[greybox_calibrate::Score]) -> Ordered<Score> {
    let finite = |v: f64| Some(v).filter(|v| v.is_finite());
    data.channels
        .iter()
        .zip(scores)
        .map(|(c, s)| {
            let score = Score {
                nrmse: s.nrmse,
                rmse: finite(s.rmse / c.unit.factor),
                nrmse_windowed: finite(s.nrmse_windowed),
                rmse_windowed: finite(s.rmse_windowed / c.unit.factor),
            };
            (c.name.clone(), score)
        })
        .collect()
}

fn fit_set(role: &RoleRuns, of: impl Fn(&Run) -> Vec<greybox_calibrate::Score>) -> FitSet {
    FitSet {
        nominal: scores(&role.data, &of(&role.nominal)),
        calibrated: scores(&role.data, &of(&role.calibrated)),
        improved: scores(&role.data, &of(&role.improved)),
    }
}

/// Where the held-out data come from, in words.
pub fn held_out(source: HoldoutSource, recordings: &[String]) -> String {
    match source {
        HoldoutSource::Given => format!("recordings held out: {}", recordings.join(", ")),
        HoldoutSource::LastFifth => "the last fifth of each recording".to_owned(),
        HoldoutSource::LastBlock => "the last block of the recordings".to_owned(),
        HoldoutSource::None => {
            "none: the recordings are too short to hold anything out; these are the training figures"
                .to_owned()
        }
    }
}

/// The figure that judges simulations, in the contract's words.
pub fn criterion(of: greybox_calibrate::Criterion) -> Criterion {
    match of {
        greybox_calibrate::Criterion::FreeRun => Criterion::FreeRun,
        greybox_calibrate::Criterion::Windowed => Criterion::Windowed,
    }
}

fn fit(d: &Diagnosis) -> Fit {
    let mut recordings: Ordered<RecordingFit> = Ordered::new();
    for (r, name) in d.train.data.recordings.iter().enumerate() {
        recordings.entry(name.clone()).or_default().train =
            Some(fit_set(&d.train, |run| run.by_recording[r].clone()));
    }
    for (r, name) in d.holdout.data.recordings.iter().enumerate() {
        recordings.entry(name.clone()).or_default().holdout =
            Some(fit_set(&d.holdout, |run| run.by_recording[r].clone()));
    }
    Fit {
        train: fit_set(&d.train, |run| run.scores.clone()),
        holdout: fit_set(&d.holdout, |run| run.scores.clone()),
        window_s: Some(d.window),
        criterion: criterion(d.criterion),
        holdout_source: held_out(d.holdout_source, &d.holdout.data.recordings),
        recordings,
    }
}

fn findings(d: &Diagnosis, sources: &Sources<'_>) -> Vec<Finding> {
    let mut out = Vec::new();
    for (i, (given, best)) in d.holds.iter().enumerate() {
        if given != best {
            let name = &d.nominal.inputs[i].name;
            out.push(Finding {
                severity: Severity::Warning,
                code: "hold".to_string(),
                recording: None,
                channel: Some(d.nominal.inputs[i].channel.clone()),
                message: format!(
                    "input `{name}` behaves as hold = \"{}\" between its samples, not \"{}\"",
                    best.name(),
                    given.name()
                ),
                help: Some(format!(
                    "state `hold = \"{}\"` for input `{name}`, as improved.toml does",
                    best.name()
                )),
            });
        }
    }
    if d.limited {
        out.push(Finding {
            severity: Severity::Warning,
            code: "limit".to_string(),
            recording: None,
            channel: None,
            message: "the search ended at its limit of work: more may be missing than was found, and other \
                      explanations were not all tried"
                .to_string(),
            help: Some("give it more with `--work`, or a shorter recording".to_string()),
        });
    }
    for &c in &d.unknown_noise {
        let channel = &d.train.data.channels[c].name;
        out.push(Finding {
            severity: Severity::Info,
            code: "noise".to_string(),
            recording: None,
            channel: Some(channel.clone()),
            message: format!(
                "the noise of `{channel}` is not known: the fast differences of the recording hold more than noise, \
                 and the noise floor is what the best model leaves"
            ),
            help: Some("record the channel at rest, or sample it faster".to_string()),
        });
    }
    // Of what is believed: terms that stand in for something else may fit the noise.
    let (model, run) = match d.basis {
        Ground::Named => (&d.improved, &d.train.improved.run),
        Ground::NamedAndProposed | Ground::Proposed | Ground::Calibrated => {
            (&d.calibrated, &d.train.calibrated.run)
        }
    };
    if let Ok(setup) = Setup::new(model, d.train.data.clone(), Vec::new()) {
        let found = input_noise::findings(&setup, &setup.values(), run, true);
        out.extend(found.into_iter().map(|f| health_finding(f, None)));
    }
    out.extend(health_findings(&d.nominal, sources.train.iter().chain(sources.holdout)));
    out
}

/// A finding of a recording in the words of the contract.
pub fn health_finding(f: greybox_recording::Finding, recording: Option<String>) -> Finding {
    Finding {
        severity: match f.severity {
            greybox_recording::Severity::Info => Severity::Info,
            greybox_recording::Severity::Warning => Severity::Warning,
            greybox_recording::Severity::Problem => Severity::Error,
        },
        code: f.code.to_string(),
        recording,
        channel: f.channel,
        message: f.message,
        help: f.help,
    }
}

/// What the health checks say about the channels that `model` uses, recording by recording.
pub fn health_findings<'a>(model: &Model, recordings: impl Iterator<Item = &'a Recording>) -> Vec<Finding> {
    let outputs: Vec<&str> = model.measurements.iter().map(|m| m.channel.as_str()).collect();
    let mut out = Vec::new();
    for recording in recordings {
        let inputs = model.input_columns(|name| recording.channel(name).is_some());
        for f in health::check(recording, &inputs, &outputs) {
            let used = f.channel.as_deref().is_none_or(|c| inputs.contains(&c) || outputs.contains(&c));
            if used {
                out.push(health_finding(f, Some(recording.name.clone())));
            }
        }
    }
    out
}

/// The improved model in the model language, with the user's comments kept and each new parameter
/// explained.
pub fn improved_toml(diagnosis: &Diagnosis, original: &str) -> String {
    let mut comments = Vec::new();
    let named = diagnosis.mechanisms.iter().map(|m| (m, "found by greybox"));
    let proposed = diagnosis.candidates.iter().map(|m| (m, "proposed by greybox, not named"));
    for (m, said) in named.chain(proposed) {
        for (name, _, e) in &m.parameters {
            let kind = crate::format::kind(&m.kind);
            let width = e.ci95.map_or_else(String::new, |(lo, hi)| {
                format!(
                    ", 95 % interval {} to {}",
                    crate::format::significant(lo, 4),
                    crate::format::significant(hi, 4)
                )
            });
            comments.push((name.clone(), format!("{kind}, {said}{width}")));
        }
    }
    diagnosis.improved.to_toml(&WriteOptions { original: Some(original), comments: &comments })
}

/// The page: the report and what its plots show.
pub fn page(diagnosis: &Diagnosis, report: Report, sources: &Sources<'_>) -> Page {
    let d = diagnosis;
    Page {
        title: if d.nominal.name.is_empty() {
            sources.model_file.to_string()
        } else {
            d.nominal.name.clone()
        },
        recordings: [(&d.train, page::Role::Train), (&d.holdout, page::Role::Holdout)]
            .into_iter()
            .flat_map(|(role, kind)| {
                let runs = [&role.nominal, &role.calibrated, &role.improved].map(|run| Some(&run.run));
                recordings(&role.data, &d.nominal, kind, runs)
            })
            .collect(),
        residuals: residuals(d),
        mechanism_plots: plots(d),
        models: ModelTexts {
            nominal: sources.model_text.to_string(),
            improved: improved_toml(d, sources.model_text),
        },
        report,
    }
}

/// Concatenates the pieces of one recording with a missing sample between them.
fn joined(data: &Data, recording: usize, of: impl Fn(usize) -> Vec<f64>) -> Vec<f64> {
    let mut out: Vec<f64> = Vec::new();
    for (i, piece) in data.pieces.iter().enumerate() {
        if piece.recording == recording {
            if !out.is_empty() {
                out.push(f64::NAN);
            }
            out.extend(of(i));
        }
    }
    out
}

fn times(data: &Data, recording: usize) -> Vec<f64> {
    let mut out: Vec<f64> = Vec::new();
    for piece in data.pieces.iter().filter(|p| p.recording == recording) {
        if let Some(last) = out.last().copied() {
            out.push(0.5 * (last + piece.start));
        }
        out.extend((0..piece.len).map(|k| piece.start + k as f64 * piece.dt));
    }
    out
}

fn output(data: &Data, run: &FreeRun, recording: usize, c: usize) -> Vec<f64> {
    joined(data, recording, |i| {
        let n = data.pieces[i].len;
        run.y[i][c * n..(c + 1) * n].iter().map(|v| data.channels[c].unit.from_si(*v)).collect()
    })
}

/// The recordings of one role with the free runs of the nominal, the calibrated and the improved model; one
/// that there is not leaves its series empty.
fn recordings(
    data: &Data,
    model: &Model,
    kind: page::Role,
    runs: [Option<&FreeRun>; 3],
) -> Vec<page::Recording> {
    (0..data.recordings.len())
        .map(|r| page::Recording {
            name: data.recordings[r].clone(),
            role: kind,
            t: times(data, r),
            holdout_from: None,
            channels: data
                .channels
                .iter()
                .enumerate()
                .map(|(c, info)| {
                    let [nominal, calibrated, improved] =
                        runs.map(|run| run.map_or_else(Vec::new, |run| output(data, run, r, c)));
                    page::Channel {
                        name: info.name.clone(),
                        unit: info.unit.text.clone(),
                        measured: joined(data, r, |i| {
                            data.pieces[i].measured[c].iter().map(|v| info.unit.from_si(*v)).collect()
                        }),
                        nominal,
                        calibrated,
                        improved,
                    }
                })
                .collect(),
            inputs: model
                .inputs
                .iter()
                .enumerate()
                .map(|(u, input)| page::Input {
                    name: input.name.clone(),
                    unit: input.unit.text.clone(),
                    values: joined(data, r, |i| {
                        data.pieces[i].inputs[u].iter().map(|v| input.unit.from_si(*v)).collect()
                    }),
                })
                .collect(),
        })
        .collect()
}

/// The recordings of a calibration with the free runs of the nominal and the calibrated model.
pub fn calibrated_recordings(calibration: &Calibration) -> Vec<page::Recording> {
    let c = calibration;
    [(&c.data, page::Role::Train, &c.train_runs), (&c.held, page::Role::Holdout, &c.holdout_runs)]
        .into_iter()
        .flat_map(|(data, kind, (nominal, calibrated))| {
            recordings(data, &c.model, kind, [Some(nominal), Some(calibrated), None])
        })
        .collect()
}

/// Residuals of the free runs on the training recordings, per channel.
fn residuals(d: &Diagnosis) -> Vec<Residual> {
    let data = &d.train.data;
    let mut out = Vec::new();
    for r in 0..data.recordings.len() {
        for (c, info) in data.channels.iter().enumerate() {
            let (calibrated, improved) = (&d.train.calibrated.run, &d.train.improved.run);
            let before = residual(data, calibrated, r, c, info.unit.factor);
            let after = residual(data, improved, r, c, info.unit.factor);
            let windows = d
                .mechanisms
                .first()
                .map(|m| {
                    m.location
                        .windows
                        .iter()
                        .filter(|(file, _)| *file == data.recordings[r])
                        .flat_map(|(_, w)| w.iter().map(|(a, b)| Interval { low: *a, high: *b }))
                        .collect()
                })
                .unwrap_or_default();
            let sigma = data.sigma[c] / info.unit.factor;
            out.push(Residual {
                recording: data.recordings[r].clone(),
                channel: info.name.clone(),
                unit: info.unit.text.clone(),
                t: times(data, r),
                noise_sigma: sigma,
                windows,
                spectrum: spectra(data, r, &before, &after, sigma),
                map: state_map(&d.nominal, data, [calibrated, improved], r, c),
                correlations: correlations(&d.nominal, data, [Some(calibrated), Some(improved)], r, c),
                before,
                after,
            });
        }
    }
    out
}

/// Measurement minus simulation of channel `c` of one recording, in units of `factor`.
fn residual(data: &Data, run: &FreeRun, recording: usize, c: usize, factor: f64) -> Vec<f64> {
    joined(data, recording, |i| left_over(data, run, i, c).into_iter().map(|e| e / factor).collect())
}

/// Measurement minus simulation of channel `c` of one piece, SI.
fn left_over(data: &Data, run: &FreeRun, piece: usize, c: usize) -> Vec<f64> {
    let n = data.pieces[piece].len;
    data.pieces[piece].measured[c].iter().zip(&run.y[piece][c * n..(c + 1) * n]).map(|(m, y)| m - y).collect()
}

/// Spectra of the residuals; an empty `before` stays empty.
fn spectra(data: &Data, recording: usize, before: &[f64], after: &[f64], sigma: f64) -> Option<Spectrum> {
    let piece = data.pieces.iter().filter(|p| p.recording == recording).max_by_key(|p| p.len)?;
    let filled = |x: &[f64]| greybox_recording::interpolate::fill_missing(x);
    let (freq, a) = spectrum(&filled(after), piece.dt);
    let b = if before.is_empty() { Vec::new() } else { spectrum(&filled(before), piece.dt).1 };
    if freq.len() < 8 {
        return None;
    }
    let level = 2.0 * sigma * sigma * piece.dt;
    Some(Spectrum { noise: vec![level; freq.len()], freq, before: b, after: a })
}

/// Most lags of a correlation that are told, to either side.
const LAGS: usize = 100;

/// Correlations of the residuals of channel `c` over the longest piece of a recording, before and after.
fn correlations(
    model: &Model,
    data: &Data,
    runs: [Option<&FreeRun>; 2],
    recording: usize,
    c: usize,
) -> Vec<Lagged> {
    let own = data.pieces.iter().enumerate().filter(|(_, p)| p.recording == recording);
    let Some((i, piece)) = own.max_by_key(|(_, p)| p.len) else { return Vec::new() };
    let n = piece.len;
    // A tenth of the recording, in steps that leave so many lags.
    let stride = (n / 10).div_ceil(LAGS).max(1);
    let reach = n / 10 / stride * stride;
    let residuals = runs.map(|run| run.map_or_else(Vec::new, |run| left_over(data, run, i, c)));
    let inputs = model.inputs.iter().zip(&piece.inputs).map(|(input, u)| (Some(input.name.clone()), Some(u)));
    std::iter::once((None, None))
        .chain(inputs)
        .filter_map(|(with, input)| {
            let found = residuals.each_ref().map(|e| match input {
                None => Correlation::of(e, reach),
                Some(u) => Correlation::between(u, e, reach),
            });
            let [before, after] = found;
            let after = after?;
            // With itself a residual is the same at both sides, and one at lag zero.
            let from = if with.is_some() { 0 } else { reach + stride };
            let reported = || (from..=2 * reach).step_by(stride);
            let lag = reported().map(|k| (k as f64 - reach as f64) * piece.dt).collect();
            let part = |c: Correlation| reported().map(|k| c.values[k]).collect::<Vec<f64>>();
            let bound = after.bound;
            Some(Lagged { with, lag, before: before.map_or_else(Vec::new, part), after: part(after), bound })
        })
        .collect()
}

/// Size of the residual of the first run over the state plane of the first coordinate, whose place at each
/// time the second run says.
fn state_map(
    model: &Model,
    data: &Data,
    [judged, coordinates]: [&FreeRun; 2],
    recording: usize,
    channel: usize,
) -> Option<StateMap> {
    let state = model.states.first()?;
    if state.order < 2 {
        return None;
    }
    let info = &data.channels[channel];
    let (mut x, mut y, mut value) = (Vec::new(), Vec::new(), Vec::new());
    for (i, piece) in data.pieces.iter().enumerate() {
        if piece.recording != recording {
            continue;
        }
        let n = piece.len;
        let keep = n.div_ceil(4000).max(1);
        for k in (0..n).step_by(keep) {
            let e = piece.measured[channel][k] - judged.y[i][channel * n + k];
            x.push(state.unit.from_si(coordinates.x[i][k]));
            y.push(state.unit.difference_from_si(coordinates.x[i][n + k]));
            value.push(e.abs() / info.unit.factor);
        }
    }
    let unit = &state.unit.text;
    let label = |name: &str, unit: String| {
        if unit.is_empty() || unit == "1" { name.to_string() } else { format!("{name} [{unit}]") }
    };
    Some(StateMap {
        x_label: label(&state.name, unit.clone()),
        y_label: label(&format!("{}'", state.name), format!("{unit}/s")),
        value_label: label(&format!("|residual of {}|", info.name), info.unit.text.clone()),
        x,
        y,
        value,
    })
}

fn plots(d: &Diagnosis) -> Vec<MechanismPlot> {
    d.mechanisms
        .iter()
        .enumerate()
        .filter_map(|(i, m)| {
            let curve = m.curve.as_ref()?;
            let equation = m.equations.first().cloned().unwrap_or_default();
            Some(MechanismPlot {
                mechanism: Some(i),
                title: format!("{} in equation {equation}", crate::format::kind(&m.kind)),
                x_label: curve.variable.clone(),
                y_label: format!("force in the {equation} equation, SI"),
                points: curve.points.iter().map(|(a, b)| [*a, *b]).collect(),
                curve: curve.law.iter().map(|(a, b)| [*a, *b]).collect(),
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_have_their_units() {
        let units = ["f0", "f0_hub", "zeta", "breakaway", "f01"].map(figure_unit);
        assert_eq!(units, ["Hz", "Hz", "1", "", ""]);
    }

    #[test]
    fn a_mechanism_is_told_with_its_figures_and_what_drifts() {
        let one = |value| Estimated { value, ci95: Some((0.9 * value, 1.1 * value)) };
        let found = IdentifiedMechanism {
            kind: "unmodeled_resonance".into(),
            family: "structure".into(),
            signature: String::new(),
            excitation: Some(Excitation::Around(Expr::var("f0"))),
            equations: vec!["fall".into()],
            channel: None,
            input: None,
            drifting: Some("g".into()),
            expression: "ka*(z - a)".into(),
            states: vec![("a".into(), "ma*a'' = ka*(z - a)".into())],
            parameters: vec![("g".into(), 0, one(9.81))],
            figures: vec![("f0".into(), one(4.0)), ("zeta".into(), one(0.02))],
            share_explained: 0.5,
            confidence: 0.9,
            alternatives: vec![greybox_diagnose::diagnosis::Alternative {
                kind: "actuator_lag".into(),
                confidence: 0.1,
                equivalent: false,
                expression: String::new(),
                separate: "a sine sweep".into(),
                excitation: Some(Excitation::Around(Expr::var("ta"))),
                site: greybox_diagnose::diagnosis::Site {
                    equations: vec!["fall".into()],
                    input: Some("u".into()),
                    ..Default::default()
                },
            }],
            location: Located::default(),
            evidence: greybox_diagnose::evidence::Evidence::NONE,
            curve: None,
        };
        let text = "[inputs]\nu = { unit = \"m/s^2\" }\n[states]\nz = { unit = \"m\" }\n[parameters]\n\
                    g = { value = 9.81, unit = \"m/s^2\" }\n[equations]\nfall = \"z'' = u - g\"\n";
        let model = Model::from_toml(text, "fall.toml").unwrap();
        let inputs = vec![InputRange {
            name: "u".into(),
            unit: "m/s^2".into(),
            rms: 0.5,
            reached: [-1.0, 1.0],
            stated: None,
        }];
        let reach = Reach { inputs, dt: 0.01, ..Reach::default() };
        let reported = mechanism(&found, &model, &reach);
        assert_eq!(reported.drifting.as_deref(), Some("g"));
        assert_eq!(reported.states["a"], "ma*a'' = ka*(z - a)");
        let units: Vec<(&str, &str)> =
            reported.parameters.iter().map(|(n, e)| (n.as_str(), e.unit.as_str())).collect();
        assert_eq!(units, [("g", "m/s^2"), ("f0", "Hz"), ("zeta", "1")]);
        assert_eq!(reported.parameters["f0"].ci95, Some(Interval::new(3.6, 4.4)));
        let alternative = &reported.alternatives[0];
        assert_eq!((&alternative.equation, &alternative.channel), (&Some("fall".into()), &None));
        assert_eq!(alternative.replaces.as_deref(), Some("u"));
        let experiment = reported.experiment.unwrap();
        assert_eq!(experiment.input.as_deref(), Some("u"), "the input of the equation");
        let band = experiment.band_hz.unwrap();
        assert!(band.low < 4.0 && 4.0 < band.high, "around f0: {band:?}");
    }

    #[test]
    fn a_model_states_what_its_actuators_can_do() {
        let of = |input: &str, law: &str| {
            let text = format!(
                "[inputs]\nu = {{ unit = \"mV\"{input} }}\n[states]\nx = {{ unit = \"V\" }}\n[parameters]\n\
                 T = {{ value = 1.0, unit = \"s\" }}\nlim = {{ value = 3.0, unit = \"V\" }}\n\
                 top = {{ value = 5.0, unit = \"V\" }}\n[equations]\nlag = \"T*x' + x = {law}\"\n"
            );
            stated(&Model::from_toml(&text, "m.toml").unwrap(), 0, [-1.0, 4.0])
        };
        assert_eq!(
            of(", range = [-2e3, 7e3]", "saturate(u, lim)"),
            Some([-2.0, 7.0]),
            "what is stated counts"
        );
        assert_eq!(of("", "2*saturate(u, lim)"), Some([-3.0, 4.0]), "what was reached is possible");
        assert_eq!(of("", "x + min(max(u, -lim), 2*top)"), Some([-3.0, 10.0]));
        assert_eq!(of("", "min(top, u)"), Some([-1.0, 5.0]));
        for none in ["u", "saturate(2*u, lim)", "saturate(x, lim) + u", "max(u, x)", "saturate(u, lim - top)"]
        {
            assert_eq!(of("", none), None, "{none}");
        }
    }

    #[test]
    fn numbers_in_si_are_told_where_the_model_has_other_units() {
        let text = r#"
            [units]
            doz = 12
            [inputs]
            q = { unit = "L/min" }
            [states]
            phi = { unit = "deg" }
            psi = { unit = "rad" }
            h = { unit = "cm" }
            Ti = { unit = "degC" }
            e = { unit = "doz" }
            [parameters]
            J = { value = 1.0, unit = "s^2" }
            A = { value = 1.0, unit = "m^2" }
            tau = { value = 1.0, unit = "s" }
            [equations]
            a = "J*phi'' + phi = 0"
            b = "J*psi'' + psi = 0"
            c = "A*h' = q"
            d = "tau*Ti' + Ti = 0"
            e = "tau*e' + e = 0"
        "#;
        let model = Model::from_toml(text, "m.toml").unwrap();
        let reported = |e: &str| converted(e, &model);
        assert_eq!(reported("phi").as_deref(), Some("rad"));
        assert_eq!(reported("phi'").as_deref(), Some("rad/s"));
        assert_eq!(reported("abs(h')").as_deref(), Some("m/s"));
        assert_eq!(reported("q").as_deref(), Some("m^3/s"));
        assert_eq!(reported("phi - psi").as_deref(), Some("rad"));
        assert_eq!(reported("Ti").as_deref(), Some("K"));
        assert_eq!(reported("Ti'").as_deref(), Some("K/s"));
        assert_eq!(reported("e").as_deref(), Some("1"));
        assert_eq!(coherent(&Unit::parse("degC").unwrap()), "K");
        assert_eq!(coherent(&Unit::parse("count").unwrap()), "count");
        for plain in ["psi'", "t", "z", "h*q"] {
            assert_eq!(reported(plain), None, "{plain}");
        }
    }
}
