//! The finished diagnosis from the answer of a search: estimates, free runs, what each mechanism is and how sure, the remainder.

use std::sync::Arc;

use greybox_calibrate::{Criterion, Data, HoldoutSource, Setup};
use greybox_model::Model;

use crate::Stage;
use crate::answer::Answer;
use crate::baseline::{Baseline, Judge, WholeRecordFit, residual_scale};
use crate::diagnosis::{
    Alternative, Basis, DiagnoseError, Diagnosis, Estimate, IdentifiedMechanism, Options, ParameterChange,
    Remainder, Role, Run, Site, Verdict,
};
use crate::discrepancy::Discrepancy;
use crate::findings::{DOUBTED, findings, rank};
use crate::fitted::{FittedModel, Found, MechanismTerm};
use crate::importance::subsets_of;
use crate::layout::follows;
use crate::proposal::Proposal;
use crate::remainder::{only_variable, remainder};
use crate::search::{Search, UNDECIDED};
use crate::trajectory::TrajectoryEval;
use crate::uncertainty::Uncertainty;
use crate::verdict::{Judged, discrepancy_of, is_crowded, is_shared};

/// Residual over the estimated noise below which the estimate was not of noise alone.
const BELOW_NOISE: f64 = 0.8;

/// The diagnosis of what a search for the equations `nominal` found.
///
/// # Errors
/// [`DiagnoseError::Diverges`].
pub(crate) fn conclude(
    nominal: &Setup,
    (holdout, holdout_source): (Arc<Data>, HoldoutSource),
    search: &Search<'_>,
    found: Found,
    options: &Options,
) -> Result<Diagnosis, DiagnoseError> {
    search.listener.stage(Stage::Simulating);
    // The model that fits best knows best how errors grow.
    let judge = Judge::of(&found.improved, &residual_scale(&found.improved, &found.scale));
    let Answer { found, polished, baseline, judged, believed, rejected, limited } =
        Answer::of(nominal, search, found, options, &judge);
    search.listener.stage(Stage::Concluding);
    let WholeRecordFit { fitted: improved, origin } = &polished;
    let scale = residual_scale(improved, &found.scale);
    let Baseline { polished: WholeRecordFit { fitted: calibrated, origin: own }, .. } = &baseline;
    let uncertainty = Uncertainty::of(origin, &scale);
    let (improved_model, instances) = match search.tabulated(improved) {
        Some((model, instances)) => (model, Some(instances)),
        None => (final_model(improved), None),
    };
    let parameters = parameters(
        nominal,
        (calibrated, &Uncertainty::of(own, &baseline.scale).widths()),
        (improved, &uncertainty.widths()),
    );

    let models = Models {
        nominal,
        calibrated: (calibrated, &baseline.scale),
        improved: (improved, &scale),
        judge: &judge,
    };
    let train = models.role(&nominal.data, false);
    follows([&train.calibrated.run, &train.improved.run], &nominal.data)?;
    let held_out = models.role(&holdout, true);
    // The machine may be predictable where it was recorded to learn from, and not where it is held out.
    let held = improved.setup.for_simulations_of(holdout, &improved.fit.point.parameters, &scale);
    let (elsewhere, _) = held.criterion(&improved.fit.point.parameters, &scale);
    let criterion = if elsewhere == Criterion::Windowed { elsewhere } else { judge.criterion };

    let verdict = if believed.contains(&true) { Verdict::MissingPhysics } else { judged.verdict };
    let significant =
        found.errs || judged.left.significant(improved.parts.len()) || verdict == Verdict::Unexplained;
    let mut mechanisms = findings(
        (improved, &scale),
        &found,
        &nominal.model,
        search.library,
        &judged.shares,
        &train,
        &uncertainty,
    );
    if let Some(instances) = &instances {
        improved.parts.iter().zip(instances).zip(&mut mechanisms).for_each(|((part, instance), finding)| {
            let mechanism = &search.library[part.candidate.mechanism];
            finding.stands_as(instance, &improved_model, mechanism.shape.is_some());
        });
    }
    cast_doubt(&mut mechanisms, search, improved, &judged, significant);
    let subsets = match verdict == Verdict::MissingPhysics && believed.iter().all(|b| *b) && !found.closed {
        true => {
            let left = [&judged.alone, &judged.without]
                .map(|rss| rss.iter().map(|rss| judged.share(*rss)).collect());
            subsets_of(&judged.shares, left, judged.share(judged.full))
        }
        false => Vec::new(),
    };
    let proposal = believed.contains(&false).then(|| {
        let parameters = &improved.fit.point.parameters;
        let trained = TrajectoryEval::simulated(&improved.setup, &train.improved.run.x, parameters);
        let held = TrajectoryEval::simulated(&held, &held_out.improved.run.x, parameters);
        let proposed = improved.parts.iter().zip(&believed).filter(|part| !part.1);
        let proposed: Vec<&MechanismTerm> = proposed.map(|(part, _)| part).collect();
        let errors = (baseline.errors(&judge), &judge.errors(&polished, &scale)[..]);
        Proposal::of(improved, &proposed, search.library, (&trained, &held), errors, &uncertainty)
    });
    let remainder =
        what_remains(search, &found, (calibrated, &baseline.scale), improved, judged, (verdict, significant));
    let (noise_floor, unknown_noise) = noise(&train);
    let (basis, mechanisms, candidates) = by_belief(verdict, mechanisms, believed);
    Ok(Diagnosis {
        verdict,
        terms_only: options.terms_only,
        basis,
        criterion,
        nominal: nominal.model.clone(),
        calibrated: final_model(calibrated),
        mechanisms,
        candidates,
        proposal,
        rejected,
        subsets,
        remainder,
        parameters,
        train,
        holdout: held_out,
        holdout_source,
        window: judge.window,
        noise_floor,
        unknown_noise,
        holds: nominal.holds.iter().copied().zip(improved.setup.holds.iter().copied()).collect(),
        better_holds: found.better_holds.iter().map(|b| b.0).collect(),
        seed: options.seed,
        limited,
        improved: improved_model,
    })
}

/// A model with its fitted values; the units of its mechanisms follow from the equations that they enter.
fn final_model(fitted: &FittedModel) -> Model {
    let mut model = fitted.setup.model.clone();
    for (p, v) in model.parameters.iter_mut().zip(&fitted.fit.point.parameters) {
        p.value = *v;
    }
    let _ = model.resolve_units();
    model
}

/// The parameters of the nominal equations in the calibrated and in the improved model, each with the half widths of the 95 %
/// intervals of its free parameters.
fn parameters(
    nominal: &Setup,
    calibrated: (&FittedModel, &[f64]),
    improved: (&FittedModel, &[f64]),
) -> Vec<ParameterChange> {
    let estimate = |(fitted, widths): (&FittedModel, &[f64]), index: usize| {
        let value = fitted.fit.point.parameters[index];
        let width = fitted.setup.free.iter().position(|x| x.index == index).map(|i| widths[i]);
        Estimate { value, ci95: width.map(|w| (value - w, value + w)) }
    };
    let change = |(index, parameter): (usize, &greybox_model::Parameter)| ParameterChange {
        index,
        nominal: parameter.value,
        calibrated: estimate(calibrated, index),
        improved: estimate(improved, index),
    };
    nominal.model.parameters.iter().enumerate().map(change).collect()
}

/// The three models, each fitted one with its residual scale.
struct Models<'a> {
    nominal: &'a Setup,
    calibrated: (&'a FittedModel, &'a [f64]),
    improved: (&'a FittedModel, &'a [f64]),
    judge: &'a Judge,
}

impl Models<'_> {
    /// Their free runs over one role's recordings.
    fn role(&self, data: &Arc<Data>, held: bool) -> Role {
        let run = |setup: &Setup, parameters: &[f64], scale: &[f64]| -> Run {
            let fine: Vec<f64> = scale.iter().map(|s| 0.02 * s).collect();
            let setup = match held {
                true => setup.for_simulations_of(data.clone(), parameters, &fine),
                false => setup.clone(),
            };
            let run = match held {
                true => setup.free_run(parameters, scale),
                false => setup.training_run(parameters, scale),
            };
            let scores = |recording| setup.scores(&run, parameters, self.judge.window, recording);
            let by_recording = (0..data.recordings.len()).map(|r| scores(Some(r))).collect();
            Run { scores: scores(None), by_recording, run }
        };
        let fitted =
            |(fitted, scale): (&FittedModel, &[f64])| run(&fitted.setup, &fitted.fit.point.parameters, scale);
        let spread: Vec<f64> = data.spread.iter().map(|s| s.max(1e-300)).collect();
        Role {
            data: data.clone(),
            nominal: run(self.nominal, &self.nominal.values(), &spread),
            calibrated: fitted(self.calibrated),
            improved: fitted(self.improved),
        }
    }
}

/// Bounds the confidence of what something else may stand behind, and names the law that does its work better.
fn cast_doubt(
    mechanisms: &mut [IdentifiedMechanism],
    search: &Search<'_>,
    improved: &FittedModel,
    judged: &Judged,
    significant: bool,
) {
    let nominal = &search.nominal().model;
    for (i, m) in mechanisms.iter_mut().enumerate() {
        // What is still missing may be what was taken for this.
        if significant
            || judged.doubts[i].is_some_and(|d| d > -UNDECIDED)
            || !judged.outdone[i].is_empty()
            || is_shared(improved, &judged.shares, i)
            || is_crowded(improved, &judged.shares, i, nominal)
        {
            m.confidence = m.confidence.min(DOUBTED);
            m.alternatives.iter_mut().for_each(|a| a.confidence = a.confidence.min(DOUBTED));
        }
        if let Some(law) = judged.outdone[i].first() {
            let place = &law.candidate.place;
            let mechanism = &search.library[law.candidate.mechanism];
            m.alternatives.push(Alternative {
                kind: mechanism.kind.clone(),
                confidence: 1.0 - DOUBTED,
                equivalent: false,
                expression: law.instance.expression.to_string(),
                separate: mechanism.separate(place.moves(nominal)).to_string(),
                excitation: mechanism.excitation.clone(),
                site: Site::of(std::slice::from_ref(place), nominal),
            });
            rank(&mut m.alternatives);
        }
    }
}

/// What is still unexplained, beside the calibrated model with its residual scale.
fn what_remains(
    search: &Search<'_>,
    found: &Found,
    (calibrated, calibrated_scale): (&FittedModel, &[f64]),
    improved: &FittedModel,
    judged: Judged,
    (verdict, significant): (Verdict, bool),
) -> Remainder {
    let unexplained = verdict != Verdict::MissingPhysics && !improved.parts.is_empty();
    // What is not believed explains nothing: all that the equations lack is what is missing. (Where too little is
    // known of the noise for that, what those mechanisms leave over shows the place.)
    let lacks = if unexplained { discrepancy_of(calibrated, calibrated_scale) } else { None };
    if lacks.is_some() {
        return remainder(calibrated, lacks, significant, 1.0);
    }
    let all = if unexplained { judged.share(judged.base - judged.full) } else { 0.0 };
    // What a closure leaves shows nothing of what it models: that has the closure's own variable.
    let own = if unexplained && found.closed { only_variable(improved, search.library) } else { None };
    let still = judged.share(judged.full);
    let discrepancy = judged.discrepancy.map(|left| match own {
        Some(variable) => Discrepancy { variable: Some((variable, left.gain)), ..left },
        None => left,
    });
    let mut left = remainder(improved, discrepancy, significant, still);
    // An equation of a law's own state is none of the machine.
    let of_the_machine = &search.nominal().model.equations;
    left.location.equations.retain(|name| of_the_machine.iter().any(|e| e.name == *name));
    Remainder { share_of_residual: (all + left.share_of_residual).min(1.0), ..left }
}

/// Noise over the spread of each channel, and the channels whose noise the recordings do not tell. No model beats the noise:
/// where one is below what fast differences say, they saw more than noise.
fn noise(train: &Role) -> (Vec<f64>, Vec<usize>) {
    let models = [&train.nominal, &train.calibrated, &train.improved];
    let reached = |c: usize| models.iter().map(|run| run.scores[c].nrmse).fold(f64::INFINITY, f64::min);
    let Data { sigma, spread, .. } = &*train.data;
    let estimated: Vec<f64> = sigma.iter().zip(spread).map(|(s, d)| s / d.max(1e-300)).collect();
    let floor = estimated.iter().enumerate().map(|(c, &floor)| floor.min(reached(c))).collect();
    let unknown = (0..estimated.len()).filter(|&c| reached(c) < BELOW_NOISE * estimated[c]).collect();
    (floor, unknown)
}

/// The mechanisms that are named and those that are proposed, largest share first, and what the improved model rests on. What
/// no name reaches is proposed without one: it predicts data that it was not fitted to.
fn by_belief(
    verdict: Verdict,
    mechanisms: Vec<IdentifiedMechanism>,
    believed: Vec<bool>,
) -> (Basis, Vec<IdentifiedMechanism>, Vec<IdentifiedMechanism>) {
    let mut all: Vec<(IdentifiedMechanism, bool)> = mechanisms.into_iter().zip(believed).collect();
    all.sort_by(|a, b| b.0.share_explained.total_cmp(&a.0.share_explained));
    let (named, proposed): (Vec<_>, Vec<_>) = all.into_iter().partition(|m| m.1);
    let [named, proposed] = [named, proposed].map(|of| of.into_iter().map(|m| m.0).collect::<Vec<_>>());
    match verdict {
        Verdict::MissingPhysics if proposed.is_empty() => (Basis::Named, named, proposed),
        Verdict::MissingPhysics => (Basis::NamedAndProposed, named, proposed),
        _ if proposed.is_empty() => (Basis::Calibrated, Vec::new(), proposed),
        _ => (Basis::Proposed, Vec::new(), proposed),
    }
}
