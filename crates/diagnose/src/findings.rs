//! The mechanisms of a diagnosis: values with intervals, confidence, alternatives, place and curve.

use greybox_calibrate::{FitPoint, Setup};
use greybox_model::{Expr, Model};

use crate::diagnosis::{Alternative, Curve, Estimate, IdentifiedMechanism, Role, Site};
use crate::evidence::Evidence;
use crate::fitted::{AlternativeTerm, FittedModel, Found, MechanismTerm};
use crate::library::Mechanism;
use crate::locate::{Location, force, locate};
use crate::place::Place;
use crate::trajectory::TrajectoryEval;
use crate::twins::{Twin, twins};
use crate::uncertainty::Uncertainty;

/// Most confidence in a mechanism beside which something unexplained remains, or that may be part of another law.
pub(crate) const DOUBTED: f64 = 0.8;

/// Equivalents first, then the likelier.
pub(crate) fn rank(alternatives: &mut [Alternative]) {
    alternatives.sort_by(|a, b| b.equivalent.cmp(&a.equivalent).then(b.confidence.total_cmp(&a.confidence)));
}

/// One entry per kind and place, the likeliest, and none that is the finding itself under its own name: those that the
/// data cannot separate first.
pub(crate) fn distinct(mut alternatives: Vec<Alternative>, kind: &str, site: &Site) -> Vec<Alternative> {
    rank(&mut alternatives);
    let mut out: Vec<Alternative> = Vec::new();
    for a in alternatives {
        let known = (a.kind == kind && a.site.is(site))
            || out.iter().any(|other| other.kind == a.kind && other.site.is(&a.site));
        if !known {
            out.push(a);
        }
    }
    out
}

/// A figure that follows from a mechanism's parameters, with its interval by the delta method.
fn figure(
    improved: &FittedModel,
    uncertainty: &Uncertainty,
    mechanism: &Mechanism,
    part: &MechanismTerm,
    e: &Expr,
) -> Option<Estimate> {
    let model = &improved.setup.model;
    let own: Vec<(&str, usize)> = mechanism
        .parameters()
        .zip(&part.instance.names)
        .filter_map(|(plain, name)| Some((plain, model.parameter(name)?)))
        .collect();
    let parameters = &improved.fit.point.parameters;
    let value = |e: &greybox_model::Expr| {
        e.eval(&|n, _| match n {
            "pi" => Some(std::f64::consts::PI),
            _ => own.iter().find(|o| o.0 == n).map(|o| parameters[o.1]),
        })
        .filter(|v| v.is_finite())
    };
    let mut gradient = vec![0.0; improved.setup.free.len()];
    for (plain, index) in &own {
        if let Some(at) = improved.setup.free.iter().position(|f| f.index == *index) {
            gradient[at] = value(&e.derivative(plain, 0))?;
        }
    }
    let (v, w) = (value(e)?, uncertainty.width(&gradient));
    Some(Estimate { value: v, ci95: Some((v - w, v + w)) })
}

/// The mechanisms of an improved model: `shares` of the residual that each explains, free runs of the training recordings.
pub(crate) fn findings(
    (improved, scale): (&FittedModel, &[f64]),
    found: &Found,
    nominal: &Model,
    library: &[Mechanism],
    shares: &[f64],
    train: &Role,
    uncertainty: &Uncertainty,
) -> Vec<IdentifiedMechanism> {
    let widths = uncertainty.widths();
    let parameters = &improved.fit.point.parameters;
    let mut setup = improved.setup.clone();
    setup.model.parameters.iter_mut().zip(parameters).for_each(|(p, v)| p.value = *v);
    let along = TrajectoryEval::simulated(&setup, &train.improved.run.x, parameters);
    let smoothed_states = TrajectoryEval::smoothed(FitPoint { setup: &setup, ..improved.at(scale) });
    let finding = |(part, share): (&MechanismTerm, &f64)| {
        let MechanismTerm { candidate, instance, .. } = part;
        let mechanism = &library[candidate.mechanism];
        let accepted = found.accepted.iter().find(|a| a.candidate == *candidate);
        let evidence = accepted.map_or(Evidence::NONE, |a| a.evidence);
        let tried = accepted.map_or(&[][..], |a| &a.alternatives[..]);
        let AmongAlternatives { confidence, alternatives, equations } =
            AmongAlternatives::of(part, evidence, tried, (&setup.model, nominal), library);
        let estimate = |name: &String| {
            let index = setup.model.parameter(name)?;
            let value = parameters[index];
            let width = setup.free.iter().position(|f| f.index == index).map(|i| widths[i]);
            Some((name.clone(), index, Estimate { value, ci95: width.map(|w| (value - w, value + w)) }))
        };
        let figure_of = |name: &String, e: &Expr| {
            Some((name.clone(), figure(improved, uncertainty, mechanism, part, e)?))
        };
        let state = |name: &String| {
            let equation = setup.model.equations.iter().find(|e| e.name == *name)?;
            Some((name.clone(), format!("{} = {}", equation.lhs, equation.rhs)))
        };
        let site = Site::of(std::slice::from_ref(&candidate.place), nominal);
        IdentifiedMechanism {
            kind: mechanism.kind.clone(),
            family: mechanism.family.clone(),
            signature: mechanism.about.signature.clone(),
            excitation: mechanism.excitation.clone(),
            equations,
            channel: site.channels.first().cloned(),
            input: site.input,
            drifting: site.drifting,
            expression: instance.expression.to_string(),
            states: instance.states.iter().filter_map(state).collect(),
            parameters: instance.names.iter().filter_map(estimate).collect(),
            figures: mechanism.report.iter().filter_map(|(name, e)| figure_of(name, e)).collect(),
            share_explained: *share,
            confidence,
            alternatives,
            location: Location { equations: site.equations, ..locate(&setup, &along, mechanism, instance) },
            evidence,
            curve: curve(&setup, &smoothed_states, mechanism, instance, &candidate.place),
        }
    };
    improved.parts.iter().zip(shares).map(finding).collect()
}

/// A mechanism beside the others that explain the same.
struct AmongAlternatives {
    /// Its probability.
    confidence: f64,
    alternatives: Vec<Alternative>,
    /// The equations that it enters; where the data cannot tell at which of several places it acts, all of them.
    equations: Vec<String>,
}

impl AmongAlternatives {
    /// Of a part of a model, with what was `tried` in its place, and their evidence.
    fn of(
        part: &MechanismTerm,
        evidence: Evidence,
        tried: &[AlternativeTerm],
        (model, nominal): (&Model, &Model),
        library: &[Mechanism],
    ) -> AmongAlternatives {
        let MechanismTerm { candidate, instance, .. } = part;
        let mechanism = &library[candidate.mechanism];
        // Posterior weights of the explanations tried; equivalent ones share their weight.
        let weight = |score: f64| (0.5 * (score - evidence.score)).clamp(-60.0, 0.0).exp();
        // A wider law at the same place does not speak against a special case of it.
        let wider = |r: &&AlternativeTerm| {
            let kind = &library[r.candidate.mechanism].kind;
            r.candidate.place == candidate.place && mechanism.wider().any(|k| k == kind)
        };
        let against = tried.iter().filter(|r| !r.equivalent && !wider(r));
        let others: f64 = against.map(|r| weight(r.evidence.score)).sum();
        let all = 1.0 + others + weight(0.0);
        let confidence = (1.0 / all).clamp(0.01, 0.99);
        let alternative = |r: &AlternativeTerm| {
            let m = &library[r.candidate.mechanism];
            let place = &r.candidate.place;
            Alternative {
                kind: m.kind.clone(),
                confidence: match r.equivalent {
                    true => confidence,
                    false => (weight(r.evidence.score) / all).clamp(0.0, 0.99),
                },
                equivalent: r.equivalent,
                expression: r.instance.expression.to_string(),
                separate: m.separate(place.moves(nominal)).to_string(),
                excitation: m.excitation.clone(),
                site: Site::of(std::slice::from_ref(place), nominal),
            }
        };
        let mut alternatives: Vec<Alternative> =
            tried.iter().map(alternative).filter(|a| a.equivalent || a.confidence > 0.001).collect();
        declare_twins(&mut alternatives, twins(model, nominal, library, candidate), |twin| {
            let m = &library[twin.mechanism];
            let moves = twin.places.iter().any(|place| place.moves(nominal));
            Alternative {
                kind: m.kind.clone(),
                confidence,
                equivalent: true,
                expression: String::new(),
                separate: m.separate(moves).to_string(),
                excitation: m.excitation.clone(),
                site: Site::of(&twin.places, nominal),
            }
        });
        let site = Site::of(std::slice::from_ref(&candidate.place), nominal);
        let moves = candidate.place.moves(nominal);
        for kind in mechanism.wider() {
            alternatives.retain(|a| a.kind != kind);
            let wider = library.iter().find(|m| m.kind == kind);
            alternatives.push(Alternative {
                kind: kind.to_string(),
                confidence,
                equivalent: true,
                expression: instance.expression.to_string(),
                separate: wider.map_or(String::new(), |m| m.separate(moves).to_string()),
                excitation: wider.and_then(|m| m.excitation.clone()),
                site: site.clone(),
            });
        }
        let mut equations = site.equations.clone();
        let same =
            tried.iter().filter(|r| r.equivalent && library[r.candidate.mechanism].kind == mechanism.kind);
        for name in same.flat_map(|r| r.candidate.place.equations(nominal)) {
            if !equations.contains(&name) {
                equations.push(name);
            }
        }
        AmongAlternatives {
            confidence,
            alternatives: distinct(alternatives, &mechanism.kind, &site),
            equations,
        }
    }
}

/// Algebraic twins that no recording of this kind can tell apart are declared even where they were not tried.
fn declare_twins(
    alternatives: &mut Vec<Alternative>,
    twins: Vec<Twin>,
    declared: impl Fn(&Twin) -> Alternative,
) {
    for twin in twins.iter().map(declared) {
        match alternatives.iter_mut().find(|a| a.kind == twin.kind && a.site.is(&twin.site)) {
            Some(known) => {
                known.equivalent = true;
                known.confidence = twin.confidence;
            }
            None => alternatives.push(twin),
        }
    }
}

/// The law over its variable beside the force that the rest of the equation leaves over (computed from
/// the smoothed measurements; for plots only).
pub(crate) fn curve(
    setup: &Setup,
    smoothed_states: &TrajectoryEval<'_>,
    mechanism: &Mechanism,
    instance: &crate::candidate::Instance,
    place: &Place,
) -> Option<Curve> {
    let (variable, equation, weight) = match place {
        Place::Motion(m) => {
            let rate = mechanism.law.contains("d", 1);
            let variable = if rate { m.rate.clone()? } else { m.position.clone()? };
            let e = m.weights.iter().position(|w| *w != 0.0)?;
            (variable, e, m.weights[e])
        }
        _ => return None,
    };
    let x = smoothed_states.eval(std::slice::from_ref(&variable), &[])?.pop()?;
    let f = force(setup, smoothed_states, mechanism, instance)?;
    let left = left_over(setup, smoothed_states, equation)?;
    let mut points = Vec::new();
    let mut law = Vec::new();
    for ((x, f), left) in x.iter().zip(&f).zip(&left) {
        for ((x, f), left) in x.iter().zip(f).zip(left) {
            if x.is_finite() && f.is_finite() && left.is_finite() {
                points.push((*x, f - left / weight));
                law.push((*x, *f));
            }
        }
    }
    // A few thousand points tell as much as sixty thousand.
    let keep = points.len().div_ceil(2500).max(1);
    let points = points.into_iter().step_by(keep).collect();
    law.sort_by(|a, b| a.0.total_cmp(&b.0));
    let keep = law.len().div_ceil(400).max(1);
    let law = law.into_iter().step_by(keep).collect();
    Some(Curve { variable: variable.to_string(), points, law })
}

/// Residual of an equation along the smoothed measurements, SI: what the improved model still lacks.
fn left_over(setup: &Setup, smoothed_states: &TrajectoryEval<'_>, equation: usize) -> Option<Vec<Vec<f64>>> {
    let residual = setup.model.equations[equation].residual();
    // The highest derivatives come from the smoothed measurements, too.
    let highest: Vec<(&str, u8)> =
        setup.model.states.iter().map(|s| (s.name.as_str(), s.order as u8)).collect();
    let (mass, rest) = residual.affine_in(&highest)?;
    let mut exprs = mass;
    exprs.push(rest);
    let mut values = smoothed_states.eval(&exprs, &[])?;
    let mut total = values.pop()?;
    for (j, column) in values.iter().enumerate() {
        for (p, (t, c)) in total.iter_mut().zip(column).enumerate() {
            match &setup.smoothed_states.highest[p][j] {
                Some(z) => {
                    for ((t, c), z) in t.iter_mut().zip(c).zip(z) {
                        *t += c * z;
                    }
                }
                None if c.iter().any(|v| *v != 0.0) => return None,
                None => {}
            }
        }
    }
    Some(total)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alternative(kind: &str, equations: &[&str], confidence: f64, equivalent: bool) -> Alternative {
        let equations = equations.iter().map(|e| (*e).to_string()).collect();
        Alternative {
            kind: kind.into(),
            confidence,
            equivalent,
            expression: String::new(),
            separate: String::new(),
            excitation: None,
            site: Site { equations, ..Site::default() },
        }
    }

    #[test]
    fn alternatives_are_listed_once_by_kind_and_place() {
        let input = |name: &str| Alternative {
            site: Site { input: Some(name.into()), ..Site::default() },
            ..alternative("input_offset", &[], 0.3, true)
        };
        let all = vec![
            alternative("viscous_friction", &["hub"], 0.1, false),
            alternative("presliding_friction", &["hub"], 0.4, true),
            alternative("presliding_friction", &["link"], 0.2, true),
            alternative("viscous_friction", &["hub"], 0.2, false),
            alternative("coupling", &["link", "hub"], 0.1, true),
            alternative("coupling", &["hub", "link"], 0.3, false),
            input("u"),
            input("v"),
        ];
        let own = Site { equations: vec!["hub".into()], ..Site::default() };
        let left = distinct(all, "presliding_friction", &own);
        let reported: Vec<(&str, f64)> = left.iter().map(|a| (a.kind.as_str(), a.confidence)).collect();
        assert_eq!(
            reported,
            [
                ("input_offset", 0.3),
                ("input_offset", 0.3),
                ("presliding_friction", 0.2),
                ("coupling", 0.1),
                ("viscous_friction", 0.2),
            ]
        );
        assert_eq!(left[2].site.equations, ["link"], "the finding's own name and place are not listed again");
    }

    #[test]
    fn twins_that_were_tried_become_equivalent_and_the_others_are_added() {
        let mut all = vec![alternative("sensor_offset", &["hub"], 0.1, false)];
        let twin = |e| Twin { mechanism: 0, places: vec![Place::Equation(e)] };
        declare_twins(&mut all, vec![twin(0), twin(1)], |twin| {
            let name = if twin.places == [Place::Equation(0)] { "hub" } else { "link" };
            alternative("sensor_offset", &[name], 0.6, true)
        });
        let reported: Vec<(&str, f64, bool)> =
            all.iter().map(|a| (a.site.equations[0].as_str(), a.confidence, a.equivalent)).collect();
        assert_eq!(reported, [("hub", 0.6, true), ("link", 0.6, true)]);
    }
}
