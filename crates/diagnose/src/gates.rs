//! The gates: what a model must pass to be handed back.

use rayon::prelude::*;

use crate::Stage;
use crate::baseline::{Baseline, Judge, WholeRecordFit, leaves_noise, polish, residual_scale};
use crate::fitted::{FittedModel, Found};
use crate::plausibility::Deviation;
use crate::proposal::Gate;
use crate::search::Search;
use crate::uncertainty::Uncertainty;
use crate::validate::Gain;

/// Takes mechanisms away until what is left can be handed back: every one is determined, no inertia is negative, and the
/// model is no worse than the calibrated one in training. It also predicts data left out of its fit better than chance,
/// unless a round believed it (`named`) and it leaves no more than noise, white or coloured. What acts at certain times of a
/// single recording is never taken for such a prediction. Nothing is left but the calibrated model where that takes all
/// mechanisms.
pub(crate) fn defend(
    search: &Search<'_>,
    found: &mut Found,
    polished: WholeRecordFit,
    baseline: &Baseline,
    judge: &Judge,
    named: bool,
) -> WholeRecordFit {
    let gates = Gates::new(search, baseline, judge, named);
    let mut polished = polished;
    loop {
        let fitted = &polished.fitted;
        if fitted.parts.is_empty() {
            found.improved = found.calibrated.clone();
            found.accepted.clear();
            return baseline.polished.clone();
        }
        let Some(failure) = gates.failure(&polished, &found.scale) else { return polished };
        search.listener.stage(Stage::Simulating);
        // Without the part that is missed least. (That would be one that is not determined, unless it is so only beside
        // another that does the same.)
        let open = match failure.gate {
            Gate::Clock => failure.parts,
            _ => (0..fitted.parts.len()).collect(),
        };
        let smaller = open
            .into_par_iter()
            .filter_map(|i| {
                let smaller = search.smaller(&found.improved, i, &found.scale)?;
                let polished = polish(search, &smaller, &found.scale, judge);
                let scale = residual_scale(&polished.fitted, &found.scale);
                let of = &polished.fitted;
                let misfit = judge.misfit(&of.setup, &of.fit.point.parameters, &scale);
                Some((misfit, smaller, polished))
            })
            .collect::<Vec<_>>()
            .into_iter()
            .min_by(|a, b| a.0.total_cmp(&b.0));
        match smaller {
            Some((_, smaller, rest)) => {
                found.accepted.retain(|a| smaller.parts.iter().any(|p| p.candidate == a.candidate));
                found.improved = smaller;
                polished = rest;
            }
            None => {
                found.improved = found.calibrated.clone();
                found.accepted.clear();
                return baseline.polished.clone();
            }
        }
    }
}

/// What a model must pass to be handed back.
pub(crate) struct Gates<'a> {
    pub(crate) search: &'a Search<'a>,
    pub(crate) baseline: &'a Baseline,
    pub(crate) judge: &'a Judge,
    /// A round believed its mechanisms.
    pub(crate) named: bool,
    /// How far the machine's parameters may be from what the model states of them, if that counts.
    pub(crate) stated: Option<Deviation>,
}

/// The gate that a model fails at.
pub(crate) struct Failure {
    pub(crate) gate: Gate,
    /// The parts that it fails by, where it is not the model as a whole.
    pub(crate) parts: Vec<usize>,
}

impl Failure {
    pub(crate) fn at(gate: Gate, parts: Vec<usize>) -> Option<Failure> {
        Some(Failure { gate, parts })
    }
}

impl<'a> Gates<'a> {
    pub(crate) fn new(
        search: &'a Search<'a>,
        baseline: &'a Baseline,
        judge: &'a Judge,
        named: bool,
    ) -> Gates<'a> {
        Gates { search, baseline, judge, named, stated: None }
    }

    /// Those of a closure in the place of what `stands`: it takes the machine's parameters no farther from what the model states
    /// of them than the calibrated model or that does. (Named laws are not held to it. One may stand in for a given term, whose
    /// parameter then goes to zero: gravity for the spring of a linearised pendulum.)
    pub(crate) fn of_a_closure(
        search: &'a Search<'a>,
        stands: &FittedModel,
        baseline: &'a Baseline,
        judge: &'a Judge,
    ) -> Gates<'a> {
        let calibrated = search.deviation(&baseline.polished.fitted);
        let stated = Some(calibrated.larger(search.deviation(stands)));
        Gates { stated, ..Gates::new(search, baseline, judge, false) }
    }

    /// The first gate that the model fails at, if it does.
    pub(crate) fn failure(&self, polished: &WholeRecordFit, scale: &[f64]) -> Option<Failure> {
        let (search, fitted) = (self.search, &polished.fitted);
        let own = residual_scale(fitted, scale);
        let scores = self.judge.scores(&fitted.setup, &fitted.fit.point.parameters, &own);
        // (By the free run: starts that are free absorb what a model leaves, of segments as of windows.)
        let likely = self.named && leaves_noise(&scores, &polished.origin, &own);
        let bound = if likely { Vec::new() } else { search.bound_to_a_clock(fitted) };
        if !bound.is_empty() {
            return Failure::at(Gate::Clock, bound);
        }
        let widths = Uncertainty::of(&polished.origin, &own).widths();
        if let Some(part) = search.undetermined(&polished.origin, &widths) {
            return Failure::at(Gate::Determined, vec![part]);
        }
        let parameters = &fitted.fit.point.parameters;
        if let Some(part) = fitted.parts.iter().position(|p| !search.allows(p, &fitted.setup, parameters)) {
            return Failure::at(Gate::Determined, vec![part]);
        }
        if self.judge.criterion.misfit(&scores).total_cmp(&self.baseline.misfit).is_gt() {
            return Failure::at(Gate::Training, Vec::new());
        }
        if search.has_negative_inertia(fitted.at(scale)) {
            return Failure::at(Gate::Inertia, Vec::new());
        }
        if self.stated.is_some_and(|stated| search.deviation(fitted).is_implausible_beside(stated)) {
            return Failure::at(Gate::Parameters, Vec::new());
        }
        let predicts = || {
            search.listener.stage(Stage::Validating);
            Gain::of(self.baseline.errors(self.judge), &self.judge.errors(polished, &own)).is_beyond_chance()
        };
        if likely || predicts() { None } else { Failure::at(Gate::CrossValidation, Vec::new()) }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::OnceCell;

    use super::*;
    use crate::built_in;
    use crate::candidate::Candidate;

    /// Each gate stops what it is there for, and a right law passes all of them.
    #[test]
    fn every_gate_stops_what_it_is_there_for() {
        use crate::closure::tests::{bodies, nothing};
        let library = built_in().unwrap();
        let search = Search::new(bodies(&|[x, ..]| [9.0 * x * x, 0.0, 0.0], 60), &library, &crate::Quiet);
        let found = nothing(&search);
        let (scale, calibrated) = (&found.scale, &found.calibrated);
        let own = residual_scale(calibrated, scale);
        let judge = Judge::of(calibrated, &own);
        let baseline = || Baseline::of(&found, &search.nominal().values(), &judge);
        let with = |kind: &str, values: &[f64], steps: usize| {
            let is_there = |c: &&Candidate| {
                library[c.mechanism].kind == kind && c.place.equations(&search.nominal().model) == ["first"]
            };
            let candidate = search.candidates().iter().chain(search.terms()).find(is_there).unwrap().clone();
            let parameters = calibrated.fit.point.parameters.iter().chain(values).copied().collect();
            let laws = [(candidate, values.to_vec(), vec![1.0; values.len()])];
            search.reassembled_from(calibrated, &laws, vec![parameters], scale, steps).unwrap()
        };
        let gate = |model: FittedModel, baseline: &Baseline| {
            let gates = Gates::of_a_closure(&search, calibrated, baseline, &judge);
            gates.failure(&polish(&search, &model, scale, &judge), scale).map(|failure| failure.gate)
        };
        let as_it_is = |model: FittedModel, baseline: &Baseline| {
            let gates = Gates::of_a_closure(&search, calibrated, baseline, &judge);
            gates.failure(&WholeRecordFit::kept(model), scale).map(|failure| failure.gate)
        };
        let law = with("quadratic_stiffness", &[9.0], 20);
        assert_eq!(gate(law.clone(), &baseline()), None);
        assert_eq!(gate(with("step_disturbance", &[0.5, 10.0], 20), &baseline()), Some(Gate::Clock));
        assert_eq!(gate(with("cubic_damping", &[0.01], 20), &baseline()), Some(Gate::Determined));
        // A static friction below that in motion.
        let required = with("stribeck_friction", &[0.2, 0.1, 0.5], 0);
        assert_eq!(as_it_is(required, &baseline()), Some(Gate::Determined));
        let closer = Baseline { misfit: f64::NEG_INFINITY, ..baseline() };
        assert_eq!(gate(law.clone(), &closer), Some(Gate::Training));
        let lenient = Baseline { misfit: f64::INFINITY, ..baseline() };
        // (An inertia of −0.02 kg m²: any force moves it far, so that it is well known.)
        let negative = with("position_dependent_inertia", &[-1.02, 0.5], 0);
        assert_eq!(as_it_is(negative, &lenient), Some(Gate::Inertia));
        // Five standard deviations from where the model states it, the calibrated one as stated.
        let mut drawn_away = law.clone();
        let index = drawn_away.setup.model.parameter("b").unwrap();
        let damping = drawn_away.setup.free.iter().position(|f| f.index == index).unwrap();
        let value = drawn_away.fit.point.parameters[index];
        drawn_away.setup.free[damping].prior =
            greybox_calibrate::Prior::Normal { mean: value - 0.5, std: 0.1 };
        assert_eq!(as_it_is(drawn_away, &lenient), Some(Gate::Parameters));
        // A calibrated model that predicts better.
        let folds = baseline().errors(&judge).len();
        let better = Baseline { errors: OnceCell::from(vec![-50.0; folds]), ..baseline() };
        assert_eq!(gate(law.clone(), &better), Some(Gate::CrossValidation));
        // What leaves no more than noise stays where a round named it, and goes where it is a proposal.
        let stands = |named: bool| {
            let mut found = Found { improved: law.clone(), ..nothing(&search) };
            let polished = polish(&search, &law, scale, &judge);
            let defended = defend(&search, &mut found, polished, &better, &judge, named);
            assert_eq!(found.improved.parts.len(), defended.fitted.parts.len());
            defended.fitted.parts.len()
        };
        assert_eq!((stands(true), stands(false)), (1, 0));
    }
}
