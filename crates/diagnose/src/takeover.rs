//! Replacements for what a search found: a closure that passes the gates and simulates better, or the laws that are likeliest beside
//! an error of the model.

use greybox_calibrate::{Point, Setup};

use crate::Stage;
use crate::baseline::{Baseline, Judge, WholeRecordFit, leaves_noise, polish, residual_scale};
use crate::candidate::Candidate;
use crate::closure::Visited;
use crate::evidence::Evidence;
use crate::explore::{Belief, Explorer, Hypothesis};
use crate::fitted::{AlternativeTerm, FittedModel, Found, MechanismTerm, SelectedTerm, laws, next_scale};
use crate::gates::{Gates, defend};
use crate::proposal::{Gate, Rejected};
use crate::search::{Search, limits, same_level};
use crate::validate::Gain;

/// A closure that can be handed back, in the place of what stands.
pub(crate) struct Closed {
    pub(crate) found: Found,
    pub(crate) polished: WholeRecordFit,
    /// How its simulations of the training recordings are judged.
    pub(crate) misfit: f64,
    /// Whether they leave no more than noise.
    pub(crate) leaves_noise: bool,
}

impl Closed {
    /// The closure that begins with the calibrated model or, where that leaves more than noise and it simulates better, the one
    /// that begins with what stands. Where none passes the gates, the last that failed, if there was one at all.
    pub(crate) fn of(
        search: &Search<'_>,
        found: &Found,
        polished: &WholeRecordFit,
        baseline: &Baseline,
        judge: &Judge,
    ) -> Result<Closed, Option<Rejected>> {
        let mut from = vec![&found.calibrated];
        if !polished.fitted.parts.is_empty() {
            from.push(&found.improved);
        }
        let gates = Gates::of_a_closure(search, &polished.fitted, baseline, judge);
        let mut visited = Visited::default();
        let (mut best, mut rejected): (Option<Closed>, _) = (None, None);
        for from in from {
            let Some(closed) = search.closure(found, from, &mut visited) else { continue };
            let closed = match Closed::defended(search, closed, &gates, judge) {
                Ok(closed) => closed,
                Err(failed) => {
                    rejected = Some(failed);
                    continue;
                }
            };
            if best.as_ref().is_none_or(|best| closed.misfit.total_cmp(&best.misfit).is_lt()) {
                best = Some(closed);
            }
            // (There is no less than noise.)
            if best.as_ref().is_some_and(|best| best.leaves_noise) {
                break;
            }
        }
        let mut best = best.ok_or(rejected)?;
        best.found.accepted = search.accepted(found, &best.found);
        Ok(best)
    }

    /// A closure that passes all gates, without what whole recordings do not determine; else what fails, and where.
    fn defended(
        search: &Search<'_>,
        found: Found,
        gates: &Gates<'_>,
        judge: &Judge,
    ) -> Result<Closed, Rejected> {
        let mut found = found;
        loop {
            search.listener.stage(Stage::Simulating);
            let polished = polish(search, &found.improved, &found.scale, judge);
            let Some(failure) = gates.failure(&polished, &found.scale) else {
                return Ok(Closed::new(found, polished, judge));
            };
            // Whole recordings may not tell what segments with free starts told.
            let smaller = match (failure.gate, &failure.parts[..]) {
                (Gate::Determined, [part]) => search.smaller(&found.improved, *part, &found.scale),
                _ => None,
            };
            match smaller {
                Some(smaller) if !smaller.parts.is_empty() => found.improved = smaller,
                _ => return Err(Rejected::at(failure.gate, search, &polished.fitted)),
            }
        }
    }

    pub(crate) fn new(found: Found, polished: WholeRecordFit, judge: &Judge) -> Closed {
        let fitted = &polished.fitted;
        let scale = residual_scale(fitted, &found.scale);
        let scores = judge.scores(&fitted.setup, &fitted.fit.point.parameters, &scale);
        let (misfit, leaves_noise) =
            (judge.criterion.misfit(&scores), leaves_noise(&scores, &polished.origin, &scale));
        Closed { found, polished, misfit, leaves_noise }
    }

    /// Whether it simulates the training recordings better than what stands, and predicts what was left out of its fit
    /// better: beyond chance where that has names, on the whole where it is a proposal as well.
    pub(crate) fn outdoes(
        &self,
        (found, polished): (&Found, &WholeRecordFit),
        has_names: bool,
        judge: &Judge,
    ) -> bool {
        let errors = |found: &Found, polished: &WholeRecordFit| {
            judge.errors(polished, &residual_scale(&polished.fitted, &found.scale))
        };
        let scale = residual_scale(&polished.fitted, &found.scale);
        let (setup, parameters) = (&polished.fitted.setup, &polished.fitted.fit.point.parameters);
        self.misfit.total_cmp(&judge.misfit(setup, parameters, &scale)).is_lt() && {
            let gain = Gain::of(&errors(found, polished), &errors(&self.found, &self.polished));
            if has_names { gain.is_beyond_chance() } else { gain.mean > 0.0 }
        }
    }

    /// Of the names that stand those that it holds and that no other terms can have the place of. `None` where it leaves
    /// more than noise and does not hold them all.
    pub(crate) fn names(&self, search: &Search<'_>, standing: &[&Candidate]) -> Option<Vec<Candidate>> {
        let parts = &self.polished.fitted.parts;
        let held: Vec<usize> =
            (0..parts.len()).filter(|&i| standing.contains(&&parts[i].candidate)).collect();
        (self.leaves_noise || held.len() == standing.len()).then(|| {
            let named = held.into_iter().filter(|&i| !search.is_replaceable(&self.found, i));
            named.map(|i| parts[i].candidate.clone()).collect()
        })
    }
}

/// What the exploration finds beside an error of the model, if it can be defended and says more than what stands. Where
/// nothing is named yet, it names laws or simulates better. Where laws are named, it has one of them (`agreed`) and simulates
/// better.
pub(crate) fn explored(
    search: &Search<'_>,
    (found, polished): (&Found, &WholeRecordFit),
    agreed: impl Fn(&MechanismTerm) -> bool,
    names: bool,
    baseline: &Baseline,
    judge: &Judge,
) -> Option<Explored> {
    search.listener.stage(Stage::Exploring);
    let calibrated = &found.calibrated;
    let explorer = Explorer::new(search, &calibrated.setup);
    let posterior = explorer.explore(&calibrated.fit.point.parameters, &[&found.improved])?;
    let beliefs = posterior.chosen.parts.iter().zip(&posterior.beliefs);
    let mut named: Vec<Candidate> =
        beliefs.filter(|(_, b)| b.named).map(|(part, _)| part.candidate.clone()).collect();
    let likeliest = posterior.tried.as_ref().unwrap_or(&posterior.chosen);
    if likeliest.parts.is_empty() {
        return None;
    }
    let mut adopted = adopt(search, found, likeliest, &posterior.beliefs)?;
    let own = polish(search, &adopted.improved, &adopted.scale, judge);
    let own = defend(search, &mut adopted, own, baseline, judge, false);
    let (parts, standing) = (&own.fitted.parts, &polished.fitted.parts);
    let known = |part: &MechanismTerm| standing.iter().any(|p| p.candidate == part.candidate);
    let is_same = parts.len() == standing.len() && parts.iter().all(known);
    if parts.is_empty() || names && is_same {
        return None;
    }
    let misfit = |p: &WholeRecordFit, scale: &[f64]| {
        let scale = residual_scale(&p.fitted, scale);
        judge.misfit(&p.fitted.setup, &p.fitted.fit.point.parameters, &scale)
    };
    let is_better = || misfit(&own, &adopted.scale).total_cmp(&misfit(polished, &found.scale)).is_lt();
    named.retain(|candidate| parts.iter().any(|part| part.candidate == *candidate));
    let takes_over =
        if names { parts.iter().any(agreed) && is_better() } else { !named.is_empty() || is_better() };
    adopted.limited |= posterior.limited;
    takes_over.then_some(Explored { found: adopted, polished: own, named })
}

/// What an exploration hands back.
pub(crate) struct Explored {
    pub(crate) found: Found,
    pub(crate) polished: WholeRecordFit,
    /// The candidates whose names the data hold.
    pub(crate) named: Vec<Candidate>,
}

/// A hypothesis fitted to the segments of what this search found, in its place.
fn adopt(search: &Search<'_>, found: &Found, h: &Hypothesis, beliefs: &[Belief]) -> Option<Found> {
    let at = &h.fitted.at;
    let n0 = search.nominal().model.parameters.len();
    let laws = laws(&h.parts, &at.setup.model, &at.parameters);
    let (setup, parts) = search.assemble(&at.setup.holds, &at.parameters[..n0], &laws, &at.setup).ok()?;
    let setup = Setup { noise: None, work: search.nominal().work.clone(), ..setup };
    let level = same_level(&setup, &found.calibrated.level);
    let starts = setup.starts(&level, &at.parameters);
    let point = Point { parameters: at.parameters.clone(), starts };
    let fit = setup.fit(&level, &found.scale, &[point], limits(15));
    if !fit.cost.is_finite() {
        return None;
    }
    let mut improved = FittedModel { setup, parts, level, fit };
    let scale = next_scale(&improved.fit, &found.scale, &search.nominal().data.sigma);
    search.method(&mut improved, &scale);
    improved = search.refit(&improved, &scale, 10);
    let score = |gain: f64| Evidence { score: 2.0 * gain, ..Evidence::NONE };
    let accepted = improved.parts.iter().zip(beliefs).map(|(part, belief)| SelectedTerm {
        candidate: part.candidate.clone(),
        evidence: score(belief.gain),
        alternatives: belief
            .others
            .iter()
            .map(|other| AlternativeTerm {
                candidate: other.part.candidate.clone(),
                instance: other.part.instance.clone(),
                evidence: score(belief.gain + (other.probability / belief.probability).ln()),
                equivalent: other.equivalent,
            })
            .collect(),
    });
    let accepted = accepted.collect();
    Some(Found {
        calibrated: found.calibrated.clone(),
        improved,
        accepted,
        better_holds: found.better_holds.clone(),
        scale,
        limited: found.limited,
        rejected: Vec::new(),
        errs: true,
        closed: false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::built_in;

    /// A closure takes the place of what it simulates better than, and keeps the names that it holds; where it leaves more than
    /// noise it must hold them all.
    #[test]
    fn a_closure_is_better_than_what_stands_and_holds_its_names() {
        use crate::closure::tests::{bodies, nothing};
        let library = built_in().unwrap();
        let friction = |[_, _, v, ..]: [f64; 5]| [0.8 * f64::tanh(1e3 * v), 0.0, 0.0];
        let search = Search::new(bodies(&friction, 62), &library, &crate::Quiet);
        let found = nothing(&search);
        let judge = Judge::of(&found.calibrated, &residual_scale(&found.calibrated, &found.scale));
        let baseline = Baseline::of(&found, &search.nominal().values(), &judge);
        let closure = search.closure(&found, &found.calibrated, &mut Visited::default()).unwrap();
        let polished = polish(&search, &closure.improved, &closure.scale, &judge);
        let closed = Closed::new(closure, polished, &judge);
        assert!(closed.leaves_noise);
        for has_names in [false, true] {
            assert!(closed.outdoes((&found, &baseline.polished), has_names, &judge));
            assert!(
                !closed.outdoes((&closed.found, &closed.polished), has_names, &judge),
                "it is no better than itself"
            );
        }
        let own = closed.polished.fitted.parts[0].candidate.clone();
        assert_eq!(library[own.mechanism].kind, "coulomb_friction");
        let is_other = |c: &&Candidate| library[c.mechanism].kind == "cubic_stiffness";
        let other = search.terms().find(is_other).unwrap();
        assert_eq!(closed.names(&search, &[&own]), Some(vec![own.clone()]));
        assert_eq!(
            closed.names(&search, &[&own, other]),
            Some(vec![own.clone()]),
            "there is no less than noise"
        );
        let leaves_more = Closed { leaves_noise: false, ..closed };
        assert_eq!(leaves_more.names(&search, &[&own]), Some(vec![own.clone()]));
        assert_eq!(leaves_more.names(&search, &[&own, other]), None);
    }
}
