//! Reconsideration: the model with an alternative in place of each mechanism, without it, and with simpler laws.

use rayon::prelude::*;

use super::{LAST_STEPS, MOST_MECHANISMS, PAIR_SAMPLES, PAIRS, PARSIMONY, Search, SearchState};
use crate::Stage;
use crate::candidate::{Candidate, Instance};
use crate::fitted::{AlternativeTerm, FittedModel, MechanismTerm, SelectedTerm, WHITE, is_same};
use crate::screen::{first_values, inner_scales, screen, screen_pairs};
use crate::trajectory::TrajectoryEval;

/// Most candidates that a mechanism is held against once more, beside its relatives.
const ALTERNATIVES: usize = 6;
/// Share of a law's strength by which a refinement's differs, to matter.
const SUBSTANTIAL: f64 = 0.5;
/// Score that a mechanism keeps, or goes.
const LEAST_SCORE: f64 = 10.0;

impl Search<'_> {
    /// Second thoughts; where they change the model, whether it lacks something still. Mechanisms that were thought of before
    /// would lead to the same again.
    pub(super) fn refine_structure(&self, calibrated: &mut FittedModel, state: &mut SearchState) {
        let mut seen: Vec<Vec<Candidate>> = Vec::new();
        while seen.len() < MOST_MECHANISMS && !self.is_spent() {
            let before = state.candidates();
            if seen.iter().any(|s| is_same(s, &before)) {
                break;
            }
            self.reconsider(calibrated, state);
            if state.candidates() == before {
                break;
            }
            seen.push(before);
            let after = state.candidates();
            self.level(calibrated, state);
            if state.candidates() == after {
                break;
            }
        }
    }

    /// Every mechanism again, with all others in place and the segments at their longest: what else could
    /// stand in its stead? The better (or the simpler of equals) takes its place; the others are the
    /// alternatives of the report.
    fn reconsider(&self, calibrated: &FittedModel, state: &mut SearchState) {
        self.reconsider_pair(state);
        let mut index = 0;
        let mut relieved = 0;
        // What was tried in place of the standing mechanisms: without one and the other of two, a law leads to the same.
        let mut tried: Vec<Vec<Candidate>> = Vec::new();
        let mut standing = state.candidates();
        while index < state.current.parts.len() && !self.is_spent() {
            if state.candidates() != standing {
                standing = state.candidates();
                tried.clear();
            }
            let at = index;
            index += 1;
            let Some(base) = self.without(&state.current, at, &state.scale, 12) else { continue };
            let part = state.current.parts[at].clone();
            let taken = |c: &Candidate| base.parts.iter().any(|p| p.candidate == *c);
            let open: Vec<Candidate> = self.all.iter().filter(|c| !taken(c)).cloned().collect();
            self.listener.stage(Stage::Screening { candidates: open.len(), found: base.parts.len() });
            let scored = screen(base.at(&state.scale), self.library, &open);
            let relatives = &self.library[part.candidate.mechanism].about.confused_with;
            let mut short = self.short_list(&open, &scored, 0.003, ALTERNATIVES, state.near_equals());
            // Those it is confused with at the same place, even where the score test ranks them low.
            for s in &scored {
                let c = &open[s.candidate];
                let kind = &self.library[c.mechanism].kind;
                if relatives.contains(kind)
                    && !short.iter().any(|o| self.library[open[o.candidate].mechanism].kind == *kind)
                {
                    short.push(s);
                }
            }
            short.retain(|s| open[s.candidate] != part.candidate);
            let mut trials = self.all_trials(&base, state, &open, &short, 0.003);
            trials.retain(|(c, _)| open[*c] != part.candidate);
            if let Some(own) = open.iter().position(|c| *c == part.candidate) {
                // The fit that stands, its part at the end like that of the others.
                let mut last = state.current.clone();
                last.parts.remove(at);
                last.parts.push(part.clone());
                trials.push((own, last));
            }
            // Of those that fit as well: one that makes another mechanism superfluous.
            if relieved < MOST_MECHANISMS
                && self.swap_and_drop(&base, state, &open, (&trials, &mut tried), &part)
            {
                // From the first again: fewer mechanisms, other alternatives.
                relieved += 1;
                index = 0;
                continue;
            }
            let Some((winner, chosen, alternatives, evidence)) =
                self.decide(calibrated, &base, &open, trials, &state.scale)
            else {
                continue;
            };
            let known = state.accepted.iter_mut().find(|a| a.candidate == part.candidate);
            if winner == part.candidate {
                if let Some(known) = known {
                    // What equals it exactly stays declared so.
                    let before = std::mem::replace(&mut known.alternatives, alternatives);
                    for old in before.into_iter().filter(|r| r.equivalent) {
                        match known.alternatives.iter_mut().find(|r| r.candidate == old.candidate) {
                            Some(new) => new.equivalent = true,
                            None => known.alternatives.push(old),
                        }
                    }
                    known.evidence = evidence;
                }
                continue;
            }
            let mechanism = &self.library[winner.mechanism];
            // On few data, what was found on short segments is not traded for a whim of the long ones.
            let believable = state.current.fit.count.iter().sum::<usize>() >= PAIR_SAMPLES
                && self.accepts(&evidence, mechanism, 1.0, base.parts.is_empty(), state.allow_rare);
            self.tell((&base, &chosen), &[&mechanism.kind], &evidence, &state.scale, believable);
            if !believable {
                continue;
            }
            state.accepted.retain(|a| a.candidate != part.candidate);
            self.accept(state, winner, chosen, alternatives, evidence);
        }
    }

    /// Two mechanisms of one family may be the round-about way to another two that only pay together (which
    /// the search, one at a time, does not see): the best simpler pair that fits as well takes their place.
    fn reconsider_pair(&self, state: &mut SearchState) {
        let current = state.current.clone();
        let family = |p: &MechanismTerm| &self.library[p.candidate.mechanism].family;
        let samples: usize = current.fit.count.iter().sum();
        let [first, second] = &current.parts[..] else { return };
        if family(first) != family(second) || self.complexity(&current) <= 2.0 || samples < PAIR_SAMPLES {
            return;
        }
        let scale = state.scale.clone();
        let Some(base) =
            self.without(&current, 1, &scale, 12).and_then(|one| self.without(&one, 0, &scale, 12))
        else {
            return;
        };
        let pairs = screen_pairs(base.at(&scale), self.library, &self.all, PAIRS);
        self.listener.stage(Stage::Fitting { candidates: pairs.len() });
        let best = pairs
            .par_iter()
            .filter_map(|p| self.extend_by_pair(&base, &self.all, p, &scale))
            .filter(|f| self.complexity(f) < self.complexity(&current))
            .collect::<Vec<_>>()
            .into_iter()
            .min_by(|a, b| a.rss().total_cmp(&b.rss()));
        let Some(best) = best else { return };
        let evidence = self.weigh(&base, &best, &scale);
        if evidence.score + PARSIMONY > self.weigh(&base, &current, &scale).score {
            state.accepted = best
                .parts
                .iter()
                .map(|p| SelectedTerm { candidate: p.candidate.clone(), evidence, alternatives: Vec::new() })
                .collect();
            state.current = best;
            self.settle(state);
        }
    }

    /// Takes over a trial that fits nearly as well as the standing one and lets another mechanism go. What was `tried` so is not
    /// tried again.
    fn swap_and_drop(
        &self,
        base: &FittedModel,
        state: &mut SearchState,
        open: &[Candidate],
        (trials, tried): (&[(usize, FittedModel)], &mut Vec<Vec<Candidate>>),
        standing: &MechanismTerm,
    ) -> bool {
        if state.current.parts.len() < 2 {
            return false;
        }
        let best = state.current.rss();
        for (c, trial) in trials {
            let near = trial.rss() < 1.02 * best;
            let whole = !self.library[open[*c].mechanism].equals.is_empty();
            if !near
                || whole
                || open[*c] == standing.candidate
                || trial.parts.len() != state.current.parts.len()
            {
                continue;
            }
            for index in 0..trial.parts.len() - 1 {
                let mut left: Vec<Candidate> = trial.parts.iter().map(|p| p.candidate.clone()).collect();
                left.remove(index);
                if tried.iter().any(|t| is_same(t, &left)) {
                    continue;
                }
                let Some(smaller) = self.without(trial, index, &state.scale, 12) else { continue };
                tried.push(left);
                let e = self.weigh(&smaller, &state.current, &state.scale);
                if e.score > PARSIMONY || e.drop > 0.02 {
                    continue;
                }
                let evidence = self.weigh(base, trial, &state.scale);
                state.accepted.retain(|a| smaller.parts.iter().any(|p| p.candidate == a.candidate));
                state.accepted.push(SelectedTerm {
                    candidate: open[*c].clone(),
                    evidence,
                    alternatives: Vec::new(),
                });
                state.current = smaller;
                self.settle(state);
                return true;
            }
        }
        false
    }

    /// The model with a law in place of its refinement, from the refinement's parameters.
    fn simpler(&self, fitted: &FittedModel, index: usize, scale: &[f64]) -> Option<FittedModel> {
        let mut parts = self.laws(fitted);
        let (refinement, values, _) = &parts[index];
        let law = self.all.iter().find(|c| self.is_refined_by(c, refinement))?;
        if parts.iter().any(|p| p.0 == *law) {
            return None;
        }
        let mechanism = &self.library[refinement.mechanism];
        let known: Vec<(&str, f64)> = mechanism.parameters().zip(values.iter().copied()).collect();
        let strength = known
            .iter()
            .filter(|(n, _)| mechanism.linear.iter().any(|l| l == n))
            .map(|k| k.1)
            .max_by(|a, b| a.abs().total_cmp(&b.abs()))?;
        let inner = &self.library[law.mechanism];
        let values = inner.parameters().map(|n| {
            let linear = inner.linear.iter().any(|l| l == n);
            if linear { Some(strength) } else { known.iter().find(|k| k.0 == n).map(|k| k.1) }
        });
        parts[index] = (law.clone(), values.collect::<Option<_>>()?, Vec::new());
        self.reassembled(fitted, &parts, scale, LAST_STEPS)
    }

    /// Drops what no longer pays.
    pub(super) fn prune(&self, state: &mut SearchState) {
        let mut index = 0;
        // What was found on coloured residuals stands the test of white ones, or goes.
        let least_parts = if state.current.setup.noise.is_some() { 0 } else { 1 };
        while state.current.parts.len() > least_parts && index < state.current.parts.len() {
            let Some(smaller) = self.without(&state.current, index, &state.scale, 12) else {
                index += 1;
                continue;
            };
            let e = self.weigh(&smaller, &state.current, &state.scale);
            // A little less than what it takes to be accepted, or rounds would go in circles.
            let least = match (e.whitened, e.effective_sample_ratio > WHITE) {
                (true, _) => 0.0025,
                (false, true) => 0.004,
                (false, false) => 0.01,
            };
            if e.score < LEAST_SCORE || e.drop < least {
                let gone = state.current.parts[index].candidate.clone();
                self.listener.dropped(&self.library[gone.mechanism].kind);
                state.accepted.retain(|a| a.candidate != gone);
                state.current = smaller;
                index = 0;
            } else {
                index += 1;
            }
        }
    }

    /// Puts a law in the place of its refinement where it fits as well. It begins with the refinement's parameters: from
    /// elsewhere, as one alternative among many, it may not get there.
    pub(super) fn simplify(&self, state: &mut SearchState) {
        for index in 0..state.current.parts.len() {
            let MechanismTerm { candidate: refinement, instance, .. } = state.current.parts[index].clone();
            let mechanism = &self.library[refinement.mechanism];
            if mechanism.refines.is_empty() {
                continue;
            }
            let Some(simpler) = self.simpler(&state.current, index, &state.scale) else { continue };
            let over = self.weigh(&simpler, &state.current, &state.scale);
            // What the data do not show must earn its place as any mechanism; what they show, as any of two laws.
            let undetermined = self.is_undetermined(&state.current, index, &state.scale);
            if over.score >= if undetermined { LEAST_SCORE } else { PARSIMONY } {
                continue;
            }
            let Some(base) = self.without(&simpler, index, &state.scale, 12) else { continue };
            let evidence = self.weigh(&base, &simpler, &state.scale);
            self.listener.dropped(&mechanism.kind);
            let law = simpler.parts[index].candidate.clone();
            if let Some(known) = state.accepted.iter_mut().find(|a| a.candidate == refinement) {
                known.alternatives.retain(|r| r.candidate != law);
                let before = std::mem::replace(&mut known.evidence, evidence);
                known.candidate = law;
                let alternative =
                    AlternativeTerm { candidate: refinement, instance, evidence: before, equivalent: true };
                known.alternatives.insert(0, alternative);
            }
            state.current = simpler;
        }
    }

    /// Declares refinements that these recordings would not show equals of the law that they refine: that BIC prefers
    /// the law says then no more than that it is the simpler.
    pub(super) fn mark_unidentifiable(&self, state: &mut SearchState) {
        for index in 0..state.current.parts.len() {
            let law = state.current.parts[index].candidate.clone();
            let Some(known) = state.accepted.iter_mut().find(|a| a.candidate == law) else { continue };
            for refinement in self.all.iter().filter(|c| self.is_refined_by(&law, c)) {
                if known.alternatives.iter().any(|r| r.equivalent && r.candidate == *refinement) {
                    continue;
                }
                if self.is_spent() {
                    return;
                }
                let Some(instance) = self.unseen(&state.current, index, refinement, &state.scale) else {
                    continue;
                };
                match known.alternatives.iter_mut().find(|r| r.candidate == *refinement) {
                    Some(alternative) => alternative.equivalent = true,
                    None => known.alternatives.push(AlternativeTerm {
                        candidate: refinement.clone(),
                        instance,
                        evidence: known.evidence,
                        equivalent: true,
                    }),
                }
            }
        }
    }

    /// A refinement that may be there unseen, in place of the law that it refines: at half or more of the first values
    /// of its inner parameters the 95 % interval of one of its strengths reaches further than [`SUBSTANTIAL`] from the
    /// law's. Only of a refinement that is the law itself where its strengths are the law's.
    fn unseen(
        &self,
        fitted: &FittedModel,
        index: usize,
        refinement: &Candidate,
        scale: &[f64],
    ) -> Option<Instance> {
        let parts = self.laws(fitted);
        let (law, mechanism) = (&self.library[parts[index].0.mechanism], &self.library[refinement.mechanism]);
        let ([_], [strength]) = (&law.linear[..], &parts[index].1[..]) else { return None };
        if !mechanism.is_at_equal_strengths(law) {
            return None;
        }
        let along = TrajectoryEval::smoothed(fitted.at(scale));
        let scales = inner_scales(mechanism, refinement, &along, &fitted.setup)?;
        let choices = first_values(mechanism, &scales);
        let at = |inner: &Vec<f64>| -> Option<(bool, Instance)> {
            let mut parts = parts.clone();
            let values = mechanism.values(&vec![*strength; mechanism.linear.len()], inner)?;
            parts[index] = (refinement.clone(), values, scales.clone());
            let held = self.held(fitted, &parts, index, scale)?;
            let instance = held.parts[index].instance.clone();
            Some((self.may_differ(&held, index, *strength, scale), instance))
        };
        let found: Vec<(bool, Instance)> = choices.par_iter().filter_map(at).collect();
        let unseen = found.iter().filter(|f| f.0).count();
        (2 * unseen >= choices.len()).then(|| found.into_iter().next().map(|f| f.1)).flatten()
    }

    /// Whether an admissible end of the 95 % interval of one of a part's strengths lies further than [`SUBSTANTIAL`]
    /// from this one.
    fn may_differ(&self, fitted: &FittedModel, index: usize, strength: f64, scale: &[f64]) -> bool {
        let admissible = |at: usize, value: f64| {
            let mut parameters = fitted.fit.point.parameters.clone();
            parameters[at] = value;
            self.allows(&fitted.parts[index], &fitted.setup, &parameters)
        };
        self.strengths(fitted, index, scale).iter().any(|s| {
            [(s.value - s.width).max(s.least), s.value + s.width]
                .iter()
                .any(|end| (end - strength).abs() > SUBSTANTIAL * strength.abs() && admissible(s.index, *end))
        })
    }
}
