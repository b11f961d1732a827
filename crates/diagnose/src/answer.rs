//! The answer of a search: the model that is handed back beside the best that the equations do alone, and which of its parts are
//! named.

use greybox_calibrate::Setup;
use greybox_model::Model;

use crate::baseline::{
    Baseline, Judge, WholeRecordFit, WorkOnlyListener, alone, leaves_noise, polish, residual_scale,
};
use crate::candidate::Candidate;
use crate::diagnosis::{Options, Verdict};
use crate::fitted::{FittedModel, Found, MechanismTerm};
use crate::gates::defend;
use crate::library::Mechanism;
use crate::proposal::{Gate, Rejected};
use crate::search::{MISFIT, Search};
use crate::takeover::{Closed, Explored, explored};
use crate::verdict::Judged;

/// The model that is handed back, and what holds of it.
pub(crate) struct Answer {
    pub(crate) found: Found,
    pub(crate) polished: WholeRecordFit,
    /// The best that the equations do alone.
    pub(crate) baseline: Baseline,
    pub(crate) judged: Judged,
    /// Whether each of its parts is named.
    pub(crate) believed: Vec<bool>,
    /// The closure that was not believed, and at which gate it failed.
    pub(crate) rejected: Option<Rejected>,
    /// A search ended at its limit of work.
    pub(crate) limited: bool,
}

impl Answer {
    /// Of what a search for the equations `nominal` found: what can be defended of it, or what takes its place.
    pub(crate) fn of(
        nominal: &Setup,
        search: &Search<'_>,
        found: Found,
        options: &Options,
        judge: &Judge,
    ) -> Answer {
        let library = search.library;
        let values = nominal.values();
        // The search fits the baseline with a scale that its mechanisms made small, and only where it goes on with it. What is
        // compared with is the best that the equations can do alone.
        let has_parts = !found.improved.parts.is_empty();
        let alone =
            has_parts.then(|| alone(nominal, false, options.work, &WorkOnlyListener(search.listener)));
        let baseline_of = |found: &Found| Baseline::of(found, &values, judge);
        let (mut baseline, (alone, polished)) = rayon::join(
            || baseline_of(&found),
            || {
                rayon::join(
                    || alone.as_ref().map(|alone| (alone.limited, baseline_of(alone))),
                    || has_parts.then(|| polish(search, &found.improved, &found.scale, judge)),
                )
            },
        );
        let mut limited = found.limited;
        let mut found = found;
        // What no round believed may still be what the equations lack: where the noise does not explain the rest, it is
        // held against data that it was not fitted to.
        let mut named = true;
        let mut proposed = None;
        if found.improved.parts.is_empty() && baseline.polished.fitted.misfit(&found.scale) > MISFIT {
            for rejected in std::mem::take(&mut found.rejected).into_iter().rev() {
                found.improved = rejected;
                let polished = polish(search, &found.improved, &found.scale, judge);
                let polished = defend(search, &mut found, polished, &baseline, judge, false);
                if !polished.fitted.parts.is_empty() {
                    (named, proposed) = (false, Some(polished));
                    break;
                }
            }
        }
        let mut polished = if let Some(proposed) = proposed {
            proposed
        } else if let (Some((is_limited, alone)), Some(polished)) = (alone, polished) {
            limited |= is_limited;
            if alone.misfit.total_cmp(&baseline.misfit).is_lt() {
                baseline = alone;
            }
            defend(search, &mut found, polished, &baseline, judge, true)
        } else {
            baseline.polished.clone()
        };
        let judged_of = |found: &Found, polished: &WholeRecordFit, named: &dyn Fn(&MechanismTerm) -> bool| {
            let scale = residual_scale(&polished.fitted, &found.scale);
            Judged::of(search, found, &polished.fitted, &scale, (&baseline.polished.fitted, named), library)
        };
        let mut judged = judged_of(&found, &polished, &|_| named);
        // Where more than noise is left, every model of the machine errs, and output errors do not compare them.
        let leaves_more = |found: &Found, polished: &WholeRecordFit| {
            let scale = residual_scale(&polished.fitted, &found.scale);
            let parameters = &polished.fitted.fit.point.parameters;
            !leaves_noise(&judge.scores(&polished.fitted.setup, parameters, &scale), &polished.origin, &scale)
        };
        let mut errs = leaves_more(&found, &polished);
        let names = judged.verdict == Verdict::MissingPhysics;
        let agreed: Vec<_> = match errs && names {
            true => polished.fitted.parts.iter().map(|p| named_as(p, library, &nominal.model)).collect(),
            false => Vec::new(),
        };
        // Of laws that are not believed together those stand that another comparison has named.
        let believed = |judged: &Judged, found: &Found, fitted: &FittedModel| -> Vec<bool> {
            let all = judged.verdict == Verdict::MissingPhysics;
            let stands = |part: &MechanismTerm| {
                found.errs && agreed.contains(&named_as(part, library, &nominal.model))
            };
            let parts = fitted.parts.iter().zip(&judged.named);
            parts.map(|(part, named)| (all && *named) || stands(part)).collect()
        };
        let mut rejected = None;
        // (What passes for coloured noise may hold what no name explains.)
        let unnamed = polished.fitted.parts.is_empty();
        if errs || judged.verdict == Verdict::Unexplained || unnamed && judged.left.significant(0) {
            let closed = Closed::of(search, &found, &polished, &baseline, judge);
            // What is not named is a proposal, and predicts what it was not fitted to, as any other.
            if named && judged.verdict != Verdict::MissingPhysics {
                let parts = polished.fitted.parts.len();
                polished = defend(search, &mut found, polished, &baseline, judge, false);
                if polished.fitted.parts.len() < parts {
                    judged = judged_of(&found, &polished, &|_| false);
                    errs = leaves_more(&found, &polished);
                }
            }
            // What reaches the noise leaves no error of the model to be believed beside.
            if errs && !options.terms_only && !closed.as_ref().is_ok_and(|closed| closed.leaves_noise) {
                let in_both =
                    |part: &MechanismTerm| agreed.contains(&named_as(part, library, &nominal.model));
                let standing = (&found, &polished);
                let explored = explored(search, standing, in_both, names, &baseline, judge);
                if let Some(Explored { found: other, polished: simulates, named }) = explored {
                    judged = judged_of(&other, &simulates, &|part| named.contains(&part.candidate));
                    (found, polished) = (other, simulates);
                }
            }
            rejected = match closed {
                Err(failed) => failed,
                Ok(closed) => {
                    let standing = believed(&judged, &found, &polished.fitted);
                    let standing = polished.fitted.parts.iter().zip(standing).filter(|part| part.1);
                    let standing: Vec<&Candidate> = standing.map(|(part, _)| &part.candidate).collect();
                    if !closed.outdoes((&found, &polished), !standing.is_empty(), judge) {
                        Some(Rejected::at(Gate::Comparison, search, &closed.polished.fitted))
                    } else if let Some(named) = closed.names(search, &standing) {
                        let Closed { found: other, polished: simulates, .. } = closed;
                        judged = judged_of(&other, &simulates, &|part| named.contains(&part.candidate));
                        (found, polished) = (other, simulates);
                        None
                    } else {
                        Some(Rejected::at(Gate::Names, search, &closed.polished.fitted))
                    }
                }
            };
            limited |= found.limited;
        }
        let believed = believed(&judged, &found, &polished.fitted);
        Answer { found, polished, baseline, judged, believed, rejected, limited }
    }
}

/// The name of a part and the equations that it enters.
fn named_as(part: &MechanismTerm, library: &[Mechanism], nominal: &Model) -> (String, Vec<String>) {
    let kind = library[part.candidate.mechanism].kind.clone();
    (kind, part.candidate.place.equations(nominal))
}
