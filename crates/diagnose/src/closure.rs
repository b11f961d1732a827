//! The closure: a sum of forces where the names of the library leave more than noise.
//!
//! ```text
//! E(q, q', q'') + Σᵢ cᵢ φᵢ(q, q', zᵢ; θᵢ) = 0,    zᵢ' = ψᵢ(zᵢ, q, q'; θᵢ)
//! ```
//!
//! The terms φ are the laws of the library that are forces and vanish with their coefficients c
//! ([`Mechanism::is_term`](crate::Mechanism::is_term)), with a name or without; some have constants θ of their own (the
//! speed at which a brake saturates), some a memory z (a spring and a damper in series). They are chosen, and refitted with
//! all parameters of the machine, by the errors of the simulated output: sparse identification (Brunton, Proctor and Kutz,
//! PNAS 113, 2016), on the simulated motion in place of differentiated measurements. A round adds up to three terms of one
//! coefficient that explain most together, or one law with constants or a memory, whichever is worth more, and takes away,
//! one after the other, the term that the recordings determine least, for as long as what is known of it
//! ([`robust`](crate::evidence::robust)) is below the odds against one among those that the round chose from. Where a round changes
//! nothing, all terms of one coefficient are chosen anew together, to first order: others may do their work for less. Rounds go on
//! until none changes anything, on short segments first, where first order is good, on longer ones later, where small forces are seen.

use std::sync::Arc;

use greybox_calibrate::{Point, Setup, Work};
use rayon::prelude::*;

use crate::Stage;
use crate::candidate::Candidate;
use crate::evidence::{Evidence, least_effective_sample_ratio, penalty};
use crate::fitted::{FittedModel, Found, Law, MechanismTerm, SelectedTerm, WHITE, is_same, laws, next_scale};
use crate::library::Shape;
use crate::place::own_coordinates;
use crate::screen::{Held, Scored, Together, reselect, screen, screen_set, screen_shapes, shift_without};
use crate::search::{MISFIT, MOST_SAMPLES, SAME_HOLD, Search, UNDECIDED, limits, odds, same_level, whole};
use crate::turns::Turns;
use crate::uncertainty::Uncertainty;

/// Terms that are added at once: of forces that compensate each other, none pays alone.
const AT_ONCE: usize = 3;
/// Laws with constants or a memory of their own that a round fits a few steps, and those of them that go on.
const TRIALS: usize = 6;
const FINALISTS: usize = 2;
/// Laws of free shape that are fitted.
const SHAPES: usize = 3;
/// Where a fit with new terms may begin: how much of their values, how much of the shift of the parameters that goes with
/// them. First order may promise too much of either.
const STARTS: [(f64, f64); 3] = [(1.0, 1.0), (1.0, 0.0), (1e-3, 0.0)];
/// Steps of a trial, of a fit with new terms, and of one without a term.
const STEPS_OF_A_TRIAL: usize = 5;
const STEPS: usize = 20;
const STEPS_WITHOUT: usize = 12;
/// Residual over noise from which something is left.
const LEFT: f64 = 1.03;

/// The terms that closures ended each level with: another one that comes there goes on from there as they did.
#[derive(Default)]
pub(crate) struct Visited(Vec<(usize, Vec<Candidate>)>);

impl Visited {
    /// Whether no other closure had these terms at the end of this level; from now on one has.
    fn insert(&mut self, level: usize, terms: Vec<Candidate>) -> bool {
        let is_known = self.0.iter().any(|(l, t)| *l == level && is_same(t, &terms));
        self.0.push((level, terms));
        !is_known
    }
}

impl Search<'_> {
    /// A closure that begins with the model `from`, in the place of what a search `found`. `None` where no term is worth its
    /// odds, of a model whose laws [mix](Self::mixes) equations, and where it comes to what others `visited`. What the recordings
    /// say for its parts is left open: [`accepted`](Self::accepted) is asked for the closure that is handed back.
    pub(crate) fn closure(&self, found: &Found, from: &FittedModel, visited: &mut Visited) -> Option<Found> {
        if from.parts.iter().any(|part| self.mixes(&part.candidate)) {
            return None;
        }
        let nominal = self.nominal();
        let (plain, rich): (Vec<_>, Vec<_>) =
            self.closing().into_iter().partition(|c| self.library[c.mechanism].is_plain());
        let shapes: Vec<Candidate> = self.allowed().filter(|c| self.is_shape(c)).cloned().collect();
        // With a limit of work of its own.
        let work = Arc::new(Work::of_fits_within(self.most_work));
        self.listener.begins(&work);
        let is_spent = || work.done() > self.most_work || work.is_given_up();
        let setup = Setup { noise: None, work: work.clone(), ..from.setup.clone() };
        let mut current = FittedModel { setup, ..from.clone() };
        let mut scale = found.scale.clone();
        let mut lengths = self.lengths().to_vec();
        lengths.extend(lengths.last().is_some_and(|last| 2 * last < whole(nominal)).then(|| whole(nominal)));
        // Free shapes once formulas are at their end. (From short segments again they cost as much as everything before.)
        let formulas = lengths.iter().map(|&length| (length, false));
        let rest = lengths.last().map(|&length| (length, true));
        let has_shape = |model: &FittedModel| model.parts.iter().any(|part| self.is_shape(&part.candidate));
        let mut formula = None;
        for (step, (length, is_rest)) in formulas.chain(rest).enumerate() {
            if is_rest {
                let is_enough = !leaves_something(&current, &scale) || current.misfit(&scale) <= MISFIT;
                if is_enough || shapes.is_empty() {
                    break;
                }
                formula = Some((current.clone(), scale.clone()));
            }
            let level = same_level(&current.setup, &nominal.windows(length, MOST_SAMPLES));
            let (setup, parameters) = (&current.setup, &current.fit.point.parameters);
            let stitched = setup.stitch(&current.level, &current.fit.point, &level, &scale);
            let measured = Point { parameters: parameters.clone(), starts: setup.starts(&level, parameters) };
            // At the shortest, from the measurements: what long segments believe is in doubt.
            let points = if length == lengths[0] { vec![measured] } else { vec![stitched, measured] };
            let fit = setup.fit(&level, &scale, &points, limits(25));
            current = FittedModel { level, fit, ..current };
            let mut seen: Vec<Vec<Candidate>> = Vec::new();
            loop {
                self.listener.stage(Stage::Closing { length, terms: current.parts.len() });
                scale = next_scale(&current.fit, &scale, &nominal.data.sigma);
                self.method(&mut current, &scale);
                current = self.refit(&current, &scale, 10);
                seen.push(candidates(&current));
                let is_new = |model: &FittedModel| !seen.iter().any(|s| is_same(s, &candidates(model)));
                let settled = |more: Option<FittedModel>, terms: &[Candidate]| {
                    self.settled(&current, more?, odds(terms.len()), &scale).filter(is_new)
                };
                // (Without a shape the formula is at its end.)
                let is_done = is_rest && !has_shape(&current);
                let more = if is_done || is_spent() || !leaves_something(&current, &scale) {
                    None
                } else {
                    let plain = settled(self.larger(&current, &plain, AT_ONCE, &scale), &plain);
                    // A law with more to fit is tried where it promises more than they keep.
                    let kept = plain.as_ref().map_or(0.0, |plain| 1.0 - plain.rss() / current.rss());
                    let rich = settled(self.with_one(&current, &rich, kept, &scale), &rich);
                    let reported = |model: &FittedModel| self.robust(&current, model, &scale);
                    let both = [plain, rich].into_iter().flatten();
                    both.max_by(|a, b| reported(a).total_cmp(&reported(b)))
                };
                // (Where the terms leave a misfit, others do not do their work for less.)
                let other = || match !is_done && current.misfit(&scale) <= MISFIT {
                    true => self.reselected(&current, &plain, &scale).filter(is_new),
                    false => None,
                };
                let shape = || match is_rest && !is_spent() && leaves_something(&current, &scale) {
                    true => settled(self.shaped(&current, &shapes, &scale), &shapes),
                    false => None,
                };
                let Some(next) = more.or_else(other).or_else(shape) else { break };
                // (Another hold may have stood in for what has a term now.)
                current = self.redecide_holds(&next, &scale, SAME_HOLD);
            }
            if !is_rest && !visited.insert(step, candidates(&current)) {
                self.listener.begins(&nominal.work);
                return None;
            }
        }
        if let Some(formula) = formula
            && !has_shape(&current)
        {
            (current, scale) = formula;
        }
        // What is left is work of the search again.
        self.listener.begins(&nominal.work);
        if current.parts.is_empty() || is_same(&candidates(&current), &candidates(from)) {
            return None;
        }
        current.setup.work = nominal.work.clone();
        Some(Found {
            calibrated: found.calibrated.clone(),
            improved: current,
            accepted: Vec::new(),
            better_holds: found.better_holds.clone(),
            scale,
            limited: found.limited || is_spent(),
            rejected: Vec::new(),
            errs: false,
            closed: true,
        })
    }

    /// The terms of a formula that a closure may hold.
    fn closing(&self) -> Vec<Candidate> {
        self.allowed().filter(|c| !self.is_shape(c)).cloned().collect()
    }

    /// Terms of a formula and of free shape: none that acts by a clock, that mixes equations, or that tells an angle from the
    /// same angle a turn later where the equations do not.
    fn allowed(&self) -> impl Iterator<Item = &Candidate> {
        let turns = Turns::of(&self.nominal().model);
        let holds = move |c: &&Candidate| {
            !self.is_bound_to_a_clock(c) && !self.mixes(c) && turns.admits(c, &self.library[c.mechanism])
        };
        self.terms().filter(holds)
    }

    fn is_shape(&self, candidate: &Candidate) -> bool {
        self.library[candidate.mechanism].shape.is_some()
    }

    /// What the recordings say for each part of a closure, and what the search that `found` some of them could not tell from
    /// these.
    pub(crate) fn accepted(&self, found: &Found, closure: &Found) -> Vec<SelectedTerm> {
        let (closure, scale) = (&closure.improved, &closure.scale);
        let of = |index: usize| {
            let candidate = closure.parts[index].candidate.clone();
            let score =
                self.less(closure, &[index], scale).map_or(0.0, |less| self.robust(&less, closure, scale));
            let known = found.accepted.iter().find(|a| a.candidate == candidate);
            let mut alternatives = known.map_or(Vec::new(), |known| known.alternatives.clone());
            alternatives.retain(|r| r.equivalent && closure.parts.iter().all(|p| p.candidate != r.candidate));
            alternatives.iter_mut().for_each(|r| r.evidence.score = score);
            SelectedTerm { candidate, evidence: Evidence { score, ..Evidence::NONE }, alternatives }
        };
        (0..closure.parts.len()).into_par_iter().map(of).collect()
    }

    /// What is known of a model with `more`, where that changes anything and for the better: the end of a round. `odds` are
    /// those against what the round chose.
    fn settled(
        &self,
        current: &FittedModel,
        more: FittedModel,
        odds: f64,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let settled = self.known_alone(more, odds, scale);
        let is_closer = settled.rss().total_cmp(&current.rss()).is_lt();
        (is_closer || settled.parts.len() < current.parts.len()).then_some(settled)
    }

    /// The model with one law beside it: of those that explain most to first order, and more than this share, the one that
    /// is worth most.
    fn with_one(
        &self,
        base: &FittedModel,
        terms: &[Candidate],
        more: f64,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let open = open(base, terms);
        if open.is_empty() {
            return None;
        }
        let scored = screen(base.at(scale), self.library, &open);
        let promising: Vec<Scored> =
            scored.into_iter().take_while(|one| one.gain > more).take(TRIALS).collect();
        let tried = promising.into_par_iter().filter_map(|one| {
            let alone = Together { gain: one.gain, shift: one.shift.clone(), members: vec![one] };
            self.extend_by(base, &open, &alone, &STARTS, scale, STEPS_OF_A_TRIAL)
        });
        let reported = |model: FittedModel| (self.robust(base, &model, scale), model);
        let mut tried: Vec<(f64, FittedModel)> = tried.map(reported).collect();
        tried.sort_by(|a, b| b.0.total_cmp(&a.0));
        tried.truncate(FINALISTS);
        let fitted = tried.into_par_iter().map(|(_, model)| self.refit(&model, scale, STEPS));
        let allowed = fitted.filter(|model| self.admissible(model, scale)).map(reported).collect::<Vec<_>>();
        allowed.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).map(|best| best.1)
    }

    /// The model with up to `most` terms beside it, those that explain most together.
    fn larger(
        &self,
        base: &FittedModel,
        terms: &[Candidate],
        most: usize,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let open = open(base, terms);
        let together = screen_set(base.at(scale), self.library, &open, most)?;
        self.extend_by(base, &open, &together, &STARTS, scale, STEPS)
    }

    /// The model with a law of free shape, where that is worth the odds against one of them: of those that are likeliest to
    /// first order, the one that is worth most.
    fn shaped(&self, base: &FittedModel, shapes: &[Candidate], scale: &[f64]) -> Option<FittedModel> {
        let open = open(base, shapes);
        let at = base.at(scale);
        let weight = least_effective_sample_ratio(at);
        let mut likeliest = screen_shapes(at, self.library, &open, weight);
        likeliest.truncate(SHAPES);
        let tried = likeliest.par_iter().filter_map(|shape| {
            let shaped = self.extend_by(base, &open, shape, &STARTS, scale, STEPS_OF_A_TRIAL)?;
            Some((self.robust(base, &shaped, scale), shaped))
        });
        let best = tried.collect::<Vec<_>>().into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
        let shaped = self.refit(&best.1, scale, STEPS);
        let odds = odds(shapes.len());
        (self.robust(base, &shaped, scale) > odds).then(|| self.alone(shaped, odds, scale))
    }

    /// The model with its newest part, a law of free shape, without the formula of the same variable in the same place, unless
    /// each of its terms is worth the odds: it was pieced together where a shape was lacking. (One by one its terms may not go.
    /// They compensate each other.)
    fn alone(&self, shaped: FittedModel, odds: f64, scale: &[f64]) -> FittedModel {
        let Some((shape, others)) = shaped.parts.split_last() else { return shaped };
        let law = |part: &MechanismTerm| &self.library[part.candidate.mechanism];
        let does_its_work = |part: &MechanismTerm| {
            part.candidate.place == shape.candidate.place && law(shape).is_shape_of(law(part))
        };
        let formula: Vec<usize> = (0..others.len()).filter(|&i| does_its_work(&others[i])).collect();
        if formula.is_empty() {
            return shaped;
        }
        let less = self.less(&shaped, &formula, scale);
        match less.and_then(|less| self.resized(&less, scale)) {
            Some(less) if self.robust(&less, &shaped, scale) < odds * formula.len() as f64 => less,
            _ => shaped,
        }
    }

    /// The model with the size of its newest part, a law of free shape, where its changes of slope are one in the mean square: an
    /// estimate that suits what it describes now (one step of expectation and maximisation, without the variances).
    fn resized(&self, model: &FittedModel, scale: &[f64]) -> Option<FittedModel> {
        let part = model.parts.last()?;
        let law = &self.library[part.candidate.mechanism];
        let index = |plain: &str| {
            let k = law.parameters().position(|p| p == plain)?;
            model.setup.model.parameter(&part.instance.names[k])
        };
        let changes: Vec<usize> = law.linear.iter().map(|name| index(name)).collect::<Option<_>>()?;
        let [_, size] = Shape::SIZES;
        let size = index(size)?;
        let mut parameters = model.fit.point.parameters.clone();
        let squares: f64 = changes.iter().map(|&i| parameters[i].powi(2)).sum();
        let ratio = (squares / changes.len() as f64).sqrt();
        if ratio.total_cmp(&0.0).is_le() {
            return None;
        }
        changes.iter().for_each(|&i| parameters[i] /= ratio);
        parameters[size] *= ratio;
        let parts = laws(&model.parts, &model.setup.model, &parameters);
        self.reassembled_from(model, &parts, vec![parameters], scale, STEPS)
    }

    /// The model with other terms for those that it holds, where they do the same work for less: fewer coefficients, or laws
    /// of lower rank, a linear spring for a sine, a named law for a term without a name.
    fn reselected(&self, model: &FittedModel, terms: &[Candidate], scale: &[f64]) -> Option<FittedModel> {
        let (setup, point) = (&model.setup, &model.fit.point);
        let held: Vec<Held> = model
            .parts
            .iter()
            .filter_map(|part| {
                let candidate = terms.iter().position(|c| *c == part.candidate)?;
                let index = setup.model.parameter(&part.instance.names[0])?;
                let position = setup.free.iter().position(|f| f.index == index)?;
                Some(Held { candidate, position, value: point.parameters[index] })
            })
            .collect();
        if held.is_empty() {
            return None;
        }
        let positions: Vec<usize> = held.iter().map(|h| h.position).collect();
        let inflation = Uncertainty::inflation(model, scale, &positions).factor;
        let information = model.fit.count.iter().sum::<usize>() as f64 / inflation;
        let penalty = |c: &Candidate| {
            let law = &self.library[c.mechanism];
            let parameters = law.parameters().count() as f64;
            let ranked = UNDECIDED * f64::from(law.rank);
            inflation * (penalty(parameters, information) + 2.0 * law.surcharge + ranked)
        };
        let together = reselect(model.at(scale), self.library, terms, &held, &penalty)?;
        let other = self.exchanged(model, terms, &positions, &together, scale)?;
        // (First order may have promised too much.)
        let cost = |model: &FittedModel| {
            model.rss() + model.parts.iter().map(|p| penalty(&p.candidate)).sum::<f64>()
        };
        (cost(&other) < cost(model) && self.admissible(&other, scale))
            .then(|| self.known_alone(other, odds(terms.len()), scale))
    }

    /// The model with these `terms` in the place of those that it holds of them, whose coefficients have these positions among
    /// its free parameters, and everything else where it goes with them.
    fn exchanged(
        &self,
        model: &FittedModel,
        terms: &[Candidate],
        positions: &[usize],
        together: &Together,
        scale: &[f64],
    ) -> Option<FittedModel> {
        let (setup, point) = (&model.setup, &model.fit.point);
        let mut shifted = point.parameters.clone();
        let others = (0..setup.free.len()).filter(|i| !positions.contains(i)).map(|i| &setup.free[i]);
        for (f, d) in others.zip(&together.shift) {
            shifted[f.index] = (shifted[f.index] + d).clamp(f.lower, f.upper);
        }
        let mut kept = model.parts.clone();
        kept.retain(|part| !terms.contains(&part.candidate));
        let own = laws(&kept, &setup.model, &shifted);
        let fresh = together
            .members
            .iter()
            .map(|member| (terms[member.candidate].clone(), member.values.clone(), member.scales.clone()));
        let parts: Vec<Law> = own.into_iter().chain(fresh).collect();
        let mut start = shifted[..self.nominal().model.parameters.len()].to_vec();
        start.extend(parts.iter().flat_map(|law| &law.1));
        self.reassembled_from(model, &parts, vec![start], scale, STEPS)
    }

    /// The model without what the recordings do not tell: as long as the term that they determine least is not worth the
    /// odds, it goes.
    fn known_alone(&self, model: FittedModel, odds: f64, scale: &[f64]) -> FittedModel {
        let mut model = model;
        while !model.parts.is_empty() {
            let known = self.known(&model, &Uncertainty::of(&model, scale).widths());
            let least = (0..known.len()).min_by(|&a, &b| known[a].total_cmp(&known[b])).unwrap_or(0);
            match self.less(&model, &[least], scale) {
                Some(less) if self.robust(&less, &model, scale) < odds => model = less,
                _ => break,
            }
        }
        model
    }

    /// The model without these parts, from where the others go, to first order, when they do.
    fn less(&self, model: &FittedModel, parts: &[usize], scale: &[f64]) -> Option<FittedModel> {
        let (setup, point) = (&model.setup, &model.fit.point);
        // By parameter of these parts, whether it vanishes with the force. (Constants mean nothing without it.)
        let own: Vec<(usize, bool)> = parts
            .iter()
            .flat_map(|&i| {
                let part = &model.parts[i];
                let vanish = self.library[part.candidate.mechanism].vanish_with_force();
                part.instance.names.iter().zip(vanish).collect::<Vec<_>>()
            })
            .filter_map(|(name, vanishes)| Some((setup.model.parameter(name)?, vanishes)))
            .collect();
        let of = |index: usize| own.iter().find(|o| o.0 == index);
        let gone: Vec<(usize, f64)> = (0..setup.free.len())
            .filter_map(|i| Some((i, of(setup.free[i].index)?)))
            .map(|(i, &(index, vanishes))| (i, if vanishes { point.parameters[index] } else { 0.0 }))
            .collect();
        let shift = shift_without(model.at(scale), &gone);
        let mut shifted = point.parameters.clone();
        let kept = setup.free.iter().filter(|f| of(f.index).is_none());
        for (f, d) in kept.zip(shift) {
            shifted[f.index] = (shifted[f.index] + d).clamp(f.lower, f.upper);
        }
        let start = (0..shifted.len()).filter(|&i| of(i).is_none()).map(|i| shifted[i]).collect();
        let laws = self.laws(model).into_iter().enumerate();
        let laws: Vec<Law> = laws.filter(|(i, _)| !parts.contains(i)).map(|(_, law)| law).collect();
        self.reassembled_from(model, &laws, vec![start], scale, STEPS_WITHOUT)
    }

    /// Whether up to three other terms do as well as part `index` of a closure: the recordings do not hold its name.
    pub(crate) fn is_replaceable(&self, closure: &Found, index: usize) -> bool {
        let (model, scale) = (&closure.improved, &closure.scale);
        let candidate = &model.parts[index].candidate;
        let Some(less) = self.less(model, &[index], scale) else { return true };
        let others = self.closing().into_iter().filter(|c| c != candidate);
        let (plain, mut rich): (Vec<_>, Vec<_>) = others.partition(|c| self.library[c.mechanism].is_plain());
        // (Of two laws that do as well the plainer one has the name.)
        let complexity = |c: &Candidate| self.library[c.mechanism].complexity();
        rich.retain(|c| complexity(c) <= complexity(candidate));
        let does_as_well = |other: Option<FittedModel>| {
            other.is_some_and(|other| self.robust(&other, model, scale) < UNDECIDED)
        };
        does_as_well(self.larger(&less, &plain, AT_ONCE, scale))
            || does_as_well(self.with_one(&less, &rich, 0.0, scale))
    }

    /// The law without a name that scores most in the place of these parts of a model, in one of their equations and with no
    /// more parameters, and how far it scores above them, which may only imitate it. `None` where there is no such law.
    pub(crate) fn unnamed_above(
        &self,
        model: &FittedModel,
        parts: &[usize],
        scale: &[f64],
    ) -> Option<(f64, MechanismTerm)> {
        let nominal = &self.nominal().model;
        let own: Vec<&Candidate> = parts.iter().map(|&i| &model.parts[i].candidate).collect();
        let complexity = |c: &Candidate| self.library[c.mechanism].complexity();
        let most: f64 = own.iter().map(|c| complexity(c)).sum();
        let equations: Vec<String> = own.iter().flat_map(|c| c.place.equations(nominal)).collect();
        let is_alternative = |c: &Candidate| {
            !self.library[c.mechanism].named
                && complexity(c) <= most
                && c.place.equations(nominal).iter().any(|e| equations.contains(e))
        };
        let alternatives = self.closing().into_iter().filter(is_alternative);
        let (plain, rich): (Vec<_>, Vec<_>) =
            alternatives.partition(|c| self.library[c.mechanism].is_plain());
        let mut last_first = parts.to_vec();
        last_first.sort_unstable_by(|a, b| b.cmp(a));
        let mut less = model.clone();
        for part in last_first {
            less = self.less(&less, &[part], scale)?;
        }
        let others = [self.larger(&less, &plain, 1, scale), self.with_one(&less, &rich, 0.0, scale)];
        let score = |of: &FittedModel| self.robust(&less, of, scale);
        let scored = others.into_iter().flatten().map(|other| (score(&other), other));
        let (best, mut other) = scored.max_by(|a, b| a.0.total_cmp(&b.0))?;
        Some((best - score(model), other.parts.pop()?))
    }

    /// Whether a law brings a coordinate's highest derivative into an equation that neither has it nor governs that
    /// coordinate. With such laws equations can be added to each other at will, and no coefficient means anything.
    fn mixes(&self, law: &Candidate) -> bool {
        let model = &self.nominal().model;
        let own = own_coordinates(model);
        let mut with = model.clone();
        let mechanism = &self.library[law.mechanism];
        law.insert(&mut with, mechanism, &vec![1.0; mechanism.parameters().count()]);
        (0..model.equations.len()).any(|e| {
            let (before, after) = (model.equations[e].residual(), with.equations[e].residual());
            model.states.iter().enumerate().any(|(j, state)| {
                let order = state.order as u8;
                own.get(e).copied().flatten() != Some(j)
                    && after.contains(&state.name, order)
                    && !before.contains(&state.name, order)
            })
        })
    }
}

fn candidates(fitted: &FittedModel) -> Vec<Candidate> {
    fitted.parts.iter().map(|part| part.candidate.clone()).collect()
}

/// The terms that a model does not hold.
fn open(model: &FittedModel, terms: &[Candidate]) -> Vec<Candidate> {
    let is_held = |c: &&Candidate| model.parts.iter().any(|p| p.candidate == **c);
    terms.iter().filter(|c| !is_held(c)).cloned().collect()
}

/// Whether more than white noise is left.
fn leaves_something(fitted: &FittedModel, scale: &[f64]) -> bool {
    fitted.misfit(scale) > LEFT || least_effective_sample_ratio(fitted.at(scale)) < WHITE
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::Mechanism;
    use greybox_calibrate::{Data, free_parameters};
    use greybox_model::Model;
    use greybox_recording::{Channel, Recording};
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    /// Two wheels of 1 and 0.5 kg m², the first driven and on a spring, the second on a spring between them.
    const BODIES: &str = r#"
[inputs]
f = { unit = "N m", hold = "linear" }
[states]
x = { unit = "rad" }
y = { unit = "rad" }
[parameters]
m = { value = 1.0, unit = "kg m^2", fixed = true }
n = { value = 0.5, unit = "kg m^2", fixed = true }
b = { value = 0.6, unit = "N m s/rad" }
c = { value = 0.4, unit = "N m s/rad" }
k = { value = 20.0, unit = "N m/rad" }
l = { value = 12.0, unit = "N m/rad" }
[equations]
first  = "m*x'' + b*x' + k*x + l*(x - y) = f"
second = "n*y'' + c*y' + l*(y - x) = 0"
"#;

    /// 30 s of the bodies with more forces on each and a memory, of the state (x, y, x', y', z): force, force, z'.
    pub(crate) fn bodies(more: &dyn Fn([f64; 5]) -> [f64; 3], seed: u64) -> Setup {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let (dt, n, fine) = (0.02, 1500usize, 20usize);
        let drive = |t: f64| 6.0 * (2.1 * t).sin() + 5.0 * (4.9 * t + 0.07 * t * t).cos();
        let held = |t: f64| {
            let k = (t / dt).floor();
            let (a, b) = (drive(k * dt), drive((k + 1.0) * dt));
            a + (b - a) * (t / dt - k)
        };
        let rates = |[x, y, v, w, z]: [f64; 5], t: f64| {
            let [first, second, memory] = more([x, y, v, w, z]);
            let stretch = x - y;
            [
                v,
                w,
                held(t) - 0.5 * v - 21.0 * x - 11.0 * stretch - first,
                (-0.35 * w + 11.0 * stretch - second) / 0.5,
                memory,
            ]
        };
        let mut s = [0.0; 5];
        let mut columns = [const { Vec::new() }; 4];
        for k in 0..n {
            let t = dt * k as f64;
            let row = [t, drive(t), s[0] + 1e-3 * normal(), s[1] + 1e-3 * normal()];
            columns.iter_mut().zip(row).for_each(|(c, v)| c.push(v));
            let h = dt / fine as f64;
            for i in 0..fine {
                let t = t + i as f64 * h;
                let step = |s: [f64; 5], d: [f64; 5], h: f64| std::array::from_fn(|i| s[i] + h * d[i]);
                let a = rates(s, t);
                let b = rates(step(s, a, 0.5 * h), t + 0.5 * h);
                s = step(s, b, h);
            }
        }
        let [time, f, x, y] = columns;
        let channel = |name: &str, values: Vec<f64>| Channel { name: name.into(), unit: None, values };
        let channels = vec![channel("f", f), channel("x", x), channel("y", y)];
        let recording = Recording::from_columns("bodies.csv", time, channels).unwrap();
        let model = Model::from_toml(BODIES, "bodies.toml").unwrap();
        let data = Arc::new(Data::new(&model, &[recording]).unwrap());
        Setup::new(&model, data, free_parameters(&model)).unwrap()
    }

    /// What a search is that has found nothing.
    pub(crate) fn nothing(search: &Search<'_>) -> Found {
        let setup = search.nominal().clone();
        let level = setup.windows(search.lengths()[0], MOST_SAMPLES);
        let start = Point { parameters: setup.values(), starts: setup.starts(&level, &setup.values()) };
        let fit = setup.fit(&level, &setup.data.spread, &[start], limits(30));
        let scale = next_scale(&fit, &setup.data.spread, &setup.data.sigma);
        let calibrated = FittedModel { setup, parts: Vec::new(), level, fit };
        Found {
            improved: calibrated.clone(),
            calibrated,
            accepted: Vec::new(),
            better_holds: Vec::new(),
            scale,
            limited: false,
            rejected: Vec::new(),
            errs: false,
            closed: false,
        }
    }

    /// The model with these forces on the first body beside what was found.
    pub(crate) fn with_forces(search: &Search<'_>, found: &Found, kinds: &[&str]) -> FittedModel {
        let first = |c: &Candidate| c.place.equations(&search.nominal().model) == ["first"];
        let law = |kind: &&str| {
            let is_it = |c: &&Candidate| search.library[c.mechanism].kind == *kind && first(c);
            search.terms().find(is_it).cloned().expect(kind)
        };
        let laws: Vec<Candidate> = kinds.iter().map(law).collect();
        let model = search.larger(&found.improved, &laws, laws.len(), &found.scale).unwrap();
        assert_eq!(model.parts.len(), kinds.len());
        model
    }

    /// Kind, equation and coefficient of each term, sorted.
    fn terms(found: &Found, library: &[Mechanism], model: &Model) -> Vec<(String, String, f64)> {
        let fitted = &found.improved;
        let of = |part: &crate::fitted::MechanismTerm| {
            let index = fitted.setup.model.parameter(&part.instance.names[0]).unwrap();
            let kind = library[part.candidate.mechanism].kind.clone();
            let equations = part.candidate.place.equations(model).join(" ");
            (kind, equations, fitted.fit.point.parameters[index])
        };
        let mut all: Vec<_> = fitted.parts.iter().map(of).collect();
        all.sort_by(|a, b| (&a.0, &a.1).cmp(&(&b.0, &b.1)));
        all
    }

    /// Three forces that the library has no name for are found as they are, and nothing where there is nothing.
    #[test]
    fn forces_without_a_name_are_found_with_their_coefficients() {
        let library = crate::built_in().unwrap();
        let truth = [
            ("cubic_damping", "first", 0.12),
            ("position_dependent_damping", "second", 2.5),
            ("quadratic_coupling", "first", 8.0),
        ];
        let more = |[_, y, v, w, _]: [f64; 5]| [0.12 * v * v * v + 8.0 * y * y, 2.5 * y * y * w, 0.0];
        let seeds = 4u64;
        let right = (0..seeds).filter(|seed| {
            let search = Search::new(bodies(&more, 10 + seed), &library, &crate::Quiet);
            let found = nothing(&search);
            let closed = search.closure(&found, &found.calibrated, &mut Visited::default()).unwrap();
            let reported = terms(&closed, &library, &search.nominal().model);
            reported.len() == truth.len()
                && reported
                    .iter()
                    .zip(&truth)
                    .all(|(a, b)| (&*a.0, &*a.1) == (b.0, b.1) && (a.2 / b.2 - 1.0).abs() < 0.01)
        });
        let right = right.count() as u64;
        assert!(right >= seeds - 1, "{right} of {seeds}");
        for seed in 0..seeds {
            let search = Search::new(bodies(&|_| [0.0; 3], 20 + seed), &library, &crate::Quiet);
            let found = nothing(&search);
            let closed = search.closure(&found, &found.calibrated, &mut Visited::default());
            let reported = closed.map(|closed| terms(&closed, &library, &search.nominal().model));
            assert_eq!(reported, None, "seed {seed}");
        }
    }

    /// A brake that saturates and a spring that gives way, each alone, with their constants.
    #[test]
    fn laws_with_constants_or_a_memory_are_found() {
        let library = crate::built_in().unwrap();
        let reported = |more: &dyn Fn([f64; 5]) -> [f64; 3], seed: u64| {
            let search = Search::new(bodies(more, seed), &library, &crate::Quiet);
            let found = nothing(&search);
            let closed = search.closure(&found, &found.calibrated, &mut Visited::default()).unwrap();
            let fitted = closed.improved;
            let value =
                |name: &String| fitted.fit.point.parameters[fitted.setup.model.parameter(name).unwrap()];
            let law = |part: &crate::fitted::MechanismTerm| {
                let values: Vec<f64> = part.instance.names.iter().map(value).collect();
                let place = part.candidate.place.equations(&search.nominal().model).join(" ");
                (library[part.candidate.mechanism].kind.clone(), place, values)
            };
            fitted.parts.iter().map(law).collect::<Vec<_>>()
        };
        let near = |found: &[(String, String, Vec<f64>)], kind: &str, place: &str, values: [f64; 2]| {
            let [(k, p, v)] = found else { return false };
            let close = v.iter().zip(values).all(|(a, b)| (a / b - 1.0).abs() < 0.05);
            k == kind && p == place && close
        };
        for seed in 40..42 {
            let brake = reported(&|[_, _, v, ..]| [3.0 * v / (1.0 + (v / 0.4).powi(2)), 0.0, 0.0], seed);
            assert!(near(&brake, "eddy_current_damping", "first", [3.0, 0.4]), "{brake:?}");
            let spring = reported(&|[_, y, _, _, z]| [0.0, 6.0 * (y - z), 2.0 * (y - z)], seed);
            assert!(near(&spring, "maxwell_element", "second", [6.0, 2.0]), "{spring:?}");
        }
    }

    /// x², found as |x| and a constant, is reported as x²; what is right stays.
    #[test]
    fn terms_that_do_the_same_work_for_less_take_the_place_of_more() {
        let library = crate::built_in().unwrap();
        for seed in 50..52 {
            let search =
                Search::new(bodies(&|[x, ..]| [9.0 * x * x, 0.0, 0.0], seed), &library, &crate::Quiet);
            let scale = search.nominal().data.sigma.clone();
            let calibrated = nothing(&search).calibrated;
            let plain: Vec<Candidate> =
                search.closing().into_iter().filter(|c| library[c.mechanism].is_plain()).collect();
            let with = |kinds: &[&str]| {
                let is = |c: &Candidate, kind: &str| {
                    library[c.mechanism].kind == kind
                        && c.place.equations(&search.nominal().model) == ["first"]
                };
                let law = |kind: &&str| {
                    let candidate = plain.iter().find(|c| is(c, kind)).unwrap().clone();
                    (candidate, vec![0.1], Vec::new())
                };
                let laws: Vec<_> = kinds.iter().map(law).collect();
                let start = calibrated.fit.point.parameters.iter().copied().chain(kinds.iter().map(|_| 0.1));
                search.reassembled_from(&calibrated, &laws, vec![start.collect()], &scale, STEPS).unwrap()
            };
            let reported = |model: FittedModel| {
                terms(&Found { improved: model, ..nothing(&search) }, &library, &search.nominal().model)
            };
            let other =
                search.reselected(&with(&["asymmetric_stiffness", "constant_offset"]), &plain, &scale);
            let other = reported(other.expect("there is a plainer one"));
            let [(kind, place, value)] = &other[..] else { panic!("{other:?}") };
            assert_eq!((&**kind, &**place), ("quadratic_stiffness", "first"));
            assert!((value / 9.0 - 1.0).abs() < 0.01, "{value}");
            let right = search.reselected(&with(&["quadratic_stiffness"]), &plain, &scale).map(reported);
            assert_eq!(right, None);
        }
    }

    /// A force that no formula is near stands in a table over its own variable: with it, and with the formula beside it, the
    /// equation is right all over the range.
    #[test]
    fn what_no_formula_reaches_has_a_free_shape() {
        let kinds = [
            "constant_offset",
            "cubic_stiffness",
            "viscous_friction",
            "free_position_force",
            "free_rate_force",
        ];
        let mut library = crate::built_in().unwrap();
        library.retain(|m| kinds.contains(&&*m.kind));
        // A magnet beside the first wheel.
        let magnet = |x: f64| 1.5 * (-((x - 0.2) / 0.2).powi(2)).exp();
        let search = Search::new(bodies(&|[x, ..]| [magnet(x), 0.0, 0.0], 70), &library, &crate::Quiet);
        let found = nothing(&search);
        let closed = search.closure(&found, &found.calibrated, &mut Visited::default()).unwrap();
        let reported = terms(&closed, &library, &search.nominal().model);
        assert!(reported.iter().any(|t| (&*t.0, &*t.1) == ("free_position_force", "first")), "{reported:?}");
        assert!(closed.improved.misfit(&closed.scale) < 1.1);
        let (model, _) = search.tabulated(&closed.improved).expect("a shape");
        let first = model.equations[0].residual();
        let force = |at: f64| {
            let of = |name: &str, primes: u8| match (name, primes) {
                ("x", 0) => Some(at),
                ("x" | "y", _) => Some(0.0),
                ("f", _) => Some(0.0),
                _ => model.parameter(name).map(|i| model.parameters[i].value),
            };
            first.eval(&of).unwrap()
        };
        for i in -10..=10 {
            let x = 0.06 * f64::from(i);
            let error = force(x) - (32.0 * x + magnet(x));
            assert!(error.abs() < 0.1, "{x}: {error}");
        }
    }

    /// The formula that was pieced together in place of a shape goes when that comes, and the shape takes its size.
    #[test]
    fn a_shape_takes_the_place_of_the_formula_of_its_variable() {
        let kinds = ["quadratic_stiffness", "cubic_stiffness", "free_position_force"];
        let mut library = crate::built_in().unwrap();
        library.retain(|m| kinds.contains(&&*m.kind));
        let magnet = |x: f64| 1.5 * (-((x - 0.2) / 0.2).powi(2)).exp();
        let search = Search::new(bodies(&|[x, ..]| [magnet(x), 0.0, 0.0], 71), &library, &crate::Quiet);
        let Found { calibrated, scale, .. } = nothing(&search);
        let first = |c: &&Candidate| c.place.equations(&search.nominal().model) == ["first"];
        let (shapes, plain): (Vec<_>, Vec<_>) =
            search.allowed().filter(first).cloned().partition(|c| search.is_shape(c));
        let formula = search.larger(&calibrated, &plain, 2, &scale).unwrap();
        assert_eq!(formula.parts.len(), 2);
        let shaped = search.shaped(&formula, &shapes, &scale).unwrap();
        let kinds: Vec<&str> = shaped.parts.iter().map(|p| &*library[p.candidate.mechanism].kind).collect();
        assert_eq!(kinds, ["free_position_force"]);
        assert!(shaped.rss() < formula.rss());
        let value = |name: &String| shaped.fit.point.parameters[shaped.setup.model.parameter(name).unwrap()];
        let part = &shaped.parts[0];
        let law = &library[part.candidate.mechanism];
        let is_change = |name: &str| law.linear.iter().any(|l| l == name);
        let named = law.parameters().zip(&part.instance.names);
        let changes: Vec<f64> = named.filter(|(plain, _)| is_change(plain)).map(|(_, n)| value(n)).collect();
        let mean = changes.iter().map(|v| v * v).sum::<f64>() / changes.len() as f64;
        assert!((0.3..3.0).contains(&mean), "{mean}");
    }

    /// No other terms do what a dry friction does; what a weak hardening does, a sine does too.
    #[test]
    fn a_name_is_held_only_where_no_other_terms_do_its_work() {
        let library = crate::built_in().unwrap();
        let held = |kind: &str, more: &dyn Fn([f64; 5]) -> [f64; 3]| {
            let search = Search::new(bodies(more, 31), &library, &crate::Quiet);
            let found = nothing(&search);
            let closed = search.closure(&found, &found.calibrated, &mut Visited::default()).expect(kind);
            let reported = terms(&closed, &library, &search.nominal().model);
            let index =
                closed.improved.parts.iter().position(|p| library[p.candidate.mechanism].kind == kind);
            let Some(index) = index else { panic!("{reported:?}") };
            !search.is_replaceable(&closed, index)
        };
        assert!(held("coulomb_friction", &|[_, _, v, ..]| [0.8 * f64::tanh(1e3 * v), 0.0, 0.0]));
        assert!(!held("cubic_stiffness", &|[x, ..]| [0.02 * x * x * x, 0.0, 0.0]));
    }

    /// What only imitates a law without a name scores below it, alone or with others; a right name scores above all of them.
    #[test]
    fn a_name_that_imitates_a_law_without_one_is_outdone() {
        let library = crate::built_in().unwrap();
        let above = |kinds: &[&str], more: &dyn Fn([f64; 5]) -> [f64; 3]| {
            let search = Search::new(bodies(more, 61), &library, &crate::Quiet);
            let found = nothing(&search);
            let model = with_forces(&search, &found, kinds);
            let all: Vec<usize> = (0..kinds.len()).collect();
            search.unnamed_above(&model, &all, &found.scale).unwrap().0
        };
        let damper = |[_, _, v, ..]: [f64; 5]| [0.3 * v.abs(), 0.0, 0.0];
        assert!(above(&["quadratic_stiffness"], &damper) > UNDECIDED);
        assert!(above(&["quadratic_stiffness", "constant_offset"], &damper) > UNDECIDED);
        let dry = |[_, _, v, ..]: [f64; 5]| [0.8 * f64::tanh(1e3 * v), 0.0, 0.0];
        assert!(above(&["coulomb_friction"], &dry) < -UNDECIDED);
        let cube = |[x, ..]: [f64; 5]| [20.0 * x * x * x, 0.0, 0.0];
        assert!(above(&["cubic_stiffness"], &cube) < -UNDECIDED);
    }

    /// The acceleration of one body has no place in the equation of the other.
    #[test]
    fn no_term_mixes_equations() {
        let library = crate::built_in().unwrap();
        let search = Search::new(bodies(&|_| [0.0; 3], 1), &library, &crate::Quiet);
        let (mixing, other): (Vec<_>, Vec<_>) = search.terms().partition(|c| search.mixes(c));
        let kinds = |of: &[&Candidate]| -> Vec<&str> {
            of.iter().map(|c| library[c.mechanism].kind.as_str()).collect()
        };
        // (Of a body, and of the spring between them: its inertia has both accelerations.)
        let named = ["coupling", "position_dependent_inertia"];
        assert!(kinds(&mixing).iter().all(|kind| named.contains(kind)), "{:?}", kinds(&mixing));
        assert!(other.len() > 30 && other.iter().all(|c| !library[c.mechanism].depends_on("o", 2)));
        let inertias = kinds(&other).iter().filter(|kind| **kind == named[1]).count();
        assert_eq!((mixing.len(), inertias), (3, 2));
    }
}
