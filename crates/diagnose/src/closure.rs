//! The closure: a sum of forces, each times one coefficient, where the names of the library leave more than noise.
//!
//! ```text
//! E(q, q', q'') + Σᵢ cᵢ φᵢ(q, q') = 0
//! ```
//!
//! The terms φ are the laws of the library that have one coefficient and nothing else ([`Mechanism::is_term`](crate::Mechanism::is_term)), with a
//! name or without. They are chosen, and refitted with all parameters of the machine, by the errors of the simulated
//! output: sparse identification (Brunton, Proctor and Kutz, PNAS 113, 2016), on the simulated motion in place of
//! differentiated measurements. A round adds up to three terms that explain most together, and takes away, one after the
//! other, the term that the recordings determine least, for as long as what is known of it
//! ([`robust`](crate::evidence::robust)) is below the odds against one term among all. Rounds go on until none changes
//! anything, on short segments first, where first order is good, on longer ones later, where small forces are seen.

use std::sync::Arc;

use greybox_calibrate::{Point, Setup, Work};
use rayon::prelude::*;

use crate::candidate::Candidate;
use crate::evidence::{Evidence, least_kappa};
use crate::place::own_coordinates;
use crate::screen::{screen_set, shift_without};
use crate::search::{
    Accepted, Fitted, Found, MOST_SAMPLES, Search, UNDECIDED, limits, next_scale, odds, same_level, whole,
};
use crate::uncertainty::Uncertainty;

/// Terms that are added at once: of forces that compensate each other, none pays alone.
const AT_ONCE: usize = 3;
/// Where a fit with new terms may begin: how much of their values, how much of the shift of the parameters that goes with
/// them. First order may promise too much of either.
const STARTS: [(f64, f64); 3] = [(1.0, 1.0), (1.0, 0.0), (1e-3, 0.0)];
/// Steps of a fit with new terms, and of one without a term.
const STEPS: usize = 20;
const STEPS_WITHOUT: usize = 12;
/// Residual over noise from which something is left.
const LEFT: f64 = 1.03;
/// Information per sample below which a residual is correlated.
const WHITE: f64 = 0.8;

impl Search<'_> {
    /// A closure that begins with the model `from`, in the place of what a search `found`. `None` where no term is worth its
    /// odds, and of a model whose laws [mix](Self::mixes) equations.
    pub(crate) fn closure(&self, found: &Found, from: &Fitted) -> Option<Found> {
        if from.parts.iter().any(|part| self.mixes(&part.candidate)) {
            return None;
        }
        let nominal = self.nominal();
        let terms: Vec<Candidate> = self
            .terms()
            .filter(|c| !self.is_bound_to_a_clock(c) && !self.mixes(c))
            .cloned()
            .collect();
        // With a limit of work of its own.
        let work = Arc::new(Work::of_fits_within(self.most_work));
        self.observer.begins(&work);
        let is_spent = || work.done() > self.most_work || work.is_given_up();
        let setup = Setup { noise: None, work: work.clone(), ..from.setup.clone() };
        let mut current = Fitted { setup, ..from.clone() };
        let mut scale = found.scale.clone();
        let mut lengths = self.lengths().to_vec();
        lengths.extend(lengths.last().is_some_and(|last| 2 * last < whole(nominal)).then(|| whole(nominal)));
        for (step, &length) in lengths.iter().enumerate() {
            let level = same_level(&current.setup, &nominal.windows(length, MOST_SAMPLES));
            let (setup, parameters) = (&current.setup, &current.fit.point.parameters);
            let stitched = setup.stitch(&current.level, &current.fit.point, &level, &scale);
            let measured = Point { parameters: parameters.clone(), starts: setup.starts(&level, parameters) };
            // At the shortest, from the measurements: what long segments believe is in doubt.
            let points = if step == 0 { vec![measured] } else { vec![stitched, measured] };
            let fit = setup.fit(&level, &scale, &points, limits(25));
            current = Fitted { level, fit, ..current };
            let mut seen: Vec<Vec<Candidate>> = Vec::new();
            loop {
                scale = next_scale(&current.fit, &scale, &nominal.data.sigma);
                self.method(&mut current, &scale);
                current = self.refit(&current, &scale, 10);
                seen.push(candidates(&current));
                if is_spent() || !leaves_something(&current, &scale) {
                    break;
                }
                match self.closer(&current, &terms, &scale) {
                    Some(closer) if !seen.iter().any(|s| is_same(s, &candidates(&closer))) => current = closer,
                    _ => break,
                }
            }
        }
        if current.parts.is_empty() || is_same(&candidates(&current), &candidates(from)) {
            return None;
        }
        current.setup.work = nominal.work.clone();
        let accepted = self.accepted(found, &current, &scale);
        Some(Found {
            calibrated: found.calibrated.clone(),
            improved: current,
            accepted,
            better_holds: found.better_holds.clone(),
            scale,
            limited: found.limited || is_spent(),
            rejected: Vec::new(),
            errs: false,
            closed: true,
        })
    }

    /// What the recordings say for each part of a closure, and what the search that found some of them could not tell from
    /// these.
    fn accepted(&self, found: &Found, closure: &Fitted, scale: &[f64]) -> Vec<Accepted> {
        let of = |index: usize| {
            let candidate = closure.parts[index].candidate.clone();
            let score = self.less(closure, index, scale).map_or(0.0, |less| self.robust(&less, closure, scale));
            let known = found.accepted.iter().find(|a| a.candidate == candidate);
            let mut rivals = known.map_or(Vec::new(), |known| known.rivals.clone());
            rivals.retain(|r| r.equivalent && closure.parts.iter().all(|p| p.candidate != r.candidate));
            rivals.iter_mut().for_each(|r| r.evidence.score = score);
            Accepted { candidate, evidence: Evidence { score, ..Evidence::NONE }, rivals }
        };
        (0..closure.parts.len()).into_par_iter().map(of).collect()
    }

    /// A round: more terms, and of all of them those that are known. `None` where nothing changes, or for the worse.
    fn closer(&self, current: &Fitted, terms: &[Candidate], scale: &[f64]) -> Option<Fitted> {
        let larger = self.larger(current, terms, scale)?;
        let closer = self.known_alone(larger, odds(terms.len()), scale);
        let is_better = closer.rss().total_cmp(&current.rss()).is_lt() || closer.parts.len() < current.parts.len();
        is_better.then_some(closer)
    }

    /// The model with the terms that explain most together beside it.
    fn larger(&self, base: &Fitted, terms: &[Candidate], scale: &[f64]) -> Option<Fitted> {
        let taken = |c: &Candidate| base.parts.iter().any(|p| p.candidate == *c);
        let open: Vec<Candidate> = terms.iter().filter(|c| !taken(c)).cloned().collect();
        let (setup, point) = (&base.setup, &base.fit.point);
        let together = screen_set(setup, self.library, &open, &base.level, scale, point, AT_ONCE)?;
        self.extend_by(base, &open, &together, &STARTS, scale, STEPS)
    }

    /// The model without what the recordings do not tell: as long as the term that they determine least is not worth the
    /// odds, it goes.
    fn known_alone(&self, model: Fitted, odds: f64, scale: &[f64]) -> Fitted {
        let mut model = model;
        while !model.parts.is_empty() {
            let known = self.known(&model, &Uncertainty::of(&model, scale).widths());
            let least = (0..known.len()).min_by(|&a, &b| known[a].total_cmp(&known[b])).unwrap_or(0);
            match self.less(&model, least, scale) {
                Some(less) if self.robust(&less, &model, scale) < odds => model = less,
                _ => break,
            }
        }
        model
    }

    /// The model without part `index`, from where the others go, to first order, when it does.
    fn less(&self, model: &Fitted, index: usize, scale: &[f64]) -> Option<Fitted> {
        let (setup, point) = (&model.setup, &model.fit.point);
        let own: Vec<usize> =
            model.parts[index].instance.names.iter().filter_map(|n| setup.model.parameter(n)).collect();
        let gone: Vec<(usize, f64)> = (0..setup.free.len())
            .filter(|&i| own.contains(&setup.free[i].index))
            .map(|i| (i, point.parameters[setup.free[i].index]))
            .collect();
        let shift = shift_without(setup, &model.level, scale, point, &gone);
        let mut shifted = point.parameters.clone();
        let kept = setup.free.iter().filter(|f| !own.contains(&f.index));
        for (f, d) in kept.zip(shift) {
            shifted[f.index] = (shifted[f.index] + d).clamp(f.lower, f.upper);
        }
        let start = (0..shifted.len()).filter(|i| !own.contains(i)).map(|i| shifted[i]).collect();
        let mut parts = self.laws(model);
        parts.remove(index);
        self.reassembled_from(model, &parts, vec![start], scale, STEPS_WITHOUT)
    }

    /// Whether up to three other terms do as well as part `index` of a closure: the recordings do not hold its name.
    pub(crate) fn is_replaceable(&self, closure: &Found, index: usize) -> bool {
        let (model, scale) = (&closure.improved, &closure.scale);
        let candidate = &model.parts[index].candidate;
        let Some(less) = self.less(model, index, scale) else { return true };
        let others: Vec<Candidate> =
            self.terms().filter(|c| *c != candidate && !self.mixes(c)).cloned().collect();
        let Some(other) = self.larger(&less, &others, scale) else { return false };
        self.robust(&less, &other, scale) > self.robust(&less, model, scale) - UNDECIDED
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

fn candidates(fitted: &Fitted) -> Vec<Candidate> {
    fitted.parts.iter().map(|part| part.candidate.clone()).collect()
}

/// Whether two models have the same parts, in whatever order.
fn is_same(a: &[Candidate], b: &[Candidate]) -> bool {
    a.len() == b.len() && a.iter().all(|c| b.contains(c))
}

/// Whether more than white noise is left.
fn leaves_something(fitted: &Fitted, scale: &[f64]) -> bool {
    fitted.misfit(scale) > LEFT
        || least_kappa(&fitted.setup, &fitted.level, scale, &fitted.fit.point) < WHITE
}
