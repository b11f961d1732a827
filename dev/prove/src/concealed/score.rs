//! What a report got right about a case.

use greybox_report::Report;
use greybox_report::contract::{Basis, Interval, Mechanism, Score as Fit, Verdict};
use serde::Serialize;
use serde_json::json;

use super::case::{Truth, TruthEffect};
use greybox_plants::kind::Kind;

/// Held-out error above which an improvement made things worse.
const WORSE: f64 = 1.05;

/// Everything that is judged about one case.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Score {
    /// Why there is no report; everything else is then missed.
    pub(crate) failure: Option<String>,
    pub(crate) verdict: String,
    /// Kinds found, with the equations named.
    pub(crate) found: Vec<String>,
    /// Something was said to be missing.
    pub(crate) detected: bool,
    /// Nulls: something was said to be missing.
    pub(crate) false_alarm: bool,
    /// The first mechanism (every truth, where there are several) is right by kind, or declared equivalent.
    pub(crate) exact: Option<bool>,
    pub(crate) family: Option<bool>,
    pub(crate) equation: Option<bool>,
    /// Mechanisms beyond the truth.
    pub(crate) spurious: Option<usize>,
    /// Relative errors of the mechanisms' parameters.
    pub(crate) parameter_errors: Vec<(String, f64)>,
    /// Whether the 95 % intervals (mechanisms' and the model's own parameters) hold the truth.
    pub(crate) coverage: Vec<(String, bool)>,
    /// Intersection over union of the windows in time.
    pub(crate) iou: Option<f64>,
    /// Outside the library: unexplained, or an accepted relative named.
    pub(crate) outside: Option<bool>,
    /// Outside the library, where a term without a name is the law: the improved model holds it, in its equation.
    pub(crate) term: Option<bool>,
    /// Outside the library: what the improved model rests on, or the gate at which a closure was rejected.
    pub(crate) answer: Option<String>,
    /// Outside the library: a kind that is no relative, named with confidence of 0.9 or more.
    pub(crate) confidently_wrong: Option<bool>,
    /// Held-out error over the oracle's, worst channel.
    pub(crate) holdout: Option<f64>,
    /// Held-out error over the calibrated model's, worst channel.
    pub(crate) against_calibrated: Option<f64>,
    /// Confidence of the first mechanism, and whether it was right.
    pub(crate) confidence: Option<(f64, bool)>,
    pub(crate) seconds: f64,
}

/// The oracle's held-out errors by channel: the true model, its initial state estimated as any other's.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Oracle {
    /// Channel, free run, windowed.
    pub(crate) errors: Vec<(String, f64, Option<f64>)>,
}

impl Score {
    /// Of a run without a report.
    pub(crate) fn failed(truth: &Truth, why: String, seconds: f64) -> Score {
        let effect = truth.class == "effect";
        Score {
            failure: Some(why),
            verdict: "none".into(),
            exact: effect.then_some(false),
            family: effect.then_some(false),
            equation: effect.then_some(false),
            outside: (truth.class == "outside").then_some(false),
            term: truth.term.map(|_| false),
            seconds,
            ..Score::default()
        }
    }

    /// Whether the case came out as it should.
    pub(crate) fn right(&self) -> bool {
        self.failure.is_none()
            && !self.false_alarm
            && self.exact != Some(false)
            && self.equation != Some(false)
            && self.outside != Some(false)
            && self.spurious.unwrap_or(0) == 0
    }
}

/// Judges a report.
pub(crate) fn judge(truth: &Truth, report: &Report, oracle: Option<&Oracle>, seconds: f64) -> Score {
    let verdict = match report.verdict {
        Verdict::Consistent => "consistent",
        Verdict::MissingPhysics => "missing_physics",
        Verdict::Unexplained => "unexplained",
    };
    let said = report.verdict != Verdict::Consistent;
    let found = report
        .mechanisms
        .iter()
        .map(|m| format!("{}@{} {:.2}", m.kind, m.equation.as_slice().join("+"), m.confidence))
        .collect();
    let mut score = Score { verdict: verdict.into(), found, seconds, ..Score::default() };
    let (holdout, against) = held_out(truth, report, oracle);
    (score.holdout, score.against_calibrated) = (holdout, against);
    match truth.class {
        "null" => {
            score.false_alarm = said;
            score.spurious = Some(report.mechanisms.len());
            score.coverage = model_coverage(truth, report);
        }
        "outside" => {
            score.detected = said;
            score.answer = Some(answer(report));
            score.term = truth.term.map(|term| {
                let mut held = report.mechanisms.iter().chain(&report.candidates);
                held.any(|m| m.kind == term && truth.effects.iter().any(|e| equation_fits(e, m)))
            });
            let near = report.mechanisms.iter().all(|m| truth.relatives.contains(&m.kind.as_str()));
            score.outside =
                Some(report.verdict == Verdict::Unexplained || (!report.mechanisms.is_empty() && near));
            let wrong = |m: &Mechanism| !truth.relatives.contains(&m.kind.as_str()) && m.confidence >= 0.9;
            score.confidently_wrong =
                Some(report.verdict == Verdict::MissingPhysics && report.mechanisms.iter().any(wrong));
        }
        _ => {
            score.detected = said;
            judge_effects(truth, report, &mut score);
        }
    }
    score
}

/// What the improved model rests on where it holds laws; else the gate at which a closure was rejected, or that none was found.
fn answer(report: &Report) -> String {
    let said = |what: serde_json::Value| what.as_str().unwrap_or_default().replace('_', " ");
    match (report.basis, &report.closure_rejected) {
        (Basis::Calibrated, Some(rejected)) => format!("rejected: {}", said(json!(rejected.gate))),
        (Basis::Calibrated, None) => "no closure found".to_owned(),
        (basis, _) => said(json!(basis)),
    }
}

fn judge_effects(truth: &Truth, report: &Report, score: &mut Score) {
    let mechanisms = &report.mechanisms;
    // A mechanism stands for at most one effect; each effect takes the first that fits.
    let mut taken = vec![false; mechanisms.len()];
    let mut pairs: Vec<Option<usize>> = Vec::new();
    for effect in &truth.effects {
        let fits = |m: &Mechanism| kind_fits(effect, m);
        let place = |m: &Mechanism| equation_fits(effect, m);
        let free = |i: &usize| !taken[*i];
        // The one at the right place goes before.
        let best = (0..mechanisms.len())
            .filter(free)
            .find(|&i| fits(&mechanisms[i]) && place(&mechanisms[i]))
            .or_else(|| (0..mechanisms.len()).filter(free).find(|&i| fits(&mechanisms[i])));
        if let Some(i) = best {
            taken[i] = true;
        }
        pairs.push(best);
    }
    let single = truth.effects.len() == 1;
    let mut exact = if single { pairs[0] == Some(0) } else { pairs.iter().all(Option::is_some) };
    let mut family = if single {
        mechanisms.first().is_some_and(|m| family_fits(&truth.effects[0], m))
    } else {
        truth.effects.iter().all(|e| mechanisms.iter().any(|m| family_fits(e, m)))
    };
    let mut parts = 0;
    // Asymmetric Coulomb friction is Coulomb friction and an offset (DESIGN §2.1).
    for (effect, pair) in truth.effects.iter().zip(&mut pairs) {
        let offset = |m: &Mechanism| matches!(m.kind.as_str(), "constant_offset" | "input_offset");
        let whole = pair.is_some_and(|i: usize| mechanisms[i].kind == effect.kind);
        if effect.kind != "asymmetric_coulomb_friction" || whole {
            continue;
        }
        let coulomb = mechanisms.iter().position(|m| m.kind == "coulomb_friction");
        if let (Some(i), true) = (coulomb, mechanisms.iter().any(offset)) {
            *pair = Some(i);
            parts += 1;
            if single {
                (exact, family) = (true, true);
            }
        }
    }
    score.exact = Some(exact);
    score.family = Some(family);
    let of_pairs = || truth.effects.iter().zip(&pairs).filter_map(|(e, p)| p.map(|p| (e, &mechanisms[p])));
    score.equation = Some(if single {
        mechanisms.first().is_some_and(|m| equation_fits(&truth.effects[0], m))
    } else {
        pairs.iter().all(Option::is_some) && of_pairs().all(|(e, m)| equation_fits(e, m))
    });
    let right = pairs.iter().flatten().count() + parts;
    score.spurious = Some(mechanisms.len().saturating_sub(right));
    score.confidence = mechanisms.first().map(|m| (m.confidence, exact));
    let mut overlaps = Vec::new();
    for (effect, mechanism) in of_pairs() {
        // Only the same kind states the same numbers.
        if mechanism.kind == effect.kind {
            compare_parameters(effect, mechanism, score);
        }
        if let Some(iou) = overlap(truth, effect, mechanism) {
            overlaps.push(iou);
        }
    }
    score.iou = overlaps.iter().copied().reduce(f64::min);
    if exact && score.spurious == Some(0) {
        let own = model_coverage(truth, report);
        score.coverage.extend(own);
    }
}

/// Right by kind, an algebraic twin, or declared equivalent in the report.
fn kind_fits(effect: &TruthEffect, m: &Mechanism) -> bool {
    m.kind == effect.kind
        || effect.twins.contains(&m.kind.as_str())
        || m.alternatives.iter().any(|a| a.equivalent && a.kind == effect.kind)
}

fn family_fits(effect: &TruthEffect, m: &Mechanism) -> bool {
    kind_fits(effect, m) || Kind::family_of(&m.kind) == Some(effect.family)
}

fn equation_fits(effect: &TruthEffect, m: &Mechanism) -> bool {
    let by_channel = match (&effect.channel, &m.channel) {
        (Some(right), Some(said)) => right == said,
        // A twin of a sensor's effect names an equation.
        (Some(_), None) => m.kind != effect.kind,
        (None, _) => false,
    };
    let by_twin = effect.channel.is_none() && m.channel.is_some() && m.kind != effect.kind;
    by_channel || by_twin || m.equation.as_slice().iter().any(|e| effect.equations.contains(e))
}

/// A name, or the name with a suffix.
fn is_named(name: &str, canonical: &str) -> bool {
    name.strip_prefix(canonical).is_some_and(|rest| rest.is_empty() || rest.starts_with('_'))
}

fn compare_parameters(effect: &TruthEffect, m: &Mechanism, score: &mut Score) {
    for &(name, truth) in &effect.parameters {
        let Some((_, estimate)) = m.parameters.iter().find(|(n, _)| is_named(n, name)) else { continue };
        let mut value = estimate.value;
        let mut interval = estimate.ci95;
        // A phase is known up to whole turns; a sine's sign up to half a turn is another phase.
        if matches!(name, "pcg" | "pd") {
            let turns = ((truth - value) / std::f64::consts::TAU).round() * std::f64::consts::TAU;
            value += turns;
            interval = interval.map(|i| Interval::new(i.low + turns, i.high + turns));
            score.parameter_errors.push((name.to_owned(), (value - truth).abs() / std::f64::consts::PI));
        } else {
            score.parameter_errors.push((name.to_owned(), (value - truth).abs() / truth.abs()));
        }
        if let Some(i) = interval.filter(|i| i.low.is_finite() && i.high.is_finite()) {
            score.coverage.push((name.to_owned(), i.low <= truth && truth <= i.high));
        }
    }
}

fn model_coverage(truth: &Truth, report: &Report) -> Vec<(String, bool)> {
    let mut out = Vec::new();
    for (name, value) in &truth.parameters {
        let Some(p) = report.parameters.get(name).filter(|p| !p.fixed) else { continue };
        if let Some(i) = p.ci95.filter(|i| i.low.is_finite() && i.high.is_finite()) {
            out.push((name.clone(), i.low <= *value && *value <= i.high));
        }
    }
    out
}

/// Intersection over union of true and reported windows over the training recordings; `None` where the
/// truth has none.
fn overlap(truth: &Truth, effect: &TruthEffect, m: &Mechanism) -> Option<f64> {
    if effect.windows.is_empty() {
        return None;
    }
    let (mut both, mut either) = (0.0, 0.0);
    for name in &truth.training {
        let right: &[[f64; 2]] =
            effect.windows.iter().find(|(n, _)| n == name).map_or(&[], |(_, w)| w.as_slice());
        let said: Vec<[f64; 2]> = m
            .location
            .windows_s
            .get(name)
            .map(|w| w.iter().map(|i| [i.low, i.high]).collect())
            .unwrap_or_default();
        let common = intersection(right, &said);
        both += common;
        either += length(right) + length(&said) - common;
    }
    Some(if either > 0.0 { both / either } else { 0.0 })
}

fn length(windows: &[[f64; 2]]) -> f64 {
    windows.iter().map(|w| (w[1] - w[0]).max(0.0)).sum()
}

fn intersection(a: &[[f64; 2]], b: &[[f64; 2]]) -> f64 {
    let one = |x: &[f64; 2], y: &[f64; 2]| (x[1].min(y[1]) - x[0].max(y[0])).max(0.0);
    a.iter().map(|x| b.iter().map(|y| one(x, y)).sum::<f64>()).sum()
}

/// The held-out error over the oracle's and over the calibrated model's, each by its worst channel.
///
/// Free runs. A channel that nothing pulls back drifts in free run with the least error of a constant
/// force; there, runs restarted every window count instead where they come out better.
fn held_out(truth: &Truth, report: &Report, oracle: Option<&Oracle>) -> (Option<f64>, Option<f64>) {
    let held = &report.fit.holdout;
    let improved = if held.improved.is_empty() { &held.calibrated } else { &held.improved };
    let worst = |ratios: Vec<f64>| {
        // A run that diverged has no number, and is as bad as can be.
        ratios.into_iter().map(|r| if r.is_nan() { f64::INFINITY } else { r }).reduce(f64::max)
    };
    let ratio = |channel: &String, fit: &Fit, free: f64, windowed: Option<f64>| {
        let restarted = fit.nrmse_windowed.zip(windowed).map(|(fit, base)| fit / base);
        // `min` passes over a run that diverged.
        (fit.nrmse / free).min(restarted.filter(|_| truth.drifting.contains(channel)).unwrap_or(f64::NAN))
    };
    let errors = oracle.iter().flat_map(|o| &o.errors);
    let by_oracle = errors
        .filter_map(|(channel, free, windowed)| {
            improved.get(channel).map(|fit| ratio(channel, fit, *free, *windowed))
        })
        .collect();
    let by_calibrated = improved
        .iter()
        .filter_map(|(channel, fit)| {
            held.calibrated.get(channel).map(|base| ratio(channel, fit, base.nrmse, base.nrmse_windowed))
        })
        .collect();
    (worst(by_oracle), worst(by_calibrated))
}

/// Whether an improvement lost against the calibrated model.
pub(crate) fn is_worse(score: &Score) -> bool {
    score.against_calibrated.is_some_and(|r| r > WORSE)
}

#[cfg(test)]
mod tests {
    use greybox_report::contract::{Alternative, Estimate};

    use super::*;
    use crate::cases::tests::report;

    fn left_out(kind: Kind, equation: &str) -> TruthEffect {
        TruthEffect {
            kind: kind.name(),
            family: kind.family(),
            equations: vec![equation.into()],
            channel: None,
            drifting: None,
            parameters: vec![],
            twins: vec![],
            windows: vec![],
            severity: 4.0,
        }
    }

    fn truth(class: &'static str, effects: Vec<TruthEffect>) -> Truth {
        Truth {
            id: "0".into(),
            index: 0,
            system: "servo",
            class,
            tier: None,
            masks: vec![],
            effects,
            relatives: &[],
            term: None,
            drifting: vec![],
            noise: vec![],
            parameters: vec![],
            training: vec!["train.csv".into()],
        }
    }

    fn found(kinds: &[&str]) -> Report {
        report("missing_physics", kinds, "theta")
    }

    fn scored(truth: &Truth, report: &Report) -> Score {
        judge(truth, report, None, 1.0)
    }

    #[test]
    fn one_effect_must_come_first_and_alone() {
        let t = truth("effect", vec![left_out(Kind::CoulombFriction, "axis")]);
        let right = scored(&t, &found(&["coulomb_friction"]));
        assert!(right.right() && right.detected && right.spurious == Some(0));
        let second = scored(&t, &found(&["gravity", "coulomb_friction"]));
        assert_eq!((second.exact, second.family, second.spurious), (Some(false), Some(false), Some(1)));
        let near = scored(&t, &found(&["stribeck_friction"]));
        assert_eq!((near.exact, near.family, near.spurious), (Some(false), Some(true), Some(1)));
        let silent = scored(&t, &report("consistent", &[], "theta"));
        assert_eq!((silent.detected, silent.exact), (false, Some(false)));
        let elsewhere = truth("effect", vec![left_out(Kind::CoulombFriction, "hub")]);
        let misplaced = scored(&elsewhere, &found(&["coulomb_friction"]));
        assert_eq!(
            (misplaced.exact, misplaced.equation, misplaced.right()),
            (Some(true), Some(false), false)
        );
    }

    #[test]
    fn twins_and_declared_equivalents_are_right() {
        let mut t = truth("effect", vec![left_out(Kind::InputOffset, "axis")]);
        assert_eq!(scored(&t, &found(&["constant_offset"])).exact, Some(false));
        let mut declared = found(&["constant_offset"]);
        declared.mechanisms[0].alternatives = vec![Alternative {
            kind: "input_offset".into(),
            confidence: 0.5,
            equivalent: true,
            ..Alternative::default()
        }];
        assert_eq!(scored(&t, &declared).exact, Some(true));
        declared.mechanisms[0].alternatives[0].equivalent = false;
        assert_eq!(scored(&t, &declared).exact, Some(false));
        t.effects[0].twins = vec!["constant_offset"];
        assert_eq!(scored(&t, &found(&["constant_offset"])).exact, Some(true));
    }

    #[test]
    fn asymmetric_friction_may_be_told_in_two_parts() {
        let t = truth("effect", vec![left_out(Kind::AsymmetricCoulombFriction, "axis")]);
        let parts = scored(&t, &found(&["constant_offset", "coulomb_friction"]));
        assert_eq!((parts.exact, parts.spurious), (Some(true), Some(0)));
        assert_eq!(scored(&t, &found(&["coulomb_friction"])).exact, Some(false));
    }

    #[test]
    fn of_two_effects_both_are_wanted_in_any_order() {
        let t = truth(
            "effect",
            vec![left_out(Kind::CoulombFriction, "axis"), left_out(Kind::CubicStiffness, "axis")],
        );
        assert!(scored(&t, &found(&["cubic_stiffness", "coulomb_friction"])).right());
        let half = scored(&t, &found(&["cubic_stiffness"]));
        assert_eq!((half.exact, half.family, half.spurious), (Some(false), Some(false), Some(0)));
    }

    #[test]
    fn nulls_and_outsiders() {
        let null = truth("null", vec![]);
        assert!(scored(&null, &report("consistent", &[], "theta")).right());
        assert!(scored(&null, &report("unexplained", &[], "theta")).false_alarm);
        let mut outside = truth("outside", vec![left_out(Kind::QuinticStiffness, "axis")]);
        outside.relatives = Kind::QuinticStiffness.relatives();
        assert_eq!(scored(&outside, &report("unexplained", &[], "theta")).outside, Some(true));
        assert_eq!(scored(&outside, &found(&["cubic_stiffness"])).outside, Some(true));
        // The hand-made report is sure by 0.9.
        let wrong = scored(&outside, &found(&["coulomb_friction"]));
        assert_eq!((wrong.outside, wrong.confidently_wrong), (Some(false), Some(true)));
        assert_eq!(scored(&outside, &report("consistent", &[], "theta")).outside, Some(false));
    }

    /// The term counts among what is proposed, in the equation where the law acts; where no term is the law nothing is asked.
    #[test]
    fn a_term_is_held_in_its_equation() {
        let mut outside = truth("outside", vec![left_out(Kind::QuinticStiffness, "axis")]);
        outside.term = Kind::QuinticStiffness.term();
        let proposed = |kind: &str| {
            let mut proposed = found(&[kind]);
            (proposed.verdict, proposed.candidates) =
                (Verdict::Unexplained, proposed.mechanisms.split_off(0));
            proposed
        };
        let term = |truth: &Truth, report: &Report| scored(truth, report).term;
        assert_eq!(term(&outside, &proposed("quintic_stiffness")), Some(true));
        assert_eq!(term(&outside, &proposed("cubic_stiffness")), Some(false));
        assert_eq!(term(&outside, &report("unexplained", &[], "theta")), Some(false));
        outside.effects[0].equations = vec!["hub".to_owned()];
        assert_eq!(term(&outside, &proposed("quintic_stiffness")), Some(false));
        outside.term = Kind::LockingSpring.term();
        assert_eq!(term(&outside, &proposed("quintic_stiffness")), None);
    }

    #[test]
    fn numbers_windows_and_held_out_errors() {
        let mut effect = left_out(Kind::EndStop, "axis");
        effect.parameters = vec![("kst", 100.0), ("xst", 0.5)];
        effect.windows = vec![("train.csv".into(), vec![[0.0, 2.0]])];
        let t = truth("effect", vec![effect]);
        let mut r = found(&["end_stop"]);
        let m = &mut r.mechanisms[0];
        let number = |value: f64, half: f64| Estimate {
            value,
            ci95: Some(Interval::new(value - half, value + half)),
            unit: String::new(),
        };
        m.parameters.insert("kst_axis".into(), number(110.0, 5.0));
        m.parameters.insert("xst".into(), number(0.501, 0.01));
        m.location.windows_s.insert("train.csv".into(), vec![Interval::new(1.0, 3.0)]);
        let oracle = Oracle { errors: vec![("theta".into(), 0.04, None)] };
        let s = judge(&t, &r, Some(&oracle), 1.0);
        let errors: Vec<f64> = s.parameter_errors.iter().map(|e| e.1).collect();
        assert!((errors[0] - 0.1).abs() < 1e-12 && (errors[1] - 0.002).abs() < 1e-12);
        assert_eq!(s.coverage, [("kst".to_owned(), false), ("xst".to_owned(), true)]);
        assert!((s.iou.unwrap() - 1.0 / 3.0).abs() < 1e-12);
        // The hand-made report improves 0.183 to 0.05.
        assert!((s.holdout.unwrap() - 1.25).abs() < 1e-12 && !is_worse(&s));
        r.fit.holdout.improved.get_mut("theta").unwrap().nrmse = f64::NAN;
        assert_eq!(judge(&t, &r, Some(&oracle), 1.0).holdout, Some(f64::INFINITY));
    }

    #[test]
    fn windows_overlap_in_time() {
        let a = [[0.0, 2.0], [5.0, 6.0]];
        assert_eq!(length(&a), 3.0);
        assert_eq!(intersection(&a, &[[1.0, 5.5]]), 1.5);
        assert_eq!(intersection(&a, &[]), 0.0);
    }

    #[test]
    fn names_carry_a_suffix_or_none() {
        assert!(is_named("fc", "fc") && is_named("fc_hub", "fc"));
        assert!(!is_named("fcp", "fc") && !is_named("f", "fc"));
    }
}
