//! Many reports as one: [`map`] a report to its [`Statistics`], [`reduce`] those of any number of recordings, and
//! [`conclude`] what they say together. All three are pure, so that any engine that can run a function over records
//! and fold the results can work through a fleet of recordings; `greybox diagnose MODEL.toml FOLDER` does it on one
//! machine.
//!
//! **Invariant:** joining is associative, commutative and idempotent, to the byte. [`Statistics`] is a set of
//! recordings, and every derived figure is computed from the whole set, in the order of its names, by [`conclude`]
//! alone:
//!
//! ```text
//! reduce([a, reduce([b, c])]) = reduce([reduce([a, b]), c])      reduce([a, b]) = reduce([b, a])
//! reduce([a, a]) = a                                             reduce([]) = Statistics::default()
//! ```
//!
//! ```
//! use greybox_report::contract::{ModelId, Producer};
//! use greybox_report::{Report, merge};
//!
//! # let report = |fc: f64| format!(r#"{{
//! #   "verdict": "missing_physics",
//! #   "mechanisms": [{{"kind": "coulomb_friction", "family": "friction", "equation": "cart",
//! #     "expression": "fc*sign(x')", "share_explained": 0.9, "confidence": 0.99, "location": {{}},
//! #     "parameters": {{"fc": {{"value": {fc}, "ci95": [{}, {}], "unit": "N"}}}}}}],
//! #   "remainder": {{"significant": false, "location": {{}}, "share_of_residual": 0.01}},
//! #   "parameters": {{}}, "noise_floor": {{}},
//! #   "fit": {{"train": {{"nominal": {{}}, "calibrated": {{}}, "improved": {{}}}},
//! #            "holdout": {{"nominal": {{}}, "calibrated": {{}}, "improved": {{}}}}}}
//! # }}"#, fc - 0.02, fc + 0.02);
//! # let (monday, friday) = (report(0.50), report(0.53));
//! // The texts of two report.json: Coulomb friction, fc = 0.50 ± 0.02 N and 0.53 ± 0.02 N.
//! let a = merge::map("monday.csv", None, &Report::from_json(&monday)?);
//! let b = merge::map("friday.csv", None, &Report::from_json(&friday)?);
//! let joined = merge::reduce([a, b])?;
//! let summary = merge::conclude(joined, Producer::default(), ModelId::default());
//!
//! let friction = &summary.mechanisms[0];
//! assert_eq!(friction.found_in, ["friday.csv", "monday.csv"]);
//! let fc = &friction.parameters["fc"];
//! assert!((fc.value - 0.515).abs() < 1e-12);
//! assert!(fc.heterogeneity.unwrap().p_value < 0.05, "the friction has changed since Monday");
//! # Ok::<(), greybox_report::ReportError>(())
//! ```

use std::collections::BTreeMap;

use greybox_fleet::{Effect, pool};
use serde::Serialize;

use crate::contract::{
    Estimate, FitSet, Mechanism, ModelId, Ordered, Parameter, Producer, Report, Score, Verdict,
};
use crate::machines::Fleet;
use crate::summary::{
    ErrorsOver, Heterogeneity, Law, MechanismOver, MechanismResult, Method, ParameterOver, Pooled,
    RecordingEstimate, RecordingFailure, RecordingResult, Spread, Statistics, Summary, Verdicts,
};
use crate::{ReportError, sentence};

/// The statistics of one recording; `page` is where its `report.html` is, from the summary.
pub fn map(recording: &str, page: Option<&str>, report: &Report) -> Statistics {
    let result = RecordingResult {
        recording: recording.to_owned(),
        page: page.map(str::to_owned),
        verdict: report.verdict,
        samples: report.samples,
        mechanisms: report.mechanisms.iter().map(mechanism).collect(),
        parameters: report.parameters.clone(),
        holdout: report.fit.holdout.clone(),
        run: None,
    };
    Statistics { recordings: vec![result], failed: Vec::new() }
}

pub(crate) fn mechanism(found: &Mechanism) -> MechanismResult {
    MechanismResult {
        law: Law {
            kind: found.kind.clone(),
            family: found.family.clone(),
            // Where it stands, not every place at which it might as well.
            equation: found.location.equation.clone().unwrap_or_else(|| found.equation.clone()),
            channel: found.channel.clone(),
            expression: found.expression.clone(),
            replaces: found.replaces.clone(),
            drifting: found.drifting.clone(),
        },
        parameters: found.parameters.clone(),
        share_explained: found.share_explained,
        confidence: found.confidence,
    }
}

/// The statistics of a recording that could not be diagnosed.
pub fn failed(recording: &str, message: &str, help: Option<&str>) -> Statistics {
    let failure = RecordingFailure {
        recording: recording.to_owned(),
        message: message.to_owned(),
        help: help.map(str::to_owned),
    };
    Statistics { recordings: Vec::new(), failed: vec![failure] }
}

/// Joins the statistics of any number of recordings, in any order and in any grouping. A recording that is given
/// twice with the same figures counts once; with different figures, both stay.
///
/// # Errors
/// [`ReportError::Json`] if serialisation fails; the types leave no known way for that.
pub fn reduce(parts: impl IntoIterator<Item = Statistics>) -> Result<Statistics, ReportError> {
    let (mut recordings, mut failed) = (Vec::new(), Vec::new());
    for part in parts {
        recordings.extend(part.recordings);
        failed.extend(part.failed);
    }
    Ok(Statistics { recordings: set(recordings, |r| &r.recording)?, failed: set(failed, |f| &f.recording)? })
}

/// Sorted by name and then by text, each once.
fn set<T: Serialize>(items: Vec<T>, name: impl Fn(&T) -> &String) -> Result<Vec<T>, ReportError> {
    let mut sorted = BTreeMap::new();
    for item in items {
        sorted.insert((name(&item).clone(), serde_json::to_string(&item)?), item);
    }
    Ok(sorted.into_values().collect())
}

/// What recordings of one model say together.
///
/// Where a table says which machine was recorded ([`RecordingResult::run`]), over the machines too.
pub fn conclude(statistics: Statistics, greybox: Producer, model: ModelId) -> Summary {
    let fleet = Fleet::of(&statistics.recordings);
    let mut summary = Summary {
        greybox,
        model,
        summary: Vec::new(),
        verdicts: verdicts(&statistics),
        mechanisms: mechanisms(&statistics.recordings, &fleet),
        parameters: parameters(&statistics.recordings, &fleet),
        holdout: holdout(&statistics.recordings),
        statistics,
    };
    summary.summary = sentence::recordings::summary(&summary);
    summary
}

fn verdicts(statistics: &Statistics) -> Verdicts {
    let count = |verdict| statistics.recordings.iter().filter(|r| r.verdict == verdict).count();
    Verdicts {
        consistent: count(Verdict::Consistent),
        missing_physics: count(Verdict::MissingPhysics),
        unexplained: count(Verdict::Unexplained),
        failed: statistics.failed.len(),
    }
}

fn mechanisms(recordings: &[RecordingResult], fleet: &Fleet<'_>) -> Vec<MechanismOver> {
    let mut by_law: BTreeMap<&Law, Vec<(&str, &MechanismResult)>> = BTreeMap::new();
    for recording in recordings {
        for mechanism in &recording.mechanisms {
            by_law.entry(&mechanism.law).or_default().push((&recording.recording, mechanism));
        }
    }
    let mut out: Vec<MechanismOver> =
        by_law.into_iter().map(|(law, found)| over(law, &found, fleet)).collect();
    // A stable sort: laws found equally often stay in their own order.
    out.sort_by_key(|m| std::cmp::Reverse(m.found_in.len()));
    out
}

fn over(law: &Law, found: &[(&str, &MechanismResult)], fleet: &Fleet<'_>) -> MechanismOver {
    let estimates = found.iter().flat_map(|&(recording, m)| {
        m.parameters.iter().map(move |(name, estimate)| (name.as_str(), recording, estimate.clone()))
    });
    MechanismOver {
        law: law.clone(),
        found_in: found.iter().map(|(recording, _)| (*recording).to_owned()).collect(),
        machines: fleet.share(found.iter().map(|(recording, _)| *recording)),
        share_explained: Spread::of(found.iter().map(|(_, m)| m.share_explained)),
        confidence: Spread::of(found.iter().map(|(_, m)| m.confidence)),
        parameters: pooled_by_name(estimates, fleet),
    }
}

fn parameters(recordings: &[RecordingResult], fleet: &Fleet<'_>) -> Ordered<ParameterOver> {
    let free = || {
        recordings.iter().flat_map(|r| {
            r.parameters
                .iter()
                .filter(|(_, p)| !p.fixed)
                .map(|(name, p)| (name.as_str(), r.recording.as_str(), p))
        })
    };
    let estimate =
        |p: &Parameter| Estimate { value: p.value, ci95: p.ci95, unit: p.unit.clone().unwrap_or_default() };
    let nominal: BTreeMap<&str, f64> = free().map(|(name, _, p)| (name, p.nominal)).collect();
    pooled_by_name(free().map(|(name, recording, p)| (name, recording, estimate(p))), fleet)
        .into_iter()
        .map(|(name, pooled)| {
            let nominal = nominal.get(name.as_str()).copied().unwrap_or(f64::NAN);
            (name, ParameterOver { nominal, pooled })
        })
        .collect()
}

/// Pools (name, recording, estimate) by name, in the order in which the names first come.
fn pooled_by_name<'a>(
    all: impl Iterator<Item = (&'a str, &'a str, Estimate)>,
    fleet: &Fleet<'_>,
) -> Ordered<Pooled> {
    let mut by_name: Ordered<Vec<(&str, Estimate)>> = Ordered::new();
    for (name, recording, estimate) in all {
        by_name.entry(name.to_owned()).or_default().push((recording, estimate));
    }
    by_name.into_iter().map(|(name, estimates)| (name, pooled(&estimates, fleet))).collect()
}

fn pooled(estimates: &[(&str, Estimate)], fleet: &Fleet<'_>) -> Pooled {
    let named: Vec<(&str, Effect)> = estimates
        .iter()
        .filter_map(|(recording, e)| {
            Some((*recording, Effect::of(e.value, e.ci95.map(|i| [i.low, i.high]))?))
        })
        .collect();
    let effects: Vec<Effect> = named.iter().map(|(_, effect)| *effect).collect();
    let pool = pool(&effects);
    let heterogeneity = pool.and_then(|p| p.heterogeneity);
    Pooled {
        value: pool.map_or(f64::NAN, |p| p.value),
        ci95: pool.map(|p| p.ci95().into()),
        unit: estimates.first().map(|(_, e)| e.unit.clone()).unwrap_or_default(),
        method: match (pool, heterogeneity) {
            (None, _) => Method::None,
            (_, None) => Method::Single,
            (_, Some(h)) if h.disagrees() => Method::RandomEffects,
            _ => Method::FixedEffect,
        },
        heterogeneity: heterogeneity.map(|h| Heterogeneity {
            q: h.q,
            degrees_of_freedom: h.degrees_of_freedom,
            p_value: h.p_value,
            i_squared: h.i_squared,
            tau: h.between.sqrt(),
        }),
        estimates: estimates
            .iter()
            .map(|(recording, e)| RecordingEstimate {
                recording: (*recording).to_owned(),
                value: e.value,
                ci95: e.ci95,
            })
            .collect(),
        machines: fleet.over(&named),
    }
}

fn holdout(recordings: &[RecordingResult]) -> Ordered<ErrorsOver> {
    let mut channels: Vec<&str> = Vec::new();
    for channel in recordings.iter().flat_map(|r| r.holdout.channels()) {
        if !channels.contains(&channel) {
            channels.push(channel);
        }
    }
    channels
        .into_iter()
        .map(|channel| {
            let spread = |model: fn(&FitSet) -> &Ordered<Score>| {
                Spread::of(recordings.iter().filter_map(|r| Some(model(&r.holdout).get(channel)?.nrmse)))
            };
            let errors = ErrorsOver {
                nominal: spread(|set| &set.nominal),
                calibrated: spread(|set| &set.calibrated),
                improved: spread(|set| &set.improved),
            };
            (channel.to_owned(), errors)
        })
        .collect()
}
