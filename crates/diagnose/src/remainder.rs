//! What no mechanism explains: where it acts and what it depends on.

use crate::candidate::Candidate;
use crate::diagnosis::Remainder;
use crate::discrepancy::Discrepancy;
use crate::fitted::{FittedModel, MechanismTerm};
use crate::library::Mechanism;
use crate::locate::Location;
use crate::place::{Motion, Place};
use crate::shapes::Variable;

/// What the forces of a model's parts depend on, where that is one motion.
pub(crate) fn only_variable(improved: &FittedModel, library: &[Mechanism]) -> Option<Variable> {
    let acts = |part: &&MechanismTerm| !library[part.candidate.mechanism].is_constant();
    let parts: Vec<&Candidate> = improved.parts.iter().filter(acts).map(|part| &part.candidate).collect();
    let motion = parts.first()?.motion()?;
    let is_only = parts.iter().all(|c| matches!(&c.place, Place::Motion(own) if own == motion));
    let depends = |primes| parts.iter().any(|c| library[c.mechanism].depends_on("d", primes));
    match (depends(0), depends(1)) {
        _ if !is_only || depends(2) => None,
        (true, false) => Some(Variable::Position(motion.clone())),
        (false, true) => Some(Variable::Rate(motion.clone())),
        _ => Some(Variable::Both(motion.clone())),
    }
}

pub(crate) fn remainder(
    improved: &FittedModel,
    discrepancy: Option<Discrepancy>,
    significant: bool,
    left: f64,
) -> Remainder {
    let model = &improved.setup.model;
    let mut location = Location::default();
    let mut shape = None;
    let share = discrepancy.as_ref().map_or(0.0, |s| s.gain.clamp(0.0, 1.0) * left.min(1.0));
    let force = |m: &Motion| match Place::Motion(m.clone()).moves(model) {
        true => "a force",
        false => "a term",
    };
    if significant && let Some(Discrepancy { variable: Some((variable, _)), .. }) = &discrepancy {
        let (motion, text) = match variable {
            Variable::Position(m) => {
                (m, m.position.as_ref().map(|e| format!("{} that depends on {e}", force(m))))
            }
            Variable::Rate(m) => (m, m.rate.as_ref().map(|e| format!("{} that depends on {e}", force(m)))),
            Variable::Both(m) => (
                m,
                match (&m.position, &m.rate) {
                    (Some(d), Some(v)) => Some(format!("{} that depends on {d} and {v} together", force(m))),
                    _ => None,
                },
            ),
            Variable::Product(m, o) => (
                m,
                match (&m.position, &o.position) {
                    (Some(d), Some(o)) => Some(format!("{} that depends on {d} and {o} together", force(m))),
                    _ => None,
                },
            ),
            Variable::Input(u, m) => {
                (m, Some(format!("{} that depends on the input {}", force(m), model.inputs[*u].name)))
            }
            Variable::Time(m) => (m, Some(format!("{} that changes slowly with time", force(m)))),
        };
        location.equations = Place::Motion(motion.clone()).equations(model);
        shape = text;
    }
    Remainder { significant, location, share_of_residual: share, shape }
}
