//! A round of the search: candidates by the score test, trials of the best, and the decision for one, or for a pair.

use greybox_calibrate::{Ending, Point, Setup};
use rayon::prelude::*;

use super::compare::{by_likelihood, calibrated_rss};
use super::fit::transfer;
use super::{
    BEST, FAR_FROM_NOISE, FINALISTS, FIRST_STEPS, LAST_STEPS, LEAST_SHARE, MORE_STEPS, MOST_MECHANISMS,
    PAIR_SAMPLES, PAIRS, PARSIMONY, SHORT_LIST, STARTS, Search, SearchState, UNDECIDED, limits,
};
use crate::Stage;
use crate::candidate::Candidate;
use crate::evidence::{Evidence, effective_sample_ratio};
use crate::fitted::{AlternativeTerm, FittedModel, SelectedTerm, WHITE};
use crate::place::Place;
use crate::screen::{Scored, screen, screen_pairs};
use crate::uncertainty::Uncertainty;

/// Share of the best gain from which one more of every other kind is fitted.
const NEARLY: f64 = 0.5;
/// Residual over noise from which pairs are tried.
const PAIR_MISFIT: f64 = 1.1;
/// Factor by which calibration may move a parameter before a model far from the noise is in doubt for it.
const MOVED: f64 = 2.0;
/// Share of the misfit that each parameter more must buy far from the noise.
const SHARE_PER_PARAMETER: f64 = 0.05;
/// Whitened scores that differ by less are the same.
const SAME_SCORE: f64 = 1.0;

impl Search<'_> {
    /// When no single candidate is believable and yet something is missing: the best pairs of those that
    /// only pay together.
    fn pair_round(&self, calibrated: &mut FittedModel, state: &mut SearchState) -> bool {
        if state.current.parts.len() + 2 > MOST_MECHANISMS || state.misfit() < PAIR_MISFIT {
            return false;
        }
        let current = state.current.clone();
        let scale = state.scale.clone();
        let open: Vec<Candidate> =
            self.all.iter().filter(|c| !current.parts.iter().any(|p| p.candidate == **c)).cloned().collect();
        let pairs = screen_pairs(current.at(&scale), self.library, &open, PAIRS);
        self.listener.stage(Stage::Fitting { candidates: pairs.len() });
        let trials: Vec<FittedModel> =
            pairs.par_iter().filter_map(|p| self.extend_by_pair(&current, &open, p, &scale)).collect();
        let Some(best) = trials.into_iter().min_by(|a, b| a.rss().total_cmp(&b.rss())) else {
            return false;
        };
        // (Beside a single candidate that was not believed either.)
        state.rejected.push(best.clone());
        let control = self.refit_baseline(&current, &best, &scale);
        let evidence = self.weigh(&control, &best, &scale);
        let share = (control.rss() - best.rss()) / calibrated_rss(calibrated, &scale).max(1e-300);
        let first = current.parts.is_empty();
        let members = &best.parts[best.parts.len() - 2..];
        let kinds: Vec<&str> =
            members.iter().map(|part| &*self.library[part.candidate.mechanism].kind).collect();
        // There are n²/2 pairs to choose from; of few samples, one of them always fits.
        let samples: usize = state.current.fit.count.iter().sum();
        let believable = samples >= PAIR_SAMPLES
            && evidence.score > self.threshold(2)
            && members.iter().all(|part| {
                self.accepts(&evidence, &self.library[part.candidate.mechanism], share, first, false)
            });
        self.tell((&control, &best), &kinds, &evidence, &scale, believable);
        if !believable {
            return false;
        }
        for part in members {
            state.accepted.push(SelectedTerm {
                candidate: part.candidate.clone(),
                evidence,
                alternatives: Vec::new(),
            });
        }
        state.current = best;
        self.settle(state);
        state.current.parts.len() >= current.parts.len() + 2
    }

    /// One level: rounds until nothing more is believable.
    pub(super) fn level(&self, calibrated: &mut FittedModel, state: &mut SearchState) {
        let mut seen: Vec<Vec<Candidate>> = Vec::new();
        // A round is dearer than the one before, which had a mechanism less to simulate.
        let mut last = 0;
        while state.current.parts.len() < MOST_MECHANISMS && !self.would_overspend(last) {
            let begun = self.nominal.work.done();
            if state.misfit() < 1.03 && !self.is_coloured(state, WHITE) && state.current.setup.noise.is_none()
            {
                break;
            }
            let before = state.candidates();
            if !self.round(calibrated, state) && !self.pair_round(calibrated, state) {
                break;
            }
            last = self.nominal.work.done() - begun;
            seen.push(before);
            if seen.contains(&state.candidates()) {
                break; // what was accepted has been dropped again
            }
        }
    }

    /// One round: the best candidate, if it is believable.
    pub(super) fn round(&self, calibrated: &mut FittedModel, state: &mut SearchState) -> bool {
        let current = &state.current;
        let scale = state.scale.clone();
        let taken = |c: &Candidate| {
            current.parts.iter().any(|p| {
                p.candidate == *c
                    || (p.candidate.place == c.place
                        && self.library[p.candidate.mechanism]
                            .refines
                            .contains(&self.library[c.mechanism].kind))
            })
        };
        let open: Vec<Candidate> = self.all.iter().filter(|c| !taken(c)).cloned().collect();
        self.listener.stage(Stage::Screening { candidates: open.len(), found: current.parts.len() });
        let scored = screen(current.at(&scale), self.library, &open);
        let ranking: Vec<(&str, f64)> =
            scored.iter().map(|s| (&*self.library[open[s.candidate].mechanism].kind, s.gain)).collect();
        self.listener.screened(&ranking);
        let least = if current.setup.noise.is_some() { 0.001 } else { 0.003 };
        let short = self.short_list(&open, &scored, least, SHORT_LIST, state.near_equals());
        let trials = self.all_trials(current, state, &open, &short, least);
        if trials.is_empty() {
            return false;
        }
        let Some((winner, chosen, alternatives, evidence)) =
            self.decide(calibrated, current, &open, trials, &scale)
        else {
            return false;
        };
        // Control: the smaller model from the winner's parameters. If that is better than it was, the
        // baseline had been stuck.
        let control = self.refit_baseline(current, &chosen, &scale);
        let evidence = if control.fit.cost < current.fit.cost * 0.999 {
            if current.parts.is_empty() && current.setup.noise.is_none() {
                *calibrated = control.clone();
            }
            state.current = control;
            self.weigh(&state.current, &chosen, &scale)
        } else {
            evidence
        };
        let total: f64 = calibrated_rss(calibrated, &scale);
        let share =
            if evidence.whitened { 1.0 } else { (state.current.rss() - chosen.rss()) / total.max(1e-300) };
        let mechanism = &self.library[winner.mechanism];
        let believable =
            self.accepts(&evidence, mechanism, share, state.current.parts.is_empty(), state.allow_rare);
        self.tell((&state.current, &chosen), &[&mechanism.kind], &evidence, &scale, believable);
        if !believable {
            state.rejected = vec![chosen];
            return false;
        }
        self.accept(state, winner, chosen, alternatives, evidence);
        true
    }

    /// Other points from which candidates are tried, where what calibration has made of the model may be the
    /// work of what is missing:
    ///
    /// - with the stated holds, where others fit better: half a sample of delay may be a delay;
    /// - at the nominal parameters, where the calibrated ones are far from them and the simulation still far
    ///   from the recording: a strong friction is taken for an inertia and a damping many times too large, and
    ///   no friction helps there.
    fn anchors(&self, current: &FittedModel, state: &SearchState) -> Vec<FittedModel> {
        let mut out = Vec::new();
        if !current.parts.is_empty() {
            return out; // what was found has changed the model already
        }
        let stated = current.setup.with_holds(self.nominal.holds.clone());
        if current.setup.holds != self.nominal.holds {
            let fitted = FittedModel { setup: stated.clone(), ..current.clone() };
            out.push(self.refit(&fitted, &state.scale, 10));
        }
        if current.setup.noise.is_none() && current.misfit(&state.scale) > FAR_FROM_NOISE {
            let nominal = self.nominal.values();
            let moved = current.setup.free.iter().any(|f| {
                let (was, is) = (nominal[f.index], current.fit.point.parameters[f.index]);
                !(1.0 / MOVED..=MOVED).contains(&(is / was))
            });
            if moved {
                let starts = current.setup.starts(&current.level, &nominal);
                let held = Setup { free: Vec::new(), ..stated.clone() };
                let start = Point { parameters: nominal, starts };
                let fit = held.fit(&current.level, &state.scale, &[start], limits(STARTS));
                out.push(FittedModel { setup: stated, fit, ..current.clone() });
            }
        }
        out.retain(|f| f.fit.cost.is_finite());
        out
    }

    /// Fits a short-list from `base`, and what ranks high at its anchors from these: of each candidate the better.
    pub(super) fn all_trials(
        &self,
        base: &FittedModel,
        state: &SearchState,
        open: &[Candidate],
        short: &[&Scored],
        least: f64,
    ) -> Vec<(usize, FittedModel)> {
        let scale = &state.scale;
        let anchors: Vec<(FittedModel, Vec<Scored>)> = self
            .anchors(base, state)
            .into_iter()
            .map(|a| {
                let scored = screen(a.at(scale), self.library, open);
                (a, scored)
            })
            .collect();
        let anchored: Vec<(&FittedModel, Vec<&Scored>)> =
            anchors.iter().map(|(a, s)| (a, self.short_list(open, s, least, SHORT_LIST, 0))).collect();
        let candidates = short.len() + anchored.iter().map(|a| a.1.len()).sum::<usize>();
        if candidates > 0 {
            self.listener.stage(Stage::Fitting { candidates });
        }
        let mut trials = self.trials(base, open, short, scale);
        for (anchor, short) in anchored {
            for (c, fitted) in self.trials(anchor, open, &short, scale) {
                match trials.iter_mut().find(|t| t.0 == c) {
                    Some(known) if fitted.fit.cost < known.1.fit.cost => known.1 = fitted,
                    Some(_) => {}
                    None => trials.push((c, fitted)),
                }
            }
        }
        trials
    }

    /// Fits a short-list: all of it a little, the more promising half further, the best to the end.
    pub(super) fn trials(
        &self,
        base: &FittedModel,
        open: &[Candidate],
        short: &[&Scored],
        scale: &[f64],
    ) -> Vec<(usize, FittedModel)> {
        let mut trials: Vec<(usize, FittedModel)> = short
            .par_iter()
            .filter_map(|s| self.trial(base, &open[s.candidate], s, scale).map(|f| (s.candidate, f)))
            .collect();
        trials.sort_by(|a, b| a.1.rss().total_cmp(&b.1.rss()).then(a.0.cmp(&b.0)));
        let rest = trials.split_off(trials.len().min(FINALISTS));
        let go_on = |trials: Vec<(usize, FittedModel)>, steps: usize| -> Vec<(usize, FittedModel)> {
            trials
                .into_par_iter()
                .map(|(c, f)| {
                    (c, if f.fit.ending == Ending::Limit { self.refit(&f, scale, steps) } else { f })
                })
                .filter(|(_, f)| self.admissible(f, scale))
                .collect()
        };
        let mut finished = go_on(trials, MORE_STEPS);
        // The best of these to the very end, or the one that started better would win.
        finished.sort_by(|a, b| a.1.rss().total_cmp(&b.1.rss()).then(a.0.cmp(&b.0)));
        let others = finished.split_off(finished.len().min(BEST));
        finished = go_on(finished, LAST_STEPS);
        finished.extend(others);
        finished.extend(rest);
        finished
    }

    /// The `most` strongest candidates, no more than two of a kind, and up to `more` of other kinds near the best.
    pub(crate) fn short_list<'s>(
        &self,
        open: &[Candidate],
        scored: &'s [Scored],
        least: f64,
        most: usize,
        more: usize,
    ) -> Vec<&'s Scored> {
        let mut short: Vec<&Scored> = Vec::new();
        for s in scored {
            let kind = &self.library[open[s.candidate].mechanism].kind;
            let of_kind =
                short.iter().filter(|o| self.library[open[o.candidate].mechanism].kind == *kind).count();
            // A test of first order ranks no finer than this: of every kind at least one.
            let near = of_kind == 0 && s.gain > NEARLY * scored[0].gain && short.len() < most + more;
            if s.gain > least && of_kind < 2 && (near || short.len() < most) {
                short.push(s);
            }
        }
        short
    }

    /// Takes a winner over, and settles what follows from it: its simpler parts, the scale, the hold, the
    /// mechanisms that no longer pay.
    pub(super) fn accept(
        &self,
        state: &mut SearchState,
        winner: Candidate,
        chosen: FittedModel,
        alternatives: Vec<AlternativeTerm>,
        evidence: Evidence,
    ) {
        let scale = state.scale.clone();
        // A refinement has replaced its simpler relative.
        let before = state.accepted.clone();
        state.accepted.retain(|a| chosen.parts.iter().any(|p| p.candidate == a.candidate));
        match self.split(&chosen, &scale) {
            Some(split) => {
                let whole = AlternativeTerm {
                    candidate: winner.clone(),
                    instance: chosen.parts[chosen.parts.len() - 1].instance.clone(),
                    evidence,
                    equivalent: true,
                };
                for part in &split.parts[chosen.parts.len() - 1..] {
                    // A part that was there before keeps its own evidence.
                    if let Some(known) = before.iter().find(|a| a.candidate == part.candidate) {
                        let mut known = known.clone();
                        known.alternatives.retain(|r| r.candidate != winner);
                        known.alternatives.insert(0, whole.clone());
                        state.accepted.push(known);
                        continue;
                    }
                    // What was tried beside the whole is no equal of its parts alone.
                    let mut others = vec![whole.clone()];
                    others.extend(
                        alternatives
                            .iter()
                            .filter(|r| !split.parts.iter().any(|p| p.candidate == r.candidate))
                            .map(|r| AlternativeTerm { equivalent: false, ..r.clone() }),
                    );
                    state.accepted.push(SelectedTerm {
                        candidate: part.candidate.clone(),
                        evidence,
                        alternatives: others,
                    });
                }
                state.current = split;
            }
            None => {
                state.current = chosen;
                state.accepted.push(SelectedTerm { candidate: winner, evidence, alternatives });
            }
        }
        self.settle(state);
    }

    /// Fits a candidate: added, or in place of the relative that it refines.
    fn trial(
        &self,
        current: &FittedModel,
        candidate: &Candidate,
        scored: &Scored,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let fitted = self.fitted_trial(current, candidate, scored, scale)?;
        self.admissible(&fitted, scale).then_some(fitted)
    }

    fn fitted_trial(
        &self,
        current: &FittedModel,
        candidate: &Candidate,
        scored: &Scored,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let refined = current.parts.iter().position(|p| {
            p.candidate.place == candidate.place
                && self.library[candidate.mechanism]
                    .refines
                    .contains(&self.library[p.candidate.mechanism].kind)
        });
        match refined {
            None => self.extend(current, candidate, scored, scale, FIRST_STEPS),
            Some(index) => {
                let base = self.without(current, index, scale, 6)?;
                let again = screen(base.at(scale), self.library, std::slice::from_ref(candidate));
                self.extend(&base, candidate, again.first()?, scale, FIRST_STEPS)
            }
        }
    }

    /// The last part written as the sum of simpler mechanisms that it equals exactly.
    pub(super) fn split(&self, fitted: &FittedModel, scale: &[f64]) -> Option<FittedModel> {
        let mut parts = self.laws(fitted);
        let (whole, values, _) = parts.pop()?;
        let mechanism = &self.library[whole.mechanism];
        if mechanism.equals.is_empty() {
            return None;
        }
        let Place::Motion(motion) = &whole.place else { return None };
        let touched: Vec<usize> = (0..motion.weights.len()).filter(|&e| motion.weights[e] != 0.0).collect();
        let value = |n: &str| Some(values[mechanism.parameters().position(|p| p == n)?]);
        for (kind, _, expression) in &mechanism.equals {
            let part = self.all.iter().find(|c| {
                self.library[c.mechanism].kind == *kind
                    && !parts.iter().any(|p| p.0 == **c)
                    && match &c.place {
                        Place::Equation(e) => touched == [*e] && motion.weights[*e] == 1.0,
                        place => *place == whole.place && !c.mirrored,
                    }
            })?;
            parts.push((part.clone(), vec![expression.eval(&|n, _| value(n))?], Vec::new()));
        }
        self.reassembled(fitted, &parts, scale, 3)
    }

    /// The model without the winner, from the winner's parameters.
    fn refit_baseline(&self, current: &FittedModel, chosen: &FittedModel, scale: &[f64]) -> FittedModel {
        let mut parameters = current.fit.point.parameters.clone();
        for (p, name) in parameters.iter_mut().zip(current.setup.model.parameters.iter().map(|p| &p.name)) {
            if let Some(i) = chosen.setup.model.parameter(name) {
                *p = chosen.fit.point.parameters[i];
            }
        }
        let starts = transfer(&chosen.setup, &current.level, &chosen.fit.point.starts, &current.setup, &[]);
        let points = [Point { parameters, starts }];
        let fit = current.setup.fit(&current.level, scale, &points, limits(15));
        if fit.cost < current.fit.cost { FittedModel { fit, ..current.clone() } } else { current.clone() }
    }

    /// The best trial by score, unless a simpler one is as good; with the evidence of all.
    pub(super) fn decide(
        &self,
        calibrated: &FittedModel,
        current: &FittedModel,
        open: &[Candidate],
        trials: Vec<(usize, FittedModel)>,
        scale: &[f64],
    ) -> Option<(Candidate, FittedModel, Vec<AlternativeTerm>, Evidence)> {
        // One information per sample for all: that of the residual which fits best.
        let best = trials.iter().min_by(|a, b| a.1.rss().total_cmp(&b.1.rss()))?;
        let ratios = effective_sample_ratio(best.1.at(scale));
        let mut weighed: Vec<(usize, FittedModel, Evidence)> = trials
            .into_par_iter()
            .map(|(c, f)| {
                let e = self.weigh_with(current, &f, scale, &ratios);
                (c, f, e)
            })
            .collect();
        weighed.sort_by(|a, b| b.2.score.total_cmp(&a.2.score).then(a.0.cmp(&b.0)));
        for (c, f, e) in &weighed {
            if let Some(part) = f.parts.last() {
                let kind = &self.library[open[*c].mechanism].kind;
                self.listener.tried(kind, &part.instance.expression.to_string(), e);
            }
        }
        let total = calibrated_rss(calibrated, scale);
        let mut undetermined = Vec::new();
        let best = loop {
            if weighed.is_empty() {
                return None;
            }
            let best = self.best_of(&weighed, open, total, scale);
            if self.gives_way(&weighed, best, current, open, scale) {
                undetermined.push(weighed.remove(best));
            } else if self.shows_nothing(&weighed[best].1, scale) {
                weighed.remove(best);
            } else {
                break best;
            }
        };
        let (chosen, fitted, evidence) = weighed.remove(best);
        let likelihood = by_likelihood(&fitted, &evidence, scale);
        let tell = |(c, f, e): (usize, FittedModel, Evidence), undetermined: bool| {
            // The data cannot separate what fits as well with no more parameters, nor what the evidence
            // leaves at odds that no one would bet on: close scores, or criteria that contradict each other
            // (BIC asks for certainty, Akaike's for a better prediction).
            let as_good = self.complexity(&f) <= self.complexity(&fitted)
                && !likelihood
                && f.fit.rss.iter().zip(&fitted.fit.rss).all(|(x, y)| *x < 1.005 * y);
            let disputed = likelihood && (e.score < evidence.score) != (e.akaike < evidence.akaike);
            let close = (e.score - evidence.score).abs() < UNDECIDED;
            // A refinement that the data do not show cannot be told from the law that it refines; from others it may.
            let refined = &self.library[open[c].mechanism].refines;
            let undetermined = undetermined && refined.contains(&self.library[open[chosen].mechanism].kind);
            let equivalent = as_good || disputed || close || undetermined;
            let instance = f.parts.last()?.instance.clone();
            Some(AlternativeTerm { candidate: open[c].clone(), instance, evidence: e, equivalent })
        };
        let alternatives =
            undetermined.into_iter().map(|u| (u, true)).chain(weighed.into_iter().map(|w| (w, false)));
        let alternatives =
            alternatives.filter_map(|(trial, undetermined)| tell(trial, undetermined)).collect();
        Some((open[chosen].clone(), fitted, alternatives, evidence))
    }

    /// Whether the recordings determine none of the strengths of a model's last part.
    fn shows_nothing(&self, fitted: &FittedModel, scale: &[f64]) -> bool {
        let last = fitted.parts.len().wrapping_sub(1);
        self.undetermined(fitted, &Uncertainty::of(fitted, scale).widths()) == Some(last)
    }

    /// Whether a refinement is no choice: the law that it refines is at hand, and the data do not show its parts.
    fn gives_way(
        &self,
        weighed: &[(usize, FittedModel, Evidence)],
        best: usize,
        current: &FittedModel,
        open: &[Candidate],
        scale: &[f64],
    ) -> bool {
        let (candidate, fitted) = (&open[weighed[best].0], &weighed[best].1);
        let standing = current.parts.iter().map(|p| &p.candidate);
        let mut at_hand = standing.chain(weighed.iter().map(|(c, ..)| &open[*c]));
        at_hand.any(|c| self.is_refined_by(c, candidate))
            && self.is_undetermined(fitted, fitted.parts.len().wrapping_sub(1), scale)
    }

    pub(super) fn is_refined_by(&self, law: &Candidate, refinement: &Candidate) -> bool {
        law.place == refinement.place
            && self.library[refinement.mechanism].refines.contains(&self.library[law.mechanism].kind)
    }

    /// The best by score, unless a simpler one is as good.
    fn best_of(
        &self,
        weighed: &[(usize, FittedModel, Evidence)],
        open: &[Candidate],
        total: f64,
        scale: &[f64],
    ) -> usize {
        let priority = |c: usize| self.library[open[c].mechanism].rank;
        let mut best = 0;
        for i in 1..weighed.len() {
            let (a, b) = (&weighed[best], &weighed[i]);
            // (Of innovations a per cent is much: they hold what cannot be predicted. There, and where the
            // residual is white and as small as the noise, the likelihood alone speaks.)
            let likelihood = by_likelihood(&a.1, &a.2, scale);
            let near = |slack: f64| {
                !likelihood
                    && a.1.fit.rss.iter().zip(&b.1.fit.rss).all(|(x, y)| {
                        *y < (1.0 + slack) * x || (slack > 0.01 && (y - x) < LEAST_SHARE * total)
                    })
            };
            // As good in every channel, or within what a likelihood can tell. Far above the noise each
            // parameter more must buy its share: there, any flexible law follows what another law lacks.
            let surplus = self.complexity(&a.1) - self.complexity(&b.1);
            let slack = if a.1.misfit(scale) > FAR_FROM_NOISE { SHARE_PER_PARAMETER * surplus } else { 0.0 }
                .max(0.02);
            let simpler = surplus > 0.0 && (near(slack) || a.2.score - b.2.score < PARSIMONY);
            let tie = self.complexity(&b.1) == self.complexity(&a.1)
                && (near(0.005) || (likelihood && a.2.score - b.2.score < SAME_SCORE))
                && priority(b.0) < priority(a.0);
            if simpler || tie {
                best = i;
            }
        }
        best
    }
}
