//! How far laws without a name can be trusted, and which are not handed back.
//!
//! | what | how |
//! |---|---|
//! | range of validity | least and largest value of the variables of their forces in the training recordings, SI, and the share of the held-out samples outside: there the laws are extrapolated |
//! | cross-validation | error on each part of the training recordings that was left out of the fit (`validate`), of the calibrated and of the improved model |
//! | correlation | r = C_ij / √(C_ii C_jj) of the estimates, C their covariance, with that parameter of the machine for which it is largest: near ±1 the recordings hardly tell the two apart |

use greybox_calibrate::Data;
use greybox_model::Expr;

use crate::fitted::{FittedModel, MechanismTerm};
use crate::library::Mechanism;
use crate::locate::{extent, time_of};
use crate::search::Search;
use crate::trajectory::TrajectoryEval;
use crate::uncertainty::Uncertainty;
use crate::validate;

/// How far the laws that an improved model holds without a name can be trusted.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// The variables of their forces.
    pub ranges: Vec<Range>,
    /// Share of the held-out samples where one of the variables is outside its range, 0 to 1; NaN where there is none.
    pub outside: f64,
    /// Cross-validation, fold by fold.
    pub folds: Vec<Fold>,
    /// By strength or constant of a law, what its estimate is correlated with.
    pub correlations: Vec<(String, Correlated)>,
}

/// Where a variable was in the training recordings, as the improved model simulates them.
#[derive(Debug, Clone, PartialEq)]
pub struct Range {
    /// Expression of the model.
    pub variable: String,
    /// Least value, SI.
    pub low: f64,
    /// Largest value, SI.
    pub high: f64,
    /// Share of the held-out samples outside, 0 to 1.
    pub outside: f64,
}

/// What was left out of a fit, and how it was predicted.
#[derive(Debug, Clone, PartialEq)]
pub struct Fold {
    /// The recordings.
    pub recordings: Vec<String>,
    /// From when to when, s from the start, of a part of one recording.
    pub window: Option<(f64, f64)>,
    /// RMS error over the RMS of the measurement about its mean, geometric mean over the channels, of the calibrated model
    /// fitted without the fold; infinite where it diverges.
    pub calibrated: f64,
    /// The same of the improved model.
    pub improved: f64,
}

/// The parameter of the machine whose estimate is most correlated with that of a law.
#[derive(Debug, Clone, PartialEq)]
pub struct Correlated {
    /// Its name.
    pub parameter: String,
    /// Correlation of the estimates, −1 to 1.
    pub correlation: f64,
}

/// What a closure must pass to be handed back, in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gate {
    /// No law acts at certain times of a single recording.
    Clock,
    /// The recordings determine its coefficients, and these are what its laws require of them.
    Determined,
    /// It simulates the training recordings no worse than the calibrated model.
    Training,
    /// No inertia is negative.
    Inertia,
    /// The machine's own parameters are within what the model states of them (`std`), or no farther from there than those of the
    /// calibrated model or of what stands without it.
    Parameters,
    /// It predicts what is left out of its fit better than the calibrated model, beyond chance.
    CrossValidation,
    /// It simulates the training recordings better than what stands without it, and predicts what is left out better.
    Comparison,
    /// It leaves no more than noise, or holds every law that is named.
    Names,
}

/// A closure that was tried and is not handed back.
#[derive(Debug, Clone, PartialEq)]
pub struct Rejected {
    /// The first gate that it fails at.
    pub gate: Gate,
    /// Its laws.
    pub laws: Vec<RejectedLaw>,
}

/// A law of such a closure.
#[derive(Debug, Clone, PartialEq)]
pub struct RejectedLaw {
    /// Kind of the library.
    pub kind: String,
    /// Equations that it enters.
    pub equations: Vec<String>,
    /// The law in the model's own names.
    pub expression: String,
}

impl Rejected {
    /// The laws of a model that fails at a gate.
    pub(crate) fn at(gate: Gate, search: &Search<'_>, fitted: &FittedModel) -> Rejected {
        let tables = search.tabulated(fitted).map(|(_, instances)| instances);
        let law = |(i, part): (usize, &MechanismTerm)| RejectedLaw {
            kind: search.library[part.candidate.mechanism].kind.clone(),
            equations: part.candidate.place.equations(&search.nominal().model),
            expression: tables.as_ref().map_or(&part.instance, |tables| &tables[i]).expression.to_string(),
        };
        Rejected { gate, laws: fitted.parts.iter().enumerate().map(law).collect() }
    }
}

impl Proposal {
    /// Of the `proposed` parts of `improved`, whose parameters are as uncertain as said. States are those that it simulates
    /// of the training and of the held-out recordings; `calibrated` and `own` are the logarithms of the errors on each fold.
    pub(crate) fn of(
        improved: &FittedModel,
        proposed: &[&MechanismTerm],
        library: &[Mechanism],
        (train, held_out): (&TrajectoryEval<'_>, &TrajectoryEval<'_>),
        (calibrated, own): (&[f64], &[f64]),
        uncertainty: &Uncertainty,
    ) -> Proposal {
        let mut variables: Vec<Expr> = Vec::new();
        for variable in proposed.iter().flat_map(|part| variables_of(improved, part, library)) {
            if !variables.contains(&variable) {
                variables.push(variable);
            }
        }
        let (ranges, outside) = ranges(&variables, train, held_out);
        let data = &improved.setup.data;
        let errors = calibrated.iter().copied().zip(own.iter().copied());
        let folds = validate::judged(data).into_iter().zip(errors);
        let folds = folds.map(|(left_out, errors)| Fold::of(data, &left_out, errors));
        // (The changes of a shape's slope are no figures of their own.)
        let formulas = proposed.iter().filter(|part| library[part.candidate.mechanism].shape.is_none());
        let formulas: Vec<&MechanismTerm> = formulas.copied().collect();
        let correlations = correlations(improved, &formulas, uncertainty);
        Proposal { ranges, outside, folds: folds.collect(), correlations }
    }
}

impl Fold {
    /// With the logarithms of the errors of the calibrated and the improved model.
    fn of(data: &Data, left_out: &validate::Fold, (calibrated, improved): (f64, f64)) -> Fold {
        let mut recordings: Vec<String> = Vec::new();
        for (piece, _) in left_out {
            let name = &data.recordings[data.pieces[*piece].recording];
            if !recordings.contains(name) {
                recordings.push(name.clone());
            }
        }
        let ends = left_out.iter().map(|(piece, range)| {
            let piece = &data.pieces[*piece];
            let time = |sample| time_of(piece.start, piece.dt, sample);
            (time(range.start), time(range.end))
        });
        let window = ends.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        let length =
            |(piece, range): &(usize, std::ops::Range<usize>)| (data.pieces[*piece].recording, range.len());
        let judged: usize = left_out.iter().map(|part| length(part).1).sum();
        let of_it = left_out.first().map(|part| length(part).0);
        let whole: usize = data.pieces.iter().filter(|p| Some(p.recording) == of_it).map(|p| p.len).sum();
        Fold {
            window: window.filter(|_| recordings.len() == 1 && judged < whole),
            recordings,
            calibrated: calibrated.exp(),
            improved: improved.exp(),
        }
    }
}

/// The variables that the force of a part depends on: positions and rates.
fn variables_of(improved: &FittedModel, part: &MechanismTerm, library: &[Mechanism]) -> Vec<Expr> {
    let mechanism = &library[part.candidate.mechanism];
    let model = &improved.setup.model;
    let of = |name: &str, primes: u8| {
        if !mechanism.depends_on(name, primes) {
            return None;
        }
        let expression =
            part.candidate.translate(model, &Expr::prime(name, primes), &str::to_string).simplify();
        // (A law seen from the other side.)
        Some(if let Expr::Neg(inner) = expression { *inner } else { expression })
    };
    ["d", "o"].into_iter().flat_map(|name| [of(name, 0), of(name, 1)]).flatten().collect()
}

/// Ranges of the variables, and the share of the held-out samples where one of them is outside its own.
fn ranges(
    variables: &[Expr],
    train: &TrajectoryEval<'_>,
    held_out: &TrajectoryEval<'_>,
) -> (Vec<Range>, f64) {
    let mut ranges = Vec::new();
    let mut any_outside: Vec<bool> = Vec::new();
    for variable in variables {
        let values = |along: &TrajectoryEval<'_>| along.eval(std::slice::from_ref(variable), &[])?.pop();
        let (Some(train), Some(held_out)) = (values(train), values(held_out)) else { continue };
        let (low, high) = extent(&train);
        let is_outside: Vec<bool> =
            held_out.iter().flatten().map(|value| !(low..=high).contains(value)).collect();
        any_outside.resize(is_outside.len(), false);
        any_outside.iter_mut().zip(&is_outside).for_each(|(any, own)| *any |= own);
        ranges.push(Range { variable: variable.to_string(), low, high, outside: share(&is_outside) });
    }
    (ranges, share(&any_outside))
}

/// How many are, of all; NaN of none.
fn share(are: &[bool]) -> f64 {
    are.iter().filter(|is| **is).count() as f64 / are.len() as f64
}

/// For each parameter of the parts the parameter of the machine whose estimate is most correlated with its own.
fn correlations(
    improved: &FittedModel,
    parts: &[&MechanismTerm],
    uncertainty: &Uncertainty,
) -> Vec<(String, Correlated)> {
    let setup = &improved.setup;
    let name = |free: usize| &setup.model.parameters[setup.free[free].index].name;
    let laws: Vec<&String> = improved.parts.iter().flat_map(|part| &part.instance.names).collect();
    let machine: Vec<usize> = (0..setup.free.len()).filter(|&i| !laws.contains(&name(i))).collect();
    let of = |law: &String| {
        let at = (0..setup.free.len()).find(|&i| name(i) == law)?;
        let with =
            machine.iter().map(|&i| (i, uncertainty.correlation(at, i))).filter(|(_, r)| r.is_finite());
        let (most, correlation) = with.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
        Some((law.clone(), Correlated { parameter: name(most).clone(), correlation }))
    };
    parts.iter().flat_map(|part| &part.instance.names).filter_map(of).collect()
}
